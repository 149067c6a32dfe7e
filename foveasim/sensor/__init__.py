"""Image sensors: quantum efficiency, colour filters, noise and conversion to codes."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from foveasim._core.calls import Limits, declarations_of, publish
from foveasim.sensor.budget import FIXED, TEMPORAL, NoiseBudget, noise_budget
from foveasim.sensor.calibration import Calibration, calibrate, linearise
from foveasim.sensor.effects.crosstalk import CrosstalkOperator, Diffusion, InterPixelCapacitance, KernelCrosstalk
from foveasim.sensor.effects.shot import draw_shot_noise
from foveasim.sensor.exposures import Ramp, Rates, fit_ramp, merge_exposures, non_destructive_reads
from foveasim.sensor.model.inversion import Inverse
from foveasim.sensor.model.linearisation import Linearisation
from foveasim.sensor.pixel_optics import (
    PIXEL_OPTICS,
    ApertureStack,
    Footprints,
    Microlens,
    Outlines,
    PixelOptics,
)
from foveasim.sensor.published.datasheet import DataSheet, read_datasheet
from foveasim.sensor.published.presets import PRESETS, Preset
from foveasim.sensor.sensor import Sensor
from foveasim.sensor.signal_to_noise import SiteSignals, signal_to_noise
from foveasim.sensor.spectral.curves import (
    BandMean,
    ConstantCurve,
    Curve,
    GaussianCurve,
    PassBand,
    ProductCurve,
    SiliconQE,
)
from foveasim.sensor.spectral.files import read_curve, read_filters
from foveasim.sensor.spectral.measured import camera_filters, ccd_qe
from foveasim.sensor.spectral.response import FilterSet, rgb_filters
from foveasim.sensor.spectral.tables import PolynomialCurve, SplineCurve, StepCurve, TableCurve

__all__ = [
    "FIXED",
    "LIMITS",
    "PIXEL_OPTICS",
    "PRESETS",
    "TEMPORAL",
    "ApertureStack",
    "BandMean",
    "Calibration",
    "ConstantCurve",
    "CrosstalkOperator",
    "Curve",
    "DataSheet",
    "Diffusion",
    "FilterSet",
    "Footprints",
    "GaussianCurve",
    "InterPixelCapacitance",
    "Inverse",
    "KernelCrosstalk",
    "Linearisation",
    "Microlens",
    "NoiseBudget",
    "Outlines",
    "PassBand",
    "PixelOptics",
    "PolynomialCurve",
    "Preset",
    "ProductCurve",
    "Ramp",
    "Rates",
    "Sensor",
    "SiliconQE",
    "SiteSignals",
    "SplineCurve",
    "StepCurve",
    "TableCurve",
    "calibrate",
    "camera_filters",
    "ccd_qe",
    "draw_shot_noise",
    "fit_ramp",
    "linearise",
    "merge_exposures",
    "noise_budget",
    "non_destructive_reads",
    "read_curve",
    "read_datasheet",
    "read_filters",
    "rgb_filters",
    "signal_to_noise",
]

#: Plausible ranges of the parameters of :class:`Sensor`.
LIMITS: Mapping[str, Limits] = MappingProxyType(
    {name: each.limits for name, each in declarations_of(Sensor).items() if each.limits is not None}
)

publish(__name__)

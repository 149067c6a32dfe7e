"""Spectral curves (quantum efficiency, filter transmission) and sets of colour filters."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim._core.registry import import_all
from foveasim.sensor.spectral.curves import (
    CURVES,
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
    "CURVES",
    "BandMean",
    "ConstantCurve",
    "Curve",
    "FilterSet",
    "GaussianCurve",
    "PassBand",
    "PolynomialCurve",
    "ProductCurve",
    "SiliconQE",
    "SplineCurve",
    "StepCurve",
    "TableCurve",
    "camera_filters",
    "ccd_qe",
    "read_curve",
    "read_filters",
    "rgb_filters",
]

import_all(__name__, __path__)

publish(__name__)

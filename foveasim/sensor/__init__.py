"""Sensors: quantum efficiency, colour filters, noise, conversion to codes."""

from __future__ import annotations

from foveasim.sensor._sensor import Sensor
from foveasim.sensor.crosstalk import Coupling, Diffusion, KernelCrosstalk, Mixing
from foveasim.sensor.noise import draw_shot_noise
from foveasim.sensor.spectral import (
    ConstantCurve,
    FilterSet,
    GaussianCurve,
    PolynomialCurve,
    SiliconQE,
    rgb_filters,
)

__all__ = [
    "ConstantCurve",
    "Coupling",
    "Diffusion",
    "FilterSet",
    "GaussianCurve",
    "KernelCrosstalk",
    "Mixing",
    "PolynomialCurve",
    "Sensor",
    "SiliconQE",
    "draw_shot_noise",
    "rgb_filters",
]

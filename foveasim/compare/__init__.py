"""
Comparison of cameras and layouts at equal budget.

Pictures, their quality by eccentricity, signal-to-noise ratio, resolution, aliasing, information and precision of motion.
"""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.compare.annuli import PictureQuality, quality_by_eccentricity
from foveasim.compare.budgets import BUDGETS, Budget, budget_of
from foveasim.compare.comparison import Comparison, cameras, layouts
from foveasim.compare.information import (
    SceneCovariance,
    gaussian_information_bits,
    scene_covariance,
    site_information_bits,
)
from foveasim.compare.intervals import MedianInterval, median_interval
from foveasim.compare.setup import default_sensor, photograph_scenes

__all__ = [
    "BUDGETS",
    "Budget",
    "Comparison",
    "MedianInterval",
    "PictureQuality",
    "SceneCovariance",
    "budget_of",
    "cameras",
    "default_sensor",
    "gaussian_information_bits",
    "layouts",
    "median_interval",
    "photograph_scenes",
    "quality_by_eccentricity",
    "scene_covariance",
    "site_information_bits",
]

publish(__name__)

"""Plots by matplotlib, which is imported on use."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.view.plots.figures import hidden_figures
from foveasim.view.plots.rasters import plot_cortical, plot_image, plot_picture, plot_power_map, plot_scene
from foveasim.view.plots.results import plot_results
from foveasim.view.plots.rules import plot_report
from foveasim.view.plots.sites import (
    plot_angular_response,
    plot_capture,
    plot_curves,
    plot_layout,
    plot_noise_budget,
    save_drawing,
    save_figure,
)

__all__ = [
    "hidden_figures",
    "plot_angular_response",
    "plot_capture",
    "plot_cortical",
    "plot_curves",
    "plot_image",
    "plot_layout",
    "plot_noise_budget",
    "plot_picture",
    "plot_power_map",
    "plot_report",
    "plot_results",
    "plot_scene",
    "save_drawing",
    "save_figure",
]

publish(__name__)

"""Looking at layouts and captures. Needs matplotlib, which is loaded when something is drawn."""

from __future__ import annotations

from foveasim.view.meshes import Mesh, polydata, prisms
from foveasim.view.plots import plot_capture, plot_layout, plot_noise_budget, save_figure
from foveasim.view.probe import find_renderer
from foveasim.view.stills import Viewpoint, render, show, sites_in_view

__all__ = [
    "Mesh",
    "Viewpoint",
    "find_renderer",
    "plot_capture",
    "plot_layout",
    "plot_noise_budget",
    "polydata",
    "prisms",
    "render",
    "save_figure",
    "show",
    "sites_in_view",
]

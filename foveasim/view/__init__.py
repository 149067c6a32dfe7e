"""Looking at layouts and captures. Needs matplotlib, which is loaded when something is drawn."""

from __future__ import annotations

from foveasim.view.plots import plot_capture, plot_layout, plot_noise_budget, save_figure
from foveasim.view.probe import find_renderer

__all__ = ["find_renderer", "plot_capture", "plot_layout", "plot_noise_budget", "save_figure"]

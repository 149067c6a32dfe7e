"""
Plots, three-dimensional rendering and web pages of layouts and captures.

matplotlib is imported when something is drawn.
"""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.view.id_map import SitePixels, id_map, site_at
from foveasim.view.meshes import Mesh, polydata, prisms
from foveasim.view.notebook import to_html, to_png, widget
from foveasim.view.plots import (
    hidden_figures,
    plot_angular_response,
    plot_capture,
    plot_cortical,
    plot_curves,
    plot_image,
    plot_layout,
    plot_noise_budget,
    plot_picture,
    plot_power_map,
    plot_report,
    plot_results,
    plot_scene,
    save_drawing,
    save_figure,
)
from foveasim.view.render3d import Viewpoint, plotter, render, show, show_columns, sites_in_view
from foveasim.view.renderer import find_renderer
from foveasim.view.site_colours import SiteColours, colours_of, site_colours
from foveasim.view.site_pictures import picture_colours, site_picture
from foveasim.view.solids import PartReport, SensorStack, Solids, SolidsReport, solids, stack, write_meshes
from foveasim.view.web import solid_page, web_page, write_solid_page, write_web_page

__all__ = [
    "Mesh",
    "PartReport",
    "SensorStack",
    "SiteColours",
    "SitePixels",
    "Solids",
    "SolidsReport",
    "Viewpoint",
    "colours_of",
    "find_renderer",
    "hidden_figures",
    "id_map",
    "picture_colours",
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
    "plotter",
    "polydata",
    "prisms",
    "render",
    "save_drawing",
    "save_figure",
    "show",
    "show_columns",
    "site_at",
    "site_colours",
    "site_picture",
    "sites_in_view",
    "solid_page",
    "solids",
    "stack",
    "to_html",
    "to_png",
    "web_page",
    "widget",
    "write_meshes",
    "write_solid_page",
    "write_web_page",
]

publish(__name__)

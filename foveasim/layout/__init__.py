"""Photosite layouts: model, generators, edits, colour filters, readout and design rules."""

from __future__ import annotations

from typing import TYPE_CHECKING

from foveasim._core.calls import publish
from foveasim.layout.adjacency import adjacency
from foveasim.layout.channels import MOSAICS, graph_colouring, mosaic, random_channels
from foveasim.layout.drc.cleaning import clean, cleaned
from foveasim.layout.drc.measurements import RULES, Rule
from foveasim.layout.drc.presets import PRESETS, Preset
from foveasim.layout.drc.repair import Change, Changes, Stock, enforce, repair
from foveasim.layout.drc.routing import Readout, Routing, track_demand
from foveasim.layout.drc.rules import DesignRules, Report, RuleResult, Violation, min_width_um
from foveasim.layout.edit_registry import EDITS, layout_edit
from foveasim.layout.edits.all_sites import clip, cut_out, inset, merge, merge_small, node, snap, split, union
from foveasim.layout.edits.at_points import (
    cut_along,
    merge_at,
    move_sites,
    move_vertices,
    remove_at,
    remove_vertices,
    set_channel,
    sites_at,
    split_at,
)
from foveasim.layout.edits.layers import draw, overlay
from foveasim.layout.files import (
    DERIVED_LAYERS,
    FORMATS,
    FileFormat,
    LayoutLayer,
    WrittenLayout,
    bundled_layouts,
    read_layer_map,
    read_layout,
    write_layout,
)
from foveasim.layout.generator_registry import LAYOUTS, layout_generator
from foveasim.layout.generators.foveal_cartesian import foveal_cartesian
from foveasim.layout.generators.fovi import fovi
from foveasim.layout.generators.giotto import giotto, giotto_ratio
from foveasim.layout.generators.grid import grid
from foveasim.layout.generators.hexagonal import hexagonal
from foveasim.layout.generators.log_polar import log_polar, square_ring_ratio
from foveasim.layout.generators.octagonal import octagonal
from foveasim.layout.generators.penrose import penrose
from foveasim.layout.generators.quadtree import quadtree
from foveasim.layout.generators.sunflower import sunflower
from foveasim.layout.generators.tiling import fill, tiling
from foveasim.layout.generators.voronoi import voronoi
from foveasim.layout.generators.voronoi_of import voronoi_of
from foveasim.layout.generators.zones import zones
from foveasim.layout.graph import SiteGraph, to_graph
from foveasim.layout.model import Layout
from foveasim.layout.readout import nearest_bus, readout_by, readout_order
from foveasim.layout.sizes.optical_formats import OPTICAL_FORMATS, OpticalFormat
from foveasim.layout.sizes.site_counts import SolveFor
from foveasim.layout.sizes.sizing import from_sizes
from foveasim.layout.summary import Summary, describe

__all__ = [
    "DERIVED_LAYERS",
    "EDITS",
    "FORMATS",
    "LAYOUTS",
    "MOSAICS",
    "OPTICAL_FORMATS",
    "PRESETS",
    "RULES",
    "Change",
    "Changes",
    "DesignRules",
    "FileFormat",
    "Layout",
    "LayoutLayer",
    "OpticalFormat",
    "Preset",
    "Readout",
    "Report",
    "Routing",
    "Rule",
    "RuleResult",
    "SiteGraph",
    "SolveFor",
    "Stock",
    "Summary",
    "Violation",
    "WrittenLayout",
    "adjacency",
    "bundled_layouts",
    "clean",
    "cleaned",
    "clip",
    "cut_along",
    "cut_out",
    "describe",
    "draw",
    "enforce",
    "fill",
    "foveal_cartesian",
    "fovi",
    "from_sizes",
    "giotto",
    "giotto_ratio",
    "graph_colouring",
    "grid",
    "hexagonal",
    "inset",
    "layout_edit",
    "layout_generator",
    "log_polar",
    "merge",
    "merge_at",
    "merge_small",
    "min_width_um",
    "mosaic",
    "move_sites",
    "move_vertices",
    "nearest_bus",
    "node",
    "octagonal",
    "overlay",
    "penrose",
    "quadtree",
    "random_channels",
    "read_layer_map",
    "read_layout",
    "readout_by",
    "readout_order",
    "remove_at",
    "remove_vertices",
    "repair",
    "set_channel",
    "sites_at",
    "snap",
    "split",
    "split_at",
    "square_ring_ratio",
    "sunflower",
    "tiling",
    "to_graph",
    "track_demand",
    "union",
    "voronoi",
    "voronoi_of",
    "write_layout",
    "zones",
]

if not TYPE_CHECKING:  # generators registered by other packages or at run time
    __getattr__ = LAYOUTS.attributes_of(__name__)

publish(__name__)

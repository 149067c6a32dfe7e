"""Photosites: the layout model, generators (one file a family), edits, neighbours, colour filters, readout, design rules."""

from __future__ import annotations

from foveasim.layout._model import Layout
from foveasim.layout.adjacency import adjacency
from foveasim.layout.channels import MOSAICS, colouring, mosaic, random_channels
from foveasim.layout.edits import clip, inset, merge, merge_small, node, punch, snap, split, union
from foveasim.layout.enforce import Change, enforce
from foveasim.layout.files import WrittenLayout, read_layout, shipped_layouts, write_layout
from foveasim.layout.foveal_cartesian import foveal_cartesian
from foveasim.layout.fovi import fovi
from foveasim.layout.giotto import giotto, giotto_ratio
from foveasim.layout.grid import grid
from foveasim.layout.hexagonal import hexagonal
from foveasim.layout.log_polar import log_polar, square_ring_ratio
from foveasim.layout.octagonal import octagonal
from foveasim.layout.penrose import penrose
from foveasim.layout.presets import PRESETS, Preset
from foveasim.layout.quadtree import quadtree
from foveasim.layout.readout import nearest_bus, readout_by, readout_order
from foveasim.layout.routing import Readout, Routing, crossings
from foveasim.layout.rules import DesignRules, Report, RuleResult, Violation, min_width_um
from foveasim.layout.summary import Summary, describe
from foveasim.layout.sunflower import sunflower
from foveasim.layout.tiling import fill, tiling
from foveasim.layout.voronoi import voronoi
from foveasim.layout.zones import zones

__all__ = [
    "MOSAICS",
    "PRESETS",
    "Change",
    "DesignRules",
    "Layout",
    "Preset",
    "Readout",
    "Report",
    "Routing",
    "RuleResult",
    "Summary",
    "Violation",
    "WrittenLayout",
    "adjacency",
    "clip",
    "colouring",
    "crossings",
    "describe",
    "enforce",
    "fill",
    "foveal_cartesian",
    "fovi",
    "giotto",
    "giotto_ratio",
    "grid",
    "hexagonal",
    "inset",
    "log_polar",
    "merge",
    "merge_small",
    "min_width_um",
    "mosaic",
    "nearest_bus",
    "node",
    "octagonal",
    "penrose",
    "punch",
    "quadtree",
    "random_channels",
    "read_layout",
    "readout_by",
    "readout_order",
    "shipped_layouts",
    "snap",
    "split",
    "square_ring_ratio",
    "sunflower",
    "tiling",
    "union",
    "voronoi",
    "write_layout",
    "zones",
]

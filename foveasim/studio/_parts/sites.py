"""Outlines of the photosites."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.config import Shot
from foveasim.layout import Layout
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.ahead import MANY_SITES, Ahead
from foveasim.studio._parts.registry import PartData, layout_of, part
from foveasim.view.web._content import PALETTE, outlines_of
from foveasim.view.web._shapes import Shapes, shapes_of

#: Largest number of edges of a boundary; with more, the bounding box is drawn.
MAX_EDGES = 20_000
#: A boundary has at most this number of edges per square root of the number of photosites, and some more.
EDGES_PER_SIDE, MORE_EDGES = 24, 64


def _start(shot: Shot) -> None:
    if shot.camera.layout.n_sites >= MANY_SITES:
        _arrays_of.start(shot.camera.layout)


@part("Photosites", layout_of, order=0, work_ahead=_start)
def sites(result: Simulated) -> PartData:
    """Return the outlines of the photosites, and the boundary of the layout."""
    layout = result.capture.layout
    about = {"n_sites": layout.n_sites, "bounds_um": layout.bounds_um, "palette": PALETTE}
    return about, _arrays_of(layout)


@Ahead
def _arrays_of(layout: Layout) -> dict[str, NDArray[Any]]:
    shapes = shapes_of(layout)
    return outlines_of(shapes) | _boundary_of(shapes)


def _boundary_of(shapes: Shapes) -> dict[str, NDArray[Any]]:
    """
    Return the edges that no two photosites have in common, by the positions of their ends.

    Nothing if there are many: photosites with gaps have no common edges, and their box is more legible.
    """
    from foveasim.view._kernels import outer_edges

    edges = outer_edges(shapes.position, shapes.ring_offsets)
    limit = min(MAX_EDGES, EDGES_PER_SIDE * math.sqrt(shapes.site_offsets.size - 1) + MORE_EDGES)
    return {} if len(edges) > limit else {"boundary": edges.astype(np.uint32)}

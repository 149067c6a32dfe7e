"""Outlines of the photosites."""

from __future__ import annotations

import math
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from foveasim.layout import Layout
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, layout_of, part
from foveasim.view.web._content import PALETTE, outlines_of
from foveasim.view.web._shapes import Shapes, shapes_of

#: Largest number of edges of a boundary; with more, the bounding box is drawn.
MAX_EDGES = 20_000
#: A boundary has at most this number of edges per square root of the number of photosites, and some more.
EDGES_PER_SIDE, MORE_EDGES = 24, 64


@part("Photosites", layout_of, order=0)
def sites(result: Simulated) -> PartData:
    """Return the outlines of the photosites, and the boundary of the layout."""
    layout = result.capture.layout
    about = {"n_sites": layout.n_sites, "bounds_um": layout.bounds_um, "palette": PALETTE}
    ahead = _ahead.pop(layout, None)
    return about, _arrays_of(layout) if ahead is None else ahead.result()


def compute_ahead(layout: Layout) -> None:
    """Start to compute the arrays of a layout in another thread, until its outlines are sent."""
    if layout not in _ahead:
        _ahead[layout] = _executor.submit(_arrays_of, layout)


_executor = ThreadPoolExecutor(1, "studio outlines")
_ahead: WeakKeyDictionary[Layout, Future[dict[str, NDArray[Any]]]] = WeakKeyDictionary()


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

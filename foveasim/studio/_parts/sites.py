"""Outlines of the photosites."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, layout_of, part
from foveasim.view.web._content import describe_sites, outlines_of
from foveasim.view.web._shapes import Shapes, shapes_of

#: Largest number of edges of a boundary; with more, the bounding box is drawn.
MAX_EDGES = 20_000
#: A boundary has at most this number of edges per square root of the number of photosites, and some more.
EDGES_PER_SIDE, MORE_EDGES = 24, 64


@part("Photosites", layout_of, order=0)
def sites(result: Simulated) -> PartData:
    """Return the outlines of the photosites, and the boundary of the layout."""
    about, _, layout = describe_sites(result.capture.layout)
    shapes = shapes_of(layout)
    return {key: about[key] for key in ("n_sites", "bounds_um", "palette")}, outlines_of(shapes) | _boundary_of(shapes)


def _boundary_of(shapes: Shapes) -> dict[str, NDArray[Any]]:
    """
    Return the edges that no two photosites have in common, by the positions of their ends.

    Nothing if there are many: photosites with gaps have no common edges, and their box is more legible.
    """
    from foveasim.view._kernels import outer_edges

    edges = outer_edges(shapes.position, shapes.ring_offsets)
    limit = min(MAX_EDGES, EDGES_PER_SIDE * math.sqrt(shapes.site_offsets.size - 1) + MORE_EDGES)
    return {} if len(edges) > limit else {"boundary": edges.astype(np.uint32)}

"""Areas that two polygons have in common."""

from __future__ import annotations

import numpy as np
import shapely


def overlaps_um2(polygons):
    """
    Return the areas that pairs of polygons have in common, (n_pair,).

    The smaller result of floating-point noding, which GEOS 3.14 computes wrongly for boundaries that nearly coincide, and of a
    grid, which is not exact.
    """
    a, b = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    a, b = a[a < b], b[a < b]
    exact, on_grid = (
        shapely.area(shapely.intersection(polygons[a], polygons[b], **grid)) for grid in ({}, {"grid_size": 1e-9})
    )
    return np.where(on_grid < 0.5 * exact, np.minimum(exact, on_grid), exact)

"""Areas that two polygons have in common."""

from __future__ import annotations

import numpy as np
import shapely


def overlaps_um2(polygons):
    """
    Return the areas that pairs of polygons have in common, (n_pair,).

    The smaller result of floating-point noding, which GEOS 3.14 computes wrongly for boundaries that nearly coincide, and of a
    grid, which is not exact, and needed only where the first is not 0.
    """
    a, b = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    a, b = a[a < b], b[a < b]
    common_um2 = shapely.area(shapely.intersection(polygons[a], polygons[b]))
    (pair,) = np.nonzero(common_um2)
    on_grid_um2 = shapely.area(shapely.intersection(polygons[a[pair]], polygons[b[pair]], grid_size=1e-9))
    is_wrong = on_grid_um2 < 0.5 * common_um2[pair]
    common_um2[pair[is_wrong]] = on_grid_um2[is_wrong]
    return common_um2

"""Which site covers each sample, by exact fractions: slow, and plain enough to be believed."""

from __future__ import annotations

from fractions import Fraction

import numpy as np


def track_demand(rings, y):
    """Where a row crosses the edges, each from its lower end (included) to its upper end (not): fractions."""
    found = []
    for ring in rings:
        points = [(Fraction(float(px)), Fraction(float(py))) for px, py in ring]
        for (ax, ay), (bx, by) in zip(points, points[1:] + points[:1], strict=True):
            if min(ay, by) <= y < max(ay, by):
                found.append(ax + (y - ay) * (bx - ax) / (by - ay))
    return found


def id_map(sites, x_um, y_um):
    """
    The highest of the sites (lists of rings) over each sample, (n_y, n_x); -1 where there is none.

    Even-odd; a sample on an edge lies on the edge's +x side, on a horizontal edge on its +y side.
    """
    ids = np.full((len(y_um), len(x_um)), -1)
    for site, rings in enumerate(sites):
        for iy, y in enumerate(y_um):
            beyond = track_demand(rings, Fraction(float(y)))
            for ix, x in enumerate(x_um):
                if sum(crossing <= x for crossing in beyond) % 2:
                    ids[iy, ix] = site
    return ids

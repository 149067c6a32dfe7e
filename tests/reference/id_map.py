"""Map of site indices at sample points, in rational arithmetic."""

from __future__ import annotations

from fractions import Fraction

import numpy as np


def row_crossings(rings, y):
    """Return the crossings of a row with edges, which include their lower and exclude their upper end, as fractions."""
    found = []
    for ring in rings:
        points = [(Fraction(float(px)), Fraction(float(py))) for px, py in ring]
        for (ax, ay), (bx, by) in zip(points, points[1:] + points[:1], strict=True):
            if min(ay, by) <= y < max(ay, by):
                found.append(ax + (y - ay) * (bx - ax) / (by - ay))
    return found


def id_map(sites, x_um, y_um):
    """
    Return the largest index of the sites (lists of rings) that cover each sample, (n_y, n_x); -1 without a site.

    Even-odd rule; a sample on an edge belongs to the +x side of the edge, on a horizontal edge to its +y side.
    """
    ids = np.full((len(y_um), len(x_um)), -1)
    for site, rings in enumerate(sites):
        for iy, y in enumerate(y_um):
            beyond = row_crossings(rings, Fraction(float(y)))
            for ix, x in enumerate(x_um):
                if sum(crossing <= x for crossing in beyond) % 2:
                    ids[iy, ix] = site
    return ids

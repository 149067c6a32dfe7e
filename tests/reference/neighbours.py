"""Sibson coordinates by clipping Voronoi cells from a large square with half-planes."""

from __future__ import annotations

import numpy as np
import shapely


def nearer_to(cell, point, other):
    """Return the part of a polygon that is nearer to ``point`` than to ``other``."""
    centre, away = 0.5 * (point + other), other - point
    along = np.array([-away[1], away[0]]) / np.hypot(*away) * 1e4
    back = -away / np.hypot(*away) * 1e4
    half = shapely.Polygon([centre - along, centre + along, centre + along + back, centre - along + back])
    return cell.intersection(half)


def cell_of(point, others, side=1e3):
    """Return the Voronoi cell of a point among others."""
    cell = shapely.box(-side, -side, side, side)
    for other in others:
        cell = nearer_to(cell, point, other)
    return cell


def sibson_weights(xy, point):
    """Return the fractions of the Voronoi cell of a new point that belonged to each site, (n_site,)."""
    new = cell_of(point, xy)
    taken = np.array([cell_of(site, np.delete(xy, k, axis=0)).intersection(new).area for k, site in enumerate(xy)])
    return taken / new.area

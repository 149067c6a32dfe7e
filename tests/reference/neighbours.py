"""Sibson's coordinates by cutting Voronoi cells out of a large square with half-planes: slow, and plain."""

from __future__ import annotations

import numpy as np
import shapely


def nearer_to(cell, point, other):
    """The part of a polygon that is nearer to a point than to another."""
    middle, away = 0.5 * (point + other), other - point
    along = np.array([-away[1], away[0]]) / np.hypot(*away) * 1e4
    back = -away / np.hypot(*away) * 1e4
    half = shapely.Polygon([middle - along, middle + along, middle + along + back, middle - along + back])
    return cell.intersection(half)


def cell_of(point, others, side=1e3):
    """Voronoi cell of a point among others."""
    cell = shapely.box(-side, -side, side, side)
    for other in others:
        cell = nearer_to(cell, point, other)
    return cell


def stolen_shares(xy, point):
    """Fraction of a new point's Voronoi cell that was each site's, (n_site,)."""
    new = cell_of(point, xy)
    stolen = np.array([cell_of(site, np.delete(xy, k, axis=0)).intersection(new).area for k, site in enumerate(xy)])
    return stolen / new.area

"""User-defined regions of the sensor plane: rectangles, discs, outlines, shapely polygons."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import shapely

from foveasim._core.validation import MAX_LENGTH_UM, check_length_um, finite_array
from foveasim.errors import ParameterError, printable, type_name

#: Vertices of a polygonal disc, by default: its area is that of the circle within 7 ppm.
DISC_CORNERS = 960
#: Characters of an invalid text that messages show.
MAX_SHOWN = 60


def parse_region(*, size_um: Any = None, radius_um: float | None = None, region: Any = None) -> Any:
    """
    Return the specified region as a shapely Polygon or MultiPolygon in µm.

    ``size_um`` (width, height), µm: rectangle around the optical axis. ``radius_um`` (float, µm): disc around the optical
    axis. ``region``: shapely polygon or (n, 2) vertices, µm.
    """
    if sum(x is not None for x in (size_um, radius_um, region)) != 1:
        raise ParameterError("region", "or 'size_um' or 'radius_um' must be given, but only one of them")
    if size_um is not None:
        x_um, y_um = (0.5 * check_length_um(f"size_um[{i}]", x) for i, x in enumerate(size_um))
        return shapely.box(-x_um, -y_um, x_um, y_um)
    if radius_um is not None:
        return disc(check_length_um("radius_um", radius_um), DISC_CORNERS)
    return as_region("region", region)


def as_region(name: str, region: Any) -> Any:
    """
    Return a region as a shapely Polygon or MultiPolygon with a positive area.

    The region is such a polygon, its well-known text (WKT), or an (n, 2) array of vertices in µm.
    """
    outline = region
    if isinstance(region, str):
        outline = shapely.from_wkt(region, on_invalid="ignore")
        if outline is None:
            raise ParameterError(name, "must be a polygon as well-known text (WKT)", printable(region)[:MAX_SHOWN])
    elif not isinstance(region, shapely.Geometry):
        vertices = finite_array(name, region, ndim=2)
        if vertices.shape[1] != 2 or vertices.shape[0] < 3:
            raise ParameterError(name, f"must have the shape (n, 2) with n >= 3, got {vertices.shape}")
        outline = shapely.Polygon(vertices)
    if not isinstance(outline, shapely.Polygon | shapely.MultiPolygon):
        raise ParameterError(name, f"must be a shapely Polygon or MultiPolygon, got {type_name(outline)}")
    if outline.is_empty or not outline.is_valid or not outline.area > 0.0:
        raise ParameterError(name, "must be a valid polygon without self-intersections and with a positive area")
    if np.abs(outline.bounds).max() > MAX_LENGTH_UM:
        raise ParameterError(name, f"must lie within {MAX_LENGTH_UM:g} µm of the origin", hint="coordinates are in µm")
    return outline


def disc(radius_um: float, n_chords: int) -> shapely.Polygon:
    """Return a disc around the axis as a regular inscribed polygon, first vertex at angle 0."""
    angle_rad = 2.0 * math.pi * np.arange(n_chords) / n_chords
    return shapely.Polygon(radius_um * np.stack((np.cos(angle_rad), np.sin(angle_rad)), axis=1))

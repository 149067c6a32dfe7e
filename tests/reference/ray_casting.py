"""Ray casting of a pinhole camera onto prisms over polygons, a reference for pixels of the 3D view."""

from __future__ import annotations

import itertools

import numpy as np
import shapely

#: Vertical field of view of the web page.
FIELD_DEG = 35.0


def rays_of(camera, width, height, pixels):
    """Return ray directions (n, 3) through positions in a window ``width`` by ``height``, from its top left corner."""
    eye, target = np.array(camera["eye"]), np.array(camera["target"])
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    # In a vertical view from above, x points to the right.
    right = np.array((1.0, 0.0, 0.0)) if np.linalg.norm(right) < 1e-9 else right / np.linalg.norm(right)
    up = np.cross(right, forward)
    half = np.tan(np.radians(FIELD_DEG / 2))
    x, y = np.asarray(pixels, float).T
    aside = (2 * x / width - 1) * half * width / height
    above = (1 - 2 * y / height) * half
    return forward + aside[:, np.newaxis] * right + above[:, np.newaxis] * up


def first_hits(polygons, floors, roofs, eye, directions, *, has_floor):
    """
    Return the distances (n, n_prism) along rays to the first surface of every prism, inf if a ray misses it.

    Prisms extend over polygons between two heights each; without a floor they are open at the bottom.
    """
    eye = np.asarray(eye, float)
    hits = np.full((len(directions), len(polygons)), np.inf)
    for k, (polygon, floor, roof) in enumerate(zip(polygons, floors, roofs, strict=True)):
        for z in (roof, floor) if has_floor else (roof,):
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (z - eye[2]) / directions[:, 2]
                x, y = (eye[i] + t * directions[:, i] for i in range(2))
            is_hit = (t > 0) & np.isfinite(t)
            is_hit[is_hit] = shapely.contains_xy(polygon, x[is_hit], y[is_hit])
            hits[is_hit, k] = np.minimum(hits[is_hit, k], t[is_hit])
        for ring in (polygon.exterior, *polygon.interiors):
            corners = np.array(ring.coords)
            for a, b in itertools.pairwise(corners):
                edge = b - a
                # Solve eye + t direction = a + s edge in the plane.
                cross = directions[:, 0] * edge[1] - directions[:, 1] * edge[0]
                with np.errstate(divide="ignore", invalid="ignore"):
                    t = ((a[0] - eye[0]) * edge[1] - (a[1] - eye[1]) * edge[0]) / cross
                    s = ((a[0] - eye[0]) * directions[:, 1] - (a[1] - eye[1]) * directions[:, 0]) / cross
                    z = eye[2] + t * directions[:, 2]
                    is_hit = (t > 0) & (s >= 0) & (s <= 1) & (z >= floor) & (z <= roof)
                hits[is_hit, k] = np.minimum(hits[is_hit, k], t[is_hit])
    return hits

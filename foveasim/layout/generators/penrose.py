"""Penrose layout: an aperiodic tiling of thick and thin rhombs."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np

from foveasim._core.calls import LENGTH
from foveasim._core.validation import MAX_SITES, Bools, Floats, Ints
from foveasim.errors import ParameterError
from foveasim.layout.generator_registry import layout_generator
from foveasim.layout.model import Layout
from foveasim.layout.sizes.site_counts import SolveFor

__all__ = ["penrose"]

GOLDEN_RATIO = (1.0 + math.sqrt(5.0)) / 2.0
#: Mean area of a rhomb in squared sides: in the plane, the number ratio of thick to thin rhombs is the golden ratio.
MEAN_AREA = (GOLDEN_RATIO * math.sin(math.radians(72.0)) + math.sin(math.radians(36.0))) / (GOLDEN_RATIO + 1.0)
#: Corners are integer combinations of the powers 0 to 3 of a rotation by 72°: exact, and therefore equal for neighbours.
FIFTH_ROTATIONS = np.stack(
    ([math.cos(2.0 * math.pi * k / 5.0) for k in range(4)], [math.sin(2.0 * math.pi * k / 5.0) for k in range(4)])
)
#: Multiplication of the four integers of a corner by the golden ratio: rows -(z² + z³) z^k with z⁴ = -1 - z - z² - z³.
TIMES_GOLDEN = np.array([(0, 0, -1, -1), (1, 1, 1, 0), (0, 1, 1, 1), (-1, -1, 0, 0)])
#: Number of subdivisions after which the centre repeats, so that a larger layout contains each rhomb of a smaller one.
PERIOD = 4
#: Weights that combine four integers of magnitude below 2**15 into one.
KEY = 2 ** np.array((48, 32, 16, 0), np.int64)
#: Ratio of inradius to circumradius of the first decagon.
DECAGON_INRADIUS_RATIO = math.cos(math.pi / 10.0)


@layout_generator(
    has_mosaic=False,
    example={"side_um": 2.0, "size_um": 30.0},
    solve_for=(
        SolveFor(
            name="side_um",
            is_integer=False,
            is_increasing=False,
            guess=lambda n_sites, parameters: _side_um(n_sites, parameters["size_um"], parameters["shape"] == "disc"),
        ),
    ),
)
def penrose(
    side_um: Annotated[float | None, LENGTH] = None,
    *,
    size_um: Annotated[float, LENGTH],
    shape: Literal["disc", "square"] = "disc",
    n_sites: int | None = None,  # noqa: ARG001 -- resolved by layout_generator
) -> Layout:
    """
    Generate thick and thin rhombs with fivefold symmetry around the optical axis.

    ::

              ╱╲                 thick: corners of 72 and 108 degrees, area sin 72° · side_um²
            ╱    ╲  side_um      thin:  corners of 36 and 144 degrees, area sin 36° · side_um²
          ╱        ╲
          ╲        ╱             included: rhombs with their centre in the disc or square
            ╲    ╱
              ╲╱                 thick to thin: 1.618034 by area, and → 1.618034 by number

    Parameters
    ----------
    size_um : float, µm
        Diameter of the disc, or side of the square, around the axis that contains the centres of the rhombs.
    side_um : float, µm
        Side of all rhombs.
    shape : {"disc", "square"}
        Shape of this region.
    n_sites : int, optional
        Number of sites, instead of ``side_um``, within 1 %.

    Returns
    -------
    Layout
        Complete rhombs in the order of their centres from bottom to top, with the column ``is_thick`` (1 or 0).

    Raises
    ------
    ParameterError
        When a number is out of range, or there would be no sites, or too many.

    Notes
    -----
    Ten golden triangles around the axis are subdivided (deflation of de Bruijn and Robinson) to the required size; mirrored
    pairs form a rhomb. Corners are represented by integers, the coefficients of powers of a rotation by 72°, until the final
    step. A larger ``size_um`` only adds rhombs. In a corner of a square, a rhomb may touch the others only in a vertex.

    Examples
    --------
    >>> layout = penrose(side_um=3.0, size_um=200.0)
    >>> n_thick = int(layout.columns["is_thick"].sum())
    >>> n_thick, layout.n_sites - n_thick
    (2640, 1640)
    """
    assert side_um is not None
    n_expected = (0.25 * math.pi if shape == "disc" else 1.0) * (size_um / side_um) ** 2 / MEAN_AREA
    if n_expected > MAX_SITES:
        raise ParameterError("side_um", f"must give at most {MAX_SITES} sites", side_um, "µm", "take larger rhombs")
    rings_um, is_thick = _rhombs(side_um, size_um, shape == "disc")
    if is_thick.size == 0:
        raise ParameterError("size_um", "must enclose the centre of at least one rhomb", size_um, "µm", "enlarge it")
    return Layout.from_equal_rings(rings_um, {"is_thick": is_thick.astype(np.int64)})


def _side_um(n_sites: int, size_um: float, is_disc: bool) -> float:
    """Return the side of rhombs of which a number covers the region."""
    return size_um * math.sqrt((0.25 * math.pi if is_disc else 1.0) / (n_sites * MEAN_AREA))


def _rhombs(side_um: float, size_um: float, is_disc: bool) -> tuple[Floats, Bools]:
    """Return the corners (n, 4, 2) µm, counter-clockwise, and whether each rhomb is thick."""
    half = 0.5 * size_um / side_um  # all further lengths are in sides
    reach = half * (1.0 if is_disc else math.sqrt(2.0))
    # The triangles have the side 1, scaled by the golden ratio in each subdivision.
    n_cuts = PERIOD * math.ceil(math.log((reach + 2.0) / DECAGON_INRADIUS_RATIO, GOLDEN_RATIO) / PERIOD)
    triangles, is_thick = _decagon()
    for left in range(n_cuts - 1, -1, -1):
        triangles, is_thick = _subdivide(triangles, is_thick)
        # The remaining subdivisions stay inside a triangle, and no triangle has the length 2.
        is_near = np.abs(_points(triangles[:, 0])).max(axis=1) <= half * GOLDEN_RATIO**-left + 2.0
        triangles, is_thick = triangles[is_near], is_thick[is_near]
    a, b, c = np.moveaxis(triangles, 1, 0)
    # Both halves of a rhomb have the same midpoint (b + c) / 2 of their common side.
    _, first = np.unique((b + c) @ KEY, return_index=True)
    a, b, c, is_thick = a[first], b[first], c[first], is_thick[first]
    corners = np.stack([_points(p) for p in (a, b, b + c - a, c)], axis=1)
    centre = 0.5 * _points(b + c)
    inside = np.hypot(*centre.T) <= half if is_disc else np.abs(centre).max(axis=1) <= half
    u, v = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    is_clockwise = u[:, 0] * v[:, 1] < u[:, 1] * v[:, 0]
    corners[is_clockwise] = corners[is_clockwise, ::-1]
    order = np.lexsort((centre[:, 0], centre[:, 1]))
    order = order[inside[order]]
    return side_um * corners[order], is_thick[order]


def _points(integers: Ints) -> Floats:
    """Convert corners from integers (n, 4) to sides (n, 2), with a fixed summation order."""
    x, y = (
        integers[:, 0] * rotation[0]
        + integers[:, 1] * rotation[1]
        + (integers[:, 2] * rotation[2] + integers[:, 3] * rotation[3])
        for rotation in FIFTH_ROTATIONS
    )
    return np.stack((x, y), axis=1)


def _decagon() -> tuple[Ints, Bools]:
    """Return ten acute triangles (10, 3, 4) around the axis, halves of thin rhombs."""
    fifths = np.concatenate((np.eye(4, dtype=np.int64), -np.ones((1, 4), np.int64)))
    # A rotation by 36° is the negative of a rotation by 216°. Every second triangle is mirrored.
    tips = np.stack([fifths[(3 * k) % 5] * (-1) ** k for k in range(11)])
    k = np.arange(10)
    odd = k % 2
    triangles = np.stack((np.zeros((10, 4), np.int64), tips[k + odd], tips[k + 1 - odd]), axis=1)
    return triangles, np.zeros(10, bool)


def _subdivide(triangles: Ints, is_thick: Bools) -> tuple[Ints, Bools]:
    """Subdivide Robinson triangles and scale them by the golden ratio, so that sides remain 1."""
    a, b, c = np.moveaxis(triangles[~is_thick], 1, 0)
    ga, gb, gc = a @ TIMES_GOLDEN, b @ TIMES_GOLDEN, c @ TIMES_GOLDEN
    p = ga + b - a
    thin, thick = [np.stack((gc, p, gb), axis=1)], [np.stack((p, gc, ga), axis=1)]
    a, b, c = np.moveaxis(triangles[is_thick], 1, 0)
    ga, gb, gc = a @ TIMES_GOLDEN, b @ TIMES_GOLDEN, c @ TIMES_GOLDEN
    q, r = gb + a - b, gb + c - b
    thin.append(np.stack((r, q, ga), axis=1))
    thick += [np.stack((r, gc, ga), axis=1), np.stack((q, r, gb), axis=1)]
    n_thin = sum(t.shape[0] for t in thin)
    cut = np.concatenate((*thin, *thick))
    return cut, np.arange(cut.shape[0]) >= n_thin

"""Sunflower layout: sites of equal size on a golden spiral, without rows and rings."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np

from foveasim._core.calls import LENGTH
from foveasim._core.validation import Floats, Ints, check_count, check_length_um
from foveasim.layout._regions import disc
from foveasim.layout.diagrams.voronoi import voronoi_cells
from foveasim.layout.generator_registry import SITES, layout_generator
from foveasim.layout.model import Layout, layout_of

__all__ = ["sunflower"]

#: Angle between consecutive sites: 360° / φ² = 137.5°, with the golden ratio φ.
GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))
#: Radius of site 1 for which the closest pair, sites 1 and 4, has the distance 1: 0.6242.
SPIRAL_FACTOR = 1.0 / math.sqrt(5.0 - 4.0 * math.cos(3.0 * GOLDEN_ANGLE_RAD))
#: Minimum number of chords of the default outline.
MIN_CHORDS = 64


@layout_generator(has_mosaic=False, example={"n_sites": 300, "spacing_um": 1.6})
def sunflower(
    n_sites: Annotated[int, SITES], spacing_um: Annotated[float, LENGTH], *, n_chords: int | None = None
) -> Layout:
    """
    Generate Voronoi cells of approximately equal area on a golden spiral.

    ::

              ·  ·  ·            site k = 1, 2, ... n_sites at the radius c √k · spacing_um, c = 0.6242,
            ·  · 4·  ·           137.5 degrees from site k - 1
           ·  ·  ╲ · ·
            ·  ·  1  ·           spacing_um: from site 1 to site 4, the closest pair
              ·  ·  ·

    Parameters
    ----------
    n_sites : int
        Number of sites.
    spacing_um : float, µm
        Minimum distance between centres, for 4 or more sites; other distances are slightly larger.
    n_chords : int, optional
        Number of sides of the regular polygon that approximates the circular outline of the layout; by default 4 times the
        minimum number that encloses the outermost centre.

    Returns
    -------
    Layout
        From the centre outwards, with the column ``turn`` (completed turns of the spiral before the site). ``provenance``
        contains ``radius_um``, the circumradius of the outline: ``c √(n_sites + 1/2) · spacing_um``.

    Raises
    ------
    ParameterError
        When a number is out of range, or chords would cut through centres.

    Notes
    -----
    Vogel's model of a sunflower head. The mean area per site is ``π c² spacing_um²``, 1.2242 squared spacings.

    Examples
    --------
    >>> sunflower(n_sites=500, spacing_um=2.0).n_sites
    500
    """
    k = np.arange(1, n_sites + 1)
    radius_um = check_length_um(
        "radius_um", SPIRAL_FACTOR * spacing_um * math.sqrt(n_sites + 0.5), hint="take fewer sites"
    )
    # The outermost centre must lie inside the chords.
    min_chords = max(3, math.floor(math.pi / math.acos(math.sqrt(n_sites / (n_sites + 0.5)))) + 1)
    if n_chords is None:
        n_sides = max(MIN_CHORDS, 4 * min_chords)
    else:
        n_sides = check_count("n_chords", n_chords, at_least=min_chords, at_most=10**6)
    xy_um, offsets = voronoi_cells(_spiral_um(k, spacing_um), disc(radius_um, n_sides))
    turn = np.floor(k * (GOLDEN_ANGLE_RAD / (2.0 * math.pi))).astype(np.int64)
    return layout_of(xy_um, offsets, None, {"turn": turn}, {"radius_um": radius_um})


def _spiral_um(k: Ints, spacing_um: float) -> Floats:
    r_um, angle_rad = SPIRAL_FACTOR * spacing_um * np.sqrt(k), GOLDEN_ANGLE_RAD * k
    return np.stack((r_um * np.cos(angle_rad), r_um * np.sin(angle_rad)), axis=1)

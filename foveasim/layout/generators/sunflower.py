"""The sunflower layout: sites of one size in a golden spiral, without rows and without rings."""

from __future__ import annotations

import math

import numpy as np

from foveasim._core.validation import Floats, Ints, check_count, check_length_um, check_sites
from foveasim.layout._regions import disc
from foveasim.layout._voronoi import cells_of
from foveasim.layout.families import layout_family
from foveasim.layout.model import Layout

__all__ = ["sunflower"]

#: From each site to the next: a whole turn over the square of the golden ratio, 137.5 degrees.
GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))
#: Radius of site 1 that puts the closest pair, sites 1 and 4, at distance 1: 0.6242.
C = 1.0 / math.sqrt(5.0 - 4.0 * math.cos(3.0 * GOLDEN_ANGLE_RAD))
#: Fewest chords of the outline by default.
MIN_CHORDS = 64


@layout_family(example={"n_sites": 300, "spacing_um": 1.6})
def sunflower(*, n_sites: int, spacing_um: float, n_chords: int | None = None) -> Layout:
    """
    Sites on a golden spiral, each taking the same fraction of the disc, their outlines the Voronoi cells.

    ::

              ·  ·  ·            site k = 1, 2, ... n_sites at the radius c √k · spacing_um, c = 0.6242,
            ·  · 4·  ·           137.5 degrees on from site k - 1
           ·  ·  ╲ · ·
            ·  ·  1  ·           spacing_um: from site 1 to site 4, the closest pair of any
              ·  ·  ·

    Parameters
    ----------
    n_sites : int
        Number of sites.
    spacing_um : float, µm
        Distance of the closest two centres, when there are 4 sites or more; the others are a little further apart.
    n_chords : int, optional
        Sides of the regular polygon that stands for the outline of the layout; by default 4 times as many as
        leave the outermost centre inside.

    Returns
    -------
    Layout
        From the middle outwards, with the column ``turn`` (whole turns of the spiral before the site). ``provenance``
        tells ``radius_um``, that of the outline's corners: ``c √(n_sites + 1/2) · spacing_um``.

    Raises
    ------
    ParameterError
        When a number is out of range, or chords would cut through centres.

    Notes
    -----
    Vogel's model of a sunflower's head. A site's share is ``π c² spacing_um²``, 1.2242 spacings squared.

    Examples
    --------
    >>> sunflower(n_sites=500, spacing_um=2.0).n_sites
    500
    """
    n_sites = check_sites(check_count("n_sites", n_sites))
    spacing_um = check_length_um("spacing_um", spacing_um)
    k = np.arange(1, n_sites + 1)
    radius_um = check_length_um("radius_um", C * spacing_um * math.sqrt(n_sites + 0.5), hint="take fewer sites")
    # The outermost centre must stay inside the chords.
    fewest = max(3, math.floor(math.pi / math.acos(math.sqrt(n_sites / (n_sites + 0.5)))) + 1)
    if n_chords is None:
        n_sides = max(MIN_CHORDS, 4 * fewest)
    else:
        n_sides = check_count("n_chords", n_chords, at_least=fewest, at_most=10**6)
    xy_um, offsets = cells_of(_spiral_um(k, spacing_um), disc(radius_um, n_sides))
    return Layout(
        xy_um,
        offsets,
        np.arange(offsets.size),
        {"turn": np.floor(k * (GOLDEN_ANGLE_RAD / (2.0 * math.pi))).astype(np.int64)},
        {
            "radius_um": radius_um,
        },
    )


def _spiral_um(k: Ints, spacing_um: float) -> Floats:
    r_um, angle_rad = C * spacing_um * np.sqrt(k), GOLDEN_ANGLE_RAD * k
    return np.stack((r_um * np.cos(angle_rad), r_um * np.sin(angle_rad)), axis=1)

"""The log-polar layout: rings whose sites grow with their distance from the axis."""

from __future__ import annotations

import math
import warnings
from typing import Any, Literal, get_args

import numpy as np

from foveasim._core.rings import ring_moments
from foveasim._core.validation import (
    MAX_SITES,
    Floats,
    Ints,
    check_choice,
    check_count,
    check_length_um,
    check_number,
    check_sites,
)
from foveasim.errors import LayoutWarning, ParameterError
from foveasim.layout.families import layout_family
from foveasim.layout.generators._annuli import MIN_SITES_PER_RHO, Annuli, Fovea, Ring, annuli, fovea_rings
from foveasim.layout.generators.tiling import with_hexagons
from foveasim.layout.model import Layout, valid_sites

__all__ = ["log_polar", "square_ring_ratio"]

#: Sites that each ring of the fovea has more than the one inside it: their arcs are π/3 times as wide as they are high.
SITES_PER_RHO = 6
#: Rings thinner than this fraction of their radius are rounding.
RATIO_ROUNDING = 1e-12
#: A coordinate at the radius r is rounded by up to this times r (angle, cosine and product), and a side by twice that.
COORDINATE_ROUNDING = 4.0 * np.finfo(np.float64).eps
#: Rings that end inside this fraction of ``r_max_um`` leave a fifth of the field's area open, which needs a warning.
MIN_REACH = 0.9


def square_ring_ratio(n_sectors: int) -> float:
    """
    Ratio of a ring's outer to its inner radius that makes its sites as high as they are wide.

    Notes
    -----
    Height ``r_c * 2 (q - 1) / (q + 1)`` equal to the chord ``2 r_c sin(π / n)`` on the centre line gives
    ``q = (1 + sin(π / n)) / (1 - sin(π / n))``.
    """
    s = math.sin(math.pi / check_count("n_sectors", n_sectors, at_least=3))
    return (1.0 + s) / (1.0 - s)


@layout_family(example={"n_sectors": 36, "min_size_um": 1.0, "r_max_um": 18.0, "fovea": "hexagons"})
def log_polar(
    *,
    n_sectors: int,
    r_max_um: float,
    min_size_um: float | None = None,
    r_min_um: float | None = None,
    n_rings: int | None = None,
    ring_ratio: float | None = None,
    fovea: Fovea = "none",
    stagger: bool = False,
    chords_per_arc: int = 1,
) -> Layout:
    """
    Rings of ``n_sectors`` sites around the optical axis, each ring ``ring_ratio`` times as large as the one inside.

    ::

                     ╭──────┬──────╮  r_max_um
                   ╱  ╭─────┼────╮   ╲
                  │ ╱   ╭───┼──╮   ╲  │       ring k: r_k to r_k · ring_ratio
                  ├─┼───┤ fovea├───┼──┤
                  │ ╲   ╰───┼──╯   ╱  │       site: one of n_sectors parts of a ring,
                   ╲  ╰─────┼────╯   ╱              its arcs cut into chords_per_arc chords
                     ╰──────┴──────╯
                       ├─┤ r_min_um

    Parameters
    ----------
    n_sectors : int
        Sites a ring, at least 3.
    r_max_um : float, µm
        No ring reaches further out. Rings grow by their ratio and end where one more would cross this radius: with
        ``n_rings`` exactly here, otherwise inside.
    min_size_um : float, optional, µm
        Smallest pixel that can be made. No site is smaller as the design rule ``min_size_um`` measures it, by the square
        root of its area between chords; and no ring is thinner, and no arc on a ring's centre line shorter. Rings whose
        sites would be smaller are left out: that is the **blind spot**. Where sites are squarish, its radius on the first
        ring's centre line is ``min_size / (2 sin(π / n_sectors))`` with two chords an arc or more, and tends to
        ``min_size * n_sectors / 2π`` for many sectors. A site is narrower than its size at its inner arc, which the rule
        ``min_width_um`` measures.
    r_min_um : float, optional, µm
        Inner radius of the first ring; by default the smallest that ``min_size_um`` allows.
    n_rings : int, optional
        Number of rings between ``r_min_um`` and ``r_max_um``, instead of ``ring_ratio``.
    ring_ratio : float, optional
        Outer to inner radius of a ring; :func:`square_ring_ratio` by default.
    fovea : {"none", "rings", "linear", "hexagons"}
        What fills the middle: nothing; ``λ / (λ - 1)`` rings of equal heights (λ the ring ratio), the height that a next
        ring inside would have, fewer where a site would be below ``min_size_um``. Ring 0 is one site, ring ρ holds 6ρ sites
        (``"rings"``) or is linear-polar, cut by those of the spokes that leave its sites as wide as high (``"linear"``).
        ``"hexagons"`` are of ``min_size_um`` (without it, of the first ring's size), pieces at the border joined to others.
    stagger : bool
        Turn every second ring outside the fovea by half a sector.
    chords_per_arc : int
        Straight edges that stand for an arc. The area is that of the arcs times ``sin(d)/d``, with d the angle of one
        chord. Where ``stagger`` would set odd numbers of chords against each other, arcs get twice as many, so that
        neighbours always share their corners and nothing is left open or covered twice.

    Returns
    -------
    Layout
        Ring by ring from the inside, with the columns ``ring`` (hexagons are ring 0), ``sector``, ``readout_line`` (the
        spoke in which the site begins, of a hexagon that of its middle). ``provenance`` tells ``blind_radius_um``, the inner
        radius of the first ring as generated, where the middle is left open.

    Raises
    ------
    ParameterError
        When a number is out of range, no ring fits, or a fovea inside a given ``r_min_um`` has no site of the minimum size.

    Warns
    -----
    LayoutWarning
        When the rings end inside nine tenths of ``r_max_um``, as those of a coarse ratio may.
    """
    n_sectors = check_count("n_sectors", n_sectors, at_least=3, at_most=MAX_SITES)
    check_choice("fovea", fovea, get_args(Fovea))
    chords_per_arc = check_count("chords_per_arc", chords_per_arc, at_most=1000)
    r_max_um = check_length_um("r_max_um", r_max_um)
    for name, length_um in (("min_size_um", min_size_um), ("r_min_um", r_min_um)):
        if length_um is not None:
            check_length_um(name, length_um, at_most=r_max_um, hint="it is no larger than 'r_max_um'")
    if r_min_um is None and min_size_um is None:
        raise ParameterError("r_min_um", "or 'min_size_um' must be given: without either the rings would never end")
    if n_rings is not None:
        n_rings = check_count("n_rings", n_rings, at_most=max(1, MAX_SITES // n_sectors))
        if ring_ratio is not None or r_min_um is None or not r_min_um < r_max_um:
            raise ParameterError("n_rings", "takes 'r_min_um' below 'r_max_um', and no 'ring_ratio'", n_rings)
        ratio = (r_max_um / r_min_um) ** (1.0 / n_rings)
        if ratio <= 1.0 + RATIO_ROUNDING:
            raise ParameterError("r_min_um", f"must leave {n_rings} rings some width below 'r_max_um'", r_min_um, "µm")
    elif ring_ratio is not None:
        ratio = check_number("ring_ratio", ring_ratio, above=1.0 + RATIO_ROUNDING)
    else:
        ratio = square_ring_ratio(n_sectors)

    n_chords = chords_per_arc * (2 if stagger and chords_per_arc % 2 else 1)
    smallest_um = 0.0
    if min_size_um is not None:
        smallest_um = min_size_um * _radius_per_size(n_sectors, ratio, n_chords, fovea, is_given=r_min_um is not None)
    radii_um = _ring_radii_um(n_sectors, ratio, r_min_um, r_max_um, smallest_um, n_rings)
    rings = [Ring(n_sectors, int(stagger and i % 2 == 1), n_chords) for i in range(radii_um.size - 1)]
    if fovea in {"rings", "linear"}:
        sites, n_sites = _with_fovea(
            "rings" if fovea == "rings" else "linear", radii_um, rings, ratio, min_size_um or 0.0, chords_per_arc
        )
    else:
        sites, n_sites = annuli(radii_um, rings), np.full(len(rings), n_sectors)
    provenance: dict[str, Any] = {}
    if fovea == "none":
        provenance["blind_radius_um"] = float(radii_um[0])
    layout = Layout(
        sites.xy_um,
        sites.ring_offsets,
        np.arange(sites.ring_offsets.size),
        {"ring": sites.ring, "sector": sites.sector, "readout_line": sites.sector * n_sectors // n_sites[sites.ring]},
        provenance,
    )
    if fovea == "hexagons":
        size_um = math.sqrt(layout.area_um2[:n_sectors].min()) if min_size_um is None else min_size_um
        return with_hexagons(layout, size_um, n_sectors)
    return layout


def _with_fovea(
    filling: Literal["rings", "linear"],
    radii_um: Floats,
    rings: list[Ring],
    ratio: float,
    min_size_um: float,
    n_chords: int,
) -> tuple[Annuli, Ints]:
    """Rings with a fovea of as many rings as leave no site below the minimum size, and the number of sites of each ring."""
    n_sectors = rings[0].n_sites
    n_rings = max(1, min(round(ratio / (ratio - 1.0) + 0.5), n_sectors // MIN_SITES_PER_RHO))
    for n in range(n_rings, 0, -1):
        heights, inside = fovea_rings(
            filling, n_rings=n, n_sectors=n_sectors, n_per_ring=SITES_PER_RHO, n_chords=n_chords
        )
        inside_um = heights * (radii_um[0] / heights[-1])
        # The fovea gives corners to the ring around it, which take some of its area, or all where chords are coarse.
        if _are_sites(annuli(np.concatenate((inside_um, radii_um[1:2])), [*inside, rings[0]]), min_size_um):
            all_rings = [*inside, *rings]
            n_sites = np.array([ring.n_sites for ring in all_rings])
            check_sites(int(n_sites.sum()))
            return annuli(np.concatenate((inside_um, radii_um[1:])), all_rings), n_sites
    raise ParameterError(
        "fovea", f"leaves no room for a site of {min_size_um:g} µm inside the first ring", filling,
        hint="enlarge 'r_min_um', or leave it out",
    )  # fmt: skip


def _are_sites(sites: Annuli, min_size_um: float) -> bool:
    """Whether all outlines are simple and none is below the minimum size, not by a rounding error that rules allow either."""
    area_um2, _ = ring_moments(sites.xy_um, sites.ring_offsets)
    if area_um2.min() <= 0.0 or math.sqrt(area_um2.min()) < min_size_um:
        return False
    layout = Layout(sites.xy_um, sites.ring_offsets, np.arange(sites.ring_offsets.size))
    return bool(valid_sites(layout).all())


def _radius_per_size(n_sectors: int, ratio: float, n_chords: int, fovea: Fovea, *, is_given: bool) -> float:
    """
    Smallest inner radius of a ring whose sites are not below a minimum size, over that size.

    With the inner radius 1, a ring is ``ratio - 1`` high, its arc on the centre line ``π (1 + ratio) / n_sectors`` long, and
    the triangles between the axis and the chords of a sector have the areas ``triangles`` and ``ratio² triangles``.
    """
    sector_rad = 2.0 * math.pi / n_sectors
    triangles = 0.5 * n_chords * math.sin(sector_rad / n_chords)
    area = triangles * (ratio**2 - 1.0)
    if fovea == "rings":
        # The fovea's corners on the inner circle may take what lies between its chords and its arc. Where that is most
        # of the site, the fovea must have fewer corners instead.
        least = triangles * ratio**2 - 0.5 * sector_rad
        area = least if least > 0.5 * area else area
    needs = [1.0 / math.sqrt(area), 1.0 / (ratio - 1.0), 2.0 / (sector_rad * (1.0 + ratio))]
    if fovea != "none" and not is_given:
        needs.append(1.0 / math.sqrt(n_sectors * triangles))  # the disc is one site at least
    # A site is the larger by this that the rounding of its corners takes from its sides.
    return max(needs) * (1.0 + COORDINATE_ROUNDING * (n_sectors + ratio / (ratio - 1.0)))


def _ring_radii_um(
    n_sectors: int,
    ratio: float,
    r_min_um: float | None,
    r_max_um: float,
    smallest_um: float,
    n_rings: int | None,
) -> Floats:
    """Radii of the circles between the rings that are kept, (n_ring + 1,), none of which begins inside ``smallest_um``."""
    first_um = smallest_um if r_min_um is None else r_min_um
    rounding = 1.0 + 1e-12
    n = math.log(r_max_um * rounding / first_um) / math.log(ratio) if first_um < r_max_um else 0.0
    if (n + 1) * n_sectors > MAX_SITES:
        raise ParameterError(
            "ring_ratio", f"gives more than {MAX_SITES} sites", ratio, hint="take a larger ratio or r_min_um"
        )
    radii_um = first_um * np.power(ratio, np.arange((int(n) if n_rings is None else n_rings) + 1))
    radii_um = radii_um[radii_um >= smallest_um]
    if radii_um.size < 2:
        raise ParameterError(
            "r_max_um",
            f"leaves no room for a ring: the first would reach from {max(first_um, smallest_um):g} to "
            f"{max(first_um, smallest_um) * ratio:g} µm",
            r_max_um,
            "µm",
            "enlarge it, or take fewer sectors or a smaller minimum size",
        )
    if radii_um[-1] < MIN_REACH * r_max_um:
        last_um, next_um = float(radii_um[-1]), float(radii_um[-1]) * ratio
        warnings.warn(
            f"'r_max_um' is {r_max_um:g} µm, and the rings end at {last_um:.6g} µm: the next one, {ratio:.6g} times as large, "
            f"would reach {next_um:.6g} µm; take 'r_max_um' = {next_um * (1.0 + 1e-5):.6g} µm, or 'n_rings' with 'r_min_um' = "
            f"{radii_um[0]:.6g} µm, which end at 'r_max_um'",
            LayoutWarning,
            stacklevel=3,
        )
    return radii_um

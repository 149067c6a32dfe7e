"""Log-polar layout: rings whose sites grow with the distance from the axis."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from foveasim._core.calls import LENGTH, Limits
from foveasim._core.rings import ring_area_um2
from foveasim._core.validation import MAX_SITES, Floats, Ints, check_count, check_length_um, check_sites
from foveasim.errors import LayoutWarning, ParameterError, warn
from foveasim.layout.generator_registry import layout_generator
from foveasim.layout.generators._annuli import CHORDS, MIN_SITES_PER_RHO, Annuli, Fovea, Ring, annuli, fovea_rings
from foveasim.layout.generators.tiling import with_hexagons
from foveasim.layout.model import Layout, layout_of, valid_sites
from foveasim.layout.sizes.site_counts import SolveFor

__all__ = ["log_polar", "square_ring_ratio"]

#: Increment of sites per ring of the fovea: the arcs of the sites are π/3 times as long as the ring is high.
SITES_PER_RHO = 6
#: Minimum height of a ring relative to its radius in float64.
RATIO_ROUNDING = 1e-12
#: Rounding error of a coordinate, relative to the radius (angle, cosine and product); that of a side is twice as large.
COORDINATE_ROUNDING = 4.0 * np.finfo(np.float64).eps
SECTORS = Limits(at_least=3, at_most=MAX_SITES)
#: Fraction of ``r_max_um`` below which the outermost ring leaves a fifth of the field uncovered, which causes a warning.
MIN_REACH = 0.9


def square_ring_ratio(n_sectors: Annotated[int, SECTORS]) -> float:
    """
    Compute the ratio of outer to inner ring radius for sites as high as wide.

    Notes
    -----
    Height ``r_c * 2 (q - 1) / (q + 1)`` equal to the chord ``2 r_c sin(π / n)`` on the centre line gives
    ``q = (1 + sin(π / n)) / (1 - sin(π / n))``.

    Examples
    --------
    >>> import foveasim as fs
    >>> round(fs.layout.square_ring_ratio(96), 5)
    1.06765
    """
    s = math.sin(math.pi / n_sectors)
    return (1.0 + s) / (1.0 - s)


def _count_sites(parameters: Mapping[str, Any]) -> float | None:
    """Return the number of sites of :func:`log_polar`; None where it requires a layout."""
    p = parameters
    if p["fovea"] not in {"none", "rings", "linear"}:
        return None
    n_sectors, n_chords = p["n_sectors"], p["chords_per_arc"] * (2 if p["stagger"] and p["chords_per_arc"] % 2 else 1)
    limits = {name: p[name] for name in ("r_max_um", "min_size_um", "r_min_um", "n_rings", "ring_ratio", "fovea")}
    radii_um, ratio = _rings(n_sectors, n_chords=n_chords, **limits)
    if p["fovea"] == "none":
        return float(n_sectors * (radii_um.size - 1))
    filling: Literal["rings", "linear"] = "rings" if p["fovea"] == "rings" else "linear"
    around = [Ring(n_sectors, 0, n_chords)]
    _, per_ring = _with_fovea(filling, radii_um[:2], around, ratio, p["min_size_um"] or 0.0, p["chords_per_arc"])
    return float(per_ring.sum() + n_sectors * (radii_um.size - 2))


@layout_generator(
    example={"n_sectors": 36, "min_size_um": 1.0, "r_max_um": 18.0, "fovea": "hexagons"},
    solve_for=(
        SolveFor(
            name="n_sectors",
            guess=lambda n_sites, _: math.sqrt(math.pi * n_sites),
            count=_count_sites,
            at_least=3,
        ),
        SolveFor(
            name="min_size_um",
            is_integer=False,
            is_increasing=False,
            guess=lambda n_sites, parameters: 0.2 * parameters["r_max_um"] / math.sqrt(n_sites),
            count=_count_sites,
            needs=("n_sectors",),
            is_optional=True,
        ),
    ),
)
def log_polar(
    n_sectors: Annotated[int | None, SECTORS] = None,
    *,
    r_max_um: Annotated[float, LENGTH],
    min_size_um: float | None = None,
    r_min_um: float | None = None,
    n_rings: int | None = None,
    ring_ratio: Annotated[float | None, Limits(above=1.0 + RATIO_ROUNDING)] = None,
    fovea: Fovea = "none",
    stagger: bool = False,
    chords_per_arc: Annotated[int, CHORDS] = 1,
    n_sites: int | None = None,  # noqa: ARG001 -- resolved by layout_generator
) -> Layout:
    """
    Generate log-polar rings of sites that grow outwards by a constant ratio.

    ::

                     ╭──────┬──────╮  r_max_um
                   ╱  ╭─────┼────╮   ╲
                  │ ╱   ╭───┼──╮   ╲  │       ring k: r_k to r_k · ring_ratio
                  ├─┼───┤ fovea├───┼──┤
                  │ ╲   ╰───┼──╯   ╱  │       site: one of n_sectors parts of a ring,
                   ╲  ╰─────┼────╯   ╱              arcs divided into chords_per_arc chords
                     ╰──────┴──────╯
                       ├─┤ r_min_um

    Parameters
    ----------
    n_sectors : int
        Number of sites per ring, at least 3.
    r_max_um : float, µm
        Upper limit of the outer radius. Rings grow by their ratio as long as they fit: the outermost ring ends exactly at
        this radius with ``n_rings``, otherwise inside it.
    min_size_um : float, optional, µm
        Minimum site size that can be manufactured. It limits the size of all sites as the design rule ``min_size_um``
        measures it, the square root of the area between chords, and also the height of rings and the arc length on their
        centre line. Rings with smaller sites are omitted, which results in the **blind spot**. With approximately square
        sites, its radius on the centre line of the first ring is ``min_size / (2 sin(π / n_sectors))`` for two or more
        chords per arc, and tends to ``min_size * n_sectors / 2π`` for many sectors. The width at the inner arc is smaller
        than the size; the rule ``min_width_um`` measures it.
    r_min_um : float, optional, µm
        Inner radius of the first ring; by default the smallest that satisfies ``min_size_um``.
    n_rings : int, optional
        Number of rings between ``r_min_um`` and ``r_max_um``, instead of ``ring_ratio``.
    ring_ratio : float, optional
        Ratio of the outer to the inner radius of a ring; :func:`square_ring_ratio` by default.
    fovea : {"none", "rings", "linear", "hexagons"}
        Filling of the centre. ``"none"``: no sites. ``"rings"`` and ``"linear"``: ``λ / (λ - 1)`` rings (λ the ring ratio)
        with the height of the next inner ring, fewer if a site would be below ``min_size_um``. Ring 0 is one site. Ring ρ
        has 6ρ sites (``"rings"``), or is linear-polar with as many of the sector boundaries outside as leave sites
        approximately square (``"linear"``). ``"hexagons"``: hexagons of ``min_size_um`` (without it, of the size in the
        first ring), with pieces at the boundary merged into neighbours.
    stagger : bool
        Rotate every second ring outside the fovea by half a sector.
    chords_per_arc : int
        Number of straight edges that approximate an arc. The area is that of the arcs times ``sin(d)/d``, where d is the
        angle of one chord. With ``stagger`` and an odd number, arcs have twice as many, so that neighbours share their
        corners without gaps or overlaps.
    n_sites : int, optional
        Number of sites, instead of ``n_sectors``, within 1 %; or instead of ``min_size_um``, for a given number of sectors.

    Returns
    -------
    Layout
        Ring by ring from the inside, with the columns ``ring`` (0 for hexagons), ``sector``, ``readout_line`` (the sector in
        which the site begins, or which contains the centre of a hexagon). Without a fovea, ``provenance`` contains
        ``blind_radius_um``, the inner radius of the first ring as generated.

    Raises
    ------
    ParameterError
        When a number is out of range, no ring fits, or no site of the minimum size fits inside a given ``r_min_um``.

    Warns
    -----
    LayoutWarning
        When the outermost ring ends below 0.9 ``r_max_um``, which a large ratio may cause.

    Examples
    --------
    >>> layout = log_polar(n_sites=14_000, min_size_um=2.0, r_max_um=690.0)
    >>> layout.n_sites, layout.provenance["parameters"]["n_sectors"]
    (14060, 190)
    """
    assert n_sectors is not None
    n_chords = chords_per_arc * (2 if stagger and chords_per_arc % 2 else 1)
    radii_um, ratio = _rings(n_sectors, r_max_um, min_size_um, r_min_um, n_rings, ring_ratio, fovea, n_chords)
    _warn_of_reach(radii_um, ratio, r_max_um)
    rings = [Ring(n_sectors, int(stagger and i % 2 == 1), n_chords) for i in range(radii_um.size - 1)]
    if fovea in {"rings", "linear"}:
        sites, per_ring = _with_fovea(
            "rings" if fovea == "rings" else "linear", radii_um, rings, ratio, min_size_um or 0.0, chords_per_arc
        )
    else:
        sites, per_ring = annuli(radii_um, rings), np.full(len(rings), n_sectors)
    line = sites.sector * n_sectors // per_ring[sites.ring]
    columns = {"ring": sites.ring, "sector": sites.sector, "readout_line": line}
    provenance = {"blind_radius_um": float(radii_um[0])} if fovea == "none" else {}
    layout = layout_of(sites.xy_um, sites.ring_offsets, None, columns, provenance)
    if fovea == "hexagons":
        size_um = math.sqrt(layout.area_um2[:n_sectors].min()) if min_size_um is None else min_size_um
        return with_hexagons(layout, size_um, n_sectors)
    return layout


class _Rings(NamedTuple):
    """Radii (n_ring + 1,) of the circles between rings, and the ratio of adjacent ones."""

    radii_um: Floats
    ratio: float


def _rings(
    n_sectors: int,
    r_max_um: float,
    min_size_um: float | None,
    r_min_um: float | None,
    n_rings: int | None,
    ring_ratio: float | None,
    fovea: Fovea,
    n_chords: int,
) -> _Rings:
    """Return the rings of :func:`log_polar`, for a final number of chords per arc."""
    for name, length_um in (("min_size_um", min_size_um), ("r_min_um", r_min_um)):
        if length_um is not None:
            check_length_um(name, length_um, at_most=r_max_um, hint="the upper limit is 'r_max_um'")
    if r_min_um is None and min_size_um is None:
        raise ParameterError("r_min_um", "or 'min_size_um' must be given, to limit the number of rings")
    if n_rings is not None:
        n_rings = check_count("n_rings", n_rings, at_most=max(1, MAX_SITES // n_sectors))
        if ring_ratio is not None or r_min_um is None or not r_min_um < r_max_um:
            raise ParameterError(
                "n_rings", "must be used with 'r_min_um' below 'r_max_um' and without 'ring_ratio'", n_rings
            )
        ratio = (r_max_um / r_min_um) ** (1.0 / n_rings)
        if ratio <= 1.0 + RATIO_ROUNDING:
            raise ParameterError(
                "r_min_um", f"must leave {n_rings} rings a positive width below 'r_max_um'", r_min_um, "µm"
            )
    else:
        ratio = square_ring_ratio(n_sectors) if ring_ratio is None else ring_ratio

    smallest_um = 0.0
    if min_size_um is not None:
        smallest_um = min_size_um * _radius_per_size(n_sectors, ratio, n_chords, fovea, is_given=r_min_um is not None)
    return _Rings(_ring_radii_um(n_sectors, ratio, r_min_um, r_max_um, smallest_um, n_rings), ratio)


def _with_fovea(
    filling: Literal["rings", "linear"],
    radii_um: Floats,
    rings: list[Ring],
    ratio: float,
    min_size_um: float,
    n_chords: int,
) -> tuple[Annuli, Ints]:
    """Return rings with the largest possible fovea, and the number of sites of each ring."""
    n_sectors = rings[0].n_sites
    n_rings = max(1, min(round(ratio / (ratio - 1.0) + 0.5), n_sectors // MIN_SITES_PER_RHO))
    for n in range(n_rings, 0, -1):
        heights, inside = fovea_rings(
            filling, n_rings=n, n_sectors=n_sectors, n_per_ring=SITES_PER_RHO, n_chords=n_chords
        )
        inside_um = heights * (radii_um[0] / heights[-1])
        # Corners of the fovea on the surrounding ring reduce its area, to zero or less if chords are coarse.
        if _are_valid_sites(annuli(np.concatenate((inside_um, radii_um[1:2])), [*inside, rings[0]]), min_size_um):
            all_rings = [*inside, *rings]
            n_sites = np.array([ring.n_sites for ring in all_rings])
            check_sites(int(n_sites.sum()))
            return annuli(np.concatenate((inside_um, radii_um[1:])), all_rings), n_sites
    raise ParameterError(
        "fovea", f"must fit a site of {min_size_um:g} µm inside the first ring", filling,
        hint="enlarge or omit 'r_min_um'",
    )  # fmt: skip


def _are_valid_sites(sites: Annuli, min_size_um: float) -> bool:
    """Return whether all outlines are simple and none is below the minimum size."""
    area_um2 = ring_area_um2(sites.xy_um, sites.ring_offsets)
    if area_um2.min() <= 0.0 or math.sqrt(area_um2.min()) < min_size_um:
        return False
    return bool(valid_sites(layout_of(sites.xy_um, sites.ring_offsets)).all())


def _radius_per_size(n_sectors: int, ratio: float, n_chords: int, fovea: Fovea, *, is_given: bool) -> float:
    """
    Return the ratio of the smallest valid inner ring radius to the minimum size.

    With the inner radius 1, a ring has the height ``ratio - 1`` and the arc length ``π (1 + ratio) / n_sectors`` on the
    centre line. The triangles between the axis and the chords of a sector have the areas ``triangles`` and
    ``ratio² triangles``.
    """
    sector_rad = 2.0 * math.pi / n_sectors
    triangles = 0.5 * n_chords * math.sin(sector_rad / n_chords)
    area = triangles * (ratio**2 - 1.0)
    if fovea == "rings":
        # Corners of the fovea on the inner circle may remove the area between its chords and its arc from the site. Where
        # that is most of the site, the fovea must have fewer corners instead.
        min_area = triangles * ratio**2 - 0.5 * sector_rad
        area = min_area if min_area > 0.5 * area else area
    radii_per_size = [1.0 / math.sqrt(area), 1.0 / (ratio - 1.0), 2.0 / (sector_rad * (1.0 + ratio))]
    if fovea != "none" and not is_given:
        radii_per_size.append(1.0 / math.sqrt(n_sectors * triangles))  # the disc contains at least one site
    # Margin for the rounding of the corners.
    return max(radii_per_size) * (1.0 + COORDINATE_ROUNDING * (n_sectors + ratio / (ratio - 1.0)))


def _ring_radii_um(
    n_sectors: int,
    ratio: float,
    r_min_um: float | None,
    r_max_um: float,
    smallest_um: float,
    n_rings: int | None,
) -> Floats:
    """Return the radii (n_ring + 1,) of the circles between rings, none below ``smallest_um``."""
    first_um = smallest_um if r_min_um is None else r_min_um
    rounding = 1.0 + 1e-12
    n = math.log(r_max_um * rounding / first_um) / math.log(ratio) if first_um < r_max_um else 0.0
    if (n + 1) * n_sectors > MAX_SITES:
        raise ParameterError(
            "ring_ratio", f"must give at most {MAX_SITES} sites", ratio, hint="take a larger ratio or 'r_min_um'"
        )
    radii_um = first_um * np.power(ratio, np.arange((int(n) if n_rings is None else n_rings) + 1))
    radii_um = radii_um[radii_um >= smallest_um]
    if radii_um.size < 2:
        raise ParameterError(
            "r_max_um",
            f"must leave room for a ring: the first would extend from {max(first_um, smallest_um):g} to "
            f"{max(first_um, smallest_um) * ratio:g} µm",
            r_max_um,
            "µm",
            "enlarge it, or take fewer sectors or a smaller minimum size",
        )
    return radii_um


def _warn_of_reach(radii_um: Floats, ratio: float, r_max_um: float) -> None:
    """Warn when the outermost ring leaves a large part of the field uncovered."""
    if radii_um[-1] < MIN_REACH * r_max_um:
        last_um, next_um = float(radii_um[-1]), float(radii_um[-1]) * ratio
        warn(
            f"'r_max_um' is {r_max_um:g} µm, but the outermost ring ends at {last_um:.6g} µm: the next one, {ratio:.6g} times "
            f"as large, would extend to {next_um:.6g} µm; take 'r_max_um' = {next_um * (1.0 + 1e-5):.6g} µm, or 'n_rings' with "
            f"'r_min_um' = {radii_um[0]:.6g} µm for rings that end at 'r_max_um'",
            LayoutWarning,
        )

"""
Log-polar layout by the Giotto rule: a fovea of unit rings, then growing rings.

The total diameter determines the ratio λ of the heights of adjacent rings. With ``E = n_rho - n_fovea`` rings outside the
fovea and a diameter of R smallest pixels, ``λ (λ^E - 1) / (λ - 1) = R / 2 - n_fovea + 0.5``: the heights of the rings are
``λ, λ², ... λ^E``, and the boundary of the fovea has the radius ``n_fovea - 0.5``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np

from foveasim._core.calls import Limits
from foveasim._core.validation import MAX_LENGTH_UM, MAX_SITES, check_count, check_length_um, check_sites
from foveasim.errors import ParameterError
from foveasim.layout.generator_registry import COUNT, layout_generator
from foveasim.layout.generators._annuli import CHORDS, MIN_SITES_PER_RHO, Fovea, Ring, annuli, fovea_rings
from foveasim.layout.generators.tiling import with_hexagons
from foveasim.layout.model import Layout, layout_of
from foveasim.layout.sizes.site_counts import SolveFor

__all__ = ["giotto", "giotto_ratio"]

RINGS, ACROSS = Limits(at_least=2, at_most=MAX_SITES), Limits(at_least=1, at_most=2**53)
#: Absolute tolerance of log λ; the ratio itself then has fifteen significant digits.
LOG_RATIO_ROUNDING = 1e-16


def giotto_ratio(
    *, n_rho: Annotated[int, RINGS], n_fovea: Annotated[int, COUNT], n_across: Annotated[int, ACROSS]
) -> float:
    """
    Compute the ratio λ of the heights of adjacent rings outside the fovea.

    Parameters
    ----------
    n_rho, n_fovea, n_across : int
        As for :func:`giotto`.

    Raises
    ------
    ParameterError
        When a number is out of range, or the diameter is so small that rings would shrink outwards.

    Examples
    --------
    >>> round(giotto_ratio(n_rho=152, n_fovea=42, n_across=1090), 11)
    1.02314422609
    """
    return math.exp(_log_ratio(n_rho, n_fovea, n_across))


def _count_sites(parameters: Mapping[str, Any]) -> float | None:
    """Return the number of sites of :func:`giotto`; None where it requires a layout."""
    n_rho, n_theta, n_fovea = (parameters[name] for name in ("n_rho", "n_theta", "n_fovea"))
    fovea = parameters["fovea"]
    if fovea not in {"rings", "linear", "none"}:
        return None
    inside: list[Ring] = []
    if fovea != "none":
        _, inside = fovea_rings(fovea, n_rings=n_fovea, n_sectors=n_theta, n_per_ring=n_theta // n_fovea, n_chords=1)
    return float((n_rho - n_fovea) * n_theta + sum(ring.n_sites for ring in inside))


@layout_generator(
    example={"n_rho": 16, "n_theta": 36, "n_fovea": 6, "n_across": 60, "unit_um": 0.6},
    solve_for=(
        SolveFor(
            name="n_theta",
            guess=lambda n_sites, parameters: n_sites / parameters["n_rho"],
            count=_count_sites,
            at_least=3,
        ),
    ),
)
def giotto(
    *,
    n_rho: Annotated[int, RINGS],
    n_fovea: Annotated[int, COUNT],
    n_across: Annotated[int, ACROSS],
    unit_um: float,
    n_theta: Annotated[int | None, Limits(at_least=3, at_most=MAX_SITES)] = None,
    fovea: Fovea = "rings",
    stagger: bool = True,
    chords_per_arc: Annotated[int, CHORDS] = 1,
    n_sites: int | None = None,  # noqa: ARG001 -- resolved by layout_generator
) -> Layout:
    """
    Generate a fovea of rings of equal height, then rings that grow by a constant ratio.

    ::

              ╭─────────┬─────────╮       ring n_rho - 1: n_theta sites, λ^(n_rho - n_fovea) units high
            ╱   ╭───┬───┴───┬───╮   ╲     ...
           │  ╱   ╭─┴─┬───┬─┴─╮   ╲  │    ring n_fovea: n_theta sites, λ units high
           │ │   │ ╭──┴─┬─┴──╮ │   │ │    ring ρ of the fovea: (n_theta // n_fovea) · ρ sites, one unit high
           ├─┼───┼─┤    o    ├─┼───┼─┤    ring 0: one site with a radius of half a unit
           │ │   │ ╰──┬─┴─┬──╯ │   │ │
           │  ╲   ╰─┬─┴───┴─┬─╯   ╱  │
            ╲   ╰───┴───┬───┴───╯   ╱
              ╰─────────┴─────────╯
           ├──────── n_across ───────┤    units of unit_um, the smallest pixel

    Parameters
    ----------
    n_rho : int
        Number of rings, including ring 0.
    n_fovea : int
        Number of rings of the fovea, whose radius is ``n_fovea - 0.5``.
    n_across : int
        Diameter of the layout in smallest pixels, more than ``2 n_rho - 1``.
    unit_um : float, µm
        Size of the smallest pixel: the height of the rings of the fovea.
    n_theta : int
        Number of sites per ring outside the fovea; at least 3 per ring of the fovea.
    fovea : {"rings", "linear", "hexagons", "none"}
        Filling of the fovea. ``"rings"``: rings of (n_theta // n_fovea) · ρ sites. ``"linear"``: rings with some of the
        sector boundaries outside, and sites at least one unit wide if n_theta has suitable divisors. ``"hexagons"``: hexagons
        with an area of one square unit, larger at the boundary. ``"none"``: no sites, a blind spot.
    stagger : bool
        Rotate every second ring outside the fovea by half a sector, π / n_theta.
    chords_per_arc : int
        Number of straight edges that approximate an arc. With ``stagger`` and an odd number, arcs outside the fovea have
        twice as many. In the fovea, arcs include the corners of the neighbours on the other side, so there are no gaps or
        overlaps.
    n_sites : int, optional
        Number of sites, instead of ``n_theta``, within 1 %.

    Returns
    -------
    Layout
        Ring by ring from the inside, with the columns ``ring`` (ρ, from ``n_fovea`` without a fovea), ``sector`` and
        ``readout_line`` (the one of ``n_theta`` sectors in which the site begins, or which contains the centre of a hexagon).
        Hexagons have the ring ``n_fovea - 1``. ``provenance`` contains ``ring_ratio``, λ, and without a fovea
        ``blind_radius_um``.

    Raises
    ------
    ParameterError
        When a number is out of range, or the rule results in rings that do not grow.

    Notes
    -----
    The n sites of ring ρ of the fovea, ``n = (n_theta // n_fovea) ρ``, have the width ``2π ρ / n`` units on the centre line:
    1.05 units for n = 6 ρ. The inner radius of ring ρ outside the fovea is ``A + B λ^(ρ - n_fovea)`` with
    ``B = λ / (λ - 1)`` and ``A = n_fovea - B - 0.5``.

    Examples
    --------
    Giotto 2, 5,167 sites in the fovea and 27,720 around it:

    >>> layout = giotto(n_rho=152, n_theta=252, n_fovea=42, n_across=1090, unit_um=6.45)
    >>> layout.n_sites, int((layout.columns["ring"] < 42).sum())
    (32887, 5167)
    """
    log_ratio = _log_ratio(n_rho, n_fovea, n_across)
    assert n_theta is not None
    unit_um = check_length_um("unit_um", unit_um, at_most=2.0 * MAX_LENGTH_UM / n_across)
    has_rings = fovea in {"rings", "linear"}
    if has_rings and n_theta < MIN_SITES_PER_RHO * n_fovea:
        raise ParameterError(
            "n_theta",
            f"must be >= {MIN_SITES_PER_RHO * n_fovea}, three times 'n_fovea'",
            n_theta,
            hint="or take fovea='none'",
        )
    n_rings = n_rho - n_fovea
    n_per_rho = n_theta // n_fovea
    check_sites(n_rings * n_theta + (n_per_rho * n_fovea * (n_fovea - 1) // 2 + 1 if has_rings else 0))

    n_chords = chords_per_arc * (2 if stagger and chords_per_arc % 2 else 1)
    rings = [Ring(n_theta, int(stagger and i % 2 == 1), n_chords) for i in range(n_rings)]
    growth = math.exp(log_ratio) / math.expm1(log_ratio)
    radii = n_fovea - 0.5 + growth * np.expm1(log_ratio * np.arange(n_rings + 1))
    if has_rings:
        inner, fillers = fovea_rings(
            "rings" if fovea == "rings" else "linear",
            n_rings=n_fovea,
            n_sectors=n_theta,
            n_per_ring=n_per_rho,
            n_chords=chords_per_arc,
        )
        radii, rings = np.concatenate((inner[:-1], radii)), fillers + rings
    first = n_rho - len(rings)

    xy_um, offsets, ring, sector = annuli(radii * unit_um, rings)
    per_ring = np.array([r.n_sites for r in rings])
    provenance = {"ring_ratio": math.exp(log_ratio)}
    if not has_rings:
        provenance["blind_radius_um"] = float(radii[0] * unit_um)
    columns = {"ring": first + ring, "sector": sector, "readout_line": sector * n_theta // per_ring[ring]}
    layout = layout_of(xy_um, offsets, None, columns, provenance)
    return with_hexagons(layout, unit_um, n_theta) if fovea == "hexagons" else layout


def _log_ratio(n_rho: int, n_fovea: int, n_across: int) -> float:
    from scipy.optimize import brentq

    n_fovea = check_count(
        "n_fovea",
        n_fovea,
        at_most=n_rho - 1,
        hint="'n_rho' includes the rings of the fovea and at least one around them",
    )
    if n_across < 2 * n_rho:
        raise ParameterError(
            "n_across",
            f"must be > {2 * n_rho - 1}, the diameter of {n_rho} rings of unit height",
            n_across,
            hint="take a larger diameter, or fewer rings",
        )
    n_rings = n_rho - n_fovea
    width = 0.5 * n_across - n_fovea + 0.5

    def excess(x: float) -> float:
        """Return the total ring height minus the required one, for the logarithm x of the ratio."""
        heights = math.exp(x) * math.expm1(n_rings * x) / math.expm1(x) if x > 0.0 else float(n_rings)
        return heights - width

    # Upper bracket: the last ring is no higher than all rings together.
    largest = math.log(width) / n_rings * (1.0 + 1e-9)
    return float(brentq(excess, 0.0, largest, xtol=LOG_RATIO_ROUNDING, rtol=4 * np.finfo(np.float64).eps))

"""
The log-polar layout by the Giotto rule: a fovea of rings of unit height, and around it rings that grow.

The rule fixes how much a ring is larger than the one inside it by the whole diameter: with ``E = n_rho - n_fovea`` rings
outside the fovea and R smallest pixels across, ``λ (λ^E - 1) / (λ - 1) = R / 2 - n_fovea + 0.5``, since the rings' heights
are ``λ, λ², ... λ^E`` and the fovea's edge lies at ``n_fovea - 0.5``.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from foveasim.arrays import (
    MAX_LENGTH_UM,
    MAX_SITES,
    Floats,
    Ints,
    check_choice,
    check_count,
    check_length_um,
    check_sites,
)
from foveasim.errors import ParameterError
from foveasim.layout._model import Layout

__all__ = ["giotto", "giotto_ratio", "ring_outlines"]

#: log λ is solved to this; the ratio itself then has fifteen digits.
LOG_RATIO_ROUNDING = 1e-16


class _Ring(NamedTuple):
    """A ring's sites, the half sectors that it is turned by, and the chords that each of its arcs is cut into."""

    n_sites: int
    turn: int
    n_chords: int


class _Circle(NamedTuple):
    """Points of a circle, counter-clockwise, and where they lie on it in ``n_steps`` steps of a whole turn."""

    xy_um: Floats
    step: Ints
    n_steps: int


def giotto_ratio(*, n_rho: int, n_fovea: int, n_across: int) -> float:
    """
    Ratio λ of the heights of neighbouring rings outside the fovea.

    Parameters
    ----------
    n_rho, n_fovea, n_across : int
        As for :func:`giotto`.

    Raises
    ------
    ParameterError
        When a number is out of range, or so few pixels across that rings would shrink outwards.

    Examples
    --------
    >>> round(giotto_ratio(n_rho=152, n_fovea=42, n_across=1090), 11)
    1.02314422609
    """
    return math.exp(_log_ratio(n_rho, n_fovea, n_across))


def giotto(
    *,
    n_rho: int,
    n_theta: int,
    n_fovea: int,
    n_across: int,
    unit_um: float,
    fovea: Literal["rings", "none"] = "rings",
    stagger: bool = True,
    chords_per_arc: int = 1,
) -> Layout:
    """
    Rings around the optical axis: ``n_fovea`` of one unit's height, then rings each λ times as high as the one inside.

    ::

              ╭─────────┬─────────╮       ring n_rho - 1: n_theta sites, λ^(n_rho - n_fovea) units high
            ╱   ╭───┬───┴───┬───╮   ╲     ...
           │  ╱   ╭─┴─┬───┬─┴─╮   ╲  │    ring n_fovea: n_theta sites, λ units high
           │ │   │ ╭──┴─┬─┴──╮ │   │ │    ring ρ of the fovea: (n_theta // n_fovea) · ρ sites, one unit high
           ├─┼───┼─┤    o    ├─┼───┼─┤    ring 0: one site, of half a unit's radius
           │ │   │ ╰──┬─┴─┬──╯ │   │ │
           │  ╲   ╰─┬─┴───┴─┬─╯   ╱  │
            ╲   ╰───┴───┬───┴───╯   ╱
              ╰─────────┴─────────╯
           ├──────── n_across ───────┤    units of unit_um, the smallest pixel

    Parameters
    ----------
    n_rho : int
        All rings, ring 0 included.
    n_theta : int
        Sites of a ring outside the fovea; at least 3 for each of the fovea's rings.
    n_fovea : int
        Rings of the fovea, which reaches to the radius ``n_fovea - 0.5``.
    n_across : int
        Diameter of the whole in smallest pixels, more than ``2 n_rho - 1``.
    unit_um : float, µm
        The smallest pixel: the height of the fovea's rings.
    fovea : {"rings", "none"}
        Whether the fovea is filled, or left open as the blind spot.
    stagger : bool
        Turn every second ring outside the fovea by half a sector, π / n_theta.
    chords_per_arc : int
        Straight edges that stand for an arc. Where ``stagger`` would set odd numbers of chords against each other, arcs
        outside the fovea get twice as many. In the fovea an arc has also the corners of the neighbours across it, so
        that nothing is left open or covered twice.

    Returns
    -------
    Layout
        Ring by ring from the inside, with the columns ``ring`` (ρ, which begins at ``n_fovea`` without a fovea),
        ``sector`` and ``readout_line`` (the one of ``n_theta`` spokes in which the site begins). ``provenance`` tells
        ``ring_ratio``, λ, and without a fovea ``blind_radius_um``.

    Raises
    ------
    ParameterError
        When a number is out of range, or the rule has no rings that grow.

    Notes
    -----
    A site of the fovea is ``2π / (n_theta // n_fovea)`` units wide on its centre line: 1.05 units when there are six for
    each ring. The edge of ring ρ outside the fovea lies at ``A + B λ^(ρ - n_fovea)`` with ``B = λ / (λ - 1)`` and
    ``A = n_fovea - B - 0.5``.

    Examples
    --------
    Giotto 2, 5,167 sites in the fovea and 27,720 around it:

    >>> layout = giotto(n_rho=152, n_theta=252, n_fovea=42, n_across=1090, unit_um=6.45)
    >>> layout.n_sites, int((layout.columns["ring"] < 42).sum())
    (32887, 5167)
    """
    log_ratio = _log_ratio(n_rho, n_fovea, n_across)
    n_rho, n_fovea, n_across = int(n_rho), int(n_fovea), int(n_across)
    n_theta = check_count("n_theta", n_theta, at_least=3, at_most=MAX_SITES)
    unit_um = check_length_um("unit_um", unit_um, at_most=2.0 * MAX_LENGTH_UM / n_across)
    check_choice("fovea", fovea, ("rings", "none"))
    chords_per_arc = check_count("chords_per_arc", chords_per_arc, at_most=1000)
    if fovea == "rings" and n_theta < 3 * n_fovea:
        raise ParameterError(
            "n_theta", f"must be >= {3 * n_fovea}, three times 'n_fovea'", n_theta, cure="or take fovea='none'"
        )
    n_rings = n_rho - n_fovea
    n_per_rho = n_theta // n_fovea if fovea == "rings" else 0
    check_sites(n_rings * n_theta + n_per_rho * n_fovea * (n_fovea - 1) // 2 + (fovea == "rings"))

    n_chords = chords_per_arc * (2 if stagger and chords_per_arc % 2 else 1)
    rings = [_Ring(n_theta, int(stagger and i % 2 == 1), n_chords) for i in range(n_rings)]
    growth = math.exp(log_ratio) / math.expm1(log_ratio)
    radii = n_fovea - 0.5 + growth * np.expm1(log_ratio * np.arange(n_rings + 1))
    if fovea == "rings":
        rings = [_Ring(max(1, n_per_rho * rho), 0, chords_per_arc) for rho in range(n_fovea)] + rings
        radii = np.concatenate((np.arange(n_fovea) - 0.5, radii))
    first = n_rho - len(rings)

    outlines, n_vertices = [], []
    inner = None if fovea == "rings" else _circle(radii[0] * unit_um, rings[:1])
    for i, ring in enumerate(rings):
        outer = _circle(radii[i + 1] * unit_um, rings[i : i + 2])
        if inner is None:  # the one site in the middle has no corners of its own
            outlines.append(outer.xy_um)
            n_vertices.append(np.array([len(outer.xy_um)]))
        else:
            xy_um, counts = ring_outlines(outer.xy_um, *_ends(outer, ring), inner.xy_um, *_ends(inner, ring))
            outlines.append(xy_um)
            n_vertices.append(counts)
        inner = outer

    counts = np.array([ring.n_sites for ring in rings])
    ring_of = np.repeat(np.arange(len(rings)), counts)
    sector = np.arange(ring_of.size) - (np.cumsum(counts) - counts)[ring_of]
    all_n_vertices = np.concatenate(n_vertices)
    provenance = {
        "generator": "giotto",
        "parameters": {
            "n_rho": n_rho,
            "n_theta": n_theta,
            "n_fovea": n_fovea,
            "n_across": n_across,
            "unit_um": unit_um,
            "fovea": fovea,
            "stagger": stagger,
            "chords_per_arc": chords_per_arc,
        },
        "ring_ratio": math.exp(log_ratio),
    }
    if fovea == "none":
        provenance["blind_radius_um"] = float(radii[0] * unit_um)
    return Layout(
        np.concatenate(outlines),
        np.concatenate(([0], np.cumsum(all_n_vertices))),
        np.arange(all_n_vertices.size + 1),
        {"ring": first + ring_of, "sector": sector, "readout_line": sector * n_theta // counts[ring_of]},
        provenance,
    )


def ring_outlines(
    outer_um: Floats, outer_first: Ints, outer_last: Ints, inner_um: Floats, inner_first: Ints, inner_last: Ints
) -> tuple[Floats, Ints]:
    """
    Outlines of the sites of a ring between two closed loops of points, each loop counter-clockwise and shared.

    Parameters
    ----------
    outer_um, inner_um : (n_point, 2) float64, µm
        The loops.
    outer_first, outer_last, inner_first, inner_last : (n_site,) int64
        Each site's corners on them, as positions that run on beyond a loop's end; a site has the points between its
        corners as well, and so its neighbours' corners.

    Returns
    -------
    xy_um : (n_vertex, 2) float64, µm
        Site after site: its part of the outer loop, then its part of the inner loop backwards.
    n_vertices : (n_site,) int64
        How many vertices each has.
    """
    n_outer = outer_last - outer_first + 1
    n_vertices = n_outer + inner_last - inner_first + 1
    site = np.repeat(np.arange(n_vertices.size), n_vertices)
    place = np.arange(site.size) - (np.cumsum(n_vertices) - n_vertices)[site]
    is_inner = place >= n_outer[site]
    point = np.where(
        is_inner,
        len(outer_um) + (inner_last[site] - place + n_outer[site]) % len(inner_um),
        (outer_first[site] + place) % len(outer_um),
    )
    return np.concatenate((outer_um, inner_um))[point], n_vertices


# -- circles that two rings share -----------------------------------------------------------------------------------


def _log_ratio(n_rho: int, n_fovea: int, n_across: int) -> float:
    from scipy.optimize import brentq

    n_rho = check_count("n_rho", n_rho, at_least=2, at_most=MAX_SITES)
    n_fovea = check_count(
        "n_fovea", n_fovea, at_most=n_rho - 1, cure="'n_rho' counts the fovea's rings and at least one around them"
    )
    n_across = check_count("n_across", n_across, at_most=2**53)
    if n_across < 2 * n_rho:
        raise ParameterError(
            "n_across",
            f"must be > {2 * n_rho - 1}, the diameter of {n_rho} rings that do not grow",
            n_across,
            cure="take more, or fewer rings",
        )
    n_rings = n_rho - n_fovea
    width = 0.5 * n_across - n_fovea + 0.5

    def excess(x: float) -> float:
        """Summed heights of the rings, less the width that they have, at the logarithm x of the ratio."""
        heights = math.exp(x) * math.expm1(n_rings * x) / math.expm1(x) if x > 0.0 else float(n_rings)
        return heights - width

    # The last ring alone is no higher than all of them together.
    largest = math.log(width) / n_rings * (1.0 + 1e-9)
    return float(brentq(excess, 0.0, largest, xtol=LOG_RATIO_ROUNDING, rtol=4 * np.finfo(np.float64).eps))


def _circle(radius_um: float, rings: list[_Ring]) -> _Circle:
    """Circle with the corners and chords of the rings on both of its sides; those that coincide are one point."""
    meeting = [ring for ring in rings if ring.n_sites > 1]
    n_steps = math.lcm(*(2 * ring.n_sites * ring.n_chords for ring in meeting))
    steps = []
    for n_sites, turn, n_chords in meeting:
        half_chords = 2 * np.arange(n_sites * n_chords) + turn * n_chords
        steps.append(half_chords * (n_steps // (2 * n_sites * n_chords)) % n_steps)
    step = np.unique(np.concatenate(steps))
    angle_rad = (2.0 * math.pi) * (step / n_steps)
    return _Circle(radius_um * np.stack((np.cos(angle_rad), np.sin(angle_rad)), axis=1), step, n_steps)


def _ends(circle: _Circle, ring: _Ring) -> tuple[Ints, Ints]:
    """Positions of the first and last corner of each site of a ring on a circle."""
    half_sectors = 2 * np.arange(ring.n_sites + 1) + ring.turn
    turns, corner = np.divmod(half_sectors * (circle.n_steps // (2 * ring.n_sites)), circle.n_steps)
    position = np.searchsorted(circle.step, corner) + turns * circle.step.size
    return position[:-1], position[1:]

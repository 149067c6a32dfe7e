"""Concentric rings of sites with common vertices on arcs, for the log-polar families."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from foveasim._core.calls import Limits
from foveasim._core.validation import Floats, Ints, read_only

#: Chords per arc.
CHORDS = Limits(at_least=1, at_most=1000)
#: Minimum number of sites of a ring of the fovea, per unit of its radius.
MIN_SITES_PER_RHO = 3
#: Number of circles that are cached: those between rings of equal sectors are of at most two kinds, in alternation.
MAX_CIRCLES = 4
#: Filling of the centre: none, rings with sites in proportion to the radius, linear-polar rings of the same sectors, hexagons.
Fovea: TypeAlias = Literal["none", "rings", "linear", "hexagons"]


class Ring(NamedTuple):
    """Number of sites of a ring, rotation in half sectors, and number of chords per arc."""

    n_sites: int
    rotation: int
    n_chords: int


class Annuli(NamedTuple):
    """Packed outlines of all sites from the innermost ring, with ring and sector indices."""

    xy_um: Floats
    ring_offsets: Ints
    ring: Ints
    sector: Ints


class _Circle(NamedTuple):
    """Points of a circle, counter-clockwise, and their angles in steps of 360° / ``n_steps``."""

    xy_um: Floats
    step: Ints
    n_steps: int


def annuli(radii_um: Floats, rings: Sequence[Ring]) -> Annuli:
    """
    Return the sites of concentric rings.

    ``radii_um`` (n_ring + 1,) float64, µm: increasing radii of the circles between the rings; the first may be 0 for one site
    or for sectors at the centre. ``rings``: only the innermost ring may have a single site. Each arc has the corners
    of the sites on both of its sides, so there are no gaps or overlaps.
    """
    outlines, n_vertices = [], []
    has_disc = rings[0].n_sites == 1
    inner = _circle(float(radii_um[0]), rings[:1])
    for i, ring in enumerate(rings):
        outer = _circle(float(radii_um[i + 1]), rings[i : i + 2])
        if i == 0 and has_disc:
            outlines.append(outer.xy_um)
            n_vertices.append(np.array([len(outer.xy_um)]))
        else:
            xy_um, counts = ring_outlines(
                outer.xy_um, *_corner_positions(outer, ring), inner.xy_um, *_corner_positions(inner, ring)
            )
            outlines.append(xy_um)
            n_vertices.append(counts)
        inner = outer
    n_sites = np.array([ring.n_sites for ring in rings])
    ring_of = np.repeat(np.arange(len(rings)), n_sites)
    sector = np.arange(ring_of.size) - (np.cumsum(n_sites) - n_sites)[ring_of]
    offsets = np.concatenate(([0], np.cumsum(np.concatenate(n_vertices))))
    return Annuli(np.concatenate(outlines), offsets, ring_of, sector)


def fovea_rings(
    filling: Literal["rings", "linear"], *, n_rings: int, n_sectors: int, n_per_ring: int, n_chords: int
) -> tuple[Floats, list[Ring]]:
    """
    Return circles and rings that fill a disc.

    Ring 0 is one site with a radius of half a unit; all other rings have a height of one unit.

    ``filling`` ({"rings", "linear"}): ``"rings"``: ring ρ has ``n_per_ring · ρ`` sites. ``"linear"``: linear-polar, with
    sector boundaries of the outer rings; ring ρ has as many sectors as possible with an arc of at least one unit on the centre
    line. ``n_rings``, ``n_sectors``, ``n_per_ring``, ``n_chords``: number of rings in the fovea, sites per ring outside it,
    increment of sites per ring, chords per arc. Returns ``radii`` (n_rings + 1,) float64: 0, 1/2, 3/2, ... in units of the
    ring height.
    """
    radii = np.concatenate(([0.0], np.arange(n_rings) + 0.5))
    if filling == "rings":
        counts = n_per_ring * np.arange(n_rings)
    else:
        divisors = np.array([d for d in range(1, n_sectors + 1) if n_sectors % d == 0])
        rho = np.arange(n_rings)
        position = np.searchsorted(divisors, 2.0 * math.pi * rho, side="right") - 1
        # With fewer than 3ρ corners, the inner circle of a ring would cross its outer one.
        position = np.where(divisors[position] < MIN_SITES_PER_RHO * rho, position + 1, position)
        counts = divisors[np.minimum(position, divisors.size - 1)]
    counts[0] = 1
    return radii, [Ring(int(n), 0, n_chords) for n in counts]


def ring_outlines(
    outer_um: Floats, outer_first: Ints, outer_last: Ints, inner_um: Floats, inner_first: Ints, inner_last: Ints
) -> tuple[Floats, Ints]:
    """
    Return the outlines of the sites of a ring between two closed loops of points.

    ``outer_um``, ``inner_um`` (n_point, 2) float64, µm: the loops, counter-clockwise, shared with the adjacent rings.
    ``outer_first``, ``outer_last``, ``inner_first``, ``inner_last`` (n_site,) int64: positions of the corners of each site on
    the loops, unwrapped beyond the end of a loop. A site includes the points between its corners, and therefore the corners of
    its neighbours. Returns ``xy_um`` (n_vertex, 2) float64, µm: site after site: its part of the outer loop, then its part of
    the inner loop in reverse. ``n_vertices`` (n_site,) int64: number of vertices of each site.
    """
    n_outer = outer_last - outer_first + 1
    n_vertices = n_outer + inner_last - inner_first + 1
    site = np.repeat(np.arange(n_vertices.size), n_vertices)
    position = np.arange(site.size) - (np.cumsum(n_vertices) - n_vertices)[site]
    is_inner = position >= n_outer[site]
    point = np.where(
        is_inner,
        len(outer_um) + (inner_last[site] - position + n_outer[site]) % len(inner_um),
        (outer_first[site] + position) % len(outer_um),
    )
    return np.concatenate((outer_um, inner_um))[point], n_vertices


def _circle(radius_um: float, rings: Sequence[Ring]) -> _Circle:
    """Return a circle with the distinct corners and chord ends of the rings on both sides."""
    adjacent = [ring for ring in rings if ring.n_sites > 1]
    if radius_um <= 0.0 or not adjacent:
        return _Circle(np.zeros((1, 2)), np.zeros(1, np.int64), 1)
    unit, step, n_steps = _unit_circle(tuple(adjacent))
    return _Circle(radius_um * unit, step, n_steps)


@lru_cache(maxsize=MAX_CIRCLES)
def _unit_circle(adjacent: tuple[Ring, ...]) -> _Circle:
    """Return the points of a circle of radius 1, the same for many circles of a layout."""
    n_steps = math.lcm(*(2 * ring.n_sites * ring.n_chords for ring in adjacent))
    steps = []
    for n_sites, rotation, n_chords in adjacent:
        half_chords = 2 * np.arange(n_sites * n_chords) + rotation * n_chords
        steps.append(half_chords * (n_steps // (2 * n_sites * n_chords)) % n_steps)
    step = np.unique(np.concatenate(steps))
    angle_rad = (2.0 * math.pi) * (step / n_steps)
    return _Circle(np.stack((np.cos(angle_rad), np.sin(angle_rad)), axis=1), read_only(step), n_steps)


def _corner_positions(circle: _Circle, ring: Ring) -> tuple[Ints, Ints]:
    """Return the positions of the first and last corner of each site of a ring on a circle."""
    if circle.n_steps == 1:  # the axis
        zeros = np.zeros(ring.n_sites, np.int64)
        return zeros, zeros
    half_sectors = 2 * np.arange(ring.n_sites + 1) + ring.rotation
    revolutions, corner = np.divmod(half_sectors * (circle.n_steps // (2 * ring.n_sites)), circle.n_steps)
    position = np.searchsorted(circle.step, corner) + revolutions * circle.step.size
    return position[:-1], position[1:]

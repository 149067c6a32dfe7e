"""Concentric rings of sites with common vertices on arcs, for the log-polar families."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from foveasim._core.calls import Limits
from foveasim._core.validation import Floats, Ints, freeze, read_only

#: Chords per arc.
CHORDS = Limits(at_least=1, at_most=1000)
#: Minimum number of sites of a ring of the fovea, per unit of its radius.
MIN_SITES_PER_RHO = 3
#: Number of circles and rings that are cached: those of equal sectors are of at most two kinds, in alternation.
MAX_CACHED = 4
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
    """Points of a unit circle, and their angles in steps of 360° / ``n_steps``."""

    xy: Floats
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
    inner = _adjacent(float(radii_um[0]), rings[:1])
    inner_um = radii_um[0] * _circle(inner).xy
    for i, ring in enumerate(rings):
        outer = _adjacent(float(radii_um[i + 1]), rings[i : i + 2])
        outer_um = radii_um[i + 1] * _circle(outer).xy
        if i == 0 and has_disc:
            outlines.append(outer_um)
            n_vertices.append(np.array([len(outer_um)]))
        else:
            points, counts = _points_of_ring(outer, ring, inner)
            outlines.append(np.concatenate((outer_um, inner_um)).take(points, axis=0))
            n_vertices.append(counts)
        inner, inner_um = outer, outer_um
    n_sites = np.array([ring.n_sites for ring in rings])
    ring_of = np.repeat(np.arange(len(rings)), n_sites)
    sector = np.arange(ring_of.size) - (np.cumsum(n_sites) - n_sites)[ring_of]
    offsets = np.concatenate(([0], np.cumsum(np.concatenate(n_vertices))))
    return Annuli(freeze(np.concatenate(outlines)), freeze(offsets), freeze(ring_of), freeze(sector))


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


def points_of_outlines(
    n_outer: int, outer_first: Ints, outer_last: Ints, n_inner: int, inner_first: Ints, inner_last: Ints
) -> tuple[Ints, Ints]:
    """
    Return the points of the sites of a ring between two closed loops of points.

    ``n_outer``, ``n_inner``: numbers of points of the loops, counter-clockwise, shared with the adjacent rings.
    ``outer_first``, ``outer_last``, ``inner_first``, ``inner_last`` (n_site,) int64: positions of the corners of each site on
    the loops, unwrapped beyond the end of a loop. A site includes the points between its corners, and therefore the corners of
    its neighbours. Returns ``points`` (n_vertex,) int64: site after site, its points of the outer loop, then its points of the
    inner loop in reverse, which are numbered after those of the outer one. ``n_vertices`` (n_site,) int64: number of vertices
    of each site.
    """
    n_of_outer = outer_last - outer_first + 1
    n_vertices = n_of_outer + inner_last - inner_first + 1
    site = np.repeat(np.arange(n_vertices.size), n_vertices)
    position = np.arange(site.size) - (np.cumsum(n_vertices) - n_vertices)[site]
    is_inner = position >= n_of_outer[site]
    points = np.where(
        is_inner,
        n_outer + (inner_last[site] - position + n_of_outer[site]) % n_inner,
        (outer_first[site] + position) % n_outer,
    )
    return points, n_vertices


def _adjacent(radius_um: float, rings: Sequence[Ring]) -> tuple[Ring, ...]:
    """Return the rings with corners on a circle; none on the axis."""
    return tuple(ring for ring in rings if ring.n_sites > 1) if radius_um > 0.0 else ()


@lru_cache(maxsize=MAX_CACHED)
def _circle(adjacent: tuple[Ring, ...]) -> _Circle:
    """Return the distinct corners and chord ends of rings on a unit circle, or the axis."""
    if not adjacent:
        return _Circle(read_only(np.zeros((1, 2))), read_only(np.zeros(1, np.int64)), 1)
    n_steps = math.lcm(*(2 * ring.n_sites * ring.n_chords for ring in adjacent))
    steps = []
    for n_sites, rotation, n_chords in adjacent:
        half_chords = 2 * np.arange(n_sites * n_chords) + rotation * n_chords
        steps.append(half_chords * (n_steps // (2 * n_sites * n_chords)) % n_steps)
    step = np.unique(np.concatenate(steps))
    angle_rad = (2.0 * math.pi) * (step / n_steps)
    return _Circle(read_only(np.stack((np.cos(angle_rad), np.sin(angle_rad)), axis=1)), read_only(step), n_steps)


@lru_cache(maxsize=MAX_CACHED)
def _points_of_ring(outer: tuple[Ring, ...], ring: Ring, inner: tuple[Ring, ...]) -> tuple[Ints, Ints]:
    """Return the points of a ring between two circles, as :func:`points_of_outlines`."""
    circles = _circle(outer), _circle(inner)
    loops = [(circle.step.size, *_corner_positions(circle, ring)) for circle in circles]
    points, n_vertices = points_of_outlines(*loops[0], *loops[1])
    return read_only(points), read_only(n_vertices)


def _corner_positions(circle: _Circle, ring: Ring) -> tuple[Ints, Ints]:
    """Return the positions of the first and last corner of each site of a ring on a circle."""
    if circle.n_steps == 1:  # the axis
        zeros = np.zeros(ring.n_sites, np.int64)
        return zeros, zeros
    half_sectors = 2 * np.arange(ring.n_sites + 1) + ring.rotation
    revolutions, corner = np.divmod(half_sectors * (circle.n_steps // (2 * ring.n_sites)), circle.n_steps)
    position = np.searchsorted(circle.step, corner) + revolutions * circle.step.size
    return position[:-1], position[1:]

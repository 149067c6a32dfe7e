"""Isotropic foveal layout: rings with equal radial and tangential spacing of sites."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np

from foveasim._core.calls import LENGTH, Limits
from foveasim._core.rings import positions_in_runs
from foveasim._core.validation import Floats, Ints, check_count, check_sites
from foveasim.errors import ParameterError
from foveasim.layout._regions import disc
from foveasim.layout.diagrams.voronoi import voronoi_cells
from foveasim.layout.generator_registry import layout_generator
from foveasim.layout.model import Layout, layout_of
from foveasim.layout.sizes.site_counts import SolveFor

__all__ = ["fovi"]

#: Maximum number of rings; MAX_SITES is reached before.
MAX_RINGS = 10_000
#: Chords of the outline per site of the outermost ring.
CHORDS_PER_SITE = 4


def _count_sites(parameters: Mapping[str, Any]) -> float:
    """Return the number of sites for parameters of :func:`fovi`."""
    n_rings, a_um, fov_um = (parameters[name] for name in ("n_rings", "a_um", "fov_um"))
    return float(_sites_per_ring(_radii_um(fov_um, a_um, n_rings)).sum()) if n_rings <= MAX_RINGS else math.inf


def _guess_rings(n_sites: int, parameters: Mapping[str, Any]) -> float:
    """Return the number of rings for spacings that are proportional to the radius."""
    a_um = parameters["a_um"]
    return 1.0 if a_um is None else math.sqrt(n_sites * math.log1p(0.5 * parameters["fov_um"] / a_um) / (2.0 * math.pi))


@layout_generator(
    example={"fov_um": 36.0, "a_um": 3.0, "n_rings": 12},
    solve_for=(
        SolveFor(
            name="n_rings",
            guess=_guess_rings,
            count=_count_sites,
            needs=("a_um",),
        ),
        SolveFor(
            name="a_um",
            is_integer=False,
            guess=lambda _, parameters: 0.1 * parameters["fov_um"],
            count=_count_sites,
            needs=("n_rings",),
        ),
    ),
)
def fovi(
    fov_um: Annotated[float, LENGTH],
    *,
    a_um: Annotated[float | None, LENGTH] = None,
    n_rings: Annotated[int | None, Limits(at_least=1, at_most=MAX_RINGS)] = None,
    n_chords: int | None = None,
    n_sites: int | None = None,  # noqa: ARG001 -- resolved by layout_generator
) -> Layout:
    """
    Generate isotropic rings around a central site, with a spacing that grows outwards.

    ::

               ╱ ─ · ─ ╲              · centre of a site; the outline is its Voronoi cell
             ·  ╱ ─·─ ╲  ·
            │  ·   ·   ·  │           ring i: r_i = e^w_i - a,  w uniform on [ln a, ln(fov/2 + a)]
             ·  ╲ ─·─ ╱  ·            has ceil(2π r_i / dr_i) sites,  dr_i = (r_(i+1) - r_(i-1)) / 2
               ╲ ─ · ─ ╱
            ├─────────────┤
                 fov_um, from centre to centre of the outermost ring

    Parameters
    ----------
    fov_um : float, µm
        Diameter of the outermost ring, through the centres of its sites. The layout ends half a step of w further out.
    a_um : float, µm
        Radius of the fovea: the spacing is uniform far inside it, and proportional to the radius far outside.
    n_rings : int
        Number of rings around the central site.
    n_chords : int, optional
        Number of sides of the regular polygon that approximates the circular outline of the layout; by default 4 for each
        site of the outermost ring.
    n_sites : int, optional
        Number of sites, instead of ``n_rings``, within 1 %; or instead of ``a_um``, for a given number of rings.

    Returns
    -------
    Layout
        Ring by ring from the central site, with the columns ``ring``, ``sector`` (from angle 0), ``readout_line`` (the
        ring). ``provenance`` contains ``radius_um``, the circumradius of the outline.

    Raises
    ------
    ParameterError
        When a number is out of range, there would be too many sites, or chords would cut through centres.
    GeometryError
        When the central sites are too small relative to the field for float64.

    Notes
    -----
    There is no blind spot for any ``a_um > 0``. The spacing at the outermost ring uses the radius of one further ring.

    Examples
    --------
    >>> layout = fovi(fov_um=1000.0, a_um=20.0, n_rings=20)
    >>> layout.n_sites, layout.columns["ring"][:4].tolist()
    (568, [0, 1, 1, 1])
    """
    assert a_um is not None
    assert n_rings is not None
    r_um = _radii_um(fov_um, a_um, n_rings)
    counts = _sites_per_ring(r_um)
    check_sites(int(counts.sum()))
    ring = np.repeat(np.arange(n_rings + 1), counts)
    sector = positions_in_runs(counts)
    angle_rad = 2.0 * math.pi * sector / counts[ring]
    centres_um = r_um[ring][:, np.newaxis] * np.stack((np.cos(angle_rad), np.sin(angle_rad)), axis=1)

    radius_um = a_um * math.expm1(_step(fov_um, a_um, n_rings) * (n_rings + 0.5))
    if n_chords is None:
        n_sides = max(CHORDS_PER_SITE * int(counts[-1]), _min_chords(0.5 * fov_um, radius_um))
    else:
        n_sides = check_count("n_chords", n_chords, at_least=_min_chords(0.5 * fov_um, radius_um), at_most=10**6)
    xy_um, offsets = voronoi_cells(centres_um, disc(radius_um, n_sides))
    columns = {"ring": ring, "sector": sector, "readout_line": ring}
    return layout_of(xy_um, offsets, None, columns, {"radius_um": radius_um})


def _step(fov_um: float, a_um: float, n_rings: int) -> float:
    """Return the difference of w between rings."""
    return math.log1p(0.5 * fov_um / a_um) / n_rings


def _radii_um(fov_um: float, a_um: float, n_rings: int) -> Floats:
    """Return the radii (n_rings + 2,) of the centre, the rings, and one further ring."""
    # e^w - a with w = ln a + i step, without cancellation
    r_um = a_um * np.expm1(_step(fov_um, a_um, n_rings) * np.arange(n_rings + 2))
    r_um[n_rings] = 0.5 * fov_um
    return np.asarray(r_um)


def _sites_per_ring(r_um: Floats) -> Ints:
    """Return the sites per ring; the last radius only defines the spacing before it."""
    spacing_um = 0.5 * (r_um[2:] - r_um[:-2])
    if not (np.diff(r_um) > 0.0).all():
        raise ParameterError("n_rings", "must leave each ring a positive width", r_um.size - 2, hint="take fewer rings")
    return np.concatenate(([1], np.ceil(2.0 * math.pi * r_um[1:-1] / spacing_um).astype(np.int64)))


def _min_chords(inner_um: float, outer_um: float) -> int:
    """Return the minimum number of outer chords that do not cut the inner circle."""
    return max(3, math.floor(math.pi / math.acos(inner_um / outer_um)) + 1)

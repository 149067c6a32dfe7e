"""
Optical flow on photosites of any shape: how well a shift can be known (Cramér–Rao), and an estimator that gets there.

A picture P that moves by (u, v) gives site i the charge ``e_i = ∫ P(x - u) dx`` over its polygon, so ``-de_i/du`` is the
integral of the picture's gradient over the site. That is all that a site can tell of the motion.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.validation import (
    Bools,
    Floats,
    Ints,
    as_numbers,
    check_count,
    check_number,
    finite_array,
    read_only,
)
from foveasim.errors import CoverageWarning, ParameterError
from foveasim.fields import Grid
from foveasim.integrate import Integrator
from foveasim.layout import Layout
from foveasim.metrics.sampling import require_layout

__all__ = ["FlowBound", "FlowEstimate", "estimate_flow", "flow_bound", "site_gradients_e_per_um"]

#: A direction about which there is less than this fraction of the other's information has none.
LEAST_INFORMATION = 1e-12
#: A site of which more than this share lies off the map tells nothing: what was there is not known.
OFF_SHARE = 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class FlowBound:
    """
    The Cramér–Rao bound of the flow in some regions: no unbiased estimator has a smaller covariance.

    Attributes
    ----------
    regions : (n_region,) int64
        Their labels, sorted.
    n_sites : (n_region,) int64
        That tell of it: of an estimate, those that lie wholly on the map.
    information_per_um2 : (n_region, 2, 2) float64, 1/µm²
        Fisher information of (u, v): ``Σ g gᵀ / var``.
    """

    regions: Ints
    n_sites: Ints
    information_per_um2: Floats

    @property
    def covariance_um2(self) -> Floats:
        """Inverse of the information, (n_region, 2, 2) µm²; infinite where one direction is not seen (the aperture problem)."""
        return _inverse(self.information_per_um2)

    @property
    def sigma_um(self) -> Floats:
        """Least standard deviations of u and of v, (n_region, 2) µm; infinite where nothing tells it."""
        left = np.stack([_rest_per_um2(self.information_per_um2, axis) for axis in (0, 1)], axis=1)
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / np.sqrt(left))


@dataclass(frozen=True, eq=False, kw_only=True)
class FlowEstimate:
    """
    The flow in some regions.

    Attributes
    ----------
    regions : (n_region,) int64
        Their labels, sorted.
    flow_um : (n_region, 2) float64, µm
        By how much the picture moved, (u, v); NaN where a direction is not seen.
    bound : FlowBound
        At the estimate.
    misfit : (n_region,) float64
        Mean of the squared residuals over their variances, of the sites on the map: about 1 where the model holds. NaN where
        there are none.
    """

    regions: Ints
    flow_um: Floats
    bound: FlowBound
    misfit: Floats


def site_gradients_e_per_um(
    layout: Layout, map_e_per_um2: ArrayLike, grid: Grid, *, n_threads: int | None = None
) -> Floats:
    """
    Integrals of a map's gradient over the sites: by how much each one's charge falls when the picture moves by a µm.

    Parameters
    ----------
    layout : Layout
    map_e_per_um2 : (n_y, n_x), e-/µm²
        Electrons per area at every place, cell means; smooth over a few cells, as behind a lens.
    grid : Grid
        Where the cells are.
    n_threads : int, optional

    Returns
    -------
    gradient : (n_site, 2) float64, e-/µm
        Along x and y; 0 for sites that lie partly or wholly off the map, which tell nothing.

    Raises
    ------
    ParameterError
        When the map does not fit the grid, or has fewer than 5 rows or columns.

    Warns
    -----
    CoverageWarning
        When sites lie partly or wholly off the map.
    """
    require_layout(layout)
    cells = _checked_map(map_e_per_um2, grid)
    integrator = Integrator(layout, grid, order=2, n_threads=n_threads)
    is_on = _is_on_map(integrator, layout)
    if not is_on.all():
        warnings.warn(
            f"{np.count_nonzero(~is_on):,} of {layout.n_sites:,} photosites lie partly or wholly off the map, and are taken to "
            "tell nothing: take a larger map, or fewer sites",
            CoverageWarning,
            stacklevel=2,
        )
    gradient = np.moveaxis(integrator(_gradients(cells, grid)), 0, -1)
    return np.where(is_on[:, np.newaxis], gradient, 0.0)


def flow_bound(gradient_e_per_um: ArrayLike, variance_e2: ArrayLike, *, regions: ArrayLike | None = None) -> FlowBound:
    """
    Cramér–Rao bound on the flow.

    Parameters
    ----------
    gradient_e_per_um : (n_site, 2), e-/µm
        From :func:`site_gradients_e_per_um`; or in DN/µm, with variances in DN².
    variance_e2 : (n_site,) or number, e-²
        Of each site's noise: the expected charge and the read noise squared, or what :meth:`Camera.predict` tells.
    regions : (n_site,) integers, optional
        Sites of one label move together; those below 0 are left out. All together by default.

    Returns
    -------
    FlowBound

    Raises
    ------
    ParameterError
        When shapes do not fit together, or a variance is not above 0.

    Notes
    -----
    For Gaussian noise of known variance, and for Poisson noise whose variance is the expected charge. That the variance
    itself changes with the charge would tell a little more in the presence of read noise; it is not counted.
    """
    gradient = finite_array("gradient_e_per_um", gradient_e_per_um, ndim=2)
    if gradient.shape[1] != 2:
        raise ParameterError("gradient_e_per_um", f"must have the shape (n_site, 2), got {gradient.shape}")
    variance = _per_site("variance_e2", finite_array("variance_e2", variance_e2, above=0.0), len(gradient))
    return _bound(gradient, variance, _Regions(regions, len(gradient)), np.ones(len(gradient), bool))


def estimate_flow(
    layout: Layout,
    values_e: ArrayLike,
    map_e_per_um2: ArrayLike,
    grid: Grid,
    *,
    variance_e2: ArrayLike,
    regions: ArrayLike | None = None,
    n_steps: int = 10,
    tolerance_um: float = 1e-6,
    n_threads: int | None = None,
) -> FlowEstimate:
    """
    By how much a known picture moved, from sites' values: weighted least squares (Lucas and Kanade), with Gauss–Newton steps.

    Parameters
    ----------
    layout : Layout
    values_e : (n_site,), e-
        What the sites measured after the motion.
    map_e_per_um2 : (n_y, n_x), e-/µm²
        The picture before, cell means: the true one, or one reconstructed from an earlier frame.
    grid : Grid
        Where its cells are.
    variance_e2 : (n_site,) or number, e-²
        Of each site's noise.
    regions : (n_site,) integers, optional
        Sites of one label move together; those below 0 are left out. All together by default.
    n_steps : int
        Steps at most. One is the method of Lucas and Kanade, right for shifts that are small against the picture's detail; with
        more the sites' outlines are carried back by the shift found so far, and what is left of it is found.
    tolerance_um : float, µm
        No further step is taken when the last one was nowhere longer.
    n_threads : int, optional

    Returns
    -------
    FlowEstimate

    Raises
    ------
    ParameterError
        When shapes do not fit together, or a variance is not above 0.

    Notes
    -----
    For Gaussian noise it is the estimate of maximum likelihood, and reaches the bound where noise is small against the
    picture. Steps converge to the nearest minimum: for large shifts begin with a blurred picture. Sites whose outlines,
    carried back, lie partly or wholly off the map are left out: what they should see is not known.
    """
    require_layout(layout)
    cells = _checked_map(map_e_per_um2, grid)
    maps = np.concatenate((cells[np.newaxis], _gradients(cells, grid)))
    values = _per_site("values_e", finite_array("values_e", values_e), layout.n_sites)
    variance = _per_site("variance_e2", finite_array("variance_e2", variance_e2, above=0.0), layout.n_sites)
    n_steps = check_count("n_steps", n_steps)
    tolerance_um = check_number("tolerance_um", tolerance_um, at_least=0.0)
    groups = _Regions(regions, layout.n_sites)
    vertices_of_site = np.diff(layout.ring_offsets[layout.site_offsets])
    flow_um = np.zeros((groups.labels.size, 2))
    for step in range(n_steps + 1):
        # The picture moved by u, seen by a site, is the picture seen by the site moved by -u.
        moved_um = np.repeat(groups.of_sites(flow_um), vertices_of_site, axis=0)
        carried = Layout(layout.xy_um - moved_um, layout.ring_offsets, layout.site_offsets)
        integrator = Integrator(carried, grid, order=2, n_threads=n_threads)
        is_on = _is_on_map(integrator, carried)
        expected, *gradient = integrator(maps)
        slope = np.where(is_on[:, np.newaxis], np.stack(gradient, axis=1), 0.0)
        residual = np.where(is_on, values - expected, 0.0)
        bound = _bound(slope, variance, groups, is_on)
        if step == n_steps:
            break
        score = -groups.sums(slope * (residual / variance)[:, np.newaxis])
        is_seen = np.isfinite(bound.covariance_um2).all(axis=(1, 2))
        change_um = np.zeros_like(flow_um)
        change_um[is_seen] = np.einsum("rij,rj->ri", bound.covariance_um2[is_seen], score[is_seen])
        flow_um += change_um
        if n_steps > 1 and np.abs(change_um).max(initial=0.0) <= tolerance_um:
            break
    flow_um[~np.isfinite(bound.covariance_um2).all(axis=(1, 2))] = np.nan
    misfit = groups.sums((residual**2 / variance)[:, np.newaxis])[:, 0] / np.maximum(bound.n_sites, 1)
    return FlowEstimate(
        regions=bound.regions,
        flow_um=read_only(flow_um),
        bound=bound,
        misfit=read_only(np.where(bound.n_sites > 0, misfit, np.nan)),
    )


class _Regions:
    """Sums over the sites of each region."""

    def __init__(self, regions: ArrayLike | None, n_sites: int) -> None:
        labels = np.zeros(n_sites, np.int64) if regions is None else as_numbers("regions", regions, keep_type=True)
        if labels.shape != (n_sites,) or labels.dtype.kind not in "iu":
            raise ParameterError(
                "regions", f"must be {n_sites} integers, got {labels.dtype} of the shape {labels.shape}"
            )
        self._n_all = n_sites
        self._used = np.flatnonzero(labels >= 0)
        self.labels, self._position = np.unique(labels[self._used].astype(np.int64), return_inverse=True)

    def counts(self, is_counted: Bools) -> Ints:
        """Sites of each region that count, (n_region,)."""
        return np.bincount(self._position[is_counted[self._used]], minlength=self.labels.size).astype(np.int64)

    def sums(self, values: Floats) -> Floats:
        """(n_region, k) of (n_site, k)."""
        columns = [
            np.bincount(self._position, column[self._used], self.labels.size) for column in np.moveaxis(values, 1, 0)
        ]
        return np.stack(columns, axis=1)

    def of_sites(self, values: Floats) -> Floats:
        """(n_site, k) of (n_region, k); 0 for sites that are left out."""
        spread = np.zeros((self._n_all, values.shape[1]))
        spread[self._used] = values[self._position]
        return spread


def _checked_map(map_e_per_um2: ArrayLike, grid: Grid) -> Floats:
    cells = finite_array("map_e_per_um2", map_e_per_um2, ndim=2)
    if not isinstance(grid, Grid) or cells.shape != grid.shape or min(cells.shape) < 5:
        raise ParameterError(
            "map_e_per_um2", f"must have the grid's shape, and at least 5 rows and columns, got {cells.shape}"
        )
    return cells


def _gradients(values: Floats, grid: Grid) -> Floats:
    """Slopes of a map along x and y, (2, n_y, n_x) per µm: differences of fourth order, of second at the borders."""
    pitch_x_um, pitch_y_um = grid.pitch_x_um, grid.pitch_y_um
    slopes = np.stack((np.gradient(values, pitch_x_um, axis=1), np.gradient(values, pitch_y_um, axis=0)))
    for along, out, pitch_um in (
        (values, slopes[0], pitch_x_um),
        (np.moveaxis(values, 0, 1), np.moveaxis(slopes[1], 0, 1), pitch_y_um),
    ):
        near, far = along[:, 3:-1] - along[:, 1:-3], along[:, 4:] - along[:, :-4]
        out[:, 2:-2] = (8.0 * near - far) / (12.0 * pitch_um)
    return slopes


def _is_on_map(integrator: Integrator, layout: Layout) -> Bools:
    """Sites that lie wholly on the map, (n_site,)."""
    return np.asarray(integrator.uncovered_um2 <= OFF_SHARE * layout.area_um2)


def _bound(gradient: Floats, variance_e2: Floats, groups: _Regions, is_counted: Bools) -> FlowBound:
    gx, gy = np.moveaxis(gradient, 1, 0)
    xx, xy, yy = np.moveaxis(
        groups.sums(np.stack((gx * gx, gx * gy, gy * gy), axis=1) / variance_e2[:, np.newaxis]), 1, 0
    )
    information = np.stack((np.stack((xx, xy), axis=1), np.stack((xy, yy), axis=1)), axis=1)
    return FlowBound(
        regions=read_only(groups.labels),
        n_sites=read_only(groups.counts(is_counted)),
        information_per_um2=read_only(information),
    )


def _rest_per_um2(information_per_um2: Floats, axis: int) -> Floats:
    """What is known of u or v when the other is not known either, (n_region,): 0 where nothing is left but rounding."""
    own, other = information_per_um2[:, axis, axis], information_per_um2[:, 1 - axis, 1 - axis]
    shared = information_per_um2[:, 0, 1] ** 2 / np.where(other > 0.0, other, 1.0)
    return np.where(own - shared > LEAST_INFORMATION * own, own - shared, 0.0)


def _inverse(information_per_um2: Floats) -> Floats:
    """Inverses of symmetric matrices (n, 2, 2); infinite where one is singular to float64."""
    xx, xy, yy = (information_per_um2[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    determinant = xx * yy - xy * xy
    is_good = determinant > LEAST_INFORMATION * xx * yy
    adjugate = np.stack((np.stack((yy, -xy), axis=1), np.stack((-xy, xx), axis=1)), axis=1)
    return np.where(
        is_good[:, np.newaxis, np.newaxis],
        adjugate / np.where(is_good, determinant, 1.0)[:, np.newaxis, np.newaxis],
        np.inf,
    )


def _per_site(name: str, values: NDArray[np.float64], n_sites: int) -> Floats:
    if values.shape not in ((), (n_sites,)):
        raise ParameterError(name, f"must be one for each of the {n_sites} sites, got the shape {values.shape}")
    return np.broadcast_to(values, (n_sites,))

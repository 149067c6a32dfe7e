"""
Optical flow on polygonal photosites: Cramér–Rao bound and maximum-likelihood estimator.

An image P displaced by (u, v) gives site i the charge ``e_i = ∫ P(x - u) dx`` over its polygon, so that ``-de_i/du`` is the
integral of the image gradient over the site.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import NOT_NEGATIVE, Limits
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import (
    Bools,
    Floats,
    Ints,
    as_numbers,
    check_per_site,
    finite_array,
    read_only,
)
from foveasim.errors import CoverageWarning, ParameterError, warn
from foveasim.fields import Grid
from foveasim.integrate import Integrator
from foveasim.layout import Layout
from foveasim.sensor.model.linearisation import Linearisation

__all__ = ["FlowBound", "FlowEstimate", "estimate_flow", "flow_bound", "site_gradients_e_per_um"]

#: Relative information below which a direction is unobservable.
MIN_INFORMATION = 1e-12
#: Largest uncovered area fraction of a usable site.
MAX_UNCOVERED_FRACTION = 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class FlowBound:
    """
    Cramér–Rao bound of the flow per region: smallest covariance of an unbiased estimator.

    Attributes
    ----------
    regions : (n_region,) int64
        Labels of the regions, sorted.
    n_sites : (n_region,) int64
        Sites used; for an estimate, those that lie entirely within the map.
    information_per_um2 : (n_region, 2, 2) float64, 1/µm²
        Fisher information of (u, v): ``Σ g gᵀ / var``.
    """

    regions: Ints
    n_sites: Ints
    information_per_um2: Floats

    __repr__ = short_repr

    @property
    def covariance_um2(self) -> Floats:
        """
        Inverse of the information, (n_region, 2, 2) µm².

        It is infinite if a direction is unobservable (the aperture problem).
        """
        return _inverse(self.information_per_um2)

    @property
    def sigma_um(self) -> Floats:
        """Smallest standard deviations of u and v, (n_region, 2) µm; infinite if unobservable."""
        left = np.stack([_marginal_information(self.information_per_um2, axis) for axis in (0, 1)], axis=1)
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / np.sqrt(left))


@dataclass(frozen=True, eq=False, kw_only=True)
class FlowEstimate:
    """
    Estimated flow per region.

    Attributes
    ----------
    regions : (n_region,) int64
        Labels of the regions, sorted.
    flow_um : (n_region, 2) float64, µm
        Displacement (u, v) of the image; NaN if a direction is unobservable.
    bound : FlowBound
        Cramér–Rao bound at the estimate.
    misfit : (n_region,) float64
        Mean of squared residuals over their variances, for the sites within the map: approximately 1 if the model is valid,
        NaN without sites.
    """

    regions: Ints
    flow_um: Floats
    bound: FlowBound
    misfit: Floats

    __repr__ = short_repr


def site_gradients_e_per_um(
    layout: Layout, map_e_per_um2: ArrayLike, grid: Grid, *, n_threads: int | None = None
) -> Floats:
    """
    Integrate the gradient of a map over the sites.

    This is the decrease of the charge of each site per µm of image displacement.

    Parameters
    ----------
    layout : Layout
    map_e_per_um2 : (n_y, n_x), e-/µm²
        Electrons per area, cell means; smooth over a few cells, as in an optical image.
    grid : Grid
        Cells of the map.
    n_threads : int, optional

    Returns
    -------
    gradient : (n_site, 2) float64, e-/µm
        Components along x and y; 0 for sites that lie partly or entirely off the map.

    Raises
    ------
    ParameterError
        When the shapes of map and grid differ, or the map has fewer than 5 rows or columns.

    Warns
    -----
    CoverageWarning
        When sites lie partly or entirely off the map.

    Examples
    --------
    A map with a slope of 2 e-/µm² per µm along x, on sites of 9 µm²:

    >>> import foveasim as fs
    >>> import numpy as np
    >>> grid = fs.Grid.centred((20, 20), 1.0)
    >>> map_e_per_um2 = 100.0 + 2.0 * np.arange(20.0) * np.ones((20, 1))
    >>> layout = fs.layout.grid(n_x=2, n_y=1, pitch_um=3.0)
    >>> fs.metrics.site_gradients_e_per_um(layout, map_e_per_um2, grid).round(9).tolist()
    [[18.0, 0.0], [18.0, 0.0]]
    """
    cells = _validate_map(map_e_per_um2, grid)
    integrator = Integrator(layout, grid, order=2, n_threads=n_threads)
    is_on = _is_on_map(integrator, layout)
    if not is_on.all():
        warn(
            f"{np.count_nonzero(~is_on):,} of {layout.n_sites:,} photosites lie partly or entirely off the map and have a "
            "gradient of 0; use a larger map or fewer sites",
            CoverageWarning,
        )
    gradient = np.moveaxis(integrator(_gradients(cells, grid)), 0, -1)
    return np.where(is_on[:, np.newaxis], gradient, 0.0)


def flow_bound(
    gradient_e_per_um: ArrayLike, variance_e2: ArrayLike | Linearisation, *, regions: ArrayLike | None = None
) -> FlowBound:
    """
    Compute the Cramér–Rao bound of the flow.

    Parameters
    ----------
    gradient_e_per_um : (n_site, 2), e-/µm
        Result of :func:`site_gradients_e_per_um`; or in DN/µm, with variances in DN².
    variance_e2 : (n_site,) or number, e-², or Linearisation
        Noise variance of each site, such as expected charge plus squared read noise; or the model of a sensor at the expected
        charge (:meth:`foveasim.Sensor.linearise`), with all its noise, correlated noise included, and its saturation.
    regions : (n_site,) integers, optional
        Region label of each site; negative labels are excluded. A single region by default.

    Returns
    -------
    FlowBound

    Raises
    ------
    ParameterError
        When shapes are inconsistent, or a variance is not positive.

    Notes
    -----
    The bound is valid for Gaussian noise of known variance, and for Poisson noise whose variance is the expected charge. With
    read noise, the dependence of the variance on the charge contains additional information, which is neglected.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> grid = fs.Grid.centred((64, 64), 1.0)
    >>> y, x = np.mgrid[:64, :64]
    >>> map_e_per_um2 = 100.0 + 20.0 * (np.sin(0.4 * x) + np.sin(0.4 * y))
    >>> layout = fs.layout.grid(n_x=16, n_y=16, pitch_um=3.0)
    >>> gradient = fs.metrics.site_gradients_e_per_um(layout, map_e_per_um2, grid)
    >>> fs.metrics.flow_bound(gradient, variance_e2=900.0).sigma_um.round(3).tolist()
    [[0.038, 0.038]]
    """
    gradient = finite_array("gradient_e_per_um", gradient_e_per_um, ndim=2)
    if gradient.shape[1] != 2:
        raise ParameterError("gradient_e_per_um", f"must have shape (n_site, 2), got {gradient.shape}")
    groups = _Regions(regions, len(gradient))
    weigh = _weights(variance_e2, groups, len(gradient))
    return _bound(gradient, weigh, groups, np.ones(len(gradient), bool))


def estimate_flow(
    layout: Layout,
    values_e: ArrayLike,
    map_e_per_um2: ArrayLike,
    grid: Grid,
    *,
    variance_e2: ArrayLike | Linearisation,
    regions: ArrayLike | None = None,
    n_steps: Annotated[int, Limits(at_least=1)] = 10,
    tolerance_um: Annotated[float, NOT_NEGATIVE] = 1e-6,
    n_threads: int | None = None,
) -> FlowEstimate:
    """
    Estimate the displacement of a known image from site values.

    The method is weighted least squares (Lucas and Kanade) with Gauss–Newton iterations.

    Parameters
    ----------
    layout : Layout
    values_e : (n_site,), e-
        Site values after the displacement.
    map_e_per_um2 : (n_y, n_x), e-/µm²
        Image before the displacement, cell means: the true image, or a reconstruction from an earlier frame.
    grid : Grid
        Cells of the map.
    variance_e2 : (n_site,) or number, e-², or Linearisation
        Noise variance of each site, or the model of a sensor, as for :func:`flow_bound`.
    regions : (n_site,) integers, optional
        Region label of each site; negative labels are excluded. A single region by default.
    n_steps : int
        Maximum number of iterations. One iteration is the method of Lucas and Kanade, which is accurate for displacements
        small against the image detail. Further iterations displace the site outlines by the negative estimate and estimate
        the remaining displacement.
    tolerance_um : float, µm
        Iterations end when no component of the last step exceeds this length.
    n_threads : int, optional

    Returns
    -------
    FlowEstimate

    Raises
    ------
    ParameterError
        When shapes are inconsistent, or a variance is not positive.

    Notes
    -----
    For Gaussian noise this is the maximum-likelihood estimate, which attains the bound for a high signal-to-noise ratio. The
    iterations converge to the nearest minimum; for large displacements, start with a blurred image. Sites whose displaced
    outlines lie partly or entirely off the map are excluded, because their expected value is unknown.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> grid = fs.Grid.centred((64, 64), 1.0)
    >>> y, x = np.mgrid[:64, :64]
    >>> before, after = (
    ...     100.0 + 20.0 * (np.sin(0.4 * (x - u)) + np.sin(0.4 * y)) for u in (0.0, 0.25)
    ... )
    >>> layout = fs.layout.grid(n_x=16, n_y=16, pitch_um=3.0)
    >>> values_e = fs.Integrator(layout, grid)(after)
    >>> fs.metrics.estimate_flow(
    ...     layout, values_e, before, grid, variance_e2=900.0
    ... ).flow_um.round(2).tolist()
    [[0.25, 0.0]]
    """
    cells = _validate_map(map_e_per_um2, grid)
    maps = np.concatenate((cells[np.newaxis], _gradients(cells, grid)))
    values = _per_site("values_e", finite_array("values_e", values_e), layout.n_sites)
    groups = _Regions(regions, layout.n_sites)
    weigh = _weights(variance_e2, groups, layout.n_sites)
    vertices_of_site = np.diff(layout.ring_offsets[layout.site_offsets])
    flow_um = np.zeros((groups.labels.size, 2))
    for step in range(n_steps + 1):
        # A site samples the image displaced by u like a site displaced by -u samples the original image.
        moved_um = np.repeat(groups.to_sites(flow_um), vertices_of_site, axis=0)
        displaced = Layout(layout.xy_um - moved_um, layout.ring_offsets, layout.site_offsets)
        integrator = Integrator(displaced, grid, order=2, n_threads=n_threads)
        is_on = _is_on_map(integrator, displaced)
        expected, *gradient = integrator(maps)
        slope = np.where(is_on[:, np.newaxis], np.stack(gradient, axis=1), 0.0)
        residual = np.where(is_on, values - expected, 0.0)
        bound = _bound(slope, weigh, groups, is_on)
        if step == n_steps:
            break
        weighted = weigh(residual)
        score = -groups.sums(slope * weighted[:, np.newaxis])
        is_observable = np.isfinite(bound.covariance_um2).all(axis=(1, 2))
        change_um = np.zeros_like(flow_um)
        change_um[is_observable] = np.einsum("rij,rj->ri", bound.covariance_um2[is_observable], score[is_observable])
        flow_um += change_um
        if n_steps > 1 and np.abs(change_um).max(initial=0.0) <= tolerance_um:
            break
    flow_um[~np.isfinite(bound.covariance_um2).all(axis=(1, 2))] = np.nan
    misfit = groups.sums((residual * weigh(residual))[:, np.newaxis])[:, 0] / np.maximum(bound.n_sites, 1)
    return FlowEstimate(
        regions=bound.regions,
        flow_um=read_only(flow_um),
        bound=bound,
        misfit=read_only(np.where(bound.n_sites > 0, misfit, np.nan)),
    )


class _Regions:
    """Region labels of sites, and sums over the sites of each region."""

    def __init__(self, regions: ArrayLike | None, n_sites: int) -> None:
        labels = np.zeros(n_sites, np.int64) if regions is None else as_numbers("regions", regions, keep_type=True)
        if labels.shape != (n_sites,) or labels.dtype.kind not in "iu":
            raise ParameterError("regions", f"must be {n_sites} integers, got {labels.dtype} of shape {labels.shape}")
        self._n_all = n_sites
        self._used = np.flatnonzero(labels >= 0)
        self.labels, self._position = np.unique(labels[self._used].astype(np.int64), return_inverse=True)

    def sites(self) -> list[Ints]:
        """Return the indices of the sites of each region."""
        return [self._used[self._position == k] for k in range(self.labels.size)]

    def counts(self, is_counted: Bools) -> Ints:
        """Count the selected sites of each region, (n_region,)."""
        return np.bincount(self._position[is_counted[self._used]], minlength=self.labels.size).astype(np.int64)

    def sums(self, values: Floats) -> Floats:
        """Sum values over the sites of each region: (n_region, k) from (n_site, k)."""
        columns = [
            np.bincount(self._position, column[self._used], self.labels.size) for column in np.moveaxis(values, 1, 0)
        ]
        return np.stack(columns, axis=1)

    def to_sites(self, values: Floats) -> Floats:
        """Assign region values to sites: (n_site, k) from (n_region, k); 0 for excluded sites."""
        out = np.zeros((self._n_all, values.shape[1]))
        out[self._used] = values[self._position]
        return out


def _validate_map(map_e_per_um2: ArrayLike, grid: Grid) -> Floats:
    cells = finite_array("map_e_per_um2", map_e_per_um2, ndim=2)
    if not isinstance(grid, Grid) or cells.shape != grid.shape or min(cells.shape) < 5:
        raise ParameterError(
            "map_e_per_um2", f"must have the grid's shape and at least 5 rows and columns, got {cells.shape}"
        )
    return cells


def _gradients(values: Floats, grid: Grid) -> Floats:
    """
    Compute the gradient of a map along x and y, (2, n_y, n_x) per µm.

    Central differences are of fourth order inside, and of second order at the boundary.
    """
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
    """Return whether sites lie entirely within the map, (n_site,)."""
    return np.asarray(integrator.uncovered_um2 <= MAX_UNCOVERED_FRACTION * layout.area_um2)


def _weights(noise: ArrayLike | Linearisation, groups: _Regions, n_sites: int) -> Callable[[Floats], Floats]:
    """Return a function that divides changes of charges by their variance."""
    if not isinstance(noise, Linearisation):
        variance = _per_site("variance_e2", finite_array("variance_e2", noise, above=0.0), n_sites)
        return lambda values: values / variance
    if noise.n_sites != n_sites:
        raise ParameterError("variance_e2", f"must be the model of a sensor of {n_sites} sites, got {noise.n_sites}")
    if not noise.is_correlated:
        return noise.weigh

    def weigh(values: Floats) -> Floats:  # within each region
        total = np.zeros_like(values)
        for own in groups.sites():
            moved = np.zeros_like(values)
            moved[..., own] = values[..., own]
            total += noise.weigh(moved, sites=own)
        return total

    return weigh


def _bound(gradient: Floats, weigh: Callable[[Floats], Floats], groups: _Regions, is_counted: Bools) -> FlowBound:
    gx, gy = np.moveaxis(gradient, 1, 0)
    wx, wy = weigh(np.stack((gx, gy)))
    xx, xy, yy = np.moveaxis(groups.sums(np.stack((gx * wx, gx * wy, gy * wy), axis=1)), 1, 0)
    information = np.stack((np.stack((xx, xy), axis=1), np.stack((xy, yy), axis=1)), axis=1)
    return FlowBound(
        regions=read_only(groups.labels),
        n_sites=read_only(groups.counts(is_counted)),
        information_per_um2=read_only(information),
    )


def _marginal_information(information_per_um2: Floats, axis: int) -> Floats:
    """Return the marginal information of u or v, (n_region,); 0 below rounding error."""
    own, other = information_per_um2[:, axis, axis], information_per_um2[:, 1 - axis, 1 - axis]
    shared = information_per_um2[:, 0, 1] ** 2 / np.where(other > 0.0, other, 1.0)
    return np.where(own - shared > MIN_INFORMATION * own, own - shared, 0.0)


def _inverse(information_per_um2: Floats) -> Floats:
    """Invert symmetric matrices (n, 2, 2); infinite if singular to float64."""
    xx, xy, yy = (information_per_um2[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    determinant = xx * yy - xy * xy
    is_good = determinant > MIN_INFORMATION * xx * yy
    adjugate = np.stack((np.stack((yy, -xy), axis=1), np.stack((-xy, xx), axis=1)), axis=1)
    return np.where(
        is_good[:, np.newaxis, np.newaxis],
        adjugate / np.where(is_good, determinant, 1.0)[:, np.newaxis, np.newaxis],
        np.inf,
    )


def _per_site(name: str, values: NDArray[np.float64], n_sites: int) -> Floats:
    return np.broadcast_to(check_per_site(name, values, n_sites, or_one=True), (n_sites,))

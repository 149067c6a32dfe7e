"""
Slanted-edge MTF after ISO 12233, for photosites of arbitrary shape and position.

On a grid, the standard projects pixels along the edge, so that rows at slightly different phases form one finely sampled edge
spread function (ESF). The method does not require a grid: every site is a sample at its own distance from the edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.validation import (
    Bools,
    Floats,
    Ints,
    as_numbers,
    check_length_um,
    check_number,
    check_per_site,
    finite_array,
    read_only,
    unmasked,
)
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import Layout
from foveasim.units import per_mm_from_per_um, per_um_from_per_mm

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["EdgeMtf", "slanted_edge_mtf"]

#: Bins per pitch, as in the standard.
BINS_PER_PITCH = 4
#: Minimum number of sites, and minimum extent of the ESF on each side in pitches.
MIN_SITES, MIN_REACH_PITCHES = 50, 5.0
#: Minimum contrast (white - black) / (white + black).
MIN_CONTRAST = 0.02
#: Sum of black and white, as a fraction of their difference, below which it is rounding error.
MIN_SUM_RATIO = 1e-9
#: Minimum fraction of the variance of the values that one straight edge explains.
MIN_EXPLAINED_FRACTION = 0.3
#: Extent of bins of constant width, in pitches and in widths of the edge; beyond it, the bin width increases by this fraction
#: of the distance. The ESF is smooth there, and noise at high frequencies would dominate the MTF.
NARROW_PITCHES, NARROW_WIDTHS, GROWTH = 3.0, 2.0, 0.5
#: Minimum extent of the ESF in widths of the error function; a shorter one would end on the slope of the edge.
MIN_REACH_WIDTHS = 2.0
#: Neighbouring bins on either side that contribute to the noise estimate of a bin.
SCATTER_BINS = 4
#: Minimum number of bins per period; aliases are below 1 % for 4 bins, and 18 % for 2 bins.
BINS_PER_PERIOD = 4
#: Largest edge width as a fraction of the region; a wider transition is a ramp.
MAX_WIDTH_FRACTION = 0.25
#: Residual, as a fraction of the step, above which the robust loss reduces its weight (defects, other edges at the boundary).
SOFT_LOSS_FRACTION = 0.1
#: Default number of frequencies, up to one line pair per pitch, twice the Nyquist frequency of a square grid.
N_FREQUENCIES = 101
#: Levels of the histogram that separates black from white.
N_LEVELS = 256


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeMtf:
    """
    Result of the slanted-edge method.

    Attributes
    ----------
    frequency_per_mm : (n_frequency,) float64, 1/mm
        Line pairs per mm on the sensor, perpendicular to the edge.
    mtf : (n_frequency,) float64
        MTF, 1 at frequency 0.
    mtf_sigma : (n_frequency,) float64
        Standard deviation of the MTF due to noise that is independent between sites, estimated from the scatter of the sites
        about the ESF. Where the MTF is not larger than this value, it is biased high.
    angle_deg : float, degrees
        Angle of the edge from the vertical, counter-clockwise, from -180 to 180: white is to the right at 0, and above at 90.
    offset_um : float, µm
        Distance of the edge from the origin, towards white.
    contrast : float
        (white - black) / (white + black); infinite if black and white have opposite values.
    bin_um, pitch_um : float, µm
        Bin width near the edge, and the reference pitch: the median distance between a site and its nearest neighbour.
    distance_um : (n_bin,) float64, µm
        Mean distance of the sites in each bin from the edge, black first.
    esf : (n_bin,) float64
        Edge spread function (ESF): mean of the sites in each bin, in the unit of the values.
    n_sites : int
        Number of sites in the bins.
    """

    frequency_per_mm: Floats
    mtf: Floats
    mtf_sigma: Floats
    angle_deg: float
    offset_um: float
    contrast: float
    bin_um: float
    pitch_um: float
    distance_um: Floats
    esf: Floats
    n_sites: int

    def __repr__(self) -> str:
        return (
            f"EdgeMtf(MTF50 at {self.mtf50_per_mm:.4g} per mm, edge at {self.angle_deg:.4g} degrees, "
            f"{self.n_sites:,} sites in bins of {self.bin_um:.4g} µm)"
        )

    def plot(self, *, ax: Axes | None = None) -> Axes:
        """Draw the MTF against the frequency on matplotlib axes."""
        from foveasim.view import plot_curves

        return plot_curves({"": (self.frequency_per_mm, self.mtf)}, "frequency / (line pairs per mm)", "MTF", ax=ax)

    @property
    def mtf50_per_mm(self) -> float:
        """MTF50, the lowest frequency with an MTF of 1/2, linearly interpolated, 1/mm; or NaN."""
        below = np.flatnonzero(self.mtf < 0.5)
        if below.size == 0 or below[0] == 0:
            return float("nan")
        last = below[0] - 1
        fraction = (self.mtf[last] - 0.5) / (self.mtf[last] - self.mtf[last + 1])
        return float((1.0 - fraction) * self.frequency_per_mm[last] + fraction * self.frequency_per_mm[last + 1])


def slanted_edge_mtf(
    layout: Layout,
    values: ArrayLike,
    *,
    where: ArrayLike | None = None,
    bin_um: float | None = None,
    reach_um: float | None = None,
    frequency_per_mm: ArrayLike | None = None,
    window: Literal["tukey", "hamming", "none"] = "tukey",
) -> EdgeMtf:
    """
    Measure the MTF of a complete system from one straight edge between black and white.

    Parameters
    ----------
    layout : Layout
    values : (n_site,)
        Values linear in irradiance: ``capture.expected_e``, ``capture.electrons`` or linear codes; divided by
        ``layout.area_um2`` if sites differ in size. Sites with NaN are excluded.
    where : (n_site,) bool, optional
        Mask of the sites used: a region with a single edge, one filter of a mosaic, or an annulus of a foveal layout with sites
        of similar size. All by default.
    bin_um : float, optional, µm
        Bin width of the edge spread function near the edge; a quarter of the reference pitch by default, at most one
        pitch.
    reach_um : float, optional, µm
        Largest distance from the edge of the sites used; by default as far as all bins on both sides contain sites. Shading
        over the region is interpreted as a part of the edge; in this case give a shorter reach, at least five pitches.
    frequency_per_mm : (n,), optional, 1/mm
        Increasing frequencies, at most one line pair per four bins. By default from 0 to this limit, or to one line pair per
        pitch, in 100 steps.
    window : {"tukey", "hamming", "none"}
        Window of the line spread function: ``"tukey"`` is flat over the central half of the reach with cosine flanks,
        ``"hamming"`` is the window of the first editions of the standard, ``"none"`` applies no window. A narrower window
        excludes more of the PSF tails of the lens, which increases the measured MTF.

    Returns
    -------
    EdgeMtf

    Raises
    ------
    ParameterError
        When an argument is out of range, or there are too few sites.
    SimulationError
        When no straight edge is found, the contrast is too low, or the edge is parallel to rows of sites.

    Notes
    -----
    The edge position and angle are found by a robust least-squares fit of an error function. Sites are binned by the distance
    of their centroids from the edge, weighted by area. The mean of a bin differs from the ESF at the mean distance by half the
    variance of the distances times the curvature of the ESF, and is corrected by this amount. For sites uniformly distributed
    over a bin, this corresponds to the ``sinc(f b)`` of the bin. The line spread function (LSF) is the difference of
    neighbouring bins at the distance d, which multiplies its spectrum by ``sinc(f d)``; this factor is divided out, as in the
    standard.

    Bins have constant width up to three pitches or two edge widths, whichever is larger, and beyond it half the additional
    distance. At such distances the LSF of a lens is smooth: wide bins include its tails with little noise. The differences are
    distributed uniformly over their steps, which multiplies their spectrum by ``sinc(f d)`` once more. For 100 by 100 squares
    and an edge of 50 and of 20 times the noise, the error of the MTF up to the Nyquist frequency is 0.008 and 0.021 (root mean
    square), four tenths of the error with constant bins over the complete region.

    The MTF is perpendicular to the edge and applies to the sites near it. It includes the aperture of the sites
    (:func:`polygon_mtf`), the lens, diffusion between sites, and the pixels of the chart.

    References
    ----------
    ISO 12233:2023, Photography: Electronic still picture imaging: Resolution and spatial frequency responses, annex D (e-SFR).

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.grid(n_x=80, n_y=80, pitch_um=4.0)
    >>> x_um, y_um = layout.centroid_um.T
    >>> edge = np.clip(
    ...     (x_um + 0.1 * y_um) / 4.0 + 0.5, 0.0, 1.0
    ... )  # through the apertures of the sites
    >>> found = fs.metrics.slanted_edge_mtf(layout, edge)
    >>> round(found.angle_deg, 1), round(found.mtf50_per_mm)  # |sinc| is 0.5 at 151 per mm
    (5.7, 150)
    """
    site_values = check_per_site("values", as_numbers("values", values, missing_is_nan=True), layout.n_sites)
    is_used = np.isfinite(site_values) & _mask(where, layout.n_sites)
    n_used = int(np.count_nonzero(is_used))
    if n_used < MIN_SITES:
        raise ParameterError("where", f"must select at least {MIN_SITES} sites", n_used)
    xy_um, used_values, area_um2 = layout.centroid_um[is_used], site_values[is_used], layout.area_um2[is_used]
    pitch_um = _pitch_um(xy_um)
    if bin_um is None:
        bin_um = pitch_um / BINS_PER_PITCH
    else:
        bin_um = check_length_um("bin_um", bin_um, at_most=pitch_um, hint="the limit is one pitch")
    frequency = _frequencies_per_mm(frequency_per_mm, bin_um, pitch_um)
    edge = _find_edge(xy_um, used_values, pitch_um)
    across = np.array([np.cos(edge.angle_rad), np.sin(edge.angle_rad)])
    bins = _bin_esf(xy_um @ across - edge.offset_um, used_values, area_um2, bin_um, reach_um, pitch_um, edge.width_um)
    mtf, sigma = _mtf(bins, window, per_um_from_per_mm(frequency))
    return EdgeMtf(
        frequency_per_mm=read_only(frequency),
        mtf=read_only(mtf),
        mtf_sigma=read_only(sigma),
        angle_deg=float(np.rad2deg(edge.angle_rad)),
        offset_um=edge.offset_um,
        contrast=edge.contrast,
        bin_um=bin_um,
        pitch_um=pitch_um,
        distance_um=read_only(bins.distance_um),
        esf=read_only(bins.esf),
        n_sites=bins.n_sites,
    )


def _mask(where: ArrayLike | None, n_sites: int) -> Bools:
    if where is None:
        return np.ones(n_sites, bool)
    mask = np.asarray(unmasked("where", where))
    if mask.dtype != bool or mask.shape != (n_sites,):
        raise ParameterError("where", f"must be a mask of the {n_sites} sites, got {mask.dtype} of shape {mask.shape}")
    return mask


def _frequencies_per_mm(frequency_per_mm: ArrayLike | None, bin_um: float, pitch_um: float) -> Floats:
    """Return the validated frequencies, or the default ones."""
    highest = float(per_mm_from_per_um(1.0 / (BINS_PER_PERIOD * bin_um)))
    if frequency_per_mm is None:
        return np.linspace(0.0, min(highest, float(per_mm_from_per_um(1.0 / pitch_um))), N_FREQUENCIES)
    frequency = np.atleast_1d(finite_array("frequency_per_mm", frequency_per_mm, at_least=0.0)).copy()
    if frequency.ndim != 1 or frequency.size == 0 or np.any(np.diff(frequency) <= 0.0):
        raise ParameterError("frequency_per_mm", "must be strictly increasing, (n,)", frequency_per_mm, "1/mm")
    if frequency[-1] > highest * (1.0 + 1e-9):
        raise ParameterError(
            "frequency_per_mm",
            f"must be <= {highest:.4g} with bins of {bin_um:.4g} µm",
            float(frequency[-1]),
            "1/mm",
            "use narrower bins (bin_um)",
        )
    return frequency


def _pitch_um(xy_um: Floats) -> float:
    from scipy.spatial import cKDTree

    return float(np.median(cKDTree(xy_um).query(xy_um, k=[2])[0]))


def _mtf(bins: _Bins, window: str, cycles_per_um: Floats) -> tuple[Floats, Floats]:
    """Compute the MTF and its standard deviation, (n_frequency,)."""
    rise, step_um = np.diff(bins.esf), np.diff(bins.distance_um)
    at_um = 0.5 * (bins.distance_um[1:] + bins.distance_um[:-1])
    weight = _window(window, at_um / max(-bins.distance_um[0], bins.distance_um[-1]))
    # Transfer factor of a difference over a step; averaged over constant bins, weighted by the differences.
    left = np.sinc(np.multiply.outer(cycles_per_um, step_um))
    is_narrow = bins.is_narrow[1:] & bins.is_narrow[:-1]
    size = np.abs(rise * weight) * is_narrow
    mean_left = (left @ (size / size.sum()))[:, np.newaxis]
    wave = np.exp(-2j * np.pi * np.multiply.outer(cycles_per_um, at_um))
    kernel = weight * wave * np.where(is_narrow, 1.0 / mean_left, left)
    spectrum, total = kernel @ rise, float(weight @ rise)
    modulus = np.abs(spectrum)
    mtf = modulus / total
    # First-order error propagation from the ESF: each bin contributes to two adjacent differences.
    phase = spectrum.conj() / np.maximum(modulus, np.finfo(float).tiny)
    of_rise = ((phase[:, np.newaxis] * kernel).real - np.multiply.outer(mtf, weight)) / total
    of_bin = -np.diff(of_rise, axis=1, prepend=0.0, append=0.0)
    return mtf, np.sqrt(np.square(of_bin) @ bins.variance)


# -- edge fit -----------------------------------------------------------------------------------------------------


class _Edge(NamedTuple):
    """Direction towards white (rad), distance from the origin, width and contrast of an edge."""

    angle_rad: float
    offset_um: float
    width_um: float
    contrast: float


def _find_edge(xy_um: Floats, values: Floats, pitch_um: float) -> _Edge:
    """Fit a straight edge between black and white to values at points (n, 2)."""
    from scipy.optimize import least_squares
    from scipy.special import erf

    centre_um, extent_um = xy_um.mean(axis=0), float(np.hypot(*np.ptp(xy_um, axis=0)))
    level = _otsu_threshold(values)
    is_white = values > level
    n_white = int(np.count_nonzero(is_white))
    if n_white in (0, values.size):
        raise SimulationError("no edge found: all values are equal; use a region with one edge")
    black, white = float(np.median(values[~is_white])), float(np.median(values[is_white]))
    # Initial line: linear discriminant of black and white sites, with as many sites on its black side as there are black ones.
    xy = (xy_um - centre_um) / extent_um
    normal = np.linalg.solve(np.cov(xy.T), xy.T @ (is_white - is_white.mean()))
    angle = float(np.arctan2(normal[1], normal[0]))
    offset = float(np.quantile(xy @ [np.cos(angle), np.sin(angle)], 1.0 - n_white / values.size))
    relative = (values - black) / (white - black)

    def residuals(x: Floats) -> Floats:
        angle, offset, width, low, high = x
        distance = xy @ [np.cos(angle), np.sin(angle)] - offset
        return np.asarray(low + (high - low) * 0.5 * (1.0 + erf(distance / width)) - relative)

    start, narrowest = np.array([angle, offset, 0.05, 0.0, 1.0]), 0.01 * pitch_um / extent_um
    bounds = ([-np.inf, -2.0, narrowest, -np.inf, -np.inf], [np.inf, 2.0, 10.0, np.inf, np.inf])
    fit = least_squares(
        residuals, start, bounds=bounds, loss="soft_l1", f_scale=SOFT_LOSS_FRACTION, x_scale=[0.1, 0.1, 0.05, 1, 1]
    )
    angle, offset, width, low, high = fit.x.tolist()
    if high < low:
        angle, offset, low, high = angle + np.pi, -offset, high, low
    explained = 1.0 - float(np.square(residuals(fit.x)).mean()) / float(relative.var())
    if explained < MIN_EXPLAINED_FRACTION:
        raise SimulationError(
            f"no edge found: a straight edge explains {100.0 * max(explained, 0.0):.0f} % of the variance of the values, less "
            f"than {100.0 * MIN_EXPLAINED_FRACTION:.0f} %; use a region with one edge and less noise"
        )
    if width > MAX_WIDTH_FRACTION:
        raise SimulationError(
            f"no edge found: the fit is {width * extent_um:.4g} µm wide, more than a quarter of the region; use a larger region"
        )
    low, high = black + (white - black) * low, black + (white - black) * high
    # The contrast of values symmetric about 0 is undefined.
    contrast = (high - low) / (high + low) if abs(high + low) > MIN_SUM_RATIO * (high - low) else np.inf
    contrast = abs(contrast)
    if contrast < MIN_CONTRAST:
        raise SimulationError(
            f"the contrast of the edge must be at least {MIN_CONTRAST:g}, got {contrast:.2g} (black {low:.4g}, white "
            f"{high:.4g})"
        )
    angle = float((angle + np.pi) % (2.0 * np.pi) - np.pi)
    direction = np.array([np.cos(angle), np.sin(angle)])
    return _Edge(angle, float(offset * extent_um + centre_um @ direction), float(width * extent_um), contrast)


def _otsu_threshold(values: Floats) -> float:
    """Return the threshold that best separates two classes of values (Otsu 1979)."""
    counts, edges = np.histogram(values, N_LEVELS)
    n_below = np.cumsum(counts)
    sums = np.cumsum(counts * 0.5 * (edges[1:] + edges[:-1]))
    n_above = values.size - n_below
    both = (n_below > 0) & (n_above > 0)
    if not both.any():
        return float(edges[-1])
    means = sums / np.maximum(n_below, 1), (sums[-1] - sums) / np.maximum(n_above, 1)
    between = np.where(both, n_below * n_above * (means[1] - means[0]) ** 2, 0.0)
    # The criterion is constant over the gap between both classes; use the centre of the gap.
    best = np.flatnonzero(between >= between.max() * (1.0 - 1e-12))
    return float(0.5 * (edges[best[0] + 1] + edges[best[-1] + 1]))


# -- edge spread function ------------------------------------------------------------------------------------------


class _Bins(NamedTuple):
    """Mean distances, ESF, its variance, mask of bins of constant width, and number of sites."""

    distance_um: Floats
    esf: Floats
    variance: Floats
    is_narrow: Bools
    n_sites: int


def _bin_esf(
    distance_um: Floats,
    values: Floats,
    area_um2: Floats,
    bin_um: float,
    reach_um: float | None,
    pitch_um: float,
    width_um: float,
) -> _Bins:
    """Compute the ESF as area-weighted means over bins of the distance from the edge."""
    # Bin 0 starts at the edge.
    k = np.floor(distance_um / bin_um).astype(np.int64)
    first = int(k.min())
    weight = np.bincount(k - first, weights=area_um2)
    empty = np.flatnonzero(weight == 0.0) + first
    # Largest contiguous range of bins with sites.
    low = int(empty[empty < 0].max(initial=first - 1)) + 1
    high = int(empty[empty >= 0].min(initial=int(k.max()) + 1)) - 1
    n_sides = min(-low, high + 1)
    min_reach_um = max(MIN_REACH_PITCHES * pitch_um, MIN_REACH_WIDTHS * width_um)
    if reach_um is not None:
        hint = f"the minimum is five pitches of {pitch_um:.3g} µm and two edge widths of {width_um:.3g} µm"
        min_reach_um = check_number("reach_um", reach_um, at_least=float(f"{min_reach_um:.3g}"), hint=hint)
        n_sides = min(n_sides, int(np.ceil(min_reach_um / bin_um)))
    if n_sides * bin_um < min_reach_um * (1.0 - 1e-9):
        far_um = min(-distance_um.min(), distance_um.max())
        raise SimulationError(
            f"the edge spread function must extend to {min_reach_um:.4g} µm without empty bins, "
            f"got {max(n_sides, 0) * bin_um:.4g} µm; "
            + (
                "the edge is too close to the boundary of the region"
                if far_um < min_reach_um
                else "rotate the edge by a few degrees from the rows of sites, or use a larger region or wider bins (bin_um)"
            )
        )
    is_in = (k >= -n_sides) & (k < n_sides)
    n_narrow = int(np.ceil(max(NARROW_PITCHES * pitch_um, NARROW_WIDTHS * width_um) / bin_um))
    bin_edges = _bin_edges(n_narrow, n_sides)
    position = np.searchsorted(bin_edges, k[is_in], side="right") - 1
    weights, value = area_um2[is_in], values[is_in]
    total = np.bincount(position, weights=weights)
    mean_um = np.bincount(position, weights=weights * distance_um[is_in]) / total
    off_um = distance_um[is_in] - mean_um[position]
    variance_um2 = np.bincount(position, weights=weights * np.square(off_um)) / total
    esf = np.bincount(position, weights=weights * value) / total
    # The bin mean differs from the ESF at the mean distance by half the variance of the distances times the curvature.
    esf -= 0.5 * variance_um2 * _curvature(mean_um, esf)
    # Noise: deviation of the values from a local parabola through the ESF.
    slope, half_curvature = np.gradient(esf, mean_um), 0.5 * _curvature(mean_um, esf)
    noise = value - (esf[position] + (slope[position] + half_curvature[position] * off_um) * off_um)
    return _Bins(
        mean_um,
        esf,
        _scatter(noise, position) * np.bincount(position, weights=np.square(weights)) / np.square(total),
        np.maximum(-bin_edges[:-1], bin_edges[1:]) <= n_narrow,
        int(np.count_nonzero(is_in)),
    )


def _bin_edges(n_narrow: int, n_sides: int) -> Ints:
    """Return the bin edges from -n_sides to n_sides, in units of the narrow bin width."""
    side = list(range(min(n_narrow, n_sides) + 1))
    while side[-1] < n_sides:
        step, rest = round(1.0 + max(0.0, GROWTH * (side[-1] - n_narrow))), n_sides - side[-1]
        side.append(side[-1] + (step if rest >= 2 * step else rest))
    return np.concatenate((-np.array(side[:0:-1], np.int64), np.array(side, np.int64)))


def _scatter(values: Floats, position: NDArray[np.intp]) -> Floats:
    """
    Estimate the variance of values about 0 in each bin, pooled with neighbouring bins.

    It is NaN if all these bins contain a single site each.
    """
    around = np.ones(2 * SCATTER_BINS + 1)
    squares = np.convolve(np.pad(np.bincount(position, weights=np.square(values)), SCATTER_BINS), around, "valid")
    freedom = np.convolve(np.pad(np.bincount(position) - 1.0, SCATTER_BINS), around, "valid")
    return np.asarray(squares / np.where(freedom > 0.5, freedom, np.nan))


def _curvature(distance_um: Floats, esf: Floats) -> Floats:
    """Compute the second derivative of the ESF by second differences; 0 at both ends."""
    step_um, rise = np.diff(distance_um), np.diff(esf)
    slope = rise / step_um
    return np.pad(2.0 * np.diff(slope) / (step_um[1:] + step_um[:-1]), 1)


def _window(window: str, fraction: Floats) -> Floats:
    """Return the window at fractions of the reach, from -1 to 1."""
    fraction = np.minimum(np.abs(fraction), 1.0)
    if window == "tukey":
        return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.maximum(2.0 * fraction - 1.0, 0.0)))
    return 0.54 + 0.46 * np.cos(np.pi * fraction) if window == "hamming" else np.ones_like(fraction)

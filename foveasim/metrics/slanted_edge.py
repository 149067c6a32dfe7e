"""
The modulation transfer function (MTF) from a slanted edge, in the manner of ISO 12233, for photosites of any shapes and places.

On a grid the standard projects pixels along the edge, so that rows at slightly different phases make one finely sampled
profile. Nothing of that needs a grid: every site is a sample at its own distance from the edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.validation import (
    Bools,
    Floats,
    Ints,
    as_numbers,
    check_choice,
    check_length_um,
    check_number,
    finite_array,
    read_only,
    unmasked,
)
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import Layout
from foveasim.metrics.sampling import require_layout
from foveasim.units import per_mm_from_per_um, per_um_from_per_mm

__all__ = ["EdgeMtf", "slanted_edge_mtf"]

#: Bins to a pitch, as the standard has it.
BINS_PER_PITCH = 4
#: Fewer sites tell no edge, and a shorter profile to each side, in pitches, no frequencies.
LEAST_SITES, LEAST_REACH_PITCHES = 50, 5.0
#: (white - black) / (white + black) below which black and white are the same.
LEAST_CONTRAST = 0.02
#: A sum of black and white below this fraction of their difference is rounding.
NO_SUM = 1e-9
#: Fraction of the values' variance that one straight edge must explain.
LEAST_EXPLAINED = 0.3
#: Bins of that width reach to this distance, in pitches and in widths of the edge; beyond it each is wider by this fraction of
#: the distance. The ESF is smooth there, and noise at high frequencies would dominate the MTF.
NARROW_PITCHES, NARROW_WIDTHS, WIDENING = 3.0, 2.0, 0.5
#: A profile that reaches less far than so many widths of the edge, the error function's, ends on its slope.
LEAST_REACH_WIDTHS = 2.0
#: Bins on either side whose sites tell together how much values scatter.
SCATTER_BINS = 4
#: With fewer bins to a period their aliases are no longer small: with so many they are below 1 %, with two 18 %.
BINS_PER_PERIOD = 4
#: An edge blurred over more than this fraction of the region is a ramp.
WIDEST_SHARE = 0.25
#: Residuals beyond this fraction of the step count less and less: a defect, or another edge at the border.
SOFT_SHARE = 0.1
#: Frequencies of a result that asks for none, up to one a pitch, twice the Nyquist frequency of a square grid.
N_FREQUENCIES = 101
#: Levels of the histogram that tells black from white.
N_LEVELS = 256


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeMtf:
    """
    What a slanted edge tells.

    Attributes
    ----------
    frequency_per_mm : (n_frequency,) float64, 1/mm
        Line pairs per mm on the sensor, across the edge.
    mtf : (n_frequency,) float64
        1 at frequency 0.
    mtf_sigma : (n_frequency,) float64
        Its standard deviation, as far as it comes of noise that differs from site to site; told from the scatter of the sites
        about the profile. Where the MTF itself is no larger, its mean is too high.
    angle_deg : float, degrees
        Of the edge from the vertical, counter-clockwise, from -180 to 180: 0 has white to the right of it, 90 above it.
    offset_um : float, µm
        Distance of the edge from the origin, towards white.
    contrast : float
        (white - black) / (white + black); infinite where black is as far below 0 as white is above.
    bin_um, pitch_um : float, µm
        Width of a bin near the edge, and the reference pitch: the median distance of a site from its nearest neighbour.
    distance_um : (n_bin,) float64, µm
        Mean distance of each bin's sites from the edge, black first.
    profile : (n_bin,) float64
        The edge spread function: mean of each bin's sites, in the unit of the values.
    n_sites : int
        Sites in the bins.
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
    profile: Floats
    n_sites: int

    def __repr__(self) -> str:
        return (
            f"EdgeMtf(MTF50 at {self.mtf50_per_mm:.4g} per mm, edge at {self.angle_deg:.4g} degrees, "
            f"{self.n_sites:,} sites in bins of {self.bin_um:.4g} µm)"
        )

    @property
    def mtf50_per_mm(self) -> float:
        """Lowest frequency where the MTF falls to 1/2, linear in between; NaN where it does not, 1/mm."""
        below = np.flatnonzero(self.mtf < 0.5)
        if below.size == 0 or below[0] == 0:
            return float("nan")
        last = below[0] - 1
        share = (self.mtf[last] - 0.5) / (self.mtf[last] - self.mtf[last + 1])
        return float((1.0 - share) * self.frequency_per_mm[last] + share * self.frequency_per_mm[last + 1])


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
    MTF of everything between a scene and the sites' values, from one straight edge between black and white.

    Parameters
    ----------
    layout : Layout
    values : (n_site,)
        Linear in light per area: ``capture.expected_e``, ``capture.electrons`` or linear codes; where sites differ in size,
        divided by ``layout.area_um2``. A site that is to be left out may be NaN.
    where : (n_site,) bool, optional
        Sites to take: a region where one edge is all there is, one filter of a mosaic, or an annulus of a foveal layout, whose
        sites are of about one size. All by default.
    bin_um : float, optional, µm
        Width of the bins of the edge spread function near the edge; a quarter of the reference pitch by default, one
        pitch at most.
    reach_um : float, optional, µm
        How far from the edge sites are looked at; by default as far as there are sites in every bin on both sides. Light that
        falls off over the region is taken for a part of the edge: give a shorter reach then, five pitches at least.
    frequency_per_mm : (n,), optional, 1/mm
        Rising, up to one line pair in four bins. By default from 0 to there, or to one line pair a pitch, in 100 steps.
    window : {"tukey", "hamming", "none"}
        By which the line spread function is multiplied: flat over the middle half of the reach with cosine ends; the bell of
        the standard's first editions; or none. The narrower the window, the more of the light that a lens spreads far is left
        out, and the higher the MTF comes out.

    Returns
    -------
    EdgeMtf

    Raises
    ------
    ParameterError
        When an argument is out of range, or there are too few sites.
    SimulationError
        When no straight edge is found, there is too little contrast, or the edge runs along rows of sites.

    Notes
    -----
    The edge is where an error function across a line fits best, at any angle and place, with soft losses. Sites are binned by
    the distance of their centroids from it, weighted by area. Where a bin's sites lie about their mean place, its mean is off
    by half the places' variance times the profile's curvature, which is taken off: for sites spread evenly over a bin that is
    the bin's own ``sinc(f b)``, and right for any others. The line spread function is the difference of neighbouring bins, at
    places d apart; that multiplies its spectrum by ``sinc(f d)``, which is divided out, as the standard does.

    Bins are narrow up to three pitches or twice the edge's width from it, and from there on half as wide as the way beyond. So
    far out the line spread function is smooth, as that of a lens is: all of its light is counted, and of its noise little. Its
    differences are spread over their steps, which multiplies their spectrum by ``sinc(f d)`` once more. Of 100
    by 100 squares with an edge of 50 and of 20 times the noise, the MTF up to the Nyquist frequency is off by 0.008 and 0.021
    (root mean square), four tenths of what narrow bins as far as the region reaches have.

    The MTF is that across the edge, of the sites near it. It contains the sites' own shape (:func:`polygon_mtf`), the lens,
    diffusion between sites, and the chart's own pixels.

    References
    ----------
    ISO 12233:2023, Photography: Electronic still picture imaging: Resolution and spatial frequency responses, annex D (e-SFR).
    """
    require_layout(layout)
    site_values = as_numbers("values", values, missing_is_nan=True)
    if site_values.shape != (layout.n_sites,):
        raise ParameterError("values", f"must be one for each of the {layout.n_sites} sites, got {site_values.shape}")
    is_used = np.isfinite(site_values) & _mask(where, layout.n_sites)
    check_choice("window", window, ("tukey", "hamming", "none"))
    n_used = int(np.count_nonzero(is_used))
    if n_used < LEAST_SITES:
        raise ParameterError("where", f"must leave at least {LEAST_SITES} sites", n_used)
    xy_um, light, area_um2 = layout.centroid_um[is_used], site_values[is_used], layout.area_um2[is_used]
    pitch_um = _pitch_um(xy_um)
    if bin_um is None:
        bin_um = pitch_um / BINS_PER_PITCH
    else:
        bin_um = check_length_um("bin_um", bin_um, at_most=pitch_um, hint="one pitch is the most")
    frequency = _frequencies_per_mm(frequency_per_mm, bin_um, pitch_um)
    edge = _find_edge(xy_um, light, pitch_um)
    across = np.array([np.cos(edge.angle_rad), np.sin(edge.angle_rad)])
    bins = _binned(xy_um @ across - edge.offset_um, light, area_um2, bin_um, reach_um, pitch_um, edge.width_um)
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
        profile=read_only(bins.profile),
        n_sites=bins.n_sites,
    )


def _mask(where: ArrayLike | None, n_sites: int) -> Bools:
    if where is None:
        return np.ones(n_sites, bool)
    mask = np.asarray(unmasked("where", where))
    if mask.dtype != bool or mask.shape != (n_sites,):
        raise ParameterError(
            "where", f"must be a mask of the {n_sites} sites, got {mask.dtype} of the shape {mask.shape}"
        )
    return mask


def _frequencies_per_mm(frequency_per_mm: ArrayLike | None, bin_um: float, pitch_um: float) -> Floats:
    """Those asked for, checked, or the default ones."""
    highest = float(per_mm_from_per_um(1.0 / (BINS_PER_PERIOD * bin_um)))
    if frequency_per_mm is None:
        return np.linspace(0.0, min(highest, float(per_mm_from_per_um(1.0 / pitch_um))), N_FREQUENCIES)
    frequency = np.atleast_1d(finite_array("frequency_per_mm", frequency_per_mm, at_least=0.0)).copy()
    if frequency.ndim != 1 or frequency.size == 0 or np.any(np.diff(frequency) <= 0.0):
        raise ParameterError("frequency_per_mm", "must be rising numbers, (n,)", frequency_per_mm, "1/mm")
    if frequency[-1] > highest * (1.0 + 1e-9):
        raise ParameterError(
            "frequency_per_mm",
            f"must be <= {highest:.4g} with bins of {bin_um:.4g} µm",
            float(frequency[-1]),
            "1/mm",
            "take narrower bins (bin_um)",
        )
    return frequency


def _pitch_um(xy_um: Floats) -> float:
    from scipy.spatial import cKDTree

    return float(np.median(cKDTree(xy_um).query(xy_um, k=[2])[0]))


def _mtf(bins: _Bins, window: str, cycles_per_um: Floats) -> tuple[Floats, Floats]:
    """The MTF and its standard deviation, (n_frequency,)."""
    rise, step_um = np.diff(bins.profile), np.diff(bins.distance_um)
    at_um = 0.5 * (bins.distance_um[1:] + bins.distance_um[:-1])
    weight = _window(window, at_um / max(-bins.distance_um[0], bins.distance_um[-1]))
    # What a difference over a step leaves of each frequency, for the narrow ones in the mean by their sizes.
    left = np.sinc(np.multiply.outer(cycles_per_um, step_um))
    is_narrow = bins.is_narrow[1:] & bins.is_narrow[:-1]
    size = np.abs(rise * weight) * is_narrow
    mean_left = (left @ (size / size.sum()))[:, np.newaxis]
    wave = np.exp(-2j * np.pi * np.multiply.outer(cycles_per_um, at_um))
    kernel = weight * wave * np.where(is_narrow, 1.0 / mean_left, left)
    spectrum, total = kernel @ rise, float(weight @ rise)
    modulus = np.abs(spectrum)
    mtf = modulus / total
    # To first order in the noise of the profile: a bin is the end of one rise and the beginning of the next.
    phase = spectrum.conj() / np.maximum(modulus, np.finfo(float).tiny)
    of_rise = ((phase[:, np.newaxis] * kernel).real - np.multiply.outer(mtf, weight)) / total
    of_bin = -np.diff(of_rise, axis=1, prepend=0.0, append=0.0)
    return mtf, np.sqrt(np.square(of_bin) @ bins.variance)


# -- the edge ------------------------------------------------------------------------------------------------------


class _Edge(NamedTuple):
    """Direction towards white (rad), the edge's distance from the origin in that direction, its width, and its contrast."""

    angle_rad: float
    offset_um: float
    width_um: float
    contrast: float


def _find_edge(xy_um: Floats, values: Floats, pitch_um: float) -> _Edge:
    """The straight edge between black and white that fits best, from sites at (n, 2) points."""
    from scipy.optimize import least_squares
    from scipy.special import erf

    middle_um, extent_um = xy_um.mean(axis=0), float(np.hypot(*np.ptp(xy_um, axis=0)))
    level = _level_between(values)
    is_white = values > level
    n_white = int(np.count_nonzero(is_white))
    if n_white in (0, values.size):
        raise SimulationError("no edge is found: all values are the same")
    black, white = float(np.median(values[~is_white])), float(np.median(values[is_white]))
    # Sites of either kind, told apart by a line as well as may be; so many on its black side as are black.
    xy = (xy_um - middle_um) / extent_um
    towards = np.linalg.solve(np.cov(xy.T), xy.T @ (is_white - is_white.mean()))
    angle = float(np.arctan2(towards[1], towards[0]))
    offset = float(np.quantile(xy @ [np.cos(angle), np.sin(angle)], 1.0 - n_white / values.size))
    share = (values - black) / (white - black)

    def residuals(x: Floats) -> Floats:
        angle, offset, width, low, high = x
        distance = xy @ [np.cos(angle), np.sin(angle)] - offset
        return np.asarray(low + (high - low) * 0.5 * (1.0 + erf(distance / width)) - share)

    start, narrowest = np.array([angle, offset, 0.05, 0.0, 1.0]), 0.01 * pitch_um / extent_um
    bounds = ([-np.inf, -2.0, narrowest, -np.inf, -np.inf], [np.inf, 2.0, 10.0, np.inf, np.inf])
    fit = least_squares(
        residuals, start, bounds=bounds, loss="soft_l1", f_scale=SOFT_SHARE, x_scale=[0.1, 0.1, 0.05, 1, 1]
    )
    angle, offset, width, low, high = fit.x.tolist()
    if high < low:
        angle, offset, low, high = angle + np.pi, -offset, high, low
    explained = 1.0 - float(np.square(residuals(fit.x)).mean()) / float(share.var())
    if explained < LEAST_EXPLAINED:
        raise SimulationError(
            f"no edge is found: a straight edge explains {100.0 * max(explained, 0.0):.0f} % of the values' variance, less "
            f"than {100.0 * LEAST_EXPLAINED:.0f} %; take a region with one edge and less noise"
        )
    if width > WIDEST_SHARE:
        raise SimulationError(
            f"no edge is found: the values rise over {width * extent_um:.4g} µm, more than a quarter of the region"
        )
    low, high = black + (white - black) * low, black + (white - black) * high
    # Of values around 0 a contrast has no meaning.
    contrast = (high - low) / (high + low) if abs(high + low) > NO_SUM * (high - low) else np.inf
    contrast = abs(contrast)
    if contrast < LEAST_CONTRAST:
        raise SimulationError(
            f"the edge has too little contrast: black is {low:.4g} and white {high:.4g}, a contrast of {contrast:.2g}, less "
            f"than {LEAST_CONTRAST:g}"
        )
    angle = float((angle + np.pi) % (2.0 * np.pi) - np.pi)
    direction = np.array([np.cos(angle), np.sin(angle)])
    return _Edge(angle, float(offset * extent_um + middle_um @ direction), float(width * extent_um), contrast)


def _level_between(values: Floats) -> float:
    """The level that parts values best into two kinds (Otsu 1979)."""
    counts, edges = np.histogram(values, N_LEVELS)
    n_below = np.cumsum(counts)
    sums = np.cumsum(counts * 0.5 * (edges[1:] + edges[:-1]))
    n_above = values.size - n_below
    both = (n_below > 0) & (n_above > 0)
    if not both.any():
        return float(edges[-1])
    means = sums / np.maximum(n_below, 1), (sums[-1] - sums) / np.maximum(n_above, 1)
    between = np.where(both, n_below * n_above * (means[1] - means[0]) ** 2, 0.0)
    # Over the gap between the two kinds it is the same everywhere: its middle.
    best = np.flatnonzero(between >= between.max() * (1.0 - 1e-12))
    return float(0.5 * (edges[best[0] + 1] + edges[best[-1] + 1]))


# -- the profile ---------------------------------------------------------------------------------------------------


class _Bins(NamedTuple):
    """Mean distances of the bins' sites, the profile there and its variance, which are narrow, and how many sites there are."""

    distance_um: Floats
    profile: Floats
    variance: Floats
    is_narrow: Bools
    n_sites: int


def _binned(
    distance_um: Floats,
    values: Floats,
    area_um2: Floats,
    bin_um: float,
    reach_um: float | None,
    pitch_um: float,
    width_um: float,
) -> _Bins:
    """Edge spread function: means over bins of the distance from the edge, weighted by area."""
    # Bin 0 begins at the edge.
    k = np.floor(distance_um / bin_um).astype(np.int64)
    first = int(k.min())
    weight = np.bincount(k - first, weights=area_um2)
    empty = np.flatnonzero(weight == 0.0) + first
    # As far as no bin is empty.
    low = int(empty[empty < 0].max(initial=first - 1)) + 1
    high = int(empty[empty >= 0].min(initial=int(k.max()) + 1)) - 1
    n_sides = min(-low, high + 1)
    least_um = max(LEAST_REACH_PITCHES * pitch_um, LEAST_REACH_WIDTHS * width_um)
    if reach_um is not None:
        hint = f"five pitches of {pitch_um:.3g} µm, and twice the edge's width of {width_um:.3g} µm, are the least"
        least_um = check_number("reach_um", reach_um, at_least=float(f"{least_um:.3g}"), hint=hint)
        n_sides = min(n_sides, int(np.ceil(least_um / bin_um)))
    if n_sides * bin_um < least_um * (1.0 - 1e-9):
        far_um = min(-distance_um.min(), distance_um.max())
        raise SimulationError(
            f"the edge's profile has gaps or ends {max(n_sides, 0) * bin_um:.4g} µm from it, before {least_um:.4g} µm: "
            + (
                "the edge is too near to the region's border"
                if far_um < least_um
                else "turn the edge by a few degrees from the rows of sites, take a larger region, or wider bins (bin_um)"
            )
        )
    is_in = (k >= -n_sides) & (k < n_sides)
    n_narrow = int(np.ceil(max(NARROW_PITCHES * pitch_um, NARROW_WIDTHS * width_um) / bin_um))
    borders = _widening_borders(n_narrow, n_sides)
    position = np.searchsorted(borders, k[is_in], side="right") - 1
    weights, value = area_um2[is_in], values[is_in]
    total = np.bincount(position, weights=weights)
    mean_um = np.bincount(position, weights=weights * distance_um[is_in]) / total
    off_um = distance_um[is_in] - mean_um[position]
    variance_um2 = np.bincount(position, weights=weights * np.square(off_um)) / total
    profile = np.bincount(position, weights=weights * value) / total
    # The mean over places that vary about a middle is off from the value there by half the variance times the curvature.
    profile -= 0.5 * variance_um2 * _curvature(mean_um, profile)
    # What values are off from the profile's parabola at their own places is noise.
    slope, bend = np.gradient(profile, mean_um), 0.5 * _curvature(mean_um, profile)
    noise = value - (profile[position] + (slope[position] + bend[position] * off_um) * off_um)
    return _Bins(
        mean_um,
        profile,
        _scatter(noise, position) * np.bincount(position, weights=np.square(weights)) / np.square(total),
        np.maximum(-borders[:-1], borders[1:]) <= n_narrow,
        int(np.count_nonzero(is_in)),
    )


def _widening_borders(n_narrow: int, n_sides: int) -> Ints:
    """Borders of the bins, in narrow ones, from -n_sides to n_sides."""
    side = list(range(min(n_narrow, n_sides) + 1))
    while side[-1] < n_sides:
        step, rest = round(1.0 + max(0.0, WIDENING * (side[-1] - n_narrow))), n_sides - side[-1]
        side.append(side[-1] + (step if rest >= 2 * step else rest))
    return np.concatenate((-np.array(side[:0:-1], np.int64), np.array(side, np.int64)))


def _scatter(values: Floats, position: NDArray[np.intp]) -> Floats:
    """Variance of values about 0 in each bin, told from its neighbours too; NaN where all hold one site alone."""
    around = np.ones(2 * SCATTER_BINS + 1)
    squares = np.convolve(np.pad(np.bincount(position, weights=np.square(values)), SCATTER_BINS), around, "valid")
    freedom = np.convolve(np.pad(np.bincount(position) - 1.0, SCATTER_BINS), around, "valid")
    return np.asarray(squares / np.where(freedom > 0.5, freedom, np.nan))


def _curvature(distance_um: Floats, profile: Floats) -> Floats:
    """Second derivative of the profile at its inner points by second differences, 0 at its ends."""
    step_um, rise = np.diff(distance_um), np.diff(profile)
    slope = rise / step_um
    return np.pad(2.0 * np.diff(slope) / (step_um[1:] + step_um[:-1]), 1)


def _window(window: str, share: Floats) -> Floats:
    """Weights at fractions of the reach, from -1 to 1."""
    share = np.minimum(np.abs(share), 1.0)
    if window == "tukey":
        return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.maximum(2.0 * share - 1.0, 0.0)))
    return 0.54 + 0.46 * np.cos(np.pi * share) if window == "hamming" else np.ones_like(share)

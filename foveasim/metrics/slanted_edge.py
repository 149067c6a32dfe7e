"""
The modulation transfer function (MTF) from a slanted edge, in the manner of ISO 12233, for photosites of any shapes and places.

On a grid the standard projects pixels along the edge, so that rows at slightly different phases make one finely sampled
profile. Nothing of that needs a grid: every site is a sample at its own distance from the edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from foveasim.arrays import (
    Bools,
    Floats,
    as_numbers,
    check_choice,
    check_length_um,
    check_number,
    finite_array,
    read_only,
)
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import Layout
from foveasim.units import per_mm_from_per_um, per_um_from_per_mm

__all__ = ["EdgeMtf", "slanted_edge_mtf"]

#: Bins to a pitch, as the standard has it.
BINS_PER_PITCH = 4
#: Fewer sites tell no edge, and a shorter profile to each side, in pitches, no frequencies.
LEAST_SITES, LEAST_REACH_PITCHES = 50, 5.0
#: (white - black) / (white + black) below which black and white are the same.
LEAST_CONTRAST = 0.02
#: Share of the values' variance that one straight edge must explain.
LEAST_EXPLAINED = 0.3
#: An edge blurred over more than this share of the region is a ramp.
WIDEST_SHARE = 0.25
#: Residuals beyond this share of the step count less and less: a defect, or another edge at the border.
SOFT_SHARE = 0.1
#: Corrections of the differences and bins beyond this are left at it, as the standard does.
MOST_CORRECTION = 10.0
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
    angle_deg : float, degrees
        Of the edge from the vertical, counter-clockwise, from -180 to 180: 0 has white to the right of it, 90 above it.
    offset_um : float, µm
        Distance of the edge from the origin, towards white.
    contrast : float
        (white - black) / (white + black).
    bin_um, pitch_um : float, µm
        Width of a bin, and the reference pitch: the median distance of a site from its nearest neighbour.
    distance_um : (n_bin,) float64, µm
        Mean distance of each bin's sites from the edge, black first.
    profile : (n_bin,) float64
        The edge spread function: mean of each bin's sites, in the unit of the values.
    n_sites : int
        Sites in the bins.
    """

    frequency_per_mm: Floats
    mtf: Floats
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
        Width of the bins of the edge spread function; a quarter of the reference pitch by default.
    reach_um : float, optional, µm
        How far from the edge sites are looked at; by default as far as there are sites in every bin on both sides.
    frequency_per_mm : (n,), optional, 1/mm
        By default from 0 to one line pair a pitch in 100 steps.
    window : {"tukey", "hamming", "none"}
        By which the line spread function is multiplied, to quieten noise far from the edge: flat over the middle half of the
        reach with cosine ends; the bell of the standard's first editions; or none. The narrower the window, the more of the
        light that a lens spreads far is left out, and the higher the MTF comes out.

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

    The MTF is that across the edge, of the sites near it. It contains the sites' own shape (:func:`polygon_mtf`), the lens,
    diffusion between sites, and the chart's own pixels.

    References
    ----------
    ISO 12233:2023, Photography: Electronic still picture imaging: Resolution and spatial frequency responses, annex D (e-SFR).
    """
    site_values = np.asarray(as_numbers("values", values), np.float64)
    if site_values.shape != (layout.n_sites,):
        raise ParameterError("values", f"must be one for each of the {layout.n_sites} sites, got {site_values.shape}")
    is_used = np.isfinite(site_values) & _mask(where, layout.n_sites)
    check_choice("window", window, ("tukey", "hamming", "none"))
    n_used = int(np.count_nonzero(is_used))
    if n_used < LEAST_SITES:
        raise ParameterError("where", f"must leave at least {LEAST_SITES} sites", n_used)
    xy_um, light, area_um2 = layout.centroid_um[is_used], site_values[is_used], layout.area_um2[is_used]
    pitch_um = _pitch_um(xy_um)
    bin_um = pitch_um / BINS_PER_PITCH if bin_um is None else check_length_um("bin_um", bin_um)
    edge = _find_edge(xy_um, light, pitch_um)
    across = np.array([np.cos(edge.angle_rad), np.sin(edge.angle_rad)])
    bins = _binned(xy_um @ across - edge.offset_um, light, area_um2, bin_um, reach_um, pitch_um)

    line_spread = np.diff(bins.profile)
    at_um = 0.5 * (bins.distance_um[1:] + bins.distance_um[:-1])
    line_spread *= _window(window, at_um / max(-bins.distance_um[0], bins.distance_um[-1]))
    if frequency_per_mm is None:
        frequency = per_mm_from_per_um(np.linspace(0.0, 1.0 / pitch_um, N_FREQUENCIES))
    else:
        frequency = np.atleast_1d(finite_array("frequency_per_mm", frequency_per_mm, at_least=0.0)).copy()
    cycles = per_um_from_per_mm(frequency)
    spectrum = np.exp(-2j * np.pi * np.multiply.outer(cycles, at_um)) @ line_spread
    # What a difference over a step leaves of each frequency, mean over the differences by their sizes.
    size = np.abs(line_spread) / np.abs(line_spread).sum()
    left = np.sinc(np.multiply.outer(cycles, np.diff(bins.distance_um))) @ size
    correction = 1.0 / np.maximum(left, 1.0 / MOST_CORRECTION)
    return EdgeMtf(
        frequency_per_mm=read_only(frequency),
        mtf=read_only(np.abs(spectrum) / line_spread.sum() * correction),
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
    mask = np.asarray(where)
    if mask.dtype != bool or mask.shape != (n_sites,):
        raise ParameterError(
            "where", f"must be a mask of the {n_sites} sites, got {mask.dtype} of the shape {mask.shape}"
        )
    return mask


def _pitch_um(xy_um: Floats) -> float:
    from scipy.spatial import cKDTree

    return float(np.median(cKDTree(xy_um).query(xy_um, k=[2])[0]))


# -- the edge ------------------------------------------------------------------------------------------------------


class _Edge(NamedTuple):
    """Direction towards white (rad), the edge's distance from the origin in that direction, and its contrast."""

    angle_rad: float
    offset_um: float
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
    contrast = (high - low) / max(abs(high + low), np.finfo(float).tiny)
    if contrast < LEAST_CONTRAST:
        raise SimulationError(
            f"the edge has too little contrast: black is {low:.4g} and white {high:.4g}, a contrast of {contrast:.2g}, less "
            f"than {LEAST_CONTRAST:g}"
        )
    angle = float((angle + np.pi) % (2.0 * np.pi) - np.pi)
    direction = np.array([np.cos(angle), np.sin(angle)])
    return _Edge(angle, float(offset * extent_um + middle_um @ direction), contrast)


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
    """Mean distances of the bins' sites, the profile there, and how many sites there are."""

    distance_um: Floats
    profile: Floats
    n_sites: int


def _binned(
    distance_um: Floats, values: Floats, area_um2: Floats, bin_um: float, reach_um: float | None, pitch_um: float
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
    if reach_um is None:
        least_um = LEAST_REACH_PITCHES * pitch_um
    else:
        least_um = check_number("reach_um", reach_um, at_least=2.0 * bin_um)
        n_sides = min(n_sides, int(np.ceil(least_um / bin_um)))
    if n_sides * bin_um < min(least_um, reach_um or np.inf) * (1.0 - 1e-9):
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
    position, weights = k[is_in] + n_sides, area_um2[is_in]
    total = np.bincount(position, weights=weights)
    mean_um = np.bincount(position, weights=weights * distance_um[is_in]) / total
    variance_um2 = np.bincount(position, weights=weights * np.square(distance_um[is_in] - mean_um[position])) / total
    profile = np.bincount(position, weights=weights * values[is_in]) / total
    # The mean over places that vary about a middle is off from the value there by half the variance times the curvature.
    profile -= 0.5 * variance_um2 * _curvature(mean_um, profile)
    return _Bins(mean_um, profile, int(np.count_nonzero(is_in)))


def _curvature(distance_um: Floats, profile: Floats) -> Floats:
    """Second derivative of the profile at its inner points by second differences, 0 at its ends."""
    step_um, rise = np.diff(distance_um), np.diff(profile)
    slope = rise / step_um
    return np.pad(2.0 * np.diff(slope) / (step_um[1:] + step_um[:-1]), 1)


def _window(window: str, share: Floats) -> Floats:
    """Weights at shares of the reach, from -1 to 1."""
    share = np.minimum(np.abs(share), 1.0)
    if window == "tukey":
        return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.maximum(2.0 * share - 1.0, 0.0)))
    return 0.54 + 0.46 * np.cos(np.pi * share) if window == "hamming" else np.ones_like(share)

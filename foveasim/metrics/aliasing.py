"""
Aliasing: which false frequencies a layout's sites make of a sine that is too fine for them.

A site's value is a sample at its centroid. The transform of samples is the true spectrum convolved with that of the sampling
points: a lattice has one as strong as the true one at every point of its reciprocal lattice, so that a fine sine comes back
whole as a coarse one. Points without order spread it as noise, and good ones of these leave the low frequencies clean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import (
    Floats,
    check_choice,
    check_count,
    check_length_um,
    check_number,
    finite_array,
    read_only,
)
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.metrics.pixel_mtf import polygon_otf
from foveasim.metrics.sampling import nyquist_per_mm, require_layout
from foveasim.units import per_mm_from_per_um, per_um_from_per_mm

__all__ = ["AliasingSpectrum", "SamplingSpectrum", "aliasing_spectrum", "sampling_spectrum"]

#: Steps of the spectrum to the inverse of the region's diameter: a peak of the window is some four steps wide.
STEPS = 2
#: Frequencies to a side, at most: 2 GB at work.
MOST_FREQUENCIES = 4096
#: Highest frequency by default, in median Nyquist frequencies: a lattice's first ring of peaks is at 2.
REACH_NYQUISTS = 4.0
#: Fewer sites have no spectrum to speak of.
LEAST_SITES = 16
#: The transform of points off a grid: width of the spreading kernel in cells of a grid twice as fine, and its shape (Barnett,
#: Magland, af Klinteberg 2019, "exponential of semicircle"): right to 1e-7 of the sum of the weights.
SPREAD_CELLS, SPREAD_SHAPE = 8, 2.30 * 8
#: Points spread together: what bounds the memory.
BLOCK_POINTS = 1 << 16
#: A peak with its first ring ends at this many inverse radii of the disc: beyond, cos² over a disc has a transform below 0.6 %.
PEAK_RADII = 1.6
#: Rounds of refining the place of a peak, each a quarter of the last one's step.
N_REFINED = 4


class _Region(NamedTuple):
    """Sites within a disc: places from its centre, weights that fall smoothly to 0 at its border, and its radius."""

    sites: NDArray[np.int64]
    xy_um: Floats
    weight: Floats
    radius_um: float


@dataclass(frozen=True, eq=False, kw_only=True)
class SamplingSpectrum:
    """
    Spectrum of the sampling points within a disc.

    Attributes
    ----------
    frequency_per_mm : (n,) float64, 1/mm
        Of rows and columns, line pairs per mm, 0 in the middle.
    power : (n, n) float64
        ``|Σ w exp(-2πi f·x)|² / Σ w²`` at [fy, fx], w the window: 1 on average for points by chance (Poisson), and
        ``(Σ w)² / Σ w²`` at the peaks of a lattice, which is about half the number of sites: those at the border weigh
        little. The peak at 0 is a disc of the radius ``peak_per_mm``.
    nyquist_per_mm : float, 1/mm
        Median of the region's sites.
    peak_per_mm : float, 1/mm
        Radius of a peak: what the window makes of a point.
    n_sites : int
    """

    frequency_per_mm: Floats
    power: Floats
    nyquist_per_mm: float
    peak_per_mm: float
    n_sites: int

    def radial(self, n_bins: int = 64) -> tuple[Floats, Floats, Floats]:
        """
        Mean over all directions, and how much directions differ.

        Parameters
        ----------
        n_bins : int

        Returns
        -------
        frequency_per_mm : (n_bins,) float64, 1/mm
            Middles of rings from 0 to the highest frequency; the first ones hold the peak at 0.
        power, anisotropy : (n_bins,) float64
            Mean, and variance over the mean squared: about 1 for points without order, more for lattices. NaN in empty rings.

        Raises
        ------
        ParameterError
            When the number is not an integer from 1 to 4096.
        """
        n_bins = check_count("n_bins", n_bins, at_most=MOST_FREQUENCIES)
        f = self.frequency_per_mm
        r = np.hypot(f, f[:, np.newaxis]).ravel()
        edges = np.linspace(0.0, f[-1], n_bins + 1)
        position = np.searchsorted(edges, r, side="right") - 1
        is_in = position < n_bins
        position, power = position[is_in], self.power.ravel()[is_in]
        n = np.bincount(position, minlength=n_bins).astype(np.float64)
        n[n == 0.0] = np.nan
        mean = np.bincount(position, weights=power, minlength=n_bins) / n
        square = np.bincount(position, weights=power * power, minlength=n_bins) / n
        return 0.5 * (edges[1:] + edges[:-1]), mean, square / mean**2 - 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class AliasingSpectrum:
    """
    What a layout makes of one sine wave.

    Attributes
    ----------
    wave_per_mm : (2,) float64, 1/mm
        The wave's vector.
    frequency_per_mm : (n,) float64, 1/mm
        Of rows and columns, line pairs per mm, 0 in the middle.
    amplitude : (n, n) float64
        Contrast at [fy, fx] in what the sites tell of a wave ``exp(2πi q·x)`` of contrast 1, sites weighted by their area
        and a smooth window.
    nyquist_per_mm, peak_per_mm : float, 1/mm
        Median of the region's sites, and the radius of a peak.
    baseband_fraction : float
        Contrast at the wave's own frequency: the pixels' MTF.
    alias_fraction : float
        Highest contrast at another frequency up to the Nyquist frequency: the alias that is seen.
    alias_per_mm : (2,) float64, 1/mm
        Where it is.
    noise_fraction : float
        Fraction of the samples' power at other frequencies up to the Nyquist frequency, the alias included; the power of the
        samples is spread over one reciprocal cell of them.
    """

    wave_per_mm: Floats
    frequency_per_mm: Floats
    amplitude: Floats
    nyquist_per_mm: float
    peak_per_mm: float
    baseband_fraction: float
    alias_fraction: float
    alias_per_mm: Floats
    noise_fraction: float


def sampling_spectrum(
    layout: Layout,
    *,
    centre_um: tuple[float, float] | None = None,
    radius_um: float | None = None,
    max_per_mm: float | None = None,
    weights: Literal["sites", "area"] = "sites",
) -> SamplingSpectrum:
    """
    Spectrum of a layout's sampling points: their structure factor.

    Parameters
    ----------
    layout : Layout
        For one filter of a mosaic: ``layout[layout.channel == 1]``.
    centre_um : (x, y), optional, µm
        Of the disc that is looked at; by default the middle of the layout.
    radius_um : float, optional, µm
        Half the shorter side of the layout by default. Sites differ in size all over a foveal layout: take a disc in which
        they do not.
    max_per_mm : float, optional, 1/mm
        Highest frequency along x and y; by default four times the sites' median Nyquist frequency.
    weights : {"sites", "area"}
        Whether all sites count alike, or by their area.

    Returns
    -------
    SamplingSpectrum

    Raises
    ------
    ParameterError
        When an argument is out of range, there are fewer than 16 sites in the disc, or too many frequencies.

    Notes
    -----
    Sites are weighted by ``cos²(π r / 2R)``, so that the disc's border makes no rings. Frequencies are half the inverse of its
    diameter apart: no peak falls between. The sum over sites is a fast Fourier transform of points spread on a grid, right to
    1e-7 of the largest amplitude.
    """
    check_choice("weights", weights, ("sites", "area"))
    region = _region(layout, centre_um, radius_um)
    weight = region.weight * (layout.area_um2[region.sites] if weights == "area" else 1.0)
    nyquist = _median_nyquist_per_mm(layout, region)
    frequency = _frequencies_per_mm(region, nyquist, max_per_mm)
    sums = _point_transform(region.xy_um, weight, frequency)
    return SamplingSpectrum(
        frequency_per_mm=read_only(frequency),
        power=read_only((sums.real**2 + sums.imag**2) / np.square(weight).sum()),
        nyquist_per_mm=nyquist,
        peak_per_mm=_peak_per_mm(region),
        n_sites=region.sites.size,
    )


def aliasing_spectrum(
    layout: Layout,
    wave_per_mm: tuple[float, float],
    *,
    centre_um: tuple[float, float] | None = None,
    radius_um: float | None = None,
    max_per_mm: float | None = None,
) -> AliasingSpectrum:
    """
    How much of a sine wave's contrast comes back at false frequencies.

    Parameters
    ----------
    layout : Layout
    wave_per_mm : (fx, fy), 1/mm
        Wave vector of the sine, line pairs per mm on the sensor along x and y.
    centre_um, radius_um
        As for :func:`sampling_spectrum`.
    max_per_mm : float, optional, 1/mm
        Highest frequency along x and y; by default four times the sites' median Nyquist frequency.

    Returns
    -------
    AliasingSpectrum

    Raises
    ------
    ParameterError
        As for :func:`sampling_spectrum`.

    Notes
    -----
    Each site gives the mean of the wave over its polygon (:func:`polygon_otf`), exactly.
    """
    wave = finite_array("wave_per_mm", wave_per_mm, ndim=1)
    if wave.size != 2:
        raise ParameterError("wave_per_mm", "must be two numbers (fx, fy)", wave_per_mm, "1/mm")
    region = _region(layout, centre_um, radius_um)
    weight = region.weight * layout.area_um2[region.sites]
    weight /= weight.sum()
    nyquist, peak = _median_nyquist_per_mm(layout, region), _peak_per_mm(region)
    frequency = _frequencies_per_mm(region, nyquist, max_per_mm)
    # The mean over a site is the wave at its centroid, times the site's transfer at the opposite frequency.
    otf = polygon_otf(layout[region.sites], -wave[np.newaxis])[:, 0]
    sample = weight * otf * np.exp(2j * np.pi * (region.xy_um @ per_um_from_per_mm(wave)))
    amplitude = np.abs(_point_transform(region.xy_um, sample, frequency))

    fx, fy = np.meshgrid(frequency, frequency)
    is_false = (np.hypot(fx, fy) <= nyquist) & (np.hypot(fx - wave[0], fy - wave[1]) > peak)
    false, at = 0.0, np.full(2, np.nan)
    if is_false.any():
        best = np.unravel_index(np.where(is_false, amplitude, -1.0).argmax(), amplitude.shape)
        first = np.array([frequency[best[1]], frequency[best[0]]])
        false, at = _refined(region.xy_um, sample, first, float(frequency[1] - frequency[0]), wave, peak)
    # Parseval: the mean of |amplitude|² over a reciprocal cell of the sites, of the area of their density, is Σ |sample|².
    step = per_um_from_per_mm(float(frequency[1] - frequency[0]))
    power = float(np.square(amplitude[is_false]).sum() * step**2)
    density_per_um2 = float(region.weight.sum() / (region.weight * layout.area_um2[region.sites]).sum())
    own = float(np.square(np.abs(sample)).sum()) * density_per_um2
    return AliasingSpectrum(
        wave_per_mm=read_only(wave.copy()),
        frequency_per_mm=read_only(frequency),
        amplitude=read_only(amplitude),
        nyquist_per_mm=nyquist,
        peak_per_mm=peak,
        baseband_fraction=float(np.abs(np.sum(weight * otf))),
        alias_fraction=false,
        alias_per_mm=read_only(at),
        noise_fraction=power / own,
    )


def _region(layout: Layout, centre_um: tuple[float, float] | None, radius_um: float | None) -> _Region:
    require_layout(layout)
    if layout.n_sites == 0:
        raise ParameterError("layout", "must have sites")
    x_min, y_min, x_max, y_max = layout.bounds_um
    centre = np.array([0.5 * (x_min + x_max), 0.5 * (y_min + y_max)])
    if centre_um is not None:
        centre = finite_array("centre_um", centre_um, ndim=1)
        if centre.size != 2:
            raise ParameterError("centre_um", "must be two numbers (x, y)", centre_um, "µm")
    radius_um = 0.5 * min(x_max - x_min, y_max - y_min) if radius_um is None else radius_um
    radius_um = check_length_um("radius_um", radius_um)
    xy_um = layout.centroid_um - centre
    r_um = np.hypot(*xy_um.T)
    sites = np.flatnonzero(r_um < radius_um)
    if sites.size < LEAST_SITES:
        raise ParameterError(
            "radius_um", f"must take in at least {LEAST_SITES} sites, takes in {sites.size}", radius_um, "µm"
        )
    return _Region(sites, xy_um[sites], np.cos(0.5 * np.pi * r_um[sites] / radius_um) ** 2, radius_um)


def _median_nyquist_per_mm(layout: Layout, region: _Region) -> float:
    nyquist = nyquist_per_mm(layout[region.sites])
    if not np.isfinite(nyquist).any():
        raise ParameterError("layout", "must have sites in more than one row")
    return float(np.nanmedian(nyquist))


def _peak_per_mm(region: _Region) -> float:
    return float(per_mm_from_per_um(PEAK_RADII / region.radius_um))


def _frequencies_per_mm(region: _Region, limit_per_mm: float, max_per_mm: float | None) -> Floats:
    """Equal steps from -max to max, 0 among them."""
    highest = REACH_NYQUISTS * limit_per_mm if max_per_mm is None else check_number("max_per_mm", max_per_mm, above=0.0)
    step = float(per_mm_from_per_um(1.0 / (STEPS * 2.0 * region.radius_um)))
    n = int(np.ceil(highest / step * (1.0 - 1e-12)))
    if 2 * n + 1 > MOST_FREQUENCIES:
        raise ParameterError(
            "max_per_mm",
            f"must be at most {MOST_FREQUENCIES // 2 * step:.4g} for a region of this size",
            highest,
            "1/mm",
            "take a smaller radius_um or max_per_mm",
        )
    return step * np.arange(-n, n + 1, dtype=np.float64)


# -- transforms of points --------------------------------------------------------------------------------------------


def _point_transform(xy_um: Floats, weight: NDArray[np.inexact], frequency_per_mm: Floats) -> NDArray[np.complex128]:
    """
    ``Σ w exp(-2πi f·x)`` of points (n, 2) at all pairs of some frequencies around 0 in equal steps, (n_f, n_f) at [fy, fx].

    Points must lie within half the inverse of the step from 0. Each is spread over some cells of a fine grid by a smooth
    kernel, the grid is transformed, and the kernel's own transform divided out.
    """
    import scipy.fft

    n_half = frequency_per_mm.size // 2
    step = float(per_um_from_per_mm(frequency_per_mm[1] - frequency_per_mm[0]))
    n_grid = scipy.fft.next_fast_len(max(4 * n_half + 2, 2 * SPREAD_CELLS))
    cells = np.zeros(n_grid * n_grid, np.complex128)
    for start in range(0, len(xy_um), BLOCK_POINTS):
        part = slice(start, start + BLOCK_POINTS)
        # In cells of the grid, one period of which is the inverse of the step.
        place = xy_um[part] * (step * n_grid)
        first = np.ceil(place - 0.5 * SPREAD_CELLS).astype(np.int64)
        near = first[..., np.newaxis] + np.arange(SPREAD_CELLS)
        share = _semicircle((near - place[..., np.newaxis]) / (0.5 * SPREAD_CELLS))
        column, row = near[:, 0] % n_grid, near[:, 1] % n_grid
        position = (row[:, :, np.newaxis] * n_grid + column[:, np.newaxis, :]).ravel()
        spread = (
            weight[part, np.newaxis, np.newaxis] * share[:, 1, :, np.newaxis] * share[:, 0, np.newaxis, :]
        ).ravel()
        cells += np.bincount(position, weights=spread.real, minlength=cells.size)
        if np.iscomplexobj(spread):
            cells += 1j * np.bincount(position, weights=spread.imag, minlength=cells.size)
    whole = scipy.fft.fft2(cells.reshape(n_grid, n_grid), overwrite_x=True)
    modes = np.arange(-n_half, n_half + 1)
    nodes, node_weights = np.polynomial.legendre.leggauss(64)
    waves = np.cos(np.pi * SPREAD_CELLS / n_grid * np.multiply.outer(modes, nodes))
    kernel = 0.5 * SPREAD_CELLS * (waves @ (node_weights * _semicircle(nodes)))
    return np.asarray(whole[np.ix_(modes % n_grid, modes % n_grid)] / np.multiply.outer(kernel, kernel))


def _semicircle(share: Floats) -> Floats:
    """The spreading kernel at fractions of its half width: close to the narrowest in space and frequency at once."""
    return np.asarray(
        np.exp(SPREAD_SHAPE * (np.sqrt(np.maximum(1.0 - share * share, 0.0)) - 1.0)) * (np.abs(share) <= 1.0)
    )


def _refined(
    xy_um: Floats,
    sample: NDArray[np.complex128],
    at_per_mm: Floats,
    step_per_mm: float,
    wave_per_mm: Floats,
    peak_per_mm: float,
) -> tuple[float, Floats]:
    """Height and place of a peak near a frequency and off the wave's own, by direct sums on finer and finer grids."""
    height, half_per_mm = 0.0, 0.5 * step_per_mm
    for _ in range(N_REFINED):
        off = half_per_mm * np.arange(-2, 3)
        near = at_per_mm + np.stack(np.meshgrid(off, off), axis=-1).reshape(-1, 2)
        # The middle one is off the wave's peak, so there is always one.
        near = near[np.hypot(*(near - wave_per_mm).T) >= peak_per_mm]
        sums = np.array([abs(np.exp(-2j * np.pi * (xy_um @ f)) @ sample) for f in per_um_from_per_mm(near)])
        at_per_mm, height = near[sums.argmax()], float(sums.max())
        half_per_mm *= 0.25
    return height, at_per_mm

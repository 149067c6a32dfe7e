"""
Aliasing: spectra of sampling points, and alias frequencies of sine waves.

The value of a site is a sample at its centroid. The transform of the samples is the signal spectrum convolved with the
spectrum of the sampling points. A lattice has a replica of full strength at each point of its reciprocal lattice, so that a
sine above the Nyquist frequency appears with full contrast at a lower one. Disordered points spread its power as noise;
blue-noise points leave low frequencies free of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import POSITIVE, Limits
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import (
    Floats,
    check_length_um,
    check_point,
    finite_array,
    read_only,
)
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.metrics.pixel_mtf import polygon_otf
from foveasim.metrics.sampling import nyquist_per_mm
from foveasim.units import per_mm_from_per_um, per_um_from_per_mm

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["AliasingSpectrum", "SamplingSpectrum", "aliasing_spectrum", "sampling_spectrum"]

#: Frequency steps per inverse diameter of the region; a peak of the window is approximately four steps wide.
STEPS_PER_INVERSE_DIAMETER = 2
#: Largest number of frequencies per axis; requires 2 GB of memory.
MAX_FREQUENCIES = 4096
#: Default highest frequency in median Nyquist frequencies; the first peaks of a lattice are at 2.
DEFAULT_MAX_NYQUISTS = 4.0
#: Lowest contrast in plots.
MIN_CONTRAST = 1e-4
#: Minimum number of sites for a spectrum.
MIN_SITES = 16
#: Nonuniform FFT: width of the spreading kernel in cells of a grid with twofold oversampling, and its shape parameter (Barnett,
#: Magland, af Klinteberg 2019, "exponential of semicircle"). The error is 1e-7 of the sum of the weights.
SPREAD_CELLS, SPREAD_SHAPE = 8, 2.30 * 8
#: Points per block; limits the memory.
BLOCK_POINTS = 1 << 16
#: Radius of a peak with its first ring, in inverse radii of the disc; beyond it, the transform of cos² is below 0.6 %.
PEAK_RADII = 1.6
#: Iterations that refine the position of a peak; the step is divided by 4 in each.
N_REFINEMENTS = 4


class _Region(NamedTuple):
    """Sites within a disc: positions from its centre, window weights, and radius."""

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
        Frequencies of rows and columns in line pairs per mm, 0 at the centre.
    power : (n, n) float64
        ``|Σ w exp(-2πi f·x)|² / Σ w²`` at [fy, fx] for the window w: 1 on average for random (Poisson) points, and
        ``(Σ w)² / Σ w²`` at the peaks of a lattice. This is approximately half the number of sites, because sites near the
        boundary have small weights. The peak at 0 is a disc of the radius ``peak_per_mm``.
    nyquist_per_mm : float, 1/mm
        Median Nyquist frequency of the sites in the region.
    peak_per_mm : float, 1/mm
        Radius of a peak, given by the transform of the window.
    n_sites : int
    """

    frequency_per_mm: Floats
    power: Floats
    nyquist_per_mm: float
    peak_per_mm: float
    n_sites: int

    __repr__ = short_repr

    def plot(self, *, ax: Axes | None = None) -> Axes:
        """Draw the radial mean of the power (:meth:`radial`) on matplotlib axes."""
        from foveasim.view import plot_curves

        frequency_per_mm, power, _ = self.radial()
        labels = "frequency / (line pairs per mm)", "mean power"
        return plot_curves({"": (frequency_per_mm, power)}, *labels, logarithmic="y", ax=ax)

    def radial(
        self, n_bins: Annotated[int, Limits(at_least=1, at_most=MAX_FREQUENCIES)] = 64
    ) -> tuple[Floats, Floats, Floats]:
        """
        Compute the radial mean and the anisotropy of the power.

        Parameters
        ----------
        n_bins : int

        Returns
        -------
        frequency_per_mm : (n_bins,) float64, 1/mm
            Centres of rings from 0 to the highest frequency; the first rings contain the peak at 0.
        power, anisotropy : (n_bins,) float64
            Mean, and variance over squared mean: approximately 1 for random points, more for lattices. NaN in empty rings.

        Raises
        ------
        ParameterError
            When ``n_bins`` is not an integer from 1 to 4096.
        """
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
    Spectrum of a sine wave sampled by a layout.

    Attributes
    ----------
    wave_per_mm : (2,) float64, 1/mm
        Wave vector.
    frequency_per_mm : (n,) float64, 1/mm
        Frequencies of rows and columns in line pairs per mm, 0 at the centre.
    amplitude : (n, n) float64
        Contrast at [fy, fx] of the sampled wave ``exp(2πi q·x)`` of contrast 1, with sites weighted by their area and a
        smooth window.
    nyquist_per_mm, peak_per_mm : float, 1/mm
        Median Nyquist frequency of the sites in the region, and the radius of a peak.
    baseband_fraction : float
        Contrast at the frequency of the wave; equals the aperture MTF of the sites.
    alias_fraction : float
        Highest contrast at any other frequency up to the Nyquist frequency: the visible alias.
    alias_per_mm : (2,) float64, 1/mm
        Frequency vector of the alias.
    noise_fraction : float
        Power at other frequencies up to the Nyquist frequency, alias included, as a fraction of the power of the samples over
        one cell of their reciprocal lattice.
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

    __repr__ = short_repr

    def plot(self, *, ax: Axes | None = None) -> Axes:
        """Draw the contrast in dB, a circle at the Nyquist frequency, and wave and alias."""
        from matplotlib.patches import Circle

        from foveasim.view import plot_image

        half = self.frequency_per_mm[-1] + 0.5 * (self.frequency_per_mm[1] - self.frequency_per_mm[0])
        contrast_db = 20.0 * np.log10(np.maximum(self.amplitude, MIN_CONTRAST))
        labels = "$f_x$ / (line pairs per mm)", "$f_y$ / (line pairs per mm)"
        ax = plot_image(contrast_db, (-half, -half, half, half), *labels, label="contrast / dB", ax=ax)
        ax.add_patch(
            Circle((0.0, 0.0), self.nyquist_per_mm, fill=False, color="white", linestyle="--", label="Nyquist")
        )
        for name, at_per_mm, marker in (("wave", self.wave_per_mm, "s"), ("alias", self.alias_per_mm, "o")):
            ax.plot(*at_per_mm, marker, ms=12, mfc="none", mec="white", ls="none", label=name)
        ax.legend(facecolor="#606060", labelcolor="white")
        return ax


def sampling_spectrum(
    layout: Layout,
    *,
    centre_um: tuple[float, float] | None = None,
    radius_um: float | None = None,
    max_per_mm: Annotated[float | None, POSITIVE] = None,
    weights: Literal["sites", "area"] = "sites",
) -> SamplingSpectrum:
    """
    Compute the power spectrum (structure factor) of the sampling points of a layout.

    Parameters
    ----------
    layout : Layout
        For one filter of a mosaic: ``layout[layout.channel == 1]``.
    centre_um : (x, y), optional, µm
        Centre of the analysed disc; by default the centre of the layout.
    radius_um : float, optional, µm
        Radius of the disc; by default half the shorter side of the layout. In a foveal layout, choose a disc with sites of
        similar size.
    max_per_mm : float, optional, 1/mm
        Highest frequency along x and y; by default four times the median Nyquist frequency of the sites.
    weights : {"sites", "area"}
        Whether sites have equal weights or are weighted by area.

    Returns
    -------
    SamplingSpectrum

    Raises
    ------
    ParameterError
        When an argument is out of range, the disc contains fewer than 16 sites, or there are too many frequencies.

    Notes
    -----
    Sites are weighted by the window ``cos²(π r / 2R)``, which suppresses rings from the boundary of the disc. The frequency
    step is half the inverse diameter, so that no peak is missed. The sum over sites is a nonuniform fast Fourier transform with
    an error of 1e-7 of the largest amplitude.

    Examples
    --------
    >>> import foveasim as fs
    >>> spectrum = fs.metrics.sampling_spectrum(
    ...     fs.layout.grid(n_x=32, n_y=32, pitch_um=5.0)
    ... )
    >>> type(spectrum).__name__, spectrum.power.ndim
    ('SamplingSpectrum', 2)
    """
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
    max_per_mm: Annotated[float | None, POSITIVE] = None,
) -> AliasingSpectrum:
    """
    Compute the contrast of a sine wave at its own and at alias frequencies.

    Parameters
    ----------
    layout : Layout
    wave_per_mm : (fx, fy), 1/mm
        Wave vector of the sine, line pairs per mm on the sensor along x and y.
    centre_um, radius_um
        As for :func:`sampling_spectrum`.
    max_per_mm : float, optional, 1/mm
        Highest frequency along x and y; by default four times the median Nyquist frequency of the sites.

    Returns
    -------
    AliasingSpectrum

    Raises
    ------
    ParameterError
        As for :func:`sampling_spectrum`.

    Notes
    -----
    Each site measures the exact mean of the wave over its polygon (:func:`polygon_otf`).

    The disc should contain sites of similar size. Over a complete foveal layout, the spectrum is a mean over regions with
    different aliases: these are spread over many frequencies, so that ``alias_fraction`` is far below that of each region, and
    the median Nyquist frequency is far above that of the outer sites.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(
    ...     n_x=32, n_y=32, pitch_um=5.0
    ... )  # Nyquist frequency 100 per mm
    >>> found = fs.metrics.aliasing_spectrum(layout, (140.0, 0.0))
    >>> round(float(found.alias_per_mm.flat[0]))  # 140 - 200
    -60
    """
    wave = finite_array("wave_per_mm", wave_per_mm)
    region = _region(layout, centre_um, radius_um)
    weight = region.weight * layout.area_um2[region.sites]
    weight /= weight.sum()
    nyquist, peak = _median_nyquist_per_mm(layout, region), _peak_per_mm(region)
    frequency = _frequencies_per_mm(region, nyquist, max_per_mm)
    # The mean over a site is the wave at its centroid, times the OTF of the site at the opposite frequency.
    otf = polygon_otf(layout[region.sites], -wave[np.newaxis])[:, 0]
    sample = weight * otf * np.exp(2j * np.pi * (region.xy_um @ per_um_from_per_mm(wave)))
    amplitude = np.abs(_point_transform(region.xy_um, sample, frequency))

    fx, fy = np.meshgrid(frequency, frequency)
    is_alias = (np.hypot(fx, fy) <= nyquist) & (np.hypot(fx - wave[0], fy - wave[1]) > peak)
    alias, alias_at = 0.0, np.full(2, np.nan)
    if is_alias.any():
        best = np.unravel_index(np.where(is_alias, amplitude, -1.0).argmax(), amplitude.shape)
        first = np.array([frequency[best[1]], frequency[best[0]]])
        alias, alias_at = _refine_peak(region.xy_um, sample, first, float(frequency[1] - frequency[0]), wave, peak)
    # Parseval: the mean of |amplitude|² over a reciprocal cell, whose area is the site density, is Σ |sample|².
    step = per_um_from_per_mm(float(frequency[1] - frequency[0]))
    power = float(np.square(amplitude[is_alias]).sum() * step**2)
    density_per_um2 = float(region.weight.sum() / (region.weight * layout.area_um2[region.sites]).sum())
    total = float(np.square(np.abs(sample)).sum()) * density_per_um2
    return AliasingSpectrum(
        wave_per_mm=read_only(wave.copy()),
        frequency_per_mm=read_only(frequency),
        amplitude=read_only(amplitude),
        nyquist_per_mm=nyquist,
        peak_per_mm=peak,
        baseband_fraction=float(np.abs(np.sum(weight * otf))),
        alias_fraction=alias,
        alias_per_mm=read_only(alias_at),
        noise_fraction=power / total,
    )


def _region(layout: Layout, centre_um: tuple[float, float] | None, radius_um: float | None) -> _Region:
    if layout.n_sites == 0:
        raise ParameterError("layout", "must have at least one site")
    x_min, y_min, x_max, y_max = layout.bounds_um
    centre = np.array([0.5 * (x_min + x_max), 0.5 * (y_min + y_max)])
    if centre_um is not None:
        centre = np.array(check_point("centre_um", centre_um))
    radius_um = 0.5 * min(x_max - x_min, y_max - y_min) if radius_um is None else radius_um
    radius_um = check_length_um("radius_um", radius_um)
    xy_um = layout.centroid_um - centre
    r_um = np.hypot(*xy_um.T)
    sites = np.flatnonzero(r_um < radius_um)
    if sites.size < MIN_SITES:
        raise ParameterError(
            "radius_um", f"must enclose at least {MIN_SITES} sites, encloses {sites.size}", radius_um, "µm"
        )
    return _Region(sites, xy_um[sites], np.cos(0.5 * np.pi * r_um[sites] / radius_um) ** 2, radius_um)


def _median_nyquist_per_mm(layout: Layout, region: _Region) -> float:
    nyquist = nyquist_per_mm(layout[region.sites])
    if not np.isfinite(nyquist).any():
        raise ParameterError("layout", "must have sites in more than one row within the region")
    return float(np.nanmedian(nyquist))


def _peak_per_mm(region: _Region) -> float:
    return float(per_mm_from_per_um(PEAK_RADII / region.radius_um))


def _frequencies_per_mm(region: _Region, limit_per_mm: float, max_per_mm: float | None) -> Floats:
    """Return equally spaced frequencies from -max to max, including 0."""
    highest = DEFAULT_MAX_NYQUISTS * limit_per_mm if max_per_mm is None else max_per_mm
    step = float(per_mm_from_per_um(1.0 / (STEPS_PER_INVERSE_DIAMETER * 2.0 * region.radius_um)))
    n = int(np.ceil(highest / step * (1.0 - 1e-12)))
    if 2 * n + 1 > MAX_FREQUENCIES:
        raise ParameterError(
            "max_per_mm",
            f"must be at most {MAX_FREQUENCIES // 2 * step:.4g} for a region of this size",
            highest,
            "1/mm",
            "reduce radius_um or max_per_mm",
        )
    return step * np.arange(-n, n + 1, dtype=np.float64)


# -- transforms of points --------------------------------------------------------------------------------------------


def _point_transform(xy_um: Floats, weight: NDArray[np.inexact], frequency_per_mm: Floats) -> NDArray[np.complex128]:
    """
    Compute ``Σ w exp(-2πi f·x)`` of points (n, 2) by a nonuniform FFT.

    The frequencies are equally spaced around 0; the result is (n_f, n_f) at [fy, fx]. Points must lie within half the inverse
    frequency step from 0. Each point is spread over cells of a fine grid by a smooth kernel, the grid is transformed, and the
    transform of the kernel is divided out.
    """
    import scipy.fft

    n_half = frequency_per_mm.size // 2
    step = float(per_um_from_per_mm(frequency_per_mm[1] - frequency_per_mm[0]))
    n_grid = scipy.fft.next_fast_len(max(4 * n_half + 2, 2 * SPREAD_CELLS))
    cells = np.zeros(n_grid * n_grid, np.complex128)
    for start in range(0, len(xy_um), BLOCK_POINTS):
        part = slice(start, start + BLOCK_POINTS)
        # Positions in grid cells; the period of the grid is the inverse frequency step.
        position_cells = xy_um[part] * (step * n_grid)
        first = np.ceil(position_cells - 0.5 * SPREAD_CELLS).astype(np.int64)
        near = first[..., np.newaxis] + np.arange(SPREAD_CELLS)
        factors = _spreading_kernel((near - position_cells[..., np.newaxis]) / (0.5 * SPREAD_CELLS))
        column, row = near[:, 0] % n_grid, near[:, 1] % n_grid
        position = (row[:, :, np.newaxis] * n_grid + column[:, np.newaxis, :]).ravel()
        spread = (
            weight[part, np.newaxis, np.newaxis] * factors[:, 1, :, np.newaxis] * factors[:, 0, np.newaxis, :]
        ).ravel()
        cells += np.bincount(position, weights=spread.real, minlength=cells.size)
        if np.iscomplexobj(spread):
            cells += 1j * np.bincount(position, weights=spread.imag, minlength=cells.size)
    transform = scipy.fft.fft2(cells.reshape(n_grid, n_grid), overwrite_x=True)
    modes = np.arange(-n_half, n_half + 1)
    nodes, node_weights = np.polynomial.legendre.leggauss(64)
    waves = np.cos(np.pi * SPREAD_CELLS / n_grid * np.multiply.outer(modes, nodes))
    kernel = 0.5 * SPREAD_CELLS * (waves @ (node_weights * _spreading_kernel(nodes)))
    return np.asarray(transform[np.ix_(modes % n_grid, modes % n_grid)] / np.multiply.outer(kernel, kernel))


def _spreading_kernel(fraction: Floats) -> Floats:
    """Evaluate the spreading kernel at fractions of its half width."""
    return np.asarray(
        np.exp(SPREAD_SHAPE * (np.sqrt(np.maximum(1.0 - fraction * fraction, 0.0)) - 1.0)) * (np.abs(fraction) <= 1.0)
    )


def _refine_peak(
    xy_um: Floats,
    sample: NDArray[np.complex128],
    at_per_mm: Floats,
    step_per_mm: float,
    wave_per_mm: Floats,
    peak_per_mm: float,
) -> tuple[float, Floats]:
    """Return height and position of an alias peak, by direct sums on successively finer grids."""
    height, half_per_mm = 0.0, 0.5 * step_per_mm
    for _ in range(N_REFINEMENTS):
        off = half_per_mm * np.arange(-2, 3)
        near = at_per_mm + np.stack(np.meshgrid(off, off), axis=-1).reshape(-1, 2)
        # The central point lies outside the peak of the wave, so at least one point remains.
        near = near[np.hypot(*(near - wave_per_mm).T) >= peak_per_mm]
        sums = np.array([abs(np.exp(-2j * np.pi * (xy_um @ f)) @ sample) for f in per_um_from_per_mm(near)])
        at_per_mm, height = near[sums.argmax()], float(sums.max())
        half_per_mm *= 0.25
    return height, at_per_mm

"""Closed-form OTF and MTF of photosite apertures, from the Fourier transforms of polygons."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.threads import parallel_map, thread_count
from foveasim._core.validation import Floats, finite_array
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.units import per_um_from_per_mm

__all__ = ["polygon_mtf", "polygon_otf", "wave_vectors_per_mm"]

#: Sites per call of the kernel; independent of the number of threads.
BLOCK_SITES = 1024


def wave_vectors_per_mm(frequency_per_mm: ArrayLike, angle_deg: ArrayLike = 0.0) -> Floats:
    """
    Return wave vectors for given frequencies and directions.

    Parameters
    ----------
    frequency_per_mm : (n,) or number, 1/mm
        Line pairs per mm on the sensor.
    angle_deg : (n,) or number, degrees
        Direction of the wave vector, counter-clockwise from the x axis.

    Returns
    -------
    wave_per_mm : (n, 2) float64, 1/mm

    Raises
    ------
    ParameterError
        When a number is not finite, or the lengths of both differ.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.metrics.wave_vectors_per_mm([100.0], 90.0).round(6).tolist()
    [[0.0, 100.0]]
    """
    frequency = np.atleast_1d(finite_array("frequency_per_mm", frequency_per_mm))
    angle = np.deg2rad(np.atleast_1d(finite_array("angle_deg", angle_deg)))
    if frequency.ndim != 1 or angle.ndim != 1 or (angle.size not in (1, frequency.size) and frequency.size != 1):
        raise ParameterError("angle_deg", f"must be one number, or one for each of the {frequency.size} frequencies")
    return np.stack(np.broadcast_arrays(frequency * np.cos(angle), frequency * np.sin(angle)), axis=1)


def polygon_otf(layout: Layout, wave_per_mm: ArrayLike, *, n_threads: int | None = None) -> NDArray[np.complex128]:
    """
    Compute the optical transfer function of each photosite aperture in closed form.

    Parameters
    ----------
    layout : Layout
        For a selection of sites: ``layout[sites]``.
    wave_per_mm : (n_wave, 2), 1/mm
        Wave vectors, line pairs per mm along x and y.
    n_threads : int, optional
        All cores by default. Results are bit-identical for any number of threads.

    Returns
    -------
    otf : (n_site, n_wave) complex128
        Mean of ``exp(-2πi f·(x - c))`` over the site with centroid c: 1 at frequency 0, real for point-symmetric sites.

    Raises
    ------
    ParameterError
        When the vectors are not finite, or have a different shape.

    Notes
    -----
    The result is a sum over the edges of the outline, holes included (Green's theorem), accurate to about 1e-15 at any
    frequency.

    Examples
    --------
    >>> from foveasim.layout import grid
    >>> otf = polygon_otf(
    ...     grid(n_x=1, n_y=1, pitch_um=2.0), [[0.0, 0.0], [250.0, 0.0], [250.0, 250.0]]
    ... )
    >>> np.round(otf.real, 4)
    array([[1.    , 0.6366, 0.4053]])
    """
    from foveasim.metrics import _kernels

    waves = finite_array("wave_per_mm", wave_per_mm, ndim=2)
    if waves.shape[1] != 2:
        raise ParameterError("wave_per_mm", f"must have shape (n_wave, 2), got {waves.shape}")
    rad_per_um = np.ascontiguousarray(2.0 * np.pi * per_um_from_per_mm(waves))
    transforms = _kernels.polygon_transforms
    otf = np.empty((layout.n_sites, waves.shape[0]), np.complex128)

    def block(start: int) -> None:
        sites = slice(start, min(start + BLOCK_SITES, layout.n_sites))
        otf[sites] = transforms(
            layout.xy_um,
            layout.ring_offsets,
            layout.site_offsets[start : sites.stop + 1],
            layout.centroid_um[sites],
            layout.area_um2[sites],
            rad_per_um,
        )

    parallel_map(block, range(0, layout.n_sites, BLOCK_SITES), thread_count(n_threads))
    return otf


def polygon_mtf(
    layout: Layout, frequency_per_mm: ArrayLike, *, angle_deg: ArrayLike = 0.0, n_threads: int | None = None
) -> Floats:
    """
    Compute the modulation transfer function of each photosite aperture in closed form.

    Parameters
    ----------
    layout : Layout
        For a selection of sites: ``layout[sites]``.
    frequency_per_mm : (n_wave,) or number, 1/mm
        Line pairs per mm on the sensor.
    angle_deg : (n_wave,) or number, degrees
        Direction of the wave vector, counter-clockwise from the x axis.
    n_threads : int, optional
        All cores by default.

    Returns
    -------
    mtf : (n_site, n_wave) float64
        For example ``|sinc(f w)|`` for a square of side w, perpendicular to its side.

    Raises
    ------
    ParameterError
        When a number is not finite, or the lengths of frequencies and angles differ.

    Examples
    --------
    >>> from foveasim.layout import hexagonal
    >>> hexagon = hexagonal(n_columns=1, n_rows=1, pitch_um=4.0)
    >>> np.round(polygon_mtf(hexagon, [0.0, 125.0, 250.0]), 4)
    array([[1.    , 0.6946, 0.1351]])
    """
    return np.abs(polygon_otf(layout, wave_vectors_per_mm(frequency_per_mm, angle_deg), n_threads=n_threads))

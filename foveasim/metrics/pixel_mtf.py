"""What a photosite's own shape does to contrast: the Fourier transform of its polygon, in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.threads import each, thread_count
from foveasim._core.validation import Floats, finite_array
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.metrics.sampling import require_layout
from foveasim.units import per_um_from_per_mm

__all__ = ["polygon_mtf", "polygon_otf", "wave_vectors_per_mm"]

#: Sites that one call of the kernel takes, whatever the number of threads.
BLOCK_SITES = 1024


def wave_vectors_per_mm(frequency_per_mm: ArrayLike, angle_deg: ArrayLike = 0.0) -> Floats:
    """
    Wave vectors of sines.

    Parameters
    ----------
    frequency_per_mm : (n,) or number, 1/mm
        Line pairs per mm on the sensor.
    angle_deg : (n,) or number, degrees
        Direction in which the sine varies, counter-clockwise from x.

    Returns
    -------
    wave_per_mm : (n, 2) float64, 1/mm

    Raises
    ------
    ParameterError
        When a number is not finite, or the two have different lengths.
    """
    frequency = np.atleast_1d(finite_array("frequency_per_mm", frequency_per_mm))
    angle = np.deg2rad(np.atleast_1d(finite_array("angle_deg", angle_deg)))
    if frequency.ndim != 1 or angle.ndim != 1 or (angle.size not in (1, frequency.size) and frequency.size != 1):
        raise ParameterError("angle_deg", f"must be one number, or one for each of the {frequency.size} frequencies")
    return np.stack(np.broadcast_arrays(frequency * np.cos(angle), frequency * np.sin(angle)), axis=1)


def polygon_otf(layout: Layout, wave_per_mm: ArrayLike, *, n_threads: int | None = None) -> NDArray[np.complex128]:
    """
    Optical transfer functions of photosites: what is left of a sine's contrast in a site's mean, and its phase.

    Parameters
    ----------
    layout : Layout
        For some of its sites: ``layout[sites]``.
    wave_per_mm : (n_wave, 2), 1/mm
        Wave vectors, line pairs per mm along x and y.
    n_threads : int, optional
        All cores by default. Results do not depend on it, bit for bit.

    Returns
    -------
    otf : (n_site, n_wave) complex128
        Mean of ``exp(-2πi f·(x - c))`` over the site, c its centroid: 1 at frequency 0, real for sites of point symmetry.

    Raises
    ------
    ParameterError
        When the vectors are not finite numbers of this shape.

    Notes
    -----
    Exact: a sum over the outline's edges (Green's theorem), holes included, right to some 1e-15 at any frequency.

    Examples
    --------
    >>> from foveasim.layout import grid
    >>> otf = polygon_otf(grid(n_x=1, n_y=1, pitch_um=2.0), [[0.0, 0.0], [250.0, 0.0], [250.0, 250.0]])
    >>> np.round(otf.real, 4)
    array([[1.    , 0.6366, 0.4053]])
    """
    from foveasim.metrics import _kernels

    require_layout(layout)
    waves = finite_array("wave_per_mm", wave_per_mm, ndim=2)
    if waves.shape[1] != 2:
        raise ParameterError("wave_per_mm", f"must have the shape (n_wave, 2), got {waves.shape}")
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

    each(block, range(0, layout.n_sites, BLOCK_SITES), thread_count(n_threads))
    return otf


def polygon_mtf(
    layout: Layout, frequency_per_mm: ArrayLike, *, angle_deg: ArrayLike = 0.0, n_threads: int | None = None
) -> Floats:
    """
    Modulation transfer functions of photosites, in closed form: what is left of a sine's contrast in a site's mean.

    Parameters
    ----------
    layout : Layout
        For some of its sites: ``layout[sites]``.
    frequency_per_mm : (n_wave,) or number, 1/mm
        Line pairs per mm on the sensor.
    angle_deg : (n_wave,) or number, degrees
        Direction in which the sine varies, counter-clockwise from x.
    n_threads : int, optional
        All cores by default.

    Returns
    -------
    mtf : (n_site, n_wave) float64
        ``|sinc(f w)|`` across a square of side w.

    Raises
    ------
    ParameterError
        When a number is not finite, or there is not one angle, or one a frequency.

    Examples
    --------
    >>> from foveasim.layout import hexagonal
    >>> hexagon = hexagonal(n_columns=1, n_rows=1, pitch_um=4.0)
    >>> np.round(polygon_mtf(hexagon, [0.0, 125.0, 250.0]), 4)
    array([[1.    , 0.6946, 0.1351]])
    """
    return np.abs(polygon_otf(layout, wave_vectors_per_mm(frequency_per_mm, angle_deg), n_threads=n_threads))

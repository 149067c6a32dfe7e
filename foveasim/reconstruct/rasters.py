"""Reference pictures, resampled from power maps, and blur kernels of lenses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Any

import numpy as np

from foveasim._core.calls import Limits
from foveasim._core.validation import Floats, finite_array, read_only
from foveasim.errors import ParameterError
from foveasim.fields import Grid, PowerMap
from foveasim.optics import Optics
from foveasim.reconstruct.picture import Picture

__all__ = ["blur_kernel", "reference", "sum_of_images"]

#: Default encircled energy of a kernel, and its largest radius in pixels.
DEFAULT_ENERGY_FRACTION, MAX_RADIUS = 0.98, 128
#: Largest sample pitch of the PSF in λN: half the Nyquist pitch.
SAMPLE_LAMBDA_N = 0.25
#: Largest number of PSF samples along an axis.
MAX_SAMPLES = 8192
#: Coverage above which a pixel lies on the map.
MIN_COVERAGE = 1e-9


def reference(power_map: PowerMap, grid: Grid, *, weights: Floats | None = None) -> Picture:
    """
    Resample a power map to the pixels of a picture by exact area-weighted means.

    Parameters
    ----------
    power_map : PowerMap
    grid : Grid
        Pixels of the picture, of any pitch and position.
    weights : (n_channel, n_band), optional
        Value of 1 W/m² of each band in each channel; by default one channel per band, in W/m².

    Returns
    -------
    Picture
        NaN outside the map; the coverage is the fraction of a pixel on the map.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> power_map = fs.PowerMap.from_array(
    ...     np.array([[1.0, 3.0], [5.0, 7.0]]), pitch_um=2.0, wavelength_nm=550.0
    ... )
    >>> fs.reconstruct.reference(power_map, fs.Grid.centred((1, 1), 4.0)).data.tolist()
    [[[4.0]]]
    """
    channel_weights = (
        np.eye(power_map.wavelength_nm.size) if weights is None else finite_array("weights", weights, ndim=2)
    )
    if channel_weights.shape[1] != power_map.wavelength_nm.size:
        raise ParameterError(
            "weights", f"must have the shape (n_channel, {power_map.wavelength_nm.size}), got {channel_weights.shape}"
        )
    planes = (np.tensordot(weight, power_map.data, axes=1) for weight in channel_weights)
    return sum_of_images([(power_map.grid, planes)], grid, len(channel_weights))


def sum_of_images(images: Sequence[tuple[Grid, Iterable[Any]]], grid: Grid, n_channels: int) -> Picture:
    """
    Return the sum of images on several grids, as area-weighted means over pixels.

    ``images``: sequence of (Grid, iterable of n_channels planes (n_y, n_x)). ``grid``: pixels of the picture. NaN where
    an image does not cover a pixel; the coverage is the smallest of all images.
    """
    data, coverage = np.zeros((n_channels, *grid.shape)), np.ones(grid.shape)
    for source, planes in images:
        along_y, along_x = (_overlaps_1d(grid, source, axis) for axis in (0, 1))
        on_map = np.outer(along_y.sum(axis=1), along_x.sum(axis=1)) / grid.cell_area_um2
        is_covered = on_map > MIN_COVERAGE
        on_map[~is_covered] = np.nan
        for k, plane in enumerate(planes):
            data[k] += (along_x @ (along_y @ plane).T).T / grid.cell_area_um2 / on_map
        coverage = np.minimum(coverage, np.where(is_covered, on_map, 0.0))
    return Picture(read_only(data.astype(np.float32)), read_only(coverage.astype(np.float32)), grid)


def blur_kernel(
    optics: Optics,
    grid: Grid,
    *,
    wavelength_nm: float,
    distance_m: float | None = None,
    radius: Annotated[int | None, Limits(at_least=0, at_most=MAX_RADIUS)] = None,
) -> Floats:
    """
    Compute the blur of a uniform pixel by a lens, the ``blur`` of :func:`least_squares`.

    Parameters
    ----------
    optics : Optics
    grid : Grid
        Pixels of the picture.
    wavelength_nm : float, nm
    distance_m : float, optional, m
        Distance of the scene; by default the focus distance, or infinity.
    radius : int, optional
        Pixels from the centre to either side; by default the smallest radius with an encircled energy of 98 %, in units of
        the shorter side of a pixel, at most 128.

    Returns
    -------
    kernel : (2 radius + 1, 2 radius + 1) float64
        Normalised to a sum of 1, which redistributes the energy outside the kernel.

    Notes
    -----
    On the optical axis: field-dependent aberrations are those of the field centre. The PSF is sampled at λN/4 or finer, and
    averaged exactly over both the emitting and the receiving pixel.

    Examples
    --------
    >>> import foveasim as fs
    >>> lens = fs.Optics(focal_length_mm=8.0, f_number=2.8)
    >>> kernel = fs.reconstruct.blur_kernel(
    ...     lens, fs.Grid.centred((32, 32), 1.0), wavelength_nm=550.0
    ... )
    >>> kernel.shape, round(float(kernel[kernel.shape[0] // 2, kernel.shape[1] // 2]), 3)
    ((31, 31), 0.245)
    """
    shorter_um = min(grid.pitch_x_um, grid.pitch_y_um)
    if radius is None:
        radii = np.arange(1, MAX_RADIUS + 1)
        energy = optics.encircled_energy((radii + 0.5) * shorter_um, wavelength_nm, distance_m=distance_m)
        radius = int(radii[min(int(np.searchsorted(energy, DEFAULT_ENERGY_FRACTION)), MAX_RADIUS - 1)])
    coarsest_um = 8.0 * SAMPLE_LAMBDA_N * optics.psf(wavelength_nm, distance_m=distance_m, n_points=1).grid.pitch_x_um
    step_um = shorter_um / (int(np.ceil(shorter_um / coarsest_um)) | 1)
    n_points = int(np.ceil((2 * radius + 3) * max(grid.pitch_x_um, grid.pitch_y_um) / step_um - 1e-9)) | 1
    if n_points > MAX_SAMPLES:
        raise ParameterError(
            "grid",
            f"must have pixels whose PSF needs at most {MAX_SAMPLES} samples along an axis, got {n_points}",
            hint="use pixels closer to square or a smaller 'radius'",
        )
    psf = optics.psf(wavelength_nm, distance_m=distance_m, pitch_um=step_um, n_points=n_points)
    # Convolution with the boxes of both pixels, as a product of Fourier transforms that is evaluated at pixel centres only.
    cycles_per_um = np.fft.fftfreq(n_points, step_um)
    centre_um, offset = 0.5 * (n_points - 1) * step_um, np.arange(-radius, radius + 1)
    along_y, along_x = (
        np.exp(2j * np.pi * np.outer(centre_um + offset * pitch_um, cycles_per_um))
        * np.sinc(pitch_um * cycles_per_um) ** 2
        for pitch_um in (grid.pitch_y_um, grid.pitch_x_um)
    )
    means = (along_y @ np.fft.fft2(psf.psf_per_um2) @ along_x.T).real
    kernel = np.maximum(means, 0.0)
    return np.asarray(kernel / kernel.sum())


def _overlaps_1d(to: Grid, source: Grid, axis: int) -> Any:
    """
    Return the overlap lengths of the cells of two grids along an axis, (n_to, n_source) µm.

    Axis 0 is y. The matrix is sparse.
    """
    from scipy.sparse import csr_array

    edges_to, edges_from = (
        grid.origin_um[1 - axis] + np.arange(grid.shape[axis] + 1) * grid.pitch_xy_um[1 - axis] for grid in (to, source)
    )
    cuts = np.unique(np.concatenate((edges_to, edges_from)))
    centre, length_um = 0.5 * (cuts[1:] + cuts[:-1]), np.diff(cuts)
    row, column = (np.searchsorted(edges, centre, side="right") - 1 for edges in (edges_to, edges_from))
    is_overlap = (row >= 0) & (row < to.shape[axis]) & (column >= 0) & (column < source.shape[axis])
    indices = (row[is_overlap], column[is_overlap])
    return csr_array((length_um[is_overlap], indices), shape=(to.shape[axis], source.shape[axis]))

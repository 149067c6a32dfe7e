"""Image similarity to a reference: PSNR and SSIM of pixels covered by photosites."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import FRACTION, POSITIVE, Limits
from foveasim._core.validation import Bools, Floats, as_numbers
from foveasim.errors import ParameterError
from foveasim.reconstruct import Picture

__all__ = ["psnr_db", "ssim"]

#: Default minimum fraction of a pixel's area that photosites cover.
DEFAULT_MIN_COVERAGE = 0.5


def psnr_db(
    picture: Picture | ArrayLike,
    reference: Picture | ArrayLike,
    data_range: Annotated[float | None, POSITIVE] = None,
    *,
    min_coverage: Annotated[float, FRACTION] = DEFAULT_MIN_COVERAGE,
) -> float:
    """
    Compute the peak signal-to-noise ratio (PSNR).

    Parameters
    ----------
    picture, reference : Picture or (..., n_y, n_x)
        Images of the same shape and unit.
    data_range : float, optional
        Peak value; by default the range of the reference over the compared pixels.
    min_coverage : float
        Minimum area fraction of a pixel covered by photosites. Pixels below it, or with NaN in a channel, are excluded.

    Returns
    -------
    psnr_db : float, dB
        ``20 log10(data_range / root mean square of the difference)``; infinite for identical images.

    Raises
    ------
    ParameterError
        When shapes differ, no pixel can be compared, a compared pixel is infinite, or the range is not positive.

    Examples
    --------
    >>> float(
    ...     round(
    ...         psnr_db(
    ...             [[1.0, 2.0], [3.0, np.nan]], [[1.1, 2.1], [2.9, 7.0]], data_range=1.0
    ...         ),
    ...         6,
    ...     )
    ... )
    20.0
    """
    image, ideal, is_compared = _prepare_comparison(picture, reference, min_coverage)
    difference2 = float(np.mean((image - ideal)[:, is_compared] ** 2))
    peak = _data_range(ideal[:, is_compared], data_range)
    return math.inf if difference2 == 0.0 else 10.0 * math.log10(peak * peak / difference2)


def ssim(
    picture: Picture | ArrayLike,
    reference: Picture | ArrayLike,
    data_range: Annotated[float | None, POSITIVE] = None,
    *,
    min_coverage: Annotated[float, FRACTION] = DEFAULT_MIN_COVERAGE,
    window: Annotated[int, Limits(at_least=3)] = 7,
) -> float:
    """
    Compute the mean structural similarity (SSIM).

    The definition is that of Wang, Bovik, Sheikh and Simoncelli (2004), as implemented by scikit-image.

    Parameters
    ----------
    picture, reference, data_range, min_coverage
        As for :func:`psnr_db`.
    window : int, pixels
        Odd side of the square window for means and variances.

    Returns
    -------
    ssim : float
        At most 1. Mean over the channels and the pixels whose windows contain only compared pixels.

    Raises
    ------
    ParameterError
        As for :func:`psnr_db`; when the window is even, or no window fits.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> picture = np.random.default_rng(0).random((32, 32))
    >>> (
    ...     round(fs.metrics.ssim(picture, picture), 6),
    ...     round(fs.metrics.ssim(0.5 * picture + 0.25, picture), 3),
    ... )
    (1.0, 0.801)
    """
    image, ideal, is_compared = _prepare_comparison(picture, reference, min_coverage)
    if window % 2 == 0:
        raise ParameterError("window", "must be odd", window)
    peak = _data_range(ideal[:, is_compared], data_range)
    # scikit-image requires numbers also in excluded pixels
    image, ideal = (np.where(is_compared, plane, 0.0) for plane in (image, ideal))
    similarity, fits = ssim_map(image, ideal, is_compared, peak, window=window)
    if not fits.any():
        raise ParameterError("window", "must fit within the compared pixels", window)
    return float(np.mean(similarity[fits]))


def ssim_map(
    one: NDArray[np.float64], other: NDArray[np.float64], is_compared: Bools, data_range: float, *, window: int = 7
) -> tuple[Floats, Bools]:
    """
    Compute the structural similarity of each pixel, a mean over the channels.

    ``one``, ``other`` (n_channel, n_y, n_x): finite everywhere. ``is_compared``: (n_y, n_x) bool. ``data_range``: peak value.
    ``window`` (int, pixels): odd side of the square window. Returns ``similarity`` (n_y, n_x) float64. ``fits`` (n_y, n_x)
    bool: whether the window of a pixel contains only compared pixels.
    """
    from scipy.ndimage import minimum_filter
    from skimage.metrics import structural_similarity

    fits = minimum_filter(is_compared, size=window, mode="constant", cval=0)
    if not fits.any():
        return np.full(is_compared.shape, np.nan), fits
    maps = [
        structural_similarity(a, b, win_size=window, data_range=data_range, full=True)[1]
        for a, b in zip(one, other, strict=True)
    ]
    return np.mean(maps, axis=0), fits


def _prepare_comparison(
    picture: Picture | ArrayLike, reference: Picture | ArrayLike, min_coverage: float
) -> tuple[Floats, Floats, Bools]:
    """Return both images as (n_channel, n_y, n_x), and the mask of compared pixels."""
    planes, covered = [], []
    for name, one in (("picture", picture), ("reference", reference)):
        is_picture = isinstance(one, Picture)
        values = as_numbers(name, one.data if isinstance(one, Picture) else one, missing_is_nan=True)
        if values.ndim < 2:
            raise ParameterError(name, f"must have shape (..., n_y, n_x), got {values.shape}")
        planes.append(values.reshape(-1, *values.shape[-2:]))
        # Coverage is float32: the tolerance accounts for rounding in fully covered pixels.
        covered.append(one.coverage >= min_coverage - 1e-6 if is_picture else True)  # type: ignore[union-attr]
    if planes[0].shape != planes[1].shape:
        raise ParameterError(
            "reference", f"must have the same shape as the picture, {planes[0].shape}, got {planes[1].shape}"
        )
    if (
        isinstance(picture, Picture)
        and isinstance(reference, Picture)
        and not np.allclose(picture.grid.bounds_um, reference.grid.bounds_um, rtol=1e-9, atol=1e-6)
    ):
        raise ParameterError("reference", "must have the same grid as the picture", reference.grid.bounds_um)
    is_compared = ~np.isnan(planes).any(axis=(0, 1)) & covered[0] & covered[1]
    if not is_compared.any():
        raise ParameterError("picture", "must have at least one pixel in common with the reference")
    for name, plane in zip(("picture", "reference"), planes, strict=True):
        n_infinite = int(np.count_nonzero(np.isinf(plane).any(axis=0) & is_compared))
        if n_infinite:
            raise ParameterError(
                name,
                f"must be finite, got infinity in {n_infinite:,} of {np.count_nonzero(is_compared):,} compared pixels",
                hint="mark unknown pixels by NaN",
            )
    return planes[0], planes[1], np.asarray(is_compared)


def _data_range(values: Floats, data_range: float | None) -> float:
    if data_range is not None:
        return data_range
    peak = float(np.ptp(values))
    if peak == 0.0:
        raise ParameterError("data_range", "must be given for a constant reference")
    return peak

"""
Nonuniformity of EMVA 1288: rows, columns and pixels, without the shading of the light.

EMVA Standard 1288, Release 4.0 Linear, describes the spatial variance of a mean image of M rows and N columns as the sum of
those of rows, columns and pixels, ``s² = s²_row + s²_col + s²_pixel``. The variance of the row means is
``s²_row + s²_pixel / N``, that of the column means ``s²_col + s²_pixel / M``, each with its part of the temporal noise. These
equations are solved here with the mean squares of the analysis of variance, which are unbiased; the solution of the standard
differs from it by about 1/M and 1/N of a part.

The standard suppresses uneven illumination by a highpass filter: a smoothed image is subtracted, with box filters of 7 x 7 and
11 x 11 pixels and a binomial filter of 3 x 3. What this removes from the variances of rows, columns and pixels follows from the
coefficients, and is corrected. Where the photons of each site are known, they are a better correction, for any outlines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from foveasim._core.validation import Floats, Ints
from foveasim.errors import FoveasimWarning, ParameterError, warn
from foveasim.layout.model import Layout
from foveasim.layout.rows import site_rows
from foveasim.metrics.emva_intervals import CONFIDENCE
from foveasim.metrics.photon_transfer import SiteClasses, codes_of

__all__ = ["MeanImage", "Nonuniformity", "class_grids", "mean_image", "nonuniformity"]

PARTS = ("row", "column", "pixel")
#: Smallest numbers of rows and of columns with parts.
MIN_ROWS = 3
#: Smoothing of the standard along one axis: boxes of 7 and 11 pixels and a binomial filter of 3.
SMOOTHING: Floats = np.convolve(np.convolve(np.full(7, 1 / 7), np.full(11, 1 / 11)), (0.25, 0.5, 0.25))
MARGIN = SMOOTHING.size // 2


class MeanImage(NamedTuple):
    """Mean codes over frames, (n_site,) DN, and their temporal variances, (n_site,) DN²."""

    mean_dn: Floats
    noise_dn2: Floats


def mean_image(frames: Any, dark: Any | None = None, ratio: Floats | None = None) -> MeanImage:
    """
    Return the mean of frames, with the signal of each site as for the mean photons.

    ``frames``, ``dark``: frames of one level. ``ratio``: photons of each site over their mean, or None. The signal
    above the mean of ``dark`` is divided by them.
    """
    lit = _mean_and_noise(frames)
    if ratio is None:
        return lit
    factor, unlit = 1.0 / ratio, _mean_and_noise(dark)
    return MeanImage(
        factor * lit.mean_dn + (1.0 - factor) * unlit.mean_dn,
        factor**2 * lit.noise_dn2 + (1.0 - factor) ** 2 * unlit.noise_dn2,
    )


def _mean_and_noise(frames: Any) -> MeanImage:
    codes = codes_of("frames", frames)
    n_frames = codes.shape[0]
    mean_dn = codes.mean(axis=0, dtype=np.float64)
    off = codes - mean_dn
    return MeanImage(mean_dn, (off * off).sum(axis=0) / (n_frames * (n_frames - 1)))


def class_grids(layout: Layout, groups: SiteClasses) -> list[Ints | None]:
    """
    Return the sites of each class as an array (n_row, n_column), or None.

    None for a class without complete rows and columns; warns when no class has them.
    """
    rows, columns = (site_rows(layout, axis) for axis in (1, 0))
    grids: list[Ints | None] = [None] * groups.labels.size
    if rows is not None and columns is not None:
        for k in range(groups.labels.size):
            sites = np.flatnonzero(groups.class_index == k)
            (row, row_of_site), (column, column_of_site) = (
                np.unique(index[sites], return_inverse=True) for index in (rows, columns)
            )
            grid = np.full((row.size, column.size), -1, np.int64)
            if grid.size == sites.size and min(grid.shape) >= MIN_ROWS:
                grid[row_of_site, column_of_site] = sites
                grids[k] = grid if grid.min() >= 0 else None
    if not any(grid is not None for grid in grids):
        warn(
            "DSNU and PRNU have no parts of rows, columns and pixels: the sites of no class are in complete rows and "
            f"columns, at least {MIN_ROWS} of each; green filters of a Bayer mosaic need two classes",
            FoveasimWarning,
        )
    return grids


@dataclass(frozen=True)
class SpatialParts:
    """
    Spatial variances of rows, columns and pixels of a mean image.

    Attributes
    ----------
    variance_dn2, low_dn2, high_dn2 : (3,) float64, DN²
        Estimates of ``PARTS``, which may be negative, and their limits of 95 % confidence.
    """

    variance_dn2: Floats
    low_dn2: Floats
    high_dn2: Floats


def spatial_parts(image: MeanImage, grid: Ints, *, highpass: bool = False) -> SpatialParts:
    """
    Return the spatial variances of rows, columns and pixels of a class.

    ``grid`` (n_row, n_column): sites. Limits are those of the mean squares, which follow chi-square distributions for Gaussian
    nonuniformity.

    Raises ParameterError when the grid is smaller than the highpass filter.
    """
    from scipy.special import chdtri

    picture = image.mean_dn[grid]
    noise_dn2 = float(image.noise_dn2[grid].mean())
    along = [_responses(n) if highpass else (1.0, 1.0) for n in grid.shape]
    if highpass:
        if min(grid.shape) < 2 * MARGIN + MIN_ROWS:
            raise ParameterError(
                "highpass", f"needs at least {2 * MARGIN + MIN_ROWS} rows and columns in each class", grid.shape
            )
        picture = _highpass(picture)
    n_rows, n_columns = picture.shape
    means, n_means = [picture.mean(axis=axis) for axis in (1, 0)], (n_columns, n_rows)
    residual = picture - means[0][:, None] - means[1] + picture.mean()
    degrees = np.array([n_rows - 1, n_columns - 1, (n_rows - 1) * (n_columns - 1)], np.float64)
    squares_dn2 = np.array([*(np.var(m, ddof=1) for m in means), (residual**2).sum() / degrees[2]])
    # What the filter leaves of the variance of a row, a column and a pixel, and of pixels in the means of rows and columns.
    k0, k2 = SMOOTHING[MARGIN], (SMOOTHING**2).sum()
    kept = np.array([1.0 - 2.0 * k0 + k2] * 2 + [1.0 - 2.0 * k0**2 + k2**2]) if highpass else np.ones(3)
    of_pixels = [
        (1.0 - 2.0 * k0 * inner + k2 * outer) / n if highpass else 1.0 / n
        for (inner, outer), n in zip(along[::-1], n_means, strict=True)
    ]
    pixel_dn2 = squares_dn2[2] / kept[2]
    below_dn2 = np.array([of_pixels[0] * pixel_dn2, of_pixels[1] * pixel_dn2, noise_dn2 * kept[2]])
    tail = 0.5 * (1.0 - CONFIDENCE)
    low_dn2, high_dn2 = (degrees / chdtri(degrees, p) * squares_dn2 for p in (tail, 1.0 - tail))
    variance_dn2, low_dn2, high_dn2 = ((values - below_dn2) / kept for values in (squares_dn2, low_dn2, high_dn2))
    return SpatialParts(variance_dn2, low_dn2, high_dn2)


def _highpass(picture_dn: Floats) -> Floats:
    """Return the picture without its smoothed picture, and without margins."""
    smooth = picture_dn
    for axis in (0, 1):
        windows = np.lib.stride_tricks.sliding_window_view(smooth, SMOOTHING.size, axis=axis)
        smooth = windows @ SMOOTHING
    return np.asarray(picture_dn[MARGIN:-MARGIN, MARGIN:-MARGIN] - smooth)


def _responses(n: int) -> tuple[float, float]:
    """
    Return how smoothed pixels contribute to a mean over n - 2 MARGIN of them.

    The sum of the weights of the inner pixels, and that of all squared weights, both divided by n - 2 MARGIN.
    """
    weights = np.convolve(np.ones(n - 2 * MARGIN), SMOOTHING)
    return float(weights[MARGIN:-MARGIN].sum()) / (n - 2 * MARGIN), float((weights**2).sum()) / (n - 2 * MARGIN)


@dataclass(frozen=True)
class Nonuniformity:
    """
    DSNU and PRNU of each class, as squares and their limits.

    Attributes
    ----------
    values : dict of str to (n_class,) float64
        Squares of the parameters, which may be negative; NaN without rows and columns.
    limits : dict of str to (n_class, 2) float64
        Limits of the squares.
    """

    values: dict[str, Floats]
    limits: dict[str, Floats]


def nonuniformity(
    grids: Sequence[Ints | None],
    levels: Sequence[tuple[MeanImage, MeanImage]],
    gain_dn_per_e: Floats,
    signal_dn: Floats,
    *,
    highpass: bool,
) -> Nonuniformity:
    """
    Compute the parts of DSNU and PRNU, and the whole PRNU with a highpass filter.

    ``levels``: bright and dark mean image of each class. ``gain_dn_per_e``, ``signal_dn`` (n_class,): system gain, and mean
    signal of the bright image.
    """
    names = [f"{name}_{part}_{unit}" for name, unit in (("dsnu", "e"), ("prnu", "fraction")) for part in PARTS]
    whole = ["prnu_fraction"] if highpass else []
    squares = {name: np.full(len(grids), np.nan) for name in (*names, *whole)}
    limits = {name: np.full((len(grids), 2), np.nan) for name in squares}
    for k, (grid, (bright, dark)) in enumerate(zip(grids, levels, strict=True)):
        if grid is None:
            continue
        unlit, lit = spatial_parts(dark, grid), spatial_parts(bright, grid, highpass=highpass)
        below = spatial_parts(dark, grid, highpass=highpass) if highpass else unlit
        difference, low, high = _difference(lit, below)
        rows = [
            (
                unlit.variance_dn2 / gain_dn_per_e[k] ** 2,
                np.stack((unlit.low_dn2, unlit.high_dn2)) / gain_dn_per_e[k] ** 2,
            ),
            (difference / signal_dn[k] ** 2, np.stack((low, high)) / signal_dn[k] ** 2),
        ]
        values = np.concatenate([row[0] for row in rows])
        bounds = np.concatenate([row[1] for row in rows], axis=1)
        for name, value, bound in zip(names, values, bounds.T, strict=True):
            squares[name][k], limits[name][k] = value, bound
        for name in whole:
            total = difference.sum()
            half = [np.sqrt(((bound - difference) ** 2).sum()) for bound in (low, high)]
            squares[name][k] = total / signal_dn[k] ** 2
            limits[name][k] = np.array((total - half[0], total + half[1])) / signal_dn[k] ** 2
    return Nonuniformity(squares, {name: np.maximum(values, 0.0) for name, values in limits.items()})


def _difference(lit: SpatialParts, dark: SpatialParts) -> tuple[Floats, Floats, Floats]:
    """
    Return the difference of variances, and its limits from those of both.

    G. Y. Zou and A. Donner, Construction of confidence limits about effect measures, Statistics in Medicine 27, 1693, 2008.
    """
    difference = lit.variance_dn2 - dark.variance_dn2
    low = difference - np.hypot(lit.variance_dn2 - lit.low_dn2, dark.high_dn2 - dark.variance_dn2)
    high = difference + np.hypot(lit.high_dn2 - lit.variance_dn2, dark.variance_dn2 - dark.low_dn2)
    return difference, low, high

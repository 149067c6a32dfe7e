"""Mean and variance of stacks for each class of pixels, in blocks of rows."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.threads import cached_property, parallel_map, thread_count
from foveasim._core.validation import Floats, Ints
from foveasim.twin.frames.statistics import StackStatistics

__all__ = ["Levels", "block_means", "block_weights", "class_index", "row_blocks"]

#: Largest number of blocks of rows, whose differences give the uncertainty of statistics.
MAX_BLOCKS = 64
#: Rows that a thread adds at a time.
ROWS = 64


@dataclass(frozen=True, eq=False)
class Levels:
    """
    Mean and variance over frames of each stack and class: a level.

    Attributes
    ----------
    stack, class_of_level : (n_level,) int
        Stack and class of pixels of each level.
    n_frames, n_pixels : (n_level,) int
    means_dn, variances_dn2 : (n_level, n_block) float64, DN and DN²
        Means over the pixels of each block of rows; variances of pixels, without what rows, columns and frames share.
    column_dn2 : (n_level,) float64, DN²
        Variance that columns share, which is not in ``variances_dn2``.
    mean_noise_dn2 : (n_level,) float64, DN²
        Variance of the mean over all pixels and frames due to temporal noise.
    weights : (n_block,) float64
        Fractions of the pixels.
    """

    stack: Ints
    class_of_level: Ints
    n_frames: Ints
    n_pixels: Ints
    means_dn: Floats
    variances_dn2: Floats
    column_dn2: Floats
    mean_noise_dn2: Floats
    weights: Floats

    @cached_property
    def mean_dn(self) -> Floats:
        """Mean code, (n_level,) DN."""
        return self.means_dn @ self.weights

    @cached_property
    def variance_dn2(self) -> Floats:
        """Variance of pixels over frames, (n_level,) DN²."""
        return self.variances_dn2 @ self.weights

    @classmethod
    def of(cls, stacks: list[StackStatistics], classes: NDArray[Any], share: Floats | float = 1.0) -> Levels:
        """
        Return the levels of stacks for classes of pixels.

        ``classes`` (n_y, n_x): from 0, or -1 for none. ``share`` (n_y, n_x): weights of pixels.
        """
        weights = block_weights(classes)
        rows: dict[str, list[Any]] = {each.name: [] for each in fields(cls) if each.name != "weights"}
        n_pixels = np.bincount(classes[classes >= 0])
        for k, each in enumerate(stacks):
            means = block_means(each.mean_dn, classes, share)
            variance_dn2 = each.variance_dn2
            variance_dn2 -= each.column_dn2
            variances = block_means(variance_dn2, classes, share)
            noise_dn2 = each.frame_variance_dn2() / each.n_frames
            for c, (mean, variance) in enumerate(zip(means, variances, strict=True)):
                found = k, c, each.n_frames, n_pixels[c], mean, variance, each.column_dn2, noise_dn2
                for name, value in zip(rows, found, strict=True):
                    rows[name].append(value)
        return cls(**{name: np.array(each) for name, each in rows.items()}, weights=weights)


def _blocks(classes: NDArray[Any]) -> Ints:
    return row_blocks(classes.shape[0], unit=2 if classes.max() else 1)


def block_weights(classes: NDArray[Any]) -> Floats:
    """Return the fractions of the pixels in each block, (n_block,)."""
    blocks = _blocks(classes)
    return np.bincount(blocks) / blocks.size


def block_means(values: Floats, classes: NDArray[Any], share: Floats | float = 1.0) -> Floats:
    """Return the weighted means of pixels over each class and block, (n_class, n_block)."""
    from foveasim.twin.frames import _kernels

    totals = np.zeros((int(classes.max()) + 1, classes.shape[0], 2))
    shares, classes = np.broadcast_to(np.float64(share), classes.shape), np.ascontiguousarray(classes, np.int8)
    rows = [range(first, min(first + ROWS, classes.shape[0])) for first in range(0, classes.shape[0], ROWS)]

    def add(part: range) -> None:
        _kernels.add_classes(values, classes, shares, part.start, part.stop, totals)

    parallel_map(add, rows, thread_count())
    of_blocks = np.array([[np.bincount(_blocks(classes), each) for each in of_class.T] for of_class in totals])
    return of_blocks[:, 1] / np.maximum(of_blocks[:, 0], 1e-300)


def row_blocks(n_y: int, *, unit: int = 1) -> Ints:
    """Return the block of each row, (n_y,), of equal numbers of ``unit`` rows."""
    n_units = n_y // unit
    n_blocks = max(1, min(MAX_BLOCKS, n_units // 2))
    of_unit = np.arange(n_units) * n_blocks // n_units
    return np.minimum(np.repeat(of_unit, unit)[np.minimum(np.arange(n_y), n_units * unit - 1)], n_blocks - 1)


def class_index(n_y: int, n_x: int, mosaic: str | None) -> NDArray[np.int8]:
    """Return the class of each pixel, (n_y, n_x): 0, or the position in a mosaic of 2 x 2."""
    if mosaic is None:
        return np.zeros((n_y, n_x), np.int8)
    of_row, of_column = (np.arange(n, dtype=np.int8) % 2 for n in (n_y, n_x))
    return of_row[:, None] * np.int8(2) + of_column

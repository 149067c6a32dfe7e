"""
Statistics of stacks of frames: what a fit needs of them, computed in one pass.

With the codes of n frames of M rows and N columns, the deviations from the mean image are those of frames, rows, columns and
pixels (analysis of variance). Their mean squares are unbiased: with the variances of pixels σ², rows ρ² and columns γ² in a
frame, the mean square of rows is σ² + N ρ², that of columns σ² + M γ².
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, Ints
from foveasim.errors import ParameterError

__all__ = ["StackStatistics", "StackSums", "sum_frames"]

#: Probability of a difference between frames below which it is real, such as flicker of the light.
MAX_PROBABILITY = 1e-3
#: Number of columns above which the mean of a row is subtracted from its pixels.
MIN_COLUMNS = 2
#: Frames that are added at once, while a row of sums stays in the cache.
BATCH = 8


@dataclass(eq=False)
class StackSums:
    """
    Sums over the frames of a stack.

    ``sums``, ``squares``, ``products`` (n_y, n_x) int64: of codes, and with the sum of the row. ``rows`` (n_frame, n_y),
    ``columns`` (n_frame, n_x): sums of lines. ``found`` (3,): number of zeros, highest code, and bits that occur.
    """

    sums: Ints
    squares: Ints
    products: Ints
    rows: Ints
    columns: Ints
    found: Ints


def sum_frames(name: str, frames: Iterable[NDArray[Any]]) -> StackSums:
    """
    Return the sums over frames of codes, which are read once.

    ``frames``: (n_y, n_x) uint8 or uint16 each.

    Raises ParameterError when there are fewer than two frames, of different sizes, or of other numbers.
    """
    from foveasim.twin.frames import _kernels

    batch: list[NDArray[Any]] = []
    total: StackSums | None = None
    rows, columns = [], []

    def add() -> None:
        codes = np.stack(batch)
        assert total is not None
        of_rows, of_columns = (np.zeros((len(batch), n), np.int64) for n in codes.shape[1:])
        _kernels.add_frames(codes, total.sums, total.squares, total.products, of_rows, of_columns, total.found)
        rows.append(of_rows)
        columns.append(of_columns)
        batch.clear()

    for k, frame in enumerate(frames):
        codes = check_frame(f"{name}, frame {k}", frame)
        if total is None:
            zeros = np.zeros(codes.shape, np.int64)
            total = StackSums(zeros, zeros.copy(), zeros.copy(), zeros[:0], zeros[:0], np.zeros(3, np.int64))
        elif codes.shape != total.sums.shape:
            raise ParameterError(
                "frames",
                f"must have the same size, but {name} has frames of {_size(total.sums.shape)} and {_size(codes.shape)}",
            )
        if batch and batch[0].dtype != codes.dtype:
            add()
        batch.append(codes)
        if len(batch) == BATCH:
            add()
    if batch:
        add()
    if total is None or (n_frames := sum(map(len, rows))) < 2:
        raise ParameterError(
            "frames",
            f"must be at least two per stack, but {name} has {0 if total is None else n_frames}: noise is their difference",
        )
    total.rows, total.columns = np.concatenate(rows), np.concatenate(columns)
    return total


def check_frame(name: str, frame: Any) -> NDArray[Any]:
    """Return a frame as uint8 or uint16 (n_y, n_x), after validation."""
    codes = np.asarray(frame)
    if codes.ndim != 2 or min(codes.shape) < 1:
        raise ParameterError("frames", f"must be (n_y, n_x) codes, but {name} has the shape {codes.shape}")
    if codes.dtype in (np.uint8, np.uint16):
        return codes
    if (
        codes.dtype.kind not in "iuf"
        or not np.array_equal(codes, np.rint(codes))
        or codes.min() < 0
        or codes.max() > 65535
    ):
        raise ParameterError(
            "frames",
            f"must contain raw codes, whole numbers from 0 to 65,535, but {name} does not: fit frames before any processing",
        )
    return codes.astype(np.uint16)


def _size(shape: Sequence[int]) -> str:
    return f"{shape[1]} x {shape[0]} pixels"


@dataclass(frozen=True, eq=False)
class StackStatistics:
    """
    Means and variances of the codes of a stack.

    Attributes
    ----------
    n_frames : int
    mean_dn : (n_y, n_x) float64, DN
        Mean over frames; row 0 is that of the frames.
    variance_dn2 : (n_y, n_x) float64, DN²
        Variance over frames of the deviation from the mean of the row: without what rows and frames share.
    row_dn, column_dn : (n_frame, n_y) and (n_frame, n_x) float64, DN
        Deviations of rows and columns of each frame from their mean over frames.
    """

    n_frames: int
    mean_dn: Floats
    variance_dn2: Floats
    row_dn: Floats
    column_dn: Floats

    @classmethod
    def of(cls, total: StackSums) -> StackStatistics:
        """Return the statistics of sums."""
        n, (n_y, n_x) = len(total.rows), total.sums.shape
        row_dn, column_dn = (
            each / m - (each / m).mean(axis=0) for each, m in ((total.rows, n_x), (total.columns, n_y))
        )
        squares = (n * total.squares - total.sums**2) / n
        with_row = total.products / n_x - total.sums * (total.rows.sum(axis=0) / (n * n_x))[:, None]
        residual = squares - 2.0 * with_row + (row_dn**2).sum(axis=0)[:, None]
        # The mean of a row contains the pixel: its deviation has the variance (1 - 2 / n_x) v + (mean of v over the row) / n_x.
        residual /= n - 1
        variance = residual
        if n_x > MIN_COLUMNS:
            variance = (residual - residual.mean(axis=1, keepdims=True) / (n_x - 1)) / (1.0 - 2.0 / n_x)
        return cls(n, total.sums / n, np.maximum(variance, 0.0), row_dn, column_dn)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        n_y, n_x = self.mean_dn.shape
        return n_y, n_x

    @cached_property
    def frame_dn(self) -> Floats:
        """Deviations of frames from their mean, (n_frame,) DN."""
        return np.asarray(self.row_dn.mean(axis=1))

    @cached_property
    def mean_squares_dn2(self) -> dict[str, float]:
        """Mean squares of rows, columns and pixels, DN², without the common deviations of frames."""
        (n_y, n_x), n = self.shape, self.n_frames
        frame = self.frame_dn[:, None]
        row = n_x * float(((self.row_dn - frame) ** 2).sum())
        column = n_y * float(((self.column_dn - frame) ** 2).sum())
        degrees = {"row": (n - 1) * (n_y - 1), "column": (n - 1) * (n_x - 1), "pixel": (n - 1) * (n_y - 1) * (n_x - 1)}
        pixel = (n - 1) * (1.0 - 1.0 / n_x) * float(self.variance_dn2.sum()) - column
        return {
            name: each / max(degrees[name], 1) for name, each in (("row", row), ("column", column), ("pixel", pixel))
        }

    @property
    def column_dn2(self) -> float:
        """Variance that the pixels of a column share, DN²; unbiased, and maybe negative."""
        squares = self.mean_squares_dn2
        return (squares["column"] - squares["pixel"]) / self.shape[0]

    def frame_variance_dn2(self) -> float:
        """
        Return the variance of the mean of a frame, DN².

        That of its pixels, rows and columns, or more if frames differ more, as by flicker.
        """
        from scipy.special import chdtrc

        squares = self.mean_squares_dn2
        own = (squares["row"] + max(squares["column"] - squares["pixel"], 0.0)) / self.mean_dn.size
        found = float(self.frame_dn.var(ddof=1))
        degrees = self.n_frames - 1
        return found if chdtrc(degrees, degrees * found / max(own, 1e-300)) < MAX_PROBABILITY else own

"""
Statistics of stacks of frames: what a fit needs of them, computed in one pass.

With the codes of n frames of M rows and N columns, the deviations from the mean image are those of frames, rows, columns and
pixels (analysis of variance). Their mean squares are unbiased: with the variances of pixels σ², rows ρ² and columns γ² in a
frame, the mean square of rows is σ² + N ρ², that of columns σ² + M γ².
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.threads import cached_property, parallel_map, thread_count
from foveasim._core.validation import Floats, Ints
from foveasim.errors import ParameterError
from foveasim.sensor.adc import ADC

__all__ = ["LinearStatistics", "StackStatistics", "StackSums", "sum_frames", "weighted"]

#: Probability of a difference between frames below which it is real, such as flicker of the light.
MAX_PROBABILITY = 1e-3
#: Number of columns above which the mean of a row is subtracted from its pixels.
MIN_COLUMNS = 2
#: Largest number of codes whose sum has 32 bits.
MAX_SUMMED = 1 << 16
#: Number of columns whose codes are counted, and of codes.
COUNTED, N_CODES = 64, 1 << 16
#: Frames that are added at once, with one access to the sums of pixels.
BATCH = 8
#: Name of the threads that read frames.
READER = "foveasim-frames"
#: Pixels of the rows that a thread adds at a time.
BAND_PIXELS = 1 << 18


@dataclass(eq=False)
class StackSums:
    """
    Sums over the frames of a stack.

    ``sums`` (n_y, n_x) uint32 or int64: of codes. ``squares_dn2`` (n_y, n_x) float64, whole numbers: of d (n_x d - 2 t), with
    differences d from ``centre``, and their sums t in the row. ``rows`` (n_frame, n_y), ``columns`` (n_frame, n_x) int64: sums
    of codes in lines. ``found`` (3,): number of zeros, highest code, and bits that occur. ``counts``: see
    :class:`StackStatistics`.
    """

    sums: NDArray[Any]
    squares_dn2: Floats
    centre: float
    rows: Ints
    columns: Ints
    found: Ints
    counts: NDArray[np.uint32]

    @classmethod
    def zeros(cls, like: NDArray[Any]) -> StackSums:
        """Return sums over no frames, for frames as one of a stack."""
        (n_y, n_x), sample = like.shape, like[:: max(1, like.shape[0] // 64)]
        rows, columns = (np.zeros((0, n), np.int64) for n in (n_y, n_x))
        sums: NDArray[Any] = np.zeros(like.shape, np.uint32)
        centre, found = float(np.rint(sample.mean())), np.zeros(3, np.int64)
        counts = np.zeros((min(n_x, COUNTED), N_CODES), np.uint32)
        return cls(sums, np.zeros(like.shape), centre, rows, columns, found, counts)


def sum_frames(name: str, frames: Iterable[NDArray[Any]]) -> StackSums:
    """
    Return the sums over frames of codes, which are read once, some ahead in another thread.

    ``frames``: (n_y, n_x) uint8 or uint16 each.

    Raises ParameterError when there are fewer than two frames, of different sizes, or of other numbers.
    """
    numbered = enumerate(frames)

    def read() -> list[NDArray[Any]]:
        return [check_frame(f"{name}, frame {k}", frame) for k, frame in islice(numbered, BATCH)]

    total: StackSums | None = None
    whole: Ints | None = None
    rows, columns, n_frames = [], [], 0
    with ThreadPoolExecutor(1, thread_name_prefix=READER) as reader:
        ahead = reader.submit(read)
        while batch := ahead.result():
            ahead = reader.submit(read)
            total = StackSums.zeros(batch[0]) if total is None else total
            for codes in batch:
                if codes.shape != total.sums.shape:
                    sizes = f"{_size(total.sums.shape)} and {_size(codes.shape)}"
                    raise ParameterError("frames", f"must have the same size, but {name} has frames of {sizes}")
            of_rows, of_columns = _add(batch, total)
            rows.append(of_rows)
            columns.append(of_columns)
            n_frames += len(batch)
            if n_frames % MAX_SUMMED == 0:  # more would exceed 32 bits
                whole = total.sums.astype(np.int64) + (0 if whole is None else whole)
                total.sums[:] = 0
    if total is None or n_frames < 2:
        raise ParameterError(
            "frames", f"must be at least two per stack, but {name} has {n_frames}: noise is their difference"
        )
    if whole is not None:
        total.sums = whole + total.sums
    total.rows, total.columns = np.concatenate(rows), np.concatenate(columns)
    total.counts = total.counts[:, : total.found[1] + 1].copy()
    return total


def _add(batch: list[NDArray[Any]], total: StackSums) -> tuple[Ints, Ints]:
    """Add frames to sums; return the sums of their rows and columns."""
    from foveasim.twin.frames import _kernels

    n_frames, (n_y, n_x) = len(batch), total.sums.shape
    if len({codes.dtype for codes in batch}) > 1:
        batch = [codes.astype(np.uint16, copy=False) for codes in batch]
    batch = batch + [np.zeros((n_y, n_x), batch[0].dtype)] * (BATCH - n_frames)
    rows = np.zeros((BATCH, n_y), np.int64)
    chosen = np.arange(len(total.counts)) * n_x // len(total.counts)
    samples = np.empty((BATCH, -(-n_y // 2), chosen.size), np.uint16)

    def add(band: slice) -> tuple[NDArray[np.uint32], Ints]:
        columns, found = np.zeros((BATCH, n_x), np.uint32), np.zeros(3, np.int64)
        _kernels.add_frames(
            *batch, n_frames, band.start, band.stop, total.centre, total.sums, total.squares_dn2, rows, columns, found, chosen,
            samples,
        )  # fmt: skip
        return columns, found

    columns = np.zeros((n_frames, n_x), np.int64)
    for of_columns, (n_zeros, highest, bits) in parallel_map(add, _bands(n_y, n_x), thread_count()):
        columns += of_columns[:n_frames]
        total.found[:] = total.found[0] + n_zeros, max(total.found[1], highest), total.found[2] | bits
    _kernels.count_codes(samples[:n_frames], total.counts)
    return rows[:n_frames], columns


def _bands(n_y: int, n_x: int) -> list[slice]:
    """Return bands of rows."""
    step = min(max(1, BAND_PIXELS // n_x), MAX_SUMMED)
    return [slice(first, min(first + step, n_y)) for first in range(0, n_y, step)]


def check_frame(name: str, frame: Any) -> NDArray[Any]:
    """Return a frame as contiguous uint8 or uint16 (n_y, n_x), after validation."""
    codes: NDArray[Any] = np.asarray(frame)
    if codes.ndim != 2 or min(codes.shape) < 1:
        raise ParameterError("frames", f"must be (n_y, n_x) codes, but {name} has the shape {codes.shape}")
    if codes.dtype.kind == "u" and codes.itemsize <= 2:
        return np.ascontiguousarray(codes, codes.dtype.newbyteorder("="))
    if (
        codes.dtype.kind not in "iuf"
        or (codes.dtype.kind == "f" and not np.array_equal(codes, np.rint(codes)))
        or codes.min() < 0
        or codes.max() > 65535
    ):
        raise ParameterError(
            "frames",
            f"must contain raw codes, whole numbers from 0 to 65,535, but {name} does not: fit frames before any processing",
        )
    return codes.astype(np.uint16, order="C")


def _size(shape: Sequence[int]) -> str:
    return f"{shape[1]} x {shape[0]} pixels"


@dataclass(frozen=True, eq=False)
class StackStatistics:
    """
    Means and variances of the codes of a stack.

    Those of pixels are stored in 8 bytes: a fit needs those of all stacks.

    Attributes
    ----------
    n_frames : int
    sums : (n_y, n_x) uint32 or int64
        Sums over frames; row 0 is that of the frames.
    variances : (n_y, n_x) float32
        ``variance_dn2``.
    row_dn, column_dn : (n_frame, n_y) and (n_frame, n_x) float64, DN
        Deviations of rows and columns of each frame from their mean over frames.
    found : (3,) int64
        Number of codes that are 0, highest code, and bits that occur.
    counts : (n_column, n_code) uint32
        Number of times that codes up to the highest one occur in the even rows, which have one colour of a mosaic, of some
        columns.
    """

    n_frames: int
    sums: NDArray[Any]
    variances: NDArray[np.float32]
    row_dn: Floats
    column_dn: Floats
    found: Ints
    counts: NDArray[np.uint32]

    @classmethod
    def of(cls, total: StackSums) -> StackStatistics:
        """Return the statistics of sums."""
        n, (n_y, n_x) = len(total.rows), total.sums.shape
        row_dn, column_dn = (
            each / m - (each / m).mean(axis=0) for each, m in ((total.rows, n_x), (total.columns, n_y))
        )
        off = total.rows / n_x - total.centre
        off_sum, off_squares = off.sum(axis=0)[:, None], (off**2).sum(axis=0)[:, None]
        variances = np.empty(total.sums.shape, np.float32)

        def fill(band: slice) -> None:
            # Squares of the deviations from the mean of the row, about their mean.
            mean = total.sums[band] - (n * total.centre + off_sum[band])
            residual = total.squares_dn2[band] / n_x + off_squares[band] - mean**2 / n
            residual /= n - 1
            if n_x > MIN_COLUMNS:
                # The mean of a row contains the pixel: its deviation has the variance (1 - 2 / n_x) v + (mean of v over the
                # row) / n_x.
                residual = (residual - residual.mean(axis=1, keepdims=True) / (n_x - 1)) / (1.0 - 2.0 / n_x)
            variances[band] = np.maximum(residual, 0.0)

        parallel_map(fill, _bands(n_y, n_x), thread_count())
        return cls(n, total.sums, variances, row_dn, column_dn, total.found, total.counts)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        n_y, n_x = self.sums.shape
        return n_y, n_x

    @property
    def mean_dn(self) -> Floats:
        """Mean over frames, (n_y, n_x) float64, DN; computed by each access."""
        return self.sums / self.n_frames

    @property
    def variance_dn2(self) -> Floats:
        """
        Variance over frames without what rows and frames share, (n_y, n_x) float64, DN².

        It is that of the deviation from the mean of the row, computed by each access.
        """
        return self.variances.astype(np.float64)

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
        own = (squares["row"] + max(squares["column"] - squares["pixel"], 0.0)) / self.sums.size
        found = float(self.frame_dn.var(ddof=1))
        degrees = self.n_frames - 1
        return found if chdtrc(degrees, degrees * found / max(own, 1e-300)) < MAX_PROBABILITY else own


@dataclass(frozen=True, eq=False)
class LinearStatistics(StackStatistics):
    """
    Statistics in linear codes, for what differs between pixels.

    ``adc``: ADC of the codes.
    """

    adc: ADC

    @classmethod
    def of_codes(cls, each: StackStatistics, adc: ADC) -> LinearStatistics:
        """Return statistics in linear codes of those in codes."""
        found = cls(**{one.name: getattr(each, one.name) for one in fields(each)}, adc=adc)
        width = found._width_dn
        return replace(found, row_dn=each.row_dn * width.mean(axis=1), column_dn=each.column_dn * width.mean(axis=0))

    @property
    def _inside_dn(self) -> Floats:
        return super().mean_dn.clip(0.0, self.adc.n_codes - 1.0)

    @property
    def _width_dn(self) -> Floats:
        return self.adc.width_of_code_dn(self._inside_dn)

    @property
    def mean_dn(self) -> Floats:
        """Mean over frames, (n_y, n_x) float64, DN; computed by each access."""
        return self.adc.linear_of_code_dn(self._inside_dn)

    @property
    def variance_dn2(self) -> Floats:
        """Variance over frames, (n_y, n_x) float64, DN²; computed by each access."""
        return super().variance_dn2 * self._width_dn**2


def weighted(weights: Floats, maps: Iterable[Floats]) -> Floats:
    """Return the sum of maps times weights, (n_y, n_x), of which one is in memory at a time."""
    total = np.zeros(())
    for weight, values in zip(weights, maps, strict=True):
        total = total + weight * values
    return total

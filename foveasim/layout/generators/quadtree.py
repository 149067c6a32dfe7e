"""The quadtree: squares that are split where an importance picture asks, neighbours differing by one level at most."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.validation import (
    Bools,
    Floats,
    Ints,
    check_choice,
    check_count,
    check_length_um,
    check_number,
    finite_array,
)
from foveasim.errors import ParameterError
from foveasim.layout.families import layout_family
from foveasim.layout.model import Layout

__all__ = ["quadtree"]

#: More levels than this would be a slip: 2**15 pixels along the largest square.
MAX_LEVELS = 15


@layout_family(
    example={
        "importance": np.exp(-np.hypot(*np.mgrid[-32:32, -32:32]) / 6.0),
        "pitch_um": 0.5,
        "limit": 1.0,
        "n_levels": 4,
    },
    picture="importance",
)
def quadtree(
    importance: ArrayLike,
    *,
    pitch_um: float,
    limit: float,
    n_levels: int,
    measure: Literal["sum", "peak"] = "sum",
) -> Layout:
    """
    Squares of sides that are powers of two, the smaller the more important the picture says their place is.

    ::

        ┌───────┬───┬───┐  ─┬─
        │       │   │   │   │            largest square: 2^n_levels · pitch_um
        │       ├─┬─┼───┤   │
        │       ├─┼─┤   │   │            smallest: one pixel of the picture, pitch_um
        ├───┬───┼─┴─┴───┤   │
        │   │   │       │   │ n_y · pitch_um
        ├───┼───┤       │   │            no square meets one of less than half or more than twice
        │   │   │       │   │            its side along an edge
        └───┴───┴───────┘  ─┴─
        ├───────────────┤
          n_x · pitch_um

    Parameters
    ----------
    importance : (n_y, n_x) array
        A number of at least 0 for each smallest square, the lowest row first; both sides multiples of 2^n_levels.
    pitch_um : float, µm
        Side of the smallest squares, and of the picture's pixels.
    limit : float
        A square is split while the importance in it is above this.
    n_levels : int
        How often a largest square may be split.
    measure : {"sum", "peak"}
        Whether the importance in a square is the sum over its pixels, or that of its most important pixel.

    Returns
    -------
    Layout
        Row by row of lower left corners, the middle of the picture on the optical axis, with the columns ``level`` (how
        often split), ``row`` and ``column`` (of the lower left corner, in pixels) and ``readout_line`` (the column).

    Raises
    ------
    ParameterError
        When a number is out of range, or the picture does not fit whole largest squares.

    Notes
    -----
    Where a square meets two smaller ones along a side, the corner that they share is a corner of its outline too, so that
    neighbours always share whole edges.

    Examples
    --------
    One important pixel in a corner of 8 × 8 takes 3 squares of each side, and itself:

    >>> picture = np.zeros((8, 8))
    >>> picture[0, 0] = 1.0
    >>> layout = quadtree(picture, pitch_um=2.0, limit=0.5, n_levels=3)
    >>> np.bincount(layout.columns["level"]).tolist(), float(layout.area_um2.sum())
    ([0, 3, 3, 4], 256.0)
    """
    picture = finite_array("importance", importance, ndim=2, at_least=0.0)
    n_levels = check_count("n_levels", n_levels, at_least=0, at_most=MAX_LEVELS)
    block = 2**n_levels
    if 0 in picture.shape or picture.shape[0] % block or picture.shape[1] % block:
        raise ParameterError(
            "importance", f"must have sides that are multiples of {block}, 2 to the 'n_levels', got {picture.shape}"
        )
    pitch_um = check_length_um("pitch_um", pitch_um)
    limit = check_number("limit", limit, at_least=0.0)
    check_choice("measure", measure, ("sum", "peak"))
    splits = [*_splits(picture, limit, n_levels, measure), np.zeros(picture.shape, bool)]
    level, row, column, has_middle = _leaves(splits)

    # Corners and the middles of sides, counter-clockwise from the lower left, in half sides.
    outline = np.array([(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)])
    side = 2 ** (n_levels - level)
    # Middles exist on squares of an even side alone.
    steps = outline * side[:, np.newaxis, np.newaxis] // 2 + np.stack((column, row), axis=1)[:, np.newaxis]
    is_vertex = np.ones((level.size, 8), bool)
    is_vertex[:, 1::2] = has_middle
    middle = 0.5 * np.array(picture.shape[::-1])
    return Layout(
        (steps[is_vertex] - middle) * pitch_um,
        np.concatenate(([0], np.cumsum(is_vertex.sum(axis=1)))),
        np.arange(level.size + 1),
        {"level": level, "row": row, "column": column, "readout_line": column},
        {
            "parameters": {"importance": f"picture of {picture.shape} pixels"},
        },
    )


def _blocks(values: Floats | Bools) -> Floats | Bools:
    """The 2 × 2 blocks of a picture, (n_y / 2, n_x / 2, 4)."""
    n_y, n_x = values.shape
    return np.moveaxis(values.reshape(n_y // 2, 2, n_x // 2, 2), 1, 2).reshape(n_y // 2, n_x // 2, 4)


def _splits(values: Floats, limit: float, n_levels: int, measure: str) -> list[Bools]:
    """Which squares of each level are split, the largest first: where asked, where a part is, and for balance."""
    splits: list[Bools] = []
    finer = np.zeros(values.shape, bool)
    for _ in range(n_levels):
        blocks = _blocks(values)
        values = np.asarray(blocks.sum(axis=2) if measure == "sum" else blocks.max(axis=2))
        # A square that is split needs neighbours of its own size at least, so their squares are split as well.
        padded = np.pad(finer, 1)
        needs = finer | padded[2:, 1:-1] | padded[:-2, 1:-1] | padded[1:-1, 2:] | padded[1:-1, :-2]
        finer = (values > limit) | np.asarray(_blocks(needs).any(axis=2))
        splits.append(finer)
    return splits[::-1]


def _leaves(splits: list[Bools]) -> tuple[Ints, Ints, Ints, Bools]:
    """Level, row and column in pixels of every square that is left whole, and which of its sides meet two squares."""
    parts = []
    exists = np.ones(splits[0].shape, bool)
    for level, split in enumerate(splits):
        row, column = np.nonzero(exists & ~split)
        around = np.pad(split, 1)
        # Below, right, above, left: a neighbour that is split has two squares along this side.
        has_middle = np.stack([around[row + dy, column + dx] for dy, dx in ((0, 1), (1, 2), (2, 1), (1, 0))], axis=1)
        side = 2 ** (len(splits) - 1 - level)
        parts.append((np.full(row.size, level), row * side, column * side, has_middle))
        exists = np.repeat(np.repeat(split, 2, axis=0), 2, axis=1)
    levels, rows, columns, middles = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.lexsort((columns, rows))
    return levels[order], rows[order], columns[order], middles[order]

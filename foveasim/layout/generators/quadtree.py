"""Quadtree layout: squares split by an importance picture, balanced to one level per edge."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import LENGTH, NOT_NEGATIVE, Limits
from foveasim._core.validation import Bools, Floats, Ints, finite_array
from foveasim.errors import ParameterError
from foveasim.layout.generator_registry import layout_generator
from foveasim.layout.model import Layout, layout_of
from foveasim.layout.sizes.site_counts import SolveFor

__all__ = ["quadtree"]

#: Upper limit of levels: 2**15 pixels along the largest square.
MAX_LEVELS = 15


@layout_generator(
    has_mosaic=False,
    example={
        "importance": np.exp(-np.hypot(*np.mgrid[-32:32, -32:32]) / 6.0),
        "pitch_um": 0.5,
        "limit": 1.0,
        "n_levels": 4,
    },
    picture="importance",
    solve_for=(
        SolveFor(
            name="limit",
            is_integer=False,
            is_increasing=False,
            guess=lambda n_sites, parameters: 2.0 * float(np.sum(parameters["importance"])) / n_sites,
        ),
    ),
)
def quadtree(
    importance: ArrayLike,
    *,
    pitch_um: Annotated[float, LENGTH],
    n_levels: Annotated[int, Limits(at_least=0, at_most=MAX_LEVELS)],
    limit: Annotated[float | None, NOT_NEGATIVE] = None,
    measure: Literal["sum", "peak"] = "sum",
    n_sites: int | None = None,  # noqa: ARG001 -- resolved by layout_generator
) -> Layout:
    """
    Generate squares with power-of-two sides, smaller where an importance picture is larger.

    ::

        ┌───────┬───┬───┐  ─┬─
        │       │   │   │   │            largest square: 2^n_levels · pitch_um
        │       ├─┬─┼───┤   │
        │       ├─┼─┤   │   │            smallest: one pixel of the picture, pitch_um
        ├───┬───┼─┴─┴───┤   │
        │   │   │       │   │ n_y · pitch_um
        ├───┼───┤       │   │            sides of squares that share an edge differ by a factor
        │   │   │       │   │            of 2 at most
        └───┴───┴───────┘  ─┴─
        ├───────────────┤
          n_x · pitch_um

    Parameters
    ----------
    importance : (n_y, n_x) array
        Importance >= 0 of each smallest square, the lowest row first; both sides are multiples of 2^n_levels.
    pitch_um : float, µm
        Side of the smallest squares, and pixel pitch of the picture.
    n_levels : int
        Maximum number of subdivisions of a largest square.
    limit : float
        Importance above which a square is split.
    measure : {"sum", "peak"}
        Importance of a square: the sum or the maximum over its pixels.
    n_sites : int, optional
        Number of sites, instead of ``limit``, within 1 %.

    Returns
    -------
    Layout
        Sites row by row in the order of their lower left corners, with the centre of the picture on the optical axis, and the
        columns ``level`` (number of subdivisions), ``row`` and ``column`` (of the lower left corner, in pixels) and
        ``readout_line`` (the column).

    Raises
    ------
    ParameterError
        When a number is out of range, or a side of the picture is not a multiple of 2^n_levels.

    Notes
    -----
    If a square shares a side with two smaller ones, their common corner is also a vertex of its outline, so that neighbours
    always share complete edges.

    Examples
    --------
    A single important pixel in a corner of 8 × 8 results in 3 squares of each size, and itself:

    >>> picture = np.zeros((8, 8))
    >>> picture[0, 0] = 1.0
    >>> layout = quadtree(picture, pitch_um=2.0, limit=0.5, n_levels=3)
    >>> np.bincount(layout.columns["level"]).tolist(), float(layout.area_um2.sum())
    ([0, 3, 3, 4], 256.0)
    """
    picture = finite_array("importance", importance, ndim=2, at_least=0.0)
    assert limit is not None
    block = 2**n_levels
    if 0 in picture.shape or picture.shape[0] % block or picture.shape[1] % block:
        raise ParameterError(
            "importance", f"must have sides that are multiples of {block}, 2 to the 'n_levels', got {picture.shape}"
        )
    splits = [*_split_masks(picture, limit, n_levels, measure), np.zeros(picture.shape, bool)]
    level, row, column, has_midpoint = _leaves(splits)

    # Corners and midpoints of sides, counter-clockwise from the lower left, in half sides.
    outline = np.array([(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)])
    side = 2 ** (n_levels - level)
    # Only squares with an even side have midpoints.
    steps = outline * side[:, np.newaxis, np.newaxis] // 2 + np.stack((column, row), axis=1)[:, np.newaxis]
    is_vertex = np.ones((level.size, 8), bool)
    is_vertex[:, 1::2] = has_midpoint
    centre = 0.5 * np.array(picture.shape[::-1])
    offsets = np.concatenate(([0], np.cumsum(is_vertex.sum(axis=1))))
    columns = {"level": level, "row": row, "column": column, "readout_line": column}
    parameters = {"importance": f"picture of {picture.shape} pixels"}
    return layout_of((steps[is_vertex] - centre) * pitch_um, offsets, None, columns, {"parameters": parameters})


def _blocks(values: Floats | Bools) -> Floats | Bools:
    """Return the 2 × 2 blocks of a picture, (n_y / 2, n_x / 2, 4)."""
    n_y, n_x = values.shape
    return np.moveaxis(values.reshape(n_y // 2, 2, n_x // 2, 2), 1, 2).reshape(n_y // 2, n_x // 2, 4)


def _split_masks(values: Floats, limit: float, n_levels: int, measure: str) -> list[Bools]:
    """Return masks of split squares per level, the largest first, balanced between neighbours."""
    splits: list[Bools] = []
    finer = np.zeros(values.shape, bool)
    for _ in range(n_levels):
        blocks = _blocks(values)
        values = np.asarray(blocks.sum(axis=2) if measure == "sum" else blocks.max(axis=2))
        # A split square requires neighbours of at least its own size, so their parents are split as well.
        padded = np.pad(finer, 1)
        is_required = finer | padded[2:, 1:-1] | padded[:-2, 1:-1] | padded[1:-1, 2:] | padded[1:-1, :-2]
        finer = (values > limit) | np.asarray(_blocks(is_required).any(axis=2))
        splits.append(finer)
    return splits[::-1]


def _leaves(splits: list[Bools]) -> tuple[Ints, Ints, Ints, Bools]:
    """Return level, row and column (pixels) of unsplit squares, and a mask of divided sides."""
    parts = []
    exists = np.ones(splits[0].shape, bool)
    for level, split in enumerate(splits):
        row, column = np.nonzero(exists & ~split)
        around = np.pad(split, 1)
        # Below, right, above, left: a split neighbour has two squares along this side.
        has_midpoint = np.stack([around[row + dy, column + dx] for dy, dx in ((0, 1), (1, 2), (2, 1), (1, 0))], axis=1)
        side = 2 ** (len(splits) - 1 - level)
        parts.append((np.full(row.size, level), row * side, column * side, has_midpoint))
        exists = np.repeat(np.repeat(split, 2, axis=0), 2, axis=1)
    levels, rows, columns, has_midpoints = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.lexsort((columns, rows))
    return levels[order], rows[order], columns[order], has_midpoints[order]

"""Colour filters of photosites: mosaics, random fractions, graph colouring."""

from __future__ import annotations

import math
from collections.abc import Sequence
from string import ascii_uppercase
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import NOT_NEGATIVE, Limits
from foveasim._core.names import CHANNEL_LETTERS, COLOURS, did_you_mean, list_names
from foveasim._core.random_streams import Streams
from foveasim._core.validation import finite_array, freeze
from foveasim.errors import ParameterError
from foveasim.layout.adjacency import adjacency
from foveasim.layout.edit_registry import layout_edit
from foveasim.layout.model import Layout, derived
from foveasim.layout.rows import lattice_index, site_rows

__all__ = ["MOSAICS", "graph_colouring", "mosaic", "random_channels"]

#: Pairs of columns that index the sites in two directions, in order of preference.
INDEX_COLUMNS = (("row", "column"), ("ring", "sector"))
#: Smallest fraction of occupied positions: that of a disc is 0.79, that of staggered rows 0.5.
MIN_LATTICE_FRACTION = 2 / 3
#: Smallest side of a block that a string of letters describes.
MIN_SIDE = 2
#: Named blocks, row 0 lowest. ``rgbw`` is a Bayer block with one green filter replaced by a clear one; the spectral ones have a
#: different filter at each site, in alphabetical order from the top left.
MOSAICS: dict[str, tuple[str, ...]] = {
    "bayer": ("RG", "GB"),
    "quad_bayer": ("RRGG", "RRGG", "GGBB", "GGBB"),
    "nona": ("RRRGGG", "RRRGGG", "RRRGGG", "GGGBBB", "GGGBBB", "GGGBBB"),
    "x_trans": ("RBGBRG", "GGRGGB", "GGBGGR", "BRGRBG", "GGBGGR", "GGRGGB"),
    "rgbw": ("RG", "WB"),
    "spectral_16": ("MNOP", "IJKL", "EFGH", "ABCD"),
    "spectral_25": ("UVWXY", "PQRST", "KLMNO", "FGHIJ", "ABCDE"),
}
#: Order of the filters of letters by default; other letters follow alphabetically.
LETTER_ORDER = "RGBW"


@layout_edit(example={"block": ["RG", "GB"]})
def mosaic(layout: Layout, block: str | Sequence[str], names: str | None = None) -> Layout:
    """
    Return the layout with a repeating block of colour filters.

    Parameters
    ----------
    layout : Layout
        With the columns ``row`` and ``column``, or ``ring`` and ``sector``; or sites on a rectangular lattice, such as those
        of a GDSII file. Row 0 of a lattice is the lowest, column 0 the leftmost.
    block : str or sequence of str
        Name in :data:`MOSAICS`; or rows of letters, one letter per site: ``("RG", "GB")`` is a Bayer block with red at row
        0, column 0, and row 0 is the lowest; or the letters of a square block in reading order, such as
        ``"RGGB"``, ``"RCCB"``, or 16 letters: as in cameras, the first one is the filter at the top left of the layout.
    names : str, optional
        Letters in the order of the sensor's filters: the ``channel`` of a site is the index of its letter. "RGB" by
        default, "RGBW" for a block of these letters with a W; otherwise the letters of the block, R, G, B and W first, then
        alphabetically, or all alphabetically if they are the first ones of the alphabet, for numbered bands. Without
        ``names``, other letters are those of colours (R, G, B, W or C for clear, Y, M, C, E, N or I), and a sensor checks that
        its filters have their names in this order.

    Raises
    ------
    ParameterError
        When the block is neither a name nor a rectangle of letters of ``names`` or of colours, or the layout has no such
        columns and is not a lattice.

    Examples
    --------
    >>> from foveasim.layout import grid
    >>> mosaic(grid(n_x=4, n_y=2, pitch_um=2.0), "BGGR").channel.reshape(2, 4)[
    ...     ::-1
    ... ].tolist()
    [[2, 1, 2, 1], [1, 0, 1, 0]]
    """
    is_from_top = isinstance(block, str) and block not in MOSAICS
    if isinstance(block, str):
        block = _named_block(block)
    rows = list(block) if isinstance(block, Sequence) else []
    if not rows or not all(isinstance(row, str) and row and len(row) == len(rows[0]) for row in rows):
        raise ParameterError("block", "must be rows of letters of equal length, such as ('RG', 'GB')", block)
    is_default = names is None
    if names is None:
        names = _default_names(set("".join(rows)))
        others = sorted(set(names) - set(COLOURS)) if names != ascii_uppercase[: len(names)] else []
        if others:
            raise ParameterError(
                "block",
                f"must use letters of colours, {', '.join(COLOURS)}, got {', '.join(map(repr, others))}",
                hint=f"pass names={names!r}, with the letters in the order of the sensor's filters, for other filters",
            )
    if len(set(names)) != len(names):
        raise ParameterError("names", "must not contain a letter twice", names)
    unknown = sorted(set("".join(rows)) - set(names))
    if unknown:
        raise ParameterError("block", f"must use the letters {names!r}, got {', '.join(map(repr, unknown))}")
    channels = np.array([[names.index(letter) for letter in row] for row in rows], np.int16)
    row, column = _indices(layout)
    from_low, from_left = (site_rows(layout, axis) if is_from_top else None for axis in (1, 0))
    if from_low is not None and from_left is not None:  # the last row of the block is the top one
        row = np.subtract(from_low, (int(from_low.max(initial=0)) + 1) % len(rows), dtype=np.int32)
        column = from_left
    n_rows, n_columns = (np.array(n, np.uint16) for n in channels.shape)
    position = (row % n_rows).astype(np.int32)
    position *= n_columns
    position += column % n_columns
    columns = {**layout.columns, "channel": freeze(channels.ravel()[position])}
    found = derived(layout, f"mosaic {' '.join(rows)} of {names}", columns=columns)
    kept = {key: value for key, value in found.provenance.items() if key != CHANNEL_LETTERS}
    return found.with_provenance(kept | ({CHANNEL_LETTERS: names} if is_default else {}))


def _named_block(name: str) -> Sequence[str]:
    """Return the rows of a named block, the lowest first, or of letters in reading order."""
    if name in MOSAICS:
        return MOSAICS[name]
    side = math.isqrt(len(name))
    if side < MIN_SIDE or side**2 != len(name) or not (name.isalpha() and name.isupper()):
        raise ParameterError(
            "block",
            f"must be one of {list_names(MOSAICS, name)}, the upper-case letters of a square block, such as 'RGGB', or rows "
            "such as ('RG', 'GB')",
            name,
            hint=did_you_mean(name, MOSAICS),
        )
    return [name[k : k + side] for k in range(0, len(name), side)][::-1]


def _default_names(letters: set[str]) -> str:
    """Return the letters of a block in the order of filters."""
    if letters <= set(LETTER_ORDER):
        return LETTER_ORDER if "W" in letters else LETTER_ORDER[:3]
    if letters == set(ascii_uppercase[: len(letters)]):
        return ascii_uppercase[: len(letters)]
    return "".join(sorted(letters, key=lambda letter: (LETTER_ORDER + letter).index(letter) * 1000 + ord(letter)))


def _indices(layout: Layout) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    """Return indices of sites in two directions, from columns or positions on a lattice."""
    pair = next((pair for pair in INDEX_COLUMNS if all(name in layout.columns for name in pair)), None)
    if pair is not None:
        return layout._checked_indices(pair[0]), layout._checked_indices(pair[1])  # noqa: SLF001
    row, column = (lattice_index(layout, axis) if layout.n_sites else None for axis in (1, 0))
    if row is not None and column is not None:
        n_x = int(column.max()) + 1
        n_positions = n_x * (int(row.max()) + 1)
        if np.unique(row * n_x + column).size == layout.n_sites >= MIN_LATTICE_FRACTION * n_positions:
            return row, column
    raise ParameterError(
        "layout",
        f"must have the columns {' or '.join(' and '.join(p) for p in INDEX_COLUMNS)}, or sites on a rectangular lattice, "
        f"got {sorted(layout.columns)}",
        hint="add them with with_columns(row=..., column=...), or the filters with with_columns(channel=...)",
    )


@layout_edit(example={"fractions": [1.0, 2.0, 1.0], "seed": 0})
def random_channels(layout: Layout, fractions: ArrayLike, *, seed: int) -> Layout:
    """
    Return the layout with randomly placed colour filters in exact proportions.

    Parameters
    ----------
    layout : Layout
    fractions : (n_filter,)
        Relative frequencies of the filters: ``(1, 2, 1)`` for twice as much green.
    seed : int

    Returns
    -------
    Layout
        With the column ``channel``: the number of sites of each filter equals its fraction to within one site.

    Raises
    ------
    ParameterError
        When a fraction is negative, or all are 0.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.random_channels(
    ...     fs.layout.grid(n_x=10, n_y=10, pitch_um=2.0), [0.5, 0.25, 0.25], seed=0
    ... )
    >>> np.bincount(layout.channel).tolist()
    [50, 25, 25]
    """
    parts = finite_array("fractions", fractions, ndim=1, at_least=0.0)
    if not parts.sum() > 0.0:
        raise ParameterError("fractions", "must not all be 0", fractions)
    boundaries = np.round(np.cumsum(parts) / parts.sum() * layout.n_sites).astype(np.int64)
    ordered = np.repeat(np.arange(parts.size), np.diff(boundaries, prepend=0))
    return layout.with_columns(channel=Streams(seed).of("layout channels").permutation(ordered))


@layout_edit(example={"n_channels": 3})
def graph_colouring(
    layout: Layout,
    n_channels: Annotated[int, Limits(at_least=1, at_most=64)],
    *,
    max_gap_um: Annotated[float | None, NOT_NEGATIVE] = None,
) -> Layout:
    """
    Return the layout with colour filters that differ between neighbours where possible.

    Parameters
    ----------
    layout : Layout
        Any tiling, such as rings or Voronoi cells; rows and columns are not required.
    n_channels : int
        Number of filters. Four suffice for neighbours to differ on most layouts, three on hexagons.
    max_gap_um : float, optional, µm
        Distance at which sites count as neighbours, as in :meth:`Layout.adjacency`.

    Returns
    -------
    Layout
        With the column ``channel``. Sites whose neighbours already have the most different filters come first. Each site
        gets the filter with the shortest edges shared with neighbours of the same filter, and of those the least used one.

    Raises
    ------
    ParameterError
        When ``n_channels`` is not from 1 to 64.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.graph_colouring(
    ...     fs.layout.hexagonal(n_columns=6, n_rows=6, pitch_um=3.0), 3
    ... )
    >>> sites = layout.adjacency().tocoo()
    >>> bool(
    ...     (layout.channel[sites.row] != layout.channel[sites.col]).all()
    ... )  # no neighbours with the same filter
    True
    """
    from foveasim.layout import _kernels

    shared_um = adjacency(layout) if max_gap_um is None else adjacency(layout, max_gap_um=max_gap_um)
    channel = _kernels.colour_greedily(
        shared_um.indptr.astype(np.int64), shared_um.indices.astype(np.int64), shared_um.data, n_channels
    )
    return layout.with_columns(channel=channel)

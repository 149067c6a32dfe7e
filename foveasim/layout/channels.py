"""Which colour filter each photosite has."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from foveasim.errors import ParameterError
from foveasim.layout._model import Layout

__all__ = ["mosaic"]

#: Pairs of columns that number a layout's sites in two directions, in order of preference.
INDEX_COLUMNS = (("row", "column"), ("ring", "sector"))


def mosaic(layout: Layout, block: Sequence[str], names: str = "RGB") -> Layout:
    """
    The layout with a repeating block of colour filters.

    Parameters
    ----------
    layout : Layout
        With the columns ``row`` and ``column``, or ``ring`` and ``sector``.
    block : sequence of str
        Rows of the block, a letter a site: ``("RG", "GB")`` is a Bayer block with red at row 0, column 0. Row 0 is
        the lowest.
    names : str
        The filters' letters in the order of the sensor's filters: a site's ``channel`` is its letter's position.

    Raises
    ------
    ParameterError
        When the block is not a rectangle of known letters, or the layout has no such columns.
    """
    rows = [block] if isinstance(block, str) else list(block) if isinstance(block, Sequence) else []
    if not rows or not all(isinstance(row, str) and row and len(row) == len(rows[0]) for row in rows):
        raise ParameterError("block", "must be rows of letters of equal length, such as ('RG', 'GB')", block)
    unknown = sorted(set("".join(rows)) - set(names))
    if unknown:
        raise ParameterError("block", f"must use the letters {names!r}, got {', '.join(map(repr, unknown))}")
    pair = next((pair for pair in INDEX_COLUMNS if all(name in layout.columns for name in pair)), None)
    if pair is None:
        raise ParameterError(
            "layout",
            f"must have the columns {' or '.join(' and '.join(p) for p in INDEX_COLUMNS)}, got {sorted(layout.columns)}",
            cure="set its channel column with with_columns(channel=...)",
        )
    channels = np.array([[names.index(letter) for letter in row] for row in rows])
    row, column = (layout.index_column(name) for name in pair)
    return layout._with_columns(  # noqa: SLF001 -- of the same room
        {"channel": channels[row % channels.shape[0], column % channels.shape[1]]},
        f"mosaic {' '.join(rows)} of {names}",
    )

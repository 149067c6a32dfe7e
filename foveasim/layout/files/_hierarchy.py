"""
Congruent sites, and the regular arrays that they form.

Sites on the database grid are congruent if their vertices are equal after a translation, as integers and in the same order. An
array consists of congruent sites in columns and rows of constant pitch, whose numbers and integer columns are linear functions
of the indices in the array, and whose other columns are constant: a few numbers specify all of its sites exactly. Rotated
copies are not congruent: on the database grid, their vertices are rounded differently.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.rings import positions_in_runs
from foveasim._core.validation import Ints

#: Maximum number of columns and of rows of an array in GDSII.
MAX_ARRAY_SIDE = 32767
#: Integers below this limit are exact as steps of an array; columns with larger ones count as constant.
MAX_STEP = 2**53
#: Integer columns with at most so few values, such as channels, are constant in an array: they may be periodic.
MAX_CONSTANTS = 4
#: Periods of mosaics, in sites of the same filter in a row.
STRIDES = (1, 2, 3, 4, 6, 8)


ARRAY_FIELDS = ("first", "n_x", "n_y", "pitch", "number_steps")


@dataclass(frozen=True)
class Arrays:
    """
    Arrays of congruent sites; single sites are arrays of 1 x 1.

    ``first`` (n,): index of the site in column 0, row 0. ``n_x``, ``n_y`` (n,): numbers of columns and rows. ``pitch`` (n, 2):
    pitch of the columns in x and of the rows in y, in database units. ``number_steps`` (n, 2): steps of the site index from
    column to column, and from row to row. ``column_steps``: the same for integer columns.
    """

    first: Ints
    n_x: Ints
    n_y: Ints
    pitch: Ints
    number_steps: Ints
    column_steps: Mapping[str, Ints]

    def select(self, chosen: Any) -> Arrays:
        """Return some of the arrays."""
        first, n_x, n_y, pitch, steps = (getattr(self, name)[chosen] for name in ARRAY_FIELDS)
        return Arrays(first, n_x, n_y, pitch, steps, {name: steps[chosen] for name, steps in self.column_steps.items()})

    def sites(self) -> Ints:
        """Return the sites of all arrays, array after array."""
        size = self.n_x * self.n_y
        array = np.repeat(np.arange(size.size), size)
        j, i = np.divmod(positions_in_runs(size), self.n_x[array])
        return np.asarray(self.first[array] + i * self.number_steps[array, 0] + j * self.number_steps[array, 1])


def single_sites(sites: Ints, columns: Mapping[str, NDArray[Any]]) -> Arrays:
    """Return the given sites as arrays of 1 x 1."""
    one, zero = np.ones(sites.size, np.int64), np.zeros((sites.size, 2), np.int64)
    return Arrays(sites, one, one, zero, zero, dict.fromkeys(columns, zero))


def congruence_classes(xy_dbu: Ints, ring_offsets: Ints, site_offsets: Ints) -> tuple[Ints, Ints]:
    """
    Return the congruence class of each site, and the position of each site.

    ``xy_dbu``: (n_vertex, 2) int64. ``ring_offsets``, ``site_offsets``: packed rings, as of a layout. Returns ``class_of``
    (n_site,) int64: classes 0, 1, ... in no particular order. ``origin_dbu`` (n_site, 2) int64: lower left corner of the
    bounding box; vertices of congruent sites are equal relative to it.
    """
    from foveasim.layout.files import _kernels

    if site_offsets.size == 1:
        return np.zeros(0, np.int64), np.zeros((0, 2), np.int64)
    hashes, origin = _kernels.outline_hashes(xy_dbu, ring_offsets, site_offsets)
    found, first, class_of = np.unique(hashes, return_index=True, return_inverse=True)
    # Sites with equal hashes are compared with the first one of their class; different ones would be a class of their own.
    collided = np.flatnonzero(~_kernels.are_congruent(xy_dbu, ring_offsets, site_offsets, origin, first[class_of]))
    class_of[collided] = found.size + np.arange(collided.size)
    return class_of, origin


def find_arrays(class_of: Ints, origin_dbu: Ints, columns: Mapping[str, NDArray[Any]], max_dbu: int) -> Arrays:
    """
    Divide the sites into arrays.

    ``class_of`` (n_site,) int64: sites of different classes are in different arrays. ``origin_dbu``: (n_site, 2) int64.
    ``columns`` (mapping of str to (n_site,) arrays): columns that the arrays reproduce. ``max_dbu``: maximum coordinate, also
    of the position behind the last column and row.

    Sites in the order of class, y and x are divided into runs of constant pitch, and runs of equal length, pitch and x into
    arrays. Each step is a sort and a pass, repeated for several periods where a class is not regular.
    """
    kind, numbers = class_of, [np.arange(class_of.size)]
    index_of: dict[str, int] = {}
    for name, column in columns.items():
        if _is_linear(column) and np.unique(column).size > MAX_CONSTANTS:
            index_of[name] = 2 + len(numbers)
            numbers.append(column.astype(np.int64))
        else:
            kind = _combine(kind, _codes(column))
    is_repeated = np.bincount(kind)[kind] > 1 if kind.size else np.zeros(0, bool)
    rows = np.column_stack((origin_dbu, *numbers))[is_repeated]
    kind = kind[is_repeated]

    order = np.lexsort((rows[:, 0], rows[:, 1], kind))
    rows, kind = rows[order], kind[order]
    order, start, n_x = _progressions(rows, np.column_stack((kind, rows[:, 1])))
    rows, kind = rows[order], kind[order]
    step_x = _steps(rows, start, n_x)
    rows, keys = rows[start], np.column_stack((kind[start], n_x, rows[start, 0], step_x))
    order = np.lexsort((rows[:, 1], *keys.T[::-1]))
    rows, n_x, step_x, keys = rows[order], n_x[order], step_x[order], keys[order]
    order, start, n_y = _progressions(rows, keys)
    rows, n_x, step_x = rows[order], n_x[order][start], step_x[order][start]
    steps = np.stack((step_x, _steps(rows, start, n_y)), axis=2)
    rows = rows[start]

    none = np.zeros_like(steps[:, 0])
    arrays = Arrays(
        rows[:, 2],
        n_x,
        n_y,
        np.stack((steps[:, 0, 0], steps[:, 1, 1]), axis=1),
        steps[:, 2],
        {name: steps[:, index_of[name]] if name in index_of else none for name in columns},
    )
    end = rows[:, :2] + arrays.pitch * np.stack((n_x, n_y), axis=1)
    is_within = (np.abs(end) <= max_dbu).all(axis=1)
    others = np.concatenate((np.flatnonzero(~is_repeated), arrays.select(~is_within).sites()))
    joined = concatenate(arrays.select(is_within), single_sites(others, columns))
    return joined.select(np.argsort(joined.first))


def _progressions(rows: Ints, keys: Ints) -> tuple[Ints, Ints, Ints]:
    """
    Divide sorted rows into arithmetic progressions of rows with equal keys.

    ``rows`` (n, k) int64: sorted by keys. ``keys`` (n, m) int64: the first key is the kind. Every n-th row of equal keys is in
    the same progressions, with the n of :data:`STRIDES` that leads to the fewest progressions for the kind: in a quad Bayer
    mosaic, the pitch of every second red site is constant. Returns ``order`` (n,) int64: rows in the order of their
    progressions. ``start``, ``size``: first row of each progression in this order, and number of rows.
    """
    from foveasim.layout.files import _kernels

    is_new = np.ones(len(keys), bool)
    is_new[1:] = (keys[1:] != keys[:-1]).any(axis=1)
    group = np.cumsum(is_new) - 1
    position = np.arange(len(keys)) - np.flatnonzero(is_new)[group]
    kind = np.unique(keys[:, 0], return_inverse=True)[1]
    n_kinds = int(kind.max(initial=-1)) + 1

    def divide(chosen: Ints, stride: Any) -> tuple[Ints, Ints]:
        """Return the chosen rows in order of progressions, and the positions of their first rows."""
        residue = position[chosen] % stride
        order = chosen[np.lexsort((residue, group[chosen]))] if np.any(stride != 1) else chosen
        line = group[order] * max(STRIDES) + (
            position[order] % (stride if np.isscalar(stride) else strides[kind[order]])
        )
        return order, np.flatnonzero(_kernels.progressions(np.ascontiguousarray(rows[order]), line, MAX_ARRAY_SIDE))

    strides = np.ones(n_kinds, np.int64)
    order, start = divide(np.arange(len(keys)), 1)
    fewest = np.bincount(kind[start], minlength=n_kinds)
    is_irregular = (fewest > np.bincount(kind[is_new], minlength=n_kinds))[kind]
    if is_irregular.any():
        irregular = np.flatnonzero(is_irregular)
        for stride in STRIDES[1:]:
            order, start = divide(irregular, stride)
            n = np.bincount(kind[order[start]], minlength=n_kinds)
            is_better = (n > 0) & (n < fewest)
            strides[is_better], fewest[is_better] = stride, n[is_better]
        order, start = divide(np.arange(len(keys)), strides[kind])
    return order, start, np.diff(np.append(start, len(rows)))


def _steps(rows: Ints, start: Ints, size: Ints) -> Ints:
    """Return the difference of successive rows of each progression; 0 for a single row."""
    second = np.minimum(start + 1, len(rows) - 1)
    return np.where((size > 1)[:, np.newaxis], rows[second] - rows[start], 0)


def concatenate(*parts: Arrays) -> Arrays:
    """Return the arrays of all parts."""
    first, n_x, n_y, pitch, number_steps = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ARRAY_FIELDS
    )
    steps = {name: np.concatenate([part.column_steps[name] for part in parts]) for name in parts[0].column_steps}
    return Arrays(first, n_x, n_y, pitch, number_steps, steps)


def _is_linear(column: NDArray[Any]) -> bool:
    """Return whether the values are integers whose differences are exact."""
    if column.dtype.kind not in "iu" or column.size == 0:
        return False
    return int(column.min()) > -MAX_STEP and int(column.max()) < MAX_STEP


def _codes(column: NDArray[Any]) -> Ints:
    """Return an integer per distinct value; numbers are distinct if their bits are."""
    if column.dtype.kind == "f":
        column = column.astype(np.float64).view(np.int64)
    return np.asarray(np.unique(column, return_inverse=True)[1], np.int64)


def _combine(a: Ints, b: Ints) -> Ints:
    """Return an integer per distinct pair."""
    return np.asarray(np.unique(a * (int(b.max(initial=0)) + 1) + b, return_inverse=True)[1], np.int64)

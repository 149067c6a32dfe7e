"""Numba kernels of GDSII and OASIS files: records, congruent sites, regular arrays."""

from __future__ import annotations

import numpy as np
from numba import types

from foveasim._core.jit import njit
from foveasim._core.jit.types import FLAGS, INTS, INTS_2D, array_of

_bytes = array_of(types.uint8)
_events = types.Array(types.int64, 2, "C")
_state = types.Array(types.int64, 1, "C")


@njit(types.UniTuple(types.int64, 2)(_bytes, FLAGS, types.int64))
def walk_records(data, is_known, last):
    """
    Follow the records up to type ``last``, an invalid record, or the end of the data.

    Returns ``at``: final position, behind the last record; beyond the data if that record is incomplete. ``record``: type of
    the last record, with its data type; -1 if no valid record begins at ``at``.
    """
    at, record = 0, 0
    while at + 4 <= data.size and record != last:
        length = np.int64(data[at]) << 8 | np.int64(data[at + 1])
        record = np.int64(data[at + 2]) << 8 | np.int64(data[at + 3])
        if length < 4 or length & 1 or not is_known[record]:
            return at, -1
        at += length
    return at, record


#: Events of GDSII records that :func:`gds_events` returns with the position of the record and a number.
(
    CELL,  # BGNSTR
    CELL_NAME,  # STRNAME, length of the name
    NO_WIDTH,  # XY of a path without WIDTH
    ABSOLUTE_WIDTH,  # WIDTH of a path
    PATH_TYPE,  # unknown PATHTYPE, and its value
    EXTENSION,  # BGNEXTN or ENDEXTN of a path of another type, and its value
    ABSOLUTE,  # STRANS of a reference with absolute magnification or angle
    MAGNIFIED,  # MAG of a reference, if it is not 1
    ROTATED,  # ANGLE of a reference, if it is not 0
    ARRAY_SIZE,  # COLROW whose sides are not 1 to 32767, and columns + 65536 rows
    SKEWED,  # XY of an array that is neither rotated nor mirrored, and whose first corner is not on the axes of the others
    FLAT_ARRAY,  # COLROW of an array with a pitch of 0, and columns + 65536 rows without it
) = range(1, 13)


@njit()
def _big_endian(data, at, n_bytes):
    """Return a signed integer of the most significant byte first."""
    value = np.int64(data[at])
    if value > 127:
        value -= 256
    for k in range(1, n_bytes):
        value = value << 8 | np.int64(data[at + k])
    return value


@njit(types.int64(_bytes, _events))
def gds_events(data, events):
    """
    Find the cells, and the records that gdstk reads otherwise than other programs.

    ``data``: records that are complete up to ENDLIB. ``events`` (n, 3) int64, written: kind, position and number; filled as far
    as it suffices. Returns the number of events.
    """
    n, at, element = 0, 0, 0
    has_width = is_turned = False
    path_type, colrow = 0, 0
    while at + 4 <= data.size:
        length, record = np.int64(data[at]) << 8 | np.int64(data[at + 1]), np.int64(data[at + 2])
        if length < 4 or at + length > data.size or record == 0x04:
            break
        kind, number = 0, 0
        if record == 0x05:
            kind = CELL
        elif record == 0x06:
            kind, number = CELL_NAME, length - 4
        elif 0x08 <= record <= 0x0C or record in (0x15, 0x2D):
            element, has_width, is_turned, path_type, colrow = record, False, False, 0, 0
        elif record == 0x11:
            element = 0
        elif element == 0x09:
            if record == 0x0F and length >= 8:
                has_width = True
                if data[at + 4] > 127:
                    kind = ABSOLUTE_WIDTH
            elif record == 0x21 and length >= 6:
                path_type = _big_endian(data, at + 4, 2)
                if path_type not in (0, 1, 2, 4):
                    kind, number = PATH_TYPE, path_type
            elif record in (0x30, 0x31) and length >= 8 and path_type != 4:
                number = _big_endian(data, at + 4, 4)
                kind = EXTENSION if number != 0 else 0
            elif record == 0x10 and not has_width:
                kind, has_width = NO_WIDTH, True
        elif element in (0x0A, 0x0B):
            if record == 0x1A and length >= 6:
                is_turned = is_turned or data[at + 4] > 127
                if data[at + 5] & 6:
                    kind = ABSOLUTE
            elif record == 0x1B and length >= 12 and (_big_endian(data, at + 4, 8) != 0x4110000000000000):
                kind = MAGNIFIED
            elif record == 0x1C and length >= 12 and (_big_endian(data, at + 4, 8) & 0x00FFFFFFFFFFFFFF) != 0:
                kind, is_turned = ROTATED, True
            elif record == 0x13 and length >= 8:
                colrow = at
                columns, rows = _big_endian(data, at + 4, 2) & 0xFFFF, _big_endian(data, at + 6, 2) & 0xFFFF
                if not 1 <= columns <= 32767 or not 1 <= rows <= 32767:
                    kind, number = ARRAY_SIZE, columns + 65536 * rows
            elif record == 0x10 and length >= 28 and colrow > 0:
                x, y = _big_endian(data, at + 4, 4), _big_endian(data, at + 8, 4)
                x_column, y_column = _big_endian(data, at + 12, 4), _big_endian(data, at + 16, 4)
                x_row, y_row = _big_endian(data, at + 20, 4), _big_endian(data, at + 24, 4)
                columns, rows = _big_endian(data, colrow + 4, 2) & 0xFFFF, _big_endian(data, colrow + 6, 2) & 0xFFFF
                is_point = (columns > 1 and x == x_column and y == y_column, rows > 1 and x == x_row and y == y_row)
                if is_point[0] or is_point[1]:
                    if n < len(events):
                        events[n, 0], events[n, 1] = FLAT_ARRAY, colrow
                        events[n, 2] = (1 if is_point[0] else columns) + 65536 * (1 if is_point[1] else rows)
                    n += 1
                if not is_turned and y_column == 0 and x_row == 0 and (x != 0 or y != 0):
                    kind = SKEWED
        if kind:
            if n < len(events):
                events[n, 0], events[n, 1], events[n, 2] = kind, at, number
            n += 1
        at += length
    return n


#: Events of OASIS records that :func:`walk_oasis` returns with the first byte of the record, the one behind it, and a number.
(
    NAME,  # CELLNAME, with its number or -1
    CELL_BY_NUMBER,  # CELL, with its number
    CELL_BY_NAME,  # CELL
    CIRCLE,  # cell and index of the circle among its polygons in place of the bytes, and its radius
    PLACED_BY_NAME,  # PLACEMENT, with the byte of the name
    PLACED_BY_NUMBER,  # PLACEMENT, with the number of the cell
    EXTENSION_RECORD,  # XNAME or XELEMENT
) = range(1, 8)
#: State of :func:`walk_oasis`: index of the cell and of the polygon, radius of the last circle, whether to return placements.
CELL_INDEX, POLYGON_INDEX, RADIUS, WITH_PLACEMENTS = range(4)
#: Reasons to stop at a record: end of the data; no room for further events; a record that is not read here; a truncated one.
AT_STOP, IS_FULL, IS_OTHER, IS_TRUNCATED = range(4)
#: Integers of more bits are cut off: they are only skipped.
MAX_BITS = 62


#: Kinds of fields of OASIS records. All begin with an unsigned integer: the value, a length, a type or a number of values.
INTEGER, RADIUS_FIELD, STRING, NAMED, REAL, REPETITION, POINTS, EXTENSIONS, INTERVAL, SHAPE, VALUE = range(11)
_XY = [(0x10, INTEGER, 0), (0x08, INTEGER, 0), (0x04, REPETITION, 0)]
_LAYER = [(0x01, INTEGER, 0), (0x02, INTEGER, 0)]
_SIZE = [(0x40, INTEGER, 0), (0x20, INTEGER, 0)]
_PLACE = [(0x20, INTEGER, 0), (0x10, INTEGER, 0), (0x08, REPETITION, 0)]
_STRING, _INTEGER = (0, STRING, 0), (0, INTEGER, 0)
#: Fields of the records by type: bits of the first byte with which a field exists (0: always), kind, and for names the bit that
#: stands for a number in place of a string.
_RECORDS: dict[int, tuple[tuple[int, int, int], ...]] = {
    **dict.fromkeys((0, 15, 16, 29), ()),
    **dict.fromkeys((3, 5, 7, 9, 14), (_STRING,)),
    **dict.fromkeys((4, 6, 8, 10), (_STRING, _INTEGER)),
    **dict.fromkeys((11, 12), (_STRING, (0, INTERVAL, 0), (0, INTERVAL, 0))),
    13: (_INTEGER,),
    17: ((0x80, NAMED, 0x40), *_PLACE),
    18: ((0x80, NAMED, 0x40), (0x04, REAL, 0), (0x02, REAL, 0), *_PLACE),
    19: ((0x40, NAMED, 0x20), *_LAYER, *_XY),
    20: (*_LAYER, *_SIZE, *_XY),
    21: (*_LAYER, (0x20, POINTS, 0), *_XY),
    22: (*_LAYER, (0x40, INTEGER, 0), (0x80, EXTENSIONS, 0), (0x20, POINTS, 0), *_XY),
    23: (*_LAYER, *_SIZE, _INTEGER, _INTEGER, *_XY),
    **dict.fromkeys((24, 25), (*_LAYER, *_SIZE, _INTEGER, *_XY)),
    26: (*_LAYER, (0x80, SHAPE, 0), *_SIZE, *_XY),
    27: (*_LAYER, (0x20, RADIUS_FIELD, 0), *_XY),
    28: ((0x04, NAMED, 0x02),),
    30: (_INTEGER, _STRING),
    31: (_INTEGER, _STRING, _INTEGER),
    32: (_INTEGER, _STRING),
}
LAST_RECORD = 34
FIELDS = np.array([field for record in range(LAST_RECORD + 1) for field in _RECORDS.get(record, ())], np.int64)
#: First field of each record; -1 for records that are not read here.
FIRST_FIELD = np.cumsum([0, *(len(_RECORDS.get(record, ())) for record in range(LAST_RECORD + 1))])
IS_READ = np.array([record in _RECORDS for record in range(LAST_RECORD + 1)])


@njit()
def _unsigned(data, at, stop):
    """Return an unsigned integer, and the position behind it; -1 if it is truncated."""
    value, bits = 0, 0
    while 0 <= at < stop:
        byte = np.int64(data[at])
        at += 1
        if bits < MAX_BITS:
            value = (value | (byte & 127) << bits) & ((1 << MAX_BITS) - 1)
        bits += 7
        if byte < 128:
            return value, at
    return 0, -1


@njit()
def _skip_field(data, at, stop, kind, is_number, state):
    """Return the position behind a field; -1 if it is truncated or invalid."""
    value, at = _unsigned(data, at, stop)
    if at < 0:
        return -1
    n_integers, n_deltas, n_bytes = 0, 0, 0
    if kind == RADIUS_FIELD:
        state[RADIUS] = value
    elif kind == STRING or (kind == NAMED and not is_number):
        n_bytes = value
    elif kind == EXTENSIONS:
        n_integers = int(value >> 2 & 3 == 3) + int(value & 3 == 3)
    elif kind == INTERVAL:
        if value > 4:
            return -1
        n_integers = 0 if value == 0 else 2 if value == 4 else 1
    elif kind == SHAPE:
        if value > 25:
            return -1
    elif kind == REAL or (kind == VALUE and value < 8):
        if value > 7:
            return -1
        n_integers = 1 if value < 4 else 2 if value < 6 else 0
        n_bytes = 4 if value == 6 else 8 if value == 7 else 0
    elif kind == VALUE and not 10 <= value <= 12:
        if value > 15:
            return -1
        n_integers = 1
    elif kind == REPETITION and value < 4:
        n_integers = 0 if value == 0 else 4 if value == 1 else 2
    elif kind in (REPETITION, POINTS, VALUE):
        n, at = _unsigned(data, at, stop)
        if at < 0 or value > (11 if kind == REPETITION else 5 if kind == POINTS else 12):
            return -1
        if kind == VALUE:
            n_bytes = n
        elif kind == POINTS:
            n_integers, n_deltas = (n, 0) if value < 4 else (0, n)
        elif value == 8:
            n_integers, n_deltas = 1, 2
        elif value == 9:
            n_deltas = 1
        elif value >= 10:
            n_integers, n_deltas = int(value == 11), n + 1
        else:
            n_integers = n + 1 + int(value in (5, 7))
    if n_integers > stop - at or n_deltas > stop - at or n_bytes > stop - at:
        return -1
    # A vector in one of eight directions is one integer, any other one two.
    is_second = False
    k = 0
    while k < n_integers + n_deltas:
        value, at = _unsigned(data, at, stop)
        if at < 0:
            return -1
        is_second = k >= n_integers and not is_second and value & 1 == 1
        k += 0 if is_second else 1
    return at + n_bytes


@njit()
def _skip_record(data, at, stop, record, state):
    """Return the position behind the fields of a record; -1 if it is truncated or invalid."""
    info = 0
    if 17 <= record <= 28:
        if at >= stop:
            return -1
        info = np.int64(data[at])
        at += 1
    n_values = 0
    f = FIRST_FIELD[record]
    while f < FIRST_FIELD[record + 1] + n_values:
        if f >= FIRST_FIELD[record + 1]:
            at = _skip_field(data, at, stop, VALUE, False, state)
        elif FIELDS[f, 0] == 0 or info & FIELDS[f, 0]:
            at = _skip_field(data, at, stop, FIELDS[f, 1], info & FIELDS[f, 2] != 0, state)
        if at < 0:
            return -1
        f += 1
        if record == 28 and f == FIRST_FIELD[record + 1] and not info & 8:
            n_values = info >> 4
            if n_values == 15:
                n_values, at = _unsigned(data, at, stop)
                if at < 0 or n_values > stop - at:
                    return -1
    return at


@njit(types.UniTuple(types.int64, 3)(_bytes, types.int64, types.int64, _state, _events))
def walk_oasis(data, at, stop, state, events):
    """
    Follow OASIS records up to ``stop``, or to one that is not read here.

    These are START, END, XGEOMETRY, CBLOCK, and unknown ones. ``state`` (4,) int64, written: :data:`CELL_INDEX` and the
    following. ``events`` (n, 4) int64, written. Returns the position of the next record, the number of events, and the reason
    of the stop.
    """
    n = 0
    while at < stop:
        if n == len(events):
            return at, n, IS_FULL
        record = np.int64(data[at])
        if record > LAST_RECORD or not IS_READ[record]:
            return at, n, IS_OTHER
        end = _skip_record(data, at + 1, stop, record, state)
        if end < 0:
            return at, n, IS_TRUNCATED
        kind, number = 0, 0
        if record == 3:
            kind, number = NAME, -1
        elif record == 4:
            kind = NAME
            length, begin = _unsigned(data, at + 1, stop)
            number = _unsigned(data, begin + length, stop)[0]
        elif record in (13, 14):
            kind = CELL_BY_NUMBER if record == 13 else CELL_BY_NAME
            number = _unsigned(data, at + 1, stop)[0]
            state[CELL_INDEX] += 1
            state[POLYGON_INDEX] = 0
        elif record in (17, 18):
            info = np.int64(data[at + 1])
            if state[WITH_PLACEMENTS] and info & 0x80:
                kind = PLACED_BY_NUMBER if info & 0x40 else PLACED_BY_NAME
                number = _unsigned(data, at + 2, stop)[0] if info & 0x40 else at + 2
        elif 20 <= record <= 27:
            if record == 27:
                events[n, 0], events[n, 1], events[n, 2] = CIRCLE, state[CELL_INDEX], state[POLYGON_INDEX]
                events[n, 3] = state[RADIUS]
                n += 1
            state[POLYGON_INDEX] += record != 22
        elif 30 <= record <= 32:
            kind = EXTENSION_RECORD
        if kind:
            events[n, 0], events[n, 1], events[n, 2], events[n, 3] = kind, at, end, number
            n += 1
        at = end
    return at, n, AT_STOP


@njit(types.Array(types.boolean, 1, "C")(INTS_2D, INTS, types.int64))
def progressions(rows, group, at_most):
    """
    Divide rows into arithmetic progressions.

    Successive rows of a progression have a constant difference, and are in the same group.

    ``rows``: (n, k) int64. ``group`` (n,) int64: rows of different groups are in different progressions. ``at_most``: maximum
    length of a progression. Returns ``is_first`` (n,) bool: whether a row is the first of its progression.
    """
    n, k = rows.shape
    is_first = np.zeros(n, np.bool_)
    start = 0
    while start < n:
        is_first[start] = True
        stop = start + 1
        while stop < n and stop - start < at_most and group[stop] == group[start]:
            if stop > start + 1:
                is_regular = True
                for c in range(k):
                    if rows[stop, c] - rows[stop - 1, c] != rows[start + 1, c] - rows[start, c]:
                        is_regular = False
                        break
                if not is_regular:
                    break
            stop += 1
        start = stop
    return is_first


#: Odd multipliers of the hash of an outline: of the position of a vertex, x, y and the ring (splitmix64 and the golden ratio).
_MIX = (
    np.uint64(0x9E3779B97F4A7C15),
    np.uint64(0xBF58476D1CE4E5B9),
    np.uint64(0x94D049BB133111EB),
    np.uint64(0xD6E8FEB86659FD93),
)
_29 = np.uint64(29)


@njit(types.Tuple((types.Array(types.uint64, 1, "C"), types.Array(types.int64, 2, "C")))(INTS_2D, INTS, INTS))
def outline_hashes(xy, ring_offsets, site_offsets):
    """
    Return a hash of each outline that does not depend on its position, and its origin.

    ``xy``: (n_vertex, 2) int64. Returns ``hashes`` (n_site,) uint64: sums modulo 2^64 over the vertices. ``origin`` (n_site, 2)
    int64: the lower left corner of the bounding box.
    """
    n_sites = site_offsets.size - 1
    hashes = np.zeros(n_sites, np.uint64)
    origin = np.empty((n_sites, 2), np.int64)
    for site in range(n_sites):
        first_ring, last_ring = site_offsets[site], site_offsets[site + 1]
        start, stop = ring_offsets[first_ring], ring_offsets[last_ring]
        x_min, y_min = xy[start, 0], xy[start, 1]
        for v in range(start + 1, stop):
            x_min, y_min = min(x_min, xy[v, 0]), min(y_min, xy[v, 1])
        origin[site] = x_min, y_min
        total = np.uint64(0)
        for ring in range(first_ring, last_ring):
            for v in range(ring_offsets[ring], ring_offsets[ring + 1]):
                mixed = np.uint64(v - start + 1) * _MIX[0]
                mixed = (mixed ^ np.uint64(xy[v, 0] - x_min)) * _MIX[1]
                mixed ^= mixed >> _29
                mixed = (mixed ^ np.uint64(xy[v, 1] - y_min)) * _MIX[2]
                mixed ^= mixed >> _29
                mixed = (mixed ^ np.uint64(ring - first_ring)) * _MIX[3]
                mixed ^= mixed >> _29
                total += mixed
        hashes[site] = total
    return hashes, origin


@njit(types.Array(types.boolean, 1, "C")(INTS_2D, INTS, INTS, INTS_2D, INTS))
def are_congruent(xy, ring_offsets, site_offsets, origin, model):
    """
    Return whether each site is a translated copy of its model, vertex by vertex.

    Returns (n_site,) bool. ``xy``: (n_vertex, 2) int64. ``origin``: (n_site, 2) int64. ``model``: (n_site,) int64, sites.
    """
    found = np.zeros(model.size, np.bool_)
    for site in range(model.size):
        other = model[site]
        ring, twin = site_offsets[site], site_offsets[other]
        n_rings = site_offsets[site + 1] - ring
        is_equal = n_rings == site_offsets[other + 1] - twin
        start, shift = ring_offsets[ring], ring_offsets[twin] - ring_offsets[ring]
        if is_equal:
            for k in range(1, n_rings + 1):
                is_equal = is_equal and ring_offsets[ring + k] + shift == ring_offsets[twin + k]
        if is_equal:
            dx, dy = origin[other, 0] - origin[site, 0], origin[other, 1] - origin[site, 1]
            for v in range(start, ring_offsets[ring + n_rings]):
                if xy[v, 0] + dx != xy[v + shift, 0] or xy[v, 1] + dy != xy[v + shift, 1]:
                    is_equal = False
                    break
        found[site] = is_equal
    return found

r"""
Columns of a layout as one string per site.

They are used by formats with shape properties but without tables.

A string consists of words such as ``ring=3 gain=0.25 is_dead=true name="a"``: a key, and a value. A value is a number with
the digits required for an exact round trip, a boolean, or a string quoted as in JSON, with blanks as \u0020. A key is a
plain name, or any other name quoted in the same way. Strings that are read are parsed and never evaluated.

An array of sites has one string. In it, ``row=2+1j`` and ``column=0+1i`` are integers that change by 1 from row to row (index
j) and from column to column (index i); other values are those of all sites of the array.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Bools, Ints, exact_integers

#: Column that GDSII and OASIS store as the datatype.
CHANNEL = "channel"
#: Maximum number of columns of a file.
MAX_COLUMNS = 64
#: Default limit of distinct strings in a column, above the number of sites of any layout.
MAX_STRINGS = 2**62
#: Maximum number of distinct key sets in a file; more do not form columns.
MAX_KINDS = 64
#: Memory limit of a column: in a small file, a repeated cell with long strings could require more than all outlines.
MAX_COLUMN_BYTES = 2**28
#: Names that are not quoted.
PLAIN_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.:-]*")
#: Escapes of blanks and equal signs in quoted strings.
ESCAPES = str.maketrans({" ": "\\u0020", "=": "\\u003d"})
BOOLEANS = {b"true": True, b"false": False}
LINEAR = re.compile(rb"(-?[0-9]+)(?:([+-][0-9]+)i)?(?:([+-][0-9]+)j)?")
QUOTED = re.compile(rb'"(?:[^"\\]|\\.)*"')
_VALUE = re.compile(rb"=\S*")


# -- writing ----------------------------------------------------------------------------------------------------------


def storable_columns(
    columns: Mapping[str, NDArray[Any]],
    first: Ints,
    steps: Mapping[str, Ints],
    max_chars: int | Ints,
    max_strings: int = MAX_STRINGS,
) -> tuple[dict[str, list[Any]], tuple[str, ...]]:
    """
    Return the columns that fit into one string per site or array of sites.

    ``columns``: mapping of str to (n_site,) arrays. ``first`` (n,) int64: the site, or the first site of the array, of each
    string. ``steps`` (mapping of str to (n, 2) int64): differences of the values of successive columns and rows of an array.
    ``max_chars`` (int or (n,) int64): maximum length of a string. ``max_strings``: maximum number of distinct string values of
    a column. Returns ``stored``: values by key: integers, floating-point numbers, and strings. ``dropped``: names of the
    dropped columns, sorted.
    """
    stored: dict[str, list[Any]] = {}
    dropped = []
    n_chars = np.full(first.size, -1)
    for name, column in columns.items():
        values = _values(column[first]) if first.size and len(stored) < MAX_COLUMNS else None
        if values is not None:
            for k in np.flatnonzero(steps[name].any(axis=1)).tolist():
                values[k] = linear_text(values[k], *steps[name][k].tolist())
            key = name if PLAIN_NAME.fullmatch(name) else _quote(name)
            longer = n_chars + len(key) + 2 + np.fromiter(map(len, map(str, values)), np.int64, len(values))
            # Few strings need no count.
            has_few = len(values) <= max_strings or len({v for v in values if isinstance(v, str)}) <= max_strings
            if has_few and (longer <= max_chars).all():
                stored[key], n_chars = values, longer
                continue
        dropped.append(name)
    return stored, tuple(sorted(dropped))


def linear_text(start: int, step_i: int, step_j: int) -> str:
    """Return an integer that changes from column to column and from row to row of an array."""
    return f"{start}" + (f"{step_i:+d}i" if step_i else "") + (f"{step_j:+d}j" if step_j else "")


def column_strings(stored: dict[str, list[Any]]) -> list[str]:
    """Return the string of each site."""
    line = " ".join(f"{key.replace('%', '%%')}=%s" for key in stored)
    return list(map(line.__mod__, zip(*stored.values(), strict=True))) if stored else []


def _values(column: NDArray[Any]) -> list[Any] | None:
    """Return numbers and string representations, or None for an unsupported type."""
    kind = column.dtype.kind
    if kind == "b":
        return np.where(column, "true", "false").tolist()
    if kind == "U":
        return [_quote(text) for text in column.tolist()]
    if kind not in "iuf" or column.dtype.itemsize > 8:
        return None
    numbers = column if kind in "iu" else column.astype(np.float64)
    values = numbers.tolist()
    for i in np.flatnonzero(~_is_exact_in_oasis(numbers)).tolist():
        values[i] = str(values[i])
    return values


def _is_exact_in_oasis(numbers: NDArray[Any]) -> Bools:
    """
    Return whether numbers survive an OASIS round trip exactly.

    gdstk crashes on the smallest integer, and writes any number whose inverse rounds to an integer as a reciprocal.
    """
    if numbers.dtype.kind in "iu":
        return np.asarray(numbers != np.iinfo(np.int64).min)
    with np.errstate(all="ignore"):
        inverse = 1.0 / numbers
        is_reciprocal = (inverse == np.trunc(inverse)) & (np.abs(inverse) < 2.0**64) & (numbers != np.trunc(numbers))
        is_other = is_reciprocal & (1.0 / inverse != numbers)
    return np.asarray(~is_other & ~np.isinf(numbers) & ~((numbers == 0.0) & np.signbit(numbers)))


def _quote(text: str) -> str:
    return json.dumps(text).translate(ESCAPES)


# -- reading ----------------------------------------------------------------------------------------------------------


def parse_columns(lines: bytes) -> dict[str, tuple[NDArray[Any], Ints | None]]:
    """
    Return the columns that every string contains.

    ``lines``: one string per line, in printable ASCII; untrusted. Returns ``columns``: one value per line, and for integers
    that change within arrays their steps, (n_line, 2) int64.
    """
    columns: dict[str, tuple[NDArray[Any], Ints | None]] = {}
    for key, values in (_parse_uniform_lines(lines) or _parse_mixed_lines(lines)).items():
        name, column, steps = _name(key), _column(values), None
        if column is None:
            column, steps = _linear_integers(values)
        if name is not None and column is not None:
            columns[name] = (column, steps)
    return columns


def _parse_uniform_lines(lines: bytes) -> dict[bytes, Sequence[bytes]]:
    """
    Return values by key where all strings have the same keys, else an empty dict.

    Strings that foveasim wrote have the same keys.
    """
    keys = [word.partition(b"=")[0] for word in lines.split(b"\n", 1)[0].split()]
    if len({*keys}) != len(keys) or len(keys) > MAX_COLUMNS:
        return {}
    # With the additional empty group, findall returns tuples even for a single key.
    pattern = rb" ".join(re.escape(key) + rb"=(\S*)" for key in keys) + rb"()"
    rows = re.findall(b"^" + pattern + b"$", lines, re.MULTILINE)
    return dict(zip(keys, zip(*rows, strict=True), strict=False)) if len(rows) == lines.count(b"\n") + 1 else {}


def _parse_mixed_lines(lines: bytes) -> dict[bytes, Sequence[bytes]]:
    """Return the values of the keys that every string contains exactly once."""
    keys_of_line = _VALUE.sub(b"", lines).split(b"\n")
    kinds = {keys: i for i, keys in enumerate(dict.fromkeys(keys_of_line))}
    if len(kinds) > MAX_KINDS:
        return {}
    keys_of_kind = [keys.split() for keys in kinds]
    kind = np.fromiter(map(kinds.__getitem__, keys_of_line), np.int64, len(keys_of_line))
    n_words = np.array([len(keys) for keys in keys_of_kind])[kind]
    words = lines.split()
    if n_words.sum() != len(words):
        return {}
    first = np.cumsum(n_words) - n_words
    values: dict[bytes, Sequence[bytes]] = {}
    for key in keys_of_kind[0][:MAX_COLUMNS]:
        if all(keys.count(key) == 1 for keys in keys_of_kind):
            index = first + np.array([keys.index(key) for keys in keys_of_kind])[kind]
            values[key] = [words[i][len(key) + 1 :] for i in index.tolist()]
    return values


def _name(key: bytes) -> str | None:
    if not key.startswith(b'"'):
        return key.decode("ascii")
    try:
        name = json.loads(key)
    except ValueError:
        return None
    return name if isinstance(name, str) else None


def _column(values: Sequence[bytes]) -> NDArray[Any] | None:
    """Return the values as an array, or None for values of several types."""
    try:
        if values[0] in BOOLEANS:
            return np.array([BOOLEANS[value] for value in values])
        if values[0].startswith(b'"'):
            return _strings(values)
        return _numbers(values)
    except (KeyError, ValueError, OverflowError):
        return None


def _numbers(values: Sequence[bytes]) -> NDArray[Any] | None:
    try:
        return exact_integers(list(map(int, values)))
    except ValueError:
        return np.array(list(map(float, values)))


def _linear_integers(values: Sequence[bytes]) -> tuple[NDArray[Any] | None, Ints | None]:
    """Return integers and their steps within arrays, or None for other values."""
    matches = list(map(LINEAR.fullmatch, values))
    if not all(matches):
        return None, None
    try:
        table = np.array([[int(number or 0) for number in match.groups()] for match in matches if match], np.int64)
    except (OverflowError, ValueError):
        return None, None
    return table[:, 0], table[:, 1:]


def _strings(values: Sequence[bytes]) -> NDArray[Any] | None:
    if not all(map(QUOTED.fullmatch, values)):
        return None
    strings = json.loads(b"[" + b",".join(values) + b"]")
    return np.array(strings) if 4 * max(map(len, strings)) * len(strings) <= MAX_COLUMN_BYTES else None

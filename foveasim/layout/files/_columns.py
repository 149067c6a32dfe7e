r"""
Columns of a layout as a short text of each site, for formats that know shapes and their properties but no tables.

A text is made of words as ``ring=3 gain=0.25 is_dead=true name="a"``: a key, and a value that is a number of as many
digits as it takes to be the same again, a truth value, or text as JSON quotes it, blanks as \u0020. A key is a plain name,
or any name quoted as text is. Nothing that is read is evaluated.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Bools, exact_integers
from foveasim.layout.model import Layout

__all__ = ["CHANNEL", "MAX_COLUMN_BYTES", "columns_of", "kept_columns", "texts_of"]

#: The column that chip formats keep elsewhere, as the data type.
CHANNEL = "channel"
#: Columns of a file that are read.
MAX_COLUMNS = 64
#: More different texts in a column than any layout has sites.
MAX_TEXTS = 2**62
#: Texts with different keys in a file; more are no columns.
MAX_KINDS = 64
#: A column of long texts, read from a small file whose cell stands there often, would take more than all outlines.
MAX_COLUMN_BYTES = 2**28
#: Names that stand as they are.
PLAIN_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.:-]*")
#: What is said instead of blanks and equal signs in quoted text.
ESCAPES = str.maketrans({" ": "\\u0020", "=": "\\u003d"})
TRUTHS = {b"true": True, b"false": False}
QUOTED = re.compile(rb'"(?:[^"\\]|\\.)*"')
_VALUE = re.compile(rb"=\S*")


# -- writing ----------------------------------------------------------------------------------------------------------


def kept_columns(
    layout: Layout, max_chars: int, max_texts: int = MAX_TEXTS
) -> tuple[dict[str, list[Any]], tuple[str, ...]]:
    """
    The columns that a text of each site can hold, beside the channel.

    Parameters
    ----------
    layout : Layout
    max_chars : int
        Length of the longest text.
    max_texts : int
        Different values of a column that are text and not numbers.

    Returns
    -------
    kept : dict of str to list
        Values by their key: whole and floating-point numbers, and text.
    lost : tuple of str
        Names of the columns that are left out, sorted.
    """
    kept: dict[str, list[Any]] = {}
    lost = []
    n_chars = np.full(layout.n_sites, -1)
    for name, column in layout.columns.items():
        if name == CHANNEL:
            continue
        values = _values(column) if layout.n_sites and len(kept) < MAX_COLUMNS else None
        if values is not None:
            key = name if PLAIN_NAME.fullmatch(name) else _quoted(name)
            longer = n_chars + len(key) + 2 + np.fromiter(map(len, map(str, values)), np.int64, len(values))
            if longer.max() <= max_chars and len({v for v in values if isinstance(v, str)}) <= max_texts:
                kept[key], n_chars = values, longer
                continue
        lost.append(name)
    return kept, tuple(sorted(lost))


def texts_of(kept: dict[str, list[Any]]) -> list[str]:
    """The text of each site."""
    words = [[f"{key}={value}" for value in values] for key, values in kept.items()]
    return list(map(" ".join, zip(*words, strict=True)))


def _values(column: NDArray[Any]) -> list[Any] | None:
    """Numbers, and text that stands for a value; nothing for a column of another type."""
    kind = column.dtype.kind
    if kind == "b":
        return np.where(column, "true", "false").tolist()
    if kind == "U":
        return [_quoted(text) for text in column.tolist()]
    if kind not in "iuf" or column.dtype.itemsize > 8:
        return None
    numbers = column if kind in "iu" else column.astype(np.float64)
    values = numbers.tolist()
    for i in np.flatnonzero(~_is_exact_in_oasis(numbers)).tolist():
        values[i] = str(values[i])
    return values


def _is_exact_in_oasis(numbers: NDArray[Any]) -> Bools:
    """
    Which numbers come back from OASIS as they were.

    gdstk crashes on the smallest integer, and writes as a reciprocal any number whose inverse rounds to a whole one.
    """
    if numbers.dtype.kind in "iu":
        return np.asarray(numbers != np.iinfo(np.int64).min)
    with np.errstate(all="ignore"):
        inverse = 1.0 / numbers
        is_reciprocal = (inverse == np.trunc(inverse)) & (np.abs(inverse) < 2.0**64) & (numbers != np.trunc(numbers))
        is_other = is_reciprocal & (1.0 / inverse != numbers)
    return np.asarray(~is_other & ~np.isinf(numbers) & ~((numbers == 0.0) & np.signbit(numbers)))


def _quoted(text: str) -> str:
    return json.dumps(text).translate(ESCAPES)


# -- reading ----------------------------------------------------------------------------------------------------------


def columns_of(texts: bytes) -> dict[str, NDArray[Any]]:
    """
    Columns that every text tells, one text a line.

    Parameters
    ----------
    texts : bytes
        Printable ASCII; from a stranger.
    """
    columns: dict[str, NDArray[Any]] = {}
    for key, values in (_values_of_like_texts(texts) or _values_of_texts(texts)).items():
        name, column = _name(key), _column(values)
        if name is not None and column is not None and name != CHANNEL:
            columns[name] = column
    return columns


def _values_of_like_texts(texts: bytes) -> dict[bytes, Sequence[bytes]]:
    """Values by key where all texts have the same keys, as those have that were written here; else nothing."""
    keys = [word.partition(b"=")[0] for word in texts.split(b"\n", 1)[0].split()]
    if len({*keys}) != len(keys) or len(keys) > MAX_COLUMNS:
        return {}
    # The empty group makes tuples of the groups, of one also.
    text = rb" ".join(re.escape(key) + rb"=(\S*)" for key in keys) + rb"()"
    rows = re.findall(b"^" + text + b"$", texts, re.MULTILINE)
    return dict(zip(keys, zip(*rows, strict=True), strict=False)) if len(rows) == texts.count(b"\n") + 1 else {}


def _values_of_texts(texts: bytes) -> dict[bytes, Sequence[bytes]]:
    """Values of the keys that every text has once."""
    keys_of_text = _VALUE.sub(b"", texts).split(b"\n")
    kinds = {keys: i for i, keys in enumerate(dict.fromkeys(keys_of_text))}
    if len(kinds) > MAX_KINDS:
        return {}
    keys_of_kind = [keys.split() for keys in kinds]
    kind = np.fromiter(map(kinds.__getitem__, keys_of_text), np.int64, len(keys_of_text))
    n_words = np.array([len(keys) for keys in keys_of_kind])[kind]
    words = texts.split()
    if n_words.sum() != len(words):
        return {}
    first = np.cumsum(n_words) - n_words
    values: dict[bytes, Sequence[bytes]] = {}
    for key in keys_of_kind[0][:MAX_COLUMNS]:
        if all(keys.count(key) == 1 for keys in keys_of_kind):
            at = first + np.array([keys.index(key) for keys in keys_of_kind])[kind]
            values[key] = [words[i][len(key) + 1 :] for i in at.tolist()]
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
    """The values as an array; nothing where they are not all of one type."""
    try:
        if values[0] in TRUTHS:
            return np.array([TRUTHS[value] for value in values])
        if values[0].startswith(b'"'):
            return _texts(values)
        return _numbers(values)
    except (KeyError, ValueError, OverflowError):
        return None


def _numbers(values: Sequence[bytes]) -> NDArray[Any] | None:
    try:
        return exact_integers(list(map(int, values)))
    except ValueError:
        return np.array(list(map(float, values)))


def _texts(values: Sequence[bytes]) -> NDArray[Any] | None:
    if not all(map(QUOTED.fullmatch, values)):
        return None
    texts = json.loads(b"[" + b",".join(values) + b"]")
    return np.array(texts) if 4 * max(map(len, texts)) * len(texts) <= MAX_COLUMN_BYTES else None

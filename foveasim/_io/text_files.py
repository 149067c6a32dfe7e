"""Small text files that are not trusted: UTF-8, tables in CSV, XML."""

from __future__ import annotations

import csv
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

from foveasim._core.names import missing_path
from foveasim.errors import FileError

__all__ = ["parse_xml", "read_columns", "read_rows", "read_text"]

#: Numbers with a decimal comma and with a decimal point.
COMMA_NUMBER = re.compile(r"[-+]?(\d+,\d*|,\d+)([eE][-+]?\d+)?")
POINT_NUMBER = re.compile(r"[-+]?(\d+\.\d*|\.\d+)([eE][-+]?\d+)?")

#: Largest depth of elements in XML; the supported files have a few levels.
MAX_XML_DEPTH = 50


def read_text(path: Path, what: str, max_bytes: int) -> str:
    """
    Read a UTF-8 text file, with or without a byte order mark.

    ``what``: expected content, for the message. Raises FileError when the file is missing, larger than ``max_bytes``, or not
    UTF-8 text.
    """
    try:
        if not path.is_file():
            raise FileError(path, missing_path(path))
        if path.stat().st_size > max_bytes:
            raise FileError(path, f"must be {what} with at most {max_bytes} bytes")
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise FileError(path, "is not valid UTF-8 text") from None
    except (OSError, ValueError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(path, f"cannot be read: {getattr(error, 'strerror', None) or error}") from None


def read_rows(
    path: Path, what: str, max_bytes: int, *, has_numbers: bool = True, has_comments: bool = False
) -> list[tuple[int, list[str]]]:
    """
    Read the rows of a table, with the separator and the decimal mark of its program.

    Columns are separated by semicolons, tabs, commas or blanks, whichever the first line contains, in this order. Where they
    are not separated by commas, numbers may have decimal commas. A separator at the end of all rows is ignored.

    ``what``, ``max_bytes``: as for :func:`read_text`. ``has_numbers``: whether cells with numbers are returned with decimal
    points. ``has_comments``: whether lines that begin with ``#`` are ignored. Returns the number of each line with content, and
    its cells. Raises FileError when the file cannot be read, is not a table, or has decimal points and commas.
    """
    lines = read_text(path, what, max_bytes).splitlines()
    if has_comments:
        lines = ["" if line.lstrip().startswith("#") else line for line in lines]
    separator = _separator(next((line for line in lines if line.strip()), ""))
    if separator == " ":
        rows = [(number, line.split()) for number, line in enumerate(lines, 1) if line.strip()]
    else:
        reader, rows, number = csv.reader(lines, delimiter=separator, strict=True), [], 1
        try:
            for row in reader:
                rows.append((number, [cell.strip() for cell in row]))
                number = reader.line_num + 1
        except csv.Error as error:
            raise FileError(path, f"line {number} cannot be split into columns: {error}") from None
    rows = _without_trailing_cells([(number, row) for number, row in rows if any(row)])
    if has_numbers and separator != ",":
        rows = _with_decimal_points(path, rows)
    return rows


def _separator(line: str) -> str:
    """Return the separator of columns in a line."""
    for mark in ";\t":
        if mark in line:
            return mark
    cells = line.split()
    has_decimal_commas = len(cells) > 1 and all(COMMA_NUMBER.fullmatch(cell) or cell.isdigit() for cell in cells)
    return "," if "," in line and not has_decimal_commas else " "


def _without_trailing_cells(rows: list[tuple[int, list[str]]]) -> list[tuple[int, list[str]]]:
    """Return rows without the empty cells after a separator at the end of each line."""
    n_columns = max((len(row) for _, row in rows), default=0)
    has_end = [len(row) == n_columns and row[-1] == "" for _, row in rows]
    is_shorter = [len(row) == n_columns - 1 for _, row in rows]
    # Either the first line or all others may lack it.
    is_header_only = has_end[:1] == [True] and all(is_shorter[1:])
    is_without_header = is_shorter[:1] == [True] and all(has_end[1:])
    if n_columns < 2 or len(rows) < 2 or not (all(has_end) or is_header_only or is_without_header):
        return rows
    return [(number, row[: n_columns - 1]) for number, row in rows]


def _with_decimal_points(path: Path, rows: list[tuple[int, list[str]]]) -> list[tuple[int, list[str]]]:
    """Return rows whose numbers have decimal points instead of commas."""
    commas = [number for number, row in rows if any(COMMA_NUMBER.fullmatch(cell) for cell in row)]
    points = [number for number, row in rows if any(POINT_NUMBER.fullmatch(cell) for cell in row)]
    if commas and points:
        raise FileError(
            path, f"has decimal points, in line {points[0]}, and commas, in line {commas[0]}; use one decimal mark"
        )
    if not commas:
        return rows
    return [
        (number, [cell.replace(",", ".") if COMMA_NUMBER.fullmatch(cell) else cell for cell in row])
        for number, row in rows
    ]


def read_columns(
    path: Path,
    what: str,
    names: Sequence[str],
    max_bytes: int,
    *,
    has_numbers: bool = True,
    has_comments: bool = False,
) -> list[tuple[int, list[str]]]:
    """
    Read columns of a table by the names in its first line.

    Returns the number of each line with its cells in the order of ``names``; empty lines and other columns are ignored.
    ``what``, ``max_bytes``, ``has_numbers``, ``has_comments``: as for :func:`read_rows`. Raises FileError when the file cannot
    be read, or a column or a cell is missing.
    """
    rows = read_rows(path, what, max_bytes, has_numbers=has_numbers, has_comments=has_comments)
    header = rows[0][1] if rows else []
    if not set(names) <= set(header):
        required = " and ".join((", ".join(map(repr, names[:-1])), repr(names[-1])))
        raise FileError(path, f"must have the columns {required} in its first line, got {header}")
    columns = [header.index(name) for name in names]
    found = []
    for number, row in rows[1:]:
        if len(row) != len(header):
            raise FileError(path, f"has {len(row)} values in line {number}, expected {len(header)}")
        found.append((number, [row[column] for column in columns]))
    return found


def parse_xml(source: Path, content: bytes, root: str, what: str, *, error: type[FileError] = FileError) -> ET.Element:
    """
    Return the root element of an XML file of another program.

    ``root``: required tag. ``what``: expected kind of the file, for messages: ``"KLayout report database"``. Raises ``error``
    when the file is not XML, declares entities, which can expand without limit, is too deep, or has another root.
    """
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise error(source, f"declares XML entities, which are not allowed in a {what}")
    try:
        found = ET.fromstring(content)  # noqa: S314 -- entities are rejected above
    except ET.ParseError as problem:
        raise error(source, f"is corrupt, or not a {what} ({problem})") from None
    if found.tag != root:
        raise error(source, f"is not a {what}, whose root is {root}; got {found.tag!r:.40}")
    level, depth = [found], 1
    while level := [child for element in level for child in element]:
        depth += 1
        if depth > MAX_XML_DEPTH:
            raise error(source, f"has elements in more than {MAX_XML_DEPTH} levels, which a {what} cannot have")
    return found

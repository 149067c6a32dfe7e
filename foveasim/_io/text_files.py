"""Small text files that are not trusted: UTF-8, tables in CSV, XML."""

from __future__ import annotations

import csv
import io
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

from foveasim._core.names import missing_path
from foveasim.errors import FileError

__all__ = ["parse_xml", "read_columns", "read_text"]

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


def read_columns(path: Path, what: str, names: Sequence[str], max_bytes: int) -> list[tuple[int, list[str]]]:
    """
    Read columns of a CSV file by the names in its first line.

    Returns the number of each line with its cells in the order of ``names``; empty lines and other columns are ignored.
    ``what``, ``max_bytes``: as for :func:`read_text`. Raises FileError when the file cannot be read, or a column or a cell is
    missing.
    """
    try:
        lines = list(csv.reader(io.StringIO(read_text(path, what, max_bytes), newline=""), strict=True))
    except csv.Error as error:
        raise FileError(path, f"is not a valid CSV file ({error})") from None
    header = [name.strip() for name in lines[0]] if lines else []
    if not set(names) <= set(header):
        required = " and ".join((", ".join(map(repr, names[:-1])), repr(names[-1])))
        raise FileError(path, f"must have the columns {required} in its first line, got {header}")
    columns = [header.index(name) for name in names]
    found = []
    for number, line in enumerate(lines[1:], 2):
        if not line:
            continue
        if len(line) != len(header):
            raise FileError(path, f"has {len(line)} values in line {number}, expected {len(header)}")
        found.append((number, [line[column].strip() for column in columns]))
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

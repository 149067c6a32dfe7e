"""Results of sweep points as plain data, and the journal file of a running sweep."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import re
import time
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from foveasim._core.provenance import differences
from foveasim._io.atomic import lock, rename_or_remove
from foveasim.errors import FileError, ParameterError, type_name

FORMAT, VERSION = "foveasim sweep", 1
#: Beginning of a journal: a checksum and the format.
TRUNCATED_HEADER = rb'[0-9a-f]{1,8} \{"format": "foveasim'
#: Longest time before journal lines are synchronised to the disk, seconds.
SYNC_S = 1.0
#: Error of a point whose worker process ended in every attempt.
WORKER_LOST = "worker process ended in every attempt: out of memory, or a crash in a metric"
#: Results of metrics other than arrays.
Scalar = bool | int | float | str


@dataclass(frozen=True, eq=False)
class Value:
    """Array result of a metric, with dimension names and optional labels."""

    data: NDArray[Any]
    dims: tuple[str, ...]
    labels: Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Record:
    """Values of one point by name, its error message and its warnings (empty if none)."""

    point: int
    values: Mapping[str, Scalar | Value]
    error: str = ""
    warning: str = ""


def to_values(name: str, given: Any) -> dict[str, Scalar | Value]:
    """Convert the result of a metric to values by variable name."""
    if isinstance(given, Mapping):
        found: dict[str, Scalar | Value] = {}
        for key, item in given.items():
            new_values = to_values(_name(f"{name}_{key}"), item)
            check_unique(found, new_values)
            found |= new_values
        return found
    if isinstance(given, np.generic | np.ndarray):
        return {name: _value(name, given, tuple(f"{name}_{k}" for k in range(given.ndim)), {})}
    if isinstance(given, Scalar):
        return {name: _scalar(name, given)}
    if all(hasattr(given, part) for part in ("values", "dims", "coords")):
        dims = tuple(_name(str(dim)) for dim in given.dims)
        labels = {str(dim): given.coords[dim].values for dim in given.dims if dim in given.coords}
        return {name: _value(name, given.values, dims, labels)}
    raise ParameterError(
        name, f"must return a number, a string, a mapping, an array or a labelled array, got {type_name(given)}"
    )


def check_unique(found: Collection[str], names: Iterable[str]) -> None:
    """Check that the names of new variables are not used yet."""
    repeated = next((name for name in names if name in found), None)
    if repeated is not None:
        raise ParameterError(repeated, "must be a unique result name, got two results")


def _name(name: str) -> str:
    """Return a name after checking that it is valid for an array directory of the store."""
    if (
        not name.isprintable()
        or not name.strip(". ")
        or name == "zarr.json"
        or set(name) & {"/", "\\"}
        or len(name) > 100
    ):
        raise ParameterError(name[:100], "must be a short printable string without '/', as the name of a result")
    return name


def _value(name: str, data: Any, dims: tuple[str, ...], labels: Mapping[str, Any]) -> Scalar | Value:
    """Return an array with its labels, or a number or string for a 0-d array."""
    array = _as_basic_array(name, data)
    if not dims:
        return _scalar(name, array.item())
    if len(set(dims)) < len(dims):
        raise ParameterError(name, f"must have unique dimension names, got {', '.join(dims)}")
    basic = {dim: _as_basic_array(name, each) for dim, each in labels.items()}
    for dim, each in basic.items():
        if len(set(each.tolist())) < each.size or (each.dtype.kind == "f" and np.isnan(each).any()):
            raise ParameterError(name, f"must have unique labels along '{dim}', without NaN")
    return Value(array, dims, basic)


def _as_basic_array(name: str, array: Any) -> NDArray[Any]:
    """Convert data to an array of numbers or strings that every store supports."""
    array = np.asarray(array)
    if array.dtype.kind == "T" or (array.dtype.kind == "O" and all(isinstance(item, str) for item in array.flat)):
        array = array.astype(str)
    if array.dtype.kind not in "biufU":
        raise ParameterError(name, f"must return numbers or strings, got an array of {array.dtype}")
    if array.dtype.kind == "f" and array.dtype.itemsize > np.dtype(np.float64).itemsize:
        array = array.astype(np.float64)
    if array.dtype.kind == "U":
        _scalar(name, "".join(array.flat))
    return np.array(array, array.dtype.newbyteorder("="), order="C")


def _scalar(name: str, given: Scalar) -> Scalar:
    """Convert a number or string to a value that every store supports."""
    if isinstance(given, str):
        try:
            given.encode()
        except UnicodeEncodeError:
            raise ParameterError(name, "must return valid Unicode strings, without lone surrogates", given) from None
    elif isinstance(given, int) and given.bit_length() > 63:
        return float(given)
    return given


# -- the journal ------------------------------------------------------------------------------------------------------


def journal_path(store: Path) -> Path:
    """
    Return the path of the journal of a store.

    The journal exists while a sweep runs, after an interruption, and after a sweep with failed points.
    """
    return store.with_name(store.name + ".journal")


class Journal:
    """
    File of records, one per line, that remains valid after any interruption.

    Every line has a checksum; truncated lines are ignored and their points computed again. Each line is passed to the operating
    system at once, so a crash of the program loses none. Lines are synchronised to the disk every second, so a power failure
    loses about one second of results, or the last point. The file is locked while it is open: only one program writes it.
    """

    def __init__(self, store: Path, plan: Mapping[str, Any]) -> None:
        self.path = journal_path(store)
        self._store = store
        header = {"format": FORMAT, "version": VERSION, "plan": json.loads(json.dumps(plan))}
        self.records: dict[int, Record] = {}
        self._synced_s = float("-inf")
        try:
            self._file: IO[bytes] = self.path.open("a+b")
        except OSError as error:
            raise FileError(self.path, f"cannot be written: {error.strerror or error}") from None
        try:
            lines = self._open(header)
        except BaseException as error:
            self._file.close()
            if isinstance(error, OSError):
                raise FileError(self.path, f"cannot be written: {error.strerror or error}") from None
            raise
        for line, _ in lines[1:]:
            if line is not None:
                record = _record(line)
                self.records[record.point] = record

    def _open(self, header: Mapping[str, Any]) -> list[tuple[Any, int]]:
        """Return the existing lines of the same plan; write the header to a new journal."""
        if not lock(self._file):
            raise FileError(self._store, "is being written by another program that runs the same sweep")
        self._file.seek(0)
        lines = list(_lines(self._file))
        self._file.seek(0)
        if lines or not _is_truncated_header(self._file.read()):
            _check_same(self.path, lines[0][0] if lines else None, header)
        self._end = sum(length for _, length in lines)
        self._file.truncate(self._end)
        self._is_new = not lines
        if self._is_new:
            self._write(header)
        return lines

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            if self._is_new and not self.records:
                self.remove()
            elif self.path.exists():
                self._sync()
        with contextlib.suppress(OSError):
            self._file.close()

    def add(self, record: Record) -> None:
        """
        Write a record.

        Raises FileError when writing fails, for example on a full disk. Records that were written before remain valid.
        """
        try:
            self._write(_line(record))
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.truncate(self._end)
            raise FileError(
                self.path,
                f"cannot be written: {error.strerror or error}; it contains {len(self.records):,} points, from which the "
                "same sweep resumes",
            ) from None
        self.records[record.point] = record

    def remove(self) -> None:
        """Remove the file once its records are in the store."""
        rename_or_remove(self._file, partial(self.path.unlink, missing_ok=True))

    def _write(self, line: Any) -> None:
        text = json.dumps(line).encode()
        encoded_line = b"%08x %s\n" % (zlib.crc32(text), text)
        # Unbuffered: the operating system has the line even when this process crashes.
        remaining = memoryview(encoded_line)
        while remaining:
            remaining = remaining[os.write(self._file.fileno(), remaining) :]
        self._end += len(encoded_line)
        if time.monotonic() - self._synced_s > SYNC_S:
            self._sync()

    def _sync(self) -> None:
        """Synchronise the file to the disk, against power failures."""
        os.fsync(self._file.fileno())
        self._synced_s = time.monotonic()


def _lines(file: IO[bytes]) -> Iterator[tuple[Any, int]]:
    """Yield the data (None if corrupt) and length of each line, without a truncated last line."""
    for line in file:
        if not line.endswith(b"\n"):
            return
        checksum, _, text = line.rstrip(b"\n").partition(b" ")
        try:
            data = json.loads(text) if int(checksum, 16) == zlib.crc32(text) else None
        except ValueError:
            data = None
        yield data, len(line)


def _is_truncated_header(text: bytes) -> bool:
    """Return whether a file is empty or contains a truncated journal header."""
    return not text.strip(b"\0") or re.match(TRUNCATED_HEADER, text) is not None


def _check_same(path: Path, found: Any, header: Mapping[str, Any]) -> None:
    """Check that a journal belongs to a plan."""
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise FileError(path, "is not a sweep journal; move it, or write the results elsewhere")
    if found.get("version") != VERSION:
        raise FileError(path, f"has the format version {found.get('version')}, expected {VERSION}")
    check_same_plan(path, found.get("plan", {}), header["plan"])


def check_same_plan(path: Path, found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Check that results belong to a plan."""
    expected = json.loads(json.dumps(expected))
    different = next(differences(found, expected), None)
    if different is not None:
        raise FileError(
            path,
            f"belongs to another sweep or study: '{different}' differs; use another name, or remove the existing results",
        )


def _line(record: Record) -> dict[str, Any]:
    return {
        "point": record.point,
        "values": {
            name: {
                "data": _encode_array(value.data),
                "dims": value.dims,
                "labels": {dim: _encode_array(labels) for dim, labels in value.labels.items()},
            }
            if isinstance(value, Value)
            else value
            for name, value in record.values.items()
        },
        "error": record.error,
        "warning": record.warning,
    }


def _record(line: Mapping[str, Any]) -> Record:
    values = {
        name: Value(
            _decode_array(value["data"]),
            tuple(value["dims"]),
            {dim: _decode_array(encoded) for dim, encoded in value["labels"].items()},
        )
        if isinstance(value, dict)
        else value
        for name, value in line["values"].items()
    }
    return Record(line["point"], values, line["error"], line["warning"])


def _encode_array(array: NDArray[Any]) -> list[Any]:
    return [array.dtype.str, array.shape, base64.b64encode(array.tobytes()).decode("ascii")]


def _decode_array(encoded: Any) -> NDArray[Any]:
    dtype, shape, text = encoded
    return np.frombuffer(base64.b64decode(text), np.dtype(dtype)).reshape(shape)

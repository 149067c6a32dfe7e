"""What points gave, as plain data; and the journal that they are written to, one by one, while a sweep runs."""

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
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from foveasim._core.provenance import differences
from foveasim._io.atomic import lock
from foveasim.errors import FileError, ParameterError

__all__ = ["ENDED_ITS_WORKER", "Journal", "Record", "Value", "check_new", "check_same_plan", "journal_of", "values_of"]

FORMAT, VERSION = "foveasim sweep", 1
#: How a journal begins: a checksum, and what it is.
TORN_HEAD = rb'[0-9a-f]{1,8} \{"format": "foveasim'
#: So long a journal's lines may wait for the disk.
SYNC_S = 1.0
#: Error of a point that ended its worker each time it was tried.
ENDED_ITS_WORKER = "ended its worker each time: too little memory, or a crash in a metric"
#: What a metric may give that is no array.
Scalar = bool | int | float | str


@dataclass(frozen=True, eq=False)
class Value:
    """An array of a metric, with names of its dimensions and labels of those that have some."""

    data: NDArray[Any]
    dims: tuple[str, ...]
    labels: Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Record:
    """What a point gave: values by names, what went wrong, and warnings; the texts are empty when all is well."""

    point: int
    values: Mapping[str, Scalar | Value]
    error: str = ""
    warning: str = ""


def values_of(name: str, given: Any) -> dict[str, Scalar | Value]:
    """
    What a metric gave, by the names of variables.

    Raises
    ------
    ParameterError
        When it is none of a number, a text, a mapping, an array, or an array with labels, or cannot be kept in a store.
    """
    if isinstance(given, Mapping):
        found: dict[str, Scalar | Value] = {}
        for key, item in given.items():
            more = values_of(_name(f"{name}_{key}"), item)
            check_new(found, more)
            found |= more
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
        name, f"must give a number, a text, a mapping, an array or an array with labels, got a {type(given).__name__}"
    )


def check_new(found: Collection[str], more: Iterable[str]) -> None:
    """
    Whether variables have other names than those before.

    Raises
    ------
    ParameterError
        With the name.
    """
    twice = next((name for name in more if name in found), None)
    if twice is not None:
        raise ParameterError(twice, "must be the name of one result; there are two of it")


def _name(name: str) -> str:
    """The name of a variable or a dimension, which is a folder in the store."""
    if (
        not name.isprintable()
        or not name.strip(". ")
        or name == "zarr.json"
        or set(name) & {"/", "\\"}
        or len(name) > 100
    ):
        raise ParameterError(name[:100], "cannot be the name of a result: it must be a short text without '/'")
    return name


def _value(name: str, data: Any, dims: tuple[str, ...], labels: Mapping[str, Any]) -> Scalar | Value:
    """An array with its labels; a number or text where it has no dimensions."""
    array = _simple(name, data)
    if not dims:
        return _scalar(name, array.item())
    if len(set(dims)) < len(dims):
        raise ParameterError(name, f"must have dimensions of different names, got {', '.join(dims)}")
    simple = {dim: _simple(name, each) for dim, each in labels.items()}
    for dim, each in simple.items():
        if len(set(each.tolist())) < each.size or (each.dtype.kind == "f" and np.isnan(each).any()):
            raise ParameterError(name, f"must have a different label for each value along '{dim}', and no NaN")
    return Value(array, dims, simple)


def _simple(name: str, array: Any) -> NDArray[Any]:
    """An array of numbers or texts that any store takes."""
    array = np.asarray(array)
    if array.dtype.kind == "T" or (array.dtype.kind == "O" and all(isinstance(item, str) for item in array.flat)):
        array = array.astype(str)
    if array.dtype.kind not in "biufU":
        raise ParameterError(name, f"must give numbers or texts, got an array of {array.dtype}")
    if array.dtype.kind == "f" and array.dtype.itemsize > np.dtype(np.float64).itemsize:
        array = array.astype(np.float64)
    if array.dtype.kind == "U":
        _scalar(name, "".join(array.flat))
    return np.array(array, array.dtype.newbyteorder("="), order="C")


def _scalar(name: str, given: Scalar) -> Scalar:
    """A number or text that any store takes."""
    if isinstance(given, str):
        try:
            given.encode()
        except UnicodeEncodeError:
            raise ParameterError(name, "must give texts of Unicode characters, got a lone half of one", given) from None
    elif isinstance(given, int) and given.bit_length() > 63:
        return float(given)
    return given


# -- the journal ------------------------------------------------------------------------------------------------------


def journal_of(store: Path) -> Path:
    """The journal beside a store: there while a sweep runs, and after one that was ended or has points that failed."""
    return store.with_name(store.name + ".journal")


class Journal:
    """
    A file of records, a line each, which is whole after any end of the program.

    A line has a checksum, and only whole lines count: what a sudden end cut off is done again. The system has every line at
    once, whatever becomes of the program; the disk gets lines every second, so that a power cut costs little more than the work
    of a second, or of the last point. The file is locked while it is open, so that two programs never write it at once.
    """

    def __init__(self, store: Path, plan: Mapping[str, Any]) -> None:
        self.path = journal_of(store)
        self._store = store
        head = {"format": FORMAT, "version": VERSION, "plan": json.loads(json.dumps(plan))}
        self.records: dict[int, Record] = {}
        self._synced_s = float("-inf")
        try:
            self._file: IO[bytes] = self.path.open("a+b")
        except OSError as error:
            raise FileError(self.path, f"cannot be written: {error.strerror or error}") from None
        try:
            lines = self._begin(head)
        except BaseException as error:
            self._file.close()
            if isinstance(error, OSError):
                raise FileError(self.path, f"cannot be written: {error.strerror or error}") from None
            raise
        for line, _ in lines[1:]:
            if line is not None:
                record = _record(line)
                self.records[record.point] = record

    def _begin(self, head: Mapping[str, Any]) -> list[tuple[Any, int]]:
        """The whole lines that are there, of the same plan; the head when there are none."""
        if not lock(self._file):
            raise FileError(self._store, "is being written by another program that runs the same sweep")
        self._file.seek(0)
        lines = list(_lines(self._file))
        self._file.seek(0)
        if lines or not _is_torn_head(self._file.read()):
            _check_same(self.path, lines[0][0] if lines else None, head)
        self._end = sum(length for _, length in lines)
        self._file.truncate(self._end)
        self._is_new = not lines
        if self._is_new:
            self._write(head)
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

        Raises
        ------
        FileError
            When the disk is full, say; what was written before is whole.
        """
        try:
            self._write(_line(record))
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.truncate(self._end)
            raise FileError(
                self.path,
                f"cannot be written: {error.strerror or error}; {len(self.records):,} points are kept in it, and the same "
                "sweep goes on from there",
            ) from None
        self.records[record.point] = record

    def remove(self) -> None:
        """Take the file away: its records are in the store."""
        self.path.unlink(missing_ok=True)

    def _write(self, line: Any) -> None:
        text = json.dumps(line).encode()
        whole = b"%08x %s\n" % (zlib.crc32(text), text)
        # Past Python's buffer: the system has the line, whatever becomes of this process.
        left = memoryview(whole)
        while left:
            left = left[os.write(self._file.fileno(), left) :]
        self._end += len(whole)
        if time.monotonic() - self._synced_s > SYNC_S:
            self._sync()

    def _sync(self) -> None:
        """The lines on the disk, whatever becomes of the machine."""
        os.fsync(self._file.fileno())
        self._synced_s = time.monotonic()


def _lines(file: IO[bytes]) -> Iterator[tuple[Any, int]]:
    """What the whole lines of a journal say, None where one is broken, and their lengths; nothing of a torn last line."""
    for line in file:
        if not line.endswith(b"\n"):
            return
        checksum, _, text = line.rstrip(b"\n").partition(b" ")
        try:
            said = json.loads(text) if int(checksum, 16) == zlib.crc32(text) else None
        except ValueError:
            said = None
        yield said, len(line)


def _is_torn_head(text: bytes) -> bool:
    """Whether a file without a whole line is empty, or what a sudden end left of a journal that was just begun."""
    return not text.strip(b"\0") or re.match(TORN_HEAD, text) is not None


def _check_same(path: Path, found: Any, head: Mapping[str, Any]) -> None:
    """
    Whether a journal is of a plan.

    Raises
    ------
    FileError
        When it is of another.
    """
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise FileError(path, "is no sweep's journal")
    if found.get("version") != VERSION:
        raise FileError(path, f"has the format version {found.get('version')}, expected {VERSION}")
    check_same_plan(path, found.get("plan", {}), head["plan"])


def check_same_plan(path: Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """
    Whether results are of a plan.

    Raises
    ------
    FileError
        When they are of another.
    """
    wanted = json.loads(json.dumps(wanted))
    different = next(differences(found, wanted), None)
    if different is not None:
        raise FileError(
            path,
            f"is of another sweep or study: '{different}' differs; write this one under another name, or remove that one",
        )


def _line(record: Record) -> dict[str, Any]:
    return {
        "point": record.point,
        "values": {
            name: {
                "data": _packed(value.data),
                "dims": value.dims,
                "labels": {dim: _packed(labels) for dim, labels in value.labels.items()},
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
            _unpacked(value["data"]),
            tuple(value["dims"]),
            {dim: _unpacked(packed) for dim, packed in value["labels"].items()},
        )
        if isinstance(value, dict)
        else value
        for name, value in line["values"].items()
    }
    return Record(line["point"], values, line["error"], line["warning"])


def _packed(array: NDArray[Any]) -> list[Any]:
    return [array.dtype.str, array.shape, base64.b64encode(array.tobytes()).decode("ascii")]


def _unpacked(packed: Any) -> NDArray[Any]:
    dtype, shape, text = packed
    return np.frombuffer(base64.b64decode(text), np.dtype(dtype)).reshape(shape)

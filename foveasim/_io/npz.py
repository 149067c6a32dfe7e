"""Arrays with JSON metadata in ``.npz`` files: atomic writes, size limits, no unpickling."""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from foveasim._core.names import missing_path
from foveasim._core.validation import MAX_SITES
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import as_file_error, check_version
from foveasim.errors import FileError

#: Name of the array that contains the metadata as JSON.
ABOUT = "about"
SUFFIX = ".npy"
#: numpy before 2.2 stores the argument of this name as one more array; readers ignore it.
IGNORED_ARRAY = "allow_pickle"
#: Files that would decompress to more than this are rejected.
MAX_DECOMPRESSED_BYTES = 8 * 2**30
#: Largest metadata that are read to find out what a file is.
MAX_ABOUT_BYTES = 2**28
#: Bytes per read call.
CHUNK_BYTES = 2**20


def write_archive(
    path: str | Path, about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], *, is_compressed: bool = True
) -> None:
    """
    Write arrays and metadata atomically.

    ``path``: file with the extension ``.npz``. ``about``: metadata: plain data that JSON can represent. ``arrays``: arrays by
    name. ``is_compressed``: whether to compress the arrays: smaller files, slower writes. Raises FileError when the extension
    is not ``.npz``, an array contains Python objects, or the file cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() != ".npz":
        raise FileError(target, "must end in .npz")
    pickled = [name for name, array in arrays.items() if array.dtype.hasobject]
    if pickled:  # numpy before 2.2 would store the argument allow_pickle=False as an array
        raise FileError(target, f"{pickled[0]!r:.40} must contain numbers or strings, got Python objects")
    members: dict[str, Any] = {ABOUT: np.array(json.dumps(about)), **arrays}
    with atomic_write(target) as temporary, temporary.open("wb") as file:
        write = np.savez_compressed if is_compressed else np.savez
        write(file, **members)


def read_archive(path: Path, *, max_bytes: int | None = None) -> tuple[Any, dict[str, NDArray[Any]]]:
    """
    Read the metadata, None if there are none, and the arrays of :func:`write_archive`.

    Raises FileError when the file would decompress to too many bytes, or has a compression method that numpy does not use.
    Raises Exception of any type, when the file is corrupt; :func:`open_archive` converts it to a FileError.
    """
    limit = MAX_DECOMPRESSED_BYTES if max_bytes is None else max_bytes
    arrays = {}
    with zip_members(path) as (archive, items):
        if sum(item.file_size for item in archive.infolist()) > limit:
            raise FileError(path, f"would decompress to more than {limit} bytes")
        for name, item in items.items():
            if name != IGNORED_ARRAY:
                with archive.open(item) as file:
                    arrays[name] = read_array(file, item.file_size)
    return json.loads(str(arrays.pop(ABOUT))) if ABOUT in arrays else None, arrays


@contextmanager
def open_archive(
    path: str | Path, what: str, file_format: str, version: int
) -> Iterator[tuple[dict[str, Any], dict[str, NDArray[Any]]]]:
    """
    Yield the metadata and the arrays of a file; exceptions of the block become FileErrors.

    ``path``: file that :func:`write_archive` wrote. ``what``: expected kind of the file, for messages: ``"foveasim capture"``.
    ``file_format``, ``version``: required values of ``format`` and ``version`` in the metadata. Raises FileError when the file
    is missing, too large, corrupt, or of another format.
    """
    source = Path(path)
    if not source.is_file():
        raise FileError(source, missing_path(source))
    with as_file_error(source, what, passes=(FileError,)):
        about, arrays = read_archive(source)
        check_version(source, about, what, file_format, version)
        yield about, arrays


def archive_format(path: Path) -> str | None:
    """Return the format that the metadata of an archive name; None for other files."""
    try:
        with zip_members(path) as (archive, items):
            item = items[ABOUT]
            with archive.open(item) as file:
                about = json.loads(str(read_array(file, min(item.file_size, MAX_ABOUT_BYTES))))
    except (FileError, KeyError, OSError, ValueError, zipfile.BadZipFile, zlib.error, RuntimeError, EOFError):
        return None
    found = about.get("format") if isinstance(about, dict) else None
    return found if isinstance(found, str) else None


@contextmanager
def zip_members(path: Path) -> Iterator[tuple[zipfile.ZipFile, dict[str, zipfile.ZipInfo]]]:
    """
    Open a zip archive of arrays; yield it with its members by array name.

    Raises FileError when a member has a compression method that numpy does not use.
    """
    with zipfile.ZipFile(path) as archive:
        items = {item.filename.removesuffix(SUFFIX): item for item in archive.infolist()}
        if not {item.compress_type for item in items.values()} <= {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise FileError(path, "has a compression method that numpy does not use")
        yield archive, items


def read_array(
    file: IO[bytes], n_bytes: int, check: Callable[[tuple[int, ...], np.dtype[Any]], None] | None = None
) -> NDArray[Any]:
    """
    Read an array in the ``.npy`` format, after checking its header against the file size.

    The check prevents allocations larger than the file.

    ``file``: file in the ``.npy`` format. ``n_bytes``: size of the file. ``check``: function that receives shape and dtype
    before memory is allocated, and may raise. Raises ValueError when the header is invalid or does not match the size, or the
    array contains Python objects.
    """
    shape, is_fortran, dtype = read_header(file, n_bytes, check)
    if not dtype.itemsize:
        return np.zeros(shape, dtype)
    data = np.empty(math.prod(shape), dtype)
    read_into(file, data)
    return data.reshape(shape, order="F" if is_fortran else "C")


def read_header(
    file: IO[bytes], n_bytes: int, check: Callable[[tuple[int, ...], np.dtype[Any]], None] | None = None
) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """
    Read shape, whether the order is that of Fortran, and dtype of a ``.npy`` file.

    Parameters and errors are those of :func:`read_array`.
    """
    version = npy.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"unsupported array format {version}")
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, is_fortran, dtype = read(file)
    if check is not None:
        check(shape, dtype)
    if dtype.hasobject:
        raise ValueError("an array of Python objects")
    n, n_data_bytes = math.prod(shape), n_bytes - file.tell()
    # The file size does not limit the number of items of zero bytes.
    if n * dtype.itemsize != n_data_bytes or min(shape, default=0) < 0 or n > max(n_bytes, MAX_SITES):
        raise ValueError("the size of an array does not match its header")
    return shape, is_fortran, dtype


def read_into(file: IO[bytes], array: NDArray[Any]) -> None:
    """Fill a C-contiguous array from a file; raise ValueError when that is too short."""
    target = array.reshape(-1).view(np.uint8).data
    n_read = 0
    while n_read < len(target) and (n := file.readinto(target[n_read : n_read + CHUNK_BYTES])):  # type: ignore[attr-defined]
        n_read += n
    if n_read < len(target):
        raise ValueError("truncated")

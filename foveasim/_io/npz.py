"""Arrays and words about them in one ``.npz`` file: written whole, read within limits, and never unpickled."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from foveasim._core.validation import MAX_SITES
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import as_file_error
from foveasim.errors import FileError

__all__ = ["opened_archive", "read_archive", "read_array", "write_archive", "zip_members"]

#: Name of the text beside the arrays.
ABOUT = "about"
SUFFIX = ".npy"
#: numpy before 2.2 stores the argument of this name as one more array; readers ignore it.
STRAY = "allow_pickle"
#: A file that would unpack to more than this is rejected.
MAX_UNPACKED_BYTES = 8 * 2**30
#: Bytes that are read at once.
PIECE_BYTES = 2**20


def write_archive(
    path: str | Path, about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], *, is_packed: bool = True
) -> None:
    """
    Write arrays, and what is to be known about them, whole or not at all.

    Parameters
    ----------
    path : path
        ``.npz``.
    about : mapping
        Plain data, as JSON holds them.
    arrays : mapping of str to array
    is_packed : bool
        Whether to write fewer bytes in more time.

    Raises
    ------
    FileError
        When the ending is another, an array contains Python objects, or nothing can be written there.
    """
    target = Path(path)
    if target.suffix.lower() != ".npz":
        raise FileError(target, "must end in .npz")
    pickled = [name for name, array in arrays.items() if array.dtype.hasobject]
    if pickled:  # not by allow_pickle=False, which is an array's name to numpy before 2.2
        raise FileError(target, f"{pickled[0]!r:.40} must contain numbers or strings, got Python objects")
    members: dict[str, Any] = {ABOUT: np.array(json.dumps(about)), **arrays}
    with atomic_write(target) as temporary, temporary.open("wb") as file:
        write = np.savez_compressed if is_packed else np.savez
        write(file, **members)


def read_archive(path: Path, *, max_bytes: int | None = None) -> tuple[Any, dict[str, NDArray[Any]]]:
    """
    What :func:`write_archive` wrote: the words, or None where there are none, and the arrays.

    Raises
    ------
    FileError
        When it would unpack to too much, or is packed as numpy never packs.
    Exception
        Of any kind, when it is broken; :func:`opened_archive` tells it in one sentence.
    """
    limit = MAX_UNPACKED_BYTES if max_bytes is None else max_bytes
    arrays = {}
    with zip_members(path) as (archive, items):
        if sum(item.file_size for item in archive.infolist()) > limit:
            raise FileError(path, f"would unpack to more than {limit} bytes")
        for name, item in items.items():
            if name != STRAY:
                with archive.open(item) as file:
                    arrays[name] = read_array(file, item.file_size)
    return json.loads(str(arrays.pop(ABOUT))) if ABOUT in arrays else None, arrays


@contextmanager
def opened_archive(
    path: str | Path, what: str, file_format: str, version: int
) -> Iterator[tuple[dict[str, Any], dict[str, NDArray[Any]]]]:
    """
    What a file says, and its arrays; whatever the block trips over in them is told in one sentence.

    Parameters
    ----------
    path : path
    what : str
        What the file should hold, for messages: ``"foveasim capture"``.
    file_format, version
        What it must say under ``format`` and ``version``.

    Raises
    ------
    FileError
        When the file is missing, too large, broken, or of another format.
    """
    source = Path(path)
    if not source.is_file():
        raise FileError(source, "is not a file" if source.exists() else "no such file")
    with as_file_error(source, what, passes=(FileError,)):
        about, arrays = read_archive(source)
        if not isinstance(about, dict) or about.get("format") != file_format:
            raise FileError(source, f"is no {what}")
        if about.get("version") != version:
            raise FileError(source, f"has the format version {about.get('version')!r:.40}, expected {version}")
        yield about, arrays


@contextmanager
def zip_members(path: Path) -> Iterator[tuple[zipfile.ZipFile, dict[str, zipfile.ZipInfo]]]:
    """
    Open a zip archive of arrays, with its members by the names of the arrays.

    Raises
    ------
    FileError
        When a member is compressed as numpy never does.
    """
    with zipfile.ZipFile(path) as archive:
        items = {item.filename.removesuffix(SUFFIX): item for item in archive.infolist()}
        if not {item.compress_type for item in items.values()} <= {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise FileError(path, "is packed in a way that numpy does not use")
        yield archive, items


def read_array(
    file: IO[bytes], n_bytes: int, check: Callable[[tuple[int, ...], np.dtype[Any]], None] | None = None
) -> NDArray[Any]:
    """
    Read one array, after its header was found to fit what follows it: no array is made larger than the file is.

    Parameters
    ----------
    file : binary file
        In the ``.npy`` format.
    n_bytes : int
        Length of the file.
    check : callable, optional
        Gets shape and dtype before anything is allocated, and may raise.

    Raises
    ------
    ValueError
        When the header is invalid, or the array has Python objects or another size.
    """
    version = npy.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"array format {version}")
    read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, is_fortran, dtype = read_header(file)
    if check is not None:
        check(shape, dtype)
    if dtype.hasobject:
        raise ValueError("an array of objects")
    n, left = math.prod(shape), n_bytes - file.tell()
    # Items of no bytes could be there any number of times.
    if n * dtype.itemsize != left or min(shape, default=0) < 0 or n > max(n_bytes, MAX_SITES):
        raise ValueError("an array of another size than its header tells")
    if not dtype.itemsize:
        return np.zeros(shape, dtype)
    data = np.empty(left, np.uint8)
    done = 0
    while done < left and (piece := file.read(min(left - done, PIECE_BYTES))):
        data[done : done + len(piece)] = np.frombuffer(piece, np.uint8)
        done += len(piece)
    if done < left:
        raise ValueError("truncated")
    return data.view(dtype).reshape(shape, order="F" if is_fortran else "C")

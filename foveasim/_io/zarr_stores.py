"""
Safe reading of untrusted zarr stores, and writing of arrays to stores.

The metadata of a zarr array name the codecs that decompress its chunks, a missing chunk is read as a fill value, and a few
bytes of metadata can claim any size. Readers of the package therefore check the metadata before they read data.
"""

from __future__ import annotations

import json
import os
import re
import stat
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._core.names import DEVICES, missing_path
from foveasim._io.formats import as_file_error, check_version
from foveasim.errors import FileError, format_value

ZARR = ".zarr"
#: Size limit of the metadata of a group or an array.
MAX_METADATA_BYTES = 2**26
#: Maximum length of an array name: file names are limited to 255 bytes.
MAX_NAME_LENGTH = 60


@dataclass(frozen=True)
class Variable:
    """An array with its dimension names and attributes, including its unit."""

    dims: tuple[str, ...]
    data: NDArray[Any]
    attributes: Mapping[str, Any]


def free_names(names: Iterable[str], taken: Iterable[str] = ()) -> dict[str, str]:
    """
    Return unused array names that zarr, netCDF and xarray accept: letters, digits, ``_``.

    An array is a directory of this name: it is none of a device, and names differ by more than the case of letters.

    Examples
    --------
    >>> free_names(["a/b", "A", "a", "con"], {"a_b"})
    {'a/b': 'a_b_', 'A': 'A', 'a': 'a_', 'con': 'con_'}
    """
    used = {name.casefold() for name in taken}
    found: dict[str, str] = {}
    for name in names:
        safe = re.sub(r"\W", "_", name, flags=re.ASCII)[:MAX_NAME_LENGTH]
        safe = safe if re.match(r"[A-Za-z]", safe) else f"column_{safe.lstrip('_')}"
        while safe.casefold() in used or DEVICES.fullmatch(safe):
            safe += "_"
        used.add(safe.casefold())
        found[name] = safe
    return found


def named_arrays(group: Any, names: Mapping[str, str] | None) -> dict[str, Any]:
    """
    Return the arrays of a group by the names that :func:`free_names` replaced.

    ``names``: its result, or None for a store without one, whose arrays have their own names.
    """
    stored = dict(group.arrays())
    return stored if names is None else {str(name): stored[key] for name, key in names.items()}


def write_variables(group: Any, variables: Mapping[str, Variable]) -> None:
    """
    Write arrays to an open group, each uncompressed in one chunk, with dimension names.

    Raises FileError when the installed version of zarr does not support the type of an array.
    """
    with warnings.catch_warnings():
        # zarr warns that fixed-length strings are not portable; xarray reads them.
        warnings.simplefilter("ignore")
        for name, variable in variables.items():
            values = np.asarray(variable.data, order="C")
            values = values.astype(values.dtype.newbyteorder("="), copy=False)
            array = group.create_array(
                name,
                shape=values.shape,
                chunks=tuple(max(n, 1) for n in values.shape),
                dtype=values.dtype,
                filters=None,
                compressors=None,
                dimension_names=variable.dims,
                attributes=dict(variable.attributes),
                config={"write_empty_chunks": True},
            )
            if array.dtype != values.dtype:
                raise FileError(
                    Path(str(group.store_path)), f"cannot store '{name}' of the type {values.dtype}; update zarr"
                )
            if values.size:
                array[...] = values


def store_format(path: Path) -> str | None:
    """Return the ``format`` attribute of the root of a zarr 3 store, or None."""
    try:
        return str(_metadata(path / "zarr.json")["attributes"]["format"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def check_codecs(source: Path, allowed: Collection[str], what: str) -> None:
    """
    Check that the metadata of a store name only allowed codecs.

    Raises FileError when the metadata name another codec, or storage transformers, or as :func:`check_plain_files`. Raises
    ValueError, KeyError, AttributeError, OSError when the metadata are corrupt.
    """
    check_plain_files(source)
    for path in (*source.glob("zarr.json"), *source.glob("*/zarr.json"), *source.glob("*/*/zarr.json")):
        metadata = _metadata(path)
        if metadata.get("storage_transformers"):
            raise FileError(source, f"has storage transformers, which are not valid in a {what}")
        for codec in metadata.get("codecs", []):
            if codec.get("name") not in allowed:
                raise FileError(
                    source,
                    f"has the codec {format_value(codec.get('name'), at_most=40)}, which is not valid in a {what}",
                )


@contextmanager
def open_store(
    path: Path, what: str, file_format: str, version: int
) -> Iterator[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """
    Open a store of :func:`write_variables`; exceptions of the block become FileErrors.

    ``path``: directory of the store. ``what``: expected kind of the store, for messages: ``"foveasim capture"``.
    ``file_format``, ``version``: required values of ``format`` and ``version`` in the attributes. Yields ``attributes``:
    attributes of the root. ``arrays``: arrays by path, such as ``"code"`` and ``"layout/xy_um"``; all chunks are complete.
    Raises FileError when zarr is not installed, or the store is missing, corrupt, incomplete or of another format.
    """
    import_optional(path, "zarr")
    if not path.is_dir():
        raise FileError(path, missing_path(path, "zarr store"))
    with open_group(path, what, ("bytes",), file_format, version) as group:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            arrays: dict[str, Any] = dict(group.arrays())
            for name, subgroup in group.groups():
                arrays |= {f"{name}/{key}": array for key, array in subgroup.arrays()}
            for name, array in arrays.items():
                if array.nbytes != _chunk_bytes(path / name):
                    raise FileError(path, f"is corrupt: '{name}' is incomplete")
        yield dict(group.attrs), arrays


@contextmanager
def open_group(
    source: Path, what: str, codecs: Collection[str], file_format: str, version: int, mode: str = "r"
) -> Iterator[Any]:
    """Open the group of an untrusted store; exceptions of the block become FileErrors."""
    zarr = import_optional(source, "zarr")
    with as_file_error(source, what, passes=(FileError,)):
        check_codecs(source, codecs, what)
        group = zarr.open_group(str(source), mode=mode, use_consolidated=False)  # consolidated metadata are not checked
        check_version(source, group.attrs, what, file_format, version)
        yield group


def _metadata(path: Path) -> Any:
    if not path.is_file():  # reading a FIFO waits for its writer
        raise FileNotFoundError(f"{path.name} is not a regular file")
    if path.stat().st_size > MAX_METADATA_BYTES:
        raise ValueError(f"{path.name} has more than {MAX_METADATA_BYTES} bytes")
    return json.loads(path.read_text(encoding="utf-8"))


def check_plain_files(path: Path) -> None:
    """
    Check that a store contains only regular files and directories, without opening them.

    Raises FileError when it contains a link, a FIFO, a socket or a device.
    """
    for directory, directories, files in os.walk(path, followlinks=False):
        for name in (*directories, *files):
            try:
                mode = (Path(directory) / name).lstat().st_mode
            except FileNotFoundError:  # a temporary file of a process that writes
                continue
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise FileError(path, f"contains {format_value(name)}, which is neither a regular file nor a directory")


def _chunk_bytes(directory: Path) -> int:
    return sum(file.stat().st_size for file in (directory / "c").rglob("*") if file.is_file()) + (
        (directory / "c").stat().st_size if (directory / "c").is_file() else 0
    )

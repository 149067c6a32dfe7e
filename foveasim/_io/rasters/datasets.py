"""
netCDF files and zarr directories, read with xarray.

External references are not opened and objects are not unpickled: files are checked for both before xarray opens them.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.extras import import_optional
from foveasim._core.names import possible_names
from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.rasters import check_size
from foveasim._io.rasters.labels import X, Y

if TYPE_CHECKING:
    import xarray as xr

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
NETCDF3_MAGICS = (b"CDF\x01", b"CDF\x02")
ZARR_FILES = ("zarr.json", ".zgroup", ".zarray", ".zattrs", ".zmetadata")
#: Keys of zarr metadata that name codecs for the chunks, and the safe codecs, which only encode numbers.
ZARR_CODEC_KEYS = ("codecs", "index_codecs", "filters", "compressor", "storage_transformers")
COMPRESSORS = ("zlib", "zstd", "blosc", "lz4", "bz2", "lzma", "gzip", "shuffle")
ZARR_CODECS = frozenset(
    {
        "bytes",
        "endian",
        "transpose",
        "crc32c",
        "sharding_indexed",
        *COMPRESSORS,
        *(f"numcodecs.{c}" for c in COMPRESSORS),
    }
)
#: Maximum number of groups, arrays and links in a file.
MAX_OBJECTS = 1000
MAX_METADATA_BYTES = 2**22


@contextlib.contextmanager
def open_netcdf(path: Path) -> Iterator[tuple[xr.Dataset, int]]:
    """Open a netCDF or HDF5 file; yield the lazy dataset and the file size in bytes."""
    xr = import_optional(path, "xarray", "maps")
    with path.open("rb") as file:
        is_hdf5 = not file.read(4).startswith(b"CDF")
    if is_hdf5:
        _check_hdf5(path)
    options: dict[str, Any] = {"phony_dims": "sort"} if is_hdf5 else {}
    with xr.open_dataset(
        path, engine="h5netcdf" if is_hdf5 else "scipy", decode_times=False, cache=False, **options
    ) as dataset:
        yield dataset, path.stat().st_size


@contextlib.contextmanager
def open_zarr(path: Path) -> Iterator[tuple[xr.Dataset, int]]:
    """Open a zarr directory; yield the lazy dataset and the total size in bytes."""
    xr = import_optional(path, "xarray", "maps")
    import_optional(path, "zarr", "maps")
    n_bytes = _check_zarr(path)
    with xr.open_zarr(path, consolidated=False, chunks=None, decode_times=False) as dataset:
        yield dataset, n_bytes


def is_zarr(path: Path) -> bool:
    """Return whether a directory is a zarr group or array."""
    return path.is_dir() and any((path / name).is_file() for name in ZARR_FILES[:3])


#: Formats without readers and writers.
NETCDF = FileFormat(
    title="netCDF", suffixes=(".nc", ".nc4"), signatures=(HDF5_MAGIC, *NETCDF3_MAGICS), is_sandboxed=True
)
ZARR = FileFormat(
    title="zarr",
    suffixes=(".zarr",),
    matches=lambda path, _head: is_zarr(path),
    is_sandboxed=True,
    is_directory=True,
)


def select_array(
    dataset: xr.Dataset, name: str | None, n_bytes: int, *, default: str = "", min_ndim: int = 2, what: str = "the map"
) -> xr.DataArray:
    """
    Return the named array, the one with the default name, or the only possible one.

    ``n_bytes``: size of the file in bytes, which limits the size of the array. ``default``: name of the array in files with
    several. ``min_ndim``: number of dimensions of arrays that are selected without a name. ``what``: kind of the array, for
    messages. Raises FormatError if no array has the name, or several arrays are possible.
    """
    variable = dataset[_select_name(dataset, name, default, min_ndim, what)]
    for array in (variable, *variable.coords.values()):
        check_size(array.shape, array.dtype.itemsize, n_bytes)
    return variable


def _select_name(dataset: xr.Dataset, name: str | None, default: str, min_ndim: int, what: str) -> str:
    names = [str(n) for n in dataset.data_vars]
    if name is not None:
        if name not in names:
            raise FormatError(f"has no variable {name!r:.40}; {possible_names(name, names)}")
        return name
    if default in names:
        return default
    rasters = [n for n in names if dataset[n].ndim >= min_ndim and dataset[n].dtype.kind in "iufc"]
    with_axes = [n for n in rasters if {str(d).lower() for d in dataset[n].dims} & set(X + Y)]
    for candidates in (with_axes, rasters):
        if len(candidates) == 1:
            return candidates[0]
    of = "rows and columns" if min_ndim == 2 else "rows, columns and bands"
    summary = f"contains {len(rasters)} numeric arrays with {of}"
    raise FormatError(
        f"{summary}: {', '.join(n[:40] for n in rasters[:5])}; select {what} with name=" if rasters else summary
    )


# -- checks of untrusted files ----------------------------------------------------------------------------------------


def _check_hdf5(path: Path) -> None:
    """Reject files with external references or too many objects."""
    h5py = import_optional(path, "h5py", "maps")
    import_optional(path, "h5netcdf", "maps")
    with h5py.File(path, "r") as file:
        groups, n_objects = [file["/"]], 0
        visited = set()
        while groups:
            group = groups.pop()
            for key in group:
                n_objects += 1
                if n_objects > MAX_OBJECTS:
                    raise FormatError(f"contains more than {MAX_OBJECTS} arrays and groups")
                if not isinstance(group.get(key, getlink=True), h5py.HardLink):
                    raise FormatError(
                        "contains a soft or external link, which is not followed; copy its target into the file"
                    )
                part = group[key]
                address = h5py.h5o.get_info(part.id).addr
                if address in visited:
                    continue
                visited.add(address)
                if isinstance(part, h5py.Group):
                    groups.append(part)
                elif isinstance(part, h5py.Dataset) and (part.external or part.is_virtual):
                    raise FormatError("stores its data in another file, which is not opened; copy them into this file")


def _check_zarr(path: Path) -> int:
    """Reject directories with unsafe metadata; return the total size in bytes."""
    for number, found in enumerate(_metadata_files(path)):
        if number > MAX_OBJECTS:
            raise FormatError(f"contains more than {MAX_OBJECTS} arrays and groups")
        if found.is_symlink() or found.stat().st_size > MAX_METADATA_BYTES:
            raise FormatError(f"has a {found.name} that is a symbolic link or too large")
        try:
            _check_codecs(json.loads(found.read_text(encoding="utf-8")))
        except (ValueError, RecursionError) as error:
            raise FormatError(f"has an invalid {found.name} ({error})") from None
    return sum(
        (Path(directory) / file).stat().st_size
        for directory, _, files in os.walk(path, followlinks=False)
        for file in files
    )


def _metadata_files(path: Path) -> Iterator[Path]:
    """Yield the metadata files of directories that contain some, from the root downwards."""
    directories = [path]
    while directories:
        directory = directories.pop()
        existing = [directory / name for name in ZARR_FILES if (directory / name).exists()]
        yield from existing
        if existing:
            with contextlib.suppress(OSError):
                directories += [Path(entry) for entry in os.scandir(directory) if entry.is_dir()]


def _check_codecs(metadata: Any) -> None:
    """
    Check the codecs, dtypes, shapes and chunks in zarr metadata.

    Raises FormatError if the metadata specify a codec that is not known to be safe, a dtype of Python objects, or an invalid
    size.
    """
    stack = [metadata]
    while stack:
        part = stack.pop()
        if isinstance(part, list):
            stack += part
        if not isinstance(part, dict):
            continue
        stack += part.values()
        for key in ZARR_CODEC_KEYS:
            for codec in np.atleast_1d(np.array(part.get(key) or [], dtype=object)).tolist():
                named = codec.get("name", codec.get("id")) if isinstance(codec, dict) else codec
                if named not in ZARR_CODECS:
                    raise FormatError(f"is encoded with the unsupported codec {named!r:.40}; use zstd, gzip or blosc")
        shape, kind = part.get("shape"), part.get("dtype", part.get("data_type"))
        if isinstance(kind, str) and ("O" in kind or "object" in kind):
            raise FormatError("contains Python objects, expected numbers")
        if isinstance(shape, list) and not all(isinstance(n, int) and 0 <= n < 2**40 for n in shape):
            raise FormatError("contains an array of invalid shape")
        for chunk in (part.get("chunks"), part.get("chunk_shape")):
            if isinstance(chunk, list) and not 0 < math.prod(n if isinstance(n, int) else 0 for n in chunk) < 2**33:
                raise FormatError("contains chunks of invalid size")

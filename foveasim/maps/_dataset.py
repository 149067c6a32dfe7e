"""
Power maps in netCDF files and zarr directories, read and written with xarray.

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

from foveasim._core.extras import needs
from foveasim._core.names import possible_names
from foveasim._io.atomic import atomic_directory, check_free_space
from foveasim._io.formats import FileFormat, FormatError
from foveasim.errors import FileError
from foveasim.fields import PowerMap
from foveasim.maps._common import Found, check_size
from foveasim.maps._formats import MAP_FORMATS
from foveasim.maps._xarray import NAME, X, Y, found_in_array, to_xarray

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["HDF5_MAGIC", "NETCDF3_MAGICS", "is_zarr", "read_netcdf", "read_zarr", "write_netcdf", "write_zarr"]

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
NETCDF3_MAGICS = (b"CDF\x01", b"CDF\x02")
ZARR_FILES = ("zarr.json", ".zgroup", ".zarray", ".zattrs", ".zmetadata")
#: Keys of zarr metadata that name codecs for the chunks, and the safe codecs, which only encode numbers.
ZARR_CODEC_KEYS = ("codecs", "index_codecs", "filters", "compressor", "storage_transformers")
ZARR_CODECS = frozenset(
    {
        "bytes",
        "endian",
        "transpose",
        "crc32c",
        "sharding_indexed",
        "gzip",
        "zlib",
        "zstd",
        "blosc",
        "lz4",
        "bz2",
        "lzma",
    }
    | {"numcodecs." + name for name in ("zlib", "zstd", "blosc", "lz4", "bz2", "lzma", "gzip", "shuffle")}
    | {"shuffle"}
)
#: Maximum number of groups, arrays and links in a file.
MAX_OBJECTS = 1000
MAX_METADATA_BYTES = 2**22
#: Upper bound of the size of headers and attributes in a netCDF file written here, without data and coordinates.
NETCDF_BYTES = 2**16


# -- writing ----------------------------------------------------------------------------------------------------------


def write_netcdf(power_map: PowerMap, path: Path) -> None:
    """Write an uncompressed netCDF 4 file."""
    _require(path, "h5netcdf")
    # HDF5 crashes if the disk is full.
    check_free_space(path, power_map.data.nbytes + 8 * sum(power_map.data.shape) + NETCDF_BYTES)
    to_xarray(power_map).to_dataset().to_netcdf(path, engine="h5netcdf", encoding={NAME: {"_FillValue": None}})


def write_zarr(power_map: PowerMap, path: Path) -> None:
    """
    Write an uncompressed zarr directory atomically.

    Raises
    ------
    FileError
        If zarr is missing, the path exists and is not a zarr directory, or it cannot be written.
    """
    _require(path, "zarr")
    with atomic_directory(path, is_ours=is_zarr) as directory:
        dataset = to_xarray(power_map).to_dataset()
        encoding: dict[str, dict[str, Any]] = {str(name): {"compressors": None} for name in dataset.variables}
        dataset.to_zarr(directory, mode="w", encoding=encoding, consolidated=False, zarr_format=3)


# -- reading ----------------------------------------------------------------------------------------------------------


def read_netcdf(path: Path, name: str | None) -> Found:
    """Read the named variable, or ``irradiance``, or the only variable that is a map."""
    import xarray as xr

    with path.open("rb") as file:
        is_hdf5 = not file.read(4).startswith(b"CDF")
    if is_hdf5:
        _check_hdf5(path)
    options: dict[str, Any] = {"phony_dims": "sort"} if is_hdf5 else {}
    with xr.open_dataset(
        path, engine="h5netcdf" if is_hdf5 else "scipy", decode_times=False, cache=False, **options
    ) as dataset:
        return _read_dataset(dataset, name, path.stat().st_size)


def read_zarr(path: Path, name: str | None) -> Found:
    """Read the named array, or ``irradiance``, or the only array that is a map."""
    import xarray as xr

    n_bytes = _check_zarr(path)
    with xr.open_zarr(path, consolidated=False, chunks=None, decode_times=False) as dataset:
        return _read_dataset(dataset, name, n_bytes)


def is_zarr(path: Path) -> bool:
    """Return whether a directory is a zarr group or array."""
    return path.is_dir() and any((path / name).is_file() for name in ZARR_FILES[:3])


def _read_dataset(dataset: xr.Dataset, name: str | None, n_bytes: int) -> Found:
    variable = dataset[_select_variable(dataset, name)]
    check_size(variable.shape, variable.dtype.itemsize, n_bytes)
    for coordinate in variable.coords.values():
        check_size(coordinate.shape, coordinate.dtype.itemsize, n_bytes)
    return found_in_array(variable)


def _select_variable(dataset: xr.Dataset, name: str | None) -> str:
    names = [str(n) for n in dataset.data_vars]
    if name is not None:
        if name not in names:
            raise FormatError(f"has no variable {name!r:.40}; {possible_names(name, names)}")
        return name
    if NAME in names:
        return NAME
    maps = [n for n in names if dataset[n].ndim >= 2 and dataset[n].dtype.kind in "iufc"]
    with_axes = [n for n in maps if {str(d).lower() for d in dataset[n].dims} & set(X + Y)]
    for candidates in (with_axes, maps):
        if len(candidates) == 1:
            return candidates[0]
    summary = f"contains {len(maps)} numeric arrays with rows and columns"
    raise FormatError(
        f"{summary}: {', '.join(n[:40] for n in maps[:5])}; select the map with name=" if maps else summary
    )


# -- checks of untrusted files ----------------------------------------------------------------------------------------


def _check_hdf5(path: Path) -> None:
    """Reject files with external references or too many objects."""
    import h5py

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

    Raises
    ------
    FormatError
        If the metadata specify a codec that is not known to be safe, a dtype of Python objects, or an invalid size.
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


def _require(path: Path, engine: str) -> None:
    try:
        __import__(engine)
        __import__("xarray")
    except ImportError:
        raise FileError(path, needs(engine, "maps")) from None


MAP_FORMATS.register(
    "netcdf",
    FileFormat(
        title="netCDF",
        suffixes=(".nc", ".nc4"),
        signatures=(HDF5_MAGIC, *NETCDF3_MAGICS),
        read=read_netcdf,
        write=write_netcdf,
        is_sandboxed=True,
    ),
)
MAP_FORMATS.register(
    "zarr",
    FileFormat(
        title="zarr",
        suffixes=(".zarr",),
        matches=lambda path, _head: is_zarr(path),
        read=read_zarr,
        write=write_zarr,
        is_sandboxed=True,
        is_directory=True,
    ),
)

"""
Power maps as numpy arrays: one array (npy), or named arrays in an archive (npz).

Names in an archive are ``data``, ``pitch_um``, ``origin_um``, ``wavelength_nm``, ``band_width_nm`` and ``unit``, as written by
``np.savez(path, data=..., pitch_um=0.5, wavelength_nm=[450, 550], unit="w_m2")``; the bottom row is first. ``pitch_um`` is one
number, or a pair (x, y). Objects are never unpickled.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.names import possible_names
from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.npz import read_array, zip_members
from foveasim._io.rasters import check_size
from foveasim.fields import PowerMap
from foveasim.maps._common import Found
from foveasim.maps._formats import MAP_FORMATS

NPY_MAGIC = b"\x93NUMPY"
#: Signatures of zip archives: nonempty and empty.
ZIP_MAGICS = (b"PK\x03\x04", b"PK\x05\x06")
DATA = "data"
METADATA_NAMES = ("pitch_um", "origin_um", "wavelength_nm", "band_width_nm", "unit")
#: Maximum size of an array of metadata.
MAX_METADATA_BYTES = 2**20


def write_npz(power_map: PowerMap, path: Path) -> None:
    """Write the arrays of the map without compression."""
    with path.open("wb") as file:
        np.savez(
            file,
            data=power_map.data,
            pitch_um=power_map.grid.pitch_um,
            origin_um=power_map.grid.origin_um,
            wavelength_nm=power_map.wavelength_nm,
            unit="w_m2",
        )


def read_npy(path: Path, name: str | None) -> Found:
    """Read one array without metadata."""
    _check_no_name(name)
    n_bytes = path.stat().st_size
    with path.open("rb") as file:
        return Found(data=_array(file, n_bytes, n_bytes))


def read_npz(path: Path, name: str | None) -> Found:
    """Read the named array, or ``data``, or the only array, and the metadata."""
    n_bytes = path.stat().st_size
    with zip_members(path) as (archive, items):
        selected = _select_array(list(items), name)
        metadata = {
            key: _member(archive, items[key], n_bytes) for key in METADATA_NAMES if key in items and key != selected
        }
        data = _member(archive, items[selected], n_bytes)
    pitch = metadata.get("pitch_um")
    origin = metadata.get("origin_um")
    return Found(
        data=data,
        pitch_um=None if pitch is None else _pair(np.broadcast_to(pitch, (2,))),
        origin_um=None if origin is None else _pair(origin),
        wavelength_nm=_list(metadata.get("wavelength_nm")),
        band_width_nm=_list(metadata.get("band_width_nm")),
        unit=None if "unit" not in metadata else str(metadata["unit"]),
    )


def _check_no_name(name: str | None) -> None:
    if name is not None:
        raise FormatError("contains one unnamed array; omit name=")


def _select_array(names: list[str], name: str | None) -> str:
    others = [n for n in names if n not in METADATA_NAMES]
    if name is not None:
        if name not in names:
            raise FormatError(f"has no array {name!r:.40}; {possible_names(name, names)}")
        return name
    if DATA in others:
        return DATA
    if len(others) != 1:
        raise FormatError(f"contains {len(others)} arrays, none of them named 'data'; select the map with name=")
    return others[0]


def _pair(values: NDArray[Any]) -> tuple[float, float]:
    along_x, along_y = np.asarray(values, dtype=np.float64).reshape(2).tolist()
    return along_x, along_y


def _list(values: NDArray[Any] | None) -> list[float] | None:
    return None if values is None else np.atleast_1d(np.asarray(values, dtype=np.float64)).ravel().tolist()


def _member(archive: zipfile.ZipFile, item: zipfile.ZipInfo, n_bytes: int) -> NDArray[Any]:
    if item.filename.removesuffix(".npy") in METADATA_NAMES and item.file_size > MAX_METADATA_BYTES:
        raise FormatError(f"is corrupt: {item.filename!r:.40} has {item.file_size} bytes")
    check_size((item.file_size,), 1, n_bytes)
    with archive.open(item) as file:
        return _array(file, item.file_size, n_bytes)


def _array(file: IO[bytes], size: int, n_bytes: int) -> NDArray[Any]:
    def check(shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        if dtype.hasobject or not dtype.itemsize:
            raise FormatError("contains Python objects or elements of size 0; save an array of numbers")
        check_size(shape, dtype.itemsize, n_bytes)

    return read_array(file, size, check)


def _example(path: Path) -> tuple[PowerMap, dict[str, Any]]:
    """Write one band of 2 x 3 cells, bottom row first."""
    values, metadata = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), {"pitch_um": 2.0, "wavelength_nm": 550.0}
    np.save(path, values)
    return PowerMap.from_array(values, **metadata), {**metadata, "unit": "w_m2"}  # type: ignore[arg-type]


MAP_FORMATS.register(
    "npy", FileFormat(title="npy", suffixes=(".npy",), signatures=(NPY_MAGIC,), read=read_npy), example=_example
)
MAP_FORMATS.register(
    "npz", FileFormat(title="npz", suffixes=(".npz",), signatures=ZIP_MAGICS, read=read_npz, write=write_npz)
)

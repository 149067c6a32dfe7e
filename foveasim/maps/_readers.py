"""The readers that go through libraries which a broken file can crash, by the kind of file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from foveasim.maps import _dataset, _exr, _isetcam
from foveasim.maps._common import Found

__all__ = ["READERS"]

READERS: dict[str, Callable[[Path, str | None], Found]] = {
    "EXR": _exr.read,
    "netCDF": _dataset.read_netcdf,
    "zarr": _dataset.read_zarr,
    "MAT": _isetcam.read_mat5,
    "MAT 7.3": _isetcam.read_mat73,
}

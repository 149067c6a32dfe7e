"""Power maps in netCDF files and zarr directories, read and written with xarray."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foveasim._core.extras import import_optional
from foveasim._io.atomic import atomic_directory, check_free_space
from foveasim._io.rasters.datasets import NETCDF, ZARR, is_zarr, open_netcdf, open_zarr, select_array
from foveasim.fields import PowerMap
from foveasim.maps._common import Found
from foveasim.maps._formats import MAP_FORMATS
from foveasim.maps._xarray import NAME, found_in_array, to_xarray

if TYPE_CHECKING:
    import xarray as xr

#: Upper bound of the size of headers and attributes in a netCDF file written here, without data and coordinates.
NETCDF_BYTES = 2**16


# -- writing ----------------------------------------------------------------------------------------------------------


def write_netcdf(power_map: PowerMap, path: Path) -> None:
    """Write an uncompressed netCDF 4 file."""
    for module in ("h5netcdf", "xarray"):
        import_optional(path, module, "maps")
    # HDF5 crashes if the disk is full.
    check_free_space(path, power_map.data.nbytes + 8 * sum(power_map.data.shape) + NETCDF_BYTES)
    to_xarray(power_map).to_dataset().to_netcdf(path, engine="h5netcdf", encoding={NAME: {"_FillValue": None}})


def write_zarr(power_map: PowerMap, path: Path) -> None:
    """
    Write an uncompressed zarr directory atomically.

    Raises FileError if zarr is missing, the path exists and is not a zarr directory, or it cannot be written.
    """
    for module in ("zarr", "xarray"):
        import_optional(path, module, "maps")
    with atomic_directory(path, is_ours=is_zarr) as directory:
        dataset = to_xarray(power_map).to_dataset()
        encoding: dict[str, dict[str, Any]] = {str(name): {"compressors": None} for name in dataset.variables}
        dataset.to_zarr(directory, mode="w", encoding=encoding, consolidated=False, zarr_format=3)


# -- reading ----------------------------------------------------------------------------------------------------------


def _read(
    open_dataset: Callable[[Path], AbstractContextManager[tuple[xr.Dataset, int]]], path: Path, name: str | None
) -> Found:
    """Read the named array, or ``irradiance``, or the only array that is a map."""
    with open_dataset(path) as (dataset, n_bytes):
        return found_in_array(select_array(dataset, name, n_bytes, default=NAME))


MAP_FORMATS.register("netcdf", replace(NETCDF, read=partial(_read, open_netcdf), write=write_netcdf))
MAP_FORMATS.register("zarr", replace(ZARR, read=partial(_read, open_zarr), write=write_zarr))

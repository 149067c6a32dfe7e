"""Power maps in netCDF files and zarr directories, read and written with xarray."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from foveasim._core.extras import import_optional
from foveasim._io.atomic import atomic_directory, check_free_space
from foveasim._io.formats import FileFormat
from foveasim._io.rasters.datasets import HDF5_MAGIC, NETCDF3_MAGICS, is_zarr, open_netcdf, open_zarr, select_array
from foveasim.fields import PowerMap
from foveasim.maps._common import Found
from foveasim.maps._formats import MAP_FORMATS
from foveasim.maps._xarray import NAME, found_in_array, to_xarray

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


def read_netcdf(path: Path, name: str | None) -> Found:
    """Read the named variable, or ``irradiance``, or the only variable that is a map."""
    with open_netcdf(path) as (dataset, n_bytes):
        return found_in_array(select_array(dataset, name, n_bytes, default=NAME))


def read_zarr(path: Path, name: str | None) -> Found:
    """Read the named array, or ``irradiance``, or the only array that is a map."""
    with open_zarr(path) as (dataset, n_bytes):
        return found_in_array(select_array(dataset, name, n_bytes, default=NAME))


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

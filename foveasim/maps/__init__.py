"""
Light on the sensor from other programs: power maps as files, and as labelled arrays.

==============  ==============================  =====================================================================
ending          format                          what a file tells
==============  ==============================  =====================================================================
.npy            numpy array                     nothing; read only
.npz            numpy arrays with names         everything, to the last bit
.fits           FITS image                      everything, to the last bit
.tif, .tiff     TIFF, a page per band             everything, to the last bit; from others nothing
.exr            EXR, a channel a band           everything, to the last bit of float32; from others wavelengths and unit
.nc             netCDF                          everything, to the last bit
.zarr           zarr folder                     everything, to the last bit
.mat            optical image of ISETCam        everything; read only
==============  ==============================  =====================================================================

Files are read by what they hold, whatever their ending. What one does not tell must be said; what is said goes before what
it tells. A file that is corrupt, truncated or malformed ends in one :class:`~foveasim.errors.FileError`.
"""

from __future__ import annotations

from pathlib import Path

from numpy.typing import ArrayLike

from foveasim._core.registry import import_all
from foveasim._core.validation import handed_over
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import as_file_error, format_of, writing_format
from foveasim.errors import FileError, ParameterError
from foveasim.fields import Pitch, PowerMap
from foveasim.maps import _dataset, _exr, _fits, _isetcam, _npy, _tiff  # noqa: F401 -- they register their formats
from foveasim.maps._common import Found, Given, finished
from foveasim.maps._formats import MAP_FORMATS, read_found
from foveasim.maps._units import Unit
from foveasim.maps._xarray import from_xarray, to_xarray

__all__ = ["MAP_FORMATS", "Found", "Unit", "from_xarray", "read_power_map", "to_xarray", "write_power_map"]


def read_power_map(
    path: str | Path,
    *,
    pitch_um: Pitch | None = None,
    wavelength_nm: ArrayLike | None = None,
    band_width_nm: ArrayLike | None = None,
    unit: Unit | None = None,
    origin_um: tuple[float, float] | None = None,
    top_row_first: bool | None = None,
    name: str | None = None,
) -> PowerMap:
    """
    Read the light on a sensor, from a file of any program.

    Parameters
    ----------
    path : path
        A file of one of the formats above, told by its content, or a zarr folder.
    pitch_um : float, or (pitch_x, pitch_y), optional, µm
        Side of a square cell, or width and height of a rectangular one, where the file does not contain them.
    wavelength_nm : number or sequence, optional, nm
        The bands' wavelengths, where the file does not tell them.
    band_width_nm : number or sequence, optional, nm
        Of light per nm: the bands' widths; by default they reach halfway to the neighbours.
    unit : {"w_m2", "w_m2_nm", "photons_s_m2", "photons_s_m2_nm"}, optional
        What the numbers are, where the file does not tell: power or photons a second, on a square metre, in the band or in
        each nm of it.
    origin_um : (x0, y0), optional, µm
        Lower left corner of the map; by default what the file tells, or its middle on the axis. With ``pitch_um`` the file
        is not asked.
    top_row_first : bool, optional
        Whether the file's first row is the one on top; by default what the format says: TIFF, EXR and ISETCam yes; npy, npz
        and FITS no; netCDF and zarr by their coordinate y.
    name : str, optional
        Of the array, the variable or the extension, where the file holds several.

    Returns
    -------
    PowerMap
        float32 where the file has no more digits, W/m² per band.

    Raises
    ------
    FileError
        When the file is missing, broken, truncated, too large, no map, holds what light cannot be, or lacks what nobody
        said.
    ParameterError
        When what is said is out of range, or does not fit the file.

    Notes
    -----
    Power is ``photons * h c / wavelength * width``. Negative light is rejected, but for rounding: 1e-5 of the brightest.

    Examples
    --------
    >>> import numpy as np
    >>> np.save("spot.npy", np.ones((20, 30)))  # doctest: +SKIP
    >>> read_power_map("spot.npy", pitch_um=0.5, wavelength_nm=550.0, unit="w_m2").grid.bounds_um  # doctest: +SKIP
    (-7.5, -5.0, 7.5, 5.0)
    """
    path = Path(path)
    given = Given(
        pitch_um=pitch_um,
        wavelength_nm=wavelength_nm,
        band_width_nm=band_width_nm,
        unit=unit,
        origin_um=origin_um,
        top_row_first=top_row_first,
    )
    with as_file_error(path, "power map", passes=(ParameterError,)):
        kind, _ = format_of(path, MAP_FORMATS, "power map")
        found = read_found(path, kind, name)
        handed_over(found.data)
        return finished(found, given)


def write_power_map(power_map: PowerMap, path: str | Path) -> None:
    """
    Write a map to a file, whole or not at all.

    Parameters
    ----------
    power_map : PowerMap
    path : path
        Its ending names the format: ``.npz``, ``.fits``, ``.tif``, ``.exr``, ``.nc`` or ``.zarr``.

    Raises
    ------
    FileError
        When the ending is unknown, a library is missing, or nothing can be written there.
    ParameterError
        When it is no map, or the format cannot hold it.

    Examples
    --------
    >>> write_power_map(power_map, "light.fits")  # doctest: +SKIP
    """
    if not isinstance(power_map, PowerMap):
        raise ParameterError("power_map", f"must be a PowerMap, got a {type(power_map).__name__}")
    path = Path(path)
    form = writing_format(path, MAP_FORMATS)
    assert form.write is not None
    if form.is_directory:
        form.write(power_map, path)
        return
    with atomic_write(path) as temporary:
        try:
            form.write(power_map, temporary)
        except FileError as error:
            raise FileError(path, str(error).removeprefix(f"{temporary}: ")) from None


import_all(__name__, __path__)

"""
Exchange of power maps with other programs, as files and as labelled arrays.

==============  ==============================  =====================================================================
extension       format                          metadata in the file
==============  ==============================  =====================================================================
.npy            numpy array                     none; read only
.npz            named numpy arrays              all, lossless
.fits           FITS image                      all, lossless
.tif, .tiff     TIFF, one page per band         all, lossless; none in files of other programs
.exr            EXR, one channel per band       all, lossless float32; wavelengths and unit in files of other programs
.nc             netCDF                          all, lossless
.zarr           zarr directory                  all, lossless
.mat            optical image of ISETCam        all; read only
==============  ==============================  =====================================================================

The format is detected from the content of a file, not from its extension. Metadata that a file lacks must be passed as
arguments; arguments override the metadata of the file. A corrupt, truncated or malformed file raises a
:class:`~foveasim.errors.FileError`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from numpy.typing import ArrayLike

from foveasim._core.calls import POSITIVE, publish
from foveasim._core.registry import import_all
from foveasim._core.validation import freeze
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import as_file_error, detect_format, select_writer
from foveasim.errors import FileError, ParameterError
from foveasim.fields import Pitch, PowerMap
from foveasim.maps._common import Found, Given, to_power_map
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
    focal_length_mm: Annotated[float | None, POSITIVE] = None,
) -> PowerMap:
    """
    Read a power map from a file.

    Parameters
    ----------
    path : path
        File in one of the formats of :mod:`foveasim.maps`, detected from its content, or a zarr directory.
    pitch_um : float, or (pitch_x, pitch_y), optional, µm
        Side of a square cell, or width and height of a rectangular cell, if the file does not contain them.
    wavelength_nm : number or sequence, optional, nm
        Wavelengths of the bands, if the file does not contain them.
    band_width_nm : number or sequence, optional, nm
        Widths of the bands for units per nm. By default bands extend halfway to the adjacent wavelengths.
    unit : {"w_m2", "w_m2_nm", "photons_s_m2", "photons_s_m2_nm"}, optional
        Unit of the values, if the file does not contain it: power or photons per second, per square metre, in the band or
        per nm.
    origin_um : (x0, y0), optional, µm
        Lower left corner of the map. By default the origin in the file, or a map centred on the axis. If ``pitch_um`` is
        given, the origin in the file is ignored.
    top_row_first : bool, optional
        Whether the first row of the file is the top row. The default depends on the format: true for TIFF, EXR and ISETCam;
        false for npy, npz and FITS; given by the coordinate y for netCDF and zarr.
    name : str, optional
        Name of the array, variable or extension, if the file contains several.
    focal_length_mm : float, optional, mm
        Focal length that converts cells in angles, as in FITS files of telescopes, to lengths.

    Returns
    -------
    PowerMap
        W/m² per band; float32 if this represents the values of the file exactly, otherwise float64.

    Raises
    ------
    FileError
        If the file is missing, corrupt, truncated, too large or not a map, contains invalid irradiance, or lacks metadata
        that were not passed.
    ParameterError
        If an argument is out of range or inconsistent with the file.

    Notes
    -----
    Power is ``photons * h c / wavelength * width``. Negative values are rejected, except rounding errors of up to 1e-5 of the
    maximum.

    Examples
    --------
    >>> import numpy as np
    >>> np.save("spot.npy", np.ones((20, 30)))  # doctest: +SKIP
    >>> read_power_map(
    ...     "spot.npy", pitch_um=0.5, wavelength_nm=550.0, unit="w_m2"
    ... ).grid.bounds_um  # doctest: +SKIP
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
        focal_length_mm=focal_length_mm,
    )
    with as_file_error(path, "power map", passes=(ParameterError,)):
        kind, _ = detect_format(path, MAP_FORMATS, "power map")
        found = read_found(path, kind, name)
        freeze(found.data)
        return to_power_map(found, given)


def write_power_map(power_map: PowerMap, path: str | Path) -> None:
    """
    Write a power map to a file atomically.

    Parameters
    ----------
    power_map : PowerMap
    path : path
        The extension selects the format: ``.npz``, ``.fits``, ``.tif``, ``.exr``, ``.nc`` or ``.zarr``.

    Raises
    ------
    FileError
        If the extension is unknown, a library is missing, or the file cannot be written.
    ParameterError
        If ``power_map`` is not a PowerMap, or the format cannot represent it.

    Examples
    --------
    >>> write_power_map(power_map, "map.fits")  # doctest: +SKIP
    """
    if isinstance(power_map, PowerMap) and power_map.projection != "rectilinear":
        raise ParameterError(
            "power_map",
            f"must be rectilinear for a file, got an {power_map.projection} image",
            hint="files contain no projection: capture the scene instead",
        )
    path = Path(path)
    form = select_writer(path, MAP_FORMATS)
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

publish(__name__)

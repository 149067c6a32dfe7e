"""
Power maps in FITS images: axes x, y and wavelength, bottom row first.

The coordinates of x and y are those of :mod:`foveasim._io.rasters.fits`, in a unit of length, or of angle with the focal length
of the caller. The coordinate of wavelengths is linear (``CTYPE3``), and the unit is ``BUNIT``.

The writer also stores these metadata as JSON in the keyword
``FOVEASIM``, because numbers in a header are rounded.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from foveasim._core.extras import import_optional
from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.rasters import STEP_TOLERANCE
from foveasim._io.rasters.fits import MAGIC, image_axes, number_of, open_fits, read_image, select_image, step_of
from foveasim._io.rasters.units import length_in_um
from foveasim.fields import PowerMap
from foveasim.maps._common import Found
from foveasim.maps._formats import MAP_FORMATS
from foveasim.maps._json_metadata import found_in_metadata, map_metadata

KEYWORD = "FOVEASIM"
#: Names of wavelength axes: in vacuum and in air.
WAVES = ("WAVE", "AWAV", "WAVELENGTH", "LAMBDA")


def write(power_map: PowerMap, path: Path) -> None:
    """Write one image (n_band, n_y, n_x)."""
    fits = import_optional(path, "astropy.io.fits")
    grid, waves_nm = power_map.grid, power_map.wavelength_nm
    hdu = fits.PrimaryHDU(power_map.data.astype(power_map.data.dtype.newbyteorder(">")))
    header = hdu.header
    header["BUNIT"] = "W m-2"
    for axis, start, step in ((1, grid.origin_um[0], grid.pitch_x_um), (2, grid.origin_um[1], grid.pitch_y_um)):
        header[f"CTYPE{axis}"] = "LINEAR"
        header[f"CUNIT{axis}"] = "um"
        header[f"CRPIX{axis}"] = 0.5
        header[f"CRVAL{axis}"] = start
        header[f"CDELT{axis}"] = step
    step_nm = np.diff(waves_nm)
    if step_nm.size == 0 or np.ptp(step_nm) <= STEP_TOLERANCE * abs(step_nm[0]):
        header["CTYPE3"], header["CUNIT3"], header["CRPIX3"] = "WAVE", "nm", 1.0
        header["CRVAL3"], header["CDELT3"] = float(waves_nm[0]), float(step_nm[0]) if step_nm.size else 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warns about long strings
        header[KEYWORD] = json.dumps(map_metadata(power_map))
        hdu.writeto(path, overwrite=True)


def read(path: Path, name: str | None) -> Found:
    """Read the image with a name or number, or the only image."""
    with open_fits(path) as file:
        hdu = select_image(file, name, "the map")
        header = hdu.header
        data = read_image(hdu, path.stat().st_size)
        text = header.get(KEYWORD)
        found = found_in_metadata(text if isinstance(text, str) else "", data, is_y_descending=False)
        if found.pitch_um is not None:
            return found
        return replace(found, **_header_values(header, data.shape))


def _header_values(header: Any, shape: tuple[int, ...]) -> dict[str, Any]:
    """Return pitch, origin, wavelengths and unit from a header."""
    metadata: dict[str, Any] = _plane_values(header, shape)
    if len(shape) >= 3 and str(header.get("CTYPE3", "")).strip().upper() in WAVES:
        unit_um = length_in_um(str(header.get("CUNIT3", "m")))
        step, start = step_of(header, 3), number_of(header, "CRVAL3", 0)
        if unit_um is None:
            raise FormatError(f"has the wavelength unit {str(header.get('CUNIT3'))!r:.20}, expected a unit of length")
        if step is not None:
            channel = np.arange(shape[-3]) + 1.0 - number_of(header, "CRPIX3", 0)
            metadata["wavelength_nm"] = ((start + step * channel) * (unit_um * 1e3)).tolist()
    unit = header.get("BUNIT")
    if isinstance(unit, str) and unit.strip():
        metadata["unit"] = unit
    return metadata


def _plane_values(header: Any, shape: tuple[int, ...]) -> dict[str, Any]:
    """Return pitch, origin and directions of the axes x and y, as far as they are known."""
    axes = image_axes(header)
    if axes is None:
        return {}
    metadata: dict[str, Any] = {"is_x_descending": axes.is_descending[0], "is_y_descending": axes.is_descending[1]}
    metadata["pitch_um"], metadata["pitch_deg"] = axes.pitch_um, axes.pitch_deg
    if axes.zero_px is not None:
        origin = []
        for pitch, is_descending, zero, n in zip(
            axes.steps, axes.is_descending, axes.zero_px, shape[::-1][:2], strict=True
        ):
            edges = (-0.5 - zero) * pitch, (n - 0.5 - zero) * pitch
            origin.append(-edges[1] if is_descending else edges[0])
        metadata["origin_um" if axes.pitch_deg is None else "origin_deg"] = tuple(origin)
    return metadata


MAP_FORMATS.register(
    "fits", FileFormat(title="FITS", suffixes=(".fits", ".fit"), signatures=(MAGIC,), read=read, write=write)
)

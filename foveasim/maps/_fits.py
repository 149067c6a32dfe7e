"""
Power maps in FITS images: axes x, y and wavelength, bottom row first.

The reader supports a linear world coordinate system (FITS standard 4.0, section 8: ``CTYPE``, ``CRPIX``, ``CRVAL``, ``CDELT``
or a diagonal ``CD``; without ``CRPIX`` the reference pixel is 0, as in the standard) with a length as ``CUNIT``, or the pixel
size in µm, ``XPIXSZ`` and ``YPIXSZ``; and ``BUNIT``. The writer also stores these metadata as JSON in the keyword
``FOVEASIM``, because numbers in a header are rounded.
"""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from foveasim._core.extras import import_optional
from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.rasters import STEP_TOLERANCE
from foveasim._io.rasters.fits import MAGIC, open_fits, read_image
from foveasim._io.rasters.units import length_in_um
from foveasim.fields import PowerMap
from foveasim.maps._common import Found
from foveasim.maps._formats import MAP_FORMATS
from foveasim.maps._json_metadata import found_in_metadata, map_metadata

KEYWORD = "FOVEASIM"
#: Maximum number of header-data units that are searched.
MAX_HDUS = 64
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
    """Read the image with a name or number, or the first image."""
    with open_fits(path) as file:
        hdu = _find_image(file, name)
        header = hdu.header
        data = read_image(hdu, path.stat().st_size)
        text = header.get(KEYWORD)
        found = found_in_metadata(text if isinstance(text, str) else "", data, is_y_descending=False)
        if found.pitch_um is not None:
            return found
        return replace(found, **_header_values(header, data.shape))


def _find_image(file: Any, name: str | None) -> Any:
    """Return the header-data unit with a name or number, or the first image."""
    for number in range(MAX_HDUS):
        try:
            hdu = file[number]
        except IndexError:
            break
        if name is not None and name not in (str(number), hdu.name):
            continue
        if hdu.is_image and hdu.shape and 0 not in hdu.shape:
            return hdu
        if hdu.header.get("ZIMAGE") is True:
            raise FormatError("is compressed; decompress it with funpack")
        if name is not None:
            break
    raise FormatError("contains no image" if name is None else f"contains no image {name!r:.40}")


def _header_values(header: Any, shape: tuple[int, ...]) -> dict[str, Any]:
    """Return pitch, origin, wavelengths and unit from a header."""
    metadata: dict[str, Any] = _plane_values(header, shape)
    if len(shape) >= 3 and str(header.get("CTYPE3", "")).strip().upper() in WAVES:
        unit_um = length_in_um(str(header.get("CUNIT3", "m")))
        step, start = _step(header, 3), _number(header, "CRVAL3", 0)
        if unit_um is None:
            raise FormatError(f"has the wavelength unit {str(header.get('CUNIT3'))!r:.20}, expected a unit of length")
        if step is not None:
            channel = np.arange(shape[-3]) + 1.0 - _number(header, "CRPIX3", 0)
            metadata["wavelength_nm"] = ((start + step * channel) * (unit_um * 1e3)).tolist()
    unit = header.get("BUNIT")
    if isinstance(unit, str) and unit.strip():
        metadata["unit"] = unit
    return metadata


def _plane_values(header: Any, shape: tuple[int, ...]) -> dict[str, Any]:
    """Return pitch, origin and directions of the axes x and y, as far as they are known."""
    steps = [_step(header, axis) for axis in (1, 2)]
    units_um = [length_in_um(str(header.get(f"CUNIT{axis}", ""))) for axis in (1, 2)]
    if None not in steps and None not in units_um:
        metadata: dict[str, Any] = {"is_x_descending": steps[0] < 0.0, "is_y_descending": steps[1] < 0.0}  # type: ignore[operator]
        pitch, origin = [], []
        for axis, (step, unit_um, n) in enumerate(zip(steps, units_um, shape[::-1][:2], strict=True), start=1):
            assert step is not None
            assert unit_um is not None
            start, at = _number(header, f"CRVAL{axis}", 0), _number(header, f"CRPIX{axis}", 0)
            edges = (start + step * (0.5 - at), start + step * (n + 0.5 - at))
            pitch.append(abs(step) * unit_um)
            origin.append(min(edges) * unit_um)
        return {**metadata, "pitch_um": tuple(pitch), "origin_um": tuple(origin)}
    sizes = [header.get("XPIXSZ"), header.get("YPIXSZ", header.get("XPIXSZ"))]
    if all(isinstance(size, int | float) and size > 0 for size in sizes):
        return {"pitch_um": tuple(map(float, sizes))}
    return {}


def _step(header: Any, axis: int) -> float | None:
    """Return the step along an axis, None if the header has none."""
    for other in (1, 2, 3):
        for prefix in ("CD", "PC"):
            if other != axis and (
                _number(header, f"{prefix}{axis}_{other}", 0) or _number(header, f"{prefix}{other}_{axis}", 0)
            ):
                raise FormatError("has rotated coordinate axes; resample it without rotation")
    if f"CD{axis}_{axis}" in header:
        return _number(header, f"CD{axis}_{axis}", 0) or None
    return _number(header, f"CDELT{axis}", 0) * _number(header, f"PC{axis}_{axis}", 1) or None


def _number(header: Any, keyword: str, default: int) -> float:
    value = header.get(keyword, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise FormatError(f"has the invalid value {keyword} = {value!r:.20}, expected a finite number")
    return float(value)


MAP_FORMATS.register(
    "fits", FileFormat(title="FITS", suffixes=(".fits", ".fit"), signatures=(MAGIC,), read=read, write=write)
)

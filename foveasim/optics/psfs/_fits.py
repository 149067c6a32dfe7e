"""
PSFs in FITS files.

The primary image is ``psf``, (n_point, n_wavelength, n_y, n_x), with the keyword ``PITCH_UM`` and, where they differ from the
defaults of :meth:`foveasim.optics.PSFGrid.from_arrays`, ``IMAGE``, ``FIRSTROW`` and ``SAMPLES``. The table ``POINTS`` has the
columns ``x_um``, ``y_um`` and, as an option, ``relative_illumination`` with n_wavelength values per row; the table
``WAVELENGTHS`` has the column ``wavelength_nm``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from foveasim._core.extras import import_optional
from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.rasters.fits import MAGIC, open_fits, read_image
from foveasim.optics.psfs._formats import PSF_FORMATS, choices_of, require
from foveasim.optics.psfs._grid import MAX_POINTS, PSFGrid

#: Keywords by the names of the conventions.
KEYWORDS = {"image": "IMAGE", "first_row": "FIRSTROW", "samples": "SAMPLES"}


def read(path: Path) -> PSFGrid:
    """Read the image and the tables."""
    with open_fits(path) as file:
        header = file[0].header
        require(header, ("PITCH_UM",))
        pitch_um = header["PITCH_UM"]
        if isinstance(pitch_um, bool) or not isinstance(pitch_um, int | float):
            raise FormatError(f"has the invalid value PITCH_UM = {pitch_um!r:.20}, expected a number")
        if not file[0].shape:
            raise FormatError("contains no image")
        points, waves = (
            _columns(file, *names) for names in (("POINTS", "x_um", "y_um"), ("WAVELENGTHS", "wavelength_nm"))
        )
        conventions = choices_of({name: header.get(keyword) for name, keyword in KEYWORDS.items()})
        psf = read_image(file[0], path.stat().st_size)
        psf = psf.astype(psf.dtype.newbyteorder("="))
    fraction = points.get("relative_illumination")
    return PSFGrid.from_arrays(
        psf,
        x_um=points["x_um"],
        y_um=points["y_um"],
        wavelength_nm=waves["wavelength_nm"],
        pitch_um=float(pitch_um),
        relative_illumination=fraction,
        **conventions,
    )


def _columns(file: Any, table: str, *required: str) -> dict[str, Any]:
    """Return the columns of a table by name."""
    try:
        hdu = file[table]
    except KeyError:
        raise FormatError(f"has no table '{table}' with the columns {', '.join(required)}") from None
    header = hdu.header
    n_rows, n_row_bytes = int(header.get("NAXIS2", 0)), int(header.get("NAXIS1", 0))
    if not 0 < n_rows <= MAX_POINTS or n_row_bytes > 8 * MAX_POINTS:
        raise FormatError(f"must have 1 to {MAX_POINTS} rows in the table '{table}', got {n_rows}")
    names = [str(name) for name in hdu.columns.names]
    require(names, required)
    numbers = {}
    for name in {*required, "relative_illumination"} & set(names):
        column = np.asarray(hdu.data[name])
        if column.dtype.kind not in "iuf":
            raise FormatError(f"must have numbers in the column '{name}' of the table '{table}'")
        numbers[name] = column.astype(np.float64)
    return numbers


def write(psfs: PSFGrid, path: Path) -> None:
    """Write the arrays of the upright picture."""
    fits = import_optional(path, "astropy.io.fits")
    primary = fits.PrimaryHDU(psfs.psf.astype(psfs.psf.dtype.newbyteorder(">")))
    primary.header["PITCH_UM"], primary.header["SAMPLES"] = psfs.pitch_um, psfs.samples
    columns = [fits.Column("x_um", "D", "um", array=psfs.x_um), fits.Column("y_um", "D", "um", array=psfs.y_um)]
    fraction = psfs.relative_illumination
    if fraction is not None:
        columns.append(fits.Column("relative_illumination", f"{fraction.shape[1]}D", array=fraction))
    waves = fits.Column("wavelength_nm", "D", "nm", array=psfs.wavelength_nm)
    tables = (
        fits.BinTableHDU.from_columns(columns, name="POINTS"),
        fits.BinTableHDU.from_columns([waves], name="WAVELENGTHS"),
    )
    fits.HDUList([primary, *tables]).writeto(path, overwrite=True)


PSF_FORMATS.register(
    "fits", FileFormat(title="FITS", suffixes=(".fits", ".fit"), signatures=(MAGIC,), read=read, write=write)
)

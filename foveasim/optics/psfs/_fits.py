"""
PSFs in FITS files: stacks of foveasim, images of POPPY, STPSF and other programs.

A stack is the primary image ``psf``, (n_point, n_wavelength, n_y, n_x), with the keyword ``PITCH_UM`` and, where they differ
from the defaults of :meth:`foveasim.optics.PSFGrid.from_arrays`, ``IMAGE``, ``FIRSTROW``, ``SAMPLES`` and the position of the
image point, ``CRPIX1`` and ``CRPIX2`` (from 1). The table ``POINTS`` has the columns ``x_um``, ``y_um`` and, as an option,
``relative_illumination`` with n_wavelength values per row; the table ``WAVELENGTHS`` has the column ``wavelength_nm``, and
``pitch_um`` if it differs between wavelengths.

Other files contain images of one point, (n_y, n_x), each with its wavelength, or a cube (n_wavelength, n_y, n_x). The pitch is
that of :mod:`foveasim._io.rasters.fits`, a length, or an angle (``PIXELSCL``) with the focal length of the caller. The image
point is at the coordinate 0, by ``CRVAL``, ``CDELT`` and ``CRPIX``, which is 0 if missing; without coordinates it is the middle
of the array, as in POPPY. The first row is the lowest one.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._core.names import possible_names
from foveasim._core.validation import finite_array
from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.rasters.fits import (
    MAGIC,
    ImageAxes,
    image_axes,
    images_of,
    names_of,
    number_of,
    open_fits,
    read_image,
)
from foveasim.errors import ParameterError
from foveasim.optics.psfs._formats import PSF_FORMATS, choices_of, require
from foveasim.optics.psfs._grid import MAX_POINTS, SAME_STEP, PSFGrid, with_common_window

#: Keywords by the names of the conventions.
KEYWORDS = {"image": "IMAGE", "first_row": "FIRSTROW", "samples": "SAMPLES"}


#: Wavelength of an image in POPPY and STPSF, m, and of the images of their cubes; number of wavelengths of a sum.
WAVELENGTH, CUBE_WAVELENGTHS, N_WAVELENGTHS = "WAVELEN", ("WAVELN{:02d}", "WVLN{:04d}", "WAVE{}"), "NWAVES"
#: Images of STPSF with means over pixels.
BINNED = re.compile(r"DET_?(SAMP|DIST)")
#: Units of logarithms, whose values are not proportional to the irradiance.
LOGARITHMS = re.compile(r"\s*(mag|dex|db|log)\b|.*\blog(10)?\s*\(.*", re.IGNORECASE)
#: Keyword of positions in the field, of which a cube of STPSF has one for each image.
FIELD_POINT = "DET_YX0"


def read(
    path: Path,
    *,
    name: str | None = None,
    wavelength_nm: Any = None,
    focal_length_mm: float | None = None,
    centre: Any = None,
) -> PSFGrid:
    """Read a stack of foveasim, or images of other programs."""
    with open_fits(path) as file:
        if "PITCH_UM" in file[0].header or "POINTS" in file:
            given = {"name": name, "wavelength_nm": wavelength_nm, "focal_length_mm": focal_length_mm, "centre": centre}
            for option, value in given.items():
                if value is not None:
                    raise ParameterError(option, "must be omitted for a stack, which contains it", value)
            return _read_stack(file, path)
        return _read_images(file, path, name, wavelength_nm, focal_length_mm, centre)


def _read_stack(file: Any, path: Path) -> PSFGrid:
    """Read the image and the tables."""
    header = file[0].header
    require(header, ("PITCH_UM",))
    pitch_um = header["PITCH_UM"]
    if isinstance(pitch_um, bool) or not isinstance(pitch_um, int | float):
        raise FormatError(f"has the invalid value PITCH_UM = {pitch_um!r:.20}, expected a number")
    if not file[0].shape:
        raise FormatError("contains no image")
    points = _columns(file, "POINTS", ("x_um", "y_um"), ("relative_illumination",))
    waves = _columns(file, "WAVELENGTHS", ("wavelength_nm",), ("pitch_um",))
    conventions = choices_of({name: header.get(keyword) for name, keyword in KEYWORDS.items()})
    centre = None
    if "CRPIX1" in header or "CRPIX2" in header:
        centre = number_of(header, "CRPIX2", 0) - 1.0, number_of(header, "CRPIX1", 0) - 1.0
    return PSFGrid.from_arrays(
        _values(file[0], path),
        x_um=points["x_um"],
        y_um=points["y_um"],
        wavelength_nm=waves["wavelength_nm"],
        pitch_um=waves.get("pitch_um", float(pitch_um)),
        relative_illumination=points.get("relative_illumination"),
        centre=centre,
        **conventions,
    )


def _values(hdu: Any, path: Path) -> NDArray[Any]:
    """Return the values of an image in native byte order."""
    unit = hdu.header.get("BUNIT")
    if isinstance(unit, str) and LOGARITHMS.fullmatch(unit):
        raise FormatError(f"has values in BUNIT = {unit!r:.20}, a logarithm; write the irradiance")
    psf = read_image(hdu, path.stat().st_size)
    return psf.astype(psf.dtype.newbyteorder("="))


def _read_images(
    file: Any, path: Path, name: str | None, wavelength_nm: Any, focal_length_mm: float | None, centre: Any
) -> PSFGrid:
    """Read images of one point, one or several wavelengths."""
    images = images_of(file)
    every = names_of(images)
    if name is not None:
        images = [(number, hdu) for number, hdu in images if name in (str(number), hdu.name)]
    if not images:
        raise FormatError(f"contains no image{'' if name is None else f' {name!r:.40}; {possible_names(name, every)}'}")
    planes: list[tuple[NDArray[Any], Any]] = []  # values and centres
    waves_nm: list[float] = []
    pitches_um: list[float] = []
    for _, hdu in images:
        pitch_um, axes = _pitch_um(hdu.header, focal_length_mm)
        stack = _planes(hdu, path)
        at = _zero(axes) if centre is None else centre
        planes += [(plane, at) for plane in stack]
        pitches_um += len(stack) * [pitch_um]
        waves_nm += [] if wavelength_nm is not None else _wavelengths_nm(hdu.header, len(stack))
    if wavelength_nm is not None:
        given_nm = finite_array("wavelength_nm", wavelength_nm)
        if given_nm.shape not in ((), (len(planes),)):
            raise ParameterError("wavelength_nm", f"must have {len(planes)} values, one per image, got {given_nm.size}")
        waves_nm = np.broadcast_to(given_nm, len(planes)).tolist()
    if len(set(waves_nm)) < len(waves_nm):
        same = next(wave_nm for wave_nm in waves_nm if waves_nm.count(wave_nm) > 1)
        raise FormatError(f"contains several PSFs at {same:g} nm; select one with name=, {possible_names('', every)}")
    samples = {"bins" if BINNED.match(hdu.name) else "points" for _, hdu in images}
    if len(samples) > 1:
        raise FormatError(f"contains samples and means over pixels; select one with name=, {possible_names('', every)}")
    psf, at = with_common_window(planes)
    return PSFGrid.from_arrays(
        psf[np.newaxis],
        x_um=0.0,
        y_um=0.0,
        wavelength_nm=waves_nm,
        pitch_um=pitches_um,
        centre=at,
        **{
            "samples": samples.pop(),
            **choices_of({name: images[0][1].header.get(key) for name, key in KEYWORDS.items()}),
        },
    )


def _pitch_um(header: Any, focal_length_mm: float | None) -> tuple[float, ImageAxes]:
    """Return the pitch, and the coordinates from which it follows."""
    axes = image_axes(header)
    if axes is None:
        raise FormatError(
            "does not specify the pitch of its samples: it has no CDELT with a unit, PIXELSCL, PIXSCALE, XPIXSZ or PITCH_UM"
        )
    along_x, along_y = axes.steps
    is_angle = axes.pitch_deg is not None
    if abs(along_x - along_y) > SAME_STEP * along_x:
        raise FormatError(f"has samples of {along_x:g} x {along_y:g}, expected squares; resample it")
    if any(axes.is_descending):
        raise FormatError("has coordinates that fall along an axis, CDELT < 0; write it with ascending ones")
    if not is_angle and focal_length_mm is not None:
        raise ParameterError(
            "focal_length_mm", "must be omitted for a file with samples in a unit of length", focal_length_mm
        )
    if is_angle and focal_length_mm is None:
        raise FormatError(f"has samples of {3600.0 * along_x:.6g} arcsec, an angle; pass focal_length_mm=...")
    pitch_um = along_x if focal_length_mm is None else math.radians(along_x) * 1e3 * focal_length_mm
    return pitch_um, axes


def _zero(axes: ImageAxes) -> Any:
    """Return the position (row, column) of the coordinate 0, or the middle of the array."""
    if axes.is_celestial:
        raise FormatError("has celestial coordinates, which do not say where the image point is; pass centre=...")
    return "middle" if axes.zero_px is None else axes.zero_px[::-1]


def _planes(hdu: Any, path: Path) -> NDArray[Any]:
    """Return the images of a header-data unit, (n_wavelength, n_y, n_x)."""
    values = _values(hdu, path)
    if values.ndim > 3 and set(values.shape[:-3]) == {1}:
        values = values.reshape(values.shape[-3:])
    if values.ndim == 3 and FIELD_POINT in hdu.header:
        raise FormatError("contains PSFs at points of the detector; pass them to PSFGrid.from_arrays")
    if values.ndim not in (2, 3):
        raise FormatError(
            f"contains an image of the shape {values.shape[:6]}, expected (n_y, n_x) or (n_wavelength, n_y, n_x)"
        )
    return values.reshape(-1, *values.shape[-2:])


def _wavelengths_nm(header: Any, n: int) -> list[float]:
    """Return the wavelengths of the planes of an image from its header."""
    if n > 1:
        for form in CUBE_WAVELENGTHS:
            if all(form.format(k) in header for k in range(n)):
                return [1e9 * number_of(header, form.format(k), 0) for k in range(n)]
    elif WAVELENGTH in header:
        n_waves = number_of(header, N_WAVELENGTHS, 1)
        if n_waves > 1:
            raise FormatError(
                f"is the PSF of {n_waves:g} wavelengths; pass wavelength_nm=..., the one for which it stands"
            )
        return [1e9 * number_of(header, WAVELENGTH, 0)]
    raise FormatError(
        f"does not specify the wavelength of {'each image' if n > 1 else 'its PSF'}; pass wavelength_nm=..."
    )


def _columns(file: Any, table: str, required: tuple[str, ...], optional: tuple[str, ...]) -> dict[str, Any]:
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
    for name in {*required, *optional} & set(names):
        column = np.asarray(hdu.data[name])
        if column.dtype.kind not in "iuf":
            raise FormatError(f"must have numbers in the column '{name}' of the table '{table}'")
        numbers[name] = column.astype(np.float64)
    return numbers


def write(psfs: PSFGrid, path: Path) -> None:
    """Write the arrays of the upright picture."""
    fits = import_optional(path, "astropy.io.fits")
    primary = fits.PrimaryHDU(psfs.psf.astype(psfs.psf.dtype.newbyteorder(">")))
    assert psfs.centre is not None
    primary.header["PITCH_UM"], primary.header["SAMPLES"] = float(psfs.pitches_um.max()), psfs.samples
    for axis, at in ((1, psfs.centre[1]), (2, psfs.centre[0])):
        primary.header[f"CRPIX{axis}"] = at + 1.0
    columns = [fits.Column("x_um", "D", "um", array=psfs.x_um), fits.Column("y_um", "D", "um", array=psfs.y_um)]
    fraction = psfs.relative_illumination
    if fraction is not None:
        columns.append(fits.Column("relative_illumination", f"{fraction.shape[1]}D", array=fraction))
    waves = [fits.Column("wavelength_nm", "D", "nm", array=psfs.wavelength_nm)]
    if np.ndim(psfs.pitch_um):
        waves.append(fits.Column("pitch_um", "D", "um", array=psfs.pitches_um))
    tables = (
        fits.BinTableHDU.from_columns(columns, name="POINTS"),
        fits.BinTableHDU.from_columns(waves, name="WAVELENGTHS"),
    )
    fits.HDUList([primary, *tables]).writeto(path, overwrite=True)


PSF_FORMATS.register(
    "fits",
    FileFormat(
        title="FITS",
        suffixes=(".fits", ".fit"),
        signatures=(MAGIC,),
        read=read,
        write=write,
        read_options=("name", "wavelength_nm", "focal_length_mm", "centre"),
    ),
)

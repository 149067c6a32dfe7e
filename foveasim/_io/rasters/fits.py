"""
FITS files, opened with astropy: images with size limits, and coordinates of their axes.

Coordinates follow the FITS standard 4.0, section 8. Understood: ``CTYPE``, ``CRPIX`` (0 if missing), ``CRVAL``, ``CDELT`` (1
if only the unit is given), diagonal ``CD`` and ``PC``, and ``CUNIT``, a length or an angle; tangential celestial coordinates,
whose reference pixel is 0; the scales of :data:`LENGTHS_UM` and :data:`SCALES_ARCSEC`. Rejected by name: rotations and
distortions (:data:`REJECTED`) and other projections. ``BSCALE``, ``BZERO`` and ``BLANK`` (NaN) are applied by astropy. All
other keywords do not change where samples are.
"""

from __future__ import annotations

import contextlib
import math
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._core.names import possible_names
from foveasim._io.formats import FormatError
from foveasim._io.rasters import check_size
from foveasim._io.rasters.units import length_in_um

MAGIC = b"SIMPLE  ="
#: Maximum number of header-data units that are searched.
MAX_HDUS = 64
#: Keywords of distortions, and of parameters of projections, on the axes of the plane.
REJECTED = re.compile(
    r"(A|B|AP|BP)_ORDER|C[PQ]DIS[12]|D[PQ][12](\..*)?|D2IMDIS[12]|D2IMARR|P[VS][12]_\d{1,2}|WAT[012]_.*"
)
#: Celestial coordinates with the code of a projection.
CELESTIAL = re.compile(r"(?:RA|DEC|[GESH]?LON|[GESH]?LAT|[A-Z]{2}LN|[A-Z]{2}LT)(?:-+([A-Z]{3}))?")
#: Codes of non-linear algorithms at the end of other types of coordinates.
ALGORITHM = re.compile(r"[^-]{1,4}-+[A-Z0-9]{3}(-.*)?")
#: Sizes of pixels in files of cameras, µm, and scales of telescopes and POPPY, arcseconds per pixel, of x and y.
LENGTHS_UM = (("XPIXSZ", "YPIXSZ"),)
SCALES_ARCSEC = (
    ("PIXELSCL",) * 2,
    ("PIXSCALE",) * 2,
    ("PIXSCAL1", "PIXSCAL2"),
    ("SECPIX",) * 2,
    ("SECPIX1", "SECPIX2"),
)
#: Degrees of units of angles.
DEGREES = {
    **dict.fromkeys(("deg", "degree", "degrees"), 1.0),
    **dict.fromkeys(("arcmin", "arcminute", "arcminutes"), 1.0 / 60.0),
    **dict.fromkeys(("arcsec", "arcsecond", "arcseconds"), 1.0 / 3600.0),
    "mas": 1e-3 / 3600.0,
    **dict.fromkeys(("rad", "radian", "radians"), 180.0 / math.pi),
    "mrad": 0.18 / math.pi,
}
#: Largest relative difference of two keywords for the same scale.
SAME_SCALE = 0.01


@dataclass(frozen=True, kw_only=True)
class ImageAxes:
    """
    Uniform coordinates of the columns and rows of an image.

    ``pitch_um`` or ``pitch_deg`` (x, y): positive; the other one is None. ``zero_px`` (x, y): position of the coordinate 0 in
    samples, from 0 in the middle of the first one; None if unknown. ``is_celestial``: whether the coordinates are those of the
    sky, whose directions are independent of those of the picture.
    """

    pitch_um: tuple[float, float] | None = None
    pitch_deg: tuple[float, float] | None = None
    is_descending: tuple[bool, bool] = (False, False)
    zero_px: tuple[float, float] | None = None
    is_celestial: bool = False

    @property
    def unit(self) -> str:
        """Name of the unit of the pitch."""
        return "µm" if self.pitch_deg is None else "degrees"

    @property
    def steps(self) -> tuple[float, float]:
        """Pitch (x, y) in the unit."""
        found = self.pitch_um if self.pitch_deg is None else self.pitch_deg
        assert found is not None
        return found


def images_of(file: Any) -> list[tuple[int, Any]]:
    """Return numbers and units of the images; raise a FormatError for compressed ones."""
    found = []
    for number in range(MAX_HDUS):
        try:
            hdu = file[number]
        except IndexError:
            break
        if hdu.header.get("ZIMAGE") is True:
            raise FormatError("is compressed; decompress it with funpack")
        if hdu.is_image and hdu.shape and 0 not in hdu.shape:
            found.append((number, hdu))
    return found


def select_image(file: Any, name: str | None, what: str) -> Any:
    """
    Return the unit of the image with a name or number, or of the only image.

    ``what``: kind of the image, for messages. Raises FormatError if there is none, or several without a name.
    """
    images = images_of(file)
    if name is not None:
        for number, hdu in images:
            if name in (str(number), hdu.name):
                return hdu
        raise FormatError(f"contains no image {name!r:.40}; {possible_names(name, names_of(images))}")
    if not images:
        raise FormatError("contains no image")
    if len(images) > 1:
        listed = ", ".join(names_of(images)[:5])
        raise FormatError(f"contains {len(images)} images: {listed:.100}; select {what} with name=")
    return images[0][1]


def names_of(images: list[tuple[int, Any]]) -> list[str]:
    """Return the names of images, or their numbers."""
    return [hdu.name if hdu.name and hdu.name != "PRIMARY" else str(number) for number, hdu in images]


def image_axes(header: Any) -> ImageAxes | None:
    """
    Return the coordinates of the axes 1 and 2; None without a unit.

    Raises FormatError if the coordinates are rotated, distorted or not linear, or two keywords contradict each other.
    """
    for keyword in header:
        if REJECTED.fullmatch(keyword) and header[keyword] not in (0, 0.0):
            raise FormatError(f"has distorted coordinates, {keyword} = {header[keyword]!r:.20}; resample it")
    of_wcs = _world_axes(header)
    scale = _pixel_scale(header)
    if of_wcs is None or scale is None or of_wcs.unit != scale.unit:
        return of_wcs or scale
    for along, other in zip(of_wcs.steps, scale.steps, strict=True):
        if abs(along - other) > SAME_SCALE * other:
            unit = scale.unit
            raise FormatError(
                f"has pixels of {along:.6g} {unit} by CDELT or CD, and of {other:.6g} {unit} by other keywords"
            )
    return of_wcs


def _world_axes(header: Any) -> ImageAxes | None:
    """Return the linear world coordinates in a unit of length or angle."""
    types = [str(header.get(f"CTYPE{axis}", "")).strip().upper() for axis in (1, 2)]
    celestial = [CELESTIAL.fullmatch(name) for name in types]
    for axis, name, found in zip((1, 2), types, celestial, strict=True):
        is_other = found[1] not in (None, "TAN") if found else ALGORITHM.fullmatch(name) is not None
        if is_other:
            raise FormatError(f"has the coordinates CTYPE{axis} = {name!r:.20}, which are not linear; resample it")
    steps = [step_of(header, axis) for axis in (1, 2)]
    units = [
        str(header.get(f"CUNIT{axis}", "deg" if found else "")).strip()
        for axis, found in zip((1, 2), celestial, strict=True)
    ]
    sizes: list[float | None] = [length_in_um(unit) for unit in units]
    is_angle = None in sizes
    if is_angle:
        sizes = [DEGREES.get(unit.lower()) for unit in units]
    if None in steps or None in sizes:
        return None
    step_x, step_y = (step * size for step, size in zip(steps, sizes, strict=True))  # type: ignore[operator]
    is_celestial = all(celestial)
    zero = []
    for axis, step in zip((1, 2), steps, strict=True):
        assert step is not None
        # Celestial coordinates are those of a plane that touches the sphere at the reference pixel.
        start = 0.0 if is_celestial else number_of(header, f"CRVAL{axis}", 0)
        zero.append(number_of(header, f"CRPIX{axis}", 0) - 1.0 - start / step)
    pitch = {"pitch_deg" if is_angle else "pitch_um": (abs(step_x), abs(step_y))}
    return ImageAxes(
        **pitch,
        is_descending=(False, False) if is_celestial else (step_x < 0.0, step_y < 0.0),
        zero_px=(zero[0], zero[1]),
        is_celestial=is_celestial,
    )


def _pixel_scale(header: Any) -> ImageAxes | None:
    """Return the pixel size or scale by keywords of cameras and telescopes."""
    for names, is_angle in (*((n, False) for n in LENGTHS_UM), *((n, True) for n in SCALES_ARCSEC)):
        if names[0] not in header:
            continue
        found = [number_of(header, name if name in header else names[0], 0) for name in names]
        if min(found) <= 0.0:
            raise FormatError(f"has the invalid value {names[0]} = {min(found):g}, expected a positive number")
        unit = str(header.get("PIXUNIT", "arcsec")).strip().lower()
        if is_angle and unit in DEGREES:
            size = DEGREES[unit]
        elif is_angle:
            length_um = length_in_um(unit)
            if length_um is None:
                raise FormatError(f"has the unit PIXUNIT = {unit!r:.20}, expected an angle or a length")
            size = length_um
        else:
            size = 1.0
        both = found[0] * size, found[1] * size
        return ImageAxes(pitch_deg=both) if is_angle and unit in DEGREES else ImageAxes(pitch_um=both)
    return None


def step_of(header: Any, axis: int) -> float | None:
    """Return the step along an axis, None if the header has none."""
    for other in (1, 2, 3):
        for prefix in ("CD", "PC"):
            if other != axis and (
                number_of(header, f"{prefix}{axis}_{other}", 0) or number_of(header, f"{prefix}{other}_{axis}", 0)
            ):
                raise FormatError("has rotated coordinate axes; resample it without rotation")
    if number_of(header, f"CROTA{axis}", 0):
        raise FormatError(f"has rotated coordinate axes, CROTA{axis}; resample it without rotation")
    if f"CD{axis}_{axis}" in header:
        return number_of(header, f"CD{axis}_{axis}", 0) or None
    default = 1 if f"CUNIT{axis}" in header else 0
    return number_of(header, f"CDELT{axis}", default) * number_of(header, f"PC{axis}_{axis}", 1) or None


def number_of(header: Any, keyword: str, default: int) -> float:
    """Return a finite number of a header."""
    value = header.get(keyword, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise FormatError(f"has the invalid value {keyword} = {value!r:.20}, expected a finite number")
    return float(value)


@contextlib.contextmanager
def open_fits(path: Path) -> Iterator[Any]:
    """Open a FITS file; yield its header-data units, which are read on access."""
    fits = import_optional(path, "astropy.io.fits")
    with (
        warnings.catch_warnings(),
        path.open("rb") as binary,  # astropy does not close truncated files
        fits.open(binary, mode="readonly", memmap=False, disable_image_compression=True, lazy_load_hdus=True) as file,
    ):
        warnings.simplefilter("ignore")  # warns about deviations from the standard
        yield file


def read_image(hdu: Any, n_bytes: int) -> NDArray[Any]:
    """
    Return the image of a header-data unit of a file of ``n_bytes``.

    Raises FormatError, before memory is allocated, if the image is too large or truncated.
    """
    itemsize = abs(int(hdu.header["BITPIX"])) // 8
    check_size(hdu.shape, max(itemsize, 1), n_bytes)
    if math.prod(hdu.shape) * itemsize > n_bytes:
        raise FormatError("is truncated")
    return np.asarray(hdu.data)

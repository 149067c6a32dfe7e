"""What all formats of maps share: limits, what a file tells and what its reader adds, and the checks of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.validation import (
    Floats,
    Images,
    check_choice,
    check_pitch_um,
    finite_array,
    read_only,
    wavelengths_nm,
)
from foveasim._io.formats import FormatError
from foveasim.errors import ParameterError
from foveasim.fields import Grid, Pitch, PowerMap, rising
from foveasim.maps._units import PER_NM, UNITS, Unit, light_unit, per_band_w_m2

__all__ = [
    "Found",
    "Given",
    "as_images",
    "check_numbers",
    "check_size",
    "finished",
    "max_unpacked",
    "pitch_of_axes",
]

MAX_UNPACKED_BYTES = 8 * 2**30
#: What a small file may unpack to, and for each byte of a larger one.
MIN_UNPACKED_BYTES, UNPACKED_PER_BYTE = 2**28, 256
MAX_BANDS = 4096
#: Steps are even when they differ by less than this share: coordinates may be float32.
UNEVEN = 1e-4
#: Cells are square when their sides differ by less than this fraction: what float32 coordinates leave of one pitch.
SQUARE = 1e-6
#: Fourier transforms in float32 leave so much of the brightest light below 0.
DARKEST = 1e-5


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """
    What a file tells of a map, None where it tells nothing.

    Attributes
    ----------
    data : (n_y, n_x) or (n_band, n_y, n_x)
        Numbers of any type, rows and columns in the file's order.
    is_y_falling, is_x_falling : bool
        Whether the first row is the highest, and the first column the rightmost.
    pitch_um : (along x, along y), µm
    origin_um : (x0, y0), µm
    wavelength_nm, band_width_nm : (n_band,), nm
    unit : str
        As the file writes it: ``w_m2``, ``W m-2 nm-1``, ``uW/cm^2``, ...
    """

    data: NDArray[Any]
    is_y_falling: bool = False
    is_x_falling: bool = False
    pitch_um: tuple[float, float] | None = None
    origin_um: tuple[float, float] | None = None
    wavelength_nm: Sequence[float] | None = None
    band_width_nm: Sequence[float] | None = None
    unit: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Given:
    """What the caller says of a map, which goes before what the file tells; None where nothing is said."""

    pitch_um: Pitch | None = None
    wavelength_nm: ArrayLike | None = None
    band_width_nm: ArrayLike | None = None
    unit: Unit | None = None
    origin_um: tuple[float, float] | None = None
    top_row_first: bool | None = None

    def __post_init__(self) -> None:
        if self.pitch_um is not None:
            check_pitch_um("pitch_um", self.pitch_um)
        if self.wavelength_nm is not None:
            wavelengths_nm("wavelength_nm", self.wavelength_nm)
        if self.band_width_nm is not None:
            finite_array("band_width_nm", self.band_width_nm, above=0.0)
        if self.unit is not None:
            check_choice("unit", self.unit, UNITS)
        if self.origin_um is not None:
            Grid((1, 1), 1.0, self.origin_um)


def max_unpacked(n_bytes: int) -> int:
    """Bytes that a file of so many may unpack to."""
    return min(MIN_UNPACKED_BYTES + UNPACKED_PER_BYTE * n_bytes, MAX_UNPACKED_BYTES)


def check_size(shape: Sequence[int], itemsize: int, n_bytes: int) -> None:
    """
    Reject what would unpack to too much, before it is unpacked.

    Raises
    ------
    FormatError
        When an array of the shape would take more memory than a file of ``n_bytes`` may.
    """
    size = itemsize
    for n in shape:
        size *= int(n)
    if size > max_unpacked(n_bytes):
        told = " x ".join(map(str, shape[:5]))
        raise FormatError(
            f"holds an array of {told} numbers, more than the {max_unpacked(n_bytes)} bytes that are read of a file of "
            "this size; a map that packs so well can be written unpacked"
        )


def pitch_of_axes(x: Floats, y: Floats) -> tuple[float | None, float | None]:
    """
    Steps of two axes' coordinates, with their signs; none of an axis with one cell.

    Raises
    ------
    FormatError
        When coordinates are no numbers, or their steps uneven.
    """
    steps: list[float | None] = []
    for name, along in (("x", x), ("y", y)):
        if not np.isfinite(along).all():
            raise FormatError(f"has coordinates along {name} that are no numbers")
        if along.size == 1:
            steps.append(None)
            continue
        step = float((along[-1] - along[0]) / (along.size - 1))
        # Coordinates that are rounded to float32 far from 0 have uneven steps too.
        rounding = 4.0 * float(np.spacing(np.float32(np.abs(along).max())))
        if step == 0.0 or np.abs(np.diff(along) - step).max() > UNEVEN * abs(step) + rounding:
            raise FormatError(f"has uneven steps along {name}; cells must be equal, so resample it first")
        steps.append(step)
    return steps[0], steps[1]


def finished(found: Found, given: Given) -> PowerMap:
    """
    The map in W/m² per band, every check passed.

    Raises
    ------
    FormatError
        When it holds something else than light, or lacks what nobody said.
    ParameterError
        When what was given does not fit it.
    """
    images = as_images(found.data)
    pitch_um = _pitch_um(found, given)
    waves_nm = _wavelengths_nm(images, found, given)
    data = _in_w_m2(images, waves_nm, found, given)
    check_numbers(data)
    is_y_falling = found.is_y_falling if given.top_row_first is None else given.top_row_first
    origin_um = (
        given.origin_um if given.origin_um is not None else None if given.pitch_um is not None else found.origin_um
    )
    return PowerMap.from_array(
        rising(data, is_x_falling=found.is_x_falling, is_y_falling=is_y_falling),
        pitch_um=pitch_um,
        wavelength_nm=waves_nm,
        origin_um=origin_um,
    )


def as_images(data: NDArray[Any]) -> Images:
    """
    The numbers as floating-point images (n_band, n_y, n_x) in this machine's byte order.

    Raises
    ------
    FormatError
        When they are no numbers, or have another number of dimensions.
    """
    if data.ndim > 3 and all(n == 1 for n in data.shape[:-3]):
        data = data.reshape(data.shape[-3:])
    if data.ndim not in (2, 3) or 0 in data.shape:
        raise FormatError(f"holds an array of the shape {data.shape[:6]}, expected (n_y, n_x) or (n_band, n_y, n_x)")
    if data.dtype.kind == "c":
        raise FormatError("holds complex numbers: a field; give its power, the square of their absolute values")
    if data.dtype.kind not in "iuf":
        raise FormatError(f"holds an array of the type {data.dtype!s:.40}, expected numbers")
    if data.ndim == 3 and data.shape[0] > MAX_BANDS:
        raise FormatError(f"holds {data.shape[0]} bands, more than {MAX_BANDS}; bands come first: (n_band, n_y, n_x)")
    images = data.reshape(-1, *data.shape[-2:])
    is_small = images.dtype.itemsize <= (4 if images.dtype.kind == "f" else 2)
    converted: Images = images.astype(np.float32 if is_small else np.float64, copy=False)
    if converted is not images:
        read_only(converted)
    return converted


def _pitch_um(found: Found, given: Given) -> Pitch:
    if given.pitch_um is not None:
        return given.pitch_um
    if found.pitch_um is None:
        raise FormatError("does not tell the size of its cells; give pitch_um=..., their side or (width, height) in µm")
    try:
        along_x, along_y = check_pitch_um("pitch_um", found.pitch_um)
    except ParameterError as error:
        raise FormatError(f"has cells of a size outside the allowed range ({error})") from None
    return along_x if abs(along_x - along_y) <= SQUARE * max(along_x, along_y) else (along_x, along_y)


def _wavelengths_nm(images: Images, found: Found, given: Given) -> Floats:
    n_band = images.shape[0]
    if given.wavelength_nm is not None:
        waves_nm = wavelengths_nm("wavelength_nm", given.wavelength_nm)
        if waves_nm.size != n_band:
            raise ParameterError(
                "wavelength_nm", f"must have {n_band} values, one for each band of the map, got {waves_nm.size}"
            )
        return waves_nm
    if found.wavelength_nm is None:
        raise FormatError(f"does not tell the wavelengths of its bands; give wavelength_nm=..., {n_band} in nm")
    try:
        waves_nm = wavelengths_nm("wavelength_nm", np.asarray(found.wavelength_nm, dtype=np.float64))
    except ParameterError as error:
        raise FormatError(f"tells no wavelengths ({error})") from None
    if waves_nm.size != n_band:
        raise FormatError(f"tells {waves_nm.size} wavelengths, and has {n_band} bands")
    return waves_nm


def _in_w_m2(images: Images, waves_nm: Floats, found: Found, given: Given) -> Images:
    unit, size = (given.unit, 1.0) if given.unit is not None else _parsed_unit(found.unit)
    width_nm = _band_widths_nm(waves_nm, found, given) if unit in PER_NM else None
    factor = size * per_band_w_m2(unit, waves_nm, width_nm)
    if np.all(factor == 1.0):
        return images
    # A float32 holds a photon rate and its power, but not always what lies between.
    data = np.empty_like(images)
    for band, scale in enumerate(factor):
        np.multiply(images[band], scale, out=data[band], dtype=np.float64, casting="same_kind")
    return read_only(data)


def _parsed_unit(text: str | None) -> tuple[Unit, float]:
    choices = ", ".join(map(repr, UNITS))
    if text is None:
        raise FormatError(f"does not tell its unit; give unit=..., one of {choices}")
    unit = light_unit(text)
    if unit is None:
        raise FormatError(
            f"is in {text!r:.40}, which is no irradiance; if that is wrong give unit=..., one of {choices}"
        )
    return unit


def _band_widths_nm(waves_nm: Floats, found: Found, given: Given) -> Floats:
    """Widths as given or told, or reaching halfway to the neighbouring wavelengths."""
    told = given.band_width_nm if given.band_width_nm is not None else found.band_width_nm
    if told is not None:
        width_nm = np.asarray(told, dtype=np.float64)
        if width_nm.shape not in ((), (1,), waves_nm.shape) or not np.all((width_nm > 0.0) & np.isfinite(width_nm)):
            rule = f"must be one positive number, or one for each of the {waves_nm.size} bands"
            if given.band_width_nm is None:
                raise FormatError(f"tells widths of its bands that {rule}")
            raise ParameterError("band_width_nm", rule, given.band_width_nm, "nm")
        return np.array(np.broadcast_to(width_nm, waves_nm.shape))
    order = np.argsort(waves_nm)
    steps = np.diff(waves_nm[order])
    if steps.size == 0 or np.any(steps <= 0.0):
        raise FormatError("is per nm, and does not tell how wide its bands are; give band_width_nm=...")
    # The outermost bands reach as far out as they reach in.
    width_nm = np.empty_like(waves_nm)
    width_nm[order] = 0.5 * (np.concatenate((steps[:1], steps)) + np.concatenate((steps, steps[-1:])))
    return width_nm


def check_numbers(data: Images) -> None:
    """
    Reject what light cannot be.

    Raises
    ------
    FormatError
        When a number is not finite, or below 0 by more than rounding.
    """
    lowest, highest = float(data.min()), float(data.max())
    if not (np.isfinite(lowest) and np.isfinite(highest)):
        where = np.unravel_index(int(np.argmin(np.isfinite(data))), data.shape)
        raise FormatError(f"holds {data[where]} at [band, row, column] = {[int(i) for i in where]}; light is finite")
    if lowest < -DARKEST * max(highest, 0.0):
        where = np.unravel_index(int(np.argmin(data)), data.shape)
        raise FormatError(
            f"holds negative light, {lowest:.6g} W/m² at [band, row, column] = {[int(i) for i in where]}; clip it first"
        )

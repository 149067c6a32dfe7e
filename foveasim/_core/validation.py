"""
Array types, and validation of values where they enter the package.

``np.asarray`` drops the mask of masked arrays (:mod:`numpy.ma`), and with it the information about missing data. Every array
from outside the package is therefore passed to :func:`unmasked`, also by :func:`as_numbers` and :func:`finite_array`: an empty
mask is removed; masked values are rejected, or become NaN where NaN represents missing data.

Arrays that an object of the package stores are passed to :func:`own`: later edits of the caller's array do not change them.
"""

from __future__ import annotations

import math
import mmap
import os
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.names import did_you_mean, list_names
from foveasim.errors import ParameterError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
#: Images and power maps: (n_band, n_y, n_x), float32 unless float64 is requested.
Images = NDArray[np.floating[Any]]

_Array = TypeVar("_Array", bound=NDArray[Any])

#: Lengths on a sensor outside this range indicate wrong units: smaller than an atom, larger than ten metres.
MIN_LENGTH_UM, MAX_LENGTH_UM = 1e-4, 1e7
#: More photosites than this indicate an error in the parameters of a generator.
MAX_SITES = 50_000_000
#: Arrays of the size of a picture that are in memory during imaging.
ARRAYS_IN_FLIGHT = 3
#: Memory where the system does not report it, above that of any machine; files that contain the limit of a container.
UNKNOWN_MEMORY_BYTES = 2**42
CONTAINER_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
#: Wavelengths outside this range indicate wrong units: hard ultraviolet to one millimetre.
MIN_WAVELENGTH_NM, MAX_WAVELENGTH_NM = 10.0, 1e6

#: Units for messages by suffix of the name, longest suffix first.
UNIT_SUFFIXES = {
    "_fraction": "",
    "_dn_per_ph": "DN per photon",
    "_dn_per_e": "DN/e-",
    "_dn2": "DN²",
    "_e2": "e-²",
    "_ph": "photons",
    "_w_m2_sr_nm": "W/(m² sr nm)",
    "_cd_m2": "cd/m²",
    "_lux": "lx",
    "_w_m2_sr": "W/(m² sr)",
    "_e_per_s": "e-/s",
    "_e_per_j": "e-/J",
    "_j_per_k": "J/K",
    "_m_per_s": "m/s",
    "_e_per_dn": "e-/DN",
    "_w_m2_um2": "(W/m²)·µm²",
    "_w_m2": "W/m²",
    "_w_sr": "W/sr",
    "_sr": "sr",
    "_j_s": "J s",
    "_per_mm": "per mm",
    "_per_s": "per s",
    "_um2": "µm²",
    "_um3": "µm³",
    "_px": "pixels",
    "_um": "µm",
    "_mm": "mm",
    "_nm": "nm",
    "_rad": "rad",
    "_deg": "degrees",
    "_dn": "DN",
    "_ev": "eV",
    "_m": "m",
    "_s": "s",
    "_k": "K",
    "_f": "F",
    "_v": "V",
    "_e": "e-",
    "_j": "J",
    "_c": "C",
    "_w": "W",
}


@lru_cache(maxsize=1024)
def unit_of(name: str) -> str:
    """Return the unit that the suffix of a name specifies, ``""`` if dimensionless."""
    return next((unit for suffix, unit in UNIT_SUFFIXES.items() if name.lower().endswith(suffix)), "")


def words_and_unit(name: str) -> tuple[str, str]:
    """Return a name in words without the suffix of its unit, and the unit."""
    suffix = next((s for s in UNIT_SUFFIXES if name.lower().endswith(s) and len(s) < len(name)), "")
    unit = UNIT_SUFFIXES.get(suffix, "")
    bare = name[: len(name) - len(suffix)] if unit else name
    return bare.replace("_", " ").strip() or name, unit


def title_and_unit(name: str, title: str, unit: str) -> tuple[str, str]:
    """Return a declared title and unit; without a title, those of the name."""
    words, suffix_unit = words_and_unit(name)
    return title or words, unit if unit or title else suffix_unit


def check_number(
    name: str,
    value: object,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    hint: str = "",
) -> float:
    """Return the value as a finite float within bounds, or raise a ParameterError."""
    is_plain = type(value) is float or type(value) is int  # most numbers are
    value = value if is_plain else unmasked(name, value)
    try:
        if not is_plain and (value is None or isinstance(value, bool | str | bytes) or np.ndim(value) != 0):  # type: ignore[arg-type]
            raise TypeError
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise ParameterError(name, "must be one number", value, hint=hint) from None
    except OverflowError:
        raise ParameterError(name, "must fit in a 64-bit float", hint=hint) from None
    unit = unit_of(name)
    got = value if isinstance(value, int) else number
    if not math.isfinite(number):
        raise ParameterError(name, "must be finite", got, unit, hint)
    if above is not None and not number > above:
        raise ParameterError(name, f"must be > {above:g}", got, unit, hint)
    if at_least is not None and not number >= at_least:
        raise ParameterError(name, f"must be >= {at_least:g}", got, unit, hint)
    if at_most is not None and not number <= at_most:
        raise ParameterError(name, f"must be <= {at_most:g}", got, unit, hint)
    return number


def check_count(name: str, value: object, *, at_least: int = 1, at_most: int | None = None, hint: str = "") -> int:
    """Return the value as an integer within bounds, or raise a ParameterError."""
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        number = int(value)  # not through float: seeds may have more digits
    else:
        floating = check_number(name, value, hint=hint)
        number = int(floating)
        if number != floating:
            raise ParameterError(name, "must be an integer", floating, hint=hint)
    if number < at_least:
        raise ParameterError(name, f"must be >= {at_least}", number, hint=hint)
    if at_most is not None and number > at_most:
        raise ParameterError(name, f"must be <= {at_most}", number, hint=hint)
    return number


def check_shape(name: str, value: object) -> tuple[int, int]:
    """
    Return the value as the shape (n_y, n_x) of a picture or grid.

    Raises ParameterError when it is not a pair of integers of at least 1, or float32 arrays of this shape do not fit in
    memory.
    """
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str) or len(value) != 2:
        raise ParameterError(name, "must be two integers (n_y, n_x)", value)
    n_y, n_x = (check_count(f"{name}[{i}]", n, at_most=2**30) for i, n in enumerate(value))
    check_memory(name, 4 * n_y * n_x, (n_y, n_x))
    return n_y, n_x


def check_memory(name: str, n_bytes: int, value: object, hint: str = "") -> None:
    """
    Check that an array and the arrays computed from it fit in memory.

    Otherwise the operating system may kill the process. ``name``, ``value``: the parameter that determines the size.
    ``n_bytes``: size of one array; every computation needs at least three arrays of this size.
    """
    memory = memory_bytes()
    if ARRAYS_IN_FLIGHT * n_bytes > memory:
        raise ParameterError(
            name,
            f"must fit in memory: {ARRAYS_IN_FLIGHT} arrays of {n_bytes / 2**30:,.4g} GiB exceed "
            f"{memory / 2**30:.3g} GiB",
            value,
            hint=hint or "take fewer pixels",
        )


@lru_cache(maxsize=1)
def memory_bytes() -> int:
    """Return the memory of this machine, or of the container that the process runs in."""
    limits = [UNKNOWN_MEMORY_BYTES]
    with suppress(AttributeError, ValueError, OSError):
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for file in CONTAINER_LIMITS:
        with suppress(OSError, ValueError):
            limits.append(int(Path(file).read_text(encoding="ascii")))
    return min(limit for limit in limits if limit > 0)


def check_length_um(name: str, value: object, *, at_most: float | None = None, hint: str = "") -> float:
    """Return the value as a positive length on a sensor, in µm, up to a limit."""
    length_um = check_number(name, value, above=0.0, at_most=at_most, hint=hint)
    return check_number(
        name, length_um, at_least=MIN_LENGTH_UM, at_most=MAX_LENGTH_UM, hint=hint or "lengths on a sensor are in µm"
    )


def check_pitch_um(name: str, value: object) -> tuple[float, float]:
    """Return one length, or a pair of lengths (along x, along y), as cell pitches in µm."""
    value = unmasked(name, value)
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str) or getattr(value, "ndim", 1) == 0:
        pitch_um = check_length_um(name, value)
        return pitch_um, pitch_um
    if len(value) != 2:
        raise ParameterError(name, "must be one number, or two numbers (along x, along y)", value, "µm")
    along_x_um, along_y_um = (check_length_um(name, length_um) for length_um in value)
    return along_x_um, along_y_um


def check_sites(n_sites: int, *, at_most: int = MAX_SITES) -> int:
    """Return the number of sites that a generator is about to create, within the limit."""
    return check_count("n_sites", n_sites, at_most=at_most, hint="take fewer or larger photosites")


def check_choice(name: str, value: object, choices: Collection[str]) -> str:
    """Return the value if it is one of the choices; the message lists them with the closest."""
    if not isinstance(value, str) or value not in choices:
        rule = f"must be one of {list_names(choices, value)}"
        raise ParameterError(name, rule, value, hint=did_you_mean(value, choices) if isinstance(value, str) else "")
    return value


def unmasked(name: str, value: Any, *, missing_is_nan: bool = False) -> Any:
    """
    Return the value without masks of numpy, which ``np.asarray`` would drop silently.

    Masked arrays, also in lists, are converted; other objects are returned unchanged. Masked values raise a ParameterError,
    or become NaN with ``missing_is_nan`` (float64 unless the array is floating-point already).
    """
    if not _has_mask(value):
        return value
    try:
        data, mask = np.asarray(_map_nested(value, np.ma.getdata)), np.asarray(_map_nested(value, np.ma.getmaskarray))
    except ValueError:
        return value  # ragged: conversion to an array reports the error
    n_masked = int(np.count_nonzero(mask))
    if n_masked == 0:
        return data
    if missing_is_nan and data.dtype.kind in "biuf":
        return np.where(mask, data.dtype.type(np.nan) if data.dtype.kind == "f" else np.nan, data)
    raise ParameterError(
        name,
        f"must have no masked values, got {n_masked} of {mask.size} masked",
        hint="fill them first, for example with .filled(0)",
    )


def _map_nested(value: Any, function: Callable[[Any], Any]) -> Any:
    """Return the data or the masks of masked arrays in nested lists."""
    return [_map_nested(item, function) for item in value] if isinstance(value, list | tuple) else function(value)


def _has_mask(value: object) -> bool:
    if isinstance(value, np.ma.MaskedArray):
        return True
    if not isinstance(value, list | tuple):
        return False
    kinds = set(map(type, value))
    return any(issubclass(kind, np.ma.MaskedArray | list | tuple) for kind in kinds) and any(map(_has_mask, value))


def as_any_array(name: str, value: Any) -> NDArray[Any]:
    """Return the value, without masks, as an array of any type."""
    value = unmasked(name, value)
    try:
        return np.asarray(value)
    except ValueError:  # ragged
        raise ParameterError(name, "must be an array of numbers", value) from None


def as_numbers(name: str, value: ArrayLike, *, keep_type: bool = False, missing_is_nan: bool = False) -> NDArray[Any]:
    """
    Return the value as an array of real numbers: float64, or its own dtype (``keep_type``).

    Raises ParameterError when it is ragged, contains other data, or is masked and ``missing_is_nan`` is not set.
    """
    value = unmasked(name, value, missing_is_nan=missing_is_nan)
    try:
        array = np.asarray(value)
        if array.dtype.kind in "cSUmM":
            raise TypeError
        return array if keep_type and array.dtype.kind in "biuf" else np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError):
        raise ParameterError(name, "must be an array of numbers", value) from None


def check_point(name: str, value: ArrayLike, *, at_least: float | None = None) -> tuple[float, float]:
    """Return two finite numbers (x, y) after validation."""
    point = finite_array(name, value, at_least=at_least)
    if point.shape != (2,):
        raise ParameterError(name, "must be two numbers (x, y)", value, unit_of(name))
    return float(point[0]), float(point[1])


def finite_array(
    name: str,
    value: ArrayLike,
    *,
    ndim: int | None = None,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
    hint: str = "",
) -> Floats:
    """
    Return the value as a float64 array of finite numbers within bounds.

    The message of the ParameterError gives the index of the first other number.
    """
    array = as_numbers(name, value)
    if ndim is not None and array.ndim != ndim:
        raise ParameterError(name, f"must have {ndim} dimension{'s' * (ndim != 1)}, got the shape {array.shape}")
    # Two reductions decide for valid arrays, without temporary arrays.
    smallest, largest = (array.min(), array.max()) if array.size else (np.nan, np.nan)
    is_within = (
        (at_least is None or smallest >= at_least)
        and (above is None or smallest > above)
        and (at_most is None or largest <= at_most)
    )
    if is_within and np.isfinite(smallest) and np.isfinite(largest):
        return array
    for is_bad, rule in (
        (~np.isfinite(array), "must be finite"),
        (array < at_least if at_least is not None else None, f"must be >= {at_least}"),
        (array <= above if above is not None else None, f"must be > {above}"),
        (array > at_most if at_most is not None else None, f"must be <= {at_most:g}" if at_most is not None else ""),
    ):
        if is_bad is not None and np.any(is_bad):
            where = tuple(int(i) for i in np.argwhere(is_bad)[0])
            position = f" at [{', '.join(map(str, where))}]" if where else ""
            unit = (unit_of(name) + position).strip()
            raise ParameterError(name, f"{rule} everywhere", float(array[where]), unit, hint)
    return array


def check_broadcast(**arrays: NDArray[Any]) -> tuple[int, ...]:
    """Return the common shape of arrays, by the names of their parameters."""
    names = list(arrays)
    for n in range(len(names), 0, -1):
        try:
            common = np.broadcast_shapes(*(arrays[name].shape for name in names[:n]))
        except ValueError:
            continue
        if n == len(names):
            return common
        others = ", ".join(f"'{name}' {arrays[name].shape}" for name in names[:n])
        rule = f"must have a shape that broadcasts with {others}, got {arrays[names[n]].shape}"
        raise ParameterError(names[n], rule)
    return ()


def as_broadcast(**arrays: ArrayLike) -> list[NDArray[Any]]:
    """Return arrays of numbers whose shapes broadcast, by the names of their parameters."""
    numbers = {name: as_numbers(name, value) for name, value in arrays.items()}
    check_broadcast(**numbers)
    return list(numbers.values())


def exact_integers(values: Sequence[int]) -> NDArray[Any] | None:
    """
    Return integers as an int64 or uint64 array, or None if neither can represent them.

    numpy converts lists with integers above 63 bits to floating-point numbers, which loses digits.
    """
    low, high = min(values), max(values)
    if low >= -(2**63) and high < 2**63:
        return np.array(values, np.int64)
    return np.array(values, np.uint64) if low >= 0 and high < 2**64 else None


def wavelengths_nm(name: str, value: ArrayLike) -> Floats:
    """Return the value as a read-only array of wavelengths within the range in nm, (n,)."""
    waves_nm = finite_array(name, np.atleast_1d(as_numbers(name, value)), ndim=1, above=0.0)
    is_outside = (waves_nm < MIN_WAVELENGTH_NM) | (waves_nm > MAX_WAVELENGTH_NM)
    if waves_nm.size == 0 or is_outside.any():
        raise ParameterError(
            name,
            f"must be from {MIN_WAVELENGTH_NM:g} to {MAX_WAVELENGTH_NM:g}",
            waves_nm[is_outside].tolist()[:3],
            "nm",
            "wavelengths are in nm",
        )
    return read_only(waves_nm.copy())


def band_widths_nm(
    wavelength_nm: Floats, band_width_nm: ArrayLike | None, range_nm: tuple[float, float] = (0.0, math.inf)
) -> Floats:
    """
    Return the specified widths of bands, or widths halfway to the adjacent wavelengths.

    The latter end at the ends of the range, such as that of a tabulated spectrum.
    """
    if band_width_nm is not None:
        widths = finite_array("band_width_nm", band_width_nm, above=0.0, at_most=MAX_WAVELENGTH_NM)
        if widths.ndim > 1 or widths.size not in (1, wavelength_nm.size):
            raise ParameterError(
                "band_width_nm", f"must be one number, or one for each of the {wavelength_nm.size} wavelengths"
            )
        return np.broadcast_to(widths, wavelength_nm.shape).astype(np.float64)
    if wavelength_nm.size == 1:
        raise ParameterError(
            "band_width_nm", "must be given for a single wavelength, which has no adjacent wavelengths"
        )
    order = np.argsort(wavelength_nm)
    steps = np.diff(wavelength_nm[order])
    if np.any(steps <= 0):
        raise ParameterError("wavelength_nm", "must be unique", wavelength_nm.tolist(), "nm")
    # The outermost bands are symmetric about their wavelengths, within the range.
    below, above = 0.5 * np.concatenate((steps[:1], steps)), 0.5 * np.concatenate((steps, steps[-1:]))
    below[0] = min(below[0], wavelength_nm[order[0]] - range_nm[0])
    above[-1] = min(above[-1], range_nm[1] - wavelength_nm[order[-1]])
    widths = np.empty(wavelength_nm.size)
    widths[order] = below + above
    return widths


def check_per_site(name: str, values: _Array, n_sites: int, *, or_one: bool = False, or_rows: bool = False) -> _Array:
    """
    Return an array after checking that its shape is (n_site,).

    With ``or_one``, it may also be one number; with ``or_rows``, have further axes before, (..., n_site). Raises ParameterError
    for other shapes.
    """
    shape = values.shape
    if (shape[-1:] == (n_sites,) and (or_rows or values.ndim == 1)) or (or_one and shape == ()):
        return values
    rule = "be one number, or one for each" if or_one else "have one value for each"
    raise ParameterError(name, f"must {rule} of the {n_sites} sites, got the shape {shape}")


def own_arrays(instance: Any) -> None:
    """Replace the arrays of a frozen dataclass by read-only ones, independent of the caller's."""
    for field in fields(instance):
        values = unmasked(field.name, getattr(instance, field.name))
        if isinstance(values, np.ndarray | list | tuple):
            object.__setattr__(instance, field.name, frozen_array(np.asarray(values)))


def read_only(array: _Array) -> _Array:
    """Return the same array, marked as read-only."""
    array.flags.writeable = False
    return array


def freeze(array: _Array) -> _Array:
    """
    Return the same array, with its base arrays also marked as read-only.

    For memory that the package has allocated and that no caller can access.
    """
    base: Any = array
    while isinstance(base, np.ndarray):
        base.flags.writeable = False
        base = base.base
    return array


def frozen_array(array: _Array) -> _Array:
    """
    Return the values as a read-only array, independent of the caller's array.

    An array that is read-only together with its base arrays is returned unchanged, so that objects of the package share memory
    and large maps are not duplicated; other arrays are copied.
    """
    base: Any = array
    while isinstance(base, np.ndarray) and not base.flags.writeable:
        base = base.base
    return array if base is None or isinstance(base, bytes | mmap.mmap) else read_only(array.copy())

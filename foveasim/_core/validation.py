"""
Array types, and the shared checks that every value passes once, where it enters the package.

Masked arrays (:mod:`numpy.ma`) lose their mask in ``np.asarray``, and with it what they say about missing data. Every array
from outside therefore goes through :func:`unmasked`, as :func:`as_numbers` and :func:`finite_array` do: a mask that hides
nothing is taken off; masked values are rejected, or become NaN where NaN stands for no data.

Arrays that an object of the package holds go through :func:`own`: later edits of the caller's array do not reach it.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim.errors import ParameterError

__all__ = [
    "MAX_LENGTH_UM",
    "MAX_SITES",
    "UNIT_SUFFIXES",
    "Bools",
    "Floats",
    "Images",
    "Ints",
    "as_numbers",
    "check_choice",
    "check_count",
    "check_length_um",
    "check_memory",
    "check_number",
    "check_pitch_um",
    "check_shape",
    "check_sites",
    "exact_integers",
    "finite_array",
    "handed_over",
    "memory_bytes",
    "own",
    "read_only",
    "unit_of",
    "unmasked",
    "wavelengths_nm",
]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
#: Pictures and maps: (n_band, n_y, n_x), float32 unless float64 was asked for.
Images = NDArray[np.floating[Any]]

_Array = TypeVar("_Array", bound=NDArray[Any])

#: Lengths on a sensor outside this range are a slip of units: less than an atom, more than ten metres.
MIN_LENGTH_UM, MAX_LENGTH_UM = 1e-4, 1e7
#: More photosites than this are a slip in a generator's parameters.
MAX_SITES = 50_000_000
#: Arrays of a picture's size that an image of it takes.
ARRAYS_IN_FLIGHT = 3
#: Memory where the system does not specify it: more than machines have. And where containers have theirs.
UNKNOWN_MEMORY_BYTES = 2**42
CONTAINER_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
#: Wavelengths outside this range are, too: from hard ultraviolet to a millimetre.
MIN_WAVELENGTH_NM, MAX_WAVELENGTH_NM = 10.0, 1e6

#: Suffixes of names, longest first, and the unit that each stands for in messages.
UNIT_SUFFIXES = {
    "_fraction": "",
    "_dn_per_ph": "DN per photon",
    "_dn2": "DN²",
    "_e2": "e-²",
    "_ph": "photons",
    "_w_m2_sr_nm": "W/(m² sr nm)",
    "_w_m2_sr": "W/(m² sr)",
    "_e_per_s": "e-/s",
    "_e_per_j": "e-/J",
    "_j_per_k": "J/K",
    "_m_per_s": "m/s",
    "_e_per_dn": "e-/DN",
    "_w_m2_um2": "(W/m²)·µm²",
    "_w_m2": "W/m²",
    "_w_sr": "W/sr",
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
    """Unit that a name carries, ``""`` for a dimensionless one."""
    return next((unit for suffix, unit in UNIT_SUFFIXES.items() if name.lower().endswith(suffix)), "")


def check_number(
    name: str,
    value: object,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    hint: str = "",
) -> float:
    """
    The value as a finite float within its bounds.

    Raises
    ------
    ParameterError
        When it is no number, not finite, or out of bounds.
    """
    value = unmasked(name, value)
    try:
        if value is None or isinstance(value, bool | str | bytes) or np.ndim(value) != 0:  # type: ignore[arg-type]
            raise TypeError
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise ParameterError(name, "must be one number", value, hint=hint) from None
    except OverflowError:
        raise ParameterError(name, "is larger than any floating-point number", hint=hint) from None
    unit = unit_of(name)
    got = value if isinstance(value, int) else number
    if not np.isfinite(number):
        raise ParameterError(name, "must be finite", got, unit, hint)
    if above is not None and not number > above:
        raise ParameterError(name, f"must be > {above:g}", got, unit, hint)
    if at_least is not None and not number >= at_least:
        raise ParameterError(name, f"must be >= {at_least:g}", got, unit, hint)
    if at_most is not None and not number <= at_most:
        raise ParameterError(name, f"must be <= {at_most:g}", got, unit, hint)
    return number


def check_count(name: str, value: object, *, at_least: int = 1, at_most: int | None = None, hint: str = "") -> int:
    """
    The value as an integer within its bounds.

    Raises
    ------
    ParameterError
        When it is not an integer, or out of bounds.
    """
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        number = int(value)  # of any size: seeds have more digits than a float
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
    The value as the shape (n_y, n_x) of a picture or a grid, one array of which fits in this machine's memory.

    Raises
    ------
    ParameterError
        When it is not two integers of at least 1, or an array of float32 of that shape needs more memory than there is.
    """
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str) or len(value) != 2:
        raise ParameterError(name, "must be two integers (n_y, n_x)", value)
    n_y, n_x = (check_count(f"{name}[{i}]", n, at_most=2**30) for i, n in enumerate(value))
    check_memory(name, 4 * n_y * n_x, (n_y, n_x))
    return n_y, n_x


def check_memory(name: str, n_bytes: int, value: object, hint: str = "") -> None:
    """
    Check that an array and what is made of it fit in memory, before the system ends the program for want of it.

    Parameters
    ----------
    name : str
        Of the parameter that asks for it.
    n_bytes : int
        Of one array; nothing is made of it with fewer than three of its size.
    value : object
        Of that parameter, for the message.

    Raises
    ------
    ParameterError
        When three such arrays are larger than this machine's memory.
    """
    memory = memory_bytes()
    if ARRAYS_IN_FLIGHT * n_bytes > memory:
        raise ParameterError(
            name,
            f"must give {ARRAYS_IN_FLIGHT} arrays of {n_bytes / 2**30:,.4g} GiB that fit in the memory of "
            f"{memory / 2**30:.3g} GiB",
            value,
            hint=hint or "take fewer pixels",
        )


@lru_cache(maxsize=1)
def memory_bytes() -> int:
    """Memory of this machine, or of the container that the program runs in."""
    limits = [UNKNOWN_MEMORY_BYTES]
    with suppress(AttributeError, ValueError, OSError):
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for file in CONTAINER_LIMITS:
        with suppress(OSError, ValueError):
            limits.append(int(Path(file).read_text(encoding="ascii")))
    return min(limit for limit in limits if limit > 0)


def check_length_um(name: str, value: object, *, at_most: float | None = None, hint: str = "") -> float:
    """
    The value as a length on a sensor, in µm.

    Raises
    ------
    ParameterError
        When it is no number, not positive, longer than allowed, or of a size that no sensor has.
    """
    length_um = check_number(name, value, above=0.0, at_most=at_most, hint=hint)
    return check_number(
        name, length_um, at_least=MIN_LENGTH_UM, at_most=MAX_LENGTH_UM, hint=hint or "lengths on a sensor are in µm"
    )


def check_pitch_um(name: str, value: object) -> tuple[float, float]:
    """
    The value as the distances of cells along x and along y, in µm.

    Raises
    ------
    ParameterError
        When it is neither one length nor a pair of lengths (along x, along y).
    """
    value = unmasked(name, value)
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str) or getattr(value, "ndim", 1) == 0:
        pitch_um = check_length_um(name, value)
        return pitch_um, pitch_um
    if len(value) != 2:
        raise ParameterError(name, "must be one number, or two numbers (along x, along y)", value, "µm")
    along_x_um, along_y_um = (check_length_um(name, length_um) for length_um in value)
    return along_x_um, along_y_um


def check_sites(n_sites: int) -> int:
    """
    A number of sites that a generator is about to make.

    Raises
    ------
    ParameterError
        When there would be too many.
    """
    return check_count("n_sites", n_sites, at_most=MAX_SITES, hint="take fewer or larger photosites")


def check_choice(name: str, value: object, choices: Collection[str]) -> str:
    """
    The value, when it is one of the choices.

    Raises
    ------
    ParameterError
        When it is none of them; the message names them all.
    """
    if not isinstance(value, str) or value not in choices:
        raise ParameterError(name, f"must be one of {', '.join(repr(c) for c in choices)}", value)
    return value


def unmasked(name: str, value: Any, *, missing_is_nan: bool = False) -> Any:
    """
    Return the value without numpy's masks, which ``np.asarray`` would drop in silence.

    Parameters
    ----------
    name : str
        Of the parameter, for the message.
    value : any
        Masked arrays, also in lists, are looked for; anything else is returned as it is.
    missing_is_nan : bool
        Whether masked values become NaN (float64 unless the array is floating-point already); by default they are rejected.

    Raises
    ------
    ParameterError
        When values are masked and NaN does not stand for missing data.
    """
    if not _has_mask(value):
        return value
    try:
        data, mask = np.asarray(_parts(value, np.ma.getdata)), np.asarray(_parts(value, np.ma.getmaskarray))
    except ValueError:
        return value  # ragged: whoever makes an array of it says so
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


def _parts(value: Any, part_of: Callable[[Any], Any]) -> Any:
    """The data or the masks of masked arrays in lists."""
    return [_parts(item, part_of) for item in value] if isinstance(value, list | tuple) else part_of(value)


def _has_mask(value: object) -> bool:
    if isinstance(value, np.ma.MaskedArray):
        return True
    if not isinstance(value, list | tuple):
        return False
    kinds = set(map(type, value))
    return any(issubclass(kind, np.ma.MaskedArray | list | tuple) for kind in kinds) and any(map(_has_mask, value))


def as_numbers(name: str, value: ArrayLike, *, keep_type: bool = False, missing_is_nan: bool = False) -> NDArray[Any]:
    """
    The value as an array of real numbers: float64, or as it is.

    Raises
    ------
    ParameterError
        When it is ragged, or has other than real numbers, or masked values and ``missing_is_nan`` is not set.
    """
    value = unmasked(name, value, missing_is_nan=missing_is_nan)
    try:
        array = np.asarray(value)
        if array.dtype.kind in "cSUmM":
            raise TypeError
        return array if keep_type and array.dtype.kind in "biuf" else np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError):
        raise ParameterError(name, "must be an array of numbers", value) from None


def finite_array(
    name: str, value: ArrayLike, *, ndim: int | None = None, at_least: float | None = None, above: float | None = None
) -> Floats:
    """
    The value as a float64 array of finite numbers.

    Raises
    ------
    ParameterError
        When it is not numeric, has another number of dimensions, or a value that is not finite or out of bounds;
        the message gives the first such value's position.
    """
    array = as_numbers(name, value)
    if ndim is not None and array.ndim != ndim:
        raise ParameterError(name, f"must have {ndim} dimension{'s' * (ndim != 1)}, got the shape {array.shape}")
    for is_bad, rule in (
        (~np.isfinite(array), "must be finite"),
        (array < at_least if at_least is not None else None, f"must be >= {at_least}"),
        (array <= above if above is not None else None, f"must be > {above}"),
    ):
        if is_bad is not None and np.any(is_bad):
            where = tuple(int(i) for i in np.argwhere(is_bad)[0])
            place = f" at [{', '.join(map(str, where))}]" if where else ""
            raise ParameterError(name, f"{rule} everywhere", float(array[where]), (unit_of(name) + place).strip())
    return array


def exact_integers(values: Sequence[int]) -> NDArray[Any] | None:
    """
    Return integers as an int64 array, or as uint64 where that is needed; None where neither contains them all.

    numpy makes floating-point numbers, which differ, of a list with integers of more than 63 bits.
    """
    low, high = min(values), max(values)
    if low >= -(2**63) and high < 2**63:
        return np.array(values, np.int64)
    return np.array(values, np.uint64) if low >= 0 and high < 2**64 else None


def wavelengths_nm(name: str, value: ArrayLike) -> Floats:
    """
    The value as a read-only list of wavelengths, (n,) nm.

    Raises
    ------
    ParameterError
        When it is no list of numbers, or one is no wavelength of light in nm.
    """
    waves_nm = finite_array(name, np.atleast_1d(as_numbers(name, value)), ndim=1, above=0.0)
    is_odd = (waves_nm < MIN_WAVELENGTH_NM) | (waves_nm > MAX_WAVELENGTH_NM)
    if waves_nm.size == 0 or is_odd.any():
        raise ParameterError(
            name,
            f"must be from {MIN_WAVELENGTH_NM:g} to {MAX_WAVELENGTH_NM:g}",
            waves_nm[is_odd].tolist()[:3],
            "nm",
            "wavelengths are in nm",
        )
    return read_only(waves_nm.copy())


def read_only(array: _Array) -> _Array:
    """The same array, no longer writeable."""
    array.flags.writeable = False
    return array


def handed_over(array: _Array) -> _Array:
    """The same array, with all that it is a view of no longer writeable: for memory that nobody outside the package knows."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base.flags.writeable = False
        base = base.base
    return array


def own(array: _Array) -> _Array:
    """
    Return the values as a read-only array that later edits of the caller's array do not change.

    An array that is read-only already, with all that it is a view of, is returned as it is, so that objects of the package
    share memory and large maps are not doubled; any other is copied.
    """
    base: Any = array
    while isinstance(base, np.ndarray) and not base.flags.writeable:
        base = base.base
    return array if base is None or isinstance(base, bytes | mmap.mmap) else read_only(array.copy())

"""Selection of bands, rows and columns of a cube, without copies where possible."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import (
    Bools,
    Floats,
    Images,
    Ints,
    check_count,
    finite_array,
    freeze,
    memory_bytes,
    unmasked,
    wavelengths_nm,
)
from foveasim._io.formats import FormatError
from foveasim._io.mapped_files import in_memory, range_and_values, remember_range, value_range
from foveasim._io.rasters import MAX_BANDS
from foveasim.errors import ParameterError
from foveasim.scene.cubes._cube import Cube

#: Treatment of NaN, infinite, negative and missing values.
Invalid: TypeAlias = Literal["raise", "zero"]
#: Values that are converted at a time.
BLOCK_VALUES = 2**22
#: Floating-point values of a mapped file are copied into memory up to this size.
MAX_COPIED_BYTES = 2**30


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Selected part of a cube; parameters as for :meth:`foveasim.Scene.from_cube`."""

    wavelength_nm: Sequence[float] | None = None
    bands: Sequence[int] | None = None
    range_nm: Sequence[float] | None = None
    resample_nm: Sequence[float] | None = None
    rows: Sequence[int] | None = None
    columns: Sequence[int] | None = None
    invalid: str = "raise"

    def __post_init__(self) -> None:
        plain: dict[str, Any] = {}
        for name in ("wavelength_nm", "resample_nm"):
            if getattr(self, name) is not None:
                plain[name] = wavelengths_nm(name, getattr(self, name)).tolist()
        if self.resample_nm is not None:
            _check_ascending("resample_nm", np.array(plain["resample_nm"]))
        if self.range_nm is not None:
            low_high = finite_array("range_nm", self.range_nm, ndim=1)
            if low_high.size != 2 or not low_high[0] <= low_high[1]:
                raise ParameterError("range_nm", "must be two wavelengths (lowest, highest)", self.range_nm, "nm")
            plain["range_nm"] = low_high.tolist()
        if self.bands is not None:
            bands = _integers("bands", self.bands)
            plain["bands"] = bands
            if not bands or len(set(bands)) < len(bands):
                raise ParameterError("bands", "must be different indices from 0", self.bands)
        for name in ("rows", "columns"):
            if getattr(self, name) is not None:
                plain[name] = _integers(name, getattr(self, name))
                if len(plain[name]) != 2:
                    raise ParameterError(name, "must be two integers (start, stop)", plain[name])
        for name, value in plain.items():
            object.__setattr__(self, name, value)


def _integers(name: str, value: Any) -> list[int]:
    values = unmasked(name, value)
    if np.ndim(values) != 1 or isinstance(values, str):
        raise ParameterError(name, "must be a sequence of integers", value)
    return [check_count(f"{name}[{i}]", n, at_least=0) for i, n in enumerate(values)]


def select(cube: Cube, selection: Selection) -> Cube:
    """
    Return the selected part of a cube with its rows and columns in the order of scenes.

    Returns ``cube``: bands with ascending wavelengths in nm, bottom row first, float32 if this represents the values exactly,
    otherwise float64. The data are a view of a memory map of such values above 1 GiB, unless they are stored by pixel, have an
    offset, or contain values that are replaced. Raises FormatError if the cube is not a real array of three dimensions, or
    contains invalid values or wavelengths. Raises ParameterError if the selection is not within the cube.
    """
    cube = _as_bands(cube)
    n_bands, n_y, n_x = cube.data.shape
    waves_nm = cube.waves_nm(selection.wavelength_nm)
    index = _selected_bands(cube, waves_nm, selection)
    rows = _limits("rows", selection.rows, n_y)
    columns = _limits("columns", selection.columns, n_x)
    y, x = _in_file(rows, n_y, not cube.is_y_descending), _in_file(columns, n_x, cube.is_x_descending)
    scale, offset = (_per_band(name, getattr(cube, name), n_bands)[index] for name in ("scale", "offset"))
    if not np.all(scale > 0.0):
        raise FormatError(f"has the scale factor {scale.min():.6g}, expected positive numbers")
    images, limits = _load(cube.data, index, y, x)
    if cube.is_y_descending:
        images = images[:, ::-1]
    if cube.is_x_descending:
        images = images[:, :, ::-1]
    if limits is not None and not offset.any() and _is_valid(*limits, cube.missing):
        remember_range(freeze(images), limits)
    else:
        images = _checked(images, cube.missing, offset / scale, selection.invalid, index, (rows.start, columns.start))
    widths = cube.band_width_nm
    fov_deg = cube.field_of_view_deg
    if fov_deg is not None:
        half = np.tan(np.radians(0.5 * fov_deg)) * (columns.stop - columns.start) / n_x
        fov_deg = float(np.degrees(2.0 * np.arctan(half)))
    return replace(
        cube,
        data=images,
        is_y_descending=False,
        is_x_descending=False,
        wavelength=waves_nm[index],
        wavelength_unit="nm",
        band_width_nm=None if widths is None else _per_band("band_width_nm", widths, n_bands)[index],
        scale=scale,
        offset=0.0,
        is_good=None,
        missing=None,
        field_of_view_deg=fov_deg,
        close=None,
    )


def interpolation_weights(wavelength_nm: Floats, at_nm: Floats) -> Floats:
    """
    Return the weights (n_band, n) of linear interpolation between ascending wavelengths.

    Raises ParameterError if a wavelength is outside the bands.
    """
    is_outside = (at_nm < wavelength_nm[0]) | (at_nm > wavelength_nm[-1])
    if is_outside.any():
        rule = f"must be from {wavelength_nm[0]:g} to {wavelength_nm[-1]:g}, the range of the selected bands"
        raise ParameterError("resample_nm", rule, at_nm[is_outside].tolist()[:3], "nm")
    return np.array([np.interp(at_nm, wavelength_nm, band) for band in np.eye(wavelength_nm.size)])


def _as_bands(cube: Cube) -> Cube:
    """Return a cube with three dimensions and real values; a single band may have two."""
    data = cube.data
    if len(data.shape) == 2:
        data = np.asarray(data)[np.newaxis]
    if len(data.shape) != 3 or 0 in data.shape:
        raise FormatError(f"contains an array of shape {tuple(data.shape)[:6]}, expected rows, columns and bands")
    if data.dtype.kind not in "iuf":
        raise FormatError(f"contains an array of dtype {data.dtype!s:.40}, expected real numbers")
    if data.shape[0] > MAX_BANDS:
        raise FormatError(f"contains {data.shape[0]} bands, more than {MAX_BANDS}; the order of its axes is unexpected")
    return replace(cube, data=data)


def _selected_bands(cube: Cube, waves_nm: Floats, selection: Selection) -> Ints:
    """Return the indices of the selected bands, by ascending wavelength."""
    n_bands = waves_nm.size
    if selection.bands is not None:
        index = np.array(selection.bands, np.int64)
        if index.max() >= n_bands:
            raise ParameterError("bands", f"must be from 0 to {n_bands - 1}, the bands of the cube", int(index.max()))
    else:
        good = np.ones(n_bands, bool) if cube.is_good is None else np.asarray(cube.is_good, bool)
        if good.size != n_bands:
            raise FormatError(f"marks {good.size} bands as good or bad, and contains {n_bands}")
        index = np.flatnonzero(good)
        if index.size == 0:
            raise FormatError("marks all its bands as bad; select some with bands=")
    if selection.range_nm is not None:
        low, high = selection.range_nm
        within = index[(waves_nm[index] >= low) & (waves_nm[index] <= high)]
        if within.size == 0:
            first, last = waves_nm[index].min(), waves_nm[index].max()
            raise ParameterError(
                "range_nm", f"must contain a band of the cube, from {first:g} to {last:g}", selection.range_nm, "nm"
            )
        index = within
    _check_order(waves_nm[index], index)
    if selection.resample_nm is not None:
        weights = interpolation_weights(waves_nm[index], np.array(selection.resample_nm))
        index = index[weights.any(axis=1)]
    return index


def _check_order(waves_nm: Floats, index: Ints) -> None:
    falls = np.flatnonzero(np.diff(waves_nm) <= 0.0)
    if falls.size:
        k = int(falls[0])
        raise FormatError(
            f"wavelengths must ascend, got {waves_nm[k + 1]:g} nm in band {index[k + 1]} after {waves_nm[k]:g} nm in band "
            f"{index[k]}; select bands in ascending order with bands="
        )


def _check_ascending(name: str, waves_nm: Floats) -> None:
    if np.any(np.diff(waves_nm) <= 0.0):
        raise ParameterError(name, "must ascend", waves_nm.tolist(), "nm")


def _limits(name: str, given: Sequence[int] | None, n: int) -> slice:
    start, stop = (0, n) if given is None else given
    if not 0 <= start < stop <= n:
        raise ParameterError(name, f"must be (start, stop) with 0 <= start < stop <= {n}", tuple(given or ()))
    return slice(start, stop)


def _in_file(part: slice, n: int, is_reversed: bool) -> slice:
    """Return rows counted from the top, or columns from the left, as a slice of the file."""
    return slice(n - part.stop, n - part.start) if is_reversed else part


def _per_band(name: str, values: Any, n_bands: int) -> Floats:
    array = np.asarray(values, np.float64)
    if array.shape not in ((), (1,), (n_bands,)) or not np.isfinite(array).all():
        raise FormatError(f"has {array.size} values of '{name}' for {n_bands} bands, or some are not finite")
    return np.array(np.broadcast_to(array, (n_bands,)))


def _load(data: Any, index: Ints, y: slice, x: slice) -> tuple[Images, tuple[float, float] | None]:
    """
    Return selected bands, and the range of their values where it is known.

    Floating-point data are not copied, except from a mapped file up to :data:`MAX_COPIED_BYTES`; others are converted.
    """
    is_small = data.dtype.itemsize <= (4 if data.dtype.kind == "f" else 2)
    real: Any = np.float32 if is_small else np.float64
    span = slice(int(index.min()), int(index.max()) + 1)
    if not isinstance(data, np.ndarray):  # one request, because chunks of a file may contain all bands
        _check_fits((span.stop - span.start, y.stop - y.start, x.stop - x.start), real)
        data, index, span = np.asarray(data[span, y, x]), index - span.start, slice(None)
        y = x = slice(None)
    view: Images = np.asarray(data)[span, y, x]
    is_by_pixel = view.shape[0] > 1 and view.strides[0] == view.itemsize
    is_run = bool(np.all(np.diff(index) == 1))
    if is_run and view.dtype == real and not is_by_pixel:
        if view.nbytes > MAX_COPIED_BYTES:
            return view, None
        limits, images = range_and_values(view)
        return images, limits
    _check_fits((index.size, *view.shape[1:]), real)
    images = np.empty((index.size, *view.shape[1:]), real)
    index = index - int(index.min())
    # By rows if stored by pixel, where a band would touch all memory.
    step = max(1, BLOCK_VALUES // (view.shape[0] * view.shape[2])) if is_by_pixel else view.shape[1]
    for first in range(0, view.shape[1], step):
        rows = slice(first, first + step)
        part = in_memory(view[:, rows]) if is_by_pixel else view[:, rows]
        for k, band in enumerate(index):
            images[k, rows] = in_memory(part[band])
    return images, None


def _check_fits(shape: tuple[int, int, int], real: Any) -> None:
    n_bytes = math.prod(shape) * np.dtype(real).itemsize
    if n_bytes > memory_bytes():
        raise FormatError(
            f"needs {n_bytes / 2**30:,.4g} GiB of memory, more than the {memory_bytes() / 2**30:.3g} GiB of this machine; "
            "select bands=, range_nm=, rows= or columns="
        )


def _checked(
    images: Images,
    missing: float | None,
    offset: Floats,
    invalid: str,
    index: Ints,
    corner: tuple[int, int],
) -> Images:
    """Add the offsets, and reject or replace invalid values; a view is then copied."""
    if offset.any():
        images = _writeable(images)
    n_invalid, first_invalid = 0, ""
    for k in range(images.shape[0]):
        where = _invalid_pixels(images[k], missing, offset[k])
        if where is None:
            continue
        n_invalid += int(np.count_nonzero(where))
        if invalid == "zero":
            images = _writeable(images)
            images[k][where] = 0.0
        elif not first_invalid:
            row, column = (int(i) for i in np.argwhere(where[::-1])[0])
            value = images[k][where.shape[0] - 1 - row, column]
            place = [int(index[k]), corner[0] + row, corner[1] + column]
            first_invalid = f"got {value:.6g} at [band, row, column] = {place}"
    if first_invalid:
        raise FormatError(
            f"values must be finite, >= 0 and not missing, {first_invalid}, {n_invalid:,} such values in all; pass "
            "invalid='zero' to replace them, or select bands=, rows= and columns="
        )
    return freeze(images)


def _is_valid(low: float, high: float, missing: float | None) -> bool:
    """Return whether all values of a range are finite, not negative and not missing."""
    return low >= 0.0 and high < np.inf and (missing is None or missing < low or missing > high)


def _writeable(images: Images) -> Images:
    copy = in_memory(images)
    return copy if copy.flags.writeable else np.array(copy)


def _invalid_pixels(band: NDArray[Any], missing: float | None, offset: float) -> Bools | None:
    """Add the offset to a band in place; return its invalid pixels, or None."""
    band = in_memory(band)
    low, high = value_range(band[np.newaxis])
    may_miss = missing is not None and not (missing < low or missing > high)
    where = band == missing if may_miss else None
    if offset:
        band += band.dtype.type(offset)
    if not (low + offset >= 0.0 and high < np.inf):
        bad = ~(np.isfinite(band) & (band >= 0.0))
        where = bad if where is None else where | bad
    return where if where is not None and where.any() else None

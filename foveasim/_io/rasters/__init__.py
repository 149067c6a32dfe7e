"""
Images of spectral bands in files of other programs.

Size limits, reading in the sandbox process, and the parts of EXR, MAT, netCDF, zarr and units that the readers of power maps
(:mod:`foveasim.maps`) and of hyperspectral cubes (:mod:`foveasim.scene.cubes`) share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats, Images, read_only
from foveasim._io import sandbox
from foveasim._io.formats import FileFormat, FormatError

MAX_DECOMPRESSED_BYTES = 8 * 2**30
#: Limit of the decompressed size: a constant plus a factor of the file size.
MIN_DECOMPRESSED_BYTES, DECOMPRESSED_PER_BYTE = 2**28, 256
MAX_BANDS = 4096
#: Relative tolerance of uniform steps: coordinates may be float32.
STEP_TOLERANCE = 1e-4


def read_raster(
    form: FileFormat, reader: Callable[..., sandbox.ReaderResult], path: Path, **args: Any
) -> sandbox.ReaderResult:
    """
    Run a reader of a format, in the sandbox process if the format requires it.

    ``form``: format of the file. ``reader``: module-level function of the path as a string and ``args``; returns metadata that
    JSON can represent, and arrays. ``**args``: keywords of the reader, plain data. Raises FileError if the file is corrupt,
    malformed or too large.
    """
    if not form.is_sandboxed:
        return reader(str(path), **args)
    return sandbox.read_in_sandbox(
        reader,
        path,
        kind=form.title,
        max_decompressed_bytes=max_decompressed_bytes,
        is_silent=form.is_silent,
        **args,
    )


def max_decompressed_bytes(n_bytes: int) -> int:
    """Return the limit of the decompressed size of a file of ``n_bytes``."""
    return min(MIN_DECOMPRESSED_BYTES + DECOMPRESSED_PER_BYTE * n_bytes, MAX_DECOMPRESSED_BYTES)


def check_size(shape: Sequence[int], itemsize: int, n_bytes: int) -> None:
    """
    Reject arrays that are too large, before they are decompressed.

    Raises FormatError if an array of the shape would exceed the memory limit of a file of ``n_bytes``.
    """
    size = itemsize
    for n in shape:
        size *= int(n)
    if size > max_decompressed_bytes(n_bytes):
        dimensions = " x ".join(map(str, shape[:5]))
        raise FormatError(
            f"contains an array of {dimensions} elements, more than the limit of {max_decompressed_bytes(n_bytes)} bytes "
            "for a file of this size; write it uncompressed"
        )


def pitch_of_axes(x: Floats, y: Floats) -> tuple[float | None, float | None]:
    """
    Return the signed coordinate steps of two axes; None for an axis with one cell.

    Raises FormatError if coordinates are not finite, or their steps are not uniform.
    """
    steps: list[float | None] = []
    for name, along in (("x", x), ("y", y)):
        if not np.isfinite(along).all():
            raise FormatError(f"has non-finite coordinates along {name}")
        if along.size == 1:
            steps.append(None)
            continue
        step = float((along[-1] - along[0]) / (along.size - 1))
        # Coordinates far from 0 that were rounded to float32 also have non-uniform steps.
        rounding = 4.0 * float(np.spacing(np.float32(np.abs(along).max())))
        if step == 0.0 or np.abs(np.diff(along) - step).max() > STEP_TOLERANCE * abs(step) + rounding:
            raise FormatError(f"has non-uniform steps along {name}; resample it to equal cells")
        steps.append(step)
    return steps[0], steps[1]


def as_images(data: NDArray[Any]) -> Images:
    """
    Return floating-point images (n_band, n_y, n_x) in native byte order.

    Raises FormatError if the dtype is not real, or the number of dimensions is wrong.
    """
    if data.ndim > 3 and all(n == 1 for n in data.shape[:-3]):
        data = data.reshape(data.shape[-3:])
    if data.ndim not in (2, 3) or 0 in data.shape:
        raise FormatError(f"contains an array of shape {data.shape[:6]}, expected (n_y, n_x) or (n_band, n_y, n_x)")
    if data.dtype.kind == "c":
        raise FormatError("contains complex values (a field); write the power, the square of their modulus")
    if data.dtype.kind not in "iuf":
        raise FormatError(f"contains an array of dtype {data.dtype!s:.40}, expected real numbers")
    if data.ndim == 3 and data.shape[0] > MAX_BANDS:
        raise FormatError(
            f"contains {data.shape[0]} bands, more than {MAX_BANDS}; store bands first: (n_band, n_y, n_x)"
        )
    images = data.reshape(-1, *data.shape[-2:])
    is_small = images.dtype.itemsize <= (4 if images.dtype.kind == "f" else 2)
    converted: Images = images.astype(np.float32 if is_small else np.float64, copy=False)
    if converted is not images:
        read_only(converted)
    return converted

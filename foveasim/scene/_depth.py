"""
Distances of the pixels of a picture: files, their units, and pixels without a distance.

Distances are those along the optical axis, as depth cameras and stereo pairs state them, in m.

Sources: N. Silberman, D. Hoiem, P. Kohli, R. Fergus, Indoor segmentation and support inference from RGBD images, ECCV (2012),
and the functions ``depth_rel2depth_abs.m`` and ``camera_params.m`` of its toolbox; J. H. Lee et al., From big to small:
multi-scale local planar guidance for monocular depth estimation, arXiv:1907.10326 (2019), whose pictures of the depth of NYU
Depth v2 are in millimetres; D. Scharstein et al., High-resolution stereo datasets with subpixel-accurate ground truth, GCPR
(2014), and the description of ``calib.txt`` on the page of the data; J. Sturm et al., A benchmark for the evaluation of RGB-D
SLAM systems, IROS (2012), and the page of its file formats; Technical introduction to OpenEXR (channel Z: the distance of a
sample from the viewer, whose unit and direction it leaves open).
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from foveasim._core.names import missing_path
from foveasim._core.validation import Floats, as_numbers, check_number, read_only
from foveasim._io.formats import FormatError, as_file_error
from foveasim._io.images import read_picture
from foveasim._io.rasters.exr import MAGIC, read_channels, read_header
from foveasim.errors import FileError, ParameterError
from foveasim.units import m_from_mm

#: Conventions of depth files, besides a factor: NYU Depth v2 as recorded by the Kinect, pictures of the NYU and TUM sets, and
#: disparities of Middlebury 2014.
DepthFormat: TypeAlias = Literal["mm", "nyu", "nyu_raw", "tum", "middlebury"]
#: What replaces pixels without a distance: an error, the farthest background, or the nearest pixel with a distance.
Missing: TypeAlias = Literal["raise", "far", "nearest"]
#: Metres per stored value.
SCALES_M: dict[str, float] = {"mm": 1e-3, "nyu": 1e-3, "tum": 1.0 / 5000.0}
#: Raw values d of NYU Depth v2, with swapped bytes, are disparities of the Kinect: 351.3 / (1092.5 - d) m, set to 10 m if they
#: are more.
NYU_NUMERATOR_M, NYU_OFFSET, NYU_FARTHEST_M = 351.3, 1092.5, 10.0
#: Numbers of a calibration of Middlebury: ``cam0=[f 0 cx; 0 f cy; 0 0 1]``, ``doffs=...`` in pixels, ``baseline=...`` in mm.
CALIBRATION = re.compile(r"^\s*(cam0|doffs|baseline)\s*=\s*\[?\s*([-+0-9.eE]+)", re.MULTILINE)
MAX_CALIBRATION_BYTES = 65536
#: Distances of pixels are at most those of scenes.
MAX_DISTANCE_M = 1e9
SHORTEST_M = 1e-6


def read_depth(
    depth: Any,
    *,
    depth_scale: float | None,
    depth_format: DepthFormat | None,
    calibration: str | Path | None,
    missing: Missing,
) -> Floats:
    """
    Return distances (n_y, n_x), m, bottom row first.

    ``depth``: array or file, top row first. Raises ParameterError or FileError.
    """
    if depth_scale is not None and depth_format is not None:
        raise ParameterError("depth_scale", "must not be given together with 'depth_format'", depth_scale)
    if (depth_format == "middlebury") != (calibration is not None):
        raise ParameterError(
            "calibration",
            "must be the file calib.txt of depth_format='middlebury', and is of no use otherwise",
            calibration,
        )
    if not isinstance(depth, str | os.PathLike):
        values = as_numbers("depth_m", depth, keep_type=True)
        return _checked(_in_m(values, depth_scale, depth_format, calibration), missing)
    path = Path(depth)
    values, is_exr = _read(path)
    if depth_scale is None and depth_format is None:
        raise FileError(
            path,
            "does not state the unit of its distances; pass depth_scale, in m per value (0.001 for mm), or depth_format",
        )
    if is_exr and depth_format is not None:
        raise ParameterError("depth_format", "must be None for EXR: pass depth_scale, in m per value", depth_format)
    try:
        return _checked(_in_m(values, depth_scale, depth_format, calibration), missing)
    except ParameterError as error:
        if error.name != "depth_m":
            raise
        raise FileError(path, error.detail) from None


def _read(path: Path) -> tuple[NDArray[Any], bool]:
    """Return the values of a file, and whether it is EXR."""
    if not path.is_file():
        raise FileError(path, missing_path(path))
    with path.open("rb") as file:
        is_exr = file.read(4) == MAGIC
    if is_exr:
        with as_file_error(path, "depth file", passes=(ParameterError,)):
            names = read_header(path).channels
            found = [name for name in names if name.rpartition(".")[2] == "Z"]
            if len(found) != 1:
                listed = ", ".join(names[:5])
                raise FormatError(f"must have one channel Z of distances, got {listed:.80}")
            return read_channels(path, found)[0], True
    if path.suffix.lower() == ".npy":
        with as_file_error(path, "depth file", passes=(ParameterError,)):
            return as_numbers("depth_m", np.load(path, mmap_mode="r", allow_pickle=False), keep_type=True), False
    values = read_picture(path)
    if values.ndim != 2:
        raise FileError(path, f"must have one channel of distances, got the shape {values.shape}")
    if values.dtype == np.uint8:
        raise FileError(path, "has 8 bits, which are too few for distances; use 16 bits, EXR, PFM or an array in m")
    return values, False


def _in_m(
    values: NDArray[Any], scale: float | None, depth_format: DepthFormat | None, calibration: str | Path | None
) -> Floats:
    """Return stored values in m: 0 where a code means that there is no distance."""
    stored = values.astype(np.float64)
    if scale is not None:
        return stored * check_number("depth_scale", scale, above=0.0)
    if depth_format is None:
        return stored
    if depth_format == "nyu_raw":
        # The Kinect states 2047 for pixels without a distance, for which the formula is negative; the toolbox then returns 0.
        is_measured = (stored > 0.0) & (stored < NYU_OFFSET)
        found_m = NYU_NUMERATOR_M / np.where(is_measured, NYU_OFFSET - stored, 1.0)
        return np.where(is_measured, np.minimum(found_m, NYU_FARTHEST_M), 0.0)
    if depth_format == "middlebury":
        assert calibration is not None
        focal, offset, baseline_mm = _calibration(Path(calibration))
        disparity = stored + offset
        # Infinite disparities are unknown.
        is_known = np.isfinite(stored) & (disparity > 0.0)
        return np.where(is_known, float(m_from_mm(baseline_mm)) * focal / np.where(is_known, disparity, 1.0), 0.0)
    if values.dtype.kind not in "ui":
        raise ParameterError(
            "depth_m", f"must contain integers for depth_format='{depth_format}', got {values.dtype}; use depth_scale"
        )
    return stored * SCALES_M[depth_format]


def _calibration(path: Path) -> tuple[float, float, float]:
    """Return focal length and offset of disparities in pixels, and the baseline in mm."""
    if not path.is_file():
        raise FileError(path, missing_path(path))
    with path.open("rb") as file:
        text = file.read(MAX_CALIBRATION_BYTES).decode("utf-8", "replace")
    found = {}
    for name, number in CALIBRATION.findall(text):
        try:
            found[name] = float(number)
        except ValueError:
            raise FileError(path, f"must have a number after {name}=, got {number:.40}") from None
    absent = [name for name in ("cam0", "doffs", "baseline") if name not in found]
    if absent:
        raise FileError(
            path, f"must be a calibration of Middlebury 2014 with cam0, doffs and baseline, but lacks {absent[0]}"
        )
    return found["cam0"], found["doffs"], found["baseline"]


def _checked(depth_m: Floats, missing: Missing) -> Floats:
    """Return distances, bottom row first, without missing ones."""
    if depth_m.ndim != 2 or 0 in depth_m.shape:
        raise ParameterError("depth_m", f"must have the shape (n_y, n_x), got {depth_m.shape}")
    if (depth_m < 0.0).any():
        raise ParameterError("depth_m", "must be > 0, or 0 where there is no distance", float(np.nanmin(depth_m)), "m")
    is_missing = np.isnan(depth_m) | (depth_m == 0.0)
    if is_missing.any():
        if missing == "raise":
            raise ParameterError(
                "depth_m",
                f"must have a distance in every pixel, but {np.count_nonzero(is_missing):,} of {depth_m.size:,} are 0 or NaN; "
                "pass missing='nearest' (that of the nearest pixel) or 'far' (infinity)",
            )
        if is_missing.all():
            raise ParameterError("depth_m", "must have a distance in at least one pixel")
        if missing == "far":
            depth_m = np.where(is_missing, np.inf, depth_m)
        else:
            from scipy.ndimage import distance_transform_edt

            at_y, at_x = distance_transform_edt(is_missing, return_distances=False, return_indices=True)
            depth_m = depth_m[at_y, at_x]
    return read_only(np.ascontiguousarray(depth_m[::-1]))


def check_depth(depth_m: Any, shape: tuple[int, ...]) -> Floats:
    """Return the distances of a scene of the shape (n_y, n_x), read-only; infinity is allowed."""
    found = as_numbers("depth_m", depth_m)
    if found.shape != shape:
        raise ParameterError(
            "depth_m", f"must have the shape of the picture, {shape}, got {found.shape}; resample one of them"
        )
    lowest = float(found.min())  # NaN if any
    if not lowest >= SHORTEST_M:
        raise ParameterError("depth_m", f"must be at least {SHORTEST_M:g}, or infinity", lowest, "m", "depths are in m")
    return found

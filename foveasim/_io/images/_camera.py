"""HEIC pictures and camera raw files, in the sandbox process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._io.formats import FormatError
from foveasim._io.images._limits import check_size
from foveasim._io.images._profiles import MAX_PROFILE_BYTES

#: Parameters of libraw that give the sRGB encoding of linear values: exponent and slope of the linear part.
SRGB_GAMMA = (2.4, 12.92)


def read_heif(name: str) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """
    Read the primary picture of a HEIC file, upright, in the sandbox process.

    Returns ``h273``, the codes of primaries and transfer characteristics, or None; pixels, and the ICC profile as bytes, empty
    if there is none.
    """
    path = Path(name)
    pillow_heif = import_optional(path, "pillow_heif")
    file = pillow_heif.open_heif(name, convert_hdr_to_8bit=False, hdr_to_16bit=False)
    check_size(*file.size)
    picture = np.asarray(file)
    largest = 2 ** file.info.get("bit_depth", 8) - 1
    if picture.dtype != np.uint8:  # 10 or 12 bits
        picture = np.rint(picture * (np.iinfo(np.uint16).max / largest)).astype(np.uint16)
    if picture.ndim == 3 and picture.shape[2] in (2, 4) and getattr(file, "premultiplied_alpha", False):
        picture = picture[..., :-1]  # the colours are already composed with black
    profile = file.info.get("icc_profile") or b""
    if len(profile) > MAX_PROFILE_BYTES:
        raise FormatError(f"has a colour profile of {len(profile)} bytes, more than the limit of {MAX_PROFILE_BYTES}")
    nclx = file.info.get("nclx_profile")
    h273 = [int(nclx[key]) for key in ("color_primaries", "transfer_characteristics")] if nclx else None
    return {"h273": h273}, [picture, np.frombuffer(profile, np.uint8)]


def read_raw(name: str) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Demosaic a raw file in sRGB, as white-balanced by the camera, in the sandbox process."""
    path = Path(name)
    rawpy = import_optional(path, "rawpy")
    with rawpy.imread(name) as raw:
        check_size(raw.sizes.raw_width, raw.sizes.raw_height)
        picture = raw.postprocess(
            gamma=SRGB_GAMMA,
            no_auto_bright=True,
            adjust_maximum_thr=0.0,  # white is saturation, not the brightest pixel
            use_camera_wb=True,
            output_bps=16,
            output_color=rawpy.ColorSpace.sRGB,
        )
    return {}, [picture]


def read_mosaic(name: str) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Read the codes of a raw file, as on the sensor, in the sandbox process."""
    rawpy = import_optional(Path(name), "rawpy")
    with rawpy.imread(name) as raw:
        check_size(raw.sizes.raw_width, raw.sizes.raw_height)
        return {}, [np.array(raw.raw_image_visible)]

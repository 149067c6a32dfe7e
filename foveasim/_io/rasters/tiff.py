"""
Tags of TIFF pages that change what their numbers mean, for maps and cubes.

Read are the photometric interpretation (0 is black), the orientation (top or bottom row first), the value without data of GDAL,
and the kind of extra samples. Tags of :data:`REJECTED`, and scales and offsets of GDAL, are errors by name. tifffile applies
the layout, sample format, predictor and compression. All other tags do not change numbers: names, dates, resolution, geography.
"""

from __future__ import annotations

import re
from typing import Any

from foveasim._io.formats import FormatError

#: Tags that are read.
ORIENTATION, EXTRA_SAMPLES, GDAL_METADATA, GDAL_NODATA = 274, 338, 42112, 42113
#: Orientations with the top row first and the bottom row first.
TOP_FIRST, BOTTOM_FIRST = 1, 4
#: Extra samples without a defined meaning; others are transparency.
UNSPECIFIED = 0
#: Tags with which numbers are not proportional to light, and what they are.
REJECTED = {
    290: "a response curve (GrayResponseUnit)",
    291: "a response curve (GrayResponseCurve)",
    301: "a transfer function (TransferFunction)",
    320: "a palette (ColorMap)",
    34675: "a colour profile with a transfer function (InterColorProfile)",
}
#: Scale or offset in the metadata of GDAL, other than 1 and 0.
GDAL_FACTOR = re.compile(r'role="(scale|offset)"[^>]*>\s*([^<\s]+)', re.IGNORECASE)


def check_page(page: Any) -> bool:
    """
    Return whether the first row of a page is the top row.

    Raises FormatError for tags that change its numbers.
    """
    import tifffile

    if page.photometric not in (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.RGB):
        raise FormatError("has an unsupported photometric interpretation; save values with 0 as black")
    for tag, what in REJECTED.items():
        if tag in page.tags:
            raise FormatError(f"has {what}, the tag {tag}; save linear values without it")
    extra = page.tags[EXTRA_SAMPLES].value if EXTRA_SAMPLES in page.tags else ()
    if any(int(kind) != UNSPECIFIED for kind in (extra if isinstance(extra, tuple) else (extra,))):
        raise FormatError("has transparency as a sample, which is no band; save it without alpha")
    if GDAL_METADATA in page.tags:
        for role, value in GDAL_FACTOR.findall(str(page.tags[GDAL_METADATA].value)):
            if value not in ({"1", "1.0"} if role.lower() == "scale" else {"0", "0.0"}):
                raise FormatError(f"has the {role.lower()} {value:.20} in GDAL_METADATA; apply it, and save it without")
    orientation = page.tags[ORIENTATION].value if ORIENTATION in page.tags else TOP_FIRST
    if orientation not in (TOP_FIRST, BOTTOM_FIRST):
        raise FormatError(f"has the unsupported orientation {orientation!s:.10}; save it with orientation 1 or 4")
    return bool(orientation == TOP_FIRST)


def missing_value(page: Any) -> float | None:
    """Return the value of pixels without data by GDAL, or None."""
    if GDAL_NODATA not in page.tags:
        return None
    text = str(page.tags[GDAL_NODATA].value).strip().rstrip("\0")
    try:
        return float(text)
    except ValueError:
        raise FormatError(f"has the tag GDAL_NODATA = {text!r:.20}, expected a number") from None

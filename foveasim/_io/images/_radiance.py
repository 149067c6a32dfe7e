"""
Radiance HDR pictures, with the header of the manual of Radiance ("File Formats").

Values are divided by all EXPOSURE and COLORCORR of the header, so that they are the radiance of the scene; OpenCV, imageio
and imagecodecs ignore both. Without PRIMARIES the primaries are those of sRGB, as other programs mean them (Radiance: white
at (1/3, 1/3)). Lines that begin with a blank are those of pictures from which this one was made.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from foveasim._core.extras import import_optional
from foveasim._io.formats import FormatError
from foveasim._io.images._colour import Colour, FilePicture
from foveasim._io.images._limits import check_size, check_square_pixels
from foveasim.errors import printable

#: Variables that are understood.
UNDERSTOOD = frozenset(("FORMAT", "EXPOSURE", "COLORCORR", "PRIMARIES", "PIXASPECT", "GAMMA", "NCOMP"))
#: Variables that do not change the pixels: the view and the programs, and sizes that the resolution repeats.
IRRELEVANT = frozenset(
    ("VIEW", "SOFTWARE", "CAPDATE", "GMT", "LATLONG", "OWNER", "CAMERA", "LAMPCALC", "NROWS", "NCOLS")
)
RGB, XYZ = "32-bit_rle_rgbe", "32-bit_rle_xyze"
#: Size limit of a header, and its end.
MAX_HEADER_BYTES = 2**16
VARIABLE = re.compile(r"([A-Z_][A-Z0-9_]*)=(.*)")
RESOLUTION = re.compile(rb"([-+])([XY]) +(\d{1,9}) +([-+])([XY]) +(\d{1,9})\s*")


def read_radiance(path: Path) -> FilePicture:
    """
    Read a Radiance HDR picture, upright.

    Raises FormatError when a variable of the header changes the meaning and is not known.
    """
    imagecodecs = import_optional(path, "imagecodecs")
    content = path.read_bytes()
    header, resolution, begin = _parts(content)
    factor, colour = np.ones(3), Colour(transfer="linear")
    for line in header:
        match = VARIABLE.match(line)
        if match is None:
            continue  # comments and commands
        name, text = match.groups()
        if name == "EXPOSURE":
            factor *= _numbers(name, text, 1, above=0.0)
        elif name == "COLORCORR":
            factor *= _numbers(name, text, 3, above=0.0)
        elif name == "PRIMARIES":
            colour = Colour(transfer="linear", primaries=tuple(_numbers(name, text, 8)))
        elif name == "PIXASPECT":
            check_square_pixels(_numbers(name, text, 1, above=0.0)[0], 1.0, name)
        elif name == "GAMMA" and not math.isclose(_numbers(name, text, 1)[0], 1.0):
            raise FormatError(
                f"has GAMMA={printable(text):.20}, but pictures of Radiance are linear; save it with GAMMA=1"
            )
        elif name == "FORMAT" and text.strip() != RGB:
            cure = "; convert it with: ra_xyze -r" if text.strip() == XYZ else ""
            raise FormatError(f"has the FORMAT {printable(text.strip())!r:.40}, expected {RGB}{cure}")
        elif name == "NCOMP" and _numbers(name, text, 1)[0] != 3.0:
            raise FormatError(f"has NCOMP={printable(text):.20}, expected 3 components")
        elif name not in UNDERSTOOD and name not in IRRELEVANT:
            raise FormatError(f"has the unknown variable {printable(name)!r:.40} in its header; remove the line")
    sign_major, major, n_major, sign_minor, minor, n_minor = resolution
    if major == minor:
        raise FormatError("is corrupt or truncated (resolution)")
    check_size(n_minor, n_major)
    # Scan lines have the order of the resolution: the decoder knows only the usual one.
    usual = f"#?RADIANCE\nFORMAT={RGB}\n\n-Y {n_major} +X {n_minor}\n".encode()
    pixels: Any = np.asarray(imagecodecs.rgbe_decode(usual + content[begin:]))
    # Y decreases down, X increases to the right.
    if (sign_major == "+") == (major == "Y"):
        pixels = pixels[::-1]
    if (sign_minor == "+") == (minor == "Y"):
        pixels = pixels[:, ::-1]
    pixels = pixels if major == "Y" else pixels.swapaxes(0, 1)
    if not (factor == 1.0).all():
        pixels = (pixels / factor).astype(np.float32)
    return FilePicture(pixels=np.ascontiguousarray(pixels), colour=colour)


def _parts(content: bytes) -> tuple[list[str], tuple[str, str, int, str, str, int], int]:
    """Return the lines of the header, the resolution, and the offset of the pixels."""
    end = content.find(b"\n\n", 0, MAX_HEADER_BYTES)
    last = content.find(b"\n", end + 2, end + 2 + 64) if end >= 0 else -1
    match = RESOLUTION.fullmatch(content[end + 2 : last]) if last >= 0 else None
    if match is None:
        raise FormatError("is corrupt or truncated (no size)")
    lines = content[:end].decode("latin-1").split("\n")[1:]
    sign, axis, number, *others = match.groups()
    return (
        lines,
        (sign.decode(), axis.decode(), int(number), others[0].decode(), others[1].decode(), int(others[2])),
        last + 1,
    )


def _numbers(name: str, text: str, n: int, above: float = -math.inf) -> list[float]:
    """Return n finite numbers of a variable."""
    try:
        numbers = [float(part) for part in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != n or not all(math.isfinite(number) and number > above for number in numbers):
        expected = f"{n} positive number{'s' * (n > 1)}" if above == 0.0 else f"{n} number{'s' * (n > 1)}"
        raise FormatError(f"has {name}={printable(text):.40} in its header, expected {expected}")
    return numbers

"""
Cubes in a folder of pictures: one grey picture per band, as in the database CAVE.

The pictures are PNG or TIFF files with one number per pixel, 8 or 16 bits or floating point, all of one size, top row first.
They are sorted by their names, numbers by value. Wavelengths are numbers before ``nm`` in the names, ``spool_450nm.png``, or
those of the caller, in the order of the names. ``name`` is a pattern for the names in a folder with other pictures:
``"*_ms_*.png"``. Files of other kinds, such as text and colour pictures in other formats, are ignored.

Numbers are returned as they are stored, and are proportional to the light: PNG files with a transfer function (``gAMA``,
``sRGB``, ``iCCP``, ``cICP``), a palette, colours or transparency are rejected.
"""

from __future__ import annotations

import fnmatch
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats
from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.images import TIFF_EXTENSIONS, read_picture
from foveasim._io.rasters import MAX_BANDS
from foveasim.errors import FileError
from foveasim.scene.cubes._cube import EXAMPLE_UNIT, Cube, example_radiance
from foveasim.scene.cubes._formats import CUBE_FORMATS

PNG = ".png"
WAVELENGTH = re.compile(r"(?<![0-9.,])([0-9]{2,5}(?:[.,][0-9]{1,4})?)[ _]?nm(?![a-z])", re.IGNORECASE)
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
#: Chunks of PNG that change the meaning of numbers; all others do not.
REJECTED_CHUNKS = {
    b"gAMA": "a transfer function",
    b"sRGB": "a transfer function",
    b"iCCP": "a transfer function",
    b"cICP": "a transfer function",
    b"PLTE": "a palette",
    b"tRNS": "transparency",
    b"acTL": "an animation",
}
#: Files of a folder that are considered.
MAX_FILES = 100_000


def is_folder(path: Path, _head: bytes) -> bool:
    """Return whether a path is a directory with pictures of bands."""
    return path.is_dir() and any(_is_band(each) for each in path.iterdir())


def _is_band(path: Path) -> bool:
    is_hidden = path.name.startswith(".")
    return not is_hidden and path.suffix.lower() in (PNG, *TIFF_EXTENSIONS) and path.is_file()


def read_folder(path: Path, name: str | None) -> Cube:
    """Read the pictures of a folder in the order of their names."""
    files = _files(path, name)
    bands = [_band(files[0])]
    for file in files[1:]:
        band = _band(file)
        if band.shape != bands[0].shape or band.dtype != bands[0].dtype:
            raise FormatError(
                f"contains bands of different kinds: {files[0].name!r:.60} has {bands[0].shape} {bands[0].dtype}, "
                f"{file.name!r:.60} {band.shape} {band.dtype}; select files with name='*.png' or another pattern"
            )
        bands.append(band)
    found = [WAVELENGTH.findall(file.name) for file in files]
    has_waves = all(len(each) == 1 for each in found)
    waves_nm = [float(each[0].replace(",", ".")) for each in found] if has_waves else None
    order = np.argsort(waves_nm, kind="stable") if waves_nm is not None else np.arange(len(files))
    return Cube(
        data=np.stack([bands[k] for k in order]),
        wavelength=None if waves_nm is None else [waves_nm[k] for k in order],
        wavelength_unit="nm",
    )


def _files(path: Path, name: str | None) -> list[Path]:
    """Return the pictures of bands, sorted by names."""
    every = sorted(path.iterdir(), key=lambda each: _natural(each.name))
    if len(every) > MAX_FILES:
        raise FormatError(f"contains {len(every)} files, more than {MAX_FILES}")
    pattern = "*" if name is None else name
    files = [each for each in every if _is_band(each) and fnmatch.fnmatchcase(each.name, pattern)]
    if not files:
        raise FormatError(f"contains no PNG or TIFF pictures with names like {pattern!r:.60}")
    if len(files) > MAX_BANDS:
        raise FormatError(f"contains {len(files)} pictures, more than {MAX_BANDS} bands")
    kinds = sorted({each.suffix.lower() for each in files})
    if len(kinds) > 1:
        raise FormatError(
            f"contains pictures of several kinds, {', '.join(kinds)}; select some with name='*{kinds[0]}'"
        )
    return files


def _natural(name: str) -> list[Any]:
    """Return a key that sorts numbers in names by value."""
    return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in re.split(r"([0-9]{1,18})", name.lower())]


def _band(file: Path) -> NDArray[Any]:
    """Return the numbers of a picture, (n_y, n_x)."""
    if file.suffix.lower() == PNG:
        for chunk in _chunks(file):
            if chunk in REJECTED_CHUNKS:
                raise FormatError(
                    f"has a picture {file.name!r:.60} with {REJECTED_CHUNKS[chunk]} (the chunk {chunk.decode()}), which "
                    "changes its numbers; write it without"
                )
    try:
        picture = read_picture(file)
    except FileError as error:
        raise FormatError(f"has a picture {file.name!r:.60} that {error.detail}") from None
    if picture.ndim != 2:
        raise FormatError(
            f"has a picture {file.name!r:.60} of {picture.shape[2]} channels, expected one number per pixel; select grey "
            "pictures with name=, a pattern"
        )
    return picture


def _chunks(file: Path) -> list[bytes]:
    """Return the names of the chunks before the pixels of a PNG file."""
    found: list[bytes] = []
    with file.open("rb") as binary:
        if binary.read(8) != PNG_MAGIC:
            raise FormatError(f"has a file {file.name!r:.60}, which is not a PNG picture")
        while len(head := binary.read(8)) == 8 and head[4:] not in (b"IDAT", b"IEND"):
            found.append(head[4:])
            binary.seek(int.from_bytes(head[:4], "big") + 4, 1)
            if len(found) > MAX_BANDS:
                break
    return found


def _example(path: Path) -> tuple[Floats, dict[str, Any]]:
    """Write 16-bit pictures, whose names contain wavelengths."""
    from PIL import Image

    radiance = example_radiance()
    path.mkdir()
    for wave_nm, band in zip((500, 600), radiance, strict=True):
        Image.fromarray(band[::-1].astype(np.uint16)).save(path / f"example_{wave_nm}nm.png")
    return radiance, {"unit": EXAMPLE_UNIT}


CUBE_FORMATS.register(
    "folder",
    FileFormat(title="folder of pictures", suffixes=("",), matches=is_folder, read=read_folder, is_directory=True),
    example=_example,
)

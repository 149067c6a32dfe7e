"""
ENVI cubes: a text header ``.hdr`` and a file of raw data, which is mapped into memory.

The header is the file that is opened, or is found by the name of the data: ``a.img`` and ``a.hdr`` or ``a.img.hdr``. The data
file has the size that the header specifies. Keys are those of :data:`UNDERSTOOD`, in any case; the unit of radiance is read
from ``data units``. Gains and offsets of reflectance apply where there are none of radiance. Keys of :data:`IRRELEVANT` do not
change the values, and neither do other keys, unless one of :data:`RELEVANT` is in their names, which is an error. Lists may
begin on the line after their key, and have commas or blanks between their values.
"""

from __future__ import annotations

import math
import re
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.names import did_you_mean
from foveasim._core.validation import Floats
from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.mapped_files import map_file
from foveasim.scene.cubes._cube import EXAMPLE_NM, EXAMPLE_UNIT, Cube, Quantity, example_radiance
from foveasim.scene.cubes._formats import CUBE_FORMATS

#: First bytes of headers, which may follow a byte order mark.
MAGIC, MAGIC_BYTES = b"ENVI", 7
MAX_HEADER_BYTES = 2**22
#: dtypes by ``data type``; 6 and 9 are complex.
TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}
#: Axes of the data, and their order as (band, line, sample).
INTERLEAVES = {
    "bsq": (("bands", "lines", "samples"), (0, 1, 2)),
    "bil": (("lines", "bands", "samples"), (1, 0, 2)),
    "bip": (("lines", "samples", "bands"), (2, 0, 1)),
}
#: Extensions of data files.
DATA_SUFFIXES = ("", ".img", ".dat", ".raw", ".bin", ".bsq", ".bil", ".bip", ".cube", ".cub")
#: Names of the unit of radiance, which the format does not define.
UNIT_KEYS = ("data units", "data unit", "radiance units", "units")
MAX_SIZE = 2**40
#: Keys that are read.
UNDERSTOOD = frozenset((
    "samples", "lines", "bands", "header offset", "file type", "data type", "interleave", "byte order", "wavelength",
    "wavelength units", "data gain values", "data offset values", "data reflectance gain values",
    "data reflectance offset values", "reflectance scale factor", "bbl", "data ignore value", "file compression",
    "major frame offsets", "minor frame offsets",
    *UNIT_KEYS,
))  # fmt: skip
#: Keys that do not change the values: where the scene is (its distance and pitch are those of the caller), the sensor's bands,
#: whose widths are not those of the spectrum between them, names, display, time and weather; settings of Specim's cameras.
IRRELEVANT = frozenset((
    "map info", "projection info", "coordinate system string", "geo points", "pixel size", "rpc info", "x start", "y start",
    "dem file", "dem band", "fwhm", "sensor type", "sensor", "sensorid", "band names", "spectra names", "description",
    "default bands", "default stretch", "z plot range", "z plot average", "z plot titles", "plot range", "plot average",
    "plot titles", "sun azimuth", "sun elevation", "solar irradiance", "cloud cover", "acquisition time", "acquisition date",
    "timestamp", "security tag", "product type", "history", "fps", "tint", "binning", "himg", "vimg", "hroi", "vroi", "errors",
    "fodis", "trigger mode", "temperature", "gps start time", "gps stop time", "spatial binning", "spectral binning",
))  # fmt: skip
#: Parts of the names of keys that change the values.
RELEVANT = re.compile(
    r"gain|offset|scal|factor|unit|wave|byte|interleave|compress|mask|ignore|calib|quanti|radian|reflect|irrad|order|type|rotat|"
    r"mirror|flip|class|complex|procedure|encod|gamma|\blog|dark|linear"
)


def is_envi(path: Path, head: bytes) -> bool:
    """Return whether a file is a header, or data with a header."""
    is_data = path.is_file() and path.suffix.lower() in DATA_SUFFIXES
    return _begins_with_magic(head) or (is_data and _header_of(path) is not None)


def _begins_with_magic(head: bytes) -> bool:
    return head.removeprefix(b"\xef\xbb\xbf").startswith(MAGIC)


def read_envi(path: Path, name: str | None) -> Cube:
    """Map the data of a header."""
    if name is not None:
        raise FormatError("contains one unnamed cube; omit name=")
    with path.open("rb") as file:
        is_header = _begins_with_magic(file.read(MAGIC_BYTES))
    header_path = path if is_header else _header_of(path)
    assert header_path is not None
    entries = _entries(header_path)
    data_path = _data_of(header_path) if is_header else path
    scale: Any
    offset: Any
    unit = next((entries[key].strip("{} ") for key in UNIT_KEYS if key in entries), None)
    quantity: Quantity | None = None
    scale, offset = (_band_numbers(entries, f"data {name} values") for name in ("gain", "offset"))
    of_reflectance = [_band_numbers(entries, f"data reflectance {name} values") for name in ("gain", "offset")]
    if scale is None and offset is None and of_reflectance != [None, None]:
        (scale, offset), quantity, unit = of_reflectance, "reflectance", None
    scale, offset = (default if values is None else values for values, default in ((scale, 1.0), (offset, 0.0)))
    factor = _number(entries, "reflectance scale factor")
    if factor is not None:
        if not factor > 0.0:
            raise FormatError(f"'reflectance scale factor' must be > 0, got {factor:g}")
        quantity, unit = "reflectance", None
        scale, offset = (np.asarray(values) / factor for values in (scale, offset))
    good = _band_numbers(entries, "bbl")
    wavelength = _numbers(entries, "wavelength")
    return Cube(
        data=_map(data_path, entries),
        wavelength=wavelength,
        wavelength_unit=_wavelength_unit(entries),
        quantity=quantity,
        unit=unit,
        scale=scale,
        offset=offset,
        is_good=None if good is None else [value != 0.0 for value in good],
        missing=_number(entries, "data ignore value"),
    )


def _entries(path: Path) -> dict[str, str]:
    """Return the entries of a header with keys in lower case."""
    if path.stat().st_size > MAX_HEADER_BYTES:
        raise FormatError(f"has a header of {path.stat().st_size} bytes, more than {MAX_HEADER_BYTES}")
    content = path.read_bytes()
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if not text.startswith("ENVI"):
        raise FormatError(f"has the header {path.name!r}, which does not begin with ENVI")
    lines = deque(line for line in text.split("\n") if line.strip() and not line.lstrip().startswith(";"))
    entries: dict[str, str] = {}
    while lines:
        name, equals, value = lines.popleft().partition("=")
        if not equals:
            continue
        key, parts = " ".join(name.lower().split()), [value.strip()]
        if not parts[0] and lines and lines[0].lstrip().startswith("{"):
            parts = [lines.popleft().strip()]
        while parts[0].startswith("{") and "}" not in parts[-1]:
            parts.append(lines.popleft() if lines else "}")
        value = " ".join(parts)
        if entries.setdefault(key, value) != value:
            raise FormatError(f"has two values of {key!r:.40}, {entries[key]!r:.40} and {value!r:.40}; remove one")
    _check_keys(entries)
    return entries


def _check_keys(entries: dict[str, str]) -> None:
    """Raise a FormatError for an unknown key that changes values, or another file type."""
    for key in entries:
        if key not in UNDERSTOOD and key not in IRRELEVANT and RELEVANT.search(key):
            raise FormatError(f"has the unknown key {key!r:.60}, which may change the values; remove it if it does not")
    kind = entries.get("file type", "").strip("{} ")
    if kind.lower() not in ("", "envi", "envi standard"):
        raise FormatError(f"has the 'file type' {kind!r:.40}, expected ENVI Standard, an image of numbers")


def _map(path: Path, entries: dict[str, str]) -> NDArray[Any]:
    """Return the data (band, line, sample) as a memory map."""
    interleave = entries.get("interleave", "").lower()
    if interleave not in INTERLEAVES:
        got = f"got {interleave!r:.20}" if interleave else "and is missing"
        raise FormatError(f"'interleave' must be bsq, bil or bip, {got}")
    if _integer(entries, "file compression", default=0):
        raise FormatError("is compressed; decompress the data file, and set 'file compression = 0'")
    for key in ("major frame offsets", "minor frame offsets"):
        if any(_numbers(entries, key) or []):
            raise FormatError(f"has '{key}', which are not supported; write the data without gaps")
    number = _integer(entries, "data type")
    if number not in TYPES:
        what = "complex" if number in (6, 9) else "not known"
        raise FormatError(f"'data type' must be one of {', '.join(map(str, TYPES))}, got {number}, which is {what}")
    order = _integer(entries, "byte order", default=0)
    if order not in (0, 1):
        raise FormatError(f"'byte order' must be 0 (little-endian) or 1 (big-endian), got {order}")
    dtype = np.dtype("<>"[order] + TYPES[number])
    axes, to_bands = INTERLEAVES[interleave]
    sizes = {key: _integer(entries, key, at_least=1) for key in ("bands", "lines", "samples")}
    offset = _integer(entries, "header offset", default=0)
    expected, actual = offset + math.prod(sizes.values()) * dtype.itemsize, path.stat().st_size
    if expected != actual:
        problem = "the data file is truncated, or" if actual < expected else "the data file contains more, or"
        raise FormatError(
            f"specifies {sizes['lines']} lines x {sizes['samples']} samples x {sizes['bands']} bands of {dtype.itemsize} bytes "
            f"after {offset} bytes, {expected:,} bytes in all, but {path.name!r:.60} has {actual:,}: {problem} the header is "
            "that of another file"
        )
    return map_file(path, dtype, tuple(sizes[axis] for axis in axes), offset).transpose(to_bands)


def _wavelength_unit(entries: dict[str, str]) -> str | None:
    unit = entries.get("wavelength units", "").strip("{} ")
    return None if unit.lower() in ("", "unknown") else unit


def _header_of(path: Path) -> Path | None:
    """Return the header of a data file, or None."""
    for candidate in (path.with_name(path.name + ".hdr"), path.with_suffix(".hdr"), path.with_suffix(".HDR")):
        if candidate != path and candidate.is_file():
            with candidate.open("rb") as file:
                if _begins_with_magic(file.read(MAGIC_BYTES)):
                    return candidate
    return None


def _data_of(header: Path) -> Path:
    """Return the data file of a header."""
    stem = header.name[: -len(header.suffix)] if header.suffix.lower() == ".hdr" else header.name
    names = [stem + case for suffix in DATA_SUFFIXES for case in dict.fromkeys((suffix, suffix.upper()))]
    found = [path for name in names if (path := header.with_name(name)) != header and path.is_file()]
    # Two names of one file on systems that ignore case.
    found = [path for i, path in enumerate(found) if not any(path.samefile(other) for other in found[:i])]
    if len(found) == 1:
        return found[0]
    if found:
        raise FormatError(
            f"has several data files, {', '.join(path.name for path in found)}; pass the data file instead"
        )
    hint = did_you_mean(stem + ".img", [path.name for path in header.parent.iterdir() if path != header])
    raise FormatError(
        f"has no data file: expected {stem!r} without extension or with one of {', '.join(DATA_SUFFIXES[1:])} in the same "
        f"directory{'; ' * bool(hint)}{hint}"
    )


def _integer(entries: dict[str, str], key: str, *, default: int | None = None, at_least: int = 0) -> int:
    text = entries.get(key, "" if default is None else str(default))
    if not re.fullmatch(r"[+-]?[0-9]{1,15}", text) or not at_least <= int(text) < MAX_SIZE:
        got = f"got {text!r:.20}" if text else "and is missing"
        raise FormatError(f"'{key}' must be an integer of at least {at_least}, {got}")
    return int(text)


def _band_numbers(entries: dict[str, str], key: str) -> list[float] | None:
    """Return a list with one number per band."""
    values, n_bands = _numbers(entries, key), _integer(entries, "bands", at_least=1)
    if values is not None and len(values) != n_bands:
        raise FormatError(f"'{key}' must have {n_bands} numbers, one per band, got {len(values)}")
    return values


def _number(entries: dict[str, str], key: str) -> float | None:
    values = _numbers(entries, key)
    if values is not None and len(values) != 1:
        raise FormatError(f"'{key}' must be one number, got {len(values)}")
    return None if values is None else values[0]


def _numbers(entries: dict[str, str], key: str) -> list[float] | None:
    """Return a number or a list in braces."""
    if key not in entries:
        return None
    parts = re.split(r"[,\s]+", entries[key].strip().strip("{}"))
    try:
        return [float(part) for part in parts if part]
    except ValueError:
        raise FormatError(f"'{key}' must be a list of numbers, got {entries[key]!r:.40}") from None


def _example(path: Path) -> Floats:
    """Write big-endian data by line, top row first."""
    radiance = example_radiance()
    radiance[:, ::-1].transpose(1, 0, 2).astype(">f4").tofile(path.with_suffix(".bil"))
    sizes = "bands = 2\nlines = 4\nsamples = 5\ninterleave = bil\ndata type = 4\nbyte order = 1\n"
    bands = f"wavelength = {{{EXAMPLE_NM[0]}, {EXAMPLE_NM[1]}}}\nwavelength units = nm\ndata units = {EXAMPLE_UNIT}\n"
    path.write_text(f"ENVI\n{bands}{sizes}", encoding="utf-8")
    return radiance


CUBE_FORMATS.register(
    "envi", FileFormat(title="ENVI", suffixes=(".hdr",), matches=is_envi, read=read_envi), example=_example
)

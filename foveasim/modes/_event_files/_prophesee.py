"""
Files of Prophesee's cameras: RAW with EVT 2.0, 2.1 or 3.0, and DAT.

Sources: the pages on file and encoding formats of the documentation of the Metavision SDK, https://docs.prophesee.ai. Times
are those of the clock of the camera; Metavision subtracts the first one by default.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._io.formats import FormatError
from foveasim.modes._event_files._recording import MAX_EVENTS, Recording, shape_of

#: Keys of headers that are read.
UNDERSTOOD = frozenset(("evt", "format", "geometry", "width", "height", "version", "endianness", "end"))
#: Keys that do not change events: names and numbers of cameras, programs and dates.
IRRELEVANT = frozenset((
    "date", "camera_integrator_name", "integrator_name", "plugin_integrator_name", "plugin_name", "plugin_version",
    "serial_number", "system_id", "subsystem_id", "system_version", "firmware_version", "generation", "sensor_generation",
    "sensor_name", "hal_version", "metavision_version", "machine", "acquisition_system", "label", "comment", "lens", "notes",
))  # fmt: skip
#: Free text of headers without a key, by its first word.
FREE_TEXT = frozenset(("data", "this"))
#: Words that are no events of light: changes of an external signal, and words of vendors with their continuation.
TRIGGERS, VENDOR = "external triggers", "words of vendors"
#: Longest header, and longest line.
MAX_HEADER_BYTES = 1 << 16
ENCODINGS = {"2.0": "EVT2", "2.1": "EVT21", "3.0": "EVT3"}
#: Type of the events of DAT files of version 2, with 8 bytes for each event; 0 is its older number.
DAT_TYPES, DAT_BYTES = (0x00, 0x0C), 8
DAT_VERSIONS = ("2",)
#: Times of DAT files have 32 bits.
DAT_LOOP_US = 1 << 32


class Header(NamedTuple):
    """Values of a header by key in lower case, and where the data begin."""

    values: dict[str, str]
    n_bytes: int


def read_header(path: Path, ignore: Collection[str]) -> Header:
    """Read the lines that begin with ``% ``; raise a FormatError for keys that are not known."""
    with path.open("rb") as file:
        head = file.read(MAX_HEADER_BYTES + 1)
    values: dict[str, str] = {}
    at = 0
    while head[at : at + 2] == b"% ":
        stop = head.find(b"\n", at)
        if stop < 0 or stop > MAX_HEADER_BYTES:
            raise FormatError(f"has a header of more than {MAX_HEADER_BYTES} bytes")
        line = head[at + 2 : stop].decode("ascii", "replace").strip()
        at = stop + 1
        key, _, value = line.partition(" ")
        key = key.lower()
        if key == "end":
            break
        if not key or key in FREE_TEXT:
            continue
        if key in UNDERSTOOD:
            values[key] = value.strip()
        elif key not in IRRELEVANT and key not in {name.lower() for name in ignore}:
            raise FormatError(
                f"has the header '{key:.40}', which is not known; pass ignore=('{key:.40}',) if it does not change the events"
            )
    return Header(values, at)


def read_raw(path: Path, ignore: Collection[str] = ()) -> Recording:
    """Read a RAW file."""
    header = read_header(path, ignore)
    encoding, options = _encoding(header.values)
    shape = _shape(header.values, options)
    n_bytes = {"EVT2": 4, "EVT21": 8, "EVT3": 2}[encoding]
    size = path.stat().st_size - header.n_bytes
    if size % n_bytes:
        raise FormatError(f"is truncated: {size:,} bytes of data are no multiple of the {n_bytes} bytes of a word")
    if encoding == "EVT3":
        words = np.fromfile(path, "<u2", offset=header.n_bytes)
        return _decoded(lambda *out: _kernel_module().decode_evt3(words, *out), words.size, 16, header.n_bytes, shape)
    halves = np.fromfile(path, "<u4", offset=header.n_bytes)
    valid = np.zeros(0, np.uint32)
    if encoding == "EVT21":
        # A 64-bit word begins with its lower half, the mask of pixels; older cameras send the upper half first.
        lower = 1 if options["endianness"] == "legacy" else 0
        halves, valid = np.ascontiguousarray(halves[1 - lower :: 2]), np.ascontiguousarray(halves[lower::2])
    return _decoded(
        lambda *out: _kernel_module().decode_evt2(halves, valid, *out), halves.size, 8 * n_bytes, header.n_bytes, shape
    )


def _kernel_module() -> Any:
    """Return the kernels, which are compiled when they are imported."""
    from foveasim.modes._event_files import _kernels

    return _kernels


def _decoded(
    decode: Callable[..., tuple[int, ...]], n_words: int, n_bits: int, offset: int, shape: tuple[int, int] | None
) -> Recording:
    """Decode words twice if there are more events than words."""
    capacity = n_words
    while True:
        arrays: list[NDArray[Any]] = [np.empty(capacity, kind) for kind in (np.int64, np.uint16, np.uint16, np.bool_)]
        n, n_before, n_triggers, n_vendor, bad, is_falling = decode(*arrays)
        if bad >= 0:
            position = offset + bad * n_bits // 8
            what = "a time that falls" if is_falling else "a word of an unknown type"
            raise FormatError(f"has {what} at byte {position:,}; it is damaged, or of another encoding")
        if n > MAX_EVENTS:
            raise FormatError(f"contains {n:,} events, more than the limit of {MAX_EVENTS:,}")
        if n <= capacity:
            break
        capacity = n
    skipped = {"events before the first time": n_before, TRIGGERS: n_triggers, VENDOR: n_vendor}
    t_us, x, y, is_on = (values[:n] for values in arrays)
    return Recording(t_us, x, y, is_on, shape, {name: count for name, count in skipped.items() if count})


def _encoding(values: dict[str, str]) -> tuple[str, dict[str, str]]:
    """Return the encoding, and the options of the key ``format`` such as height and width."""
    name, *parts = (part.strip() for part in values.get("format", "").split(";"))
    options = {}
    for part in filter(None, parts):
        key, equals, value = part.partition("=")
        key = key.strip().lower()
        if not equals or key not in ("height", "width", "endianness"):
            raise FormatError(f"has the option '{part:.40}' of its format, which is not known")
        options[key] = value.strip().lower()
    by_version = ENCODINGS.get(values.get("evt", ""))
    encoding = name.upper() or by_version or ""
    if encoding not in ENCODINGS.values():
        stated = name or (f"evt {values['evt']}" if "evt" in values else "no encoding")
        raise FormatError(f"states {stated:.40}, must be EVT2, EVT21 or EVT3; convert it with the Metavision SDK")
    if name and by_version and by_version != encoding:
        raise FormatError(f"states {name:.40} and evt {values['evt']:.40}, which are different encodings")
    endianness = options.setdefault("endianness", values.get("endianness", "").lower() or "little")
    known = ("little", "legacy") if encoding == "EVT21" else ("little",)
    if "endianness" not in values and encoding == "EVT21" and "endianness=" not in values.get("format", "").lower():
        raise FormatError("must state the endianness of EVT 2.1, as in '% format EVT21;endianness=legacy'")
    if endianness not in known:
        raise FormatError(f"states the endianness {endianness:.40}, must be {' or '.join(known)} for {encoding}")
    return encoding, options


def _shape(values: dict[str, str], options: dict[str, str]) -> tuple[int, int] | None:
    """Return the shape of the sensor that a header states, in three ways."""
    found: set[tuple[str, str]] = set()
    if "width" in options or "height" in options:
        found.add((options.get("width", ""), options.get("height", "")))
    if "geometry" in values:
        match = re.fullmatch(r"(\d{1,6})\s*[xX]\s*(\d{1,6})", values["geometry"])
        found.add((match[1], match[2]) if match else (values["geometry"], ""))
    if "width" in values or "height" in values:
        found.add((values.get("width", ""), values.get("height", "")))
    shapes = set()
    for pair in found:
        if not all(re.fullmatch(r"\d{1,6}", number) for number in pair):
            raise FormatError(f"states the size {' x '.join(pair):.40}, must be two numbers")
        shapes.add(shape_of(int(pair[0]), int(pair[1])))
    if len(shapes) > 1:
        raise FormatError("states different sizes of the sensor: " + ", ".join(f"{w} x {h}" for h, w in sorted(shapes)))
    return shapes.pop() if shapes else None


def read_dat(path: Path, ignore: Collection[str] = ()) -> Recording:
    """Read a DAT file of CD events."""
    header = read_header(path, ignore)
    if header.values.get("version", "2") not in DAT_VERSIONS:
        raise FormatError(f"is a DAT file of version {header.values['version']:.40}, must be 2")
    for key in ("evt", "format", "endianness"):
        if key in header.values:
            raise FormatError(f"has the header '{key}' of RAW files; it must end in .raw")
    with path.open("rb") as file:
        file.seek(header.n_bytes)
        about = file.read(2)
    if len(about) < 2 or about[0] not in DAT_TYPES or about[1] != DAT_BYTES:
        raise FormatError(f"must contain CD events of {DAT_BYTES} bytes (type 12), got {list(about)} as type and size")
    size = path.stat().st_size - header.n_bytes - 2
    if size % DAT_BYTES:
        raise FormatError(f"is truncated: {size:,} bytes of data are no multiple of the {DAT_BYTES} bytes of an event")
    records = np.fromfile(path, "<u4", offset=header.n_bytes + 2).reshape(-1, 2)
    t_us, address = records[:, 0].astype(np.int64), records[:, 1]
    loops = np.cumsum(np.diff(t_us, prepend=t_us[:1]) < -DAT_LOOP_US // 2)
    polarity = address >> 28
    if polarity.size and polarity.max() > 1:
        raise FormatError(
            f"has the polarity {int(polarity.max())}, must be 0 or 1; it is damaged, or of another version"
        )
    x, y = _addresses(address), _addresses(address >> 14)
    return Recording(t_us + DAT_LOOP_US * loops, x, y, polarity == 1, _shape(header.values, {}))


def _addresses(values: NDArray[Any]) -> NDArray[np.uint16]:
    return (values & 0x3FFF).astype(np.uint16)

"""
AEDAT files of iniVation's cameras, jAER and v2e.

AEDAT 2 are the addresses of jAER: x counts from the right, and y from the bottom of the picture; v2e writes the same.
AEDAT 4 is read with the package aedat.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._io.formats import FormatError
from foveasim._io.sandbox import read_in_sandbox
from foveasim.modes._event_files._recording import MAX_EVENTS, Recording, shape_of

#: Longest header of AEDAT 2.
MAX_HEADER_BYTES = 1 << 20
#: Records of AEDAT 2: address and time in µs, big-endian.
RECORD = np.dtype([("address", ">u4"), ("t", ">u4")])
#: Largest compression ratio of LZ4 and Zstandard that is accepted, and size of decompressed data.
MAX_DECOMPRESSION_RATIO, MAX_DECOMPRESSED_BYTES = 1024, 8 * 2**30
#: Streams of AEDAT 4 that are no events of light.
IRRELEVANT_STREAMS = ("frame", "imus", "triggers")
SAMPLES, SPECIAL = "samples of frames and of the inertial sensor", "special events"


class Addresses(NamedTuple):
    """Shift and number of bits of y and x, and bits of polarity, special events and samples."""

    y: tuple[int, int]
    x: tuple[int, int]
    on: int
    special: int | None
    sample: int | None


DAVIS = Addresses(y=(22, 9), x=(12, 10), on=11, special=10, sample=31)
#: Addresses by the shape of the sensor, (n_row, n_column).
ADDRESSES = {
    (260, 346): DAVIS,
    (180, 240): DAVIS,
    (480, 640): Addresses(y=(11, 10), x=(1, 10), on=0, special=None, sample=None),
}
#: Shapes by the class of the chip in jAER, without the package, in lower case.
CHIPS = {
    r"davis346.*": (260, 346),
    r"davis240.*|sbret10": (180, 240),
    r"dvs640": (480, 640),
}


def read_aedat2(path: Path, shape: tuple[int, int] | None = None) -> Recording:
    """
    Read an AEDAT 2 file of a DAVIS 240, DAVIS 346 or DVS 640.

    ``shape``: rows and columns of the sensor, for files that do not name the chip, such as those of v2e.
    """
    with path.open("rb") as file:
        head = file.read(MAX_HEADER_BYTES)
    at, chip = 0, ""
    while head[at : at + 1] == b"#":
        stop = head.find(b"\n", at)
        if stop < 0:
            raise FormatError(f"has a header of more than {MAX_HEADER_BYTES} bytes")
        line = head[at:stop].decode("utf-8", "replace").strip()
        if at == 0 and line != "#!AER-DAT2.0":
            raise FormatError(f"is of the version {line.removeprefix('#!'):.40}, must be AER-DAT2.0 or AER-DAT4.0")
        found = re.search(r"AEChip:\s*(?:class\s+)?([\w.$]+)", line)
        chip = found[1].rpartition(".")[2] if found else chip
        at = stop + 1
    if chip:
        stated = next((s for pattern, s in CHIPS.items() if re.fullmatch(pattern, chip.lower())), None)
        if stated is None:
            raise FormatError(
                f"is of the chip {chip:.40}, whose addresses are not known; must be DAVIS240, DAVIS346 or DVS640"
            )
        shape = stated
    if shape not in ADDRESSES:
        sizes = ", ".join(f"{w} x {h}" for h, w in ADDRESSES)
        got = f", got {shape[1]} x {shape[0]}" if shape else "; pass a layout of its size"
        raise FormatError(f"does not name its chip, and must be of a sensor of {sizes} pixels{got}")
    size = path.stat().st_size - at
    if size % RECORD.itemsize:
        raise FormatError(
            f"is truncated: {size:,} bytes of data are no multiple of the {RECORD.itemsize} bytes of an event"
        )
    if size // RECORD.itemsize > MAX_EVENTS:
        raise FormatError(f"contains more than the limit of {MAX_EVENTS:,} events")
    records = np.fromfile(path, RECORD, offset=at)
    address, form = records["address"].astype(np.uint32), ADDRESSES[shape]
    is_sample, is_special = (
        np.zeros(address.size, bool) if bit is None else (address >> bit & 1).astype(bool)
        for bit in (form.sample, form.special)
    )
    is_event = ~(is_sample | is_special)
    address, t_us = address[is_event], records["t"][is_event].astype(np.int64)
    loops = np.cumsum(np.diff(t_us, prepend=t_us[:1]) < -(1 << 31))
    x, y = (shape[1] - 1 - _bits(address, form.x), shape[0] - 1 - _bits(address, form.y))
    skipped = {SAMPLES: int(is_sample.sum()), SPECIAL: int((is_special & ~is_sample).sum())}
    skipped = {name: count for name, count in skipped.items() if count}
    return Recording(t_us + (loops << 32), x, y, (address >> form.on & 1).astype(bool), shape, skipped)


def _bits(address: NDArray[np.uint32], place: tuple[int, int]) -> NDArray[np.int32]:
    shift, n_bits = place
    return (address >> shift & ((1 << n_bits) - 1)).astype(np.int32)


def read_aedat4(path: Path) -> Recording:
    """Read the events of an AEDAT 4 file in the sandbox process."""
    import_optional(path, "aedat")
    about, (t_us, x, y, is_on) = read_in_sandbox(
        _read_aedat4, path, kind="AEDAT 4", max_decompressed_bytes=_max_decompressed_bytes
    )
    return Recording(t_us, x, y, is_on, shape_of(about["width"], about["height"]))


def _max_decompressed_bytes(n_bytes: int) -> int:
    return min(MAX_DECOMPRESSION_RATIO * n_bytes + (1 << 26), MAX_DECOMPRESSED_BYTES)


def _read_aedat4(file_name: str) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Read the arrays of the only stream of events."""
    import aedat  # type: ignore[import-not-found, unused-ignore]

    decoder = aedat.Decoder(file_name)
    streams = decoder.id_to_stream()
    found = [(k, stream) for k, stream in streams.items() if stream["type"] == "events"]
    unknown = {str(stream["type"]) for stream in streams.values()} - {"events", *IRRELEVANT_STREAMS}
    if unknown:
        raise FormatError(f"contains streams of the unknown types {', '.join(sorted(unknown)):.80}")
    if len(found) != 1:
        raise FormatError(f"must contain one stream of events, got {len(found)}")
    k, stream = found[0]
    packets = [packet["events"] for packet in decoder if packet["stream_id"] == k]
    if sum(part.size for part in packets) > MAX_EVENTS:
        raise FormatError(f"contains more than the limit of {MAX_EVENTS:,} events")
    kinds = {"t": np.int64, "x": np.uint16, "y": np.uint16, "on": np.bool_}
    arrays = [
        np.concatenate([np.zeros(0, kind), *(part[name].astype(kind) for part in packets)])
        for name, kind in kinds.items()
    ]
    return {"width": int(stream["width"]), "height": int(stream["height"])}, arrays

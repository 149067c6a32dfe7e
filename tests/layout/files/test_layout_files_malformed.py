"""Malformed layout files: each gives a layout or a one-line error, within 10 s of processor time and 2 GiB of memory."""

from __future__ import annotations

import io
import json
import select
import struct
import subprocess
import sys
import zipfile
import zlib

import numpy as np
import pytest
import shapely
from waiting import DEADLINE_S

from foveasim.layout import Layout
from foveasim.layout.files import write_layout

gdstk = pytest.importorskip("gdstk")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

MAX_S = 10.0
MAX_BYTES = 2 * 2**30
#: Permitted exceptions of reading.
ERRORS = {"ConfigError", "FileError", "GeometryError", "ParameterError"}
READ = """
import json, resource, sys
from foveasim.config import read_any_layout
from foveasim.errors import FoveasimError
import foveasim.layout.files._kernels

def busy_s():
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))

for line in sys.stdin:
    open("/proc/self/clear_refs", "w").write("5")  # resets VmHWM
    began_s = busy_s()
    try:
        answer = ["Layout", str(read_any_layout(line.rstrip("\\n")).layout.n_sites)]
    except FoveasimError as error:
        answer = [type(error).__name__, str(error)]
    except BaseException as error:
        answer = ["!" + type(error).__name__, str(error)]
    own_s = busy_s() - began_s
    # ru_maxrss of RUSAGE_SELF includes the memory of the parent process.
    own = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM")) * 1024
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    print(json.dumps([*answer, own_s, own, children]), flush=True)
"""


class Reader:
    """
    A process that reads files one after the other; if a file terminates it, another one reads the following files.

    Each answer contains: kind, message, processor time in seconds, peak memory of the process while it read the file, and
    that of its largest child so far, in bytes. The kind of a file that terminates the process is ``!ended``.
    """

    def __init__(self):
        self.process = None

    def __call__(self, paths):
        return [self.read(path) for path in paths]

    def read(self, path):
        if self.process is None:
            self.process = subprocess.Popen(
                [sys.executable, "-c", READ], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        self.process.stdin.write(f"{path}\n")
        self.process.stdin.flush()
        has_answer = select.select([self.process.stdout], [], [], DEADLINE_S)[0]
        answer = self.process.stdout.readline() if has_answer else ""
        if answer:
            return json.loads(answer)
        return [f"!ended with {self.end()}", "", 0.0, 0, 0]

    def end(self):
        """Terminate the process; return its exit code."""
        process, self.process = self.process, None
        if process is not None:
            process.kill()
            process.communicate()
        return None if process is None else process.returncode


@pytest.fixture(scope="module")
def read():
    reader = Reader()
    yield reader
    reader.end()


def assert_harmless(answer, kinds):
    kind, message, busy_s, own_bytes, child_bytes = answer
    assert kind in kinds, answer
    assert message.isprintable(), answer
    assert len(message) < 700
    assert busy_s < MAX_S, answer
    assert own_bytes + child_bytes < MAX_BYTES, answer


# -- GDSII ------------------------------------------------------------------------------------------------------------


def gds_real(value):
    """Return an 8-byte GDSII real: sign, exponent to base 16, 56 bits of mantissa."""
    exponent = 64
    while value and abs(value) >= 1.0:
        value, exponent = value / 16, exponent + 1
    while value and abs(value) < 1 / 16:
        value, exponent = value * 16, exponent - 1
    return struct.pack(">Q", (value < 0) << 63 | exponent << 56 | round(abs(value) * 2**56))


def record(kind, data_type, payload=b""):
    return struct.pack(">HBB", 4 + len(payload), kind, data_type) + payload


def text_record(kind, text):
    return record(kind, 6, text + b"\0" * (len(text) % 2))


def gds(*cells, dbu_m=1e-10):
    """Return a GDSII file of cells given as (name, elements)."""
    now = struct.pack(">12h", *[1] * 12)
    data = record(0x00, 2, b"\x02\x58") + record(0x01, 2, now) + text_record(0x02, b"LIB")
    data += record(0x03, 5, gds_real(dbu_m * 1e6) + gds_real(dbu_m))
    for name, elements in cells:
        data += record(0x05, 2, now) + text_record(0x06, name) + elements + record(0x07, 0)
    return data + record(0x04, 0)


def gds_shape(*xy, properties=()):
    shape = record(0x08, 0) + record(0x0D, 2, b"\0\1") + record(0x0E, 2, b"\0\0")
    shape += record(0x10, 3, struct.pack(f">{len(xy)}i", *xy))
    for attribute, text in properties:
        shape += record(0x2B, 2, struct.pack(">h", attribute)) + text_record(0x2C, text)
    return shape + record(0x11, 0)


SQUARE = gds_shape(0, 0, 10000, 0, 10000, 10000, 0, 10000, 0, 0)


def gds_reference(name, n_columns=None, n_rows=None, *, magnification=None, angle=None, step=20000, x=0, properties=()):
    """Return a reference to a cell, or an array of references."""
    is_array = n_columns is not None
    element = record(0x0B if is_array else 0x0A, 0) + text_record(0x12, name)
    if magnification is not None or angle is not None:
        element += record(0x1A, 1, b"\0\0")
        element += record(0x1B, 5, magnification) if magnification is not None else b""
        element += record(0x1C, 5, angle) if angle is not None else b""
    xy = (x, 0)
    if is_array:
        element += record(0x13, 2, struct.pack(">hh", n_columns, n_rows))
        limit = 2**31 - 1
        xy = (x, 0, min(step * abs(n_columns), limit), 0, 0, min(step * abs(n_rows), limit))
    element += record(0x10, 3, struct.pack(f">{len(xy)}i", *xy))
    for attribute, text in properties:
        element += record(0x2B, 2, struct.pack(">h", attribute)) + text_record(0x2C, text)
    return element + record(0x11, 0)


def numbered_array(text, columns=b"a=0+1i", n_columns=30, n_rows=20):
    """Return a file with an array of numbered photosites."""
    site = gds_shape(0, 0, 10000, 0, 10000, 10000, 0, 10000, 0, 0, properties=[(1, b"photosite 0")])
    properties = [(1, text), (2, columns)]
    return gds((b"C", site), (b"TOP", gds_reference(b"C", n_columns, n_rows, properties=properties)))


def gds_path(width, end, n=2):
    xy = [v for i in range(n) for v in (i * 1000, (i % 2) * 1000)]
    path = record(0x09, 0) + record(0x0D, 2, b"\0\1") + record(0x0E, 2, b"\0\0")
    path += record(0x21, 2, struct.pack(">h", end)) + record(0x0F, 3, struct.pack(">i", width))
    return path + record(0x10, 3, struct.pack(f">{len(xy)}i", *xy)) + record(0x11, 0)


def nested(n_levels, n_each, base=SQUARE):
    """Return nested cells, each with ``n_each`` references to the previous one."""
    cells = [(b"C0", base)]
    for i in range(1, n_levels + 1):
        inner = b"C%d" % (i - 1)
        cells.append((b"C%d" % i, b"".join(gds_reference(inner, x=20000 * k) for k in range(n_each))))
    return gds(*cells)


def columns(text):
    return [(1, b"photosite 0"), (2, text)]


GDS_BOMBS = {
    "numbered array of 32767 x 32767": lambda: numbered_array(
        b"photosites 0+1i+32767j of 32767x32767", n_columns=32767, n_rows=32767
    ),
    "numbers beyond 64 bits": lambda: numbered_array(b"photosites 999999999+999999999i+999999999j of 30x20"),
    "array of equal numbers": lambda: numbered_array(b"photosites 7 of 30x20"),
    "array of negative numbers": lambda: numbered_array(b"photosites 0-1i of 30x20"),
    "array of another size": lambda: numbered_array(b"photosites 0+1i+30j of 30x999999999"),
    "array columns beyond 64 bits": lambda: numbered_array(
        b"photosites 0+1i+30j of 30x20", b"a=0+9223372036854775807i+9j"
    ),
    "array columns of 800 digits": lambda: numbered_array(b"photosites 0+1i+30j of 30x20", b"a=0+" + b"9" * 800 + b"i"),
    "array with a channel beyond 64 bits": lambda: numbered_array(
        b"photosites 0+1i+30j of 30x20", b"channel=0+9223372036854775807i"
    ),
    "arrays of a site in two parts": lambda: gds(
        (b"C", gds_shape(0, 0, 9, 0, 9, 9, 0, 0, properties=[(1, b"photosite 0 part 1 of 2")]) * 2),
        (b"TOP", gds_reference(b"C", 3, 3, properties=[(1, b"photosites 0+1i+3j of 3x3")])),
    ),
    "8000 references with the same number": lambda: gds(
        (b"C", gds_shape(0, 0, 10000, 0, 10000, 10000, 0, 10000, 0, 0, properties=[(1, b"photosite 0")])),
        (b"TOP", gds_reference(b"C", properties=[(1, b"photosite 5"), (2, b"a=1")]) * 8000),
    ),
    "array of 32767 x 32767": lambda: gds((b"C", SQUARE), (b"TOP", gds_reference(b"C", 32767, 32767))),
    "10 levels of 10": lambda: nested(10, 10),
    "60 levels of 2": lambda: nested(60, 2),
    "arrays of arrays of empty cells": lambda: gds(
        (b"C", b""),
        (b"D", gds_reference(b"C", 32767, 32767)),
        (b"TOP", gds_reference(b"D", 32767, 32767)),
    ),
    "array of 7000 x 7000": lambda: gds((b"C", SQUARE), (b"TOP", gds_reference(b"C", 7000, 7000, step=11000))),
    "array of 0 x -1": lambda: gds((b"C", SQUARE), (b"TOP", gds_reference(b"C", 0, -1))),
    "array of -32768 x -32768": lambda: gds((b"C", SQUARE), (b"TOP", gds_reference(b"C", -32768, -32768))),
    "chain of 1000 cells with 8000 squares": lambda: gds(
        (b"C0", SQUARE * 8000),
        *((b"C%d" % i, gds_reference(b"C%d" % (i - 1))) for i in range(1, 1000)),
    ),
    "5000 cells in a chain": lambda: gds(
        (b"C0", SQUARE), *((b"C%d" % i, gds_reference(b"C%d" % (i - 1))) for i in range(1, 5000))
    ),
    "5000 top cells": lambda: gds(*((b"C%d" % i, SQUARE) for i in range(5000))),
    "round paths, wide": lambda: gds((b"C", gds_path(2**31 - 1, 1) * 20_000)),
    "array of round paths": lambda: gds((b"C", gds_path(2**31 - 1, 1)), (b"TOP", gds_reference(b"C", 3000, 3000))),
    "path of zero width": lambda: gds((b"C", gds_path(0, 0))),
    "path of 8000 spikes": lambda: gds((b"C", gds_path(2**30, 1, 8000))),
    "magnified to infinity": lambda: gds(
        (b"C", SQUARE), (b"TOP", gds_reference(b"C", magnification=b"\x7f" + b"\xff" * 7))
    ),
    "rotated by a huge angle": lambda: gds((b"C", SQUARE), (b"TOP", gds_reference(b"C", angle=b"\x7f" + b"\xff" * 7))),
    "magnified by zero": lambda: gds((b"C", SQUARE), (b"TOP", gds_reference(b"C", magnification=bytes(8)))),
    "database unit of zero": lambda: gds((b"C", SQUARE), dbu_m=0.0),
    "database unit of a light year": lambda: gds((b"C", SQUARE), dbu_m=1e16),
    "cell names with line breaks": lambda: gds((b"A\n\x1b[31m\xff", SQUARE), (b"B\r\n", SQUARE)),
    "shape of two vertices": lambda: gds((b"C", gds_shape(0, 0, 5, 5, 0, 0))),
    "shape without vertices": lambda: gds((b"C", gds_shape())),
    "shapes of four billion vertices": lambda: gds(
        (b"C", gds_shape(*range(16_000)) * 50), (b"TOP", gds_reference(b"C", 100, 100))
    ),
    "outline of 8000 random vertices": lambda: gds(
        (b"C", gds_shape(*np.random.default_rng(1).integers(-(10**6), 10**6, 16_000).tolist()))
    ),
    "outline that oscillates along a line": lambda: gds(
        (b"C", gds_shape(*[v for i in range(4000) for v in ((i % 2) * 10**6 - i, (i % 5) * 10)]))
    ),
    "collinear outline": lambda: gds((b"C", gds_shape(*[v for i in range(8000) for v in (i * 7919 % 8009, 0)]))),
    "1000 overlapping parts of a site": lambda: gds(
        (
            b"C",
            b"".join(
                gds_shape(
                    0, 0, 10**6, i, 10**6 - i, 10**6, 0, 0, properties=[(1, b"photosite 0 part %d of 1000" % (i + 1))]
                )
                for i in range(1000)
            ),
        )
    ),
    "missing parts of a site": lambda: gds(
        (b"C", gds_shape(0, 0, 9, 0, 9, 9, 0, 0, properties=[(1, b"photosite 0 part 1 of 999999999")]))
    ),
    "same part twice": lambda: gds(
        (b"C", gds_shape(0, 0, 9, 0, 9, 9, 0, 0, properties=[(1, b"photosite 0 part 1 of 2")]) * 2)
    ),
    "properties of 60000 bytes": lambda: gds(
        (b"C", gds_shape(0, 0, 9999, 0, 9999, 9999, 0, 0, properties=columns(b"a" * 60_000)) * 300)
    ),
    "columns of very many digits": lambda: gds(
        (b"C", gds_shape(0, 0, 9999, 0, 9999, 9999, 0, 0, properties=columns(b"a=" + b"9" * 900)) * 300)
    ),
    "columns of a thousand names": lambda: gds(
        (b"C", gds_shape(0, 0, 9999, 0, 9999, 9999, 0, 0, properties=columns(b"a=1 b= " * 140)) * 2000)
    ),
    "columns of different names for each shape": lambda: gds(
        (
            b"C",
            b"".join(
                gds_shape(0, 0, 9999, 0, 9999, 9999, 0, 0, properties=columns(b"a%d=1" % i)) for i in range(20_000)
            ),
        )
    ),
    "long strings in an array": lambda: gds(
        (b"C", gds_shape(0, 0, 9999, 0, 9999, 9999, 0, 0, properties=columns(b'a="' + b"a" * 900 + b'"'))),
        (b"TOP", gds_reference(b"C", 400, 400)),
    ),
    "columns with Python code": lambda: gds(
        (b"C", gds_shape(0, 0, 9999, 0, 9999, 9999, 0, 0, properties=columns(b"a=__import__('os').abort()")))
    ),
}


# -- OASIS ------------------------------------------------------------------------------------------------------------


def number(value):
    """Return an OASIS unsigned integer: 7 bits per byte, least significant first."""
    data = bytearray()
    while value >= 128:
        data.append(value & 127 | 128)
        value >>= 7
    return bytes([*data, value])


def string(text):
    return number(len(text)) + text


def oasis(content, scheme=0):
    """Return an OASIS file: START record, a cell with the content, and an END record of 256 bytes."""
    data = b"%SEMI-OASIS\r\n" + b"\x01" + string(b"1.0") + b"\x00" + number(10_000) + b"\x00" + bytes(12)
    data += b"\x0e" + string(b"C") + content
    return data + b"\x02" + number(252) + bytes(252) + bytes([scheme])


def packed(content, n_bytes=None):
    """Return a compressed block with a declared decompressed size."""
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
    data = deflate.compress(content) + deflate.flush()
    return b"\x22\x00" + number(len(content) if n_bytes is None else n_bytes) + number(len(data)) + data


def packed_zeros(n_bytes):
    """Return a compressed block of very many empty records."""
    deflate, piece = zlib.compressobj(9, zlib.DEFLATED, -15), bytes(2**20)
    data = b"".join(deflate.compress(piece) for _ in range(n_bytes // 2**20)) + deflate.flush()
    return b"\x22\x00" + number(n_bytes) + number(len(data)) + data


def oasis_rectangle(repetition=b""):
    """Return a square on layer 1, optionally repeated."""
    side = number(20_000)
    return bytes([20, 0b01111011 | (0b100 if repetition else 0)]) + b"\x01\x00" + 2 * side + b"\x00\x00" + repetition


def repeated(n_columns, n_rows):
    return b"\x01" + number(n_columns - 2) + number(n_rows - 2) + b"\x10\x10"


def oasis_polygon(n_claimed, data=b""):
    return bytes([21, 0b00111011]) + b"\x01\x00" + b"\x04" + number(n_claimed) + data + b"\x00\x00"


def spike(i):
    """Return step i of an outline of spikes from a common point."""
    up = 100 * (i // 3)
    x, y = ((50_000, up), (0, 50), (-50_000, -up - 50))[i % 3]
    return number(abs(x) << 2 | (x < 0) << 1 | 1) + number(abs(y) << 1 | (y < 0))


def oasis_numbered(numbers, repetition):
    """Return a cell with a numbered array of squares."""
    words = [b"\x08" + number(n) for n in numbers]
    placement = bytes([17, 0b10111000]) + string(b"D") + b"\x00\x00" + repetition
    return placement + oasis_property(words, b"photosites") + b"\x0e" + string(b"D") + oasis_rectangle()


def oasis_property(values, name=b"columns"):
    """Return a property with its name and values."""
    head = bytes([28, 0b00000100 | (min(len(values), 15) << 4)]) + string(name)
    return head + (number(len(values)) if len(values) >= 15 else b"") + b"".join(values)


OASIS_BOMBS = {
    "numbered array beyond 64 bits": lambda: oasis(oasis_numbered([2**63 - 1, 2**63 - 1, 0, 2, 2], repeated(10, 10))),
    "numbered array of a string": lambda: oasis(oasis_numbered([0, 1, 10], repeated(10, 10))),
    "numbered array of a million times a million": lambda: oasis(
        oasis_numbered([0, 1, 10**6, 10**6, 10**6], repeated(10**6, 10**6))
    ),
    "a million times a million": lambda: oasis(oasis_rectangle(repeated(10**6, 10**6))),
    "2^32 x 2^32, beyond 64 bits": lambda: oasis(oasis_rectangle(repeated(2**32, 2**32))),
    "2^63 x 4, beyond 64 bits": lambda: oasis(oasis_rectangle(repeated(2**63 + 2, 4))),
    "2^33 x (2^31 + 1)": lambda: oasis(oasis_rectangle(repeated(2**33, 2**31 + 1))),
    "list of 2^40 positions": lambda: oasis(oasis_rectangle(b"\x0a" + number(2**40) + b"\x10\x10")),
    "list of 2^26 positions in a row": lambda: oasis(oasis_rectangle(b"\x04" + number(2**26) + b"\x10\x10")),
    "polygon of 2^60 vertices": lambda: oasis(oasis_polygon(2**60)),
    "polygon of a billion vertices": lambda: oasis(oasis_polygon(10**9)),
    "polygon of 2^26 vertices": lambda: oasis(oasis_polygon(2**26)),
    "name of 2^40 bytes": lambda: oasis(b"\x0e" + number(2**40) + b"C"),
    "name of 2^30 bytes": lambda: oasis(b"\x0e" + number(2**30) + b"C"),
    "integer of a million bytes": lambda: oasis(b"\x0e" + b"\xff" * 10**6),
    "block that declares 2^40 bytes": lambda: oasis(packed(oasis_rectangle(), 2**40)),
    "block that declares 2^30 bytes": lambda: oasis(packed(oasis_rectangle(), 2**30)),
    "block that declares 3 bytes": lambda: oasis(packed(oasis_rectangle() * 1000, 3)),
    "block of 30 million empty records": lambda: oasis(packed_zeros(30 * 2**20)),
    "block in a block": lambda: oasis(packed(packed(packed(oasis_rectangle() * 1000)))),
    "block of five million squares": lambda: oasis(packed(oasis_rectangle() * (5 * 10**6))),
    "block of a property repeated a million times": lambda: oasis(
        packed(oasis_rectangle() + oasis_property([b"\x08\x01"] * 10**4) + (oasis_rectangle() + b"\x1d") * 10**6)
    ),
    "a million properties of a square": lambda: oasis(
        packed(oasis_rectangle() + oasis_property([b"\x08\x01"]) + b"\x1d" * 10**6)
    ),
    "columns of long words on 6000 squares": lambda: oasis(
        packed((oasis_rectangle() + oasis_property([b"\x0a" + string(b"a" * 500)] * 8)) * 6000)
    ),
    "circle of 2^50": lambda: oasis(bytes([27, 0b00111011]) + b"\x01\x00" + number(2**50) + b"\x00\x00"),
    "trapezoid of type 255": lambda: oasis(bytes([26, 0b11111011]) + b"\x01\x00\xff\x08\x08\x00\x00"),
    "cell that contains itself": lambda: oasis(bytes([17, 0b10110000]) + string(b"C") + b"\x00\x00"),
    "cell number 2^60": lambda: oasis(oasis_rectangle() + b"\x0d" + number(2**60) + oasis_rectangle()),
    "outline to a point and back 20000 times": lambda: oasis(
        oasis_polygon(59_999, b"".join(map(spike, range(59_999))))
    ),
    "unknown record": lambda: oasis(oasis_rectangle() + b"\x7f" + oasis_rectangle()),
    "unknown checksum": lambda: oasis(oasis_rectangle(), scheme=77),
}


# -- npz --------------------------------------------------------------------------------------------------------------

ABOUT = json.dumps({"format": "foveasim layout", "version": 1, "unit": "um", "provenance": {}})


def npy(descr, shape, data):
    """Return an npy file with an arbitrary header."""
    head = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + data


def zipped(items, compression=zipfile.ZIP_STORED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, data in items.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def npz(compression=zipfile.ZIP_STORED, **changes):
    """Return an npz layout of one triangle, with some arrays replaced."""
    arrays = {
        "about": npy(f"'<U{len(ABOUT)}'", (), ABOUT.encode("utf-32-le")),
        "xy_um": npy("'<f8'", (3, 2), np.array([[0.0, 0], [1, 0], [0, 1]]).tobytes()),
        "ring_offsets": npy("'<i8'", (2,), struct.pack("<2q", 0, 3)),
        "site_offsets": npy("'<i8'", (2,), struct.pack("<2q", 0, 1)),
    }
    return zipped({f"{name}.npy": data for name, data in {**arrays, **changes}.items()}, compression)


def pickled_array():
    buffer = io.BytesIO()
    np.save(buffer, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return buffer.getvalue()


def with_wrong_sizes(data):
    """Return an archive that declares much larger arrays than it contains."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        sizes = [item.file_size for item in archive.infolist() if item.filename == "xy_um.npy"]
    return data.replace(struct.pack("<I", sizes[0]), struct.pack("<I", 2**32 - 2))


NPZ_BOMBS = {
    "a billion points declared": lambda: npz(xy_um=npy("'<f8'", (10**9, 2), bytes(48))),
    "100 MB of zeros": lambda: npz(zipfile.ZIP_DEFLATED, xy_um=npy("'<f8'", (6_250_000, 2), bytes(100_000_000))),
    "50 MB of zeros": lambda: npz(zipfile.ZIP_DEFLATED, xy_um=npy("'<f8'", (3_000_000, 2), bytes(48_000_000))),
    "a million zeros as offsets": lambda: npz(
        zipfile.ZIP_DEFLATED, ring_offsets=npy("'<i8'", (10**6,), bytes(8 * 10**6))
    ),
    "pickled objects": lambda: npz(column_evil=pickled_array()),
    "pickled objects as vertices": lambda: npz(xy_um=pickled_array()),
    "10^18 elements of zero bytes": lambda: npz(column_a=npy("'|V0'", (10**18,), b"")),
    "10^15 empty strings": lambda: npz(column_a=npy("'<U0'", (10**15,), b"")),
    "rows of a billion": lambda: npz(column_a=npy("('<f8', (1000000000,))", (0,), b"")),
    "empty array of shape 2^62 x 2^62": lambda: npz(column_a=npy("'<f8'", (2**62, 2**62, 0), b"")),
    "negative shape": lambda: npz(xy_um=npy("'<f8'", (-3, -2), bytes(48))),
    "shape of 60 dimensions": lambda: npz(column_a=npy("'<f8'", (1,) * 60, bytes(8))),
    "header with Python code": lambda: npz(column_a=npy("__import__('os').abort()", (1,), bytes(8))),
    "header of nested brackets": lambda: npz(column_a=npy("(" * 3000 + ")" * 3000, (1,), bytes(8))),
    "header of many fields": lambda: npz(
        column_a=npy([(f"f{i}", "<f8") for i in range(400)], (1,), bytes(3200)),
    ),
    "deeply nested provenance": lambda: npz(about=npy("'<U100000'", (), ("[" * 100_000).encode("utf-32-le"))),
    "archive with wrong sizes": lambda: with_wrong_sizes(npz()),
    "archive of 20000 names": lambda: zipped({f"column_{i}.npy": b"" for i in range(20_000)}),
    "array with unknown name": lambda: npz(columm_a=npy("'<i8'", (1,), bytes(8))),
    "long column name with line breaks": lambda: npz(
        **{"column_\n\x1b[31m" + "a" * 60_000: npy("'<i8'", (2,), bytes(16))}
    ),
    "archive compressed with lzma": lambda: npz(zipfile.ZIP_LZMA, xy_um=npy("'<f8'", (300_000, 2), bytes(4_800_000))),
    "timestamps out of range": lambda: npz(column_a=npy("'<M8[as]'", (1,), b"\xff" * 8)),
}


# -- GeoJSON ----------------------------------------------------------------------------------------------------------

RING = "[[0,0],[9,0],[9,9],[0,0]]"


def collection(*features, **members):
    members = {"foveasim": origin(), **members}  # which states the unit
    text = "".join(f', "{name}": {value}' for name, value in members.items())
    return f'{{"type": "FeatureCollection", "features": [{",".join(features)}]{text}}}'.encode()


def feature(coordinates=f"[{RING}]", properties="{}"):
    return (
        f'{{"type": "Feature", "properties": {properties}, "geometry": '
        f'{{"type": "Polygon", "coordinates": {coordinates}}}}}'
    )


def origin(**columns):
    about = {"format": "foveasim layout", "version": 1, "unit": "um", "provenance": {}, "columns": columns}
    return json.dumps(about)


def fan(n):
    """Return a square whose triangular holes all have a corner in its centre: a valid polygon."""
    angle = np.arange(2 * n + 1) * np.pi / n
    x, y = 50 * np.cos(angle), 50 * np.sin(angle)
    holes = [f"[[0,0],[{x[i + 1]},{y[i + 1]}],[{x[i]},{y[i]}],[0,0]]" for i in range(0, 2 * n, 2)]
    return f"[[[-100,-100],[100,-100],[100,100],[-100,100],[-100,-100]],{','.join(holes)}]"


def diagonals(n):
    """Return a square with adjacent long holes whose bounding boxes all overlap: a valid polygon."""
    holes = [f"[[{i / 100},0],[{i / 100 + 900},900],[{i / 100 + 900.001},900],[{i / 100},0]]" for i in range(n)]
    return f"[[[-10,-10],[5000,-10],[5000,5000],[-10,5000],[-10,-10]],{','.join(holes)}]"


GEOJSON_BOMBS = {
    "coordinates nested 100000 deep": lambda: collection(feature("[" * 100_000 + "]" * 100_000)),
    "properties nested 100000 deep": lambda: collection(feature(properties='{"a":' * 100_000 + "1" + "}" * 100_000)),
    "300000 positions": lambda: collection(feature("[[" + "[0,0]," * (3 * 10**5) + "[0,0]]]")),
    "30000 identical rings": lambda: collection(feature("[" + f"{RING}," * 30_000 + f"{RING}]")),
    "5000 holes that meet in a point": lambda: collection(feature(fan(5000))),
    "5000 holes along a diagonal": lambda: collection(feature(diagonals(5000))),
    "outline to a point and back 20000 times": lambda: collection(
        feature("[[" + "".join(f"[0,0],[50,{i}],[50,{i}.5]," for i in range(20_000)) + "[0,0]]]")
    ),
    "a different property for each of 20000": lambda: collection(
        *(feature(properties=f'{{"a{i}": 1}}') for i in range(20_000))
    ),
    "200 properties of 8000 features": lambda: collection(
        feature(properties=json.dumps({f"a{i}": 1 for i in range(200)})), *[feature()] * 8000
    ),
    "100000 declared columns": lambda: collection(
        *[feature()] * 1000, foveasim=origin(**{f"a{i}": "<i8" for i in range(10**5)})
    ),
    "one long string among 1000": lambda: collection(
        feature(properties=json.dumps({"a": "x" * 10**6})), *[feature(properties='{"a": "y"}')] * 1000
    ),
    "strings declared to be long": lambda: collection(
        *[feature(properties='{"a": "y"}')] * 20, foveasim=origin(a="<U99999999")
    ),
    "column declared with a huge type": lambda: collection(
        *[feature(properties='{"a": 1}')] * 10, foveasim=origin(a="V999999999")
    ),
    "numbers of 4000 digits": lambda: collection(*[feature(properties=f'{{"a": {"9" * 4000}}}')] * 300),
    "positions of 4000 digits": lambda: collection(feature(f"[[[0,0],[{'9' * 4000},0],[9,9],[0,0]]]")),
    "exponent of a billion": lambda: collection(feature("[[[0,0],[1e1000000000,0],[9,9],[0,0]]]")),
    "bytes that are not UTF-8": lambda: collection(feature()) + b"\xff\xfe",
    "UTF-16": lambda: collection(feature()).decode().encode("utf-16"),
    "unterminated string": lambda: b'{"type": "FeatureCollection", "features": [], "a": "' + b"\\" * 10**6,
    "200000 members": lambda: b"{" + b",".join(b'"a%d": 0' % i for i in range(200_000)) + b"}",
    "10 MB of blanks": lambda: b"{" + b" " * 10**7,
    "geometry type with line breaks": lambda: collection(feature().replace("Polygon", "Poly\\n\\u001b[31mgon")),
    "unpaired surrogates": lambda: collection(feature(properties='{"\\ud800": "\\udfff"}')),
}


# -- GeoParquet -------------------------------------------------------------------------------------------------------

GEO = json.dumps({"primary_column": "geometry", "columns": {"geometry": {"encoding": "WKB"}}})
TRIANGLE = shapely.to_wkb(shapely.Polygon([(0, 0), (9, 0), (9, 9)]), byte_order=1)


def parquet(*tables, geo=GEO, about=None, **options):
    """Return a Parquet file with geometry metadata, without the Arrow schema."""
    about = origin() if about is None else about
    buffer = io.BytesIO()
    with pq.ParquetWriter(buffer, tables[0].schema, store_schema=False, compression="zstd", **options) as writer:
        for table in tables:
            writer.write_table(table)
        writer.add_key_value_metadata({"geo": geo, "foveasim": about})
    return buffer.getvalue()


def outlines(*wkb, **others):
    return pa.table({"geometry": pa.array(wkb, pa.binary()), **others})


def same(value, n_rows):
    """Return a dictionary column that repeats one value in a few bytes."""
    return pa.DictionaryArray.from_arrays(pa.array(np.zeros(n_rows, np.int32)), pa.array([value]))


def varint(value):
    """Return a Thrift zigzag integer; -0.5 encodes -1."""
    return number(int(abs(2 * value)))


def declared(n_rows):
    """Return a table of 777 rows with another declared number of rows."""
    data = parquet(outlines(*[TRIANGLE] * 777))
    length = int.from_bytes(data[-8:-4], "little")
    footer = data[-8 - length : -8].replace(b"\x16" + varint(777), b"\x16" + varint(n_rows))
    return data[: -8 - length] + footer + struct.pack("<I", len(footer)) + b"PAR1"


def nested_wkb(n, kind):
    return struct.pack("<BII", 1, kind, 1) * n + TRIANGLE


PARQUET_BOMBS = {
    "a billion rows declared": lambda: declared(10**9),
    "40 million rows declared": lambda: declared(4 * 10**7),
    "negative number of rows declared": lambda: declared(-0.5),
    "40 million rows of one outline": lambda: parquet(*[pa.table({"geometry": same(TRIANGLE, 10**6)})] * 40),
    "outline of 1 MiB, repeated 4000 times": lambda: parquet(
        pa.table({"geometry": same(bytes(2**20), 4000)}), dictionary_pagesize_limit=2**24
    ),
    "string of 4 MiB, repeated 5000 times": lambda: parquet(
        outlines(*[TRIANGLE] * 5000, a=same("x" * 2**22, 5000)), dictionary_pagesize_limit=2**24
    ),
    "one long string among 10000": lambda: parquet(
        outlines(*[TRIANGLE] * 10_000, a=pa.array(["x" * 10**6] + ["y"] * 9999)), use_dictionary=False
    ),
    "75 MB of zeros": lambda: parquet(outlines(bytes(75_000_000)), use_dictionary=False, write_statistics=False),
    "multipolygons in multipolygons, 100000 deep": lambda: parquet(outlines(nested_wkb(100_000, 6))),
    "collections in collections, 100000 deep": lambda: parquet(outlines(nested_wkb(100_000, 7))),
    "collections in a multipolygon": lambda: parquet(
        outlines(struct.pack("<BII", 1, 6, 1) + nested_wkb(100_000, 7)),
    ),
    "collections behind a polygon": lambda: parquet(
        outlines(struct.pack("<BII", 1, 6, 2) + TRIANGLE + nested_wkb(100_000, 7)),
    ),
    "curved polygons, 100000 deep": lambda: parquet(outlines(nested_wkb(100_000, 10))),
    "outline of 2^32 rings": lambda: parquet(outlines(struct.pack("<BII", 1, 3, 2**32 - 1) + bytes(100))),
    "outline of 2^32 vertices": lambda: parquet(outlines(struct.pack("<BIII", 1, 3, 1, 2**32 - 1) + bytes(100))),
    "empty outline": lambda: parquet(outlines(b"")),
    "null outline": lambda: parquet(outlines(None)),
    "deeply nested metadata": lambda: parquet(outlines(TRIANGLE), geo="[" * 100_000),
    "metadata of another type": lambda: parquet(outlines(TRIANGLE), geo="[]"),
    "invalid column types": lambda: parquet(
        outlines(TRIANGLE, a=pa.array([1])), about=origin(a="<U999999999", geometry="<f8")
    ),
    "nested lists": lambda: parquet(outlines(TRIANGLE, a=pa.array([[[[[[[1] * 1000]]]]]]))),
    "3000 columns": lambda: parquet(outlines(TRIANGLE, **{f"a{i}": pa.array([i]) for i in range(3000)})),
    "footer of the wrong length": lambda: parquet(outlines(TRIANGLE))[:-8] + b"\xff\xff\xff\x7fPAR1",
}


# -- YAML -------------------------------------------------------------------------------------------------------------


def yaml_layout(parameters, generator="grid"):
    return f"generator: {generator}\nparameters: {{{parameters}}}\n".encode()


YAML_BOMBS = {
    "Python object": lambda: b"!!python/object/apply:os._exit [3]\n",
    "Python object as a value": lambda: yaml_layout("n_x: !!python/object/apply:os._exit [3], n_y: 3, pitch_um: 2.0"),
    "Python name": lambda: b"generator: !!python/name:os.system\n",
    "unknown tag": lambda: b"generator: !evil grid\n",
    "a billion laughs": lambda: (
        b"a: &a [x, x, x, x, x, x, x, x, x]\n"
        + b"".join(b"%c: &%c [%s]\n" % (c, c, b", ".join([b"*%c" % (c - 1)] * 9)) for c in range(98, 110))
    ),
    "list that contains itself": lambda: b"a: &a [*a]\n",
    "merge key": lambda: b"a: &a {b: 1}\nc: {<<: *a}\n",
    "a billion columns": lambda: yaml_layout("n_x: 1000000000, n_y: 2, pitch_um: 0.001"),
    "a billion columns and rows": lambda: yaml_layout("n_x: 1000000000, n_y: 1000000000, pitch_um: 2.0"),
    "columns of 4000 digits": lambda: yaml_layout(f"n_x: {'9' * 4000}, n_y: 2, pitch_um: 2.0"),
    "columns of 900000 digits": lambda: yaml_layout(f"n_x: {'9' * 900_000}, n_y: 2, pitch_um: 2.0"),
    "a pitch of 1e-300": lambda: yaml_layout("n_x: 10, n_y: 2, pitch_um: 1e-300"),
    "a pitch of infinity": lambda: yaml_layout("n_x: 10, n_y: 2, pitch_um: .inf"),
    "a billion sectors": lambda: yaml_layout("r_min_um: 1.0, r_max_um: 100.0, n_sectors: 1000000000", "log_polar"),
    "rings of rings of rings": lambda: yaml_layout(
        "r_min_um: 1e-3, r_max_um: 1e7, n_sectors: 3, ring_ratio: 1.0000001", "log_polar"
    ),
    "a billion seeds": lambda: yaml_layout("n_sites: 1000000000, spacing_um: 1.0", "sunflower"),
    "very many rhombs": lambda: yaml_layout("side_um: 1e-3, size_um: [1e6, 1e6]", "penrose"),
    "coordinate of infinity": lambda: yaml_layout(
        "n_sites: 10, region: 'POLYGON ((0 0, 1e999 0, 1 1, 0 0))'", "voronoi"
    ),
    "a billion vertices declared": lambda: yaml_layout("n_sites: 10, region: [[0, 0], [1e9, 0], [0, 1e9]]", "voronoi"),
    "lists nested 100000 deep": lambda: b"[" * 100_000,
    "mappings nested 20000 deep": lambda: b"{a: " * 20_000,
    "blocks nested 100000 deep": lambda: b"- " * 100_000,
    "blocks nested by indentation": lambda: b"".join(b" " * i + b"a:\n" for i in range(1000)),
    "a file of 2 MB": lambda: b"#" * (2 * 2**20),
    "bytes that are not UTF-8": lambda: b"\xff\xfe\x00",
    "control characters": lambda: b"generator: \x00\x1b[31m\n",
    "duplicate key": lambda: b"generator: grid\ngenerator: grid\n",
    "list as a key": lambda: b"? [1, 2]\n: 3\n",
    "two documents": lambda: b"a: 1\n---\nb: 2\n",
    "30000 numbers": lambda: b"- 1\n" * 30_000,
}


# -- reading ----------------------------------------------------------------------------------------------------------

BOMBS = {
    "gds": GDS_BOMBS,
    "oas": OASIS_BOMBS,
    "npz": NPZ_BOMBS,
    "geojson": GEOJSON_BOMBS,
    "parquet": PARQUET_BOMBS,
    "yaml": YAML_BOMBS,
}


@pytest.fixture(scope="module")
def answers(read, tmp_path_factory):
    """Answers of reading by format and name; the files of a format are read on first access."""
    directory, known = tmp_path_factory.mktemp("bombs"), {}

    def answer(extension, name):
        if extension not in known:
            paths = [directory / f"{i}.{extension}" for i in range(len(BOMBS[extension]))]
            for path, make in zip(paths, BOMBS[extension].values(), strict=True):
                path.write_bytes(make())
            known[extension] = dict(zip(BOMBS[extension], read(paths), strict=True))
        return known[extension][name]

    return answer


#: Files that are read as a layout.
HARMLESS = {
    "gds": {
        "round paths, wide",
        "path of 8000 spikes",
        "arrays of arrays of empty cells",
        "numbers beyond 64 bits",
        "array of equal numbers",
        "array of negative numbers",
        "array of another size",
        "array columns beyond 64 bits",
        "array columns of 800 digits",
        "array with a channel beyond 64 bits",
        "8000 references with the same number",
        "chain of 1000 cells with 8000 squares",
        "5000 cells in a chain",
        "rotated by a huge angle",
        "magnified by zero",
        "properties of 60000 bytes",
        "columns of very many digits",
        "columns of a thousand names",
        "columns of different names for each shape",
        "long strings in an array",
        "columns with Python code",
    },
    "oas": {
        "numbered array beyond 64 bits",
        "numbered array of a string",
        "block of 30 million empty records",
        "a million properties of a square",
        "columns of long words on 6000 squares",
        "unknown checksum",
    },
    "npz": {"header of many fields", "timestamps out of range"},
    "geojson": {
        "a different property for each of 20000",
        "200 properties of 8000 features",
        "100000 declared columns",
        "one long string among 1000",
        "strings declared to be long",
        "column declared with a huge type",
        "numbers of 4000 digits",
        "unpaired surrogates",
    },
    "parquet": {"one long string among 10000", "invalid column types", "nested lists", "3000 columns"},
    "yaml": set(),
}


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("extension", "name"), [(extension, name) for extension, bombs in BOMBS.items() for name in bombs]
)
def test_malformed_file_raises_unless_harmless(answers, extension, name):
    assert_harmless(answers(extension, name), {"Layout"} if name in HARMLESS[extension] else ERRORS)


@pytest.fixture(scope="module")
def valid_files(tmp_path_factory):
    """A valid file of each format: nine sites with holes, and columns of every type that all formats support."""
    centre_um = np.stack(np.divmod(np.arange(9), 3), 1) * 5.0
    layout = Layout.from_polygons(
        [shapely.Point(c).buffer(2.0, 3) - shapely.Point(c).buffer(0.5, 1) for c in centre_um],
        channel=np.arange(9) % 3,
        ring=np.arange(9),
        gain=np.arange(9) / 7,
        is_dead=np.arange(9) % 2 == 0,
        name=np.array([f"s{i}" for i in range(9)]),
    )
    directory = tmp_path_factory.mktemp("valid")
    for extension in FORMATS:
        assert write_layout(layout, directory / f"a.{extension}").dropped_columns == ()
    return {extension: (directory / f"a.{extension}").read_bytes().rstrip(b"\n") for extension in FORMATS}


FORMATS = ("gds", "oas", "npz", "geojson", "parquet")
#: First bytes of a file of each format.
HEADS = {
    "gds": b"\x00\x06\x00\x02\x02\x58",
    "oas": b"%SEMI-OASIS\r\n\x01\x031.0",
    "npz": b"PK\x03\x04",
    "geojson": b'{"type": "FeatureCollection", "features": [',
    "parquet": b"PAR1",
}


def truncated(data, n):
    """Return a file truncated at regular positions, and just before its end."""
    return [data[: len(data) * i // n] for i in range(n)] + [data[:-i] for i in (1, 2, 3, 4, 8, 16)]


def flipped(data, rng, n, extension, first=0):
    """Return copies of a file with one to three bits flipped behind ``first``; OASIS with a valid checksum."""
    files = []
    for i in range(n):
        corrupt = bytearray(data)
        for at in rng.integers(first, len(data), 1 + i % 3):
            corrupt[at] ^= 1 << rng.integers(8)
        files.append(
            bytes(corrupt[:-4]) + struct.pack("<I", zlib.crc32(corrupt[:-4])) if extension == "oas" else bytes(corrupt)
        )
    return files


def noise(rng, n, extension):
    """Return random bytes, with and without the first bytes of the format."""
    sizes = rng.integers(1, 5000, n)
    return [HEADS[extension] * (i % 2) + rng.bytes(size) for i, size in enumerate(sizes)]


def numbered(directory, files, extension):
    paths = [directory / f"{i}.{extension}" for i in range(len(files))]
    for path, data in zip(paths, files, strict=True):
        path.write_bytes(data)
    return paths


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("extension", FORMATS)
def test_truncated_files_and_noise_are_rejected(read, valid_files, tmp_path, extension):
    files = truncated(valid_files[extension], 14) + noise(np.random.default_rng(21), 10, extension)

    for answer in read(numbered(tmp_path, files, extension)):
        assert_harmless(answer, ERRORS)


@pytest.mark.slow
@pytest.mark.parametrize("extension", FORMATS)
def test_flipped_bits_raise_or_give_layout(read, valid_files, tmp_path, extension):
    files = flipped(valid_files[extension], np.random.default_rng(22), 15, extension)

    for answer in read(numbered(tmp_path, files, extension)):
        assert_harmless(answer, ERRORS | {"Layout"})


@pytest.mark.slow
@pytest.mark.parametrize("extension", ["npz", "parquet"])
def test_flipped_directory_bits_raise_or_give_layout(read, valid_files, tmp_path, extension):
    data = valid_files[extension]
    files = flipped(data, np.random.default_rng(23), 60, extension, first=max(0, len(data) - 3000))

    for answer in read(numbered(tmp_path, files, extension)):
        assert_harmless(answer, ERRORS | {"Layout"})

"""ICC profiles written by hand (ICC.1:2001-04), for tests."""

from __future__ import annotations

import itertools
import struct

import numpy as np

D50 = (0.9642, 1.0, 0.8249)


def xyz_tag(values):
    return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(value * 65536) for value in values))


def curve_tag(gamma):
    return b"curv\0\0\0\0" + struct.pack(">IH", 1, round(gamma * 256))


def text_tag(text):
    name = text.encode() + b"\0"
    return b"desc\0\0\0\0" + struct.pack(">I", len(name)) + name + bytes(78)


def profile(space, device, tags, connection=b"XYZ "):
    """Return a profile of version 2 with tags by signature."""
    tags = {b"desc": text_tag("by hand"), b"cprt": b"text\0\0\0\0none\0", b"wtpt": xyz_tag(D50), **tags}
    offset, table, body = 132 + 12 * len(tags), b"", b""
    for signature, content in tags.items():
        padded = content + bytes(-len(content) % 4)
        table += struct.pack(">4sII", signature, offset + len(body), len(content))
        body += padded
    size = offset + len(body)
    header = struct.pack(">I4sI4s4s4s", size, b"\0\0\0\0", 0x02400000, device, space, connection)
    header += (
        struct.pack(">6H4s", 2026, 1, 1, 0, 0, 0, b"acsp")
        + bytes(28)
        + struct.pack(">3i", *(round(v * 65536) for v in D50))
    )
    return header.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body


def rgb_profile(colorants, gamma):
    """Return a matrix profile; ``colorants`` (3, 3): XYZ of red, green and blue relative to D50."""
    return profile(
        b"RGB ",
        b"mntr",
        {
            **{key: xyz_tag(row) for key, row in zip((b"rXYZ", b"gXYZ", b"bXYZ"), colorants, strict=True)},
            **dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve_tag(gamma)),
        },
    )


def grey_profile(gamma):
    return profile(b"GRAY", b"mntr", {b"kTRC": curve_tag(gamma)})


def cmyk_profile(lab_of):
    """Return a profile with a table of the 16 corners of CMYK; ``lab_of``: function of c, m, y, k (0 or 1)."""
    codes = []
    for inks in itertools.product((0, 1), repeat=4):
        lightness, a, b = lab_of(*inks)
        codes += [lightness * 652.8, (a + 128.0) * 256.0, (b + 128.0) * 256.0]
    identity = np.eye(3).ravel()
    table = b"mft2\0\0\0\0" + bytes([4, 3, 2, 0]) + struct.pack(">9i", *(round(v * 65536) for v in identity))
    table += struct.pack(">2H", 2, 2) + struct.pack(">2H", 0, 65535) * 4
    table += struct.pack(f">{len(codes)}H", *(round(code) for code in codes)) + struct.pack(">2H", 0, 65535) * 3
    return profile(b"CMYK", b"prtr", {b"A2B0": table}, connection=b"Lab ")

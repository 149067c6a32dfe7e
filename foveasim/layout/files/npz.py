"""
Layouts as numpy arrays in one npz file: exact, with provenance and columns of any type.

Pickled objects are never loaded.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from foveasim._core.rings import ring_moments
from foveasim._io.formats import FileFormat, as_file_error
from foveasim._io.npz import read_archive, write_archive
from foveasim.errors import FileError
from foveasim.layout.files._common import (
    FORMATS,
    WrittenLayout,
    check_header,
    check_site_count,
    header,
    lossless_report,
    max_decompressed_bytes,
)
from foveasim.layout.model import Layout
from foveasim.layout.packed import is_layout_array, layout_from_arrays, layout_to_arrays

__all__ = ["MAGICS", "read", "write"]

#: Signatures of a zip archive and of an empty one.
MAGICS = (b"PK\x03\x04", b"PK\x05\x06")


def write(layout: Layout, path: Path) -> WrittenLayout:
    """
    Write all arrays, columns and the provenance.

    Raises FileError when the file cannot be written.
    """
    write_archive(path, header(layout), layout_to_arrays(layout), is_compressed=False)
    return lossless_report(layout, path)


def read(path: Path) -> Layout:
    """
    Read a file that :func:`write` wrote.

    Raises FileError when the file is corrupt, too large, or not a layout.
    """
    with as_file_error(path, "npz layout"):
        about, arrays = read_archive(path, max_bytes=max_decompressed_bytes(path))
        if about is None:
            raise FileError(path, "is not a foveasim layout")
        provenance = check_header(path, about)
        unknown = [name for name in arrays if not is_layout_array(name)]
        if unknown:
            raise FileError(path, f"is corrupt: {unknown[0]!r:.40} is not an array of a layout")
        check_site_count(path, arrays["site_offsets"].size - 1)
        layout = layout_from_arrays(arrays, provenance)
        _check_winding(path, layout)
        return layout


def _check_winding(path: Path, layout: Layout) -> None:
    """
    Check that outlines are counter-clockwise and holes clockwise.

    The constructor of Layout does not check the winding order.
    """
    is_outline = np.zeros(layout.ring_offsets.size - 1, bool)
    is_outline[layout.site_offsets[:-1]] = True
    with np.errstate(all="ignore"):
        area_um2 = ring_moments(layout.xy_um, layout.ring_offsets)[0]
    is_right = np.where(is_outline, area_um2 > 0.0, area_um2 < 0.0)
    if not is_right.all():
        ring = int(np.flatnonzero(~is_right)[0])
        site = int(np.searchsorted(layout.site_offsets, ring, side="right")) - 1
        raise FileError(path, f"is corrupt: a ring of site {site} is wound the wrong way, or has no area")


FORMATS.register("npz", FileFormat(title="npz", suffixes=(".npz",), signatures=MAGICS, read=read, write=write))

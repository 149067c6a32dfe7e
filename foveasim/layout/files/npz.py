"""
Layouts as numpy arrays in one npz file: exact, with provenance and columns of any type.

Pickled objects are never loaded.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from foveasim._io.formats import FileFormat, as_file_error
from foveasim._io.npz import read_archive, write_archive
from foveasim.errors import FileError
from foveasim.layout.files._common import (
    FORMATS,
    WrittenLayout,
    check_header,
    check_site_count,
    header,
    max_decompressed_bytes,
)
from foveasim.layout.model import Layout, winding_um2
from foveasim.layout.packed import is_layout_array, layout_from_arrays, layout_to_arrays

__all__ = ["MAGICS", "read", "write"]

#: Signatures of a zip archive and of an empty one.
MAGICS = (b"PK\x03\x04", b"PK\x05\x06")


def write(layout: Layout, path: Path) -> WrittenLayout:
    """Write all arrays, columns and the provenance."""
    write_archive(path, header(layout), layout_to_arrays(layout), is_compressed=False)
    return WrittenLayout(path=path, n_sites=layout.n_sites)


def read(path: Path) -> Layout:
    """Read a file that :func:`write` wrote."""
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
    with np.errstate(all="ignore"):
        is_wrong = ~(winding_um2(*layout.rings_um) > 0.0)
    if is_wrong.any():
        ring = int(np.argmax(is_wrong))
        site = int(np.searchsorted(layout.site_offsets, ring, side="right")) - 1
        raise FileError(path, f"is corrupt: a ring of site {site} is wound the wrong way, or has no area")


FORMATS.register("npz", FileFormat(title="npz", suffixes=(".npz",), signatures=MAGICS, read=read, write=write))

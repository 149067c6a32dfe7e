"""Layouts as numpy arrays in one file: exact, columns of any type and the origin included. Nothing is ever unpickled."""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from foveasim.arrays import MAX_SITES
from foveasim.errors import FileError
from foveasim.files import written_whole
from foveasim.layout._model import Layout
from foveasim.layout.files._common import (
    WrittenLayout,
    check_header,
    check_sites_of,
    check_unpacked,
    header,
    lossless,
    one_sentence,
)
from foveasim.rings import ring_moments

__all__ = ["MAGICS", "read", "write"]

#: A zip archive, and an empty one.
MAGICS = (b"PK\x03\x04", b"PK\x05\x06")
ARRAYS = ("xy_um", "ring_offsets", "site_offsets")
#: How a column is named among the arrays.
COLUMN_PREFIX = "column_"
SUFFIX = ".npy"


def write(layout: Layout, path: Path) -> WrittenLayout:
    """
    Write all arrays, columns and the origin.

    Raises
    ------
    FileError
        When nothing can be written there.
    """
    arrays: dict[str, Any] = {name: getattr(layout, name) for name in ARRAYS}
    arrays |= {COLUMN_PREFIX + name: values for name, values in layout.columns.items()}
    with written_whole(path) as temporary, temporary.open("wb") as file:
        np.savez(file, about=np.array(json.dumps(header(layout))), **arrays)
    return lossless(layout, path)


def read(path: Path) -> Layout:
    """
    Read a file that :func:`write` wrote.

    Raises
    ------
    FileError
        When it is broken, too large, or something else.
    """
    with one_sentence(path, "npz"), zipfile.ZipFile(path) as archive:
        items = {item.filename.removesuffix(SUFFIX): item for item in archive.infolist()}
        check_unpacked(path, sum(item.file_size for item in items.values()))
        if not {item.compress_type for item in items.values()} <= {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise FileError(path, "is packed in a way that numpy does not use")
        if "about" not in items:
            raise FileError(path, "is no foveasim layout")
        provenance = check_header(path, json.loads(str(_array(archive, items["about"]))))
        unknown = [n for n in items if n not in {"about", *ARRAYS} and not n.startswith(COLUMN_PREFIX)]
        if unknown:
            raise FileError(path, f"is broken: {unknown[0]!r:.40} is no array of a layout")
        xy_um, ring_offsets, site_offsets = (_array(archive, items[name]) for name in ARRAYS)
        check_sites_of(path, site_offsets.size - 1)
        columns = {
            name.removeprefix(COLUMN_PREFIX): _array(archive, item)
            for name, item in items.items()
            if name.startswith(COLUMN_PREFIX)
        }
        layout = Layout(xy_um, ring_offsets, site_offsets, columns, provenance)
        _check_winding(path, layout)
        return layout


def _array(archive: zipfile.ZipFile, item: zipfile.ZipInfo) -> NDArray[Any]:
    """One array, after its header was found to fit what follows it: no array is made larger than the file says."""
    with archive.open(item) as file:
        version = npy.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"array format {version}")
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, is_fortran, dtype = read_header(file)
        if dtype.hasobject:
            raise ValueError("an array of objects")
        # What takes no room may be there any number of times.
        n = math.prod(shape)
        if n * dtype.itemsize != item.file_size - file.tell() or not 0 <= n <= max(item.file_size, MAX_SITES):
            raise ValueError("an array of another size than its header tells")
        flat = np.frombuffer(file.read(), dtype) if dtype.itemsize else np.zeros(n, dtype)
    return flat.reshape(shape, order="F" if is_fortran else "C")


def _check_winding(path: Path, layout: Layout) -> None:
    """Outlines go counter-clockwise, holes clockwise, as a layout's plain constructor takes for granted."""
    is_outline = np.zeros(layout.ring_offsets.size - 1, bool)
    is_outline[layout.site_offsets[:-1]] = True
    with np.errstate(all="ignore"):
        area_um2 = ring_moments(layout.xy_um, layout.ring_offsets)[0]
    is_right = np.where(is_outline, area_um2 > 0.0, area_um2 < 0.0)
    if not is_right.all():
        ring = int(np.flatnonzero(~is_right)[0])
        site = int(np.searchsorted(layout.site_offsets, ring, side="right")) - 1
        raise FileError(path, f"holds no photosites: a ring of site {site} is wound the wrong way, or has no area")

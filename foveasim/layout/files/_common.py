"""What all layout formats share: limits, checks of files from strangers, and the report of a written file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.provenance import to_plain_data
from foveasim._core.rings import site_area_um2
from foveasim._core.validation import MAX_SITES, Floats
from foveasim.errors import FileError, GeometryError, ParameterError
from foveasim.layout.model import Layout

__all__ = [
    "WrittenLayout",
    "check_header",
    "check_sites_of",
    "check_sizes",
    "check_unpacked",
    "checked_layout",
    "header",
    "lossless",
    "max_unpacked",
    "restored_column",
    "rounding",
    "texts",
]

#: Written in every file that keeps columns and origin.
FILE_FORMAT = "foveasim layout"
FILE_VERSION = 1
MAX_UNPACKED_BYTES = 8 * 2**30
#: What a small file may unpack to, and for each byte of a larger one: regular grids, packed, unpack to 30 bytes a byte.
MIN_UNPACKED_BYTES, UNPACKED_PER_BYTE = 2**26, 128
#: A column of text takes the room of its longest in every row: what that may come to, and for each letter there is.
MIN_TEXT_BYTES, TEXT_BYTES_PER_LETTER = 2**28, 64
#: Rings and edges of a site are looked at in pairs where they may meet: pairs of either in all sites, and for each there is.
MAX_RING_PAIRS, PAIRS_PER_RING = 2_000_000, 100
MAX_VERTEX_PAIRS, PAIRS_PER_VERTEX = 1_000_000_000, 1000
#: Kinds of numpy types that text formats keep: truth values, integers, floating-point numbers, text.
PLAIN_KINDS = "biufU"


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenLayout:
    """
    What became of a layout in a file.

    Attributes
    ----------
    path : Path
        The file.
    n_sites : int
        Photosites in it.
    max_displacement_um : float, µm
        How far rounding moved the vertex that it moved furthest.
    worst_area_error : float
        Change of a site's area by rounding, relative to its area, of the site with the largest.
    dropped_columns : tuple of str
        Names of the columns that the file does not hold, sorted.
    """

    path: Path
    n_sites: int
    max_displacement_um: float
    worst_area_error: float
    dropped_columns: tuple[str, ...]


def lossless(layout: Layout, path: Path, dropped_columns: tuple[str, ...] = ()) -> WrittenLayout:
    """Report of a format that keeps every digit."""
    return WrittenLayout(
        path=path,
        n_sites=layout.n_sites,
        max_displacement_um=0.0,
        worst_area_error=0.0,
        dropped_columns=dropped_columns,
    )


def rounding(layout: Layout, rounded_um: Floats, path: Path, dropped_columns: tuple[str, ...] = ()) -> WrittenLayout:
    """Report of a format that holds these vertices instead of the layout's, and not these columns."""
    if layout.n_sites == 0:
        return lossless(layout, path, dropped_columns)
    move_um = np.hypot(*(rounded_um - layout.xy_um).T)
    area_um2 = layout.area_um2
    error = site_area_um2(rounded_um, layout.ring_offsets, layout.site_offsets) / area_um2 - 1.0
    return WrittenLayout(
        path=path,
        n_sites=layout.n_sites,
        max_displacement_um=float(move_um.max()),
        worst_area_error=float(np.abs(error).max()),
        dropped_columns=dropped_columns,
    )


def max_unpacked(path: Path) -> int:
    """Bytes that a file of its size may unpack to."""
    return min(MIN_UNPACKED_BYTES + UNPACKED_PER_BYTE * path.stat().st_size, MAX_UNPACKED_BYTES)


def check_unpacked(path: Path, n_bytes: int) -> None:
    """
    Reject a file that would unpack to too much.

    Raises
    ------
    FileError
        When it was made to fill the memory.
    """
    if n_bytes > max_unpacked(path):
        raise FileError(path, f"would unpack to more than {max_unpacked(path)} bytes")


def check_sites_of(path: Path, n_sites: int) -> None:
    """
    Reject a file with too many sites.

    Raises
    ------
    FileError
        When there are more than any sensor has.
    """
    if n_sites > MAX_SITES:
        raise FileError(path, f"has {n_sites} sites, more than the {MAX_SITES} that are read")


def check_sizes(n_rings: NDArray[Any], n_vertices: NDArray[Any]) -> None:
    """
    Reject sites of so many rings or vertices that it would take minutes to see whether any two of them meet.

    Raises
    ------
    GeometryError
        When there are more than photosites have.
    """
    for what, n, at_most, more in (
        ("rings", n_rings, MAX_RING_PAIRS, PAIRS_PER_RING),
        ("vertices", n_vertices, MAX_VERTEX_PAIRS, PAIRS_PER_VERTEX),
    ):
        if np.sum(n.astype(np.float64) ** 2) > at_most + more * n.sum():
            site = int(np.argmax(n))
            raise GeometryError(f"site {site} has {n[site]} {what}, more than photosites have", (site,))


def checked_layout(
    polygons: NDArray[Any] | tuple[NDArray[Any], NDArray[Any], NDArray[Any]],
    columns: Mapping[str, NDArray[Any]],
    provenance: Mapping[str, Any],
) -> Layout:
    """
    Layout of outlines from a stranger, all checks of :meth:`Layout.from_polygons` passed.

    Raises
    ------
    GeometryError, ParameterError
        When outlines are no photosites, or a column does not fit.
    """
    if isinstance(polygons, tuple):
        _, ring_offsets, site_offsets = polygons
        check_sizes(np.diff(site_offsets), np.diff(ring_offsets[site_offsets]))
    else:
        check_sizes(shapely.get_num_interior_rings(polygons) + 1, shapely.get_num_coordinates(polygons))
    bare = Layout.from_polygons(polygons)
    return Layout._derived(bare.xy_um, bare.ring_offsets, bare.site_offsets, columns, provenance)  # noqa: SLF001


# -- origin and types of columns, as text in the file -----------------------------------------------------------------


def header(layout: Layout) -> dict[str, Any]:
    """Plain data that stands beside the outlines in a file: format, unit, origin."""
    provenance = to_plain_data(dict(layout.provenance))
    return {"format": FILE_FORMAT, "version": FILE_VERSION, "unit": "um", "provenance": provenance}


def check_header(path: Path, about: Any) -> dict[str, Any]:
    """
    The origin that a file tells.

    Raises
    ------
    FileError
        When the file is of another format or version, or tells no origin.
    """
    if not isinstance(about, dict) or about.get("format") != FILE_FORMAT:
        got = about.get("format") if isinstance(about, dict) else None
        hint = "; load it with Capture.load, whose .layout it holds" if got == "foveasim capture" else ""
        raise FileError(path, f"is no {FILE_FORMAT}{hint}")
    if about.get("version") != FILE_VERSION:
        raise FileError(path, f"has the format version {about.get('version')!r:.40}, expected {FILE_VERSION}")
    provenance = about.get("provenance")
    if not isinstance(provenance, dict) or about.get("unit") != "um":
        raise FileError(path, "does not tell its origin and unit (µm) as this format asks")
    return provenance


def plain_columns(layout: Layout, format_name: str) -> dict[str, NDArray[Any]]:
    """
    The columns, when a format for numbers and text can hold them.

    Raises
    ------
    ParameterError
        When a column holds something else.
    """
    for name, column in layout.columns.items():
        if column.dtype.kind not in PLAIN_KINDS or (column.dtype.itemsize > 8 and column.dtype.kind == "f"):
            raise ParameterError(
                name, f"of the type {column.dtype} cannot be kept in {format_name}", hint="write a .npz file"
            )
    return dict(layout.columns)


def dtype_text(layout: Layout) -> dict[str, str]:
    """Type of each column as text, such as ``<i8``."""
    return {name: column.dtype.str for name, column in layout.columns.items()}


def restored_column(values: NDArray[Any], dtype: object) -> NDArray[Any]:
    """A column in the type that the file names, where that is a plain one and holds the same values."""
    if not isinstance(dtype, str) or len(dtype) > 16 or dtype[1:2] not in PLAIN_KINDS:
        return values
    try:
        if np.dtype(dtype).itemsize * values.size > max(2 * values.nbytes, MIN_TEXT_BYTES):
            return values
        with np.errstate(all="ignore"):
            restored = values.astype(np.dtype(dtype))
            again = restored.astype(values.dtype)
    except (TypeError, ValueError, OverflowError):
        return values
    is_floating = values.dtype.kind == "f"
    is_same = np.array_equal(restored, values, equal_nan=is_floating and restored.dtype.kind == "f")
    # An integer equals its neighbours where both are compared as floating-point numbers: so there and back again.
    return restored if is_same and np.array_equal(again, values, equal_nan=is_floating) else values


def texts(values: Sequence[str]) -> NDArray[Any] | None:
    """A column of text; nothing where one text is so long that the column would fill the memory."""
    n_letters = list(map(len, values))
    n_bytes = 4 * max(n_letters, default=0) * len(n_letters)
    return np.array(values, dtype=str) if n_bytes <= MIN_TEXT_BYTES + TEXT_BYTES_PER_LETTER * sum(n_letters) else None

"""Table of layout formats, limits, checks of untrusted files, and write reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.provenance import to_plain_data
from foveasim._core.registry import Registry
from foveasim._core.rings import site_area_um2
from foveasim._core.validation import MAX_SITES, Floats
from foveasim._io.formats import FileFormat
from foveasim.errors import FileError, ParameterError
from foveasim.layout.model import Layout, layout_of
from foveasim.layout.packed import check_sizes

#: Formats of layout files. ``read(path, **options)`` returns a :class:`foveasim.Layout`, ``write(layout, path, **options)`` a
#: :class:`foveasim.layout.WrittenLayout`. Installed packages add formats as entry points of the group ``foveasim.formats``.
FORMATS: Registry[FileFormat] = Registry("layout format", "foveasim.formats")
#: Identifier in every file that contains columns and provenance.
FILE_FORMAT = "foveasim layout"
FILE_VERSION = 1
MAX_DECOMPRESSED_BYTES = 8 * 2**30
#: Maximum decompressed size of a small file, and per byte of a larger one (regular grids: 30 bytes per byte).
MIN_DECOMPRESSED_BYTES, DECOMPRESSED_PER_BYTE = 2**26, 128
#: A string column requires the memory of its longest string in every row: maximum, and maximum per character.
MIN_STRING_BYTES, STRING_BYTES_PER_CHAR = 2**28, 64
#: Kinds of numpy types that GeoJSON and GeoParquet support: booleans, integers, floating-point numbers, strings.
PLAIN_KINDS = "biufU"


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenLayout:
    """
    Report of a written layout file.

    Attributes
    ----------
    path : Path
        Written file.
    n_sites : int
        Number of photosites in the file.
    max_displacement_um : float, µm
        Maximum displacement of a vertex by rounding.
    worst_area_error : float
        Maximum relative change of a site's area by rounding.
    dropped_columns : tuple of str
        Names of the columns that the file does not contain, sorted.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> layout = fs.layout.hexagonal(n_columns=4, n_rows=4, pitch_um=3.0)
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     written = layout.write(Path(directory, "layout.gds"))
    >>> written.n_sites, written.max_displacement_um < 0.001
    (16, True)
    """

    path: Path
    n_sites: int
    max_displacement_um: float = 0.0
    worst_area_error: float = 0.0
    dropped_columns: tuple[str, ...] = ()


def rounding_report(
    layout: Layout, rounded_um: Floats, path: Path, dropped_columns: tuple[str, ...] = ()
) -> WrittenLayout:
    """Return the report of a format with rounded vertices and dropped columns."""
    if layout.n_sites == 0 or rounded_um is layout.xy_um:
        return WrittenLayout(path=path, n_sites=layout.n_sites, dropped_columns=dropped_columns)
    displacement_um = np.hypot(*(rounded_um - layout.xy_um).T)
    area_um2 = layout.area_um2
    error = site_area_um2(rounded_um, layout.ring_offsets, layout.site_offsets) / area_um2 - 1.0
    return WrittenLayout(
        path=path,
        n_sites=layout.n_sites,
        max_displacement_um=float(displacement_um.max()),
        worst_area_error=float(np.abs(error).max()),
        dropped_columns=dropped_columns,
    )


def max_decompressed_bytes(path: Path) -> int:
    """Return the maximum decompressed size of a file in bytes, which depends on its size."""
    return min(MIN_DECOMPRESSED_BYTES + DECOMPRESSED_PER_BYTE * path.stat().st_size, MAX_DECOMPRESSED_BYTES)


def check_decompressed(path: Path, n_bytes: int) -> None:
    """Reject a file that would decompress to too many bytes."""
    if n_bytes > max_decompressed_bytes(path):
        raise FileError(path, f"would decompress to more than the maximum of {max_decompressed_bytes(path)} bytes")


def check_site_count(path: Path, n_sites: int) -> None:
    """Reject a file with too many sites."""
    if n_sites > MAX_SITES:
        raise FileError(path, f"has {n_sites} sites, more than the maximum of {MAX_SITES}")


def check_readable(layout: Layout) -> None:
    """Reject a layout with more rings or vertices of a site than are read from a file."""
    check_sizes(np.diff(layout.site_offsets), np.diff(layout.ring_offsets[layout.site_offsets]))


def layout_from_untrusted(
    polygons: NDArray[Any] | tuple[NDArray[Any], NDArray[Any], NDArray[Any]],
    columns: Mapping[str, NDArray[Any]],
    provenance: Mapping[str, Any],
) -> Layout:
    """Return a layout of untrusted outlines, after all checks of :meth:`Layout.from_polygons`."""
    if isinstance(polygons, tuple):
        _, ring_offsets, site_offsets = polygons
        check_sizes(np.diff(site_offsets), np.diff(ring_offsets[site_offsets]))
    else:
        check_sizes(shapely.get_num_interior_rings(polygons) + 1, shapely.get_num_coordinates(polygons))
    return layout_of(*Layout.from_polygons(polygons).rings_um, columns, provenance)


# -- provenance and types of columns in the file ----------------------------------------------------------------------


def header(layout: Layout) -> dict[str, Any]:
    """Return the metadata of a file as plain data: format, unit, provenance."""
    provenance = to_plain_data(dict(layout.provenance))
    return {"format": FILE_FORMAT, "version": FILE_VERSION, "unit": "um", "provenance": provenance}


def table_header(layout: Layout) -> dict[str, Any]:
    """Return the metadata of a table, with the types of the columns, such as ``<i8``."""
    return {**header(layout), "columns": {name: column.dtype.str for name, column in layout.columns.items()}}


def check_header(path: Path, about: Any) -> dict[str, Any]:
    """Return the provenance in the metadata of a file."""
    if not isinstance(about, dict) or about.get("format") != FILE_FORMAT:
        got = about.get("format") if isinstance(about, dict) else None
        hint = "; load it with Capture.load and use its attribute layout" if got == "foveasim capture" else ""
        raise FileError(path, f"is not a {FILE_FORMAT}{hint}")
    if about.get("version") != FILE_VERSION:
        raise FileError(path, f"has the format version {about.get('version')!r:.40}, expected {FILE_VERSION}")
    provenance = about.get("provenance")
    if not isinstance(provenance, dict) or about.get("unit") != "um":
        raise FileError(path, "has no valid provenance, or a unit other than µm")
    return provenance


def check_table_header(path: Path, about: Any, title: str) -> tuple[dict[str, Any], Mapping[str, Any]]:
    """Return provenance and types of columns of a table; its metadata may be None."""
    if about is None:
        return {"made_by": "read_layout", "file": path.name, "format": title}, {}
    provenance, types = check_header(path, about), about.get("columns")
    return provenance, types if isinstance(types, dict) else {}


def plain_columns(layout: Layout, format_name: str) -> dict[str, NDArray[Any]]:
    """Return the columns for a format that supports only numbers and strings."""
    for name, column in layout.columns.items():
        if column.dtype.kind not in PLAIN_KINDS or (column.dtype.itemsize > 8 and column.dtype.kind == "f"):
            raise ParameterError(
                name,
                f"must contain real numbers of at most 64 bits, booleans or strings in {format_name}, got {column.dtype}",
                hint="write a .npz file",
            )
    return dict(layout.columns)


def restore_column(values: NDArray[Any], dtype: object) -> NDArray[Any]:
    """Return a column in the type that the file specifies, where the conversion is exact."""
    if not isinstance(dtype, str) or len(dtype) > 16 or dtype[1:2] not in PLAIN_KINDS:
        return values
    try:
        if np.dtype(dtype).itemsize * values.size > max(2 * values.nbytes, MIN_STRING_BYTES):
            return values
        with np.errstate(all="ignore"):
            restored = values.astype(np.dtype(dtype))
            again = restored.astype(values.dtype)
    except (TypeError, ValueError, OverflowError):
        return values
    is_floating = values.dtype.kind == "f"
    is_same = np.array_equal(restored, values, equal_nan=is_floating and restored.dtype.kind == "f")
    # Large integers equal their neighbours when compared as floating-point numbers, hence the test of the round trip.
    return restored if is_same and np.array_equal(again, values, equal_nan=is_floating) else values


def string_column(values: Sequence[str]) -> NDArray[Any] | None:
    """Return a string column, or None where a long string makes it exceed the memory limit."""
    n_chars = list(map(len, values))
    n_bytes = 4 * max(n_chars, default=0) * len(n_chars)
    return np.array(values, dtype=str) if n_bytes <= MIN_STRING_BYTES + STRING_BYTES_PER_CHAR * sum(n_chars) else None

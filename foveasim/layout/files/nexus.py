"""
Layouts as detectors in NeXus files (HDF5): NXoff_geometry, and pixel corners of pyFAI.

A file contains one detector, with

- ``detector_shape`` (NXoff_geometry): ``vertices`` in µm, the faces of the sites, counter-clockwise, and ``detector_faces``,
- ``pixel_corners`` (pyFAI): (slow, fast, corner, 3) float32, corners as (z, y, x) in metres. Sites with fewer corners repeat
  the last one. Slow and fast are the columns ``row`` and ``column`` of a complete grid, otherwise 1 and the sites,
- the columns, and the attribute ``foveasim`` with the provenance.

Read are also uniform detectors of pyFAI (``pixel_size`` and ``shape``), and a ``pixel_shape`` at the offsets of all pixels.
x and y are those of the detector; its position in the laboratory does not matter.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._core.validation import Floats, Ints
from foveasim._io.atomic import atomic_write
from foveasim._io.formats import FileFormat, FormatError, as_file_error
from foveasim._io.rasters.units import length_in_um
from foveasim._io.sandbox import read_in_sandbox
from foveasim.errors import FileError, GeometryError
from foveasim.layout.files._common import (
    FORMATS,
    WrittenLayout,
    check_site_count,
    check_table_header,
    layout_from_untrusted,
    max_decompressed_bytes,
    plain_columns,
    restore_column,
    string_column,
    table_header,
)
from foveasim.layout.files._outlines import (
    Invalid,
    LengthUnit,
    Parts,
    agreed_unit,
    check_plane,
    grouped_polygons,
    layout_of_geometries,
    required_unit,
    scaled,
    with_fix,
)
from foveasim.layout.model import Layout

__all__ = ["read", "write"]

MAGIC = b"\x89HDF\r\n\x1a\n"
#: pyFAI reads only entries with a time; it is always the same, so that equal layouts give equal files.
START_TIME = "1970-01-01T00:00:00"
DETECTOR = "/entry/instrument/detector"
OFF, CYLINDERS = "NXoff_geometry", "NXcylindrical_geometry"
#: Datasets of a geometry; all of them are read, and others are errors.
GEOMETRY = ("vertices", "winding_order", "faces", "detector_faces")
#: Datasets of a detector that are read, and those that do not change the outlines of its pixels: versions, calibrations and
#: counts, sizes that follow from the corners, and its position. Others are errors where corners or sizes of pyFAI are read.
UNDERSTOOD = ("pixel_corners", "pixel_size", "shape", "max_shape", "binning", "orientation", "mask")
IRRELEVANT = frozenset((
    "API_VERSION", "IS_FLAT", "IS_CONTIGUOUS", "CORNERS", "force_pixel", "flatfield", "darkcurrent", "dummy", "delta_dummy",
    "sensor_material", "sensor_thickness", "detector_number", "data", "data_errors", "description", "type", "local_name",
    "serial_number", "distance", "polar_angle", "azimuthal_angle", "depends_on", "count_time", "frame_time", "exposure_time",
    "x_pixel_size", "y_pixel_size", "beam_center_x", "beam_center_y", "bit_depth_readout", "saturation_value",
    "underload_value", "countrate_correction_applied", "pixel_mask", "pixel_mask_applied", "flatfield_applied",
    "dead_time", "gain_setting", "layout", "threshold_energy", "frame_start_number", "trigger_mode",
))  # fmt: skip
#: Orientations of pyFAI: whether x and y decrease with the index of a pixel.
FLIPS = {1: (True, True), 2: (False, True), 3: (False, False), 4: (True, False)}
#: Largest number of objects in a file, and of corners relative to the vertices of a layout that are written for pyFAI.
MAX_OBJECTS, MAX_PADDING = 100_000, 16
#: Coordinates in float64 after decompression, relative to those in the file.
READING_COPIES = 8


# -- writing ------------------------------------------------------------------------------------------------------------


def write(layout: Layout, path: Path) -> WrittenLayout:
    """
    Write a detector with one face per site.

    Raises GeometryError when a site has a hole, which faces cannot have. Raises FileError when h5py is not installed, or the
    file cannot be written.
    """
    h5py = import_optional(path, "h5py", "maps")
    columns = plain_columns(layout, "NeXus")
    holed = np.flatnonzero(np.diff(layout.site_offsets) > 1)
    if holed.size:
        raise GeometryError(
            f"site {holed[0]} has a hole, which NeXus files cannot contain; write a GDSII or GeoParquet file",
            tuple(holed.tolist()),
        )
    n_vertices = layout.xy_um.shape[0]
    with atomic_write(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update({"NX_class": "NXroot", "default": "entry", "foveasim": json.dumps(table_header(layout))})
        detector = file
        for name, kind in (("entry", "NXentry"), ("instrument", "NXinstrument"), ("detector", "NXdetector")):
            detector = detector.create_group(name)
            detector.attrs["NX_class"] = kind
        file["entry/start_time"] = START_TIME
        _write_corners(detector, layout)
        shape = detector.create_group("detector_shape")
        shape.attrs["NX_class"] = OFF
        vertices = np.zeros((n_vertices, 3))
        vertices[:, :2] = layout.xy_um
        shape.create_dataset("vertices", data=vertices).attrs["units"] = "um"
        shape["winding_order"] = np.arange(n_vertices)
        shape["faces"] = layout.ring_offsets[:-1]
        shape["detector_faces"] = np.repeat(np.arange(layout.n_sites)[:, np.newaxis], 2, axis=1)
        collection = file["entry"].create_group("columns")
        collection.attrs["NX_class"] = "NXcollection"
        for number, (name, values) in enumerate(columns.items()):
            stored = np.char.encode(values, "utf-8") if values.dtype.kind == "U" else values
            collection.create_dataset(f"column_{number}", data=stored).attrs["name"] = name
    return WrittenLayout(path=path, n_sites=layout.n_sites)


def _write_corners(detector: Any, layout: Layout) -> None:
    """Write corners of pixels as pyFAI does, unless padding would take far more memory."""
    row, column = _rows_and_columns(layout)
    count = np.diff(layout.ring_offsets)
    n_corners = int(count.max(initial=3))
    if layout.n_sites == 0 or layout.n_sites * n_corners > MAX_PADDING * layout.xy_um.shape[0]:
        return
    shape = int(row.max()) + 1, int(column.max()) + 1
    corner = np.minimum(np.arange(n_corners), count[:, np.newaxis] - 1) + layout.ring_offsets[:-1, np.newaxis]
    corners = np.zeros((*shape, n_corners, 3), np.float32)
    corners[row, column, :, 1:] = 1e-6 * layout.xy_um[corner][..., ::-1]
    number = np.zeros(shape, np.int64)
    number[row, column] = np.arange(layout.n_sites)
    size_m = 1e-6 * float(np.sqrt(layout.area_um2.mean()))
    for name, value in (
        ("API_VERSION", np.bytes_("1.1")),
        ("IS_FLAT", True),
        ("IS_CONTIGUOUS", False),
        ("CORNERS", n_corners),
        ("force_pixel", True),
        ("max_shape", np.array(shape, np.int32)),
        ("shape", np.array(shape, np.int32)),
        ("binning", np.ones(2, np.int32)),
        ("orientation", np.int32(3)),
        ("detector_number", number),
    ):
        detector[name] = value
    detector.create_dataset("pixel_size", data=np.array([size_m, size_m])).attrs["unit"] = "m"
    dataset = detector.create_dataset("pixel_corners", data=corners)
    dataset.attrs.update({"interpretation": "vertex", "units": "m"})


def _rows_and_columns(layout: Layout) -> tuple[Ints, Ints]:
    """Return the positions of sites in an array: a complete grid, otherwise one row."""
    row, column = (layout.columns.get(name) for name in ("row", "column"))
    if row is not None and column is not None and row.dtype.kind in "iu" and column.dtype.kind in "iu" and row.size:
        row, column = row.astype(np.int64) - int(row.min()), column.astype(np.int64) - int(column.min())
        n_rows, n_columns = int(row.max()) + 1, int(column.max()) + 1
        if n_rows * n_columns == row.size == np.unique(row * n_columns + column).size:
            return row, column
    return np.zeros(layout.n_sites, np.int64), np.arange(layout.n_sites)


# -- reading ------------------------------------------------------------------------------------------------------------


def read(
    path: Path,
    *,
    cell: str | None = None,
    unit: LengthUnit | None = None,
    invalid: Invalid = "error",
    parts: Parts = "error",
) -> Layout:
    """Read the detecting faces of a detector, in their order, or its pixels row by row."""
    import_optional(path, "h5py", "maps")
    with as_file_error(path, "NeXus detector"):
        about, arrays = read_in_sandbox(
            _read,
            path,
            kind="NeXus detector",
            max_decompressed_bytes=lambda _: READING_COPIES * max_decompressed_bytes(path),
            cell=cell,
        )
        found = dict(zip(about["names"], arrays, strict=True))
        title = "NeXus"
        provenance, types = check_table_header(path, json.loads(about["header"]), title)
        unit_um = _unit_um(path, about["units"], unit)
        shapes, columns = _GEOMETRIES[about["kind"]](path, found)
        n_sites = shapes.counts.size if isinstance(shapes, _Rings) else shapes.size
        check_site_count(path, n_sites)
        if json.loads(about["header"]) is not None:
            columns = {}  # those of the layout follow
        for number, name in enumerate(about["columns"]):
            values = found[f"column_{number}"]
            text = [value.decode("utf-8") for value in values.tolist()] if values.dtype.kind == "S" else None
            values = values if text is None else string_column(text)
            if values is not None and values.shape == (n_sites,):
                columns[name] = restore_column(values, types.get(name))
        if isinstance(shapes, _Rings) and invalid == "error" and np.isfinite(shapes.xy).all():
            ring_offsets = np.concatenate(([0], np.cumsum(shapes.counts)))
            rings = scaled(shapes.xy, unit_um), ring_offsets, np.arange(ring_offsets.size)
            try:
                return layout_from_untrusted(rings, columns, provenance)
            except GeometryError as error:
                raise with_fix(path, error) from None
        return layout_of_geometries(
            path,
            _polygons(*shapes) if isinstance(shapes, _Rings) else shapes,
            columns,
            provenance,
            noun="pixel",
            unit_um=unit_um,
            invalid=invalid,
            parts=parts,
        )


class _Rings(NamedTuple):
    """Corners (n, 2) of polygons, one after the other, and their number of corners."""

    xy: Floats
    counts: Ints


#: One polygon per site: its ring, or any shape.
_Shapes: TypeAlias = _Rings | NDArray[Any]


def _unit_um(path: Path, name: str, unit: LengthUnit | None) -> float:
    if not name:
        return required_unit(path, unit, "has vertices without the attribute 'units'")
    stated_um = length_in_um(name)
    if stated_um is None:
        raise FileError(path, f"has the unit {name!r:.40}, expected a length such as m, mm or um")
    return agreed_unit(path, unit, stated_um, name)


def _of_faces(path: Path, found: dict[str, NDArray[Any]]) -> tuple[_Shapes, dict[str, Any]]:
    """Return the shapes of the detecting faces: those with one number are one site."""
    faces = _faces(path, found)
    pairs = found.get("detector_faces")
    if pairs is None:
        return faces, {}
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not _are_indices(pairs[:, 0], faces.counts.size):
        raise FileError(path, "has 'detector_faces' that are not pairs of a face and a number")
    if np.array_equal(pairs[:, 0], np.arange(faces.counts.size)) and np.unique(pairs[:, 1]).size == pairs.shape[0]:
        return faces, {"detector_number": pairs[:, 1]}
    polygons = _polygons(*faces)
    numbers, first, site = np.unique(pairs[:, 1], return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(order.size, np.int64)
    rank[order] = np.arange(order.size)
    site = rank[site.ravel()]
    by_site = np.argsort(site, kind="stable")
    counts = np.bincount(site, minlength=numbers.size)
    shapes = grouped_polygons(polygons[pairs[by_site, 0]], counts)
    for i in np.flatnonzero(counts > 1):
        shapes[i] = shapely.union_all(shapely.get_parts(shapes[i]))
    return shapes, {"detector_number": numbers[order]}


def _faces(path: Path, found: dict[str, NDArray[Any]]) -> _Rings:
    """Return the faces of a geometry."""
    vertices, winding, starts = (found[name] for name in GEOMETRY[:3])
    if vertices.ndim != 2 or vertices.shape[1] != 3 or winding.ndim != 1 or starts.ndim != 1 or starts.size == 0:
        raise FileError(path, "has no vertices (n, 3), or no faces")
    if not _are_indices(winding, vertices.shape[0]) or not _are_indices(starts, winding.size):
        raise FileError(path, "has faces of vertices that do not exist")
    counts = np.diff(np.append(starts.astype(np.int64), winding.size))
    if starts[0] != 0 or (counts < 3).any():
        raise FileError(path, "has faces of fewer than 3 vertices")
    corners = vertices[winding].astype(np.float64)
    check_plane(path, corners[:, 2], float(np.abs(corners).max()))
    return _Rings(corners[:, :2], counts)


def _polygons(xy: Floats, counts: Ints) -> NDArray[Any]:
    """Return polygons with so many corners each, None where a coordinate is not finite."""
    ring_of = np.repeat(np.arange(counts.size), counts)
    is_bad = np.zeros(counts.size, bool)
    is_bad[ring_of[~np.isfinite(xy).all(axis=1)]] = True
    polygons = np.full(counts.size, None, dtype=object)
    kept = ~is_bad[ring_of]
    if kept.any():
        index = np.cumsum(~is_bad) - 1
        polygons[~is_bad] = shapely.polygons(shapely.linearrings(xy[kept], indices=index[ring_of[kept]]))
    return polygons


def _are_indices(values: NDArray[Any], n: int) -> bool:
    return values.dtype.kind in "iu" and (values.size == 0 or (int(values.min()) >= 0 and int(values.max()) < n))


def _of_corners(path: Path, found: dict[str, NDArray[Any]]) -> tuple[_Shapes, dict[str, Any]]:
    """Return the pixels of pyFAI's corners (slow, fast, corner, 3) as (z, y, x)."""
    corners = found["pixel_corners"]
    if corners.ndim != 4 or corners.shape[3] != 3 or corners.shape[2] < 3 or corners.dtype.kind != "f":
        raise FileError(path, f"has 'pixel_corners' of the shape {corners.shape}, expected (slow, fast, corner, 3)")
    n_slow, n_fast, n_corners = corners.shape[:3]
    if "shape" in found and (n_slow, n_fast) != tuple(found["shape"].tolist()):
        raise FileError(path, "has corners of single pixels, but is binned; save the detector without binning")
    xyz = corners.reshape(-1, 3)[:, ::-1].astype(np.float64)
    check_plane(path, xyz[:, 2], float(np.nanmax(np.abs(xyz), initial=0.0)))
    return _Rings(xyz[:, :2], np.full(n_slow * n_fast, n_corners)), _grid_columns(path, n_slow, n_fast, found)


def _grid_columns(path: Path, n_slow: int, n_fast: int, found: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Return the columns of pixels in rows (slow) and columns (fast), with the mask."""
    row, column = np.divmod(np.arange(n_slow * n_fast), max(n_fast, 1))
    columns: dict[str, Any] = {"row": row, "column": column}
    if "mask" in found:
        if found["mask"].shape != (n_slow, n_fast):
            raise FileError(path, f"has a mask of the shape {found['mask'].shape}, expected {(n_slow, n_fast)}")
        columns["mask"] = found["mask"].ravel() != 0
    return columns


def _of_sizes(path: Path, found: dict[str, NDArray[Any]]) -> tuple[_Shapes, dict[str, Any]]:
    """Return the equal pixels of a uniform detector of pyFAI."""
    shape = found.get("shape", found.get("max_shape"))
    sizes = found["pixel_size"]
    if shape is None or shape.shape != (2,) or sizes.shape != (2,) or not (shape > 0).all():
        raise FileError(path, "has no 'shape' (slow, fast) and 'pixel_size' (slow, fast)")
    orientation = int(found["orientation"].ravel()[0]) if "orientation" in found else 3
    if orientation not in FLIPS:
        raise FileError(path, f"has the orientation {orientation}, expected 1 to 4")
    n_slow, n_fast = (int(n) for n in shape)
    check_site_count(path, n_slow * n_fast)
    columns = _grid_columns(path, n_slow, n_fast, found)
    flip_x, flip_y = FLIPS[orientation]
    y = n_slow - 1 - columns["row"] if flip_y else columns["row"]
    x = n_fast - 1 - columns["column"] if flip_x else columns["column"]
    height, width = (float(size) for size in sizes)
    x0, x1, y0, y1 = x * width, (x + 1) * width, y * height, (y + 1) * height
    xy = np.stack((x0, y0, x1, y0, x1, y1, x0, y1), axis=1).reshape(-1, 2)
    return _Rings(xy, np.full(x.size, 4)), columns


def _of_offsets(path: Path, found: dict[str, NDArray[Any]]) -> tuple[_Shapes, dict[str, Any]]:
    """Return one shape at the offsets of all pixels."""
    x, y = found["x_pixel_offset"], found["y_pixel_offset"]
    if x.ndim == y.ndim == 1 and found.get("detector_number", x).ndim == 2:
        y, x = (each.copy() for each in np.meshgrid(y, x, indexing="ij"))
    if x.shape != y.shape or x.ndim == 0:
        raise FileError(path, f"has offsets of the shapes {x.shape} and {y.shape}, expected one offset per pixel")
    faces = _faces(path, found)
    if "z_pixel_offset" in found:
        check_plane(path, found["z_pixel_offset"].astype(np.float64), float(np.abs(x).max(initial=0.0)))
    if faces.counts.size != 1:
        raise FileError(path, f"has a pixel of {faces.counts.size} faces, expected one")
    corners = faces.xy
    xy = np.stack((x.ravel(), y.ravel()), axis=1)[:, np.newaxis] + corners
    columns: dict[str, Any] = {}
    if x.ndim == 2:
        columns = _grid_columns(path, x.shape[0], x.shape[1], {})
    if "detector_number" in found and found["detector_number"].size == x.size:
        columns["detector_number"] = found["detector_number"].ravel()
    return _Rings(xy.reshape(-1, 2).astype(np.float64), np.full(x.size, corners.shape[0])), columns


_GEOMETRIES = {
    "faces": _of_faces,
    "corners": _of_corners,
    "sizes": _of_sizes,
    "offsets": _of_offsets,
}


# -- in the sandbox process ------------------------------------------------------------------------------------------------


def _read(file_name: str, cell: str | None) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Read the arrays of the outlines of one detector, and their names."""
    import h5py

    with h5py.File(file_name, "r") as file:
        header = file.attrs.get("foveasim")
        sources = _sources(file)
        if header is not None and cell is None:
            cell = f"{DETECTOR}/detector_shape"
        if cell is not None:
            chosen = "/" + cell.strip("/")
            sources = [source for source in sources if chosen in (source[1].name, source[2].name)] or sources
            if len(sources) != 1 and all(chosen != source[1].name for source in sources):
                raise FormatError(f"has no detector {cell!r:.80}; it has {_listed(sources)}")
        if len(sources) != 1:
            raise FormatError(
                f"has several detectors: {_listed(sources)}; select one with cell="
                if sources
                else "has no detector with NXoff_geometry, or with corners or sizes of pixels of pyFAI"
            )
        kind, part, detector = sources[0]
        datasets, units = _datasets(kind, part, detector)
        names: list[str] = []
        if header is not None and isinstance(file.get("entry/columns"), h5py.Group):
            collection = file["entry/columns"]
            for number in range(len(collection)):
                datasets[f"column_{number}"] = _plain(collection[f"column_{number}"])
                names.append(str(collection[f"column_{number}"].attrs["name"]))
        arrays = [np.ascontiguousarray(dataset[()]) for dataset in datasets.values()]
    about = {"kind": kind, "names": list(datasets), "units": units, "columns": names, "header": str(header or "null")}
    return about, arrays


def _sources(file: Any) -> list[tuple[str, Any, Any]]:
    """Return the descriptions of outlines in a file: their kind, object, and detector."""
    import h5py

    found: list[tuple[str, Any, Any]] = []
    groups, n_objects = [file["/"]], 0
    while groups:
        group = groups.pop(0)
        is_detector = _class(group) == "NXdetector"
        for name in group:
            n_objects += 1
            if n_objects > MAX_OBJECTS:
                raise FormatError(f"contains more than {MAX_OBJECTS} arrays and groups")
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue
            part = group[name]
            if isinstance(part, h5py.Group):
                groups.append(part)
                if is_detector and _class(part) == CYLINDERS:
                    raise FormatError(f"describes {part.name} by cylinders ({CYLINDERS}), which have no outline")
                if is_detector and _class(part) == OFF:
                    found.append(("offsets" if name == "pixel_shape" else "faces", part, group))
            elif is_detector and name == "pixel_corners":
                found.append(("corners", part, group))
        has_corners = any(source[2] == group for source in found)
        if is_detector and not has_corners and "pixel_size" in group and ("shape" in group or "max_shape" in group):
            found.append(("sizes", group, group))
    return found


def _datasets(kind: str, part: Any, detector: Any) -> tuple[dict[str, Any], str]:
    """Return the datasets that describe outlines, and their unit, empty if not stated."""
    import h5py

    if kind in ("faces", "offsets"):
        unknown = [name for name in part if name not in GEOMETRY]
        if unknown:
            raise FormatError(f"has {part.name}/{unknown[0]:.60}, which is not known in {OFF}")
        missing = [name for name in GEOMETRY[:3] if name not in part]
        if missing:
            raise FormatError(f"lacks {part.name}/{missing[0]}")
        datasets = {name: _plain(part[name]) for name in part}
        units = _text(datasets["vertices"].attrs.get("units", ""))
        if kind == "offsets":
            for name in ("x_pixel_offset", "y_pixel_offset", "z_pixel_offset", "detector_number"):
                if name in detector:
                    datasets[name] = _plain(detector[name])
                    other = _text(datasets[name].attrs.get("units", units))
                    if name != "detector_number" and other != units:
                        raise FormatError(f"has {name} in {other!r:.20}, but the vertices in {units!r:.20}")
            if "x_pixel_offset" not in datasets or "y_pixel_offset" not in datasets:
                raise FormatError(
                    f"has the shape of one pixel in {part.name}, but no x_pixel_offset and y_pixel_offset"
                )
        return datasets, units
    known = {name for name in detector if name in UNDERSTOOD or name in IRRELEVANT}
    unknown = [name for name in detector if name not in known and isinstance(detector.get(name), h5py.Dataset)]
    if unknown:
        raise FormatError(f"has {detector.name}/{unknown[0]:.60}, which is not known in detectors of pyFAI")
    datasets = {name: _plain(detector[name]) for name in UNDERSTOOD if name in detector}
    lengths = datasets["pixel_corners" if kind == "corners" else "pixel_size"].attrs
    return datasets, _text(lengths.get("units", lengths.get("unit", "m")))  # pyFAI: metres


def _plain(dataset: Any) -> Any:
    """Return a dataset of numbers or strings that is stored in this file."""
    import h5py

    if (
        not isinstance(dataset, h5py.Dataset)
        or dataset.external
        or dataset.is_virtual
        or dataset.dtype.kind not in "biufS"
    ):
        raise FormatError(
            f"must contain the numbers {getattr(dataset, 'name', '')!r:.80}, not a group or external data"
        )
    return dataset


def _class(group: Any) -> str:
    return _text(group.attrs.get("NX_class", ""))


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _listed(sources: list[tuple[str, Any, Any]]) -> str:
    return ", ".join(str(part.name)[:80] for _, part, _ in sources[:5]) or "none"


FORMATS.register(
    "nexus",
    FileFormat(
        title="NeXus",
        suffixes=(".nxs", ".h5", ".hdf5"),
        signatures=(MAGIC,),
        read=read,
        write=write,
        read_options=("cell", "unit", "invalid", "parts"),
    ),
)

"""
Layouts from drawings in DXF, through ezdxf.

Sites are closed outlines in model space: LWPOLYLINE and POLYLINE with their arcs, CIRCLE, ELLIPSE, SPLINE, SOLID, TRACE,
3DFACE, HATCH and MPOLYGON, also in blocks (INSERT), repeated, rotated, scaled and mirrored. Curves are chords that deviate by
at most ``max_sagitta_um``. The format is read-only.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import shapely

from foveasim._core.calls import Limits
from foveasim._core.extras import import_optional
from foveasim._core.names import possible_names
from foveasim._core.validation import MAX_SITES, Floats
from foveasim._io.formats import FileFormat, as_file_error, one_line
from foveasim.errors import FileError, LayoutWarning, ParameterError, warn
from foveasim.layout.files._common import FORMATS
from foveasim.layout.files._outlines import (
    Invalid,
    LengthUnit,
    Parts,
    agreed_unit,
    check_plane,
    layout_of_geometries,
    required_unit,
)
from foveasim.layout.model import Layout

__all__ = ["read"]

BINARY_MAGIC = b"AutoCAD Binary DXF\r\n\x1a\x00"
#: Units of $INSUNITS in µm, with their names; 0 is unitless.
UNITS_UM = {
    1: (25400.0, "in"), 2: (304800.0, "ft"), 3: (1.609344e9, "mi"), 4: (1e3, "mm"), 5: (1e4, "cm"), 6: (1e6, "m"),
    7: (1e9, "km"), 8: (0.0254, "µin"), 9: (25.4, "mil"), 10: (914400.0, "yd"), 11: (1e-4, "Å"), 12: (1e-3, "nm"),
    13: (1.0, "µm"), 14: (1e5, "dm"), 15: (1e7, "dam"), 16: (1e8, "hm"), 17: (1e15, "Gm"),
}  # fmt: skip
#: Entities that are outlines, that fill outlines, and those without an area: texts, dimensions, auxiliary lines, views. Others
#: are errors that name them.
CURVES = frozenset(("LWPOLYLINE", "POLYLINE", "CIRCLE", "ELLIPSE", "SPLINE", "SOLID", "TRACE", "3DFACE"))
FILLED = frozenset(("HATCH", "MPOLYGON"))
IRRELEVANT = frozenset((
    "TEXT", "MTEXT", "ATTDEF", "ATTRIB", "DIMENSION", "ARC_DIMENSION", "LARGE_RADIAL_DIMENSION", "LEADER", "MULTILEADER",
    "MLEADER", "TOLERANCE", "POINT", "XLINE", "RAY", "VIEWPORT", "SEQEND", "VERTEX",
))  # fmt: skip
#: Depth of nested blocks, and number of coordinates of all outlines.
MAX_DEPTH, MAX_VERTICES = 32, 50_000_000
SAGITTA = Limits(at_least=1e-5, at_most=1e4)
#: Rounding of coordinates within which the ends of a polyline are the same.
CLOSED = 1e-9
#: Flag of control points of splines among the vertices of a polyline, and largest number of chords of an arc.
SPLINE_FRAME, MAX_CHORDS = 16, 100_000
#: Number of kinds of entities in a message.
MAX_LISTED = 5
#: Characters of a message of ezdxf.
MAX_MESSAGE = 160


def read(
    path: Path,
    *,
    layer: Any = None,
    unit: LengthUnit | None = None,
    invalid: Invalid = "error",
    parts: Parts = "error",
    max_sagitta_um: Annotated[float, SAGITTA] = 1e-3,
) -> Layout:
    """
    Read the closed outlines of some layers, in the order of the file.

    The column ``layer`` contains the layers. Raises FileError when the unit is neither stated by the file nor by the caller,
    outlines are on several layers and none is selected, or an entity is not an outline.
    """
    ezdxf = import_optional(path, "ezdxf")
    with as_file_error(path, "DXF drawing", passes=(ParameterError,)):
        drawing = _drawing(path, ezdxf, invalid)
        # ezdxf assumes metres where a file has no such variable, as those of R12.
        number = int(drawing.header.get("$INSUNITS", 0)) if b"$INSUNITS" in path.read_bytes() else 0
        if number and number not in UNITS_UM:
            raise FileError(path, f"has the unit $INSUNITS = {number}, which is not a length of a layout")
        if number:
            unit_um = agreed_unit(path, unit, *UNITS_UM[number])
        else:
            unit_um = required_unit(path, unit, "is unitless (its $INSUNITS is 0 or missing)")
        reader = _Reader(_names(layer), max_sagitta_um / unit_um)
        found = list(reader.outlines(drawing.modelspace(), np.eye(4), None, 0))
        _check_layers(path, reader, found, layer)
        if reader.unknown:
            _report_unknown(path, reader.unknown, invalid)
        if not found:
            raise FileError(path, "has no closed outlines in model space")
        z = np.array([height for _, _, heights in found for height in heights])
        check_plane(path, z, max(float(np.abs(shapely.bounds(shape)).max()) for _, shape, _ in found))
        layers = np.array([name for name, _, _ in found], dtype=str)
        return layout_of_geometries(
            path,
            np.array([shape for _, shape, _ in found], dtype=object),
            {"layer": layers},
            {"made_by": "read_layout", "file": path.name, "format": "DXF"},
            noun="outline",
            unit_um=unit_um,
            invalid=invalid,
            parts=parts,
        )


class _Messages(logging.Handler):
    """Warnings of ezdxf about content that it ignores."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep the text of a warning."""
        self.texts.append(one_line(record.getMessage(), MAX_MESSAGE))


def _drawing(path: Path, ezdxf: Any, invalid: str) -> Any:
    """Read a drawing; what ezdxf ignores is an error, or a warning with invalid='skip'."""
    messages, logger = _Messages(), logging.getLogger("ezdxf")
    propagates, logger.propagate = logger.propagate, False
    logger.addHandler(messages)
    try:
        drawing = ezdxf.readfile(str(path))
    except ezdxf.DXFError as error:
        reason = one_line(str(error), MAX_MESSAGE)
        raise FileError(path, f"is corrupt or not a valid DXF drawing ({reason})") from None
    finally:
        logger.removeHandler(messages)
        logger.propagate = propagates
    if messages.texts:
        what = f"has content that ezdxf ignores: {messages.texts[0]}"
        if invalid == "error":
            raise FileError(path, f"{what}; repair the file, or pass invalid='skip'")
        warn(f"{path.name}: {what}", LayoutWarning)
    return drawing


def _names(layer: Any) -> frozenset[str] | None:
    """Return the names of selected layers in lower case: DXF does not distinguish cases."""
    if layer is None:
        return None
    names = [layer] if isinstance(layer, str) or not isinstance(layer, Sequence) else list(layer)
    if not names or not all(isinstance(name, str | int) for name in names):
        raise ParameterError("layer", "must be the name of a layer of a DXF drawing, or several", layer)
    return frozenset(str(name).lower() for name in names)


def _check_layers(path: Path, reader: _Reader, found: list[Any], layer: Any) -> None:
    """Require a selection of existing layers where outlines are on several ones."""
    if layer is None:
        if len(reader.layers) > 1:
            names = ", ".join(repr(name)[:40] for name in sorted(reader.layers)[:MAX_LISTED])
            raise FileError(path, f"has outlines on {len(reader.layers)} layers: {names}; select with layer=")
    elif not found and not reader.unknown:
        hint = possible_names(str(layer), sorted(reader.layers))
        raise FileError(path, f"has no outlines on the layer {str(layer)[:60]!r}; {hint}")


def _report_unknown(path: Path, unknown: Counter[str], invalid: str) -> None:
    kinds = ", ".join(f"{count} {kind}" for kind, count in unknown.most_common(MAX_LISTED))
    if invalid == "error":
        raise FileError(
            path, f"has entities that are no closed outlines: {kinds}; select layers, or pass invalid='skip'"
        )
    warn(f"{path.name}: entities that are no closed outlines are skipped: {kinds}", LayoutWarning)


class _Reader:
    """
    Outlines of the entities of a drawing.

    ``names``: selected layers in lower case, or None. ``tolerance``: largest deviation of chords, in units of the drawing.
    ``layers``: layers with outlines. ``unknown``: number of entities on selected layers that are no outlines, by kind.
    """

    def __init__(self, names: frozenset[str] | None, tolerance: float) -> None:
        self._names, self._tolerance = names, tolerance
        self.layers: set[str] = set()
        self.unknown: Counter[str] = Counter()
        self._n_outlines = self._n_vertices = 0

    def outlines(
        self, entities: Any, matrix: Floats, parent: str | None, depth: int
    ) -> Iterator[tuple[str, Any, list[float]]]:
        """Yield layer, polygon and heights of all outlines, as rows times a matrix."""
        if depth > MAX_DEPTH:
            raise FileError(None, f"has blocks nested more than {MAX_DEPTH} deep")
        for entity in entities:
            kind = entity.dxftype()
            # Entities on layer 0 of a block are on the layer of its reference.
            name = str(entity.dxf.get("layer", "0"))
            name = parent if parent is not None and name == "0" else name
            if kind == "INSERT":
                yield from self._inserted(entity, matrix, name, depth)
                continue
            if kind in IRRELEVANT:
                continue
            is_selected = self._names is None or name.lower() in self._names
            rings = self._rings(entity, kind, matrix) if is_selected or kind in CURVES | FILLED else None
            if rings:
                self.layers.add(name)
            if not is_selected:
                continue
            if not rings:
                self.unknown[kind if kind not in CURVES | FILLED else f"{kind} (open or wide)"] += 1
                continue
            self._count(rings)
            yield name, _shape(rings), [float(z) for ring in rings for z in (ring[:, 2].min(), ring[:, 2].max())]

    def _count(self, corners: list[Floats]) -> None:
        self._n_outlines += 1
        self._n_vertices += sum(len(ring) for ring in corners)
        if self._n_outlines > MAX_SITES or self._n_vertices > MAX_VERTICES:
            raise FileError(None, f"has more than {MAX_VERTICES} vertices or {MAX_SITES} outlines")

    def _inserted(self, insert: Any, matrix: Floats, name: str, depth: int) -> Iterator[tuple[str, Any, list[float]]]:
        """Yield the outlines of a block at all places of its reference."""
        block = insert.block()
        if block is None:
            raise FileError(None, f"has a reference to the block {insert.dxf.name!r:.60}, which does not exist")
        own = np.array(list(insert.matrix44())).reshape(4, 4)
        n_rows, n_columns = max(insert.dxf.row_count, 1), max(insert.dxf.column_count, 1)
        if n_rows * n_columns > MAX_SITES:
            raise FileError(None, f"has an array of {n_rows} x {n_columns} blocks, more than {MAX_SITES}")
        ocs = insert.ocs()
        angle = np.radians(insert.dxf.rotation)
        x_axis, y_axis = (
            np.array(ocs.to_wcs((c, s, 0.0)))
            for c, s in ((np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle)))
        )
        seen = set()
        for row in range(n_rows):
            for column in range(n_columns):
                step = column * insert.dxf.column_spacing * x_axis + row * insert.dxf.row_spacing * y_axis
                if tuple(step) in seen:  # a spacing of 0
                    continue
                seen.add(tuple(step))
                placed = own.copy()
                placed[3, :3] += step
                yield from self.outlines(block, placed @ matrix, name, depth + 1)

    def _rings(self, entity: Any, kind: str, matrix: Floats) -> list[Floats] | None:
        """Return the closed rings (n, 3) of an outline, or None."""
        scale = float(np.linalg.norm(matrix[:3, :3], axis=1).max())
        tolerance = self._tolerance / scale if scale > 0.0 else self._tolerance
        if kind in FILLED:
            rings = _boundaries(entity, tolerance)
        elif kind in CURVES and not _width(entity, kind):
            rings = [_curve(entity, kind, tolerance)]
        else:
            return None
        if not rings or any(ring is None or len(ring) < 3 for ring in rings):
            return None
        return [ring @ matrix[:3, :3] + matrix[3, :3] for ring in rings if ring is not None]


def _curve(entity: Any, kind: str, tolerance: float) -> Floats | None:
    """Return the corners (n, 3) of a closed curve, without the first one again, or None."""
    if kind == "LWPOLYLINE":
        points = np.array(entity.get_points(format="xyb"), np.float64).reshape(-1, 3)
        return _in_world(entity, _with_arcs(points, entity.closed, tolerance), float(entity.dxf.get("elevation", 0.0)))
    if kind == "POLYLINE":
        if not (entity.is_2d_polyline or entity.is_3d_polyline):
            return None  # meshes
        vertices = [v for v in entity.vertices if not v.dxf.get("flags", 0) & SPLINE_FRAME]
        points = np.array([(*v.dxf.location, v.dxf.get("bulge", 0.0)) for v in vertices], np.float64).reshape(-1, 4)
        if entity.is_3d_polyline:
            return _closed(points[:, :3], entity.is_closed)
        elevation = float(entity.dxf.get("elevation", (0.0, 0.0, 0.0))[2])
        return _in_world(entity, _with_arcs(points[:, (0, 1, 3)], entity.is_closed, tolerance), elevation)
    if kind in ("SOLID", "TRACE", "3DFACE"):
        # The corners of solids are in the order of two rows.
        corners = np.array([tuple(corner) for corner in entity.wcs_vertices()], np.float64)
        return _closed(corners, is_closed=True)
    points = entity.flattening(tolerance)
    return _closed(np.array([tuple(point) for point in points], np.float64), is_closed=False)


def _closed(points: Floats, is_closed: bool) -> Floats | None:
    """Return the corners of an outline, without the first one again; None if it is open."""
    size = float(np.ptp(points, axis=0).max()) if len(points) > 1 else 0.0
    if size and np.abs(points[0] - points[-1]).max() <= CLOSED * size:
        return points[:-1]
    return points if is_closed else None


def _in_world(entity: Any, points: Floats | None, height: float) -> Floats | None:
    """Return points (n, 2) of an entity's own plane as (n, 3) of the drawing."""
    if points is None or not len(points):
        return None
    heights = np.full((len(points), 1), height)
    return np.array([tuple(p) for p in entity.ocs().points_to_wcs(np.hstack((points, heights)).tolist())], np.float64)


def _with_arcs(points: Floats, is_closed: bool, tolerance: float) -> Floats | None:
    """
    Return the corners (n, 2) of a polyline whose arcs are chords.

    ``points`` (n, 3): x, y, and the bulge of the arc to the next point, the tangent of a quarter of its angle, positive if
    counter-clockwise.
    """
    size = float(np.ptp(points[:, :2], axis=0).max()) if len(points) > 1 else 0.0
    if not is_closed and (not size or np.abs(points[0, :2] - points[-1, :2]).max() > CLOSED * size):
        return None
    corners = []
    for (x, y, bulge), (end_x, end_y, _) in zip(points, np.roll(points, -1, axis=0), strict=True):
        start, chord = complex(x, y), complex(end_x - x, end_y - y)
        if bulge and chord:
            radius = abs(chord) * (1.0 + bulge * bulge) / (4.0 * abs(bulge))
            angle = 4.0 * np.arctan(bulge)
            step = 2.0 * np.arccos(max(1.0 - tolerance / radius, 0.0))
            n = int(min(max(np.ceil(abs(angle) / step), 1), MAX_CHORDS))
            centre = start + 0.5 * chord * (1.0 + 1j * (1.0 - bulge * bulge) / (2.0 * bulge))
            corners += (centre + (start - centre) * np.exp(1j * angle * np.arange(n) / n)).tolist()
        else:
            corners.append(start)
    found = np.array(corners, complex)
    kept = np.append(found[1:] != found[:-1], found[0] != found[-1])
    return np.stack((found.real, found.imag), axis=1)[kept]


def _boundaries(hatch: Any, tolerance: float) -> list[Floats | None]:
    """Return the corners of the boundaries of a hatch."""
    elevation = float(hatch.dxf.get("elevation", (0.0, 0.0, 0.0))[2])
    found = []
    for boundary in hatch.paths:
        if hasattr(boundary, "vertices"):
            points = np.array(boundary.vertices, np.float64).reshape(-1, 3)
            found.append(_with_arcs(points, True, tolerance))
            continue
        corners: list[tuple[float, ...]] = []
        for edge in boundary.edges:
            part = _edge(edge, tolerance)
            if (
                corners
                and np.abs(np.subtract(corners[-1], part[0])).max() > np.abs(np.subtract(corners[-1], part[-1])).max()
            ):
                part = part[::-1]  # edges may have any direction
            corners += part if not corners else part[1:]
        found.append(_closed(np.array(corners, np.float64).reshape(-1, 2), is_closed=False))
    return [_in_world(hatch, points, elevation) for points in found]


def _edge(edge: Any, tolerance: float) -> list[tuple[float, float]]:
    """Return the points of an edge of a hatch in its plane."""
    from ezdxf.math import ConstructionArc

    kind = edge.EDGE_TYPE
    if kind == "LineEdge":
        points = [edge.start, edge.end]
    elif kind == "ArcEdge":
        arc = ConstructionArc(edge.center, edge.radius, edge.start_angle, edge.end_angle)
        points = list(arc.flattening(tolerance))
    else:
        tool = edge.construction_tool()
        points = list(tool.flattening(tolerance))
    return [(float(point[0]), float(point[1])) for point in points]


def _width(entity: Any, kind: str) -> bool:
    """Return whether a polyline is drawn with a width, so that it is a band and no outline."""
    if kind == "LWPOLYLINE":
        return bool(entity.dxf.get("const_width", 0.0)) or any(
            start or end for start, end in entity.get_points(format="se")
        )
    if kind == "POLYLINE":
        return bool(entity.dxf.get("default_start_width", 0.0) or entity.dxf.get("default_end_width", 0.0))
    return False


def _shape(corners: list[Floats]) -> Any:
    """Return the polygon of a ring, or the area of several ones by the even-odd rule."""
    polygons = [shapely.Polygon(ring[:, :2]) for ring in corners]
    if len(polygons) == 1:
        return polygons[0]
    area = polygons[0]
    for polygon in polygons[1:]:
        area = shapely.symmetric_difference(area, polygon)
    return area


def _is_dxf(_path: Path, head: bytes) -> bool:
    """Return whether a file begins with comments, or with a section of a drawing."""
    if head.startswith(BINARY_MAGIC):
        return True
    lines = [line.strip() for line in head.removeprefix(b"\xef\xbb\xbf").split(b"\n")]
    while len(lines) > 1 and lines[0] == b"999":
        lines = lines[2:]
    return lines[:2] == [b"0", b"SECTION"]


def _example(path: Path) -> tuple[Layout, dict[str, Any]]:
    groups = [0, "SECTION", 2, "ENTITIES"]
    for x in (0.0, 3.0):
        groups += [0, "POLYLINE", 8, "PIXEL", 66, 1, 70, 1, 10, 0.0, 20, 0.0, 30, 0.0]
        for dx, dy in ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)):
            groups += [0, "VERTEX", 8, "PIXEL", 10, x + dx, 20, dy, 30, 0.0]
        groups += [0, "SEQEND", 8, "PIXEL"]
    path.write_text("\n".join(map(str, [*groups, 0, "ENDSEC", 0, "EOF", ""])))
    squares = Layout.from_rectangles([[1.0, 1.0], [4.0, 1.0]], 2.0, layer=np.array(["PIXEL", "PIXEL"]))
    return squares, {"unit": "um"}


FORMATS.register(
    "dxf",
    FileFormat(
        title="DXF",
        suffixes=(".dxf",),
        matches=_is_dxf,
        read=read,
        read_options=("layer", "unit", "invalid", "parts", "max_sagitta_um"),
    ),
    example=_example,
)

"""
Flattened polygons of GDSII and OASIS files, read by gdstk in the sandbox process.

The module imports no other module of the package, which makes the process start quickly.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterator
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["FormatError", "read"]

#: Prefix of cells that KLayout adds for its own metadata.
KLAYOUT_METADATA = "$$$CONTEXT_INFO$$$"
#: Number of names in a message.
MAX_LISTED = 5
#: Memory in bytes per vertex and per polygon while cells are flattened: source, copies and concatenation.
VERTEX_BYTES, POLYGON_BYTES = 48, 192
#: Limit of the polygons copied between cells, as a multiple of the maximum number of sites.
MAX_COPY_RATIO = 2
#: Attributes of the GDSII properties for the number of a photosite and for its columns.
NUMBER_PROPERTY, COLUMNS_PROPERTY = 1, 2
NUMBER = re.compile(r"photosite ([0-9]{1,9})(?: part ([0-9]{1,9}) of ([0-9]{1,9}))?\0*")
MAX_SITE = 10**9
#: Maximum number of names and values of a shape's columns, and maximum length of their string.
MAX_WORDS = 128
MAX_CHARS = 1024


class FormatError(Exception):
    """The file is rejected; the message follows its path."""


class Shapes:
    """
    Polygons of a flattened cell.

    Attributes
    ----------
    xy : (n_vertex, 2) float64, in database units
    counts : (n,) int64
        Vertices of each polygon.
    tags : (n, 7) int64
        Layer, datatype, photosite (-1: unknown), part and number of parts (0: undivided), placement of the cell, line of
        its columns in the text of all columns (-1: none).
    n_placements : int
        Number of placements of the cell.
    """

    def __init__(self, xy: NDArray[np.float64], counts: NDArray[np.int64], tags: NDArray[np.int64], n: int) -> None:
        self.xy = xy
        self.counts = counts
        self.tags = tags
        self.n_placements = n

    def place(self, matrix: NDArray[np.float64], offsets: NDArray[np.float64]) -> Shapes:
        """Return copies at all offsets, transformed by the matrix."""
        import numpy as np

        k = len(offsets)
        transformed = self.xy @ matrix.T
        xy = (transformed[np.newaxis] + offsets[:, np.newaxis]).reshape(-1, 2)
        tags = np.tile(self.tags, (k, 1))
        tags[:, 5] += np.repeat(np.arange(k) * self.n_placements, len(self.tags))
        return Shapes(xy, np.tile(self.counts, k), tags, k * self.n_placements)


def read(
    path: str,
    *,
    limit: Callable[[str, int], None],
    is_oasis: bool,
    layer: int | None,
    cell: str | None,
    max_sites: int,
    max_memory_bytes: int,
    max_text_bytes: int,
    max_cpu_s: int,
) -> tuple[dict[str, Any], list[Any]]:
    """
    Read a cell with its complete hierarchy.

    Parameters
    ----------
    path : str
    limit : callable
        Function that sets limits of memory and processor time. Tighter limits apply while gdstk reads the file.
    is_oasis : bool
    layer, cell : optional
        Layer and cell selected by the user.
    max_sites, max_memory_bytes, max_text_bytes, max_cpu_s : int
        Limits of the flattened content.

    Returns
    -------
    about : dict
        Database unit ``dbu_um`` and name ``cell``.
    arrays : list
        ``xy`` in database units, ``counts``, ``tags`` (see :class:`Shapes`), and the text of all columns.

    Raises
    ------
    FormatError
        When the file is rejected.
    """
    import gdstk

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        library = (gdstk.read_oas if is_oasis else gdstk.read_gds)(path)
    if is_oasis and caught:
        # gdstk drops the rest of an OASIS file after an unknown record; GDSII records contain their lengths.
        raise FormatError(f"is corrupt, or contains elements that gdstk does not support ({caught[0].message})")
    dbu_um = library.precision * 1e6
    if not (math.isfinite(dbu_um) and 1e-9 <= dbu_um <= 1e3 and 1e-12 <= library.unit <= 1.0):
        raise FormatError(f"has the invalid database unit {dbu_um:g} µm")
    cells = {cell.name: cell for cell in library.cells}
    top = _top_cell(cells, cell)
    order = _post_order(cells, top)
    _check_numbers(cells, order, max_sites, max_memory_bytes)
    # Memory and time of the following steps are bounded.
    limit("RLIMIT_AS", max_memory_bytes)
    limit("RLIMIT_CPU", max_cpu_s)
    flat: dict[str, Shapes] = {}
    lines: list[str] = []
    last_use = {child: name for name in order for child in _children(cells, name)}
    for name in order:
        flat[name] = _flatten(cells[name], flat, lines, library.unit * 1e6, dbu_um)
        for child in _children(cells, name):
            if last_use[child] == name:
                del flat[child]
    shapes = _select_layer(flat[top], layer)
    text = _column_lines(shapes, lines, max_text_bytes)
    return {"dbu_um": dbu_um, "cell": top}, [shapes.xy, shapes.counts, shapes.tags, text]


# -- cells ------------------------------------------------------------------------------------------------------------


def _top_cell(cells: dict[str, Any], wanted: str | None) -> str:
    """Return the name of the cell to read."""
    if wanted is not None:
        if wanted not in cells:
            closest = get_close_matches(wanted, cells, n=1)
            hint = f"did you mean {closest[0]!r}? " if closest else ""
            raise FormatError(f"has no cell {wanted!r}; {hint}possible: {_format_names(cells)}")
        return wanted
    below = {reference.cell_name for cell in cells.values() for reference in cell.references}
    tops = [n for n, c in cells.items() if n not in below and not n.startswith(KLAYOUT_METADATA)]
    if len(tops) > 1:
        tops = [name for name in tops if _has_shapes(cells[name]) or cells[name].references] or tops[:1]
    if not tops:
        raise FormatError("has no top cell: it is empty, or its cells contain each other")
    if len(tops) > 1:
        raise FormatError(f"has several top cells, {_format_names(tops)}; select one with cell=")
    return tops[0]


def _post_order(cells: dict[str, Any], top: str) -> list[str]:
    """Return the names of a cell and its hierarchy, subcells before their parents."""
    order: list[str] = []
    is_open = {top: True}
    stack: list[tuple[str, Iterator[str]]] = [(top, _children(cells, top))]
    while stack:
        name, children = stack[-1]
        child = next(children, None)
        if child is None:
            stack.pop()
            order.append(name)
            is_open[name] = False
        elif child not in is_open:
            is_open[child] = True
            stack.append((child, _children(cells, child)))
        elif is_open[child]:
            raise FormatError(f"has a cell that contains itself, {child!r}")
    return order


def _children(cells: dict[str, Any], name: str) -> Iterator[str]:
    for child in dict.fromkeys(reference.cell_name for reference in cells[name].references):
        if child not in cells:
            raise FormatError(f"references the cell {child!r}, which it does not contain")
        yield child


def _check_numbers(cells: dict[str, Any], order: list[str], max_sites: int, max_memory_bytes: int) -> None:
    """Reject a hierarchy that would flatten to too many sites or too much memory or time."""
    n_polygons: dict[str, int] = {}
    n_vertices: dict[str, int] = {}
    max_vertices = max_memory_bytes // VERTEX_BYTES
    n_copied = 0
    for name in order:
        cell = cells[name]
        references = [(r.cell_name, _n_copies(r)) for r in cell.references]
        own = sum(map(_n_copies, cell.polygons)) + sum(map(_n_copies, cell.paths))
        n_polygons[name] = own + sum(k * n_polygons[c] for c, k in references)
        n_copied += n_polygons[name]
        # References to empty cells require time, too.
        if max(n_polygons[name], sum(k for _, k in references)) > max_sites or n_copied > MAX_COPY_RATIO * max_sites:
            raise FormatError(f"has more than the maximum of {max_sites} sites")
        n_vertices[name] = _count_vertices(cell, max_vertices) + sum(k * n_vertices[c] for c, k in references)
        if VERTEX_BYTES * n_vertices[name] + POLYGON_BYTES * n_polygons[name] > max_memory_bytes:
            raise FormatError("would flatten to more sites and vertices than the maximum for a file of its size")


def _count_vertices(cell: Any, max_vertices: int) -> int:
    """
    Count the vertices of a cell's polygons and paths.

    Counting stops when the number exceeds ``max_vertices``, as paths may have very many vertices.
    """
    n = sum(p.size * _n_copies(p) for p in cell.polygons)
    for path in cell.paths:
        if n > max_vertices:
            break
        n += _n_copies(path) * sum(p.size for p in path.to_polygons())
    return n


def _n_copies(element: Any) -> int:
    """
    Return the number of repetitions of an element.

    For arrays, columns times rows can exceed the size that gdstk reports.
    """
    repetition = element.repetition
    n = repetition.size if repetition.columns is None else repetition.columns * repetition.rows
    return max(1, n)


def _format_names(names: Any) -> str:
    shown = list(names)
    return ", ".join(f"{n!r:.40}" for n in shown[:MAX_LISTED]) + (", ..." if len(shown) > MAX_LISTED else "")


# -- shapes -----------------------------------------------------------------------------------------------------------


def _has_shapes(cell: Any) -> bool:
    return bool(cell.polygons or cell.paths)


def _flatten(cell: Any, flat: dict[str, Shapes], lines: list[str], unit_um: float, dbu_um: float) -> Shapes:
    """
    Return the polygons of a cell and its hierarchy, in database units.

    The column strings of the polygons are appended to ``lines``.
    """
    import numpy as np

    parts = [_own_shapes(cell, lines, unit_um, dbu_um)]
    n_placements = 1
    groups: dict[tuple[Any, ...], list[NDArray[np.float64]]] = {}
    for r in cell.references:
        offsets = np.asarray(r.repetition.get_offsets(), dtype=np.float64).reshape(-1, 2)
        offsets = offsets if len(offsets) else np.zeros((1, 2))
        key = (r.cell_name, r.rotation or 0.0, r.magnification or 1.0, bool(r.x_reflection))
        groups.setdefault(key, []).append(np.asarray(r.origin) + offsets)
    for (name, angle_rad, magnification, is_mirrored), origins in groups.items():
        matrix = _rotation(angle_rad) @ np.diag([magnification, -magnification if is_mirrored else magnification])
        copies = flat[name].place(matrix, np.rint(np.concatenate(origins) * (unit_um / dbu_um)))
        copies.tags[:, 5] += n_placements
        n_placements += copies.n_placements
        parts.append(copies)
    parts = [p for p in parts if p.counts.size] or parts[:1]
    if len(parts) == 1:
        return Shapes(parts[0].xy, parts[0].counts, parts[0].tags, n_placements)
    return Shapes(
        np.concatenate([p.xy for p in parts]),
        np.concatenate([p.counts for p in parts]),
        np.concatenate([p.tags for p in parts]),
        n_placements,
    )


def _rotation(angle_rad: float) -> NDArray[np.float64]:
    """Return the matrix of a counter-clockwise rotation, exact for multiples of 90°."""
    import numpy as np

    quarters = angle_rad / (0.5 * math.pi)
    is_quarter = abs(quarters - round(quarters)) < 1e-9
    exact = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarters) % 4]
    c, s = exact if is_quarter else (math.cos(angle_rad), math.sin(angle_rad))
    return np.array([[c, -s], [s, c]])


def _own_shapes(cell: Any, lines: list[str], unit_um: float, dbu_um: float) -> Shapes:
    """Return the polygons of one cell, with paths as polygons and repetitions expanded."""
    import numpy as np

    polygons = list(cell.polygons)
    for p in cell.polygons:
        if p.repetition.size:
            # Copies are separate photosites, although they have the same number.
            polygons += p.apply_repetition()
    for path in cell.paths:
        polygons += [q for p in (path, *path.apply_repetition()) for q in p.to_polygons()]
    points = [p.points for p in polygons]
    counts = np.fromiter(map(len, points), np.int64, len(points))
    xy = np.concatenate(points) if points else np.zeros((0, 2))
    del points
    xy *= unit_um / dbu_um
    np.rint(xy, out=xy)
    tags = np.array([(p.layer, p.datatype, *_site(p), 0, -1) for p in polygons], np.int64).reshape(-1, 7)
    strings = [_columns(p) for p in polygons]
    tags[:, 6] = np.where(list(map(bool, strings)), len(lines) + np.arange(len(strings)), -1)
    lines += strings
    return Shapes(xy, counts, tags, 1)


def _site(polygon: Any) -> tuple[int, int, int]:
    """Return photosite, part and number of parts from the properties of a polygon."""
    text = polygon.get_gds_property(NUMBER_PROPERTY)
    match = NUMBER.fullmatch(text) if isinstance(text, str) else None
    if match:
        return int(match[1]), int(match[2] or 0), int(match[3] or 0)
    numbers = polygon.get_property("photosite")
    if not numbers or not all(isinstance(n, int) and 0 <= n < MAX_SITE for n in numbers):
        return -1, 0, 0
    return (numbers[0], numbers[1], numbers[2]) if len(numbers) == 3 else (numbers[0], 0, 0)


def _columns(polygon: Any) -> str:
    """Return a polygon's column string of words ``name=value``, empty where it has none."""
    text = polygon.get_gds_property(COLUMNS_PROPERTY)
    if text is None:
        values = polygon.get_property("columns")
        if not values or len(values) % 2 or len(values) > MAX_WORDS:
            return ""
        words = [v.decode("ascii", "replace") if isinstance(v, bytes) else str(v) for v in values]
        text = " ".join(map("=".join, zip(words[::2], words[1::2], strict=True)))
    if not isinstance(text, str):
        return ""
    text = text.rstrip("\0")
    return text if len(text) <= MAX_CHARS and text.isascii() and text.isprintable() else ""


def _column_lines(shapes: Shapes, lines: list[str], max_bytes: int) -> NDArray[np.uint8]:
    """
    Return the distinct column strings of the shapes, one per line.

    The tags of the shapes are renumbered accordingly. The result is empty if a shape has no columns.
    """
    import numpy as np

    used, tags = np.unique(shapes.tags[:, 6], return_inverse=True)
    shapes.tags[:, 6] = tags
    if used.size == 0 or used[0] < 0:
        return np.zeros(0, np.uint8)
    used_lines = lines if used.size == len(lines) else [lines[i] for i in used.tolist()]
    n_bytes = sum(map(len, used_lines)) + len(used_lines)
    return np.frombuffer("\n".join(used_lines).encode(), np.uint8) if n_bytes <= max_bytes else np.zeros(0, np.uint8)


def _select_layer(shapes: Shapes, wanted: int | None) -> Shapes:
    """Return the polygons on the layer of the photosites."""
    import numpy as np

    layers = np.unique(shapes.tags[:, 0])
    if wanted is None and layers.size > 1:
        raise FormatError(f"has shapes on several layers, {_format_names(layers.tolist())}; select one with layer=")
    if wanted is None or layers.tolist() == [wanted]:
        return shapes
    if wanted not in layers:
        raise FormatError(
            f"has no shape on layer {wanted}; its layers with shapes are {_format_names(layers.tolist())}"
        )
    is_wanted = shapes.tags[:, 0] == wanted
    is_selected_vertex = np.repeat(is_wanted, shapes.counts)
    return Shapes(shapes.xy[is_selected_vertex], shapes.counts[is_wanted], shapes.tags[is_wanted], shapes.n_placements)

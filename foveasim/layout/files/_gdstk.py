"""
Flattened polygons of GDSII and OASIS files, read by gdstk in the sandbox process.

The module imports only one other module of the package, which imports none: the process starts quickly.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim.layout.files._paths import CIRCLE_TOLERANCE, disc, n_vertices_of_disc, path_outline

#: Prefix of cells with the metadata of KLayout: their references and shapes only carry properties.
KLAYOUT_METADATA = "$$$CONTEXT_INFO$$$"
#: Number of names in a message.
MAX_LISTED = 5
#: Memory in bytes per vertex and per polygon while cells are flattened: source, copies and concatenation.
VERTEX_BYTES, POLYGON_BYTES = 48, 224
#: Limit of the polygons copied between cells, as a multiple of the maximum number of sites.
MAX_COPY_RATIO = 2
#: Attributes of the GDSII properties for the number of a photosite and for its columns.
NUMBER_PROPERTY, COLUMNS_PROPERTY = 1, 2
UNDIVIDED = re.compile(r"^photosite ([0-9]{1,9})\0*$", re.MULTILINE)
NUMBER = re.compile(r"photosite ([0-9]{1,9})(?: part ([0-9]{1,9}) of ([0-9]{1,9}))?\0*")
#: Numbers of the sites of an array: number of the first site, steps from column to column and from row to row, columns, rows.
NUMBERS = re.compile(
    r"photosites ([0-9]{1,9})(?:([+-][0-9]{1,9})i)?(?:([+-][0-9]{1,9})j)? of ([0-9]{1,9})x([0-9]{1,9})\0*"
)
MAX_SITE = 10**9
#: Maximum number of names and values of a shape's columns, and maximum length of their string.
MAX_WORDS = 128
MAX_CHARS = 1024
#: Vertices of paths and circles are not on the database grid; those within this distance are.
SAME_DBU = 1e-6
#: Tolerance with which gdstk approximates circles by few vertices.
MAX_TOLERANCE_UM = 1e9
#: Beginning of the warning of gdstk that a cell is missing.
MISSING_REFERENCE = "Missing reference"


class FormatError(Exception):
    """The file is rejected; the message follows its path."""


class Shapes(NamedTuple):
    """
    Polygons of a flattened cell.

    ``xy`` (n_vertex, 2), in database units. ``counts`` (n,): vertices of each polygon. ``tags`` (n, 9): layer, datatype,
    photosite (-1: unknown), part and number of parts (0: undivided), placement of the cell, line of its columns in the text of
    all columns (-1: none), index in its array (column + 2^32 row), filter with the outline of the photosite (index in the list
    of filters, -1: none). ``n_placements``: number of placements of the cell.
    """

    xy: NDArray[np.float64]
    counts: NDArray[np.int64]
    tags: NDArray[np.int64]
    n_placements: int

    def place(self, matrix: NDArray[np.float64], offsets: NDArray[np.float64]) -> Shapes:
        """Return copies at all offsets, transformed by the matrix."""
        k = len(offsets)
        transformed = self.xy @ matrix.T
        xy = (transformed[np.newaxis] + offsets[:, np.newaxis]).reshape(-1, 2)
        tags = np.tile(self.tags, (k, 1))
        tags[:, 5] += np.repeat(np.arange(k) * self.n_placements, len(self.tags))
        return Shapes(xy, np.tile(self.counts, k), tags, k * self.n_placements)

    def place_sites(
        self, matrix: NDArray[np.float64], offsets: NDArray[np.float64], identity: NDArray[np.int64]
    ) -> Shapes:
        """
        Return copies each of which is one site.

        ``identity`` (n, 3): photosite, line of its columns and index in its array, of each copy.
        """
        copies = self.place(matrix, offsets)
        copies.tags[:, 5] = 0
        of_shape = np.repeat(identity, len(self.tags), axis=0)
        copies.tags[:, 2] = np.where(copies.tags[:, 2] < 0, -1, of_shape[:, 0])
        copies.tags[:, 6:8] = of_shape[:, 1:]
        return copies._replace(n_placements=0)

    def is_site(self) -> bool:
        """Return whether the shapes are those of one site, so that copies are numbered."""
        return self.n_placements == 1 and self.tags.size > 0 and bool((self.tags[:, 2] <= 0).all())

    def select(self, chosen: NDArray[np.bool_]) -> Shapes:
        """Return the chosen shapes."""
        if chosen.all():
            return self
        return Shapes(
            self.xy[np.repeat(chosen, self.counts)], self.counts[chosen], self.tags[chosen], self.n_placements
        )


def read(
    path: str,
    *,
    limit: Callable[[str, int], None],
    is_oasis: bool,
    layers: list[tuple[int, int | None]] | None,
    filters: list[tuple[int, int | None]],
    cell: str | None,
    max_sites: int,
    max_memory_bytes: int,
    max_text_bytes: int,
    max_cpu_s: int,
    source: str | None = None,
    circles: str | None = None,
    ambiguous: Sequence[str] = (),
    missing: str = "error",
    circle_tolerance: float = CIRCLE_TOLERANCE,
) -> tuple[dict[str, Any], list[Any]]:
    """
    Read a cell with its complete hierarchy.

    ``limit``: function that sets limits of memory and processor time. Tighter limits apply while gdstk reads the file.
    ``layers``: layers of the photosites; a datatype of None stands for all. ``filters``: layers of the colour filters.
    ``cell``: cell selected by the user. ``max_sites``, ``max_memory_bytes``, ``max_text_bytes``, ``max_cpu_s``: limits of the
    flattened content. ``source``, ``circles``: files with the edited content and with the circles, see
    :class:`foveasim.layout.files._source.Source`. ``ambiguous``: names that several cells had. ``missing``: ``"skip"`` ignores
    references to cells that the file does not contain. ``circle_tolerance``: of discs and round ends.

    Returns ``about``: database unit ``dbu_um``, name ``cell``, ``layers`` of the photosites, names of ``missing`` cells, and
    whether there are ``arcs``. ``arrays``: ``xy`` in database units, ``counts``, ``tags`` (see :class:`Shapes`) of the
    photosites, the text of their columns, and the same three arrays of the filters without the outline of a photosite.
    """
    import gdstk

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        # The tolerance of gdstk is an absolute one; circles are replaced below.
        library = (gdstk.read_oas if is_oasis else gdstk.read_gds)(source or path, tolerance=MAX_TOLERANCE_UM)
    problems = [str(w.message) for w in caught if not str(w.message).startswith(MISSING_REFERENCE)]
    if is_oasis and problems:
        # gdstk drops the rest of an OASIS file after a problem.
        raise FormatError(f"is corrupt: gdstk stops with {problems[0]!r}")
    dbu_um = library.precision * 1e6
    if not (math.isfinite(dbu_um) and 1e-9 <= dbu_um <= 1e3 and 1e-12 <= library.unit <= 1.0):
        raise FormatError(f"has the invalid database unit {dbu_um:g} µm")
    radii = _radii(circles)
    radii_of = {cell.name: radii.get(k, {}) for k, cell in enumerate(library.cells)}
    cells = {cell.name: cell for cell in library.cells if not cell.name.startswith(KLAYOUT_METADATA)}
    children = _Children(cells, set(ambiguous), is_skipped=missing == "skip")
    top = _top_cell(cells, cell)
    order = _post_order(children, top)
    found = _layers_with_shapes(cells, order)
    layers = _layers_of_sites(found, layers, filters)
    is_site = {key for key in found if _last_match(key, layers) >= 0}
    filter_of = {key: k for key in found if (k := _last_match(key, filters)) >= 0}
    arcs = _Arcs(library.unit * 1e6 / dbu_um, n_vertices_of_disc(circle_tolerance))
    selected = {name: _Selected(cells[name], is_site, filter_of, radii_of[name], arcs) for name in order}
    _check_numbers(children, order, selected, max_sites, max_memory_bytes)
    # Memory and time of the following steps are bounded.
    limit("RLIMIT_AS", max_memory_bytes)
    limit("RLIMIT_CPU", max_cpu_s)
    flat: dict[str, Shapes] = {}
    lines: list[str] = []
    last_use = {child: name for name in order for child in children.of(name)}
    for name in order:
        references = children.references(name)
        flat[name] = _flatten(references, selected.pop(name), flat, lines, library.unit * 1e6, dbu_um)
        for child in children.of(name):
            if last_use[child] == name:
                del flat[child]
    is_on_site_layer = np.isin(
        flat[top].tags[:, 0] << 32 | flat[top].tags[:, 1], [n << 32 | kind for n, kind in is_site]
    )
    sites, covers = flat[top].select(is_on_site_layer), flat[top].select(~is_on_site_layer)
    text = _column_lines(sites, lines, max_text_bytes)
    about = {
        "dbu_um": dbu_um,
        "cell": top,
        "layers": layers,
        "missing": sorted(children.missing),
        "arcs": arcs.are_used,
    }
    return about, [sites.xy, sites.counts, sites.tags, text, covers.xy, covers.counts, covers.tags]


# -- layers -----------------------------------------------------------------------------------------------------------


def _last_match(key: tuple[int, int], layers: list[tuple[int, int | None]]) -> int:
    """Return the index of the last layer of a list that is or contains a layer and datatype."""
    layer, datatype = key
    return max(
        (k for k, (number, kind) in enumerate(layers) if number == layer and kind in (None, datatype)), default=-1
    )


def _layers_with_shapes(cells: dict[str, Any], order: list[str]) -> dict[tuple[int, int], bool]:
    """Return the layers with shapes, and whether a shape has the number of a photosite."""
    found: dict[tuple[int, int], bool] = {}
    for name in order:
        in_cell: dict[tuple[int, int], Any] = {}
        for polygon in cells[name].polygons:
            in_cell.setdefault((polygon.layer, polygon.datatype), polygon)
        for path in cells[name].paths:
            in_cell.update(dict.fromkeys(zip(path.layers, path.datatypes, strict=False)))
        for key, polygon in in_cell.items():
            found[key] = found.get(key, False) or (polygon is not None and _site(polygon)[0] >= 0)
    return found


def _layers_of_sites(
    found: dict[tuple[int, int], bool],
    wanted: list[tuple[int, int | None]] | None,
    filters: list[tuple[int, int | None]],
) -> list[tuple[int, int | None]]:
    """
    Return the layers of the photosites.

    By default these are the layers of the shapes with numbers of photosites, or the only layer with shapes besides the filters.
    If all shapes are on the layers of filters, these are the layers of the photosites.
    """
    if wanted is not None:
        for number, kind in wanted:
            if not any(number == n and kind in (None, d) for n, d in found):
                text = f"{number}" if kind is None else f"{number}/{kind}"
                raise FormatError(f"has no shape on layer {text}; its layers with shapes are {_format_layers(found)}")
        return wanted
    numbered = [key for key, is_numbered in found.items() if is_numbered]
    if filters and not numbered:
        others = [key for key in found if _last_match(key, filters) < 0]
        if not others:
            return [filters[k] for k in sorted({_last_match(key, filters) for key in found})]
        found = dict.fromkeys(others, False)
    layers = {number for number, _ in numbered} or {number for number, _ in found}
    if len(layers) > 1:
        raise FormatError(f"has shapes on several layers, {_format_layers(found)}; select one with layer=")
    if numbered and any(number in layers and not is_numbered for (number, _), is_numbered in found.items()):
        return [(number, kind) for number, kind in numbered]
    return [(number, None) for number in layers]


def _format_layers(found: Any) -> str:
    return _format_names(f"{number}/{kind}" for number, kind in sorted(found)) or "none"


# -- cells ------------------------------------------------------------------------------------------------------------


def _top_cell(cells: dict[str, Any], wanted: str | None) -> str:
    """Return the name of the cell to read."""
    if wanted is not None:
        if wanted not in cells:
            from difflib import get_close_matches

            closest = get_close_matches(wanted, cells, n=1)
            hint = f"did you mean {closest[0]!r}? " if closest else ""
            raise FormatError(f"has no cell {wanted!r}; {hint}possible: {_format_names(f'{n!r:.40}' for n in cells)}")
        return wanted
    below = {reference.cell_name for cell in cells.values() for reference in cell.references}
    tops = [n for n in cells if n not in below]
    if len(tops) > 1:
        tops = [n for n in tops if cells[n].polygons or cells[n].paths or cells[n].references] or tops[:1]
    if not tops:
        raise FormatError("has no top cell: it is empty, or its cells contain each other")
    if len(tops) > 1:
        raise FormatError(f"has several top cells, {_format_names(f'{n!r:.40}' for n in tops)}; select one with cell=")
    return tops[0]


class _Children:
    """
    References between the cells, without those to missing ones if these ``are_skipped``.

    ``missing``: names of the missing cells so far.
    """

    def __init__(self, cells: dict[str, Any], ambiguous: set[str], *, is_skipped: bool) -> None:
        self.cells, self.ambiguous, self.is_skipped = cells, ambiguous, is_skipped
        self.missing: set[str] = set()

    def references(self, name: str) -> list[Any]:
        """Return the references of a cell to other cells."""
        return [r for r in self.cells[name].references if r.cell_name in self.cells]

    def of(self, name: str) -> Iterator[str]:
        """Yield the names of the cells that a cell contains."""
        for child in dict.fromkeys(reference.cell_name for reference in self.cells[name].references):
            if child in self.cells:
                if child in self.ambiguous:
                    raise FormatError(
                        f"references the cell {child!r:.40} in {name!r:.40}, but contains several different cells of this "
                        "name; give each its own name"
                    )
                yield child
            elif self.is_skipped:
                self.missing.add(child)
            else:
                raise FormatError(
                    f"references the cell {child!r:.40} in {name!r:.40}, which it does not contain; add the cell, or pass "
                    "missing='skip' to read the others"
                )


def _post_order(cells: _Children, top: str) -> list[str]:
    """Return the names of a cell and its hierarchy, subcells before their parents."""
    order: list[str] = []
    is_open = {top: True}
    stack: list[tuple[str, Iterator[str]]] = [(top, cells.of(top))]
    while stack:
        name, children = stack[-1]
        child = next(children, None)
        if child is None:
            stack.pop()
            order.append(name)
            is_open[name] = False
        elif child not in is_open:
            is_open[child] = True
            stack.append((child, cells.of(child)))
        elif is_open[child]:
            raise FormatError(f"has a cell that contains itself, {child!r}")
    return order


def _radii(file: str | None) -> dict[int, dict[int, int]]:
    """Return the radii of the circles, in database units, by cell and index of the polygon."""
    radii: dict[int, dict[int, int]] = {}
    if file is not None:
        for cell, polygon, radius in np.load(file, allow_pickle=False).tolist():
            radii.setdefault(cell, {})[polygon] = radius
    return radii


class _Arcs:
    """
    Polygons of paths and of circles.

    ``scale``: database units per unit of gdstk. ``n``: vertices of a disc. ``are_used``: whether an outline has arcs.
    """

    def __init__(self, scale: float, n: int) -> None:
        self.scale, self.n, self.are_used = scale, n, False

    def of_path(self, path: Any) -> Any:
        """Return the polygon of a path, with its repetition and properties."""
        half = 0.5 * float(np.rint(path.widths()[0, 0] * self.scale))
        end = path.ends[0]
        ends: tuple[float, float] | None = None
        if end == "round":
            self.are_used = True
        elif isinstance(end, str):
            ends = (0.0, 0.0) if end == "flush" else (half, half)
        else:
            ends = (round(end[0] * self.scale), round(end[1] * self.scale))
        outline = path_outline(np.rint(path.spine() * self.scale), half, ends, self.n)
        return self._polygon(outline, path, path.layers[0], path.datatypes[0])

    def of_circle(self, polygon: Any, radius: int) -> Any:
        """Return the polygon of a circle."""
        self.are_used = True
        centre = np.rint(polygon.points.mean(axis=0) * self.scale)
        return self._polygon(disc(centre, radius, self.n), polygon, polygon.layer, polygon.datatype)

    def _polygon(self, outline: NDArray[np.float64], element: Any, layer: int, datatype: int) -> Any:
        import gdstk

        points: Any = outline / self.scale
        polygon = gdstk.Polygon(points, layer, datatype)
        polygon.properties, polygon.repetition = element.properties, element.repetition
        return polygon


class _Selected:
    """
    Shapes of a cell on the layers of photosites and filters, paths and circles as polygons.

    A filter with the outline of a photosite in the same cell covers no other photosite. It is not expanded with the
    hierarchy: its index is an attribute of the photosite.

    ``polygons``: the filters that are not attributes follow the photosites. ``filters``: filter of each polygon, -1 for none.
    ``copies``: number of repetitions of each polygon. ``is_on_grid``: whether all vertices are multiples of the database unit.
    """

    def __init__(
        self,
        cell: Any,
        is_site: set[tuple[int, int]],
        filter_of: dict[tuple[int, int], int],
        radii: dict[int, int],
        arcs: _Arcs,
    ) -> None:
        layers = is_site | filter_of.keys()
        polygons = cell.polygons
        for i, radius in radii.items():
            if (polygons[i].layer, polygons[i].datatype) in layers:
                polygons[i] = arcs.of_circle(polygons[i], radius)
        paths = [p for p in cell.paths if (p.layers[0], p.datatypes[0]) in layers]
        self.is_on_grid = not radii and not paths
        polygons += map(arcs.of_path, paths)
        self.filter_of = filter_of
        self.polygons = [p for p in polygons if (p.layer, p.datatype) in is_site]
        self.filters = [filter_of.get((p.layer, p.datatype), -1) for p in self.polygons] if filter_of else []
        if filter_of:
            self._add_filters([p for p in polygons if (p.layer, p.datatype) in filter_of.keys() - is_site])
        else:
            self.filters = [-1] * len(self.polygons)
        self.copies = list(map(_n_copies, self.polygons))

    def _add_filters(self, filters: list[Any]) -> None:
        sites: dict[bytes, list[int]] = {}
        for i, site in enumerate(self.polygons):
            if _n_copies(site) == 1:
                sites.setdefault(site.points.tobytes(), []).append(i)
        for polygon in filters:
            k = self.filter_of[polygon.layer, polygon.datatype]
            twins = sites.get(polygon.points.tobytes(), []) if _n_copies(polygon) == 1 else []
            if twins and all(self.filters[i] in (-1, k) for i in twins):
                for i in twins:
                    self.filters[i] = k
            else:
                self.polygons.append(polygon)
                self.filters.append(-1)

    def count_polygons(self) -> int:
        """Count polygons, with their repetitions."""
        return sum(self.copies)

    def count_vertices(self) -> int:
        """Count the vertices of polygons, with their repetitions."""
        return sum(p.size * k for p, k in zip(self.polygons, self.copies, strict=True))


def _check_numbers(
    cells: _Children, order: list[str], selected: dict[str, _Selected], max_sites: int, max_memory_bytes: int
) -> None:
    """Reject a hierarchy that would flatten to too many sites or too much memory or time."""
    n_polygons: dict[str, int] = {}
    n_vertices: dict[str, int] = {}
    n_copied = 0
    for name in order:
        references = [(r.cell_name, _n_copies(r)) for r in cells.references(name)]
        n_polygons[name] = selected[name].count_polygons() + sum(k * n_polygons[c] for c, k in references)
        n_copied += n_polygons[name]
        if n_polygons[name] > max_sites or n_copied > MAX_COPY_RATIO * max_sites:
            raise FormatError(f"has more than the maximum of {max_sites} sites")
        n_vertices[name] = selected[name].count_vertices() + sum(k * n_vertices[c] for c, k in references)
        if VERTEX_BYTES * n_vertices[name] + POLYGON_BYTES * n_polygons[name] > max_memory_bytes:
            raise FormatError(
                f"has more than the maximum for a file of its size: {n_polygons[name]} sites and filters with "
                f"{n_vertices[name]} vertices; write it without arrays (hierarchy=False), or read fewer layers"
            )


def _n_copies(element: Any) -> int:
    """
    Return the number of repetitions of an element.

    For arrays, columns times rows can exceed the size that gdstk reports.
    """
    repetition = element.repetition
    columns = repetition.columns
    return max(1, repetition.size if columns is None else columns * repetition.rows)


def _format_names(names: Iterable[str]) -> str:
    shown = list(names)
    return ", ".join(shown[:MAX_LISTED]) + ", ..." * (len(shown) > MAX_LISTED)


# -- shapes -----------------------------------------------------------------------------------------------------------


def _flatten(
    references: list[Any], selected: _Selected, flat: dict[str, Shapes], lines: list[str], unit_um: float, dbu_um: float
) -> Shapes:
    """
    Return the polygons of a cell and of its references, in database units.

    The column strings of the polygons and of numbered references are appended to ``lines``.
    """
    parts = [_shapes_of_cell(selected, lines, unit_um, dbu_um)]
    n_placements = 1
    groups: dict[tuple[Any, ...], list[NDArray[np.float64]]] = {}
    numbered: dict[tuple[Any, ...], tuple[list[NDArray[np.float64]], list[NDArray[np.int64]]]] = {}
    for r in references:
        if flat[r.cell_name].counts.size == 0:
            continue
        offsets = np.asarray(r.repetition.get_offsets(), dtype=np.float64).reshape(-1, 2)
        offsets = offsets if len(offsets) else np.zeros((1, 2))
        key = (r.cell_name, r.rotation or 0.0, r.magnification or 1.0, bool(r.x_reflection))
        positions = np.asarray(r.origin) + offsets
        identity = _site_numbers(r, offsets, len(lines)) if flat[r.cell_name].is_site() else None
        if identity is None:
            groups.setdefault(key, []).append(positions)
        else:
            lines.append(_columns(r))
            places, identities = numbered.setdefault(key, ([], []))
            places.append(positions)
            identities.append(identity)
    for (name, *transformation), origins in groups.items():
        copies = flat[name].place(_matrix(*transformation), np.rint(np.concatenate(origins) * (unit_um / dbu_um)))
        copies.tags[:, 5] += n_placements
        n_placements += copies.n_placements
        parts.append(copies)
    for (name, *transformation), (origins, identities) in numbered.items():
        offsets = np.rint(np.concatenate(origins) * (unit_um / dbu_um))
        parts.append(flat[name].place_sites(_matrix(*transformation), offsets, np.concatenate(identities)))
    parts = [p for p in parts if p.counts.size] or parts[:1]
    if len(parts) == 1:
        return parts[0]._replace(n_placements=n_placements)
    xy, counts, tags = (np.concatenate([getattr(p, name) for p in parts]) for name in ("xy", "counts", "tags"))
    return Shapes(xy, counts, tags, n_placements)


def _matrix(angle_rad: float, magnification: float, is_mirrored: bool) -> NDArray[np.float64]:
    """Return the matrix of a reference: mirrored at the x axis, magnified, rotated."""
    return _rotation(angle_rad) @ np.diag([magnification, -magnification if is_mirrored else magnification])


def _site_numbers(reference: Any, offsets: NDArray[np.float64], line: int) -> NDArray[np.int64] | None:
    """
    Return the identities of the copies of a numbered reference, or None.

    These are photosite, line of the columns and index in the array, (n, 3). Columns and rows follow from the offsets, as
    programs store arrays in different orders. An array that another program changed has no numbers.
    """
    number = _array_number(reference)
    if number is None:
        return None
    first, step_i, step_j, n_x, n_y = number
    (x, i), (y, j) = (np.unique(np.rint(offsets[:, axis] * 1e6), return_inverse=True) for axis in (0, 1))
    sites = first + step_i * i + step_j * j
    is_valid = sites.min() >= 0 and sites.max() < MAX_SITE
    if (x.size, y.size) != (n_x, n_y) or len(offsets) != n_x * n_y or not is_valid:
        return None
    return np.stack((sites, np.full(len(offsets), line), i + (j << 32)), axis=1)


def _array_number(reference: Any) -> tuple[int, int, int, int, int] | None:
    """Return first site, steps, columns and rows from the properties of a reference."""
    text = _property(reference, NUMBER_PROPERTY)
    if text is not None:
        match = NUMBERS.fullmatch(text) or NUMBER.fullmatch(text)
        if match is None or (match.re is NUMBER and match[2]):
            return None
        first, step_i, step_j, n_x, n_y = (int(n or 0) for n in (*match.groups(), *("0", "0"))[:5])
        return (first, step_i, step_j, n_x, n_y) if match.re is NUMBERS else (first, 0, 0, 1, 1)
    numbers = reference.get_property("photosites")
    if numbers and len(numbers) == 5 and all(isinstance(n, int) and abs(n) < MAX_SITE for n in numbers):
        return numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    numbers = reference.get_property("photosite")
    if numbers and len(numbers) == 1 and isinstance(numbers[0], int) and 0 <= numbers[0] < MAX_SITE:
        return numbers[0], 0, 0, 1, 1
    return None


def _rotation(angle_rad: float) -> NDArray[np.float64]:
    """Return the matrix of a counter-clockwise rotation, exact for multiples of 90°."""
    quarters = angle_rad / (0.5 * math.pi)
    is_quarter = abs(quarters - round(quarters)) < 1e-9
    exact = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarters) % 4]
    c, s = exact if is_quarter else (math.cos(angle_rad), math.sin(angle_rad))
    return np.array([[c, -s], [s, c]])


def _shapes_of_cell(selected: _Selected, lines: list[str], unit_um: float, dbu_um: float) -> Shapes:
    """Return the polygons of one cell, with repetitions expanded."""
    polygons, filters = list(selected.polygons), list(selected.filters)
    for i, n in enumerate(selected.copies):
        if n > 1:
            # Copies are separate photosites, although they have the same number.
            copies = selected.polygons[i].apply_repetition()
            polygons += copies
            filters += [filters[i]] * len(copies)
    # An outline of fewer vertices has no area, and is an invalid one of the file.
    points = [p.points if p.size > 2 else np.resize(p.points, (3, 2)) for p in polygons]
    counts = np.fromiter(map(len, points), np.int64, len(points))
    xy = np.concatenate(points) if points else np.zeros((0, 2))
    del points
    xy *= unit_um / dbu_um
    if selected.is_on_grid:
        np.rint(xy, out=xy)
    else:
        on_grid = np.rint(xy)
        np.copyto(xy, on_grid, where=np.abs(xy - on_grid) < SAME_DBU)
    strings = _column_strings(polygons)
    tags = np.zeros((len(polygons), 9), np.int64)
    tags[:, 0] = [p.layer for p in polygons]
    tags[:, 1] = [p.datatype for p in polygons]
    tags[:, 2:5] = _sites(polygons)
    tags[:, 6] = np.where(np.fromiter(map(bool, strings), bool, len(strings)), len(lines) + np.arange(len(strings)), -1)
    tags[:, 8] = filters
    lines += strings
    return Shapes(xy, counts, tags, 1)


def _sites(polygons: list[Any]) -> Any:
    """Return photosite, part and number of parts of each polygon, (n, 3)."""
    texts = [_property(p, NUMBER_PROPERTY) for p in polygons]
    known = [text for text in texts if text is not None]
    if len(known) == len(texts):
        # The fast way is right only if every string is one line, and every line matches.
        text = "\n".join(known)
        numbers = UNDIVIDED.findall(text)
        if len(numbers) == len(texts) == text.count("\n") + 1:
            table = np.zeros((len(texts), 3), np.int64)
            table[:, 0] = list(map(int, numbers))
            return table
    return np.array(list(map(_site, polygons)), np.int64).reshape(-1, 3)


def _site(polygon: Any) -> tuple[int, int, int]:
    """Return photosite, part and number of parts from the properties of a polygon."""
    text = _property(polygon, NUMBER_PROPERTY)
    match = None if text is None else NUMBER.fullmatch(text)
    if match:
        return int(match[1]), int(match[2] or 0), int(match[3] or 0)
    numbers = polygon.get_property("photosite")
    if not numbers or not all(isinstance(n, int) and 0 <= n < MAX_SITE for n in numbers):
        return -1, 0, 0
    return (numbers[0], numbers[1], numbers[2]) if len(numbers) == 3 else (numbers[0], 0, 0)


def _property(element: Any, attribute: int) -> str | None:
    """Return a GDSII property, or None if it is missing or not UTF-8 (bytes in gdstk)."""
    text = element.get_gds_property(attribute)
    return text if isinstance(text, str) else None


def _column_strings(polygons: list[Any]) -> list[str]:
    """Return the column string of each polygon, empty where it has none."""
    texts = [_property(p, COLUMNS_PROPERTY) for p in polygons]
    known = [text.rstrip("\0") for text in texts if text is not None]
    if known and len(known) == len(texts):
        text = "".join(known)
        if text.isascii() and text.isprintable() and max(map(len, known)) <= MAX_CHARS:
            return known
    return list(map(_columns, polygons))


def _columns(element: Any) -> str:
    """Return the column string of a polygon or reference, empty where it has none."""
    text = _property(element, COLUMNS_PROPERTY)
    if text is None:
        values = element.get_property("columns")
        if not values or len(values) % 2 or len(values) > MAX_WORDS:
            return ""
        words = [v.decode("ascii", "replace") if isinstance(v, bytes) else str(v) for v in values]
        text = " ".join(map("=".join, zip(words[::2], words[1::2], strict=True)))
    text = text.rstrip("\0")
    return text if len(text) <= MAX_CHARS and text.isascii() and text.isprintable() else ""


def _column_lines(shapes: Shapes, lines: list[str], max_bytes: int) -> NDArray[np.uint8]:
    """
    Return the distinct column strings of the shapes, one per line.

    The tags of the shapes are renumbered accordingly. The result is empty if a shape has no columns.
    """
    used, tags = np.unique(shapes.tags[:, 6], return_inverse=True)
    shapes.tags[:, 6] = tags
    if used.size == 0 or used[0] < 0:
        return np.zeros(0, np.uint8)
    used_lines = lines if used.size == len(lines) else [lines[i] for i in used.tolist()]
    n_bytes = sum(map(len, used_lines)) + len(used_lines)
    return np.frombuffer("\n".join(used_lines).encode(), np.uint8) if n_bytes <= max_bytes else np.zeros(0, np.uint8)

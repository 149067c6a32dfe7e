"""
A program of its own that reads GDSII and OASIS through gdstk, flattened: a broken or hostile file can only end *it*.

Started by ``gds.py`` with a task as JSON on standard input; answers with JSON on standard output, and leaves the
polygons as arrays in the file that the task names. It loads nothing of the package, so that it starts quickly.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__: list[str] = []

#: Cells that KLayout adds for its own use begin with this.
KLAYOUT_NOTES = "$$$CONTEXT_INFO$$$"
#: How many names a message shows.
SHOWN = 5


class Refusal(Exception):  # noqa: N818 -- not an error of this program, but its answer
    """The file is refused, in one sentence that follows its name."""


class Shapes:
    """
    Flat polygons of a cell.

    Attributes
    ----------
    xy : (n_vertex, 2) float64, in database units
    counts : (n,) int64
        Vertices of each polygon.
    tags : (n, 6) int64
        Layer, data type, photosite (-1: not told), part and number of parts (0: whole), placement of the cell.
    n_placements : int
    """

    def __init__(self, xy: NDArray[np.float64], counts: NDArray[np.int64], tags: NDArray[np.int64], n: int) -> None:
        self.xy = xy
        self.counts = counts
        self.tags = tags
        self.n_placements = n

    def placed(self, matrix: NDArray[np.float64], offsets: NDArray[np.float64]) -> Shapes:
        """Copies at all offsets, each turned and scaled by the matrix."""
        import numpy as np

        k = len(offsets)
        turned = self.xy @ matrix.T
        xy = (turned[np.newaxis] + offsets[:, np.newaxis]).reshape(-1, 2)
        tags = np.tile(self.tags, (k, 1))
        tags[:, 5] += np.repeat(np.arange(k) * self.n_placements, len(self.tags))
        return Shapes(xy, np.tile(self.counts, k), tags, k * self.n_placements)


def main() -> None:
    """Do the task."""
    task = json.load(sys.stdin)
    _limit(task)
    sys.path[:] = task["sys_path"]
    try:
        answer = _read(task)
    except Refusal as refusal:
        answer = {"refused": str(refusal)}
    except MemoryError:
        answer = {"refused": "asks for more memory than any layout needs"}
    except Exception as error:  # noqa: BLE001 -- whatever a broken file makes its reader trip over
        answer = {"broken": " ".join(str(error).split()) or type(error).__name__}
    sys.stdout.write(json.dumps(answer))


def _limit(task: dict[str, Any]) -> None:
    """Bounds of memory and time, where the system has them."""
    try:
        import resource
    except ImportError:
        return
    for kind, most in (
        (resource.RLIMIT_AS, task["max_memory_bytes"]),
        (resource.RLIMIT_CPU, task["max_s"]),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        bound = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (bound, hard))


def _read(task: dict[str, Any]) -> dict[str, Any]:
    import gdstk
    import numpy as np

    read = gdstk.read_oas if task["is_oasis"] else gdstk.read_gds
    library = read(task["path"])
    dbu_um = library.precision * 1e6
    if not (math.isfinite(dbu_um) and 1e-9 <= dbu_um <= 1e3 and 1e-12 <= library.unit <= 1.0):
        raise Refusal(f"has the impossible database unit {dbu_um:g} µm")
    cells = {cell.name: cell for cell in library.cells}
    top = _top(cells, task["cell"])
    order = _from_the_bottom(cells, top)
    _check_numbers(cells, order, task)
    flat: dict[str, Shapes] = {}
    for name in order:
        flat[name] = _flat(cells[name], flat, library.unit * 1e6, dbu_um)
    shapes = _on_one_layer(flat[top], task["layer"])
    with open(task["out"], "wb") as file:  # noqa: PTH123 -- a plain name from the task
        for array in (shapes.xy, shapes.counts, shapes.tags):
            np.save(file, array, allow_pickle=False)
    return {"dbu_um": dbu_um, "cell": top}


# -- cells ------------------------------------------------------------------------------------------------------------


def _top(cells: dict[str, Any], wanted: str | None) -> str:
    """Name of the cell to read."""
    if wanted is not None:
        if wanted not in cells:
            raise Refusal(f"has no cell {wanted!r}; its cells are {_listed(cells)}")
        return wanted
    below = {reference.cell_name for cell in cells.values() for reference in cell.references}
    tops = [n for n, c in cells.items() if n not in below and not n.startswith(KLAYOUT_NOTES)]
    if len(tops) > 1:
        tops = [name for name in tops if _own(cells[name]) or cells[name].references] or tops[:1]
    if not tops:
        raise Refusal("has no cell on top: it is empty, or its cells hold each other")
    if len(tops) > 1:
        raise Refusal(f"has several cells on top, {_listed(tops)}; say which to read with cell=")
    return tops[0]


def _from_the_bottom(cells: dict[str, Any], top: str) -> list[str]:
    """Names of the cells below and including one, each after those that it holds."""
    order: list[str] = []
    is_open = {top: True}
    stack: list[tuple[str, Iterator[str]]] = [(top, _held(cells, top))]
    while stack:
        name, held = stack[-1]
        child = next(held, None)
        if child is None:
            stack.pop()
            order.append(name)
            is_open[name] = False
        elif child not in is_open:
            is_open[child] = True
            stack.append((child, _held(cells, child)))
        elif is_open[child]:
            raise Refusal(f"has a cell that holds itself, {child!r}")
    return order


def _held(cells: dict[str, Any], name: str) -> Iterator[str]:
    for child in dict.fromkeys(reference.cell_name for reference in cells[name].references):
        if child not in cells:
            raise Refusal(f"refers to the cell {child!r}, which is not in it")
        yield child


def _check_numbers(cells: dict[str, Any], order: list[str], task: dict[str, Any]) -> None:
    """Refuse what would flatten to more than any sensor has, before it is done."""
    n_polygons: dict[str, int] = {}
    n_vertices: dict[str, int] = {}
    for name in order:
        cell = cells[name]
        polygons = [(p.size, _times(p)) for p in cell.polygons]
        polygons += [(2, _times(path)) for path in cell.paths]
        references = [(r.cell_name, _times(r)) for r in cell.references]
        n_polygons[name] = sum(k for _, k in polygons) + sum(k * n_polygons[c] for c, k in references)
        n_vertices[name] = sum(n * k for n, k in polygons) + sum(k * n_vertices[c] for c, k in references)
        # A reference without shapes costs as well.
        if max(n_polygons[name], sum(k for _, k in references)) > task["max_sites"]:
            raise Refusal(f"has more than the {task['max_sites']} sites that are read")
        if n_vertices[name] > task["max_vertices"]:
            raise Refusal(f"has more than the {task['max_vertices']} vertices that are read")


def _times(element: Any) -> int:
    """How often an element stands there."""
    return max(1, element.repetition.size)


def _listed(names: Any) -> str:
    shown = list(names)
    return ", ".join(f"{n!r:.40}" for n in shown[:SHOWN]) + (", ..." if len(shown) > SHOWN else "")


# -- shapes -----------------------------------------------------------------------------------------------------------


def _own(cell: Any) -> bool:
    return bool(cell.polygons or cell.paths)


def _flat(cell: Any, flat: dict[str, Shapes], unit_um: float, dbu_um: float) -> Shapes:
    """The polygons of a cell and of all cells below, in database units."""
    import numpy as np

    parts = [_own_shapes(cell, unit_um, dbu_um)]
    n_placements = 1
    groups: dict[tuple[Any, ...], list[NDArray[np.float64]]] = {}
    for r in cell.references:
        offsets = np.asarray(r.repetition.get_offsets(), dtype=np.float64).reshape(-1, 2)
        offsets = offsets if len(offsets) else np.zeros((1, 2))
        key = (r.cell_name, r.rotation or 0.0, r.magnification or 1.0, bool(r.x_reflection))
        groups.setdefault(key, []).append(np.asarray(r.origin) + offsets)
    for (name, angle_rad, magnification, is_mirrored), places in groups.items():
        matrix = _turn(angle_rad) @ np.diag([magnification, -magnification if is_mirrored else magnification])
        copies = flat[name].placed(matrix, np.rint(np.concatenate(places) * (unit_um / dbu_um)))
        copies.tags[:, 5] += n_placements
        n_placements += copies.n_placements
        parts.append(copies)
    if len(parts) == 1:
        return parts[0]
    return Shapes(
        np.concatenate([p.xy for p in parts]),
        np.concatenate([p.counts for p in parts]),
        np.concatenate([p.tags for p in parts]),
        n_placements,
    )


def _turn(angle_rad: float) -> NDArray[np.float64]:
    """Matrix of a counter-clockwise turn; quarter turns are exact."""
    import numpy as np

    quarters = angle_rad / (0.5 * math.pi)
    is_quarter = abs(quarters - round(quarters)) < 1e-9
    exact = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarters) % 4]
    c, s = exact if is_quarter else (math.cos(angle_rad), math.sin(angle_rad))
    return np.array([[c, -s], [s, c]])


def _own_shapes(cell: Any, unit_um: float, dbu_um: float) -> Shapes:
    """The polygons of one cell, paths as polygons, repetitions written out."""
    import numpy as np

    polygons = list(cell.polygons)
    for p in cell.polygons:
        if p.repetition.size:
            # Copies are other photosites than the one whose number they carry.
            polygons += p.apply_repetition()
    for path in cell.paths:
        polygons += [q for p in (path, *path.apply_repetition()) for q in p.to_polygons()]
    points = [p.points for p in polygons]
    xy = np.rint(np.concatenate(points) * (unit_um / dbu_um)) if points else np.zeros((0, 2))
    counts = np.fromiter(map(len, points), np.int64, len(points))
    tags = np.array([(p.layer, p.datatype, *_site(p.properties), 0) for p in polygons], np.int64).reshape(-1, 6)
    return Shapes(xy, counts, tags, 1)


def _site(properties: Any) -> tuple[int, int, int]:
    """Photosite, part and number of parts that a polygon's properties tell."""
    for name, *values in properties:
        if name == "S_GDS_PROPERTY" and len(values) == 2 and values[0] == 1 and isinstance(values[1], bytes):
            words = values[1].rstrip(b"\0").split()
            numbers = [int(w) for w in words[1::2] if w.isdigit() and len(w) < 10]
            if words[::2] in ([b"photosite"], [b"photosite", b"part", b"of"]) and len(numbers) == len(words) // 2:
                break
        elif name == "photosite" and all(isinstance(v, int) and 0 <= v < 10**9 for v in values):
            numbers = values
            break
    else:
        return -1, 0, 0
    return (numbers[0], numbers[1], numbers[2]) if len(numbers) == 3 else (numbers[0] if numbers else -1, 0, 0)


def _on_one_layer(shapes: Shapes, wanted: int | None) -> Shapes:
    """Those polygons that are photosites."""
    import numpy as np

    layers = np.unique(shapes.tags[:, 0])
    if wanted is None and layers.size > 1:
        raise Refusal(f"has shapes on the layers {_listed(layers.tolist())}; say which to read with layer=")
    if wanted is None or layers.tolist() == [wanted]:
        return shapes
    if wanted not in layers:
        raise Refusal(f"has no shape on layer {wanted}; there are some on {_listed(layers.tolist())}")
    is_wanted = shapes.tags[:, 0] == wanted
    is_kept_vertex = np.repeat(is_wanted, shapes.counts)
    return Shapes(shapes.xy[is_kept_vertex], shapes.counts[is_wanted], shapes.tags[is_wanted], shapes.n_placements)


if __name__ == "__main__":
    main()

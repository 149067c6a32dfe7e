"""
Integer encoding of surfaces for the page of solids.

Vertices lie on an integer lattice, sorted by photosite. Photosites of equal shape have equal triangles, with indices relative
to their first point, and most points are above or next to the previous one. The arrays therefore compress to a fraction of the
size of glTF.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.rings import positions_in_runs
from foveasim._core.validation import Ints
from foveasim.errors import GeometryError, ParameterError
from foveasim.layout import Layout
from foveasim.view.meshes import Mesh
from foveasim.view.web._pack import back_references, to_smallest_type

#: Largest number of lattice steps along the longest side of all surfaces: differences are exact in int32.
MAX_STEPS = 2**30
#: Smallest number of lattice steps: the resolution of float32.
MIN_STEPS = 2**24
#: Steps across the smallest photosite or part, if MAX_STEPS allows it.
STEPS_PER_FEATURE = 2**12
#: Photosites per tile; tiles out of view are not drawn.
SITES_PER_TILE = 1500


def bodies_of(meshes: Sequence[Mesh], layout: Layout) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """
    Return surfaces as plain data and arrays for ``bodies.js``.

    ``meshes``: closed surfaces of photosites of the layout; photosite -1 stands for none. Returns ``about``: ``lattice_um``,
    ``origin_um``, the bounding box ``low_um`` and ``high_um``, and the ``list`` of surfaces. ``arrays``: ``position_x``,
    ``position_y``: lattice steps from one position to the next; ``positions``: position of each point, as back references;
    ``z``: height of each point on the lattice; ``run_sites``: site + 1 of each run of points, with ``run_points``,
    ``run_triangles``, ``run_colours`` of each run; ``corners``: triangles, as indices relative to the first point of their
    run; ``tile_runs``: number of runs of each tile. Raises GeometryError when there are no triangles. Raises ParameterError
    when a triangle spans several photosites, a photosite is not in the layout, or a part has several colours at a photosite.
    """
    meshes = [mesh for mesh in meshes if mesh.triangles.size]
    if not meshes:
        raise GeometryError("the solids must have at least one triangle, got none")
    for mesh in meshes:
        _check(mesh, layout.n_sites)
    low_um = np.min([mesh.bounds_um[0] for mesh in meshes], axis=0)
    high_um = np.max([mesh.bounds_um[1] for mesh in meshes], axis=0)
    lattice_um = _lattice_um(meshes, layout, float((high_um - low_um).max()))
    origin_um = 0.5 * (low_um + high_um)
    points = np.rint((np.concatenate([mesh.points_um for mesh in meshes]) - origin_um) / lattice_um).astype(np.int64)
    _, position = np.unique((points[:, 0] << 32) + points[:, 1], return_inverse=True)
    tile_of_site = _tiles(layout)
    pieces = []
    start = 0
    for mesh in meshes:
        stop = start + mesh.points_um.shape[0]
        pieces.append(_runs(mesh, position[start:stop], tile_of_site, start))
        start = stop
    order = np.concatenate([piece.pop("order") for piece in pieces])
    position, first = _by_first_occurrence(position[order])
    arrays = {key: np.concatenate([piece[key] for piece in pieces]) for key in pieces[0]}
    position_points = points[order][first]
    arrays |= {
        "position_x": np.diff(position_points[:, 0], prepend=0),
        "position_y": np.diff(position_points[:, 1], prepend=0),
        "positions": back_references(position),
        "z": points[order, 2],
    }
    about = {
        "lattice_um": lattice_um,
        "origin_um": origin_um.tolist(),
        "low_um": low_um.tolist(),
        "high_um": high_um.tolist(),
        "list": [
            {
                "name": mesh.name,
                "n_runs": int(piece["run_sites"].size),
                "n_tiles": int(piece["tile_runs"].size),
            }
            for mesh, piece in zip(meshes, pieces, strict=True)
        ],
    }
    return about, {key: to_smallest_type(values) for key, values in arrays.items()}


def _check(mesh: Mesh, n_sites: int) -> None:
    site = mesh.photosite[mesh.triangles]
    if (site != site[:, :1]).any():
        raise ParameterError("solids", f"must have triangles of one photosite each, got others in {mesh.name!r}")
    if mesh.photosite.min() < -1 or mesh.photosite.max() >= n_sites:
        raise ParameterError("solids", f"must be of photosites 0 to {n_sites - 1:,}, got others in {mesh.name!r}")
    colour_of_site = np.zeros((n_sites + 1, 3), np.uint8)
    colour_of_site[mesh.photosite] = mesh.colours
    if not np.array_equal(colour_of_site[mesh.photosite], mesh.colours):
        raise ParameterError("solids", f"must have one colour per photosite and part, got several in {mesh.name!r}")


def _lattice_um(meshes: Sequence[Mesh], layout: Layout, extent_um: float) -> float:
    """Return the lattice step that resolves the smallest photosite and the thinnest part."""
    thickness_um = np.array([high[2] - low[2] for low, high in (mesh.bounds_um for mesh in meshes)])
    feature_um = min(float(np.sqrt(layout.area_um2.min())), float(thickness_um[thickness_um > 0.0].min(initial=np.inf)))
    return max(extent_um / MAX_STEPS, min(extent_um / MIN_STEPS, feature_um / STEPS_PER_FEATURE))


def _tiles(layout: Layout) -> Ints:
    """Return the tile of each photosite, (n_site,), in rows over the layout's bounds."""
    n = max(1, round(np.sqrt(layout.n_sites / SITES_PER_TILE)))
    x_min, y_min, x_max, y_max = layout.bounds_um
    fraction = (layout.centroid_um - (x_min, y_min)) / np.maximum((x_max - x_min, y_max - y_min), np.finfo(float).tiny)
    column, row = np.clip((n * fraction).astype(np.int64), 0, n - 1).T
    return row * n + column


def _runs(mesh: Mesh, position: Ints, tile_of_site: Ints, offset: int) -> dict[str, NDArray[Any]]:
    """
    Sort points and triangles of a surface by tile and photosite.

    Points of a photosite at the same position are contiguous.
    """
    site = mesh.photosite.astype(np.int64)
    tile = np.append(tile_of_site, 0)[site]  # the last entry: no photosite
    rank_of_site = np.empty(tile_of_site.size + 1, np.int64)
    by_tile = np.lexsort((np.arange(tile_of_site.size + 1), np.append(tile_of_site, 0)))
    rank_of_site[by_tile] = np.arange(by_tile.size)
    rank = rank_of_site[site]
    _, first, same = np.unique(rank * (int(position.max()) + 1) + position, return_index=True, return_inverse=True)
    order = np.lexsort((first[same], rank))
    starts = np.flatnonzero(np.diff(rank[order], prepend=-1))
    counts = np.diff(starts, append=order.size)
    within = np.empty(order.size, np.int64)
    within[order] = positions_in_runs(counts)
    rank_of_triangle = rank[mesh.triangles[:, 0]]
    triangles = mesh.triangles[np.argsort(rank_of_triangle, kind="stable")]
    run_of_rank = np.searchsorted(rank[order][starts], rank_of_triangle)
    head = order[starts]
    return {
        "order": order + offset,
        "run_sites": site[head] + 1,
        "run_points": counts,
        "run_triangles": np.bincount(run_of_rank, minlength=starts.size),
        "run_colours": mesh.colours[head].ravel(),
        "corners": within[triangles].ravel(),
        "tile_runs": np.diff(np.flatnonzero(np.diff(tile[head], prepend=-1)), append=starts.size),
    }


def _by_first_occurrence(position: Ints) -> tuple[Ints, Ints]:
    """Number positions in order of first occurrence, and return where each occurs first."""
    n = int(position.max()) + 1
    first = np.empty(n, np.int64)
    first[position[::-1]] = np.arange(position.size)[::-1]  # the last write is the first occurrence
    by_first = np.argsort(first)
    rank = np.empty(n, np.int64)
    rank[by_first] = np.arange(n)
    return rank[position], first[by_first]

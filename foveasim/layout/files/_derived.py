"""
Derived layers of GDSII and OASIS files, computed from the outlines of the sites.

There are two kinds. A function of a layout returns one polygon per site; congruent sites are drawn once. A
:class:`LayoutLayer` returns the polygons of the complete layout.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.registry import Registry
from foveasim._core.validation import Floats, Ints, check_number
from foveasim.errors import ParameterError
from foveasim.layout.files._hierarchy import congruence_classes
from foveasim.layout.model import Layout

#: Corners are extended by at most this multiple of the offset.
MITRE_LIMIT = 100.0
#: Vertices are compared in units far below any database unit.
CONGRUENCE_UM = 1e-6
#: Sites whose neighbours are searched at once, which limits the memory.
QUERY_SITES = 2**17
#: Sites whose distances a message is based on.
SAMPLE_SITES = 1000


class LayoutLayer:
    """
    Derived layer of the complete layout: a function that returns any number of polygons.

    Parameters
    ----------
    function : callable
        Function of a layout, with keywords, that returns shapely polygons in µm.

    Examples
    --------
    >>> import shapely
    >>> from foveasim.layout import LayoutLayer, grid
    >>> @LayoutLayer
    ... def die(layout, *, margin_um=0.0):
    ...     return [shapely.box(*layout.bounds_um).buffer(margin_um, join_style="mitre")]
    >>> die(grid(n_x=4, n_y=3, pitch_um=2.0), margin_um=1.0)[0].area
    80.0
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self.function = function

    def __repr__(self) -> str:
        return f"LayoutLayer({getattr(self.function, '__name__', self.function)})"

    def __call__(self, layout: Layout, **parameters: Any) -> Any:
        """Return the polygons of a layout."""
        return self.function(layout, **parameters)


@dataclass(frozen=True)
class PlacedShapes:
    """
    Shapes that are repeated at several positions.

    ``polygons``: (n,) geometries, µm. ``shape`` (m,) int64: index of the polygon at each position. ``position_um``: (m, 2)
    float64, µm.
    """

    polygons: NDArray[Any]
    shape: Ints
    position_um: Floats


#: Function of a layout that returns one polygon per site, or layer of the complete layout.
DerivedLayer: TypeAlias = Callable[..., NDArray[Any]] | LayoutLayer
#: Derived layers by name: functions of a layout, with keywords, that return one polygon per site, (n_site,), in µm, or a
#: :class:`LayoutLayer`. A polygon of a site depends on the outline of this site only, because congruent sites are drawn once.
#: Installed packages add derived layers as entry points of the group ``foveasim.derived_layers``.
DERIVED_LAYERS: Registry[DerivedLayer] = Registry("derived layer", "foveasim.derived_layers")


@DERIVED_LAYERS.register("well", example={"inset_um": 0.5}, expected=16.0 * 81.0)
def _well(layout: Layout, *, inset_um: float = 0.1) -> NDArray[Any]:
    """Return the wells of the photodiodes: outlines with an inward offset, half a trench."""
    return _offset(layout.polygons(), -check_number("inset_um", inset_um, at_least=0.0))


@DERIVED_LAYERS.register("microlens", example={"inset_um": 1.0}, expected=16.0 * 64.0)
def _microlens(layout: Layout, *, inset_um: float = 0.0, corner_radius_um: float = 0.0) -> NDArray[Any]:
    """Return the bases of the microlenses: outlines without holes, inset, with round corners."""
    inset_um = check_number("inset_um", inset_um, at_least=0.0)
    radius_um = check_number("corner_radius_um", corner_radius_um, at_least=0.0)
    outlines = shapely.polygons(shapely.get_exterior_ring(layout.polygons()))
    return np.asarray(shapely.buffer(_offset(outlines, -inset_um - radius_um), radius_um, quad_segs=8))


@DERIVED_LAYERS.register("metal_keep_out", example={"outset_um": 0.5}, expected=41.0**2)
def _metal_keep_out(layout: Layout, *, outset_um: float = 0.0) -> NDArray[Any]:
    """Return the areas without metal: outlines with an outward offset, inward if negative."""
    return _offset(layout.polygons(), check_number("outset_um", outset_um))


@DERIVED_LAYERS.register("trench", example={"outset_um": 0.5, "inset_um": 0.5}, expected=41.0**2 - 16.0 * 81.0)
@LayoutLayer
def _trench(layout: Layout, *, outset_um: float = 0.0, inset_um: float = 0.0) -> PlacedShapes:
    """
    Return the area between sites and around them.

    It consists of the outlines with an outward offset, without those with an inward offset. Each shape is the area of one
    site: a frame, repeated for congruent sites, or where it reaches into other sites, the area outside these.
    """
    outset_um = check_number("outset_um", outset_um, at_least=0.0)
    inset_um = check_number("inset_um", inset_um, at_least=0.0)
    if outset_um + inset_um == 0.0:
        raise ParameterError("outset_um", "or 'inset_um' must be positive", 0.0, "µm", hint=_gap_hint(layout))
    xy = np.rint(layout.xy_um / CONGRUENCE_UM).astype(np.int64)
    found, origin = congruence_classes(xy, layout.ring_offsets, layout.site_offsets)
    _, first, shape = np.unique(found, return_index=True, return_inverse=True)
    position_um: Floats = np.asarray(origin * CONGRUENCE_UM, np.float64)
    models = _translate(layout[first].polygons(), -position_um[first])
    grown, kept = _offset(models, outset_um), _offset(models, -inset_um)
    frames = np.asarray(shapely.difference(grown, kept))
    site, other = _overlaps(grown, kept, shape, position_um)
    if site.size == 0:
        return PlacedShapes(frames, shape, position_um)
    crossing, group = np.unique(site, return_inverse=True)
    parts, group = _parts(_translate(kept[shape[other]], position_um[other]), group)
    around = shapely.multipolygons(parts, indices=group)
    remainders = shapely.difference(_translate(frames[shape[crossing]], position_um[crossing]), around)
    shape[crossing] = frames.size + np.arange(crossing.size)
    position_um[crossing] = 0.0
    return PlacedShapes(np.concatenate((frames, remainders)), shape, position_um)


def _overlaps(grown: NDArray[Any], kept: NDArray[Any], shape: Ints, position_um: Floats) -> tuple[Ints, Ints]:
    """Return pairs of a grown site and another site that it overlaps."""
    reach, boxes = (shapely.bounds(each)[shape] + np.tile(position_um, 2) for each in (grown, kept))
    # Abutting boxes do not overlap.
    reach += CONGRUENCE_UM * np.array([1.0, 1.0, -1.0, -1.0])
    tree = shapely.STRtree(shapely.box(*boxes.T))
    candidates = []
    for start in range(0, shape.size, QUERY_SITES):
        site, other = tree.query(shapely.box(*reach[start : start + QUERY_SITES].T))
        candidates.append(np.stack((site + start, other))[:, site + start != other])
    site, other = np.concatenate(candidates, axis=1) if candidates else np.zeros((2, 0), np.int64)
    inner = shapely.buffer(grown, -CONGRUENCE_UM, join_style="mitre")
    # Equal pairs of shapes at equal distances are compared once.
    step = np.rint((position_um[other] - position_um[site]) / CONGRUENCE_UM).astype(np.int64)
    pairs, index = np.unique(np.column_stack((shape[site], shape[other], step)), axis=0, return_inverse=True)
    a, b = inner[pairs[:, 0]], _translate(kept[pairs[:, 1]], pairs[:, 2:] * CONGRUENCE_UM)
    is_overlap = shapely.intersects(a, b)[index.reshape(-1)]
    return site[is_overlap], other[is_overlap]


def _parts(polygons: NDArray[Any], group: Ints) -> tuple[NDArray[Any], Ints]:
    """Return the polygons of all geometries, sorted by their groups, and the groups."""
    parts, index = shapely.get_parts(polygons, return_index=True)
    order = np.argsort(group[index], kind="stable")
    return parts[order], group[index][order]


def _gap_hint(layout: Layout) -> str:
    """Return parameters of a trench for the distances between the sites."""
    sample = layout[: min(layout.n_sites, SAMPLE_SITES)].polygons()
    (a, b), gap_um = shapely.STRtree(sample).query_nearest(sample, exclusive=True, return_distance=True)
    gap_um = gap_um[a != b]
    if gap_um.size and gap_um.min() > 0.0:
        return f"the gap between sites is {gap_um.min():.4g} µm, for example: outset_um={0.5 * gap_um.min():.4g}"
    return "the sites have no gaps, for example: inset_um=0.1"


def _offset(polygons: NDArray[Any], distance_um: float) -> NDArray[Any]:
    if distance_um == 0.0:
        return polygons
    return np.asarray(shapely.buffer(polygons, distance_um, join_style="mitre", mitre_limit=MITRE_LIMIT))


def _translate(polygons: NDArray[Any], by_um: Floats) -> NDArray[Any]:
    """Return the polygons, each displaced by its own distance, (n, 2)."""
    xy_um, index = shapely.get_coordinates(polygons, return_index=True)
    return np.asarray(shapely.set_coordinates(polygons.copy(), xy_um + by_um[index]))


# -- shapes for writers -----------------------------------------------------------------------------------------------


def shapes_of_sites(name: str, layout: Layout, parameters: Mapping[str, Any]) -> NDArray[Any]:
    """Return the polygons of a derived layer, one per site."""
    polygons = np.asarray(_call(name, layout, parameters))
    if polygons.shape != (layout.n_sites,) or not shapely.is_geometry(polygons).all():
        raise ParameterError(
            "layers",
            f"derived layer '{name}' must return one polygon for each of the {layout.n_sites} sites",
            hint="decorate a function that returns the polygons of the complete layout with LayoutLayer",
        )
    return polygons


def shapes_of_layout(name: str, layout: Layout, parameters: Mapping[str, Any]) -> PlacedShapes:
    """Return the polygons of a derived layer of the complete layout."""
    found = _call(name, layout, parameters)
    if isinstance(found, PlacedShapes):
        return found
    polygons = np.atleast_1d(np.asarray(found, dtype=object))
    is_polygon = [isinstance(each, shapely.Polygon | shapely.MultiPolygon) for each in polygons.flat]
    if polygons.ndim != 1 or not all(is_polygon):
        raise ParameterError("layers", f"derived layer '{name}' must return a sequence of shapely polygons")
    return PlacedShapes(polygons, np.arange(polygons.size), np.zeros((polygons.size, 2)))


def _call(name: str, layout: Layout, parameters: Mapping[str, Any]) -> Any:
    try:
        return DERIVED_LAYERS[name](layout, **parameters)
    except ParameterError as error:
        raise ParameterError(f"layers[{name}].{error.name}", error.detail) from None

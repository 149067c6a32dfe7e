"""Outlines of other programs: units of length, parts, planes, and invalid outlines."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
import shapely
from numpy.typing import NDArray

from foveasim._core.rings import SITE_ID, ring_area_um2, site_ids
from foveasim._core.validation import Floats, Ints
from foveasim._io.rasters.units import length_in_um
from foveasim.errors import FileError, GeometryError, LayoutWarning, warn
from foveasim.layout.files._common import layout_from_untrusted
from foveasim.layout.model import Layout
from foveasim.layout.packed import check_sizes

#: Units of length that users may state, and their sizes in µm.
LengthUnit: TypeAlias = Literal["nm", "um", "mm", "cm", "m", "mil", "in"]
LENGTHS_UM = {unit: size_um for unit in get_args(LengthUnit) if (size_um := length_in_um(unit)) is not None}
Invalid: TypeAlias = Literal["error", "skip", "repair"]
Parts: TypeAlias = Literal["error", "split", "largest"]

#: Integers up to this one are exact in float64.
MAX_EXACT = 2**53
#: Number of outlines that a message lists.
MAX_LISTED = 50
#: Differences of z, relative to the largest coordinate, up to which outlines lie in a plane: rounding of float32.
FLAT = 1e-6


def required_unit(path: Path, unit: str | None, why: str) -> float:
    """Return a unit in µm that must be stated; ``why`` completes the message where it is not."""
    if unit is None:
        raise FileError(path, f"{why}; if they are lengths in the sensor plane, state their unit: unit='um', 'mm', ...")
    return LENGTHS_UM[unit]


def agreed_unit(path: Path, unit: str | None, stated_um: float, name: str) -> float:
    """Return the unit in µm that a file states; another one is an error."""
    if unit is not None and not np.isclose(LENGTHS_UM[unit], stated_um, rtol=1e-9, atol=0.0):
        raise FileError(path, f"has coordinates in {name}, got unit='{unit}'; omit 'unit'")
    return stated_um


def check_plane(path: Path, z: NDArray[Any], extent: float) -> None:
    """Reject outlines that do not lie in a plane of constant z; NaN stands for no z."""
    z = z[np.isfinite(z)]
    if z.size and float(np.ptp(z)) > FLAT * max(extent, float(np.abs(z).max())):
        raise FileError(
            path,
            f"has outlines at several z, from {z.min():g} to {z.max():g}; a layout is a plane: project the outlines onto it",
        )


def layout_of_geometries(
    path: Path,
    geometries: NDArray[Any],
    columns: Mapping[str, NDArray[Any]],
    provenance: Mapping[str, Any],
    *,
    noun: str,
    unit_um: float = 1.0,
    invalid: Invalid = "error",
    parts: Parts = "error",
    problems: Mapping[int, str] | None = None,
) -> Layout:
    """
    Return the layout of geometries of a file.

    ``geometries`` (n,): shapely geometries or None. ``columns``: mapping of str to (n,) array. ``noun``: what a geometry is
    called in messages, ``"row"``. ``unit_um``: unit of the coordinates. ``problems``: why geometries are None, by their
    number. With ``parts="split"``, sites of multipolygons have the columns ``parent`` and ``part``. Raises FileError,
    GeometryError; warns of what is skipped or repaired.
    """
    is_empty = shapely.is_missing(geometries) | shapely.is_empty(geometries)
    kind = shapely.get_type_id(geometries)
    is_multiple = (kind == shapely.GeometryType.MULTIPOLYGON) & (shapely.get_num_geometries(geometries) > 1)
    is_area = (kind == shapely.GeometryType.POLYGON) | (kind == shapely.GeometryType.MULTIPOLYGON)
    is_bad = is_empty | ~is_area | (is_multiple & (parts == "error"))
    if is_bad.any():
        _report_unusable(path, geometries, is_bad, noun, invalid, problems or {})
    rows = np.flatnonzero(~is_bad)
    polygons, index = shapely.get_parts(geometries[rows], return_index=True)
    parent = rows[index]
    part = np.arange(parent.size) - np.searchsorted(parent, parent)
    if parts == "largest" and part.any():
        order = np.lexsort((part, -shapely.area(polygons), parent))
        chosen = np.sort(order[np.concatenate(([True], np.diff(parent[order]) != 0))])
        lost = 1.0 - shapely.area(polygons[chosen]).sum() / shapely.area(polygons).sum()
        n_lost = parent.size - chosen.size
        warn(f"{path.name}: {n_lost} smaller parts, {100 * lost:.2g} % of the area, are not read", LayoutWarning)
        polygons, parent, part = polygons[chosen], parent[chosen], np.zeros(chosen.size, np.int64)
    polygons = _in_um(path, polygons, unit_um)
    if invalid == "error":
        kept = np.arange(polygons.size)
    else:
        polygons, kept = valid_polygons(path, polygons, invalid)
    parent, part = parent[kept], part[kept]
    columns = {name: values[parent] for name, values in columns.items()}
    if parts == "split" and is_multiple.any():
        columns |= {"parent": parent, "part": part}
    try:
        return with_one_identity(layout_from_untrusted(polygons, columns, provenance), kept)
    except GeometryError as error:
        raise with_fix(path, error) if invalid == "error" else error from None


def grouped_polygons(polygons: NDArray[Any], polygons_of: Ints) -> NDArray[Any]:
    """Return a polygon, a multipolygon or None for each number of successive polygons."""
    found = np.full(polygons_of.size, None, dtype=object)
    first = np.cumsum(polygons_of) - polygons_of
    is_one = polygons_of == 1
    found[is_one] = polygons[first[is_one]]
    for i in np.flatnonzero(polygons_of > 1):
        found[i] = shapely.MultiPolygon(list(polygons[first[i] : first[i] + polygons_of[i]]))
    return found


def with_fix(path: Path, error: GeometryError) -> FileError:
    """Return the error of invalid sites of a file, with the options that read the others."""
    return FileError(path, f"{error}{', or pass invalid=' + repr('skip') if error.site_ids else ''}")


def _in_um(path: Path, polygons: NDArray[Any], unit_um: float) -> NDArray[Any]:
    """Return polygons in µm, without z."""
    if shapely.has_z(polygons).any():
        coordinates = shapely.get_coordinates(polygons, include_z=True)
        check_plane(path, coordinates[:, 2], float(np.abs(coordinates[:, :2]).max()))
        polygons = shapely.force_2d(polygons)
    return polygons if unit_um == 1.0 else np.asarray(shapely.transform(polygons, lambda xy: scaled(xy, unit_um)))


def scaled(values: Any, unit_um: float) -> Floats:
    """Return coordinates in µm; units below a µm divide, so that decimal numbers remain exact."""
    return np.asarray(values * unit_um if unit_um >= 1.0 else values / round(1.0 / unit_um, 9), dtype=np.float64)


def _report_unusable(
    path: Path, geometries: NDArray[Any], is_bad: Any, noun: str, invalid: str, problems: Mapping[int, str]
) -> None:
    """Raise for geometries that are no outlines, or warn that they are skipped."""
    bad = np.flatnonzero(is_bad).tolist()
    why = {number: problems.get(number) or _problem(geometries[number]) for number in bad[:MAX_LISTED]}
    more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
    if invalid == "error":
        fix = "pass parts='split' or 'largest'" if "parts" in why[bad[0]] else "correct it, or pass invalid='skip'"
        raise FileError(path, f"{noun} {bad[0]} {why[bad[0]]}{more}; {fix}")
    if len(bad) == geometries.size:
        raise FileError(path, f"has no outlines: {noun} {bad[0]} {why[bad[0]]}{more}")
    shown = ", ".join(f"{noun} {number} {text}" for number, text in why.items())
    warn(f"{path.name}: {len(bad)} of {geometries.size} are skipped: {shown}", LayoutWarning)


def _problem(geometry: Any) -> str:
    if geometry is None or geometry.is_empty:
        return "must be one polygon, got none"
    if isinstance(geometry, shapely.MultiPolygon):
        return f"must be one polygon, got one of {len(geometry.geoms)} parts"
    return f"must be one polygon, got {geometry.geom_type}"


def valid_polygons(path: Path, polygons: NDArray[Any], invalid: str) -> tuple[NDArray[Any], Ints]:
    """
    Return the valid polygons, repaired ones included, and their sites, ascending.

    Raises FileError when a polygon is invalid, and ``invalid`` is ``"error"``, or no valid polygon remains. Raises
    GeometryError when the layout is invalid for other reasons.
    """
    check_sizes(np.maximum(shapely.get_num_interior_rings(polygons), 0) + 1, shapely.get_num_coordinates(polygons))
    n_sites, site = polygons.size, np.arange(polygons.size)
    where: dict[int, str] = {}
    while True:
        try:
            Layout.from_polygons(polygons)
            break
        except GeometryError as error:
            bad = np.array(error.site_ids, np.int64)
            if bad.size == 0:
                raise
        # Repaired ones are checked again, and skipped if they are still invalid.
        new = [i for i in bad.tolist() if int(site[i]) not in where]
        where |= {int(site[i]): _place(polygons[i]) for i in new}
        parts = [(site[i], part) for i in new if invalid == "repair" for part in _repaired(polygons[i])]
        polygons, site = np.delete(polygons, bad), np.delete(site, bad)
        if parts:
            site = np.append(site, [s for s, _ in parts])
            order = np.argsort(site, kind="stable")
            polygons, site = np.append(polygons, [part for _, part in parts])[order], site[order]
        if site.size == 0:
            break
    if not where:
        return polygons, site
    shown = ", ".join(f"site {s} at {where[s]} µm" for s in sorted(where)[:MAX_LISTED])
    shown += f" and {len(where) - MAX_LISTED} more" * (len(where) > MAX_LISTED)
    what = f"of {n_sites} outlines cross themselves or have no area"
    if invalid == "error" or site.size == 0:
        fix = "correct them" if site.size == 0 else "correct them, or pass invalid='skip' or invalid='repair'"
        raise FileError(path, f"{len(where)} {what}, {shown}; {fix}")
    n_skipped = n_sites - np.unique(site).size
    n_repaired = len(where) - n_skipped
    done = f"{n_skipped} are skipped" + f", {n_repaired} repaired" * (invalid == "repair")
    warn(f"{path.name}: {len(where)} {what}, {shown}: {done}", LayoutWarning)
    return polygons, site


def _repaired(polygon: Any) -> list[Any]:
    """Return all parts of an outline that touches itself, and the largest of one that crosses."""
    parts = shapely.get_parts(shapely.make_valid(polygon))
    parts = parts[shapely.area(parts) > 0.0]
    if parts.size < 2:
        return list(parts)
    xy_um = shapely.get_coordinates(shapely.get_exterior_ring(polygon))
    outline_um2 = abs(float(ring_area_um2(xy_um, np.array([0, len(xy_um)]))[0]))
    # The winding order changes where an outline crosses itself, so that areas of its parts are subtracted from each other.
    is_touching = abs(outline_um2 - shapely.area(parts).sum()) <= 1e-9 * outline_um2
    return list(parts) if is_touching else [parts[np.argmax(shapely.area(parts))]]


def with_one_identity(layout: Layout, site: Ints) -> Layout:
    """Return the layout with the identity of the first part for all parts of a site."""
    is_part = np.append(False, site[1:] == site[:-1])
    if not is_part.any():
        return layout
    ids = site_ids(layout)
    return layout.with_columns(**{SITE_ID: ids[np.searchsorted(site, site)]})


def _place(polygon: Any) -> str:
    """Return the position of the problem of an outline, or its first vertex."""
    found = re.search(r"\[(\S+) (\S+)\]", str(shapely.is_valid_reason(polygon)))
    x, y = map(float, found.groups()) if found else shapely.get_coordinates(polygon)[0]
    return f"({x:.6g}, {y:.6g})"

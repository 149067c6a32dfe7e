"""Openings and photodiodes of sites, and values that congruent sites share."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from foveasim._core.rings import polygons_of, shrink_polygons, site_moments
from foveasim._core.threads import parallel_map, thread_count
from foveasim._core.validation import Floats, Ints
from foveasim.errors import GeometryError, ParameterError, type_name
from foveasim.fields import Outlines, PackedRings
from foveasim.incidence import ChiefRayTable, Incidence
from foveasim.sensor.effects.contract import Photosites

#: Sites are congruent if their vertices, relative to their centroids, differ by at most this fraction of their width.
CONGRUENT = 1e-9
#: Step of the nodes of congruent sites in the tangent of the chief ray: bilinear interpolation of responses is within 5e-4.
NODE_STEP = 1.0 / 128.0
#: Largest number of nodes; there are 10^5 up to tangents of 1.
MAX_NODES = 1 << 22
#: Rows per call of a kernel, fixed so that results do not depend on the number of threads.
ROWS = 4096
#: Sites per call in rows and columns.
SITES_PER_BLOCK = 1 << 17


class Shapes(NamedTuple):
    """
    Openings and photodiodes of sites, or those of one of several congruent sites.

    ``sites``, ``opening``, ``photodiode``: outlines. ``centre_um`` (n, 2): centroids of the sites. ``is_congruent``: whether
    the outlines are those of one site, of which the others are translated copies.
    """

    sites: Outlines
    opening: Outlines
    photodiode: Outlines
    centre_um: Floats
    is_congruent: bool

    @classmethod
    def of(cls, sites: Photosites, opening: Outlines | float, photodiode: Outlines | float) -> Shapes:
        """
        Return the shapes of sites: given outlines, or insets in µm.

        Raises ParameterError when given outlines have another number of sites, and GeometryError for insets that are too large.
        """
        for name, given in (("opening", opening), ("photodiode", photodiode)):
            if isinstance(given, Outlines) and given.n_sites != sites.n_sites:
                raise ParameterError(name, f"must have the {sites.n_sites} sites of the layout, got {given.n_sites}")
        own = _one_of_lattice(sites)
        others = [each for each in (opening, photodiode) if isinstance(each, Outlines)]
        if own is None or others:
            own = as_outlines("sites", sites)
            centre_um = site_moments(own.xy_um, own.ring_offsets, own.site_offsets)[1]
            is_congruent = sites.n_sites > 1 and all(_are_congruent(each, centre_um) for each in (own, *others))
            if is_congruent:
                first = slice(0, 1)
                own, centre_um = own.part(first), centre_um[first]
                opening, photodiode = (
                    each.part(first) if isinstance(each, Outlines) else each for each in (opening, photodiode)
                )
        else:
            is_congruent, centre_um = True, site_moments(own.xy_um, own.ring_offsets, own.site_offsets)[1]
        shapes = [
            each if isinstance(each, Outlines) else inset(name, own, each)
            for name, each in (("opening", opening), ("photodiode", photodiode))
        ]
        return cls(own, shapes[0], shapes[1], np.ascontiguousarray(centre_um), is_congruent)

    def evaluate(
        self,
        incidence: Incidence,
        n_values: int,
        compute: Callable[[Incidence, Ints], Floats],
        design: ChiefRayTable | None = None,
    ) -> Floats:
        """
        Return values per site, (n_site, n_values), for cones of light.

        ``compute`` returns the values of rows of cones, given the indices of the outlines. Those of congruent sites are
        interpolated between nodes in the image, which are the same for all selections of sites; except where a node is beyond
        the table of the lens, or that of ``design``.
        """
        if not self.is_congruent:
            return _in_blocks(incidence, np.arange(incidence.n_sites), n_values, compute)
        n_sites, none = incidence.n_sites, np.zeros(incidence.n_sites, np.int64)
        step_um = NODE_STEP * min(incidence.um_per_tangent, math.inf if design is None else design.um_per_tangent)
        if not math.isfinite(step_um) and incidence.covers(incidence.field_um, design).all():  # all cones are the same
            return np.repeat(compute(incidence.at(incidence.positions_um(none[:1])), none[:1]), n_sites, axis=0)
        # Column by column: many times faster than a reduction along axis 0.
        axes_um = incidence.axes_um or incidence.field_um.T
        low, high = (np.floor(np.array([find(axis) for axis in axes_um]) / step_um) for find in (np.min, np.max))
        if not math.isfinite(step_um) or np.prod(high - low + 2.0) > MAX_NODES:  # a table with a step in its angles
            return _in_blocks(incidence, none, n_values, compute)
        n_x, n_y = (high - low).astype(np.int64) + 2
        columns, rows = low[0] + np.arange(n_x), low[1] + np.arange(n_y)
        nodes_um = np.stack(np.meshgrid(columns * step_um, rows * step_um), axis=-1).reshape(-1, 2)
        values = np.full((nodes_um.shape[0], n_values), np.nan)
        used = np.arange(n_x * n_y)
        if used.size > 4 * n_sites:
            used = _nodes_near(incidence.field_um / step_um - low, n_x)
        used = used[incidence.covers(nodes_um[used], design)]
        values[used] = _in_blocks(incidence.at(nodes_um[used]), np.zeros(used.size, np.int64), n_values, compute)
        found = _interpolate(incidence, step_um, low, values.reshape(n_y, n_x, n_values))
        if used.size < values.shape[0]:
            alone = np.flatnonzero(np.isnan(found).any(axis=1))
            found[alone] = _in_blocks(incidence.at(incidence.positions_um(alone)), none[alone], n_values, compute)
        return found


def _interpolate(incidence: Incidence, step_um: float, low: Floats, values: Floats) -> Floats:
    """Return values at sites between nodes (n_y, n_x, n_value), (n_site, n_value)."""
    from foveasim.sensor.pixel_optics import _kernels

    found = np.empty((incidence.n_sites, values.shape[2]))
    axes_um = incidence.axes_um
    if axes_um is None:
        field_um = incidence.field_um

        def block(part: slice) -> None:
            _kernels.interpolate(field_um[part], step_um, low[0], low[1], values, found[part])

        n_rows, n_per_block = incidence.n_sites, ROWS
    else:
        x_um, y_um = axes_um
        lines = found.reshape(y_um.size, x_um.size, values.shape[2])

        def block(part: slice) -> None:
            _kernels.interpolate_rows(x_um, y_um[part], step_um, low[0], low[1], values, lines[part])

        n_rows, n_per_block = y_um.size, max(SITES_PER_BLOCK // x_um.size, 1)
    parallel_map(block, _blocks(n_rows, n_per_block), thread_count())
    return found


def _nodes_near(position: Floats, n_x: int) -> Ints:
    """Return the indices of the nodes around positions."""
    column, row = np.floor(position).astype(np.int64).T
    corner = row * n_x + column
    return np.unique(np.concatenate([corner, corner + 1, corner + n_x, corner + n_x + 1]))


def _blocks(n_rows: int, n_per_block: int = ROWS) -> list[slice]:
    return [slice(first, min(first + n_per_block, n_rows)) for first in range(0, n_rows, n_per_block)]


def _in_blocks(
    incidence: Incidence, site_of: Ints, n_values: int, compute: Callable[[Incidence, Ints], Floats]
) -> Floats:
    """Return the values of all rows, computed in threads."""
    field_um = incidence.field_um
    found = np.empty((site_of.size, n_values))

    def block(rows: slice) -> None:
        found[rows] = compute(incidence.at(field_um[rows]), site_of[rows])

    parallel_map(block, _blocks(site_of.size), thread_count())
    return found


def _one_of_lattice(sites: Photosites) -> Outlines | None:
    """Return the outline of one of the equal rectangles of a lattice; None for other layouts."""
    lattice = getattr(sites, "lattice", None)
    if lattice is None or lattice.n_sites < 2 or lattice.site_size_um is None:
        return None
    return Outlines(*lattice.rings(0, 1))


def smallest_area_um2(sites: Photosites) -> float:
    """Return the smallest area of some sites, µm², inf for none."""
    lattice = getattr(sites, "lattice", None)
    if lattice is None or not lattice.n_sites:
        return float(sites.area_um2.min(initial=np.inf))
    return math.prod(float((high - low).min()) for low, high in (lattice.x_um.T, lattice.y_um.T))


def _are_congruent(outlines: Outlines, centre_um: Floats) -> bool:
    """Return whether sites are translated copies of each other, as are their centres."""
    n_sites, n_vertices = outlines.n_sites, np.diff(outlines.ring_offsets)
    n_rings = outlines.site_offsets[1]
    if (np.diff(outlines.site_offsets) != n_rings).any() or (
        n_vertices.reshape(n_sites, -1) != n_vertices[:n_rings]
    ).any():
        return False
    vertices_um, first_um = (
        outlines.xy_um.reshape(n_sites, -1, 2),
        outlines.xy_um[: n_vertices[:n_rings].sum()] - centre_um[0],
    )
    tolerance_um = CONGRUENT * np.ptp(first_um, axis=0).max() + 1e-12 * np.abs(centre_um).max()
    return all(  # the last one first: most layouts differ there
        (np.abs(vertices_um[rows] - centre_um[rows, np.newaxis] - first_um) <= tolerance_um).all()
        for rows in (slice(-1, None), slice(None))
    )


def as_outlines(name: str, layout: PackedRings | Any) -> Outlines:
    """
    Return the outlines of a layout.

    Raises ParameterError with the name of the parameter for other objects.
    """
    if isinstance(layout, Outlines):
        return layout
    if not all(hasattr(layout, each) for each in ("xy_um", "ring_offsets", "site_offsets")):
        raise ParameterError(name, f"must be a Layout with the same sites, got {type_name(layout)}")
    return Outlines(layout.xy_um, layout.ring_offsets, layout.site_offsets)


def inset(name: str, outlines: Outlines, margin_um: float) -> Outlines:
    """
    Return outlines that are offset inwards, with sharp corners.

    Raises GeometryError for sites that would vanish or split into parts.
    """
    if margin_um == 0.0:
        return outlines
    from foveasim.sensor.pixel_optics import _kernels

    inset_um = np.empty_like(outlines.xy_um)
    rings = outlines.xy_um, outlines.ring_offsets, outlines.site_offsets
    if _kernels.inset_convex(*rings, margin_um, inset_um):
        return Outlines(inset_um, *rings[1:])
    import shapely

    shrunk, bad = shrink_polygons(polygons_of(*rings), margin_um)
    if bad.size:
        raise GeometryError(
            f"the {name} of site {bad[0]} would vanish or split into parts with an inset of {margin_um:g} µm; reduce "
            f"'{name}_inset_um'",
            tuple(int(i) for i in bad),
        )
    _, xy_um, (ring_offsets, site_offsets) = shapely.to_ragged_array(shapely.orient_polygons(shrunk))
    # Without the first vertex again at the end of each ring.
    return Outlines(
        np.delete(xy_um, ring_offsets[1:] - 1, axis=0), ring_offsets - np.arange(ring_offsets.size), site_offsets
    )

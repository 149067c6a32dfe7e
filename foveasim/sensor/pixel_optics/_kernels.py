"""
Numba kernels of pixel optics: moments of overlaps, averaged over cones of rays.

The indicator of a polygon is the signed sum over its edges of the regions below them, s the sign of the direction along x. The
product of two indicators is the sum over pairs of edges of the regions below both, so that
``∫_{A ∩ B} = Σ_e Σ_f s_e s_f ∫ dx ∫^{min(y_e, y_f)} dy`` over the common range of x: exact for any polygons, concave ones and
such with holes among them, without clipping. If both are convex, half of the time suffices: the boundary of A ∩ B is that
of A in B and that of B in A, each edge clipped by the half-planes of the other polygon (M. Cyrus and J. Beck, Generalized two-
and three-dimensional clipping, Comput. Graph. 3, 23, 1978). Outlines are packed rings, relative to a centre per site.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from foveasim._core._kernels import N_MOMENTS, add_outline, moments_below
from foveasim._core.jit import njit
from foveasim._core.jit.types import FLOATS, FLOATS_2D, FLOATS_3D, INTS

#: Vertices of the polygon in an image of the pupil: its area is that of the disc to 7e-4.
N_PUPIL = 96
_ANGLES = 2.0 * np.pi * np.arange(N_PUPIL) / N_PUPIL
_COSINES, _SINES = np.cos(_ANGLES), np.sin(_ANGLES)
#: Nodes of Gauss and Legendre on an interval of the length 1, around its centre.
GAUSS_NODE = 0.5 / math.sqrt(3.0)
#: Overlaps below this fraction of the area of an opening are slivers, whose power is negligible: no map follows from them.
MIN_OVERLAP = 1e-6
#: Largest displacement by the radius of the cone, in widths of a site, for each set of rays but the last.
REACH = (0.06, 0.15, 0.5)
#: Largest error of the formula for areas, in areas: for larger ones, the overlap of each ray is computed.
LARGEST_DIFFERENCE = 1e-3
#: Sums may be in any order, in vectors.
SUMS = {"reassoc"}
#: Edges with a smaller sine of their angle are parallel.
MIN_SINE = 1e-8
#: Edges with a smaller change of x per change of y are vertical.
MIN_COTANGENT = 1e-14

_out1, _out2 = types.Array(types.float64, 1, "C"), types.Array(types.float64, 2, "C")
_number = types.float64
_rings = (FLOATS_2D, INTS, INTS)


@njit()
def _fill_edges(xy, ring_offsets, first_ring, last_ring, x_0, y_0, edges):
    """Write edges as x_low, x_high, y at x_low, slope, sign; return their number."""
    n = 0
    for ring in range(first_ring, last_ring):
        start, stop = ring_offsets[ring], ring_offsets[ring + 1]
        for k in range(start, stop):
            after = k + 1 if k + 1 < stop else start
            x, y = xy[k, 0] - x_0, xy[k, 1] - y_0
            x_after, y_after = xy[after, 0] - x_0, xy[after, 1] - y_0
            if abs(x_after - x) <= MIN_COTANGENT * abs(y_after - y):  # no area below
                continue
            is_rising = x < x_after
            edges[n, 0] = x if is_rising else x_after
            edges[n, 1] = x_after if is_rising else x
            edges[n, 2] = y if is_rising else y_after
            edges[n, 3] = (y_after - y) / (x_after - x)
            edges[n, 4] = 1.0 if is_rising else -1.0
            n += 1
    return n


@njit()
def _largest_size(ring_offsets, site_offsets, site_of):
    """Return the largest number of vertices of some sites."""
    largest = 0
    for s in site_of:
        largest = max(largest, ring_offsets[site_offsets[s + 1]] - ring_offsets[site_offsets[s]])
    return largest


@njit()
def _add_overlap(edges_a, n_a, edges_b, n_b, i, rays, sums):
    """Add the moments of A ∩ (B - d), d that of ray i, to its six sums, (6, n_ray)."""
    d_x, d_y = rays[0, i], rays[1, i]
    m_0, m_x, m_y, m_xx, m_xy, m_yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for e in range(n_a):
        e_low, e_high, e_y, e_slope = edges_a[e, 0], edges_a[e, 1], edges_a[e, 2], edges_a[e, 3]
        for f in range(n_b):
            f_low, f_high = edges_b[f, 0] - d_x, edges_b[f, 1] - d_x
            low = max(f_low, e_low)
            high = min(f_high, e_high)
            if not low < high:
                continue
            sign = edges_a[e, 4] * edges_b[f, 4]
            f_y, f_slope = edges_b[f, 2] - d_y, edges_b[f, 3]
            e_at_low, e_at_high = e_y + e_slope * (low - e_low), e_y + e_slope * (high - e_low)
            f_at_low, f_at_high = f_y + f_slope * (low - f_low), f_y + f_slope * (high - f_low)
            before, after = e_at_low - f_at_low, e_at_high - f_at_high
            at_low = f_at_low if before > 0.0 else e_at_low
            at_high = f_at_high if after > 0.0 else e_at_high
            if before * after < 0.0:  # the edges cross
                x = low + (high - low) * (before / (before - after))
                y = e_y + e_slope * (x - e_low)
                part = moments_below(low, x, at_low, y, sign)
                m_0, m_x, m_y = m_0 + part[0], m_x + part[1], m_y + part[2]
                m_xx, m_xy, m_yy = m_xx + part[3], m_xy + part[4], m_yy + part[5]
                low, at_low = x, y
            part = moments_below(low, high, at_low, at_high, sign)
            m_0, m_x, m_y = m_0 + part[0], m_x + part[1], m_y + part[2]
            m_xx, m_xy, m_yy = m_xx + part[3], m_xy + part[4], m_yy + part[5]
    sums[0, i] += m_0
    sums[1, i] += m_x
    sums[2, i] += m_y
    sums[3, i] += m_xx
    sums[4, i] += m_xy
    sums[5, i] += m_yy


@njit()
def _fill_sides(xy, ring_offsets, first_ring, last_ring, x_0, y_0, sides):
    """
    Write the edges of a convex polygon; return their number, 0 for others.

    Strictly convex and anticlockwise; columns x, y, e_x, e_y and 1 / (f × e), f the edge before.
    """
    if last_ring != first_ring + 1:
        return 0
    start = ring_offsets[first_ring]
    n = ring_offsets[last_ring] - start
    for k in range(n):
        after = start + k + 1 if k + 1 < n else start
        sides[k, 0], sides[k, 1] = xy[start + k, 0] - x_0, xy[start + k, 1] - y_0
        sides[k, 2], sides[k, 3] = xy[after, 0] - xy[start + k, 0], xy[after, 1] - xy[start + k, 1]
    n_turns, last = 0, n - 1
    for k in range(n):
        cross = sides[last, 2] * sides[k, 3] - sides[last, 3] * sides[k, 2]
        squares = (sides[last, 2] ** 2 + sides[last, 3] ** 2) * (sides[k, 2] ** 2 + sides[k, 3] ** 2)
        if not cross > MIN_SINE * math.sqrt(squares):
            return 0
        sides[k, 4] = 1.0 / cross
        n_turns += (sides[k, 3] > 0.0) != (sides[last, 3] > 0.0)
        last = k
    return n if n_turns == 2 else 0  # once around


@njit()
def _add_sides(sides_e, n_e, sides_f, n_f, is_first, rays, n_rays, planes, sums):
    """
    Add the moments of the edges e within the edges f to six sums per ray, (6, n_ray).

    Edges e are those of A if ``is_first``, otherwise those of B - d. ``planes`` (n, 4): memory for the half-planes of the edges
    f, with the position along the edge e that is on each, as a linear function of the displacement. Of edges that coincide,
    those of A count.
    """
    sign, shift = (1.0, 0.0) if is_first else (-1.0, 1.0)
    for e in range(n_e):
        x, y, e_x, e_y = sides_e[e, 0], sides_e[e, 1], sides_e[e, 2], sides_e[e, 3]
        squared_e = e_x * e_x + e_y * e_y
        # Half-planes that bound the edge from below, from above, and parallel ones.
        n_low, n_high, n_parallel = 0, n_f, n_f
        for f in range(n_f):
            f_x, f_y = sides_f[f, 2], sides_f[f, 3]
            apart_x, apart_y = x - sides_f[f, 0], y - sides_f[f, 1]
            slope = f_x * e_y - f_y * e_x
            if slope * slope > MIN_SINE * MIN_SINE * (squared_e * (f_x * f_x + f_y * f_y)):
                inverse = 1.0 / slope
                if slope > 0.0:
                    k = n_low
                    n_low += 1
                else:
                    n_high -= 1
                    k = n_high
                planes[k, 0] = (f_y * apart_x - f_x * apart_y) * inverse
                planes[k, 1], planes[k, 2] = sign * f_y * inverse, -sign * f_x * inverse
            else:
                # The same number decides for both edges, or rounding might count both or neither: that of the edge of B.
                b_x, b_y = (f_x, f_y) if is_first else (e_x, e_y)
                planes[n_parallel, 0] = sign * (b_x * apart_y - b_y * apart_x)
                planes[n_parallel, 1], planes[n_parallel, 2] = -b_y, b_x
                planes[n_parallel, 3] = 1.0 if not is_first and e_x * f_x + e_y * f_y > 0.0 else 0.0
                n_parallel += 1
        for i in range(n_rays):
            d_x, d_y = rays[0, i], rays[1, i]
            is_outside = False
            for k in range(n_f, n_parallel):
                level = planes[k, 0] + (planes[k, 1] * d_x + planes[k, 2] * d_y)
                is_outside |= (level < 0.0) != (planes[k, 3] > 0.0)
            if is_outside:
                continue
            low, high = 0.0, 1.0
            for k in range(n_low):
                t = planes[k, 0] + (planes[k, 1] * d_x + planes[k, 2] * d_y)
                low = max(low, t)
            for k in range(n_high, n_f):
                t = planes[k, 0] + (planes[k, 1] * d_x + planes[k, 2] * d_y)
                high = min(high, t)
            if low >= high:
                continue
            x_0, y_0 = x - shift * d_x, y - shift * d_y
            part = moments_below(x_0 + low * e_x, x_0 + high * e_x, y_0 + low * e_y, y_0 + high * e_y, -1.0)
            for m in range(N_MOMENTS):
                sums[m, i] += part[m]


@njit(types.boolean(*_rings, _number, _out2))
def inset_convex(xy, ring_offsets, site_offsets, margin, out):
    """
    Write outlines that are offset inwards by a margin.

    Return whether all sites are convex and keep all edges; otherwise, the result is incomplete.
    """
    sides = np.empty((_largest_size(ring_offsets, site_offsets, np.arange(site_offsets.size - 1)), 5))
    for s in range(site_offsets.size - 1):
        n = _fill_sides(xy, ring_offsets, site_offsets[s], site_offsets[s + 1], 0.0, 0.0, sides)
        if n == 0:
            return False
        start, last = ring_offsets[site_offsets[s]], n - 1
        for k in range(n):
            # The intersection of both edges, displaced: v + margin (|e| f - |f| e) / (f × e).
            e_x, e_y, f_x, f_y = sides[k, 2], sides[k, 3], sides[last, 2], sides[last, 3]
            length_e, length_f = math.hypot(e_x, e_y), math.hypot(f_x, f_y)
            scale = margin * sides[k, 4]
            out[start + k, 0] = sides[k, 0] + scale * (length_f * e_x - length_e * f_x)
            out[start + k, 1] = sides[k, 1] + scale * (length_f * e_y - length_e * f_y)
            last = k
        for k in range(n):
            after = k + 1 if k + 1 < n else 0
            x, y = out[start + after, 0] - out[start + k, 0], out[start + after, 1] - out[start + k, 1]
            if not x * sides[k, 2] + y * sides[k, 3] > 0.0:
                return False
    return True


@njit()
def _displacement_per_tangent(squared_tangent, height_um, squared_index):
    """Return the displacement in a stack of layers over the tangent of the ray."""
    total = 0.0
    for k in range(height_um.size):
        total += height_um[k] / math.sqrt(squared_index[k] * (1.0 + squared_tangent) - squared_tangent)
    return total


@njit()
def _fill_both(a_xy, a_rings, a_sites, b_xy, b_rings, b_sites, s, x_0, y_0, edges_a, edges_b):
    """Write the edges of A and B of a site; return their numbers, and whether both are convex."""
    n_a = _fill_sides(a_xy, a_rings, a_sites[s], a_sites[s + 1], x_0, y_0, edges_a)
    n_b = _fill_sides(b_xy, b_rings, b_sites[s], b_sites[s + 1], x_0, y_0, edges_b)
    if n_a > 0 and n_b > 0:
        return n_a, n_b, True
    n_a = _fill_edges(a_xy, a_rings, a_sites[s], a_sites[s + 1], x_0, y_0, edges_a)
    return n_a, _fill_edges(b_xy, b_rings, b_sites[s], b_sites[s + 1], x_0, y_0, edges_b), False


@njit()
def _fill_overlaps(edges_a, n_a, edges_b, n_b, is_convex, rays, n_rays, planes, sums):
    """Write the moments of A ∩ (B - d) for the displacement d of each ray, (6, n_ray)."""
    sums[:, :n_rays] = 0.0
    if is_convex:
        _add_sides(edges_a, n_a, edges_b, n_b, True, rays, n_rays, planes, sums)
        _add_sides(edges_b, n_b, edges_a, n_a, False, rays, n_rays, planes, sums)
    else:
        for i in range(n_rays):
            _add_overlap(edges_a, n_a, edges_b, n_b, i, rays, sums)


@njit(types.void(*_rings, *_rings, FLOATS_2D, _out2, _out2))
def overlap_moments(a_xy, a_rings, a_sites, b_xy, b_rings, b_sites, displacement, out, reference):
    """
    Write the moments of A ∩ (B - d) of one site, (n, 6), for displacements (n, 2).

    ``reference``: those from pairs of edges, of convex polygons, too.
    """
    edges_a, edges_b = np.empty((a_xy.shape[0], 5)), np.empty((b_xy.shape[0], 5))
    rays, n_rays = np.ascontiguousarray(displacement.T), displacement.shape[0]
    planes = np.empty((2 * max(a_xy.shape[0], b_xy.shape[0]), 4))
    sums = np.empty((N_MOMENTS, out.shape[0]))
    rings = a_xy, a_rings, a_sites, b_xy, b_rings, b_sites
    n_a, n_b, is_convex = _fill_both(*rings, 0, 0.0, 0.0, edges_a, edges_b)
    _fill_overlaps(edges_a, n_a, edges_b, n_b, is_convex, rays, n_rays, planes, sums)
    out[:] = sums.T
    n_a = _fill_edges(a_xy, a_rings, a_sites[0], a_sites[1], 0.0, 0.0, edges_a)
    n_b = _fill_edges(b_xy, b_rings, b_sites[0], b_sites[1], 0.0, 0.0, edges_b)
    _fill_overlaps(edges_a, n_a, edges_b, n_b, False, rays, n_rays, planes, sums)
    reference[:] = sums.T


@njit(types.void(*_rings, FLOATS_2D, FLOATS_2D, FLOATS_2D, FLOATS_2D, INTS, _out2))
def affine_images(xy, ring_offsets, site_offsets, centre, mean, maps, target, site_of, out):
    """
    Write the vertices of affine images of outlines, ``M (x - c - m) + m + shift + target``.

    Image k, around ``target[k]``, is that of the site ``site_of[k]`` with the centre c and the mean m. ``maps[k]`` contains the
    elements xx, xy, yy of M, and the shift.
    """
    n = 0
    for k in range(site_of.size):
        s = site_of[k]
        c_x, c_y = centre[s, 0] + mean[s, 0], centre[s, 1] + mean[s, 1]
        o_x, o_y = target[k, 0] + mean[s, 0] + maps[k, 3], target[k, 1] + mean[s, 1] + maps[k, 4]
        for v in range(ring_offsets[site_offsets[s]], ring_offsets[site_offsets[s + 1]]):
            x, y = xy[v, 0] - c_x, xy[v, 1] - c_y
            out[n, 0] = o_x + (maps[k, 0] * x + maps[k, 1] * y)
            out[n, 1] = o_y + (maps[k, 1] * x + maps[k, 2] * y)
            n += 1


@njit(fastmath=SUMS)
def _fill_rays(chief_x, chief_y, radius, points, weights, first, n_rays, height_um, squared_index, rays):
    """
    Write displacement and weight of rays, (4, n), from the point ``first`` on.

    The weights have the sum 1; the last row is memory.
    """
    for i in range(n_rays):
        t_x, t_y = chief_x + radius * points[0, first + i], chief_y + radius * points[1, first + i]
        rays[2, i], rays[3, i] = t_x * t_x + t_y * t_y, 0.0
    for k in range(height_um.size):
        height, index2 = height_um[k], squared_index[k]
        for i in range(n_rays):
            rays[3, i] += height / math.sqrt(index2 * (1.0 + rays[2, i]) - rays[2, i])
    total = 0.0
    for i in range(n_rays):
        rays[0, i] = rays[3, i] * (chief_x + radius * points[0, first + i])
        rays[1, i] = rays[3, i] * (chief_y + radius * points[1, first + i])
        rays[2, i] = weights[first + i] / ((1.0 + rays[2, i]) * (1.0 + rays[2, i]))
        total += rays[2, i]
    inverse = 1.0 / total
    for i in range(n_rays):
        rays[2, i] *= inverse


@njit(fastmath=SUMS)
def _mean_area(sides, n_sides, area, rays, n_rays, differences, sums):
    """
    Return the mean over rays of the area of A ∩ (A - d), A convex, for small displacements.

    It is ``|A| - Σ_e |e × d| / 2 + Σ_v (e × d)(d × f) / 2 (e × f)``, v the vertices between edges e and f on different sides of
    the direction d: each edge loses a parallelogram, of which a triangle at v is outside A. Exact while these triangles are in
    the polygons. If ``differences``, the mean is that of the areas ``sums[0]`` minus this, and inf where it is not exact.
    """
    for i in range(n_rays):
        rays[3, i] = 2.0 * area
    last_x, last_y = sides[n_sides - 1, 2], sides[n_sides - 1, 3]
    for k in range(n_sides):
        e_x, e_y, inverse = sides[k, 2], sides[k, 3], sides[k, 4]
        for i in range(n_rays):
            cross = e_x * rays[1, i] - e_y * rays[0, i]
            both = cross * (last_x * rays[1, i] - last_y * rays[0, i])
            rays[3, i] -= abs(cross) + min(both, 0.0) * inverse
        last_x, last_y = e_x, e_y
    if differences:
        largest = 0.0
        for i in range(n_rays):
            rays[3, i] = 2.0 * sums[0, i] - rays[3, i]
            largest = max(largest, abs(rays[3, i]))
        if largest > 2.0 * LARGEST_DIFFERENCE * area:
            return np.inf
    total = 0.0
    for i in range(n_rays):
        total += rays[2, i] * rays[3, i]
    return 0.5 * total


@njit()
def _displacement_density(squared, radius, height_um, squared_index):
    """
    Return the displacement per tangent times the weight over a cone.

    It is linear in the squared radius u of the unit disc: the value at its mean u = 1/2 and the slope are those between two
    nodes of Gauss and Legendre. Each is that of the mean of t² over the circle.
    """
    total, value, slope = 0.0, 0.0, 0.0
    for node in (-GAUSS_NODE, GAUSS_NODE):
        mean = squared + radius * radius * (0.5 + node)
        weight = 1.0 / ((1.0 + mean) * (1.0 + mean))
        weighted = weight * _displacement_per_tangent(mean, height_um, squared_index)
        total += 0.5 * weight
        value += 0.5 * weighted
        slope += weighted / (2.0 * node)
    mean = squared + 0.5 * radius * radius
    value = _displacement_per_tangent(mean, height_um, squared_index) / ((1.0 + mean) * (1.0 + mean))
    return value / total, slope / total


@njit(fastmath=SUMS)
def _kink_error(
    xy, ring_offsets, first_ring, last_ring, area, c_x, c_y, radius, points, weights,
    first_ray, n_rays, value, slope, rays,
):  # fmt: skip
    """
    Return half the error of the mean of ``Σ_e |e × d|`` over rays of a cone.

    With the displacement ``(value + slope (u - 1/2)) t`` at the tangent t = c + radius p and the squared radius u = p² of the
    unit disc, and with s = |e × c| / (radius |e|) and q = sqrt(1 - s²), the means of |e × t| / (radius |e|) and of u times it
    are ``(2/π) (s asin s + q - q³/3)`` and ``(1/π) (s asin s + q - q³/3 + 2q⁵/15)`` for s < 1; s and s/2 above. Their second
    derivatives in s are (2/π) ∫ dy and (2/π) ∫ u dy over the chord at s. The displacement c shortens the edges of the overlap:
    the error is that of a parallelogram, which is smaller by the overlap for c.
    """
    total = shortened = 0.0
    for i in range(n_rays):
        x, y = points[0, first_ray + i], points[1, first_ray + i]
        rays[0, i], rays[1, i] = c_x + radius * x, c_y + radius * y
        rays[2, i] = weights[first_ray + i] * (value + slope * (x * x + y * y - 0.5))
    for ring in range(first_ring, last_ring):
        start, stop = ring_offsets[ring], ring_offsets[ring + 1]
        for k in range(start, stop):
            after = k + 1 if k + 1 < stop else start
            e_x, e_y = xy[after, 0] - xy[k, 0], xy[after, 1] - xy[k, 1]
            along, reach = abs(e_x * c_y - e_y * c_x), radius * math.hypot(e_x, e_y)
            shortened += along
            mean, mean_u = along, 0.5 * along
            if along < reach:
                s = along / reach
                squared = 1.0 - s * s
                q = math.sqrt(squared)
                both = s * math.asin(s) + q * (1.0 - squared / 3.0)
                mean = reach * 2.0 * both / math.pi
                mean_u = reach * (both + q * squared * squared * (2.0 / 15.0)) / math.pi
            total -= value * mean + slope * (mean_u - 0.5 * mean)
            for i in range(n_rays):
                total += rays[2, i] * abs(e_x * rays[1, i] - e_y * rays[0, i])
    return 0.5 * total * max(1.0 - 0.5 * value * shortened / area, 0.0)


@njit()
def _width(xy, ring_offsets, first_ring, last_ring, area):
    """Return four areas over the perimeter of a site: the width of a square."""
    perimeter = 0.0
    for ring in range(first_ring, last_ring):
        start, stop = ring_offsets[ring], ring_offsets[ring + 1]
        for k in range(start, stop):
            after = k + 1 if k + 1 < stop else start
            perimeter += math.hypot(xy[after, 0] - xy[k, 0], xy[after, 1] - xy[k, 1])
    return 4.0 * area / perimeter


@njit()
def _central_moments(moments):
    """Return centroid and covariance of an area: x, y, xx, xy, yy."""
    area = moments[0]
    x, y = moments[1] / area, moments[2] / area
    return x, y, moments[3] / area - x * x, moments[4] / area - x * y, moments[5] / area - y * y


@njit()
def _square_root(a, b, c):
    """Return the root of a matrix X: (X + sqrt(det X)) / sqrt(tr X + 2 sqrt(det X))."""
    root = math.sqrt(max(a * c - b * b, 0.0))
    scale = 1.0 / math.sqrt(a + c + 2.0 * root)
    return scale * (a + root), scale * b, scale * (c + root)


@njit()
def _product(p, q, r, a, b, c):
    """Return the symmetric product of matrices: P A P."""
    return (
        p * p * a + 2.0 * p * q * b + q * q * c,
        p * q * a + (p * r + q * q) * b + q * r * c,
        q * q * a + 2.0 * q * r * b + r * r * c,
    )


@njit()
def _fill_mean(rays, n_rays, sums, mean):
    """Write the mean moments over rays; return the smallest area."""
    smallest = np.inf
    for i in range(n_rays):
        sums[0, i] = max(sums[0, i], 0.0)
        smallest = min(smallest, sums[0, i])
    for m in range(N_MOMENTS):
        total = 0.0
        for i in range(n_rays):
            total += rays[2, i] * sums[m, i]
        mean[m] = total
    return smallest


@njit()
def _write_map(before, after, out):
    """
    Write the affine map of an area to one with given moments; return whether there is one.

    It is the symmetric matrix M with ``M C₀ M = C₁`` for the covariances, its elements xx, xy, yy, and the displacement of the
    centroid; the identity for slivers.
    """
    out[0], out[1], out[2], out[3], out[4] = 1.0, 0.0, 1.0, 0.0, 0.0
    if not after[0] > MIN_OVERLAP * before[0]:
        return False
    x_0, y_0, a_0, b_0, c_0 = _central_moments(before)
    x_1, y_1, a_1, b_1, c_1 = _central_moments(after)
    p, q, r = _square_root(a_0, b_0, c_0)
    scale = 1.0 / (p * r - q * q)
    a, b, c = _square_root(*_product(p, q, r, a_1, b_1, c_1))
    a, b, c = _product(scale * r, -scale * q, scale * p, a, b, c)
    if not (a * c - b * b > 0.0 and a + c < np.inf):
        return False
    out[0], out[1], out[2], out[3], out[4] = a, b, c, x_1 - x_0, y_1 - y_0
    return True


@njit(
    types.void(
        FLOATS_2D, _number, FLOATS, FLOATS, FLOATS_2D, FLOATS, INTS, types.boolean, *_rings, *_rings, INTS, types.boolean,
        FLOATS_2D, FLOATS_2D, _out2,
    )
)  # fmt: skip
def cone_footprints(
    chief_rays, radius, height_um, squared_index, points, weights, ray_offsets, has_disc,
    a_xy, a_rings, a_sites, b_xy, b_rings, b_sites, site_of, is_same, centre, before, out,
):  # fmt: skip
    """
    Write mean overlaps A ∩ (B - d) over cones, and maps of A with their moments.

    Row k, (6,), is for the chief ray ``chief_rays[k]`` and the outlines of the site ``site_of[k]``: the mean area, 0 for
    slivers; then the elements xx, xy, yy of the matrix, and the shift. ``before`` (n, 6): moments of A about the centres.

    The rays are those of one of several sets, of increasing numbers: set l contains the points from ``ray_offsets[l]`` on, and
    is for displacements by the cone up to ``REACH[l]`` widths of a site. The area of a convex polygon that overlaps itself is
    that of a formula, with fewer rays for the moments. If A and B are the same, the overlap has kinks where d is along an edge:
    if ``has_disc``, their means over the disc of a clear pupil replace those over the rays.
    """
    largest_a, largest_b = _largest_size(a_rings, a_sites, site_of), _largest_size(b_rings, b_sites, site_of)
    edges_a, edges_b = np.empty((largest_a, 5)), np.empty((largest_b, 5))
    n_sets = ray_offsets.size - 1
    sums, mean = np.empty((N_MOMENTS, ray_offsets[n_sets])), np.empty(N_MOMENTS)
    rays, planes = np.empty((4, ray_offsets[n_sets])), np.empty((2 * max(largest_a, largest_b), 4))
    reach = radius * _displacement_per_tangent(0.0, height_um, squared_index)
    last_site = -1
    n_a = n_b = which = 0
    is_convex = False
    for k in range(chief_rays.shape[0]):
        s = site_of[k]
        if s != last_site:
            n_a, n_b, is_convex = _fill_both(
                a_xy, a_rings, a_sites, b_xy, b_rings, b_sites, s, centre[s, 0], centre[s, 1], edges_a, edges_b
            )
            width = _width(a_xy, a_rings, a_sites[s], a_sites[s + 1], before[s, 0])
            which = 0
            while which < n_sets - 1 and reach > REACH[which] * width:
                which += 1
            last_site = s
        c_x, c_y, area = chief_rays[k, 0], chief_rays[k, 1], before[s, 0]
        first, n = ray_offsets[which], ray_offsets[which + 1] - ray_offsets[which]
        found = np.inf
        if is_same and is_convex:
            few = max(which - 1, 0)
            _fill_rays(c_x, c_y, radius, points, weights, first, n, height_um, squared_index, rays)
            mean_area = _mean_area(edges_a, n_a, area, rays, n, False, sums)
            first_few, n_few = ray_offsets[few], ray_offsets[few + 1] - ray_offsets[few]
            if few != which:
                _fill_rays(c_x, c_y, radius, points, weights, first_few, n_few, height_um, squared_index, rays)
            _fill_overlaps(edges_a, n_a, edges_b, n_b, is_convex, rays, n_few, planes, sums)
            _fill_mean(rays, n_few, sums, mean)
            found = mean_area + _mean_area(edges_a, n_a, area, rays, n_few, True, sums)
        has_kink = is_same
        if found == np.inf:
            _fill_rays(c_x, c_y, radius, points, weights, first, n, height_um, squared_index, rays)
            _fill_overlaps(edges_a, n_a, edges_b, n_b, is_convex, rays, n, planes, sums)
            has_kink &= _fill_mean(rays, n, sums, mean) > 0.0
            found = mean[0]
        if has_kink and has_disc:
            value, slope = _displacement_density(c_x * c_x + c_y * c_y, radius, height_um, squared_index)
            found += _kink_error(
                a_xy, a_rings, a_sites[s], a_sites[s + 1], area, c_x, c_y, radius, points, weights,
                first, n, value, slope, rays,
            )  # fmt: skip
        out[k, 0] = found if _write_map(before[s], mean, out[k, 1:]) else 0.0


# -- images of the pupil ----------------------------------------------------------------------------------------------


@njit()
def _is_inside(xy, ring_offsets, first_ring, last_ring, x, y):
    """Return whether a point is inside a site, by the parity of crossings."""
    is_inside = False
    for ring in range(first_ring, last_ring):
        start, stop = ring_offsets[ring], ring_offsets[ring + 1]
        for k in range(start, stop):
            after = k + 1 if k + 1 < stop else start
            y_0, y_1 = xy[k, 1], xy[after, 1]
            if (y_0 > y) != (y_1 > y) and x < xy[k, 0] + (xy[after, 0] - xy[k, 0]) * ((y - y_0) / (y_1 - y_0)):
                is_inside = not is_inside
    return is_inside


@njit()
def _squared_distance(xy, ring_offsets, first_ring, last_ring, x, y):
    """Return the squared distance of a point from the boundary of a site."""
    nearest = np.inf
    for ring in range(first_ring, last_ring):
        start, stop = ring_offsets[ring], ring_offsets[ring + 1]
        for k in range(start, stop):
            after = k + 1 if k + 1 < stop else start
            e_x, e_y = xy[after, 0] - xy[k, 0], xy[after, 1] - xy[k, 1]
            p_x, p_y = x - xy[k, 0], y - xy[k, 1]
            length2 = e_x * e_x + e_y * e_y
            along = min(max((p_x * e_x + p_y * e_y) / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
            d_x, d_y = p_x - along * e_x, p_y - along * e_y
            nearest = min(nearest, d_x * d_x + d_y * d_y)
    return nearest


@njit()
def _density(squared_tangent, height_um, squared_index):
    """Return the power per area of the image of the pupil, and the squared displacement."""
    per_tangent, slope = 0.0, 0.0
    for k in range(height_um.size):
        inverse2 = 1.0 / (squared_index[k] * (1.0 + squared_tangent) - squared_tangent)
        term = height_um[k] * math.sqrt(inverse2)
        per_tangent += term
        slope -= 0.5 * (squared_index[k] - 1.0) * term * inverse2
    jacobian = per_tangent * (per_tangent + 2.0 * squared_tangent * slope)
    return 1.0 / ((1.0 + squared_tangent) ** 2 * jacobian), squared_tangent * per_tangent * per_tangent


@njit(types.void(FLOATS_2D, _number, FLOATS, FLOATS, FLOATS_2D, *_rings, INTS, FLOATS_2D, _out1))
def pupil_fractions(chief_rays, radius, height_um, squared_index, shift, xy, rings, sites, site_of, centre, out):
    """
    Write the fractions of images of clear circular pupils on photodiodes.

    The fractions are of power. Image k is that of the chief ray ``chief_rays[k]``, shifted by ``-shift[k]``, relative to
    ``centre[k]``, and falls on the outline of the site ``site_of[k]``. Its power per area is a function of the squared
    displacement p, linear over the range of the image.
    """
    image, edges_p = np.empty((N_PUPIL, 2)), np.empty((N_PUPIL, 5))
    edges = np.empty((_largest_size(rings, sites, site_of), 5))
    whole = np.array([0, N_PUPIL])
    inside, total, undisplaced = np.empty((N_MOMENTS, 1)), np.empty(N_MOMENTS), np.zeros((2, 1))
    for k in range(out.size):
        first_ring, last_ring = sites[site_of[k]], sites[site_of[k] + 1]
        c_x, c_y = chief_rays[k, 0], chief_rays[k, 1]
        squared = c_x * c_x + c_y * c_y
        per_tangent = _displacement_per_tangent(squared, height_um, squared_index)
        o_x, o_y = per_tangent * c_x, per_tangent * c_y  # displacement of the chief ray
        m_x, m_y = centre[k, 0] + o_x - shift[k, 0], centre[k, 1] + o_y - shift[k, 1]
        apart2 = _squared_distance(xy, rings, first_ring, last_ring, m_x, m_y)
        # Displacements change at most by those per tangent times the change of the tangent, the most where it is smallest.
        low, high = max(math.sqrt(squared) - radius, 0.0), math.sqrt(squared) + radius
        extent = radius * _displacement_per_tangent(low * low, height_um, squared_index)
        if apart2 >= extent * extent:
            out[k] = 1.0 if _is_inside(xy, rings, first_ring, last_ring, m_x, m_y) else 0.0
            continue
        extent2 = 0.0
        for i in range(N_PUPIL):
            t_x, t_y = c_x + radius * _COSINES[i], c_y + radius * _SINES[i]
            per_tangent = _displacement_per_tangent(t_x * t_x + t_y * t_y, height_um, squared_index)
            image[i, 0], image[i, 1] = per_tangent * t_x - o_x, per_tangent * t_y - o_y
            extent2 = max(extent2, image[i, 0] ** 2 + image[i, 1] ** 2)
        if apart2 >= extent2:
            out[k] = 1.0 if _is_inside(xy, rings, first_ring, last_ring, m_x, m_y) else 0.0
            continue
        n_p = _fill_edges(image, whole, 0, 1, 0.0, 0.0, edges_p)
        n = _fill_edges(xy, rings, first_ring, last_ring, m_x, m_y, edges)
        inside[:], total[:] = 0.0, 0.0
        _add_overlap(edges_p, n_p, edges, n, 0, undisplaced, inside)
        add_outline(image, 0, N_PUPIL, 0.0, 0.0, total)
        centre2, half2 = 0.5 * (low * low + high * high), 0.5 * (high * high - low * low)
        # Nodes of Chebyshev.
        density_0, p_0 = _density(centre2 - 0.707 * half2, height_um, squared_index)
        density_1, p_1 = _density(centre2 + 0.707 * half2, height_um, squared_index)
        slope = (density_1 - density_0) / (p_1 - p_0)
        constant = density_0 + slope * (o_x * o_x + o_y * o_y - p_0)
        powers = (
            constant * inside[0, 0]
            + slope * (2.0 * (o_x * inside[1, 0] + o_y * inside[2, 0]) + inside[3, 0] + inside[5, 0]),
            constant * total[0] + slope * (2.0 * (o_x * total[1] + o_y * total[2]) + total[3] + total[5]),
        )
        out[k] = min(max(powers[0] / powers[1], 0.0), 1.0)


@njit(types.void(FLOATS_2D, _number, FLOATS, FLOATS, FLOATS_2D, FLOATS, FLOATS_2D, *_rings, INTS, FLOATS_2D, _out1))
def ray_fractions(
    chief_rays, radius, height_um, squared_index, points, weights, shift, xy, rings, sites, site_of, centre, out
):
    """Write the fractions of rays on photodiodes, as for :func:`pupil_fractions`."""
    n_rays = points.shape[1]
    rays = np.empty((4, n_rays))
    for k in range(out.size):
        first_ring, last_ring = sites[site_of[k]], sites[site_of[k] + 1]
        _fill_rays(
            chief_rays[k, 0], chief_rays[k, 1], radius, points, weights, 0, n_rays, height_um, squared_index, rays
        )
        m_x, m_y = centre[k, 0] - shift[k, 0], centre[k, 1] - shift[k, 1]
        total = 0.0
        for i in range(n_rays):
            if _is_inside(xy, rings, first_ring, last_ring, m_x + rays[0, i], m_y + rays[1, i]):
                total += rays[2, i]
        out[k] = min(total, 1.0)


@njit()
def _between(x, n):
    """Return the interval of n nodes at 0, 1, ... that contains x, and the fraction."""
    j = min(max(math.floor(x), 0), n - 2)
    return j, x - j


@njit(types.void(FLOATS_2D, _number, _number, _number, FLOATS_3D, _out2))
def interpolate(field, step, first_column, first_row, nodes, out):
    """Interpolate values (n_row, n_column, n_value) at multiples of a step bilinearly."""
    for k in range(out.shape[0]):
        j, x = _between(field[k, 0] / step - first_column, nodes.shape[1])
        i, y = _between(field[k, 1] / step - first_row, nodes.shape[0])
        for v in range(out.shape[1]):
            low = (1.0 - y) * nodes[i, j, v] + y * nodes[i + 1, j, v]
            high = (1.0 - y) * nodes[i, j + 1, v] + y * nodes[i + 1, j + 1, v]
            out[k, v] = (1.0 - x) * low + x * high


@njit(types.void(FLOATS, FLOATS, _number, _number, _number, FLOATS_3D, types.Array(types.float64, 3, "C")))
def interpolate_rows(x, y, step, first_column, first_row, nodes, out):
    """Interpolate as :func:`interpolate` at x and y, (n_y, n_x, n_value)."""
    line = np.empty((nodes.shape[1], nodes.shape[2]))
    columns, fractions = np.empty(x.size, np.int64), np.empty(x.size)
    for k in range(x.size):
        columns[k], fractions[k] = _between(x[k] / step - first_column, nodes.shape[1])
    for row in range(y.size):
        i, at = _between(y[row] / step - first_row, nodes.shape[0])
        for j in range(line.shape[0]):
            for v in range(line.shape[1]):
                line[j, v] = (1.0 - at) * nodes[i, j, v] + at * nodes[i + 1, j, v]
        for k in range(x.size):
            j, fraction = columns[k], fractions[k]
            for v in range(line.shape[1]):
                out[row, k, v] = (1.0 - fraction) * line[j, v] + fraction * line[j + 1, v]

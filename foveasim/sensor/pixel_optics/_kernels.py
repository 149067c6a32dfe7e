"""
Numba kernels of pixel optics: moments of overlaps, averaged over cones of rays.

The indicator of a polygon is the signed sum over its edges of the regions below them, s the sign of the direction along x. The
product of two indicators is the sum over pairs of edges of the regions below both, so that
``∫_{A ∩ B} = Σ_e Σ_f s_e s_f ∫ dx ∫^{min(y_e, y_f)} dy`` over the common range of x: exact for any polygons, concave ones and
such with holes among them, without clipping. Outlines are packed rings, relative to a centre per site.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from foveasim._core._kernels import N_MOMENTS, add_outline, moments_below
from foveasim._core.jit import njit

#: Vertices of the polygon in an image of the pupil: its area is that of the disc to 7e-4.
N_PUPIL = 96
_ANGLES = 2.0 * np.pi * np.arange(N_PUPIL) / N_PUPIL
_COSINES, _SINES = np.cos(_ANGLES), np.sin(_ANGLES)
TWO_OVER_PI = 2.0 / math.pi

_floats = types.Array(types.float64, 1, "C", readonly=True)
_points = types.Array(types.float64, 2, "C", readonly=True)
_ints = types.Array(types.int64, 1, "C", readonly=True)
_out1, _out2 = types.Array(types.float64, 1, "C"), types.Array(types.float64, 2, "C")
_number = types.float64
_rings = (_points, _ints, _ints)


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
            if x == x_after:
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
def _add_overlap(edges_a, n_a, edges_b, n_b, d_x, d_y, sums):
    """Add the moments of A ∩ (B - d) to six sums."""
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
    sums[0] += m_0
    sums[1] += m_x
    sums[2] += m_y
    sums[3] += m_xx
    sums[4] += m_xy
    sums[5] += m_yy


@njit()
def _displacement_per_tangent(squared_tangent, height_um, squared_index):
    """Return the displacement in a stack of layers over the tangent of the ray."""
    total = 0.0
    for k in range(height_um.size):
        total += height_um[k] / math.sqrt(squared_index[k] * (1.0 + squared_tangent) - squared_tangent)
    return total


@njit(types.void(*_rings, *_rings, _points, _out2))
def overlap_moments(a_xy, a_rings, a_sites, b_xy, b_rings, b_sites, displacement, out):
    """Write the moments of A ∩ (B - d) of sites, (n, 6), for displacements (n, 2)."""
    edges_a, edges_b = np.empty((a_xy.shape[0], 5)), np.empty((b_xy.shape[0], 5))
    for s in range(out.shape[0]):
        n_a = _fill_edges(a_xy, a_rings, a_sites[s], a_sites[s + 1], 0.0, 0.0, edges_a)
        n_b = _fill_edges(b_xy, b_rings, b_sites[s], b_sites[s + 1], 0.0, 0.0, edges_b)
        out[s] = 0.0
        _add_overlap(edges_a, n_a, edges_b, n_b, displacement[s, 0], displacement[s, 1], out[s])


@njit(types.void(*_rings, _points, _points, _points, _points, _ints, _out2))
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


@njit()
def _fill_rays(chief_x, chief_y, radius, points, weights, height_um, squared_index, rays):
    """Write displacement and weight of each ray, (n, 3); the weights have the sum 1."""
    total = 0.0
    for i in range(points.shape[0]):
        t_x, t_y = chief_x + radius * points[i, 0], chief_y + radius * points[i, 1]
        squared = t_x * t_x + t_y * t_y
        per_tangent = _displacement_per_tangent(squared, height_um, squared_index)
        weight = weights[i] / ((1.0 + squared) * (1.0 + squared))
        rays[0, i], rays[1, i], rays[2, i] = per_tangent * t_x, per_tangent * t_y, weight
        total += weight
    for i in range(points.shape[0]):
        rays[2, i] /= total


@njit()
def _fill_circles(squared, radius, radii, areas, height_um, squared_index, circles):
    """
    Write the displacements per tangent and weights of circles in a cone, (n, 2).

    Both are those of the mean of t² over each circle; the displacement is multiplied by the weight.
    """
    total = 0.0
    for j in range(radii.size):
        mean = squared + radius * radius * radii[j] * radii[j]
        circles[j, 0] = _displacement_per_tangent(mean, height_um, squared_index)
        circles[j, 1] = areas[j] / ((1.0 + mean) * (1.0 + mean))
        total += circles[j, 1]
    for j in range(radii.size):
        circles[j, 0] *= circles[j, 1] / total


@njit()
def _kink_error(
    xy, ring_offsets, first_ring, last_ring, x_0, y_0, c_x, c_y, radius, points, circles, exact_radii, exact_circles
):
    """
    Return half the error of the mean of ``Σ_e |e × d|`` over rays of a cone.

    On a circle around c, of the radius r, the mean of |e × t| is ``r |e| g(s)``, s = |e × c| / r |e|, with
    ``g(s) = (2/π) (s asin s + sqrt(1 - s²))`` for s < 1, and s above. Displacement per tangent and weight are those of the mean
    of t² over each circle, for the rays as well. The displacement c shortens the edges of the overlap: the error is that of a
    parallelogram, which is smaller by the overlap for c.
    """
    total, n_points = 0.0, points.shape[0] // circles.shape[0]
    shortened = twice = 0.0
    for ring in range(first_ring, last_ring):
        start, stop = ring_offsets[ring], ring_offsets[ring + 1]
        for k in range(start, stop):
            after = k + 1 if k + 1 < stop else start
            e_x, e_y = xy[after, 0] - xy[k, 0], xy[after, 1] - xy[k, 1]
            along, widest = abs(e_x * c_y - e_y * c_x), radius * math.hypot(e_x, e_y)
            shortened += along
            twice += (xy[k, 0] - x_0) * e_y - (xy[k, 1] - y_0) * e_x
            for j in range(exact_radii.size):
                reach = widest * exact_radii[j]
                if along >= reach:
                    total -= exact_circles[j, 0] * along
                else:
                    s = along / reach
                    total -= exact_circles[j, 0] * reach * TWO_OVER_PI * (s * math.asin(s) + math.sqrt(1.0 - s * s))
            for j in range(circles.shape[0]):
                part = 0.0
                for i in range(j * n_points, (j + 1) * n_points):
                    part += abs(e_x * (c_y + radius * points[i, 1]) - e_y * (c_x + radius * points[i, 0]))
                total += circles[j, 0] * part / n_points
    per_tangent = 0.0
    for j in range(circles.shape[0]):
        per_tangent += circles[j, 0]
    return 0.5 * total * max(1.0 - per_tangent * shortened / twice, 0.0)


@njit(
    types.void(
        _points, _number, _floats, _floats, _points, _floats, types.int64, _floats, _floats, *_rings, *_rings, _ints,
        types.boolean, _points, _out2,
    )
)  # fmt: skip
def cone_moments(
    chief_rays, radius, height_um, squared_index, points, weights, n_circles, exact_radii, exact_areas,
    a_xy, a_rings, a_sites, b_xy, b_rings, b_sites, site_of, is_same, centre, out,
):  # fmt: skip
    """
    Write mean areas and moments of the overlaps A ∩ (B - d) over the rays of cones.

    Row k, (7,), is for the chief ray ``chief_rays[k]`` and the outlines of the site ``site_of[k]``: the mean area, then the
    moments of the sum over the rays about the centre of the site. If A and B are the same, the overlap for small displacements
    is ``|A| - Σ_e |e × d| / 2``, with a kink at d = 0: its mean over the disc of a clear pupil replaces that over the rays.
    ``n_circles``: number of circles of the rays in a clear pupil, 0 for other pupils. ``exact_radii`` and ``exact_areas``:
    radii and relative areas of circles in the unit disc for this mean.
    """
    edges_a = np.empty((_largest_size(a_rings, a_sites, site_of), 5))
    edges_b = np.empty((_largest_size(b_rings, b_sites, site_of), 5))
    rays = np.empty((3, points.shape[0]))
    # The circles on which the points are, one after another with equal numbers of points.
    n_points = points.shape[0] // max(n_circles, 1)
    radii, areas = np.empty(n_circles), np.empty(n_circles)
    for j in range(n_circles):
        radii[j] = math.hypot(points[j * n_points, 0], points[j * n_points, 1])
        areas[j] = weights[j * n_points]
    circles, exact_circles = np.empty((n_circles, 2)), np.empty((exact_radii.size, 2))
    sums = np.empty(N_MOMENTS)
    last_site = -1
    n_a = n_b = 0
    for k in range(chief_rays.shape[0]):
        s = site_of[k]
        if s != last_site:
            n_a = _fill_edges(a_xy, a_rings, a_sites[s], a_sites[s + 1], centre[s, 0], centre[s, 1], edges_a)
            n_b = _fill_edges(b_xy, b_rings, b_sites[s], b_sites[s + 1], centre[s, 0], centre[s, 1], edges_b)
            last_site = s
        c_x, c_y = chief_rays[k, 0], chief_rays[k, 1]
        _fill_rays(c_x, c_y, radius, points, weights, height_um, squared_index, rays)
        out[k] = 0.0
        smallest = np.inf
        for i in range(points.shape[0]):
            sums[:] = 0.0
            _add_overlap(edges_a, n_a, edges_b, n_b, rays[0, i], rays[1, i], sums)
            sums[0] = max(sums[0], 0.0)
            smallest = min(smallest, sums[0])
            for m in range(N_MOMENTS):
                out[k, 1 + m] += rays[2, i] * sums[m]
        out[k, 0] = out[k, 1]
        if is_same and n_circles and smallest > 0.0:
            squared = c_x * c_x + c_y * c_y
            _fill_circles(squared, radius, radii, areas, height_um, squared_index, circles)
            _fill_circles(squared, radius, exact_radii, exact_areas, height_um, squared_index, exact_circles)
            out[k, 0] += _kink_error(
                a_xy, a_rings, a_sites[s], a_sites[s + 1], centre[s, 0], centre[s, 1], c_x, c_y, radius, points, circles,
                exact_radii, exact_circles,
            )  # fmt: skip


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


@njit(types.void(_points, _number, _floats, _floats, _points, *_rings, _ints, _points, _out1))
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
    inside, total = np.empty(N_MOMENTS), np.empty(N_MOMENTS)
    for k in range(out.size):
        first_ring, last_ring = sites[site_of[k]], sites[site_of[k] + 1]
        c_x, c_y = chief_rays[k, 0], chief_rays[k, 1]
        squared = c_x * c_x + c_y * c_y
        per_tangent = _displacement_per_tangent(squared, height_um, squared_index)
        o_x, o_y = per_tangent * c_x, per_tangent * c_y  # displacement of the chief ray
        m_x, m_y = centre[k, 0] + o_x - shift[k, 0], centre[k, 1] + o_y - shift[k, 1]
        extent2 = 0.0
        for i in range(N_PUPIL):
            t_x, t_y = c_x + radius * _COSINES[i], c_y + radius * _SINES[i]
            per_tangent = _displacement_per_tangent(t_x * t_x + t_y * t_y, height_um, squared_index)
            image[i, 0], image[i, 1] = per_tangent * t_x - o_x, per_tangent * t_y - o_y
            extent2 = max(extent2, image[i, 0] ** 2 + image[i, 1] ** 2)
        if _squared_distance(xy, rings, first_ring, last_ring, m_x, m_y) >= extent2:
            out[k] = 1.0 if _is_inside(xy, rings, first_ring, last_ring, m_x, m_y) else 0.0
            continue
        n_p = _fill_edges(image, whole, 0, 1, 0.0, 0.0, edges_p)
        n = _fill_edges(xy, rings, first_ring, last_ring, m_x, m_y, edges)
        inside[:], total[:] = 0.0, 0.0
        _add_overlap(edges_p, n_p, edges, n, 0.0, 0.0, inside)
        add_outline(image, 0, N_PUPIL, 0.0, 0.0, total)
        low, high = max(math.sqrt(squared) - radius, 0.0), math.sqrt(squared) + radius
        centre2, half2 = 0.5 * (low * low + high * high), 0.5 * (high * high - low * low)
        # Nodes of Chebyshev.
        density_0, p_0 = _density(centre2 - 0.707 * half2, height_um, squared_index)
        density_1, p_1 = _density(centre2 + 0.707 * half2, height_um, squared_index)
        slope = (density_1 - density_0) / (p_1 - p_0)
        constant = density_0 + slope * (o_x * o_x + o_y * o_y - p_0)
        powers = (
            constant * inside[0] + slope * (2.0 * (o_x * inside[1] + o_y * inside[2]) + inside[3] + inside[5]),
            constant * total[0] + slope * (2.0 * (o_x * total[1] + o_y * total[2]) + total[3] + total[5]),
        )
        out[k] = min(max(powers[0] / powers[1], 0.0), 1.0)


@njit(types.void(_points, _number, _floats, _floats, _points, _floats, _points, *_rings, _ints, _points, _out1))
def ray_fractions(
    chief_rays, radius, height_um, squared_index, points, weights, shift, xy, rings, sites, site_of, centre, out
):
    """Write the fractions of rays on photodiodes, as for :func:`pupil_fractions`."""
    rays = np.empty((3, points.shape[0]))
    for k in range(out.size):
        first_ring, last_ring = sites[site_of[k]], sites[site_of[k] + 1]
        _fill_rays(chief_rays[k, 0], chief_rays[k, 1], radius, points, weights, height_um, squared_index, rays)
        m_x, m_y = centre[k, 0] - shift[k, 0], centre[k, 1] - shift[k, 1]
        total = 0.0
        for i in range(points.shape[0]):
            if _is_inside(xy, rings, first_ring, last_ring, m_x + rays[0, i], m_y + rays[1, i]):
                total += rays[2, i]
        out[k] = min(total, 1.0)


@njit(types.void(_points, _number, _number, _number, types.Array(types.float64, 3, "C", readonly=True), _out2))
def interpolate(field, step, first_column, first_row, nodes, out):
    """Interpolate values (n_row, n_column, n_value) at multiples of a step bilinearly."""
    for k in range(out.shape[0]):
        x, y = field[k, 0] / step - first_column, field[k, 1] / step - first_row
        j, i = min(max(math.floor(x), 0), nodes.shape[1] - 2), min(max(math.floor(y), 0), nodes.shape[0] - 2)
        x, y = x - j, y - i
        for v in range(out.shape[1]):
            low = (1.0 - x) * nodes[i, j, v] + x * nodes[i, j + 1, v]
            high = (1.0 - x) * nodes[i + 1, j, v] + x * nodes[i + 1, j + 1, v]
            out[k, v] = (1.0 - y) * low + y * high

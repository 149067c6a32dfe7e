"""Pixel optics: closed forms of responses, footprints, mixing, and the camera that uses them."""

from __future__ import annotations

import math
import pickle
from dataclasses import dataclass, replace

import numpy as np
import pytest
import shapely
import skimage
from scipy.ndimage import gaussian_filter

import foveasim as fs
from foveasim.errors import FoveasimWarning, GeometryError, ParameterError
from foveasim.incidence import N_RINGS
from foveasim.layout import inset
from foveasim.optics import ChiefRayTable
from foveasim.sensor import ApertureStack, Footprints, Microlens, PixelOptics
from foveasim.sensor.effects import FixedFactor
from foveasim.sensor.pixel_optics._layers import Layers

SQUARE = fs.Layout.from_rectangles([[0.0, 0.0]], 3.0)
STACK = ApertureStack(height_um=4.0, refractive_index=1.5)
RINGS = fs.layout.log_polar(n_sectors=48, r_min_um=23.0, r_max_um=62.0, n_rings=8)
CONCAVE = fs.Layout.from_polygons(
    [shapely.Polygon([(0, 0), (5, 0), (5, 2), (2.5, 2.2), (2, 5), (0, 5)])] * 1
    + [shapely.box(6, 0, 12, 6).difference(shapely.box(8, 2, 10, 3.5))]
)
SCENE = fs.Scene.flat(shape=(120, 120), pitch_um=200.0, distance_m=1.0, illuminance_lux=500.0)


def lens(f_number=2.8, **options):
    return fs.Optics(focal_length_mm=8.0, f_number=f_number, **options)


def at_angle(layout, angle_deg, f_number=2.8, azimuth_deg=25.0):
    """Return cones with the same chief ray angle at all sites."""
    direction = np.array([math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg))])
    table = ChiefRayTable((0.0, 1.0, 1e6), (0.0, angle_deg, angle_deg))
    return lens(f_number, chief_ray=table).incidence(np.tile(1e4 * direction, (layout.n_sites, 1)))


# -- refraction -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle_deg", [0.0, 5.0, 30.0, 70.0])
def test_layers_refract_by_snells_law(angle_deg):
    heights_um, indices = (1.0, 0.5, 2.5), (1.46, 2.0, 3.5)
    angle = math.radians(angle_deg)
    expected_um = sum(h * math.tan(math.asin(math.sin(angle) / n)) for h, n in zip(heights_um, indices, strict=True))
    direction = np.array([0.6, 0.8])

    found_um = Layers.of(heights_um, indices).displacements_um(math.tan(angle) * direction)
    np.testing.assert_allclose(found_um, expected_um * direction, rtol=1e-12, atol=1e-15)


def test_equal_layers_are_one_layer():
    cones = at_angle(RINGS, 12.0)
    one = STACK.footprints(RINGS, cones)
    two = ApertureStack(height_um=(1.0, 3.0), refractive_index=(1.5, 1.5)).footprints(RINGS, cones)

    np.testing.assert_allclose(two.response, one.response, rtol=1e-13)


# -- openings and photodiodes -----------------------------------------------------------------------------------------


# Up to displacements by half of the width, and by all of it, where the product of both coordinates counts.
@pytest.mark.parametrize(
    ("relative_height", "n_rings", "tolerance"),
    [
        (0.1, N_RINGS, 1e-3), (0.3, N_RINGS, 1e-3), (0.5, N_RINGS, 1e-3), (1.0, 2, 2e-3),
        (0.1, 20, 1e-5), (0.5, 20, 1e-5), (1.0, 40, 1e-5),
    ],
)  # fmt: skip
def test_response_on_axis_has_closed_form(relative_height, n_rings, tolerance):
    # Paraxial, far from the pupil: a = h / (n w), with a tangent radius rho.
    f_number = 100.0
    rho = 0.5 / f_number
    height_um = relative_height * 3.0 * 1.5 / rho
    a = height_um / (1.5 * 3.0)
    expected = 1.0 - 8.0 * a * rho / (3.0 * np.pi) + a**2 * rho**2 / (2.0 * np.pi)
    stack = ApertureStack(height_um=height_um, refractive_index=1.5)

    found = stack.footprints(SQUARE, lens(f_number).incidence([[0.0, 0.0]]).with_rings(n_rings))
    assert found.response[0] == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize(("n_rings", "tolerance"), [(N_RINGS, 1e-3), (20, 1e-5)])
def test_response_off_axis_has_closed_form(n_rings, tolerance):
    f_number, c = 1000.0, 0.001
    rho = 0.5 / f_number
    height_um = 0.3 * 3.0 * 1.5 / c
    a = height_um / (1.5 * 3.0)
    expected = (1.0 - a * c) * (1.0 - 4.0 * a * rho / (3.0 * np.pi))
    cones = lens(f_number, exit_pupil_mm=10.0).incidence([[10.0, 0.0]]).with_rings(n_rings)

    found = ApertureStack(height_um=height_um, refractive_index=1.5).footprints(SQUARE, cones).response[0]
    assert found == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize(("f_number", "c"), [(1.4, 0.0), (2.8, 0.1), (2.8, 0.4), (1.4, 0.7)])
def test_response_is_mean_over_exact_cone(f_number, c):
    # Overlaps of squares in closed form, at 300 x 400 rays weighted as irradiance.
    cones = lens(f_number, exit_pupil_mm=10.0).incidence([[1e4 * c * 0.8, 1e4 * c * 0.6]])
    radius2, angle = (np.arange(300) + 0.5) / 300, 2.0 * np.pi * (np.arange(400) + 0.3) / 400
    disc = np.sqrt(radius2)[:, np.newaxis, np.newaxis] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    t = cones.chief_ray[0] + cones.radius * disc
    squared = np.square(t).sum(axis=-1)
    d = 4.0 * t / np.sqrt(1.5**2 * (1.0 + squared) - squared)[..., np.newaxis]
    share = np.prod(np.maximum(1.0 - np.abs(d) / 3.0, 0.0), axis=-1)
    expected = np.average(share, weights=(1.0 + squared) ** -2.0)

    assert STACK.footprints(SQUARE, cones).response[0] == pytest.approx(expected, abs=1e-3)
    assert STACK.footprints(SQUARE, cones.with_rings(20)).response[0] == pytest.approx(expected, abs=3e-5)


@pytest.mark.parametrize("layout", [SQUARE, RINGS[::97]], ids=["square", "quadrilaterals"])
@pytest.mark.parametrize("height_um", [0.5, 2.0, 6.0])
@pytest.mark.parametrize(("f_number", "angle_deg"), [(1.0, 5.0), (1.4, 0.0), (1.4, 18.0), (2.8, 20.0)])
def test_responses_converge_at_any_displacement(layout, height_um, f_number, angle_deg):
    # From displacements by 2 % of the width to such by more than all of it.
    stack, cones = replace(STACK, height_um=height_um), at_angle(layout, angle_deg, f_number)
    expected = stack.footprints(layout, cones.with_rings(40)).response

    np.testing.assert_allclose(stack.footprints(layout, cones).response, expected, atol=1e-3)


@pytest.mark.parametrize(
    "changes", [{"photodiode_inset_um": 0.4}, {"opening_inset_um": 0.3}, {"opening_inset_um": 0.6}]
)
@pytest.mark.parametrize(("f_number", "angle_deg"), [(1.4, 0.0), (1.4, 12.0), (2.8, 12.0)])
def test_responses_of_insets_converge(changes, f_number, angle_deg):
    stack, cones = replace(STACK, **changes), at_angle(RINGS, angle_deg, f_number)
    expected = stack.footprints(RINGS, cones.with_rings(24)).response

    np.testing.assert_allclose(stack.footprints(RINGS, cones).response, expected, atol=2e-3)


def test_small_sites_lose_more_light():
    layout = fs.layout.log_polar(n_sectors=240, r_min_um=120.8, r_max_um=1012.0, n_rings=81)
    radius_um = np.hypot(*layout.centroid_um.T)
    inner, outer = radius_um.argmin(), np.abs(radius_um - 1000.0).argmin()
    found = [
        STACK.footprints(layout, lens(f_number, exit_pupil_mm=12.0).incidence(layout.centroid_um)).response
        for f_number in (1.4, 2.8, 5.6)
    ]

    np.testing.assert_allclose([each[inner] for each in found], [0.77, 0.88, 0.94], atol=0.006)
    np.testing.assert_allclose([each[outer] for each in found], [0.97, 0.98, 0.99], atol=0.006)


def test_insets_reduce_response_by_areas():
    # Light from a narrow cone on the axis: the fraction of the area of the site that opening and photodiode share.
    cones = lens(f_number=1000.0).incidence([[0.0, 0.0]])
    found = [
        ApertureStack(height_um=1.0, refractive_index=1.5, opening_inset_um=a, photodiode_inset_um=b)
        .footprints(SQUARE, cones)
        .response[0]
        for a, b in ((0.3, 0.0), (0.0, 0.3), (0.3, 0.5))
    ]

    # A displacement of at most 3.3e-4 µm.
    np.testing.assert_allclose(found, [2.4**2 / 9.0, 2.4**2 / 9.0, 2.0**2 / 9.0], atol=1e-3)


def test_congruent_sites_are_interpolated():
    layout = fs.layout.hexagonal(n_columns=30, n_rows=30, pitch_um=4.0)
    spread = fs.layout.grid(n_x=30, n_y=30, pitch_um=4.0)
    for each in (layout, spread):
        field_um = 40.0 * each.centroid_um
        cones = lens(exit_pupil_mm=8.0).incidence(field_um)
        together = STACK.footprints(each, cones)
        for site in (0, 17, each.n_sites // 2 + 7):
            alone = STACK.footprints(each[[site]], cones.at(cones.field_um[[site]]))

            assert together.response[site] == pytest.approx(alone.response[0], abs=1e-4)
            start = each.ring_offsets[site]
            stop = each.ring_offsets[site + 1]
            np.testing.assert_allclose(together.outlines.xy_um[start:stop], alone.outlines.xy_um, atol=1e-3)


def test_wells_of_files_equal_insets():
    by_layout = replace(STACK, photodiode=inset(RINGS, 0.3), opening=inset(RINGS, 0.1))
    by_inset = replace(STACK, photodiode_inset_um=0.3, opening_inset_um=0.1)
    cones = at_angle(RINGS, 10.0)
    one, other = (each.footprints(RINGS, cones) for each in (by_layout, by_inset))

    np.testing.assert_allclose(one.response, other.response, rtol=1e-12)
    np.testing.assert_allclose(one.area_ratio, other.area_ratio, rtol=1e-12)
    microlenses = Microlens(height_um=3.0, refractive_index=1.5, photodiode=inset(RINGS, 0.9))
    expected = replace(microlenses, photodiode=None, photodiode_inset_um=0.9).footprints(RINGS, cones).response
    np.testing.assert_allclose(microlenses.footprints(RINGS, cones).response, expected, rtol=1e-10)


# -- affine outlines --------------------------------------------------------------------------------------------------


def clipped(layout, cones, stack, site):
    """Return the overlaps of a site's outline with its displaced photodiode, one per ray."""
    t = cones.tangents[site]
    displacements_um = Layers.of(stack.height_um, stack.refractive_index).displacements_um(t)
    outline = layout.polygons()[site]
    return [shapely.intersection(outline, shapely.affinity.translate(outline, *-d)) for d in displacements_um]


def second_moments(polygon):
    """Return area, x, y, x², xy, y² of a polygon from a triangulation."""
    total = np.zeros(6)
    for triangle in shapely.constrained_delaunay_triangles(polygon).geoms:
        vertices = np.array(triangle.exterior.coords)[:3]
        x, y = (0.5 * (vertices + np.roll(vertices, 1, axis=0))).T
        total += triangle.area * np.array([np.ones(3), x, y, x * x, x * y, y * y]).mean(axis=1)
    return total


@pytest.mark.parametrize("layout", [RINGS[::97], CONCAVE], ids=["quadrilaterals", "concave"])
@pytest.mark.parametrize("angle_deg", [0.0, 17.0])
def test_affine_outlines_have_moments_of_mean_overlap(layout, angle_deg):
    cones = at_angle(layout, angle_deg).with_rings(6)  # at all displacements
    found = STACK.footprints(layout, cones)
    outlines = fs.Layout(found.outlines.xy_um, found.outlines.ring_offsets, found.outlines.site_offsets).polygons()
    for site in range(layout.n_sites):
        overlaps = [second_moments(each) for each in clipped(layout, cones, STACK, site)]
        expected, affine = np.average(overlaps, axis=0, weights=cones.weights[site]), second_moments(outlines[site])

        # Means of all quadratic maps are equal.
        np.testing.assert_allclose(affine / affine[0], expected / expected[0], rtol=1e-9, atol=1e-9)
        assert found.area_ratio[site] == pytest.approx(affine[0] / layout.area_um2[site], rel=1e-10)
        assert found.response[site] == pytest.approx(expected[0] / layout.area_um2[site], abs=1e-2)  # few rays, kinks


def test_second_order_samples_quadratic_maps_exactly():
    layout = RINGS[[97]].translate(*-RINGS[[97]].centroid_um[0])
    cones = at_angle(layout, 17.0).with_rings(6)
    grid = fs.Grid.centred((300, 300), 0.04)
    x, y = np.meshgrid(*(np.linspace(-5.98, 5.98, 300),) * 2)
    cells = 1.0 + 0.05 * x - 0.03 * y + 0.01 * x * x - 0.02 * x * y + 0.015 * y * y + 0.025 * 0.04**2 / 12  # cell means
    found, overlaps = STACK.footprints(layout, cones), fs.Layout.from_polygons(clipped(layout, cones, STACK, 0))
    weights = cones.weights[0]
    expected = weights @ fs.Integrator(overlaps, grid, order=2)(cells) / (weights @ overlaps.area_um2)

    mean = fs.Integrator(found.outlines, grid, order=2)(cells) / (found.area_ratio * layout.area_um2)
    np.testing.assert_allclose(mean, expected, rtol=1e-9)


def blurred_map():
    """Return a photograph blurred by 1.5 µm, in cells of 0.25 µm."""
    picture = gaussian_filter(skimage.data.camera().astype(np.float64), 1.5 / 0.25)
    return fs.PowerMap.from_array(picture, pitch_um=0.25, wavelength_nm=550.0)


def affine_errors(layout, angle_deg, stack):
    """Return the relative errors of irradiance means over affine outlines, against one clipped outline per ray."""
    power_map = blurred_map()
    # Sixteen rays; the footprints have others.
    cones = at_angle(layout, angle_deg)
    radius, angle = np.sqrt([0.25, 0.75]), 2.0 * np.pi * np.arange(8) / 8
    disc = np.concatenate(
        [r * np.column_stack((np.cos(angle + 0.4 * k), np.sin(angle + 0.4 * k))) for k, r in enumerate(radius)]
    )
    t = cones.chief_ray[0] + cones.radius * disc
    weights = (1.0 + np.square(t).sum(axis=1)) ** -2.0
    polygons, power, area_um2 = layout.polygons(), 0.0, 0.0
    for weight, d in zip(weights, Layers.of(stack.height_um, stack.refractive_index).displacements_um(t), strict=True):
        moved = np.array([shapely.affinity.translate(each, *-d) for each in polygons])
        overlap = fs.Layout.from_polygons(list(shapely.intersection(polygons, moved)))
        power = power + weight * fs.Integrator(overlap, power_map.grid, order=2)(power_map.data[0])
        area_um2 = area_um2 + weight * overlap.area_um2
    found = stack.footprints(layout, cones)
    affine = fs.Integrator(found.outlines, power_map.grid, order=2)(power_map.data[0])
    affine /= found.area_ratio * layout.area_um2
    return affine / (power / area_um2) - 1.0


def test_affine_outlines_replace_clipped_ones():
    sites = fs.layout.log_polar(n_sectors=60, r_min_um=28.0, r_max_um=62.0, n_rings=8)
    sites = sites[(sites.size_um >= 3.0) & (sites.size_um <= 6.0)]
    assert sites.n_sites > 300
    error = affine_errors(sites, 17.0, STACK)

    assert np.sqrt(np.mean(error**2)) <= 5e-4
    assert np.abs(error).max() <= 5e-3


def test_affine_outlines_replace_clipped_concave_sites():
    # Copies of an L and of a frame, at different positions of the picture.
    shapes = [
        shapely.affinity.translate(each, 13.3 * i - 60.0, 7.1 * j - 60.0)
        for each in CONCAVE.polygons()
        for i in range(9)
        for j in range(16)
    ]
    error = affine_errors(fs.Layout.from_polygons(shapes), 17.0, STACK)

    # The overlap of such sites is not similar to their outline: 0.17 % and 1.1 % of an L, 0.11 % and 0.7 % of a frame.
    assert np.sqrt(np.mean(error**2)) <= 5e-3
    assert np.abs(error).max() <= 2.5e-2


# -- microlenses ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["square", "hexagon", "frame"])
def test_microlenses_lose_nothing_within_inscribed_circle(shape):
    centre, radius_um = np.zeros(2), 1.5
    polygon = {
        "square": shapely.box(-1.5, -1.5, 1.5, 1.5),
        "hexagon": shapely.Polygon(
            1.5 / math.cos(math.pi / 6) * np.array([(math.cos(a), math.sin(a)) for a in np.pi / 3 * np.arange(6)])
        ),
        "frame": shapely.box(-3.0, -1.5, 3.0, 1.5)
        .difference(shapely.box(1.9, -1.0, 2.5, 1.0))
        .union(shapely.box(-3.7, -1, -3, 1)),
    }[shape]
    layout = fs.Layout.from_polygons([polygon])
    rho = 0.5 / 2.8
    # The marginal ray meets the circle: h rho' = radius, refracted. The centroid of the frame is not at the origin.
    centre = layout.centroid_um[0]
    radius_um -= np.abs(centre).max()
    marginal = rho / math.sqrt(1.5**2 * (1.0 + rho**2) - rho**2)
    for fraction, is_complete in ((0.5, True), (1.0, True), (1.6, False)):
        optics = Microlens(height_um=fraction * radius_um / marginal, refractive_index=1.5)
        found = optics.footprints(layout, lens().incidence([[0.0, 0.0]])).response[0]
        if is_complete:
            assert found == pytest.approx(1.0, abs=1e-12)
        else:
            assert found < 0.99


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("f_number", [1.4, 2.8])
@pytest.mark.parametrize("angle_deg", [0.0, 12.0, 25.0])
@pytest.mark.parametrize("layout", [SQUARE, CONCAVE], ids=["square", "concave"])
def test_pupil_images_agree_with_random_rays(layout, angle_deg, f_number):
    n, rng = 400_000, np.random.default_rng(5)
    optics = Microlens(height_um=(2.0, 1.5), refractive_index=(1.45, 1.9), photodiode_inset_um=0.4)
    cones = at_angle(layout, angle_deg, f_number)
    found = optics.footprints(layout, cones).response
    radius, angle = np.sqrt(rng.random(n)), 2.0 * np.pi * rng.random(n)
    for site, photodiode in enumerate(inset(layout, 0.4).polygons()):
        t = cones.chief_ray[site] + cones.radius * np.column_stack((radius * np.cos(angle), radius * np.sin(angle)))
        weight = (1.0 + np.square(t).sum(axis=1)) ** -2.0
        sines = t / np.sqrt(1.0 + np.square(t).sum(axis=1, keepdims=True))
        at_um = layout.centroid_um[site]
        for h, index in ((2.0, 1.45), (1.5, 1.9)):
            inside = sines / index
            at_um = at_um + h * inside / np.sqrt(1.0 - np.square(inside).sum(axis=1, keepdims=True))
        hit = shapely.contains_xy(photodiode, *at_um.T)
        expected = np.average(hit, weights=weight)
        error = math.sqrt(np.sum(weight**2 * (hit - expected) ** 2)) / weight.sum()

        assert found[site] == pytest.approx(expected, abs=5.0 * error + 1e-12)


def test_optimal_shift_centres_pupil_image():
    optics = Microlens(height_um=(2.0, 1.5), refractive_index=(1.45, 1.9), shift="optimal")
    cones = lens(exit_pupil_mm=6.0).incidence(np.array([[1500.0, 0.0], [-700.0, 900.0], [0.0, 0.0]]))
    for shift_um, chief_ray in zip(optics.shift_um(cones), cones.chief_ray, strict=True):
        angle = math.atan(np.hypot(*chief_ray))
        length_um = 2.0 * math.tan(math.asin(math.sin(angle) / 1.45)) + 1.5 * math.tan(math.asin(math.sin(angle) / 1.9))

        assert np.hypot(*shift_um) == pytest.approx(length_um, abs=1e-12)
        assert shift_um @ chief_ray == pytest.approx(length_um * np.hypot(*chief_ray), abs=1e-12)  # parallel


def test_shift_restores_periphery_and_scales():
    layout = fs.layout.grid(n_x=40, n_y=40, pitch_um=3.0)
    cones = lens(exit_pupil_mm=6.0).incidence(40.0 * layout.centroid_um)
    corner = {
        shift: Microlens(height_um=4.0, refractive_index=1.5, shift=shift, photodiode_inset_um=0.9)
        .footprints(layout, cones)
        .response[0]
        for shift in ("none", 0.5, "optimal", 2.0)
    }

    assert corner["optimal"] > 0.98
    assert corner["none"] < corner[0.5] < corner["optimal"]
    assert corner[2.0] == pytest.approx(corner["none"], abs=0.05)  # twice the shift: the opposite displacement


def test_design_table_is_that_of_other_lens():
    table = ChiefRayTable((0.0, 1000.0, 2000.0), (0.0, 8.0, 15.0))
    layout = fs.Layout.from_rectangles([[900.0, 0.0], [0.0, 1800.0]], 3.0)
    parameters = {"height_um": 4.0, "refractive_index": 1.5, "shift": "optimal", "photodiode_inset_um": 0.6}
    own = lens(chief_ray=table).incidence(layout.centroid_um)
    other = lens(exit_pupil_mm=3.0).incidence(layout.centroid_um)
    designed = Microlens(**parameters, design_chief_ray=table)

    assert (designed.footprints(layout, own).response > 0.999).all()
    assert designed.footprints(layout, other).response[1] < 0.8
    np.testing.assert_array_equal(designed.shift_um(other), Microlens(**parameters).shift_um(own))


GRID = fs.layout.grid(n_x=9, n_y=7, pitch_um=3.0)


@pytest.mark.parametrize(("last_um", "angle_deg"), [(15.1, 19.0), (1e3, 79.0)])
@pytest.mark.parametrize("optics", [STACK, Microlens(height_um=6.0, refractive_index=1.5, photodiode_inset_um=0.6)])
def test_grids_use_tables_to_their_end(optics, last_um, angle_deg):
    # Sites near the last height of the table, where nodes are beyond it, and others.
    table = ChiefRayTable((0.0, last_um), (0.0, angle_deg))
    cones = lens(chief_ray=table).incidence(GRID.centroid_um)
    found = optics.footprints(GRID, cones).response
    alone = [optics.footprints(GRID[[k]], cones.at(cones.field_um[[k]])).response[0] for k in range(GRID.n_sites)]

    np.testing.assert_allclose(found, alone, atol=5e-4)
    assert np.ptp(found) > 0.005
    in_rows = cones.on_axes(*(0.5 * axis_um.sum(axis=1) for axis_um in (GRID.lattice.x_um, GRID.lattice.y_um)))
    np.testing.assert_allclose(optics.footprints(GRID, in_rows).response, found, rtol=1e-13)


@pytest.mark.parametrize("table", [ChiefRayTable((0.0, 5.0), (0.0, 20.0)), ChiefRayTable((0.0, 5.0), (0.0, 0.0))])
@pytest.mark.parametrize("optics", [STACK, Microlens(height_um=6.0, refractive_index=1.5)])
def test_short_tables_are_rejected_for_grids(optics, table):
    with pytest.raises(ParameterError, match=r"'image_height_um' must extend to 15 µm, .* got 5.0 µm"):
        optics.footprints(GRID, lens(chief_ray=table).incidence(GRID.centroid_um))
    design = Microlens(height_um=6.0, refractive_index=1.5, shift="optimal", design_chief_ray=table)
    with pytest.raises(ParameterError, match="'image_height_um' must extend to 15 µm"):
        design.footprints(GRID, lens().incidence(GRID.centroid_um))


def test_telecentric_lens_sees_shift_of_design():
    design = ChiefRayTable((0.0, 100.0), (0.0, 40.0))
    optics = Microlens(
        height_um=6.0, refractive_index=1.5, photodiode_inset_um=0.6, shift="optimal", design_chief_ray=design
    )
    cones = lens(exit_pupil_mm=math.inf).incidence(GRID.translate(40.0, 0.0).centroid_um)
    found = optics.footprints(GRID, cones).response
    alone = [optics.footprints(GRID[[k]], cones.at(cones.field_um[[k]])).response[0] for k in range(GRID.n_sites)]

    np.testing.assert_allclose(found, alone, atol=5e-4)
    assert np.ptp(found) > 0.01


def test_annular_pupils_are_counted_by_rays():
    # An annulus around the photodiode: of its rays, those within the photodiode's circle.
    disc = fs.Layout.from_polygons([shapely.Point(0, 0).buffer(0.9, quad_segs=200)])
    optics = Microlens(height_um=20.0, refractive_index=1.5)
    f_number = 20.0 / 1.5 / 2.0  # the image of the pupil has a radius of 1 µm
    cones = lens(f_number, pupil=fs.optics.Annulus(0.5)).incidence([[0.0, 0.0]]).with_rings(40)

    assert optics.footprints(disc, cones).response[0] == pytest.approx((0.9**2 - 0.5**2) / (1.0 - 0.5**2), abs=0.02)


# -- mixing -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_light_is_collected_once_at_most(seed):
    """For random ordinary configurations, with enough sites that responses alone are interpolated."""
    rng = np.random.default_rng(seed)
    pitch_um, n = rng.uniform(1.0, 3.0), int(rng.integers(40, 90))
    shapes = (
        fs.layout.grid(n_x=n, n_y=n, pitch_um=pitch_um),
        fs.layout.hexagonal(n_columns=n, n_rows=n, pitch_um=pitch_um),
    )
    layout = shapes[seed % 2].translate(*rng.uniform(0.0, 2000.0, 2))
    lens = fs.Optics(focal_length_mm=6.0, f_number=rng.uniform(1.4, 4.0))
    optics = Microlens(
        height_um=rng.uniform(1.0, 5.0), refractive_index=1.5, shift=("none", "optimal", 0.5)[seed % 3], crosstalk=True
    )
    cones = lens.incidence(layout.centroid_um)
    found = optics.footprints(layout, cones)
    collected = found.response + np.asarray(found.mixing.sum(axis=0)).ravel()

    assert collected.max() <= 1.0 + 1e-12
    # Without gaps between photodiodes, nothing is lost inside of the field.
    distance_um = np.abs(layout.centroid_um - 0.5 * (layout.centroid_um.min(axis=0) + layout.centroid_um.max(axis=0)))
    is_inside = (distance_um < 0.25 * np.ptp(layout.centroid_um, axis=0)).all(axis=1)
    assert collected[is_inside].min() >= 1.0 - 1e-9
    alone = replace(optics, crosstalk=False).footprints(layout, cones).response
    np.testing.assert_allclose(found.response, alone, atol=2e-3)


@pytest.mark.parametrize("inset_um", [0.0, 0.5])
def test_mixing_and_losses_are_all_light(inset_um):
    layout = fs.layout.hexagonal(n_columns=14, n_rows=14, pitch_um=3.0)
    optics = Microlens(height_um=8.0, refractive_index=1.5, crosstalk=True, photodiode_inset_um=inset_um)
    found = optics.footprints(layout, at_angle(layout, 25.0))
    collected = found.response + found.mixing.sum(axis=0)
    inner = np.hypot(*(layout.centroid_um - layout.centroid_um.mean(axis=0)).T) < 10.0

    assert found.mixing.diagonal().max() == 0.0
    assert found.mixing.nnz > layout.n_sites
    assert (collected <= 1.0 + 1e-12).all()
    if inset_um == 0.0:  # photodiodes tile the plane
        np.testing.assert_allclose(collected[inner], 1.0, atol=1e-10)
    else:
        assert (collected[inner] < 1.0).all()


def test_uniform_light_stays_uniform_with_mixing():
    layout = fs.layout.hexagonal(n_columns=16, n_rows=16, pitch_um=3.0)
    inner = np.hypot(*(layout.centroid_um - layout.centroid_um.mean(axis=0)).T) < 12.0
    optics = Microlens(height_um=6.0, refractive_index=1.5, crosstalk=True, photodiode_inset_um=0.2)
    # Far from the axis, chief rays are parallel.
    moved = layout.translate(20_000.0, 0.0)
    table = ChiefRayTable((0.0, 1000.0, 1e6), (0.0, 20.0, 20.0))
    camera = fs.Camera(optics=lens(chief_ray=table), sensor=fs.Sensor(moved, pixel_optics=optics))
    alone, response = camera.footprints(SCENE).response[inner], camera.angular_response(SCENE)[inner]

    assert alone.max() < 0.5 < response.min() < response.max() < 1.0
    np.testing.assert_allclose(response, response.mean(), rtol=1e-3)


def test_footprints_reject_light_that_is_collected_twice():
    from scipy.sparse import csr_array

    with pytest.raises(ParameterError, match="'mixing' plus 'response' must have sums of at most 1 per site, got 1"):
        Footprints(np.array([0.8, 0.9]), mixing=csr_array(np.array([[0.0, 0.1], [0.5, 0.0]])))


def test_sensors_with_mixing_are_not_divided():
    sensor = fs.Sensor(RINGS, pixel_optics=Microlens(height_um=4.0, refractive_index=1.5, crosstalk=True))

    with pytest.raises(
        ParameterError, match="'pixel_optics' must not mix the light of sites in a sensor to be divided"
    ):
        sensor.part(slice(0, 10))


# -- cameras ----------------------------------------------------------------------------------------------------------

OPTICS = {
    "stack": STACK,
    "stack with openings": replace(STACK, opening_inset_um=0.2, photodiode=inset(RINGS, 0.1)),
    "microlens": Microlens(height_um=4.0, refractive_index=1.5, photodiode_inset_um=0.7, shift="optimal"),
}
PHOTOGRAPH = fs.Scene.from_picture(
    np.random.default_rng(7).random((150, 150)),
    pitch_um=150.0,
    distance_m=1.0,
    wavelength_nm=550.0,
    band_width_nm=100.0,
    peak_radiance_w_m2_sr_nm=0.05,
)


def camera_of(layout, pixel_optics, **options):
    sensor = fs.Sensor(layout, pixel_optics=pixel_optics, read_noise_e=2.0, prnu_fraction=0.01, capacitance_f=1e-13)
    return fs.Camera(optics=lens(exit_pupil_mm=1.0, precision="double"), sensor=sensor, **options)


@pytest.mark.parametrize(
    "distortion",
    [None, fs.distortion.BrownConrady(focal_um=8000.0, k1=-20.0, centre_um=(5.0, 3.0))],
    ids=["", "distorted"],
)
@pytest.mark.parametrize("name", OPTICS)
def test_moved_sensor_equals_moved_layout(name, distortion):
    optics = OPTICS[name] if name != "microlens" else replace(OPTICS[name], shift="none")
    by_um = (11.0, -7.0)
    moved = replace(optics, photodiode=inset(RINGS.translate(*by_um), 0.1)) if "openings" in name else optics
    sensor = camera_of(RINGS, optics, distortion=distortion)
    layout = camera_of(RINGS.translate(*by_um), moved, distortion=distortion)

    found = sensor.with_gaze(by_um).photoelectrons_per_s(PHOTOGRAPH)
    np.testing.assert_allclose(found, layout.photoelectrons_per_s(PHOTOGRAPH), rtol=1e-9)
    assert not np.allclose(found, sensor.photoelectrons_per_s(PHOTOGRAPH), rtol=1e-3)


def test_turned_camera_keeps_field_positions():
    camera = camera_of(RINGS, STACK, axis="sensor")
    turned = camera.with_gaze((40.0, 0.0)).angular_response(PHOTOGRAPH)

    np.testing.assert_array_equal(turned, camera.angular_response(PHOTOGRAPH))
    assert np.abs(camera.with_gaze((40.0, 0.0), "image").angular_response(PHOTOGRAPH) - turned).max() > 1e-3


def test_field_positions_start_at_principal_point():
    centre_um = (30.0, -20.0)
    distortion = fs.distortion.BrownConrady(focal_um=8000.0, k1=-0.05, centre_um=centre_um)
    shifted = camera_of(RINGS, STACK, distortion=distortion)
    expected = camera_of(RINGS.translate(-30.0, 20.0), STACK).angular_response(PHOTOGRAPH)

    np.testing.assert_allclose(shifted.angular_response(PHOTOGRAPH), expected, rtol=1e-9)


@pytest.mark.parametrize("name", OPTICS)
def test_tiles_equal_captures(name, monkeypatch):
    monkeypatch.setattr("foveasim.tiles.BLOCK_SITES", 256)
    monkeypatch.setattr("foveasim.sensor.blocks.BLOCK_SITES", 256)
    camera = camera_of(RINGS, OPTICS[name])
    capture = camera.capture(PHOTOGRAPH, exposure_s=0.01, seed=3)
    tiles = list(fs.tiles.capture_tiles(camera, PHOTOGRAPH, exposure_s=0.01, seed=3, tile_sites=256))

    assert len(tiles) > 1
    np.testing.assert_allclose(np.concatenate([tile.expected_e for tile in tiles]), capture.expected_e, rtol=1e-11)
    assert (np.concatenate([tile.code for tile in tiles]) == capture.code).mean() > 0.999


def test_tiles_warn_of_layout_beyond_image(monkeypatch, recwarn):
    # The image ends at the layout, and so do the sites; their footprints are displaced.
    monkeypatch.setattr("foveasim.tiles.BLOCK_SITES", 256)
    layout = fs.layout.grid(n_x=20, n_y=20, pitch_um=3.0)
    camera = fs.Camera(optics=lens(exit_pupil_mm=0.1), sensor=fs.Sensor(layout, pixel_optics=STACK))
    power_map = fs.PowerMap.from_array(np.ones((60, 60)), pitch_um=1.0, wavelength_nm=550.0)
    list(fs.tiles.capture_tiles(camera, power_map, exposure_s=0.01, seed=0, tile_sites=256))

    assert not any("outside the image" in str(each.message) for each in recwarn)
    moved = camera.with_gaze((0.5, 0.0), None)
    with pytest.warns(FoveasimWarning, match="20 of 400 photosites lie partly or completely outside the image"):
        list(fs.tiles.capture_tiles(moved, power_map, exposure_s=0.01, seed=0, tile_sites=256))


def test_used_camera_is_pickled():
    camera = camera_of(RINGS, STACK)
    before = camera.photoelectrons_per_s(PHOTOGRAPH)
    again = pickle.loads(pickle.dumps(camera))

    np.testing.assert_allclose(again.photoelectrons_per_s(PHOTOGRAPH), before, rtol=1e-12)


@pytest.mark.parametrize("optics", [STACK, Microlens(height_um=4.0, refractive_index=1.5)], ids=["stack", "microlens"])
def test_tiles_of_lattices_equal_captures(optics, monkeypatch):
    monkeypatch.setattr("foveasim.tiles.BLOCK_SITES", 256)
    camera = camera_of(fs.layout.grid(n_x=33, n_y=31, pitch_um=3.0), optics)
    tiles = list(fs.tiles.capture_tiles(camera, PHOTOGRAPH, exposure_s=0.01, seed=3, tile_sites=256))
    expected_e = camera.capture(PHOTOGRAPH, exposure_s=0.01, seed=3).expected_e

    np.testing.assert_allclose(np.concatenate([tile.expected_e for tile in tiles]), expected_e, rtol=1e-11)


def test_videos_along_gazes_equal_captures():
    camera = camera_of(RINGS, STACK)
    gazes_um = [(0.0, 0.0), (20.0, 5.0), (0.0, 0.0), (-3.0, 8.0)]
    rates = list(camera.rates([(PHOTOGRAPH, gaze_um) for gaze_um in gazes_um]))
    for rate, gaze_um in zip(rates, gazes_um, strict=True):
        np.testing.assert_allclose(rate, camera.with_gaze(gaze_um).photoelectrons_per_s(PHOTOGRAPH), rtol=1e-9)


@pytest.mark.parametrize("name", [*OPTICS, "table", "crosstalk"])
def test_saved_captures_restore_pixel_optics(name, tmp_path):
    table = ChiefRayTable((0.0, 100.0), (0.0, 10.0))
    more = {
        "table": Microlens(height_um=(1.0, 2.0), refractive_index=(1.4, 1.6), shift=0.8, design_chief_ray=table),
        "crosstalk": Microlens(height_um=4.0, refractive_index=1.5, crosstalk=True),
    }
    camera = camera_of(RINGS, (OPTICS | more)[name])
    capture = camera.capture(PHOTOGRAPH, exposure_s=0.01, seed=0)
    capture.save(tmp_path / "capture.npz")
    read = fs.Capture.load(tmp_path / "capture.npz")
    again = fs.Sensor.from_settings(RINGS, read.settings["sensor"], read.sensor_arrays)

    other = fs.Camera(optics=camera.optics, sensor=replace(camera.sensor, pixel_optics=again.pixel_optics))
    np.testing.assert_array_equal(other.capture(PHOTOGRAPH, exposure_s=0.01, seed=0).code, capture.code)
    np.testing.assert_array_equal(read.signal_to_noise(), capture.signal_to_noise())


def test_settings_files_contain_pixel_optics():
    settings = {
        "scene": {"kind": "flat", "shape": [60, 60], "pitch_um": 300.0, "distance_m": 1.0, "illuminance_lux": 500.0},
        "optics": {"focal_length_mm": 8.0, "f_number": 2.8, "exit_pupil_mm": 1.0},
        "layout": {"generator": "grid", "parameters": {"n_x": 16, "n_y": 16, "pitch_um": 3.0}},
        "sensor": {
            "pixel_optics": {
                "kind": "microlens",
                "height_um": [2.0, 2.0],
                "refractive_index": [1.5, 1.6],
                "shift": "optimal",
                "design_chief_ray": {"image_height_um": [0, 100], "angle_deg": [0.0, 3.0]},
            }
        },
        "exposure_s": 0.01,
    }
    shot = fs.config.build_shot(None, settings)
    table = ChiefRayTable((0.0, 100.0), (0.0, 3.0))
    expected = Microlens(height_um=(2.0, 2.0), refractive_index=(1.5, 1.6), shift="optimal", design_chief_ray=table)
    assert shot.camera.sensor.pixel_optics == expected
    assert shot.camera.optics.exit_pupil_mm == 1.0

    names = {}
    exec(fs.config.to_python(settings), names)
    code = shot.camera.capture(shot.scene, exposure_s=0.01, seed=0).code
    np.testing.assert_array_equal(names["capture"].code, code)


def test_sweeps_distinguish_pixel_optics(tmp_path):
    base = {
        "scene": {"kind": "flat", "shape": [60, 60], "pitch_um": 300.0, "distance_m": 1.0, "illuminance_lux": 500.0},
        "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
        "layout": {"generator": "grid", "parameters": {"n_x": 16, "n_y": 16, "pitch_um": 3.0}},
        "sensor": {"pixel_optics": {"kind": "aperture_stack", "height_um": 1.0, "refractive_index": 1.5}},
        "exposure_s": 0.01,
    }
    runner = fs.explore.worker_cache.ShotRunner(None, {})
    means = []
    for height_um in (1.0, 4.0, 1.0):
        base["sensor"]["pixel_optics"]["height_um"] = height_um
        means.append(float(runner.simulate_capture(base)[1].expected_e.mean()))

    assert means[0] == means[2] > 1.05 * means[1]


# -- compositions -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class KnownResponse(FixedFactor):
    """A known response of each site, at the photo stage."""

    name = "known_response"
    stage = "photo"

    values: tuple[float, ...]

    def pattern(self, sites):
        return np.array(self.values)


@dataclass(frozen=True)
class KnownOptics(PixelOptics):
    """Pixel optics with a known response."""

    values: tuple[float, ...]

    def footprints(self, sites, incidence):
        return Footprints(np.array(self.values))

    def part(self, selection):
        return KnownOptics(tuple(np.array(self.values)[selection]))


def equal_cameras():
    layout = fs.layout.hexagonal(n_columns=20, n_rows=20, pitch_um=3.0)
    response = np.random.default_rng(1).uniform(0.3, 1.0, layout.n_sites)
    common = {"read_noise_e": 3.0, "prnu_fraction": 0.02, "dark_e_per_s": 50.0, "full_well_e": 1e4, "bits": 12}
    common["capacitance_f"] = 6e-16
    sensors = {
        "pixel_optics": fs.Sensor(layout, **common, pixel_optics=KnownOptics(tuple(response))),
        "effect": fs.Sensor(layout, **common, effects=[KnownResponse(tuple(response))]),
        "sensitivity": fs.Sensor(layout, **common, sensitivity=response),
    }
    optics = lens(focus_distance_m=1.0)
    return {name: fs.Camera(optics=optics, sensor=sensor) for name, sensor in sensors.items()}


def test_equal_responses_give_equal_results():
    cameras = equal_cameras()
    exposure_s = 0.002
    found = {}
    for name, camera in cameras.items():
        capture = camera.capture(PHOTOGRAPH, exposure_s=exposure_s, seed=0)
        budget = camera.noise_budget(PHOTOGRAPH, exposure_s=exposure_s)
        tiles = fs.tiles.capture_tiles(camera, PHOTOGRAPH, exposure_s=exposure_s, seed=0)
        found[name] = [
            *camera.predict(PHOTOGRAPH, exposure_s=exposure_s),
            capture.expected_e,
            capture.signal_to_noise(),
            np.concatenate([tile.expected_e for tile in tiles]),
            *(budget[source] for source in ("photon_shot", "dark_shot", "read", "quantisation", "prnu")),
        ]
    for name in ("effect", "sensitivity"):
        assert len(found[name]) == len(found["pixel_optics"]) > 6
        for one, other in zip(found["pixel_optics"], found[name], strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-11)  # dark noise is a root of a difference


def test_equal_responses_give_equal_comparisons():
    cameras = equal_cameras()
    found = fs.compare.cameras(
        cameras, {"random": PHOTOGRAPH}, exposure_s=0.002, n_annuli=2, max_pixels=48, centre_um=(0.0, 0.0)
    )
    for name, values in found.values.items():
        for row in values[1:]:
            np.testing.assert_allclose(row, values[0], rtol=1e-9, atol=1e-12, err_msg=name)


def test_corrected_pictures_are_uniform():
    camera = equal_cameras()["pixel_optics"]
    capture = camera.capture(SCENE, exposure_s=0.002, seed=0)
    known = camera.sensor.with_angular_response(camera.angular_response(SCENE))
    raw, corrected = (
        capture.picture(of="light_e", per="um2", max_pixels=40, sensor=each).data for each in (camera.sensor, known)
    )

    assert np.nanstd(corrected) / np.nanmean(corrected) < 0.5 * np.nanstd(raw) / np.nanmean(raw)


# -- wrong inputs -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (
            lambda: ApertureStack(height_um=(1.0, 2.0), refractive_index=1.5),
            r"^'refractive_index' must have one value for each of the 2 heights, got 1$",
        ),
        (
            lambda: ApertureStack(height_um=1.0, refractive_index=0.9),
            r"^'refractive_index' must be >= 1.0 everywhere, got 0.9; 1 for air, 1.46 for silicon oxide",
        ),
        (
            lambda: Microlens(height_um=1.0, refractive_index=1.5, shift="best"),
            r"^'shift' must be one of 'none', 'optimal', got 'best'",
        ),
        (
            lambda: ApertureStack(height_um=1.0, refractive_index=1.5, photodiode=3.0),
            r"^'photodiode' must be a Layout with the same sites, got a float$",
        ),
        (
            lambda: replace(STACK, photodiode=RINGS[:7]).footprints(RINGS, at_angle(RINGS, 0.0)),
            r"^'photodiode' must have the \d+ sites of the layout, got 7$",
        ),
        (lambda: fs.Sensor(RINGS, pixel_optics="microlens"), r"^'pixel_optics' must be a PixelOptics, got a str$"),
    ],
)
def test_pixel_optics_reject_wrong_input(make, match):
    with pytest.raises(ParameterError, match=match):
        make()


def test_large_insets_name_site_and_margin():
    with pytest.raises(
        GeometryError, match="the photodiode of site 0 would vanish or split into parts with an inset of 9 µm"
    ):
        replace(STACK, photodiode_inset_um=9.0).footprints(RINGS, at_angle(RINGS, 0.0))


def test_openings_of_few_wavelengths_cause_warning():
    camera = camera_of(fs.layout.grid(n_x=8, n_y=8, pitch_um=0.6), STACK)

    power_map = fs.PowerMap.from_array(np.ones((20, 20)), pitch_um=1.0, wavelength_nm=550.0)

    with pytest.warns(FoveasimWarning, match=r"the narrowest opening of the pixel optics measures 1\.6 wavelengths"):
        camera.capture(power_map, exposure_s=0.01, seed=0)


def test_coverage_warnings_refer_to_layout(recwarn):
    # The image ends at the layout; footprints are displaced beyond it.
    layout = fs.layout.grid(n_x=20, n_y=20, pitch_um=3.0)
    camera = fs.Camera(optics=lens(exit_pupil_mm=0.1), sensor=fs.Sensor(layout, pixel_optics=STACK))
    power_map = fs.PowerMap.from_array(np.ones((60, 60)), pitch_um=1.0, wavelength_nm=550.0)
    outlines = camera.footprints(power_map).outlines
    camera.capture(power_map, exposure_s=0.01, seed=0)
    messages = [str(each.message) for each in recwarn]

    assert np.abs(outlines.xy_um).max() < 30.0  # rays that point outwards enter on the side of the axis
    assert not any("outside the image" in message for message in messages)
    with pytest.warns(FoveasimWarning, match="photosites lie partly or completely outside the image"):
        camera.capture(power_map, exposure_s=0.01, seed=0, gaze_um=(0.5, 0.0))

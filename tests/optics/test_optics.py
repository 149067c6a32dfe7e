"""Optics against closed forms: Airy pattern, falloff, photometry of the lens, energy."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import scipy.fft
from scipy.special import j1

import foveasim as fs
from foveasim.errors import ParameterError, SamplingWarning
from foveasim.optics import circular_otf

DISTANCE_M = 0.56
#: Fraction of an Airy pattern's light in a centred square of side x λN (tabulated from the pattern's double integral).
ENSQUARED = {0.5: 0.177327, 1.0: 0.528891, 1.5: 0.766734, 2.0: 0.833845, 2.44: 0.844488}


def lens(**changes):
    values = {"focal_length_mm": 22.0, "f_number": 4.0, "precision": "double", "padding": "periodic"}
    return fs.Optics(**{**values, **changes})


def airy_map(cells_per_lambda_n, n, optics=None, wavelength_nm=550.0):
    """Map of one point source whose λN is so many cells wide, with the point at the middle of the map."""
    optics = lens() if optics is None else optics
    lambda_n_um = wavelength_nm * 1e-3 * optics.working_f_number(DISTANCE_M)
    pitch_um = lambda_n_um / cells_per_lambda_n
    scene = fs.Scene.point_sources(
        shape=(n, n),
        pixels=[(n // 2, n // 2)],
        intensity_w_sr_nm=1e-9,
        pitch_um=pitch_um / optics.magnification(DISTANCE_M),
        distance_m=DISTANCE_M,
        wavelength_nm=[wavelength_nm],
        band_width_nm=1.0,
    )
    return optics.power_map(scene), lambda_n_um


def ensquared(power_map, side_um):
    square = fs.Layout.from_rectangles([[0.0, 0.0]], side_um)
    total = power_map.data.sum() * power_map.grid.cell_area_um2
    return fs.Integrator(square, power_map.grid)(power_map.data)[0, 0] / total


# -- the transfer function -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("s", "mtf"), [(0.0, 1.0), (0.25, 0.68504), (0.5, 0.39100), (0.40397, 0.5), (1.0, 0.0), (3.0, 0.0)]
)
def test_otf_of_a_circle_has_its_tabulated_values(s, mtf):
    assert circular_otf(s) == pytest.approx(mtf, abs=5e-6)


def test_otf_is_the_overlap_of_two_circles():
    x, y = np.meshgrid(np.linspace(-1, 1, 2001), np.linspace(-1, 1, 2001))
    is_inside = x**2 + y**2 < 1
    for shift in (100, 400, 900):
        overlap = (is_inside[:, shift:] & is_inside[:, : 2001 - shift]).sum() / is_inside.sum()

        # The circles' centres are `shift` cells of 1/1000 radius apart; s is that over the diameter.
        assert circular_otf(shift / 2000) == pytest.approx(overlap, abs=2e-4)


# -- the diffraction pattern ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("side", "cells_per_lambda_n", "n"),
    [
        (1.0, 3, 1025),
        (1.0, 5, 1025),
        (1.0, 9, 2049),
        (0.5, 6, 1025),
        (1.5, 6, 1025),
        (2.0, 4.5, 1025),
        (2.44, 25 / 2.44, 2049),
    ],
)
def test_ensquared_energy_is_exact_where_the_square_has_its_edges_on_cell_borders(side, cells_per_lambda_n, n):
    power_map, lambda_n_um = airy_map(cells_per_lambda_n, n)

    assert ensquared(power_map, side * lambda_n_um) == pytest.approx(ENSQUARED[side], abs=1e-5)


@pytest.mark.parametrize("side", [0.5, 1.5, 2.0, 2.44])
def test_ensquared_energy_errs_by_the_square_of_the_cell_elsewhere(side):
    errors = []
    for cells_per_lambda_n in (5, 15):
        power_map, lambda_n_um = airy_map(cells_per_lambda_n, 1537)
        errors.append(ensquared(power_map, side * lambda_n_um) - ENSQUARED[side])

    # Three times finer: nine times less. A square's edge lies at another place of its cell each time, so only about.
    assert abs(errors[1]) < abs(errors[0]) / 4.5


@pytest.mark.parametrize("wavelength_nm", [450.0, 620.0])
def test_irradiance_of_a_point_follows_the_airy_formula(wavelength_nm):
    power_map, _ = airy_map(24, 1201, wavelength_nm=wavelength_nm)
    line = (
        power_map.data[0, 600, 600:700]
        * power_map.grid.cell_area_um2
        / (power_map.data.sum() * power_map.grid.cell_area_um2)
    )
    v = np.pi * np.arange(1, 100) / 24

    airy = (np.pi / 4) * (2 * j1(v) / v) ** 2 / 24**2  # fraction of the light in a cell of λN/24
    # Cell means differ from samples by the curvature of the pattern over a cell.
    assert line[1:] == pytest.approx(airy, abs=3e-3 * airy[0])


@pytest.mark.parametrize("cells_per_lambda_n", [0.07, 0.13, 0.19, 0.3, 0.4, 0.9, 1.7])
def test_cells_wider_than_the_pattern_hold_its_exact_share(cells_per_lambda_n):
    """The middle cell is a square of side 1/cells λN, whatever the sampling theorem says of the pattern."""
    power_map, lambda_n_um = airy_map(cells_per_lambda_n, 301)
    fine, _ = airy_map(cells_per_lambda_n * 15, 301 * 5)

    share = power_map.data[0, 150, 150] / power_map.data.sum()

    assert share == pytest.approx(ensquared(fine, lambda_n_um / cells_per_lambda_n), abs=2e-4)


def test_a_square_source_pixel_widens_the_pattern_by_its_square():
    point, _ = airy_map(3, 301)
    square, _ = airy_map(3, 301, lens(source_pixel="square"))
    fine, _ = airy_map(15, 1505)
    # A square pixel is the sum of its 25 parts, each a point on the finer grid (which errs by the part's square).
    steps = range(-2, 3)
    parts = sum(np.roll(fine.data[0], (dy, dx), (0, 1)) for dy in steps for dx in steps) / 25
    coarse = parts.reshape(301, 5, 301, 5).sum(axis=(1, 3))

    peak = point.data.max() / point.data.sum()
    assert square.data[0] / square.data.sum() == pytest.approx(coarse / coarse.sum(), abs=3e-3 * peak)
    assert square.data.max() < 0.97 * point.data.max()


# -- energy and falloff ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("precision", "tolerance"), [("single", 1e-6), ("double", 1e-12)])
@pytest.mark.parametrize("f_number", [1.4, 4.0, 16.0])
def test_no_light_is_lost(precision, tolerance, f_number):
    rng = np.random.default_rng(0)
    scene = fs.Scene.from_picture(
        rng.random((120, 150)),
        pitch_um=30.0,
        distance_m=0.56,
        peak_radiance_w_m2_sr_nm=1.0,
        band_width_nm=2.0,
        encoding="linear",
    )
    optics = lens(precision=precision, f_number=f_number)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        got_w = optics.power_map(scene).data.sum(dtype=np.float64) * optics.grid(scene).cell_area_um2
    x, y = np.meshgrid((np.arange(150) - 74.5) * 30e-6, (np.arange(120) - 59.5) * 30e-6)
    cos4 = (0.56**2 / (0.56**2 + x**2 + y**2)) ** 2
    # Every pixel's flux into the pupil: radiance x area x projected solid angle of the lens, on the scene's side.
    into_image = np.pi / (1 + 4 * optics.working_f_number(0.56) ** 2) * optics.magnification(0.56) ** 2
    flux_w = (2.0 * scene.basis[0].astype(np.float64) * 30.0**2 * cos4).sum() * into_image

    assert got_w == pytest.approx(flux_w, rel=tolerance)


@pytest.mark.parametrize("f_number", [1.4, 2.8, 8.0])
@pytest.mark.parametrize("distance_m", [0.06, 0.56, 1e4])
def test_radiance_on_the_axis_gives_the_irradiance_of_the_camera_equation(f_number, distance_m):
    optics = lens(f_number=f_number)
    d_mm = 1.0 / (1.0 / 22.0 - 1e-3 / distance_m)
    n_image = d_mm / (22.0 / f_number)  # image distance over pupil diameter
    scene = fs.Scene.flat(
        shape=(65, 65), pitch_um=distance_m, distance_m=distance_m, radiance_w_m2_sr_nm=3.0, band_width_nm=5.0
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        on_axis = optics.power_map(scene).data[0, 32, 32]

    assert on_axis == pytest.approx(np.pi * 15.0 / (1 + 4 * n_image**2), rel=1e-6)


@pytest.mark.parametrize(("emission", "power"), [("lambertian", 4), ("isotropic", 3)])
@pytest.mark.parametrize(("precision", "tolerance"), [("single", 1e-6), ("double", 1e-12)])
@pytest.mark.parametrize("at", [(64, 128), (0, 64), (128, 0), (10, 97)])
def test_light_of_a_point_falls_off_by_the_cosine_law(emission, power, precision, tolerance, at):
    half_m = 0.56 * np.tan(np.radians(30.0))  # the middle of the border is at 30 degrees
    pitch_um = half_m * 1e6 / 64
    optics = lens(emission=emission, precision=precision, f_number=1.4)

    def light_of(pixel):
        scene = fs.Scene.point_sources(
            shape=(129, 129),
            pixels=[pixel],
            intensity_w_sr_nm=1.0,
            pitch_um=pitch_um,
            distance_m=0.56,
            band_width_nm=1.0,
        )
        return optics.power_map(scene).data.sum(dtype=np.float64)

    radius_m = np.hypot(at[0] - 64, at[1] - 64) * pitch_um * 1e-6
    cos = 0.56 / np.hypot(0.56, radius_m)

    assert light_of(at) / light_of((64, 64)) == pytest.approx(cos**power, rel=tolerance)
    assert at != (64, 128) or cos**4 == pytest.approx(0.5625)


@pytest.mark.parametrize(("emission", "power"), [("lambertian", 4), ("isotropic", 3)])
def test_a_flat_scene_shows_the_cosine_law_over_its_field(emission, power):
    """The far wings of the diffraction pattern mix the field a little, here by less than 2e-5."""
    n = 257
    half_m = 0.56 * np.tan(np.radians(30.0))
    scene = fs.Scene.flat(
        shape=(n, n), pitch_um=half_m * 2e6 / (n - 1), distance_m=0.56, radiance_w_m2_sr_nm=1.0, band_width_nm=1.0
    )
    data = lens(emission=emission, f_number=1.0).power_map(scene).data[0]
    x, y = np.meshgrid(np.linspace(-half_m, half_m, n), np.linspace(-half_m, half_m, n))
    cos = 0.56 / np.sqrt(0.56**2 + x**2 + y**2)
    inside = slice(20, -20)

    assert (data / data[n // 2, n // 2])[inside, inside] == pytest.approx((cos**power)[inside, inside], abs=2e-5)


def test_isotropic_points_give_the_irradiance_of_equation_3():
    """Eq. 3 integrated over the sensor plane: A0² p0² cos³ (π a²) / (2π H²) for each pixel of the scene."""
    optics = lens(emission="isotropic")
    power_map, _ = airy_map(3, 201, optics)
    pitch_m = power_map.grid.pitch_um * 1e-6 / optics.magnification(DISTANCE_M)
    a_m = 22e-3 / 4.0 / 2
    radiance = 1e-9 / pitch_m**2

    flux_w = radiance * pitch_m**2 * np.pi * a_m**2 / (2 * np.pi * DISTANCE_M**2)

    assert power_map.data.sum() * power_map.grid.cell_area_um2 * 1e-12 == pytest.approx(flux_w, rel=1e-12)


@pytest.mark.parametrize("f_number", [1.4, 2.8, 4.0])
@pytest.mark.parametrize("distance_m", [0.5, 1e4])
def test_aplanatic_irradiance_conserves_entrance_pupil_flux(f_number, distance_m):
    """Radiance times the projected solid angle of the entrance pupil, summed over its rings, spread over the geometric image."""
    optics = lens(f_number=f_number, lens="aplanatic")
    a_m = 0.5 * 22e-3 / f_number
    r_m = a_m * (np.arange(2000) + 0.5) / 2000
    cos2 = distance_m**2 / (distance_m**2 + r_m**2)
    projected_sr = (2.0 * np.pi * r_m * cos2**2 / distance_m**2).sum() * a_m / 2000
    per_radiance_sr = projected_sr / optics.magnification(distance_m) ** 2

    # Small pupil against the distance of the scene: off by (a/H)², at most 2.5e-4 here.
    assert optics.irradiance_per_radiance(distance_m) == pytest.approx(
        per_radiance_sr, rel=(a_m / distance_m) ** 2 + 1e-6
    )
    isotropic = lens(f_number=f_number, lens="aplanatic", emission="isotropic")
    # A hemisphere of even radiance emits π L per area, isotropic points L in 2π sr: a factor of 2π on the axis.
    assert optics.irradiance_per_radiance(distance_m) == pytest.approx(
        2.0 * np.pi * isotropic.irradiance_per_radiance(distance_m), rel=1e-14
    )


@pytest.mark.parametrize(("f_number", "percent"), [(4.0, 1.56), (2.8, 3.19), (1.4, 12.76)])
def test_thin_and_aplanatic_irradiance_differ(f_number, percent):
    thin, aplanatic = (
        lens(f_number=f_number, lens=kind).irradiance_per_radiance(np.inf) for kind in ("thin", "aplanatic")
    )

    assert 100.0 * (aplanatic / thin - 1.0) == pytest.approx(percent, abs=0.01)
    assert lens(f_number=f_number).irradiance_per_radiance(np.inf) == thin


def test_transmission_scales_the_light():
    full, _ = airy_map(3, 101)
    half, _ = airy_map(3, 101, lens(transmission=0.5))

    assert half.data == pytest.approx(0.5 * full.data, abs=1e-15 * full.data.max())


# -- geometry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("focal_mm", "distance_m", "m"), [(22.0, 0.56, 22 / 538), (50.0, 0.1, 1.0), (35.0, 35.035, 1e-3)]
)
def test_magnification_is_that_of_the_thin_lens(focal_mm, distance_m, m):
    assert lens(focal_length_mm=focal_mm).magnification(distance_m) == pytest.approx(m, rel=1e-12)


def test_the_picture_is_upright_and_not_mirrored():
    target = np.zeros((40, 60))
    target[30, 45] = 1.0  # high and to the right
    scene = fs.Scene(target[np.newaxis], np.ones((1, 1)), np.array([550.0]), np.array([1.0]), 100.0, 0.56)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        power_map = lens().power_map(scene)
    brightest = np.unravel_index(power_map.data[0].argmax(), (40, 60))

    assert brightest == (30, 45)
    assert power_map.grid.y_um[30] > 0 < power_map.grid.x_um[45]


# -- padding -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("padding", ["reflect", "edge"])
def test_a_flat_scene_stays_flat_to_its_borders(padding):
    scene = fs.Scene.flat(shape=(150, 151), pitch_um=11.6, distance_m=10.0, radiance_w_m2_sr_nm=1.0, band_width_nm=1.0)
    data = lens(padding=padding, focal_length_mm=400.0).power_map(scene).data[0]

    assert data == pytest.approx(np.full(data.shape, data.mean()), rel=1e-6)


def test_darkness_around_the_picture_takes_light_from_its_border():
    scene = fs.Scene.flat(shape=(150, 151), pitch_um=11.6, distance_m=0.56, radiance_w_m2_sr_nm=1.0, band_width_nm=1.0)
    data = lens(padding="zero").power_map(scene).data[0]

    # At a straight border half the blur's weight lies in the dark, in a corner three quarters.
    assert data[75, 0] / data[75, 75] == pytest.approx(0.5, abs=0.1)
    assert data[0, 0] / data[75, 75] == pytest.approx(0.25, abs=0.1)


@pytest.mark.parametrize("shape", [(60, 41), (33, 1), (1, 50)])
@pytest.mark.parametrize("padding", ["reflect", "edge", "zero", "periodic"])
@pytest.mark.parametrize("cells_per_lambda_n", [4.1, 1.3, 0.21])
def test_a_map_is_the_padded_picture_convolved_with_the_pattern(shape, padding, cells_per_lambda_n):
    """The twin adds up shifted copies of the pattern of one point, from a far larger periodic picture."""
    rng = np.random.default_rng(shape[0])
    pad = 15
    mode = {"reflect": "reflect", "edge": "edge", "zero": "constant", "periodic": "wrap"}[padding]
    image = rng.random(shape)
    pattern_map, _ = airy_map(cells_per_lambda_n, 401, lens(focal_length_mm=1.0))
    pattern = pattern_map.data[0] / pattern_map.data[0].sum()
    optics = lens(focal_length_mm=1.0, padding=padding, padding_cells=pad)
    pitch_um = pattern_map.grid.pitch_um / optics.magnification(DISTANCE_M)
    scene = fs.Scene(image[np.newaxis], np.ones((1, 1)), np.array([550.0]), np.array([1.0]), pitch_um, DISTANCE_M)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        got = optics.power_map(scene).data[0] / optics.irradiance_per_radiance(DISTANCE_M)

    tan2 = [((np.arange(n) - (n - 1) / 2) * pitch_um * 1e-6 / DISTANCE_M) ** 2 for n in shape]
    lit = image / (1 + tan2[0][:, np.newaxis] + tan2[1]) ** 2
    # Periods as the transform has them: the padded size made fast, or the picture itself.
    periods = [n if padding == "periodic" else scipy.fft.next_fast_len(n + 2 * pad, real=True) for n in shape]
    widths = [((p - n) // 2, p - n - (p - n) // 2) for n, p in zip(shape, periods, strict=True)]
    padded = np.pad(lit, widths, mode=mode)
    wrapped = np.zeros(padded.shape)
    iy, ix = np.mgrid[-200:201, -200:201]
    np.add.at(wrapped, (iy % periods[0], ix % periods[1]), pattern)
    expected = np.real(np.fft.ifft2(np.fft.fft2(padded) * np.fft.fft2(wrapped)))
    expected = expected[widths[0][0] :, widths[1][0] :][: shape[0], : shape[1]]

    # The pattern's own picture ends at 200 cells: 2 / (π² r) of its light lies beyond r = 200 cells in units of λN, and comes
    # back on its other side.
    astray = 2 / np.pi**2 / (200 / cells_per_lambda_n)
    assert got == pytest.approx(expected, abs=astray * lit.max() + 1e-6)


# -- wavelengths --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["single", "double"])
def test_the_collapsed_route_equals_the_sum_of_the_power_maps(precision):
    rng = np.random.default_rng(1)
    wavelength_nm = np.linspace(420.0, 700.0, 15)
    scene = fs.Scene(
        rng.random((3, 64, 80)),
        rng.random((3, 15)),
        wavelength_nm,
        rng.uniform(5, 20, 15),
        pitch_um=20.0,
        distance_m=0.7,
    )
    optics = fs.Optics(focal_length_mm=25.0, f_number=5.6, precision=precision)
    weights = rng.random((4, 15))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        maps = optics.power_map(scene).data.astype(np.float64)
        collapsed = np.stack(list(optics.weighted_maps(scene, weights)))

    expected = np.tensordot(weights, maps, axes=1)
    assert collapsed == pytest.approx(expected, abs=expected.max() * (3e-6 if precision == "single" else 3e-8))


def test_each_wavelength_has_its_own_blur():
    blue, _ = airy_map(6, 401, wavelength_nm=450.0)
    scene = fs.Scene.point_sources(
        shape=(401, 401),
        pixels=[(200, 200)],
        intensity_w_sr_nm=1e-9,
        pitch_um=blue.grid.pitch_um / lens().magnification(DISTANCE_M),
        distance_m=DISTANCE_M,
        wavelength_nm=[450.0, 900.0],
        band_width_nm=1.0,
    )
    both = lens().power_map(scene).data

    assert both[0] == pytest.approx(blue.data[0], rel=1e-6, abs=1e-9 * blue.data.max())
    # Twice the wavelength: four times the area, a quarter of the peak (less what a cell mean takes off the sharper one).
    assert both[1].max() / both[0].max() == pytest.approx(0.25, rel=0.02)


def test_weights_of_zero_cost_and_give_nothing():
    scene = fs.Scene.flat(shape=(32, 32), pitch_um=500.0, distance_m=1.0, radiance_w_m2_sr_nm=1.0, band_width_nm=1.0)
    dark, light = lens(padding="reflect").weighted_maps(scene, np.array([[0.0], [1.0]]))

    assert not dark.any()
    assert light.min() > 0


# -- limits -------------------------------------------------------------------------------------------------------------


def test_too_small_a_picture_for_the_aperture_is_warned_of():
    scene = fs.Scene.flat(shape=(20, 400), pitch_um=11.6, distance_m=0.56, radiance_w_m2_sr_nm=1.0, band_width_nm=1.0)

    # a / (H λ / (p0 min(M, N))) = 1.375 mm / (0.56 m x 550 nm / (11.6 µm x 20)) = 1.04 at f/8
    with pytest.warns(SamplingWarning, match=r"Eq\. 5 wants .*, and it is 1\.04 times that"):
        lens(f_number=8.0).power_map(scene)


@pytest.mark.parametrize("distance_m", [0.022, 0.01, 1e-6])
def test_a_scene_inside_the_focal_length_is_refused(distance_m):
    scene = fs.Scene.flat(
        shape=(20, 20), pitch_um=1.0, distance_m=distance_m, radiance_w_m2_sr_nm=1.0, band_width_nm=1.0
    )

    with pytest.raises(ParameterError, match=r"'distance_m' must be larger than the focal length, 0\.022 m"):
        lens().power_map(scene)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("focal_length_mm", 0.0, "must be > 0, got 0.0 mm"),
        ("focal_length_mm", float("nan"), "must be finite"),
        ("f_number", -2.0, "must be > 0, got -2.0"),
        ("f_number", "4", "must be one number"),
        ("emission", "lambert", "must be one of 'lambertian', 'isotropic', got 'lambert'"),
        ("transmission", 1.2, "must be <= 1, got 1.2"),
        ("padding", None, "must be one of 'reflect'"),
        ("padding_cells", 2.5, "must be an integer"),
        ("padding_cells", -1, "must be >= 0"),
        ("precision", "half", "must be one of 'single', 'double'"),
        ("source_pixel", "round", "must be one of 'point', 'square'"),
    ],
)
def test_a_bad_parameter_is_refused_by_name(name, value, message):
    with pytest.raises(ParameterError, match=f"'{name}' {message}"):
        lens(**{name: value})

"""Optics against closed forms: Airy pattern, relative illumination, lens photometry, energy."""

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
#: Ensquared energy of the Airy pattern for squares of side x λN, from numerical double integration.
ENSQUARED = {0.5: 0.177327, 1.0: 0.528891, 1.5: 0.766734, 2.0: 0.833845, 2.44: 0.844488}


def lens(**changes):
    values = {"focal_length_mm": 22.0, "f_number": 4.0, "precision": "double", "padding": "periodic"}
    return fs.Optics(**{**values, **changes})


def airy_map(cells_per_lambda_n, n, optics=None, wavelength_nm=550.0):
    """Map of a point source at the centre of the map, with the given number of cells per λN."""
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


# -- transfer function -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("s", "mtf"), [(0.0, 1.0), (0.25, 0.68504), (0.5, 0.39100), (0.40397, 0.5), (1.0, 0.0), (3.0, 0.0)]
)
def test_circular_otf_matches_tabulated_values(s, mtf):
    assert circular_otf(s) == pytest.approx(mtf, abs=5e-6)


def test_circular_otf_equals_circle_overlap():
    x, y = np.meshgrid(np.linspace(-1, 1, 2001), np.linspace(-1, 1, 2001))
    is_inside = x**2 + y**2 < 1
    for shift in (100, 400, 900):
        overlap = (is_inside[:, shift:] & is_inside[:, : 2001 - shift]).sum() / is_inside.sum()

        # The centres of the circles are `shift` / 1000 radii apart; s is this distance over the diameter.
        assert circular_otf(shift / 2000) == pytest.approx(overlap, abs=2e-4)


# -- point spread function ------------------------------------------------------------------------------------------


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
def test_cell_aligned_ensquared_energy_is_exact(side, cells_per_lambda_n, n):
    power_map, lambda_n_um = airy_map(cells_per_lambda_n, n)

    assert ensquared(power_map, side * lambda_n_um) == pytest.approx(ENSQUARED[side], abs=1e-5)


@pytest.mark.parametrize("side", [0.5, 1.5, 2.0, 2.44])
def test_ensquared_energy_error_is_second_order(side):
    errors = []
    for cells_per_lambda_n in (5, 15):
        power_map, lambda_n_um = airy_map(cells_per_lambda_n, 1537)
        errors.append(ensquared(power_map, side * lambda_n_um) - ENSQUARED[side])

    # Cells three times finer reduce the error about nine times; the factor varies with the position of the edge in its cell.
    assert abs(errors[1]) < abs(errors[0]) / 4.5


@pytest.mark.parametrize("wavelength_nm", [450.0, 620.0])
def test_point_irradiance_follows_airy_pattern(wavelength_nm):
    power_map, _ = airy_map(24, 1201, wavelength_nm=wavelength_nm)
    line = (
        power_map.data[0, 600, 600:700]
        * power_map.grid.cell_area_um2
        / (power_map.data.sum() * power_map.grid.cell_area_um2)
    )
    v = np.pi * np.arange(1, 100) / 24

    airy = (np.pi / 4) * (2 * j1(v) / v) ** 2 / 24**2  # fraction of the energy in a cell of λN/24
    # Cell means differ from samples by the curvature of the PSF over a cell.
    assert line[1:] == pytest.approx(airy, abs=3e-3 * airy[0])


@pytest.mark.parametrize("cells_per_lambda_n", [0.07, 0.13, 0.19, 0.3, 0.4, 0.9, 1.7])
def test_wide_cells_contain_exact_ensquared_energy(cells_per_lambda_n):
    """The centre cell is a square of side 1/cells λN, also where the PSF is undersampled."""
    power_map, lambda_n_um = airy_map(cells_per_lambda_n, 301)
    fine, _ = airy_map(cells_per_lambda_n * 15, 301 * 5)

    fraction = power_map.data[0, 150, 150] / power_map.data.sum()

    assert fraction == pytest.approx(ensquared(fine, lambda_n_um / cells_per_lambda_n), abs=2e-4)


def test_square_source_pixel_convolves_psf():
    point, _ = airy_map(3, 301)
    square, _ = airy_map(3, 301, lens(source_pixel="square"))
    fine, _ = airy_map(15, 1505)
    # A square pixel is the sum of 25 points on the finer grid, up to the size of its cells.
    steps = range(-2, 3)
    parts = sum(np.roll(fine.data[0], (dy, dx), (0, 1)) for dy in steps for dx in steps) / 25
    coarse = parts.reshape(301, 5, 301, 5).sum(axis=(1, 3))

    peak = point.data.max() / point.data.sum()
    assert square.data[0] / square.data.sum() == pytest.approx(coarse / coarse.sum(), abs=3e-3 * peak)
    assert square.data.max() < 0.97 * point.data.max()


# -- energy and relative illumination -------------------------------------------------------------------------------


@pytest.mark.parametrize(("precision", "tolerance"), [("single", 1e-6), ("double", 1e-12)])
@pytest.mark.parametrize("f_number", [1.4, 4.0, 16.0])
def test_power_map_conserves_flux(precision, tolerance, f_number):
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
    # Flux of each pixel into the pupil: radiance x area x projected solid angle of the lens in object space.
    into_image = np.pi / (1 + 4 * optics.working_f_number(0.56) ** 2) * optics.magnification(0.56) ** 2
    flux_w = (2.0 * scene.basis[0].astype(np.float64) * 30.0**2 * cos4).sum() * into_image

    assert got_w == pytest.approx(flux_w, rel=tolerance)


@pytest.mark.parametrize("f_number", [1.4, 2.8, 8.0])
@pytest.mark.parametrize("distance_m", [0.06, 0.56, 1e4])
def test_on_axis_irradiance_follows_camera_equation(f_number, distance_m):
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


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize(("emission", "power"), [("lambertian", 4), ("isotropic", 3)])
@pytest.mark.parametrize(("precision", "tolerance"), [("single", 1e-6), ("double", 1e-12)])
@pytest.mark.parametrize("at", [(64, 128), (0, 64), (128, 0), (10, 97)])
def test_point_flux_follows_cosine_falloff(emission, power, precision, tolerance, at):
    half_m = 0.56 * np.tan(np.radians(30.0))  # the centre of an edge is at 30 degrees
    pitch_um = half_m * 1e6 / 64
    optics = lens(emission=emission, precision=precision, f_number=1.4)

    def flux_of(pixel):
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

    assert flux_of(at) / flux_of((64, 64)) == pytest.approx(cos**power, rel=tolerance)
    assert at != (64, 128) or cos**4 == pytest.approx(0.5625)


@pytest.mark.parametrize(("emission", "power"), [("lambertian", 4), ("isotropic", 3)])
def test_uniform_scene_follows_cosine_falloff(emission, power):
    """The far wings of the PSF average over the field; the effect is below 2e-5 here."""
    n = 257
    half_m = 0.56 * np.tan(np.radians(30.0))
    scene = fs.Scene.flat(
        shape=(n, n), pitch_um=half_m * 2e6 / (n - 1), distance_m=0.56, radiance_w_m2_sr_nm=1.0, band_width_nm=1.0
    )
    data = lens(emission=emission, f_number=1.0).power_map(scene).data[0]
    x, y = np.meshgrid(np.linspace(-half_m, half_m, n), np.linspace(-half_m, half_m, n))
    cos = 0.56 / np.sqrt(0.56**2 + x**2 + y**2)
    inside = slice(20, -20)

    found = data / data[n // 2, n // 2]
    np.testing.assert_allclose(found[inside, inside], (cos**power)[inside, inside], rtol=0.0, atol=2e-5)


def test_isotropic_irradiance_follows_equation_3():
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

    # The small-pupil approximation is off by (a/H)², at most 2.5e-4 here.
    assert optics.irradiance_per_radiance(distance_m) == pytest.approx(
        per_radiance_sr, rel=(a_m / distance_m) ** 2 + 1e-6
    )
    isotropic = lens(f_number=f_number, lens="aplanatic", emission="isotropic")
    # A Lambertian surface emits π L per area, isotropic points emit L into 2π sr: a factor of 2π on the axis.
    assert optics.irradiance_per_radiance(distance_m) == pytest.approx(
        2.0 * np.pi * isotropic.irradiance_per_radiance(distance_m), rel=1e-14
    )


@pytest.mark.parametrize(("f_number", "percent"), [(4.0, 1.56), (2.8, 3.19), (1.4, 12.76)])
def test_aplanatic_irradiance_exceeds_thin_lens(f_number, percent):
    thin, aplanatic = (
        lens(f_number=f_number, lens=kind).irradiance_per_radiance(np.inf) for kind in ("thin", "aplanatic")
    )

    assert 100.0 * (aplanatic / thin - 1.0) == pytest.approx(percent, abs=0.01)
    assert lens(f_number=f_number).irradiance_per_radiance(np.inf) == thin


def test_transmission_scales_irradiance():
    full, _ = airy_map(3, 101)
    half, _ = airy_map(3, 101, lens(transmission=0.5))

    np.testing.assert_allclose(half.data, 0.5 * full.data, rtol=0.0, atol=1e-15 * full.data.max())


# -- geometry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("focal_mm", "distance_m", "m"), [(22.0, 0.56, 22 / 538), (50.0, 0.1, 1.0), (35.0, 35.035, 1e-3)]
)
def test_magnification_follows_thin_lens_equation(focal_mm, distance_m, m):
    assert lens(focal_length_mm=focal_mm).magnification(distance_m) == pytest.approx(m, rel=1e-12)


def test_picture_is_upright_and_not_mirrored():
    target = np.zeros((40, 60))
    target[30, 45] = 1.0  # upper right
    scene = fs.Scene(target[np.newaxis], np.ones((1, 1)), np.array([550.0]), np.array([1.0]), 100.0, 0.56)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        power_map = lens().power_map(scene)
    brightest = np.unravel_index(power_map.data[0].argmax(), (40, 60))

    assert brightest == (30, 45)
    assert power_map.grid.y_um[30] > 0 < power_map.grid.x_um[45]


# -- padding -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("padding", ["reflect", "edge"])
def test_uniform_scene_stays_uniform_at_boundary(padding):
    scene = fs.Scene.flat(shape=(150, 151), pitch_um=11.6, distance_m=10.0, radiance_w_m2_sr_nm=1.0, band_width_nm=1.0)
    data = lens(padding=padding, focal_length_mm=400.0).power_map(scene).data[0]

    assert data == pytest.approx(np.full(data.shape, data.mean()), rel=1e-6)


def test_zero_padding_reduces_boundary_irradiance():
    scene = fs.Scene.flat(shape=(150, 151), pitch_um=11.6, distance_m=0.56, radiance_w_m2_sr_nm=1.0, band_width_nm=1.0)
    data = lens(padding="zero").power_map(scene).data[0]

    # Outside the picture lies half of the PSF at an edge, and three quarters at a corner.
    assert data[75, 0] / data[75, 75] == pytest.approx(0.5, abs=0.1)
    assert data[0, 0] / data[75, 75] == pytest.approx(0.25, abs=0.1)


@pytest.mark.parametrize("shape", [(60, 41), (33, 1), (1, 50)])
@pytest.mark.parametrize("padding", ["reflect", "edge", "zero", "periodic"])
@pytest.mark.parametrize("cells_per_lambda_n", [4.1, 1.3, 0.21])
def test_map_equals_padded_picture_convolved_with_psf(shape, padding, cells_per_lambda_n):
    """Reference: sum of shifted PSFs, taken from a much larger periodic picture."""
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
    # Periods of the transform: the padded size rounded up to a fast FFT size, or the picture size.
    periods = [n if padding == "periodic" else scipy.fft.next_fast_len(n + 2 * pad, real=True) for n in shape]
    widths = [((p - n) // 2, p - n - (p - n) // 2) for n, p in zip(shape, periods, strict=True)]
    padded = np.pad(lit, widths, mode=mode)
    wrapped = np.zeros(padded.shape)
    iy, ix = np.mgrid[-200:201, -200:201]
    np.add.at(wrapped, (iy % periods[0], ix % periods[1]), pattern)
    expected = np.real(np.fft.ifft2(np.fft.fft2(padded) * np.fft.fft2(wrapped)))
    expected = expected[widths[0][0] :, widths[1][0] :][: shape[0], : shape[1]]

    # The PSF is known up to 200 cells: 2 / (π² r) of its energy lies beyond r = 200 cells, in units of λN, and wraps around.
    wrapped_fraction = 2 / np.pi**2 / (200 / cells_per_lambda_n)
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=wrapped_fraction * lit.max() + 1e-6)


# -- wavelengths --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["single", "double"])
def test_weighted_maps_equal_weighted_sum_of_maps(precision):
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
    tolerance = 3e-6 if precision == "single" else 3e-8
    np.testing.assert_allclose(collapsed, expected, rtol=0.0, atol=tolerance * expected.max())


@pytest.mark.slow
def test_psf_width_scales_with_wavelength():
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

    np.testing.assert_allclose(both[0], blue.data[0], rtol=1e-6, atol=1e-9 * blue.data.max())
    # Twice the wavelength: four times the area and a quarter of the peak, apart from the averaging over cells.
    assert both[1].max() / both[0].max() == pytest.approx(0.25, rel=0.02)


def test_zero_weights_give_zero_map():
    scene = fs.Scene.flat(shape=(32, 32), pitch_um=500.0, distance_m=1.0, radiance_w_m2_sr_nm=1.0, band_width_nm=1.0)
    dark, light = lens(padding="reflect").weighted_maps(scene, np.array([[0.0], [1.0]]))

    assert not dark.any()
    assert light.min() > 0


# -- limits -------------------------------------------------------------------------------------------------------------


def test_small_picture_warns_about_equation_5():
    scene = fs.Scene.flat(shape=(20, 400), pitch_um=11.6, distance_m=0.56, radiance_w_m2_sr_nm=1.0, band_width_nm=1.0)

    # a / (H λ / (p0 min(M, N))) = 1.375 mm / (0.56 m x 550 nm / (11.6 µm x 20)) = 1.04 at f/8
    with pytest.warns(SamplingWarning, match=r"an aperture radius much larger than .*, got 1\.04 times"):
        lens(f_number=8.0).power_map(scene)


@pytest.mark.parametrize("distance_m", [0.022, 0.01, 1e-6])
def test_scene_within_focal_length_raises(distance_m):
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
def test_invalid_optics_parameter_raises(name, value, message):
    with pytest.raises(ParameterError, match=f"'{name}' {message}"):
        lens(**{name: value})

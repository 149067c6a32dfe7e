"""Oversampled power maps: exact cell means, and photosites as small as the PSF."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j1

import foveasim as fs
from foveasim.errors import SamplingWarning
from foveasim.optics import _field_modes

DISTANCE_M = 1.0
WAVELENGTH_NM = 500.0
OPTICS = fs.Optics(focal_length_mm=10.0, f_number=4.0, precision="double", padding="periodic")
LAMBDA_N_UM = 1e-3 * WAVELENGTH_NM * OPTICS.working_f_number(DISTANCE_M)


def pitch_of(cells_per_lambda_n):
    """Pixel pitch of a scene for a given number of image pixels per λN."""
    return LAMBDA_N_UM / cells_per_lambda_n / OPTICS.magnification(DISTANCE_M)


def points_of(cells_per_lambda_n, shape, pixels):
    return fs.Scene.point_sources(
        shape=shape,
        pixels=pixels,
        intensity_w_sr_nm=1.0,
        pitch_um=pitch_of(cells_per_lambda_n),
        distance_m=DISTANCE_M,
        wavelength_nm=WAVELENGTH_NM,
        band_width_nm=1.0,
    )


def block_means(cells, k):
    n_y, n_x = cells.shape
    return cells.reshape(n_y // k, k, n_x // k, k).mean(axis=(1, 3))


def airy_energy(centre, sides):
    """Energy of the Airy pattern in rectangles, in λN: Gauss quadrature of (2 J1(πr) / πr)² π/4."""
    node, weight = np.polynomial.legendre.leggauss(24)
    found = []
    for (x, y), (width, height) in zip(centre, sides, strict=True):
        r = np.pi * np.hypot(*np.meshgrid(x + 0.5 * width * node, y + 0.5 * height * node)) + 1e-12
        found.append(0.25 * width * height * np.pi / 4 * ((2.0 * j1(r) / r) ** 2 * np.outer(weight, weight)).sum())
    return np.array(found)


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("k", [2, 3, 4, 5])
@pytest.mark.parametrize("cells_per_lambda_n", [0.3, 0.7, 1.2, 3.0])
@pytest.mark.parametrize(("source_pixel", "pupil"), [("point", "circle"), ("square", "coma")])
def test_fine_cells_average_to_source_cells(k, cells_per_lambda_n, source_pixel, pupil):
    optics = replace(OPTICS, source_pixel=source_pixel)
    if pupil == "coma":
        optics = replace(optics, pupil=fs.optics.Blades(5), zernike=fs.optics.Zernike(coefficients={7: 0.1, 5: 0.05}))
    scene = points_of(cells_per_lambda_n, (66, 70), [(10, 50), (45, 3)])
    coarse = optics.power_map(scene)
    fine = replace(optics, oversample=k).power_map(scene)

    assert fine.grid.bounds_um == pytest.approx(coarse.grid.bounds_um, rel=1e-12)
    assert fine.grid.shape == (66 * k, 70 * k)
    # Sums of many aliases are interpolated: 3e-7 of the peak for a circle, 1e-4 for other pupils.
    tolerance = {"circle": 1e-6, "coma": 1e-4}[pupil] if cells_per_lambda_n < 0.7 else 1e-12
    np.testing.assert_allclose(block_means(fine.data[0], k), coarse.data[0], atol=tolerance * coarse.data.max())


@pytest.mark.parametrize(("cells_per_lambda_n", "k"), [(0.5, 2), (0.7, 3), (1.2, 2), (2.0, 2), (1.0, 5)])
def test_fine_cells_contain_airy_energy(cells_per_lambda_n, k):
    n = 160
    scene = points_of(cells_per_lambda_n, (n, n), [(n // 2, n // 2)])
    fine = replace(OPTICS, oversample=k).power_map(scene)
    at_um = -0.5 * n * LAMBDA_N_UM / cells_per_lambda_n + (n // 2 + 0.5) * LAMBDA_N_UM / cells_per_lambda_n
    near = slice(k * n // 2 - 2 * k, k * n // 2 + 3 * k)
    x, y = np.meshgrid(fine.grid.x_um[near] - at_um, fine.grid.y_um[near] - at_um)
    centre = np.stack((x.ravel(), y.ravel()), axis=1) / LAMBDA_N_UM
    sides = np.full(centre.shape, fine.grid.pitch_x_um / LAMBDA_N_UM)
    got = fine.data[0, near, near].ravel() / fine.data.sum()

    # In a periodic picture of at least 80 λN, the 0.25 % of the energy beyond it is spread uniformly over the cells.
    np.testing.assert_allclose(got, airy_energy(centre, sides), atol=2e-3 * sides[0, 0] ** 2)


@pytest.mark.parametrize("padding", ["reflect", "zero", "periodic"])
@pytest.mark.parametrize("source_pixel", ["point", "square"])
def test_uniform_scene_stays_uniform_on_fine_cells(padding, source_pixel):
    optics = replace(OPTICS, padding=padding, source_pixel=source_pixel, oversample=3)
    scene = fs.Scene.flat(
        shape=(80, 90),
        pitch_um=pitch_of(1.3),
        distance_m=DISTANCE_M,
        radiance_w_m2_sr_nm=1.0,
        wavelength_nm=WAVELENGTH_NM,
        band_width_nm=1.0,
    )
    data = optics.power_map(scene).data[0]
    centre = data[90:150, 90:180]

    # At most 0.03 mm off the axis at 10 mm. With zero padding, the wings of the PSF are missing.
    assert np.ptp(centre) / centre.mean() < (0.02 if padding == "zero" else 5e-5)


@pytest.mark.parametrize("cells_per_lambda_n", [1.0, 1.2, 1.5, 2.0, 3.0, 4.5])
def test_auto_oversample_bounds_pixel_error(cells_per_lambda_n):
    """Energy of a point in pixels of side λN at random offsets, against quadrature of the Airy pattern."""
    n = int(80 * cells_per_lambda_n) // 2 * 2
    scene = points_of(cells_per_lambda_n, (n, n), [(n // 2, n // 2)])
    point_um = 0.5 * LAMBDA_N_UM / cells_per_lambda_n
    offset = np.random.default_rng(5).uniform(-1.5, 1.5, (400, 2))
    everything = [[0.0, 0.0, 0.999 * n * LAMBDA_N_UM / cells_per_lambda_n]]
    squares = np.concatenate(
        (np.column_stack((point_um + offset * LAMBDA_N_UM, np.full(400, LAMBDA_N_UM))), everything)
    )
    layout = fs.Layout.from_rectangles(squares[:, :2], squares[:, 2:] * [1.0, 1.0])
    truth = airy_energy(offset, np.ones((400, 2)))
    errors = {}
    for oversample in ("auto", 1):
        camera = fs.Camera(optics=replace(OPTICS, oversample=oversample), sensor=fs.Sensor(layout))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SamplingWarning)
            rate = camera.photoelectrons_per_s(scene)
        errors[oversample] = np.abs(rate[:-1] / rate[-1] - truth).max()

    assert errors["auto"] < 1e-3
    assert errors[1] > 1.3e-3


def test_capture_settings_contain_oversample():
    sensor = fs.Sensor(fs.layout.grid(n_x=10, n_y=10, pitch_um=2.0))
    camera = fs.Camera(optics=replace(OPTICS, padding="reflect"), sensor=sensor)
    capture = camera.capture(points_of(1.5, (100, 100), [(50, 50)]), exposure_s=1e-3, seed=0)

    assert capture.settings["oversample"] == 4  # 5.5 / 1.5, rounded up
    assert capture.settings["integration_order"] == 2
    assert camera.power_map(points_of(1.5, (100, 100), [(50, 50)])).grid.shape == (400, 400)


def test_wide_source_pixels_disable_auto_oversample():
    """For pixels wider than λN, finer cells would resolve each emitter."""
    scene = points_of(0.9, (120, 120), [(60, 60)])
    sensor = fs.Sensor(fs.layout.grid(n_x=10, n_y=10, pitch_um=2.0))
    auto, plain = (fs.Camera(optics=replace(OPTICS, oversample=k), sensor=sensor) for k in ("auto", 1))

    assert auto.oversample(scene) == 1
    with pytest.warns(SamplingWarning, match="since source pixels are points farther apart than λN"):
        assert (auto.photoelectrons_per_s(scene) == plain.photoelectrons_per_s(scene)).all()


def photograph(pixel_lambda_n, shape=(30, 30)):
    """Random pixels of a given width in λN."""
    image = np.random.default_rng(1).random((1, *shape))
    pitch_um = pixel_lambda_n * LAMBDA_N_UM / OPTICS.magnification(DISTANCE_M)
    return fs.Scene(image, np.ones((1, 1)), np.array([WAVELENGTH_NM]), np.ones(1), pitch_um, DISTANCE_M)


def sites_of(side_um, half_um, n=100):
    at_um = np.random.default_rng(2).uniform(-half_um, half_um, (n, 2))
    return fs.Sensor(fs.Layout.from_rectangles(at_um, side_um))


@pytest.mark.parametrize("pixel_lambda_n", [0.97, 1.03, 1.6, 2.8])
def test_auto_oversample_resolves_wide_square_pixels(pixel_lambda_n):
    """Reference: 16 cells per source pixel."""
    scene = photograph(pixel_lambda_n)
    sensor = sites_of(LAMBDA_N_UM, 8.0 * pixel_lambda_n * LAMBDA_N_UM)
    square = replace(OPTICS, source_pixel="square")
    fine = replace(square, oversample=16 if pixel_lambda_n < 2.0 else "auto")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        rate, truth = (fs.Camera(optics=o, sensor=sensor).photoelectrons_per_s(scene) for o in (square, fine))

    assert square.auto_oversample(scene) >= 5.5 * pixel_lambda_n
    assert np.abs(rate - truth).max() < 1e-3 * truth.mean()


def test_limited_auto_oversample_warns_with_error():
    """For wider square pixels, the limit of 16 cells leaves an error, which is at most twice the expected one."""
    scene = photograph(8.0, (20, 20))
    optics = replace(OPTICS, source_pixel="square")
    sensor = sites_of(LAMBDA_N_UM, 40.0 * LAMBDA_N_UM)
    with pytest.warns(
        SamplingWarning, match=r"16 x 16 cells .* since more cells .* would exceed its limits: .* errors up to 1\.9 %"
    ):
        fs.Camera(optics=optics, sensor=sensor).photoelectrons_per_s(scene)

    assert optics.auto_oversample_error(scene) == pytest.approx(0.16 / 2.0**3.1)
    # Sites twenty times as wide, and pixels that the limit does not affect.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fs.Camera(optics=optics, sensor=sites_of(20.0 * LAMBDA_N_UM, 20.0 * LAMBDA_N_UM)).photoelectrons_per_s(scene)
        fs.Camera(optics=optics, sensor=sensor).photoelectrons_per_s(photograph(2.5, (40, 40)))


def test_wide_point_pixels_warn_for_small_sites():
    scene = photograph(1.03)
    for side, is_warned in ((0.9, True), (1.5, False)):
        camera = fs.Camera(optics=OPTICS, sensor=sites_of(side * LAMBDA_N_UM, 8.0 * LAMBDA_N_UM))
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            camera.photoelectrons_per_s(scene)

        assert any("automatic oversampling" in str(w.message) for w in found) == is_warned


def test_auto_oversample_respects_memory_limit():
    """Maps have at most 2^27 cells, so that large scenes are oversampled less."""
    for shape, expected in (((1000, 1000), 4), ((5000, 4000), 2), ((6000, 6000), 1)):
        scene = fs.Scene.flat(
            shape=shape,
            pitch_um=pitch_of(1.4),
            distance_m=DISTANCE_M,
            radiance_w_m2_sr_nm=1.0,
            wavelength_nm=WAVELENGTH_NM,
            band_width_nm=1.0,
        )
        assert OPTICS.auto_oversample(scene) == expected


@pytest.mark.slow
@pytest.mark.parametrize("approximation", [{"field_patches": 3}, {"field_tolerance": 0.01}], ids=["patches", "modes"])
def test_oversample_supports_field_dependent_lateral_colour(approximation, monkeypatch):
    """Each band has its own image size and grid, with field-dependent aberrations.

    Patches do not depend on the cells. Modes do: each map displaces light up to the tolerance.
    """
    monkeypatch.setattr(_field_modes, "FIELD_POINTS", (5,))
    optics = replace(
        OPTICS,
        **approximation,
        padding="reflect",
        seidel=fs.optics.Seidel(coma_um=0.15, field_radius_um=60.0),
        lateral_colour=fs.optics.LateralColour(wavelength_nm=(450.0, 650.0), magnification=(0.99, 1.01)),
    )
    scene = fs.Scene.point_sources(
        shape=(60, 64),
        pixels=[(30, 32), (12, 50)],
        intensity_w_sr_nm=1.0,
        pitch_um=pitch_of(1.3),
        distance_m=DISTANCE_M,
        wavelength_nm=[450.0, 650.0],
        band_width_nm=1.0,
    )
    for which in (0, 1):
        maps = {}
        for k in (1, 3):
            lens = replace(optics, oversample=k)
            grid, is_on_it = lens.image_grids(scene)[which]
            maps[k] = next(lens.weighted_maps(scene, is_on_it[np.newaxis].astype(float), grid=grid))
            assert grid.shape == (60 * k, 64 * k)

        difference = block_means(maps[3], 3) - maps[1]
        if optics.field_patches is None:
            assert 0.5 * abs(difference).sum() < 2 * optics.field_tolerance * maps[1].sum()
            assert abs(difference.sum()) < 1e-4 * maps[1].sum()
        else:
            assert abs(difference).max() < 1e-5 * maps[1].max()


@pytest.mark.parametrize("oversample", [0, 17, 1.5, "fine"])
def test_invalid_oversample_raises(oversample):
    with pytest.raises(fs.errors.ParameterError, match="oversample"):
        replace(OPTICS, oversample=oversample)


def test_negative_site_values_warn_on_coarse_cells():
    """With order=2 on cells wider than the PSF, gradients at a point undershoot 0."""
    scene = points_of(0.8, (60, 60), [(30, 30)])
    cell_um = LAMBDA_N_UM / 0.8
    layout = fs.layout.grid(n_x=40, n_y=40, pitch_um=0.25 * cell_um).translate(0.5 * cell_um, 0.5 * cell_um)
    optics = replace(OPTICS, padding="reflect", oversample=1)
    camera = fs.Camera(optics=optics, sensor=fs.Sensor(layout), order=2)
    with pytest.warns(SamplingWarning, match=r"negative, [\d.]+ % of all, .* use order=1, or smaller cells"):
        rate = camera.photoelectrons_per_s(scene)

    assert rate.min() == 0.0

    # A layout of the negative photosites alone: all values are negative.
    every = np.array(
        [camera.integrator(camera.power_map(scene).grid, order=2)(camera.power_map(scene).data[0])]
    ).ravel()
    alone = fs.Camera(optics=camera.optics, sensor=fs.Sensor(layout[every < 0.0]), order=2)
    with pytest.warns(SamplingWarning, match="100 % of all"):
        assert (alone.photoelectrons_per_s(scene) == 0.0).all()

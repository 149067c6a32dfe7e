"""Modes of PSFs that vary over the field: patches and single points as references, power, errors."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError, SamplingWarning
from foveasim.optics import LateralColour, Seidel, _field_modes
from foveasim.optics._field_modes import Sampling, find_modes, sampled_psfs

pytestmark = pytest.mark.filterwarnings("ignore:the image of the scene is only")
WAVES_NM = np.array([500.0, 600.0])
SEIDEL = Seidel(coma_um=0.08, astigmatism_um=0.06, field_curvature_um=0.05, field_radius_um=30.0)
LENS = fs.Optics(
    focal_length_mm=8.0, f_number=4.0, seidel=SEIDEL, padding="zero", padding_cells=40, precision="double", oversample=1
)


def scene_of(image, pitch_um=100.0, waves_nm=WAVES_NM[:1]):
    image = np.asarray(image, float).reshape(-1, *np.shape(image)[-2:])
    spectra = np.random.default_rng(1).uniform(0.5, 1.0, (len(image), len(waves_nm)))
    return fs.Scene(image, spectra, waves_nm, np.ones(len(waves_nm)), pitch_um, 1.0)


def noise(n=24, n_basis=1, **options):
    return scene_of(np.random.default_rng(0).random((n_basis, n, n + 6)), **options)


def lambda_n_um(scene):
    return 1e-3 * scene.wavelength_nm * LENS.working_f_number(scene.distance_m)


@pytest.fixture
def few_points(monkeypatch):
    """PSFs at 5 x 5 points of the field instead of 9 x 9."""
    monkeypatch.setattr(_field_modes, "FIELD_POINTS", (5,))


@pytest.fixture
def linear(monkeypatch):
    """PSFs at 3 x 3 points of the field, with weights that are linear between them, as those of patches."""

    def splines(n_points, at, degree=3):
        unit = np.eye(n_points)
        return np.stack([np.interp(at, np.linspace(0, 1, n_points), row) for row in unit], axis=1), unit

    monkeypatch.setattr(_field_modes, "splines", splines)
    monkeypatch.setattr(_field_modes, "FIELD_POINTS", (3,))


@pytest.mark.slow(keep=3)
# Cells of 0.4, 0.8 and 2.3 λN (aliases), finer cells, several basis images and wavelengths.
@pytest.mark.parametrize(
    ("options", "changes"),
    [
        ({}, {}),
        ({"pitch_um": 200.0}, {"source_pixel": "square"}),
        ({"pitch_um": 600.0}, {"seidel": replace(SEIDEL, field_radius_um=150.0)}),
        ({"n_basis": 2, "waves_nm": WAVES_NM}, {}),
        ({}, {"oversample": 2}),
        ({}, {"oversample": 3, "emission": "isotropic"}),
        ({"waves_nm": WAVES_NM}, {"lateral_colour": LateralColour(wavelength_nm=WAVES_NM, magnification=(0.98, 1.0))}),
        ({}, {"zernike": fs.optics.Zernike(coefficients={7: 0.05})}),
    ],
)
@pytest.mark.usefixtures("linear")
def test_all_modes_equal_patches(options, changes):
    scene, lens = noise(**options), replace(LENS, **changes)
    patches = replace(lens, field_patches=3, padding_cells=lens.padding_cells).power_map(scene).data
    modes = replace(lens, field_modes=80).power_map(scene).data

    # Aliases are interpolated to 1e-4 of the peak, for transforms of other sizes; smaller images have their own patches.
    tolerance = 1e-3 if options.get("pitch_um") == 600.0 else 5e-3 if "lateral_colour" in changes else 1e-12
    np.testing.assert_allclose(modes, patches, atol=tolerance * patches.max())


@pytest.mark.usefixtures("linear")
def test_all_modes_equal_patches_in_single_precision():
    scene, lens = noise(), replace(LENS, precision="single")
    patches = replace(lens, field_patches=3).power_map(scene).data

    np.testing.assert_allclose(replace(lens, field_modes=80).power_map(scene).data, patches, atol=1e-6 * patches.max())


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("padding", "precision", "tolerance"),
    [
        ("periodic", "single", 1e-6),
        ("periodic", "double", 1e-12),
        # The light beyond the picture.
        ("zero", "single", 3e-3),
        ("reflect", "double", 3e-3),
        ("edge", "double", 3e-3),
    ],
)
@pytest.mark.usefixtures("few_points")
def test_any_modes_conserve_power(padding, precision, tolerance):
    image = np.zeros((100, 100))
    image[40:60, 40:60] = np.random.default_rng(2).random((20, 20))
    lens = replace(LENS, padding=padding, padding_cells=None if padding == "periodic" else 120, precision=precision)
    scene = scene_of(image)
    sums = [replace(lens, field_modes=k).power_map(scene).data.sum(dtype=np.float64) for k in (0, 3)]
    fixed = replace(lens, seidel=None).power_map(scene).data.sum(dtype=np.float64)

    np.testing.assert_allclose(sums, fixed, rtol=tolerance)


@pytest.mark.usefixtures("few_points")
def test_modes_are_singular_vectors_of_psfs():
    scene = noise()
    aperture, grid = LENS.aperture(scene), LENS.grid(scene)
    near_um = lambda_n_um(scene)
    for k in (0, 2, 11):
        modes = find_modes(aperture, grid, scene.wavelength_nm, near_um, tolerance=1.0, n_modes=k, n_threads=1)
        sampling = Sampling.of(aperture, modes.points_um, scene.wavelength_nm, near_um, 0.0)
        psfs = sampled_psfs(aperture, modes.points_um, sampling, 1)[:, 0]
        sampled = modes.combinations @ psfs
        found = modes.at_points.reshape(k + 1, -1).T @ sampled

        error = np.sqrt(np.square(psfs - found).sum())
        expected = np.sqrt(np.square(modes.singular_values[k:]).sum())
        assert error == pytest.approx(expected, rel=1e-10)
        np.testing.assert_allclose(modes.combinations[1:].sum(axis=1), 0.0, atol=1e-14)
        assert modes.combinations[0].sum() == pytest.approx(1.0, rel=1e-14)


def map_of_own_psf(lens, scene, row, column):
    """Return the map of a point, whose pupil has the aberrations there everywhere."""
    grid = lens.grid(scene)
    at_um = float(grid.x_um[column]), float(grid.y_um[row])

    def pupil(x, y, wave_nm):
        return np.exp(2j * np.pi * lens.seidel.wavefront_um(x, y, wave_nm, at_um) / (1e-3 * wave_nm))

    return replace(lens, seidel=None, pupil=pupil).power_map(scene).data


def displaced_light(found, expected):
    return 0.5 * np.abs(found - expected).sum() / expected.sum()


def point_scene(n, row, column, **options):
    image = np.zeros((n, n))
    image[row, column] = 1.0
    return scene_of(image, **options)


@pytest.fixture(scope="module")
def point_maps():
    """Return scenes of a point, and their maps with the PSF of the point."""
    points = np.random.default_rng(4).integers(0, 64, (8, 2))
    scenes = [(point_scene(64, *point), point) for point in points]
    return [(scene, map_of_own_psf(LENS, scene, *point)) for scene, point in scenes]


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [0.1, 0.03, 0.01])
def test_field_error_bounds_displaced_light(tolerance, point_maps):
    lens = replace(LENS, field_tolerance=tolerance)
    blank = scene_of(np.zeros((64, 64)))
    error = lens.field_error(blank)
    assert error <= tolerance
    assert replace(lens, field_tolerance=0.5 * tolerance).field_error(blank) < error
    displaced = [displaced_light(lens.power_map(scene).data, expected) for scene, expected in point_maps]

    assert max(displaced) <= error
    assert max(displaced) > 0.1 * error


@pytest.mark.slow
def test_wide_cells_need_fewer_modes():
    # Cells of 2.3 λN: light that is displaced within them does not count.
    n = 64
    wide = replace(LENS, seidel=replace(SEIDEL, field_radius_um=100.0), padding_cells=20)
    blank = scene_of(np.zeros((n, n)), pitch_um=600.0)
    grid, error = wide.grid(blank), wide.field_error(blank)
    fine = find_modes(
        wide.aperture(blank), replace(grid, shape=(8 * n, 8 * n), pitch_um=grid.pitch_x_um / 8), blank.wavelength_nm,
        lambda_n_um(blank), tolerance=0.01, n_modes=None, n_threads=1,
    )  # fmt: skip
    assert wide._field_modes(blank, 1).n_modes < fine.n_modes - 3
    displaced = []
    for row, column in np.random.default_rng(4).integers(4, n - 4, (4, 2)):
        scene = point_scene(n, row, column, pitch_um=600.0)
        displaced.append(displaced_light(wide.power_map(scene).data, map_of_own_psf(wide, scene, row, column)))

    assert max(displaced) <= error <= 0.01


@pytest.mark.usefixtures("few_points")
def test_fewer_modes_suffice_for_larger_tolerances():
    scene = noise()
    numbers = [
        find_modes(
            LENS.aperture(scene),
            LENS.grid(scene),
            scene.wavelength_nm,
            lambda_n_um(scene),
            tolerance=t,
            n_modes=None,
            n_threads=1,
        ).n_modes
        for t in (0.5, 0.1, 0.02, 0.01)
    ]

    assert numbers == sorted(numbers)
    assert numbers[0] < numbers[-1] < 30


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("seed", range(30))
def test_errors_fall_with_the_tolerance(seed, recwarn, monkeypatch):
    monkeypatch.setattr(_field_modes, "FIELD_POINTS", (4, 7))
    rng = np.random.default_rng(seed)
    strength = 10.0 ** rng.uniform(-1.5, -0.2)
    names = ("spherical_um", "coma_um", "astigmatism_um", "field_curvature_um")
    paths_um = dict(zip(names, strength * rng.uniform(-1.0, 1.0, 4), strict=True))
    seidel = Seidel(**paths_um, field_radius_um=float(rng.uniform(20.0, 60.0)))
    lens = replace(LENS, seidel=seidel, f_number=float(rng.uniform(2.0, 8.0)))
    blank = scene_of(np.zeros((24, 30)))
    before = np.inf
    for tolerance in (0.05, 0.02, 0.01, 0.005, 0.002):
        recwarn.clear()
        error = replace(lens, field_tolerance=tolerance).field_error(blank)

        assert error <= 1.03 * before
        assert error <= tolerance or "more points would take too long" in str(recwarn.pop(SamplingWarning).message)
        before = error


@pytest.mark.usefixtures("few_points")
def test_unreachable_tolerance_causes_warning():
    strong = replace(LENS, seidel=Seidel(coma_um=0.2, astigmatism_um=0.4, field_radius_um=10.0))
    with pytest.warns(
        SamplingWarning,
        match=r"modes, from its values at 5 x 5 points, displace 0\.\d+ of the light of a point, more than field_tolerance = "
        r"0\.01; more points would take too long: use a part of the picture, or accept it with field_tolerance=0\.\d+",
    ):
        strong.power_map(noise(n=16))


@pytest.mark.slow
def test_more_points_reach_the_tolerance():
    strong = Seidel(coma_um=0.48, astigmatism_um=0.36, field_curvature_um=0.3, field_radius_um=30.0)
    modes = replace(LENS, seidel=strong).psf_modes(noise(48))

    assert modes.points_um.shape == (17 * 17, 2)
    assert modes.displaced <= 0.01


@pytest.mark.usefixtures("few_points")
def test_modes_are_those_of_maps():
    modes = LENS.psf_modes(noise())

    assert modes.displaced == LENS.field_error(noise())
    assert modes.n_modes == len(modes.at_points)
    with pytest.raises(ValueError, match="read-only"):
        modes.at_points[0] = 0.0
    assert np.all(np.diff(modes.singular_values) <= 0.0)
    np.testing.assert_allclose(modes.combinations.sum(axis=1), [1.0] + [0.0] * (modes.n_modes - 1), atol=1e-9)
    assert replace(LENS, field_modes=3).psf_modes(noise()).n_modes == 4


@pytest.mark.parametrize("changes", [{"field_patches": 3}, {"seidel": None}])
def test_lenses_without_modes_are_rejected(changes):
    with pytest.raises(ParameterError, match="must have a PSF that varies"):
        replace(LENS, **changes).psf_modes(noise())


@pytest.mark.usefixtures("few_points")
def test_equal_psfs_need_no_modes():
    nearly = replace(LENS, seidel=Seidel(spherical_um=0.1, coma_um=1.0, field_radius_um=1e7))
    scene = noise()
    fixed = replace(LENS, seidel=Seidel(spherical_um=0.1)).power_map(scene).data

    assert nearly.field_error(scene) < 1e-4
    np.testing.assert_allclose(nearly.power_map(scene).data, fixed, rtol=1e-6)


@pytest.mark.usefixtures("few_points")
def test_turned_scene_has_turned_map():
    # The aberrations have the symmetry; the picture is turned by 180 degrees.
    image = np.random.default_rng(3).random((40, 40))
    lens = replace(LENS, field_modes=10)

    turned = lens.power_map(scene_of(image[::-1, ::-1])).data[:, ::-1, ::-1]
    np.testing.assert_allclose(turned, lens.power_map(scene_of(image)).data, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.usefixtures("few_points")
def test_tiles_equal_captures_with_varying_psfs():
    scene = noise(32, n_basis=3, waves_nm=WAVES_NM)
    layout = fs.layout.grid(n_x=12, n_y=12, pitch_um=1.2)
    camera = fs.Camera(optics=LENS, sensor=fs.Sensor(layout))
    options = {"exposure_s": 0.01, "seed": 3}
    whole, parts = (camera.capture(scene, **options), fs.tiles.capture_tiles(camera, scene, **options, tile_sites=50))

    np.testing.assert_array_equal(np.concatenate([tile.code for tile in parts]), whole.code)


@pytest.mark.usefixtures("few_points")
def test_used_lens_with_modes_is_pickled():
    scene, lens = noise(), replace(LENS, field_modes=4)
    expected = lens.power_map(scene).data

    np.testing.assert_array_equal(pickle.loads(pickle.dumps(lens)).power_map(scene).data, expected)
    np.testing.assert_allclose(lens.power_map(scene, n_threads=2).data, expected, rtol=1e-12)


@pytest.mark.slow
def test_threads_share_pupils_of_several_wavelengths(monkeypatch):
    monkeypatch.setattr(_field_modes, "FIELD_POINTS", (3,))
    scene = noise(waves_nm=np.array([450.0, 500.0, 560.0, 640.0]))
    expected = replace(LENS, field_modes=4).power_map(scene, n_threads=1).data

    for _ in range(3):
        found = replace(LENS, field_modes=4).power_map(scene, n_threads=4).data
        np.testing.assert_allclose(found, expected, atol=1e-12 * expected.max())


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"field_tolerance": 0.0}, "'field_tolerance' must be > 0"),
        ({"field_modes": 81}, "'field_modes' must be <= 80"),
        ({"field_modes": "all"}, "'field_modes' must be"),
        ({"field_patches": 3, "padding": "periodic"}, "'padding' must not be 'periodic' with 'field_patches'"),
    ],
)
def test_wrong_field_settings_are_rejected(changes, match):
    with pytest.raises(ParameterError, match=match):
        replace(LENS, **changes)

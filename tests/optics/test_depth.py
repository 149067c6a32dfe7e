"""Scenes with depth: closed forms, conservation of energy, and rays through points of the pupil."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import foveasim as fs
from foveasim.optics.otf import defocused_otf

#: A lens whose diffraction is much smaller than the blur: λN is 0.6 µm, a cell 4 µm.
LENS = {"focal_length_mm": 10.0, "f_number": 1.4, "precision": "double", "oversample": 1, "padding": "edge"}
BAND = {"wavelength_nm": [400.0], "band_width_nm": 10.0, "encoding": "linear", "peak_radiance_w_m2_sr_nm": 1.0}
CELL_UM, FOCUS_M = 4.0, 1.0
#: Uniform relative illumination.
EVEN = fs.optics.IlluminationTable(image_height_um=[0.0, 1e5], fraction=[1.0, 1.0])


def lens(**changes):
    return fs.Optics(**{**LENS, "relative_illumination": EVEN, **changes})


def scene_of(picture, depth_m, **changes):
    """Return a scene whose pixels have the image size of CELL_UM."""
    pitch_um = CELL_UM / fs.Optics(**LENS).magnification(FOCUS_M)
    return fs.Scene.from_rgbd(picture, depth_m, distance_m=FOCUS_M, pitch_um=pitch_um, **{**BAND, **changes})


def depth_of_blur_m(radius_cells, optics=None):
    """Return the distance whose geometric blur has a radius, negative behind the focus: r = a D (1/H - 1/H_focus)."""
    optics = optics or fs.Optics(**LENS)
    radius_m = 0.5e-3 * optics.focal_length_mm / optics.f_number
    image_m = FOCUS_M * optics.magnification(FOCUS_M)
    return 1.0 / (1.0 / FOCUS_M + 1e-6 * CELL_UM * radius_cells / (radius_m * image_m))


def random_scene(kind, n=96):
    """Return a textured picture (n, n) and its blur radius in cells, positive in front of the focus."""
    rng = np.random.default_rng(kind)
    y, x = np.mgrid[:n, :n] / n
    near, nearer = (gaussian_filter(rng.standard_normal((n, n)), n / 14, mode="wrap") for _ in range(2))
    texture = [gaussian_filter(rng.standard_normal((n, n)), 2.0, mode="wrap") for _ in range(2)]
    bright, dark = (np.clip(0.5 + 0.2 * each / each.std(), 0.0, 1.0) for each in texture)
    radius = {
        0: np.where(near > 0.0, 6.0, 0.0),  # a background in focus
        1: np.where(near > 0.0, 0.0, -6.0),  # objects in focus
        2: np.where(near > 0.0, 5.0, -5.0),  # none in focus
        3: 6.0 * np.sin(2.0 * np.pi * y),  # a smooth surface
        4: np.where(near > 0.0, 5.0 + 2.0 * np.sin(2.0 * np.pi * x), -5.0 + 3.0 * np.sin(2.0 * np.pi * y)),
        5: np.where(nearer > 0.0, 6.0, np.where(near > 0.0, 1.0, -5.0)),  # three objects that cover each other
    }[kind]
    return np.where(radius > radius.mean(), bright, 0.6 * dark), radius


def test_constant_depth_equals_plane_scene():
    picture = np.random.default_rng(0).random((40, 50))
    plane = fs.Scene.from_picture(picture, distance_m=FOCUS_M, pitch_um=300.0, **BAND)
    same = fs.Scene.from_rgbd(picture, np.full((40, 50), FOCUS_M), distance_m=FOCUS_M, pitch_um=300.0, **BAND)

    for optics in (fs.Optics(**LENS), fs.Optics(**LENS, focus_distance_m=0.7), lens()):
        np.testing.assert_array_equal(optics.power_map(same).data, optics.power_map(plane).data)


def share_of_disc(edges, radius):
    """Return means over cells of the share of a disc on the near side of an edge, (acos s - s sqrt(1 - s²)) / π."""
    s = np.clip(edges / radius, -1.0, 1.0)
    integral = (s * np.arccos(s) - np.sqrt(1.0 - s * s) * (2.0 + s * s) / 3.0) / np.pi  # over s from 1
    integral += np.minimum(edges / radius + 1.0, 0.0)  # 1 beyond the disc
    return radius * np.diff(integral) / np.diff(edges)


@pytest.mark.parametrize("radius_cells", [0.55, 0.9, 1.3, 3.0, 12.0, 30.0])
@pytest.mark.parametrize("is_background_sharp", [True, False])
def test_near_edge_equals_closed_form(radius_cells, is_background_sharp):
    """A half plane, blurred over a disc of 840 λN, in front of an even background."""
    n, cell_um = 96 if radius_cells < 20.0 else 192, 480.0 / radius_cells
    is_near = np.arange(n) < n // 2
    far_m = FOCUS_M if is_background_sharp else np.inf
    depth_m = np.where(is_near, depth_of_blur_m(480.0 / CELL_UM), far_m) * np.ones((8, 1))
    picture = np.where(is_near, 1.0, 0.25) * np.ones((8, 1))
    scene = scene_of(picture, depth_m).with_pitch(scene_of(picture, depth_m).pitch_um * cell_um / CELL_UM)

    line = lens(source_pixel="square", oversample=2).power_map(scene).data[0, 8]

    edges = np.arange(2 * n + 1) / 2.0 - n // 2
    expected = share_of_disc(edges, radius_cells)
    np.testing.assert_allclose((line / line[-n // 2] - 1.0) / 3.0, expected, atol=1.1e-3)


def test_defocused_otf_equals_quadrature():
    """Over the pupil, by the integrals of point images."""
    for distance_m in (0.9, 0.6, 0.3):
        optics = fs.Optics(focal_length_mm=10.0, f_number=2.0, focus_distance_m=1.0)
        waves = optics.defocus_um(distance_m) / 0.55
        ratio = np.linspace(0.01, 0.99, 12)
        expected = optics.mtf(1e3 * ratio / (0.55 * optics.working_f_number(distance_m)), 550.0, distance_m=distance_m)

        np.testing.assert_allclose(np.abs(defocused_otf(ratio, waves)), expected, atol=1e-12)


@pytest.mark.parametrize("kind", range(6))
def test_equal_radiances_stay_flat(kind):
    _, radius = random_scene(kind)
    found = lens().power_map(scene_of(np.ones((96, 96)), depth_of_blur_m(radius))).data

    np.testing.assert_allclose(found, found.mean(), rtol=1e-6)


def test_relative_illumination_is_that_of_sensor():
    depth_m = depth_of_blur_m(random_scene(2)[1])
    optics = fs.Optics(**LENS)
    scene = scene_of(np.ones((96, 96)), depth_m)
    found = optics.power_map(scene)

    x = found.grid.pitch_x_um * (np.arange(96) - 47.5) / (1e6 * FOCUS_M * optics.magnification(FOCUS_M))
    even = found.data[0] * (1.0 + x**2 + x[:, np.newaxis] ** 2) ** 2
    np.testing.assert_allclose(even, even.mean(), rtol=1e-9)


@pytest.mark.parametrize("radius_cells", [-6.0, -0.3, 0.0, 0.3, 3.0, 30.0])
@pytest.mark.parametrize("is_alone", [True, False])
def test_point_keeps_its_energy(radius_cells, is_alone):
    """At every distance, alone or in front of a dark background."""
    picture = np.zeros((64, 64))
    picture[30, 34] = 1.0
    depth_m = np.full((64, 64), depth_of_blur_m(radius_cells) if is_alone else depth_of_blur_m(-8.0))
    depth_m[30, 34] = depth_of_blur_m(radius_cells)
    optics = lens(padding="periodic")
    sharp = fs.Scene.from_picture(picture, distance_m=FOCUS_M, pitch_um=scene_of(picture, depth_m).pitch_um, **BAND)

    energy = optics.power_map(scene_of(picture, depth_m)).data.sum()

    assert energy == pytest.approx(optics.power_map(sharp).data.sum(), rel=1e-9)


#: Limits of the root mean square and the largest error of each random scene, relative to white: 1.2 times those measured.
ERRORS = {0: (0.002, 0.013), 1: (0.004, 0.03), 2: (0.008, 0.09), 3: (0.01, 0.05), 4: (0.011, 0.07), 5: (0.009, 0.15)}


@pytest.mark.parametrize("kind", range(6))
def test_layers_agree_with_rays(kind):
    picture, radius = random_scene(kind)
    scene, optics = scene_of(picture, depth_of_blur_m(radius)), lens()
    white = optics.power_map(scene_of(np.ones((96, 96)), depth_of_blur_m(radius))).data.max()

    error = (optics.power_map(scene).data - optics.power_map(scene, reference=True).data)[0, 8:-8, 8:-8] / white

    assert np.sqrt(np.mean(error**2)) < ERRORS[kind][0]
    assert np.abs(error).max() < ERRORS[kind][1]


def test_rays_agree_with_closed_form():
    """The reference, whose oracle is the share of a disc on one side of an edge."""
    radius_cells = 8.0
    is_near = np.arange(48) < 24
    depth_m = np.where(is_near, depth_of_blur_m(radius_cells), FOCUS_M) * np.ones((8, 1))

    line = lens().power_map(scene_of(is_near * np.ones((8, 1)), depth_m), reference=True).data[0, 4]

    s = np.clip((np.arange(48) + 0.5 - 24) / radius_cells, -1.0, 1.0)
    np.testing.assert_allclose(line / line[0], (np.arccos(s) - s * np.sqrt(1.0 - s * s)) / np.pi, atol=0.01)


def test_aberrated_layers_agree_with_rays():
    """Coma, and pupils with an obscuration, in layers and in rays."""
    picture, radius = random_scene(0)
    optics = lens(zernike=fs.optics.Zernike(coefficients={7: 0.8}), pupil=fs.optics.Annulus(0.4))
    scene = scene_of(picture, depth_of_blur_m(radius))
    plain = lens().power_map(scene).data
    rays = optics.power_map(scene, reference=True).data

    error = (optics.power_map(scene).data - rays)[0, 8:-8, 8:-8]

    assert np.sqrt(np.mean(error**2)) < 0.01 * rays.max()
    assert np.sqrt(np.mean((0.84 * plain - rays)[0, 8:-8, 8:-8] ** 2)) > 0.02 * rays.max()


def test_lateral_colour_and_field_aberrations_compose():
    """Scenes with depth of equal radiance stay flat with every kind of aberration."""
    depth_m = depth_of_blur_m(random_scene(0)[1][:48, :48])
    bands = {"wavelength_nm": [450.0, 650.0], "band_width_nm": [10.0, 10.0]}
    scene = scene_of(np.ones((48, 48)), depth_m, **bands)
    colour = fs.optics.LateralColour(wavelength_nm=[450.0, 650.0], magnification=[0.999, 1.0])
    seidel = fs.optics.Seidel(coma_um=0.3, field_radius_um=100.0)
    for changes in ({"lateral_colour": colour}, {"seidel": seidel}, {"seidel": seidel, "field_patches": 2}):
        optics = lens(f_number=8.0, **changes)
        for grid, is_of_it in optics.image_grids(scene):
            weights = is_of_it[np.newaxis].astype(float)
            (found,) = optics.weighted_maps(scene, weights, grid=grid)

            np.testing.assert_allclose(found, found.mean(), rtol=1e-6)


def test_halves_of_pupil_add_up_in_energy():
    picture, radius = random_scene(0)
    scene = scene_of(picture, depth_of_blur_m(radius))

    left, right, full = (lens(pupil_part=part).power_map(scene).data.sum() for part in ("left", "right", "full"))

    assert left + right == pytest.approx(full, rel=1e-3)
    plane = fs.Scene.from_picture(picture, distance_m=FOCUS_M, pitch_um=scene.pitch_um, **BAND)
    parts = [
        lens(pupil_part=part, padding="periodic").power_map(plane).data.sum() for part in ("left", "right", "full")
    ]
    assert parts[0] == pytest.approx(parts[1], rel=1e-12)
    assert parts[0] + parts[1] == pytest.approx(parts[2], rel=1e-12)


@pytest.mark.parametrize(("part", "sign"), [("left", -1.0), ("right", 1.0)])
def test_centroids_of_half_pupils_are_displaced(part, sign):
    """By 4 r / 3π, the centroid of a half disc: towards its own side in front of the focus."""
    radius_cells = 6.0
    picture = np.zeros((64, 64))
    picture[32, 32] = 1.0
    scene = scene_of(picture, np.full((64, 64), depth_of_blur_m(radius_cells)))

    data = lens(pupil_part=part, padding="periodic").power_map(scene).data[0]

    x = np.arange(64) - 32.0
    near = np.abs(x) < 20.0
    centroid = (data.sum(axis=0) * x)[near].sum() / data.sum(axis=0)[near].sum()
    assert centroid == pytest.approx(sign * 4.0 * radius_cells / (3.0 * np.pi), rel=0.03)


def test_sum_of_halves_has_half_the_peak():
    """In focus the halves diffract more: the peak of each is a quarter of the full one."""
    optics = {part: lens(f_number=8.0, pupil_part=part) for part in ("left", "right", "full")}
    # PSFs are normalised to their power, of which each half has half.
    peaks = {part: float(each.psf(550.0, n_points=1).psf_per_um2[0, 0]) for part, each in optics.items()}

    assert 0.5 * (peaks["left"] + peaks["right"]) == pytest.approx(0.5 * peaks["full"], rel=1e-6)

"""Scenes with depth: closed forms, conservation of energy, and rays through points of the pupil."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import foveasim as fs
from foveasim.optics import _depth

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


def test_near_edge_equals_closed_form():
    """A half plane, blurred over a disc of 12 cells, in front of an even background in focus."""
    n, radius_cells = 128, 12.0
    is_near = np.arange(n) < n // 2
    depth_m = np.where(is_near, depth_of_blur_m(radius_cells), FOCUS_M) * np.ones((32, 1))
    picture = np.where(is_near, 1.0, 0.25) * np.ones((32, 1))
    optics = lens(source_pixel="square", oversample=4)

    line = optics.power_map(scene_of(picture, depth_m)).data[0, 64]

    share = (line / line[-1] - 1.0) / 3.0
    x = (np.arange(4 * n) + 0.5) / 4.0 - n // 2
    s = np.clip(x / radius_cells, -1.0, 1.0)
    expected = (np.arccos(s) - s * np.sqrt(1.0 - s * s)) / np.pi
    inner = slice(100, -100)
    assert np.abs(share - expected)[inner].max() < 1e-3


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


@pytest.mark.parametrize("radius_cells", [-6.0, -0.5, 0.0, 3.0, 8.0])
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


#: Root mean square and largest error of each random scene, relative to white.
ERRORS = {0: (0.01, 0.1), 1: (0.01, 0.1), 2: (0.01, 0.1), 3: (0.02, 0.1), 4: (0.02, 0.1), 5: (0.02, 0.1)}


@pytest.mark.parametrize("kind", range(6))
def test_layers_agree_with_rays(kind):
    picture, radius = random_scene(kind)
    scene, optics = scene_of(picture, depth_of_blur_m(radius)), lens()
    white = optics.power_map(scene_of(np.ones((96, 96)), depth_of_blur_m(radius))).data.max()

    error = (optics.power_map(scene).data - optics.power_map(scene, reference=True).data)[0, 8:-8, 8:-8] / white

    print(kind, np.sqrt(np.mean(error**2)), np.abs(error).max())
    assert np.sqrt(np.mean(error**2)) < ERRORS[kind][0]
    assert np.abs(error).max() < ERRORS[kind][1]

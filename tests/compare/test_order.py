"""Results of a comparison do not depend on the order of its cameras and scenes."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.metrics import metric_info

OPTICS = fs.Optics(focal_length_mm=8.0, f_number=2.8)
OPTIONS = {"exposure_s": 1 / 60, "n_annuli": 2, "max_pixels": 48}
PICTURE = np.random.default_rng(3).random((40, 48))


def camera_of(layout, qe=0.6, **options):
    sensor = fs.Sensor(layout, qe=qe, capacitance_f=1.5e-16 * layout.area_um2, read_noise_e=2.0, bits=10)
    return fs.Camera(optics=OPTICS, sensor=sensor, **options)


def scene_of(**options):
    return fs.Scene.from_picture(PICTURE, **{"distance_m": 1.0, "illuminance_lux": 500.0, **options})


def filling(width_um):
    """Return the pitch of a picture whose image has a width."""
    return {"pitch_um": width_um / OPTICS.magnification(1.0) / PICTURE.shape[1]}


#: Cameras that differ in what a comparison could take from the first one.
CAMERAS = {
    "framed": (
        {
            "wide": camera_of(fs.layout.grid(n_x=24, n_y=10, pitch_um=2.0)),
            "high": camera_of(fs.layout.grid(n_x=12, n_y=20, pitch_um=2.0)),
            "moved": camera_of(fs.layout.grid(n_x=16, n_y=15, pitch_um=2.0).translate(5.0, -3.0)),
        },
        {"covers": {"fit": "cover"}, "within": {"fit": "contain"}},
    ),
    "moved": (
        {
            axis or "centred": camera_of(
                fs.layout.grid(n_x=16, n_y=15, pitch_um=2.0), **({"gaze_um": (12.0, 4.0), "axis": axis} if axis else {})
            )
            for axis in ("", "image", "sensor")
        },
        {"near": filling(90.0), "far": filling(180.0) | {"distance_m": 2.0}},
    ),
    "of unequal budgets and efficiencies": (
        {
            f"{n_x} sites": camera_of(fs.layout.grid(n_x=n_x, n_y=15, pitch_um=2.0), qe=0.1 * k)
            for k, n_x in enumerate((16, 18, 20), start=4)
        },
        {
            "green": filling(60.0),
            "red": filling(60.0) | {"wavelength_nm": [600.0, 650.0, 700.0], "band_width_nm": 50.0},
        },
    ),
}


@pytest.mark.slow(keep=1)
@pytest.mark.filterwarnings("ignore::foveasim.errors.CoverageWarning")
@pytest.mark.parametrize("kind", CAMERAS)
def test_comparison_is_independent_of_order(kind):
    cameras, keywords = CAMERAS[kind]
    scenes = {name: scene_of(**options) for name, options in keywords.items()}
    found = []
    for names in list(permutations(cameras))[::2]:  # each camera is first once
        order = slice(None, None, -1 if names[0] == next(iter(cameras)) else 1)
        permuted = dict(list(scenes.items())[order])
        found.append(fs.compare.cameras({n: cameras[n] for n in names}, permuted, budget=None, **OPTIONS))
    first = found[0]
    for other in found[1:]:
        rows = [other.names.index(name) for name in first.names]
        columns = [other.scenes.index(name) for name in first.scenes]
        for key, values in first.values.items():
            same = other.values[key][rows]
            if metric_info(key.removesuffix("_by_eccentricity")).has_scene:
                same = same[:, columns]
            np.testing.assert_allclose(same, values, rtol=1e-7, atol=1e-9, err_msg=key)
        np.testing.assert_array_equal(other.coverage_fraction[rows], first.coverage_fraction)
        np.testing.assert_array_equal(other.edges_um, first.edges_um)
        for name in cameras:
            one, same = first.pictures[name][0].data, other.pictures[name][columns[0]].data
            np.testing.assert_allclose(same, one, rtol=1e-5)


@pytest.mark.slow(keep=1)
@pytest.mark.filterwarnings("ignore::foveasim.errors.CoverageWarning")
@pytest.mark.parametrize("axis", ["image", "sensor"])
def test_camera_has_the_reference_of_its_gaze(axis):
    layout = fs.layout.grid(n_x=20, n_y=12, pitch_um=2.0)
    turned, scene = camera_of(layout, gaze_um=(10.0, 0.0), axis=axis), scene_of(**filling(120.0))

    beside = fs.compare.cameras({"a": camera_of(layout), "b": turned}, {"s": scene}, **OPTIONS)
    alone = fs.compare.cameras({"b": turned, "c": turned}, {"s": scene}, **OPTIONS)

    np.testing.assert_array_equal(beside.values["psnr_db"][1], alone.values["psnr_db"][0])
    # The ideal images are those of the camera's own part of the scene, moved by the gaze: 10 µm are whole pixels.
    n_pixels = round(10.0 / beside.ideals["a"][0].grid.pitch_x_um)
    here, there = (beside.ideals[name][0].data[0] for name in "ab")
    if axis == "image":
        assert 10.0 / beside.ideals["a"][0].grid.pitch_x_um == pytest.approx(n_pixels)
        np.testing.assert_allclose(there[:, :-n_pixels], here[:, n_pixels:], rtol=1e-5)


@pytest.mark.slow
def test_scenes_are_framed_for_all_layouts():
    layouts = {
        "wide": fs.layout.grid(n_x=60, n_y=20, pitch_um=2.0),
        "high": fs.layout.grid(n_x=20, n_y=60, pitch_um=2.0),
    }
    cameras = {name: camera_of(layout) for name, layout in layouts.items()}
    framed = cameras["wide"].fit_scene(scene_of(fit="cover"), others=[cameras["high"]])

    # The union is 120 x 120 µm, and the picture of 48 x 40 pixels covers it with its height.
    assert framed.pitch_um == pytest.approx(120.0 / OPTICS.magnification(1.0) / 40)
    found = fs.compare.cameras(cameras, {"s": scene_of(fit="cover")}, **OPTIONS)
    pitched = fs.compare.cameras(cameras, {"s": framed.with_pitch(framed.pitch_um)}, **OPTIONS)
    np.testing.assert_allclose(found.values["psnr_db"], pitched.values["psnr_db"], rtol=1e-9)


def test_framing_for_other_lenses_is_rejected():
    layout = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0)
    other = fs.Camera(optics=fs.Optics(focal_length_mm=9.0, f_number=2.8), sensor=fs.Sensor(layout))

    with pytest.raises(ParameterError, match="'others' must be cameras with the same optics"):
        camera_of(layout).fit_scene(scene_of(fit="cover"), others=[other])


def test_budgets_are_compared_pairwise():
    """Three budgets each within 2 % of the middle one differ by 4 %: no order accepts them."""
    layouts = {str(n): fs.layout.grid(n_x=n, n_y=2, pitch_um=2.0) for n in (50, 49, 51)}
    for names in permutations(layouts):
        with pytest.raises(ParameterError, match="the number of sites of '49' is 98, that of '51' 102"):
            fs.compare.layouts({n: layouts[n] for n in names}, {"s": scene_of(fit="cover")}, tolerance=0.03)

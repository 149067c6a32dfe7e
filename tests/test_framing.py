"""Framing of pictures on layouts: pitches by hand, corners at the edges of the picture, warnings of wrong sizes."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
from effort import examples
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

import foveasim as fs
from foveasim.errors import CoverageWarning, ParameterError
from foveasim.video import FrameSource, GazePath, pan_camera, shift_sensor

FOCAL_MM, DISTANCE_M = 22.0, 0.56
OPTICS = fs.Optics(focal_length_mm=FOCAL_MM, f_number=1.0)
#: Thin lens: 1/f = 1/H + 1/D.
IMAGE_DISTANCE_MM = 1.0 / (1.0 / FOCAL_MM - 1.0 / (1e3 * DISTANCE_M))
MAGNIFICATION = IMAGE_DISTANCE_MM / (1e3 * DISTANCE_M)
#: 40 x 30 µm, and a picture of another aspect ratio.
LAYOUT = fs.layout.grid(n_x=20, n_y=15, pitch_um=2.0)
N_Y, N_X = 200, 300
PICTURE = np.random.default_rng(0).random((N_Y, N_X)).astype(np.float32)


def scene_of(picture=PICTURE, **framing):
    return fs.Scene.from_picture(
        picture, distance_m=DISTANCE_M, peak_radiance_w_m2_sr_nm=0.05, band_width_nm=10.0, encoding="linear", **framing
    )


def camera_of(layout=LAYOUT, optics=OPTICS, **parts):
    return fs.Camera(optics=optics, sensor=fs.Sensor(layout, capacitance_f=1e-13), **parts)


@pytest.mark.parametrize(("fit", "image_um"), [("cover", 30 / 200), ("contain", 40 / 300), ("width", 40 / 300)])
def test_pitch_follows_from_thin_lens(fit, image_um):
    camera = camera_of()

    assert camera.fit_scene(scene_of(fit=fit)).pitch_um == pytest.approx(image_um / MAGNIFICATION, rel=1e-12)
    focused_at_infinity = camera.replace(optics=replace(OPTICS, focus_distance_m=np.inf))
    magnification = FOCAL_MM / (1e3 * DISTANCE_M)
    assert focused_at_infinity.fit_scene(scene_of(fit=fit)).pitch_um == pytest.approx(
        image_um / magnification, rel=1e-12
    )


def test_alternating_scenes_have_their_own_pitch():
    camera, wide, high = camera_of(), scene_of(), scene_of(PICTURE.T)

    pitches_um = [camera.fit_scene(scene).pitch_um for scene in (wide, high, wide, high)]

    # 30 µm over 200 rows, and 40 µm over 200 columns.
    assert pitches_um[:2] == pytest.approx([30 / 200 / MAGNIFICATION, 40 / 200 / MAGNIFICATION], rel=1e-12)
    assert pitches_um[2:] == pitches_um[:2]


def test_picture_without_pitch_covers_layout():
    assert scene_of().fit == "cover"
    assert scene_of().pitch_um is None
    assert repr(scene_of()).startswith("Scene(300 x 200 pixels, fit='cover', at 0.56 m")


@pytest.mark.parametrize("fit", ["cover", "contain", "width"])
def test_edges_of_picture_meet_layout(fit):
    x0, y0, x1, y1 = camera_of().image_grid(scene_of(fit=fit)).bounds_um

    tight = {"cover": (y0, y1), "contain": (x0, x1), "width": (x0, x1)}[fit]
    assert tight == pytest.approx((-15.0, 15.0) if fit == "cover" else (-20.0, 20.0), rel=1e-12)
    assert (x1 > 20.1 or y1 > 15.1) == (fit == "cover")


@given(n_x=st.integers(2, 60), n_y=st.integers(2, 60), n_columns=st.integers(1, 9), n_rows=st.integers(1, 9))
@settings(max_examples=examples(30))
def test_cover_and_contain_are_dual(n_x, n_y, n_columns, n_rows):
    """A picture lies within a layout when the layout, as a picture, covers the picture, as a layout."""
    within = camera_of(fs.layout.grid(n_x=n_columns, n_y=n_rows, pitch_um=1.0)).fit_scene(
        scene_of(np.ones((n_y, n_x)), fit="contain")
    )
    picture_as_layout = fs.Layout.from_rectangles([[0.0, 0.0]], [[float(n_x), float(n_y)]])
    around = camera_of(picture_as_layout).fit_scene(scene_of(np.ones((n_rows, n_columns)), fit="cover"))

    assert within.pitch_um * around.pitch_um * MAGNIFICATION**2 == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize(
    ("move_um", "fit", "image_um"),
    [
        ((5.0, 0.0), "cover", 50 / 300),  # to x = 25 µm on either side of the axis
        ((5.0, 0.0), "contain", 30 / 300),  # to x = -15 µm
        ((5.0, 0.0), "width", 40 / 300),
        ((0.0, -8.0), "cover", 46 / 200),  # to y = -23 µm
        ((0.0, -8.0), "contain", 14 / 200),  # to y = 7 µm
        ((30.0, 0.0), "cover", 100 / 300),
        ((30.0, 0.0), "width", 40 / 300),
    ],
)
def test_moved_layout_is_framed_from_lens_axis(move_um, fit, image_um):
    lens = fs.distortion.BrownConrady(focal_um=1e3 * IMAGE_DISTANCE_MM)
    camera = camera_of(LAYOUT.translate(*move_um), distortion=lens)

    assert camera.fit_scene(scene_of(fit=fit)).pitch_um == pytest.approx(image_um / MAGNIFICATION, rel=2e-5)


@pytest.mark.filterwarnings("ignore:.*lie partly or completely outside the image")
@pytest.mark.parametrize("fit", ["cover", "contain", "width"])
@given(dx_um=st.floats(-1e3, 1e3), dy_um=st.floats(-1e3, 1e3))
@example(dx_um=1e-8, dy_um=0.0)
@settings(max_examples=examples(20))
def test_picture_is_framed_on_moved_layout(fit, dx_um, dy_um):
    """A chip that is drawn with its origin in a corner, or anywhere, has the captures of a centred one."""
    centred, scene = camera_of(order=1), scene_of(fit=fit)
    moved = camera_of(LAYOUT.translate(dx_um, dy_um), order=1)
    bounds_um = np.array(moved.image_grid(scene).bounds_um) - [dx_um, dy_um, dx_um, dy_um]

    # A layout whose centre is within 1e-9 of its size from the origin counts as centred there.
    assert moved.fit_scene(scene).pitch_um == pytest.approx(centred.fit_scene(scene).pitch_um, rel=4e-9)
    np.testing.assert_allclose(bounds_um, centred.image_grid(scene).bounds_um, atol=1e-7)
    np.testing.assert_allclose(
        moved.photoelectrons_per_s(scene), centred.photoelectrons_per_s(scene), rtol=1e-5
    )  # rounding of positions
    np.testing.assert_allclose(
        moved.photoelectrons_per_s(moved.power_map(scene)), moved.photoelectrons_per_s(scene), rtol=1e-5
    )


def undistorted_radius_um(radius_um, k1, focal_um):
    """Solve r_d = r_u (1 + k1 (r_u / f)²) for r_u."""
    return brentq(lambda r: r * (1.0 + k1 * (r / focal_um) ** 2) - radius_um, 0.0, 4.0 * radius_um, xtol=1e-13)


@pytest.mark.filterwarnings("ignore:the focal length of the lens model")  # a short one, for strong distortion
@pytest.mark.parametrize("is_one_site", [True, False], ids=["one site", "grid"])
@pytest.mark.parametrize("k1", [-0.1, 0.3], ids=["barrel", "pincushion"])
def test_cover_contains_undistorted_outlines(k1, is_one_site):
    """A barrel lens has its extremes at the corners of a rectangle, a pincushion lens on the axes."""
    focal_um, corner_um = 60.0, np.array([20.0, 15.0])
    lens = fs.distortion.BrownConrady(focal_um=focal_um, k1=k1)
    layout = fs.Layout.from_rectangles([[0.0, 0.0]], [2.0 * corner_um]) if is_one_site else LAYOUT
    if k1 < 0.0:
        radius_um = np.hypot(*corner_um)
        extreme_um = corner_um * undistorted_radius_um(radius_um, k1, focal_um) / radius_um
    else:
        extreme_um = np.array([undistorted_radius_um(half_um, k1, focal_um) for half_um in corner_um])
    camera = camera_of(layout, distortion=lens)

    image_um = camera.fit_scene(scene_of(fit="cover")).pitch_um * MAGNIFICATION
    exact_um = max(2.0 * extreme_um[0] / N_X, 2.0 * extreme_um[1] / N_Y)
    assert exact_um <= image_um <= exact_um * (1.0 + 2e-5)
    image_um = camera.fit_scene(scene_of(fit="contain")).pitch_um * MAGNIFICATION
    assert image_um == pytest.approx(min(2.0 * extreme_um[0] / N_X, 2.0 * extreme_um[1] / N_Y), rel=1e-5)
    camera.photoelectrons_per_s(scene_of(fit="cover"))  # without a CoverageWarning


def test_principal_point_is_centre_of_picture():
    lens = fs.distortion.BrownConrady(focal_um=1e4, centre_um=(5.0, 0.0))
    camera = camera_of(distortion=lens)

    x0, y0, x1, y1 = camera.image_grid(scene_of(fit="contain")).bounds_um
    assert (x0 + x1, y0 + y1) == pytest.approx((10.0, 0.0))
    assert (x0, x1) == pytest.approx((-10.0, 20.0), rel=1e-5)  # from 5 to the nearer edge at 20 µm


def test_two_focal_lengths_stretch_the_picture():
    """The image is scaled by sqrt(fx / fy) along x and its inverse along y."""
    stretch = 1.5
    lens = fs.distortion.BrownConrady(focal_um=(1e4 * stretch, 1e4 / stretch))
    pitch_um = camera_of(distortion=lens).fit_scene(scene_of(fit="cover")).pitch_um

    expected_um = max(40 / 300 / stretch, 30 / 200 * stretch) / MAGNIFICATION
    assert pitch_um == pytest.approx(expected_um, rel=2e-5)


@pytest.mark.filterwarnings("ignore:the focal length of the lens model")  # a short one, for strong distortion
def test_sites_outside_image_circle_do_not_count():
    lens = fs.distortion.Fisheye(projection="orthographic", focal_um=60.0)
    layout = fs.Layout.from_rectangles([[0.0, 0.0], [100.0, 0.0]], 20.0)
    with pytest.warns(CoverageWarning, match="1 of 2 photosites lie outside the image circle"):
        camera_of(layout, distortion=lens).photoelectrons_per_s(scene_of(fit="cover"))

    one = camera_of(layout[:1], distortion=lens).fit_scene(scene_of(fit="cover"))
    assert camera_of(layout, distortion=lens).fit_scene(scene_of(fit="cover")).pitch_um == pytest.approx(one.pitch_um)
    with pytest.raises(
        ParameterError, match=r"^'fit' must be used with a layout that has photosites in the image circle"
    ):
        camera_of(layout[1:], distortion=lens).fit_scene(scene_of(fit="cover"))


def test_all_wavelengths_are_covered_and_contained():
    optics = replace(
        OPTICS, lateral_colour=fs.optics.LateralColour(wavelength_nm=(450.0, 650.0), magnification=(0.98, 1.01))
    )
    bands = {"wavelength_nm": [450.0, 550.0, 650.0]}
    colour = np.repeat(PICTURE[..., np.newaxis], 3, axis=2)
    scenes = {
        fit: fs.Scene.from_picture(
            colour, fit=fit, distance_m=DISTANCE_M, peak_radiance_w_m2_sr_nm=0.05, encoding="linear", **bands
        )
        for fit in ("cover", "contain", "width")
    }
    pitch_um = {fit: camera_of(optics=optics).fit_scene(scene).pitch_um for fit, scene in scenes.items()}

    assert pitch_um["cover"] == pytest.approx(30 / 200 / MAGNIFICATION / 0.98, rel=1e-12)
    assert pitch_um["contain"] == pytest.approx(40 / 300 / MAGNIFICATION / 1.01, rel=1e-12)
    assert pitch_um["width"] == pytest.approx(40 / 300 / MAGNIFICATION, rel=1e-12)


def test_field_of_view_determines_pitch():
    scene = scene_of(field_of_view_deg=40.0)
    width_um = 2.0 * DISTANCE_M * 1e6 * np.tan(np.deg2rad(20.0))

    assert scene.pitch_um == pytest.approx(width_um / N_X, rel=1e-12)
    assert OPTICS.grid(scene).pitch_x_um * N_X == pytest.approx(
        2e3 * IMAGE_DISTANCE_MM * np.tan(np.deg2rad(20.0)), rel=1e-12
    )
    assert camera_of().fit_scene(scene) is scene


def test_results_equal_those_of_framed_scene():
    camera = camera_of()
    scene = scene_of(fit="cover")
    framed = camera.fit_scene(scene)
    exposure = {"exposure_s": 0.01}
    by_fit, by_pitch = (camera.capture(light, **exposure, seed=3) for light in (scene, framed))

    assert framed.fit == "cover"  # centred on the layout
    assert np.array_equal(by_fit.code, by_pitch.code)
    for name in ("predict", "noise_budget"):
        one, other = (getattr(camera, name)(light, **exposure) for light in (scene, framed))
        assert str(one) == str(other)
    assert (camera.order(scene), camera.oversample(scene)) == (camera.order(framed), camera.oversample(framed))
    assert np.array_equal(camera.power_map(scene).data, camera.power_map(framed).data)
    grid = fs.Grid.centred((5, 6), 4.0)
    one, other = (camera.reference(light, grid, **exposure).data for light in (scene, framed))
    assert np.array_equal(one, other)
    for ahead in (0, 2):
        (video,) = camera.video([scene], **exposure, seed=3, ahead=ahead)
        assert np.array_equal(video.code, by_fit.code)


def test_capture_records_fit_and_pitch():
    camera = camera_of()
    light = camera.capture(scene_of(fit="cover"), exposure_s=0.01, seed=0).settings["light"]

    assert (light["fit"], light["field_of_view_deg"]) == ("cover", None)
    assert light["pitch_um"] == pytest.approx(30 / 200 / MAGNIFICATION, rel=1e-12)
    light = camera.capture(scene_of(field_of_view_deg=0.2), exposure_s=0.01, seed=0).settings["light"]
    assert (light["fit"], light["field_of_view_deg"]) == (None, 0.2)
    assert light["pitch_um"] == scene_of(field_of_view_deg=0.2).pitch_um


def test_framing_follows_lens_and_layout():
    """Twice the focal length images the same part of the layout from a picture of about half the size."""
    camera = camera_of()
    longer = camera.replace(optics=replace(OPTICS, focal_length_mm=2.0 * FOCAL_MM))
    wider = camera.replace(sensor=fs.Sensor(fs.layout.grid(n_x=60, n_y=15, pitch_um=2.0)))
    bounds_um = [each.image_grid(scene_of()).bounds_um for each in (camera, longer, wider)]

    assert bounds_um[1] == pytest.approx(bounds_um[0], rel=1e-12)
    assert bounds_um[2][2] == pytest.approx(60.0, rel=1e-12)


def test_frames_of_video_are_framed():
    template = scene_of(fit="width")
    small = PICTURE[::4, ::4]
    (frame,) = FrameSource([small], template=template, encoding="linear")
    assert camera_of().image_grid(frame).bounds_um[2] == pytest.approx(20.0, rel=1e-12)

    (frame,) = FrameSource([small], template=scene_of(field_of_view_deg=40.0), encoding="linear")
    assert frame.pitch_um == pytest.approx(4.0 * scene_of(field_of_view_deg=40.0).pitch_um, rel=1e-12)


def test_panned_parts_have_the_same_pitch():
    scene = scene_of(field_of_view_deg=40.0)
    path = GazePath([0.0], [[0.0, 0.0]])
    ((part, _),) = pan_camera(scene, path, OPTICS, shape=(50, 60))

    assert part.pitch_um == scene.pitch_um
    with pytest.raises(ParameterError, match=r"'scene' must have a pixel pitch.*camera\.fit_scene\(scene\)"):
        pan_camera(scene_of(fit="cover"), path, OPTICS, shape=(50, 60))


def test_panned_parts_of_fitted_scene_cover_layout():
    camera, path = camera_of(), GazePath([0.0, 1.0], [[0.0, 0.0], [5.0, 0.0]])
    for fit, side in (("width", 0), ("cover", slice(None))):
        frames = list(pan_camera(scene_of(fit=fit), path, camera, shape=(45, 60)))
        for part, _ in frames:
            x0, y0, x1, y1 = camera.image_grid(part).bounds_um
            assert part.basis.shape[1:] == (45, 60)
            # The layout measures 40 x 30 µm. A part that covers it has a margin of half a pixel on each side.
            margin_um = part.pitch_um * MAGNIFICATION if fit == "cover" else 0.0
            size_um = np.array([x1 - x0, y1 - y0]) - margin_um
            assert (size_um[side] >= np.array([40.0, 30.0])[side] - 1e-9).all()
            assert size_um[0] == pytest.approx(40.0, rel=0.01)
        assert frames[1][0].pitch_um == frames[0][0].pitch_um


def test_small_layout_on_picture_warns():
    camera = camera_of()
    # 300 pixels of 1000 µm are 300 mm, 12.3 mm in the image; the layout of 40 µm is 0.3 % of it.
    width_um = 1000.0 * N_X * MAGNIFICATION
    with pytest.warns(CoverageWarning) as caught:
        camera.photoelectrons_per_s(scene_of(pitch_um=1000.0))
    (message,) = [str(each.message) for each in caught if each.category is CoverageWarning]

    assert f"measures only {100 * 40 / width_um:.2g} % of the width of the picture" in message
    assert re.search(rf"image measures {width_um:.5g} x [\d.]+ µm.* layout 40 x 30 µm.*use fit='cover'", message)
    assert "\n" not in message
    for fit in ("cover", "contain", "width"):
        camera.photoelectrons_per_s(scene_of(fit=fit))
    camera.photoelectrons_per_s(replace(scene_of(pitch_um=1000.0), is_picture=False))
    list(camera.rates(shift_sensor(scene_of(pitch_um=1000.0), GazePath([0.0], [[0.0, 0.0]]))))


def test_quarter_of_picture_is_limit():
    camera = camera_of()
    limit_um = 40 / MAGNIFICATION / 0.25 / N_X
    camera.photoelectrons_per_s(scene_of(pitch_um=limit_um * 0.999))
    with pytest.warns(CoverageWarning, match="measures only 25 % of the width"):
        camera.photoelectrons_per_s(scene_of(pitch_um=limit_um * 1.001))


def test_small_picture_warning_suggests_fit():
    pattern = "174 of 300 photosites lie .* image measures 30 x 20 µm.* layout 40 x 30 µm.*use fit='cover'"
    with pytest.warns(CoverageWarning, match=pattern):
        camera_of().photoelectrons_per_s(scene_of(pitch_um=0.1 / MAGNIFICATION))


@pytest.mark.parametrize(
    ("layout", "fit", "message"),
    [
        (LAYOUT[:0], "cover", "'fit' must be used with a layout that has photosites, got 'cover'"),
        (
            LAYOUT.translate(30.0, 0.0),
            "contain",
            "'fit' must not be 'contain' with the optical axis, at (0, 0) µm, outside the layout, which extends from (10, -15) to (50, 15) µm; use 'cover' or 'width', or move the layout",
        ),
    ],
)
def test_impossible_framing_is_one_line(layout, fit, message):
    lens = fs.distortion.BrownConrady(focal_um=1e3 * IMAGE_DISTANCE_MM)
    with pytest.raises(ParameterError, match=f"^{re.escape(message)}$"):
        camera_of(layout, distortion=lens).capture(scene_of(fit=fit), exposure_s=0.01, seed=0)


def test_optics_require_a_pitch():
    with pytest.raises(ParameterError, match=r"^'scene' must have a pixel pitch.*pass camera\.fit_scene\(scene\)"):
        OPTICS.power_map(scene_of(fit="cover"))
    with pytest.raises(ParameterError, match="must be a Scene, got a PowerMap"):
        camera_of().fit_scene(fs.PowerMap.from_array(np.ones((2, 2)), pitch_um=1.0, wavelength_nm=550.0))


def test_bounds_of_many_sites_are_exact():
    """Blocks of sites, with distortion, have the bounds of the integrator's outlines."""
    layout = fs.layout.grid(n_x=300, n_y=300, pitch_um=2.0)
    lens = fs.distortion.BrownConrady(focal_um=2000.0, k1=-0.2, p1=0.01)
    camera = camera_of(layout, distortion=lens)
    grid = camera.image_grid(scene_of(fit="width"))

    x0, _, x1, _ = fs.Integrator(layout, grid, distortion=lens).bounds_um
    assert grid.bounds_um[2] - grid.bounds_um[0] == pytest.approx(x1 - x0, rel=1e-5)


def test_scene_with_fit_is_drawn_in_pixels():
    scene = fs.Scene.from_picture(
        np.zeros((30, 40), np.uint8), distance_m=1.0, peak_radiance_w_m2_sr_nm=0.1, band_width_nm=10.0
    )
    ax = scene.plot()

    assert (ax.get_xlabel(), ax.get_xlim(), ax.get_ylim()) == ("x / pixels", (-20.0, 20.0), (-15.0, 15.0))
    assert "fit='cover'" in scene._repr_html_().replace("&#x27;", "'")


def test_optical_axis_stays_with_framed_scene():
    """A part, a copy in another process and a displacement keep the axis that several cameras have in common."""
    centred, aside = (camera_of(fs.layout.grid(n_x=20, n_y=10, pitch_um=1.0).translate(x, 0.0)) for x in (0.0, 30.0))
    framed = centred.fit_scene(scene_of(fit="cover"), others=[aside])
    part = replace(framed, basis=framed.basis[:, 1:-1, 1:-1])

    assert framed.axis_um == (15.0, 0.0)
    for scene in (framed, part, pickle.loads(pickle.dumps(framed)), framed.with_centre((5.0, 0.0))):
        assert [camera.sensor_frame(scene).axis_um for camera in (centred, aside)] == [(15.0, 0.0)] * 2
    assert framed.with_pitch(3.0).axis_um is None
    with pytest.raises(ParameterError, match="'axis_um' requires 'fit'"):
        replace(framed, fit=None)

"""Pictures of wide fields, unwrapped through the lens model."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError

FOCAL_UM = 1000.0
LENS = fs.distortion.Fisheye(projection="equidistant", focal_um=FOCAL_UM)


def radiance(x, y, z):
    return 1.0 + 0.4 * x + 0.3 * y * z - 0.2 * y


def panorama(n_y=64, **options):
    elevation, azimuth = np.meshgrid(
        (0.5 - (np.arange(n_y) + 0.5) / n_y) * math.pi,
        ((np.arange(2 * n_y) + 0.5) / n_y - 1.0) * math.pi,
        indexing="ij",
    )
    cosine = np.cos(elevation)
    picture = radiance(cosine * np.sin(azimuth), np.sin(elevation), cosine * np.cos(azimuth))
    return fs.Scene.from_panorama(picture, luminance_cd_m2=500.0, encoding="linear", **options)


@pytest.fixture(scope="module")
def capture():
    """Return a capture of 210° whose codes are proportional to the radiance."""
    sensor = fs.Sensor(fs.layout.grid(n_x=200, n_y=200, pitch_um=18.5), shot_noise="off", capacitance_f=1e-16)
    camera = fs.Camera(
        optics=fs.Optics(focal_length_mm=1.0, f_number=2.8, projection="equisolid"), sensor=sensor, distortion=LENS
    )
    return camera.capture(panorama(cells=512), exposure_s=1e-4, seed=0)


def relative(picture, directions, falloff=True):
    """Return the values of a picture over the radiance of its directions, relative to the centre of the sensor."""
    theta = np.arccos(np.clip(directions[..., 2], -1.0, 1.0))
    expected = radiance(*np.moveaxis(directions, -1, 0)) * (np.sinc(theta / math.pi) if falloff else 1.0)
    return picture.data[0] / expected


def test_equirectangular_picture_shows_the_panorama(capture):
    view = capture.picture(of="expected_e", projection="equirectangular", max_pixels=180)
    assert view.data.shape == (1, 90, 180)
    elevation, azimuth = np.meshgrid(
        np.radians(np.arange(-89.0, 90.0, 2.0)), np.radians(np.arange(-179.0, 180.0, 2.0)), indexing="ij"
    )
    cosine = np.cos(elevation)
    directions = np.stack((cosine * np.sin(azimuth), np.sin(elevation), cosine * np.cos(azimuth)), axis=-1)
    found = relative(view, directions)
    is_seen = np.isfinite(found)
    theta = np.arccos(directions[..., 2])
    assert is_seen[theta < math.radians(104.0)].all()
    assert not is_seen[theta > math.radians(155.0)].any()  # beyond the corners
    inner = found[theta < math.radians(100.0)]
    np.testing.assert_allclose(inner, inner.mean(), rtol=5e-3)
    assert view.grid.pitch_um == pytest.approx(FOCAL_UM * math.radians(2.0))


@pytest.mark.parametrize("projection", ["rectilinear", "stereographic", "orthographic"])
def test_views_show_their_directions(capture, projection):
    """A view to the upper right, against the formula of its projection."""
    n, azimuth, elevation = 64, 40.0, 25.0
    view = capture.picture(
        of="expected_e",
        projection=projection,
        field_of_view_deg=60.0,
        towards_deg=(azimuth, elevation),
        max_pixels=n,
    )
    height = {"rectilinear": math.tan, "stereographic": lambda t: 2.0 * math.tan(t / 2), "orthographic": math.sin}
    half = height[projection](math.radians(30.0))
    x, y = np.meshgrid(*[((np.arange(n) + 0.5) / n * 2.0 - 1.0) * half] * 2)
    if projection == "rectilinear":
        d = np.stack((x, y, np.ones_like(x)), axis=-1) / np.sqrt(1.0 + x * x + y * y)[..., np.newaxis]
    elif projection == "stereographic":
        k = 1.0 / (1.0 + 0.25 * (x * x + y * y))
        d = np.stack((x * k, y * k, 2.0 * k - 1.0), axis=-1)
    else:
        d = np.stack((x, y, np.sqrt(1.0 - x * x - y * y)), axis=-1)
    ce, se, ca, sa = (f(math.radians(a)) for a in (elevation, azimuth) for f in (math.cos, math.sin))
    up = d @ np.array([[1.0, 0.0, 0.0], [0.0, ce, -se], [0.0, se, ce]])
    world = up @ np.array([[ca, 0.0, -sa], [0.0, 1.0, 0.0], [sa, 0.0, ca]])
    found = relative(view, world)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, found.mean(), rtol=5e-3)


def test_stored_captures_contain_their_lens(capture, tmp_path):
    capture.save(tmp_path / "capture.npz")
    again = fs.Capture.load(tmp_path / "capture.npz").picture(projection="rectilinear", max_pixels=40)
    expected = capture.picture(projection="rectilinear", max_pixels=40, lens=LENS)
    np.testing.assert_array_equal(again.data, expected.data)


def test_gaze_displaces_the_sensor():
    """A view shows the same directions wherever the sensor is behind the lens."""
    camera = fs.Camera(
        optics=fs.Optics(focal_length_mm=1.0, f_number=2.8),
        sensor=fs.Sensor(fs.layout.grid(n_x=120, n_y=120, pitch_um=20.0), shot_noise="off"),
        distortion=LENS,
    )
    scene = panorama(gaze_range_um=(300.0, 300.0), cells=256)
    views = [
        camera.capture(scene, exposure_s=1e-4, seed=0, gaze_um=gaze_um).picture(
            of="expected_e", projection="rectilinear", field_of_view_deg=40.0, max_pixels=50
        )
        for gaze_um in ((0.0, 0.0), (300.0, -200.0))
    ]
    np.testing.assert_allclose(views[1].data, views[0].data, rtol=3e-3)


def test_cameras_without_model_have_ideal_views():
    layout = fs.layout.grid(n_x=80, n_y=80, pitch_um=20.0)
    options = {"sensor": fs.Sensor(layout, shot_noise="off")}
    ideal = fs.Camera(optics=fs.Optics(focal_length_mm=1.0, f_number=2.8, projection="equidistant"), **options)
    scene = panorama(cells=256)
    view = {"of": "expected_e", "projection": "rectilinear", "field_of_view_deg": 50.0, "max_pixels": 40}
    found = ideal.capture(scene, exposure_s=1e-4, seed=0).picture(**view)
    model = fs.Camera(optics=ideal.optics, distortion=LENS, **options)
    expected = model.capture(scene, exposure_s=1e-4, seed=0).picture(**view)
    np.testing.assert_allclose(found.data, expected.data, rtol=1e-4)


def test_wrong_views_are_errors(capture):
    with pytest.raises(
        ParameterError, match="'field_of_view_deg' must be <= 170 for the rectilinear projection, got 200"
    ):
        capture.picture(projection="rectilinear", field_of_view_deg=200.0)
    with pytest.raises(ParameterError, match="'grid' must not be given with 'projection'"):
        capture.picture(projection="rectilinear", grid=fs.Grid((4, 4), 1.0))
    with pytest.raises(ParameterError, match="'lens' requires 'projection'"):
        capture.picture(lens=LENS)
    unknown = replace(capture, settings={**capture.settings, "distortion": {"kind": "Own"}})
    with pytest.raises(ParameterError, match="'lens' must be given: the capture does not contain its lens model"):
        unknown.picture(projection="rectilinear")

"""Means of panoramas over the solid angle of image cells."""

from __future__ import annotations

import math

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.scene._panorama import Panorama

LEVEL = {"luminance_cd_m2": 100.0, "encoding": "linear"}


def cell_directions(n, extent):
    """Return the directions of cells of an equidistant image of n x n cells, and their solid angles."""
    at = (np.arange(n) + 0.5 - 0.5 * n) * extent / n
    x, y = np.meshgrid(at, at)
    theta = np.hypot(x, y)
    across = np.sinc(theta / math.pi)
    solid_sr = np.where(theta < math.pi, np.abs(across), 0.0) * (extent / n) ** 2
    return np.stack((x * across, y * across, np.cos(theta)), axis=-1), solid_sr


def equirectangular(function, n_y):
    """Return a picture, top row first, of a function of directions at the centres of its pixels."""
    elevation, azimuth = np.meshgrid(
        (0.5 - (np.arange(n_y) + 0.5) / n_y) * math.pi,
        ((np.arange(2 * n_y) + 0.5) / n_y - 1.0) * math.pi,
        indexing="ij",
    )
    cosine = np.cos(elevation)
    return function(cosine * np.sin(azimuth), np.sin(elevation), cosine * np.cos(azimuth))


def cubemap(function, n):
    """Return a horizontal cross, top row first, from the faces as seen from the centre of the cube."""
    at = (np.arange(n) + 0.5) / n * 2.0 - 1.0
    right, up = np.meshgrid(at, at[::-1])
    one = np.ones_like(right)
    faces = {
        (0, 1): (right, one, -up),  # top: its lower side is at the front
        (1, 0): (-one, up, right),
        (1, 1): (right, up, one),
        (1, 2): (one, up, -right),
        (1, 3): (-right, up, -one),
        (2, 1): (right, -one, up),
    }
    picture = np.zeros((3 * n, 4 * n))
    for (row, column), d in faces.items():
        x, y, z = np.array(d) / np.sqrt(np.square(d).sum(axis=0))
        picture[row * n : (row + 1) * n, column * n : (column + 1) * n] = function(x, y, z)
    return picture


def smooth(x, y, z):
    return 1.0 + 0.3 * x + 0.25 * y * z + 0.2 * x * x - 0.15 * y


def means(picture, n, extent=2.0 * math.pi, **parameters):
    """Return the means over the cells of an equidistant image, n x n."""
    panorama = Panorama(**parameters)
    return panorama.cell_means(
        np.ascontiguousarray(picture[::-1], np.float32)[np.newaxis], "equidistant", (n, n), extent / n, 1
    )[0]


@pytest.mark.parametrize("mapping", ["equirectangular", "cubemap", "fisheye"])
def test_cells_have_the_radiance_of_their_direction(mapping):
    extent, options = 2.0 * math.pi, {"mapping": mapping}
    if mapping == "equirectangular":
        picture = equirectangular(smooth, 512)
    elif mapping == "cubemap":
        picture = cubemap(smooth, 256)
    else:
        # A photograph by an equisolid lens with the centre of its image at (10, -6) pixels.
        extent, n = 0.9 * math.pi, 1024
        lens = fs.distortion.Fisheye(projection="equisolid", focal_um=900.0, centre_um=(30.0, -18.0))
        x, y = np.meshgrid((np.arange(n) + 0.5 - 0.5 * n) * 3.0, (0.5 * n - np.arange(n) - 0.5) * 3.0)
        d = lens.direction(np.stack((x, y), axis=-1), outside="mask")
        picture = np.nan_to_num(smooth(*np.moveaxis(d, -1, 0)))
        options |= {"lens": lens, "pixel_um": 3.0}
    d, solid_sr = cell_directions(300, extent)
    found = means(picture, 300, extent, **options)
    # Nearly opposite to the axis, cells become narrow, and the mean over a cell is not that of its centre.
    is_compared = (solid_sr > 0.2 * solid_sr.max()) & (np.hypot(d[..., 0], d[..., 1]) > 0.0)
    np.testing.assert_allclose(found[is_compared], smooth(*np.moveaxis(d, -1, 0))[is_compared], atol=4e-3)
    assert np.abs(found - smooth(*np.moveaxis(d, -1, 0)))[is_compared].mean() < 6e-4


@pytest.mark.parametrize(
    "orientation", [{}, {"pitch_deg": 90.0}, {"yaw_deg": 130.0, "pitch_deg": -35.0, "roll_deg": 20.0}]
)
def test_light_of_random_pixels_is_conserved(orientation):
    """Pixels of the panorama have the solid angle Δφ (sin β2 - sin β1): at eight cells per pixel their light is exact to 1e-3."""
    n_y = 32
    picture = np.random.default_rng(4).random((n_y, 2 * n_y)) ** 4
    sines = np.sin(math.pi * (np.arange(n_y + 1) / n_y - 0.5))
    expected = (picture[::-1] * np.diff(sines)[:, np.newaxis]).sum() * math.pi / n_y
    n = 8 * 2 * n_y
    _, solid_sr = cell_directions(n, 2.0 * math.pi)
    found = (means(picture, n, **orientation) * solid_sr).sum()
    assert found == pytest.approx(expected, rel=1e-3)


def test_poles_keep_narrow_features():
    """Alternating columns converge at the zenith, where a cell contains thousands of pixels, to their mean."""
    picture = np.tile([0.0, 1.0], (512, 512))
    found = means(picture, 101, 0.5, pitch_deg=90.0)
    assert np.abs(found[47:54, 47:54] - 0.5).max() < 0.02
    # A single bright pixel below the zenith has the light of its solid angle.
    picture = np.zeros((512, 1024))
    picture[3, 100] = 1.0
    sr = 2.0 * math.pi / 1024 * (math.cos(3.0 * math.pi / 512) - math.cos(4.0 * math.pi / 512))
    _, solid_sr = cell_directions(400, 0.4)
    assert (means(picture, 400, 0.4, pitch_deg=90.0) * solid_sr).sum() == pytest.approx(sr, rel=0.02)


def test_channels_are_those_of_single_pictures(monkeypatch):
    """Panoramas whose sums exceed the memory limit are processed channel by channel."""
    pictures = np.random.default_rng(1).random((3, 32, 64)).astype(np.float32)
    together = Panorama().cell_means(pictures, "equisolid", (20, 24), 0.1, 1)
    monkeypatch.setattr("foveasim.scene._panorama.MAX_SUMS", 1)
    np.testing.assert_array_equal(Panorama().cell_means(pictures, "equisolid", (20, 24), 0.1, 2), together)


def test_orientation_turns_the_camera():
    """The camera sees straight ahead what is to the right, above, or tilted."""

    def ahead(**orientation):
        x, y, z = Panorama(**orientation).rotation @ [0.0, 0.0, 1.0]
        return round(x, 6), round(y, 6), round(z, 6)

    assert ahead(yaw_deg=90.0) == (1.0, 0.0, 0.0)
    assert ahead(pitch_deg=90.0) == (0.0, 1.0, 0.0)
    assert ahead(yaw_deg=90.0, pitch_deg=45.0) == (0.707107, 0.707107, 0.0)
    assert ahead(yaw_deg=30.0, gaze_deg=(60.0, 0.0)) == (1.0, 0.0, 0.0)
    # The camera turns clockwise: its upper side points to the right.
    np.testing.assert_allclose(Panorama(roll_deg=90.0).rotation @ [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], atol=1e-15)


def test_panoramas_of_other_shapes_are_errors():
    with pytest.raises(
        ParameterError, match="must be twice as wide as high, 360° x 180°, for 'equirectangular', got 30 x 20"
    ):
        fs.Scene.from_panorama(np.ones((20, 30)), **LEVEL)
    with pytest.raises(ParameterError, match="must be a horizontal cross of 4 x 3 square faces"):
        fs.Scene.from_panorama(np.ones((20, 30)), mapping="cubemap", **LEVEL)
    with pytest.raises(ParameterError, match=r"'lens' must be a lens model of foveasim\.distortion"):
        fs.Scene.from_panorama(np.ones((20, 30)), mapping="fisheye", pixel_um=3.0, **LEVEL)
    with pytest.raises(ParameterError, match="'pixel_um' requires mapping='fisheye'"):
        fs.Scene.from_panorama(np.ones((20, 40)), pixel_um=3.0, **LEVEL)
    flat = fs.Scene.flat(shape=(4, 4), pitch_um=1.0, distance_m=1.0, luminance_cd_m2=1.0)
    with pytest.raises(ParameterError, match=r"must be a panorama, which Scene\.from_panorama creates"):
        flat.turned(yaw_deg=1.0)

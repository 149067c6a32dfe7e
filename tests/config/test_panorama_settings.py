"""Panoramas in settings files."""

from __future__ import annotations

import numpy as np
from PIL import Image

import foveasim as fs

SHOT = """
scene: {kind: panorama, picture: sky.png, luminance_cd_m2: 500.0, yaw_deg: 90.0, cells: 64}
optics: {focal_length_mm: 1.0, f_number: 2.8, pupil_tilt: turning}
distortion: {kind: fisheye, projection: equidistant, focal_um: 1000.0}
layout: {generator: grid, parameters: {n_x: 4, n_y: 4, pitch_um: 700.0}}
exposure_s: 0.001
"""
PHOTOGRAPH = """
scene:
  kind: panorama
  picture: photograph.png
  mapping: fisheye
  lens: {kind: fisheye, projection: equisolid, focal_um: 100.0}
  pixel_um: 10.0
  luminance_cd_m2: 500.0
"""


def test_settings_of_panoramas_yield_scenes_of_python(tmp_path):
    sky = np.random.default_rng(0).integers(0, 255, (16, 32), np.uint8)
    Image.fromarray(sky).save(tmp_path / "sky.png")
    (tmp_path / "shot.yaml").write_text(SHOT)
    shot = fs.config.read_shot(tmp_path / "shot.yaml")
    camera = fs.Camera(
        optics=fs.Optics(focal_length_mm=1.0, f_number=2.8, pupil_tilt="turning"),
        sensor=fs.Sensor(fs.layout.grid(n_x=4, n_y=4, pitch_um=700.0)),
        distortion=fs.distortion.Fisheye(projection="equidistant", focal_um=1000.0),
    )
    scene = fs.Scene.from_panorama(sky, luminance_cd_m2=500.0, yaw_deg=90.0, cells=64)
    assert shot.scene.panorama == scene.panorama
    expected = camera.photoelectrons_per_s(scene)
    assert expected.min() > 0.0
    np.testing.assert_array_equal(shot.camera.photoelectrons_per_s(shot.scene), expected)


def test_settings_contain_the_lens_of_a_photograph(tmp_path):
    Image.fromarray(np.full((40, 40), 200, np.uint8)).save(tmp_path / "photograph.png")
    others = "\n".join(SHOT.splitlines()[2:])
    (tmp_path / "shot.yaml").write_text(PHOTOGRAPH + others)
    scene = fs.config.read_shot(tmp_path / "shot.yaml").scene
    assert scene.panorama.lens == fs.distortion.Fisheye(projection="equisolid", focal_um=100.0)

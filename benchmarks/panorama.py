"""Images of panoramas per orientation, against linear interpolation of as many samples by SciPy."""

from __future__ import annotations

import time
from itertools import count

import numpy as np
from report import Report, best_s
from scipy.ndimage import map_coordinates

import foveasim as fs

#: Field of the image, a fisheye lens of 185°, and its focal length, µm.
FOCAL_UM, HALF_FIELD_RAD = 1000.0, 1.6144
N_REPEATS = 4
#: Samples of a cell along each axis, and the time that an image may take in units of their interpolation.
N_POINTS, MAX_RATIO = 2, 8.0


def bench_panorama(report: Report, n_side: int) -> None:
    """Add the row of an image of n_side x n_side cells in another orientation each time."""
    picture = np.random.default_rng(0).random((n_side, 2 * n_side), dtype=np.float32)
    scene = fs.Scene.from_panorama(picture, luminance_cd_m2=100.0, encoding="linear", cells=n_side)
    side_um = 2.0 * HALF_FIELD_RAD * FOCAL_UM
    camera = fs.Camera(
        optics=fs.Optics(focal_length_mm=1e-3 * FOCAL_UM, f_number=2.8),
        sensor=fs.Sensor(fs.layout.grid(n_x=8, n_y=8, pitch_um=side_um / 8.0)),
        distortion=fs.distortion.Fisheye(projection="equidistant", focal_um=FOCAL_UM),
        n_threads=1,
    )
    numbers, random = count(), np.random.default_rng(1)
    places = np.arange(N_POINTS * n_side) / N_POINTS
    at = np.stack(np.meshgrid(places, places, indexing="ij")) + random.random((2, N_POINTS * n_side, N_POINTS * n_side))

    def image() -> None:
        camera.fit_scene(scene.turned(yaw_deg=0.1 * next(numbers)))

    def samples() -> None:
        map_coordinates(picture, at, order=1, mode="nearest")

    image()
    times = best_s({"image": image, "samples": samples}, N_REPEATS, time.process_time)
    what = f"image of a panorama on {n_side} x {n_side} cells, per orientation"
    report.slower_than(what, times["image"], "linear interpolation of 4 samples per cell", times["samples"], MAX_RATIO)

"""Frames of scenes with depth, against Fourier transforms of the picture."""

from __future__ import annotations

import time

import numpy as np
import scipy.fft
from report import Report, best_s

import foveasim as fs

LENS = fs.Optics(focal_length_mm=8.0, f_number=1.4, padding="periodic", oversample=1, focus_distance_m=1.0)
#: Pitch of the scene at 1 m, µm: cells of 4 µm.
PITCH_UM = 500.0
N_REPEATS = 4
#: Pairs of transforms of a frame with n layers: (n + 2) times this number, for the light and the cover of each. Layers of a
#: floor are bands of rows, outside which they are not transformed.
FLOOR_PAIRS, WALL_PAIRS = 1.5, 2.0


def bench_depth(report: Report, n_side: int) -> None:
    """Add rows of repeated frames of n_side x n_side cells: a floor and a side wall, each with a near square."""
    picture = np.random.default_rng(0).random((n_side, n_side), dtype=np.float32)
    recedes_m = np.linspace(0.6, 3.0, n_side) * np.ones((n_side, 1))

    def pair() -> None:
        scipy.fft.irfft2(scipy.fft.rfft2(picture))

    for what, depth_m, limit in (("a floor", recedes_m.T.copy(), FLOOR_PAIRS), ("a side wall", recedes_m, WALL_PAIRS)):
        depth_m[n_side // 4 : n_side // 2, n_side // 4 : n_side // 2] = 0.5
        scene = fs.Scene.from_rgbd(
            picture, depth_m, distance_m=1.0, pitch_um=PITCH_UM, peak_radiance_w_m2_sr_nm=1.0, encoding="linear"
        )
        n_layers = len(LENS._focused(scene)._layers(scene).layers)  # noqa: SLF001 -- the unit of the cost

        def frame(scene: fs.Scene = scene) -> None:
            LENS.power_map(scene, n_threads=1)

        def pairs(n_pairs: int = n_layers + 2) -> None:
            for _ in range(n_pairs):
                pair()

        for _ in range(2):  # transfer functions are cached from the second request on
            frame()
        times = best_s({"frame": frame, "pairs": pairs}, N_REPEATS, time.process_time)
        name = f"{what} of {n_side} x {n_side} cells, in {n_layers} layers"
        against = f"rfft2 + irfft2, {n_layers} + 2 times"
        report.slower_than(name, times["frame"], against, times["pairs"], limit)

"""Frames with PSFs that vary over the field, against frames with one PSF."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from report import Report, best_s

import foveasim as fs

LENS = fs.Optics(focal_length_mm=8.0, f_number=4.0, padding="zero", oversample=1)
#: Pitch of the scene for cells of 0.45 λN, in µm.
PITCH_UM = 122.0
#: Aberrations at the corners, µm, which blur by 6 cells.
CORNER_UM = {"coma_um": 0.14, "astigmatism_um": 0.098, "field_curvature_um": 0.07}
N_REPEATS = 4


def bench_field_modes(report: Report, n_side: int) -> None:
    """Add the rows of repeated frames of n_side x n_side cells with 4 and 16 modes, and of a first frame."""
    fixed = replace(LENS, seidel=fs.optics.Seidel(spherical_um=0.1))
    scene = _scene(n_side)
    lenses = {k: _varying(scene, field_modes=k) for k in (4, 16)}

    def frame(lens: fs.Optics) -> None:
        lens.power_map(scene, n_threads=1)

    for lens in (fixed, *lenses.values()):  # transfer functions are cached from the second request on
        frame(lens)
        frame(lens)
    times = best_s(
        {"one PSF": lambda: frame(fixed), **{str(k): lambda lens=lens: frame(lens) for k, lens in lenses.items()}},
        N_REPEATS,
        time.process_time,
    )
    for k, limit in ((4, 4.0), (16, 10.0)):
        what = f"frame of {n_side} x {n_side} cells with the mean PSF and {k} modes"
        report.slower_than(what, times[str(k)], "frame with one PSF", times["one PSF"], limit)
    small = _scene(512)
    start = time.perf_counter()
    lens = _varying(small)
    lens.power_map(small)
    seconds = time.perf_counter() - start
    displaced = lens.field_error(small)
    report.add("first frame of 512 x 512 cells", f"{seconds:.3g} s", "seconds", "", seconds, 5.0)
    report.add(
        "light that its modes displace", f"{displaced:.2%}", "tolerance", f"{lens.field_tolerance:.0%}", displaced, 0.01
    )


def _scene(n_side: int) -> fs.Scene:
    picture = np.random.default_rng(0).random((1, n_side, n_side), dtype=np.float32)
    return fs.Scene(picture, np.ones((1, 1)), np.array([550.0]), np.ones(1), PITCH_UM, 1.0)


def _varying(scene: fs.Scene, **options: int) -> fs.Optics:
    corner_um = float(np.hypot(*LENS.grid(scene).bounds_um[2:]))
    return replace(LENS, seidel=fs.optics.Seidel(**CORNER_UM, field_radius_um=corner_um), **options)

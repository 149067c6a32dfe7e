"""Times of pixel optics: footprints against compiled layouts, frames and first captures against those without."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from dense import EXPOSURE_S, dense_camera, dense_scene
from report import Report, best_s

import foveasim as fs

N_SECTORS, N_RINGS = 240, 142
STACK = fs.sensor.ApertureStack(height_um=4.0, refractive_index=1.5)
MICROLENS = fs.sensor.Microlens(height_um=3.0, refractive_index=1.5, shift="optimal", photodiode_inset_um=0.1)
N_REPEATS = 5


def bench_angular(report: Report, shape: tuple[int, int], n_side: int) -> None:
    """Add the rows of log-polar sites over a map, and of a square lattice of n_side x n_side photosites."""
    _bench_rings(report, shape)
    _bench_lattice(report, n_side)


def _bench_rings(report: Report, shape: tuple[int, int]) -> None:
    """Compare response and outlines with compiling, and frames with those of the layout."""
    optics = fs.Optics(focal_length_mm=8.0, f_number=2.8, oversample=1)
    grid = fs.Grid.centred(shape, 0.5)
    r_max_um = 0.495 * shape[0] * 0.5
    layout = fs.layout.log_polar(n_sectors=N_SECTORS, n_rings=N_RINGS, r_min_um=0.1 * r_max_um, r_max_um=r_max_um)
    cones = optics.incidence(layout.centroid_um)
    times = best_s(
        {
            "footprints": lambda: STACK.footprints(layout, cones),
            "lenses": lambda: MICROLENS.footprints(layout, cones),
            "compile": lambda: fs.Integrator(layout, grid),
        },
        N_REPEATS,
        time.process_time,
    )
    what = f"response and footprints of {layout.n_sites:,} log-polar sites"
    report.slower_than(what, times["footprints"], "compiling them", times["compile"], 0.6)
    report.slower_than("response of microlenses", times["lenses"], "compiling the layout", times["compile"])
    outlines = STACK.footprints(layout, cones).outlines
    plain, angular = fs.Integrator(layout, grid), fs.Integrator(outlines, grid)
    cells = np.random.default_rng(0).random(shape, dtype=np.float32)
    frames = best_s({"plain": lambda: plain(cells), "angular": lambda: angular(cells)}, 4 * N_REPEATS)
    report.slower_than("frame over footprints", frames["angular"], "frame over the layout", frames["plain"], 1.05)


def _bench_lattice(report: Report, n_side: int) -> None:
    """Compare first captures of a lattice with and without microlenses."""
    scene, plain = dense_scene(n_side, 1), dense_camera(n_side, is_colour=False)

    def first(camera: fs.Camera) -> None:
        fresh = fs.Camera(optics=replace(camera.optics), sensor=replace(camera.sensor))
        fresh.capture(scene, exposure_s=EXPOSURE_S, seed=0)

    lenses = fs.Camera(optics=plain.optics, sensor=replace(plain.sensor, pixel_optics=MICROLENS))
    times = best_s({"lenses": lambda: first(lenses), "plain": lambda: first(plain)}, N_REPEATS)
    what = f"first capture of {n_side} x {n_side} photosites with microlenses"
    report.slower_than(what, times["lenses"], "without microlenses", times["plain"], 1.2)

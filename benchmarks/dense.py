"""
Captures of sensors with as many photosites as source pixels, in pairs of Fourier transforms of the picture.

A pair is one float64 ``scipy.fft.rfft2`` and one ``irfft2`` of the picture on one thread. Pairs alternate with captures, and
medians are compared.

    python benchmarks/dense.py             2048 x 2048 photosites
    python benchmarks/dense.py --quick     512 x 512
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.fft
from report import Report, best_s
from rich.console import Console

import foveasim as fs

#: Pitch of the photosites and of the cells of the power map; the Airy disc has a diameter of 5.4 µm at f/4.
PITCH_UM = 3.0
#: Exposure below the saturation of all sensors of these programs.
EXPOSURE_S = 2e-4
#: Distance of the scenes, and captures per figure; more of a cube in a file, whose time is that of memory.
DISTANCE_M, N_REPEATS, N_CUBE_REPEATS = 1.0, 5, 15
#: Bands of a hyperspectral scene.
N_BANDS = 31
#: Bounds in pairs: one band, three bands behind a Bayer mosaic, 31 bands behind it.
MONO_PAIRS, BAYER_PAIRS, BANDS_PAIRS = 2.5, 4.0, 16.0
#: Bounds of a first capture, which includes layout and compilation, in pairs; and of its memory above the scene.
FIRST_PAIRS, BYTES_PER_SITE = 15.0, 150.0
console = Console(width=130)


def bench_dense(report: Report, n_side: int) -> None:
    """Add all rows for square sensors of n_side x n_side photosites."""
    bench_mono(report, n_side)
    bench_bayer(report, n_side)
    bench_bands(report, n_side)
    bench_first(report, n_side)
    bench_memory(report, n_side)
    bench_cube(report, n_side)
    bench_tiles(report, 5 * n_side)


def bench_mono(report: Report, n_side: int) -> None:
    """Repeated captures of one band."""
    _report_captures(report, "mono", dense_camera(n_side, is_colour=False), dense_scene(n_side, 1), MONO_PAIRS)


def bench_bayer(report: Report, n_side: int) -> None:
    """Repeated captures of a colour picture of three bands behind a Bayer mosaic."""
    _report_captures(
        report, "Bayer, 3 bands", dense_camera(n_side, is_colour=True), dense_scene(n_side, 3), BAYER_PAIRS
    )


def bench_bands(report: Report, n_side: int) -> None:
    """Repeated captures of 31 independent bands behind a Bayer mosaic."""
    _report_captures(
        report, "Bayer, 31 bands", dense_camera(n_side, is_colour=True), dense_scene(n_side, N_BANDS), BANDS_PAIRS
    )


def bench_first(report: Report, n_side: int) -> None:
    """First captures: layout, sensor, camera and capture."""
    for name, n_bands in (("mono", 1), ("Bayer, 3 bands", 3)):
        scene = dense_scene(n_side, n_bands)

        def first(scene: fs.Scene = scene, *, is_colour: bool = n_bands > 1) -> None:
            dense_camera(n_side, is_colour=is_colour).capture(scene, exposure_s=EXPOSURE_S, seed=0)

        times = medians_s({"pair": pair_of(n_side), "first": first, "again": pair_of(n_side)}, N_REPEATS)
        report.slower_than(
            f"layout and first capture, {name}",
            times["first"],
            "rfft2 + irfft2",
            min(times["pair"], times["again"]),
            FIRST_PAIRS,
        )


MEMORY_PROBE = """
import sys
sys.path.insert(0, sys.argv[1])
import dense
def status(key):
    return next(int(l.split()[1]) * 1024 for l in open("/proc/self/status") if l.startswith(key))
def run(n_side, scene):
    dense.dense_camera(n_side, is_colour=False).capture(scene, exposure_s=dense.EXPOSURE_S, seed=0)
run(256, dense.dense_scene(256, 1))
n_side = int(sys.argv[2])
scene = dense.dense_scene(n_side, 1)
before = status("VmRSS")
open("/proc/self/clear_refs", "w").write("5")
run(n_side, scene)
print((status("VmHWM") - before) / n_side**2)
"""


def bench_memory(report: Report, n_side: int) -> None:
    """Measure the peak memory of a first capture above the scene, in a separate process (Linux)."""
    if not Path("/proc/self/clear_refs").exists():
        return
    arguments = [sys.executable, "-c", MEMORY_PROBE, str(Path(__file__).parent), str(n_side)]
    n_bytes = float(subprocess.run(arguments, capture_output=True, text=True, check=True).stdout)
    report.add("peak memory of layout and first capture, mono", "", "bytes per site", "", n_bytes, BYTES_PER_SITE)


def bench_cube(report: Report, n_side: int) -> None:
    """Compare a capture of a cube of 31 bands in an ENVI file with one of the cube in memory."""
    scene, camera = dense_scene(n_side, N_BANDS), dense_camera(n_side, is_colour=True)
    with tempfile.TemporaryDirectory() as directory:
        header = Path(directory) / "cube.hdr"
        scene.basis[:, ::-1].tofile(header.with_suffix(".img"))  # top row first
        wavelengths = ", ".join(map(str, scene.wavelength_nm))
        header.write_text(
            f"ENVI\nsamples = {n_side}\nlines = {n_side}\nbands = {N_BANDS}\ndata type = 4\ninterleave = bsq\n"
            f"wavelength units = nm\nwavelength = {{{wavelengths}}}\n"
        )

        def from_file() -> None:
            cube = fs.Scene.from_cube(header, unit="W/(m^2 sr nm)", pitch_um=scene.pitch_um, distance_m=DISTANCE_M)
            camera.capture(cube, exposure_s=EXPOSURE_S, seed=0)

        # The best of each: how long reading takes varies with how much of the file the machine keeps in memory.
        times = best_s(
            {"file": from_file, "memory": lambda: camera.capture(scene, exposure_s=EXPOSURE_S, seed=0)},
            N_CUBE_REPEATS,
        )
    what = f"ENVI cube of {N_BANDS} bands, opened and captured"
    report.slower_than(what, times["file"], "the cube in memory", times["memory"], 1.5)


TILES_PROBE = """
import sys, tempfile, time
sys.path.insert(0, sys.argv[1])
import dense, foveasim as fs
from pathlib import Path
n_side = int(sys.argv[2])
scene, camera = dense.dense_scene(n_side, 1), dense.dense_camera(n_side, is_colour=False)
with tempfile.TemporaryDirectory() as directory:
    start = time.perf_counter()
    fs.tiles.write_tiles(Path(directory) / "capture.zarr", camera, scene, exposure_s=dense.EXPOSURE_S, seed=0)
    duration_s = time.perf_counter() - start
peak = next(int(l.split()[1]) * 1024 for l in open("/proc/self/status") if l.startswith("VmHWM"))
print(duration_s, peak)
"""


def bench_tiles(report: Report, n_side: int) -> None:
    """Measure a capture in tiles to a zarr store, in a separate process (Linux)."""
    if not Path("/proc/self/status").exists():
        return
    arguments = [sys.executable, "-c", TILES_PROBE, str(Path(__file__).parent), str(n_side)]
    output = subprocess.run(arguments, capture_output=True, text=True, check=True).stdout
    duration_s, n_bytes = map(float, output.split())
    pair = pair_of(n_side)
    pair_s = medians_s({"pair": pair}, 1)["pair"]
    what = f"{n_side} x {n_side} photosites in tiles, written to zarr"
    report.slower_than(what, duration_s, f"rfft2 + irfft2, float64, {n_side} x {n_side}", pair_s)
    report.add("peak memory of the same, with the scene", "", "GB", "", n_bytes / 1e9, 8.0)


def dense_optics() -> fs.Optics:
    """Return a lens with one map cell per source pixel."""
    return fs.Optics(focal_length_mm=22.0, f_number=4.0, oversample=1)


def dense_scene(n_side: int, n_bands: int) -> fs.Scene:
    """Return random basis images, each of one wavelength."""
    wavelength_nm = np.linspace(430.0, 670.0, n_bands) if n_bands > 1 else np.array([550.0])
    return fs.Scene(
        np.random.default_rng(0).random((n_bands, n_side, n_side), dtype=np.float32),
        0.2 * np.eye(n_bands),
        wavelength_nm,
        np.full(n_bands, 240.0 / n_bands),
        PITCH_UM / dense_optics().magnification(DISTANCE_M),
        DISTANCE_M,
    )


def dense_camera(n_side: int, *, is_colour: bool) -> fs.Camera:
    """Return a camera with one photosite per source pixel, with all noise."""
    layout = fs.layout.grid(n_x=n_side, n_y=n_side, pitch_um=PITCH_UM)
    noise = {"dark_e_per_s": 20.0, "full_well_e": 1e6, "read_noise_e": 1.0, "bits": 12}
    if is_colour:
        sensor = fs.Sensor(fs.layout.mosaic(layout, ("RG", "GB")), filters="rgb", **noise)
    else:
        sensor = fs.Sensor(layout, qe=0.6, **noise)
    return fs.Camera(optics=dense_optics(), sensor=sensor)


def pair_of(n_side: int) -> Callable[[], object]:
    """Return a call that transforms a float64 picture on one thread and back."""
    picture = np.random.default_rng(0).random((n_side, n_side))
    return lambda: scipy.fft.irfft2(scipy.fft.rfft2(picture), s=picture.shape)


def medians_s(calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the median time of each call; calls alternate."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(times) for name, times in seconds.items()}


def _report_captures(report: Report, name: str, camera: fs.Camera, scene: fs.Scene, bound: float) -> None:
    """Compare repeated captures, and the optics alone, with pairs."""
    n_side = scene.basis.shape[1]
    weights = camera.sensor.responsivity_e_per_j(scene.wavelength_nm)

    def image() -> None:
        for cells in camera.optics.weighted_maps(scene, weights):
            del cells

    def capture() -> None:
        camera.capture(scene, exposure_s=EXPOSURE_S, seed=0)

    for _ in range(2):  # compiles the layout, and caches the factors of the lens, which it does from the second map on
        capture()
    times = medians_s(
        {"pair": pair_of(n_side), "capture": capture, "again": pair_of(n_side), "optics": image}, N_REPEATS
    )
    against = f"rfft2 + irfft2, float64, {n_side} x {n_side}"
    pair_s = min(times["pair"], times["again"])
    what = f"{n_side} x {n_side} photosites, {name}"
    report.slower_than(what, times["capture"], against, pair_s, bound)
    report.slower_than("its optics alone", times["optics"], against, pair_s)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    is_quick = parser.parse_args().quick
    own = Report(is_judged=not is_quick)
    bench_dense(own, 512 if is_quick else 2048)
    console.print(own.table)

"""
Video: frames per second against the Fourier transforms and the integration that a frame needs, and peak memory.

    python benchmarks/video.py             1,000 frames of 1080p onto 30,240 sites, about a minute
    python benchmarks/video.py --quick     100 frames
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import scipy.fft
from report import Report
from rich.console import Console

import foveasim as fs
from foveasim._core.threads import thread_count
from foveasim.modes import EventPixels

SHAPE = (1080, 1920)
PITCH_UM, DISTANCE_M, FOCAL_LENGTH_MM, F_NUMBER = 20.0, 0.82, 40.0, 4.0
N_SECTORS, N_RINGS = 240, 126
EXPOSURE_S, FRAME_S, LINE_S = 0.01, 1 / 60, 2e-5
#: Different pictures in turns: a video of them is not in memory.
N_PICTURES = 8
MAX_PEAK_GB = 1.5
console = Console(width=130)


def bench_video(report: Report, n_frames: int) -> None:
    """Benchmark frames of a video with cells of source pixels and with finer ones, and the memory of ``n_frames``."""
    _bench_camera(report, _camera(oversample=1))
    _bench_camera(report, _camera(oversample="auto"))
    _memory(report, n_frames)


def _limit(camera: fs.Camera, scene: fs.Scene) -> tuple[str, Callable[[], None]]:
    """Return the minimum work per frame: FFT of the padded picture, inverse FFT to the cells of the map, integration."""
    pixels, k = camera.optics.grid(scene), camera.oversample(scene)
    pad = int(np.ceil(20.3 * 0.55 * camera.optics.working_f_number(DISTANCE_M) / pixels.pitch_um))
    padded = tuple(int(scipy.fft.next_fast_len(n + 2 * pad, real=True)) for n in SHAPE)
    fine = tuple(k * n for n in padded)
    ((grid, _),) = camera.optics.resolve_oversample(scene).image_grids(scene)
    cells, picture = (np.random.default_rng(0).random(s, dtype=np.float32) for s in (grid.shape, padded))
    integrator = camera.integrator(grid, order=camera.order(scene))

    def limit() -> None:
        for _ in range(N_PICTURES):
            spectrum = scipy.fft.rfft2(picture, workers=thread_count())
            scipy.fft.irfft2(spectrum, s=fine, workers=thread_count(), overwrite_x=True)
            integrator(cells)

    name = f"rfft2 {padded[0]} x {padded[1]}, irfft2{'' if k == 1 else f' {fine[0]} x {fine[1]}'}, integral"
    return name, limit


def _bench_camera(report: Report, camera: fs.Camera) -> None:
    pictures = _pictures()
    scenes = [next(iter(_footage([picture]))) for picture in pictures]
    k = camera.oversample(scenes[0])
    against, limit = _limit(camera, scenes[0])

    def still() -> None:
        for _ in camera.video(scenes, exposure_s=EXPOSURE_S, seed=0):
            pass

    def ahead() -> None:
        for _ in camera.video(scenes * 2, exposure_s=EXPOSURE_S, seed=0, ahead=thread_count()):
            pass

    def rolling() -> None:
        for _ in camera.video(scenes, exposure_s=EXPOSURE_S, seed=0, frame_s=FRAME_S, line_s=LINE_S):
            pass

    def from_pictures() -> None:
        for _ in camera.video(_footage(pictures * 2), exposure_s=EXPOSURE_S, seed=0):
            pass

    def gaze() -> None:
        path = ((scenes[0], (0.37 * k, -0.21 * k)) for k in range(N_PICTURES))
        for _ in camera.video(path, exposure_s=EXPOSURE_S, seed=0):
            pass

    pixels = EventPixels(camera.sensor, capacitance_f=1e-14, noise_per_s=1.0, refractory_s=1e-4, mismatch_fraction=0.03)

    def events() -> None:
        for _ in pixels.stream(camera.rates(scenes), frame_s=FRAME_S, seed=0):
            pass

    calls = {
        "still": (still, N_PICTURES),
        "ahead": (ahead, 2 * N_PICTURES),
        "pictures": (from_pictures, 2 * N_PICTURES),
        "rolling": (rolling, N_PICTURES),
        "events": (events, N_PICTURES),
        "gaze": (gaze, N_PICTURES),
    }
    times, cpu = _best({"limit": (limit, N_PICTURES)} | calls, 10)
    console.print(
        f"{SHAPE[0]} x {SHAPE[1]}, {k} x {k} cells a pixel, {camera.sensor.layout.n_sites:,} log-polar sites, "
        f"{thread_count()} threads"
    )
    for name, title, bound in (
        ("still", f"frame of a video, all noise, oversample={k}", 1.0 / 0.6),
        ("ahead", "the same, frames ahead on each thread", 1.0 / 0.6),
        ("pictures", "the same from sRGB pictures", 1.0 / 0.6),
        ("rolling", "frame through a rolling shutter", None),
        ("events", "frame to event pixels", None),
        ("gaze", "frame of a gaze over a still scene", None),
    ):
        report.slower_than(title, times[name], against, times["limit"], bound)
    for name, title in (("still", "frame of a video"), ("pictures", "the same from sRGB pictures")):
        report.slower_than(f"{title}, oversample={k}: processor time", cpu[name], against, cpu["limit"], 1.0 / 0.6)
    _print_stage_times(camera, pictures)


def _best(calls: dict[str, tuple[Callable[[], None], int]], repeats: int) -> tuple[dict[str, float], dict[str, float]]:
    """Return the minimum wall and processor time per frame, with interleaved calls."""
    wall, cpu = dict.fromkeys(calls, float("inf")), dict.fromkeys(calls, float("inf"))
    for _ in range(repeats):
        for name, (call, n_frames) in calls.items():
            begin, begin_cpu = time.perf_counter(), time.process_time()
            call()
            wall[name] = min(wall[name], (time.perf_counter() - begin) / n_frames)
            cpu[name] = min(cpu[name], (time.process_time() - begin_cpu) / n_frames)
    return wall, cpu


def _camera(oversample: int | Literal["auto"] = "auto") -> fs.Camera:
    half_um = 0.5 * SHAPE[0] * PITCH_UM * FOCAL_LENGTH_MM / (1e3 * DISTANCE_M - FOCAL_LENGTH_MM)
    r_max_um = 0.96 * half_um
    layout = fs.layout.log_polar(n_sectors=N_SECTORS, n_rings=N_RINGS, r_min_um=0.026 * r_max_um, r_max_um=r_max_um)
    ring = layout.columns["ring"]
    layout = layout.with_columns(readout_order=np.asarray(ring - ring.min(), np.int64))
    sensor = fs.Sensor(
        layout,
        qe=0.6,
        dark_e_per_s=20.0,
        full_well_e=1e6,
        read_noise_e=1.0,
        bits=12,
        prnu_fraction=0.01,
        pixel_fpn_fraction=0.01,
    )
    optics = fs.Optics(focal_length_mm=FOCAL_LENGTH_MM, f_number=F_NUMBER, oversample=oversample)
    return fs.Camera(optics=optics, sensor=sensor)


def _pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [rng.integers(0, 256, SHAPE, dtype=np.uint8) for _ in range(N_PICTURES)]


def _footage(pictures: object) -> fs.video.FrameSource:
    return fs.video.FrameSource(
        pictures, pitch_um=PITCH_UM, distance_m=DISTANCE_M, peak_radiance_w_m2_sr_nm=0.1, band_width_nm=100.0
    )


def _print_stage_times(camera: fs.Camera, pictures: list[np.ndarray]) -> None:
    """Print the times of the stages of a frame."""
    total: dict[str, float] = {}
    start, cpu = time.perf_counter(), time.process_time()
    for capture in camera.video(_footage(pictures * 4), exposure_s=EXPOSURE_S, seed=0):
        for stage, s in capture.stage_s.items():
            total[stage] = total.get(stage, 0.0) + s
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    total["pictures, records and the rest"] = wall - sum(total.values())
    shares = ", ".join(
        f"{stage} {100 * s / wall:.1f} %" for stage, s in sorted(total.items(), key=lambda item: -item[1])
    )
    n = 4 * len(pictures)
    console.print(
        f"a frame from pictures: {1e3 * wall / n:.1f} ms of wall, {1e3 * cpu / n:.1f} ms of processor time: {shares}"
    )


def _memory(report: Report, n_frames: int) -> None:
    """Stream in a separate process, which reports its peak memory."""
    result = subprocess.run(
        [sys.executable, __file__, "--stream", str(n_frames)], capture_output=True, text=True, check=True
    )
    found = json.loads(result.stdout)
    console.print(
        f"{n_frames:,} frames from pictures to a zarr folder: {n_frames / found['wall_s']:.1f} frames/s of wall, "
        f"{n_frames / found['cpu_s']:.1f} frames per second of processor time, {found['folder_mb']:.0f} MB written"
    )
    report.add(
        f"peak memory of {n_frames:,} frames", f"{found['peak_gb']:.2f} GB", "GB", "", found["peak_gb"], MAX_PEAK_GB
    )


def _stream(n_frames: int) -> None:
    """Write a long video, and report time and memory."""
    camera, pictures = _camera(), _pictures()

    def frames() -> Iterator[np.ndarray]:
        for k in range(n_frames):
            yield np.roll(pictures[k % N_PICTURES], k, axis=1)

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.zarr"
        start, cpu = time.perf_counter(), time.process_time()
        fs.video.write_video(
            camera.video(_footage(frames()), exposure_s=EXPOSURE_S, seed=0, ahead=thread_count()), path
        )
        wall_s, cpu_s = time.perf_counter() - start, time.process_time() - cpu
        n_bytes = sum(p.stat().st_size for p in path.rglob("*") if p.is_file())
    # Peak of this process alone: getrusage includes the memory of its parent.
    status = Path("/proc/self/status").read_text()
    peak_gb = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) * 1024 / 1e9
    print(json.dumps({"wall_s": wall_s, "cpu_s": cpu_s, "peak_gb": peak_gb, "folder_mb": n_bytes / 1e6}))


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description="Videos: frames per second, times of stages, memory.")
    parser.add_argument("--quick", action="store_true", help="100 frames")
    parser.add_argument("--stream", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.stream is not None:
        _stream(options.stream)
        return
    report = Report(is_judged=not options.quick)
    bench_video(report, 100 if options.quick else 1000)
    console.print(report.table)
    sys.exit(1 if report.missed else 0)


if __name__ == "__main__":
    main()

"""
Times of the critical paths, as ratios to a limit of the machine or to another library, measured in one run.

Each figure is the best of several runs, interleaved with those of its reference, since single times on shared machines vary.
A benchmark in which a ratio misses its bound is run again, and the better ratio counts. A ratio that misses its bound again is
marked; the program then exits with 1. Bounds hold on an idle machine: the last lines say how busy it was.

    python benchmarks/run.py                  everything, about 15 minutes
    python benchmarks/run.py --quick          the same for a sixteenth of the pixels, without bounds
    python benchmarks/run.py sensor optics    some benchmarks
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import scipy.fft
import shapely
from angular import bench_angular
from dense import EXPOSURE_S, bench_dense
from depth import bench_depth
from exploring import bench_exploring
from field_modes import bench_field_modes
from frames import bench_frames
from gradients import bench_gradients
from kernels import bench_first_capture, bench_kernels
from learning import bench_learning, bench_stored
from looking import bench_looking
from panorama import bench_panorama
from report import Report, best_s
from rich.console import Console
from small import bench_small
from video import bench_video

import foveasim as fs
from foveasim._core.threads import thread_count
from foveasim.sensor.blocks import for_each_block
from foveasim.sensor.effects import GroupedNoise, Sites
from layouts import bench_layouts

#: The largest picture of the paper.
FULL_SHAPE = (4640, 8256)
N_SECTORS, N_RINGS = 240, 126
console = Console(width=130)


def paper_scene(shape: tuple[int, int], spectrum: np.ndarray, wavelength_nm: np.ndarray) -> fs.Scene:
    """Return a noise picture with the size, pitch and distance of the paper's largest."""
    rng = np.random.default_rng(0)
    basis = rng.random((spectrum.shape[0], *shape), dtype=np.float32)
    widths_nm = np.full(wavelength_nm.size, 300.0 / wavelength_nm.size)
    return fs.Scene(basis, 0.2 * spectrum, wavelength_nm, widths_nm, 11.6, 0.56)


def paper_layout(grid: fs.Grid) -> fs.Layout:
    """Return 30,240 log-polar sites over the height of the image."""
    r_max_um = 0.495 * grid.shape[0] * grid.pitch_um
    return fs.layout.log_polar(n_sectors=N_SECTORS, n_rings=N_RINGS, r_min_um=0.026 * r_max_um, r_max_um=r_max_um)


def bench_integrator(report: Report, shape: tuple[int, int]) -> None:
    """Compare the integrator with exactextract, with one pass over the map, and with polygon clipping."""
    from exactextract import exact_extract
    from exactextract.feature import JSONFeatureSource
    from exactextract.raster import NumPyRasterSource

    grid = fs.Grid.centred(shape, 0.5)
    layout = paper_layout(grid)
    cells = np.random.default_rng(0).random(shape, dtype=np.float32)
    top_first = np.ascontiguousarray(cells[::-1])
    features = [
        {"type": "Feature", "id": str(i), "properties": {}, "geometry": json.loads(g)}
        for i, g in enumerate(shapely.to_geojson(layout.polygons()))
    ]
    integrator, second = fs.Integrator(layout, grid), fs.Integrator(layout, grid, order=2)
    peer_sums = None

    def peer(strategy: str) -> None:
        nonlocal peer_sums
        raster = NumPyRasterSource(top_first, *grid.bounds_um)
        found = exact_extract(raster, JSONFeatureSource(features), ["sum"], strategy=strategy)
        peer_sums = np.array([f["properties"]["sum"] for f in found])

    peer_s = min(best_s({s: lambda s=s: peer(s) for s in ("feature-sequential", "raster-sequential")}, 2).values())
    ours = best_s(
        {
            "frame": lambda: integrator(cells),
            "second": lambda: second(cells),
            "sum": cells.sum,
            "compile": lambda: fs.Integrator(layout, grid),
            "once": lambda: fs.Integrator(layout, grid, compiled=False)(cells),
        },
        12,
    )
    difference = np.abs(integrator(cells) / grid.cell_area_um2 / peer_sums - 1).max()
    n_y, n_x = shape
    console.print(f"map {n_y} x {n_x} float32, {layout.n_sites:,} log-polar sites, {thread_count()} threads")
    console.print(f"largest relative difference of a site from exactextract: {difference:.1e}")
    report.faster_than("frame", ours["frame"], "exactextract", peer_s, 30)
    report.faster_than("compile + frame", ours["frame"] + ours["compile"], "exactextract", peer_s, 12)
    report.slower_than("frame", ours["frame"], "map.sum(), float32", ours["sum"], 6)
    report.slower_than("frame of second order", ours["second"], "frame", ours["frame"], 2)
    report.slower_than("layout integrated once, not compiled", ours["once"], "frame", ours["frame"], 2)
    bench_compilation(report, shape[0] // 3)

    small = fs.Grid.centred((116, 206), 0.5)
    few = fs.layout.hexagonal(n_columns=16, n_rows=12, pitch_um=3.7)
    cells_small = np.random.default_rng(1).random(small.shape)

    def clipped() -> np.ndarray:
        x, y = np.meshgrid(small.x_um - 0.25, small.y_um - 0.25)
        boxes = shapely.box(x, y, x + 0.5, y + 0.5).ravel()
        return np.array(
            [(shapely.area(shapely.intersection(p, boxes)) * cells_small.ravel()).sum() for p in few.polygons()]
        )

    once = best_s({"ours": lambda: fs.Integrator(few, small)(cells_small), "clipped": clipped}, 2)
    report.faster_than("compile + frame, 192 hexagons", once["ours"], "shapely clipping, 116 x 206", once["clipped"])


def bench_compilation(report: Report, n_side: int) -> None:
    """Measure the processor time and memory of compiling hexagons of the size of a cell, per site."""
    layout = fs.layout.hexagonal(n_columns=n_side, n_rows=n_side, pitch_um=1.0746)
    grid = fs.Grid.centred((n_side, 11 * n_side // 10), 1.0)
    s = best_s({"compile": lambda: fs.Integrator(layout, grid)}, 6, time.process_time)["compile"]
    what = f"compiling {layout.n_sites:,} hexagons"
    report.add(what, f"{s:.4g} s", "processor time, µs per site", "", 1e6 * s / layout.n_sites, 0.7)
    tracemalloc.start()
    integrator = fs.Integrator(layout, grid)
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    report.add("memory of the same", "", "bytes per site", "", size / integrator.n_sites, 180)


def bench_optics(report: Report, shape: tuple[int, int]) -> None:
    """Compare optics and complete captures with two Fourier transforms."""
    n_threads = thread_count()
    optics = fs.Optics(focal_length_mm=22.0, f_number=4.0)
    mono = paper_scene(shape, np.ones((1, 1)), np.array([550.0]))
    grid = optics.grid(mono)
    layout = paper_layout(grid)
    sensor = fs.Sensor(layout, qe=0.6, dark_e_per_s=20.0, full_well_e=1e6, read_noise_e=1.0, bits=12)
    camera = fs.Camera(optics=optics, sensor=sensor)
    # Reference with the same padding.
    aberrated = replace(optics, pupil=fs.optics.Blades(6), zernike=fs.optics.Zernike(coefficients={7: 0.02}))
    # Padded size: the encircled energy within 20.3 λN is 99 %.
    pad = int(np.ceil(20.3 * 0.55 * optics.working_f_number(0.56) / grid.pitch_um))
    padded = tuple(int(scipy.fft.next_fast_len(n + 2 * pad, real=True)) for n in shape)
    picture = np.random.default_rng(0).random(padded, dtype=np.float32)

    def pair() -> None:
        spectrum = scipy.fft.rfft2(picture, workers=n_threads)
        scipy.fft.irfft2(spectrum, s=padded, workers=n_threads, overwrite_x=True)

    times = best_s(
        {
            "pair": pair,
            "optics": lambda: list(optics.weighted_maps(mono, np.ones((1, 1)))),
            "aberrated": lambda: list(aberrated.weighted_maps(mono, np.ones((1, 1)))),
            "capture": lambda: camera.capture(mono, exposure_s=EXPOSURE_S, seed=0),
            "first": lambda: fs.Camera(optics=optics, sensor=sensor).capture(mono, exposure_s=EXPOSURE_S, seed=0),
        },
        6,
    )
    report.slower_than(
        "optics, one band", times["optics"], f"rfft2 + irfft2, {padded[0]} x {padded[1]}", times["pair"], 1.3
    )
    report.slower_than("six blades and coma, one band", times["aberrated"], "rfft2 + irfft2", times["pair"], 1.3)
    report.slower_than("mono capture, all noise", times["capture"], "rfft2 + irfft2", times["pair"], 1.7)
    report.slower_than("the same, layout not yet compiled", times["first"], "rfft2 + irfft2", times["pair"])


def bench_wavelengths(report: Report, shape: tuple[int, int]) -> None:
    """Compare a colour capture with 31 wavelengths and with three."""
    rng = np.random.default_rng(3)
    optics = fs.Optics(focal_length_mm=22.0, f_number=4.0)
    few = paper_scene(shape, rng.random((3, 3)), np.array([450.0, 550.0, 620.0]))
    many = fs.Scene(few.basis, rng.random((3, 31)), np.linspace(450.0, 620.0, 31), np.full(31, 5.0), 11.6, 0.56)
    layout = fs.layout.mosaic(paper_layout(optics.grid(few)), ("RG", "GB"))
    camera = fs.Camera(optics=optics, sensor=fs.Sensor(layout, filters="rgb"))
    times = best_s(
        {
            "31": lambda: camera.capture(many, exposure_s=EXPOSURE_S, seed=0),
            "3": lambda: camera.capture(few, exposure_s=EXPOSURE_S, seed=0),
        },
        4,
    )
    report.slower_than("RGB picture at 31 wavelengths", times["31"], "the same at 3", times["3"], 1.3)


def bench_distortion(report: Report, shape: tuple[int, int]) -> None:
    """Compare captures with and without distortion, and undistorted outlines with a warped map."""
    import cv2

    scene = paper_scene(shape, np.ones((1, 1)), np.array([550.0]))
    optics = fs.Optics(focal_length_mm=22.0, f_number=4.0)
    grid = optics.grid(scene)
    layout = paper_layout(grid)
    sensor = fs.Sensor(layout, qe=0.6, dark_e_per_s=20.0, full_well_e=1e6, read_noise_e=1.0, bits=12)
    # The coefficients are those of a lens with a focal length of twice the width of the layout.
    focal_um = 1e6 * scene.distance_m * optics.magnification(scene.distance_m)
    ratio = focal_um / (4.0 * layout.bounds_um[2])
    lens = fs.distortion.BrownConrady(focal_um=focal_um, k1=-0.08 * ratio**2, k2=0.01 * ratio**4, p1=1e-3 * ratio)
    plain = fs.Camera(optics=optics, sensor=sensor)
    bent = fs.Camera(optics=optics, sensor=sensor, distortion=lens)
    cells = np.random.default_rng(0).random(grid.shape, dtype=np.float32)
    straight, carried = plain.integrator(grid), bent.integrator(grid)
    squares = fs.layout.grid(n_x=8 * shape[1] // 50, n_y=8 * shape[0] // 50, pitch_um=5.0 * grid.pitch_um)
    turned = squares.rotate(1.0)
    # Source position of each cell of the warped map, in cells.
    x, y = np.meshgrid(grid.x_um, grid.y_um)
    source = lens.undistort(np.stack((x, y), axis=-1), outside="mask")
    index = ((source - np.array([grid.x_um[0], grid.y_um[0]])) / grid.pitch_um).astype(np.float32)
    # Compared calls alternate, without other allocations in between.
    compiling = best_s(
        {
            "bent": lambda: fs.Integrator(layout, grid, distortion=lens),
            "plain": lambda: fs.Integrator(layout, grid),
            "squares bent": lambda: fs.Integrator(squares, grid, distortion=lens),
            "squares": lambda: fs.Integrator(turned, grid),
        },
        8,
    )
    times = best_s(
        {
            "bent": lambda: bent.capture(scene, exposure_s=EXPOSURE_S, seed=0),
            "plain": lambda: plain.capture(scene, exposure_s=EXPOSURE_S, seed=0),
            "frame": lambda: carried(cells),
            "remap": lambda: straight(cv2.remap(cells, index, None, cv2.INTER_LINEAR)),
        },
        6,
    )
    report.slower_than("distorted mono capture", times["bent"], "the same undistorted", times["plain"], 1.1)
    report.faster_than("distorted frame", times["frame"], "cv2.remap + undistorted frame", times["remap"], 3)
    report.slower_than("compiling a distorted layout", compiling["bent"], "undistorted", compiling["plain"], 2)
    # Worst case: squares are the simplest outlines, which are traced fastest; distorted ones are not. Upright squares are not
    # compiled.
    what = f"compiling {squares.n_sites:,} distorted squares"
    report.slower_than(what, compiling["squares bent"], "turned by 1°", compiling["squares"], 2.5)


def bench_sensor(report: Report, n_side: int) -> None:
    """
    Compare exposures with their bounds of processor time per site, and with numpy's Gaussian numbers for them.

    On one thread: where cores share their memory, two threads take up to 1.3 times the processor time.
    """
    bench_shot_and_read_noise(report, 2 * n_side)
    layout = fs.layout.hexagonal(n_columns=n_side, n_rows=n_side, pitch_um=2.0)
    layout = layout.with_columns(readout_line=np.arange(layout.n_sites) % n_side)
    sensor = fs.Sensor(
        layout,
        prnu_fraction=0.01,
        dark_e_per_s=20.0,
        dsnu_fraction=0.1,
        hot_fraction=1e-4,
        hot_e_per_s=1e4,
        dead_fraction=1e-4,
        crosstalk=fs.sensor.Diffusion(spread_um=0.3),
        full_well_e=1e5,
        ktc_noise=True,
        read_noise_e=3.0,
        rts_fraction=0.01,
        rts_e=10.0,
        gain_fpn_fraction=0.01,
        nonlinearity_fraction=0.02,
        pixel_fpn_fraction=0.02,
        line_fpn_fraction=0.02,
        bits=12,
        companding="root",
        inl_dn=[0.0, 1.0, -1.0, 0.0],
        dnl_dn=0.5,
        capacitance_f=2e-15,
    )
    rate_e_per_s = np.full(layout.n_sites, 5000.0)

    def exposure() -> object:
        return sensor.expose(rate_e_per_s, 1.0, seed=1, n_threads=1)

    # Shot, reset and read noise.
    numbers = gaussian_numbers(layout.n_sites, 3)
    times = best_s({"exposure": exposure, "numbers": numbers}, 8, time.process_time)
    add_per_site(report, f"sensor, every noise, {layout.n_sites:,} sites", times["exposure"], layout.n_sites, 30)
    report.slower_than("the same", times["exposure"], "numpy's Gaussian numbers for it", times["numbers"], 1.25)
    tracemalloc.start()
    exposure()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    report.add("memory of the same", "", "float64 arrays (n_site,)", "", peak / (8 * layout.n_sites), 4)
    bench_model(report, n_side)


@dataclass(frozen=True)
class RowNoise(GroupedNoise):
    """Noise of each readout line."""

    name: ClassVar[str] = "row_noise"
    stage: ClassVar[str] = "charge"

    def deviation(self, sites: Sites) -> float:  # noqa: ARG002 -- the same for all sites
        """Return the standard deviation, e-."""
        return 2.0


def bench_model(report: Report, n_side: int) -> None:
    """Compare the first-order model of a sensor with the prediction of its codes."""
    layout = fs.layout.grid(n_x=n_side, n_y=n_side, pitch_um=2.0)
    layout = layout.with_columns(readout_line=np.arange(layout.n_sites) // n_side)
    sensor = fs.Sensor(
        layout, prnu_fraction=0.01, dark_e_per_s=20.0, dsnu_fraction=0.1, hot_fraction=1e-4, hot_e_per_s=1e4, full_well_e=1e5,
        ktc_noise=True, read_noise_e=3.0, rts_fraction=0.01, rts_e=10.0, gain_fpn_fraction=0.01, pixel_fpn_fraction=0.02,
        line_fpn_fraction=0.02, bits=12, pedestal_v=0.2, capacitance_f=2e-15,
    )  # fmt: skip
    charge_e = sensor.expected_electrons(np.linspace(200.0, 5000.0, layout.n_sites), 1.0)
    dark_e = np.full(layout.n_sites, 20.0)
    rows = replace(sensor, effects=[RowNoise()])
    patterns = np.stack((charge_e, charge_e[::-1]))
    times = best_s(
        {
            "predict": lambda: sensor.predict(charge_e),
            "model": lambda: sensor.linearise(charge_e).variance_e2(),
            "snr": lambda: fs.sensor.signal_to_noise(sensor, charge_e, dark_e),
            "information": lambda: rows.linearise(charge_e).information(patterns),
        },
        6,
        time.process_time,
    )
    predict_s, sites = times["predict"], f"{layout.n_sites:,} sites"
    add_per_site(report, f"prediction of codes, {sites}", predict_s, layout.n_sites, 160)
    report.slower_than("first-order model with variance", times["model"], "prediction of codes", predict_s, 0.3)
    report.slower_than("signal-to-noise ratio", times["snr"], "prediction of codes", predict_s, 1.5)
    report.slower_than(
        "information of a shift with row noise", times["information"], "prediction of codes", predict_s, 2.0
    )
    tracemalloc.start()
    sensor.linearise(charge_e).variance_e2()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    report.add("memory of the model with variance", "", "float64 arrays (n_site,)", "", peak / (8 * layout.n_sites), 10)


def bench_shot_and_read_noise(report: Report, n_side: int) -> None:
    """Compare shot and read noise at high and low charges, and the sensor part of a capture, with their bounds."""
    layout = fs.layout.grid(n_x=n_side, n_y=n_side, pitch_um=2.0)
    sensor = fs.Sensor(layout, read_noise_e=3.0, bits=12)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=sensor, n_threads=1)
    light = fs.PowerMap.from_array(np.ones((8, 8)), pitch_um=0.25 * n_side, wavelength_nm=550.0)
    many, few = np.full(layout.n_sites, 5000.0), np.full(layout.n_sites, 10.0)
    times = best_s(
        {
            "many": lambda: sensor.expose(many, 1.0, seed=1, n_threads=1),
            "few": lambda: sensor.expose(few, 1.0, seed=1, n_threads=1),
            "capture": lambda: camera.capture(light, exposure_s=1.0, seed=1, photo_e_per_s=many),
            "numbers": gaussian_numbers(layout.n_sites, 2),
        },
        6,
        time.process_time,
    )
    add_per_site(report, f"sensor, shot and read noise, {layout.n_sites:,} sites", times["many"], layout.n_sites, 20)
    report.slower_than("the same", times["many"], "numpy's Gaussian numbers for it", times["numbers"], 0.75)
    add_per_site(report, "the same at 10 e-, exact Poisson draws", times["few"], layout.n_sites, 25)
    add_per_site(report, "capture of known rates", times["capture"], layout.n_sites, 20)


def add_per_site(report: Report, what: str, s: float, n_sites: int, at_most_ns: float) -> None:
    """Add the processor time per site, with its bound."""
    report.seconds(what, s, at_most_ns, "processor time, ns per site", unit_s=1e-9 * n_sites)


def gaussian_numbers(n_sites: int, n_effects: int) -> Callable[[], object]:
    """Return a function that draws numpy's Gaussian numbers of several effects."""

    def draw(block: int, sites: slice) -> None:
        rng = np.random.default_rng(block)
        for _ in range(n_effects):
            rng.standard_normal(sites.stop - sites.start)

    return lambda: for_each_block(n_sites, draw, 1)


MEMORY_PROBE = """
import sys, numpy as np
sys.path.insert(0, sys.argv[1])
import run, foveasim as fs
shape = tuple(int(n) for n in sys.argv[2:4])
def status(key):
    return next(int(l.split()[1]) * 1024 for l in open("/proc/self/status") if l.startswith(key))
optics = fs.Optics(focal_length_mm=22.0, f_number=4.0)
def camera_for(scene):
    layout = run.paper_layout(optics.grid(scene))
    return fs.Camera(optics=optics, sensor=fs.Sensor(layout, qe=0.6, dark_e_per_s=20.0, read_noise_e=1.0))
small = run.paper_scene((464, 825), np.ones((1, 1)), np.array([550.0]))
camera_for(small).capture(small, exposure_s=run.EXPOSURE_S, seed=0)
scene = run.paper_scene(shape, np.ones((1, 1)), np.array([550.0]))
camera = camera_for(scene)
before = status("VmRSS")
open("/proc/self/clear_refs", "w").write("5")
camera.capture(scene, exposure_s=run.EXPOSURE_S, seed=0)
print((status("VmHWM") - before) / (4 * shape[0] * shape[1]))
"""


def bench_memory(report: Report, shape: tuple[int, int]) -> None:
    """Measure the peak memory of a capture, in a separate process (Linux)."""
    if not Path("/proc/self/clear_refs").exists():
        return
    arguments = [sys.executable, "-c", MEMORY_PROBE, str(Path(__file__).parent), *map(str, shape)]
    maps = float(subprocess.run(arguments, capture_output=True, text=True, check=True).stdout)
    report.add("peak memory of a mono capture", "", "float32 maps above the input", "", maps, 4)


def bench_import(report: Report) -> None:
    """Measure the import time from bytecode, in addition to the start of Python."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}

    def start(code: str) -> Callable[[], object]:
        return lambda: subprocess.run(
            [sys.executable, "-c", code], check=True, env=environment, stdout=subprocess.DEVNULL
        )

    bare = start("pass")
    for label, bound_s, code in (
        ("import foveasim", 0.3, "import foveasim"),
        ("the same, and use of Camera, Scene and Sensor", 0.5, "import foveasim as fs; fs.Camera, fs.Scene, fs.Sensor"),
        ("foveasim --version", 0.25, "import sys; sys.argv[1:] = ['--version']; from foveasim.cli import main; main()"),
    ):
        start(code)()  # writes the bytecode
        times = best_s({"bare": bare, "ours": start(code)}, 5)
        report.seconds(label, times["ours"] - times["bare"], bound_s, "seconds after the start of Python")


def benchmarks(*, is_quick: bool) -> list[tuple[Callable[..., object], tuple[object, ...]]]:
    """Return all benchmarks with their sizes."""
    shape = (FULL_SHAPE[0] // 4, FULL_SHAPE[1] // 4) if is_quick else FULL_SHAPE
    side, n_side = (512, 100) if is_quick else (2048, 1000)
    return [
        *((bench, (shape,)) for bench in (bench_integrator, bench_gradients, bench_optics, bench_distortion)),
        *((bench, (shape,)) for bench in (bench_wavelengths, bench_memory)),
        (bench_dense, (side,)),
        (bench_angular, (shape, side)),
        (bench_field_modes, (side,)),
        (bench_depth, (side,)),
        (bench_panorama, (side // 2,)),
        (bench_kernels, (side,)),
        (bench_sensor, (n_side,)),
        (bench_small, ()),
        (bench_layouts, (10_000 if is_quick else 1_000_000,)),
        (bench_video, (n_side,)),
        (bench_learning, (n_side,)),
        (bench_stored, (n_side,)),
        (bench_frames, ((750, 1000) if is_quick else (3000, 4000),)),
        (bench_exploring, (10 if is_quick else 40,)),
        (bench_looking, (20_000 if is_quick else 1_000_000,)),
        (bench_import, ()),
        (bench_first_capture, ()),
    ]


def main() -> int:
    """Run the benchmarks; exit with 1 when a bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="benchmarks, such as optics and first_capture; all by default")
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    of_name = {
        bench.__name__.removeprefix("bench_"): (bench, sizes) for bench, sizes in benchmarks(is_quick=given.quick)
    }
    unknown = sorted(set(given.names) - set(of_name))
    if unknown:
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(of_name)}")
    report = Report(is_judged=not given.quick)
    for name in given.names or of_name:
        bench, sizes = of_name[name]
        with console.status(f"bench {name.replace('_', ' ')}"):
            report.measure(bench, *sizes)
    console.print(report.table)
    console.print(report.summary(), highlight=False)
    return 1 if report.missed else 0


if __name__ == "__main__":
    sys.exit(main())

"""Kernels against the same algorithms in C, and the first capture on a new machine."""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from report import Report, best_s

SOURCE = Path(__file__).with_name("kernels.c")
#: Without contraction to fused multiplications, whose rounding differs; without error numbers, which prevent vectorisation.
FLAGS = (
    *("-O3", "-march=native", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"),
    *("-shared", "-fPIC"),
)
#: Bound of all ratios to C.
AT_MOST = 1.3
REPEATS = 20
#: Width of the photosites, in cells.
SIDE = 3.99
#: Processor time from the start of Python to the end of a capture, and of the capture alone.
FIRST_CAPTURE = """
import json, time
import foveasim
from foveasim.config import demo_settings, read_shot
start_s = time.process_time()
shot = read_shot(demo_settings()[0])
shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)
print(json.dumps([time.process_time(), time.process_time() - start_s]))
"""


def bench_kernels(report: Report, n_cells: int) -> None:
    """Measure kernels for maps of ``n_cells`` x ``n_cells`` against C where there is a compiler, in one thread."""
    compiler = shutil.which("cc")
    if compiler is None:
        return
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "kernels.so"
        subprocess.run([compiler, *FLAGS, "-o", str(path), str(SOURCE), "-lm"], check=True)
        theirs = ctypes.CDLL(str(path))
    bench_rectangles(report, theirs, n_cells)
    bench_outlines(report, theirs, n_cells)
    bench_conversion(report, theirs, n_cells**2 // 4)
    bench_shot_noise(report, theirs, n_cells**2 // 4)


def in_c(function: Callable[..., object], *args: object) -> Callable[[], object]:
    """Return a call of a C function with arrays, 64-bit integers and float64."""
    kinds = {float: ctypes.c_double, int: ctypes.c_int64}
    converted = [
        ctypes.c_void_p(value.ctypes.data) if isinstance(value, np.ndarray) else kinds[type(value)](value)
        for value in args
    ]
    return lambda: function(*converted)


def compare(
    report: Report,
    what: str,
    ours: Callable[[], object],
    theirs: Callable[[], object],
    found: Sequence[np.ndarray],
    expected: Sequence[np.ndarray],
) -> None:
    """Measure two calls and require bit-identical results."""
    times = best_s({"ours": ours, "C": theirs}, REPEATS)
    assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True)), what
    report.slower_than(what, times["ours"], "C", times["C"], AT_MOST)


def bench_rectangles(report: Report, theirs: ctypes.CDLL, n_cells: int) -> None:
    """Measure the integrals over rectangles."""
    from foveasim.integrate import _rectangle_kernels as ours

    cells = np.random.default_rng(0).random((n_cells, n_cells), dtype=np.float32)
    n = int((n_cells - 1) / SIDE)
    edges = 0.3 + SIDE * np.arange(n + 1)
    u = np.stack((edges[:-1], edges[1:]), axis=1)
    bounds = np.empty((n, n, 4))
    bounds[..., 0], bounds[..., 2] = u[:, 0], u[:, 1]
    bounds[..., 1], bounds[..., 3] = u[:, :1], u[:, 1:]
    bounds = bounds.reshape(-1, 4)
    expected, found = np.zeros((2, n * n))
    everywhere = np.empty(0, np.bool_)
    for order in (1, 2):
        compare(
            report,
            f"integrals of {n} x {n} rectangles, order {order}, one thread",
            lambda order=order: ours.gather_rectangles(cells, bounds, 0, n * n, everywhere, 1.0, order, found),
            in_c(theirs.gather_rectangles, cells, n_cells, n_cells, bounds, n * n, 1.0, order, expected),
            [found],
            [expected],
        )
    compare(
        report,
        f"the same as a lattice of {n} x {n}, one thread",
        lambda: ours.gather_lattice(cells, u, u, 0, n, everywhere, 1.0, 1, found),
        in_c(theirs.gather_lattice, cells, n_cells, n_cells, u, n, u, n, 1.0, expected),
        [found],
        [expected],
    )


def bench_outlines(report: Report, theirs: ctypes.CDLL, n_cells: int) -> None:
    """Measure the tracing of outlines, and the integrals over traced ones."""
    import foveasim as fs
    from foveasim._core.rings import to_frame
    from foveasim.integrate import _kernels as ours
    from foveasim.integrate._outlines import outlines_of
    from foveasim.integrate._plan import compile_plan

    cells = np.random.default_rng(0).random((n_cells, n_cells), dtype=np.float32)
    grid = fs.Grid.centred((n_cells, n_cells), 1.0)
    log_polar = fs.layout.log_polar(
        n_sectors=15 * n_cells // 128, n_rings=n_cells // 16, r_min_um=0.013 * n_cells, r_max_um=0.495 * n_cells
    )
    hexagons = fs.layout.hexagonal(n_columns=n_cells // 14, n_rows=n_cells // 14, pitch_um=13.4)
    for layout, name, order in ((log_polar, "log-polar sites", 1), (hexagons, "hexagons", 2)):
        rings = to_frame(layout.xy_um, grid.origin_um, grid.pitch_xy_um), layout.ring_offsets, layout.site_offsets
        traced = ours.trace_sites(*rings, 0, n_cells, n_cells, order)
        # A further row has to fit, or the kernel returns for longer lists.
        lists = [
            np.empty((len(part) + (12 * n_cells + 12) * (len(part) > 0), *part.shape[1:]), part.dtype)
            for part in traced[:4]
        ]
        expected = [np.empty_like(part) for part in traced]
        boxes, covered, counts = ours.accumulators(n_cells, n_cells, order), np.zeros(layout.n_sites), np.zeros(3, int)

        def trace(rings=rings, boxes=boxes, covered=covered, lists=lists) -> None:
            covered[:] = 0.0
            progress = np.array([0, -1, 0, 0, 0])
            ours.trace_rows(*rings, 0, n_cells, n_cells, *boxes, covered, *lists, progress)

        compare(
            report,
            f"tracing {layout.n_sites:,} {name}, order {order}, one thread",
            trace,
            in_c(theirs.trace_sites, *rings, layout.n_sites, 0, n_cells, n_cells, order, *expected, counts),
            [*(part[: len(full)] for part, full in zip(lists, expected[:4], strict=True)), covered],
            expected,
        )
        plan, _ = compile_plan(partial(outlines_of, layout), layout.n_sites, grid, 1, order)
        arrays = plan.row_spans, plan.row_weights, plan.spans, plan.weights, plan.row_cuts, plan.cuts, plan.moments
        found, sums = np.zeros((2, int(plan.first_slot[-1])))
        compare(
            report,
            f"integrals of the same {name}, order {order}, one thread",
            lambda arrays=arrays, found=found: ours.gather(cells, 0, n_cells, *arrays, np.empty(0, np.bool_), found),
            in_c(theirs.gather, cells, n_cells, n_cells, 0, n_cells, *arrays, sums),
            [found],
            [sums],
        )


def bench_conversion(report: Report, theirs: ctypes.CDLL, n_sites: int) -> None:
    """Measure the conversion of voltages to codes."""
    from foveasim.sensor import _kernels as ours
    from foveasim.sensor.adc import ADC

    voltage_v = np.random.default_rng(0).normal(1.5, 0.8, n_sites)
    line = (np.arange(n_sites) % 1000).astype(np.int32)
    found, expected = np.zeros((2, n_sites), np.uint16)
    for name, adc in (
        ("linear", ADC(bits=12)),
        ("square root, INL, DNL", ADC(bits=12, companding="root", inl_dn=[0.0, 1.0, -1.0, 0.0], dnl_dn=0.5)),
        ("linear, DNL", ADC(bits=12, dnl_dn=0.5)),
    ):
        t = adc.tables(3.0, np.uint64(1))
        compare(
            report,
            f"{n_sites:,} conversions, {name}, one thread",
            lambda t=t: ours.convert(voltage_v, line, t, found),
            in_c(
                theirs.convert,
                *(voltage_v, line, n_sites, t.v_sat_v, t.companding_index, t.log_strength, float(t.n_codes)),
                *(t.inl, float(t.inl.size), t.dnl_dn, int(t.dnl_key), t.quantiles, float(t.quantiles.size), expected),
            ),
            [found],
            [expected],
        )


def bench_shot_noise(report: Report, theirs: ctypes.CDLL, n_sites: int) -> None:
    """Measure Poisson draws; both take the exponential function from the same C library."""
    from foveasim.sensor import _kernels as ours
    from foveasim.sensor.effects.shot import poisson_tables

    tables = poisson_tables(100)
    cumulative, guide = tables.cumulative_fraction, tables.guide
    for low, high in ((0.0, 2.0), (20.0, 80.0), (1e3, 1e4)):
        mean_e = np.random.default_rng(0).uniform(low, high, n_sites)
        found, expected = np.zeros((2, n_sites))
        draw = in_c(
            theirs.draw_poisson, expected, n_sites, 100.0, cumulative, cumulative.shape[1], guide, guide.shape[1], 7
        )

        def draw_here(mean_e=mean_e, found=found) -> None:
            found[:] = mean_e
            ours.draw_poisson(found, 100.0, tables, np.uint64(7))

        def draw_there(mean_e=mean_e, expected=expected, draw=draw) -> None:
            expected[:] = mean_e
            draw()

        what = f"{n_sites:,} Poisson draws, means {low:g} to {high:g}, one thread"
        compare(report, what, draw_here, draw_there, [found], [expected])


def bench_first_capture(report: Report) -> None:
    """Measure the first capture of the demo in a new process, with and without compiled kernels."""
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"NUMBA_CACHE_DIR": cache}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # the modules are compiled, too

        def first() -> list[float]:
            done = subprocess.run(
                [sys.executable, "-c", FIRST_CAPTURE], env=environment, stdout=subprocess.PIPE, check=True
            )
            return list(json.loads(done.stdout))

        cold_s, _ = first()
        warm_s = min(first()[1] for _ in range(5))
    report.seconds("first capture of the demo, new machine", cold_s, 9.0, "seconds of processor time")
    report.seconds("first capture of a process, compiled", warm_s, 0.8, "seconds of processor time after imports")

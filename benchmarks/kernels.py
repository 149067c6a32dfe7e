"""Kernels of dense sensors against the same algorithm in C, and the first capture on a new machine."""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from report import Report, best_s

SOURCE = Path(__file__).with_name("kernels.c")
#: Without contraction to fused multiplications, whose rounding differs.
FLAGS = ("-O3", "-march=native", "-ffp-contract=off", "-shared", "-fPIC")
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
    """Measure the kernels for rectangles on ``n_cells`` x ``n_cells``, one thread, against C where there is a compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return
    from foveasim.integrate import _rectangle_kernels as ours

    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "kernels.so"
        subprocess.run([compiler, *FLAGS, "-o", str(path), str(SOURCE), "-lm"], check=True)
        theirs = ctypes.CDLL(str(path))
    size, number = ctypes.c_int64, ctypes.c_double
    cells = np.random.default_rng(0).random((n_cells, n_cells), dtype=np.float32)
    n = int((n_cells - 1) / SIDE)
    edges = 0.3 + SIDE * np.arange(n + 1)
    u = np.stack((edges[:-1], edges[1:]), axis=1)
    bounds = np.empty((n, n, 4))
    bounds[..., 0], bounds[..., 2] = u[:, 0], u[:, 1]
    bounds[..., 1], bounds[..., 3] = u[:, :1], u[:, 1:]
    bounds = bounds.reshape(-1, 4)
    out, found = np.zeros((2, n * n))
    everywhere = np.empty(0, np.bool_)

    def pointer(array: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    shape = (size(n_cells), size(n_cells))
    for order in (1, 2):
        times = best_s(
            {
                "ours": lambda order=order: ours.gather_rectangles(
                    cells, bounds, 0, n * n, everywhere, 1.0, order, found
                ),
                "C": lambda order=order: theirs.gather_rectangles(
                    pointer(cells), *shape, pointer(bounds), size(n * n), number(1.0), size(order), pointer(out)
                ),
            },
            20,
        )
        assert np.array_equal(out, found)
        what = f"integrals of {n} x {n} rectangles, order {order}, one thread"
        report.slower_than(what, times["ours"], "C", times["C"], 1.3)
    times = best_s(
        {
            "ours": lambda: ours.gather_lattice(cells, u, u, 0, n, everywhere, 1.0, 1, found),
            "C": lambda: theirs.gather_lattice(
                pointer(cells), *shape, pointer(u), size(n), pointer(u), size(n), number(1.0), pointer(out)
            ),
        },
        20,
    )
    assert np.array_equal(out, found)
    report.slower_than(f"the same as a lattice of {n} x {n}, one thread", times["ours"], "C", times["C"], 1.3)


def bench_first_capture(report: Report) -> None:
    """Measure the first capture of the demo in a new process, with and without compiled kernels."""
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"NUMBA_CACHE_DIR": cache}

        def first() -> list[float]:
            done = subprocess.run(
                [sys.executable, "-c", FIRST_CAPTURE], env=environment, stdout=subprocess.PIPE, check=True
            )
            return list(json.loads(done.stdout))

        cold_s, _ = first()
        warm_s = min(first()[1] for _ in range(5))
    report.add("first capture of the demo, new machine", "", "seconds of processor time", "", cold_s, 12)
    report.add("first capture of a process, compiled", "", "seconds of processor time after imports", "", warm_s, 0.8)

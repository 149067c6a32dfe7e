"""
Sums over the frames of a camera, from which a sensor is fitted, compared with reading their files twice.

    python benchmarks/frames.py             64 frames of 12 million pixels, from 16 files
    python benchmarks/frames.py --quick     of 750,000 pixels
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from report import Report, best_s
from rich.console import Console

from foveasim import twin
from foveasim.twin.frames.statistics import StackStatistics, sum_frames

#: Files, how often each is read, and repetitions, of which the best counts.
N_FILES, N_TIMES, REPEATS = 16, 4, 5
SHAPE = (3000, 4000)
console = Console(width=130)


def bench_frames(report: Report, shape: tuple[int, int]) -> None:
    """Measure the statistics of a stack of files of 12 bits, which are in the cache of the operating system."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as directory:
        paths = [Path(directory, f"{k}.npy") for k in range(N_FILES)]
        for path in paths:
            np.save(path, rng.normal(800.0, 20.0, shape).astype(np.uint16))
        files = paths * N_TIMES
        stack = twin.Stack(files, exposure_s=0.01)

        def read_twice() -> None:
            for path in files + files:
                np.load(path)

        sum_frames("stack", twin.Stack(paths[:2], exposure_s=0.01))  # compiles the kernel
        times = best_s(
            {"statistics": lambda: StackStatistics.of(sum_frames("stack", stack)), "reading": read_twice}, REPEATS
        )
    what = f"means and variances of {len(files)} frames of {shape[0]} x {shape[1]} pixels"
    report.slower_than(what, times["statistics"], "np.load of the files, twice", times["reading"], 3.0)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    report = Report(is_judged=not (is_quick := parser.parse_args().quick))
    report.measure(bench_frames, (750, 1000) if is_quick else SHAPE)
    console.print(report.table)
    console.print(report.summary(), highlight=False)


if __name__ == "__main__":
    main()

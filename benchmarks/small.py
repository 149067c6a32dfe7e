"""
Captures of few photosites: the time that Python takes, besides kernels and transforms.

    python benchmarks/small.py
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

from machine import add_numbers
from report import Report, best_s
from rich.console import Console

import foveasim as fs

#: Seconds of ten million additions of the machine for which bounds are stated, and of Python per capture.
ADDITIONS_S, PYTHON_S = 0.8, 1.5e-3
N_CAPTURES, N_BEST = 20, 7
EXPOSURE_S = 0.01


def bench_small(report: Report) -> None:
    """Time repeated captures of a scene that is almost without arithmetic, and the cost of pixel optics."""
    tiny = fs.Scene.flat(shape=(8, 8), pitch_um=3000.0, distance_m=1.0, illuminance_lux=500.0)
    scene = fs.Scene.flat(shape=(60, 60), pitch_um=3000.0, distance_m=1.0, illuminance_lux=500.0)
    few, many = fs.layout.grid(4, 4, 3.0), fs.layout.log_polar(n_sectors=160, min_size_um=2.0, r_max_um=690.0)
    stack = fs.sensor.ApertureStack(height_um=4.0, refractive_index=1.5)

    def captures(layout: fs.Layout, scene: fs.Scene, **parameters: object) -> Callable[[], object]:
        sensor = fs.Sensor(layout, read_noise_e=2.0, capacitance_f=1e-13, **parameters)  # type: ignore[arg-type]
        optics = fs.Optics(focal_length_mm=8.0, f_number=2.8)
        camera = fs.Camera(optics=optics, sensor=sensor, n_threads=1)

        def run() -> object:
            return [camera.capture(scene, exposure_s=EXPOSURE_S, seed=k) for k in range(N_CAPTURES)]

        return run

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        times = best_s(
            {
                "python": captures(few, tiny),
                "additions": add_numbers,  # at the same time: the speed of a shared machine varies within a run
                "plain": captures(many, scene),
                "stack": captures(many, scene, pixel_optics=stack),
            },
            N_BEST,
        )
    python_s = times["python"] / N_CAPTURES
    scaled = python_s * ADDITIONS_S / times["additions"] / PYTHON_S
    report.add("Python of a repeated capture", f"{python_s:.3g} s", "1.5 ms, scaled", "", scaled, 1.4)
    report.slower_than(
        f"{many.n_sites:,} sites with an aperture stack", times["stack"], "the same without", times["plain"], 1.25
    )


def main() -> None:
    """Run the benchmark."""
    report = Report(is_judged=False)
    bench_small(report)
    Console(width=130).print(report.table)


if __name__ == "__main__":
    main()

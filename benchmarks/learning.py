"""
Samples for learning: cameras simulated on demand, compared with a loader that reads and resizes the same pictures, and stored
samples in random order.

    python benchmarks/learning.py             1,000 samples of 50 photographs, with 0 and 2 workers where torch is installed
    python benchmarks/learning.py --quick     100 samples
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import skimage.data
from PIL import Image
from report import Report, best_s
from rich.console import Console

from foveasim import explore

N_PICTURES, SIDE_PIXELS = 50, 256
SHOT = {
    "scene": {
        "kind": "picture",
        "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 0.004,
        "wavelength_nm": [620, 550, 450],
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {
        "generator": "log_polar",
        "parameters": {"n_sectors": 96, "min_size_um": 2.0, "r_max_um": 400.0, "stagger": True},
        "mosaic": ["RG", "GB"],
    },
    "sensor": {"qe": 0.6, "filters": "rgb", "capacitance_f": {"per_um2": 1e-16}, "v_sat_v": 1.0, "bits": 10},
    "exposure_s": 0.02,
}
console = Console(width=130)


class PlainPictures:
    """A loader of pictures: read, convert to RGB, resize, return the class."""

    def __init__(self, paths: Sequence[Path], n: int) -> None:
        self.paths, self.n = paths, n

    def __len__(self) -> int:
        return self.n

    def __getitem__(self, index: int) -> dict[str, Any]:
        if index >= self.n:
            raise IndexError(index)
        with Image.open(self.paths[index * len(self.paths) // self.n]) as image:
            small = image.convert("RGB").resize((96, 96), Image.Resampling.BILINEAR)
        return {"code": np.array(small), "label": index % 3}


def bench_learning(report: Report, n_samples: int) -> None:
    """Compute all samples with 0 and 2 workers, check that they are equal, and compare with plain pictures."""
    with tempfile.TemporaryDirectory() as folder:
        paths = _photographs(Path(folder))
        data = explore.classification(
            [str(path) for path in paths], SHOT, cameras=n_samples // N_PICTURES, seed=1, fit="cover"
        )
        data[0]  # compiles the kernels
        has_torch = importlib.util.find_spec("torch") is not None
        digests_of: dict[str, set[str]] = {}
        for n_workers in (0, 2) if has_torch else (0,):
            took, cpu_s = {}, 0.0
            for name, samples in (("cameras", data), ("pictures", PlainPictures(paths, len(data)))):
                begin, begin_cpu = time.perf_counter(), time.process_time()
                digests_of.setdefault(name, set()).add(
                    _digest(_loaded(samples, n_workers) if has_torch else iter(samples))
                )
                took[name] = (time.perf_counter() - begin) / len(data)
                cpu_s = (time.process_time() - begin_cpu) / len(data) if name == "cameras" else cpu_s
            console.print(
                f"{len(data):,} samples, {n_workers} workers: {1 / took['cameras']:.0f} a second through cameras drawn at "
                f"random, {1 / took['pictures']:.0f} plain pictures a second"
            )
            report.slower_than(
                f"a sample through a random camera, {n_workers} workers",
                took["cameras"],
                "a plain picture",
                took["pictures"],
            )
            if n_workers == 0:
                what = "samples through random cameras"
                report.seconds(what, cpu_s, 0.02, "seconds of processor time per sample")
        assert all(len(digests) == 1 for digests in digests_of.values()), "samples differ with the number of workers"


def bench_stored(report: Report, n_samples: int) -> None:
    """Write a dataset as zarr store, and compare reading in random order with reading in order."""
    with tempfile.TemporaryDirectory() as folder:
        paths = _photographs(Path(folder))
        data = explore.denoising(
            [str(path) for path in paths],
            SHOT,
            draws=n_samples // N_PICTURES,
            fields=("code", "electrons"),
            raster={"max_pixels": 64},
            fit="cover",
        )
        stored = explore.write_dataset(data, Path(folder) / "data.zarr")
        order = list(range(len(stored)))
        shuffled = np.random.default_rng(0).permutation(order).tolist()

        def read(indices: Sequence[int]) -> Callable[[], object]:
            # Each reading process opens the store once.
            return lambda: [samples[k] for samples in [explore.open_dataset(stored.path)] for k in indices]

        times = best_s({"shuffled": read(shuffled), "order": read(order)}, 5)
        report.slower_than(
            f"{len(stored):,} stored samples, shuffled", times["shuffled"], "in order", times["order"], 2
        )


def _photographs(folder: Path) -> list[Path]:
    """Write crops of photographs as JPEG files."""
    rng = np.random.default_rng(0)
    sources = [skimage.data.astronaut(), skimage.data.coffee(), skimage.data.chelsea()]
    paths = []
    for k in range(N_PICTURES):
        image = sources[k % len(sources)]
        top, left = (rng.integers(0, size - SIDE_PIXELS + 1) for size in image.shape[:2])
        paths.append(folder / f"{k:03d}.jpg")
        Image.fromarray(image[top : top + SIDE_PIXELS, left : left + SIDE_PIXELS]).save(paths[-1], quality=92)
    return paths


def _loaded(samples: Any, n_workers: int) -> Iterator[Any]:
    import torch

    return iter(torch.utils.data.DataLoader(samples, batch_size=20, num_workers=n_workers))


def _digest(batches: Iterator[Any]) -> str:
    """Return the digest of all codes, in order."""
    digest = hashlib.sha256()
    for batch in batches:
        digest.update(np.ascontiguousarray(batch["code"]).tobytes())
    return digest.hexdigest()


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description="Datasets: samples per second, compared with plain pictures.")
    parser.add_argument("--quick", action="store_true", help="100 samples")
    options = parser.parse_args()
    report = Report(is_judged=False)
    n_samples = 100 if options.quick else 1000
    bench_learning(report, n_samples)
    bench_stored(report, n_samples)
    console.print(report.table)


if __name__ == "__main__":
    main()

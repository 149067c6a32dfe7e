"""
Cameras as layers of PyTorch, against their Fourier transforms and sparse products alone; fraction of a training step.

    python benchmarks/sensor_layers.py             everything (make bench-torch)
    python benchmarks/sensor_layers.py --quick     small batches, without bounds

Runs on a GPU where PyTorch has one. One row is the rate at which the layer moves data, relative to a copy in memory.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import torch
from report import Report, best_s
from rich.console import Console
from torch import Tensor, nn

import foveasim as fs

#: Batch, pixels along a side, and photosites along a side of the sensor with three filters.
N_PICTURES, N_PIXELS, N_SIDE = 64, 256, 64
#: Bounds: pictures per second on 2 cores, times of the layer over transforms and products, and its fraction of a training step.
PICTURES_PER_S, OVER_LIMIT, FRACTION = 400.0, 1.5, 0.3
console = Console(width=130)


def sensor_layer(n_pixels: int) -> fs.learn.SensorLayer:
    """Return a layer with three colour channels and three filters."""
    layout = fs.layout.hexagonal(n_columns=N_SIDE, n_rows=N_SIDE, pitch_um=4.0)
    layout = layout.with_columns(channel=np.arange(layout.n_sites) % 3)
    sensor = fs.Sensor(layout, filters="rgb", bits=10, read_noise_e=2.0, capacitance_f=5e-15)
    lens = fs.Optics(focal_length_mm=8.0, f_number=2.8, oversample=1)
    return fs.learn.SensorLayer(fs.Camera(optics=lens, sensor=sensor), scene_shape=(3, n_pixels, n_pixels))


def bench_layer(report: Report, n_pictures: int, n_pixels: int, device: torch.device) -> None:
    """Compare a batch with the transforms of its padded pictures and the products with the overlaps."""
    layer = sensor_layer(n_pixels).to(device)
    pictures = torch.rand(n_pictures, 3, n_pixels, n_pixels, device=device)
    imaging = layer.model.imaging
    width, _ = imaging.padded_columns
    parts = imaging.split(pictures).slices
    padded = torch.rand(n_pictures, 3, width, width, device=device)
    spectra = torch.fft.rfft2(padded)
    cells = torch.rand(n_pixels * width, 3 * n_pictures, device=device)
    overlaps = layer.model.overlaps(pictures)

    def transforms() -> None:
        for part in parts:
            torch.fft.rfft2(padded[part])
            torch.fft.irfft2(spectra[part], s=(width, width))

    def products() -> None:
        for k, matrix in enumerate(overlaps):
            torch.sparse.mm(matrix, cells[:, k::3].contiguous())

    def synchronised(call: object) -> object:
        def run() -> None:
            call()  # type: ignore[operator]
            if device.type == "cuda":
                torch.cuda.synchronize()

        return run

    calls = {"layer": lambda: layer(pictures), "transforms": transforms, "products": products}
    with torch.no_grad():
        times = best_s({name: synchronised(call) for name, call in calls.items()}, 7)  # type: ignore[misc]
    name = f"layer, {n_pictures} pictures of {n_pixels}² x 3, {layer.n_sites:,} sites, noise"
    limit_s = times["transforms"] + times["products"]
    report.slower_than(name, times["layer"], "transforms and sparse products", limit_s, OVER_LIMIT)
    per_s = n_pictures / times["layer"]
    report.add("the same", f"{per_s:.4g} / s", "pictures per second (inverse)", "", PICTURES_PER_S / per_s, 1.0)
    # Pictures are read; padded pictures, spectra, products and maps are written and read.
    n_bytes = padded.element_size() * (pictures.numel() + 2 * 4 * padded.numel())
    layer_gb_s = 1e-9 * n_bytes / times["layer"]
    copied = torch.empty_like(padded)
    copy_s = best_s({"copy": synchronised(lambda: copied.copy_(padded))}, 7)["copy"]  # type: ignore[dict-item]
    copy_gb_s = 1e-9 * 2 * padded.numel() * padded.element_size() / copy_s
    report.add(
        "pictures, spectra and maps", f"{layer_gb_s:.3g} GB/s", "copy in memory", f"{copy_gb_s:.3g} GB/s",
        layer_gb_s / copy_gb_s, None, is_lower_bound=True,
    )  # fmt: skip


def bench_training(report: Report, n_pictures: int, n_pixels: int, device: torch.device) -> None:
    """Measure the fraction of the sensor in a training step of a network on its photosites."""
    layer = sensor_layer(n_pixels).to(device)
    layout = layer.camera().layout
    first = fs.learn.SitePool(layout)
    second = fs.learn.SitePool(first.layout)
    network = nn.Sequential(
        fs.learn.SiteConv(1, 32, layout), nn.ReLU(), first, fs.learn.SiteConv(32, 64, first.layout), nn.ReLU(), second,
        fs.learn.SiteConv(64, 64, second.layout), nn.ReLU(), nn.Flatten(), nn.Linear(64 * second.layout.n_sites, 10),
    ).to(device)  # fmt: skip
    optimiser = torch.optim.Adam(network.parameters())
    pictures = torch.rand(n_pictures, 3, n_pixels, n_pixels, device=device)
    labels = torch.randint(0, 10, (n_pictures,), device=device)

    def sense() -> Tensor:
        with torch.no_grad():
            found: Tensor = layer(pictures)[:, None] / layer.max_code
        return found

    def step() -> None:
        optimiser.zero_grad()
        nn.functional.cross_entropy(network(sense()), labels).backward()
        optimiser.step()
        if device.type == "cuda":
            torch.cuda.synchronize()

    times = best_s({"sensor": sense, "step": step}, 3)
    report.slower_than(
        f"sensor in a training step, {n_pictures} pictures", times["sensor"], "training step", times["step"], FRACTION
    )


def main() -> int:
    """Run the benchmarks; exit with 1 when a bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    is_quick = parser.parse_args().quick
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    report = Report(is_judged=not is_quick)
    sizes = (8, 128) if is_quick else (N_PICTURES, N_PIXELS)
    bench_layer(report, *sizes, device)
    bench_training(report, *sizes, device)
    console.print(report.table)
    return 1 if report.missed else 0


if __name__ == "__main__":
    sys.exit(main())

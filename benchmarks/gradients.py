"""
Gradients with respect to vertices, in frames of the integrator; training steps, against soft masks in PyTorch.

    python benchmarks/gradients.py             everything; training steps need PyTorch (make bench-torch)
    python benchmarks/gradients.py --quick     a map of a sixteenth of the cells, without bounds
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from report import Report, best_s
from rich.console import Console

import foveasim as fs
from foveasim.integrate import SharedEdges, vertex_gradient

#: The largest picture of the paper, and its log-polar sites.
FULL_SHAPE, N_SECTORS, N_RINGS = (4640, 8256), 240, 126
#: Bounds: gradients of first and second order in frames of first order; a training step in ms.
FRAMES_ORDER_1, FRAMES_ORDER_2, STEP_MS = 1.5, 2.5, 15.0
#: A training step: pictures per batch, photosites and cells along a side of the picture.
N_BATCH, N_SIDE, N_CELLS = 128, 10, 64
#: Width of the sigmoid at the boundary of a soft mask, in cells.
SOFTNESS = 0.5
console = Console(width=130)


def bench_gradients(report: Report, shape: tuple[int, int]) -> None:
    """Compare gradients with respect to all vertices with frames, and their memory with the map."""
    grid = fs.Grid.centred(shape, 0.5)
    r_max_um = 0.495 * shape[0] * 0.5
    layout = fs.layout.log_polar(n_sectors=N_SECTORS, n_rings=N_RINGS, r_min_um=0.026 * r_max_um, r_max_um=r_max_um)
    rng = np.random.default_rng(0)
    cells, weights = rng.random(shape, dtype=np.float32), rng.random(layout.n_sites)
    integrator, edges = fs.Integrator(layout, grid), SharedEdges.from_layout(layout)
    once = fs.Integrator(layout, grid, compiled=False)

    def gradient(order: int) -> Callable[[], object]:
        return lambda: vertex_gradient(layout, grid, cells, weights, order=order, edges=edges)  # type: ignore[arg-type]

    times = best_s(
        {"frame": lambda: integrator(cells), "once": lambda: once(cells), "first": gradient(1), "second": gradient(2)},
        9,
    )
    name = f"gradient by the vertices of {layout.n_sites:,} sites"
    report.slower_than(f"{name}, order 1", times["first"], "frame", times["frame"], FRAMES_ORDER_1)
    report.slower_than(f"{name}, order 2", times["second"], "frame", times["frame"], FRAMES_ORDER_2)
    report.slower_than(
        "integrals without compilation, and gradient", times["once"] + times["first"], "frame", times["frame"]
    )
    tracemalloc.start()
    gradient(1)()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    report.add("peak memory of the gradient", "", "map", "", peak / cells.nbytes, 0.2)


def training_pictures() -> Any:
    """Return a batch of pictures, (n_batch, n_cells, n_cells)."""
    import torch

    return torch.rand(N_BATCH, N_CELLS, N_CELLS, generator=torch.Generator().manual_seed(0))


def exact_step() -> Callable[[], object]:
    """Return a step of gradient descent on vertices and a small network."""
    import torch

    mesh = fs.learn.Mesh(fs.layout.grid(N_SIDE, N_SIDE, N_CELLS / N_SIDE).rotate(0.5), "sliding")
    grid, pictures = fs.Grid.centred((N_CELLS, N_CELLS), 1.0), training_pictures()
    network, target = _network()
    optimiser = torch.optim.Adam([*mesh.parameters(), *network.parameters()], lr=1e-3)

    def step() -> None:
        optimiser.zero_grad()
        power = fs.learn.site_power(mesh(), pictures, mesh, grid)
        mean = power / mesh.area_um2().to(power.dtype)
        torch.nn.functional.cross_entropy(network(mean), target).backward()
        optimiser.step()
        mesh.limit_step()

    return step


def soft_step() -> Callable[[], object]:
    """Return the same step with masks that are smooth at their boundaries: products of sigmoids over all cells."""
    import torch

    mesh = fs.learn.Mesh(fs.layout.grid(N_SIDE, N_SIDE, N_CELLS / N_SIDE).rotate(0.5), "sliding")
    at = torch.arange(N_CELLS) + 0.5 - 0.5 * N_CELLS
    centres = torch.stack(torch.meshgrid(at, at, indexing="xy"), dim=-1).reshape(-1, 2)
    pictures = training_pictures().reshape(N_BATCH, -1)
    network, target = _network()
    optimiser = torch.optim.Adam([*mesh.parameters(), *network.parameters()], lr=1e-3)

    def step() -> None:
        optimiser.zero_grad()
        begin, end = mesh.outlines.vertices(mesh().float())
        along = end - begin
        normal = torch.stack((-along[:, 1], along[:, 0]), dim=1) / along.norm(dim=1, keepdim=True)
        inside = torch.sigmoid((normal @ centres.T - (normal * begin).sum(dim=1, keepdim=True)) / SOFTNESS)
        masks = inside.reshape(mesh.n_sites, 4, -1).prod(dim=1)
        mean = pictures @ masks.T / masks.sum(dim=1)
        torch.nn.functional.cross_entropy(network(mean), target).backward()
        optimiser.step()

    return step


def _network() -> tuple[Any, Any]:
    import torch

    torch.manual_seed(0)
    layers = torch.nn.Linear(N_SIDE**2, 128), torch.nn.ReLU(), torch.nn.Linear(128, 10)
    return torch.nn.Sequential(*layers), torch.randint(0, 10, (N_BATCH,))


PROBE = """
import sys
sys.path.insert(0, sys.argv[1])
import gradients, report, torch
def status(key):
    return next(int(l.split()[1]) * 1024 for l in open("/proc/self/status") if l.startswith(key))
torch.nn.functional.cross_entropy(torch.nn.Linear(4, 4)(torch.ones(4, 4)), torch.zeros(4, dtype=torch.int64)).backward()
step = getattr(gradients, sys.argv[2])()
before = status("VmRSS")
open("/proc/self/clear_refs", "w").write("5")
step()
print(status("VmHWM") - before, report.best_s({"step": step}, 40)["step"])
"""


def bench_training(report: Report) -> None:
    """Compare a training step with one that has soft masks, in time and memory (Linux)."""
    if not Path("/proc/self/clear_refs").exists():
        return

    def measure(step: str) -> tuple[float, float]:
        # In processes of their own: idle threads of PyTorch occupy the cores for a while.
        arguments = [sys.executable, "-c", PROBE, str(Path(__file__).parent), step]
        size, seconds = subprocess.run(arguments, capture_output=True, text=True, check=True).stdout.split()
        return float(size), float(seconds)

    (exact_bytes, exact_s), (soft_bytes, soft_s) = measure("exact_step"), measure("soft_step")
    name = f"training step, {N_SIDE**2} sites, {N_BATCH} pictures of {N_CELLS} x {N_CELLS}"
    report.add(name, f"{exact_s:.4g} s", "ms", "", 1e3 * exact_s, STEP_MS)
    report.faster_than("the same", exact_s, "soft masks over all cells", soft_s)
    sizes = (f"{size / 1e6:.3g} MB" for size in (exact_bytes, soft_bytes))
    report.add("peak memory of its first step", next(sizes), "soft masks", next(sizes), exact_bytes / soft_bytes, None)


def main() -> int:
    """Run the benchmarks; exit with 1 when a bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    is_quick = parser.parse_args().quick
    report = Report(is_judged=not is_quick)
    bench_gradients(report, (FULL_SHAPE[0] // 4, FULL_SHAPE[1] // 4) if is_quick else FULL_SHAPE)
    if find_spec("torch"):
        bench_training(report)
    else:
        console.print("training steps need PyTorch: make bench-torch")
    console.print(report.table)
    return 1 if report.missed else 0


if __name__ == "__main__":
    sys.exit(main())

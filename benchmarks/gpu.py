"""
Layers of PyTorch on a GPU: tests on the device with derivatives, and rates relative to a copy in memory; at most six minutes.

    python benchmarks/gpu.py                  on the GPU (make test-gpu); without one, only says so
    python benchmarks/gpu.py --device cpu     the same on the CPU

Figures are not judged; they are written to out/gpu.json with the name of the device. Exits with 1 if a test fails.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import time
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path

from machine import processor_model
from report import Report
from rich.console import Console

ROOT = Path(__file__).parents[1]
#: Time limit of the tests, s; the figures take a minute at most.
TESTS_S = 270
console = Console(width=130)


def has_gpu() -> bool:
    """Return whether PyTorch is installed, and finds a CUDA device."""
    if not find_spec("torch"):
        return False
    import torch

    return bool(torch.cuda.is_available())


def name_of(device: str) -> str:
    """Return the name of the GPU or processor, with versions."""
    import torch

    if device == "cpu":
        return f"{processor_model()}, PyTorch {torch.__version__}"
    memory_gb = 1e-9 * torch.cuda.get_device_properties(0).total_memory
    return (
        f"{torch.cuda.get_device_name(0)}, {memory_gb:.0f} GB, PyTorch {torch.__version__}, CUDA {torch.version.cuda}"
    )


def run_tests(device: str) -> str:
    """Run the tests with the parameter of a device, and return the last line of pytest."""
    command = (sys.executable, "-m", "pytest", "--quiet", "-p", "no:cacheprovider", "-k", f"[{device}", "tests/learn")
    try:
        ran = subprocess.run(command, cwd=ROOT, timeout=TESTS_S, capture_output=True, text=True, check=False)
    except subprocess.TimeoutExpired:
        sys.exit(f"the tests did not end within {TESTS_S} s")
    if ran.returncode:
        sys.exit(f"{ran.stdout}{ran.stderr}")
    return ran.stdout.splitlines()[-1]


def measure(device: str) -> Report:
    """Measure the layer, and its part of a training step."""
    import sensor_layers
    import torch

    report = Report(is_judged=False)
    sizes = (sensor_layers.N_PICTURES, sensor_layers.N_PIXELS)
    sensor_layers.bench_layer(report, *sizes, torch.device(device))
    sensor_layers.bench_training(report, *sizes, torch.device(device))
    return report


def main() -> None:
    """Run tests and benchmarks on a device."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "gpu.json")
    options = parser.parse_args()
    if options.device == "cuda" and not has_gpu():
        console.print("PyTorch finds no CUDA device here; nothing was run.")
        return
    start_s = time.perf_counter()
    name = name_of(options.device)
    tests = run_tests(options.device)
    console.print(f"{name}: {tests}")
    report = measure(options.device)
    console.print(report.table)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    seconds = time.perf_counter() - start_s
    found = {
        "date": time.strftime("%Y-%m-%d"), "device": name, "python": platform.python_version(), "tests": tests,
        "rows": [asdict(row) for row in report.rows], "seconds": round(seconds, 1),
    }  # fmt: skip
    options.out.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", "utf-8")
    console.print(f"{options.out}, after {seconds:.0f} s")


if __name__ == "__main__":
    main()

"""
Latency of the studio: from a message of the page until the last changed view has arrived, without a browser.

    python benchmarks/studio.py             the demo with 14,208 photosites, and a layout of 200,000
    python benchmarks/studio.py --quick     5 changes instead of 50, without bounds
"""

from __future__ import annotations

import argparse
import asyncio
import json
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import websockets
from report import Report
from rich.console import Console

from foveasim.studio._messages import decode_part

#: Bounds of the median in ms, with the browser.
SENSOR_MS, F_NUMBER_MS, LAYOUT_MS, LARGE_MS = 80.0, 150.0, 200.0, 600.0
N_CHANGES, N_QUICK = 50, 5
#: Changes by name: setting, its k-th value, and bound in ms.
CHANGES: dict[str, tuple[str, Callable[[int], Any], float]] = {
    "exposure": ("exposure_s", lambda k: 0.03 + 1e-4 * k, SENSOR_MS),
    "read noise": ("sensor.read_noise_e", lambda k: 1.0 + 0.01 * k, SENSOR_MS),
    "f-number": ("optics.f_number", lambda k: 2.8 + 0.01 * k, F_NUMBER_MS),
    "gaze": ("gaze_um", lambda k: [-140.0 + k, 320.0], LAYOUT_MS),
    "sectors": ("layout.parameters.n_sectors", lambda k: 192 - 2 * (k % 40), LAYOUT_MS),
}
#: A layout of 200,000 photosites.
LARGE = {"generator": "grid", "parameters": {"n_x": 500, "n_y": 400, "pitch_um": 2.0}, "mosaic": ["RG", "GB"]}
console = Console(width=130)


def start_server(*options: str) -> tuple[subprocess.Popen[str], str]:
    """Start the studio with options of its command, and return its process and address."""
    command = [sys.executable, "-m", "foveasim", "studio", "--no-browser", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, process.stdout.readline().partition("studio at ")[2].split()[0]


async def changes_ms(connection: Any, key: str, value: Callable[[int], Any], n: int) -> tuple[float, float]:
    """Return the median time of changes until the values of the photosites, and until all views."""
    first_ms, all_ms = [], []
    for k in range(n + 2):
        start_s = time.perf_counter()
        await connection.send(json.dumps({"id": k, "do": "set", "key": key, "value": value(k), "final": True}))
        is_done = False
        values_ms = float("nan")
        while not is_done:
            message = await connection.recv()
            elapsed_ms = 1e3 * (time.perf_counter() - start_s)
            if isinstance(message, bytes):
                if decode_part(message)[0]["part"] == "columns":
                    values_ms = elapsed_ms
                continue
            found = json.loads(message)
            if found["kind"] == "state" and found["errors"]:
                raise RuntimeError(found["errors"])
            is_done = found["kind"] == "done"
        if k > 1:  # the first ones compile kernels
            first_ms.append(values_ms)
            all_ms.append(elapsed_ms)
    return float(np.median(first_ms)), float(np.median(all_ms))


async def bench(report: Report, address: str, n: int) -> None:
    """Add the latency of changes to the report."""
    host, _, token = address.removeprefix("http://").partition("/#")
    async with websockets.connect(f"ws://{host}/socket", max_size=None) as connection:
        await connection.send(json.dumps({"token": token, "session": None}))

        async def done() -> None:
            while True:
                message = await connection.recv()
                if isinstance(message, str) and json.loads(message)["kind"] == "done":
                    return

        async def measure(label: str, key: str, value: Callable[[int], Any], bound_ms: float) -> None:
            first_ms, all_ms = await changes_ms(connection, key, value, n)
            report.add(
                label,
                f"{all_ms:.0f} ms",
                f"bound; values {first_ms:.0f} ms",
                f"{bound_ms:g} ms",
                all_ms / bound_ms,
                1.0,
            )

        await done()
        for name, (key, value, bound_ms) in CHANGES.items():
            await measure(f"14,208 photosites: {name}", key, value, bound_ms)
        for key, value in (("scene.fit", "cover"), ("layout", LARGE)):
            await connection.send(json.dumps({"do": "set", "key": key, "value": value, "final": True}))
            await done()
        key, change, _ = CHANGES["exposure"]
        await measure("200,000 photosites: exposure", key, change, LARGE_MS)
        key, change, _ = CHANGES["f-number"]
        await measure("200,000 photosites: f-number", key, change, LARGE_MS)


def main() -> int:
    """Print the table; exit with 1 when a bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    is_quick = parser.parse_args().quick
    report = Report(is_judged=not is_quick)
    process, address = start_server()
    with process:
        try:
            asyncio.run(bench(report, address, N_QUICK if is_quick else N_CHANGES))
        finally:
            process.terminate()
    console.print(report.table)
    return min(report.missed, 1)


if __name__ == "__main__":
    sys.exit(main())

"""
Latency of the studio: from a message of the page until the last changed view has arrived, without a browser.

    python benchmarks/studio.py             the demo, and layouts of 200,000 and 1,000,000 photosites
    python benchmarks/studio.py --quick     5 changes instead of 50, without bounds
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import websockets
from report import Report
from rich.console import Console

from foveasim.studio import TOKEN_VARIABLE
from foveasim.studio._messages.encoding import decode_part

N_CHANGES, N_QUICK = 50, 5
#: Sensors by number of photosites: settings that differ from the demo.
SENSORS: dict[str, dict[str, Any]] = {
    "14,208": {
        "layout": {
            "generator": "log_polar",
            "parameters": {
                "n_sectors": 192,
                "min_size_um": 2.0,
                "r_max_um": 690.0,
                "stagger": True,
                "chords_per_arc": 2,
            },
            "mosaic": ["RG", "GB"],
            "rules": {"min_size_um": 2.0, "min_width_um": 1.9, "angle_limit_deg": 25.0, "max_overlap_um2": 0.0},
        },
    },
    "200,000": {
        "layout": {
            "generator": "log_polar",
            "parameters": {"n_sectors": 680, "min_size_um": 0.4, "r_max_um": 690.0, "stagger": True},
            "mosaic": ["RG", "GB"],
        },
    },
    "1,000,000": {
        "layout": {
            "generator": "grid",
            "parameters": {"n_x": 1000, "n_y": 1000, "pitch_um": 1.0},
            "mosaic": ["RG", "GB"],
        },
    },
}
#: Settings by name: key, and its k-th value.
SETTINGS: dict[str, tuple[str, Callable[[int], Any]]] = {
    "exposure": ("exposure_s", lambda k: 0.03 + 1e-4 * k),
    "read noise": ("sensor.read_noise_e", lambda k: 1.0 + 0.01 * k),
    "f-number": ("optics.f_number", lambda k: 2.8 + 0.01 * k),
    "gaze": ("gaze_um", lambda k: [-140.0 + k, 320.0]),
    "sectors": ("layout.parameters.n_sectors", lambda k: 192 - 2 * (k % 40)),
    "many sectors": ("layout.parameters.n_sectors", lambda k: 678 - 2 * (k % 4)),
}
#: Changes by number of photosites: name of the setting, bound of the median in ms for all views, and that for the map.
CHANGES: dict[str, list[tuple[str, float, float | None]]] = {
    "14,208": [
        ("exposure", 45.0, None),
        ("read noise", 45.0, None),
        ("f-number", 90.0, None),
        ("gaze", 90.0, None),
        ("sectors", 150.0, None),
    ],
    "200,000": [("exposure", 150.0, None), ("gaze", 250.0, None), ("many sectors", 1500.0, 500.0)],
    "1,000,000": [("exposure", 1000.0, None)],
}
#: Bound of the time until a layout of a number of photosites is shown, ms.
SHOWN_MS = {"1,000,000": 8000.0}
console = Console(width=130)


def start_server(*options: str, token: str | None = None) -> tuple[subprocess.Popen[str], str]:
    """Start the studio with options of its command, and return its process and address."""
    command = [sys.executable, "-m", "foveasim", "studio", "--no-browser", *options]
    environment = os.environ if token is None else {**os.environ, TOKEN_VARIABLE: token}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
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

        await done()
        for sensor, sections in SENSORS.items():
            for key, section in sections.items():
                await connection.send(json.dumps({"do": "set", "key": key, "value": section, "final": True}))
                await done()
            for name, bound_ms, _ in CHANGES[sensor]:
                first_ms, all_ms = await changes_ms(connection, *SETTINGS[name], n)
                report.add(
                    f"{sensor} photosites: {name}",
                    f"{all_ms:.0f} ms",
                    f"bound; values {first_ms:.0f} ms",
                    f"{bound_ms:g} ms",
                    all_ms / bound_ms,
                    1.0,
                )


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

"""Reading through libraries that a broken file can crash, in a program of its own with limits of memory and time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from foveasim.errors import FileError
from foveasim.maps._common import Found, Refusal, max_unpacked

__all__ = ["read_apart"]

#: Memory of the program and its libraries, and how often the numbers are copied on their way.
BASE_BYTES, COPIES = 2**31, 3
MAX_CPU_S, BYTES_PER_S = 10, 2**22
#: On a busy computer the same takes longer.
PATIENCE = 5


def read_apart(path: Path, kind: str, name: str | None) -> Found:
    """
    What a file holds.

    Parameters
    ----------
    path : Path
    kind : {"EXR", "netCDF", "zarr", "MAT", "MAT 7.3"}
    name : str, optional
        Of the array, where there are several.

    Raises
    ------
    Refusal
        When it is broken, hostile, too large, or no map.
    """
    n_bytes = path.stat().st_size if path.is_file() else _folder_bytes(path)
    max_cpu_s = MAX_CPU_S + n_bytes // BYTES_PER_S
    with tempfile.TemporaryDirectory(prefix="foveasim-") as folder:
        out, told = Path(folder) / "map.npy", Path(folder) / "told.txt"
        task = {
            "path": str(path.resolve()),
            "kind": kind,
            "name": name,
            "out": str(out),
            "told": str(told),
            "sys_path": sys.path,
            "max_cpu_s": max_cpu_s,
            "max_bytes": BASE_BYTES + COPIES * max_unpacked(n_bytes),
        }
        try:
            done = subprocess.run(  # noqa: S603 -- our own program
                [sys.executable, "-P", str(Path(__file__).with_name("_isolated.py"))],
                input=json.dumps(task).encode(),
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                timeout=PATIENCE * max_cpu_s,
                check=False,
                # Each thread of a library reserves memory of its own.
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"},
            )
        except subprocess.TimeoutExpired:
            raise Refusal(f"is broken or hostile: reading it took more than {max_cpu_s} s") from None
        if done.returncode == -getattr(signal, "SIGXCPU", 0):
            raise Refusal(f"is broken or hostile: reading it took more than {max_cpu_s} s")
        if done.returncode != 0 or not done.stdout:
            raise Refusal(f"is broken or hostile: reading it as {kind} crashed")
        answer = json.loads(done.stdout)
        if kind == "EXR" and told.stat().st_size:  # OpenEXR gives pixels that it could not read, and prints so
            raise Refusal("is broken or cut short")
        if "refused" in answer:
            raise Refusal(answer["refused"])
        if "broken" in answer:
            raise FileError(path, f"is broken, or no power map ({answer['broken']:.200})")
        found = {key: tuple(v) if key in ("pitch_um", "origin_um") and v else v for key, v in answer["found"].items()}
        return Found(**{**found, "data": np.load(out, allow_pickle=False)})


def _folder_bytes(path: Path) -> int:
    return sum((Path(folder) / file).lstat().st_size for folder, _, files in os.walk(path) for file in files)

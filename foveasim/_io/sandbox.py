"""Reading through libraries that a malformed file can crash: in a sandbox process, with limits of memory and time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.errors import FileError

__all__ = ["PATIENCE", "read_in_sandbox", "run_in_sandbox"]

#: Memory of the process and its libraries, and how often the numbers are copied on their way.
BASE_BYTES, COPIES = 2**31, 3
MAX_CPU_S, BYTES_PER_S = 10, 2**22
#: Wall time over processor time: on a busy computer the same takes longer.
PATIENCE = 5
CHILD = Path(__file__).with_name("_sandboxed.py")

#: What a reader returns: plain data, and arrays.
Answer = tuple[dict[str, Any], list[NDArray[Any]]]


def read_in_sandbox(
    reader: Callable[..., Answer],
    path: Path,
    *,
    kind: str,
    max_unpacked: Callable[[int], int],
    is_silent: bool = False,
    **args: Any,
) -> Answer:
    """
    Run a reader of the package in the sandbox process, with limits by the size of the file.

    Parameters
    ----------
    reader : function
        Of a module, by its name: of the path as a string and ``args``, to what the file tells, as JSON has it, and arrays.
    path : Path
        A file, or a directory.
    kind : str
        Of the file, for messages.
    max_unpacked : function
        Bytes of the numbers that a file of so many bytes may hold.
    is_silent : bool
        Whether the reader prints nothing for a valid file.
    **args
        Plain data.

    Raises
    ------
    FileError
        When the reader rejects the file, fails, crashes, prints though it is silent, or takes too much memory or time.
    """
    n_bytes = path.stat().st_size if path.is_file() else _directory_bytes(path)
    return run_in_sandbox(
        reader,
        path,
        args,
        kind=kind,
        max_cpu_s=MAX_CPU_S + n_bytes // BYTES_PER_S,
        max_bytes=BASE_BYTES + COPIES * max_unpacked(n_bytes),
        is_silent=is_silent,
    )


def run_in_sandbox(
    reader: Callable[..., Answer],
    path: Path,
    args: Mapping[str, Any],
    *,
    kind: str,
    max_cpu_s: int,
    max_bytes: int,
    is_silent: bool = False,
    is_standalone: bool = False,
) -> Answer:
    """
    Run a reader in the sandbox process, with given limits.

    Parameters
    ----------
    reader, path, kind, is_silent
        As for :func:`read_in_sandbox`.
    args : mapping
        Keywords of the reader, plain data.
    max_cpu_s : int, s
        Processor time; ``PATIENCE`` times as much wall time.
    max_bytes : int
        Address space.
    is_standalone : bool
        Whether the reader's module imports nothing of the package. It is loaded by itself, which is faster and needs less
        memory, and the reader gets a keyword ``limit``, the function that sets limits.

    Raises
    ------
    FileError
        As for :func:`read_in_sandbox`.
    """
    with tempfile.TemporaryDirectory(prefix="foveasim-") as folder:
        arrays, printed = Path(folder) / "arrays.npy", Path(folder) / "printed.txt"
        task = {
            "module": reader.__module__,
            "file": sys.modules[reader.__module__].__file__ if is_standalone else None,
            "reader": reader.__name__,
            "path": str(path.resolve()),
            "args": dict(args),
            "arrays": str(arrays),
            "printed": str(printed),
            "sys_path": sys.path,
            "max_cpu_s": max_cpu_s,
            "max_bytes": max_bytes,
        }
        try:
            done = subprocess.run(  # noqa: S603 -- our own program
                [sys.executable, "-P", str(CHILD)],
                input=json.dumps(task).encode(),
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                timeout=PATIENCE * max_cpu_s,
                check=False,
                # Each thread of a library reserves memory of its own.
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"},
            )
            is_late = done.returncode == -getattr(signal, "SIGXCPU", 0)
        except subprocess.TimeoutExpired:
            is_late = True
        if is_late:
            raise FileError(path, f"is malformed: reading it took more than {max_cpu_s} s")
        if done.returncode != 0 or not done.stdout:
            raise FileError(path, f"is malformed: reading it as {kind} crashed")
        answer = json.loads(done.stdout)
        if is_silent and printed.stat().st_size:
            raise FileError(path, "is corrupt or truncated")
        if "rejected" in answer:
            raise FileError(path, answer["rejected"])
        with arrays.open("rb") as file:
            return answer["told"], [np.load(file, allow_pickle=False) for _ in range(answer["n_arrays"])]


def _directory_bytes(path: Path) -> int:
    return sum((Path(folder) / file).lstat().st_size for folder, _, files in os.walk(path) for file in files)

"""Reading through libraries that a broken file can crash, in a program of its own with limits of memory and time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.errors import FileError, FoveasimError

__all__ = ["read_apart"]

#: Memory of the program and its libraries, and how often the numbers are copied on their way.
BASE_BYTES, COPIES = 2**31, 3
MAX_CPU_S, BYTES_PER_S = 10, 2**22
#: On a busy computer the same takes longer.
PATIENCE = 5
#: The program: it finds the package where this one found it.
PROGRAM = (
    "import json, sys; task = json.load(sys.stdin); sys.path[:] = task['sys_path']; "
    "from foveasim._io.sandbox import _do; _do(task)"
)


def read_apart(
    reader: Callable[..., tuple[dict[str, Any], NDArray[Any]]],
    path: Path,
    *args: str | None,
    kind: str,
    max_unpacked: Callable[[int], int],
    is_silent: bool = False,
) -> tuple[dict[str, Any], NDArray[Any]]:
    """
    What a reader makes of a file, read by another program: a broken or hostile file can only end that one.

    Parameters
    ----------
    reader : function
        A module's, by its name: of the path and ``args``, to what the file tells, as JSON has it, and numbers.
    path : Path
        A file, or a folder.
    kind : str
        Of the file, for messages.
    max_unpacked : function
        Bytes of the numbers that a file of so many bytes may hold.
    is_silent : bool
        Whether the reader has nothing to print of a whole file.

    Raises
    ------
    FileError
        When the reader refuses the file, trips over it, crashes, prints though it is silent, or takes too much memory or
        time.
    """
    n_bytes = path.stat().st_size if path.is_file() else _folder_bytes(path)
    max_cpu_s = MAX_CPU_S + n_bytes // BYTES_PER_S
    with tempfile.TemporaryDirectory(prefix="foveasim-") as folder:
        numbers, printed = Path(folder) / "numbers.npy", Path(folder) / "printed.txt"
        task = {
            "module": reader.__module__,
            "reader": reader.__name__,
            "path": str(path.resolve()),
            "args": args,
            "numbers": str(numbers),
            "printed": str(printed),
            "sys_path": sys.path,
            "max_cpu_s": max_cpu_s,
            "max_bytes": BASE_BYTES + COPIES * max_unpacked(n_bytes),
        }
        try:
            done = subprocess.run(  # noqa: S603 -- our own program
                [sys.executable, "-P", "-c", PROGRAM],
                input=json.dumps(task).encode(),
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                timeout=PATIENCE * max_cpu_s,
                check=False,
                # Each thread of a library reserves memory of its own.
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"},
            )
        except subprocess.TimeoutExpired:
            raise FileError(path, f"is broken or hostile: reading it took more than {max_cpu_s} s") from None
        if done.returncode == -getattr(signal, "SIGXCPU", 0):
            raise FileError(path, f"is broken or hostile: reading it took more than {max_cpu_s} s")
        if done.returncode != 0 or not done.stdout:
            raise FileError(path, f"is broken or hostile: reading it as {kind} crashed")
        answer = json.loads(done.stdout)
        if is_silent and printed.stat().st_size:
            raise FileError(path, "is broken or cut short")
        if "refused" in answer:
            raise FileError(path, answer["refused"])
        return answer["told"], np.load(numbers, allow_pickle=False)


def _folder_bytes(path: Path) -> int:
    return sum((Path(folder) / file).lstat().st_size for folder, _, files in os.walk(path) for file in files)


# -- the other program -----------------------------------------------------------------------------------------------


def _do(task: dict[str, Any]) -> None:
    """Do the task: the answer goes to standard output as JSON, and numbers to the file that the task names."""
    for kind, most in (("RLIMIT_CORE", 0), ("RLIMIT_CPU", task["max_cpu_s"]), ("RLIMIT_AS", task["max_bytes"])):
        _limit(kind, most)
    warnings.simplefilter("ignore")
    # Libraries print on standard output what they think of a file.
    with os.fdopen(os.dup(1), "w") as answer, Path(task["printed"]).open("w") as printed:
        os.dup2(printed.fileno(), 1)
        answer.write(json.dumps(_answer(task)))


def _limit(kind: str, most: int) -> None:
    """A bound of memory or time, where the system has them."""
    try:
        import resource
    except ImportError:
        return
    number = getattr(resource, kind)
    hard = resource.getrlimit(number)[1]
    resource.setrlimit(number, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _answer(task: dict[str, Any]) -> dict[str, Any]:
    try:
        reader = getattr(import_module(task["module"]), task["reader"])
        told, numbers = reader(Path(task["path"]), *task["args"])
        with Path(task["numbers"]).open("wb") as file:
            np.save(file, np.ascontiguousarray(numbers), allow_pickle=False)
    except FoveasimError as refusal:
        return {"refused": str(refusal).removeprefix(f"{task['path']}: ")}
    except MemoryError:
        return {"refused": "is broken or hostile: it asks for more memory than a file of its size needs"}
    except Exception as error:  # noqa: BLE001 -- whatever a broken file makes its reader trip over
        return {"refused": f"is broken or cut short ({error!r:.200})"}
    return {"told": told}

"""Sandbox process with resource limits, for libraries that malformed files can crash."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from foveasim.errors import FileError

__all__ = ["WALL_TIME_FACTOR", "iterate_in_sandbox", "read_in_sandbox", "run_in_sandbox"]

#: Memory of the process and its libraries, and number of copies of the data in memory.
BASE_BYTES, DATA_COPIES = 2**31, 3
MAX_CPU_S, BYTES_PER_S = 10, 2**22
#: Ratio of the wall time limit to the processor time limit, for busy machines.
WALL_TIME_FACTOR = 5
COMMAND = (sys.executable, "-P", str(Path(__file__).with_name("_sandboxed.py")))
#: Environment of the process: each thread of a library reserves memory.
ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"}

#: Result of a reader: plain data, and arrays.
ReaderResult = tuple[dict[str, Any], list[NDArray[Any]]]


def read_in_sandbox(
    reader: Callable[..., ReaderResult],
    path: Path,
    *,
    kind: str,
    max_decompressed_bytes: Callable[[int], int],
    is_silent: bool = False,
    **args: Any,
) -> ReaderResult:
    """
    Run a reader of the package in the sandbox process, with limits by file size.

    Parameters
    ----------
    reader : function
        Module-level function of the path as a string and ``args``; returns plain data that JSON can represent, and arrays.
    path : Path
        A file or a directory.
    kind : str
        Kind of the file, for messages.
    max_decompressed_bytes : function
        Function of the file size in bytes that returns the maximum size of the decompressed data in bytes.
    is_silent : bool
        Whether output of the reader on standard output means that the file is corrupt.
    **args
        Keywords of the reader, plain data.

    Raises
    ------
    FileError
        When the reader rejects the file, fails, crashes, prints although ``is_silent`` is set, or exceeds a limit.
    """
    n_bytes = path.stat().st_size if path.is_file() else _directory_bytes(path)
    return run_in_sandbox(
        reader,
        path,
        args,
        kind=kind,
        max_cpu_s=MAX_CPU_S + n_bytes // BYTES_PER_S,
        max_bytes=BASE_BYTES + DATA_COPIES * max_decompressed_bytes(n_bytes),
        is_silent=is_silent,
    )


def run_in_sandbox(
    reader: Callable[..., ReaderResult],
    path: Path,
    args: Mapping[str, Any],
    *,
    kind: str,
    max_cpu_s: int,
    max_bytes: int,
    is_silent: bool = False,
    is_standalone: bool = False,
) -> ReaderResult:
    """
    Run a reader in the sandbox process, with given limits.

    Parameters
    ----------
    reader, path, kind, is_silent
        As in :func:`read_in_sandbox`.
    args : mapping
        Keywords of the reader, plain data.
    max_cpu_s : int, s
        Processor time limit; the wall time limit is ``WALL_TIME_FACTOR`` times as long.
    max_bytes : int
        Limit of the address space.
    is_standalone : bool
        Whether the module of the reader imports no other module of the package. It is then loaded without the package, which is
        faster and needs less memory, and the reader receives the keyword ``limit``, the function that sets resource limits.

    Raises
    ------
    FileError
        As in :func:`read_in_sandbox`.
    """
    with tempfile.TemporaryDirectory(prefix="foveasim-") as directory:
        arrays, printed = Path(directory) / "arrays.npy", Path(directory) / "printed.txt"
        files = {
            "file": sys.modules[reader.__module__].__file__ if is_standalone else None,
            "arrays": str(arrays),
            "printed": str(printed),
        }
        task = _task(reader, path, args, **files, max_cpu_s=max_cpu_s, max_bytes=max_bytes)
        try:
            process = subprocess.run(  # noqa: S603 -- a script of this package
                COMMAND,
                input=task,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                timeout=WALL_TIME_FACTOR * max_cpu_s,
                check=False,
                env={**os.environ, **ENVIRONMENT},
            )
            is_timed_out = process.returncode == -getattr(signal, "SIGXCPU", 0)
        except subprocess.TimeoutExpired:
            is_timed_out = True
        if is_timed_out:
            raise FileError(path, f"is malformed: reading it took more than {max_cpu_s} s")
        if process.returncode != 0 or not process.stdout:
            raise FileError(path, f"is malformed: reading it as {kind} crashed")
        answer = json.loads(process.stdout)
        if is_silent and printed.stat().st_size:
            raise FileError(path, "is corrupt or truncated")
        if "rejected" in answer:
            raise FileError(path, answer["rejected"])
        with arrays.open("rb") as file:
            return answer["metadata"], [np.load(file, allow_pickle=False) for _ in range(answer["n_arrays"])]


def iterate_in_sandbox(
    reader: Callable[..., Iterator[NDArray[Any] | None]],
    path: Path,
    args: Mapping[str, Any],
    *,
    kind: str,
    max_bytes: int,
    max_item_s: float = WALL_TIME_FACTOR * MAX_CPU_S,
) -> Iterator[NDArray[Any]]:
    """
    Iterate over the arrays that a reader of the package yields in the sandbox process.

    The process ends with the iterator. It waits while no array is requested.

    Parameters
    ----------
    reader : function
        Module-level function of the path as a string and ``args``; yields arrays, and None for skipped ones.
    path, kind
        As in :func:`read_in_sandbox`.
    args : mapping
        Keywords of the reader, plain data.
    max_bytes : int
        Limit of the address space.
    max_item_s : float, s
        Limit of the time for each array.

    Raises
    ------
    FileError
        When the reader rejects the file, fails, crashes or exceeds a limit.
    """
    task = _task(
        reader, path, args, file=None, is_iterator=True, printed=os.devnull, max_cpu_s=None, max_bytes=max_bytes
    )
    process = subprocess.Popen(  # noqa: S603 -- a script of this package
        COMMAND,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, **ENVIRONMENT},
    )
    assert process.stdin is not None
    assert process.stdout is not None
    with process:
        try:
            with suppress(BrokenPipeError), process.stdin as task_file:  # it may have ended already
                task_file.write(task)
            while True:
                is_late = threading.Event()
                timer = threading.Timer(max_item_s, _end, (process, is_late))
                timer.start()
                try:
                    header, content = _read_item(process.stdout, max_bytes)
                finally:
                    timer.cancel()
                if is_late.is_set():
                    raise FileError(path, f"is malformed: reading it took more than {max_item_s:g} s")
                if "rejected" in header:
                    raise FileError(path, header["rejected"])
                if header.get("is_last"):
                    return
                if not header:
                    raise FileError(path, f"is malformed: reading it as {kind} crashed")
                if "shape" in header:
                    yield np.frombuffer(content, header["type"]).reshape(header["shape"])
        finally:
            process.kill()


def _task(reader: Callable[..., Any], path: Path, args: Mapping[str, Any], **options: Any) -> bytes:
    """Return the task of the sandbox process, as :mod:`foveasim._io._sandboxed` reads it."""
    about = {"module": reader.__module__, "reader": reader.__name__, "path": str(path.resolve()), "args": dict(args)}
    return json.dumps(about | {"sys_path": sys.path} | options).encode()


def _read_item(file: IO[bytes], max_bytes: int) -> tuple[dict[str, Any], bytes]:
    """Return the header and the content of an item; an empty header if the process has ended."""
    try:
        header = json.loads(file.readline())
    except ValueError:
        return {}, b""
    n_bytes = min(int(header.get("n_bytes", 0)), max_bytes)
    content = file.read(n_bytes)
    return (header, content) if len(content) == n_bytes else ({}, b"")


def _end(process: subprocess.Popen[bytes], is_late: threading.Event) -> None:
    """End a process that takes too long."""
    is_late.set()
    process.kill()


def _directory_bytes(path: Path) -> int:
    return sum((Path(folder) / file).lstat().st_size for folder, _, files in os.walk(path) for file in files)

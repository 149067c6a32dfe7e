"""
Sandbox process with resource limits, for libraries that malformed files can crash.

It protects against crashes, endless loops, and excessive memory, processor time and output of a library that reads a malformed
file, with the limits that the system has: Windows limits the time only, macOS not the memory. A reader ends with one line, and
the process and, except on Windows, its descendants end with it. It has a minimal environment, without
passwords and tokens of the parent, and a session of its own. On Linux (x86-64 and ARM, 64 bits), where the kernel permits
filters of system calls, it can also not open network sockets, start processes or programs, or send signals.

It does not protect against code in a file that takes control of the process: the process runs as the same user, and can read
and write the files of this user. Programs that read untrusted files for others should run as a user without
privileges, or in a container.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._io.zarr_stores import check_plain_files
from foveasim.errors import FileError

#: Memory of the process and its libraries, and number of copies of the data in memory.
BASE_BYTES, DATA_COPIES = 2**31, 3
MAX_CPU_S, BYTES_PER_S = 10, 2**22
#: Exit code of a process at the limit of its processor time; none on Windows.
PROCESSOR_TIME_CODES = (-signal.SIGXCPU,) if hasattr(signal, "SIGXCPU") else ()
#: Ratio of the wall time limit to the processor time limit, for busy machines.
WALL_TIME_FACTOR = 5
COMMAND = (sys.executable, "-P", str(Path(__file__).with_name("_sandboxed.py")))
#: Environment of the process: each thread of a library reserves memory.
ENVIRONMENT = {
    "PATH": os.defpath,
    "PYTHONUTF8": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "HDF5_PLUGIN_PRELOAD": "::",
}
#: Variables that Python and its libraries need to start.
INHERITED = ("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "PYTHONHOME", "SYSTEMROOT", "WINDIR")
#: Variables with the directory of temporary files; the last two on Windows.
TEMPORARY = ("TMPDIR", "TEMP", "TMP")
#: Size limits of an answer and of a header, and largest number of arrays.
MAX_ANSWER_BYTES, MAX_ARRAYS = 2**28, 4096

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

    ``reader``: module-level function of the path as a string and ``args``; returns plain data that JSON can represent, and
    arrays. ``path``: a file or a directory. ``kind``: kind of the file, for messages. ``max_decompressed_bytes``: function of
    the file size in bytes that returns the maximum size of the decompressed data in bytes. ``is_silent``: whether output of
    the reader on standard output means that the file is corrupt. ``**args``: keywords of the reader, plain data. Raises
    FileError when the reader rejects the file, fails, crashes, prints although ``is_silent`` is set, or exceeds a limit, or a
    directory contains links, FIFOs or devices.
    """
    if path.is_dir():
        check_plain_files(path)
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
    parts: Sequence[ModuleType] = (),
) -> ReaderResult:
    """
    Run a reader in the sandbox process, with given limits.

    ``reader``, ``path``, ``kind``, ``is_silent``: as in :func:`read_in_sandbox`. ``args``: keywords of the reader, plain data.
    ``max_cpu_s`` (int, s): processor time limit; the wall time limit is ``WALL_TIME_FACTOR`` times as long. ``max_bytes``:
    limit of the address space. ``is_standalone``: whether the module of the reader imports no other module of the package than
    ``parts``, which import none. It is then loaded without the package, which is faster and needs less memory, and the reader
    receives the keyword ``limit``, the function that sets resource limits. Raises FileError as in :func:`read_in_sandbox`.
    """
    with tempfile.TemporaryDirectory(prefix="foveasim-", ignore_cleanup_errors=True) as directory:
        arrays, printed = Path(directory) / "arrays.npy", Path(directory) / "printed.txt"
        files = {
            "files": [(m.__name__, m.__file__) for m in (*parts, sys.modules[reader.__module__])]
            if is_standalone
            else [],
            "arrays": str(arrays),
            "printed": str(printed),
        }
        task = _task(reader, path, args, **files, max_cpu_s=max_cpu_s, max_bytes=max_bytes)
        # A file instead of a pipe, which a descendant of the process could hold open.
        with tempfile.TemporaryFile() as answer_file:
            process = _start(task, answer_file, directory)
            try:
                process.wait(WALL_TIME_FACTOR * max_cpu_s)
                is_timed_out = process.returncode in PROCESSOR_TIME_CODES
            except subprocess.TimeoutExpired:
                is_timed_out = True
            finally:
                _end(process)
            if is_timed_out:
                raise FileError(path, f"is malformed: reading it took more than {max_cpu_s} s")
            answer_file.seek(0)
            text = answer_file.read(MAX_ANSWER_BYTES)
        if process.returncode != 0 or not text:
            raise FileError(path, f"is malformed: reading it as {kind} crashed")
        if is_silent and _is_regular(printed) and printed.stat().st_size:
            raise FileError(path, "is corrupt or truncated")
        try:
            return _result(path, json.loads(text), arrays)
        except FileError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError, OSError, EOFError, MemoryError, RecursionError):
            raise FileError(path, f"is malformed: reading it as {kind} gave an invalid answer") from None


def _result(path: Path, answer: Any, arrays: Path) -> ReaderResult:
    """Return the data and the arrays of an answer; raise what malformed ones cause."""
    if "rejected" in answer:
        raise FileError(path, _reason(answer))
    metadata, n_arrays = answer["metadata"], answer["n_arrays"]
    if not isinstance(metadata, dict) or not isinstance(n_arrays, int) or not 0 <= n_arrays <= MAX_ARRAYS:
        raise ValueError("the answer has other types")
    if not _is_regular(arrays):
        raise ValueError("the arrays are not in a regular file")
    with arrays.open("rb") as file:
        return metadata, [np.load(file, allow_pickle=False) for _ in range(n_arrays)]


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

    ``reader``: module-level function of the path as a string and ``args``; yields arrays, and None for skipped ones. ``path``,
    ``kind``: as in :func:`read_in_sandbox`. ``args``: keywords of the reader, plain data. ``max_bytes``: limit of the address
    space. ``max_item_s`` (float, s): limit of the time for each array. Raises FileError when the reader rejects the file,
    fails, crashes or exceeds a limit.
    """
    task = _task(
        reader, path, args, files=[], is_iterator=True, printed=os.devnull, max_cpu_s=None, max_bytes=max_bytes
    )
    process = _start(task, subprocess.PIPE, tempfile.gettempdir())
    assert process.stdout is not None
    with process:
        try:
            while True:
                is_late = threading.Event()
                timer = threading.Timer(max_item_s, _end_late, (process, is_late))
                timer.start()
                try:
                    header, content = _read_item(process.stdout, max_bytes)
                finally:
                    timer.cancel()
                if is_late.is_set():
                    raise FileError(path, f"is malformed: reading it took more than {max_item_s:g} s")
                if "rejected" in header:
                    raise FileError(path, _reason(header))
                if header.get("is_last"):
                    return
                if not header:
                    raise FileError(path, f"is malformed: reading it as {kind} crashed")
                if "shape" in header:
                    try:
                        item = np.frombuffer(content, np.dtype(header["type"])).reshape(header["shape"])
                    except (ValueError, TypeError, KeyError):
                        raise FileError(path, f"is malformed: reading it as {kind} gave an invalid answer") from None
                    yield item
        finally:
            _end(process)


def _task(reader: Callable[..., Any], path: Path, args: Mapping[str, Any], **options: Any) -> bytes:
    """Return the task of the sandbox process, as :mod:`foveasim._io._sandboxed` reads it."""
    about = {"module": reader.__module__, "reader": reader.__name__, "path": str(path.resolve()), "args": dict(args)}
    return json.dumps(about | {"sys_path": sys.path} | options).encode()


def _start(task: bytes, output: Any, directory: str) -> subprocess.Popen[bytes]:
    """Start the process in a session of its own; its standard input is the task."""
    inherited = {name: os.environ[name] for name in INHERITED if name in os.environ}
    with tempfile.TemporaryFile() as file:
        file.write(task)
        file.seek(0)
        return subprocess.Popen(  # noqa: S603 -- a script of this package
            COMMAND,
            stdin=file,
            stdout=output,
            stderr=subprocess.DEVNULL,
            env={**inherited, **dict.fromkeys(TEMPORARY, directory), **ENVIRONMENT},
            start_new_session=True,
        )


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the process and the descendants in its group."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.wait()


def _end_late(process: subprocess.Popen[bytes], is_late: threading.Event) -> None:
    """End a process that takes too long."""
    is_late.set()
    _end(process)


def _reason(answer: Mapping[str, Any]) -> str:
    """Return the reason of a rejection as one line."""
    return " ".join(str(answer["rejected"]).split())


def _is_regular(path: Path) -> bool:
    """Return whether a path of the process is a regular file, and not a link."""
    return path.is_file() and not path.is_symlink()


def _read_item(file: IO[bytes], max_bytes: int) -> tuple[dict[str, Any], bytes]:
    """Return header and content of an item; an empty header if it is missing or invalid."""
    try:
        header = json.loads(file.readline(MAX_ANSWER_BYTES))
        n_bytes = min(int(header.get("n_bytes", 0)), max_bytes)
    except (ValueError, TypeError, AttributeError, RecursionError):
        return {}, b""
    content = file.read(max(n_bytes, 0))
    return (header, content) if len(content) == n_bytes else ({}, b"")


def _directory_bytes(path: Path) -> int:
    return sum((Path(folder) / file).lstat().st_size for folder, _, files in os.walk(path) for file in files)

"""
Main module of the sandbox process, which reads one untrusted file.

:mod:`foveasim._io.sandbox` starts the process and sends a task as JSON to its standard input. The process imports no module of
the package before the reader, so that it starts quickly and its limits apply to the reader.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import json
import os
import sys
import warnings
from typing import Any, BinaryIO

#: Names of the exceptions that readers raise to reject a file; other exceptions mean that the file is corrupt.
REJECTIONS = {"FoveasimError", "FormatError"}


#: Linux: the architecture that a filter of system calls checks, and the numbers of the denied calls: sockets, processes,
#: programs, signals, other sessions and groups, tracing, io_uring. ``clone`` without a thread flag is denied as well,
#: and so are ``tgkill`` and ``prlimit64``, the last two numbers, for other processes.
DENIED_CALLS = {
    "x86_64": (
        0xC000003E,
        56,
        (41, 57, 58, 59, 62, 101, 109, 112, 129, 200, 297, 310, 311, 322, 424, 425),
        (234, 302),
    ),
    "aarch64": (
        0xC00000B7,
        220,
        (198, 221, 129, 117, 138, 154, 157, 130, 240, 270, 271, 281, 424, 425),
        (131, 261),
    ),
}
CLONE3, CLONE_THREAD, X32_CALLS = 435, 0x00010000, 0x40000000


def limit(kind: str, maximum: int) -> None:
    """
    Set a resource limit, such as memory ("RLIMIT_AS") or time ("RLIMIT_CPU"), if supported.

    Windows has none of them. macOS rejects limits of memory below the address space that each process reserves.
    """
    try:
        import resource

        number = getattr(resource, kind)
    except (ImportError, AttributeError):
        return
    hard = resource.getrlimit(number)[1]
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(number, (maximum if hard == resource.RLIM_INFINITY else min(maximum, hard), hard))


def deny_system_calls() -> bool:
    """
    Deny sockets, new processes and programs, and signals to other processes.

    Returns whether the kernel permits this. It needs no privileges on Linux: seccomp with a filter (man 2 seccomp), which
    readers cannot remove. Denied calls fail with EPERM.
    """
    if sys.platform != "linux" or os.uname().machine not in DENIED_CALLS or sys.maxsize < 2**32:
        return False
    import ctypes
    import struct

    architecture, clone, denied, (tgkill, prlimit) = DENIED_CALLS[os.uname().machine]
    # Instructions of BPF: code, jumps if true and if false, operand.
    load, equal, at_least, any_bit, give = 0x20, 0x15, 0x35, 0x45, 0x06
    allow, eperm, enosys = 0x7FFF0000, 0x00050001, 0x00050026
    program = [
        (load, 0, 0, 4),
        (equal, 1, 0, architecture),
        (give, 0, 0, eperm),
        (load, 0, 0, 0),
        (at_least, 0, 1, X32_CALLS),
        (give, 0, 0, eperm),
        (equal, 0, 1, CLONE3),
        (give, 0, 0, enosys),  # the C library then uses clone, whose flags a filter can read
    ]
    for number in denied:
        program += [(equal, 0, 1, number), (give, 0, 0, eperm)]
    for number, own in ((tgkill, os.getpid()), (prlimit, 0)):
        program += [(equal, 0, 4, number), (load, 0, 0, 16), (equal, 1, 0, own), (give, 0, 0, eperm), (load, 0, 0, 0)]
    program += [
        (equal, 0, 3, clone),
        (load, 0, 0, 16),
        (any_bit, 1, 0, CLONE_THREAD),
        (give, 0, 0, eperm),
        (give, 0, 0, allow),
    ]
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *instruction) for instruction in program))
    filter_ = ctypes.create_string_buffer(struct.pack("HxxxxxxP", len(program), ctypes.addressof(code)))
    try:
        prctl = ctypes.CDLL(None, use_errno=True).prctl
    except (OSError, AttributeError):
        return False
    arguments = [ctypes.c_ulong(number) for number in (1, 0, 0, 0)]
    is_locked = prctl(38, *arguments) == 0  # PR_SET_NO_NEW_PRIVS
    # PR_SET_SECCOMP, SECCOMP_MODE_FILTER
    return bool(is_locked and prctl(22, ctypes.c_ulong(2), filter_, ctypes.c_ulong(0), ctypes.c_ulong(0)) == 0)


def _import(name: str) -> Any:
    """Import a module; of this package only what the module needs, not all of its parts."""
    root = name.partition(".")[0]
    spec = importlib.util.find_spec(root) if root == "foveasim" else None
    if spec is not None:
        sys.modules[root] = importlib.util.module_from_spec(spec)  # not executed: its __init__ imports everything
    return importlib.import_module(name)


def _load(task: dict[str, Any]) -> Any:
    """Return the reader of a task, with its keywords."""
    if not task["files"]:
        return functools.partial(getattr(_import(task["module"]), task["reader"]), task["path"], **task["args"])
    for name, file in task["files"]:
        spec = importlib.util.spec_from_file_location(name, file)
        assert spec is not None
        assert spec.loader is not None
        # Under its name, so that the next module can import from it without its package.
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return functools.partial(
        getattr(sys.modules[task["module"]], task["reader"]), task["path"], limit=limit, **task["args"]
    )


def _run_reader(task: dict[str, Any], answer: BinaryIO) -> dict[str, Any]:
    """Write the arrays of a reader, and return its other data."""
    import numpy as np

    if task.get("is_iterator"):
        for array in _load(task)():
            about = {} if array is None else {"shape": array.shape, "type": array.dtype.str}
            content = b"" if array is None else array.tobytes()
            answer.write(json.dumps({**about, "n_bytes": len(content)}).encode() + b"\n" + content)
            answer.flush()
        return {"is_last": True}
    metadata, arrays = _load(task)()
    with open(task["arrays"], "wb") as file:  # noqa: PTH123 -- a string from the task
        for array in arrays:
            np.save(file, np.ascontiguousarray(array), allow_pickle=False)
    return {"metadata": metadata, "n_arrays": len(arrays)}


def _answer(task: dict[str, Any], answer: BinaryIO) -> dict[str, Any]:
    """Return the answer of a reader, or the reason why it rejects the file."""
    try:
        return _run_reader(task, answer)
    except BrokenPipeError:
        raise
    except MemoryError:
        return {"rejected": "is malformed: reading it needs more memory than a valid file of its size"}
    except Exception as error:  # noqa: BLE001 -- readers raise arbitrary exceptions on malformed files
        if REJECTIONS & {kind.__name__ for kind in type(error).__mro__}:
            return {"rejected": str(error).removeprefix(f"{task['path']}: ")}
        reason = " ".join(str(error).split()) or type(error).__name__
        return {"rejected": f"is corrupt or truncated ({reason:.200})"}


def _main() -> None:
    task = json.load(sys.stdin)
    for kind, maximum in (
        ("RLIMIT_CORE", 0),
        ("RLIMIT_CPU", task["max_cpu_s"]),
        ("RLIMIT_AS", task["max_bytes"]),
        ("RLIMIT_FSIZE", task["max_bytes"]),
    ):
        if maximum is not None:
            limit(kind, maximum)
    deny_system_calls()
    sys.path[:] = task["sys_path"]
    warnings.simplefilter("ignore")
    # Libraries print problems of a file on standard output.
    with os.fdopen(os.dup(1), "wb") as answer, open(task["printed"], "w") as printed:  # noqa: PTH123
        os.dup2(printed.fileno(), 1)
        answer.write(json.dumps(_answer(task, answer)).encode())


if __name__ == "__main__":
    _main()

"""
The sandbox process: reads one file through a library that a malformed file can crash.

:mod:`foveasim._io.sandbox` starts it with a task as JSON on standard input. It loads nothing of the package by itself, so that
it starts quickly and its limits are those of the reader.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import sys
import warnings
from typing import Any

__all__ = ["limit"]

#: Names of the errors by which readers reject a file; any other means that it is corrupt.
REJECTIONS = {"FoveasimError", "FormatError"}


def limit(kind: str, most: int) -> None:
    """Set a limit of memory ("RLIMIT_AS"), time ("RLIMIT_CPU") or others, where the system has them."""
    try:
        import resource
    except ImportError:
        return
    number = getattr(resource, kind)
    hard = resource.getrlimit(number)[1]
    resource.setrlimit(number, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _answer(task: dict[str, Any]) -> dict[str, Any]:
    import numpy as np

    try:
        if task["file"] is None:
            module = importlib.import_module(task["module"])
            told, arrays = getattr(module, task["reader"])(task["path"], **task["args"])
        else:
            spec = importlib.util.spec_from_file_location(task["module"], task["file"])
            assert spec is not None
            assert spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            told, arrays = getattr(module, task["reader"])(task["path"], limit=limit, **task["args"])
        with open(task["arrays"], "wb") as file:  # noqa: PTH123 -- a plain name from the task
            for array in arrays:
                np.save(file, np.ascontiguousarray(array), allow_pickle=False)
    except MemoryError:
        return {"rejected": "is malformed: it asks for more memory than a file of its size needs"}
    except Exception as error:  # noqa: BLE001 -- whatever a malformed file makes its reader raise
        if REJECTIONS & {kind.__name__ for kind in type(error).__mro__}:
            return {"rejected": str(error).removeprefix(f"{task['path']}: ")}
        reason = " ".join(str(error).split()) or type(error).__name__
        return {"rejected": f"is corrupt or truncated ({reason:.200})"}
    return {"told": told, "n_arrays": len(arrays)}


def _main() -> None:
    task = json.load(sys.stdin)
    for kind, most in (("RLIMIT_CORE", 0), ("RLIMIT_CPU", task["max_cpu_s"]), ("RLIMIT_AS", task["max_bytes"])):
        limit(kind, most)
    sys.path[:] = task["sys_path"]
    warnings.simplefilter("ignore")
    # Libraries print on standard output what they find wrong with a file.
    with os.fdopen(os.dup(1), "w") as answer, open(task["printed"], "w") as printed:  # noqa: PTH123
        os.dup2(printed.fileno(), 1)
        answer.write(json.dumps(_answer(task)))


if __name__ == "__main__":
    _main()

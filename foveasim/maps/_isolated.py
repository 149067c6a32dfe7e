"""
A program of its own that reads EXR, HDF5, netCDF, zarr and MAT files: a broken or hostile file can only end *it*.

Started by ``_apart.py`` with a task as JSON on standard input; answers with JSON on standard output, and leaves the map's
numbers in the file that the task names.
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

__all__: list[str] = []


def main() -> None:
    """Do the task."""
    task = json.load(sys.stdin)
    for kind, most in (("RLIMIT_CORE", 0), ("RLIMIT_CPU", task["max_cpu_s"]), ("RLIMIT_AS", task["max_bytes"])):
        _limit(kind, most)
    sys.path[:] = task["sys_path"]
    warnings.simplefilter("ignore")
    # Libraries print on standard output what they think of a file.
    with os.fdopen(os.dup(1), "w") as answer, Path(task["told"]).open("w") as told:
        os.dup2(told.fileno(), 1)
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
    import numpy as np

    from foveasim.errors import FoveasimError
    from foveasim.maps._common import Refusal, as_images
    from foveasim.maps._readers import READERS

    try:
        found = READERS[task["kind"]](Path(task["path"]), task["name"])
        data = as_images(found.data)
        with Path(task["out"]).open("wb") as file:
            np.save(file, np.ascontiguousarray(data), allow_pickle=False)
        return {"found": asdict(replace(found, data=np.empty(0))) | {"data": None}}
    except (Refusal, FoveasimError) as refusal:
        return {"refused": str(refusal).removeprefix(f"{task['path']}: ")}
    except MemoryError:
        return {"refused": "asks for more memory than any map needs"}
    except ImportError as error:
        return {"refused": f"needs {error.name or 'a library'}; install it with: pip install 'foveasim[maps]'"}
    except Exception as error:  # noqa: BLE001 -- whatever a broken file makes its reader trip over
        return {"broken": f"{type(error).__name__}: {error}"}


if __name__ == "__main__":
    main()

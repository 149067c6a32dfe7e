"""Loading a room's numba kernels: when they are needed, and with a word where they must be compiled first."""

from __future__ import annotations

import importlib
import logging
import os
import sys
import tempfile
from pathlib import Path
from threading import Lock
from types import ModuleType

__all__ = ["kernels"]

_log = logging.getLogger("foveasim")
_lock = Lock()


def kernels(room: str, module: str = "_kernels") -> ModuleType:
    """
    The compiled kernels of a room, of one module of them.

    numba itself takes half a second to load, and compiling some seconds more, once a machine: so neither happens at
    ``import foveasim``. Where no folder can keep the machine code, it is kept in the temporary one.
    """
    name = f"foveasim.{room}.{module}"
    with _lock:
        if name in sys.modules:
            return sys.modules[name]
        if not _is_cached(room, module):
            _log.warning("compiling the kernels of foveasim.%s for this machine, once (a few seconds)", room)
        try:
            return importlib.import_module(name)
        except RuntimeError as error:
            if "no locator available" not in str(error):
                raise
            import numba

            os.environ["NUMBA_CACHE_DIR"] = numba.config.CACHE_DIR = str(Path(tempfile.gettempdir()) / "foveasim-numba")
            return importlib.import_module(name)


def _is_cached(room: str, module: str) -> bool:
    """Whether machine code lies beside the source, or may lie elsewhere because the source's folder cannot be written."""
    folder = Path(__file__).parent / room
    is_elsewhere = bool(os.environ.get("NUMBA_CACHE_DIR")) or not os.access(folder, os.W_OK)
    pattern = f"{module}.*py{sys.version_info.major}{sys.version_info.minor}*.nbi"
    return is_elsewhere or any((folder / "__pycache__").glob(pattern))

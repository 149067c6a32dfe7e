"""Loading a room's numba kernels: when they are needed, and with a word where they must be compiled first."""

from __future__ import annotations

import importlib
import logging
import sys
from pathlib import Path
from types import ModuleType

__all__ = ["kernels"]

_log = logging.getLogger("foveasim")


def kernels(room: str) -> ModuleType:
    """
    The compiled kernels of a room.

    numba itself takes half a second to load, and compiling some seconds more, once a machine: so neither happens at
    ``import foveasim``.
    """
    name = f"foveasim.{room}._kernels"
    if name not in sys.modules and not _is_cached(room):
        _log.warning("compiling the kernels of foveasim.%s for this machine, once (a few seconds)", room)
    return importlib.import_module(name)


def _is_cached(room: str) -> bool:
    """Whether machine code lies beside the source; elsewhere, as for a package that cannot be written to, is not looked."""
    folder = Path(__file__).parent / room
    return any((folder / "__pycache__").glob("_kernels.*.nbi"))

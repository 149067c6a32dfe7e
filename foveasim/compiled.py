"""Loading a room's numba kernels: when they are needed, and with a word where they must be compiled first."""

from __future__ import annotations

import importlib
import logging
import os
import sys
import tempfile
import traceback
from pathlib import Path
from threading import Lock
from types import ModuleType

from foveasim.errors import FileError

__all__ = ["kernels"]

_log = logging.getLogger("foveasim")
_lock = Lock()
#: What reads and writes machine code on disk; its objects have a ``cache_path``.
CACHING = "numba.core.caching"


def kernels(room: str, module: str = "_kernels") -> ModuleType:
    """
    The compiled kernels of a room, of one module of them.

    numba itself takes half a second to load, and compiling some seconds more, once a machine: so neither happens at
    ``import foveasim``. Where no folder can keep the machine code, it is kept in the temporary one. Machine code on
    disk that numba cannot read, as a full disk or a crash leaves it, is deleted and compiled again.

    Parameters
    ----------
    room : str
        Name below ``foveasim``, with dots: ``"sensor"``, ``"layout.files"``.
    module : str
        Name of the module in it.

    Raises
    ------
    FileError
        When machine code can be neither read from disk nor replaced there; it names the directory to delete.
    """
    name = f"foveasim.{room}.{module}"
    with _lock:
        if name in sys.modules:
            return sys.modules[name]
        if not _is_cached(room, module):
            _log.warning("compiling the kernels of foveasim.%s for this machine, once (a few seconds)", room)
        emptied: set[Path] = set()
        while True:
            try:
                return _imported(name)
            except Exception as error:
                folder = _cache_of(error)
                if folder is None:
                    raise
                if folder in emptied or isinstance(error, OSError):
                    raise _unusable(folder, error) from None
            _empty(folder)
            emptied.add(folder)
            _log.warning("compiled kernels in %s were corrupt: compiling them again (a few seconds)", folder)


def _imported(name: str) -> ModuleType:
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
    folder = Path(__file__).parent.joinpath(*room.split("."))
    is_elsewhere = bool(os.environ.get("NUMBA_CACHE_DIR")) or not os.access(folder, os.W_OK)
    pattern = f"{module}.*py{sys.version_info.major}{sys.version_info.minor}*.nbi"
    return is_elsewhere or any((folder / "__pycache__").glob(pattern))


def _cache_of(error: BaseException | None) -> Path | None:
    """Directory of the cache in which an error was raised, or one that it followed; None where it was raised elsewhere."""
    while error is not None:
        for frame, _ in traceback.walk_tb(error.__traceback__):
            path = getattr(frame.f_locals.get("self"), "cache_path", None)
            if path is not None and frame.f_globals.get("__name__") == CACHING:
                return Path(path)
        error = error.__cause__ or error.__context__
    return None


def _empty(folder: Path) -> None:
    """Delete the machine code in a directory; numba has one for each directory of sources."""
    try:
        for path in folder.glob("*.nb[ic]"):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise _unusable(folder, error) from None


def _unusable(folder: Path, error: Exception) -> FileError:
    reason = " ".join(str(error).split()) or type(error).__name__
    cure = "delete this directory, or name another one in NUMBA_CACHE_DIR"
    return FileError(folder, f"contains compiled kernels that can be neither read nor replaced ({reason:.200}); {cure}")

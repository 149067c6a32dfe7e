"""
Compilation of numba kernels, with machine code cached on disk.

Kernels lie in modules of their own, ``_kernels.py``, which are imported where they are called: numba takes half a second
to load and compiling takes seconds, so neither happens at ``import foveasim``.
"""

from __future__ import annotations

import inspect
import logging
import os
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from foveasim.errors import FileError

__all__ = ["njit"]

_log = logging.getLogger("foveasim")
#: Reads and writes machine code on disk; its objects have a ``cache_path``.
CACHING = "numba.core.caching"
#: Modules whose compilation was announced.
_announced: set[str] = set()


def njit(signature: Any = None, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """
    Decorate a kernel: :func:`numba.njit` that releases the GIL and caches machine code on disk.

    A first compilation is announced. If no directory can store the machine code, the temporary one does. Machine code on
    disk that numba cannot read, as a full disk or a crash leaves it, is deleted and compiled again.

    Parameters
    ----------
    signature : numba type or list of them, optional
        Compile at once for these arguments; without it, when a kernel that calls it is compiled.
    **options
        Further options of :func:`numba.njit`.

    Raises
    ------
    FileError
        When machine code can be neither read from disk nor replaced there; it names the directory to delete.
    """
    import numba

    def decorated(function: Callable[..., Any]) -> Any:
        if function.__module__ not in _announced and not _is_cached(function):
            _announced.add(function.__module__)
            package = function.__module__.rpartition(".")[0]
            _log.warning("compiling the kernels of %s for this machine, once (a few seconds)", package)
        emptied: set[Path] = set()
        while True:
            try:
                return numba.njit(signature, cache=True, nogil=True, **options)(function)
            except Exception as error:
                if "no locator available" in str(error):
                    place = str(Path(tempfile.gettempdir()) / "foveasim-numba")
                    if place != numba.config.CACHE_DIR:
                        os.environ["NUMBA_CACHE_DIR"] = numba.config.CACHE_DIR = place
                        continue
                directory = _cache_of(error)
                if directory is None:
                    raise
                if directory in emptied or isinstance(error, OSError):
                    raise _unusable(directory, error) from None
            _empty(directory)
            emptied.add(directory)
            _log.warning("compiled kernels in %s were corrupt: compiling them again (a few seconds)", directory)

    return decorated


def _is_cached(function: Callable[..., Any]) -> bool:
    """Whether machine code is next to the source, or may be elsewhere because the source's directory cannot be written."""
    source = Path(inspect.getfile(function))
    is_elsewhere = bool(os.environ.get("NUMBA_CACHE_DIR")) or not os.access(source.parent, os.W_OK)
    pattern = f"{source.stem}.*py{sys.version_info.major}{sys.version_info.minor}*.nbi"
    return is_elsewhere or any((source.parent / "__pycache__").glob(pattern))


def _cache_of(error: BaseException | None) -> Path | None:
    """Directory of the cache in which an error was raised, or one that it followed; None where it was raised elsewhere."""
    while error is not None:
        for frame, _ in traceback.walk_tb(error.__traceback__):
            path = getattr(frame.f_locals.get("self"), "cache_path", None)
            if path is not None and frame.f_globals.get("__name__") == CACHING:
                return Path(path)
        error = error.__cause__ or error.__context__
    return None


def _empty(directory: Path) -> None:
    """Delete the machine code in a directory; numba has one for each directory of sources."""
    try:
        for path in directory.glob("*.nb[ic]"):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise _unusable(directory, error) from None


def _unusable(directory: Path, error: Exception) -> FileError:
    reason = " ".join(str(error).split()) or type(error).__name__
    hint = "delete this directory, or name another one in NUMBA_CACHE_DIR"
    return FileError(
        directory, f"contains compiled kernels that can be neither read nor replaced ({reason:.200}); {hint}"
    )

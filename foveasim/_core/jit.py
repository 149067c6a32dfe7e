"""
Compilation of numba kernels, with machine code cached on disk.

Kernels are defined in separate modules, ``_kernels.py``, which are imported by the functions that call them: importing numba
takes half a second and compilation takes seconds, so neither happens at ``import foveasim``.
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
#: Module of numba that reads and writes machine code on disk; its objects have a ``cache_path``.
CACHE_MODULE = "numba.core.caching"
#: Modules whose compilation has been logged.
_announced: set[str] = set()


def njit(signature: Any = None, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """
    Decorate a kernel with :func:`numba.njit`, with machine code cached on disk.

    The kernel releases the GIL. The first compilation is logged. If the default cache directories are not writeable, machine
    code is stored in the temporary directory. Machine code that numba cannot read, for example after a full disk or a crash, is
    deleted and compiled again.

    Parameters
    ----------
    signature : numba type or list of them, optional
        Argument types to compile for at import; by default the kernel is compiled with the kernel that calls it.
    **options
        Further options of :func:`numba.njit`.

    Raises
    ------
    FileError
        When cached machine code can be neither read nor replaced; the message names the directory to delete.
    """
    import numba

    def decorate(function: Callable[..., Any]) -> Any:
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
                    cache_directory = str(Path(tempfile.gettempdir()) / "foveasim-numba")
                    if cache_directory != numba.config.CACHE_DIR:
                        os.environ["NUMBA_CACHE_DIR"] = numba.config.CACHE_DIR = cache_directory
                        continue
                directory = _find_cache_directory(error)
                if directory is None:
                    raise
                if directory in emptied or isinstance(error, OSError):
                    raise _cache_error(directory, error) from None
            _delete_cache(directory)
            emptied.add(directory)
            _log.warning("compiled kernels in %s were corrupt: compiling them again (a few seconds)", directory)

    return decorate


def _is_cached(function: Callable[..., Any]) -> bool:
    """
    Whether machine code is cached next to the source.

    True also where the cache may be in another directory: ``NUMBA_CACHE_DIR`` is set, or the source directory is read-only.
    """
    source = Path(inspect.getfile(function))
    is_elsewhere = bool(os.environ.get("NUMBA_CACHE_DIR")) or not os.access(source.parent, os.W_OK)
    pattern = f"{source.stem}.*py{sys.version_info.major}{sys.version_info.minor}*.nbi"
    return is_elsewhere or any((source.parent / "__pycache__").glob(pattern))


def _find_cache_directory(error: BaseException | None) -> Path | None:
    """Return the cache directory in which an error or its cause was raised, or None."""
    while error is not None:
        for frame, _ in traceback.walk_tb(error.__traceback__):
            path = getattr(frame.f_locals.get("self"), "cache_path", None)
            if path is not None and frame.f_globals.get("__name__") == CACHE_MODULE:
                return Path(path)
        error = error.__cause__ or error.__context__
    return None


def _delete_cache(directory: Path) -> None:
    """Delete the machine code in a cache directory; numba creates one per source directory."""
    try:
        for path in directory.glob("*.nb[ic]"):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise _cache_error(directory, error) from None


def _cache_error(directory: Path, error: Exception) -> FileError:
    reason = " ".join(str(error).split()) or type(error).__name__
    hint = "delete this directory, or set NUMBA_CACHE_DIR to another one"
    return FileError(
        directory, f"contains compiled kernels that can be neither read nor replaced ({reason:.200}); {hint}"
    )

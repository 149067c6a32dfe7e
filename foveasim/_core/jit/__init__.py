"""
Compilation of numba kernels, on first use or ahead, with machine code on disk.

Kernels are defined in separate modules, ``_kernels.py``, which are imported by the functions that call them: importing numba
takes half a second, so it does not happen at ``import foveasim``. A kernel is compiled when it is first called, for the types
of this call: compiling all of them takes five times as long as those of one capture.
"""

from __future__ import annotations

import gc
import inspect
import logging
import os
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from operator import itemgetter
from pathlib import Path
from typing import Any

from foveasim._core.calls import check_arguments
from foveasim._core.threads import ForkSafeLock, cached_property, thread_count
from foveasim._core.validation import check_count
from foveasim.errors import FileError

_log = logging.getLogger("foveasim")
#: The package, whose modules ``_*kernels`` contain the kernels.
PACKAGE = Path(__file__).parents[2]
#: Module of numba that reads and writes machine code on disk; its objects have a ``cache_path``.
CACHE_MODULE = "numba.core.caching"
#: Options of all kernels. Division by 0 gives infinity or NaN, as in numpy: a check in each loop prevents vectorisation.
OPTIONS = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
#: Options of functions that only kernels call.
INNER = {"no_cpython_wrapper": True}
#: Modules whose compilation has been logged.
_announced: set[str] = set()
_lock = ForkSafeLock()


def njit(
    signature: Any = None, *, allocates: bool | None = None, **options: Any
) -> Callable[[Callable[..., Any]], Any]:
    """
    Decorate a kernel with :func:`numba.njit`, compiled on first use.

    The kernel releases the GIL. The first compilation is logged. If the default cache directories are not writeable, machine
    code is stored in the temporary directory. Machine code that numba cannot read, for example after a full disk or a crash, is
    deleted and compiled again.

    ``signature`` (numba type or list of them): argument types, which differ in the dtypes of arrays. Without it, the function
    can be called by kernels only, and is inlined in them. ``allocates``: whether the function creates arrays; by default True
    with a signature, and False without. Otherwise arrays are not reference-counted in it, which in a loop takes more time than
    the loop itself: each assignment of an array, and each use in a branch, is an atomic operation. ``**options``: further
    options of :func:`numba.njit`. The decorator returns a :class:`Kernel`, or a function of numba for kernels.
    """
    if signature is None:
        import numba

        inner: Callable[[Callable[..., Any]], Any] = numba.njit(
            **OPTIONS | INNER | {"forceinline": True, "_nrt": bool(allocates)} | options
        )
        return inner
    signatures = signature if isinstance(signature, Sequence) else [signature]
    return lambda function: Kernel(function, signatures, options | {"_nrt": allocates is not False})


class Kernel:
    """
    A function of arrays and numbers, compiled for each of its signatures on first use.

    One dispatcher of numba for each signature: the dtypes of the arguments select it, without resolution of types in Python.

    Parameters
    ----------
    function : Callable
    signatures : sequence of numba types
        They differ in the dtypes of arrays.
    options : dict
        Options of :func:`numba.njit`.

    Raises
    ------
    FileError
        On a call, when cached machine code can be neither read nor replaced; the message names the directory to delete.
    """

    def __init__(self, function: Callable[..., Any], signatures: Sequence[Any], options: dict[str, Any]) -> None:
        self.__name__, self.__qualname__, self.__module__ = (
            function.__name__,
            function.__qualname__,
            function.__module__,
        )
        self.__doc__ = function.__doc__
        self.py_func = function
        self._options = OPTIONS | options
        self._positions = _distinct_positions(signatures)
        self._signatures = {self._dtypes_of(signature): signature for signature in signatures}
        self._compiled: dict[tuple[Any, ...], Callable[..., Any]] = {}

    def __call__(self, *args: Any) -> Any:
        key = tuple([args[k].dtype for k in self._positions])
        compiled = self._compiled.get(key)
        return (self._compile(key) if compiled is None else compiled)(*args)

    def __repr__(self) -> str:
        return (
            f"<kernel {self.__module__}.{self.__qualname__}, {len(self._compiled)} of {len(self._signatures)} compiled>"
        )

    @property
    def signatures(self) -> tuple[Any, ...]:
        """Types of the arguments for which the kernel can be compiled."""
        return tuple(self._signatures.values())

    @cached_property
    def _inner(self) -> Any:
        """The function of numba for kernels that call this one."""
        import numba

        return numba.njit(**self._options | INNER)(self.py_func)

    @property
    def _numba_type_(self) -> Any:
        import numba

        return numba.types.Dispatcher(self._inner)

    def compile(self) -> None:
        """Compile all signatures, or load their machine code."""
        for key in self._signatures:
            self._compile(key)

    def _dtypes_of(self, signature: Any) -> tuple[Any, ...]:
        from numba.np.numpy_support import as_dtype

        return tuple(as_dtype(_arguments(signature)[k].dtype) for k in self._positions)

    def _compile(self, key: tuple[Any, ...]) -> Callable[..., Any]:
        with _lock:
            compiled = self._compiled.get(key)
            if compiled is None:
                if key not in self._signatures:
                    raise TypeError(f"{self!r} has no signature for {', '.join(map(str, key))}")
                compiled = self._compiled[key] = _compile(self.py_func, self._signatures[key], self._options)
            return compiled


@check_arguments
def compile_kernels(*, n_workers: int | None = None) -> int:
    """
    Compile all kernels that are not yet compiled for this machine.

    Without this call, each kernel is compiled on its first use. Use it when a container is built, before many processes start,
    or before measuring times; ``foveasim compile`` does the same. Machine code is stored next to the package, or in
    ``NUMBA_CACHE_DIR``, for this type of processor and these versions of Python and numba.

    Parameters
    ----------
    n_workers : int, optional
        Number of processes, by default one per core. With 1, the kernels are compiled in this process.

    Returns
    -------
    int
        Number of kernels.

    Raises
    ------
    FileError
        When machine code cannot be stored, or corrupt machine code cannot be replaced.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.compile_kernels()  # doctest: +SKIP
    60
    """
    n_workers = thread_count() if n_workers is None else check_count("n_workers", n_workers)
    kernels = list(_all_kernels())
    if n_workers > 1:
        shares: list[list[Kernel]] = [[] for _ in range(min(n_workers, len(kernels)))]
        costs = [0] * len(shares)
        for cost, kernel in sorted(((_cost(kernel), kernel) for kernel in kernels), key=itemgetter(0), reverse=True):
            least = costs.index(min(costs))
            shares[least].append(kernel)
            costs[least] += cost
        with ThreadPoolExecutor(len(shares)) as pool:
            if all(pool.map(_compile_in_process, shares)):
                return len(kernels)
    for kernel in kernels:  # raises the error of a worker
        kernel.compile()
    return len(kernels)


def kernel_modules() -> Iterator[str]:
    """Yield the names of the modules with kernels."""
    for path in sorted(PACKAGE.rglob("*_kernels.py")):
        yield ".".join((PACKAGE.name, *path.relative_to(PACKAGE).with_suffix("").parts))


def compile_named(names: Sequence[str]) -> None:
    """Compile kernels, given as pairs of a module and a name."""
    for name in names:
        module, _, kernel = name.partition(":")
        getattr(import_module(module), kernel).compile()


def _all_kernels() -> Iterator[Kernel]:
    for name in kernel_modules():
        for value in vars(import_module(name)).values():
            if isinstance(value, Kernel) and value.__module__ == name:
                yield value


def _cost(kernel: Kernel) -> int:
    """Return a number that is about proportional to the time of compilation."""
    return len(inspect.getsource(kernel.py_func)) * len(kernel.signatures)


def _compile_in_process(kernels: Sequence[Kernel]) -> bool:
    """Compile kernels in a new process; return whether it succeeded."""
    # Without multiprocessing, which imports the main module again.
    names = [f"{kernel.__module__}:{kernel.__name__}" for kernel in kernels]
    paths = [str(PACKAGE.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    done = subprocess.run(  # noqa: S603 -- names of the package
        [
            sys.executable,
            "-c",
            f"import sys; from {__name__} import compile_named; compile_named(sys.argv[1:])",
            *names,
        ],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=False,
    )
    return done.returncode == 0


def _arguments(signature: Any) -> tuple[Any, ...]:
    """Return the types of the arguments of a signature."""
    return tuple(getattr(signature, "args", signature))


def _distinct_positions(signatures: Sequence[Any]) -> tuple[int, ...]:
    """Return the positions of the fewest arrays whose dtypes distinguish the signatures."""
    positions: list[int] = []
    columns = list(zip(*map(_arguments, signatures), strict=True))
    while len({tuple(columns[k][i] for k in positions) for i in range(len(signatures))}) < len(signatures):
        positions.append(
            max(
                (k for k, column in enumerate(columns) if hasattr(column[0], "dtype") and k not in positions),
                key=lambda k: len({tuple(columns[j][i] for j in (*positions, k)) for i in range(len(signatures))}),
            )
        )
    return tuple(positions)


def _compile(function: Callable[..., Any], signature: Any, options: dict[str, Any]) -> Callable[..., Any]:
    """Compile a function for a signature, or load its machine code."""
    import numba

    if function.__module__ not in _announced and not _is_cached(function):
        _announced.add(function.__module__)
        package = function.__module__.rpartition(".")[0]
        _log.warning("compiling the kernels of %s for this machine, once (a few seconds)", package)
    emptied: set[Path] = set()
    while True:
        try:
            with _no_garbage_collection():
                compiled: Callable[..., Any] = numba.njit(signature, cache=True, **options)(function)
            directory = _directory_of_other_code(compiled, function)
            if directory is None:
                return compiled
            if directory in emptied:
                raise _cache_error(directory, ValueError("it has the machine code of another kernel"))
        except FileError:
            raise
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


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """
    Pause the collector of cyclic garbage.

    It finds little during a compilation, and takes an eighth of its time. The caller holds the lock, so that no other kernel
    enables it.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def _is_cached(function: Callable[..., Any]) -> bool:
    """
    Whether machine code of a kernel is cached next to the source.

    True also where the cache may be in another directory: ``NUMBA_CACHE_DIR`` is set, or the source directory is read-only.
    """
    source = Path(inspect.getfile(function))
    is_elsewhere = bool(os.environ.get("NUMBA_CACHE_DIR")) or not os.access(source.parent, os.W_OK)
    pattern = f"{source.stem}.{function.__qualname__}-*py{sys.version_info.major}{sys.version_info.minor}*.nbi"
    return is_elsewhere or any((source.parent / "__pycache__").glob(pattern))


def _directory_of_other_code(compiled: Any, function: Callable[..., Any]) -> Path | None:
    """Return the cache directory if it has the code of another function, else None."""
    wanted = function.__module__, function.__qualname__
    overloads = getattr(compiled, "overloads", {})  # none where compilation is disabled
    names = {(found.fndesc.modname, found.fndesc.qualname) for found in overloads.values()}
    return None if names <= {wanted} else Path(compiled._cache.cache_path)  # noqa: SLF001 -- no public name


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

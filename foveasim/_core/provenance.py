"""Provenance of results: settings, versions and identities of functions as plain data."""

from __future__ import annotations

import functools
import hashlib
import json
import platform
import sys
import sysconfig
from collections.abc import Collection, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import frozen_array
from foveasim._version import __version__

#: Arrays up to this size are stored as lists; larger arrays as shape, dtype and checksum.
MAX_LISTED_VALUES = 64
_ATOMS = frozenset({str, int, float, bool, type(None)})
#: Types whose ``repr`` is their value, equal in all processes.
_REPRESENTED = (bool, int, float, complex, str, bytes, range, slice, type(None), type(...), np.dtype, Path)


def to_plain_data(value: Any, *, without: Collection[str] = ()) -> Any:
    """
    Convert an object to plain data: numbers, strings, lists and dicts.

    A dataclass becomes a dict of its class name and public fields, except those in ``without``; a large array becomes its
    shape, dtype and SHA-256; a function, or an object without a representation of its own, becomes its identity
    (:func:`identify`).
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        if value.size <= MAX_LISTED_VALUES:
            return value.tolist()
        digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return {"shape": list(value.shape), "dtype": str(value.dtype), "sha256": digest}
    if isinstance(value, Mapping):
        return {str(key): to_plain_data(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain_data(item) for item in value]
    if is_dataclass(value):
        return {
            "kind": type(value).__name__,
            **{
                f.name: to_plain_data(getattr(value, f.name))
                for f in fields(value)
                if not f.name.startswith("_") and f.name not in without
            },
        }
    # Default representations contain addresses.
    has_address = type(value).__repr__ is object.__repr__  # type: ignore[comparison-overlap]
    return identify(value) if callable(value) or has_address else repr(value)


def is_digest(value: Any) -> bool:
    """Return whether plain data are the shape, dtype and SHA-256 of an array."""
    return isinstance(value, Mapping) and value.keys() == {"shape", "dtype", "sha256"}


def large_arrays(value: Any) -> dict[str, NDArray[Any]]:
    """Return the arrays that :func:`to_plain_data` replaces by a checksum, by this checksum."""
    if isinstance(value, np.ndarray):
        digest = to_plain_data(value)
        return {digest["sha256"]: value} if is_digest(digest) else {}
    if is_dataclass(value):
        parts: Any = [getattr(value, f.name) for f in fields(value) if not f.name.startswith("_")]
    elif isinstance(value, Mapping):
        parts = value.values()
    else:
        parts = value if isinstance(value, list | tuple) else ()
    return {key: array for part in parts for key, array in large_arrays(part).items()}


def resolve(digest: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> NDArray[Any] | None:
    """Return the array of a digest among those of :func:`large_arrays`; None if it is missing."""
    array = arrays.get(str(digest["sha256"]))
    if array is None:
        return None
    return np.ascontiguousarray(array).reshape(-1).view(str(digest["dtype"])).reshape(digest["shape"])


def copy_plain_data(value: Any) -> Any:
    """Return a deep copy of plain data; editing the copy does not change the original."""
    # Concrete types first: checks of abstract types take several times as long, and every video frame has such data.
    if type(value) in _ATOMS:
        return value
    if isinstance(value, dict | Mapping):
        return {key: copy_plain_data(item) for key, item in value.items()}
    if isinstance(value, list):
        return [copy_plain_data(item) for item in value]
    if type(value) is tuple:
        return tuple(copy_plain_data(item) for item in value)
    return frozen_array(value) if isinstance(value, np.ndarray) else value


def differences(one: Any, other: Any, prefix: str = "") -> Iterator[str]:
    """Yield the dotted names of the entries in which plain data differ: ``optics.f_number``."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in dict.fromkeys([*one, *other]):
            path = f"{prefix}.{key}" if prefix else str(key)
            if key not in one or key not in other:
                yield path
            else:
                yield from differences(one[key], other[key], path)
    elif one != other:
        yield prefix or "plan"


@cache
def _versions() -> dict[str, str]:
    libraries = {name: version(name) for name in ("numpy", "scipy", "numba", "shapely")}
    return {"foveasim": __version__, "python": platform.python_version(), **libraries}


def versions() -> dict[str, str]:
    """Return the versions of the package, of Python, and of the libraries that affect results."""
    return dict(_versions())


# -- functions and objects --------------------------------------------------------------------------------------------


def find_user_module(value: Any) -> str | None:
    """Return the user module (main program or uninstalled file) of an object, or None."""
    name = getattr(value, "__module__", None)
    if not isinstance(name, str) or name.partition(".")[0] == "foveasim":
        return None
    if name == "__main__":
        return name
    file = getattr(sys.modules.get(name), "__file__", None)
    if file is None:
        return None
    installed = {sysconfig.get_path(kind) for kind in ("purelib", "platlib", "stdlib")}
    return None if any(Path(file).is_relative_to(directory) for directory in installed) else name


def identify(value: Any) -> str:
    """
    Return the module and name of a function, with a digest for user functions and objects.

    The digest covers code, constants, defaults, captured values (of closures, partial functions and objects), and the functions
    and variables of user modules that the function uses. It is equal in all processes and runs of one program, changes with
    any of these, and does not depend on comments, line numbers or hash seeds. Functions of installed packages have no digest:
    their versions identify them. Of objects that cannot be pickled, such as locks, only the type contributes.
    """
    name = f"{getattr(value, '__module__', '')}:{getattr(value, '__qualname__', type(value).__qualname__)}"
    if isinstance(value, FunctionType) and find_user_module(value) is None and value.__closure__ is None:
        return name
    parts = json.dumps(_nested(value, {}))
    return f"{name} {hashlib.sha256(parts.encode()).hexdigest()[:32]}"


def _nested(value: Any, visited: dict[int, tuple[int, Any]]) -> Any:
    """Return nested lists of strings, with a number in place of a repeated part."""
    kind = type(value).__qualname__
    if isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
        return [kind, value.dtype.str, value.shape, hashlib.sha256(value.tobytes()).hexdigest()]
    if type(value) in _REPRESENTED or isinstance(value, np.dtype | Path):
        return [kind, repr(value)]
    # Whether equal constants are one object depends on how the code was loaded. References keep the ids of other parts valid.
    if not isinstance(value, tuple | frozenset | CodeType):
        if id(value) in visited:
            return ["part", visited[id(value)][0]]
        visited[id(value)] = len(visited), value
    return [kind, *(_nested(part, visited) for part in _parts(value))]


def _parts(value: Any) -> Iterator[Any]:
    """Return the parts of a function, class, container or object."""
    if isinstance(value, list | tuple):
        return iter(value)
    if isinstance(value, np.ndarray):
        return iter((value.shape, value.tolist()))
    if isinstance(value, set | frozenset):
        return iter(sorted(value, key=repr))  # the iteration order depends on the hash seed
    if isinstance(value, Mapping):
        return (part for item in value.items() for part in item)
    if isinstance(value, functools.partial):
        return iter((value.func, value.args, sorted(value.keywords.items())))
    if isinstance(value, MethodType):
        return iter((value.__func__, value.__self__))
    if isinstance(value, BuiltinFunctionType):
        return iter((value.__name__, value.__self__))
    if isinstance(value, CodeType):
        # Names of arguments and variables; line numbers do not change the behaviour.
        return iter((value.co_code, value.co_names, value.co_consts, value.co_varnames[: value.co_argcount]))
    if isinstance(value, ModuleType):
        return iter((value.__name__,))
    if isinstance(value, FunctionType):
        return _parts_of_function(value)
    if isinstance(value, type):
        own = [] if find_user_module(value) is None else [*value.__bases__, *_members(value)]
        return iter((value.__qualname__, *own))
    if is_dataclass(value):
        return iter((type(value), *(getattr(value, part.name) for part in fields(value))))
    if find_user_module(type(value)) is not None:
        return iter((type(value), dict(getattr(value, "__dict__", {}))))
    if hasattr(value, "__wrapped__"):
        return iter((value.__wrapped__,))
    return _parts_of_pickle(value)


def _parts_of_pickle(value: Any) -> Iterator[Any]:
    """Return the parts of an object as pickles contain them, without their byte format."""
    try:
        reduced = value.__reduce_ex__(4)
    except Exception:  # noqa: BLE001 -- objects may raise anything when they are pickled
        return iter(())
    if isinstance(reduced, str):
        return iter((reduced,))
    function, arguments, *rest = reduced
    state = rest[0] if rest else None
    return iter((getattr(function, "__qualname__", ""), arguments, state, *(list(part or ()) for part in rest[1:3])))


def _parts_of_function(function: FunctionType) -> Iterator[Any]:
    yield from (function.__qualname__, function.__defaults__, function.__kwdefaults__)
    for cell in function.__closure__ or ():
        try:
            yield cell.cell_contents
        except ValueError:  # a variable without a value
            yield CellType
    # Package versions identify installed functions.
    if find_user_module(function) is not None:
        yield function.__code__
        names = _global_names(function.__code__)
        yield from (function.__globals__[name] for name in names if name in function.__globals__)


def _members(kind: type) -> Iterator[Any]:
    """Yield the names, functions and constants of a class."""
    for name, member in sorted(vars(kind).items()):
        function = getattr(
            member, "__func__", getattr(member, "fget", member)
        )  # of static and class methods, and properties
        if isinstance(function, bool | int | float | complex | str | bytes | Path | FunctionType | None) and not (
            name.startswith("__") and isinstance(function, str | int | None)
        ):
            yield from (name, function)


def _global_names(code: CodeType) -> Iterator[str]:
    """Yield the names of module variables in a function and its nested functions."""
    yield from code.co_names
    for part in code.co_consts:
        if isinstance(part, CodeType):
            yield from _global_names(part)

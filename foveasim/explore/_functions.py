"""Identities of user functions: stored results are reused only for equal functions."""

from __future__ import annotations

import functools
import sys
import sysconfig
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

from foveasim._core.extras import import_optional

__all__ = ["find_user_module", "identify_function"]


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


def identify_function(function: Callable[..., Any]) -> str:
    """
    Return the module and name of a function, with a content token for user functions.

    The token covers code, constants, defaults, captured values (of closures, partial functions and objects), and the functions
    and variables of user modules that the function uses. It is equal in all processes and runs of one program, changes with
    any of these, and does not depend on comments. Functions of installed packages have no token. The token that dask computes
    for a function is derived from its pickle, which depends on hash seeds and line numbers, or is just the name; functions
    are therefore split into their parts first.

    Raises
    ------
    ParameterError
        When dask is not installed.
    """
    name = f"{getattr(function, '__module__', '')}:{getattr(function, '__qualname__', type(function).__qualname__)}"
    if isinstance(function, FunctionType) and find_user_module(function) is None and function.__closure__ is None:
        return name
    tokenize = import_optional("metrics", "dask.base").tokenize
    return f"{name} {tokenize(_parts_of(function, {}))}"


def _parts_of(value: Any, visited: dict[int, tuple[int, Any]]) -> Any:
    """Return nested lists of values, with a number in place of a repeated part."""
    parts = _parts(value)
    if parts is None:
        return value
    # Whether equal constants are one object depends on how the code was loaded. References keep the ids of other parts valid.
    if not isinstance(value, tuple | frozenset | CodeType):
        if id(value) in visited:
            return ["part", visited[id(value)][0]]
        visited[id(value)] = len(visited), value
    return [type(value).__qualname__, *(_parts_of(part, visited) for part in parts)]


def _parts(value: Any) -> Iterator[Any] | None:
    """Return the parts of a function, class or container; None for values that dask tokenizes."""
    if isinstance(value, list | tuple):
        return iter(value)
    if isinstance(value, set | frozenset):
        return iter(sorted(value, key=repr))  # the iteration order depends on the hash seed
    if isinstance(value, dict):
        return (part for item in value.items() for part in item)
    if isinstance(value, functools.partial):
        return iter((value.func, value.args, sorted(value.keywords.items())))
    if isinstance(value, MethodType):
        return iter((value.__func__, value.__self__))
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
    if find_user_module(type(value)) is not None:
        return iter((type(value), dict(getattr(value, "__dict__", {}))))
    if hasattr(value, "__wrapped__"):
        return iter((value.__wrapped__,))
    return None


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

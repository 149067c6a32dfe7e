"""Identities of user functions: stored results are reused only for equal functions."""

from __future__ import annotations

import functools
import sys
import sysconfig
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

from foveasim._core.extras import needs
from foveasim.errors import ParameterError

__all__ = ["identity_of", "own_module"]


def own_module(thing: Any) -> str | None:
    """Return the user module (main program or uninstalled file) of an object, or None."""
    name = getattr(thing, "__module__", None)
    if not isinstance(name, str) or name.partition(".")[0] == "foveasim":
        return None
    if name == "__main__":
        return name
    file = getattr(sys.modules.get(name), "__file__", None)
    if file is None:
        return None
    installed = {sysconfig.get_path(kind) for kind in ("purelib", "platlib", "stdlib")}
    return None if any(Path(file).is_relative_to(folder) for folder in installed) else name


def identity_of(function: Callable[..., Any]) -> str:
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
    if isinstance(function, FunctionType) and own_module(function) is None and function.__closure__ is None:
        return name
    try:
        from dask.base import tokenize
    except ImportError:
        raise ParameterError("metrics", needs("dask")) from None
    return f"{name} {tokenize(_parts_of(function, {}))}"


def _parts_of(thing: Any, seen: dict[int, tuple[int, Any]]) -> Any:
    """Return nested lists of values, with a number in place of a repeated part."""
    parts = _parts(thing)
    if parts is None:
        return thing
    # Whether equal constants are one object depends on how the code was loaded. References keep the ids of other parts valid.
    if not isinstance(thing, tuple | frozenset | CodeType):
        if id(thing) in seen:
            return ["part", seen[id(thing)][0]]
        seen[id(thing)] = len(seen), thing
    return [type(thing).__qualname__, *(_parts_of(part, seen) for part in parts)]


def _parts(thing: Any) -> Iterator[Any] | None:
    """Return the parts of a function, class or container; None for values that dask tokenizes."""
    if isinstance(thing, list | tuple):
        return iter(thing)
    if isinstance(thing, set | frozenset):
        return iter(sorted(thing, key=repr))  # the iteration order depends on the hash seed
    if isinstance(thing, dict):
        return (part for item in thing.items() for part in item)
    if isinstance(thing, functools.partial):
        return iter((thing.func, thing.args, sorted(thing.keywords.items())))
    if isinstance(thing, MethodType):
        return iter((thing.__func__, thing.__self__))
    if isinstance(thing, CodeType):
        # Names of arguments and variables; line numbers do not change the behaviour.
        return iter((thing.co_code, thing.co_names, thing.co_consts, thing.co_varnames[: thing.co_argcount]))
    if isinstance(thing, ModuleType):
        return iter((thing.__name__,))
    if isinstance(thing, FunctionType):
        return _parts_of_function(thing)
    if isinstance(thing, type):
        own = [] if own_module(thing) is None else [*thing.__bases__, *_members(thing)]
        return iter((thing.__qualname__, *own))
    if own_module(type(thing)) is not None:
        return iter((type(thing), dict(getattr(thing, "__dict__", {}))))
    if hasattr(thing, "__wrapped__"):
        return iter((thing.__wrapped__,))
    return None


def _parts_of_function(function: FunctionType) -> Iterator[Any]:
    yield from (function.__qualname__, function.__defaults__, function.__kwdefaults__)
    for cell in function.__closure__ or ():
        try:
            yield cell.cell_contents
        except ValueError:  # a variable without a value
            yield CellType
    # Package versions identify installed functions.
    if own_module(function) is not None:
        yield function.__code__
        names = _global_names(function.__code__)
        yield from (function.__globals__[name] for name in names if name in function.__globals__)


def _members(kind: type) -> Iterator[Any]:
    """Yield the names, functions and constants of a class."""
    for name, member in sorted(vars(kind).items()):
        inside = getattr(
            member, "__func__", getattr(member, "fget", member)
        )  # of static and class methods, and properties
        if isinstance(inside, bool | int | float | complex | str | bytes | Path | FunctionType | None) and not (
            name.startswith("__") and isinstance(inside, str | int | None)
        ):
            yield from (name, inside)


def _global_names(code: CodeType) -> Iterator[str]:
    """Yield the names of module variables in a function and its nested functions."""
    yield from code.co_names
    for part in code.co_consts:
        if isinstance(part, CodeType):
            yield from _global_names(part)

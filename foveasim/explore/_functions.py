"""Functions of the user's: which they are, and a checksum of what they do, by which results of others are told apart."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import pickle
import sys
import sysconfig
from collections.abc import Callable, Iterator
from pathlib import Path
from types import BuiltinFunctionType, CellType, CodeType, EllipsisType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

__all__ = ["described", "own_module"]

#: Characters of a checksum: chance gives two functions the same once in 2 ** 64.
N_CHARACTERS = 16
#: What is told by its text.
PLAIN = bool | int | float | complex | str | bytes | None | EllipsisType | Path
#: What may hold other things, and cannot hold itself.
CONSTANT = (tuple, frozenset, CodeType, np.ndarray)


def own_module(thing: Any) -> str | None:
    """Name of the module of a function or class, where it is the user's: the main program, or a file that is not installed."""
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


def described(function: Callable[..., Any]) -> str:
    """
    A function's place and name, with a checksum of what it does where it is not the package's own.

    The checksum is of the code, of constants and defaults, of what it takes along (the arguments of a partial function, the
    variables around a function in another, the state of an object), and of the functions and variables of the user's own
    modules that it names: the same in any process and run of the same program, and another after a change.
    """
    place = f"{getattr(function, '__module__', '')}:{getattr(function, '__qualname__', type(function).__qualname__)}"
    if isinstance(function, FunctionType) and own_module(function) is None and function.__closure__ is None:
        return place
    return f"{place} {_checksum(function, {})}"


def _checksum(thing: Any, seen: dict[int, tuple[int, Any]]) -> str:
    """Checksum of a thing; of one that was met before, its number."""
    if id(thing) in seen:
        return f"number {seen[id(thing)][0]}"
    # Whether two equal constants are one object depends on how the code came into memory. The rest is kept, so is its id.
    if not isinstance(thing, PLAIN) and not isinstance(thing, CONSTANT):
        seen[id(thing)] = len(seen), thing
    digest = hashlib.sha256(type(thing).__qualname__.encode())
    for part in _parts(thing):
        text = part if isinstance(part, bytes) else _checksum(part, seen).encode()
        digest.update(len(text).to_bytes(8, "big") + text)
    return digest.hexdigest()[:N_CHARACTERS]


def _parts(thing: Any) -> Iterator[Any]:
    """What makes a thing another: bytes, and things with parts of their own."""
    if isinstance(thing, PLAIN):
        yield repr(thing).encode("utf-8", "surrogatepass")
    elif isinstance(thing, np.ndarray | np.generic) and thing.dtype.kind != "O":
        yield from (str(thing.dtype).encode(), str(thing.shape).encode(), thing.tobytes())
    elif isinstance(thing, list | tuple):
        yield from thing
    elif isinstance(thing, set | frozenset):
        yield from sorted(_checksum(item, {}).encode() for item in thing)
    elif isinstance(thing, dict):
        for item in thing.items():
            yield from item
    elif isinstance(thing, functools.partial):
        yield from (
            thing.func,
            thing.args,
            sorted(thing.keywords),
            [thing.keywords[key] for key in sorted(thing.keywords)],
        )
    elif isinstance(thing, MethodType):
        yield from (thing.__func__, thing.__self__)
    elif isinstance(thing, CodeType):
        yield from (thing.co_code, thing.co_names, thing.co_consts, thing.co_varnames[: thing.co_argcount])
    elif isinstance(thing, ModuleType):
        yield thing.__name__.encode()
    elif isinstance(thing, BuiltinFunctionType):
        yield from (thing.__name__, thing.__self__)
    elif isinstance(thing, FunctionType):
        yield from (thing.__qualname__, thing.__defaults__, thing.__kwdefaults__)
        yield from map(_content, thing.__closure__ or ())
        # Installed packages are told by their versions.
        if own_module(thing) is not None:
            yield thing.__code__
            yield from (thing.__globals__[name] for name in _names(thing.__code__) if name in thing.__globals__)
    elif isinstance(thing, type):
        yield thing.__qualname__
        if own_module(thing) is not None:
            yield from thing.__bases__
            yield from _members(thing)
    elif own_module(type(thing)) is not None:
        yield from (type(thing), dict(getattr(thing, "__dict__", {})))
    elif dataclasses.is_dataclass(thing):
        yield type(thing)
        yield from (getattr(thing, field.name) for field in dataclasses.fields(thing) if field.init)
    elif hasattr(thing, "__wrapped__"):
        yield thing.__wrapped__
    else:
        try:
            yield pickle.dumps(thing, protocol=5)
        except Exception:  # noqa: BLE001 -- objects refuse in many ways; such have nothing that a worker could get
            yield b""


def _content(cell: CellType) -> Any:
    """A variable around a function; its type where it was not given a value."""
    try:
        return cell.cell_contents
    except ValueError:
        return CellType


def _members(kind: type) -> Iterator[Any]:
    """Functions and constants of a class."""
    for name, part in sorted(vars(kind).items()):
        inside = getattr(part, "__func__", getattr(part, "fget", part))  # of static and class methods, and properties
        if isinstance(inside, PLAIN | FunctionType) and name not in {"__module__", "__doc__"}:
            yield from (name, inside)


def _names(code: CodeType) -> Iterator[str]:
    """Names of modules' variables in a function, and in those inside it."""
    yield from code.co_names
    for part in code.co_consts:
        if isinstance(part, CodeType):
            yield from _names(part)

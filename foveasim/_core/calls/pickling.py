"""
State of objects for pickle and copies.

Caches and locks are not part of the state, and a copy computes the same values again: cached properties, and the private
fields of dataclasses with a ``default_factory``. Read-only arrays, which numpy restores as writeable, stay read-only, and
arrays of one repeated value stay without memory.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from functools import cache, cached_property
from inspect import get_annotations
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

_Class = TypeVar("_Class", bound=type)


class _ReadOnly:
    """Read-only array or mapping within a state."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        value = self.value
        if not isinstance(value, np.ndarray):
            return _restore_mapping, (_mark(dict(value)),)
        if value.size > 1 and not any(value.strides):
            return np.broadcast_to, (value[(0,) * value.ndim], value.shape)
        return _restore_array, (value,)


def _restore_array(array: NDArray[Any]) -> NDArray[Any]:
    """Return an unpickled array as read-only."""
    array.flags.writeable = False
    return array


def _restore_mapping(items: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    """Return an unpickled dictionary as read-only mapping."""
    return MappingProxyType(_unmark(items))


def _mark(value: Any) -> Any:
    """Replace read-only arrays and mappings in a value and its lists, tuples and dictionaries."""
    if isinstance(value, MappingProxyType) or (type(value) is np.ndarray and not value.flags.writeable):
        return _ReadOnly(value)
    return _replaced(value, _mark)


def _unmark(value: Any) -> Any:
    """Restore read-only arrays and mappings in the state of a shallow copy."""
    return value.value if isinstance(value, _ReadOnly) else _replaced(value, _unmark)


def _replaced(value: Any, replace: Callable[[Any], Any]) -> Any:
    """Return a list, tuple or dictionary with replaced elements, itself if none differs."""
    kind = type(value)
    if kind is dict:
        items = {key: replace(item) for key, item in value.items()}
        return items if any(items[key] is not value[key] for key in items) else value
    if kind in (list, tuple):
        elements = kind(replace(item) for item in value)
        return elements if any(a is not b for a, b in zip(elements, value, strict=True)) else value
    return value


def _own_classes(kind: type) -> list[type]:
    """Return the classes of this package among a class and its bases."""
    package = __name__.partition(".")[0]
    return [base for base in kind.__mro__ if base.__module__.partition(".")[0] == package]


@cache
def _caches(kind: type) -> dict[str, Callable[[], Any] | None]:
    """Return functions that create empty caches by name, None for cached properties."""
    members = [item for base in kind.__mro__ for item in vars(base).items()]
    own_fields = {name for base in _own_classes(kind) for name in get_annotations(base)}
    found: dict[str, Callable[[], Any] | None] = {
        name: None for name, member in members if isinstance(member, cached_property)
    }
    for part in fields(kind) if is_dataclass(kind) else ():
        if part.name in own_fields and part.name.startswith("_") and part.default_factory is not MISSING:
            found[part.name] = part.default_factory
    return found


def _getstate(self: Any) -> dict[str, Any]:
    caches = _caches(self.__class__)
    # By attribute: descriptors check values of mapped files.
    return {name: _mark(getattr(self, name)) for name in vars(self) if name not in caches}


def _setstate(self: Any, state: dict[str, Any]) -> None:
    vars(self).update({name: _unmark(value) for name, value in state.items()})
    vars(self).update({name: create() for name, create in _caches(self.__class__).items() if create is not None})


def copyable(kind: _Class) -> _Class:
    """
    Define the state of a class for pickle and copies; a class decorator.

    Classes that define their own state or have no ``__dict__`` are not changed.
    """
    defined = {name for base in _own_classes(kind) for name in vars(base)}
    has_dict = getattr(kind, "__dictoffset__", 0) != 0
    if has_dict and not defined & {"__getstate__", "__setstate__", "__reduce__", "__reduce_ex__"}:
        for name, method in (("__getstate__", _getstate), ("__setstate__", _setstate)):
            setattr(kind, name, method)
    return kind


def make_copyable(module_name: str) -> None:
    """Apply :func:`copyable` to all public classes of a module, those in its ``__all__``."""
    module = sys.modules[module_name]
    for name in module.__all__:
        item = vars(module).get(name)
        if isinstance(item, type) and not issubclass(item, BaseException | tuple | dict):
            for kind in _own_classes(item):
                if not getattr(kind, "_is_protocol", False):  # a state would be a member that implementations need
                    copyable(kind)

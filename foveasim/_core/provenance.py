"""Provenance of results: settings and versions as plain data."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Collection, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import version
from typing import Any

import numpy as np

from foveasim._core.validation import own
from foveasim._version import __version__

__all__ = ["copy_plain_data", "differences", "is_digest", "to_plain_data", "versions"]

#: Arrays up to this size are stored as lists; larger arrays as shape, dtype and checksum.
MAX_LISTED_VALUES = 64
_ATOMS = frozenset({str, int, float, bool, type(None)})


def to_plain_data(value: Any, *, without: Collection[str] = ()) -> Any:
    """
    Convert an object to plain data: numbers, strings, lists and dicts.

    A dataclass becomes a dict of its class name and public fields, except those in ``without``; a large array becomes its
    shape, dtype and SHA-256.
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
    return repr(value)


def is_digest(value: Any) -> bool:
    """Return whether plain data are the shape, dtype and SHA-256 of an array."""
    return isinstance(value, Mapping) and value.keys() == {"shape", "dtype", "sha256"}


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
    return own(value) if isinstance(value, np.ndarray) else value


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

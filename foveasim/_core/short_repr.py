"""Short representations of objects with arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

import numpy as np

from foveasim.errors import format_value

#: Largest number of characters of a representation, and of the value of one field.
MAX_REPR, MAX_FIELD = 200, 60
#: Largest number of elements of an array that is written as a list.
MAX_LISTED = 3


def short_repr(item: Any) -> str:
    """
    Return a dataclass on one line: fields that are not defaults, arrays as type and shape.

    Classes use it as ``__repr__ = short_repr``.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(eq=False)
    ... class Signal:
    ...     time_s: np.ndarray
    ...     gain: float = 1.0
    ...
    ...     __repr__ = short_repr
    >>> Signal(np.zeros((100, 2)))
    Signal(time_s=float64 (100, 2))
    """
    if is_dataclass(item):
        shown = {f.name: getattr(item, f.name) for f in fields(item) if f.repr and not f.name.startswith("_")}
        at_default = {f.name for f in fields(item) if f.name in shown and _is_default(f, shown[f.name])}
        values = {name: value for name, value in shown.items() if name not in at_default}
    else:
        values = item._asdict()  # a named tuple
    text = f"{type(item).__name__}("
    parts: list[str] = []
    for name, value in values.items():
        part = f"{name}={format_field(value)}"
        if len(text) + sum(map(len, parts)) + 2 * len(parts) + len(part) > MAX_REPR:
            parts.append("...")
            break
        parts.append(part)
    return f"{text}{', '.join(parts)})"


def format_field(value: Any) -> str:
    """
    Return a value in at most 60 characters.

    Large arrays are written as type and shape, other large objects without their parts.
    """
    if isinstance(value, np.ndarray):
        if value.ndim == 1 and value.size <= MAX_LISTED and value.dtype.kind in "biuf":
            return f"[{', '.join(f'{x:.6g}' for x in value.tolist())}]"
        return f"{value.dtype} {value.shape}"
    if isinstance(value, list | tuple) and len(value) > MAX_LISTED:
        return f"{type(value).__name__} of {len(value)}"
    if isinstance(value, Mapping) and len(value) > MAX_LISTED:
        return f"{type(value).__name__} of {len(value)}"
    if isinstance(value, list | tuple):
        inner = ", ".join(map(format_field, value))
        text = f"[{inner}]" if isinstance(value, list) else f"({inner}{',' * (len(value) == 1)})"
    elif isinstance(value, Mapping):
        text = f"{{{', '.join(f'{key!r}: {format_field(part)}' for key, part in value.items())}}}"
    elif value is None or isinstance(value, bool | int | float | str | np.generic):
        return format_value(value.item() if isinstance(value, np.generic) else value, at_most=MAX_FIELD)
    elif callable(value) and hasattr(value, "__name__"):
        text = str(value.__name__)
    else:
        text = format_value(value, at_most=MAX_REPR)
        text = text if len(text) <= MAX_FIELD and "array(" not in text else f"{type(value).__name__}(...)"
    return text if len(text) <= MAX_FIELD else f"{text[: MAX_FIELD - 3]}..."


def _is_default(field: Field[Any], value: Any) -> bool:
    """Return whether a value is the default of its field; empty collections equal None."""
    default = field.default if field.default_factory is MISSING else field.default_factory()
    if default is None and isinstance(value, list | tuple | Mapping):
        return not value
    if default is MISSING or isinstance(value, np.ndarray) or type(value) is not type(default):
        return False
    try:
        return bool(value == default)
    except ValueError:  # sequences with arrays
        return False

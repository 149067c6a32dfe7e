"""
Every error and warning that foveasim raises on purpose.

::

    FoveasimError
    ├── ParameterError   (ValueError)    one value is wrong: .name .value .unit
    ├── GeometryError    (ValueError)    outlines that are no photosites: .site_ids
    ├── FileError        (ValueError)    a file that cannot be read or written: .path
    │   └── ConfigError                  a settings file with a wrong key or value
    └── SimulationError  (RuntimeError)  parts that do not fit together, found while running

    FoveasimWarning (UserWarning)
    ├── SamplingWarning                  the discretisation is coarser than the physics asks for
    ├── CoverageWarning                  photosites lie off the picture
    └── LayoutWarning                    a layout covers less of its field than its parameters ask for

Each message says what is wrong, where, what was got, what was expected, and the hint.
"""

from __future__ import annotations

import errno
import os
import re
import reprlib
from pathlib import Path
from typing import Any

__all__ = [
    "ConfigError",
    "CoverageWarning",
    "FileError",
    "FoveasimError",
    "FoveasimWarning",
    "GeometryError",
    "LayoutWarning",
    "ParameterError",
    "SamplingWarning",
    "SimulationError",
    "disk_problem",
    "printable",
    "shown",
]


#: No value is to be shown; None is a value.
_UNSAID = object()


class FoveasimError(Exception):
    """Base of all errors of the package; they go from process to process as they are."""

    def __init__(self, message: str = "", *, prefix: str = "") -> None:
        super().__init__(prefix + _shortened(message))

    def __reduce__(self) -> tuple[Any, ...]:
        state = dict(self.__dict__)
        if not isinstance(state.get("value"), str | int | float | None):
            state["value"] = shown(state["value"])  # which may be anything
        return _restored, (type(self), self.args, state)


class ParameterError(FoveasimError, ValueError):
    """One parameter has a value that cannot be: raise it where a value enters the package."""

    def __init__(self, name: str, rule: str, value: object = _UNSAID, unit: str = "", hint: str = "") -> None:
        self.name = name
        self.value = None if value is _UNSAID else value
        self.unit = unit
        got = f", got {shown(value)}{' ' + unit if unit else ''}" if value is not _UNSAID else ""
        #: The message without the name.
        self.detail = f"{rule}{got}{'; ' + hint if hint else ''}"
        super().__init__(f"'{name}' {self.detail}")


class GeometryError(FoveasimError, ValueError):
    """Outlines that are no photosites; ``site_ids`` are the positions of the bad ones."""

    def __init__(self, message: str, site_ids: tuple[int, ...] = ()) -> None:
        self.site_ids = site_ids
        super().__init__(message)


class FileError(FoveasimError, ValueError):
    """A file that is missing, broken, of the wrong kind, or too large."""

    def __init__(self, path: str | Path, message: str) -> None:
        self.path = Path(path)
        super().__init__(message, prefix=f"{_without_middle(printable(path), LONGEST_PATH)}: ")


class ConfigError(FileError):
    """A settings file with an unknown key, a wrong type, or an impossible value."""


class SimulationError(FoveasimError, RuntimeError):
    """Parts that are right alone and do not fit together."""


class FoveasimWarning(UserWarning):
    """Base of all warnings of the package."""


class SamplingWarning(FoveasimWarning):
    """The picture or the grid is too coarse or too small for the optics it meets."""


class CoverageWarning(FoveasimWarning):
    """Photosites lie partly or wholly off the map of light and receive less, or nothing."""


class LayoutWarning(FoveasimWarning):
    """A generated layout covers less of its field than its parameters ask for."""


def _restored(kind: type[FoveasimError], args: tuple[Any, ...], state: dict[str, Any]) -> FoveasimError:
    """An error that was pickled: its message is made, and must not be made again."""
    error = kind.__new__(kind)
    error.args = args
    error.__dict__.update(state)
    return error


#: Characters of a value in a message, of a word in one, of a message, and of a file's path before it.
LONGEST_VALUE, LONGEST_WORD, LONGEST_MESSAGE, LONGEST_PATH = 80, 240, 2000, 1000
#: Containers are written out to this depth, with this many elements each: no message costs more than its length.
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlong = 3, 2 * LONGEST_VALUE
_SHORT.maxstring = _SHORT.maxother = LONGEST_VALUE
for _kind in ("tuple", "list", "array", "dict", "set", "frozenset", "deque"):
    setattr(_SHORT, f"max{_kind}", 8)
#: Errors of the system that mean that the disk, and not the data, ended the writing.
DISK_ERRNOS = frozenset(
    getattr(errno, name) for name in ("ENOSPC", "EDQUOT", "EFBIG", "EROFS", "EIO") if hasattr(errno, name)
)


def shown(value: Any, *, at_most: int = LONGEST_VALUE) -> str:
    """
    Return a value as one short line for a message.

    Parameters
    ----------
    value : object
        Of any size and depth.
    at_most : int
        Number of characters.

    Returns
    -------
    text : str
        Printable characters only; what exceeds the limit is replaced by ``...``.
    """
    try:
        text = printable(" ".join(_SHORT.repr(value).split()))
    except Exception:  # noqa: BLE001 -- the repr of any object may raise, and Python rejects very long integers
        return f"one of type {type(value).__name__}"
    return text if len(text) <= at_most else text[: at_most - 3] + "..."


def _shortened(message: str) -> str:
    """Return a message without the middle of what is too long in it, whichever value that came from."""
    words = re.sub(rf"\S{{{LONGEST_WORD + 1},}}", lambda word: _without_middle(word[0], LONGEST_VALUE), message)
    return _without_middle(words, LONGEST_MESSAGE)


def _without_middle(text: str, at_most: int) -> str:
    half = (at_most - 3) // 2
    return text if len(text) <= at_most else f"{text[:half]}...{text[-half:]}"


def printable(text: object, *, keep: str = "") -> str:
    r"""
    Return a text with every character that a terminal does not print as an escape, such as ``\n`` and ``\x1b``.

    Parameters
    ----------
    text : object
        A string or a path, from wherever.
    keep : str
        Characters that stay as they are.

    Returns
    -------
    text : str

    Examples
    --------
    >>> printable("a\nb") == "a" + chr(92) + "nb"
    True
    """
    string = str(text)
    if string.isprintable():
        return string
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode("ascii") for c in string)


def disk_problem(error: BaseException) -> str:
    """
    Return the system's reason when the disk ended the writing: full, over a limit, read-only, failed; else ``""``.

    Libraries wrap the system's error in their own, so causes and contexts are inspected too.
    """
    seen: set[int] = set()
    found: BaseException | None = error
    while found is not None and id(found) not in seen:
        seen.add(id(found))
        # KLayout, Arrow and HDF5 have the number in their messages.
        number = re.search(r"errno ?=? ?(\d+)", str(found))
        for code in (getattr(found, "errno", None), number and int(number[1])):
            if code is not None and code in DISK_ERRNOS:
                return os.strerror(code)
        found = found.__cause__ or found.__context__
    return ""

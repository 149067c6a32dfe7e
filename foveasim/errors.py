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

Each message says what is wrong, where, what was got, what was expected, and the cure.
"""

from __future__ import annotations

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
]


#: No value is to be shown; None is a value.
_UNSAID = object()


class FoveasimError(Exception):
    """Base of all errors of the package; they go from process to process as they are."""

    def __reduce__(self) -> tuple[Any, ...]:
        state = dict(self.__dict__)
        if not isinstance(state.get("value"), str | int | float | None):
            state["value"] = _shown(state["value"])  # which may be anything
        return _restored, (type(self), self.args, state)


class ParameterError(FoveasimError, ValueError):
    """One parameter has a value that cannot be: raise it where a value enters the package."""

    def __init__(self, name: str, rule: str, value: object = _UNSAID, unit: str = "", cure: str = "") -> None:
        self.name = name
        self.value = None if value is _UNSAID else value
        self.unit = unit
        got = f", got {_shown(value)}{' ' + unit if unit else ''}" if value is not _UNSAID else ""
        #: All of the message but the name.
        self.told = f"{rule}{got}{'; ' + cure if cure else ''}"
        super().__init__(f"'{name}' {self.told}")


class GeometryError(FoveasimError, ValueError):
    """Outlines that are no photosites; ``site_ids`` are the positions of the bad ones."""

    def __init__(self, message: str, site_ids: tuple[int, ...] = ()) -> None:
        self.site_ids = site_ids
        super().__init__(message)


class FileError(FoveasimError, ValueError):
    """A file that is missing, broken, of the wrong kind, or too large."""

    def __init__(self, path: str | Path, message: str) -> None:
        self.path = Path(path)
        super().__init__(f"{path}: {message}")


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


def _shown(value: Any) -> str:
    """Short text of a value for a message."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # noqa: BLE001 -- any object may fail to tell what it is, and Python refuses very long numbers
        return f"one of type {type(value).__name__}"
    return text if len(text) <= 80 else text[:77] + "..."

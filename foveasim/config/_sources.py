"""Origin of settings for messages: file and position, key, or command line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from foveasim._io.yaml_files import position_of
from foveasim.errors import ConfigError, ParameterError


@dataclass(frozen=True, kw_only=True)
class Source:
    """
    Origin of settings.

    Parameters
    ----------
    file : Path, optional
        YAML file; None for settings from Python.
    keys : tuple of str
        Path of the settings in the file, such as ``("shot",)`` for a shot in the file of a sweep.
    index : str
        Index of one value in a list of values, which only determines the position.
    replaced : mapping of str to Source or str
        Other origins of settings, by their path: their source, or a name such as ``--set``.
    """

    file: Path | None = None
    keys: tuple[str, ...] = ()
    index: str = ""
    replaced: Mapping[str, Source | str] = field(default_factory=dict)

    @classmethod
    def of(cls, source: Source | str | Path | None) -> Source:
        """Return the source of a file; None is that of settings from Python."""
        if isinstance(source, Source):
            return source
        return cls(file=None if source is None else Path(source))

    @property
    def directory(self) -> Path:
        """Directory of relative paths."""
        return Path() if self.file is None else self.file.parent

    @property
    def name(self) -> str:
        """Name of a shot with these settings."""
        return "shot" if self.file is None else self.file.stem

    def absolute(self) -> Source:
        """Return the source with an absolute path of its file."""
        return self if self.file is None else replace(self, file=self.file.absolute())

    def at(self, *keys: str) -> Source:
        """Return the source of a section."""
        return replace(self, keys=(*self.keys, *keys))

    def with_replaced(self, replaced: Mapping[str, Source | str]) -> Source:
        """Return the source with other origins of some settings."""
        return replace(self, replaced={**self.replaced, **replaced})

    def error(self, key_path: str | tuple[str, ...], problem: str) -> ConfigError:
        """Return an error about a setting, such as ``"sensor.bits"``, with its position."""
        is_path = isinstance(key_path, tuple) and all(isinstance(key, str) for key in key_path)
        if not is_path and not isinstance(key_path, str):
            raise ParameterError("key_path", "must be a text such as 'sensor.bits', or a tuple of keys", key_path)
        parts = tuple(key_path) if is_path else tuple(re.findall(r"[^.\[\]]+", str(key_path)))
        name = ".".join(parts) if is_path else str(key_path)
        for n in range(len(parts), 0, -1):
            origin = self.replaced.get(".".join(parts[:n]))
            if isinstance(origin, str):
                return ConfigError(self.file, f"{origin} {name}: {problem}")
            if origin is not None:
                return origin.error(parts[n:], problem)
        keys = (*self.keys, *([self.index] if self.index else []), *parts)
        if self.file is None or position_of(self.file, keys, is_exact=True) is None:
            # A section that exists only because one of its settings is replaced.
            below = next((path for path in self.replaced if path.startswith(f"{name}.")), None)
            if below is not None:
                return self.error(below, problem)
        shown = ".".join((*self.keys, *([name] if name else [])))
        position = None if self.file is None else position_of(self.file, keys)
        return ConfigError(self.file, f"{shown}: {problem}" if shown else problem, position=position)

"""Recent settings files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from foveasim._io.yaml_files import read_yaml
from foveasim.config import YAML_EXTENSIONS
from foveasim.errors import ConfigError
from foveasim.studio._files import Files

#: Number of files that are listed, and that are read to find them.
MAX_LISTED, MAX_READ = 12, 100


def recent_files(files: Files, directories: list[Path]) -> list[dict[str, Any]]:
    """
    Return the settings files of shots in directories, the newest first.

    ``files``: those that settings may contain; others, such as hidden files, are not listed. Returns name, path, directory and
    time of the last change (s since 1970) of each.
    """
    dated = []
    for path in {path for directory in directories for path in _yaml_files(directory)}:
        try:
            dated.append((path.stat().st_mtime, path))
        except OSError:  # deleted meanwhile
            continue
    newest = sorted((each for each in dated if files.allows(each[1])), reverse=True)[:MAX_READ]
    found = [(time_s, path) for time_s, path in newest if _is_shot(path)][:MAX_LISTED]
    return [
        {"name": path.name, "path": str(path), "directory": path.parent.name, "time_s": time_s}
        for time_s, path in found
    ]


def _yaml_files(directory: Path) -> Iterator[Path]:
    try:
        yield from (path for path in directory.iterdir() if path.suffix.lower() in YAML_EXTENSIONS)
    except OSError:  # deleted, or not readable
        return


def _is_shot(path: Path) -> bool:
    """Return whether a file contains settings of a shot, unlike those of sweeps or layouts."""
    try:
        settings = read_yaml(path)
    except ConfigError:
        return False
    return isinstance(settings, dict) and "scene" in settings

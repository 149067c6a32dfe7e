"""Files of sweeps for the command ``foveasim sweep``."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from foveasim._io.yaml_files import format_yaml
from foveasim.config import RegionResult, get_setting, put_setting
from foveasim.explore.sweeps.plan import OF_SHOT, copy_settings
from foveasim.studio._exports import note_of_files, without_directories
from foveasim.studio._settings.changes import changed_keys
from foveasim.studio._sweeps.request import Axis


def sweep_file(
    base: dict[str, Any],
    points: Sequence[dict[str, Any]],
    axes: Sequence[Axis],
    results: Sequence[RegionResult],
    directories: Sequence[Path],
) -> tuple[str, list[str]]:
    """
    Return a file whose points have the given settings, and the uploaded files of these.

    ``base``: settings that the points change. ``points``: settings in the order of all combinations of the values.
    ``directories``: those of uploaded files. The files are names; they must be next to the file.
    """
    named, files = without_directories({"shot": base, "points": list(points)}, directories, {}, lambda file: file.name)
    base, points = named["shot"], named["points"]
    content = {
        **_varied(base, points, axes),
        "results": {name: _given(result) for name, result in _names(results).items()},
        "seed": OF_SHOT,
        "shot": base,
    }
    labels = " and ".join(str(axis.control["label"]) for axis in axes)
    head = f"# Sweep of {labels}, with the seed of the shot in all points. Run it with\n#     foveasim sweep FILE\n"
    return head + note_of_files(list(files)) + format_yaml(content), list(files)


def _varied(base: dict[str, Any], points: Sequence[dict[str, Any]], axes: Sequence[Axis]) -> dict[str, Any]:
    """Return the values by setting, or the changes of all points if others follow."""
    values = {axis.key: list(axis.values) for axis in axes}
    combinations = itertools.product(*values.values())
    if all(point == _with(base, values, chosen) for point, chosen in zip(points, combinations, strict=True)):
        return {"vary": values}
    paths = _changed_paths(base, points)
    return {"points": [{path: get_setting(point, path) for path in paths} for point in points]}


def _with(base: dict[str, Any], keys: Mapping[str, Any], chosen: Sequence[Any]) -> dict[str, Any]:
    found: dict[str, Any] = copy_settings(base)
    for key, value in zip(keys, chosen, strict=True):
        put_setting(None, found, key, value)
    return found


def _changed_paths(base: dict[str, Any], points: Sequence[dict[str, Any]]) -> list[str]:
    """Return the paths of values that differ, or of sections around missing ones."""
    paths = dict.fromkeys(key for point in points for key in changed_keys(point, base))
    found = dict.fromkeys(_common_path(path, points) for path in paths)
    return [path for path in found if not any(path.startswith(f"{other}.") for other in found)]


def _common_path(path: str, points: Sequence[dict[str, Any]]) -> str:
    """Return the path of a value, or of the innermost section around it that all points have."""
    while "." in path and any(get_setting(point, path) is None for point in points):
        path = path.rpartition(".")[0]
    return path


def _names(results: Sequence[RegionResult]) -> dict[str, RegionResult]:
    """Return results by names that are not those of settings."""
    measures = [result.measure for result in results]
    is_unique = len(set(measures)) == len(measures)
    names = [
        f"result_{measure}" if is_unique else f"result_{number}_{measure}" for number, measure in enumerate(measures, 1)
    ]
    return dict(zip(names, results, strict=True))


def _given(result: RegionResult) -> dict[str, Any]:
    """Return the parameters of a result that are not defaults."""
    found = {name: value for name, value in asdict(result).items() if value is not None}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in found.items()}

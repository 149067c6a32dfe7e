"""Origins of a sensor's values: presets, data sheets, and twins of cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from foveasim._io.npz import archive_format
from foveasim.config._sources import Source
from foveasim.errors import FoveasimError, ParameterError
from foveasim.layout import Layout
from foveasim.layout.files import check_no_options, read_layout
from foveasim.sensor import PRESETS, DataSheet, Sensor, read_datasheet
from foveasim.sensor.published.presets import with_changes
from foveasim.twin.frames.result import FILE_FORMAT, Twin, read_twin

__all__ = ["ELECTRONICS", "read_twin_or_sites", "sensor_maker", "values_of_twin", "with_electronics"]

#: Keys of a sensor with the origin of its values, which its other keys replace.
ELECTRONICS = ("preset", "datasheet", "twin")


def sensor_maker(
    source: Source, section: Any, cache: Callable[[str, Any, Callable[[], Any]], Any]
) -> Callable[..., Sensor]:
    """Return the call that makes the sensor of a section from its layout and the other keys."""
    given = [name for name in ELECTRONICS if getattr(section, name) is not None]
    if len(given) > 1:
        others = " and ".join(f"'{name}'" for name in given[:-1])
        raise source.error(f"sensor.{given[-1]}", f"must not be given together with {others}; remove one of them")
    match given:
        case ["preset"]:
            return partial(Sensor.from_preset, preset=section.preset)
        case ["datasheet"]:
            return partial(Sensor.from_datasheet, sheet=_sheet_of(source, section.datasheet))
        case ["twin"]:
            twin: Twin = cache("twin", section.twin, lambda: _twin_of(source, section.twin))
            return twin.sensor
    return Sensor


def _sheet_of(source: Source, path: str) -> DataSheet:
    """Return the data sheet of a file in settings; errors have the lines of both files."""
    file = source.directory / path
    try:
        return read_datasheet(file)
    except ParameterError as error:
        raise source.error("sensor.datasheet", str(Source.of(file).error(error.name, error.detail))) from None
    except FoveasimError as error:
        raise source.error("sensor.datasheet", str(error)) from None


def _twin_of(source: Source, path: str) -> Twin:
    """Return the twin of a file in settings."""
    try:
        return read_twin(source.directory / path)
    except FoveasimError as error:
        raise source.error("sensor.twin", str(error)) from None


def read_twin_or_sites(path: Path, **options: Any) -> Layout:
    """Return the pixels of a twin, or the photosites of another file."""
    if archive_format(path) != FILE_FORMAT:
        return read_layout(path, **options)
    check_no_options(**{name: value for name, value in options.items() if name != "centre"})
    return read_twin(path).layout()


def values_of_twin(sensor: Any) -> dict[str, Any]:
    """Return the numbers and names of the twin in a sensor's settings, if there is one."""
    path = sensor.get("twin") if isinstance(sensor, Mapping) else None
    try:
        return {} if not isinstance(path, str) else _stored_values(path, Path(path).stat().st_mtime_ns)
    except (FoveasimError, OSError, ValueError):
        return {}


@lru_cache(maxsize=4)
def _stored_values(path: str, _time_ns: int) -> dict[str, Any]:
    found = read_twin(path).sensor(maps=False)
    values = {each.name: getattr(found, each.name) for each in fields(found)}
    return {name: value for name, value in values.items() if isinstance(value, int | float | str)}


def with_electronics(source: Source | str | Path | None, sensor: Any) -> Any:
    """
    Return the settings of a sensor with the values of its preset or data sheet.

    For sites without readout lines. The maps of a twin remain in its file. Settings that :func:`build_shot` rejects are
    returned unchanged.
    """
    if not isinstance(sensor, Mapping):
        return sensor
    given = [name for name in ELECTRONICS if sensor.get(name) is not None]
    if len(given) != 1 or given == ["twin"] or not isinstance(origin := sensor[given[0]], str):
        return sensor
    if given == ["preset"] and origin not in PRESETS:
        return sensor
    electronics = PRESETS[origin] if given == ["preset"] else _sheet_of(Source.of(source), origin)
    others = {name: value for name, value in sensor.items() if name not in ELECTRONICS}
    return with_changes(electronics.settings(), others)

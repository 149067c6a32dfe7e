"""New files of a sensor: a data sheet, and a shot that uses it, or the twin of a camera."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from foveasim._core.calls.docstrings import Docstring
from foveasim._core.names import did_you_mean
from foveasim._io.atomic import atomic_write
from foveasim._io.yaml_files import format_yaml, parse_yaml
from foveasim.config._starting_files import starting_file
from foveasim.errors import ConfigError, FileError, ParameterError
from foveasim.sensor import DataSheet
from foveasim.sensor.published.datasheet import QUANTITIES, _range_of
from foveasim.twin.frames.result import read_twin

#: Quantities that are asked for, the more common ones first; others are keys of the file.
ASKED = (
    "title", "source", "pixel_um", "bits", "qe_percent", "wavelength_nm", "gain_dn_per_e", "inverse_gain_e_per_dn",
    "dark_noise_e", "threshold_ph", "saturation_e", "full_well_e", "snr_max_db", "dynamic_range_db", "dsnu_e", "prnu_percent",
    "linearity_error_min_percent", "dark_current_e_per_s", "temperature_k", "black_level_dn",
)  # fmt: skip
REQUIRED = ("pixel_um", "bits")
#: Values of any type: texts keep the printed digits of numbers.
TEXTS = ("title", "source", "shutter")
#: The section of the sensor in the commented shot.
SENSOR = re.compile(r"^sensor:\n(?: +.*\n)+", re.MULTILINE)
HEADER = "# Data sheet in the terms of EMVA 1288, as printed. Other keys: foveasim.sensor.DataSheet.\n"


def write_sensor_files(
    quantities: Mapping[str, Any], path: str | Path | None = None, *, force: bool = False
) -> tuple[Path, Path]:
    """
    Write a data sheet, and a commented shot whose sensor has its values.

    Parameters
    ----------
    quantities : mapping of str to object
        Parameters of :class:`foveasim.sensor.DataSheet`; numbers as text keep their printed digits.
    path : path, optional
        Settings file of the shot, by default ``sensor.yaml`` in the working directory. The name of the data sheet ends in
        ``_datasheet.yaml``.
    force : bool
        Whether to replace existing files.

    Returns
    -------
    sheet, shot : Path
        Both files, which are written atomically.

    Raises
    ------
    ParameterError
        When the quantities are not those of a valid data sheet.
    FileError
        When a file exists, or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> quantities = {
    ...     "pixel_um": "2.25",
    ...     "bits": 12,
    ...     "qe_percent": "91.25",
    ...     "dark_noise_e": "5.560",
    ...     "saturation_e": 9458,
    ... }
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     sheet, shot = fs.config.write_sensor_files(
    ...         quantities, Path(directory, "imx900.yaml")
    ...     )
    ...     sheet.name, fs.config.read_shot(shot).camera.sensor.read_noise_e
    ('imx900_datasheet.yaml', 5.56)
    """
    checked_datasheet(quantities)
    shot = Path("sensor.yaml" if path is None else path)
    sheet = shot.with_name(f"{shot.stem}_datasheet.yaml")
    section = (
        f"  datasheet: {sheet.name:<24} # values of a data sheet, which other keys replace\n"
        "  filters: rgb                       # colour filters of the mosaic; omit it without filters\n"
    )
    _write({sheet: HEADER + format_yaml(dict(quantities)), shot: _shot_with(section)}, force=force)
    return sheet, shot


def write_shot_of_twin(twin: str | Path, path: str | Path | None = None, *, force: bool = False) -> Path:
    """
    Write a commented shot with the sensor of a camera's twin, and return its path.

    ``path``: by default ``sensor.yaml`` in the working directory. Raises FileError when the file exists or cannot be written,
    or is not a twin.
    """
    shot = Path("sensor.yaml" if path is None else path)
    name = json.dumps(os.path.relpath(twin, shot.parent), ensure_ascii=False)  # quoted for YAML, too
    section = (
        f"  twin: {name:<28} # values of a camera, which other keys replace\n"
        "                                     # without the section layout: this camera, with the maps of its pixels\n"
    )
    if not any(each.startswith("qe") for each in read_twin(twin).estimates):
        section += "  qe: {kind: silicon, depth_um: 3.0} # which the frames do not determine: they have no photons\n"
    _write({shot: _shot_with(section)}, force=force)
    return shot


def _shot_with(section: str) -> str:
    """Return the commented shot with other lines of its sensor."""
    return SENSOR.sub(lambda _: f"sensor:\n{section}", starting_file("shot"), count=1)


def _write(texts: Mapping[Path, str], *, force: bool) -> None:
    """Write files, unless one exists."""
    for file in texts:
        if file.exists() and not force:
            raise FileError(file, "exists already; choose another file with --out, or replace it with --force")
    for file, text in texts.items():
        with atomic_write(file) as temporary:
            temporary.write_text(text, encoding="utf-8")


def quantities_of(changes: Sequence[str]) -> dict[str, Any]:
    """Return the quantities of texts "key=value"; numbers stay texts."""
    found: dict[str, Any] = {}
    for change in changes:
        key, equals, value = (part.strip() for part in change.partition("="))
        names = [each.name for each in fields(DataSheet)]
        if not equals:
            raise ConfigError(None, f"--set must be 'key=value', such as dark_noise_e=5.56, got '{change}'")
        if key not in names:
            raise ParameterError(key, "must be a quantity of a data sheet", hint=did_you_mean(key, names))
        found[key] = _value_of(key, value)
    return found


def asked_quantities(ask: Callable[[str], str], report: Callable[[str], None]) -> dict[str, Any]:
    """
    Return the quantities that a user gives, one after the other.

    ``ask``: returns the answer to a question, empty for a quantity that is not in the sheet. ``report``: prints an error, after
    which the question is repeated.
    """
    described = Docstring.of(DataSheet).parameters
    found: dict[str, Any] = {}
    names = list(ASKED)
    while True:
        name = names.pop(0)
        answer = ask(f"{name} ({_first_words(described.get(name, ''))})").strip()
        found.pop(name, None)
        try:
            if answer:
                found[name] = _value_of(name, answer)
                _check(name, found)
            elif name in REQUIRED:
                raise ParameterError(name, "must be in the data sheet")
            if not names:
                checked_datasheet(found)
                return found
        except ParameterError as error:
            report(str(error))
            names.insert(0, error.name if error.name in ASKED else name)


def checked_datasheet(quantities: Mapping[str, Any]) -> DataSheet:
    """Return the data sheet of quantities, or raise a ParameterError."""
    for name in REQUIRED:
        if name not in quantities:
            raise ParameterError(name, "must be in the data sheet")
    return DataSheet(**quantities)


def _check(name: str, found: Mapping[str, Any]) -> None:
    """Check one quantity, apart from others."""
    example = {"pixel_um": 1.0, "bits": 16, "dark_noise_e": 1.0, "saturation_e": 1000.0}
    if name in QUANTITIES:
        _range_of(name, found[name])
    elif name == "bits":
        DataSheet(**example | {name: found[name]})


def _value_of(name: str, text: str) -> Any:
    """Return the value of a quantity: texts and numbers as text, others as in YAML."""
    return text if name in TEXTS or name in QUANTITIES else parse_yaml(Path("--set"), text)


def _first_words(description: str) -> str:
    """Return the beginning of a description, up to the first colon, semicolon or full stop."""
    return re.split(r"[:;.]( |$)", description, maxsplit=1)[0]

"""Registry of cube formats, and reading in the sandbox process."""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from foveasim._core.registry import Registry
from foveasim._io.formats import FileFormat, as_file_error, detect_format
from foveasim._io.rasters import read_raster
from foveasim._io.sandbox import ReaderResult
from foveasim.errors import ParameterError
from foveasim.scene.cubes._cube import Cube
from foveasim.scene.cubes._selection import Selection, select

#: Formats of hyperspectral cubes. ``read(path, name)`` returns a :class:`foveasim.scene.Cube`. Installed packages add formats
#: as entry points of the group ``foveasim.cube_formats``.
CUBE_FORMATS: Registry[FileFormat] = Registry("cube format", "foveasim.cube_formats")
#: Key of the result of the sandbox process for an argument that the file makes invalid.
INVALID = "invalid_argument"


def read_cube(path: Path, name: str | None, selection: Selection) -> Cube:
    """
    Read the selected part of a cube, in the sandbox process if the format requires it.

    ``name``: name of the variable, if there are several. Returns the cube as :func:`select` does. Raises FileError if the
    file is corrupt, malformed, too large, or not a cube, and ParameterError if the selection is inconsistent with it.
    """
    kind, form = detect_format(path, CUBE_FORMATS, "hyperspectral cube")
    if not form.is_sandboxed:
        return _read_selected(form, path, name, selection)
    metadata, arrays = read_raster(form, _read_plain, path, format_name=kind, name=name, selection=asdict(selection))
    if INVALID in metadata:
        raise ParameterError(*metadata[INVALID])
    return Cube(data=arrays[0], **metadata)


def _read_selected(form: FileFormat, path: Path, name: str | None, selection: Selection) -> Cube:
    assert form.read is not None
    cube: Cube = form.read(path, name)
    try:
        return select(cube, selection)
    finally:
        if cube.close is not None:
            cube.close()


def _read_plain(path: str, format_name: str, name: str | None, selection: dict[str, Any]) -> ReaderResult:
    """Return the selected part of a cube as plain data and an array."""
    with as_file_error(Path(path), "hyperspectral cube", passes=(ParameterError,)):
        try:
            cube = _read_selected(CUBE_FORMATS[format_name], Path(path), name, Selection(**selection))
        except ParameterError as error:
            return {INVALID: [error.name, error.detail]}, []
        data, plain = cube.data, replace(cube, data=None, close=None)
        metadata = {field.name: getattr(plain, field.name) for field in fields(plain)}
        del metadata["data"], metadata["close"]
        return {key: v.tolist() if isinstance(v, np.ndarray) else v for key, v in metadata.items()}, [data]

"""Registry of power map formats, and reading in the sandbox process."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.registry import Registry
from foveasim._io.formats import FileFormat, as_file_error
from foveasim._io.rasters import as_images, read_raster
from foveasim.errors import ParameterError
from foveasim.maps._common import Found

#: Formats of power maps. ``read(path, name)`` returns a :class:`foveasim.maps.Found`, ``write(power_map, path)`` None.
#: Installed packages add formats as entry points of the group ``foveasim.map_formats``.
MAP_FORMATS: Registry[FileFormat] = Registry("power map format", "foveasim.map_formats")


def read_found(path: Path, kind: str, name: str | None) -> Found:
    """
    Read data and metadata of a file, in the sandbox process if the format requires it.

    ``kind``: name in :data:`MAP_FORMATS`. ``name``: name of the array, if there are several. Raises FileError if the file
    is corrupt, malformed, too large, or not a map.
    """
    metadata, (data,) = read_raster(MAP_FORMATS[kind], _read, path, format_name=kind, name=name)
    about: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in metadata.items()}
    return Found(data=data, **about)


def _read(path: str, format_name: str, name: str | None) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Return the result of a reader as plain data and arrays, for transfer between processes."""
    form = MAP_FORMATS[format_name]
    assert form.read is not None
    with as_file_error(Path(path), "power map", passes=(ParameterError,)):
        found: Found = form.read(Path(path), name)
        metadata = asdict(replace(found, data=np.empty(0)))
        del metadata["data"]
        return metadata, [as_images(found.data)]

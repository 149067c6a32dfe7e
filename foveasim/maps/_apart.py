"""Maps through libraries that a broken file can crash: their readers, and what they find in a program of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._io import sandbox
from foveasim.maps import _dataset, _exr, _isetcam
from foveasim.maps._common import Found, Refusal, as_images, max_unpacked, one_sentence

__all__ = ["READERS", "read_apart"]

#: By the kind of file.
READERS: dict[str, Callable[[Path, str | None], Found]] = {
    "EXR": _exr.read,
    "netCDF": _dataset.read_netcdf,
    "zarr": _dataset.read_zarr,
    "MAT": _isetcam.read_mat5,
    "MAT 7.3": _isetcam.read_mat73,
}


def read_apart(path: Path, kind: str, name: str | None) -> Found:
    """
    What a file holds.

    Parameters
    ----------
    path : Path
    kind : {"EXR", "netCDF", "zarr", "MAT", "MAT 7.3"}
    name : str, optional
        Of the array, where there are several.

    Raises
    ------
    FileError
        When it is broken, hostile, too large, or no map.
    """
    # OpenEXR prints what it could not read, and may go on without it.
    told, data = sandbox.read_apart(
        _read, path, kind, name, kind=kind, max_unpacked=max_unpacked, is_silent=kind == "EXR"
    )
    about: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in told.items()}
    return Found(data=data, **about)


def _read(path: Path, kind: str, name: str | None) -> tuple[dict[str, Any], NDArray[Any]]:
    """What a reader finds, taken apart for its way between the programs."""
    with one_sentence(path):
        try:
            found = READERS[kind](path, name)
        except ModuleNotFoundError as error:
            raise Refusal(f"needs {error.name}; install it with: pip install 'foveasim[maps]'") from None
        told = asdict(replace(found, data=np.empty(0)))
        del told["data"]
        return told, as_images(found.data)

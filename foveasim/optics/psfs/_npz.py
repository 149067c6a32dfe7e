"""
PSFs in ``.npz`` files.

Arrays as for :meth:`foveasim.optics.PSFGrid.from_arrays`: ``psf``, ``x_um``, ``y_um``, ``wavelength_nm``, ``pitch_um``, and as
options ``image``, ``first_row``, ``samples``, ``centre``, ``relative_illumination``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.npz import read_archive, write_archive
from foveasim.optics.psfs._formats import CHOICES, PSF_FORMATS, choices_of, require
from foveasim.optics.psfs._grid import MAX_VALUES, PSFGrid

REQUIRED = ("psf", "x_um", "y_um", "wavelength_nm", "pitch_um")
OPTIONAL = (*CHOICES, "centre", "relative_illumination")


def read(path: Path) -> PSFGrid:
    """Read arrays by name."""
    _, arrays = read_archive(path, max_bytes=8 * MAX_VALUES)
    require(arrays, REQUIRED)
    unknown = sorted(set(arrays) - {*REQUIRED, *OPTIONAL})
    if unknown:
        raise FormatError(f"has the unknown array {unknown[0]!r:.40}; expected {', '.join((*REQUIRED, *OPTIONAL))}")
    options: dict[str, Any] = choices_of({name: arrays.pop(name) for name in CHOICES if name in arrays})
    if "centre" in arrays:
        options["centre"] = pair(arrays.pop("centre"))
    if np.size(arrays["pitch_um"]) != 1:
        raise FormatError(f"must have one 'pitch_um', got {np.size(arrays['pitch_um'])}")
    pitch_um = float(arrays.pop("pitch_um").reshape(()))
    return PSFGrid.from_arrays(pitch_um=pitch_um, **{**arrays, **options})


def pair(centre: Any) -> tuple[int, int]:
    """Return the indices of a centre, or raise a FormatError."""
    found = np.asarray(centre)
    if found.shape != (2,) or found.dtype.kind not in "iu":
        raise FormatError("must have two integers (row, column) as 'centre'")
    return int(found[0]), int(found[1])


def write(psfs: PSFGrid, path: Path) -> None:
    """Write the arrays of the upright picture."""
    arrays = {name: np.asarray(getattr(psfs, name)) for name in (*REQUIRED, "samples")}
    if psfs.relative_illumination is not None:
        arrays["relative_illumination"] = psfs.relative_illumination
    write_archive(path, {"format": "foveasim PSFs", "version": 1}, arrays)


PSF_FORMATS.register(
    "npz", FileFormat(title="npz", suffixes=(".npz",), signatures=(b"PK\x03\x04",), read=read, write=write)
)

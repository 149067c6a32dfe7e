"""
PSFs in ``.npz`` files.

Arrays as for :meth:`foveasim.optics.PSFGrid.from_arrays`: ``psf``, ``x_um``, ``y_um``, ``wavelength_nm``, ``pitch_um`` or the
coordinates ``sample_x_um`` and ``sample_y_um``, and as options ``image``, ``first_row``, ``samples``, ``centre``,
``relative_illumination``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from foveasim._io.formats import FileFormat, FormatError
from foveasim._io.npz import read_archive, write_archive
from foveasim.optics.psfs._formats import CHOICES, PSF_FORMATS, choices_of, require
from foveasim.optics.psfs._grid import CENTRES, MAX_VALUES, PSFGrid

REQUIRED = ("psf", "x_um", "y_um", "wavelength_nm")
OPTIONAL = ("pitch_um", "sample_x_um", "sample_y_um", *CHOICES, "centre", "relative_illumination")


def read(path: Path, *, centre: Any = None) -> PSFGrid:
    """Read arrays by name."""
    _, arrays = read_archive(path, max_bytes=8 * MAX_VALUES)
    require(arrays, (*REQUIRED, *(("pitch_um",) if "sample_x_um" not in arrays else ())))
    unknown = sorted(set(arrays) - {*REQUIRED, *OPTIONAL})
    if unknown:
        raise FormatError(f"has the unknown array {unknown[0]!r:.40}; expected {', '.join((*REQUIRED, *OPTIONAL))}")
    options: dict[str, Any] = choices_of({name: arrays.pop(name) for name in CHOICES if name in arrays})
    own = arrays.pop("centre", None)
    options["centre"] = centre if centre is not None or own is None else _centre(own)
    if "pitch_um" in arrays:
        arrays["pitch_um"] = (
            arrays["pitch_um"].ravel() if arrays["pitch_um"].size > 1 else arrays["pitch_um"].reshape(())
        )
    return PSFGrid.from_arrays(**{**arrays, **options})


def _centre(centre: Any) -> Any:
    """Return a centre, (row, column) or a name, or raise a FormatError."""
    found = np.asarray(centre)
    if found.shape == () and found.dtype.kind == "U" and str(found) in CENTRES:
        return str(found)
    if found.shape != (2,) or found.dtype.kind not in "iuf":
        raise FormatError("must have two numbers (row, column), 'fft' or 'middle' as 'centre'")
    return float(found[0]), float(found[1])


def write(psfs: PSFGrid, path: Path) -> None:
    """Write the arrays of the upright picture."""
    arrays = {name: np.asarray(getattr(psfs, name)) for name in (*REQUIRED, "pitch_um", "samples", "centre")}
    if psfs.relative_illumination is not None:
        arrays["relative_illumination"] = psfs.relative_illumination
    write_archive(path, {"format": "foveasim PSFs", "version": 1}, arrays)


PSF_FORMATS.register(
    "npz",
    FileFormat(
        title="npz", suffixes=(".npz",), signatures=(b"PK\x03\x04",), read=read, write=write, read_options=("centre",)
    ),
)

"""
Optical images of ISETCam and ISETBio in MAT files: the struct ``oi``, or its fields.

``data.photons`` (row, column, wave) are photons/(s m² nm), top row first; ``spectrum.wave`` is in nm. The image is centred on
the axis, its samples are square, and its width is ``2 f tan(wAngular / 2)`` with the focal length f (``oiGet(oi, 'width')``
since November 2021; earlier versions used the image distance).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from foveasim._io.rasters.mat import IsetStruct, MatFile, find_struct, register_mat
from foveasim.fields import PowerMap, from_file_rows
from foveasim.maps._common import Found
from foveasim.maps._formats import MAP_FORMATS
from foveasim.units import photon_energy_j

#: Names of the struct in files of scripts and of vcExportObject.
NAMES = ("oi", "opticalimage", "opticalImage")


def _read(file: MatFile, name: str | None) -> Found:
    image = find_struct(file, name, NAMES, "optical image", "oiCompute")
    pitch = _pitch_um(image)
    return Found(
        data=from_file_rows(image.photons),  # bottom row first
        pitch_um=None if pitch is None else (pitch, pitch),
        wavelength_nm=image.wavelength_nm,
        band_width_nm=image.band_width_nm,
        unit="photons_s_m2_nm",
    )


def _pitch_um(image: IsetStruct) -> float | None:
    """Return the side of a cell from the field of view; None without angle or focal length."""
    angle_deg, focal_m = image.number("wAngular"), image.number("optics/focalLength")
    if image.text("optics/model") == "raytrace":
        focal_mm = image.number("optics/rayTrace/effectiveFocalLength")
        focal_m = None if focal_mm is None else focal_mm * 1e-3
    if angle_deg is None or focal_m is None or not 0.0 < angle_deg < 180.0 or not focal_m > 0.0:
        return None
    return 2.0 * focal_m * math.tan(math.radians(0.5 * angle_deg)) / image.photons.shape[1] * 1e6


def _example(write: Callable[[Path, Mapping[str, Any]], None], path: Path) -> PowerMap:
    """Write an optical image of 3 x 2 cells of 2 µm: 90 degrees, focal length 3 µm."""
    waves_nm = np.array([500.0, 510.0])
    photons = np.array([[[1, 2], [3, 4], [5, 6]], [[7, 8], [9, 10], [11, 12]]]) * 1e18
    image = {"data": {"photons": photons}, "spectrum": {"wave": waves_nm[:, np.newaxis]}, "wAngular": 90.0}
    write(
        path, {"oi": {"type": "opticalimage", "optics": {"focalLength": 3e-6, "model": "diffractionlimited"}, **image}}
    )
    data_w_m2 = np.moveaxis(photons, 2, 0)[:, ::-1] * (10.0 * photon_energy_j(waves_nm))[:, np.newaxis, np.newaxis]
    return PowerMap.from_array(data_w_m2, pitch_um=2.0, wavelength_nm=waves_nm)


register_mat(MAP_FORMATS, _read, _example)

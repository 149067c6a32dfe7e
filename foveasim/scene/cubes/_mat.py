"""
Cubes in MAT files: scenes of ISETCam, and arrays (row, column, band), top row first.

A scene is the struct ``scene`` or its fields: ``data.photons`` are photons/(s m² sr nm), ``spectrum.wave`` is in nm,
``wAngular`` is the horizontal field of view in degrees, and ``distance`` is in m.

Otherwise the cube is the only array of three dimensions, or the one with the given name. Wavelengths in nm are the variable
``wavelengths``, ``wave``, ``bands`` or another usual name; if only the first axis has as many elements, it is that of the
bands. A variable ``unit`` or ``units`` contains the unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from foveasim._core.names import possible_names
from foveasim._core.validation import Floats
from foveasim._io.formats import FormatError
from foveasim._io.rasters.mat import MatFile, find_struct, register_mat
from foveasim.scene.cubes._cube import EXAMPLE_NM, EXAMPLE_UNIT, Cube, example_radiance
from foveasim.scene.cubes._formats import CUBE_FORMATS

SCENE = ("scene",)
WAVELENGTHS = (
    *("wavelength_nm", "wavelengths_nm", "wavelengths", "wavelength", "waves", "wave", "wl", "lambda", "lambdas"),
    *("bands", "band", "wavelist"),
)
UNITS = ("unit", "units")
ISET_UNIT = "photons s-1 m-2 sr-1 nm-1"


def _read(file: MatFile, name: str | None) -> Cube:
    is_struct = {n for n in file.names if n not in file.shapes}
    has_fields = "photons" in file.names or "data" in is_struct
    if name in is_struct or (name is None and (is_struct & set(SCENE) or has_fields)):
        return _scene(file, name)
    return _array(file, name)


def _scene(file: MatFile, name: str | None) -> Cube:
    scene = find_struct(file, name, SCENE, "scene", "sceneCreate or sceneFromFile")
    angle_deg, distance_m = scene.number("wAngular"), scene.number("distance")
    return Cube(
        data=_bands_first(scene.photons),
        wavelength=scene.wavelength_nm,
        wavelength_unit="nm",
        band_width_nm=scene.band_width_nm,
        quantity="radiance",
        unit=ISET_UNIT,
        field_of_view_deg=angle_deg if angle_deg is not None and 0.0 < angle_deg < 180.0 else None,
        distance_m=distance_m if distance_m is not None and distance_m > 0.0 else None,
    )


def _array(file: MatFile, name: str | None) -> Cube:
    cubes = [n for n, shape in file.shapes.items() if len(shape) == 3]
    if name is None:
        if len(cubes) != 1:
            listed = f": {', '.join(n[:40] for n in cubes[:5])}; select one with name=" if cubes else ""
            raise FormatError(f"contains {len(cubes)} arrays of rows, columns and bands{listed}")
        name = cubes[0]
    elif name not in file.shapes:
        raise FormatError(f"has no array {name!r:.40}; {possible_names(name, cubes or list(file.shapes))}")
    by_lower = {n.lower(): n for n in file.names if n != name}
    key = next((by_lower[n] for n in WAVELENGTHS if n in by_lower and by_lower[n] in file.shapes), None)
    waves = None if key is None else file.read(key)
    unit = next((by_lower[n] for n in UNITS if n in by_lower), None)
    text = None if unit is None else file.read(unit)
    data = file.read(name)
    assert data is not None
    n_waves = None if waves is None else waves.size
    is_first = data.ndim == 3 and data.shape[2] != n_waves and data.shape[0] == n_waves
    return Cube(
        data=data if is_first else _bands_first(data),
        wavelength=None if waves is None else waves.ravel().tolist(),
        unit="".join(text.ravel().tolist()) if text is not None and text.dtype.kind == "U" else None,
    )


def _bands_first(data: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.moveaxis(data, 2, 0) if data.ndim == 3 else data


def _example(write: Callable[[Path, Mapping[str, Any]], None], path: Path) -> Floats:
    """Write an array (row, column, band), top row first."""
    radiance = example_radiance()
    write(path, {"cube": np.moveaxis(radiance[:, ::-1], 0, 2), "wave": np.array(EXAMPLE_NM), "unit": EXAMPLE_UNIT})
    return radiance


register_mat(CUBE_FORMATS, _read, _example)

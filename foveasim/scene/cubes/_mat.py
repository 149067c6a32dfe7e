"""
Cubes in MAT files: scenes of ISETCam, and arrays (row, column, band), top row first.

A scene is the struct ``scene`` or its fields: ``data.photons`` are photons/(s m² sr nm), ``spectrum.wave`` is in nm,
``wAngular`` is the horizontal field of view in degrees, and ``distance`` is in m.

Otherwise the cube is the only array of three dimensions, or the one with the given name, which is also that of a field of a
struct: ``data.cube``. Wavelengths in nm are the variable, or the field of the same struct, ``wavelengths``, ``wave``, ``bands``
or another usual name; if only the first axis has as many elements, it is that of the bands. ``unit`` or ``units`` contains the
unit. Other variables are ignored, unless their names are those of :data:`FACTORS`, which change the values.
"""

from __future__ import annotations

import re
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
#: Names of numbers by which the values of a cube may be multiplied or displaced; they have no defined meaning.
FACTORS = ("scale", "scale_factor", "scalefactor", "factor", "gain", "offset", "add_offset", "fill_value", "nodata")
ISET_UNIT = "photons s-1 m-2 sr-1 nm-1"


def _read(file: MatFile, name: str | None) -> Cube:
    if name is not None and re.search(r"[./]", name):
        return _array(file, name)
    is_struct = {n for n in file.names if n not in file.shapes}
    has_fields = "photons" in (*file.names, *file.fields("data"))
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
    path, beside = _place(file, name)
    by_lower = {n.lower(): f"{path.rpartition('/')[0]}/{n}".lstrip("/") for n in beside}
    waves = next((v for n in WAVELENGTHS if n in by_lower and (v := _numbers(file, by_lower[n])) is not None), None)
    text = next((v for n in UNITS if n in by_lower and (v := file.read(by_lower[n])) is not None), None)
    for factor in FACTORS:
        if factor in by_lower and _numbers(file, by_lower[factor]) is not None:
            raise FormatError(
                f"has the number {by_lower[factor]!r:.40}, which may change the values; read the array, and pass it with scale="
            )
    data = file.read(path)
    assert data is not None
    n_waves = None if waves is None else waves.size
    is_first = data.ndim == 3 and data.shape[2] != n_waves and data.shape[0] == n_waves
    return Cube(
        data=data if is_first else _bands_first(data),
        wavelength=None if waves is None else waves.ravel().tolist(),
        unit="".join(text.ravel().tolist()) if text is not None and text.dtype.kind == "U" else None,
    )


def _place(file: MatFile, name: str | None) -> tuple[str, list[str]]:
    """Return the path of the array with a name, or of the only one, and the names beside it."""
    cubes = [n for n, shape in file.shapes.items() if len(shape) == 3]
    if name is None:
        if len(cubes) != 1:
            listed = f": {', '.join(n[:40] for n in cubes[:5])}; select one with name=" if cubes else ""
            structs = [n for n in file.names if file.fields(n)]
            if not cubes and structs:
                field = file.fields(structs[0])[0]
                listed = f"; select the field of a struct with name=, such as '{structs[0]:.40}.{field:.40}'"
            raise FormatError(f"contains {len(cubes)} arrays of rows, columns and bands{listed}")
        name = cubes[0]
    *struct, last = re.split(r"[./]", name)
    beside = file.fields("/".join(struct)) if struct else file.names
    path = "/".join((*struct, last))
    if last not in beside or _numbers(file, path) is None:
        known = [".".join((*struct, n)) for n in beside] if struct else cubes or list(file.shapes)
        raise FormatError(f"has no array {name!r:.40}; {possible_names(name, known)}")
    return path, [n for n in beside if n != last]


def _numbers(file: MatFile, path: str) -> np.ndarray[Any, Any] | None:
    """Return an array of numbers, or None."""
    values = file.read(path)
    return values if values is not None and values.dtype.kind in "iufc" else None


def _bands_first(data: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.moveaxis(data, 2, 0) if data.ndim == 3 else data


def _example(write: Callable[[Path, Mapping[str, Any]], None], path: Path) -> Floats:
    """Write an array (row, column, band), top row first."""
    radiance = example_radiance()
    write(path, {"cube": np.moveaxis(radiance[:, ::-1], 0, 2), "wave": np.array(EXAMPLE_NM), "unit": EXAMPLE_UNIT})
    return radiance


register_mat(CUBE_FORMATS, _read, _example)

"""
Hyperspectral cubes: files of many bands, read by :meth:`foveasim.Scene.from_cube`.

==============  ================================  =================================================================
extension       format                            metadata in the file
==============  ================================  =================================================================
.hdr            ENVI, header and raw data         wavelengths, scale factors, bad bands; reflectance or ``data units``
.mat            MATLAB, version 5 to 7.3          wavelengths in a variable; all in scenes of ISETCam
.exr            spectral EXR                      wavelengths, unit, radiance or reflectance
.nc             netCDF, HDF5                      wavelengths, unit, pixel pitch
.zarr           zarr directory                    wavelengths, unit, pixel pitch
folder          grey pictures, one per band       wavelengths in their names
.npy            numpy array (row, column, band)   none
.tif            TIFF of several bands             none
==============  ================================  =================================================================

The format is detected from the content of a file. Each format is one entry of :data:`CUBE_FORMATS`; ``read(path, name)``
returns a :class:`Cube`.
"""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim._core.registry import import_all
from foveasim.scene.cubes._arrays import array_errors, cube_of
from foveasim.scene.cubes._cube import Cube, Quantity
from foveasim.scene.cubes._formats import CUBE_FORMATS, read_cube
from foveasim.scene.cubes._radiance import IlluminantTable, Radiance, spectral_radiance
from foveasim.scene.cubes._selection import Invalid, Selection, select

__all__ = [
    "CUBE_FORMATS",
    "Cube",
    "IlluminantTable",
    "Invalid",
    "Quantity",
    "Radiance",
    "Selection",
    "array_errors",
    "cube_of",
    "read_cube",
    "select",
    "spectral_radiance",
]

import_all(__name__, __path__)

publish(__name__)

"""Lens models: from scene radiance to irradiance on the sensor plane."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim._core.registry import import_all
from foveasim.incidence import ChiefRayTable, Incidence
from foveasim.optics._field_modes import FieldModes
from foveasim.optics._illumination import IlluminationTable
from foveasim.optics._optics import Optics
from foveasim.optics._point_images import PointSpread
from foveasim.optics._quadrature import PupilEdges
from foveasim.optics.aberrations import LateralColour, Seidel, Zernike, noll_to_nm, osa_to_nm, zernike
from foveasim.optics.otf import circular_otf
from foveasim.optics.psfs._formats import PSF_FORMATS, read_psfs
from foveasim.optics.psfs._grid import PSFGrid
from foveasim.optics.pupils import PUPILS, Annulus, Blades, Pupil, PupilImage, Slit, Spider

__all__ = [
    "PSF_FORMATS",
    "PUPILS",
    "Annulus",
    "Blades",
    "ChiefRayTable",
    "FieldModes",
    "IlluminationTable",
    "Incidence",
    "LateralColour",
    "Optics",
    "PSFGrid",
    "PointSpread",
    "Pupil",
    "PupilEdges",
    "PupilImage",
    "Seidel",
    "Slit",
    "Spider",
    "Zernike",
    "circular_otf",
    "noll_to_nm",
    "osa_to_nm",
    "read_psfs",
    "zernike",
]

import_all(__name__, __path__, skip="_")  # deferred: these modules import scipy, which only imaging needs

publish(__name__)

"""
Lens distortion models.

A model maps points of the sensor plane: :meth:`distort` from the ideal (pinhole) position to the real position,
:meth:`undistort` in the opposite direction. It also maps directions of rays, beyond 90° from the axis too: :meth:`direction`
returns that of a real position, :meth:`project` is its inverse. The simulation never resamples images for distortion: the
integrator undistorts the outlines of the photosites once. :func:`distort_map` resamples a power map for display and comparison.
"""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim._core.registry import import_all
from foveasim.distortion._brown_conrady import BrownConrady
from foveasim.distortion._calibration import from_opencv, to_opencv
from foveasim.distortion._calibration_files import read_calibration
from foveasim.distortion._fisheye import Fisheye, PolynomialFisheye, Scaramuzza
from foveasim.distortion._lens import Lens
from foveasim.distortion._map import distort_map
from foveasim.distortion._registry import LENSES
from foveasim.distortion._unified import DoubleSphere, ExtendedUnified, FieldOfView, Omnidirectional

__all__ = [
    "LENSES",
    "BrownConrady",
    "DoubleSphere",
    "ExtendedUnified",
    "FieldOfView",
    "Fisheye",
    "Lens",
    "Omnidirectional",
    "PolynomialFisheye",
    "Scaramuzza",
    "distort_map",
    "from_opencv",
    "read_calibration",
    "to_opencv",
]

import_all(__name__, __path__)

publish(__name__)

"""
Where a lens puts light that an ideal one would put elsewhere.

A model maps points of the sensor plane, nothing else: :meth:`distort` from the ideal (pinhole) position to the real one,
:meth:`undistort` back. Pictures are never resampled: the integrator carries the outlines of photosites back once. To look
at a distorted map, there is :func:`distort_map`.
"""

from __future__ import annotations

from foveasim._core.registry import import_all
from foveasim.distortion._brown_conrady import BrownConrady
from foveasim.distortion._calibration import from_opencv, read_calibration, to_opencv
from foveasim.distortion._fisheye import Fisheye, PolynomialFisheye, Scaramuzza
from foveasim.distortion._lens import Lens
from foveasim.distortion._map import distort_map
from foveasim.distortion._registry import LENSES

__all__ = [
    "LENSES",
    "BrownConrady",
    "Fisheye",
    "Lens",
    "PolynomialFisheye",
    "Scaramuzza",
    "distort_map",
    "from_opencv",
    "read_calibration",
    "to_opencv",
]

import_all(__name__, __path__)

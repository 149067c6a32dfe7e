"""Warning of a lens model that contradicts the focal length of the optics."""

from __future__ import annotations

import math

import numpy as np

from foveasim._core.user_warnings import warn
from foveasim.distortion import Lens
from foveasim.errors import FoveasimWarning
from foveasim.optics import Optics
from foveasim.scene import Scene
from foveasim.units import um_from_m

#: Cameras warn when the focal length of the lens model differs from the image distance by more than this fraction.
MAX_FOCAL_DIFFERENCE = 0.02


def warn_of_focal_length(optics: Optics, lens: Lens | None, scene: Scene) -> None:
    """
    Warn when the focal length of a lens model differs from the image distance.

    A lens model maps directions, which are ideal positions over its focal length. Those of the optics are over the image
    distance, which equals their focal length for a distant scene in focus. For unequal axes, the geometric mean is compared,
    which preserves areas.
    """
    if lens is None:
        return
    image_um = optics.magnification(scene.distance_m) * float(um_from_m(scene.distance_m))
    focal_um = math.sqrt(np.broadcast_to(np.asarray(lens.focal_um, np.float64), (2,)).prod())
    if abs(focal_um / image_um - 1.0) <= MAX_FOCAL_DIFFERENCE:
        return
    focus_m = scene.distance_m if optics.focus_distance_m is None else optics.focus_distance_m
    focus_um = float(um_from_m(focus_m))
    # The thin lens with the image distance of the lens model: 1 / f = 1 / D + 1 / H.
    focal_length_mm = optics.focal_length_mm * focal_um / image_um * (image_um + focus_um) / (focal_um + focus_um)
    warn(
        f"the focal length of the lens model is {focal_um:,.5g} µm, but the image distance of the optics {image_um:,.5g} µm "
        f"({optics.focal_length_mm:g} mm, focused at {focus_m:g} m): the image is distorted for wrong field angles; use "
        f"focal_um={image_um:.5g}, or focal_length_mm={focal_length_mm:.5g}",
        FoveasimWarning,
    )

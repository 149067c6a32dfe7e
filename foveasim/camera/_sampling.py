"""Warnings of images that are sampled too coarsely for their photosites."""

from __future__ import annotations

import math

import numpy as np

from foveasim._core.user_warnings import warn
from foveasim._core.validation import Bools, Floats
from foveasim.errors import SamplingWarning
from foveasim.layout import Layout
from foveasim.optics import Optics
from foveasim.scene import Scene
from foveasim.units import um_from_nm

#: Error of photosites above which a limited automatic oversampling causes a warning.
MAX_AUTO_ERROR = 1e-3


def warn_of_coarse_cells(optics: Optics, scene: Scene, layout: Layout) -> None:
    """Warn when automatic oversampling is limited, and photosites have an error above 1e-3."""
    if optics.oversample != "auto":
        return
    error = optics.auto_oversample_error(scene)  # of sites of side λN, an upper limit for wider ones
    if error <= MAX_AUTO_ERROR:
        return
    lambda_n_um = float(um_from_nm(scene.wavelength_nm.min())) * optics.working_f_number(scene.distance_m)
    side_um = math.sqrt(float(layout.area_um2.min(initial=np.inf)))
    # Wider photosites have proportionally fewer cells at their edges.
    error *= min(1.0, lambda_n_um / side_um)
    k, pixel_um = optics.auto_oversample(scene), optics.grid(scene).pitch_x_um
    is_lattice = optics.source_pixel == "point" and pixel_um > lambda_n_um
    # Point emitters farther apart than λN have no limit for small cells; they represent a continuous scene for sites > λN.
    if error <= MAX_AUTO_ERROR or (is_lattice and side_um > lambda_n_um):
        return
    reason, cure = (
        ("source pixels are points farther apart than λN", 'use source_pixel="square"')
        if is_lattice
        else ("more would exceed its limits", "set Optics(oversample=...), or use a smaller picture")
    )
    warn(
        f"automatic oversampling chooses {k} x {k} cells of {pixel_um / k:.3g} µm per source pixel, since {reason}: "
        f"photosites of {side_um:.3g} µm then have errors up to {100.0 * error:.2g} % (λN = {lambda_n_um:.3g} µm); {cure}, "
        "or Optics(oversample=1) to accept them",
        SamplingWarning,
    )


def warn_of_negative(rate_e_per_s: Floats, is_negative: Bools) -> None:
    """Warn when gradients of coarse cells give negative photoelectrons."""
    fraction = -float(rate_e_per_s[is_negative].sum()) / float(np.abs(rate_e_per_s).sum())
    warn(
        f"second-order integration makes the photoelectrons of {int(is_negative.sum()):,} of {rate_e_per_s.size:,} "
        f"photosites negative, {100.0 * fraction:.3g} % of all, and they are set to 0: the image is too sharp for cells of "
        "this size; use order=1, or smaller cells (Optics(oversample=...))",
        SamplingWarning,
    )

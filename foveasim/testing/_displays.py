"""Check of displays: luminances, chromaticities, and the mean of their cells."""

from __future__ import annotations

from typing import Any

import numpy as np

from foveasim._core.provenance import to_plain_data
from foveasim.scene import DISPLAYS, Display, Scene
from foveasim.testing._extension import Extension, check_of, require, shot_with

#: Tolerance of chromaticities, and of luminances relative to white.
SAME_XY, ROUNDING = 1e-3, 1e-6
#: Pixels of a uniform picture, a multiple of the blocks of displays.
N_PIXELS = 12
N_LEVELS = 33


@check_of(DISPLAYS)
def check_display(extension: Extension) -> None:
    """Check the luminances of greys, the primaries, and the mean over the cells."""
    display = extension.make()
    require(isinstance(display, Display), f"must return a Display, got {type(display).__name__}")
    greys = np.linspace(0.0, 1.0, N_LEVELS)[np.newaxis]
    luminance_cd_m2 = Scene.from_display(greys, display, distance_m=1.0).luminance_cd_m2[0]
    limits_cd_m2 = np.array([display.black_cd_m2, display.white_cd_m2])
    require(
        np.allclose(luminance_cd_m2[[0, -1]], limits_cd_m2, rtol=0.0, atol=ROUNDING * limits_cd_m2[1]),
        f"shows black and white of {luminance_cd_m2[[0, -1]].round(4).tolist()} cd/m², expected {limits_cd_m2.tolist()}",
    )
    require(
        np.all(np.diff(luminance_cd_m2) >= 0.0), "must have a luminance that does not decrease with the digital value"
    )
    if extension.expected is not None:
        found, expected = display.primaries_xy, np.asarray(extension.expected)
        require(
            found.shape == expected.shape and np.abs(found - expected).max() <= SAME_XY,
            f"has primaries with the chromaticities {found.round(4).tolist()}, expected {expected.tolist()}",
        )
    if display.cells is not None:
        grey = np.full((N_PIXELS, N_PIXELS), 0.5)
        uniform, of_cells = (
            Scene.from_display(grey, display, distance_m=1.0, subpixels=each).luminance_cd_m2.mean()
            for each in (False, True)
        )
        require(
            abs(of_cells - uniform) <= ROUNDING * uniform,
            f"has cells with a mean luminance of {of_cells:.6g} cd/m², expected {uniform:.6g}",
        )
    section = {"kind": "display", "picture": "skimage:camera", "display": extension.settings, "distance_m": 1.0}
    by_file: Any = shot_with("scene", section).scene
    again = Scene.from_display(np.zeros((1, 1)), display, distance_m=1.0)
    require(
        to_plain_data(by_file.spectrum_w_m2_sr_nm) == to_plain_data(again.spectrum_w_m2_sr_nm)
        and by_file.pitch_um == display.pitch_um,
        "must be the same in a settings file",
    )

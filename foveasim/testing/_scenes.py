"""Check of scenes and charts: size, radiance, arrangement, and means of finer pixels."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

import numpy as np

from foveasim._core.validation import Floats
from foveasim.scene import SCENES, Scene
from foveasim.testing._extension import Extension, check_of, require

#: Factors between pixel pitches, and the tolerance of means over finer pixels relative to white; charts whose summary contains
#: "Exact." have that of float32.
FACTORS, SAMPLED = (2, 5), 1.0 / 64.0 + 1e-6
ROUNDING = 1e-6
#: Relative radiance of bright and of dark cells.
BRIGHT, DARK = 2.0 / 3.0, 1.0 / 3.0
#: Parameters that are proportional to the radiance.
RADIANCES = ("radiance_w_m2_sr_nm", "peak_radiance_w_m2_sr_nm", "intensity_w_sr_nm")


def _radiance(scene: Scene) -> Floats:
    """Return the spectral radiance (n_wavelength, n_y, n_x)."""
    return np.asarray(np.einsum("byx,bk->kyx", scene.basis, scene.spectrum_w_m2_sr_nm, dtype=np.float64))


@check_of(SCENES)
def check_scene(extension: Extension) -> None:
    """Check the scene of a chart, a picture or a cube."""
    parameters = extension.parameters
    scene = extension.make()
    require(isinstance(scene, Scene), f"must return a Scene, got {type(scene).__name__}")
    require(inspect.getdoc(extension.item), "must have a docstring")
    radiance = _radiance(scene)
    require(np.isfinite(radiance).all() and radiance.min() >= 0.0, "must have finite radiance of at least 0")
    require(radiance.max() > 0.0, "must have radiance")
    if "shape" in parameters:
        require(
            radiance.shape[1:] == tuple(parameters["shape"]),
            f"must have the shape of its example, got {radiance.shape[1:]}",
        )
    for name in parameters.keys() & {"pitch_um", "distance_m"}:
        require(
            getattr(scene, name) == parameters[name], f"must have the {name} of its example, got {getattr(scene, name)}"
        )
    require(np.array_equal(_radiance(extension.make()), radiance), "must return the same scene for the same parameters")
    for name in parameters.keys() & set(RADIANCES):
        twice = _radiance(extension.make(**{name: 2.0 * np.asarray(parameters[name])}))
        require(np.allclose(twice, 2.0 * radiance, rtol=ROUNDING), f"must be proportional to {name}")
    require(
        extension.expected is not None,
        "has no known arrangement; register it with expected=, rows of '#' (bright), '.' (dark) and spaces, top row first",
    )
    _check_arrangement(radiance, extension.expected)
    # Functions draw charts in lengths, methods of Scene read pixels.
    if {"shape", "pitch_um"} <= parameters.keys() and not inspect.ismethod(extension.item):
        for factor in FACTORS:
            _check_finer(extension, radiance, factor)
    by_file: Any = extension.shot("scene").scene
    require(np.array_equal(_radiance(by_file), radiance), "must be the same in a settings file")


def _check_arrangement(radiance_w_m2_sr_nm: Floats, rows: Sequence[str]) -> None:
    image = radiance_w_m2_sr_nm.mean(axis=0)[::-1]  # top row first
    n_y, n_x = len(rows), len(rows[0])
    require(
        image.shape[0] % n_y == 0 and image.shape[1] % n_x == 0,
        f"has {image.shape[0]} x {image.shape[1]} pixels, not a multiple of the expected {n_y} x {n_x} cells",
    )
    cells = image.reshape(n_y, image.shape[0] // n_y, n_x, -1).mean(axis=(1, 3))
    found = ["".join("#" if c > BRIGHT else "." if c < DARK else " " for c in row) for row in cells / cells.max()]
    differing = sum(
        e not in (" ", f) for row, expected in zip(found, rows, strict=True) for f, e in zip(row, expected, strict=True)
    )
    require(
        differing == 0,
        f"has the arrangement {found}, expected {list(rows)}; row 0 of an array of a Scene is the lowest row",
    )


def _check_finer(extension: Extension, coarse_w_m2_sr_nm: Floats, factor: int) -> None:
    """Compare pixels with the means of finer pixels."""
    n_y, n_x = coarse_w_m2_sr_nm.shape[1:]
    pitch_um = extension.parameters["pitch_um"] / factor
    fine = _radiance(extension.make(shape=(n_y * factor, n_x * factor), pitch_um=pitch_um))
    means = fine.reshape(-1, n_y, factor, n_x, factor).mean(axis=(2, 4))
    worst = np.abs(means - coarse_w_m2_sr_nm).max() / coarse_w_m2_sr_nm.max()
    is_exact = "Exact." in str(inspect.getdoc(extension.item)).partition("\n")[0]
    require(
        worst <= (ROUNDING if is_exact else SAMPLED),
        f"differs by up to {worst:.1%} of white from the mean of {factor} x {factor} finer pixels; sizes must not depend on "
        "pitch_um, and a pixel is the mean over its square",
    )

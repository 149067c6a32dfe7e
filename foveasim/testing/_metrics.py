"""Checks of metrics and columns: numbers that depend on the capture only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from foveasim.capture import Capture
from foveasim.columns import COLUMNS, column_info
from foveasim.layout import DesignRules
from foveasim.metrics import METRICS
from foveasim.scene import Scene
from foveasim.testing._extension import Extension, check_of, require, shot_with


@check_of(METRICS)
def check_metric(extension: Extension) -> None:
    """Check the results of a metric for a capture, and for the same capture in a file."""
    shot = replace(shot_with("sensor", {"read_noise_e": 3.0}), rules=DesignRules(min_size_um=1.0))
    camera = shot.camera
    capture = camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=1)
    assert isinstance(shot.scene, Scene)
    inputs = [capture.code, capture.electrons, capture.expected_e, shot.scene.basis, capture.layout.xy_um]
    before = [array.copy() for array in inputs]

    def results(of: Capture) -> dict[str, Any]:
        found = extension.item(shot, camera, of, **extension.example)
        return dict(found) if isinstance(found, Mapping) else {"": found}

    found = results(capture)
    for name, value in found.items():
        require(
            isinstance(value, str) or np.asarray(value).dtype.kind in "biuf",
            f"must return a number, a string, or a mapping of names to numbers, got {type(value).__name__} {name}".rstrip(),
        )
        if not isinstance(value, str):
            is_documented = "nan" in str(extension.item.__doc__).lower()
            require(
                is_documented or np.isfinite(np.asarray(value, np.float64)).all(), "must be finite, or document NaN"
            )
    require(
        all(np.array_equal(a, b) for a, b in zip(inputs, before, strict=True)),
        "must not change the capture or its scene",
    )
    require(_is_same(results(capture), found), "must return the same numbers for the same capture")
    capture.save(extension.directory / "capture.npz")
    loaded = Capture.load(extension.directory / "capture.npz")
    require(_is_same(results(loaded), found), "must return the same numbers for a capture that was saved and loaded")


@check_of(COLUMNS)
def check_column(extension: Extension) -> None:
    """Check the values of a column for a capture, and for the same capture in a file."""
    shot = shot_with("sensor", {"read_noise_e": 3.0})
    capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=1)
    found = np.asarray(extension.item(capture))
    n_sites, declared = capture.layout.n_sites, np.dtype(column_info(extension.name).dtype)
    require(
        found.shape == (n_sites,), f"must return one value for each of {n_sites} sites, got the shape {found.shape}"
    )
    is_stored = found.dtype.kind in "biu" or np.can_cast(found.dtype, declared, "same_kind")
    require(is_stored and declared.kind in "biuf", f"must return numbers of the dtype {declared}, got {found.dtype}")
    capture.save(extension.directory / "capture.npz")
    loaded = Capture.load(extension.directory / "capture.npz")
    require(
        np.array_equal(extension.item(loaded), found),
        "must return the same values for a capture that was saved and loaded",
    )


def _is_same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    return one.keys() == other.keys() and all(
        value == other[name] if isinstance(value, str) else np.array_equal(value, other[name], equal_nan=True)
        for name, value in one.items()
    )

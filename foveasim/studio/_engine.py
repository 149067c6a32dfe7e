"""Simulation of settings with a cache of its stages."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats
from foveasim.capture import Capture
from foveasim.config import Shot
from foveasim.errors import GeometryError
from foveasim.explore.worker_cache import ShotRunner

__all__ = ["Engine", "Simulated"]

#: Largest number of photosites that are shown.
MAX_SITES = 2_000_000
#: Size limit of the arrays in the cache of a session.
MAX_BYTES = 1 << 27


@dataclass(frozen=True, eq=False)
class Simulated:
    """
    A shot and its capture.

    Attributes
    ----------
    settings : dict
    shot : Shot
    capture : Capture
    photo_e_per_s : (n_site,) float64, e-/s
        Photoelectron rates of the sites.
    images : dict
        Optical images by grid and filter, photoelectrons per second and µm²; empty for power maps.
    warnings : list of str
    seconds_s : float, s
        Time of the simulation.
    frozen : Simulated, optional
        Variant to compare with.
    """

    settings: dict[str, Any]
    shot: Shot
    capture: Capture
    photo_e_per_s: Floats
    images: dict[Any, Any]
    warnings: list[str] = field(default_factory=list)
    seconds_s: float = 0.0
    frozen: Simulated | None = None

    __repr__ = short_repr


class Engine:
    """
    Simulation of settings: only the stages whose settings changed are computed.

    Layout, scene, optics, distortion, compiled outlines, optical images and power on sites are cached by their settings.

    Parameters
    ----------
    n_threads : int, optional
        Number of threads; one per core by default.
    """

    def __init__(self, *, n_threads: int | None = None) -> None:
        self._runner = ShotRunner(None, {}, n_threads=n_threads, max_bytes=MAX_BYTES)

    @property
    def n_built(self) -> dict[str, int]:
        """Number of times that each stage was computed."""
        return self._runner.cache.n_built

    def forget(self, text: str) -> None:
        """Remove cached stages whose settings contain a string, such as the path of a frame."""
        self._runner.cache.forget(text)

    def simulate(self, settings: Mapping[str, Any]) -> Simulated:
        """
        Simulate the shot of settings.

        Raises
        ------
        FoveasimError
            When a setting is invalid, or the parts are incompatible; in one line.
        """
        start_s = time.perf_counter()
        cache = self._runner.cache
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                shot, capture = self._runner.simulate_capture(settings)
                if not 0 < capture.layout.n_sites <= MAX_SITES:
                    raise GeometryError(
                        f"the studio shows layouts of 1 to {MAX_SITES:,} photosites, got {capture.layout.n_sites:,}"
                    )
                photo_e_per_s = self._runner.photoelectrons_per_s(shot, settings)
                images = self._runner.images(shot, settings)
            finally:
                found = cache.finish_point()
        messages = dict.fromkeys([*found, *(" ".join(str(warning.message).split()) for warning in caught)])
        return Simulated(
            dict(settings), shot, capture, photo_e_per_s, images, list(messages), time.perf_counter() - start_s
        )

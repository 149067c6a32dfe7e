"""Simulation of settings with a cache of its stages."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats
from foveasim._io.mapped_files import in_memory
from foveasim.capture import Capture
from foveasim.config import Shot
from foveasim.errors import GeometryError
from foveasim.explore.worker_cache import ShotRunner
from foveasim.layout import Layout
from foveasim.scene import Scene

#: Longer side of pictures where the page gives none.
PICTURE_PIXELS = 512

#: Largest number of photosites that are shown.
MAX_SITES = 2_000_000
#: Largest number of cells of the optical image of a preview.
PREVIEW_CELLS = 1 << 18
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
    compared : tuple of (str, Simulated)
        Variants to compare with, and their names.
    is_preview : bool
        Whether the scene was reduced.
    picture_pixels : int
        Longer side of pictures.
    pinned : tuple of int
        Photosites that charts compare, instead of typical ones.
    """

    settings: dict[str, Any]
    shot: Shot
    capture: Capture
    photo_e_per_s: Floats
    images: dict[Any, Any]
    warnings: list[str] = field(default_factory=list)
    seconds_s: float = 0.0
    compared: tuple[tuple[str, Simulated], ...] = ()
    is_preview: bool = False
    picture_pixels: int = PICTURE_PIXELS
    pinned: tuple[int, ...] = ()

    __repr__ = short_repr

    @property
    def read_noise_e(self) -> float:
        """Median noise of the readout over the photosites, without quantisation, e-."""
        return float(np.sqrt(np.median(self.shot.camera.sensor.readout_model(0.0).noise_e2)))


class Engine:
    """
    Simulation of settings: only the stages whose settings changed are computed.

    Layout, scene, optics, distortion, compiled outlines, optical images and power on sites are cached by their settings.

    ``n_threads``: number of threads; one per core by default. ``check``: called with the name of each stage before it; it may
    raise an exception to stop the simulation. ``on_shot``: called with the shot before it is simulated.
    """

    def __init__(
        self,
        *,
        n_threads: int | None = None,
        check: Callable[[str], None] | None = None,
        on_shot: Callable[[Shot], None] = lambda _: None,
    ) -> None:
        self._on_shot = on_shot
        self._runner = ShotRunner(None, {}, n_threads=n_threads, max_bytes=MAX_BYTES, check=check)

    @property
    def n_built(self) -> dict[str, int]:
        """Number of times that each stage was computed."""
        return self._runner.cache.n_built

    def forget(self, text: str) -> None:
        """Remove cached stages whose settings contain a string, such as the path of a frame."""
        self._runner.cache.forget(text)

    def clear(self) -> None:
        """Remove all cached stages."""
        self._runner.cache.clear()

    def layout(self, settings: Mapping[str, Any]) -> Layout:
        """Return the layout of settings, which the simulation that follows finds in the cache."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                return self._runner.build_shot(settings).camera.layout
            finally:
                self._runner.cache.finish_point()

    def simulate(self, settings: Mapping[str, Any], *, is_preview: bool = False) -> Simulated:
        """
        Simulate the shot of settings.

        ``is_preview``: whether a large scene may be reduced: means of blocks of its pixels, and no finer cells of the optical
        image. Raises FoveasimError when a setting is invalid, or the parts are incompatible; in one line.
        """
        start_s = time.perf_counter()
        cache = self._runner.cache
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                shot, used, is_reduced = self._shot(settings, is_preview)
                self._on_shot(shot)
                capture = self._runner.capture(shot, used)
                if not 0 < capture.layout.n_sites <= MAX_SITES:
                    raise GeometryError(
                        f"the studio shows layouts of 1 to {MAX_SITES:,} photosites, got {capture.layout.n_sites:,}"
                    )
                shot = shot.captured(capture)
                photo_e_per_s = self._runner.photoelectrons_per_s(shot, used)
                images = self._runner.images(shot, used)
            finally:
                found = cache.finish_point()
        messages = dict.fromkeys([*found, *(" ".join(str(warning.message).split()) for warning in caught)])
        return Simulated(
            dict(settings),
            shot,
            capture,
            photo_e_per_s,
            images,
            list(messages),
            time.perf_counter() - start_s,
            is_preview=is_reduced,
        )

    def _shot(self, settings: Mapping[str, Any], is_preview: bool) -> tuple[Shot, Mapping[str, Any], bool]:
        """Return a shot, its settings for the cache, and whether its scene was reduced."""
        shot = self._runner.build_shot(settings)
        scene, camera = shot.scene, shot.camera
        if not (is_preview and isinstance(scene, Scene)):
            return shot, settings, False
        oversample = camera.oversample(scene)
        n_cells = math.prod(scene.basis.shape[1:])
        if n_cells * oversample**2 <= PREVIEW_CELLS:
            return shot, settings, False
        block = math.ceil(math.sqrt(n_cells / PREVIEW_CELLS))
        key = [settings["scene"], block]
        reduced = self._runner.part("preview", key, lambda: _reduced(scene, block))
        used = {**settings, "scene": {"preview": key}, "optics": {**settings["optics"], "oversample": 1}}
        optics = self._runner.part("optics", used["optics"], lambda: replace(camera.optics, oversample=1))
        return replace(shot, scene=reduced, camera=camera.replace(optics=optics)), used, True


def block_means(cells: NDArray[Any], block: int) -> NDArray[Any]:
    """Return means of square blocks of cells; incomplete upper and right blocks are cropped."""
    if block == 1:
        return cells
    n_y, n_x = (n // block for n in cells.shape)
    # Sums of complete rows first: much faster than sums over both axes at once.
    rows = cells[: n_y * block, : n_x * block].reshape(n_y, block, -1).sum(axis=1)
    return np.asarray(rows.reshape(n_y, n_x, block).sum(axis=2) / cells.dtype.type(block * block))


def _reduced(scene: Scene, block: int) -> Scene:
    """Return a scene with means of blocks of its pixels; the outermost pixels may be cropped."""
    if block == 1:
        return scene
    n_y, n_x = (block * (n // block) for n in scene.basis.shape[1:])
    y0, x0 = ((n - used) // 2 for n, used in zip(scene.basis.shape[1:], (n_y, n_x), strict=True))
    basis = np.stack([block_means(in_memory(image[y0 : y0 + n_y, x0 : x0 + n_x]), block) for image in scene.basis])
    pitch_um = None if scene.pitch_um is None or scene.field_of_view_deg is not None else scene.pitch_um * block
    depth_m = scene.depth_m
    if depth_m is not None:  # of the pixel in the middle: means would be distances between objects
        depth_m = depth_m[y0 : y0 + n_y, x0 : x0 + n_x][block // 2 :: block, block // 2 :: block]
    return replace(scene, basis=basis, pitch_um=pitch_um, depth_m=depth_m)

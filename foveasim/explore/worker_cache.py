"""Captures of sweep points, with a cache of their shared components."""

from __future__ import annotations

import hashlib
import json
import sys
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import current_thread, main_thread
from typing import Any

import numpy as np

from foveasim._core.provenance import to_plain_data
from foveasim._core.threads import thread_count
from foveasim._core.validation import Floats
from foveasim.capture import Capture
from foveasim.config import Shot, Source, build_shot
from foveasim.config._models import with_layout_of_twin
from foveasim.errors import FoveasimError
from foveasim.explore._metrics import reference_of
from foveasim.explore._records import Record, check_unique, to_values
from foveasim.metrics import Metric
from foveasim.scene import Scene

__all__ = ["ShotRunner", "WorkerCache", "rate_settings"]

#: Limits of a cache: bytes, and number of components. Nested components count in every component that contains them.
MAX_BYTES, MAX_PARTS = 1 << 30, 1024
#: A cache uses at most 1/4 of the memory of a worker: captures need most of it.
MEMORY_DIVISOR = 4
#: Kinds of components whose size increases with use.
GROWING_KINDS = ("camera", "images")
#: Depth of nested containers whose arrays count towards the size of a component.
MAX_DEPTH = 6
#: Sections of the settings of a shot that do not change the photoelectron rates, and others that do not change the optical
#: images; the responsivity of the sensor changes both.
AFTER_LIGHT = ("sensor", "exposure_s", "seed", "requirements", "gaze_path", "times_s")
AFTER_IMAGE = ("layout", "distortion", "integration_order", "gaze_um", "gaze_deg", "axis")
#: Longest stored message, characters.
MAX_MESSAGE_LENGTH = 500


@dataclass
class _Part:
    """Cached component with the warnings of its construction and its size."""

    value: Any
    warnings: list[str]
    n_bytes: int = 0


class WorkerCache:
    """
    Cache of shot components, limited in memory.

    Components are layouts, scenes, lenses, cameras, optical images and power on sites. Results do not depend on the contents of
    the cache: a component is a function of its settings, and its warnings are stored with it.

    ``max_bytes``: size limit of all arrays. Components of the last point are never removed.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self.max_bytes = max_bytes
        self._parts: OrderedDict[tuple[str, str], _Part] = OrderedDict()
        self._used: set[tuple[str, str]] = set()
        self._warnings: list[str] = []
        self.n_built: dict[str, int] = {}

    def part(self, kind: str, settings: Any, make: Callable[[], Any]) -> Any:
        """Return the component with the given settings, from the cache or newly built."""
        key = kind, json.dumps(settings, sort_keys=True)
        if key not in self._parts:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                value = make()
            self._parts[key] = _Part(value, [str(warning.message) for warning in caught])
            self.n_built[kind] = self.n_built.get(kind, 0) + 1
        self._parts.move_to_end(key)
        self._used.add(key)
        self._warnings += self._parts[key].warnings
        return self._parts[key].value

    def forget(self, text: str) -> None:
        """Remove components whose settings contain a string, such as the path of a file."""
        quoted = json.dumps(text)
        for key in [key for key in self._parts if quoted in key[1]]:
            del self._parts[key]

    def clear(self) -> None:
        """Remove all components."""
        self._parts.clear()

    def finish_point(self) -> list[str]:
        """
        Remove the least recently used components, except those of the last point.

        Returns ``warnings``: warnings of the components of the last point.
        """
        for key in self._used:
            # Measured again for cameras and images, which grow with use.
            if self._parts[key].n_bytes == 0 or key[0] in GROWING_KINDS:
                self._parts[key].n_bytes = _n_bytes(self._parts[key].value, set())
        total = sum(part.n_bytes for part in self._parts.values())
        for key in list(self._parts):
            if total <= self.max_bytes and len(self._parts) <= MAX_PARTS:
                break
            if key not in self._used:
                total -= self._parts.pop(key).n_bytes
        found, self._warnings, self._used = self._warnings, [], set()
        return found


class ShotRunner:
    """
    Captures of shots and their metrics, with a cache of shared components.

    Parameters
    ----------
    source : Source, path or None
        Origin of the settings, for messages.
    metrics : mapping of str to function
    is_geometry_varied : bool
        Whether points differ in photosites or distortion; optical images are then cached.
    n_threads : int, optional
        Threads of a capture; by default those of the worker, or of this process.
    max_bytes : int
        Size limit of the arrays in the cache. On a worker the limit is at most a quarter of its memory.
    check : function of str, optional
        Called with the name of each stage before it; it may raise an exception to stop the simulation. Stages until then
        remain in the cache.

    Notes
    -----
    Pickles of a runner do not contain the cache, which starts empty in each process.
    """

    def __init__(
        self,
        source: Source | Path | None,
        metrics: Mapping[str, Metric],
        *,
        is_geometry_varied: bool = True,
        n_threads: int | None = None,
        max_bytes: int = MAX_BYTES,
        check: Callable[[str], None] | None = None,
    ) -> None:
        self.source: Source | Path | None = source
        self.metrics: Mapping[str, Metric] = metrics
        self.check = check
        self.is_geometry_varied: bool = is_geometry_varied
        self.n_threads: int | None = n_threads
        self.max_bytes: int = max_bytes
        self._cache: WorkerCache | None = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_cache": None}

    @property
    def cache(self) -> WorkerCache:
        """Component cache of this process."""
        if self._cache is None:
            worker = _worker()
            limit = worker.memory_manager.memory_limit if worker is not None else None
            self._cache = WorkerCache(min(self.max_bytes, limit // MEMORY_DIVISOR) if limit else self.max_bytes)
            if self.n_threads is None:
                self.n_threads = thread_count() if worker is None else int(worker.state.nthreads)
        return self._cache

    def __call__(self, point: tuple[int, Mapping[str, Any]]) -> Record:
        """Return the record of a point, given its number and all its settings."""
        return self.record(*point)

    def simulate_capture(self, settings: Mapping[str, Any]) -> tuple[Shot, Capture]:
        """Build the shot of the given settings and simulate its capture."""
        shot = self.build_shot(settings)
        capture = self.capture(shot, settings)
        return shot.captured(capture), capture

    def build_shot(self, settings: Mapping[str, Any]) -> Shot:
        """Build the shot of the given settings."""
        return build_shot(self.source, settings, n_threads=self.n_threads, cache=self.part)

    def capture(self, shot: Shot, settings: Mapping[str, Any]) -> Capture:
        """Simulate the capture of a shot with the given settings."""
        photo_e_per_s = self.photoelectrons_per_s(shot, settings)
        self._before_stage("capture")
        return shot.camera.capture(shot.scene, exposure_s=shot.requested_s, seed=shot.seed, photo_e_per_s=photo_e_per_s)

    def part(self, kind: str, settings: Any, make: Callable[[], Any]) -> Any:
        """Return a component as :meth:`WorkerCache.part`, with a check before it is built."""

        def checked() -> Any:
            self._before_stage(kind)
            return make()

        return self.cache.part(kind, settings, checked)

    def _before_stage(self, name: str) -> None:
        if self.check is not None:
            self.check(name)

    def photoelectrons_per_s(self, shot: Shot, settings: Mapping[str, Any]) -> Floats:
        """Return the photoelectron rates of a shot's sites, (n_site,) e-/s."""
        images = self.images(shot, settings) if self.is_geometry_varied else None
        rates: Floats = self.part(
            "power on sites",
            rate_settings(shot, settings),
            lambda: shot.camera.photoelectrons_per_s(shot.scene, images=images),
        )
        return rates

    def images(self, shot: Shot, settings: Mapping[str, Any]) -> dict[Any, Any]:
        """Return the optical images that a shot's capture computed, by grid and filter."""
        found: dict[Any, Any] = self.cache.part("images", _image_settings(shot, settings), self._make_images)
        return found

    def _make_images(self) -> dict[Any, Any]:
        """Return an empty cache of images, with a check after each."""
        return {} if self.check is None else _CheckedImages(lambda: self._before_stage("optical image"))

    def _measure(self, metric: Metric, shot: Shot, capture: Capture, settings: Mapping[str, Any]) -> Any:
        """Compute a metric, with a cached reference where the metric takes one."""
        compared: Callable[..., Any] = metric
        make = reference_of(metric)
        if make is None:
            return metric(shot, shot.camera, capture)
        # White balance of the reference is in codes.
        key = [make.__name__, rate_settings(shot, settings), shot.exposure_s, shot.camera.sensor.bits]
        reference = self.cache.part("reference", key, lambda: make(shot, shot.camera))
        return compared(shot, shot.camera, capture, reference=reference)

    def record(self, point: int, settings: Mapping[str, Any]) -> Record:
        """
        Return the metrics of a point, or its error message.

        Exceptions of a point, except Ctrl-C, become error messages and do not interrupt the run.
        """
        values: dict[str, Any] = {}
        errors = []
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                shot, capture = self.simulate_capture(settings)
            except BaseException as error:  # noqa: BLE001 -- settings may cause any exception of the package or a library
                _raise_ctrl_c(error)
                errors.append(_message(error))
            else:
                for name, metric in self.metrics.items():
                    try:
                        new_values = to_values(name, self._measure(metric, shot, capture, settings))
                        check_unique(values, new_values)
                        values |= new_values
                    except BaseException as error:  # noqa: BLE001 -- metrics are user code, and may call sys.exit()
                        _raise_ctrl_c(error)
                        text = _message(error)
                        # Messages of this package about a result already start with its name.
                        errors.append(text if text.startswith(f"'{name}") else f"{name}: {text}")
        messages = dict.fromkeys([*self.cache.finish_point(), *(str(warning.message) for warning in caught)])
        return Record(point, values, "; ".join(errors), "; ".join(_truncate(text) for text in messages))


class _CheckedImages(dict[Any, Any]):
    """Optical images that call a function after each new one."""

    def __init__(self, check: Callable[[], None]) -> None:
        super().__init__()
        self._check = check

    def __setitem__(self, key: Any, value: Any) -> None:
        super().__setitem__(key, value)
        self._check()


def _worker() -> Any:
    """Return the dask worker that runs this code, or None."""
    if sys.modules.get("distributed") is None:
        return None
    from distributed import get_worker

    try:
        return get_worker()
    except ValueError:
        return None


def rate_settings(shot: Shot, settings: Mapping[str, Any]) -> list[Any]:
    """
    Return all that determines the photoelectron rates of a shot's sites, as plain data.

    Sections of the settings that do not are excluded by name, so that any other section, also a new one, is contained. Of the
    sensor, only spectral responsivity, the filter of each site and pixel optics matter.
    """
    filters = hashlib.sha256(shot.camera.sensor.filter_of_site.tobytes()).hexdigest()
    return [_without(settings, AFTER_LIGHT), _responsivity_digest(shot), filters, pixel_optics_settings(shot)]


def pixel_optics_settings(shot: Shot) -> Any:
    """Return the pixel optics of a shot as plain data, None without."""
    return to_plain_data(shot.camera.sensor.pixel_optics)


def _image_settings(shot: Shot, settings: Mapping[str, Any]) -> list[Any]:
    """Return all that determines the optical images of the filters in use, as plain data."""
    scene = shot.scene
    # With 'fit' the pitch depends on layout and distortion.
    pitch_um: Any = None
    if isinstance(scene, Scene):
        framed = shot.camera.geometry_of(scene)
        assert isinstance(framed, Scene)
        pitch_um = framed.pitch_um
        if scene.panorama is not None:  # its image depends on the lens model and the bounds of the layout
            pitch_um = [pitch_um, framed.projection, framed.basis.shape, to_plain_data(shot.camera.distortion)]
    gaze_um = shot.camera.gaze_um if shot.camera.axis == "sensor" else None
    # Images that are computed together share sums, whose rounding depends on their number.
    used = shot.camera.sensor.filters_used.tolist()
    return [
        _without(settings, (*AFTER_LIGHT, *AFTER_IMAGE)),
        pitch_um,
        [gaze_um, shot.camera.gaze_deg],
        _responsivity_digest(shot),
        used,
    ]


def _without(settings: Mapping[str, Any], sections: Sequence[str]) -> dict[str, Any]:
    return {name: section for name, section in with_layout_of_twin(settings).items() if name not in sections}


def _responsivity_digest(shot: Shot) -> str:
    return hashlib.sha256(shot.camera.sensor.responsivity_e_per_j(shot.scene.wavelength_nm).tobytes()).hexdigest()


def _raise_ctrl_c(error: BaseException) -> None:
    """
    Raise an error again if it is Ctrl-C.

    Ctrl-C interrupts the main thread. A KeyboardInterrupt in another thread, such as that of a worker, comes from a metric.
    """
    if isinstance(error, KeyboardInterrupt) and current_thread() is main_thread():
        raise error


def _message(error: BaseException) -> str:
    return _truncate(
        str(error) if isinstance(error, FoveasimError) else f"{type(error).__name__}: {error}".removesuffix(": ")
    )


def _truncate(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= MAX_MESSAGE_LENGTH else text[: MAX_MESSAGE_LENGTH - 3] + "..."


def _n_bytes(value: Any, visited: set[int], depth: int = MAX_DEPTH) -> int:
    """Return the bytes of the arrays in an object, without those in ``visited``."""
    if id(value) in visited or depth == 0:
        return 0
    if isinstance(value, np.ndarray):
        base = value if value.base is None or not isinstance(value.base, np.ndarray) else value.base
        n_bytes = 0 if id(base) in visited else int(base.nbytes)
        visited |= {id(base), id(value)}
        return n_bytes
    if isinstance(value, str | bytes | int | float | type(None)):
        return 0
    visited.add(id(value))
    if isinstance(value, Mapping):
        members: list[Any] = list(value.values())
    elif isinstance(value, list | tuple):
        members = list(value)
    elif type(value).__module__.startswith("foveasim"):
        slots = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())]
        members = [*getattr(value, "__dict__", {}).values(), *(getattr(value, name, None) for name in slots)]
    else:
        return 0
    return sum(_n_bytes(item, visited, depth - 1) for item in members)

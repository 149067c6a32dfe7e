"""Captures of sweep points, with a cache of their shared components."""

from __future__ import annotations

import hashlib
import json
import sys
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import current_thread, main_thread
from typing import Any

import numpy as np

from foveasim._core.threads import thread_count
from foveasim.capture import Capture
from foveasim.config import Shot, build_shot
from foveasim.errors import FoveasimError
from foveasim.explore._metrics import REFERENCES, Metric
from foveasim.explore._records import Record, check_new, values_of

__all__ = ["ShotRunner", "WorkerCache"]

#: Limits of a cache: bytes, and number of components. Nested components count in every component that contains them.
MAX_BYTES, MAX_PARTS = 1 << 30, 1024
#: A cache uses at most 1/4 of the memory of a worker: captures need most of it.
FRACTION_OF_MEMORY = 4
#: Kinds of components whose size increases with use.
GROWING = ("camera", "images")
#: Depth of nested containers whose arrays count towards the size of a component.
DEPTH = 6
#: Longest stored message, characters.
LONGEST_MESSAGE = 500


@dataclass
class _Part:
    """Cached component with the warnings of its construction and its size."""

    made: Any
    warnings: list[str]
    n_bytes: int = 0


class WorkerCache:
    """
    Cache of shot components, limited in memory.

    Components are layouts, scenes, lenses, cameras, optical images and power on sites. Results do not depend on the contents of
    the cache: a component is a function of its settings, and its warnings are stored with it.

    Parameters
    ----------
    max_bytes : int
        Size limit of all arrays. Components of the last point are never removed.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self.max_bytes = max_bytes
        self._parts: OrderedDict[tuple[str, str], _Part] = OrderedDict()
        self._used: set[tuple[str, str]] = set()
        self._warnings: list[str] = []
        self.n_made: dict[str, int] = {}

    def part(self, kind: str, settings: Any, make: Callable[[], Any]) -> Any:
        """Return the component with the given settings, from the cache or newly built."""
        key = kind, json.dumps(settings, sort_keys=True)
        if key not in self._parts:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                made = make()
            self._parts[key] = _Part(made, [str(warning.message) for warning in caught])
            self.n_made[kind] = self.n_made.get(kind, 0) + 1
        self._parts.move_to_end(key)
        self._used.add(key)
        self._warnings += self._parts[key].warnings
        return self._parts[key].made

    def end_point(self) -> list[str]:
        """
        Remove the least recently used components, except those of the last point.

        Returns
        -------
        warnings : list of str
            Warnings of the components of the last point.
        """
        for key in self._used:
            # Measured again for cameras and images, which grow with use.
            if self._parts[key].n_bytes == 0 or key[0] in GROWING:
                self._parts[key].n_bytes = _n_bytes(self._parts[key].made, set())
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
    source : Path
        File of the settings, for messages.
    metrics : mapping of str to function
    is_geometry_varied : bool
        Whether points differ in photosites or distortion; optical images are then cached.
    n_threads : int, optional
        Threads of a capture; by default those of the worker, or of this process.
    max_bytes : int
        Size limit of the arrays in the cache. On a worker the limit is at most a quarter of its memory.

    Notes
    -----
    Pickles of a runner do not contain the cache, which starts empty in each process.
    """

    def __init__(
        self,
        source: Path,
        metrics: Mapping[str, Metric],
        *,
        is_geometry_varied: bool = True,
        n_threads: int | None = None,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        self.source, self.metrics = source, metrics
        self.is_geometry_varied, self.n_threads, self.max_bytes = is_geometry_varied, n_threads, max_bytes
        self._cache: WorkerCache | None = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_cache": None}

    @property
    def cache(self) -> WorkerCache:
        """Component cache of this process."""
        if self._cache is None:
            worker = _worker()
            limit = worker.memory_manager.memory_limit if worker is not None else None
            self._cache = WorkerCache(min(self.max_bytes, limit // FRACTION_OF_MEMORY) if limit else self.max_bytes)
            if self.n_threads is None:
                self.n_threads = thread_count() if worker is None else int(worker.state.nthreads)
        return self._cache

    def __call__(self, point: tuple[int, Mapping[str, Any]]) -> Record:
        """Return the record of a point, given its number and all its settings."""
        return self.record(*point)

    def captured(self, settings: Mapping[str, Any]) -> tuple[Shot, Capture]:
        """Build the shot of the given settings and simulate its capture."""
        cache = self.cache
        shot = build_shot(self.source, settings, n_threads=self.n_threads, cache=cache.part)
        camera, sensor, scene = shot.camera, shot.camera.sensor, shot.scene
        light = _light(shot, settings)
        filters = hashlib.sha256(sensor.filter_of_site.tobytes()).hexdigest()
        sites = [settings["layout"], settings.get("distortion"), settings.get("integration_order"), filters]
        images = cache.part("images", light, dict) if self.is_geometry_varied else None
        photo_e_per_s = cache.part(
            "light on sites", [light, sites], lambda: camera.photoelectrons_per_s(scene, images=images)
        )
        capture = camera.capture(scene, exposure_s=shot.exposure_s, seed=shot.seed, photo_e_per_s=photo_e_per_s)
        return shot, capture

    def _measured(self, metric: Metric, shot: Shot, capture: Capture, settings: Mapping[str, Any]) -> Any:
        """Compute a metric, with a cached reference where the metric takes one."""
        compared: Callable[..., Any] = metric
        make = next((make for own, make in REFERENCES.items() if own is metric), None)
        if make is None:
            return metric(shot, shot.camera, capture)
        key = [_light(shot, settings), settings["layout"], shot.exposure_s]
        reference = self.cache.part("reference", key, lambda: make(shot, shot.camera))
        return compared(shot, shot.camera, capture, reference)

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
                shot, capture = self.captured(settings)
            except BaseException as error:  # noqa: BLE001 -- settings may cause any exception of the package or a library
                _raise_ctrl_c(error)
                errors.append(_message(error))
            else:
                for name, metric in self.metrics.items():
                    try:
                        more = values_of(name, self._measured(metric, shot, capture, settings))
                        check_new(values, more)
                        values |= more
                    except BaseException as error:  # noqa: BLE001 -- metrics are user code, and may call sys.exit()
                        _raise_ctrl_c(error)
                        text = _message(error)
                        # Messages of this package about a result already start with its name.
                        errors.append(text if text.startswith(f"'{name}") else f"{name}: {text}")
        texts = dict.fromkeys([*self.cache.end_point(), *(str(warning.message) for warning in caught)])
        return Record(point, values, "; ".join(errors), "; ".join(_short(text) for text in texts))


def _worker() -> Any:
    """Return the dask worker that runs this code, or None."""
    if "distributed" not in sys.modules:
        return None
    from distributed import get_worker

    try:
        return get_worker()
    except ValueError:
        return None


def _light(shot: Shot, settings: Mapping[str, Any]) -> list[Any]:
    """Return the settings that determine the optical images, with the spectral responsivity."""
    response = shot.camera.sensor.responsivity_e_per_j(shot.scene.wavelength_nm)
    return [settings["scene"], settings["optics"], hashlib.sha256(response.tobytes()).hexdigest()]


def _raise_ctrl_c(error: BaseException) -> None:
    """
    Raise an error again if it is Ctrl-C.

    Ctrl-C interrupts the main thread. A KeyboardInterrupt in another thread, such as that of a worker, comes from a metric.
    """
    if isinstance(error, KeyboardInterrupt) and current_thread() is main_thread():
        raise error


def _message(error: BaseException) -> str:
    return _short(
        str(error) if isinstance(error, FoveasimError) else f"{type(error).__name__}: {error}".removesuffix(": ")
    )


def _short(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= LONGEST_MESSAGE else text[: LONGEST_MESSAGE - 3] + "..."


def _n_bytes(thing: Any, seen: set[int], depth: int = DEPTH) -> int:
    """Return the bytes of the arrays in an object, without those in ``seen``."""
    if id(thing) in seen or depth == 0:
        return 0
    if isinstance(thing, np.ndarray):
        base = thing if thing.base is None or not isinstance(thing.base, np.ndarray) else thing.base
        n_bytes = 0 if id(base) in seen else int(base.nbytes)
        seen |= {id(base), id(thing)}
        return n_bytes
    if isinstance(thing, str | bytes | int | float | type(None)):
        return 0
    seen.add(id(thing))
    if isinstance(thing, Mapping):
        inside: list[Any] = list(thing.values())
    elif isinstance(thing, list | tuple):
        inside = list(thing)
    elif type(thing).__module__.startswith("foveasim"):
        slots = [name for kind in type(thing).__mro__ for name in getattr(kind, "__slots__", ())]
        inside = [*getattr(thing, "__dict__", {}).values(), *(getattr(thing, name, None) for name in slots)]
    else:
        return 0
    return sum(_n_bytes(item, seen, depth - 1) for item in inside)

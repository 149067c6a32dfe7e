"""A worker's bench: takes the captures of points, and keeps what the next points may have in common with them."""

from __future__ import annotations

import hashlib
import json
import signal
import sys
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock, current_thread, main_thread
from typing import Any

import numpy as np

from foveasim.capture import Capture
from foveasim.config import Shot, build_shot
from foveasim.errors import FoveasimError
from foveasim.explore._metrics import REFERENCES, Metric
from foveasim.explore._records import Record, check_new, values_of

__all__ = ["Bench", "Job", "Task", "run_tasks"]

#: What a worker keeps of earlier points, in memory and in number. Parts inside others are counted in each.
KEPT_BYTES, MOST_PARTS = 1 << 30, 1024
#: And no more than this part of a worker's memory: captures need most of it.
SHARE_OF_MEMORY = 4
#: Parts that hold more as they are used.
GROWING = ("camera", "images")
#: Objects are weighed by the arrays in them, so many containers deep.
DEPTH = 6
#: Characters of a message that are kept.
LONGEST_MESSAGE = 500


@dataclass(frozen=True)
class Job:
    """What all points of a sweep have in common: the file for messages, metrics, threads (0: the worker's), what varies."""

    source: Path
    metrics: Mapping[str, Metric]
    n_threads: int
    is_geometry_varied: bool


@dataclass(frozen=True)
class Task:
    """A point: its number, and all its settings."""

    point: int
    settings: Mapping[str, Any]


@dataclass
class _Part:
    """Something that was made, the warnings of its making, and its weight."""

    made: Any
    told: list[str]
    n_bytes: int = 0


class Bench:
    """
    Parts that were made before, up to a size in memory: layouts, scenes, lenses, compiled layouts, images, light on sites.

    Results never depend on what is kept: a part is a function of its settings, and its warnings are kept with it.
    """

    def __init__(self, kept_bytes: int = KEPT_BYTES) -> None:
        self._kept_bytes = kept_bytes
        self._parts: OrderedDict[tuple[str, str], _Part] = OrderedDict()
        self._used: set[tuple[str, str]] = set()
        self._told: list[str] = []
        self.n_made: dict[str, int] = {}

    def kept(self, part: str, settings: Any, make: Callable[[], Any]) -> Any:
        """What a part's settings make, or made before."""
        key = part, json.dumps(settings, sort_keys=True)
        if key not in self._parts:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                made = make()
            self._parts[key] = _Part(made, [str(warning.message) for warning in caught])
            self.n_made[part] = self.n_made.get(part, 0) + 1
        self._parts.move_to_end(key)
        self._used.add(key)
        self._told += self._parts[key].told
        return self._parts[key].made

    def _forget(self) -> None:
        """Let go of what was not used for longest, but not of what the last point used."""
        for key in self._used:
            # Weighed anew: cameras and images grow while they are used.
            if self._parts[key].n_bytes == 0 or key[0] in GROWING:
                self._parts[key].n_bytes = _n_bytes(self._parts[key].made, set())
        total = sum(part.n_bytes for part in self._parts.values())
        for key in list(self._parts):
            if total <= self._kept_bytes and len(self._parts) <= MOST_PARTS:
                break
            if key not in self._used:
                total -= self._parts.pop(key).n_bytes
        self._used = set()

    def captured(self, job: Job, settings: Mapping[str, Any]) -> tuple[Shot, Capture]:
        """The shot of a point and its capture."""
        shot = build_shot(job.source, settings, n_threads=job.n_threads, kept=self.kept)
        camera, sensor, scene = shot.camera, shot.camera.sensor, shot.scene
        light = _light(shot, settings)
        filters = hashlib.sha256(sensor.filter_of_site.tobytes()).hexdigest()
        sites = [settings["layout"], settings.get("distortion"), settings.get("integration_order"), filters]
        images = self.kept("images", light, dict) if job.is_geometry_varied else None
        photo_e_per_s = self.kept(
            "light on sites", [light, sites], lambda: camera.photoelectrons_per_s(scene, images=images)
        )
        capture = camera.capture(scene, exposure_s=shot.exposure_s, seed=shot.seed, photo_e_per_s=photo_e_per_s)
        return shot, capture

    def _measured(self, metric: Metric, shot: Shot, capture: Capture, settings: Mapping[str, Any]) -> Any:
        """What a metric gives; what it compares captures with is made once for all that share it."""
        compared: Callable[..., Any] = metric
        make = next((make for own, make in REFERENCES.items() if own is metric), None)
        if make is None:
            return metric(shot, shot.camera, capture)
        key = [_light(shot, settings), settings["layout"], shot.exposure_s]
        reference = self.kept("reference", key, lambda: make(shot, shot.camera))
        return compared(shot, shot.camera, capture, reference)

    def record(self, job: Job, task: Task) -> Record:
        """What a point gave: its metrics, or what went wrong. Nothing that a point raises ends the others."""
        self._told = []
        values: dict[str, Any] = {}
        errors = []
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                shot, capture = self.captured(job, task.settings)
            except BaseException as error:  # noqa: BLE001 -- a point's settings may make anything of ours or of a library's raise
                _raise_ctrl_c(error)
                errors.append(_told(error))
            else:
                for name, metric in job.metrics.items():
                    try:
                        more = values_of(name, self._measured(metric, shot, capture, task.settings))
                        check_new(values, more)
                        values |= more
                    except BaseException as error:  # noqa: BLE001 -- metrics are the user's, and may end with sys.exit()
                        _raise_ctrl_c(error)
                        text = _told(error)
                        # What we say of a result begins with its name.
                        errors.append(text if text.startswith(f"'{name}") else f"{name}: {text}")
        self._forget()
        told = dict.fromkeys([*self._told, *(str(warning.message) for warning in caught)])
        return Record(task.point, values, "; ".join(errors), "; ".join(_short(text) for text in told))


def _light(shot: Shot, settings: Mapping[str, Any]) -> list[Any]:
    """What the light behind the lens depends on, as the sensor's filters see it."""
    response = shot.camera.sensor.responsivity_e_per_j(shot.scene.wavelength_nm)
    return [settings["scene"], settings["optics"], hashlib.sha256(response.tobytes()).hexdigest()]


def _raise_ctrl_c(error: BaseException) -> None:
    """Let Ctrl-C through, which comes to the main thread; elsewhere, as in a worker's tasks, a metric raised it."""
    if isinstance(error, KeyboardInterrupt) and current_thread() is main_thread():
        raise error


def _told(error: BaseException) -> str:
    return _short(
        str(error) if isinstance(error, FoveasimError) else f"{type(error).__name__}: {error}".removesuffix(": ")
    )


def _short(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= LONGEST_MESSAGE else text[: LONGEST_MESSAGE - 3] + "..."


def _n_bytes(thing: Any, seen: set[int], depth: int = DEPTH) -> int:
    """Bytes of the arrays in an object that were not seen before."""
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


# -- on a worker ------------------------------------------------------------------------------------------------------

#: One point at a time in a process: a camera uses the process's threads.
_lock = Lock()
#: The job that this process works on, and its bench.
_current: dict[str, tuple[Job, Bench]] = {}


def dask_setup(_worker: Any) -> None:
    """What a worker that we start does first: Ctrl-C, which the whole terminal gets, is for the program that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def run_tasks(
    job: bytes, versions: Mapping[str, str], folder: str, tasks: Sequence[Task]
) -> tuple[list[Record], float] | None:
    """
    The records of some points, and the seconds that they took; called by dask on its workers.

    None when this is another worker than that with the folder: dask itself tries again what ended with one.

    Raises
    ------
    RuntimeError
        When this worker's versions are others: its results might be, too.
    """
    import cloudpickle
    from distributed import get_worker

    from foveasim._core.provenance import versions as own_versions

    worker = get_worker()
    if worker.local_directory != folder:
        return None
    if own_versions() != dict(versions):
        different = [
            f"{name} {own_versions().get(name)}" for name in versions if own_versions().get(name) != versions[name]
        ]
        wanted = [f"{name} {versions[name]}" for name in versions if own_versions().get(name) != versions[name]]
        raise RuntimeError(f"a worker has {', '.join(different)}, and here is {', '.join(wanted)}")
    digest = hashlib.sha256(job).hexdigest()
    with _lock:
        if digest not in _current:
            _current.clear()
            own_job = cloudpickle.loads(job)
            n_threads = own_job.n_threads or int(worker.state.nthreads)
            kept_bytes = min(KEPT_BYTES, (worker.memory_manager.memory_limit or sys.maxsize) // SHARE_OF_MEMORY)
            _current[digest] = replace(own_job, n_threads=n_threads), Bench(kept_bytes)
        own_job, bench = _current[digest]
        start_s = time.perf_counter()
        return [bench.record(own_job, task) for task in tasks], time.perf_counter() - start_s

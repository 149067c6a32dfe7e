"""Session of a page: settings with history, simulation in a thread, and messages."""

from __future__ import annotations

import copy
import json
import math
import shutil
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from foveasim._core.work_arrays import release_memory
from foveasim._io.atomic import atomic_write
from foveasim._io.yaml_files import format_yaml
from foveasim.config import Requirement, check_settings, put_setting, validate
from foveasim.errors import FoveasimError, ParameterError, SimulationError, printable
from foveasim.explore import result_of
from foveasim.explore.solving import search_value
from foveasim.layout import Layout
from foveasim.metrics import metric_info
from foveasim.studio._costs import FORGET_S, PREVIEW_IDLE_S, RELEASE_S, CancelledError, Costs, SupersededError
from foveasim.studio._engine import Engine, Simulated
from foveasim.studio._exports import log_of, text_of, without_directories
from foveasim.studio._files import (
    Files,
    apply_preset,
    file_name,
    is_unused_or_copy,
    unused_path,
    with_covering_scene,
)
from foveasim.studio._frames import Frames
from foveasim.studio._history import History
from foveasim.studio._messages import from_json, one_line, to_json
from foveasim.studio._parts import PARTS, summary_of
from foveasim.studio._parts.comparison import FROZEN
from foveasim.studio._pictures import reduced_picture, resolved_pixels
from foveasim.studio._settings.changes import (
    ONCE,
    changed_keys,
    check_depth,
    chooses_filters,
    is_change,
    is_draft,
    is_frame,
    is_temporary,
    key_of,
    match_filters,
    reset,
    setting_of,
    string_of,
    with_file,
)
from foveasim.studio._settings.controls import controls_of, structure_of
from foveasim.studio._settings.gaze import SessionGaze, random_rows, rows_of_file
from foveasim.studio._settings.unknowns import (
    PARAMETERS,
    balanced,
    generated_layout,
    solved_of,
    with_n_sites,
    with_unknown,
)
from foveasim.studio._settings.values import number_control, present_number, values_of, with_values
from foveasim.studio._start import new_sensor
from foveasim.studio._sweeps import Sweep, Sweeps, axes_of, results_of
from foveasim.studio._variants import DIRECTORY, Variants
from foveasim.studio._views import Views

#: Size limit of all uploaded files.
MAX_SESSION_BYTES = 512 << 20
#: Largest number of photosites that charts compare, and of variants that are compared with the current state.
MAX_PINNED, MAX_COMPARED = 6, 5
#: Range of goal seek for automatic exposures.
EXPOSURES_S = (1e-5, 1.0)
#: Largest number of messages that wait.
MAX_WAITING = 1000
#: Newer changes stop simulations for at most this time in succession, so that some are shown.
MAX_STOPPED_S = 3.0
#: Longest time for which views wait until a page has drawn the photosites.
DRAWN_S = 0.5
#: Stages are not reported in the first time of a change: short ones are not shown.
PROGRESS_S = 0.3
#: Receives messages for a page: strings of JSON, and bytes of parts.
Listener = Callable[[str | bytes], None]


class Start:
    """
    Initial state of sessions.

    Parameters
    ----------
    settings : dict
    name : str
        Name of the shot.
    directory : Path, optional
        Directory of the settings file.
    out : Path, optional
        Directory for saved files.
    shows_start_page : bool
        Whether new pages begin with the start page.
    """

    def __init__(
        self,
        settings: dict[str, Any],
        name: str = "shot",
        directory: Path | None = None,
        out: Path | None = None,
        *,
        shows_start_page: bool = False,
    ) -> None:
        self.settings, self.name, self.directory, self.out = settings, name, directory, out
        self.shows_start_page = shows_start_page


class Session:
    """
    Settings of a page with history, and a thread that simulates them.

    ``name``: identifier. ``n_threads``: number of threads of the simulation. ``origin``: session whose history and uploaded
    files are copied.
    """

    def __init__(self, name: str, start: Start, *, n_threads: int | None = None, origin: Session | None = None) -> None:
        self.name, self.start = name, start
        self.uploads = Path(tempfile.mkdtemp(prefix="foveasim-studio-"))
        directory = (self.uploads if start.out is None else start.out.absolute()) / DIRECTORY
        self.variants = Variants(directory, self._save)
        self.files = Files(start.settings, (start.directory, start.out), self.uploads, directory)
        self._costs = Costs()
        self._views = Views(self._send, self._wait_for_page, self._line, self._costs)
        self.engine = Engine(n_threads=n_threads, check=self._check, on_shot=self._views.work_ahead)
        self.history = History(start.settings)
        self.result: Simulated | None = None
        self.last_used_s = time.monotonic()
        self.n_free_bytes = MAX_SESSION_BYTES
        if origin is not None:
            self._copy_state(origin)
        # Identifier of the page that is connected, or was last.
        self.page: str | None = None
        self._uploading = threading.Lock()  # in threads of the server
        self.frames = Frames(self.uploads, self._new_path)
        self.gaze = SessionGaze(self._line)
        self._sweeps = Sweeps(self._send, self._line)
        self._version = 0
        self._last_id: Any = None
        self._structure: Any = None
        self._controls: list[dict[str, Any]] = []
        self._frozen: dict[str, Any] | None = None
        self._frozen_result: Simulated | None = None
        # Variants that are compared, with the settings that were simulated, and the errors of others.
        self._compared: dict[str, tuple[dict[str, Any], Simulated]] = {}
        self._variant_errors: dict[str, str] = {}
        self._errors: dict[str, str] = {}
        self._simulated_frame: str | None = None
        self._pinned: tuple[int, ...] = ()
        # Sentences about pictures that were reduced, by path.
        self._notes: dict[str, str] = {}
        self._reductions: dict[tuple[str, int, str], tuple[Path, str] | None] = {}
        # Setting that changed last, and whether this was during a drag.
        self._key: str | None = None
        self._is_dragging = False
        self._needs_complete_result = False
        self._has_unused_memory = False
        self._is_cancelled = self._is_working = False
        self._can_stop = False
        self._stopped_s = self._started_s = -math.inf
        # Connections, and whether they answer when the photosites are drawn.
        self._listeners: dict[Listener, bool] = {}
        self._drawn_version = 0
        self._waiting: deque[dict[str, Any]] = deque()
        self._wake = threading.Condition()
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name=f"studio {name[:8]}", daemon=True)
        self._thread.start()

    # -- interface of the server ------------------------------------------------------------------------------------

    def hello(self) -> dict[str, Any]:
        """Return the controls, and the names of views."""
        settings = self.history.settings
        return {
            "controls": controls_of(settings, self.start.settings),
            "views": [part.about() for part in PARTS.values()],
            "can_save": self.start.out is not None,
            "settings": to_json(settings),
            "name": self.start.name,
            "shows_start_page": self.start.shows_start_page,
        }

    def _copy_state(self, origin: Session) -> None:
        """Take over the history and the uploaded files of another session."""
        with origin._uploading:
            self.n_free_bytes = origin.n_free_bytes
            with suppress(FileNotFoundError):  # of a session that is being closed
                for path in origin.uploads.iterdir():
                    if path.is_file():
                        shutil.copy2(path, self.uploads / path.name)
                # The file of a source of frames is written when it is required.
                for name, frame in origin.frames.export(origin.history.settings).items():
                    shutil.copy2(frame, self.uploads / Path(name).name)
                if self.start.out is None and origin.variants.directory.is_dir():
                    shutil.copytree(origin.variants.directory, self.variants.directory)

        def moved(value: Any) -> Any:
            """Return settings with the paths of this session's files."""
            if isinstance(value, dict):
                return {name: moved(item) for name, item in value.items()}
            if isinstance(value, list):
                return [moved(item) for item in value]
            return value.replace(old, new) if isinstance(value, str) else value

        old, new = f"{origin.uploads}/", f"{self.uploads}/"
        self.history = origin.history.mapped(moved)

    def attach(self, listener: Listener, *, answers: bool = False) -> None:
        """
        Add a connection, which receives all parts.

        ``answers``: whether it posts ``drawn`` when it has drawn photosites that the session waits for.
        """
        with self._wake:
            self._listeners[listener] = answers
            self.last_used_s = time.monotonic()
        self.post({"do": "refresh", "id": None})

    def detach(self, listener: Listener) -> None:
        """Remove a connection."""
        with self._wake:
            self._listeners.pop(listener, None)
            self.last_used_s = time.monotonic()
            self._wake.notify()

    @property
    def is_idle(self) -> bool:
        """Whether no page is connected."""
        return not self._listeners

    def post(self, message: Any) -> None:
        """
        Add a message of the page.

        It is handled in the thread of the session, but two at once: ``cancel`` stops the work in progress and what waits,
        ``drawn`` starts work that would delay the page.
        """
        if isinstance(message, dict) and message.get("do") == "drawn":
            with self._wake:
                self._drawn_version = message["version"] if type(message.get("version")) is int else 0
                self._wake.notify()
            return
        if isinstance(message, dict) and message.get("do") == "cancel":
            with self._wake:
                self._is_cancelled = self._is_working or bool(self._waiting)
            return
        with self._wake:
            self.last_used_s = time.monotonic()
            if is_frame(message) and self._waiting and is_frame(self._waiting[-1]) and not message.get("is_first"):
                message["is_first"] = self._waiting.pop().get("is_first")
            if len(self._waiting) >= MAX_WAITING:
                message = None
            else:
                self._waiting.append(message)
            self._wake.notify()
        if message is None:
            self._send({"kind": "error", "id": None, "text": "too many messages wait; the newest were discarded"})

    def close(self) -> None:
        """Stop the thread, and delete uploaded files."""
        with self._wake:
            self._is_closed = True
            self._wake.notify()
        shutil.rmtree(self.uploads, ignore_errors=True)

    def add_file(self, name: str, content: bytes) -> Path | None:
        """Store an uploaded file and return its path; None beyond the limit of the session."""
        with self._uploading:
            if len(content) > self.n_free_bytes:
                return None
            self.n_free_bytes -= len(content)
        path = None
        try:
            path = self._new_path(file_name(name))
            path.write_bytes(content)
        except OSError:
            if path is not None:
                path.unlink(missing_ok=True)
            with self._uploading:
                self.n_free_bytes += len(content)
            raise
        return path

    def _new_path(self, name: str) -> Path:
        """Return the path of a new, empty file for an uploaded file or for the frames of a source."""
        with self._uploading:
            path = unused_path(self.uploads / name, lambda path: not path.exists())
            path.touch()
        return path

    # -- thread -----------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._handle_until_closed()
        finally:
            self.frames.stop()
            shutil.rmtree(self.uploads, ignore_errors=True)

    def _handle_until_closed(self) -> None:
        while True:
            with self._wake:
                while not self._waiting and not self._is_closed and self._wake.wait(self._idle_timeout_s):
                    pass
                if self._is_closed:
                    return
                messages = list(self._waiting)
                self._waiting.clear()
                is_sweeping = self._sweeps.is_running and not self._needs_complete_result
                # Points are interrupted by messages, not cancelled.
                self._is_working = bool(messages) or not is_sweeping
            try:
                if is_sweeping and not messages:
                    self._has_unused_memory = True
                    self._sweeps.compute_next(self.engine.simulate)
                elif messages or self._needs_complete_result:
                    self._has_unused_memory = True
                    self._handle(messages) if messages else self._complete()
                elif self._has_unused_memory:
                    self._has_unused_memory = False
                    release_memory()
                else:
                    self._forget_result()
            except BaseException as error:  # noqa: BLE001 -- the session continues with its last valid state
                self._send_error(self._last_id, error)
            finally:
                with self._wake:
                    self._is_cancelled = self._is_working = False

    @property
    def _idle_timeout_s(self) -> float | None:
        """Time without messages after which the thread has something to do; None for any time."""
        if self._needs_complete_result:
            return PREVIEW_IDLE_S
        if self._sweeps.is_running:
            return 0.0
        if self._has_unused_memory:
            return RELEASE_S
        return FORGET_S if self.is_idle and self.result is not None else None

    def _forget_result(self) -> None:
        """
        Release the memory of a session without a page.

        Also that of variants and of what was sent. The settings and those of A are simulated again for the next page, which
        chooses the other variants to compare.
        """
        self.result = self._frozen_result = None
        self._compared = {}
        self._views.forget()
        self.engine.clear()
        release_memory()

    def _handle(self, messages: list[Any]) -> None:
        """Handle messages in order; consecutive changes are simulated once."""
        changes: list[dict[str, Any]] = []
        done = 0
        self._is_working = True
        self._started_s = time.monotonic()
        try:
            for k, message in enumerate(messages):
                if is_change(message):
                    changes.append(message)
                    continue
                self._change(changes)
                changes, done = [], k + 1
                try:
                    self._answer(message)
                except Exception as error:  # noqa: BLE001 -- messages of the page may cause any exception
                    self._last_id = message.get("id") if isinstance(message, dict) else None
                    self._send_error(self._last_id, error)
            self._change(changes)
        except SupersededError:
            # Applied again together with the newer ones.
            with self._wake:
                self._waiting.extendleft(reversed(messages[done:]))
            return
        finally:
            self._is_cancelled = self._is_working = False
        self._send_parts()
        self._needs_complete_result = self.is_preview

    def _check(self, stage: str) -> None:
        """
        Report a stage, or stop a simulation.

        It is stopped when the session is closed, the user cancels, or a newer change waits.
        """
        if self._is_closed:
            raise SupersededError
        if self._sweeps.is_computing:
            if self._sweeps.is_interrupted(list(self._waiting)):
                raise SupersededError
            return
        if self._is_cancelled:
            raise CancelledError("cancelled; the settings are those before")
        if not self._is_dragging and time.monotonic() - self._started_s > PROGRESS_S:
            self._send({"kind": "progress", "text": stage})
        if not self._can_stop or not any(is_change(m) and m["do"] not in ONCE for m in list(self._waiting)):
            return
        now_s = time.monotonic()
        if self._stopped_s == -math.inf:
            self._stopped_s = now_s
        if now_s - self._stopped_s < MAX_STOPPED_S:
            raise SupersededError

    def _generated(self, settings: Mapping[str, Any]) -> Layout | None:
        """Return the layout of the generator of settings, without edits; None without one."""
        return self._layout_source()(settings)

    def _layout_source(self) -> Callable[[Mapping[str, Any]], Layout | None]:
        """Return a function as :meth:`_generated`, which later results do not affect."""
        shown = None if self.result is None else self.result.capture.layout
        section = None if self.result is None else self.result.settings.get("layout")
        return lambda settings: generated_layout(settings, shown, section)

    def _setter(self) -> Callable[[dict[str, Any], Sequence[tuple[str, Any]]], dict[str, Any]]:
        """Return a function that sets values as the page does now."""
        return partial(with_values, controls=self._controls, start=self.start.settings, layout_of=self._layout_source())

    @property
    def is_preview(self) -> bool:
        """Whether the views show a preview, or were left out for one."""
        return bool(self._views.left_out) or (self.result is not None and self.result.is_preview)

    def _complete(self) -> None:
        """Replace a preview by the complete result."""
        self._is_dragging = self._needs_complete_result = False
        self._send({"kind": "busy"})
        try:
            self._simulate(self.history.settings)
        except SupersededError:
            return
        except CancelledError:
            self._send({"kind": "note", "text": "cancelled; the preview remains"})
        except Exception as error:  # noqa: BLE001 -- the preview stays, with the reason
            self._errors = {"": self._line(error)}
        self._send_state()
        self._send_parts()

    def _change(self, messages: list[dict[str, Any]], *, can_stop: bool = True) -> None:
        """Apply changes and simulate the result; after an error each change is applied separately."""
        if not messages:
            return
        kept = [
            message
            for message, following in zip(messages, [*messages[1:], None], strict=True)
            if following is None
            or not (
                (is_draft(message) and is_draft(following, setting_of(message)))
                or (is_frame(message) and is_frame(following) and not message.get("is_first"))
            )
        ]
        before = self.history.copy()
        self._send({"kind": "busy"})
        try:
            for message in kept:
                self._apply(message)
            key = setting_of(kept[0])
            self._key = key if len(kept) == 1 and isinstance(key, str) else None
            self._is_dragging = is_draft(kept[-1])
            can_stop = can_stop and not any(message["do"] in ONCE for message in kept)
            self._simulate(self.history.settings, can_stop=can_stop)
        except SupersededError:
            self.history = before
            raise
        except CancelledError as error:
            self.history, self._errors = before, {}
            self._send({"kind": "note", "text": str(error)})
        except Exception as error:  # noqa: BLE001 -- settings may cause any exception of the package or a library
            self.history = before
            if len(kept) > 1:
                for message in kept:
                    self._change([message], can_stop=False)
                return
            message = kept[0]
            if message.get("do") == "set" and message.get("final", True):
                self.history.commit(self.history.settings)  # a valid preview is the step
            key = message.get("key")
            self._errors = {key if isinstance(key, str) else str(message.get("do")): self._line(error)}
        else:
            self._errors = {}
        self._last_id = messages[-1].get("id")
        self._send_state()

    def _apply(self, message: dict[str, Any]) -> None:
        """Apply one change to the history."""
        settings = before = self.history.settings
        match message["do"]:
            case "undo":
                if not self.history.undo():
                    raise SimulationError("there is no step to undo")
                return
            case "redo":
                if not self.history.redo():
                    raise SimulationError("there is no step to redo")
                return
            case "set":
                value = from_json(check_depth(message.get("value")))
                settings = self._setter()(settings, [(key_of(message), value)])
            case "assign":
                settings = self._setter()(settings, values_of(message))
            case "reset":
                key = key_of(message)
                settings = balanced(reset(settings, self.start.settings, key), key, before, self._generated)
            case "delete":
                key = key_of(message)
                settings = balanced(reset(settings, {}, key), key, before, self._generated)
            case "seek":
                settings = self._with_solved_value(settings, message)
            case "fit":
                if self.result is None:
                    raise SimulationError("there is no image to fit")
                settings = with_covering_scene(settings, self.result.shot)
            case "solve":
                generated = self._generated(settings)
                if generated is None:
                    raise SimulationError("there is no layout whose parameters are known")
                settings = with_unknown(settings, string_of(message, "name"), generated)
            case "apply":
                settings = self.variants.settings_of(message.get("variant"))
            case "preset":
                settings = apply_preset(string_of(message, "name"), settings)
            case "new_sensor":
                self._check("solving for the number of photosites")
                settings = new_sensor(settings, message)
            case "restore":
                restored = from_json(check_depth(message.get("settings")))
                if not isinstance(restored, dict):
                    raise ParameterError("settings", "must be a mapping")
                settings = self.files.with_uploads(restored)
            case "file":
                opened, use = string_of(message, "path"), message.get("as")
                if use == "scene":
                    opened = self._reduced(opened)
                settings = with_file(settings, self.start.settings, self.files, opened, use)
            case "match":
                if self._frozen_result is None or self.result is None:
                    raise SimulationError("there is no variant A to compare with")
                n_sites, edited = self._frozen_result.capture.layout.n_sites, self.result.capture.layout
                own = self._generated(settings) or edited
                # Edits may change the number of the generator.
                settings = with_n_sites(settings, max(1, round(n_sites * own.n_sites / edited.n_sites)), own)
            case "video":
                path = Path(self.files.available(string_of(message, "path")))
                shown = self.frames.path if self.frames.open_video(path) else path
                settings = with_file(settings, self.start.settings, self.files, str(shown), "scene")
            case "frame":
                found = self._with_frame(settings, message)
                if found is None:
                    return
                settings = found
            case "follow":
                settings = self.gaze.at(settings, message.get("t_s"))
            case "gaze_file":
                rows = rows_of_file(self.files.available(string_of(message, "path")))
                settings = {**settings, "gaze_path": rows}
            case "saccades":
                shot = None if self.result is None else self.result.shot
                film = self.frames.about(settings)
                rows = random_rows(message, shot, None if film is None else film["frame_s"])
                settings = {**settings, "gaze_path": rows}
        settings = self.files.resolve(settings)
        if chooses_filters(message):
            match_filters(settings, before)
        check_settings(None, settings)
        if is_temporary(message):
            self.history.preview(settings)
        else:
            self.history.commit(settings)

    def _with_frame(self, settings: dict[str, Any], message: dict[str, Any]) -> dict[str, Any] | None:
        """Use a frame, and return the settings that follow from it; None if they are the same."""
        if "pixels" in message:
            is_first = bool(message.get("is_first"))
            if not self.frames.receive(message["pixels"], is_first=is_first) or not is_first:
                return None
            return with_file(settings, self.start.settings, self.files, str(self.frames.path), "scene")
        if message.get("follows") is not True:
            self.frames.show(message.get("n"))
            return None
        self.gaze.required_path(settings)  # an error leaves the frame
        self.frames.show(message.get("n"))
        return self.gaze.at(settings, self.frames.time_s)

    def _with_solved_value(self, settings: dict[str, Any], message: dict[str, Any]) -> dict[str, Any]:
        """
        Return settings in which a requirement is met.

        One number is changed; the curve of its results is sent to the page.
        """
        key, wanted = key_of(message), from_json(check_depth(message.get("requirement")))
        control = number_control(self._controls, key)
        if self.result is None:
            raise SimulationError("there is no result to start from")
        if not isinstance(wanted, dict):
            raise ParameterError("requirement", "must be a mapping")
        requirement: Requirement = validate(None, Requirement, wanted)
        present = present_number(settings, control, self.result)
        low, high = control.get("suggested") or EXPOSURES_S
        if isinstance(present, int | float):
            low, high = min(low, present), max(high, present if key != f"{PARAMETERS}.n_sites" else 4 * present)
        else:
            present = low
        if message.get("bounds") is not None:
            bounds = message["bounds"]
            if (
                not isinstance(bounds, list)
                or len(bounds) != 2
                or not all(type(each) in (int, float) for each in bounds)
            ):
                raise ParameterError("bounds", "must be two numbers")
            low, high = bounds
        n_done = 0

        def changed(value: float) -> dict[str, Any]:
            found = copy.deepcopy(settings)
            put_setting(None, found, key, value)
            return balanced(found, key, settings, self._generated)

        def result_at(value: float) -> float:
            nonlocal n_done
            n_done += 1
            self._check(f"goal seek, step {n_done}")
            result = self.engine.simulate(changed(value))
            return result_of(requirement, result.shot, result.capture)

        solution = search_value(
            key, present, requirement, result_at, bounds=(low, high), is_integer=control["kind"] == "integer"
        )
        self._send({
            "kind": "sought",
            "id": message.get("id"),
            "key": key,
            "label": control["label"],
            "unit": control["unit"],
            "value": solution.value,
            "result": solution.result,
            "subject": requirement.subject,
            "measure": metric_info(requirement.measure).title,
            "result_unit": requirement.unit,
            "limits": [requirement.at_least, requirement.at_most],
            "curve": [list(point) for point in solution.curve],
        })  # fmt: skip
        return changed(solution.value)

    def _planned_sweep(self, message: dict[str, Any]) -> Sweep:
        """Return the sweep of a message, of the settings as they are now."""
        result, base, set_values = self.result, self.frames.with_file(self.history.settings), self._setter()
        if result is None:
            raise SimulationError("there is no result to start from")
        axes = axes_of(message, self._controls)
        present = [present_number(base, axis.control, result) for axis in axes]

        def change(settings: dict[str, Any], values: Sequence[tuple[str, Any]]) -> dict[str, Any]:
            found: dict[str, Any] = self.files.resolve(set_values(settings, values))
            check_settings(None, found)
            return found

        return Sweep(message.get("id"), base, axes, results_of(message), present, change)

    def _reduced(self, path: str) -> str:
        """Return the path of a picture, or of a reduced one if it is large."""
        if self.result is None:
            return path
        self._check(f"reading {Path(self.files.available(path)).name}")
        encoding = self.history.settings["scene"].get("encoding", "srgb")
        key = (path, resolved_pixels(self.result.shot), encoding)
        if key not in self._reductions:
            self._reductions[key] = reduced_picture(Path(path), self._new_path, key[1], encoding)
        found = self._reductions[key]
        if found is None:
            return path
        self._notes[str(found[0])] = found[1]
        return str(found[0])

    def _simulate(self, settings: dict[str, Any], *, can_stop: bool = True) -> None:
        settings, before = self.frames.with_current(settings), self._simulated_frame
        is_preview = self._is_dragging and self._costs.is_slow(self._key)
        result = self.result
        if result is not None and result.settings == settings and (is_preview or not result.is_preview):
            return
        self._can_stop = can_stop
        try:
            self.result = self.engine.simulate(settings, is_preview=is_preview)
        finally:
            self._can_stop = False
        self._stopped_s = self._started_s = -math.inf
        if not self.result.is_preview:
            self._costs.add_simulation(self._key, self.result.seconds_s)
        self._version += 1
        self._simulated_frame = self.frames.stored_name
        if before is not None and before != self._simulated_frame:
            self.engine.forget(before)

    def _answer(self, message: Any) -> None:
        """Handle a message that does not change the settings."""
        if not isinstance(message, dict):
            raise ParameterError("message", "must be a JSON object")
        self._last_id = message.get("id")
        match message.get("do"):
            case "refresh":
                self._views.forget()
                self._sweeps.send()
                self._structure = None
                self.gaze.forget()
                if self.result is None:
                    self._send({"kind": "busy"})
                    self._simulate_frozen()
                    try:
                        self._simulate(self.history.settings, can_stop=False)
                    except Exception as error:  # noqa: BLE001 -- shown at the settings
                        self._errors = {"": self._line(error)}
            case "views":
                self._views.select(message.get("names"), message.get("pixels"))
            case "pin":
                sites = message.get("sites")
                if (
                    not isinstance(sites, list)
                    or len(sites) > MAX_PINNED
                    or not all(type(each) is int for each in sites)
                ):
                    raise ParameterError("sites", f"must be a list of at most {MAX_PINNED} indices of photosites")
                self._pinned = tuple(dict.fromkeys(each for each in sites if each >= 0))
            case "freeze":
                self._freeze(message.get("variant"))
            case "unfreeze":
                self._frozen = self._frozen_result = None
                self._forget_comparison()
            case "variant":
                self._change_variant(message)
            case "compare":
                self._compare(message.get("variants"))
            case "sweep":
                self._sweeps.start(self._planned_sweep(message))
            case "stop_sweep":
                self._sweeps.stop()
            case "sweep_file":
                text, files = self._sweeps.file(self._file_directories)
                self._send({"kind": "text", "id": message.get("id"), "what": "sweep", "text": text, "files": files})
            case "text":
                what, exported = string_of(message, "what"), self.exported()
                self._send({
                    "kind": "text",
                    "id": message.get("id"),
                    "what": what,
                    "text": self.text(what, exported),
                    "files": list(exported[1]),
                })  # fmt: skip
            case "save":
                name, may_replace = string_of(message, "name"), message.get("may_replace") is True
                path = self._saved_path(name)
                if path.exists() and not may_replace:
                    self._send({"kind": "exists", "id": message.get("id"), "name": name, "file": path.name})
                else:
                    self._save(path)
                    self._send({"kind": "saved", "id": message.get("id"), "path": str(path)})
            case unknown:
                raise ParameterError("do", "must be the name of a message", printable(str(unknown))[:40])
        self._send_state()

    # -- variants ---------------------------------------------------------------------------------------------------

    def _freeze(self, variant: Any) -> None:
        """
        Keep the current result, or that of a variant, as A.

        The page keeps what is sent before the next change.
        """
        if self.result is None:
            raise SimulationError("there is no result to freeze")
        if self.result.is_preview:
            self._is_dragging = False
            self._simulate(self.history.settings, can_stop=False)
        settings, current = self.history.settings, self.result
        if variant is not None:
            self._send({"kind": "busy"})
            settings = self.files.resolve(self.variants.settings_of(variant))
            self.result = self.engine.simulate(settings)
            self._version += 1
        self._frozen_result = self.result
        self._frozen = {"summary": summary_of(self.result), "settings": settings}
        self._send_parts(is_freeze=True, is_followed=variant is not None)
        if variant is not None:
            self.result = current
            self._version += 1

    def _simulate_frozen(self) -> None:
        """Simulate A again, whose result was released; without its files it is removed."""
        if self._frozen is None or self._frozen_result is not None:
            return
        try:
            self._frozen_result = self.engine.simulate(self._frozen["settings"])
        except FoveasimError:
            self._frozen = None

    def _change_variant(self, message: dict[str, Any]) -> None:
        variant = message.get("variant")
        match message.get("action"):
            case "keep":
                self.variants.keep(message.get("name"), message.get("note", ""))
            case "update":
                self.variants.update(variant)
            case "describe":
                self.variants.describe(variant, message.get("name"), message.get("note"))
            case "delete":
                self.variants.delete(variant)
            case unknown:
                raise ParameterError("action", "must be keep, update, describe or delete", printable(str(unknown))[:40])
        self._compare([each.id for each in self.variants if each.id in self._compared])

    def _compare(self, wanted: Any) -> None:
        """
        Simulate variants that are compared with the current state.

        Those that fail are left out, with the reason.
        """
        if not isinstance(wanted, list) or len(wanted) > MAX_COMPARED:
            raise ParameterError("variants", f"must be a list of at most {MAX_COMPARED} variants")
        self._send({"kind": "busy"})
        before, self._compared, self._variant_errors = self._compared, {}, {}
        for variant in dict.fromkeys(str(each) for each in wanted):
            try:
                settings = self.files.resolve(self.variants.settings_of(variant))
                known = before.get(variant)
                if known is None or known[0] != settings:
                    known = settings, self.engine.simulate(settings)
                self._compared[variant] = known
            except FoveasimError as error:
                self._variant_errors[variant] = self._line(error)
        self._forget_comparison()

    def _forget_comparison(self) -> None:
        """Send views of variants again when the next variant is compared."""
        if not self._variants_shown:
            for part in PARTS.values():
                if part.is_of_variants:
                    self._views.forget(part.name)

    @property
    def _variants_shown(self) -> tuple[tuple[str, Simulated], ...]:
        """The variants that are compared with the current state, A first."""
        names = {each.id: each.name for each in self.variants} if self._compared else {}
        named = [(names.get(variant, variant), result) for variant, (_, result) in self._compared.items()]
        return (*(() if self._frozen_result is None else ((FROZEN, self._frozen_result),)), *named)

    # -- answers ----------------------------------------------------------------------------------------------------

    def text(self, what: str, exported: tuple[dict[str, Any], dict[str, Path]] | None = None) -> str:
        """
        Return the current settings in a text format, or their changes as a difference.

        ``what``: {"yaml", "python", "notebook", "link", "diff", "log"}. ``exported``: as :meth:`exported` returns it,
        for several texts of the same state. Raises ParameterError when the format is unknown.
        """
        if what == "log":
            return log_of(self.history.states).replace(f"{self.uploads}/", "")
        settings, files = self.exported() if exported is None else exported
        return text_of(what, settings, self.start.settings, self.start.name, list(files))

    def exported(
        self, name_of: Callable[[Path], str] = lambda file: file.name
    ) -> tuple[dict[str, Any], dict[str, Path]]:
        """
        Return the current settings with names of uploaded files for their paths, and the files.

        ``name_of``: returns the name of a file. Returns ``files``: uploaded files by name, and the current frame of a source.
        """
        settings = self.history.settings
        return without_directories(settings, self._file_directories, self.frames.export(settings), name_of)

    @property
    def _file_directories(self) -> tuple[Path, ...]:
        """Directories whose files are copied with settings."""
        return self.uploads, self.variants.directory

    def _saved_path(self, name: str) -> Path:
        """Return the path of saved settings with a name."""
        if self.start.out is None:
            raise SimulationError("files are written only with --out; use the download instead")
        safe = file_name(name)
        return self.start.out / (safe if safe.endswith((".yaml", ".yml")) else f"{safe}.yaml")

    def _save(self, path: Path, text: str = "") -> None:
        """
        Write the settings to a file, with copies of uploaded files in its directory.

        ``text``: comments at the beginning of the file.
        """
        out = path.parent
        out.mkdir(parents=True, exist_ok=True)
        originals = {path: path}

        def name_of(original: Path) -> str:
            """Return a name that no other file has, of these settings or of those saved before."""

            def is_usable(copied: Path) -> bool:
                return originals.get(copied, original) == original and is_unused_or_copy(copied, original)

            copied = unused_path(out / original.name, is_usable)
            originals[copied] = original
            return copied.name

        settings, files = self.exported(name_of)
        for copied, original in files.items():
            with atomic_write(out / copied) as temporary:
                shutil.copyfile(original, temporary)
        with atomic_write(path) as temporary:
            temporary.write_text(text + format_yaml(settings), encoding="utf-8")

    def _send_state(self) -> None:
        settings, result = self.history.settings, self.result
        structure = structure_of(settings)
        if structure != self._structure:
            self._structure, self._controls = structure, controls_of(settings, self.start.settings)
            self._send({"kind": "controls", "controls": self._controls})
        gaze_path = self.gaze.message(settings, None if result is None else result.shot)
        if gaze_path is not None:
            self._send(gaze_path)
        self._send({
            "kind": "state",
            "id": self._last_id,
            "version": self._version,
            "settings": settings,
            "changed": changed_keys(settings, self.start.settings),
            "can_undo": self.history.can_undo,
            "can_redo": self.history.can_redo,
            "errors": self._errors,
            "warnings": [] if result is None else result.warnings,
            "notes": [note for path, note in self._notes.items() if settings.get("scene", {}).get("picture") == path],
            "summary": {} if result is None else summary_of(result),
            "solved": {} if result is None else solved_of(result.settings, result.capture.layout),
            "frozen": self._frozen,
            "variants": [
                {**vars(each), "is_compared": each.id in self._compared, "problem": self._variant_errors.get(each.id)}
                for each in self.variants
            ],
            "film": self.frames.about(settings),
            "is_preview": result is not None and result.is_preview,
        })  # fmt: skip

    def _send_parts(self, *, is_freeze: bool = False, is_followed: bool = False) -> None:
        """
        Compute and send the parts that changed, until newer messages interrupt.

        Those of a variant are complete; those of the current state follow them.
        """
        if self.result is None:
            return
        times_ms = self._views.send_changed(
            replace(
                self.result,
                compared=self._variants_shown,
                pinned=tuple(site for site in self._pinned if site < self.result.capture.layout.n_sites),
            ),
            self._version,
            self._last_id,
            key=self._key,
            is_dragging=self._is_dragging,
            is_interrupted=lambda: not is_freeze and bool(self._waiting),
        )
        if times_ms is not None:
            times_ms["simulation"] = 1e3 * self.result.seconds_s
            self._send({
                "kind": "done",
                "id": self._last_id,
                "version": self._version,
                "ms": times_ms,
                "is_preview": self.is_preview,
                "is_freeze": is_freeze,
                "is_followed": is_followed,
            })  # fmt: skip

    def _line(self, error: BaseException) -> str:
        """Return an error in one line, without the directory of uploads."""
        return str(error) if isinstance(error, CancelledError) else one_line(error).replace(f"{self.uploads}/", "")

    def _send_error(self, number: Any, error: BaseException) -> None:
        self._send({"kind": "error", "id": number, "text": self._line(error)})

    def _wait_for_page(self) -> None:
        """Wait until a page has drawn the photosites, so that later work does not delay it."""

        def is_over() -> bool:
            return self._drawn_version >= self._version or bool(self._waiting) or self._is_closed

        with self._wake:
            if any(self._listeners.values()):
                self._wake.wait_for(is_over, DRAWN_S)

    def _send(self, message: dict[str, Any] | bytes) -> None:
        sent = message if isinstance(message, bytes) else json.dumps(to_json(message), allow_nan=False)
        for listener in list(self._listeners):
            with suppress(Exception):
                listener(sent)

"""Session of a page: settings with history, simulation in a thread, and messages."""

from __future__ import annotations

import json
import math
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import foveasim.studio._settings.goal  # handles messages, as the next ones
import foveasim.studio._settings.repairs
import foveasim.studio._start.new_sensor  # noqa: F401
from foveasim._core.work_arrays import release_memory
from foveasim.config import check_settings
from foveasim.errors import SimulationError
from foveasim.layout import Layout
from foveasim.studio import _exports
from foveasim.studio._costs import FORGET_S, PREVIEW_IDLE_S, RELEASE_S, CancelledError, Costs, SupersededError
from foveasim.studio._engine import Engine, Simulated
from foveasim.studio._files import Files, file_name, unused_path
from foveasim.studio._frames import Frames
from foveasim.studio._history import History
from foveasim.studio._messages.encoding import one_line, to_json
from foveasim.studio._messages.models import Message, Refresh, SetValue, handle, read_message
from foveasim.studio._parts import PARTS, summary_of
from foveasim.studio._pictures import ReducedPictures
from foveasim.studio._queue import IdleWork, Queue
from foveasim.studio._settings.changes import changed_keys, match_filters
from foveasim.studio._settings.controls import controls_of, structure_of
from foveasim.studio._settings.gaze import SessionGaze
from foveasim.studio._settings.labels import worded
from foveasim.studio._settings.unknowns import generated_layout, solved_of
from foveasim.studio._settings.values import with_values
from foveasim.studio._sweeps import Sweeps
from foveasim.studio._variants import DIRECTORY, Compared, Variants
from foveasim.studio._views import Views

#: Size limit of all uploaded files.
MAX_SESSION_BYTES = 512 << 20
#: Stages are not reported in the first time of a change: short ones are not shown.
PROGRESS_S = 0.3
#: Receives messages for a page: strings of JSON, and bytes of parts.
Listener = Callable[[str | bytes], None]


@dataclass
class Start:
    """
    Initial state of sessions.

    ``name``: that of the shot. ``directory``: that of the settings file. ``out``: that of saved files. ``shows_start_page``:
    whether new pages begin with the start page.
    """

    settings: dict[str, Any]
    name: str = "shot"
    directory: Path | None = None
    out: Path | None = None
    shows_start_page: bool = field(default=False, kw_only=True)


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
        self.variants = Variants(directory, partial(_exports.save, self))
        self.files = Files(start.settings, (start.directory, start.out), self.uploads, directory)
        #: Directories whose files are copied with settings.
        self.file_directories = self.uploads, directory
        self.costs = Costs()
        self.views = Views(self.send, self._wait_for_page, self.line, self.costs)
        self.engine = Engine(n_threads=n_threads, check=self.check, on_shot=self.views.work_ahead)
        self.history = History(start.settings)
        self.result: Simulated | None = None
        self.n_free_bytes = MAX_SESSION_BYTES
        if origin is not None:
            self._copy_state(origin)
        # Identifier of the page that is connected, or was last.
        self.page: str | None = None
        self._uploading = threading.Lock()  # in threads of the server
        self.frames = Frames(self.uploads, self._new_path)
        self.pictures = ReducedPictures(self._new_path)
        self.gaze = SessionGaze(self.line)
        self.sweeps = Sweeps(self.send, self.line)
        self.compared = Compared()
        #: Photosites that charts compare.
        self.pinned: tuple[int, ...] = ()
        self.controls: list[dict[str, Any]] = []
        self._structure: Any = None
        self._version = 0
        self._last_id: Any = None
        self._errors: dict[str, str] = {}
        self._simulated_frame: str | None = None
        # Setting that changed last, and whether this was during a drag.
        self._key: str | None = None
        self._is_dragging = False
        self._needs_complete_result = False
        self._has_unused_memory = False
        self._can_stop = False
        self._started_s = -math.inf
        # Connections, and whether they answer when the photosites are drawn.
        self._listeners: dict[Listener, bool] = {}
        self.queue = Queue(self._handle, self._idle_work, self._report)
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
        with self.queue.wake:
            self._listeners[listener] = answers
        self.post(Refresh())

    def detach(self, listener: Listener) -> None:
        """Remove a connection."""
        with self.queue.wake:
            self._listeners.pop(listener, None)
        self.queue.wake_up()

    @property
    def is_idle(self) -> bool:
        """Whether no page is connected."""
        return not self._listeners

    def post(self, data: Any) -> None:
        """Add a message of the page for the thread; types that are immediate are handled."""
        message = read_message(data)
        if message.is_immediate and message.is_valid:
            handle(self, message)
        elif not self.queue.add(message):
            self.send({"kind": "error", "id": None, "text": "too many messages wait; the newest were discarded"})

    def close(self) -> None:
        """Stop the thread, and delete uploaded files."""
        self.queue.close()
        shutil.rmtree(self.uploads, ignore_errors=True)

    def add_file(self, name: str, content: bytes) -> Path | None:
        """
        Store an uploaded file and return its path; None beyond the limit of the session.

        An equal file of the same name is not stored again.
        """
        same = self.uploads / file_name(name)
        if same.is_file() and same.stat().st_size == len(content) and same.read_bytes() == content:
            return same  # other files may name it
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
            self.queue.run()
        finally:
            self.frames.stop()
            shutil.rmtree(self.uploads, ignore_errors=True)

    def _report(self, error: BaseException) -> None:
        self._send_error(self._last_id, error)

    def _idle_work(self) -> IdleWork | None:
        """Return the next work without messages."""
        if self._needs_complete_result:
            return IdleWork(PREVIEW_IDLE_S, self._complete)
        if self.sweeps.is_running:
            # Points are interrupted by messages, not cancelled.
            return IdleWork(0.0, self._compute_point, is_cancellable=False)
        if self._has_unused_memory:
            return IdleWork(RELEASE_S, self._release_memory)
        return IdleWork(FORGET_S, self._forget_result) if self.is_idle and self.result is not None else None

    def _compute_point(self) -> None:
        self._has_unused_memory = True
        self.sweeps.compute_next(self.engine.simulate)

    def _release_memory(self) -> None:
        self._has_unused_memory = False
        release_memory()

    def _forget_result(self) -> None:
        """
        Release the memory of a session without a page.

        Also that of variants and of what was sent. The settings and those of A are simulated again for the next page, which
        chooses the other variants to compare.
        """
        self.result = None
        self.compared.release()
        self.views.forget()
        self.engine.clear()
        release_memory()

    def _handle(self, messages: list[Message]) -> None:
        """Handle messages in order; consecutive changes are simulated once."""
        changes: list[Message] = []
        done = 0
        self._has_unused_memory = True
        self._started_s = time.monotonic()
        with self.queue.working():
            try:
                for k, message in enumerate(messages):
                    if message.is_change:
                        changes.append(message)
                        continue
                    self._change(changes)
                    changes, done = [], k + 1
                    self._answer(message)
                self._change(changes)
            except SupersededError:
                # Applied again together with the newer ones.
                self.queue.put_back(messages[done:])
                return
        self.send_parts()
        self._needs_complete_result = self.is_preview

    def check(self, stage: str) -> None:
        """
        Report a stage, or stop a simulation.

        It is stopped when the session is closed, the user cancels, or a newer change waits.
        """
        if self.queue.is_closed:
            raise SupersededError
        if self.sweeps.is_computing:
            if self.sweeps.is_interrupted(list(self.queue.waiting)):
                raise SupersededError
            return
        if self.queue.is_cancelled:
            raise CancelledError("cancelled; the settings are those before")
        if not self._is_dragging and time.monotonic() - self._started_s > PROGRESS_S:
            self.send({"kind": "progress", "text": stage})
        if self._can_stop and self.queue.stops_simulation():
            raise SupersededError

    @property
    def is_preview(self) -> bool:
        """Whether the views show a preview, or were left out for one."""
        return bool(self.views.left_out) or (self.result is not None and self.result.is_preview)

    def _complete(self) -> None:
        """Replace a preview by the complete result."""
        self._has_unused_memory = True
        self._is_dragging = self._needs_complete_result = False
        self.send({"kind": "busy"})
        try:
            self._simulate(self.history.settings)
        except SupersededError:
            return
        except CancelledError:
            self.send({"kind": "note", "text": "cancelled; the preview remains"})
        except Exception as error:  # noqa: BLE001 -- the preview stays, with the reason
            self._errors = {"": self.line(error)}
        self._send_state()
        self.send_parts()

    def _change(self, messages: list[Message], *, can_stop: bool = True) -> None:
        """Apply changes and simulate the result; after an error each change is applied separately."""
        if not messages:
            return
        kept = [
            message
            for message, following in zip(messages, [*messages[1:], None], strict=True)
            if following is None or not message.is_replaced_by(following)
        ]
        before = self.history.copy()
        self.send({"kind": "busy"})
        try:
            for message in kept:
                self._apply(message)
            self._key = kept[0].setting if len(kept) == 1 else None
            self._is_dragging = kept[-1].is_draft
            can_stop = can_stop and not any(message.is_once for message in kept)
            self._simulate(self.history.settings, can_stop=can_stop)
        except SupersededError:
            self.history = before
            raise
        except CancelledError as error:
            self.history, self._errors = before, {}
            self.send({"kind": "note", "text": str(error)})
        except Exception as error:  # noqa: BLE001 -- settings may cause any exception of the package or a library
            self.history = before
            if len(kept) > 1:
                for message in kept:
                    self._change([message], can_stop=False)
                return
            if isinstance(kept[0], SetValue) and not kept[0].is_temporary:
                self.history.commit(self.history.settings)  # a valid preview is the step
            self._errors = {kept[0].key_of_errors: self.line(error)}
        else:
            self._errors = {}
        self._last_id = messages[-1].id
        self._send_state()

    def _apply(self, message: Message) -> None:
        """Apply one change to the history."""
        before = self.history.settings
        found = handle(self, message)
        if found is None:
            return
        settings = self.files.resolve(found)
        if message.chooses_filters:
            match_filters(settings, before)
        check_settings(None, settings)
        if message.is_temporary:
            self.history.preview(settings)
        else:
            self.history.commit(settings)

    def _answer(self, message: Message) -> None:
        """Handle a message that does not change the settings."""
        self._last_id = message.id
        try:
            handle(self, message)
            self._send_state()
        except Exception as error:  # noqa: BLE001 -- messages of the page may cause any exception
            self._send_error(message.id, error)

    def _simulate(self, settings: dict[str, Any], *, can_stop: bool = True) -> None:
        settings, before = self.frames.with_current(settings), self._simulated_frame
        is_preview = self._is_dragging and self.costs.is_slow(self._key)
        result = self.result
        if result is not None and result.settings == settings and (is_preview or not result.is_preview):
            return
        self._can_stop = can_stop
        try:
            found = self.engine.simulate(settings, is_preview=is_preview)
        finally:
            self._can_stop = False
        self.queue.end_simulation()
        self._started_s = -math.inf
        if not found.is_preview:
            self.costs.add_simulation(self._key, found.seconds_s)
        self.use(found)
        self._simulated_frame = self.frames.stored_name
        if before is not None and before != self._simulated_frame:
            self.engine.forget(before)

    # -- interface of handlers --------------------------------------------------------------------------------------

    def layout_source(self) -> Callable[[Mapping[str, Any]], Layout | None]:
        """
        Return a function that returns the layout of the generator of settings, without edits.

        Without a generator it returns None. Later results do not affect it.
        """
        shown = None if self.result is None else self.result.capture.layout
        section = None if self.result is None else self.result.settings.get("layout")
        return lambda settings: generated_layout(settings, shown, section)

    def setter(self) -> Callable[[dict[str, Any], Sequence[tuple[str, Any]]], dict[str, Any]]:
        """Return a function that sets values as the page does now."""
        return partial(with_values, controls=self.controls, start=self.start.settings, layout_of=self.layout_source())

    def reduced(self, path: str) -> str:
        """Return the path of a picture, or of a reduced one if it is large."""
        if self.result is None:
            return path
        self.check(f"reading {Path(self.files.available(path)).name}")
        encoding = self.history.settings["scene"].get("encoding", "auto")
        return self.pictures.path_of(path, self.result.shot, encoding)

    def required_result(self, purpose: str) -> Simulated:
        """Return the current result; raise SimulationError if there is none."""
        if self.result is None:
            raise SimulationError(f"there is no result to {purpose}")
        return self.result

    def complete_result(self) -> Simulated:
        """Return the complete current result; raise SimulationError if there is none."""
        if self.required_result("freeze").is_preview:
            self._is_dragging = False
            self._simulate(self.history.settings, can_stop=False)
        return self.required_result("freeze")

    def use(self, result: Simulated) -> None:
        """Replace the current result."""
        self.result = result
        self._version += 1

    def send_again(self) -> None:
        """Send everything again, simulated if the result was released."""
        self.views.forget()
        self.sweeps.send()
        self._structure = None
        self.gaze.forget()
        self.frames.forget()
        if self.result is None:
            self.send({"kind": "busy"})
            self.compared.simulate_frozen(self.engine.simulate)
            try:
                self._simulate(self.history.settings, can_stop=False)
            except Exception as error:  # noqa: BLE001 -- shown at the settings
                self._errors = {"": self.line(error)}

    # -- answers ----------------------------------------------------------------------------------------------------

    def text(self, what: str, exported: tuple[dict[str, Any], dict[str, Path]] | None = None) -> str:
        """
        Return the current settings in a text format, or their changes as a difference.

        ``what``: {"yaml", "python", "notebook", "link", "diff", "log"}. ``exported``: as :meth:`exported` returns it,
        for several texts of the same state. Raises ParameterError when the format is unknown.
        """
        if what == "log":
            return _exports.log_of(self.history.states).replace(f"{self.uploads}/", "")
        settings, files = self.exported() if exported is None else exported
        return _exports.text_of(what, settings, self.start.settings, self.start.name, list(files))

    def exported(
        self, name_of: Callable[[Path], str] = lambda file: file.name
    ) -> tuple[dict[str, Any], dict[str, Path]]:
        """
        Return the current settings with names of uploaded files for their paths, and the files.

        ``name_of``: returns the name of a file. Returns ``files``: uploaded files by name, and the current frame of a source.
        """
        settings = self.history.settings
        return _exports.without_directories(settings, self.file_directories, self.frames.export(settings), name_of)

    def _send_state(self) -> None:
        settings, result = self.history.settings, self.result
        structure = structure_of(settings)
        if structure != self._structure:
            self._structure, self.controls = structure, controls_of(settings, self.start.settings)
            self.send({"kind": "controls", "controls": self.controls})
        gaze_path = self.gaze.message(settings, None if result is None else result.shot)
        if gaze_path is not None:
            self.send(gaze_path)
        film_times = self.frames.times_message()
        if film_times is not None:
            self.send(film_times)
        self.send({
            "kind": "state",
            "id": self._last_id,
            "version": self._version,
            "settings": settings,
            "changed": changed_keys(settings, self.start.settings),
            "can_undo": self.history.can_undo,
            "can_redo": self.history.can_redo,
            "errors": self._errors,
            "warnings": [] if result is None else result.warnings,
            "notes": self.pictures.notes_of(settings),
            "summary": {} if result is None else summary_of(result),
            "solved": {} if result is None else solved_of(result.settings, result.capture.layout),
            "frozen": self.compared.frozen,
            "variants": self.compared.about(self.variants),
            "film": self.frames.about(settings),
            "is_preview": result is not None and result.is_preview,
        })  # fmt: skip

    def send_parts(self, *, is_freeze: bool = False, is_followed: bool = False) -> None:
        """
        Compute and send the parts that changed, until newer messages interrupt.

        Those of a variant are complete; those of the current state follow them.
        """
        if self.result is None:
            return
        times_ms = self.views.send_changed(
            replace(
                self.result,
                compared=self.compared.shown(self.variants),
                pinned=tuple(site for site in self.pinned if site < self.result.capture.layout.n_sites),
            ),
            self._version,
            self._last_id,
            key=self._key,
            is_dragging=self._is_dragging,
            is_interrupted=lambda: not is_freeze and bool(self.queue.waiting),
        )
        if times_ms is not None:
            times_ms["simulation"] = 1e3 * self.result.seconds_s
            self.send({
                "kind": "done",
                "id": self._last_id,
                "version": self._version,
                "ms": times_ms,
                "is_preview": self.is_preview,
                "is_freeze": is_freeze,
                "is_followed": is_followed,
            })  # fmt: skip

    def send_text(self, number: Any, what: str, text: str, files: list[str]) -> None:
        """Answer a message with a text and the names of uploaded files that it requires."""
        self.send({"kind": "text", "id": number, "what": what, "text": text, "files": files})

    def line(self, error: BaseException) -> str:
        """Return an error in one line, in the words of the controls, without directories."""
        if isinstance(error, CancelledError):
            return str(error)
        return worded(one_line(error).replace(f"{self.uploads}/", ""))

    def _send_error(self, number: Any, error: BaseException) -> None:
        self.send({"kind": "error", "id": number, "text": self.line(error)})

    def _wait_for_page(self) -> None:
        """Wait until a page has drawn the photosites, so that later work does not delay it."""
        if any(self._listeners.values()):
            self.queue.wait_until_drawn(self._version)

    def send(self, message: dict[str, Any] | bytes) -> None:
        """Send plain data, or a part, to all connections."""
        sent = message if isinstance(message, bytes) else json.dumps(to_json(message), allow_nan=False)
        for listener in list(self._listeners):
            with suppress(Exception):
                listener(sent)

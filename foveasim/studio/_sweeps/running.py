"""Sweep of a session: its points are computed one by one while no message waits."""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foveasim.config import RegionResult, check_settings
from foveasim.errors import SimulationError
from foveasim.explore import result_of
from foveasim.metrics import metric_info
from foveasim.studio._costs import SupersededError
from foveasim.studio._engine import Simulated
from foveasim.studio._messages.models import Message, SendSweepFile, StartSweep, StopSweep, handles
from foveasim.studio._settings.values import present_number
from foveasim.studio._sweeps.files import sweep_file
from foveasim.studio._sweeps.request import Axis, about_result, axes_of, results_of

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Shortest time between two messages with partial results.
SEND_S = 0.1
#: Messages interrupt a point for at most this time in succession, so that sweeps advance while a slider is dragged.
MAX_STOPPED_S = 3.0


class Sweep:
    """
    Points of a sweep with their results; the first one has the settings at the start.

    ``number``: that of the message. ``base``: settings at the start. ``present``: values of the axes in these. ``change``:
    returns settings with values, as the page sets them.
    """

    def __init__(
        self,
        number: Any,
        base: dict[str, Any],
        axes: Sequence[Axis],
        results: Sequence[RegionResult],
        present: Sequence[Any],
        change: Callable[[dict[str, Any], Sequence[tuple[str, Any]]], dict[str, Any]],
    ) -> None:
        self.number, self.base, self.axes, self.results = number, base, axes, results
        self._present, self._change = present, change
        self._points = list(itertools.product(*(axis.values for axis in axes)))
        self._settings: list[dict[str, Any] | None] = [None] * len(self._points)
        #: Values of the results: of the settings at the start, and of the points so far.
        self._values: list[list[float]] = []
        #: Fraction of saturated photosites in these, which is sent where a result depends on it.
        self._saturated: list[float] = []
        self._is_of_signals = any(metric_info(each.measure).is_of_signals for each in results)
        self._problem = ""
        self.is_stopped = False
        #: Time of the first interruption of the present point.
        self.stopped_s: float | None = None

    @property
    def is_running(self) -> bool:
        """Whether points are still to be computed."""
        return not self.is_stopped and len(self._values) <= len(self._points)

    def settings_of(self, point: int) -> dict[str, Any]:
        """Return the settings of a point, which share equal sections with those at the start."""
        known = self._settings[point]
        if known is not None:
            return known
        pairs = [(axis.key, value) for axis, value in zip(self.axes, self._points[point], strict=True)]
        changed = self._change(self.base, pairs)
        found = {name: self.base[name] if self.base.get(name) == each else each for name, each in changed.items()}
        self._settings[point] = found
        return found

    def compute_next(
        self, simulate: Callable[[dict[str, Any]], Simulated], line: Callable[[BaseException], str]
    ) -> None:
        """
        Compute the next point; its error is stored.

        Raises SupersededError when the simulation was interrupted: the point is then still the next one.
        """
        values, saturated = [math.nan] * len(self.results), 0.0
        try:
            done = len(self._values)
            simulated = simulate(self.base if done == 0 else self.settings_of(done - 1))
        except SupersededError:
            self.stopped_s = time.monotonic() if self.stopped_s is None else self.stopped_s
            raise
        except Exception as error:  # noqa: BLE001 -- settings may cause any exception of the package or a library
            self._explain(line(error))
        else:
            values = [self._measured(result, simulated, line) for result in self.results]
            saturated = simulated.capture.saturated_fraction
        self.stopped_s = None
        self._values.append(values)
        self._saturated.append(saturated)

    def _measured(self, result: RegionResult, simulated: Simulated, line: Callable[[BaseException], str]) -> float:
        """Return a result; NaN after an error, which is stored."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # those of the simulation are in the state
                found = result_of(result, simulated.shot, simulated.capture)
        except Exception as error:  # noqa: BLE001 -- as above
            self._explain(line(error))
            return math.nan
        if math.isnan(found):
            self._explain(f"{result.subject}: no value, for example because all photosites are saturated")
        return found

    def _explain(self, text: str) -> None:
        """Store the first problem of a point, which is not that of the settings at the start."""
        if self._values:
            self._problem = self._problem or text

    def about(self) -> dict[str, Any]:
        """Return the sweep with its results so far as a message."""
        points = self._values[1:]
        return {
            "kind": "sweep",
            "id": self.number,
            "state": "running" if self.is_running else "stopped" if self.is_stopped else "done",
            "axes": [axis.about() for axis in self.axes],
            "results": [about_result(result) for result in self.results],
            "n_points": len(self._points),
            "start": {"settings": list(self._present), "results": self._values[0] if self._values else None},
            "points": points,
            "saturated": self._saturated[1:] if self._is_of_signals else None,
            "problem": self._problem,
            "n_failed": sum(any(math.isnan(value) for value in point) for point in points),
        }

    def file(self, directories: Sequence[Path]) -> tuple[str, list[str]]:
        """Return the file for ``foveasim sweep``, and the uploaded files that it requires."""
        settings = [self.settings_of(point) for point in range(len(self._points))]
        return sweep_file(self.base, settings, self.axes, self.results, directories)


class Sweeps:
    """
    The sweep of a session.

    ``send``: sends a message to the page. ``line``: returns an error in one line.
    """

    def __init__(self, send: Callable[[dict[str, Any]], None], line: Callable[[BaseException], str]) -> None:
        self._send, self._line = send, line
        self._sweep: Sweep | None = None
        self._sent_s = -math.inf
        self.is_computing = False

    @property
    def is_running(self) -> bool:
        """Whether points are still to be computed."""
        return self._sweep is not None and self._sweep.is_running

    def start(self, sweep: Sweep) -> None:
        """Replace the sweep."""
        self._sweep = sweep
        self.send()

    def stop(self) -> None:
        """End the sweep; the results so far remain."""
        if self._sweep is not None and self._sweep.is_running:
            self._sweep.is_stopped = True
            self.send()

    def send(self) -> None:
        """Send the sweep with its results so far, if there is one."""
        if self._sweep is not None:
            self._sent_s = time.monotonic()
            self._send(self._sweep.about())

    def compute_next(self, simulate: Callable[[dict[str, Any]], Simulated]) -> None:
        """Compute a point and send the results so far, not more often than the page can show them."""
        assert self._sweep is not None
        self.is_computing = True
        try:
            self._sweep.compute_next(simulate, self._line)
        except SupersededError:
            return
        finally:
            self.is_computing = False
        if not self.is_running or time.monotonic() - self._sent_s >= SEND_S:
            self.send()

    def is_interrupted(self, waiting: Iterable[Message]) -> bool:
        """Return whether messages that wait interrupt the present point; frames of a video do not."""
        others = [message for message in waiting if not message.is_frame]
        if any(message.ends_points for message in others):
            return True
        stopped_s = None if self._sweep is None else self._sweep.stopped_s
        return bool(others) and (stopped_s is None or time.monotonic() - stopped_s < MAX_STOPPED_S)

    def file(self, directories: Sequence[Path]) -> tuple[str, list[str]]:
        """
        Return the file of the sweep, and the names of uploaded files that it requires.

        Raises SimulationError when there was no sweep.
        """
        if self._sweep is None:
            raise SimulationError("there is no sweep; run one first")
        return self._sweep.file(directories)


@handles(StartSweep)
def _start(session: Session, message: StartSweep) -> None:
    result, base, set_values = (
        session.required_result("start from"),
        session.frames.with_file(session.history.settings),
        session.setter(),
    )
    axes = axes_of(message.settings, session.controls)
    present = [present_number(base, axis.control, result) for axis in axes]

    def change(settings: dict[str, Any], values: Sequence[tuple[str, Any]]) -> dict[str, Any]:
        found: dict[str, Any] = session.files.resolve(set_values(settings, values))
        check_settings(None, found)
        return found

    session.sweeps.start(Sweep(message.id, base, axes, results_of(message.results), present, change))


@handles(StopSweep)
def _stop(session: Session, _message: StopSweep) -> None:
    session.sweeps.stop()


@handles(SendSweepFile)
def _send_file(session: Session, message: SendSweepFile) -> None:
    session.send_text(message.id, "sweep", *session.sweeps.file(session.file_directories))

"""Queue of a session: messages that wait, and the loop of the thread that handles them."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

from foveasim.studio._messages.models import CameraFrame, Cancel, Drawn, Message, handles

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Largest number of messages that wait.
MAX_WAITING = 1000
#: Newer changes stop simulations for at most this time in succession, so that some are shown.
MAX_STOPPED_S = 3.0
#: Longest time for which views wait until a page has drawn the photosites.
DRAWN_S = 0.5


class IdleWork(NamedTuple):
    """Work after a time without messages; ``is_cancellable``: whether ``cancel`` stops it."""

    after_s: float
    do: Callable[[], None]
    is_cancellable: bool = True


class Queue:
    """
    Messages of a page that wait for the thread of a session.

    ``handle``: receives all that wait. ``idle_work``: returns the next work without messages, or None. ``report``: receives
    exceptions.
    """

    def __init__(
        self,
        handle: Callable[[list[Message]], None],
        idle_work: Callable[[], IdleWork | None],
        report: Callable[[BaseException], None],
    ) -> None:
        self._handle, self._idle_work, self._report = handle, idle_work, report
        self.waiting: deque[Message] = deque()
        self.wake = threading.Condition()
        self.is_closed = self.is_cancelled = self._is_working = False
        self.last_used_s = time.monotonic()
        self._drawn_version = 0
        self._stopped_s = -math.inf

    def add(self, message: Message) -> bool:
        """Add a message, a frame instead of a waiting one; return False if too many wait."""
        with self.wake:
            self.last_used_s = time.monotonic()
            is_first = getattr(message, "is_first", False)
            if message.is_frame and not is_first and self.waiting and self.waiting[-1].is_frame:
                before = self.waiting.pop()
                if isinstance(message, CameraFrame):
                    message.is_first = getattr(before, "is_first", False)
            if len(self.waiting) >= MAX_WAITING:
                return False
            self.waiting.append(message)
            self.wake.notify()
        return True

    def put_back(self, messages: Sequence[Message]) -> None:
        """Let messages wait again, before newer ones."""
        with self.wake:
            self.waiting.extendleft(reversed(messages))

    def wake_up(self) -> None:
        """Let the thread look for idle work again."""
        with self.wake:
            self.last_used_s = time.monotonic()
            self.wake.notify()

    def cancel(self) -> None:
        """Stop the work in progress, and what waits."""
        with self.wake:
            self.is_cancelled = self._is_working or bool(self.waiting)

    def close(self) -> None:
        """End the thread."""
        with self.wake:
            self.is_closed = True
            self.wake.notify()

    # -- thread -----------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Handle messages, and work in the time between them, until the queue is closed."""
        while True:
            with self.wake:
                work = self._wait()
                if self.is_closed:
                    return
                messages = list(self.waiting)
                self.waiting.clear()
                self._is_working = bool(messages) or work is None or work.is_cancellable
            try:
                if messages:
                    self._handle(messages)
                elif work is not None:
                    work.do()
            except BaseException as error:  # noqa: BLE001 -- the session continues with its last valid state
                self._report(error)
            finally:
                with self.wake:
                    self._end_work()

    def _wait(self) -> IdleWork | None:
        """Wait for a message, the end, or the time of idle work, and return this work."""
        while not self.waiting and not self.is_closed:
            work = self._idle_work()
            if not self.wake.wait(None if work is None else work.after_s):
                return work
        return None

    @contextmanager
    def working(self) -> Iterator[None]:
        """Let ``cancel`` stop the work in the context."""
        self._is_working = True
        try:
            yield
        finally:
            self._end_work()

    def _end_work(self) -> None:
        self.is_cancelled = self._is_working = False

    # -- work in progress -------------------------------------------------------------------------------------------

    def stops_simulation(self) -> bool:
        """Return whether a newer change waits, and has not stopped simulations for too long."""
        if not any(message.is_change and not message.is_once for message in list(self.waiting)):
            return False
        now_s = time.monotonic()
        if self._stopped_s == -math.inf:
            self._stopped_s = now_s
        return now_s - self._stopped_s < MAX_STOPPED_S

    def end_simulation(self) -> None:
        """Let newer changes stop the next simulation again."""
        self._stopped_s = -math.inf

    def draw(self, version: int) -> None:
        """Store that the page has drawn the photosites of a version."""
        with self.wake:
            self._drawn_version = version
            self.wake.notify()

    def wait_until_drawn(self, version: int) -> None:
        """Wait until the page has drawn a version, a message waits, or some time has passed."""
        with self.wake:
            self.wake.wait_for(lambda: self._drawn_version >= version or bool(self.waiting) or self.is_closed, DRAWN_S)


@handles(Drawn)
def _draw(session: Session, message: Drawn) -> None:
    session.queue.draw(message.version)


@handles(Cancel)
def _cancel(session: Session, _message: Cancel) -> None:
    session.queue.cancel()

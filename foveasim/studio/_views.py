"""Views that a page shows: each is computed and sent when what it depends on changed."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any
from weakref import ref

from foveasim.config import Shot
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.studio._costs import Costs
from foveasim.studio._engine import PICTURE_PIXELS, Simulated
from foveasim.studio._messages.encoding import encode_part
from foveasim.studio._messages.models import PinSites, Refresh, SelectViews, handles
from foveasim.studio._parts import PARTS, Part, PartData
from foveasim.studio._parts.registry import FIRST_TILE

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Parts that are sent first and together: sites, and their values.
FIRST = ("sites", "columns", "signals")
#: The page draws the parts of a change in one frame if those after the photosites are expected within the first time, and
#: otherwise those of the second: each frame takes a browser tens of milliseconds.
SOON_S, TOGETHER_S = 0.04, 0.1
#: Views that are expected to take longer wait until the page has drawn the photosites: both need the processor.
AWAITED_S = 0.2


class Views:
    """
    Selected views, and what was sent of them.

    ``send``: receives parts as bytes, and errors as dicts. ``wait_for_page``: waits until the page has
    drawn the photosites. ``line``: returns its message in one line. ``costs``: receives the times of views;
    slow ones are left out during drags.
    """

    def __init__(
        self,
        send: Callable[[dict[str, Any] | bytes], None],
        wait_for_page: Callable[[], None],
        line: Callable[[BaseException], str],
        costs: Costs,
    ) -> None:
        self._send, self._wait_for_page, self._line, self._costs = send, wait_for_page, line, costs
        self.left_out: list[str] = []
        self._names = [name for name, part in PARTS.items() if part.has_data and not (part.is_lazy or part.is_costly)]
        self._pixels = PICTURE_PIXELS
        # Weak references to what each view was computed from: a view that is not shown retains no earlier result.
        self._sent: dict[str, list[Any]] = {}
        self._version: dict[str, int] = {}
        self._layout: ref[Layout] | None = None

    def select(self, names: list[str], pixels: int | None = None) -> None:
        """
        Set the views that are sent.

        ``pixels``: longer side of pictures. Raises ParameterError when a name is unknown.
        """
        if not set(names) <= set(PARTS):
            raise ParameterError("names", f"must be a list of names of views: {', '.join(PARTS)}")
        self._names = [name for name in PARTS if name in names]
        self._pixels = self._pixels if pixels is None else pixels

    def work_ahead(self, shot: Shot) -> None:
        """Start what views require of a new layout while it is simulated."""
        layout = shot.camera.layout
        if self._layout is not None and self._layout() is layout:
            return
        self._layout = ref(layout)
        for name in self._names:
            if (start := PARTS[name].work_ahead) is not None:
                start(shot)

    def forget(self, name: str | None = None) -> None:
        """Send a view again, or all."""
        for each in list(self._sent) if name is None else [name]:
            self._sent.pop(each, None)
            self._version.pop(each, None)

    def send_changed(
        self,
        result: Simulated,
        version: int,
        number: Any,
        *,
        key: str | None,
        is_dragging: bool,
        is_interrupted: Callable[[], bool],
    ) -> dict[str, float] | None:
        """
        Compute and send the views that changed.

        ``version``: number of the result. ``number``: number of the message that is answered. ``key``: setting that changed.
        ``is_dragging``: whether slow views are left out. ``is_interrupted``: whether newer messages wait: later views are then
        left to the next call. Returns ``times_ms``: times by view, for the message that follows the last one; None after an
        interruption.
        """
        result = replace(result, picture_pixels=self._pixels)
        times_ms: dict[str, float] = {}
        self.left_out = []
        drawn_s = time.perf_counter()
        shown = [name for name in self._names if result.compared or not PARTS[name].is_of_variants]
        # Sites and their values belong together; the others in the order of their age, small ones before images.
        first = [name for name in FIRST if name in shown]
        names = first + sorted(
            set(shown) - set(first),
            key=lambda name: (self._version.get(name, -1), PARTS[name].order < FIRST_TILE, shown.index(name)),
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # those of the simulation are in the state
            for k, name in enumerate(names):
                part = PARTS[name]
                depends = self._attempt(part, number, _depends_of, part, result)
                if depends is None or (name in self._sent and _is_same(self._sent[name], depends)):
                    self._version[name] = version
                    continue
                together = first if name in first else [name]
                is_slow = any(self._costs.is_slow_part(key, each) for each in together)
                if is_dragging and (part.is_costly or is_slow):
                    self.left_out.append(name)
                    continue
                start_s = time.perf_counter()
                data = self._attempt(part, number, _data_of, part, result)
                self._sent[name], self._version[name] = [_weak(each) for each in depends], version
                time_s = time.perf_counter() - start_s
                times_ms[name] = 1e3 * time_s
                self._costs.add_part(key, name, time_s)
                is_stopped = k >= len(first) and is_interrupted()
                is_late = k + 1 >= len(first) and time.perf_counter() - drawn_s > TOGETHER_S
                is_last = k + 1 == len(first)
                rest_s = self._costs.parts_s(key, names[k + 1 :])
                has_slow = is_last and rest_s > SOON_S
                is_drawn = is_stopped or is_late or has_slow
                is_awaited = is_last and rest_s > AWAITED_S and not is_stopped
                if data is not None:
                    options = {"is_preview": result.is_preview, "has_more": not is_drawn, "is_awaited": is_awaited}
                    message = self._attempt(part, number, encode_part, name, version, *data, **options)
                    if message is not None:
                        self._send(message)
                if is_awaited:
                    self._wait_for_page()
                if is_drawn:
                    drawn_s = time.perf_counter()
                if is_stopped:
                    return None
        return times_ms

    def _attempt(self, part: Part, number: Any, call: Callable[..., Any], *values: Any, **options: Any) -> Any:
        """Return the result of a call; None after an exception, which is sent."""
        try:
            return call(*values, **options)
        except Exception as error:  # noqa: BLE001 -- of any view
            self._send({"kind": "error", "id": number, "part": part.name, "text": f"{part.label}: {self._line(error)}"})
            return None


def _depends_of(part: Part, result: Simulated) -> tuple[Any, ...]:
    """Return the objects that determine the data of a view."""
    return tuple(part.depends(result))


def _data_of(part: Part, result: Simulated) -> PartData:
    """Return the data of a view; a value that is not a pair raises an exception."""
    about, arrays = part.make(result)
    return about, arrays


def _weak(value: Any) -> Any:
    """Return a weak reference to an object; tuples and small objects without one themselves."""
    return ref(value) if type(value).__weakrefoffset__ else value


def _is_same(old: list[Any], new: tuple[Any, ...]) -> bool:
    """Return whether the references are to the same objects, and tuples are equal."""
    return len(old) == len(new) and all(
        a() is b if isinstance(a, ref) else a is b or (isinstance(b, tuple) and a == b)
        for a, b in zip(old, new, strict=True)
    )


@handles(Refresh)
def _refresh(session: Session, _message: Refresh) -> None:
    session.send_again()


@handles(SelectViews)
def _select(session: Session, message: SelectViews) -> None:
    session.views.select(message.names, message.pixels)


@handles(PinSites)
def _pin(session: Session, message: PinSites) -> None:
    session.pinned = tuple(dict.fromkeys(each for each in message.sites if each >= 0))

"""Work for views that depends on the layout only, while the photosites are simulated."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock
from typing import Any, Generic, TypeVar
from weakref import WeakKeyDictionary

from foveasim.layout import Layout

__all__ = ["MANY_SITES", "Ahead"]

_Result = TypeVar("_Result")
#: With more photosites only their outlines are computed ahead: other work would delay them.
MANY_SITES = 50_000
_executor = ThreadPoolExecutor(1, "studio views")


class Ahead(Generic[_Result]):
    """
    A function of a layout and other values whose results may be computed ahead.

    ``compute``: the function. A call takes the result that was started for the layout, or computes it.
    """

    def __init__(self, compute: Callable[..., _Result]) -> None:
        self._compute = compute
        self._lock = Lock()  # of the threads of several sessions
        self._started: WeakKeyDictionary[Layout, tuple[tuple[Any, ...], Future[_Result]]] = WeakKeyDictionary()

    def start(self, layout: Layout, *values: Any) -> None:
        """Start to compute a result; those of other layouts that have not begun are given up."""
        with self._lock:
            for _, future in self._started.values():
                future.cancel()
            self._started[layout] = values, _executor.submit(self._compute, layout, *values)

    def started(self, layout: Layout, *values: Any) -> Future[_Result] | None:
        """Remove and return a result that was started; None if there is none, or it has not begun."""
        with self._lock:
            found, future = self._started.pop(layout, (None, None))
        return None if future is None or future.cancel() or found != values else future

    def __call__(self, layout: Layout, *values: Any) -> _Result:
        future = self.started(layout, *values)
        return self._compute(layout, *values) if future is None else future.result()

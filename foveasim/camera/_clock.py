"""Times of the stages of a capture."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Clock:
    """Elapsed seconds of named stages."""

    def __init__(self) -> None:
        self.stage_s: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start_s = time.perf_counter()
        yield
        self.stage_s[name] = self.stage_s.get(name, 0.0) + time.perf_counter() - start_s

    def add(self, other: Clock) -> None:
        """Add the seconds of another clock."""
        for name, s in other.stage_s.items():
            self.stage_s[name] = self.stage_s.get(name, 0.0) + s

    def take(self) -> Clock:
        """Return the seconds since the last call, and reset."""
        before = Clock()
        before.stage_s, self.stage_s = self.stage_s, {}
        return before

"""Times of simulations and views by setting, which decide what previews leave out."""

from __future__ import annotations

from collections.abc import Iterable

#: Simulations and views that take longer are reduced or left out while a control is dragged.
SLOW_S = 0.15
#: Idle time after which a preview is replaced by the complete result.
PREVIEW_IDLE_S = 0.3
#: Idle time after which unused memory is returned to the operating system.
RELEASE_S = 5.0
#: Idle time after which a session without a page releases its results.
FORGET_S = 20.0
#: Settings that no stage with a scene depends on.
FAST_KEYS = ("exposure_s", "seed")
#: An earlier time counts with this factor: stages may come from the cache once.
DECAY = 0.5


class SupersededError(Exception):
    """A newer change waits: the simulation stops."""


class CancelledError(Exception):
    """The user has cancelled a change."""


class Costs:
    """Times of complete simulations and of views, by the setting that changed."""

    def __init__(self) -> None:
        self._simulation_s: dict[str | None, float] = {}
        self._part_s: dict[tuple[str | None, str], float] = {}

    def add_simulation(self, key: str | None, time_s: float) -> None:
        """Store the time of a complete simulation after a change of a setting."""
        self._simulation_s[key] = max(time_s, DECAY * self._simulation_s.get(key, 0.0))

    def add_part(self, key: str | None, name: str, time_s: float) -> None:
        """Store the time of a view after a change of a setting."""
        self._part_s[key, name] = max(time_s, DECAY * self._part_s.get((key, name), 0.0))

    def is_slow(self, key: str | None) -> bool:
        """Return whether a change of a setting may take long; unknown ones may."""
        return key not in FAST_KEYS and self._simulation_s.get(key, 2.0 * SLOW_S) > SLOW_S

    def parts_s(self, key: str | None, names: Iterable[str]) -> float:
        """Return the expected time of views after a change of a setting, s."""
        return sum(self._part_s.get((key, name), 0.0) for name in names)

    def is_slow_part(self, key: str | None, name: str) -> bool:
        """Return whether a view took long after a change of a setting."""
        return self._part_s.get((key, name), 0.0) > SLOW_S

"""Cache of computed values, limited in number."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

from foveasim._core.threads import ForkSafeLock


class BoundedCache:
    """
    Values by key, each computed once, and limited in number.

    Values that have not been used recently are discarded, and computed again when required. Reading a stored value takes no
    lock. Neither the lock nor the values are part of the state: copies and pickles are empty.
    """

    def __init__(self, max_values: int) -> None:
        self.max_values = max_values
        self._values: dict[Hashable, Any] = {}
        # Objects whose addresses are part of a key: an address is unique only while its object exists.
        self._owners: dict[Hashable, Any] = {}
        self._used: set[Hashable] = set()
        # Reentrant: computing a value may use other values.
        self._lock = ForkSafeLock()

    def __reduce__(self) -> tuple[Any, ...]:
        return BoundedCache, (self.max_values,)

    def __len__(self) -> int:
        return len(self._values)

    def get(self, key: Hashable, compute: Callable[[], Any], *, owner: Any = None) -> Any:
        """
        Return the value of a key, computed at the first call.

        ``compute``: called without arguments. ``owner``: stored with the value, so that the addresses of its parts remain
        theirs.
        """
        try:
            value = self._values[key]
        except KeyError:
            with self._lock:
                if key not in self._values:
                    value = compute()
                    self._make_room()
                    self._owners[key] = owner
                    self._values[key] = value
                    return value
                value = self._values[key]
        self._used.add(key)
        return value

    def _make_room(self) -> None:
        """Remove the oldest values that were not used since the last search (clock algorithm)."""
        while len(self._values) >= self.max_values:
            key = next(iter(self._values))
            value, owner = self._values.pop(key), self._owners.pop(key)
            if key in self._used:
                self._used.discard(key)
                self._owners[key] = owner
                self._values[key] = value

"""Undo and redo of settings."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from foveasim.errors import SimulationError
from foveasim.studio._messages.models import Redo, Undo, handles

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Largest number of undo steps; earlier ones are discarded.
MAX_STEPS = 1000


class History:
    """
    Settings with undo and redo.

    A draft is a state while a control is dragged: it is not an undo step.

    ``start``: initial settings.
    """

    def __init__(self, start: Mapping[str, Any]) -> None:
        self._past: list[dict[str, Any]] = []
        self._future: list[dict[str, Any]] = []
        self._present: dict[str, Any] = copy.deepcopy(dict(start))
        self._draft: dict[str, Any] | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """The current settings, drafts included; edit a copy."""
        return self._present if self._draft is None else self._draft

    @property
    def can_undo(self) -> bool:
        """Whether there is an earlier state."""
        return bool(self._past) or self._draft is not None

    @property
    def can_redo(self) -> bool:
        """Whether there is a later state."""
        return bool(self._future)

    @property
    def states(self) -> list[dict[str, Any]]:
        """All states from the start to the current one, without drafts."""
        return [*self._past, self._present]

    def preview(self, settings: dict[str, Any]) -> None:
        """Show settings without an undo step."""
        self._draft = settings

    def commit(self, settings: dict[str, Any]) -> None:
        """Set the settings as one undo step; equal settings are none."""
        self._draft = None
        if settings == self._present:
            return
        self._past = [*self._past, self._present][-MAX_STEPS:]
        self._future = []
        # States share their equal sections.
        self._present = {
            name: before if (before := self._present.get(name)) == section else section
            for name, section in settings.items()
        }

    def undo(self) -> bool:
        """Return to the state before the last step; a draft is discarded first."""
        if self._draft is not None:
            self._draft = None
            return True
        if not self._past:
            return False
        *self._past, earlier = self._past
        self._future = [*self._future, self._present]
        self._present = earlier
        return True

    def redo(self) -> bool:
        """Repeat the step that was undone last."""
        if not self._future:
            return False
        self._draft = None
        *self._future, later = self._future
        self._past = [*self._past, self._present]
        self._present = later
        return True

    def mapped(self, change: Callable[[dict[str, Any]], dict[str, Any]]) -> History:
        """Return an independent history with changed states."""
        other = History({})
        other._past, other._future = [change(each) for each in self._past], [change(each) for each in self._future]
        other._present, other._draft = change(self._present), None if self._draft is None else change(self._draft)
        return other

    def copy(self) -> History:
        """Return an independent history with the same states, which are not copied."""
        other = History({})
        other._past, other._future = self._past, self._future
        other._present, other._draft = self._present, self._draft
        return other


@handles(Undo)
@handles(Redo)
def _step(session: Session, message: Undo | Redo) -> None:
    if not (session.history.undo() if isinstance(message, Undo) else session.history.redo()):
        raise SimulationError(f"there is no step to {message.do}")

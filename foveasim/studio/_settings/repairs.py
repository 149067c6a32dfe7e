"""Repair of the layout: what each method would change, and the edit that applies one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, get_args

from foveasim.config import get_setting
from foveasim.errors import FoveasimError, ParameterError
from foveasim.layout.drc.repair import Repair
from foveasim.studio._messages.models import PreviewRepairs, RepairLayout, handles

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Kind of the edit.
REPAIR = "repair"


def with_repair(settings: Mapping[str, Any], method: str) -> dict[str, Any]:
    """
    Return settings whose last edit is a repair by a method, instead of an earlier one.

    Raises ParameterError when the layout has no design rules.
    """
    if get_setting(settings, "layout.rules") is None:
        raise ParameterError("layout.rules", "must be given: the repair is that of their violations")
    edits = list(get_setting(settings, "layout.edits") or [])
    if edits and edits[-1].get("kind") == REPAIR:
        edits.pop()
    return {**settings, "layout": {**settings["layout"], "edits": [*edits, {"kind": REPAIR, "method": method}]}}


@handles(RepairLayout)
def _repair(session: Session, message: RepairLayout) -> dict[str, Any]:
    return with_repair(session.history.settings, message.method)


@handles(PreviewRepairs)
def _preview(session: Session, message: PreviewRepairs) -> None:
    """Send the changes of each method until another message waits; keep the layouts."""
    session.send({"kind": "busy"})
    settings = session.frames.with_current(session.history.settings)
    for method in get_args(Repair):
        if session.queue.waiting:
            return
        session.check(f"repair: {method}")
        try:
            layout = session.engine.layout(with_repair(settings, method))
            found = layout.provenance["repairs"][-1]
        except FoveasimError as error:
            found = {"method": method, "text": session.line(error)}
        session.send({"kind": "repair", "id": message.id, **found})

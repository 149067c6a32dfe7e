"""Values that a page sets, one or several at once, and the settings that are numbers."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from foveasim.config import get_setting, put_setting
from foveasim.config._electronics import ELECTRONICS
from foveasim.errors import ParameterError, printable
from foveasim.layout import Layout
from foveasim.studio._engine import Simulated
from foveasim.studio._files import apply_preset
from foveasim.studio._messages.models import AssignValues, SetValue, handles
from foveasim.studio._settings.changes import choose_electronics
from foveasim.studio._settings.controls import chosen_value
from foveasim.studio._settings.unknowns import balanced, solved_of

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Kinds of controls of numbers.
NUMBERS = ("number", "integer")
#: Setting that may also be a string, such as "auto".
EXPOSURE = "exposure_s"


def with_values(
    settings: dict[str, Any],
    values: Sequence[tuple[str, Any]],
    *,
    controls: Sequence[Mapping[str, Any]],
    start: Mapping[str, Any],
    layout_of: Callable[[Mapping[str, Any]], Layout | None],
) -> dict[str, Any]:
    """
    Return settings with values that are set one after the other.

    ``controls``: those of the page. ``start``: initial settings. ``layout_of``: returns the generator's layout of settings,
    None without one.
    """
    for key, value in values:
        before, settings = settings, copy.deepcopy(settings)
        if key == "layout" and isinstance(value, str):
            settings = apply_preset(f"layout:{value}", settings)
        else:
            put_setting(None, settings, key, chosen_value(key, copy.deepcopy(value), controls, settings, start))
        settings = balanced(settings, key, before, layout_of)
        if key.rpartition(".")[::2] in [("sensor", name) for name in ELECTRONICS]:
            choose_electronics(settings)
    return settings


def number_control(controls: Sequence[Mapping[str, Any]], key: str) -> Mapping[str, Any]:
    """
    Return the control of a setting that is a number; the exposure may also be a string.

    Raises ParameterError when there is none.
    """
    for control in controls:
        if control["key"] == key and (control["kind"] in NUMBERS or key == EXPOSURE):
            return control
    raise ParameterError("key", "must be the key of a number", printable(key)[:40])


def present_number(settings: Mapping[str, Any], control: Mapping[str, Any], result: Simulated) -> Any:
    """Return the present value of a number, also a solved, automatic or default one."""
    key = control["key"]
    present = get_setting(settings, key)
    if key == EXPOSURE and not isinstance(present, int | float):
        return result.shot.exposure_s
    return solved_of(settings, result.capture.layout).get(key, control["default"]) if present is None else present


@handles(SetValue)
def _set(session: Session, message: SetValue) -> dict[str, Any]:
    return session.setter()(session.history.settings, [(message.key, message.value)])


@handles(AssignValues)
def _assign(session: Session, message: AssignValues) -> dict[str, Any]:
    return session.setter()(session.history.settings, [(each.key, each.value) for each in message.values])

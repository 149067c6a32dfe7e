"""
Messages that a page sends: fields, limits, treatment by a session, and handlers.

The description of a field completes "must be" in errors. ``types.d.ts`` follows from the models.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PrivateAttr, ValidationError
from pydantic.json_schema import SkipJsonSchema

from foveasim.errors import ParameterError, printable
from foveasim.layout.drc.repair import Repair
from foveasim.studio._engine import MAX_SITES
from foveasim.studio._messages.encoding import from_json

#: Largest depth of settings.
MAX_DEPTH = 20
#: Largest number of values that are set at once, of settings and results of a sweep, of photosites that charts compare, and
#: of variants that are compared with the current state.
MAX_VALUES, MAX_SWEPT, MAX_PINNED, MAX_COMPARED = 100, 2, 6, 5
#: Limit of the longer side of pictures.
MAX_PIXELS = 2048
#: Fields that a page may leave undefined, which is an error.
UNCHECKED: Any = {"unchecked": True}

Text = Annotated[str, Field(description="a string")]
Flag = Annotated[bool, Field(description="true or false")]
Number = Annotated[int | float | None, Field(description="a number")]
Positive = Annotated[int | float | None, Field(gt=0, allow_inf_nan=False, description="a positive number")]
Path = Annotated[str, Field(description="the path of a file", json_schema_extra=UNCHECKED)]
PATH_OF_SETTING = Field(
    max_length=500, pattern=r"^[^.]+(\.[^.]+)*$", description="the path of a setting, such as sensor.bits"
)
Key = Annotated[str, PATH_OF_SETTING]
Plain = BeforeValidator(lambda value: from_json(value, MAX_DEPTH))
Value = Annotated[Any, Plain, Field(description=f"plain data with at most {MAX_DEPTH} levels")]
TREE = Field(description=f"a mapping with at most {MAX_DEPTH} levels", json_schema_extra=UNCHECKED)
Mapping = Annotated[dict[str, Any], Plain, TREE]


def _items(low: int, high: int, items: str, **options: Any) -> Any:
    """Return a field of a list with a number of items."""
    number = f"{low} to {high}" if low else f"at most {high}"
    return Field(min_length=low, max_length=high, description=f"a list of {number} {items}", **options)


def _integer(low: int, high: int, default: Any = ...) -> Any:
    """Return a field of an integer within limits."""
    return Field(default, ge=low, le=high, description=f"an integer from {low} to {high:,}")


def _must_be(words: str, default: Any = ..., **options: Any) -> Any:
    """Return a field whose error is that it "must be" what the words say."""
    return Field(default, description=words, **options)


class Message(BaseModel):
    """
    Message of a page, with the number that its answer has.

    ``do``: its name. ``is_change``: whether it changes the settings. ``is_immediate``: handled at once, in the thread of the
    server. ``is_once``: its simulation is not stopped by newer changes, and stops none. ``is_frame``: changes the frame of a
    video or camera. ``ends_points``: interrupts points of a sweep at any time.
    """

    model_config = ConfigDict(strict=True)

    do: ClassVar[str] = ""
    is_change: ClassVar[bool] = False
    is_immediate: ClassVar[bool] = False
    is_once: ClassVar[bool] = False
    is_frame: ClassVar[bool] = False
    ends_points: ClassVar[bool] = False

    id: SkipJsonSchema[Any] = None
    _problem: ParameterError | None = PrivateAttr(None)

    def __init_subclass__(cls, do: str = "", **treatment: bool) -> None:
        super().__init_subclass__()
        for name, value in treatment.items():
            setattr(cls, name, value)
        if do:
            cls.do, MESSAGES[do] = do, cls

    @classmethod
    def invalid(cls, data: dict[str, Any], problem: ParameterError) -> Message:
        """Return a message with unchecked fields; an error is raised where it is handled."""
        names = {name for key, each in cls.model_fields.items() for name in (key, each.alias)}
        message = cls.model_construct(**{name: value for name, value in data.items() if name in names})
        message._problem = problem  # noqa: SLF001 -- of the same class
        return message

    @property
    def is_valid(self) -> bool:
        """Whether all fields are valid."""
        return self._problem is None

    def check(self) -> None:
        """Raise the error of an invalid message."""
        if self._problem is not None:
            raise self._problem

    @property
    def setting(self) -> str | None:
        """Path of the setting that changes, if there is one."""
        key = getattr(self, "key", None)
        return key if isinstance(key, str) else None

    @property
    def key_of_errors(self) -> str:
        """Path of the setting that errors are shown at, or the name of the message."""
        key = getattr(self, "key", None)
        return key if isinstance(key, str) else self.do

    @property
    def is_temporary(self) -> bool:
        """Whether the settings change without an undo step."""
        return getattr(self, "final", True) is False

    @property
    def is_draft(self) -> bool:
        """Whether a value is set during a drag or a replay."""
        return self.is_temporary and not self.is_frame

    @property
    def chooses_filters(self) -> bool:
        """Whether a layout, or the filters of the sensor, are chosen."""
        return self.setting in ("layout", "sensor", "sensor.filters")

    def is_replaced_by(self, following: Message) -> bool:
        """Return whether only the following message of two is simulated."""
        if self.is_frame and following.is_frame:
            return not getattr(self, "is_first", False)
        return self.is_draft and following.is_draft and self.setting == following.setting


#: Types of messages in JSON, by name.
MESSAGES: dict[str, type[Message]] = {}


def read_message(data: Any) -> Message:
    """Return the message in data of a page; an error of it is raised where it is handled."""
    if isinstance(data, Message):
        return data
    if not isinstance(data, dict):
        return Message.invalid({}, ParameterError("message", "must be a JSON object"))
    name = data.get("do")
    kind = MESSAGES.get(name) if isinstance(name, str) else None
    if kind is None:
        problem = ParameterError("do", "must be the name of a message", printable(str(name))[:40])
        return Message.invalid({"id": data.get("id")}, problem)
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        key = error.errors()[0]["loc"][0]
        rule = next(each.description for name, each in kind.model_fields.items() if key in (name, each.alias))
        value = data.get(str(key))
        got = (value,) if isinstance(value, str | int | float) else ()
        return kind.invalid(data, ParameterError(str(key), f"must be {rule}", *got))


Handler = TypeVar("Handler", bound=Callable[..., Any])
#: Functions of a session and a message. Those of changes return the new settings, or None if these remain.
HANDLERS: dict[type[Message], Callable[..., Any]] = {}


def handles(kind: type[Message]) -> Callable[[Handler], Handler]:
    """Register a function as the handler of a type of messages."""

    def register(handler: Handler) -> Handler:
        HANDLERS[kind] = handler
        return handler

    return register


def handle(session: Any, message: Message) -> Any:
    """Return the result of the handler of a message; raise ParameterError when it is invalid."""
    message.check()
    return HANDLERS[type(message)](session, message)


# -- changes of the settings ----------------------------------------------------------------------------------------------


class Change(Message, is_change=True):
    """Change of the settings."""


class SetValue(Change, do="set"):
    """Set a value; a draft while it is not final."""

    key: Key
    value: Value = None
    final: Flag = True


class NewValue(BaseModel):
    """Value of a setting."""

    key: Key
    value: Value = None


class AssignValues(Change, do="assign"):
    """Set several values in one step."""

    values: list[NewValue] = _items(1, MAX_VALUES, "mappings with the path of a setting as key, and a value")


class ResetValue(Change, do="reset"):
    """Restore the initial value."""

    key: Key


class DeleteValue(Change, do="delete"):
    """Remove a value."""

    key: Key


class SeekValue(Change, do="seek", is_once=True):
    """Change one number so that a requirement is met."""

    key: Key
    requirement: Mapping
    bounds: list[int | float] | None = _must_be("two numbers", None, min_length=2, max_length=2)


class SolveFor(Change, do="solve"):
    """Choose the parameter of the generator that follows from the others."""

    name: Text


class FitScene(Change, do="fit"):
    """Let the image cover the photosites."""


class MatchBudget(Change, do="match"):
    """Change the field of the generator, its number of photosites, or both, to those of A."""

    what: Literal["field", "n_sites", "both", "data_rate"] = _must_be("field, n_sites, both or data_rate", "field")


class RepairLayout(Change, do="repair", is_once=True):
    """Repair the layout by a method of :func:`foveasim.layout.enforce`, as its last edit."""

    method: Repair = _must_be("best, drop, shrink, merge or refill")


class ApplyVariant(Change, do="apply"):
    """Use the settings of a variant."""

    variant: Text


class ApplyPreset(Change, do="preset"):
    """Use a bundled shot or layout."""

    name: Text

    @property
    def chooses_filters(self) -> bool:
        """Whether the preset is a layout."""
        return self.name.startswith("layout:")


class NewSensor(Change, do="new_sensor"):
    """
    Create a sensor of what is given; the rest follows.

    ``size_um``: width and height of the format, which rasters fill, and in whose shorter side other layouts are inscribed.
    ``n_sites``: approximately; or ``pixels_per_s`` at ``frames_per_s``. ``min_size_um``: smallest site; or ``sites_per_deg``
    at the gaze. ``filters``: name of a mosaic.
    """

    generator: Text
    size_um: list[int | float] | None = _must_be(
        "the width and the height of the sensor", None, min_length=2, max_length=2
    )
    n_sites: int | None = _integer(1, MAX_SITES, None)
    min_size_um: Positive = None
    sites_per_deg: Positive = None
    pixels_per_s: Positive = None
    frames_per_s: Positive = None
    filters: str | None = _must_be("the name of a mosaic", None)
    electronics: Text


class RestoreSettings(Change, do="restore"):
    """Use all settings of a page, such as those of a link."""

    settings: Mapping


class OpenFile(Change, do="file"):
    """Use an uploaded file; without ``as`` for what its content is."""

    path: Path
    use: Literal["scene", "layout", "settings"] | None = _must_be("scene, layout or settings", None, alias="as")

    @property
    def chooses_filters(self) -> bool:
        """Whether the file is a layout."""
        return self.use == "layout"


class OpenVideo(Change, do="video", is_once=True):
    """Use a video as the scene."""

    path: Path


class Frame(Change, is_once=True, is_frame=True):
    """Frame of a video or camera."""

    is_first: SkipJsonSchema[Flag] = False


class ShowFrame(Frame, do="frame"):
    """Show a frame of the video, with the gaze of the path at its time if it ``follows``."""

    n: int = _must_be("the number of a frame")
    follows: Flag = False
    final: Flag = True


class CameraFrame(Frame):
    """Frame of a camera, in binary; ``pixels``: (n_y, n_x, 3) uint8."""

    do = "frame"

    width: int = _must_be("a number of pixels", ge=1)
    height: int = _must_be("a number of pixels", ge=1)
    is_first: Flag = False
    pixels: SkipJsonSchema[Any] = None


class FollowGaze(Change, do="follow"):
    """Move the gaze to that of the path at a time."""

    t_s: int | float = _must_be("a time in seconds")
    final: Flag = True

    @property
    def setting(self) -> str:
        """Path of the gaze."""
        return "gaze_um"


class OpenGazeFile(Change, do="gaze_file"):
    """Use the gaze path of a file."""

    path: Path


class AddSaccades(Change, do="saccades"):
    """Use a random gaze path, with parameters of :func:`foveasim.video.saccades`."""

    seed: Number = None
    duration_s: Number = None
    fixation_s: Number = None
    drift_um_per_root_s: Number = None


class Undo(Change, do="undo"):
    """Return to the state before the last step."""


class Redo(Change, do="redo"):
    """Repeat the step that was undone last."""


# -- other messages -------------------------------------------------------------------------------------------------------


class Refresh(Message, do="refresh"):
    """Send everything again."""


class SelectViews(Message, do="views"):
    """Select the views that are sent; ``pixels``: longer side of pictures."""

    names: list[str] = _must_be("a list of names of views")
    pixels: int | None = _integer(1, MAX_PIXELS, None)


class PinSites(Message, do="pin"):
    """Select photosites that charts compare."""

    sites: list[int] = _items(0, MAX_PINNED, "indices of photosites")


class Freeze(Message, do="freeze"):
    """Keep the current result, or that of a variant, as A."""

    variant: str | None = _must_be("the name of a variant", None)


class Unfreeze(Message, do="unfreeze"):
    """Forget A."""


class ChangeVariant(Message, do="variant"):
    """Keep the present state as a variant, or change one."""

    action: Literal["keep", "update", "describe", "delete"] = _must_be("keep, update, describe or delete")
    variant: Text = ""
    name: Text = ""
    note: Text = ""


class CompareVariants(Message, do="compare"):
    """Compare variants with the current state."""

    variants: list[str] = _items(0, MAX_COMPARED, "variants")


class SweptSetting(BaseModel):
    """Setting of a sweep, and its range."""

    model_config = ConfigDict(extra="allow")

    key: Key


class PreviewRepairs(Message, do="preview_repairs"):
    """Send what each method of repair would change."""


class StartSweep(Message, do="sweep", ends_points=True):
    """Compute results for all combinations of values."""

    settings: Annotated[list[SweptSetting], Plain] = _items(1, MAX_SWEPT, "mappings", json_schema_extra=UNCHECKED)
    results: Annotated[list[dict[str, Any]], Plain] = _items(1, MAX_SWEPT, "mappings", json_schema_extra=UNCHECKED)


class StopSweep(Message, do="stop_sweep", ends_points=True):
    """End the sweep."""


class SendSweepFile(Message, do="sweep_file"):
    """Return the file of the sweep for the command line."""


class SendText(Message, do="text"):
    """Return the settings in a text format."""

    what: Text


class Save(Message, do="save"):
    """Write the settings to a file."""

    name: Text
    may_replace: Flag = False


class Drawn(Message, do="drawn", is_immediate=True):
    """Start work that would have delayed the photosites, which are drawn."""

    version: int = _must_be("the number of a version")


class Cancel(Message, do="cancel", is_immediate=True):
    """Stop the work in progress, and what waits."""

"""
Errors and warnings of foveasim.

::

    FoveasimError
    ├── ParameterError   (ValueError)    an invalid value: .name .value .unit
    │   └── ArgumentError  (TypeError)   a call with a misspelt, missing or surplus argument
    ├── GeometryError    (ValueError)    outlines that are not valid photosites: .site_ids
    ├── FileError        (ValueError)    a file that cannot be read or written: .path
    │   └── ConfigError                  a settings file with an invalid key or value
    └── SimulationError  (RuntimeError)  incompatible parts, detected during a simulation

    FoveasimWarning (UserWarning)
    ├── SamplingWarning                  the sampling is too coarse for the physics
    ├── CoverageWarning                  image and layout differ in size: photosites outside, or a small part
    ├── ExposureWarning                  many photosites are saturated, or most receive no signal
    └── LayoutWarning                    a layout that differs from its parameters, or its file from the layout

Each message gives the name of the parameter or the path of the file, the rule, the value and a hint.
"""

from __future__ import annotations

import errno
import os
import re
import reprlib
import sys
import warnings
from pathlib import Path
from types import FrameType
from typing import Any

PACKAGE = __name__.partition(".")[0]

__all__ = [
    "ArgumentError",
    "ConfigError",
    "CoverageWarning",
    "ExposureWarning",
    "FileError",
    "FoveasimError",
    "FoveasimWarning",
    "GeometryError",
    "LayoutWarning",
    "ParameterError",
    "SamplingWarning",
    "SimulationError",
]


#: Default for "no value": None is a value that messages show.
_NO_VALUE = object()


class FoveasimError(Exception):
    """
    Base class of all errors of the package; pickling preserves instances.

    Examples
    --------
    All errors of the package have this class, such as that of a file that does not exist:

    >>> import foveasim as fs
    >>> try:
    ...     fs.read_layout("missing.gds")
    ... except fs.FoveasimError as error:
    ...     print(type(error).__name__)
    FileError
    """

    def __init__(self, message: str = "", *, prefix: str = "") -> None:
        # Names and values of files may contain control characters, which change terminals.
        super().__init__(prefix + printable(_shorten(message), keep="\n"))

    def __reduce__(self) -> tuple[Any, ...]:
        state = dict(self.__dict__)
        if not isinstance(state.get("value"), str | int | float | None):
            state["value"] = format_value(state["value"])  # arbitrary objects may not be picklable
        return _restore, (type(self), self.args, state)


class ParameterError(FoveasimError, ValueError):
    """
    Invalid value of a parameter, raised where the value enters the package.

    Examples
    --------
    >>> import foveasim as fs
    >>> try:
    ...     fs.layout.grid(n_x=4, n_y=4, pitch_um=-2.0)
    ... except fs.errors.ParameterError as error:
    ...     print(error.name, error.value, error.unit)
    ...     print(error)
    pitch_um -2.0 µm
    'pitch_um' must be > 0, got -2.0 µm; lengths on a sensor are in µm
    """

    def __init__(self, name: str, rule: str, value: object = _NO_VALUE, unit: str = "", hint: str = "") -> None:
        self.name = name
        self.value: Any = None if value is _NO_VALUE else value
        self.unit = unit
        got = f", got {format_value(value)}{' ' + unit if unit else ''}" if value is not _NO_VALUE else ""
        #: The message without the name.
        self.detail: str = f"{rule}{got}{'; ' + hint if hint else ''}"
        super().__init__(f"'{name}' {self.detail}")


class ArgumentError(ParameterError, TypeError):
    """
    A call with a misspelt, missing or surplus argument; the message contains the signature.

    Examples
    --------
    >>> import foveasim as fs
    >>> try:
    ...     fs.Optics(focal_length_mm=8.0, f_nummer=2.8)
    ... except fs.errors.ArgumentError as error:
    ...     print(error.name, "-", str(error).partition("; ")[2])
    f_nummer - did you mean 'f_number'?
    """


class GeometryError(FoveasimError, ValueError):
    """
    Outlines that are not valid photosites; ``site_ids`` are their indices.

    Examples
    --------
    >>> import foveasim as fs
    >>> import shapely
    >>> bow_tie = shapely.Polygon([(0.0, 0.0), (2.0, 2.0), (2.0, 0.0), (0.0, 2.0)])
    >>> try:
    ...     fs.Layout.from_polygons([shapely.box(3.0, 0.0, 5.0, 2.0), bow_tie])
    ... except fs.errors.GeometryError as error:
    ...     print(error.site_ids)
    (1,)
    """

    def __init__(self, message: str, site_ids: tuple[int, ...] = ()) -> None:
        self.site_ids = site_ids
        super().__init__(message)


class FileError(FoveasimError, ValueError):
    """
    A file that is missing, corrupt, of another format, or too large.

    Examples
    --------
    >>> import foveasim as fs
    >>> try:
    ...     fs.read_power_map("missing.npz")
    ... except fs.errors.FileError as error:
    ...     print(error.path, "-", error.detail)
    missing.npz - no such file
    """

    def __init__(self, path: str | Path | None, message: str, *, position: tuple[int, int] | None = None) -> None:
        self.path: Path | None = None if path is None else Path(path)
        #: Line and column of the problem in a text file, from 1.
        self.position = position
        #: The message without the path.
        self.detail = message
        where = "" if position is None else ":{}:{}".format(*position)
        prefix = "" if path is None else f"{_elide(printable(path), MAX_PATH_LENGTH)}{where}: "
        super().__init__(message, prefix=prefix)


class ConfigError(FileError):
    """
    Settings with an unknown key, a wrong type, or an invalid value.

    ``path`` is None for settings from Python, ``position`` the line and column in a file, from 1, if it is known.

    Examples
    --------
    >>> import foveasim as fs
    >>> try:
    ...     fs.config.read_shot(fs.config.demo_settings()[0], ["sensor.bits=40"])
    ... except fs.errors.ConfigError as error:
    ...     print(error.path.name, "-", error.detail)
    foveal.yaml - --set sensor.bits: must be <= 16, got 40
    """


class SimulationError(FoveasimError, RuntimeError):
    """
    Parts that are valid separately and incompatible with each other.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=2, n_y=2, pitch_um=3.0)
    >>> try:
    ...     fs.Sensor(layout, filters="rgb")
    ... except fs.errors.SimulationError as error:
    ...     print(str(error).partition("; ")[0])
    the sensor has 3 filters, but the layout has no column 'channel'
    """


class FoveasimWarning(UserWarning):
    """
    Base class of all warnings of the package.

    Examples
    --------
    Raise warnings of the package as errors, so that a script stops at the first one:

    >>> import warnings
    >>> import foveasim as fs
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", fs.errors.FoveasimWarning)
    ...     layout = fs.layout.grid(n_x=4, n_y=4, pitch_um=3.0)
    >>> layout.n_sites
    16
    """


class SamplingWarning(FoveasimWarning):
    """
    A picture or grid that is too coarse or too small for the optics.

    Examples
    --------
    Ignore the warnings of one kind, here of a chart with fewer than two pixels per period:

    >>> import warnings
    >>> import foveasim as fs
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", fs.errors.SamplingWarning)
    ...     chart = fs.scene.charts.siemens_star(
    ...         shape=(64, 64), pitch_um=100.0, distance_m=1.0, luminance_cd_m2=100.0
    ...     )
    >>> chart.basis.shape
    (1, 64, 64)
    """


class CoverageWarning(FoveasimWarning):
    """
    Photosites outside the image, or a layout that measures a small part of a photograph.

    Examples
    --------
    Record the warning of a scene whose image is smaller than the layout:

    >>> import warnings
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(fs.layout.grid(n_x=32, n_y=32, pitch_um=3.0))
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    ... )
    >>> scene = fs.Scene.flat(
    ...     shape=(40, 40), pitch_um=250.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> with warnings.catch_warnings(record=True) as found:
    ...     warnings.simplefilter("always", fs.errors.CoverageWarning)
    ...     capture = camera.capture(scene, exposure_s=0.001, seed=0)
    >>> str(found[0].message).partition(" the image")[0]
    '348 of 1,024 photosites lie partly or completely outside'
    """


class ExposureWarning(FoveasimWarning):
    """
    An exposure at which many photosites are saturated, or most receive no signal.

    Examples
    --------
    Ignore the warning of a capture that is saturated on purpose:

    >>> import warnings
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(fs.layout.grid(n_x=4, n_y=4, pitch_um=3.0), full_well_e=1e4)
    >>> camera = fs.Camera(
    ...     optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    ... )
    >>> scene = fs.Scene.flat(
    ...     shape=(64, 64), pitch_um=500.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", fs.errors.ExposureWarning)
    ...     capture = camera.capture(scene, exposure_s=10.0, seed=0)
    >>> int(capture.electrons.min())
    10000
    """


class LayoutWarning(FoveasimWarning):
    """
    A layout that covers less of its field than specified, or a file with rounded outlines.

    Examples
    --------
    Record the warning of rings that end far within the outer radius:

    >>> import warnings
    >>> import foveasim as fs
    >>> with warnings.catch_warnings(record=True) as found:
    ...     warnings.simplefilter("always", fs.errors.LayoutWarning)
    ...     layout = fs.layout.log_polar(n_sectors=8, min_size_um=4.0, r_max_um=30.0)
    >>> str(found[0].message).partition(":")[0]
    "'r_max_um' is 30 µm, but the outermost ring ends at 16.8392 µm"
    """


def _restore(kind: type[FoveasimError], args: tuple[Any, ...], state: dict[str, Any]) -> FoveasimError:
    """Return an unpickled error; its message is complete and must not be built a second time."""
    error = kind.__new__(kind)
    error.args = args
    error.__dict__.update(state)
    return error


#: Most characters of a value in a message, of a word in a message, of a message, and of the file path before it.
MAX_VALUE_LENGTH, MAX_WORD_LENGTH, MAX_MESSAGE_LENGTH, MAX_PATH_LENGTH = 80, 240, 2000, 1000
#: Depth and number of elements of containers in messages: limits the cost of formatting large values.
_REPR = reprlib.Repr()
_REPR.maxlevel, _REPR.maxlong = 3, 2 * MAX_VALUE_LENGTH
_REPR.maxstring = _REPR.maxother = MAX_VALUE_LENGTH
for _kind in ("tuple", "list", "array", "dict", "set", "frozenset", "deque"):
    setattr(_REPR, f"max{_kind}", 8)
#: System errors that report a failure of the disk, not of the data.
DISK_ERRNOS = frozenset(
    getattr(errno, name) for name in ("ENOSPC", "EDQUOT", "EFBIG", "EROFS", "EIO") if hasattr(errno, name)
)


def format_value(value: Any, *, at_most: int = MAX_VALUE_LENGTH) -> str:
    """Return a value as one line of printable characters, shortened with ``...``."""
    try:
        text = printable(" ".join(_REPR.repr(value).split()))
    except Exception:  # noqa: BLE001 -- the repr of any object may raise, and Python rejects very long integers
        return f"an object of type {type(value).__name__}"
    return text if len(text) <= at_most else text[: at_most - 3] + "..."


#: Beginnings of words that are pronounced with a vowel, and exceptions.
_VOWEL, _CONSONANT = (re.compile(p, re.IGNORECASE) for p in (r"[aeiou]|ndarray|xarray", r"u(func|int|ni|se|uid)|one"))


def with_article(word: str) -> str:
    """
    Return a word after "a" or "an".

    Examples
    --------
    >>> (
    ...     with_article("Layout"),
    ...     with_article("effect"),
    ...     with_article("ndarray"),
    ...     with_article("uint8"),
    ... )
    ('a Layout', 'an effect', 'an ndarray', 'a uint8')
    """
    return f"{'an' if _VOWEL.match(word) and not _CONSONANT.match(word) else 'a'} {word}"


def type_name(value: object) -> str:
    """
    Return the name of the type of a value with its article, for messages.

    Examples
    --------
    >>> type_name(3)
    'an int'
    """
    return with_article(type(value).__name__)


def _shorten(message: str) -> str:
    """Replace the central part of long words and of a long message with ``...``."""
    words = re.sub(rf"\S{{{MAX_WORD_LENGTH + 1},}}", lambda word: _elide(word[0], MAX_VALUE_LENGTH), message)
    return _elide(words, MAX_MESSAGE_LENGTH)


def _elide(text: str, at_most: int) -> str:
    half = (at_most - 3) // 2
    return text if len(text) <= at_most else f"{text[:half]}...{text[-half:]}"


def printable(text: object, *, keep: str = "") -> str:
    r"""
    Return a string with unprintable characters as escapes, such as ``\n`` and ``\x1b``.

    Parameters
    ----------
    text : object
        A string or a path; may be untrusted.
    keep : str
        Characters that are not escaped.

    Returns
    -------
    text : str

    Examples
    --------
    >>> printable("a\nb") == "a" + chr(92) + "nb"
    True
    """
    string = str(text)
    if string.isprintable():
        return string
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode("ascii") for c in string)


def disk_problem(error: BaseException) -> str:
    """
    Return the system's message when the disk caused a write error, else ``""``.

    Causes are a full disk, an exceeded quota or file size limit, a read-only file system and an input/output error. Libraries
    wrap the system error in their own exceptions, so causes and contexts are also inspected.
    """
    visited: set[int] = set()
    cause: BaseException | None = error
    while cause is not None and id(cause) not in visited:
        visited.add(id(cause))
        # KLayout, Arrow and HDF5 report the error number only in their messages.
        number = re.search(r"errno ?=? ?(\d+)", str(cause))
        for code in (getattr(cause, "errno", None), number and int(number[1])):
            if code is not None and code in DISK_ERRNOS:
                return os.strerror(code)
        cause = cause.__cause__ or cause.__context__
    return ""


def warn(message: str, category: type[Warning]) -> None:
    """Issue a warning at the innermost line outside this package."""
    frame: FrameType | None = sys._getframe(1)  # noqa: SLF001 -- the only way to count frames
    level = 2
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == PACKAGE:
        frame, level = frame.f_back, level + 1
    warnings.warn(printable(message, keep="\n"), category, stacklevel=level)

"""What a sweep does: a shot, the settings that vary, repeats, seed and metrics; and the numbers of its points."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from foveasim._core.provenance import versions
from foveasim._core.random_streams import derived_seed
from foveasim._core.validation import Ints, check_choice, check_count
from foveasim._io.yaml_files import read_yaml
from foveasim.config import check_settings, files_from, put_setting, read_settings, validated
from foveasim.errors import ConfigError, ParameterError
from foveasim.explore._files import digests
from foveasim.explore._functions import identity_of
from foveasim.explore._metrics import Metric, named_metrics, with_more_metrics

__all__ = [
    "MAX_POINTS",
    "Plan",
    "SweepSection",
    "check_apart",
    "coordinate",
    "plan_sweep",
    "read_sweep",
    "shot_of",
    "telling",
]

#: More points than this are a slip: of a millisecond each they would take a quarter of an hour.
MAX_POINTS = 1_000_000
#: So many values of each setting are checked before a sweep begins; what is wrong with later ones, their points tell.
CHECKED_VALUES = 1000
#: Names of dimensions that are not settings.
POINT, REPEAT = "point", "repeat"
#: Settings that change where light falls on photosites, and those that change the light.
GEOMETRY = ("layout", "distortion", "integration_order")
LIGHT = ("scene", "optics", "sensor.qe", "sensor.filters")


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """
    A sweep before it runs.

    Attributes
    ----------
    source : Path
        The file that the settings are from, for messages.
    settings : mapping
        Of the shot, as plain data; files that they name are absolute.
    values : mapping of str to list
        Values of each setting that varies, by its path, such as ``"sensor.bits"``.
    mode : {"product", "zip"}
        Every value with every other, or the first with the first, the second with the second.
    repeats : int
        Captures of each point, which differ in their seeds.
    seed : int
        That every point's seed is derived from.
    metrics : mapping of str to function
    files : mapping of str to str
        SHA-256 of the files that the settings name, and of those that these name.
    """

    source: Path
    settings: Mapping[str, Any]
    values: Mapping[str, Sequence[Any]]
    mode: Literal["product", "zip"]
    repeats: int
    seed: int
    metrics: Mapping[str, Metric]
    files: Mapping[str, str]

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Numbers of values along the results' dimensions, repeats last where there are several."""
        counts = [len(values) for values in self.values.values()]
        own = tuple(counts) if self.mode == "product" else (counts[0],)
        return own if self.repeats == 1 else (*own, self.repeats)

    @property
    def dims(self) -> tuple[str, ...]:
        """Names of the results' dimensions."""
        own = tuple(self.values) if self.mode == "product" else (POINT,)
        return own if self.repeats == 1 else (*own, REPEAT)

    @property
    def n_points(self) -> int:
        """Captures that the sweep takes."""
        return math.prod(self.shape)

    @cached_property
    def choices(self) -> Ints:
        """Which value of each setting every point has, (n_point, n_setting)."""
        number = np.arange(self.n_points)
        if self.mode == "product":
            return np.stack(np.unravel_index(number, self.shape)[: len(self.values)], axis=1)
        return np.repeat((number // self.repeats)[:, np.newaxis], len(self.values), axis=1)

    def settings_of(self, point: int) -> dict[str, Any]:
        """All settings of a point, with its seed."""
        chosen = {path: values[k] for (path, values), k in zip(self.values.items(), self.choices[point], strict=True)}
        return self._changed(chosen) | {"seed": self.seed_of(point)}

    def seed_of(self, point: int) -> int:
        """Seed of a point's noise: of the sweep's seed and the point's number, and of nothing else."""
        return derived_seed(self.seed, point)

    @property
    def is_geometry_varied(self) -> bool:
        """Whether points differ in the photosites, or in where the lens puts them."""
        return any(_is_of(path, GEOMETRY) for path in self.values)

    def order(self) -> tuple[Ints, Ints]:
        """
        Numbers of the points, those with the same layout and light beside each other, and where such groups begin.

        Every other layout has its lights in the other order, so that the light met last is met again.
        """
        choices = self.choices if self.mode == "product" else self._first_equal()
        groups = []
        for parts in (GEOMETRY, LIGHT):
            own = [k for k, path in enumerate(self.values) if _is_of(path, parts)]
            groups.append(np.unique(choices[:, own], axis=0, return_inverse=True)[1].reshape(-1))
        layout, light = groups
        light_there_and_back = np.where(layout % 2 == 0, light, -light)
        order = np.lexsort((np.arange(self.n_points), light_there_and_back, layout))
        is_new = np.diff(layout[order], prepend=-1) | np.diff(light[order], prepend=-1)
        return order, np.flatnonzero(is_new)

    def to_dict(self) -> dict[str, Any]:
        """All that results depend on, as plain data: a store goes on where it equals."""
        return {
            "settings": dict(self.settings),
            "vary": {path: list(values) for path, values in self.values.items()},
            "mode": self.mode,
            "repeats": self.repeats,
            "seed": self.seed,
            "metrics": dict(self._metrics_described),
            "files": dict(self.files),
            "versions": versions(),
        }

    @cached_property
    def _metrics_described(self) -> dict[str, str]:
        # Once: what a function takes along may change while it works.
        return {name: identity_of(metric) for name, metric in self.metrics.items()}

    def _first_equal(self) -> Ints:
        """As ``choices``, with the number of the first value that is equal instead of every value's own."""
        columns = []
        for values, chosen in zip(self.values.values(), self.choices.T, strict=True):
            first: dict[str, int] = {}
            numbers = [first.setdefault(json.dumps(value), k) for k, value in enumerate(values)]
            columns.append(np.array(numbers)[chosen])
        return np.stack(columns, axis=1)

    def _changed(self, chosen: Mapping[str, Any]) -> dict[str, Any]:
        data = _copied(self.settings)
        for path, value in chosen.items():
            put_setting(self.source, data, path, value)
        return data

    def check(self) -> None:
        """
        Names and types of all settings that vary, before anything is built.

        Raises
        ------
        ConfigError
            With the setting, what was expected and got.
        """
        names = list(self.values)
        check_apart(self.source, names)
        if self.mode == "zip":
            for k in range(min(len(self.values[names[0]]), CHECKED_VALUES)):
                check_settings(self.source, self._changed({path: values[k] for path, values in self.values.items()}))
            return
        first = {path: values[0] for path, values in self.values.items()}
        for path, values in self.values.items():
            for value in values[:CHECKED_VALUES]:
                check_settings(self.source, self._changed(first | {path: value}))


class _Range(BaseModel):
    """Numbers from one to another."""

    model_config = ConfigDict(extra="forbid", strict=True)
    low: float = Field(alias="from")
    high: float = Field(alias="to")
    n: int = Field(ge=1, le=MAX_POINTS)
    spacing: Literal["linear", "geometric"] = "linear"


class SweepSection(BaseModel):
    """A sweep: a shot, what varies in it, repeats, seed, names of metrics."""

    model_config = ConfigDict(extra="forbid", strict=True)
    shot: str | dict[str, Any] = Field(description="a file beside this one, or the settings themselves")
    set: dict[str, Any] = Field({}, description="settings to be replaced in all points, by their paths")
    vary: dict[str, list[Any] | _Range] | None = Field(None, description="values or ranges, by settings' paths")
    points: list[dict[str, Any]] | None = Field(None, description="instead of vary: settings of each point")
    mode: Literal["product", "zip"] = Field("product", description="every value with every other, or side by side")
    repeats: int = Field(1, description="captures of each point, which differ in their seeds")
    seed: int = 0
    metrics: list[str] | None = Field(None, description="names of metrics; usual ones by default")


def read_sweep(path: str | Path, *, metrics: Sequence[str] = ()) -> Plan:
    """
    Read a YAML file of a sweep.

    Parameters
    ----------
    path : path
        With the keys ``shot`` (a file beside it, or the settings themselves), ``vary`` (settings' paths to lists, or to
        ``{from: 2, to: 16, n: 8, spacing: geometric}``) or ``points`` (a list of settings), ``mode``, ``repeats``, ``seed``,
        ``metrics``, and ``set`` (settings to be replaced in all points). The file names metrics of :data:`METRICS` only: a file
        never makes the program import code.
    metrics : sequence of str
        More metrics: names, or ``module:function``, which is imported.

    Raises
    ------
    ConfigError
        With the file, the place in it, what was expected and got.
    ParameterError
        When there is no such metric.
    """
    path = Path(path)
    section: SweepSection = validated(path, SweepSection, read_yaml(path))
    if (section.vary is None) == (section.points is None):
        raise ConfigError(path, "must have either 'vary' or 'points'")
    vary: Any = section.points
    if section.vary is not None:
        vary = {
            name: _numbers(path, name, values) if isinstance(values, _Range) else values
            for name, values in section.vary.items()
        }
    source, shot = shot_of(path, section.shot)
    with telling(path):
        # The names that the file gives are looked up in METRICS, and never imported.
        named = named_metrics(section.metrics)
    wanted = with_more_metrics(named, metrics)
    with telling(path):
        return plan_sweep(
            shot,
            vary,
            mode=section.mode,
            repeats=section.repeats,
            seed=section.seed,
            metrics=wanted,
            changes={name: files_from(path.parent, value, name) for name, value in section.set.items()},
            source=source,
            folder=path.parent,
        )


def plan_sweep(
    shot: str | Path | Mapping[str, Any],
    vary: Mapping[str, Iterable[Any]] | Sequence[Mapping[str, Any]],
    *,
    mode: Literal["product", "zip"] = "product",
    repeats: int = 1,
    seed: int = 0,
    metrics: Iterable[str | Metric] | Mapping[str, Metric] | None = None,
    changes: Mapping[str, Any] | None = None,
    source: str | Path = "settings",
    folder: str | Path = ".",
) -> Plan:
    """
    Plan a sweep, and check all that can be checked without building anything.

    Parameters
    ----------
    shot : path or mapping
        A settings file, or settings as it has them.
    vary : mapping of str to values, or sequence of mappings
        Values by the settings' paths, such as ``{"sensor.bits": [8, 10]}``; or a list of points, all with the same paths.
    mode : {"product", "zip"}
        Every value with every other, or the first with the first, the second with the second.
    repeats : int
        Captures of each point, which differ in their seeds.
    seed : int
    metrics : names or functions, or mapping of names to functions, optional
        See :data:`METRICS`. A function takes a shot, its camera and its capture, and gives a number, a text, a mapping of names
        to such, a numpy array, or an xarray.DataArray.
    changes : mapping of str to value, optional
        Settings to be replaced in all points.
    source : path
        What messages call settings that are no file.
    folder : path
        Where files that ``vary`` names are looked for.

    Raises
    ------
    ParameterError, ConfigError
        When nothing varies, a path or a value is none of the shot's, or there are too many points.
    """
    check_choice("mode", mode, ("product", "zip"))
    if isinstance(shot, Mapping):
        source, data = Path(source), dict(shot)
    else:
        source = Path(shot)
        data = read_settings(source)
    values, mode = _by_path(vary, mode)
    repeats = check_count("repeats", repeats, at_most=MAX_POINTS)
    counts = [len(each) for each in values.values()]
    n_points = repeats * (math.prod(counts) if mode == "product" else counts[0])
    if n_points > MAX_POINTS:
        raise ParameterError(
            "vary",
            f"asks for {n_points:,} points, and a sweep has at most {MAX_POINTS:,}; vary fewer settings together",
        )
    found: list[Path] = []
    settings = files_from(source.parent, data, found=found)
    for path, value in (changes or {}).items():
        put_setting(source, settings, path, files_from(Path(folder), value, path, found))
    settings.pop("seed", None)
    plan = Plan(
        source=source.absolute(),
        settings=settings,
        values={path: [files_from(Path(folder), v, path, found) for v in each] for path, each in values.items()},
        mode=mode,
        repeats=repeats,
        seed=check_count("seed", seed, at_least=0),
        metrics=named_metrics(metrics),
        files=digests(found),
    )
    clash = next((name for name in plan.metrics if name in plan.values), None)
    if clash is not None:
        raise ParameterError("metrics", f"must have other names than the settings that vary, not '{clash}'")
    plan.check()
    return plan


def shot_of(path: Path, shot: str | dict[str, Any]) -> tuple[Path, dict[str, Any]]:
    """
    The shot that a file names, beside it, or holds: the file that its settings are from, and the settings.

    Raises
    ------
    ConfigError
        When there is no such file, or it is no YAML.
    """
    if not isinstance(shot, str):
        return path, shot
    source = path.parent / shot
    return source, read_settings(source)


def coordinate(values: Iterable[Any]) -> NDArray[Any]:
    """Values of a setting as labels: numbers, yes and no, or texts; all others as texts of JSON."""
    values = list(values)
    for kinds, dtype in (((bool,), np.bool_), ((int,), np.int64), ((int, float), np.float64)):
        if all(type(value) in kinds for value in values):
            try:
                return np.array(values, dtype)
            except OverflowError:
                continue
    texts = [value if isinstance(value, str) else json.dumps(value) for value in values]
    return np.array(texts, np.dtypes.StringDType())


@contextmanager
def telling(path: Path) -> Iterator[None]:
    """
    Errors in what a file says, with the file's name; those of the shot that it names, with both.

    Raises
    ------
    ConfigError
        Instead of any :class:`ParameterError`, and of other files' errors.
    """
    try:
        yield
    except ParameterError as error:
        raise ConfigError(path, str(error)) from None
    except ConfigError as error:
        if error.path.absolute() == path.absolute():
            raise
        raise ConfigError(path, f"with {error.path.name}: {str(error).removeprefix(f'{error.path}: ')}") from None


def check_apart(source: Path, paths: Iterable[str], verb: str = "vary") -> None:
    """
    Whether no setting is inside another.

    Raises
    ------
    ConfigError
        With both.
    """
    names = list(paths)
    for path in names:
        inside = next((other for other in names if other.startswith(path + ".")), None)
        if inside is not None:
            raise ConfigError(source, f"'{path}' and '{inside}' cannot both {verb}: one holds the other")


def _by_path(vary: Any, mode: Literal["product", "zip"]) -> tuple[dict[str, list[Any]], Literal["product", "zip"]]:
    """Values by path, of a mapping or of a list of points."""
    if not isinstance(vary, Mapping):
        points = list(vary) if isinstance(vary, Iterable) and not isinstance(vary, str) else []
        if not points or not all(isinstance(point, Mapping) and point for point in points):
            raise ParameterError("vary", "must be values by settings' paths, or a list of points, and not empty", vary)
        for point in points:
            if set(point) != set(points[0]):
                raise ParameterError("points", f"must all have the settings {', '.join(points[0])}", dict(point))
        vary, mode = {path: [point[path] for point in points] for path in points[0]}, "zip"
    values: dict[str, list[Any]] = {}
    for path, each in vary.items():
        # A set has another order in every run, and with it the points other numbers.
        if not isinstance(each, Iterable) or isinstance(each, str | Mapping | set | frozenset):
            raise ParameterError(str(path), "must vary over a list of values", each)
        if isinstance(each, Sized) and len(each) > MAX_POINTS:
            raise ParameterError(str(path), f"has {len(each):,} values, and a sweep has at most {MAX_POINTS:,} points")
        values[str(path)] = [_plain(str(path), value) for value in each]
    if not values or not all(values.values()):
        empty = next(iter(values), None)
        raise ParameterError(empty or "vary", "must have values: nothing varies")
    if "seed" in values:
        raise ParameterError("seed", "cannot vary: every point's seed is derived from the sweep's; take 'repeats'")
    counts = {path: len(each) for path, each in values.items()}
    if mode == "zip" and len(set(counts.values())) > 1:
        told = ", ".join(f"{path}: {n}" for path, n in counts.items())
        raise ParameterError("vary", f"must have as many values of each setting to go side by side ({told})")
    if mode == "product":
        for path, each in values.items():
            twice, n = Counter(coordinate(each).tolist()).most_common(1)[0]
            if n > 1:
                raise ParameterError(path, f"has the value {twice} twice; take 'repeats' for more captures of a point")
    return values, mode


def _plain(path: str, value: Any) -> Any:
    """A value as YAML has it."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Path):
        value = str(value)
    try:
        return json.loads(json.dumps(value), parse_constant=_constant)
    except (TypeError, ValueError, RecursionError):
        raise ParameterError(path, "must vary over numbers, texts, lists and sections", value) from None


def _constant(text: str) -> float:
    """Infinity, which a distance may be; no setting is NaN."""
    if text == "NaN":
        raise ValueError(text)
    return float(text)


def _numbers(path: Path, name: str, between: _Range) -> list[Any]:
    if between.spacing == "geometric":
        if not between.low * between.high > 0.0:
            raise ConfigError(path, f"vary.{name}: geometric steps need ends of one sign, and not 0")
        numbers = np.geomspace(between.low, between.high, between.n)
    else:
        numbers = np.linspace(between.low, between.high, between.n)
    if not np.isfinite(numbers).all():
        raise ConfigError(path, f"vary.{name}: has ends that are not finite")
    is_whole = bool((numbers == np.rint(numbers)).all())
    return [int(number) if is_whole else float(number) for number in numbers]


def _is_of(path: str, parts: tuple[str, ...]) -> bool:
    return any(path == part or path.startswith(part + ".") or part.startswith(path + ".") for part in parts)


def _copied(data: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with sections of their own; lists are shared."""
    return {key: _copied(value) if isinstance(value, dict) else value for key, value in data.items()}

"""Plans of sweeps: varied settings, repeats, seed and metrics, and order of the points."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from foveasim._core.calls import OwnCheck
from foveasim._core.provenance import identify, versions
from foveasim._core.random_streams import derive_seed
from foveasim._core.short_repr import short_repr
from foveasim._core.threads import cached_property
from foveasim._core.validation import Ints, check_count
from foveasim._io.yaml_files import position_of, read_yaml
from foveasim.config import (
    RegionResult,
    Source,
    check_settings,
    plain_settings,
    put_setting,
    read_settings,
    resolve_files,
    validate,
)
from foveasim.config._models import Section
from foveasim.errors import ConfigError, ParameterError
from foveasim.explore._files import digests
from foveasim.explore._metrics import add_metrics, resolve_metrics
from foveasim.explore.requirements import ResultMetric
from foveasim.metrics import Metric

__all__ = [
    "MAX_POINTS",
    "Plan",
    "SweepSection",
    "ValueRange",
    "check_disjoint",
    "coordinate",
    "copy_settings",
    "locate_shot",
    "plan_sweep",
    "put_changes",
    "read_sweep",
    "with_changes",
    "with_file_context",
]

#: Largest number of points. At 1 ms each they take a quarter of an hour; more are probably a mistake.
MAX_POINTS = 1_000_000
#: Number of values of each setting that are checked before a sweep starts; errors in later values appear in the results.
CHECKED_VALUES = 1000
#: Names of dimensions that are not settings.
POINT, REPEAT = "point", "repeat"
#: Setting with the seed of a shot.
SEED = "seed"
#: Keys of files with the values of settings: by path, and by point.
VARY, POINTS = "vary", "points"
#: Seed of a sweep, from which those of its points are derived; or that of the shot, which then is the seed of all points.
Seed = int | Literal["shot"]
OF_SHOT: Final = "shot"
#: Settings of the photosites and their integration areas, and settings of the optical image.
GEOMETRY_SETTINGS = ("layout", "distortion", "integration_order", "gaze_um")
IMAGE_SETTINGS = ("scene", "optics", "sensor.qe", "sensor.filters", "gaze_deg")


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """
    Validated plan of a sweep.

    Attributes
    ----------
    source : Source
        Origin of the settings of the shot, for messages.
    written : Source
        Origin of the values.
    settings : mapping
        Settings of the shot as plain data, with absolute file paths.
    values : mapping of str to list
        Values of each varied setting by path, such as ``"sensor.bits"``.
    mode : {"product", "zip"}
        All combinations of the values, or the k-th values of all settings together.
    repeats : int
        Captures of each point, which differ in their seeds.
    seed : int
        Seed from which the seed of every point is derived.
    metrics : mapping of str to function
    files : mapping of str to str
        SHA-256 of the files that the settings reference directly or indirectly.
    is_seed_common : bool
        Whether the seed is that of the shot, and of all points.
    """

    source: Source
    written: Source
    settings: Mapping[str, Any]
    values: Mapping[str, Sequence[Any]]
    mode: Literal["product", "zip"]
    repeats: int
    seed: int
    metrics: Mapping[str, Metric]
    files: Mapping[str, str]
    is_seed_common: bool = False

    __repr__ = short_repr

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the dimensions of the results; repeats last, if there are several."""
        counts = [len(values) for values in self.values.values()]
        own = tuple(counts) if self.mode == "product" else (counts[0],)
        return own if self.repeats == 1 else (*own, self.repeats)

    @property
    def dims(self) -> tuple[str, ...]:
        """Names of the dimensions of the results."""
        own = tuple(self.values) if self.mode == "product" else (POINT,)
        return own if self.repeats == 1 else (*own, REPEAT)

    @property
    def n_points(self) -> int:
        """Number of captures of the sweep."""
        return math.prod(self.shape)

    @cached_property
    def choices(self) -> Ints:
        """Indices of the values of each point, (n_point, n_setting)."""
        number = np.arange(self.n_points)
        if self.mode == "product":
            return np.stack(np.unravel_index(number, self.shape)[: len(self.values)], axis=1)
        return np.repeat((number // self.repeats)[:, np.newaxis], len(self.values), axis=1)

    def settings_of(self, point: int) -> dict[str, Any]:
        """Return all settings of a point, with its seed."""
        chosen = {path: values[k] for (path, values), k in zip(self.values.items(), self.choices[point], strict=True)}
        return self._settings_with(chosen) | {"seed": self.seed_of(point)}

    def seed_of(self, point: int) -> int:
        """Return the noise seed of a point: that of the shot, or derived from seed and number."""
        return self.seed if self.is_seed_common else derive_seed(self.seed, point)

    @property
    def is_geometry_varied(self) -> bool:
        """Whether points differ in the photosites or the distortion."""
        return any(_overlaps(path, GEOMETRY_SETTINGS) for path in self.values)

    def order(self) -> tuple[Ints, Ints]:
        """
        Return the points grouped by layout and optical image.

        The order of the images alternates between layouts, so that the last image of a layout is the first of the next one.

        Returns
        -------
        order : (n_point,) int64
            Numbers of the points in the order of computation.
        begins : (n_group,) int64
            Positions in ``order`` at which groups begin.
        """
        choices = self.choices if self.mode == "product" else self._first_equal()
        groups = []
        for parts in (GEOMETRY_SETTINGS, IMAGE_SETTINGS):
            own = [k for k, path in enumerate(self.values) if _overlaps(path, parts)]
            groups.append(np.unique(choices[:, own], axis=0, return_inverse=True)[1].reshape(-1))
        layout, image = groups
        alternating_image = np.where(layout % 2 == 0, image, -image)
        order = np.lexsort((np.arange(self.n_points), alternating_image, layout))
        is_new = np.diff(layout[order], prepend=-1) | np.diff(image[order], prepend=-1)
        return order, np.flatnonzero(is_new)

    def to_dict(self) -> dict[str, Any]:
        """Return everything that determines the results as plain data; resuming requires equality."""
        return {
            "settings": dict(self.settings),
            "vary": {path: list(values) for path, values in self.values.items()},
            "mode": self.mode,
            "repeats": self.repeats,
            "seed": OF_SHOT if self.is_seed_common else self.seed,
            "metrics": dict(self._metric_identities),
            "files": dict(self.files),
            "versions": versions(),
        }

    @cached_property
    def _metric_identities(self) -> dict[str, str]:
        # Computed once: captured values of a function may change while it runs.
        return {name: identify(metric) for name, metric in self.metrics.items()}

    def _first_equal(self) -> Ints:
        """Return ``choices`` with equal values replaced by the index of the first of them."""
        columns = []
        for values, chosen in zip(self.values.values(), self.choices.T, strict=True):
            first: dict[str, int] = {}
            numbers = [first.setdefault(json.dumps(value), k) for k, value in enumerate(values)]
            columns.append(np.array(numbers)[chosen])
        return np.stack(columns, axis=1)

    def _settings_with(self, chosen: Mapping[str, Any]) -> dict[str, Any]:
        data: dict[str, Any] = copy_settings(self.settings)
        for path, value in chosen.items():
            put_setting(self.source, data, path, value)
        return data

    def check(self) -> None:
        """
        Check names and types of all varied settings without building a camera.

        Raises
        ------
        ConfigError
            When a setting is invalid; with its path, the expected and the actual value.
        """
        names = list(self.values)
        check_disjoint(self.written, names)
        first = dict.fromkeys(names, 0)
        if self.mode == "zip":
            points = [dict.fromkeys(names, k) for k in range(min(len(self.values[names[0]]), CHECKED_VALUES))]
        else:
            points = [
                first | {path: k}
                for path, values in self.values.items()
                for k in range(min(len(values), CHECKED_VALUES))
            ]
        for point in points:
            chosen = {path: self.values[path][k] for path, k in point.items()}
            check_settings(self.source_with(point), self._settings_with(chosen))

    def source_with(self, choices: Mapping[str, int] | None = None) -> Source:
        """Return the origin of the settings of a point, given the indices of its values."""
        is_list = self.written.keys[-1:] == (POINTS,)
        replaced: dict[str, Source | str] = {}
        for path in self.values:
            index = "" if choices is None else str(choices[path])
            if is_list:
                replaced[path] = self.written.at(*([index] if index else []), path)
            else:
                replaced[path] = replace(self.written.at(path), index=index)
        return self.source.with_replaced(replaced)


class ValueRange(Section):
    """Range of ``n`` values with linear or geometric spacing."""

    low: float = Field(alias="from")
    high: float = Field(alias="to")
    n: int = Field(ge=1, le=MAX_POINTS)
    spacing: Literal["linear", "geometric"] = "linear"

    def values(self) -> list[int | float]:
        """
        Return the values, integers if all are.

        Raises ParameterError when a bound is not finite, or the bounds allow no geometric spacing.
        """
        if self.spacing == "geometric":
            if not self.low * self.high > 0.0:
                raise ParameterError(
                    "range", "must have non-zero bounds of equal sign for geometric spacing", [self.low, self.high]
                )
            numbers = np.geomspace(self.low, self.high, self.n)
        else:
            numbers = np.linspace(self.low, self.high, self.n)
        if not np.isfinite(numbers).all():
            raise ParameterError("range", "must have finite bounds", [self.low, self.high])
        rounded = np.array([float(f"{number:.12g}") for number in numbers])
        numbers = np.where(
            np.isclose(numbers, rounded, rtol=1e-15, atol=0.0), rounded, numbers
        )  # 4 for 3.999999999999999
        is_integer = bool((numbers == np.rint(numbers)).all())
        return [int(number) if is_integer else float(number) for number in numbers]


class SweepSection(Section):
    """Settings of a sweep: shot, varied settings, repeats, seed and metrics."""

    shot: str | dict[str, Any] = Field(description="settings file, relative to this file, or the settings")
    set: dict[str, Any] = Field({}, description="settings that are replaced in all points, by path")
    vary: dict[str, list[Any] | ValueRange] | None = Field(None, description="values or ranges, by setting path")
    points: list[dict[str, Any]] | None = Field(None, description="settings of each point, instead of vary")
    mode: Literal["product", "zip"] = Field("product", description="all combinations, or values in parallel")
    repeats: int = Field(1, description="captures of each point, which differ in their seeds")
    seed: Seed = Field(0, description="from which the seeds of the points are derived; shot: all have that of the shot")
    metrics: list[str] | None = Field(None, description="names of metrics; a default set if omitted, without results")
    results: dict[str, RegionResult] = Field({}, description="further metrics by name: results of photosites")


def read_sweep(path: str | Path, *, metrics: Sequence[str] = ()) -> Plan:
    """
    Read the YAML file of a sweep.

    Parameters
    ----------
    path : path
        File with the keys ``shot`` (a settings file, or the settings), ``vary`` (setting paths to lists, or to
        ``{from: 2, to: 16, n: 8, spacing: geometric}``) or ``points`` (a list of settings), ``mode``, ``repeats``, ``seed``,
        ``metrics``, ``results`` (metrics of photosites by name, each as a :class:`~foveasim.config.RegionResult`), and ``set``
        (settings that are replaced in all points). Metrics in the file must be names in :data:`METRICS`, so that reading a
        file never imports code.
    metrics : sequence of str
        Further metrics: names, or ``module:function``, which is imported.

    Returns
    -------
    Plan

    Raises
    ------
    ConfigError
        When a setting is invalid; with the file, the key, the expected and the actual value.
    ParameterError
        When a metric does not exist.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = fs.config.write_starting_file("sweep", Path(directory, "sweep.yaml"))
    ...     plan = fs.explore.read_sweep(path)
    >>> plan.n_points, list(plan.values)
    (9, ['layout.parameters.n_sectors', 'optics.f_number'])
    """
    path = Path(path)
    section: SweepSection = validate(path, SweepSection, read_yaml(path))
    if (section.vary is None) == (section.points is None):
        raise ConfigError(path, "must have either 'vary' or 'points'")
    vary: Any = section.points
    if section.vary is not None:
        vary = {
            name: _expand_range(path, name, values) if isinstance(values, ValueRange) else values
            for name, values in section.vary.items()
        }
    with with_file_context(path):
        # Names in the file are looked up in METRICS, and never imported.
        file_metrics = _metrics_of(section)
    all_metrics = add_metrics(file_metrics, metrics)
    with with_file_context(path):
        return plan_sweep(
            path.parent / section.shot if isinstance(section.shot, str) else section.shot,
            vary,
            mode=section.mode,
            repeats=section.repeats,
            seed=section.seed,
            metrics=all_metrics,
            changes=section.set,
            source=path,
        )


def plan_sweep(
    shot: str | Path | Mapping[str, Any],
    vary: OwnCheck[Mapping[str, Iterable[Any]] | Sequence[Mapping[str, Any]]],
    *,
    mode: Literal["product", "zip"] = "product",
    repeats: int = 1,
    seed: Seed = 0,
    metrics: Iterable[str | Metric] | Mapping[str, Metric] | None = None,
    changes: Mapping[str, Any] | None = None,
    source: Source | str | Path | None = None,
    written_as: str = VARY,
) -> Plan:
    """
    Create the plan of a sweep, with all checks that do not require building a camera.

    Parameters
    ----------
    shot : path or mapping
        Settings file, or mapping of settings.
    vary : mapping of str to values, or sequence of mappings
        Values by setting path, such as ``{"sensor.bits": [8, 10]}``; or a list of points with the same paths.
    mode : {"product", "zip"}
        All combinations of the values, or the k-th values of all settings together.
    repeats : int
        Captures of each point, which differ in their seeds.
    seed : int or "shot"
        Seed from which the seed of every point is derived; ``"shot"`` for the seed of the shot in all points, whose noise is
        then equal.
    metrics : names or functions, or mapping of names to functions, optional
        See :data:`METRICS`. A function of a shot, its camera and its capture returns a number, a string, a mapping of names to
        numbers or strings, a numpy array, or an xarray.DataArray.
    changes : mapping of str to value, optional
        Settings that are replaced in all points.
    source : Source or path, optional
        File of the sweep, for messages. Relative paths in ``changes``, ``vary`` and a mapping of settings are relative to its
        directory, by default the working directory.
    written_as : str
        Key of the values in this file.

    Returns
    -------
    Plan

    Raises
    ------
    ParameterError, ConfigError
        When nothing varies, a path or a value is invalid, or there are too many points.

    Examples
    --------
    >>> import foveasim as fs
    >>> shot = fs.config.demo_settings()[0]
    >>> plan = fs.explore.plan_sweep(
    ...     shot, {"sensor.bits": [8, 10], "optics.f_number": [2.0, 2.8, 4.0]}, repeats=5
    ... )
    >>> plan.n_points, list(plan.metrics)
    (30, ['mean_code_dn', 'saturated_fraction', 'snr', 'n_sites'])
    """
    own = Source.of(source)
    shot_source, data = locate_shot(own, shot)
    if own.file is not None and not isinstance(vary, Mapping):
        written_as = POINTS
    values, mode = _by_path(vary, mode)
    repeats = check_count("repeats", repeats, at_most=MAX_POINTS)
    counts = [len(each) for each in values.values()]
    n_points = repeats * (math.prod(counts) if mode == "product" else counts[0])
    if n_points > MAX_POINTS:
        raise ParameterError(
            "vary",
            f"must specify at most {MAX_POINTS:,} points, got {n_points:,}; vary fewer settings together",
        )
    found: list[Path] = []
    settings = resolve_files(shot_source.directory, data, found=found)
    shot_source = with_changes(own, shot_source, changes)
    put_changes(own, shot_source, settings, changes, found)
    of_shot = settings.pop(SEED, 0)
    if seed == OF_SHOT and repeats > 1:
        raise ParameterError("repeats", "must be 1 with the seed of the shot, which gives equal captures", repeats)
    plan = Plan(
        source=shot_source.absolute(),
        written=own.absolute().at(written_as),
        settings=settings,
        values={path: [resolve_files(own.directory, v, path, found) for v in each] for path, each in values.items()},
        mode=mode,
        repeats=repeats,
        seed=check_count("seed", of_shot if seed == OF_SHOT else seed, at_least=0),
        is_seed_common=seed == OF_SHOT,
        metrics=resolve_metrics(metrics),
        files=digests(found),
    )
    clash = next((name for name in plan.metrics if name in plan.values), None)
    if clash is not None:
        raise ParameterError("metrics", f"must not have the name of a varied setting, got '{clash}'")
    plan.check()
    return plan


def locate_shot(own: Source, shot: str | Path | Mapping[str, Any]) -> tuple[Source, dict[str, Any]]:
    """
    Return the settings of a shot, and their origin.

    ``own``: origin of the sweep, study or dataset; that of a mapping of settings is its key ``shot``. Raises ConfigError when
    the file does not exist, or is not valid YAML.
    """
    if isinstance(shot, Mapping):
        return own.at("shot"), plain_settings(own.at("shot"), shot)
    return Source.of(shot), read_settings(shot)


def with_changes(own: Source, shot_source: Source, changes: Mapping[str, Any] | None) -> Source:
    """Return the origin of settings of which a sweep, study or dataset replaces some."""
    key = "changes" if own.file is None else "set"
    return shot_source.with_replaced({path: own.absolute().at(key, path) for path in changes or {}})


def put_changes(
    own: Source, shot_source: Source, settings: dict[str, Any], changes: Mapping[str, Any] | None, found: list[Path]
) -> None:
    """
    Replace settings of a shot in place.

    The referenced files are appended to ``found``.

    Raises ConfigError when a path or a value is not one of settings.
    """
    for path, value in plain_settings(shot_source, changes or {}).items():
        put_setting(shot_source, settings, path, resolve_files(own.directory, value, path, found))


def coordinate(values: Iterable[Any]) -> NDArray[Any]:
    """Convert values of a setting to labels: numbers, booleans or strings; JSON for others."""
    values = list(values)
    for kinds, dtype in (((bool,), np.bool_), ((int,), np.int64), ((int, float), np.float64)):
        if all(type(value) in kinds for value in values):
            try:
                return np.array(values, dtype)
            except OverflowError:
                continue
    strings = [value if isinstance(value, str) else json.dumps(value) for value in values]
    return np.array(strings, np.dtypes.StringDType())


@contextmanager
def with_file_context(path: Path) -> Iterator[None]:
    """
    Raise errors in the settings of a file with its path.

    Errors in a referenced shot file are raised with both paths.

    Raises ConfigError instead of any :class:`ParameterError`, or of a :class:`ConfigError` of another file.
    """
    try:
        yield
    except ParameterError as error:
        sections: tuple[list[str], ...] = ([VARY], ["search"], ["set"], ["objectives"], ["constraints"], [])
        positions = (position_of(path, [*section, error.name], is_exact=True) for section in sections)
        raise ConfigError(path, str(error), position=next(filter(None, positions), None)) from None
    except ConfigError as error:
        if error.path is None or error.path.absolute() == path.absolute():
            raise ConfigError(path, error.detail, position=error.position) from None
        name = ":".join(map(str, (error.path.name, *(error.position or ()))))
        raise ConfigError(path, f"with {name}: {error.detail}", position=position_of(path, ["shot"])) from None


def check_disjoint(source: Source, paths: Iterable[str], verb: str = "vary") -> None:
    """Check that no setting contains another."""
    names = list(paths)
    for path in names:
        nested = next((other for other in names if other.startswith(path + ".")), None)
        if nested is not None:
            raise ConfigError(source.file, f"'{path}' and '{nested}' cannot both {verb}: the first contains the second")


def _by_path(vary: Any, mode: Literal["product", "zip"]) -> tuple[dict[str, list[Any]], Literal["product", "zip"]]:
    """Return the values by path of a mapping or a list of points, and the mode."""
    if not isinstance(vary, Mapping):
        points = list(vary) if isinstance(vary, Iterable) and not isinstance(vary, str) else []
        if not points or not all(isinstance(point, Mapping) and point for point in points):
            raise ParameterError("vary", "must be a mapping of setting paths to values, or a list of points", vary)
        for point in points:
            if set(point) != set(points[0]):
                raise ParameterError("points", f"must all have the settings {', '.join(points[0])}", dict(point))
        vary, mode = {path: [point[path] for point in points] for path in points[0]}, "zip"
    values: dict[str, list[Any]] = {}
    for path, each in vary.items():
        # The order of a set, and so the numbers of the points, would differ between runs.
        if not isinstance(each, Iterable) or isinstance(each, str | Mapping | set | frozenset):
            raise ParameterError(str(path), "must vary over a list of values", each)
        if isinstance(each, Sized) and len(each) > MAX_POINTS:
            raise ParameterError(str(path), f"must have at most {MAX_POINTS:,} values, got {len(each):,}")
        values[str(path)] = [_to_plain_data(str(path), value) for value in each]
    if not values or not all(values.values()):
        empty = next(iter(values), None)
        raise ParameterError(empty or "vary", "must have at least one value")
    if "seed" in values:
        raise ParameterError("seed", "must not vary: it is derived from the seed of the sweep; use 'repeats'")
    counts = {path: len(each) for path, each in values.items()}
    if mode == "zip" and len(set(counts.values())) > 1:
        listing = ", ".join(f"{path}: {n}" for path, n in counts.items())
        raise ParameterError("vary", f"must have equal numbers of values in the mode 'zip' ({listing})")
    if mode == "product":
        for path, each in values.items():
            repeated, n = Counter(coordinate(each).tolist()).most_common(1)[0]
            if n > 1:
                raise ParameterError(
                    path, f"must have unique values, got {repeated} twice; use 'repeats' for more captures"
                )
    return values, mode


def _to_plain_data(path: str, value: Any) -> Any:
    """Convert a value to plain data."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Path):
        value = str(value)
    try:
        return json.loads(json.dumps(value), parse_constant=_constant)
    except (TypeError, ValueError, RecursionError):
        raise ParameterError(path, "must vary over numbers, strings, lists and mappings", value) from None


def _constant(text: str) -> float:
    """Convert infinity, which is valid for distances; NaN is not valid for any setting."""
    if text == "NaN":
        raise ValueError(text)
    return float(text)


def _expand_range(path: Path, name: str, value_range: ValueRange) -> list[Any]:
    try:
        return value_range.values()
    except ParameterError as error:
        raise ConfigError(path, f"{VARY}.{name}: {error.detail}") from None


def _metrics_of(section: SweepSection) -> dict[str, Metric]:
    """Return the metrics and results of a file by name."""
    results = {name: ResultMetric(result) for name, result in section.results.items()}
    named = {} if results and section.metrics is None else resolve_metrics(section.metrics)
    twice = next((name for name in results if name in named), None)
    if twice is not None:
        raise ParameterError("results", "must not have the name of a metric", twice)
    return named | resolve_metrics(results) if results else named


def _overlaps(path: str, parts: tuple[str, ...]) -> bool:
    return any(path == part or path.startswith(part + ".") or part.startswith(path + ".") for part in parts)


def copy_settings(data: Any) -> Any:
    """Return a copy of settings with new mappings and lists, in which values can be put."""
    if isinstance(data, dict):
        return {key: copy_settings(value) for key, value in data.items()}
    return [copy_settings(value) for value in data] if isinstance(data, list) else data


def takes_integers(source: Source, settings: Mapping[str, Any], path: str, probe: Any = 2.5) -> bool:
    """
    Return whether a setting accepts only integers.

    ``probe``: a number in its range that is not an integer.
    """
    changed = copy_settings(dict(settings))
    put_setting(source, changed, path, probe)
    try:
        check_settings(source, changed)
    except ConfigError as error:
        return "integer" in error.detail
    return False

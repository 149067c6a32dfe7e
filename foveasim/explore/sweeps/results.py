"""Conversion of point records to a labelled xarray.Dataset, and its zarr store."""

from __future__ import annotations

import json
import os
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.extras import import_optional
from foveasim._core.names import missing_path
from foveasim._core.validation import unit_of
from foveasim._io.atomic import atomic_directory
from foveasim.errors import FileError
from foveasim.explore._records import FORMAT, VERSION, Record, Value
from foveasim.explore.sweeps.plan import POINT, REPEAT, Plan, coordinate

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["check_store", "import_xarray", "open_results", "stored_plan", "to_dataset", "write_store"]

#: Variables of every sweep.
SEED, ERROR, WARNING = "seed", "error", "warning"
#: Attributes of a store, as JSON strings, which every file format supports.
PLAN, SETTINGS, VERSIONS = "plan", "settings", "versions"


def to_dataset(plan: Plan, records: Mapping[int, Record]) -> xr.Dataset:
    """
    Combine records to an xarray.Dataset, independent of their order.

    ``records``: records by point number; points without a record have NaN and the error "not done". Dimensions are the
    varied settings, or ``point``, and ``repeat``. Variables are the metrics, ``seed``, ``error`` (empty without errors) and
    ``warning``. Unlabelled dimensions are padded with NaN to the longest array.
    """
    xr = import_xarray("sweep")
    shape, dims = plan.shape, plan.dims
    errors = {k: records[k].error if k in records else "not done" for k in range(plan.n_points)}
    reserved = {*plan.values, POINT, REPEAT, SEED, ERROR, WARNING}
    values_by_name = _rename_dimensions(
        _select_consistent(_by_name([records[k] for k in sorted(records)]), reserved, errors), reserved
    )
    labels = _labels(values_by_name)
    variables: dict[str, Any] = {}
    for name, values in values_by_name.items():
        flat = _stack(values, plan.n_points, labels)
        variables[name] = (
            (*dims, *next(iter(values.values())).dims),
            flat.reshape(*shape, *flat.shape[1:]),
            {"units": unit_of(name)} if unit_of(name) else {},
        )
    seeds = np.array([plan.seed_of(k) for k in range(plan.n_points)], np.int64)
    strings = {
        ERROR: list(errors.values()),
        WARNING: [records[k].warning if k in records else "" for k in range(plan.n_points)],
    }
    variables[SEED] = (dims, seeds.reshape(shape))
    for name, each in strings.items():
        variables[name] = (dims, _string_array(each).reshape(shape))
    coords: dict[str, Any] = {
        path: (
            (path if plan.mode == "product" else POINT,),
            coordinate(values),
            {"units": unit_of(path)} if unit_of(path) else {},
        )
        for path, values in plan.values.items()
    }
    if plan.mode == "zip":
        coords[POINT] = np.arange(shape[0])
    if plan.repeats > 1:
        coords[REPEAT] = np.arange(plan.repeats)
    coords |= {dim: (dim, array) for dim, (array, _) in labels.items()}
    plan_dict = plan.to_dict()
    attributes = {
        "format": FORMAT,
        "version": VERSION,
        SETTINGS: json.dumps(plan_dict["settings"]),
        VERSIONS: json.dumps(plan_dict["versions"]),
        PLAN: json.dumps(plan_dict),
    }
    return xr.Dataset(variables, coords, attributes)


def _string_array(values: list[str]) -> NDArray[Any]:
    return np.array(values, np.dtypes.StringDType())


def _by_name(rows: Iterable[Record]) -> dict[str, dict[int, Value]]:
    """Return the values by name and point, with numbers and strings as 0-d arrays."""
    values_by_name: dict[str, dict[int, Value]] = {}
    for record in rows:
        for name, value in record.values.items():
            array = value if isinstance(value, Value) else Value(np.asarray(value), (), {})
            values_by_name.setdefault(name, {})[record.point] = array
    return values_by_name


def _select_consistent(
    values_by_name: Mapping[str, dict[int, Value]], reserved: set[str], errors: dict[int, str]
) -> dict[str, dict[int, Value]]:
    """
    Select the values with equal dimensions in all points.

    Values with other dimensions than most points, or with the name of a varied setting, are excluded and reported in
    ``errors``.
    """
    selected: dict[str, dict[int, Value]] = {}
    for name, values in values_by_name.items():
        kinds = Counter((value.dims, tuple(value.labels)) for value in values.values())
        most_common = kinds.most_common(1)[0][0]
        consistent = {k: value for k, value in values.items() if (value.dims, tuple(value.labels)) == most_common}
        dims = ", ".join(most_common[0]) or "none"
        problem = f"{name}: has other dimensions or labels than in most points, which have {dims}"
        if name in reserved:
            consistent, problem = {}, f"{name}: must not have the name of a setting or a dimension"
        for k in sorted(values.keys() - consistent.keys()):
            errors[k] = "; ".join(filter(None, (errors[k], problem)))
        if consistent:
            selected[name] = consistent
    return selected


def _rename_dimensions(
    values_by_name: Mapping[str, Mapping[int, Value]], reserved: set[str]
) -> dict[str, dict[int, Value]]:
    """
    Rename dimensions to unique names.

    Labelled dimensions are shared by all variables that use their name; unlabelled dimensions belong to one variable.
    """
    labelled = {dim for values in values_by_name.values() for dim in next(iter(values.values())).labels}
    renamed: dict[str, dict[int, Value]] = {}
    for name, values in values_by_name.items():
        first = next(iter(values.values()))
        new_names: dict[str, str] = {}
        for dim in first.dims:
            new_name = dim if dim in first.labels or dim.startswith(name) else f"{name}_{dim}"
            used_names = {
                *reserved,
                *values_by_name,
                *new_names.values(),
                *(() if new_name in first.labels else labelled),
            }
            if new_name in used_names:
                new_name = f"{name}_{dim}"
            while new_name in used_names:
                new_name += "_"
            new_names[dim] = new_name
        for k, value in values.items():
            labels = {new_names[dim]: each for dim, each in value.labels.items()}
            renamed.setdefault(name, {})[k] = Value(value.data, tuple(new_names[dim] for dim in value.dims), labels)
    return renamed


def _labels(values_by_name: Mapping[str, Mapping[int, Value]]) -> dict[str, tuple[NDArray[Any], dict[Any, int]]]:
    """Return the labels of labelled dimensions (sorted numbers, or strings) and their indices."""
    found: dict[str, dict[Any, None]] = {}
    for values in values_by_name.values():
        for value in values.values():
            for dim, labels in value.labels.items():
                found.setdefault(dim, {}).update(dict.fromkeys(labels.tolist()))
    combined: dict[str, tuple[NDArray[Any], dict[Any, int]]] = {}
    for dim, each in found.items():
        if any(isinstance(label, str) for label in each):
            indices = {text: k for k, text in enumerate(dict.fromkeys(map(str, each)))}
            combined[dim] = _string_array(list(indices)), {label: indices[str(label)] for label in each}
        else:
            numbers = sorted(each)
            combined[dim] = np.array(numbers), {label: k for k, label in enumerate(numbers)}
    return combined


def _stack(
    values: Mapping[int, Value], n_points: int, labels: Mapping[str, tuple[NDArray[Any], Mapping[Any, int]]]
) -> NDArray[Any]:
    """Stack the values of all points, (n_point, ...), with NaN or empty strings where missing."""
    first = next(iter(values.values()))
    shape = tuple(
        labels[dim][0].size if dim in first.labels else max(value.data.shape[axis] for value in values.values())
        for axis, dim in enumerate(first.dims)
    )
    kinds = {value.data.dtype.kind for value in values.values()}
    is_string = "U" in kinds
    is_complete = len(values) == n_points and all(value.data.shape == shape for value in values.values())
    if is_string:
        flat: NDArray[Any] = np.full((n_points, *shape), "", np.dtypes.StringDType())
    else:
        dtype = np.result_type(*(value.data.dtype for value in values.values()))
        if not is_complete and dtype.kind != "f":
            dtype = np.promote_types(dtype, np.float64)
        flat = np.empty((n_points, *shape), dtype) if is_complete else np.full((n_points, *shape), np.nan, dtype)
    for k, value in values.items():
        axis_indices: list[Any] = [
            np.array([labels[dim][1][label] for label in value.labels[dim].tolist()], np.int64)
            if dim in value.labels
            else np.arange(value.data.shape[axis])
            for axis, dim in enumerate(value.dims)
        ]
        index: Any = (k, *np.ix_(*axis_indices))
        flat[index] = value.data.astype(flat.dtype) if is_string else value.data
    return flat


# -- the store --------------------------------------------------------------------------------------------------------


def check_store(path: Path) -> None:
    """Check that results can be written to a path before the computation."""
    if not path.absolute().parent.is_dir():
        raise FileError(path, f"cannot be written: the directory {path.absolute().parent} does not exist")
    if path.exists() and not (path / "zarr.json").is_file():
        raise FileError(path, "cannot be written: it exists and does not contain sweep results; use another path")


def stored_plan(path: Path) -> dict[str, Any] | None:
    """Read the plan from a store of results; None if the store does not exist."""
    if not path.exists():
        return None
    try:
        attributes = json.loads((path / "zarr.json").read_text(encoding="utf-8"))["attributes"]
        if attributes["format"] == FORMAT:
            plan: dict[str, Any] = json.loads(attributes[PLAN])
            return plan
    except (OSError, ValueError, KeyError, TypeError):
        pass
    raise FileError(path, "does not contain sweep results")


def open_results(path: str | Path) -> xr.Dataset:
    """
    Load the results of a store into memory.

    Raises
    ------
    FileError
        When the store does not exist, or is corrupt.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> scene = {
    ...     "kind": "flat",
    ...     "shape": [60, 60],
    ...     "pitch_um": 300.0,
    ...     "distance_m": 1.0,
    ...     "illuminance_lux": 500.0,
    ... }
    >>> layout = {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 3.0}}
    >>> shot = {
    ...     "scene": scene,
    ...     "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    ...     "layout": layout,
    ...     "exposure_s": 0.002,
    ... }
    >>> shot["sensor"] = {"preset": "machine_vision"}
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = Path(directory, "results.zarr")
    ...     _ = fs.explore.sweep(
    ...         shot, {"sensor.bits": [8, 10]}, metrics=["n_sites"], out=path, workers=0
    ...     )
    ...     print(fs.explore.open_results(path)["n_sites"].values.tolist())
    [64, 64]
    """
    path = Path(path)
    if stored_plan(path) is None:
        raise FileError(path, missing_path(path, "store"))
    xarray = import_xarray(path)
    try:
        with xarray.open_zarr(path, consolidated=False, chunks=None) as dataset:
            loaded: xr.Dataset = dataset.load()
            return loaded
    except Exception as error:  # noqa: BLE001 -- corrupt stores raise many kinds of errors
        raise FileError(path, f"is corrupt ({' '.join(str(error).split()):.200})") from None


def write_store(dataset: xr.Dataset, path: Path) -> None:
    """Write a zarr store atomically, replacing an existing one."""
    with (
        atomic_directory(path, is_ours=lambda directory: stored_plan(directory) is not None) as new,
        warnings.catch_warnings(),
    ):
        # For xarray.open_zarr. The warning concerns other zarr implementations, which do not need consolidated metadata.
        warnings.filterwarnings("ignore", "Consolidated metadata is currently not part")
        dataset.to_zarr(new, mode="w", consolidated=True, zarr_format=3)
        # The store is on disk before the journal is removed: after a power failure, one of both is complete.
        for file in (path for path in new.rglob("*") if path.is_file()):
            with file.open("r+b") as opened:
                os.fsync(opened.fileno())


def import_xarray(subject: Path | str) -> Any:
    """Import xarray, and zarr, the format of the results."""
    import_optional(subject, "zarr", "explore")
    return import_optional(subject, "xarray", "explore")

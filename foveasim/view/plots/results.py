"""Curves of the results of a sweep."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import check_choice
from foveasim.errors import ParameterError
from foveasim.view.plots.sites import plot_curves

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

__all__ = ["plot_results"]

#: Largest number of curves that a legend can name.
MAX_CURVES = 12
#: Relative deviation of ratios between neighbouring values that are spaced geometrically.
GEOMETRIC = 0.1
#: Dimension of repeated points, and variables besides the metrics.
REPEAT, NO_METRICS = "repeat", ("seed",)


def plot_results(
    results: xr.Dataset,
    metric: str | None = None,
    *,
    x: str | None = None,
    at: Mapping[str, Any] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """
    Draw a metric of a sweep against a setting.

    There is one curve for each combination of the other settings.

    Parameters
    ----------
    results : xarray.Dataset
        From :func:`foveasim.explore.sweep` or :func:`foveasim.explore.open_results`. Repeats are averaged.
    metric : str, optional
        Name of a variable; by default the first one with a dimension.
    x : str, optional
        Setting along x; by default the numeric setting with the most values. The axis is logarithmic if these are spaced
        geometrically.
    at : mapping of str to value, optional
        Values of other settings; the nearest simulated value is drawn.
    ax : matplotlib axes, optional
        New axes by default.

    Returns
    -------
    matplotlib axes

    Raises
    ------
    ParameterError
        When a name is unknown, or there are more than 12 curves.

    Examples
    --------
    >>> import xarray as xr
    >>> sweep = xr.Dataset(
    ...     {"snr_mean": ("sensor.bits", [20.0, 31.0])}, {"sensor.bits": [8, 10]}
    ... )
    >>> plot_results(sweep).get_xlabel()
    'sensor.bits'
    """
    values = _metric(results, metric)
    for name, value in (at or {}).items():
        values = _selected(values, check_choice("at", name, [*map(str, values.dims)]), value)
    if REPEAT in values.dims:
        values = values.mean(REPEAT)
    values = values.squeeze()
    if not values.dims:
        raise ParameterError("results", "must have a setting with at least two values to draw")
    # The settings of a list of points are coordinates along one dimension.
    along = (
        _default_x(values)
        if x is None
        else check_choice("x", x, [*map(str, values.dims), *_settings_along_points(values)])
    )
    others = [str(dim) for dim in values.dims if dim not in values[along].dims]
    n_curves = math.prod(values.sizes[dim] for dim in others)
    if n_curves > MAX_CURVES:
        hint = f"specify the value of {' or '.join(map(repr, others))} with 'at'"
        raise ParameterError("results", f"must give at most {MAX_CURVES} curves, got {n_curves}", hint=hint)
    positions = _coordinate(values, along)
    curves = {}
    for index in itertools.product(*(range(values.sizes[dim]) for dim in others)):
        chosen = dict(zip(others, index, strict=True))
        name = ", ".join(f"{dim} = {_text(_coordinate(values, dim)[k])}" for dim, k in chosen.items())
        curves[name] = positions, values.isel(chosen).values
    scale: Literal["", "x"] = "x" if _is_geometric(positions) else ""
    return plot_curves(
        curves, _label(values, along), _label(results, str(values.name)), logarithmic=scale, marker="o", ax=ax
    )


def _metric(results: xr.Dataset, metric: str | None) -> xr.DataArray:
    """Return the variable of a metric."""
    names = [
        str(name)
        for name, values in results.data_vars.items()
        if values.dtype.kind in "fiub" and values.dims and name not in NO_METRICS
    ]
    if not names:
        raise ParameterError("results", "must contain a metric of numbers, with the settings as dimensions")
    return results[names[0] if metric is None else check_choice("metric", metric, names)]


def _settings_along_points(values: xr.DataArray) -> list[str]:
    """Return the coordinates of one dimension with another name."""
    return [str(name) for name, each in values.coords.items() if each.ndim == 1 and name not in values.dims]


def _selected(values: xr.DataArray, name: str, value: Any) -> xr.DataArray:
    """Return the values at the nearest simulated value of a setting."""
    positions = _coordinate(values, name)
    if positions.dtype.kind in "fiu":
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number):
            raise ParameterError("at", f"must be a number for {name!r}", value)
        index = int(np.abs(positions - number).argmin())
    else:
        texts = [str(position) for position in positions.tolist()]
        index = texts.index(check_choice("at", str(value), texts))
    return values.isel({name: index})


def _default_x(values: xr.DataArray) -> str:
    """Return the numeric dimension with the most values, else the first one."""
    numeric = [str(dim) for dim in values.dims if _coordinate(values, str(dim)).dtype.kind in "fiu"]
    return max(numeric or map(str, values.dims), key=lambda dim: values.sizes[dim])


def _coordinate(values: xr.DataArray, name: str) -> NDArray[Any]:
    """Return the values of a setting, or numbers from 0."""
    found = np.asarray(values[name].values)
    if found.dtype.kind in "fiu":
        return found
    # Strings of variable width have no conversion to those of fixed width.
    return np.array([str(value) for value in found.tolist()])


def _is_geometric(positions: NDArray[Any]) -> bool:
    """Return whether at least three positive numbers are spaced geometrically."""
    if positions.dtype.kind not in "fiu" or positions.size < 3 or positions.min() <= 0.0:
        return False
    steps = np.diff(np.log(np.sort(positions.astype(np.float64))))
    return bool(np.ptp(steps) < GEOMETRIC * steps.mean() and steps.sum() > math.log(3.0))


def _label(data: Any, name: str) -> str:
    units = data[name].attrs.get("units")
    return f"{name} / {units}" if units else name


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float | np.floating) else str(value)

"""
Chain of a sensor as arrays, to be evaluated on a GPU, or with gradients.

Steps that do not mix sites are reduced to straight lines where they are straight; others are tables.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from foveasim._core.validation import Floats, Ints, read_only
from foveasim.errors import ParameterError
from foveasim.sensor.effects import Effect, ShotNoise, Sites
from foveasim.sensor.effects.contract import NOTHING
from foveasim.sensor.effects.crosstalk import CrosstalkOperator
from foveasim.sensor.model.records import light_records

if TYPE_CHECKING:
    from foveasim.sensor.sensor import Sensor

__all__ = ["Curve", "GroupNoise", "LocalStep", "SensorSteps", "tabulate"]

#: Number of nodes of a table, and relative deviation up to which values lie on a straight line.
N_NODES, STRAIGHT = 1025, 1e-11
#: Charges of tables without a limit of the sensor, e-.
LARGEST_CHARGE_E = 1e6
#: Nodes at which straight lines are recognised, and the largest number of elements of a table, whose nodes are thinned up to
#: this factor.
PROBES, MAX_TABLE, MAX_STRIDE = (3, 17, 101, 260, 511, 777, 1001), 2**26, 16
#: Largest number of DNL offsets, readout lines x codes.
MAX_OFFSETS = 2**26
#: Range of the tables of voltages, in units of the full range.
VOLTAGE_RANGE = (-0.5, 2.0)


@dataclass(frozen=True, eq=False)
class Curve:
    """
    Function of the value before a step, at equidistant nodes of a variable t.

    ``t = sqrt(x)`` with ``is_root``, else ``t = x``. ``value`` and ``slope``, the derivative by x, are (n_node, n_site) or
    (n_node, 1).
    """

    start: float
    step: float
    value: Floats
    slope: Floats
    is_root: bool

    @classmethod
    def through(cls, nodes: Floats, value: Floats, *, is_root: bool, slope: Floats | None = None) -> Curve:
        """Return the curve through values at nodes (n_node,); slopes follow from them by default."""
        value = value.reshape(nodes.size, -1)
        found = np.asarray(np.gradient(value, nodes, axis=0, edge_order=2) if slope is None else slope)
        t = np.sqrt(nodes) if is_root else nodes
        shape = np.broadcast_shapes(value.shape, found.shape)
        return cls(float(t[0]), float(t[1] - t[0]), value, np.broadcast_to(found, shape), is_root)


@dataclass(frozen=True, eq=False)
class GroupNoise:
    """
    Gaussian noise common to groups of sites.

    ``deviation`` (n_site,) or (1,), unless there is a curve of it; ``labels`` (n_site,) from 0.
    """

    deviation: Floats
    labels: Ints
    curve: Curve | None = None


@dataclass(frozen=True, eq=False)
class LocalStep:
    """
    Step that does not mix sites.

    Attributes
    ----------
    slope, offset : (n_site,) or (1,)
        Mean after the step: ``slope * x + offset``, unless there is a curve.
    curve : Curve or None
    variance, variance_slope : (n_site,) or (1,)
        Variance that the step adds: ``variance + variance_slope * x``, unless there is a curve of it.
    variance_curve : Curve or None
    half_step : (n_site,) or (1,)
        Half the difference of two equally probable states.
    groups : tuple of GroupNoise
    distribution : {"gaussian", "poisson", "rounded"}
        Of the values after the step: rounded ones are the integers next to the mean.
    """

    slope: Floats
    offset: Floats
    curve: Curve | None = None
    variance: Floats = field(default_factory=lambda: np.zeros(1))
    variance_slope: Floats = field(default_factory=lambda: np.zeros(1))
    variance_curve: Curve | None = None
    half_step: Floats = field(default_factory=lambda: np.zeros(1))
    groups: tuple[GroupNoise, ...] = ()
    distribution: Literal["gaussian", "poisson", "rounded"] = "gaussian"

    @property
    def is_straight(self) -> bool:
        """Whether the mean is a straight line, and the noise is Gaussian and constant."""
        curves = self.curve, self.variance_curve, *(each.curve for each in self.groups)
        return all(curve is None for curve in curves) and not np.any(self.variance_slope)

    def after(self, before: LocalStep) -> LocalStep:
        """Return this step after another one, both straight."""
        return LocalStep(
            self.slope * before.slope,
            self.slope * before.offset + self.offset,
            variance=self.slope**2 * before.variance + self.variance,
            half_step=_only(self.slope * before.half_step, self.half_step),
            groups=(*(replace(each, deviation=self.slope * each.deviation) for each in before.groups), *self.groups),
        )

    def may_follow(self, before: LocalStep) -> bool:
        """Whether :meth:`after` exists: both steps are straight, and at most one has two states."""
        has_states = [np.any(step.half_step) for step in (before, self)]
        return before.is_straight and self.is_straight and not all(has_states)


@dataclass(frozen=True, eq=False)
class SensorSteps:
    """
    Chain of a sensor from expected charges to voltages at the ADC.

    Attributes
    ----------
    response : tuple of arrays or CrosstalkOperator
        Slopes from photoelectrons to expected charges: factors (n_site,) or (1,), and operators.
    collection : LocalStep
        From expected to collected charges.
    well_e : (n_site,) or (1,), e-
        Full well, the limit of the collected charges.
    charge : tuple of LocalStep or CrosstalkOperator
        From collected charges to those that are converted to voltages.
    sense : tuple of LocalStep
        From charges to voltages before the response nonlinearity.
    output : tuple of LocalStep
        From voltages after the nonlinearity to those at the ADC, including the pedestal.
    nonlinearity_fraction, v_sat_v : float
        Of the response nonlinearity, and the full range of the ADC, V.
    dnl_dn : (n_line, n_codes) or None, DN
        Offset of each code transition of the readout lines.
    line_of_site : (n_site,) int64
        Row of ``dnl_dn`` of each site.
    """

    response: tuple[Floats | CrosstalkOperator, ...]
    collection: LocalStep
    well_e: Floats
    charge: tuple[LocalStep | CrosstalkOperator, ...]
    sense: tuple[LocalStep, ...]
    output: tuple[LocalStep, ...]
    nonlinearity_fraction: float
    v_sat_v: float
    dnl_dn: Floats | None
    line_of_site: Ints


def tabulate(sensor: Sensor, exposure_s: float | None = None) -> SensorSteps:
    """
    Return the chain of a sensor, for its device, as lines, curves and operators.

    Parameters
    ----------
    sensor : Sensor
    exposure_s : float, optional, s
        Required by collections that depend on it.

    Notes
    -----
    Curves have 1,025 nodes: charges at equal steps of their square root, up to twice the saturation, voltages at equal steps.
    """
    sites = sensor._sites_during(exposure_s)  # noqa: SLF001 - part of the sensor
    dark = sensor.linearise(np.zeros(1), exposure_s=exposure_s)
    top_e = 2.0 * np.max(dark.saturation_e, initial=1.0, where=np.isfinite(dark.saturation_e))
    charges_e = np.linspace(0.0, np.sqrt(top_e if top_e > 2.0 else LARGEST_CHARGE_E), N_NODES) ** 2
    volts = sensor.v_sat_v * np.linspace(*VOLTAGE_RANGE, N_NODES)
    collection = _step(sensor.collection, charges_e, sites)
    if not sensor.collection.is_drawn:
        collection = replace(collection, distribution="rounded")
    elif isinstance(sensor.collection, ShotNoise):
        collection = replace(collection, distribution="poisson")
    lines, line_of_site = np.unique(sensor.layout.readout_line, return_inverse=True)
    light = light_records(sensor, sensor.sites, NOTHING, 1.0)
    line = LocalStep(np.ones(1), np.zeros(1))
    conversion, pedestal = replace(line, slope=sensor.v_per_e), replace(line, offset=np.full(1, sensor.pedestal_v))
    return SensorSteps(
        tuple(each.slope for each in light if each.branch != "dark" and each.slope is not None),
        collection,
        sensor.well_e,
        _merged(_steps(sensor.effects_at("charge"), charges_e, sites)),
        _local(_merged([conversion, *_steps(sensor.effects_at("sense_node"), volts, sites)])),
        _local(_merged([pedestal, *_steps(sensor.effects_at("output"), volts, sites)])),
        sensor.nonlinearity_fraction,
        sensor.v_sat_v,
        _dnl_offsets_dn(sensor, lines) if sensor.dnl_dn else None,
        line_of_site.ravel(),
    )


def _dnl_offsets_dn(sensor: Sensor, lines: Ints) -> Floats:
    """Return the DNL offset of each code transition of readout lines, (n_line, n_codes) DN."""
    from foveasim.sensor import _kernels

    if lines.size * sensor.adc.n_codes > MAX_OFFSETS:
        raise ParameterError(
            "sensor",
            f"must have at most {MAX_OFFSETS:,} readout lines times codes for a table of the DNL, got "
            f"{lines.size * sensor.adc.n_codes:,}",
            hint="set dnl_dn=0",
        )
    offset_dn = np.empty((lines.size, sensor.adc.n_codes))
    _kernels.dnl_offsets(sensor._tables, read_only(lines.astype(np.int32)), offset_dn)  # noqa: SLF001 - part of the sensor
    return offset_dn


def _steps(effects: Iterable[Effect], nodes: Floats, sites: Sites) -> list[LocalStep | CrosstalkOperator]:
    return [_operator(effect, sites) if effect.reach == "all" else _step(effect, nodes, sites) for effect in effects]


def _operator(effect: Effect, sites: Sites) -> CrosstalkOperator:
    """Return the operator of an effect that mixes sites."""
    slope = effect.validate_linear(np.zeros(sites.n_sites), sites).slope
    assert isinstance(slope, CrosstalkOperator)
    return slope


def _step(effect: Effect, nodes: Floats, sites: Sites) -> LocalStep:
    """Return an effect that does not mix sites."""
    step, is_straight = _through(effect, nodes[[0, *PROBES, -1]], sites)
    if is_straight:
        return step
    n_columns = max(part.value.shape[1] for part in _curves(step))
    every = max(1, -(-n_columns * nodes.size // MAX_TABLE))
    return _through(effect, nodes[:: min(every, MAX_STRIDE)], sites)[0]


def _through(effect: Effect, nodes: Floats, sites: Sites) -> tuple[LocalStep, bool]:
    """Return an effect through its models at some values, and whether it needs no curve."""
    models = [effect.validate_linear(np.array([value]), sites) for value in nodes]
    is_root = nodes[0] == 0.0
    slopes = [np.ones(1) if each.slope is None else each.slope for each in models]
    slope, offset, curve = _line(nodes, _rows([each.mean for each in models]), is_root, _rows(slopes))
    step = LocalStep(slope, offset, curve)
    if not effect.is_temporal or all(each.deviation is None for each in models):
        return step, curve is None
    deviations = _rows([np.zeros(1) if each.deviation is None else each.deviation for each in models])
    half_step, groups = effect.half_step(sites.of(effect)), models[0].groups
    if groups is not None:
        labels = np.unique(groups, return_inverse=True)[1].ravel()
        rise, lowest, curve_of_noise = _line(nodes, deviations, is_root)
        if np.any(rise) and curve_of_noise is None:
            curve_of_noise = Curve.through(nodes, deviations, is_root=is_root)
        step = replace(step, groups=(GroupNoise(lowest, labels, curve_of_noise),))
        return step, curve is None and curve_of_noise is None
    if half_step is not None:
        return replace(step, half_step=np.atleast_1d(half_step)), curve is None
    rise, lowest, curve_of_noise = _line(nodes, deviations**2, is_root)
    step = replace(step, variance=lowest, variance_slope=rise, variance_curve=curve_of_noise)
    return step, curve is None and curve_of_noise is None


def _line(
    nodes: Floats, values: Floats, is_root: bool, slopes: Floats | None = None
) -> tuple[Floats, Floats, Curve | None]:
    """Return slopes and values at 0 of lines through values (n_node, n), or a curve."""
    rise = (values[-1] - values[0]) / (nodes[-1] - nodes[0])
    rise = np.where(np.abs(rise) * np.abs(nodes).max() <= STRAIGHT * np.abs(values[0]), 0.0, rise)
    at_zero = values[0] - nodes[0] * rise
    line = at_zero + nodes[:, np.newaxis] * rise
    if np.all(np.abs(values - line) <= STRAIGHT * (1.0 + np.abs(values).max(axis=0))):
        return rise, at_zero, None
    return rise, at_zero, Curve.through(nodes, values, is_root=is_root, slope=slopes)


def _rows(parts: list[Any]) -> Floats:
    """Return arrays (n,) or (1,) as rows, with one column where all sites are equal."""
    rows = np.stack(np.broadcast_arrays(*parts))
    return rows[:, :1] if np.all(rows == rows[:, :1]) else rows


def _curves(step: LocalStep) -> list[Curve]:
    found = [step.curve, step.variance_curve, *(each.curve for each in step.groups)]
    return [curve for curve in found if curve is not None]


def _merged(steps: Iterable[LocalStep | CrosstalkOperator]) -> tuple[LocalStep | CrosstalkOperator, ...]:
    """Return steps, straight ones in succession as one."""
    merged: list[LocalStep | CrosstalkOperator] = []
    for step in steps:
        last = merged[-1] if merged else None
        if isinstance(step, LocalStep) and isinstance(last, LocalStep) and step.may_follow(last):
            merged[-1] = step.after(last)
        else:
            merged.append(step)
    return tuple(merged)


def _local(steps: Iterable[LocalStep | CrosstalkOperator]) -> tuple[LocalStep, ...]:
    return tuple(step for step in steps if isinstance(step, LocalStep))


def _only(one: Floats, other: Floats) -> Floats:
    """Return the one of two arrays that is not 0."""
    return one if np.any(one) else other

"""Records of the steps of the sensor chain: slopes, sources of noise, propagation."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.validation import Floats, Ints
from foveasim.sensor.effects.contract import Effect, Sites
from foveasim.sensor.effects.crosstalk import CrosstalkOperator
from foveasim.sensor.model.prediction import MIN_SLOPE, ReadoutModel, Transfer

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from foveasim.sensor.sensor import Sensor

#: Sites per block where rows of mixing operators are multiplied: bounds the memory.
BLOCK_ROWS = 4096
#: Source of noise: drawn for each frame, drawn at the reset, or different between devices.
NoiseKind: TypeAlias = Literal["temporal", "reset", "fixed"]
Branch: TypeAlias = Literal["photo", "dark", ""]


class Record(NamedTuple):
    """
    Step of the chain at the mean of each site.

    The fields from ``mean`` to ``groups`` are those of :class:`foveasim.sensor.effects.StepModel`. ``branch`` is that of the
    light or of the dark current before both are added, else empty. ``half_step`` is half the difference between two states.
    ``role`` marks the conversion of charge to voltage, and the response nonlinearity with the pedestal: an effect of a user may
    have any name.
    """

    name: str
    mean: Floats
    slope: Floats | CrosstalkOperator | None = None
    deviation: Floats | None = None
    groups: Ints | None = None
    kind: NoiseKind = "temporal"
    branch: Branch = ""
    half_step: Floats | None = None
    role: Literal["conversion", "response", ""] = ""

    @property
    def labels(self) -> Ints:
        """Indices of the groups of the sites, (n_site,); not every index has sites."""
        groups = np.asarray(self.groups)
        if groups.size and groups.min() >= 0 and groups.max() < groups.size:
            return groups
        return np.unique(groups, return_inverse=True)[1].ravel()

    @property
    def operator(self) -> CrosstalkOperator | None:
        """Slope of a step that mixes sites."""
        return None if self.slope is None or isinstance(self.slope, np.ndarray) else self.slope

    @property
    def factor(self) -> Floats | None:
        """Slope of a step that does not mix sites; None for 1."""
        return self.slope if isinstance(self.slope, np.ndarray) else None

    def map(self, values: Floats) -> Floats:
        """Return the derivative of the mean times values (..., n_site)."""
        if self.slope is None:
            return values
        return values * self.slope if isinstance(self.slope, np.ndarray) else self.slope.apply(values)

    def map_back(self, values: Floats) -> Floats:
        """Return the transposed derivative times values (..., n_site)."""
        return self.map(values) if self.operator is None else self.operator.transpose().apply(values)

    def correlate(self, values: Floats) -> Floats:
        """Return the covariance of the added noise times values (..., n_site)."""
        assert self.deviation is not None
        weighted = values * self.deviation
        if self.groups is not None:
            label = self.labels
            sums = [np.bincount(label, row)[label] for row in np.atleast_2d(weighted)]
            weighted = np.asarray(np.stack(sums).reshape(weighted.shape), np.float64)
        return weighted * self.deviation

    def spread(self, rows: csr_array[Any]) -> csr_array[Any]:
        """Return rows (n, n_site) times the factor F of the covariance F Fᵀ of the added noise."""
        from scipy.sparse import csr_array

        assert self.deviation is not None
        if self.groups is None:
            return scale_columns(rows, self.deviation)
        n_sites, label = rows.shape[1], self.labels
        shape = n_sites, int(label.max(initial=0)) + 1
        deviation = np.broadcast_to(self.deviation, n_sites)
        return csr_array(rows @ csr_array((deviation, label, np.arange(n_sites + 1)), shape=shape))

    def rows(self, rows: csr_array[Any]) -> csr_array[Any]:
        """Return rows (n, n_site) times the derivative of the mean."""
        if self.operator is not None:
            return self.operator.rows(rows)
        return rows if self.factor is None else scale_columns(rows, self.factor)

    def of(self, index: tuple[int, ...]) -> Record:
        """Return the step of one of several charges."""
        parts = {name: getattr(self, name) for name in ("mean", "slope", "deviation")}
        return self._replace(
            **{name: part[index] for name, part in parts.items() if isinstance(part, np.ndarray) and part.ndim > 1}
        )


def scale_columns(rows: csr_array[Any], factor: Floats) -> csr_array[Any]:
    """Return a sparse matrix with scaled columns."""
    from scipy.sparse import csr_array

    data = rows.data * (factor if factor.size == 1 else factor[rows.indices])
    return csr_array((data, rows.indices, rows.indptr), shape=rows.shape)


def walk(effects: Iterable[Effect], records: list[Record], mean: Floats, sites: Sites, branch: Branch = "") -> Floats:
    """Append the records of effects, and return the mean after them."""
    is_known = sites.known_device is not None
    for effect in effects:
        found = effect.validate_linear(mean, sites)
        kind: NoiseKind = "fixed" if not effect.is_temporal else "reset" if effect.is_drawn_at_reset else "temporal"
        half_step = effect.half_step(sites.of(effect)) if is_known and effect.is_temporal else None
        records.append(Record(effect.name, *found, kind, branch, half_step))
        mean = found.mean
    return mean


def map_light(records: Iterable[Record], values: Floats) -> Floats:
    """Return the derivative of the mean times values (..., n_site), without the dark branch."""
    for record in records:
        values = values if record.branch == "dark" else record.map(values)
    return values


def slope_of(records: Iterable[Record]) -> Floats:
    """Return the product of the slopes of steps that do not mix sites."""
    return map_light(records, np.ones(1))


def light_records(sensor: Sensor, sites: Sites, photo_e_per_s: Floats, exposure_s: float) -> list[Record]:
    """Return the records from photoelectron rates to expected charges."""
    slope = None if np.all(sensor.sensitivity == 1.0) else np.atleast_1d(sensor.sensitivity)
    rates = photo_e_per_s if slope is None else photo_e_per_s * slope
    records = [Record("", rates, slope, branch="photo")]
    rates = walk(sensor.effects_at("photo"), records, rates, sites, "photo")
    rates = rates + walk(sensor.effects_at("dark"), records, sensor.nominal_dark_e_per_s, sites, "dark")
    records.append(Record("", rates * exposure_s, np.array([exposure_s])))
    walk(sensor.effects_at("expected"), records, records[-1].mean, sites)
    return records


def split_charge(sensor: Sensor) -> tuple[list[Effect], list[Effect]]:
    """Split the effects on the collected charge after the last one that mixes sites."""
    charge = sensor.effects_at("charge")
    n = max((k + 1 for k, effect in enumerate(charge) if effect.reach == "all"), default=0)
    return charge[:n], charge[n:]


def walk_from_node(sensor: Sensor, sites: Sites, node_e: Floats) -> tuple[list[Record], Floats]:
    """Return the records from the sense node to the ADC, and the mean voltage at the ADC."""
    records: list[Record] = []
    mean = walk(split_charge(sensor)[1], records, node_e, sites) * sensor.v_per_e
    records.append(Record("", mean, sensor.v_per_e, role="conversion"))
    mean = walk(sensor.effects_at("sense_node"), records, mean, sites)
    mean, slope = apply_nonlinearity(sensor, mean)
    records.append(Record("", mean, slope, role="response"))
    return records, walk(sensor.effects_at("output"), records, mean, sites)


def apply_nonlinearity(sensor: Sensor, sense_v: Floats) -> tuple[Floats, Floats | None]:
    """Return voltages after nonlinearity and pedestal, and its slope, None for 1."""
    loss = sensor.nonlinearity_fraction
    if not loss:
        return (sense_v + sensor.pedestal_v if sensor.pedestal_v else sense_v), None
    fraction = sense_v / sensor.v_sat_v
    # Outside the range the relative loss is constant: 0, or that at full range.
    is_within = (fraction > 0.0) & (fraction < 1.0)
    fraction = np.clip(fraction, 0.0, 1.0)
    slope = np.maximum(1.0 - np.where(is_within, 2.0, 1.0) * loss * fraction, MIN_SLOPE)
    return sense_v * (1.0 - loss * fraction) + sensor.pedestal_v, slope


def transfer_of(sensor: Sensor, records: Iterable[Record], node_e: Floats) -> Transfer:
    """
    Return the transfer function of :func:`walk_from_node`.

    It is first-order in effects, and exact in the nonlinearity.
    """
    scale, offset, before = np.ones(1), np.zeros(1), node_e
    v_per_e, sense_v = scale, offset
    for record in records:
        if record.role == "response":
            v_per_e, sense_v, scale, offset = scale, offset, np.ones(1), np.full(1, sensor.pedestal_v)
        elif record.slope is not None:
            added = 0.0 if record.role == "conversion" else record.mean - record.map(before)
            scale, offset = record.map(scale), record.map(offset) + added
        elif record.mean is not before:
            offset = offset + (record.mean - before)
        before = record.mean
    return Transfer(v_per_e, sense_v, scale, offset, sensor.nonlinearity_fraction, sensor.v_sat_v)


def highest_charge_e(sensor: Sensor, transfer: Transfer) -> Floats:
    """Return the lowest charge with the highest code, at least 0; infinite if none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        top_fraction = sensor.adc.transition_levels[-2] - transfer.output_v / sensor.v_sat_v
        fraction = np.maximum(top_fraction / transfer.scale, 0.0)
        loss = sensor.nonlinearity_fraction
        if loss:
            relative = 0.5 * (1.0 - np.sqrt(np.maximum(1.0 - 4.0 * loss * fraction, 0.0))) / loss
            fraction = np.where(fraction < 1.0 - loss, relative, fraction / (1.0 - loss))
        top_v = np.maximum(fraction * sensor.v_sat_v - transfer.sense_v, 0.0)
        return np.where(transfer.v_per_e > 0.0, top_v / transfer.v_per_e, np.inf)


def _sum(one: Floats | None, other: Floats | None) -> Floats | None:
    """Return the sum of arrays, in place of one of them if possible; None for 0."""
    if one is None or other is None:
        return other if one is None else one
    if one.shape != other.shape and one.size < other.size:
        one, other = other, one
    return np.add(one, other, out=one if np.broadcast_shapes(one.shape, other.shape) == one.shape else None)


def _multiply(values: Floats, factor: Floats) -> Floats:
    """Return a product, in place of the values if possible."""
    is_own = np.broadcast_shapes(values.shape, factor.shape) == values.shape
    return np.multiply(values, factor, out=values if is_own else None)


def propagate(records: Sequence[Record], n_sites: int, is_used: Callable[[Record], bool]) -> Floats:
    """Return the variance of the chosen sources after the last step, (..., n_site) or (1,)."""
    sums: dict[str, Floats | None] = {"photo": None, "dark": None}
    is_diagonal = True
    for record in records:
        at = sums[record.branch] if record.branch in sums else _sum(sums["photo"], sums["dark"])
        if at is not None:
            if record.operator is None:
                if record.factor is not None:
                    at = _multiply(_multiply(at, record.factor), record.factor)
            elif is_diagonal:
                at = record.operator.variance(np.broadcast_to(at, np.broadcast_shapes(at.shape, (n_sites,))))
                is_diagonal = False
            else:
                return _propagate_rows(records, n_sites, is_used)
        if record.deviation is not None and is_used(record):
            at = _sum(at, np.square(record.deviation))
            is_diagonal &= record.groups is None
        sums[record.branch] = at
    total = sums.get("", sums["photo"])
    return np.zeros(1) if total is None else total


def _propagate_rows(records: Sequence[Record], n_sites: int, is_used: Callable[[Record], bool]) -> Floats:
    """Compute :func:`propagate` for correlated sources that are mixed, by blocks of rows."""
    shape = np.broadcast_shapes(*(np.shape(record.deviation) for record in records if record.deviation is not None))
    out = np.empty((*shape[:-1], n_sites))
    for index in np.ndindex(shape[:-1]):
        single = [record.of(index) for record in records]
        for first in range(0, n_sites, BLOCK_ROWS):
            sites = np.arange(first, min(first + BLOCK_ROWS, n_sites))
            factors = row_factors(single, n_sites, sites, is_used)
            out[index][sites] = sum(np.asarray(factor.power(2).sum(axis=1)).ravel() for factor in factors)
    return out


def row_factors(
    records: Sequence[Record], n_sites: int, sites: Ints, is_used: Callable[[Record], bool]
) -> Iterator[csr_array[Any]]:
    """
    Yield rows of a factor F of the covariance F Fᵀ after the last step, for each source.

    The rows are (n, n_site) or (n, n_group), sparse.
    """
    from scipy.sparse import csr_array

    rows = csr_array((np.ones(sites.size), sites, np.arange(sites.size + 1)), shape=(sites.size, n_sites))
    joined: csr_array[Any] | None = None
    branch: Branch = ""
    for record in reversed(records):
        if record.branch != branch:
            joined = rows if joined is None else joined
            rows, branch = joined, record.branch
        if record.deviation is not None and is_used(record):
            yield record.spread(rows)
        rows = record.rows(rows)


def readout_model(
    sensor: Sensor, mean_e: ArrayLike, variance_e2: ArrayLike, sites: Sites, *, is_reset: bool
) -> ReadoutModel:
    """
    Compute the first-order readout model at the mean collected charges.

    ``mean_e``, ``variance_e2`` (..., n_site) or number, e- and e-²: moments of collected charges. ``sites``: all sites, with a
    device or without. ``is_reset``: whether to include the noise of effects that are drawn at the reset.
    """
    mean_e, variance_e2 = (np.atleast_1d(np.asarray(part, np.float64)) for part in (mean_e, variance_e2))
    mixed = split_charge(sensor)[0]
    used = partial(is_temporal, is_reset=is_reset)
    own_fraction: Floats | None = None
    if mixed:
        records = [Record("", mean_e, deviation=np.sqrt(variance_e2))]
        mean_e = np.broadcast_to(mean_e, np.broadcast_shapes(mean_e.shape, (sites.n_sites,)))
        mean_e = walk(mixed, records, mean_e, sites)
        variance_e2 = propagate(records, sites.n_sites, used)
        if len(mixed) == 1 and records[1].operator is not None:
            own_fraction = records[1].operator.own_fraction
    records, _ = walk_from_node(sensor, sites, mean_e)
    slope = slope_of(records)
    states = [record._replace(deviation=record.half_step) for record in records]
    total, half_step2 = (propagate(part, sites.n_sites, used) for part in (records, states))
    variance = np.maximum(total - half_step2, 0.0)
    per_v2 = np.divide(1.0, slope**2, out=np.zeros(np.shape(slope)), where=slope != 0.0)
    return ReadoutModel(
        mean_e=mean_e,
        variance_e2=variance_e2,
        is_mixed=bool(mixed),
        own_fraction=own_fraction,
        transfer=transfer_of(sensor, records, mean_e),
        gaussian_e2=variance * per_v2,
        half_step_e=np.sqrt(half_step2 * per_v2),
    )


def is_temporal(record: Record, *, is_reset: bool = True) -> bool:
    """Whether a source is temporal; draws at the reset are constants in differences of reads."""
    return record.kind == "temporal" or (is_reset and record.kind == "reset")

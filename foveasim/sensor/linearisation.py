"""
First-order statistical model of a sensor: slopes and sources of noise along its chain.

One walk along the chain records the slope and the added noise of every step. All results about noise follow from these records:
predictions, the noise budget, signal-to-noise ratios, weights of estimates, covariances and information.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.names import possible_names
from foveasim._core.short_repr import short_repr
from foveasim._core.threads import cached_property
from foveasim._core.validation import Bools, Floats, Ints, as_numbers, check_per_site
from foveasim.errors import ParameterError
from foveasim.sensor.effects.contract import NOTHING, Effect, Operator, Sites, Stage
from foveasim.sensor.prediction import MIN_SLOPE, ReadoutModel, Transfer

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from foveasim.sensor.sensor import Sensor

__all__ = ["Inverse", "Linearisation"]

#: Noise is clipped within this number of standard deviations of the full well or the highest code. Its variance decreases from
#: there on, which is the saturation criterion of EMVA 1288.
CLIPPING_SIGMAS = 2.0
#: Sites per block where rows of mixing operators are multiplied: bounds the memory.
BLOCK_ROWS = 4096
#: Relative residual of iterative solutions with the covariance, and maximum number of iterations.
RESIDUAL, MAX_ITERATIONS = 1e-11, 1000
#: Relative step at which Newton's method ends, and maximum number of steps: a double root halves the error in each.
INVERSION_ROUNDING, MAX_INVERSIONS = 1e-14, 60
#: Names of the noise of the collection, of photoelectrons and of dark signal, and of the conversion to codes.
PHOTON_SHOT, DARK_SHOT, QUANTISATION = "photon_shot", "dark_shot", "quantisation"
#: Values to which derivatives refer: photoelectron rates, e-/s; expected charge, e-; or charge at the sense node, e-.
Start: TypeAlias = Literal["light", "charge", "node"]
#: Source of noise: drawn for each frame, drawn at the reset, or different between devices.
Kind: TypeAlias = Literal["temporal", "reset", "fixed"]
Branch: TypeAlias = Literal["photo", "dark", ""]


class Record(NamedTuple):
    """
    Step of the chain at the mean of each site.

    The fields from ``mean`` to ``groups`` are those of :class:`foveasim.sensor.effects.StepModel`. ``branch`` is that of the
    light or of the dark current before both are added, else empty. ``half_step`` is half the difference between two states.
    """

    name: str
    mean: Floats
    slope: Floats | Operator | None = None
    deviation: Floats | None = None
    groups: Ints | None = None
    kind: Kind = "temporal"
    branch: Branch = ""
    half_step: Floats | None = None

    @property
    def operator(self) -> Operator | None:
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
            rows = np.atleast_2d(weighted)
            label = np.unique(self.groups, return_inverse=True)[1].ravel()
            weighted = np.stack([np.bincount(label, row)[label] for row in rows]).reshape(weighted.shape)
        return weighted * self.deviation

    def spread(self, rows: csr_array[Any]) -> csr_array[Any]:
        """Return rows (n, n_site) times the factor F of the covariance F Fᵀ of the added noise."""
        from scipy.sparse import csr_array, dia_array

        n_sites = rows.shape[1]
        deviation = np.broadcast_to(np.asarray(self.deviation), n_sites)
        if self.groups is None:
            return csr_array(rows @ dia_array((deviation[np.newaxis], [0]), shape=(n_sites, n_sites)))
        label = np.unique(self.groups, return_inverse=True)[1].ravel()
        return csr_array(rows @ csr_array((deviation, label, np.arange(n_sites + 1)), shape=(n_sites, label.max() + 1)))

    def rows(self, rows: csr_array[Any]) -> csr_array[Any]:
        """Return rows (n, n_site) times the derivative of the mean."""
        from scipy.sparse import csr_array, dia_array

        if self.operator is not None:
            return csr_array(self.operator.rows(rows))
        if self.factor is None:
            return rows
        n_sites = rows.shape[1]
        diagonal = np.broadcast_to(self.factor, n_sites)[np.newaxis]
        return csr_array(rows @ dia_array((diagonal, [0]), shape=(n_sites, n_sites)))

    def of(self, index: tuple[int, ...]) -> Record:
        """Return the step of one of several charges."""
        parts = (
            part[index] if isinstance(part, np.ndarray) and part.ndim > 1 else part
            for part in (self.mean, self.slope, self.deviation)
        )
        return Record(self.name, *parts, *self[4:])  # type: ignore[arg-type] # the types of the parts stay


class _Walk:
    """Records of consecutive steps."""

    def __init__(self, sites: Sites) -> None:
        self.sites = sites
        self.records: list[Record] = []

    def effects(self, effects: Iterable[Effect], mean: Floats, branch: Branch = "") -> Floats:
        """Record effects, and return the mean after them."""
        is_known = self.sites.known_device is not None
        for effect in effects:
            found = effect.validate_linear(mean, self.sites)
            kind: Kind = "fixed" if not effect.is_temporal else "reset" if effect.is_drawn_at_reset else "temporal"
            half_step = effect.half_step(self.sites.of(effect)) if is_known and effect.is_temporal else None
            self.records.append(Record(effect.name, *found, kind, branch, half_step))
            mean = found.mean
        return mean

    def step(self, name: str, mean: Floats, slope: Floats | None = None, **values: Any) -> Floats:
        """Record a step, and return its mean."""
        self.records.append(Record(name, mean, slope, **values))
        return mean


def effects_at(chain: Iterable[Effect], stage: Stage) -> list[Effect]:
    """Return the effects of a stage, in their order."""
    return [effect for effect in chain if effect.stage == stage]


def light_records(
    sensor: Sensor, chain: Sequence[Effect], sites: Sites, photo: Floats, exposure_s: float
) -> list[Record]:
    """Return the records from photoelectron rates to expected charges, with the effects of a chain."""
    walk, sensitivity = _Walk(sites), np.atleast_1d(np.asarray(sensor.sensitivity, np.float64))
    slope = None if sensitivity.size == 1 and sensitivity[0] == 1.0 else sensitivity
    rates = walk.step("sensitivity", photo if slope is None else photo * slope, slope, branch="photo")
    rates = walk.effects(effects_at(chain, "photo"), rates, "photo")
    rates = rates + walk.effects(effects_at(chain, "dark"), sensor.nominal_dark_e_per_s, "dark")
    walk.effects(effects_at(chain, "expected"), walk.step("exposure", rates * exposure_s, np.array([exposure_s])))
    return walk.records


def split_charge(chain: Iterable[Effect]) -> tuple[list[Effect], list[Effect]]:
    """Return the effects on the collected charge up to the last one that mixes sites, and the others of this stage."""
    charge = effects_at(chain, "charge")
    n = max((k + 1 for k, effect in enumerate(charge) if effect.mixes_means), default=0)
    return charge[:n], charge[n:]


def node_records(sensor: Sensor, chain: Sequence[Effect], sites: Sites, node_e: Floats) -> list[Record]:
    """Return the records from the charge at the sense node to the voltage at the ADC, with the effects of a chain."""
    walk = _Walk(sites)
    charge_e = walk.effects(split_charge(chain)[1], node_e)
    sense_v = walk.effects(
        effects_at(chain, "sense_node"), walk.step("conversion", charge_e * sensor.v_per_e, sensor.v_per_e)
    )
    walk.effects(effects_at(chain, "output"), walk.step("nonlinearity", *apply_nonlinearity(sensor, sense_v)))
    return walk.records


def apply_nonlinearity(sensor: Sensor, sense_v: Floats) -> tuple[Floats, Floats | None]:
    """Return voltages after nonlinearity and pedestal, and the slope of the nonlinearity, None for 1."""
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
    """Return the transfer function of :func:`node_records`: first-order in effects, exact in the nonlinearity."""
    scale, offset, before = np.ones(1), np.zeros(1), node_e
    v_per_e, sense_v = scale, offset
    for record in records:
        if record.name == "nonlinearity":
            v_per_e, sense_v, scale, offset = scale, offset, np.ones(1), np.full(1, sensor.pedestal_v)
        elif record.slope is not None:
            added = 0.0 if record.name == "conversion" else record.mean - record.map(before)
            scale, offset = record.map(scale), record.map(offset) + added
        elif record.mean is not before:
            offset = offset + (record.mean - before)
        before = record.mean
    return Transfer(v_per_e, sense_v, scale, offset, sensor.nonlinearity_fraction, sensor.v_sat_v)


def top_e(sensor: Sensor, transfer: Transfer) -> Floats:
    """Return the lowest charge at the sense node with the highest code, at least 0; infinite if none has it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        top_fraction = sensor.adc.transition_levels[-2] - transfer.output_v / sensor.v_sat_v
        fraction = np.maximum(top_fraction / transfer.scale, 0.0)
        loss = sensor.nonlinearity_fraction
        if loss:
            relative = 0.5 * (1.0 - np.sqrt(np.maximum(1.0 - 4.0 * loss * fraction, 0.0))) / loss
            fraction = np.where(fraction < 1.0 - loss, relative, fraction / (1.0 - loss))
        top_v = np.maximum(fraction * sensor.v_sat_v - transfer.sense_v, 0.0)
        return np.where(transfer.v_per_e > 0.0, top_v / transfer.v_per_e, np.inf)


def propagate(
    records: Iterable[Record], n_sites: int, is_used: Callable[[Record], bool], start: Floats | float = 0.0
) -> Floats:
    """
    Return the variance of the sum of the chosen sources after the last step, (..., n_site) or (1,).

    ``start``: variance of independent sites before the first step.
    """
    records = list(records)
    variance: dict[str, Any] = {"photo": start, "dark": 0.0, "": None}
    is_diagonal = True
    for record in records:
        at = variance[record.branch]
        if at is None:
            at = variance["photo"] + variance["dark"]
        if np.any(at):
            if record.operator is None:
                at = at if record.slope is None else at * np.square(record.slope)
            elif is_diagonal:
                at = record.operator.variance(np.broadcast_to(at, np.broadcast_shapes(np.shape(at), (n_sites,))))
                is_diagonal = False
            else:
                return _propagate_rows(records, n_sites, is_used, start)
        if record.deviation is not None and is_used(record):
            at = at + np.square(record.deviation)
            is_diagonal &= record.groups is None
        variance[record.branch] = at
    total = variance[""] if variance[""] is not None else variance["photo"]
    return np.atleast_1d(np.asarray(total, np.float64))


def _propagate_rows(
    records: list[Record], n_sites: int, is_used: Callable[[Record], bool], start: Floats | float
) -> Floats:
    """Compute :func:`propagate` where sources are correlated before they are mixed, in blocks of rows."""
    if np.any(start):
        records = [Record("", NOTHING, None, np.sqrt(start), branch="photo"), *records]
        chosen = is_used

        def is_used(record: Record) -> bool:
            return not record.name or chosen(record)

    shape = np.broadcast_shapes(*(np.shape(record.deviation) for record in records if record.deviation is not None))[
        :-1
    ]
    out = np.empty((*shape, n_sites))
    for index in np.ndindex(shape):
        single = [record.of(index) for record in records]
        for first in range(0, n_sites, BLOCK_ROWS):
            sites = np.arange(first, min(first + BLOCK_ROWS, n_sites))
            factors = row_factors(single, n_sites, sites, is_used)
            out[index][sites] = sum(np.asarray(factor.power(2).sum(axis=1)).ravel() for factor in factors)
    return out


def row_factors(
    records: Iterable[Record], n_sites: int, sites: Ints, is_used: Callable[[Record], bool]
) -> Iterator[csr_array[Any]]:
    """
    Yield the rows of some sites of a factor F of the covariance F Fᵀ after the last step, for each chosen source.

    The rows are (n, n_site) or (n, n_group), sparse.
    """
    from scipy.sparse import csr_array

    rows = csr_array((np.ones(sites.size), sites, np.arange(sites.size + 1)), shape=(sites.size, n_sites))
    joined: csr_array[Any] | None = None
    branch: Branch = ""
    for record in reversed(list(records)):
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
    chain = sensor.chain
    mixed = split_charge(chain)[0]
    used = partial(_is_temporal, is_reset=is_reset)
    if mixed:
        walk = _Walk(sites)
        mean_e = walk.effects(mixed, np.broadcast_to(mean_e, np.broadcast_shapes(mean_e.shape, (sites.n_sites,))))
        variance_e2 = propagate(walk.records, sites.n_sites, used, variance_e2)
    records = node_records(sensor, chain, sites, mean_e)
    slope, variance, half_step2 = np.ones(1), np.zeros(1), np.zeros(1)
    for record in records:
        if record.slope is not None:
            slope = slope * record.slope
            variance, half_step2 = (
                part * np.square(record.slope) if np.any(part) else part for part in (variance, half_step2)
            )
        if record.deviation is not None and used(record):
            own = NOTHING if record.half_step is None else np.square(record.half_step)
            variance, half_step2 = variance + np.maximum(np.square(record.deviation) - own, 0.0), half_step2 + own
    per_v2 = np.divide(1.0, slope**2, out=np.zeros(np.shape(slope)), where=slope != 0.0)
    return ReadoutModel(
        mean_e=mean_e,
        variance_e2=variance_e2,
        is_mixed=bool(mixed),
        transfer=transfer_of(sensor, records, mean_e),
        gaussian_e2=variance * per_v2,
        half_step_e=np.sqrt(half_step2 * per_v2),
    )


def _is_temporal(record: Record, *, is_reset: bool = True) -> bool:
    """Whether a source is temporal; draws at the reset are constants in differences of reads."""
    return record.kind == "temporal" or (is_reset and record.kind == "reset")


@dataclass(frozen=True, eq=False, repr=False)
class Linearisation:
    """
    First-order statistical model of a sensor at the mean of each site.

    Created by :meth:`foveasim.Sensor.linearise`. Codes are those of the ADC; noise in e- is referred to the charge at the sense
    node, after effects that mix sites. Arrays are (..., n_site), or (1,) for equal values.

    Attributes
    ----------
    sensor : Sensor
    expected_e : (..., n_site) float64, e-
        Expected charge before the collection.
    node_e : (..., n_site) float64, e-
        Mean charge at the sense node, at most :attr:`top_e`.
    top_e : (..., n_site) or (1,) float64, e-
        Lowest charge at the sense node with the highest code.

    Notes
    -----
    A source of noise is a standard deviation at its step of the chain, with or without groups of sites that share its draw. Its
    covariance is ``L Lᵀ``, with L the later slopes times the deviation. Covariances are applied, and never assembled for all
    sites.

    At sites above their range, signal and noise are those at the end of the range: the signal-to-noise ratio is the maximum one
    of EMVA 1288. The derivative is 0 at saturated sites. Clipping at code 0 is not included.
    """

    sensor: Sensor
    expected_e: Floats
    node_e: Floats
    top_e: Floats
    _records: tuple[Record, ...]
    _starts: dict[str, int]
    _full_e: Floats | None
    _transfer: Transfer

    def __repr__(self) -> str:
        names = ", ".join(self.sources)
        return f"Linearisation({self.n_sites:,} sites, sources {names})"

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return self.sensor.layout.n_sites

    @property
    def sources(self) -> dict[str, Kind]:
        """Sources of noise in the order of the chain: ``"temporal"``, drawn at the ``"reset"``, or ``"fixed"``, by name."""
        return {record.name: record.kind for record in self._records if record.deviation is not None}

    # -- means and slopes ---------------------------------------------------------------------------------------------

    @cached_property
    def mean_dn(self) -> Floats:
        """Mean code: that of the mean voltage, minus 1/2 for quantisation, (..., n_site) or (1,)."""
        adc = self.sensor.adc
        fraction = np.clip(self._records[-2].mean / self.sensor.v_sat_v, 0.0, 1.0)
        return np.interp(fraction, adc.transition_levels, np.arange(adc.n_codes + 1.0)) - 0.5

    @cached_property
    def gain_dn_per_e(self) -> Floats:
        """Derivative of the code with respect to the charge at the sense node, (..., n_site) or (1,) DN/e-."""
        slope = np.ones(1)
        for record in self._records[self._starts["node"] :]:
            slope = record.map(slope)
        return slope

    @cached_property
    def linear_gain_dn_per_e(self) -> Floats:
        """System gain without response nonlinearity: linear codes per electron, (..., n_site) or (1,) DN/e-."""
        return self._transfer.v_per_e * self._transfer.scale / self.sensor.v_sat_v * 2.0**self.sensor.bits

    @cached_property
    def is_saturated(self) -> Bools:
        """Whether noise is clipped by the full well or the highest code, within two standard deviations, (..., n_site)."""
        is_saturated = self.node_e + CLIPPING_SIGMAS * np.sqrt(self.variance_e2()) >= self.top_e
        if self._full_e is not None:
            is_saturated = is_saturated | (self._full_e >= self.sensor.well_e)
        return np.broadcast_to(is_saturated, np.broadcast_shapes(is_saturated.shape, (self.n_sites,)))

    def forward(self, values: ArrayLike, start: Start = "charge") -> Floats:
        """
        Compute the change of the mean codes for small changes of the light or the charge.

        Parameters
        ----------
        values : (..., n_site)
            Changes of photoelectron rates, e-/s (``"light"``), of expected charges, e- (``"charge"``), or of charges at the
            sense node, e- (``"node"``).
        start : {"light", "charge", "node"}

        Returns
        -------
        change : (..., n_site) float64, DN
            0 at saturated sites.

        Raises
        ------
        ParameterError
            For ``"light"`` without the exposure.
        """
        changes = self._check("values", values)
        for record in self._main(start):
            changes = record.map(changes)
        return np.where(self.is_saturated, 0.0, changes)

    def backward(self, values: ArrayLike, start: Start = "charge") -> Floats:
        """
        Compute the gradient of a function of the codes with respect to the light or the charge.

        This is the transpose of :meth:`forward`.

        Parameters
        ----------
        values : (..., n_site)
            Gradient with respect to the codes.
        start : {"light", "charge", "node"}

        Returns
        -------
        gradient : (..., n_site) float64
        """
        gradient = np.where(self.is_saturated, 0.0, self._check("values", values))
        for record in reversed(self._main(start)):
            gradient = record.map_back(gradient)
        return gradient

    # -- noise --------------------------------------------------------------------------------------------------------

    def variance_dn2(self, sources: Collection[str] | None = None, *, is_reset: bool = True) -> Floats:
        """
        Compute the temporal variance of the codes.

        Parameters
        ----------
        sources : sequence of str, optional
            Names among :attr:`sources`, also of fixed patterns; by default all temporal ones.
        is_reset : bool
            Whether to include noise that is drawn at the reset, which cancels in differences of non-destructive reads.

        Returns
        -------
        variance : (..., n_site) or (1,) float64, DN²
            Includes quantisation: 1/12 DN², and differential nonlinearity.
        """
        return propagate(self._records, self.n_sites, self._chosen(sources, is_reset))

    def variance_e2(self, sources: Collection[str] | None = None, *, is_reset: bool = True) -> Floats:
        """Compute the temporal variance referred to the charge at the sense node, e-²; see :meth:`variance_dn2`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = self.variance_dn2(sources, is_reset=is_reset) / np.square(self.gain_dn_per_e)
        return np.where(np.isnan(variance), 0.0, variance) if np.isnan(np.min(variance, initial=0.0)) else variance

    def covariance_dn2(self, sites: ArrayLike, others: ArrayLike) -> Floats:
        """
        Compute the temporal covariance of the codes of pairs of sites.

        Parameters
        ----------
        sites, others : (n_pair,) int
            Indices of the sites of each pair.

        Returns
        -------
        covariance : (..., n_pair) float64, DN²
        """
        index, other = (self._check_sites(name, pair) for name, pair in (("sites", sites), ("others", others)))
        if index.size != other.size:
            raise ParameterError("others", f"must have as many elements as 'sites', {index.size}, got {other.size}")
        self._check_single()
        pairs = (row_factors(self._records, self.n_sites, each, self._chosen(None, True)) for each in (index, other))
        products = (np.asarray(a.multiply(b).sum(axis=1)).ravel() for a, b in zip(*pairs, strict=True))
        return np.asarray(sum(products, np.zeros(index.size)))

    def covariance_matrix_dn2(self, sites: ArrayLike) -> Floats:
        """
        Compute the temporal covariance of the codes of some sites, (n, n) DN².

        ``sites`` (n,) int: indices of the sites.
        """
        self._check_single()
        index = self._check_sites("sites", sites)
        factors = row_factors(self._records, self.n_sites, index, self._chosen(None, True))
        return np.asarray(sum(((a @ a.T).toarray() for a in factors), np.zeros((index.size, index.size))))

    def apply_covariance(self, values: ArrayLike) -> Floats:
        """Apply the temporal covariance of the codes to values (..., n_site); the result is in DN² times their unit."""
        values = self._check("values", values)
        records, chosen = self._records[self._starts["charge"] :], self._chosen(None, True)
        back: list[Floats] = []
        for record in reversed(records):
            back.append(values)
            values = record.map_back(values)
        total: Floats = np.zeros(1)
        for record, at in zip(records, reversed(back), strict=True):
            total = record.map(np.broadcast_to(total, at.shape))
            if record.deviation is not None and chosen(record):
                total = total + record.correlate(at)
        return total

    @cached_property
    def is_correlated(self) -> bool:
        """Whether the temporal noise of different sites is correlated."""
        chosen = self._chosen(None, True)
        sources = [k for k, record in enumerate(self._records) if record.deviation is not None and chosen(record)]
        return any(
            self._records[k].groups is not None or any(later.operator is not None for later in self._records[k + 1 :])
            for k in sources
        )

    def solve_covariance(self, values: ArrayLike, sites: ArrayLike | None = None) -> Floats:
        """
        Apply the inverse of the temporal covariance of the codes of all sites, or of some of them.

        Parameters
        ----------
        values : (n, n_site) or (n_site,)
        sites : (n,) int, optional
            Indices of the sites whose codes are known; the values of others are not used.

        Returns
        -------
        solution : (n, n_site) or (n_site,) float64
            0 at sites whose codes are not known.

        Notes
        -----
        Without correlated noise, the inverse is diagonal. Noise that groups share has the inverse of Woodbury's formula. Where
        noise is mixed, conjugate gradients are used, with the variances as preconditioner.
        """
        values = self._check("values", values)
        self._check_single()
        variance = np.broadcast_to(self.variance_dn2(), self.n_sites)
        known = np.arange(self.n_sites) if sites is None else self._check_sites("sites", sites)
        rows = np.atleast_2d(values)[:, known]
        if not self.is_correlated:
            found = rows / variance[known]
        elif any(record.operator is not None for record in self._records[self._starts["charge"] :]):
            found = np.stack([self._conjugate_gradients(row, variance, known) for row in rows])
        else:
            found = self._woodbury(rows, known)
        solution = np.zeros((len(rows), self.n_sites))
        solution[:, known] = found
        return solution.reshape(values.shape)

    def weigh(self, changes: ArrayLike, start: Start = "charge", sites: ArrayLike | None = None) -> Floats:
        """
        Apply the Fisher information of the codes about the light or the charges of all sites.

        Parameters
        ----------
        changes : (n, n_site) or (n_site,)
            Changes of light or charges, as for :meth:`forward`.
        start : {"light", "charge", "node"}
        sites : (n,) int, optional
            Indices of the sites whose codes are known.

        Returns
        -------
        weighted : (n, n_site) or (n_site,) float64
            ``Jᵀ C⁻¹ J`` times the changes, with the derivatives J of the codes and their covariance C. Without correlations it
            is the change over the variance, both referred to the charge.
        """
        return self.backward(self.solve_covariance(self.forward(changes, start), sites), start)

    def information(self, patterns: ArrayLike, start: Start = "charge", sites: ArrayLike | None = None) -> Floats:
        """
        Compute the Fisher information of the codes about amplitudes of patterns.

        Parameters
        ----------
        patterns : (n_pattern, n_site)
            Changes of light or charge per unit of each parameter, as for :meth:`forward`.
        start : {"light", "charge", "node"}
        sites : (n,) int, optional
            Indices of the sites whose codes are known.

        Returns
        -------
        information : (n_pattern, n_pattern) float64
            ``G C⁻¹ Gᵀ`` with the derivatives G of the codes and their covariance C: for Gaussian noise of known variance. Its
            inverse is the Cramér–Rao bound.
        """
        derivatives = np.atleast_2d(self.forward(patterns, start))
        return np.asarray(derivatives @ self.solve_covariance(derivatives, sites).T)

    def _woodbury(self, rows: Floats, known: Ints) -> Floats:
        """Solve systems with the covariance of known sites, (n, n_known), for noise that groups share and nothing mixes."""
        from scipy.sparse import csr_array, dia_array, eye_array, hstack
        from scipy.sparse.linalg import splu

        chosen = self._chosen(None, True)
        records = self._records[self._starts["charge"] :]
        variance = propagate(records, self.n_sites, lambda record: chosen(record) and record.groups is None)
        independent = np.broadcast_to(variance, self.n_sites)[known]
        factors = row_factors(records, self.n_sites, known, lambda record: chosen(record) and record.groups is not None)
        factor = csr_array(hstack(list(factors)))
        inverse = dia_array(((1.0 / independent)[np.newaxis], [0]), shape=(known.size, known.size))
        inner = splu((eye_array(factor.shape[1]) + factor.T @ inverse @ factor).tocsc())
        weighted = rows / independent
        return weighted - (factor @ inner.solve(np.ascontiguousarray(factor.T @ weighted.T))).T / independent

    def _conjugate_gradients(self, row: Floats, variance: Floats, known: Ints) -> Floats:
        """Solve a system with the covariance of known sites, (n_known,)."""
        from scipy.sparse.linalg import LinearOperator, cg

        def apply(values: Floats) -> Floats:
            all_values = np.zeros(self.n_sites)
            all_values[known] = np.ravel(values)
            return self.apply_covariance(all_values)[known]

        shape = (known.size, known.size)
        matrix = LinearOperator(shape, matvec=apply, dtype=np.float64)
        inverse = LinearOperator(shape, matvec=lambda values: np.ravel(values) / variance[known], dtype=np.float64)
        solution, _ = cg(matrix, row, rtol=RESIDUAL, maxiter=MAX_ITERATIONS, M=inverse)
        return np.asarray(solution)

    # -- parts --------------------------------------------------------------------------------------------------------

    def _chosen(self, sources: Collection[str] | None, is_reset: bool) -> Callable[[Record], bool]:
        """Return a function that chooses sources."""
        if sources is None:
            return partial(_is_temporal, is_reset=is_reset)
        names = {sources} if isinstance(sources, str) else set(sources)
        unknown = sorted(names.difference(self.sources))
        if unknown:
            raise ParameterError(
                "sources", f"must be names from {', '.join(self.sources)}", unknown[0],
                hint=possible_names(unknown[0], list(self.sources)),
            )  # fmt: skip
        return lambda record: record.name in names and (is_reset or record.kind != "reset")

    def _main(self, start: Start) -> list[Record]:
        """Return the steps from light or charge to the codes."""
        if start not in self._starts:
            raise ParameterError(
                "start",
                "must be 'charge' or 'node', or 'light' with a known exposure",
                start,
                hint="pass exposure_s to Sensor.linearise",
            )
        return [record for record in self._records[self._starts[start] :] if record.branch != "dark"]

    def _check_single(self) -> None:
        """Raise unless the model is that of a single charge per site."""
        if np.ndim(self.node_e) > 1:
            raise ParameterError(
                "expected_e", f"must be one charge per site for covariances, got {np.shape(self.node_e)}"
            )

    def _check(self, name: str, values: ArrayLike) -> Floats:
        array = np.asarray(as_numbers(name, values), np.float64)
        return check_per_site(name, array, self.n_sites, or_rows=True)

    def _check_sites(self, name: str, index: ArrayLike) -> Ints:
        found = np.atleast_1d(np.asarray(index))
        if found.ndim != 1 or found.dtype.kind not in "iu" or np.any((found < 0) | (found >= self.n_sites)):
            raise ParameterError(name, f"must be indices of the {self.n_sites} sites", index)
        return found


def linearise(
    sensor: Sensor,
    chain: Sequence[Effect],
    sites: Sites,
    expected_e: Floats | None,
    photo_e_per_s: Floats | None,
    exposure_s: float | None,
) -> Linearisation:
    """Walk along the chain: see :meth:`foveasim.Sensor.linearise`."""
    records: list[Record] = []
    starts: dict[str, int] = {}
    photo_fraction: Floats | None = None
    if exposure_s is not None:
        rates = NOTHING if photo_e_per_s is None else photo_e_per_s
        records = light_records(sensor, chain, sites, rates, exposure_s)
        starts["light"] = 0
        if photo_e_per_s is not None:
            mean_e, photo_e = records[-1].mean, photo_e_per_s
            for record in records:
                photo_e = photo_e if record.branch == "dark" else record.map(photo_e)
            photo_fraction = np.divide(photo_e, mean_e, out=np.zeros(np.shape(mean_e)), where=np.asarray(mean_e) > 0.0)
            photo_fraction = np.clip(photo_fraction, 0.0, 1.0)
            expected_e = mean_e if expected_e is None else expected_e
    assert expected_e is not None
    starts["charge"] = len(records)
    collected_e, slope, deviation, groups = sensor.shot.validate_linear(expected_e, sites)
    full_e: Floats | None = None
    if sensor.full_well_e is not None:
        own = 0.0 if deviation is None or not sensor.shot.is_drawn else deviation
        full_e = collected_e + CLIPPING_SIGMAS * own
        part = np.divide(
            sensor.well_e, collected_e, out=np.ones(np.shape(collected_e)), where=collected_e > sensor.well_e
        )
        collected_e = np.minimum(collected_e, sensor.well_e)
        deviation = None if deviation is None else deviation * np.sqrt(part) if sensor.shot.is_drawn else deviation
    own = {"groups": groups, "kind": "temporal"}
    if photo_fraction is None or not sensor.shot.is_drawn:
        records.append(Record(sensor.shot.name, collected_e, slope, deviation, **own))
    else:
        deviation = NOTHING if deviation is None else deviation
        records += [
            Record(PHOTON_SHOT, collected_e, slope, deviation * np.sqrt(photo_fraction), **own),
            Record(DARK_SHOT, collected_e, None, deviation * np.sqrt(1.0 - photo_fraction), **own),
        ]
    walk = _Walk(sites)
    node_e = walk.effects(split_charge(chain)[0], collected_e)
    records += walk.records
    starts["node"] = len(records)
    after = node_records(sensor, chain, sites, node_e)
    transfer = transfer_of(sensor, after, node_e)
    highest_e = top_e(sensor, transfer)
    if np.any(node_e > highest_e):
        # Sites above their range have the values of the end of the range.
        part = np.divide(highest_e, node_e, out=np.ones(np.shape(node_e)), where=node_e > highest_e)
        if sensor.shot.is_drawn:
            for k in range(starts["charge"], starts["node"]):
                if records[k].name in (PHOTON_SHOT, DARK_SHOT, sensor.shot.name):
                    records[k] = records[k]._replace(deviation=records[k].deviation * np.sqrt(part))
        node_e = np.minimum(node_e, highest_e)
        after = node_records(sensor, chain, sites, node_e)
    adc = sensor.adc
    step_v = np.full(1, sensor.v_sat_v / 2.0**sensor.bits)
    output_v = after[-1].mean
    if not adc.is_linear:
        step_v = adc.width_at_dn(np.clip(output_v / sensor.v_sat_v, 0.0, 1.0)) * step_v
    with np.errstate(divide="ignore"):
        per_v = 1.0 / step_v
    conversion = Record(QUANTISATION, output_v, per_v, np.full(1, math.sqrt(adc.noise_dn2)))
    return Linearisation(
        sensor, expected_e, node_e, highest_e, (*records, *after, conversion), starts, full_e, transfer
    )


class Inverse(NamedTuple):
    """
    Charges at the sense nodes that codes correspond to, on the nominal sensor.

    Attributes
    ----------
    charge_e : (..., n_site) float64, e-
        Charge whose voltage is at the centre of the code.
    noise_e2 : (..., n_site) float64, e-²
        Temporal variance of readout and conversion, without that of the collection.
    is_saturated : (..., n_site) bool
        Whether a code is the highest one, or the charge is the full well.
    """

    charge_e: Floats
    noise_e2: Floats
    is_saturated: Bools

    def __repr__(self) -> str:
        return short_repr(self)


def invert(sensor: Sensor, sites: Sites, code: ArrayLike, fraction: Floats) -> Inverse:
    """
    Invert the chain from the charge at the sense node to codes: see :meth:`foveasim.Sensor.invert`.

    ``fraction`` (..., n_site): voltages of the codes relative to the range. Newton's method starts at no charge: for a response
    that bends towards saturation it converges from below.
    """
    target_v, codes = fraction * sensor.v_sat_v, np.asarray(code, np.float64)
    charge_e: Floats = np.zeros(np.broadcast_shapes(target_v.shape, (sites.n_sites,)))
    slope = np.ones(1)
    for _ in range(MAX_INVERSIONS):
        records = node_records(sensor, sensor.chain, sites, charge_e)
        slope = np.ones(1)
        for record in records:
            slope = record.map(slope)
        step_e = np.divide(target_v - records[-1].mean, slope, out=np.zeros_like(charge_e), where=slope != 0.0)
        charge_e = charge_e + step_e
        if np.all(np.abs(step_e) <= INVERSION_ROUNDING * (1.0 + np.abs(charge_e))):
            break
    readout = readout_model(sensor, np.maximum(charge_e, 0.0), 0.0, sites, is_reset=True)
    step_v = sensor.adc.width_of_code_dn(codes) * sensor.v_sat_v / 2.0**sensor.bits
    noise_e2 = readout.noise_e2 + np.square(step_v / slope) * sensor.adc.noise_dn2
    return Inverse(charge_e, noise_e2, (charge_e >= sensor.well_e) | (codes >= 2.0**sensor.bits - 1.0))

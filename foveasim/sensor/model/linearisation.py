"""
First-order statistical model of a sensor: slopes and sources of noise along its chain.

One walk along the chain records the slope and the added noise of every step. All results about noise follow from these records:
predictions, the noise budget, signal-to-noise ratios, weights of estimates, covariances and information.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.names import possible_names
from foveasim._core.threads import cached_property
from foveasim._core.validation import Bools, Floats, Ints, as_numbers, check_per_site
from foveasim.errors import ParameterError, SimulationError
from foveasim.sensor.effects.contract import NOTHING, Sites
from foveasim.sensor.effects.crosstalk import CrosstalkOperator
from foveasim.sensor.model.prediction import Transfer
from foveasim.sensor.model.records import (
    NoiseKind,
    Record,
    highest_charge_e,
    is_temporal,
    light_records,
    map_light,
    propagate,
    row_factors,
    scale_columns,
    slope_of,
    split_charge,
    transfer_of,
    walk,
    walk_from_node,
)

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from foveasim.sensor.sensor import Sensor

__all__ = ["Linearisation"]

#: Noise is clipped within this number of standard deviations of the full well or the highest code. Its variance decreases from
#: there on, which is the saturation criterion of EMVA 1288.
CLIPPING_SIGMAS = 2.0
#: Relative residual of iterative solutions with the covariance, and maximum number of iterations.
RESIDUAL, MAX_ITERATIONS = 1e-11, 1000
#: Fraction of dark signal in the charge that counts as rounding.
ROUNDING = 1e-12
#: Names of the noise of the collection, of photoelectrons and of dark signal, and of the conversion to codes.
PHOTON_SHOT, DARK_SHOT, QUANTISATION = "photon_shot", "dark_shot", "quantisation"
#: Values to which derivatives refer: photoelectron rates, e-/s; expected and collected charge, and that at the sense node, e-.
Start: TypeAlias = Literal["light", "charge", "collected", "node"]


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
    collected_e : (..., n_site) float64, e-
        Mean collected charge, at most the full well.
    node_e : (..., n_site) float64, e-
        Mean charge at the sense node, at most :attr:`top_e`.

    Notes
    -----
    A source of noise is a standard deviation at its step of the chain, with or without groups of sites that share its draw. Its
    covariance is ``L Lᵀ``, with L the later slopes times the deviation. Covariances are applied, and never assembled for all
    sites.

    At sites above their range, signal and noise are those at the end of the range: the signal-to-noise ratio is the maximum one
    of EMVA 1288. The derivative is 0 at saturated sites. Clipping at code 0 is not included.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.grid(n_x=4, n_y=4, pitch_um=3.0)
    >>> sensor = fs.Sensor(
    ...     layout, read_noise_e=10.0, capacitance_f=1.6e-15, v_sat_v=1.0, bits=14
    ... )
    >>> model = sensor.linearise(np.full(16, 900.0))
    >>> (
    ...     list(model.sources),
    ...     round(float(np.sqrt(model.variance_e2()[0])), 1),
    ... )  # √(900 + 100), and quantisation
    (['shot', 'read', 'quantisation'], 31.6)
    """

    sensor: Sensor
    expected_e: Floats
    collected_e: Floats
    node_e: Floats
    _output_v: Floats
    _records: tuple[Record, ...]
    _starts: dict[str, int]
    _is_full: Bools | bool
    _arguments: tuple[Any, ...]

    def __reduce__(self) -> tuple[Any, ...]:
        return linearise, (self.sensor, *self._arguments)

    def __repr__(self) -> str:
        names = ", ".join(self.sources)
        return f"Linearisation({self.n_sites:,} sites, sources {names})"

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return self.sensor.layout.n_sites

    @property
    def exposure_s(self) -> float | None:
        """Exposure time, s; None if it is unknown."""
        return self._arguments[-1]

    @property
    def sources(self) -> dict[str, NoiseKind]:
        """Kinds of the sources of noise by name: ``"temporal"``, ``"reset"`` or ``"fixed"``."""
        return {record.name: record.kind for record in self._records if record.deviation is not None}

    # -- means and slopes ---------------------------------------------------------------------------------------------

    @cached_property
    def mean_dn(self) -> Floats:
        """Mean code: that of the mean voltage, minus 1/2 for quantisation, (..., n_site) or (1,)."""
        adc = self.sensor.adc
        fraction = np.clip(self._output_v / self.sensor.v_sat_v, 0.0, 1.0)
        return np.interp(fraction, adc.transition_levels, np.arange(adc.n_codes + 1.0)) - 0.5

    @cached_property
    def gain_dn_per_e(self) -> Floats:
        """Derivative of the code with respect to the charge at the sense node, DN/e-."""
        return slope_of(self._records[self._starts["node"] :])

    @property
    def slope_dn_per_v(self) -> Floats:
        """Derivative of the code with respect to the voltage at the ADC, DN/V."""
        return slope_of(self._records[-1:])

    @cached_property
    def linear_gain_dn_per_e(self) -> Floats:
        """Linear codes per electron without the response nonlinearity, DN/e-."""
        return self._transfer.linear_gain_dn_per_e(self.sensor.adc.n_codes)

    @cached_property
    def _transfer(self) -> Transfer:
        records, _ = walk_from_node(self.sensor, self._arguments[0], self.node_e)
        return transfer_of(self.sensor, records, self.node_e)

    @cached_property
    def top_e(self) -> Floats:
        """Lowest charge at the sense node with the highest code, e-; infinite if none."""
        return highest_charge_e(self.sensor, self._transfer)

    @property
    def saturation_e(self) -> Floats:
        """Charge at which a site saturates: full well, or lowest with the highest code, e-."""
        return np.minimum(self.top_e, self.sensor.well_e)

    @cached_property
    def is_saturated(self) -> Bools:
        """
        Whether the full well or the highest code clips the noise of each site.

        (..., n_site) bool: within two standard deviations.
        """
        is_saturated = self.node_e + CLIPPING_SIGMAS * np.sqrt(self.variance_e2()) >= self.top_e
        is_saturated = is_saturated | self._is_full
        return np.broadcast_to(is_saturated, np.broadcast_shapes(is_saturated.shape, (self.n_sites,)))

    def slopes(self, start: Start, end: Start) -> list[Floats | CrosstalkOperator]:
        """
        Return the slopes of the steps between two points of the chain, in their order.

        They are factors (..., n_site) or (1,), and operators that mix sites; slopes of 1 are omitted.
        """
        return [record.slope for record in self._main(start, self._starts[end]) if record.slope is not None]

    def forward(self, values: ArrayLike, start: Start = "charge") -> Floats:
        """
        Compute the change of the mean codes for small changes of the light or the charge.

        Parameters
        ----------
        values : (..., n_site)
            Changes of photoelectron rates, e-/s (``"light"``), of expected charges, e- (``"charge"``), of collected
            charges, e- (``"collected"``), or of charges at the sense node, e- (``"node"``).
        start : {"light", "charge", "collected", "node"}

        Returns
        -------
        change : (..., n_site) float64, DN
            0 at saturated sites.

        Raises
        ------
        ParameterError
            For ``"light"`` without the exposure.
        """
        changes = map_light(self._main(start), self._check("values", values))
        return np.where(self.is_saturated, 0.0, changes)

    def backward(self, values: ArrayLike, start: Start = "charge") -> Floats:
        """
        Compute the gradient of a function of the codes with respect to the light or the charge.

        This is the transpose of :meth:`forward`.

        Parameters
        ----------
        values : (..., n_site)
            Gradient with respect to the codes.
        start : {"light", "charge", "collected", "node"}

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
        """Compute :meth:`variance_dn2` referred to the charge at the sense node, e-²."""
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
        pairs = zip(self._factors(index), self._factors(other), strict=True)
        return np.asarray(sum((np.asarray(a.multiply(b).sum(axis=1)).ravel() for a, b in pairs), np.zeros(index.size)))

    def covariance_matrix_dn2(self, sites: ArrayLike) -> Floats:
        """
        Compute the temporal covariance of the codes of some sites, (n, n) DN².

        ``sites`` (n,) int: indices of the sites.
        """
        index = self._check_sites("sites", sites)
        factors = self._factors(index)
        return np.asarray(sum(((a @ a.T).toarray() for a in factors), np.zeros((index.size, index.size))))

    def apply_covariance(self, values: ArrayLike) -> Floats:
        """
        Apply the temporal covariance of the codes, DN².

        ``values`` (..., n_site): in any unit.
        """
        values = self._check("values", values)
        records = self._main("charge")
        back: list[Floats] = []
        for record in reversed(records):
            back.append(values)
            values = record.map_back(values)
        total: Floats = np.zeros(1)
        for record, at in zip(records, reversed(back), strict=True):
            total = record.map(np.broadcast_to(total, at.shape))
            if record.deviation is not None and is_temporal(record):
                total = total + record.correlate(at)
        return total

    @cached_property
    def is_correlated(self) -> bool:
        """Whether the temporal noise of different sites is correlated."""
        is_mixed = False
        for record in reversed(self._main("charge")):
            if record.deviation is not None and is_temporal(record) and (is_mixed or record.groups is not None):
                return True
            is_mixed |= record.operator is not None
        return False

    def solve_covariance(self, values: ArrayLike, sites: ArrayLike | None = None) -> Floats:
        """
        Apply the inverse of the temporal covariance of the codes, of all or some sites.

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
        elif any(record.operator is not None for record in self._main("charge")):
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
        start : {"light", "charge", "collected", "node"}
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
        start : {"light", "charge", "collected", "node"}
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
        """Solve systems (n, n_known) with the covariance of sites whose noise is not mixed."""
        from scipy.sparse import csr_array, eye_array, hstack
        from scipy.sparse.linalg import splu

        records = self._main("charge")
        variance = propagate(records, self.n_sites, lambda record: is_temporal(record) and record.groups is None)
        independent = np.broadcast_to(variance, self.n_sites)[known]
        shared = self._factors(known, lambda record: is_temporal(record) and record.groups is not None)
        factor = csr_array(hstack(list(shared)))
        inner = splu(
            (eye_array(factor.shape[1]) + scale_columns(csr_array(factor.T), 1.0 / independent) @ factor).tocsc()
        )
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
        solution, n_left = cg(matrix, row, rtol=RESIDUAL, maxiter=MAX_ITERATIONS, M=inverse)
        if n_left:
            raise SimulationError(
                f"the covariance of the codes is not inverted in {MAX_ITERATIONS} iterations; reduce the noise that sites "
                "share, or their mixing"
            )
        return np.asarray(solution)

    # -- parts --------------------------------------------------------------------------------------------------------

    def _chosen(self, sources: Collection[str] | None, is_reset: bool) -> Callable[[Record], bool]:
        """Return a function that chooses sources."""
        if sources is None:
            return partial(is_temporal, is_reset=is_reset)
        names = {sources} if isinstance(sources, str) else set(sources)
        unknown = sorted(names.difference(self.sources))
        if unknown:
            raise ParameterError(
                "sources", f"must be names from {', '.join(self.sources)}", unknown[0],
                hint=possible_names(unknown[0], list(self.sources)),
            )  # fmt: skip
        return lambda record: record.name in names and (is_reset or record.kind != "reset")

    def _main(self, start: Start, end: int | None = None) -> list[Record]:
        """Return the steps from light or charge to the codes, or to a position."""
        if start not in self._starts:
            raise ParameterError(
                "start",
                "must be 'charge', 'collected' or 'node', or 'light' with a known exposure",
                start,
                hint="pass exposure_s to Sensor.linearise",
            )
        return [record for record in self._records[self._starts[start] : end] if record.branch != "dark"]

    def _factors(self, index: Ints, is_used: Callable[[Record], bool] = is_temporal) -> Iterator[csr_array[Any]]:
        """Yield rows of factors F of the covariance F Fᵀ of some sites."""
        self._check_single()
        return row_factors(self._main("charge"), self.n_sites, index, is_used)

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
    sites: Sites,
    expected_e: Floats | None,
    photo_e_per_s: Floats | None,
    exposure_s: float | None,
) -> Linearisation:
    """Walk along the chain: see :meth:`foveasim.Sensor.linearise`."""
    arguments = (sites, expected_e, photo_e_per_s, exposure_s)
    records: list[Record] = []
    starts: dict[str, int] = {}
    photo_fraction: Floats | None = None
    if exposure_s is not None:
        rates = NOTHING if photo_e_per_s is None else photo_e_per_s
        records = light_records(sensor, sites, rates, exposure_s)
        starts["light"] = 0
        if photo_e_per_s is not None:
            mean_e, photo_e = records[-1].mean, map_light(records, photo_e_per_s)
            photo_fraction = np.divide(photo_e, mean_e, out=np.zeros(np.shape(mean_e)), where=np.asarray(mean_e) > 0.0)
            # Rounding is not a dark signal.
            photo_fraction = np.where(photo_fraction > 1.0 - ROUNDING, 1.0, np.maximum(photo_fraction, 0.0))
            expected_e = mean_e if expected_e is None else expected_e
    assert expected_e is not None
    starts["charge"] = len(records)
    collected_e, slope, deviation, groups = sensor.collection.validate_linear(expected_e, sites)
    is_full: Bools | bool = False
    if sensor.full_well_e is not None:
        own = 0.0 if deviation is None or not sensor.collection.is_drawn else deviation
        is_full = collected_e + CLIPPING_SIGMAS * own >= sensor.well_e
        if np.any(is_full):
            deviation = _limited(deviation, collected_e, sensor.well_e, sensor.collection.is_drawn)
            collected_e = np.minimum(collected_e, sensor.well_e)
    if photo_fraction is None or deviation is None or not sensor.collection.is_drawn:
        records.append(Record(sensor.collection.name, collected_e, slope, deviation, groups))
    else:
        records += [
            Record(PHOTON_SHOT, collected_e, slope, deviation * np.sqrt(photo_fraction), groups),
            Record(DARK_SHOT, collected_e, None, deviation * np.sqrt(1.0 - photo_fraction), groups),
        ]
    starts["collected"] = len(records)
    node_e = walk(split_charge(sensor)[0], records, collected_e, sites)
    starts["node"], records = len(records), _without_means(records)
    after, output_v = walk_from_node(sensor, sites, node_e)
    adc = sensor.adc
    if np.any(output_v >= adc.transition_levels[-2] * sensor.v_sat_v):
        # Sites above their range have the values of the end of the range.
        highest_e = highest_charge_e(sensor, transfer_of(sensor, after, node_e))
        for k in range(starts["charge"], starts["collected"]):
            limited = _limited(records[k].deviation, node_e, highest_e, sensor.collection.is_drawn)
            records[k] = records[k]._replace(deviation=limited)
        node_e = np.minimum(node_e, highest_e)
        after, output_v = walk_from_node(sensor, sites, node_e)
    step_v = np.full(1, sensor.v_sat_v / 2.0**sensor.bits)
    if not adc.is_linear:
        step_v = adc.width_at_dn(np.clip(output_v / sensor.v_sat_v, 0.0, 1.0)) * step_v
    with np.errstate(divide="ignore"):
        conversion = Record(QUANTISATION, NOTHING, 1.0 / step_v, np.full(1, math.sqrt(adc.noise_dn2)))
    steps = (*records, *_without_means(after), conversion)
    return Linearisation(sensor, expected_e, collected_e, node_e, output_v, steps, starts, is_full, arguments)


def _without_means(records: list[Record]) -> list[Record]:
    """Return records without their means, which for many sites are most of the memory."""
    return [record._replace(mean=NOTHING) for record in records]


def _limited(deviation: Floats | None, charge_e: Floats, limit_e: Floats, is_drawn: bool) -> Floats | None:
    """Return the deviation of charges at a limit; the variance is proportional to them."""
    if deviation is None or not is_drawn:
        return deviation
    part = np.divide(limit_e, charge_e, out=np.ones(np.shape(charge_e)), where=charge_e > limit_e)
    return np.asarray(deviation * np.sqrt(part))

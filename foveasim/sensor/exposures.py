"""
Multiple reads of the same sites: HDR merge of several exposures, and up-the-ramp reads.

Both estimate electrons per second with inverse-variance weights. The shot noise in the weights is computed from an estimate
common to all reads; weights from individual reads would favour those that are low by chance and bias the result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.random_streams import Streams
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, Ints, as_numbers, check_per_site, own_arrays
from foveasim.errors import ParameterError, SimulationError
from foveasim.sensor.calibration import Calibration, linearise, nominal_e_per_dn
from foveasim.sensor.effects import Sites
from foveasim.sensor.effects.contract import NOTHING
from foveasim.sensor.effects.shot import MAX_CHARGE_E, ROUNDING_E2
from foveasim.sensor.limits import DURATION, EXPOSURE, RATE
from foveasim.sensor.model.prediction import MIN_SLOPE
from foveasim.sensor.sensor import Sensor

__all__ = ["Ramp", "Rates", "fit_ramp", "merge_exposures", "non_destructive_reads"]

#: A read counts as saturated within this number of read-noise standard deviations of the full well.
MARGIN_SIGMAS = 5.0
#: Final fraction of the range over which weights taper to 0: wide compared with shot noise for charges above 400 e-.
TAPER_FRACTION = 0.25
#: Number of iterations of the weights from the merged estimate.
N_PASSES = 2
#: Number of iterations that estimate charges before inter-pixel capacitance.
N_UNMIXING_STEPS = 8
#: Relative decrease of an expected charge that counts as rounding.
DECREASE_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Rates:
    """
    Estimated charge rates, in electrons per second.

    Attributes
    ----------
    rate_e_per_s : (n_site,) float64, e-/s
        NaN for sites without usable reads.
    sigma_e_per_s : (n_site,) float64, e-/s
        Predicted standard deviation: the inverse square root of the sum of inverse variances.
    n_used : (n_site,) int64
        Number of reads used.

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(n_x=1, n_y=1, pitch_um=2.0),
    ...     bits=10,
    ...     v_sat_v=1.0,
    ...     capacitance_f=1.6406288e-16,
    ... )
    >>> rates = fs.sensor.merge_exposures([[500], [1023]], [0.1, 10.0], sensor)
    >>> rates.rate_e_per_s.round().tolist(), rates.n_used.tolist()
    ([5005.0], [1])
    """

    rate_e_per_s: Floats
    sigma_e_per_s: Floats
    n_used: Ints

    __repr__ = short_repr

    def __post_init__(self) -> None:
        own_arrays(self)


@dataclass(frozen=True, eq=False)
class Ramp:
    """
    Up-the-ramp reads of one exposure.

    Attributes
    ----------
    times_s : (n_read,) float64, s
        Times of the reads since the reset.
    electrons : (n_read, n_site) int64, e-
        Charge collected up to each read, without reset noise and read noise.
    code : (n_read, n_site) uint8 or uint16, DN
    """

    times_s: Floats
    electrons: Ints
    code: NDArray[Any]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        own_arrays(self)


# -- HDR merge --------------------------------------------------------------------------------------------------------


def merge_exposures(
    code: ArrayLike, exposures_s: ArrayLike, sensor: Sensor, *, calibration: Calibration | None = None
) -> Rates:
    """
    Merge several exposures of the same scene into charge rates (HDR merge).

    Parameters
    ----------
    code : (n_exposure, n_site), DN
        Codes of the sensor, one row per exposure; not modified.
    exposures_s : (n_exposure,), s
        Exposure times, in any order.
    sensor : Sensor
        Its ADC, capacitances, full well and noise are used.
    calibration : Calibration, optional
        Calibration for the correction of offsets, dark signal and gain differences. Without one, a linear code y corresponds
        to a charge of ``y + 1/2`` codes, the dark signal is part of the rate, and offsets of the sensor are errors.

    Raises
    ------
    SimulationError
        If the calibration does not contain the dark signal of an exposure time.

    Notes
    -----
    The charge ``N_j`` of the exposure ``t_j`` has the variance

    ::

        v_j = r t_j + dark signal + read² + reset² + rts² / 4 + step² (1/12 + dnl²)

    with ``rts`` on the device's RTS sites and ``step`` the width of the code. The rate is

    ::

        r = sum_j w_j N_j / t_j / sum_j w_j,    w_j = a_j t_j² / v_j

    with the shot noise of the common r: initially ``sum a N / sum a t``, followed by two iterations with the result. Below
    saturation ``a = 1``: the weights are inverse variances, and the variance of the result is the inverse of their sum. This
    is the maximum-likelihood estimate for Gaussian noise (Granados et al., Optimal HDR reconstruction with linear digital
    cameras, CVPR 2010).

    The highest code and codes within five standard deviations of the full well are never used. This criterion alone would
    select exposures near saturation only if they are low by chance. The weight ``a`` therefore tapers from 1 to 0 over the
    last quarter of the range, and the remaining selection bias is subtracted: a weight a(x) that depends on the Gaussian
    variable x itself shifts the mean by ``variance * E[a'(x)]`` (C. Stein, Annals of Statistics 9, 1135, 1981). In the taper,
    the predicted variance follows from the derivatives of the result with respect to all exposures; within two standard
    deviations of saturation it is too large by up to a third.

    Noise is clipped at code 0: without a pedestal above the read noise, the rates of dark sites are too high.

    Examples
    --------
    A site with 5000 e-/s in two exposures, of which the second is saturated at 1000 e-:

    >>> import foveasim as fs
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(n_x=1, n_y=1, pitch_um=2.0),
    ...     bits=10,
    ...     v_sat_v=1.0,
    ...     capacitance_f=1.6406288e-16,
    ... )
    >>> merge_exposures([[499.5], [1023]], [0.1, 10.0], sensor).rate_e_per_s.round(
    ...     1
    ... ).tolist()
    [5000.0]

    Adjacent large and small sites (sub-pixel HDR) are two classes of sites, here with sensitivities 1 and 0.1:

    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0),
    ...     bits=10,
    ...     v_sat_v=1.0,
    ...     capacitance_f=1.6406288e-16,
    ... )
    >>> rates, sensitivity = (
    ...     merge_exposures([[1023, 499.5]], [0.1], sensor),
    ...     np.array([1.0, 0.1]),
    ... )
    >>> weight = (sensitivity / rates.sigma_e_per_s) ** 2
    >>> round(
    ...     float(np.nansum(weight * rates.rate_e_per_s / sensitivity) / np.nansum(weight)),
    ...     1,
    ... )
    50000.0
    """
    times_s = DURATION.check_array("exposures_s", exposures_s, ndim=1)
    codes, linear_dn, e_per_dn, conversion_e2 = _linearise_reads(code, times_s.size, sensor, "exposure")
    n_sites = sensor.layout.n_sites
    dark_e = np.zeros((times_s.size, 1))
    gain = np.ones(1)
    offset_dn = np.full((times_s.size, 1), -0.5)
    if calibration is not None:
        if not isinstance(calibration, Calibration) or calibration.n_sites != n_sites:
            raise ParameterError("calibration", f"must be a Calibration of the sensor's {n_sites} sites", calibration)
        single = calibration.exposure_s is None
        offset_dn = np.stack([calibration.offset_at(None if single else float(t_s)) for t_s in times_s])
        gain = np.where(calibration.gain > 0.0, calibration.gain, np.nan)
        dark_e = np.stack([sensor.expected_electrons(np.zeros(n_sites), float(t_s)) for t_s in times_s])

    counting = _Counting(sensor, times_s)
    charge_e = (linear_dn - offset_dn) / gain * e_per_dn
    top_dn = _saturation_dn(sensor)
    top_e = (top_dn - offset_dn) / gain * e_per_dn
    # Expected charges, of which the mean charges of collections that are not linear are functions.
    charge_e, top_e = (counting.invert(part, dark_e) for part in (charge_e, top_e))
    is_used = (codes < 2.0**sensor.bits - 1.0) & (linear_dn < top_dn) & np.isfinite(charge_e) & (top_e > 0.0)
    top_e = np.where(np.isfinite(top_e), top_e, np.max(charge_e, initial=1.0, where=is_used))
    t_s = times_s[:, None]
    rates = np.where(is_used, charge_e, 0.0) / t_s
    width = TAPER_FRACTION * np.where(is_used, top_e, 1.0) / t_s
    taper = np.where(is_used, np.clip((np.where(is_used, top_e, 0.0) / t_s - rates) / width, 0.0, 1.0), 0.0)
    falling = np.where((taper > 0.0) & (taper < 1.0), -1.0 / width, 0.0)
    is_known = taper.any(axis=0)
    total = np.where(is_known, (taper * t_s).sum(axis=0), 1.0)
    rate = (taper * rates * t_s).sum(axis=0) / total
    fraction = taper
    for _ in range(N_PASSES):
        mean_e, variance_e2, per_e = counting.moments(np.maximum(rate, 0.0) * t_s + dark_e)
        model = sensor.readout_model(mean_e, variance_e2)
        information = (t_s * per_e) ** 2 / (model.variance_e2 + model.noise_e2 + conversion_e2)
        total = np.where(is_known, (taper * information).sum(axis=0), 1.0)
        fraction = taper * information / total
        rate = (fraction * rates).sum(axis=0)
    slope = fraction + falling * information / total * (rates - rate)
    rate = rate - (falling * (1.0 - fraction)).sum(axis=0) / total
    variance = (slope**2 / information).sum(axis=0)
    return Rates(
        rate_e_per_s=np.where(is_known, rate, np.nan),
        sigma_e_per_s=np.where(is_known, np.sqrt(variance), np.nan),
        n_used=np.count_nonzero(taper, axis=0).astype(np.int64),
    )


# -- up-the-ramp reads ------------------------------------------------------------------------------------------------


def non_destructive_reads(
    sensor: Sensor,
    photo_e_per_s: ArrayLike,
    times_s: ArrayLike,
    *,
    seed: int,
    frame: int = 0,
    n_threads: int | None = None,
) -> Ramp:
    """
    Simulate non-destructive reads during one exposure.

    Parameters
    ----------
    sensor : Sensor
    photo_e_per_s : number or (n_site,), e-/s
        Photoelectron rate, as from :meth:`foveasim.Camera.photoelectrons_per_s`.
    times_s : (n_read,), s
        Times of the reads since the reset, strictly increasing.
    seed, frame : int
        Seed and frame number of the draws. Equal ones give bit-identical ramps.
    n_threads : int, optional
        Number of threads; all cores by default. Draws do not depend on it.

    Raises
    ------
    SimulationError
        If an effect lets the expected charge decrease with time, or charges of consecutive intervals are not independent
        (:attr:`~foveasim.sensor.effects.Collection.has_independent_increments`).

    Notes
    -----
    The expected charge of a read is that of an exposure until the read, with all effects on it. The charge collected between
    two reads is drawn independently with the increase of the expected charge, added, and clipped at the full well. Later
    charges include earlier ones, ``cov(N_i, N_j) = E[N_i]`` for ``i <= j``, and increments are uncorrelated.

    Each read passes through the complete chain, as in a capture. Read noise is drawn for each read. Effects that are drawn at
    the reset, such as reset noise, act at their place in the chain with the same random numbers in all reads. The state of RTS
    sites is drawn for each read, which assumes fast switching.

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0), shot_noise="off", full_well_e=500.0
    ... )
    >>> non_destructive_reads(
    ...     sensor, [100.0, 300.0], [1.0, 2.0, 3.0], seed=0
    ... ).electrons.tolist()
    [[100, 300], [200, 500], [300, 500]]
    """
    times, streams, collection = _check_increasing("times_s", times_s), Streams(seed, frame), sensor.collection
    if collection.is_drawn and not collection.has_independent_increments:
        raise SimulationError(
            f"non-destructive reads require a collection with independent increments, but those of '{collection.name}' depend "
            "on the charge"
        )
    n_sites = sensor.layout.n_sites
    photo = RATE.check_array("photo_e_per_s", photo_e_per_s)
    photo = np.broadcast_to(check_per_site("photo_e_per_s", photo, n_sites, or_one=True), n_sites)
    well_e = np.minimum(sensor.well_e, MAX_CHARGE_E).astype(np.int64)
    electrons, codes = np.empty((times.size, n_sites), np.int64), []
    expected_e, collected = np.zeros(n_sites), np.zeros(n_sites, np.int64)
    for k, (time_s, interval_s) in enumerate(zip(times.tolist(), np.diff(times, prepend=0.0).tolist(), strict=True)):
        own = Streams(int(streams.of("read of a ramp", k).integers(2**63)), streams.frame)
        before_e, expected_e = expected_e, sensor.expected_electrons(photo, time_s, n_threads=n_threads)
        draw = partial(sensor.collect, n_threads=n_threads, _streams=own)
        if collection.is_drawn:
            added_e = _increase(before_e, expected_e, time_s)
            collected = np.minimum(collected + draw(added_e, exposure_s=interval_s), well_e)
        else:
            collected = draw(expected_e, exposure_s=time_s)
        electrons[k] = collected
        codes.append(sensor.read(collected, n_threads=n_threads, _streams=own, _reset_streams=streams))
    return Ramp(times_s=times, electrons=electrons, code=np.stack(codes))


def _increase(before_e: Floats, expected_e: Floats, time_s: float) -> Floats:
    """Return the increase of expected charges since the previous read, at least 0."""
    added_e = expected_e - before_e
    is_less = added_e < -DECREASE_ROUNDING * np.abs(before_e)
    if is_less.any():
        site = int(np.argmax(is_less))
        raise SimulationError(
            f"the expected charge of site {site} decreases from {before_e[site]:.6g} to {expected_e[site]:.6g} e- until the "
            f"read at {time_s:g} s; effects at the stage 'expected' must not decrease with time"
        )
    return np.maximum(added_e, 0.0)


def fit_ramp(
    code: ArrayLike, times_s: ArrayLike, sensor: Sensor, *, weight_rate_e_per_s: ArrayLike | None = None
) -> Rates:
    """
    Fit the slopes of up-the-ramp reads, in electrons per second.

    Parameters
    ----------
    code : (n_read, n_site), DN
        Codes of the sensor; not modified.
    times_s : (n_read,), s
        Times of the reads, strictly increasing.
    sensor : Sensor
        Its ADC, capacitances, full well, read noise and RTS sites are used.
    weight_rate_e_per_s : number or (n_site,), optional, e-/s
        Rate of the collected charge for the shot noise in the weights; by default each site's rate from its first and last
        usable reads, with an approximate correction of inter-pixel capacitance.

    Returns
    -------
    Rates
        The dark signal is part of the rate. NaN for fewer than two usable reads.

    Notes
    -----
    Differences of consecutive reads contain neither offset nor reset noise. Their covariance matrix is tridiagonal with
    ``r dt_k + 2 s²`` on the diagonal and ``-s²`` next to it, where s combines read, RTS and conversion noise. Effects that mix
    the charges of sites after collection, such as inter-pixel capacitance, change the shot noise ``r dt_k`` to
    ``sum_j K_ij² r_j dt_k``, with the fraction K_ij of the charge of site j at site i. The slope is the generalised
    least-squares solution, computed in time proportional to the number of reads (T. D. Brandt, PASP 136, 045004, 2024;
    arXiv:2309.08753).

    For a given ``weight_rate_e_per_s`` the slope is a fixed linear combination of the reads, and therefore unbiased; for
    weights from the site's own rate the bias is a fraction of an electron per ramp.

    Reads are used up to the first saturated one (highest code, or within five standard deviations of the full well).

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0)
    >>> sensor = fs.Sensor(
    ...     layout, capacitance_f=1.6e-15, v_sat_v=1.0, bits=14, shot_noise="off"
    ... )
    >>> times_s = [1.0, 2.0, 3.0, 4.0]
    >>> ramp = fs.sensor.non_destructive_reads(sensor, [100.0, 1000.0], times_s, seed=0)
    >>> fs.sensor.fit_ramp(ramp.code, times_s, sensor).rate_e_per_s.round().tolist()
    [100.0, 1000.0]
    """
    times = _check_increasing("times_s", times_s)
    if times.size < 2:
        raise ParameterError("times_s", "must have at least two values", times_s, "s")
    codes, linear_dn, e_per_dn, conversion_e2 = _linearise_reads(code, times.size, sensor, "read")
    n_sites = sensor.layout.n_sites
    charge_e = linear_dn * e_per_dn
    model = sensor.readout_model(charge_e, is_reset=False)
    noise_e2 = conversion_e2 + model.noise_e2 + model.variance_e2
    if not sensor.collection.is_drawn:
        noise_e2 += ROUNDING_E2
    is_below = (codes < 2.0**sensor.bits - 1.0) & (linear_dn < _saturation_dn(sensor))
    is_used = np.logical_and.accumulate(is_below, axis=0)
    n_used = np.count_nonzero(is_used, axis=0).astype(np.int64)
    last = np.maximum(n_used - 1, 0)
    duration_s = times[last] - times[0]
    if weight_rate_e_per_s is None:
        rise_e = charge_e[last, np.arange(n_sites)] - charge_e[0]
        rate = np.divide(rise_e, duration_s, out=np.zeros(n_sites), where=duration_s > 0.0)
        longest_s = times[-1] - times[0]
        rate = _estimate_collected(sensor, np.maximum(rate, 0.0) * longest_s) / longest_s
    else:
        rate = replace(RATE, at_least=None, low=-RATE.high).check_array("weight_rate_e_per_s", weight_rate_e_per_s)
        check_per_site("weight_rate_e_per_s", rate, n_sites, or_one=True)
    if not sensor.collection.is_drawn:
        rate = np.zeros(1)
    dt_s = np.where(is_used[1:], np.diff(times)[:, None], 0.0)
    rise_e = np.where(is_used[1:], np.diff(charge_e, axis=0), 0.0)
    charges_e = np.broadcast_to(np.maximum(rate, 0.0) * np.diff(times)[:, None], dt_s.shape)
    shot_e2 = charges_e
    if sensor.collection.is_drawn:
        shot_e2 = sensor.collection.moments(charges_e, NOTHING, sites=sensor.sites)[1]
    if model.is_mixed:
        with_shot = sensor.readout_model(charge_e[1:], shot_e2, is_reset=False)
        shot_e2 = with_shot.variance_e2 - np.broadcast_to(model.variance_e2, charge_e.shape)[1:]
    diagonal = np.where(is_used[1:], shot_e2 + noise_e2[:-1] + noise_e2[1:], 1.0)
    off_diagonal = np.where(is_used[2:], -noise_e2[1:-1], 0.0)
    weights = _solve_tridiagonal(diagonal, off_diagonal, dt_s)
    information = (weights * dt_s).sum(axis=0)
    is_known = n_used >= 2
    information = np.where(is_known, information, 1.0)
    return Rates(
        rate_e_per_s=np.where(is_known, (weights * rise_e).sum(axis=0) / information, np.nan),
        sigma_e_per_s=np.where(is_known, 1.0 / np.sqrt(information), np.nan),
        n_used=n_used,
    )


# -- helpers ----------------------------------------------------------------------------------------------------------


class _Counting:
    """Collection of a sensor for several exposures: arrays (n_exposure, n_site)."""

    def __init__(self, sensor: Sensor, times_s: Floats) -> None:
        self.sensor, self.sites = sensor, [sensor.sites.during(time_s) for time_s in times_s.tolist()]
        self.is_linear = sensor.collection.validate_linear(np.zeros(1), self.sites[0]).slope is None

    def _each(self, function: Callable[[Floats, Sites], tuple[Floats, ...]], values: Floats) -> tuple[Floats, ...]:
        """Return the results of a function of the charges and sites of each exposure."""
        results = [function(row, sites) for row, sites in zip(values, self.sites, strict=True)]
        return tuple(
            np.stack([np.broadcast_to(part, values.shape[1]) for part in parts]) for parts in zip(*results, strict=True)
        )

    def invert(self, charge_e: Floats, dark_e: Floats) -> Floats:
        """Return the expected charges of light for charges without those of the dark signal."""
        if self.is_linear:
            return charge_e
        collection = self.sensor.collection
        dark_e = np.broadcast_to(dark_e, charge_e.shape)
        (dark_mean_e,) = self._each(lambda row, sites: collection.validate_moments(row, NOTHING, sites)[:1], dark_e)
        total_e = np.maximum(np.nan_to_num(charge_e + dark_mean_e, nan=0.0), 0.0)
        (expected_e,) = self._each(lambda row, sites: (collection.invert(row, sites=sites),), total_e)
        return np.where(np.isfinite(charge_e), expected_e - dark_e, np.nan)

    def moments(self, charge_e: Floats) -> tuple[Floats, Floats, Floats]:
        """Return mean, variance and slope of the collection for charges at the sense node."""
        collection = self.sensor.collection
        if self.is_linear:
            collected_e = _estimate_collected(self.sensor, charge_e)
            return *collection.moments(collected_e, NOTHING, sites=self.sensor.sites), np.ones(1)

        def moments(row: Floats, sites: Sites) -> tuple[Floats, ...]:
            slope = collection.validate_linear(row, sites).slope
            assert isinstance(slope, np.ndarray)
            return (*collection.validate_moments(row, NOTHING, sites), slope)

        mean_e, variance_e2, slope = self._each(moments, charge_e)
        return mean_e, variance_e2, np.maximum(slope, MIN_SLOPE)


def _check_increasing(name: str, times_s: ArrayLike) -> Floats:
    times = EXPOSURE.check_array(name, times_s, ndim=1)
    if times.size == 0 or np.any(np.diff(times) <= 0.0):
        raise ParameterError(name, "must be one or more strictly increasing times", times_s, "s")
    return times


def _linearise_reads(
    code: ArrayLike, n_reads: int, sensor: Sensor, kind: str
) -> tuple[NDArray[Any], Floats, Floats, Floats]:
    """
    Return codes, linear codes, electrons per linear code, and the variance of conversion.

    ``code`` (n_reading, n_site), DN. The variance, in e-², is that of the width of each code.
    """
    linear_dn = linearise(code, sensor)
    codes = as_numbers("code", code)
    if codes.shape != (n_reads, sensor.layout.n_sites):
        raise ParameterError(
            "code",
            f"must have one row per {kind} and one column per site, {(n_reads, sensor.layout.n_sites)}, "
            f"got the shape {codes.shape}",
        )
    e_per_dn = nominal_e_per_dn(sensor)
    step_e = sensor.adc.width_of_code_dn(codes) * e_per_dn
    return codes, linear_dn, e_per_dn, step_e**2 * sensor.adc.noise_dn2


def _estimate_collected(sensor: Sensor, charge_e: Floats) -> Floats:
    """
    Estimate collected charges from those after effects that mix sites.

    For inter-pixel capacitance with the fractions K, the iteration ``q <- q + (charge - K q)`` (P. H. van Cittert, Zeitschrift
    für Physik 69, 298, 1931) is ended early, since its limit amplifies noise. Without mixing, charges are returned unchanged.
    """
    if not any(effect.reach == "all" and effect.stage == "charge" for effect in sensor.chain):
        return charge_e
    at_zero = sensor.readout_model(np.zeros(sensor.layout.n_sites))
    collected_e = charge_e
    for _ in range(N_UNMIXING_STEPS):
        mixed_e = sensor.readout_model(collected_e).mean_e - at_zero.mean_e
        collected_e = np.maximum(collected_e + charge_e - mixed_e, 0.0)
    return collected_e


def _saturation_dn(sensor: Sensor) -> Floats:
    """
    Return the linear code above which a site counts as saturated, (n_site,) DN.

    It is the highest code, or the code of the full well minus a margin for readout noise.
    """
    n_sites = sensor.layout.n_sites
    top_dn = np.full(n_sites, float(linearise(2**sensor.bits - 1, sensor)))
    if sensor.full_well_e is None:
        return top_dn
    without_noise = sensor.without(
        *(e.name for e in sensor.chain if e.is_temporal or (e.stage == "charge" and e.reach == "all"))
    )
    well_e = np.broadcast_to(np.minimum(sensor.well_e, MAX_CHARGE_E), n_sites).astype(np.int64)
    well_dn = linearise(without_noise.read(well_e), sensor)
    noise_dn = np.sqrt(sensor.readout_model(sensor.well_e).noise_e2) / nominal_e_per_dn(sensor)
    return np.minimum(top_dn, well_dn - MARGIN_SIGMAS * noise_dn - 1.0)


def _solve_tridiagonal(diagonal: Floats, off_diagonal: Floats, right: Floats) -> Floats:
    """Solve symmetric tridiagonal systems, one per column, by the Thomas algorithm."""
    n = diagonal.shape[0]
    pivot, solved = diagonal.copy(), right.copy()
    for k in range(1, n):
        factor = off_diagonal[k - 1] / pivot[k - 1]
        pivot[k] -= factor * off_diagonal[k - 1]
        solved[k] -= factor * solved[k - 1]
    solved[-1] /= pivot[-1]
    for k in range(n - 2, -1, -1):
        solved[k] = (solved[k] - off_diagonal[k] * solved[k + 1]) / pivot[k]
    return solved

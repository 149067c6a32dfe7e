"""
Fit of the chain to means and variances of levels, by maximum likelihood.

Means and variances over many pixels and frames are Gaussian, and independent of each other for Gaussian noise: the likelihood
is that of weighted squares, with the moments of the chain (:meth:`foveasim.Sensor.predict`), and weights by the variances that
it predicts. Weights follow the parameters (iteratively reweighted), so that the equations of the estimate are unbiased.

Uncertainties come from the differences between blocks of rows, through the linear map from the statistics to the estimate (the
"sandwich"): they include what differs between pixels, and correlations, of any distribution.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from foveasim._core.validation import Bools, Floats
from foveasim.sensor.adc import QUANTISATION_DN2
from foveasim.twin.fitting.chain import Chain, Moments
from foveasim.twin.fitting.levels import Levels

__all__ = ["Exposures", "PooledFit", "fit_levels"]

#: Relative step of numerical derivatives, largest change of a logarithm in one iteration, and largest number of iterations.
STEP, MAX_CHANGE, MAX_ITERATIONS = 1e-4, 0.7, 60
#: Decrease of the sum of squares that is expected of the next iteration, and relative one of the last, which end the search:
#: the estimate is within a twentieth of a standard error, in every combination of parameters.
TOLERANCE, RELATIVE_TOLERANCE = 2.5e-3, 1e-6
#: Smallest eigenvalue of the correlations of derivatives that is no rounding.
RANK = 1e-12
#: Parameters whose logarithms are fitted.
POSITIVE = ("gain_dn_per_e", "full_well_e", "qe", "light_e_per_s", "dark_doubling_k", "level_e")
WELL, BEND = "full_well_e", "nonlinearity_fraction"
#: Powers of the gain that turn parameters into codes.
EXPONENTS = {WELL: 1, "qe": 1, "light_e_per_s": 1, "dark_e_per_s": 1, "read_noise_e2": 2}
#: Damping of the first iteration, and its largest value.
DAMPING, MAX_DAMPING = 1e-3, 1e8
#: Smallest variance for weights, DN².
SMALLEST_DN2 = 1e-4
#: Noise of means in weights, as a fraction of codes: the chain's rounding.
MEAN_FLOOR_DN = 1e-3
#: Variance below which noise is between two codes, and errors of means, and of variances as a fraction, there.
ROUGH_DN2, ROUGH_MEAN_DN, ROUGH_FRACTION = 0.3, 0.02, 0.2
#: Error of the effect of the few pixels of a level that are full, or not full, as a fraction of it.
TAIL_FRACTION = 0.5


@dataclass(frozen=True, eq=False)
class Exposures:
    """
    Exposure times, light and temperatures of levels.

    ``exposure_s`` (n_level,). ``light`` (n_level,): photons, or relative light times seconds; 0 in the dark, NaN if unknown.
    ``light_parameter`` (n_level,): name of the parameter that it multiplies. ``temperature_k`` (n_level,), or NaN.
    """

    exposure_s: Floats
    light: Floats
    light_parameter: tuple[str, ...]
    temperature_k: Floats

    @property
    def is_dark(self) -> Bools:
        """Levels without light."""
        return np.asarray(self.light == 0.0)

    @property
    def is_free(self) -> Bools:
        """Levels of unknown light."""
        return np.isnan(self.light)

    def light_e(self, values: Mapping[str, float]) -> Floats:
        """Return the charges of light for parameters, (n_level,) e-; NaN for unknown light."""
        pairs = zip(self.light, self.light_parameter, strict=True)
        return self.light * np.array([values[name] if amount > 0.0 else 0.0 for amount, name in pairs])

    def dark_e(self, values: Mapping[str, float]) -> Floats:
        """Return the charges of dark current for parameters, (n_level,) e-."""
        charge_e = values.get("dark_e_per_s", 0.0) * self.exposure_s
        if "dark_doubling_k" not in values:
            return np.asarray(charge_e)
        above_k = self.temperature_k - np.nanmin(self.temperature_k)
        return np.asarray(charge_e * 2.0 ** (above_k / values["dark_doubling_k"]))


@dataclass(frozen=True, eq=False)
class PooledFit:
    """
    Parameters of the chain, with the linear map from statistics to them.

    ``names`` and ``values``: parameters, then charges of levels of unknown light. ``means_dn``, ``variances_dn2``,
    ``slopes_dn_per_e``, ``light_e`` (n_level,): of the chain. ``covariance``: over devices of the kind. ``own_covariance``: of
    this device, by temporal noise alone; both of the fitted variables, logarithms for positive ones.
    """

    names: tuple[str, ...]
    values: Mapping[str, float]
    means_dn: Floats
    variances_dn2: Floats
    slopes_dn_per_e: Floats
    light_e: Floats
    covariance: Floats
    own_covariance: Floats
    residuals: Floats = field(default_factory=lambda: np.zeros(0))

    def error(self, name: str, *, of_device: bool = False) -> float:
        """Return the standard error of a parameter; of a logarithm for positive ones."""
        matrix = self.own_covariance if of_device else self.covariance
        k = self.names.index(name)
        return math.sqrt(max(float(matrix[k, k]), 0.0))


def fit_levels(
    chain: Chain,
    levels: Levels,
    exposures: Exposures,
    start: Mapping[str, float],
    start_e: Floats,
    *,
    variance_error_dn2: Floats,
    common_error_dn2: float = 0.0,
) -> PooledFit:
    """
    Return the parameters that explain the levels best.

    ``start``: first values of all parameters that are fitted. ``start_e`` (n_level,): first charges of levels of unknown light.
    ``variance_error_dn2`` (n_level,): standard error of the variance of a level where it does not follow from the blocks, or
    NaN. ``common_error_dn2``: of all variances together.
    """
    model = _Model(chain, levels, exposures, tuple(start), start_e)
    vector = model.pack(start)
    model.add_common_errors(vector, common_error_dn2)
    damping, n = DAMPING, len(model.names)
    moments = model.moments(vector)
    whiten = model.whitening(vector, moments)
    residual = whiten(model.residual(moments))
    for _ in range(MAX_ITERATIONS):
        jacobian = whiten(model.jacobian(vector, moments.statistics))
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ residual
        before = float(residual @ residual)
        if gradient @ _inverse(normal) @ gradient < TOLERANCE * max(1.0, before / residual.size):
            break
        diagonal = np.diag(normal).copy()
        diagonal[diagonal <= 0.0] = 1.0
        # Logarithms of what the statistics do not determine, such as charges of full levels, move little.
        diagonal[model.is_log] = np.maximum(diagonal[model.is_log], 1.0)
        after = math.inf
        while damping < MAX_DAMPING:
            change = np.linalg.solve(normal + damping * np.diag(diagonal), gradient)
            # A charge changes its own level only: that of a full one, which changes nothing, does not shorten other steps.
            change[n:] = change[n:].clip(-MAX_CHANGE, MAX_CHANGE)
            change[:n] *= min(
                1.0, MAX_CHANGE / max(float(np.abs(change[:n][model.is_log[:n]]).max(initial=0.0)), 1e-300)
            )
            proposed = model.moments(vector + change)
            new = model.residual(proposed)
            after = float((whiten(new) ** 2).sum()) if np.isfinite(new).all() else math.inf
            if after < before:
                break
            damping = max(damping, 1e-6) * 10.0
        if after >= before:
            break
        vector, damping, moments = vector + change, damping / 10.0, proposed
        whiten = model.whitening(vector, moments)
        residual = whiten(model.residual(moments))
        if before - after < RELATIVE_TOLERANCE * after:
            break
    return model.result(vector, variance_error_dn2)


def _inverse(matrix: Floats) -> Floats:
    """
    Return the inverse of a normal matrix where it has one.

    Directions that the statistics do not determine are left out. Units of parameters must not decide which these are: the
    diagonal is 1.
    """
    scale = np.sqrt(np.diag(matrix))
    scale[scale <= 0.0] = 1.0
    product = np.multiply.outer(scale, scale)
    return np.asarray(np.linalg.pinv(matrix / product, hermitian=True, rcond=RANK) / product)


@dataclass(eq=False)
class _Model:
    """Residuals of the statistics and their derivatives by the fitted variables."""

    chain: Chain
    levels: Levels
    exposures: Exposures
    names: tuple[str, ...]
    start_e: Floats

    def __post_init__(self) -> None:
        self.common = np.zeros((2 * self.levels.mean_dn.size,) * 2)
        self.free = np.flatnonzero(self.exposures.is_free)
        positive = [any(name.startswith(each) for each in POSITIVE) for name in self.names]
        self.is_log = np.array([*positive, *[True] * self.free.size])
        self.is_signal = np.array([*(name == WELL for name in self.names), *[True] * self.free.size])

    def pack(self, values: Mapping[str, float]) -> Floats:
        """
        Return the vector of fitted variables.

        They are signals in codes instead of charges, and logarithms of positive ones. Means are known much better than the
        gain: as functions of signals they do not depend on it, so that the valley of the likelihood is straight.
        """
        gain = values["gain_dn_per_e"]
        found = np.array([*(values[name] for name in self.names), *self.start_e[self.free]], np.float64)
        found *= self._powers(gain)
        found[self.is_signal] *= 1.0 - values.get(BEND, 0.0) * found[self.is_signal] / self.chain.n_codes
        return np.where(self.is_log, np.log(np.where(self.is_log, np.maximum(found, 1e-12), 1.0)), found)

    def _powers(self, gain: float) -> Floats:
        """Return the factors of charges, and of their squares, to codes."""
        exponents = [EXPONENTS.get(name.partition("_of_class_")[0], 0) for name in self.names]
        return gain ** np.array([*exponents, *[1] * self.free.size], np.float64)

    def unpack(self, vector: Floats) -> tuple[dict[str, float], Floats]:
        """Return the parameters, and the charges of levels of unknown light."""
        found = np.where(self.is_log, np.exp(np.minimum(vector, 40.0)), vector)
        gain = float(found[self.names.index("gain_dn_per_e")])
        bend = float(found[self.names.index(BEND)]) if BEND in self.names else 0.0
        relative = found[self.is_signal] / self.chain.n_codes
        found[self.is_signal] *= 2.0 / (1.0 + np.sqrt(np.maximum(1.0 - 4.0 * bend * relative, 0.0)))
        found = found / self._powers(gain)
        n = len(self.names)
        return dict(zip(self.names, found[:n].tolist(), strict=True)), found[n:]

    def reported(self, vector: Floats) -> Floats:
        """Return the parameters and charges, logarithms of positive ones."""
        values, free_e = self.unpack(vector)
        found = np.array([*values.values(), *free_e])
        return np.where(self.is_log, np.log(np.where(self.is_log, np.maximum(found, 1e-300), 1.0)), found)

    def charges(self, vector: Floats) -> tuple[dict[str, float], Floats, Floats]:
        """Return the parameters, and charges of light and of dark current, (n_level,) e-."""
        values, free_e = self.unpack(vector)
        light_e = self.exposures.light_e(values)
        light_e[self.free] = free_e
        return values, light_e, self.exposures.dark_e(values)

    def add_common_errors(self, vector: Floats, variance_error_dn2: float) -> None:
        """Include the errors of all variances, and of the spread over pixels, in the covariance."""
        n = self.levels.mean_dn.size
        self.common[n:, n:] = variance_error_dn2**2
        at = self.moments(vector).statistics
        for spread in self.chain.spread.deviating():
            change = replace(self.chain, spread=spread).moments(*self.charges(vector)).statistics - at
            self.common += np.multiply.outer(change, change)

    def moments(self, vector: Floats) -> Moments:
        """Return the moments of the levels."""
        return self.chain.moments(*self.charges(vector))

    def residual(self, moments: Moments) -> Floats:
        """Return measured less expected statistics."""
        return np.concatenate((self.levels.mean_dn, self.levels.variance_dn2)) - moments.statistics

    def noise(self, moments: Moments) -> Floats:
        """Return the variances of the statistics by temporal noise."""
        variance = np.maximum(moments.variance_dn2, SMALLEST_DN2)
        # Gaussian noise, and two codes where there is no other: s⁴ has the variance 2 V², and V (1 - 4 V).
        of_pixel = 2.0 * variance**2 + np.maximum(variance * (1.0 - 4.0 * variance), 0.0)
        of_variance = of_pixel / (self.levels.n_pixels * (self.levels.n_frames - 1))
        return np.concatenate((self.levels.mean_noise_dn2, of_variance))

    def chain_errors(self, vector: Floats, moments: Moments) -> Floats:
        """
        Return the variances of the statistics by what the chain describes to a part only.

        Between two codes, moments depend on where pixels are in a code: this effect of rounding decreases with the variance as
        the Fourier transform of a Gaussian distribution. Without noise, a mean is any value of its code, and a variance is as
        uncertain as that of rounding.
        """
        variance = np.maximum(moments.variance_dn2, SMALLEST_DN2)
        rough, rounded = (
            np.exp(-2.0 * math.pi**2 * np.maximum(variance - each, 0.0)) for each in (ROUGH_DN2, QUANTISATION_DN2)
        )
        of_mean = (ROUGH_MEAN_DN * rough) ** 2 + QUANTISATION_DN2 * rounded**2 + MEAN_FLOOR_DN**2
        of_variance = (ROUGH_FRACTION * rough * variance) ** 2 + (QUANTISATION_DN2 * rounded) ** 2
        return np.concatenate((of_mean, of_variance)) + self._tail_errors(vector, moments) ** 2

    def _tail_errors(self, vector: Floats, moments: Moments) -> Floats:
        """
        Return errors of the statistics of levels of which only some pixels are full.

        They depend on the tails of distributions, which a Gaussian describes to a part of their effect only.
        """
        if WELL not in self.names:
            return np.zeros(moments.statistics.size)
        values, light_e, dark_e = self.charges(vector)
        well_e = values.pop(WELL)
        without = self.chain.moments(values, light_e, dark_e)
        full = self.chain.moments(values | {WELL: well_e}, np.full(light_e.size, 2.0 * well_e), dark_e)
        mean, variance = moments.mean_dn, moments.variance_dn2
        of_mean = np.minimum(np.abs(without.mean_dn - mean), np.abs(full.mean_dn - mean))
        missing = 1.0 - variance / np.maximum(without.variance_dn2, SMALLEST_DN2)
        return TAIL_FRACTION * np.concatenate((of_mean, variance * np.clip(missing, 0.0, 1.0)))

    def whitening(self, vector: Floats, moments: Moments) -> Callable[[Floats], Floats]:
        """Return the map to uncorrelated statistics of variance 1, for noise and pixels."""
        from scipy.linalg import solve_triangular

        n_pixels, classes = np.tile(self.levels.n_pixels, 2), np.tile(self.levels.class_of_level, 2)
        sampling = moments.sampling() / np.sqrt(np.multiply.outer(n_pixels, n_pixels))
        matrix = np.where(np.equal.outer(classes, classes), sampling, 0.0) + self.common
        matrix[np.diag_indices_from(matrix)] += self.noise(moments) + self.chain_errors(vector, moments)
        scale = np.sqrt(np.diag(matrix))
        factor = np.linalg.cholesky(matrix / np.multiply.outer(scale, scale))
        return lambda values: np.asarray(solve_triangular(factor, (values.T / scale).T, lower=True))

    def jacobian(self, vector: Floats, at: Floats) -> Floats:
        """
        Return the derivatives of the statistics, which are ``at``.

        Charges of levels of unknown light are changed all at once.
        """
        n_levels, n = self.levels.mean_dn.size, len(self.names)
        found = np.zeros((2 * n_levels, vector.size))

        def change(step: Floats) -> Floats:
            return self.moments(vector + step).statistics - at

        for k, name in enumerate(self.names):
            step = np.zeros(vector.size)
            step[k] = STEP if self.is_log[k] else self._step(name, vector)
            found[:, k] = change(step) / step[k]
            if name == WELL:
                # Codes of full pixels without noise rise in steps: their slope is that over a code.
                step[k] = max(STEP, 0.5 * self._full_code_fraction())
                found[:, k] = (change(step) - change(-step)) / (2.0 * step[k])
        if self.free.size:
            step = np.zeros(vector.size)
            step[n:] = STEP
            of_all = change(step) / STEP
            for j, level in enumerate(self.free):
                found[(level, n_levels + level), n + j] = of_all[[level, n_levels + level]]
        return found

    def _full_code_fraction(self) -> float:
        """Return the width of the highest code that occurs, as a fraction of its voltage."""
        adc = self.chain.adc
        code_dn = self.levels.mean_dn.max().clip(0.0, adc.n_codes - 1.0)
        return float(adc.width_of_code_dn(code_dn) / (adc.linear_of_code_dn(code_dn) + 0.5))

    def _step(self, name: str, vector: Floats) -> float:
        value = float(vector[self.names.index(name)])
        if name == "read_noise_e2":
            return max(abs(value), 0.1) * 1e-2
        if name == "dark_e_per_s":
            return max(abs(value) * 1e-3, 1e-2 / float(self.exposures.exposure_s.max()))
        return {"black_level_dn": 1e-2, BEND: 1e-4}[name]

    def result(self, vector: Floats, variance_error_dn2: Floats) -> PooledFit:
        """Return the fit with its covariances."""
        levels, moments = self.levels, self.moments(vector)
        whiten = self.whitening(vector, moments)
        noise, of_chain = self.noise(moments), self.chain_errors(vector, moments)
        jacobian = whiten(self.jacobian(vector, moments.statistics))
        to_vector = _inverse(jacobian.T @ jacobian) @ jacobian.T @ whiten(np.eye(noise.size))
        to_reported = np.empty((vector.size, vector.size))
        for k, step in enumerate(1e-5 * np.eye(vector.size)):
            to_reported[:, k] = (self.reported(vector + step) - self.reported(vector - step)) / 2e-5
        to_vector = to_reported @ to_vector
        of_blocks = np.concatenate((levels.means_dn, levels.variances_dn2))
        off = of_blocks - (of_blocks @ levels.weights)[:, None]
        known = np.flatnonzero(~np.isnan(variance_error_dn2)) + levels.mean_dn.size
        off[known] = 0.0
        n_blocks = levels.weights.size
        over_blocks = (off * levels.weights**2) @ off.T * n_blocks / max(n_blocks - 1, 1)
        over_blocks += self.common + np.diag(of_chain)
        over_blocks[known, known] = variance_error_dn2[known - levels.mean_dn.size] ** 2
        values, free_e = self.unpack(vector)
        values |= {f"level_e_{k}": float(value) for k, value in zip(self.free, free_e, strict=True)}
        return PooledFit(
            names=(*self.names, *(f"level_e_{k}" for k in self.free)),
            values=values,
            means_dn=moments.mean_dn,
            variances_dn2=moments.variance_dn2,
            slopes_dn_per_e=moments.slope_dn_per_e,
            light_e=self.charges(vector)[1],
            covariance=to_vector @ over_blocks @ to_vector.T,
            own_covariance=(to_vector * (noise + of_chain)) @ to_vector.T,
            residuals=whiten(self.residual(moments)),
        )

"""Maximum likelihood of thresholds, mismatch and contrast noise from S-curves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from foveasim._core.threads import cached_property
from foveasim._core.validation import Bools, Floats, Ints, read_only
from foveasim.errors import ParameterError
from foveasim.modes.pixels import MIN_THRESHOLD_FRACTION
from foveasim.modes.step_response import log_no_event
from foveasim.twin.events.recordings import StepResponses

__all__ = ["POLARITY_OF", "QUANTILE", "Conditions", "Curve", "Found", "dead_pixels", "fit_steps", "log_none"]

POLARITY_OF = {"contrast_on": 1, "contrast_off": -1}
#: Ranges of the parameters of S-curves: those of EventPixels, from what no recording distinguishes from 0.
RANGES = {
    "contrast_on": (1e-3, 20.0), "contrast_off": (1e-3, 20.0), "mismatch_fraction": (1e-4, 0.3), "contrast_noise": (1e-5, 1.0),
}  # fmt: skip
#: Fractions of responses that steps must reach from below and above to locate a threshold.
LOW_FRACTION, HIGH_FRACTION = 0.1, 0.9
#: Steps are far from the threshold beyond this number of standard deviations of the S-curve.
PLATEAU = 5.0
#: Half the chi-square quantile of one parameter, and the Gaussian quantile, for 95 %.
HALF_DEVIANCE, QUANTILE = 1.9207, 1.95996
#: Above this standard error of a logarithm, the likelihood is too skewed for a Gaussian interval.
MAX_GAUSSIAN_ERROR = 0.2
#: Range over which the mismatch is integrated, in standard deviations.
Z_MAX = 6.0
#: Pixels per block of the likelihood, for memory, and pixels whose likelihood is maximised: more are no longer the limit.
BLOCK_PIXELS, MAX_PIXELS = 4096, 10_000

#: Estimates and their limits by parameter.
Found = dict[str, tuple[float, tuple[float, float]]]


@dataclass(frozen=True)
class Conditions:
    """
    Expected numbers in the window: changes of the noise, and noise events.

    ``drift_fraction``, ``later_fraction``: leak before and in the window in ON thresholds.
    """

    changes: float = 0.0
    background: float | None = None
    drift_fraction: float = 0.0
    later_fraction: float = 0.0


@dataclass(frozen=True, eq=False)
class Curve:
    """
    Responses of one polarity.

    ``step``, ``n_trials``: absolute log contrasts and trials (n_step,). ``responses``: (n_step, n_pixel).
    ``missed``: fraction of steps far above the threshold without an event, such as those in a refractory time. ``false``:
    fraction of steps far below it with an event.
    """

    step: Floats
    n_trials: Ints
    responses: Ints
    sign: int
    is_pooled: bool

    @cached_property
    def missed(self) -> float:
        threshold, spread = _start(self)
        return 1.0 - self._plateau(self.step > threshold + PLATEAU * spread, 1.0)

    @cached_property
    def false(self) -> float:
        threshold, spread = _start(self)
        return self._plateau(self.step < threshold - PLATEAU * spread, 0.0)

    def _plateau(self, chosen: Bools, value: float) -> float:
        return float(np.average(self.fraction[chosen], weights=self.n_trials[chosen])) if chosen.any() else value

    @classmethod
    def of(cls, steps: StepResponses, sign: int, dead: Ints) -> Curve:
        chosen = np.sign(steps.log_contrast) == sign
        responses = steps.n_responses[chosen]
        responses = responses[:, None] if steps.is_pooled else np.delete(responses, dead, axis=1)
        step = np.abs(steps.log_contrast[chosen])
        order = np.argsort(step)
        return cls(step[order], steps.n_trials[chosen][order], responses[order], sign, steps.is_pooled)

    @property
    def n_pixels(self) -> int:
        return self.responses.shape[1]

    @property
    def fraction(self) -> Floats:
        return np.asarray(self.responses.mean(axis=1) / self.n_trials)

    @property
    def polarity(self) -> str:
        return "ON" if self.sign > 0 else "OFF"

    def check(self) -> None:
        fraction, kind = self.fraction, f"{self.polarity} steps"
        largest, smallest = f"{self.step[-1]:.3g}", f"{self.step[0]:.3g}"
        if np.unique(self.step).size < 2:
            raise ParameterError(
                "steps", f"must have two or more {kind} of different contrast", hint="an S-curve is needed"
            )
        if fraction.max() < LOW_FRACTION:
            rule = (
                f"are too small: at most {fraction.max():.2g} of the trials cause one, at {largest}; use larger steps"
            )
        elif fraction.min() > HIGH_FRACTION:
            rule = f"are too large: at least {fraction.min():.2g} of the trials cause one, at {smallest}; use smaller steps"
        elif not np.any((fraction > 0.0) & (fraction < 1.0)):
            low, high = self.step[fraction == 0.0].max(), self.step[fraction == 1.0].min()
            rule = f"are too coarse: the threshold is between {low:.3g} and {high:.3g}; add steps between"
        else:
            return
        raise ParameterError("steps", f"must cover the S-curve of events, but {kind} {rule}")


def log_none(
    curve: Curve,
    threshold: float,
    contrast_on: float,
    mismatch_fraction: float,
    contrast_noise: float,
    at: Conditions,
    n_nodes: int = 256,
    step: Floats | None = None,
) -> tuple[Floats, Floats, Floats]:
    """
    Return logarithms of the probability of no event, (n_step, n_node).

    With them, weights and thresholds of the nodes of the mismatch, (n_node,).
    """
    z = np.linspace(-Z_MAX, Z_MAX, n_nodes) if mismatch_fraction > 0.0 else np.zeros(1)
    weights = np.exp(-0.5 * z * z)
    level = threshold * np.maximum(1.0 + mismatch_fraction * z, MIN_THRESHOLD_FRACTION)
    limit = (
        level * (1.0 - at.drift_fraction - at.later_fraction)
        if curve.sign > 0
        else level + contrast_on * at.drift_fraction
    )
    background = -np.log1p(-curve.false) if at.background is None else at.background
    none = log_no_event(
        (curve.step if step is None else step)[:, None], level, limit, contrast_noise, at.changes, background
    )
    none = np.log(np.maximum(curve.missed + (1.0 - curve.missed) * np.exp(none), 1e-300))
    return none, weights / weights.sum(), level


def _n_nodes(curve: Curve, threshold: float, mismatch_fraction: float, contrast_noise: float) -> int:
    """Return the number of nodes that resolves the likelihood of a pixel, 256 to 4096."""
    spacing = np.ptp(curve.step) / max(curve.step.size - 1, 1)
    n_informative = curve.n_trials.max() * (1.0 + 2.0 * contrast_noise / max(spacing, 1e-12))
    # Pooled responses follow the mean of the nodes, and not their likelihoods.
    error = contrast_noise if curve.is_pooled else contrast_noise / np.sqrt(n_informative)
    node = 0.5 * error / (threshold * mismatch_fraction)
    return int(2 ** np.clip(np.ceil(np.log2(2.0 * Z_MAX / max(node, 1e-6))), 8, 12))


def _log_likelihood(
    curve: Curve, threshold: float, contrast_on: float, mismatch_fraction: float, contrast_noise: float, at: Conditions
) -> tuple[float, Floats]:
    """Return the log-likelihood, and the posterior mean of the threshold of each pixel."""
    if curve.is_pooled and at.changes == 0.0:  # the sum of two Gaussian numbers
        contrast_noise = float(np.hypot(contrast_noise, threshold * mismatch_fraction))
        mismatch_fraction = 0.0
    n_nodes = _n_nodes(curve, threshold, mismatch_fraction, contrast_noise) if mismatch_fraction > 0.0 else 1
    none, weights, level = log_none(curve, threshold, contrast_on, mismatch_fraction, contrast_noise, at, n_nodes)
    if curve.is_pooled:
        none, weights, level = np.log(np.exp(none) @ weights)[:, None], np.ones(1), np.full(1, threshold)
    event = np.log(np.maximum(-np.expm1(none), 1e-300))
    total, means, log_weights = 0.0, np.empty(curve.n_pixels), np.log(weights)
    for first in range(0, curve.n_pixels, BLOCK_PIXELS):
        part = slice(first, first + BLOCK_PIXELS)
        k = curve.responses[:, part].astype(np.float64)
        joint = k.T @ event + (curve.n_trials[:, None] - k).T @ none + log_weights
        top = joint.max(axis=1)
        share = np.exp(joint - top[:, None])
        sums = share.sum(axis=1)
        total += float((top + np.log(sums)).sum())
        means[part] = share @ level / sums
    return total, means


def dead_pixels(steps: StepResponses) -> Ints:
    """Return pixels without any response to steps to which most others respond."""
    if steps.is_pooled or steps.response_fraction.max() < 0.5:
        return np.zeros(0, np.int64)
    return np.flatnonzero(steps.n_responses.sum(axis=0) == 0)


def fit_steps(
    steps: StepResponses, dead: Ints, at: Conditions, values: Mapping[str, float], found: Found, reasons: dict[str, str]
) -> dict[int, Floats]:
    """Fit the S-curves; return the thresholds of the pixels by polarity."""
    if steps.n_responses.sum() == 0:
        raise ParameterError(
            "steps", "must have events, got none", hint="use larger steps, or check clock and polarity"
        )
    curves: dict[str, Curve] = {}
    for name, sign in POLARITY_OF.items():
        curve = Curve.of(steps, sign, dead)
        if curve.step.size:
            curve.check()
            curves[name] = curve
        else:
            reasons[name] = f"there are no {curve.polarity} steps"
    shared = [name for name in ("mismatch_fraction", "contrast_noise") if name not in values]
    if steps.is_pooled and len(shared) == 2:
        reasons |= dict.fromkeys(
            shared,
            "pooled responses contain only the sum of the variances of mismatch and noise; use the responses of each pixel, or "
            "hold one of the two",
        )
        for name, curve in curves.items():
            own: Found = {}
            _maximise({name: curve}, {"mismatch_fraction": 0.0}, at, ["contrast_noise"], own, reasons)
            _widen(own, steps.n_pixels, curve)
            found |= {
                name.replace("contrast_noise", f"s_curve_width_{curve.polarity.lower()}"): own[name] for name in own
            }
        return {}
    every = max(1, math.ceil(max(curve.n_pixels for curve in curves.values()) / MAX_PIXELS))
    sample = {name: replace(curve, responses=curve.responses[:, ::every]) for name, curve in curves.items()}
    best = _maximise(sample, values, at, shared, found, reasons)
    if not steps.is_pooled and found.get("mismatch_fraction", (0.0, (0.0, 0.0)))[1][0] > 0.0:
        # The largest likelihood of a standard deviation belongs to a sum of squares over n, and not n - 1.
        n_pixels = min(curve.n_pixels for curve in sample.values())
        value, limits = found["mismatch_fraction"]
        factor = (n_pixels / max(n_pixels - 1, 1)) ** 0.5
        found["mismatch_fraction"] = factor * value, (factor * limits[0], factor * limits[1])
    thresholds = {}
    for name, curve in curves.items():
        if steps.is_pooled:
            _widen(found, steps.n_pixels, curve)
            continue
        of_pixel = np.full(steps.n_responses.shape[1], np.nan)
        of_pixel[np.setdiff1d(np.arange(of_pixel.size), dead)] = _of(curve, name, best, at)[1]
        thresholds[curve.sign] = read_only(of_pixel)
    return thresholds


def _of(curve: Curve, name: str, x: Mapping[str, float], at: Conditions) -> tuple[float, Floats]:
    contrast_on = x.get("contrast_on", x[name])
    return _log_likelihood(curve, x[name], contrast_on, x["mismatch_fraction"], x["contrast_noise"], at)


def _start(curve: Curve) -> tuple[float, float]:
    """Return threshold and standard deviation of an S-curve from its quantiles."""
    fraction = np.maximum.accumulate(curve.fraction) + 1e-9 * np.arange(curve.step.size)
    low, middle, high = np.interp((0.16, 0.5, 0.84), fraction, curve.step)
    return float(middle), float(max(0.5 * (high - low), 0.02 * middle))


def _widen(found: Found, n_pixels: int | None, curve: Curve) -> None:
    """Add the sampling error of a number of pixels to intervals of pooled responses."""
    threshold, spread = _start(curve)
    errors = {name: spread / threshold for name in POLARITY_OF if POLARITY_OF[name] == curve.sign}
    for name, error in (errors | dict.fromkeys(("mismatch_fraction", "contrast_noise"), 0.5**0.5)).items():
        if n_pixels is not None and name in found:
            value, limits = found[name]
            ratios = [abs(np.log(max(limit, 1e-9) / value)) for limit in limits]
            low, high = np.exp(np.hypot(ratios, QUANTILE * error / np.sqrt(n_pixels))).tolist()
            found[name] = value, (value / low if limits[0] else 0.0, value * high)


def _maximise(
    curves: Mapping[str, Curve],
    values: Mapping[str, float],
    at: Conditions,
    shared: Sequence[str],
    found: Found,
    reasons: dict[str, str],
) -> dict[str, float]:
    """Add the estimates of largest likelihood and their limits; return all parameters."""
    starts = {name: _start(curve) for name, curve in curves.items()}
    threshold, width = np.mean(list(starts.values()), axis=0) / (1.0, max(len(shared), 1) ** 0.5)
    start = {name: value for name, (value, _) in starts.items()}
    start |= {name: width / threshold if name == "mismatch_fraction" else width for name in shared}
    names = list(start)
    bounds = np.log([RANGES[name] for name in names])

    def parameters(x: Floats) -> dict[str, float]:
        return {**values, **dict(zip(names, np.exp(np.clip(x, *bounds.T)).tolist(), strict=True))}

    def function(x: Floats) -> float:
        return -sum(_of(curve, name, parameters(x), at)[0] for name, curve in curves.items())

    x, _ = _minimum(function, np.log([start[name] for name in names]), list(range(len(names))), bounds)
    x, error = _polish(function, x, bounds)
    for i, name in enumerate(names):
        low, high = x[i] - QUANTILE * error[i], x[i] + QUANTILE * error[i]
        if not error[i] < MAX_GAUSSIAN_ERROR:
            low, high = (_profile_limit(function, x, i, bounds, side) for side in (-1, 1))
        if high >= bounds[i, 1] and low <= bounds[i, 0]:
            reasons[name] = "the likelihood is flat: use more trials, pixels or steps near the threshold"
            continue
        limits = 0.0 if low <= bounds[i, 0] else float(np.exp(low)), float(np.exp(min(high, bounds[i, 1])))
        found[name] = float(np.exp(x[i])), limits
    return parameters(x)


def _minimum(function: Callable[[Floats], float], x: Floats, free: list[int], bounds: Floats) -> tuple[Floats, float]:
    """Minimise over some parameters, and return all, and the minimum."""
    from scipy.optimize import minimize

    full = np.clip(x, *bounds.T)

    def part(y: Floats) -> float:
        full[free] = y
        return function(full)

    if not free:
        return full, function(full)
    limits = [(float(low), float(high)) for low, high in bounds[free]]
    result = minimize(part, full[free], method="L-BFGS-B", bounds=limits, options={"eps": 1e-5, "ftol": 1e-11})
    full[free] = result.x
    return full, float(result.fun)


def _polish(function: Callable[[Floats], float], x: Floats, bounds: Floats) -> tuple[Floats, Floats]:
    """Return the minimum by Newton steps, and standard errors, infinite if not resolved."""
    sizes, error = np.full(x.size, 1e-3), np.full(x.size, np.inf)
    for _ in range(2):
        here, units = function(x), np.diag(sizes)
        ups, downs = (np.array([function(x + sign * unit) for unit in units]) for sign in (1, -1))
        hessian = np.diag(ups - 2.0 * here + downs)
        for i, k in itertools.combinations(range(x.size), 2):
            both = sum(function(x + sign * (units[i] + units[k])) for sign in (1, -1))
            hessian[i, k] = hessian[k, i] = 0.5 * (both + 2.0 * here - ups[i] - ups[k] - downs[i] - downs[k])
        hessian /= np.outer(sizes, sizes)
        if not np.all(np.linalg.eigvalsh(hessian) > 0.0):
            return x, np.full(x.size, np.inf)
        covariance = np.linalg.inv(hessian)
        error = np.sqrt(np.diag(covariance))
        moved = np.clip(x - covariance @ ((ups - downs) / (2.0 * sizes)), *bounds.T)
        x = moved if function(moved) < here else x
        sizes = np.clip(0.5 / np.sqrt(np.diag(hessian)), 1e-5, 0.2)
    return x, np.where(np.isclose(x, bounds[:, 0]) | np.isclose(x, bounds[:, 1]), np.inf, error)


def _profile_limit(function: Callable[[Floats], float], x: Floats, i: int, bounds: Floats, side: int) -> float:
    """Return where the profile likelihood reaches the limit of confidence, or a bound."""
    bound = float(bounds[i, 0] if side < 0 else bounds[i, 1])
    others, most = [k for k in range(x.size) if k != i], function(x) + HALF_DEVIANCE

    def is_outside(start: Floats, value: float) -> tuple[bool, Floats]:
        start = np.where(np.arange(x.size) == i, value, start)
        start, least = _minimum(function, start, others, bounds)
        return least > most, start

    inner, step, start, outside = x[i], 0.1, x, False
    while not outside:
        if inner == bound:
            return bound
        outer = float(np.clip(inner + side * step, *bounds[i]))
        outside, start = is_outside(start, outer)
        inner, step = (inner, step) if outside else (outer, 2.0 * step)
    for _ in range(6):
        middle = 0.5 * (inner + outer)
        outside, start = is_outside(start, middle)
        inner, outer = (inner, middle) if outside else (middle, outer)
    return float(0.5 * (inner + outer))

"""Closed forms of event pixels: steps of irradiance (S-curves), and constant irradiance."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import NOT_NEGATIVE
from foveasim._core.validation import Floats, finite_array
from foveasim.errors import ParameterError

__all__ = ["event_probability"]


def event_probability(
    log_contrast: ArrayLike,
    threshold: ArrayLike,
    *,
    contrast_noise: Annotated[float, NOT_NEGATIVE] = 0.0,
    changes_per_s: Annotated[float, NOT_NEGATIVE] = 0.0,
    window_s: Annotated[float, NOT_NEGATIVE] = 0.0,
    background_per_s: Annotated[float, NOT_NEGATIVE] = 0.0,
    leak_per_s: Annotated[float, NOT_NEGATIVE] = 0.0,
    rest_s: Annotated[float, NOT_NEGATIVE] = 0.0,
) -> Floats:
    """
    Return the probability that a step of irradiance causes an event of its polarity.

    Parameters
    ----------
    log_contrast : array_like
        Natural logarithms of the ratio of the irradiances after and before each step, positive for ON and negative for OFF
        events.
    threshold : array_like
        Thresholds of this polarity, broadcast against ``log_contrast``.
    contrast_noise, changes_per_s : float, and 1/s
        As ``contrast_noise`` and ``contrast_noise_changes_per_s`` of :class:`EventPixels`.
    window_s : float, s
        Time after the step in which events count.
    background_per_s : float, 1/s
        Rate of noise events of this polarity: half of the noise rate of :class:`EventPixels`.
    leak_per_s : float, 1/s
        Leak rate, which lowers the reference of the site before and after the step.
    rest_s : float, s
        Time between the last event of the site and the step.

    Returns
    -------
    probability : float64
        From 0 to 1, of the broadcast shape.

    Raises
    ------
    ParameterError
        When a value is not finite, shapes do not match, or a rate, a time or the noise is negative.

    Notes
    -----
    For a step s and threshold c, without rates, it is ``Phi((s - c) / contrast_noise)`` with the Gaussian distribution function
    Phi; for k changes of the noise expected in the window, the probability of no event is ``P exp(-k (1 - P))`` with
    ``P = Phi((c - s) / contrast_noise)``. Noise that would have caused an event before the step is excluded. The step is fast,
    the window longer than the response of the photoreceptor, and events of the other polarity in the window are neglected.

    Examples
    --------
    >>> event_probability([0.18, 0.2, 0.22], 0.2, contrast_noise=0.02).round(3).tolist()
    [0.159, 0.5, 0.841]
    """
    step, level = finite_array("log_contrast", log_contrast), finite_array("threshold", threshold)
    try:
        np.broadcast_shapes(step.shape, level.shape)
    except ValueError:
        raise ParameterError(
            "threshold", f"must match 'log_contrast' of shape {step.shape}, got shape {level.shape}"
        ) from None
    drift = leak_per_s * np.where(step > 0.0, rest_s + window_s, -rest_s)
    log_none = log_no_event(
        np.abs(step),
        level,
        level * (1.0 - drift),
        contrast_noise,
        changes_per_s * window_s,
        background_per_s * window_s,
    )
    return np.asarray(-np.expm1(log_none))


def log_no_event(
    step: Floats,
    threshold: Floats,
    limit: Floats,
    contrast_noise: float,
    changes: float,
    background: float,
) -> Floats:
    """
    Return the logarithm of the probability of no event after a step towards a threshold.

    ``limit``: part of the threshold that the step must exceed. ``changes``, ``background``: expected changes of the
    noise and noise events.
    """
    from scipy.special import log_ndtr, ndtr

    if contrast_noise == 0.0:
        return np.where(step >= limit, -np.inf, 0.0) - background
    missing = (limit - step) / contrast_noise
    start = np.minimum(log_ndtr(missing) - log_ndtr(threshold / contrast_noise), 0.0)
    return np.asarray(start - changes * ndtr(-missing) - background)


def contrast_noise_events_per_s(threshold: Floats, contrast_noise: float, changes_per_s: float) -> Floats:
    """Return the rate of events of one polarity that contrast noise causes by itself."""
    from scipy.special import ndtr

    if contrast_noise == 0.0:
        return np.zeros_like(threshold)
    return np.asarray(changes_per_s * ndtr(-threshold / contrast_noise))


def leak_part(events_per_s: float, threshold: float, contrast_noise: float, changes_per_s: float) -> float:
    """Return the leak rate over the rate of leak events, which contrast noise advances."""
    from scipy.special import ndtr

    if contrast_noise == 0.0 or events_per_s == 0.0:
        return 1.0
    # Leak since the last event in thresholds: the noise exceeds the rest at a change, or when the leak reaches it.
    part = np.linspace(0.0, 1.0 + 8.0 * contrast_noise / threshold, 4001)
    rest = (1.0 - part) * threshold / contrast_noise
    changes = np.cumsum(ndtr(-rest)) * part[1] * changes_per_s
    ratio = 1.0
    for _ in range(30):
        none = ndtr(rest) / ndtr(rest[0]) * np.exp(-changes / (events_per_s * ratio))
        ratio = float(none.mean() * part[-1])
    return ratio


def noise_and_leak_per_s(on_per_s: Floats, off_per_s: Floats, refractory_s: float) -> tuple[Floats, Floats]:
    """
    Return noise and leak rates from rates of ON and OFF events at constant irradiance.

    Every event begins a refractory time, and a noise event also restarts the leak: with noise rate n and leak rate r, the
    leak events outside refractory times have the rate ``n / (exp(n / r) - 1)``. The leak is 0 if OFF events are as frequent
    as ON events.
    """
    active = 1.0 - refractory_s * (on_per_s + off_per_s)
    noise, excess = 2.0 * off_per_s / active, (on_per_s - off_per_s) / active
    with np.errstate(divide="ignore", invalid="ignore"):
        leak = np.where(noise > 0.0, noise / np.log1p(noise / excess), excess)
    return np.asarray(noise), np.where(excess > 0.0, leak, 0.0)


def leak_events_per_s(leak_per_s: Floats, noise_per_s: Floats) -> Floats:
    """Return the rate of leak events outside refractory times; noise restarts the leak."""
    ratio = np.clip(noise_per_s / np.maximum(leak_per_s, 1e-300), 1e-12, 700.0)
    return np.asarray(leak_per_s * ratio / np.expm1(ratio))

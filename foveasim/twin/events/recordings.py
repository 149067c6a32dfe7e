"""Recordings of an event camera: responses to steps, and events at constant irradiance."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import POSITIVE, Limits, check_declared
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, Ints, as_numbers, finite_array, frozen_array
from foveasim.errors import ParameterError
from foveasim.modes import Events
from foveasim.sensor.limits import DURATION, EXPOSURE, RATE

__all__ = ["StaticRecording", "StepResponses"]

#: Steps above this, a ratio of 148, exceed the thresholds of all event cameras: they indicate percent.
MAX_LOG_CONTRAST = 5.0
#: Shortest intervals that are stored, for the refractory time.
N_SHORTEST = 100
#: Fewer pixels do not show the spread over pixels.
MIN_PIXELS = 8
TICK_S = 1e-6
_CONTRAST_HINT = "convert a contrast in percent by numpy.log1p(percent / 100), and a ratio of irradiances by numpy.log"


@dataclass(frozen=True, eq=False)
class StepResponses:
    """
    Numbers of steps that caused an event of their polarity: the data of S-curves.

    Parameters
    ----------
    log_contrast : (n_step,) float64
        Natural logarithm of the ratio of the irradiances after and before each kind of step: positive for ON, negative for
        OFF events.
    n_trials : (n_step,) int64
        Repetitions of each kind of step.
    n_responses : (n_step, n_pixel) or (n_step,) int64
        Repetitions that caused at least one event of the polarity of the step, of each pixel; or summed over pixels (pooled),
        with trials that are summed as well.
    window_s : float, s
        Time after the step in which events were counted.
    rest_s : float, s
        Time between the last event and the step, in which the leak lowers the reference.
    current_e_per_s : float, e-/s, optional
        Photocurrent before the steps, for the bandwidth.
    latency_s, latency_error_s : (n_step,) float64, s, optional
        Median time from each kind of step to the first event, and its standard error.
    n_pixels : int, optional
        Number of pixels of pooled responses, which widens their intervals: repetitions with one pixel are not independent.

    Raises
    ------
    ParameterError
        When shapes or numbers do not match, or contrasts are zero or in percent.

    Examples
    --------
    >>> StepResponses([0.1, 0.2, 0.3], [100, 100, 100], [3, 55, 99]).is_pooled
    True
    """

    log_contrast: Floats
    n_trials: Ints
    n_responses: Ints
    _: KW_ONLY
    window_s: Annotated[float, EXPOSURE] = 0.0
    rest_s: Annotated[float, EXPOSURE] = 0.0
    current_e_per_s: Annotated[float | None, RATE] = None
    latency_s: Floats | None = None
    latency_error_s: Floats | None = None
    n_pixels: Annotated[int | None, Limits(at_least=1)] = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_declared(self)
        step = _contrasts(self.log_contrast)
        trials, responses = _counts("n_trials", self.n_trials), _counts("n_responses", self.n_responses)
        if trials.shape != step.shape or (trials.size and trials.min() < 1):
            raise ParameterError(
                "n_trials", f"must be one number of at least 1 for each of {step.size} steps", trials.tolist()
            )
        if responses.ndim not in (1, 2) or responses.shape[0] != step.size or not responses.size:
            raise ParameterError(
                "n_responses",
                f"must be ({step.size}, n_pixel), or ({step.size},) if pooled, for {step.size} steps",
                responses.shape,
                hint="one row for each step",
            )
        if np.any(responses > trials.reshape(-1, *[1] * (responses.ndim - 1))):
            raise ParameterError(
                "n_responses", "must be at most the number of trials of each step", int(responses.max()),
                hint="count steps with events, not events",
            )  # fmt: skip
        if responses.ndim == 2 and self.n_pixels is not None:
            raise ParameterError("n_pixels", "must not be given for responses of each pixel", self.n_pixels)
        arrays = {"log_contrast": step, "n_trials": trials, "n_responses": responses}
        for name in ("latency_s", "latency_error_s"):
            if (values := getattr(self, name)) is not None:
                arrays[name] = as_numbers(name, values).astype(np.float64)
                if arrays[name].shape != step.shape:
                    raise ParameterError(name, f"must be one time for each of {step.size} steps", arrays[name].shape)
        for name, array in arrays.items():
            object.__setattr__(self, name, frozen_array(array))

    @property
    def is_pooled(self) -> bool:
        """Whether the responses are summed over pixels."""
        return self.n_responses.ndim == 1

    @property
    def response_fraction(self) -> Floats:
        """Fraction of trials with an event, over all pixels, (n_step,)."""
        responses = self.n_responses if self.is_pooled else self.n_responses.mean(axis=1)
        return np.asarray(responses / self.n_trials)

    @classmethod
    def from_events(
        cls,
        events: Events,
        times_s: ArrayLike,
        log_contrast: ArrayLike,
        *,
        window_s: Annotated[float, DURATION],
        rest_s: Annotated[float, EXPOSURE] = 0.0,
        current_e_per_s: Annotated[float | None, RATE] = None,
    ) -> StepResponses:
        """
        Count the responses of each pixel of a recording, and measure their latencies.

        Parameters
        ----------
        events : Events
            Recording, as from :meth:`foveasim.modes.Events.read`; all its sites saw the steps.
        times_s : (n_trial,) float64, s
            Times of the steps on the clock of the events, in ascending order.
        log_contrast : (n_trial,) float64
            Logarithm of the ratio of irradiances of each step. Equal values are repetitions. Steps that reset the pixels
            between measured ones are not listed.
        window_s, rest_s, current_e_per_s : float
            As for the class.

        Raises
        ------
        ParameterError
            When there are no events, or windows overlap.
        """
        step, begins_s = _contrasts(log_contrast), finite_array("times_s", times_s, ndim=1)
        if begins_s.size != step.size:
            raise ParameterError("times_s", f"must be one time for each of {step.size} steps", begins_s.size)
        if np.any(np.diff(begins_s) < window_s):
            raise ParameterError(
                "times_s", f"must be ascending, {window_s:g} s or more apart", begins_s, "s", "use a smaller 'window_s'"
            )
        if not len(events):
            raise ParameterError("events", "must contain events, got none", hint="check the clock and the polarity")
        contrasts, kind = np.unique(step, return_inverse=True)
        responses = np.zeros((contrasts.size, events.layout.n_sites), np.int64)
        delays_s: list[list[Floats]] = [[] for _ in contrasts]
        for k, begin_s in zip(kind, begins_s, strict=True):
            part = slice(*np.searchsorted(events.t_s, (begin_s, begin_s + window_s)))
            is_due = events.polarity[part] == np.sign(contrasts[k])
            sites, first = np.unique(events.site[part][is_due], return_index=True)
            responses[k, sites] += 1
            delays_s[k].append(events.t_s[part][is_due][first] - begin_s)
        joined = [np.concatenate(delays) if delays else np.zeros(0) for delays in delays_s]
        return cls(
            contrasts,
            np.bincount(kind, minlength=contrasts.size),
            responses,
            window_s=window_s,
            rest_s=rest_s,
            current_e_per_s=current_e_per_s,
            latency_s=np.array([np.median(d) if d.size else np.nan for d in joined]),
            latency_error_s=np.array(
                [_median_error_s(d, (n > 0).sum()) for d, n in zip(joined, responses, strict=True)]
            ),
        )


@dataclass(frozen=True, eq=False)
class StaticRecording:
    """
    Numbers of events of each pixel at constant irradiance.

    Parameters
    ----------
    n_on, n_off : (n_bin, n_pixel) or (n_pixel,) int64
        ON and OFF events in consecutive times of equal duration. The leak spread requires at least three.
    bin_s : float, s
        Duration of each.
    current_e_per_s : float, e-/s, optional
        Photocurrent, for the decrease of the noise with irradiance.
    interval_s : (n,) float64, s, optional
        Shortest times from an event to the next one of the same pixel, if that is OFF, in ascending order.
    n_intervals : int
        Number of all these intervals.
    tick_s : float, s
        Resolution of their times.

    Raises
    ------
    ParameterError
        When shapes do not match, there are fewer than 8 pixels, or no events.

    Examples
    --------
    >>> import numpy as np
    >>> StaticRecording(np.full(20, 9), np.full(20, 2), bin_s=10.0).n_on.shape
    (1, 20)
    """

    n_on: Ints
    n_off: Ints
    _: KW_ONLY
    bin_s: Annotated[float, DURATION]
    current_e_per_s: Annotated[float | None, RATE] = None
    interval_s: Floats = field(default_factory=lambda: np.zeros(0))
    n_intervals: Annotated[int, Limits(at_least=0)] = 0
    tick_s: Annotated[float, EXPOSURE] = 0.0

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_declared(self)
        on, off = (np.atleast_2d(_counts(name, getattr(self, name))) for name in ("n_on", "n_off"))
        if on.ndim != 2 or on.shape != off.shape:
            raise ParameterError("n_off", f"must have the shape {on.shape} of 'n_on'", off.shape)
        if on.shape[1] < MIN_PIXELS:
            raise ParameterError("n_on", f"must have {MIN_PIXELS} or more pixels", on.shape[1])
        if not on.sum() + off.sum():
            raise ParameterError("n_on", "must contain events, got none", hint="record for a longer time")
        intervals = finite_array("interval_s", self.interval_s, ndim=1, at_least=0.0)
        for name, array in (("n_on", on), ("n_off", off), ("interval_s", np.sort(intervals))):
            object.__setattr__(self, name, frozen_array(array))

    @classmethod
    def from_events(
        cls,
        events: Events,
        start_s: Annotated[float, EXPOSURE],
        stop_s: Annotated[float, POSITIVE],
        *,
        n_bins: Annotated[int, Limits(at_least=1, at_most=1000)] = 10,
        current_e_per_s: Annotated[float | None, RATE] = None,
    ) -> StaticRecording:
        """
        Count the events of a recording at constant irradiance from ``start_s`` to ``stop_s``.

        The first seconds after a change of the irradiance are best omitted.

        Raises
        ------
        ParameterError
            When ``stop_s`` is not above ``start_s``, or there are no events between them.
        """
        if not stop_s > start_s:
            raise ParameterError("stop_s", f"must be > {start_s:g}, the start", stop_s, "s")
        edges_s = np.linspace(start_s, stop_s, n_bins + 1)
        part = events.between(start_s, stop_s)
        order = np.lexsort((part.t_s, part.site))
        site, t_s, polarity = part.site[order], part.t_s[order], part.polarity[order]
        is_interval = (site[1:] == site[:-1]) & (polarity[1:] == -1)
        intervals = np.sort(np.diff(t_s)[is_interval])
        is_in_us = bool(np.all(np.abs(t_s * 1e6 - np.round(t_s * 1e6)) < 1e-3))
        return cls(
            part.histogram(edges_s, polarity=1),
            part.histogram(edges_s, polarity=-1),
            bin_s=(stop_s - start_s) / n_bins,
            current_e_per_s=current_e_per_s,
            interval_s=intervals[:N_SHORTEST],
            n_intervals=intervals.size,
            tick_s=TICK_S if is_in_us else 0.0,
        )


def _contrasts(values: ArrayLike) -> Floats:
    step = finite_array("log_contrast", values, ndim=1)
    if not step.size:
        raise ParameterError("log_contrast", "must contain at least one step")
    if np.any(step == 0.0):
        raise ParameterError("log_contrast", "must not be 0", hint="the polarity of a step is its sign")
    if np.abs(step).max() > MAX_LOG_CONTRAST:
        raise ParameterError(
            "log_contrast",
            f"must be natural logarithms of at most {MAX_LOG_CONTRAST:g}",
            float(step[np.abs(step).argmax()]),
            hint=_CONTRAST_HINT,
        )
    return step


def _counts(name: str, values: ArrayLike) -> Ints:
    array = as_numbers(name, values, keep_type=True)
    if array.dtype.kind not in "iu" or (array.size and array.min() < 0):
        raise ParameterError(name, "must be integers >= 0", array, hint="counts of trials or events, not fractions")
    return array.astype(np.int64)


def _median_error_s(delays_s: Floats, n_pixels: int) -> float:
    """Return the standard error of the median; delays of the same pixel may be equal."""
    if delays_s.size < MIN_PIXELS or n_pixels < MIN_PIXELS:
        return float("nan")
    low_s, high_s = np.quantile(delays_s, (0.16, 0.84))
    return float(1.2533 * 0.5 * (high_s - low_s) / np.sqrt(n_pixels))

"""
Parameters of :class:`foveasim.modes.EventPixels` from recordings of an event camera.

Thresholds, their mismatch and the contrast noise follow from S-curves by maximum likelihood, with the probabilities of
:mod:`foveasim.modes`. Leak, noise and refractory time follow from events at constant irradiance, the bandwidth from latencies.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from foveasim._core.provenance import to_plain_data
from foveasim._core.validation import Floats, Ints, read_only
from foveasim._version import __version__
from foveasim.errors import ParameterError
from foveasim.metrics.emva_intervals import CONFIDENCE
from foveasim.modes import EventPixels
from foveasim.modes.pixels import CONTRAST_NOISE, EVENT_RATE
from foveasim.modes.step_response import contrast_noise_events_per_s, leak_part
from foveasim.sensor import Sensor
from foveasim.sensor.limits import SPREAD, TEMPERATURE
from foveasim.twin.events._s_curves import (
    POLARITY_OF,
    QUANTILE,
    Conditions,
    Curve,
    Found,
    dead_pixels,
    fit_steps,
    log_none,
)
from foveasim.twin.events._static_events import fit_static, noise_at
from foveasim.twin.events.recordings import StaticRecording, StepResponses
from foveasim.units import BOLTZMANN_J_PER_K, ELEMENTARY_CHARGE_C

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["EventPixelFit", "fit_event_pixels"]

#: Steps for latencies: above this multiple of the threshold, with events in nearly all trials.
MIN_RATIO, MIN_FRACTION, MIN_STEPS = 1.5, 0.95, 4


@dataclass(frozen=True, eq=False)
class EventPixelFit:
    """
    Parameters of event pixels, from :func:`fit_event_pixels`.

    Attributes
    ----------
    values : mapping of str to float
        Estimates by the names of parameters of :class:`foveasim.modes.EventPixels`, in their units. For pooled responses also
        ``s_curve_width_on`` and ``s_curve_width_off``, the standard deviations of the S-curves.
    intervals : mapping of str to (float, float)
        Limits of 95 % confidence of each estimate. A lower limit of 0 is a parameter that may be absent.
    not_identifiable : mapping of str to str
        Reason for each parameter that the recordings do not contain.
    thresholds_on, thresholds_off : (n_pixel,) float64, optional
        Thresholds of each pixel: posterior means, for responses of each pixel. NaN for dead pixels.
    leak_rates_per_s, noise_rates_per_s : (n_pixel,) float64, 1/s, optional
        Rates of each pixel, averaged over the static recordings.
    hot_pixels, dead_pixels : (n,) int64
        Pixels with far more events at constant irradiance than others, and pixels without any response to steps that others
        respond to. They are excluded.
    steps : StepResponses, optional
        The responses.
    provenance : mapping
        What was held, assumed and neglected; the recordings; the version.
    """

    values: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float]]
    not_identifiable: Mapping[str, str]
    thresholds_on: Floats | None
    thresholds_off: Floats | None
    leak_rates_per_s: Floats | None
    noise_rates_per_s: Floats | None
    hot_pixels: Ints
    dead_pixels: Ints
    steps: StepResponses | None
    provenance: Mapping[str, Any]

    def __repr__(self) -> str:
        found = ", ".join(f"{name}={value:.4g}" for name, value in self.values.items())
        missing = f"; not identifiable: {', '.join(self.not_identifiable)}" if self.not_identifiable else ""
        return f"EventPixelFit({found}{missing})"

    def records(self) -> list[dict[str, Any]]:
        """Return one dict per parameter: value and limits, or why it is not identifiable."""
        found = [
            {"parameter": name, "value": value, "low": self.intervals[name][0], "high": self.intervals[name][1]}
            for name, value in self.values.items()
        ]
        return found + [{"parameter": name, "reason": reason} for name, reason in self.not_identifiable.items()]

    def pixels(self, sensor: Sensor, **parameters: float) -> EventPixels:
        """
        Return event pixels of a sensor with these parameters.

        Parameters
        ----------
        sensor : Sensor
            Sensor with the photosites.
        **parameters : float
            Parameters of :class:`foveasim.modes.EventPixels` that replace the estimates, or are not identifiable.

        Returns
        -------
        EventPixels
            Parameters that are neither identified nor given have their defaults. Noise events that the contrast noise causes by
            itself are subtracted from the noise rate.

        Raises
        ------
        ParameterError
            When a threshold, or the shares of mismatch and noise in pooled responses, are neither identified nor given.
        """
        names = {f.name for f in fields(EventPixels)}
        chosen = dict(self.provenance["held"]) | {k: v for k, v in self.values.items() if k in names} | parameters
        for name in ("contrast_on", "contrast_off", "mismatch_fraction", "contrast_noise"):
            if name in self.not_identifiable and name not in chosen:
                raise ParameterError(
                    name, f"must be given: it is not identifiable from these recordings, {self.not_identifiable[name]}"
                )
        pixels = EventPixels(sensor, **chosen)
        own = sum(
            float(contrast_noise_events_per_s(c, pixels.contrast_noise, pixels.contrast_noise_changes_per_s).mean())
            for c in pixels.thresholds
        )
        if not own or "noise_per_s" in parameters:
            return pixels
        return EventPixels(sensor, **chosen | {"noise_per_s": max(0.0, pixels.noise_per_s - own)})

    def plot(self, *, ax: Axes | None = None) -> Axes:
        """Draw the S-curves: fractions of all pixels with their standard errors, and the fit."""
        from foveasim.view import plot_curves

        if self.steps is None:
            raise ParameterError("steps", "must be given to the fit for S-curves")
        curves, points = {}, []
        for name, sign in POLARITY_OF.items():
            if name in self.values:
                curve = Curve.of(self.steps, sign, self.dead_pixels)
                label, theta = ("ON", "OFF")[sign < 0], self.values[name]
                mismatch, noise = self._spreads(label.lower())
                shown = np.linspace(0.0, 1.1 * curve.step.max(), 200)
                none = log_none(
                    curve, theta, theta, mismatch, noise, Conditions(**self.provenance["conditions"]), step=shown
                )
                curves[label] = shown, 1.0 - np.exp(none[0]) @ none[1]
                points.append((curve.step, curve.fraction, curve.n_trials * (1 if curve.is_pooled else curve.n_pixels)))
        axes = plot_curves(curves, "step, |ln of the ratio of irradiances|", "fraction of steps with an event", ax=ax)
        for line, (step, fraction, n) in zip(axes.get_lines()[-len(points) :], points, strict=True):
            axes.errorbar(step, fraction, np.sqrt(fraction * (1.0 - fraction) / n), fmt="o", color=line.get_color())
        return axes

    def _spreads(self, label: str) -> tuple[float, float]:
        known = dict(self.provenance["held"]) | dict(self.values)
        if (width := known.get(f"s_curve_width_{label}")) is not None:
            return 0.0, width
        return known["mismatch_fraction"], known["contrast_noise"]


def fit_event_pixels(
    steps: StepResponses | None = None,
    static: Sequence[StaticRecording] = (),
    *,
    mismatch_fraction: Annotated[float | None, SPREAD] = None,
    contrast_noise: Annotated[float | None, CONTRAST_NOISE] = None,
    contrast_noise_changes_per_s: Annotated[float, EVENT_RATE] = 0.0,
    temperature_k: Annotated[float, TEMPERATURE] = 300.0,
) -> EventPixelFit:
    """
    Estimate parameters of event pixels from recordings, with intervals of 95 %.

    Parameters
    ----------
    steps : StepResponses, optional
        Responses to steps of irradiance, of each pixel or pooled.
    static : sequence of StaticRecording
        Recordings at constant irradiance of the same pixels; with two or more known photocurrents, the noise is a function of
        irradiance. Their leak and noise also enter the S-curves.
    mismatch_fraction, contrast_noise : float, optional
        Known values to hold; pooled responses determine one of the two if the other is held.
    contrast_noise_changes_per_s : float, 1/s
        Rate at which the contrast noise changes, which S-curves do not determine: with 0, once for each event.
    temperature_k : float, K
        Temperature of the sensor, for the capacitance.

    Returns
    -------
    EventPixelFit

    Raises
    ------
    ParameterError
        When there are no recordings, no events, or the steps are too small, too large or too few for a threshold.

    Notes
    -----
    The threshold of pixel i is Gaussian, ``contrast (1 + mismatch z_i)``, and given z_i its responses are binomial. The
    likelihood integrates over z_i numerically: the spread over pixels is the mismatch, the width of the S-curve of each pixel
    the contrast noise. The pixels are a sample of the kind of sensor. Intervals are those of a Gaussian on a logarithmic scale,
    and of the profile likelihood where the estimate is uncertain by more than 20 %. Of more than 10,000 pixels, every n-th
    enters the likelihood. Steps beyond 5 standard deviations of the S-curve show the fraction of events that are missed, as in
    refractory times or readout, and without static recordings the fraction of false ones.

    The reference must be at the level before each measured step. Precede it with a step that is much larger than the thresholds
    and faster than the refractory time: it also draws the noise again. Without it, a pixel that did not respond remembers the
    difference.

    At constant irradiance, OFF events are noise, and ON events noise and leak; noise that restarts the leak is corrected.
    Intervals come from the jackknife over pixels. The refractory time is the lower end of the intervals before OFF events,
    extrapolated from the shortest hundred, which are uniform near this end.

    The bandwidth follows from the latencies of steps above 1.5 thresholds: a low pass with ``tau = C (kT/q) / I`` crosses the
    threshold c of a step s after ``-tau ln(1 - c / s)``. A delay common to all steps is fitted.

    Examples
    --------
    >>> steps = StepResponses(
    ...     [0.1, 0.15, 0.2, 0.25, 0.3], [1000] * 5, [4, 166, 502, 831, 997]
    ... )
    >>> fit = fit_event_pixels(steps, mismatch_fraction=0.0)
    >>> low, high = fit.intervals["contrast_on"]
    >>> round(fit.values["contrast_on"], 3), round(low, 3), round(high, 3)
    (0.2, 0.198, 0.202)
    """
    if steps is None and not static:
        raise ParameterError("steps", "must be given, or 'static'")
    held = {"contrast_noise_changes_per_s": contrast_noise_changes_per_s, "temperature_k": temperature_k}
    held |= {
        name: value
        for name, value in (("mismatch_fraction", mismatch_fraction), ("contrast_noise", contrast_noise))
        if value is not None
    }
    found: Found = {}
    reasons: dict[str, str] = {}
    rates, hot = fit_static(static, found, reasons)
    thresholds: dict[int, Floats] = {}
    dead = np.zeros(0, np.int64)
    conditions = Conditions()
    if steps is not None:
        conditions = Conditions(
            changes=contrast_noise_changes_per_s * steps.window_s,
            background=0.5 * noise_at(found, steps.current_e_per_s) * steps.window_s if static else None,
            drift_fraction=found["leak_per_s"][0] * steps.rest_s if "leak_per_s" in found else 0.0,
            later_fraction=found["leak_per_s"][0] * steps.window_s if "leak_per_s" in found else 0.0,
        )
        dead = dead_pixels(steps)
        thresholds = fit_steps(steps, dead, conditions, held, found, reasons)
        _fit_capacitance(steps, temperature_k, found, reasons)
        if {"leak_per_s", "contrast_on", "contrast_noise"} <= found.keys():
            leak, limits = found["leak_per_s"]
            theta, noise = (found[name][0] for name in ("contrast_on", "contrast_noise"))
            part = leak_part(leak, theta, noise, contrast_noise_changes_per_s)
            found["leak_per_s"] = leak * part, (limits[0] * part, limits[1] * part)
    else:
        names = ("contrast_on", "contrast_off", "mismatch_fraction", "contrast_noise", "capacitance_f")
        reasons |= {name: "there are no responses to steps" for name in names if name not in held}
    provenance = {
        "foveasim": __version__,
        "held": held,
        "conditions": to_plain_data({f.name: getattr(conditions, f.name) for f in fields(conditions)}),
        "recordings": to_plain_data([steps, *static]),
        "confidence": CONFIDENCE,
    }
    return EventPixelFit(
        values=MappingProxyType({name: value for name, (value, _) in found.items()}),
        intervals=MappingProxyType({name: limits for name, (_, limits) in found.items()}),
        not_identifiable=MappingProxyType(reasons),
        thresholds_on=thresholds.get(1),
        thresholds_off=thresholds.get(-1),
        leak_rates_per_s=None if rates is None else rates[0],
        noise_rates_per_s=None if rates is None else rates[1],
        hot_pixels=read_only(hot),
        dead_pixels=read_only(dead),
        steps=steps,
        provenance=MappingProxyType(provenance),
    )


def _fit_capacitance(steps: StepResponses, temperature_k: float, found: Found, reasons: dict[str, str]) -> None:
    """Fit the capacitance of the low pass to the latencies of steps far above the threshold."""
    if steps.latency_s is None or steps.latency_error_s is None or steps.current_e_per_s is None:
        reasons["capacitance_f"] = "latencies and the photocurrent before the steps are needed"
        return
    size = np.abs(steps.log_contrast)
    theta = np.array(
        [found.get("contrast_off" if s < 0.0 else "contrast_on", (np.inf,))[0] for s in steps.log_contrast]
    )
    ratio = theta / size
    used = (ratio < 1.0 / MIN_RATIO) & (steps.response_fraction > MIN_FRACTION) & np.isfinite(steps.latency_error_s)
    if used.sum() < MIN_STEPS:
        reasons["capacitance_f"] = (
            f"{used.sum()} steps are above {MIN_RATIO:g} thresholds, with events in nearly all trials of {MIN_STEPS} needed"
        )
        return
    after = steps.current_e_per_s * np.exp(steps.log_contrast[used])
    design = np.stack((np.ones(after.size), -np.log1p(-ratio[used]) / after), axis=1)
    error_s = np.maximum(steps.latency_error_s[used], 1e-4 * steps.latency_s[used])
    scaled = design / error_s[:, None]
    covariance = np.linalg.inv(scaled.T @ scaled)
    solution = covariance @ scaled.T @ (steps.latency_s[used] / error_s)
    residual = steps.latency_s[used] / error_s - scaled @ solution
    excess = max(1.0, float(residual @ residual) / max(after.size - 2, 1))
    half = QUANTILE * float(np.sqrt(covariance[1, 1] * excess))
    charge = ELEMENTARY_CHARGE_C**2 / (BOLTZMANN_J_PER_K * temperature_k)
    if solution[1] - half <= 0.0:
        reasons["capacitance_f"] = (
            f"latencies do not decrease with the step as those of a low pass: at most {(solution[1] + half) * charge:.3g} F"
        )
        return
    low, value, high = (float((solution[1] + d) * charge) for d in (-half, 0.0, half))
    found["capacitance_f"] = value, (low, high)

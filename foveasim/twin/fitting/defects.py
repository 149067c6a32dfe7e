"""Defects of pixels: hot ones, dead ones, and those of RTS noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from foveasim._core.validation import Bools, Floats
from foveasim.metrics.photon_transfer import MIN_DARK_DN2
from foveasim.twin.fitting.recording import Recording
from foveasim.twin.fitting.telegraph import TelegraphFit, fit_telegraph
from foveasim.twin.frames.statistics import weighted

__all__ = ["DarkSlopes", "Defects", "find_defects"]

#: Response below which a pixel is dead, and probability that any other pixel is taken for a hot one.
DEAD_RESPONSE, HOT_PROBABILITY = 0.5, 0.01
#: Smallest variance of a pixel in the dark, over the mean one.
MIN_SHOT_RATIO = 0.2


class DarkSlopes(NamedTuple):
    """
    Slopes of dark codes over the exposure time.

    ``dn_per_s``, ``noise_dn2``: (n_y, n_x), and their variances by temporal noise of pixels. ``row_noise_dn2``: that of rows.
    """

    dn_per_s: Floats
    noise_dn2: Floats
    row_noise_dn2: float


@dataclass(frozen=True, eq=False)
class Defects:
    """
    Defects of a recording.

    ``is_hot``, ``is_dead`` (n_y, n_x). ``slopes``: of the dark current, or None without dark stacks of two exposure times and
    one temperature. ``telegraph``: RTS noise in ``telegraph_stack``, or None. ``rts_probability`` (n_y, n_x): of pixels.
    ``step_dn``: difference of its states, in codes at the dark level. ``dark_variance_dn2``: median over pixels, which does not
    contain RTS noise.
    """

    is_hot: Bools
    is_dead: Bools
    slopes: DarkSlopes | None
    telegraph: TelegraphFit | None
    telegraph_stack: int
    rts_probability: Floats
    step_dn: float
    dark_variance_dn2: float


def find_defects(recording: Recording) -> tuple[Recording, Defects]:
    """Return a recording without hot and dead pixels, and what they are."""
    slopes = _dark_slopes(recording)
    is_hot = np.zeros(recording.classes.shape, np.bool_) if slopes is None else _hot_pixels(slopes)
    recording = recording.without(is_hot)
    is_dead = _dead_pixels(recording)
    recording = recording.without(is_dead)
    stack = max(recording.shortest, key=lambda k: recording.statistics[k].n_frames)
    variance_dn2 = float(np.median(recording.statistics[stack].variance_dn2))
    telegraph = None if variance_dn2 < MIN_DARK_DN2 else _telegraph(recording, slopes, stack)
    probability, step_dn = np.zeros(recording.classes.shape), 0.0
    if telegraph is not None:
        probability[recording.good] = telegraph.probability
        code = np.median(recording.statistics[stack].mean_dn)
        step_dn = telegraph.step_dn / float(recording.adc.width_of_code_dn(code))
    return recording, Defects(is_hot, is_dead, slopes, telegraph, stack, probability, step_dn, variance_dn2)


def _dark_slopes(recording: Recording) -> DarkSlopes | None:
    if not recording.has_dark_series or recording.has_temperatures:
        return None
    dark, linear = recording.dark, recording.linear
    times = np.array([recording.lights[k].exposure_s for k in dark])
    n = np.array([recording.statistics[k].n_frames for k in dark], np.float64)
    centre = (n @ times) / n.sum()
    factor = n * (times - centre) / (n @ (times - centre) ** 2)
    slope = weighted(factor, (linear[k].mean_dn for k in dark))
    noise = weighted(factor**2 / n, (linear[k].variance_dn2 for k in dark))
    squares = [linear[k].mean_squares_dn2 for k in dark]
    rows_dn2 = np.array([each["row"] - each["pixel"] for each in squares]) / slope.shape[1]
    return DarkSlopes(slope, noise, max(float((factor**2 / n) @ rows_dn2), 0.0))


def _hot_pixels(slopes: DarkSlopes) -> Bools:
    """Return the pixels above the tail of a log-normal distribution with the quantiles of all."""
    slope = slopes.dn_per_s
    middle, above = np.quantile(slope, (0.5, 0.8413))
    tail = float(ndtri(1.0 - HOT_PROBABILITY / slope.size))
    spread = math.log(max(above, middle) / middle) if middle > 0.0 else 0.0
    noise_dn = math.sqrt(float(np.median(slopes.noise_dn2)))
    return np.asarray(slope > max(middle * math.exp(spread * tail), middle + tail * max(above - middle, noise_dn)))


def _dead_pixels(recording: Recording) -> Bools:
    """Return the pixels that do not respond to light."""
    is_dead = np.zeros(recording.classes.shape, np.bool_)
    signal = recording.linear[recording.brightest].mean_dn - recording.dark_mean_dn
    for c in range(recording.n_classes):
        own = recording.classes == c
        is_dead |= own & (signal < DEAD_RESPONSE * np.median(signal[own]))
    return is_dead


def _telegraph(recording: Recording, slopes: DarkSlopes | None, stack: int) -> TelegraphFit | None:
    """Find RTS noise in linear codes of a dark stack, in which steps are nearly equal."""
    variance_dn2 = recording.linear[stack].variance_dn2
    variance_dn2 /= _shot_ratio(recording, slopes, stack, variance_dn2)
    return fit_telegraph(variance_dn2[recording.good], recording.statistics[stack].n_frames)


def _shot_ratio(
    recording: Recording, slopes: DarkSlopes | None, dark_stack: int, variance_dn2: Floats
) -> Floats | float:
    """Return variances of dark pixels by shot noise of dark current, over the mean one."""
    if slopes is None:
        return 1.0
    own = recording.classes == 0
    dark, lit = recording.linear[dark_stack], recording.linear[recording.brightest]
    rise_dn2 = float(np.median(lit.variance_dn2[own]) - np.median(variance_dn2[own]))
    gain = rise_dn2 / max(float(np.median(lit.mean_dn[own]) - np.median(dark.mean_dn[own])), 1e-9)
    current_dn = np.maximum(slopes.dn_per_s, 0.0) * recording.lights[dark_stack].exposure_s
    current_dn -= current_dn.mean(where=recording.good)
    return np.maximum(1.0 + max(gain, 0.0) / float(np.median(variance_dn2[own])) * current_dn, MIN_SHOT_RATIO)

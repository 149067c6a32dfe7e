"""Parameters of a sensor from stacks: defects, chain, differences between pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy.special import ndtri

from foveasim._core.validation import Bools, Floats, Ints
from foveasim.errors import ParameterError
from foveasim.metrics.photon_transfer import MIN_DARK_DN2
from foveasim.sensor.adc import ADC, QUANTISATION_DN2
from foveasim.twin.frames.chain import Chain, Spread
from foveasim.twin.frames.code_widths import fit_code_widths
from foveasim.twin.frames.dark_current import DarkSpread, fit_dark_spread
from foveasim.twin.frames.intervals import (
    HALF_WIDTH,
    Estimate,
    Uncertain,
    of_fraction,
    of_mean,
    of_squares,
    of_variance,
)
from foveasim.twin.frames.levels import Levels, block_means, class_index
from foveasim.twin.frames.pooled import Exposures, PooledFit, fit_levels
from foveasim.twin.frames.stacks import Stack
from foveasim.twin.frames.statistics import LinearStatistics, StackStatistics, weighted
from foveasim.twin.frames.telegraph import MIN_FRAMES, TelegraphFit, fit_telegraph

__all__ = ["Fitted", "fit_statistics"]

#: Fraction of the variance that shot noise would have, below which a level is close to the full well, and at which it is full.
SATURATING, FULL = 0.6, 0.15
#: Largest part of the saturation of levels for the response of pixels.
LINEAR_FRACTION = 0.8
#: Response below which a pixel is dead, and probability that any other pixel is taken for a hot one.
DEAD_RESPONSE, HOT_PROBABILITY = 0.5, 0.01
#: Standard error of the nonlinearity up to which it is fitted.
MAX_NONLINEARITY_ERROR = 0.1
#: Rounds of the fit, with what differs between pixels from the round before.
ROUNDS = 3
#: Chi-square per degree of freedom from which a fit starts again, and noise and shifts of the black level there, in codes.
UNEXPLAINED, OTHER_SIGMAS, OTHER_SHIFTS = 3.0, (0.2, 0.4), (-0.3, 0.0, 0.3)
#: Fraction of the full well above which the first fit leaves out levels.
CLOSE_FRACTION = 0.85
#: Smallest variance of a pixel in the dark, over the mean one.
MIN_SHOT_RATIO = 0.2
#: Gain above which, and read noise below which, codes of whole electrons are more frequent than those between.
MAX_GAIN, MIN_READ_E = 0.7, 0.6
#: Smallest number of rows and columns.
MIN_LINES = 4
#: Rounds of the means of rows and columns of images with missing pixels.
LINE_ROUNDS = 3
#: Probability of RTS noise from which a pixel is left out of offsets.
MAX_RTS = 0.5
#: Charges of the response by which the signals of hot pixels become charges.
N_CHARGES = 400
#: ADC parameters of a sensor that a fit has to know.
ADC_NAMES = ("companding", "log_strength", "companding_table", "inl_dn")


@dataclass(eq=False)
class Fitted:
    """
    Result of :func:`fit_statistics`.

    ``estimates``: parameters with intervals, or why they are not identifiable. ``maps``: (n_y, n_x) by name. ``levels``,
    ``fit``: statistics and chain. ``assumptions``: what was taken as known. ``temperature_k``: of the dark current, or None.
    """

    estimates: dict[str, Estimate | Uncertain]
    maps: dict[str, Floats]
    levels: Levels
    fit: PooledFit
    assumptions: list[str]
    temperature_k: float | None


def fit_statistics(
    statistics: Sequence[StackStatistics],
    stacks: Sequence[Stack],
    known: Mapping[str, Any],
    mosaic: str | None = None,
) -> Fitted:
    """
    Fit a sensor to the statistics of stacks.

    ``known``: ``bits``, and parameters of the ADC other than linear ones.

    Raises ParameterError when there are no dark stacks, no stacks with light, or the stacks do not differ.
    """
    return _Fit(list(statistics), list(stacks), dict(known), mosaic).run()


@dataclass(frozen=True, eq=False)
class _Start:
    """
    First values of a fit.

    ``light_e``, ``fixed_e`` (n_level,): charges, and those of full levels of unknown light, or NaN. ``is_used``, ``is_close``:
    levels below the highest codes, and those close to the full well.
    """

    values: dict[str, float]
    light_e: Floats
    fixed_e: Floats
    is_used: Bools
    is_close: Bools


class _Fit:
    """The steps of a fit, which share statistics and results so far."""

    def __init__(
        self, statistics: list[StackStatistics], lights: list[Stack], known: dict[str, Any], mosaic: str | None
    ) -> None:
        self.statistics, self.lights, self.known = statistics, lights, known
        self.dark = [k for k, each in enumerate(lights) if each.is_dark]
        self.lit = [k for k, each in enumerate(lights) if not each.is_dark]
        if not self.dark:
            raise ParameterError("frames", "must contain a stack of dark frames: light=0, lens covered")
        if not self.lit:
            raise ParameterError("frames", "must contain stacks with light: the gain follows from their shot noise")
        if min(statistics[0].shape) < MIN_LINES:
            n_y, n_x = statistics[0].shape
            raise ParameterError(
                "frames",
                f"must have at least {MIN_LINES} rows and columns, got {n_x} x {n_y} pixels: intervals are their differences",
            )
        if len({each.temperature_k is None for each in lights}) > 1:
            raise ParameterError("temperature_k", "must be given for all stacks, or for none")
        self.classes = class_index(*statistics[0].shape, mosaic)
        self.n_classes = int(self.classes.max()) + 1
        self.adc = ADC(bits=known["bits"], **{name: known[name] for name in ADC_NAMES if name in known})
        times = sorted({lights[k].exposure_s for k in self.dark})
        self.shortest = [k for k in self.dark if lights[k].exposure_s == times[0]]
        self.has_dark_series = len(times) > 1
        is_linear = self.adc.is_linear
        self.linear = statistics if is_linear else [LinearStatistics.of_codes(each, self.adc) for each in statistics]
        self.assumptions: list[str] = []
        self.estimates: dict[str, Estimate | Uncertain] = {}
        self.maps: dict[str, Floats] = {}
        self.telegraph: TelegraphFit | None = None
        self.step_dn = 0.0
        self.is_used: Bools = np.zeros(0, np.bool_)

    # -- steps ------------------------------------------------------------------------------------------------------

    def run(self) -> Fitted:
        self._find_hot()
        self._find_dead()
        self._find_telegraph()
        spread, fit = Spread(), None
        for k in range(ROUNDS):
            fit = self._fit_chain(spread, fit)
            before, spread = spread, self._measure_pixels(fit)
            if k and spread.is_close(before):
                break
        assert fit is not None
        self._report(fit)
        temperatures = [each.temperature_k for each in self.lights if each.temperature_k is not None]
        lowest_k = min(temperatures, default=None)
        return Fitted(self.estimates, self.maps, self.levels, fit, self.assumptions, lowest_k)

    @property
    def good(self) -> Bools:
        """Pixels that are no defects, (n_y, n_x)."""
        return self.classes >= 0

    def _find_hot(self) -> None:
        """Find pixels with much more dark current than others, by two exposure times."""
        shape = self.statistics[0].shape
        self.is_hot = np.zeros(shape, np.bool_)
        self.dark_slope_dn = self.dark_slope_noise = None
        if not self.has_dark_series or self._temperatures(self.dark) > 1:
            return
        times = np.array([self.lights[k].exposure_s for k in self.dark])
        n = np.array([self.statistics[k].n_frames for k in self.dark], np.float64)
        centre = (n @ times) / n.sum()
        factor = n * (times - centre) / (n @ (times - centre) ** 2)
        slope = weighted(factor, (self.linear[k].mean_dn for k in self.dark))
        noise = weighted(factor**2 / n, (self.linear[k].variance_dn2 for k in self.dark))
        self.dark_slope_dn, self.dark_slope_noise = slope, noise
        squares = [self.linear[k].mean_squares_dn2 for k in self.dark]
        rows_dn2 = np.array([each["row"] - each["pixel"] for each in squares]) / slope.shape[1]
        self.dark_slope_of_rows = max(float((factor**2 / n) @ rows_dn2), 0.0)
        # Above the tail of a log-normal distribution with these quantiles.
        middle, above = np.quantile(slope, (0.5, 0.8413))
        tail = float(ndtri(1.0 - HOT_PROBABILITY / slope.size))
        spread = math.log(max(above, middle) / middle) if middle > 0.0 else 0.0
        noise_dn = math.sqrt(float(np.median(noise)))
        self.is_hot = slope > max(middle * math.exp(spread * tail), middle + tail * max(above - middle, noise_dn))
        self.classes = np.where(self.is_hot, -1, self.classes)

    def _find_dead(self) -> None:
        """Find pixels that do not respond to light."""
        self.is_dead = np.zeros(self.classes.shape, np.bool_)
        dark = self._mean_of(self.shortest)
        best = max(self.lit, key=self._brightness)
        signal = self.linear[best].mean_dn - dark
        for c in range(self.n_classes):
            own = self.classes == c
            self.is_dead |= own & (signal < DEAD_RESPONSE * np.median(signal[own]))
        self.classes = np.where(self.is_dead, -1, self.classes)

    def _brightness(self, k: int) -> float:
        """Return the mean code of a stack that is below the highest codes, otherwise -1."""
        mean = float(np.median(self.statistics[k].mean_dn))
        return mean if mean < LINEAR_FRACTION * (self.adc.n_codes - 1) else -1.0 / (1.0 + mean)

    def _find_telegraph(self) -> None:
        """Find RTS noise in the stack of most dark frames of the shortest exposure."""
        self.telegraph_stack = max(self.shortest, key=lambda k: self.statistics[k].n_frames)
        stack = self.statistics[self.telegraph_stack]
        self.rts_probability = np.zeros(stack.shape)
        if np.median(stack.variance_dn2) < MIN_DARK_DN2:
            return
        # In linear codes: the steps of pixels with different offsets are nearly equal.
        variance_dn2 = self.linear[self.telegraph_stack].variance_dn2
        variance_dn2 /= self._shot_ratio(variance_dn2)
        self.telegraph = fit_telegraph(variance_dn2[self.good], stack.n_frames)
        if self.telegraph is not None:
            self.rts_probability[self.good] = self.telegraph.probability
            self.step_dn = self.telegraph.step_dn / float(self.adc.width_of_code_dn(np.median(stack.mean_dn)))

    def _shot_ratio(self, variance_dn2: Floats) -> Floats | float:
        """Return variances of dark pixels by shot noise of dark current, over the mean one."""
        if self.dark_slope_dn is None:
            return 1.0
        best, own = max(self.lit, key=self._brightness), self.classes == 0
        dark, lit = self.linear[self.telegraph_stack], self.linear[best]
        rise_dn2 = float(np.median(lit.variance_dn2[own]) - np.median(variance_dn2[own]))
        gain = rise_dn2 / max(float(np.median(lit.mean_dn[own]) - np.median(dark.mean_dn[own])), 1e-9)
        current_dn = np.maximum(self.dark_slope_dn, 0.0) * self.lights[self.telegraph_stack].exposure_s
        current_dn -= current_dn.mean(where=self.good)
        return np.maximum(1.0 + max(gain, 0.0) / float(np.median(variance_dn2[own])) * current_dn, MIN_SHOT_RATIO)

    def _fit_chain(self, spread: Spread, before: PooledFit | None) -> PooledFit:
        """
        Fit the chain to the levels of all pixels that are no defects.

        The first fit leaves out levels close to the full well, whose noise depends on the responses of pixels.
        """
        levels = Levels.of(self.statistics, self.classes, 1.0 - self.rts_probability)
        errors = np.full(levels.mean_dn.size, np.nan)
        if self.telegraph is not None:
            levels, errors = self._without_telegraph(levels, before)
        exposures = self._exposures(levels)
        if before is None:
            self.start = start = self._start(levels, exposures)
            clear = np.unique(levels.stack[start.is_used & ~start.is_close])
            self.estimates["dnl_dn"] = fit_code_widths([self.statistics[k].counts for k in clear])
            names, is_used, light_e = dict(start.values), start.is_used & ~start.is_close, start.light_e
            self.well_e = names.pop("full_well_e", None)
        else:
            start, is_used, light_e = self.start, self.start.is_used, self.start.light_e.copy()
            names = self.start_names(before)
            light_e[self.is_used] = before.light_e
            if self.well_e is not None and "full_well_e" not in names:
                names["full_well_e"] = math.nan
        self.is_used, used = is_used, np.flatnonzero(is_used)
        dnl_dn2, dnl_error_dn2 = self._dnl()
        self.levels, self.exposures, self.fixed_e = (
            _selected(replace(levels, variances_dn2=levels.variances_dn2 - dnl_dn2), used),
            _chosen(exposures, used),
            start.fixed_e[used],
        )
        self.chain = Chain(self.known, used.size, spread)
        if math.isnan(names.get("full_well_e", 0.0)):
            assert before is not None
            names["full_well_e"] = self._full_well(before, light_e[used])

        def fit(names: Mapping[str, float]) -> PooledFit:
            return fit_levels(
                self.chain, self.levels, self.exposures, names, light_e[used], fixed_e=self.fixed_e,
                variance_error_dn2=errors[used], common_error_dn2=dnl_error_dn2,
            )  # fmt: skip

        found = fit(names)
        if before is None and found.chi_square > UNEXPLAINED:
            found = min((found, *map(fit, self._other_starts(names))), key=lambda each: each.chi_square)
        bend = "nonlinearity_fraction"
        if bend in names and found.error(bend) > MAX_NONLINEARITY_ERROR:
            self.estimates[bend] = Uncertain(
                "the stacks have too few levels of known light: give their exposure times with a constant light, or photons"
            )
            found = fit({name: value for name, value in self.start_names(found).items() if name != bend})
        return found

    def _other_starts(self, names: Mapping[str, float]) -> list[dict[str, float]]:
        """
        Return first values with other noise and black levels.

        Where noise is small against the codes, the moments of dark frames are periodic in the black level, and the likelihood
        has several maxima.
        """
        width_dn = float(self.adc.width_of_code_dn(self.levels.mean_dn.min()))
        return [
            {
                **names,
                "read_noise_e2": (sigma * width_dn / names["gain_dn_per_e"]) ** 2,
                "black_level_dn": names["black_level_dn"] + shift * width_dn,
            }
            for sigma in OTHER_SIGMAS
            for shift in OTHER_SHIFTS
        ]

    def _dnl(self) -> tuple[float, float]:
        """Return the variance by DNL, which all levels have, and its standard error, DN²."""
        found = self.estimates["dnl_dn"]
        if isinstance(found, Uncertain) or not found.low:
            return 0.0, 0.0
        return found.value**2, (found.high**2 - found.low**2) / (2.0 * HALF_WIDTH)

    def _full_well(self, before: PooledFit, start_e: Floats) -> float:
        """Return the full well with the mean of the highest level, after a fit without it, e-."""
        from scipy.optimize import brentq

        assert self.well_e is not None
        guess = self.well_e * self.start.values["gain_dn_per_e"] / before.values["gain_dn_per_e"]
        highest = int(np.argmax(self.levels.mean_dn))
        names, amounts = self.exposures.light_parameter, self.exposures.light
        rates = np.array([before.values.get(name, math.nan) for name in names])
        light_e = np.where(np.isnan(amounts * rates), start_e, amounts * rates)
        light_e = np.where(np.isnan(self.fixed_e), light_e, self.fixed_e)
        dark_e = before.values.get("dark_e_per_s", 0.0) * self.exposures.exposure_s

        def above(well_e: float) -> float:
            values = {**before.values, "full_well_e": well_e}
            return float(self.chain.moments(values, light_e, dark_e).mean_dn[highest] - self.levels.mean_dn[highest])

        low, high = 0.7 * guess, 1.4 * guess
        return float(brentq(above, low, high, rtol=1e-6)) if above(low) * above(high) < 0.0 else guess

    @staticmethod
    def start_names(fit: PooledFit) -> dict[str, float]:
        """Return the parameters of a fit as start of another."""
        return {name: fit.values[name] for name in fit.names if not name.startswith("level_e_")}

    def _without_telegraph(self, levels: Levels, before: PooledFit | None) -> tuple[Levels, Floats]:
        """
        Return the levels without RTS noise, and the error of the dark variance.

        Pixels have the probability that they are free of RTS noise as weights. The dark variance is that of the mixture.
        """
        assert self.telegraph is not None
        variances, errors = levels.variances_dn2.copy(), np.full(levels.mean_dn.size, np.nan)
        ratios, p = self._slope_ratios(levels, before), self.rts_probability
        masks = (self.classes == c for c in range(self.n_classes))
        missed = [float(np.sum(p * (1.0 - p), where=own) / np.sum(1.0 - p, where=own)) for own in masks]
        for k, (stack, c) in enumerate(zip(levels.stack.tolist(), levels.class_of_level.tolist(), strict=True)):
            if stack == self.telegraph_stack:
                linear_dn2 = np.average(
                    self.linear[stack].variance_dn2, weights=np.where(self.classes == c, 1.0 - p, 0.0)
                )
                measured_dn2 = float(levels.column_dn2[k] + variances[k] @ levels.weights)
                variances[k] += (self.telegraph.noise_dn2 / float(linear_dn2) - 1.0) * measured_dn2
                errors[k] = self.telegraph.noise_error_dn2 / float(linear_dn2) * measured_dn2
            else:
                variances[k] -= missed[c] * 0.25 * (self.step_dn * ratios[k]) ** 2
        return replace(levels, variances_dn2=variances), errors

    def _slope_ratios(self, levels: Levels, before: PooledFit | None) -> Floats:
        """Return slopes of codes by charges over that of the dark level, (n_level,)."""
        widths = self.adc.width_of_code_dn(levels.mean_dn.clip(0.0, self.adc.n_codes - 1.0))
        slopes = 1.0 / widths
        if before is not None:
            slopes[self.is_used] = before.slopes_dn_per_e
            slopes[~self.is_used] = 0.0
        return np.asarray(slopes / slopes[levels.stack == self.telegraph_stack][0])

    def _temperatures(self, stacks: Sequence[int]) -> int:
        return len({self.lights[k].temperature_k for k in stacks})

    def _mean_of(self, stacks: Sequence[int]) -> Floats:
        """Return the mean image of stacks, weighted by their frames, (n_y, n_x) DN."""
        n = np.array([self.statistics[k].n_frames for k in stacks], np.float64)
        return weighted(n / n.sum(), (self.linear[k].mean_dn for k in stacks))

    def _noise_of(self, stacks: Sequence[int]) -> Floats:
        """Return the variance of :meth:`_mean_of` by temporal noise, (n_y, n_x) DN²."""
        n = np.array([self.statistics[k].n_frames for k in stacks], np.float64)
        return weighted(n / n.sum() ** 2, (self.linear[k].variance_dn2 for k in stacks))

    def _exposures(self, levels: Levels) -> Exposures:
        amounts, names = [], []
        for stack, c in zip(levels.stack.tolist(), levels.class_of_level.tolist(), strict=True):
            each = self.lights[stack]
            suffix = f"_of_class_{c}" if self.n_classes > 1 else ""
            if each.is_dark:
                amounts.append(0.0)
            elif each.photons is not None:
                amounts.append(each.photons)
            else:
                amounts.append(math.nan if each.light is None else each.light * each.exposure_s)
            names.append(("qe" if each.photons is not None else "light_e_per_s") + suffix)
        temperature = [math.nan if each.temperature_k is None else each.temperature_k for each in self.lights]
        return Exposures(
            np.array([self.lights[k].exposure_s for k in levels.stack]), np.array(amounts), tuple(names),
            np.array(temperature)[levels.stack],
        )  # fmt: skip

    def _start(self, levels: Levels, exposures: Exposures) -> _Start:
        """Return first values of the fit, by the photon transfer in linear codes."""
        width = self.adc.width_of_code_dn(levels.mean_dn.clip(0.0, self.adc.n_codes - 1.0))
        mean = self.adc.linear_of_code_dn(levels.mean_dn.clip(0.0, self.adc.n_codes - 1.0))
        variance = np.maximum(levels.variance_dn2 - QUANTISATION_DN2, 1e-6) * width**2
        is_dark = exposures.is_dark
        black, noise = float(mean[is_dark].min()), float(variance[is_dark].min())
        signal, shot = mean - black, variance - noise
        ratio = np.where((signal > 0.0) & ~is_dark, shot / np.maximum(signal, 1e-9), np.nan)
        is_clear = ~is_dark & (shot > 2.0 * noise) & (mean < LINEAR_FRACTION * self.adc.n_codes)
        if not is_clear.any():
            is_clear = ~is_dark & (shot > 0.0) & (mean < 0.95 * self.adc.n_codes)
        if not is_clear.any():
            raise ParameterError(
                "frames",
                "must contain levels with shot noise between the dark and the highest code; check light and bits",
            )
        gain = float(np.median(np.sort(ratio[is_clear])[-max(3, int(0.6 * is_clear.sum())) :]))
        top_dn = self.adc.n_codes - 1.0
        is_clipped = levels.mean_dn > top_dn - np.maximum(3.0 * np.sqrt(np.maximum(levels.variance_dn2, 0.0)), 1.0)
        relative = np.where(is_dark, 1.0, ratio / gain)
        highest = float(signal[~is_dark].max())
        is_saturating = ~is_dark & (relative < SATURATING) & (signal > 0.4 * highest) & ~is_clipped
        values: dict[str, float] = {
            "gain_dn_per_e": gain,
            "read_noise_e2": max(noise / gain**2, 1e-3),
            "black_level_dn": black,
        }
        fixed_e = np.full(levels.mean_dn.size, math.nan)
        if is_saturating.any():
            values["full_well_e"] = float(signal[is_saturating].max()) / gain
            full = is_saturating & (relative < FULL) & exposures.is_free
            well = values["full_well_e"]
            fixed_e[full] = 1.5 * well + 10.0 * math.sqrt(well)
        is_used = ~is_clipped
        if not (is_used & is_dark).any():
            raise ParameterError("frames", "must contain dark frames below the highest code; check light and bits")
        known = is_used & ~exposures.is_free & ~is_dark
        for name in sorted({exposures.light_parameter[k] for k in np.flatnonzero(known)}):
            own = [k for k in np.flatnonzero(known & ~is_saturating) if exposures.light_parameter[k] == name]
            own = own or [k for k in np.flatnonzero(known) if exposures.light_parameter[k] == name]
            values[name] = float(np.median(signal[own] / gain / exposures.light[own]))
        if self.has_dark_series:
            times = exposures.exposure_s[is_dark]
            slope = np.polyfit(times, mean[is_dark], 1)[0]
            values["dark_e_per_s"] = max(float(slope) / gain, 0.0)
            if len({each for each in exposures.temperature_k[is_dark] if not math.isnan(each)}) > 1:
                values["dark_doubling_k"] = 8.0
        if len({round(float(x), 12) for x in exposures.light[known]}) >= 3 or np.count_nonzero(is_used & ~is_dark) >= 6:
            values["nonlinearity_fraction"] = 0.0
        light_e = np.maximum(signal / gain, 1.0)
        is_close = ~is_dark & (light_e > CLOSE_FRACTION * values.get("full_well_e", math.inf))
        return _Start(values, light_e, fixed_e, is_used, is_close)

    # -- what differs between pixels --------------------------------------------------------------------------------

    def _measure_pixels(self, fit: PooledFit) -> Spread:
        """Measure offsets, responses and noise of pixels; return their spread."""
        values = fit.values
        used = np.flatnonzero(self.is_used)
        self.gain_dn_per_e = gain = values["gain_dn_per_e"]
        bend_per_e = 2.0 * values.get("nonlinearity_fraction", 0.0) * gain / self.adc.n_codes
        offset, noise = self._mean_of(self.shortest), self._noise_of(self.shortest)
        self.offset_dn = self._centred(offset)
        self.offset_noise = noise
        self.dark_spread = dark = self._dark_spread()
        # Responses: levels below saturation, weighted by their shot noise.
        well = values.get("full_well_e", math.inf)
        bright = [
            k
            for k in range(used.size)
            if fit.light_e[k] > 0.0
            and fit.light_e[k] < LINEAR_FRACTION * well
            and self.levels.mean_dn[k] < LINEAR_FRACTION * (self.adc.n_codes - 1)
            and np.isnan(self.fixed_e[k])
        ]
        line_noise = self._measure_responses(fit, bright, bend_per_e)
        self.has_response = bool(bright)
        self.prnu = self._spatial(self.response, self.response_noise, line_noise)
        self.dsnu = self._spatial(self.offset_dn, noise, self._line_noise())
        response, response_error = self._total(self.prnu)
        total_offset, offset_error = self._total(self.dsnu)
        return Spread(
            response if bright else 0.0,
            total_offset / gain,
            0.0 if dark is None else dark.fraction,
            (response_error, offset_error, 0.0 if dark is None else dark.relative_error),
        )

    def _total(self, parts: Mapping[str, tuple[float, Any]]) -> tuple[float, float]:
        """
        Return the standard deviation of rows, columns and pixels together.

        With its relative error, at most 1.
        """
        total = sum(max(variance, 0.0) for variance, _ in parts.values())
        if total == 0.0:
            return 0.0, 0.0
        errors = [_error(parts["pixel"][1], self.levels.weights)]
        for name in ("row", "column"):
            variance, (square, degrees, _, n) = parts[name]
            errors.append(square / n * math.sqrt(2.0 / max(degrees, 1)) if variance > 0.0 else 0.0)
        return math.sqrt(total), min(0.5 * math.hypot(*errors) / total, 1.0)

    def _currents_dn_per_s(self) -> Floats | None:
        """Return known differences of dark currents from their mean, (n_y, n_x)."""
        if self.dark_spread is None or self.dark_slope_dn is None or self.dark_slope_noise is None:
            return None
        mean_dn_per_s = self.dark_spread.mean * self.gain_dn_per_e
        share = _reliability((self.dark_spread.fraction * mean_dn_per_s) ** 2, self.dark_slope_noise)
        return share * (self.dark_slope_dn - mean_dn_per_s)

    def _measure_responses(self, fit: PooledFit, bright: list[int], bend_per_e: float) -> dict[str, float]:
        """
        Measure responses of pixels by levels, with their variances by temporal noise.

        Returns the temporal part of mean squares of rows and columns.
        """
        gain, classes, currents = self.gain_dn_per_e, self.classes, self._currents_dn_per_s()
        lines = {name: np.zeros(self.n_classes) for name in ("row", "column")}
        response, response_noise = np.zeros(classes.shape), np.zeros(classes.shape)
        of_offset, total = np.zeros(self.n_classes), np.zeros(self.n_classes)
        for k in bright:
            stack, c = self.linear[int(self.levels.stack[k])], int(self.levels.class_of_level[k])
            mean_dn, variance_dn2, own = stack.mean_dn, stack.variance_dn2, classes == c
            slope = 1.0 - bend_per_e * float(fit.light_e[k])
            signal = gain * slope * float(fit.light_e[k])
            weight = signal**2 * stack.n_frames / max(float(variance_dn2.mean(where=own)), 1e-6)
            mean_dn -= float(mean_dn.mean(where=own)) + slope * self.offset_dn
            if currents is not None:
                longer_s = float(self.exposures.exposure_s[k]) - self.lights[self.shortest[0]].exposure_s
                mean_dn -= slope * longer_s * currents
            mean_dn *= own * (weight / signal)
            variance_dn2 *= own * (weight**2 / stack.n_frames / signal**2)
            response += mean_dn
            response_noise += variance_dn2
            squares = stack.mean_squares_dn2
            for name, of_class in lines.items():
                of_class[c] += weight**2 / stack.n_frames / signal**2 * (squares[name] - squares["pixel"])
            of_offset[c] += weight * slope / signal
            total[c] += weight
        # The last one is that of defects, whose class is -1.
        scale = np.append(np.divide(1.0, total, out=np.zeros_like(total), where=total > 0.0), 0.0)[classes]
        self.response = response * scale
        self.response_noise = (
            response_noise * scale**2 + (np.append(of_offset, 0.0)[classes] * scale) ** 2 * self.offset_noise
        )
        has = total > 0.0
        if not has.any():
            return dict.fromkeys(lines, 0.0)
        of_dark, offsets = self._line_noise(), float(((of_offset[has] / total[has]) ** 2).mean())
        return {
            name: float((of_class[has] / total[has] ** 2).mean()) + offsets * of_dark[name]
            for name, of_class in lines.items()
        }

    def _dark_spread(self) -> DarkSpread | None:
        """Return the distribution of the dark current over pixels, in e-/s."""
        if self.dark_slope_dn is None or self.dark_slope_noise is None:
            return None
        gain, good = self.gain_dn_per_e, self.good
        # Noise of rows is common to their pixels, and not in the variances: it is subtracted as far as means of rows show it.
        of_rows, in_row = self.dark_slope_of_rows, np.maximum(good.sum(axis=1, keepdims=True), 1)
        sums = self.dark_slope_dn.sum(axis=1, keepdims=True, where=good)
        middle = float(sums.sum() / good.sum())
        share = of_rows / (of_rows + self.dark_slope_dn.var(where=good) / in_row)
        off = (self.dark_slope_dn - middle - share * (sums / in_row - middle)) / gain
        off /= np.sqrt(1.0 - share * (2.0 - share) / (in_row + 1))
        noise = self.dark_slope_noise + (1.0 - share) * of_rows
        return fit_dark_spread(off[good] + middle / gain, noise[good] / gain**2)

    def _centred(self, values: Floats) -> Floats:
        """Return values less the mean of each class."""
        found = np.zeros(values.shape)
        for c in range(self.n_classes):
            own = self.classes == c
            found[own] = values[own] - values[own].mean()
        return np.where(self.good, found, 0.0)

    def _line_noise(self) -> dict[str, float]:
        """Return the temporal part of the mean squares of lines of the dark mean image, DN²."""
        frames = sum(self.statistics[k].n_frames for k in self.shortest)
        squares = self._mean_squares()
        return {name: (squares[name] - squares["pixel"]) / frames for name in ("row", "column")}

    def _mean_squares(self) -> dict[str, float]:
        """Return the mean squares of lines and pixels over the shortest dark frames, DN²."""
        n = {k: self.statistics[k].n_frames - 1 for k in self.shortest}
        each = {k: self.linear[k].mean_squares_dn2 for k in self.shortest}
        return {part: sum(n[k] * each[k][part] for k in n) / sum(n.values()) for part in ("row", "column", "pixel")}

    def _spatial(
        self, values: Floats, noise: Floats, lines: Mapping[str, float] | None = None
    ) -> dict[str, tuple[float, Any]]:
        """
        Return the variances of rows, columns and pixels, without temporal noise.

        Each with what its interval needs: mean squares and degrees of freedom of rows and columns, block means of pixels.
        """
        good = self.good & (self.rts_probability < MAX_RTS)  # a mean code of two states is not that of the mean
        n_y, n_x = values.shape
        in_row, in_column = np.maximum(good.sum(axis=1), 1), np.maximum(good.sum(axis=0), 1)
        clean = np.where(good, values, 0.0)
        clean -= good * (clean.sum() / good.sum())
        row, column = np.zeros(n_y), np.zeros(n_x)
        for _ in range(LINE_ROUNDS):  # without pixels, means of rows contain columns, and those of columns rows
            row = (clean.sum(axis=1) - good @ column) / in_row
            column = (clean.sum(axis=0) - row @ good) / in_column
        left = np.where(good, clean - row[:, None] - column, 0.0)
        degrees = good.sum() - n_y - n_x + 1
        scale = good.sum() / max(degrees, 1)
        squares = block_means(left**2 * scale - noise, np.where(good, self.classes, -1))
        weights = self.levels.weights
        per_class = (squares @ weights).mean()
        pixel_square = float((left**2).sum()) / max(degrees, 1)
        found: dict[str, tuple[float, Any]] = {"pixel": (float(per_class), squares.mean(axis=0))}
        for name, means, n in (("row", row, n_x), ("column", column, n_y)):
            square, other = n * float(means.var(ddof=1)), pixel_square + (0.0 if lines is None else lines[name])
            found[name] = ((square - other) / n, (square, means.size - 1, other, n))
        return found

    # -- results ----------------------------------------------------------------------------------------------------

    def _report(self, fit: PooledFit) -> None:
        """Collect estimates with intervals, or why they are not identifiable."""
        values, blocks = fit.values, self.levels.weights.size
        found = self.estimates
        found["gain_dn_per_e"] = of_mean(values["gain_dn_per_e"], fit.error("gain_dn_per_e"), blocks, is_log=True)
        found["black_level_dn"] = of_mean(values["black_level_dn"], fit.error("black_level_dn", of_device=True))
        dark = [k for k in range(self.levels.stack.size) if self.exposures.is_dark[k]]
        if float(self.levels.variance_dn2[dark].min()) < MIN_DARK_DN2:
            found["read_noise_e"] = Uncertain(
                f"the dark variance, {self.levels.variance_dn2[dark].min():.2g} DN², is below {MIN_DARK_DN2} DN²: quantisation "
                "hides the noise; use a higher gain"
            )
        else:
            found["read_noise_e"] = of_variance(values["read_noise_e2"], fit.error("read_noise_e2"), blocks)
        if "nonlinearity_fraction" in fit.names:
            found["nonlinearity_fraction"] = of_mean(
                values["nonlinearity_fraction"], fit.error("nonlinearity_fraction"), blocks
            )
        elif "nonlinearity_fraction" not in found:
            found["nonlinearity_fraction"] = Uncertain("it needs six levels, or three of known light")
        if "full_well_e" in fit.names:
            found["full_well_e"] = of_mean(values["full_well_e"], fit.error("full_well_e"), blocks, is_log=True)
        else:
            top = (self.adc.n_codes - 1 - values["black_level_dn"]) / values["gain_dn_per_e"]
            found["full_well_e"] = Uncertain(
                f"no level is limited by it: the codes end at {top:.4g} e-, or the levels are too low"
            )
        if self.n_classes > 1:
            self.assumptions.append(
                "Colours have no spectral curves: sensor() has neutral filters with their responses to the lamp; give filters."
            )
        for name in fit.names:
            if name.startswith(("qe", "dark_doubling_k")):
                found[name] = of_mean(values[name], fit.error(name), blocks, is_log=True)
        self._report_dark(fit)
        self._report_defects(fit)
        self._report_patterns(fit)
        self._report_lines()
        if values["gain_dn_per_e"] > MAX_GAIN and values["read_noise_e2"] < MIN_READ_E**2:
            found["dnl_dn"] = Uncertain("single electrons make some codes more frequent than others")
        if isinstance(found["read_noise_e"], Uncertain):
            names = ("dsnu_e", "dsnu_row_e", "dsnu_column_e", "row_noise_e", "column_noise_e", "rts_fraction", "rts_e")
            found |= dict.fromkeys(names, found["read_noise_e"])
        self._report_maps()

    def _report_maps(self) -> None:
        """Collect maps of pixels, each value in proportion to its reliability."""
        gain = self.gain_dn_per_e
        spread2 = self._total(self.dsnu)[0] ** 2
        offset = self.offset_dn
        currents = self._currents_dn_per_s()
        if currents is not None and self.dark_spread is not None and self.dark_slope_dn is not None:
            current = np.maximum(self.dark_spread.mean + currents / gain, 0.0)
            current[self.is_hot] = np.fmax(self.hot_e_per_s, np.maximum(self.dark_slope_dn[self.is_hot], 0.0) / gain)
            self.maps["dark_e_per_s"] = current
            currents *= -self.lights[self.shortest[0]].exposure_s
            currents += offset
            offset = currents
        response = 1.0 + _reliability(self._total(self.prnu)[0] ** 2, self.response_noise) * self.response
        self.maps |= {
            "offset_e": np.where(self.good, _reliability(spread2, self.offset_noise) * offset, 0.0) / gain,
            "response_fraction": np.where(self.is_dead, 0.0, np.where(self.good, response, 1.0)),
            "noise_e": np.sqrt(np.maximum(self.linear[self.telegraph_stack].variance_dn2, 0.0)) / gain,
            "is_defect": (~self.good).astype(np.float64),
        }

    def _report_dark(self, fit: PooledFit) -> None:
        found, blocks = self.estimates, self.levels.weights.size
        if "dark_e_per_s" not in fit.names:
            reason = "it needs dark stacks of two exposure times"
            found["dark_e_per_s"] = found["dsnu_fraction"] = Uncertain(reason)
            self.assumptions.append(
                "The dark current is part of the black level, as at the exposure time of the dark frames."
            )
            return
        found["dark_e_per_s"] = of_mean(fit.values["dark_e_per_s"], fit.error("dark_e_per_s"), blocks)
        if self.dark_slope_dn is None or self.dark_slope_noise is None:
            found["dsnu_fraction"] = Uncertain("the dark stacks have several temperatures")
            return
        spread = self.dark_spread
        if spread is None:
            noise = math.sqrt(float(self.dark_slope_noise[self.good].mean())) / self.gain_dn_per_e
            found["dsnu_fraction"] = Uncertain(
                f"the noise of the slopes, {noise:.3g} e-/s, hides differences of the dark current: longer dark exposures, or "
                "more frames"
            )
            return
        found["dsnu_fraction"] = Estimate(spread.fraction, spread.low, spread.high)

    def _report_defects(self, fit: PooledFit) -> None:
        found, n = self.estimates, self.classes.size
        hot = int(self.is_hot.sum())
        if self.dark_slope_dn is None:
            found["hot_fraction"] = found["hot_e_per_s"] = Uncertain("it needs dark stacks of two exposure times")
        else:
            found["hot_fraction"] = of_fraction(hot, n)
            own = self._hot_currents(fit)
            self.hot_e_per_s = own
            own = own[~np.isnan(own)] - fit.values.get("dark_e_per_s", 0.0)
            if own.size < 3:
                found["hot_e_per_s"] = Uncertain(f"there are {own.size} hot pixels below saturation")
            else:
                error = math.hypot(
                    float(own.std(ddof=1)) / math.sqrt(own.size), float(own.mean()) * fit.error("gain_dn_per_e")
                )
                found["hot_e_per_s"] = of_mean(float(own.mean()), error, own.size)
        found["dead_fraction"] = of_fraction(int(self.is_dead.sum()), n)
        if self.telegraph is None:
            reason = "no pixels have variances that one distribution does not explain"
            if self.statistics[self.telegraph_stack].n_frames < MIN_FRAMES:
                reason = "it needs four dark frames of one exposure time"
            found["rts_fraction"] = found["rts_e"] = Uncertain(reason)
            return
        each = self.telegraph
        odds = math.log(each.fraction / (1.0 - each.fraction))
        limits = of_mean(odds, each.log_odds_error)[1:]
        found["rts_fraction"] = Estimate(each.fraction, *(1.0 / (1.0 + math.exp(-limit)) for limit in limits))
        gain_error = fit.error("gain_dn_per_e")
        found["rts_e"] = of_mean(self._step_e(fit), math.hypot(each.log_step_error, gain_error), is_log=True)
        self.maps["rts_probability"] = self.rts_probability

    def _step_e(self, fit: PooledFit) -> float:
        """
        Return the difference of charge between the states of RTS noise.

        Their codes, in linear codes by the width at their mean, are a step apart.
        """
        from scipy.optimize import brentq

        assert self.telegraph is not None
        step_dn, gain = self.telegraph.step_dn, self.gain_dn_per_e
        dark_e = np.array([fit.values.get("dark_e_per_s", 0.0) * self.lights[self.telegraph_stack].exposure_s])
        chain = Chain(self.known, 1)

        def code_dn(charge_e: float) -> float:
            values = {**fit.values, "black_level_dn": fit.values["black_level_dn"] + gain * charge_e}
            return float(chain.moments(values, np.zeros(1), dark_e).mean_dn[0])

        def above(step_e: float) -> float:
            upper, lower = code_dn(0.5 * step_e), code_dn(-0.5 * step_e)
            return (upper - lower) * float(self.adc.width_of_code_dn(0.5 * (upper + lower))) - step_dn

        guess = step_dn / gain
        low, high = 0.2 * guess, 5.0 * guess
        return float(brentq(above, low, high, rtol=1e-6)) if above(low) * above(high) < 0.0 else guess

    def _hot_currents(self, fit: PooledFit) -> Floats:
        """Return dark currents of hot pixels below saturation, (n_hot,) e-/s, or NaN."""
        values = fit.values
        top_e = min(values.get("full_well_e", math.inf), 1.1 * self.adc.n_codes / self.gain_dn_per_e)
        charges_e = top_e * np.linspace(0.0, 1.0, N_CHARGES) ** 2
        codes_dn = Chain(self.known, N_CHARGES).moments(values, charges_e, np.zeros(N_CHARGES)).mean_dn
        highest = min(np.interp(CLOSE_FRACTION * top_e, charges_e, codes_dn), CLOSE_FRACTION * (self.adc.n_codes - 1))
        found = np.stack([self.statistics[k].mean_dn[self.is_hot] for k in self.dark])
        times = np.array([self.lights[k].exposure_s for k in self.dark])[:, None]
        n = np.array([self.statistics[k].n_frames for k in self.dark], np.float64)[:, None] * (found < highest)
        off = times - (n * times).sum(axis=0) / np.maximum(n.sum(axis=0), 1.0)
        squares = (n * off**2).sum(axis=0)
        slopes = (n * off * np.interp(found, codes_dn, charges_e)).sum(axis=0) / np.where(
            squares > 0.0, squares, np.nan
        )
        return np.asarray(slopes)

    def _report_patterns(self, fit: PooledFit) -> None:
        found, weights, blocks = self.estimates, self.levels.weights, self.levels.weights.size
        pixel, of_blocks = self.dsnu["pixel"]
        scale = self.gain_dn_per_e**2
        if self.dark_spread is not None:  # differences of the dark current in the shortest exposure
            shortest_s = self.lights[self.shortest[0]].exposure_s
            pixel -= (self.dark_spread.fraction * self.dark_spread.mean * shortest_s * self.gain_dn_per_e) ** 2
        error = math.hypot(_error(of_blocks, weights), 2.0 * pixel * fit.error("gain_dn_per_e"))
        found["dsnu_e"] = of_variance(pixel / scale, error / scale, blocks)
        for name in ("row", "column"):
            _, (square, degrees, pixel_square, n) = self.dsnu[name]
            found[f"dsnu_{name}_e"] = of_squares(square / scale, degrees, pixel_square / scale, n)
        if self.has_response:
            pixel, of_blocks = self.prnu["pixel"]
            found["prnu_fraction"] = of_variance(pixel, _error(of_blocks, weights), blocks)
            for name in ("row", "column"):
                found[f"prnu_{name}_fraction"] = of_squares(*self.prnu[name][1])
        else:
            names = ("prnu_fraction", "prnu_row_fraction", "prnu_column_fraction")
            found |= dict.fromkeys(names, Uncertain("no level is between the dark and the saturation"))

    def _report_lines(self) -> None:
        scale = self.gain_dn_per_e**2
        n_y, n_x = self.classes.shape
        squares = self._mean_squares()
        for name, n, lines in (("row", n_x, n_y), ("column", n_y, n_x)):
            degrees = sum((self.statistics[k].n_frames - 1) * (lines - 1) for k in self.shortest)
            self.estimates[f"{name}_noise_e"] = of_squares(squares[name] / scale, degrees, squares["pixel"] / scale, n)


def _reliability(variance: float, noise: Floats) -> Floats:
    """Return the fraction of the variance of measured values that is real."""
    return np.asarray(variance / np.maximum(variance + noise, 1e-300))


def _error(of_blocks: Floats, weights: Floats) -> float:
    """Return the standard error of a weighted mean of blocks."""
    off = of_blocks - of_blocks @ weights
    n = weights.size
    return math.sqrt(float((weights * off) @ (weights * off)) * n / max(n - 1, 1))


def _selected(levels: Levels, index: Ints) -> Levels:
    """Return some of the levels."""
    names = (each.name for each in fields(Levels) if each.name != "weights")
    return replace(levels, **{name: getattr(levels, name)[index] for name in names})


def _chosen(exposures: Exposures, index: Ints) -> Exposures:
    return Exposures(
        exposures.exposure_s[index], exposures.light[index], tuple(exposures.light_parameter[k] for k in index),
        exposures.temperature_k[index],
    )  # fmt: skip

"""Parameters with intervals, or why they are not identifiable, and maps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats
from foveasim.metrics.photon_transfer import MIN_DARK_DN2
from foveasim.twin.fitting.chain import Chain
from foveasim.twin.fitting.chain_fit import ChainFit
from foveasim.twin.fitting.defects import Defects
from foveasim.twin.fitting.intervals import (
    Estimate,
    Uncertain,
    of_fraction,
    of_mean,
    of_squares,
    of_variance,
)
from foveasim.twin.fitting.pixels import Pixels, block_error, reliability
from foveasim.twin.fitting.recording import Recording
from foveasim.twin.fitting.starts import CLOSE_FRACTION
from foveasim.twin.fitting.telegraph import MIN_FRAMES

__all__ = ["Results"]

#: Estimates by name.
Estimates = dict[str, Estimate | Uncertain]
#: Gain above which, and read noise below which, codes of whole electrons are more frequent than those between.
MAX_GAIN, MIN_READ_E = 0.7, 0.6
#: Charges of the response by which the signals of hot pixels become charges.
N_CHARGES = 400
#: Parameters that quantisation hides with the read noise.
HIDDEN = (
    "dsnu_fraction",
    "dsnu_e",
    "dsnu_row_e",
    "dsnu_column_e",
    "row_noise_e",
    "column_noise_e",
    "rts_fraction",
    "rts_e",
)


@dataclass(frozen=True, eq=False)
class Results:
    """Results of the steps of a fit."""

    recording: Recording
    defects: Defects
    chain: ChainFit
    pixels: Pixels

    @property
    def _blocks(self) -> int:
        return int(self.chain.levels.weights.size)

    def _mean(self, name: str, *, is_log: bool = False) -> Estimate:
        """Return the interval of a parameter of the chain."""
        fit = self.chain.fit
        return of_mean(fit.values[name], fit.error(name), self._blocks, is_log=is_log)

    def estimates(self) -> Estimates:
        """Return the estimates, or why they are not identifiable."""
        fit, chain = self.chain.fit, self.chain
        values = fit.values
        found: Estimates = {"dnl_dn": chain.dnl_dn}
        if values["gain_dn_per_e"] > MAX_GAIN and values["read_noise_e2"] < MIN_READ_E**2:
            found["dnl_dn"] = Uncertain("single electrons make some codes more frequent than others")
        found["gain_dn_per_e"] = self._mean("gain_dn_per_e", is_log=True)
        found["black_level_dn"] = of_mean(values["black_level_dn"], fit.error("black_level_dn", of_device=True))
        found["read_noise_e"] = self._read_noise()
        if "nonlinearity_fraction" in fit.names:
            found["nonlinearity_fraction"] = self._mean("nonlinearity_fraction")
        else:
            found["nonlinearity_fraction"] = chain.bend or Uncertain("it needs six levels, or three of known light")
        if "full_well_e" in fit.names:
            found["full_well_e"] = self._mean("full_well_e", is_log=True)
        else:
            top = (self.recording.adc.n_codes - 1 - values["black_level_dn"]) / values["gain_dn_per_e"]
            found["full_well_e"] = Uncertain(
                f"no level is limited by it: the codes end at {top:.4g} e-, or the levels are too low"
            )
        found |= {
            name: self._mean(name, is_log=True) for name in fit.names if name.startswith(("qe", "dark_doubling_k"))
        }
        found |= self._dark() | self._hot_and_dead() | self._telegraph() | self._patterns() | self._lines()
        if isinstance(found["read_noise_e"], Uncertain):
            found |= dict.fromkeys(HIDDEN, found["read_noise_e"])
        return found

    def assumptions(self) -> list[str]:
        """Return what was taken as known."""
        found = []
        if self.recording.n_classes > 1:
            found.append(
                "Colours have no spectral curves: sensor() has neutral filters with their responses to the lamp; give filters."
            )
        if "dark_e_per_s" not in self.chain.fit.names:
            found.append("The dark current is part of the black level, as at the exposure time of the dark frames.")
        return found

    def maps(self) -> dict[str, Floats]:
        """Return maps of pixels, (n_y, n_x), each value in proportion to its reliability."""
        pixels, good, is_hot = self.pixels, self.recording.good, self.defects.is_hot
        gain, offset, slopes, weights = (
            pixels.gain_dn_per_e,
            pixels.offset_dn,
            self.defects.slopes,
            self.chain.levels.weights,
        )
        found = {}
        if self.defects.telegraph is not None:
            found["rts_probability"] = self.defects.rts_probability
        if pixels.currents_dn_per_s is not None and pixels.dark is not None and slopes is not None:
            current = np.maximum(pixels.dark.mean + pixels.currents_dn_per_s / gain, 0.0)
            current[is_hot] = np.fmax(self._hot_currents, np.maximum(slopes.dn_per_s[is_hot], 0.0) / gain)
            found["dark_e_per_s"] = current
            offset = offset - self._shortest_s * pixels.currents_dn_per_s
        response = 1.0 + reliability(pixels.prnu.total(weights)[0] ** 2, pixels.response_noise) * pixels.response
        own = reliability(pixels.dsnu.total(weights)[0] ** 2, pixels.offset_noise_dn2) * offset
        variance_dn2 = self.recording.linear[self.defects.telegraph_stack].variance_dn2
        return found | {
            "offset_e": np.where(good, own, 0.0) / gain,
            "response_fraction": np.where(self.defects.is_dead, 0.0, np.where(good, response, 1.0)),
            "noise_e": np.sqrt(np.maximum(variance_dn2, 0.0)) / gain,
            "is_defect": (~good).astype(np.float64),
        }

    @property
    def _shortest_s(self) -> float:
        return float(self.recording.lights[self.recording.shortest[0]].exposure_s)

    def _read_noise(self) -> Estimate | Uncertain:
        levels, exposures, fit = self.chain.levels, self.chain.exposures, self.chain.fit
        lowest_dn2 = min(float(levels.variance_dn2[exposures.is_dark].min()), self.defects.dark_variance_dn2)
        if lowest_dn2 < MIN_DARK_DN2:
            return Uncertain(
                f"the dark variance, {lowest_dn2:.2g} DN², is below {MIN_DARK_DN2} DN²: quantisation hides the noise; use a "
                "higher gain"
            )
        return of_variance(fit.values["read_noise_e2"], fit.error("read_noise_e2"), self._blocks)

    def _dark(self) -> Estimates:
        if "dark_e_per_s" not in self.chain.fit.names:
            return dict.fromkeys(
                ("dark_e_per_s", "dsnu_fraction"), Uncertain("it needs dark stacks of two exposure times")
            )
        spread, slopes = self.pixels.dark, self.defects.slopes
        fraction: Estimate | Uncertain
        if slopes is None:
            fraction = Uncertain("the dark stacks have several temperatures")
        elif spread is None:
            noise = math.sqrt(float(slopes.noise_dn2[self.recording.good].mean())) / self.pixels.gain_dn_per_e
            fraction = Uncertain(
                f"the noise of the slopes, {noise:.3g} e-/s, hides differences of the dark current: longer dark exposures, or "
                "more frames"
            )
        else:
            fraction = Estimate(spread.fraction, spread.low, spread.high)
        return {"dark_e_per_s": self._mean("dark_e_per_s"), "dsnu_fraction": fraction}

    def _hot_and_dead(self) -> Estimates:
        n = self.recording.classes.size
        dead = of_fraction(int(self.defects.is_dead.sum()), n)
        if self.defects.slopes is None:
            reason = Uncertain("it needs dark stacks of two exposure times")
            return {"hot_fraction": reason, "hot_e_per_s": reason, "dead_fraction": dead}
        hot = of_fraction(int(self.defects.is_hot.sum()), n)
        own = self._hot_currents[~np.isnan(self._hot_currents)] - self.chain.values.get("dark_e_per_s", 0.0)
        if own.size < 3:
            few = Uncertain(f"there are {own.size} hot pixels below saturation")
            return {"hot_fraction": hot, "hot_e_per_s": few, "dead_fraction": dead}
        mean, gain_error = float(own.mean()), self.chain.fit.error("gain_dn_per_e")
        error = math.hypot(float(own.std(ddof=1)) / math.sqrt(own.size), mean * gain_error)
        return {"hot_fraction": hot, "hot_e_per_s": of_mean(mean, error, own.size), "dead_fraction": dead}

    @cached_property
    def _hot_currents(self) -> Floats:
        """Dark currents of hot pixels below saturation, (n_hot,) e-/s, or NaN."""
        recording, values, adc = self.recording, self.chain.values, self.recording.adc
        top_e = min(values.get("full_well_e", math.inf), 1.1 * adc.n_codes / self.pixels.gain_dn_per_e)
        charges_e = top_e * np.linspace(0.0, 1.0, N_CHARGES) ** 2
        codes_dn = Chain(recording.known, N_CHARGES).moments(values, charges_e, np.zeros(N_CHARGES)).mean_dn
        highest = min(np.interp(CLOSE_FRACTION * top_e, charges_e, codes_dn), CLOSE_FRACTION * (adc.n_codes - 1))
        found = np.stack([recording.statistics[k].mean_dn[self.defects.is_hot] for k in recording.dark])
        times = np.array([recording.lights[k].exposure_s for k in recording.dark])[:, None]
        n_frames = np.array([recording.statistics[k].n_frames for k in recording.dark], np.float64)
        n = n_frames[:, None] * (found < highest)
        off = times - (n * times).sum(axis=0) / np.maximum(n.sum(axis=0), 1.0)
        squares = (n * off**2).sum(axis=0)
        charges = np.interp(found, codes_dn, charges_e)
        return np.asarray((n * off * charges).sum(axis=0) / np.where(squares > 0.0, squares, np.nan))

    def _telegraph(self) -> Estimates:
        each = self.defects.telegraph
        if each is None:
            reason = "no pixels have variances that one distribution does not explain"
            if self.recording.statistics[self.defects.telegraph_stack].n_frames < MIN_FRAMES:
                reason = "it needs four dark frames of one exposure time"
            return dict.fromkeys(("rts_fraction", "rts_e"), Uncertain(reason))
        odds = math.log(each.fraction / (1.0 - each.fraction))
        limits = (1.0 / (1.0 + math.exp(-limit)) for limit in of_mean(odds, each.log_odds_error)[1:])
        step_error = math.hypot(each.log_step_error, self.chain.fit.error("gain_dn_per_e"))
        return {
            "rts_fraction": Estimate(each.fraction, *limits),
            "rts_e": of_mean(self._step_e(each.step_dn), step_error, is_log=True),
        }

    def _step_e(self, step_dn: float) -> float:
        """
        Return the difference of charge between the states of RTS noise.

        In linear codes, by the width at the mean of both states, the variance of a pixel exceeds that of others by that of the
        states, and by their own noise, which companding makes different.
        """
        from scipy.optimize import brentq

        values, gain, adc = self.chain.values, self.pixels.gain_dn_per_e, self.recording.adc
        exposure_s = self.recording.lights[self.defects.telegraph_stack].exposure_s
        dark_e = np.array([values.get("dark_e_per_s", 0.0) * exposure_s])
        chain = Chain(self.recording.known, 1)

        def code(charge_e: float) -> tuple[float, float]:
            shifted = {**values, "black_level_dn": values["black_level_dn"] + gain * charge_e}
            moments = chain.moments(shifted, np.zeros(1), dark_e)
            return float(moments.mean_dn[0]), float(moments.variance_dn2[0])

        _, noise_dn2 = code(0.0)

        def above(step_e: float) -> float:
            (upper, upper_dn2), (lower, lower_dn2) = code(0.5 * step_e), code(-0.5 * step_e)
            excess_dn2 = 0.25 * (upper - lower) ** 2 + 0.5 * (upper_dn2 + lower_dn2) - noise_dn2
            return excess_dn2 * float(adc.width_of_code_dn(0.5 * (upper + lower))) ** 2 - 0.25 * step_dn**2

        guess = step_dn / gain
        low, high = 0.2 * guess, 5.0 * guess
        return float(brentq(above, low, high, rtol=1e-6)) if above(low) * above(high) < 0.0 else guess

    def _patterns(self) -> Estimates:
        pixels, weights, blocks = self.pixels, self.chain.levels.weights, self._blocks
        gain, dsnu, prnu = pixels.gain_dn_per_e, pixels.dsnu, pixels.prnu
        pixel = dsnu.pixel
        if pixels.dark is not None:  # differences of the dark current in the shortest exposure
            pixel -= (pixels.dark.fraction * pixels.dark.mean * self._shortest_s * gain) ** 2
        error = math.hypot(block_error(dsnu.of_blocks, weights), 2.0 * pixel * self.chain.fit.error("gain_dn_per_e"))
        found: Estimates = {"dsnu_e": of_variance(pixel / gain**2, error / gain**2, blocks)}
        for name, line in (("row", dsnu.row), ("column", dsnu.column)):
            found[f"dsnu_{name}_e"] = of_squares(line.square / gain**2, line.degrees, line.other / gain**2, line.n)
        if pixels.has_response:
            found["prnu_fraction"] = of_variance(prnu.pixel, block_error(prnu.of_blocks, weights), blocks)
            found |= {"prnu_row_fraction": of_squares(*prnu.row), "prnu_column_fraction": of_squares(*prnu.column)}
        else:
            names = ("prnu_fraction", "prnu_row_fraction", "prnu_column_fraction")
            found |= dict.fromkeys(names, Uncertain("no level is between the dark and the saturation"))
        return found

    def _lines(self) -> Estimates:
        recording, scale = self.recording, self.pixels.gain_dn_per_e**2
        n_y, n_x = recording.classes.shape
        squares, found = recording.mean_squares_dn2, {}
        for name, n, lines in (("row", n_x, n_y), ("column", n_y, n_x)):
            degrees = sum((recording.statistics[k].n_frames - 1) * (lines - 1) for k in recording.shortest)
            found[f"{name}_noise_e"] = of_squares(squares[name] / scale, degrees, squares["pixel"] / scale, n)
        return dict(found)

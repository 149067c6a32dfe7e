"""Differences between pixels: offsets, responses, dark currents; rows and columns."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from foveasim._core.validation import Bools, Floats
from foveasim.twin.fitting.chain import Spread
from foveasim.twin.fitting.chain_fit import ChainFit
from foveasim.twin.fitting.dark_current import DarkSpread, fit_dark_spread
from foveasim.twin.fitting.defects import Defects
from foveasim.twin.fitting.levels import block_means
from foveasim.twin.fitting.recording import LINEAR_FRACTION, Recording

__all__ = ["LineSquares", "Parts", "Pixels", "block_error", "measure_pixels", "reliability"]

#: Rounds of the means of rows and columns of images with missing pixels.
LINE_ROUNDS = 3
#: Probability of RTS noise from which a pixel is left out of offsets.
MAX_RTS = 0.5


class LineSquares(NamedTuple):
    """
    Mean square of rows or columns of ``n`` pixels.

    Its expectation is ``n`` times their variance plus ``other``, by ``degrees`` of freedom.
    """

    square: float
    degrees: int
    other: float
    n: int

    @property
    def variance(self) -> float:
        """Variance of rows or columns; may be negative."""
        return (self.square - self.other) / self.n


class Parts(NamedTuple):
    """Variances of pixels, in all and in blocks, of rows, and of columns."""

    pixel: float
    of_blocks: Floats
    row: LineSquares
    column: LineSquares

    def total(self, weights: Floats) -> tuple[float, float]:
        """
        Return the standard deviation of rows, columns and pixels together.

        With its relative error, at most 1. ``weights``: of blocks.
        """
        lines = (self.row, self.column)
        total = sum(max(each, 0.0) for each in (self.pixel, *(each.variance for each in lines)))
        if total == 0.0:
            return 0.0, 0.0
        errors = [
            each.square / each.n * math.sqrt(2.0 / max(each.degrees, 1)) if each.variance > 0.0 else 0.0
            for each in lines
        ]
        error = math.hypot(block_error(self.of_blocks, weights), *errors)
        return math.sqrt(total), min(0.5 * error / total, 1.0)


@dataclass(frozen=True, eq=False)
class Pixels:
    """
    Maps of pixels, and their parts.

    ``offset_dn``, ``response`` (n_y, n_x): differences from the mean, with variances ``offset_noise_dn2`` and
    ``response_noise`` by temporal noise. ``has_response``: whether a level is between the dark and saturation. ``dark``:
    distribution of the dark current, or None. ``currents_dn_per_s``: its known differences from the mean, or None. ``dsnu``,
    ``prnu``: parts of offsets, DN², and responses.
    """

    gain_dn_per_e: float
    offset_dn: Floats
    offset_noise_dn2: Floats
    response: Floats
    response_noise: Floats
    has_response: bool
    dark: DarkSpread | None
    currents_dn_per_s: Floats | None
    dsnu: Parts
    prnu: Parts
    spread: Spread


def measure_pixels(recording: Recording, defects: Defects, chain: ChainFit) -> Pixels:
    """Measure offsets, responses and dark currents of pixels, with a fit of the chain."""
    gain, weights = chain.values["gain_dn_per_e"], chain.levels.weights
    offset, noise, line_noise = recording.dark_mean_dn, recording.dark_noise_dn2, recording.line_noise_dn2
    good = recording.good & (
        defects.rts_probability < MAX_RTS
    )  # a mean of two states is not that of the mean, and noisier
    offset_dn = _centred(recording, offset)
    dark = _dark_spread(defects, good, gain)
    currents_dn_per_s = _currents_dn_per_s(defects, dark, gain)
    response, response_noise, response_lines = _responses(recording, chain, offset_dn, noise, currents_dn_per_s)
    prnu = _parts(recording, good, response, response_noise, response_lines or dict.fromkeys(line_noise, 0.0), weights)
    dsnu = _parts(recording, good, offset_dn, noise, line_noise, weights)
    response_spread, response_error = prnu.total(weights)
    offset_spread, offset_error = dsnu.total(weights)
    spread = Spread(
        response_spread if response_lines else 0.0,
        offset_spread / gain,
        0.0 if dark is None else dark.fraction,
        (response_error, offset_error, 0.0 if dark is None else dark.relative_error),
    )
    return Pixels(
        gain,
        offset_dn,
        noise,
        response,
        response_noise,
        response_lines is not None,
        dark,
        currents_dn_per_s,
        dsnu,
        prnu,
        spread,
    )


def _responses(
    recording: Recording, chain: ChainFit, offset_dn: Floats, offset_noise_dn2: Floats, currents_dn_per_s: Floats | None
) -> tuple[Floats, Floats, dict[str, float] | None]:
    """
    Measure responses of pixels by levels below saturation, weighted by their shot noise.

    Returns responses, their variances by temporal noise, and the temporal part of mean squares of rows and columns; None for
    the latter without such levels.
    """
    values, light_e, classes = chain.values, chain.fit.light_e, recording.classes
    gain, n_codes = values["gain_dn_per_e"], recording.adc.n_codes
    bend_per_e = 2.0 * values.get("nonlinearity_fraction", 0.0) * gain / n_codes
    is_bright = (
        (light_e > 0.0)
        & (light_e < LINEAR_FRACTION * values.get("full_well_e", math.inf))
        & (chain.levels.mean_dn < LINEAR_FRACTION * (n_codes - 1))
    )
    lines = {name: np.zeros(recording.n_classes) for name in ("row", "column")}
    response, response_noise = np.zeros(classes.shape), np.zeros(classes.shape)
    of_offset, total = np.zeros(recording.n_classes), np.zeros(recording.n_classes)
    for k in np.flatnonzero(is_bright):
        stack, c = recording.linear[int(chain.levels.stack[k])], int(chain.levels.class_of_level[k])
        mean_dn, variance_dn2, own = stack.mean_dn, stack.variance_dn2, classes == c
        slope = 1.0 - bend_per_e * float(light_e[k])
        signal = gain * slope * float(light_e[k])
        weight = signal**2 * stack.n_frames / max(float(variance_dn2.mean(where=own)), 1e-6)
        mean_dn -= float(mean_dn.mean(where=own)) + slope * offset_dn
        if currents_dn_per_s is not None:
            longer_s = float(chain.exposures.exposure_s[k]) - recording.lights[recording.shortest[0]].exposure_s
            mean_dn -= slope * longer_s * currents_dn_per_s
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
    noise = response_noise * scale**2 + (np.append(of_offset, 0.0)[classes] * scale) ** 2 * offset_noise_dn2
    has = total > 0.0
    if not has.any():
        return response * scale, noise, None
    of_dark, offsets = recording.line_noise_dn2, float(((of_offset[has] / total[has]) ** 2).mean())
    of_lines = {
        name: float((of_class[has] / total[has] ** 2).mean()) + offsets * of_dark[name]
        for name, of_class in lines.items()
    }
    return response * scale, noise, of_lines


def _dark_spread(defects: Defects, good: Bools, gain: float) -> DarkSpread | None:
    """Return the distribution of the dark current over good pixels, in e-/s."""
    if defects.slopes is None:
        return None
    slopes = defects.slopes
    # Noise of rows is common to their pixels, and not in the variances: it is subtracted as far as means of rows show it.
    of_rows, in_row = slopes.row_noise_dn2, np.maximum(good.sum(axis=1, keepdims=True), 1)
    sums = slopes.dn_per_s.sum(axis=1, keepdims=True, where=good)
    middle = float(sums.sum() / good.sum())
    share = of_rows / (of_rows + slopes.dn_per_s.var(where=good) / in_row)
    off = (slopes.dn_per_s - middle - share * (sums / in_row - middle)) / gain
    off /= np.sqrt(1.0 - share * (2.0 - share) / (in_row + 1))
    noise = slopes.noise_dn2 + (1.0 - share) * of_rows
    return fit_dark_spread(off[good] + middle / gain, noise[good] / gain**2)


def _currents_dn_per_s(defects: Defects, dark: DarkSpread | None, gain: float) -> Floats | None:
    """Return known differences of dark currents from their mean, (n_y, n_x)."""
    if dark is None or defects.slopes is None:
        return None
    mean_dn_per_s = dark.mean * gain
    share = reliability((dark.fraction * mean_dn_per_s) ** 2, defects.slopes.noise_dn2)
    return share * (defects.slopes.dn_per_s - mean_dn_per_s)


def _centred(recording: Recording, values: Floats) -> Floats:
    """Return values less the mean of each class, 0 for defects."""
    found = np.zeros(values.shape)
    for c in range(recording.n_classes):
        own = recording.classes == c
        found[own] = values[own] - values[own].mean()
    return found


def _parts(
    recording: Recording, good: Bools, values: Floats, noise: Floats, lines: Mapping[str, float], weights: Floats
) -> Parts:
    """
    Return the variances of rows, columns and pixels, without temporal noise.

    ``good``: pixels that are used. ``lines``: temporal part of the mean squares of rows and columns. ``weights``: of blocks.
    """
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
    squares = block_means(left**2 * scale - noise, np.where(good, recording.classes, -1))
    pixel_square = float((left**2).sum()) / max(degrees, 1)
    found = {
        name: LineSquares(n * float(means.var(ddof=1)), means.size - 1, pixel_square + lines[name], n)
        for name, means, n in (("row", row, n_x), ("column", column, n_y))
    }
    return Parts(float((squares @ weights).mean()), squares.mean(axis=0), **found)


def reliability(variance: float, noise: Floats) -> Floats:
    """Return the fraction of the variance of measured values that is real."""
    return np.asarray(variance / np.maximum(variance + noise, 1e-300))


def block_error(of_blocks: Floats, weights: Floats) -> float:
    """Return the standard error of a weighted mean of blocks."""
    off = of_blocks - of_blocks @ weights
    n = weights.size
    return math.sqrt(float((weights * off) @ (weights * off)) * n / max(n - 1, 1))

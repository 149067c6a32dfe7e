"""Means and variances of levels by the sensor chain, for the parameters of a fit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats
from foveasim.layout.generators.grid import grid
from foveasim.sensor import Sensor
from foveasim.sensor.adc import ADC, QUANTISATION_DN2
from foveasim.sensor.effects.measured import OffsetMap
from foveasim.sensor.published.datasheet import SWING_V

__all__ = ["Chain", "Spread"]

#: Pixels that represent all: a lattice of rank 1, whose responses, offsets and dark currents are equally probable each, and the
#: steps of the lattice with the smallest correlations.
N_PIXELS, LATTICE = 31, (1, 22, 10)
#: Parts of the probability of the lowest and highest response at which these pixels are divided: the few pixels that are not
#: full determine the variance of levels above the full well.
TAIL = (1 / 256, 1 / 64, 1 / 16, 1 / 4, 1 / 2)
#: Relative difference of spreads up to which they have the same effect.
SAME_SPREAD = 0.02
#: Standard deviation of noise, in codes, from which quantisation adds the variance of a uniform distribution.
SMOOTH_SIGMA = 2.0
#: Variance of the noise, e-², below which moments continue as straight lines: codes of whole electrons without noise are steps.
SMOOTH_E2 = 0.25
#: Largest nonlinearity in a search.
MAX_BEND = 0.45
#: Standard deviations of the charge below the full well from which it matters, and a full well that does not, e-.
MARGIN_SIGMAS, LARGEST_E = 12.0, 1e12


@dataclass(frozen=True)
class Spread:
    """
    Standard deviations over pixels.

    Those of response and dark current are relative to their means, that of offsets is in e-.
    """

    response_fraction: float = 0.0
    offset_e: float = 0.0
    dark_fraction: float = 0.0
    #: Relative errors of the three.
    errors: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def deviating(self) -> list[Spread]:
        """Return the spreads that are one standard error larger in one of the three."""
        names = ("response_fraction", "offset_e", "dark_fraction")
        return [
            replace(self, **{name: getattr(self, name) * (1.0 + error)})
            for name, error in zip(names, self.errors, strict=True)
            if error and getattr(self, name)
        ]

    def is_close(self, other: Spread) -> bool:
        """Whether another spread has nearly the same effect."""
        mine, others = ((each.response_fraction, each.offset_e, each.dark_fraction) for each in (self, other))
        return bool(np.allclose(mine, others, rtol=SAME_SPREAD))

    @cached_property
    def pixels(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Responses, offsets (e-), factors of dark current, and weights, (n,) each."""
        if not (self.response_fraction or self.offset_e or self.dark_fraction):
            return np.ones(1), np.zeros(1), np.ones(1), np.ones(1)
        normal, weights = _lattice() if self.response_fraction else _lattice(())
        response, offset, dark = normal
        sigma = math.sqrt(math.log1p(self.dark_fraction**2))
        factor = np.exp(sigma * dark)
        responses = np.maximum(1.0 + self.response_fraction * response, 0.0)
        return responses, self.offset_e * offset, factor / (factor @ weights), weights


@cache
def _lattice(tail_fraction: tuple[float, ...] = TAIL) -> tuple[Floats, Floats]:
    """Return normal numbers of pixels, (3, n), and their weights, (n,)."""
    k = np.arange(N_PIXELS)
    parts = np.array([0.0, *tail_fraction, 1.0]) / N_PIXELS
    edges = np.concatenate((parts, k[2:-1] / N_PIXELS, 1.0 - parts[::-1]))
    weights = np.diff(edges)
    pixel = np.concatenate((np.zeros(parts.size - 1, np.int64), k[1:-1], np.full(parts.size - 1, k[-1])))
    normal = ndtri((np.multiply.outer(LATTICE, pixel) % N_PIXELS + 0.5) / N_PIXELS)
    normal[0] = -np.diff(np.exp(-0.5 * ndtri(edges) ** 2)) / weights  # means between the edges, but for a factor
    normal -= (normal @ weights)[:, None]
    return normal / np.sqrt(normal**2 @ weights)[:, None], weights


class Moments(NamedTuple):
    """
    Moments of codes at several levels.

    ``mean_dn``, ``variance_dn2``, ``slope_dn_per_e`` (n_level,): in the mean over pixels; the slope is that of the mean code by
    the charge. ``of_pixels`` (2 n_level, n): means, then variances, of pixels that represent all, with ``weights`` (n,).
    """

    mean_dn: Floats
    variance_dn2: Floats
    slope_dn_per_e: Floats
    of_pixels: Floats
    weights: Floats

    @property
    def statistics(self) -> Floats:
        """Means, then variances, (2 n_level,)."""
        return np.concatenate((self.mean_dn, self.variance_dn2))

    def sampling(self) -> Floats:
        """Return the covariance of statistics over pixels, (2 n_level, 2 n_level)."""
        off = self.of_pixels - self.statistics[:, None]
        return np.asarray((self.weights * off) @ off.T)


@dataclass(frozen=True, eq=False)
class Chain:
    """
    Chain of a sensor for pixels at several levels.

    ``known``: parameters of its ADC.
    """

    known: Mapping[str, Any]
    n_levels: int
    spread: Spread = Spread()

    @cached_property
    def _layouts(self) -> dict[int, Any]:
        """Layouts of the numbers of pixels so far."""
        return {}

    @cached_property
    def adc(self) -> ADC:
        """ADC of the sensor."""
        return ADC(**self.known)

    @property
    def n_codes(self) -> int:
        """Number of codes."""
        return self.adc.n_codes

    def parameters(self, values: Mapping[str, float]) -> dict[str, Any]:
        """Return parameters of a sensor for those of a fit."""
        return dict(self.known) | {
            "gain_dn_per_e": values["gain_dn_per_e"],
            "v_sat_v": SWING_V,
            "pedestal_v": SWING_V * max(values["black_level_dn"] + 0.5, 0.0) / self.n_codes,
            "read_noise_e": math.sqrt(max(values["read_noise_e2"], SMOOTH_E2)),
            "nonlinearity_fraction": min(max(values.get("nonlinearity_fraction", 0.0), -MAX_BEND), MAX_BEND),
        }

    def _step_dn(self, parameters: Mapping[str, Any]) -> int:
        """
        Return the width of codes of a coarser ADC that gives the same moments, a power of 2.

        Noise over ``SMOOTH_SIGMA`` codes has the moments of the voltage, but for ``QUANTISATION_DN2``, to 1e-30: means and
        variances of finer codes follow from those of coarser ones, which are fewer.
        """
        if not self.adc.is_linear:
            return 1
        sigma_dn = parameters["gain_dn_per_e"] * parameters["read_noise_e"]
        return int(2 ** max(math.floor(math.log2(max(sigma_dn / SMOOTH_SIGMA, 1.0))), 0))

    def moments(self, values: Mapping[str, float], light_e: Floats, dark_e: Floats) -> Moments:
        """Return the moments of codes for charges of light and dark current, (n_level,) e- each."""
        responses, offset_e, factors, weights = self.spread.pixels
        signed_e = (np.outer(light_e, responses) + np.outer(dark_e, factors)).ravel()
        offsets_e, well_e = np.tile(offset_e, self.n_levels), values.get("full_well_e", math.inf)
        index, share, well = np.arange(signed_e.size), np.ones(signed_e.size), np.full(signed_e.size, LARGEST_E)
        is_near = signed_e + MARGIN_SIGMAS * np.sqrt(np.maximum(signed_e, 1.0)) > well_e
        if is_near.any():
            # Charges are whole electrons, and full wells, too: between two of them, moments are interpolated.
            near, fraction = np.flatnonzero(is_near), well_e - math.floor(well_e)
            index, share = np.concatenate((index, near)), np.concatenate((share, np.full(near.size, fraction)))
            share[near], well[near] = 1.0 - fraction, math.floor(well_e)
            well = np.concatenate((well, np.full(near.size, math.floor(well_e) + 1.0)))
        signed_e = signed_e[index]
        charge_e = np.maximum(signed_e, 0.0)
        if charge_e.size not in self._layouts:
            self._layouts[charge_e.size] = grid(n_x=charge_e.size, n_y=1, pitch_um=1.0)
        effects = [OffsetMap(offsets_e[index])] if np.any(offset_e) else []
        parameters = self.parameters(values) | {"full_well_e": well}
        step = self._step_dn(parameters)
        parameters |= {
            "bits": parameters["bits"] - step.bit_length() + 1,
            "gain_dn_per_e": values["gain_dn_per_e"] / step,
        }
        sensor = Sensor(self._layouts[charge_e.size], effects=effects, **parameters)
        mean, variance = sensor.predict(charge_e)
        mean, variance = step * (mean + 0.5) - 0.5, step**2 * (variance - QUANTISATION_DN2) + QUANTISATION_DN2
        slope = step * np.broadcast_to(sensor.linearise(charge_e).gain_dn_per_e, charge_e.size)
        # Estimates of a dark current or a noise of 0 are negative for half of the devices: moments continue as straight lines.
        mean = mean + slope * (signed_e - charge_e)
        variance = variance + slope**2 * (signed_e - charge_e + min(values["read_noise_e2"] - SMOOTH_E2, 0.0))
        means, variances, slopes = (
            np.bincount(index, share * each).reshape(self.n_levels, -1) for each in (mean, variance, slope)
        )
        return Moments(
            means @ weights, variances @ weights, slopes @ weights, np.concatenate((means, variances)), weights
        )

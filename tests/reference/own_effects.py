"""Effects of a user, one of each kind, for tests that combine them with features of the package."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import bdtr

from foveasim.sensor.effects import AdditiveNoise, Collection, Effect, FixedFactor, GroupedNoise


@dataclass(frozen=True)
class CornerLoss(FixedFactor):
    """Transmission that falls with the square of the distance from the origin."""

    name = "corner_loss"
    stage = "photo"

    loss: float
    radius_um: float

    def pattern(self, sites):
        """Return the transmission of every site."""
        radius_um = np.hypot(*sites.layout.centroid_um.T)
        return 1.0 - self.loss * np.minimum(radius_um / self.radius_um, 1.0) ** 2


@dataclass(frozen=True)
class StitchedGain(FixedFactor):
    """Two gains, left and right of the origin, cached under names."""

    name = "stitched_gain"
    stage = "sense_node"

    left: float
    right: float

    def pattern(self, sites):
        """Return the gain of every site."""
        halves = [
            sites.cached(
                (self, "half " + str(half)), lambda each, half=half: (each.layout.centroid_um[:, 0] > 0) == half
            )
            for half in (False, True)
        ]
        return np.where(halves[0], self.left, 0.0) + np.where(halves[1], self.right, 0.0)


@dataclass(frozen=True)
class ResetSag(AdditiveNoise):
    """Noise of the reset level, in volts, drawn once per reset."""

    name = "reset_sag"
    stage = "sense_node"
    is_drawn_at_reset = True

    sigma_v: float

    def deviation(self, sites):
        """Return the standard deviation, V."""
        return self.sigma_v


@dataclass(frozen=True)
class LineNoise(GroupedNoise):
    """Temporal noise common to the sites of one band of 5 µm, V."""

    name = "line_noise"
    stage = "output"

    sigma_v: float

    def deviation(self, sites):
        """Return the standard deviation, V."""
        return self.sigma_v

    def groups(self, sites):
        """Return the band of every site."""
        return np.floor(sites.layout.centroid_um[:, 1] / 5.0).astype(int)


@dataclass(frozen=True)
class AfterGlow(Effect):
    """Charge proportional to the expected charge, before collection."""

    name = "after_glow"
    stage = "expected"
    is_temporal = False

    fraction: float

    def apply(self, values, *, sites, rng):
        """Return the charges with their glow."""
        return values * (1.0 + self.fraction)

    def moments(self, mean, variance, *, sites):
        """Scale the moments."""
        return mean * (1.0 + self.fraction), variance * (1.0 + self.fraction) ** 2


@dataclass(frozen=True)
class RowNoise(GroupedNoise):
    """Temporal noise of each readout line, in the unit of its stage."""

    sigma: float = 30.0
    stage: str = "charge"
    name: str = "row_noise"

    def deviation(self, sites):
        """Return the standard deviation."""
        return self.sigma


@dataclass(frozen=True)
class Gates(Collection):
    """Binary gates: at most one count in each."""

    name = "gates"
    needs_layout = False

    n_gates: int = 100

    def cumulative(self, count, mean, *, sites):
        """Return the binomial distribution."""
        return bdtr(np.minimum(count, self.n_gates), self.n_gates, -np.expm1(-mean / self.n_gates))

    def moments(self, mean, variance, *, sites):
        """Return mean and variance of the counts."""
        dark = np.exp(-mean / self.n_gates)
        return self.n_gates * (1.0 - dark), variance * dark**2 + self.n_gates * dark * (1.0 - dark)


OWN_EFFECTS = {each.name: each for each in (CornerLoss, StitchedGain, ResetSag, LineNoise, AfterGlow)}

"""Temporal noise of the readout: reset (kTC), read and random telegraph (RTS) noise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, cast

import numpy as np

from foveasim._core.calls import FRACTION, NOT_NEGATIVE, Declared
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats
from foveasim.sensor.effects.contract import AdditiveNoise, Sites, Stage
from foveasim.units import BOLTZMANN_J_PER_K, ELEMENTARY_CHARGE_C

__all__ = ["ReadNoise", "ResetNoise", "TelegraphNoise"]


@dataclass(frozen=True)
class ResetNoise(Declared, AdditiveNoise):
    """
    Reset (kTC) noise: thermal noise of the reset switch, stored on the sense node.

    Parameters
    ----------
    temperature_k : float, K
    """

    example: ClassVar[Mapping[str, Any]] = {"ktc_noise": True}
    name: ClassVar[str] = "reset"
    stage: ClassVar[Stage] = "charge"
    is_drawn_at_reset: ClassVar[bool] = True
    needs_layout: ClassVar[bool] = False

    temperature_k: Annotated[float, NOT_NEGATIVE]

    def deviation(self, sites: Sites) -> Floats:
        """Return ``sqrt(k T C) / q``, (n,) or (1,) e-."""
        return np.asarray(np.sqrt(BOLTZMANN_J_PER_K * self.temperature_k * sites.capacitance_f) / ELEMENTARY_CHARGE_C)


@dataclass(frozen=True, eq=False)
class ReadNoise(Declared, AdditiveNoise):
    """
    Gaussian read noise.

    Parameters
    ----------
    read_noise_e : float or (n_site,), e-
        Standard deviation, referred to the charge.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> sensor = fs.Sensor(fs.layout.grid(n_x=8, n_y=8, pitch_um=3.0), read_noise_e=3.0)
    >>> next(
    ...     effect
    ...     for effect in sensor.chain
    ...     if isinstance(effect, fs.sensor.effects.ReadNoise)
    ... )
    ReadNoise(read_noise_e=3.0)
    """

    example: ClassVar[Mapping[str, Any]] = {"read_noise_e": 12.0}
    name: ClassVar[str] = "read"
    stage: ClassVar[Stage] = "charge"
    needs_layout: ClassVar[bool] = False

    read_noise_e: Annotated[float | Floats, NOT_NEGATIVE]

    __repr__ = short_repr

    def deviation(self, sites: Sites) -> float | Floats:
        """Return the standard deviation, (n,) or one number, e-."""
        return self.read_noise_e


@dataclass(frozen=True)
class TelegraphNoise(Declared, AdditiveNoise):
    """
    Random telegraph signal (RTS) noise: two equally probable states on some sites.

    The state of each affected site is drawn for each frame.

    Parameters
    ----------
    rts_fraction : float
        Probability that a site has RTS noise.
    rts_e : float, e-
        Difference between the two states.

    Notes
    -----
    The variance is ``rts_e² / 4`` on RTS sites. Averaged over all devices it is ``rts_fraction * rts_e² / 4`` on each site.
    """

    example: ClassVar[Mapping[str, Any]] = {"rts_fraction": 0.3, "rts_e": 60.0}
    name: ClassVar[str] = "rts"
    stage: ClassVar[Stage] = "charge"
    is_defect: ClassVar[bool] = True
    needs_layout: ClassVar[bool] = False

    rts_fraction: Annotated[float, FRACTION]
    rts_e: Annotated[float, NOT_NEGATIVE]

    def deviation(self, sites: Sites) -> float | Floats:
        """
        Return half the difference between the states, 0 on other sites, (n,) e-.

        Without a device: its RMS value over all devices.
        """
        if sites.known_device is None:
            return 0.5 * self.rts_e * math.sqrt(self.rts_fraction)
        return np.where(sites.device.uniforms(self.name) < self.rts_fraction, 0.5 * self.rts_e, 0.0)

    def half_step(self, sites: Sites) -> Floats:
        """Return half the difference between the states of the device, 0 on other sites, (n,) e-."""
        return sites.pattern(self, self.deviation)

    def apply(self, values: Floats, *, sites: Sites, rng: np.random.Generator) -> Floats:
        """Return the values plus or minus half the difference of the states on RTS sites."""
        rts_sites = sites.cached((self, "sites"), lambda all_sites: np.flatnonzero(self.half_step(all_sites)))
        # Without its layout, the effect has ranges of sites only.
        first, end, _ = cast("slice", sites.index).indices(sites.layout.n_sites)
        where = rts_sites[slice(*np.searchsorted(rts_sites, (first, end)))] - first
        values[where] += np.copysign(0.5 * self.rts_e, rng.random(where.size) - 0.5)
        return values

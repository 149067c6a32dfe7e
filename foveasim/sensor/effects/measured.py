"""Measured patterns of a device, and temporal noise of its rows and columns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, cast

import numpy as np

from foveasim._core.calls import NOT_NEGATIVE, Declared, Limits
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, Ints
from foveasim.errors import SimulationError
from foveasim.sensor.effects.contract import (
    EFFECTS,
    AdditiveNoise,
    FixedFactor,
    FixedOffset,
    GroupedNoise,
    Sites,
    Stage,
)
from foveasim.sensor.limits import NOISE

__all__ = ["ColumnNoise", "OffsetMap", "ResponseMap", "RowNoise", "TelegraphMap"]

#: Offsets of either sign.
SIGNED = Limits(low=-NOISE.high, at_most=NOISE.high, hint=NOISE.hint)


@EFFECTS.register("response_map", example={"response_fraction": 0.9})
@dataclass(frozen=True, eq=False)
class ResponseMap(Declared, FixedFactor):
    """
    Measured response of each site to light, relative to the quantum efficiency.

    Parameters
    ----------
    response_fraction : float or (n_site,)
        Factors, of mean 1 for a device whose quantum efficiency is a mean over its sites.
    """

    name: ClassVar[str] = "response_map"
    stage: ClassVar[Stage] = "photo"

    response_fraction: Annotated[float | Floats, NOT_NEGATIVE]

    __repr__ = short_repr

    def pattern(self, sites: Sites) -> float | Floats:
        """Return the factors, (n,) or one number."""
        return self.response_fraction


@EFFECTS.register("offset_map", example={"offset_e": 3.0})
@dataclass(frozen=True, eq=False)
class OffsetMap(Declared, FixedOffset):
    """
    Measured offset of each site in dark frames.

    Parameters
    ----------
    offset_e : float or (n_site,), e-
        Offsets from the black level, of either sign, in addition to the dark current.
    """

    name: ClassVar[str] = "offset_map"
    stage: ClassVar[Stage] = "charge"

    offset_e: Annotated[float | Floats, SIGNED]

    __repr__ = short_repr

    def pattern(self, sites: Sites) -> float | Floats:
        """Return the offsets, (n,) or one number, e-."""
        return self.offset_e


@EFFECTS.register("telegraph_map", example={"step_e": 40.0})
@dataclass(frozen=True, eq=False)
class TelegraphMap(Declared, AdditiveNoise):
    """
    Random telegraph signal (RTS) noise with measured steps: two equally probable states.

    Parameters
    ----------
    step_e : float or (n_site,), e-
        Difference between the two states of each site; 0 for sites without RTS noise.
    """

    name: ClassVar[str] = "telegraph_map"
    stage: ClassVar[Stage] = "charge"

    step_e: Annotated[float | Floats, NOISE]

    __repr__ = short_repr

    def deviation(self, sites: Sites) -> Floats:
        """Return half the difference between the states, (n,) or one number, e-."""
        return 0.5 * np.asarray(self.step_e)

    def half_step(self, sites: Sites) -> Floats:
        """Return half the difference between the states, (n,) or (1,) e-."""
        return sites.pattern(self, self.deviation)

    def apply(self, values: Floats, *, sites: Sites, rng: np.random.Generator) -> Floats:
        """Return the values plus or minus half the difference of the states."""
        values += np.copysign(self.half_step(sites), rng.random(values.size) - 0.5)
        return values


@dataclass(frozen=True)
class _LineNoise(Declared, GroupedNoise):
    """Gaussian temporal noise of rows or columns of sites."""

    stage: ClassVar[Stage] = "charge"
    column: ClassVar[str]

    noise_e: Annotated[float, NOISE]

    def deviation(self, sites: Sites) -> float:
        """Return the standard deviation, e-."""
        return self.noise_e

    def groups(self, sites: Sites) -> Ints:
        """Return the row or column of each site, (n,)."""
        if self.column not in sites.layout.columns:
            raise SimulationError(
                f"the effect '{self.name}' requires the {self.column} of each site, but the layout has no column "
                f"'{self.column}'; add it with Layout.with_columns"
            )
        return cast("Ints", sites.select(sites.layout.columns[self.column]))


@EFFECTS.register("row_noise", example={"noise_e": 3.0})
class RowNoise(_LineNoise):
    """
    Temporal noise that the sites of a row share: their column ``row`` of the layout.

    Parameters
    ----------
    noise_e : float, e-
        Standard deviation, referred to the charge.
    """

    name: ClassVar[str] = "row_noise"
    column: ClassVar[str] = "row"


@EFFECTS.register("column_noise", example={"noise_e": 3.0})
class ColumnNoise(_LineNoise):
    """
    Temporal noise that the sites of a column share: their column ``column`` of the layout.

    Parameters
    ----------
    noise_e : float, e-
        Standard deviation, referred to the charge.
    """

    name: ClassVar[str] = "column_noise"
    column: ClassVar[str] = "column"

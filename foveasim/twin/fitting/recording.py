"""Statistics of the stacks of a camera, with their light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.threads import cached_property
from foveasim._core.validation import Bools, Floats
from foveasim.errors import ParameterError
from foveasim.sensor.adc import ADC
from foveasim.twin.fitting.levels import class_index
from foveasim.twin.frames.stacks import Stack
from foveasim.twin.frames.statistics import LinearStatistics, StackStatistics, weighted

__all__ = ["Recording"]

#: Largest part of the highest code for levels below saturation.
LINEAR_FRACTION = 0.8
#: Smallest number of rows and columns.
MIN_LINES = 4


@dataclass(frozen=True, eq=False)
class Recording:
    """
    Stacks of a camera.

    ``statistics``, ``linear``: in codes, and in linear codes. ``lights``: exposure times and light. ``known``: bits, and the
    ADC other than a linear one. ``classes`` (n_y, n_x): colour of each pixel of ``n_classes``, -1 for defects.
    """

    statistics: list[StackStatistics]
    linear: Sequence[Any]
    lights: Sequence[Stack]
    known: Mapping[str, Any]
    adc: ADC
    classes: NDArray[np.int8]
    n_classes: int

    @classmethod
    def of(
        cls,
        statistics: list[StackStatistics],
        lights: Sequence[Stack],
        known: Mapping[str, Any],
        mosaic: str | None,
    ) -> Recording:
        """
        Return the recording of stacks.

        Raises ParameterError when there are no dark stacks, no stacks with light, too few pixels, or temperatures of some only.
        """
        if all(not each.is_dark for each in lights):
            raise ParameterError("frames", "must contain a stack of dark frames: light=0, lens covered")
        if all(each.is_dark for each in lights):
            raise ParameterError("frames", "must contain stacks with light: the gain follows from their shot noise")
        n_y, n_x = statistics[0].shape
        if min(n_y, n_x) < MIN_LINES:
            raise ParameterError(
                "frames",
                f"must have at least {MIN_LINES} rows and columns, got {n_x} x {n_y} pixels: intervals are their differences",
            )
        if len({each.temperature_k is None for each in lights}) > 1:
            raise ParameterError("temperature_k", "must be given for all stacks, or for none")
        adc = ADC(**known)
        linear = statistics if adc.is_linear else [LinearStatistics.of_codes(each, adc) for each in statistics]
        classes = class_index(n_y, n_x, mosaic)
        return cls(statistics, linear, lights, known, adc, classes, int(classes.max()) + 1)

    def without(self, defects: Bools) -> Recording:
        """Return the recording with further defects, (n_y, n_x)."""
        return replace(self, classes=np.where(defects, -1, self.classes))

    @cached_property
    def dark(self) -> list[int]:
        """Dark stacks."""
        return [k for k, each in enumerate(self.lights) if each.is_dark]

    @cached_property
    def lit(self) -> list[int]:
        """Stacks with light."""
        return [k for k, each in enumerate(self.lights) if not each.is_dark]

    @cached_property
    def shortest(self) -> list[int]:
        """Dark stacks of the shortest exposure time."""
        shortest_s = min(self.lights[k].exposure_s for k in self.dark)
        return [k for k in self.dark if self.lights[k].exposure_s == shortest_s]

    @property
    def has_dark_series(self) -> bool:
        """Whether there are dark stacks of several exposure times."""
        return len({self.lights[k].exposure_s for k in self.dark}) > 1

    @property
    def has_temperatures(self) -> bool:
        """Whether dark stacks have several temperatures."""
        return len({self.lights[k].temperature_k for k in self.dark}) > 1

    @property
    def good(self) -> Bools:
        """Pixels that are no defects, (n_y, n_x)."""
        return self.classes >= 0

    @cached_property
    def brightest(self) -> int:
        """Stack of the most light that is below the highest codes."""

        def brightness(k: int) -> float:
            mean = float(np.median(self.statistics[k].mean_dn))
            return mean if mean < LINEAR_FRACTION * (self.adc.n_codes - 1) else -1.0 / (1.0 + mean)

        return max(self.lit, key=brightness)

    @property
    def dark_mean_dn(self) -> Floats:
        """Mean image of the shortest dark stacks, weighted by their frames, (n_y, n_x)."""
        n = np.array([self.statistics[k].n_frames for k in self.shortest], np.float64)
        return weighted(n / n.sum(), (self.linear[k].mean_dn for k in self.shortest))

    @property
    def dark_noise_dn2(self) -> Floats:
        """Variance of :attr:`dark_mean_dn` by temporal noise, (n_y, n_x)."""
        n = np.array([self.statistics[k].n_frames for k in self.shortest], np.float64)
        return weighted(n / n.sum() ** 2, (self.linear[k].variance_dn2 for k in self.shortest))

    @property
    def line_noise_dn2(self) -> dict[str, float]:
        """Temporal part of the mean squares of rows and columns of :attr:`dark_mean_dn`."""
        frames = sum(self.statistics[k].n_frames for k in self.shortest)
        squares = self.mean_squares_dn2
        return {name: (squares[name] - squares["pixel"]) / frames for name in ("row", "column")}

    @property
    def mean_squares_dn2(self) -> dict[str, float]:
        """Mean squares of rows, columns and pixels over the shortest dark frames."""
        n = {k: self.statistics[k].n_frames - 1 for k in self.shortest}
        each = {k: self.linear[k].mean_squares_dn2 for k in self.shortest}
        return {part: sum(n[k] * each[k][part] for k in n) / sum(n.values()) for part in ("row", "column", "pixel")}

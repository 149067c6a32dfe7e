"""
Rolling shutters: overlap of the exposure of each photosite with the frames of a scene.

The exposure of a site begins ``readout_order * line_s`` after the first. Irradiance is given in frames, ``frame_s`` apart: it
is constant until the next frame, or interpolated linearly between frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from foveasim._core.calls import NOT_NEGATIVE, check_declared
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, check_per_site, finite_array
from foveasim.errors import SimulationError
from foveasim.layout.model import Layout
from foveasim.sensor.limits import DURATION, EXPOSURE

__all__ = ["Between", "Exposure", "Shutter"]

#: Irradiance between frames: constant until the next frame, or linear interpolation.
Between = Literal["hold", "linear"]
#: Rounding tolerance in frames: an exposure that ends less than this after a frame is regarded as ending with the frame.
TIME_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Shutter:
    """
    Exposure timing of the sites relative to the frames of a scene.

    Parameters
    ----------
    layout : Layout
        Layout of the photosites, with the column ``readout_order`` if ``line_s`` is not 0.
    frame_s : float, s
        Frame period of the scene.
    line_s : float, s
        Line time, between the starts of exposure of successive lines; 0 for a global shutter.
    between : {"hold", "linear"}
        Irradiance between frames: constant until the next frame, or linear interpolation.

    Raises
    ------
    SimulationError
        When ``line_s`` is not 0 and the layout has no column ``readout_order``.

    Examples
    --------
    Two lines with an exposure of 2 s, frames of 1.5 s, and a line time of 0.5 s:

    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=1, n_y=2, pitch_um=2.0).with_columns(readout_order=np.array([0, 1]))
    >>> shutter = Shutter(layout, frame_s=1.5, line_s=0.5)
    >>> [shutter.overlap_fraction(frame, 2.0).tolist() for frame in range(3)]
    [[0.75, 0.5], [0.25, 0.5], [0.0, 0.0]]
    """

    layout: Layout
    frame_s: Annotated[float, DURATION]
    line_s: Annotated[float, EXPOSURE] = 0.0
    between: Between = "hold"

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_declared(self)
        if self.line_s and "readout_order" not in self.layout.columns:
            raise SimulationError(
                "a rolling shutter needs the line of each site; add a column 'readout_order' to the layout, for example with "
                "foveasim.layout.readout_by or nearest_bus"
            )
        if self.line_s:
            finite_array("readout_order", self.layout.columns["readout_order"])

    @property
    def delay_s(self) -> Floats:
        """Start of the exposure of each site after the first line, (n_site,) s; (1,) if global."""
        if not self.line_s:
            return np.zeros(1)
        order = np.asarray(self.layout.columns["readout_order"], np.float64)
        return self.line_s * (order - order.min(initial=np.inf))

    def overlap_fraction(self, frame: Annotated[int, NOT_NEGATIVE], exposure_s: Annotated[float, EXPOSURE]) -> Floats:
        """
        Return the weight of a frame in the exposure of each site, (n_site,) or (1,).

        Frame 0 begins with the first line.
        """
        delay_s = self.delay_s
        if not exposure_s:  # instantaneous exposure
            return np.where((delay_s >= frame * self.frame_s) & (delay_s < (frame + 1) * self.frame_s), 1.0, 0.0)
        if self.between == "hold":
            before, after = (np.clip((k * self.frame_s - delay_s) / exposure_s, 0.0, 1.0) for k in (frame, frame + 1))
            return np.asarray(after - before)
        begin, end = (_hat_integral(t_s / self.frame_s - frame) for t_s in (delay_s, delay_s + exposure_s))
        return np.asarray((end - begin) * (self.frame_s / exposure_s))

    def last_frame(self, exposure_s: Annotated[float, EXPOSURE]) -> int:
        """Return the last frame that overlaps the exposure of any site."""
        end = (float(self.delay_s.max(initial=0.0)) + exposure_s) / self.frame_s
        frames = int(np.ceil(end - TIME_ROUNDING))
        return max(frames - 1, 0) if self.between == "hold" else frames


class Exposure:
    """
    Incremental integration of one exposure from frames.

    Parameters
    ----------
    shutter : Shutter
        Exposure timing.
    exposure_s : float, s
        Exposure time; 0 for an instantaneous exposure.

    Examples
    --------
    With a rolling shutter, half of the exposure of the second line is in the second frame:

    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.grid(n_x=1, n_y=2, pitch_um=2.0).with_columns(readout_order=np.array([0, 1]))
    >>> exposure = fs.modes.Exposure(fs.modes.Shutter(layout, frame_s=1.0, line_s=0.5), exposure_s=1.0)
    >>> for rate_e_per_s in (100.0, 200.0):
    ...     exposure.add(np.full(2, rate_e_per_s))
    >>> exposure.is_complete, exposure.mean_e_per_s(np.full(2, 200.0)).tolist()
    (True, [100.0, 150.0])
    """

    def __init__(self, shutter: Shutter, exposure_s: Annotated[float, EXPOSURE]) -> None:
        self._shutter = shutter
        self.exposure_s: float = exposure_s
        self._last = shutter.last_frame(exposure_s)
        self._n_added = 0
        self._rate_e_per_s: Floats = np.zeros(1)
        self._weight: Floats = np.zeros(1)

    def __repr__(self) -> str:
        return f"Exposure({self.exposure_s:.6g} s, {self._n_added} of {self._last + 1} frames added)"

    @property
    def is_complete(self) -> bool:
        """Whether all frames that overlap the exposure have been added."""
        return self._n_added > self._last

    def add(self, rate_e_per_s: Floats) -> None:
        """Add the photoelectron rates of the next frame, (n_site,) e-/s."""
        rate_e_per_s = self._validate_rate("rate_e_per_s", rate_e_per_s)
        if not self.is_complete:
            weight = self._shutter.overlap_fraction(self._n_added, self.exposure_s)
            self._rate_e_per_s = self._rate_e_per_s + weight * rate_e_per_s
            self._weight = self._weight + weight
        self._n_added += 1

    def mean_e_per_s(self, last_e_per_s: Floats) -> Floats:
        """
        Return the mean photoelectron rate during the exposure of every site, (n_site,) e-/s.

        The rate of the last frame is used for the rest of an incomplete exposure.
        """
        last_e_per_s = self._validate_rate("last_e_per_s", last_e_per_s)
        if self.is_complete:
            return self._rate_e_per_s
        return self._rate_e_per_s + (1.0 - self._weight) * last_e_per_s

    def _validate_rate(self, name: str, rate_e_per_s: Floats) -> Floats:
        return check_per_site(name, finite_array(name, rate_e_per_s, at_least=0.0), self._shutter.layout.n_sites)


def _hat_integral(x: Floats) -> Floats:
    """Return the integral up to x of the triangular function of unit height on [-1, 1]."""
    x = np.clip(x, -1.0, 1.0)
    return np.where(x < 0.0, 0.5 * (1.0 + x) ** 2, 1.0 - 0.5 * (1.0 - x) ** 2)

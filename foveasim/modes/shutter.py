"""
Rolling shutters: which frames of light each photosite's exposure covers, and how much of each.

A site begins its exposure ``readout_order * line_s`` after the first. Light is given in frames, ``frame_s`` apart: it stays as
it is until the next one, or goes over into it in a straight line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from foveasim._core.validation import Floats, check_choice, check_count, finite_array
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import Layout
from foveasim.sensor.limits import check_plausible

__all__ = ["Between", "Exposure", "Shutter"]

#: What light does between frames: it holds until the next, or goes over into it in a straight line.
Between = Literal["hold", "linear"]
#: An exposure that ends this fraction of a frame behind one ends with it: the rounding of times.
TIME_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Shutter:
    """
    When the sites expose, within frames of light.

    Parameters
    ----------
    layout : Layout
        With the column ``readout_order``, where lines differ in time.
    frame_s : float, s
        From one frame of light to the next.
    line_s : float, s
        From the begin of one line's exposure to the next one's; 0 for a global shutter.
    between : {"hold", "linear"}

    Raises
    ------
    ParameterError
        When a time is out of range, or the layout is none.
    SimulationError
        When lines differ in time, and the layout does not say which site is on which.

    Examples
    --------
    Of an exposure of 2 s that begins with a frame of 1.5 s, or half a second later:

    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=1, n_y=2, pitch_um=2.0).with_columns(readout_order=np.array([0, 1]))
    >>> shutter = Shutter(layout, frame_s=1.5, line_s=0.5)
    >>> [shutter.overlap_fraction(frame, 2.0).tolist() for frame in range(3)]
    [[0.75, 0.5], [0.25, 0.5], [0.0, 0.0]]
    """

    layout: Layout
    frame_s: float
    line_s: float = 0.0
    between: Between = "hold"

    def __post_init__(self) -> None:
        if not isinstance(self.layout, Layout):
            raise ParameterError("layout", f"must be a foveasim.Layout, got a {type(self.layout).__name__}")
        object.__setattr__(self, "frame_s", check_plausible("frame_s", self.frame_s))
        object.__setattr__(self, "line_s", check_plausible("line_s", self.line_s))
        check_choice("between", self.between, ("hold", "linear"))
        if self.line_s and "readout_order" not in self.layout.columns:
            raise SimulationError(
                "lines are exposed one after the other, but the layout does not say which site is on which; give it a column "
                "'readout_order', for example with foveasim.layout.readout_by or nearest_bus"
            )

    @property
    def delay_s(self) -> Floats:
        """From the begin of the first line's exposure to that of each site's, (n_site,) s; (1,) of a global shutter."""
        if not self.line_s:
            return np.zeros(1)
        order = np.asarray(self.layout.columns["readout_order"], np.float64)
        return self.line_s * (order - order.min(initial=np.inf))

    def overlap_fraction(self, frame: int, exposure_s: float) -> Floats:
        """Fraction of each site's exposure that a frame lights, (n_site,) or (1,); frame 0 begins with the first line."""
        frame = check_count("frame", frame, at_least=0)
        exposure_s = check_plausible("exposure_s", exposure_s)
        delay_s = self.delay_s
        if not exposure_s:  # a moment
            return np.where((delay_s >= frame * self.frame_s) & (delay_s < (frame + 1) * self.frame_s), 1.0, 0.0)
        if self.between == "hold":
            before, after = (np.clip((k * self.frame_s - delay_s) / exposure_s, 0.0, 1.0) for k in (frame, frame + 1))
            return np.asarray(after - before)
        begin, end = (_hat_integral(t_s / self.frame_s - frame) for t_s in (delay_s, delay_s + exposure_s))
        return np.asarray((end - begin) * (self.frame_s / exposure_s))

    def last_frame(self, exposure_s: float) -> int:
        """The last frame that lights any site's exposure."""
        exposure_s = check_plausible("exposure_s", exposure_s)
        end = (float(self.delay_s.max(initial=0.0)) + exposure_s) / self.frame_s
        frames = int(np.ceil(end - TIME_ROUNDING))
        return max(frames - 1, 0) if self.between == "hold" else frames


class Exposure:
    """
    One exposure in the making: frames of light are added as they come.

    Parameters
    ----------
    shutter : Shutter
    exposure_s : float, s
        0 for a moment.

    Raises
    ------
    ParameterError
        When the time is out of range, or light is not one finite number of at least 0 a site.
    """

    def __init__(self, shutter: Shutter, exposure_s: float) -> None:
        if not isinstance(shutter, Shutter):
            raise ParameterError("shutter", f"must be a foveasim.modes.Shutter, got a {type(shutter).__name__}")
        exposure_s = check_plausible("exposure_s", exposure_s)
        self._shutter, self.exposure_s = shutter, exposure_s
        self._last = shutter.last_frame(exposure_s)
        self._n_seen = 0
        self._rate_e_per_s: Floats = np.zeros(1)
        self._share: Floats = np.zeros(1)

    @property
    def is_complete(self) -> bool:
        """Whether no frame to come lights any site."""
        return self._n_seen > self._last

    def add(self, rate_e_per_s: Floats) -> None:
        """Add the next frame's light, (n_site,) e-/s."""
        rate_e_per_s = self._light("rate_e_per_s", rate_e_per_s)
        if not self.is_complete:
            share = self._shutter.overlap_fraction(self._n_seen, self.exposure_s)
            self._rate_e_per_s = self._rate_e_per_s + share * rate_e_per_s
            self._share = self._share + share
        self._n_seen += 1

    def mean_e_per_s(self, last_e_per_s: Floats) -> Floats:
        """Mean light over every site's exposure, (n_site,) e-/s; the last frame's light stays until all are over."""
        last_e_per_s = self._light("last_e_per_s", last_e_per_s)
        if self.is_complete:
            return self._rate_e_per_s
        return self._rate_e_per_s + (1.0 - self._share) * last_e_per_s

    def _light(self, name: str, rate_e_per_s: Floats) -> Floats:
        light, n_sites = finite_array(name, rate_e_per_s, at_least=0.0), self._shutter.layout.n_sites
        if light.shape != (n_sites,):
            raise ParameterError(name, f"must have one number for each of the {n_sites} sites, got {light.shape}")
        return light


def _hat_integral(x: Floats) -> Floats:
    """Integral up to x of the hat that rises from 0 at -1 to 1 at 0 and falls to 0 at 1."""
    x = np.clip(x, -1.0, 1.0)
    return np.where(x < 0.0, 0.5 * (1.0 + x) ** 2, 1.0 - 0.5 * (1.0 - x) ** 2)

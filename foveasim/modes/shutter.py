"""
Rolling shutters: overlap of the exposure of each photosite with the frames of a scene.

The exposure of a site begins ``readout_order * line_s`` after the first, or with its row. Irradiance is given in frames,
``frame_s`` apart or at ``times_s``: it is constant until the next frame, or interpolated linearly between frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np

from foveasim._core.calls import NOT_NEGATIVE, check_declared
from foveasim._core.short_repr import short_repr
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, check_per_site, finite_array, read_only
from foveasim.errors import FoveasimWarning, ParameterError, warn
from foveasim.layout.model import Layout
from foveasim.layout.rows import Scan, scan_index
from foveasim.modes.frame_times import FrameTimes
from foveasim.sensor.limits import DURATION, EXPOSURE

__all__ = ["Between", "Exposure", "Shutter"]

#: Irradiance between frames: constant until the next frame, or linear interpolation.
Between = Literal["hold", "linear"]
#: Scan of layouts without the column ``readout_order``: that of cameras.
DEFAULT_SCAN: Scan = "rows_from_top"
#: Rounding tolerance in frames: an exposure that ends less than this after a frame is regarded as ending with the frame.
TIME_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Shutter:
    """
    Exposure timing of the sites relative to the frames of a scene.

    Parameters
    ----------
    layout : Layout
        Layout of the photosites; its column ``readout_order`` is the line time at which each exposure begins.
    frame_s : float, s
        Frame period of the scene.
    line_s : float, s
        Line time, between the starts of exposure of successive lines; 0 for a global shutter.
    between : {"hold", "linear"}
        Irradiance between frames: constant until the next frame, or linear interpolation.
    scan : {"rows_from_top", "rows_from_bottom", "columns_from_left", "columns_from_right"}, optional
        Order of the rows or columns in the upright picture, as in :func:`foveasim.layout.readout_by`, instead of the column
        ``readout_order``. Rows from the top, as in cameras, for layouts without this column.
    times_s : (n_frame,) float64, s
        Times of the frames in strictly ascending order, instead of ``frame_s``. After the last one irradiance is constant.

    Raises
    ------
    ParameterError
        When not exactly one of ``frame_s`` and ``times_s`` is given, or the times are not ascending.

    Warns
    -----
    FoveasimWarning
        When ``line_s`` is not 0, the layout has no column ``readout_order``, and no scan is specified.

    Examples
    --------
    Two lines with an exposure of 2 s, frames of 1.5 s, and a line time of 0.5 s:

    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=1, n_y=2, pitch_um=2.0).with_columns(
    ...     readout_order=np.array([0, 1])
    ... )
    >>> shutter = Shutter(layout, frame_s=1.5, line_s=0.5)
    >>> [shutter.overlap_fraction(frame, 2.0).tolist() for frame in range(3)]
    [[0.75, 0.5], [0.25, 0.5], [0.0, 0.0]]

    The second frame of three lasts from 0.5 s to 2 s:

    >>> shutter = Shutter(layout, times_s=[0.0, 0.5, 2.0], line_s=0.5)
    >>> [shutter.overlap_fraction(frame, 2.0).tolist() for frame in range(3)]
    [[0.25, 0.0], [0.75, 0.75], [0.0, 0.25]]
    """

    layout: Layout
    frame_s: Annotated[float | None, DURATION] = None
    line_s: Annotated[float, EXPOSURE] = 0.0
    between: Between = "hold"
    scan: Scan | None = None
    times_s: Floats | None = None
    times: FrameTimes = field(init=False, repr=False)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_declared(self)
        times = FrameTimes.of(self.frame_s, self.times_s)
        if times is None:
            raise ParameterError("frame_s", "must be given, or 'times_s'")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "times_s", times.times_s)
        if not self.line_s or self.scan is not None:
            return
        if "readout_order" in self.layout.columns:
            finite_array("readout_order", self.layout.columns["readout_order"])
            return
        object.__setattr__(self, "scan", DEFAULT_SCAN)
        if self.layout.n_sites:
            n_rows = int(scan_index(self.layout, DEFAULT_SCAN).max()) + 1
            warn(
                f"the rolling shutter reads {n_rows:,} rows from the top of the picture, because the layout has no column "
                "'readout_order'; pass scan='rows_from_top' or another order, or use foveasim.layout.readout_by",
                FoveasimWarning,
            )

    @cached_property
    def delay_s(self) -> Floats:
        """Start of the exposure of each site after the first line, (n_site,) s; (1,) if global."""
        if not self.line_s:
            return read_only(np.zeros(1))
        order = self.layout.columns["readout_order"] if self.scan is None else scan_index(self.layout, self.scan)
        order = np.asarray(order, np.float64)
        return read_only(self.line_s * (order - order.min(initial=np.inf)))

    def overlap_fraction(
        self,
        frame: Annotated[int, NOT_NEGATIVE],
        exposure_s: Annotated[float, EXPOSURE],
        first_frame: Annotated[int, NOT_NEGATIVE] = 0,
    ) -> Floats:
        """
        Return the weight of a frame in the exposure of each site, (n_site,) or (1,).

        Frame 0 begins with the first line; it is the frame ``first_frame`` of ``times_s``.
        """
        delay_s = self.delay_s
        before_s, begin_s, end_s = (
            self.times.after_s(first_frame + max(k, 0), first_frame) for k in (frame - 1, frame, frame + 1)
        )
        if begin_s == math.inf:
            return np.zeros(1)
        if not exposure_s and self.between == "linear":  # instantaneous exposure
            rise_s, later_s = begin_s - before_s or math.inf, delay_s - begin_s
            return np.clip(np.minimum(1.0 + later_s / rise_s, 1.0 - later_s / (end_s - begin_s)), 0.0, 1.0)
        if not exposure_s:
            return np.where((delay_s >= begin_s) & (delay_s < end_s), 1.0, 0.0)
        if self.between == "hold":
            before, after = (np.clip((t_s - delay_s) / exposure_s, 0.0, 1.0) for t_s in (begin_s, end_s))
            return np.asarray(after - before)
        start, stop = (
            _hat_integral(t_s - begin_s, begin_s - before_s, end_s - begin_s) for t_s in (delay_s, delay_s + exposure_s)
        )
        return np.asarray((stop - start) / exposure_s)

    def last_frame(self, exposure_s: Annotated[float, EXPOSURE], first_frame: Annotated[int, NOT_NEGATIVE] = 0) -> int:
        """Return the last frame, from ``first_frame``, that overlaps the exposure of any site."""
        end_s = float(self.delay_s.max(initial=0.0)) + exposure_s
        last = self.times.last_before(end_s, first_frame, TIME_ROUNDING)
        is_last = self.times.after_s(first_frame + last + 1, first_frame) == math.inf
        return max(last, 0) if self.between == "hold" or is_last else last + 1


class Exposure:
    """
    Incremental integration of one exposure from frames.

    Parameters
    ----------
    shutter : Shutter
        Exposure timing.
    exposure_s : float, s
        Exposure time; 0 for an instantaneous exposure.
    first_frame : int
        Number of the frame with which the exposure of the first line begins.

    Examples
    --------
    With a rolling shutter, half of the exposure of the second line is in the second frame:

    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout = fs.layout.grid(n_x=1, n_y=2, pitch_um=2.0).with_columns(
    ...     readout_order=np.array([0, 1])
    ... )
    >>> exposure = fs.modes.Exposure(
    ...     fs.modes.Shutter(layout, frame_s=1.0, line_s=0.5), exposure_s=1.0
    ... )
    >>> for rate_e_per_s in (100.0, 200.0):
    ...     exposure.add(np.full(2, rate_e_per_s))
    >>> exposure.is_complete, exposure.mean_e_per_s(np.full(2, 200.0)).tolist()
    (True, [100.0, 150.0])
    """

    def __init__(
        self,
        shutter: Shutter,
        exposure_s: Annotated[float, EXPOSURE],
        first_frame: Annotated[int, NOT_NEGATIVE] = 0,
    ) -> None:
        self._shutter, self._first = shutter, first_frame
        self.exposure_s: float = exposure_s
        self._last = shutter.last_frame(exposure_s, first_frame)
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
            weight = self._shutter.overlap_fraction(self._n_added, self.exposure_s, self._first)
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


def _hat_integral(t_s: Floats, rise_s: float, fall_s: float) -> Floats:
    """
    Return the integral up to a time of a function that rises to 1 at 0, and then falls.

    It is linear before and after. ``rise_s``: time before 0 at which it rises. ``fall_s``: time after 0 at which it is 0 again;
    infinite if it stays 1.
    """
    rising = np.clip(t_s, -rise_s, 0.0)
    integral = 0.5 * (rise_s + rising) ** 2 / rise_s if rise_s else 0.0
    falling = np.clip(t_s, 0.0, fall_s)
    return np.asarray(integral + falling * (1.0 - 0.5 * falling / fall_s))

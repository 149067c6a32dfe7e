"""Times of frames: at equal steps, or given one by one as the time stamps of a video are."""

from __future__ import annotations

import math
from collections.abc import Sized
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.validation import Floats, finite_array, read_only
from foveasim.errors import ParameterError
from foveasim.sensor.limits import DURATION

__all__ = ["FrameTimes", "check_times"]


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """
    Times at which frames begin: at equal steps ``frame_s``, or ``times_s``.

    The last of given frames lasts until the end of all exposures.
    """

    frame_s: float | None
    times_s: Floats | None = None

    @classmethod
    def of(cls, frame_s: float | None, times_s: ArrayLike | None, *, frames: object = None) -> FrameTimes | None:
        """
        Return the times of arguments, None without them; ``frames``: those that have the times.

        Raises ParameterError when both are given, a value is out of range, or the number of frames is known and another one.
        """
        if times_s is not None and frame_s is not None:
            raise ParameterError(
                "times_s", "must not be given with 'frame_s'", hint="times_s are the times of all frames"
            )
        if frame_s is not None:
            return cls(DURATION.check("frame_s", frame_s))
        if times_s is None:
            return None
        found = check_times("times_s", times_s)
        if isinstance(frames, Sized) and len(frames) != found.size:
            raise other_number(len(frames), found.size)
        return cls(None, found)

    def after_s(self, number: int, first: int = 0) -> float:
        """Return the time from one frame to a later one in s; infinite after the last frame."""
        if self.frame_s is not None:
            return (number - first) * self.frame_s
        assert self.times_s is not None
        return float(self.times_s[number] - self.times_s[first]) if number < self.times_s.size else math.inf

    def at_s(self, number: int) -> float:
        """Return the time of a frame in s."""
        return self.after_s(number) if self.times_s is None else float(self.times_s[number])

    def last_before(self, time_s: float, first: int, rounding: float) -> int:
        """
        Return the last frame that begins before a time, from ``first`` on; -1 if none does.

        ``time_s``: after the frame ``first``. ``rounding``: tolerance as a fraction of the time between frames.
        """
        if self.frame_s is not None:
            return math.ceil(time_s / self.frame_s - rounding) - 1
        assert self.times_s is not None
        end_s = self.times_s[first] + time_s
        last = int(np.searchsorted(self.times_s, end_s, "left")) - 1
        if last > first and end_s - self.times_s[last] <= rounding * (self.times_s[last] - self.times_s[last - 1]):
            last -= 1
        return last - first

    def of_frames(self, first: int, n: int) -> tuple[Floats, Floats]:
        """
        Return the times of frames and of the one after them, (n + 1,) s, and durations (n,) s.

        The last of given frames lasts as long as the one before it.
        """
        if self.frame_s is not None:
            return np.asarray((first + np.arange(n + 1)) * self.frame_s), np.full(n, self.frame_s)
        assert self.times_s is not None
        times_s = self.times_s
        last_s = times_s[-1] - times_s[-2] if times_s.size > 1 else 0.0
        ends_s = np.append(times_s, times_s[-1] + last_s)[first : first + n + 1]
        return np.asarray(ends_s, np.float64), np.diff(ends_s)

    def shortest_s(self, every: int) -> float:
        """Return the shortest time between frames whose numbers are multiples of ``every``."""
        if self.frame_s is not None:
            return every * self.frame_s
        assert self.times_s is not None
        return float(np.diff(self.times_s[::every]).min(initial=math.inf))

    def check_number(self, number: int) -> None:
        """Check that a frame has a time; raises ParameterError."""
        if self.times_s is not None and number >= self.times_s.size:
            raise other_number(f"at least {number + 1}", self.times_s.size)

    def check_complete(self, n_frames: int) -> None:
        """Check that all times had a frame; raises ParameterError."""
        if self.times_s is not None and n_frames != self.times_s.size:
            raise other_number(n_frames, self.times_s.size)


def check_times(name: str, times_s: ArrayLike) -> Floats:
    """
    Return times as an array, (n,) s.

    Raises ParameterError when they are not finite and strictly ascending.
    """
    found = finite_array(name, times_s, ndim=1)
    if found.size == 0:
        raise ParameterError(name, "must be one or more times")
    wrong = np.flatnonzero(np.diff(found) <= 0.0)
    if wrong.size:
        k = int(wrong[0])
        raise ParameterError(
            name, f"must be strictly ascending, got {found[k + 1]:g} s after {found[k]:g} s at index {k + 1}"
        )
    return read_only(found.copy())


def other_number(n_frames: int | str, n_times: int) -> ParameterError:
    """Return the error of frames whose number is not that of their times."""
    return ParameterError("times_s", f"must be one time per frame, got {n_times} times of {n_frames} frames")

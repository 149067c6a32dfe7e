"""Events of a recording: what all files contain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Bools, Ints
from foveasim._io.formats import FormatError

TimeUnit = Literal["s", "ms", "us", "ns"]
TIME_UNITS = get_args(TimeUnit)
#: Microseconds per unit.
US_PER: Mapping[str, float] = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
#: Most events of a file: 4.5 GB of arrays.
MAX_EVENTS = 1 << 28
MAX_ADDRESS = 2**16 - 1
#: Above this time float64 does not resolve microseconds.
MAX_T_US = 2**53


@dataclass(frozen=True)
class Recording:
    """
    Events of a recording.

    Attributes
    ----------
    t_us : (n_event,) int64, µs
        Times on the clock of the file.
    x, y : (n_event,) integers
        Column, and row from the top.
    is_on : (n_event,) bool
    shape : (n_row, n_column) or None
        Pixels of the sensor, if the file states them.
    skipped : mapping of str to int
        Numbers of records that are no events of the file's clock, by their name.
    """

    t_us: Ints
    x: NDArray[Any]
    y: NDArray[Any]
    is_on: Bools
    shape: tuple[int, int] | None = None
    skipped: Mapping[str, int] = field(default_factory=dict)

    def checked(self) -> Recording:
        """Return the recording in the order of its times, or raise a FormatError."""
        if not self.t_us.size == self.x.size == self.y.size == self.is_on.size:
            raise FormatError("must have a time, x, y and a polarity for each event")
        if self.t_us.size > MAX_EVENTS:
            raise FormatError(f"contains {self.t_us.size:,} events, more than the limit of {MAX_EVENTS:,}")
        if not self.t_us.size:
            return self
        if self.t_us.min() < 0 or self.t_us.max() > MAX_T_US:
            raise FormatError(
                f"must have times from 0 to 2^53 µs, got {int(self.t_us.min())} to {int(self.t_us.max())}"
            )
        limits = [n - 1 for n in self.shape[::-1]] if self.shape else [MAX_ADDRESS] * 2
        for name, values, limit in zip("xy", (self.x, self.y), limits, strict=True):
            if values.min() < 0 or values.max() > limit:
                bad = int(values.min() if values.min() < 0 else values.max())
                raise FormatError(f"has an event with {name} = {bad}, outside the sensor: 0 to {limit}")
        if np.all(self.t_us[1:] >= self.t_us[:-1]):
            return self
        order = np.argsort(self.t_us, kind="stable")
        arrays = {name: getattr(self, name)[order] for name in ("t_us", "x", "y", "is_on")}
        return replace(self, **arrays)


def empty_recording() -> Recording:
    """Return a recording without events."""
    return Recording(np.zeros(0, np.int64), np.zeros(0, np.uint16), np.zeros(0, np.uint16), np.zeros(0, bool))


def shape_of(width: int, height: int) -> tuple[int, int]:
    """Return the shape of a sensor of the stated size, or raise a FormatError."""
    if not (0 < width <= MAX_ADDRESS + 1 and 0 < height <= MAX_ADDRESS + 1):
        raise FormatError(f"states a sensor of {width} x {height} pixels")
    return height, width


def polarities(values: NDArray[Any]) -> Bools:
    """Return whether events are ON, from 0 and 1, or -1 and 1."""
    if values.dtype.kind == "b":
        return values
    is_on = values == 1
    others = values[~is_on]
    if others.size and not (np.all(others == 0) or np.all(others == -1)):
        bad = others[(others != 0) & (others != -1)]
        raise FormatError(
            f"has the polarity {bad[0]}, must have 0 and 1, or -1 and 1"
            if bad.size
            else "has polarities of 0 and of -1"
        )
    return np.asarray(is_on)


def integers(name: str, values: NDArray[Any]) -> Ints:
    """Return numbers as int64; raise a FormatError when they are no integers."""
    if values.dtype.kind in "iub":
        return values.astype(np.int64, copy=False)
    if values.dtype.kind != "f" or not np.isfinite(values).all() or not np.all(values == np.rint(values)):
        raise FormatError(f"must have integers as {name}")
    if values.size and np.abs(values).max() > MAX_T_US:
        raise FormatError(f"has too large numbers as {name}")
    return values.astype(np.int64)


def microseconds(values: NDArray[Any], unit: str) -> Ints:
    """Return times in µs, rounded to the nearest: files contain decimal numbers."""
    if values.dtype.kind in "iu" and unit == "us":
        return values.astype(np.int64)
    if values.dtype.kind not in "iuf" or (values.dtype.kind == "f" and not np.isfinite(values).all()):
        raise FormatError("must have finite numbers as times")
    t_us = np.rint(values * US_PER[unit]) if unit != "ns" else np.floor(values / 1000)
    if t_us.size and np.abs(t_us).max() > MAX_T_US:
        raise FormatError(f"must have times up to 2^53 µs, got {np.abs(t_us).max():.3g}")
    return t_us.astype(np.int64)

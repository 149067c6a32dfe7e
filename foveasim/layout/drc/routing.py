"""Routing capacity for readout lines, and readout data rate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np

from foveasim._core.calls import LENGTH, NOT_NEGATIVE, POSITIVE, Declared, Limits
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, Ints, as_numbers
from foveasim.layout.model import Layout

__all__ = ["Readout", "Routing", "TrackDemand", "track_demand"]

#: Lines whose first sites end within this distance of each other begin at the same strip.
SAME_STRIP_UM = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Readout(Declared):
    """
    Frame rate, bit depth and lanes of the readout.

    Parameters
    ----------
    frames_per_s : float, 1/s
        Frame rate.
    bits : int
        Bits per site.
    blanking : float
        Time without data as a fraction of the time with data, such as 0.2.
    n_lanes : int
        Number of output lanes, with equal data rates.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.layout.Readout(frames_per_s=30.0, bits=10, n_lanes=4).gbit_per_s(1_000_000)
    0.075
    """

    frames_per_s: Annotated[float, POSITIVE]
    bits: Annotated[int, Limits(at_least=1, at_most=64)]
    blanking: Annotated[float, NOT_NEGATIVE] = 0.0
    n_lanes: Annotated[int, Limits(at_least=1)] = 1

    def gbit_per_s(self, n_sites: int) -> float:
        """
        Compute the data rate of one lane, Gbit/s.

        The data rate is ``sites · frames/s · bits · (1 + blanking) / lanes``.

        Examples
        --------
        >>> round(Readout(frames_per_s=30.0, bits=10, blanking=0.2).gbit_per_s(2592 * 1944), 3)
        1.814
        """
        return 1e-9 * n_sites * self.frames_per_s * self.bits * (1.0 + self.blanking) / self.n_lanes


@dataclass(frozen=True, slots=True, kw_only=True)
class Routing(Declared):
    """
    Metal tracks for the readout lines.

    Parameters
    ----------
    width_um, space_um : float, µm
        Minimum width of a track and minimum space between two tracks.
    n_layers : int
        Number of metal layers for the lines.
    direction : {"outwards", "upwards"}
        Direction of the lines: radially away from the optical axis (sectors), or along y (columns).
    """

    width_um: Annotated[float, LENGTH]
    space_um: Annotated[float, LENGTH]
    n_layers: Annotated[int, Limits(at_least=1, at_most=1000)] = 1
    direction: Literal["outwards", "upwards"] = "outwards"

    def n_tracks(self, strip_um: Floats) -> Ints:
        """
        Return the number of tracks across strips of the given widths.

        The number is ``layers · floor(strip / (width + space))``.
        """
        # Tolerance for a strip that is an exact multiple of the track pitch, up to rounding.
        tracks = np.floor(as_numbers("strip_um", strip_um) / (self.width_um + self.space_um) * (1.0 + 1e-12))
        return (self.n_layers * tracks).astype(np.int64)


class TrackDemand(NamedTuple):
    """
    Readout lines and tracks of every strip where lines begin, outwards or upwards.

    Attributes
    ----------
    position_um : (n_strip,) float64, µm
        Radius of the circle, or y of the horizontal line, that is the strip.
    n_nets, n_tracks : (n_strip,) int64
        Lines that cross the strip, and available tracks.
    first_sites : (n_line,) int64
        First site of each line.
    strip : (n_line,) int64
        Index of the strip where each line begins.
    """

    position_um: Floats
    n_nets: Ints
    n_tracks: Ints
    first_sites: Ints
    strip: Ints

    def __repr__(self) -> str:
        return short_repr(self)


def track_demand(layout: Layout, routing: Routing) -> TrackDemand:
    """
    Count readout lines and available tracks at every strip where lines begin.

    A line begins at the outer end of its innermost (lowest) site and crosses every strip from there outwards (upwards).
    A strip is the circle of length ``2πr`` around the axis at that radius, or the full width of the layout at that y. In a
    log-polar layout, the first ring is the narrowest strip, and all lines cross it.

    Parameters
    ----------
    layout : Layout
        With the column ``readout_line``.
    routing : Routing

    Raises
    ------
    ParameterError
        When the layout has no such column.

    Examples
    --------
    Ten columns on the full width of 30 µm, with one track per µm:

    >>> import foveasim as fs
    >>> layout = fs.layout.readout_by(fs.layout.grid(n_x=10, n_y=4, pitch_um=3.0), "column")
    >>> demand = fs.layout.track_demand(
    ...     layout, fs.layout.Routing(width_um=0.5, space_um=0.5, direction="upwards")
    ... )
    >>> demand.n_nets.tolist(), demand.n_tracks.tolist()
    ([10], [30])
    """
    line = layout.index_column("readout_line")
    if line.size == 0:
        empty = np.zeros(0, np.int64)
        return TrackDemand(np.zeros(0), empty, empty, empty, empty)
    reach_um = np.hypot(*layout.xy_um.T) if routing.direction == "outwards" else layout.xy_um[:, 1]
    end_um = np.maximum.reduceat(reach_um, layout.ring_offsets[layout.site_offsets[:-1]])
    order = np.lexsort((end_um, line))
    first_sites = order[np.unique(line[order], return_index=True)[1]]
    start_um = np.sort(end_um[first_sites])
    position_um = start_um[np.append(np.diff(start_um) > SAME_STRIP_UM, True)]
    strip = np.searchsorted(position_um, end_um[first_sites] - SAME_STRIP_UM)
    n_nets = np.cumsum(np.bincount(strip, minlength=position_um.size))
    x_min, _, x_max, _ = layout.bounds_um
    strips_um = (
        2.0 * math.pi * position_um if routing.direction == "outwards" else np.full(position_um.size, x_max - x_min)
    )
    return TrackDemand(position_um, n_nets, routing.n_tracks(strips_um), first_sites, strip)

"""Gazes that move: paths of saccades and drift, and frames of light seen along them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.random_streams import Streams
from foveasim._core.validation import Floats, check_number, check_shape, finite_array, read_only
from foveasim.errors import ParameterError
from foveasim.fields import PowerMap
from foveasim.optics import Optics
from foveasim.scene import Scene

__all__ = ["GazePath", "pan_camera", "saccades", "shift_sensor"]

#: Shape of the law of fixations' durations (a gamma distribution): their standard deviation is half their mean.
FIXATION_SHAPE = 4.0
#: A shortest fixation, as a fraction of the mean.
SHORTEST_FIXATION = 0.2
#: Longer paths are a slip of units.
MAX_POINTS = 10**8


@dataclass(frozen=True, eq=False)
class GazePath:
    """
    Where a gaze is when.

    Parameters
    ----------
    t_s : (n,) float64, s
        Rising.
    xy_um : (n, 2) float64, µm
        Places on the sensor plane, in the image of the whole picture: what is there falls on the sensor's middle.

    Raises
    ------
    ParameterError
        When times do not rise, or there is not one place a time.
    """

    t_s: Floats
    xy_um: Floats

    def __post_init__(self) -> None:
        t_s, xy_um = finite_array("t_s", self.t_s, ndim=1), finite_array("xy_um", self.xy_um, ndim=2)
        if t_s.size == 0 or np.any(np.diff(t_s) <= 0.0):
            raise ParameterError("t_s", "must be one or more times, each later than the one before", t_s, "s")
        if xy_um.shape != (t_s.size, 2):
            raise ParameterError("xy_um", f"must have the shape ({t_s.size}, 2), one place a time, got {xy_um.shape}")
        object.__setattr__(self, "t_s", read_only(t_s.copy()))
        object.__setattr__(self, "xy_um", read_only(xy_um.copy()))

    def at(self, t_s: ArrayLike) -> Floats:
        """Places at some times, (..., 2) µm: straight lines between the path's, and its ends beyond them."""
        times_s = finite_array("t_s", t_s)
        return np.stack([np.interp(times_s, self.t_s, self.xy_um[:, axis]) for axis in (0, 1)], axis=-1)


def saccades(
    *,
    duration_s: float,
    frame_s: float,
    size_um: tuple[float, float],
    seed: int,
    fixation_s: float = 0.3,
    saccade_s: float = 0.05,
    drift_um_per_root_s: float = 0.0,
) -> GazePath:
    """
    A gaze that jumps from place to place, and drifts while it rests.

    Parameters
    ----------
    duration_s, frame_s : float, s
        How long it lasts, and from one point of the path to the next.
    size_um : (width, height), µm
        Rectangle about the axis that all its targets lie in, each place as likely as the other; it begins on the axis.
    seed : int
    fixation_s : float, s
        Mean duration of a rest: gamma distribution with a standard deviation of half of it.
    saccade_s : float, s
        Duration of a jump, which is the smoothest one (least jerk): ``10 u³ - 15 u⁴ + 6 u⁵``.
    drift_um_per_root_s : float, µm / sqrt(s)
        Standard deviation, along either axis, of the drift of a rest after one second: a random walk that begins again
        with each rest.

    Returns
    -------
    GazePath
        With ``round(duration_s / frame_s)`` points, the first at 0 s.

    Raises
    ------
    ParameterError
        When a value is out of range.

    Examples
    --------
    >>> path = saccades(duration_s=1.0, frame_s=0.01, size_um=(100.0, 50.0), seed=1)
    >>> path.xy_um.shape, path.xy_um[0].tolist()
    ((100, 2), [0.0, 0.0])
    """
    frame_s = check_number("frame_s", frame_s, above=0.0)
    duration_s = check_number("duration_s", duration_s, above=0.0)
    n = round(min(duration_s / frame_s, 2.0 * MAX_POINTS))
    if not 1 <= n <= MAX_POINTS:
        raise ParameterError("duration_s", f"must be 1 to {MAX_POINTS:,} frames of {frame_s:g} s", duration_s, "s")
    half_um = 0.5 * finite_array("size_um", size_um, ndim=1, at_least=0.0)
    if half_um.size != 2:
        raise ParameterError("size_um", "must be two numbers (width, height)", size_um, "µm")
    fixation_s = check_number("fixation_s", fixation_s, at_least=frame_s)
    saccade_s = check_number("saccade_s", saccade_s, at_least=0.0)
    drift = check_number("drift_um_per_root_s", drift_um_per_root_s, at_least=0.0)
    streams = Streams(seed)
    rests, targets, walk = (streams.of(f"gaze {what}") for what in ("rests", "targets", "drift"))
    t_s = frame_s * np.arange(n)
    steps_um = drift * math.sqrt(frame_s) * walk.standard_normal((n, 2))
    xy_um = np.zeros((n, 2))
    begin_s, place_um = 0.0, np.zeros(2)
    while begin_s < t_s[-1] or begin_s == 0.0:
        rest_s = fixation_s * max(rests.gamma(FIXATION_SHAPE) / FIXATION_SHAPE, SHORTEST_FIXATION)
        leave_s = begin_s + rest_s
        resting = slice(*np.searchsorted(t_s, (begin_s, leave_s)))
        walked_um = np.cumsum(steps_um[resting], axis=0) - steps_um[resting][:1]
        xy_um[resting] = place_um + walked_um
        left_um = xy_um[resting][-1] if resting.start < resting.stop else place_um
        place_um = half_um * (2.0 * targets.random(2) - 1.0)
        begin_s = leave_s + saccade_s
        jumping = slice(*np.searchsorted(t_s, (leave_s, begin_s)))
        u = ((t_s[jumping] - leave_s) / max(saccade_s, frame_s))[:, np.newaxis]
        xy_um[jumping] = left_um + (place_um - left_um) * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    return GazePath(np.asarray(t_s), xy_um)


def shift_sensor(light: Scene | PowerMap, path: GazePath) -> Iterator[tuple[Scene | PowerMap, tuple[float, float]]]:
    """
    Frames of a still light that a sensor is moved over, for :meth:`foveasim.Camera.video`.

    The lens stays, and with it falloff and aberrations: the sensor moves behind it. So the image is computed once, and each
    frame is its integral over the moved outlines, exact for any shift.

    Parameters
    ----------
    light : Scene or PowerMap
    path : GazePath

    Yields
    ------
    light, (x_um, y_um)

    Raises
    ------
    ParameterError
        When an argument is none of these.
    """
    _check_kinds(("light", light, (Scene, PowerMap)), ("path", path, (GazePath,)))
    return ((light, (float(x_um), float(y_um))) for x_um, y_um in path.xy_um)


def pan_camera(
    scene: Scene, path: GazePath, optics: Optics, *, shape: tuple[int, int]
) -> Iterator[tuple[Scene, tuple[float, float]]]:
    """
    Frames of a large picture that the whole camera moves before, for :meth:`foveasim.Camera.video`.

    Of the picture the part that the lens sees is cut out at whole pixels, and the rest of the shift, half a pixel at most,
    moves the photosites: no picture is resampled. Falloff and aberrations are the lens's, about the gaze, to that half pixel.

    Parameters
    ----------
    scene : Scene
        The whole picture.
    path : GazePath
        On the sensor plane, as the lens images the whole picture.
    optics : Optics
    shape : (n_y, n_x)
        Of the part that is cut out.

    Yields
    ------
    scene, (x_um, y_um)

    Raises
    ------
    ParameterError
        At once, when an argument is none of these, or the part larger than the picture; later, when it would reach beyond.
    """
    _check_kinds(("scene", scene, (Scene,)), ("path", path, (GazePath,)), ("optics", optics, (Optics,)))
    n_y, n_x = check_shape("shape", shape)
    if n_y > scene.basis.shape[1] or n_x > scene.basis.shape[2]:
        raise ParameterError("shape", f"must be within the picture's {scene.basis.shape[1:]}", (n_y, n_x))
    return _parts(scene, path, optics.grid(scene).pitch_x_um, n_y, n_x)


def _parts(
    scene: Scene, path: GazePath, cell_um: float, n_y: int, n_x: int
) -> Iterator[tuple[Scene, tuple[float, float]]]:
    """The parts of a picture along a path."""
    free_y, free_x = scene.basis.shape[1] - n_y, scene.basis.shape[2] - n_x
    before: tuple[int, int] | None = None
    part = scene
    for t_s, place_um in zip(path.t_s, path.xy_um, strict=True):
        # The part's middle: half a pixel off where the numbers of free pixels are odd.
        left, bottom = (
            round(float(at_um) / cell_um + 0.5 * free) for at_um, free in zip(place_um, (free_x, free_y), strict=True)
        )
        if not (0 <= left <= free_x and 0 <= bottom <= free_y):
            raise ParameterError(
                "path",
                f"leaves the picture at {t_s:g} s: the part of {n_x} x {n_y} pixels may be moved by at most "
                f"({0.5 * free_x * cell_um:.4g}, {0.5 * free_y * cell_um:.4g}) µm",
                tuple(float(at_um) for at_um in place_um),
                "µm",
            )
        if (left, bottom) != before:
            part = replace(scene, basis=scene.basis[:, bottom : bottom + n_y, left : left + n_x])
            before = left, bottom
        rest_um = [
            float(at_um) - (at - 0.5 * free) * cell_um
            for at_um, at, free in zip(place_um, (left, bottom), (free_x, free_y), strict=True)
        ]
        yield part, (rest_um[0], rest_um[1])


def _check_kinds(*arguments: tuple[str, object, tuple[type, ...]]) -> None:
    for name, value, kinds in arguments:
        if not isinstance(value, kinds):
            told = " or ".join(kind.__name__ for kind in kinds)
            raise ParameterError(name, f"must be of the class {told}, got a {type(value).__name__}")

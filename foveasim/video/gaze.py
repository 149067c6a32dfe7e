"""Gaze paths of saccades and drift, and frames of scenes along a path."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import NOT_NEGATIVE, OwnCheck
from foveasim._core.random_streams import Streams
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, check_number, check_shape, finite_array, read_only
from foveasim._io.atomic import atomic_write
from foveasim._io.text_files import read_columns
from foveasim._projections import check_direction
from foveasim.camera import Camera
from foveasim.camera._frames import Frame, PathPosition, TimedFrames, carried_times, path_digests, path_positions
from foveasim.errors import FileError, ParameterError, format_value
from foveasim.fields import PowerMap
from foveasim.modes.frame_times import FrameTimes
from foveasim.optics import Optics
from foveasim.scene import Scene
from foveasim.sensor.limits import DURATION

__all__ = [
    "DirectionPath",
    "GazePath",
    "follow_gaze",
    "pan_camera",
    "read_gaze_path",
    "saccades",
    "shift_sensor",
    "turn_camera",
]

#: Shape of the gamma distribution of fixation durations: the standard deviation is half the mean.
FIXATION_SHAPE = 4.0
#: Shortest fixation as a fraction of the mean.
MIN_FIXATION = 0.2
#: Upper limit of points; longer paths indicate wrong units.
MAX_POINTS = 10**8
#: Largest files, and their first lines.
MAX_FILE_BYTES, MAX_HEADER_BYTES = 1 << 28, 65536


class _TimedPath:
    """Points as a function of time, with straight lines between them."""

    #: Columns of files and rows, and attribute of the coordinates.
    COLUMNS: ClassVar[tuple[str, str, str]]
    POINTS: ClassVar[str]

    t_s: Floats

    __repr__ = short_repr

    def __post_init__(self) -> None:
        times_s = finite_array("t_s", self.t_s, ndim=1)
        points = finite_array(self.POINTS, getattr(self, self.POINTS), ndim=2)
        if times_s.size == 0 or np.any(np.diff(times_s) <= 0.0):
            raise ParameterError("t_s", "must be one or more times in strictly ascending order", times_s, "s")
        if points.shape != (times_s.size, 2):
            raise ParameterError(
                self.POINTS, f"must have the shape ({times_s.size}, 2), one position per time, got {points.shape}"
            )
        self._check(points)
        object.__setattr__(self, "t_s", read_only(times_s.copy()))
        object.__setattr__(self, self.POINTS, read_only(points.copy()))

    def _check(self, points: Floats) -> None:
        """Raise ParameterError if points are out of range."""

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """
        Read a path from a CSV file.

        Parameters
        ----------
        path : path
            UTF-8 text whose first line names the columns. Those of the class are read, others are ignored.

        Raises
        ------
        FileError
            When the file cannot be read, or is not such a table.
        """
        path = Path(path)
        lines = read_columns(path, "a table of gazes", cls.COLUMNS, MAX_FILE_BYTES)
        rows = []
        for number, cells in lines:
            try:
                rows.append([float(cell) for cell in cells])
            except ValueError:
                raise FileError(path, f"must have numbers in line {number}, got {', '.join(cells)[:60]}") from None
        problem = _problem_of_rows(rows, [f"line {number}" for number, _ in lines], cls.COLUMNS)
        if problem is not None:
            raise FileError(path, problem)
        try:
            return cls._of(rows)
        except ParameterError as error:
            raise FileError(path, error.detail) from None

    @classmethod
    def from_rows(cls, rows: OwnCheck[Sequence[Sequence[float]] | Floats]) -> Self:
        """
        Return the path of rows, as settings files contain them.

        Parameters
        ----------
        rows : sequence of three numbers
            Times in s, strictly ascending, and both coordinates, as the columns of files.

        Raises
        ------
        ParameterError
            When a row is not three finite numbers, or not later than the one before.

        Examples
        --------
        >>> import foveasim as fs
        >>> path = fs.video.GazePath.from_rows([[0.0, 0.0, 0.0], [1.0, 100.0, 50.0]])
        >>> path.at(0.25).tolist()
        [25.0, 12.5]
        """
        problem = _problem_of_rows(rows, [f"row {k}" for k in range(1, len(rows) + 1)], cls.COLUMNS)
        if problem is not None:
            raise ParameterError("rows", problem)
        return cls._of(rows)

    @classmethod
    def _of(cls, rows: Sequence[Sequence[float]] | Floats) -> Self:
        """Return the path of valid rows."""
        values = np.array(rows, dtype=float)
        return cls(**{"t_s": values[:, 0], cls.POINTS: values[:, 1:]})

    @property
    def rows(self) -> Floats:
        """Times and coordinates, (n, 3): see :meth:`from_rows`."""
        return np.column_stack((self.t_s, getattr(self, self.POINTS)))

    def write(self, path: str | Path) -> None:
        """
        Write the path to a CSV file, atomically: see :meth:`read`.

        Raises
        ------
        FileError
            When the file cannot be written.
        """
        with atomic_write(path) as temporary:
            np.savetxt(temporary, self.rows, fmt="%.17g", delimiter=",", header=",".join(self.COLUMNS), comments="")

    def at(self, t_s: ArrayLike) -> Floats:
        """
        Return the coordinates at given times, (..., 2), by linear interpolation.

        Before the first and after the last point they are constant.
        """
        times_s, points = finite_array("t_s", t_s), getattr(self, self.POINTS)
        return np.stack([np.interp(times_s, self.t_s, points[:, axis]) for axis in (0, 1)], axis=-1)


@dataclass(frozen=True, eq=False, repr=False)
class GazePath(_TimedPath):
    """
    Gaze positions as a function of time.

    Parameters
    ----------
    t_s : (n,) float64, s
        Times in strictly ascending order.
    xy_um : (n, 2) float64, µm
        Gaze positions in the sensor plane, in the image of the complete picture: points that are imaged on the sensor centre.

    Raises
    ------
    ParameterError
        When times are not strictly ascending, or there is not one position per time.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> path = fs.video.GazePath(
    ...     np.array([0.0, 1.0]), np.array([[0.0, 0.0], [100.0, 50.0]])
    ... )
    >>> path.at([0.25]).tolist()
    [[25.0, 12.5]]
    """

    COLUMNS: ClassVar[tuple[str, str, str]] = ("t_s", "x_um", "y_um")
    POINTS: ClassVar[str] = "xy_um"

    t_s: Floats
    xy_um: Floats


@dataclass(frozen=True, eq=False, repr=False)
class DirectionPath(_TimedPath):
    """
    Directions of a camera that turns in a panorama, as a function of time.

    Parameters
    ----------
    t_s : (n,) float64, s
        Times in strictly ascending order.
    direction_deg : (n, 2) float64, degrees
        Azimuth, within ±360, and elevation, within ±90: :attr:`foveasim.Camera.gaze_deg`. Both are interpolated linearly.

    Raises
    ------
    ParameterError
        When times are not strictly ascending, there is not one direction per time, or an angle is out of range.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> path = fs.video.DirectionPath(
    ...     np.array([0.0, 1.0]), np.array([[0.0, 0.0], [90.0, 10.0]])
    ... )
    >>> path.at([0.5]).tolist()
    [[45.0, 5.0]]
    """

    COLUMNS: ClassVar[tuple[str, str, str]] = ("t_s", "azimuth_deg", "elevation_deg")
    POINTS: ClassVar[str] = "direction_deg"

    t_s: Floats
    direction_deg: Floats

    def _check(self, points: Floats) -> None:
        for each_deg in points.tolist():
            check_direction(self.POINTS, each_deg)


def read_gaze_path(path: str | Path) -> GazePath | DirectionPath:
    """
    Read a path of positions or of directions from a CSV file.

    Parameters
    ----------
    path : path
        UTF-8 text whose first line names the columns: ``t_s``, ``x_um`` and ``y_um``, or ``t_s``, ``azimuth_deg`` and
        ``elevation_deg``. Others are ignored.

    Returns
    -------
    GazePath or DirectionPath

    Raises
    ------
    FileError
        When the file cannot be read, or is not such a table.
    """
    return path_class(Path(path)).read(path)


def path_class(path: Path) -> type[GazePath | DirectionPath]:
    """Return the class of the path in a CSV file, by its columns."""
    try:
        with path.open("rb") as file:
            names = file.readline(MAX_HEADER_BYTES).decode("utf-8-sig", "replace").split(",")
    except OSError:  # reported by the reader
        return GazePath
    return DirectionPath if set(DirectionPath.COLUMNS) <= {name.strip() for name in names} else GazePath


def _problem_of_rows(
    rows: Sequence[Sequence[float]] | Floats, names: Sequence[str], columns: tuple[str, ...]
) -> str | None:
    """Return the first problem of rows with names such as "row 1"; None if they are a path."""
    if len(rows) == 0:
        return f"must have one or more rows [{', '.join(columns)}]"
    before_s = -math.inf
    for k, (row, name) in enumerate(zip(rows, names, strict=True)):
        if not _is_row(row):
            listed = f"{', '.join(columns[:2])} and {columns[2]}"
            return f"must have three finite numbers, {listed}, in {name}, got {format_value(row)}"
        if row[0] <= before_s:
            return (
                f"must have times in strictly ascending order, got {row[0]:g} s in {name} after {before_s:g} s in "
                f"{names[k - 1]}"
            )
        before_s = row[0]
    return None


def _is_row(row: Any) -> bool:
    """Return whether an object is a time and a position."""
    return (
        isinstance(row, list | tuple | np.ndarray)
        and len(row) == 3
        and all(isinstance(x, int | float | np.number) and not isinstance(x, bool) and math.isfinite(x) for x in row)
    )


def saccades(
    *,
    duration_s: Annotated[float, DURATION],
    frame_s: Annotated[float, DURATION],
    size_um: tuple[float, float],
    seed: int,
    fixation_s: float = 0.3,
    saccade_s: Annotated[float, NOT_NEGATIVE] = 0.05,
    drift_um_per_root_s: Annotated[float, NOT_NEGATIVE] = 0.0,
) -> GazePath:
    """
    Generate a random gaze path of saccades, and fixations with drift.

    Parameters
    ----------
    duration_s, frame_s : float, s
        Duration of the path, and time step between its points.
    size_um : (width, height), µm
        Size of the rectangle about the axis in which the targets are uniformly distributed; the path begins on the axis.
    seed : int
        Seed of the path.
    fixation_s : float, s
        Mean duration of a fixation: gamma distribution with a standard deviation of half the mean.
    saccade_s : float, s
        Duration of a saccade, a minimum-jerk movement ``10 u³ - 15 u⁴ + 6 u⁵``.
    drift_um_per_root_s : float, µm / sqrt(s)
        Standard deviation of the drift along either axis one second after the start of a fixation: a random walk that restarts
        with each fixation.

    Returns
    -------
    GazePath
        Path of ``round(duration_s / frame_s)`` points, the first at 0 s.

    Examples
    --------
    >>> path = saccades(duration_s=1.0, frame_s=0.01, size_um=(100.0, 50.0), seed=1)
    >>> path.xy_um.shape, path.xy_um[0].tolist()
    ((100, 2), [0.0, 0.0])
    """
    n = round(min(duration_s / frame_s, 2.0 * MAX_POINTS))
    if not 1 <= n <= MAX_POINTS:
        raise ParameterError("duration_s", f"must be 1 to {MAX_POINTS:,} frames of {frame_s:g} s", duration_s, "s")
    half_um = 0.5 * finite_array("size_um", size_um, at_least=0.0)
    fixation_s = check_number("fixation_s", fixation_s, at_least=frame_s)
    streams = Streams(seed)
    fixations, targets, walk = (streams.of(f"gaze {name}") for name in ("rests", "targets", "drift"))
    t_s = frame_s * np.arange(n)
    steps_um = drift_um_per_root_s * math.sqrt(frame_s) * walk.standard_normal((n, 2))
    xy_um = np.zeros((n, 2))
    begin_s, position_um = 0.0, np.zeros(2)
    while begin_s < t_s[-1] or begin_s == 0.0:
        stay_s = fixation_s * max(fixations.gamma(FIXATION_SHAPE) / FIXATION_SHAPE, MIN_FIXATION)
        leave_s = begin_s + stay_s
        fixation_slice = slice(*np.searchsorted(t_s, (begin_s, leave_s)))
        drift_um = np.cumsum(steps_um[fixation_slice], axis=0) - steps_um[fixation_slice][:1]
        xy_um[fixation_slice] = position_um + drift_um
        start_um = xy_um[fixation_slice][-1] if fixation_slice.start < fixation_slice.stop else position_um
        position_um = half_um * (2.0 * targets.random(2) - 1.0)
        begin_s = leave_s + saccade_s
        saccade_slice = slice(*np.searchsorted(t_s, (leave_s, begin_s)))
        u = ((t_s[saccade_slice] - leave_s) / max(saccade_s, frame_s))[:, np.newaxis]
        xy_um[saccade_slice] = start_um + (position_um - start_um) * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    return GazePath(np.asarray(t_s), xy_um)


def shift_sensor(source: Scene | PowerMap, path: GazePath) -> Iterator[tuple[Scene | PowerMap, tuple[float, float]]]:
    """
    Yield frames of a static scene for a sensor that moves behind a fixed lens.

    The frames are for :meth:`foveasim.Camera.video`. Relative illumination and aberrations do not move with the sensor. The
    image is computed once, and each frame is its integral over the shifted outlines, exact for any shift.

    Parameters
    ----------
    source : Scene or PowerMap
        Static scene or power map.
    path : GazePath
        Positions of the sensor.

    Yields
    ------
    source, (x_um, y_um)

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> scene = fs.Scene.flat(
    ...     shape=(8, 8), pitch_um=100.0, distance_m=1.0, illuminance_lux=100.0
    ... )
    >>> path = fs.video.GazePath(np.array([0.0, 0.1]), np.array([[0.0, 0.0], [5.0, 0.0]]))
    >>> [gaze_um for _, gaze_um in fs.video.shift_sensor(scene, path)]
    [(0.0, 0.0), (5.0, 0.0)]
    """
    positions_um = path_positions(path.xy_um, path.t_s)
    return TimedFrames(((source, position_um) for position_um in positions_um), FrameTimes(None, path.t_s))


def turn_camera(scene: Scene, path: DirectionPath) -> Iterator[Scene]:
    """
    Yield frames of a static panorama for a camera that turns.

    The frames are for :meth:`foveasim.Camera.video`. The image of each direction is computed once; equal directions that follow
    each other share it.

    Parameters
    ----------
    scene : Scene
        A panorama.
    path : DirectionPath
        Directions of the camera from the orientation of the scene.

    Yields
    ------
    Scene

    Raises
    ------
    ParameterError
        Immediately when the scene is not a panorama.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> scene = fs.Scene.from_panorama(np.ones((16, 32)), luminance_cd_m2=100.0)
    >>> path = fs.video.DirectionPath(
    ...     np.array([0.0, 0.1]), np.array([[0.0, 0.0], [30.0, 10.0]])
    ... )
    >>> [frame.panorama.gaze_deg for frame in fs.video.turn_camera(scene, path)]
    [(0.0, 0.0), (30.0, 10.0)]
    """
    _seen_towards(scene, (0.0, 0.0))  # an error of the scene is raised here
    return TimedFrames(_turned(scene, path), FrameTimes(None, path.t_s))


def _turned(scene: Scene, path: DirectionPath) -> Iterator[Scene]:
    """Yield a panorama along a path."""
    frame: Scene | None = None
    for azimuth_deg, elevation_deg in path.direction_deg.tolist():
        gaze_deg = (azimuth_deg, elevation_deg)
        if frame is None or frame.panorama is None or frame.panorama.gaze_deg != gaze_deg:
            frame = _seen_towards(scene, gaze_deg)
        yield frame


def _seen_towards(scene: Scene | PowerMap, gaze_deg: tuple[float, float]) -> Scene:
    if not isinstance(scene, Scene):
        raise ParameterError("scene", "must be a panorama for a path of directions, got a power map; use a GazePath")
    return scene.turned(gaze_deg=gaze_deg)


def follow_gaze(
    frames: Iterable[Scene | PowerMap],
    path: GazePath | DirectionPath,
    *,
    frame_s: Annotated[float | None, DURATION] = None,
    first_frame: Annotated[int, NOT_NEGATIVE] = 0,
    times_s: ArrayLike | None = None,
) -> Iterator[Frame]:
    """
    Yield frames of a changing scene along a gaze path.

    The frames are for :meth:`foveasim.Camera.video`, as those of :func:`shift_sensor` for a static scene.

    Parameters
    ----------
    frames : iterable of Scene or PowerMap
        Frames of a video, such as a :class:`FrameSource`.
    path : GazePath or DirectionPath
        With directions, the frames are panoramas.
    frame_s : float, s
        Frame period.
    first_frame : int
        Number of the first frame, whose gaze is that at ``first_frame * frame_s``.
    times_s : (n_frame,) float64, s
        Times of the frames on the axis of the path, instead of ``frame_s``; by default those that the frames carry.

    Yields
    ------
    light, (x_um, y_um); along directions, panoramas

    Raises
    ------
    ParameterError
        Immediately when the frames have no times, or both ``frame_s`` and ``times_s`` are given; during iteration when there is
        not one time per frame.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> frames = [
    ...     fs.Scene.flat(
    ...         shape=(8, 8), pitch_um=100.0, distance_m=1.0, illuminance_lux=100.0
    ...     )
    ... ] * 3
    >>> path = fs.video.GazePath(np.array([0.0, 0.1]), np.array([[0.0, 0.0], [10.0, 0.0]]))
    >>> [gaze_um for _, gaze_um in fs.video.follow_gaze(frames, path, frame_s=0.05)]
    [(0.0, 0.0), (5.0, 0.0), (10.0, 0.0)]
    """
    times = FrameTimes.of(frame_s, times_s, frames=frames) or carried_times(frames)
    if times is None:
        raise ParameterError("frame_s", "must be given, or 'times_s': the frames have no times")
    if first_frame and times.times_s is not None:
        raise ParameterError(
            "first_frame", "must not be given with times of the frames, which say when they are", first_frame
        )
    return TimedFrames(_followed(frames, path, times, first_frame), times)


def _followed(
    frames: Iterable[Scene | PowerMap], path: GazePath | DirectionPath, times: FrameTimes, first: int
) -> Iterator[Frame]:
    """Yield frames with the gaze at their times."""
    for n, light in enumerate(frames, first):
        times.check_number(n)
        x, y = path.at(times.at_s(n)).tolist()
        yield (light, (x, y)) if isinstance(path, GazePath) else _seen_towards(light, (x, y))


def pan_camera(
    scene: Scene, path: GazePath, optics: Optics | Camera, *, shape: tuple[int, int]
) -> Iterator[tuple[Scene, tuple[float, float]]]:
    """
    Yield frames of a large scene for a camera that moves in front of it.

    The frames are for :meth:`foveasim.Camera.video`. The scene is cropped at integer pixel positions, and the remaining shift
    of at most half a pixel moves the photosites, so that pictures are not resampled. Relative illumination and aberrations are
    centred on the gaze to within this half pixel.

    Parameters
    ----------
    scene : Scene
        The complete scene. With ``fit`` and a camera, the cropped part is framed on its layout.
    path : GazePath
        Gaze positions in the sensor plane, in the image of the complete scene.
    optics : Optics or Camera
        Lens of the camera, or the camera.
    shape : (n_y, n_x)
        Shape of the cropped part in pixels.

    Yields
    ------
    scene, (x_um, y_um)

    Raises
    ------
    ParameterError
        Immediately when an argument is of another class, the part is larger than the scene, or a scene with ``fit`` is given
        without a camera; during iteration when the part extends beyond the scene.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> optics = fs.Optics(focal_length_mm=8.0, f_number=2.8)
    >>> scene = fs.Scene.flat(
    ...     shape=(200, 200), pitch_um=500.0, distance_m=1.0, illuminance_lux=500.0
    ... )
    >>> path = fs.video.GazePath(np.array([0.0, 0.1]), np.array([[0.0, 0.0], [10.0, 0.0]]))
    >>> frames = list(fs.video.pan_camera(scene, path, optics, shape=(64, 64)))
    >>> (
    ...     frames[1][0].basis.shape,
    ...     round(frames[1][1][0], 2),
    ... )  # 10 µm are 2 pixels of 4.03 µm, and 1.94 µm
    ((1, 64, 64), 1.94)
    """
    n_y, n_x = check_shape("shape", shape)
    if n_y > scene.basis.shape[1] or n_x > scene.basis.shape[2]:
        raise ParameterError("shape", f"must not exceed the shape of the scene, {scene.basis.shape[1:]}", (n_y, n_x))
    if isinstance(optics, Camera):
        camera, optics = optics, optics.optics
        if scene.pitch_um is None:
            # The remaining shift moves the photosites by up to half a pixel on each side.
            margin = 1 if scene.fit == "cover" else 0
            framed = camera.fit_scene(_crop(scene, 0, 0, max(1, n_y - margin), max(1, n_x - margin)))
            scene = scene.framed(framed.pitch_um or 0.0, framed.axis_um)
    elif scene.pitch_um is None:
        raise ParameterError(
            "scene", "must have a pixel pitch", hint="pass the camera instead of its optics, or camera.fit_scene(scene)"
        )
    return TimedFrames(_parts(scene, path, optics.grid(scene).pitch_x_um, n_y, n_x), FrameTimes(None, path.t_s))


def _crop(scene: Scene, left: int, bottom: int, n_y: int, n_x: int) -> Scene:
    """Return a part of a scene, with its pitch or its framing."""
    part = slice(bottom, bottom + n_y), slice(left, left + n_x)
    depth_m = None if scene.depth_m is None else scene.depth_m[part]
    return replace(scene, basis=scene.basis[:, *part], depth_m=depth_m, field_of_view_deg=None)


def _parts(
    scene: Scene, path: GazePath, cell_um: float, n_y: int, n_x: int
) -> Iterator[tuple[Scene, tuple[float, float]]]:
    """Yield the cropped parts of a scene along a path, and the remaining shifts."""
    free_y, free_x = scene.basis.shape[1] - n_y, scene.basis.shape[2] - n_x
    previous: tuple[int, int] | None = None
    part = scene
    digests = path_digests(path.xy_um)
    for k, (t_s, position_um) in enumerate(zip(path.t_s.tolist(), path.xy_um.tolist(), strict=True)):
        # The centre of the part is off by half a pixel if the number of free pixels is odd.
        left, bottom = (
            round(at_um / cell_um + 0.5 * free) for at_um, free in zip(position_um, (free_x, free_y), strict=True)
        )
        if not (0 <= left <= free_x and 0 <= bottom <= free_y):
            raise ParameterError(
                "path",
                f"must stay within the scene, but leaves it at {t_s:g} s: a part of {n_x} x {n_y} pixels can move by at most "
                f"({0.5 * free_x * cell_um:.4g}, {0.5 * free_y * cell_um:.4g}) µm",
                tuple(position_um),
                "µm",
            )
        if (left, bottom) != previous:
            part = _crop(scene, left, bottom, n_y, n_x)
            previous = left, bottom
        x_um, y_um = (
            at_um - (at - 0.5 * free) * cell_um
            for at_um, at, free in zip(position_um, (left, bottom), (free_x, free_y), strict=True)
        )
        yield part, PathPosition((x_um, y_um), (position_um[0], position_um[1]), digests, k, t_s)

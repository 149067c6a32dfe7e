"""Gaze path of a session: its rows for the page, replay, files and random paths."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.validation import Floats
from foveasim.config import Shot
from foveasim.errors import FoveasimError, ParameterError, SimulationError
from foveasim.fields import PowerMap
from foveasim.studio._messages.models import AddSaccades, FollowGaze, OpenGazeFile, handles
from foveasim.video import GazePath, saccades

if TYPE_CHECKING:
    from foveasim.studio._session import Session

#: Time step of a replay without a frame rate of the readout, s.
STEP_S = 1.0 / 30.0
#: Largest number of rows: the settings of the page contain them.
MAX_ROWS = 10_000


class SessionGaze:
    """
    Gaze path of the settings of a session, which is read once for equal settings.

    ``line``: returns the message of an error in one line.
    """

    def __init__(self, line: Callable[[BaseException], str]) -> None:
        self._line = line
        self._section: Any = None
        self._path: GazePath | None = None
        self._sent: dict[str, Any] | None = None

    def path_of(self, settings: Mapping[str, Any]) -> GazePath | None:
        """
        Return the path of settings, None without one.

        Raises FileError or ParameterError when it is invalid, or has more rows than the page can show.
        """
        section = settings.get("gaze_path")
        if section != self._section or (section is not None and self._path is None):
            self._section, self._path = section, None
            self._path = _read(section)
        return self._path

    def required_path(self, settings: Mapping[str, Any]) -> GazePath:
        """
        Return the path of settings.

        Raises SimulationError when they have none.
        """
        path = self.path_of(settings)
        if path is None:
            raise SimulationError("there is no gaze path; record or open one")
        return path

    def at(self, settings: Mapping[str, Any], t_s: float) -> dict[str, Any]:
        """Return settings with the gaze of their path at a time."""
        return {**settings, "gaze_um": self.required_path(settings).at(t_s).tolist()}

    def forget(self) -> None:
        """Send the message again."""
        self._sent = None

    def message(self, settings: Mapping[str, Any], shot: Shot | None) -> dict[str, Any] | None:
        """Return the rows and the time step of a replay, or None if the page has them."""
        rows: list[list[float]] = []
        problem = ""
        try:
            path = self.path_of(settings)
            rows = [] if path is None else path.rows.tolist()
        except FoveasimError as error:
            problem = self._line(error)
        message = {"kind": "gaze_path", "rows": rows, "problem": problem, "step_s": step_s(shot)}
        if message == self._sent:
            return None
        self._sent = message
        return message


def _read(section: Any) -> GazePath | None:
    """Return the path of a setting, from its file or its rows."""
    if section is None:
        return None
    path = GazePath.read(section) if isinstance(section, str) else GazePath.from_rows(section)
    if path.t_s.size > MAX_ROWS:
        raise ParameterError("gaze_path", f"must have at most {MAX_ROWS:,} rows in the studio", path.t_s.size)
    return path


def step_s(shot: Shot | None) -> float:
    """Return the time step of a replay over a picture: one frame of the readout."""
    readout = None if shot is None or shot.rules is None else shot.rules.readout
    rate_per_s = None if readout is None else readout.frames_per_s
    return 1.0 / rate_per_s if rate_per_s else STEP_S


def rows_of_file(path: str) -> list[list[float]]:
    """
    Return the rows of a CSV file.

    Raises FileError or ParameterError when the file is invalid, or has more rows than the page can show.
    """
    found = _read(path)
    assert found is not None
    return _plain(found)


def random_rows(parameters: Mapping[str, Any], shot: Shot | None, frame_s: float | None) -> list[list[float]]:
    """
    Return the rows of a random path of saccades for which the image covers the photosites.

    ``parameters``: those of :func:`foveasim.video.saccades`. ``frame_s``: frame period of the video that is the scene; None for
    pictures. Raises ParameterError or SimulationError when a parameter is invalid, or the image
    does not extend beyond the photosites.
    """
    if shot is None:
        raise SimulationError("there is no image for a gaze path")
    frame_s = frame_s or step_s(shot)
    duration_s = parameters.get("duration_s", 0.0)
    if duration_s > MAX_ROWS * frame_s:
        raise ParameterError("duration_s", f"must be at most {MAX_ROWS * frame_s:g} s in the studio", duration_s, "s")
    size_um = (2.0 * free_um(shot)).tolist()
    if not any(size_um):
        raise SimulationError(
            "the image does not extend beyond the photosites; choose a larger scene.gaze_range_um, or a smaller layout"
        )
    return _plain(saccades(**parameters, frame_s=frame_s, size_um=tuple(size_um)))


def free_um(shot: Shot) -> Floats:
    """Return the distances of the gaze within which the image covers all sites, (x, y) µm."""
    camera, scene = shot.camera.with_gaze((0.0, 0.0)), shot.scene
    grid = scene.grid if isinstance(scene, PowerMap) else camera.image_grid(scene)
    image_um, layout_um = (np.reshape(each.bounds_um, (2, 2)) for each in (grid, camera.layout))
    margins_um = np.stack((layout_um[0] - image_um[0], image_um[1] - layout_um[1]))
    return np.asarray(np.maximum(margins_um.min(axis=0), 0.0))


def _plain(path: GazePath) -> list[list[float]]:
    """Return the rows of a path as settings contain them."""
    rows: list[list[float]] = path.rows.tolist()
    return rows


@handles(FollowGaze)
def _follow(session: Session, message: FollowGaze) -> dict[str, Any]:
    return session.gaze.at(session.history.settings, message.t_s)


@handles(OpenGazeFile)
def _open_gaze_file(session: Session, message: OpenGazeFile) -> dict[str, Any]:
    return {**session.history.settings, "gaze_path": rows_of_file(session.files.available(message.path))}


@handles(AddSaccades)
def _add_saccades(session: Session, message: AddSaccades) -> dict[str, Any]:
    settings, shot = session.history.settings, None if session.result is None else session.result.shot
    film = session.frames.about(settings)
    parameters = message.model_dump(exclude={"id"}, exclude_none=True)
    return {**settings, "gaze_path": random_rows(parameters, shot, None if film is None else film["frame_s"])}

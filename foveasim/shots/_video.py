"""A shot whose scene moves: the frames of a folder or a video file in the place of its picture."""

from __future__ import annotations

from pathlib import Path

from foveasim.config import Shot
from foveasim.errors import ParameterError, SimulationError
from foveasim.parallel import thread_count
from foveasim.scene import Scene
from foveasim.video import Footage, write_video

__all__ = ["run_video"]

#: How long a frame is shown where nobody said.
USUAL_FRAME_S = 1.0 / 25.0


def run_video(
    shot: Shot,
    frames: str | Path,
    out: str | Path,
    *,
    frame_s: float | None = None,
    line_s: float = 0.0,
    stop: int | None = None,
    n_threads: int | None = None,
    progress: bool = False,
) -> int:
    """
    Take a video with a shot's camera, and write it.

    Parameters
    ----------
    shot : Shot
        Its scene's pitch, distance and spectra are those of the frames.
    frames : path
        A folder of pictures, or a video file.
    out : path
        As of :func:`foveasim.video.write_video`.
    frame_s : float, optional, s
        From one frame to the next; by default what the video file says.
    line_s : float, s
        Of a rolling shutter, from one line to the next.
    stop : int, optional
        How many frames to take, at most.
    n_threads : int, optional
        Frames that are computed at a time; all cores by default.
    progress : bool

    Returns
    -------
    n_frames : int
        How many were written.

    Raises
    ------
    FileError
        When frames cannot be read, or nothing written.
    ParameterError, SimulationError
        When the shot is of a map of light and not of a scene, or parts do not fit together.
    """
    if not isinstance(shot.scene, Scene):
        raise SimulationError(
            f"{shot.name} is of a map of light; frames need a scene, which says how large their pixels are"
        )
    footage = Footage(frames, like=shot.scene, frame_s=frame_s, stop=stop)
    if line_s and footage.frame_s is None:
        raise ParameterError("frame_s", "must be given for a rolling shutter: pictures in a folder do not say it")
    captures = shot.camera.video(
        footage,
        exposure_s=shot.exposure_s,
        seed=shot.seed,
        frame_s=footage.frame_s if line_s else None,
        line_s=line_s,
        ahead=thread_count(n_threads),
    )
    shown_s = footage.frame_s or USUAL_FRAME_S
    return write_video(captures, out, frame_s=shown_s, n_frames=footage.n_frames, progress=progress)

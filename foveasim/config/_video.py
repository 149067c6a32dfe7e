"""A shot whose scene moves: the frames of a folder or a video file instead of its picture."""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields
from pathlib import Path
from typing import Any

from foveasim._core.provenance import to_plain_data, versions
from foveasim._core.threads import thread_count
from foveasim.config import Shot
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import Layout
from foveasim.scene import Scene
from foveasim.video import FrameSource, count_recorded_frames, write_video
from foveasim.video.frame_source import pictures_in

__all__ = ["run_video"]

#: How long a frame is shown where nobody said.
USUAL_FRAME_S = 1.0 / 25.0
#: Parts of the shot's scene instead of which the frames have their own.
OF_FRAMES = ("basis", "source")


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
    Take a video with a shot's camera, and write it; a zarr folder is gone on with where it was ended.

    Parameters
    ----------
    shot : Shot
        Its scene's pitch, distance and spectra are those of the frames.
    frames : path
        A folder of pictures, or a video file.
    out : path
        As of :func:`foveasim.video.write_video`. A zarr folder that is finished is left as it is.
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
        How many there are.

    Raises
    ------
    FileError
        When frames cannot be read, or nothing written, or a zarr folder is another recording.
    ParameterError, SimulationError
        When the shot is of a map of light and not of a scene, or parts do not fit together.
    """
    if not isinstance(shot.scene, Scene):
        raise SimulationError(
            f"{shot.name} is of a map of light; frames need a scene, which says how large their pixels are"
        )
    footage = FrameSource(frames, template=shot.scene, frame_s=frame_s, stop=stop)
    if line_s and footage.frame_s is None:
        raise ParameterError("frame_s", "must be given for a rolling shutter: pictures in a folder do not say it")
    is_kept = Path(out).suffix.lower() == ".zarr"
    n_before = count_recorded_frames(out) if is_kept else 0
    captures = shot.camera.video(
        footage.from_frame(n_before),
        exposure_s=shot.exposure_s,
        seed=shot.seed,
        first_frame=n_before,
        frame_s=footage.frame_s if line_s else None,
        line_s=line_s,
        ahead=thread_count(n_threads),
    )
    return write_video(
        captures,
        out,
        frame_s=footage.frame_s or USUAL_FRAME_S,
        n_frames=footage.n_frames,
        progress=progress,
        resume=is_kept,
        plan=_plan(shot, shot.scene, Path(frames), footage.frame_s, line_s, stop) if is_kept else None,
    )


def _plan(
    shot: Shot, scene: Scene, frames: Path, frame_s: float | None, line_s: float, stop: int | None
) -> dict[str, Any]:
    """All that codes depend on, as plain data; of the frames their files' names and sizes, which are quickly looked up."""
    camera, layout = shot.camera, shot.camera.sensor.layout
    assert isinstance(layout, Layout)  # a camera has no other
    files = [[path.name, path.stat().st_size] for path in (pictures_in(frames) if frames.is_dir() else [frames])]
    return {
        "scene": {f.name: to_plain_data(getattr(scene, f.name)) for f in fields(scene) if f.name not in OF_FRAMES},
        "optics": to_plain_data(camera.optics),
        "distortion": to_plain_data(camera.distortion),
        "layout": to_plain_data({**layout.provenance, "xy_um": layout.xy_um, "columns": layout.columns}),
        "sensor": {name: value for name, value in to_plain_data(camera.sensor).items() if name != "layout"},
        "exposure_s": shot.exposure_s,
        "seed": shot.seed,
        "frames": hashlib.sha256(json.dumps(files).encode()).hexdigest(),
        "shutter": {"frame_s": frame_s, "line_s": line_s} if line_s else None,
        "stop": stop,
        "versions": versions(),
    }

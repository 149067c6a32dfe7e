"""Videos with the camera of a shot: pictures or a video file instead of its scene."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from foveasim._core.calls import OwnCheck
from foveasim._core.provenance import to_plain_data, versions
from foveasim._core.threads import thread_count
from foveasim.capture import Capture
from foveasim.config._objects import Shot
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import Layout
from foveasim.layout.rows import Scan
from foveasim.scene import Scene
from foveasim.video import (
    DirectionPath,
    FrameSource,
    GazePath,
    count_recorded_frames,
    follow_gaze,
    read_gaze_path,
    write_video,
)
from foveasim.video.frame_source import list_pictures
from foveasim.video.writing import DEFAULT_FRAME_S

#: Attributes of the scene that the frames replace.
FRAME_ATTRIBUTES = ("basis", "source")


def run_video(
    shot: Shot,
    frames: str | Path,
    out: str | Path,
    *,
    frame_s: float | None = None,
    line_s: float = 0.0,
    scan: Scan | None = None,
    stop: int | None = None,
    gaze: str | Path | None = None,
    n_threads: int | None = None,
    progress: bool = False,
    times_s: OwnCheck[str | Path | ArrayLike | None] = None,
) -> int:
    """
    Simulate and write a video with a shot's camera; an interrupted zarr store resumes.

    Parameters
    ----------
    shot : Shot
        Pitch or framing, distance and spectra of its scene apply to the frames.
    frames : path
        A directory of pictures, or a video file.
    out : path
        As for :func:`foveasim.video.write_video`. A complete zarr store is not changed.
    frame_s : float, optional, s
        Frame period; by default the frames have the times of the shot (``times_s``) or the time stamps of the video file.
    line_s : float, s
        Line time of a rolling shutter.
    scan : str, optional
        Order of its rows or columns: :meth:`foveasim.Camera.video`.
    stop : int, optional
        Maximum number of frames.
    gaze : path, optional
        CSV file of a gaze path (:func:`foveasim.video.read_gaze_path`), with times from the first frame, instead of the path of
        the shot (``gaze_path``); without both, each frame has the gaze of the shot.
    n_threads : int, optional
        Number of frames that are computed at a time; one per core by default.
    progress : bool
        Whether to show a progress bar.
    times_s : (n_frame,) float64, or path, optional, s
        Times of the frames, or a CSV file with the column ``t_s``, instead of those of the shot.

    Returns
    -------
    n_frames : int
        Number of frames in the output.

    Raises
    ------
    FileError
        When frames cannot be read, the output cannot be written, or a zarr store is another recording.
    ParameterError, SimulationError
        When the shot has a power map instead of a scene, or the parts are incompatible.

    Examples
    --------
    >>> import foveasim as fs
    >>> shot = fs.config.read_shot("shot.yaml")  # doctest: +SKIP
    >>> fs.config.run_video(shot, "frames", "video.mp4", frame_s=0.04)  # doctest: +SKIP
    """
    if not isinstance(shot.scene, Scene):
        raise SimulationError(
            f"{shot.name} has a power map; frames require a scene, which specifies the size of their pixels"
        )
    if times_s is None and frame_s is None:
        times_s = shot.times_s
    encoding: dict[str, Any] = {} if shot.frame_encoding is None else {"encoding": shot.frame_encoding}
    source = FrameSource(frames, template=shot.scene, frame_s=frame_s, times_s=times_s, stop=stop, **encoding)
    step_s = source.frame_s
    is_irregular = step_s is None and source.times_s is not None
    if line_s and step_s is None and not is_irregular:
        raise ParameterError(
            "frame_s", "or 'times_s' must be given for a rolling shutter: pictures in a directory have no times"
        )
    path = shot.gaze_path if gaze is None else read_gaze_path(gaze)
    is_store = Path(out).suffix.lower() == ".zarr"
    n_before = count_recorded_frames(out) if is_store else 0
    scenes = source.from_frame(n_before)
    captures: Iterable[Capture] = ()
    if not is_irregular or scenes.times_s is not None:  # otherwise the recording has all frames
        of_path: dict[str, Any] = (
            {} if is_irregular else {"frame_s": step_s or DEFAULT_FRAME_S, "first_frame": n_before}
        )
        captures = shot.camera.video(
            scenes if path is None else follow_gaze(scenes, path, **of_path),
            exposure_s=shot.requested_s,
            seed=shot.seed,
            first_frame=n_before,
            frame_s=step_s if line_s else None,
            line_s=line_s,
            scan=scan,
            ahead=thread_count(n_threads),
        )
    return write_video(
        captures,
        out,
        n_frames=source.n_frames,
        progress=progress,
        resume=is_store,
        plan=_plan(shot, shot.scene, Path(frames), source, line_s, scan, stop, path) if is_store else None,
    )


def _plan(
    shot: Shot,
    scene: Scene,
    frames: Path,
    source: FrameSource,
    line_s: float,
    scan: Scan | None,
    stop: int | None,
    path: GazePath | DirectionPath | None,
) -> dict[str, Any]:
    """Return everything that codes depend on; for frames, names and sizes of their files."""
    camera, layout = shot.camera, shot.camera.sensor.layout
    assert isinstance(layout, Layout)  # checked by Camera
    files = [[path.name, path.stat().st_size] for path in (list_pictures(frames) if frames.is_dir() else [frames])]
    return {
        "scene": {
            f.name: to_plain_data(getattr(scene, f.name)) for f in fields(scene) if f.name not in FRAME_ATTRIBUTES
        },
        "optics": to_plain_data(camera.optics),
        "distortion": to_plain_data(camera.distortion),
        "layout": to_plain_data({**layout.provenance, "xy_um": layout.xy_um, "columns": layout.columns}),
        "sensor": {name: value for name, value in to_plain_data(camera.sensor).items() if name != "layout"},
        "exposure_s": shot.requested_s,
        "seed": shot.seed,
        "frames": hashlib.sha256(json.dumps(files).encode()).hexdigest(),
        "encoding": shot.frame_encoding,
        "shutter": {"frame_s": source.frame_s, "line_s": line_s, "scan": scan} if line_s else None,
        "times_s": None if source.frame_s is not None else to_plain_data(source.times_s),
        "stop": stop,
        "gaze": {
            "gaze_um": camera.gaze_um,
            "gaze_deg": camera.gaze_deg,
            "axis": camera.axis,
            "path": None if path is None else to_plain_data(path),
        },
        "versions": versions(),
    }

"""
Videos: scenes from pictures and gaze paths; recordings of captures and video files.

::

    frames = fs.video.FrameSource(
        "street.mp4", pitch_um=20.0, distance_m=0.8, peak_radiance_w_m2_sr_nm=0.1
    )
    fs.video.write_video(
        camera.video(frames, exposure_s=1 / 100, seed=0), "street.zarr", progress=True
    )
"""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.video.frame_source import FrameSource
from foveasim.video.gaze import (
    DirectionPath,
    GazePath,
    follow_gaze,
    pan_camera,
    read_gaze_path,
    saccades,
    shift_sensor,
    turn_camera,
)
from foveasim.video.recording import Recording, count_recorded_frames, partial_path, read_recording
from foveasim.video.writing import write_video

__all__ = [
    "DirectionPath",
    "FrameSource",
    "GazePath",
    "Recording",
    "count_recorded_frames",
    "follow_gaze",
    "pan_camera",
    "partial_path",
    "read_gaze_path",
    "read_recording",
    "saccades",
    "shift_sensor",
    "turn_camera",
    "write_video",
]

publish(__name__)

"""Video files as sequences of pictures with times."""

from __future__ import annotations

from foveasim._io.videos.files import SandboxedVideo, VideoFile, frame_pixels

__all__ = ["SandboxedVideo", "VideoFile", "frame_pixels"]

"""The camera: optics and a sensor, from scenes to captures."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.camera._camera import Camera, GazeAxis
from foveasim.camera._frames import Frame

__all__ = ["Camera", "Frame", "GazeAxis"]

publish(__name__)

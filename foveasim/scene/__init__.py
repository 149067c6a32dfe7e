"""Scenes: photographs, hyperspectral cubes, flat fields, points and test charts."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.scene import charts
from foveasim.scene._scene import Scene
from foveasim.scene.cubes import CUBE_FORMATS, Cube
from foveasim.scene.registry import SCENES

__all__ = ["CUBE_FORMATS", "SCENES", "Cube", "Scene", "charts"]

publish(__name__)

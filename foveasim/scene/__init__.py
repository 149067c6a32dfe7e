"""Scenes: photographs, hyperspectral cubes, displays, flat fields, points and test charts."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.scene import charts, displays
from foveasim.scene._scene import Scene
from foveasim.scene.cubes import CUBE_FORMATS, Cube
from foveasim.scene.displays._display import Display
from foveasim.scene.registry import DISPLAYS, SCENES

__all__ = ["CUBE_FORMATS", "DISPLAYS", "SCENES", "Cube", "Display", "Scene", "charts", "displays"]

publish(__name__)

"""Scenes: photographs, flat fields, point sources and test charts in radiometric units."""

from __future__ import annotations

from foveasim.scene import charts
from foveasim.scene._scene import Scene
from foveasim.scene.registry import SCENES

__all__ = ["SCENES", "Scene", "charts"]

"""Registries of scenes, charts and displays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from foveasim._core.registry import Registry

__all__ = ["DISPLAYS", "SCENES"]

#: Functions that return a :class:`foveasim.Scene`, by their names in settings files. Installed packages add functions as
#: entry points of the group ``foveasim.scenes``.
SCENES: Registry[Callable[..., Any]] = Registry("scene", "foveasim.scenes")

#: Functions that return a :class:`foveasim.scene.Display`, by their names in settings files and in
#: :meth:`foveasim.Scene.from_display`. Installed packages add functions as entry points of the group ``foveasim.displays``.
DISPLAYS: Registry[Callable[..., Any]] = Registry("display", "foveasim.displays")

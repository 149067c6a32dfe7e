"""Registry of scenes and charts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from foveasim._core.registry import Registry

__all__ = ["SCENES"]

#: Functions that return a :class:`foveasim.Scene`, by their names in settings files. Installed packages add functions as
#: entry points of the group ``foveasim.scenes``.
SCENES: Registry[Callable[..., Any]] = Registry("scene", "foveasim.scenes")

"""Registry of lens models."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from foveasim._core.registry import Registry

#: Lens models by their names in settings files; calling an entry returns an object with ``distort`` and ``undistort``.
#: Installed packages add models as entry points of the group ``foveasim.lenses``.
LENSES: Registry[Callable[..., Any]] = Registry("lens model", "foveasim.lenses")

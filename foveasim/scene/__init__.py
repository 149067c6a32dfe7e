"""Scenes: photographs, flat fields and point sources as light in physical units."""

from __future__ import annotations

from foveasim.scene._scene import Scene

__all__ = ["Scene"]

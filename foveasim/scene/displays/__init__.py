"""Bundled displays: an LCD and an OLED display."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from foveasim._core.calls import publish
from foveasim.scene.displays._bundled import lcd, oled
from foveasim.scene.registry import DISPLAYS

__all__ = ["lcd", "oled"]

__getattr__: Callable[[str], Any] = DISPLAYS.attributes_of(__name__)

publish(__name__)

"""Start page: presets, templates of new sensors, and recent files."""

from __future__ import annotations

from foveasim.studio._start.contents import contents_of
from foveasim.studio._start.recent import recent_files

__all__ = ["contents_of", "recent_files"]

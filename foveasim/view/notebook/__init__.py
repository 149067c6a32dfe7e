"""Rich representations of objects in notebooks: HTML and PNG."""

from __future__ import annotations

from foveasim.view.notebook._objects import to_html, to_png

__all__ = ["to_html", "to_png"]

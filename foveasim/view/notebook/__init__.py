"""Rich representations of objects in notebooks: HTML and PNG."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.view.notebook._objects import html_table, to_html, to_png
from foveasim.view.notebook._widget import widget

__all__ = ["html_table", "to_html", "to_png", "widget"]

publish(__name__)

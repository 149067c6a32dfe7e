"""Self-contained web pages that need no network."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.view.web._page import check_page_path, web_page, write_web_page
from foveasim.view.web._serve import open_page, serve_page
from foveasim.view.web._solid_page import solid_page, write_solid_page

__all__ = [
    "check_page_path",
    "open_page",
    "serve_page",
    "solid_page",
    "web_page",
    "write_solid_page",
    "write_web_page",
]

publish(__name__)

"""The page: template, style, scripts and data joined to one file that needs no network."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from foveasim._io.atomic import atomic_write
from foveasim.capture import Capture
from foveasim.errors import FileError
from foveasim.layout import Layout, Report
from foveasim.view.web._content import content_of
from foveasim.view.web._pack import packed

__all__ = ["bundled", "check_page_path", "joined", "web_page", "write_web_page"]

#: Endings of pages.
ENDINGS = (".html", ".htm")
#: A page loads nothing: its own scripts and style alone, told by their checksums, and pictures that stand in it.
POLICY = (
    "default-src 'none'; script-src '{script}'; style-src '{style}'; img-src data: blob:; base-uri 'none'; "
    "form-action 'none'"
)
#: What modules take from each other, and what they give: lines of their own, without other names for the same.
IMPORT = re.compile(r'^import \{[\w$, ]+\} from "\./(\w+\.js)";\n', re.MULTILINE)
EXPORT = re.compile(r"^export (?=(?:async )?function |class |const )", re.MULTILINE)


def web_page(data: Layout | Capture, *, report: Report | None = None, name: str = "") -> str:
    """
    A page to explore a layout or a capture in a browser: zoom, values of the site under the mouse, colours, histogram.

    Parameters
    ----------
    data : Layout or Capture
    report : Report, optional
        Of a check of this layout: its violations are listed and marked.
    name : str
        Heading; by default what made the layout.

    Returns
    -------
    text : str
        HTML with everything in it, for a browser with WebGL2; it loads nothing from anywhere.

    Raises
    ------
    ParameterError
        When the data is neither, or the report is of another layout.
    GeometryError
        When the layout has no sites.

    Examples
    --------
    >>> from foveasim.layout import grid
    >>> page = web_page(grid(n_x=4, n_y=3, pitch_um=2.0), name="a small grid")
    >>> "<title>a small grid</title>" in page
    True
    """
    content = content_of(data, report, name=name)
    arrays = {key: packed(values) for key, values in content.arrays.items()}
    about = {**content.about, "arrays": {key: told for key, (told, _) in arrays.items()}}
    return joined(
        "template.html",
        ("page.css",),
        "page.js",
        about,
        {key: text for key, (_, text) in arrays.items()},
        title=str(content.about["name"]),
        alt="What the sensor saw" if isinstance(data, Capture) else "The photosites of the layout",
        picture="data:image/png;base64," + base64.b64encode(content.picture_png).decode(),
    )


def write_web_page(data: Layout | Capture, path: str | Path, *, report: Report | None = None, name: str = "") -> None:
    """
    Write :func:`web_page` to a file, whole or not at all.

    Parameters
    ----------
    data : Layout or Capture
    path : path
        Ending in ``.html``.
    report : Report, optional
    name : str
        Heading; by default what made the layout.

    Raises
    ------
    FileError
        When the ending is another, or nothing can be written there.
    ParameterError, GeometryError
        As for :func:`web_page`.
    """
    write_page(path, lambda: web_page(data, report=report, name=name))


def write_page(path: str | Path, page: Callable[[], str]) -> None:
    """
    Write a page atomically; it is made after its path was checked.

    Raises
    ------
    FileError
        When the path does not end as pages do, its directory does not exist, or nothing can be written there.
    """
    target = check_page_path(path)
    text = page()
    with atomic_write(target) as temporary:
        temporary.write_text(text, encoding="utf-8")


def check_page_path(path: str | Path) -> Path:
    """
    The path of a page, before anything is computed for it.

    Raises
    ------
    FileError
        When it does not end as pages do, or its folder does not exist.
    """
    target = Path(path)
    if target.suffix.lower() not in ENDINGS:
        raise FileError(target, "must end in .html")
    if not target.parent.is_dir():
        raise FileError(target, f"cannot be written: the folder {target.parent} does not exist")
    return target


def joined(
    template: str,
    styles: tuple[str, ...],
    script: str,
    about: dict[str, Any],
    data: dict[str, str],
    **texts: str,
) -> str:
    """
    One HTML text of its parts.

    Parameters
    ----------
    template, styles, script : str
        Files in this package. The script is the module that imports all others, as :func:`bundled` joins them.
    about : dict
        Plain data, for the element ``about``.
    data : dict of str to base64
        Packed arrays, for elements ``data-NAME``.
    **texts : str
        For the template's places, escaped.
    """
    style = "".join(map(_part, styles))
    script = bundled(script)
    # Of what ends a script element nothing may stand in one, whatever a column of a stranger's file is called.
    plain = json.dumps(about, ensure_ascii=True, allow_nan=False).replace("<", "\\u003c").replace(">", "\\u003e")
    elements = [f'<script type="application/json" id="about">{plain}</script>']
    elements += [f'<script type="text/plain" id="data-{key}">{text}</script>' for key, text in data.items()]
    return Template(_part(template)).substitute(
        {name: html.escape(text) for name, text in texts.items()},
        policy=html.escape(POLICY.format(script=_checksum(script), style=_checksum(style)), quote=False),
        style=style,
        script=script,
        data="\n".join(elements),
    )


@cache
def bundled(name: str) -> str:
    """
    Return a module and all that it imports as one script, which a page from a file may run where it may not import.

    Parameters
    ----------
    name : str
        A module in this package, such as ``"page.js"``. Modules import names from each other as they are, at their top, and
        no two have the same names.

    Returns
    -------
    text : str
        Every module once, behind those that it imports, in a scope that is closed to others.
    """
    modules: dict[str, str] = {}

    def add(module: str) -> None:
        if module not in modules:
            text = _part(module)
            for imported in IMPORT.findall(text):
                add(imported)
            modules[module] = EXPORT.sub("", IMPORT.sub("", text))

    add(name)
    return '(() => {\n"use strict";\n' + "\n".join(modules.values()) + "\n})();\n"


@cache
def _part(name: str) -> str:
    return files("foveasim.view.web").joinpath(name).read_text(encoding="utf-8")


def _checksum(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()

"""Assembly of pages: template, style, scripts and data in one file that needs no network."""

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
from foveasim.fields import PowerMap
from foveasim.layout import Layout, Report
from foveasim.view.web._content import Content, content_of
from foveasim.view.web._pack import pack

#: File extensions of pages.
EXTENSIONS = (".html", ".htm")
#: Content security policy: only embedded scripts and style, identified by checksums, and embedded pictures.
POLICY = (
    "default-src 'none'; script-src '{script}'; style-src '{style}'; img-src data: blob:; base-uri 'none'; "
    "form-action 'none'"
)
#: Import and export statements of modules: without aliases.
IMPORT = re.compile(r'^import \{[\w$,\s]+\} from "\./(\w+\.js)";\n', re.MULTILINE)
#: Types for the checker, which browsers do not need.
TYPE = re.compile(r" */\*\*(?:(?!\*/).)*\*/\n?", re.DOTALL)
EXPORT = re.compile(r"^export (?=(?:async )?function |class |const )", re.MULTILINE)


def web_page(
    data: Layout | Capture,
    *,
    report: Report | None = None,
    second: Capture | None = None,
    optical_image: PowerMap | None = None,
    name: str = "",
) -> str:
    """
    Return a page to explore a layout or a capture in a browser.

    The page has zoom, values of the site under the mouse, colour scales and a histogram.

    Parameters
    ----------
    data : Layout or Capture
    report : Report, optional
        Check of this layout, whose violations are listed and marked.
    second : Capture, optional
        Capture of the same layout, shown in a second map with the same view and the same scales.
    optical_image : PowerMap, optional
        Image of the ideal lens, such as ``optics.power_map(scene)``, next to the map with a common cursor; by default the
        picture of the capture, or the sites of the layout. With lens distortion, positions in both differ.
    name : str
        Heading; by default the generator of the layout.

    Returns
    -------
    text : str
        Self-contained HTML for a browser with WebGL2; it loads no other resources.

    Raises
    ------
    ParameterError
        When the data is neither, or the report or the second capture is of another layout.
    GeometryError
        When the layout has no sites.

    Examples
    --------
    >>> from foveasim.layout import grid
    >>> page = web_page(grid(n_x=4, n_y=3, pitch_um=2.0), name="a small grid")
    >>> "<title>a small grid</title>" in page
    True
    """
    return page_of(content_of(data, report, second=second, optical_image=optical_image, name=name))


def page_of(content: Content) -> str:
    """Return the page of a layout's or a capture's content."""
    arrays = {key: pack(values) for key, values in content.arrays.items()}
    about = {**content.about, "arrays": {key: metadata for key, (metadata, _) in arrays.items()}}
    return assemble_page(
        "template.html",
        ("page.css",),
        "page.js",
        about,
        {key: text for key, (_, text) in arrays.items()},
        title=str(content.about["name"]),
        alt=content.picture_alt,
        picture="data:image/png;base64," + base64.b64encode(content.picture_png).decode(),
    )


def write_web_page(
    data: Layout | Capture,
    path: str | Path,
    *,
    report: Report | None = None,
    second: Capture | None = None,
    optical_image: PowerMap | None = None,
    name: str = "",
) -> None:
    """
    Write :func:`web_page` to a file atomically.

    Parameters
    ----------
    data : Layout or Capture
    path : path
        With the extension ``.html``.
    report : Report, optional
    second : Capture, optional
    optical_image : PowerMap, optional
    name : str
        Heading; by default the generator of the layout.

    Raises
    ------
    FileError
        When the extension is another, or the file cannot be written.
    ParameterError, GeometryError
        As for :func:`web_page`.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=4, n_y=3, pitch_um=2.0)
    >>> report = layout.check(fs.DesignRules(min_size_um=2.5))
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = Path(directory, "grid.html")
    ...     fs.view.write_web_page(layout, path, report=report, name="a small grid")
    ...     print("min_size_um" in path.read_text("utf-8"))
    True
    """
    write_page(path, lambda: web_page(data, report=report, second=second, optical_image=optical_image, name=name))


def write_page(path: str | Path, page: Callable[[], str]) -> None:
    """
    Write a page atomically; it is created after its path is checked.

    Raises FileError when the extension is not that of a page, the directory does not exist, or the file cannot be written.
    """
    target = check_page_path(path)
    text = page()
    with atomic_write(target) as temporary:
        temporary.write_text(text, encoding="utf-8")


def check_page_path(path: str | Path) -> Path:
    """
    Check the path of a page before the page is computed.

    Raises
    ------
    FileError
        When the extension is not that of a page, or the directory does not exist.
    """
    target = Path(path)
    if target.suffix.lower() not in EXTENSIONS:
        raise FileError(target, "must end in .html")
    if not target.parent.is_dir():
        raise FileError(target, f"cannot be written: the directory {target.parent} does not exist")
    return target


def assemble_page(
    template: str,
    styles: tuple[str, ...],
    script: str,
    about: dict[str, Any],
    data: dict[str, str],
    **strings: str,
) -> str:
    """
    Return one HTML document of its parts.

    ``template``, ``styles``, ``script``: files in this package. The script is the module that imports all others, as
    :func:`bundle` joins them. ``about``: plain data, for the element ``about``. ``data``: encoded arrays, for elements
    ``data-NAME``. ``**strings``: strings of the placeholders in the template, which are escaped.
    """
    style = "".join(map(part, styles))
    script = bundle(script)
    # Angle brackets are escaped: column names in untrusted files must not close the script element.
    plain = json.dumps(about, ensure_ascii=True, allow_nan=False).replace("<", "\\u003c").replace(">", "\\u003e")
    elements = [f'<script type="application/json" id="about">{plain}</script>']
    elements += [f'<script type="text/plain" id="data-{key}">{text}</script>' for key, text in data.items()]
    return Template(part(template)).substitute(
        {name: html.escape(text) for name, text in strings.items()},
        policy=html.escape(POLICY.format(script=_checksum(script), style=_checksum(style)), quote=False),
        style=style,
        script=script,
        data="\n".join(elements),
    )


@cache
def bundle(name: str) -> str:
    """
    Return a module and all its imports as one script.

    A page opened from a file can run scripts, but cannot import modules.

    ``name``: a module in this package, such as ``"page.js"``. Modules import names from each other without aliases, at their
    top, and no two modules have the same names. Returns ``text``: every module once, after its imports, in a closed scope.
    """
    modules: dict[str, str] = {}

    def add(module: str) -> None:
        if module not in modules:
            text = part(module)
            for imported in IMPORT.findall(text):
                add(imported)
            modules[module] = TYPE.sub("", EXPORT.sub("", IMPORT.sub("", text)))

    add(name)
    return '(() => {\n"use strict";\n' + "\n".join(modules.values()) + "\n})();\n"


@cache
def part(name: str) -> str:
    """Return a file of this package."""
    return files("foveasim.view.web").joinpath(name).read_text(encoding="utf-8")


def _checksum(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()

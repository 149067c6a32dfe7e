"""
Building blocks of HTML in notebooks: title, facts, table, picture.

The HTML has no scripts, style sheets or links. Colours are inherited from the notebook, so that text is legible on light and
dark backgrounds. All strings are untrusted, and escaped.
"""

from __future__ import annotations

import html
import math
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from foveasim.errors import format_value, printable

#: Rows of a table; more are counted.
MAX_ROWS = 60
#: Characters of a cell.
MAX_CELL = 160
#: Lines between rows, legible on light and dark backgrounds.
RULE = "border:0;border-bottom:1px solid rgba(128,128,128,0.35)"
CELL = f"padding:0.15em 0.8em 0.15em 0;background:none;vertical-align:top;{RULE}"


class Html(str):
    """HTML that needs no escaping."""

    __slots__ = ()


def escape(value: object) -> Html:
    """Return any value as HTML on one line, with unprintable characters as escapes."""
    if isinstance(value, Html):
        return value
    text = printable(value)
    return Html(html.escape(text if len(text) <= MAX_CELL else f"{text[: MAX_CELL - 3]}..."))


def panel(title: str, *parts: Html) -> Html:
    """Return a title line above parts, which are side by side if they fit."""
    columns = "".join(f'<div style="min-width:0;max-width:100%">{part}</div>' for part in parts if part)
    return Html(
        f'<div style="line-height:1.4;max-width:100%"><div style="font-weight:600;margin-bottom:0.4em">{escape(title)}</div>'
        f'<div style="display:flex;flex-wrap:wrap;gap:1em 1.5em;align-items:flex-start">{columns}</div></div>'
    )


def picture(png: bytes, size: tuple[int, int], alt: str, caption: str = "") -> Html:
    """Return an embedded picture of (width, height) pixels, above a caption."""
    width, height = size
    data = b64encode(png).decode("ascii")
    style = "display:block;max-width:100%;height:auto;image-rendering:auto"
    below = f'<div style="opacity:0.75;font-size:smaller">{escape(caption)}</div>' if caption else ""
    return Html(
        f'<img width="{width}" height="{height}" alt="{html.escape(printable(alt), quote=True)}" '
        f'style="{style}" src="data:image/png;base64,{data}">{below}'
    )


def facts(rows: Mapping[str, object] | Iterable[tuple[str, object]]) -> Html:
    """Return names with values; empty values are omitted."""
    pairs = rows.items() if isinstance(rows, Mapping) else rows
    lines = "".join(
        f'<tr style="background:none"><th style="{CELL};text-align:left;font-weight:normal;opacity:0.75">{escape(name)}</th>'
        f'<td style="{CELL};text-align:left">{escape(value)}</td></tr>'
        for name, value in pairs
        if value not in ("", None)
    )
    return (
        _scrolling(f'<table style="border-collapse:collapse;margin:0"><tbody>{lines}</tbody></table>')
        if lines
        else Html()
    )


def table(headings: Sequence[str], rows: Sequence[Sequence[object]]) -> Html:
    """Return a table; numbers are aligned to the right."""
    shown = rows[:MAX_ROWS]
    is_number = [all(isinstance(row[k], int | float | np.number) for row in shown) for k in range(len(headings))]
    align = [f"{CELL};text-align:{'right' if right else 'left'}" for right in is_number]
    head = "".join(f'<th style="{a};font-weight:600">{escape(h)}</th>' for a, h in zip(align, headings, strict=True))
    body = "".join(
        '<tr style="background:none">'
        + "".join(f'<td style="{a}">{escape(format_cell(c))}</td>' for a, c in zip(align, row, strict=True))
        + "</tr>"
        for row in shown
    )
    more = f'<div style="opacity:0.75">and {len(rows) - len(shown):,} more rows</div>' if len(rows) > len(shown) else ""
    return _scrolling(
        f'<table style="border-collapse:collapse;margin:0"><thead><tr style="background:none">{head}</tr></thead>'
        f"<tbody>{body}</tbody></table>{more}"
    )


def format_cell(value: object) -> str:
    """Return a number in five digits, and other values unchanged."""
    if isinstance(value, Html | str):
        return value
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{int(value):,}"
    if isinstance(value, float | np.floating):
        return "" if math.isnan(value) else f"{float(value):.5g}"
    return format_value(value)


def bar(fraction: float) -> Html:
    """Return a horizontal bar of a fraction of the width of a cell."""
    style = f"width:{8.0 * fraction:.2f}em;height:0.7em;margin-top:0.35em;background:currentColor;opacity:0.45"
    return Html(f'<div style="{style}"></div>')


def swatch(colour: str) -> Html:
    """Return a small square of a colour."""
    style = f"display:inline-block;width:0.7em;height:0.7em;margin-right:0.5em;background:{colour}"
    return Html(f'<span style="{style}"></span>')


def _scrolling(content: Any) -> Html:
    return Html(f'<div style="overflow-x:auto;max-width:100%">{content}</div>')

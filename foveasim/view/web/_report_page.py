"""Pages of reports: sections of paragraphs, tables and figures, without scripts."""

from __future__ import annotations

import base64
import hashlib
import html
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Colours of lines and text in figures, which the page replaces by those of its light or dark theme.
INK, FAINT = "#010203", "#040506"
#: Replacements in the light and the dark theme.
LIGHT, DARK = {INK: "#1b2230", FAINT: "#d5d9e0"}, {INK: "#e8ebf0", FAINT: "#404857"}
#: Size of figures.
FIGURE_INCHES = (4.7, 3.1)
POLICY = "default-src 'none'; style-src '{style}'; img-src data:; base-uri 'none'; form-action 'none'"
#: Characters of a cell above which its column is text with lines.
MAX_CELL = 40


@dataclass(frozen=True)
class ReportFigure:
    """Figure with its caption, and another source for dark pages; small for pixels."""

    source: str
    title: str
    caption: str
    dark: str = ""
    is_small: bool = False


@dataclass(frozen=True)
class ReportTable:
    """
    Table of strings: heads of the columns, and rows that begin with their heads.

    ``best``: for each row, the index of the cell after its head that is emphasised, or None.
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str
    best: Sequence[int | None] = ()


@dataclass(frozen=True)
class ReportSection:
    """Heading with paragraphs, tables, rows of figures and folded plain text."""

    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[ReportTable] = ()
    figures: Sequence[Sequence[ReportFigure]] = ()
    folded: tuple[str, str] | None = None


def figure_of(draw: Callable[[Axes], None], ink: str, faint: str) -> Figure:
    """Return a figure that a function draws, in colours of its text and its grid."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"text.parse_math": False}):
        figure = Figure(figsize=FIGURE_INCHES, layout="constrained")
        axes = figure.add_subplot()
        draw(axes)
        style_axes(axes, ink, faint)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=9, labelcolor=ink)
    return figure


def style_axes(axes: Axes, ink: str, faint: str) -> None:
    """Draw axes and grid in colours of the text and the grid."""
    axes.grid(color=faint, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(which="both", colors=ink)
    for spine in axes.spines.values():
        spine.set_color(ink)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set_color(ink)


def drawn_figure(figure: Figure, title: str, caption: str) -> ReportFigure:
    """
    Return a matplotlib figure as SVG for light and dark pages.

    Lines and text in the colours ``INK`` and ``FAINT`` have the colours of the theme; the background is transparent.
    """
    from matplotlib import rc_context

    encoded = io.BytesIO()
    with rc_context({"svg.fonttype": "path", "svg.hashsalt": "foveasim", "text.parse_math": False}):
        figure.savefig(encoded, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    drawing = encoded.getvalue().decode()
    sources = []
    for theme in (LIGHT, DARK):
        themed = drawing
        for sentinel, colour in theme.items():
            themed = themed.replace(sentinel, colour)
        sources.append("data:image/svg+xml;base64," + base64.b64encode(themed.encode()).decode())
    return ReportFigure(sources[0], title, caption, sources[1])


def picture_figure(pixels: NDArray[np.uint8], title: str, caption: str) -> ReportFigure:
    """Return a picture (n_y, n_x, n_channel), grey or RGB with alpha, as PNG."""
    from PIL import Image

    encoded = io.BytesIO()
    Image.fromarray(pixels).save(encoded, format="PNG")
    return ReportFigure(
        "data:image/png;base64," + base64.b64encode(encoded.getvalue()).decode(), title, caption, is_small=True
    )


def report_html(title: str, sections: Sequence[ReportSection]) -> str:
    """
    Return a self-contained page for light and dark themes; all strings are escaped.

    The first section has no heading.
    """
    style = files("foveasim.view.web").joinpath("report.css").read_text(encoding="utf-8")
    checksum = "sha256-" + base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    body = "\n".join(_section(section, is_first=k == 0) for k, section in enumerate(sections))
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{html.escape(POLICY.format(style=checksum), quote=False)}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta name="referrer" content="no-referrer">
<meta name="generator" content="foveasim">
<title>{_text(title)}</title>
<link rel="icon" href="data:,">
<style>{style}</style>
</head>
<body>
<h1>{_text(title)}</h1>
{body}
</body>
</html>
"""


def _section(section: ReportSection, *, is_first: bool) -> str:
    parts = [] if is_first else [f"<h2>{_text(section.title)}</h2>"]
    parts += [f"<p>{_text(paragraph)}</p>" for paragraph in section.paragraphs]
    parts += [_table(table) for table in section.tables]
    for row in section.figures:
        kind = "figures small" if all(figure.is_small for figure in row) else "figures"
        parts.append(f'<div class="{kind}">\n' + "\n".join(map(_figure, row)) + "\n</div>")
    if section.folded is not None:
        head, content = section.folded
        parts.append(f"<details><summary>{_text(head)}</summary><pre>{_text(content)}</pre></details>")
    return "<section>\n" + "\n".join(parts) + "\n</section>"


def _table(table: ReportTable) -> str:
    kinds = [
        ' class="prose"' if any(len(row[k]) > MAX_CELL for row in table.rows) else ""
        for k in range(1, len(table.heads))
    ]
    heads = "".join(
        f'<th scope="col"{kind}>{_text(head)}</th>' for head, kind in zip(table.heads, ["", *kinds], strict=True)
    )
    rows = "\n".join(
        f'<tr><th scope="row">{_text(head)}</th>'
        + "".join(
            f"<td{kind}>{_emphasised(cell) if k == best else _text(cell)}</td>"
            for k, (cell, kind) in enumerate(zip(cells, kinds, strict=True))
        )
        + "</tr>"
        for (head, *cells), best in zip_longest(table.rows, table.best)
    )
    return (
        f'<p class="caption">{_text(table.caption)}</p>\n'
        f'<div class="table" tabindex="0"><table aria-label="{_text(table.caption)}">'
        f"<thead><tr>{heads}</tr></thead>\n<tbody>{rows}</tbody></table></div>"
    )


def _emphasised(cell: str) -> str:
    return f'<strong title="best value">{_text(cell)}</strong>'


def _figure(figure: ReportFigure) -> str:
    image = f'<img src="{figure.source}" alt="{_text(figure.title)}">'
    if figure.dark:
        image = f'<picture><source media="(prefers-color-scheme: dark)" srcset="{figure.dark}">{image}</picture>'
    kind = ' class="pixels"' if figure.is_small else ""
    return (
        f"<figure{kind}>{image}<figcaption><b>{_text(figure.title)}</b> {_text(figure.caption)}</figcaption></figure>"
    )


def _text(value: Any) -> str:
    # Control characters of names in files are not valid in HTML.
    return html.escape("".join(c if c.isprintable() or c in "\n\t" else "�" for c in str(value)))

"""
Consoles that print untrusted text without interpreting markup or control characters.

Paths, names in files and values in messages are untrusted. The consoles of this module do not interpret them as markup or emoji
codes, and print control characters as escapes. Characters that a stream cannot encode are replaced by similar ones or escapes.
"""

from __future__ import annotations

import codecs
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from io import TextIOWrapper
from typing import Any, TypeVar

from rich.console import Console
from rich.text import Text

from foveasim.errors import printable

T = TypeVar("T")
#: Name of the encoding error handler of streams.
HANDLER = "foveasim.plain"
#: ASCII replacements of characters that this package and rich print, of equal length where possible to align tables.
SIMILAR_CHARACTERS = {
    "u": "µμ",
    "x": "×",
    ".": "·",
    "-": "–—−‐‑─━═",
    "'": "‘’",
    '"': "“”",
    "2": "²",
    "3": "³",
    "4": "⁴",
    "|": "│┃║╎",
    "+": "┌┐└┘├┤┬┴┼╭╮╯╰┏┓┗┛┡┩╇╈╞╡╪╤╧┠┨┯┷╸╺",
    "#": "█▉▊▋▌▐",
    "=": "▍▎▏▇▆▅▄",
    "_": "▃▂▁",
    "*": "•" + "".join(map(chr, range(0x2800, 0x2900))),  # braille characters of spinners
    "...": "…",
    "+-": "±",
    "deg": "°",
    "sigma": "σ",
    "lambda": "λ",
    "pi": "π",
    "<=": "≤",
    ">=": "≥",
    "->": "→",
}
PLAIN_CHARACTERS = {character: plain for plain, characters in SIMILAR_CHARACTERS.items() for character in characters}


class PlainConsole(Console):
    """
    A rich console for untrusted text.

    Strings are printed without interpretation of markup; styled parts are ``rich.text.Text``.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a string as rich text, with control characters except line breaks as escapes."""
        return super().render_str(printable(text, keep="\n"), **options)


def as_plain_text(value: object) -> Text:
    """
    Return an untrusted value as rich text on one line, without interpretation of markup.

    For tables that users print on their own consoles, and for parts of rich that always interpret strings as markup.
    """
    return Text(printable(value))


def select_spinner(console: Console) -> str:
    """Return the name of a spinner that the console's stream can encode."""
    return "line" if console.options.ascii_only else "dots"


@contextmanager
def plain_streams() -> Iterator[None]:
    """Replace characters that standard output and error cannot encode, inside the block."""
    with ExitStack() as changed:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, TextIOWrapper):
                changed.callback(stream.reconfigure, errors=stream.errors)
                stream.reconfigure(errors=HANDLER)
        yield


def _replace_unencodable(error: UnicodeError) -> tuple[str, int]:
    """Replace characters that a stream cannot encode by similar ones or escapes."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    unencodable = error.object[error.start : error.end]
    return "".join(
        PLAIN_CHARACTERS.get(c) or c.encode("unicode_escape").decode("ascii") for c in unencodable
    ), error.end


codecs.register_error(HANDLER, _replace_unencodable)


def with_progress(items: Iterable[T], what: str, n_items: int | None, n_before: int = 0) -> Iterator[T]:
    """
    Yield items with a progress bar.

    ``n_before``: items that were done earlier; the remaining time is estimated without them.
    """
    from rich.progress import Progress, SpinnerColumn, TimeElapsedColumn, TimeRemainingColumn

    console = PlainConsole()
    spinner = SpinnerColumn(select_spinner(console))
    columns = (spinner, *Progress.get_default_columns()[:-1], TimeRemainingColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(what, total=n_items, completed=n_before)
        for item in items:
            yield item
            bar.advance(task)

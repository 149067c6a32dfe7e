"""
Consoles that print text from outside as it is: no markup, no control characters, and plain characters where needed.

Paths, names in files and values in messages may contain anything. A console of this module interprets none of it as
markup or emoji codes and prints control characters as escapes. A stream that cannot encode a character gets one that
looks like it, or its escape.
"""

from __future__ import annotations

import codecs
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from io import TextIOWrapper
from typing import Any

from rich.console import Console
from rich.text import Text

from foveasim.errors import printable

__all__ = ["PlainConsole", "plain_streams", "spinner_of", "text_of"]

#: Name of the error handler of streams.
HANDLER = "foveasim.plain"
#: ASCII for the characters that this package and rich print; one for one where possible, so that tables keep their columns.
LOOK_ALIKES = {
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
    "*": "•" + "".join(map(chr, range(0x2800, 0x2900))),  # and the braille of spinners
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
PLAIN_CHARACTERS = {character: plain for plain, characters in LOOK_ALIKES.items() for character in characters}


class PlainConsole(Console):
    """A rich console for text from outside; strings are printed as they are, styled parts are ``rich.text.Text``."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return the string as text, control characters but line ends as escapes."""
        return super().render_str(printable(text, keep="\n"), **options)


def text_of(value: object) -> Text:
    """
    Return a value from outside as a text that no console interprets, in one line.

    For tables that users print on consoles of their own, and for parts of rich that interpret strings as markup always.
    """
    return Text(printable(value))


def spinner_of(console: Console) -> str:
    """Return the name of a spinner that the console's stream can encode."""
    return "line" if console.options.ascii_only else "dots"


@contextmanager
def plain_streams() -> Iterator[None]:
    """Let standard output and error print a similar character, or an escape, for what they cannot encode."""
    with ExitStack() as changed:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, TextIOWrapper):
                changed.callback(stream.reconfigure, errors=stream.errors)
                stream.reconfigure(errors=HANDLER)
        yield


def _plain(error: UnicodeError) -> tuple[str, int]:
    """Replace what a stream cannot encode."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    bad = error.object[error.start : error.end]
    return "".join(PLAIN_CHARACTERS.get(c) or c.encode("unicode_escape").decode("ascii") for c in bad), error.end


codecs.register_error(HANDLER, _plain)

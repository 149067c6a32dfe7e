"""Warnings that point to the line of the user's program."""

from __future__ import annotations

import sys
import warnings
from types import FrameType

from foveasim.errors import printable

PACKAGE = __name__.partition(".")[0]


def warn(message: str, category: type[Warning]) -> None:
    """Issue a warning at the innermost line outside this package."""
    frame: FrameType | None = sys._getframe(1)  # noqa: SLF001 -- the only way to count frames
    level = 2
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == PACKAGE:
        frame, level = frame.f_back, level + 1
    warnings.warn(printable(message, keep="\n"), category, stacklevel=level)

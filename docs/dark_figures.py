"""Variants of figures for dark pages: black, white and greys of lines and text are inverted, colours and pictures remain."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure, FigureBase
from matplotlib.text import Annotation, Text

import foveasim.view

#: Addition to the name of a figure.
SUFFIX = "_dark"
#: Grey levels of black and white in the variants; the page has 0.075.
BLACK, WHITE = 0.92, 0.075
#: Largest difference of red, green and blue in a grey.
NEUTRAL = 0.03
#: Collections of more colours show grey values.
MAX_COLOURS = 4
PROPERTIES = ("color", "facecolor", "edgecolor", "markerfacecolor", "markeredgecolor")


@contextmanager
def with_dark_variants() -> Iterator[None]:
    """Let :func:`foveasim.view.save_figure` also write a variant for dark pages."""
    save = foveasim.view.save_figure

    def save_both(figure: Figure, path: str | Path, dpi: float = 150.0) -> None:
        save(figure, path, dpi=dpi)
        restore = invert_greys(figure)
        save(figure, dark_path(Path(path)), dpi=dpi)
        for set_value, value in reversed(restore):
            set_value(value)

    foveasim.view.save_figure = save_both
    try:
        yield
    finally:
        foveasim.view.save_figure = save


def dark_path(path: Path) -> Path:
    """Return the path of the variant of a figure."""
    return path.with_name(f"{path.stem}{SUFFIX}{path.suffix}")


def invert_greys(figure: Figure) -> list[tuple[Any, Any]]:
    """Invert the greys of a figure, and return the setters of its colours with their former values."""
    restore: list[tuple[Any, Any]] = []
    if np.mean(to_rgba(figure.get_facecolor())[:3]) < 0.5:
        return restore  # dark already
    for artist in _artists(figure):
        found = []  # before colours are set: those of markers follow the colour of their line
        for name in PROPERTIES:
            get, set_value = (
                getattr(artist, f"get_{name}", None),
                getattr(artist, f"set_{name}", None),
            )
            if (
                get is None
                or set_value is None
                or (isinstance(artist, Collection) and name == "color")
            ):
                continue
            value = get()
            inverted = _inverted(value)
            if inverted is not None:
                found.append((set_value, value, inverted))
        for set_value, value, inverted in found:
            restore.append((set_value, value))
            set_value(inverted)
    return restore


def _artists(figure: Figure) -> Iterator[Artist]:
    for artist in figure.findobj():
        if isinstance(artist, FigureBase | Axes):
            continue  # their colours are those of their patches
        yield artist
        if isinstance(artist, Text) and artist.get_bbox_patch() is not None:
            yield artist.get_bbox_patch()
        if isinstance(artist, Annotation) and artist.arrow_patch is not None:
            yield artist.arrow_patch


def _inverted(value: Any) -> Any:
    """Return an inverted grey, or an array of at most ``MAX_COLOURS`` of them; None for other values."""
    if isinstance(value, np.ndarray) and value.ndim == 2:
        colours = [_inverted(colour) for colour in value]
        return (
            None
            if not colours or len(colours) > MAX_COLOURS or None in colours
            else colours
        )
    try:
        red, green, blue, alpha = to_rgba(value)
    except (TypeError, ValueError):  # "auto", "none"
        return None
    if alpha == 0.0 or max(red, green, blue) - min(red, green, blue) > NEUTRAL:
        return None
    grey = BLACK + (WHITE - BLACK) * red
    return (grey, grey, grey, alpha)

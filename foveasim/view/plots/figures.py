"""
New figures: shown in notebooks and windows, plain objects in scripts.

Figures of pyplot are shown at the end of a notebook cell or in a window, and remain in memory until they are closed. Other
figures are not shown, and are freed with their last reference. All plot functions create their figures here.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

from foveasim._core.calls import Limits
from foveasim.view._ipython import ipython_shell

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["hidden_figures", "new_axes", "new_figure"]

#: Smallest ratio of a figure's shorter side to its longer one, which leaves space for axes, labels and colour bars.
MIN_ASPECT_RATIO = 0.4

#: Longer side of a figure in inches.
FIGURE_INCHES = Limits(above=0.0, low=0.1, at_most=200.0)

_is_hidden: ContextVar[bool] = ContextVar("_is_hidden", default=False)


def new_axes(figure_inches: float, ratio: float = 1.0) -> Axes:
    """
    Return axes on a new figure.

    ``figure_inches``: longer side of the figure. ``ratio``: height over width of the content.

    The figure is made by pyplot if a notebook or a window shows it: the backend is that of a notebook (inline, ipympl), or the
    user has imported pyplot and its backend is interactive. Otherwise pyplot is not imported, and the figure is in none of its
    lists.
    """
    width, height = max(MIN_ASPECT_RATIO, min(1.0, 1.0 / ratio)), max(MIN_ASPECT_RATIO, min(1.0, ratio))
    return new_figure((figure_inches * width, figure_inches * height)).add_subplot()


def new_figure(figure_inches: tuple[float, float]) -> Figure:
    """Return an empty figure, made by pyplot as in :func:`new_axes`."""
    if _is_shown():
        from matplotlib import pyplot as plt

        return plt.figure(figsize=figure_inches, layout="constrained")
    from matplotlib.figure import Figure

    return Figure(figsize=figure_inches, layout="constrained")


@contextmanager
def hidden_figures() -> Iterator[None]:
    """
    Make plain figures inside the block, such as those of files, also in notebooks.

    Examples
    --------
    >>> import foveasim as fs
    >>> with fs.view.hidden_figures():
    ...     axes = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0).plot()
    >>> axes.get_xlabel()
    'x / µm'
    """
    token = _is_hidden.set(True)
    try:
        yield
    finally:
        _is_hidden.reset(token)


def _is_shown() -> bool:
    """Return whether figures of pyplot are shown; selects a backend only for pyplot users."""
    if _is_hidden.get():
        return False
    import matplotlib as mpl
    from matplotlib.backends.registry import BackendFilter, backend_registry

    has_pyplot = "matplotlib.pyplot" in sys.modules
    backend = mpl.get_backend() if has_pyplot else mpl.get_backend(auto_select=False)
    without_window: list[str] = backend_registry.list_builtin(BackendFilter.NON_INTERACTIVE)  # type: ignore[no-untyped-call]
    with_window: list[str] = backend_registry.list_builtin(BackendFilter.INTERACTIVE)  # type: ignore[no-untyped-call]
    if backend is None or backend.lower() in without_window:
        return False
    if backend.lower() in with_window:
        # Importing pyplot would load a GUI toolkit, and toolkits work in the main thread only.
        return has_pyplot and threading.current_thread() is threading.main_thread()
    # Programs started from a notebook inherit its backend, but show no figures.
    return has_pyplot or ipython_shell() is not None

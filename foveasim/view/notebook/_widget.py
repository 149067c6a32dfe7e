"""Interactive view of photosites in notebooks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from foveasim._core.extras import import_optional
from foveasim.capture import Capture
from foveasim.layout import Layout, Report

if TYPE_CHECKING:
    from foveasim.view.web._widget import SitesWidget


def widget(
    data: Layout | Capture, *, report: Report | None = None, name: str = "", height_px: int = 600
) -> SitesWidget:
    """
    Return a widget to explore a layout or a capture in a notebook.

    It is the page of :func:`foveasim.view.web_page`, connected with Python: the colours, the pinned site and the selection can
    be read, observed and set.

    Parameters
    ----------
    data : Layout or Capture
    report : Report, optional
        Check of this layout, whose violations are listed and marked.
    name : str
        Heading; by default the generator of the layout.
    height_px : int
        Height in pixels of the screen.

    Returns
    -------
    SitesWidget
        With the traits ``by`` (quantity shown by the colours), ``pinned`` (index of a site, or -1), ``selected`` (indices) and
        ``hovered`` (read-only). Works where anywidget does: JupyterLab, VS Code, Colab, marimo.

    Raises
    ------
    ParameterError
        When anywidget is missing, the data is neither a layout nor a capture, or the report is of another layout.
    GeometryError
        When the layout has no sites.

    Examples
    --------
    >>> import foveasim as fs
    >>> view = fs.view.widget(
    ...     fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0), name="a small grid"
    ... )
    >>> view.by = "area_um2"
    >>> view.by, view.pinned
    ('area_um2', -1)

    Select sites in the widget by a rectangle, or in Python, and read their values::

        view = fs.view.widget(capture)
        view  # last line of a cell
        view.by = "electrons"
        capture.electrons[view.selected].mean()
    """
    for module in ("anywidget", "traitlets"):
        import_optional("widget", module)
    from foveasim.view.web._content import content_of
    from foveasim.view.web._widget import SitesWidget

    return SitesWidget(content_of(data, report, name=name), height_px)

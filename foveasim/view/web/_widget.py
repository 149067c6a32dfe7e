"""Notebook widget with the page of a layout or capture; imported on use, needs anywidget."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import anywidget
import numpy as np
import traitlets

from foveasim._core.validation import Ints, as_numbers, check_choice, check_count
from foveasim.errors import ParameterError
from foveasim.view.web._content import Content
from foveasim.view.web._page import page_of, part


class _Sites(traitlets.TraitType[Ints, Any]):
    """Indices of sites in ascending order, without repetition."""

    info_text = "indices of sites, or one boolean per site"

    def validate(self, widget: SitesWidget, value: Any) -> Ints:
        """Return an array of indices; booleans select sites."""
        sites = as_numbers("selected", value, keep_type=True)
        if sites.dtype == np.bool_ and sites.shape == (widget.n_sites,):
            return np.flatnonzero(sites)
        is_index = sites.ndim == 1 and (sites.dtype.kind in "iu" or not sites.size)
        if not is_index or (sites.size and not 0 <= sites.min() <= sites.max() < widget.n_sites):
            raise ParameterError(
                "selected",
                f"must be indices of sites, integers from 0 to {widget.n_sites - 1}, or one boolean per site",
                value,
            )
        return np.unique(sites).astype(np.int64)


def _to_bytes(sites: Ints, _: Any) -> memoryview:
    return memoryview(sites.astype("<u4").tobytes())


def _from_bytes(message: Any, _: Any) -> Ints:
    return np.frombuffer(message, "<u4").astype(np.int64)


class SitesWidget(anywidget.AnyWidget):  # type: ignore[misc]
    """
    Photosites in a notebook: zoom, values under the mouse, colours, selections.

    Made by :func:`foveasim.view.widget`. All traits can be observed (``widget.observe(function, "pinned")``).

    Attributes
    ----------
    by : str
        Quantity shown by the colours: a key of ``columns``.
    pinned : int
        Index of the pinned site, or -1.
    selected : (n,) int64
        Indices of the selected sites, in ascending order.
    hovered : int
        Index of the site under the mouse, or -1; read-only.
    height_px : int
        Height in pixels of the screen.
    columns : tuple of str
        Quantities that ``by`` accepts.
    n_sites : int
    """

    _esm = part("widget.js")
    page = traitlets.Unicode().tag(sync=True)
    height_px = traitlets.Int(600).tag(sync=True)
    by = traitlets.Unicode().tag(sync=True)
    pinned = traitlets.Int(-1).tag(sync=True)
    hovered = traitlets.Int(-1).tag(sync=True)
    selected = _Sites(np.zeros(0, np.int64)).tag(sync=True, to_json=_to_bytes, from_json=_from_bytes)

    def __init__(self, content: Content, height_px: int) -> None:
        about: Mapping[str, Any] = content.about
        self.name, self.n_sites = str(about["name"]), int(about["n_sites"])
        self.columns = tuple(str(column["key"]) for column in about["columns"])
        super().__init__(page=page_of(content), height_px=height_px)

    def __repr__(self) -> str:
        shown = f"by={self.by!r}, pinned={self.pinned}, {self.selected.size} selected"
        return f"SitesWidget({self.name!r}, {self.n_sites} sites, {shown})"

    @traitlets.validate("by")
    def _check_by(self, proposal: Mapping[str, Any]) -> str:
        return check_choice("by", proposal["value"], self.columns)

    @traitlets.validate("pinned")
    def _check_pinned(self, proposal: Mapping[str, Any]) -> int:
        if proposal["value"] >= self.n_sites:
            raise ParameterError("pinned", f"must be < {self.n_sites}, the number of sites", proposal["value"])
        return max(-1, proposal["value"])

    @traitlets.validate("height_px")
    def _check_height(self, proposal: Mapping[str, Any]) -> int:
        return check_count("height_px", proposal["value"], at_least=100)

"""Summary figures of a layout: counts, sizes, areas, channels and readout lines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from foveasim._core.quantities import format_quantity
from foveasim._core.show import view_method
from foveasim._core.validation import Floats, Ints
from foveasim.layout.drc.routing import Readout
from foveasim.layout.model import Layout

if TYPE_CHECKING:
    from rich.console import RenderableType

__all__ = ["Summary", "describe"]

#: Maximum number of size classes of a histogram.
SIZE_CLASSES = 12
#: Relative difference below which all sizes form one class.
SIZE_ROUNDING = 1e-6
#: Length of the longest histogram bar, in characters.
BAR_WIDTH = 40


@dataclass(frozen=True, kw_only=True, eq=False)
class Summary:
    """
    Summary figures of a layout.

    Attributes
    ----------
    n_sites, n_vertices : int
    bounds_um : (x_min, y_min, x_max, y_max), µm
    area_um2 : float, µm²
        Total area of all sites.
    fill_factor : float
        Total area as a fraction of the area of the convex hull.
    size_um : (5,) float64, µm
        Minimum, lower quartile, median, upper quartile and maximum site size, the square root of the area of a site.
    size_edges_um, size_counts : (n_class + 1,) float64 µm and (n_class,) int64
        Histogram of the sizes, with class limits of equal ratios.
    channels : mapping of int to int
        Number of sites per colour filter.
    n_lines : int
        Number of readout lines.
    readout : Readout or None
    origin : str
        Name of the generator, or of the function that made the layout.

    Examples
    --------
    >>> import foveasim as fs
    >>> summary = fs.layout.describe(
    ...     fs.layout.grid(n_x=10, n_y=10, pitch_um=3.0, fill_factor=0.64)
    ... )
    >>> summary.n_sites, round(summary.area_um2, 1), summary.size_um.round(2).tolist()
    (100, 576.0, [2.4, 2.4, 2.4, 2.4, 2.4])
    """

    n_sites: int
    n_vertices: int
    bounds_um: tuple[float, float, float, float]
    area_um2: float
    fill_factor: float
    size_um: Floats
    size_edges_um: Floats
    size_counts: Ints
    channels: Mapping[int, int]
    n_lines: int
    readout: Readout | None
    origin: str

    def __repr__(self) -> str:
        x0, y0, x1, y1 = self.bounds_um
        return (
            f"Summary({self.n_sites:,} photosites of {self._sizes()} on "
            f"{x1 - x0:.6g} x {y1 - y0:.6g} µm, from {self.origin})"
        )

    def _sizes(self) -> str:
        """Return the smallest and the largest size."""
        return format_quantity([float(self.size_um[0]), float(self.size_um[-1])], "µm")

    def rows(self) -> list[tuple[str, str]]:
        """Return names and values as strings, in the order of the table."""
        x0, y0, x1, y1 = self.bounds_um
        _, lower, median, upper, _ = self.size_um
        rows = [
            ("origin", self.origin),
            ("photosites", f"{self.n_sites:,}"),
            ("vertices", f"{self.n_vertices:,}"),
            ("field", f"{x1 - x0:.6g} x {y1 - y0:.6g} µm, from ({x0:.6g}, {y0:.6g}) to ({x1:.6g}, {y1:.6g})"),
            ("area", format_quantity(self.area_um2, "µm²", digits=6)),
            ("fill factor", f"{100.0 * self.fill_factor:.4g} % of the convex hull"),
            ("site size", f"{self._sizes()}, median {median:.4g}, quartiles {lower:.4g} and {upper:.4g}"),
            ("channels", ", ".join(f"{channel}: {n:,}" for channel, n in self.channels.items())),
            ("readout lines", f"{self.n_lines:,}"),
        ]
        if self.readout is not None:
            r = self.readout
            lanes = f" on each of {r.n_lanes} lanes" if r.n_lanes > 1 else ""
            terms = f"{r.frames_per_s:g} frames/s, {r.bits} bits, {100.0 * r.blanking:g} % blanking"
            shown = format_quantity(1e9 * r.gbit_per_s(self.n_sites), "bit/s")
            rows.append(("data rate", f"{shown}{lanes} ({terms})"))
        return rows

    def records(self) -> list[dict[str, Any]]:
        """Return one dict per class of the size histogram: limits in µm and number of sites."""
        edges = self.size_edges_um.tolist()
        return [
            {"from_um": low, "to_um": high, "n_sites": int(n)}
            for low, high, n in zip(edges[:-1], edges[1:], self.size_counts, strict=True)
        ]

    def __str__(self) -> str:
        return "\n".join(f"{name}: {value}" for name, value in self.rows())

    _repr_html_ = view_method("to_html")

    def __rich__(self) -> RenderableType:
        from rich.console import Group
        from rich.table import Table

        from foveasim._io.terminal import as_plain_text

        facts = Table(show_header=False, box=None)
        for name, value in self.rows():
            facts.add_row(name, as_plain_text(value))
        sizes = Table(title="Site sizes", title_justify="left", box=None)
        for heading in ("from µm", "to µm", "sites"):
            sizes.add_column(heading, justify="right")
        sizes.add_column("")
        max_count = max((int(n) for n in self.size_counts), default=0)
        for row in self.records():
            bar = "█" * max(int(row["n_sites"] > 0), round(BAR_WIDTH * row["n_sites"] / max(max_count, 1)))
            sizes.add_row(f"{row['from_um']:.4g}", f"{row['to_um']:.4g}", f"{row['n_sites']:,}", bar)
        return Group(facts, sizes)


def hull_area_um2(layout: Layout) -> float:
    """Return the area of the convex hull of all photosites."""
    return float(shapely.LineString(layout.xy_um).convex_hull.area)


def describe(layout: Layout, readout: Readout | None = None) -> Summary:
    """
    Summarise a layout: counts, sizes, areas, channels and readout lines.

    Parameters
    ----------
    layout : Layout
    readout : Readout, optional
        Frame rate, bit depth and lanes, for the data rate.

    Returns
    -------
    Summary
        Rendered as a table with a histogram by a rich console.

    Raises
    ------
    GeometryError
        When the layout has no sites.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.layout.describe(fs.layout.hexagonal(n_columns=20, n_rows=20, pitch_um=3.0))
    Summary(400 photosites of 2.792 µm on 61.5 x 52.8275 µm, from hexagonal)
    """
    bounds_um = layout.bounds_um
    size_um = layout.size_um
    edges_um = _size_edges_um(float(size_um.min()), float(size_um.max()))
    channel, counts = np.unique(layout.channel, return_counts=True)
    return Summary(
        n_sites=layout.n_sites,
        n_vertices=len(layout.xy_um),
        bounds_um=bounds_um,
        area_um2=float(layout.area_um2.sum()),
        fill_factor=float(layout.area_um2.sum()) / hull_area_um2(layout),
        size_um=np.quantile(size_um, [0.0, 0.25, 0.5, 0.75, 1.0]),
        size_edges_um=edges_um,
        size_counts=np.histogram(size_um, edges_um)[0],
        channels={int(c): int(n) for c, n in zip(channel, counts, strict=True)},
        n_lines=int(np.unique(layout.readout_line).size),
        readout=readout,
        origin=str(layout.provenance.get("generator", layout.provenance.get("made_by", "packed rings"))),
    )


def _size_edges_um(low_um: float, high_um: float) -> Floats:
    """Return class limits of equal ratios that contain all sizes; one class for equal sizes."""
    if high_um <= low_um * (1.0 + SIZE_ROUNDING):
        return np.array([low_um * (1.0 - SIZE_ROUNDING), high_um * (1.0 + SIZE_ROUNDING)])
    edges_um = np.geomspace(low_um, high_um, SIZE_CLASSES + 1)
    edges_um[0], edges_um[-1] = low_um, high_um
    return np.asarray(edges_um)

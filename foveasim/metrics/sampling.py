"""How finely photosites sample a picture: the Nyquist frequency of every site, and how it falls with eccentricity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats, Ints, check_choice, check_count, finite_array, read_only
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.units import per_mm_from_per_um

__all__ = [
    "EccentricityTable",
    "neighbour_spacing_um",
    "nyquist_per_mm",
    "nyquist_vs_eccentricity",
    "require_layout",
]

#: The second neighbour is at least 30 degrees off the line through the first: in a lattice's reduced basis it is 60 or more.
LEAST_SINE = 0.5
#: So many sites nearby are looked at for it, then four times as many, and so on up to the last: enough for rectangles 300
#: times as long as wide.
FIRST_NEIGHBOURS, MOST_NEIGHBOURS = 12, 768
#: Pairs of sites looked at together: what bounds the memory.
BLOCK_PAIRS = 1 << 18
#: Sizes that differ by less than this share are the same.
SIZE_ROUNDING = 1e-9


def nyquist_per_mm(
    layout: Layout, *, by: Literal["neighbours", "area"] = "neighbours", per_channel: bool = False
) -> Floats:
    """
    Nyquist frequency at every site: the finest sine that the sites around it tell from a coarser one.

    Parameters
    ----------
    layout : Layout
    by : {"neighbours", "area"}
        ``"neighbours"``: ``1 / (2 h)``, h the distance of two rows of sites. A site's nearest neighbour gives the direction of
        the row, and the nearest one off that line the next row. Of a lattice this is exactly the frequency below which
        nothing is aliased in any direction: ``1 / (2 p)`` for squares, ``1 / (√3 p)`` for hexagons of pitch p. Gaps between
        sites do not matter. Of sites in groups, as one filter's in a quad-Bayer mosaic, it is that within a group: for their
        repeat see :func:`foveasim.metrics.sampling_spectrum`.
        ``"area"``: ``1 / (2 sqrt(area))`` of the site itself: the same in all directions, and smooth where sites are irregular,
        but right only where sites are without gaps.
    per_channel : bool
        Whether only neighbours of the same filter count, as in a mosaic of colours; by neighbours only.

    Returns
    -------
    nyquist : (n_site,) float64, 1/mm
        Line pairs per mm. NaN where there are no such neighbours, as in a single row, or where one is at the same place.

    Raises
    ------
    ParameterError
        When a choice is none of the above.

    Examples
    --------
    >>> from foveasim.layout import grid, hexagonal
    >>> np.unique(nyquist_per_mm(grid(n_x=4, n_y=4, pitch_um=2.0, trench_um=0.2)).round(6))
    array([250.])
    >>> np.unique(nyquist_per_mm(hexagonal(n_columns=4, n_rows=4, pitch_um=2.0)).round(3))
    array([288.675])
    """
    require_layout(layout)
    if check_choice("by", by, ("neighbours", "area")) == "area":
        if per_channel:
            raise ParameterError("per_channel", "goes with by='neighbours': an area does not tell how far its like is")
        return per_mm_from_per_um(0.5 / np.sqrt(layout.area_um2))
    return per_mm_from_per_um(0.5 / neighbour_spacing_um(layout, per_channel=per_channel)[1])


def neighbour_spacing_um(layout: Layout, *, per_channel: bool = False) -> tuple[Floats, Floats]:
    """
    Distances of a site's nearest neighbour, and of the nearest row of sites beside the line through the two.

    Parameters
    ----------
    layout : Layout
    per_channel : bool
        Whether only neighbours of the same filter count.

    Returns
    -------
    nearest_um, row_um : (n_site,) float64, µm
        Between centroids; their product is the area of a lattice's cell. NaN where there is no such neighbour; sites with
        another one at the same place have a distance of 0 and no row.
    """
    require_layout(layout)
    nearest_um, row_um = np.full(layout.n_sites, np.nan), np.full(layout.n_sites, np.nan)
    channel = layout.channel if per_channel else np.zeros(layout.n_sites, np.int64)
    for c in np.unique(channel):
        sites = np.flatnonzero(channel == c)
        nearest_um[sites], row_um[sites] = _spacing_um(layout.centroid_um[sites])
    return nearest_um, row_um


def _spacing_um(xy_um: Floats) -> tuple[Floats, Floats]:
    """The same for points (n, 2)."""
    from scipy.spatial import cKDTree

    n = len(xy_um)
    nearest_um, row_um = np.full(n, np.nan), np.full(n, np.nan)
    if n < 2:
        return nearest_um, row_um
    tree = cKDTree(xy_um)
    left, k = np.arange(n), FIRST_NEIGHBOURS
    while left.size and k <= MOST_NEIGHBOURS:
        block = BLOCK_PAIRS // k
        for start in range(0, left.size, block):
            sites = left[start : start + block]
            # The first is the site itself; beyond the last one distances are infinite.
            distance_um, ids = map(np.asarray, tree.query(xy_um[sites], k=list(range(2, min(k, n) + 1))))
            step_um = xy_um[ids] - xy_um[sites, np.newaxis]
            along = step_um[:, 0] / np.maximum(distance_um[:, :1], np.finfo(float).tiny)
            off_um = np.abs(along[:, :1] * step_um[..., 1] - along[:, 1:] * step_um[..., 0])
            # One at the same place gives no direction.
            is_beside = (off_um >= LEAST_SINE * distance_um) & (distance_um[:, :1] > 0.0)
            first = is_beside.argmax(axis=1)
            nearest_um[sites] = distance_um[:, 0]
            found = np.arange(sites.size)
            row_um[sites] = np.where(is_beside[found, first], off_um[found, first], np.nan)
        left = left[np.isnan(row_um[left])] if k < n else left[:0]
        k *= 4
    return nearest_um, row_um


@dataclass(frozen=True, eq=False, kw_only=True)
class EccentricityTable:
    """
    Sampling against the distance from a centre.

    Attributes
    ----------
    edges_um : (n_bin + 1,) float64, µm
        Limits of the bins.
    n_sites : (n_bin,) int64
    nyquist_per_mm, nyquist_min_per_mm, nyquist_max_per_mm : (n_bin,) float64, 1/mm
        Median, lowest and highest Nyquist frequency of each bin's sites; NaN where there are none.
    size_um : (n_bin,) float64, µm
        Mean square root of the sites' areas; NaN where there are none.
    size_at_centre_um : float, µm
        Of the line ``size = size_at_centre + growth · r`` through all sites, by least squares: 0 for a log-polar layout. The
        linear magnification, sites to a µm, is ``1 / size``, as that of the cortex is.
    growth_fraction : float
        The line's slope: 0 where sites are of one size.
    """

    edges_um: Floats
    n_sites: Ints
    nyquist_per_mm: Floats
    nyquist_min_per_mm: Floats
    nyquist_max_per_mm: Floats
    size_um: Floats
    size_at_centre_um: float
    growth_fraction: float

    @property
    def e2_um(self) -> float:
        """Eccentricity at which sites are twice as large as at the centre; infinite where they are of one size, µm."""
        return self.size_at_centre_um / self.growth_fraction if self.growth_fraction else float("inf")

    def records(self) -> list[dict[str, Any]]:
        """One dict a bin."""
        return [
            {
                "from_um": float(self.edges_um[k]),
                "to_um": float(self.edges_um[k + 1]),
                "n_sites": int(self.n_sites[k]),
                "size_um": float(self.size_um[k]),
                "nyquist_min_per_mm": float(self.nyquist_min_per_mm[k]),
                "nyquist_per_mm": float(self.nyquist_per_mm[k]),
                "nyquist_max_per_mm": float(self.nyquist_max_per_mm[k]),
            }
            for k in range(self.n_sites.size)
        ]

    def __str__(self) -> str:
        lines = ["     from       to / µm    sites  size / µm   Nyquist / mm: lowest   median  highest"]
        lines += [
            f"{row['from_um']:9.5g}{row['to_um']:9.5g}{row['n_sites']:14,}{row['size_um']:11.4g}"
            f"{row['nyquist_min_per_mm']:24.5g}{row['nyquist_per_mm']:9.5g}{row['nyquist_max_per_mm']:9.5g}"
            for row in self.records()
        ]
        lines.append(f"size = {self.size_at_centre_um:.4g} µm + {self.growth_fraction:.4g} · distance")
        return "\n".join(lines)


def nyquist_vs_eccentricity(
    layout: Layout,
    centre_um: tuple[float, float] = (0.0, 0.0),
    *,
    n_bins: int = 24,
    by: Literal["neighbours", "area"] = "neighbours",
    per_channel: bool = False,
) -> EccentricityTable:
    """
    Nyquist frequency and size of the sites in rings around a centre.

    Parameters
    ----------
    layout : Layout
    centre_um : (x, y), µm
        On the optical axis by default.
    n_bins : int
        Rings of equal widths, from the nearest site to the furthest.
    by, per_channel
        As for :func:`nyquist_per_mm`.

    Returns
    -------
    EccentricityTable

    Raises
    ------
    ParameterError
        When an argument is out of range, or the layout has no sites.
    """
    require_layout(layout)
    centre = finite_array("centre_um", centre_um, ndim=1)
    if centre.size != 2:
        raise ParameterError("centre_um", "must be two numbers (x, y)", centre_um, "µm")
    n_bins = check_count("n_bins", n_bins, at_most=100_000)
    if layout.n_sites == 0:
        raise ParameterError("layout", "must have sites")
    nyquist = nyquist_per_mm(layout, by=by, per_channel=per_channel)
    r_um, size_um = np.hypot(*(layout.centroid_um - centre).T), np.sqrt(layout.area_um2)
    edges_um = np.linspace(r_um.min(), max(r_um.max(), r_um.min() + 1e-9), n_bins + 1)
    position = np.asarray(np.searchsorted(edges_um[1:-1], r_um, side="right"))
    counts = np.bincount(position, minlength=n_bins)
    sums_um = np.bincount(position, weights=size_um, minlength=n_bins)
    off_um = r_um - r_um.mean()
    slope = float(off_um @ size_um / max(off_um @ off_um, np.finfo(float).tiny))
    at_centre_um = float(size_um.mean() - slope * r_um.mean())
    # Sizes that differ by rounding alone have no slope, and lines through the origin no size there.
    rounding_um = SIZE_ROUNDING * float(size_um.mean())
    slope = 0.0 if abs(slope) * np.ptp(r_um) <= rounding_um else slope
    at_centre_um = 0.0 if abs(at_centre_um) <= rounding_um else at_centre_um
    low, middle, high = _low_middle_high(nyquist, position, n_bins)
    return EccentricityTable(
        edges_um=read_only(edges_um),
        n_sites=read_only(counts.astype(np.int64)),
        nyquist_per_mm=read_only(middle),
        nyquist_min_per_mm=read_only(low),
        nyquist_max_per_mm=read_only(high),
        size_um=read_only(np.where(counts > 0, sums_um / np.maximum(counts, 1), np.nan)),
        size_at_centre_um=at_centre_um,
        growth_fraction=slope,
    )


def require_layout(layout: object) -> None:
    """
    Pass a layout.

    Raises
    ------
    ParameterError
        When it is something else.
    """
    if not isinstance(layout, Layout):
        raise ParameterError("layout", f"must be a foveasim.Layout, got a {type(layout).__name__}")


def _low_middle_high(values: Floats, position: NDArray[np.intp], n_bins: int) -> tuple[Floats, Floats, Floats]:
    """Lowest, median and highest value of every bin; NaN where there is none."""
    is_known = np.isfinite(values)
    values, position = values[is_known], position[is_known]
    order = np.lexsort((values, position))
    values, starts = values[order], np.searchsorted(position[order], np.arange(n_bins + 1))
    n = np.diff(starts)
    result = np.full((3, n_bins), np.nan)
    some = np.flatnonzero(n)
    first, last = starts[some], starts[some + 1] - 1
    result[0, some], result[2, some] = values[first], values[last]
    result[1, some] = 0.5 * (values[first + (n[some] - 1) // 2] + values[first + n[some] // 2])
    return result[0], result[1], result[2]

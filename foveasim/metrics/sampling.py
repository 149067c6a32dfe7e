"""Sampling density of photosites: Nyquist frequency per site and against eccentricity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import Limits
from foveasim._core.rings import TIE_FRACTION
from foveasim._core.validation import Bools, Floats, Ints, check_point, read_only
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.units import per_mm_from_per_um

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "EccentricityTable",
    "neighbour_spacing_um",
    "nyquist_per_mm",
    "nyquist_vs_eccentricity",
]

#: Sine of the minimum angle (30 degrees) between the directions of both neighbours; it is 60 degrees or more in the reduced
#: basis of a lattice.
MIN_SINE = 0.5
#: Number of candidate neighbours: initial value, multiplied by 4 up to the largest value, which suffices for rectangles of an
#: aspect ratio of 300.
INITIAL_NEIGHBOURS, MAX_NEIGHBOURS = 12, 768
#: Pairs of sites per block; limits the memory.
BLOCK_PAIRS = 1 << 18
#: Relative difference below which sizes are equal.
SIZE_ROUNDING = 1e-9


def nyquist_per_mm(
    layout: Layout, *, by: Literal["neighbours", "area"] = "neighbours", per_channel: bool = False
) -> Floats:
    """
    Compute the Nyquist frequency at every site.

    Parameters
    ----------
    layout : Layout
    by : {"neighbours", "area"}
        ``"neighbours"``: ``1 / (2 h)`` for the distance h between two rows of sites. The nearest neighbour of a site gives the
        direction of the row, and the nearest site off that line the next row. For a lattice, this is exactly the highest
        frequency without aliasing in any direction: ``1 / (2 p)`` for squares, ``1 / (√3 p)`` for hexagons of pitch p. Gaps
        between sites have no effect. For grouped sites, such as one filter of a quad-Bayer mosaic, it is the value within a
        group; for the period of the groups, see :func:`foveasim.metrics.sampling_spectrum`.
        ``"area"``: ``1 / (2 sqrt(area))`` of the site itself. It is isotropic, and smooth for irregular sites, but valid only
        for gap-free layouts.
    per_channel : bool
        Whether only neighbours of the same filter are considered, as in a colour mosaic; requires ``by="neighbours"``.

    Returns
    -------
    nyquist : (n_site,) float64, 1/mm
        Line pairs per mm. NaN without suitable neighbours, as in a single row, or with coincident sites.

    Examples
    --------
    >>> from foveasim.layout import grid, hexagonal
    >>> np.unique(nyquist_per_mm(grid(n_x=4, n_y=4, pitch_um=2.0, trench_um=0.2)).round(6))
    array([250.])
    >>> np.unique(nyquist_per_mm(hexagonal(n_columns=4, n_rows=4, pitch_um=2.0)).round(3))
    array([288.675])
    """
    if by == "area":
        if per_channel:
            raise ParameterError(
                "per_channel", "must be False with by='area'; use by='neighbours' for one filter of a mosaic"
            )
        return per_mm_from_per_um(0.5 / layout.size_um)
    return per_mm_from_per_um(0.5 / neighbour_spacing_um(layout, per_channel=per_channel)[1])


def neighbour_spacing_um(layout: Layout, *, per_channel: bool = False) -> tuple[Floats, Floats]:
    """
    Compute the distances to the nearest neighbour and to the nearest row of sites.

    The nearest row is the one next to the line through a site and its nearest neighbour. With several nearest neighbours, or
    several sites that may define the row, at equal distances, its distance is the mean over all of them: results do not depend
    on the order of the sites.

    Parameters
    ----------
    layout : Layout
    per_channel : bool
        Whether only neighbours of the same filter are considered.

    Returns
    -------
    nearest_um, row_um : (n_site,) float64, µm
        Distances between centroids; their product is the cell area of a lattice. NaN without such a neighbour; coincident
        sites have a distance of 0 and NaN for the row.

    Examples
    --------
    >>> import foveasim as fs
    >>> nearest_um, row_um = fs.metrics.neighbour_spacing_um(
    ...     fs.layout.hexagonal(n_columns=9, n_rows=9, pitch_um=4.0)
    ... )
    >>> round(float(nearest_um[40]), 4), round(float(row_um[40]), 4)  # 4 and 4 · √3 / 2
    (4.0, 3.4641)
    """
    nearest_um, row_um = np.full(layout.n_sites, np.nan), np.full(layout.n_sites, np.nan)
    channel = layout.channel if per_channel else np.zeros(layout.n_sites, np.int64)
    for c in np.unique(channel):
        sites = np.flatnonzero(channel == c)
        nearest_um[sites], row_um[sites] = _spacing_um(layout.centroid_um[sites])
    return nearest_um, row_um


def _spacing_um(xy_um: Floats) -> tuple[Floats, Floats]:
    """Compute the distances of :func:`neighbour_spacing_um` for points (n, 2)."""
    from scipy.spatial import cKDTree

    n = len(xy_um)
    nearest_um, row_um = np.full(n, np.nan), np.full(n, np.nan)
    if n < 2:
        return nearest_um, row_um
    tree = cKDTree(xy_um)
    is_pending = np.ones(n, bool)
    remaining, k = np.arange(n), INITIAL_NEIGHBOURS
    while remaining.size and k <= MAX_NEIGHBOURS:
        block = BLOCK_PAIRS // k
        for start in range(0, remaining.size, block):
            sites = remaining[start : start + block]
            # k = 1 is the site itself; missing neighbours have infinite distances.
            distance_um, ids = map(np.asarray, tree.query(xy_um[sites], k=list(range(2, min(k, n) + 1))))
            nearest_um[sites] = distance_um[:, 0]
            step_um = xy_um[ids] - xy_um[sites, np.newaxis]
            row_um[sites], is_complete = _row_um(distance_um, step_um)
            is_pending[sites] = ~is_complete
        remaining = remaining[is_pending[remaining]] if k < n else remaining[:0]
        k *= 4
    return nearest_um, row_um


def _row_um(distance_um: Floats, step_um: Floats) -> tuple[Floats, Bools]:
    """
    Compute the distances to the nearest rows from neighbours sorted by distance.

    ``distance_um``, ``step_um`` (n, n_neighbour), (n, n_neighbour, 2), µm: distances of the neighbours, and vectors to them.
    Returns ``row_um`` (n,) µm: mean over ties; NaN without another row. ``is_complete`` (n,) bool: whether further neighbours
    cannot change the result.
    """
    is_nearest = distance_um <= distance_um[:, :1] * (1.0 + TIE_FRACTION)
    total_um, count = np.zeros(len(distance_um)), np.zeros(len(distance_um))
    is_complete = np.ones(len(distance_um), bool)
    direction = step_um / np.maximum(distance_um, np.finfo(float).tiny)[..., np.newaxis]
    for j in range(int(is_nearest.sum(axis=1).max())):
        along = direction[:, j]
        off_um = np.abs(along[:, :1] * step_um[..., 1] - along[:, 1:] * step_um[..., 0])
        # A coincident site does not define a direction.
        is_other_row = (off_um >= MIN_SINE * (1.0 - TIE_FRACTION) * distance_um) & (distance_um[:, :1] > 0.0)
        first_um = np.where(is_other_row, distance_um, np.inf).min(axis=1, keepdims=True)
        is_used = is_other_row & (distance_um <= first_um * (1.0 + TIE_FRACTION)) & is_nearest[:, j : j + 1]
        total_um += np.where(is_used, off_um, 0.0).sum(axis=1)
        count += is_used.sum(axis=1)
        is_complete &= ~is_nearest[:, j] | (distance_um[:, -1] > first_um[:, 0] * (1.0 + TIE_FRACTION))
    # The last neighbour is farther than all ties.
    is_complete &= (distance_um[:, -1] > distance_um[:, 0] * (1.0 + TIE_FRACTION)) & (count > 0)
    return np.where(count > 0, total_um / np.maximum(count, 1.0), np.nan), is_complete


@dataclass(frozen=True, eq=False, kw_only=True)
class EccentricityTable:
    """
    Sampling density against the distance from a centre.

    Attributes
    ----------
    edges_um : (n_bin + 1,) float64, µm
        Edges of the bins.
    n_sites : (n_bin,) int64
    nyquist_per_mm, nyquist_min_per_mm, nyquist_max_per_mm : (n_bin,) float64, 1/mm
        Median, lowest and highest Nyquist frequency of the sites in each bin; NaN for empty bins.
    size_um : (n_bin,) float64, µm
        Mean square root of the site areas; NaN for empty bins.
    size_at_centre_um : float, µm
        Intercept of the least-squares line ``size = size_at_centre + growth · r`` over all sites: 0 for a log-polar layout.
        The linear magnification in sites per µm is ``1 / size``, like the cortical magnification.
    growth_fraction : float
        Slope of this line: 0 for sites of equal size.
    """

    edges_um: Floats
    n_sites: Ints
    nyquist_per_mm: Floats
    nyquist_min_per_mm: Floats
    nyquist_max_per_mm: Floats
    size_um: Floats
    size_at_centre_um: float
    growth_fraction: float

    def __repr__(self) -> str:
        n_rings, n_sites = self.n_sites.size, int(self.n_sites.sum())
        return f"EccentricityTable({n_rings} rings up to {self.edges_um[-1]:.4g} µm, {n_sites:,} photosites)"

    @property
    def e2_um(self) -> float:
        """Eccentricity at which the site size has doubled, µm; infinite for sites of equal size."""
        return self.size_at_centre_um / self.growth_fraction if self.growth_fraction else float("inf")

    def records(self) -> list[dict[str, Any]]:
        """Return one dict per bin."""
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

    def plot(self, *, ax: Axes | None = None) -> Axes:
        """Draw the Nyquist frequencies against the eccentricity on matplotlib axes."""
        from foveasim.view import plot_curves

        centre_um = 0.5 * (self.edges_um[1:] + self.edges_um[:-1])
        curves: dict[str, tuple[Floats, Floats]] = {
            "highest": (centre_um, self.nyquist_max_per_mm),
            "median": (centre_um, self.nyquist_per_mm),
            "lowest": (centre_um, self.nyquist_min_per_mm),
        }
        labels = "eccentricity / µm", "Nyquist frequency / (line pairs per mm)"
        return plot_curves(curves, *labels, logarithmic="y", marker=".", ax=ax)

    def _repr_html_(self) -> str:
        from foveasim.view import to_html

        return to_html(self)

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
    n_bins: Annotated[int, Limits(at_least=1, at_most=100_000)] = 24,
    by: Literal["neighbours", "area"] = "neighbours",
    per_channel: bool = False,
) -> EccentricityTable:
    """
    Compute Nyquist frequency and size of the sites in rings around a centre.

    Parameters
    ----------
    layout : Layout
    centre_um : (x, y), µm
        Centre of the rings; the optical axis by default.
    n_bins : int
        Number of rings of equal width, from the nearest site to the farthest.
    by, per_channel
        As for :func:`nyquist_per_mm`.

    Returns
    -------
    EccentricityTable

    Raises
    ------
    ParameterError
        When an argument is out of range, or the layout has no sites.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.log_polar(n_sectors=64, min_size_um=3.0, r_max_um=300.0)
    >>> table = fs.metrics.nyquist_vs_eccentricity(layout, n_bins=4)
    >>> list(table.records()[0])
    ['from_um', 'to_um', 'n_sites', 'size_um', 'nyquist_min_per_mm', 'nyquist_per_mm', 'nyquist_max_per_mm']
    """
    centre = check_point("centre_um", centre_um)
    if layout.n_sites == 0:
        raise ParameterError("layout", "must have at least one site")
    nyquist = nyquist_per_mm(layout, by=by, per_channel=per_channel)
    r_um, size_um = np.hypot(*(layout.centroid_um - centre).T), layout.size_um
    edges_um = np.linspace(r_um.min(), max(r_um.max(), r_um.min() + 1e-9), n_bins + 1)
    position = np.asarray(np.searchsorted(edges_um[1:-1], r_um, side="right"))
    counts = np.bincount(position, minlength=n_bins)
    sums_um = np.bincount(position, weights=size_um, minlength=n_bins)
    off_um = r_um - r_um.mean()
    slope = float(off_um @ size_um / max(off_um @ off_um, np.finfo(float).tiny))
    at_centre_um = float(size_um.mean() - slope * r_um.mean())
    # Set rounding errors to 0: the slope for equal sizes, and the intercept of a line through the origin.
    rounding_um = SIZE_ROUNDING * float(size_um.mean())
    slope = 0.0 if abs(slope) * np.ptp(r_um) <= rounding_um else slope
    at_centre_um = 0.0 if abs(at_centre_um) <= rounding_um else at_centre_um
    low, median, high = _min_median_max(nyquist, position, n_bins)
    return EccentricityTable(
        edges_um=read_only(edges_um),
        n_sites=read_only(counts.astype(np.int64)),
        nyquist_per_mm=read_only(median),
        nyquist_min_per_mm=read_only(low),
        nyquist_max_per_mm=read_only(high),
        size_um=read_only(np.where(counts > 0, sums_um / np.maximum(counts, 1), np.nan)),
        size_at_centre_um=at_centre_um,
        growth_fraction=slope,
    )


def _min_median_max(values: Floats, position: NDArray[np.intp], n_bins: int) -> tuple[Floats, Floats, Floats]:
    """Return lowest, median and highest value of each bin; NaN for empty bins."""
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

"""
Log-polar images of rings and sectors, as in models of the visual cortex.

On layouts of rings with equal numbers of sectors, the image has exactly one pixel per site. Any other picture is resampled.

Conventions: ring 0 is the innermost, angles increase counter-clockwise from the x axis. ``cv2.warpPolar`` with
``WARP_POLAR_LOG`` returns the transposed image (rows are angles); applied to picture data with the lowest row first, its
angles increase in the same direction. It samples at the corners of pixels, at angles ``2π i / n`` and radii
``exp(j log(R) / n) - 1`` in pixels of the picture, which correspond to an ``offset_um`` of one pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import FINITE, NOT_NEGATIVE, POSITIVE, Limits
from foveasim._core.short_repr import short_repr
from foveasim._core.show import ViewMethod, view_method
from foveasim._core.validation import (
    Floats,
    Images,
    Ints,
    as_numbers,
    check_count,
    check_point,
    finite_array,
    frozen_array,
    read_only,
)
from foveasim.errors import ParameterError
from foveasim.fields import Grid
from foveasim.layout.model import Layout
from foveasim.reconstruct.picture import Picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["CorticalImage", "cortical", "from_cortical", "to_cortical"]

#: Largest relative difference of the radii of a ring, and largest difference of centroids from equal sectors, in sectors.
RING_ROUNDING, SECTOR_ROUNDING = 1e-6, 0.05
#: Fraction of valid neighbours below which an interpolated value is unknown.
MIN_KNOWN = 0.5
SIDE = Limits(at_least=1, at_most=2**15)
#: Hint for layouts without rings of equal sectors.
RESAMPLE = "resample a picture instead, with 'n_rings' and 'n_sectors'"


@dataclass(frozen=True, eq=False, kw_only=True)
class CorticalImage:
    """
    Log-polar image, with rings as rows and sectors as columns.

    Attributes
    ----------
    data : (n_channel, n_ring, n_sector) float32 or float64
        Values, the innermost ring first; NaN where unknown.
    radius_um : (n_ring + 1,) float64, µm
        Increasing radii of the circles between rings.
    start_rad : (n_ring,) float64, rad
        Angle at which sector 0 of each ring begins, counter-clockwise from the x axis; half a sector for staggered rings.
    centre_um : (x, y), µm
        Centre of the rings.
    offset_um : float, µm
        Rings are equidistant in ``log(r + offset_um)``, for the interpolation between them.
    sites : (n_ring, n_sector) int64, optional
        Site of each pixel; None for resampled images.
    white : (n_channel,) float64, optional
    colour_matrix : (3, n_channel) float64, optional
        Values of white, and colour correction, as of :class:`foveasim.Picture`.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.log_polar(n_sectors=32, n_rings=8, r_min_um=10.0, r_max_um=80.0)
    >>> image = fs.reconstruct.cortical(layout, layout.size_um)
    >>> image.radius_um.round(1).tolist()
    [10.0, 13.0, 16.8, 21.8, 28.3, 36.7, 47.6, 61.7, 80.0]
    """

    data: Images
    radius_um: Floats
    start_rad: Floats
    centre_um: tuple[float, float] = (0.0, 0.0)
    offset_um: float = 0.0
    sites: Ints | None = None
    white: Floats | None = None
    colour_matrix: Floats | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        data = np.asarray(as_numbers("data", self.data, missing_is_nan=True))
        if data.ndim != 3 or 0 in data.shape:
            raise ParameterError("data", f"must have the shape (n_channel, n_ring, n_sector), got {data.shape}")
        n_rings = data.shape[1]
        radius_um = finite_array("radius_um", self.radius_um, ndim=1, at_least=0.0)
        start_rad = finite_array("start_rad", self.start_rad, ndim=1)
        if radius_um.size != n_rings + 1 or not (np.diff(radius_um) > 0.0).all():
            raise ParameterError("radius_um", f"must be {n_rings + 1} increasing radii, for {n_rings} rings")
        if start_rad.size != n_rings:
            raise ParameterError("start_rad", f"must be {n_rings} angles, one per ring, got {start_rad.size}")
        if self.sites is not None and np.shape(self.sites) != data.shape[1:]:
            raise ParameterError("sites", f"must have the shape {data.shape[1:]}", list(np.shape(self.sites)))
        for name, values in (("data", data), ("radius_um", radius_um), ("start_rad", start_rad)):
            object.__setattr__(self, name, frozen_array(values))

    plot: ClassVar[ViewMethod[Axes]] = view_method("plot_cortical")
    _repr_html_ = view_method("to_html")

    @property
    def ring_centre_um(self) -> Floats:
        """Radius midway between the circles of each ring in log(r + offset_um), (n_ring,) µm."""
        shifted = self.radius_um + self.offset_um
        return np.sqrt(shifted[1:] * shifted[:-1]) - self.offset_um

    def site_values(self, n_sites: int) -> Floats:
        """
        Return the values by site, the inverse of :func:`cortical`.

        Parameters
        ----------
        n_sites : int
            Number of sites of the layout.

        Returns
        -------
        values : (n_channel, n_site) float64
            NaN for sites that are not in the image.

        Raises
        ------
        ParameterError
            When the image is resampled, or the layout has fewer sites.
        """
        if self.sites is None:
            raise ParameterError("sites", "must be known; a resampled image has no sites")
        n_sites = check_count("n_sites", n_sites, at_least=int(self.sites.max()) + 1)
        values = np.full((self.data.shape[0], n_sites), np.nan)
        values[:, self.sites] = self.data
        return values


def cortical(layout: Layout, values: ArrayLike) -> CorticalImage:
    """
    Return the values of sites in rings as a log-polar image, exactly one pixel per site.

    Parameters
    ----------
    layout : Layout
        With the columns ``ring`` and ``sector``, as those of ``log_polar`` and ``giotto``. The image contains the rings with as
        many sectors as the outermost one; sites of a filled fovea are not part of it.
    values : (n_site,) or (n_channel, n_site)

    Raises
    ------
    ParameterError
        When the layout does not have two or more concentric rings of equal sectors, or there is not one value per site.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.log_polar(n_sectors=32, n_rings=8, r_min_um=10.0, r_max_um=60.0)
    >>> image = fs.reconstruct.cortical(layout, layout.columns["ring"])
    >>> image.data.shape, image.data[0, :3, 0].tolist()
    ((1, 8, 32), [0.0, 1.0, 2.0])
    """
    channels = np.atleast_2d(as_numbers("values", values, missing_is_nan=True))
    if channels.ndim != 2 or channels.shape[1] != layout.n_sites:
        raise ParameterError("values", f"must have the shape (..., {layout.n_sites}), got {np.shape(values)}")
    sites = _sites_of_rings(layout)
    centre_um = layout.centroid_um[sites[-1]].mean(axis=0)
    offset_um = layout.xy_um - centre_um
    n_vertices = np.diff(layout.ring_offsets[layout.site_offsets])
    ring_of_site = np.full(layout.n_sites, -1)
    ring_of_site[sites] = np.arange(len(sites))[:, np.newaxis]
    ring_of_vertex = np.repeat(ring_of_site, n_vertices)
    r_um = np.hypot(*offset_um.T)
    largest_um, smallest_um = np.zeros(len(sites)), np.full(len(sites), np.inf)
    inside = ring_of_vertex >= 0
    np.maximum.at(largest_um, ring_of_vertex[inside], r_um[inside])
    np.minimum.at(smallest_um, ring_of_vertex[inside], r_um[inside])
    radius_um = np.concatenate((smallest_um[:1], largest_um))
    n_sectors = sites.shape[1]
    step_rad = 2.0 * math.pi / n_sectors
    xy_um = layout.centroid_um[sites] - centre_um
    angle_rad = np.arctan2(xy_um[..., 1], xy_um[..., 0])
    # Angle of each centroid minus that of its sector if all rings were aligned with the outermost, in sectors. The first ring
    # may have corners of a fovea, which move its centroids.
    first_rad = float(angle_rad[-1, 0]) - 0.5 * step_rad
    lead = (angle_rad - first_rad) / step_rad - (np.arange(n_sectors) + 0.5)
    lead = (lead - lead[:, :1] + 0.5 * n_sectors) % n_sectors - 0.5 * n_sectors + lead[:, :1]
    start = lead.mean(axis=1)
    rounded = np.rint(2.0 * start) / 2.0
    start = np.where(np.abs(start - rounded) < SECTOR_ROUNDING, rounded, start)
    start_rad = (first_rad if abs(first_rad) > RING_ROUNDING * step_rad else 0.0) + start * step_rad
    start_rad = np.where(np.abs(start_rad) < RING_ROUNDING * step_rad, 0.0, start_rad)
    are_adjacent = np.abs(smallest_um[1:] - largest_um[:-1]) <= RING_ROUNDING * largest_um[-1]
    if np.abs(lead - start[:, np.newaxis]).max() > SECTOR_ROUNDING or not are_adjacent.all():
        raise ParameterError("layout", "must have concentric rings of equal sectors", hint=RESAMPLE)
    return CorticalImage(
        data=channels[:, sites],
        radius_um=radius_um,
        start_rad=start_rad,
        centre_um=(float(centre_um[0]), float(centre_um[1])),
        sites=read_only(sites),
    )


def to_cortical(
    picture: Picture,
    *,
    n_rings: Annotated[int, SIDE],
    n_sectors: Annotated[int, SIDE],
    r_max_um: Annotated[float, POSITIVE],
    r_min_um: Annotated[float | None, NOT_NEGATIVE] = None,
    centre_um: tuple[float, float] = (0.0, 0.0),
    start_rad: Annotated[float, FINITE] = 0.0,
    offset_um: Annotated[float, NOT_NEGATIVE] = 0.0,
) -> CorticalImage:
    """
    Resample a picture to a log-polar image by bilinear interpolation.

    Parameters
    ----------
    picture : Picture
    n_rings, n_sectors : int
    r_max_um : float, µm
        Outer radius of the outermost ring.
    r_min_um : float, optional, µm
        Inner radius of the innermost ring; by default such that pixels are approximately square.
    centre_um : (x, y), µm
        Centre of the rings.
    start_rad : float, rad
        Angle at which sector 0 begins.
    offset_um : float, µm
        Rings are equidistant in ``log(r + offset_um)``: 0 for log-polar images. With a positive offset ``r_min_um`` may be 0.

    Returns
    -------
    CorticalImage
        NaN where the picture has no data.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=40, n_y=40, pitch_um=2.0)
    >>> picture = fs.reconstruct.cells(
    ...     layout, layout.centroid_um[:, 0] ** 2, fs.Grid.centred((40, 40), 2.0)
    ... )
    >>> image = fs.reconstruct.to_cortical(
    ...     picture, n_rings=8, n_sectors=32, r_min_um=4.0, r_max_um=36.0
    ... )
    >>> image.data.shape
    (1, 8, 32)
    """
    from scipy.ndimage import map_coordinates

    centre = check_point("centre_um", centre_um)
    if r_min_um is None:
        r_min_um = max(0.0, (r_max_um + offset_um) * math.exp(-2.0 * math.pi * n_rings / n_sectors) - offset_um)
    if not 0.0 < r_min_um + offset_um < r_max_um + offset_um:
        raise ParameterError("r_min_um", f"must be > 0 and < {r_max_um:g}, the outer radius", r_min_um, "µm")
    ratio = (r_max_um + offset_um) / (r_min_um + offset_um)
    edges_um = (r_min_um + offset_um) * ratio ** (np.arange(n_rings + 1) / n_rings) - offset_um
    edges_um[0], edges_um[-1] = r_min_um, r_max_um
    image = CorticalImage(
        data=np.full((picture.data.shape[0], n_rings, n_sectors), np.nan),
        radius_um=edges_um,
        start_rad=np.full(n_rings, start_rad),
        centre_um=centre,
        offset_um=offset_um,
    )
    angle_rad = start_rad + (np.arange(n_sectors) + 0.5) * (2.0 * math.pi / n_sectors)
    r_um = image.ring_centre_um[:, np.newaxis]
    grid = picture.grid
    x = (centre[0] + r_um * np.cos(angle_rad) - grid.origin_um[0]) / grid.pitch_x_um - 0.5
    y = (centre[1] + r_um * np.sin(angle_rad) - grid.origin_um[1]) / grid.pitch_y_um - 0.5
    data = np.empty(image.data.shape)
    for channel, plane in zip(data, np.asarray(picture.data, np.float64), strict=True):
        is_known = np.isfinite(plane)
        weights = map_coordinates(is_known.astype(np.float64), (y, x), order=1, mode="constant", cval=0.0)
        sums = map_coordinates(np.where(is_known, plane, 0.0), (y, x), order=1, mode="constant", cval=0.0)
        channel[:] = np.divide(sums, weights, out=np.full(sums.shape, np.nan), where=weights >= MIN_KNOWN)
    return replace(image, data=data, white=picture.white, colour_matrix=picture.colour_matrix)


def from_cortical(image: CorticalImage, grid: Grid, *, method: Literal["linear", "nearest"] = "linear") -> Picture:
    """
    Map a log-polar image to a raster picture.

    Parameters
    ----------
    image : CorticalImage
    grid : Grid
        Pixels of the picture; values are those at the pixel centres.
    method : {"linear", "nearest"}
        Interpolation between the pixels of the image. ``"nearest"`` gives the value of the pixel (or site) that contains a
        point.

    Returns
    -------
    Picture
        NaN outside the rings, and where the image is unknown.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.log_polar(n_sectors=32, n_rings=8, r_min_um=10.0, r_max_um=60.0)
    >>> image = fs.reconstruct.cortical(layout, layout.columns["ring"])
    >>> picture = fs.reconstruct.from_cortical(
    ...     image, fs.Grid.centred((64, 64), 2.0), method="nearest"
    ... )
    >>> picture.data[0, 32, 36:64:4].tolist()  # along the x axis, outwards
    [nan, 2.0, 4.0, 5.0, 6.0, 7.0, 7.0]
    """
    x_um, y_um = np.meshgrid(grid.x_um - image.centre_um[0], grid.y_um - image.centre_um[1])
    r_um, angle_rad = np.hypot(x_um, y_um), np.arctan2(y_um, x_um)
    n_channels, n_rings, n_sectors = image.data.shape
    row, column = np.nonzero((r_um >= image.radius_um[0]) & (r_um <= image.radius_um[-1]))
    r_um, sector = r_um[row, column], angle_rad[row, column] * (n_sectors / (2.0 * math.pi))
    start = image.start_rad * (n_sectors / (2.0 * math.pi))
    data = np.full((n_channels, *grid.shape), np.nan)
    if method == "nearest":
        ring = np.clip(np.searchsorted(image.radius_um, r_um, side="right") - 1, 0, n_rings - 1)
        data[:, row, column] = image.data[:, ring, np.floor(sector - start[ring]).astype(np.int64) % n_sectors]
    else:
        log_centre, log_r = (np.log(r + image.offset_um) for r in (image.ring_centre_um, np.maximum(r_um, 1e-300)))
        at = np.interp(log_r, log_centre, np.arange(n_rings))
        inner = np.minimum(at.astype(np.int64), max(n_rings - 2, 0))
        total, weights = np.zeros((n_channels, r_um.size)), np.zeros((n_channels, r_um.size))
        for ring, part in ((inner, 1.0 - (at - inner)), (np.minimum(inner + 1, n_rings - 1), at - inner)):
            position = sector - start[ring] - 0.5
            first = np.floor(position)
            for step, weight in ((0, 1.0 - (position - first)), (1, position - first)):
                values = image.data[:, ring, (first.astype(np.int64) + step) % n_sectors]
                known = np.isfinite(values)
                total += np.where(known, values, 0.0) * (part * weight)
                weights += known * (part * weight)
        data[:, row, column] = np.divide(total, weights, out=np.full(total.shape, np.nan), where=weights >= MIN_KNOWN)
    coverage = np.isfinite(data).any(axis=0)
    parts = read_only(data.astype(np.float32)), read_only(coverage.astype(np.float32)), grid
    return Picture(*parts, image.white, image.colour_matrix)


def _sites_of_rings(layout: Layout) -> Ints:
    """Return the sites (n_ring, n_sector) of rings with as many sectors as the last."""
    if not {"ring", "sector"} <= set(layout.columns) or layout.n_sites == 0:
        raise ParameterError("layout", "must have the columns 'ring' and 'sector'", hint=RESAMPLE)
    ring, sector = layout.columns["ring"], layout.columns["sector"]
    labels, position, counts = np.unique(ring, return_inverse=True, return_counts=True)
    is_full = counts == counts[-1]
    # Full rings are contiguous, out to the outermost one.
    first = int(np.flatnonzero(~is_full)[-1]) + 1 if not is_full.all() else 0
    if labels.size - first < 2 or counts[-1] < 3:
        raise ParameterError("layout", "must have at least two rings with equal numbers of sectors", hint=RESAMPLE)
    chosen = np.flatnonzero(position.ravel() >= first)
    chosen = chosen[np.lexsort((sector[chosen], ring[chosen]))]
    sites: NDArray[np.int64] = chosen.reshape(-1, counts[-1])
    if (sector[sites] != np.arange(counts[-1])).any():
        raise ParameterError("layout", "must have the sectors 0, 1, 2, ... in every ring", hint=RESAMPLE)
    return sites

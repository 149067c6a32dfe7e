"""
Index maps: the photosite under each pixel of a picture.

Colours and the site under the mouse are lookups in such a map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import Limits
from foveasim._core.short_repr import short_repr
from foveasim._core.threads import parallel_map, thread_count
from foveasim._core.validation import Floats, check_shape, finite_array, read_only, unmasked
from foveasim.errors import ParameterError
from foveasim.fields import PackedRings
from foveasim.view.site_colours import BACKGROUND, Rgb, decode_light, encode_light

__all__ = ["SitePixels", "id_map", "site_at", "validate_bounds"]

#: Largest number of samples in a picture: 4 GB of indices.
MAX_SAMPLES = 2**30
#: Bands of rows per thread: two balance the load of clustered sites; each band visits all sites, so that more are slower.
BANDS_PER_THREAD = 2
#: Levels of linear light that are encoded: steps far below that of the darkest sRGB byte.
N_LEVELS = 2**16
#: Sites per work item in the search for their rows.
CHUNK_SITES = 65_536

Bounds = tuple[float, float, float, float]


def id_map(
    layout: PackedRings,
    shape: tuple[int, int],
    bounds_um: Sequence[float] | Floats | None = None,
    *,
    n_threads: int | None = None,
) -> NDArray[np.int32]:
    """
    Return the photosite under the centre of each pixel.

    Parameters
    ----------
    layout : Layout
        With convex or concave sites, with or without holes.
    shape : (n_y, n_x)
        Numbers of pixels.
    bounds_um : (x_min, y_min, x_max, y_max), optional, µm
        Extent of the pixels; the bounds of the layout by default.
    n_threads : int, optional
        All cores by default; the result does not depend on it.

    Returns
    -------
    ids : (n_y, n_x) int32
        Index of the site, -1 where there is none; row 0 is the lowest y.

    Raises
    ------
    ParameterError
        When the shape or the bounds are invalid, or the layout has no sites and no bounds are given.

    Notes
    -----
    A pixel centre on the boundary of two sites belongs to the site on the +x side, or on the +y side if the boundary is
    horizontal, so that every pixel of a tiling has exactly one site. Slanted boundaries are evaluated in float64, identically
    for both sites. Where sites overlap, the highest index has priority. The interior of rings follows the even-odd rule,
    independent of their winding.

    Examples
    --------
    >>> from foveasim.layout import grid
    >>> id_map(
    ...     grid(n_x=2, n_y=1, pitch_um=3.0), (1, 4), (-4.0, -1.0, 4.0, 1.0)
    ... ).tolist()  # centres at -3, -1, 1, 3
    [[0, 0, 1, -1]]
    """
    n_y, n_x = check_shape("shape", shape)
    if n_y * n_x > MAX_SAMPLES:
        raise ParameterError("shape", f"must have at most {MAX_SAMPLES:,} pixels", shape)
    x_min, y_min, x_max, y_max = validate_bounds(layout, bounds_um)
    columns_um, rows_um = _centres_um(x_min, x_max, n_x), _centres_um(y_min, y_max, n_y)
    return _sites_at(layout, columns_um, rows_um, thread_count(n_threads))


def site_at(layout: PackedRings, x_um: float, y_um: float) -> int:
    """
    Return the index of the site at a point, -1 where there is none.

    Boundaries and overlaps are resolved as in :func:`id_map`.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0)
    >>> fs.view.site_at(layout, 0.1, 0.1), fs.view.site_at(layout, 9.0, 0.0)
    (4, -1)
    """
    point = finite_array("x_um, y_um", (x_um, y_um))
    return int(_sites_at(layout, point[:1], point[1:], 1)[0, 0])


@dataclass(frozen=True, eq=False)
class SitePixels:
    """
    Photosite indices of the samples of a picture.

    Attributes
    ----------
    ids : (n_y * n_samples, n_x * n_samples) int32
        The site at each sample, -1 where there is none; row 0 is the lowest y.
    bounds_um : (x_min, y_min, x_max, y_max), µm
    n_samples : int
        Samples along each side of a pixel.

    Examples
    --------
    >>> import foveasim as fs
    >>> pixels = fs.view.SitePixels.from_layout(
    ...     fs.layout.grid(n_x=2, n_y=2, pitch_um=3.0), (20, 20)
    ... )
    >>> pixels.site_at([-1.0, 1.0], [-1.0, 1.0]).tolist()
    [0, 3]
    """

    ids: NDArray[np.int32]
    bounds_um: Bounds
    n_samples: int = 1

    __repr__ = short_repr

    @classmethod
    def from_layout(
        cls,
        layout: PackedRings,
        shape: tuple[int, int],
        bounds_um: Sequence[float] | Floats | None = None,
        *,
        n_samples: Annotated[int, Limits(at_least=1, at_most=16)] = 3,
        n_threads: int | None = None,
    ) -> SitePixels:
        """
        Sample a layout.

        Parameters
        ----------
        layout : Layout
        shape : (n_y, n_x)
            Numbers of pixels.
        bounds_um : (x_min, y_min, x_max, y_max), optional, µm
            Extent of the pixels; the bounds of the layout by default.
        n_samples : int
            Samples along each side of a pixel, for anti-aliased boundaries.
        n_threads : int, optional
            All cores by default.

        Raises
        ------
        ParameterError
            As for :func:`id_map`.
        """
        n_y, n_x = check_shape("shape", shape)
        bounds = validate_bounds(layout, bounds_um)
        ids = id_map(layout, (n_samples * n_y, n_samples * n_x), bounds, n_threads=n_threads)
        return cls(read_only(ids), bounds, n_samples)

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of pixels (n_y, n_x)."""
        n_y, n_x = self.ids.shape
        return n_y // self.n_samples, n_x // self.n_samples

    def picture(
        self,
        rgb: NDArray[np.uint8],
        *,
        background: Rgb | None = BACKGROUND,
        boundary: Rgb | None = None,
        n_threads: int | None = None,
    ) -> NDArray[np.uint8]:
        """
        Return a picture with one colour per site.

        Parameters
        ----------
        rgb : (n_site, 3) uint8
            From :func:`foveasim.view.site_colours`.
        background : (r, g, b) or None
            Colour of areas without sites; None makes them transparent.
        boundary : (r, g, b), optional
            Colour of the boundaries between sites, lines of one sample width.
        n_threads : int, optional
            All cores by default.

        Returns
        -------
        picture : (n_y, n_x, 3) uint8, or (n_y, n_x, 4) without a background
            Red, green, blue, and the fraction covered by sites as alpha; row 0 is the lowest y. A pixel is the mean of its
            sample colours in linear light. :func:`foveasim.view.site_picture` averages exactly, and values before their
            colours.

        Raises
        ------
        ParameterError
            When ``rgb`` has fewer rows than there are sites in the picture, or is not uint8.
        """
        from foveasim.view import _kernels

        rgb = np.asarray(unmasked("rgb", rgb))
        max_id = int(self.ids.max(initial=-1))
        if rgb.dtype != np.uint8 or rgb.ndim != 2 or rgb.shape[1] != 3 or rgb.shape[0] <= max_id:
            raise ParameterError(
                "rgb", f"must be uint8 of shape (n_site, 3), n_site > {max_id}, got {rgb.dtype} of shape {rgb.shape}"
            )
        table = np.ones((rgb.shape[0] + 2, 4), np.float32)
        table[0] = 0.0 if background is None else (*decode_light(np.array(background)), 1.0)
        table[1:-1, :3] = decode_light(rgb)
        table[-1, :3] = decode_light(np.array(boundary or (0, 0, 0)))
        picture = np.empty((*self.shape, 4), np.uint8)
        n, n_threads = self.n_samples, thread_count(n_threads)
        encoded = encode_light(np.linspace(0.0, 1.0, N_LEVELS))

        def blend(rows: slice) -> None:
            _kernels.blend(self.ids, table, encoded, n, boundary is not None, rows.start, picture[rows])

        parallel_map(blend, _bands(self.shape[0], n_threads), n_threads)
        return picture if background is None else picture[..., :3]

    def boundary_fraction(self) -> Floats:
        """
        Return the fraction of each pixel that boundaries between sites cover, (n_y, n_x).

        Boundaries have the width of one sample.
        """
        is_boundary = np.zeros(self.ids.shape, bool)
        is_boundary[:, 1:] = self.ids[:, 1:] != self.ids[:, :-1]
        is_boundary[1:] |= self.ids[1:] != self.ids[:-1]
        (n_y, n_x), n = self.shape, self.n_samples
        return np.asarray(is_boundary.reshape(n_y, n, n_x, n).mean(axis=(1, 3)))

    def site_at(self, x_um: ArrayLike, y_um: ArrayLike) -> NDArray[np.int32]:
        """
        Return the site of the sample nearest to each point, (...) int32.

        -1 where there is no site, and outside the picture.
        """
        x, y = np.broadcast_arrays(finite_array("x_um", x_um), finite_array("y_um", y_um))
        x_min, y_min, x_max, y_max = self.bounds_um
        n_y, n_x = self.ids.shape
        column, row = ((x - x_min) * (n_x / (x_max - x_min)), (y - y_min) * (n_y / (y_max - y_min)))
        is_inside = (column >= 0.0) & (column < n_x) & (row >= 0.0) & (row < n_y)
        at = self.ids[np.where(is_inside, row, 0.0).astype(np.int64), np.where(is_inside, column, 0.0).astype(np.int64)]
        return np.where(is_inside, at, np.int32(-1))


def validate_bounds(layout: PackedRings, bounds_um: Sequence[float] | Floats | None) -> Bounds:
    """Return checked bounds of a picture; by default those of the layout."""
    if bounds_um is None:
        if layout.xy_um.size == 0:
            raise ParameterError("layout", "must have sites unless 'bounds_um' is given")
        x_um, y_um = layout.xy_um[:, 0], layout.xy_um[:, 1]
        bounds_um = (x_um.min(), y_um.min(), x_um.max(), y_um.max())
    bounds = finite_array("bounds_um", bounds_um, ndim=1)
    if bounds.size != 4 or not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
        raise ParameterError("bounds_um", "must be (x_min, y_min, x_max, y_max) in ascending order", bounds_um, "µm")
    x_min, y_min, x_max, y_max = bounds.tolist()
    return x_min, y_min, x_max, y_max


def _centres_um(low_um: float, high_um: float, n: int) -> Floats:
    return np.asarray(low_um + (np.arange(n) + 0.5) * ((high_um - low_um) / n))


def _bands(n_rows: int, n_threads: int) -> list[slice]:
    """Split rows into bands; rows are independent, so that the result does not depend on them."""
    height = -(-n_rows // (BANDS_PER_THREAD * n_threads)) if n_threads > 1 else n_rows
    return [slice(start, min(start + height, n_rows)) for start in range(0, n_rows, height)]


def _sites_at(layout: PackedRings, x_um: Floats, y_um: Floats, n_threads: int) -> NDArray[np.int32]:
    """Return the site at each sample of ascending columns and rows, (n_y, n_x) int32."""
    from foveasim.view import _kernels

    n_sites = layout.site_offsets.size - 1
    starts = layout.ring_offsets[layout.site_offsets]
    rows = np.empty((n_sites, 2), np.int32)
    ids = np.full((y_um.size, x_um.size), -1, np.int32)

    def find(first: int) -> None:
        _kernels.rows_of_sites(layout.xy_um, starts, x_um, y_um, first, rows[first : first + CHUNK_SITES])

    def paint(band: slice) -> None:
        _kernels.paint_sites(
            layout.xy_um, layout.ring_offsets, layout.site_offsets, rows, x_um, y_um, band.start, ids[band]
        )

    parallel_map(find, range(0, n_sites, CHUNK_SITES), n_threads)
    parallel_map(paint, _bands(y_um.size, n_threads), n_threads)
    return ids

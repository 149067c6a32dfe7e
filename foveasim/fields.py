"""
Shared data types: grids, power maps, and protocols of scenes, lenses and outlines.

All coordinates are in one right-handed frame: origin on the optical axis, x to the right, y **up**. Row 0 of every array has
the lowest y. Picture files store the top row first; only :func:`from_file_rows` and :func:`to_file_rows` convert between the
two orders.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.calls import publish
from foveasim._core.rings import check_packed, select_sites
from foveasim._core.short_repr import short_repr
from foveasim._core.show import ViewMethod, view_method
from foveasim._core.validation import (
    Floats,
    Images,
    Ints,
    as_any_array,
    as_numbers,
    check_pitch_um,
    check_point,
    check_shape,
    frozen_array,
    read_only,
    unmasked,
    wavelengths_nm,
)
from foveasim._projections import ImageProjection
from foveasim.errors import ParameterError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "Grid",
    "Lattice",
    "Outlines",
    "PackedRings",
    "Pitch",
    "PointMap",
    "PowerMap",
    "SceneLike",
    "from_file_rows",
    "to_file_rows",
    "with_ascending_axes",
]

#: Cell size: one length for square cells, or (along x, along y).
Pitch: TypeAlias = float | tuple[float, float]


class PackedRings(Protocol):
    """Outlines that the integrator accepts, such as :class:`foveasim.Layout`."""

    @property
    def xy_um(self) -> Floats:
        """Vertices (n_vertex, 2) of consecutive rings; the first vertex is not repeated."""

    @property
    def ring_offsets(self) -> Ints:
        """Offsets (n_ring + 1,): ring r is ``xy_um[ring_offsets[r] : ring_offsets[r + 1]]``."""

    @property
    def site_offsets(self) -> Ints:
        """
        Offsets of the sites in the rings, (n_site + 1,).

        Site s has the rings ``site_offsets[s] : site_offsets[s + 1]``; outer rings are counter-clockwise.
        """


@dataclass(frozen=True, eq=False)
class Outlines:
    """
    Packed rings of sites without the rules of a layout: :class:`PackedRings`.

    Parameters
    ----------
    xy_um : (n_vertex, 2) float64, µm
    ring_offsets : (n_ring + 1,) int64
    site_offsets : (n_site + 1,) int64

    Examples
    --------
    >>> import foveasim as fs
    >>> pair = fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0)
    >>> Outlines(pair.xy_um, pair.ring_offsets, pair.site_offsets).n_sites
    2
    """

    xy_um: Floats
    ring_offsets: Ints
    site_offsets: Ints

    __repr__ = short_repr

    def __post_init__(self) -> None:
        rings = check_packed(self.xy_um, self.ring_offsets, self.site_offsets, min_vertices=0, min_rings=0)
        for name, array in zip(("xy_um", "ring_offsets", "site_offsets"), rings, strict=True):
            object.__setattr__(self, name, frozen_array(array))

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return self.site_offsets.size - 1

    def part(self, selection: slice | Ints) -> Outlines:
        """Return the outlines of some of the sites."""
        sites = np.atleast_1d(np.arange(self.n_sites)[selection])
        return Outlines(*select_sites(self.xy_um, self.ring_offsets, self.site_offsets, sites))


class Lattice(Protocol):
    """
    Rectangles in rows and columns.

    Site ``row * n_column + column`` is ``x_um[column]`` by ``y_um[row]``.
    """

    @property
    def x_um(self) -> Floats:
        """Lower and upper x of each column, (n_column, 2)."""

    @property
    def y_um(self) -> Floats:
        """Lower and upper y of each row, (n_row, 2)."""

    @property
    def n_sites(self) -> int:
        """Number of sites."""

    @property
    def bounds_um(self) -> tuple[float, float, float, float]:
        """Bounding box x_min, y_min, x_max, y_max."""

    def rings(self, first: int = 0, last: int | None = None) -> tuple[Floats, Ints, Ints]:
        """Return packed rings of the sites ``first`` to ``last - 1``."""

    def site_bounds_um(self) -> Floats:
        """Return x_min, y_min, x_max, y_max of each site, (n_site, 4)."""


class PointMap(Protocol):
    """Lens distortion that the integrator accepts; see :mod:`foveasim.distortion`."""

    def undistort(self, xy_um: ArrayLike, *, outside: Any = "error") -> Floats:
        """
        Return the undistorted image positions of (..., 2) points, µm.

        With ``outside="mask"``, points outside the image circle become NaN.
        """


class SceneLike(Protocol):
    """
    Planar scene that the optics accepts, such as :class:`foveasim.Scene`.

    The spectral radiance of pixel [iy, ix] at wavelength k is ``sum_b basis[b, iy, ix] * spectrum[b, k]`` in
    W/(m² sr nm). Each wavelength represents a band of width ``band_width_nm[k]``.
    """

    @property
    def basis(self) -> Images:
        """Basis images (n_basis, n_y, n_x)."""

    @property
    def spectrum_w_m2_sr_nm(self) -> Floats:
        """Spectra of the basis images (n_basis, n_wavelength)."""

    @property
    def wavelength_nm(self) -> Floats:
        """Wavelengths (n_wavelength,)."""

    @property
    def band_width_nm(self) -> Floats:
        """Widths of the wavelength bands (n_wavelength,)."""

    @property
    def pitch_um(self) -> float | None:
        """Pixel pitch in the scene plane; None if the framing on a layout determines it."""

    @property
    def centre_um(self) -> tuple[float, float]:
        """Position (x, y) of the picture's centre in the scene plane, from the optical axis."""

    @property
    def distance_m(self) -> float:
        """Distance between the scene and the pupil."""

    @property
    def projection(self) -> ImageProjection:
        """Projection of the picture: rectilinear for one of a plane in front of the lens."""


@dataclass(frozen=True)
class Grid:
    """
    A grid of equal rectangular cells in the sensor plane.

    Parameters
    ----------
    shape : (n_y, n_x)
        Numbers of rows and columns.
    pitch_um : float, or (pitch_x, pitch_y), µm
        Side of square cells, or width and height of rectangular cells. Two equal numbers are stored as one: ``pitch_um`` is a
        float for square cells and a tuple for others; ``pitch_x_um`` and ``pitch_y_um`` are floats for both.
    origin_um : (x0, y0), µm
        Lower left corner of cell [0, 0].

    Examples
    --------
    >>> grid = Grid(shape=(2, 4), pitch_um=0.5, origin_um=(-1.0, -0.5))
    >>> grid.bounds_um
    (-1.0, -0.5, 1.0, 0.5)
    >>> Grid(shape=(2, 4), pitch_um=(0.5, 2.0)).bounds_um
    (0.0, 0.0, 2.0, 4.0)
    """

    shape: tuple[int, int]
    pitch_um: Pitch
    origin_um: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "origin_um", check_point("origin_um", self.origin_um))
        object.__setattr__(self, "shape", check_shape("shape", self.shape))
        pitch_x_um, pitch_y_um = check_pitch_um("pitch_um", self.pitch_um)
        object.__setattr__(self, "pitch_um", pitch_x_um if pitch_x_um == pitch_y_um else (pitch_x_um, pitch_y_um))

    @classmethod
    def centred(cls, shape: tuple[int, int], pitch_um: Pitch, centre_um: tuple[float, float] = (0.0, 0.0)) -> Grid:
        """Return a grid centred on a point (x, y); parameters as for the class."""
        n_y, n_x = check_shape("shape", shape)
        pitch_x_um, pitch_y_um = check_pitch_um("pitch_um", pitch_um)
        x_um, y_um = centre_um
        return cls(shape, pitch_um, (x_um - 0.5 * n_x * pitch_x_um, y_um - 0.5 * n_y * pitch_y_um))

    @property
    def pitch_x_um(self) -> float:
        """Cell width in µm."""
        return self.pitch_um[0] if isinstance(self.pitch_um, tuple) else self.pitch_um

    @property
    def pitch_y_um(self) -> float:
        """Cell height in µm."""
        return self.pitch_um[1] if isinstance(self.pitch_um, tuple) else self.pitch_um

    @property
    def pitch_xy_um(self) -> Floats:
        """Cell width and height, (2,) µm."""
        return np.array([self.pitch_x_um, self.pitch_y_um])

    @property
    def is_square(self) -> bool:
        """Whether the cells are square."""
        return not isinstance(self.pitch_um, tuple)

    @property
    def cell_area_um2(self) -> float:
        """Cell area in µm²."""
        return self.pitch_x_um * self.pitch_y_um

    @property
    def bounds_um(self) -> tuple[float, float, float, float]:
        """Bounds (x_min, y_min, x_max, y_max) in µm."""
        x0, y0 = self.origin_um
        return x0, y0, x0 + self.shape[1] * self.pitch_x_um, y0 + self.shape[0] * self.pitch_y_um

    @property
    def centre_um(self) -> tuple[float, float]:
        """Centre (x, y) in µm; exactly that of :meth:`centred`."""
        x0, y0 = self.origin_um
        return x0 + 0.5 * self.shape[1] * self.pitch_x_um, y0 + 0.5 * self.shape[0] * self.pitch_y_um

    @property
    def x_um(self) -> Floats:
        """Cell centres along x, (n_x,), µm."""
        return np.asarray(self.origin_um[0] + (np.arange(self.shape[1]) + 0.5) * self.pitch_x_um)

    @property
    def y_um(self) -> Floats:
        """Cell centres along y, (n_y,), µm, the lowest first."""
        return np.asarray(self.origin_um[1] + (np.arange(self.shape[0]) + 0.5) * self.pitch_y_um)


@dataclass(frozen=True, eq=False)
class PowerMap:
    """
    Irradiance in the sensor plane, per wavelength band.

    Parameters
    ----------
    data : (n_band, n_y, n_x) float32 or float64, W/m² per band
        Mean irradiance of each cell within each band. The array is copied, so that later edits do not change the map; an
        array that is read-only together with its base arrays is shared.
    grid : Grid
        Grid of the cells.
    wavelength_nm : (n_band,) float64, nm
        Wavelength of each band.
    projection : {"rectilinear", "equidistant", "equisolid", "stereographic", "orthographic"}
        Projection of the image in the plane of the map, from which a camera with a lens model derives directions.

    Raises
    ------
    ParameterError
        When shapes do not match, cells are masked, or a wavelength is not positive.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> light = fs.PowerMap.from_array(np.ones((4, 6)), pitch_um=2.0, wavelength_nm=550.0)
    >>> light.data.shape, light.grid.bounds_um
    ((1, 4, 6), (-6.0, -4.0, 6.0, 4.0))
    """

    data: Images
    grid: Grid
    wavelength_nm: Floats
    projection: ImageProjection = field(default="rectilinear", kw_only=True)

    def __post_init__(self) -> None:
        data = np.asarray(unmasked("data", self.data))
        if not np.can_cast(data.dtype, np.float64):
            raise ParameterError("data", f"must have real numbers, got the type {data.dtype}")
        if data.dtype not in (np.float32, np.float64):
            data = read_only(data.astype(np.float64))
        wavelength_nm = wavelengths_nm("wavelength_nm", self.wavelength_nm)
        if data.shape != (wavelength_nm.size, *self.grid.shape):
            raise ParameterError(
                "data",
                f"must have the shape (n_band, n_y, n_x) = {(wavelength_nm.size, *self.grid.shape)} of the "
                f"wavelengths and the grid, got {data.shape}",
            )
        object.__setattr__(self, "data", frozen_array(data))
        object.__setattr__(self, "wavelength_nm", wavelength_nm)

    def __repr__(self) -> str:
        n_bands, n_y, n_x = self.data.shape
        low_nm, high_nm = self.wavelength_nm.min(), self.wavelength_nm.max()
        bands = f"1 band at {low_nm:g} nm" if n_bands == 1 else f"{n_bands} bands from {low_nm:g} to {high_nm:g} nm"
        return f"PowerMap({n_x} x {n_y} cells of {self.grid.pitch_x_um:.4g} x {self.grid.pitch_y_um:.4g} µm, {bands})"

    plot: ClassVar[ViewMethod[Axes]] = view_method("plot_power_map")
    _repr_html_ = view_method("to_html")

    @classmethod
    def from_array(
        cls,
        data: ArrayLike,
        *,
        pitch_um: Pitch,
        wavelength_nm: ArrayLike,
        origin_um: tuple[float, float] | None = None,
        top_row_first: bool = False,
    ) -> PowerMap:
        """
        Return a power map of a plain array.

        Parameters
        ----------
        data : (n_y, n_x) or (n_band, n_y, n_x), W/m² per band
            Mean irradiance of each cell; a two-dimensional array is one band.
        pitch_um : float, or (pitch_x, pitch_y), µm
            Side of square cells, or width and height of rectangular cells.
        wavelength_nm : number or (n_band,), nm
            Wavelength of each band.
        origin_um : (x0, y0), optional, µm
            Lower left corner of the first cell of the lowest row; by default the map is centred on the optical axis.
        top_row_first : bool
            Whether the first row is the top row, as in pictures; by default it is the lowest.

        Returns
        -------
        PowerMap

        Raises
        ------
        ParameterError
            When the array has another number of dimensions, is not real, or does not match the wavelengths.

        Examples
        --------
        >>> spot = PowerMap.from_array(
        ...     [[0.0, 1.0], [0.0, 0.0]], pitch_um=2.0, wavelength_nm=550.0, top_row_first=True
        ... )
        >>> spot.data[0, 1].tolist(), spot.grid.origin_um
        ([0.0, 1.0], (-2.0, -2.0))
        """
        images = as_any_array("data", data)
        if images.ndim not in (2, 3) or 0 in images.shape:
            raise ParameterError("data", f"must have the shape (n_y, n_x) or (n_band, n_y, n_x), got {images.shape}")
        images = images.reshape(-1, *images.shape[-2:])
        n_y, n_x = images.shape[1:]
        centred = Grid.centred((n_y, n_x), pitch_um)
        grid = centred if origin_um is None else Grid((n_y, n_x), pitch_um, origin_um)
        return cls(
            with_ascending_axes(images, is_y_falling=top_row_first),
            grid,
            np.atleast_1d(as_numbers("wavelength_nm", wavelength_nm)),
        )


def from_file_rows(picture: NDArray[Any]) -> NDArray[Any]:
    """
    Convert a picture with the top row first to channels with the lowest row first.

    The shape (n_y, n_x) or (n_y, n_x, n_channel) becomes (n_channel, n_y, n_x). Returns a view.
    """
    channels = picture[np.newaxis] if picture.ndim == 2 else np.moveaxis(picture, -1, 0)
    return channels[:, ::-1, :]


def to_file_rows(picture: ArrayLike) -> NDArray[Any]:
    """
    Convert channels with the lowest row first to a picture with the top row first.

    The shape (n_y, n_x) or (n_channel, n_y, n_x) becomes (n_y, n_x[, n_channel]). Returns a view.
    """
    picture = np.asarray(unmasked("picture", picture))
    return picture[::-1] if picture.ndim == 2 else np.moveaxis(picture, 0, -1)[::-1]


def with_ascending_axes(
    images: NDArray[Any], *, is_x_falling: bool = False, is_y_falling: bool = False
) -> NDArray[Any]:
    """
    Return images (..., n_y, n_x) on ascending axes: lowest row and leftmost column first.

    The result is contiguous, and read-only if it is a copy.
    """
    flipped = images[..., :: -1 if is_y_falling else 1, :: -1 if is_x_falling else 1]
    contiguous = np.ascontiguousarray(flipped)
    return contiguous if contiguous is flipped else read_only(contiguous)


publish(__name__)

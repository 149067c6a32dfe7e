"""Raster pictures, the result of all reconstruction methods."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from foveasim._core.calls import Limits
from foveasim._core.show import ViewMethod, view_method
from foveasim._core.validation import (
    Bools,
    Floats,
    Images,
    Ints,
    check_count,
    finite_array,
    frozen_array,
    read_only,
    unmasked,
)
from foveasim._io.images import picture_format, write_picture
from foveasim.errors import GeometryError, ParameterError
from foveasim.fields import Grid, Lattice, PackedRings, to_file_rows
from foveasim.integrate import Integrator
from foveasim.layout.gaps import close_gaps
from foveasim.layout.model import Layout
from foveasim.reconstruct.colour import check_matrix
from foveasim.units import decode_srgb
from foveasim.units import encode_srgb as encoded_in_srgb

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Picture", "raster_grid"]

#: Pixels along the longer side of a picture.
PIXELS = Limits(at_least=1, at_most=2**15)
#: Coverage below the first fraction, and missing coverage below the second, are rounding errors.
NO_COVERAGE, COMPLETE = 1e-9, 1e-6
#: Caches of results for layouts, up to 200 bytes per site: number of layouts in each cache, and their largest number of sites.
MAX_CACHED: tuple[tuple[int, int], ...] = ((2, 1 << 18), (1, 1 << 20))
#: Whether gaps between neighbours, such as trenches, are drawn.
Gaps: TypeAlias = Literal["fill", "empty"]
#: Colour of pixels without photosites in formats without alpha: neither black nor white, which saturated sites have.
NO_DATA_COLOUR = (185, 196, 214)
#: A name or code of HTML, such as "white" or "#204060", or red, green and blue from 0 to 255.
Colour: TypeAlias = str | Sequence[int]
_Made = TypeVar("_Made")


@dataclass(frozen=True, eq=False)
class Picture:
    """
    Raster picture of photosite values.

    Arrays are read-only; later changes of the source arrays have no effect. Other libraries see the picture as
    ``np.asarray(picture)``: its pixels in sRGB with alpha, (n_y, n_x, 4) uint8, top row first, so that
    ``plt.imshow(picture)`` and ``PIL.Image.fromarray(np.asarray(picture))`` show it.

    Attributes
    ----------
    data : (n_channel, n_y, n_x) float32
        Values in the unit of the sites, lowest row first; NaN, not 0, where no photosite lies.
    coverage : (n_y, n_x) float32
        Fraction of each pixel that photosites cover.
    grid : Grid
        Pixels in the sensor plane.
    white : (n_channel,) float64, optional
        Values of white in each channel, up to a common factor, for the white balance of colours.
    colour_matrix : (3, n_channel) float64, optional
        Linear red, green and blue (sRGB) of white-balanced values, for :meth:`to_rgb` and all images. ``data`` are not
        corrected.

    Raises
    ------
    ParameterError
        When there is not one positive white per channel, or the matrix has another shape.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> layout, grid = (
    ...     fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0),
    ...     fs.Grid.centred((8, 8), 1.0),
    ... )
    >>> picture = fs.reconstruct.cells(layout, np.arange(16.0), grid)
    >>> picture.data.shape, picture.grid.bounds_um
    ((1, 8, 8), (-4.0, -4.0, 4.0, 4.0))
    >>> np.asarray(picture)[0, 0].tolist()  # top left pixel in sRGB, with alpha
    [231, 231, 231, 255]
    """

    data: Images
    coverage: Images
    grid: Grid
    white: Floats | None = None
    colour_matrix: Floats | None = None

    def __post_init__(self) -> None:
        for name, missing_is_nan in (("data", True), ("coverage", False)):
            values = unmasked(name, getattr(self, name), missing_is_nan=missing_is_nan)
            object.__setattr__(self, name, frozen_array(np.asarray(values)))
        if self.data.ndim != 3 or self.coverage.shape != self.data.shape[1:]:
            raise ParameterError(
                "data",
                f"and 'coverage' must have the shapes (n_channel, n_y, n_x) and (n_y, n_x), got {self.data.shape} and "
                f"{self.coverage.shape}",
            )
        if self.white is not None:
            white = finite_array("white", self.white, ndim=1, above=0.0)
            if white.size != self.data.shape[0]:
                raise ParameterError(
                    "white", f"must be one number for each of the {self.data.shape[0]} channels", white
                )
            object.__setattr__(self, "white", frozen_array(white))
        if self.colour_matrix is not None:
            matrix = check_matrix("colour_matrix", self.colour_matrix, self.data.shape[0])
            object.__setattr__(self, "colour_matrix", matrix)

    def __repr__(self) -> str:
        n_channels, n_y, n_x = self.data.shape
        values = self.data[np.isfinite(self.data)]
        extent = f"values from {values.min():.4g} to {values.max():.4g}" if values.size else "no values"
        pixels = f"{n_x} x {n_y} pixels of {self.grid.pitch_x_um:.4g} x {self.grid.pitch_y_um:.4g} µm"
        return f"Picture({pixels}, {n_channels} channel{'s' * (n_channels != 1)}, {extent})"

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        if copy is False:
            raise ValueError("the pixels of a Picture are always a copy; 'data' contains its values without one")
        image = self.to_image()
        if image.shape[2] == 2:
            image = image[..., [0, 0, 0, 1]]
        return image if dtype is None else image.astype(dtype)

    plot: ClassVar[ViewMethod[Axes]] = view_method("plot_picture")
    _repr_html_ = view_method("to_html")
    _repr_png_ = view_method("to_png")

    def to_rgb(self, white: float | Floats | None = None, *, clip: bool = False) -> Picture:
        """
        Return the picture as light, in linear sRGB or grey.

        Parameters
        ----------
        white : number or (n_channel,), optional
            Values that become 1; by default those of the picture, or 1. A single number applies neither white balance nor
            colour correction.
        clip : bool
            Whether values above white are limited to it, before the colour correction, so that saturated photosites are white.

        Returns
        -------
        Picture
            Values relative to white: three channels, corrected with ``colour_matrix`` if there is one, and then negative for
            colours outside sRGB; one channel for grey pictures, and the mean of other numbers of channels.
        """
        given = (1.0 if self.white is None else self.white) if white is None else white
        levels = self._levels(given)
        data = np.asarray(self.data / levels)
        if clip:
            np.minimum(data, 1.0, out=data)
        if self.colour_matrix is not None and levels.size == self.data.shape[0]:
            data = np.einsum("ck,kyx->cyx", self.colour_matrix, data)
        elif data.shape[0] not in (1, 3):
            data = data.mean(axis=0, keepdims=True)
        return Picture(read_only(data.astype(np.float32)), self.coverage, self.grid)

    def to_image(
        self,
        white: float | Floats | None = None,
        *,
        encode_srgb: bool = True,
        bits: Literal[8, 16] = 8,
        background: Colour | None = None,
    ) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """
        Return the picture as integers for a file or a screen, top row first.

        Parameters
        ----------
        white : number or (n_channel,), optional
            Values that map to the largest integer, as for :meth:`to_rgb`; by default the largest value of the picture, or, for
            a picture with ``white``, the smallest multiple of it that no value exceeds.
        encode_srgb : bool
            Whether to encode linear values with the sRGB transfer function, as screens and image files expect.
        bits : {8, 16}
        background : str or (r, g, b), optional
            Colour of pixels without photosites, such as ``"white"``, ``"#204060"`` or ``(32, 64, 96)``; pixels that photosites
            cover partly are mixed with it, as viewers mix transparent pixels. By default such pixels are transparent.

        Returns
        -------
        image : (n_y, n_x, 2 or 4) or, with a background, (n_y, n_x, 1 or 3), uint8 or uint16
            Grey or RGB as of :meth:`to_rgb`, with the coverage as alpha. With a background there is no alpha; a grey picture on
            a background of another colour becomes RGB, unless photosites cover all pixels.

        Raises
        ------
        ParameterError
            When ``white`` is not positive, ``bits`` is neither 8 nor 16, or ``background`` is not a colour.
        """
        light = np.asarray(self.to_rgb(white, clip=white is not None).data, np.float64)
        level = 1.0 if white is not None else float(np.nanmax(light, initial=0.0)) or 1.0
        fraction = np.clip(np.nan_to_num(light) / level, 0.0, 1.0)
        if encode_srgb:
            fraction = encoded_in_srgb(fraction)
        coverage = np.clip(self.coverage, 0.0, 1.0)[np.newaxis]
        if background is None:
            layers = np.concatenate((fraction, coverage))
        else:
            colour = _channels(background, fraction.shape[0])
            is_complete = bool(np.all(coverage >= 1.0 - COMPLETE))
            layers = fraction if is_complete else coverage * fraction + (1.0 - coverage) * colour
        image: NDArray[Any] = np.rint((2**bits - 1) * to_file_rows(layers))
        return np.ascontiguousarray(image.astype(np.uint8 if bits == 8 else np.uint16))

    def save(
        self,
        path: str | Path,
        white: float | Floats | None = None,
        *,
        encode_srgb: bool | None = None,
        bits: Literal[8, 16, 32] | None = None,
        background: Colour | None = None,
    ) -> None:
        """
        Write the picture to a file atomically.

        Parameters
        ----------
        path : path
            ``.png``, ``.webp``, ``.jp2``, ``.tga`` (with alpha), ``.jpg``, ``.bmp``, ``.ppm``, ``.gif`` (without alpha),
            ``.tif`` with integers or floating-point numbers, or, with the extra ``pictures``, ``.exr``. 16 bits per channel
            are available in ``.png`` (in colour with the extra ``pictures``) and ``.tif``.
        white, encode_srgb
            For integers, as for :meth:`to_image`: encoded in sRGB by default; linear ones are marked so, in ``.png`` and
            ``.tif`` only. Floating-point files contain linear values and cannot be encoded: ``data``, or, with ``white``, light
            as of :meth:`to_rgb`. :meth:`foveasim.Scene.from_picture` returns these values from each file.
        bits : {8, 16, 32}, optional
            32 writes floating-point numbers, with NaN where no photosite lies and without alpha. By default 32 for TIFF and
            EXR, and 8 for other formats.
        background : str or (r, g, b), optional
            As for :meth:`to_image`; a pale blue, (185, 196, 214), by default in formats without alpha. In floating-point files
            its linear value, where 1 is ``white``, replaces NaN and is mixed with partly covered pixels.

        Raises
        ------
        FileError
            When the extension is unknown, the format does not support ``bits``, or the file cannot be written.
        ParameterError
            When ``bits`` is none of these, a floating-point file has a background and no ``white``, integers are linear in a
            format that cannot say so, or as for :meth:`to_image`.
        """
        chosen = picture_format(path)
        if bits is None and np.dtype(chosen.types[0]).itemsize == 4:
            bits = 32
        if bits != 32:
            if background is None and not chosen.has_alpha:
                background = NO_DATA_COLOUR
            encode_srgb = encode_srgb is None or encode_srgb
            if not encode_srgb and chosen.write_linear is None:
                hint = "use .png or .tif"
                raise ParameterError(
                    "encode_srgb",
                    f"must be True for {chosen.title}, which cannot store that values are linear",
                    hint=hint,
                )
            image = self.to_image(white, encode_srgb=encode_srgb, bits=bits or 8, background=background)
            write_picture(path, image, encoding="srgb" if encode_srgb else "linear")
            return
        if encode_srgb:
            raise ParameterError("encode_srgb", "must be False for floating-point files, which store linear values")
        values = np.asarray(self.data if white is None else self.to_rgb(white).data)
        if values.shape[0] not in (1, 3):
            raise ParameterError(
                "data", f"must have 1 or 3 channels to be saved without 'white', got {self.data.shape[0]}"
            )
        if background is not None:
            if white is None:
                raise ParameterError("white", "must be given with 'background' in floating-point files, as its unit")
            colour = decode_srgb(_channels(background, values.shape[0]))
            coverage = np.clip(self.coverage, 0.0, 1.0)
            values = coverage * np.nan_to_num(values) + (1.0 - coverage) * colour
        write_picture(path, np.ascontiguousarray(to_file_rows(np.asarray(values, np.float32))))

    def _levels(self, white: float | Floats) -> Floats:
        levels = finite_array("white", white, above=0.0)
        if levels.ndim > 1 or levels.size not in (1, self.data.shape[0]):
            raise ParameterError(
                "white", f"must be one number, or one for each of the {self.data.shape[0]} channels", white
            )
        return levels.reshape(-1, 1, 1)


def _channels(colour: Colour, n_channels: int) -> Floats:
    """Return a colour as sRGB values from 0 to 1, (1 or 3, 1, 1); one if all is grey."""
    from PIL import ImageColor

    try:
        if isinstance(colour, str):
            rgb = tuple(ImageColor.getrgb(colour)[:3])
        else:
            rgb = tuple(check_count("background", part, at_least=0, at_most=255) for part in colour)
        if len(rgb) != 3:
            raise ValueError
    except (TypeError, ValueError):
        raise ParameterError(
            "background", "must be a colour such as 'white', '#204060' or (32, 64, 96)", colour
        ) from None
    is_grey = n_channels == 1 and len(set(rgb)) == 1
    return np.array(rgb[:1] if is_grey else rgb, np.float64).reshape(-1, 1, 1) / 255.0


def raster_grid(layout: PackedRings, max_pixels: Annotated[int, PIXELS]) -> Grid:
    """
    Return a grid of square pixels over the layout, ``max_pixels`` along its longer side.

    Examples
    --------
    >>> import foveasim as fs
    >>> grid = fs.reconstruct.raster_grid(fs.layout.grid(n_x=40, n_y=20, pitch_um=3.0), 400)
    >>> grid.shape, round(grid.pitch_um, 4)
    ((200, 400), 0.3)
    """
    lattice: Lattice | None = getattr(layout, "lattice", None)
    if lattice is None and layout.xy_um.size == 0:
        raise GeometryError("the layout has no sites; a picture needs at least one")
    if lattice is not None:  # without its vertices
        low, high = np.array(lattice.bounds_um).reshape(2, 2)
    else:
        columns_um = layout.xy_um.T  # separately: many times faster than a reduction along axis 0
        low, high = (np.array([extreme(each) for each in columns_um]) for extreme in (np.min, np.max))
    pitch_um = float((high - low).max()) / max_pixels
    n_x, n_y = (max(1, math.ceil(length / pitch_um - 1e-6)) for length in high - low)
    centre = 0.5 * (low + high)
    origin_um = (float(centre[0] - 0.5 * n_x * pitch_um), float(centre[1] - 0.5 * n_y * pitch_um))
    return Grid((n_y, n_x), pitch_um, origin_um)


class Raster(NamedTuple):
    """
    Photosites on the pixels of a picture.

    ``sites``: integrator of the photosites. ``drawn``: that of the outlines in the picture, without gaps between neighbours
    if these are filled. ``covered_um2`` (n_y, n_x): area of the drawn outlines in each pixel. ``covered_fraction``
    (n_y, n_x): the same as a fraction of the pixel.
    """

    sites: Integrator
    drawn: Integrator
    covered_um2: Floats
    covered_fraction: Floats

    def means(self, values: Floats) -> Picture:
        """Return the means of values (n_channel, n_site) over the covered part of each pixel."""
        covered_um2 = np.where(self.covered_fraction > 0.0, self.covered_um2, np.nan)
        return self.picture(self.drawn.spread(values) / covered_um2)

    def picture(self, values: Floats) -> Picture:
        """Return the picture with these values, (n_channel, n_y, n_x)."""
        coverage = read_only(self.covered_fraction.astype(np.float32))
        return Picture(read_only(values.astype(np.float32)), coverage, self.sites.grid)


def cached_by_layout(make: Callable[..., _Made]) -> Callable[..., _Made]:
    """
    Return a function whose last results are cached, for layouts of up to a million sites.

    ``make``: function of a layout and hashable values.
    """
    caches = [(max_sites, lru_cache(maxsize=count)(make)) for count, max_sites in MAX_CACHED]

    def cached(layout: PackedRings, *values: Any) -> _Made:
        if isinstance(layout, Layout):  # immutable
            for max_sites, cached_make in caches:
                if layout.n_sites <= max_sites:
                    return cached_make(layout, *values)
        return make(layout, *values)

    return cached


# Pictures of one layout share its raster, such as the samples of a dataset or the frames of a video.
@cached_by_layout
def raster_of(layout: PackedRings, grid: Grid, gaps: Gaps, n_threads: int | None) -> Raster:
    """Return the photosites on the pixels of a picture."""
    sites = Integrator(layout, grid, n_threads=n_threads)
    covered_um2 = sites.spread(np.ones(sites.n_sites))
    closed = close_gaps(layout, _sites_at_gaps(sites, covered_um2)) if gaps == "fill" else None
    drawn = sites if closed is None else Integrator(closed, grid, n_threads=n_threads)
    covered_um2 = covered_um2 if closed is None else drawn.spread(np.ones(sites.n_sites))
    fraction = covered_um2 / grid.cell_area_um2
    return Raster(sites, drawn, covered_um2, np.where(fraction > NO_COVERAGE, np.minimum(fraction, 1.0), 0.0))


def _sites_at_gaps(sites: Integrator, covered_um2: Floats) -> Ints:
    """Return the sites at pixels that are not covered completely: others have no gap."""
    is_incomplete: Bools = covered_um2 < (1.0 - COMPLETE) * sites.grid.cell_area_um2
    near = np.pad(is_incomplete, 1, constant_values=True)
    near = near[:-2] | near[1:-1] | near[2:]
    near = near[:, :-2] | near[:, 1:-1] | near[:, 2:]
    return np.flatnonzero(sites(near.astype(np.float64)) > 0.0)

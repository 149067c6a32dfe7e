"""Raster pictures, the result of all reconstruction methods."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats, Images, check_count, finite_array, own, unmasked
from foveasim._io.encodings import encode_srgb_values
from foveasim._io.images import write_picture
from foveasim.errors import GeometryError, ParameterError
from foveasim.fields import Grid, PackedRings, to_file_rows
from foveasim.integrate import Integrator

__all__ = ["Picture", "coverage_fraction", "raster_grid"]

#: Coverage below this fraction is rounding error.
NO_COVERAGE = 1e-9
#: File extensions that store floating-point numbers by default.
FLOAT_EXTENSIONS = (".tif", ".tiff", ".exr")


@dataclass(frozen=True, eq=False)
class Picture:
    """
    Raster picture of photosite values.

    Arrays are read-only; later changes of the source arrays have no effect.

    Attributes
    ----------
    data : (n_channel, n_y, n_x) float32
        Values in the unit of the sites, lowest row first; NaN, not 0, where no photosite lies.
    coverage : (n_y, n_x) float32
        Fraction of each pixel that photosites cover.
    grid : Grid
        Pixels in the sensor plane.
    """

    data: Images
    coverage: Images
    grid: Grid

    def __post_init__(self) -> None:
        for name, missing_is_nan in (("data", True), ("coverage", False)):
            values = unmasked(name, getattr(self, name), missing_is_nan=missing_is_nan)
            object.__setattr__(self, name, own(np.asarray(values)))

    def to_image(
        self, white: float | Floats | None = None, *, encode_srgb: bool = False, bits: int = 8
    ) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """
        Return the picture as integers for a file or a screen, top row first.

        Parameters
        ----------
        white : number or (n_channel,), optional
            Values that map to the largest integer; by default the largest value of the picture.
        encode_srgb : bool
            Whether to encode linear values with the sRGB transfer function.
        bits : {8, 16}

        Returns
        -------
        image : (n_y, n_x, n_channel + 1) uint8 or uint16
            Grey or RGB, with the coverage as alpha: pixels without photosites are transparent.

        Raises
        ------
        ParameterError
            When the picture has neither 1 nor 3 channels, ``white`` is not positive, or ``bits`` is neither 8 nor 16.
        """
        if self.data.shape[0] not in (1, 3):
            raise ParameterError("data", f"must have 1 or 3 channels to be shown, got {self.data.shape[0]}")
        if bits not in (8, 16):
            raise ParameterError("bits", "must be 8 or 16", bits)
        if white is None:
            white = float(np.nanmax(self.data, initial=0.0)) or 1.0
        fraction = np.clip(np.nan_to_num(self.data) / self._levels(white), 0.0, 1.0)
        if encode_srgb:
            fraction = encode_srgb_values(fraction)
        layers = np.concatenate((fraction, np.clip(self.coverage, 0.0, 1.0)[np.newaxis]))
        image: NDArray[Any] = np.rint((2**bits - 1) * to_file_rows(layers))
        return np.ascontiguousarray(image.astype(np.uint8 if bits == 8 else np.uint16))

    def save(
        self,
        path: str | Path,
        white: float | Floats | None = None,
        *,
        encode_srgb: bool = False,
        bits: int | None = None,
    ) -> None:
        """
        Write the picture to a file atomically.

        Parameters
        ----------
        path : path
            ``.png`` and other integer formats, ``.tif`` with integers or floating-point numbers, or, with the extra
            ``pictures``, ``.exr``.
        white, encode_srgb
            For integers, as for :meth:`to_image`. Floating-point files contain linear values, divided by ``white`` if it is
            given, and cannot be encoded.
        bits : {8, 16, 32}, optional
            32 writes floating-point numbers, with NaN where no photosite lies and without alpha. By default 32 for TIFF and
            EXR, and 8 for other formats.

        Raises
        ------
        FileError
            When the extension is unknown, the format does not support ``bits``, or the file cannot be written.
        ParameterError
            When ``bits`` is none of these, or as for :meth:`to_image`.
        """
        if bits is None:
            bits = 32 if Path(path).suffix.lower() in FLOAT_EXTENSIONS else 8
        if bits not in (8, 16, 32):
            raise ParameterError("bits", "must be 8, 16 or 32", bits)
        if bits != 32:
            write_picture(path, self.to_image(white, encode_srgb=encode_srgb, bits=bits))
            return
        if encode_srgb:
            raise ParameterError("encode_srgb", "must be False for floating-point files, which store linear values")
        if self.data.shape[0] not in (1, 3):
            raise ParameterError("data", f"must have 1 or 3 channels to be saved, got {self.data.shape[0]}")
        values = self.data if white is None else self.data / self._levels(white)
        write_picture(path, np.ascontiguousarray(to_file_rows(np.asarray(values, np.float32))))

    def _levels(self, white: float | Floats) -> Floats:
        levels = finite_array("white", white, above=0.0)
        if levels.ndim > 1 or levels.size not in (1, self.data.shape[0]):
            raise ParameterError(
                "white", f"must be one number, or one for each of the {self.data.shape[0]} channels", white
            )
        return levels.reshape(-1, 1, 1)


def raster_grid(layout: PackedRings, max_pixels: int) -> Grid:
    """Return a grid of square pixels over the layout, ``max_pixels`` along its longer side."""
    max_pixels = check_count("max_pixels", max_pixels, at_most=2**15)
    if layout.xy_um.size == 0:
        raise GeometryError("the layout has no sites; a picture needs at least one")
    low, high = layout.xy_um.min(axis=0), layout.xy_um.max(axis=0)
    pitch_um = float((high - low).max()) / max_pixels
    n_x, n_y = (max(1, math.ceil(length / pitch_um - 1e-6)) for length in high - low)
    centre = 0.5 * (low + high)
    origin_um = (float(centre[0] - 0.5 * n_x * pitch_um), float(centre[1] - 0.5 * n_y * pitch_um))
    return Grid((n_y, n_x), pitch_um, origin_um)


def coverage_fraction(integrator: Integrator) -> Floats:
    """
    Compute the exact fraction of each pixel that photosites cover, (n_y, n_x).

    Fractions within rounding error of 0 are 0.
    """
    fraction = integrator.spread(np.ones(integrator.n_sites)) / integrator.grid.cell_area_um2
    return np.where(fraction > NO_COVERAGE, fraction, 0.0)

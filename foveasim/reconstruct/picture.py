"""The raster picture that every method of reconstruction gives."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats, Images, check_count, finite_array, own, unmasked
from foveasim._io.encodings import encoded_srgb
from foveasim._io.images import write_picture
from foveasim.errors import GeometryError, ParameterError
from foveasim.fields import Grid, PackedRings, to_file_rows
from foveasim.integrate import Integrator

__all__ = ["Picture", "covered_share", "raster_grid"]

#: A raster pixel covered by less than this share is touched by rounding only.
NO_COVERAGE = 1e-9
#: Endings of files that hold floating-point numbers, unless told otherwise.
FLOATING = (".tif", ".tiff", ".exr")


@dataclass(frozen=True, eq=False)
class Picture:
    """
    A raster picture of per-site values.

    Arrays are read-only; later edits of arrays that it was made of do not change it.

    Attributes
    ----------
    data : (n_channel, n_y, n_x) float32
        Values in the sites' unit, row 0 lowest; NaN where no photosite is: no data is not black.
    coverage : (n_y, n_x) float32
        Fraction of each pixel that photosites cover.
    grid : Grid
        The pixels, in the sensor plane.
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
        The picture as integers for a file or a screen, first row on top.

        Parameters
        ----------
        white : number or (n_channel,), optional
            Values that become the highest number; the largest value by default.
        encode_srgb : bool
            Whether the values are linear light and are to be encoded as a screen expects.
        bits : {8, 16}

        Returns
        -------
        image : (n_y, n_x, n_channel + 1) uint8 or uint16
            Grey or colour, and the coverage as alpha: where no photosite is, the picture is transparent.

        Raises
        ------
        ParameterError
            When the picture has neither 1 nor 3 channels, white is not positive, or the bits are neither 8 nor 16.
        """
        if self.data.shape[0] not in (1, 3):
            raise ParameterError("data", f"must have 1 or 3 channels to be shown, got {self.data.shape[0]}")
        if bits not in (8, 16):
            raise ParameterError("bits", "must be 8 or 16", bits)
        if white is None:
            white = float(np.nanmax(self.data, initial=0.0)) or 1.0
        share = np.clip(np.nan_to_num(self.data) / self._levels(white), 0.0, 1.0)
        if encode_srgb:
            share = encoded_srgb(share)
        layers = np.concatenate((share, np.clip(self.coverage, 0.0, 1.0)[np.newaxis]))
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
        Write the picture to a file, whole or not at all.

        Parameters
        ----------
        path : path
            ``.png`` and others of integers, ``.tif`` of either kind, or, with the extra ``pictures``, ``.exr``.
        white, encode_srgb
            Of integers, as for :meth:`to_image`. Floating-point files hold the values themselves, or, where ``white`` is
            given, over it; they are linear, and cannot be encoded.
        bits : {8, 16, 32}, optional
            32 are floating-point numbers: NaN where no photosite is, and no alpha. By default 32 for TIFF and EXR, and 8 for
            others.

        Raises
        ------
        FileError
            When the ending names no format, or none for these bits, or nothing can be written.
        ParameterError
            When the bits are none of these, or as for :meth:`to_image`.
        """
        if bits is None:
            bits = 32 if Path(path).suffix.lower() in FLOATING else 8
        if bits not in (8, 16, 32):
            raise ParameterError("bits", "must be 8, 16 or 32", bits)
        if bits != 32:
            write_picture(path, self.to_image(white, encode_srgb=encode_srgb, bits=bits))
            return
        if encode_srgb:
            raise ParameterError("encode_srgb", "must be off for floating-point numbers, which are linear light")
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
    """Grid of square pixels over the layout, the longer side ``max_pixels`` long."""
    max_pixels = check_count("max_pixels", max_pixels, at_most=2**15)
    if layout.xy_um.size == 0:
        raise GeometryError("the layout has no sites, and so no picture")
    low, high = layout.xy_um.min(axis=0), layout.xy_um.max(axis=0)
    pitch_um = float((high - low).max()) / max_pixels
    n_x, n_y = (max(1, math.ceil(length / pitch_um - 1e-6)) for length in high - low)
    middle = 0.5 * (low + high)
    origin_um = (float(middle[0] - 0.5 * n_x * pitch_um), float(middle[1] - 0.5 * n_y * pitch_um))
    return Grid((n_y, n_x), pitch_um, origin_um)


def covered_share(integrator: Integrator) -> Floats:
    """Fraction of each pixel that photosites cover, exactly, (n_y, n_x); 0 where they touch it by rounding only."""
    share = integrator.spread(np.ones(integrator.n_sites)) / integrator.grid.cell_area_um2
    return np.where(share > NO_COVERAGE, share, 0.0)

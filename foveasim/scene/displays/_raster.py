"""Pictures on displays: digital values, luminances of pixels, cells of subpixels."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Bools, Floats, band_widths_nm, check_memory, wavelengths_nm
from foveasim._io.encodings import decode, encode
from foveasim._io.images import EncodedPicture
from foveasim.errors import ParameterError
from foveasim.fields import from_file_rows
from foveasim.scene._illuminants import interpolate_table
from foveasim.scene._photometry import luminance_of
from foveasim.scene.displays._display import Display

Images32 = NDArray[np.float32]


class Raster(NamedTuple):
    """
    Basis images of a picture on a display with their spectra, as those of a scene.

    ``basis`` (n_primary, n_y, n_x) float32, bottom row first. ``spectrum_w_m2_sr_nm`` (n_primary, n_wavelength);
    ``wavelength_nm``, ``band_width_nm`` and ``white``, relative, (n_wavelength,). ``pitch_um``: that of pixels or cells.
    """

    basis: Images32
    spectrum_w_m2_sr_nm: Floats
    wavelength_nm: Floats
    band_width_nm: Floats
    white: Floats
    pitch_um: float


def raster_of(
    display: Display, picture: EncodedPicture, *, subpixels: bool, wavelength_nm: Any, band_width_nm: Any
) -> Raster:
    """
    Return the light of a picture on a display.

    ``subpixels``: whether pixels consist of the cells of the display. ``wavelength_nm``, ``band_width_nm``: bands of the scene,
    None for those of the display. Raises ParameterError if the picture does not have digital values of the primaries, or the
    display has no cells.
    """
    if subpixels and display.cells is None:
        raise ParameterError("subpixels", "requires a display with 'cells'", subpixels)
    spectra, waves_nm, widths_nm = _spectra(display, wavelength_nm, band_width_nm)
    values = _levels(display, picture)
    black = 1.0 / display.contrast
    values *= np.float32(1.0 - black)
    values += np.float32(black)
    white, pitch_um = spectra.sum(axis=0), display.pitch_um
    if subpixels:
        values, factors, n_cells = _with_cells(display, values)
        spectra, pitch_um = spectra * factors[:, np.newaxis], pitch_um / n_cells
    return Raster(values, spectra, waves_nm, widths_nm, white / white.max(), pitch_um)


def _spectra(display: Display, wavelength_nm: Any, band_width_nm: Any) -> tuple[Floats, Floats, Floats]:
    """Return spectra of the primaries with the luminance of white, wavelengths, and widths."""
    waves_nm, spectra = np.asarray(display.wavelength_nm), np.asarray(display.primaries)
    if wavelength_nm is not None:
        at_nm = wavelengths_nm("wavelength_nm", wavelength_nm)
        waves_nm, spectra = at_nm, interpolate_table(np.vstack((waves_nm, spectra)), at_nm)
    widths_nm = band_widths_nm(waves_nm, band_width_nm)
    per_unit = float(luminance_of(spectra.sum(axis=0), waves_nm, widths_nm))
    if per_unit == 0.0:
        raise ParameterError(
            "wavelength_nm",
            "must have a band between 380 and 780 nm with light of the display",
            waves_nm.tolist(),
            "nm",
        )
    return spectra * ((display.white_cd_m2 or 0.0) / per_unit), waves_nm, widths_nm


def _levels(display: Display, picture: EncodedPicture) -> Images32:
    """Return relative luminances (n_primary, n_y, n_x), bottom row first, without black."""
    n_primary = np.asarray(display.primaries).shape[0]
    digital = _digital_values(picture, n_primary)
    if digital.dtype.kind == "f":
        shown = np.broadcast_to(digital, (n_primary, *digital.shape[1:]))
        return display.relative_luminance(shown).astype(np.float32)
    # A table of all digital values instead of the transfer function of all pixels.
    peak = np.iinfo(digital.dtype).max
    table = display.relative_luminance(np.tile(np.arange(peak + 1.0) / peak, (n_primary, 1))).astype(np.float32)
    channels = np.broadcast_to(digital, (n_primary, *digital.shape[1:]))
    return np.stack([curve[channel] for curve, channel in zip(table, channels, strict=True)])


def _digital_values(picture: EncodedPicture, n_primary: int) -> NDArray[Any]:
    """Return digital values (n_primary or 1, n_y, n_x), integers or floats from 0 to 1."""
    pixels = np.asarray(picture.pixels)
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    if pixels.dtype == np.bool_:
        pixels = pixels.astype(np.uint8) * np.uint8(255)
    if pixels.dtype.kind != "f" and pixels.dtype not in (np.uint8, np.uint16):
        raise ParameterError("picture", f"must have the dtype uint8, uint16 or float, got {pixels.dtype}")
    n_channels = pixels.shape[2] if pixels.ndim == 3 else 1
    has_alpha = n_channels != n_primary and n_channels in (2, n_primary + 1)
    if pixels.ndim not in (2, 3) or 0 in pixels.shape or n_channels - has_alpha not in (1, n_primary):
        raise ParameterError(
            "picture",
            f"must have 1 or {n_primary} channels, as the display, and alpha or none, got the shape {pixels.shape}",
        )
    if pixels.dtype.kind == "f":
        pixels = pixels.astype(np.float64)
        if not np.isfinite(pixels).all() or pixels.min() < 0.0 or pixels.max() > 1.0:
            hint = "digital values of floating-point pictures are from 0 to 1: divide by 255, or pass uint8"
            raise ParameterError("picture", "must be from 0 to 1 in all pixels", hint=hint)
    images = np.asarray(from_file_rows(pixels))
    images = images[np.newaxis] if images.ndim == 2 else images
    if picture.encoding != "srgb" or has_alpha:
        peak = 1.0 if images.dtype.kind == "f" else float(np.iinfo(images.dtype).max)
        values = images / peak
        colours = values[:-1] if has_alpha else values
        if picture.encoding != "srgb":
            colours = encode(decode(np.clip(colours, 0.0, 1.0), picture.encoding), "srgb")
        return colours * values[-1] if has_alpha else colours
    return images


def _with_cells(display: Display, values: Images32) -> tuple[Images32, Floats, int]:
    """
    Return images of cells, factors of the spectra, and the cells along a side of a pixel.

    The images are (n_primary, n_y n, n_x n) for n cells, the factors (n_primary,).
    """
    layout, (rows, columns) = np.asarray(display.cells)[::-1], display.block
    n_primary, n_y, n_x = values.shape
    along_y, along_x = layout.shape[0] // rows, layout.shape[1] // columns
    n = math.lcm(along_y, along_x)
    check_memory("cells", values.nbytes * n * n, layout.shape, "take fewer pixels or cells")
    fine = layout.repeat(n // along_y, axis=0).repeat(n // along_x, axis=1)
    shown = np.zeros((n_primary, n_y * n, n_x * n), np.float32)
    factors = np.empty(n_primary)
    for k in range(n_primary):
        is_lit = fine == k
        factors[k] = is_lit.size / np.count_nonzero(is_lit)
        areas = is_lit.reshape(rows, n, columns, n).sum(axis=(1, 3))
        own = values[k] if areas.min() == areas.max() else _block_means(values[k], rows, columns)
        _fill(shown[k], own, is_lit, n)
    return shown, factors, n


def _block_means(values: Images32, rows: int, columns: int) -> Images32:
    """
    Return the mean over the block of each pixel.

    Incomplete blocks are continued by their outermost pixels.
    """
    n_y, n_x = values.shape
    # The block at the top left is complete; row 0 is the lowest row.
    padded = np.pad(values, ((-n_y % rows, 0), (0, -n_x % columns)), mode="edge").astype(np.float64)
    means = padded.reshape(padded.shape[0] // rows, rows, -1, columns).mean(axis=(1, 3))
    return means.repeat(rows, axis=0).repeat(columns, axis=1)[-n_y:, :n_x].astype(np.float32)


def _fill(out: Images32, values: Images32, is_lit: Bools, n: int) -> None:
    """Write the values of pixels to the lit cells; blocks begin at the top left."""
    n_x = out.shape[1]
    across = -(-n_x // is_lit.shape[1])
    tiled = np.tile(is_lit, (1, across))[:, :n_x]
    for row in range(values.shape[0]):
        # Rows are counted from the top in the pattern, from the bottom in the image.
        below_top = values.shape[0] - 1 - row
        first = is_lit.shape[0] - n - (below_top * n) % is_lit.shape[0]
        np.multiply(values[row].repeat(n), tiled[first : first + n], out=out[row * n : (row + 1) * n])

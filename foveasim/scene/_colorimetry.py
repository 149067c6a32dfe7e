"""Colorimetry: tristimulus values, linear sRGB, CIELAB, and a chart of 24 patches."""

from __future__ import annotations

from functools import cache

import numpy as np

from foveasim._core.validation import Floats, read_only
from foveasim._io.primaries import WHITE_XYZ, XYZ_OF_SRGB, srgb_of_xyz
from foveasim.scene._illuminants import illuminant, read_table

#: End of the linear part of CIELAB, and its slope: CIE 15:2004, section 8.2.1.
LAB_LINEAR_END, LAB_SLOPE = (24.0 / 116.0) ** 3, 841.0 / 108.0


#: Luminance of linear red, green and blue, rounded as in Rec. ITU-R BT.709.
LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722], np.float32)


def tristimulus(spectra: Floats, wavelength_nm: Floats, band_width_nm: Floats) -> Floats:
    """
    Return the tristimulus values X, Y and Z (n, 3) of spectra (n, n_wavelength).

    CIE 1931 observer. Sums over the bands, without the factor of photometric units. Colour-matching functions are interpolated
    linearly between steps of 5 nm, and 0 outside 380 to 780 nm.
    """
    at_nm, *observer = read_table("cie_observer")
    matching = [np.interp(wavelength_nm, at_nm, column, left=0.0, right=0.0) for column in observer]
    return np.asarray((spectra * band_width_nm) @ np.transpose(matching))


def lab_of(srgb: Floats) -> Floats:
    """Return CIELAB (n, 3) of linear sRGB (n, 3), which may be negative."""
    relative = srgb @ XYZ_OF_SRGB / WHITE_XYZ
    x, y, z = np.where(
        relative > LAB_LINEAR_END, np.cbrt(np.maximum(relative, 0.0)), LAB_SLOPE * relative + 16.0 / 116.0
    ).T
    return np.column_stack((116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)))


def reflectances(wavelength_nm: Floats) -> Floats:
    """Return the reflectances (24, n_wavelength) of the chart; constant beyond its table."""
    at_nm, *patches = read_table("colour_chart_24")
    return np.array([np.interp(wavelength_nm, at_nm, patch) for patch in patches])


def patch_colours(illumination: Floats, wavelength_nm: Floats, band_width_nm: Floats) -> Floats | None:
    """
    Return linear sRGB (24, 3) of the patches under an illumination (n_wavelength,).

    Returns None when a tristimulus value of the illumination is 0: there is no white to adapt to.
    """
    patches, white = (
        tristimulus(illumination * part, wavelength_nm, band_width_nm)
        for part in (reflectances(wavelength_nm), np.ones((1, wavelength_nm.size)))
    )
    return srgb_of_xyz(patches, white[0]) if white.min() > 0.0 else None


@cache
def photograph_of_patches() -> Floats:
    """Return linear sRGB (24, 3) of the chart in daylight, as a picture file stores it."""
    waves_nm = np.arange(380.0, 781.0, 5.0)
    found = patch_colours(illuminant("D65", waves_nm), waves_nm, np.full(waves_nm.size, 5.0))
    assert found is not None
    return read_only(np.clip(found, 0.0, None))

"""Bundled displays: an LCD with the primaries of sRGB, an OLED with those of DCI-P3."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Annotated

import numpy as np

from foveasim._core.calls import OwnCheck, Usual
from foveasim._core.validation import Floats, Ints, band_widths_nm, read_only
from foveasim._io.primaries import SRGB_XY, xyz_of_xy
from foveasim.scene._colorimetry import tristimulus
from foveasim.scene.displays._display import BLACK, PITCH, WHITE, Display, Transfer
from foveasim.scene.registry import DISPLAYS

#: Bands (peak in nm, full width at half maximum in nm, relative height) of each primary. The last two digits of peaks and
#: heights solve for the chromaticities of the standards.
LCD_BANDS = (
    ((622.50, 50.0, 1.0), (450.0, 20.0, 0.04966)),
    ((541.907, 70.0, 1.0), (450.0, 20.0, 0.09238)),
    ((450.0, 20.0, 1.0), (503.653, 50.0, 0.08673)),
)
OLED_BANDS = (
    ((620.464, 30.0, 1.0), (660.464, 40.0, 0.2)),
    ((529.077, 35.0, 1.0), (569.077, 45.0, 0.24729)),
    ((458.0, 20.0, 1.0), (530.106, 60.0, 0.02979)),
)
#: Wavelengths of the tables.
FIRST_NM, LAST_NM, STEP_NM = 380.0, 780.0, 5.0
#: Stripes of red, green and blue; RGBG of a PenTile display with two subpixels per pixel.
STRIPES = ((0, 1, 2),)
PENTILE, PENTILE_BLOCK = ((0, 1, 2, 1), (2, 1, 0, 1)), (2, 2)

_Bands = tuple[tuple[tuple[float, float, float], ...], ...]


@cache
def _white_balanced(bands: _Bands) -> tuple[Floats, Floats]:
    """Return wavelengths and primaries, whose sum has the chromaticity of D65."""
    waves_nm = np.arange(FIRST_NM, LAST_NM + 1.0, STEP_NM)
    spectra = np.array(
        [
            sum(
                height * np.exp(-4.0 * np.log(2.0) * ((waves_nm - peak_nm) / fwhm_nm) ** 2)
                for peak_nm, fwhm_nm, height in own
            )
            for own in bands
        ]
    )
    xyz = tristimulus(spectra, waves_nm, band_widths_nm(waves_nm, None))
    amounts = np.linalg.solve(xyz.T, xyz_of_xy(SRGB_XY[3:])[0])
    return read_only(waves_nm), read_only(amounts[:, np.newaxis] * spectra / (amounts[:, np.newaxis] * spectra).max())


@DISPLAYS.register("lcd", expected=((0.64, 0.33), (0.30, 0.60), (0.15, 0.06)))
def lcd(
    *,
    pitch_um: Annotated[float, PITCH, Usual(50.0, 500.0)] = 264.6,
    white_cd_m2: Annotated[float, WHITE, Usual(50.0, 1000.0)] = 250.0,
    black_cd_m2: Annotated[float, BLACK, Usual(0.0, 1.0)] = 0.25,
    transfer: OwnCheck[Transfer] = "srgb",
    cells: Sequence[Sequence[int]] | Ints | None = STRIPES,
    block: tuple[int, int] = (1, 1),
) -> Display:
    """
    Create a desktop LCD with white LEDs behind colour filters, and the primaries of sRGB.

    Parameters
    ----------
    pitch_um : float, µm
        Pixel pitch; by default 96 pixels per inch.
    white_cd_m2, black_cd_m2 : float, cd/m²
        Luminances; by default those of an office monitor with a contrast of 1000.
    transfer, cells, block
        As for :class:`Display`; by default sRGB, and stripes of red, green and blue, each a third of a pixel wide.

    Returns
    -------
    Display

    Notes
    -----
    The spectra are not a measurement. They are sums of Gaussian bands: a blue LED at 450 nm, as in backlights of LCDs with
    phosphors (L. Wang et al., Opt. Express 23, 28707, 2015), with a half width of 20 nm, and broad green and red bands of
    phosphors behind colour filters, which transmit some light of neighbouring bands. The peaks and heights that remain are the
    solution for the primaries of Rec. ITU-R BT.709; the chromaticities agree to 5e-4, and that of white, D65, exactly.

    Examples
    --------
    >>> import foveasim as fs
    >>> monitor = fs.scene.displays.lcd(white_cd_m2=120.0, black_cd_m2=0.1)
    >>> round(monitor.dpi), monitor.white_xy.round(4).tolist()
    (96, [0.3127, 0.329])
    """
    waves_nm, primaries = _white_balanced(LCD_BANDS)
    return Display(
        wavelength_nm=waves_nm,
        primaries=primaries,
        pitch_um=pitch_um,
        white_cd_m2=white_cd_m2,
        black_cd_m2=black_cd_m2,
        transfer=transfer,
        cells=cells,
        block=block,
        source="LCD, sRGB",
    )


@DISPLAYS.register("oled", expected=((0.68, 0.32), (0.265, 0.69), (0.15, 0.06)))
def oled(
    *,
    pitch_um: Annotated[float, PITCH, Usual(50.0, 500.0)] = 63.5,
    white_cd_m2: Annotated[float, WHITE, Usual(50.0, 1000.0)] = 500.0,
    black_cd_m2: Annotated[float, BLACK, Usual(0.0, 1.0)] = 0.0,
    transfer: OwnCheck[Transfer] = "srgb",
    cells: Sequence[Sequence[int]] | Ints | None = PENTILE,
    block: tuple[int, int] = PENTILE_BLOCK,
) -> Display:
    """
    Create an OLED display of a telephone with the primaries of DCI-P3.

    Parameters
    ----------
    pitch_um : float, µm
        Pixel pitch; by default 400 pixels per inch.
    white_cd_m2, black_cd_m2 : float, cd/m²
        Luminances. Pixels with the digital value 0 emit no light by default.
    transfer, cells, block
        As for :class:`Display`; by default sRGB, as Display P3, and a PenTile matrix (RGBG): each pixel has a green subpixel,
        and every second one a red or a blue one.

    Returns
    -------
    Display

    Notes
    -----
    The spectra are not a measurement. They are Gaussian bands with half widths of 20 to 35 nm and shoulders at longer
    wavelengths. Peaks and heights are the solution for the primaries of SMPTE EG 432-1 (DCI-P3); the chromaticities agree to
    5e-4. White is D65, as for Display P3. Measured OLED displays had large contrast ratios, and powers as transfer functions
    (E. A. Cooper et al., Assessment of OLED displays for vision research, J. Vis. 13(12), 16, 2013).

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.scene.displays.oled().primaries_xy.round(3).tolist()
    [[0.68, 0.32], [0.265, 0.69], [0.15, 0.06]]
    """
    waves_nm, primaries = _white_balanced(OLED_BANDS)
    return Display(
        wavelength_nm=waves_nm,
        primaries=primaries,
        pitch_um=pitch_um,
        white_cd_m2=white_cd_m2,
        black_cd_m2=black_cd_m2,
        transfer=transfer,
        cells=cells,
        block=block,
        source="OLED, DCI-P3",
    )

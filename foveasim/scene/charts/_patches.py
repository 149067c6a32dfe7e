"""Charts of uniform patches: greys and colours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Unpack

import numpy as np

from foveasim._core.calls import NOT_NEGATIVE, POSITIVE, Limits
from foveasim._core.validation import Floats, band_widths_nm, wavelengths_nm
from foveasim.scene._illuminants import TABLES_NM, Illuminant
from foveasim.scene._illuminants import illuminant as cie_illuminant
from foveasim.scene._photometry import level_of_white
from foveasim.scene._scene import RADIANCE, Scene
from foveasim.scene.charts._canvas import Canvas, Fractions, Picture, Raster, add_rectangle, chart
from foveasim.scene.charts._colours import PATCH_NAMES, nonnegative_factors, patch_reflectance

#: Default wavelengths of a colour chart.
COLOUR_NM = tuple(400.0 + 10.0 * k for k in range(31))
#: Wavelengths of the tabulated factors.
TABLE_NM = 380.0 + 10.0 * np.arange(41)
N_ROWS, N_COLUMNS = 4, 6
MAX_STEPS = 1000


@chart(
    "grey_scale",
    example={"patch_mm": 1.9, "n_steps": 4},
    expected=("........", "........", "##  ....", "##  ....", "........", "........"),
)
def grey_scale(
    *,
    n_steps: Annotated[int, Limits(at_least=1, at_most=MAX_STEPS)] = 12,
    ratio: Annotated[float, Limits(at_least=1.0)] = 2.0,
    patch_mm: Annotated[float, POSITIVE],
    **picture: Unpack[Picture],
) -> Scene:
    """
    Return a grey scale on black, for response curves and dynamic range. Exact.

    Square patches in a row, with radiance decreasing from left to right.

    Parameters
    ----------
    n_steps : int
        Number of patches; the first is white.
    ratio : float
        Ratio of the radiances of successive patches: 2 is a stop, ``10**0.15`` a density step of 0.15.
    patch_mm : float, mm
        Side of a patch.
    {picture}

    Returns
    -------
    scene : Scene
        One basis image. The centre of patch k, from 0 on the left, is ``((k - (n_steps - 1) / 2) * patch_mm, 0)``.

    Raises
    ------
    ParameterError
        If the patches do not fit, or a value is out of range.

    Warns
    -----
    SamplingWarning
        If a patch is smaller than a pixel.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.scene.charts.grey_scale(
    ...     patch_mm=3.0,
    ...     shape=(90, 120),
    ...     pitch_um=400.0,
    ...     distance_m=0.5,
    ...     illuminance_lux=500.0,
    ... )
    >>> scene.basis.shape
    (1, 90, 120)
    """
    canvas = Canvas(**picture)
    canvas.check_fits("patch_mm", n_steps * patch_mm, patch_mm)
    canvas.warn_if_fine("patch_mm", 2.0 * patch_mm)
    fractions = np.zeros(canvas.shape, np.float32)
    for k in range(n_steps):
        left_mm = (k - 0.5 * n_steps) * patch_mm
        x_mm, y_mm = (left_mm, left_mm + patch_mm), (-0.5 * patch_mm, 0.5 * patch_mm)
        add_rectangle(fractions, canvas, x_mm, y_mm, float(np.exp(-k * np.log(ratio))))
    return canvas.scene(fractions, "a grey scale")


@chart(
    "colour_chart",
    example={"patch_mm": 1.03, "gap_mm": 0.11},
    expected=("........", ".. ..  .", ". . .  .", "....#  .", " ## ....", "........"),
)
def colour_chart(
    *,
    patch_mm: Annotated[float, POSITIVE],
    gap_mm: Annotated[float, NOT_NEGATIVE] = 0.0,
    illuminant: Illuminant = "D65",
    n_basis: Annotated[int, Limits(at_least=1, at_most=len(PATCH_NAMES))] = 12,
    radiance_w_m2_sr_nm: Annotated[float | None, RADIANCE] = None,
    luminance_cd_m2: float | None = None,
    illuminance_lux: float | None = None,
    wavelength_nm: Sequence[float] = COLOUR_NM,
    **raster: Unpack[Raster],
) -> Scene:
    """
    Return the Macbeth ColorChecker on black under an illuminant. Exact.

    The 24 patches are arranged in four rows of six.

    Parameters
    ----------
    patch_mm : float, mm
        Side of a patch.
    gap_mm : float, mm
        Gap between patches.
    illuminant : {"A", "D50", "D55", "D65", "D75", "E"}
        CIE illuminant of the chart.
    n_basis : int
        Number of basis images, at most 24. The computing time of the optics is proportional to it; see the notes.
    radiance_w_m2_sr_nm : float, W/(m² sr nm)
        Spectral radiance at 560 nm of a white with reflectance 1.
    luminance_cd_m2, illuminance_lux : float, cd/m² and lx
        Luminance of this white, or illuminance of the chart, instead of the radiance.
    wavelength_nm : sequence, nm
        Wavelengths from 380 to 780; by default 400 to 700 in steps of 10.
    {picture}

    Returns
    -------
    scene : Scene
        Scene with ``n_basis`` basis images, or one per wavelength if there are fewer wavelengths.

    Raises
    ------
    ParameterError
        If the patches do not fit, or a value is out of range.

    Warns
    -----
    SamplingWarning
        If a patch is smaller than a pixel.

    Notes
    -----
    Areas are exact. The first patch, dark skin, is at the upper left, white at the lower left. The reflectances are those of
    :func:`patch_reflectance`.

    Spectra are exact with 24 basis images, or with one basis image per wavelength. With fewer basis images the spectra are
    sums of ``n_basis`` spectra, with a mean and maximum colour difference of 0.1 and 0.5 CIELAB units for 12 basis images,
    0.3 and 1.3 for 10, 0.8 and 2.5 for 8.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.scene.charts.colour_chart(
    ...     patch_mm=5.0,
    ...     gap_mm=1.0,
    ...     shape=(90, 120),
    ...     pitch_um=400.0,
    ...     distance_m=0.5,
    ...     illuminance_lux=500.0,
    ... )
    >>> scene.basis.shape, scene.wavelength_nm.size
    ((12, 90, 120), 31)
    """
    waves_nm = wavelengths_nm("wavelength_nm", wavelength_nm)
    illumination = cie_illuminant(illuminant, waves_nm)
    weights, spectra = _patch_spectra(waves_nm, n_basis)  # before the bands: wavelengths are within the tables
    if raster.get("band_width_nm") is None:
        raster["band_width_nm"] = band_widths_nm(waves_nm, None, TABLES_NM).tolist()
    canvas = Canvas(radiance_w_m2_sr_nm=1.0, wavelength_nm=wavelength_nm, **raster)
    step_mm = patch_mm + gap_mm
    canvas.check_fits("patch_mm", N_COLUMNS * step_mm - gap_mm, N_ROWS * step_mm - gap_mm)
    canvas.warn_if_fine("patch_mm", 2.0 * patch_mm)
    level = level_of_white(
        "radiance_w_m2_sr_nm",
        radiance_w_m2_sr_nm,
        illumination,
        waves_nm,
        np.asarray(canvas.band_width_nm),
        luminance_cd_m2=luminance_cd_m2,
        illuminance_lux=illuminance_lux,
    )
    basis = _patches(canvas, weights, patch_mm, step_mm)
    return canvas.scene_of(basis, spectra * illumination * level, "a colour chart", illumination)


def _patch_spectra(wavelength_nm: Floats, n_basis: int) -> tuple[Floats, Floats]:
    """Return weights (24, n) and reflectances (n, n_wavelength) of the basis images."""
    if wavelength_nm.size <= n_basis:
        return patch_reflectance(wavelength_nm), np.eye(wavelength_nm.size)
    exact = patch_reflectance(wavelength_nm)
    if n_basis == len(PATCH_NAMES):
        return np.eye(n_basis), exact
    weights, spectra = nonnegative_factors(n_basis)
    return weights, np.array([np.interp(wavelength_nm, TABLE_NM, spectrum) for spectrum in spectra])


def _patches(canvas: Canvas, weights: Floats, patch_mm: float, step_mm: float) -> Fractions:
    """Return basis images (n_basis, n_y, n_x) of patches with weights (24, n_basis)."""
    basis = np.zeros((weights.shape[1], *canvas.shape), np.float32)
    for patch, row_of_weights in enumerate(weights):
        row, column = divmod(patch, N_COLUMNS)
        x_mm = (column - 0.5 * (N_COLUMNS - 1)) * step_mm
        y_mm = (0.5 * (N_ROWS - 1) - row) * step_mm
        for picture, weight in zip(basis, row_of_weights, strict=True):
            if weight > 0.0:
                add_rectangle(
                    picture,
                    canvas,
                    (x_mm - 0.5 * patch_mm, x_mm + 0.5 * patch_mm),
                    (y_mm - 0.5 * patch_mm, y_mm + 0.5 * patch_mm),
                    float(weight),
                )
    return basis

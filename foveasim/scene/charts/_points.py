"""Charts of point sources."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Unpack

import numpy as np

from foveasim._core.calls import NOT_NEGATIVE, POSITIVE
from foveasim._core.validation import check_shape
from foveasim.errors import ParameterError
from foveasim.scene._scene import Scene
from foveasim.scene.charts._canvas import Canvas, Raster, chart

#: Tolerance of a spacing from an integer number of pixels.
ROUNDING_PIXELS = 1e-6


@chart(
    "point_grid",
    example={"spacing_mm": 2.0, "n_points": (2, 3), "intensity_w_sr_nm": 3e-6},
    expected=("........", "..#.#.#.", "........", "..#.#.#.", "........", "........"),
)
def point_grid(
    *,
    spacing_mm: Annotated[float, POSITIVE],
    n_points: tuple[int, int] | None = None,
    intensity_w_sr_nm: Annotated[float, NOT_NEGATIVE],
    wavelength_nm: Sequence[float] | None = None,
    **raster: Unpack[Raster],
) -> Scene:
    """
    Return a grid of point sources on black, for field-dependent PSFs and distortion.

    Parameters
    ----------
    spacing_mm : float, mm
        Spacing of the points, an integer multiple of the pixel pitch.
    n_points : (n_y, n_x), optional
        Number of rows and columns of points; by default the largest odd numbers that fit into the picture.
    intensity_w_sr_nm : float, W/(sr nm)
        Spectral radiant intensity of each point.
    wavelength_nm : sequence, optional, nm
        Wavelengths; the intensity is the same at all of them. By default one band at 550 nm with a width of 100 nm.
    {picture}

    Raises
    ------
    ParameterError
        If the spacing is not an integer number of pixels, the points do not fit, or a value is out of range.

    Warns
    -----
    SamplingWarning
        If every pixel is a point.

    Notes
    -----
    The power of a point is assigned to the pixel that contains it. A point on the boundary of two pixels is assigned to the
    right or upper pixel: if the centre of the picture is such a boundary, the grid is shifted by half a pixel to the right
    or up.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.scene.charts.point_grid(
    ...     spacing_mm=4.0,
    ...     intensity_w_sr_nm=1e-6,
    ...     shape=(90, 120),
    ...     pitch_um=400.0,
    ...     distance_m=0.5,
    ... )
    >>> int((scene.basis > 0.0).sum())
    99
    """
    canvas = Canvas(radiance_w_m2_sr_nm=1.0, wavelength_nm=wavelength_nm, **raster)
    step = round(spacing_mm / canvas.pitch_mm)
    if step < 1 or abs(spacing_mm / canvas.pitch_mm - step) > ROUNDING_PIXELS:
        raise ParameterError(
            "spacing_mm",
            f"must be an integer number of pixels of {canvas.pitch_mm:g} mm",
            spacing_mm,
            "mm",
            f"the nearest value is {max(step, 1) * canvas.pitch_mm:.6g} mm",
        )
    counts = tuple(2 * ((n - n // 2 - 1) // step) + 1 for n in canvas.shape)
    if n_points is not None:
        counts = check_shape("n_points", n_points)
        # The outermost points lie at pixel centres or on pixel boundaries.
        canvas.check_fits(
            "n_points", ((counts[1] - 1) * step + 1) * canvas.pitch_mm, ((counts[0] - 1) * step + 1) * canvas.pitch_mm
        )
    canvas.warn_if_fine("spacing_mm", spacing_mm)
    i_y, i_x = (
        np.asarray([(n_pixels + (2 * j - n + 1) * step) // 2 for j in range(n)], np.int64)
        for n_pixels, n in zip(canvas.shape, counts, strict=True)
    )
    pixels = np.stack(np.meshgrid(i_y, i_x, indexing="ij"), axis=-1).reshape(-1, 2)
    return Scene.point_sources(
        shape=canvas.shape,
        pixels=pixels,  # type: ignore[arg-type]
        intensity_w_sr_nm=intensity_w_sr_nm,
        pitch_um=canvas.pitch_um,
        distance_m=canvas.distance_m,
        wavelength_nm=canvas.wavelength_nm,
        band_width_nm=canvas.band_width_nm,
    )

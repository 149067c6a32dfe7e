"""Periodic charts: sine wave, zone plate and Siemens star."""

from __future__ import annotations

from typing import Annotated, Literal, Unpack

import numpy as np

from foveasim._core.calls import FRACTION, POSITIVE, Limits
from foveasim._core.validation import Floats
from foveasim.scene._scene import Scene
from foveasim.scene.charts._canvas import HALF_TURN, Canvas, Pattern, Picture, chart, half_plane, sample_means

#: Limit of computing time: the sampled centre of a star with more sectors takes minutes.
MAX_SPOKES = 1000
#: A pixel contains at most one edge where sectors are wider than this, which is more than a pixel diagonal.
MIN_SECTOR_PIXELS = 1.5
#: Half the pixel diagonal, rounded up.
HALF_DIAGONAL_PIXELS = 0.7072
#: Amplitude of the wave that is clipped to a square wave; the value on an edge is 1/2.
SQUARE_WAVE_AMPLITUDE = 1e9
#: Points and weights of three-point Gauss-Legendre quadrature for means over the interval from -1/2 to 1/2.
GAUSS = ((-0.5 * np.sqrt(0.6), 5.0 / 18.0), (0.0, 8.0 / 18.0), (0.5 * np.sqrt(0.6), 5.0 / 18.0))


@chart(
    "sine",
    example={"line_pairs_per_mm": 0.23, "angle_deg": 30.0},
    expected=(". ##.. #", "..## ..#", ".. ##.. ", " ..## ..", "#.. ##..", "# ..## ."),
)
def sine(
    *,
    line_pairs_per_mm: Annotated[float, POSITIVE],
    angle_deg: Annotated[float, HALF_TURN] = 0.0,
    phase_deg: Annotated[float, Limits(at_least=-360.0, at_most=360.0)] = 0.0,
    contrast: Annotated[float, FRACTION] = 1.0,
    **picture: Unpack[Picture],
) -> Scene:
    """
    Return a sine wave of one frequency and direction, for direct MTF measurements. Exact.

    Parameters
    ----------
    line_pairs_per_mm : float, 1/mm
        Spatial frequency in the scene.
    angle_deg : float, degrees
        Direction of the wave vector, counter-clockwise from x; at 0 the lines are vertical.
    phase_deg : float, degrees
        Shift of the central white line along the wave vector; 90 is a quarter of a period.
    contrast : float
        (white - black) / (white + black) of the ideal wave; the contrast of the pixel means is slightly lower.
    {picture}

    Warns
    -----
    SamplingWarning
        If a period is shorter than two pixels.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.scene.charts.sine(
    ...     line_pairs_per_mm=0.2,
    ...     shape=(90, 120),
    ...     pitch_um=400.0,
    ...     distance_m=0.5,
    ...     illuminance_lux=500.0,
    ... )
    >>> scene.basis.shape
    (1, 90, 120)
    """
    canvas = Canvas(contrast=contrast, **picture)
    angle, phase = np.deg2rad(angle_deg), np.deg2rad(phase_deg)
    canvas.warn_if_fine("line_pairs_per_mm", 1.0 / line_pairs_per_mm)
    along_x, along_y = line_pairs_per_mm * np.cos(angle), line_pairs_per_mm * np.sin(angle)
    # The mean of a wave over a pixel is its value at the centre times a sinc along each side.
    height = 0.5 * np.sinc(along_x * canvas.pitch_mm) * np.sinc(along_y * canvas.pitch_mm)
    x = np.exp(2j * np.pi * along_x * canvas.x_mm - 1j * phase)
    y = height * np.exp(2j * np.pi * along_y * canvas.y_mm)
    fractions = canvas.fill(
        lambda rows: 0.5 + np.multiply.outer(y.real[rows], x.real) - np.multiply.outer(y.imag[rows], x.imag)
    )
    return canvas.scene(fractions, "a sine wave")


@chart(
    "zone_plate",
    example={"line_pairs_per_mm": 0.9},
    expected=("  ####  ", " # .. # ", " #.##.# ", " #.##.# ", " # .. # ", "  ####  "),
)
def zone_plate(
    *,
    line_pairs_per_mm: Annotated[float, POSITIVE],
    radius_mm: Annotated[float, POSITIVE] | None = None,
    **pattern: Unpack[Pattern],
) -> Scene:
    """
    Return a sinusoidal zone plate, for aliasing at all frequencies and directions.

    Parameters
    ----------
    line_pairs_per_mm : float, 1/mm
        Spatial frequency at the rim, in the scene.
    radius_mm : float, optional, mm
        Radius of the rim; by default the largest that fits into the picture.
    {picture}

    Raises
    ------
    ParameterError
        If the rings do not fit, or a value is out of range.

    Warns
    -----
    SamplingWarning
        If a period at the rim is shorter than two pixels.

    Notes
    -----
    The fraction of white is ``(1 + cos(π f r² / R)) / 2`` with the frequency f at the rim R, so that the frequency at r is
    ``f r / R``. The background outside the rim is the mean of black and white. The means are exact (Fresnel integrals),
    except in pixels on the rim, which are sampled at 32 x 32 points.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.scene.charts.zone_plate(
    ...     line_pairs_per_mm=1.0,
    ...     shape=(90, 120),
    ...     pitch_um=400.0,
    ...     distance_m=0.5,
    ...     illuminance_lux=500.0,
    ... )
    >>> scene.basis.shape
    (1, 90, 120)
    """
    canvas = Canvas(**pattern)
    radius_mm = canvas.radius_mm(radius_mm)
    canvas.warn_if_fine("line_pairs_per_mm", 1.0 / line_pairs_per_mm)
    # Fresnel integrals are integrals of cos(π t² / 2): t is this factor times a length.
    scale_per_mm = float(np.sqrt(2.0 * line_pairs_per_mm / radius_mm))
    (cos_x, sin_x), (cos_y, sin_y) = (_mean_chirp(e, scale_per_mm) for e in (canvas.x_edges_mm, canvas.y_edges_mm))

    def ideal(x: Floats, y: Floats) -> Floats:
        r2 = x * x + y * y
        return np.where(r2 < radius_mm**2, 0.5 + 0.5 * np.cos(0.5 * np.pi * scale_per_mm**2 * r2), 0.5)

    def block(rows: slice) -> Floats:
        r = np.hypot(canvas.x_mm, canvas.y_mm[rows, np.newaxis])
        rings = 0.5 + 0.5 * (np.multiply.outer(cos_y[rows], cos_x) - np.multiply.outer(sin_y[rows], sin_x))
        rings[r > radius_mm] = 0.5
        is_rim = np.abs(r - radius_mm) < HALF_DIAGONAL_PIXELS * canvas.pitch_mm
        rings[is_rim] = sample_means(canvas, is_rim, rows, ideal)
        return rings

    return canvas.scene(canvas.fill(block), "a zone plate")


@chart(
    "siemens_star",
    example={"n_spokes": 3},
    expected=("  ##..  ", "  ##..  ", " .. .## ", " .. .## ", "  ##..  ", "  ##..  "),
)
def siemens_star(
    *,
    n_spokes: Annotated[int, Limits(at_least=2, at_most=MAX_SPOKES)] = 36,
    radius_mm: Annotated[float, POSITIVE] | None = None,
    profile: Literal["square", "sine"] = "square",
    **pattern: Unpack[Pattern],
) -> Scene:
    """
    Return a Siemens star, for resolution and aliasing in all directions.

    Parameters
    ----------
    n_spokes : int
        Number of white sectors, equal to the number of black sectors; a white sector is centred on the x axis. The spatial
        frequency at the radius r is ``n_spokes / (2 π r)`` line pairs per mm.
    radius_mm : float, optional, mm
        Radius of the star; by default the largest that fits into the picture.
    profile : {"square", "sine"}
        Profile across the sectors: black and white, or sinusoidal (as the star of ISO 12233:2014 with 144 sectors).
    {picture}

    Raises
    ------
    ParameterError
        If the star does not fit, or a value is out of range.

    Warns
    -----
    SamplingWarning
        If a period at the rim is shorter than two pixels. Near the centre it always is.

    Notes
    -----
    The background outside the rim is the mean of black and white. Where sectors are wider than 1.5 pixels, means of the
    square profile are exact and means of the sinusoidal profile are accurate to 1e-4. Pixels nearer to the centre and pixels
    on the rim are sampled at 32 x 32 points.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.scene.charts.siemens_star(
    ...     n_spokes=36,
    ...     shape=(90, 120),
    ...     pitch_um=400.0,
    ...     distance_m=0.5,
    ...     illuminance_lux=500.0,
    ... )
    >>> scene.basis.shape
    (1, 90, 120)
    """
    canvas = Canvas(**pattern)
    radius_mm = canvas.radius_mm(radius_mm)
    canvas.warn_if_fine("n_spokes", 2.0 * np.pi * radius_mm / n_spokes)
    mean_of_spokes = _mean_of_edges if profile == "square" else _mean_of_waves

    def ideal(x: Floats, y: Floats) -> Floats:
        height = SQUARE_WAVE_AMPLITUDE if profile == "square" else 0.5
        spokes = np.clip(0.5 + height * np.cos(n_spokes * np.arctan2(y, x)), 0.0, 1.0)
        return np.where(x * x + y * y < radius_mm**2, spokes, 0.5)

    def block(rows: slice) -> Floats:
        x, y = canvas.x_mm / canvas.pitch_mm, canvas.y_mm[rows, np.newaxis] / canvas.pitch_mm
        r, rim = np.hypot(x, y), radius_mm / canvas.pitch_mm
        spokes = mean_of_spokes(x, y, n_spokes)
        spokes[r > rim] = 0.5
        is_central = r * np.sin(np.pi / n_spokes) < MIN_SECTOR_PIXELS
        is_sampled = (is_central & (r < rim)) | (np.abs(r - rim) < HALF_DIAGONAL_PIXELS)
        spokes[is_sampled] = sample_means(canvas, is_sampled, rows, ideal)
        return spokes

    return canvas.scene(canvas.fill(block), "a Siemens star")


def _mean_of_edges(x: Floats, y: Floats, n_spokes: int) -> Floats:
    """
    Return the fraction of white sectors in pixels at x (n_x,) and y (n_row, 1), in pixels.

    Valid for pixels with at most one edge.
    """
    angle = np.arctan2(y, x)
    number = np.rint(angle * n_spokes / np.pi - 0.5)
    edge = (number + 0.5) * np.pi / n_spokes
    across_x, across_y = -np.sin(edge), np.cos(edge)
    fraction = half_plane(across_x * x + across_y * y, across_x, across_y)
    # The sector counter-clockwise of the first edge is black, of the next edge white, and so on.
    return np.where(np.mod(number, 2.0) == 0.0, 1.0 - fraction, fraction)


def _mean_of_waves(x: Floats, y: Floats, n_spokes: int) -> Floats:
    """
    Return the mean of the angular wave in pixels at x (n_x,) and y (n_row, 1), in pixels.

    Gauss-Legendre quadrature, accurate where sectors are wide.
    """
    mean = np.full(np.broadcast_shapes(x.shape, y.shape), 0.5)
    for dx, weight_x in GAUSS:
        for dy, weight_y in GAUSS:
            mean += 0.5 * weight_x * weight_y * np.cos(n_spokes * np.arctan2(y + dy, x + dx))
    return mean


def _mean_chirp(edges_mm: Floats, scale_per_mm: float) -> tuple[Floats, Floats]:
    """Return means (n,) of cos and sin of π (s x)² / 2 between boundaries (n + 1,)."""
    from scipy.special import fresnel

    sines, cosines = fresnel(scale_per_mm * edges_mm)
    steps = scale_per_mm * np.diff(edges_mm)
    return np.diff(cosines) / steps, np.diff(sines) / steps

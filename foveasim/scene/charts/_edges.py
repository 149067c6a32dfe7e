"""Charts of straight edges with exact means over pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, Unpack

import numpy as np

from foveasim._core.calls import FRACTION, POSITIVE
from foveasim._core.validation import Floats, check_count, check_shape
from foveasim.errors import ParameterError
from foveasim.scene._scene import Scene
from foveasim.scene.charts._canvas import (
    HALF_TURN,
    Canvas,
    Pattern,
    Picture,
    add_rectangle,
    chart,
    half_plane,
    ink_to_white,
    interval,
)

Ink = Literal["dark", "bright"]

#: Elements per group; the ratio of successive frequencies is the sixth root of 2.
N_ELEMENTS = 6
#: Bars per element, and their length in bar widths.
N_BARS, BAR_LENGTH = 3, 5.0
#: Gaps in bar widths: between the two halves of an element, below it, and right of the first element of a group.
INNER_GAP, LOWER_GAP, COLUMN_GAP = 2.0, 2.0, 4.0
#: Larger absolute numbers are input errors: 1e-9 and 1e9 line pairs per mm.
MAX_GROUP = 30
#: Strokes of the F in fifths of its height, (x0, x1, y0, y1) from the lower left corner: stem, upper arm, lower arm.
F_STROKES = ((0.0, 1.0, 0.0, 5.0), (1.0, 3.0, 4.0, 5.0), (1.0, 2.0, 2.0, 3.0))
F_WIDTH, F_HEIGHT = 3.0, 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BarElement:
    """
    Half of an element of :func:`bars`: three bars that fill a square.

    Attributes
    ----------
    group, element : int
    direction : {"vertical", "horizontal"}
        Direction of the bars; vertical bars measure the resolution along x.
    line_pairs_per_mm : float, 1/mm
        Spatial frequency in the scene.
    x_mm, y_mm : float, mm
        Centre of the square.
    side_mm : float, mm
        Side of the square, five bar widths.
    """

    group: int
    element: int
    direction: Literal["vertical", "horizontal"]
    line_pairs_per_mm: float
    x_mm: float
    y_mm: float
    side_mm: float


@chart(
    "checkerboard",
    example={"square_mm": 2.03},
    expected=("##..##..", "..##..##", "..##..##", "##..##..", "##..##..", "..##..##"),
)
def checkerboard(
    *,
    square_mm: Annotated[float, POSITIVE],
    n_squares: tuple[int, int] | None = None,
    **pattern: Unpack[Pattern],
) -> Scene:
    """
    Return a checkerboard, for lens calibration and moiré. Exact.

    Parameters
    ----------
    square_mm : float, mm
        Side of a square.
    n_squares : (n_y, n_x), optional
        Number of squares of a centred board on white, with a black lower left square. By default the squares fill the
        picture, a corner of four squares is at the centre, and the square to its upper right is black.
    {picture}

    Raises
    ------
    ParameterError
        If the board does not fit, or a value is out of range.

    Warns
    -----
    SamplingWarning
        If a square is smaller than a pixel.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.scene.charts.checkerboard(
    ...     square_mm=4.0,
    ...     n_squares=(4, 6),
    ...     shape=(90, 120),
    ...     pitch_um=400.0,
    ...     distance_m=0.5,
    ...     illuminance_lux=500.0,
    ... )
    >>> scene.basis.shape
    (1, 90, 120)
    """
    canvas = Canvas(**pattern)
    edges_mm = canvas.y_edges_mm, canvas.x_edges_mm
    inside: list[Floats] = [np.ones(n) for n in canvas.shape]
    first_mm = [0.0, 0.0]
    if n_squares is not None:
        counts = check_shape("n_squares", n_squares)
        canvas.check_fits("n_squares", counts[1] * square_mm, counts[0] * square_mm)
        first_mm = [-0.5 * n * square_mm for n in counts]
        inside = [interval(e, low, -low) for e, low in zip(edges_mm, first_mm, strict=True)]
        edges_mm = tuple(np.clip(e, low, -low) for e, low in zip(edges_mm, first_mm, strict=True))  # type: ignore[assignment]
    canvas.warn_if_fine("square_mm", 2.0 * square_mm)
    y, x = (
        np.diff(_integral_of_square_wave_mm(e - low, square_mm)) / canvas.pitch_mm
        for e, low in zip(edges_mm, first_mm, strict=True)
    )
    # Squares are black if the signs of column and row are equal.
    fractions = canvas.fill(
        lambda rows: 1.0 - 0.5 * (np.multiply.outer(inside[0][rows], inside[1]) + np.multiply.outer(y[rows], x))
    )
    return canvas.scene(fractions, "a checkerboard")


@chart(
    "slanted_edge",
    example={"angle_deg": 25.0},
    expected=(".. #####", "...#####", "... ####", "....####", ".... ###", ".....###"),
)
def slanted_edge(
    *,
    angle_deg: Annotated[float, HALF_TURN] = 5.0,
    contrast: Annotated[float, FRACTION] = 0.6,
    **picture: Unpack[Picture],
) -> Scene:
    """
    Return a slanted edge through the centre, for the MTF of ISO 12233. Exact.

    The left side is black, the right side white.

    Parameters
    ----------
    angle_deg : float, degrees
        Angle of the edge from the vertical, counter-clockwise; 90 is a horizontal edge with white above it.
    contrast : float
        (white - black) / (white + black); 0.6 by default, a ratio of 4 between white and black, as in ISO 12233.
    {picture}

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.scene.charts.slanted_edge(
    ...     angle_deg=5.0,
    ...     shape=(90, 120),
    ...     pitch_um=400.0,
    ...     distance_m=0.5,
    ...     illuminance_lux=500.0,
    ... )
    >>> round(float(scene.basis.min() / scene.basis.max()), 4)  # a ratio of 4
    0.25
    """
    canvas = Canvas(contrast=contrast, **picture)
    angle = np.deg2rad(angle_deg)
    across_x, across_y = float(np.cos(angle)), float(np.sin(angle))
    x = across_x * canvas.x_mm / canvas.pitch_mm
    y = across_y * canvas.y_mm / canvas.pitch_mm
    fractions = canvas.fill(lambda rows: half_plane(np.add.outer(y[rows], x), across_x, across_y))
    return canvas.scene(fractions, "a slanted edge")


@chart(
    "bars",
    example={"groups": [1], "shape": (90, 80)},
    expected=("########", "###  ###", "#### ###", "########", "###  ###", *["########"] * 4),
)
def bars(
    *,
    groups: Sequence[int],
    ink: Ink = "dark",
    **pattern: Unpack[Pattern],
) -> Scene:
    """
    Return a three-bar target with the frequencies of the USAF 1951 chart. Exact.

    Parameters
    ----------
    groups : sequence of int
        Group numbers. A group has six elements of ``2**(group + (element - 1) / 6)`` line pairs per mm in the scene.
    ink : {"dark", "bright"}
        Black bars on white, or white bars on black.
    {picture}

    Raises
    ------
    ParameterError
        If the groups do not fit, or a value is out of range.

    Warns
    -----
    SamplingWarning
        If the finest element has fewer than two pixels per period.

    Notes
    -----
    The gaps between bars are equal to their width, their length is five widths (MIL-STD-150A). The arrangement differs from
    the spiral of the standard: each group is a column with its first element on top, the coarsest group is on the left, and
    vertical bars are left of horizontal bars. :func:`bar_elements` returns the positions.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.scene.charts.bars(
    ...     groups=[-1],
    ...     shape=(90, 120),
    ...     pitch_um=400.0,
    ...     distance_m=0.5,
    ...     illuminance_lux=500.0,
    ... )
    >>> scene.basis.shape
    (1, 90, 120)
    """
    canvas = Canvas(**pattern)
    elements = bar_elements(groups)
    canvas.check_fits(
        "groups",
        2.0 * max(abs(e.x_mm) + 0.5 * e.side_mm for e in elements),
        2.0 * max(abs(e.y_mm) + 0.5 * e.side_mm for e in elements),
    )
    canvas.warn_if_fine("groups", min(1.0 / e.line_pairs_per_mm for e in elements))
    fractions = np.zeros(canvas.shape, np.float32)
    for e in elements:
        low, high = -0.5 * e.side_mm, 0.5 * e.side_mm
        for k in range(N_BARS):
            left = low + 2 * k * e.side_mm / BAR_LENGTH
            across, along = (left, left + e.side_mm / BAR_LENGTH), (low, high)
            x, y = (across, along) if e.direction == "vertical" else (along, across)
            add_rectangle(fractions, canvas, (e.x_mm + x[0], e.x_mm + x[1]), (e.y_mm + y[0], e.y_mm + y[1]))
    return canvas.scene(ink_to_white(fractions, ink), "bars")


def bar_elements(groups: Sequence[int]) -> tuple[BarElement, ...]:
    """
    Return positions and frequencies of the elements of :func:`bars`.

    Parameters
    ----------
    groups : sequence of int

    Returns
    -------
    elements : tuple of BarElement
        Sorted by group from the coarsest, then by element; vertical bars before horizontal bars.

    Raises
    ------
    ParameterError
        If the groups are not integers, or not unique.

    Examples
    --------
    >>> finest = bar_elements([0, 1])[-1]
    >>> finest.group, finest.element, finest.direction, round(finest.line_pairs_per_mm, 2)
    (1, 6, 'horizontal', 3.56)
    """
    if not isinstance(groups, Sequence | np.ndarray) or len(groups) == 0:
        raise ParameterError("groups", "must be a list of integers", groups)
    numbers = sorted(
        check_count(f"groups[{i}]", g, at_least=-MAX_GROUP, at_most=MAX_GROUP) for i, g in enumerate(groups)
    )
    if len(set(numbers)) != len(numbers):
        raise ParameterError("groups", "must be unique", list(groups))
    elements = []
    left_mm = lowest_mm = right_mm = 0.0
    for group in numbers:
        top_mm = 0.0
        for element in range(1, N_ELEMENTS + 1):
            line_pairs_per_mm = 2.0 ** (group + (element - 1) / N_ELEMENTS)
            width_mm = 0.5 / line_pairs_per_mm
            side_mm = BAR_LENGTH * width_mm
            y_mm = top_mm - 0.5 * side_mm
            x_mm = left_mm + 0.5 * side_mm
            elements.append((group, element, "vertical", line_pairs_per_mm, x_mm, y_mm, side_mm))
            x_mm += side_mm + INNER_GAP * width_mm
            elements.append((group, element, "horizontal", line_pairs_per_mm, x_mm, y_mm, side_mm))
            right_mm = max(right_mm, x_mm + 0.5 * side_mm)
            lowest_mm = min(lowest_mm, y_mm - 0.5 * side_mm)
            top_mm -= side_mm + LOWER_GAP * width_mm
        left_mm += (2.0 * BAR_LENGTH + INNER_GAP + COLUMN_GAP) * 0.5 / 2.0**group
    return tuple(
        BarElement(
            group=group,
            element=element,
            direction=direction,  # type: ignore[arg-type]
            line_pairs_per_mm=line_pairs_per_mm,
            x_mm=x_mm - 0.5 * right_mm,
            y_mm=y_mm - 0.5 * lowest_mm,
            side_mm=side_mm,
        )
        for group, element, direction, line_pairs_per_mm, x_mm, y_mm, side_mm in elements
    )


@chart(
    "letter_f",
    example={"height_mm": 4.7},
    expected=("###  ###", "## . ###", "## .####", "## .####", "##  ####", "########"),
)
def letter_f(
    *,
    height_mm: Annotated[float, POSITIVE],
    ink: Ink = "dark",
    **pattern: Unpack[Pattern],
) -> Scene:
    """
    Return a centred letter F, which has no rotation or mirror symmetry. Exact.

    Parameters
    ----------
    height_mm : float, mm
        Height of the letter; the stroke width is a fifth of it, the width of the letter three fifths.
    ink : {"dark", "bright"}
        Black letter on white, or white letter on black.
    {picture}

    Raises
    ------
    ParameterError
        If the letter does not fit, or a value is out of range.

    Warns
    -----
    SamplingWarning
        If a stroke is narrower than a pixel.

    Examples
    --------
    >>> import foveasim as fs
    >>> scene = fs.scene.charts.letter_f(
    ...     height_mm=20.0,
    ...     shape=(90, 120),
    ...     pitch_um=400.0,
    ...     distance_m=0.5,
    ...     illuminance_lux=500.0,
    ... )
    >>> sorted(set(scene.basis.ravel().tolist()))
    [0.0, 1.0]
    """
    canvas = Canvas(**pattern)
    unit_mm = height_mm / F_HEIGHT
    canvas.check_fits("height_mm", F_WIDTH * unit_mm, height_mm)
    canvas.warn_if_fine("height_mm", 2.0 * unit_mm)
    fractions = np.zeros(canvas.shape, np.float32)
    for x0, x1, y0, y1 in F_STROKES:
        x_mm = ((x0 - 0.5 * F_WIDTH) * unit_mm, (x1 - 0.5 * F_WIDTH) * unit_mm)
        y_mm = ((y0 - 0.5 * F_HEIGHT) * unit_mm, (y1 - 0.5 * F_HEIGHT) * unit_mm)
        add_rectangle(fractions, canvas, x_mm, y_mm)
    return canvas.scene(ink_to_white(fractions, ink), "a letter F")


def _integral_of_square_wave_mm(x_mm: Floats, half_mm: float) -> Floats:
    """Return the integral from 0 of a square wave with values 1 and -1, starting with 1."""
    return np.asarray(half_mm - np.abs(np.mod(x_mm, 2.0 * half_mm) - half_mm))

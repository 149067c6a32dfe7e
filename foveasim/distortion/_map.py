"""Distorted power maps by inverse mapping and interpolation, for display and comparison."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import Limits, OwnCheck
from foveasim._core.validation import Floats, Images, read_only
from foveasim.errors import ParameterError
from foveasim.fields import Grid, PointMap, PowerMap

#: Conserved quantity: the power on an area of the image, or the power per area.
Conserve: TypeAlias = Literal["flux", "density"]
#: Highest spline order of ``scipy.ndimage``.
MAX_ORDER = 5
#: Memory limit: strong distortion can map the boundary to infinity.
MAX_CELLS = 2**28
#: Cells that are interpolated at once, a memory limit.
CELLS_PER_PIECE = 2**20
#: Sample points of the boundary: per cell, and minimum per side.
POINTS_PER_CELL, MIN_POINTS = 1, 256
#: Tolerance for rounding errors of positions on cell edges, in cells.
EDGE_TOLERANCE = 1e-6
#: Step of the finite differences for cells that extend beyond the image circle, in cells.
DIFFERENCE_STEP = 1e-3


def distort_map(
    power_map: PowerMap,
    lens: OwnCheck[PointMap],
    *,
    grid: Grid | None = None,
    conserve: Conserve = "flux",
    order: Annotated[int, Limits(at_least=0, at_most=MAX_ORDER)] = 1,
) -> PowerMap:
    """
    Distort the power map of an ideal lens.

    Parameters
    ----------
    power_map : PowerMap
        Power map in the image plane of an ideal lens.
    lens : BrownConrady, Fisheye, PolynomialFisheye or Scaramuzza
        Any object with ``distort`` and ``undistort``.
    grid : Grid, optional
        Grid of the distorted map. The default has the same pitch, covers the complete distorted boundary of the map, and is
        aligned with the cells of the map.
    conserve : {"flux", "density"}
        Whether the power on an area of the image is conserved (physical), or the power per area (as in image warping).
    order : int
        Order of the spline between cell means, from 0 (nearest) and 1 (linear) to 5. Orders of 2 and above can yield negative
        values.

    Returns
    -------
    PowerMap
        Distorted map with the dtype and wavelengths of the input. Cells with a source position outside the map or outside the
        image circle are 0.

    Raises
    ------
    ParameterError
        If an argument differs from the above, or the distorted map would be too large.

    Notes
    -----
    The method of the paper (section on distortion): the centre of each cell is undistorted, and the map is interpolated
    there. "flux" multiplies by the ratio of the areas of the undistorted and the distorted cell, the determinant of
    ``d x_u / d x_d``. Interpolation blurs the image, and a coarser grid aliases it. Photosites avoid both, because
    :class:`foveasim.Integrator` undistorts their outlines.

    Examples
    --------
    >>> import foveasim as fs
    >>> flat = fs.PowerMap.from_array(np.ones((40, 60)), pitch_um=10.0, wavelength_nm=550.0)
    >>> barrel = fs.distortion.BrownConrady(focal_um=1000.0, k1=-0.1)
    >>> distort_map(flat, barrel).grid.shape
    (40, 60)
    >>> round(float(distort_map(flat, barrel, conserve="density").data.max()), 12)
    1.0
    """
    if not (hasattr(lens, "undistort") and (grid is not None or hasattr(lens, "distort"))):
        raise ParameterError("lens", "must be a lens of foveasim.distortion", lens)
    if power_map.projection != "rectilinear":
        raise ParameterError(
            "power_map",
            f"must be rectilinear, got an {power_map.projection} image",
            hint="pass camera.lens_for(power_map) to foveasim.Integrator instead",
        )
    if grid is None:
        grid = _bounding_grid(power_map.grid, lens)
    if math.prod(grid.shape) > MAX_CELLS:
        raise ParameterError("grid", f"must have at most {MAX_CELLS} cells", grid.shape, hint="reduce its shape")
    coefficients = [_spline(band, order) for band in power_map.data]
    data = np.empty((len(coefficients), *grid.shape), power_map.data.dtype)
    n_rows = max(CELLS_PER_PIECE // grid.shape[1], 1)
    for first in range(0, grid.shape[0], n_rows):
        rows = slice(first, min(first + n_rows, grid.shape[0]))
        pixel, gain = _source_coordinates(grid, rows, power_map.grid, lens, conserve)
        for band, image in enumerate(coefficients):
            data[band, rows] = _interpolate(image, pixel, order) * gain
    return PowerMap(read_only(data), grid, power_map.wavelength_nm)


def _bounding_grid(grid: Grid, lens: Any) -> Grid:
    """Return the smallest aligned grid of equal pitch around the distorted map."""
    x0, y0, x1, y1 = grid.bounds_um
    n_y, n_x = (max(POINTS_PER_CELL * n, MIN_POINTS) + 1 for n in grid.shape)
    x, y = np.linspace(x0, x1, n_x), np.linspace(y0, y1, n_y)
    boundary = np.concatenate(
        [np.stack(np.broadcast_arrays(*side), axis=1) for side in ((x, y0), (x, y1), (x0, y), (x1, y))]
    )
    real = lens.distort(boundary, outside="mask")
    is_outside = np.isnan(real).any(axis=1)
    corners = real[~is_outside]
    if is_outside.any():
        # Part of the boundary lies beyond the fold: the distorted map fills the image circle.
        radius_um, centre = lens.max_radius_um[1], np.asarray(lens.centre_um)
        corners = np.concatenate((corners, [centre - radius_um, centre + radius_um]))
    low, high = corners.min(axis=0), corners.max(axis=0)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ParameterError("grid", "must be specified, because the lens maps the map boundary to infinity")
    first = np.floor((low - (x0, y0)) / grid.pitch_xy_um + EDGE_TOLERANCE)
    last = np.ceil((high - (x0, y0)) / grid.pitch_xy_um - EDGE_TOLERANCE)
    n_x, n_y = (int(n) for n in np.maximum(last - first, 1))
    if n_x * n_y > MAX_CELLS:
        raise ParameterError(
            "grid", f"must be specified, because the distorted map has {n_y} x {n_x} cells, more than {MAX_CELLS}"
        )
    origin = np.array([x0, y0]) + first * grid.pitch_xy_um
    return Grid((n_y, n_x), grid.pitch_um, (float(origin[0]), float(origin[1])))


def _spline(band: NDArray[Any], order: int) -> Images:
    """Return the coefficients of the spline through the cell means."""
    from scipy.ndimage import spline_filter

    if order < 2:
        return band
    return np.asarray(spline_filter(np.asarray(band, np.float64), order, mode="reflect"))  # type: ignore[call-overload]


def _interpolate(image: Images, pixel: Floats, order: int) -> Floats:
    """
    Return interpolated values at positions (2, n_y, n_x) in rows and columns.

    Integer positions are cell centres. Values are 0 outside the map and at NaN positions.
    """
    from scipy.ndimage import map_coordinates

    n = np.array(image.shape)[:, np.newaxis, np.newaxis]
    is_on_map = ((pixel >= -0.5 - EDGE_TOLERANCE) & (pixel <= n - 0.5 + EDGE_TOLERANCE)).all(axis=0)
    inside = np.where(is_on_map, pixel, 0.0)
    values = np.empty(is_on_map.shape)
    map_coordinates(image, inside, values, order, mode="reflect", prefilter=False)  # type: ignore[call-overload]
    return np.where(is_on_map, values, 0.0)


def _source_coordinates(
    grid: Grid, rows: slice, source: Grid, lens: PointMap, conserve: Conserve
) -> tuple[Floats, Floats | float]:
    """
    Return source positions of rows of cells, and the factors of their values.

    Positions are in rows and columns of the source cells.
    """
    centres = np.stack(np.meshgrid(grid.x_um, grid.y_um[rows]), axis=-1)
    ideal = lens.undistort(centres, outside="mask")
    cell = (ideal - source.origin_um) / source.pitch_xy_um - 0.5
    pixel = np.stack([cell[..., 1], cell[..., 0]])
    if conserve == "density":
        return pixel, 1.0
    corners = lens.undistort(_corners(grid, rows), outside="mask")
    # The area of a quadrilateral is half the product of its diagonals.
    rising, falling = corners[1:, 1:] - corners[:-1, :-1], corners[1:, :-1] - corners[:-1, 1:]
    area_um2 = 0.5 * np.abs(rising[..., 0] * falling[..., 1] - rising[..., 1] * falling[..., 0])
    gain = area_um2 / grid.cell_area_um2
    is_rim = np.isnan(gain) & ~np.isnan(ideal).any(axis=-1)
    gain[is_rim] = _determinant(lens, centres[is_rim], ideal[is_rim], DIFFERENCE_STEP * grid.pitch_xy_um)
    return pixel, np.nan_to_num(gain, nan=0.0)


def _corners(grid: Grid, rows: slice) -> Floats:
    """Return the corners of rows of cells, (n_row + 1, n_x + 1, 2), µm."""
    x_um = grid.origin_um[0] + np.arange(grid.shape[1] + 1) * grid.pitch_x_um
    y_um = grid.origin_um[1] + np.arange(rows.start, rows.stop + 1) * grid.pitch_y_um
    return np.stack(np.meshgrid(x_um, y_um), axis=-1)


def _determinant(lens: PointMap, points_um: Floats, ideal_um: Floats, step_um: Floats) -> Floats:
    """
    Return the determinant of d x_u / d x_d for cells that extend beyond the image circle.

    One-sided differences towards the centre of the image circle.
    """
    columns = []
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = step_um[axis]
        up, down = (lens.undistort(points_um + sign * step, outside="mask") for sign in (1.0, -1.0))
        columns.append(np.where(np.isnan(up), ideal_um - down, up - ideal_um) / step_um[axis])
    across, along = columns
    return np.asarray(np.abs(across[..., 0] * along[..., 1] - across[..., 1] * along[..., 0]))

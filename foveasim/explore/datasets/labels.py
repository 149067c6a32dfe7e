"""Mapping of picture labels (boxes, masks, optical flow) to photosites through the lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Bools, Floats, Ints, finite_array
from foveasim._io.images import read_picture
from foveasim.distortion import Lens
from foveasim.errors import ParameterError, type_name
from foveasim.explore._files import load_array
from foveasim.fields import Grid, from_file_rows
from foveasim.integrate import Integrator

__all__ = [
    "NO_CLASS",
    "Boxes",
    "Flow",
    "boxes_on_sites",
    "check_per_picture",
    "flow_on_sites",
    "mask_on_sites",
    "read_flow",
    "read_mask",
    "validate_boxes",
]

#: Label of a site whose area lies mostly outside the picture, and of padding boxes.
NO_CLASS = -1
#: Largest class of a box: classes are passed as float64, which represents all integers up to 2^53.
MAX_CLASS = 2**53
#: Points along each side of a box, whose image may be curved.
POINTS_PER_SIDE = 65
#: Areas that differ by less than this fraction of a site are equal up to rounding; the lower class is then assigned.
AREA_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Boxes:
    """
    Boxes on the sensor.

    Attributes
    ----------
    box_um : (n_box, 4) float64, µm
        x_min, y_min, x_max, y_max of the image of each box, y up. With distortion: bounds of the image of the outline, as far
        as the lens images it; 0 when the lens images none of it.
    covers : (n_box, n_site) bool
        Sites with more than half of their light-collecting area inside the box.
    """

    box_um: Floats
    covers: Bools

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class Flow:
    """
    Optical flow at the photosites.

    Attributes
    ----------
    flow_um : (n_site, 2) float64, µm
        Displacement on the sensor, y up: the mean over the part of the site with known flow; 0 where the flow is unknown.
    is_known : (n_site,) bool
        Whether the flow is known in any part of the site.
    """

    flow_um: Floats
    is_known: Bools

    __repr__ = short_repr


def boxes_on_sites(boxes_px: Floats, integrator: Integrator, lens: Lens | None) -> Boxes:
    """
    Map boxes of a picture to the sensor.

    ``boxes_px`` (n_box, 4) float64, pixels: x_min, y_min, x_max, y_max from the upper left corner, y down; pixel k extends
    from k to k + 1. ``integrator``: first-order integrator of the sites on the image grid of the picture.

    A pixel on the boundary of a box counts with its fraction inside the box, distributed uniformly over the pixel. Boxes
    aligned with pixels are exact.
    """
    grid = integrator.grid
    n_y, n_x = grid.shape
    box_um = np.empty(boxes_px.shape)
    covers = np.empty((boxes_px.shape[0], integrator.n_sites), bool)
    collecting_um2 = _collecting_area_um2(integrator)
    for k, (left, top, right, bottom) in enumerate(boxes_px):
        corners = _to_sensor_um(np.array([[left, bottom], [right, top]]), grid)
        if lens is None:
            box_um[k] = corners.reshape(-1)
        else:
            (x0, y0), (x1, y1) = corners
            x, y = np.linspace(x0, x1, POINTS_PER_SIDE), np.linspace(y0, y1, POINTS_PER_SIDE)
            sides = ((x, y0), (x, y1), (x0, y), (x1, y))
            outline = np.concatenate([np.stack(np.broadcast_arrays(*side), axis=1) for side in sides])
            imaged = lens.distort(outline, outside="mask")
            imaged = imaged[~np.isnan(imaged).any(axis=1)]
            box_um[k] = [*imaged.min(axis=0), *imaged.max(axis=0)] if len(imaged) else 0.0
        columns, rows = (
            np.clip(np.minimum(np.arange(n) + 1, high) - np.maximum(np.arange(n), low), 0.0, 1.0)
            for n, low, high in ((n_x, left, right), (n_y, n_y - bottom, n_y - top))
        )
        inside_um2 = integrator(np.outer(rows, columns))
        covers[k] = (inside_um2 > (0.5 + AREA_TOLERANCE) * collecting_um2) & (collecting_um2 > 0.0)
    return Boxes(box_um, covers)


def mask_on_sites(mask: Ints, integrator: Integrator) -> Ints:
    """
    Return the class with the largest area of each site.

    ``mask`` (n_y, n_x) integers: classes of the pixels of the picture, top row first. ``integrator``: as for
    :func:`boxes_on_sites`. Returns ``classes`` (n_site,) int64: :data:`NO_CLASS` where the area outside the picture is at
    least that of every class. Among classes with equal area, the lowest.

    Areas are those of the undistorted outlines, from which sites collect light.
    """
    rows = from_file_rows(mask)[0]
    found = np.full(integrator.n_sites, NO_CLASS, np.int64)
    rounding_um2 = AREA_TOLERANCE * _collecting_area_um2(integrator)
    max_um2 = integrator.uncovered_um2
    for number in np.unique(rows):
        class_um2 = integrator((rows == number).astype(np.float32))
        is_larger = class_um2 > max_um2 + rounding_um2
        found[is_larger] = number
        max_um2 = np.where(is_larger, class_um2, max_um2)
    return found


def flow_on_sites(flow_px: Floats, integrator: Integrator, lens: Lens | None) -> Flow:
    """
    Map the optical flow of a picture to the photosites.

    ``flow_px`` (n_y, n_x, 2) float, pixels: displacement of each pixel, x to the right and y down; NaN where it is unknown.
    ``integrator``, ``lens``: as for :func:`boxes_on_sites`.
    """
    grid = integrator.grid
    displacement = np.moveaxis(from_file_rows(np.asarray(flow_px, np.float64)), 0, -1) * [
        grid.pitch_x_um,
        -grid.pitch_y_um,
    ]
    is_known = np.isfinite(displacement).all(axis=-1)
    displacement = np.where(is_known[..., np.newaxis], displacement, 0.0)
    if lens is not None:
        centres = np.stack(np.meshgrid(grid.x_um, grid.y_um), axis=-1)
        displacement = lens.distort(centres + displacement, outside="mask") - lens.distort(centres, outside="mask")
        is_known &= np.isfinite(displacement).all(axis=-1)
        displacement = np.where(is_known[..., np.newaxis], displacement, 0.0)
    known_um2 = integrator(is_known.astype(np.float64))
    is_site_known = known_um2 > AREA_TOLERANCE * np.maximum(_collecting_area_um2(integrator), np.finfo(float).tiny)
    sums = integrator(np.moveaxis(displacement, -1, 0))
    flow_um = np.where(is_site_known, sums / np.where(is_site_known, known_um2, 1.0), 0.0)
    return Flow(np.ascontiguousarray(np.moveaxis(flow_um, 0, -1)), is_site_known)


def _collecting_area_um2(integrator: Integrator) -> Floats:
    """Return the light-collecting area of each site; 0 outside the image circle."""
    covered_um2 = integrator(np.ones(integrator.grid.shape))
    is_outside = integrator.sites_outside_image_circle
    uncovered_um2 = np.array(integrator.uncovered_um2)
    uncovered_um2[is_outside] = 0.0
    return covered_um2 + uncovered_um2


def _to_sensor_um(points_px: Floats, grid: Grid) -> Floats:
    """Convert points (n, 2) from picture coordinates (upper left corner, y down) to sensor µm."""
    x0, _, _, y1 = grid.bounds_um
    return np.array([x0, y1]) + points_px * [grid.pitch_x_um, -grid.pitch_y_um]


def validate_boxes(name: str, boxes: Any) -> tuple[Floats, Ints]:
    """
    Return the boxes and classes of one picture after validation.

    Classes are :data:`NO_CLASS` when ``boxes`` has no column of classes.

    Raises ParameterError when ``boxes`` is not an (n, 4) or (n, 5) array of numbers, or a box has no area.
    """
    if np.size(boxes) == 0:
        return np.zeros((0, 4)), np.zeros(0, np.int64)
    numbers = finite_array(name, boxes, ndim=2)
    if numbers.shape[1] not in (4, 5):
        raise ParameterError(
            name,
            f"must have the shape (n, 4) or, with classes, (n, 5), got {numbers.shape}",
            hint="x0, y0, x1, y1, class",
        )
    is_empty = (numbers[:, 2:4] <= numbers[:, :2]).any(axis=1)
    if is_empty.any():
        raise ParameterError(name, "must have x0 < x1 and y0 < y1", numbers[is_empty][0, :4].tolist(), "pixels")
    classes = numbers[:, 4] if numbers.shape[1] == 5 else np.full(len(numbers), float(NO_CLASS))
    if (classes != np.rint(classes)).any() or (np.abs(classes) > MAX_CLASS).any():
        raise ParameterError(name, f"must have integers up to {MAX_CLASS} as classes", classes.tolist())
    return numbers[:, :4], classes.astype(np.int64)


def read_mask(mask: Any, name: str, shape: tuple[int, int]) -> Ints:
    """
    Read a mask from a file or an array, top row first.

    ``mask`` (path or (n_y, n_x) array of integers): files with a palette give the indices of its entries. ``name``: name of
    the mask, for messages. ``shape`` (n_y, n_x): shape of the picture. Raises FileError, ParameterError when the mask cannot
    be read, or its shape differs.
    """
    if isinstance(mask, str | Path):
        name = str(mask)
        classes = _palette_numbers(Path(mask))
        classes = read_picture(mask) if classes is None else classes
    else:
        try:
            classes = np.asarray(mask)
        except ValueError:
            raise ParameterError(name, "must be an array of integers", mask) from None
    if classes.dtype == np.bool_:
        classes = classes.astype(np.uint8)
    if classes.shape == shape and classes.dtype == np.uint64 and classes.max() > np.iinfo(np.int64).max:
        raise ParameterError(name, "must be signed 64-bit integers", int(classes.max()))
    if classes.shape != shape or classes.dtype.kind not in "iu":
        raise ParameterError(
            name, f"must be integers of the picture's shape {shape}, got {classes.dtype} of shape {classes.shape}"
        )
    return classes


def _palette_numbers(path: Path) -> NDArray[Any] | None:
    """Return the palette indices of a picture file, or None if it has no palette."""
    from PIL import Image

    try:
        with Image.open(path, formats=("PNG", "GIF", "BMP")) as image:
            return np.asarray(image) if image.mode == "P" else None
    except Exception:  # noqa: BLE001 -- read_picture reports the problem
        return None


def read_flow(flow: Any, name: str, shape: tuple[int, int]) -> Floats:
    """Read an optical flow from a ``.npy`` file or an array, top row first."""
    if isinstance(flow, str | Path):
        name = str(flow)
        flow = load_array(flow)
    displacement = np.asarray(flow)
    if displacement.shape != (*shape, 2) or displacement.dtype.kind not in "iuf":
        raise ParameterError(
            name, f"must be numbers of shape {(*shape, 2)}, got {displacement.dtype} of shape {displacement.shape}"
        )
    return displacement


def check_per_picture(name: str, given: Any, n: int) -> Sequence[Any]:
    """Return a sequence after checking that it has one item per picture."""
    if isinstance(given, str | bytes) or not (hasattr(given, "__len__") and hasattr(given, "__getitem__")):
        raise ParameterError(name, f"must be a sequence with one item per picture, got {type_name(given)}")
    if len(given) != n:
        raise ParameterError(name, f"must have one item for each of the {n} pictures, got {len(given)}")
    sequence: Sequence[Any] = given
    return sequence

"""Labels of a picture's pixels as labels of a sensor's sites: boxes, masks and optical flow, through the lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Bools, Floats, Ints, finite_array
from foveasim._io.images import read_picture
from foveasim.distortion import Lens
from foveasim.errors import FileError, ParameterError
from foveasim.fields import Grid, from_file_rows
from foveasim.integrate import Integrator

__all__ = [
    "NOTHING",
    "Boxes",
    "Flow",
    "boxes_on_sites",
    "checked_boxes",
    "flow_on_sites",
    "mask_on_sites",
    "one_a_picture",
    "read_flow",
    "read_mask",
]

#: Label of a site that sees mostly what lies off the picture, and of boxes that only fill up a sample.
NOTHING = -1
#: Largest class of a box: beyond it not every integer is a float, as which boxes are given.
MOST_CLASS = 2**53
#: Points along each side of a box, whose image may be bent.
POINTS_A_SIDE = 65
#: Areas that differ by less than this fraction of a site are the same up to rounding: the lower class has it.
TIE = 1e-9


@dataclass(frozen=True, eq=False)
class Boxes:
    """
    Boxes on the sensor.

    Attributes
    ----------
    box_um : (n_box, 4) float64, µm
        x_min, y_min, x_max, y_max of each box's image, y up; where the lens bends it, around the image of its outline, as much
        of it as the lens images; 0 where it images none.
    covers : (n_box, n_site) bool
        Sites of whose light-collecting area more than half is in the box.
    """

    box_um: Floats
    covers: Bools


@dataclass(frozen=True, eq=False)
class Flow:
    """
    Optical flow on the sites.

    Attributes
    ----------
    flow_um : (n_site, 2) float64, µm
        How far what a site sees moves on the sensor, y up: the mean over what is known of it; 0 where nothing is.
    is_known : (n_site,) bool
    """

    flow_um: Floats
    is_known: Bools


def boxes_on_sites(boxes_px: Floats, integrator: Integrator, lens: Lens | None) -> Boxes:
    """
    Boxes in a picture on the sensor.

    Parameters
    ----------
    boxes_px : (n_box, 4) float64, pixels
        x_min, y_min, x_max, y_max as image files count: from the upper left corner, y down, pixel k from k to k + 1.
    integrator : Integrator
        Of first order, of the sites on the grid that the picture's pixels are imaged on.
    lens : lens of foveasim.distortion, optional

    Notes
    -----
    A box that cuts a pixel has its fraction of the pixel, spread evenly over it; boxes along pixels are exact.
    """
    grid = integrator.grid
    n_y, n_x = grid.shape
    box_um = np.empty(boxes_px.shape)
    covers = np.empty((boxes_px.shape[0], integrator.n_sites), bool)
    seen_um2 = _seen_um2(integrator)
    for k, (left, top, right, bottom) in enumerate(boxes_px):
        corners = _on_sensor(np.array([[left, bottom], [right, top]]), grid)
        if lens is None:
            box_um[k] = corners.reshape(-1)
        else:
            (x0, y0), (x1, y1) = corners
            x, y = np.linspace(x0, x1, POINTS_A_SIDE), np.linspace(y0, y1, POINTS_A_SIDE)
            sides = ((x, y0), (x, y1), (x0, y), (x1, y))
            outline = np.concatenate([np.stack(np.broadcast_arrays(*side), axis=1) for side in sides])
            real = lens.distort(outline, outside="mask")
            real = real[~np.isnan(real).any(axis=1)]
            box_um[k] = [*real.min(axis=0), *real.max(axis=0)] if len(real) else 0.0
        columns, rows = (
            np.clip(np.minimum(np.arange(n) + 1, high) - np.maximum(np.arange(n), low), 0.0, 1.0)
            for n, low, high in ((n_x, left, right), (n_y, n_y - bottom, n_y - top))
        )
        inside_um2 = integrator(np.outer(rows, columns))
        covers[k] = (inside_um2 > (0.5 + TIE) * seen_um2) & (seen_um2 > 0.0)
    return Boxes(box_um, covers)


def mask_on_sites(mask: Ints, integrator: Integrator) -> Ints:
    """
    The class that has most of each site's area, (n_site,) int64.

    Parameters
    ----------
    mask : (n_y, n_x) integers
        Classes of the picture's pixels, first row on top.
    integrator : Integrator
        As for :func:`boxes_on_sites`.

    Returns
    -------
    classes : (n_site,) int64
        :data:`NOTHING` where no class has more than what lies off the picture. Of classes with the same area the lowest.

    Notes
    -----
    Areas are those from which a site collects light: of its outline carried back through the lens.
    """
    rows = from_file_rows(mask)[0]
    found = np.full(integrator.n_sites, NOTHING, np.int64)
    rounding_um2 = TIE * _seen_um2(integrator)
    most_um2 = integrator.uncovered_um2
    for number in np.unique(rows):
        own_um2 = integrator((rows == number).astype(np.float32))
        is_more = own_um2 > most_um2 + rounding_um2
        found[is_more] = number
        most_um2 = np.where(is_more, own_um2, most_um2)
    return found


def flow_on_sites(flow_px: Floats, integrator: Integrator, lens: Lens | None) -> Flow:
    """
    Optical flow of a picture on the sensor.

    Parameters
    ----------
    flow_px : (n_y, n_x, 2) float, pixels
        How far each pixel moves, x to the right and y down as image files have it; NaN where it is not known.
    integrator, lens
        As for :func:`boxes_on_sites`.
    """
    grid = integrator.grid
    moves = np.moveaxis(from_file_rows(np.asarray(flow_px, np.float64)), 0, -1) * [grid.pitch_x_um, -grid.pitch_y_um]
    is_known = np.isfinite(moves).all(axis=-1)
    moves = np.where(is_known[..., np.newaxis], moves, 0.0)
    if lens is not None:
        middles = np.stack(np.meshgrid(grid.x_um, grid.y_um), axis=-1)
        moves = lens.distort(middles + moves, outside="mask") - lens.distort(middles, outside="mask")
        is_known &= np.isfinite(moves).all(axis=-1)
        moves = np.where(is_known[..., np.newaxis], moves, 0.0)
    known_um2 = integrator(is_known.astype(np.float64))
    is_told = known_um2 > TIE * np.maximum(_seen_um2(integrator), np.finfo(float).tiny)
    sums = integrator(np.moveaxis(moves, -1, 0))
    flow_um = np.where(is_told, sums / np.where(is_told, known_um2, 1.0), 0.0)
    return Flow(np.ascontiguousarray(np.moveaxis(flow_um, 0, -1)), is_told)


def _seen_um2(integrator: Integrator) -> Floats:
    """Area from which each site collects light, off the picture too; 0 outside the lens's image circle."""
    on_um2 = integrator(np.ones(integrator.grid.shape))
    lost = integrator.sites_outside_image_circle
    off_um2 = np.array(integrator.uncovered_um2)
    off_um2[lost] = 0.0
    return on_um2 + off_um2


def _on_sensor(points_px: Floats, grid: Grid) -> Floats:
    """Points (n, 2) of a picture, from its upper left corner and y down, in the sensor's plane."""
    x0, _, _, y1 = grid.bounds_um
    return np.array([x0, y1]) + points_px * [grid.pitch_x_um, -grid.pitch_y_um]


def checked_boxes(name: str, boxes: Any) -> tuple[Floats, Ints]:
    """
    Boxes of one picture, and their classes; :data:`NOTHING` where none are given.

    Raises
    ------
    ParameterError
        When they are not (n, 4) or (n, 5) numbers, or a box has no area.
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
    is_flat = (numbers[:, 2:4] <= numbers[:, :2]).any(axis=1)
    if is_flat.any():
        raise ParameterError(name, "must have x0 < x1 and y0 < y1", numbers[is_flat][0, :4].tolist(), "pixels")
    classes = numbers[:, 4] if numbers.shape[1] == 5 else np.full(len(numbers), float(NOTHING))
    if (classes != np.rint(classes)).any() or (np.abs(classes) > MOST_CLASS).any():
        raise ParameterError(name, f"must have integers up to {MOST_CLASS} as classes", classes.tolist())
    return numbers[:, :4], classes.astype(np.int64)


def read_mask(mask: Any, name: str, shape: tuple[int, int]) -> Ints:
    """
    A mask, of a file or an array, first row on top.

    Parameters
    ----------
    mask : path or (n_y, n_x) array of integers
        Of a file with a palette, its entries' numbers.
    name : str
        For messages.
    shape : (n_y, n_x)
        Of the picture.

    Raises
    ------
    FileError, ParameterError
        When it cannot be read, or is of another size.
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
        raise ParameterError(name, "must be integers of 64 bits with a sign", int(classes.max()))
    if classes.shape != shape or classes.dtype.kind not in "iu":
        raise ParameterError(
            name, f"must be integers of the picture's shape {shape}, got {classes.dtype} of {classes.shape}"
        )
    return classes


def _palette_numbers(path: Path) -> NDArray[Any] | None:
    """Numbers of a picture with a palette; None of any other, which the usual reader takes or rejects."""
    from PIL import Image

    try:
        with Image.open(path, formats=("PNG", "GIF", "BMP")) as image:
            return np.asarray(image) if image.mode == "P" else None
    except Exception:  # noqa: BLE001 -- the usual reader tells what is wrong
        return None


def read_flow(flow: Any, name: str, shape: tuple[int, int]) -> Floats:
    """
    Optical flow, of a ``.npy`` file or an array, first row on top.

    Raises
    ------
    FileError, ParameterError
        When it cannot be read, or is of another size.
    """
    if isinstance(flow, str | Path):
        name = str(flow)
        try:
            flow = np.load(flow, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise FileError(name, f"is no array that can be read ({error})") from None
    moves = np.asarray(flow)
    if moves.shape != (*shape, 2) or moves.dtype.kind not in "iuf":
        raise ParameterError(name, f"must be numbers of the shape {(*shape, 2)}, got {moves.dtype} of {moves.shape}")
    return moves


def one_a_picture(name: str, given: Any, n: int) -> Sequence[Any]:
    """
    A sequence that has something for every picture.

    Raises
    ------
    ParameterError
        When it is none, or of another length.
    """
    if isinstance(given, str | bytes) or not (hasattr(given, "__len__") and hasattr(given, "__getitem__")):
        raise ParameterError(name, f"must be a sequence with one for each picture, got a {type(given).__name__}")
    if len(given) != n:
        raise ParameterError(name, f"must have one for each of the {n} pictures, got {len(given)}")
    sequence: Sequence[Any] = given
    return sequence

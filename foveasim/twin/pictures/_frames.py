"""
Frames of a real camera as codes of the photosites, and the patches of a target in them.

Pixels are counted as in the given arrays: x is the column and y the row from 0, and pixel (x, y) is the square from x to x + 1
and from y to y + 1. Inside this module, row 0 is the top of the upright picture.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats, Ints, as_any_array, as_numbers, finite_array
from foveasim.camera import Camera
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.layout.rows import site_rows
from foveasim.twin.frame_files import FirstRow, stored_frames
from foveasim.twin.pictures._target_scenes import undistorted

__all__ = ["Raster", "check_unsaturated"]

#: Largest fraction of the highest code in a patch: hot pixels of real sensors are fewer.
MAX_SATURATED_FRACTION = 1e-3
#: Part of the side of a patch between corners that is measured, around its centre.
MEASURED_FRACTION = 0.6
#: Bits of files with two bytes per pixel.
FILE_BITS = 16


class Raster(NamedTuple):
    """Sites of a regular sensor, (n_y, n_x) top row first, and the bits of its codes."""

    sites: Ints
    bits: int

    @classmethod
    def of(cls, layout: Layout, bits: int) -> Raster:
        """Return the raster of a layout; raise a ParameterError if it is not regular."""
        row, column = (site_rows(layout, axis) for axis in (1, 0))
        if row is not None and column is not None and layout.n_sites:
            sites = np.full((int(row.max()) + 1, int(column.max()) + 1), -1, np.int64)
            if sites.size == layout.n_sites:
                sites[row.max() - row, column] = np.arange(layout.n_sites)
                if sites.min() == 0:
                    return cls(sites, bits)
        raise ParameterError("camera", "must have photosites in complete rows and columns, as the pixels of a picture")

    def codes(self, name: str, frames: Any, first_row: FirstRow | None) -> tuple[NDArray[Any], FirstRow]:
        """Return codes of real frames, (n_frame, n_site), and the first row of the arrays."""
        parts, orders = zip(*(_pictures(name, part, first_row) for part in _listed(frames)), strict=True)
        if len(set(orders)) > 1:
            raise ParameterError("first_row", "must be given for files with different first rows")
        shapes = {part.shape[1:] for part in parts}
        if len(shapes) != 1 or shapes != {self.sites.shape}:
            shape = next(shape for shape in shapes if len(shapes) == 1 or shape != self.sites.shape)
            hint = "rotate them upright with numpy.rot90" if shape == self.sites.shape[::-1] else ""
            rule = f"must have the {self.sites.shape} rows and columns of the sensor, got {shape}"
            raise ParameterError(name, rule, hint=hint)
        pictures = np.concatenate(parts)
        self._check_codes(name, pictures)
        codes = np.empty((pictures.shape[0], self.sites.size), np.uint16)
        codes[:, self.sites.ravel()] = pictures.reshape(pictures.shape[0], -1)
        return codes, orders[0]

    def _check_codes(self, name: str, pictures: NDArray[Any]) -> None:
        lowest, highest, top = pictures.min(), pictures.max(), 2**self.bits - 1
        if pictures.dtype.kind == "f" and not np.all(pictures == np.rint(pictures)):
            raise ParameterError(
                name, "must be whole numbers, the codes of single frames", hint="do not average or scale frames"
            )
        if pictures.dtype == np.uint8 and self.bits > np.iinfo(np.uint8).bits:
            raise ParameterError(
                name, f"must be codes of {self.bits} bits, got pictures of 8 bits", hint="save raw frames of 16 bits"
            )
        if not (lowest >= 0 and highest <= top):
            shift = FILE_BITS - self.bits
            is_shifted = lowest >= 0 and shift > 0 and not np.any(pictures % 2**shift)
            hint = f"the codes are in the upper bits: divide them by {2**shift}" if is_shifted else ""
            raise ParameterError(
                name,
                f"must be codes from 0 to {top} of a sensor of {self.bits} bits",
                int(highest if lowest >= 0 else lowest),
                "DN",
                hint,
            )

    def regions(self, regions: Sequence[Sequence[float]], first_row: FirstRow) -> Ints:
        """Return the number of the region of each site, (n_site,), -1 outside."""
        n_y, n_x = self.sites.shape
        labels: Ints = np.full((n_y, n_x), -1, np.int64)
        given = finite_array("regions", regions)
        if given.ndim != 2 or given.shape[1] != 4 or not given.size:
            raise ParameterError("regions", "must be a list of rectangles (x0, y0, x1, y1)", given.shape)
        for k, (x0, y0, x1, y1) in enumerate(np.rint(given).astype(np.int64).tolist()):
            if not (0 <= x0 < x1 <= n_x and 0 <= y0 < y1 <= n_y):
                rule = f"must be within {n_x} columns and {n_y} rows, with x0 < x1 and y0 < y1"
                raise ParameterError(f"regions[{k}]", rule, given[k].tolist(), "pixels")
            rows = slice(y0, y1) if first_row == "top" else slice(n_y - y1, n_y - y0)
            if np.any(labels[rows, x0:x1] >= 0):
                raise ParameterError("regions", f"must not overlap, as region {k} does with an earlier one")
            labels[rows, x0:x1] = k
        found: Ints = np.empty(labels.size, np.int64)
        found[self.sites.ravel()] = labels.ravel()
        return found

    def chart(
        self,
        camera: Camera,
        corners: Sequence[Sequence[float]],
        shape: tuple[int, int],
        gap_fraction: float,
        first_row: FirstRow,
    ) -> tuple[Ints, Ints]:
        """
        Return the number of the patch of each site, (n_site,) twice.

        Patches of ``shape`` (n_row, n_column) with gaps, relative to their sides, fill the quadrangle of the corners in
        perspective, without the distortion of the camera. First the inner part of each patch, which is measured, and -1
        elsewhere; then the complete patch, and the number of patches in black gaps and beyond the corners, or -1 without gaps.
        """
        n_y, n_x = self.sites.shape
        x0_um, y0_um, x1_um, y1_um = camera.layout.bounds_um
        from_top = _check_corners(corners, (n_x, n_y), first_row) / (n_x, n_y)
        at_um = np.array([x0_um, y1_um]) + from_top * (x1_um - x0_um, y0_um - y1_um)
        xy, sites_um = undistorted(camera, at_um), undistorted(camera, camera.layout.centroid_um)
        step = 1.0 + gap_fraction
        width, height = shape[1] * step - gap_fraction, shape[0] * step - gap_fraction
        target = np.array([(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)])
        # The homography h of eight unknowns: u (h6 x + h7 y + 1) = h0 x + h1 y + h2, and the same for v with h3 to h5.
        points, zeros = np.column_stack((xy, np.ones(4))), np.zeros((4, 3))
        left = np.block([[points, zeros], [zeros, points]])
        equations = np.column_stack((left, -target.T.reshape(8, 1) * np.tile(xy, (2, 1))))
        h = np.append(np.linalg.solve(equations, target.T.ravel()), 1.0).reshape(3, 3)
        mapped = h @ np.column_stack((sites_um, np.ones(len(sites_um)))).T
        is_visible = mapped[2] * (h[2, :2] @ xy[0] + 1.0) > 0.0  # not behind the horizon
        u, v = mapped[:2] / np.where(is_visible, mapped[2], np.nan)
        is_in = (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height)
        (column, x), (row, y) = (np.divmod(np.where(is_in, values, 0.0), step) for values in (u, v))
        patch = (row * shape[1] + column).astype(np.int64)
        is_patch = is_in & (np.maximum(x, y) <= 1.0)
        is_inner = is_in & (np.maximum(np.abs(x - 0.5), np.abs(y - 0.5)) < 0.5 * MEASURED_FRACTION)
        outside = math.prod(shape) if gap_fraction else -1
        return np.where(is_inner, patch, -1), np.where(is_patch, patch, outside)


def _check_corners(corners: Sequence[Sequence[float]], size_px: tuple[int, int], first_row: FirstRow) -> Floats:
    """Return four corners, (4, 2), clockwise in the upright picture with y downwards."""
    xy = finite_array("corners", corners).copy()
    if xy.shape != (4, 2):
        raise ParameterError("corners", "must be four points (x, y)", xy.shape)
    if np.any(xy < 0.0) or np.any(xy > size_px):
        rule = f"must be within the picture of {size_px[0]} columns and {size_px[1]} rows"
        raise ParameterError("corners", rule, xy.tolist(), "pixels")
    if first_row == "bottom":
        xy[:, 1] = size_px[1] - xy[:, 1]
    sides = np.roll(xy, -1, axis=0) - xy
    after = np.roll(sides, -1, axis=0)
    turns = sides[:, 0] * after[:, 1] - sides[:, 1] * after[:, 0]
    if np.all(turns < 0.0):
        raise ParameterError(
            "corners",
            "must go round the chart clockwise, from the corner of its first patch along the first row",
            hint="if they do, the picture is mirrored: check 'first_row'",
        )
    if not np.all(turns > 0.0):
        raise ParameterError("corners", "must be those of a convex quadrangle, whose sides do not cross", xy.tolist())
    return xy


def check_unsaturated(codes: NDArray[Any], labels: Ints, bits: int) -> None:
    """Raise a ParameterError when patches contain the highest code."""
    is_used = labels >= 0
    n_sites = np.bincount(labels[is_used])
    share = np.bincount(labels[is_used], (codes[:, is_used] == 2**bits - 1).mean(axis=0)) / np.maximum(n_sites, 1)
    if share.max() > MAX_SATURATED_FRACTION:
        worst = int(share.argmax())
        raise ParameterError(
            "frames",
            f"must not be saturated in the target: {100.0 * share[worst]:.2g} % of the codes of patch {worst} are "
            f"{2**bits - 1}",
            hint="expose for a shorter time, or leave the patch out",
        )


def _listed(frames: Any) -> list[Any]:
    """Return files or arrays as a list."""
    is_list = isinstance(frames, list | tuple) and len(frames) > 0
    is_nested = is_list and (isinstance(frames[0], str | os.PathLike) or np.ndim(frames[0]) >= 2)
    return list(frames) if is_nested else [frames]


def _pictures(name: str, frames: Any, first_row: FirstRow | None) -> tuple[NDArray[Any], FirstRow]:
    """Return numbers (n_frame, n_y, n_x), top row first, and the first row given."""
    usual: FirstRow = "top"
    if isinstance(frames, str | os.PathLike):
        stored, usual = stored_frames(Path(frames))
        frames = list(stored)
        if len(shapes := {frame.shape for frame in frames}) > 1:
            raise ParameterError(name, "must have the same size", sorted(shapes))
    pictures = as_numbers(name, as_any_array(name, frames), keep_type=True)
    if pictures.ndim not in (2, 3) or 0 in pictures.shape or pictures.dtype.kind not in "uif":
        raise ParameterError(name, "must be codes of the shape (n_frame, n_y, n_x) or (n_y, n_x)", pictures.shape)
    pictures = pictures.reshape(-1, *pictures.shape[-2:])
    order = first_row or usual
    return (pictures if order == "top" else pictures[:, ::-1]), order

"""Panoramas: radiance by direction, and its means over the cells of an image."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import POSITIVE, Limits, OwnCheck, check_declared
from foveasim._core.threads import parallel_map
from foveasim._core.validation import Floats, Images, read_only
from foveasim._projections import LAWS, ImageProjection, check_direction, turned
from foveasim.errors import ParameterError

#: Arrangement of the directions of a picture.
Mapping = Literal["equirectangular", "cubemap", "fisheye"]
#: Points of a cell along each axis; each receives the mean over the solid angle around it.
N_POINTS = 2
#: Cells along the longer side of an image: per pixel of the panorama on the axis, and limits.
CELLS_PER_PIXEL, MIN_CELLS, MAX_CELLS = 2, 64, 2048
#: Points that are processed at once, in the cache of a core.
POINTS_PER_BLOCK = 2**15
#: Sums of pixels that are in memory together, 512 MiB.
MAX_SUMS = 2**26
#: Cosine of the elevation, at the poles of an equirectangular picture.
MIN_COSINE = 1e-9
#: Angles of the orientation.
TURN = Limits(at_least=-360.0, at_most=360.0, hint="angles are in degrees")
#: Cells of an image, if given.
CELLS = Limits(at_least=16, at_most=8192)
#: Columns and rows of faces in a horizontal cross.
CROSS = (4, 3)


class Boxes(NamedTuple):
    """
    Rectangles of a picture around points, in pixels from its lower left corner.

    Empty at points outside the picture.
    """

    u0: Floats
    u1: Floats
    v0: Floats
    v1: Floats


@dataclass(frozen=True, kw_only=True)
class Panorama:
    """
    Directions of the pixels of a picture, and the orientation of the camera in it.

    Parameters
    ----------
    mapping : {"equirectangular", "cubemap", "fisheye"}
        As for :meth:`foveasim.Scene.from_panorama`, like the other parameters.
    yaw_deg, pitch_deg, roll_deg : float, degrees
        Orientation of the camera: to the right, upwards, and clockwise about its axis.
    cells : "auto" or int
        Number of cells along the longer side of the image.
    lens : lens model of foveasim.distortion, optional
        Calibration of a fisheye photograph.
    pixel_um : float, optional, µm
        Its pixel size.
    gaze_deg : (azimuth, elevation), optional, degrees
        Direction towards which the camera turns from this orientation, instead of its gaze.
    """

    mapping: Mapping = "equirectangular"
    yaw_deg: Annotated[float, TURN] = 0.0
    pitch_deg: Annotated[float, TURN] = 0.0
    roll_deg: Annotated[float, TURN] = 0.0
    cells: Annotated[int | Literal["auto"], CELLS] = "auto"
    lens: OwnCheck[Any] = None
    pixel_um: Annotated[float | None, POSITIVE] = None
    gaze_deg: OwnCheck[tuple[float, float] | None] = None

    def __post_init__(self) -> None:
        check_declared(self)
        if self.gaze_deg is not None:
            object.__setattr__(self, "gaze_deg", check_direction("gaze_deg", self.gaze_deg))
        is_fisheye = self.mapping == "fisheye"
        if is_fisheye and not hasattr(self.lens, "project"):
            raise ParameterError(
                "lens", "must be a lens model of foveasim.distortion for a fisheye photograph", self.lens
            )
        if is_fisheye and self.pixel_um is None:
            raise ParameterError(
                "pixel_um", "must be given for a fisheye photograph: its pixel size in the calibration"
            )
        if not is_fisheye and (self.lens is not None or self.pixel_um is not None):
            name = "pixel_um" if self.lens is None else "lens"
            raise ParameterError(name, "requires mapping='fisheye'", getattr(self, name))

    def check_shape(self, shape: tuple[int, ...]) -> None:
        """Raise ParameterError if pictures (n_y, n_x) do not fit the mapping."""
        n_y, n_x = shape
        if self.mapping == "equirectangular" and n_x != 2 * n_y:
            raise ParameterError(
                "picture",
                f"must be twice as wide as high, 360° x 180°, for 'equirectangular', got {n_x} x {n_y} pixels",
            )
        if self.mapping == "cubemap" and (n_x * CROSS[1] != n_y * CROSS[0] or n_y % CROSS[1]):
            raise ParameterError(
                "picture", f"must be a horizontal cross of 4 x 3 square faces for 'cubemap', got {n_x} x {n_y} pixels"
            )

    def towards(self, direction: Floats) -> Panorama:
        """Return the panorama for a camera that turns towards a direction (3,) in its frame."""
        x, y, z = direction.tolist()
        return replace(self, gaze_deg=(math.degrees(math.atan2(x, z)), math.degrees(math.asin(max(-1.0, min(y, 1.0))))))

    @property
    def rotation(self) -> Floats:
        """Rotation (3, 3) from directions of the camera to those of the panorama."""
        yaw, pitch, roll, azimuth, elevation = (
            math.radians(each) for each in (self.yaw_deg, self.pitch_deg, self.roll_deg, *(self.gaze_deg or (0.0, 0.0)))
        )
        c, s = math.cos(roll), math.sin(roll)
        rolled = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return turned(yaw, pitch) @ rolled @ turned(azimuth, elevation)

    def n_cells(self, shape: tuple[int, ...], extent: float) -> int:
        """Return the cells along the longer side of an image, of ``extent`` focal lengths."""
        if self.cells != "auto":
            return self.cells
        n_y, n_x = shape
        if self.mapping == "equirectangular":
            pixel = 2.0 * math.pi / n_x
        elif self.mapping == "cubemap":
            pixel = 2.0 * CROSS[1] / n_y
        else:
            pixel = float(self.pixel_um or 1.0) / float(np.min(self.lens.focal_um))
        return max(MIN_CELLS, min(math.ceil(CELLS_PER_PIXEL * extent / pixel), MAX_CELLS))

    def cell_means(
        self, basis: Images, projection: ImageProjection, shape: tuple[int, int], pitch: float, n_threads: int
    ) -> Images:
        """
        Return the mean radiance over the solid angle of each cell of an image.

        The result is (n_basis, n_y, n_x) float32. ``shape``, ``pitch``: numbers of cells, and their size in focal lengths; the
        image is centred on the axis. Each cell is the mean of 2 x 2 boxes, which contain fractions of pixels: there is no
        aliasing, whatever the size of the pixels. Cells beyond the largest angle of the projection are 0.
        """
        cells = np.zeros((basis.shape[0], *shape), np.float32)
        n_together = max(1, MAX_SUMS // (basis.shape[1] * basis.shape[2]))
        for first in range(0, basis.shape[0], n_together):
            part = slice(first, first + n_together)
            self._fill(basis[part], projection, pitch, n_threads, cells[part])
        return read_only(cells)

    def _fill(
        self, basis: Images, projection: ImageProjection, pitch: float, n_threads: int, cells: NDArray[np.float32]
    ) -> None:
        from foveasim.scene import _kernels

        law, rotation = LAWS[projection], self.rotation
        weights = self._row_weights(basis.shape[1])
        table = np.zeros((basis.shape[0], basis.shape[1] + 1, basis.shape[2] + 1))
        for image, sums in zip(basis, table, strict=True):
            np.cumsum(np.cumsum(image * weights[:, np.newaxis], axis=0, dtype=np.float64), axis=1, out=sums[1:, 1:])
        of_rows = np.concatenate(([0.0], np.cumsum(weights)))
        _, n_y, n_x = cells.shape
        n_rows = max(1, POINTS_PER_BLOCK // (N_POINTS * N_POINTS * n_x))
        step = pitch / N_POINTS
        x = (np.arange(N_POINTS * n_x) - 0.5 * (N_POINTS * n_x - 1)) * step
        is_periodic = self.mapping == "equirectangular"

        def fill(first: int) -> None:
            last = min(first + n_rows, n_y)
            y = (np.arange(N_POINTS * first, N_POINTS * last) - 0.5 * (N_POINTS * n_y - 1)) * step
            xy = np.stack(np.meshgrid(x, y), axis=-1)
            flat = xy.reshape(-1, 2)
            theta_rad = law.angles_rad(np.hypot(flat[:, 0], flat[:, 1]))
            solid_sr = np.nan_to_num(law.solid_angle_sr(theta_rad)) * step * step
            directions = np.nan_to_num(law.directions(flat)) @ rotation.T
            directions[np.isnan(theta_rad), 2] = 1.0  # of weight 0
            boxes = self._boxes(directions, solid_sr, xy.shape[:2], (basis.shape[1], basis.shape[2]))
            _kernels.box_means(
                table,
                of_rows,
                *(np.ascontiguousarray(box) for box in boxes),
                solid_sr,
                N_POINTS,
                is_periodic,
                cells[:, first:last],
            )

        parallel_map(fill, range(0, n_y, n_rows), n_threads)

    def pixels_at(self, directions: Floats, shape: tuple[int, int]) -> tuple[Floats, Floats]:
        """Return rows and columns of directions (n, 3), from the lower left pixel."""
        n_points = directions.shape[0]
        u0, u1, v0, v1 = self._boxes(directions, np.full(n_points, 1e-9), (n_points, 1), shape)
        return 0.5 * (v0 + v1) - 0.5, 0.5 * (u0 + u1) - 0.5

    def _row_weights(self, n_y: int) -> Floats:
        """Return the relative solid angle of the pixels of each row."""
        if self.mapping != "equirectangular":
            return np.ones(n_y)
        sines = np.sin(math.pi * (np.arange(n_y + 1) / n_y - 0.5))
        return np.diff(sines) / (math.pi / n_y)

    def _boxes(self, directions: Floats, solid_sr: Floats, points: tuple[int, ...], shape: tuple[int, int]) -> Boxes:
        """Return the boxes of pixels around directions (n, 3), each with a solid angle (n,)."""
        if self.mapping == "fisheye":
            return self._fisheye_boxes(directions, points, shape)
        return (_equirectangular_boxes if self.mapping == "equirectangular" else _cubemap_boxes)(
            directions, solid_sr, shape
        )

    def _fisheye_boxes(self, directions: Floats, points: tuple[int, ...], shape: tuple[int, int]) -> Boxes:
        n_y, n_x = shape
        at_um = self.lens.project(directions, outside="mask")
        u, v = at_um[:, 0] / self.pixel_um + 0.5 * n_x, at_um[:, 1] / self.pixel_um + 0.5 * n_y
        half_u, half_v = (_half_widths(each.reshape(points)) for each in (u, v))
        is_inside = (u >= 0.0) & (u <= n_x) & (v >= 0.0) & (v <= n_y)  # False for NaN
        u, v = (np.where(is_inside, each, 0.0) for each in (u, v))
        half_u, half_v = (np.where(is_inside, each, 0.0) for each in (half_u, half_v))
        return Boxes(
            *(np.clip(u + side * half_u, 0.0, n_x) for side in (-1, 1)),
            *(np.clip(v + side * half_v, 0.0, n_y) for side in (-1, 1)),
        )


def _half_widths(at: Floats) -> Floats:
    """Return half the distances between neighbouring points of an array, flat."""
    steps = [np.gradient(at, axis=axis) if n > 1 else np.zeros(at.shape) for axis, n in enumerate(at.shape)]
    return np.nan_to_num(0.5 * np.hypot(*steps)).ravel()


def _equirectangular_boxes(directions: Floats, solid_sr: Floats, shape: tuple[int, int]) -> Boxes:
    n_y, n_x = shape
    x, y, z = directions.T
    elevation = np.arcsin(np.clip(y, -1.0, 1.0))
    u, v = (np.arctan2(x, z) / (2.0 * math.pi) + 0.5) * n_x, (elevation / math.pi + 0.5) * n_y
    half_rad = 0.5 * np.sqrt(solid_sr)
    half_v = half_rad * (n_y / math.pi)
    half_u = np.minimum(half_rad / np.maximum(np.cos(elevation), MIN_COSINE), math.pi) * (n_x / (2.0 * math.pi))
    return Boxes(u - half_u, u + half_u, np.maximum(v - half_v, 0.0), np.minimum(v + half_v, n_y))


def _cubemap_boxes(directions: Floats, solid_sr: Floats, shape: tuple[int, int]) -> Boxes:
    """Return the boxes of pixels of a horizontal cross of faces, as above."""
    side = shape[0] / CROSS[1]
    x, y, z = directions.T
    depth = np.abs(directions).max(axis=1)
    is_top, is_bottom = y >= depth, -y >= depth
    is_front, is_back, is_right = z >= depth, -z >= depth, x >= depth
    upright = [is_top, is_bottom, is_front, is_back, is_right]
    right = np.select(upright, [x, x, x, -x, -z], z)
    up = np.select(upright, [-z, z, y, y, y], y)
    column = np.select(upright, [1.0, 1.0, 1.0, 3.0, 2.0], 0.0)
    row = np.where(is_top, 2.0, np.where(is_bottom, 0.0, 1.0))
    half = np.minimum(0.25 * side * np.sqrt(solid_sr / depth**3), 0.5 * side)
    u, v = (np.clip(0.5 * side * (each / depth + 1.0), half, side - half) for each in (right, up))
    u, v = u + column * side, v + row * side
    return Boxes(u - half, u + half, v - half, v + half)

"""Pictures of wide fields as panorama, or as views in other projections."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np

from foveasim._core.calls import Limits, OwnCheck
from foveasim._core.validation import Floats, check_point, read_only
from foveasim._projections import LAWS, ImageProjection, check_direction, turned
from foveasim.distortion._projected import projected
from foveasim.errors import ParameterError
from foveasim.fields import Grid
from foveasim.reconstruct.picture import PIXELS, Picture

__all__ = ["unwrap"]

#: Projections of pictures: ``"equirectangular"`` has the azimuth along x and the elevation along y.
ViewProjection: TypeAlias = Literal["equirectangular", ImageProjection]
#: Horizontal field of views, degrees: by default, and the largest one.
DEFAULT_DEG: dict[ViewProjection, float] = {
    "equirectangular": 360.0,
    "rectilinear": 90.0,
    "equidistant": 180.0,
    "equisolid": 180.0,
    "stereographic": 180.0,
    "orthographic": 180.0,
}
LARGEST_DEG: dict[ViewProjection, float] = {**dict.fromkeys(LAWS, 360.0), "rectilinear": 170.0, "orthographic": 180.0}
FIELD = Limits(above=0.0, at_most=360.0)
#: Points of a pixel along each axis, and fraction of them that photosites must cover.
N_POINTS, MIN_KNOWN = 2, 0.5


def unwrap(
    picture: Picture,
    lens: OwnCheck[Any],
    *,
    projection: ViewProjection = "equirectangular",
    field_of_view_deg: Annotated[float | None, FIELD] = None,
    towards_deg: OwnCheck[tuple[float, float]] = (0.0, 0.0),
    max_pixels: Annotated[int, PIXELS] = 1024,
    position_um: tuple[float, float] = (0.0, 0.0),
) -> Picture:
    """
    Map a picture of a sensor to another projection, through its lens model.

    Parameters
    ----------
    picture : Picture
        In the frame of the sensor, such as :meth:`foveasim.Capture.picture`, which calls this function with ``projection``.
    lens : lens model of foveasim.distortion
    projection : {"equirectangular", "rectilinear", "equidistant", "equisolid", "stereographic", "orthographic"}
        ``"equirectangular"``: azimuth along x and elevation along y, as in panoramas. Others as for
        :class:`foveasim.Optics`.
    field_of_view_deg : float, optional, degrees
        Horizontal field; by default 360 for ``"equirectangular"``, which has 180 in height at most, 90 for
        ``"rectilinear"``, and 180 for others, whose pictures are square.
    towards_deg : (azimuth, elevation), degrees
        Direction at the centre of the picture, from the optical axis: to the right, then upwards.
    max_pixels : int
        Pixels along the longer side.
    position_um : (x, y), µm
        Position of the sensor behind the lens, the gaze of a camera with ``axis="image"``.

    Returns
    -------
    Picture
        On a grid at the focal length of the lens model; NaN beyond the photosites and beyond the field of the lens.

    Raises
    ------
    ParameterError
        When the field is too large for the projection.

    Notes
    -----
    Each pixel is the mean of 2 x 2 points, between whose neighbours the picture is interpolated linearly.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> lens = fs.distortion.Fisheye(projection="equidistant", focal_um=100.0)
    >>> picture = fs.reconstruct.cells(
    ...     fs.layout.grid(n_x=32, n_y=32, pitch_um=10.0),
    ...     np.ones(1024),
    ...     fs.Grid.centred((32, 32), 10.0),
    ... )
    >>> view = fs.reconstruct.unwrap(picture, lens, max_pixels=64)
    >>> view.data.shape, round(float(np.isfinite(view.data).mean()), 2)
    ((1, 32, 64), 0.57)
    """
    from scipy.ndimage import map_coordinates

    field_deg = DEFAULT_DEG[projection] if field_of_view_deg is None else field_of_view_deg
    largest_deg = LARGEST_DEG.get(projection, 360.0)
    if field_deg > largest_deg:
        raise ParameterError(
            "field_of_view_deg", f"must be <= {largest_deg:g} for the {projection} projection", field_deg, "degrees"
        )
    azimuth_deg, elevation_deg = check_direction("towards_deg", towards_deg)
    rotation = turned(math.radians(azimuth_deg), math.radians(elevation_deg))
    place_um = np.array(check_point("position_um", position_um))
    focal_um = math.sqrt(np.broadcast_to(np.asarray(lens.focal_um, np.float64), (2,)).prod())
    half_rad = 0.5 * math.radians(field_deg)
    if projection == "equirectangular":
        half_x, half_y = half_rad, min(half_rad, 0.5 * math.pi)
    else:
        half_x = half_y = float(LAWS[projection].height(np.array([half_rad]))[0])
    pitch = 2.0 * half_x / max_pixels
    shape = max(1, round(2.0 * half_y / pitch)), max_pixels
    known = np.asarray(np.isfinite(picture.data).all(axis=0))
    values = np.where(known, picture.data, 0.0)
    weights, sums = np.zeros(shape), np.zeros((picture.data.shape[0], *shape))
    x0_um, y0_um = picture.grid.origin_um
    offsets = ((np.arange(N_POINTS) + 0.5) / N_POINTS - 0.5).tolist()
    for offset_x, offset_y in ((a, b) for a in offsets for b in offsets):
        x, y = (
            (np.arange(n) - 0.5 * (n - 1) + offset) * pitch
            for n, offset in zip(shape[::-1], (offset_x, offset_y), strict=True)
        )
        directions = _directions(projection, *np.meshgrid(x, y)) @ rotation.T
        is_seen = ~np.isnan(directions[:, 2])
        at_um = np.full((directions.shape[0], 2), np.nan)
        at_um[is_seen] = projected(lens, directions[is_seen]) - place_um
        at = (at_um - (x0_um, y0_um)) / picture.grid.pitch_xy_um - 0.5
        rows_columns = np.where(np.isnan(at), -2.0, at)[:, ::-1].T.reshape(2, *shape)
        weights += map_coordinates(known.astype(np.float64), rows_columns, order=1, mode="constant", cval=0.0)
        for k, channel in enumerate(values):
            sums[k] += map_coordinates(channel, rows_columns, order=1, mode="constant", cval=0.0)
    is_known = weights >= MIN_KNOWN * N_POINTS**2
    data = np.divide(sums, weights, out=np.full(sums.shape, np.nan), where=is_known)
    return Picture(
        read_only(data.astype(np.float32)),
        read_only((weights / N_POINTS**2).astype(np.float32)),
        Grid.centred(shape, pitch * focal_um),
        picture.white,
        picture.colour_matrix,
    )


def _directions(projection: ViewProjection, x: Floats, y: Floats) -> Floats:
    """Return the directions (n, 3) of points of a view, in focal lengths; NaN beyond it."""
    if projection == "equirectangular":
        cosine = np.cos(y)
        directions = np.stack((cosine * np.sin(x), np.sin(y), cosine * np.cos(x)), axis=-1).reshape(-1, 3)
        return np.where((np.abs(y) <= 0.5 * math.pi).reshape(-1, 1), directions, np.nan)
    return LAWS[projection].directions(np.stack((x, y), axis=-1).reshape(-1, 2))

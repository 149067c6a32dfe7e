"""Relative illumination over the image height, in place of the cosine law of a thin lens."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import Limits, check_declared
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, finite_array, read_only
from foveasim._projections import LAWS, ImageProjection
from foveasim.errors import ParameterError
from foveasim.fields import Grid
from foveasim.incidence import HEIGHT, check_heights

#: Points of a cell along each axis, in cells from its centre: nodes of Gauss and Legendre.
CELL_NODES = 0.5 / 3.0**0.5
#: Relative illumination: above 1 where pupil aberration enlarges the pupil off the axis.
ILLUMINATION = Limits(at_least=0.0, at_most=4.0, hint="relative illumination is a fraction of that on the axis")


@dataclass(frozen=True)
class IlluminationTable:
    """
    Relative illumination at image heights, as in data sheets of lenses.

    Parameters
    ----------
    image_height_um : sequence of float, µm
        Distances from the optical axis, ascending from 0.
    fraction : sequence of float
        Irradiance of a uniform scene at each height over that on the axis, 1 on the axis.

    Raises
    ------
    ParameterError
        When there are fewer than two heights, they do not ascend from 0, or the numbers of heights and fractions differ.

    Notes
    -----
    The fraction is interpolated monotonically in the image height (F. N. Fritsch and J. Butland, A method for constructing
    local monotone piecewise cubic interpolants, SIAM J. Sci. Stat. Comput. 5, 300, 1984), and constant beyond the last height.

    Examples
    --------
    >>> import foveasim as fs
    >>> table = fs.optics.IlluminationTable(
    ...     image_height_um=(0.0, 1000.0, 2000.0), fraction=(1.0, 0.9, 0.6)
    ... )
    >>> table.at([[0.0, 0.0], [0.0, -1000.0], [3000.0, 0.0]]).round(6).tolist()
    [1.0, 0.9, 0.6]
    """

    image_height_um: Annotated[Sequence[float], HEIGHT]
    fraction: Annotated[Sequence[float], ILLUMINATION]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_declared(self)
        check_heights(self.image_height_um, "fraction", self.fraction)
        if self.fraction[0] != 1.0:
            raise ParameterError("fraction", "must be 1 on the axis", self.fraction[0])

    def at(self, field_um: ArrayLike) -> Floats:
        """
        Interpolate the relative illumination at positions relative to the optical axis.

        Parameters
        ----------
        field_um : (..., 2) float64, µm

        Returns
        -------
        fraction : (...) float64
        """
        x_um, y_um = np.moveaxis(finite_array("field_um", field_um), -1, 0)
        return np.asarray(_interpolant(self)(np.minimum(np.hypot(x_um, y_um), self.image_height_um[-1])))


@lru_cache(maxsize=16)
def _interpolant(table: IlluminationTable) -> Callable[[Floats], Floats]:
    from scipy.interpolate import PchipInterpolator

    found: Callable[[Floats], Floats] = PchipInterpolator(table.image_height_um, table.fraction)
    return found


def solid_angles_sr(grid: Grid, focal_um: float, projection: ImageProjection, *, is_flat: bool) -> Floats:
    """
    Return the mean solid angle per area of the cells of an image, (n_y, n_x) sr.

    Areas are in squared focal lengths. ``is_flat``: times the cosine of the angle to the axis, for a flat pupil. Beyond the
    largest angle of the projection it is 0.
    """
    law = LAWS[projection]
    x, y = (
        ((np.arange(n) - 0.5 * (n - 1)) * pitch + c) / focal_um
        for n, pitch, c in zip(grid.shape[::-1], grid.pitch_xy_um, grid.centre_um, strict=True)
    )
    step = CELL_NODES * grid.pitch_xy_um / focal_um
    total = np.zeros(grid.shape)
    for side_x in (-step[0], step[0]):
        for side_y in (-step[1], step[1]):
            theta_rad = law.angles_rad(np.hypot(x + side_x, (y + side_y)[:, np.newaxis]))
            value = law.solid_angle_sr(theta_rad)
            total += np.nan_to_num(value * np.maximum(np.cos(theta_rad), 0.0) if is_flat else value)
    return read_only(0.25 * total)

"""
Conversion of lens models from and to OpenCV.

OpenCV counts pixels from the upper left pixel with y pointing down; here the origin is the centre of the image and y points up.
The principal point of a calibration becomes ``centre_um``. Pixel positions are pixel centres.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import POSITIVE
from foveasim._core.validation import Floats, check_count, finite_array
from foveasim.distortion._brown_conrady import BrownConrady
from foveasim.distortion._fisheye import PolynomialFisheye
from foveasim.errors import ParameterError

#: OpenCV's order of coefficients; calibrations contain the first 4, 5, 8, 12 or all of them.
OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x_rad", "tau_y_rad")
#: Coefficients whose sign changes because y points up instead of down.
REVERSED = ("p1", "s3", "s4", "tau_x_rad")


def from_opencv(
    camera_matrix: ArrayLike,
    coefficients: ArrayLike,
    *,
    image_size: tuple[int, int],
    pixel_um: Annotated[float, POSITIVE],
    fisheye: bool = False,
) -> BrownConrady | PolynomialFisheye:
    """
    Convert an OpenCV camera matrix and distortion coefficients to a lens.

    Parameters
    ----------
    camera_matrix : (3, 3), pixels
        ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``.
    coefficients : (4,), (5,), (8,), (12,) or (14,)
        ``k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, τx, τy]]]]``; with ``fisheye`` the four coefficients of
        ``cv2.fisheye``.
    image_size : (width, height), pixels
        Size of the calibration images.
    pixel_um : float, µm
        Pixel size.
    fisheye : bool
        Whether the coefficients belong to the model of ``cv2.fisheye``.

    Returns
    -------
    BrownConrady or PolynomialFisheye

    Raises
    ------
    ParameterError
        If a shape or a value differs from the above, or the matrix has a skew.

    Examples
    --------
    >>> import foveasim as fs
    >>> matrix = [[1000.0, 0.0, 320.0], [0.0, 1000.0, 240.0], [0.0, 0.0, 1.0]]
    >>> lens = fs.distortion.from_opencv(
    ...     matrix, [-0.2, 0.05, 0.0, 0.0], image_size=(640, 480), pixel_um=3.0
    ... )
    >>> float(lens.distort([[600.0, 0.0]])[0, 0].round(1))
    595.3
    """
    matrix = finite_array("camera_matrix", camera_matrix, ndim=2)
    if matrix.shape != (3, 3) or matrix[0, 1] or matrix[1, 0] or not (matrix[2] == (0.0, 0.0, 1.0)).all():
        raise ParameterError("camera_matrix", "must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", matrix.tolist())
    k = finite_array("coefficients", coefficients).ravel()
    allowed = (4,) if fisheye else (4, 5, 8, 12, 14)
    if k.size not in allowed:
        raise ParameterError("coefficients", f"must be {', '.join(map(str, allowed))} numbers", k.tolist())
    position: dict[str, Any] = {
        "focal_um": (matrix[0, 0] * pixel_um, matrix[1, 1] * pixel_um),
        "centre_um": centre_um((matrix[0, 2], matrix[1, 2]), image_size, pixel_um),
    }
    if fisheye:
        return PolynomialFisheye(k=k.tolist(), **position)
    values: dict[str, Any] = dict(zip(OPENCV_ORDER, k.tolist(), strict=False))
    return BrownConrady(**_reversed(values), **position)


def _reversed(values: dict[str, Any]) -> dict[str, Any]:
    """Return coefficients for y pointing in the other direction."""
    return {name: -value if name in REVERSED else value for name, value in values.items()}


def to_opencv(
    lens: BrownConrady | PolynomialFisheye, *, image_size: tuple[int, int], pixel_um: Annotated[float, POSITIVE]
) -> tuple[Floats, Floats]:
    """
    Convert a lens to an OpenCV camera matrix and distortion coefficients.

    The inverse of :func:`from_opencv`. The matrix is (3, 3); the coefficients are (8,), (14,) with thin prisms or a tilt, or
    (4,) for a fisheye lens.

    Raises
    ------
    ParameterError
        If OpenCV has no equivalent of the lens model.

    Examples
    --------
    >>> import foveasim as fs
    >>> lens = fs.distortion.BrownConrady(k1=-0.2, k2=0.05, focal_um=3000.0)
    >>> matrix, coefficients = fs.distortion.to_opencv(
    ...     lens, image_size=(640, 480), pixel_um=3.0
    ... )
    >>> matrix.tolist(), coefficients[:2].tolist()
    ([[1000.0, 0.0, 319.5], [0.0, 1000.0, 239.5], [0.0, 0.0, 1.0]], [-0.2, 0.05])
    """
    width, height = size_of(image_size)
    fx, fy = np.broadcast_to(np.asarray(lens.focal_um), (2,)) / pixel_um
    cx = lens.centre_um[0] / pixel_um + 0.5 * (width - 1)
    cy = -lens.centre_um[1] / pixel_um + 0.5 * (height - 1)
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if isinstance(lens, PolynomialFisheye):
        return matrix, np.array(lens.k)
    values = np.array(list(_reversed({name: getattr(lens, name) for name in OPENCV_ORDER}).values()))
    return matrix, values if values[8:].any() else values[:8]


def size_of(image_size: tuple[Any, Any]) -> tuple[int, int]:
    """Return the width and height of an image, in pixels."""
    if np.shape(image_size) != (2,):
        raise ParameterError("image_size", "must be two numbers (width, height)", image_size, "pixels")
    return check_count("image_size[0]", image_size[0]), check_count("image_size[1]", image_size[1])


def centre_um(pixel: tuple[float, float], image_size: tuple[Any, Any], pixel_um: float) -> tuple[float, float]:
    """Return the position in the sensor plane of a pixel of an image."""
    width, height = size_of(image_size)
    return (float(pixel[0]) - 0.5 * (width - 1)) * pixel_um, (0.5 * (height - 1) - float(pixel[1])) * pixel_um

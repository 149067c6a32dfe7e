"""
Conversion of lens models from and to the calibrations of other programs.

Supported programs are OpenCV, ROS, MATLAB and OCamCalib. They count pixels from the upper left pixel with y pointing down;
in foveasim the origin is the centre of the image and y points up. The principal point of a calibration becomes
``centre_um``. Pixel positions are pixel centres.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import POSITIVE
from foveasim._core.names import possible_names
from foveasim._core.validation import Floats, check_count, finite_array
from foveasim.distortion._brown_conrady import BrownConrady
from foveasim.distortion._fisheye import PolynomialFisheye, Scaramuzza
from foveasim.distortion._lens import Lens
from foveasim.errors import ConfigError, ParameterError

#: OpenCV's order of coefficients; calibrations contain the first 4, 5 or 8 of them.
OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
#: Alternative keys in calibration files, in lower case without underscores.
MATRIX_KEYS = ("cameramatrix", "k", "intrinsicmatrix")
COEFFICIENT_KEYS = ("distortioncoefficients", "distcoeffs", "d")
MODEL_KEYS = ("distortionmodel", "cameramodel", "model")
WIDTH_KEYS, HEIGHT_KEYS = ("imagewidth", "width"), ("imageheight", "height")
FISHEYE_MODELS = ("fisheye", "equidistant", "kannala_brandt4", "kannala_brandt", "opencv_fisheye")
PINHOLE_MODELS = ("plumb_bob", "rational_polynomial", "pinhole", "radtan", "brown_conrady", "opencv")


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
    coefficients : (4,), (5,) or (8,), or (12,) or (14,) with zeros after the eighth
        ``k1, k2, p1, p2[, k3[, k4, k5, k6]]``; with ``fisheye`` the four coefficients of ``cv2.fisheye``.
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
    >>> lens = fs.distortion.from_opencv(matrix, [-0.2, 0.05, 0.0, 0.0], image_size=(640, 480), pixel_um=3.0)
    >>> float(lens.distort([[600.0, 0.0]])[0, 0].round(1))
    595.3
    """
    matrix = finite_array("camera_matrix", camera_matrix, ndim=2)
    if matrix.shape != (3, 3) or matrix[0, 1] or matrix[1, 0] or not (matrix[2] == (0.0, 0.0, 1.0)).all():
        raise ParameterError("camera_matrix", "must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", matrix.tolist())
    k = finite_array("coefficients", coefficients).ravel()
    if not fisheye and k.size in (12, 14) and not k[8:].any():  # no thin prism, no tilt
        k = k[:8]
    allowed = (4,) if fisheye else (4, 5, 8)
    if k.size not in allowed:
        raise ParameterError("coefficients", f"must be {', '.join(map(str, allowed))} numbers", k.tolist())
    position: dict[str, Any] = {
        "focal_um": (matrix[0, 0] * pixel_um, matrix[1, 1] * pixel_um),
        "centre_um": _centre_um((matrix[0, 2], matrix[1, 2]), image_size, pixel_um),
    }
    if fisheye:
        return PolynomialFisheye(k=k.tolist(), **position)
    values: dict[str, Any] = dict(zip(OPENCV_ORDER, k.tolist(), strict=False))
    # The tangential term along y changes its sign because y points up instead of down.
    values["p1"] = -values["p1"]
    return BrownConrady(**values, **position)


def to_opencv(
    lens: BrownConrady | PolynomialFisheye, *, image_size: tuple[int, int], pixel_um: Annotated[float, POSITIVE]
) -> tuple[Floats, Floats]:
    """
    Convert a lens to an OpenCV camera matrix and distortion coefficients.

    The inverse of :func:`from_opencv`. The matrix is (3, 3); the coefficients are (8,), or (4,) for a fisheye lens.

    Raises
    ------
    ParameterError
        If OpenCV has no equivalent of the lens model.

    Examples
    --------
    >>> import foveasim as fs
    >>> lens = fs.distortion.BrownConrady(k1=-0.2, k2=0.05, focal_um=3000.0)
    >>> matrix, coefficients = fs.distortion.to_opencv(lens, image_size=(640, 480), pixel_um=3.0)
    >>> matrix.tolist(), coefficients[:2].tolist()
    ([[1000.0, 0.0, 319.5], [0.0, 1000.0, 239.5], [0.0, 0.0, 1.0]], [-0.2, 0.05])
    """
    width, height = _size(image_size)
    fx, fy = np.broadcast_to(np.asarray(lens.focal_um), (2,)) / pixel_um
    cx = lens.centre_um[0] / pixel_um + 0.5 * (width - 1)
    cy = -lens.centre_um[1] / pixel_um + 0.5 * (height - 1)
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if isinstance(lens, PolynomialFisheye):
        return matrix, np.array(lens.k)
    values = [getattr(lens, name) for name in OPENCV_ORDER]
    values[OPENCV_ORDER.index("p1")] *= -1.0
    return matrix, np.array(values)


def read_calibration(
    path: str | Path,
    *,
    pixel_um: Annotated[float, POSITIVE],
    focal_um: Annotated[float | None, POSITIVE] = None,
    image_size: tuple[int, int] | None = None,
) -> Lens:
    r"""
    Read a lens from a calibration file.

    Parameters
    ----------
    path : path
        YAML or JSON of OpenCV or ROS (camera matrix, distortion coefficients, model), JSON of MATLAB's ``cameraParameters`` or
        ``fisheyeParameters``, or ``calib_results.txt`` of OCamCalib.
    pixel_um : float, µm
        Pixel size.
    focal_um : float, optional, µm
        Distance of the ideal image plane. Required for Scaramuzza's model, whose calibrations have no focal length.
    image_size : (width, height), optional, pixels
        Image size, required if the file does not contain it.

    Raises
    ------
    ConfigError
        If the file has none of these formats or lacks a parameter of the lens.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> text = "camera_matrix: [[1000, 0, 320], [0, 1000, 240], [0, 0, 1]]\ndistortion_coefficients: [-0.2, 0.05, 0, 0]\n"
    >>> with tempfile.TemporaryDirectory() as directory:
    ...     path = Path(directory, "calibration.yaml")
    ...     _ = path.write_text(text)
    ...     lens = fs.distortion.read_calibration(path, pixel_um=3.0, image_size=(640, 480))
    >>> lens.focal_um, lens.k1, lens.k2
    ((3000.0, 3000.0), -0.2, 0.05)
    """
    from foveasim._io.yaml_files import parse_yaml, read_text

    path = Path(path)
    text = read_text(path)
    try:
        if text.lstrip().startswith("#polynomial"):
            return _from_ocamcalib(path, text, pixel_um, focal_um)
        data = parse_yaml(path, _plain_yaml(text))
        if not isinstance(data, dict):
            raise ConfigError(
                path, "contains no calibration; provide the keys camera_matrix and distortion_coefficients"
            )
        keys = {re.sub("[_ -]", "", str(key)).lower(): value for key, value in data.items()}
        if "mappingcoefficients" in keys or "intrinsics" in keys:
            return _from_matlab_fisheye(path, keys, pixel_um, focal_um)
        if "radialdistortion" in keys:
            return _from_matlab(path, keys, pixel_um)
        return _from_keys(path, keys, pixel_um, image_size)
    except ParameterError as error:
        raise ConfigError(path, str(error)) from None


def _plain_yaml(text: str) -> str:
    """Remove the nonstandard header and tags of OpenCV's YAML."""
    return re.sub(r"!!opencv-[\w-]+", "", re.sub(r"\A%YAML[: ]1\.\d\s*\n", "", text))


def _from_keys(path: Path, keys: Mapping[str, Any], pixel_um: float, image_size: tuple[int, int] | None) -> Lens:
    matrix = _numbers(path, _value(path, keys, MATRIX_KEYS, "a camera matrix")).reshape(-1)
    if matrix.size != 9:
        raise ConfigError(path, f"the camera matrix must have 9 numbers, got {matrix.size}")
    coefficients = _numbers(path, _value(path, keys, COEFFICIENT_KEYS, "distortion coefficients")).reshape(-1)
    model = str(next((keys[key] for key in MODEL_KEYS if key in keys), PINHOLE_MODELS[0])).lower()
    model = re.sub("kannalabrandt", "kannala_brandt", re.sub("[- ]", "_", model))
    if model not in FISHEYE_MODELS + PINHOLE_MODELS:
        known = FISHEYE_MODELS + PINHOLE_MODELS
        raise ConfigError(path, f"has the unknown distortion model '{model}'; {possible_names(model, known)}")
    size: list[Any] = [next((keys[key] for key in names if key in keys), None) for names in (WIDTH_KEYS, HEIGHT_KEYS)]
    if None in size:
        if image_size is None:
            raise ConfigError(path, "must specify image_width and image_height; pass 'image_size' instead")
        size = list(_size(image_size))
    return from_opencv(
        matrix.reshape(3, 3),
        coefficients,
        image_size=(size[0], size[1]),
        pixel_um=pixel_um,
        fisheye=model in FISHEYE_MODELS,
    )


def _from_matlab(path: Path, keys: Mapping[str, Any], pixel_um: float) -> Lens:
    if "k" in keys:
        matrix = _square(path, keys["k"], 3)
    else:  # IntrinsicMatrix of older MATLAB releases is transposed
        matrix = _square(path, _value(path, keys, ("intrinsicmatrix",), "an intrinsic matrix"), 3).T
    radial = _numbers(path, keys["radialdistortion"]).ravel()
    tangential = _numbers(path, keys.get("tangentialdistortion", [0.0, 0.0])).ravel()
    size = _numbers(path, _value(path, keys, ("imagesize",), "an image size")).ravel()
    if radial.size not in (2, 3) or tangential.size != 2 or size.size != 2:
        raise ConfigError(path, "must have 2 or 3 radial and 2 tangential coefficients and 2 image dimensions")
    matrix = matrix - np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])  # MATLAB counts pixels from 1
    coefficients = [*radial[:2], *tangential, *radial[2:]]
    return from_opencv(matrix, coefficients, image_size=(size[1], size[0]), pixel_um=pixel_um)


def _from_matlab_fisheye(path: Path, keys: Mapping[str, Any], pixel_um: float, focal_um: float | None) -> Lens:
    inner = keys.get("intrinsics", None)
    if isinstance(inner, dict):
        keys = {re.sub("[_ -]", "", str(key)).lower(): value for key, value in inner.items()}
    a = _numbers(path, _value(path, keys, ("mappingcoefficients",), "mapping coefficients")).ravel()
    centre = _numbers(path, _value(path, keys, ("distortioncenter",), "a distortion centre")).ravel() - 1.0
    size = _numbers(path, _value(path, keys, ("imagesize",), "an image size")).ravel()
    matrix = _square(path, keys.get("stretchmatrix", [[1.0, 0.0], [0.0, 1.0]]), 2)
    if centre.size != 2 or size.size != 2:
        raise ConfigError(path, "must have 2 numbers for the distortion centre and 2 for the image size")
    return Scaramuzza(
        a=a.tolist(),
        pixel_um=pixel_um,
        focal_um=_require_focal_um(path, focal_um),
        stretch=(matrix * np.array([[1.0, -1.0], [-1.0, 1.0]])).tolist(),
        centre_um=_centre_um((centre[0], centre[1]), (size[1], size[0]), pixel_um),
    )


def _from_ocamcalib(path: Path, text: str, pixel_um: float, focal_um: float | None) -> Scaramuzza:
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    try:
        rows = [[float(x) for x in line] for line in lines]
        n = int(rows[0][0])
        polynomial = rows[0][1:]
        centre, affine, size = rows[2][:2], rows[3][:3], rows[4][:2]
    except (ValueError, IndexError, OverflowError):
        raise ConfigError(
            path, "must have the five lines of numbers of calib_results.txt: polynomial, inverse, centre, affine, size"
        ) from None
    if n != len(polynomial) or n != 5 or polynomial[1] != 0.0 or len(centre) + len(affine) + len(size) != 7:
        raise ConfigError(
            path, "must have the five coefficients a0, 0, a2, a3, a4, the centre, c d e and the image size"
        )
    c, d, e = affine
    # OCamCalib's x axis points down (row index), its y axis to the right (column index).
    return Scaramuzza(
        a=[polynomial[0], polynomial[2], polynomial[3], polynomial[4]],
        pixel_um=pixel_um,
        focal_um=_require_focal_um(path, focal_um),
        stretch=[[1.0, -e], [-d, c]],
        centre_um=_centre_um((centre[1], centre[0]), (size[1], size[0]), pixel_um),
    )


def _require_focal_um(path: Path, focal_um: float | None) -> float:
    if focal_um is None:
        raise ConfigError(path, "contains Scaramuzza's model, which has no focal length; pass 'focal_um'")
    return focal_um


def _value(path: Path, keys: Mapping[str, Any], names: tuple[str, ...], what: str) -> Any:
    for name in names:
        if name in keys:
            return keys[name]
    raise ConfigError(path, f"lacks {what}; add one of the keys {', '.join(names)}")


def _numbers(path: Path, value: Any) -> Floats:
    """Return the numbers of a list, or of a matrix as written by OpenCV and ROS."""
    try:
        return finite_array("data", value["data"] if isinstance(value, dict) else value)
    except (ParameterError, KeyError):
        raise ConfigError(path, f"must contain finite numbers, got {str(value)[:60]}") from None


def _square(path: Path, value: Any, n: int) -> Floats:
    """Return a square matrix of n rows."""
    numbers = _numbers(path, value)
    if numbers.size != n * n:
        raise ConfigError(path, f"must have a matrix of {n} x {n} numbers, got {numbers.size}")
    return numbers.reshape(n, n)


def _size(image_size: tuple[Any, Any]) -> tuple[int, int]:
    if np.shape(image_size) != (2,):
        raise ParameterError("image_size", "must be two numbers (width, height)", image_size, "pixels")
    return check_count("image_size[0]", image_size[0]), check_count("image_size[1]", image_size[1])


def _centre_um(pixel: tuple[float, float], image_size: tuple[Any, Any], pixel_um: float) -> tuple[float, float]:
    width, height = _size(image_size)
    return (float(pixel[0]) - 0.5 * (width - 1)) * pixel_um, (0.5 * (height - 1) - float(pixel[1])) * pixel_um

"""
Calibration files of OpenCV, ROS, Kalibr, EuRoC, VINS, MATLAB and OCamCalib.

Every key of a file is read, known to be irrelevant for the image of one camera, or an error that names it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from foveasim._core.calls import POSITIVE
from foveasim._core.names import possible_names
from foveasim._core.validation import Floats, finite_array
from foveasim._io.text_files import parse_xml
from foveasim.distortion._brown_conrady import BrownConrady
from foveasim.distortion._calibration import centre_um, from_opencv
from foveasim.distortion._fisheye import PolynomialFisheye, Scaramuzza
from foveasim.distortion._lens import Lens
from foveasim.distortion._registry import LENSES
from foveasim.distortion._unified import DoubleSphere, ExtendedUnified, FieldOfView, Omnidirectional
from foveasim.errors import ConfigError, ParameterError

#: Keys that do not change the image of one camera: poses, other cameras, results of the fit, topics. All keys are compared in
#: lower case without ``_``, ``-`` and blanks.
IRRELEVANT = frozenset((
    # OpenCV's calibration samples
    "calibrationtime", "nframes", "nrofframes", "boardwidth", "boardheight", "squaresize", "markersize", "flags", "flagvalue",
    "aspectratio", "fixaspectratio", "avgreprojectionerror", "perviewreprojectionerrors", "extrinsicparameters", "imagepoints",
    "gridpoints", "rms", "sensormodel",
    "rotationmatrix", "translationvector",
    # ROS
    "header", "cameraname", "rectificationmatrix", "projectionmatrix",
    # Kalibr, EuRoC, VINS
    "tcncnm1", "tcamimu", "timcam", "timucam", "timeshiftcamimu", "rostopic", "camoverlaps", "sensortype", "comment", "tbs",
    "ratehz",
    # MATLAB
    "worldpoints", "worldunits", "estimateskew", "numradialdistortioncoefficients", "estimatetangentialdistortion",
    "translationvectors", "reprojectionerrors", "detectedkeypoints", "rotationvectors", "numpatterns", "intrinsics",
    "meanreprojectionerror", "reprojectedpoints", "rotationmatrices", "focallength", "principalpoint", "patternextrinsics",
    "distcoeffsestimationtype",
))  # fmt: skip
#: Poses and rectification of stereo cameras: irrelevant if they are matrices, not coefficients of the same name.
POSES = frozenset(("r", "t", "e", "f", "r1", "r2", "p1", "p2", "q", "p"))
#: Names of the same thing.
MATRIX = ("cameramatrix", "k", "m", "intrinsicmatrix")
COEFFICIENTS = ("distortioncoefficients", "distcoeffs", "d")
MODEL = ("distortionmodel", "cameramodel", "model")
WIDTH, HEIGHT, SIZE = ("imagewidth", "width"), ("imageheight", "height"), ("imagesize", "resolution")
#: Distortion models by their names in files.
RADIAL, FISHEYE = "plumb_bob", "equidistant"
MODELS = {
    **dict.fromkeys(
        (
            "plumb_bob",
            "rational_polynomial",
            "pinhole",
            "radtan",
            "radial_tangential",
            "brown_conrady",
            "opencv",
            "none",
            "",
        ),
        RADIAL,
    ),
    **dict.fromkeys(
        ("equidistant", "fisheye", "kannala_brandt", "kannala_brandt4", "opencv_fisheye", "equi", "kb4"), FISHEYE
    ),
    "fov": "fov",
}
#: Projections of Kalibr and of the programs that follow it, with the numbers before the focal lengths.
PROJECTIONS = {"pinhole": (), "omni": ("xi",), "mei": ("xi",), "eucm": ("alpha", "beta"), "ds": ("xi", "alpha")}


class _Intrinsics(NamedTuple):
    """
    Intrinsics of a camera.

    ``focal_px``, ``centre_px``: focal lengths and principal point. ``projection``: one of :data:`PROJECTIONS` with its
    ``numbers``. ``distortion``: a value of :data:`MODELS` with its ``coefficients``. ``size``: width and height, if known.
    """

    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    projection: str = "pinhole"
    numbers: Mapping[str, Any] = {}
    distortion: str = RADIAL
    coefficients: Sequence[float] = ()
    size: tuple[Any, Any] | None = None


def _example(directory: Path) -> dict[str, Any]:
    (directory / "camera.yaml").write_text(
        "image_width: 640\nimage_height: 480\ncamera_matrix: [20, 0, 319.5, 0, 20, 239.5, 0, 0, 1]\n"
        "distortion_coefficients: [-0.2, 0.05, 0, 0]\n"
    )
    return {"path": str(directory / "camera.yaml"), "pixel_um": 3.0}


def read_calibration(
    path: str | Path,
    *,
    pixel_um: Annotated[float, POSITIVE],
    focal_um: Annotated[float | None, POSITIVE] = None,
    image_size: tuple[int, int] | None = None,
    camera: str | int | None = None,
    ignore: Sequence[str] = (),
) -> Lens:
    r"""
    Read a lens from a calibration file.

    Parameters
    ----------
    path : path
        OpenCV (YAML, XML, JSON; also stereo, fisheye and omnidirectional), ROS ``CameraInfo``, Kalibr ``camchain.yaml``, EuRoC
        ``sensor.yaml``, VINS, JSON of MATLAB's ``cameraParameters`` or ``fisheyeParameters``, or ``calib_results.txt`` of
        OCamCalib.
    pixel_um : float, µm
        Pixel size.
    focal_um : float, optional, µm
        Distance of the ideal image plane. Required for Scaramuzza's model, whose calibrations have no focal length.
    image_size : (width, height), optional, pixels
        Image size, required if the file does not contain it.
    camera : str or int, optional
        Name of the camera in a file of several: ``"cam0"`` of Kalibr, ``1`` or ``2`` of OpenCV's stereo files.
    ignore : sequence of str
        Further keys that do not change the image.

    Raises
    ------
    ConfigError
        If the file has none of these formats, lacks a parameter of the lens, has a key or model that is not known, or several
        cameras and ``camera`` is none of them.

    Notes
    -----
    Models: Brown-Conrady with up to fourteen coefficients (radtan, plumb_bob, rational_polynomial), equidistant (Kannala and
    Brandt), field of view, unified omnidirectional, extended unified, double sphere, Scaramuzza.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import foveasim as fs
    >>> matrix = "[[1000, 0, 320], [0, 1000, 240], [0, 0, 1]]"
    >>> text = f"camera_matrix: {matrix}\ndistortion_coefficients: [-0.2, 0.05, 0, 0]\n"
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
        data = _from_xml(path, text) if text.lstrip().startswith("<") else parse_yaml(path, _plain_yaml(text))
        if not isinstance(data, dict):
            raise ConfigError(
                path, "contains no calibration; provide the keys camera_matrix and distortion_coefficients"
            )
        keys = _Keys(path, _chosen(path, data, camera), {_plain(key) for key in ignore})
        if "mappingcoefficients" in keys or isinstance(keys.get("intrinsics"), dict):
            return _from_matlab_fisheye(path, keys, pixel_um, focal_um)
        parse = next(parse for key, parse in PARSERS.items() if not key or key in keys)
        found = parse(keys)
        keys.check()
        size = image_size if found.size is None else found.size
        if size is None:
            raise ConfigError(path, "must specify image_width and image_height; pass 'image_size' instead")
        return _lens(path, found, size, pixel_um)
    except ParameterError as error:
        raise ConfigError(path, str(error)) from None


LENSES.register("calibration", read_calibration, example=_example, expected={(6.0, 0.0): (5.98803, 0.0)})


# -- keys ---------------------------------------------------------------------------------------------------------------


def _plain(key: Any) -> str:
    return re.sub("[_ -]", "", str(key)).lower()


class _Keys:
    """Values of a file by key, which records what was read."""

    def __init__(self, path: Path, data: Mapping[str, Any], ignore: set[str]) -> None:
        self.path, self.ignore = path, ignore
        self.names = {_plain(key): str(key) for key in data}
        self.values = {_plain(key): value for key, value in data.items()}
        self.used: set[str] = set()

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def get(self, *keys: str, default: Any = None) -> Any:
        """Return the value of the first of some keys that the file contains."""
        found = next((key for key in keys if key in self.values), None)
        if found is None:
            return default
        self.used.add(found)
        return self.values[found]

    def require(self, what: str, *keys: str) -> Any:
        """Return the value of the first of some keys; raise ConfigError without any of them."""
        if not any(key in self.values for key in keys):
            raise ConfigError(self.path, f"lacks {what}; add one of the keys {', '.join(keys)}")
        return self.get(*keys)

    def numbers(self, what: str, *keys: str, n: Sequence[int] = ()) -> Floats:
        """Return the numbers of a required key, in one dimension."""
        found = numbers_of(self.path, self.require(what, *keys)).ravel()
        if n and found.size not in n:
            expected = " or ".join(map(str, n))
            raise ConfigError(self.path, f"{what} must have {expected} numbers, got {found.size}")
        return found

    def size(self) -> tuple[Any, Any] | None:
        """Return the width and height of the image, if the file contains them."""
        width, height, both = self.get(*WIDTH), self.get(*HEIGHT), self.get(*SIZE)
        if width is not None and height is not None:
            return width, height
        return None if both is None else tuple(self.numbers("an image size", *SIZE, n=(2,)).tolist())

    def check(self) -> None:
        """Raise ConfigError when there is a key that was not read and may change the image."""
        matrices = {key for key in POSES & self.values.keys() if isinstance(self.values[key], list | dict)}
        for key, name in self.names.items():
            if key not in self.used | IRRELEVANT | matrices | self.ignore:
                raise ConfigError(
                    self.path,
                    f"has the key '{name}', which is not known; if it does not change the image, pass ignore=['{name}']",
                )


def _chosen(path: Path, data: Mapping[str, Any], camera: str | int | None) -> Mapping[str, Any]:
    """Return the keys of one camera."""
    plain = {_plain(key): key for key in data}
    cameras: dict[str, Mapping[str, Any]] = {}
    if data and all(re.fullmatch(r"cam\d+", key) and isinstance(data[name], dict) for key, name in plain.items()):
        cameras = {key: data[name] for key, name in plain.items()}
    else:
        both = [f"{name}{number}" for name in (*MATRIX, *COEFFICIENTS) for number in (1, 2)]
        for number in ("1", "2"):
            own = {key.rstrip("12"): data[plain[key]] for key in both if key.endswith(number) and key in plain}
            if own.keys() & set(MATRIX) and own.keys() & set(COEFFICIENTS):
                cameras[number] = {**{key: data[name] for key, name in plain.items() if key not in both}, **own}
    if not cameras:
        if camera is not None:
            raise ConfigError(path, f"contains one camera without a name; omit camera={camera!r}")
        return data
    if camera is None and len(cameras) == 1:
        return next(iter(cameras.values()))
    if str(camera) not in cameras:
        names = ", ".join(cameras)
        problem = "contains several cameras" if camera is None else f"contains no camera {camera!r}"
        raise ConfigError(path, f"{problem}; pass camera= one of {names}")
    return cameras[str(camera)]


def numbers_of(path: Path, value: Any) -> Floats:
    """Return the numbers of a list, or of a matrix as OpenCV and ROS write it."""
    try:
        found = finite_array("data", value["data"] if isinstance(value, dict) else value)
    except (ParameterError, KeyError):
        raise ConfigError(path, f"must contain finite numbers, got {str(value)[:60]}") from None
    rows, columns = (value.get(name, 1) for name in ("rows", "cols")) if isinstance(value, dict) else (1, found.size)
    if isinstance(value, dict) and "rows" in value and found.size != rows * columns:
        raise ConfigError(path, f"has a matrix of {rows} x {columns} with {found.size} numbers")
    return found


# -- formats --------------------------------------------------------------------------------------------------------------


def _plain_yaml(text: str) -> str:
    """Remove the header and tags of OpenCV's YAML, and the end of a message of ROS."""
    text = re.sub(r"\A%YAML[: ]1\.\d\s*\n", "", text)
    return re.sub(r"\n---\s*\Z", "\n", re.sub(r"!!opencv-[\w-]+", "", text))


def _from_xml(path: Path, text: str) -> dict[str, Any]:
    """Return the values of an XML file of OpenCV."""
    root = parse_xml(path, text.encode(), "opencv_storage", "calibration of OpenCV", error=ConfigError)

    def value(element: Element) -> Any:
        if len(element):
            return {each.tag: value(each) for each in element}
        words = [_number(word) for word in (element.text or "").split()]
        return words[0] if len(words) == 1 and element.tag != "data" else words

    return {element.tag: value(element) for element in root}


def _number(word: str) -> float | int | str:
    for kind in (int, float):
        try:
            return kind(word)
        except ValueError:
            continue
    return word.strip('"')


def _opencv_or_ros(keys: _Keys) -> _Intrinsics:
    matrix = keys.numbers("a camera matrix", *MATRIX)
    if matrix.size != 9:
        raise ConfigError(keys.path, f"the camera matrix must have 9 numbers, got {matrix.size}")
    fx, skew, cx, other, fy, cy, *last = matrix.tolist()
    if skew or other or last != [0.0, 0.0, 1.0]:
        raise ParameterError("camera_matrix", "must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", matrix.tolist())
    coefficients = numbers_of(keys.path, keys.require("distortion coefficients", *COEFFICIENTS)).ravel()
    model = _model(keys.path, str(keys.get(*MODEL, default=RADIAL)), MODELS, "distortion model")
    if keys.get("fisheyemodel", default=0):
        model = FISHEYE
    for name in ("binningx", "binningy"):
        if keys.get(name, default=0) not in (0, 1):
            raise ConfigError(
                keys.path, f"has binned pixels ('{keys.names[name]}'), which the matrix does not describe"
            )
    region = keys.get("roi", default={})
    if isinstance(region, dict) and any(region.get(side) for side in ("x_offset", "y_offset", "width", "height")):
        raise ConfigError(keys.path, "has a region of interest ('roi'), which the matrix does not describe")
    xi = keys.get("xi")
    return _Intrinsics(
        (fx, fy),
        (cx, cy),
        "pinhole" if xi is None else "omni",
        {} if xi is None else {"xi": float(numbers_of(keys.path, xi).ravel()[0])},
        model,
        coefficients.tolist(),
        keys.size(),
    )


def _kalibr(keys: _Keys) -> _Intrinsics:
    """Return the intrinsics of a camera of Kalibr or EuRoC."""
    projection = _model(
        keys.path,
        str(keys.require("a camera model", "cameramodel")),
        {name: name for name in PROJECTIONS},
        "camera model",
    )
    names = PROJECTIONS[projection]
    intrinsics = keys.numbers("intrinsics", "intrinsics", n=(len(names) + 4,)).tolist()
    *numbers, fx, fy, cx, cy = intrinsics
    coefficients = keys.get("distortioncoeffs", "distortioncoefficients", default=[])
    model = _model(keys.path, str(keys.get("distortionmodel", default="none")), MODELS, "distortion model")
    return _Intrinsics(
        (fx, fy),
        (cx, cy),
        projection,
        dict(zip(names, numbers, strict=True)),
        model,
        numbers_of(keys.path, coefficients).ravel().tolist(),
        keys.size(),
    )


def _vins(keys: _Keys) -> _Intrinsics:
    """Return the intrinsics of a camera of VINS and camodocal."""
    known = {"pinhole": "pinhole", "mei": "mei", "kannala_brandt": "kannala_brandt"}
    model = _model(keys.path, str(keys.get("modeltype")), known, "camera model")
    parts = {
        name: {_plain(key): value for key, value in found.items()}
        for name in ("projectionparameters", "distortionparameters", "mirrorparameters")
        if isinstance(found := keys.get(name, default={}), dict)
    }
    given, distorted = parts.get("projectionparameters", {}), parts.get("distortionparameters", {})

    def numbers(values: Mapping[str, Any], *names: str) -> list[float]:
        missing = [name for name in names if name not in values]
        if missing:
            raise ConfigError(keys.path, f"lacks the number '{missing[0]}' of the model '{model}'")
        return [float(numbers_of(keys.path, values[name])) for name in names]

    if model == "kannala_brandt":
        *k, fx, fy, cx, cy = numbers(given, "k2", "k3", "k4", "k5", "mu", "mv", "u0", "v0")
        return _Intrinsics((fx, fy), (cx, cy), "pinhole", {}, FISHEYE, k, keys.size())
    k = numbers(distorted, "k1", "k2", "p1", "p2") if distorted else []
    if model == "mei":
        fx, fy, cx, cy = numbers(given, "gamma1", "gamma2", "u0", "v0")
        (xi,) = numbers(parts.get("mirrorparameters", {}), "xi")
        return _Intrinsics((fx, fy), (cx, cy), "omni", {"xi": xi}, RADIAL, k, keys.size())
    fx, fy, cx, cy = numbers(given, "fx", "fy", "cx", "cy")
    return _Intrinsics((fx, fy), (cx, cy), "pinhole", {}, RADIAL, k, keys.size())


def _matlab(keys: _Keys) -> _Intrinsics:
    if "k" in keys:
        matrix = _square(keys.path, keys.get("k"), 3)
        keys.get("intrinsicmatrix")
    else:  # IntrinsicMatrix of older MATLAB releases is transposed
        matrix = _square(keys.path, keys.require("an intrinsic matrix", "intrinsicmatrix"), 3).T
    radial = keys.numbers("radial coefficients", "radialdistortion").tolist()
    tangential = numbers_of(keys.path, keys.get("tangentialdistortion", default=[0.0, 0.0])).ravel().tolist()
    size = keys.numbers("an image size", "imagesize").tolist()
    if len(radial) not in (2, 3) or len(tangential) != 2 or len(size) != 2:
        raise ConfigError(keys.path, "must have 2 or 3 radial and 2 tangential coefficients and 2 image dimensions")
    if keys.get("skew", default=0.0) or matrix[0, 1]:
        raise ConfigError(keys.path, "has a skew, which the lens models do not have; calibrate without EstimateSkew")
    return _Intrinsics(
        (matrix[0, 0], matrix[1, 1]),
        (matrix[0, 2] - 1.0, matrix[1, 2] - 1.0),  # MATLAB counts pixels from 1
        coefficients=[*radial[:2], *tangential, *radial[2:]],
        size=(size[1], size[0]),
    )


#: Reader of a file by a key that only this format has.
PARSERS: dict[str, Callable[[_Keys], _Intrinsics]] = {
    "modeltype": _vins,
    "radialdistortion": _matlab,
    "intrinsics": _kalibr,
    "": _opencv_or_ros,
}


def _model(path: Path, name: str, known: Mapping[str, str], what: str) -> str:
    """Return the common name of a model."""
    plain = re.sub("kannalabrandt", "kannala_brandt", re.sub("[- ]", "_", name.strip().lower()))
    if plain not in known:
        raise ConfigError(
            path, f"has the unknown {what} '{name}'; {possible_names(plain, [each for each in known if each])}"
        )
    return known[plain]


# -- lenses -----------------------------------------------------------------------------------------------------------------


def _lens(path: Path, found: _Intrinsics, size: tuple[Any, Any], pixel_um: float) -> Lens:
    """Return the lens of a pinhole or wide-angle model."""
    (fx, fy), k = found.focal_px, list(found.coefficients)
    centre = centre_um(found.centre_px, size, pixel_um)

    def options(factor: float = 1.0) -> dict[str, Any]:
        return {"focal_um": (fx * pixel_um * factor, fy * pixel_um * factor), "centre_um": centre}

    def require(*n: int) -> None:
        if len(k) not in n:
            rule = f"must be {' or '.join(map(str, n))} numbers"
            raise ParameterError("coefficients", f"{rule} for {found.projection} with {found.distortion}", k)

    if found.projection == "pinhole":
        if found.distortion == "fov":
            require(1)
            return FieldOfView(w_rad=k[0], **options(2.0 * math.tan(0.5 * k[0]) / k[0] if k[0] else 1.0))
        if not k:
            return (
                BrownConrady(**options())
                if found.distortion == RADIAL
                else PolynomialFisheye(k=(0.0,) * 4, **options())
            )
        matrix = np.array([[fx, 0.0, found.centre_px[0]], [0.0, fy, found.centre_px[1]], [0.0, 0.0, 1.0]])
        return from_opencv(
            matrix, k, image_size=(size[0], size[1]), pixel_um=pixel_um, fisheye=found.distortion == FISHEYE
        )
    if found.projection in ("omni", "mei"):
        if found.distortion != RADIAL:
            raise ConfigError(path, f"has an omnidirectional model with the unknown distortion '{found.distortion}'")
        require(0, 4)
        k1, k2, p1, p2 = k or (0.0,) * 4
        xi = found.numbers["xi"]
        return Omnidirectional(xi=xi, k1=k1, k2=k2, p1=-p1, p2=p2, **options(1.0 / (1.0 + xi)))
    require(0)
    if found.projection == "eucm":
        return ExtendedUnified(**found.numbers, **options())
    return DoubleSphere(**found.numbers, **options(1.0 / (1.0 + found.numbers["xi"])))


def _from_matlab_fisheye(path: Path, keys: _Keys, pixel_um: float, focal_um: float | None) -> Lens:
    inner = keys.get("intrinsics")
    if isinstance(inner, dict):
        keys.check()
        keys = _Keys(path, inner, keys.ignore)
    a = keys.numbers("mapping coefficients", "mappingcoefficients")
    centre = keys.numbers("a distortion centre", "distortioncenter") - 1.0
    size = keys.numbers("an image size", "imagesize")
    matrix = _square(path, keys.get("stretchmatrix", default=[[1.0, 0.0], [0.0, 1.0]]), 2)
    keys.check()
    if centre.size != 2 or size.size != 2:
        raise ConfigError(path, "must have 2 numbers for the distortion centre and 2 for the image size")
    return Scaramuzza(
        a=a.tolist(),
        pixel_um=pixel_um,
        focal_um=_require_focal_um(path, focal_um),
        stretch=(matrix * np.array([[1.0, -1.0], [-1.0, 1.0]])).tolist(),
        centre_um=centre_um((centre[0], centre[1]), (size[1], size[0]), pixel_um),
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
    if n != len(polynomial) or n < 2 or polynomial[1] != 0.0 or len(centre) + len(affine) + len(size) != 7:
        raise ConfigError(
            path, "must have the coefficients a0, 0, a2, ... after their number, the centre, c d e and the image size"
        )
    c, d, e = affine
    # OCamCalib's x axis points down (row index), its y axis to the right (column index).
    return Scaramuzza(
        a=[polynomial[0], *polynomial[2:]],
        pixel_um=pixel_um,
        focal_um=_require_focal_um(path, focal_um),
        stretch=[[1.0, -e], [-d, c]],
        centre_um=centre_um((centre[1], centre[0]), (size[1], size[0]), pixel_um),
    )


def _require_focal_um(path: Path, focal_um: float | None) -> float:
    if focal_um is None:
        raise ConfigError(path, "contains Scaramuzza's model, which has no focal length; pass 'focal_um'")
    return focal_um


def _square(path: Path, value: Any, n: int) -> Floats:
    """Return a square matrix of n rows."""
    numbers = numbers_of(path, value)
    if numbers.size != n * n:
        raise ConfigError(path, f"must have a matrix of {n} x {n} numbers, got {numbers.size}")
    return numbers.reshape(n, n)

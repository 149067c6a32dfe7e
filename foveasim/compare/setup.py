"""Scenes that fill the field of a comparison, and cameras of the same design."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import POSITIVE
from foveasim._io.images import EncodedPicture, as_encoded
from foveasim.camera import Camera
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.optics import Optics
from foveasim.scene import Scene
from foveasim.sensor import Sensor

__all__ = ["DEFAULT_PICTURES", "default_sensor", "field_um", "photograph_scenes"]

#: Photographs of scikit-image.
DEFAULT_PICTURES = ("camera.png", "astronaut.png", "coffee.png", "chelsea.png", "rocket.jpg")
#: Width of the scenes over the width of the field, so that no site is beyond the image.
FIELD_MARGIN = 1.04
#: Defaults of layouts without cameras: a lens, a monochrome sensor whose full scale of 2,800 e-/µm² is at 0.9 of the white of
#: the photographs at 1/60 s, and a distance of the scenes.
DEFAULT_FOCAL_MM, DEFAULT_F_NUMBER, DEFAULT_DISTANCE_M = 8.0, 2.8, 1.0
DEFAULT_RADIANCE_W_M2_SR_NM, DEFAULT_WAVELENGTH_NM, DEFAULT_BAND_NM = 0.008, 550.0, 100.0
DEFAULT_EXPOSURE_S = 1 / 60
READ_NOISE_E, QE, BITS = 2.0, 0.6, 10


def default_sensor(layout: Layout) -> Sensor:
    """
    Return a monochrome sensor of 10 bits with capacitances in proportion to area.

    It has a quantum efficiency of 0.6 and 2 e- of read noise per site. All sites saturate at the same irradiance.

    Parameters
    ----------
    layout : Layout

    Examples
    --------
    >>> import foveasim as fs
    >>> sensor = fs.compare.default_sensor(fs.layout.grid(n_x=4, n_y=4, pitch_um=4.0))
    >>> sensor.bits, sensor.filter_names
    (10, ('all',))
    """
    return Sensor(layout, qe=QE, read_noise_e=READ_NOISE_E, bits=BITS)


def default_optics() -> Optics:
    """Return the lens of layouts without cameras."""
    return Optics(focal_length_mm=DEFAULT_FOCAL_MM, f_number=DEFAULT_F_NUMBER)


def field_um(layouts: Iterable[Layout]) -> float:
    """Return the side of the smallest centred square that contains all layouts, µm."""
    return 2.0 * max(float(np.abs(layout.bounds_um).max()) for layout in layouts)


def photograph_scenes(
    width_um: Annotated[float, POSITIVE],
    optics: Optics | None = None,
    *,
    pictures: Sequence[str | Path] | Mapping[str, NDArray[np.uint8]] | None = None,
    distance_m: Annotated[float, POSITIVE] = DEFAULT_DISTANCE_M,
    peak_radiance_w_m2_sr_nm: float = DEFAULT_RADIANCE_W_M2_SR_NM,
    wavelength_nm: Sequence[float] = (DEFAULT_WAVELENGTH_NM,),
    band_width_nm: float | Sequence[float] | None = DEFAULT_BAND_NM,
) -> dict[str, Scene]:
    """
    Return scenes of photographs, cropped to squares, whose images fill a field.

    Parameters
    ----------
    width_um : float, µm
        Side of the field on the sensor; the scenes are 4 % wider.
    optics : Optics, optional
        By default a lens of 8 mm and f/2.8.
    pictures : sequence of paths, or mapping of str to arrays, optional
        Photographs, in the colours that files state; arrays sRGB-encoded. By default five of scikit-image.
    distance_m, peak_radiance_w_m2_sr_nm, wavelength_nm, band_width_nm
        As for :meth:`Scene.from_picture`.

    Returns
    -------
    dict of str to Scene

    Raises
    ------
    ParameterError
        When a value is out of range, or two pictures have the same name.
    FileError
        When a picture cannot be read.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> pictures = {"ramp": np.tile(np.arange(64, dtype=np.uint8), (48, 1))}
    >>> scenes = fs.compare.photograph_scenes(
    ...     200.0, pictures=pictures
    ... )  # cropped to 48 x 48 pixels
    >>> lens = fs.Optics(focal_length_mm=8.0, f_number=2.8)
    >>> round(
    ...     scenes["ramp"].pitch_um * 48 * lens.magnification(1.0), 1
    ... )  # image size, 4 % larger than the field
    208.0
    """
    optics = default_optics() if optics is None else optics
    if pictures is None:
        directory = files("skimage.data")
        pictures = [Path(str(directory / name)) for name in DEFAULT_PICTURES]
    if isinstance(pictures, Mapping):
        photographs = {str(name): as_encoded(picture) for name, picture in pictures.items()}
    else:
        photographs = {}
        for path in pictures:
            name = Path(path).stem
            if name in photographs:
                raise ParameterError("pictures", "must have unique file names", name)
            photographs[name] = as_encoded(path)
    if not photographs:
        raise ParameterError("pictures", "must contain at least one picture")
    scenes = {}
    for name, photograph in photographs.items():
        square: Any = _central_square(photograph)
        scenes[name] = Scene.from_picture(
            square,
            pitch_um=FIELD_MARGIN * width_um / (optics.magnification(distance_m) * square.pixels.shape[0]),
            distance_m=distance_m,
            peak_radiance_w_m2_sr_nm=peak_radiance_w_m2_sr_nm,
            wavelength_nm=wavelength_nm,
            band_width_nm=band_width_nm,
        )
    return scenes


def cameras_of(
    layouts: Mapping[str, Layout], optics: Optics | None, sensor: Callable[[Layout], Sensor] | None
) -> dict[str, Camera]:
    """Return a camera per layout, with the same lens and a sensor of the same design."""
    lens = default_optics() if optics is None else optics
    return {
        name: Camera(optics=lens, sensor=(default_sensor if sensor is None else sensor)(layout))
        for name, layout in layouts.items()
    }


def _central_square(picture: EncodedPicture) -> EncodedPicture:
    """Return the largest square around the centre of a picture."""
    n_y, n_x = picture.pixels.shape[:2]
    n = min(n_y, n_x)
    y, x = (n_y - n) // 2, (n_x - n) // 2
    return picture.crop(slice(y, y + n), slice(x, x + n))

"""Images of the cameras of a comparison, their photons and spectra, and the common field."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats
from foveasim.camera import Camera
from foveasim.camera._framing import turned_instead
from foveasim.compare.annuli import Annuli
from foveasim.fields import Grid, PowerMap
from foveasim.reconstruct import reference
from foveasim.scene import Scene
from foveasim.sensor import Sensor
from foveasim.units import photon_energy_j, w_from_w_m2_um2

#: Images whose covariance is fitted: pixels per side of the smallest site, smallest and largest number along the field.
SITE_PIXELS, MIN_FIELD_PIXELS, MAX_FIELD_PIXELS = 4, 256, 2048
#: Relative margin of the outermost annulus.
EDGE_ROUNDING = 1e-9


def with_angular_response(camera: Camera, light: Scene | PowerMap) -> Sensor:
    """Return the sensor with its known response to cones of light, for corrections."""
    if camera.sensor.pixel_optics is None:
        return camera.sensor
    return camera.sensor.with_angular_response(camera.angular_response(light))


def framed(camera: Camera, light: Scene | PowerMap) -> tuple[Camera, Scene | PowerMap]:
    """Return a scene with its pitch, or a power map, and the camera for it."""
    camera, light = turned_instead(camera, light)
    return camera, camera.fit_scene(light) if isinstance(light, Scene) else light


def image_of(camera: Camera, light: Scene | PowerMap, maps: dict[tuple[float, float], PowerMap]) -> PowerMap:
    """
    Return the ideal image that a camera sees.

    ``maps``: images by the direction of the camera, which are computed once.
    """
    turned_um = camera.gaze_um if camera.axis == "sensor" else (0.0, 0.0)
    if turned_um not in maps:
        maps[turned_um] = camera.power_map(light) if isinstance(light, Scene) else light
    return maps[turned_um]


def photons_per_um2(image: PowerMap, grid: Grid, exposure_s: float) -> Floats:
    """Return the mean number of photons per area of each pixel of a grid, (n_y, n_x)."""
    per_w_m2 = float(w_from_w_m2_um2(exposure_s)) / photon_energy_j(image.wavelength_nm)
    return np.asarray(reference(image, grid, weights=per_w_m2[np.newaxis]).data[0], np.float64)


class Spectrum(NamedTuple):
    """Mean irradiance of each band of an image, W/m²."""

    wavelength_nm: Floats
    irradiance_w_m2: Floats


def mean_spectrum(image: PowerMap, grid: Grid) -> Spectrum:
    """Return the mean spectrum of an image in a field; in all of it if it has no part there."""
    x0_um, y0_um, x1_um, y1_um = grid.bounds_um
    is_x, is_y = (
        (low <= at) & (at <= high)
        for low, at, high in ((x0_um, image.grid.x_um, x1_um), (y0_um, image.grid.y_um, y1_um))
    )
    cells = image.data[:, is_y][:, :, is_x] if is_x.any() and is_y.any() else image.data
    return Spectrum(image.wavelength_nm, cells.mean(axis=(1, 2), dtype=np.float64))


def e_per_photon(sensor: Sensor, spectra: Sequence[Spectrum]) -> Floats:
    """Return the electrons of each filter per photon of the sum of spectra."""
    electrons = sum(sensor.responsivity_e_per_j(one.wavelength_nm) @ one.irradiance_w_m2 for one in spectra)
    n_photons = sum(float((one.irradiance_w_m2 / photon_energy_j(one.wavelength_nm)).sum()) for one in spectra)
    return np.asarray(electrons / n_photons, np.float64)


def behind_image(camera: Camera) -> Camera:
    """Return a camera for its own power maps, which already have its gaze if it turns."""
    return camera if camera.axis == "image" else camera.with_gaze((0.0, 0.0))


def field_of(
    cameras: Sequence[Camera], centre_um: tuple[float, float], n_annuli: int, max_pixels: int
) -> tuple[Annuli, Grid, Grid]:
    """Return annuli and picture grid of the common field, and the image grid for covariances."""
    all_layouts = [camera.layout for camera in cameras]
    bounds_um = np.array([layout.bounds_um for layout in all_layouts])
    low, high = bounds_um[:, :2].min(axis=0), bounds_um[:, 2:].max(axis=0)
    seen_um = bounds_um + np.tile([camera.gaze_um for camera in cameras], 2)
    low_seen, high_seen = seen_um[:, :2].min(axis=0), seen_um[:, 2:].max(axis=0)
    site_um = min(math.sqrt(float(layout.area_um2.min())) for layout in all_layouts)
    n_pixels = math.ceil(SITE_PIXELS * float((high_seen - low_seen).max()) / site_um)
    reach_um = max(float(np.hypot(*(layout.centroid_um - centre_um).T).max()) for layout in all_layouts)
    return (
        Annuli(centre_um, np.linspace(0.0, reach_um * (1.0 + EDGE_ROUNDING), n_annuli + 1)),
        grid_of(low, high, max_pixels),
        grid_of(low_seen, high_seen, min(max(n_pixels, MIN_FIELD_PIXELS), MAX_FIELD_PIXELS)),
    )


def grid_of(low: NDArray[np.float64], high: NDArray[np.float64], max_pixels: int) -> Grid:
    """Return a grid of square pixels over a rectangle."""
    pitch_um = float((high - low).max()) / max_pixels
    n_x, n_y = (int(np.ceil(length / pitch_um - 1e-6)) for length in high - low)
    centre = 0.5 * (low + high)
    return Grid(
        (n_y, n_x), pitch_um, (float(centre[0] - 0.5 * n_x * pitch_um), float(centre[1] - 0.5 * n_y * pitch_um))
    )

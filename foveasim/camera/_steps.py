"""Steps of a capture, shared by the camera and its tiles."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.provenance import to_plain_data, versions
from foveasim._core.random_streams import Streams
from foveasim._core.validation import Bools, Floats, read_only
from foveasim.camera._clock import Clock
from foveasim.camera._colour import colour_correction, white_response
from foveasim.camera._exposure import AUTO_SETTINGS, ExposureTime, exposure_time
from foveasim.camera._warnings import warn_of_exposure, warn_of_negative
from foveasim.capture import Capture
from foveasim.distortion import Lens
from foveasim.errors import SimulationError
from foveasim.fields import Grid, PowerMap
from foveasim.integrate import Integrator
from foveasim.layout.model import Layout
from foveasim.scene import Scene
from foveasim.sensor import Footprints, Sensor
from foveasim.units import w_from_w_m2_um2

if TYPE_CHECKING:
    from foveasim.camera._camera import Camera

#: Fourier transforms in float32 leave negative rates of up to this fraction of the largest one.
NEGATIVE_ROUNDING = 1e-4


class WeightedMap(NamedTuple):
    """
    A power map, and the sites to which it contributes.

    ``image``: index of the integrator for the grid of the map. ``where`` (n_site,): sites to which the map contributes, None
    for all. ``weight`` (n_site,): factor of their powers, None for 1.
    """

    image: int
    cells: NDArray[Any]
    where: Bools | None
    weight: Floats | None


class SensorFrame(NamedTuple):
    """
    Frame of the sensor, in which the image of a lens is scaled along x and y.

    ``axis_um`` (x, y): where the optical axis meets the image plane. ``scale`` (2,): factors of the image's width and height.
    """

    axis_um: tuple[float, float]
    scale: Floats

    @classmethod
    def of(cls, lens: Lens | None, axis_um: tuple[float, float] = (0.0, 0.0)) -> SensorFrame:
        """Return the frame of a lens model; without a model, use ``axis_um`` and equal scales."""
        if lens is None:
            return cls(axis_um, np.ones(2))
        focal_um = np.broadcast_to(np.asarray(lens.focal_um), (2,))
        return cls(lens.centre_um, focal_um / math.sqrt(focal_um[0] * focal_um[1]))

    def image(self, grid: Grid) -> Grid:
        """Return a grid of the optics, which is centred on the axis, in this frame."""
        pitch_x_um, pitch_y_um = grid.pitch_xy_um * self.scale
        x0_um, y0_um = np.array(self.axis_um) + grid.origin_um * self.scale
        return Grid(grid.shape, (float(pitch_x_um), float(pitch_y_um)), (float(x0_um), float(y0_um)))


def integrate_maps(
    sensor: Sensor,
    light: Scene | PowerMap,
    maps: Iterable[WeightedMap],
    integrators: Sequence[Integrator],
    clock: Clock,
    footprints: Footprints | None = None,
) -> Floats:
    """
    Return the sums of weighted maps over every site, photoelectrons per second.

    ``footprints``: the light that sites collect within the outlines of the integrators; None for all of it.
    """
    rate_e_per_s = np.zeros(sensor.layout.n_sites)
    for image, cells, where, weight in maps:
        with clock.stage("integration"):
            if image == 0 and weight is None:  # each site belongs to one filter
                integrators[0](cells, where=where, out=rate_e_per_s)
            else:
                power = integrators[image](cells, where=where)
                rate_e_per_s += power if weight is None else np.multiply(power, weight, out=power)
        del cells
    with clock.stage("integration"):
        rate_e_per_s *= w_from_w_m2_um2(1.0)
        _check_rates(light, rate_e_per_s, integrators[0].order)
        np.maximum(rate_e_per_s, 0.0, out=rate_e_per_s)
        return rate_e_per_s if footprints is None else footprints.apply(rate_e_per_s, out=rate_e_per_s)


def _check_rates(light: Scene | PowerMap, rate_e_per_s: Floats, order: int) -> None:
    """Raise or warn when rates are not finite, or negative beyond rounding."""
    # Minimum and maximum propagate NaN, and need no array.
    lowest, highest = (float(find(rate_e_per_s, initial=0.0)) for find in (np.min, np.max))
    if lowest == 0.0 and highest < np.inf:
        return
    if not np.isfinite(rate_e_per_s).all():
        bad = int(np.flatnonzero(~np.isfinite(rate_e_per_s))[0])
        raise SimulationError(f"irradiance on site {bad} must be finite; the power map contains NaN or infinity there")
    is_negative = rate_e_per_s < -NEGATIVE_ROUNDING * highest
    if not is_negative.any():
        return
    if isinstance(light, PowerMap) and (order == 1 or np.nanmin(light.data) < 0.0):
        bad = int(rate_e_per_s.argmin())
        raise SimulationError(f"irradiance on site {bad} must be >= 0; the power map is negative there")
    if order == 2:
        warn_of_negative(rate_e_per_s, is_negative)


def seconds_of(camera: Camera, exposure_s: ExposureTime, photo_e_per_s: Floats) -> float:
    """Return an exposure time in seconds."""
    time_s = exposure_time(exposure_s, camera.optics.f_number)
    return camera.sensor.exposure_for(photo_e_per_s, n_threads=camera.n_threads) if time_s == "auto" else time_s


def capture_for_time(
    camera: Camera,
    light: Scene | PowerMap,
    photo_e_per_s: Floats,
    exposure_s: ExposureTime,
    streams: Streams,
    clock: Clock,
    **settings: Any,
) -> Capture:
    """Return the capture of photoelectron rates for a time, or with automatic exposure."""
    settings |= AUTO_SETTINGS if exposure_s == "auto" else {}
    with clock.stage("sensor"):
        time_s = seconds_of(camera, exposure_s, photo_e_per_s)
    return capture_rates(camera, camera.sensor, light, photo_e_per_s, time_s, streams, clock, **settings)


def check_exposure(camera: Camera, light: Scene | PowerMap, photo_e_per_s: Floats, capture: Capture) -> None:
    """Warn of an exposure that is wrong for the scene."""
    exposure_s = float(capture.settings["exposure_s"])
    if isinstance(light, Scene) and exposure_s > 0.0:
        warn_of_exposure(camera.sensor, photo_e_per_s, exposure_s, capture, camera._warned, is_picture=light.is_picture)


def capture_rates(
    camera: Camera,
    sensor: Sensor,
    light: Scene | PowerMap,
    photo_e_per_s: Floats,
    exposure_s: float,
    streams: Streams,
    clock: Clock,
    **settings: Any,
) -> Capture:
    """Return the capture of photoelectron rates by the sensor of a camera, or by a part of it."""
    about = capture_settings(camera, light, exposure_s, streams) | settings
    with clock.stage("sensor"):
        expected_e, electrons, code = sensor.expose(
            photo_e_per_s, exposure_s, n_threads=camera.n_threads, _streams=streams
        )
    assert isinstance(sensor.layout, Layout)  # as in every camera
    return Capture(
        layout=sensor.layout,
        code=read_only(code),
        electrons=read_only(electrons),
        expected_e=read_only(expected_e),
        filter_of_site=sensor.filter_of_site,
        filter_names=sensor.filter_names,
        bits=sensor.bits,
        white_dn=white_dn(sensor, light),
        settings=about,
        stage_s=clock.stage_s,
        electronics=sensor,
    )


def white_dn(sensor: Sensor, light: Scene | PowerMap) -> Floats:
    """Return the code of white of each filter, up to a common factor."""
    return white_response(sensor, light) * (2**sensor.bits - 1)


def capture_settings(camera: Camera, light: Scene | PowerMap, exposure_s: float, streams: Streams) -> dict[str, Any]:
    """Return the settings of a capture, as plain data."""
    colour = colour_correction(camera.sensor, light)
    return {
        "light": _light_settings(camera, light),
        "colour": None if colour is None else colour.to_settings(),
        **camera.settings,
        "gaze_um": list(camera.gaze_um),
        **({"gaze_deg": list(camera.gaze_deg)} if any(camera.gaze_deg) else {}),
        "axis": camera.axis,
        "oversample": camera.oversample(light),
        "integration_order": camera.order(light),
        "exposure_s": exposure_s,
        "seed": streams.seed,
        "frame": streams.frame,
        "versions": versions(),
    }


def _depth_settings(scene: Scene) -> dict[str, object]:
    """Return the distances of a scene with depth."""
    if scene.depth_m is None:
        return {}
    return {"depth_m": to_plain_data(scene.depth_m), "depth_layers": scene.depth_layers}


def _light_settings(camera: Camera, light: Scene | PowerMap) -> dict[str, object]:
    if isinstance(light, PowerMap):
        return {
            "kind": "PowerMap",
            "grid": to_plain_data(light.grid),
            "wavelength_nm": light.wavelength_nm.tolist(),
        }
    framed, panorama = camera.geometry_of(light), light.panorama
    assert isinstance(framed, Scene)
    # The settings of a plane do not mention the projection.
    directions = {} if framed.projection == "rectilinear" and panorama is None else {"projection": framed.projection}
    if panorama is not None:
        directions |= {"panorama": to_plain_data(panorama)}
    return {
        "kind": "Scene",
        "source": light.source,
        "shape": list(light.basis.shape),
        "pitch_um": framed.pitch_um,
        **directions,
        "fit": light.fit,
        "field_of_view_deg": light.field_of_view_deg,
        "distance_m": light.distance_m,
        **_depth_settings(light),
        "wavelength_nm": light.wavelength_nm.tolist(),
        "band_width_nm": light.band_width_nm.tolist(),
        "spectrum_w_m2_sr_nm": to_plain_data(light.spectrum_w_m2_sr_nm),
        "illuminant": to_plain_data(light.illuminant),
    }

"""Metric of the reconstructed picture: PSNR against the picture of an ideal sensor."""

from __future__ import annotations

from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.config import Shot
from foveasim.explore._metrics import METRICS, REFERENCES
from foveasim.metrics import psnr_db
from foveasim.reconstruct import Picture, raster_grid

__all__ = ["ideal_picture", "picture_psnr_db"]


#: Side of the compared pictures, pixels.
PSNR_PIXELS = 256


def ideal_picture(shot: Shot, camera: Camera) -> Picture:
    """Return the noise-free picture of an ideal sensor for a scene, layout and exposure."""
    grid = raster_grid(camera.sensor.layout, PSNR_PIXELS)
    return camera.reference(shot.scene, grid, exposure_s=shot.exposure_s)


@METRICS.register("psnr_db")
def picture_psnr_db(shot: Shot, camera: Camera, capture: Capture, reference: Picture | None = None) -> float:
    """
    Compute the PSNR of the reconstructed picture against the ideal picture, dB.

    Both are rasters of photoelectrons per µm²; the reference is that of :func:`ideal_picture`.
    """
    reference = ideal_picture(shot, camera) if reference is None else reference
    picture = capture.picture(of="light_e", per="um2", grid=reference.grid, sensor=camera.sensor)
    return psnr_db(picture, reference)


REFERENCES[picture_psnr_db] = ideal_picture

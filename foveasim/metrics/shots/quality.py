"""Metrics of the reconstructed picture, against the picture of an ideal sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.errors import SimulationError
from foveasim.fields import Grid
from foveasim.layout import Layout
from foveasim.metrics.quality import psnr_db, ssim
from foveasim.metrics.registry import METRICS, MetricInfo, MetricShot, Region, centre_um_of
from foveasim.reconstruct import Picture, raster_grid

__all__ = ["ideal_picture", "picture_psnr_db", "picture_ssim"]

#: Side of the compared pictures, pixels.
PICTURE_PIXELS = 256


def ideal_picture(shot: MetricShot, camera: Camera, region: Region | None = None) -> Picture:
    """Return the noise-free picture of an ideal sensor for a scene, layout and exposure."""
    return camera.reference(shot.scene, _grid_of(camera.layout, region), exposure_s=shot.exposure_s)


@METRICS.register(
    "psnr_db",
    info=MetricInfo(
        better="high",
        title="PSNR",
        unit="dB",
        definition="peak signal-to-noise ratio of the picture, with the range of the ideal picture as peak",
        is_of_signals=True,
        reference=ideal_picture,
    ),
)
def picture_psnr_db(
    shot: MetricShot, camera: Camera, capture: Capture, reference: Picture | None = None, region: Region | None = None
) -> float:
    """
    Compute the PSNR of the reconstructed picture against the ideal picture, dB.

    Both are rasters of photoelectrons per µm²; the reference is that of :func:`ideal_picture`.
    """
    reference = ideal_picture(shot, camera, region) if reference is None else reference
    return psnr_db(_picture(camera, capture, reference.grid, region), reference)


@METRICS.register(
    "ssim",
    info=MetricInfo(
        better="high",
        title="SSIM",
        definition="structural similarity of the picture and the ideal picture",
        is_of_signals=True,
        reference=ideal_picture,
    ),
)
def picture_ssim(
    shot: MetricShot, camera: Camera, capture: Capture, reference: Picture | None = None, region: Region | None = None
) -> float:
    """Compute the structural similarity of the reconstructed picture and the ideal picture."""
    reference = ideal_picture(shot, camera, region) if reference is None else reference
    return ssim(_picture(camera, capture, reference.grid, region), reference)


def _has_extent(region: Region | None) -> bool:
    return region is not None and (region.annulus_um is not None or region.rectangle_um is not None)


def _grid_of(layout: Layout, region: Region | None) -> Grid:
    """Return the raster of a layout, or of the bounding box of a region."""
    if region is not None and region.site is not None:
        raise SimulationError(f"{region.subject}: a picture quality needs an annulus or a rectangle")
    if region is None or not _has_extent(region):
        return raster_grid(layout, PICTURE_PIXELS)
    if region.rectangle_um is not None:
        x0, y0, x1, y1 = region.rectangle_um
    else:
        assert region.annulus_um is not None
        x, y = centre_um_of(layout)
        outer_um = region.annulus_um[1]
        x0, y0, x1, y1 = x - outer_um, y - outer_um, x + outer_um, y + outer_um
    pitch_um = max(x1 - x0, y1 - y0) / PICTURE_PIXELS
    shape = (max(1, round((y1 - y0) / pitch_um)), max(1, round((x1 - x0) / pitch_um)))
    return Grid(shape, ((x1 - x0) / shape[1], (y1 - y0) / shape[0]), (x0, y0))


def _picture(camera: Camera, capture: Capture, grid: Grid, region: Region | None) -> Picture:
    """Return the picture of a capture; NaN outside an annulus."""
    picture = capture.picture(of="light_e", per="um2", grid=grid, sensor=camera.sensor)
    if region is None or region.annulus_um is None:
        return picture
    x_um, y_um = (
        origin + (np.arange(n) + 0.5) * step
        for origin, n, step in zip(grid.origin_um, grid.shape[::-1], (grid.pitch_x_um, grid.pitch_y_um), strict=True)
    )
    centre = centre_um_of(capture.layout)
    radius_um = np.hypot(x_um - centre[0], (y_um - centre[1])[:, None])
    inner, outer = region.annulus_um
    return replace(picture, data=np.where((radius_um >= inner) & (radius_um < outer), picture.data, np.nan))

"""
Scenes of targets, and their photoelectrons on the sensor of the simulated camera.

Patches and edges are at the places where the frames show them.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Bools, Floats, Ints
from foveasim.camera import Camera
from foveasim.errors import SamplingWarning, SimulationError
from foveasim.metrics.slanted_edge import EdgeMtf
from foveasim.scene import Scene, charts
from foveasim.scene._illuminants import Illuminant
from foveasim.scene._photometry import level_of_white

__all__ = [
    "WAVES_NM",
    "WIDTHS_NM",
    "axis_um",
    "check_slanted",
    "edge_rates",
    "painted_rates",
    "undistorted",
    "white_of",
]

#: Bands of the scenes, and the illuminance of their white at the light factor 1.
WAVES_NM = np.arange(400.0, 701.0, 10.0)
WIDTHS_NM = np.full(WAVES_NM.size, 10.0)
ILLUMINANCE_LUX = 1000.0
#: Largest number of cells along the picture of painted patches, which are much larger than cells.
MAX_CELLS = 1024
#: Pixels of the chart of an edge per photosite, and their largest number along its side.
EDGE_PIXELS, MAX_EDGE_PIXELS = 8, 4096
#: Smallest number of rows or columns of photosites that an edge crosses.
MIN_CROSSED = 2
#: Sites around the region of an edge that are simulated, too.
MARGIN_SITES = 8


def white_of(illuminant: Illuminant) -> Floats:
    """Return the radiance of white at factor 1, (n_wavelength,) W/(m² sr nm)."""
    relative = charts.illuminant(illuminant, WAVES_NM)
    level = level_of_white("illuminance_lux", None, relative, WAVES_NM, WIDTHS_NM, illuminance_lux=ILLUMINANCE_LUX)
    return np.asarray(level * relative)


def axis_um(camera: Camera) -> Floats:
    """Return where the optical axis meets the sensor, (2,) µm."""
    if camera.distortion is not None:
        return np.array(camera.distortion.centre_um)
    bounds_um = camera.layout_bounds_um
    return 0.5 * (bounds_um[:2] + bounds_um[2:])


def undistorted(camera: Camera, xy_um: Floats) -> Floats:
    """Return points (n, 2) in the ideal image."""
    return xy_um if camera.distortion is None else camera.distortion.undistort(xy_um)


def painted_rates(
    camera: Camera, sites: Ints, patches: Ints, weights: Floats, spectra: Floats, white: Floats, distance_m: float
) -> tuple[Scene, Floats]:
    """
    Return the scene of uniform patches, and the rates of all sites.

    ``sites`` (n_y, n_x): sites of a regular sensor. ``patches`` (n_site,): patch of each site. Sites without a patch, -1, have
    the light of the nearest one, and those with the number after the last patch are black. ``weights`` (n_basis, n_patch),
    ``spectra`` (n_basis, n_wavelength): spectral radiance of each patch. ``white`` (n_wavelength,): that of white.
    """
    from scipy.ndimage import distance_transform_edt

    step = math.ceil(max(sites.shape) / MAX_CELLS)
    shape = max(sites.shape[0] // step, 1), max(sites.shape[1] // step, 1)

    def scene_of(basis: NDArray[Any], spectra: Floats) -> Scene:
        return Scene(
            basis, spectra, WAVES_NM, WIDTHS_NM, None, distance_m, fit="cover", source="patches", illuminant=white
        )

    # Otherwise, images of cells of the size of sites would be computed on many finer cells.
    camera = camera.replace(optics=replace(camera.optics, oversample=1))
    grid = camera.image_grid(scene_of(np.ones((1, *shape), np.float32), white[np.newaxis]))
    xy = (undistorted(camera, camera.layout.centroid_um) - grid.origin_um) / grid.pitch_xy_um
    column, row = np.clip(xy.astype(np.int64), 0, np.array(shape[::-1]) - 1).T
    cells = np.full(shape, -1)
    is_patch = patches >= 0
    cells[row[is_patch], column[is_patch]] = patches[is_patch]
    nearest = distance_transform_edt(cells < 0, return_distances=False, return_indices=True)
    cells = cells[tuple(nearest)]
    scene = scene_of(np.pad(weights, ((0, 0), (0, 1)))[:, cells].astype(np.float32), spectra)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)  # sites are within uniform patches
        return scene, camera.photoelectrons_per_s(scene)


def check_slanted(camera: Camera, used: Bools, edge: EdgeMtf) -> None:
    """Raise a SimulationError when an edge is nearly parallel to rows or columns."""
    slopes = abs(np.cos(np.deg2rad(edge.angle_deg))), abs(np.sin(np.deg2rad(edge.angle_deg)))
    length_um = np.ptp(camera.layout.centroid_um[used], axis=0)[int(slopes[0] > slopes[1])]
    if length_um * min(slopes) / max(slopes) < MIN_CROSSED * math.sqrt(float(np.median(camera.layout.area_um2[used]))):
        raise SimulationError(
            f"the edge at {edge.angle_deg:.2g} degrees must cross at least {MIN_CROSSED} rows or columns of photosites; rotate "
            "it by a few degrees, or use a larger region"
        )


def edge_rates(camera: Camera, used: Bools, edge: EdgeMtf, white: Floats, distance_m: float) -> Floats:
    """Return the rates of sites from an edge at the place of a real one; 0 far away."""
    layout, pitch_um = camera.layout, math.sqrt(float(np.median(camera.layout.area_um2)))
    margin_um = MARGIN_SITES * pitch_um
    xy_um = layout.centroid_um
    low_um, high_um = xy_um[used].min(axis=0) - margin_um, xy_um[used].max(axis=0) + margin_um
    sites = np.flatnonzero(np.all((xy_um >= low_um) & (xy_um <= high_um), axis=1))
    # The point of the edge next to the centre of the region, and the direction of the edge, without distortion.
    normal = np.array([np.cos(np.deg2rad(edge.angle_deg)), np.sin(np.deg2rad(edge.angle_deg))])
    centre_um = 0.5 * (low_um + high_um)
    at_um = centre_um + (edge.offset_um - centre_um @ normal) * normal
    along_um = margin_um * np.array([-normal[1], normal[0]])
    start_um, at_um, end_um = undistorted(camera, np.array([at_um - along_um, at_um, at_um + along_um]))
    angle_deg = float(np.rad2deg(np.arctan2(*(end_um - start_um)[::-1]))) - 90.0
    half_um = np.abs(undistorted(camera, xy_um[sites]) - at_um).max(axis=0) + margin_um
    n_pixels = min(EDGE_PIXELS, max(2, int(MAX_EDGE_PIXELS * pitch_um / (2.0 * half_um.max()))))
    magnification = camera.optics.magnification(distance_m)
    scene = charts.slanted_edge(
        angle_deg=(angle_deg + 180.0) % 360.0 - 180.0,
        contrast=float(np.clip(edge.contrast, 0.0, 1.0)),
        shape=tuple(np.ceil(2.0 * half_um[::-1] / pitch_um * n_pixels).astype(int).tolist()),
        pitch_um=pitch_um / n_pixels / magnification,
        distance_m=distance_m,
        radiance_w_m2_sr_nm=white.tolist(),
        wavelength_nm=WAVES_NM.tolist(),
    )
    frame = camera.sensor_frame(scene)
    x_um, y_um = ((at_um - np.array(frame.axis_um)) / (frame.scale * magnification)).tolist()
    # Effects between sites follow when frames are drawn.
    sensor = camera.sensor.without(*(effect.name for effect in camera.sensor.chain if effect.reach == "all"))
    rate_e_per_s = np.zeros(layout.n_sites)
    rate_e_per_s[sites] = camera.replace(sensor=sensor.part(sites)).photoelectrons_per_s(
        scene.with_centre((x_um, y_um))
    )
    return rate_e_per_s

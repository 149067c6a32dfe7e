"""Point spread function of the lens at photosites."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from foveasim.scene import Scene
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, curves_of, label_of, part

#: Samples of a section, and half its length in λN beyond the blur.
N_SAMPLES, MARGIN_LAMBDA_N = 129, 4.0
#: Largest number of photosites whose PSFs are shown.
MAX_SHOWN = 2


def _lens_of(result: Simulated) -> tuple[Any, ...]:
    camera = result.shot.camera
    numbers = (*camera.position_um, *result.pinned)
    return result.capture.layout, camera.optics, camera.distortion, result.shot.scene, numbers


@part("Point spread", _lens_of, order=82, group="See", is_lazy=True)
def psf(result: Simulated) -> PartData:
    """Return sections of the PSF at pinned photosites, or nearest and farthest from the axis."""
    camera, source = result.shot.camera, result.shot.scene
    if not isinstance(source, Scene):
        return {"curves": [], "note": "A power map contains the point spread of its lens."}, {}
    scene, frame = camera.light_at_gaze(source), camera.sensor_frame(source)
    lens = camera.lens_for(scene)
    points_um = camera.layout.centroid_um + np.array(camera.position_um)
    height_um = np.hypot(*(points_um - frame.axis_um).T)
    chosen = {"nearest": int(height_um.argmin()), "farthest": int(height_um.argmax())}
    if result.pinned:
        chosen = {label_of(site): site for site in result.pinned[:MAX_SHOWN]}
    optics, wavelength_nm = camera.optics, float(np.median(scene.wavelength_nm))
    lambda_n_um = float(optics.cut_off_um(wavelength_nm, scene.distance_m))
    curves, x, y, notes = [], [], [], []
    for name, site in chosen.items():
        at_um = points_um[site]
        if lens is not None:
            at_um = lens.undistort(at_um, outside="mask")
        field_um = (at_um - frame.axis_um) / frame.scale
        if np.isnan(field_um).any():
            notes.append(f"{name} outside the image circle")
            continue
        field = float(field_um[0]), float(field_um[1])
        blur = optics.aperture(scene).blur_lambda_n(wavelength_nm, field)
        half_um = lambda_n_um * (MARGIN_LAMBDA_N + blur)
        found = optics.psf(
            wavelength_nm,
            distance_m=scene.distance_m,
            field_um=field,
            n_points=N_SAMPLES,
            pitch_um=2.0 * half_um / (N_SAMPLES - 1),
        )
        for along, section in (("x", found.psf_per_um2[N_SAMPLES // 2]), ("y", found.psf_per_um2[:, N_SAMPLES // 2])):
            curves.append({"label": f"{name}, {along}", "unit_x": "µm", "unit_y": "1/µm²"})
            x.append(found.grid.x_um)
            y.append(section)
        side_um = math.sqrt(float(camera.layout.area_um2[site]))
        energy = float(optics.ensquared_energy(side_um, wavelength_nm, distance_m=scene.distance_m, field_um=field))
        notes.append(f"{name} {energy:.0%}")
    about, arrays = curves_of(curves, x, y)
    return about | {
        "note": f"{wavelength_nm:g} nm; light within a square of the site's area: {', '.join(notes)}"
    }, arrays

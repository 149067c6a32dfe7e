"""Warnings of captures: coverage, exposure, focal lengths, coarse cells and pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from foveasim._core.validation import Bools, Floats
from foveasim.capture import Capture
from foveasim.distortion import Lens
from foveasim.errors import CoverageWarning, ExposureWarning, FoveasimWarning, ParameterError, SamplingWarning, warn
from foveasim.fields import Grid, PointMap, PowerMap
from foveasim.incidence import Incidence
from foveasim.integrate import Integrator
from foveasim.layout.model import Layout
from foveasim.optics import Optics
from foveasim.scene import Scene
from foveasim.sensor import Sensor
from foveasim.units import um_from_m, um_from_nm

#: Cameras warn when the layout measures less than this fraction of the width of a photograph.
MIN_PICTURE_FRACTION = 0.25
#: Cameras warn when the focal length of the lens model differs from the image distance by more than this fraction.
MAX_FOCAL_DIFFERENCE = 0.02
#: Cameras warn when a larger fraction of the sites is saturated, or smaller than the pixels of a photograph.
MAX_SATURATED, MAX_BELOW_PIXELS = 0.2, 0.1
#: Cameras warn of openings of pixel optics that measure fewer wavelengths in their layer.
MIN_OPENING_WAVELENGTHS = 2.0
#: Cameras with pixel optics warn of more oblique chief rays.
MAX_CHIEF_RAY_DEG = 60.0
#: Error of photosites above which a limited automatic oversampling causes a warning.
MAX_AUTO_ERROR = 1e-3


class Covered(NamedTuple):
    """
    Numbers of sites beyond an image, among them those outside the image circle.

    ``image_um`` and ``layout_um`` are bounds (x_min, y_min, x_max, y_max), µm.
    """

    image_um: tuple[float, float, float, float]
    layout_um: tuple[float, float, float, float]
    n_uncovered: int
    n_outside: int

    @classmethod
    def by(cls, integrator: Integrator) -> Covered:
        """Return the coverage of an integrator's sites by its grid."""
        n_outside = integrator.sites_outside_image_circle.size
        return cls(integrator.grid.bounds_um, integrator.bounds_um, integrator.n_uncovered, n_outside)

    @classmethod
    def of(
        cls, layout: Layout, bounds_um: Sequence[float], grid: Grid, distortion: PointMap | None, n_threads: int
    ) -> Covered:
        """
        Return the coverage of a layout by a grid.

        ``bounds_um``: of its undistorted outlines. Without distortion, sites are examined only if these exceed the grid.
        """
        x0_um, y0_um, x1_um, y1_um = bounds_um
        low_x_um, low_y_um, high_x_um, high_y_um = grid.bounds_um
        is_inside = low_x_um <= x0_um and low_y_um <= y0_um and x1_um <= high_x_um and y1_um <= high_y_um
        if distortion is None and is_inside:
            return cls(grid.bounds_um, (x0_um, y0_um, x1_um, y1_um), 0, 0)
        return cls.by(Integrator(layout, grid, distortion=distortion, compiled=False, n_threads=n_threads))

    @classmethod
    def union(cls, image_um: tuple[float, float, float, float], parts: Sequence[Covered]) -> Covered:
        """Return the coverage of the sites of all parts by an image."""
        bounds_um = np.array([part.layout_um for part in parts])
        x0, y0 = np.fmin.reduce(bounds_um[:, :2])
        x1, y1 = np.fmax.reduce(bounds_um[:, 2:])
        n_uncovered, n_outside = (sum(part.n_uncovered for part in parts), sum(part.n_outside for part in parts))
        return cls(image_um, (float(x0), float(y0), float(x1), float(y1)), n_uncovered, n_outside)


def warn_of_coverage(
    source: Scene | PowerMap,
    covered: Covered,
    n_sites: int,
    gaze_um: Sequence[float] | None = None,
    warned: set[str] | None = None,
) -> None:
    """
    Warn of sites outside the image, and of a layout that measures a small part of it.

    Sites outside are dark whatever the scene is. ``gaze_um``: None at the centre. ``warned``: causes of earlier warnings, which
    are not repeated.
    """
    warned = set() if warned is None else warned
    if covered.n_outside and "image circle" not in warned:
        warned.add("image circle")
        warn(
            f"{covered.n_outside:,} of {n_sites:,} photosites lie outside the image circle of the lens and "
            "are dark; shrink or move the layout, or use a lens model with a larger field",
            CoverageWarning,
        )
    is_photograph = isinstance(source, Scene) and source.is_picture
    fit = source.fit if isinstance(source, Scene) else None
    if fit in ("contain", "width") or "image" in warned:
        return
    image_um, layout_um = covered.image_um, covered.layout_um
    n_uncovered = covered.n_uncovered - covered.n_outside
    if n_uncovered:
        warned.add("image")
        remedy, where = "enlarge the scene (pitch_um), or shrink or move the layout", ""
        if is_photograph:
            remedy = "use fit='cover', or a larger pitch_um or field_of_view_deg, or shrink or move the layout"
        if gaze_um is not None:
            where = f" at the gaze {format_point(gaze_um)} µm"
        if fit == "cover":
            x_um, y_um = np.abs(gaze_um if gaze_um is not None else (0.0, 0.0))
            call = "from_picture" if isinstance(source, Scene) and source.panorama is None else "from_panorama"
            remedy = f"use Scene.{call}(..., gaze_range_um=({x_um:.4g}, {y_um:.4g})), or gazes nearer to the centre"
        warn(
            f"{n_uncovered:,} of {n_sites:,} photosites lie partly or completely outside the image{where}, where "
            f"irradiance is 0: the image measures {_format_extent(image_um)}, the layout {_format_extent(layout_um)}; "
            f"{remedy}",
            CoverageWarning,
        )
    elif is_photograph and fit is None and gaze_um is None:
        fraction = size_um(layout_um)[0] / size_um(image_um)[0]
        if fraction < MIN_PICTURE_FRACTION:
            warn(
                f"the layout measures only {100.0 * fraction:.2g} % of the width of the picture: the image measures "
                f"{_format_extent(image_um)}, the layout {_format_extent(layout_um)}; use fit='cover', or a smaller "
                "pitch_um or field_of_view_deg",
                CoverageWarning,
            )


def warn_of_exposure(
    sensor: Sensor, photo_e_per_s: Floats, exposure_s: float, capture: Capture, warned: set[str], *, is_picture: bool
) -> None:
    """
    Warn when many sites are saturated, or most of them receive no signal.

    Charts may be mostly dark: of those, all sites must receive no signal.
    The message contains the time of automatic exposure. ``warned``: causes of earlier warnings, which are not repeated.
    """
    n_sites = capture.code.size
    n_saturated = int(np.count_nonzero(sensor.are_saturated(capture.electrons, capture.code)))
    if n_saturated > MAX_SATURATED * n_sites:
        problem = f"{100.0 * n_saturated / n_sites:.0f} % of the photosites are saturated"
    else:
        is_dark = photo_e_per_s * exposure_s < np.maximum(sensor.first_code_e, 1.0)
        if is_picture and 2 * np.count_nonzero(is_dark) > n_sites:
            problem = "more than half of the photosites receive less than one electron or one code"
        elif not is_picture and is_dark.all() and photo_e_per_s.any():
            problem = "all photosites receive less than one electron or one code"
        else:
            return
    cause = problem.split("photosites")[1]
    if cause in warned:
        return
    warned.add(cause)
    try:
        remedy = f"use exposure_s={sensor.exposure_for(photo_e_per_s):.3g}, or 'auto'"
    except ParameterError:
        remedy = "use more light"
    warn(f"{problem} at an exposure of {exposure_s:.3g} s; {remedy}", ExposureWarning)


def warn_of_coarse_pixels(scene: Scene, pixel_um: float, layout: Layout, warned: set[str]) -> None:
    """Warn when many sites are smaller than the pixels of a photograph on the sensor."""
    if not scene.is_picture or "pixels" in warned:
        return
    fraction = np.count_nonzero(layout.area_um2 < pixel_um**2) / max(layout.n_sites, 1)
    if fraction > MAX_BELOW_PIXELS:
        warned.add("pixels")
        warn(
            f"{100.0 * fraction:.0f} % of the photosites are smaller than the pixels of the picture, of {pixel_um:.3g} µm on "
            "the sensor, and cannot show finer details; use a picture with more pixels",
            SamplingWarning,
        )


def size_um(bounds_um: Sequence[float]) -> tuple[float, float]:
    """Return width and height of a bounding box."""
    x0_um, y0_um, x1_um, y1_um = bounds_um
    return x1_um - x0_um, y1_um - y0_um


def format_point(xy_um: Sequence[float] | Floats) -> str:
    return f"({xy_um[0]:.4g}, {xy_um[1]:.4g})"


def _format_extent(bounds_um: Sequence[float]) -> str:
    """Return size and position of a bounding box, for messages."""
    width_um, height_um = size_um(bounds_um)
    return (
        f"{width_um:.5g} x {height_um:.5g} µm, from {format_point(bounds_um[:2])} to {format_point(bounds_um[2:])} µm"
    )


def warn_of_focal_length(optics: Optics, lens: Lens | None, scene: Scene) -> None:
    """
    Warn when the focal length of a lens model differs from the image distance.

    A lens model maps directions, which are ideal positions over its focal length. Those of the optics are over the image
    distance, which equals their focal length for a distant scene in focus. For unequal axes, the geometric mean is compared,
    which preserves areas.
    """
    if lens is None:
        return
    image_um = optics.magnification(scene.distance_m) * float(um_from_m(scene.distance_m))
    focal_um = math.sqrt(np.broadcast_to(np.asarray(lens.focal_um, np.float64), (2,)).prod())
    if abs(focal_um / image_um - 1.0) <= MAX_FOCAL_DIFFERENCE:
        return
    focus_m = scene.distance_m if optics.focus_distance_m is None else optics.focus_distance_m
    focus_um = float(um_from_m(focus_m))
    # The thin lens with the image distance of the lens model: 1 / f = 1 / D + 1 / H.
    focal_length_mm = optics.focal_length_mm * focal_um / image_um * (image_um + focus_um) / (focal_um + focus_um)
    warn(
        f"the focal length of the lens model is {focal_um:,.5g} µm, but the image distance of the optics {image_um:,.5g} µm "
        f"({optics.focal_length_mm:g} mm, focused at {focus_m:g} m): the image is distorted for wrong field angles; use "
        f"focal_um={image_um:.5g}, or focal_length_mm={focal_length_mm:.5g}",
        FoveasimWarning,
    )


def warn_of_coarse_cells(optics: Optics, scene: Scene, layout: Layout) -> None:
    """Warn when automatic oversampling is limited, and photosites have an error above 1e-3."""
    if optics.oversample != "auto":
        return
    error = optics.auto_oversample_error(scene)  # of sites of side λN, an upper limit for wider ones
    if error <= MAX_AUTO_ERROR:
        return
    lambda_n_um = float(um_from_nm(scene.wavelength_nm.min())) * optics.working_f_number(scene.distance_m)
    side_um = math.sqrt(float(layout.area_um2.min(initial=np.inf)))
    # Wider photosites have proportionally fewer cells at their edges.
    error *= min(1.0, lambda_n_um / side_um)
    k, pixel_um = optics.auto_oversample(scene), optics.grid(scene).pitch_x_um
    is_lattice = optics.source_pixel == "point" and pixel_um > lambda_n_um
    # Point emitters farther apart than λN have no limit for small cells; they represent a continuous scene for sites > λN.
    if error <= MAX_AUTO_ERROR or (is_lattice and side_um > lambda_n_um):
        return
    reason, cure = (
        ("source pixels are points farther apart than λN", 'use source_pixel="square"')
        if is_lattice
        else (
            "more cells of the picture, or of the padding for its blur, would exceed its limits",
            "set Optics(oversample=...), or use a smaller picture, or less aberration",
        )
    )
    warn(
        f"automatic oversampling chooses {k} x {k} cells of {pixel_um / k:.3g} µm per source pixel, since {reason}: "
        f"photosites of {side_um:.3g} µm then have errors up to {100.0 * error:.2g} % (λN = {lambda_n_um:.3g} µm); {cure}, "
        "or Optics(oversample=1) to accept them",
        SamplingWarning,
    )


def warn_of_small_openings(opening_um: float, light: Scene | PowerMap) -> None:
    """Warn of openings of pixel optics in which rays are diffracted."""
    wavelength_um = float(um_from_nm(light.wavelength_nm.max()))
    if opening_um < MIN_OPENING_WAVELENGTHS * wavelength_um:
        warn(
            f"the narrowest opening of the pixel optics measures {opening_um / wavelength_um:.2g} wavelengths in its layer, "
            f"fewer than {MIN_OPENING_WAVELENGTHS:g}: geometric rays neglect diffraction; use larger sites, "
            "or a measured 'sensitivity'",
            FoveasimWarning,
        )


def warn_of_oblique_rays(incidence: Incidence, warned: set[str]) -> None:
    """Warn, once per camera, of chief rays that are too oblique for models of pixel optics."""
    if "chief rays" in warned:
        return
    warned.add("chief rays")
    tangent = incidence.largest_tangent
    if tangent > math.tan(math.radians(MAX_CHIEF_RAY_DEG)):
        warn(
            f"chief rays reach the sensor at up to {math.degrees(math.atan(tangent)):.0f}° to its normal, beyond "
            f"{MAX_CHIEF_RAY_DEG:g}°, where the response of pixels is not known; the exit pupils of fisheye lenses are farther "
            "from the sensor than the thin lens: set Optics(exit_pupil_mm=...), or its 'chief_ray'",
            FoveasimWarning,
        )


def warn_of_negative(rate_e_per_s: Floats, is_negative: Bools) -> None:
    """Warn when gradients of coarse cells give negative photoelectrons."""
    fraction = -float(rate_e_per_s[is_negative].sum()) / float(np.abs(rate_e_per_s).sum())
    warn(
        f"second-order integration makes the photoelectrons of {int(is_negative.sum()):,} of {rate_e_per_s.size:,} "
        f"photosites negative, {100.0 * fraction:.3g} % of all, and they are set to 0: the image is too sharp for cells of "
        "this size; use order=1, or smaller cells (Optics(oversample=...))",
        SamplingWarning,
    )

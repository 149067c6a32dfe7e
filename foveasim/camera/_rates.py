"""Photoelectron rates: the maps of a source, integrated over the photosites."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Bools, Floats
from foveasim._core.work_arrays import trim_heaps
from foveasim.camera._clock import Clock
from foveasim.camera._footprints import find_footprints, placed
from foveasim.camera._frames import ImageCache, Position
from foveasim.camera._steps import WeightedMap, integrate_maps
from foveasim.camera._warnings import (
    Covered,
    warn_of_coarse_cells,
    warn_of_coarse_pixels,
    warn_of_coverage,
    warn_of_focal_length,
)
from foveasim.errors import ParameterError, type_name
from foveasim.fields import Grid, PowerMap
from foveasim.optics import Optics
from foveasim.scene import Scene
from foveasim.sensor import Footprints, Sensor

if TYPE_CHECKING:
    from foveasim.camera._camera import Camera


def expected_rates(
    camera: Camera,
    source: Scene | PowerMap,
    clock: Clock,
    moving_um: Position | None = None,
    cached: ImageCache | None = None,
    warned: set[str] | None = None,
) -> Floats:
    """
    Return the expected photoelectrons of every site per second, (n_site,).

    ``moving_um`` is the gaze of a frame with its own, or None; ``cached`` is a cache of a scene's images by grid and filter, or
    None; ``warned`` are the warnings of earlier frames, which are not repeated.
    """
    if not isinstance(source, Scene | PowerMap):
        raise ParameterError("light", f"must be a Scene or a PowerMap, got {type_name(source)}")
    sensor, layout = camera.sensor, camera.layout
    gaze_um = camera.gaze_um if moving_um is None else moving_um
    position_um = (gaze_um[0], gaze_um[1]) if camera.axis == "image" else (0.0, 0.0)
    trim_heaps()
    light = camera.light_at_gaze(source, gaze_um)
    e_per_j = sensor.responsivity_e_per_j(light.wavelength_nm)
    with clock.stage("load kernels"):
        _load_kernels(light)
    if isinstance(light, PowerMap):
        maps, grids = _bands(sensor, light, e_per_j), [light.grid]
    else:
        warn_of_focal_length(camera.optics, camera.distortion, light)
        # Lateral chromatic aberration gives images of several sizes, each with its own grid.
        optics = camera.optics.resolve_oversample(light)
        warn_of_coarse_cells(camera.optics, light, layout)
        warn_of_coarse_pixels(light, camera.optics.grid(light).pitch_x_um, layout, camera._warned)
        images, frame = optics.image_grids(light), camera.sensor_frame(light)
        # Images of a camera that turns differ for each gaze.
        cached = None if camera.axis == "sensor" and moving_um is not None else cached
        maps = _images(sensor, light, optics, images, e_per_j, clock, cached, camera.n_threads)
        grids = [frame.image(grid) for grid, _ in images]
    with clock.stage("compile layout"):
        order, footprints = camera.order(light), footprints_at(camera, light, position_um)
        integrators = [
            camera.integrator(
                grid,
                order=order,
                n_grids=len(grids),
                position_um=position_um,
                # Most gazes of a video occur once, and so do the images of a camera that turns.
                compiled=moving_um is None or gaze_um == camera.gaze_um,
                footprints=footprints,
                projection=camera.projection(light),
            )
            for grid in grids
        ]
        smallest = min(integrators, key=lambda integrator: integrator.grid.cell_area_um2)
        covered = Covered.by(smallest)
        if footprints is not None and footprints.outlines is not None:
            bounds_um = (camera.bounds_in_um(camera.projection(light)) + np.tile(position_um, 2)).tolist()
            moved = placed(layout, None, position_um)
            covered = Covered.of(moved, bounds_um, smallest.grid, camera.lens_for(light), camera.n_threads)
    named_um = None if moving_um is None and not any(gaze_um) else gaze_um
    warn_of_coverage(source, covered, layout.n_sites, named_um, warned)
    return integrate_maps(sensor, light, maps, integrators, clock, footprints)


def footprints_at(camera: Camera, light: Scene | PowerMap, position_um: Position) -> Footprints | None:
    """Return the light that the sites collect at a position of the layout's origin."""
    return find_footprints(camera, camera.layout, camera.sensor.pixel_optics, light, position_um, camera._footprints)


def _bands(sensor: Sensor, power_map: PowerMap, e_per_j: Floats) -> Iterator[WeightedMap]:
    """Yield each band of a power map, with every site's photoelectrons per joule in it."""
    for band, cells in enumerate(power_map.data):
        yield WeightedMap(0, cells, None, e_per_j[sensor.filter_of_site, band])


def _images(
    sensor: Sensor,
    scene: Scene,
    optics: Optics,
    images: Sequence[tuple[Grid, Bools]],
    e_per_j: Floats,
    clock: Clock,
    cached: ImageCache | None,
    n_threads: int,
) -> Iterator[WeightedMap]:
    """
    Yield the photoelectron map of each filter, with its sites.

    One inverse transform per filter and image, for any number of wavelengths.
    """
    used = sensor.filters_used

    # As a function, without a reference in this generator: one map is in memory at a time.
    def image(grid: Grid, c: int, maps: Iterator[NDArray[Any]]) -> NDArray[Any]:
        with clock.stage("optics"):
            if cached is None:
                return next(maps)
            if (grid, c) not in cached:
                cached[grid, c] = next(maps)
            return cached[grid, c]

    for k, (grid, is_in_image) in enumerate(images):
        new = used if cached is None else np.array([c for c in used if (grid, c) not in cached], np.int64)
        maps = optics.weighted_maps(scene, e_per_j[new] * is_in_image, grid=grid, n_threads=n_threads)
        for c in used:
            yield WeightedMap(k, image(grid, int(c), maps), sensor.sites_of_filter[int(c)], None)


def _load_kernels(light: Scene | PowerMap) -> None:
    """Import the kernels that this source needs, before other stages are timed."""
    import foveasim.integrate._kernels

    if isinstance(light, Scene):
        import foveasim.optics._kernels  # noqa: F401

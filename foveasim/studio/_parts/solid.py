"""Layers of the sensor in three dimensions."""

from __future__ import annotations

import numpy as np

from foveasim.errors import GeometryError
from foveasim.layout import Layout
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, layout_of, part
from foveasim.view.solids import SensorStack, Solids, solids
from foveasim.view.web._bodies import bodies_of

#: Largest number of photosites whose layers are shown: those nearest to the centre of the layout.
MAX_STACK_SITES = 20_000
#: Stacks with decreasing demands on the shape of photosites, and what they lack.
STACKS = (
    (SensorStack(n_lens_steps=3), ""),
    (SensorStack(n_lens_steps=3, trench_width_um=0.0), "no trenches: a photosite is too narrow"),
)


@part("3D", layout_of, order=10, group="See", is_costly=True)
def solid(result: Simulated) -> PartData:
    """Return the layers of the sensor: silicon, trenches, colour filters, microlenses."""
    layout = result.capture.layout
    chosen = _central(layout)
    model, missing = _solids(layout if chosen.size == layout.n_sites else layout[chosen])
    bodies, arrays = bodies_of(model.meshes, model.layout)
    arrays["run_sites"] = (chosen[arrays["run_sites"].astype(np.int64) - 1] + 1).astype(np.uint32)
    shape = model.sensor_stack
    notes = [
        f"Silicon {shape.well_depth_um:g} µm, filters {shape.filter_thickness_um:g} µm",
        f"lenses {shape.lens_height_um:g} µm" if "lenses" in model.parts else "",
        f"{len(model.sites_without_lens):,} photosites of shapes without lens" if model.sites_without_lens else "",
        missing,
        f"{chosen.size:,} central photosites" if chosen.size < layout.n_sites else "",
    ]
    return {"bodies": bodies, "n_sites": layout.n_sites, "note": ", ".join(filter(None, notes))}, arrays


def _central(layout: Layout) -> np.ndarray:
    """Return the photosites nearest to the centre of the layout, in ascending order."""
    if layout.n_sites <= MAX_STACK_SITES:
        return np.arange(layout.n_sites)
    x0, y0, x1, y1 = layout.bounds_um
    distance_um = np.abs(layout.centroid_um - (0.5 * (x0 + x1), 0.5 * (y0 + y1))).max(axis=1)
    return np.sort(np.argpartition(distance_um, MAX_STACK_SITES)[:MAX_STACK_SITES])


def _solids(layout: Layout) -> tuple[Solids, str]:
    """Return the first stack that the photosites allow, and what it lacks."""
    *others, (last, lacks) = STACKS
    for sensor_stack, missing in others:
        try:
            return solids(layout, sensor_stack), missing
        except GeometryError:
            continue
    return solids(layout, last), lacks

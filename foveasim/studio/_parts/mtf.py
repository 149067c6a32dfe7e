"""Modulation transfer."""

from __future__ import annotations

import numpy as np

from foveasim.layout import Layout
from foveasim.metrics import nyquist_per_mm, polygon_mtf
from foveasim.scene import Scene
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, curves_of, label_of, part
from foveasim.units import per_mm_from_per_um

#: Number of frequencies of MTF curves.
N_FREQUENCIES = 65
#: Nearest photosites among which the Nyquist frequency of a site is measured.
N_NEIGHBOURS = 64


@part(
    "MTF",
    lambda result: (result.capture.layout, result.shot.camera.optics, result.shot.scene, result.pinned),
    order=80,
    group="Measure",
    is_first=True,
)
def mtf(result: Simulated) -> PartData:
    """Return MTF curves of the lens on the axis, and of pinned or three photosites."""
    layout, scene = result.capture.layout, result.shot.scene
    order = np.argsort(layout.area_um2, kind="stable")
    chosen = {"smallest site": order[0], "median site": order[order.size // 2], "largest site": order[-1]}
    smallest = order[0]
    if result.pinned:
        chosen = {label_of(site): site for site in result.pinned}
        smallest = min(result.pinned, key=lambda site: float(layout.area_um2[site]))
    last_per_mm = float(per_mm_from_per_um(1.0 / np.sqrt(layout.area_um2[smallest])))
    frequency_per_mm = np.linspace(0.0, last_per_mm, N_FREQUENCIES)
    values = {name: polygon_mtf(layout[np.array([site])], frequency_per_mm)[0] for name, site in chosen.items()}
    if isinstance(scene, Scene):
        wavelength_nm = float(np.median(scene.wavelength_nm))
        lens = result.shot.camera.optics.mtf(frequency_per_mm, wavelength_nm=wavelength_nm, distance_m=scene.distance_m)
        values = {f"lens, {wavelength_nm:g} nm": lens, **values}
    curves = [{"label": name, "unit_x": "1/mm", "unit_y": ""} for name in values]
    about, arrays = curves_of(curves, [frequency_per_mm] * len(curves), list(values.values()))
    limits_per_mm = {name: _nyquist_per_mm(layout, int(site)) for name, site in chosen.items()}
    about["lines"] = [
        {"x": value, "label": name, "of": "Nyquist"} for name, value in limits_per_mm.items() if np.isfinite(value)
    ]
    return about, arrays


def _nyquist_per_mm(layout: Layout, site: int) -> float:
    """Return the Nyquist frequency at a photosite, from its neighbours, 1/mm."""
    if layout.n_sites <= N_NEIGHBOURS:
        return float(nyquist_per_mm(layout)[site])
    distance_um2 = np.square(layout.centroid_um - layout.centroid_um[site]).sum(axis=1)
    nearest = np.sort(np.argpartition(distance_um2, N_NEIGHBOURS)[:N_NEIGHBOURS])
    return float(nyquist_per_mm(layout[nearest])[np.searchsorted(nearest, site)])

"""Charts: noise budget, spectral response, modulation transfer."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.metrics import nyquist_per_mm, polygon_mtf
from foveasim.scene import Scene
from foveasim.sensor import noise_budget
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, capture_of, curves_of, part
from foveasim.units import per_mm_from_per_um, photon_energy_j

__all__ = ["mtf", "noise", "spectrum"]

#: Wavelengths of the spectrum: the first range that all curves of the sensor cover; else the bands of the scene.
RANGES_NM = ((350.0, 1000.0), (400.0, 1000.0), (380.0, 780.0), (400.0, 700.0))
N_WAVELENGTHS = 131
#: Number of frequencies of MTF curves.
N_FREQUENCIES = 65
#: Nearest photosites among which the Nyquist frequency of a site is measured.
N_NEIGHBOURS = 64


@part("Noise", capture_of)
def noise(result: Simulated) -> PartData:
    """Return the noise budget: median over the photosites by source, e-."""
    sensor, capture = result.shot.camera.sensor, result.capture
    budget = noise_budget(sensor, result.photo_e_per_s, result.shot.exposure_s)
    sources = [
        {"name": name, "label": name.replace("_", " "), "is_temporal": name in budget.temporal, "values": found}
        for name, values in budget.items()
        if (found := float(np.median(values))) > 0.0
    ]
    return {"sources": sources, "unit": "e⁻", "median_electrons": float(np.median(capture.electrons))}, {}


@part("Spectrum", lambda result: (result.shot.camera.sensor,))
def spectrum(result: Simulated) -> PartData:
    """Return the spectral response of each filter, electrons per photon."""
    wavelength_nm, e_per_j = _responsivity(result)
    e_per_photon = e_per_j * photon_energy_j(wavelength_nm)
    curves = [
        {"label": name, "unit_x": "nm", "unit_y": "e⁻ per photon", "name": name} for name in result.capture.filter_names
    ]
    return curves_of(curves, [wavelength_nm] * len(curves), list(e_per_photon))


def _responsivity(result: Simulated) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return wavelengths, and the responsivity of each filter at these, (n_filter, n), e-/J."""
    sensor = result.shot.camera.sensor
    for low_nm, high_nm in RANGES_NM:
        wavelength_nm = np.linspace(low_nm, high_nm, N_WAVELENGTHS)
        with suppress(ParameterError):
            return wavelength_nm, sensor.responsivity_e_per_j(wavelength_nm)
    wavelength_nm = np.sort(result.shot.scene.wavelength_nm)
    return wavelength_nm, sensor.responsivity_e_per_j(wavelength_nm)


@part("MTF", lambda result: (result.capture.layout, result.shot.camera.optics, result.shot.scene))
def mtf(result: Simulated) -> PartData:
    """Return MTF curves of the lens on the axis and of three photosites."""
    layout, scene = result.capture.layout, result.shot.scene
    order = np.argsort(layout.area_um2, kind="stable")
    chosen = {"smallest site": order[0], "median site": order[order.size // 2], "largest site": order[-1]}
    last_per_mm = float(per_mm_from_per_um(1.0 / np.sqrt(layout.area_um2[order[0]])))
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

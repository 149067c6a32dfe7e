"""Spectral response."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim.errors import ParameterError
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, curves_of, part
from foveasim.units import photon_energy_j

#: Wavelengths of the spectrum: the first range that all curves of the sensor cover; else the bands of the scene.
RANGES_NM = ((350.0, 1000.0), (400.0, 1000.0), (380.0, 780.0), (400.0, 700.0))
N_WAVELENGTHS = 131


@part("Spectrum", lambda result: (result.shot.camera.sensor,), order=50, group="See")
def spectrum(result: Simulated) -> PartData:
    """Return the spectral response of each filter, electrons per photon."""
    wavelength_nm, e_per_j = _responsivity(result)
    e_per_photon = e_per_j * photon_energy_j(wavelength_nm)
    curves = [
        {"label": name, "unit_x": "nm", "unit_y": "e- per photon", "name": name} for name in result.capture.filter_names
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

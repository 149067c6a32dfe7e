"""Electronics of published sensors: parameters of :class:`foveasim.Sensor`, with their sources and nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

__all__ = ["PRESETS"]

#: By name: ``fs.Sensor(layout, **fs.sensor.PRESETS["paper_foveal"])``. Of "From the radiance reflected by a scene to a digital
#: picture", the table of its runs: read noise, capacity, voltage range and bits (with 1/30 s and 1/60 s); and its Fig. 9, of
#: which the read noise is 0, 50 or 200 e-. What the paper does not tell has the sensor's defaults.
PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "paper_foveal": MappingProxyType({"read_noise_e": 1.0, "capacitance_f": 1e-13, "v_sat_v": 3.0, "bits": 8}),
        "paper_distortion": MappingProxyType(
            {"read_noise_e": 1.0, "capacitance_f": 4.8e-13, "v_sat_v": 3.0, "bits": 8}
        ),
        "paper_read_noise": MappingProxyType({"read_noise_e": 50.0, "full_well_e": 7000.0}),
    }
)

"""Published electronic parameters as keywords of :class:`foveasim.Sensor`, with sources."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

__all__ = ["PRESETS"]

#: Presets by name: ``fs.Sensor(layout, **fs.sensor.PRESETS["paper_foveal"])``. Source: "From the radiance reflected by a scene
#: to a digital picture": table of its runs (read noise, capacitance, voltage range and bits, for exposures of 1/30 s and
#: 1/60 s), and Fig. 9, with a read noise of 0, 50 or 200 e-. Parameters that the paper does not specify have their defaults.
PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "paper_foveal": MappingProxyType({"read_noise_e": 1.0, "capacitance_f": 1e-13, "v_sat_v": 3.0, "bits": 8}),
        "paper_distortion": MappingProxyType(
            {"read_noise_e": 1.0, "capacitance_f": 4.8e-13, "v_sat_v": 3.0, "bits": 8}
        ),
        "paper_read_noise": MappingProxyType({"read_noise_e": 50.0, "full_well_e": 7000.0}),
    }
)

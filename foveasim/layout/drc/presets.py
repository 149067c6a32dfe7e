"""
Design rule limits of public processes, with their sources.

They are defaults of logic processes and not specific to image sensors.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from foveasim._core.short_repr import short_repr

__all__ = ["PRESETS", "Preset"]


class Preset(NamedTuple):
    """
    Limits by parameter name of :class:`foveasim.layout.DesignRules`, and their source.

    Examples
    --------
    >>> import foveasim as fs
    >>> preset = fs.layout.PRESETS["sky130_diff"]
    >>> fs.DesignRules(**preset.limits, min_size_um=2.0)
    DesignRules(min_size_um=2.0, min_width_um=0.15, min_space_um=0.27, edge_angle_step_deg=90.0, grid_um=0.005)
    """

    limits: Mapping[str, Any]
    source: str

    def __repr__(self) -> str:
        return short_repr(self)


_SKY130 = "SkyWater SKY130 PDK (github.com/google/skywater-pdk), docs/rules/periphery: "

#: Sets of limits by name, for example ``DesignRules(preset="sky130_met1")``.
PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        "sky130_met1": Preset(
            {
                "min_width_um": 0.140,
                "min_space_um": 0.140,
                "min_area_um2": 0.083,
                "min_hole_um2": 0.140,
                "edge_angle_step_deg": 45.0,
                "grid_um": 0.005,
                "max_density": 0.77,
                "density_window_um": 50.0,
            },
            _SKY130 + "first metal, m1.1, m1.2, m1.6, m1.7, m1.13, m1.14; x.1b and x.3a for grid and angles",
        ),
        "sky130_diff": Preset(
            {"min_width_um": 0.150, "min_space_um": 0.270, "edge_angle_step_deg": 90.0, "grid_um": 0.005},
            _SKY130 + "diffusion, difftap.1, difftap.3; x.1b and x.2 for grid and angles",
        ),
        "sky130_dnwell": Preset(
            {"min_width_um": 3.0, "min_space_um": 6.3, "edge_angle_step_deg": 45.0, "grid_um": 0.005},
            _SKY130 + "deep n-well, dnwell.2, dnwell.3; x.1b and x.3a for grid and angles",
        ),
        "ihp_sg13g2": Preset(
            {
                "min_angle_deg": 87.0,
                "grid_um": 0.005,
                "min_density": 0.25,
                "max_density": 0.65,
                "density_window_um": 800.0,
            },
            "IHP SG13G2 open-source layout rules (github.com/IHP-GmbH/IHP-Open-PDK): grid, acute angles, metal density",
        ),
        "paper": Preset(
            {"min_size_um": 2.2},
            "From the radiance reflected by a scene to a digital picture: the pixel of its distortion run, 2.2 µm",
        ),
        "smallest_pixel": Preset(
            {"min_size_um": 0.56},
            "The smallest pixel in series production in 2022, 0.56 µm (Samsung ISOCELL HP3)",
        ),
    }
)

"""
foveasim: simulator of image sensors with polygonal photosites.

Optics form the power map of a scene; the map is integrated exactly over every photosite; photoelectrons, noise, voltages
and codes follow::

    import foveasim as fs

    layout = fs.layout.log_polar(n_sectors=128, min_size_um=2.0, r_max_um=600.0)
    camera = fs.Camera(
        optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=fs.Sensor(layout)
    )
    capture = camera.capture(scene, exposure_s=1 / 30, seed=0)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from foveasim._version import __version__

if TYPE_CHECKING:
    from foveasim import (
        compare,
        config,
        distortion,
        errors,
        explore,
        layout,
        learn,
        maps,
        metrics,
        modes,
        optics,
        reconstruct,
        scene,
        sensor,
        studio,
        testing,
        tiles,
        twin,
        units,
        video,
        view,
    )
    from foveasim._core.jit import compile_kernels
    from foveasim.camera import Camera
    from foveasim.capture import Capture
    from foveasim.config import read_layout
    from foveasim.errors import FoveasimError
    from foveasim.fields import Grid, PowerMap
    from foveasim.integrate import Integrator
    from foveasim.layout import DesignRules, Layout
    from foveasim.maps import read_power_map, write_power_map
    from foveasim.optics import Optics
    from foveasim.reconstruct import Picture
    from foveasim.scene import Scene
    from foveasim.sensor import FilterSet, GaussianCurve, PolynomialCurve, Sensor, SiliconQE, rgb_filters

__all__ = [
    "Camera",
    "Capture",
    "DesignRules",
    "FilterSet",
    "FoveasimError",
    "GaussianCurve",
    "Grid",
    "Integrator",
    "Layout",
    "Optics",
    "Picture",
    "PolynomialCurve",
    "PowerMap",
    "Scene",
    "Sensor",
    "SiliconQE",
    "__version__",
    "columns",
    "compare",
    "compile_kernels",
    "config",
    "distortion",
    "errors",
    "explore",
    "layout",
    "learn",
    "maps",
    "metrics",
    "modes",
    "optics",
    "read_layout",
    "read_power_map",
    "reconstruct",
    "rgb_filters",
    "scene",
    "sensor",
    "studio",
    "testing",
    "tiles",
    "twin",
    "units",
    "video",
    "view",
    "write_power_map",
]


#: Modules of the names that are not modules themselves. All are imported on use.
_HOMES = {
    "camera": ["Camera"],
    "capture": ["Capture"],
    "config": ["read_layout"],
    "errors": ["FoveasimError"],
    "fields": ["Grid", "PowerMap"],
    "integrate": ["Integrator"],
    "layout": ["DesignRules", "Layout"],
    "maps": ["read_power_map", "write_power_map"],
    "optics": ["Optics"],
    "reconstruct": ["Picture"],
    "scene": ["Scene"],
    "sensor": ["FilterSet", "GaussianCurve", "PolynomialCurve", "Sensor", "SiliconQE", "rgb_filters"],
    "_core.jit": ["compile_kernels"],
}

if not TYPE_CHECKING:  # type checkers would take any name for an attribute

    def __getattr__(name: str) -> Any:
        """Import a public name, which is then an attribute."""
        if name not in __all__:
            from foveasim._core.names import did_you_mean

            hint = "" if name.startswith("__") else did_you_mean(name, __all__)  # protocols of other libraries
            raise AttributeError(f"module '{__name__}' has no attribute '{name}'{'; ' if hint else ''}{hint}")
        home = next((home for home, names in _HOMES.items() if name in names), None)
        if home is None:
            return import_module(f"{__name__}.{name}")
        globals()[name] = getattr(import_module(f"{__name__}.{home}"), name)
        return globals()[name]


def __dir__() -> list[str]:
    return list(__all__)

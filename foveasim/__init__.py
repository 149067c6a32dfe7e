"""
foveasim: simulator of image sensors with polygonal photosites.

Optics form the power map of a scene; the map is integrated exactly over every photosite; photoelectrons, noise, voltages
and codes follow::

    import foveasim as fs

    layout = fs.layout.log_polar(n_sectors=128, min_size_um=2.0, r_max_um=600.0)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=22.0, f_number=4.0), sensor=fs.Sensor(layout))
    capture = camera.capture(scene, exposure_s=1 / 30, seed=0)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from foveasim import (
    distortion,
    errors,
    layout,
    maps,
    metrics,
    modes,
    optics,
    reconstruct,
    scene,
    sensor,
    tiles,
    units,
    video,
    view,
)
from foveasim._core.calls import check_public_calls
from foveasim._core.jit import compile_kernels
from foveasim._io.pickling import make_copyable
from foveasim._version import __version__
from foveasim.camera import Camera
from foveasim.capture import Capture
from foveasim.errors import FoveasimError
from foveasim.fields import Grid, PowerMap
from foveasim.integrate import Integrator
from foveasim.layout import DesignRules, Layout
from foveasim.maps import read_power_map, write_power_map
from foveasim.optics import Optics
from foveasim.reconstruct import Picture
from foveasim.scene import Scene
from foveasim.sensor import FilterSet, GaussianCurve, PolynomialCurve, Sensor, SiliconQE, rgb_filters

if TYPE_CHECKING:
    from foveasim import compare, explore, learn, studio, testing
    from foveasim.config import read_layout

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
    "units",
    "video",
    "view",
    "write_power_map",
]


for _module in (
    "distortion", "errors", "layout", "maps", "metrics", "modes", "optics", "reconstruct", "scene", "scene.charts", "sensor",
    "sensor.effects", "tiles", "units", "video", "view",
):  # fmt: skip
    check_public_calls(f"{__name__}.{_module}")
    make_copyable(f"{__name__}.{_module}")
check_public_calls(__name__)
make_copyable(__name__)

#: Names that are imported when they are used, and the modules that have them.
_LAZY = {
    "compare": "foveasim.compare",
    "config": "foveasim.config",
    "explore": "foveasim.explore",
    "learn": "foveasim.learn",
    "read_layout": "foveasim.config",
    "studio": "foveasim.studio",
    "testing": "foveasim.testing",
}

if not TYPE_CHECKING:  # type checkers would take any name for an attribute

    def __getattr__(name: str) -> Any:
        """Import the names of ``_LAZY``."""
        if name not in _LAZY:
            from foveasim._core.names import did_you_mean

            hint = "" if name.startswith("__") else did_you_mean(name, __all__)  # protocols of other libraries
            raise AttributeError(f"module '{__name__}' has no attribute '{name}'{'; ' if hint else ''}{hint}")
        from importlib import import_module

        module = import_module(_LAZY[name])
        return module if module.__name__ == f"{__name__}.{name}" else getattr(module, name)


def __dir__() -> list[str]:
    return list(__all__)

"""
Gradients with respect to photosites, optics and electronics, for PyTorch.

Cameras are layers of networks on any device; layouts with variable vertices use the kernels of the simulator on the CPU, and
operations of PyTorch elsewhere. Requires the extra ``learn``, and for :func:`physics` and :func:`transform` the extra
``adapters``: without PyTorch the module has no names, and their use raises an ImportError.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from foveasim._core.calls import publish
from foveasim._core.extras import needs

__all__ = [
    "Cortical",
    "Imaging",
    "Mesh",
    "Model",
    "Outlines",
    "PowerCells",
    "Readout",
    "SensorLayer",
    "SiteConv",
    "SitePool",
    "barrier",
    "capture",
    "from_fovi",
    "generated",
    "physics",
    "site_power",
    "to_fovi",
    "transform",
    "undistort",
]

if TYPE_CHECKING or find_spec("torch") is not None:
    from foveasim.learn.adapters import from_fovi, physics, to_fovi, transform
    from foveasim.learn.distortion import undistort
    from foveasim.learn.imaging import Imaging
    from foveasim.learn.integral import site_power
    from foveasim.learn.layer import SensorLayer
    from foveasim.learn.mesh import Mesh
    from foveasim.learn.model import Model, capture
    from foveasim.learn.outlines import Outlines
    from foveasim.learn.parametric import generated
    from foveasim.learn.penalties import barrier
    from foveasim.learn.power_cells import PowerCells
    from foveasim.learn.readout import Readout
    from foveasim.learn.sites.convolution import SiteConv
    from foveasim.learn.sites.cortical import Cortical
    from foveasim.learn.sites.pooling import SitePool

    publish(__name__)
else:

    def __getattr__(name: str) -> Any:
        if name in __all__:
            extra = "adapters" if name in ("physics", "transform") else "learn"
            raise ImportError(f"{__name__}.{name} {needs('torch', extra)}", name=__name__)
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")

    def __dir__() -> list[str]:
        return []

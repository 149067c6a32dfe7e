"""
Gradients with respect to photosites, optics and electronics, for PyTorch.

The functions take and return tensors on the CPU; the kernels below them are those of the simulator. Requires the extra
``learn``.
"""

from __future__ import annotations

from foveasim._core.calls import check_public_calls
from foveasim._core.extras import needs

try:
    import torch as _torch  # noqa: F401
except ImportError:
    raise ImportError(f"foveasim.learn {needs('torch')}") from None

from foveasim.learn.distortion import undistort
from foveasim.learn.imaging import Imaging
from foveasim.learn.integral import site_power
from foveasim.learn.mesh import Mesh
from foveasim.learn.model import Model, capture
from foveasim.learn.outlines import Outlines
from foveasim.learn.parametric import generated
from foveasim.learn.penalties import barrier
from foveasim.learn.power_cells import PowerCells
from foveasim.learn.readout import Readout

__all__ = [
    "Imaging",
    "Mesh",
    "Model",
    "Outlines",
    "PowerCells",
    "Readout",
    "barrier",
    "capture",
    "generated",
    "site_power",
    "undistort",
]

check_public_calls(__name__)

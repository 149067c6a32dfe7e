"""
Real cameras and their simulation: from recorded frames to a sensor.

::

    twin = fs.twin.fit("frames", bits=12, pixel_um=3.45)
    sensor = twin.sensor()
"""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.twin.camera_fit import fit
from foveasim.twin.intervals import Estimate
from foveasim.twin.result import Twin, read_twin
from foveasim.twin.stacks import Stack, read_stacks

__all__ = ["Estimate", "Stack", "Twin", "fit", "read_stacks", "read_twin"]

publish(__name__)

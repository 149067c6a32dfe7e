"""
Real cameras and their simulation.

From recorded frames or events to a sensor, and real pictures beside simulated ones.

::

    twin = fs.twin.fit("frames", bits=12, pixel_um=3.45)
    sensor = twin.sensor()
"""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.twin.events.pixels import EventPixelFit, fit_event_pixels
from foveasim.twin.events.recordings import StaticRecording, StepResponses
from foveasim.twin.fitting.intervals import Estimate
from foveasim.twin.frames.camera_fit import fit
from foveasim.twin.frames.result import Twin, read_twin
from foveasim.twin.frames.stacks import Stack, read_stacks
from foveasim.twin.pictures.comparison import Deviation, PictureComparison, compare_with

__all__ = [
    "Deviation",
    "Estimate",
    "EventPixelFit",
    "PictureComparison",
    "Stack",
    "StaticRecording",
    "StepResponses",
    "Twin",
    "compare_with",
    "fit",
    "fit_event_pixels",
    "read_stacks",
    "read_twin",
]

publish(__name__)

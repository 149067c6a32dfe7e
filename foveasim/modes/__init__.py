"""
Acquisition modes other than global exposures: rolling shutters, events, spikes.

::

    pixels = fs.modes.EventPixels(
        camera.sensor, contrast_on=0.2, contrast_off=0.2, refractory_s=1e-4
    )
    for events in pixels.stream(camera.rates(frames), frame_s=1 / 1000, seed=0):
        ...
"""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.modes.events import Events, write_events
from foveasim.modes.pixels import EventPixels, SpikingPixels
from foveasim.modes.shutter import Between, Exposure, Shutter
from foveasim.modes.step_response import event_probability

__all__ = [
    "Between",
    "EventPixels",
    "Events",
    "Exposure",
    "Shutter",
    "SpikingPixels",
    "event_probability",
    "write_events",
]

publish(__name__)

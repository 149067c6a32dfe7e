"""Parameters of real cameras from their recordings, for simulations of the same camera."""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.twin.event_pixels import EventPixelFit, fit_event_pixels
from foveasim.twin.event_recordings import StaticRecording, StepResponses

__all__ = ["EventPixelFit", "StaticRecording", "StepResponses", "fit_event_pixels"]

publish(__name__)

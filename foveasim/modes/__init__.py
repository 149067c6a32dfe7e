"""Ways of acquisition beyond one exposure of all sites at once: rolling shutters, events, spikes."""

from __future__ import annotations

from foveasim.modes.shutter import Between, Exposure, Shutter

__all__ = ["Between", "Exposure", "Shutter"]

"""Layout generators, one module each, registered in :data:`foveasim.layout.LAYOUTS`."""

from __future__ import annotations

from foveasim._core.registry import import_all

import_all(__name__, __path__)

"""Point spread functions of other programs and measurements."""

from __future__ import annotations

from foveasim._core.registry import import_all

import_all(__name__, __path__)

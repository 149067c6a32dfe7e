"""
Modules and kernels of a local worker.

The process that forks the workers imports this module once (:func:`foveasim.explore.cluster.open_client`), so that no worker
spends seconds on it.
"""

from __future__ import annotations

from contextlib import suppress

import distributed  # noqa: F401

import foveasim.explore.worker_cache

with suppress(Exception):  # a worker that needs the kernels raises the error again
    import foveasim.integrate._kernels
    import foveasim.optics._kernels
    import foveasim.sensor._kernels  # noqa: F401

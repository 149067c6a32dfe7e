"""
Views of the studio: the data that each shows, by name.

A view is one module here with :func:`~foveasim.studio._parts.registry.part`, and one of its name in ``static/views``.
"""

from foveasim._core.registry import import_all
from foveasim.studio._parts.page_views import summary_of
from foveasim.studio._parts.registry import PARTS, Part, PartData

__all__ = ["PARTS", "Part", "PartData", "summary_of"]

import_all(__name__, __path__)

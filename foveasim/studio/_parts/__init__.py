"""
Views of the studio: the data that each shows, by name.

A new view is one function with :func:`~foveasim.studio._parts.registry.part` in a module here, and one pane of the page.
"""

from foveasim.studio._parts import charts, comparison, exposure, images, sites, solid  # noqa: F401 -- registered views
from foveasim.studio._parts.registry import PARTS, Part, PartData
from foveasim.studio._parts.sites import summary_of

__all__ = ["PARTS", "Part", "PartData", "summary_of"]

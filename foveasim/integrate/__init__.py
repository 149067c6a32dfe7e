"""
Exact integration of maps over polygons.

A map contains the mean of every cell of its grid. If the map is constant within each cell, the integral over a site is
exactly ``sum over cells of map[cell] * area(site ∩ cell)``; at second order each cell also has a gradient. An
:class:`Integrator` compiles outlines and a grid once. All frames, sweep points and reconstructions use the same plan.
"""

from __future__ import annotations

from foveasim._core.calls import publish
from foveasim.integrate._integrator import Integrator
from foveasim.integrate._outlines import UndistortedOutlines, outline_bounds_um
from foveasim.integrate._shape import EdgeMoments, SharedEdges, vertex_gradient

__all__ = ["EdgeMoments", "Integrator", "SharedEdges", "UndistortedOutlines", "outline_bounds_um", "vertex_gradient"]

publish(__name__)

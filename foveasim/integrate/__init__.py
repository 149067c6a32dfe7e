"""
Exact integrals of maps over polygons.

The map is known by the mean of every cell of its grid. What a site receives is
``sum over cells of map[cell] * area(site ∩ cell)``, exactly, when the map is even within each cell; at second order
a cell has a gradient, too. An :class:`Integrator` compiles outlines and a grid once; every frame, sweep point and
reconstruction then uses the same plan.
"""

from __future__ import annotations

from foveasim.integrate._integrator import Integrator

__all__ = ["Integrator"]

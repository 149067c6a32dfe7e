"""
Exact integrals of maps over polygons.

The map is constant on every cell of its grid (its mean). What a site receives is
``sum over cells of map[cell] * area(site ∩ cell)``, exactly. An :class:`Integrator` compiles outlines and a grid
once; every frame, sweep point and reconstruction then uses the same plan.
"""

from __future__ import annotations

from foveasim.integrate._integrator import Integrator

__all__ = ["Integrator"]

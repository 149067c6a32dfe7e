"""Voronoi and power diagrams, for the irregular layout generators."""

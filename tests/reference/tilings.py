"""Small layouts of most families, which tile areas around the origin."""

from __future__ import annotations

from functools import cache

import numpy as np

from foveasim import layout

TILINGS = {
    "grid": lambda: layout.grid(n_x=13, n_y=11, pitch_um=0.77),
    "hexagonal": lambda: layout.hexagonal(n_columns=12, n_rows=13, pitch_um=0.9),
    "hexagonal flat": lambda: layout.hexagonal(n_columns=11, n_rows=12, pitch_um=1.1, orientation="flat"),
    "log_polar": lambda: layout.log_polar(n_sectors=24, r_min_um=0.2, r_max_um=4.7),
    "log_polar with fovea": lambda: layout.log_polar(n_sectors=24, r_min_um=0.2, r_max_um=4.7, fovea="rings"),
    "log_polar staggered, odd chords": lambda: layout.log_polar(
        n_sectors=20, r_min_um=0.4, r_max_um=5.5, stagger=True, chords_per_arc=3
    ),
    "zones": lambda: layout.zones(side_um=(1.4, 4.2, 9.8), pitch_um=(0.35, 0.7, 1.4)),
    "octagonal": lambda: layout.octagonal(n_x=9, n_y=9, pitch_um=1.1, border="cut"),
    "giotto": lambda: layout.giotto(n_rho=12, n_theta=40, n_fovea=5, n_across=40, unit_um=0.25),
    "fovi": lambda: layout.fovi(fov_um=9.0, a_um=0.5, n_rings=14),
    "foveal_cartesian": lambda: layout.foveal_cartesian(n_rings=7, ring_ratio=1.4, pitch_um=0.4, n_fovea=3),
    "sunflower": lambda: layout.sunflower(n_sites=250, spacing_um=0.6),
    "voronoi": lambda: layout.voronoi(n_sites=200, size_um=(9.0, 9.0), n_iterations=3).translate(0.1, 0.1),
    "voronoi_of": lambda: layout.voronoi_of(np.random.default_rng(3).uniform(-4.4, 4.4, (150, 2)), size_um=(9.0, 9.0)),
    "quadtree": lambda: layout.quadtree(np.random.default_rng(1).random((32, 32)), pitch_um=0.3, limit=9.0, n_levels=5),
    "penrose": lambda: layout.penrose(side_um=0.9, size_um=10.0),
}


@cache
def tiling(name):
    """Return the layout of this name, built once."""
    return TILINGS[name]()

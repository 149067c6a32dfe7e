"""
What can be drawn of a layout, and how many photosites does a picture bear?

New here: ``Layout.plot`` by columns, with readout lines and neighbours over it; ``view.id_map``, the site under each pixel.

Expect: a foveal layout by size, by filter, by readout line and with its neighbours; and a million hexagons in one picture, each
where it is: of 2000 x 2000 pixels each shows one of them, and the areas that pixels count agree with the photosites' own within
1 % in every hundredth of the field.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.view import id_map, save_figure

N_PIXELS, N_PARTS = 2000, 10


def main(out_dir: Path) -> None:
    """Write the drawings to a folder."""
    # %% One layout in four ways.
    layout = fs.layout.log_polar(n_sectors=36, min_size_um=4.0, r_max_um=102.0, fovea="hexagons", stagger=True)
    mosaic = fs.layout.graph_colouring(layout, 3)
    rings_alone = fs.layout.log_polar(n_sectors=36, min_size_um=4.0, r_max_um=102.0)
    lines = fs.layout.readout_by(rings_alone, "sector")
    figure = Figure(figsize=(14.0, 11.0), layout="constrained")
    axes = figure.subplots(2, 2)
    layout.plot("size_um", ax=axes[0, 0])
    axes[0, 0].set_title("by size")
    mosaic.plot("channel", ax=axes[0, 1])
    axes[0, 1].set_title("three filters, never two of a kind side by side")
    lines.plot("readout_line", overlay="readout_lines", legend=False, ax=axes[1, 0])
    axes[1, 0].set_title("by readout line, one a sector")
    layout.plot(overlay="adjacency", ax=axes[1, 1])
    axes[1, 1].set_title("photosites and their neighbours")
    for ax in axes.flat:
        ax.set(xlim=(-80.0, 80.0), ylim=(-80.0, 80.0))
    save_figure(figure, out_dir / "13_ways_to_draw.png", dpi=80)

    # %% A million hexagons, each with the value of a zone plate in its middle, and a closer look.
    many = fs.layout.hexagonal(n_columns=1000, n_rows=1000, pitch_um=1.0)
    radius_um = np.hypot(*many.centroid_um.T)
    rings = np.cos(np.pi * radius_um**2 / 900.0)
    figure = Figure(figsize=(14.0, 6.4), layout="constrained")
    for ax, half_um in zip(figure.subplots(1, 2), (None, 22.0), strict=True):
        many.plot(rings, label="cos(π r² / 900 µm²)", ax=ax, legend=half_um is not None)
        if half_um is not None:
            ax.set(xlim=(410.0 - half_um, 410.0 + half_um), ylim=(-half_um, half_um))
    save_figure(figure, out_dir / "13_a_million.png", dpi=80)

    # %% The photosite under each pixel, and what it counts.
    half_um = 300.0
    ids = id_map(many, (N_PIXELS, N_PIXELS), (-half_um, -half_um, half_um, half_um))
    x, y = (np.clip(((c + half_um) * N_PARTS / (2 * half_um)).astype(int), 0, N_PARTS - 1) for c in many.centroid_um.T)
    part = y * N_PARTS + x
    is_seen = np.all(np.abs(many.centroid_um) < half_um, axis=1)
    counted_um2 = np.bincount(part[ids].ravel(), minlength=N_PARTS**2) * (2 * half_um / N_PIXELS) ** 2
    own_um2 = np.bincount(part[is_seen], many.area_um2[is_seen], minlength=N_PARTS**2)
    error = float(np.max(np.abs(counted_um2 / own_um2 - 1.0)))
    print(f"{many.n_sites:,} photosites, {np.unique(ids).size:,} in the picture; areas by pixels within {error:.2%}")
    assert ids.min() >= 0
    assert error < 0.01


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

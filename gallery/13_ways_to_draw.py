"""
Which plots show a layout, and how many photosites can one figure contain?

New here: ``Layout.plot`` of columns, with overlaid readout lines and adjacency;
``view.id_map``, the site at each pixel.

Expect: a foveal layout by size, by filter, by readout line and with its adjacency; a
million hexagons in one figure, at their correct positions: each of 2000 x 2000 pixels
shows one of them, and areas counted in pixels agree with the areas of the photosites
within 1 % in each of 10 x 10 parts of the field.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import skimage.data
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.view import id_map, save_figure

N_PIXELS, N_PARTS = 2000, 10


def main(out_dir: Path) -> None:
    """Write the plots to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Four plots of one layout.
    layout = fs.layout.log_polar(
        n_sectors=36, min_size_um=4.0, r_max_um=102.0, fovea="hexagons", stagger=True
    )
    mosaic = fs.layout.graph_colouring(layout, 3)
    rings_alone = fs.layout.log_polar(n_sectors=36, min_size_um=4.0, r_max_um=102.0)
    readout = fs.layout.readout_by(rings_alone, "sector")
    figure = Figure(figsize=(8.0, 7.0), layout="constrained")
    axes = figure.subplots(2, 2)
    layout.plot("size_um", ax=axes[0, 0])
    axes[0, 0].set_title("by size", fontsize=10)
    mosaic.plot("channel", ax=axes[0, 1])
    axes[0, 1].set_title("three filters, different for neighbours", fontsize=10)
    readout.plot("readout_line", overlay="readout_lines", legend=False, ax=axes[1, 0])
    axes[1, 0].set_title("by readout line, one per sector", fontsize=10)
    layout.plot(overlay="adjacency", ax=axes[1, 1])
    axes[1, 1].set_title("adjacency of the photosites", fontsize=10)
    for ax in axes.flat:
        ax.set(xlim=(-80.0, 80.0), ylim=(-80.0, 80.0))
    save_figure(figure, out_dir / "13_ways_to_draw.png", dpi=140)

    # %% A million hexagons with the values of a photograph at their centroids, and an
    # enlarged part.
    hexagons = fs.layout.hexagonal(n_columns=1000, n_rows=1000, pitch_um=1.0)
    photograph = skimage.data.camera()[::-1] / 255.0
    row, column = (
        np.clip(
            (c / 1000.0 + 0.5) * photograph.shape[0], 0, photograph.shape[0] - 1
        ).astype(int)
        for c in hexagons.centroid_um.T[::-1]
    )
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    for ax, half_um in zip(figure.subplots(1, 2), (None, 60.0), strict=True):
        hexagons.plot(
            photograph[row, column], label="value", ax=ax, legend=half_um is not None
        )
        if half_um is not None:
            ax.set(
                xlim=(-120.0 - half_um, -120.0 + half_um),
                ylim=(310.0 - half_um, 310.0 + half_um),
            )
    save_figure(figure, out_dir / "13_a_million.png", dpi=92)

    # %% Photosite at each pixel, and areas counted in pixels.
    half_um = 300.0
    ids = id_map(hexagons, (N_PIXELS, N_PIXELS), (-half_um, -half_um, half_um, half_um))
    x, y = (
        np.clip(((c + half_um) * N_PARTS / (2 * half_um)).astype(int), 0, N_PARTS - 1)
        for c in hexagons.centroid_um.T
    )
    part = y * N_PARTS + x
    is_inside = np.all(np.abs(hexagons.centroid_um) < half_um, axis=1)
    counted_um2 = (
        np.bincount(part[ids].ravel(), minlength=N_PARTS**2)
        * (2 * half_um / N_PIXELS) ** 2
    )
    expected_um2 = np.bincount(
        part[is_inside], hexagons.area_um2[is_inside], minlength=N_PARTS**2
    )
    error = float(np.max(np.abs(counted_um2 / expected_um2 - 1.0)))
    print(
        f"{hexagons.n_sites:,} photosites, {np.unique(ids).size:,} in the id "
        f"map; areas in pixels within {error:.2%}"
    )
    assert ids.min() >= 0
    assert error < 0.01


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

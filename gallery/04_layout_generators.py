"""
Which layout generators exist, and how can the centre of a foveal layout be filled?

New here: all generators in ``layout.LAYOUTS``, ``log_polar(fovea=)``,
``graph_colouring``, ``plot_layout``.

Expect: fifteen layouts without overlapping sites; four foveal layouts that differ only
in the centre: 1,740 sites around a blind spot, which is empty or contains 169, 144 or
235 sites, none below the minimum size of 2 µm.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.view import plot_layout, save_figure

MIN_SIZE_UM = 2.0
FOVEA = {
    "n_sectors": 60,
    "min_size_um": MIN_SIZE_UM,
    "r_max_um": 380.0,
    "stagger": True,
    "chords_per_arc": 2,
}


def families() -> dict[str, fs.Layout]:
    """
    Return the example layout of each registered generator, and variants of two
    of them.
    """
    make = fs.layout
    return {
        **{
            name.replace("_", " "): generator(**make.LAYOUTS.example(name))
            for name, generator in make.LAYOUTS.items()
        },
        "zones of hexagons": make.zones(
            side_um=(9, 19, 36), pitch_um=(1, 2, 4), cells="hexagons"
        ),
        "dual pixels": make.split(make.grid(n_x=10, n_y=10, pitch_um=3.0)),
    }


def main(out_dir: Path) -> None:
    """Write the overview of generators and the foveas to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% One layout per generator, with different colours for neighbours.
    layouts = families()
    n_rows = -(-len(layouts) // 3)
    figure = Figure(figsize=(8.0, 2.7 * n_rows), layout="constrained")
    colours = np.array(
        [(0.55, 0.7, 0.86), (0.98, 0.85, 0.55), (0.75, 0.85, 0.65), (0.9, 0.65, 0.6)]
    )
    for position, (name, layout) in enumerate(layouts.items(), start=1):
        axes = figure.add_subplot(n_rows, 3, position)
        plot_layout(
            layout, colours[fs.layout.graph_colouring(layout, 4).channel], ax=axes
        )
        axes.set_title(f"{name}: {layout.n_sites} sites", fontsize=10)
    save_figure(figure, out_dir / "04_families.png", dpi=140)

    # %% Options for the blind spot.
    foveas = {
        filling: fs.layout.log_polar(**FOVEA, fovea=filling)
        for filling in ("none", "rings", "linear", "hexagons")
    }
    figure = Figure(figsize=(8.0, 7.8), layout="constrained")
    for position, (name, layout) in enumerate(foveas.items(), start=1):
        axes = figure.add_subplot(2, 2, position)
        plot_layout(layout, ax=axes)
        axes.set_xlim(-45, 45)
        axes.set_ylim(-45, 45)
        axes.set_title(f"fovea={name!r}: {layout.n_sites} sites")
    save_figure(figure, out_dir / "04_foveas.png", dpi=140)

    # %% Checks.
    no_overlap = fs.DesignRules(max_overlap_um2=0.0)
    for name, layout in (layouts | foveas).items():
        assert layout.check(no_overlap).ok, name
    n_around = foveas["none"].n_sites
    for name, layout in foveas.items():
        size_um = np.sqrt(layout.area_um2[: layout.n_sites - n_around])
        print(
            f"{name:>9}: {size_um.size:4d} sites in the centre, {n_around:,} around it"
        )
        assert np.all(size_um >= MIN_SIZE_UM)
    assert [layout.n_sites - n_around for layout in foveas.values()] == [
        0,
        169,
        144,
        235,
    ]


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

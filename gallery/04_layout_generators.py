"""
Which layout generators exist, and what does a photograph look like through their
photosites?

New here: all generators in ``layout.LAYOUTS``, ``log_polar(fovea=)``, ``Integrator``,
``plot_layout``.

Expect: sixteen layouts without overlapping sites in a field of 100 µm, coloured by the
size of their sites on one scale, each beside the mean irradiance of one photograph over
its sites; and four foveal layouts that differ only in the centre: 1,740 sites around a
blind spot, which is empty or contains 169, 144 or 235 sites, none below the minimum
size of 2 µm.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from skimage.color import rgb2gray
from skimage.data import astronaut

import foveasim as fs
from foveasim.view import plot_layout, save_figure

#: Side of the field, which holds all layouts.
FIELD_UM = 100.0
#: Colours of sizes, from fine to coarse.
SIZES = ScalarMappable(LogNorm(0.8, 8.0), "viridis_r")
MIN_SIZE_UM = 2.0
FOVEA = {
    "n_sectors": 60,
    "min_size_um": MIN_SIZE_UM,
    "r_max_um": 380.0,
    "stagger": True,
    "chords_per_arc": 2,
}


def families() -> dict[str, fs.Layout]:
    """Return a layout of each registered generator, and variants of two of them."""
    make = fs.layout
    offset = np.arange(128) - 63.5
    distance = np.hypot(offset, offset[:, np.newaxis])
    points_um = 22.0 * np.random.default_rng(0).standard_normal((1800, 2))
    points_um = points_um[np.abs(points_um).max(axis=1) < 0.5 * FIELD_UM]
    size_um = (FIELD_UM, FIELD_UM)
    return {
        "log-polar": make.log_polar(
            n_sectors=96, min_size_um=1.0, r_max_um=50.0, fovea="rings"
        ),
        "FOVI": make.fovi(fov_um=96.0, a_um=6.0, n_rings=28),
        "GIOTTO": make.giotto(
            n_rho=30, n_theta=60, n_fovea=10, n_across=100, unit_um=1.0
        ),
        "foveal cartesian": make.foveal_cartesian(
            n_rings=17, pitch_um=0.9, n_fovea=8, ring_ratio=1.225
        ),
        "zones": make.zones(side_um=(25.0, 50.0, 100.0), pitch_um=(1.0, 2.5, 5.0)),
        "zones of hexagons": make.zones(
            side_um=(26.0, 52.0, 96.0), pitch_um=(1.0, 2.5, 5.0), cells="hexagons"
        ),
        "quadtree": make.quadtree(
            importance=0.9 * np.exp(-distance / 12.0),
            pitch_um=0.78,
            limit=1.0,
            n_levels=4,
        ),
        "sunflower": make.sunflower(n_sites=2000, spacing_um=1.79),
        "grid": make.grid(n_x=45, n_y=45, pitch_um=2.2, trench_um=0.3, stagger=True),
        "dual pixels": make.split(make.grid(n_x=32, n_y=32, pitch_um=3.1)),
        "hexagonal": make.hexagonal(n_columns=44, n_rows=50, pitch_um=2.25),
        "octagonal": make.octagonal(n_x=32, n_y=32, pitch_um=3.1),
        "tiling": make.tiling(pitch_um=2.0, radius_um=50.0),
        "Penrose": make.penrose(side_um=2.4, size_um=98.0),
        "Voronoi": make.voronoi(n_sites=2000, size_um=size_um, n_iterations=20),
        "Voronoi of points": make.voronoi_of(points_um, size_um=size_um),
    }


def main(out_dir: Path) -> None:
    """Write the overview of generators and the foveas to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% A photograph over the field: face in the centre, top row at the top.
    photograph = fs.PowerMap.from_array(
        rgb2gray(astronaut()[0:260, 95:355])[::-1],
        pitch_um=1.05 * FIELD_UM / 260,
        wavelength_nm=550.0,
    )

    # %% Each layout, coloured by the size of its sites, and the mean irradiance of its
    # sites.
    layouts = families()
    n_rows = -(-len(layouts) // 2)
    figure = Figure(figsize=(8.0, 2.2 * n_rows + 0.6), layout="constrained")
    panels = figure.subplots(n_rows, 4).reshape(-1, 2)
    for (sizes, seen), (name, layout) in zip(panels, layouts.items(), strict=True):
        mean = (
            fs.Integrator(layout, photograph.grid)(photograph.data)[0] / layout.area_um2
        )
        plot_layout(
            layout, SIZES.to_rgba(layout.size_um)[:, :3], ax=sizes, scale_bar=False
        )
        plot_layout(
            layout,
            np.clip(mean, 0.0, 1.0)[:, np.newaxis].repeat(3, axis=1),
            ax=seen,
            scale_bar=False,
        )
        sizes.set_title(name, fontsize=11, loc="left")
        seen.set_title(f"{layout.n_sites:,} sites", fontsize=10, loc="right")
        for axes in (sizes, seen):
            axes.set(
                xlim=(-51, 51),
                ylim=(-51, 51),
                xlabel="",
                ylabel="",
                xticks=[],
                yticks=[],
            )
    bar = figure.colorbar(
        SIZES,
        ax=panels.ravel().tolist(),
        orientation="horizontal",
        aspect=50.0,
        pad=0.01,
    )
    bar.set_label("size of a photosite / µm")
    bar.ax.minorticks_off()
    bar.set_ticks([1, 2, 4, 8], labels=["1", "2", "4", "8"])
    save_figure(figure, out_dir / "04_families.png", dpi=140)

    # %% Options for the blind spot.
    foveas = {
        filling: fs.layout.log_polar(**FOVEA, fovea=filling)
        for filling in ("none", "rings", "linear", "hexagons")
    }
    figure = Figure(figsize=(8.0, 7.8), layout="constrained")
    for position, (name, layout) in enumerate(foveas.items(), start=1):
        axes = figure.add_subplot(2, 2, position)
        plot_layout(layout, SIZES.to_rgba(layout.size_um)[:, :3], ax=axes)
        axes.set_xlim(-45, 45)
        axes.set_ylim(-45, 45)
        axes.set_title(f"fovea={name!r}: {layout.n_sites} sites")
    save_figure(figure, out_dir / "04_foveas.png", dpi=140)

    # %% Checks.
    shown = {layout.provenance["generator"] for layout in layouts.values()}
    assert shown == set(fs.layout.LAYOUTS)
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

"""
What does a fovea gain over a square grid with the same number of photosites, and what
does it cost?

New here: ``n_sites=`` of layout generators, and ``foveasim.compare``: pictures, quality
by eccentricity and information of cameras at equal budget.

Expect: of two sensors with 4,096 photosites, the foveal one has a PSNR at least 5 dB
higher around the gaze, at least 2 dB lower in the periphery, and at least 3 times as
much information per area at the gaze; the total information differs by less than 40 %.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.compare.figures import draw_measure
from foveasim.view import save_figure

N_SITES = 4096
FIELD_UM = 720.0
MIN_SIZE_UM = 2.0
#: Photosites for a test of the script.
QUICK = {"n_sites": 1681}
METRICS = ("psnr_db", "snr_mean_db", "information_bit_per_mm2")


def compare(n_sites: int) -> fs.compare.Comparison:
    """Compare a foveal and a square layout of the same number of sites and width."""
    foveal = fs.layout.log_polar(
        n_sites=n_sites,
        min_size_um=MIN_SIZE_UM,
        r_max_um=FIELD_UM / 2.0,
        fovea="rings",
        stagger=True,
    )
    square = fs.layout.grid(n_sites=n_sites, size_um=(FIELD_UM, FIELD_UM))
    return fs.compare.layouts(
        {"foveal": foveal, "square": square}, n_annuli=6, max_pixels=192
    )


def draw(found: fs.compare.Comparison) -> Figure:
    """Draw the pictures of one scene, and three measures against eccentricity."""
    figure = Figure(figsize=(8.0, 5.6), layout="constrained")
    axes = figure.subplots(2, 3)
    scene = found.scenes.index("astronaut")
    ideal = found.ideals["square"][scene]
    white = np.nanquantile(ideal.data, 0.995)
    pictures = {"ideal": ideal} | {
        f"{name}: {budget.n_sites:,} sites": found.pictures[name][scene]
        for name, budget in zip(found.names, found.budgets, strict=True)
    }
    for one, (title, picture) in zip(axes[0], pictures.items(), strict=True):
        grey = fs.units.encode_srgb(np.clip(picture.data[0] / white, 0.0, 1.0))
        one.imshow(grey, cmap="gray", origin="lower", vmin=0.0, vmax=1.0)
        one.set(title=title, xticks=[], yticks=[])
    for one, name in zip(axes[1], METRICS, strict=True):
        draw_measure(found, name, one)
        one.grid(color="0.92")
    axes[1, 0].legend(frameon=False)
    return figure


def main(out_dir: Path, n_sites: int = N_SITES) -> None:
    """Write the figure to a directory, and check the differences."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Five photographs through both sensors.
    found = compare(n_sites)
    print(found)

    # %% Pictures of one scene, and measures against eccentricity; bands are 95 %
    # intervals of the median over the scenes.
    figure = draw(found)
    save_figure(figure, out_dir / "26_foveal_against_square.png", dpi=140)

    # %% Checks.
    foveal, square = found.summary("psnr_db", by_eccentricity=True).median
    per_mm2 = found.summary("information_bit_per_mm2", by_eccentricity=True).median
    total = found.summary("information_bit_per_site").median
    assert foveal[0] > square[0] + 5.0
    assert foveal[3] < square[3] - 2.0
    assert per_mm2[0, 0] > 3.0 * per_mm2[1, 0]
    assert abs(total[0] / total[1] - 1.0) < 0.4


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

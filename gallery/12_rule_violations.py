"""
Where does a layout break its design rules, and by how much?

New here: ``Layout.check`` on a layout with planted faults, ``Report.plot``, ``Layout.plot`` with overlays.

Expect: of 2 slivers, 1 overlap, 2 pixels that are too small and 1 gap, planted in a grid of 60 sites, exactly these are found.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import shapely
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.view import save_figure

PITCH_UM = 4.0
MIN_WIDTH_UM, MIN_SIZE_UM, MIN_SPACE_UM = 1.0, 2.0, 0.5
RULES = fs.DesignRules(
    min_width_um=MIN_WIDTH_UM,
    min_size_um=MIN_SIZE_UM,
    min_space_um=MIN_SPACE_UM,
    max_overlap_um2=0.0,
    min_angle_deg=30.0,
)
#: What is planted: the widths of a sliver and an overlap, the side of a small pixel, the width of a gap.
SLIVER_UM, SMALL_UM, OVERLAP_UM, GAP_UM = 0.6, 1.5, 0.4, 0.2
EXPECTED = {"min_width_um": 2, "min_size_um": 2, "min_space_um": 1, "max_overlap_um2": 1, "min_angle_deg": 0}


def faulty() -> fs.Layout:
    """A grid of square sites with faults planted in six of them."""
    sound = fs.layout.grid(n_x=10, n_y=6, pitch_um=PITCH_UM, trench_um=1.0)
    boxes = shapely.bounds(sound.polygons())
    sites = list(sound.polygons())
    for site, width_um in ((12, SLIVER_UM), (47, SLIVER_UM + 0.2)):
        x0, y0, _, y1 = boxes[site]
        sites[site] = shapely.box(x0, y0 - 0.4, x0 + width_um, y1 + 0.4).union(shapely.box(x0, y0, x0 + 3.0, y0 + 1.5))
    for site in (25, 36):
        x0, y0, _, _ = boxes[site]
        sites[site] = shapely.box(x0, y0, x0 + SMALL_UM, y0 + SMALL_UM)
    x0, y0, _, y1 = boxes[8]
    sites[8] = shapely.box(x0 - 1.0 - OVERLAP_UM, y0, x0 + 2.0, y1)
    x0, y0, x1, _ = boxes[42]
    sites[42] = shapely.box(x0, y0, x1, y0 + 4.0 - GAP_UM)
    return fs.layout.readout_by(fs.Layout.from_polygons(sites, **sound.columns), "column")


def main(out_dir: Path) -> None:
    """Write the layout, its lines and its faults to a folder."""
    layout = faulty()
    report = layout.check(RULES)

    # %% The layout by size with its readout lines, and which site is read through which.
    figure = Figure(figsize=(15, 5.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    layout.plot("size_um", overlay="readout_lines", ax=left)
    left.set_title("sizes, and the lines that read the sites")
    layout.plot("readout_line", ax=right)
    right.set_title("readout lines")
    save_figure(figure, out_dir / "12_layout.png", dpi=80)

    # %% What is wrong with it.
    print(report)
    axes = report.plot(layout, figure_inches=9.0)
    save_figure(axes.figure, out_dir / "12_violations.png", dpi=100)

    # %% The numbers.
    assert {result.rule: len(result) for result in report.results} == EXPECTED
    worst = {result.rule: result.worst for result in report.results}
    assert np.isclose(worst["min_width_um"], SLIVER_UM)
    assert np.isclose(worst["min_size_um"], SMALL_UM)
    assert np.isclose(worst["min_space_um"], GAP_UM)
    assert np.isclose(worst["max_overlap_um2"], OVERLAP_UM * 3.0)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

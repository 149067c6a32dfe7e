"""
Where does a layout violate its design rules, and by how much?

New here: ``Layout.check`` on a layout with deliberate violations, ``Report.plot``.

Expect: 2 slivers, 1 overlap, 2 photosites below the minimum size and 1 narrow space,
which are inserted into a grid of 60 sites, and no other violation.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import shapely

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
#: Inserted violations: width of a sliver, side of a small site, width of an overlap,
#: width of a space.
SLIVER_UM, SMALL_SIDE_UM, OVERLAP_UM, SPACE_UM = 0.6, 1.5, 0.4, 0.2
#: Sites with violations, and their names in the figure.
INSERTED = {
    12: "sliver",
    47: "sliver",
    25: "too small",
    36: "too small",
    8: "overlap",
    42: "narrow space",
}
EXPECTED = {
    "min_width_um": 2,
    "min_size_um": 2,
    "min_space_um": 2,
    "max_overlap_um2": 1,
    "min_angle_deg": 0,
}


def layout_with_violations() -> fs.Layout:
    """Return a grid of square sites with violations in six of them."""
    regular = fs.layout.grid(n_x=10, n_y=6, pitch_um=PITCH_UM, trench_um=1.0)
    boxes = shapely.bounds(regular.polygons())
    sites = list(regular.polygons())
    for site, width_um in ((12, SLIVER_UM), (47, SLIVER_UM + 0.2)):
        x0, y0, _, y1 = boxes[site]
        sites[site] = shapely.box(x0, y0 - 0.4, x0 + width_um, y1 + 0.4).union(
            shapely.box(x0, y0, x0 + 3.0, y0 + 1.5)
        )
    for site in (25, 36):
        x0, y0, _, _ = boxes[site]
        sites[site] = shapely.box(x0, y0, x0 + SMALL_SIDE_UM, y0 + SMALL_SIDE_UM)
    x0, y0, _, y1 = boxes[8]
    sites[8] = shapely.box(x0 - 1.0 - OVERLAP_UM, y0, x0 + 2.0, y1)
    x0, y0, x1, _ = boxes[42]
    sites[42] = shapely.box(x0, y0, x1, y0 + 4.0 - SPACE_UM)
    return fs.Layout.from_polygons(sites, **regular.columns)


def main(out_dir: Path) -> None:
    """Write the layout and its violations to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    layout = layout_with_violations()
    report = layout.check(RULES)

    # %% Photosites in grey, violations in the colours of their rules, with the names of
    # the inserted violations.
    print(report)
    axes = report.plot(layout, figure_inches=8.0)
    for site, text in INSERTED.items():
        arrow = {"arrowstyle": "->", "color": "#22224a"}
        box = {"boxstyle": "round", "facecolor": "white", "edgecolor": "0.6"}
        x_um, y_um = layout.centroid_um[site]
        at_um = (
            x_um + (3.2 if x_um < 0.0 else -3.2),
            y_um + (-2.9 if text == "narrow space" else 2.9),
        )
        axes.annotate(
            text,
            (x_um, y_um),
            at_um,
            arrowprops=arrow,
            bbox=box,
            ha="center",
            fontsize=10,
        )
    save_figure(axes.figure, out_dir / "12_violations.png", dpi=140)

    # %% Checks.
    assert {result.rule: len(result) for result in report.results} == EXPECTED
    worst = {result.rule: result.worst for result in report.results}
    assert np.isclose(worst["min_width_um"], SLIVER_UM)
    assert np.isclose(worst["min_size_um"], SMALL_SIDE_UM)
    # Sites that overlap have no space between them.
    spaces_um = next(
        result.values for result in report.results if result.rule == "min_space_um"
    )
    assert np.allclose(spaces_um, [0.0, SPACE_UM])
    assert np.isclose(worst["max_overlap_um2"], OVERLAP_UM * 3.0)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

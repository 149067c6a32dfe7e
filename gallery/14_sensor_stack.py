"""
What does a foveal sensor look like when it is cut open?

New here: ``view.SensorStack``, ``view.solids``, ``view.stack``, ``Solids.check``, ``Solids.write``, ``view.render``.

Expect: wells, trenches, filters and lenses of 546 sites as closed solids that share no volume; wells and trenches that are
together the silicon under the sites within 1e-9, the wells 88.8 % of it; and the same solids in a file for a web page or a
printer.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import foveasim as fs
from foveasim import view

#: Trenches are etched as deep as the wells; filters and lenses are as thick as those of small pixels.
STACK = view.SensorStack(
    well_depth_um=6.0,
    trench_width_um=0.3,
    filter_thickness_um=1.6,
    lens_height_um=2.4,
    n_lens_corners=20,
    n_lens_steps=8,
)
LARGEST_ERROR = 1e-9


def foveal_layout() -> fs.Layout:
    """A small retina with a colour filter on every site, turned so that no trench runs along a cut."""
    rings = fs.layout.giotto(n_rho=18, n_theta=40, n_fovea=7, n_across=62, unit_um=2.0, chords_per_arc=3)
    return fs.layout.mosaic(rings, ("RG", "GB")).rotate(2.0)


def main(out_dir: Path) -> None:
    """Write the picture and the solids to a folder."""
    layout = foveal_layout()
    # Pictures are made without OpenGL where there is none, without the shade of corners.
    renderer = "pyvista" if view.find_renderer() else "software"

    # %% Cut open: silicon with its trenches, then filters, then lenses.
    view.render(
        view.stack(layout, STACK),
        out_dir / "14_sensor_stack.png",
        viewpoint=view.Viewpoint(azimuth_deg=-50.0, elevation_deg=38.0),
        size_px=(1280, 800),
        ambient_occlusion=renderer == "pyvista",
        renderer=renderer,
    )

    # %% Whole, for a page that turns it, or a printer.
    made = view.solids(layout, STACK)
    made.write(out_dir / "14_sensor_stack.glb")

    # %% The numbers.
    report = made.check()
    for part in report.parts:
        print(f"{part.name:>9}: {part.n_triangles:7,} triangles, {part.volume_um3:9,.1f} µm³")
    silicon_um3 = layout.area_um2 * STACK.well_depth_um
    share = made.volumes_um3("wells").sum() / silicon_um3.sum()
    print(f"{layout.n_sites:,} sites; wells are {share:.1%} of the silicon")
    assert report.ok
    assert np.allclose(
        made.volumes_um3("wells") + made.volumes_um3("trenches"), silicon_um3, rtol=LARGEST_ERROR, atol=0.0
    )
    narrowed = fs.layout.inset(layout, STACK.trench_width_um / 2)
    assert abs(share - narrowed.area_um2.sum() / layout.area_um2.sum()) < LARGEST_ERROR
    assert layout.n_sites == 546
    assert abs(share - 0.888) < 0.001


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

"""
What do the layers of a foveal sensor look like as solids?

New here: ``view.SensorStack``, ``view.solids``, ``view.stack``, ``Solids.check``,
``Solids.write``, ``view.render``.

Expect: wells, trenches, filters and lenses of 546 sites as closed solids that do not
overlap; wells and trenches whose volumes add up to the silicon below the sites within
1e-9, 88.8 % of it in the wells; the same solids in a file for a web page or a 3D
printer.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import foveasim as fs
from foveasim import view

#: Trenches have the depth of the wells; filters and lenses have the thickness that is
#: common for small pixels.
STACK = view.SensorStack(
    well_depth_um=6.0,
    trench_width_um=0.3,
    filter_thickness_um=1.6,
    lens_height_um=2.4,
    n_lens_corners=20,
    n_lens_steps=8,
)
MAX_ERROR = 1e-9


def foveal_layout() -> fs.Layout:
    """
    Return a small retina with a colour mosaic, rotated so that no trench is parallel to
    a cut.
    """
    rings = fs.layout.giotto(
        n_rho=18, n_theta=40, n_fovea=7, n_across=62, unit_um=2.0, chords_per_arc=3
    )
    return fs.layout.mosaic(rings, ("RG", "GB")).rotate(2.0)


def main(out_dir: Path) -> None:
    """Write the picture and the solids to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    layout = foveal_layout()
    # The software renderer, for machines without OpenGL, has no ambient occlusion.
    renderer = "pyvista" if view.find_renderer() else "software"

    # %% Cutaway view: silicon with trenches, filters, lenses.
    view.render(
        view.stack(layout, STACK),
        out_dir / "14_sensor_stack.png",
        viewpoint=view.Viewpoint(azimuth_deg=-50.0, elevation_deg=38.0),
        size_px=(1280, 800),
        ambient_occlusion=renderer == "pyvista",
        renderer=renderer,
        labels=True,
    )

    # %% Complete stack, for an interactive web page or a 3D printer.
    solids = view.solids(layout, STACK)
    solids.write(out_dir / "14_sensor_stack.glb")

    # %% Checks.
    report = solids.check()
    for part in report.parts:
        print(
            f"{part.name:>9}: {part.n_triangles:7,} triangles, "
            f"{part.volume_um3:9,.1f} µm³"
        )
    silicon_um3 = layout.area_um2 * STACK.well_depth_um
    well_fraction = solids.volumes_um3("wells").sum() / silicon_um3.sum()
    print(f"{layout.n_sites:,} sites; wells contain {well_fraction:.1%} of the silicon")
    assert report.ok
    assert np.allclose(
        solids.volumes_um3("wells") + solids.volumes_um3("trenches"),
        silicon_um3,
        rtol=MAX_ERROR,
        atol=0.0,
    )
    narrowed = fs.layout.inset(layout, STACK.trench_width_um / 2)
    assert (
        abs(well_fraction - narrowed.area_um2.sum() / layout.area_um2.sum()) < MAX_ERROR
    )
    assert layout.n_sites == 546
    assert abs(well_fraction - 0.888) < 0.001


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

"""
How does a retina-like sensor record the eye of a cat?

New here: ``view.prisms`` of a capture in user-defined colours, ``view.Viewpoint``,
``Integrator`` for other pictures.

Expect: 9,411 sites, 28 % of them in a fovea with 5.1 % of the area; columns with
heights proportional to the codes within 1e-12, and a height of 60 µm for the highest
code.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import skimage.data

import foveasim as fs
from foveasim import view

WAVELENGTH_NM = 550.0
EXPOSURE_S = 0.01
#: Photons per exposure at white.
MAX_PHOTONS_PER_UM2 = 1500.0
CAPACITANCE_F_PER_UM2 = 0.7e-16
#: Row and column of the cat's eye, which is imaged on the optical axis.
GAZE_PX = (113, 172)
PITCH_UM = 2.3
N_FOVEA = 30
MAX_HEIGHT_UM = 60.0
#: Factor on the colours, since shaded walls are darker than the photograph.
COLOUR_GAIN = 1.5


def retina() -> fs.Layout:
    """
    Return a Giotto layout: rings of unit height in the fovea, growing rings
    around it.
    """
    return fs.layout.giotto(
        n_rho=64, n_theta=200, n_fovea=N_FOVEA, n_across=260, unit_um=2.0
    )


def photograph(radius_um: float) -> np.ndarray:
    """Return the relative RGB radiance around the cat's eye within a radius."""
    half = int(radius_um / PITCH_UM) + 1
    row, column = GAZE_PX
    padded = np.pad(
        skimage.data.chelsea(), ((half, half), (half, half), (0, 0)), mode="edge"
    )
    return fs.units.decode_srgb(
        padded[row : row + 2 * half, column : column + 2 * half] / 255.0
    )


def main(out_dir: Path) -> None:
    """Write the pictures to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    layout = retina()
    rgb = photograph(layout.bounds_um[2])
    joules_um2 = (
        MAX_PHOTONS_PER_UM2
        * fs.units.photon_energy_j(WAVELENGTH_NM)
        * rgb
        @ np.array([0.3, 0.6, 0.1])
    )
    power_map = fs.PowerMap.from_array(
        joules_um2 / EXPOSURE_S / 1e-12,
        pitch_um=PITCH_UM,
        wavelength_nm=WAVELENGTH_NM,
        top_row_first=True,
    )

    # %% With capacitances proportional to areas, codes are proportional to irradiance
    # for all site sizes.
    sensor = fs.Sensor(
        layout, capacitance_f=CAPACITANCE_F_PER_UM2 * layout.area_um2, bits=10
    )
    camera = fs.Camera(
        optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    )
    capture = camera.capture(power_map, exposure_s=EXPOSURE_S, seed=1)
    print(capture)

    # %% Each column has the mean colour of the photograph over its site.
    site_rgb = (
        fs.Integrator(layout, power_map.grid)(np.moveaxis(rgb[::-1], -1, 0))
        / layout.area_um2
    )
    colours = fs.units.encode_srgb(COLOUR_GAIN * site_rgb).T
    columns = view.prisms(capture, by=colours, max_height_um=MAX_HEIGHT_UM)

    # %% Complete retina, and its fovea; the software renderer, used without OpenGL, has
    # no ambient occlusion.
    renderer = "pyvista" if view.find_renderer() else "software"
    for name, viewpoint in {
        "whole": view.Viewpoint(azimuth_deg=-80.0, elevation_deg=52.0),
        "fovea": view.Viewpoint(
            azimuth_deg=-80.0, elevation_deg=48.0, zoom=3.4, focus_um=(0.0, 0.0, 10.0)
        ),
    }.items():
        view.render(
            columns,
            out_dir / f"15_retina_{name}.png",
            viewpoint=viewpoint,
            size_px=(1200, 860),
            ambient_occlusion=renderer == "pyvista",
            renderer=renderer,
        )

    # %% Checks.
    is_fovea = layout.columns["ring"] < N_FOVEA
    site_fraction, area_fraction = (
        is_fovea.mean(),
        layout.area_um2[is_fovea].sum() / layout.area_um2.sum(),
    )
    print(f"highest colour value: {colours.max():.2f} of white")
    print(
        f"{layout.n_sites:,} sites, {site_fraction:.0%} of them in a fovea with "
        f"{area_fraction:.1%} of the area"
    )
    top_um = np.zeros(layout.n_sites)
    np.maximum.at(top_um, columns.photosite, columns.points_um[:, 2])
    assert layout.n_sites == 9411
    assert abs(site_fraction - 0.28) < 0.005
    assert abs(area_fraction - 0.051) < 0.0005
    assert np.allclose(
        top_um, MAX_HEIGHT_UM * capture.code / capture.code.max(), rtol=1e-12, atol=0.0
    )
    assert capture.saturated_fraction == 0.0
    assert colours.max() < 1.0


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

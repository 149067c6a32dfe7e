"""
How does a distorting lens change the picture and the irradiance on a hexagonal sensor?

New here: ``Integrator(distortion=)`` in addition to ``Camera(distortion=)``, and direct
use of a lens model.

Expect: a checkerboard with barrel distortion on 27,170 hexagons, whose undistorted
outlines grow towards the corners. There a hexagon receives 1.777 times the power of one
at the centre: the Jacobian determinant of the lens model, within 1e-4.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.scene import charts
from foveasim.view import save_figure

PITCH_UM, WIDTH_UM, HEIGHT_UM = 10.0, 1900.0, 1240.0
LENS = fs.distortion.BrownConrady(focal_um=4000.0, k1=-1.4, k2=1.6)


def main(out_dir: Path) -> None:
    """Write the captures of both lenses and the outlines to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Checkerboard of 20 mm squares at a distance of 0.5 m, and a sensor of hexagons.
    scene = charts.checkerboard(
        square_mm=20.0,
        shape=(900, 1300),
        pitch_um=250.0,
        distance_m=0.5,
        radiance_w_m2_sr_nm=0.0012,
        contrast=0.8,
        wavelength_nm=[550.0],
        band_width_nm=100.0,
    )
    layout = fs.layout.hexagonal(
        n_columns=round(WIDTH_UM / PITCH_UM),
        n_rows=round(HEIGHT_UM / PITCH_UM / 0.866),
        pitch_um=PITCH_UM,
    )
    sensor = fs.Sensor(layout, qe=0.6, capacitance_f=3e-15, read_noise_e=3.0, bits=10)
    optics = fs.Optics(focal_length_mm=4.0, f_number=2.8)
    ideal = fs.Camera(optics=optics, sensor=sensor).capture(
        scene, exposure_s=0.02, seed=0
    )
    distorted = fs.Camera(optics=optics, sensor=sensor, distortion=LENS).capture(
        scene, exposure_s=0.02, seed=0
    )

    # %% Captures of both lenses, and undistorted outlines of larger hexagons.
    figure = Figure(figsize=(8.0, 6.6), layout="constrained")
    axes = list(figure.subplot_mosaic("AB;CC", height_ratios=(1.0, 1.5)).values())
    ideal.plot(ax=axes[0])
    axes[0].set_title("ideal lens")
    distorted.plot(ax=axes[1])
    axes[1].set_title("distorting lens")
    large_hexagons = fs.layout.hexagonal(n_columns=19, n_rows=14, pitch_um=100.0)
    undistorted = fs.Layout(
        LENS.undistort(large_hexagons.xy_um),
        large_hexagons.ring_offsets,
        large_hexagons.site_offsets,
    )
    undistorted.plot(
        undistorted.area_um2 / large_hexagons.area_um2,
        label="undistorted area / area",
        ax=axes[2],
    )
    axes[2].set_title("undistorted outlines of 100 µm hexagons")
    save_figure(figure, out_dir / "18_distorted_hexagons.png", dpi=140)

    # %% Uniform irradiance: the power of a hexagon is proportional to its undistorted
    # area.
    grid = fs.Grid((1000, 1500), 2.0, (-1500.0, -1000.0))
    power = (
        fs.Integrator(layout, grid, distortion=LENS)(np.ones(grid.shape))
        / layout.area_um2
    )
    corner = int(np.argmax(np.hypot(*layout.centroid_um.T)))
    centre = int(np.argmin(np.hypot(*layout.centroid_um.T)))
    step_um = 0.01
    x_um, y_um = layout.centroid_um[corner]
    right, left, up, down = LENS.undistort(
        [
            [x_um + step_um, y_um],
            [x_um - step_um, y_um],
            [x_um, y_um + step_um],
            [x_um, y_um - step_um],
        ]
    )
    along_x, along_y = (right - left) / (2.0 * step_um), (up - down) / (2.0 * step_um)
    jacobian = float(along_x[0] * along_y[1] - along_x[1] * along_y[0])
    power_ratio = float(power[corner] / power[centre])
    print(
        f"{layout.n_sites} hexagons; relative power in the corner "
        f"{power_ratio:.5f}, Jacobian determinant {jacobian:.5f}"
    )
    assert abs(power_ratio / jacobian - 1.0) < 1e-4
    assert abs(power_ratio - 1.777) < 1e-3


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

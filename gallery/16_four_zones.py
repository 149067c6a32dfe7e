"""
How does a sensor of four zones, whose pitch doubles outwards, record a photograph?

New here: a bundled layout (``layouts/four_zones.yaml``), a picture of a region,
additivity of charge.

Expect: Fig. 14 of the paper with another photograph: 13,312 photosites, compared with
262,144 of a uniform grid of the smallest ones. The expected charge of a photosite of 8,
16 or 32 µm is the sum over the 4, 16 or 64 small ones in the same area, within 1e-12 of
the total charge; in the central zone both sensors are equal.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from skimage.data import camera as photographer

import foveasim as fs
from foveasim.config import read_any_layout
from foveasim.view import save_figure

SMALLEST_UM, SIDE_UM = 4.0, 2048.0
EXPOSURE_S = 1 / 30


def main(out_dir: Path) -> None:
    """Write the pictures of both sensors to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Scene, and two sensors of the same size: four zones, and a uniform grid of the
    # smallest photosites. Additional sky at the top shifts the photographer to the
    # finest zone.
    photograph = np.pad(photographer(), ((126, 0), (25, 0)), mode="edge")[:512, :512]
    scene = fs.Scene.from_picture(
        photograph,
        pitch_um=520.0,
        distance_m=1.0,
        peak_radiance_w_m2_sr_nm=0.01,
        wavelength_nm=(550.0,),
        band_width_nm=100.0,
    )
    optics = fs.Optics(focal_length_mm=8.0, f_number=2.8)
    zones = read_any_layout("four_zones").layout
    n_side = round(SIDE_UM / SMALLEST_UM)
    fine = fs.layout.grid(n_x=n_side, n_y=n_side, pitch_um=SMALLEST_UM)

    def capture(layout: fs.Layout) -> fs.Capture:
        sensor = fs.Sensor(
            layout,
            qe=fs.SiliconQE(depth_um=3.0),
            capacitance_f=4e-16 * layout.area_um2,
            read_noise_e=2.0,
            bits=10,
        )
        return fs.Camera(optics=optics, sensor=sensor).capture(
            scene, exposure_s=EXPOSURE_S, seed=1
        )

    zone_capture, fine_capture = capture(zones), capture(fine)

    # %% Both pictures, and the central zone.
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    centre = fs.Grid((512, 512), 0.5, (-128.0, -128.0))
    for ax, (title, shot, grid) in zip(
        figure.subplots(1, 3),
        (
            (f"{fine.n_sites:,} photosites\nof 4 µm", fine_capture, None),
            (
                f"{zones.n_sites:,} photosites\nof 4, 8, 16 and 32 µm",
                zone_capture,
                None,
            ),
            ("central zone:\n4,096 photosites of 4 µm", zone_capture, centre),
        ),
        strict=True,
    ):
        picture = shot.picture(grid=grid)
        image = picture.to_image(shot.white_dn)
        x_min, y_min, x_max, y_max = picture.grid.bounds_um
        ax.imshow(
            image[..., 0],
            cmap="gray",
            vmin=0,
            vmax=255,
            extent=(x_min, x_max, y_min, y_max),
        )
        ax.set_title(title, fontsize=10)
        ax.set(xlabel="x / µm", ylabel="y / µm")
    save_figure(figure, out_dir / "16_four_zones.png", dpi=140)

    # %% Additivity: the charge of every photosite is the sum over the small ones in the
    # same area.
    column, row = (np.floor(fine.centroid_um / SMALLEST_UM).astype(int) + n_side // 2).T
    charge_e = np.zeros((n_side, n_side))
    charge_e[row, column] = fine_capture.expected_e
    sums = np.pad(charge_e.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    low, high = (
        np.rint(zones.site_bounds_um / SMALLEST_UM + n_side // 2)
        .astype(int)
        .reshape(-1, 2, 2)
        .swapaxes(0, 1)
    )
    summed_e = (
        sums[high[:, 1], high[:, 0]]
        - sums[low[:, 1], high[:, 0]]
        - sums[high[:, 1], low[:, 0]]
        + sums[low[:, 1], low[:, 0]]
    )
    error = float(np.max(np.abs(zone_capture.expected_e - summed_e)) / sums[-1, -1])
    print(
        f"{zones.n_sites} sites, uniform grid {fine.n_sites}; largest error of "
        f"the sums {error:.1e} of the total charge"
    )
    assert (zones.n_sites, fine.n_sites) == (13_312, 262_144)
    assert error < 1e-12


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

"""
How large is the blind spot of a log-polar sensor, and which foveas remove it?

New here: ``log_polar(fovea=)`` in a capture, ``Picture.coverage`` for regions without
photosites.

Expect: the same photograph through four sensors that differ only in the centre. Without
a fovea, a disc with a radius of 60.12 µm has no data (11,355 µm² within 0.5 %, since
its boundary consists of chords). Hexagons, rings and linear rings cover it, and no
photosite is smaller than the minimum size of 2 µm.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from skimage.data import astronaut

import foveasim as fs
from foveasim.view import save_figure

MIN_SIZE_UM = 2.0
#: Grid of the centre, with pixels of 0.5 µm.
CENTRE = fs.Grid((520, 520), 0.5, (-130.0, -130.0))
FOVEAS = {
    "none": "blind spot",
    "hexagons": "hexagons",
    "rings": "rings",
    "linear": "linear rings",
}


def main(out_dir: Path) -> None:
    """Write the four pictures to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Face of the astronaut on the optical axis.
    scene = fs.Scene.from_picture(
        astronaut()[20:200, 134:314],
        pitch_um=250.0,
        distance_m=1.0,
        peak_radiance_w_m2_sr_nm=0.006,
        wavelength_nm=(620, 550, 450),
    )
    optics = fs.Optics(focal_length_mm=8.0, f_number=2.8)

    # %% Four sensors with rings of 192 sites, which differ in the fovea, and their
    # pictures of the centre.
    figure = Figure(figsize=(8.0, 8.4), layout="constrained")
    uncovered_um2, sizes_um = {}, {}
    x_um, y_um = np.meshgrid(CENTRE.x_um, CENTRE.y_um)
    is_within = np.hypot(x_um, y_um) < 125.0
    for axes, (fovea, name) in zip(
        figure.subplots(2, 2).ravel(), FOVEAS.items(), strict=True
    ):
        layout = fs.layout.log_polar(
            n_sectors=192,
            min_size_um=MIN_SIZE_UM,
            r_max_um=175.0,
            fovea=fovea,
            stagger=True,
            chords_per_arc=2,
        )
        sensor = fs.Sensor(
            layout,
            qe=fs.SiliconQE(depth_um=3.0),
            capacitance_f=4e-16 * layout.area_um2,
            read_noise_e=2.0,
            bits=10,
        )
        capture = fs.Camera(optics=optics, sensor=sensor).capture(
            scene, exposure_s=1 / 30, seed=1
        )
        picture = capture.picture(grid=CENTRE)
        image = picture.to_image(capture.white_dn)
        x_min, y_min, x_max, y_max = CENTRE.bounds_um
        axes.set_facecolor("#b9c4d6")
        grey = np.dstack((image[..., :1],) * 3 + (image[..., 1:],))
        axes.imshow(grey, extent=(x_min, x_max, y_min, y_max), origin="upper")
        axes.set_title(f"{name}: {layout.n_sites:,} photosites")
        axes.set(xlabel="x / µm", ylabel="y / µm")
        uncovered_um2[fovea] = (
            float((1.0 - picture.coverage[is_within]).sum()) * CENTRE.cell_area_um2
        )
        sizes_um[fovea] = float(np.sqrt(layout.area_um2.min()))
    save_figure(figure, out_dir / "17_filling_the_blind_spot.png", dpi=140)

    # %% Checks.
    for fovea, area_um2 in uncovered_um2.items():
        print(
            f"{FOVEAS[fovea]}: {area_um2:.0f} µm² without data, "
            f"smallest pixel {sizes_um[fovea]:.2f} µm"
        )
    spot_um2 = math.pi * 60.12**2
    assert abs(uncovered_um2["none"] / spot_um2 - 1.0) < 0.005
    assert all(
        uncovered_um2[fovea] < 1e-3 * spot_um2 for fovea in FOVEAS if fovea != "none"
    )
    assert min(sizes_um.values()) > 0.99 * MIN_SIZE_UM


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

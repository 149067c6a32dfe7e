"""
What does the blind spot of a log-polar sensor hide, and what do its cures bring back?

New here: ``log_polar(fovea=)`` in a capture, ``Picture.coverage`` for what no photosite saw.

Expect: the same photograph through four sensors that differ in the middle alone. Without a cure a disc of 60.12 µm radius has
no data (11,355 µm², within 0.5 %: its border is of chords); filled with hexagons, rings or linear rings all is seen, and no
pixel is smaller than the 2 µm that the process allows.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import shapely
from matplotlib.figure import Figure
from skimage.data import astronaut

import foveasim as fs
from foveasim.view import save_figure

MIN_SIZE_UM = 2.0
#: The part that is shown: the middle, half a micron a pixel.
MIDDLE = fs.Grid((520, 520), 0.5, (-130.0, -130.0))
INNER_UM = (-10.0, -10.0, 72.0, 72.0)
CURES = {"none": "blind spot", "hexagons": "hexagons", "rings": "rings", "linear": "linear rings"}


def main(out_dir: Path) -> None:
    """Write the four pictures to a folder."""
    # %% The face of the astronaut on the axis of the lens.
    scene = fs.Scene.from_picture(
        astronaut()[20:200, 134:314],
        pitch_um=250.0,
        distance_m=1.0,
        peak_radiance_w_m2_sr_nm=0.006,
        wavelength_nm=(620, 550, 450),
    )
    optics = fs.Optics(focal_length_mm=8.0, f_number=2.8)

    figure = Figure(figsize=(13.0, 6.9), layout="constrained")
    axes = figure.subplots(2, 4)
    hidden_um2, sizes_um = {}, {}
    for k, (fovea, name) in enumerate(CURES.items()):
        # %% One sensor: rings of 192 sites, and what fills the middle.
        layout = fs.layout.log_polar(
            n_sectors=192, min_size_um=MIN_SIZE_UM, r_max_um=175.0, fovea=fovea, stagger=True, chords_per_arc=2
        )
        sensor = fs.Sensor(
            layout, qe=fs.SiliconQE(depth_um=3.0), capacitance_f=4e-16 * layout.area_um2, read_noise_e=2.0, bits=10
        )
        capture = fs.Camera(optics=optics, sensor=sensor).capture(scene, exposure_s=1 / 30, seed=1)

        # %% What it sees of the middle, and with what.
        picture = capture.picture(grid=MIDDLE)
        image = picture.to_image(capture.white_dn, encode_srgb=True)
        x_min, y_min, x_max, y_max = MIDDLE.bounds_um
        axes[0, k].set_facecolor("#b9c4d6")
        axes[0, k].imshow(
            np.dstack((image[..., :1],) * 3 + (image[..., 1:],)), extent=(x_min, x_max, y_min, y_max), origin="upper"
        )
        axes[0, k].set_title(f"{name}: {layout.n_sites:,} photosites")
        inner = fs.layout.clip(layout, shapely.box(*INNER_UM), cut="drop")
        inner.plot(ax=axes[1, k])
        axes[1, k].set(xlim=INNER_UM[::2], ylim=INNER_UM[1::2], ylabel="")

        # %% What stays hidden.
        x_um, y_um = np.meshgrid(MIDDLE.x_um, MIDDLE.y_um)
        is_within = np.hypot(x_um, y_um) < 125.0
        hidden_um2[fovea] = float((1.0 - picture.coverage[is_within]).sum()) * MIDDLE.cell_area_um2
        sizes_um[fovea] = float(np.sqrt(layout.area_um2.min()))
    save_figure(figure, out_dir / "17_blind_spot_cures.png", dpi=110)

    # %% The numbers.
    for fovea, area_um2 in hidden_um2.items():
        print(f"{CURES[fovea]}: {area_um2:.0f} µm² hidden, smallest pixel {sizes_um[fovea]:.2f} µm")
    spot_um2 = math.pi * 60.12**2
    assert abs(hidden_um2["none"] / spot_um2 - 1.0) < 0.005
    assert all(hidden_um2[fovea] < 1e-3 * spot_um2 for fovea in CURES if fovea != "none")
    assert min(sizes_um.values()) > 0.99 * MIN_SIZE_UM


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

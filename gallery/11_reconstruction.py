"""
Which reconstruction method recovers a photograph best from the codes of a foveal
sensor?

New here: ``Capture.picture(method=)``: "cells", "linear", "natural", "least_squares";
``Camera.reference``; ``foveasim.metrics.psnr_db`` and ``ssim``.

Expect: a PSNR of about 27 dB for "least_squares", relative to the charge density on the
sensor, at least 2 dB more than the 24 dB of "cells"; about 1 dB more than "cells" for
the two interpolations between centroids; no data in the blind spot.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import skimage.data
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

import foveasim as fs
from foveasim.metrics import psnr_db, ssim
from foveasim.view import save_figure

WAVELENGTH_NM, BAND_WIDTH_NM = 550.0, 50.0
DISTANCE_M, EXPOSURE_S = 0.5, 0.01
RADIANCE_W_M2_SR_NM = 0.01
FIELD_UM, N_PIXELS = 1024.0, 512
#: The maximum irradiance gives two thirds of the highest code for all site sizes.
CAPACITANCE_F_PER_UM2 = 6e-17
#: Pixels without photosites: none of the grey levels of a picture.
NO_DATA = {
    "facecolor": "0.93",
    "edgecolor": "0.6",
    "hatch": "////",
    "linewidth": 0.0,
    "label": "no photosites",
}
#: Face of the astronaut, x and y, where photosites measure 6 to 13 µm.
FACE_UM = (-190.0, 50.0, 150.0, 390.0)
METHODS = ("cells", "linear", "natural", "least_squares")


def main(out_dir: Path) -> None:
    """Write the pictures side by side to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% A photograph on a log-polar sensor with capacitances proportional to the areas
    # of the sites.
    layout = fs.layout.log_polar(
        n_sectors=200, min_size_um=2.0, r_max_um=510.0, stagger=True
    )
    optics = fs.Optics(focal_length_mm=8.0, f_number=4.0)
    sensor = fs.Sensor(
        layout,
        qe=0.6,
        capacitance_f=CAPACITANCE_F_PER_UM2 * layout.area_um2,
        v_sat_v=1.0,
        bits=10,
        read_noise_e=3.0,
    )
    photograph = skimage.data.astronaut()
    scene = fs.Scene.from_picture(
        photograph,
        pitch_um=FIELD_UM / photograph.shape[0] / optics.magnification(DISTANCE_M),
        distance_m=DISTANCE_M,
        peak_radiance_w_m2_sr_nm=RADIANCE_W_M2_SR_NM,
        wavelength_nm=(WAVELENGTH_NM,),
        band_width_nm=BAND_WIDTH_NM,
    )
    camera = fs.Camera(optics=optics, sensor=sensor)
    capture = camera.capture(scene, exposure_s=EXPOSURE_S, seed=1)
    print(
        f"{capture}: {np.median(capture.electrons):,.0f} electrons in the median site"
    )

    # %% Four pictures of the same codes, in electrons per µm², and their reference.
    grid = fs.Grid.centred((N_PIXELS, N_PIXELS), FIELD_UM / N_PIXELS)
    reference = camera.reference(scene, grid, exposure_s=EXPOSURE_S)
    pictures = {
        method: capture.picture(
            method, of="light_e", per="um2", grid=grid, sensor=sensor
        )
        for method in METHODS
    }
    quality_db = {
        method: psnr_db(picture, reference, min_coverage=1.0)
        for method, picture in pictures.items()
    }
    similarity = {
        method: ssim(picture, reference, min_coverage=1.0)
        for method, picture in pictures.items()
    }
    for method in METHODS:
        print(
            f"{method:13s}: PSNR {quality_db[method]:.2f} dB, SSIM "
            f"{similarity[method]:.3f}"
        )

    # %% Figure: a complete picture, and the face in each of them.
    white = float(np.nanmax(reference.data))
    figure = Figure(figsize=(8.0, 5.9), layout="constrained")
    (complete, *closer) = figure.subplots(2, 3).flat
    left, bottom, right, top = grid.bounds_um
    panels = {"reference": reference, **pictures}
    for panel, name in zip((complete, *closer), ("cells", *panels), strict=True):
        panel.add_patch(
            Rectangle((left, bottom), right - left, top - bottom, **NO_DATA)
        )
        shown = fs.units.encode_srgb(np.clip(panels[name].data[0] / white, 0.0, 1.0))
        extent = (left, right, bottom, top)
        panel.imshow(
            shown,
            origin="lower",
            cmap="gray",
            vmin=0.0,
            vmax=1.0,
            extent=extent,
            zorder=2,
        )
        panel.set_xticks([])
        panel.set_yticks([])
        panel.set_title(
            name if name not in quality_db else f"{name}: {quality_db[name]:.1f} dB",
            fontsize=11,
        )
    complete.set_title("the field, with the part shown", fontsize=11)
    complete.add_patch(
        Rectangle(
            (FACE_UM[0], FACE_UM[2]),
            *np.diff(FACE_UM)[::2],
            fill=False,
            color="tab:red",
            zorder=3,
        )
    )
    complete.legend(handles=[Patch(**NO_DATA)], loc="lower left", fontsize=10)
    for panel in closer:
        panel.set(xlim=FACE_UM[:2], ylim=FACE_UM[2:])
    save_figure(figure, out_dir / "11_reconstruction.png", dpi=140)

    # %% Files for other programs: a PNG file of 16 bits for display, and a TIFF file of
    # the values.
    pictures["least_squares"].save(out_dir / "11_least_squares.png", white, bits=16)
    pictures["least_squares"].save(out_dir / "11_least_squares.tif")

    # %% Checks.
    assert quality_db["least_squares"] > quality_db["cells"] + 2.0
    assert min(quality_db["linear"], quality_db["natural"]) > quality_db["cells"] + 0.5
    assert similarity["least_squares"] > similarity["cells"]
    for picture in pictures.values():
        assert np.isnan(picture.data[0, N_PIXELS // 2, N_PIXELS // 2])


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

"""
How much of a photograph is in the codes of a foveal sensor, and which picture shows it?

New here: ``Capture.picture(method=)``: "cells", "linear", "natural", "least_squares"; ``Camera.reference``;
``foveasim.metrics.psnr_db`` and ``ssim``.

Expect: the picture of least squares at least 2 dB nearer to the light on the sensor than that of cells, about 27 dB against 24;
pictures between the centres about 1 dB nearer; the blind spot open in all of them.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import skimage.data
from matplotlib.figure import Figure

import foveasim as fs
from foveasim._io.encodings import encode_srgb_values
from foveasim.metrics import psnr_db, ssim
from foveasim.view import save_figure

WAVELENGTH_NM, BAND_WIDTH_NM = 550.0, 50.0
DISTANCE_M, EXPOSURE_S = 0.5, 0.01
RADIANCE_W_M2_SR_NM = 0.01
FIELD_UM, N_PIXELS = 1024.0, 512
#: Capacitance of a square micrometre: the brightest light fills two thirds of the codes of small and large sites alike.
CAPACITANCE_F_PER_UM2 = 6e-17
METHODS = ("cells", "linear", "natural", "least_squares")


def main(out_dir: Path) -> None:
    """Write the pictures side by side to a folder."""
    # %% A photograph on a log-polar sensor whose capacitances grow with the sites' areas.
    layout = fs.layout.log_polar(n_sectors=200, min_size_um=2.0, r_max_um=510.0, stagger=True)
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
    print(f"{capture}: {np.median(capture.electrons):,.0f} electrons in the median site")

    # %% Four pictures of the same codes, in electrons per µm², and the light that they are of.
    grid = fs.Grid.centred((N_PIXELS, N_PIXELS), FIELD_UM / N_PIXELS)
    light = camera.reference(scene, grid, exposure_s=EXPOSURE_S)
    pictures = {
        method: capture.picture(method, of="light_e", per="um2", grid=grid, sensor=sensor) for method in METHODS
    }
    near_db = {method: psnr_db(picture, light, min_coverage=1.0) for method, picture in pictures.items()}
    check_consistent = {method: ssim(picture, light, min_coverage=1.0) for method, picture in pictures.items()}
    for method in METHODS:
        print(f"{method:13s}: PSNR {near_db[method]:.2f} dB, SSIM {check_consistent[method]:.3f}")

    # %% The picture: all of it, and its middle.
    white = float(np.nanmax(light.data))
    figure = Figure(figsize=(20, 8.6), layout="constrained")
    axes = figure.subplots(2, 5)
    panels = {"light on the sensor": light, **pictures}
    left, bottom, right, top = grid.bounds_um
    for column, (name, picture) in enumerate(panels.items()):
        shown = encode_srgb_values(np.clip(picture.data[0] / white, 0.0, 1.0))
        for place in axes[:, column]:
            place.set_facecolor("tab:blue")  # no data
            place.imshow(
                shown, origin="lower", cmap="gray", vmin=0.0, vmax=1.0, extent=(left, right, bottom, top), zorder=1
            )
            place.set_xticks([])
            place.set_yticks([])
        axes[1, column].set(xlim=(-150.0, 150.0), ylim=(-150.0, 150.0))
        axes[0, column].set_title(name if name not in near_db else f"{name}: {near_db[name]:.1f} dB")
    axes[0, 0].set_ylabel("whole")
    axes[1, 0].set_ylabel("the middle 300 µm")
    save_figure(figure, out_dir / "11_reconstruction.png", dpi=70)

    # %% The same for other programs: 16 bits to look at, and the values themselves.
    pictures["least_squares"].save(out_dir / "11_least_squares.png", white, encode_srgb=True, bits=16)
    pictures["least_squares"].save(out_dir / "11_least_squares.tif")

    # %% The numbers.
    assert near_db["least_squares"] > near_db["cells"] + 2.0
    assert min(near_db["linear"], near_db["natural"]) > near_db["cells"] + 0.5
    assert check_consistent["least_squares"] > check_consistent["cells"]
    for picture in pictures.values():
        assert np.isnan(picture.data[0, N_PIXELS // 2, N_PIXELS // 2])


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

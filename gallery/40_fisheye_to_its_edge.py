"""
What does a calibrated fisheye camera record of everything around it, to the edge of its
image?

New here: ``fs.distortion.read_calibration`` of a lens beyond 90°,
``Optics(pupil_tilt=...)``, pictures of a fisheye in other projections.

Expect: the calibration of OCamCalib reaches 129° in the corners; 48 % of the photosites
see directions beyond 90°, which is the white circle, and none is dark. Behind a flat
pupil, which directions beyond 90° do not meet, 50 % would be dark.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.view import save_figure

sys.path.insert(0, str(Path(__file__).parent))
town = import_module("39_omnidirectional_fovea").town
sys.path.pop(0)

#: A calibration of the camera Kodak PIXPRO SP360 4K by OCamCalib, at 1440 x 1440
#: pixels: https://github.com/uts-magic-lab/kodak_pixpro_sp360_ros.
CALIBRATION = (
    "#polynomial coefficients for the DIRECT mapping function",
    "5 -2.716972e+02 0.000000e+00 -2.741744e-06 1.840940e-06 -8.024838e-10",
    "#polynomial coefficients for the inverse mapping function",
    (
        "13 583.439624 470.805865 97.165132 120.712689 100.686168 55.067847 67.348203 "
        "15.186683 1.492255 84.459767 105.607698 48.090642 7.785426"
    ),
    '#center: "row" and "column", starting from 0 (C convention)',
    "728.648728 729.090632",
    '#affine parameters "c", "d", "e"',
    "1.001407 -0.000818 0.000221",
    '#image size: "height" and "width"',
    "1440 1440",
)
#: Assumed size of its pixels; photosites of this example are larger.
PIXEL_UM, N_PIXELS, BINNING = 3.0, 1440, 5
#: Parameters for a test of the script.
QUICK = {"n_y": 128, "binning": 30}


def calibrated_lens() -> fs.distortion.Scaramuzza:
    """Return the lens model of the calibration."""
    focal_um = 271.6972 * PIXEL_UM
    with TemporaryDirectory() as folder:
        path = Path(folder) / "calib_results.txt"
        path.write_text("\n".join(CALIBRATION))
        return fs.distortion.read_calibration(
            path, pixel_um=PIXEL_UM, focal_um=focal_um
        )


def main(out_dir: Path, n_y: int = 1024, binning: int = BINNING) -> None:
    """Write the figure to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% The camera: the lens model selects the projection of the intermediate image.
    lens = calibrated_lens()
    n = N_PIXELS // binning
    layout = fs.layout.mosaic(
        fs.layout.grid(n_x=n, n_y=n, pitch_um=binning * PIXEL_UM), ("RG", "GB")
    )
    sensor = fs.Sensor(layout, filters="rgb", read_noise_e=3.0)
    focal_mm = 1e-3 * lens.focal_um
    scene = fs.Scene.from_panorama(town(n_y), illuminance_lux=10_000.0, pitch_deg=60.0)
    captures = {}
    for tilt in ("turning", "flat"):
        optics = fs.Optics(focal_length_mm=focal_mm, f_number=2.8, pupil_tilt=tilt)
        camera = fs.Camera(optics=optics, sensor=sensor, distortion=lens)
        captures[tilt] = camera.capture(scene, exposure_s=5e-3, seed=0)

    # %% Angles of the photosites to the axis.
    z = lens.direction(layout.centroid_um)[:, 2]
    is_behind = z < 0.0
    corner_deg = np.degrees(np.arccos(z.min()))
    dark = {
        tilt: np.mean(capture.expected_e < 1e-3 * capture.expected_e.max())
        for tilt, capture in captures.items()
    }
    print(f"image: {camera.projection(scene)}, up to {corner_deg:.0f}°")
    print(f"beyond 90°: {100.0 * is_behind.mean():.0f} % of the photosites")
    print(f"dark: {100 * dark['turning']:.0f} %, flat pupil {100 * dark['flat']:.0f} %")
    assert dark["turning"] == 0.0
    assert dark["flat"] > is_behind.mean() > 0.4

    # %% The fisheye picture with its circle of 90°, and the same as a panorama.
    azimuth = np.linspace(0.0, 2.0 * np.pi, 361)
    circle = np.stack((np.cos(azimuth), np.sin(azimuth), 0.0 * azimuth), axis=1)
    figure = Figure(figsize=(10.0, 6.6), layout="constrained")
    axes = figure.subplots(2, 2, width_ratios=(1.0, 2.0))
    for row, (tilt, capture) in zip(axes, captures.items(), strict=True):
        picture = capture.picture(max_pixels=720)
        x0, y0, x1, y1 = picture.grid.bounds_um
        row[0].imshow(picture.to_image(background="black"), extent=(x0, x1, y0, y1))
        row[0].plot(*lens.project(circle).T, color="white", linewidth=1.0)
        row[0].set_title(f"{tilt} pupil", fontsize=13)
        panorama = capture.picture(max_pixels=1000, projection="equirectangular")
        row[1].imshow(panorama.to_image(background="black"))
        row[1].set_title("unwrapped around the axis", fontsize=13)
        for ax in row:
            ax.set_axis_off()
    save_figure(figure, out_dir / "40_fisheye_to_its_edge.png")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

"""
How does a foveal colour sensor capture a photograph, compared with a square grid of as many photosites?

New here: ``layout.log_polar``, ``layout.mosaic``, ``Scene.from_picture``, ``Optics``, ``Sensor``, ``Camera``, ``Capture``.

Expect: a blind spot with a radius of 60.12 µm (within 0.01 µm), the inner radius of the first ring with pixels of at least
2 µm; photosites of 11.4 µm on the square grid, which covers the same field.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

from skimage.data import astronaut

import foveasim as fs
from foveasim.view import plot_capture, save_figure

PITCH_UM = 500.0
DISTANCE_M = 1.0
EXPOSURE_S = 1 / 30
#: Position of the face in the image.
GAZE_UM = (-140.0, 320.0)


def camera_of(layout: fs.Layout) -> fs.Camera:
    """Return a camera with these photosites and a fixed capacitance per area."""
    sensor = fs.Sensor(
        layout,
        qe=fs.SiliconQE(depth_um=3.0),
        filters="rgb",
        capacitance_f=1e-15 * layout.area_um2,
        read_noise_e=1.0,
        bits=10,
    )
    return fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)


def main(out_dir: Path) -> None:
    """Write the pictures and the layout to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Scene: a photograph with pixels of 0.5 mm at a distance of 1 m.
    scene = fs.Scene.from_picture(
        astronaut(),
        pitch_um=PITCH_UM,
        distance_m=DISTANCE_M,
        peak_radiance_w_m2_sr_nm=0.02,
        wavelength_nm=(620, 550, 450),
    )

    # %% Sensor: rings of 192 sites of at least 2 µm.
    layout = fs.layout.log_polar(n_sectors=192, min_size_um=2.0, r_max_um=690.0, stagger=True, chords_per_arc=2)
    layout = fs.layout.mosaic(layout, ("RG", "GB"))
    camera = camera_of(layout)

    # %% Capture, with the gaze on the face.
    capture = camera.capture(scene, exposure_s=EXPOSURE_S, seed=1, gaze_um=GAZE_UM)
    capture.picture(max_pixels=800).save(out_dir / "01_foveal_picture.png", capture.white_dn)
    axes = plot_capture(capture)
    save_figure(axes.figure, out_dir / "01_foveal_layout.png", dpi=140)

    # %% The same field on a square grid with as many photosites.
    x_min, _, x_max, _ = layout.bounds_um
    n = math.isqrt(layout.n_sites)
    pitch_um = (x_max - x_min) / n
    square = fs.layout.mosaic(fs.layout.grid(n_x=n, n_y=n, pitch_um=pitch_um), ("RG", "GB"))
    square_capture = camera_of(square).capture(scene, exposure_s=EXPOSURE_S, seed=1, gaze_um=GAZE_UM)
    square_capture.picture(max_pixels=800).save(out_dir / "01_square_picture.png", square_capture.white_dn)

    # %% Checks.
    print(f"{square.n_sites} square photosites of {pitch_um:.1f} µm")
    assert abs(pitch_um - 11.4) < 0.05
    blind_radius_um = layout.provenance["blind_radius_um"]
    print(f"{layout.n_sites} foveal photosites, blind spot with a radius of {blind_radius_um:.2f} µm")
    assert abs(blind_radius_um - 60.12) < 0.01


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

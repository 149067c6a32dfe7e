"""
What does a foveal colour sensor see of a photograph?

New here: ``layout.log_polar``, ``layout.mosaic``, ``Scene.from_picture``, ``Optics``, ``Sensor``, ``Camera``, ``Capture``.

Expect: a blind spot of 60.12 µm radius (within 0.01 µm), the inner edge of the first ring whose pixels reach 2 µm.
"""

from __future__ import annotations

import sys
from pathlib import Path

from skimage.data import astronaut

import foveasim as fs
from foveasim.view import plot_capture, save_figure

PITCH_UM = 500.0
DISTANCE_M = 1.0
EXPOSURE_S = 1 / 30


def main(out_dir: Path) -> None:
    """Write the picture and the layout to a folder."""
    # %% The scene: a photograph, half a millimetre a pixel, one metre away.
    scene = fs.Scene.from_picture(
        astronaut(),
        pitch_um=PITCH_UM,
        distance_m=DISTANCE_M,
        peak_radiance_w_m2_sr_nm=0.02,
        wavelength_nm=(620, 550, 450),
    )

    # %% The sensor: rings of 192 sites, none smaller than 2 µm, looking at the face.
    layout = fs.layout.log_polar(n_sectors=192, min_size_um=2.0, r_max_um=690.0, stagger=True, chords_per_arc=2)
    layout = fs.layout.mosaic(layout, ("RG", "GB")).translate(-140.0, 320.0)
    sensor = fs.Sensor(
        layout,
        qe=fs.SiliconQE(depth_um=3.0),
        filters="rgb",
        capacitance_f=1e-15 * layout.area_um2,
        read_noise_e=1.0,
        bits=10,
    )

    # %% The shot.
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)
    capture = camera.capture(scene, exposure_s=EXPOSURE_S, seed=1)
    capture.picture(max_pixels=800).save(out_dir / "01_foveal_picture.png", capture.white_dn, encode_srgb=True)
    axes = plot_capture(capture)
    save_figure(axes.figure, out_dir / "01_foveal_layout.png", dpi=100)

    # %% The number.
    blind_radius_um = layout.provenance["blind_radius_um"]
    print(f"blind spot of {blind_radius_um:.2f} µm radius, {layout.n_sites} photosites")
    assert abs(blind_radius_um - 60.12) < 0.01


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

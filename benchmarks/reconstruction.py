"""
Pictures by every method of reconstruction against the light on the sensor: PSNR and time, as a table.

    python benchmarks/reconstruction.py

Three photographs on three layouts, f/4, 10 bits, a read noise of 3 electrons; capacitances as the sites' areas, so that the
brightest site is at 90 % of the range. Only pixels that photosites cover wholly are compared.
"""

from __future__ import annotations

import time

import numpy as np
import skimage.data
from rich.console import Console
from rich.table import Table
from skimage.color import rgb2gray
from skimage.transform import resize

import foveasim as fs
from foveasim.metrics import psnr_db, ssim
from foveasim.units import ELEMENTARY_CHARGE_C

METHODS = ("cells", "linear", "natural", "least_squares")
GRID = fs.Grid.centred((512, 512), 2.0)
EXPOSURE_S, READ_NOISE_E, FILLED = 0.01, 3.0, 0.9
SCENE = {"distance_m": 0.5, "wavelength_nm": [550.0], "band_width_nm": 50.0, "peak_radiance_w_m2_sr_nm": 0.01}
LAYOUTS = {
    "log-polar": fs.layout.log_polar(n_sectors=200, min_size_um=2.0, r_max_um=510.0, stagger=True),
    "hexagons": fs.layout.hexagonal(n_columns=164, n_rows=186, pitch_um=6.2),
    "four zones": fs.layout.zones(side_um=(128, 256, 512, 1024), pitch_um=(2, 4, 8, 16)),
}


def captured(layout: fs.Layout, scene: fs.Scene) -> tuple[fs.Camera, fs.Capture]:
    """Return a capture with the brightest site at 90 % of the range."""
    optics = fs.Optics(focal_length_mm=8.0, f_number=4.0)
    plain = fs.Sensor(layout, qe=0.6)
    trial = fs.Camera(optics=optics, sensor=plain).capture(scene, exposure_s=EXPOSURE_S, seed=0)
    most_e_per_um2 = float((trial.expected_e / layout.area_um2).max())
    capacitance_f = most_e_per_um2 * layout.area_um2 * ELEMENTARY_CHARGE_C / (FILLED * plain.v_sat_v)
    sensor = fs.Sensor(layout, qe=0.6, capacitance_f=capacitance_f, read_noise_e=READ_NOISE_E, bits=10)
    camera = fs.Camera(optics=optics, sensor=sensor)
    return camera, camera.capture(scene, exposure_s=EXPOSURE_S, seed=1)


def main() -> None:
    """Print the table."""
    table = Table(title="PSNR in dB, SSIM, seconds; reference: irradiance on the sensor")
    for heading in ("layout", "photograph", *METHODS):
        table.add_column(heading)
    for kind, layout in LAYOUTS.items():
        for name in ("astronaut", "coffee", "chelsea"):
            grey = resize(rgb2gray(getattr(skimage.data, name)()), (600, 600), anti_aliasing=True)
            scene = fs.Scene.from_picture(np.rint(255.0 * grey).astype(np.uint8), pitch_um=112.5, **SCENE)
            camera, capture = captured(layout, scene)
            reference = camera.reference(scene, GRID, exposure_s=EXPOSURE_S)
            cells = []
            for method in METHODS:
                start = time.perf_counter()
                picture = capture.picture(method, grid=GRID, of="light_e", per="um2", sensor=camera.sensor)
                s = time.perf_counter() - start
                psnr, likeness = (measure(picture, reference, min_coverage=1.0) for measure in (psnr_db, ssim))
                cells.append(f"{psnr:.1f}  {likeness:.3f}  {s:.2f} s")
            table.add_row(f"{kind}, {layout.n_sites:,} sites", name, *cells)
    Console(width=140).print(table)


if __name__ == "__main__":
    main()

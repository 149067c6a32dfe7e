"""
What does a foveal sensor see of everything around it, through one fisheye lens?

New here: ``fs.Scene.from_panorama``, ``fs.Camera(gaze_deg=...)``,
``capture.picture(projection=...)``.

Expect: 12,528 photosites over a field of 200°, half of them within 15° of the axis.
Unwrapped pictures are sharp where the camera looks, and coarse at the sides and behind;
windows are visible where the gaze is on them.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.view import save_figure

FOCAL_UM, FIELD_DEG = 1000.0, 200.0
#: Gazes: azimuth and elevation, degrees.
GAZES_DEG = ((0.0, 0.0), (70.0, 12.0))
N_SECTORS, R_MIN_UM = 144, 40.0
#: Parameters for a test of the script.
QUICK = {"n_y": 128, "n_sectors": 48}


def town(n_y: int) -> np.ndarray:
    """Return an equirectangular picture (n_y, 2 n_y, 3) of houses under a sky."""
    azimuth_deg, elevation_deg = np.meshgrid(
        (np.arange(2 * n_y) + 0.5) * 180.0 / n_y - 180.0,
        90.0 - (np.arange(n_y) + 0.5) * 180.0 / n_y,
    )
    # The sky, brighter at the horizon, and a floor of tiles 1.5 m below the camera.
    height = np.clip(elevation_deg / 90.0, 0.0, 1.0)[..., np.newaxis]
    picture = (1.0 - height) * (0.85, 0.9, 1.0) + height * (0.2, 0.4, 0.8)
    away_m = 1.5 / np.tan(np.radians(np.maximum(-elevation_deg, 0.5)))
    x, y = (away_m * turn(np.radians(azimuth_deg)) for turn in (np.sin, np.cos))
    tiles = ((np.floor(x) + np.floor(y)) % 2)[..., np.newaxis]
    floor = tiles * (0.55, 0.5, 0.42) + (1.0 - tiles) * (0.3, 0.28, 0.25)
    picture = np.where((elevation_deg < 0.0)[..., np.newaxis], floor, picture)
    # Houses with windows, 20° wide, at random heights.
    random = np.random.default_rng(3)
    number = np.floor((azimuth_deg + 180.0) / 20.0).astype(int)
    tops_deg = random.uniform(8.0, 32.0, 18)
    walls = random.uniform(0.35, 0.9, (18, 3))
    along_deg = (azimuth_deg + 180.0) % 20.0
    is_house = (
        (elevation_deg > -3.0)
        & (elevation_deg < tops_deg[number])
        & (np.abs(along_deg - 10.0) < 8.5)
    )
    is_window = (along_deg % 4.0 > 1.2) & (along_deg % 4.0 < 3.2)
    is_window &= (elevation_deg % 5.0 > 1.5) & (elevation_deg % 5.0 < 4.0)
    house = np.where(is_window[..., np.newaxis], (0.08, 0.1, 0.14), walls[number])
    return np.where(is_house[..., np.newaxis], house, picture)


def camera(n_sectors: int) -> fs.Camera:
    """Return a camera with a fisheye lens and a log-polar layout."""
    r_max_um = FOCAL_UM * math.radians(0.5 * FIELD_DEG)
    n_rings = round(n_sectors * math.log(r_max_um / R_MIN_UM) / (2.0 * math.pi))
    layout = fs.layout.log_polar(
        n_sectors=n_sectors, n_rings=n_rings, r_min_um=R_MIN_UM, r_max_um=r_max_um
    )
    return fs.Camera(
        optics=fs.Optics(focal_length_mm=FOCAL_UM / 1000.0, f_number=2.8),
        sensor=fs.Sensor(layout, read_noise_e=3.0),
        distortion=fs.distortion.Fisheye(projection="equidistant", focal_um=FOCAL_UM),
    )


def main(out_dir: Path, n_y: int = 1024, n_sectors: int = N_SECTORS) -> None:
    """Write the figure to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Radiance by direction, and a lens that sees more than a hemisphere.
    scene = fs.Scene.from_panorama(town(n_y), illuminance_lux=10_000.0)
    foveal = camera(n_sectors)
    layout = foveal.layout
    angle_deg = np.degrees(np.hypot(*layout.centroid_um.T) / FOCAL_UM)
    n_near = int(np.median(angle_deg))
    print(f"{layout.n_sites:,} photosites, half of them within {n_near}°")
    assert n_near < 20.0
    assert angle_deg.max() > 90.0

    # %% The camera turns to two directions.
    captures = [
        foveal.capture(scene, exposure_s="auto", seed=0, gaze_deg=gaze_deg)
        for gaze_deg in GAZES_DEG
    ]

    # %% On the sensor, as a panorama around the axis, and as a view ahead.
    figure = Figure(figsize=(10.0, 5.6), layout="constrained")
    axes = figure.subplots(2, 3, width_ratios=(1.0, 2.0, 1.0))
    for row, capture, gaze_deg in zip(axes, captures, GAZES_DEG, strict=True):
        ahead = f"azimuth {gaze_deg[0]:g}°, elevation {gaze_deg[1]:g}°"
        ways = (
            ("on the sensor", {}),
            (ahead, {"projection": "equirectangular"}),
            ("90° ahead", {"projection": "rectilinear", "field_of_view_deg": 90.0}),
        )
        for ax, (title, way) in zip(row, ways, strict=True):
            picture = capture.picture(per="um2", max_pixels=800, **way)
            ax.imshow(picture.to_image(background="black"), cmap="gray")
            ax.set_title(title, fontsize=13)
            ax.set_axis_off()
    save_figure(figure, out_dir / "39_omnidirectional_fovea.png")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

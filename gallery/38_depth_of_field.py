"""
How does a lens blur a scene with depth, and how well do layers show what covers what?

New here: ``fs.Scene.from_rgbd``, ``Optics(focus_distance_m=...)`` with depth,
``Optics.power_map(reference=True)``.

Expect: a ball at 0.4 m, a post at 0.8 m and a wall at 3 m, on a floor, in focus in
turn. Behind the blurred edge of the ball, the wall is visible. Layers agree with rays
through points of the pupil within 1.5 % of white (root mean square), of which a part is
the diffraction that rays lack; six random scenes within 1 %, with larger errors where
the edges of objects that are out of focus coincide.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

import foveasim as fs
from foveasim.view import save_figure

#: Rows and columns of the picture, and distances of the objects, m.
SHAPE = (120, 160)
BALL_M, POST_M, WALL_M = 0.4, 0.8, 3.0
#: Height of the camera above the floor, m, and half the vertical field of view.
HEIGHT_M, HALF_TANGENT = 0.12, 0.3
#: Random scenes whose layers are compared with rays.
TITLES = (
    "sharp background",
    "sharp objects",
    "none in focus",
    "smooth surface",
    "varying depth",
    "three objects",
)
LIGHT = {"distance_m": POST_M, "illuminance_lux": 500.0, "encoding": "linear"}


def picture_and_depth() -> tuple[np.ndarray, np.ndarray]:
    """Return a sharp picture and the distance of each pixel, top row first."""
    n_y, n_x = SHAPE
    down, right = np.mgrid[:n_y, :n_x] + 0.5
    down = HALF_TANGENT * (2.0 * down / n_y - 1.0)
    right = HALF_TANGENT * (2.0 * right - n_x) / n_y
    floor_m = HEIGHT_M / np.maximum(down, 1e-6)
    depth_m = np.minimum(floor_m, WALL_M)
    is_wall = floor_m > WALL_M
    # Mean over each pixel, whose rows are wider than the squares of the far floor.
    rows = HALF_TANGENT * (2.0 * np.arange(9) - 8.0) / (9 * n_y)
    board = np.mean([squares(down + row, right, is_wall) for row in rows], axis=0)
    picture = np.where(is_wall, 0.55 + 0.35 * board, 0.1 + 0.4 * board)
    is_post = (np.abs(right - 0.18) < 0.05) & (floor_m > POST_M)
    depth_m = np.where(is_post, POST_M, depth_m)
    picture = np.where(is_post, 0.2 + 0.7 * (np.floor(down / 0.02) % 2), picture)
    is_ball = np.hypot(right + 0.14, down + 0.02) < 0.11
    depth_m = np.where(is_ball, BALL_M, depth_m)
    stripes = np.floor((right + down) / 0.02) % 2
    return np.where(is_ball, 0.15 + 0.5 * stripes, picture), depth_m


def squares(down: np.ndarray, right: np.ndarray, is_wall: np.ndarray) -> np.ndarray:
    """Return a chessboard on the wall and the floor, in directions (tangents)."""
    floor_m = HEIGHT_M / np.maximum(down, HEIGHT_M / WALL_M)
    across = right * np.where(is_wall, WALL_M / 0.15, floor_m / 0.04)
    along = np.where(is_wall, down * WALL_M / 0.15, floor_m / 0.04)
    return (np.floor(across) + np.floor(along)) % 2


def lens(focus_m: float) -> fs.Optics:
    """Return a lens with a focus distance."""
    return fs.Optics(focal_length_mm=6.0, f_number=1.8, focus_distance_m=focus_m)


def figure_of_focus(out: Path) -> None:
    """Draw pictures of a camera that is focused on each object."""
    picture, depth_m = picture_and_depth()
    scene = fs.Scene.from_rgbd(picture, depth_m, **LIGHT)
    layout = fs.layout.grid(n_x=140, n_y=105, pitch_um=4.0)
    sensor = fs.Sensor(layout)
    figure = Figure(figsize=(9.0, 2.7), layout="constrained")
    for axes, focus_m in zip(
        figure.subplots(1, 3), (BALL_M, POST_M, WALL_M), strict=True
    ):
        camera = fs.Camera(optics=lens(focus_m), sensor=sensor)
        capture = camera.capture(scene, exposure_s="auto", seed=0)
        axes.imshow(capture.code.reshape(105, 140), cmap="gray", origin="lower")
        axes.set_title(f"focus at {focus_m:g} m", fontsize=11)
        axes.set_axis_off()
    save_figure(figure, out / "38_focus.png")


def figure_of_errors(out: Path) -> float:
    """Draw layers, rays and their difference; return the root mean square error."""
    picture, depth_m = picture_and_depth()
    pitch_um = 4.0 / lens(POST_M).magnification(POST_M)
    scene = fs.Scene.from_rgbd(picture, depth_m, pitch_um=pitch_um, **LIGHT)
    optics = lens(POST_M)
    layers, rays = (
        optics.power_map(scene, reference=is_rays).data[0] for is_rays in (False, True)
    )
    white = rays.max()
    error = (layers - rays) / white
    figure = Figure(figsize=(9.0, 2.7), layout="constrained")
    views = figure.subplots(1, 3)
    for axes, title, image in zip(
        views[:2], ("layers", "rays"), (layers, rays), strict=True
    ):
        axes.imshow(image, cmap="gray", origin="lower")
        axes.set_title(title, fontsize=11)
    shown = views[2].imshow(
        100.0 * error, cmap="coolwarm", origin="lower", vmin=-10, vmax=10
    )
    views[2].set_title("difference, % of white", fontsize=11)
    figure.colorbar(shown, ax=views[2]).ax.tick_params(labelsize=11)
    for axes in views:
        axes.set_axis_off()
    save_figure(figure, out / "38_layers_and_rays.png")
    return float(np.sqrt(np.mean(error**2)))


def random_scene(kind: int, n: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """Return a textured picture (n, n) and its blur radius in cells, near positive."""
    rng = np.random.default_rng(kind)
    y, x = np.mgrid[:n, :n] / n
    wide, fine = n / 14, 2.0
    near, nearer, bright, dark = (
        gaussian_filter(rng.standard_normal((n, n)), size, mode="wrap")
        for size in (wide, wide, fine, fine)
    )
    wave_x, wave_y = (np.sin(2.0 * np.pi * along) for along in (x, y))
    radius = (
        np.where(near > 0.0, 6.0, 0.0),
        np.where(near > 0.0, 0.0, -6.0),
        np.where(near > 0.0, 5.0, -5.0),
        6.0 * wave_y,
        np.where(near > 0.0, 5.0 + 2.0 * wave_x, -5.0 + 3.0 * wave_y),
        np.where(nearer > 0.0, 6.0, np.where(near > 0.0, 1.0, -5.0)),
    )[kind]
    bright, dark = (
        np.clip(0.5 + 0.2 * each / each.std(), 0.0, 1.0) for each in (bright, dark)
    )
    return np.where(radius > radius.mean(), bright, 0.6 * dark), radius


def figure_of_random_scenes(out: Path) -> None:
    """Draw six random scenes and the errors of their layers."""
    optics = fs.Optics(
        focal_length_mm=10.0,
        f_number=1.4,
        focus_distance_m=1.0,
        oversample=1,
        padding="edge",
        relative_illumination=fs.optics.IlluminationTable(
            image_height_um=[0.0, 1e5], fraction=[1.0, 1.0]
        ),
    )
    pupil_m, size = 0.5e-3 * 10.0 / 1.4, optics.magnification(1.0)
    figure = Figure(figsize=(7.6, 2.9), layout="constrained")
    axes = figure.subplots(2, len(TITLES))
    for kind, title in enumerate(TITLES):
        picture, radius = random_scene(kind)
        # The geometric blur in cells of 4 µm is a D (1/H - 1/1 m)
        depth_m = 1.0 / (1.0 + 4e-6 * radius / (pupil_m * size))
        scene, white = (
            fs.Scene.from_rgbd(
                each,
                depth_m,
                distance_m=1.0,
                pitch_um=4.0 / size,
                encoding="linear",
                wavelength_nm=[400.0],
                band_width_nm=10.0,
                peak_radiance_w_m2_sr_nm=1.0,
            )
            for each in (picture, np.ones_like(picture))
        )
        layers, rays, even = (
            optics.power_map(each, reference=is_rays).data[0]
            for each, is_rays in ((scene, False), (scene, True), (white, False))
        )
        error = 100.0 * (layers - rays)[8:-8, 8:-8] / even.max()
        rms, largest = np.sqrt(np.mean(error**2)), np.abs(error).max()
        print(f"{title}: {rms:.2f} % of white (rms), at most {largest:.2g} %")
        assert rms < 1.0
        axes[0, kind].imshow(layers[8:-8, 8:-8], cmap="gray", origin="lower")
        axes[0, kind].set_title(title, fontsize=9)
        shown = axes[1, kind].imshow(
            error, cmap="coolwarm", origin="lower", vmin=-10, vmax=10
        )
    figure.colorbar(shown, ax=axes, label="error, % of white", fraction=0.04)
    for each in axes.ravel():
        each.set_axis_off()
    save_figure(figure, out / "38_random_scenes.png")


def main(out: Path) -> None:
    """Write the figures."""
    out.mkdir(parents=True, exist_ok=True)

    # %% Pictures that are focused on each object in turn.
    figure_of_focus(out)

    # %% Layers against rays through the pupil.
    rms = figure_of_errors(out)
    print(f"error of layers: {100.0 * rms:.2g} % of white (rms)")
    assert rms < 0.015

    # %% The same for random scenes.
    figure_of_random_scenes(out)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

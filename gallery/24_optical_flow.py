"""
How few photosites tell the motion of a picture well enough: as an even grid, or with the small ones at the gaze?

New here: ``foveasim.metrics.estimate_flow``, ``flow_bound`` and ``site_gradients_e_per_um``; pictures of
``foveasim.reconstruct.least_squares`` as what the next capture is compared with.

Expect: for the motion of a target of 100 µm at the gaze to 0.15 µm, about 450 foveal photosites, and of an even grid of the
same field more than 8 times as many, about 5,600. For that of 25 patches all over the field to 0.8 µm no gain: 1,050 even ones,
1,100 foveal ones, and the 425 that nearly suffice at the gaze tell next to nothing. With the picture known estimates are in
the median within 10 % of the Cramér-Rao bound; a grid of 1,000 that compares two captures of its own is more than 5 times above
it: what it lacks is not light, but the picture between its sites.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import skimage.data
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from scipy.ndimage import distance_transform_edt

import foveasim as fs
from foveasim._io.encodings import encode_srgb_values
from foveasim.metrics import estimate_flow, flow_bound, site_gradients_e_per_um
from foveasim.reconstruct import SiteEstimates, cells, estimate_from_code, least_squares
from foveasim.view import save_figure

#: The lens, whose finest detail is 5.5 µm, and the light, of up to 280 electrons per µm².
OPTICS = fs.Optics(focal_length_mm=8.0, f_number=10.0)
DISTANCE_M, WAVELENGTH_NM, BAND_WIDTH_NM = 1.0, 550.0, 50.0
RADIANCE_W_M2_SR_NM, EXPOSURE_S = 0.03, 0.02
#: Photographs with detail everywhere, and the pixel (row, column) under the gaze.
GAZES = {"chelsea": (129, 160), "gravel": (256, 256), "coins": (150, 190), "grass": (256, 256)}
N_PIXELS, PICTURE_UM, N_RASTER = 204, 560.0, 188
#: The field, and its patches of the same area: the target, a disc at the gaze, and 8 and 16 parts of the rings around it.
FIELD_RADIUS_UM, TARGET_RADIUS_UM = 250.0, 50.0
PARTS = (1, 8, 16)
#: Motion between two captures, in three directions. No answer, and one that nothing is as fast as, count as "nothing moved".
MOTION_UM, LONGEST_UM = 3.6, 10.0
MOTIONS_UM = MOTION_UM * np.array([[np.cos(turn), np.sin(turn)] for turn in np.deg2rad([-30.0, 90.0, 210.0])])
#: Of the pictures before the motion: with 1e-4 errors were less by up to a fifth, and it took twice as long.
TOLERANCE = 3e-4
#: How far the gaze strays from shot to shot, in pixels of the photograph.
STRAY_CELLS = 3
#: What all sensors have in common: the smallest pixel that can be made, and the electronics.
MIN_SIZE_UM = 5.0
QE, READ_NOISE_E, BITS, CAPACITANCE_F_PER_UM2 = 0.6, 3.0, 12, 2.5e-17
#: The fovea is the target and as much around it as it moves; its hexagons may be larger than the smallest pixel.
FOVEA_RADIUS_UM = 56.0
#: All of the layouts for both tasks, and more of everything, by hand.
LARGE_GRID_SITES = tuple(int(n) for n in np.geomspace(150, 7800, 12))
LARGE_FOVEAL = tuple((n, size) for n in (16, 32, 48, 64, 80, 100) for size in (5.0, 7.0, 10.0, 14.0) if n * size < 900)
LARGE_DRAWS = 3
COLOURS = {"even grid": "tab:blue", "foveal": "tab:red"}


class View(NamedTuple):
    """A photograph behind the lens, and the electrons that it gives on its cells."""

    light: fs.PowerMap
    true_e_per_um2: np.ndarray


class Task(NamedTuple):
    """Whose motion is asked for."""

    title: str
    n_patches: int
    #: Sites and picture so far from the gaze are enough to tell it.
    reach_um: float
    n_draws: int
    allowed_um: float
    #: Layouts near the front: numbers of sites of grids; sectors of rings and sizes in the fovea.
    grids: tuple[int, ...]
    foveals: tuple[tuple[int, float], ...]


class Told(NamedTuple):
    """What a layout tells of the motion: root mean squares over photographs, draws, and patches."""

    n_sites: int
    #: From two captures.
    error_um: float
    #: The least error of unbiased estimates from the second capture and the true picture (Cramér and Rao).
    bound_um: float
    #: What such an estimate has.
    known_um: float


TASKS = (
    Task(
        title="the target at the gaze",
        n_patches=1,
        reach_um=TARGET_RADIUS_UM + 32.0,
        n_draws=3,
        allowed_um=0.15,
        grids=(1000, 2000, 4000, 7800),
        foveals=((16, 10.0), (16, 7.0), (16, 5.0), (32, 5.0)),
    ),
    Task(
        title="all 25 patches alike",
        n_patches=sum(PARTS),
        reach_um=FIELD_RADIUS_UM,
        n_draws=1,
        allowed_um=0.8,
        grids=(500, 1000, 2000),
        foveals=((16, 5.0), (64, 10.0), (100, 7.0)),
    ),
)


def even(n_sites: int) -> fs.Layout:
    """Squares over the round field."""
    pitch_um = FIELD_RADIUS_UM * np.sqrt(np.pi / n_sites)
    n_side = 2 * int(FIELD_RADIUS_UM / pitch_um) + 3
    layout = fs.layout.grid(n_x=n_side, n_y=n_side, pitch_um=pitch_um)
    return layout[np.hypot(*layout.centroid_um.T) < FIELD_RADIUS_UM]


def foveal(n_sectors: int, size_um: float) -> fs.Layout:
    """Even hexagons where the target is, and around them rings of squarish sites, up to the border of the same field."""
    r_min_um = max(FOVEA_RADIUS_UM, size_um * n_sectors / (2.0 * np.pi))
    n_rings = round(np.log(FIELD_RADIUS_UM / r_min_um) / np.log(fs.layout.square_ring_ratio(n_sectors)))
    return fs.layout.log_polar(
        n_sectors=n_sectors,
        n_rings=n_rings,
        min_size_um=size_um,
        r_min_um=r_min_um,
        r_max_um=FIELD_RADIUS_UM,
        fovea="hexagons",
        stagger=True,
        chords_per_arc=2,
    )


def patches(layout: fs.Layout) -> np.ndarray:
    """The patch of each site; 0 is the target."""
    x_um, y_um = np.moveaxis(layout.centroid_um, 1, 0)
    ring = ((np.hypot(x_um, y_um) / TARGET_RADIUS_UM + 1.0) / 2.0).astype(int).clip(max=len(PARTS) - 1)
    n_parts = np.array(PARTS)[ring]
    part = (np.arctan2(y_um, x_um) / (2.0 * np.pi) * n_parts // 1.0).astype(int) % n_parts
    return np.concatenate(([0], np.cumsum(PARTS)))[ring] + part


def view_of(name: str) -> View:
    """A square of a photograph, what is looked at in its middle."""
    row, column = np.array(GAZES[name]) - N_PIXELS // 2
    scene = fs.Scene.from_picture(
        getattr(skimage.data, name)()[row : row + N_PIXELS, column : column + N_PIXELS],
        pitch_um=PICTURE_UM / N_PIXELS / OPTICS.magnification(DISTANCE_M),
        distance_m=DISTANCE_M,
        peak_radiance_w_m2_sr_nm=RADIANCE_W_M2_SR_NM,
        wavelength_nm=[WAVELENGTH_NM],
        band_width_nm=BAND_WIDTH_NM,
    )
    light = OPTICS.power_map(scene)
    true = camera_with(even(100)).reference(light, light.grid, exposure_s=EXPOSURE_S)
    return View(light, true.data[0].astype(float))


def camera_with(layout: fs.Layout) -> fs.Camera:
    """The same lens and electronics for all, with wells that grow with the sites."""
    capacitance_f = CAPACITANCE_F_PER_UM2 * layout.area_um2
    sensor = fs.Sensor(layout, qe=QE, capacitance_f=capacitance_f, read_noise_e=READ_NOISE_E, bits=BITS)
    return fs.Camera(optics=OPTICS, sensor=sensor, order=2)


def squared_error_um2(
    layout: fs.Layout, seen: SiteEstimates, picture: np.ndarray, grid: fs.Grid, motion_um: np.ndarray, n_patches: int
) -> np.ndarray:
    """Of the motion found in each patch, from a capture and the picture before."""
    patch = patches(layout)
    found = estimate_flow(
        layout,
        seen.light_e,
        picture,
        grid,
        variance_e2=seen.variance_e2,
        regions=np.where(patch < n_patches, patch, -1),
        n_steps=5,
        tolerance_um=1e-3,
        n_threads=1,
    )
    flow_um = np.zeros((n_patches, 2))
    is_answer = np.hypot(*found.flow_um.T) < LONGEST_UM
    flow_um[found.regions[is_answer]] = found.flow_um[is_answer]
    return np.sum((flow_um - motion_um) ** 2, axis=1)


def told_by(layout: fs.Layout, views: Sequence[View], task: Task, n_draws: int) -> Told:
    """What a layout tells of the motion."""
    near = layout[np.hypot(*layout.centroid_um.T) < task.reach_um]
    camera = camera_with(near)
    pitch_um = views[0].light.grid.pitch_um
    n_cells = min(N_RASTER, 2 * int((task.reach_um + 20.0) / pitch_um))
    grid = fs.Grid.centred((n_cells, n_cells), pitch_um)
    patch = patches(near)
    regions = np.where(patch < task.n_patches, patch, -1)

    # The gaze strays by some cells. A picture that moves by u over the sensor is a sensor that moves by -u over the picture.
    rng = np.random.default_rng(0)
    shots, seen = [], []
    for seed in range(len(views) * n_draws):
        (light, whole), motion_um = views[seed % len(views)], MOTIONS_UM[seed // len(views) % len(MOTIONS_UM)]
        stray = rng.integers(-STRAY_CELLS, STRAY_CELLS + 1, 2)
        gaze_um = pitch_um * stray
        frames = [(light, tuple(gaze_um)), (light, tuple(gaze_um - motion_um))]
        captures = camera.video(frames, exposure_s=EXPOSURE_S, seed=seed)
        before, after = (estimate_from_code(capture.code, camera.sensor, EXPOSURE_S) for capture in captures)
        x, y = stray + (N_PIXELS - n_cells) // 2
        true = whole[y : y + n_cells, x : x + n_cells]
        shots.append((true, after, motion_um))
        seen.append(before)
    # The picture before the motion is what the sensor makes of its own codes; beyond the field it goes on as at its border.
    pictures = least_squares(
        near,
        np.array([before.light_e for before in seen]),
        grid,
        variance=np.array([before.variance_e2 for before in seen]),
        tolerance=TOLERANCE,
    ).data.astype(float)
    nearest = distance_transform_edt(np.isnan(pictures[0]), return_distances=False, return_indices=True)

    error_um2, bound_um2, known_um2 = [], [], []
    for (true, after, motion_um), picture in zip(shots, pictures[:, *nearest], strict=True):
        bound = flow_bound(site_gradients_e_per_um(near, true, grid), after.variance_e2, regions=regions)
        least_um2 = np.full(task.n_patches, np.inf)
        least_um2[bound.regions] = np.sum(bound.sigma_um**2, axis=1)
        bound_um2.append(np.minimum(least_um2, MOTION_UM**2))
        error_um2.append(squared_error_um2(near, after, picture, grid, motion_um, task.n_patches))
        known_um2.append(squared_error_um2(near, after, true, grid, motion_um, task.n_patches))
    return Told(layout.n_sites, *(float(np.sqrt(np.mean(squares))) for squares in (error_um2, bound_um2, known_um2)))


def measured(views: Sequence[View], task: Task, *, is_large: bool) -> dict[str, list[Told]]:
    """What the layouts of both families tell."""
    n_draws = LARGE_DRAWS * task.n_draws if is_large else task.n_draws
    families = {
        "even grid": [even(n_sites) for n_sites in (LARGE_GRID_SITES if is_large else task.grids)],
        "foveal": [foveal(*chosen) for chosen in (LARGE_FOVEAL if is_large else task.foveals)],
    }
    return {name: [told_by(one, views, task, n_draws) for one in family] for name, family in families.items()}


def front(told: Sequence[Told]) -> list[Told]:
    """Those that none with as few photosites beats, the smallest first."""
    best: list[Told] = []
    for one in sorted(told, key=lambda one: (one.n_sites, one.error_um)):
        if not best or one.error_um < best[-1].error_um:
            best.append(one)
    return best


def fewest_sites(told: Sequence[Told], allowed_um: float) -> float:
    """Photosites with which the front falls to an error, on the lines between what was measured; or infinitely many."""
    best = front(told)
    error_um = np.array([one.error_um for one in best])
    if not error_um[-1] <= allowed_um <= error_um[0]:
        return np.inf
    n_sites = np.log([one.n_sites for one in best])
    return float(np.exp(np.interp(-np.log(allowed_um), -np.log(error_um), n_sites)))


def show_sensors(axes: Sequence[Axes], view: View, layouts: dict[str, fs.Layout]) -> None:
    """The light with the patches, and what sensors make of it."""
    light, true = view
    shown = {"the light on the sensor, and its 25 patches": true}
    for name, layout in layouts.items():
        camera = camera_with(layout)
        light_e = estimate_from_code(
            camera.capture(light, exposure_s=EXPOSURE_S, seed=0).code, camera.sensor, EXPOSURE_S
        )
        grid = fs.Grid.centred((560, 560), 1.0)
        shown[f"{name}: {layout.n_sites} photosites"] = cells(layout, light_e.light_e / layout.area_um2, grid).data[0]
    x_min, y_min, x_max, y_max = light.grid.bounds_um
    for axis, (title, picture) in zip(axes, shown.items(), strict=True):
        grey = encode_srgb_values(np.clip(picture / np.percentile(true, 99.5), 0.0, 1.0))
        axis.imshow(grey, cmap="gray", origin="lower", extent=(x_min, x_max, y_min, y_max), interpolation="nearest")
        axis.set(title=title, xticks=[], yticks=[], xlim=(-260, 260), ylim=(-260, 260))
        axis.set_facecolor("white")
        axis.add_patch(Circle((0, 0), TARGET_RADIUS_UM, fill=False, edgecolor="gold", linewidth=1.5))
    for ring, n_parts in enumerate(PARTS[1:], start=1):
        inner_um, outer_um = (2 * ring - 1) * TARGET_RADIUS_UM, (2 * ring + 1) * TARGET_RADIUS_UM
        axes[0].add_patch(Circle((0, 0), outer_um, fill=False, edgecolor="w", linewidth=0.8))
        for angle in 2.0 * np.pi * np.arange(n_parts) / n_parts:
            along = np.array([np.cos(angle), np.sin(angle)])
            axes[0].plot(*np.outer(along, (inner_um, outer_um)), color="w", linewidth=0.8)
    axes[0].plot([-240, -140], [-240, -240], color="k", linewidth=3)
    axes[0].text(-190, -232, "100 µm", ha="center", va="bottom", color="k", fontsize=9)


def show_task(axes: Axes, told: dict[str, list[Told]], task: Task) -> None:
    """Errors against photosites, the bounds, and where the errors are allowed."""
    lowest_um = 0.02
    fewest = {name: fewest_sites(family, task.allowed_um) for name, family in told.items()}
    axes.axhline(MOTION_UM, color="0.6", linewidth=0.8, linestyle=":")
    axes.text(18_500, 1.04 * MOTION_UM, "“nothing moved”", color="0.5", fontsize=9, va="bottom", ha="right")
    axes.axhline(task.allowed_um, color="k", linewidth=0.8)
    axes.text(18_500, 1.04 * task.allowed_um, f"ε = {task.allowed_um:g} µm", fontsize=10, va="bottom", ha="right")
    for name, family in told.items():
        best, colour = front(family), COLOURS[name]
        ordered = sorted(family, key=lambda one: one.n_sites)
        axes.plot([one.n_sites for one in ordered], [one.error_um for one in ordered], "o", color=colour, alpha=0.3)
        axes.plot(
            [one.n_sites for one in best],
            [one.error_um for one in best],
            "o-",
            color=colour,
            linewidth=2,
            label=f"{name}: two captures",
        )
        known = [(one.n_sites, one.known_um) for one in ordered]
        axes.plot(*np.transpose(known), "+", color=colour, label=f"{name}: picture known")
        least = [(one.n_sites, one.bound_um) for one in best]
        axes.plot(*np.transpose(least), "--", color=colour, linewidth=1, label=f"{name}: Cramér–Rao bound")
        if np.isfinite(m := fewest[name]):
            # The labels of neighbouring lines stand on either side.
            at = "right" if m == min(fewest.values()) else "left"
            axes.plot([m, m], [lowest_um, task.allowed_um], color=colour, linewidth=1)
            axes.text(m, 1.08 * lowest_um, f" M = {m:,.0f} ", color=colour, ha=at, va="bottom")
    axes.set(xscale="log", yscale="log", xlim=(60, 20_000), ylim=(lowest_um, 6.0), title=task.title)
    axes.set(xlabel="photosites M", ylabel="error of the motion, root mean square (µm)")
    axes.grid(color="0.93", which="both", linewidth=0.6)
    axes.set_axisbelow(True)


def main(out_dir: Path, *, is_large: bool = False) -> None:
    """Write the errors against the numbers of photosites, and what two of the sensors see, to a folder."""
    # %% What every sensor tells of the motion.
    views = [view_of(name) for name in GAZES]
    told = [measured(views, task, is_large=is_large) for task in TASKS]

    # %% The picture.
    figure = Figure(figsize=(12.6, 9.6), layout="constrained")
    axes = figure.subplot_mosaic("AABBCC;DDDEEE", height_ratios=(1.0, 1.15))
    sharp = foveal(16, MIN_SIZE_UM)
    show_sensors([axes[k] for k in "ABC"], views[0], {"even grid": even(sharp.n_sites), "foveal": sharp})
    for key, task, families in zip("DE", TASKS, told, strict=True):
        show_task(axes[key], families, task)
    lines, labels = axes["D"].get_legend_handles_labels()
    figure.legend(lines, labels, frameon=False, ncols=6, fontsize=8.5, columnspacing=1.5, loc="outside lower center")
    save_figure(figure, out_dir / "24_optical_flow.png", dpi=100)

    # %% The numbers.
    for task, families in zip(TASKS, told, strict=True):
        print(task.title)
        for name, family in families.items():
            for one in family:
                print(
                    f"  {name} of {one.n_sites} photosites: {one.error_um:.3f} µm from two captures; "
                    f"with the picture known {one.known_um:.3f} µm, bound {one.bound_um:.3f} µm"
                )
    target, patches_too = (
        {name: fewest_sites(family, task.allowed_um) for name, family in families.items()}
        for task, families in zip(TASKS, told, strict=True)
    )
    for task, fewest in zip(TASKS, (target, patches_too), strict=True):
        print(f"{task.title}, {task.allowed_um} µm:", ", ".join(f"{name} {m:.0f}" for name, m in fewest.items()))
    everything = [one for families in told for family in families.values() for one in family]
    known = np.median([one.known_um / one.bound_um for one in everything])
    print(f"errors with the picture known: {known:.2f} times the bound (median)")
    assert target["even grid"] > 8.0 * target["foveal"]
    assert 0.8 < patches_too["foveal"] / patches_too["even grid"] < 1.5
    assert told[1]["foveal"][0].n_sites == sharp.n_sites
    assert told[1]["foveal"][0].error_um > 0.75 * MOTION_UM
    assert abs(known - 1.0) < 0.1
    assert all(one.error_um > 5.0 * one.bound_um for one in told[0]["even grid"] if one.n_sites < 1500)


if __name__ == "__main__":
    folders = [word for word in sys.argv[1:] if word != "--large"]
    main(Path(folders[0] if folders else "."), is_large="--large" in sys.argv)

"""
How many photosites does motion estimation require on a uniform grid, and with a fovea
at the gaze?

New here: ``foveasim.metrics.estimate_flow``, ``flow_bound`` and
``site_gradients_e_per_um``; reconstructions by ``foveasim.reconstruct.least_squares``
as the reference of the next capture.

Expect: for a target of 100 µm at the gaze and an error of 0.15 µm, about 500 foveal
photosites, or about 4,700 on a uniform grid of the same field, more than 8 times as
many. For 25 patches over the complete field and an error of 0.8 µm, no gain: 1,010
photosites on a uniform grid, 1,060 on foveal layouts; the 425 that nearly suffice at
the gaze give almost no information. With a known picture, the median of the errors is
within 10 % of the Cramér-Rao bound. With two captures, a grid of 1,000 exceeds the
bound more than 5 times: not photon noise, but unknown detail between the sites limits
it.
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
from foveasim.metrics import estimate_flow, flow_bound, site_gradients_e_per_um
from foveasim.reconstruct import SiteEstimates, cells, estimate_from_code, least_squares
from foveasim.view import save_figure

#: Lens with a finest period of 5.5 µm, and exposures of up to 280 electrons per µm².
OPTICS = fs.Optics(focal_length_mm=8.0, f_number=10.0)
DISTANCE_M, WAVELENGTH_NM, BAND_WIDTH_NM = 1.0, 550.0, 50.0
RADIANCE_W_M2_SR_NM, EXPOSURE_S = 0.03, 0.02
#: Photographs with detail in all regions, and the pixel (row, column) at the gaze.
GAZES = {
    "chelsea": (129, 160),
    "gravel": (256, 256),
    "coins": (150, 190),
    "grass": (256, 256),
}
N_PIXELS, PICTURE_UM, N_RASTER = 204, 560.0, 188
#: Field, with 25 patches of equal area: the target, a disc at the gaze, and 8 and 16
#: parts of the two rings around it.
FIELD_RADIUS_UM, TARGET_RADIUS_UM = 250.0, 50.0
PARTS = (1, 8, 16)
#: Motion between two captures, in three directions. Missing estimates and those above
#: the maximum count as zero motion.
MOTION_UM, MAX_MOTION_UM = 3.6, 10.0
MOTIONS_UM = MOTION_UM * np.array(
    [[np.cos(angle), np.sin(angle)] for angle in np.deg2rad([-30.0, 90.0, 210.0])]
)
#: Tolerance of the reconstructions: 1e-4 reduces errors by up to a fifth, and doubles
#: the computing time.
TOLERANCE = 3e-4
#: Maximum random offset of the gaze in each shot, in pixels of the photograph.
GAZE_OFFSET_CELLS = 3
#: Common parameters of all sensors: minimum site size, and electronics.
MIN_SIZE_UM = 5.0
QE, READ_NOISE_E, BITS, CAPACITANCE_F_PER_UM2 = 0.6, 3.0, 12, 2.5e-17
#: The fovea covers the target and a margin for its motion; its hexagons may be larger
#: than the minimum site size.
FOVEA_RADIUS_UM = 56.0
#: Option --large: all layouts for both tasks, and more draws.
LARGE_GRID_SITES = tuple(int(n) for n in np.geomspace(150, 7800, 12))
LARGE_FOVEAL = tuple(
    (n, size)
    for n in (16, 32, 48, 64, 80, 100)
    for size in (5.0, 7.0, 10.0, 14.0)
    if n * size < 900
)
LARGE_DRAWS = 3
#: Photographs for a test of the script.
QUICK = {"n_views": 2}
COLOURS = {"uniform grid": "tab:blue", "foveal": "tab:red"}


class View(NamedTuple):
    """Power map of a photograph, and the expected charge density of its cells."""

    light: fs.PowerMap
    true_e_per_um2: np.ndarray


class Task(NamedTuple):
    """Parameters of a motion estimation task."""

    title: str
    n_patches: int
    #: Radius around the gaze of the sites and the picture that the task requires.
    reach_um: float
    n_draws: int
    allowed_um: float
    #: Layouts near the Pareto front: numbers of sites of grids; sectors and fovea site
    #: sizes of foveal layouts.
    grids: tuple[int, ...]
    foveals: tuple[tuple[int, float], ...]


class MotionErrors(NamedTuple):
    """Rms motion errors of a layout over photographs, draws and patches."""

    n_sites: int
    #: Error of estimates from two captures.
    error_um: float
    #: Cramér-Rao bound of unbiased estimates from the second capture and the true
    #: picture.
    bound_um: float
    #: Error of estimates from the second capture and the true picture.
    known_um: float


TASKS = (
    Task(
        title="target at the gaze",
        n_patches=1,
        reach_um=TARGET_RADIUS_UM + 32.0,
        n_draws=3,
        allowed_um=0.15,
        grids=(1000, 2000, 4000, 7800),
        foveals=((16, 10.0), (16, 7.0), (16, 5.0), (32, 5.0)),
    ),
    Task(
        title="all 25 patches",
        n_patches=sum(PARTS),
        reach_um=FIELD_RADIUS_UM,
        n_draws=1,
        allowed_um=0.8,
        grids=(500, 1000, 2000),
        foveals=((16, 5.0), (64, 10.0), (100, 7.0)),
    ),
)


def uniform(n_sites: int) -> fs.Layout:
    """Return a uniform grid of squares over the circular field."""
    pitch_um = FIELD_RADIUS_UM * np.sqrt(np.pi / n_sites)
    n_side = 2 * int(FIELD_RADIUS_UM / pitch_um) + 3
    layout = fs.layout.grid(n_x=n_side, n_y=n_side, pitch_um=pitch_um)
    return layout[np.hypot(*layout.centroid_um.T) < FIELD_RADIUS_UM]


def foveal(n_sectors: int, size_um: float) -> fs.Layout:
    """
    Return uniform hexagons on the target, and rings of nearly square sites over the
    other field.
    """
    r_min_um = max(FOVEA_RADIUS_UM, size_um * n_sectors / (2.0 * np.pi))
    n_rings = round(
        np.log(FIELD_RADIUS_UM / r_min_um)
        / np.log(fs.layout.square_ring_ratio(n_sectors))
    )
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
    """Return the patch index of each site; 0 is the target."""
    x_um, y_um = np.moveaxis(layout.centroid_um, 1, 0)
    ring = (
        ((np.hypot(x_um, y_um) / TARGET_RADIUS_UM + 1.0) / 2.0)
        .astype(int)
        .clip(max=len(PARTS) - 1)
    )
    n_parts = np.array(PARTS)[ring]
    part = (np.arctan2(y_um, x_um) / (2.0 * np.pi) * n_parts // 1.0).astype(
        int
    ) % n_parts
    return np.concatenate(([0], np.cumsum(PARTS)))[ring] + part


def view_of(name: str) -> View:
    """Return a square part of a photograph, centred on the gaze."""
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
    true = camera_with(uniform(100)).reference(light, light.grid, exposure_s=EXPOSURE_S)
    return View(light, true.data[0].astype(float))


def camera_with(layout: fs.Layout) -> fs.Camera:
    """
    Return a camera with the common lens and electronics and a fixed capacitance per
    area.
    """
    capacitance_f = CAPACITANCE_F_PER_UM2 * layout.area_um2
    sensor = fs.Sensor(
        layout, qe=QE, capacitance_f=capacitance_f, read_noise_e=READ_NOISE_E, bits=BITS
    )
    return fs.Camera(optics=OPTICS, sensor=sensor, order=2)


def squared_error_um2(
    layout: fs.Layout,
    estimates: SiteEstimates,
    picture: np.ndarray,
    grid: fs.Grid,
    motion_um: np.ndarray,
    n_patches: int,
) -> np.ndarray:
    """Return the squared error of the estimated motion of each patch."""
    patch = patches(layout)
    found = estimate_flow(
        layout,
        estimates.light_e,
        picture,
        grid,
        variance_e2=estimates.variance_e2,
        regions=np.where(patch < n_patches, patch, -1),
        n_steps=5,
        tolerance_um=1e-3,
        n_threads=1,
    )
    flow_um = np.zeros((n_patches, 2))
    is_valid = np.hypot(*found.flow_um.T) < MAX_MOTION_UM
    flow_um[found.regions[is_valid]] = found.flow_um[is_valid]
    return np.sum((flow_um - motion_um) ** 2, axis=1)


def motion_errors(
    layout: fs.Layout, views: Sequence[View], task: Task, n_draws: int
) -> MotionErrors:
    """Compute the motion errors of a layout."""
    nearby = layout[np.hypot(*layout.centroid_um.T) < task.reach_um]
    camera = camera_with(nearby)
    pitch_um = views[0].light.grid.pitch_um
    n_cells = min(N_RASTER, 2 * int((task.reach_um + 20.0) / pitch_um))
    grid = fs.Grid.centred((n_cells, n_cells), pitch_um)
    patch = patches(nearby)
    regions = np.where(patch < task.n_patches, patch, -1)

    # The gaze has a random offset. Motion of the picture by u is equivalent to motion
    # of the sensor by -u.
    rng = np.random.default_rng(0)
    targets, estimates = [], []
    for seed in range(len(views) * n_draws):
        (light, true_e_per_um2), motion_um = (
            views[seed % len(views)],
            MOTIONS_UM[seed // len(views) % len(MOTIONS_UM)],
        )
        offset = rng.integers(-GAZE_OFFSET_CELLS, GAZE_OFFSET_CELLS + 1, 2)
        gaze_um = pitch_um * offset
        frames = [(light, tuple(gaze_um)), (light, tuple(gaze_um - motion_um))]
        captures = camera.video(frames, exposure_s=EXPOSURE_S, seed=seed)
        before, after = (
            estimate_from_code(capture.code, camera.sensor, EXPOSURE_S)
            for capture in captures
        )
        x, y = offset + (N_PIXELS - n_cells) // 2
        true = true_e_per_um2[y : y + n_cells, x : x + n_cells]
        targets.append((true, after, motion_um))
        estimates.append(before)
    # The previous picture is reconstructed from codes, and extrapolated with the
    # nearest values outside the field.
    pictures = least_squares(
        nearby,
        np.array([before.light_e for before in estimates]),
        grid,
        variance=np.array([before.variance_e2 for before in estimates]),
        tolerance=TOLERANCE,
    ).data.astype(float)
    nearest = distance_transform_edt(
        np.isnan(pictures[0]), return_distances=False, return_indices=True
    )

    error_um2, bound_um2, known_um2 = [], [], []
    for (true, after, motion_um), picture in zip(
        targets, pictures[:, *nearest], strict=True
    ):
        bound = flow_bound(
            site_gradients_e_per_um(nearby, true, grid),
            after.variance_e2,
            regions=regions,
        )
        least_um2 = np.full(task.n_patches, np.inf)
        least_um2[bound.regions] = np.sum(bound.sigma_um**2, axis=1)
        bound_um2.append(np.minimum(least_um2, MOTION_UM**2))
        error_um2.append(
            squared_error_um2(nearby, after, picture, grid, motion_um, task.n_patches)
        )
        known_um2.append(
            squared_error_um2(nearby, after, true, grid, motion_um, task.n_patches)
        )
    return MotionErrors(
        layout.n_sites,
        *(
            float(np.sqrt(np.mean(squares)))
            for squares in (error_um2, bound_um2, known_um2)
        ),
    )


def family_errors(
    views: Sequence[View], task: Task, *, is_large: bool
) -> dict[str, list[MotionErrors]]:
    """Compute the motion errors of the layouts of both families."""
    n_draws = LARGE_DRAWS * task.n_draws if is_large else task.n_draws
    families = {
        "uniform grid": [
            uniform(n_sites)
            for n_sites in (LARGE_GRID_SITES if is_large else task.grids)
        ],
        "foveal": [
            foveal(*chosen) for chosen in (LARGE_FOVEAL if is_large else task.foveals)
        ],
    }
    return {
        name: [motion_errors(entry, views, task, n_draws) for entry in family]
        for name, family in families.items()
    }


def front(results: Sequence[MotionErrors]) -> list[MotionErrors]:
    """
    Return the Pareto front of error and number of photosites, in ascending
    number.
    """
    best: list[MotionErrors] = []
    for entry in sorted(results, key=lambda entry: (entry.n_sites, entry.error_um)):
        if not best or entry.error_um < best[-1].error_um:
            best.append(entry)
    return best


def fewest_sites(results: Sequence[MotionErrors], allowed_um: float) -> float:
    """
    Interpolate the number of photosites where the Pareto front reaches an error, or
    infinity.
    """
    best = front(results)
    error_um = np.array([entry.error_um for entry in best])
    if not error_um[-1] <= allowed_um <= error_um[0]:
        return np.inf
    n_sites = np.log([entry.n_sites for entry in best])
    return float(np.exp(np.interp(-np.log(allowed_um), -np.log(error_um), n_sites)))


def show_sensors(
    axes: Sequence[Axes], view: View, layouts: dict[str, fs.Layout]
) -> None:
    """Plot the irradiance with the patches, and the pictures of two sensors."""
    light, true = view
    shown = {"irradiance on the sensor, 25 patches": true}
    for name, layout in layouts.items():
        camera = camera_with(layout)
        light_e = estimate_from_code(
            camera.capture(light, exposure_s=EXPOSURE_S, seed=0).code,
            camera.sensor,
            EXPOSURE_S,
        )
        grid = fs.Grid.centred((560, 560), 1.0)
        shown[f"{name}: {layout.n_sites} photosites"] = cells(
            layout, light_e.light_e / layout.area_um2, grid
        ).data[0]
    x_min, y_min, x_max, y_max = light.grid.bounds_um
    for axis, (title, picture) in zip(axes, shown.items(), strict=True):
        grey = fs.units.encode_srgb(
            np.clip(picture / np.percentile(true, 99.5), 0.0, 1.0)
        )
        axis.imshow(
            grey,
            cmap="gray",
            origin="lower",
            extent=(x_min, x_max, y_min, y_max),
            interpolation="nearest",
        )
        axis.set_title(title.replace(": ", ":\n"), fontsize=10)
        axis.set(xticks=[], yticks=[], xlim=(-260, 260), ylim=(-260, 260))
        axis.set_facecolor("white")
        axis.add_patch(
            Circle(
                (0, 0), TARGET_RADIUS_UM, fill=False, edgecolor="gold", linewidth=1.5
            )
        )
    for ring, n_parts in enumerate(PARTS[1:], start=1):
        inner_um, outer_um = (
            (2 * ring - 1) * TARGET_RADIUS_UM,
            (2 * ring + 1) * TARGET_RADIUS_UM,
        )
        axes[0].add_patch(
            Circle((0, 0), outer_um, fill=False, edgecolor="w", linewidth=0.8)
        )
        for angle in 2.0 * np.pi * np.arange(n_parts) / n_parts:
            along = np.array([np.cos(angle), np.sin(angle)])
            axes[0].plot(
                *np.outer(along, (inner_um, outer_um)), color="w", linewidth=0.8
            )
    axes[0].plot([-240, -140], [-240, -240], color="k", linewidth=3)
    axes[0].text(-190, -232, "100 µm", ha="center", va="bottom", color="k", fontsize=10)


def show_task(axes: Axes, results: dict[str, list[MotionErrors]], task: Task) -> None:
    """Plot errors and bounds against numbers of photosites, with the maximum error."""
    lowest_um = 0.02
    fewest = {
        name: fewest_sites(family, task.allowed_um) for name, family in results.items()
    }
    axes.axhline(MOTION_UM, color="0.6", linewidth=0.8, linestyle=":")
    axes.text(
        18_500,
        1.04 * MOTION_UM,
        "zero-motion estimate",
        color="0.5",
        fontsize=10,
        va="bottom",
        ha="right",
    )
    axes.axhline(task.allowed_um, color="k", linewidth=0.8)
    axes.text(
        18_500,
        1.04 * task.allowed_um,
        f"ε = {task.allowed_um:g} µm",
        fontsize=10,
        va="bottom",
        ha="right",
    )
    for name, family in results.items():
        best, colour = front(family), COLOURS[name]
        ordered = sorted(family, key=lambda entry: entry.n_sites)
        axes.plot(
            [entry.n_sites for entry in ordered],
            [entry.error_um for entry in ordered],
            "o",
            color=colour,
            alpha=0.3,
        )
        axes.plot(
            [entry.n_sites for entry in best],
            [entry.error_um for entry in best],
            "o-",
            color=colour,
            linewidth=2,
            label=f"{name}: two captures",
        )
        known = [(entry.n_sites, entry.known_um) for entry in ordered]
        axes.plot(
            *np.transpose(known), "+", color=colour, label=f"{name}: known picture"
        )
        least = [(entry.n_sites, entry.bound_um) for entry in best]
        axes.plot(
            *np.transpose(least),
            "--",
            color=colour,
            linewidth=1,
            label=f"{name}: Cramér–Rao bound",
        )
        if np.isfinite(m := fewest[name]):
            # Labels on opposite sides, since the lines can be close.
            at = "right" if m == min(fewest.values()) else "left"
            axes.plot([m, m], [lowest_um, task.allowed_um], color=colour, linewidth=1)
            axes.text(
                m, 1.08 * lowest_um, f" M = {m:,.0f} ", color=colour, ha=at, va="bottom"
            )
    axes.set(
        xscale="log",
        yscale="log",
        xlim=(60, 20_000),
        ylim=(lowest_um, 6.0),
        title=task.title,
    )
    axes.set(xlabel="photosites M", ylabel="rms error of the motion / µm")
    axes.grid(color="0.93", which="both", linewidth=0.6)
    axes.set_axisbelow(True)


def main(out_dir: Path, *, is_large: bool = False, n_views: int = len(GAZES)) -> None:
    """Write a figure of motion errors and of two sensors to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Motion errors of all sensors.
    views = [view_of(name) for name in list(GAZES)[:n_views]]
    results = [family_errors(views, task, is_large=is_large) for task in TASKS]

    # %% Figure.
    figure = Figure(figsize=(8.0, 12.4), layout="constrained")
    axes = figure.subplot_mosaic("ABC;DDD;EEE", height_ratios=(1.0, 1.6, 1.6))
    small_foveal = foveal(16, MIN_SIZE_UM)
    show_sensors(
        [axes[k] for k in "ABC"],
        views[0],
        {"uniform grid": uniform(small_foveal.n_sites), "foveal": small_foveal},
    )
    for key, task, families in zip("DE", TASKS, results, strict=True):
        show_task(axes[key], families, task)
    lines, labels = axes["D"].get_legend_handles_labels()
    figure.legend(
        lines,
        labels,
        frameon=False,
        ncols=2,
        columnspacing=1.5,
        loc="outside lower center",
    )
    save_figure(figure, out_dir / "24_optical_flow.png", dpi=140)

    # %% Checks.
    for task, families in zip(TASKS, results, strict=True):
        print(task.title)
        for name, family in families.items():
            for entry in family:
                print(
                    f"  {name} of {entry.n_sites} photosites: "
                    f"{entry.error_um:.3f} µm from two captures; "
                    f"known picture {entry.known_um:.3f} µm, bound "
                    f"{entry.bound_um:.3f} µm"
                )
    target_only, all_patches = (
        {
            name: fewest_sites(family, task.allowed_um)
            for name, family in families.items()
        }
        for task, families in zip(TASKS, results, strict=True)
    )
    for task, fewest in zip(TASKS, (target_only, all_patches), strict=True):
        print(
            f"{task.title}, {task.allowed_um} µm:",
            ", ".join(f"{name} {m:.0f}" for name, m in fewest.items()),
        )
    all_results = [
        entry
        for families in results
        for family in families.values()
        for entry in family
    ]
    known = np.median([entry.known_um / entry.bound_um for entry in all_results])
    print(f"errors with a known picture: {known:.2f} times the bound (median)")
    assert target_only["uniform grid"] > 8.0 * target_only["foveal"]
    assert 0.8 < all_patches["foveal"] / all_patches["uniform grid"] < 1.5
    assert results[1]["foveal"][0].n_sites == small_foveal.n_sites
    assert results[1]["foveal"][0].error_um > 0.75 * MOTION_UM
    assert abs(known - 1.0) < 0.1
    assert all(
        entry.error_um > 5.0 * entry.bound_um
        for entry in results[0]["uniform grid"]
        if entry.n_sites < 1500
    )


if __name__ == "__main__":
    directories = [word for word in sys.argv[1:] if word != "--large"]
    main(Path(directories[0] if directories else "."), is_large="--large" in sys.argv)

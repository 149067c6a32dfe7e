"""
How does a lens with strong distortion image a chart, and how wrong is the power in a
warped picture?

New here: ``Camera(distortion=)``, a shot from a settings file
(``mobius_distortion.yaml``, the run of the paper), ``conserve="density"``,
``fs.distortion.distort_map``.

Expect: arrows from the positions of points in an ideal lens to those in this one; a
checkerboard with barrel distortion, and with brighter corners, since the lens
demagnifies them; point images, displaced by up to 90 pixels, within 0.15 pixels of
their positions in the lens model (limited by undersampling); an upright F; undistorted
outlines and a warped map that agree within 1.5 % of the brightest site; a power deficit
of 41 % in the corners of a picture that is warped without regard to areas.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
import skimage.data
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.config import read_shot
from foveasim.scene import charts
from foveasim.view import save_figure

SETTINGS = Path(__file__).parent / "mobius_distortion.yaml"
#: Half-width of the window for the centroid of a point image, sites.
HALF_WINDOW = 8


def centroids_um(
    layout: fs.Layout, values: np.ndarray, guess_um: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """Return signal centroids around positions (n, 2) on a square grid of sites, µm."""
    picture, x_um, y_um = (v.reshape(shape) for v in (values, *layout.centroid_um.T))
    found = []
    for x, y in guess_um:
        column, row = np.abs(x_um[0] - x).argmin(), np.abs(y_um[:, 0] - y).argmin()
        window = (
            slice(row - HALF_WINDOW, row + HALF_WINDOW + 1),
            slice(column - HALF_WINDOW, column + HALF_WINDOW + 1),
        )
        weight = picture[window] / picture[window].sum()
        found.append([(weight * x_um[window]).sum(), (weight * y_um[window]).sum()])
    return np.array(found)


def main(out_dir: Path) -> None:
    """
    Write the run of the paper, points, a letter and the warping error to a
    directory.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Settings of the paper: a million sites, whose outlines are undistorted once.
    # The paper combines the distortion of a lens of 3.5 mm with the image of one of 22
    # mm, of which captures warn.
    warnings.filterwarnings("ignore", message="the focal length of the lens model")
    shot = read_shot(SETTINGS)
    lens, layout, optics = (
        shot.camera.distortion,
        shot.camera.sensor.layout,
        shot.camera.optics,
    )
    size = layout.provenance["parameters"]
    shape = size["n_y"], size["n_x"]
    left, bottom, right, top = layout.bounds_um
    checkers = shot.camera.capture(
        shot.scene, exposure_s=shot.exposure_s, seed=shot.seed
    )

    # %% The same scene without distortion, on sites with four times the pitch.
    fine = shot.camera.sensor
    large = fs.layout.grid(
        n_x=shape[1] // 4, n_y=shape[0] // 4, pitch_um=4.0 * size["pitch_um"]
    )
    coarse = fs.Sensor(
        large,
        qe=fine.qe,
        capacitance_f=16.0 * fine.capacitance_f,
        v_sat_v=fine.v_sat_v,
        bits=fine.bits,
    )
    ideal = optics.power_map(shot.scene)
    undistorted = fs.Camera(optics=optics, sensor=coarse).capture(
        ideal, exposure_s=shot.exposure_s, seed=1
    )

    # %% Points and a letter through the same lens.
    template = {
        "shape": shot.scene.basis.shape[1:],
        "pitch_um": shot.scene.pitch_um,
        "distance_m": shot.scene.distance_m,
        "wavelength_nm": shot.scene.wavelength_nm,
        "band_width_nm": shot.scene.band_width_nm,
    }
    points = charts.point_grid(
        spacing_mm=500 * 11.6e-3, intensity_w_sr_nm=1e-6, **template
    )
    spots = shot.camera.capture(points, exposure_s=shot.exposure_s, seed=1)
    coarse_pixels = {
        "shape": tuple(n // 8 for n in template["shape"]),
        "pitch_um": 8.0 * template["pitch_um"],
    }
    letter = charts.letter_f(
        height_mm=45.0, radiance_w_m2_sr_nm=3.0, **(template | coarse_pixels)
    )
    distorted = fs.Camera(optics=optics, sensor=coarse, distortion=lens)
    upright = distorted.capture(letter, exposure_s=shot.exposure_s, seed=1)

    # %% A photograph through the ideal lens and through this one, as in Fig. 4 of the
    # paper.
    medium = fs.layout.grid(
        n_x=shape[1] // 2, n_y=shape[0] // 2, pitch_um=2.0 * size["pitch_um"]
    )
    half = fs.Sensor(
        medium,
        qe=fine.qe,
        capacitance_f=4.0 * fine.capacitance_f,
        v_sat_v=fine.v_sat_v,
        bits=fine.bits,
    )
    photograph = fs.Scene.from_picture(
        skimage.data.coffee(),
        pitch_um=template["shape"][1]
        * template["pitch_um"]
        / skimage.data.coffee().shape[1],
        distance_m=template["distance_m"],
        peak_radiance_w_m2_sr_nm=3.0,
        wavelength_nm=(550.0,),
        band_width_nm=100.0,
    )
    figure = Figure(figsize=(8.0, 2.9), layout="constrained")
    for axes, (title, distortion) in zip(
        figure.subplots(1, 2),
        {"ideal lens": None, "Mobius ActionCam": lens}.items(),
        strict=True,
    ):
        shown = fs.Camera(optics=optics, sensor=half, distortion=distortion).capture(
            photograph, exposure_s=shot.exposure_s, seed=1
        )
        codes = fs.units.encode_srgb(shown.code.reshape(shape[0] // 2, -1) / 255.0)
        axes.imshow(
            codes,
            origin="lower",
            extent=(left, right, bottom, top),
            cmap="gray",
            vmin=0.0,
            vmax=1.0,
        )
        axes.set_title(f"photograph, {title}", fontsize=10)
        if (
            distortion is not None
        ):  # from the ideal positions of points to those behind the lens
            x_um, y_um = np.meshgrid(
                np.linspace(0.9 * left, 0.9 * right, 11),
                np.linspace(0.85 * bottom, 0.85 * top, 7),
            )
            start_um = np.column_stack((x_um.ravel(), y_um.ravel()))
            step_um = lens.distort(start_um) - start_um
            axes.quiver(
                *start_um.T,
                *step_um.T,
                angles="xy",
                scale_units="xy",
                scale=1.0,
                color="#ffb000",
                width=0.004,
            )
        axes.set(xlabel="x / µm", ylabel="y / µm")
    save_figure(figure, out_dir / "07_photograph.png", dpi=140)

    cells = optics.grid(points)
    lit = np.argwhere(points.basis[0] > 0.0)
    ideal_um = np.column_stack((cells.x_um[lit[:, 1]], cells.y_um[lit[:, 0]]))
    expected_um = lens.distort(ideal_um)
    is_inside = np.all(
        np.abs(expected_um)
        < np.array([right, top]) - (HALF_WINDOW + 1) * lens.pixel_um,
        axis=1,
    )
    found_um = centroids_um(layout, spots.expected_e, expected_um[is_inside], shape)

    # %% The same power map, warped and then integrated, in the upper right corner,
    # where distortion is strongest.
    is_in_corner = np.all(layout.centroid_um > 0.5 * np.array([right, top]), axis=1)
    (n_y, n_x), cell_um = ideal.grid.shape, ideal.grid.pitch_um
    corner = fs.Grid(
        (n_y // 2 - n_y // 5, n_x // 2 - n_x // 5),
        cell_um,
        (n_x // 5 * cell_um, n_y // 5 * cell_um),
    )
    warped = fs.distortion.distort_map(ideal, lens, grid=corner)
    by_warping = fs.Integrator(layout[is_in_corner], warped.grid)(warped.data)[0]
    by_outlines = shot.camera.integrator(ideal.grid, order=2)(ideal.data)[0][
        is_in_corner
    ]
    # Uniform irradiance on larger sites, to compare how both modes treat areas.
    uniform_grid = fs.Grid.centred((290, 516), 16.0 * ideal.grid.pitch_um)
    by_density, by_flux = (
        fs.Integrator(large, uniform_grid, distortion=lens, conserve=mode)(
            np.ones(uniform_grid.shape)
        )
        for mode in ("density", "flux")
    )

    figure = Figure(figsize=(8.0, 8.2), layout="constrained")
    pictures = {
        "ideal lens: code / DN": (undistorted.code, "gray"),
        "run of the paper: code / DN": (checkers.code, "gray"),
        "letter F: code / DN": (upright.code, "gray"),
        "power of a warped picture /\npower through the lens": (
            by_density / by_flux,
            "viridis",
        ),
    }
    for position, (name, (values, colours)) in enumerate(pictures.items(), start=1):
        axes = figure.add_subplot(3, 2, position)
        n_rows = round((values.size * shape[0] / shape[1]) ** 0.5)
        image = axes.imshow(
            values.reshape(n_rows, -1),
            origin="lower",
            extent=(left, right, bottom, top),
            cmap=colours,
        )
        axes.set_title(name, fontsize=10)
        axes.set_xlabel("x / µm")
        axes.set_ylabel("y / µm")
        if colours == "viridis":
            figure.colorbar(image, ax=axes)
    axes = figure.add_subplot(3, 2, 5)
    axes.plot(
        *ideal_um[is_inside].T, "o", markerfacecolor="none", label="without distortion"
    )
    axes.plot(*found_um.T, "x", label="centroids of the capture")
    axes.set_title("point sources", fontsize=10)
    axes.set_aspect("equal")
    axes.set_xlabel("x / µm")
    axes.set_ylabel("y / µm")
    rest = figure.add_subplot(3, 2, 6)
    rest.set_axis_off()
    rest.legend(
        *axes.get_legend_handles_labels(),
        title="point sources",
        loc="center",
        frameon=False,
    )
    save_figure(figure, out_dir / "07_distortion.png", dpi=140)

    # %% Checks.
    error_px = np.hypot(*(found_um - expected_um[is_inside]).T).max() / lens.pixel_um
    displacement_px = (
        np.hypot(*(expected_um - ideal_um)[is_inside].T).max() / lens.pixel_um
    )
    difference = np.abs(by_warping - by_outlines).max() / by_outlines.max()
    deficit = 1.0 - (by_density / by_flux).min()
    print(
        f"{is_inside.sum()} points, displaced by up to {displacement_px:.0f} "
        f"pixels, are located within {error_px:.3f} pixels"
    )
    print(
        f"undistorted outlines and a warped map agree within {difference:.2%} of "
        "the brightest site"
    )
    print(
        f"a picture warped without regard to areas lacks up to {deficit:.0%} of "
        "the power"
    )
    code = upright.code
    assert error_px < 0.15
    assert difference < 0.02
    assert abs(deficit - 0.41) < 0.02
    assert code.min() < 0.2 * code.max()


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

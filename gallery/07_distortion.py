"""
What does a lens with strong distortion make of a chart, and where would a warped picture have the wrong light?

New here: ``Camera(distortion=)``, a shot from a settings file (``mobius_distortion.yaml``, the paper's run),
``conserve="density"``, ``fs.distortion.distort_map``.

Expect: a checkerboard bent like a barrel, its corners brighter since the lens draws them together; points of light, moved by up
to 90 pixels, within an eighth of a pixel of where the lens model puts them (sites too coarse for the lens tell no more); an
upright F; moved outlines and a warped map that agree within 1.5 % of the brightest site; corners where a picture that is warped
without care for areas lacks 41 % of the light.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.config import read_shot
from foveasim.scene import charts
from foveasim.view import save_figure

SETTINGS = Path(__file__).parent / "mobius_distortion.yaml"
#: Half-width of the window around a point of light in which its middle is looked for, sites.
NEAR = 8


def middles_um(layout: fs.Layout, values: np.ndarray, guess_um: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Centres of gravity of the light around places (n, 2) on a square grid of sites, µm."""
    picture, x_um, y_um = (v.reshape(shape) for v in (values, *layout.centroid_um.T))
    found = []
    for x, y in guess_um:
        column, row = np.abs(x_um[0] - x).argmin(), np.abs(y_um[:, 0] - y).argmin()
        window = (slice(row - NEAR, row + NEAR + 1), slice(column - NEAR, column + NEAR + 1))
        weight = picture[window] / picture[window].sum()
        found.append([(weight * x_um[window]).sum(), (weight * y_um[window]).sum()])
    return np.array(found)


def main(out_dir: Path) -> None:
    """Write the paper's run, points and a letter, and the light that warping loses to a folder."""
    # %% The settings of the paper: a million sites, their outlines carried back through the lens once.
    shot = read_shot(SETTINGS)
    lens, layout, optics = shot.camera.distortion, shot.camera.sensor.layout, shot.camera.optics
    size = layout.provenance["parameters"]
    shape = size["n_y"], size["n_x"]
    left, bottom, right, top = layout.bounds_um
    checkers = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)

    # %% The same without distortion, on sites four times as wide.
    fine = shot.camera.sensor
    large = fs.layout.grid(n_x=shape[1] // 4, n_y=shape[0] // 4, pitch_um=4.0 * size["pitch_um"])
    coarse = fs.Sensor(large, qe=fine.qe, capacitance_f=16.0 * fine.capacitance_f, v_sat_v=fine.v_sat_v, bits=fine.bits)
    ideal = optics.power_map(shot.scene)
    straight = fs.Camera(optics=optics, sensor=coarse).capture(ideal, exposure_s=shot.exposure_s, seed=1)

    # %% Points and a letter through the same lens.
    like = {
        "shape": shot.scene.basis.shape[1:],
        "pitch_um": shot.scene.pitch_um,
        "distance_m": shot.scene.distance_m,
        "wavelength_nm": shot.scene.wavelength_nm,
        "band_width_nm": shot.scene.band_width_nm,
    }
    points = charts.point_grid(spacing_mm=500 * 11.6e-3, intensity_w_sr_nm=1e-6, **like)
    spots = shot.camera.capture(points, exposure_s=shot.exposure_s, seed=1)
    rough = {"shape": tuple(n // 8 for n in like["shape"]), "pitch_um": 8.0 * like["pitch_um"]}
    letter = charts.letter_f(height_mm=45.0, radiance_w_m2_sr_nm=3.0, **(like | rough))
    bent = fs.Camera(optics=optics, sensor=coarse, distortion=lens)
    upright = bent.capture(letter, exposure_s=shot.exposure_s, seed=1)

    cells = optics.grid(points)
    lit = np.argwhere(points.basis[0] > 0.0)
    ideal_um = np.column_stack((cells.x_um[lit[:, 1]], cells.y_um[lit[:, 0]]))
    expected_um = lens.distort(ideal_um)
    is_inside = np.all(np.abs(expected_um) < np.array([right, top]) - (NEAR + 1) * lens.pixel_um, axis=1)
    found_um = middles_um(layout, spots.expected_e, expected_um[is_inside], shape)

    # %% The same light warped as a picture, and integrated, in the upper right corner, where it is bent the most.
    is_in_corner = np.all(layout.centroid_um > 0.5 * np.array([right, top]), axis=1)
    (n_y, n_x), cell_um = ideal.grid.shape, ideal.grid.pitch_um
    corner = fs.Grid((n_y // 2 - n_y // 5, n_x // 2 - n_x // 5), cell_um, (n_x // 5 * cell_um, n_y // 5 * cell_um))
    warped = fs.distortion.distort_map(ideal, lens, grid=corner)
    by_warping = fs.Integrator(layout[is_in_corner], warped.grid)(warped.data)[0]
    by_outlines = shot.camera.integrator(ideal.grid, order=2)(ideal.data)[0][is_in_corner]
    # Even light on larger sites, to see what each way makes of areas.
    even = fs.Grid.centred((290, 516), 16.0 * ideal.grid.pitch_um)
    by_density, by_flux = (
        fs.Integrator(large, even, distortion=lens, conserve=kept)(np.ones(even.shape)) for kept in ("density", "flux")
    )

    figure = Figure(figsize=(18, 7.4), layout="constrained")
    pictures = {
        "an ideal lens: code": (straight.code, "gray"),
        "the paper's run: code": (checkers.code, "gray"),
        "a letter: code": (upright.code, "gray"),
        "light of a warped picture over that of the lens": (by_density / by_flux, "viridis"),
    }
    for position, (name, (values, colours)) in enumerate(pictures.items(), start=1):
        axes = figure.add_subplot(2, 3, position)
        n_rows = round((values.size * shape[0] / shape[1]) ** 0.5)
        image = axes.imshow(values.reshape(n_rows, -1), origin="lower", extent=(left, right, bottom, top), cmap=colours)
        axes.set_title(name)
        axes.set_xlabel("x / µm")
        axes.set_ylabel("y / µm")
        if colours == "viridis":
            figure.colorbar(image, ax=axes)
    axes = figure.add_subplot(2, 3, 5)
    axes.plot(*ideal_um[is_inside].T, "o", markerfacecolor="none", label="without distortion")
    axes.plot(*found_um.T, "x", label="found in the capture")
    axes.set_title("points of light")
    axes.set_aspect("equal")
    axes.set_xlabel("x / µm")
    axes.set_ylabel("y / µm")
    axes.legend(loc="center")
    save_figure(figure, out_dir / "07_distortion.png", dpi=80)

    # %% The numbers.
    off_px = np.hypot(*(found_um - expected_um[is_inside]).T).max() / lens.pixel_um
    moved_px = np.hypot(*(expected_um - ideal_um)[is_inside].T).max() / lens.pixel_um
    apart = np.abs(by_warping - by_outlines).max() / by_outlines.max()
    missing = 1.0 - (by_density / by_flux).min()
    print(f"{is_inside.sum()} points, moved by up to {moved_px:.0f} pixels, are found within {off_px:.3f} pixels")
    print(f"outlines and a warped map agree within {apart:.2%} of the brightest site")
    print(f"a picture warped without care for the areas lacks up to {missing:.0%} of the light")
    code = upright.code
    assert off_px < 0.15
    assert apart < 0.02
    assert abs(missing - 0.41) < 0.02
    assert code.min() < 0.2 * code.max()


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

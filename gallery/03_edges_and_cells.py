"""
How large is the power error of a photosite whose edges cut cells of the power map?

New here: the discretisation error of power maps with constant cells;
``Optics(oversample=k)``, cells smaller than the pixels of the scene, and their cost.

Expect: an error that decreases as the power -2 of the number of cells (within 0.25),
and no error where edges coincide with cell boundaries; with the oversampling that a
camera selects, at most 1e-3 of a point's energy in any photosite of side wavelength x
f-number.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.special import j1

import foveasim as fs
from foveasim.view import save_figure

WAVELENGTH_NM = 550.0
DISTANCE_M = 0.56
#: Ensquared energy of the Airy pattern in a centred square of side 1.5 x wavelength x
#: f-number.
SIDE, ENERGY_FRACTION = 1.5, 0.766734
CELLS = np.array([3, 5, 7, 9, 13, 17, 21])
#: Scene pixels per wavelength x f-number in the image, and cells of the map along a
#: scene pixel.
PIXELS_PER_LAMBDA_N = (1.2, 1.5, 2.0, 3.0)
OVERSAMPLE = (1, 2, 3, 4)
OPTICS = fs.Optics(
    focal_length_mm=22.0, f_number=4.0, padding="periodic", precision="double"
)
LAMBDA_N_UM = 1e-3 * WAVELENGTH_NM * OPTICS.working_f_number(DISTANCE_M)


def point(cells: float, n: int) -> fs.Scene:
    """
    Return n x n pixels with a central point, for a number of cells per wavelength x
    f-number.
    """
    return fs.Scene.point_sources(
        shape=(n, n),
        pixels=[(n // 2, n // 2)],
        intensity_w_sr_nm=1e-9,
        pitch_um=LAMBDA_N_UM / cells / OPTICS.magnification(DISTANCE_M),
        distance_m=DISTANCE_M,
        wavelength_nm=[WAVELENGTH_NM],
        band_width_nm=1.0,
    )


def airy_energy(centre: np.ndarray) -> np.ndarray:
    """
    Integrate the Airy pattern over unit squares at (n, 2) points, in wavelength x
    f-number.
    """
    node, weight = np.polynomial.legendre.leggauss(24)
    x, y = (centre[:, axis, np.newaxis] + 0.5 * node for axis in (0, 1))
    r = np.pi * np.hypot(x[:, np.newaxis, :], y[:, :, np.newaxis])
    return (
        np.einsum("nyx,y,x->n", (2.0 * j1(r) / r) ** 2, weight, weight) * np.pi / 16.0
    )


def worst_error(cells: float, k: int | str) -> float:
    """
    Return the largest energy error of 300 squares of side wavelength x f-number near a
    point.
    """
    n = int(40 * cells) | 1
    scene = point(cells, n)
    optics = replace(OPTICS, oversample=k).resolve_oversample(scene)
    power_map = optics.power_map(scene)
    centre = np.random.default_rng(1).uniform(-1.5, 1.5, (300, 2))
    squares = fs.Layout.from_rectangles(centre * LAMBDA_N_UM, LAMBDA_N_UM)
    power = fs.Integrator(squares, power_map.grid, order=2)(power_map.data)[0]
    total = power_map.data.sum() * power_map.grid.cell_area_um2
    return float(np.abs(power / total - airy_energy(centre)).max())


def optics_time_s(k: int) -> float:
    """
    Return the shortest of three times of the optics for a picture of 700 x 700 pixels,
    s.
    """
    scene, optics = point(2.0, 700), replace(OPTICS, oversample=k, precision="single")
    times = []
    for _ in range(3):
        start_s = time.perf_counter()
        optics.power_map(scene)
        times.append(time.perf_counter() - start_s)
    return min(times)


def energy_fraction(cells: float, side: float) -> float:
    """
    Return the energy fraction in a square for a number of cells per wavelength x
    f-number.
    """
    power_map = OPTICS.power_map(point(cells, 1025))
    square = fs.Layout.from_rectangles([[0.0, 0.0]], side * LAMBDA_N_UM)
    power = fs.Integrator(square, power_map.grid)(power_map.data)[0, 0]
    return float(power / (power_map.data.sum() * power_map.grid.cell_area_um2))


def main(out_dir: Path) -> None:
    """Write the error curves to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Odd numbers of cells per wavelength x f-number: the edges of the square pass
    # through cell centres.
    errors = np.array(
        [energy_fraction(cells, SIDE) - ENERGY_FRACTION for cells in CELLS]
    )
    for cells, error in zip(CELLS, errors, strict=True):
        print(f"{cells:3d} cells: {error:+.2e}")

    # %% Six cells per wavelength x f-number, nine per square: its edges coincide with
    # cell boundaries.
    on_boundaries = energy_fraction(6, SIDE) - ENERGY_FRACTION
    print(f"edges on cell boundaries: {on_boundaries:+.1e}")

    # %% Cells smaller than scene pixels: largest error over 300 positions at second
    # order, and cost.
    errors_oversampled = np.array(
        [[worst_error(cells, k) for k in OVERSAMPLE] for cells in PIXELS_PER_LAMBDA_N]
    )
    errors_auto = [worst_error(cells, "auto") for cells in PIXELS_PER_LAMBDA_N]
    cost_s = np.array([optics_time_s(k) for k in OVERSAMPLE])
    print(
        "pixels per λN   "
        + "".join(f"k = {k:<6}" for k in OVERSAMPLE)
        + "k selected by a camera"
    )
    for cells, row, auto in zip(
        PIXELS_PER_LAMBDA_N, errors_oversampled, errors_auto, strict=True
    ):
        k = OPTICS.auto_oversample(point(cells, 101))
        print(
            f"{cells:13g}   "
            + "".join(f"{error:<10.1e}" for error in row)
            + f"{auto:.1e} (k = {k})"
        )
    print(
        "relative time   " + "".join(f"{ratio:<10.1f}" for ratio in cost_s / cost_s[0])
    )
    print("relative memory " + "".join(f"{k * k:<10}" for k in OVERSAMPLE))

    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    axes, oversampled = figure.subplots(1, 2)
    for cells, row in zip(PIXELS_PER_LAMBDA_N, errors_oversampled, strict=True):
        oversampled.semilogy(OVERSAMPLE, row, "o-", label=f"{cells:g} pixels per λN")
    oversampled.margins(x=0.12)
    oversampled.axhline(1e-3, color="grey", linestyle=":")
    oversampled.set_xticks(OVERSAMPLE, [f"{k}\n× {k * k}" for k in OVERSAMPLE])
    oversampled.set_xlabel(
        "oversample: cells along a scene pixel,\nand relative memory"
    )
    oversampled.set_ylabel("largest error of the energy fraction of a photosite")
    oversampled.legend()
    axes.loglog(CELLS, np.abs(errors), "o-", label="edges inside cells")
    axes.loglog(
        CELLS,
        np.abs(errors[0]) * (CELLS[0] / CELLS) ** 2,
        ":",
        color="grey",
        label="power -2",
    )
    axes.set_xticks([3, 6, 10, 20], ["3", "6", "10", "20"])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("cells per wavelength × f-number")
    axes.set_ylabel("error of the energy fraction of a photosite")
    axes.legend()
    save_figure(figure, out_dir / "03_edges_and_cells.png", dpi=140)

    # %% Checks.
    slope = float(np.polyfit(np.log(CELLS), np.log(np.abs(errors)), 1)[0])
    print(f"slope {slope:.2f}")
    assert abs(slope + 2.0) < 0.25
    assert abs(on_boundaries) < 1e-5
    assert max(errors_auto) < 1e-3


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

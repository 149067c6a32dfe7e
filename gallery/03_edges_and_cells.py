"""
How wrong is the light in a pixel whose edges cut the map's cells?

New here: the limit of a map that is constant on its cells, and how it shrinks; Optics(oversample=k), cells finer than the
pixels of the scene, and what they cost.

Expect: an error that falls as the power -2 of the number of cells (within 0.25), and none where edges lie on cell borders;
with the oversampling that a camera chooses, at most 1e-3 of a point's energy in any pixel of side wavelength x f-number.
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
#: Fraction of a point's light in a centred square of side 1.5 x wavelength x f-number (the Airy pattern's integral).
SIDE, SHARE = 1.5, 0.766734
CELLS = np.array([3, 5, 7, 9, 13, 17, 21])
#: Pixels of the scene's image per wavelength x f-number, and cells of the map along a pixel.
COARSE = (1.2, 1.5, 2.0, 3.0)
FINER = (1, 2, 3, 4)
OPTICS = fs.Optics(focal_length_mm=22.0, f_number=4.0, padding="periodic", precision="double")


LAMBDA_N_UM = 1e-3 * WAVELENGTH_NM * OPTICS.working_f_number(DISTANCE_M)


def point(cells: float, n: int) -> fs.Scene:
    """Make a scene of n x n pixels with a point in the centre one, imaged at a number of pixels per wavelength x f-number."""
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
    """Integrate the Airy pattern over squares of side 1 around points (n, 2), in wavelength x f-number."""
    node, weight = np.polynomial.legendre.leggauss(24)
    x, y = (centre[:, axis, np.newaxis] + 0.5 * node for axis in (0, 1))
    r = np.pi * np.hypot(x[:, np.newaxis, :], y[:, :, np.newaxis])
    return np.einsum("nyx,y,x->n", (2.0 * j1(r) / r) ** 2, weight, weight) * np.pi / 16.0


def worst_error(cells: float, k: int | str) -> float:
    """Find the largest error of the fraction of a point's energy in squares of side wavelength x f-number around it."""
    n = int(40 * cells) | 1
    scene = point(cells, n)
    optics = replace(OPTICS, oversample=k).resolve_oversample(scene)
    power_map = optics.power_map(scene)
    centre = np.random.default_rng(1).uniform(-1.5, 1.5, (300, 2))
    squares = fs.Layout.from_rectangles(centre * LAMBDA_N_UM, LAMBDA_N_UM)
    power = fs.Integrator(squares, power_map.grid, order=2)(power_map.data)[0]
    whole = power_map.data.sum() * power_map.grid.cell_area_um2
    return float(np.abs(power / whole - airy_energy(centre)).max())


def seconds(k: int) -> float:
    """Time the optics of a picture of 700 x 700 pixels, the best of three."""
    scene, optics = point(2.0, 700), replace(OPTICS, oversample=k, precision="single")
    times = []
    for _ in range(3):
        start_s = time.perf_counter()
        optics.power_map(scene)
        times.append(time.perf_counter() - start_s)
    return min(times)


def share_of_light(cells: float, side: float) -> float:
    """Fraction of a point's light in a square, on a map of so many cells to wavelength x f-number."""
    power_map = OPTICS.power_map(point(cells, 1025))
    square = fs.Layout.from_rectangles([[0.0, 0.0]], side * LAMBDA_N_UM)
    power = fs.Integrator(square, power_map.grid)(power_map.data)[0, 0]
    return float(power / (power_map.data.sum() * power_map.grid.cell_area_um2))


def main(out_dir: Path) -> None:
    """Write the curve of errors to a folder."""
    # %% Odd numbers of cells to wavelength x f-number: the square's edges lie in the middle of cells.
    errors = np.array([share_of_light(cells, SIDE) - SHARE for cells in CELLS])
    for cells, error in zip(CELLS, errors, strict=True):
        print(f"{cells:3d} cells: {error:+.2e}")

    # %% Six cells: nine to the square, whose edges lie on their borders.
    on_borders = share_of_light(6, SIDE) - SHARE
    print(f"edges on cell borders: {on_borders:+.1e}")

    # %% Finer cells than pixels of the scene: the largest error over all positions at second order, and the price.
    errors_finer = np.array([[worst_error(cells, k) for k in FINER] for cells in COARSE])
    chosen = [worst_error(cells, "auto") for cells in COARSE]
    cost = np.array([seconds(k) for k in FINER])
    print("pixels per λN   " + "".join(f"k = {k:<6}" for k in FINER) + "k chosen by a camera")
    for cells, row, auto in zip(COARSE, errors_finer, chosen, strict=True):
        k = OPTICS.auto_oversample(point(cells, 101))
        print(f"{cells:13g}   " + "".join(f"{error:<10.1e}" for error in row) + f"{auto:.1e} (k = {k})")
    print("optics, time    " + "".join(f"{ratio:<10.1f}" for ratio in cost / cost[0]))
    print("map, memory     " + "".join(f"{k * k:<10}" for k in FINER))

    figure = Figure(figsize=(10.4, 4.0), layout="constrained")
    axes, finer = figure.subplots(1, 2)
    for cells, row in zip(COARSE, errors_finer, strict=True):
        finer.semilogy(FINER, row, "o-", label=f"{cells:g} pixels per λN")
    finer.margins(x=0.12)
    finer.axhline(1e-3, color="grey", linestyle=":")
    finer.set_xticks(FINER, [f"{k}\n{k * k} × memory" for k in FINER])
    finer.set_xlabel("oversample: cells along a pixel of the scene")
    finer.set_ylabel("largest error of the energy in a pixel")
    finer.legend()
    axes.loglog(CELLS, np.abs(errors), "o-", label="edges inside cells")
    axes.loglog(CELLS, np.abs(errors[0]) * (CELLS[0] / CELLS) ** 2, ":", color="grey", label="power -2")
    axes.set_xlabel("cells to wavelength × f-number")
    axes.set_ylabel("error of the fraction of light")
    axes.legend()
    save_figure(figure, out_dir / "03_edges_and_cells.png", dpi=120)

    # %% The numbers.
    slope = float(np.polyfit(np.log(CELLS), np.log(np.abs(errors)), 1)[0])
    print(f"power {slope:.2f}")
    assert abs(slope + 2.0) < 0.25
    assert abs(on_borders) < 1e-5
    assert max(chosen) < 1e-3


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

"""
How wrong is the light in a pixel whose edges cut the map's cells?

New here: the limit of a map that is constant on its cells, and how it shrinks.

Expect: an error that falls as the power -2 of the number of cells (within 0.25), and none where edges lie on cell borders.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.view import save_figure

WAVELENGTH_NM = 550.0
DISTANCE_M = 0.56
#: Share of a point's light in a centred square of side 1.5 x wavelength x f-number (the Airy pattern's integral).
SIDE, SHARE = 1.5, 0.766734
CELLS = np.array([3, 5, 7, 9, 13, 17, 21])


def share_of_light(cells: float, side: float) -> float:
    """Share of a point's light in a square, on a map of so many cells to wavelength x f-number."""
    optics = fs.Optics(focal_length_mm=22.0, f_number=4.0, padding="periodic", precision="double")
    lambda_n_um = 1e-3 * WAVELENGTH_NM * optics.working_f_number(DISTANCE_M)
    n = 1025
    scene = fs.Scene.point_sources(
        shape=(n, n),
        pixels=[(n // 2, n // 2)],
        intensity_w_sr_nm=1e-9,
        pitch_um=lambda_n_um / cells / optics.magnification(DISTANCE_M),
        distance_m=DISTANCE_M,
        wavelength_nm=[WAVELENGTH_NM],
        band_width_nm=1.0,
    )
    power_map = optics.power_map(scene)
    square = fs.Layout.from_rectangles([[0.0, 0.0]], side * lambda_n_um)
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

    axes = Figure(figsize=(6.4, 4.0), layout="constrained").add_subplot()
    axes.loglog(CELLS, np.abs(errors), "o-", label="edges inside cells")
    axes.loglog(CELLS, np.abs(errors[0]) * (CELLS[0] / CELLS) ** 2, ":", color="grey", label="power -2")
    axes.set_xlabel("cells to wavelength × f-number")
    axes.set_ylabel("error of the share of light")
    axes.legend()
    save_figure(axes.figure, out_dir / "03_edges_and_cells.png", dpi=120)

    # %% The numbers.
    slope = float(np.polyfit(np.log(CELLS), np.log(np.abs(errors)), 1)[0])
    print(f"power {slope:.2f}")
    assert abs(slope + 2.0) < 0.25
    assert abs(on_borders) < 1e-5


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

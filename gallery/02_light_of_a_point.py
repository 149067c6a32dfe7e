"""
Which fraction of the energy of a point source falls on a square photosite?

New here: ``Scene.point_sources``, ``Optics.power_map``, ``Integrator``,
``Layout.from_rectangles``.

Expect: an ensquared energy of 52.889 % (within 0.001 %) in a square of side wavelength
x f-number, the textbook value of the Airy pattern.
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
CELLS = 9
SIDES = np.arange(1, 46, 2) / CELLS
SHAPE = (1025, 1025)


def main(out_dir: Path) -> None:
    """Write the curve of ensquared energy to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% One point on the axis; nine cells of the power map per wavelength x f-number.
    optics = fs.Optics(
        focal_length_mm=22.0, f_number=4.0, padding="periodic", precision="double"
    )
    lambda_n_um = 1e-3 * WAVELENGTH_NM * optics.working_f_number(DISTANCE_M)
    scene = fs.Scene.point_sources(
        shape=SHAPE,
        pixels=[(SHAPE[0] // 2, SHAPE[1] // 2)],
        intensity_w_sr_nm=1e-9,
        pitch_um=lambda_n_um / CELLS / optics.magnification(DISTANCE_M),
        distance_m=DISTANCE_M,
        wavelength_nm=[WAVELENGTH_NM],
        band_width_nm=1.0,
    )
    power_map = optics.power_map(scene)

    # %% Squares centred on the point, with edges on cell boundaries, where the integral
    # is exact.
    squares = fs.Layout.from_rectangles(np.zeros((SIDES.size, 2)), SIDES * lambda_n_um)
    power = fs.Integrator(squares, power_map.grid)(power_map.data)[0]
    ensquared = power / (power_map.data.sum() * power_map.grid.cell_area_um2)

    axes = Figure(figsize=(6.4, 4.0), layout="constrained").add_subplot()
    axes.plot(SIDES, 100 * ensquared, "o-", markersize=3)
    axes.set_xlabel("side of the photosite / (wavelength × f-number)")
    axes.set_ylabel("ensquared energy / %")
    axes.set_ylim(0, 100)
    axes.grid(visible=True, alpha=0.3)
    save_figure(axes.figure, out_dir / "02_light_of_a_point.png", dpi=140)

    # %% Check.
    at_lambda_n = float(ensquared[CELLS // 2])
    print(
        f"{100 * at_lambda_n:.3f} % of the energy in a square of side wavelength "
        "x f-number"
    )
    assert abs(at_lambda_n - 0.52889) < 1e-5


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

"""
How much light do the photosites of a fovea lose in their pixel stack, and what do
microlenses recover?

New here: ``Sensor(pixel_optics=...)`` with ``ApertureStack`` and ``Microlens``,
``Camera.angular_response``, ``Optics(exit_pupil_mm=...)``.

Expect: with openings above photodiodes, sites of 3.2 µm in the fovea collect 0.77 of
their light at f/1.4 and 0.94 at f/5.6, large sites in the periphery 0.97 and 0.99;
small sites with microlenses collect all of it on the axis, and far from the axis only
if the microlenses are shifted.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.view import save_figure

HEIGHT_UM, INDEX = 4.0, 1.5
F_NUMBERS = np.array([1.4, 2.0, 2.8, 4.0, 5.6, 8.0])
EXIT_PUPIL_MM = 12.0
#: The camera module of a phone: a near exit pupil.
NEAR_PUPIL_MM = 3.0
SCENE = fs.Scene.flat(
    shape=(64, 64), pitch_um=5000.0, distance_m=1.0, illuminance_lux=500.0
)


def response_of(
    layout: fs.Layout, optics: fs.Optics, pixel_optics: fs.sensor.PixelOptics
) -> np.ndarray:
    """Return the response of each site behind a lens."""
    return fs.Camera(
        optics=optics, sensor=fs.Sensor(layout, pixel_optics=pixel_optics)
    ).angular_response(SCENE)


def main(out_dir: Path) -> None:
    """Write the figure to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% A foveal sensor with openings above photodiodes, against the f-number.
    layout = fs.layout.log_polar(
        n_sectors=240, r_min_um=120.8, r_max_um=1012.0, n_rings=81
    )
    radius_um = np.hypot(*layout.centroid_um.T)
    sites = {
        "fovea": int(radius_um.argmin()),
        "periphery": int(np.abs(radius_um - 1000.0).argmin()),
    }
    stack = fs.sensor.ApertureStack(height_um=HEIGHT_UM, refractive_index=INDEX)
    responses = [
        response_of(
            layout,
            fs.Optics(
                focal_length_mm=8.0, f_number=f_number, exit_pupil_mm=EXIT_PUPIL_MM
            ),
            stack,
        )
        for f_number in F_NUMBERS.tolist()
    ]

    # %% A row of small photosites behind a near exit pupil, with and without
    # microlenses.
    near = fs.Optics(focal_length_mm=4.0, f_number=2.0, exit_pupil_mm=NEAR_PUPIL_MM)
    row = fs.layout.grid(n_x=833, n_y=1, pitch_um=2.4)
    x_um = row.centroid_um[:, 0]
    lens = {
        "height_um": HEIGHT_UM,
        "refractive_index": INDEX,
        "photodiode_inset_um": 0.4,
    }
    kinds = {
        "openings only": fs.sensor.ApertureStack(**lens),
        "microlenses": fs.sensor.Microlens(**lens),
        "shifted microlenses": fs.sensor.Microlens(**lens, shift="optimal"),
    }
    rows = {name: response_of(row, near, kind) for name, kind in kinds.items()}

    figure = Figure(figsize=(7.6, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for (name, site), colour in zip(sites.items(), ("#b5403a", "#3a6ea5"), strict=True):
        label = f"{name}: sites of {layout.size_um[site]:.1f} µm"
        left.plot(
            F_NUMBERS,
            [each[site] for each in responses],
            "o-",
            markersize=4,
            color=colour,
            label=label,
        )
    left.set_xscale("log", base=2)
    left.set_xticks(F_NUMBERS, [f"{n:g}" for n in F_NUMBERS])
    left.set_xlabel("f-number")
    left.set_ylabel("response to uniform light")
    for name, response in rows.items():
        right.plot(1e-3 * x_um, response, label=name)
    right.set_xlabel("distance from the optical axis / mm")
    right.set_ylabel(f"response of sites of 2.4 µm at f/{near.f_number:g}")
    for axes in (left, right):
        axes.set_ylim(0.0, 1.05)
        axes.grid(visible=True, alpha=0.3)
        axes.legend(fontsize=9, loc="lower center")
    save_figure(figure, out_dir / "33_angular_response.png", dpi=140)

    # %% Check: the loss of a small site, and what the shift recovers.
    for k, expected in ((0, 0.77), (2, 0.88), (4, 0.94)):
        assert abs(responses[k][sites["fovea"]] - expected) < 0.006
    assert min(each[sites["periphery"]] for each in responses) > 0.96
    corner, axis = 0, int(np.abs(x_um).argmin())
    assert rows["shifted microlenses"].min() > 0.95
    assert rows["microlenses"][axis] > 0.95
    assert rows["microlenses"][corner] < 0.6
    print(
        f"fovea at f/1.4: {responses[0][sites['fovea']]:.2f}, periphery: "
        f"{responses[0][sites['periphery']]:.2f}"
    )
    for name, response in rows.items():
        print(
            f"{name}: {response[axis]:.2f} on the axis, {response[corner]:.2f} "
            f"at {1e-3 * abs(x_um[corner]):.1f} mm"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

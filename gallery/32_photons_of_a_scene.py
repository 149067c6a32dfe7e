"""
How many photoelectrons does a photosite collect, from moonlight to sunlight?

New here: ``Scene.flat(illuminance_lux=...)``, ``Camera.photoelectrons_per_s`` of
photosites of many sizes.

Expect: irradiance that falls with the fourth power of the cosine of the field angle
(within 0.1 %), and charges in proportion to area and illuminance; in an office, in 1/30
s at f/2.8, a photosite of 1.4 µm collects 1,620 photoelectrons, one of 3.45 µm 9,836.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.view import save_figure

DISTANCE_M = 1.0
EXPOSURE_S = 1.0 / 30.0
OPTICS = fs.Optics(focal_length_mm=8.0, f_number=2.8, oversample=1)
#: Light in lux, and its name.
LIGHTS = {
    0.2: "full moon",
    10.0: "street lamps",
    500.0: "office",
    10_000.0: "overcast day",
}
SIZES_UM = np.geomspace(0.7, 30.0, 15)
N_PIXELS = 401


def flat(pitch_um: float, illuminance_lux: float) -> fs.Scene:
    """
    Return a white wall at a distance of 1 m that reflects 18 % of the light, as an
    average scene does.
    """
    return fs.Scene.flat(
        shape=(N_PIXELS, N_PIXELS),
        pitch_um=pitch_um,
        distance_m=DISTANCE_M,
        illuminance_lux=illuminance_lux,
        reflectance=0.18,
        wavelength_nm=np.arange(400.0, 701.0, 10.0),
    )


def main(out_dir: Path) -> None:
    """Write the figure to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Irradiance along a row of the map of a wide field, relative to the axis.
    pitch_um = 4000.0
    cells = OPTICS.power_map(flat(pitch_um, 500.0)).data.sum(axis=0)
    middle = N_PIXELS // 2
    tangent = (np.arange(N_PIXELS) - middle) * 1e-6 * pitch_um / DISTANCE_M
    angle_deg = np.degrees(np.arctan(tangent))
    relative = cells[middle] / cells[middle, middle]

    # %% Photoelectrons of squares of all sizes, side by side on the axis, in four kinds
    # of light.
    places_um = np.c_[np.cumsum(SIZES_UM + 1.0) - SIZES_UM / 2, np.zeros(SIZES_UM.size)]
    squares = fs.Layout.from_rectangles(
        places_um - [places_um[-1, 0] / 2, 0.0], SIZES_UM
    )
    camera = fs.Camera(
        optics=OPTICS, sensor=fs.Sensor(squares, qe=fs.SiliconQE(depth_um=3.0))
    )
    electrons = {
        name: EXPOSURE_S * camera.photoelectrons_per_s(flat(200.0, lux))
        for lux, name in LIGHTS.items()
    }

    figure = Figure(figsize=(7.6, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(
        angle_deg,
        100.0 * np.cos(np.radians(angle_deg)) ** 4,
        color="#bbbbbb",
        linewidth=5,
        label="cos⁴",
    )
    left.plot(
        angle_deg, 100.0 * relative, color="#b5403a", linewidth=1.2, label="computed"
    )
    left.set_xlabel("field angle / degrees")
    left.set_ylabel("irradiance / % of that on the axis")
    left.set_ylim(0, 105)
    for name, charge_e in electrons.items():
        right.loglog(SIZES_UM, charge_e, "o-", markersize=3, label=name)
    right.set_xlabel("side of the photosite / µm")
    right.set_ylabel("photoelectrons in 1/30 s at f/2.8")
    right.set_ylim(0.1, 3e9)  # room for the legend
    snr = right.secondary_yaxis(
        "right", functions=(lambda e: np.sqrt(np.maximum(e, 1e-9)), np.square)
    )
    snr.set_ylabel("signal-to-noise ratio with photon shot noise only")
    for axes in (left, right):
        axes.grid(visible=True, alpha=0.3)
        axes.legend(fontsize=9, ncols=2 if axes is right else 1)
    save_figure(figure, out_dir / "32_photons_of_a_scene.png", dpi=140)

    # %% Check: the closed forms.
    inner = np.abs(angle_deg) < 30.0
    assert np.allclose(
        relative[inner], np.cos(np.radians(angle_deg[inner])) ** 4, rtol=1e-3
    )
    office = electrons["office"]
    assert np.allclose(office / SIZES_UM**2, office[0] / SIZES_UM[0] ** 2, rtol=1e-2)
    assert np.allclose(electrons["overcast day"], 20.0 * office, rtol=1e-6)
    for side_um in (1.4, 3.45):
        charge_e = float(office[0]) * (side_um / SIZES_UM[0]) ** 2
        print(f"office: {charge_e:,.0f} photoelectrons on {side_um} µm")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

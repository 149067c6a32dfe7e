"""
How do quantum efficiency and colour filters combine, and how does a colour mosaic
record a grey picture?

New here: ``sensor.ccd_qe``, ``PolynomialCurve``, ``camera_filters``, ``PassBand``,
products of curves, ``layout.mosaic``.

Expect: a polynomial of degree 5 within 0.012 of a measured quantum efficiency from 400
to 1000 nm (Fig. 5 of the paper); one curve for filters, quantum efficiency and infrared
cut, with the same electrons as the three curves (Fig. 6); a grey picture at three
wavelengths in one mosaic (Fig. 7): the sum of three monochromatic pictures within 1e-6
of the brightest site, and electrons per photon of each colour that agree with the
curves within 1e-5.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from skimage.data import camera as photographer

import foveasim as fs
from foveasim.sensor import (
    Curve,
    PassBand,
    PolynomialCurve,
    StepCurve,
    camera_filters,
    ccd_qe,
)
from foveasim.view import plot_capture, save_figure

FROM_NM, TO_NM = 400.0, 1000.0
DEGREES = (2, 3, 5, 9)
#: Wavelengths of red, green and blue in Fig. 7 of the paper.
RGB_NM = (620.0, 550.0, 450.0)
BAND_NM = 10.0
PITCH_UM = 10.0
COLOURS = {"R": "tab:red", "G": "tab:green", "B": "tab:blue"}
LIGHT = {"pitch_um": 500.0, "distance_m": 1.0, "band_width_nm": BAND_NM}
OPTICS = fs.Optics(focal_length_mm=8.0, f_number=2.8)
EXPOSURE_S = 1 / 30


def fits() -> dict[int, PolynomialCurve]:
    """Fit polynomials of several degrees to the table from 400 to 1000 nm."""
    table = ccd_qe()
    inside = [
        (w, v)
        for w, v in zip(table.wavelength_nm, table.value, strict=True)
        if FROM_NM <= w <= TO_NM
    ]
    waves_nm, values = zip(*inside, strict=True)
    return {
        degree: PolynomialCurve(wavelength_nm=waves_nm, value=values, degree=degree)
        for degree in DEGREES
    }


def draw_filters(
    axes: Axes, filters: fs.FilterSet, waves_nm: np.ndarray, title: str, y_label: str
) -> None:
    """Plot the curves of a filter set in their colours."""
    for name, values in zip(filters.names, filters.transmission(waves_nm), strict=True):
        axes.plot(waves_nm, values, color=COLOURS[name], label=name)
    axes.set_title(title)
    axes.set(xlabel="wavelength / nm", ylabel=y_label)
    axes.set_ylim(0.0, 1.05)


def sensors(qe: Curve) -> dict[str, fs.Sensor]:
    """
    Return sensors of squares, hexagons and rings with equal electronics and RGB
    filters.
    """
    make = fs.layout
    layouts = {
        "squares": make.mosaic(
            make.grid(n_x=120, n_y=120, pitch_um=PITCH_UM), ("RG", "GB")
        ),
        "hexagons": make.mosaic(
            make.hexagonal(n_columns=120, n_rows=140, pitch_um=PITCH_UM),
            ("RGB", "GBR", "BRG"),
        ),
        "rings": make.mosaic(
            make.log_polar(
                n_sectors=192, min_size_um=3.0, r_max_um=600.0, stagger=True
            ),
            ("RG", "GB"),
        ),
    }
    return {
        name: fs.Sensor(
            layout, qe=qe, filters="rgb", capacitance_f=2e-15 * layout.area_um2, bits=10
        )
        for name, layout in layouts.items()
    }


def electrons(sensor: fs.Sensor, scene: fs.Scene) -> np.ndarray:
    """Return the expected charge of every site."""
    return (
        fs.Camera(optics=OPTICS, sensor=sensor)
        .capture(scene, exposure_s=EXPOSURE_S, seed=1)
        .expected_e
    )


def main(out_dir: Path) -> None:
    """Write the curves and the mosaics to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Fig. 5: a table of quantum efficiencies, and polynomial fits.
    table, polynomials = ccd_qe(), fits()
    waves_nm = np.arange(FROM_NM, TO_NM + 1.0)
    worst = {
        degree: float(np.abs(curve(waves_nm) - table(waves_nm)).max())
        for degree, curve in polynomials.items()
    }
    figure = Figure(figsize=(8, 4.6), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(
        table.wavelength_nm,
        table.value,
        "ko",
        markersize=4,
        label="measured (ESO, CCD44-82)",
    )
    for degree, curve in polynomials.items():
        axes.plot(
            waves_nm,
            curve(waves_nm),
            label=f"degree {degree}, largest error {worst[degree]:.3f}",
        )
    steps = StepCurve(edge_nm=[400, 600, 800, 1000], value=table([500.0, 700.0, 900.0]))
    axes.plot(waves_nm, steps(waves_nm), ":", color="gray", label="piecewise constant")
    axes.set_xlabel("wavelength / nm")
    axes.set_ylabel("quantum efficiency")
    axes.set_ylim(0.0, 1.0)
    axes.legend()
    save_figure(figure, out_dir / "08_quantum_efficiency.png", dpi=140)

    # %% Fig. 6: filters, and their product with an infrared cut and the quantum
    # efficiency of silicon.
    visible_nm = np.arange(FROM_NM, 751.0)
    qe, cut = polynomials[5], PassBand(to_nm=660.0, edge_nm=25.0)
    combined = fs.rgb_filters() * qe * cut
    figure = Figure(figsize=(8.0, 6.6), layout="constrained")
    (first, second), (third, rest) = figure.subplots(2, 2, sharey=True)
    rest.set_axis_off()
    draw_filters(first, fs.rgb_filters(), visible_nm, "filters", "transmission")
    draw_filters(
        second, combined, visible_nm, "filters × QE × infrared cut", "efficiency"
    )
    second.plot(
        visible_nm, qe(visible_nm), "k--", linewidth=1, label="quantum efficiency"
    )
    second.plot(visible_nm, cut(visible_nm), "k:", linewidth=1, label="infrared cut")
    draw_filters(
        third,
        camera_filters(),
        visible_nm,
        "measured product (Nikon D5100)",
        "relative efficiency",
    )
    rest.legend(handles=second.get_lines(), loc="center", frameon=False)
    save_figure(figure, out_dir / "08_filters.png", dpi=140)

    # %% Fig. 7: one grey picture as the radiance at three wavelengths, recorded by one
    # mosaic.
    peak = {"peak_radiance_w_m2_sr_nm": 0.2, **LIGHT}
    together = fs.Scene.from_picture(photographer(), wavelength_nm=RGB_NM, **peak)
    figure = Figure(figsize=(8.0, 5.8), layout="constrained")
    mosaics = sensors(qe * cut)
    for position, (name, sensor) in enumerate(mosaics.items(), start=1):
        capture = fs.Camera(optics=OPTICS, sensor=sensor).capture(
            together, exposure_s=EXPOSURE_S, seed=1
        )
        axes = plot_capture(
            capture, legend=False, ax=figure.add_subplot(2, 3, position)
        )
        axes.set_xlim(60, 260)
        axes.set_ylim(200, 400)
        axes.set_title(f"{name}: {sensor.layout.n_sites:,} sites", fontsize=10)
        axes = figure.add_subplot(2, 3, 3 + position)
        axes.imshow(capture.picture(max_pixels=600).to_image())
        axes.set_axis_off()
        axes.set_title("colours of the nearest sites", fontsize=10)
    save_figure(figure, out_dir / "08_mosaics.png", dpi=140)

    # %% Checks: curves combine to one, bands are additive, and channels agree with the
    # curves.
    print(", ".join(f"degree {degree}: {error:.3f}" for degree, error in worst.items()))
    assert worst[5] < 0.012
    assert list(worst.values()) == sorted(worst.values(), reverse=True)
    rays_nm = np.array(RGB_NM)
    per_photon = (
        (fs.rgb_filters().transmission(rays_nm) * qe(rays_nm) * cut(rays_nm))
        @ rays_nm
        / rays_nm.sum()
    )
    flat = fs.Scene.flat(
        shape=(400, 400), radiance_w_m2_sr_nm=0.1, wavelength_nm=RGB_NM, **LIGHT
    )
    for name, sensor in mosaics.items():
        efficiency = electrons(sensor, flat) / electrons(fs.Sensor(sensor.layout), flat)
        by_channel = [
            float(efficiency[sensor.layout.channel == k].mean()) for k in range(3)
        ]
        print(
            f"{name}: {by_channel[0]:.4f}, {by_channel[1]:.4f} and "
            f"{by_channel[2]:.4f} e- per photon in red, green and blue"
        )
        assert np.allclose(efficiency, per_photon[sensor.layout.channel], rtol=1e-5)

        all_e, one_curve = (
            electrons(sensor, together),
            fs.Sensor(sensor.layout, filters=combined),
        )
        assert np.allclose(electrons(one_curve, together), all_e, rtol=1e-12)
        monochromatic = [
            fs.Scene.from_picture(
                photographer(), wavelength_nm=[ray_nm], **peak
            )  # one picture per wavelength
            for ray_nm in RGB_NM
        ]
        assert np.allclose(
            sum(electrons(sensor, scene) for scene in monochromatic),
            all_e,
            rtol=0,
            atol=1e-6 * all_e.max(),
        )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

"""
Which frequencies do photosites of different shapes and layouts resolve, and how do
higher ones alias?

New here: ``slanted_edge_mtf``, ``polygon_mtf``, ``nyquist_vs_eccentricity``,
``sampling_spectrum``, ``aliasing_spectrum``.

Expect: the slanted-edge MTF of a lens with squares and with hexagons, within 2 % of its
closed form up to the Nyquist frequency; the Nyquist frequencies of the bundled layouts,
constant or inversely proportional to eccentricity; spectra of their sampling points:
peaks for lattices, which alias a sine above Nyquist to a lower frequency with the same
contrast, and rings for irregular sites, which convert it to noise.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.config import bundled_layouts, read_any_layout
from foveasim.metrics import (
    AliasingSpectrum,
    SamplingSpectrum,
    aliasing_spectrum,
    nyquist_per_mm,
    nyquist_vs_eccentricity,
    polygon_mtf,
    sampling_spectrum,
    slanted_edge_mtf,
    wave_vectors_per_mm,
)
from foveasim.optics import circular_otf
from foveasim.scene import charts
from foveasim.view import save_figure

OPTICS = fs.Optics(focal_length_mm=10.0, f_number=4.0)
DISTANCE_M, WAVELENGTH_NM = 0.5, 550.0
#: Size of a chart pixel in the image.
CELL_UM = 0.5
PITCH_UM, ANGLE_DEG = 4.0, 5.0
#: Maximum diameter of the discs for spectra, in sites; smaller where site sizes grow
#: with eccentricity.
SITES_ACROSS = 28
#: Frequency of the aliased sine over the Nyquist frequency.
SINE_OVER_NYQUIST = 1.4
#: Direction of the sine: midway between the rows and the diagonals of squares.
SINE_DEG = 22.5


def edge_and_closed_form(
    layout: fs.Layout,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return frequencies and MTFs: slanted edge; lens, chart and site; site only."""
    chart = charts.slanted_edge(
        angle_deg=ANGLE_DEG,
        shape=(600, 600),
        pitch_um=CELL_UM / OPTICS.magnification(DISTANCE_M),
        distance_m=DISTANCE_M,
        radiance_w_m2_sr_nm=0.1,
        wavelength_nm=[WAVELENGTH_NM],
        band_width_nm=10.0,
    )
    sensor = fs.Sensor(layout, capacitance_f=1e-15 * layout.area_um2)
    capture = fs.Camera(optics=OPTICS, sensor=sensor).capture(
        chart, exposure_s=0.1, seed=1
    )
    measured_mtf = slanted_edge_mtf(layout, capture.expected_e)
    print(f"{measured_mtf!r}")
    per_mm = measured_mtf.frequency_per_mm
    lens = circular_otf(
        per_mm * 1e-6 * WAVELENGTH_NM * OPTICS.working_f_number(DISTANCE_M)
    )
    # Mean of the chart over its pixel, and of the power map over a cell.
    cells = (
        np.prod(
            np.sinc(
                1e-3 * CELL_UM * wave_vectors_per_mm(per_mm, measured_mtf.angle_deg)
            ),
            axis=1,
        )
        ** 2
    )
    pixel = polygon_mtf(layout[[0]], per_mm, angle_deg=measured_mtf.angle_deg)[0]
    return per_mm, measured_mtf.mtf, lens * cells * pixel, pixel


def spectra(
    layout: fs.Layout, *, is_foveal: bool
) -> tuple[SamplingSpectrum, AliasingSpectrum]:
    """Return spectra of the sampling points in a disc and of a sine above Nyquist."""
    if np.unique(layout.channel).size > 1:
        layout = layout[layout.channel == 1]
    low, high = np.reshape(layout.bounds_um, (2, 2))
    # At the centre; in foveal layouts at a large eccentricity, where adjacent sites
    # have similar sizes.
    eccentricity_um = 0.375 * (high - low)[0] if is_foveal else 0.0
    site = np.hypot(
        *(layout.centroid_um - 0.5 * (low + high) - [eccentricity_um, 0.0]).T
    ).argmin()
    distance_um = np.sort(np.hypot(*(layout.centroid_um - layout.centroid_um[site]).T))
    radius_um = distance_um[min(distance_um.size - 1, int(np.pi / 4 * SITES_ACROSS**2))]
    max_radius_um = eccentricity_um / 3.0 if is_foveal else 0.5 * (high - low).min()
    region = {
        "centre_um": tuple(layout.centroid_um[site]),
        "radius_um": float(min(radius_um, max_radius_um)),
    }
    points = sampling_spectrum(layout, **region)
    wave = wave_vectors_per_mm(SINE_OVER_NYQUIST * points.nyquist_per_mm, SINE_DEG)[0]
    return points, aliasing_spectrum(layout, tuple(wave), **region)


def main(out_dir: Path) -> None:
    """Write the curves and the spectra to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% MTF of lens and photosites, by a slanted edge and in closed form.
    sensors = {
        "squares": fs.layout.grid(n_x=56, n_y=56, pitch_um=PITCH_UM),
        "hexagons": fs.layout.hexagonal(n_columns=56, n_rows=64, pitch_um=PITCH_UM),
    }
    figure = Figure(figsize=(8.0, 12.0), layout="constrained")
    axes = figure.subplots(3, 1)
    worst = {}
    for (name, layout), colour in zip(
        sensors.items(), ("tab:blue", "tab:orange"), strict=True
    ):
        per_mm, measured, expected, pixel = edge_and_closed_form(layout)
        nyquist = float(nyquist_per_mm(layout)[0])
        worst[name] = float(np.abs(measured / expected - 1.0)[per_mm <= nyquist].max())
        axes[0].plot(per_mm, pixel, ":", color=colour, label=f"{name}, pixel only")
        axes[0].plot(per_mm, expected, "-", color=colour, label=f"{name}, lens × pixel")
        axes[0].plot(
            per_mm[::4], measured[::4], ".", color=colour, label=f"{name}, slanted edge"
        )
        axes[0].axvline(nyquist, color=colour, linewidth=0.6)
        print(
            f"{name}: largest error {100.0 * worst[name]:.2f} % up to the "
            f"Nyquist frequency, {nyquist:.1f} per mm"
        )
    axes[0].set(
        xlabel="spatial frequency / (line pairs per mm)",
        ylabel="MTF",
        xlim=(0, 1e3 / PITCH_UM),
        ylim=(0, 1.02),
    )
    axes[0].set_title(f"pitch {PITCH_UM:g} µm; vertical lines: Nyquist frequencies")
    axes[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)

    # %% Nyquist frequencies of the bundled layouts against eccentricity.
    layouts = {
        name: read_any_layout(path).layout for name, path in bundled_layouts().items()
    }
    is_foveal = {}
    for name, layout in layouts.items():
        table = nyquist_vs_eccentricity(layout, n_bins=40, per_channel=True)
        bin_centre_um = 0.5 * (table.edges_um[1:] + table.edges_um[:-1])
        is_finite = np.isfinite(table.nyquist_per_mm)
        is_foveal[name] = table.growth_fraction != 0.0
        part = axes[1 if is_foveal[name] else 2]
        (line,) = part.plot(
            bin_centre_um[is_finite], table.nyquist_per_mm[is_finite], label=name
        )
        if is_foveal[name]:
            low, high = (
                table.nyquist_min_per_mm[is_finite],
                table.nyquist_max_per_mm[is_finite],
            )
            part.fill_between(
                bin_centre_um[is_finite],
                low,
                high,
                color=line.get_color(),
                alpha=0.2,
                linewidth=0.0,
            )
            print(
                f"{name}: size {table.size_at_centre_um:.3g} µm + "
                f"{table.growth_fraction:.4f} times the eccentricity"
            )
    for part, title in zip(
        axes[1:],
        ("foveal: median and range of sites and filters", "uniform: median of filters"),
        strict=True,
    ):
        part.set(
            xlabel="eccentricity / µm",
            ylabel="Nyquist frequency / (lp/mm)",
            xscale="log",
            yscale="log",
        )
        part.set_title(title)
        part.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    save_figure(figure, out_dir / "19_mtf_and_nyquist.png", dpi=140)

    # %% Aliasing of a sine above the Nyquist frequency.
    shown = layouts | {
        "hexagons": sensors["hexagons"],
        "sunflower": fs.layout.sunflower(n_sites=2500, spacing_um=PITCH_UM),
        "Voronoi, uniform density": fs.layout.voronoi(
            n_sites=2500, size_um=(200.0, 200.0), seed=1
        ),
    }
    n_rows = -(-len(shown) // 3)
    figure = Figure(figsize=(8.0, 2.7 * n_rows), layout="constrained")
    alias_ratio, parts = {}, iter(figure.subplots(n_rows, 3).ravel())
    for name, layout in shown.items():
        axes = next(parts)
        points, alias = spectra(layout, is_foveal=is_foveal.get(name, False))
        alias_ratio[name] = alias.alias_fraction / alias.baseband_fraction
        reach = points.frequency_per_mm[-1] / points.nyquist_per_mm
        axes.imshow(
            np.log10(points.power + 1e-9),
            origin="lower",
            extent=(-reach, reach, -reach, reach),
            cmap="magma",
            vmin=-2.5,
            vmax=2.5,
        )
        angle = np.linspace(0.0, 2.0 * np.pi, 100)
        axes.plot(np.cos(angle), np.sin(angle), "-", color="w", linewidth=0.6)
        axes.plot(*(alias.wave_per_mm / points.nyquist_per_mm), "+", color="c")
        axes.plot(*(alias.alias_per_mm / points.nyquist_per_mm), "x", color="lime")
        axes.set_title(
            f"{name}\nalias {100.0 * alias_ratio[name]:.0f} % of the sine", fontsize=10
        )
        axes.set(xticks=(-2, 0, 2), yticks=(-2, 0, 2))
    for axes in parts:
        axes.set_visible(False)
    figure.suptitle(
        "power spectra of sampling points, frequencies in units of Nyquist "
        "(circle):\na sine (+) and its strongest alias (×)"
    )
    save_figure(figure, out_dir / "19_sampling_spectra.png", dpi=140)

    # %% Checks.
    for name in ("bayer_grid", "sunflower", "Voronoi, uniform density"):
        print(
            f"{name}: strongest alias {100.0 * alias_ratio[name]:.1f} % of a "
            f"sine at {SINE_OVER_NYQUIST} times Nyquist"
        )
    assert max(worst.values()) < 0.02
    assert abs(alias_ratio["pixirad_1"] - 1.0) < 0.01
    assert alias_ratio["Voronoi, uniform density"] < 0.4


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

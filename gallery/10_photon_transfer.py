"""
Which gain, noise and full well do small and large photosites have, measured from their
codes alone?

New here: ``photon_transfer`` of simulated frames, ``predicted_photon_transfer`` and
``emva1288`` in ``foveasim.metrics``.

Expect: a photon transfer curve for each size, simulated and predicted, with a slope of
1/2 and a drop at full well; the system gains of 0.656 and 0.164 DN/e- within 3 %, and
the read noises of 6 and 12 e- within 5 %.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.metrics import (
    draw_frames,
    emva1288,
    photon_transfer,
    predicted_photon_transfer,
)
from foveasim.units import ELEMENTARY_CHARGE_C
from foveasim.view import save_figure

PITCH_UM = (2.0, 4.0)
BITS, V_SAT_V = 12, 1.0
CAPACITANCE_F, READ_NOISE_E, FULL_WELL_E = (
    (1e-15, 4e-15),
    (6.0, 12.0),
    (5000.0, 15_000.0),
)
DARK_E_PER_S, PRNU, QE = (4000.0, 16_000.0), 0.02, 0.6
EXPOSURE_S = 0.05
DARK_EXPOSURES_S = (0.02, 0.04, 0.06, 0.08, 0.1)
#: Number of sites of each size in the prediction.
N_PREDICTED = 10


def two_sizes(layout: fs.Layout) -> fs.Sensor:
    """
    Return a sensor of two site sizes.

    The outer sites have four times the area and capacitance and three times the full
    well.
    """
    zone = layout.columns["zone"]
    return fs.Sensor(
        layout,
        bits=BITS,
        v_sat_v=V_SAT_V,
        capacitance_f=np.take(CAPACITANCE_F, zone),
        read_noise_e=np.take(READ_NOISE_E, zone),
        full_well_e=np.take(FULL_WELL_E, zone),
        dark_e_per_s=np.take(DARK_E_PER_S, zone),
        prnu_fraction=PRNU,
        qe=QE,
    )


def charges(sensor: fs.Sensor, photons_per_um2: np.ndarray) -> list[np.ndarray]:
    """Return the expected charge of every site at several uniform exposures."""
    area_um2 = sensor.layout.area_um2
    return [
        sensor.expected_electrons(QE * p * area_um2 / EXPOSURE_S, EXPOSURE_S)
        for p in photons_per_um2
    ]


def main(out_dir: Path) -> None:
    """Write the curves to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Frames of uniform irradiance, from 1 % of saturation to beyond it, and dark
    # frames.
    sensor = two_sizes(fs.layout.zones(side_um=(200, 400), pitch_um=PITCH_UM))
    layout = sensor.layout
    size_um = np.take(PITCH_UM, layout.columns["zone"])
    photons_per_um2 = np.concatenate(
        (np.geomspace(4.0, 400.0, 12), np.arange(450.0, 2600.0, 50.0))
    )
    frames = [
        draw_frames(sensor, expected_e, seed=1, first_frame=2 * k)
        for k, expected_e in enumerate(charges(sensor, photons_per_um2))
    ]
    dark_frames = [
        draw_frames(
            sensor,
            sensor.expected_electrons(np.zeros(layout.n_sites), exposure_s),
            n_frames=8,
            seed=2,
            first_frame=8 * k,
        )
        for k, exposure_s in enumerate((EXPOSURE_S, *DARK_EXPOSURES_S))
    ]

    # %% Parameters by EMVA 1288.
    result = emva1288(
        frames,
        dark_frames[:1],
        photons_per_um2[:, None] * layout.area_um2,
        classes=size_um,
        dark_series=dark_frames[1:],
        exposure_s=DARK_EXPOSURES_S,
    )
    for c, size in enumerate(result.classes):
        print(
            f"{size:.0f} µm: {result.gain_dn_per_e[c]:.4f} DN/e-, read noise "
            f"{result.dark_noise_e[c]:.2f} e-, QE "
            f"{result.qe[c]:.3f}, saturation {result.saturation_e[c]:,.0f} e-, "
            f"PRNU {100 * result.prnu_fraction[c]:.2f} %, "
            f"dark current {result.dark_current_e_per_s[c]:,.0f} e-/s, SNR up to "
            f"{result.snr_max[c]:.1f}, dynamic range "
            f"{result.dynamic_range_db[c]:.1f} dB"
        )
        low, high = result.intervals["qe"][c]
        print(
            f"95 % confidence: QE from {low:.3f} to {high:.3f}; not resolved: "
            f"{result.records()[c]['not_resolved']}"
        )

    # %% Analytical prediction for some of the sites.
    some = np.concatenate(
        [np.flatnonzero(size_um == size)[:N_PREDICTED] for size in PITCH_UM]
    )
    few = two_sizes(layout[some])
    dense_per_um2 = np.concatenate(
        (np.geomspace(4.0, 1000.0, 40), np.arange(1010.0, 2600.0, 10.0))
    )
    dark_predicted = predicted_photon_transfer(
        few, charges(few, np.zeros(1)), classes=size_um[some]
    )
    predicted = predicted_photon_transfer(
        few, charges(few, dense_per_um2), classes=size_um[some]
    )
    simulated, dark = photon_transfer(frames, classes=size_um), result.dark

    # %% Figure.
    figure = Figure(figsize=(8.0, 8.6), layout="constrained")
    curves, variances = figure.subplots(2, 1)
    for c, (size, colour) in enumerate(
        zip(PITCH_UM, ("tab:blue", "tab:orange"), strict=True)
    ):
        for axes, transform in ((curves, np.sqrt), (variances, np.array)):
            axes.plot(
                simulated.mean_dn[:, c] - dark.mean_dn[0, c],
                transform(simulated.temporal_variance_dn2[:, c]),
                ".",
                color=colour,
                label=f"{size:.0f} µm, two frames",
            )
            axes.plot(
                predicted.mean_dn[:, c] - dark_predicted.mean_dn[0, c],
                transform(predicted.temporal_variance_dn2[:, c]),
                "-",
                color=colour,
                label=f"{size:.0f} µm, predicted",
            )
        read_dn = result.gain_dn_per_e[c] * result.dark_noise_e[c]
        curves.axhline(
            read_dn, color=colour, linestyle=":", label=f"{size:.0f} µm, read noise"
        )
    curves.set(
        xscale="log",
        yscale="log",
        xlabel="mean minus dark mean / DN",
        ylabel="temporal noise / DN",
    )
    variances.set(
        xlabel="mean minus dark mean / DN",
        ylabel="temporal variance / DN²",
        ylim=(0.0, None),
    )
    curves.set_title("photon transfer: slopes 0 and 1/2, drop at full well")
    variances.set_title("slope of the variance: system gain")
    curves.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    variances.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    save_figure(figure, out_dir / "10_photon_transfer.png", dpi=140)

    # %% Checks.
    gain_dn_per_e = 2**BITS * ELEMENTARY_CHARGE_C / (V_SAT_V * np.array(CAPACITANCE_F))
    assert np.allclose(gain_dn_per_e, (0.656, 0.164), atol=5e-4)
    assert np.allclose(result.gain_dn_per_e, gain_dn_per_e, rtol=0.03)
    assert np.allclose(result.dark_noise_e, READ_NOISE_E, rtol=0.05)
    assert np.allclose(result.qe, QE, rtol=0.03)
    assert np.allclose(
        predicted.gain_dn_per_e(dark_predicted), gain_dn_per_e, rtol=0.01
    )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

"""
Which foveal sensors give the best picture for their number of photosites?

New here: ``foveasim.explore.study``: a search with two objectives and a constraint,
with a Pareto front.

Expect: about ten of 40 sensors on the Pareto front, all with photosites on at least
92 % of the field; along the front, PSNR increases with the number of photosites.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.config import Shot
from foveasim.explore import study
from foveasim.metrics import METRICS
from foveasim.view import save_figure

FIELD_RADIUS_UM = 250.0
SHOT = {
    "scene": {
        "kind": "picture",
        "picture": "skimage:astronaut",
        "pitch_um": 125.0,
        "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 0.01,
        "wavelength_nm": [550],
        "band_width_nm": 50.0,
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {
        "generator": "log_polar",
        "parameters": {
            "n_sectors": 128,
            "min_size_um": 2.0,
            "r_max_um": FIELD_RADIUS_UM,
            "stagger": True,
        },
    },
    "sensor": {
        "qe": 0.6,
        "capacitance_f": {"per_um2": 3.0e-16},
        "read_noise_e": 1.0,
        "v_sat_v": 3.0,
        "bits": 12,
    },
    "exposure_s": 0.01,
}
N_TRIALS = 40
#: Trials for a test of the script.
QUICK = {"n_trials": 20}
MIN_COVERED_FRACTION = 0.92


def covered_fraction(_shot: Shot, _camera: fs.Camera, capture: fs.Capture) -> float:
    """Return the fraction of the circular field that photosites cover."""
    return float(capture.layout.area_um2.sum()) / (np.pi * FIELD_RADIUS_UM**2)


def main(out_dir: Path, n_trials: int = N_TRIALS) -> None:
    """Write the study and its figure to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Search over sectors and minimum site size; the blind spot grows with both.
    result = study(
        SHOT,
        {
            "layout.parameters.n_sectors": {"from": 32, "to": 192, "step": 4},
            "layout.parameters.min_size_um": {
                "from": 0.5,
                "to": 4.0,
                "spacing": "geometric",
            },
        },
        {"psnr_db": "maximize", "n_sites": "minimize"},
        constraints={"covered_fraction": (MIN_COVERED_FRACTION, None)},
        metrics={
            **{name: METRICS[name] for name in ("psnr_db", "n_sites")},
            "covered_fraction": covered_fraction,
        },
        n_trials=n_trials,
        seed=1,
        storage=out_dir / "22_study.db",
    )
    trials = [trial for trial in result.trials if trial.values]
    front = sorted(result.best_trials, key=lambda trial: trial.values[1])

    # %% All trials, and the Pareto front.
    figure = Figure(figsize=(7.6, 5.0), layout="constrained")
    ax = figure.subplots()
    is_feasible = np.array(
        [
            trial.user_attrs["covered_fraction"] >= MIN_COVERED_FRACTION
            for trial in trials
        ]
    )
    psnr_db, n_sites = np.array([trial.values for trial in trials]).T
    size_um = np.array(
        [trial.params["layout.parameters.min_size_um"] for trial in trials]
    )
    ax.plot(
        n_sites[~is_feasible],
        psnr_db[~is_feasible],
        "x",
        color="0.6",
        label="blind spot too large",
    )
    ax.plot(
        [trial.values[1] for trial in front],
        [trial.values[0] for trial in front],
        color="black",
        linewidth=1,
        label="Pareto front",
    )
    points = ax.scatter(
        n_sites[is_feasible],
        psnr_db[is_feasible],
        c=size_um[is_feasible],
        norm=mpl.colors.LogNorm(0.5, 4.0),
        zorder=3,
        label="feasible",
    )
    colour_bar = figure.colorbar(points, ax=ax, label="smallest photosite / µm")
    colour_bar.ax.set_yticks([0.5, 1, 2, 4], ["0.5", "1", "2", "4"])
    colour_bar.ax.set_yticks([], minor=True)
    ax.set(
        xscale="log",
        xlabel="photosites",
        ylabel="PSNR relative to the optical image / dB",
    )
    ax.grid(color="0.9")
    ax.legend(frameon=False)
    save_figure(figure, out_dir / "22_study.png", dpi=140)

    # %% Checks.
    for trial in front:
        settings = ", ".join(
            f"{path.rpartition('.')[2]} {value:.3g}"
            for path, value in trial.params.items()
        )
        print(
            f"{trial.values[1]:7,.0f} photosites, {trial.values[0]:.1f} dB: {settings}"
        )
    assert len(trials) == n_trials
    assert 7 <= len(front) <= 14
    assert all(
        trial.user_attrs["covered_fraction"] >= MIN_COVERED_FRACTION for trial in front
    )
    assert all(np.diff([trial.values[0] for trial in front]) > 0.0)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

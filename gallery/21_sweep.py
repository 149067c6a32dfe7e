"""
How do the number of sectors and the f-number of a foveal camera affect a picture?

New here: ``foveasim.explore``: a sweep in a YAML file (``sweeps/foveal.yaml``), run on
worker processes, with a labelled store.

Expect: photon shot noise dominates, so that the mean SNR of each layout is proportional
to 1 / sqrt(1 + 4 N²) with the working f-number N, within 1 % from f/2 to f/8. Four
times the sectors increase the PSNR by 8 dB, and by nearly 10 dB at f/8, where the image
contains less unresolved detail.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from foveasim.explore import read_sweep, run_sweep
from foveasim.view import save_figure

SWEEP = Path(__file__).parent / "sweeps" / "foveal.yaml"
#: Magnification at a focal length of 8 mm and a distance of 1 m.
MAGNIFICATION = 8.0 / (1000.0 - 8.0)


def main(out_dir: Path) -> None:
    """Write the results and their figure to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Twenty-five cameras; the same call resumes an interrupted sweep.
    plan = read_sweep(SWEEP)
    results = run_sweep(plan, out=out_dir / "21_foveal_sweep.zarr", workers=2)
    f_number = results["optics.f_number"].to_numpy()
    sectors = results["layout.parameters.n_sectors"].to_numpy()
    snr, psnr_db, n_sites = (
        results[name].to_numpy() for name in ("snr_mean", "psnr_db", "n_sites")
    )
    print(
        results[["snr_mean", "psnr_db"]].to_dataframe().unstack().round(1).to_string()
    )

    # %% Effect of each parameter.
    relative_snr = 1.0 / np.sqrt(1.0 + 4.0 * (f_number * (1.0 + MAGNIFICATION)) ** 2)
    expected = relative_snr * np.mean(snr / relative_snr, axis=1, keepdims=True)
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.loglog(
        f_number,
        expected[0],
        color="black",
        linewidth=1,
        label=r"$\propto 1 / \sqrt{1 + 4 N^2}$",
    )
    left.loglog(f_number, expected[1:].T, color="black", linewidth=1)
    for row, count in zip(snr, sectors, strict=True):
        left.loglog(f_number, row, "o", label=f"{count} sectors")
    left.set(xlabel="f-number", ylabel="mean SNR")
    left.set_yticks([20, 30, 50, 100, 200], ["20", "30", "50", "100", "200"])
    left.set_yticks([], minor=True)
    left.set_xticks(f_number, [f"{n:.3g}" for n in f_number], minor=False)
    left.set_xticks([], minor=True)
    for column, n in zip(psnr_db.T, f_number, strict=True):
        right.semilogx(n_sites[:, 0], column, "o-", label=f"f/{n:.3g}")
    right.set(xlabel="photosites", ylabel="PSNR relative to the optical image / dB")
    right.set_xticks(n_sites[:, 0], [f"{n:,}" for n in n_sites[:, 0]], minor=False)
    right.set_xticks([], minor=True)
    for ax in (left, right):
        ax.grid(color="0.9")
        ax.legend(frameon=False, loc="lower left" if ax is left else "upper left")
    save_figure(figure, out_dir / "21_sweep.png", dpi=140)

    # %% Checks.
    assert not any(results["error"].to_numpy().ravel())
    assert float(results["saturated_fraction"].max()) < 0.01
    worst = float(np.abs(snr / expected - 1.0).max())
    gain_db = psnr_db[-1] - psnr_db[0]
    print(
        f"SNR within {100 * worst:.1f} % of the shot noise limit; PSNR gain of "
        f"{sectors[-1]} sectors {gain_db.round(1)} dB"
    )
    assert worst < 0.01
    assert 8.0 < gain_db[0] < gain_db[-1] < 10.5


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

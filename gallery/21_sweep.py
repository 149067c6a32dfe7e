"""
How fine a fovea, and how wide a lens: what does a photograph gain from each?

New here: ``foveasim.explore``: a sweep in a YAML file (``sweeps/foveal.yaml``), run on worker processes into a labelled store.

Expect: noise is that of light, so the mean signal to noise of any of the layouts goes as one over the root of 1 + 4 N², N the
f-number behind the lens, within 1 % from f/2 to f/8. Four times the sectors bring the picture 8 dB nearer to the light, and
nearly 10 dB at f/8, where the lens leaves less detail to be missed.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from foveasim.explore import read_sweep, run_sweep
from foveasim.view import save_figure

SWEEP = Path(__file__).parent / "sweeps" / "foveal.yaml"
#: Image size over scene size: 8 mm of focal length, 1 m away.
MAGNIFICATION = 8.0 / (1000.0 - 8.0)


def main(out_dir: Path) -> None:
    """Write the results and their picture to a folder."""
    # %% Twenty-five cameras; the same command again would go on where this one was ended.
    plan = read_sweep(SWEEP)
    results = run_sweep(plan, out=out_dir / "21_foveal_sweep.zarr", workers=2)
    f_number = results["optics.f_number"].to_numpy()
    sectors = results["layout.parameters.n_sectors"].to_numpy()
    snr, psnr_db, n_sites = (results[name].to_numpy() for name in ("snr_mean", "psnr_db", "n_sites"))
    print(results[["snr_mean", "psnr_db"]].to_dataframe().unstack().round(1).to_string())

    # %% What each brings.
    law = 1.0 / np.sqrt(1.0 + 4.0 * (f_number * (1.0 + MAGNIFICATION)) ** 2)
    expected = law * np.mean(snr / law, axis=1, keepdims=True)
    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.loglog(f_number, expected[0], color="black", linewidth=1, label=r"as $1 / \sqrt{1 + 4 N^2}$")
    left.loglog(f_number, expected[1:].T, color="black", linewidth=1)
    for row, count in zip(snr, sectors, strict=True):
        left.loglog(f_number, row, "o", label=f"{count} sectors")
    left.set(xlabel="f-number", ylabel="mean signal to noise")
    left.set_yticks([20, 30, 50, 100, 200], ["20", "30", "50", "100", "200"])
    left.set_yticks([], minor=True)
    left.set_xticks(f_number, [f"{n:.3g}" for n in f_number], minor=False)
    left.set_xticks([], minor=True)
    for column, n in zip(psnr_db.T, f_number, strict=True):
        right.semilogx(n_sites[:, 0], column, "o-", label=f"f/{n:.3g}")
    right.set(xlabel="photosites", ylabel="PSNR against the light behind the lens / dB")
    right.set_xticks(n_sites[:, 0], [f"{n:,}" for n in n_sites[:, 0]], minor=False)
    right.set_xticks([], minor=True)
    for ax in (left, right):
        ax.grid(color="0.9")
        ax.legend(frameon=False)
    save_figure(figure, out_dir / "21_sweep.png", dpi=110)

    # %% The numbers.
    assert not any(results["error"].to_numpy().ravel())
    assert float(results["saturated_fraction"].max()) < 0.01
    worst = float(np.abs(snr / expected - 1.0).max())
    gain_db = psnr_db[-1] - psnr_db[0]
    print(
        f"signal to noise is within {100 * worst:.1f} % of shot noise; {sectors[-1]} sectors gain {gain_db.round(1)} dB"
    )
    assert worst < 0.01
    assert 8.0 < gain_db[0] < gain_db[-1] < 10.5


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

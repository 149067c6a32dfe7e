"""
How do I add effects of my own to a sensor, here 1/f noise of the readout and lens
shading?

New here: ``sensor.effects.AdditiveNoise``, ``sensor.effects.FixedFactor``,
``Sensor(effects=)``, ``plot_noise_budget``.

Expect: both effects in captures, in the prediction and in the noise budget without
further code; temporal noise that agrees with the prediction within 1 %; a shading loss
of 30 % in the corners.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.sensor.effects import AdditiveNoise, FixedFactor, Sites
from foveasim.view import plot_noise_budget, save_figure

N_SIDE = 96
N_FRAMES = 400
EXPOSURE_S = 0.01


@dataclass(frozen=True)
class FlickerNoise(AdditiveNoise):
    """1/f noise of one amplifier that reads all sites sequentially."""

    name = "flicker"
    stage = "output"
    reach = "group"

    sigma_v: float

    def deviation(self, sites: Sites) -> float:
        """Return the standard deviation in V, which gives the moments of the noise."""
        return self.sigma_v

    def apply(
        self, values: np.ndarray, *, sites: Sites, rng: np.random.Generator
    ) -> np.ndarray:
        """
        Return voltages with a noise sequence in readout order, the same for all blocks
        of sites.
        """
        n_sites = sites.layout.n_sites
        frequency = np.fft.rfftfreq(n_sites)
        amplitude = np.divide(
            1.0, np.sqrt(frequency), out=np.zeros(frequency.size), where=frequency > 0.0
        )
        amplitude *= n_sites / np.sqrt(2.0 * np.sum(amplitude**2))
        white = (
            rng.standard_normal(frequency.size)
            + 1j * rng.standard_normal(frequency.size)
        ) / np.sqrt(2.0)
        return values + self.sigma_v * sites.select(
            np.fft.irfft(amplitude * white, n_sites)
        )


@dataclass(frozen=True)
class LensShading(FixedFactor):
    """
    Shading loss of a lens, proportional to the square of the distance from
    the axis.
    """

    name = "lens_shading"
    stage = "photo"

    corner_loss: float

    def pattern(self, sites: Sites) -> np.ndarray:
        """Return the relative response of every site."""
        radius_um = np.hypot(*sites.layout.centroid_um.T)
        return 1.0 - self.corner_loss * (radius_um / radius_um.max()) ** 2


def main(out_dir: Path) -> None:
    """Write pictures and the noise budget to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% A sensor with both effects.
    layout = fs.layout.grid(n_x=N_SIDE, n_y=N_SIDE, pitch_um=3.0)
    user_effects = [FlickerNoise(sigma_v=6e-3), LensShading(corner_loss=0.3)]
    sensor = fs.Sensor(
        layout,
        effects=user_effects,
        read_noise_e=5.0,
        capacitance_f=1e-15,
        v_sat_v=1.0,
        bits=12,
        pedestal_v=0.1,
    )
    camera = fs.Camera(
        optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor
    )
    rate_e_per_s = np.full(layout.n_sites, 2e5)
    power_map = fs.PowerMap.from_array(
        np.full((N_SIDE, N_SIDE), 2e5 * fs.units.photon_energy_j(550.0) / (3e-6) ** 2),
        pitch_um=3.0,
        wavelength_nm=550.0,
    )

    # %% Frames of uniform irradiance, and their prediction.
    frames = np.stack(
        [
            camera.capture(power_map, exposure_s=EXPOSURE_S, seed=1, frame=k).code
            for k in range(N_FRAMES)
        ]
    )
    mean_dn, variance_dn2 = camera.predict(power_map, exposure_s=EXPOSURE_S)
    figure = Figure(figsize=(8.0, 3.1), layout="constrained")
    pictures = {
        "one frame": frames[0],
        "mean of the frames": frames.mean(axis=0),
        "predicted mean": mean_dn,
    }
    for axes, (title, values) in zip(
        figure.subplots(1, 3), pictures.items(), strict=True
    ):
        axes.imshow(
            values.reshape(N_SIDE, N_SIDE),
            origin="lower",
            cmap="gray",
            vmin=mean_dn.min(),
            vmax=mean_dn.max(),
        )
        axes.set_title(title)
        axes.set_axis_off()
    save_figure(figure, out_dir / "25_own_effects.png", dpi=140)

    # %% Noise budget, with a dot for each effect.
    budget = fs.sensor.noise_budget(sensor, rate_e_per_s, EXPOSURE_S)
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    plot_noise_budget(budget, ax=figure.add_subplot())
    save_figure(figure, out_dir / "25_noise_budget.png", dpi=140)

    # %% Checks.
    ratio = np.sqrt(frames.var(axis=0, ddof=1).mean() / variance_dn2.mean())
    corner_loss = 1.0 - sensor.response[0]
    print(
        f"temporal noise / prediction: {ratio:.4f}; shading loss in the corners: "
        f"{100 * corner_loss:.0f} %"
    )
    assert abs(ratio - 1.0) < 0.01
    assert abs(corner_loss - 0.3) < 1e-9
    assert budget["flicker"].min() > 0.0
    # The shading is the same in all devices, and reduces photon shot noise in the
    # corners.
    assert budget["lens_shading"].max() == 0.0
    assert (
        abs(budget["photon_shot"].min() ** 2 / (rate_e_per_s[0] * EXPOSURE_S) - 0.7)
        < 1e-9
    )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out"))

"""
What do the noises of the electronic chain look like, one after the other?

New here: ``PowerMap.from_array``, ``Sensor(read_noise_e=, line_fpn_fraction=, dnl_dn=)``, ``Camera.predict``.

Expect: the paper's read noises of 0, 50 and 200 e- on at most 6000 photons: spreads of the brightest sites of 77, 92 and
214 e-, drawn and predicted; stripes of 2 % of the range that stay from frame to frame; codes of 4 bits of which the converter's
own steps move 28 %, in every column in another way.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import skimage.data
from matplotlib.figure import Figure
from skimage.transform import resize

import foveasim as fs
from foveasim.view import save_figure

WAVELENGTH_NM = 550.0
EXPOSURE_S = 0.01
MOST_PHOTONS = 6000.0
FULL_WELL_E = 7000.0
N_SIDE = 256
PITCH_UM = 2.0
V_SAT_V = 3.0
N_FRAMES = 24


def light() -> fs.PowerMap:
    """A photograph as light: its brightest cell sends so many photons to a site in an exposure."""
    picture = resize(skimage.data.camera(), (N_SIDE, N_SIDE), anti_aliasing=True) ** 2.2
    joules = MOST_PHOTONS * fs.units.photon_energy_j(WAVELENGTH_NM) * picture / picture.max()
    irradiance_w_m2 = joules / EXPOSURE_S / (PITCH_UM * 1e-6) ** 2
    return fs.PowerMap.from_array(irradiance_w_m2, pitch_um=PITCH_UM, wavelength_nm=WAVELENGTH_NM, top_row_first=True)


def camera(**parameters: object) -> fs.Camera:
    """A camera of square sites whose highest code is the full well."""
    layout = fs.layout.grid(n_x=N_SIDE, n_y=N_SIDE, pitch_um=PITCH_UM)
    capacitance_f = FULL_WELL_E * fs.units.ELEMENTARY_CHARGE_C / V_SAT_V
    values = {"bits": 10, "capacitance_f": capacitance_f, "full_well_e": FULL_WELL_E, "v_sat_v": V_SAT_V, **parameters}
    return fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=fs.Sensor(layout, **values))


def codes(one: fs.Camera, scene: fs.PowerMap, frame: int = 0) -> np.ndarray:
    """Codes as a picture, the lowest row first."""
    return one.capture(scene, exposure_s=EXPOSURE_S, seed=1, frame=frame).code.reshape(N_SIDE, N_SIDE)


def main(out_dir: Path) -> None:
    """Write the noises' pictures to a folder."""
    scene = light()
    # %% Read noise: the paper's three.
    noises_e = (0.0, 50.0, 200.0)
    cameras = [camera(read_noise_e=noise_e) for noise_e in noises_e]
    figure = Figure(figsize=(15, 5.7), layout="constrained")
    for axes, one, noise_e in zip(figure.subplots(1, 3), cameras, noises_e, strict=True):
        axes.imshow(codes(one, scene), origin="lower", cmap="gray", vmin=0, vmax=1023 * MOST_PHOTONS / FULL_WELL_E)
        axes.set_title(f"read noise {noise_e:g} e-")
        axes.set_axis_off()
    save_figure(figure, out_dir / "09_read_noise.png", dpi=70)

    # %% Fixed patterns: of lines, and of pixels.
    striped, grainy = camera(line_fpn_fraction=0.02), camera(pixel_fpn_fraction=0.02)
    figure = Figure(figsize=(10, 5.7), layout="constrained")
    for axes, (name, one) in zip(
        figure.subplots(1, 2), {"lines, 2 %": striped, "pixels, 2 %": grainy}.items(), strict=True
    ):
        axes.imshow(codes(one, scene), origin="lower", cmap="gray")
        axes.set_title(name)
        axes.set_axis_off()
    save_figure(figure, out_dir / "09_fixed_patterns.png", dpi=70)

    # %% A converter of 4 bits whose steps are wrong, by half a step rms, in every column in another way.
    even, uneven = camera(bits=4, shot_noise="off"), camera(bits=4, shot_noise="off", dnl_dn=0.5)
    pictures = [codes(one, scene).astype(int) for one in (even, uneven)]
    column = N_SIDE // 2
    expected_e = even.photoelectrons_per_s(scene).reshape(N_SIDE, N_SIDE) * EXPOSURE_S
    figure = Figure(figsize=(16, 5.7), layout="constrained")
    axes = figure.subplots(1, 3, width_ratios=[1, 1, 1.3])
    for place, picture, name in zip(axes, pictures, ("4 bits", "4 bits, DNL of 0.5"), strict=False):
        place.imshow(picture, origin="lower", cmap="gray", vmin=0, vmax=15)
        place.axvline(column, color="tab:red", linewidth=0.8)
        place.set_title(name)
        place.set_axis_off()
    axes[2].plot(expected_e[:, column] / FULL_WELL_E * 16, color="tab:red", linewidth=1, label="before the converter")
    axes[2].step(np.arange(N_SIDE), pictures[0][:, column], color="tab:green", where="mid", label="4 bits")
    axes[2].step(np.arange(N_SIDE), pictures[1][:, column], color="tab:blue", where="mid", label="with DNL")
    axes[2].set_xlabel("row")
    axes[2].set_ylabel("code / DN")
    axes[2].legend()
    save_figure(figure, out_dir / "09_converter.png", dpi=70)

    # %% The numbers.
    e_per_dn = FULL_WELL_E / 1024
    for one, noise_e, spread_e in zip(cameras, noises_e, (77.0, 92.0, 214.0), strict=True):
        mean_dn, variance_dn2 = one.predict(scene, exposure_s=EXPOSURE_S)
        frames = np.stack([codes(one, scene, frame).ravel() for frame in range(N_FRAMES)])
        brightest = mean_dn > 0.97 * mean_dn.max()
        drawn_e = float(np.sqrt(frames[:, brightest].var(axis=0, ddof=1).mean())) * e_per_dn
        told_e = float(np.sqrt(variance_dn2[brightest].mean())) * e_per_dn
        apart = np.abs(frames.mean(axis=0) - mean_dn) / np.sqrt(variance_dn2 / N_FRAMES + 1e-3)
        print(f"read noise {noise_e:3g} e-: the brightest sites spread by {drawn_e:.0f} e-, {told_e:.0f} predicted")
        assert abs(told_e - spread_e) < 2.0
        assert abs(drawn_e - told_e) < 0.03 * told_e
        assert apart.max() < 6.0
    plain, frames = codes(camera(), scene).astype(float), [codes(striped, scene, k) for k in (0, 1)]
    stripes = np.where((plain > 100) & (plain < 900), frames[0] - plain, np.nan)
    line_dn = np.nanmean(stripes, axis=0)
    assert abs(line_dn.std() / 1024 - 0.02) < 0.003
    assert np.nanmax(np.abs(stripes - line_dn)) <= 1.0
    assert np.corrcoef(np.nanmean(np.where(np.isnan(stripes), np.nan, frames[1] - plain), axis=0), line_dn)[0, 1] > 0.95
    moved = pictures[1] - pictures[0]
    print(f"wrong steps move {np.mean(moved != 0):.0%} of the codes, by up to {np.abs(moved).max()}")
    assert 0.22 < np.mean(moved != 0) < 0.34
    assert np.abs(moved.mean()) < 0.2


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

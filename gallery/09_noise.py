"""
How does each noise source of the electronic chain appear in a picture?

New here: ``PowerMap.from_array``, ``Sensor(read_noise_e=, line_fpn_fraction=,
dnl_dn=)``, ``Camera.predict``; ``Sensor.chain``, drawn with the noise budget (Fig. 8 of
the paper).

Expect: temporal noise of 77, 92 and 214 e- rms in the brightest sites, simulated and
predicted, for the read noises of the paper, 0, 50 and 200 e-, and at most 6000 photons;
column FPN of 2 % of the range, the same in all frames; a 4-bit ADC whose DNL, different
for each column, changes 28 % of the codes.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import skimage.data
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle
from skimage.transform import resize

import foveasim as fs
from foveasim.view import save_figure

WAVELENGTH_NM = 550.0
EXPOSURE_S = 0.01
MAX_PHOTONS = 6000.0
FULL_WELL_E = 7000.0
N_SIDE = 256
PITCH_UM = 2.0
V_SAT_V = 3.0
N_FRAMES = 24
#: Coat and hand of the photographer: rows from the bottom, and columns.
DARK = (slice(110, 174), slice(60, 124))
#: Stages of the chain, with the quantity that passes each.
STAGES = {
    "photo": "photocurrent",
    "dark": "dark current",
    "collection": "charge, drawn\nat collection",
    "charge": "charge at readout",
    "sense_node": "voltage",
    "output": "output voltage",
    "ADC": "code",
}


def photograph() -> fs.PowerMap:
    """
    Return a photograph as a power map with at most ``MAX_PHOTONS`` per site and
    exposure.
    """
    picture = resize(skimage.data.camera(), (N_SIDE, N_SIDE), anti_aliasing=True) ** 2.2
    joules = (
        MAX_PHOTONS * fs.units.photon_energy_j(WAVELENGTH_NM) * picture / picture.max()
    )
    irradiance_w_m2 = joules / EXPOSURE_S / (PITCH_UM * 1e-6) ** 2
    return fs.PowerMap.from_array(
        irradiance_w_m2,
        pitch_um=PITCH_UM,
        wavelength_nm=WAVELENGTH_NM,
        top_row_first=True,
    )


def camera(**parameters: object) -> fs.Camera:
    """
    Return a camera of square sites with the highest code at the full well
    capacity.
    """
    layout = fs.layout.grid(n_x=N_SIDE, n_y=N_SIDE, pitch_um=PITCH_UM)
    capacitance_f = FULL_WELL_E * fs.units.ELEMENTARY_CHARGE_C / V_SAT_V
    values = {
        "bits": 10,
        "capacitance_f": capacitance_f,
        "full_well_e": FULL_WELL_E,
        "v_sat_v": V_SAT_V,
        **parameters,
    }
    return fs.Camera(
        optics=fs.Optics(focal_length_mm=8.0, f_number=2.8),
        sensor=fs.Sensor(layout, **values),
    )


def codes(tested: fs.Camera, scene: fs.PowerMap, frame: int = 0) -> np.ndarray:
    """Return the codes of a capture as a picture, bottom row first."""
    return tested.capture(
        scene, exposure_s=EXPOSURE_S, seed=1, frame=frame
    ).code.reshape(N_SIDE, N_SIDE)


def draw_chain(axes: Axes, sensor: fs.Sensor, photo_e_per_s: float) -> None:
    """
    Draw the stages of a sensor from top to bottom, with the noise of every source at a
    photocurrent.
    """
    rms_e = fs.sensor.noise_budget(
        sensor, np.full(sensor.layout.n_sites, photo_e_per_s), EXPOSURE_S
    )
    sources = {
        effect.name: (effect.stage, effect.is_temporal)
        for effect in sensor.chain
        if effect.name != "shot"
    }
    sources |= dict.fromkeys(("photon_shot", "dark_shot"), ("collection", True)) | {
        "quantisation": ("ADC", True)
    }
    names = sorted(sources, key=lambda name: list(STAGES).index(sources[name][0]))
    noise_e = [float(np.sqrt(np.mean(rms_e[name] ** 2))) for name in names]
    colours = ["tab:blue" if sources[name][1] else "tab:orange" for name in names]
    axes.barh(range(len(names)), noise_e, color=colours, height=0.6)
    for row, value in enumerate(noise_e):
        axes.text(1.1 * value, row, f"{value:.2g}", va="center")
    axes.set(
        xscale="log",
        xlim=(0.1, 3.0 * max(noise_e)),
        xlabel="noise / e- rms",
        yticks=range(len(names)),
        yticklabels=names,
    )
    axes.invert_yaxis()
    axes.spines[["top", "right"]].set_visible(False)
    # Stages on the left: boxes over the rows of their sources, and arrows from each to
    # the next.
    stage_of_row = [sources[name][0] for name in names]
    place = axes.get_yaxis_transform()
    for stage, text in STAGES.items():
        rows = [row for row, of in enumerate(stage_of_row) if of == stage]
        low, high = rows[0] - 0.38, rows[-1] + 0.38
        box = FancyBboxPatch(
            (-0.78, low),
            0.46,
            high - low,
            boxstyle="round,pad=0.0,rounding_size=0.02",
            transform=place,
        )
        box.set(
            facecolor="0.93", edgecolor="#3b6ab0", clip_on=False, mutation_aspect=12.0
        )
        axes.add_patch(box)
        axes.text(
            -0.55, 0.5 * (low + high), text, transform=place, ha="center", va="center"
        )
        if rows[-1] + 1 < len(names):
            arrow = {
                "arrowstyle": "-|>",
                "color": "0.3",
                "shrinkA": 0.0,
                "shrinkB": 0.0,
            }
            axes.annotate(
                "",
                (-0.55, high + 0.24),
                (-0.55, high),
                xycoords=place,
                textcoords=place,
                arrowprops=arrow,
            )
    for colour, text in (
        ("tab:blue", "drawn in every frame"),
        ("tab:orange", "fixed pattern of the device"),
    ):
        axes.barh(0, np.nan, color=colour, label=text)
    axes.legend(loc="lower center", bbox_to_anchor=(0.1, 1.0), ncols=2, frameon=False)


def main(out_dir: Path) -> None:
    """Write the chain and pictures with each noise source to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% The chain of a sensor with all sources, at half of the full well capacity.
    complete = camera(
        prnu_fraction=0.01,
        dark_e_per_s=500.0,
        dsnu_fraction=0.05,
        hot_fraction=0.01,
        hot_e_per_s=1e4,
        ktc_noise=True,
        read_noise_e=20.0,
        rts_fraction=0.1,
        rts_e=30.0,
        gain_fpn_fraction=0.01,
        pixel_fpn_fraction=0.005,
        line_fpn_fraction=0.005,
    ).sensor
    figure = Figure(figsize=(8.0, 6.0))
    draw_chain(
        figure.add_axes((0.45, 0.1, 0.52, 0.81)),
        complete,
        0.5 * FULL_WELL_E / EXPOSURE_S,
    )
    save_figure(figure, out_dir / "09_chain.png", dpi=140)

    scene = photograph()
    # %% The three read noises of the paper.
    noises_e = (0.0, 50.0, 200.0)
    cameras = [camera(read_noise_e=noise_e) for noise_e in noises_e]
    white = 1023 * MAX_PHOTONS / FULL_WELL_E
    figure = Figure(figsize=(8.0, 5.7), layout="constrained")
    for (whole, part), tested, noise_e in zip(
        figure.subplots(2, 3).T, cameras, noises_e, strict=True
    ):
        code = codes(tested, scene)
        whole.imshow(code, origin="lower", cmap="gray", vmin=0, vmax=white)
        whole.add_patch(
            Rectangle(
                (DARK[1].start, DARK[0].start), 64, 64, fill=False, color="tab:red"
            )
        )
        whole.set_title(f"read noise {noise_e:g} e-")
        part.imshow(code[DARK], origin="lower", cmap="gray", vmin=0, vmax=0.15 * white)
        part.set_title("dark part, brighter", fontsize=10)
        for axes in (whole, part):
            axes.set_axis_off()
    save_figure(figure, out_dir / "09_read_noise.png", dpi=140)

    # %% Fixed-pattern noise of columns and of pixels.
    with_column_fpn, with_pixel_fpn = (
        camera(line_fpn_fraction=0.02),
        camera(pixel_fpn_fraction=0.02),
    )
    figure = Figure(figsize=(8.0, 4.4), layout="constrained")
    for axes, (name, tested) in zip(
        figure.subplots(1, 2),
        {"column FPN, 2 %": with_column_fpn, "pixel FPN, 2 %": with_pixel_fpn}.items(),
        strict=True,
    ):
        axes.imshow(codes(tested, scene), origin="lower", cmap="gray")
        axes.set_title(name)
        axes.set_axis_off()
    save_figure(figure, out_dir / "09_fixed_patterns.png", dpi=140)

    # %% A 4-bit ADC with a DNL of 0.5 DN rms, different for each column.
    ideal_adc, adc_with_dnl = (
        camera(bits=4, shot_noise="off"),
        camera(bits=4, shot_noise="off", dnl_dn=0.5),
    )
    pictures = [
        codes(tested, scene).astype(int) for tested in (ideal_adc, adc_with_dnl)
    ]
    column = N_SIDE // 2
    expected_e = (
        ideal_adc.photoelectrons_per_s(scene).reshape(N_SIDE, N_SIDE) * EXPOSURE_S
    )
    figure = Figure(figsize=(8.0, 7.2), layout="constrained")
    axes = list(figure.subplot_mosaic("AB;CC", height_ratios=(1.0, 0.8)).values())
    for panel, picture, name in zip(
        axes, pictures, ("4 bits", "4 bits, DNL of 0.5 DN"), strict=False
    ):
        panel.imshow(picture, origin="lower", cmap="gray", vmin=0, vmax=15)
        panel.axvline(column, color="tab:red", linewidth=0.8)
        panel.set_title(name)
        panel.set_axis_off()
    axes[2].plot(
        expected_e[:, column] / FULL_WELL_E * 16,
        color="tab:red",
        linewidth=1,
        label="ADC input",
    )
    axes[2].step(
        np.arange(N_SIDE),
        pictures[0][:, column],
        color="tab:green",
        where="mid",
        label="4 bits",
    )
    axes[2].step(
        np.arange(N_SIDE),
        pictures[1][:, column],
        color="tab:blue",
        where="mid",
        label="with DNL",
    )
    axes[2].set_xlabel("row")
    axes[2].set_ylabel("code / DN")
    axes[2].set_ylim(0, 18)
    axes[2].legend(ncols=3, loc="upper center", frameon=False)
    save_figure(figure, out_dir / "09_converter.png", dpi=140)

    # %% Checks.
    e_per_dn = FULL_WELL_E / 1024
    for tested, noise_e, noise_rms_e in zip(
        cameras, noises_e, (77.0, 92.0, 214.0), strict=True
    ):
        mean_dn, variance_dn2 = tested.predict(scene, exposure_s=EXPOSURE_S)
        frames = np.stack(
            [codes(tested, scene, frame).ravel() for frame in range(N_FRAMES)]
        )
        brightest = mean_dn > 0.97 * mean_dn.max()
        simulated_e = (
            float(np.sqrt(frames[:, brightest].var(axis=0, ddof=1).mean())) * e_per_dn
        )
        predicted_e = float(np.sqrt(variance_dn2[brightest].mean())) * e_per_dn
        deviation_sigma = np.abs(frames.mean(axis=0) - mean_dn) / np.sqrt(
            variance_dn2 / N_FRAMES + 1e-3
        )
        print(
            f"read noise {noise_e:3g} e-: {simulated_e:.0f} e- rms in the "
            f"brightest sites, {predicted_e:.0f} e- predicted"
        )
        assert abs(predicted_e - noise_rms_e) < 2.0
        # Five standard errors of the brightest sites; all sites give the noise within 1
        # %.
        n_samples = (N_FRAMES - 1) * np.count_nonzero(brightest)
        assert abs(simulated_e - predicted_e) < 5.0 * predicted_e / np.sqrt(
            2.0 * n_samples
        )
        assert abs(frames.var(axis=0, ddof=1).mean() / variance_dn2.mean() - 1.0) < 0.01
        assert deviation_sigma.max() < 6.0
    plain, frames = (
        codes(camera(), scene).astype(float),
        [codes(with_column_fpn, scene, k) for k in (0, 1)],
    )
    fpn_dn = np.where((plain > 100) & (plain < 900), frames[0] - plain, np.nan)
    line_dn = np.nanmean(fpn_dn, axis=0)
    assert abs(line_dn.std() / 1024 - 0.02) < 0.003
    assert np.nanmax(np.abs(fpn_dn - line_dn)) <= 1.0
    assert (
        np.corrcoef(
            np.nanmean(np.where(np.isnan(fpn_dn), np.nan, frames[1] - plain), axis=0),
            line_dn,
        )[0, 1]
        > 0.95
    )
    change_dn = pictures[1] - pictures[0]
    print(
        f"DNL changes {np.mean(change_dn != 0):.0%} of the codes, by up to "
        f"{np.abs(change_dn).max()} DN"
    )
    assert 0.22 < np.mean(change_dn != 0) < 0.34
    assert np.abs(change_dn.mean()) < 0.2


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

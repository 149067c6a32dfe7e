"""
What do a rolling shutter, event pixels and spiking pixels make of a fan that turns?

New here: ``Camera.video`` and ``Camera.rates``, ``foveasim.video.FrameSource``, ``foveasim.modes``: ``EventPixels`` and
``SpikingPixels``.

Expect: blades bent by a shutter whose lines begin 0.25 ms after each other, and a bar of 1.92 µm/ms that leans by 0.48 µm a
line; events of brightening before every blade and of darkening behind it, on photosites of 0.7 to 6 µm, which tell the fan's
5 turns a second to 1 %.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.layout import readout_by
from foveasim.modes import EventPixels, SpikingPixels
from foveasim.video import FrameSource
from foveasim.view import save_figure

#: The scene: pictures of 1 ms, which the lens makes 2.5 times smaller than their pixels of 2.4 µm.
N_SIDE, SCENE_PITCH_UM, DISTANCE_M, FOCAL_LENGTH_MM = 240, 2.4, 0.07, 20.0
FRAME_S, N_FRAMES = 1e-3, 60
TURNS_PER_S, N_BLADES, DARK = 5.0, 3, 0.1
BAR_PX_PER_FRAME, BAR_PX = 2.0, 16
#: The sensors.
N_LINES, PITCH_UM, LINE_S, EXPOSURE_S = 96, 2.0, 0.25e-3, 0.5e-3
CONTRAST, REFRACTORY_S, CAPACITANCE_F = 0.25, 2e-4, 2e-15
SPIKE_E = 20_000.0


def fan() -> Iterator[np.ndarray]:
    """Pictures of bright blades, smooth over a pixel, that turn counter-clockwise."""
    x, y = np.meshgrid(*[np.arange(N_SIDE) - 0.5 * (N_SIDE - 1)] * 2)
    radius, angle = np.hypot(x, y), np.arctan2(-y, x)  # the first row is on top
    for k in range(N_FRAMES):
        turned = N_BLADES * (angle - 2.0 * np.pi * TURNS_PER_S * FRAME_S * k)
        to_edge = radius * np.arcsin(np.sin(turned)) / N_BLADES
        disc = np.clip(0.48 * N_SIDE - radius, 0.0, 1.0) * np.clip(radius - 6.0, 0.0, 1.0)
        yield DARK + (1.0 - DARK) * np.clip(to_edge + 0.5, 0.0, 1.0) * disc


def bar() -> Iterator[np.ndarray]:
    """Pictures of an upright bar that goes to the right."""
    for k in range(N_FRAMES):
        picture = np.full((N_SIDE, N_SIDE), DARK)
        left = 40 + round(BAR_PX_PER_FRAME * k)
        picture[:, left : left + BAR_PX] = 1.0
        yield picture


def footage(pictures: Iterator[np.ndarray]) -> FrameSource:
    """The pictures as light."""
    return FrameSource(
        pictures,
        pitch_um=SCENE_PITCH_UM,
        distance_m=DISTANCE_M,
        peak_radiance_w_m2_sr_nm=0.4,
        band_width_nm=100.0,
        encoding="linear",
    )


def sites(axes: Axes, layout: fs.Layout, values: np.ndarray, colours: str, limit: float, title: str) -> None:
    """Draw every site in the colour of its value, from 0 or from the negative limit on."""
    low = -limit if values.min() < 0 else 0.0
    rings = np.split(layout.xy_um, layout.ring_offsets[1:-1])
    shapes = PolyCollection(rings, array=values, cmap=colours, edgecolors="face", linewidths=0.2)
    shapes.set_clim(low, limit)
    axes.add_collection(shapes)
    axes.autoscale_view()
    axes.set(aspect="equal", title=title, xlabel="x (µm)", ylabel="y (µm)")


def main(out_dir: Path) -> None:
    """Write the pictures to a folder."""
    optics = fs.Optics(focal_length_mm=FOCAL_LENGTH_MM, f_number=2.8)

    # %% A sensor whose lines are read from the lowest up, and one exposure of it, through either shutter.
    grid = readout_by(fs.layout.grid(n_x=N_LINES, n_y=N_LINES, pitch_um=PITCH_UM), "column")
    camera = fs.Camera(optics=optics, sensor=fs.Sensor(grid, bits=12, capacitance_f=5e-15, read_noise_e=3.0))
    times = {"exposure_s": EXPOSURE_S, "seed": 1, "frame_s": FRAME_S, "every": N_FRAMES}
    still = next(camera.video(footage(fan()), **times))
    bent = next(camera.video(footage(fan()), **times, line_s=LINE_S, between="linear"))
    leaning = next(camera.video(footage(bar()), **times, line_s=LINE_S))

    # %% How far the bar leans from line to line.
    light = np.maximum(leaning.expected_e.reshape(N_LINES, N_LINES) - 1.5 * np.median(leaning.expected_e), 0.0)
    middle_um = light @ grid.centroid_um[:N_LINES, 0] / light.sum(axis=1)
    lean_um = np.polyfit(np.arange(N_LINES), middle_um, 1)[0]
    cell_um = optics.magnification(DISTANCE_M) * SCENE_PITCH_UM
    expected_um = BAR_PX_PER_FRAME * cell_um / FRAME_S * LINE_S
    print(f"the bar leans by {lean_um:.4f} µm a line, its speed times the time of a line is {expected_um:.4f} µm")

    # %% The same fan on photosites that speak for themselves, on rings.
    rings = fs.layout.log_polar(n_sectors=96, n_rings=36, r_min_um=10.0, r_max_um=100.0)
    foveal = fs.Camera(optics=optics, sensor=fs.Sensor(rings, dark_e_per_s=100.0))
    rates = list(foveal.rates(footage(fan())))
    pixels = EventPixels(
        foveal.sensor,
        contrast_on=CONTRAST,
        contrast_off=CONTRAST,
        mismatch_fraction=0.03,
        refractory_s=REFRACTORY_S,
        capacitance_f=CAPACITANCE_F,
        noise_per_s=0.5,
    )
    events = pixels.events(rates, frame_s=FRAME_S, seed=2)
    spikes = SpikingPixels(foveal.sensor, threshold_e=SPIKE_E).events(rates, frame_s=FRAME_S, seed=3)

    # %% The speed: that at which the events of brightening keep their angle to a blade best.
    angle = np.arctan2(rings.centroid_um[:, 1], rings.centroid_um[:, 0])
    ups = events.polarity > 0
    up_s, up_angle = events.t_s[ups], angle[events.site[ups]]
    guesses = np.linspace(3.0, 7.0, 4001)
    kept = [abs(np.exp(1j * N_BLADES * (up_angle - 2.0 * np.pi * guess * up_s)).sum()) for guess in guesses]
    turns_per_s = guesses[int(np.argmax(kept))]
    print(f"{len(events):,} events tell {turns_per_s:.3f} turns a second; {len(spikes):,} spikes")

    # %% The picture.
    figure = Figure(figsize=(15, 9.4), layout="constrained")
    axes = figure.subplots(2, 3)
    top = float(np.quantile(still.code, 0.999))
    sites(axes[0, 0], grid, still.code, "gray", top, "global shutter")
    sites(axes[0, 1], grid, bent.code, "gray", top, f"rolling shutter, {1e3 * LINE_S:g} ms a line, from below")
    sites(axes[0, 2], grid, leaning.code, "gray", top, f"a bar that leans by {lean_um:.3f} µm a line")
    last = events.between(FRAME_S * (N_FRAMES - 1) - 4e-3, FRAME_S * N_FRAMES)
    balance = (last.counts(polarity=1) - last.counts(polarity=-1)).astype(np.float64)
    sites(axes[1, 0], rings, balance, "RdBu", 4.0, "events of the last 4 ms: brighter blue, darker red")
    for polarity, colour in ((1, "tab:blue"), (-1, "tab:red")):
        own = events.polarity == polarity
        axes[1, 1].plot(1e3 * events.t_s[own], np.degrees(angle[events.site[own]]), ",", color=colour)
    axes[1, 1].set(xlabel="time (ms)", ylabel="angle of the site (degrees)", ylim=(-180, 180))
    axes[1, 1].set_title(f"{len(events):,} events: {turns_per_s:.3f} turns a second")
    early = spikes.between(0.0, 4e-3)
    per_s = early.counts() / 4e-3
    sites(axes[1, 2], rings, per_s, "gray", float(np.quantile(per_s, 0.99)), "spikes a second, of the first 4 ms")
    save_figure(figure, out_dir / "20_events_and_rolling_shutter.png", dpi=80)

    # %% The numbers.
    assert np.isclose(lean_um, expected_um, rtol=0.01)
    assert np.isclose(turns_per_s, TURNS_PER_S, rtol=0.01)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

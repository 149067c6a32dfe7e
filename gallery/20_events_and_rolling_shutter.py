"""
How do a rolling shutter, event pixels and spiking pixels record a rotating fan?

New here: ``Camera.video`` and ``Camera.rates``, ``foveasim.video.FrameSource``,
``foveasim.modes``: ``EventPixels`` and ``SpikingPixels``.

Expect: blades distorted by a rolling shutter with a line time of 0.25 ms, and a bar at
1.92 µm/ms that is skewed by 0.48 µm per line; ON events at the leading edge of every
blade and OFF events at its trailing edge, on photosites of 0.7 to 6 µm, which give the
rotation rate of 5 turns per second within 1 %.
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

#: Scene: frames of 1 ms, with pixels of 2.4 µm that the lens demagnifies 2.5 times.
N_SIDE, SCENE_PITCH_UM, DISTANCE_M, FOCAL_LENGTH_MM = 240, 2.4, 0.07, 20.0
FRAME_S, N_FRAMES = 1e-3, 60
TURNS_PER_S, N_BLADES, BACKGROUND = 5.0, 3, 0.1
BAR_PX_PER_FRAME, BAR_PX = 2.0, 16
#: The sensors.
N_LINES, PITCH_UM, LINE_S, EXPOSURE_S = 96, 2.0, 0.25e-3, 0.5e-3
CONTRAST, REFRACTORY_S, CAPACITANCE_F = 0.25, 2e-4, 2e-15
SPIKE_E = 20_000.0


def fan() -> Iterator[np.ndarray]:
    """Yield pictures of bright antialiased blades that rotate counter-clockwise."""
    x, y = np.meshgrid(*[np.arange(N_SIDE) - 0.5 * (N_SIDE - 1)] * 2)
    radius, angle = np.hypot(x, y), np.arctan2(-y, x)  # top row first
    for k in range(N_FRAMES):
        phase = N_BLADES * (angle - 2.0 * np.pi * TURNS_PER_S * FRAME_S * k)
        to_edge = radius * np.arcsin(np.sin(phase)) / N_BLADES
        disc = np.clip(0.48 * N_SIDE - radius, 0.0, 1.0) * np.clip(
            radius - 6.0, 0.0, 1.0
        )
        yield BACKGROUND + (1.0 - BACKGROUND) * np.clip(to_edge + 0.5, 0.0, 1.0) * disc


def bar() -> Iterator[np.ndarray]:
    """Yield pictures of a vertical bar that moves to the right."""
    for k in range(N_FRAMES):
        picture = np.full((N_SIDE, N_SIDE), BACKGROUND)
        left = 40 + round(BAR_PX_PER_FRAME * k)
        picture[:, left : left + BAR_PX] = 1.0
        yield picture


def frame_source(pictures: Iterator[np.ndarray]) -> FrameSource:
    """Return a frame source of the pictures."""
    return FrameSource(
        pictures,
        pitch_um=SCENE_PITCH_UM,
        distance_m=DISTANCE_M,
        peak_radiance_w_m2_sr_nm=0.4,
        band_width_nm=100.0,
        encoding="linear",
    )


def plot_sites(
    axes: Axes,
    layout: fs.Layout,
    values: np.ndarray,
    colours: str,
    limit: float,
    title: str,
) -> None:
    """
    Plot values of sites on a scale from 0, or from the negative limit, to
    the limit.
    """
    low = -limit if values.min() < 0 else 0.0
    rings = np.split(layout.xy_um, layout.ring_offsets[1:-1])
    shapes = PolyCollection(
        rings, array=values, cmap=colours, edgecolors="face", linewidths=0.2
    )
    shapes.set_clim(low, limit)
    axes.add_collection(shapes)
    axes.autoscale_view()
    axes.set(aspect="equal", title=title, xlabel="x / µm", ylabel="y / µm")


def main(out_dir: Path) -> None:
    """Write the pictures to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    optics = fs.Optics(focal_length_mm=FOCAL_LENGTH_MM, f_number=2.8)

    # %% A sensor that is read row by row, from the top of the picture; one exposure
    # with each shutter.
    grid = readout_by(fs.layout.grid(n_x=N_LINES, n_y=N_LINES, pitch_um=PITCH_UM))
    camera = fs.Camera(
        optics=optics,
        sensor=fs.Sensor(grid, bits=12, capacitance_f=5e-15, read_noise_e=3.0),
    )
    times = {"exposure_s": EXPOSURE_S, "seed": 1, "frame_s": FRAME_S, "every": N_FRAMES}
    global_shutter = next(camera.video(frame_source(fan()), **times))
    rolling_shutter = next(
        camera.video(frame_source(fan()), **times, line_s=LINE_S, between="linear")
    )
    skewed = next(camera.video(frame_source(bar()), **times, line_s=LINE_S))

    # %% Skew of the bar per line.
    signal_e = np.maximum(
        skewed.expected_e.reshape(N_LINES, N_LINES)
        - 1.5 * np.median(skewed.expected_e),
        0.0,
    )
    centroid_um = signal_e @ grid.centroid_um[:N_LINES, 0] / signal_e.sum(axis=1)
    skew_um = np.polyfit(np.arange(N_LINES)[::-1], centroid_um, 1)[0]
    cell_um = optics.magnification(DISTANCE_M) * SCENE_PITCH_UM
    expected_um = BAR_PX_PER_FRAME * cell_um / FRAME_S * LINE_S
    print(
        f"skew of the bar: {skew_um:.4f} µm per line; speed times line time: "
        f"{expected_um:.4f} µm"
    )

    # %% The same fan on rings of event pixels and of spiking pixels.
    rings = fs.layout.log_polar(n_sectors=96, n_rings=36, r_min_um=10.0, r_max_um=100.0)
    foveal = fs.Camera(optics=optics, sensor=fs.Sensor(rings, dark_e_per_s=100.0))
    rates = list(foveal.rates(frame_source(fan())))
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
    spikes = SpikingPixels(foveal.sensor, threshold_e=SPIKE_E).events(
        rates, frame_s=FRAME_S, seed=3
    )

    # %% Rotation rate: that at which ON events are most coherent with the blades.
    angle = np.arctan2(rings.centroid_um[:, 1], rings.centroid_um[:, 0])
    is_on = events.polarity > 0
    on_s, on_angle = events.t_s[is_on], angle[events.site[is_on]]
    candidates = np.linspace(3.0, 7.0, 4001)
    coherence = [
        abs(np.exp(1j * N_BLADES * (on_angle - 2.0 * np.pi * candidate * on_s)).sum())
        for candidate in candidates
    ]
    turns_per_s = candidates[int(np.argmax(coherence))]
    print(
        f"{len(events):,} events:\n{turns_per_s:.3f} turns per second; "
        f"{len(spikes):,} spikes"
    )

    # %% Figure.
    figure = Figure(figsize=(8.0, 10.6), layout="constrained")
    axes = figure.subplots(3, 2).reshape(2, 3)
    max_dn = float(np.quantile(global_shutter.code, 0.999))
    plot_sites(axes[0, 0], grid, global_shutter.code, "gray", max_dn, "global shutter")
    plot_sites(
        axes[0, 1],
        grid,
        rolling_shutter.code,
        "gray",
        max_dn,
        f"rolling shutter, {1e3 * LINE_S:g} ms per line,\ntop line first",
    )
    plot_sites(
        axes[0, 2],
        grid,
        skewed.code,
        "gray",
        max_dn,
        f"moving bar,\nskew {skew_um:.3f} µm per line",
    )
    last = events.between(FRAME_S * (N_FRAMES - 1) - 4e-3, FRAME_S * N_FRAMES)
    balance = (last.counts(polarity=1) - last.counts(polarity=-1)).astype(np.float64)
    plot_sites(
        axes[1, 0],
        rings,
        balance,
        "RdBu",
        4.0,
        "events of the last 4 ms:\nON blue, OFF red",
    )
    for polarity, colour in ((1, "tab:blue"), (-1, "tab:red")):
        is_shown = events.polarity == polarity
        axes[1, 1].plot(
            1e3 * events.t_s[is_shown],
            np.degrees(angle[events.site[is_shown]]),
            ",",
            color=colour,
        )
    axes[1, 1].set(
        xlabel="time / ms", ylabel="angle of the site / degrees", ylim=(-180, 180)
    )
    axes[1, 1].set_title(f"{len(events):,} events: {turns_per_s:.3f} turns per second")
    early = spikes.between(0.0, 4e-3)
    per_s = early.counts() / 4e-3
    plot_sites(
        axes[1, 2],
        rings,
        per_s,
        "gray",
        float(np.quantile(per_s, 0.99)),
        "spikes per second\nin the first 4 ms",
    )
    save_figure(figure, out_dir / "20_events_and_rolling_shutter.png", dpi=140)

    # %% Checks.
    assert np.isclose(skew_um, expected_um, rtol=0.01)
    assert np.isclose(turns_per_s, TURNS_PER_S, rtol=0.01)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

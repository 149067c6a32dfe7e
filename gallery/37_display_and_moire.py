"""
What does a camera see of a monitor: its subpixels, or moiré?

New here: ``Scene.from_display``, ``fs.scene.displays`` and ``subpixels=True``.

Expect: at 7 cm the stripes of an LCD are resolved, and the PenTile matrix of an OLED
display at 4 cm. At 33 cm a pixel of the monitor is 1.1 times as wide as two photosites,
and the Bayer mosaic shows coloured stripes with a period of 66 µm on the sensor, which
a display with uniform pixels does not have.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import foveasim as fs
from foveasim.scene import displays
from foveasim.view import save_figure

FOCAL_MM, PITCH_UM = 8.0, 3.0
N_X, N_Y = 132, 88
#: Widths of the image of a pixel of the display, in photosites.
WIDTHS = {
    "LCD, close": 12.0,
    "OLED, close": 8.0,
    "LCD, moiré": 2.2,
    "LCD, uniform": 2.2,
}
#: Sites of red, from the origin of the mosaic.
RED = (slice(0, None, 2), slice(0, None, 2))


def distance_m(display: fs.scene.Display, image_um: float) -> float:
    """Return the distance at which the image of a pixel has a width, in focus."""
    return 1e-3 * FOCAL_MM * (1.0 + display.pitch_um / image_um)


def text(n_y: int, n_x: int) -> np.ndarray:
    """Return dark lines on white."""
    picture = np.full((n_y, n_x, 3), 255, np.uint8)
    rows = np.arange(n_y)
    for slope in (0, n_y // 4):
        columns = (n_x // 2 + slope + rows // 2 - n_y // 4) % n_x
        picture[rows, columns] = 30
    return picture


def main(out_dir: Path) -> None:
    """Write the figure to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% A camera with a Bayer mosaic, in front of three displays.
    layout = fs.layout.mosaic(
        fs.layout.grid(n_x=N_X, n_y=N_Y, pitch_um=PITCH_UM), ("RG", "GB")
    )
    camera = fs.Camera(
        optics=fs.Optics(focal_length_mm=FOCAL_MM, f_number=2.8),
        sensor=fs.Sensor(layout, filters="rgb", full_well_e=10_000.0, bits=12),
    )
    captures = {}
    for name, width in WIDTHS.items():
        display = displays.oled() if name.startswith("OLED") else displays.lcd()
        n_x = 2 * int(np.ceil(0.6 * N_X / width)) + 8
        is_close = name.endswith("close")
        scene = fs.Scene.from_display(
            text(n_x, n_x) if is_close else np.full((n_x, n_x), 255, np.uint8),
            display,
            distance_m=distance_m(display, width * PITCH_UM),
            subpixels=not name.endswith("uniform"),
        )
        captures[name] = camera.capture(scene, exposure_s="auto", seed=0)

    figure = Figure(figsize=(7.6, 5.4), layout="constrained")
    for axes, (name, capture) in zip(
        figure.subplots(2, 2).flat, captures.items(), strict=True
    ):
        axes.imshow(capture.picture().to_image(), interpolation="nearest")
        axes.set_title(f"{name}: pixels of {WIDTHS[name]:g} photosites")
        axes.set_axis_off()
    save_figure(figure, out_dir / "37_display_and_moire.png", dpi=140)

    # %% Check: the period of the moiré is that of two frequencies, 1 / 6 µm (red
    # photosites) and 1 / 6.6 µm (stripes).
    amplitude = {}
    for name in ("LCD, moiré", "LCD, uniform"):
        red = captures[name].expected_e.reshape(N_Y, N_X)[RED].mean(axis=0)
        spectrum = np.abs(np.fft.rfft(red / red.mean())) / red.size
        beat = round(red.size * (1.0 - 2.0 / WIDTHS[name]))
        amplitude[name] = 2.0 * spectrum[beat]
        if name == "LCD, moiré":
            assert np.argmax(spectrum[1:]) + 1 == beat
    assert amplitude["LCD, moiré"] > 0.05
    assert amplitude["LCD, uniform"] < 0.01
    for name, found in amplitude.items():
        print(f"{name}: red varies by {100.0 * found:.1f} % at 66 µm")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

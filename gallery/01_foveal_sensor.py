"""
What does a foveal sensor gain and lose against a square grid with as many photosites?

New here: ``layout.log_polar``, ``translate``, ``layout.clip``, ``layout.union``,
``Scene.from_picture``, ``Optics``, ``Sensor.from_preset``, ``Camera``,
``Capture.picture``, ``Camera.reference``.

Expect: 6,432 foveal photosites from 3 to 72 µm against 6,400 of 19 µm; on the face
3,195 against 272, and a PSNR of 31.8 against 23.1 dB; on the shuttle 111 against 256,
and 21.8 against 25.1 dB.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import shapely
from skimage.data import astronaut

import foveasim as fs
from foveasim.metrics import psnr_db
from foveasim.view import plot_capture, save_figure

N_SQUARE, PITCH_UM = 80, 19.0
HALF_UM = 0.5 * N_SQUARE * PITCH_UM
MIN_SIZE_UM = 3.0
DISTANCE_M = 1.0
OPTICS = fs.Optics(focal_length_mm=8.0, f_number=2.8, source_pixel="square")
#: Centres of two parts of the photograph, as fractions of its width and height from the
#: upper left, and half their side.
FACE, SHUTTLE, HALF_FRACTION = (0.434, 0.228), (0.814, 0.248), 0.1028
#: Bands of a prism that splits light to three chips.
BANDS_NM = ((580.0, 700.0), (490.0, 580.0), (400.0, 490.0))
#: Only every second pixel of the photograph, for a test of the script.
QUICK = {"step": 2}
PAGE, FOVEAL, SQUARE = "#14181d", "#f5a623", "#63b8f0"


class Part(NamedTuple):
    """A square part of the picture; lengths in µm."""

    x_um: float
    y_um: float
    half_um: float

    @classmethod
    def at(cls, fractions: tuple[float, float]) -> Part:
        """Return the part around a point of the photograph."""
        x, y = fractions
        return cls(
            2.0 * HALF_UM * (x - 0.5),
            2.0 * HALF_UM * (0.5 - y),
            2.0 * HALF_UM * HALF_FRACTION,
        )

    def grid(self, n_pixels: int) -> fs.Grid:
        """Return the pixels of a picture of the part."""
        return fs.Grid.centred(
            (n_pixels, n_pixels), 2.0 * self.half_um / n_pixels, (self.x_um, self.y_um)
        )

    def count(self, layout: fs.Layout) -> int:
        """Return the number of photosites with their centroid in the part."""
        distance_um = np.abs(layout.centroid_um - (self.x_um, self.y_um)).max(axis=1)
        return int(np.count_nonzero(distance_um < self.half_um))


def foveal_layout(gaze_um: tuple[float, float]) -> fs.Layout:
    """Return log-polar rings around the gaze, clipped to the square field."""
    rings = fs.layout.log_polar(
        118, min_size_um=MIN_SIZE_UM, r_max_um=2200.0, fovea="rings", stagger=True
    )
    field = shapely.box(-HALF_UM, -HALF_UM, HALF_UM, HALF_UM)
    # Small pieces at the edge of the field become part of their neighbours.
    return fs.layout.merge_small(
        fs.layout.clip(rings.translate(*gaze_um), field), min_size_um=MIN_SIZE_UM
    )


def three_chips(layout: fs.Layout) -> fs.Camera:
    """
    Return a camera with a prism: every photosite exists on three chips, for red, green
    and blue.
    """
    chips = [
        layout.with_columns(channel=np.full(layout.n_sites, k))
        for k in range(len(BANDS_NM))
    ]
    bands = fs.sensor.FilterSet(
        [fs.sensor.PassBand(from_nm=low, to_nm=high) for low, high in BANDS_NM],
        ("red", "green", "blue"),
    )
    sensor = fs.Sensor.from_preset(
        fs.layout.union(chips),
        "machine_vision",
        filters=bands,
        qe=fs.SiliconQE(depth_um=3.0),
        prnu_fraction=0.01,
    )
    return fs.Camera(optics=OPTICS, sensor=sensor)


def photograph(step: int = 1) -> fs.Scene:
    """
    Return the photograph under 500 lx, as large as the field; optionally only some of
    its pixels.
    """
    picture = astronaut()[::step, ::step]
    pitch_um = 2.0 * HALF_UM / OPTICS.magnification(DISTANCE_M) / picture.shape[0]
    return fs.Scene.from_picture(
        picture, pitch_um=pitch_um, distance_m=DISTANCE_M, illuminance_lux=500.0
    )


def main(out_dir: Path, step: int = 1) -> None:
    """Write the pictures and the layout to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% The same scene, lens, electronics and number of photosites.
    scene, face, shuttle = photograph(step), Part.at(FACE), Part.at(SHUTTLE)
    layouts = {
        "foveal": foveal_layout((face.x_um, face.y_um)),
        "square": fs.layout.grid(n_x=N_SQUARE, n_y=N_SQUARE, pitch_um=PITCH_UM),
    }
    cameras = {name: three_chips(layout) for name, layout in layouts.items()}
    exposure_s = cameras["square"].auto_exposure(scene)
    captures = {
        name: camera.capture(scene, exposure_s=exposure_s, seed=1)
        for name, camera in cameras.items()
    }

    # %% Number of photosites in both parts, and PSNR of the light that they estimate.
    counts, quality_db = {}, {}
    for name, camera in cameras.items():
        for title, part in (("face", face), ("shuttle", shuttle)):
            grid = part.grid(128)
            found = captures[name].picture(grid=grid, of="light_e", per="um2")
            counts[name, title] = part.count(layouts[name])
            quality_db[name, title] = psnr_db(
                found, camera.reference(scene, grid, exposure_s=exposure_s)
            )

    # %% Figure: both pictures, and the parts enlarged.
    figure = draw(
        layouts, captures, {"face": face, "shuttle": shuttle}, counts, quality_db
    )
    save_figure(figure, out_dir / "01_first_picture.png", dpi=150)
    foveal = layouts["foveal"]
    captures["foveal"].picture(max_pixels=800).save(
        out_dir / "01_foveal_picture.png", captures["foveal"].white_dn
    )
    chip = fs.Camera(
        optics=OPTICS, sensor=fs.Sensor.from_preset(foveal, "machine_vision")
    )
    save_figure(
        plot_capture(chip.capture(scene, exposure_s="auto", seed=1)).figure,
        out_dir / "01_foveal_layout.png",
        dpi=140,
    )

    # %% Checks.
    sizes_um = np.sqrt(foveal.area_um2)
    print(
        f"{foveal.n_sites:,} foveal photosites of {sizes_um.min():.1f} to "
        f"{sizes_um.max():.0f} µm"
    )
    for key, value_db in quality_db.items():
        print(f"{key[0]}, {key[1]}: {counts[key]:,} photosites, PSNR {value_db:.1f} dB")
    assert abs(foveal.n_sites - layouts["square"].n_sites) < 0.01 * foveal.n_sites
    assert sizes_um.min() > MIN_SIZE_UM * (1.0 - 1e-9)
    assert counts["foveal", "face"] > 10 * counts["square", "face"]
    assert quality_db["foveal", "face"] > quality_db["square", "face"] + 5.0
    assert quality_db["foveal", "shuttle"] < quality_db["square", "shuttle"] - 2.0


def draw(
    layouts: dict[str, fs.Layout],
    captures: dict[str, fs.Capture],
    parts: dict[str, Part],
    counts: dict[tuple[str, str], int],
    quality_db: dict[tuple[str, str], float],
) -> plt.Figure:
    """Return a figure of both pictures and their parts."""
    figure = plt.figure(figsize=(8.0, 6.9), facecolor=PAGE)
    figure.suptitle(
        "Same photograph, same lens, same number of photosites",
        color="white",
        weight="bold",
        size=15,
    )
    columns = figure.add_gridspec(
        2, 4, height_ratios=(2.02, 1.0), left=0.01, right=0.99, top=0.89, bottom=0.085
    )
    columns.update(hspace=0.02, wspace=0.02)
    for k, (name, colour) in enumerate((("foveal", FOVEAL), ("square", SQUARE))):
        layout, capture = layouts[name], captures[name]
        sizes_um = np.sqrt(layout.area_um2)
        range_um = (
            f"{PITCH_UM:.0f}"
            if name == "square"
            else f"{sizes_um.min():.0f} to {sizes_um.max():.0f}"
        )
        axes = figure.add_subplot(columns[0, 2 * k : 2 * k + 2])
        image = capture.picture(max_pixels=900).to_image(
            capture.white_dn, background=PAGE
        )
        axes.imshow(image, extent=(-HALF_UM, HALF_UM, -HALF_UM, HALF_UM))
        axes.set_title(
            f"{name}: {layout.n_sites:,} of {range_um} µm",
            color=colour,
            weight="bold",
            size=12,
        )
        axes.axis("off")
        for m, (title, part) in enumerate(parts.items()):
            corner = (part.x_um - part.half_um, part.y_um - part.half_um)
            axes.add_patch(
                plt.Rectangle(
                    corner,
                    2 * part.half_um,
                    2 * part.half_um,
                    fill=False,
                    ec=colour,
                    lw=1.5,
                )
            )
            zoomed = figure.add_subplot(columns[1, 2 * k + m])
            picture = capture.picture(grid=part.grid(400))
            zoomed.imshow(picture.to_image(capture.white_dn, background=PAGE))
            zoomed.set(xticks=[], yticks=[])
            for spine in zoomed.spines.values():
                spine.set(edgecolor=colour, linewidth=1.5)
            caption = (
                f"{title}: {counts[name, title]:,} photosites\nPSNR "
                f"{quality_db[name, title]:.1f} dB"
            )
            zoomed.set_xlabel(caption, color=colour, size=10.5)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

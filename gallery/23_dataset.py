"""
How do I generate datasets that make a network robust to cameras, or to their noise?

New here: ``foveasim.explore.classification`` and ``denoising``, ``Dataset``,
``write_dataset``.

Expect: one photograph through 8 random cameras, each sample with its class and the
sites in its bounding box; noisy captures at three exposures with their expected codes,
and a mean squared error that agrees with the variance predicted by the sensor within 3
%.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import skimage.data
from matplotlib.figure import Figure
from numpy.typing import NDArray

from foveasim import Capture, explore
from foveasim.view import save_figure

SHOT = {
    "scene": {
        "kind": "picture",
        "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 0.004,
        "wavelength_nm": [620, 550, 450],
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8, "source_pixel": "square"},
    "layout": "foveal_blind_spot",
    "sensor": {
        "qe": 0.6,
        "filters": "rgb",
        "capacitance_f": {"per_um2": 1e-16},
        "v_sat_v": 1.0,
        "bits": 10,
    },
    "exposure_s": 0.02,
}
#: Layouts of the samples: names of bundled layouts, or settings.
LAYOUTS = [
    "foveal_blind_spot",
    {
        "generator": "hexagonal",
        "parameters": {"n_columns": 110, "n_rows": 127, "pitch_um": 12.0},
        "mosaic": ["RG", "GB"],
    },
    {
        "generator": "grid",
        "parameters": {"n_x": 100, "n_y": 100, "pitch_um": 12.5},
        "mosaic": ["RG", "GB"],
    },
]
#: Fewer sites for denoising: expected codes of few electrons take longer to compute
#: than captures.
HEXAGONS = {
    "generator": "hexagonal",
    "parameters": {"n_columns": 76, "n_rows": 88, "pitch_um": 17.3},
    "mosaic": ["RG", "GB"],
}
#: Settings for denoising: hundreds of electrons give the highest code.
DIM = {
    "exposure_s": 2e-4,
    "sensor.capacitance_f": {"per_um2": 1e-18},
    "layout": HEXAGONS,
}
#: Bounding box of the face, in pixels from the upper left corner, and its class.
FACE_PX, FACE = [170, 50, 280, 200], 1
N_CAMERAS, N_DRAWS = 8, 4
#: Cameras of the first dataset for a test of the script.
QUICK = {"n_cameras": 4}
#: Side of the pictures in pixels, and the grey level of regions without photosites.
PICTURE_PIXELS, GREY = 300, 60.0


def picture_on_grey(
    capture: Capture, white_dn: float | None = None
) -> NDArray[np.uint8]:
    """Return the picture of a capture over grey, optionally with a white level."""
    scale = 1.0 if white_dn is None else white_dn / capture.white_dn.max()
    image = capture.picture(max_pixels=PICTURE_PIXELS).to_image(
        scale * capture.white_dn
    )
    cover = image[..., -1:] / 255.0
    return np.rint(image[..., :-1] * cover + GREY * (1.0 - cover)).astype(np.uint8)


def main(out_dir: Path, n_cameras: int = N_CAMERAS) -> None:
    """Write samples of both datasets to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    photograph = skimage.data.astronaut()

    # %% Classification: one class, whatever the layout, lens, exposure and electronics.
    data = explore.classification(
        [photograph],
        SHOT,
        {"layout": {"choice": LAYOUTS}, "sensor.bits": {"choice": [6, 8, 10]}},
        cameras=n_cameras,
        seed=5,
        labels=["astronaut"],
        boxes=[[[*FACE_PX, FACE]]],
        fit="cover",
    )
    figure = Figure(figsize=(8.0, 10.0), layout="constrained")
    for k, axes in enumerate(figure.subplots(n_cameras // 2, 2).ravel()):
        sample, capture = data[k], data.capture(k)
        x0, y0, x1, y1 = capture.layout.bounds_um
        axes.imshow(picture_on_grey(capture), extent=(x0, x1, y0, y1))
        left, low, right, high = sample["box_um"][0]
        axes.plot(
            [left, right, right, left, left],
            [low, low, high, high, low],
            color="yellow",
            linewidth=0.8,
        )
        drawn = sample["settings"]
        axes.set_title(
            f"f/{drawn['optics.f_number']:.1f}, {1e3 * drawn['exposure_s']:.0f} ms, "
            f"{drawn['sensor.read_noise_e']:.1f} e- read noise, "
            f"{drawn['sensor.bits']} bits\n"
            f"{capture.layout.n_sites:,} sites, "
            f"{sample['box_covers'][0].sum():,} on the face",
            fontsize=10,
        )
        axes.set_axis_off()
    save_figure(figure, out_dir / "23_random_cameras.png", dpi=140)

    # %% Denoising: noise realisations, and their mean, computed analytically.
    noisy = explore.denoising(
        [photograph], SHOT, cameras=3, draws=N_DRAWS, fit="cover", changes=DIM
    )
    figure = Figure(figsize=(8.0, 6.2), layout="constrained")
    ratios, errors = [], []
    for axes, first in zip(
        figure.subplots(2, 3).T, range(0, len(noisy), N_DRAWS), strict=True
    ):
        samples = [noisy[k] for k in range(first, first + N_DRAWS)]
        capture = noisy.capture(first)
        _, variance_dn2 = noisy.shot(first).camera.sensor.predict(capture.expected_e)
        errors_dn = [sample["code"] - sample["expected_dn"] for sample in samples]
        ratios.append(float(np.mean(np.square(errors_dn)) / variance_dn2.mean()))
        # Standard error of the sum of squared Gaussian numbers.
        errors.append(
            float(np.sqrt(2.0 / N_DRAWS * np.sum(variance_dn2**2)) / variance_dn2.sum())
        )
        drawn = samples[0]["settings"]
        print(
            f"{1e6 * drawn['exposure_s']:.0f} µs: mean squared error / predicted "
            f"variance {ratios[-1]:.4f}"
        )
        titles = (
            (
                f"code: {1e6 * drawn['exposure_s']:.0f} "
                f"µs,\n{drawn['sensor.read_noise_e']:.1f} e- read noise"
            ),
            (
                "expected code,\nrms error "
                f"{np.sqrt(np.mean(np.square(errors_dn))):.1f} DN"
            ),
        )
        mean_dn = samples[0]["expected_dn"]
        target = replace(capture, code=np.rint(mean_dn).astype(capture.code.dtype))
        for part, plotted, title in zip(axes, (capture, target), titles, strict=True):
            part.imshow(picture_on_grey(plotted, float(np.percentile(mean_dn, 99.0))))
            part.set_title(title, fontsize=10)
            part.set_axis_off()
    save_figure(figure, out_dir / "23_denoising.png", dpi=140)

    # %% Write the dataset in shards, and read it back.
    with tempfile.TemporaryDirectory() as directory:
        stored = explore.write_dataset(noisy, Path(directory) / "noisy")
        print(stored, "with seed", stored.about["plan"]["seed"])
        assert np.array_equal(stored[7]["code"], noisy[7]["code"])
    assert (
        max(
            abs(ratio - 1.0) / error
            for ratio, error in zip(ratios, errors, strict=True)
        )
        < 5.0
    )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

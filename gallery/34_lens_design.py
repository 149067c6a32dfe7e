"""
What does a sensor see through a real lens design, and how many modes do its PSFs need?

New here: ``fs.optics.PSFGrid.from_arrays``, ``Optics(psfs=...)``,
``Optics(field_modes=...)``, ``Optics.field_error``, ``Optics.psf_modes``.

Expect: a Cooke triplet at f/5 that images a star sharply on the axis, and with coma and
astigmatism at 8 and 15 mm. The singular values of its PSFs decrease by a factor of 100
within 10 modes. With 6 modes, some 2 % of the light of a point is displaced, with 16
modes 0.4 %.
"""

from __future__ import annotations

import itertools
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull

import foveasim as fs
from foveasim.view import save_figure

#: Cooke triplet of focal length 50 mm, f/5, for 40 degrees: radius, distance to the
#: next surface, mm, and glass. It is a sample of several design programs; the stop is
#: the fourth surface.
TRIPLET = (
    (22.01359, 3.258976, "SK16"),
    (-435.76044, 6.007551, ""),
    (-22.213277, 0.999975, "F2"),
    (20.291924, 4.750409, ""),
    (79.683603, 2.952076, "SK16"),
    (-18.395333, 42.207778, ""),
)
STOP, PUPIL_MM, START_MM = 3, 10.0, -20.0
#: Sellmeier coefficients (Schott, optical glass data sheets): B1, B2, B3, C1, C2, C3 in
#: µm².
GLASSES = {
    "SK16": (
        1.34317774,
        0.241144399,
        0.994317969,
        0.00704687339,
        0.0229005,
        92.7508526,
    ),
    "F2": (
        1.34533359,
        0.209073176,
        0.937357162,
        0.00997743871,
        0.0470450767,
        111.886764,
    ),
}
WAVES_NM = (480.0, 550.0, 650.0)
ANGLES_DEG = np.linspace(0.0, 20.0, 9)
#: λN/2 at the shortest wavelength.
PITCH_UM, N_SAMPLES, N_RAYS = 1.2, 161, 121
LENS = fs.Optics(focal_length_mm=50.0, f_number=5.0, padding="edge", oversample=1)
DISTANCE_M = 10.0
HEIGHTS_MM = (0.0, 8.0, 15.0)
N_MODES = (2, 6, 16)
#: Frames, pixels, wavelengths and samples of a PSF for a test of the script.
QUICK = {"n_frames": 1, "n_pixels": 256, "waves_nm": (550.0,), "n_samples": 121}


def index_of(glass: str, wave_um: float) -> float:
    """Return the refractive index."""
    if not glass:
        return 1.0
    *b, c1, c2, c3 = GLASSES[glass]
    return float(
        np.sqrt(
            1.0
            + sum(
                bi * wave_um**2 / (wave_um**2 - ci)
                for bi, ci in zip(b, (c1, c2, c3), strict=True)
            )
        )
    )


def trace(
    xy_mm: np.ndarray, angle_rad: float, wave_um: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """
    Trace a parallel beam to the image plane.

    ``xy_mm`` (n, 2): points of the wavefront through (0, 0, START_MM). Returns points
    and directions in the image plane, optical path lengths, and heights in the stop.
    """
    across, up = (
        np.array([1.0, 0.0, 0.0]),
        np.array([0.0, np.cos(angle_rad), -np.sin(angle_rad)]),
    )
    at = xy_mm[:, :1] * across + xy_mm[:, 1:] * up + (0.0, 0.0, START_MM)
    ray = np.tile([0.0, np.sin(angle_rad), np.cos(angle_rad)], (len(at), 1))
    path, before, vertex, stop = np.zeros(len(at)), 1.0, 0.0, at
    for number, (radius, thickness, glass) in enumerate(TRIPLET):
        centre = np.array([0.0, 0.0, vertex + radius])
        b = np.sum(ray * (at - centre), axis=1)
        step = -b - np.sign(radius) * np.sqrt(
            b**2 - np.sum((at - centre) ** 2, axis=1) + radius**2
        )
        at, path = at + step[:, None] * ray, path + before * step
        if number == STOP:
            stop = at
        normal, after = (at - centre) / radius, index_of(glass, wave_um)
        cosine, ratio = -np.sum(ray * normal, axis=1), before / after
        ray = (
            ratio * ray
            + (ratio * cosine - np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2)))[:, None]
            * normal
        )
        before, vertex = after, vertex + thickness
    step = (vertex - at[:, 2]) / ray[:, 2]
    return at + step[:, None] * ray, ray, path + step, stop


def beam(angle_rad: float, wave_um: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return the rays of a beam that fill the stop: image points, directions, path
    lengths; the chief ray first.
    """
    marginal = trace(np.array([[0.0, 0.5 * PUPIL_MM]]), 0.0, 0.55)[3]
    low, high = -20.0, 20.0
    for _ in range(60):  # the ray through the centre of the stop
        middle = 0.5 * (low + high)
        is_below = trace(np.array([[0.0, middle]]), angle_rad, wave_um)[3][0, 1] < 0.0
        low, high = (middle, high) if is_below else (low, middle)
    offsets = np.linspace(-6.0, 6.0, N_RAYS)
    grid = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    start = np.concatenate(([[0.0, low]], grid + np.array([0.0, low])))
    at, ray, path, stop = trace(start, angle_rad, wave_um)
    fills = np.hypot(stop[:, 0], stop[:, 1]) <= marginal[0, 1]
    return at[fills], ray[fills], path[fills]


def psf_of(
    angle_rad: float, wave_um: float, n_samples: int
) -> tuple[np.ndarray, float, float]:
    """
    Return the PSF around the chief ray, its image height in mm, and the projected solid
    angle of the beam.
    """
    at, ray, path = beam(angle_rad, wave_um)
    offsets_mm = 1e-3 * PITCH_UM * (np.arange(n_samples) - n_samples // 2)
    # Each ray is a plane wave, with the phase of its path at the chief ray's image
    # point.
    k_per_mm = 2e3 * np.pi / wave_um
    phase = k_per_mm * (path - np.sum(ray[:, :2] * (at - at[0])[:, :2], axis=1))
    along_x, along_y = (
        np.exp(1j * k_per_mm * np.outer(offsets_mm, ray[:, axis])) for axis in (0, 1)
    )
    amplitude = (along_y[:, 1:] * np.exp(1j * (phase[1:] - phase[0]))) @ along_x[
        :, 1:
    ].T
    return np.abs(amplitude) ** 2, float(at[0, 1]), float(ConvexHull(ray[:, :2]).volume)


def triplet(waves_nm: tuple[float, ...], n_samples: int) -> fs.optics.PSFGrid:
    """
    Return the PSFs of the triplet on one radius, as a design program
    exports them.
    """
    found = [
        [psf_of(angle, 1e-3 * wave_nm, n_samples) for wave_nm in waves_nm]
        for angle in np.radians(ANGLES_DEG)
    ]
    return fs.optics.PSFGrid.from_arrays(
        [[psf for psf, _, _ in each] for each in found],
        x_um=np.zeros(len(found)),
        y_um=[1e3 * each[len(waves_nm) // 2][1] for each in found],
        wavelength_nm=waves_nm,
        pitch_um=PITCH_UM,
        centre="fft",
        image="inverted",
        relative_illumination=[
            [each[w][2] / found[0][w][2] for w in range(len(waves_nm))]
            for each in found
        ],
    )


def scene_of(
    image: np.ndarray, pitch_um: float, centre_um: float, waves_nm: np.ndarray
) -> fs.Scene:
    """Return a scene whose image has this pitch, around a height on the sensor."""
    scale = LENS.magnification(DISTANCE_M)
    spectrum = np.full((1, waves_nm.size), 0.01)
    return fs.Scene(
        image[None],
        spectrum,
        waves_nm,
        np.full(waves_nm.size, 50.0),
        pitch_um / scale,
        DISTANCE_M,
        centre_um=(0.0, centre_um / scale),
    )


def star(n: int, n_spokes: int = 24) -> np.ndarray:
    """Return a star of bright and dark spokes."""
    y, x = np.mgrid[:n, :n] - 0.5 * (n - 1)
    spokes = 0.5 + 0.5 * np.clip(4.0 * np.sin(n_spokes * np.arctan2(y, x)), -1.0, 1.0)
    return np.where(np.hypot(x, y) < 0.45 * n, spokes, 0.5)


def main(
    out_dir: Path,
    n_frames: int = 4,
    n_pixels: int = 512,
    waves_nm: tuple[float, ...] = WAVES_NM,
    n_samples: int = N_SAMPLES,
) -> None:
    """Write the figure to a directory; times are the shortest of ``n_frames``."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% PSFs of the design, and the image of a star at three heights.
    psfs = triplet(waves_nm, n_samples)
    lens = replace(LENS, psfs=psfs, field_tolerance=0.03)
    near = replace(lens, field_patches=1)  # the PSF at the centre of each star
    stars = [
        scene_of(star(160), 3.0, 1e3 * height_mm, np.array(waves_nm))
        for height_mm in HEIGHTS_MM
    ]
    images = [near.power_map(scene).data.sum(axis=0) for scene in stars]
    spots = [
        lens.psf(
            550.0,
            distance_m=DISTANCE_M,
            field_um=(0.0, 1e3 * h),
            pitch_um=0.6,
            n_points=101,
        )
        for h in HEIGHTS_MM
    ]

    # %% Modes of a picture of 10 x 10 mm above the axis: light displaced, and time of a
    # frame.
    wide = scene_of(
        np.random.default_rng(0).random((n_pixels, n_pixels), dtype=np.float32),
        10240.0 / n_pixels,
        9000.0,
        np.array([550.0]),
    )
    one = replace(
        LENS,
        psfs=replace(
            psfs,
            psf=psfs.psf[:1],
            x_um=psfs.x_um[:1],
            y_um=psfs.y_um[:1],
            relative_illumination=None,
        ),
    )
    lenses = {k: replace(lens, field_modes=k) for k in N_MODES}
    displaced = {k: each.field_error(wide) for k, each in lenses.items()}
    times_s = {
        k: frame_s(each, wide, n_frames) / frame_s(one, wide, n_frames)
        for k, each in lenses.items()
    }

    figure = Figure(figsize=(7.6, 7.0), layout="constrained")
    rows = figure.subfigures(2, 1, height_ratios=(1.55, 1.0))
    axes = rows[0].subplots(2, 3)
    for column, (height_mm, image, spot) in enumerate(
        zip(HEIGHTS_MM, images, spots, strict=True)
    ):
        axes[0, column].imshow(image, origin="lower", cmap="gray")
        axes[0, column].set_title(f"{height_mm:g} mm from the axis", fontsize=10)
        half_um = spot.grid.bounds_um[2]
        axes[1, column].imshow(
            np.sqrt(np.maximum(spot.psf_per_um2, 0.0)),
            origin="lower",
            cmap="magma",
            extent=(-half_um, half_um) * 2,
        )
        axes[1, column].set_xlabel("µm")
    for each in axes[0]:
        each.set_xticks([])
        each.set_yticks([])
    left, right = rows[1].subplots(1, 2)
    values = lens.psf_modes(wide).singular_values[:40]
    left.semilogy(np.arange(1, values.size + 1), values / values[0], "o-", markersize=3)
    left.set_xlabel("mode")
    left.set_ylabel("relative singular value")
    right.semilogy(
        [times_s[k] for k in N_MODES], [1e2 * displaced[k] for k in N_MODES], "o-"
    )
    for k in N_MODES:
        at = times_s[k], 1e2 * displaced[k]
        right.annotate(
            f"{k} modes",
            at,
            textcoords="offset points",
            xytext=(-6, -12) if k == 16 else (-4, 7),
            ha="right" if k == 16 else "left",
            fontsize=9,
        )
    right.set_xlim(left=0.0)
    right.set_ylim(0.2, 12.0)
    right.yaxis.set_major_formatter("{x:g}")
    right.set_xlabel("time of a frame over that with one PSF")
    right.set_ylabel("light displaced / %")
    for each in (left, right):
        each.grid(visible=True, alpha=0.3, which="both")
    save_figure(figure, out_dir / "34_lens_design.png", dpi=140)

    # %% Check: focal length, sharpness on the axis, blur and less light off it, and
    # convergence of the modes.
    near_um, angle = psf_of(np.radians(0.1), 0.55, n_samples)[1] * 1e3, np.radians(0.1)
    assert abs(near_um / np.tan(angle) - 50000.0) < 300.0
    strehl = [
        lens.strehl(550.0, distance_m=DISTANCE_M, field_um=(0.0, 1e3 * h))
        for h in HEIGHTS_MM
    ]
    assert strehl[0] > 2.0 * strehl[2]
    assert psfs.relative_illumination is not None
    assert displaced[6] < 0.03
    assert values[10] < 1e-2 * values[0]
    assert 0.6 < psfs.relative_illumination[-1].mean() < 0.9
    assert all(displaced[a] > displaced[b] for a, b in itertools.pairwise(N_MODES))
    print(f"Strehl ratios: {', '.join(f'{value:.2f}' for value in strehl)}")
    for k in N_MODES:
        print(
            f"{k:2d} modes: {displaced[k]:.1%} of the light displaced, "
            f"{times_s[k]:.1f} times the frame"
        )
    chosen = lens.psf_modes(wide)
    print(f"tolerance of 3 %: {chosen.n_modes - 1} modes")


def frame_s(lens: fs.Optics, scene: fs.Scene, n_frames: int) -> float:
    """Return the shortest time of a repeated frame."""
    times_s = []
    for _ in range(n_frames):
        start = time.perf_counter()
        for _ in lens.weighted_maps(scene, np.ones((1, 1))):
            pass
        times_s.append(time.perf_counter() - start)
    return min(times_s)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

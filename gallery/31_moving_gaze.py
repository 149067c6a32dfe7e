"""
What does a foveal sensor record while its gaze moves over a scene?

New here: one layout per gaze, clipped to the field of the lens; frames with different
photosites in one animation.

Expect: 5,300 to 6,800 photosites, fewer where the gaze is at the edge of the field;
2,800 or more of them within 150 µm of the gaze, 14 times as many as the square grid of
gallery script 1 has there; an animation of less than 0.8 MB.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import foveasim as fs

sys.path.insert(0, str(Path(__file__).parent))
first = import_module("01_foveal_sensor")
sys.path.pop(0)

#: Points that the gaze visits, as fractions of the width and height from the upper
#: left; frames between two, and at each.
STOPS = (
    (0.434, 0.228),
    (0.814, 0.248),
    (0.67, 0.55),
    (0.74, 0.86),
    (0.34, 0.74),
    (0.08, 0.22),
)
N_MOVING, N_RESTING = 4, 1
FRAME_MS, REST_MS = 160, 700
N_PIXELS = 640
RING_UM = 150.0
#: Frames and pixels for a test of the script.
QUICK = {"n_stops": 2, "n_moving": 1, "step": 2}


def gaze_path(n_stops: int, n_moving: int) -> tuple[np.ndarray, list[int]]:
    """
    Return gazes (n_frame, 2) in µm along a closed path with smooth starts and ends, and
    durations in ms.
    """
    stops_um = 2.0 * first.HALF_UM * (np.array(STOPS[:n_stops]) - 0.5) * (1.0, -1.0)
    gazes, durations_ms = [], []
    for begin, end in zip(stops_um, np.roll(stops_um, -1, axis=0), strict=True):
        gazes.append(begin)
        durations_ms.append(REST_MS)
        for step in np.arange(1, n_moving + 1) / (n_moving + 1):
            gazes.append(begin + (end - begin) * (3.0 - 2.0 * step) * step**2)
            durations_ms.append(FRAME_MS)
    return np.array(gazes), durations_ms


def frame(
    scene: fs.Scene, gaze_um: np.ndarray, exposure_s: float, seed: int
) -> tuple[Image.Image, int, int]:
    """
    Return a picture with a ring at the gaze, the number of photosites, and that near
    the gaze.
    """
    layout = first.foveal_layout(tuple(gaze_um))
    capture = first.three_chips(layout).capture(scene, exposure_s=exposure_s, seed=seed)
    picture = capture.picture(max_pixels=N_PIXELS)
    image = Image.fromarray(picture.to_image(capture.white_dn, background="black"))
    scale = N_PIXELS / (2.0 * first.HALF_UM)
    x, y, r = (
        (gaze_um[0] + first.HALF_UM) * scale,
        (first.HALF_UM - gaze_um[1]) * scale,
        RING_UM * scale,
    )
    n_near = int(
        np.count_nonzero(np.hypot(*(layout.centroid_um - gaze_um).T) < RING_UM)
    )
    drawing = ImageDraw.Draw(image)
    drawing.ellipse((x - r, y - r, x + r, y + r), outline=first.FOVEAL, width=3)
    text = f"{layout.n_sites:,} photosites, {n_near:,} in the ring"
    font = ImageFont.load_default(size=20)
    drawing.rectangle(
        (0, N_PIXELS - 32, drawing.textlength(text, font) + 20, N_PIXELS),
        fill=first.PAGE,
    )
    drawing.text((10, N_PIXELS - 28), text, fill="white", font=font)
    return image, layout.n_sites, n_near


def main(
    out_dir: Path, n_stops: int = len(STOPS), n_moving: int = N_MOVING, step: int = 1
) -> None:
    """Write the animation to a directory."""
    out_dir.mkdir(parents=True, exist_ok=True)
    # %% Scene and exposure are fixed; each gaze has its own photosites.
    scene = first.photograph(step)
    gazes_um, durations_ms = gaze_path(n_stops, n_moving)
    exposure_s = first.three_chips(
        first.foveal_layout(tuple(gazes_um[0]))
    ).auto_exposure(scene)
    frames, counts, near = zip(
        *(
            frame(scene, gaze_um, exposure_s, seed)
            for seed, gaze_um in enumerate(gazes_um)
        ),
        strict=True,
    )

    # %% One animated picture.
    path = out_dir / "31_moving_gaze.webp"
    frames[0].save(
        path,
        save_all=True,
        append_images=frames[1:],
        duration=durations_ms,
        loop=0,
        quality=60,
        method=6,
    )

    # %% Checks: density near the gaze, against squares of 19 µm.
    square_near = np.pi * RING_UM**2 / first.PITCH_UM**2  # 196
    print(
        f"{len(frames)} frames, {min(counts):,} to {max(counts):,} photosites, "
        f"{path.stat().st_size / 1e3:.0f} kB"
    )
    print(
        f"{min(near):,} to {max(near):,} photosites in the ring; "
        f"{square_near:.0f} of the square grid"
    )
    assert 5200 < min(counts) <= max(counts) < 6900
    assert min(near) > 14 * square_near
    assert path.stat().st_size < 800_000


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

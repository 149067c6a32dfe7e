"""Settings of a small shot, for tests of commands and of many shots."""

from __future__ import annotations

#: A uniform scene and 64 square photosites.
FLAT_SHOT = {
    "scene": {
        "kind": "flat",
        "shape": [60, 60],
        "pitch_um": 300.0,
        "distance_m": 1.0,
        "radiance_w_m2_sr_nm": 0.1,
        "band_width_nm": 100.0,
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 3.0}},
    "sensor": {"read_noise_e": 2.0, "capacitance_f": 4e-15},
    "exposure_s": 0.01,
}

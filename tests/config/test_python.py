"""Python source of settings: the same codes as the settings."""

from __future__ import annotations

import copy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import foveasim as fs
from foveasim._io.images import write_picture
from foveasim.config import build_shot, bundled_layouts, demo_settings, read_settings, starting_file, to_python
from foveasim.errors import ConfigError

REPOSITORY = Path(fs.__file__).parents[1]
SHOT = {
    "scene": {
        "kind": "flat",
        "shape": [60, 60],
        "pitch_um": 400.0,
        "distance_m": 1.0,
        "radiance_w_m2_sr_nm": 0.02,
        "band_width_nm": 100.0,
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {"generator": "grid", "parameters": {"n_x": 12, "n_y": 10, "pitch_um": 4.0}},
    "sensor": {"bits": 10, "capacitance_f": 1e-13},
    "exposure_s": 0.01,
    "seed": 7,
}


def codes_of_settings(settings, source=None):
    shot = build_shot(source, settings)
    return shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed).code


def codes_of_python(text):
    names = {}
    exec(compile(text, "shot.py", "exec"), names)
    return names["capture"].code


def changed(**changes):
    settings = copy.deepcopy(SHOT)
    for key, value in changes.items():
        section = settings
        *above, last = key.split("__")
        for name in above:
            section = section.setdefault(name, {})
        section[last] = value
    return settings


@pytest.mark.parametrize(
    "path",
    [*demo_settings(), REPOSITORY / "gallery" / "own_photograph.yaml", REPOSITORY / "gallery" / "paper_foveal.yaml"],
    ids=lambda path: path.stem,
)
def test_source_of_files_gives_same_codes(path):
    settings = read_settings(path)

    assert np.array_equal(codes_of_python(to_python(settings, source=path)), codes_of_settings(settings, path))


def test_source_of_large_file_compiles():
    path = REPOSITORY / "gallery" / "mobius_distortion.yaml"
    text = to_python(read_settings(path), source=path)

    compile(text, "shot.py", "exec")
    assert "fs.distortion.Scaramuzza(" in text


def test_source_of_starting_file_gives_same_codes(tmp_path):
    path = tmp_path / "shot.yaml"
    path.write_text(starting_file("shot"))
    settings = read_settings(path)

    assert np.array_equal(codes_of_python(to_python(settings)), codes_of_settings(settings))


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("name", sorted(set(bundled_layouts()) - {"pixirad_1"}))
def test_source_of_bundled_layouts_gives_same_codes(name):
    settings = changed(layout=name, scene__pitch_um=20000.0)

    assert np.array_equal(codes_of_python(to_python(settings)), codes_of_settings(settings))


EDITS = [
    {"kind": "remove_at", "points_um": [[2.0, 2.0]]},
    {"kind": "draw", "outlines_um": [[[-9.0, -9.0], [9.0, -9.0], [0.0, 9.0]]], "channel": 1},
    {"kind": "overlay", "layer": {"generator": "hexagonal", "parameters": {"n_columns": 3, "n_rows": 3, "pitch_um": 2.0}, "move_um": [12.0, 8.0]}},
    {"kind": "rotate", "angle_deg": 10.0},
    {"kind": "merge_at", "points_um": [[-14.0, -14.0], [-17.0, -14.0]]},
    {"kind": "repair"},
]  # fmt: skip


@pytest.mark.filterwarnings("ignore::foveasim.errors.FoveasimWarning")
@pytest.mark.parametrize(
    "settings",
    [
        changed(layout__edits=EDITS, layout__rules={"min_size_um": 1.5}, layout__move_um=[3.0, -2.5], layout__inset_um=0.2),
        changed(layout__move_um=[3.0, -2.5], layout__inset_um=0.2, layout__snap_um=0.01, layout__mosaic=["RG", "GB"], sensor__filters="rgb", scene__wavelength_nm=[620.0, 550.0, 450.0], scene__band_width_nm=80.0),
        changed(sensor__capacitance_f={"per_um2": 1e-15}, sensor__dark_e_per_s={"per_um2": 3.7}, sensor__read_noise_e=1.5),
        changed(sensor__qe={"kind": "product", "curves": [0.5, {"kind": "silicon", "depth_um": 3.0}]}),
        changed(sensor__crosstalk={"kind": "diffusion", "spread_um": 1.0}, sensor__coupling={"neighbour_fraction": 0.01}),
        changed(optics__pupil={"kind": "annulus", "obscuration": 0.3}, optics__zernike={"coefficients": {"4": 0.1}}),
        changed(optics__focus_distance_m=float("inf"), optics__seidel={"spherical_um": 0.2}),
        changed(distortion={"kind": "brown_conrady", "focal_um": 8000.0, "k1": 0.1}, integration_order=1),
        changed(scene={"kind": "siemens_star", "n_spokes": 12, "radius_mm": 8.0, "shape": [60, 60], "pitch_um": 400.0, "distance_m": 1.0, "radiance_w_m2_sr_nm": 0.02, "band_width_nm": 100.0}),
    ],
    ids=["edits", "steps", "per area", "curves", "crosstalk", "pupil", "focus", "distortion", "chart"],
)  # fmt: skip
def test_source_of_sections_gives_same_codes(settings):
    text = to_python(settings)

    assert "build_shot" not in text
    assert np.array_equal(codes_of_python(text), codes_of_settings(settings))


@pytest.mark.slow
def test_source_runs_in_new_process():
    settings = changed(scene=read_settings(demo_settings()[0])["scene"], scene__pitch_um=20.0)
    script = to_python(settings) + "\nprint(capture.code.sum())"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)

    assert int(done.stdout) == codes_of_settings(settings).sum()


def test_source_of_density_picture_gives_same_codes(tmp_path):
    picture = tmp_path / "density.png"
    write_picture(picture, np.tile(np.arange(60, 160, dtype=np.uint8), (100, 1)))
    parameters = {"n_sites": 60, "size_um": [60.0, 60.0], "density": str(picture), "seed": 3}
    settings = changed(layout={"generator": "voronoi", "parameters": parameters})

    assert np.array_equal(codes_of_python(to_python(settings)), codes_of_settings(settings))


def test_source_of_layout_file_gives_same_codes(tmp_path):
    path = tmp_path / "sites.npz"
    fs.layout.grid(8, 8, 5.0).write(path)
    settings = changed(layout={"file": "sites.npz", "move_um": [1.0, 0.0]})
    source = tmp_path / "shot.yaml"

    assert np.array_equal(codes_of_python(to_python(settings, source=source)), codes_of_settings(settings, source))


def test_invalid_settings_give_one_line():
    with pytest.raises(ConfigError, match=r"exposure_s") as caught:
        to_python(changed(exposure_s="long"))

    assert "\n" not in str(caught.value)

"""The command compare: reports of layouts and shots, unequal budgets, mixed files and interruption."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

import foveasim as fs

SHOT = """
scene: {{kind: picture, picture: photo.png, pitch_um: 200.0, distance_m: {distance_m}, peak_radiance_w_m2_sr_nm: 0.02,
  wavelength_nm: 550, band_width_nm: 100}}
optics: {{focal_length_mm: 8.0, f_number: {f_number}}}
layout: {{generator: grid, parameters: {{n_sites: {n_sites}, size_um: [100.0, 100.0]}}}}
exposure_s: {exposure_s}
"""
FAST = ("--pixels", "32", "--annuli", "3")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare")
    fs.layout.log_polar(n_sectors=24, min_size_um=2.0, r_max_um=60.0).write(folder / "foveal.npz")
    fs.layout.grid(n_x=16, size_um=(120.0, 120.0)).write(folder / "square.geojson")
    (folder / "broad.yaml").write_text("generator: hexagonal\nparameters: {n_sites: 240, size_um: [120.0, 120.0]}\n")
    y, x = np.mgrid[:90, :120]
    Image.fromarray(np.uint8(120 + 100 * np.sin(x / 7.0) * np.cos(y / 5.0))).save(folder / "photo.png")
    for name, options in {
        "shot": {},
        "fine": {"n_sites": 900},
        "other_lens": {"f_number": 2.0},
        "long": {"exposure_s": 0.02},
        "far": {"distance_m": 2.0},
    }.items():
        (folder / f"{name}.yaml").write_text(
            SHOT.format(**{"f_number": 4.0, "n_sites": 400, "exposure_s": 0.01, "distance_m": 1.0, **options})
        )
    return folder


@pytest.mark.slow
def test_layouts_are_compared_in_a_report(foveasim, folder):
    result = foveasim(
        "compare",
        "foveal.npz",
        "square.geojson",
        "--budget",
        "none",
        "--picture",
        "photo.png",
        "-o",
        "r.html",
        *FAST,
        cwd=folder,
    )

    assert result.returncode == 0, result.stderr
    assert "wrote r.html" in result.stdout
    assert "PSNR / dB" in result.stdout
    assert "<h1>Comparison of foveal and square</h1>" in (folder / "r.html").read_text()


@pytest.mark.slow
def test_shots_are_compared_on_their_scenes(foveasim, folder):
    result = foveasim(
        "compare", "shot.yaml", "fine.yaml", "shot.yaml", "--budget", "area", "-o", "s.html", *FAST, cwd=folder
    )

    assert result.returncode == 0, result.stderr
    page = (folder / "s.html").read_text()
    assert "Comparison of shot, fine and shot (2)" in page
    assert "one scene, without confidence intervals, which require 5 scenes: scene of shot." in page


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("foveal.npz",), "'files' must be at least two layouts or shots, got 1"),
        (("square.geojson", "gone.npz"), "gone.npz: no such file"),
        (("shot.yaml", "square.geojson"), "not both: shot.yaml is a shot, square.geojson a layout"),
        (("shot.yaml", "other_lens.yaml"), "must have the same optics: those of 'shot' and 'other_lens' differ"),
        (("shot.yaml", "long.yaml"), "'exposure_s' must be equal, got '0.01 s (shot), 0.02 s (long)'"),
        (
            ("shot.yaml", "fine.yaml"),
            "'budget' must be equal within 2 %: the number of sites of 'shot' is 400, that of",
        ),
        (("shot.yaml", "shot.yaml", "--budget", "bits"), "'budget' must be one of 'n_sites', 'data_rate'"),
        (("shot.yaml", "shot.yaml", "-o", "report.pdf"), "report.pdf: must end in .html"),
        (("shot.yaml", "shot.yaml", "--picture", "gone.png"), "gone.png: no such file"),
        (
            ("shot.yaml", "far.yaml", "--picture", "photo.png"),
            "'pictures' require shots whose scenes have the same distance_m: those of shot and far differ",
        ),
    ],
)
def test_bad_comparisons_have_one_line(foveasim, folder, arguments, message):
    result = foveasim("compare", *arguments, *FAST, cwd=folder)

    assert result.returncode == 2
    assert message in result.stderr
    assert result.stderr.count("\n") == 1


def test_interrupted_comparison_writes_nothing(foveasim, folder, monkeypatch):
    def interrupt(*_arguments, **_options):
        raise KeyboardInterrupt

    monkeypatch.setattr("foveasim.compare.comparison.quality_by_eccentricity", interrupt)

    result = foveasim("compare", "shot.yaml", "shot.yaml", "-o", "never.html", *FAST, cwd=folder)

    assert result.returncode == 130
    assert "interrupted; nothing was written" in result.stderr
    assert not (folder / "never.html").exists()

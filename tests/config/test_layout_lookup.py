"""Layouts by path or by name: one lookup for the library, the command line and settings files."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import foveasim as fs
from foveasim.config import read_any_layout, read_shot
from foveasim.errors import FileError, ParameterError
from foveasim.layout import bundled_layouts

SHOT = """
scene: {kind: flat, shape: [40, 40], pitch_um: 100, distance_m: 1.0, radiance_w_m2_sr_nm: 0.1, band_width_nm: 10}
optics: {focal_length_mm: 8, f_number: 2.8}
layout: prima_100
exposure_s: 0.01
"""


@pytest.fixture
def two_sites():
    return fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0)


def write_as(layout, path):
    """A layout in a file whose name has no extension."""
    layout.write(path.with_suffix(".npz"))
    path.with_suffix(".npz").rename(path)


def command(*arguments, cwd):
    return subprocess.run(
        [sys.executable, "-m", "foveasim.cli", *arguments], cwd=cwd, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("name", ["giotto_2", "prima_75"])
def test_read_layout_finds_bundled_layouts_by_name(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    layout = fs.read_layout(name)

    assert isinstance(layout, fs.Layout)
    assert np.array_equal(layout.xy_um, read_any_layout(bundled_layouts()[name]).layout.xy_um)


def test_read_layout_reads_files_of_any_format(tmp_path, two_sites):
    two_sites.write(tmp_path / "two.geojson")
    (tmp_path / "two.yaml").write_text("generator: grid\nparameters: {n_x: 2, n_y: 1, pitch_um: 2.0}\n")

    for name in ("two.geojson", "two.yaml"):
        assert np.array_equal(fs.read_layout(tmp_path / name).xy_um, two_sites.xy_um)
    with pytest.raises(ParameterError, match="'layer' is an option of GDSII and OASIS files only, got 3; omit it"):
        fs.read_layout(tmp_path / "two.yaml", layer=3)
    with pytest.raises(ParameterError, match="'cell' is an option of GDSII and OASIS files"):
        fs.read_layout("giotto_2", cell="TOP")


def test_files_precede_bundled_names(tmp_path, monkeypatch, two_sites):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "giotto_1").mkdir()
    write_as(two_sites, tmp_path / "prima_100")

    assert fs.read_layout("prima_100").n_sites == 2
    assert " 2 " in command("describe", "prima_100", cwd=tmp_path).stdout
    # A folder is not a layout.
    assert fs.read_layout("giotto_1").n_sites == 8309


def test_settings_files_search_own_directory_first(tmp_path, monkeypatch, two_sites):
    (tmp_path / "settings").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "settings" / "shot.yaml").write_text(SHOT)
    write_as(two_sites, tmp_path / "elsewhere" / "prima_100")
    monkeypatch.chdir(tmp_path / "elsewhere")

    assert read_shot(tmp_path / "settings" / "shot.yaml").camera.sensor.layout.n_sites == 378
    write_as(two_sites, tmp_path / "settings" / "prima_100")
    assert read_shot(tmp_path / "settings" / "shot.yaml").camera.sensor.layout.n_sites == 2


def test_read_layout_suggests_bundled_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        FileError, match=r"giotto_2: no such file; foveasim.read_layout reads the bundled layout of this"
    ):
        fs.layout.read_layout("giotto_2")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "giotto_3",
            "giotto_3: no such file, and not the name of a bundled layout; did you mean 'giotto_2'? possible: ",
        ),
        ("zzzz", "zzzz: no such file, and not the name of a bundled layout; possible: 'bayer_grid', 'four_zones', "),
        ("giotto_2.yaml", "giotto_2.yaml: no such file; 'giotto_2' is a bundled layout"),
        ("sub/giotto_2", "sub/giotto_2: no such file"),
        ("nowhere.gds", "nowhere.gds: no such file"),
    ],
)
def test_unknown_names_are_rejected_with_the_closest(name, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileError) as caught:
        fs.read_layout(name)
    found = command("check", name, cwd=tmp_path)

    assert str(caught.value).startswith(words)
    assert (found.returncode, found.stderr.strip()) == (2, f"error: {caught.value}")

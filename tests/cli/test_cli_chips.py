"""Commands with a chip that is drawn elsewhere: layers, filters, cell and centre."""

from __future__ import annotations

import re

import numpy as np
import pytest
from PIL import Image

import foveasim as fs

klayout = pytest.importorskip("klayout.db")
pytest.importorskip("gdstk")

#: Photosites of 8 µm at a pitch of 10 µm, far from the origin.
N_X, N_Y, PITCH_UM, CORNER_UM = 6, 4, 10.0, np.array([500.0, -300.0])
#: Filters of each 2 x 2 photosites: R G / G B.
FILTER_LAYERS = {"R": 10, "G": 11, "B": 12}
OPTIONS = ("--layer", "1/0", "--channels", "10/0=R,11/0=G", "--channels", "12/0=B", "--cell", "ARRAY")
SHOT = """
scene: {kind: picture, picture: photo.png, distance_m: 1.0, peak_radiance_w_m2_sr_nm: 0.02}
optics: {focal_length_mm: 8, f_number: 2.8}
layout: {file: chip.gds}
sensor: {filters: rgb}
exposure_s: 0.01
"""


def channel_of(column, row):
    return "RGGB"[2 * (row % 2) + column % 2]


@pytest.fixture
def folder(tmp_path):
    """A chip with photosites, filters and wiring, a second top cell, a photograph, and a shot."""
    chip = klayout.Layout()
    chip.dbu = 0.001
    array = chip.create_cell("ARRAY")
    chip.create_cell("LOGO").shapes(chip.layer(1, 0)).insert(klayout.DBox(0, 0, 900, 900))
    array.shapes(chip.layer(5, 0)).insert(klayout.DBox(480, -320, 600, -310))
    for row in range(N_Y):
        for column in range(N_X):
            x, y = CORNER_UM + PITCH_UM * np.array([column, row])
            array.shapes(chip.layer(1, 0)).insert(klayout.DBox(x, y, x + 8.0, y + 8.0))
            filters = chip.layer(FILTER_LAYERS[channel_of(column, row)], 0)
            array.shapes(filters).insert(klayout.DBox(x - 1.0, y - 1.0, x + 9.0, y + 9.0))
    chip.write(str(tmp_path / "chip.gds"))
    picture = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
    Image.fromarray(picture).save(tmp_path / "photo.png")
    (tmp_path / "shot.yaml").write_text(SHOT)
    return tmp_path


@pytest.fixture
def read():
    """Return a function that checks a layout against the chip as it is drawn."""

    def check(layout, *, is_centred=True):
        centre_um = np.zeros(2) if is_centred else CORNER_UM + [0.5 * (PITCH_UM * n - 2.0) for n in (N_X, N_Y)]
        x0, y0, x1, y1 = layout.bounds_um
        assert layout.n_sites == N_X * N_Y
        np.testing.assert_allclose([0.5 * (x0 + x1), 0.5 * (y0 + y1)], centre_um, atol=1e-9)
        column, row = np.rint((layout.centroid_um - [x0, y0] - 4.0) / PITCH_UM).astype(int).T
        expected = ["RGB".index(channel_of(c, r)) for c, r in zip(column, row, strict=True)]
        assert layout.channel.tolist() == expected

    return check


def succeeded(result):
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.slow
def test_chip_is_converted_and_described(foveasim, folder, read):
    source = [word.replace("--cell", "--source-cell").replace("--layer", "--source-layer") for word in OPTIONS]
    succeeded(foveasim("convert", "chip.gds", "sensor.npz", *source, "--centre", cwd=folder))
    succeeded(foveasim("convert", "chip.gds", "there.npz", *source, cwd=folder))

    read(fs.read_layout(folder / "sensor.npz"))
    read(fs.read_layout(folder / "there.npz"), is_centred=False)
    described = succeeded(foveasim("describe", "chip.gds", *OPTIONS, cwd=folder))
    assert described == succeeded(foveasim("describe", "there.npz", cwd=folder))


def test_chip_is_checked(foveasim, folder):
    (folder / "rules.yaml").write_text("{min_size_um: 7, min_space_um: 3}")
    there = foveasim("check", "chip.gds", *OPTIONS, "--rules", "rules.yaml", cwd=folder)
    centred = foveasim("check", "chip.gds", *OPTIONS, "--centre", "--rules", "rules.yaml", cwd=folder)

    assert (there.returncode, centred.returncode) == (1, 1), there.stderr
    assert there.stdout == centred.stdout
    # Gaps of 2 µm between neighbours, and of 2.8 µm between diagonal ones.
    n_pairs = (N_X - 1) * N_Y + N_X * (N_Y - 1) + 2 * (N_X - 1) * (N_Y - 1)
    assert re.search(rf"min_space_um │ fail +│ +{n_pairs} │", there.stdout)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("is_report", [False, True], ids=["layout", "report"])
def test_chip_is_viewed(foveasim, folder, is_report):
    (folder / "rules.yaml").write_text("{min_size_um: 7}")
    succeeded(foveasim("check", "chip.gds", *OPTIONS, "--rules", "rules.yaml", "--report", "a.lyrdb", cwd=folder))
    viewed = ("a.lyrdb", "--layout", "chip.gds") if is_report else ("chip.gds",)
    succeeded(foveasim("view", *viewed, *OPTIONS, "-o", "page.html", cwd=folder))

    assert f"{N_X * N_Y} photosites" in (folder / "page.html").read_text("utf-8")


@pytest.mark.slow
def test_chip_is_compared_with_other_formats(foveasim, folder):
    """The options of chip files are for the chip; both layouts are centred."""
    grid = fs.layout.grid(n_x=N_X, n_y=N_Y, pitch_um=PITCH_UM).translate(80.0, 0.0)
    fs.layout.write_layout(grid, folder / "grid.npz")
    command = ("compare", "grid.npz", "chip.gds", *OPTIONS, "--centre", "--picture", "photo.png", "--pixels", "32")
    succeeded(foveasim(*command, "--annuli", "2", "-o", "comparison.html", cwd=folder))
    rejected = foveasim("compare", "grid.npz", "prima_100", "--layer", "1/0", cwd=folder)

    assert (folder / "comparison.html").is_file()
    assert (rejected.returncode, rejected.stderr.count("\n")) == (2, 1)
    assert "'layer' is an option of DXF, GDSII and OASIS files only" in rejected.stderr


@pytest.mark.slow
def test_options_are_not_for_other_files(foveasim, folder):
    succeeded(foveasim("run", "shot.yaml", *OPTIONS, "-o", "out", cwd=folder))
    (folder / "short.yaml").write_text(SHOT.replace("{file: chip.gds}", "chip.gds"))
    for command, words in {
        ("view", "out/shot_capture.npz", "--centre"): "'centre' must be omitted: out/shot_capture.npz is a capture",
        ("compare", "shot.yaml", "shot.yaml", "--layer", "1/0"): "'layer' must be omitted for shots",
        ("run", "short.yaml", "--layer", "1/0"): "must be a section, such as {file: chip.gds}, got 'chip.gds'",
    }.items():
        result = foveasim(*command, cwd=folder)
        assert (result.returncode, result.stderr.count("\n")) == (2, 1), result.stderr
        assert words in result.stderr


@pytest.mark.slow
def test_shot_reads_chip(foveasim, folder, read):
    succeeded(foveasim("run", "shot.yaml", *OPTIONS, "--centre", "-o", "out", cwd=folder))

    capture = fs.Capture.load(folder / "out" / "shot_capture.npz")
    read(capture.layout)
    succeeded(foveasim("run", "shot.yaml", *OPTIONS, "-o", "there", cwd=folder))
    # The picture is framed on the photosites, wherever they are.
    assert np.array_equal(fs.Capture.load(folder / "there" / "shot_capture.npz").code, capture.code)
    assert capture.settings["light"]["fit"] == "cover"


def test_studio_reads_chip(foveasim, folder, monkeypatch, read):
    pytest.importorskip("starlette")
    from foveasim.config import build_shot
    from foveasim.studio import _server

    started = []
    monkeypatch.setattr(_server, "serve", lambda studio, *_, **__: started.append(studio.start))
    command = ("studio", "shot.yaml", *OPTIONS, "--centre", "--set", "exposure_s=0.002", "--no-browser")
    succeeded(foveasim(*command, cwd=folder))

    assert started[0].settings["exposure_s"] == 0.002
    read(build_shot(None, started[0].settings).camera.sensor.layout)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--channels", "10/0"), "'channels' must be layers with their channel, such as 10/0=R, got '10/0'"),
        (("--channels", "10/0=R,"), "'channels' must be layers with their channel"),
        (("--layer", "1/0", "--channels", "10/0=Z"), "'Z'"),
        (("--layer", "one"), "'layer' must be a layer, such as (77, 3) or '77/3', got 'one'"),
        (("--layer", "1/0"), "LOGO"),
        (("--layer", "1/0", "--cell", "ARRAYS"), "ARRAY"),
    ],
)
def test_invalid_options_are_one_line(foveasim, folder, options, words):
    result = foveasim("describe", "chip.gds", *options, cwd=folder)

    assert (result.returncode, result.stderr.count("\n")) == (2, 1), result.stderr
    assert words in result.stderr

"""Commands: output, exit codes and files."""

from __future__ import annotations

import errno
import json
import os
import struct
import subprocess
import sys
import zlib
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from programs import run_program

import foveasim as fs
from foveasim import config
from foveasim._io.atomic import atomic_write
from foveasim._io.images import read_picture
from foveasim.config import bundled_layouts
from foveasim.reconstruct.picture import NO_DATA_COLOUR
from foveasim.view import find_renderer

REPOSITORY = Path(__file__).parents[2]

SHOT = """
scene: {kind: picture, picture: photo.png, pitch_um: 100, distance_m: 1.0, peak_radiance_w_m2_sr_nm: 0.2}
optics: {focal_length_mm: 8, f_number: 2.8}
layout: {generator: grid, parameters: {n_x: 20, n_y: 20, pitch_um: 3}}
exposure_s: 0.01
"""


def huge_png(png):
    """Return a small PNG file with 65536 x 65536 pixels in its header and a correct checksum."""
    header = b"IHDR" + struct.pack(">II", 65536, 65536) + png[24:29]
    return png[:12] + header + struct.pack(">I", zlib.crc32(header)) + png[33:]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "shot.yaml").write_text(SHOT)
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 255, (120, 160, 3), np.uint8)).save(tmp_path / "photo.png")
    return tmp_path


@pytest.mark.slow
def test_demo_writes_pictures_and_table(foveasim, tmp_path):
    result = foveasim("demo", "-o", "out", cwd=tmp_path)

    assert result.returncode == 0, result.stderr
    out = tmp_path / "out"
    names = [
        f"{shot}_{what}" for shot in ("four_zones", "foveal") for what in ("capture.npz", "layout.png", "picture.png")
    ]
    if find_renderer() is not None:
        names.append("foveal_3d.png")
    assert sorted(p.name for p in out.iterdir()) == sorted(names)
    assert "Warning" not in result.stdout + result.stderr
    for word in ("9,631", "11,700", "saturated", "optics / s"):
        assert word in result.stdout
    check_upright_picture(out / "foveal", "astronaut", 760.0)


@pytest.mark.slow
def test_run_of_the_paper_fills_its_range(foveasim, tmp_path):
    result = foveasim("run", str(REPOSITORY / "gallery" / "paper_foveal.yaml"), "-o", str(tmp_path), cwd=REPOSITORY)

    assert result.returncode == 0, result.stderr
    assert "Warning" not in result.stdout + result.stderr
    assert "blind-spot radius / µm" in result.stdout
    code = fs.Capture.load(tmp_path / "paper_foveal_capture.npz").code
    assert 200 < np.percentile(code, 95) < 255
    assert np.mean(code == 255) < 0.02
    check_upright_picture(tmp_path / "paper_foveal", "camera", 500.0)
    picture = read_picture(tmp_path / "paper_foveal_picture.png")
    assert (picture[[0, 512], [0, 512]] == NO_DATA_COLOUR).all()  # outside the sensor, and in its blind spot


def check_upright_picture(results, photograph, pitch_um):
    """The picture correlates with the photograph, and not with its mirror images."""
    seen = read_picture(results.with_name(f"{results.name}_picture.png")).astype(float)
    capture = fs.Capture.load(results.with_name(f"{results.name}_capture.npz"))
    photograph = read_picture(str(files("skimage.data") / f"{photograph}.png")).astype(float)
    photograph = photograph.reshape(512, 512, -1)
    # Position of each pixel in the photograph: 8 mm lens at 1 m, axis at the centre.
    cell_um = pitch_um * 8 / (1000 - 8)
    grid, (gaze_x_um, gaze_y_um) = capture.picture(max_pixels=1024).grid, capture.settings["gaze_um"]
    column = np.clip(np.round((grid.x_um + gaze_x_um) / cell_um + 255.5).astype(int), 0, 511)
    row = np.clip(np.round(255.5 - (grid.y_um[::-1] + gaze_y_um) / cell_um).astype(int), 0, 511)
    is_seen = np.any(seen != NO_DATA_COLOUR, axis=2)

    def likeness(picture):
        expected = picture[np.ix_(row, column)]
        return np.corrcoef(seen[..., 0][is_seen], expected[..., 0][is_seen])[0, 1]

    assert likeness(photograph) > 0.9
    assert max(likeness(photograph[::-1]), likeness(photograph[:, ::-1])) < 0.6


@pytest.mark.slow
def test_run_writes_capture_of_settings(foveasim, folder):
    result = foveasim("run", "shot.yaml", "--set", "sensor.bits=12", "--set", "seed=4", "-o", "out", cwd=folder)
    capture = fs.Capture.load(folder / "out" / "shot_capture.npz")

    assert result.returncode == 0, result.stderr
    assert (capture.bits, capture.settings["seed"], capture.layout.n_sites) == (12, 4, 400)
    assert sorted(p.name for p in (folder / "out").iterdir()) == [
        "shot_capture.npz",
        "shot_layout.png",
        "shot_picture.png",
    ]


def test_schema_is_json(foveasim, tmp_path):
    assert json.loads(foveasim("schema", cwd=tmp_path).stdout)["title"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("sensor.bitz=3", "shot.yaml: --set sensor.bitz: unknown parameter of Sensor; did you mean 'bits'?"),
        ("sensor.bits=ten", "shot.yaml: --set sensor.bits: must be a valid integer"),
        ("optics.f_number=0", "shot.yaml: --set optics.f_number: must be > 0, got 0"),
        ("layout.parameters.n_x=0", "shot.yaml: --set layout.parameters.n_x: must be >= 1"),
        ("scene.distance_m=0.002", "shot.yaml: --set scene.distance_m: must be larger than the focal length"),
        ("exposure_s=[1]", "shot.yaml: --set exposure_s: must be a valid number"),
        ("layout={generator: none}", "shot.yaml: --set layout.generator: must be one of"),
    ],
)
def test_invalid_settings_print_one_line(foveasim, folder, change, words):
    result = foveasim("run", "shot.yaml", "--set", change, "-o", "out", cwd=folder)

    assert result.returncode == 2
    assert result.stderr.startswith(f"error: {words}")
    assert result.stderr.count("\n") == 1
    assert not (folder / "out").exists()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda p: p.unlink(), "no such file"),
        (lambda p: p.write_text("I am no picture"), "is not a picture in a supported format"),
        (lambda p: p.write_bytes(b""), "is not a picture in a supported format"),
        (lambda p: p.write_bytes(p.read_bytes()[:20_000]), "is corrupt or truncated"),
        (lambda p: (p.unlink(), p.mkdir()), "is not a file"),
        (lambda p: Image.new("RGB", (9, 9)).save(p, "GIF", save_all=True, append_images=[Image.new("RGB", (9, 9), "red")]), "contains 2 pictures"),
        (lambda p: p.write_bytes(huge_png(p.read_bytes())), "has 65536 x 65536 pixels, more than the limit|has more than"),
    ],
)  # fmt: skip
def test_invalid_picture_prints_one_line(foveasim, folder, spoil, words):
    spoil(folder / "photo.png")
    result = foveasim("run", "shot.yaml", "-o", "out", cwd=folder)

    assert result.returncode == 2
    assert result.stderr.startswith("error: shot.yaml:2:1: scene: photo.png: ")
    assert any(word in result.stderr for word in words.split("|"))
    assert result.stderr.count("\n") == 1
    assert not (folder / "out").exists()


def test_file_as_output_directory_is_rejected(foveasim, folder):
    (folder / "out").write_text("I am a file")
    result = foveasim("run", "shot.yaml", "-o", "out", cwd=folder)

    assert result.returncode == 2
    assert "out: cannot contain results: out is a file; choose a directory" in result.stderr
    assert (folder / "out").read_text() == "I am a file"


LAYOUT = """
generator: log_polar
parameters: {n_sectors: 16, r_min_um: 2.0, r_max_um: 14.5}
rules: {min_size_um: 1.0, max_overlap_um2: 0.0}
source: made for this test
"""


@pytest.fixture
def anywhere(request):
    """Return a function that runs the program in this process, or in one of its own as users do."""
    return run_program if request.param == "program" else request.getfixturevalue("foveasim")


@pytest.mark.slow(keep=("here",))
@pytest.mark.parametrize("anywhere", ["here", "program"], indirect=True)
def test_exit_code_reports_rule_violations(anywhere, foveasim, tmp_path):
    (tmp_path / "rings.yaml").write_text(LAYOUT)
    (tmp_path / "loose.yaml").write_text("min_size_um: 0.1\n")
    broken = anywhere("check", "rings.yaml", "--report", "rings.lyrdb", cwd=tmp_path)
    kept = foveasim("check", "rings.yaml", "--rules", "loose.yaml", cwd=tmp_path)

    assert broken.returncode == 1
    assert "fail" in broken.stdout
    assert (tmp_path / "rings.lyrdb").read_text().count("<item>") == 16
    assert kept.returncode == 0, kept.stderr
    assert "pass" in kept.stdout


def test_converted_gds_file_is_checked(foveasim, tmp_path):
    (tmp_path / "rings.yaml").write_text(LAYOUT)
    (tmp_path / "rules.yaml").write_text("min_size_um: 1.0\n")
    converted = foveasim("convert", "rings.yaml", "rings.gds", "--dbu-um", "0.001", cwd=tmp_path)
    checked = foveasim("check", "rings.gds", "--rules", "rules.yaml", cwd=tmp_path)

    assert converted.returncode == 0, converted.stderr
    assert "vertices moved by at most 0.000" in converted.stdout
    assert checked.returncode == 1
    assert "80 photosites" in checked.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("check", "rings.gds"), "rings.gds: no such file"),
        (("check", "bare.yaml"), "bare.yaml: contains no design rules"),
        (("check", "rings.yaml", "--rules", "none.yaml"), "none.yaml: no such file"),
        (
            ("check", "rings.yaml", "--rules", "wrong.yaml"),
            "wrong.yaml:1:1: min_sise_um: unknown parameter of DesignRules; did you mean 'min_size_um'?",
        ),
        (("convert", "rings.yaml", "rings.docx"), "rings.docx: "),
        (("convert", "wrong.gds", "rings.npz"), "wrong.gds: is not a valid layout file"),
    ],
)
def test_invalid_layout_files_print_one_line(foveasim, tmp_path, arguments, words):
    (tmp_path / "rings.yaml").write_text(LAYOUT)
    (tmp_path / "bare.yaml").write_text("generator: grid\nparameters: {n_x: 3, n_y: 3, pitch_um: 2.0}\n")
    (tmp_path / "wrong.yaml").write_text("min_sise_um: 1.0\n")
    (tmp_path / "wrong.gds").write_text("I am no layout")
    result = foveasim(*arguments, cwd=tmp_path)

    assert result.returncode == 2
    assert result.stderr.startswith(f"error: {words}")
    assert result.stderr.count("\n") == 1


SMALL_SHOT = """scene: {kind: flat, shape: [40, 40], pitch_um: 300, distance_m: 1.0, illuminance_lux: 500}
optics: {focal_length_mm: 8, f_number: 2.8}
layout: {generator: grid, parameters: {n_x: 9, n_y: 9, pitch_um: 5}}
exposure_s: 0.01
"""


@pytest.mark.parametrize("failing", ["Picture.save", "Capture.save"])
def test_run_writes_all_files_or_none(foveasim, tmp_path, monkeypatch, failing):
    (tmp_path / "shot.yaml").write_text(SMALL_SHOT)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "shot_picture.png").write_bytes(b"of an earlier run")

    def full(_, path, *_arguments, **_options):
        with atomic_write(path):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr({"Picture.save": fs.reconstruct.Picture, "Capture.save": fs.Capture}[failing], "save", full)
    result = foveasim("run", "shot.yaml", cwd=tmp_path)

    assert result.returncode == 2
    name = {"Picture.save": "picture.png", "Capture.save": "capture.npz"}[failing]
    assert result.stderr == f"error: out/shot_{name}: cannot be written: No space left on device\n"
    assert [path.read_bytes() for path in (tmp_path / "out").iterdir()] == [b"of an earlier run"]


def test_gaze_path_of_one_capture_is_rejected(foveasim, tmp_path):
    (tmp_path / "shot.yaml").write_text(SMALL_SHOT)
    result = foveasim("run", "shot.yaml", "--set", "gaze_path=[[0, 0, 0], [1, 5, 0]]", cwd=tmp_path)

    assert result.returncode == 2
    assert result.stderr == "error: --set gaze_path: only videos follow a path; use gaze_um, or foveasim video\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("layout", "radius"),
    [
        (
            "{generator: log_polar, parameters: {n_sectors: 32, r_min_um: 10, r_max_um: 40}, move_um: [5.0, 3.0]}",
            "10.00",
        ),
        ("{generator: giotto, parameters: {n_rho: 6, n_theta: 16, n_fovea: 3, n_across: 16, unit_um: 4}}", "none"),
        ("{generator: fovi, parameters: {fov_um: 80, a_um: 10, n_rings: 5}}", "none"),
        ("{generator: grid, parameters: {n_x: 9, n_y: 9, pitch_um: 5}}", "none"),
    ],
)
def test_blind_spot_is_central_hole_only(foveasim, tmp_path, monkeypatch, layout, radius):
    monkeypatch.setattr(sys.modules[config.run_shot.__module__], "write_results", lambda *_: ([], 0.0))
    scene = (
        "{kind: flat, shape: [400, 400], pitch_um: 100, distance_m: 1.0, radiance_w_m2_sr_nm: 0.1, band_width_nm: 10}"
    )
    (tmp_path / "shot.yaml").write_text(
        f"scene: {scene}\noptics: {{focal_length_mm: 8, f_number: 2.8}}\nlayout: {layout}\nexposure_s: 0.01\n"
    )
    line = next(row for row in foveasim("run", "shot.yaml", cwd=tmp_path).stdout.splitlines() if "blind-spot" in row)

    assert line.split("│")[2].strip() == radius


def test_layouts_lists_bundled_layouts(foveasim, tmp_path, monkeypatch):
    small, read, large = tmp_path / "small.yaml", config.read_layout_file, {"bayer_grid", "giotto_2", "pixirad_1"}
    monkeypatch.setattr(config, "read_layout_file", lambda path: read(small if path.stem in large else path))
    small.write_text("generator: grid\nparameters: {n_x: 111, n_y: 37, pitch_um: 2.0}\n")
    result = foveasim("layouts", cwd=tmp_path)

    assert result.returncode == 0, result.stderr
    assert all(name in result.stdout for name in bundled_layouts())
    rows = [row.split() for row in result.stdout.splitlines()]
    assert ["pixirad_1", "4,107", "222", "x", "74", "2", "grid"] in rows
    assert ["four_zones", "13,312"] in [row[:2] for row in rows]
    printed = " ".join(result.stdout.split())
    for path in bundled_layouts().values():
        first_line = path.read_text(encoding="utf-8").splitlines()[0]
        assert " ".join(first_line.removeprefix("# ").split()[:4]) in printed


def test_describe_prints_counts_and_data_rate(foveasim, tmp_path):
    fs.layout.zones(side_um=(64, 128), pitch_um=(1, 2)).write(tmp_path / "two.npz")
    by_file = foveasim("describe", "two.npz", cwd=tmp_path)
    by_name = foveasim("describe", "four_zones", "--fps", "30", "--bits", "10", "--blanking", "0.2", cwd=tmp_path)

    assert by_file.returncode == by_name.returncode == 0
    assert all(text in by_file.stdout for text in ("7,168", "100 %", "4,096", "3,072", "zones"))
    assert all(text in by_name.stdout for text in ("13,312", "100 % of the convex hull", "4.792 Mbit/s", "4 to 32 µm"))
    assert by_name.stdout.startswith("Four nested square zones whose pitch doubles outwards")


def test_describe_rejects_invalid_options(foveasim, tmp_path):
    gone = foveasim("describe", "gone.gds", cwd=tmp_path)
    bad = foveasim("describe", "four_zones", "--fps", "-1", cwd=tmp_path)

    assert (gone.returncode, bad.returncode) == (2, 2)
    assert gone.stderr.strip() == "error: gone.gds: no such file"
    assert bad.stderr.startswith("error: 'frames_per_s' must be > 0, got -1.0")


def test_bundled_layouts_are_found_by_name(foveasim, tmp_path):
    checked = foveasim("check", "prima_100", cwd=tmp_path)
    converted = foveasim("convert", "prima_100", "prima.gds", cwd=tmp_path)

    assert checked.returncode == 0, checked.stderr
    assert converted.returncode == 0, converted.stderr
    assert fs.layout.read_layout(tmp_path / "prima.gds").n_sites == 378


def test_convert_writes_layer_map(foveasim, tmp_path):
    (tmp_path / "map.yaml").write_text("photosite: 77/3\nwell: {layer: 20/0, inset_um: 2.0}\n")
    named = foveasim("convert", "prima_100", "a.gds", "--layers", "map.yaml", "--layer", "microlens=30/1", cwd=tmp_path)
    again = foveasim("convert", "a.gds", "b.npz", "--source-layer", "20/0", "--source-cell", "SENSOR", cwd=tmp_path)
    plain = foveasim("convert", "prima_100", "c.gds", "--layer", "77/3", cwd=tmp_path)

    for result in (named, again, plain):
        assert result.returncode == 0, result.stderr
    outline, well = fs.read_layout(tmp_path / "c.gds", layer=(77, 3)), fs.read_layout(tmp_path / "b.npz")
    assert outline.n_sites == well.n_sites == fs.read_layout(tmp_path / "a.gds", layer="30/1").n_sites == 378
    assert (well.area_um2 < outline.area_um2).all()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--layer", "wel=2", "--layer", "photosite=1"), "got 'wel'; did you mean 'well'?"),
        (("--layer", "2", "--layer", "well=1"), "'layer' must have a name in a layer map, got '2'; photosite=2"),
        (("--layer", "one"), "'layer' must be a layer, such as (77, 3) or '77/3', got 'one'"),
        (("--layers", "none.yaml"), "none.yaml: no such file"),
        (("--source-layer", "3"), "'layer' is an option of DXF, GDSII and OASIS files only"),
    ],
)
def test_convert_rejects_invalid_layers(foveasim, tmp_path, arguments, words):
    result = foveasim("convert", "prima_100", "a.gds", *arguments, cwd=tmp_path)

    assert result.returncode == 2
    assert words in result.stderr
    assert result.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_convert_reports_dropped_columns(foveasim, tmp_path):
    result = foveasim("convert", "prima_75", "prima.svg", cwd=tmp_path)

    assert result.returncode == 0, result.stderr
    assert "dropped columns: column, readout_line, row" in result.stdout


def test_short_option_prints_help(foveasim, tmp_path):
    short, long = (foveasim("run", option, cwd=tmp_path) for option in ("-h", "--help"))
    assert short.returncode == 0
    assert short.stdout == long.stdout != ""


def test_shell_completion_suggests_commands(tmp_path):
    environment = {**os.environ, "_FOVEASIM_COMPLETE": "complete_bash", "COMP_WORDS": "foveasim s", "COMP_CWORD": "1"}
    program = Path(sys.executable).with_name("foveasim")
    result = subprocess.run([program], env=environment, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert result.stdout.split() == ["studio", "sweep", "study", "schema"]

"""What the command line prints of names from outside: as they are, on one line, on any terminal."""

from __future__ import annotations

import json
import os
import re

import numpy as np
import pytest
import yaml
from PIL import Image
from programs import run_programs

import foveasim as fs

#: What rich would take for markup: an end tag that ends in an error, a style, a link, an emoji.
MARKUP = ("[/evil]", "[red][link=x]:smile:")
SHOT = {
    "scene": {
        "kind": "flat",
        "shape": [60, 60],
        "pitch_um": 300.0,
        "distance_m": 1.0,
        "radiance_w_m2_sr_nm": 0.1,
        "band_width_nm": 100.0,
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {
        "generator": "grid",
        "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 3.0},
        "rules": {"min_size_um": 1.0},
    },
    "exposure_s": 0.0001,
}
#: An ASCII-only terminal, as in a container without locales, whatever Python would make of it.
ASCII = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii:strict", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


def is_clean(result):
    return result.returncode >= 0 and "Traceback" not in str(result.stderr + result.stdout)


@pytest.fixture(params=MARKUP, ids=["end", "style"])
def marked(request, tmp_path):
    """A directory with files of the name, and the name as column, provenance and settings key in them."""
    name = request.param
    parent = tmp_path / f"a{name.replace('/', '')}"
    parent.mkdir()
    if "/" in name:  # as a path: the directory "[" and the file "evil]"
        (parent / name).parent.mkdir()
    layout = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0)
    columns = {**layout.columns, name: np.arange(16)}
    fs.Layout(layout.xy_um, layout.ring_offsets, layout.site_offsets, columns, {"generator": name, name: name}).write(
        parent / f"{name}.npz"
    )
    (parent / f"{name}.yaml").write_text(yaml.safe_dump(SHOT))
    (parent / "key.yaml").write_text(yaml.safe_dump({**SHOT, name: 1}))
    return parent, name


def test_describe_prints_provenance_as_it_is(foveasim, marked):
    folder, name = marked
    result = foveasim("describe", f"{name}.npz", cwd=folder)

    assert result.returncode == 0, result.stderr
    assert re.search(rf"origin\s+{re.escape(name)}\s", result.stdout)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("environment", [{}, {"FORCE_COLOR": "1", "TERM": "xterm"}], ids=["pipe", "terminal"])
def test_run_prints_names_as_they_are(foveasim, marked, environment):
    folder, name = marked
    result = foveasim("run", f"{name}.yaml", "-o", f"out{name}", cwd=folder, **environment)

    assert result.returncode == 0, result.stderr
    stem = name.rsplit("/", 1)[-1]
    assert f"wrote out{name}/{stem}_capture.npz" in result.stdout
    assert re.search(rf" {re.escape(stem)}( |:|\x1b)", result.stdout)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("arguments", "code", "printed"),
    [
        (("check", "{}.npz", "--rules", "sky130_met1", "--report", "{}.lyrdb"), (0, 1), "wrote {}.lyrdb"),
        (("check", "{}.npz"), (2,), "error: {}.npz: contains no design rules"),
        (("check", "{}.npz", "--rules", "{}"), (2,), "error: {}: "),
        (("convert", "{}.npz", "{}.svg"), (0,), "wrote {}.svg"),
        (("convert", "{}.npz", "{}.svg"), (0,), "dropped columns: {}, "),  # the column that is lost
        (("convert", "{}.npz", "out.{}"), (2,), "error: out.{}"),
        (("view", "{}.npz", "--out", "{}.html"), (0,), "wrote {}.html"),
        (("view", "{}"), (2,), "error: {}: no such"),
        (("describe", "{}"), (2,), "error: {}: no such"),
        (("run", "{}.yaml", "--set", "{}.=1"), (2,), "{}"),
        (("run", "key.yaml"), (2,), "{}: unknown key"),
        (("run", "{}.yaml", "--set", "layout.generator={}"), (2,), "{}"),
        (("sweep", "{}.yaml"), (2,), "error: {}.yaml:1:1: "),
        (("study", "{}.yaml"), (2,), "error: {}.yaml:1:1: "),
        (("dataset", "{}.yaml"), (2,), "error: {}.yaml:1:1: "),
        (("video", "{}.yaml", "--frames", "{}"), (2,), "error: {}: no such"),
        (("schema", "{}"), (2,), "'{}'"),
        (("sweep", "{}.yaml", "--workers", "{}"), (2,), "Invalid"),
        (("{}",), (2,), "{}"),
    ],
    ids=lambda value: " ".join(value)[:40] if isinstance(value, tuple) and isinstance(value[0], str) else None,
)
def test_commands_print_names_as_they_are(foveasim, marked, arguments, code, printed):
    folder, name = marked
    result = foveasim(*(argument.replace("{}", name) for argument in arguments), cwd=folder)

    assert is_clean(result)
    assert result.returncode in code
    assert printed.replace("{}", name) in (result.stdout + result.stderr)


def test_report_and_summary_print_markup_literally():
    from rich.console import Console

    layout = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0)
    layout = fs.Layout(layout.xy_um, layout.ring_offsets, layout.site_offsets, {}, {"generator": "[/evil]"})
    console = Console(record=True, width=120, force_terminal=False)
    console.print(layout.describe())
    console.print(layout.check(fs.DesignRules(min_size_um=3.0)))
    text = console.export_text()

    assert "[/evil]" in text
    assert "fail" in text
    assert "[red]" not in text


def test_control_characters_are_escaped(foveasim, tmp_path):
    name = "a\x1b[31m\n\u202eb.yaml"
    (tmp_path / name).write_text("{}")
    for command in ("run", "check", "describe", "sweep", "study", "dataset", "view"):
        result = foveasim(command, name, cwd=tmp_path)

        assert result.returncode == 2, command
        assert result.stderr.startswith(r"error: a\x1b[31m\n\u202eb.yaml: "), command
        assert result.stderr.count("\n") == 1


@pytest.mark.slow
def test_names_outside_utf8_are_escaped(tmp_path):
    name = os.fsdecode(b"$caf\xe9$^.yaml")
    (tmp_path / name).write_text(yaml.safe_dump(SHOT))
    capture = os.fsdecode(b"out/$caf\xe9$^_capture.npz")
    ran, failed, viewed = run_programs(
        ("run", name, "-o", "out"),
        ("describe", name + "x"),
        ("view", capture, "--out", "page.html"),
        cwd=tmp_path,
        COLUMNS="200",
    )

    assert ran.returncode == 0, ran.stderr
    assert rb"wrote out/$caf\udce9$^_capture.npz" in ran.stdout
    assert (tmp_path / "out" / os.fsdecode(b"$caf\xe9$^_capture.npz")).is_file()
    assert viewed.returncode == 0, viewed.stderr
    assert failed.stderr == rb"error: $caf\udce9$^.yamlx: no such file; did you mean '$caf\udce9$^.yaml'?" + b"\n"


#: Commands with their exit codes, and what they print on an ASCII-only terminal; those that compute, and the others.
ON_ASCII = {
    "texts": [
        (("layouts",), 0, b"field / um"),
        (("check", "rings.yaml"), 1, b"fail"),
        (("convert", "rings.yaml", "rings.svg"), 0, b"moved by at most 6.4e-05 um"),
        (("view", "shot.yaml", "--out", "page.html"), 2, b"error: shot.yaml"),
        (("describe", "\u00e9\u00b5.yaml"), 2, b"error: "),
        (("--help",), 0, b"Usage"),
        (("run", "--help"), 0, b"Usage"),
        (("run", "--bad"), 2, b"Usage"),
        (("schema",), 0, b"title"),
    ],
    "results": [
        (("describe", "four_zones"), 0, b"mm2"),
        (("run", "shot.yaml", "-o", "out"), 0, b"smallest site / um"),
        (("video", "picture.yaml", "--frames", "frames", "-o", "seen.gif"), 0, b"2 frames"),
    ],
}
#: The list of all bundled layouts takes seconds.
FEW_LAYOUTS = """
from foveasim import config

few = {name: path for name, path in config.bundled_layouts().items() if name.startswith("prima")}
config.bundled_layouts = lambda: few
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ON_ASCII)
def test_ascii_terminals_get_plain_characters(tmp_path, kind):
    rings = {"generator": "log_polar", "parameters": {"n_sectors": 16, "r_min_um": 2.0, "r_max_um": 20.0}}
    (tmp_path / "rings.yaml").write_text(yaml.safe_dump({**rings, "rules": {"min_size_um": 1.0}}))
    (tmp_path / "shot.yaml").write_text(yaml.safe_dump(SHOT))
    scene = {
        "kind": "picture",
        "picture": "frames/0.png",
        "pitch_um": 100.0,
        "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 0.1,
    }
    (tmp_path / "picture.yaml").write_text(yaml.safe_dump({**SHOT, "scene": scene}))
    (tmp_path / "frames").mkdir()
    for k in range(2):
        Image.new("RGB", (60, 60), (90 * k, 9, 9)).save(tmp_path / "frames" / f"{k}.png")
    commands = [arguments for arguments, _, _ in ON_ASCII[kind]]
    results = run_programs(*commands, cwd=tmp_path, before=FEW_LAYOUTS, COLUMNS="200", **ASCII)

    for (arguments, code, printed), result in zip(ON_ASCII[kind], results, strict=True):
        assert is_clean(result), (arguments, result.stderr)
        assert result.returncode == code, (arguments, result.stderr)
        assert printed in result.stdout + result.stderr, arguments
        assert (result.stdout + result.stderr).isascii(), arguments


def test_spinner_is_plain_on_ascii_terminals():
    import io

    from foveasim._io.terminal import PlainConsole, select_spinner

    ascii_file = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    utf8_file = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")

    assert (select_spinner(PlainConsole(file=ascii_file)), select_spinner(PlainConsole(file=utf8_file))) == (
        "line",
        "dots",
    )


def test_settings_in_messages_are_short(foveasim, tmp_path):
    shot = json.loads(json.dumps(SHOT))
    shot["sensor"] = {"bits": "x" * 100_000, "y" * 100_000: 1}
    (tmp_path / "shot.yaml").write_text(yaml.safe_dump(shot))
    result = foveasim("run", "shot.yaml", cwd=tmp_path)

    assert result.returncode == 2
    assert len(result.stderr) < 1000


@pytest.mark.parametrize(
    ("arguments", "printed"),
    [
        (("run", "shot.yaml", "--threads", "9" * 30), "error: 'n_threads' must be <= 4096"),
        (("video", "picture.yaml", "--frames", "frames", "--stop", "9" * 30), "error: 'stop' must be <= "),
        (("dataset", "dataset.yaml"), "error: dataset.yaml:1:1: 'cameras' must be <= 1000000000"),
        (("study", "study.yaml"), "error: study.yaml:4:3: "),
        (("check", "x" * 5000), "must have names of at most 255 bytes"),
    ],
    ids=lambda value: " ".join(value)[:30] if isinstance(value, tuple) else None,
)
def test_absurd_numbers_end_in_one_line(foveasim, tmp_path, arguments, printed):
    scene = {"kind": "picture", "pitch_um": 300.0, "distance_m": 1.0, "peak_radiance_w_m2_sr_nm": 0.1}
    scene["wavelength_nm"] = [620, 550, 450]
    taken = {**SHOT, "scene": {**scene, "picture": "frames/0.png"}}
    drawn = {"pictures": "frames", "shot": "picture.yaml", "cameras": 10**400}
    search = {"sensor.bits": {"from": 1, "to": 10**400}}
    studied = {"shot": "shot.yaml", "search": search, "objectives": {"n_sites": "maximize"}, "trials": 1}
    files = {"shot": SHOT, "picture": taken, "dataset": drawn, "study": studied}
    for name, data in files.items():
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(data))
    (tmp_path / "frames").mkdir()
    Image.new("RGB", (60, 60)).save(tmp_path / "frames" / "0.png")
    result = foveasim(*arguments, cwd=tmp_path)

    assert result.returncode == 2
    assert printed in result.stderr
    assert result.stderr.count("\n") == 1
    assert len(result.stderr) < 1500

"""Messages about wrong names: one line with the position, the closest name and the possible names."""

from __future__ import annotations

import inspect
import json
import os
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

import foveasim as fs
from foveasim import explore
from foveasim._core.names import MAX_LISTED, OTHER_TERMS, closest_name, list_names, missing_path, possible_names
from foveasim.config import Source, build_shot, read_any_layout, read_rules, read_shot
from foveasim.errors import ConfigError, FoveasimError
from foveasim.layout import LAYOUTS

SHOT = """\
scene:
  kind: flat
  shape: [20, 20]
  pitch_um: 100.0
  distance_m: 1.0
  radiance_w_m2_sr_nm: 0.1
  band_width_nm: 10.0
optics: {focal_length_mm: 8.0, f_number: 4.0}
layout:
  generator: grid
  parameters: {n_x: 3, n_y: 3, pitch_um: 3.0}
sensor:
  bits: 10
exposure_s: 0.01
"""
GRID = fs.layout.grid(n_x=3, n_y=3, pitch_um=3.0)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shot.yaml").write_text(SHOT)
    (tmp_path / "chip.yaml").write_text("generator: hexagonal\nparameters: {n_columns: 3, n_rows: 3, pitch_um: 3.0}\n")
    (tmp_path / "qe.csv").write_text("wavelength_nm,red,green\n500,0.1,0.2\n600,0.2,0.3\n")
    (tmp_path / "photos").mkdir()
    Image.new("L", (4, 4)).save(tmp_path / "photos" / "cat.png")
    GRID.write(tmp_path / "chip.gds")
    return tmp_path


def changed(old, new):
    assert old in SHOT
    Path("shot.yaml").write_text(SHOT.replace(old, new))


def shot_with(old, new, *changes):
    changed(old, new)
    return read_shot("shot.yaml", changes)


def file_with(name, text, read):
    Path(name).write_text(text)
    return read(name)


SWEEP = "shot: shot.yaml\nvary:\n  sensor.bits: [8, 10]\n"
STUDY = "shot: shot.yaml\nsearch:\n  sensor.bits: [8, 10]\nobjectives: {snr: maximize}\ntrials: 2\n"
DATASET = "shot: shot.yaml\npictures: photos\n"

#: Wrong inputs, and the beginning of the line that they give.
WRONG = {
    "parameter of a layout": (
        lambda: shot_with("pitch_um: 3.0", "pich_um: 3.0"),
        "shot.yaml:11:32: layout.parameters.pich_um: unknown parameter of grid; did you mean 'pitch_um'? possible: 'n_x', ",
    ),
    "term of another program": (
        lambda: file_with("ring.yaml", "generator: hexagonal\nparameters: {n_columns: 3,\n  n_rows: 3, pixel_size: 3.0}", read_any_layout),
        "ring.yaml:3:14: parameters.pixel_size: unknown parameter of hexagonal; did you mean 'pitch_um'? possible: ",
    ),
    "gap": (
        lambda: shot_with("pitch_um: 3.0", "pitch_um: 3.0, gap_um: 0.1"),
        "shot.yaml:11:47: layout.parameters.gap_um: unknown parameter of grid; did you mean 'trench_um'? possible: 'n_x', ",
    ),
    "name without similar ones": (
        lambda: shot_with("pitch_um: 3.0", "colour_um: 3.0"),
        "shot.yaml:11:32: layout.parameters.colour_um: unknown parameter of grid; possible: 'n_x', 'n_y', 'pitch_um', ",
    ),
    "section of a shot": (
        lambda: shot_with("exposure_s", "exposure"),
        "shot.yaml:14:1: exposure: unknown key; did you mean 'exposure_s'? possible: 'scene', 'optics', ",
    ),
    "generator": (
        lambda: shot_with("generator: grid", "generator: gird"),
        "shot.yaml:10:3: layout.generator: must be one of ",
    ),
    "kind of a section": (
        lambda: shot_with("kind: flat", "kind: flatt"),
        "shot.yaml:2:3: scene.kind: must be one of 'picture', 'panorama', ",
    ),
    "choice": (
        lambda: shot_with("f_number: 4.0", "f_number: 4.0, padding: reflekt"),
        re.compile(r".*shot.yaml:8:47: optics.padding: must be one of .*'zero', .* got .reflekt.; did you mean 'reflect'.$"),
    ),
    "value": (lambda: shot_with("bits: 10", "bits: 99"), "shot.yaml:13:3: sensor.bits: must be <= 16, got 99"),
    "change": (
        lambda: read_shot("shot.yaml", ["sensor.bitz=3"]),
        "shot.yaml: --set sensor.bitz: unknown parameter of Sensor; did you mean 'bits'? possible: ",
    ),
    "value of a change": (
        lambda: read_shot("shot.yaml", ["optics.f_number=0.1"]),
        "shot.yaml: --set optics.f_number: must be >= 0.5, got 0.1",
    ),
    "section of a change": (
        lambda: read_shot("shot.yaml", ["optic.f_number=4"]),
        "shot.yaml: --set optic.f_number: unknown key; did you mean 'optics'? possible: ",
    ),
    "anchor": (
        lambda: shot_with("bits: 10", "bits: &bits 10"),
        "shot.yaml:13:9: is not valid YAML for settings: anchors and aliases are not allowed; repeat the values",
    ),
    "YAML": (lambda: shot_with("bits: 10", "bits: [10"), "shot.yaml:14:11: is not YAML: "),
    "layout file of a shot": (
        lambda: shot_with(SHOT[SHOT.index("layout:") : SHOT.index("sensor:")], "layout: chop.yaml\n"),
        "shot.yaml:9:1: layout: chop.yaml: no such file; did you mean 'chip.yaml'?",
    ),
    "key in the layout file of a shot": (
        lambda: (
            file_with("chip.yaml", "generator: grid\nparametres: {}\n", str),
            shot_with(SHOT[SHOT.index("layout:") : SHOT.index("sensor:")], "layout: chip.yaml\n"),
        ),
        "shot.yaml:9:1: layout: chip.yaml:2:1: parametres: unknown key; did you mean 'parameters'? possible: ",
    ),
    "settings from Python": (
        lambda: build_shot(None, yaml.safe_load(SHOT.replace("bits", "bitz"))),
        "sensor.bitz: unknown parameter of Sensor; did you mean 'bits'? possible: ",
    ),
    "rule": (
        lambda: file_with("rules.yaml", "min_width_um: 1.0\nmin_sise_um: 2.0\n", read_rules),
        "rules.yaml:2:1: min_sise_um: unknown parameter of DesignRules; did you mean 'min_size_um'? possible: ",
    ),
    "preset of rules": (
        lambda: read_rules("sky130_met"),
        "sky130_met: no such file, and not the name of a preset; did you mean 'sky130_met1'? possible: ",
    ),
    "waiver": (
        lambda: fs.DesignRules(waivers={"min_sise_um": "small"}),
        "'waivers' must have names of rules as keys, got 'min_sise_um'; did you mean 'min_size_um'? possible: ",
    ),
    "setting of a sweep": (
        lambda: file_with("sweep.yaml", SWEEP.replace("bits", "bitz"), explore.read_sweep),
        "sweep.yaml:3:17: vary.sensor.bitz: unknown parameter of Sensor; did you mean 'bits'? possible: ",
    ),
    "value of a sweep": (
        lambda: file_with("sweep.yaml", SWEEP.replace("10]", "10.5]"), explore.read_sweep),
        "sweep.yaml:3:20: vary.sensor.bits: must be a valid integer, got 10.5",
    ),
    "point of a sweep": (
        lambda: file_with("sweep.yaml", "shot: shot.yaml\npoints:\n- {seed: 1}\n- {sed: 2}\n", explore.read_sweep),
        "sweep.yaml:2:1: 'points' must all have the settings seed",
    ),
    "key of a sweep": (
        lambda: file_with("sweep.yaml", SWEEP.replace("vary", "varry"), explore.read_sweep),
        "sweep.yaml:2:1: varry: unknown key; did you mean 'vary'? possible: 'shot', 'set', 'vary', ",
    ),
    "shot of a sweep": (
        lambda: file_with("sweep.yaml", SWEEP.replace("shot.yaml", "shots.yaml"), explore.read_sweep),
        "sweep.yaml:1:1: with shots.yaml: no such file; did you mean 'shot.yaml'?",
    ),
    "key in the shot of a sweep": (
        lambda: (changed("n_y", "ny"), file_with("sweep.yaml", SWEEP, explore.read_sweep)),
        "sweep.yaml:1:1: with shot.yaml:11:24: layout.parameters.ny: unknown parameter of grid; did you mean 'n_y'? possible: ",
    ),
    "replaced setting of a sweep": (
        lambda: file_with("sweep.yaml", SWEEP + "set:\n  optics.fnumber: 2.0\n", explore.read_sweep),
        "sweep.yaml:5:3: set.optics.fnumber: unknown parameter of Optics; did you mean 'f_number'? possible: ",
    ),
    "metric": (
        lambda: file_with("sweep.yaml", SWEEP + "metrics: [snrr]\n", explore.read_sweep),
        "sweep.yaml:4:1: 'metrics' must be names of metrics, got 'snrr'; did you mean 'snr'? possible: ",
    ),
    "objective": (
        lambda: file_with("study.yaml", STUDY.replace("snr", "n_site"), explore.read_study),
        re.compile(r".*study.yaml:4:1: 'objectives' must be results of .*, got 'n_site'; did you mean 'n_sites'. possible: "),
    ),
    "direction": (
        lambda: file_with("study.yaml", STUDY.replace("maximize", "maximise"), explore.read_study),
        "study.yaml:4:14: objectives.snr: must be one of 'maximize', 'minimize', got \"maximise\"; did you mean 'maximize'?",
    ),
    "key of a search range": (
        lambda: file_with("study.yaml", STUDY.replace("[8, 10]", "{from: 8, too: 10}"), explore.read_study),
        "study.yaml:3:26: search.sensor.bits.too: unknown key; did you mean 'to'? possible: 'from', 'to', 'step', 'spacing'",
    ),
    "scene of a dataset": (
        lambda: file_with("data.yaml", DATASET, explore.read_dataset),
        "data.yaml:1:1: with shot.yaml:2:3: scene.kind: must be 'picture' for a dataset",
    ),
    "pictures of a dataset": (
        lambda: file_with("data.yaml", DATASET.replace("photos", "photo"), explore.read_dataset),
        re.compile(r".*/photo: no such file or directory; did you mean 'photos'\?"),
    ),
    "empty pictures of a dataset": (
        lambda: file_with("data.yaml", DATASET.replace("photos", '""'), explore.read_dataset),
        "data.yaml:2:1: pictures: must name a directory, a zip file, an array (.npy) or pictures",
    ),
    "picture of scikit-image": (
        lambda: file_with("data.yaml", DATASET.replace("photos", "[skimage:astronut]"), explore.read_dataset),
        "data.yaml:2:12: pictures.0: scikit-image does not contain 'astronut'; did you mean 'astronaut'? possible: ",
    ),
    "distribution": (
        lambda: explore.parse_distribution("exposure_s", {"unifrom": [1.0, 2.0]}),
        "'exposure_s' must have exactly one distribution (",
    ),
    "column of a plot": (
        lambda: GRID.plot("aera_um2"),
        "'by' must be the name of a column, got 'aera_um2'; did you mean 'area_um2'? possible: 'area_um2', 'channel', ",
    ),
    "column of a layout": (
        lambda: GRID.sort_by("rwo"),
        "'keys' must be values or columns of the layout, got 'rwo'; did you mean 'row'? possible: 'column', ",
    ),
    "bundled layout": (
        lambda: fs.read_layout("giotto_3"),
        "giotto_3: no such file, and not the name of a bundled layout; did you mean 'giotto_2'? possible: ",
    ),
    "file": (lambda: fs.read_layout("chpi.gds"), "chpi.gds: no such file; did you mean 'chip.gds'?"),
    "directory": (
        lambda: fs.read_layout("foto/cat.gds"),
        "foto/cat.gds: no such file; there is no directory 'foto'; did you mean 'photos'?",
    ),
    "cell": (lambda: fs.read_layout("chip.gds", cell="SENSR"), "chip.gds: has no cell 'SENSR'; did you mean 'SENSOR'? possible: "),
    "option of a format": (
        lambda: fs.read_layout("chip.gds", layr=1),
        "'layr' is not an option of any format, got 1; did you mean 'layer'? possible: ",
    ),
    "extension of a layout": (
        lambda: GRID.write("chip.gdss"),
        "chip.gdss: must end in one of .gds, .gdsii, .geojson, ",
    ),
    "column of a table": (
        lambda: shot_with("bits: 10", "qe: {kind: file, path: qe.csv, column: gren}"),
        "shot.yaml:13:3: sensor.qe: qe.csv: has no column 'gren'; did you mean 'green'? possible: 'red', 'green', or 1 to 2",
    ),
    "effect": (
        lambda: fs.Sensor(GRID, disabled=["raed"]),
        "'disabled' must contain names of effects, got 'raed'; did you mean 'read'? possible: ",
    ),
    "kind of a schema": (
        lambda: explore.schema_of("shto"),
        "'kind' must be one of 'shot', 'layout', 'rules', 'sweep', 'study', 'dataset', got 'shto'; did you mean 'shot'?",
    ),
}  # fmt: skip


#: Numbers that would overflow, and the beginning of the line that they give.
ABSURD = {
    "optics.zernike={coefficients: {4: 1.0e+308}}": "optics.zernike.coefficients[4]: must be <= 100000 everywhere",
    "optics.zernike={coefficients: {4: -1.0e+308}, unit: waves}": "optics.zernike.coefficients[4]: must be >= -100000",
    "optics.seidel={spherical_um: 1.0e+308}": "optics.seidel.spherical_um: must be <= 100000",
    "scene.radiance_w_m2_sr_nm=1.0e+308": "scene.radiance_w_m2_sr_nm: must be <= 1e+24",
    "scene.band_width_nm=1.0e+308": "scene.band_width_nm: must be <= 1e+06",
    "sensor.read_noise_e=1.0e+308": "sensor.read_noise_e: must be <= 1e+07",
    "exposure_s=1.0e+308": "exposure_s: must be 0, or from 1e-12 to 1e+07",
}


@pytest.mark.parametrize(("change", "line"), ABSURD.items(), ids=ABSURD)
def test_absurd_numbers_give_one_line(folder, change, line):
    with pytest.raises(ConfigError) as caught:
        read_shot("shot.yaml", [change])

    assert str(caught.value).startswith(f"shot.yaml: --set {line}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("give", "line"), WRONG.values(), ids=WRONG)
def test_wrong_names_give_one_line(folder, give, line):
    with pytest.raises(FoveasimError) as caught:
        give()
    message = str(caught.value).replace(f"{folder}{os.sep}", "")

    assert "\n" not in message
    assert re.match(line, str(caught.value)) if isinstance(line, re.Pattern) else message.startswith(line)


@pytest.mark.parametrize(
    ("module", "name"),
    [(fs.layout, "log_polar"), (fs.layout, "DesignRules"), (fs.scene.charts, "siemens_star"), (fs, "explore")],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_misspelt_attributes_name_closest(module, name):
    with pytest.raises(AttributeError, match=f"has no attribute '{name}x'; did you mean '{name}'"):
        getattr(module, f"{name}x")


@pytest.mark.parametrize(
    ("name", "names", "closest"),
    [
        ("gapum", ["pitch_um", "gap_um"], "gap_um"),
        ("Gap-UM", ["pitch_um", "gap_um"], "gap_um"),
        ("gap_um", ["pitch_um", "trench_um"], "trench_um"),
        ("dark_current", ["read_noise_e", "dark_e_per_s"], "dark_e_per_s"),
        ("zzz", ["pitch_um", "gap_um"], None),
        ("", ["pitch_um"], None),
        (3, ["bits"], None),
        ("x", [], None),
    ],
)
def test_closest_name_is_similar(name, names, closest):
    assert closest_name(name, names) == closest


def test_long_lists_contain_closest_names():
    names = [f"name_{k:03d}" for k in range(200)] + ["other"]

    assert list_names(names[:MAX_LISTED]) == ", ".join(f"'{name}'" for name in names[:MAX_LISTED])
    shown = list_names(names, "othr")
    assert "'other'" in shown
    assert shown.count("', '") == MAX_LISTED - 1
    assert shown.endswith(f"({MAX_LISTED} closest of 201)")
    assert possible_names("name_007x", names).startswith("did you mean 'name_007'? possible: ")


def test_names_are_printed_on_one_line(tmp_path):
    (tmp_path / "a\nb.png").touch()

    assert missing_path(tmp_path / "a\nc.png") == r"no such file; did you mean 'a\nb.png'?"
    assert missing_path(tmp_path) == "is not a file"
    assert missing_path(tmp_path / "zzzzzz.gds") == "no such file"
    assert "\n" not in possible_names("a\nc", ["a\nb"])


def test_positions_survive_pickling(folder):
    changed("bits: 10", "bitz: 10")
    with pytest.raises(ConfigError) as caught:
        read_shot("shot.yaml")
    copy = pickle.loads(pickle.dumps(caught.value))

    assert copy.position == caught.value.position == (13, 3)
    assert str(copy) == str(caught.value)


@pytest.mark.parametrize("style", ["block", "flow", "json"])
def test_positions_are_those_of_keys(folder, style):
    settings = yaml.safe_load(SHOT) | {"sensor": {"read_noise_e": 1.0, "bits": 99}}
    text = (
        json.dumps(settings, indent=1)
        if style == "json"
        else yaml.safe_dump(settings, default_flow_style=style == "flow")
    )
    (folder / "shot.yaml").write_text(text)

    with pytest.raises(ConfigError) as caught:
        read_shot("shot.yaml")
    line, column = caught.value.position
    assert text.splitlines()[line - 1][column - 1 :].startswith(('"bits": 99', "bits: 99"))


def test_error_without_file_has_no_path():
    error = Source().error("sensor.bits", "must be an integer")

    assert (error.path, error.position, str(error)) == (None, None, "sensor.bits: must be an integer")


def test_study_trial_names_closest_result():
    found = explore.study(yaml.safe_load(SHOT), {"sensor.bits": [8, 10]}, {"snr_men": "maximize"}, n_trials=1)

    assert (
        found.trials[0]
        .user_attrs["error"]
        .startswith("'snr_men' must be one of the results; did you mean 'snr_mean'? possible: ")
    )


def test_unknown_field_of_dataset_is_named():
    with pytest.raises(FoveasimError, match="did you mean 'code'"):
        explore.Dataset(np.ones((1, 4, 4), np.uint8), {}, fields=["codes"])


def test_terms_of_other_programs_have_equivalents():
    signatures = [*LAYOUTS.values(), fs.Sensor, fs.Optics, fs.DesignRules, fs.Camera.capture]
    names = {name for call in signatures for name in inspect.signature(call).parameters}

    for term, beginnings in OTHER_TERMS.items():
        assert all(any(name.startswith(begin) for name in names) for begin in beginnings), term

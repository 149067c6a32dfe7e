"""Starting files: each is read by its reader and simulated; existing files are not replaced."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from reference.twins import small_twin

import foveasim as fs
from foveasim.config import (
    STARTING_FILES,
    build_shot,
    read_any_layout,
    read_rules,
    read_settings,
    read_shot,
    starting_file,
)
from foveasim.explore import read_dataset, read_study, read_sweep
from foveasim.explore.worker_cache import ShotRunner

#: A smaller layout, for the time of the tests.
SMALL = ["layout.parameters.r_max_um=150"]


@pytest.fixture
def new_file(foveasim, tmp_path):
    """Write a file of a kind with the program and return its path."""

    def write(kind):
        result = foveasim("new", kind, cwd=tmp_path)
        assert (result.returncode, result.stderr) == (0, "")
        assert result.stdout.startswith(f"wrote {kind}.yaml; next: foveasim ")
        return tmp_path / f"{kind}.yaml"

    return write


def small(plan_settings):
    return plan_settings | {
        "layout": plan_settings["layout"]
        | {"parameters": plan_settings["layout"]["parameters"] | {"r_max_um": 150.0, "n_sectors": 48}}
    }


def metrics_of(plan, plan_settings):
    record = ShotRunner(plan.source, plan.metrics, n_threads=1)((0, small(plan_settings)))
    assert (record.error, record.warning) == ("", "")
    return record.values


def test_starting_shot_is_simulated(new_file):
    path = new_file("shot")
    shot = read_shot(path, SMALL)
    capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)

    assert capture.settings["light"]["fit"] == "cover"
    assert 100 < np.median(capture.code) < 2**shot.camera.sensor.bits - 1
    assert capture.saturated_fraction < 0.05
    assert shot.camera.sensor.layout.check(shot.rules).ok


@pytest.mark.slow
def test_starting_shot_runs(foveasim, new_file):
    path = new_file("shot")
    result = foveasim("run", path.name, "--set", *SMALL, "--out", "out", cwd=path.parent)

    assert (result.returncode, result.stderr) == (0, "")
    assert fs.Capture.load(path.parent / "out" / "shot_capture.npz").bits == 12


def test_starting_layout_satisfies_its_rules(foveasim, new_file):
    path = new_file("layout")
    file = read_any_layout(path)

    assert file.layout.check(file.rules).ok
    assert foveasim("check", path.name, cwd=path.parent).returncode == 0


def test_starting_rules_are_those_of_layout(foveasim, new_file):
    path = new_file("rules")

    assert read_rules(path) == read_any_layout(new_file("layout")).rules
    assert foveasim("check", "four_zones", "--rules", path.name, cwd=path.parent).returncode == 0


def test_starting_sweep_point_has_metrics(new_file):
    plan = read_sweep(new_file("sweep"))
    values = metrics_of(plan, plan.settings_of(0))

    assert plan.shape == (3, 3)
    assert {"n_sites", "snr_mean", "psnr_db", "saturated_fraction"} <= set(values)


def test_starting_study_has_results_of_objectives(new_file):
    plan = read_study(new_file("study"))
    values = metrics_of(plan.base, dict(plan.base.settings) | {"seed": 1})

    assert {*plan.objectives, *plan.constraints} <= set(values)
    assert values["psnr_db"] > 10.0


def test_starting_dataset_has_labelled_samples(new_file):
    path = new_file("dataset")
    data = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump(data | {"shot": small(data["shot"])}))
    dataset = read_dataset(path).dataset

    assert len(dataset) == 12
    assert dataset[11]["label"] == 1
    assert dataset[11]["warning"] == ""
    assert dataset.class_names == ["cat", "cup", "person"]


@pytest.mark.parametrize("kind", STARTING_FILES)
def test_starting_file_has_comments_and_schema(foveasim, tmp_path, kind):
    jsonschema = pytest.importorskip("jsonschema")
    text = starting_file(kind)
    schema = json.loads(foveasim("schema", kind, cwd=tmp_path).stdout)

    assert jsonschema.Draft202012Validator(schema).is_valid(yaml.safe_load(text))
    assert "{" + kind not in text
    assert max(map(len, text.splitlines())) <= 128
    header = text.partition("\n\n")[0]
    assert "Change first: " in header
    assert re.search(r"^# +foveasim \w+ .*FILE", header, re.MULTILINE)
    keys = [line for line in text.splitlines() if re.match(r" *\w+: *[^ #{]", line)]
    assert sum("#" in line for line in keys) >= 0.6 * len(keys)


def test_existing_file_is_not_replaced(foveasim, tmp_path):
    (tmp_path / "shot.yaml").write_text("mine")
    result = foveasim("new", "shot", cwd=tmp_path)

    assert (result.returncode, result.stdout) == (2, "")
    assert (
        result.stderr
        == "error: shot.yaml: exists already; choose another file with --out, or replace it with --force\n"
    )
    assert (tmp_path / "shot.yaml").read_text() == "mine"
    assert foveasim("new", "shot", "--force", cwd=tmp_path).returncode == 0
    assert (tmp_path / "shot.yaml").read_text() == starting_file("shot")
    assert [path.name for path in tmp_path.iterdir()] == ["shot.yaml"]


def test_next_command_contains_quoted_path(foveasim, tmp_path):
    result = foveasim("new", "rules", "--out", "my rules.yaml", cwd=tmp_path)

    assert result.stdout == "wrote my rules.yaml; next: foveasim check four_zones --rules 'my rules.yaml'\n"
    assert (tmp_path / "my rules.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ("film",),
            "error: 'kind' must be one of 'shot', 'layout', 'rules', 'sweep', 'study', 'dataset', got 'film'\n",
        ),
        (
            ("shot", "--out", "nowhere/shot.yaml"),
            f"error: {Path('nowhere/shot.yaml')}: cannot be written: the directory nowhere does not exist\n",
        ),
    ],
)
def test_starting_file_errors_are_one_line(foveasim, tmp_path, arguments, line):
    result = foveasim("new", *arguments, cwd=tmp_path)

    assert (result.returncode, result.stdout, result.stderr) == (2, "", line)
    assert list(tmp_path.iterdir()) == []


def test_new_sensor_is_run(foveasim, tmp_path):
    quantities = ["pixel_um=2.25", "bits=12", "qe_percent=91.25", "dark_noise_e=5.560", "saturation_e=9458"]
    options = [option for each in quantities for option in ("--set", each)]
    result = foveasim("new", "sensor", "--from-datasheet", *options, "--out", "imx900.yaml", cwd=tmp_path)

    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout == ("wrote imx900_datasheet.yaml and imx900.yaml; next: foveasim run imx900.yaml --out out\n")
    shot = read_shot(tmp_path / "imx900.yaml", SMALL)
    assert shot.camera.sensor.read_noise_e == 5.56
    assert shot.camera.capture(shot.scene, exposure_s=0.001, seed=0).saturated_fraction < 0.05


NEEDS_ORIGIN = (
    "error: the kind sensor needs either --from-datasheet or --from-twin, of which only the former accepts --set: foveasim new "
    "sensor --from-datasheet\n"
)


def test_new_sensor_of_twin_is_run(foveasim, tmp_path):
    """In another directory than its twin, with the layout of the shot and with the pixels of the camera."""
    (tmp_path / "camera").mkdir()
    small_twin().save(tmp_path / "camera" / "twin.npz")
    result = foveasim("new", "sensor", "--from-twin", "camera/twin.npz", "--out", "shot.yaml", cwd=tmp_path)

    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout == "wrote shot.yaml; next: foveasim run shot.yaml --out out\n"
    settings = read_settings(tmp_path / "shot.yaml")
    assert settings["sensor"] == {"twin": "camera/twin.npz", "qe": {"kind": "silicon", "depth_um": 3.0}}
    assert read_shot(tmp_path / "shot.yaml", SMALL).camera.sensor.bits == 11
    del settings["layout"]
    assert build_shot(tmp_path / "shot.yaml", settings).camera.layout.n_sites == 48


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ("sensor",),
            NEEDS_ORIGIN,
        ),
        (
            ("sensor", "--from-datasheet"),
            "error: the quantities of the data sheet must be given as --set NAME=VALUE, or be typed in a terminal\n",
        ),
        (("shot", "--from-twin", "twin.npz"), NEEDS_ORIGIN),
        (("sensor", "--from-twin", "twin.npz"), "error: twin.npz: no such file\n"),
        (
            ("sensor", "--from-datasheet", "--set", "bits=12"),
            "error: 'pixel_um' must be in the data sheet\n",
        ),
    ],
)
def test_new_sensor_errors_are_one_line(foveasim, tmp_path, arguments, line):
    result = foveasim("new", *arguments, cwd=tmp_path)

    assert (result.returncode, result.stdout, result.stderr) == (2, "", line)
    assert list(tmp_path.iterdir()) == []

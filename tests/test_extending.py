"""Extensions: an installed package adds one of each kind, and every registry reports what it cannot load."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import foveasim
from foveasim._core.registry import Registry
from foveasim.errors import ParameterError

EXAMPLE = Path(__file__).parent / "example_package"
SHOT = """
scene: {kind: half_plane, shape: [40, 40], pitch_um: 200.0, distance_m: 1.0}
optics: {focal_length_mm: 8.0, f_number: 4.0, pupil: {kind: half_moon, tilt: 0.1}}
distortion: {kind: magnifier, factor: 1.05}
layout:
  generator: daisy
  parameters: {n_petals: 12, petal_um: 3.0}
  rules: {custom: {min_roundness: 0.9}}
sensor:
  read_noise_e: 2.0
  effects: [{kind: supply_ripple, sigma_v: 0.002}]
  pixel_optics: {kind: baffle, max_tangent: 0.1}
exposure_s: 0.01
"""
PROGRAM = """
import json, sys
from types import SimpleNamespace
import numpy as np
import foveasim as fs
from foveasim.studio._parts.requirements import requirements
from foveasim.studio._settings.controls import controls_of
from foveasim.config import read_shot, schema
from foveasim.metrics import METRICS
from foveasim.testing import check_extension, extensions

shot = read_shot("shot.yaml")
capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)
budget = shot.camera.noise_budget(shot.scene, exposure_s=shot.exposure_s)
daisy = fs.layout.daisy(n_petals=12, petal_um=3.0)
written = daisy.write("daisy.boxes", digits=2)
square = fs.layout.grid(n_x=2, n_y=2, pitch_um=2.0)
capture.save("capture.npz")
again = fs.Capture.load("capture.npz")
open("two.lines", "w").write("LINES\\n1 2\\n3 4\\n")
cube = fs.Scene.from_cube("two.lines", distance_m=1.0)
names = {"daisy", "stretch_x", "min_roundness", "boxes", "pad", "powers", "lines", "supply_ripple", "binary_gates", "baffle", "comb", "half_plane", "amber",
         "half_moon", "magnifier", "darkest_code_dn", "spot", "charge_density"}
own = [found for found in extensions() if found[1] in names]
for kind, name in own:
    check_extension(kind, name)
name, settings = "darkest_code_dn", fs.config.read_settings("shot.yaml")
swept = fs.explore.sweep("shot.yaml", {"sensor.bits": [8, 10]}, metrics=[name], workers=0)
studied = fs.explore.study("shot.yaml", {"exposure_s": (0.01, 0.02)}, {name: "maximize"}, n_trials=2, workers=0)
limited = fs.config.build_shot("shot.yaml", {**settings, "requirements": [{"measure": name, "at_least": 0.0, "site": 3}]})
goal = fs.config.Requirement(measure=name, at_most=1e9)
compared = fs.compare.cameras({"one": shot.camera, "other": shot.camera}, {"moon": shot.scene}, exposure_s=0.01, n_annuli=2,
                              max_pixels=16, metrics=[name])
compared.write("report.html")
rows, _ = requirements(SimpleNamespace(shot=limited, capture=capture))
demo = {key: each for key, each in fs.config.read_settings(fs.config.demo_settings()[0]).items() if key != "sensor"}
choices = [each for control in controls_of(demo) if control["id"] == "layout" for each in control["choices"]]
chosen = next(each["value"] for each in choices if each["label"] == "daisy")
petal = next(each for each in controls_of({**demo, "layout": chosen}) if each["key"].endswith("petal_um"))
try:
    fs.layout.daisy(n_petals=12, petal_um=300.0)
except fs.errors.ParameterError as error:
    too_large = str(error)
uses = {
    "generator in the studio": fs.config.build_shot(None, {**demo, "layout": chosen}).camera.layout.n_sites > 3,
    "sweep": swept[name].values.tolist()[1] >= 0,
    "study": len(studied.trials) == 2 and studied.best_value >= 0,
    "requirement": fs.explore.check_requirements(limited, capture)[0].value == capture.code[3],
    "goal seek": fs.explore.solve("shot.yaml", "exposure_s", goal, bounds=(0.01, 0.02)).result >= 0,
    "comparison": compared.values[name][0, 0] == capture.code.min() and "lowest code" in open("report.html").read().lower(),
    "studio": {"name": name, "label": "lowest code / DN", "unit": "DN", "has_region": True, "is_cost": False} in rows["measures"],
    "schema": name in json.dumps(fs.explore.schema_of("sweep")),
    "declared parameter": (petal["label"], petal["suggested"], too_large) == ("petal radius", [1.0, 20.0], "'petal_um' must be <= 100, got 300.0 µm"),
    "column": "charge_density" in capture.to_pandas() and "charge_density" in json.dumps(fs.explore.schema_of("dataset")),
}
print(json.dumps({
    "uses": sorted(use for use, is_right in uses.items() if is_right),
    "checked": len({kind for kind, _ in own}) == len({kind for kind, _ in extensions()}) == len(own) - 1,
    "generator": capture.layout.provenance["generator"],
    "effects": [effect.name for effect in shot.camera.sensor.chain],
    "ripple": bool(budget["supply_ripple"].min() > 0),
    "rules": str(capture.layout.check(shot.rules)),
    "square": square.check(shot.rules).ok,
    "boxes": fs.read_layout("daisy.boxes").n_sites,
    "metric": METRICS["darkest_code_dn"](shot, shot.camera, capture) == int(capture.code.min()),
    "chart": type(fs.scene.charts.half_plane(shape=(4, 4), pitch_um=1.0, distance_m=1.0)).__name__,
    "cube": (cube.basis[0, ::-1] * cube.spectrum_w_m2_sr_nm).tolist(),
    "schema": all(name in json.dumps(schema()) for name in ("daisy", "supply_ripple", "half_moon", "magnifier", "half_plane", "baffle")),
    "response": bool((abs(shot.camera.angular_response(shot.scene) - 0.62) < 0.08).all()),
    "snr": bool(np.allclose(again.signal_to_noise(), capture.signal_to_noise(sensor=shot.camera.sensor), rtol=1e-9)),
}))
"""


@pytest.fixture(scope="module")
def extended(tmp_path_factory):
    folder = tmp_path_factory.mktemp("extended")
    (folder / "shot.yaml").write_text(SHOT)
    return subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": f"{EXAMPLE}{os.pathsep}{Path(foveasim.__file__).parents[1]}"},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
def test_installed_package_extends_every_kind(extended):
    assert extended.returncode == 0, extended.stderr
    assert json.loads(extended.stdout) == {
        "uses": [
            "column",
            "comparison",
            "declared parameter",
            "generator in the studio",
            "goal seek",
            "requirement",
            "schema",
            "studio",
            "study",
            "sweep",
        ],
        "checked": True,
        "generator": "daisy",
        "effects": ["shot", "read", "supply_ripple"],
        "ripple": True,
        "rules": "design rules on 13 photosites\nmin_roundness: satisfied",
        "square": False,
        "boxes": 13,
        "metric": True,
        "chart": "Scene",
        "cube": [[1.0, 2.0], [3.0, 4.0]],
        "schema": True,
        "response": True,
        "snr": True,
    }


@pytest.mark.slow
def test_broken_entry_point_is_reported(extended):
    assert "scene 'broken' of foveasim-example cannot be loaded (" in extended.stderr
    assert extended.stderr.count("cannot be loaded") == 1


def test_name_is_registered_once():
    registry = Registry("thing", "foveasim.tests")
    registry.register("one", int)

    assert registry.register("one", int, example={"x": 1}) is int
    assert registry.register("one", int) is int
    assert registry.example("one") == {"x": 1}
    with pytest.raises(ParameterError, match="'name' must be new: another thing has this name, got 'one'"):
        registry.register("one", float)


def test_unknown_name_gives_closest():
    registry = Registry("thing", "foveasim.tests")
    registry.register("hexagonal")(int)

    assert registry.find("kind", "hexagonal") is int
    with pytest.raises(
        ParameterError, match="'kind' must be the name of a thing, got 'hexagnal'; did you mean 'hexagonal'"
    ):
        registry.find("kind", "hexagnal")
    with pytest.raises(AttributeError, match="module 'm' has no attribute 'grid'"):
        registry.attributes_of("m")("grid")


def test_registration_changes_version():
    registry = Registry("thing", "foveasim.tests")
    before = registry.version
    registry.register("one", int)

    assert registry.version > before
    assert dict(registry) == {"one": int}


@pytest.mark.parametrize("name", ["public", "_private"])
def test_modules_of_any_name_are_imported(name, tmp_path, monkeypatch):
    package = tmp_path / f"some_{name}"
    package.mkdir()
    (package / "__init__.py").write_text(
        "from foveasim._core.registry import import_all\nfound = []\nimport_all(__name__, __path__)\n"
    )
    (package / f"{name}.py").write_text(f"import some_{name}\nsome_{name}.found.append(__name__)\n")
    (package / "_kernels.py").write_text("raise RuntimeError('compiled')\n")
    monkeypatch.syspath_prepend(tmp_path)

    assert importlib.import_module(f"some_{name}").found == [f"some_{name}.{name}"]


def test_wrong_extensions_give_messages():
    with pytest.raises(ParameterError, match="'custom' must be a mapping to numbers, got 3"):
        foveasim.DesignRules(custom=3)
    with pytest.raises(
        ParameterError,
        match=r"'digits' is not an option of any format, got 3; possible: 'cell', 'channels', .*'layer', 'layers'",
    ):
        foveasim.read_layout("prima_100", digits=3)

"""Controls of settings: one for each key of the schema, with valid ranges and alternatives."""

from __future__ import annotations

import json

import pytest

from foveasim.config import build_shot, check_settings, get_setting, put_setting, schema
from foveasim.distortion import LENSES
from foveasim.layout import EDITS, LAYOUTS
from foveasim.optics import PUPILS
from foveasim.scene import SCENES
from foveasim.sensor import PIXEL_OPTICS
from foveasim.sensor.effects import EFFECTS
from foveasim.sensor.spectral import CURVES
from foveasim.studio._files import start_settings
from foveasim.studio._settings import controls as _controls
from foveasim.studio._settings.controls import chosen_value, controls_of, structure_of

KINDS = {"number", "integer", "choice", "boolean", "text", "file", "list", "group", "sections"}


@pytest.fixture(scope="module")
def demo():
    return start_settings(None)[0]


@pytest.fixture(scope="module")
def controls(demo):
    return controls_of(demo)


def by_id(controls, name):
    return next(control for control in controls if control["id"] == name)


def complete(choice):
    """Return the value of a choice, with a file and numbers that the page asks for."""
    if "file" not in choice:
        return choice["value"]
    asked = {name: "photo.png" if name == "picture" else 3.0 for name in choice["required"]}
    return {**choice["value"], choice["file"]: "name.txt", **asked}


def keys_of(definition):
    """Return the parameters of a section that users change."""
    properties = schema()["$defs"][definition]["properties"]
    return {name for name, below in properties.items() if not below.get("readOnly")}


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize(
    ("section", "definition"),
    [
        ("optics", "optics"),
        ("sensor", "sensor"),
        ("scene", "picture_kind"),
        ("layout", "log_polar_generator"),
        ("layout.parameters", "log_polar_parameters"),
        ("layout.rules", "design_rules"),
        ("sensor.qe", "silicon_kind"),
    ],
)
def test_every_parameter_has_a_control(controls, section, definition):
    keys = {control["key"] for control in controls}

    assert {f"{section}.{name}" for name in keys_of(definition) - {"kind", "generator"}} <= keys


def test_every_section_has_a_control(controls):
    assert {control["key"] for control in controls if "." not in control["key"]} == set(schema()["properties"])


def test_controls_have_all_attributes(controls):
    ids = [control["id"] for control in controls]

    assert len(set(ids)) == len(ids)
    json.dumps(controls, allow_nan=False)
    for control in controls:
        assert control["kind"] in KINDS
        assert {"key", "label", "unit", "section", "help", "default", "is_optional"} <= set(control)
        assert "``" not in control["help"]


def test_ranges_contain_values(demo, controls):
    numbers = [control for control in controls if control["kind"] in ("number", "integer")]
    assert len(numbers) > 40
    for control in numbers:
        low, high = control["suggested"]
        value = get_setting(demo, control["key"])
        assert low < high, control
        assert control["scale"] == "linear" or low > 0.0
        assert value is None or low <= value <= high, control
        assert control["minimum"] is None or low >= control["minimum"]
        assert control["maximum"] is None or high <= control["maximum"]


def test_references_in_all_of_are_resolved():
    root = {"$defs": {"lens": {"type": "object"}, "optics": {"allOf": [{"$ref": "#/$defs/lens"}]}}}
    node = {"allOf": [{"$ref": "#/$defs/optics"}], "description": "as pydantic before version 2.9 writes it"}
    assert _controls._resolved(root, node) == {"type": "object"}


def test_units_are_not_in_labels(controls):
    control = by_id(controls, "optics.focal_length_mm")

    assert (control["label"], control["unit"], control["section"]) == ("focal length", "mm", "optics")


def test_generators_select_their_parameters(demo, controls):
    choices = by_id(controls, "layout")["choices"]
    assert by_id(controls, "layout")["choices"][by_id(controls, "layout")["selected"]]["label"] == "log polar"
    settings = {**demo, "layout": next(c["value"] for c in choices if c["label"] == "grid")}

    found = {control["key"] for control in controls_of(settings)}

    assert "layout.parameters.n_x" in found
    assert "layout.parameters.n_sectors" not in found


def test_values_per_area_have_two_controls(controls):
    form, value = by_id(controls, "sensor.read_noise_e:form"), by_id(controls, "sensor.read_noise_e")

    assert [choice["label"] for choice in form["choices"]] == ["number", "per µm²"]
    assert value["kind"] == "number"
    assert by_id(controls, "sensor.capacitance_f.per_um2")["kind"] == "number"


def test_choices_are_valid_settings(demo, controls):
    n_checked = 0
    for control in controls:
        for choice in () if "do" in control else control.get("choices", ()):
            settings = json.loads(json.dumps(demo))
            if choice["value"] is None or control["key"] == "integration_order":
                continue
            *above, last = control["key"].split(".")
            section = settings
            for name in above:
                section = section.setdefault(name, {})
            value = complete(choice)
            section[last] = [value] if control["kind"] == "sections" else value
            if control["key"].startswith("scene."):
                settings["scene"].pop("pitch_um", None)
            check_settings(None, settings)
            n_checked += 1

    assert n_checked > 80


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::foveasim.errors.FoveasimWarning")
def test_sections_start_without_an_error(demo, controls):
    """Shots with each section that can be chosen can be built; layouts without filters, which the session adds."""
    built = set()
    for control in controls:
        for choice in () if "do" in control else control.get("choices", ()):
            value = choice["value"]
            if not isinstance(value, dict) or "file" in choice:
                continue
            settings = json.loads(json.dumps(demo))
            put_setting(None, settings, control["key"], [value] if control["kind"] == "sections" else value)
            if control["key"] == "layout" and "mosaic" not in value:
                del settings["sensor"]["filters"]
            build_shot(None, settings)
            built.add(choice["label"])

    for registry in (LAYOUTS, EDITS, SCENES, LENSES, EFFECTS, PUPILS, CURVES, PIXEL_OPTICS):
        bundled = registry.within("foveasim")  # other tests register objects that need arrays
        missing = {name for name in bundled if name.replace("_", " ") not in built}
        at_points = {name for name in missing if registry[name].__module__.endswith(".at_points")}
        assert missing - at_points <= {"calibration", "cube", "file", "picture", "image", "rgbd"}, (
            registry.kind
        )  # of files


def test_numbers_do_not_change_structure(demo):
    changed = json.loads(json.dumps(demo))
    changed["optics"]["f_number"] = 4.5
    changed["gaze_um"] = [1.0, 2.0]
    assert structure_of(changed) == structure_of(demo)
    changed["optics"]["lens"] = "aplanatic"
    assert structure_of(changed) != structure_of(demo)


def test_choices_of_older_lists_have_current_values(demo):
    demo = {**demo, "layout": {**demo["layout"], "move_um": [-140.0, 320.0]}}
    controls = controls_of(demo)
    grid = next(choice["value"] for choice in by_id(controls, "layout")["choices"] if choice["label"] == "grid")
    moved = json.loads(json.dumps(demo))
    moved["layout"]["move_um"] = [7.0, 8.0]

    assert grid["move_um"] == demo["layout"]["move_um"]
    assert chosen_value("layout", grid, controls, moved, demo)["move_um"] == [7.0, 8.0]
    assert chosen_value("layout", {"generator": "own"}, controls, moved, demo) == {"generator": "own"}


def test_sections_of_lists_have_controls(demo):
    edits = [
        {"kind": "inset", "margin_um": 0.2},
        {"kind": "draw", "outlines_um": [[[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]]]},
    ]
    settings = {
        **demo,
        "layout": {"generator": "grid", "parameters": {"n_x": 4, "n_y": 4, "pitch_um": 9.0}, "edits": edits},
    }
    controls = controls_of(settings)

    assert by_id(controls, "layout.edits.0.margin_um")["kind"] == "number"
    assert by_id(controls, "layout.edits.1.overlap")["kind"] == "choice"
    assert [control["label"] for control in controls if control.get("is_item")] == ["1. inset", "2. draw"]
    assert get_setting(settings, "layout.edits.0.margin_um") == 0.2
    assert structure_of(settings) != structure_of({**settings, "layout": {**settings["layout"], "edits": edits[:1]}})


@pytest.mark.filterwarnings("ignore::foveasim.errors.FoveasimWarning")
def test_initial_values_of_edits_are_valid(demo):
    layout = {"generator": "grid", "parameters": {"n_x": 40, "n_y": 40, "pitch_um": 9.0}}
    for choice in by_id(controls_of({**demo, "layout": layout}), "layout.edits")["choices"]:
        settings = {**demo, "layout": {**layout, "mosaic": ["RG", "GB"], "edits": [choice["value"]]}}

        assert build_shot(None, settings).camera.sensor.layout.n_sites > 0

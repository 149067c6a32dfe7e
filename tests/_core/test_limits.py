"""Declared parameters: every limit of every public dataclass is enforced, documented and part of the schema."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import math
import pickle
import re
import runpy
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pytest

import foveasim as fs
from foveasim._core.calls import POSITIVE, Declaration, Limits, Usual, check_arguments, declarations_of
from foveasim._core.calls.limits import without_declarations
from foveasim._core.validation import unit_of
from foveasim.config import schema
from foveasim.config._models import call_of, models
from foveasim.errors import ParameterError
from foveasim.sensor.adc import ADC

ROOT = Path(__file__).parents[2]
MODULES = [
    name for name in runpy.run_path(str(ROOT / "docs" / "generated_pages.py"))["MODULES"] if not name.endswith(".learn")
]
LAYOUT = fs.layout.grid(4, 4, 3.0)
#: Required parameters without limits.
EXAMPLES = {
    "layout": LAYOUT,
    "sensor": fs.Sensor(LAYOUT),
    "curve": fs.sensor.ConstantCurve(0.5),
    "focal_um": 8000.0,
    "k": (0.0, 0.0, 0.0, 0.0),
    "a": (1.0, 0.0, 0.0, 0.0),
    "projection": "equidistant",
    "custom": {},
    "basis": np.ones((1, 2, 2)),
    "primaries": [[1.0]],
    "spectrum_w_m2_sr_nm": [[1.0]],
    "wavelength_nm": [550.0],
    "band_width_nm": 10.0,
    "field_um": np.zeros((1, 2)),
    "height_um": 2.0,
    "refractive_index": 1.5,
    "image_height_um": (0.0, 100.0),
    "angle_deg": (0.0, 10.0),
    "fraction": (1.0, 0.9),
    "psf": np.pad(np.ones((1, 1, 1, 1)), ((0, 0), (0, 0), (2, 2), (2, 2))),
    "x_um": [0.0],
    "y_um": [0.0],
    "n_on": np.ones(9, np.int64),
    "n_off": np.ones(9, np.int64),
    "log_contrast": [0.1, 0.2],
    "n_trials": [9, 9],
    "n_responses": [1, 8],
    "frames": np.ones((2, 4, 4), np.uint16),
    "exposure_s": 0.01,
}
#: Parameters that others require.
COMPANIONS = {
    "from_nm": {"to_nm": None},
    "to_nm": {"from_nm": None},
    "min_density": {"density_window_um": 10.0},
    "max_density": {"density_window_um": 10.0},
    "max_data_rate_gbit_per_s": {"readout": fs.layout.Readout(frames_per_s=30.0, bits=8)},
    "max_track_utilisation": {"routing": fs.layout.Routing(width_um=1.0, space_um=1.0)},
    "depth_layers": {"depth_m": np.ones((2, 2))},
    "line_s": {"layout": LAYOUT.with_columns(readout_order=np.arange(16))},
}
#: Valid values that other parameters exclude: a pedestal of V_sat.
COUPLED = {("Sensor", "pedestal_v"): 1000.0}


def declared_classes():
    """Return the public dataclasses with declared limits, and their declarations."""
    found = {ADC: None}
    for module in map(import_module, MODULES):
        for name in module.__all__:
            item = getattr(module, name)
            if isinstance(item, type) and dataclasses.is_dataclass(item):
                found[item] = None
    classes = {kind: {n: d for n, d in declarations_of(kind).items() if d.limits} for kind in found}
    return {kind: declared for kind, declared in classes.items() if declared}


CLASSES = declared_classes()
PARAMETERS = [(kind, name, declared) for kind, found in CLASSES.items() for name, declared in found.items()]
NUMBERS = [each for each in PARAMETERS if {float, int} & set(each[2].kinds)]
BY_NAME = {"argvalues": NUMBERS, "ids": [f"{kind.__name__}.{name}" for kind, name, _ in NUMBERS]}


def inside(limits, is_integer):
    """Return the extreme valid values."""
    low = limits.lowest if limits.above != limits.lowest else np.nextafter(limits.lowest, math.inf)
    ends = [float(end) for end in (low, limits.high) if math.isfinite(end)]
    return [int(end) for end in ends] if is_integer else ends or [0.0]


def outside(limits, is_integer):
    """Return the values next to the valid ones."""
    if is_integer:
        return [int(limits.at_least) - 1, *([] if limits.at_most is None else [int(limits.at_most) + 1]), 1.5]
    found = [] if limits.at_most is None else [np.nextafter(limits.at_most, math.inf)]
    if limits.low:
        found.append(np.nextafter(limits.low, 0.0) if limits.low > 0.0 else np.nextafter(limits.low, -math.inf))
    if limits.above is not None:
        found.append(limits.above)
    if limits.at_least is not None:
        found.append(np.nextafter(limits.at_least, -math.inf))
    return [*map(float, found), math.nan, math.inf, -math.inf]


def arguments_of(kind, **given):
    """Return valid arguments of a dataclass."""
    declared = CLASSES[kind]
    required = {
        each.name: EXAMPLES[each.name]
        if each.name in EXAMPLES
        else inside(declared[each.name].limits, int in declared[each.name].kinds)[0]
        for each in dataclasses.fields(kind)
        if each.init and each.default is dataclasses.MISSING and each.default_factory is dataclasses.MISSING
    }
    if kind is fs.sensor.PassBand:
        required["to_nm"] = 600.0
    if kind is fs.scene.Display:
        required |= {"wavelength_nm": [500.0, 550.0], "primaries": [[1.0, 2.0]]}
    if kind is fs.modes.Shutter:
        required["frame_s"] = 0.1
    if issubclass(kind, fs.sensor.effects.Effect) and "fraction" in required:
        required["fraction"] = 0.1
    return required | next((COMPANIONS[name] for name in given if name in COMPANIONS), {}) | given


def test_most_parameters_declare_limits():
    assert len(CLASSES) > 20
    assert len(NUMBERS) > 100
    assert len(CLASSES[fs.Sensor]) == 32


@pytest.mark.parametrize(("kind", "name", "declared"), **BY_NAME)
def test_values_at_limits_are_accepted(kind, name, declared):
    for value in inside(declared.limits, int in declared.kinds):
        if COUPLED.get((kind.__name__, name)) != value:
            found = getattr(kind(**arguments_of(kind, **{name: value})), name)
            assert found == value
            assert type(found) is (int if int in declared.kinds else float)


@pytest.mark.parametrize(("kind", "name", "declared"), **BY_NAME)
def test_values_beyond_limits_are_rejected(kind, name, declared):
    wrong = [*outside(declared.limits, int in declared.kinds), "x", b"x", {}, object(), 1j]
    for value in wrong if declared.is_optional else [*wrong, None]:
        with pytest.raises(ParameterError) as caught:
            kind(**arguments_of(kind, **{name: value}))
        assert str(caught.value).startswith(f"'{name}' ")
        if isinstance(value, int | float):
            assert f"got {value}" in str(caught.value)
            assert unit_of(name) in str(caught.value) or math.isnan(value) or int in declared.kinds


@pytest.mark.parametrize(
    ("kind", "name", "declared"),
    [
        each
        for each in NUMBERS
        if each[2].is_per_site
        and each[0] is not fs.optics.PSFGrid
        and not issubclass(each[0], fs.sensor.effects.Effect)
    ],
    ids=lambda each: str(each)[:40],
)  # effects do not know the layout, and pitches of PSFs are of wavelengths
def test_arrays_per_site_are_checked(kind, name, declared):
    valid = np.full(LAYOUT.n_sites, inside(declared.limits, is_integer=False)[-1])
    found = getattr(kind(**arguments_of(kind, **{name: valid})), name)
    assert np.array_equal(found, valid)
    assert not found.flags.writeable
    assert found is not valid

    for wrong in (valid[:-1], np.append(valid, valid[0]), valid.reshape(4, 4), valid[:0]):
        with pytest.raises(ParameterError, match=f"^'{name}' must "):
            kind(**arguments_of(kind, **{name: wrong}))
    for value in outside(declared.limits, is_integer=False):
        array = valid.copy()
        array[5] = value
        with pytest.raises(ParameterError, match=rf"^'{name}' must .*everywhere, got .* at \[5\]"):
            kind(**arguments_of(kind, **{name: array}))


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_declared_dataclasses_can_be_copied(kind):
    instance = kind(**arguments_of(kind))
    names = [each.name for each in dataclasses.fields(kind) if each.init]
    for other in (copy.copy(instance), pickle.loads(pickle.dumps(instance))):
        assert type(other) is kind
        assert all(repr(getattr(other, name)) == repr(getattr(instance, name)) for name in names)
    assert repr(dataclasses.replace(instance)) == repr(instance)


@pytest.mark.parametrize("kind", [kind for kind in CLASSES if kind is not ADC], ids=lambda kind: kind.__name__)
def test_signatures_show_types_only(kind):
    assert "Annotated" not in str(inspect.signature(kind))
    assert "Limits" not in str(inspect.signature(kind))


def sections(model, found):
    """Collect the models of all sections."""
    for field in model.model_fields.values():
        collect(field.annotation, found)
    return found


def collect(annotation, found):
    if isinstance(annotation, type) and hasattr(annotation, "model_fields"):
        if annotation not in found:
            found.append(annotation)
            sections(annotation, found)
        return
    for part in getattr(annotation, "__args__", ()):
        collect(part, found)


def test_schema_has_declared_ranges_and_units():
    n_checked = 0
    for model in sections(models().shot, [models().shot]):
        call = call_of(model)
        if call not in CLASSES:
            continue
        properties = model.model_json_schema()["properties"] if "$ref" not in model.model_json_schema() else None
        for name, declared in CLASSES[call].items():
            if properties is None or name not in properties:
                continue
            node = properties[name]
            rule = node["items"] if Sequence in declared.kinds else node
            assert {key: rule[key] for key in ("minimum", "exclusiveMinimum", "maximum") if key in rule} == (
                declared.limits.schema
            )
            words = f"{declared.limits.range} {unit_of(name)}".strip()
            assert words[1:] in node["description"]
            assert ("per site" in node["description"]) == declared.is_per_site or not declared.is_per_site
            n_checked += 1

    assert n_checked > 60
    assert schema()["properties"]["exposure_s"]["maximum"] == 1e7


def test_table_of_sensor_parameters_has_units():
    text = (ROOT / "docs" / "guides" / "sensor_parameters.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \|([^|]*)\|", text, re.MULTILINE))

    for name, declared in declarations_of(fs.Sensor).items():
        if declared.limits is not None and name != "qe":
            assert ("per site" in rows[name]) == declared.is_per_site, name
            assert unit_of(name) in rows[name], name


@pytest.mark.parametrize(
    ("limits", "words", "rule"),
    [
        (Limits(), "", {}),
        (Limits(at_least=1, at_most=16), "from 1 to 16", {"minimum": 1, "maximum": 16}),
        (Limits(above=0.0), "above 0", {"exclusiveMinimum": 0.0}),
        (Limits(at_least=0.0), "at least 0", {"minimum": 0.0}),
        (Limits(at_most=2.0), "at most 2", {"maximum": 2.0}),
        (Limits(above=0.0, at_most=1.0), "above 0, at most 1", {"exclusiveMinimum": 0.0, "maximum": 1.0}),
        (Limits(above=0.0, low=1e-6, at_most=1.0), "from 1e-06 to 1", {"minimum": 1e-6, "maximum": 1.0}),
        (Limits(at_least=0.0, low=1e-6, at_most=1.0), "0, or from 1e-06 to 1", {"minimum": 0.0, "maximum": 1.0}),
        (Limits(low=-2.0, at_most=2.0), "from -2 to 2", {"minimum": -2.0, "maximum": 2.0}),
    ],
)
def test_ranges_have_words_and_schema(limits, words, rule):
    assert limits.range == words
    assert limits.schema == rule


def test_limits_of_functions_are_enforced():
    @check_arguments
    def area(width_um: Annotated[float, POSITIVE], *, n: Annotated[int | None, Limits(at_least=1)] = None) -> object:
        return width_um, n

    assert area(2) == (2.0, None)
    assert type(area(width_um=np.float32(2.0))[0]) is float
    assert area(2.0, n=np.int64(3)) == (2.0, 3)
    assert "Annotated" not in str(inspect.signature(area, eval_str=False)).replace("typing.Annotated", "")
    for arguments, message in (
        ((0.0,), "'width_um' must be > 0, got 0.0 µm"),
        ((-1,), "'width_um' must be > 0, got -1 µm"),
    ):
        with pytest.raises(ParameterError, match=f"^{message}"):
            area(*arguments)
    with pytest.raises(ParameterError, match=r"^'n' must be >= 1, got 0"):
        area(1.0, n=0)


def test_declarations_are_found_in_unions():
    declared = Declaration.of(Annotated[float, POSITIVE, Usual(1.0, 2.0)] | None)

    assert (declared.limits, declared.usual, declared.is_optional) == (POSITIVE, (1.0, 2.0), True)
    assert Declaration.of(Annotated[int | Literal["auto"], POSITIVE]).converter("n", "auto", None) == "auto"
    assert Declaration.of(str).converter is None


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("Annotated[float, Limits(above=0.0, at_most=(1))] | None", "float | None"),
        ("tuple[Annotated[float, X], Annotated[dict[str, int], Y(a[0], 2)]]", "tuple[float, dict[str, int]]"),
        ("float | None", "float | None"),
        (float, float),
    ],
)
def test_types_are_extracted_from_annotations(text, plain):
    assert without_declarations(text) == plain


def test_limits_contain_numbers():
    with pytest.raises(ParameterError, match="'at_most' must be at least the lower limit 2, got 1"):
        Limits(at_least=2.0, at_most=1.0)

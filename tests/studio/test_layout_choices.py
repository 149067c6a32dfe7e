"""Choices of layouts: filters that follow the generator, and the parameter that a generator solves for."""

from __future__ import annotations

from pathlib import Path

import pytest
from studio.conftest import Recorder, WithoutThread
from studio.test_session import code_part, codes_of

from foveasim.config import bundled_layouts, demo_settings
from foveasim.layout import LAYOUTS
from foveasim.studio._files import start_settings
from foveasim.studio._session import Start
from foveasim.studio._settings.controls import controls_of
from foveasim.studio._settings.templates import SECTIONS
from foveasim.studio._settings.unknowns import unknown_of, unknowns_of, with_unknown


def choose(recorder, label, **message):
    control = next(each for each in recorder.session.controls if each["id"] == "layout")
    value = next(choice["value"] for choice in control["choices"] if choice["label"] == label)
    return recorder.do(do="set", key="layout", value=value, final=True, **message)


# -- filters ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("other", ["penrose", "quadtree", "sunflower", "voronoi"])
def test_colouring_ends_with_its_generator(recorder, settings, other):
    before = choose(recorder, "grid")["settings"]["layout"]
    coloured = choose(recorder, other)["settings"]["layout"]
    after = choose(recorder, "grid")

    assert coloured["edits"] == [{"kind": "graph_colouring", "n_channels": 3}]
    assert "mosaic" not in coloured
    assert after["errors"] == {}
    assert "edits" not in after["settings"]["layout"]
    assert after["settings"]["layout"]["mosaic"] == before["mosaic"]
    assert (code_part(recorder) == codes_of({**settings, "layout": after["settings"]["layout"]})).all()


@pytest.mark.slow
def test_edits_of_the_user_remain(recorder):
    """A colouring is added after other edits, and only where it is missing."""
    rotation = {"kind": "rotate", "angle_deg": 15.0}
    recorder.do(do="set", key="layout.edits", value=[rotation])
    assert choose(recorder, "sunflower")["settings"]["layout"]["edits"] == [
        rotation,
        {"kind": "graph_colouring", "n_channels": 3},
    ]
    assert choose(recorder, "hexagonal")["settings"]["layout"]["edits"] == [rotation]

    own = {"kind": "random_channels", "fractions": [1.0, 2.0, 1.0], "seed": 1}
    recorder.do(do="set", key="layout.edits", value=[own])
    assert choose(recorder, "voronoi")["settings"]["layout"]["edits"] == [own]
    assert choose(recorder, "hexagonal")["settings"]["layout"].get("mosaic") is None


@pytest.mark.slow
def test_filters_bring_their_mosaic(recorder):
    recorder.do(do="set", key="sensor.filters", value=None)
    choose(recorder, "sunflower")
    without = choose(recorder, "voronoi")["settings"]["layout"]
    coloured = recorder.do(do="set", key="sensor.filters", value="rgb")["settings"]["layout"]

    assert "edits" not in without
    assert coloured["edits"] == [{"kind": "graph_colouring", "n_channels": 3}]


@pytest.mark.slow
def test_bundled_layouts_and_files_have_filters(recorder, tmp_path):
    choose(recorder, "voronoi")
    state = recorder.do(do="preset", name="layout:giotto_1")
    assert (state["errors"], state["settings"]["layout"].get("edits")) == ({}, None)

    path = recorder.session.add_file(
        "layout.yaml", b"generator: sunflower\nparameters: {n_sites: 200, spacing_um: 8.0}\n"
    )
    state = recorder.do(do="file", path=str(path), **{"as": "layout"})
    assert state["errors"] == {}
    assert state["settings"]["layout"]["edits"] == [{"kind": "graph_colouring", "n_channels": 3}]


# -- number of photosites -------------------------------------------------------------------------------------------------


def generated(name):
    section = {key: value for key, value in SECTIONS[f"{name} parameters"].items() if key != "n_sites"}
    return {"layout": {"generator": name, "parameters": section}}


def layout_of(settings):
    layout = settings["layout"]
    return LAYOUTS[layout["generator"]](**layout["parameters"])


SOLVING = [
    (name, unknown)
    for name in LAYOUTS
    if f"{name} parameters" in SECTIONS and LAYOUTS[name].picture is None
    for unknown in unknowns_of(generated(name))
]


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize(("name", "unknown"), SOLVING)
def test_generators_solve_for_every_unknown(name, unknown):
    settings = generated(name)
    layout = layout_of(settings)
    solved = with_unknown(settings, unknown, layout)
    found = layout_of(solved)
    back = with_unknown(solved, "n_sites", found)

    assert (unknown_of(solved), unknown_of(back)) == (unknown, "n_sites")
    assert found.n_sites == pytest.approx(layout.n_sites, rel=0.01)
    assert layout_of(back).n_sites == found.n_sites


@pytest.fixture
def log_polar(make_session, settings):
    parameters = {"n_sectors": 64, "min_size_um": 4.0, "r_max_um": 200.0}
    return make_session(
        start={**settings, "layout": {"generator": "log_polar", "parameters": parameters, "mosaic": ["RG", "GB"]}}
    )


def parameters_of(state):
    assert state["errors"] == {}
    return {key: value for key, value in state["settings"]["layout"]["parameters"].items() if key != "r_max_um"}


def test_a_number_of_photosites_can_be_entered(log_polar):
    state = log_polar.do(do="set", key="layout.parameters.n_sites", value=3000, id=1)

    assert parameters_of(state) == {"min_size_um": 4.0, "n_sites": 3000}
    assert state["summary"]["n_sites"] == pytest.approx(3000, rel=0.01)
    assert state["solved"]["layout.parameters.n_sectors"] == 198
    # One step of the history.
    assert parameters_of(log_polar.do(do="undo", id=2)) == {"n_sectors": 64, "min_size_um": 4.0}


def test_a_given_parameter_replaces_the_number(log_polar):
    log_polar.do(do="set", key="layout.parameters.n_sites", value=3000, id=1)
    assert parameters_of(log_polar.do(do="set", key="layout.parameters.n_sectors", value=80, id=2)) == {
        "n_sectors": 80,
        "min_size_um": 4.0,
    }


def test_a_removed_parameter_follows_from_the_number(log_polar):
    n_sites = log_polar.do(do="refresh")["summary"]["n_sites"]
    state = log_polar.do(do="delete", key="layout.parameters.n_sectors", id=1)
    assert parameters_of(state) == {"min_size_um": 4.0, "n_sites": n_sites}
    assert parameters_of(log_polar.do(do="delete", key="layout.parameters.n_sites", id=2)) == {
        "n_sectors": 64,
        "min_size_um": 4.0,
    }


def test_unknown_is_chosen_in_one_step(log_polar):
    state = log_polar.do(do="solve", name="min_size_um", id=1)
    n_sites = state["summary"]["n_sites"]
    assert parameters_of(state) == {"n_sectors": 64, "n_sites": n_sites}
    assert state["solved"]["layout.parameters.min_size_um"] == pytest.approx(4.0, rel=0.05)
    state = log_polar.do(do="set", key="layout.parameters.n_sites", value=2000, id=2)
    assert parameters_of(state) == {"n_sectors": 64, "n_sites": 2000}
    assert "must be one of" in log_polar.do(do="solve", name="pitch_um", id=3)["errors"]["solve"]


@pytest.mark.parametrize("key", ["n_x", "pitch_um"])
def test_rasters_keep_their_field(make_session, settings, key):
    recorder = make_session(start=settings)
    before = recorder.do(do="refresh")["summary"]
    state = recorder.do(do="set", key="layout.parameters.n_sites", value=900, id=1)
    assert state["summary"]["n_sites"] == pytest.approx(900, rel=0.05)
    assert state["summary"]["width_um"] == pytest.approx(before["width_um"])
    assert state["summary"]["height_um"] == pytest.approx(before["height_um"], rel=0.05)
    state = recorder.do(do="set", key=f"layout.parameters.{key}", value=8, id=2)
    assert state["errors"] == {}


def test_controls_have_the_unknown(settings):
    parameters = {"n_sites": 6000, "min_size_um": 3.0, "r_max_um": 600.0}
    controls = controls_of({**settings, "layout": {"generator": "log_polar", "parameters": parameters}})
    solve = next(each for each in controls if each["id"] == "layout.parameters:solve")

    assert (solve["value"], [choice["value"] for choice in solve["choices"]]) == (
        "n_sectors",
        ["n_sites", "n_sectors", "min_size_um"],
    )
    assert not any(each["id"].endswith(":solve") for each in controls_of({**settings, "layout": {"file": "chip.gds"}}))


# -- rules --------------------------------------------------------------------------------------------------------------------


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("name", list(LAYOUTS))
def test_generators_start_without_violations(name):
    """With the rules and the filters of the demo."""
    settings = start_settings(None)[0]
    recorder = Recorder(WithoutThread("test", Start(settings, "demo"), n_threads=1))
    try:
        state = choose(recorder, name.replace("_", " "))
        result = recorder.session.result
        assert state["errors"] == {}
        assert result.capture.layout.check(result.shot.rules).ok
    finally:
        recorder.session.close()


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("name", [name for name in bundled_layouts() if name != "spectral_16"])
def test_bundled_layouts_lie_in_the_image(name):
    """At the gaze of the demo, which is off the axis."""
    settings = start_settings(None)[0]
    recorder = Recorder(WithoutThread("test", Start(settings, "demo"), n_threads=1))
    try:
        state = recorder.do(do="preset", name=f"layout:{name}")
        assert state["errors"] == {}
        assert not any("outside the image" in warning for warning in state["warnings"])
    finally:
        recorder.session.close()


# -- unknowns and edits -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def of_layout(make_session, settings):
    def make(generator, parameters, **more):
        layout = {"generator": generator, "parameters": parameters, **more}
        plain = {**settings, "layout": layout, "sensor": {"qe": 0.6}}
        plain["scene"] = {**settings["scene"], "shape": [256, 256], "pitch_um": 1000.0}
        return make_session(start=plain)

    return make


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize(
    ("generator", "parameters", "edits"),
    [
        ("grid", {"n_x": 20, "n_y": 13, "pitch_um": 8.0, "trench_um": 1.0}, []),
        ("grid", {"n_x": 20, "n_y": 13, "pitch_um": 8.0, "fill_factor": 0.5}, []),
        ("grid", {"n_x": 20, "n_y": 20, "pitch_um": 8.0}, [{"kind": "scale", "factor": 1.2}]),
        ("grid", {"n_x": 20, "n_y": 20, "pitch_um": 8.0}, [{"kind": "rotate", "angle_deg": 45.0}]),
        ("hexagonal", {"n_columns": 20, "n_rows": 23, "pitch_um": 8.0}, []),
        (
            "log_polar",
            {"n_sectors": 32, "min_size_um": 6.0, "r_max_um": 150.0},
            [{"kind": "split", "n_x": 2, "n_y": 1}],
        ),
    ],
)
def test_unknowns_keep_number_and_field(of_layout, generator, parameters, edits):
    recorder = of_layout(generator, parameters, edits=edits)
    before = recorder.do(do="refresh")["summary"]
    names = list(unknowns_of(recorder.session.history.settings))
    for k, name in enumerate([*names[1:], *reversed(names), *names], 1):
        state = recorder.do(do="solve", name=name, id=k)
        assert state["errors"] == {}
        assert state["summary"]["n_sites"] == before["n_sites"]
        # The outermost ring of log-polar layouts ends at the last complete one.
        tolerance = 0.15 if generator == "log_polar" else 0.03
        assert state["summary"]["width_um"] == pytest.approx(before["width_um"], rel=tolerance)


def test_numbers_are_the_nearest_possible_ones(of_layout):
    recorder = of_layout("grid", {"n_x": 20, "n_y": 20, "pitch_um": 8.0})
    for wanted in (410, 430, 450, 500, 900):
        state = recorder.do(do="set", key="layout.parameters.n_sites", value=wanted)
        assert state["errors"] == {}
        assert state["summary"]["n_sites"] == pytest.approx(wanted, rel=0.06)
        assert state["settings"]["layout"]["parameters"]["n_sites"] == pytest.approx(
            state["summary"]["n_sites"], rel=0.01
        )
    assert recorder.do(do="set", key="layout.parameters.n_y", value=10)["errors"] == {}
    for wrong in ("abc", 1.5, -3):
        before = recorder.session.history.settings
        state = recorder.do(do="set", key="layout.parameters.n_sites", value=wrong)
        assert list(state["errors"]) == ["layout.parameters.n_sites"]
        assert state["settings"] == before


@pytest.mark.parametrize(("key", "other"), [("pitch_um", "size_um"), ("size_um", "pitch_um")])
def test_removed_size_follows(of_layout, key, other):
    recorder = of_layout("grid", {"n_x": 20, "n_y": 20, "pitch_um": 8.0})
    recorder.do(do="solve", name={"size_um": "pitch_um", "pitch_um": "columns"}[key])
    state = recorder.do(do="delete", key=f"layout.parameters.{key}")
    assert state["errors"] == {}
    assert other in state["settings"]["layout"]["parameters"]
    assert state["summary"]["n_sites"] == 400


def test_waiting_changes_build_on_each_other(of_layout):
    recorder = of_layout("grid", {"n_x": 20, "n_y": 20, "pitch_um": 8.0})
    changes = [{"do": "set", "key": "layout.parameters.n_x", "value": 40, "final": True, "id": 1}]
    state = recorder.handle([*changes, {"do": "solve", "name": "pitch_um", "id": 2}])
    assert state["settings"]["layout"]["parameters"] == {"size_um": [320.0, 160.0], "n_sites": 800}
    assert state["summary"]["n_sites"] == 800


def test_opened_settings_remain_as_written(recorder):
    """A colouring of the file equals the one that the former layout received."""
    recorder.do(do="set", key="sensor.filters", value="rgb")
    choose(recorder, "sunflower")
    content = (
        Path(demo_settings()[0])
        .read_text()
        .replace("mosaic: [RG, GB]", "edits: [{kind: graph_colouring, n_channels: 3}]")
    )
    assert "graph_colouring" in content
    path = recorder.session.add_file("own.yaml", content.encode())
    state = recorder.do(do="file", path=str(path), **{"as": "settings"})
    assert state["errors"] == {}
    assert state["settings"]["layout"]["edits"] == [{"kind": "graph_colouring", "n_channels": 3}]
    assert "mosaic" not in state["settings"]["layout"]


def test_colouring_ends_with_the_filters(recorder):
    choose(recorder, "sunflower")
    state = recorder.do(do="set", key="sensor.filters", value=None)
    assert state["errors"] == {}
    assert not state["settings"]["layout"].get("edits")

"""Choices of layouts: filters that follow the generator, and the parameter that a generator solves for."""

from __future__ import annotations

import pytest
from studio.conftest import Recorder, WithoutThread
from studio.test_session import code_part, codes_of

from foveasim.config import bundled_layouts
from foveasim.layout import LAYOUTS
from foveasim.studio._files import start_settings
from foveasim.studio._session import Start
from foveasim.studio._settings.controls import controls_of
from foveasim.studio._settings.templates import SECTIONS, WITHOUT_MOSAIC
from foveasim.studio._settings.unknowns import unknown_of, unknowns_of, with_unknown


def choose(recorder, label, **message):
    control = next(each for each in recorder.session._controls if each["id"] == "layout")
    value = next(choice["value"] for choice in control["choices"] if choice["label"] == label)
    return recorder.do(do="set", key="layout", value=value, final=True, **message)


# -- filters ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("other", WITHOUT_MOSAIC)
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


def test_filters_bring_their_mosaic(recorder):
    recorder.do(do="set", key="sensor.filters", value=None)
    choose(recorder, "sunflower")
    without = choose(recorder, "voronoi")["settings"]["layout"]
    coloured = recorder.do(do="set", key="sensor.filters", value="rgb")["settings"]["layout"]

    assert "edits" not in without
    assert coloured["edits"] == [{"kind": "graph_colouring", "n_channels": 3}]


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

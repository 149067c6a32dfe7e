"""Previews with a reduced scene, the complete result after them, and simulations that stop early."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest
from PIL import Image
from studio.conftest import ALL_VIEWS
from waiting import DEADLINE_S, wait_until

from foveasim.config import build_shot
from foveasim.studio import _engine, _queue, _session
from foveasim.studio._costs import Costs, SupersededError
from foveasim.studio._engine import Engine, block_means
from foveasim.studio._messages.encoding import decode_part
from foveasim.studio._messages.models import SetValue, ShowFrame
from foveasim.studio._session import Session, Start


@pytest.fixture
def large(settings, monkeypatch):
    """Settings whose scene of 64 x 64 pixels is too large for previews."""
    monkeypatch.setattr(_engine, "PREVIEW_CELLS", 32 * 32)
    return settings


def codes_of(settings):
    shot = build_shot(None, settings)
    return shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed).code


def drag(recorder, *values, key="optics.f_number"):
    return [recorder.do(do="set", key=key, value=value, final=False) for value in values]


def done_of(recorder):
    return [message for message in recorder.messages if message["kind"] == "done"]


# -- reduced scenes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("block", [1, 2, 3])
def test_blocks_have_mean_of_cells(block):
    cells = np.arange(7 * 8, dtype=np.float64).reshape(7, 8)
    found = block_means(cells, block)

    assert found.shape == (7 // block, 8 // block)
    assert found[0, 0] == cells[:block, :block].mean()
    assert found[-1, -1] == cells[: 7 // block * block, : 8 // block * block][-block:, -block:].mean()


def test_preview_conserves_flux_and_position(large):
    engine = Engine(n_threads=1)
    full, reduced = engine.simulate(large), engine.simulate(large, is_preview=True)
    images = [list(result.images.values()) for result in (full, reduced)]

    assert (full.is_preview, reduced.is_preview) == (False, True)
    assert reduced.shot.scene.basis.shape == (full.shot.scene.basis.shape[0], 32, 32)
    assert reduced.shot.camera.image_grid(reduced.shot.scene).bounds_um == pytest.approx(
        full.shot.camera.image_grid(full.shot.scene).bounds_um
    )
    assert [image.mean() for image in images[1]] == pytest.approx([image.mean() for image in images[0]], rel=1e-3)


def test_small_scenes_are_not_reduced(settings):
    result = Engine(n_threads=1).simulate(settings, is_preview=True)

    assert not result.is_preview
    assert np.array_equal(result.capture.code, codes_of(settings))


def test_scenes_with_fit_are_reduced(large, tmp_path):
    pixels = np.random.default_rng(1).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "photo.png")
    large["scene"] = {
        "kind": "picture", "picture": str(tmp_path / "photo.png"), "fit": "cover", "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 0.02, "wavelength_nm": [620, 550, 450],
    }  # fmt: skip
    engine = Engine(n_threads=1)
    full, reduced = engine.simulate(large), engine.simulate(large, is_preview=True)

    assert reduced.is_preview
    pitches_um = [result.shot.camera.fit_scene(result.shot.scene).pitch_um for result in (full, reduced)]
    assert pitches_um[1] == pytest.approx(2.0 * pitches_um[0])


# -- sessions ---------------------------------------------------------------------------------------------------------------


@ALL_VIEWS
def test_final_codes_after_previews_are_exact(large, make_session):
    recorder = make_session(start=large)
    for state in drag(recorder, 3.0, 3.5, 4.0):
        assert state["is_preview"]
    assert done_of(recorder)[0]["is_preview"]
    assert all(header.get("is_preview") for header, _ in recorder.parts)
    state = recorder.do(do="set", key="optics.f_number", value=4.0, final=True)

    assert not state["is_preview"]
    assert not done_of(recorder)[0]["is_preview"]
    assert not any(header.get("is_preview") for header, _ in recorder.parts)
    assert {"columns", "picture", "scene"} <= set(recorder.part_names)
    assert np.array_equal(
        recorder.session.result.capture.code, codes_of({**large, "optics": {**large["optics"], "f_number": 4.0}})
    )


@pytest.mark.parametrize("following", [{"do": "undo"}, {"do": "reset", "key": "optics.f_number"}, {"do": "freeze"}])
def test_messages_after_drags_have_complete_results(large, make_session, following):
    recorder = make_session(start=large)
    drag(recorder, 3.0, 4.0)
    state = recorder.do(**following)

    assert not state["is_preview"]
    assert np.array_equal(recorder.session.result.capture.code, codes_of(state["settings"]))


def test_invalid_value_after_drag_completes_the_draft(large, make_session):
    recorder = make_session(start=large)
    drag(recorder, 4.0)
    state = recorder.do(do="set", key="optics.f_number", value=-1.0, final=True)

    assert "optics.f_number" in state["errors"]
    recorder.messages.clear()
    recorder.session._complete()
    assert not recorder.session.is_preview
    assert np.array_equal(recorder.session.result.capture.code, codes_of(state["settings"]))


def test_fast_settings_have_no_previews(large, make_session):
    recorder = make_session(start=large)
    state = drag(recorder, 0.02, key="exposure_s")[-1]
    assert not state["is_preview"]
    # The time of a complete simulation is known after the first step.
    recorder.do(do="set", key="optics.f_number", value=4.0, final=True)
    recorder.session.costs._simulation_s["optics.f_number"] = 0.02
    assert not drag(recorder, 5.0)[-1]["is_preview"]


def test_slow_views_wait_while_dragging(recorder):
    recorder.session.costs.add_part("layout.parameters.pitch_um", "picture", 0.5)
    drag(recorder, 13.0, key="layout.parameters.pitch_um")
    assert "picture" not in recorder.part_names
    assert "columns" in recorder.part_names
    assert done_of(recorder)[0]["is_preview"]
    recorder.do(do="set", key="layout.parameters.pitch_um", value=13.0, final=True)

    assert recorder.part_names == ["picture"]
    assert not done_of(recorder)[0]["is_preview"]


@pytest.mark.parametrize("slow", ["sites", "columns"])
def test_sites_arrive_before_their_values(recorder, slow):
    costs = recorder.session.costs
    for key in ("layout.parameters.pitch_um", None):
        costs.add_part(key, slow, 1.0)
    recorder.do(do="set", key="layout.parameters.pitch_um", value=12.5, final=False)
    assert not {"sites", "columns"} & set(recorder.part_names)  # both wait for the rest
    recorder.do(do="set", key="seed", value=9, final=False)
    recorder.do(do="set", key="layout.parameters.pitch_um", value=11.5, final=True)

    assert recorder.part_names[:2] == ["sites", "columns"]


def test_layers_are_not_computed_while_dragging(recorder):
    recorder.do(do="views", names=["sites", "columns", "solid"])
    assert "solid" in recorder.part_names
    drag(recorder, 13.0, key="layout.parameters.pitch_um")
    assert "solid" not in recorder.part_names
    recorder.parts.clear()
    recorder.session._complete()
    assert recorder.part_names == ["solid"]


def test_costs_remember_slow_changes():
    costs = Costs()
    assert costs.is_slow("optics.f_number")
    assert not costs.is_slow("seed")
    costs.add_simulation("optics.f_number", 1.0)
    costs.add_simulation("optics.f_number", 1e-3)  # from the cache
    assert costs.is_slow("optics.f_number")
    for _ in range(3):
        costs.add_simulation("optics.f_number", 1e-3)
    assert not costs.is_slow("optics.f_number")


class Listener:
    """Messages of a session with its thread."""

    def __init__(self, session):
        self.messages = []
        self.event = threading.Condition()
        session.attach(self)

    def __call__(self, message):
        with self.event:
            self.messages.append(decode_part(message)[0] if isinstance(message, bytes) else json.loads(message))
            self.event.notify_all()

    def wait(self, condition, timeout_s=DEADLINE_S):
        with self.event:
            assert self.event.wait_for(lambda: any(map(condition, self.messages)), timeout_s)


@pytest.fixture
def make_threaded():
    made = []

    def make(settings):
        made.append(Session("test", Start(settings, "small"), n_threads=1))
        return made[-1]

    yield make
    for session in made:
        session.close()


@pytest.mark.slow
def test_rest_completes_a_preview(large, make_threaded):
    session = make_threaded(large)
    listener = Listener(session)
    session.post({"do": "set", "key": "optics.f_number", "value": 4.0, "final": False, "id": 5})
    listener.wait(lambda m: m.get("kind") == "done" and m["id"] == 5 and m["is_preview"])
    listener.wait(lambda m: m.get("kind") == "done" and m["id"] == 5 and not m["is_preview"])

    assert np.array_equal(
        session.result.capture.code, codes_of({**large, "optics": {**large["optics"], "f_number": 4.0}})
    )


def test_rest_releases_unused_memory(settings, make_threaded, monkeypatch):
    released = threading.Event()
    monkeypatch.setattr(_session, "RELEASE_S", 0.05)
    monkeypatch.setattr(_session, "release_memory", released.set)
    session = make_threaded(settings)
    for number in (1, 2):
        session.post({"do": "set", "key": "seed", "value": number, "final": True})
        assert released.wait(DEADLINE_S), number
        released.clear()

    # Once in each rest: the thread next wakes up to forget its result.
    assert session._idle_work().after_s == _session.FORGET_S


@pytest.mark.slow
def test_complete_result_releases_memory(large, make_threaded, monkeypatch):
    released = threading.Event()
    monkeypatch.setattr(_session, "RELEASE_S", 0.05)
    monkeypatch.setattr(_session, "release_memory", released.set)
    session = make_threaded(large)
    listener = Listener(session)
    session.post({"do": "set", "key": "optics.f_number", "value": 4.0, "final": False, "id": 5})
    listener.wait(lambda m: m.get("kind") == "done" and m["id"] == 5 and not m["is_preview"])

    assert released.wait(DEADLINE_S)


# -- interruption -----------------------------------------------------------------------------------------------------------


def test_closing_stops_the_simulation(settings, make_threaded, monkeypatch):
    is_started = threading.Event()
    monkeypatch.setattr(Session, "check", slowly(Session.check, is_started))
    session = make_threaded(settings)
    session.post({"do": "refresh"})
    assert is_started.wait(DEADLINE_S)
    session.close()
    session._thread.join(DEADLINE_S)

    assert session.result is None
    assert not session.uploads.exists()


def slowly(check, is_started):
    """Return a check that waits until the session is closed."""

    def wait(session, stage):
        is_started.set()
        wait_until(lambda: session.queue.is_closed)
        check(session, stage)

    return wait


def test_check_stops_before_the_next_stage(settings):
    built = []

    def check(_stage):
        built.append(dict(engine.n_built))
        if engine.n_built.get("scene"):
            raise SupersededError

    engine = Engine(n_threads=1, check=check)
    with pytest.raises(SupersededError):
        engine.simulate(settings)

    assert "power on sites" not in engine.n_built
    assert engine.n_built["layout"] == 1


@pytest.mark.slow
def test_newer_change_stops_a_simulation(settings, make_threaded, monkeypatch):
    session = make_threaded(settings)
    listener = Listener(session)
    listener.wait(lambda m: m.get("kind") == "done")
    started, has_newer = threading.Event(), threading.Event()
    stages = []
    make = session.engine._runner.check

    def slow_check(stage):
        stages.append(stage)
        started.set()
        assert has_newer.wait(DEADLINE_S)
        make(stage)

    session.engine._runner.check = slow_check
    session.post({"do": "set", "key": "optics.f_number", "value": 4.0, "final": True, "id": 1})
    assert started.wait(DEADLINE_S)
    n_before = len(stages)
    session.post({"do": "set", "key": "sensor.bits", "value": 8, "final": True, "id": 2})
    has_newer.set()
    listener.wait(lambda m: m.get("kind") == "done" and m["id"] == 2)

    states = [m for m in listener.messages if m.get("kind") == "state" and m["id"] in (1, 2)]
    assert [state["id"] for state in states] == [2]
    assert n_before == 1
    assert (states[0]["settings"]["optics"]["f_number"], states[0]["settings"]["sensor"]["bits"]) == (4.0, 8)
    assert np.array_equal(session.result.capture.code, codes_of(states[0]["settings"]))
    # Both are steps of their own.
    session.post({"do": "undo", "id": 3})
    listener.wait(lambda m: m.get("kind") == "done" and m["id"] == 3)
    assert session.history.settings["optics"]["f_number"] == 4.0
    assert session.history.settings["sensor"]["bits"] == 10


def test_endless_changes_are_not_stopped_forever(recorder, monkeypatch):
    session = recorder.session
    session._can_stop = True
    session.queue.add(SetValue(key="seed", value=1))
    with pytest.raises(SupersededError):
        session.check("capture")
    monkeypatch.setattr(_queue, "MAX_STOPPED_S", 0.0)
    session.check("capture")
    session.queue.waiting.clear()
    session.check("capture")


def test_frames_stop_no_simulation(recorder):
    session = recorder.session
    session._can_stop = True
    session.queue.add(ShowFrame(n=3))
    session.check("capture")

"""Studies: optima that are known in closed form, fronts against a slow twin, and the same search after any end."""

from __future__ import annotations

import json

import numpy as np
import optuna
import pytest

from foveasim import explore
from foveasim.config import build_shot
from foveasim.errors import ConfigError, FileError, ParameterError
from foveasim.explore.studies import study

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
    "layout": {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 3.0}},
    "sensor": {"read_noise_e": 2.0, "capacitance_f": 4e-15, "dark_e_per_s": 0.0},
    "exposure_s": 0.0001,
}
WANTED_E = 1000.0


def off_e(_shot, _camera, capture):
    """How far the expected charge is from what is wanted."""
    return abs(float(capture.expected_e.mean()) - WANTED_E)


def test_a_study_finds_the_exposure_that_is_known():
    """Without dark charge the charge is in proportion to the exposure: one capture tells which gives what is wanted."""
    shot = build_shot("known", SHOT)
    one = shot.camera.capture(shot.scene, exposure_s=1e-4, seed=0)
    known_s = 1e-4 * WANTED_E / one.expected_e.mean()

    found = explore.study(
        SHOT,
        {"exposure_s": {"from": 1e-6, "to": 1e-2, "spacing": "geometric"}},
        {"off_e": "minimize"},
        n_trials=60,
        metrics=[off_e],
        seed=1,
    )

    # Of 60 draws even in the logarithm the nearest is typically 8 % off.
    assert found.best_trial.params["exposure_s"] == pytest.approx(known_s, rel=0.03)


def perimeter(_shot, _camera, capture):
    x0, y0, x1, y1 = capture.layout.bounds_um
    return 2.0 * (x1 - x0 + y1 - y0)


def test_a_study_of_two_objectives_gives_the_front_within_the_constraints():
    found = explore.study(
        SHOT,
        {
            "layout.parameters.n_x": (4, 14),
            "layout.parameters.n_y": [4, 8, 12],
            "sensor.bits": {"from": 8, "to": 12, "step": 2},
        },
        {"n_sites": "maximize", "perimeter": "minimize"},
        constraints={"n_sites": (None, 80)},
        metrics=["n_sites", perimeter],
        n_trials=40,
    )
    trials = found.get_trials(states=(optuna.trial.TrialState.COMPLETE,))
    allowed = [t for t in trials if t.values[0] <= 80]

    def is_beaten(one):
        return any(
            o.values != one.values and o.values[0] >= one.values[0] and o.values[1] <= one.values[1] for o in allowed
        )

    assert len(trials) == 40
    assert len(allowed) < 40
    front = {t.number for t in allowed if not is_beaten(t)}
    assert {t.number for t in found.best_trials} == front
    assert len(front) > 2
    for trial in trials:
        n_x, n_y, bits = (
            trial.params[path] for path in ("layout.parameters.n_x", "layout.parameters.n_y", "sensor.bits")
        )
        assert trial.values[0] == trial.user_attrs["n_sites"] == n_x * json.loads(n_y)
        assert bits in (8, 10, 12)


def test_a_setting_is_searched_in_the_numbers_that_it_takes_however_the_ends_are_written():
    found = explore.study(
        SHOT,
        {
            "optics.f_number": (2, 16),
            "sensor.read_noise_e": {"from": 1, "to": 9, "spacing": "geometric"},
            "sensor.bits": (6, 14),
            "layout.parameters.n_x": {"from": 2, "to": 20},
        },
        {"snr_mean": "maximize"},
        n_trials=12,
    )
    f_number, read_noise_e, bits, n_x = (
        np.array([t.params[path] for t in found.trials]) for path in found.trials[0].params
    )

    assert (f_number % 1.0 != 0.0).all()
    assert (read_noise_e % 1.0 != 0.0).all()
    assert bits.dtype.kind == n_x.dtype.kind == "i"
    assert not any(t.user_attrs.get("error") for t in found.trials)


SEARCH = {"exposure_s": (1e-5, 1e-3), "optics.emission": ["lambertian", "isotropic"]}


def told(study):
    return [
        (t.params, t.values, t.user_attrs.get("error"))
        for t in study.trials
        if not t.user_attrs.get("ended with the program")
    ]


def test_a_study_that_was_ended_goes_on_as_if_it_was_not(tmp_path):
    def run(n_trials, **options):
        return explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=n_trials, seed=5, **options)

    whole = run(20)
    cut = run(13, storage=tmp_path / "study.db")
    cut.ask()  # a program that is killed leaves a trial that runs for ever
    again = run(20, storage=tmp_path / "study.db")

    assert told(again) == told(whole)
    assert len(again.trials) == 21
    assert told(run(20, storage=f"sqlite:///{tmp_path}/study.db")) == told(whole)
    assert told(explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=20, seed=6)) != told(whole)


@pytest.mark.parametrize("n_workers", [1, 2])
def test_batches_do_not_depend_on_workers(n_workers):
    def run(**options):
        return explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=24, seed=5, batch=6, **options)

    assert told(run(workers=n_workers)) == told(run())


def test_batch_larger_than_one_changes_the_search():
    one, many = (
        explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=24, seed=5, batch=batch) for batch in (1, 12)
    )

    # The first trials are random in any case.
    assert told(one)[:10] == told(many)[:10]
    assert told(one) != told(many)


@pytest.mark.parametrize("stopped_at", [13, 17, 18])
def test_interrupted_batch_resumes_bit_identically(stopped_at, tmp_path, monkeypatch):
    def run(**options):
        return explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=24, seed=5, batch=6, **options)

    whole = run()
    store_result, n_stored = study._store_result, []

    def interrupted(*args):
        if len(n_stored) == stopped_at:
            raise KeyboardInterrupt
        n_stored.append(None)
        store_result(*args)

    monkeypatch.setattr(study, "_store_result", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(storage=tmp_path / "study.db")
    monkeypatch.undo()

    assert told(run(storage=tmp_path / "study.db")) == told(whole)


def test_trials_are_a_multiple_of_batch():
    with pytest.raises(ParameterError, match="'n_trials' must be a multiple of the batch of 4, got 6"):
        explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=6, batch=4)


def test_two_programs_do_not_write_the_same_study(tmp_path):
    def run(file, metric):
        explore.study(SHOT, SEARCH, {"m": "maximize"}, n_trials=3, metrics={"m": metric}, storage=file)

    def meddle(*_):
        with pytest.raises(FileError, match="is being written by another program that runs a study"):
            run(f"sqlite:///{tmp_path}/s.db", len)
        return 1.0

    run(tmp_path / "s.db", meddle)

    assert [path.name for path in tmp_path.iterdir()] == ["s.db"]
    found = optuna.load_study(study_name="study", storage=f"sqlite:///{tmp_path}/s.db")
    assert [trial.value for trial in found.trials] == [1.0] * 3


def test_a_program_ends_when_another_machine_goes_on_with_its_study(tmp_path):
    """As there: the same study is signed by another program, while a trial runs."""
    calls = []

    def overtaken(*_):
        calls.append(1)
        if len(calls) == 3:
            optuna.load_study(study_name="study", storage=f"sqlite:///{tmp_path}/s.db").set_user_attr("writer", "other")
        return 1.0

    with pytest.raises(FileError, match="is being written by another program, which has begun to run the same study"):
        explore.study(SHOT, SEARCH, {"m": "maximize"}, n_trials=9, metrics={"m": overtaken}, storage=tmp_path / "s.db")

    found = optuna.load_study(study_name="study", storage=f"sqlite:///{tmp_path}/s.db")
    assert [trial.value for trial in explore.finished_trials(found)] == [1.0] * 2
    assert len(found.trials) == 3
    assert all(trial.state.is_finished() for trial in found.trials)


def test_a_study_of_another_function_of_the_same_name_is_another(tmp_path):
    for level in (1.0, 2.0):
        given = {"n_trials": 1, "metrics": {"m": lambda *_, level=level: level}, "storage": tmp_path / "s.db"}
        if level == 1.0:
            explore.study(SHOT, SEARCH, {"m": "maximize"}, **given)
        else:
            with pytest.raises(FileError, match=r"'metrics\.m' differs"):
                explore.study(SHOT, SEARCH, {"m": "maximize"}, **given)


def test_a_study_ends_with_ctrl_c_and_not_with_what_else_a_metric_raises():
    def run(kind):
        def rude(*_):
            raise kind("why")

        return explore.study(SHOT, SEARCH, {"m": "maximize"}, n_trials=1, metrics={"m": rude})

    assert run(SystemExit).trials[0].user_attrs["error"] == "m: SystemExit: why"
    with pytest.raises(KeyboardInterrupt):
        run(KeyboardInterrupt)


def test_an_array_is_told_to_be_no_objective():
    found = explore.study(SHOT, SEARCH, {"m": "maximize"}, n_trials=1, metrics={"m": lambda *_: np.zeros(3)})

    assert found.trials[0].user_attrs["error"] == "'m' is an array, no finite number"


def test_trials_that_fail_are_told_and_the_others_go_on():
    found = explore.study(
        SHOT,
        {"exposure_s": [1e-4, -1.0, 1.0]},
        {"snr_mean": "maximize"},
        n_trials=15,
        constraints={"n_sites": (1, None)},
    )
    by_choice = {json.loads(t.params["exposure_s"]): t for t in found.trials}

    assert np.isfinite(by_choice[1e-4].value)
    assert by_choice[-1.0].user_attrs["error"].endswith("exposure_s: must be >= 0, got -1.0 s")
    assert by_choice[1.0].user_attrs["error"] == "'snr_mean' is nan, no finite number"
    assert found.best_trial.params["exposure_s"] == "0.0001"


def test_a_study_of_another_plan_is_left_alone(tmp_path):
    explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=2, storage=tmp_path / "s.db")

    with pytest.raises(FileError, match=r"is of another sweep or study: 'search\.exposure_s' differs"):
        explore.study(
            SHOT, SEARCH | {"exposure_s": (1e-5, 1.0)}, {"snr_mean": "maximize"}, n_trials=2, storage=tmp_path / "s.db"
        )
    with pytest.raises(FileError, match="holds a study 'study' with other objectives"):
        explore.study(SHOT, SEARCH, {"snr_mean": "minimize"}, n_trials=2, storage=tmp_path / "s.db")
    other = explore.study(SHOT, SEARCH, {"snr_mean": "minimize"}, n_trials=2, storage=tmp_path / "s.db", name="other")
    assert len(other.trials) == 2


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"search": {}}, ParameterError, "nothing is searched"),
        ({"search": {"sensor.bitz": (8, 10)}}, ConfigError, r"sensor\.bitz: no such setting"),
        ({"search": {"sensor.bits": (8.5, 10.0)}}, ConfigError, r"sensor\.bits: must be a valid integer"),
        ({"search": {"exposure_s": (2.0, 1.0)}}, ParameterError, "two ends, the first the smaller"),
        ({"search": {"exposure_s": (1.0, float("inf"))}}, ParameterError, "two ends"),
        (
            {"search": {"exposure_s": {"from": 0, "to": 1, "spacing": "geometric"}}},
            ParameterError,
            "above 0 for geometric",
        ),
        ({"search": {"exposure_s": {"from": 0, "to": 1, "step": -1}}}, ParameterError, "a step > 0"),
        ({"search": {"exposure_s": {"from": 0, "too": 1}}}, ParameterError, "must have 'from' and 'to'"),
        ({"search": {"exposure_s": []}}, ParameterError, "must be searched in"),
        ({"objectives": {}}, ParameterError, "'objectives' must be names"),
        ({"objectives": {"snr_mean": "up"}}, ParameterError, '"maximize" or "minimize"'),
        ({"objectives": {"beauty": "maximize"}}, ParameterError, "must be results of metrics"),
        ({"constraints": {"n_sites": (None, None)}}, ParameterError, "must have limits"),
        ({"n_trials": 0}, ParameterError, "'n_trials' must be"),
        ({"storage": "/nowhere/at/all.db"}, FileError, "its folder does not exist"),
        ({"storage": "nosuch://base"}, FileError, "cannot be used as a study's storage"),
    ],
)
def test_a_bad_study_ends_before_it_begins_in_one_sentence(change, error, message):
    given = {"search": {"sensor.bits": (8, 10)}, "objectives": {"snr_mean": "maximize"}, "n_trials": 1} | change

    with pytest.raises(error, match=message) as caught:
        explore.study(SHOT, given.pop("search"), given.pop("objectives"), **given)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_storage_is_told_and_left_alone(tmp_path):
    (tmp_path / "notes.db").write_text("my notes")

    with pytest.raises(FileError, match="cannot be used as a study's storage"):
        explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=1, storage=tmp_path / "notes.db")
    assert (tmp_path / "notes.db").read_text() == "my notes"

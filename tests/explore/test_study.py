"""Studies: known optima, Pareto fronts against a brute-force reference, and resuming."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reference.shots import FLAT_SHOT

from foveasim import explore
from foveasim.config import build_shot
from foveasim.errors import ConfigError, FileError, ParameterError
from foveasim.explore.studies import plan, study

SHOT = FLAT_SHOT | {"sensor": FLAT_SHOT["sensor"] | {"dark_e_per_s": 0.0}, "exposure_s": 0.0001}
WANTED_E = 1000.0


def off_e(_shot, _camera, capture):
    """Return the deviation of the mean expected electrons from the target."""
    return abs(float(capture.expected_e.mean()) - WANTED_E)


def test_study_finds_known_optimal_exposure():
    """Without dark signal, electrons are proportional to exposure time, so one capture gives the optimum."""
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

    # The best of 60 log-uniform draws typically deviates by 8 %.
    assert found.best_trial.params["exposure_s"] == pytest.approx(known_s, rel=0.03)


def perimeter(_shot, _camera, capture):
    x0, y0, x1, y1 = capture.layout.bounds_um
    return 2.0 * (x1 - x0 + y1 - y0)


def test_two_objectives_give_constrained_pareto_front():
    from optuna.trial import TrialState

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
    trials = found.get_trials(states=(TrialState.COMPLETE,))
    allowed = [t for t in trials if t.values[0] <= 80]

    def is_dominated(one):
        return any(
            o.values != one.values and o.values[0] >= one.values[0] and o.values[1] <= one.values[1] for o in allowed
        )

    assert len(trials) == 40
    assert len(allowed) < 40
    front = {t.number for t in allowed if not is_dominated(t)}
    assert {t.number for t in found.best_trials} == front
    assert len(front) > 2
    for trial in trials:
        n_x, n_y, bits = (
            trial.params[path] for path in ("layout.parameters.n_x", "layout.parameters.n_y", "sensor.bits")
        )
        assert trial.values[0] == trial.user_attrs["n_sites"] == n_x * n_y
        assert bits in (8, 10, 12)


def test_search_values_have_setting_type():
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


def stored(path):
    """Return the study in a file."""
    import optuna

    return optuna.load_study(study_name="study", storage=f"sqlite:///{path}")


def outcomes(study):
    return [
        (t.number, t.params, t.values, t.user_attrs.get("error"))
        for t in study.trials
        if not t.user_attrs.get("ended with the program")
    ]


@pytest.mark.slow
def test_interrupted_study_resumes_identically(tmp_path):
    """The first ten trials are random, the others depend on them."""

    def run(n_trials, seed=5, **options):
        return explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=n_trials, seed=seed, **options)

    complete = run(14)
    interrupted = run(11, storage=tmp_path / "study.db")
    interrupted.ask()  # a killed program leaves a trial in the running state
    again = run(14, storage=tmp_path / "study.db")

    assert outcomes(again) == outcomes(complete)
    assert len(again.trials) == 14
    assert outcomes(run(14, storage=f"sqlite:///{tmp_path}/study.db")) == outcomes(complete)
    assert outcomes(run(14, seed=6)) != outcomes(complete)
    several = run(11, storage=tmp_path / "several.db")
    for _ in range(2):
        several.ask()  # more trials than a batch: another program left them
    values = [outcome[1:] for outcome in outcomes(run(14, storage=tmp_path / "several.db"))]
    assert values == [outcome[1:] for outcome in outcomes(complete)]


def batches(**options):
    """Run a study in batches, of which the last depends on the results of the others."""
    return explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=16, seed=5, batch=4, **options)


@pytest.fixture(scope="module")
def complete_batches():
    return outcomes(batches())


@pytest.mark.slow
@pytest.mark.parametrize("n_workers", [1, 2])
def test_batches_do_not_depend_on_workers(n_workers, complete_batches):
    assert outcomes(batches(workers=n_workers)) == complete_batches


def test_batch_size_changes_the_search():
    one, many = (
        explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=14, seed=5, batch=batch) for batch in (1, 14)
    )

    # The first trials are random in any case.
    assert outcomes(one)[:10] == outcomes(many)[:10]
    assert outcomes(one) != outcomes(many)


@pytest.mark.slow
@pytest.mark.parametrize("n_values", [1, 2, 5, 7])
def test_study_interrupted_between_values_resumes_identically(n_values, tmp_path, monkeypatch, complete_batches):
    """While the settings of the last batch are sampled."""
    suggest, store_result, stored_results, calls = plan._suggest, study._store_result, [], []

    def interrupted(*args):
        calls.extend([None] * (len(stored_results) == 12))
        if len(calls) > n_values:
            raise KeyboardInterrupt
        return suggest(*args)

    def counted(*args):
        store_result(*args)
        stored_results.append(None)

    monkeypatch.setattr(plan, "_suggest", interrupted)
    monkeypatch.setattr(study, "_store_result", counted)
    with pytest.raises(KeyboardInterrupt):
        batches(storage=tmp_path / "study.db")
    monkeypatch.undo()

    assert outcomes(batches(storage=tmp_path / "study.db")) == complete_batches


@pytest.mark.slow
@pytest.mark.parametrize("stopped_at", [12, 13, 15])
def test_interrupted_batch_resumes_bit_identically(stopped_at, tmp_path, monkeypatch, complete_batches):
    """Before the last batch, after its first trial, and before its last one."""
    store_result, n_stored = study._store_result, []

    def interrupted(*args):
        if len(n_stored) == stopped_at:
            raise KeyboardInterrupt
        n_stored.append(None)
        store_result(*args)

    monkeypatch.setattr(study, "_store_result", interrupted)
    with pytest.raises(KeyboardInterrupt):
        batches(storage=tmp_path / "study.db")
    monkeypatch.undo()

    assert outcomes(batches(storage=tmp_path / "study.db")) == complete_batches


def test_trials_must_be_multiple_of_batch():
    with pytest.raises(ParameterError, match="'n_trials' must be a multiple of the batch size 4, got 6"):
        explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=6, batch=4)


@pytest.mark.slow
def test_study_file_is_locked(tmp_path):
    def run(file, metric):
        explore.study(SHOT, SEARCH, {"m": "maximize"}, n_trials=3, metrics={"m": metric}, storage=file)

    def run_second_program(*_):
        with pytest.raises(FileError, match="is being written by another program that runs a study"):
            run(f"sqlite:///{tmp_path}/s.db", len)
        return 1.0

    run(tmp_path / "s.db", run_second_program)

    assert [path.name for path in tmp_path.iterdir()] == ["s.db"]
    found = stored(tmp_path / "s.db")
    assert [trial.value for trial in found.trials] == [1.0] * 3


def test_writer_stops_when_replaced(tmp_path):
    """Another program registers as the writer of the study while a trial runs."""
    calls = []

    def replace_writer(*_):
        calls.append(1)
        if len(calls) == 3:
            stored(tmp_path / "s.db").set_user_attr("writer", "other")
        return 1.0

    metrics = {"m": replace_writer}
    with pytest.raises(FileError, match="is being written by another program, which runs the same study"):
        explore.study(SHOT, SEARCH, {"m": "maximize"}, n_trials=9, metrics=metrics, storage=tmp_path / "s.db")

    found = stored(tmp_path / "s.db")
    assert [trial.value for trial in explore.finished_trials(found)] == [1.0] * 2
    assert len(found.trials) == 3
    assert all(trial.state.is_finished() for trial in found.trials)


def test_equally_named_metrics_are_distinguished(tmp_path):
    for level in (1.0, 2.0):
        given = {"n_trials": 1, "metrics": {"m": lambda *_, level=level: level}, "storage": tmp_path / "s.db"}
        if level == 1.0:
            explore.study(SHOT, SEARCH, {"m": "maximize"}, **given)
        else:
            with pytest.raises(FileError, match=r"'metrics\.m' differs"):
                explore.study(SHOT, SEARCH, {"m": "maximize"}, **given)


def test_only_ctrl_c_interrupts_study():
    def run(kind):
        def raising(*_):
            raise kind("why")

        return explore.study(SHOT, SEARCH, {"m": "maximize"}, n_trials=1, metrics={"m": raising})

    assert run(SystemExit).trials[0].user_attrs["error"] == "m: SystemExit: why"
    with pytest.raises(KeyboardInterrupt):
        run(KeyboardInterrupt)


def test_array_objective_is_rejected():
    found = explore.study(SHOT, SEARCH, {"m": "maximize"}, n_trials=1, metrics={"m": lambda *_: np.zeros(3)})

    assert found.trials[0].user_attrs["error"] == "'m' must be a finite number, got an array"


def log_margin(shot, camera, capture):
    """Return a logarithm that is not defined for saturated frames."""
    return np.log(1.0 - capture.saturated_fraction) if capture.saturated_fraction < 1.0 else math.nan


def test_failed_trials_are_reported():
    found = explore.study(
        SHOT,
        {"exposure_s": [1e-4, -1.0, 1.0]},
        {"log_margin": "maximize"},
        n_trials=15,
        metrics=[log_margin, "n_sites"],
        constraints={"n_sites": (1, None)},
    )
    by_choice = {t.params["exposure_s"]: t for t in found.trials}

    assert np.isfinite(by_choice[1e-4].value)
    assert (
        by_choice[-1.0]
        .user_attrs["error"]
        .endswith("exposure_s: must be >= 0, got -1.0 s; times are in seconds: 1 ms is 1e-3")
    )
    assert by_choice[1.0].user_attrs["error"] == "'log_margin' must be a finite number, got nan"
    assert found.best_trial.params["exposure_s"] == 1e-4


MIXED_CHOICES = {
    "sensor.bits": [8, 10],
    "sensor.full_well_e": [None, 1e4],
    "optics.emission": ["lambertian", "isotropic"],
    "sensor.read_noise_e": [1, 1.0, 2.5],  # equal numbers of two types
    "layout.move_um": [[0.0, 0.0], [3.0, 0.0]],
    "sensor.qe": [0.5, {"kind": "constant", "value": 0.25}],
}


@pytest.fixture(scope="module")
def mixed_study(tmp_path_factory):
    storage = tmp_path_factory.mktemp("study") / "s.db"
    options = {"n_trials": 12, "metrics": ["snr", "n_sites"], "storage": storage, "seed": 4}
    explore.study(SHOT, MIXED_CHOICES, {"snr_mean": "maximize"}, **options)
    return stored(storage)


@pytest.mark.slow
def test_finished_trials_contain_typed_choices(mixed_study):
    trials = explore.finished_trials(mixed_study)

    assert len(trials) == 12
    for path, choices in MIXED_CHOICES.items():
        found = [trial.params[path] for trial in trials]
        assert all(any(type(value) is type(choice) and value == choice for choice in choices) for value in found)
        assert {str(value) for value in found} == {str(choice) for choice in choices}


def test_best_trials_contain_scalar_choices(mixed_study):
    best = mixed_study.best_trials[0]

    assert best.params["sensor.bits"] in (8, 10)
    assert best.params["sensor.full_well_e"] in (None, 1e4)
    assert best.params["optics.emission"] in MIXED_CHOICES["optics.emission"]


def test_trials_table_matches_trials(mixed_study):
    table = explore.trials_table(mixed_study)
    trials = explore.finished_trials(mixed_study)

    assert table.index.name == "trial"
    assert list(table.index) == [trial.number for trial in trials]
    assert table["sensor.bits"].dtype == np.int64
    assert table["n_sites"].dtype == np.int64
    assert table["snr_mean"].tolist() == [trial.value for trial in trials]
    assert table["layout.move_um"].tolist() == [trial.params["layout.move_um"] for trial in trials]
    assert table.index[table.is_best].tolist() == [trial.number for trial in mixed_study.best_trials]
    assert (table.error == "").all()


def test_trials_table_contains_errors():
    found = explore.study(SHOT, {"exposure_s": [1e-4, -1.0]}, {"snr_mean": "maximize"}, n_trials=6)
    table = explore.trials_table(found).set_index("exposure_s")

    assert np.isfinite(table.loc[1e-4, "snr_mean"]).all()
    assert np.isnan(table.loc[-1.0, "snr_mean"]).all()
    assert table.loc[-1.0, "error"].str.contains("exposure_s: must be").all()
    assert table.loc[1e-4, "is_best"].any()
    assert not table.loc[-1.0, "is_best"].any()


def test_best_table_prints_typed_choices():
    plan = explore.plan_study(SHOT, MIXED_CHOICES, {"snr_mean": "maximize"}, n_trials=6)
    found = explore.run_study(plan)
    best = found.best_trials[0]
    typed = next(t for t in explore.finished_trials(found) if t.number == best.number).params
    cells = [next(iter(column.cells)) for column in explore.best_table(plan, found).columns]

    assert str(cells[-2]) == ("[0.0, 0.0]" if typed["layout.move_um"][0] == 0.0 else "[3.0, 0.0]")
    assert str(cells[2]) == str(typed["sensor.bits"])
    assert str(cells[4]) == typed["optics.emission"]


@pytest.mark.slow
def test_study_of_other_plan_is_unchanged(tmp_path):
    explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=1, storage=tmp_path / "s.db")

    with pytest.raises(FileError, match=r"belongs to another sweep or study: 'search\.exposure_s' differs"):
        explore.study(
            SHOT, SEARCH | {"exposure_s": (1e-5, 1.0)}, {"snr_mean": "maximize"}, n_trials=1, storage=tmp_path / "s.db"
        )
    with pytest.raises(FileError, match="contains a study 'study' with other objectives"):
        explore.study(SHOT, SEARCH, {"snr_mean": "minimize"}, n_trials=1, storage=tmp_path / "s.db")
    other = explore.study(SHOT, SEARCH, {"snr_mean": "minimize"}, n_trials=1, storage=tmp_path / "s.db", name="other")
    assert len(other.trials) == 1


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"search": {}}, ParameterError, "must be a non-empty mapping of setting paths to ranges"),
        ({"search": {"sensor.bitz": (8, 10)}}, ConfigError, r"sensor\.bitz: unknown (key|parameter)"),
        ({"search": {"sensor.bits": (8.5, 10.0)}}, ConfigError, r"sensor\.bits: must be a valid integer"),
        ({"search": {"exposure_s": (2.0, 1.0)}}, ParameterError, "two finite bounds in ascending order"),
        ({"search": {"exposure_s": (1.0, float("inf"))}}, ParameterError, "two finite bounds"),
        (
            {"search": {"exposure_s": {"from": 0, "to": 1, "spacing": "geometric"}}},
            ParameterError,
            "must be > 0 for geometric",
        ),
        ({"search": {"exposure_s": {"from": 0, "to": 1, "step": -1}}}, ParameterError, "a step > 0"),
        ({"search": {"exposure_s": {"from": 0, "too": 1}}}, ParameterError, "must have 'from' and 'to'"),
        ({"search": {"exposure_s": []}}, ParameterError, "must be searched in"),
        ({"objectives": {}}, ParameterError, "'objectives' must map names"),
        ({"objectives": {"snr_mean": "up"}}, ParameterError, '"maximize" or "minimize"'),
        ({"objectives": {"beauty": "maximize"}}, ParameterError, "must be results of metrics"),
        ({"constraints": {"n_sites": (None, None)}}, ParameterError, "must have limits"),
        ({"n_trials": 0}, ParameterError, "'n_trials' must be"),
        ({"storage": "/nowhere/at/all.db"}, FileError, "its directory does not exist"),
        ({"storage": "nosuch://base"}, FileError, "cannot be used as a study's storage"),
    ],
)
def test_invalid_study_is_rejected_before_start(change, error, message):
    given = {"search": {"sensor.bits": (8, 10)}, "objectives": {"snr_mean": "maximize"}, "n_trials": 1} | change

    with pytest.raises(error, match=message) as caught:
        explore.study(SHOT, given.pop("search"), given.pop("objectives"), **given)
    assert "\n" not in str(caught.value)


def test_invalid_storage_file_is_unchanged(tmp_path):
    (tmp_path / "notes.db").write_text("my notes")

    with pytest.raises(FileError, match="cannot be used as a study's storage"):
        explore.study(SHOT, SEARCH, {"snr_mean": "maximize"}, n_trials=1, storage=tmp_path / "notes.db")
    assert (tmp_path / "notes.db").read_text() == "my notes"

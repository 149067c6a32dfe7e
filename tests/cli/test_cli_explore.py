"""Studies and datasets on the command line: equal to calls, resumable, with one line for invalid files."""

from __future__ import annotations

import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
import zipfile
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
import yaml
from cli.conftest import run_here
from PIL import Image
from reference.shots import FLAT_SHOT
from waiting import DEADLINE_S, wait_until

from foveasim import explore, metrics
from foveasim.config import build_shot
from foveasim.errors import ConfigError, FileError, SimulationError
from foveasim.explore import _records
from foveasim.explore._records import Journal, Record
from foveasim.explore.datasets.label_files import match_label_files, read_boxes, read_labels
from foveasim.explore.studies.plan import _suggest
from foveasim.explore.worker_cache import ShotRunner

GALLERY = Path(__file__).parents[2] / "gallery" / "sweeps"
SHOT = FLAT_SHOT | {"sensor": FLAT_SHOT["sensor"] | {"dark_e_per_s": 0.0}, "exposure_s": 0.0001}
STUDY = {
    "shot": "shot.yaml",
    "search": {
        "layout.parameters.n_x": {"from": 4, "to": 13, "step": 2},
        "optics.f_number": {"from": 1.4, "to": 8, "spacing": "geometric"},
        "sensor.bits": [8, 10, 12],
    },
    "objectives": {"snr_mean": "maximize", "n_sites": "minimize"},
    "constraints": {"n_sites": [33, None]},
    "trials": 14,
    "seed": 3,
}
PHOTOGRAPHED = SHOT | {
    "scene": {
        "kind": "picture",
        "pitch_um": 300.0,
        "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 0.05,
        "wavelength_nm": [620, 550, 450],
    },
    "layout": {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 4.0}},
    "exposure_s": 0.01,
}
VARY = {
    "optics.f_number": {"log_uniform": [1.4, 8.0]},
    "sensor.read_noise_e": {"choice": [1.0, 4.0]},
    "layout.parameters.n_x": {"integers": [8, 9]},
}
DATA_SET = {
    "pictures": "photos",
    "shot": "photographed.yaml",
    "vary": {path: VARY[path] for path in ("optics.f_number", "sensor.read_noise_e")},
    "cameras": 2,
    "draws": 2,
    "seed": 7,
}
#: Pictures of two classes, the second before the first in the alphabet.
NAMES = ("dogs/2.png", "dogs/10.png", "cats/1.png")
N_Y, N_X = 40, 48
#: A metric that waits when it was called more often than the file ``held`` says, so that a program can be ended amid trials.
METRICS = """
import os, time
from pathlib import Path

def patient(shot, camera, capture):
    held, calls = (Path(__file__).with_name(name) for name in ("held", "calls"))
    log = os.open(calls, os.O_CREAT | os.O_APPEND | os.O_WRONLY)
    os.write(log, b"x")
    os.close(log)
    while held.exists() and calls.stat().st_size > int(held.read_text()):
        time.sleep(0.01)
    return float(capture.code.mean())

def harsh(shot, camera, capture):
    if camera.sensor.bits > 8:
        raise RuntimeError("no mood")
    return 1.0
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Working directory with a shot, a study, a dataset and metrics."""
    (tmp_path / "shot.yaml").write_text(json.dumps(SHOT))
    (tmp_path / "photographed.yaml").write_text(json.dumps(PHOTOGRAPHED))
    (tmp_path / "study.yaml").write_text(json.dumps(STUDY))
    (tmp_path / "data.yaml").write_text(json.dumps(DATA_SET))
    (tmp_path / "own.py").write_text(METRICS)
    rng = np.random.default_rng(0)
    for name in NAMES:
        (tmp_path / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 256, (N_Y, N_X, 3), np.uint8)).save(tmp_path / "photos" / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def foveasim(folder, monkeypatch, capsys):
    """Run the program in this process: exit code, standard output, standard error."""

    def run(*arguments):
        ended = run_here(monkeypatch, capsys.readouterr, *map(str, arguments), cwd=folder)
        return ended.returncode, ended.stdout, ended.stderr

    return run


def results_of(study):
    """Return numbers, states, parameters and values of a study's trials."""
    return [(t.params, t.values, t.user_attrs.get("error")) for t in explore.finished_trials(study)]


def stored(path, name="study"):
    import optuna

    return optuna.load_study(study_name=name, storage=f"sqlite:///{path}")


def assert_same(one, other):
    assert set(one) == set(other)
    for name, value in one.items():
        np.testing.assert_array_equal(value, other[name], err_msg=name)


def called_study(**options):
    """Run the study of the file as a call in Python."""
    return explore.study(
        SHOT,
        STUDY["search"],
        STUDY["objectives"],
        **{"n_trials": 14, "constraints": {"n_sites": (33, None)}, "seed": 3} | options,
    )


# -- studies ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_study_command_equals_call(foveasim, folder):
    called = called_study()

    code, said, wrong = foveasim("study", "study.yaml")

    assert (code, wrong) == (0, "")
    assert results_of(stored(folder / "study.db")) == results_of(called)
    assert "wrote study.db: 14 trials" in said
    shown = [line.split() for line in said.splitlines() if len(line.split()) == 6 and line.split()[0].isdigit()]
    best = {trial.number: trial for trial in called.best_trials}
    assert {int(number) for number, *_ in shown} <= set(best)
    assert {(row[1], row[2]) for row in shown} == {(f"{t.values[0]:.6g}", f"{t.values[1]:.6g}") for t in best.values()}
    assert [float(row[1]) for row in shown] == sorted((float(row[1]) for row in shown), reverse=True)
    for number, snr, n_sites, n_x, f_number, bits in shown:
        assert int(n_sites) == 8 * int(n_x) > 32
        trial = best[int(number)]
        assert float(snr) == pytest.approx(trial.values[0], rel=1e-5)
        assert float(f_number) == pytest.approx(trial.params["optics.f_number"], rel=1e-5)
        assert int(bits) == trial.params["sensor.bits"]


@pytest.mark.slow
def test_extended_study_equals_longer_study(foveasim, folder):
    for n_trials in (4, 9, 14):
        code, said, _ = foveasim("study", "study.yaml", "--trials", n_trials, "-o", "few.db")
        assert code == 0
        assert f"wrote few.db: {n_trials} trials" in said
    # Fewer trials than exist: the study is unchanged.
    assert "14 trials" in foveasim("study", "study.yaml", "--trials", 2, "--storage", "sqlite:///few.db")[1]

    assert results_of(stored(folder / "few.db")) == results_of(called_study())


def n_begun(path):
    """Return the number of trials in a study's file, opened read-only."""
    try:
        with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as base:
            return base.execute("SELECT count(*) FROM trials").fetchone()[0]
    except sqlite3.OperationalError:  # not yet
        return 0


def ended(end, folder, n_trials):
    """Send a signal to a study after ``n_trials``, before all have ended: its exit code and standard error."""
    calls, held, n_before = folder / "calls", folder / "held", n_begun(folder / "study.db")
    held.write_text(str((calls.stat().st_size if calls.exists() else 0) + n_trials - n_before + 2))
    command = [sys.executable, "-m", "foveasim.cli", "study", "slow.yaml", "--metric", "own:patient"]
    running = subprocess.Popen(
        command, cwd=folder, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    wait_until(lambda: n_begun(folder / "study.db") >= n_trials or running.poll() is not None)
    os.killpg(running.pid, end)
    _, said = running.communicate(timeout=DEADLINE_S)
    return running.returncode, said


#: The process that forks workers waits for the file ``go``.
HELD_FORK_SERVER = """
import os, sys, time
if any("multiprocessing.forkserver" in argument for argument in sys.orig_argv):
    open("starts", "w").close()
    while not os.path.exists("go"):
        time.sleep(0.01)
"""


def at_start(folder, script):
    """Return variables of the environment with which all Python processes first run a script."""
    (folder / "at_start").mkdir()
    (folder / "at_start" / "sitecustomize.py").write_text(script)
    return {"PYTHONPATH": str(folder / "at_start")}


def processes_of(group):
    """Return the processes of a process group."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields = path.read_text().rpartition(")")[2].split()
            if int(fields[2]) == group:
                found.append(int(path.parent.name))
    return found


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(("command", "end"), [("study", signal.SIGTERM), ("sweep", signal.SIGINT)])
def test_signal_while_workers_start_gives_one_line(folder, command, end):
    own = {
        "study": STUDY | {"trials": 400, "batch": 2},
        "sweep": {"shot": "shot.yaml", "vary": {"exposure_s": {"from": 0.001, "to": 0.01, "n": 400}}},
    }[command]
    (folder / "own.yaml").write_text(json.dumps(own))
    running = subprocess.Popen(
        [sys.executable, "-m", "foveasim.cli", command, "own.yaml", "--workers", "2"],
        cwd=folder,
        env=os.environ | at_start(folder, HELD_FORK_SERVER),
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_until((folder / "starts").exists, program=running)
    if end == signal.SIGINT:  # a terminal sends Ctrl-C to all processes
        os.killpg(running.pid, end)
    else:
        running.send_signal(end)
    (folder / "go").touch()
    _, said = running.communicate(timeout=DEADLINE_S)

    assert running.returncode == 128 + end
    assert said.startswith("interrupted; finished ")
    assert said.count("\n") == 1
    assert not list(folder.glob("*.db"))
    wait_until(lambda: not processes_of(running.pid))


def test_failed_study_leaves_no_file(folder, monkeypatch):
    def fail(*_, **__):
        raise SimulationError("the workers did not start")

    monkeypatch.setattr(sys.modules[explore.run_study.__module__], "executor", fail)
    (folder / "own.yaml").write_text(json.dumps(STUDY))
    with pytest.raises(SimulationError, match="did not start"):
        explore.run_study(explore.read_study(folder / "own.yaml"), storage=folder / "own.db")

    assert not list(folder.glob("own.db*"))


@pytest.mark.nightly
def test_study_interrupted_twice_resumes_identically(foveasim, folder, monkeypatch):
    (folder / "slow.yaml").write_text(json.dumps(STUDY | {"trials": 24}))

    code, said = ended(signal.SIGINT, folder, 4)
    n_stop = n_begun(folder / "study.db")

    assert code == 130
    assert said.endswith(
        "interrupted; finished trials are stored in study.db, run the same command again to resume\n"
    )  # after what Optuna may say about the trial that ends
    assert 4 <= n_stop < 14

    code, _ = ended(signal.SIGKILL, folder, n_stop + 4)

    assert code == -signal.SIGKILL
    assert n_stop < n_begun(folder / "study.db") < 24

    (folder / "held").unlink()
    code, _, said = foveasim("study", "slow.yaml", "--metric", "own:patient")
    found = stored(folder / "study.db")

    assert (code, said) == (0, "")
    assert results_of(found) == results_of(called_study(n_trials=24))
    assert {trial.user_attrs["patient"] > 0.0 for trial in explore.finished_trials(found)} == {True}


@pytest.mark.slow
def test_study_without_valid_trial_exits_with_1(foveasim, folder):
    failing = STUDY | {"search": {"exposure_s": [-1.0, -2.0]}, "trials": 3}
    beyond = STUDY | {"constraints": {"n_sites": [None, 5]}, "trials": 2}
    (folder / "failing.yaml").write_text(json.dumps(failing))
    (folder / "beyond.yaml").write_text(json.dumps(beyond))

    code, _, wrong = foveasim("study", "failing.yaml", "-o", "a.db")

    assert code == 1
    assert "3 of 3 trials failed; the first: " in wrong
    assert "exposure_s: must be >= 0, got -" in wrong
    assert wrong.splitlines()[-1] == "no valid trial in a.db: all failed"

    code, _, wrong = foveasim("study", "beyond.yaml", "-o", "b.db")

    assert (code, wrong) == (1, "no valid trial in b.db: all others violate the limits\n")


@pytest.mark.slow
def test_failed_trials_are_reported(foveasim, folder):
    (folder / "some.yaml").write_text(json.dumps(STUDY | {"objectives": {"harsh": "maximize"}, "trials": 8}))

    code, said, wrong = foveasim("study", "some.yaml", "--metric", "own:harsh")
    failed = [t for t in stored(folder / "study.db").trials if t.params["sensor.bits"] != 8]

    assert code == 0
    assert 0 < len(failed) < 8
    assert wrong == f"{len(failed)} of 8 trials failed; the first: harsh: RuntimeError: no mood\n"
    assert "wrote study.db: 8 trials" in said


def test_study_file_equals_call(folder):
    read = explore.read_study(folder / "study.yaml")
    called = explore.plan_study(
        folder / "shot.yaml",
        STUDY["search"],
        STUDY["objectives"],
        n_trials=14,
        constraints={"n_sites": (33, None)},
        seed=3,
    )

    assert read.to_dict() == called.to_dict()
    assert (read.n_trials, read.name) == (14, "study")
    assert set(read.base.metrics) == {"snr", "n_sites"}
    assert read.to_dict()["files"] == {}


@pytest.mark.parametrize(
    ("where", "possible"),
    [
        ({"from": 4, "to": 13, "step": 2}, {4, 6, 8, 10, 12}),
        ({"from": 0.1, "to": 0.75, "step": 0.2}, {0.1, 0.3, 0.5, 0.7}),
        ({"from": 0, "to": 1, "step": 0.3}, {0.0, 0.3, 0.6, 0.9}),
        ({"from": 1, "to": 3}, {1, 2, 3}),
        ((5, 7), {5, 6, 7}),
        ([[1, 2], "a", None], {"[1, 2]", '"a"', "null"}),
    ],
)
def test_range_suggests_its_steps_only(where, possible):
    import optuna

    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    found = [_suggest(study.ask(), "x", where) for _ in range(60)]

    if isinstance(where, list):
        assert {json.dumps(value) for value in found} == possible
        return
    assert {round(value, 12) for value in found} == possible
    assert {type(value) for value in found} == {type(next(iter(possible)))}


def test_study_depends_on_files_of_choices(folder):
    (folder / "deep").mkdir()
    for k in (1, 2):
        grid = {"generator": "grid", "parameters": {"n_x": k, "n_y": k, "pitch_um": 3.0}}
        (folder / "deep" / f"{k}.yaml").write_text(json.dumps(grid))
    search = {"sensor.bits": [8, 10], "layout": ["1.yaml", "2.yaml"]}
    (folder / "deep" / "study.yaml").write_text(json.dumps(STUDY | {"shot": "../shot.yaml", "search": search}))

    plan = explore.read_study(folder / "deep" / "study.yaml")
    found = explore.run_study(plan)

    assert [Path(file).name for file in plan.files] == ["1.yaml", "2.yaml"]
    by_file = {(t.params["layout"], t.user_attrs["n_sites"]) for t in found.trials}
    assert by_file == {("1.yaml", 1), ("2.yaml", 4)}
    (folder / "deep" / "2.yaml").write_text("changed")
    assert explore.read_study(folder / "deep" / "study.yaml").to_dict() != plan.to_dict()


def test_foreign_trials_are_not_changed(foveasim, folder):
    import optuna

    study = optuna.create_study(study_name="study", storage="sqlite:///own.db", directions=["maximize", "minimize"])
    study.tell(study.ask(), [1.0, 2.0])

    code, _, wrong = foveasim("study", "study.yaml", "-o", "own.db")

    assert code == 2
    assert wrong == "error: own.db: contains a study 'study' of another program; use another name\n"
    assert len(stored(folder / "own.db").trials) == 1


@pytest.mark.slow
def test_storage_failure_keeps_finished_trials(folder):
    from optuna.trial import TrialState

    plan = explore.read_study(folder / "study.yaml")

    def spoil(n_done, _):
        if n_done == 3:  # as by another process with the same study
            running = stored(folder / "study.db").ask()
            plan.base.metrics["snr"] = lambda *_: stored(folder / "study.db").tell(
                running.number + 1, state=TrialState.FAIL
            )

    with pytest.raises(
        FileError, match=r"study\.db: cannot be used .*already finished.*; 3 trials are stored"
    ) as caught:
        explore.run_study(plan, storage=folder / "study.db", progress=spoil)
    assert "\n" not in str(caught.value)


def without_positions(message):
    """Return a message without lines and columns, which other tests check."""
    return re.sub(r"(\.yaml):\d+:\d+:", r"\1:", message)


BAD_STUDIES = [
    ({"repeats": 3}, "bad.yaml: repeats: unknown key"),
    (
        {"search": {"sensor.bitz": [8]}},
        "bad.yaml: search.sensor.bitz: unknown parameter of Sensor; did you mean 'bits'?",
    ),
    ({"search": {}}, "bad.yaml: 'search' must be a non-empty mapping of setting paths to ranges"),
    ({"search": {"sensor.bits": []}}, "bad.yaml: 'sensor.bits' must be searched in"),
    ({"search": {"sensor.bits": {"from": 8}}}, "bad.yaml: search.sensor.bits.to: missing"),
    (
        {"search": {"sensor.bits": {"from": 12, "to": 8}}},
        "'sensor.bits' must have two finite bounds in ascending order",
    ),
    (
        {"search": {"sensor.bits": {"from": 8, "to": 10, "step": 3}}},
        "a step > 0 that is at most the width of the range",
    ),
    ({"search": {"sensor.bits": {"from": 8.5, "to": 10}}}, "sensor.bits: must be a valid integer, got 8.5"),
    ({"search": {"seed": [1, 2]}}, "'seed' must not be searched"),
    ({"search": {"layout": ["x.yaml"], "layout.parameters.n_x": [3]}}, "cannot both be searched"),
    (
        {"objectives": {"snr_mean": "up"}},
        "bad.yaml: objectives.snr_mean: must be one of 'maximize', 'minimize', got \"up\"",
    ),
    ({"objectives": {}}, "bad.yaml: 'objectives' must map names of results"),
    ({"objectives": {"beauty": "maximize"}}, "bad.yaml: 'objectives' must be results of metrics, or"),
    ({"constraints": {"beauty": [0, 1]}}, "bad.yaml: 'constraints' must be results of metrics, or"),
    ({"constraints": {"n_sites": [None, None]}}, "'n_sites' must have limits"),
    ({"constraints": {"n_sites": [2, 1]}}, "must have limits (low, high) with low <= high"),
    (
        {"metrics": ["snr"]},
        "'objectives' must be results of metrics, or of those in 'metrics', got 'n_sites'; possible: 'snr'",
    ),
    (
        {"metrics": ["own:harsh"]},
        "bad.yaml: 'metrics' must be names of metrics, got 'own:harsh'; possible: 'alias_fraction'",
    ),
    ({"trials": 0}, "bad.yaml: trials: must be greater than or equal to 1, got 0"),
    ({"trials": "many"}, 'bad.yaml: trials: must be a valid integer, got "many"'),
    ({"name": ""}, "bad.yaml: name: must have at least 1 character"),
    ({"shot": "none.yaml"}, "none.yaml: no such file"),
    ({"set": {"sensor.bitz": 3}}, "bad.yaml: set.sensor.bitz: unknown parameter of Sensor"),
]


@pytest.mark.parametrize(("change", "message"), BAD_STUDIES)
def test_invalid_study_writes_nothing(foveasim, folder, change, message):
    (folder / "bad.yaml").write_text(json.dumps(STUDY | change))
    before = sorted(folder.rglob("*"))

    code, said, wrong = foveasim("study", "bad.yaml")

    assert (code, said) == (2, "")
    assert wrong.startswith("error: ")
    assert message in without_positions(wrong)
    assert wrong.count("\n") == 1
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--trials", "0"], "'trials' must be >= 1, got 0"),
        (["--out", "no/where.db"], "no/where.db: cannot be written: its directory does not exist"),
        (["--out", "."], ".: cannot be used as a study's storage (unable to open database file)"),
        (["--out", "a.db", "--storage", "sqlite:///b.db"], "--out and --storage exclude each other"),
        (["--storage", "b.db"], "--storage must be a URL"),
        (["--storage", "nosuch://base"], "cannot be used as a study's storage"),
        (["--storage", "nosuch://me:secret@host/base"], "error: nosuch://host/base: cannot be used"),
        (["--metric", "none:such"], "'metric' must be module:function of an importable module"),
        (["--metric", "beauty"], "'metrics' must be names of metrics, got 'beauty'"),
        (["--metric", "snr"], "'metric' must have a unique name"),
    ],
)
def test_invalid_study_option_writes_nothing(foveasim, folder, options, message):
    before = sorted(folder.rglob("*"))

    code, said, wrong = foveasim("study", "study.yaml", *options)

    assert (code, said) == (2, "")
    assert message in without_positions(wrong)
    assert wrong.count("\n") == 1
    assert sorted(folder.rglob("*")) == before


# -- datasets --------------------------------------------------------------------------------------------------------


def labels_of_all_sorts(folder):
    """Label files of the three pictures, and their content."""
    rng = np.random.default_rng(1)
    masks, flows, boxes = {}, {}, {"dogs/2.png": [[1.0, 2.0, 20.5, 30.0, 4.0]], "dogs/10.png": [], "cats/1.png": []}
    boxes["cats/1.png"] = [[0.0, 0.0, 9.0, 12.0, 1.0], [20.0, 5.0, 40.0, 39.0, 2.0]]
    for name in NAMES:
        masks[name], flows[name] = rng.integers(0, 3, (N_Y, N_X), np.uint8), rng.normal(size=(N_Y, N_X, 2))
        for kind in ("masks", "flows"):
            (folder / kind / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(masks[name]).save((folder / "masks" / name).with_suffix(".bmp"))
        np.save((folder / "flows" / name).with_suffix(".npy"), flows[name])
    lines = [
        "label,note,picture",
        "seal,,dogs/10.png",
        '"lion, old","a\n b",dogs/2.png',
        "seal,,cats/1.png",
        "x,,no.png",
    ]
    (folder / "labels.csv").write_text("\n".join(lines) + "\n", encoding="utf-8-sig")
    images = [{"id": k, "file_name": name, "width": N_X} for k, name in enumerate(("no.png", *NAMES[::-1]))]
    annotations = [
        {"image_id": image["id"], "category_id": int(c), "bbox": [x0, y0, x1 - x0, y1 - y0], "segmentation": []}
        for image in images
        for x0, y0, x1, y1, c in boxes.get(image["file_name"], [])
    ]
    crowd = {"image_id": 1, "category_id": 9, "bbox": [0, 0, 5, 5], "iscrowd": 1}
    other = {"image_id": 0, "category_id": 9, "bbox": [0, 0, 0, 0]}
    (folder / "coco.json").write_text(json.dumps({"images": images, "annotations": [crowd, *annotations, other]}))
    # Pictures are in natural order of their names.
    order = sorted(NAMES, key=lambda name: (name.split("/")[0], int(Path(name).stem)))
    said = {"cats/1.png": "seal", "dogs/2.png": "lion, old", "dogs/10.png": "seal"}
    return {
        "labels": [said[name] for name in order],
        "boxes": [boxes[name] for name in order],
        "masks": [masks[name] for name in order],
        "flows": [flows[name] for name in order],
    }


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("out", ["dataset", "d.zarr"])
def test_dataset_command_equals_call(foveasim, folder, out):
    labels = labels_of_all_sorts(folder)
    named = {"labels": "labels.csv", "boxes": "coco.json", "masks": "masks", "flows": "flows", "per_shard": 5}
    (folder / "all.yaml").write_text(json.dumps(DATA_SET | named))
    data = explore.Dataset("photos", "photographed.yaml", DATA_SET["vary"], cameras=2, draws=2, seed=7, **labels)

    code, said, wrong = foveasim("dataset", "all.yaml", "--out", out, "--workers", 1)
    found = explore.open_dataset(folder / out)

    assert (code, wrong) == (0, "")
    assert f"wrote {out}: 12 samples" in said
    assert len(found) == len(data) == 12
    assert found.class_names == ["lion, old", "seal"]
    assert found.about["per_shard"] == 5
    for k in range(12):
        assert_same(found[k], data[k])
    assert {"label", "box_um", "mask", "flow_um"} < set(found[0])
    code, _, wrong = foveasim("dataset", "all.yaml", "--out", f"again_{out}")
    assert (code, wrong) == (0, "")
    assert_same(explore.open_dataset(folder / f"again_{out}")[11], data[11])


@pytest.mark.parametrize("recipe", ["classification", "denoising"])
def test_recipe_file_equals_call(folder, recipe):
    (folder / "own.yaml").write_text(json.dumps({"pictures": "photos", "shot": PHOTOGRAPHED, "recipe": recipe}))

    read = explore.read_dataset(folder / "own.yaml").dataset
    called = getattr(explore, recipe)(folder / "photos", PHOTOGRAPHED)

    assert read.to_dict() == called.to_dict()
    assert_same(read[5 % len(read)], called[5 % len(read)])


def test_pictures_come_from_several_sources(folder):
    pictures = {name: np.asarray(Image.open(folder / "photos" / name)) for name in sorted(NAMES)}
    with zipfile.ZipFile(folder / "photos.zip", "w") as archive:
        for name in NAMES:
            archive.write(folder / "photos" / name, name)
    np.save(folder / "photos.npy", np.stack(list(pictures.values())))
    (folder / "numbers.csv").write_text("picture,label\n2,-1\n1,30\n0,7\n")
    (folder / "names.csv").write_text("picture,label\n1.png,-1\n10.png,30\n2.png,7\n")

    def read(**keys):
        (folder / "own.yaml").write_text(json.dumps(DATA_SET | keys))
        return explore.read_dataset(folder / "own.yaml").dataset

    zipped = read(pictures="photos.zip")
    array = read(pictures="photos.npy", labels="numbers.csv")
    files = read(pictures=[f"photos/{name}" for name in sorted(NAMES)], labels="names.csv")

    assert zipped.class_names == ["cats", "dogs"]
    assert [array[4 * k]["label"] for k in range(3)] == [7, 30, -1]
    assert [files[4 * k]["label"] for k in range(3)] == [-1, 30, 7]
    for k, name in enumerate(sorted(NAMES)):
        np.testing.assert_array_equal(array[4 * k]["electrons"], files[4 * k]["electrons"], err_msg=name)


@pytest.mark.nightly
def test_interrupted_dataset_resumes_identically(folder):
    (folder / "long.yaml").write_text(json.dumps(DATA_SET | {"cameras": 100, "per_shard": 10}))
    command = [sys.executable, "-m", "foveasim.cli", "dataset", "long.yaml", "--workers", "2"]
    shards = lambda: {p.name: p.stat().st_mtime_ns for p in (folder / "dataset").glob("*.tar")}  # noqa: E731
    running = subprocess.Popen(
        command, cwd=folder, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    wait_until(lambda: len(shards()) >= 2, program=running)
    os.killpg(running.pid, signal.SIGINT)
    _, wrong = running.communicate(timeout=DEADLINE_S)
    before = shards()

    assert running.returncode == 130
    assert wrong == "interrupted; finished shards are stored in dataset, run the same command again to resume\n"
    # Shards in the queue were not started.
    assert 2 <= len(before) < 60
    assert not list((folder / "dataset").glob(".*"))

    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    found, data = explore.open_dataset(folder / "dataset"), explore.read_dataset("long.yaml").dataset

    assert result.returncode == 0, result.stderr
    assert before.items() <= shards().items()
    assert len(found) == len(data) == 600
    for k in (0, 19, 300, 599):
        assert_same(found[k], data[k])


@pytest.mark.slow
def test_warnings_of_samples_appear_once(folder):
    layout = SHOT["layout"] | {"parameters": {"n_x": 12, "n_y": 12, "pitch_um": 30.0}}  # beyond the pictures
    (folder / "far.yaml").write_text(json.dumps(DATA_SET | {"set": {"layout": layout}}))
    command = [sys.executable, "-m", "foveasim.cli", "dataset", "far.yaml", "--workers", "1"]

    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)

    assert result.returncode == 0
    assert result.stderr.startswith("warning: 12 of the samples written have warnings, such as: sample 0: ")
    assert result.stderr.count("\n") == 1


BAD_DATA_SETS = [
    ({"repeats": 3}, "bad.yaml: repeats: unknown key"),
    ({"pictures": None}, "bad.yaml: pictures: missing"),
    ({"pictures": "nowhere"}, "nowhere: no such file or directory"),
    ({"pictures": "empty"}, "empty: contains no pictures"),
    ({"pictures": []}, "bad.yaml: pictures: must name a directory"),
    ({"pictures": ["skimage:nobody"]}, "bad.yaml: pictures.0: scikit-image does not contain 'nobody'"),
    ({"pictures": ["photos/none.png"]}, "none.png: no such file"),
    ({"shot": "none.yaml"}, "none.yaml: no such file"),
    ({"shot": SHOT}, "bad.yaml: shot.scene.kind: must be 'picture' for a dataset"),
    (
        {"vary": {"sensor.bitz": {"choice": [8]}}},
        "bad.yaml: vary.sensor.bitz: unknown parameter of Sensor; did you mean 'bits'?",
    ),
    ({"vary": {"sensor.bits": {"chance": [8]}}}, "bad.yaml: vary.sensor.bits.chance: unknown key"),
    ({"vary": {"sensor.bits": {"integers": [8, 40]}}}, "sensor.bits: must be <= 16, got 40"),
    ({"vary": {"sensor.bits": {"choice": []}}}, "'sensor.bits' must have at least one choice"),
    ({"vary": {"exposure_s": {"uniform": [1]}}}, "bad.yaml: 'exposure_s' must specify 'uniform' as [low, high]"),
    ({"cameras": 0}, "bad.yaml: 'cameras' must be >= 1, got 0"),
    ({"draws": "many"}, 'bad.yaml: draws: must be a valid integer, got "many"'),
    ({"recipe": "magic"}, "bad.yaml: recipe: must be one of 'classification', 'denoising'"),
    ({"fields": ["volts"]}, "bad.yaml: fields.0: must be the name of a column"),
    ({"per_shard": 0}, "bad.yaml: per_shard: must be greater than or equal to 1"),
    ({"set": {"sensor.bitz": 3}}, "bad.yaml: set.sensor.bitz: unknown parameter of Sensor"),
    ({"labels": "none.csv"}, "none.csv: no such file"),
    ({"labels": [1]}, "bad.yaml: 'labels' must have one item for each of the 3 pictures, got 1"),
    ({"boxes": "own.py"}, "own.py: is not a valid COCO file (Invalid JSON"),
    ({"masks": "flows"}, "flows: no such directory"),
    ({"masks": "empty"}, "empty: has no entry for 3 of 3 pictures, first 'cats/1'; it contains no entries (.png, "),
]


@pytest.mark.parametrize(("change", "message"), BAD_DATA_SETS)
def test_invalid_dataset_writes_nothing(foveasim, folder, change, message):
    keys = {key: value for key, value in (DATA_SET | change).items() if value is not None}
    (folder / "bad.yaml").write_text(json.dumps(keys))
    (folder / "empty").mkdir()
    before = sorted(folder.rglob("*"))

    code, said, wrong = foveasim("dataset", "bad.yaml", "--workers", 1)

    assert (code, said) == (2, "")
    assert wrong.startswith("error: ")
    assert message in without_positions(wrong)
    assert wrong.count("\n") == 1
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--workers", "-1"], "'workers' must be >= 0, got -1"),
        (["--out", "no/where"], "cannot be written: the directory"),
        (["--out", "photos"], "photos: is not a dataset of foveasim"),
        (["--out", "x.txt"], "must have the extension .zarr, or none"),
    ],
)
def test_invalid_dataset_option_writes_nothing(foveasim, folder, options, message):
    before = sorted(folder.rglob("*"))

    code, _, wrong = foveasim("dataset", "data.yaml", *options)

    assert code == 2
    assert message in without_positions(wrong)
    assert wrong.count("\n") == 1
    assert sorted(folder.rglob("*")) == before


# -- label files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must have the columns 'picture' and 'label' in its first line"),
        ("id,label\na,1\n", r"must have the columns 'picture' and 'label' in its first line, got \['id', 'label'\]"),
        ("picture,label\na,1\n", "has no entry for 1 of 2 pictures, first 'b'; it contains 'a'"),
        ("picture,label\na,1\nb,1\na,2\n", "lists the picture 'a' twice, again in line 4"),
        ("picture,label\na,1\nb\n", "has 1 values in line 3, expected 2"),
        ('picture,label\na,"1\n', "line 2 cannot be split into columns"),
    ],
)
def test_invalid_class_file_is_rejected(tmp_path, text, message):
    (tmp_path / "labels.csv").write_text(text)

    with pytest.raises(FileError, match=message) as caught:
        read_labels(tmp_path / "labels.csv", ["a", "b"])
    assert "\n" not in str(caught.value)


def test_class_arrays_load_without_pickle(tmp_path):
    np.save(tmp_path / "numbers.npy", np.array([3, 1], np.uint8))
    np.save(tmp_path / "texts.npy", np.array(["b", "a"]))
    np.save(tmp_path / "objects.npy", np.array([{}, 1], object), allow_pickle=True)
    np.save(tmp_path / "reals.npy", np.array([0.5, 1.0]))

    assert read_labels(tmp_path / "numbers.npy", ["x", "y"]) == [3, 1]
    assert read_labels(tmp_path / "texts.npy", ["x", "y"]) == ["b", "a"]
    with pytest.raises(FileError, match="is not a readable array"):
        read_labels(tmp_path / "objects.npy", ["x", "y"])
    with pytest.raises(FileError, match="of integers or strings"):
        read_labels(tmp_path / "reals.npy", ["x", "y"])
    with pytest.raises(FileError, match=r"must be a \.csv file"):
        read_labels(Path(__file__), ["x", "y"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": [{"id": 1, "file_name": "b"}]}, "has no entry for 1 of 1 pictures, first 'a'; it contains 'b'"),
        ({"images": [{"id": 1, "file_name": "a"}] * 2}, "lists the picture 'a' twice"),
        ({"images": None}, "is not a valid COCO file"),
        ({"annotations": [{"image_id": 1, "category_id": 2}]}, r"annotations\.0\.bbox"),
        (
            {"annotations": [{"image_id": 1, "category_id": 2, "bbox": [1, 2, 0, 3]}]},
            r"annotations\.0: must have a box with an area > 0, got \[1\.0, 2\.0, 0\.0, 3\.0\]",
        ),
    ],
)
def test_invalid_box_file_is_rejected(tmp_path, change, message):
    coco = {"images": [{"id": 1, "file_name": "a"}], "annotations": []} | change
    (tmp_path / "coco.json").write_text(json.dumps(coco))

    with pytest.raises(FileError, match=message) as caught:
        read_boxes(tmp_path / "coco.json", ["a"])
    assert "\n" not in str(caught.value)


def test_each_picture_has_one_label_file(tmp_path):
    (tmp_path / "a.png").touch()
    (tmp_path / "b.jpg").touch()

    assert list(match_label_files(tmp_path, ["a.jpeg"], (".png",))) == [tmp_path / "a.png"]
    with pytest.raises(FileError, match="one file per picture, but two pictures have the name 'a'"):
        match_label_files(tmp_path, ["a.jpeg", "a.png"], (".png",))
    with pytest.raises(FileError, match=r"first 'b'; it contains 'a' \(\.png\)"):
        match_label_files(tmp_path, ["a.jpeg", "b.jpeg"], (".png",))
    (tmp_path / "a.bmp").touch()
    with pytest.raises(FileError, match=r"has two files for the picture 'a': a\.bmp and a\.png"):
        match_label_files(tmp_path, ["a.jpeg"], (".png", ".bmp"))


# -- common parts --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "examples", "needed"),
    [
        ("sweep", ["foveal.yaml"], {"shot"}),
        ("study", ["best_fovea.yaml"], {"shot", "search", "objectives", "trials"}),
        ("dataset", ["random_cameras.yaml"], {"pictures", "shot"}),
        ("shot", [], {"scene", "optics", "exposure_s"}),
    ],
)
def test_schema_has_keys_of_examples(foveasim, kind, examples, needed):
    code, said, _ = foveasim("schema", kind)
    schema = json.loads(said)

    assert code == 0
    assert set(schema["required"]) == needed
    if kind == "shot":  # a twin has a layout
        assert {tuple(each["required"]) for each in schema["anyOf"]} == {("layout",), ("sensor",)}
    assert schema["additionalProperties"] is False
    for example in examples:
        assert set(yaml.safe_load((GALLERY / example).read_text())) <= set(schema["properties"])


def test_default_schema_is_of_shots(foveasim):
    assert foveasim("schema") == foveasim("schema", "shot")
    assert foveasim("schema", "film") == (
        2,
        "",
        "error: 'kind' must be one of 'shot', 'layout', 'rules', 'sweep', 'study', 'dataset', got 'film'\n",
    )


def test_examples_have_documented_keys():
    study = explore.read_study(GALLERY / "best_fovea.yaml")
    file = explore.read_dataset(GALLERY / "random_cameras.yaml")

    assert study.n_trials == 40
    assert set(study.base.metrics) == {"psnr_db", "n_sites", "saturated_fraction"}
    assert len(file.dataset) == 24
    assert file.dataset.class_names == ["cat", "cup", "person"]


def test_results_depend_on_nested_layout_files(folder):
    density = {"n_sites": 30, "size_um": [40.0, 40.0], "density": "density.png"}
    (folder / "deep").mkdir()
    (folder / "deep" / "layout.yaml").write_text(json.dumps({"generator": "voronoi", "parameters": density}))
    (folder / "shot.yaml").write_text(json.dumps(SHOT | {"layout": "deep/layout.yaml"}))
    (folder / "photographed.yaml").write_text(json.dumps(PHOTOGRAPHED | {"layout": "deep/layout.yaml"}))
    plans = []
    for level in (100, 200):
        Image.fromarray(np.full((8, 8), level, np.uint8)).save(folder / "deep" / "density.png")
        plans.append(
            [
                explore.plan_sweep(folder / "shot.yaml", {"sensor.bits": [8]}).to_dict(),
                explore.Dataset(folder / "photos", folder / "photographed.yaml").to_dict(),
            ]
        )

    for one, other in zip(*plans, strict=True):
        assert [Path(file).name for file in one["files"]] == ["layout.yaml", "density.png"]
        assert {key for key in one if one[key] != other[key]} == {"files"}


def test_journal_is_synced_every_second(tmp_path, monkeypatch):
    now_s, synced = [100.0], []
    monkeypatch.setattr(_records.time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(_records.os, "fsync", lambda _: synced.append(now_s[0]))
    with Journal(tmp_path / "r.zarr", {}) as journal:
        for later_s in (100.3, 100.9, 101.1, 101.2, 105.0):
            now_s[0] = later_s
            journal.add(Record(len(journal.records), {"x": 1.0}))
        now_s[0] = 105.5

    assert synced == [100.0, 101.1, 105.0, 105.5]


def test_cached_reference_changes_no_result():
    vary = {"optics.f_number": [2.0, 4.0], "sensor.bits": [8, 12], "exposure_s": [1e-4, 2e-4]}
    scene = PHOTOGRAPHED["scene"] | {"picture": "skimage:astronaut", "pitch_um": 20.0}
    plan = explore.plan_sweep(SHOT | {"scene": scene}, vary, repeats=2, metrics=["psnr_db"])
    runner = ShotRunner(plan.source, plan.metrics, is_geometry_varied=False, n_threads=1)
    found = [runner.record(k, plan.settings_of(k)) for k in range(plan.n_points)]

    assert runner.cache.n_built["reference"] == 8  # white balance depends on the bit depth
    for k in (0, 5, 10, 15):
        shot = build_shot("by hand", plan.settings_of(k))
        capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)
        assert found[k].error == ""
        assert found[k].values["psnr_db"] == metrics.METRICS["psnr_db"](shot, shot.camera, capture)


def test_settings_files_import_no_code(foveasim, folder):
    (folder / "trap.py").write_text(f"open({str(folder / 'sprung')!r}, 'w')")
    for key in ("metrics", "objectives"):
        given = ["trap:metric"] if key == "metrics" else {"trap:metric": "maximize"}
        (folder / "bad.yaml").write_text(json.dumps(STUDY | {key: given}))
        assert foveasim("study", "bad.yaml")[0] == 2
    assert not (folder / "sprung").exists()


def test_error_names_both_settings_files(folder):
    (folder / "shot.yaml").write_text(json.dumps(SHOT | {"exposure": 1.0}))
    (folder / "sweep.yaml").write_text(json.dumps({"shot": "shot.yaml", "vary": {"sensor.bits": [8]}}))

    for read, name in ((explore.read_study, "study.yaml"), (explore.read_sweep, "sweep.yaml")):
        with pytest.raises(
            ConfigError, match=rf"{name}:1:2: with shot\.yaml:1:\d+: exposure: unknown key; did you mean 'exposure_s'"
        ):
            read(folder / name)


def test_failing_workers_print_one_line(foveasim, folder, monkeypatch):
    def none_start(**_):
        raise RuntimeError("Nanny failed\nto start.")

    monkeypatch.setattr("distributed.LocalCluster", none_start)
    (folder / "sweep.yaml").write_text(json.dumps({"shot": "shot.yaml", "vary": {"sensor.bits": [8, 9]}}))

    code, _, wrong = foveasim("sweep", "sweep.yaml", "--workers", 2)

    assert code == 2
    assert wrong.startswith("error: the workers did not start (Nanny failed to start.); retry, or use fewer workers")
    assert wrong.count("\n") == 1
    assert not (folder / "results.zarr").exists()


def test_plot_draws_a_stored_sweep(tmp_path, foveasim):
    shot = {
        "scene": {"kind": "flat", "shape": [16, 16], "pitch_um": 500.0, "distance_m": 1.0, "radiance_w_m2_sr_nm": 0.02, "band_width_nm": 50.0},
        "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
        "layout": {"generator": "grid", "parameters": {"n_x": 8, "n_y": 8, "pitch_um": 3.0}},
        "exposure_s": 0.001,
    }  # fmt: skip
    explore.sweep(shot, {"sensor.bits": [8, 10, 12]}, metrics=["snr"], out=tmp_path / "results.zarr", workers=0)

    code, said, _ = foveasim("plot", tmp_path / "results.zarr", "--metric", "snr_mean")
    assert code == 0
    assert said.split() == ["wrote", str(tmp_path / "results.png")]
    assert (tmp_path / "results.png").read_bytes().startswith(b"\x89PNG")

    code, _, said = foveasim("plot", tmp_path / "results.zarr", "--metric", "snr", "--out", tmp_path / "other.png")
    assert (code, (tmp_path / "other.png").exists()) == (2, False)
    assert "'metric' must be one of" in said

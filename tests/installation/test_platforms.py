"""Systems without POSIX, encodings of their terminals and files, directories without write permission: by imitation on Linux."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from programs import run_programs
from typer.main import get_command

import foveasim as fs
from foveasim.cli import app
from installation.calls import failures
from installation.environments import make_imitation, run_calls

#: Calls that lock, rename and remove files, start workers and the sandbox; all calls are made every night.
CALLS = {
    "main": (
        "read_layout gds", "tiles.write_tiles", "video.write_video", "foveasim run", "foveasim sweep", "foveasim study --workers",
        "foveasim dataset zarr", "foveasim video zarr",
    ),
    "all": (),
}  # fmt: skip
#: Neither files nor directories can be created in this home, also by the superuser.
NO_HOME = {"HOME": "/dev/null", "MPLCONFIGDIR": ""}
#: Terminals of Windows with redirected output, and of containers without locales.
TERMINALS = {
    "cp1252": {"PYTHONIOENCODING": "cp1252:strict", "PYTHONUTF8": "0"},
    "C": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
}
SHOT = """
scene: {kind: flat, shape: [60, 60], pitch_um: 300.0, distance_m: 1.0, radiance_w_m2_sr_nm: 0.1, band_width_nm: 100.0}
optics: {focal_length_mm: 8.0, f_number: 2.8}
layout: {generator: grid, parameters: {n_x: 8, n_y: 8, pitch_um: 3.0}}
exposure_s: 0.0001
"""

#: Writes what depends on the system: start method, number of threads, and who gets a lock; removes an empty directory.
DEPENDENT = """
import json, subprocess, sys
from pathlib import Path

from foveasim._core.threads import thread_count
from foveasim._io.atomic import lock
from foveasim._io.resumable import resumable_directory
from foveasim.explore.cluster import START_METHOD

OTHER = "import sys; from foveasim._io.atomic import lock; print(lock(open(sys.argv[1], 'ab')))"

def other_gets_lock():
    return subprocess.run([sys.executable, "-c", OTHER, "lock"], capture_output=True, text=True, check=True).stdout.strip()

with open("lock", "ab") as file:
    locks = [str(lock(file)), other_gets_lock()]
locks.append(other_gets_lock())
with resumable_directory(Path("new"), "test", is_ours=bool, has_content=lambda _: False):
    assert Path("new.partial").is_dir()
print(json.dumps([START_METHOD, thread_count(), locks, Path("new.partial").exists(), Path("lock").read_bytes().decode()]))
"""


#: Columns that some systems cannot have as directories, or not as two.
COLUMNS = ("gain", "Gain", "con", "a:b", "a/b", "a_b", "..")
WRITERS = {
    "capture": lambda path, camera, scene: camera.capture(scene, exposure_s=0.01, seed=0).save(path),
    "recording": lambda path, camera, scene: fs.video.write_video(
        [camera.capture(scene, exposure_s=0.01, seed=0)], path, frame_s=0.1
    ),
    "tiles": lambda path, camera, scene: fs.tiles.write_tiles(path, camera, scene, exposure_s=0.01, seed=0),
}
READERS = {"capture": fs.Capture.load, "recording": fs.video.read_recording, "tiles": fs.tiles.read_tiles}


@pytest.fixture(scope="module")
def imitation(tmp_path_factory):
    """Return the interpreter of an environment that imitates a system without POSIX."""
    return make_imitation(tmp_path_factory.mktemp("other") / "env", "other_system")


@pytest.mark.slow(keep=("main",))
@pytest.mark.parametrize("calls", ["main", pytest.param("all", marks=pytest.mark.nightly)])
def test_calls_work_without_posix(imitation, calls, tmp_path):
    outcomes = run_calls(
        imitation, tmp_path, CALLS[calls], PYTHONIOENCODING="cp1252:strict", PYTHONWARNDEFAULTENCODING="1"
    )

    assert failures(outcomes) == {}


def test_system_without_posix_spawns_and_locks(imitation, tmp_path):
    ran = subprocess.run(
        [imitation, "-c", DEPENDENT], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120
    )

    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout) == ["spawn", 1, ["True", "False", "True"], False, ""]


@pytest.mark.parametrize("kind", WRITERS)
def test_stored_columns_have_names_of_directories(kind, tmp_path):
    grid = fs.layout.grid(4, 4, 3.0)
    columns = {name: np.arange(16) + k for k, name in enumerate(COLUMNS)}
    layout = fs.Layout(grid.xy_um, grid.ring_offsets, grid.site_offsets, columns, {})
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=fs.Sensor(layout))
    scene = fs.Scene.flat(
        shape=(60, 60),
        pitch_um=300.0,
        distance_m=1.0,
        radiance_w_m2_sr_nm=0.1,
        wavelength_nm=550.0,
        band_width_nm=100.0,
    )
    WRITERS[kind](tmp_path / "a.zarr", camera, scene)
    stored = READERS[kind](tmp_path / "a.zarr").layout.columns
    paths = [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")]

    assert {name: stored[name].tolist() for name in stored} == {name: columns[name].tolist() for name in COLUMNS}
    assert len({path.lower() for path in paths}) == len(paths)
    assert not [path for path in paths if ":" in path or path.endswith(("/con", "/.."))]


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("terminal", TERMINALS)
def test_commands_print_on_every_terminal(terminal, tmp_path):
    (tmp_path / "shot.yaml").write_text(SHOT)
    helps = [(name, "--help") for name in get_command(app).commands]
    jobs = [
        ("run", "shot.yaml"),
        ("describe", "foveal_blind_spot"),
        ("layouts",),
        ("schema", "sweep"),
        ("new", "study"),
    ]

    results = run_programs(*helps, *jobs, cwd=tmp_path, MPLBACKEND="agg", **TERMINALS[terminal])

    assert [(r.args, r.stderr) for r in results if r.returncode or b"Traceback" in r.stderr] == []
    assert all(r.stdout.decode("cp1252") for r in results)


@pytest.mark.nightly
def test_programs_run_without_home(tmp_path):
    (tmp_path / "shot.yaml").write_text(SHOT)

    (ran,) = run_programs(("run", "shot.yaml"), cwd=tmp_path, **NO_HOME)

    assert ran.returncode == 0, ran.stderr
    assert len(list((tmp_path / "out").iterdir())) == 3


@pytest.mark.nightly
def test_kernels_are_cached_in_temporary_directory(tmp_path):
    package = Path(fs.__file__).parent
    copied = shutil.copytree(package, tmp_path / "foveasim", ignore=shutil.ignore_patterns("__pycache__"))
    for directory in {path.parent for path in copied.rglob("*_kernels.py")}:
        (directory / "__pycache__").touch()  # a file: also the superuser cannot write into it
    (tmp_path / "temporary").mkdir()
    code = "import foveasim as fs; print(fs.__file__, fs.layout.grid(4, 4, 2.0).adjacency().nnz)"

    ran = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path), "TMPDIR": str(tmp_path / "temporary"), **NO_HOME},
        capture_output=True, text=True, check=False,
    )  # fmt: skip

    assert ran.stdout.startswith(str(copied)), ran.stderr
    assert list((tmp_path / "temporary" / "foveasim-numba").rglob("*.nbi"))

"""Write errors of the disk: the message contains the reason, and no partial file is left."""

from __future__ import annotations

import errno
import json
import subprocess
import sys

import pytest

from foveasim._io.atomic import atomic_write, check_free_space
from foveasim.errors import FileError, disk_problem

#: Call every writer of the package with a file size limit of 1000 bytes.
PROGRAM = """
import json, resource, sys, warnings
from pathlib import Path
import numpy as np
import foveasim as fs
from foveasim import modes, view
from foveasim.errors import FileError
from foveasim._io.images import write_picture
from foveasim.video import write_video
from foveasim.view.web import write_web_page

warnings.simplefilter("ignore")
rng = np.random.default_rng(0)
layout = fs.layout.grid(n_x=30, n_y=30, pitch_um=2.0)
scene = fs.Scene.flat(shape=(60, 60), pitch_um=300.0, distance_m=1.0, radiance_w_m2_sr_nm=0.1, band_width_nm=10.0)
optics = fs.Optics(focal_length_mm=8.0, f_number=2.8)
camera = fs.Camera(optics=optics, sensor=fs.Sensor(layout, read_noise_e=2.0, bits=12))
capture = camera.capture(scene, exposure_s=0.01, seed=0)
report = layout.check(fs.DesignRules(min_size_um=3.0))
noise = rng.integers(0, 255, (100, 100, 3)).astype(np.uint8)
irradiance = rng.random((40, 40)).astype(np.float32)
power_map = fs.PowerMap.from_array(irradiance, pitch_um=1.0, wavelength_nm=550.0)
pixels = modes.EventPixels(camera.sensor, contrast_on=0.2, contrast_off=0.2)
events = pixels.events((np.exp(rng.normal(size=900)) * 1e5 for _ in range(9)), frame_s=1 / 60, seed=0)
solids = view.solids(layout[:30])
table = {
    **{f"layout.{e}": layout.write for e in ("geojson", "parquet", "npz", "svg")},
    **{f"layout.{e}": lambda path: layout.write(path, hierarchy=False) for e in ("gds", "oas")},
    **{f"picture.{e}": lambda p: write_picture(p, noise) for e in ("png", "jpg", "webp", "bmp", "tga", "ppm", "jp2", "tif")},
    "16bit.png": lambda p: write_picture(p, noise.astype(np.uint16)),
    "picture.exr": lambda p: write_picture(p, noise.astype(np.float32)),
    **{f"map.{e}": lambda p: fs.write_power_map(power_map, p) for e in ("npz", "fits", "tif", "exr", "nc", "zarr")},
    **{f"capture.{e}": capture.save for e in ("npz", "zarr")},
    "report.lyrdb": report.write,
    **{f"video{e}": lambda p: write_video([capture] * 20, p) for e in (".zarr", ".mp4", ".gif", "")},
    **{f"figure.{e}": lambda p: view.save_figure(capture.plot().figure, p) for e in ("png", "jpg", "svg", "pdf")},
    "page.html": lambda p: write_web_page(capture, p),
    **{f"solid.{e}": solids.write for e in ("stl", "3mf", "ply", "glb")},
    **{f"events.{e}": events.save for e in ("h5", "npy", "txt", "npz")},
}
folder = Path(sys.argv[1])
found = {}
for name, write in table.items():
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
    try:
        write(folder / name)
        found[name] = "written"
    except Exception as error:
        found[name] = f"{type(error).__name__}: {error}".replace(f"{folder}/", "")
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
print(json.dumps([found, sorted(path.name for path in folder.iterdir())]))
"""


@pytest.mark.slow
def test_writers_report_reason_and_leave_nothing(tmp_path):
    pytest.importorskip("resource")
    (tmp_path / "out").mkdir()
    done = subprocess.run(
        # Without bytecode: that of modules imported under the limit would be incomplete for all later programs.
        [sys.executable, "-B", "-c", PROGRAM, str(tmp_path / "out")],
        capture_output=True,
        text=True,
        check=True,
    )
    found, left = json.loads(done.stdout.splitlines()[-1])

    assert len(found) > 40
    assert found == {name: f"FileError: {name}: cannot be written: File too large" for name in found}
    assert left == []


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        RuntimeError("Write error on file: x.lyrdb (errno=28) in ReportDatabase.save"),
        ValueError("cannot be written in this format"),
    ],
    ids=["system", "message", "cause"],
)
def test_disk_errors_are_found_in_wrapping_errors(error, tmp_path):
    if isinstance(error, ValueError):
        error.__context__ = OSError(errno.ENOSPC, "")
        error.__suppress_context__ = True
    (tmp_path / "x.npz").write_text("former")
    with (
        pytest.raises(FileError, match=r"x\.npz: cannot be written: No space left on device"),
        atomic_write(tmp_path / "x.npz"),
    ):
        raise error

    assert (tmp_path / "x.npz").read_text() == "former"
    assert [path.name for path in tmp_path.iterdir()] == ["x.npz"]


def test_other_errors_are_unchanged(tmp_path):
    assert disk_problem(RuntimeError("errno=2")) == ""
    for error in (ValueError("a wrong value"), FileError("y.npz", "cannot store the array")):
        with pytest.raises(type(error), match=str(error)), atomic_write(tmp_path / "x.npz"):
            raise error


def test_check_room_compares_free_space(tmp_path):
    file = tmp_path / "x"
    file.write_bytes(bytes(10))
    check_free_space(file, 1000)
    with pytest.raises(OSError, match="No space left on device"):
        check_free_space(file, 2**62)

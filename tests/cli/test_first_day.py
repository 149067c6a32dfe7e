"""Tasks of the first day, as the documentation describes them: nine scripts and commands, each with its own check."""

from __future__ import annotations

import os
import re
import shlex
import webbrowser
from pathlib import Path

import numpy as np
import pytest
import skimage.data
from PIL import Image

import foveasim as fs
from foveasim.units import decode_srgb

README = Path(__file__).parents[2] / "README.md"
#: Commands of the README that run until they are interrupted, or for minutes: their options are those of other tests.
NOT_RUN = ("studio", "sweep", "study", "dataset", "compile")
SHOT = """
scene: {kind: picture, picture: photo.png, fit: cover, distance_m: 1.0, illuminance_lux: 500.0}
optics: {focal_length_mm: 8.0, f_number: 2.8}
layout:
  generator: log_polar
  parameters: {n_sectors: 40, min_size_um: 3.0, r_max_um: 150.0, stagger: true}
  mosaic: RGGB
sensor: {preset: machine_vision, filters: rgb}
exposure_s: auto
seed: 1
"""


@pytest.fixture
def folder(tmp_path):
    """Return a directory with a photograph and a shot."""
    Image.fromarray(skimage.data.astronaut()).save(tmp_path / "photo.png")
    (tmp_path / "shot.yaml").write_text(SHOT)
    return tmp_path


@pytest.fixture
def in_folder(folder, foveasim):
    """Run the program in the directory; it must succeed."""

    def run(*arguments):
        result = foveasim(*arguments, cwd=folder)
        assert result.returncode == 0, result.stderr
        return result.stdout

    return run


def test_own_photograph_with_gaze_and_colours(folder):
    scene = fs.Scene.from_picture(
        folder / "photo.png", fit="cover", gaze_range_um=(0.0, 60.0), distance_m=1.0, illuminance_lux=500.0
    )
    layout = fs.layout.mosaic(fs.layout.grid(n_x=96, n_y=96, pitch_um=3.45), "RGGB")
    sensor = fs.Sensor.from_preset(layout, "machine_vision", filters="rgb")
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)
    capture = camera.capture(scene, exposure_s="auto", seed=0, gaze_um=(0.0, -60.0))
    capture.picture(max_pixels=96).save(folder / "picture.png")

    # The image is 331.2 + 2 * 60 µm wide and high; the sensor is 60 µm below its centre.
    found = np.asarray(Image.open(folder / "picture.png").convert("RGB"), np.float64) / 255.0
    seen = skimage.data.astronaut()[136:512, 68:444]
    photo = Image.fromarray(seen).resize((96, 96), Image.Resampling.BOX)
    pair = [decode_srgb(picture).reshape(-1, 3) for picture in (found, np.asarray(photo) / 255.0)]
    assert min(np.corrcoef(pair[0][:, k], pair[1][:, k])[0, 1] for k in range(3)) > 0.9
    balance = [colours.mean(axis=0) / colours.mean() for colours in pair]
    assert balance[0] == pytest.approx(balance[1], abs=0.02)


@pytest.mark.slow
def test_comparison_at_equal_number_of_sites(folder):
    foveal = fs.layout.log_polar(n_sectors=57, min_size_um=3.0, r_max_um=150.4, fovea="rings", stagger=True)
    square = fs.layout.grid(n_sites=1024, size_um=(266.0, 266.0))
    found = fs.compare.layouts({"foveal": foveal, "square": square}, max_pixels=64)
    found.write(folder / "report.html")

    assert found.verdict()[0].startswith("Within ")
    assert "foveal has a higher PSNR than square" in found.verdict()[0]
    assert (folder / "report.html").stat().st_size > 100_000


def draw_chip(path):
    """Write a chip of three filter layers with its origin in the lower left corner, as KLayout saves it."""
    gdstk = pytest.importorskip("gdstk")
    library = gdstk.Library(unit=1e-6, precision=1e-9)
    cell = library.new_cell("TOP")
    for row in range(20):
        for column in range(30):
            corner = (4.0 * column, 4.0 * row)
            layer = (10, 11, 11, 12)[2 * (row % 2) + column % 2]
            cell.add(gdstk.rectangle(corner, (corner[0] + 4.0, corner[1] + 4.0), layer=layer, datatype=0))
    library.write_gds(path)


@pytest.mark.slow
def test_chip_with_filter_layers_off_centre(folder, in_folder):
    draw_chip(folder / "chip.gds")
    options = ("--channels", "10/0=R,11/0=G,12/0=B", "--centre")

    assert "600" in in_folder("describe", "chip.gds", *options)
    (folder / "rules.yaml").write_text("min_size_um: 4.0\nmax_overlap_um2: 0.0\n")
    assert "fail" not in in_folder("check", "chip.gds", *options, "--rules", "rules.yaml")
    in_folder("run", "shot.yaml", "--set", "layout={file: chip.gds}", *options, "--out", "out")
    capture = fs.Capture.load(folder / "out" / "shot_capture.npz")
    assert capture.layout.bounds_um == pytest.approx((-60.0, -40.0, 60.0, 40.0))
    assert np.bincount(capture.filter_of_site).tolist() == [150, 300, 150]
    # The photograph covers the chip: no quadrant of it is dark.
    x, y = capture.layout.centroid_um.T
    quadrant = 2 * (y > 0.0) + (x > 0.0)
    light = np.bincount(quadrant, capture.expected_e) / np.bincount(quadrant)
    assert light.min() > 0.2 * light.max()


@pytest.mark.slow
def test_dataset_of_random_cameras(folder, in_folder):
    (folder / "dataset.yaml").write_text(
        "pictures: [photo.png]\nlabels: [person]\nshot: shot.yaml\nvary:\n  sensor.bits: {choice: [8, 10]}\n"
        "  optics.f_number: {uniform: [2.0, 8.0]}\n  gaze_um: {choice: [[0.0, 0.0], [20.0, 10.0]]}\ncameras: 3\nseed: 5\n"
    )
    in_folder("dataset", "dataset.yaml", "--out", "samples", "--workers", "0")
    stored = fs.explore.open_dataset(folder / "samples")
    samples = [stored[k] for k in range(len(stored))]

    assert len(samples) == 3
    assert {sample["label"] for sample in samples} <= {"person", 0}


@pytest.mark.slow
def test_video_with_gaze_and_events(folder, in_folder):
    frames = folder / "frames"
    frames.mkdir()
    for k in range(4):
        Image.fromarray(np.roll(skimage.data.astronaut(), 6 * k, axis=1)).save(frames / f"{k}.png")
    path = fs.video.GazePath(
        np.array([0.0, 0.1, 0.2, 0.3]), np.array([[0.0, 0.0], [5.0, 0.0], [10.0, 5.0], [15.0, 5.0]])
    )
    path.write(folder / "path.csv")
    changes = ("--set", "scene.gaze_range_um=[20,20]", "--set", "exposure_s=0.002", "--fps", "10", "--gaze", "path.csv")
    in_folder("video", "shot.yaml", "--frames", "frames", *changes, "--out", "video.zarr")
    recording = fs.video.read_recording(folder / "video.zarr")

    assert recording.n_frames == 4
    assert recording.gaze_um == pytest.approx(path.xy_um)
    camera = fs.config.read_shot(folder / "shot.yaml").camera
    source = fs.video.FrameSource(frames, fit="cover", distance_m=1.0, illuminance_lux=500.0)
    events = fs.modes.EventPixels(camera.sensor, contrast_on=0.15, contrast_off=0.15).events(
        camera.rates(source), frame_s=0.1, seed=0
    )
    assert events.t_s.size > 100
    assert set(np.unique(events.polarity)) == {-1, 1}


@pytest.mark.slow
def test_page_in_3d(folder, in_folder):
    in_folder("run", "shot.yaml", "--out", "out")
    in_folder("view", "out/shot_capture.npz", "--solid", "--out", "page.html")
    page = (folder / "page.html").read_text("utf-8")

    assert "<canvas" in page
    assert "https://" not in page.split("<script")[0]


def test_cube_of_numpy(folder):
    wavelength_nm = np.arange(450.0, 651.0, 10.0)
    # The upper half is red, the lower half blue; row 0 is the top row.
    cube = np.full((40, 60, wavelength_nm.size), 0.001)
    cube[:20, :, wavelength_nm > 580.0] = 0.01
    cube[20:, :, wavelength_nm < 500.0] = 0.01
    scene = fs.Scene.from_cube(cube, wavelength_nm=wavelength_nm, unit="W m-2 sr-1 nm-1", distance_m=1.0, fit="cover")
    layout = fs.layout.mosaic(fs.layout.grid(n_x=60, n_y=40, pitch_um=4.0), "RGGB")
    camera = fs.Camera(
        optics=fs.Optics(focal_length_mm=8.0, f_number=2.8),
        sensor=fs.Sensor.from_preset(layout, "scientific", filters="rgb"),
    )
    picture = camera.capture(scene, exposure_s="auto", seed=0).picture(max_pixels=60)
    picture.save(folder / "cube.png")
    image = np.asarray(Image.open(folder / "cube.png").convert("RGB"), np.float64)

    assert (image[5, 10:50, 0] > 2.0 * image[5, 10:50, 2]).all()
    assert (image[35, 10:50, 2] > 2.0 * image[35, 10:50, 0]).all()


@pytest.mark.slow
def test_sweep_with_plot(folder, in_folder):
    xr = pytest.importorskip("xarray")
    (folder / "sweep.yaml").write_text(
        "shot: shot.yaml\nvary:\n  optics.f_number: {from: 2, to: 8, n: 3}\n  sensor.preset: [mobile, scientific]\n"
        "metrics: [snr, n_sites]\nseed: 1\n"
    )
    in_folder("sweep", "sweep.yaml", "--out", "results.zarr", "--workers", "0")
    in_folder("plot", "results.zarr", "--metric", "snr_mean", "--out", "snr.png")
    results = xr.open_zarr(folder / "results.zarr")

    assert dict(results["snr_mean"].sizes) == {"optics.f_number": 3, "sensor.preset": 2}
    with Image.open(folder / "snr.png") as figure:
        assert figure.size[0] > 400


@pytest.mark.slow
def test_notebook_shows_results(folder, monkeypatch):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    monkeypatch.setenv("PYTHONPATH", str(README.parent), prepend=os.pathsep)
    monkeypatch.setenv("IPYTHONDIR", str(folder / "ipython"))
    cells = [
        "import foveasim as fs\nshot = fs.config.read_shot('shot.yaml')",
        "capture = shot.camera.capture(shot.scene, exposure_s=shot.requested_s, seed=shot.seed)\ncapture",
        "capture.picture(max_pixels=64)",
        "shot.camera.layout",
        "shot.scene",
        "capture.colour_correction",
        "capture.layout.plot3d(size_px=(300, 200))",
    ]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    client.execute()
    shown = [{kind for output in cell.outputs for kind in output.get("data", {})} for cell in notebook.cells]

    assert all(kinds & {"text/html", "image/png"} for kinds in (*shown[1:5], shown[6]))
    assert "ΔE*ab" in notebook.cells[5].outputs[-1]["data"]["text/plain"]


@pytest.mark.slow
def test_commands_of_the_readme_run_as_written(tmp_path, foveasim, monkeypatch):
    lines = re.findall(r"^    foveasim (.*?)(?: +#.*)?$", README.read_text("utf-8"), re.MULTILINE)
    commands = [shlex.split(line) for line in lines]
    opened = []
    monkeypatch.setattr(webbrowser, "open", lambda url, *_args, **_options: opened.append(url) or True)
    for name in ("gallery", "layouts"):
        (tmp_path / name).symlink_to(README.parent / name)

    # Smaller layouts with the names of the bundled ones that are compared, which takes a minute.
    foveal = fs.layout.log_polar(n_sites=1024, min_size_um=3.0, r_max_um=600.0, fovea="rings", stagger=True)
    layouts = {"foveal_blind_spot": foveal, "square_grid": fs.layout.grid(n_sites=1024, size_um=(1063.0, 1063.0))}
    for command in commands:
        if command[0] == "compare":
            assert layouts.keys() <= set(command)
            for name, layout in layouts.items():
                layout.write(tmp_path / "small.npz")
                (tmp_path / "small.npz").rename(tmp_path / name)
        if command[0] not in NOT_RUN:
            result = foveasim(*command, cwd=tmp_path)
            assert result.returncode == 0, (command, result.stderr)
    assert {command[0] for command in commands} >= {"run", "check", "convert", "view", "compare", *NOT_RUN}
    assert len(opened) == 1
    assert {path.name for path in tmp_path.iterdir()} >= {
        "out",
        "report.lyrdb",
        "sensor.gds",
        "report.html",
        "shot.yaml",
    }

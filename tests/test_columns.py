"""Columns of photosites: one registration is enough for tables, figures, pages, datasets, tiles and exports."""

from __future__ import annotations

import subprocess
import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest
from registries import restored

import foveasim as fs
from foveasim.columns import COLUMNS, ColumnInfo, column_info
from foveasim.errors import ParameterError, SimulationError
from foveasim.view.web._content import content_of

SHOT = {
    "optics": {"focal_length_mm": 8.0, "f_number": 4.0},
    "layout": {"generator": "grid", "parameters": {"n_x": 24, "n_y": 20, "pitch_um": 4.0}},
    "sensor": {"read_noise_e": 2.0},
    "scene": {"kind": "picture", "distance_m": 1.0, "illuminance_lux": 300.0, "fit": "cover"},
    "exposure_s": 0.01,
}


def density(capture):
    return capture.electrons / capture.layout.area_um2


@pytest.fixture
def register():
    """Register columns until the end of the test."""
    with restored(COLUMNS):
        yield lambda name, function, **info: COLUMNS.register(name, function, info=ColumnInfo(**info))


@pytest.fixture
def camera():
    layout = fs.layout.grid(n_x=6, n_y=5, pitch_um=4.0)
    return fs.Camera(
        optics=fs.Optics(focal_length_mm=8.0, f_number=4.0),
        sensor=fs.Sensor(layout, capacitance_f=1e-13, read_noise_e=2.0),
    )


@pytest.fixture
def scene():
    return fs.Scene.flat(shape=(64, 64), pitch_um=200.0, distance_m=1.0, illuminance_lux=300.0)


@pytest.fixture
def capture(camera, scene):
    return camera.capture(scene, exposure_s=0.01, seed=1)


def test_one_registration_adds_a_column_everywhere(register, camera, scene, capture, tmp_path):
    """The array has one value per site; the expected values are those of the two arrays that it divides."""
    register("charge_density", density, title="density of charge", unit="e-/µm²", is_signal=True)
    expected = np.asarray(capture.electrons) / 16.0

    table, dataset, mesh = capture.to_pandas(), capture.to_xarray(), fs.view.polydata(capture)
    np.testing.assert_allclose(table["charge_density"], expected, rtol=1e-12)
    np.testing.assert_allclose(dataset["charge_density"], expected, rtol=1e-12)
    np.testing.assert_allclose(mesh.cell_data["charge_density"], expected, rtol=1e-12)
    assert dataset["charge_density"].attrs["units"] == "e-/µm²"
    assert '"charge_density": "e-/\\u00b5m\\u00b2"' in mesh.field_data["units"][0]

    capture.save(tmp_path / "capture.zarr")
    xarray = pytest.importorskip("xarray")
    with xarray.open_zarr(tmp_path / "capture.zarr", consolidated=False) as stored:
        np.testing.assert_allclose(stored["charge_density"], expected, rtol=1e-12)
    np.testing.assert_array_equal(fs.Capture.load(tmp_path / "capture.zarr").code, capture.code)

    np.testing.assert_allclose(fs.view.colours_of(capture, "charge_density").values, expected, rtol=1e-12)
    assert fs.view.colours_of(capture, "charge_density").title == "density of charge / e-/µm²"
    axes = fs.view.plot_capture(capture, "charge_density")
    assert "density of charge" in "".join(each.get_ylabel() + each.get_title() for each in axes.figure.axes)
    plt.close(axes.figure)
    assert fs.view.prisms(capture, "charge_density").values.max() == pytest.approx(expected.max())

    content = content_of(capture)
    column = next(column for column in content.about["columns"] if column["key"] == "charge_density")
    assert (column["label"], column["unit"]) == ("density of charge", "e-/µm²")
    np.testing.assert_allclose(content.arrays[column["array"]], expected, rtol=1e-6)

    tiles = fs.tiles.write_tiles(tmp_path / "tiles.zarr", camera, scene, exposure_s=0.01, seed=1)
    np.testing.assert_allclose(tiles.columns["charge_density"][:], tiles.electrons[:] / 16.0, rtol=1e-12)

    pictures = np.linspace(0, 255, 2 * 100 * 120).reshape(2, 100, 120).astype(np.uint8)
    samples = fs.explore.Dataset(pictures, SHOT, fields=("electrons", "charge_density"))
    np.testing.assert_allclose(samples[1]["charge_density"], samples[1]["electrons"] / 16.0, rtol=1e-12)
    fs.explore.write_dataset(samples, tmp_path / "samples.zarr")
    with xarray.open_zarr(tmp_path / "samples.zarr", consolidated=False) as stored:
        assert stored["charge_density"].attrs["units"] == "e-/µm²"


def test_columns_are_the_arrays_of_captures(capture):
    for name in ("code", "electrons", "expected_e", "filter_of_site"):
        np.testing.assert_array_equal(capture.column(name), getattr(capture, name))
    np.testing.assert_array_equal(capture.column("snr"), capture.signal_to_noise())
    np.testing.assert_array_equal(capture.column("area_um2"), np.full(30, 16.0))
    mean_dn, _ = capture.electronics.predict(capture.expected_e, exposure_s=0.01)
    np.testing.assert_array_equal(capture.column("expected_dn"), mean_dn)


def test_columns_of_the_layout_precede_computed_ones(camera, scene):
    layout = camera.layout.with_columns(snr=np.arange(30.0))
    own = fs.Camera(optics=camera.optics, sensor=fs.Sensor(layout)).capture(scene, exposure_s=0.01, seed=1)

    np.testing.assert_array_equal(own.column("snr"), np.arange(30.0))
    np.testing.assert_array_equal(fs.view.colours_of(own, "snr").values, np.arange(30.0))


def test_tiles_keep_columns_of_their_creation(register, camera, scene, tmp_path):
    fs.tiles.write_tiles(tmp_path / "tiles.zarr", camera, scene, exposure_s=0.01, seed=1)
    register("charge_density", density)

    assert "charge_density" not in fs.tiles.read_tiles(tmp_path / "tiles.zarr").columns
    assert fs.tiles.read_tiles(tmp_path / "tiles.zarr").tile(0).column("charge_density").shape == (30,)


def test_columns_of_one_draw_are_computed_once(register):
    calls = []

    def counted(capture):
        calls.append(1)
        return 2.0 * np.asarray(capture.expected_e)

    register("twice", counted, is_random=False, in_tables=False)
    pictures = np.full((1, 100, 120), 99, np.uint8)
    samples = fs.explore.Dataset(pictures, SHOT, draws=4, fields=("expected_e", "twice"))

    for k in range(4):
        np.testing.assert_array_equal(samples[k]["twice"], 2.0 * samples[k]["expected_e"])
    assert len(calls) == 1


def test_wrong_columns_are_named(register, capture):
    register("mean", lambda capture: capture.code.mean())

    with pytest.raises(SimulationError, match=r"the column 'mean' must have one value for each of the 30 sites"):
        capture.to_pandas()
    with pytest.raises(
        ParameterError, match=r"'name' must be the name of a column, got 'elctrons'; did you mean 'electrons'"
    ):
        capture.column("elctrons")
    with pytest.raises(ParameterError, match=r"'dtype' must be the name of a type of numbers, such as 'f8'"):
        ColumnInfo(dtype="banana")
    with pytest.raises(ParameterError, match=r"fields"):
        fs.explore.Dataset(np.full((1, 8, 8), 9, np.uint8), SHOT, fields=("kode",))


def test_facts_have_defaults(register):
    register("peak_um", density)

    assert (column_info("peak_um").title, column_info("peak_um").unit) == ("peak", "µm")


PROGRAM = """
import sys
import numpy as np
import foveasim as fs
from foveasim.columns import COLUMNS, ColumnInfo

@COLUMNS.register("charge_density", info=ColumnInfo(unit="e-/µm²"))
def charge_density(capture):
    return capture.electrons / capture.layout.area_um2

samples = fs.explore.Dataset(np.full((2, 100, 120), 99, np.uint8), SHOT, fields=("electrons", "charge_density"))
stored = fs.explore.write_dataset(samples, sys.argv[1], per_shard=1, workers=2)
print(np.array_equal(stored[1]["charge_density"], stored[1]["electrons"] / 16.0))
"""


@pytest.mark.slow
def test_workers_have_columns_of_the_program(tmp_path):
    """Processes that do not import the program that registers a column, as those of a notebook."""
    code = PROGRAM.replace("SHOT", repr(SHOT))
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, tmp_path / "a.zarr"], capture_output=True, text=True, check=False
    )

    assert done.stdout == "True\n", done.stderr

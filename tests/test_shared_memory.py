"""Objects keep what they were made of: later edits of a caller's arrays, lists and settings do not reach them."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

import foveasim as fs
from foveasim import distortion, modes, optics, video, view
from foveasim._core.validation import freeze, frozen_array, read_only
from foveasim.maps import from_xarray, read_power_map, to_xarray, write_power_map
from foveasim.metrics.photon_transfer import PhotonTransfer
from foveasim.reconstruct import Picture
from foveasim.sensor import Calibration, FilterSet, KernelCrosstalk, exposures
from foveasim.sensor.spectral import tables

LAYOUT = fs.layout.grid(n_x=3, n_y=2, pitch_um=2.0)
SENSOR = fs.Sensor(LAYOUT, bits=10)
GRID = fs.Grid((4, 5), 1.0)
PLACE = {"pitch_um": 1.0, "distance_m": 1.0}
CORNERS = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
SITES = np.linspace(0.1, 0.6, 6)


def scene_arrays():
    return {
        "basis": np.ones((1, 4, 5), np.float32),
        "spectrum_w_m2_sr_nm": np.ones((1, 2)),
        "wavelength_nm": np.array([500.0, 600.0]),
        "band_width_nm": np.array([10.0, 20.0]),
    }


def capture_arrays():
    return {
        "code": np.arange(6, dtype=np.uint16),
        "electrons": np.arange(6),
        "expected_e": np.arange(6.0),
        "filter_of_site": np.zeros(6, np.int64),
        "white_dn": np.ones(1),
    }


def calibration_arrays():
    numbers = ("offset_dn", "gain", "read_noise_dn", "expected_dn", "dark_rate_dn_per_s", "linear_dn")
    return {name: SITES.copy() for name in numbers} | {
        name: np.zeros(6, bool) for name in ("hot", "dead", "noisy", "clipped")
    }


#: What makes an object of named arrays, and the arrays.
CARRIERS = {
    "PowerMap": (
        lambda data, wavelength_nm: fs.PowerMap(data, GRID, wavelength_nm),
        {"data": np.ones((2, 4, 5)), "wavelength_nm": np.array([500.0, 600.0])},
    ),
    "PowerMap float32": (
        lambda data: fs.PowerMap(data, GRID, np.array([550.0])),
        {"data": np.ones((1, 4, 5), np.float32)},
    ),
    "PowerMap of a view": (
        lambda data: fs.PowerMap(data[::2, :, ::-1], GRID, np.array([550.0])),
        {"data": np.ones((2, 4, 5))},
    ),
    "PowerMap of an open view": (
        lambda data: fs.PowerMap(read_only(data[:]), GRID, np.array([550.0])),
        {"data": np.ones((1, 4, 5))},
    ),
    "PowerMap.from_array": (
        lambda data: fs.PowerMap.from_array(data, pitch_um=1.0, wavelength_nm=550.0),
        {"data": np.ones((4, 5))},
    ),
    "PowerMap.from_array top row first": (
        lambda data: fs.PowerMap.from_array(data, pitch_um=1.0, wavelength_nm=550.0, top_row_first=True),
        {"data": np.ones((1, 5))},
    ),
    "Scene": (lambda **arrays: fs.Scene(**arrays, **PLACE), scene_arrays()),
    "Scene.from_picture": (
        lambda basis: fs.Scene.from_picture(
            basis, peak_radiance_w_m2_sr_nm=1.0, band_width_nm=1.0, encoding="linear", **PLACE
        ),
        {"basis": np.ones((4, 5), np.float32)},
    ),
    "Layout": (
        lambda xy_um, ring_offsets, site_offsets, channel: fs.Layout(
            xy_um, ring_offsets, site_offsets, {"channel": channel}
        ),
        {
            "xy_um": CORNERS.copy(),
            "ring_offsets": np.array([0, 4]),
            "site_offsets": np.array([0, 1]),
            "channel": np.array([1]),
        },
    ),
    "Layout.with_columns": (lambda mine: LAYOUT.with_columns(mine=mine).columns, {"mine": SITES.copy()}),
    "Grid": (
        lambda pitch_um, origin_um: fs.Grid((2, 3), pitch_um, origin_um),
        {"pitch_um": np.array([1.0, 2.0]), "origin_um": np.array([3.0, 4.0])},
    ),
    "Picture": (
        lambda data, coverage: Picture(data, coverage, GRID),
        {"data": np.ones((1, 4, 5), np.float32), "coverage": np.ones((4, 5), np.float32)},
    ),
    "Sensor": (
        lambda **arrays: fs.Sensor(LAYOUT, **arrays),
        {name: SITES.copy() for name in ("sensitivity", "dark_e_per_s", "full_well_e", "read_noise_e")}
        | {"capacitance_f": np.full(6, 1e-15), "inl_dn": np.array([0.0, 1.0, 0.0])},
    ),
    "Sensor companding": (
        lambda companding_table: fs.Sensor(LAYOUT, companding="table", companding_table=companding_table),
        {"companding_table": np.array([0.0, 0.5, 1.0])},
    ),
    "KernelCrosstalk": (lambda kernel: KernelCrosstalk(kernel=kernel), {"kernel": np.array([[0.1, 0.8, 0.1]])}),
    "TableCurve": (
        tables.TableCurve,
        {"wavelength_nm": np.array([400.0, 700.0]), "value": np.array([0.1, 0.2])},
    ),
    "PolynomialFisheye": (
        lambda k: distortion.PolynomialFisheye(k=k, focal_um=100.0),
        {"k": np.array([0.1, 0.0, 0.0, 0.0])},
    ),
    "Scaramuzza": (
        lambda a, stretch: distortion.Scaramuzza(a=a, stretch=stretch, focal_um=100.0, pixel_um=1.0),
        {"a": np.array([100.0, -1e-3, 0.0, 0.0]), "stretch": np.eye(2)},
    ),
    "BrownConrady": (
        lambda focal_um, centre_um: distortion.BrownConrady(focal_um=focal_um, centre_um=centre_um),
        {"focal_um": np.array([100.0, 110.0]), "centre_um": np.array([1.0, 2.0])},
    ),
    "PupilImage": (
        lambda picture, wavefront_um: optics.PupilImage(picture, wavefront_um=wavefront_um),
        {"picture": np.ones((1, 1)), "wavefront_um": np.zeros((1, 1))},
    ),
    "LateralColour": (
        optics.LateralColour,
        {"wavelength_nm": np.array([500.0, 600.0]), "magnification": np.array([1.0, 1.01])},
    ),
    "Capture": (
        lambda **arrays: fs.Capture(layout=LAYOUT, filter_names=("all",), bits=10, settings={}, **arrays),
        capture_arrays(),
    ),
    "Calibration": (Calibration, calibration_arrays()),
    "Ramp": (
        exposures.Ramp,
        {"times_s": np.array([0.1, 0.2]), "electrons": np.ones((2, 6), np.int64), "code": np.ones((2, 6), np.uint16)},
    ),
    "Rates": (
        exposures.Rates,
        {"rate_e_per_s": SITES.copy(), "sigma_e_per_s": SITES.copy(), "n_used": np.ones(6, np.int64)},
    ),
    "PhotonTransfer": (
        PhotonTransfer,
        {
            "classes": np.array([0, 1]),
            "n_sites": np.array([3, 3]),
            "n_frames": np.array([2]),
            "mean_dn": np.ones((1, 2)),
            "temporal_variance_dn2": np.ones((1, 2)),
            "spatial_variance_dn2": np.ones((1, 2)),
        },
    ),
    "Events": (
        lambda t_s, site, polarity: modes.Events(t_s, site, polarity, LAYOUT),
        {
            "t_s": np.array([0.1, 0.2]),
            "site": np.array([1, 2], np.int32),
            "polarity": np.array([1, -1], np.int8),
        },
    ),
    "SpikingPixels": (
        lambda threshold_e: modes.SpikingPixels(SENSOR, threshold_e=threshold_e),
        {"threshold_e": SITES + 1},
    ),
    "GazePath": (video.GazePath, {"t_s": np.array([0.0, 1.0]), "xy_um": np.zeros((2, 2))}),
    "SiteColours": (lambda values: view.colours_of(LAYOUT, values), {"values": SITES.copy()}),
}


def held(made, name):
    return np.array(made[name] if not hasattr(made, name) else getattr(made, name))


@pytest.mark.parametrize("name", CARRIERS)
def test_edits_of_arrays_reach_no_object(name):
    make, arrays = CARRIERS[name]
    arrays = {key: array.copy() for key, array in arrays.items()}
    made = make(**arrays)
    before = {key: held(made, key) for key in arrays}

    for array in arrays.values():
        array[...] = 0 if array.dtype != bool else True

    for key, values in before.items():
        np.testing.assert_array_equal(held(made, key), values, err_msg=key)


@pytest.mark.parametrize("name", [n for n in CARRIERS if n != "Grid"])
def test_arrays_of_objects_are_read_only(name):
    make, arrays = CARRIERS[name]
    made = make(**{key: array.copy() for key, array in arrays.items()})

    for key in arrays.keys() - {"channel"}:  # which a layout makes of its column
        values = made[key] if not hasattr(made, key) else getattr(made, key)
        assert isinstance(values, tuple | float) or not values.flags.writeable, key


@pytest.mark.parametrize("name", ["PowerMap", "Scene", "Picture", "Events"])
def test_objects_leave_given_arrays_writeable(name):
    make, arrays = CARRIERS[name]
    arrays = {key: array.copy() for key, array in arrays.items()}
    make(**arrays)

    assert all(array.flags.writeable for array in arrays.values())


def test_lists_of_a_sensor_are_its_own():
    table, faults, curves = [0.0, 0.5, 1.0], [0.0, 1.0, 0.0], [fs.sensor.ConstantCurve(0.5)]
    sensor = fs.Sensor(LAYOUT, companding="table", companding_table=table, inl_dn=faults, filters=FilterSet(curves))
    table[1], faults[1], curves[0] = 0.9, 5.0, None

    assert sensor.companding_table == (0.0, 0.5, 1.0)
    assert sensor.inl_dn == (0.0, 1.0, 0.0)
    assert callable(sensor.filters.curves[0])
    assert replace(sensor, bits=12).companding_table == (0.0, 0.5, 1.0)


def test_provenance_of_a_layout_is_its_own():
    told = {"generator": "mine", "parameters": {"size_um": [1.0, 2.0]}, "steps": ["first"]}
    layout = fs.Layout(CORNERS, [0, 4], [0, 1], provenance=told)
    moved = layout.translate(1.0, 0.0)
    told["parameters"]["size_um"][0] = 9.0
    moved.provenance["parameters"]["size_um"][1] = 9.0

    assert layout.provenance["parameters"]["size_um"] == [1.0, 2.0]


# -- captures -----------------------------------------------------------------------------------------------------------


def camera():
    return fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=SENSOR)


def light():
    return fs.PowerMap.from_array(np.ones((8, 8)), pitch_um=1.0, wavelength_nm=550.0)


def test_edited_settings_stay_with_one_capture():
    mine = camera()
    first = mine.capture(light(), exposure_s=0.01, seed=0)
    second = mine.capture(light(), exposure_s=0.01, seed=0)
    first.settings["optics"]["f_number"] = 99.0
    first.settings["layout"]["parameters"]["n_x"] = 99
    first.settings["sensor"].clear()
    third = mine.capture(light(), exposure_s=0.01, seed=0)

    for capture in (second, third):
        assert capture.settings["optics"]["f_number"] == 4.0
        assert capture.settings["layout"]["parameters"]["n_x"] == 3
        assert capture.settings["sensor"]["bits"] == 10


def test_edited_settings_stay_with_one_frame():
    frames = camera().video([light(), light()], exposure_s=0.01, seed=0)
    next(frames).settings["optics"]["f_number"] = 99.0

    assert next(frames).settings["optics"]["f_number"] == 4.0


def test_capture_keeps_settings_that_it_was_given():
    told = {"exposure_s": 1.0, "sensor": {"list": [1, {"deep": 2}]}}
    capture = fs.Capture(layout=LAYOUT, filter_names=("all",), bits=10, settings=told, stage_s={}, **capture_arrays())
    told["sensor"]["list"][1]["deep"] = 3

    assert capture.settings == {"exposure_s": 1.0, "sensor": {"list": [1, {"deep": 2}]}}
    other = replace(capture)
    other.settings["sensor"]["list"][1]["deep"] = 4
    assert capture.settings["sensor"]["list"][1]["deep"] == 2


# -- memory -------------------------------------------------------------------------------------------------------------


def peak_bytes(call):
    tracemalloc.start()
    made = call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return made, peak


def test_read_only_arrays_are_shared():
    data = read_only(np.ones((1, 400, 500)))

    made, peak = peak_bytes(lambda: fs.PowerMap(data, fs.Grid((400, 500), 1.0), np.array([550.0])))

    assert np.shares_memory(made.data, data)
    assert peak < 0.1 * data.nbytes
    again, peak = peak_bytes(lambda: replace(made, grid=fs.Grid((400, 500), 2.0)))
    assert np.shares_memory(again.data, data)
    assert peak < 0.1 * data.nbytes


def test_frozen_arrays_are_copies_of_writeable_ones(tmp_path):
    data = np.arange(6.0)
    view_of_data = read_only(data[::2])

    assert not np.shares_memory(frozen_array(view_of_data), data)
    assert frozen_array(view_of_data).tolist() == [0.0, 2.0, 4.0]
    buffer = np.frombuffer(bytearray(16))
    assert not np.shares_memory(frozen_array(read_only(buffer)), buffer)
    np.save(tmp_path / "map.npy", data)
    assert isinstance(frozen_array(np.load(tmp_path / "map.npy", mmap_mode="r")), np.memmap)
    assert not isinstance(frozen_array(np.load(tmp_path / "map.npy", mmap_mode="r+")).base, np.memmap)
    window = freeze(data[2:])
    assert frozen_array(window) is window
    with pytest.raises(ValueError, match="read-only"):
        data[0] = 1.0


@pytest.mark.parametrize("ending", ["npz", "npy", "fits"])
def test_reading_map_takes_little_more_memory(tmp_path, ending):
    values = np.random.default_rng(0).random((500, 600))
    written = fs.PowerMap.from_array(values, pitch_um=1.0, wavelength_nm=550.0)
    path = tmp_path / f"map.{ending}"
    if ending == "npy":
        np.save(path, values)
    else:
        write_power_map(written, path)
    told = {"pitch_um": 1.0, "wavelength_nm": 550.0, "unit": "w_m2"} if ending == "npy" else {}
    read_power_map(path, **told)

    read, peak = peak_bytes(lambda: read_power_map(path, **told))

    np.testing.assert_array_equal(read.data, written.data)
    assert not read.data.flags.writeable
    assert peak < 2.6 * values.nbytes  # the file, the map, and a mask of its finite numbers


def test_labelled_array_is_copied():
    array = to_xarray(fs.PowerMap.from_array(np.ones((4, 5)), pitch_um=1.0, wavelength_nm=550.0)).copy(deep=True)
    made = from_xarray(array)
    array[...] = 7.0

    assert (made.data == 1.0).all()


def test_optics_and_distortion_make_maps_without_copies():
    scene = fs.Scene.flat(shape=(300, 300), pitch_um=100.0, distance_m=1.0, radiance_w_m2_sr_nm=1.0, band_width_nm=1.0)
    lens = fs.Optics(focal_length_mm=8.0, f_number=4.0)
    made = lens.power_map(scene)
    warped = distortion.distort_map(made, distortion.BrownConrady(focal_um=1e5, k1=-0.1))

    for power_map in (made, warped):
        assert power_map.data.base is None  # what the stage filled, and no copy of it
        assert not power_map.data.flags.writeable
    part = replace(scene, basis=scene.basis[:, 10:50, 20:90])
    assert np.shares_memory(part.basis, scene.basis)

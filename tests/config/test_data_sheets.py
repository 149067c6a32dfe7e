"""Data sheets and presets in settings files: the sensors of Python, their origin, and errors with both lines."""

import pickle
from dataclasses import fields, replace

import numpy as np
import pytest
import yaml

import foveasim as fs
from foveasim._core.provenance import to_plain_data
from foveasim.config import build_shot, demo_settings, put_setting, read_settings, read_shot, to_python
from foveasim.config._electronics import with_electronics
from foveasim.config._new_sensor import asked_quantities, quantities_of
from foveasim.errors import ConfigError, FileError, ParameterError

SHEET = {
    "title": "Test sensor", "source": "test of settings", "pixel_um": "3.45", "bits": 12, "wavelength_nm": 550,
    "qe_curve": [[380, 30], [550, 65], [780, 20]], "dark_noise_e": "2.1", "saturation_e": 10_400, "dsnu_e": "0.9",
    "dark_current_e_per_s": "4.0", "temperature_k": 300,
}  # fmt: skip


@pytest.fixture
def shot_file(tmp_path):
    """Write a settings file in one directory, and its data sheet in another."""

    def write(sheet=SHEET, **sensor):
        (tmp_path / "sheets").mkdir(exist_ok=True)
        (tmp_path / "sheets" / "test.yaml").write_text(yaml.safe_dump(sheet, sort_keys=False))
        path = tmp_path / "shot.yaml"
        settings = read_settings(demo_settings()[1]) | {"sensor": {"datasheet": "sheets/test.yaml", **sensor}}
        path.write_text(yaml.safe_dump(settings, sort_keys=False))
        return path

    return write


def assert_equal_sensors(one, other):
    for each in fields(fs.Sensor):
        if each.name != "layout":
            assert to_plain_data(getattr(one, each.name)) == to_plain_data(getattr(other, each.name)), each.name


@pytest.mark.parametrize(
    "changes", [{}, {"bits": 10}, {"dsnu_e": 2.0}, {"gain_dn_per_e": 0.2}, {"full_well_e": None}, {"qe": 0.4}]
)
def test_datasheet_of_settings_equals_python(shot_file, tmp_path, changes):
    sensor = read_shot(shot_file(**changes)).camera.sensor
    expected = fs.Sensor.from_datasheet(sensor.layout, tmp_path / "sheets" / "test.yaml", **changes)

    assert_equal_sensors(sensor, expected)


@pytest.mark.parametrize("name", ["mobile", "imx900_low_gain", "paper_foveal"])
def test_preset_of_settings_equals_python(name):
    settings = read_settings(demo_settings()[1]) | {"sensor": {"preset": name, "read_noise_e": 3.0}}
    sensor = build_shot(None, settings).camera.sensor

    assert_equal_sensors(sensor, fs.Sensor.from_preset(sensor.layout, name, read_noise_e=3.0))


def test_values_of_sheet_equal_its_name(shot_file):
    """The controls of the studio show the values, which give the same codes."""
    path = shot_file(bits=10)
    settings = read_settings(path)
    expanded = settings | {"sensor": with_electronics(path, settings["sensor"])}

    assert "datasheet" not in expanded["sensor"]
    assert expanded["sensor"]["bits"] == 10
    assert_equal_sensors(build_shot(path, expanded).camera.sensor, build_shot(path, settings).camera.sensor)


def test_source_of_datasheet_gives_same_codes(shot_file):
    path = shot_file(read_noise_e=2.5)
    text = to_python(read_settings(path), source=path)
    found = {}
    exec(text, found)
    shot = read_shot(path)

    assert "fs.Sensor.from_datasheet(" in text
    assert np.array_equal(
        found["capture"].code, shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed).code
    )


def test_errors_name_both_lines(shot_file, tmp_path):
    path = shot_file(SHEET | {"dark_noise_e": "-2.1"})
    sheet = tmp_path / "sheets" / "test.yaml"
    lines = [
        next(k for k, text in enumerate(file.read_text().splitlines(), 1) if name in text)
        for file, name in ((path, "datasheet"), (sheet, "dark_noise_e"))
    ]

    with pytest.raises(ConfigError) as caught:
        read_shot(path)
    assert str(caught.value).startswith(
        f"{path}:{lines[0]}:3: sensor.datasheet: {sheet}:{lines[1]}:1: dark_noise_e: must be > 0"
    )
    sheet.unlink()
    with pytest.raises(ConfigError, match=r"sensor\.datasheet: .*test\.yaml: no such file"):
        read_shot(path)
    with pytest.raises(ConfigError, match=r":\d+:3: sensor\.datasheet: must not be given together with 'preset'"):
        read_shot(shot_file(preset="mobile"))
    with pytest.raises(ConfigError, match=r"--set sensor\.datasheet: .*none\.yaml: no such file"):
        read_shot(shot_file(), ["sensor.datasheet=none.yaml"])


def test_preset_and_sheet_replace_each_other(shot_file):
    settings = read_settings(shot_file())
    put_setting(None, settings, "sensor.preset", "mobile")
    assert settings["sensor"] == {"preset": "mobile"}
    put_setting(None, settings, "sensor.datasheet", "x.yaml")
    assert settings["sensor"] == {"datasheet": "x.yaml"}


# -- origin of values ----------------------------------------------------------------------------------------------------


def test_provenance_says_where_values_come_from(tmp_path):
    layout = fs.layout.grid(4, 4, 3.45)
    sensor = fs.Sensor.from_datasheet(layout, fs.sensor.DataSheet(**SHEET), capacitance_f=1e-15, filters=None)
    found = sensor.provenance

    assert (found["title"], found["source"]) == ("Test sensor", "test of settings")
    assert found["printed"]["saturation_e"] == "10400"
    assert found["printed"]["qe_curve"] == "30 % at 380 nm, 65 % at 550 nm, 20 % at 780 nm"
    assert found["derived"]["qe_percent"] == "qe_curve at wavelength_nm"
    assert any(each.startswith("The gain is ") for each in found["assumptions"])
    assert found["replaced"] == ["capacitance_f"]
    assert fs.Sensor(layout).provenance == {}
    assert replace(sensor, bits=10).provenance == found
    assert pickle.loads(pickle.dumps(sensor)).provenance == found
    assert "test of settings" in sensor._repr_html_()
    with pytest.raises(TypeError):
        found["title"] = "other"


def test_captures_contain_the_provenance(tmp_path):
    sensor = fs.Sensor.from_preset(fs.layout.grid(8, 8, 3.45), "machine_vision", qe=0.6)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=sensor)
    scene = fs.Scene.flat(shape=(20, 20), pitch_um=900.0, distance_m=1.0, radiance_w_m2_sr_nm=0.01, band_width_nm=10.0)
    camera.capture(scene, exposure_s=0.01, seed=1).save(tmp_path / "capture.npz")
    stored = fs.Capture.load(tmp_path / "capture.npz").settings["sensor"]

    assert stored["provenance"]["source"] == fs.sensor.PRESETS["machine_vision"].source
    assert fs.Sensor.from_settings(sensor.layout, stored).provenance == sensor.provenance


# -- new files -------------------------------------------------------------------------------------------------------------


def test_new_sensor_files_are_read(tmp_path):
    quantities = quantities_of(
        ["pixel_um=2.25", "bits=12", "qe_percent = 91.25", "dark_noise_e=5.560", "saturation_e=9458"]
    )
    sheet, shot = fs.config.write_sensor_files(quantities, tmp_path / "camera.yaml")
    sensor = read_shot(shot, ["layout.parameters.r_max_um=150"]).camera.sensor

    assert sheet.name == "camera_datasheet.yaml"
    assert "'5.560'" in sheet.read_text()
    assert sensor.read_noise_e == 5.56
    with pytest.raises(FileError, match="exists already"):
        fs.config.write_sensor_files(quantities, tmp_path / "camera.yaml")
    with pytest.raises(ParameterError, match="'bits' must be in the data sheet"):
        fs.config.write_sensor_files({"pixel_um": 3.0}, tmp_path / "other.yaml")
    with pytest.raises(
        ParameterError, match="'dark_noise' must be a quantity of a data sheet; did you mean 'dark_noise_e'"
    ):
        quantities_of(["dark_noise=5"])


def test_questions_are_repeated_after_errors():
    """A required one without an answer, one out of range, and one that contradicts another."""
    answers = {
        "pixel_um": ["", "2.25"], "bits": ["12"], "qe_percent": ["640", "64"], "dark_noise_e": ["5.560"],
        "saturation_e": ["94580", "9458"], "snr_max_db": ["39.8"],
    }  # fmt: skip
    errors = []

    def answer(question):
        given = answers.get(question.partition(" ")[0], [])
        return given.pop(0) if given else ""

    found = asked_quantities(answer, errors.append)

    assert found == {
        "pixel_um": "2.25", "bits": 12, "qe_percent": "64", "dark_noise_e": "5.560", "saturation_e": "9458",
        "snr_max_db": "39.8",
    }  # fmt: skip
    assert [each.partition(" ")[0] for each in errors] == ["'pixel_um'", "'qe_percent'", "'saturation_e'"]

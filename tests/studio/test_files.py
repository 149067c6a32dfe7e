"""Files on the page: each reader is reached, and what a dropped file is for follows from its content."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from reference.twins import small_twin

import foveasim as fs
from foveasim.errors import FileError
from foveasim.studio._settings.controls import controls_of
from foveasim.studio._settings.uses import use_of

CALIBRATION = (
    "image_width: 640\nimage_height: 480\ncamera_matrix: [800, 0, 319.5, 0, 800, 239.5, 0, 0, 1]\n"
    "distortion_coefficients: [-0.2, 0.05, 0, 0]\n"
)
GEOMETRY = '{"type": "FeatureCollection", "features": []}'


@pytest.fixture(scope="module")
def lens_file(tmp_path_factory):
    """A file of the PSF of a lens."""
    spot = fs.Optics(focal_length_mm=8.0, f_number=8.0).psf(550.0, pitch_um=2.0, n_points=33).psf_per_um2
    psfs = fs.optics.PSFGrid.from_arrays(spot, x_um=0.0, y_um=0.0, wavelength_nm=550.0, pitch_um=2.0)
    path = tmp_path_factory.mktemp("lens") / "lens.npz"
    psfs.write(path)
    return path


def irradiance():
    return fs.PowerMap.from_array(np.full((60, 80), 1e-2), pitch_um=10.0, wavelength_nm=550.0)


@pytest.mark.parametrize(
    ("name", "content", "use"),
    [
        ("left.yaml", CALIBRATION, "calibration"),
        ("left.xml", '<?xml version="1.0"?><opencv_storage></opencv_storage>', "calibration"),
        ("left.json", '{"K": [1, 0, 0, 0, 1, 0, 0, 0, 1]}', "calibration"),
        ("calib_results.txt", "#polynomial coefficients for the DIRECT mapping function\n5 -1 0 1 0 0\n", "calibration"),
        ("sites.json", GEOMETRY, "layout"),
        ("sites.yaml", "generator: grid\nparameters: {n_x: 2, n_y: 2, pitch_um: 3.0}\n", "layout"),
        ("shot.yaml", "exposure_s: 0.1\n", "settings"),
        ("index.yaml", "psfs: []\n", "psfs"),
        ("gaze.csv", "t_s,x_um,y_um\n0,0,0\n", "gaze"),
        ("cube.hdr", "ENVI\nsamples = 3\n", "cube"),
        ("photo.png", b"\x89PNG\r\n\x1a\n", "scene"),
        ("photo.tif", b"II*\x00\x08\x00\x00\x00", "scene"),
        ("photo.exr", b"v/1\x01\x02\x00\x00\x00", "scene"),
        ("clip.bin", b"\x00\x01\x02\x03", "scene"),
    ],
)  # fmt: skip
def test_content_decides_what_files_are(tmp_path, name, content, use):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())

    assert use_of(path) == use


def test_archives_are_what_metadata_say(tmp_path, lens_file):
    fs.layout.grid(3, 3, 4.0).write(tmp_path / "sites.npz")
    fs.write_power_map(irradiance(), tmp_path / "map.npz")

    assert [use_of(path) for path in (tmp_path / "sites.npz", lens_file, tmp_path / "map.npz")] == [
        "layout",
        "psfs",
        "map",
    ]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("map.fits", b"SIMPLE  =                    T", "several meanings; .* setting optics.psfs .PSFs. or scene .power map."),
        ("cube.mat", b"MATLAB 5.0 MAT-file", "several meanings; .* scene .power map. or scene .cube."),
        ("qe.csv", b"wavelength_nm,QE\n400,0.5\n", "is a text; choose it in the list of the setting"),
    ],
)  # fmt: skip
def test_several_meanings_are_one_sentence(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)

    with pytest.raises(FileError, match=message):
        use_of(tmp_path / name)


def test_dropped_psfs_replace_diffraction(recorder, lens_file):
    path = recorder.session.add_file(lens_file.name, lens_file.read_bytes())

    state = recorder.do(do="file", path=str(path))

    assert state["errors"] == {}
    assert state["settings"]["optics"]["psfs"] == {"path": str(path)}
    assert recorder.session.result.shot.camera.optics.psfs.pitch_um == 2.0


def test_dropped_calibration_names_its_parameters(recorder):
    path = recorder.session.add_file("left.yaml", CALIBRATION.encode())

    state = recorder.do(do="file", path=str(path))

    assert "requires pixel_um; choose it in the list of the setting distortion (calibration)" in state["errors"]["file"]


def test_choices_with_files_open_every_reader(recorder, tmp_path):
    """Values as the page sends them: those of the choice, a file, and the parameters that the user types."""
    np.save(tmp_path / "cube.npy", np.full((60, 80, 3), 0.5, np.float32))
    fs.write_power_map(irradiance(), tmp_path / "map.npz")
    fs.layout.mosaic(fs.layout.grid(9, 8, 10.0), ["RG", "GB"]).write(tmp_path / "sites.npz")
    (tmp_path / "left.yaml").write_text(CALIBRATION)
    (tmp_path / "filters.csv").write_text("wavelength_nm,R,G,B\n300,0.1,0.2,0.3\n1100,0.3,0.2,0.1\n")
    typed = {
        "calibration": ("left.yaml", {"pixel_um": 3.0}),
        "cube": ("cube.npy", {
            "wavelength_nm": [450.0, 550.0, 650.0], "quantity": "reflectance", "distance_m": 1.0, "luminance_cd_m2": 50.0,
        }),
        "filter file": ("filters.csv", {}),
        "layout file": ("sites.npz", {}),
        "power map": ("map.npz", {}),
    }  # fmt: skip
    controls = controls_of(recorder.session.history.settings)
    found = {}
    for control in controls:
        for choice in control.get("choices", ()):
            if choice.get("label") not in typed or "file" not in choice:
                continue
            name, parameters = typed[choice["label"]]
            assert set(choice["required"]) <= set(parameters) <= {*choice["required"], *choice["optional"]}
            path = recorder.session.add_file(name, (tmp_path / name).read_bytes())
            value = {**choice["value"], choice["file"]: str(path), **parameters}
            state = recorder.do(do="set", key=control["key"], value=value, final=True)
            assert state["errors"] == {}, choice["label"]
            found[choice["label"]] = state["settings"]
            recorder.do(do="undo")

    assert found.keys() == typed.keys()
    assert found["calibration"]["distortion"]["kind"] == "calibration"
    assert found["power map"]["scene"] == {"kind": "power_map", "path": found["power map"]["scene"]["path"]}


def test_equal_files_are_stored_once(recorder):
    """Lists of files name the others, whose names remain."""
    first = recorder.session.add_file("listing.txt", b"1 2 3")
    free = recorder.session.n_free_bytes

    assert recorder.session.add_file("listing.txt", b"1 2 3") == first
    assert recorder.session.n_free_bytes == free
    assert recorder.session.add_file("listing.txt", b"1 2 4") != first


def test_data_sheets_of_settings_are_checked(recorder, tmp_path):
    """The sheet is read after the check of its path, and the controls show its values."""
    uploads = recorder.session.files._uploads
    sheet = {"pixel_um": "3.45", "bits": 12, "qe_percent": 64, "dark_noise_e": "2.1", "saturation_e": 10_400}
    for directory in (uploads, tmp_path):
        (directory / "camera.yaml").write_text(yaml.safe_dump(sheet))
    settings = uploads / "shot.yaml"
    start = recorder.session.history.settings
    settings.write_text(yaml.safe_dump({**start, "sensor": {"datasheet": "camera.yaml", "bits": 10}}))
    found = recorder.session.files.settings_of(str(settings))["sensor"]

    assert (found["bits"], found["read_noise_e"], "datasheet" in found) == (10, 2.1, False)
    assert found["provenance"]["replaced"] == ["bits"]
    settings.write_text(yaml.safe_dump({**start, "sensor": {"datasheet": str(tmp_path / "camera.yaml")}}))
    with pytest.raises(FileError, match=r"sensor\.datasheet: .* is not available here"):
        recorder.session.files.settings_of(str(settings))


def test_chosen_data_sheet_replaces_electronics(recorder):
    path = recorder.session.files._uploads / "camera.yaml"
    sheet = {"pixel_um": "3.45", "bits": 11, "qe_percent": 64, "dark_noise_e": "2.1", "saturation_e": 10_400}
    path.write_text(yaml.safe_dump(sheet))
    recorder.do(do="set", key="sensor.bits", value=14, final=True)
    state = recorder.do(do="set", key="sensor.datasheet", value=str(path), final=True)

    assert state["errors"] == {}
    assert "bits" not in state["settings"]["sensor"]
    assert recorder.session.result.capture.bits == 11


# -- twins of cameras --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def twin_content(tmp_path_factory):
    path = tmp_path_factory.mktemp("twin") / "twin.npz"
    small_twin().save(path)
    return path.read_bytes()


def test_dropped_twin_becomes_the_sensor(recorder, twin_content):
    """Its pixels replace the layout, its values the electronics; later edits of both keep it."""
    path = recorder.session.add_file("twin.npz", twin_content)
    recorder.do(do="set", key="sensor.bits", value=14, final=True)
    state = recorder.do(do="file", path=str(path))

    assert use_of(path) == "twin"
    assert state["errors"] == {}
    assert state["settings"]["sensor"]["twin"] == str(path)
    assert recorder.session.result.capture.bits == 11
    assert recorder.session.result.shot.camera.layout.n_sites == 48
    sensor = recorder.session.result.shot.camera.sensor
    assert "response_map" in {effect.name for effect in sensor.chain}
    controls = {control["key"]: control for control in recorder.session.controls}
    assert controls["sensor.bits"]["default"] == 11
    assert controls["sensor.read_noise_e"]["default"] == pytest.approx(5.0, rel=0.1)
    state = recorder.do(do="set", key="sensor.read_noise_e", value=3.0, final=True)
    assert state["settings"]["sensor"]["twin"] == str(path)
    state = recorder.do(do="set", key="layout", value="square_grid", final=True)
    assert state["errors"] == {}
    assert state["settings"]["sensor"]["twin"] == str(path)
    assert "response_map" not in {effect.name for effect in recorder.session.result.shot.camera.sensor.chain}
    recorder.do(do="undo")
    assert recorder.session.result.shot.camera.layout.n_sites == 48


def test_settings_with_twins_open(recorder, tmp_path, twin_content):
    """Without a layout, they have the pixels of the twin; files elsewhere are rejected before they are read."""
    for directory in (recorder.session.files._uploads, tmp_path):
        (directory / "twin.npz").write_bytes(twin_content)
    settings = recorder.session.files._uploads / "shot.yaml"
    start = {name: value for name, value in recorder.session.history.settings.items() if name != "layout"}
    settings.write_text(yaml.safe_dump({**start, "sensor": {"twin": "twin.npz", "bits": 10}}))
    state = recorder.do(do="file", path=str(settings))

    assert state["errors"] == {}
    path = str(recorder.session.files._uploads / "twin.npz")
    assert (state["settings"]["sensor"], state["settings"]["layout"]) == ({"twin": path, "bits": 10}, {"file": path})
    assert recorder.session.result.shot.camera.layout.n_sites == 48
    settings.write_text(yaml.safe_dump({**start, "sensor": {"twin": str(tmp_path / "twin.npz")}}))
    with pytest.raises(FileError, match="is not available here"):
        recorder.session.files.settings_of(str(settings))


def test_corrupt_twin_is_one_sentence(recorder, twin_content):
    path = recorder.session.add_file("bad.npz", twin_content[:-300])
    state = recorder.do(do="set", key="sensor.twin", value=str(path), final=True)

    (message,) = state["errors"].values()
    assert "bad.npz: is corrupt or not a valid foveasim twin" in message

"""Settings files: objects that they build, and one line for every error."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from registries import restored

import foveasim as fs
from foveasim._io.images import read_picture, write_picture
from foveasim._io.yaml_files import read_yaml
from foveasim.config import (
    build_shot,
    bundled_layouts,
    demo_settings,
    read_any_layout,
    read_layout_file,
    read_settings,
    read_shot,
    schema,
    to_python,
)
from foveasim.errors import ConfigError, FileError
from foveasim.view import plot_layout, save_figure

REPOSITORY = Path(fs.__file__).parents[1]
SHOT = """
scene: {kind: flat, shape: [80, 90], pitch_um: 400, distance_m: 1.0, radiance_w_m2_sr_nm: 0.2, band_width_nm: 100}
optics: {focal_length_mm: 8, f_number: 2.8}
layout:
  generator: hexagonal
  parameters: {n_columns: 10, n_rows: 12, pitch_um: 8}
sensor: {bits: 10, capacitance_f: {per_um2: 1e-15}}
exposure_s: 0.01
seed: 7
"""


@pytest.fixture
def shot_file(tmp_path):
    path = tmp_path / "shot.yaml"
    path.write_text(SHOT)
    return path


def test_shot_file_equals_calls(shot_file):
    shot = read_shot(shot_file)
    layout = fs.layout.hexagonal(n_columns=10, n_rows=12, pitch_um=8.0)
    sensor = fs.Sensor(layout, bits=10, capacitance_f=1e-15 * layout.area_um2)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)
    scene = fs.Scene.flat(shape=(80, 90), pitch_um=400.0, distance_m=1.0, radiance_w_m2_sr_nm=0.2, band_width_nm=100.0)
    by_hand = camera.capture(scene, exposure_s=0.01, seed=7)
    by_file = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)

    assert np.array_equal(by_file.code, by_hand.code)
    assert by_file.settings == by_hand.settings


def test_exponents_without_point_are_numbers(shot_file):
    assert read_shot(shot_file, ["sensor.v_sat_v=3e0"]).camera.sensor.v_sat_v == 3.0


@pytest.mark.parametrize(
    ("change", "value"),
    [
        ("sensor.bits=12", lambda s: s.camera.sensor.bits == 12),
        ("sensor.qe={kind: silicon, depth_um: 2.5}", lambda s: s.camera.sensor.qe == fs.SiliconQE(depth_um=2.5)),
        ("optics.emission=isotropic", lambda s: s.camera.optics.emission == "isotropic"),
        (
            "optics.pupil={kind: blades, n_blades: 5, angle_deg: 18}",
            lambda s: s.camera.optics.pupil == fs.optics.Blades(5, angle_deg=18.0),
        ),
        (
            "optics.pupil=[{kind: annulus, obscuration: 0.3}, {kind: spider, n_vanes: 4, width_fraction: 0.02}]",
            lambda s: list(s.camera.optics.pupil) == [fs.optics.Annulus(0.3), fs.optics.Spider(4, 0.02)],
        ),
        (
            "optics.zernike={coefficients: {7: 0.1, 4: [0.0, 0.2]}, unit: waves, wavelength_nm: [450, 650]}",
            lambda s: s.camera.optics.zernike.coefficients == {7: 0.1, 4: (0.0, 0.2)},
        ),
        ("optics.seidel={coma_um: 0.3}", lambda s: s.camera.optics.seidel == fs.optics.Seidel(coma_um=0.3)),
        ("optics.focus_distance_m=2.0", lambda s: s.camera.optics.defocus_um(1.0) > 0.0),
        (
            "optics.lateral_colour={wavelength_nm: [450, 650], magnification: [0.999, 1.001]}",
            lambda s: s.camera.optics.lateral_colour.magnification == (0.999, 1.001),
        ),
        (
            "distortion={kind: brown_conrady, focal_um: 8000.0, k1: -0.1}",
            lambda s: s.camera.distortion == fs.distortion.BrownConrady(focal_um=8000.0, k1=-0.1),
        ),
        (
            "distortion={kind: scaramuzza, a: [1.57e3, -2.75e-4, 3.76e-8, -3.64e-11], pixel_um: 2.2, focal_um: 22e3}",
            lambda s: s.camera.distortion.a == (1570.0, -2.75e-4, 3.76e-8, -3.64e-11),
        ),
        ("layout.mosaic=[RG, GB]", lambda s: s.camera.sensor.layout.channel.max() == 2),
        (
            "sensor.crosstalk={kind: diffusion, spread_um: 0.4}",
            lambda s: s.camera.sensor.crosstalk == fs.sensor.Diffusion(spread_um=0.4),
        ),
        (
            "sensor.crosstalk={kind: kernel, kernel: [[0, 0.02, 0], [0.02, 0.92, 0.02], [0, 0.02, 0]]}",
            lambda s: s.camera.sensor.crosstalk.kernel[1][1] == 0.92,
        ),
        (
            "sensor.coupling={neighbour_fraction: 0.01}",
            lambda s: s.camera.sensor.coupling == fs.sensor.InterPixelCapacitance(neighbour_fraction=0.01),
        ),
        ("sensor.companding=root", lambda s: s.camera.sensor.adc.companding == "root"),
        ("sensor.inl_dn=[0, 1, 0]", lambda s: s.camera.sensor.adc.inl_dn == (0.0, 1.0, 0.0)),
        ("sensor.ktc_noise=true", lambda s: "reset" in [effect.name for effect in s.camera.sensor.chain]),
        (
            "sensor={filters: rgb, qe: [0.3, {kind: constant, value: 0.5}, 0.4]}; layout.mosaic=[RG, GB]",
            lambda s: s.camera.sensor.qe == (0.3, fs.sensor.ConstantCurve(0.5), 0.4),
        ),
        ("layout.move_um=[5.0, -3.0]", lambda s: abs(s.camera.sensor.layout.centroid_um.mean(0) - [5, -3]).max() < 1),
        ("layout.mosaic=[RG, GB]; sensor.filters=rgb", lambda s: s.camera.sensor.n_filters == 3),
        (
            "layout.mosaic=[GR, RG]; sensor.filters={curves: [{kind: gaussian, centre_nm: 550, fwhm_nm: 90}, {kind: constant, value: 0.5}]}",
            lambda s: s.camera.sensor.filter_names == ("0", "1"),
        ),
        (
            "sensor.filters={curves: [{kind: constant, value: 0.5}], names: [a=b]}",
            lambda s: s.camera.sensor.filter_names == ("a=b",),
        ),
        ("exposure_s=0.5", lambda s: s.exposure_s == 0.5),
    ],
)
def test_change_replaces_one_setting(shot_file, change, value):
    assert value(read_shot(shot_file, change.split("; ")))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("sensor.bitz=3", r"sensor\.bitz: unknown (key|parameter)"),
        ("colour=red", r"colour: unknown (key|parameter)"),
        ("layout.parameters.rings=3", r"layout\.parameters\.rings: unknown (key|parameter)"),
        ("sensor.bits=ten", r'sensor\.bits: must be a valid integer, got "ten"'),
        ("sensor.bits=true", r"sensor\.bits: must be a valid integer, got true"),
        ("sensor.bits=17", r"sensor\.bits: must be <= 16, got 17"),
        ("optics.f_number=-1", r"optics\.f_number: must be > 0, got -1"),
        ("optics.f_number=.nan", r"optics\.f_number: must be finite"),
        (
            "optics.padding=mirror",
            r"optics\.padding: must be one of 'reflect', 'edge', 'zero', 'periodic', got \"mirror\"",
        ),
        ("optics=3", r"optics: must be an object, got 3"),
        ("layout.generator=spiral", r"layout\.generator: must be one of .*'grid', .*, got 'spiral'"),
        ("layout.parameters.pitch_um=0", r"layout\.parameters\.pitch_um: must be > 0, got 0"),
        (
            "layout={}",
            r"layout: requires the key 'generator' or 'file'; a layout can also be the name of a bundled one",
        ),
        ("layout={file_: a.gds}", r"layout: requires the key 'generator' or 'file', got 'file_'"),
        ("layout.mosaic=bayr", r"layout\.mosaic\.block: must be one of 'bayer', .*; did you mean 'bayer'"),
        ("layout=other.yaml", r"other\.yaml: no such file"),
        ("scene.kind=foto", r"scene\.kind: must be one of 'picture', .*'siemens_star', .*got 'foto'"),
        ("scene.distance_m=0.001", r"scene\.distance_m: must be larger than the focal length"),
        ("scene.shape=[40]", r"scene\.shape\.1: missing"),
        ("sensor.qe={kind: silicon}", r"sensor\.qe\.depth_um: missing"),
        ("sensor.qe={kind: silicon, depth_um: -3}", r"sensor\.qe\.depth_um: must be > 0, got -3"),
        ("sensor.qe=2", r"sensor\.qe: must be <= 1, got 2"),
        (
            "sensor.read_noise_e=[1.0, 2.0]",
            r"sensor\.read_noise_e: must be one number, or one for each of the 120 sites",
        ),
        ("exposure_s=-1", r"exposure_s: must be >= 0, got -1"),
        (
            "exposure_s=1/0",
            r"exposure_s: must be a time in seconds, a fraction such as '1/50', 'auto', or .*, got \"1/0\"",
        ),
        (
            "exposure_s=autom",
            r"exposure_s: must be a time in seconds, a fraction such as '1/50', 'auto', or .*, got \"autom\"",
        ),
        ("seed=-1", r"seed: must be >= 0, got -1"),
        ("seed=1.5", r"seed: must be a valid integer, got 1.5"),
        ("seed", r"a change must be 'key=value'"),
        ("seed.x=3", r"'seed\.x=3' cannot be set: seed must be a section, got 7"),
        ("sensor.bits=[1", r"is not YAML"),
        ("seed=2026-01-01", r'seed: must be a valid integer, got "2026-01-01"'),
        ("optics.pupil={kind: star}", r"optics\.pupil"),
        ("optics.pupil={kind: annulus, obscuration: 2}", r"optics\.pupil\.obscuration: must be <= 0\.999, got 2"),
        ("optics.pupil=[{kind: slit, width_fraction: 0}]", r"optics\.pupil\[0\]\.width_fraction: must be > 0"),
        ("optics.pupil={kind: image, picture: no.png}", r"no\.png: no such file"),
        ("optics.zernike={coefficients: {0: 0.1}}", r"optics\.zernike\.coefficients: has an index that must be >= 1"),
        ("optics.zernike={coefficients: {coma: 0.1}}", r"optics\.zernike\.coefficients"),
        ("optics.zernike={coefficients: {4: 500}}", r"optics\.aberrations: must blur a point by at most 128 λN"),
        ("optics.focus_distance_m=0.001", r"optics\.focus_distance_m: must be larger than the focal length"),
    ],
)
def test_invalid_setting_is_reported_with_key(shot_file, change, message):
    with pytest.raises(ConfigError, match=message) as caught:
        read_shot(shot_file, [change])

    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(shot_file.parent))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("scene.pitch_um=abc", r'scene\.pitch_um: must be a valid number, got "abc"'),
        ("scene.pitchum=3", r"scene\.pitchum: unknown (key|parameter)"),
        ("scene.wavelength_nm=[550, x]", r'scene\.wavelength_nm\.1: must be a valid number, got "x"'),
        ("scene.encoding=gamma", r"scene\.encoding: must be one of 'auto', 'srgb', 'sqrt', 'linear', got \"gamma\""),
        ("scene.band_width_nm=[1.0, x]", r'scene\.band_width_nm\.1: must be a valid number, got "x"'),
        ("scene.picture=3", r"scene\.picture: must be a valid string, got 3"),
        (
            "scene={kind: picture, picture: a.png}",
            r"scene\.distance_m: missing",
        ),
        (
            "scene={kind: point_sources, shape: [4, 5], pixels: [[1, 2, 3]]}",
            r"scene\.pixels\.0: must have at most 2 items, not 3",
        ),
        ("scene.peak_radiance_w_m2_sr_nm=-1", r"scene\.peak_radiance_w_m2_sr_nm: must be >= 0, got -1"),
    ],
)
def test_invalid_picture_setting_is_reported_with_key(shot_file, change, message):
    scene = {
        "kind": "picture",
        "picture": "skimage:camera",
        "pitch_um": 400.0,
        "distance_m": 1.0,
        "band_width_nm": 10.0,
    }
    scene["peak_radiance_w_m2_sr_nm"] = 0.1
    shot_file.write_text(yaml.safe_dump({**yaml.safe_load(SHOT.replace("1e-15", "1.0e-15")), "scene": scene}))

    with pytest.raises(ConfigError, match=message):
        read_shot(shot_file, [change])


def test_changes_resolve_paths_in_working_directory(shot_file, tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    layout = "generator: grid\nparameters: {n_x: 3, n_y: 2, pitch_um: 5.0}\nrules: {min_size_um: 6.0}\nsource: a test\n"
    (tmp_path / "elsewhere" / "six.yaml").write_text(layout)

    shot = read_shot(shot_file, ["layout=six.yaml"])

    assert shot.camera.sensor.layout.n_sites == 6
    assert shot.rules == fs.DesignRules(min_size_um=6.0)


def test_power_map_file_is_captured(shot_file, tmp_path, monkeypatch):
    light = np.random.default_rng(4).random((2, 120, 130))
    np.save(tmp_path / "light.npy", light)
    tells = "pitch_um: 1.0, wavelength_nm: [500, 600], unit: w_m2"
    monkeypatch.chdir(tmp_path)

    shot = read_shot(shot_file, [f"scene={{kind: power_map, path: light.npy, {tells}}}", "integration_order=2"])

    assert np.array_equal(shot.scene.data, light)
    assert shot.scene.grid == fs.Grid.centred((120, 130), 1.0)
    assert shot.camera.order(shot.scene) == 2
    assert shot.camera.capture(shot.scene, exposure_s=0.01, seed=1).settings["integration_order"] == 2
    for change, message in (
        ("scene={kind: power_map, path: light.npy}", r"light\.npy: .*pitch_um"),
        (f"scene={{kind: power_map, path: no.npy, {tells}}}", r"no\.npy: no such file"),
        (f"scene={{kind: power_map, path: light.npy, {tells}, unit: lux}}", "duplicate key"),
        ("integration_order=3", "integration_order: must be"),
    ):
        with pytest.raises(FileError, match=message):
            read_shot(shot_file, [change])


def test_wavelengths_outside_tables_are_rejected_early(shot_file):
    with pytest.raises(
        ConfigError, match=r"scene\.wavelength_nm: must be within the absorption table of silicon.*1500.0 nm"
    ):
        read_shot(shot_file, ["sensor.qe={kind: silicon, depth_um: 3}", "scene.wavelength_nm=[1500]"])


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must contain settings as 'key: value', got nothing"),
        ("just words", "must contain settings as 'key: value', got 'just words'"),
        ("- a\n- b\n", "must contain settings as 'key: value', got"),
        ("scene: {kind: flat\noptics: 3", ":2:7: is not YAML"),
        ("a: 1\na: 2\n", r":2:1: .*duplicate key 'a'"),
        ("1.5: 2\n", r":1:1: .*the key 1.5 must be a string or an integer"),
        ("yes: 2\n", r":1:1: .*the key True must be a string or an integer"),
        ("1: 2\n'1': 3\n", r":2:1: .*duplicate key '1'"),
        ("a: &x [1]\nb: *x\n", r":1:4: .*anchors and aliases are not allowed"),
        ("a: !!python/object/apply:os.system [ls]\n", ":1:4: is not YAML: could not determine a constructor"),
        ("a: !!set {b}\n", "a: must be a number, string, list or section, got "),
        ("a: !!binary aGk=\n", "a: must be a number, string, list or section, got b'hi'"),
        ("[" * 5000 + "]" * 5000, "is nested too deeply|must contain settings"),
        ("a: " + "{b: " * 3000 + "1" + "}" * 3000, "is nested too deeply|unknown (key|parameter)|cannot be read"),
        ("exposure_s: 1.0", r"scene: missing; optics: missing; layout: missing"),
        ("a: 1\nb: 2\nc: 3\nd: 4\n", "; and 5 more"),
    ],
)
def test_other_files_are_rejected(tmp_path, text, message):
    path = tmp_path / "bad.yaml"
    path.write_text(text)

    with pytest.raises(ConfigError, match=message) as caught:
        read_shot(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"\xff\xfe\x00", "is not a UTF-8 text file"), (b"a: 1 # " + b"x" * (1 << 20), "is larger than 1048576 bytes")],
)
def test_binary_file_is_rejected(tmp_path, content, message):
    path = tmp_path / "bad.yaml"
    path.write_bytes(content)

    with pytest.raises(ConfigError, match=message):
        read_shot(path)


@pytest.mark.parametrize(("name", "message"), [("none.yaml", "no such file"), (".", "is not a file")])
def test_missing_file_is_rejected(tmp_path, name, message):
    with pytest.raises(ConfigError, match=message):
        read_shot(tmp_path / name)


def test_pictures_resolve_to_files_and_bundled(shot_file):
    picture = {"kind": "picture", "picture": "mine.png", "pitch_um": 400.0, "distance_m": 1.0, "band_width_nm": 10.0}
    picture["peak_radiance_w_m2_sr_nm"] = 0.1
    data = {**yaml.safe_load(SHOT.replace("1e-15", "1.0e-15")), "scene": picture}
    shot_file.write_text(yaml.safe_dump(data))

    with pytest.raises(FileError, match=r"mine\.png: no such file"):
        read_shot(shot_file)
    with pytest.raises(ConfigError, match="scikit-image does not contain 'mona_lisa'; possible: 'astronaut', "):
        read_shot(shot_file, ["scene.picture='skimage:mona_lisa'"])
    assert read_shot(shot_file, ["scene.picture='skimage:camera'"]).scene.basis.shape == (1, 512, 512)


PICTURE = """
scene: {kind: picture, picture: 'skimage:camera', fit: cover, distance_m: 1.0, peak_radiance_w_m2_sr_nm: 0.1, band_width_nm: 100}
"""


def test_framing_follows_settings(shot_file):
    shot_file.write_text(PICTURE + SHOT.split("\n", 2)[2])
    for changes in ([], ["optics.focal_length_mm=16"], ["layout.parameters.pitch_um=16"]):
        shot = read_shot(shot_file, changes)
        layout = shot.camera.sensor.layout
        half_um = max(np.abs(layout.bounds_um))
        assert shot.scene.pitch_um is None
        assert shot.camera.image_grid(shot.scene).bounds_um == pytest.approx([-half_um, -half_um, half_um, half_um])
    view = read_shot(shot_file, ["scene.fit=null", "scene.field_of_view_deg=30"])
    assert view.scene.pitch_um == pytest.approx(2e6 * np.tan(np.deg2rad(15.0)) / 512)
    assert read_shot(shot_file, ["scene.fit=null", "scene.pitch_um=70"]).scene.pitch_um == 70.0


def test_last_framing_replaces_others(shot_file):
    shot_file.write_text(PICTURE + SHOT.split("\n", 2)[2])
    pitch, angle = "scene.pitch_um=70", "scene.field_of_view_deg=30"
    assert read_shot(shot_file, [pitch]).scene.pitch_um == 70.0
    assert read_shot(shot_file, [angle, pitch]).scene.field_of_view_deg is None
    assert read_shot(shot_file, [pitch, angle]).scene.field_of_view_deg == 30.0
    assert read_shot(shot_file, [pitch, "scene.fit=width"]).scene.fit == "width"
    assert read_shot(shot_file, ["scene.pitch_um=null"]).scene.fit == "cover"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("scene.fit=crop", r"shot\.yaml: --set scene\.fit: must be one of 'cover', 'contain', 'width', got \"crop\"$"),
        (
            (
                "scene={kind: picture, picture: 'skimage:camera', fit: cover, pitch_um: 70, distance_m: 1.0, "
                "peak_radiance_w_m2_sr_nm: 0.1, band_width_nm: 100}"
            ),
            r"shot\.yaml: --set scene\.fit: must not be given together with 'pitch_um', got 'cover'; choose one of .* to null$",
        ),
        (
            "distortion={kind: brown_conrady, focal_um: 8000}; layout.move_um=[900, 0]; scene.fit=contain",
            r"scene\.fit: must not be 'contain' with the optical axis, at \(0, 0\)",
        ),
        ("scene.field_of_view_deg=200; scene.fit=null", r"scene\.field_of_view_deg: must be < 180, got 200\.0 degrees"),
    ],
)
def test_invalid_framing_names_its_key(shot_file, change, message):
    shot_file.write_text(PICTURE + SHOT.split("\n", 2)[2])
    with pytest.raises(ConfigError, match=message):
        read_shot(shot_file, change.split("; "))


@cache
def validator_of(kind, version):
    """Return the validator of a kind of file with the design rules of a version of their registry."""
    return pytest.importorskip("jsonschema").Draft202012Validator(schema(kind))


def errors_of(kind, data):
    """Return the errors of plain data by the JSON schema of a kind of file."""
    return [error.message for error in validator_of(kind, fs.layout.RULES.version).iter_errors(data)]


@pytest.mark.parametrize("name", sorted(bundled_layouts()))
def test_bundled_layout_satisfies_schema(name):
    data = read_yaml(bundled_layouts()[name])

    assert errors_of("layout", data) == []
    assert errors_of("rules", data.get("rules", {})) == []
    assert errors_of("layout", data | {"mosiac": "bayer"}) != []
    assert errors_of("layout", data | {"parameters": data["parameters"] | {"sectors": 3}}) != []
    assert errors_of("layout", data | {"rules": {"min_sise_um": 1.0}}) != []


@pytest.mark.parametrize(
    ("data", "is_valid"),
    [
        ({"preset": "sky130_met1"}, True),
        ({"preset": "sky130"}, False),
        ({"min_size_um": 2, "waivers": {"min_size_um": "prototype"}}, True),
        ({"waivers": {"min_sise_um": "prototype"}}, False),
        ({"readout": {"frames_per_s": 30.0, "bits": 10}, "max_data_rate_gbit_per_s": 1.0}, True),
        ({"readout": {"frames_per_second": 30.0}}, False),
        ({"min_size_um": "2 µm"}, False),
        ({"custom": {"min_round": 0.5}}, False),
    ],
)
def test_schema_of_rules_knows_names(data, is_valid):
    assert (errors_of("rules", data) == []) == is_valid


def test_registered_rule_is_in_schema():
    with restored(fs.layout.RULES):
        fs.layout.RULES.register("min_round", fs.layout.Rule("roundness", "", lambda case: case.layout.area_um2))
        assert errors_of("rules", {"custom": {"min_round": 0.5}}) == []
    assert errors_of("rules", {"custom": {"min_round": 0.5}}) != []


def test_schema_contains_parameters_of_calls():
    text = json.dumps(schema())

    for name in (
        "peak_radiance_w_m2_sr_nm",
        "focal_length_mm",
        "min_size_um",
        "orientation",
        "depth_um",
        "per_um2",
        "die_um",
    ):
        assert f'"{name}"' in text
    assert schema()["title"] == "foveasim settings"
    assert "Minimum site size that can be manufactured" in text
    assert schema()["required"] == ["scene", "optics", "exposure_s"]
    assert schema()["anyOf"][0] == {"required": ["layout"]}  # or the twin of a camera


#: Sites of the layouts that come with the package.
SHIPPED = {
    "bayer_grid": 320 * 240,
    "four_zones": 13_312,
    "foveal_blind_spot": 14_208,
    "giotto_1": 56 * 128 + 1 + 6 * (19 * 20 // 2),
    "giotto_2": 5_167 + 27_720,
    "ibidem": 64 * 128,
    "log_polar_ccd": 30 * 64,
    "pixirad_1": 476 * 512,
    "prima_100": 378,
    "prima_75": 142,
    "quad_bayer": 128 * 128,
    "spectral_16": 128 * 96,
    "square_grid": 119 * 119,
    "x_trans": 144 * 96,
}


def test_all_bundled_layouts_are_listed():
    assert list(bundled_layouts()) == sorted(SHIPPED)


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("name", SHIPPED)
def test_bundled_layout_satisfies_its_rules(name, tmp_path):
    file = read_any_layout(name)
    ax = plot_layout(file.layout, figure_inches=2.0)
    save_figure(ax.figure, tmp_path / "layout.png", dpi=50)

    assert file.layout.n_sites == SHIPPED[name]
    assert file.rules is not None
    assert file.layout.check(file.rules).ok
    assert len(file.source) > 20
    assert read_picture(tmp_path / "layout.png").std() > 5


@pytest.mark.parametrize(
    ("name", "fill"), [("prima_100", 0.7225), ("prima_75", 0.8711), ("quad_bayer", (0.6 / 0.7) ** 2)]
)
def test_bundled_arrays_have_published_fill_factors(name, fill):
    file = read_any_layout(name)
    pitch_um = float(np.hypot(*np.diff(file.layout.centroid_um[:2], axis=0).T)[0])
    cell_um2 = pitch_um**2 * (1.0 if name == "quad_bayer" else 0.5 * np.sqrt(3.0))

    assert file.layout.area_um2[0] / cell_um2 == pytest.approx(fill, abs=1e-4)


def test_layout_file_precedes_bundled_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0).write("layout.npz")
    (tmp_path / "layout.npz").rename(tmp_path / "giotto_2")

    assert read_any_layout("giotto_2").layout.n_sites == 2
    with pytest.raises(FileError, match="giotto_3"):
        read_any_layout("giotto_3")


@pytest.fixture
def picture_file(tmp_path):
    """Write a grey picture of 64 x 32 pixels with a white square in its upper left corner."""
    picture = np.full((32, 64), 10, np.uint8)
    picture[:8, :8] = 255
    write_picture(tmp_path / "where.png", picture)
    return tmp_path / "where.png"


def test_quadtree_follows_importance_picture(tmp_path, picture_file):
    path = tmp_path / "tree.yaml"
    path.write_text(
        "generator: quadtree\n"
        f"parameters: {{importance: {picture_file.name}, pitch_um: 2.0, limit: 0.5, n_levels: 4, measure: peak}}\n"
    )
    layout = read_layout_file(path).layout
    is_fine = layout.area_um2 == 4.0

    assert layout.area_um2.sum() == 64 * 32 * 4.0
    assert (layout.centroid_um[is_fine, 0] < -40).all()
    assert (layout.centroid_um[is_fine, 1] > 10).all()
    assert is_fine.sum() >= 64


def test_site_density_follows_picture(tmp_path, picture_file):
    path = tmp_path / "cells.yaml"
    path.write_text(
        "generator: voronoi\n"
        f"parameters: {{n_sites: 300, density: {picture_file.name}, size_um: [128.0, 64.0], n_iterations: 3, seed: 4}}\n"
        "inset_um: 0.1\nsnap_um: 0.005\n"
    )
    layout = read_layout_file(path).layout
    is_bright = (layout.centroid_um[:, 0] < -48) & (layout.centroid_um[:, 1] > 16)

    # 64 pixels of 255 and 1,984 of 10.
    assert is_bright.mean() == pytest.approx(64 * 255 / (64 * 255 + 1984 * 10), abs=0.08)
    assert layout.check(fs.DesignRules(grid_um=0.005)).ok
    assert layout.adjacency().nnz == 0


@pytest.mark.usefixtures("picture_file")
@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (
            "{n_sites: 9, density: where.png}",
            "parameters.density: requires 'size_um', the rectangle that the picture covers",
        ),
        (
            "{n_sites: 9, density: where.png, size_um: [9.0, 9.0]}",
            "density: must have the aspect ratio of 'size_um', 9 x 9 µm, got 64 x 32 pixels",
        ),
        ("{n_sites: 9, density: gone.png, size_um: [9.0, 9.0]}", "gone.png: no such file"),
        (
            "{n_sites: 9, density: 'skimage:gone', size_um: [9.0, 9.0]}",
            "parameters.density: scikit-image does not contain",
        ),
        ("{n_sites: 9, size_um: [9.0, 9.0], density_grid: 3}", "parameters.density_grid: unknown (key|parameter)"),
        ("{n_sites: 9, region: POLYGON}", "'region' must be a shapely Polygon|region"),
    ],
)
def test_invalid_densities_are_reported_with_key(tmp_path, parameters, message):
    path = tmp_path / "cells.yaml"
    path.write_text(f"generator: voronoi\nparameters: {parameters}\n")

    with pytest.raises((ConfigError, FileError), match=message):
        read_layout_file(path)


def test_regions_are_vertices_or_wkt(tmp_path):
    path = tmp_path / "zones.yaml"
    path.write_text(
        "generator: zones\n"
        "parameters:\n"
        "  pitch_um: [1.0, 2.0]\n"
        "  outlines_um: [[[0.0, 0.0], [8.0, 0.0], [0.0, 8.0]], 'POLYGON ((-9 -9, 19 -9, -9 19, -9 -9))']\n"
    )
    layout = read_layout_file(path).layout

    assert layout.area_um2.sum() == pytest.approx(0.5 * 28**2)
    assert layout.area_um2[layout.columns["zone"] == 0].sum() == pytest.approx(32.0)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    "path", [*sorted((REPOSITORY / "gallery").glob("*.yaml")), *demo_settings()], ids=lambda p: p.stem
)
def test_bundled_shots_can_be_built(path):
    shot = read_shot(path)

    assert shot.camera.sensor.layout.n_sites > 100
    assert shot.exposure_s > 0


def test_layout_file_equals_call(tmp_path):
    path = tmp_path / "rings.yaml"
    path.write_text(
        "generator: log_polar\nparameters: {n_sectors: 32, min_size_um: 2, r_max_um: 45, stagger: true}\n"
        "mosaic: [RG, GB]\nmove_um: [1.0, 2.0]\nrules: {min_width_um: 1.5}\nsource: made up for this test\n"
    )
    file = read_layout_file(path)
    expected = fs.layout.log_polar(n_sectors=32, min_size_um=2.0, r_max_um=45.0, stagger=True).translate(1.0, 2.0)

    assert np.array_equal(file.layout.xy_um, expected.xy_um)
    assert file.rules == fs.DesignRules(min_width_um=1.5)
    assert file.layout.channel.tolist() == fs.layout.mosaic(expected, ("RG", "GB")).channel.tolist()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("generator: spiral\nparameters: {}\n", r"bad.yaml:1:1: generator: must be one of .*got 'spiral'"),
        ("generator: grid\n", r"parameters: missing"),
        ("generator: grid\nparameters: {n_x: 3, n_y: 0, pitch_um: 1}\n", r"parameters\.n_y: must be >= 1, got 0"),
        (
            "generator: grid\nparameters: {n_x: 3, n_y: 3, pitch_um: 1}\nrules: {min_width_um: -1}\n",
            r"rules\.min_width_um: must be >= 0",
        ),
    ],
)
def test_invalid_layout_file_is_reported_with_key(tmp_path, text, message):
    path = tmp_path / "bad.yaml"
    path.write_text(text)

    with pytest.raises(ConfigError, match=message):
        read_layout_file(path)


@pytest.mark.parametrize("character", ["\x00", "\x08", "\x95"])
def test_forbidden_yaml_character_prints_one_line(tmp_path, character):
    path = tmp_path / "layout.yaml"
    path.write_text(f"generator: gr{character}id\n", encoding="utf-8")

    with pytest.raises(ConfigError, match="special characters are not allowed") as caught:
        read_layout_file(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", sorted(p.name for p in (REPOSITORY / "gallery").glob("*.yaml")))
def test_gallery_shots_can_be_built(name):
    shot = read_shot(REPOSITORY / "gallery" / name)

    assert shot.name == name.removesuffix(".yaml")
    assert shot.camera.sensor.layout.n_sites > 1000


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"optics": {"zernike": {"coefficients": {4: 0.1, "4": 0.2}}}},
            "optics.zernike.coefficients.4: must be given once",
        ),
        ({"sensor": {"qe": {1, 2}}}, "sensor.qe: must be a number, string, list or section, got {1, 2}"),
        (
            {"sensor": {"qe": [0.5, object]}},
            "sensor.qe.1: must be a number, string, list or section, got <class 'object'>",
        ),
        ({"optics": {("a", 1): 3}}, "optics: must have strings or integers as keys, got ('a', 1)"),
        ({"optics": {True: 3}}, "optics: must have strings or integers as keys, got True"),
    ],
)
def test_settings_from_python_are_plain_data(settings, message):
    with pytest.raises(ConfigError) as caught:
        fs.config.check_settings(None, settings)

    assert str(caught.value).startswith(message)


def test_plain_settings_equal_those_of_files():
    found = fs.config.plain_settings(
        None, {4: (1, 2.5), np.int64(7): np.arange(3), "path": Path("a/b"), "x": {"y": np.float32(0.5), "z": None}}
    )

    assert json.loads(json.dumps(found)) == found
    assert found == {"4": [1, 2.5], "7": [0, 1, 2], "path": "a/b", "x": {"y": 0.5, "z": None}}


# -- presets of electronics ----------------------------------------------------------------------------------------------


def preset_settings(**sensor):
    return read_settings(demo_settings()[1]) | {"sensor": sensor}


def test_presets_of_files_equal_those_of_python():
    shot = build_shot(None, preset_settings(preset="scientific", bits=12))
    expected = fs.Sensor.from_preset(shot.camera.layout, "scientific", bits=12)

    for name in ("bits", "cds", "read_noise_e", "v_sat_v", "full_well_e", "dark_e_per_s"):
        assert getattr(shot.camera.sensor, name) == getattr(expected, name)
    assert np.array_equal(shot.camera.sensor.capacitance_f, expected.capacitance_f)


def test_unknown_preset_lists_those_that_exist():
    with pytest.raises(ConfigError, match=r"sensor\.preset: must be one of 'mobile', .* got \"machine\"; did you mean"):
        build_shot(None, preset_settings(preset="machine"))


def test_preset_in_python_has_its_values():
    source = to_python(preset_settings(preset="mobile"))

    assert 'fs.Sensor.from_preset(layout, "mobile")' in source

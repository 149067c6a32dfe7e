"""Sensors of twins where other sensors work: settings, captures, tiles, videos, sweeps, comparisons and data sets."""

import copy
import json
import pickle
import zipfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

import foveasim as fs
from foveasim import tiles
from foveasim.cli import app
from foveasim.config import build_shot, put_setting, read_settings, read_shot, schema, to_python
from foveasim.errors import ConfigError, FileError, ParameterError
from foveasim.sensor.blocks import BLOCK_SITES

N_Y, N_X, PITCH_UM = 40, 48, 3.0
GAIN, NOISE_E, ROW_E, BLACK_DN, WELL_E, DARK_E_PER_S = 0.4, 4.0, 2.0, 60.0, 8000.0, 100.0
EXPOSURE_S = 0.01


@pytest.fixture(scope="module")
def camera_pixels():
    """Numbers of a camera with strong patterns, first row at the top: responses, offsets in e-, dark current in e-/s."""
    rng = np.random.default_rng(11)
    response, offset_e = 1.0 + 0.08 * rng.normal(size=(N_Y, N_X)), 15.0 * rng.normal(size=(N_Y, N_X))
    return response, offset_e, DARK_E_PER_S * rng.lognormal(-0.08, 0.4, (N_Y, N_X))


def frames_of(camera_pixels, signal_e, exposure_s, n, seed, colour=1.0):
    """Frames of Poisson and Gaussian numbers, without the package."""
    response, offset_e, dark = camera_pixels
    rng = np.random.default_rng(seed)
    charge = np.minimum(rng.poisson(signal_e * colour * response + dark * exposure_s, (n, N_Y, N_X)), WELL_E)
    noise = rng.normal(0.0, NOISE_E, charge.shape) + rng.normal(0.0, ROW_E, (n, N_Y, 1))
    return np.clip(np.rint(GAIN * (charge + offset_e + noise) + BLACK_DN), 0, 4095).astype(np.uint16)


def fitted(camera_pixels, *, colour=1.0, efficiency=None, **options):
    """Fit a twin; with an efficiency, a photometer counted the photons."""
    stacks = [
        fs.twin.Stack(frames_of(camera_pixels, 0.0, time_s, 32, seed), time_s, light=0)
        for seed, time_s in enumerate((1e-3, 0.5, 1.0))
    ]
    stacks += [
        fs.twin.Stack(
            frames_of(camera_pixels, 950.0 * k, 0.01 * k, 16, 9 + k, colour),
            0.01 * k,
            **({"light": 1} if efficiency is None else {"photons": 950.0 * k / efficiency}),
        )
        for k in range(1, 11)
    ]
    return fs.twin.fit(stacks, bits=12, pixel_um=PITCH_UM, **options)


@pytest.fixture(scope="module")
def twin(camera_pixels):
    return fitted(camera_pixels)


@pytest.fixture
def path(twin, tmp_path):
    twin.save(tmp_path / "twin.npz")
    return tmp_path / "twin.npz"


OPTICS = fs.Optics(focal_length_mm=8.0, f_number=4.0)
SCENE = {"kind": "flat", "shape": [80, 80], "pitch_um": 400.0, "distance_m": 1.0, "radiance_w_m2_sr_nm": 0.02,
         "band_width_nm": 10.0}  # fmt: skip
SETTINGS = {"scene": SCENE, "optics": {"focal_length_mm": 8.0, "f_number": 4.0}, "exposure_s": EXPOSURE_S, "seed": 3}
GRID = {"generator": "grid", "parameters": {"n_x": N_X, "n_y": N_Y, "pitch_um": PITCH_UM}}
FOVEAL = {
    "generator": "log_polar",
    "parameters": {"n_sectors": 24, "r_min_um": 12.0, "r_max_um": 60.0, "min_size_um": 3.0},
}


def flat():
    return fs.Scene.flat(**{name: value for name, value in SCENE.items() if name != "kind"})


def camera_of(sensor, **options):
    return fs.Camera(optics=OPTICS, sensor=sensor, **options)


def settings_of(layout=None, **sensor):
    found = copy.deepcopy({**SETTINGS, "sensor": {"twin": "twin.npz", **sensor}})
    return found if layout is None else {**found, "layout": copy.deepcopy(layout)}


def shot_of(tmp_path, layout=None, **sensor):
    file = tmp_path / "shot.yaml"
    file.write_text(yaml.safe_dump(settings_of(layout, **sensor), sort_keys=False))
    return file


def codes_of(sensor, seed=3, **options):
    return camera_of(sensor, **options).capture(flat(), exposure_s=EXPOSURE_S, seed=seed).code


# -- settings ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("changes", [{}, {"bits": 10}, {"read_noise_e": 1.0}, {"prnu_fraction": 0.01}, {"qe": 0.5}])
@pytest.mark.parametrize("layout", [None, GRID, FOVEAL])
def test_settings_give_frames_of_python(twin, path, tmp_path, layout, changes):
    shot = read_shot(shot_of(tmp_path, layout, **changes))
    layouts = {} if layout is None else {"layout": shot.camera.layout}
    expected = fs.twin.read_twin(path).sensor(**layouts, **changes)
    capture = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)

    np.testing.assert_array_equal(capture.code, codes_of(expected))
    assert 60.0 < capture.code.mean() < 4000.0


def test_source_of_settings_gives_same_codes(path, tmp_path):
    for layout in (None, FOVEAL):
        file = shot_of(tmp_path, layout, bits=10)
        text = to_python(read_settings(file), source=file)
        found = {}
        exec(text, found)
        shot = read_shot(file)

        assert "fs.twin.read_twin(" in text
        codes = shot.camera.capture(shot.scene, exposure_s=shot.exposure_s, seed=shot.seed).code
        np.testing.assert_array_equal(found["capture"].code, codes)


def test_wrong_twins_of_settings_are_one_sentence(path, tmp_path):
    file = shot_of(tmp_path, preset="mobile")
    with pytest.raises(ConfigError, match=r"shot.yaml:\d+:3: sensor\.twin: must not be given together with 'preset'"):
        read_shot(file)
    file = shot_of(tmp_path, preset="mobile", datasheet="x.yaml")
    with pytest.raises(ConfigError, match=r"sensor\.twin: must not be given together with 'preset' and 'datasheet'"):
        read_shot(file)
    file = shot_of(tmp_path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(
        ConfigError, match=r"shot.yaml:\d+:3: sensor\.twin: .*twin.npz: is corrupt or not a valid foveasim twin"
    ):
        read_shot(file)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(ConfigError, match=r"sensor\.twin: .*twin.npz: is not a valid foveasim twin"):
        read_shot(file)
    fs.layout.grid(n_x=2, n_y=2, pitch_um=3.0).write(path)
    with pytest.raises(ConfigError, match=r"sensor\.twin: .*twin.npz: is not a valid foveasim twin"):
        read_shot(file)
    path.unlink()
    with pytest.raises(ConfigError, match=r"shot.yaml:\d+:3: sensor\.twin: .*twin.npz: no such file"):
        read_shot(file)
    with pytest.raises(ConfigError, match=r"^layout: missing"):
        build_shot(None, {**SETTINGS, "sensor": {"bits": 10}})


@pytest.mark.parametrize(
    "change",
    [
        {"known": {"bits": 12, "device_seed": 3}},
        {"known": {"bits": 99}},
        {"known": {"bits": 12, "mosaic": "XXXX"}},
        {"pixel_um": -1.0},
        {"estimates": {"gain_dn_per_e": [float("nan"), 0.0, 1.0]}},
        {"estimates": 3},
    ],
)
def test_forged_twins_are_rejected(path, change):
    """The metadata of an untrusted file are checked, also those that would become parameters of a sensor."""
    with np.load(path) as archive:
        members = dict(archive)
    about = json.loads(str(members.pop("about")))
    np.savez(path, about=np.array(json.dumps({**about, **change})), **members)

    with pytest.raises(FileError, match=r"twin\.npz: "):
        fs.twin.read_twin(path)


def test_pickled_objects_are_never_read(path):
    """An array of Python objects is rejected before it is read."""
    with zipfile.ZipFile(path, "a") as archive, archive.open("noise.npy", "w") as file:
        np.save(file, np.array([{}], object), allow_pickle=True)

    with pytest.raises(FileError, match="Python objects"):
        fs.twin.read_twin(path)
    with np.load(path, allow_pickle=False) as archive:
        members = {name: archive[name] for name in archive.files if name != "noise"}
    for wrong in (
        {"offset_e": np.zeros((2, 3))},
        {"offset_e": np.full((N_Y, N_X), np.nan)},
        {"other": np.zeros((N_Y, N_X))},
    ):
        np.savez(path, **{**members, **wrong})
        with pytest.raises(FileError, match="maps must be"):
            fs.twin.read_twin(path)


def test_schema_accepts_twins_instead_of_layouts(path, tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft202012Validator(schema())

    assert validator.is_valid(settings_of())
    assert validator.is_valid(settings_of(GRID))
    assert not validator.is_valid({**SETTINGS, "sensor": {"bits": 10}})


def test_twin_replaces_other_origins(path):
    settings = settings_of()
    put_setting(None, settings, "sensor.preset", "mobile")
    assert settings["sensor"] == {"preset": "mobile"}
    put_setting(None, settings, "sensor.twin", "twin.npz")
    assert settings["sensor"] == {"twin": "twin.npz"}


# -- maps or statistics ----------------------------------------------------------------------------------------------------


def test_pixels_of_the_camera_have_their_maps(twin, camera_pixels, tmp_path):
    """Displaced, in another order, and read from a chip file: the numbers of the draw, at the place of each site."""
    pytest.importorskip("gdstk")
    own = twin.layout()
    response = camera_pixels[0]
    shuffled = own[np.random.default_rng(0).permutation(own.n_sites)]
    own.write(tmp_path / "chip.gds")
    chip = fs.layout.read_layout(tmp_path / "chip.gds")
    for layout in (own, own.translate(dx_um=7.3, dy_um=-2.0), shuffled, chip):
        found = twin.sensor(layout)
        x, y = (layout.centroid_um - layout.centroid_um.mean(axis=0)).T / PITCH_UM
        expected = response[np.rint((N_Y - 1) / 2 - y).astype(int), np.rint(x + (N_X - 1) / 2).astype(int)]
        assert np.corrcoef(found.pattern("response_map"), expected)[0, 1] > 0.99


def test_other_photosites_have_statistics(twin, camera_pixels):
    for layout in (
        fs.layout.grid(n_x=N_X - 2, n_y=N_Y - 2, pitch_um=PITCH_UM),
        fs.layout.grid(n_x=N_X, n_y=N_Y, pitch_um=1.1 * PITCH_UM),
        fs.layout.hexagonal(n_columns=N_X, n_rows=N_Y, pitch_um=PITCH_UM),
    ):
        sensor = twin.sensor(layout)
        names = {effect.name for effect in sensor.chain}
        assert names.isdisjoint({"response_map", "offset_map"})
        assert sensor.pattern("prnu").std() == pytest.approx(0.08, rel=0.1)
        assert sensor.pattern("dark_offset" if "dark_offset" in names else "dsnu_offset").std() == pytest.approx(
            15.0, rel=0.1
        )
        assert any("random, with the statistics" in text for text in sensor.provenance["assumptions"])
        with pytest.raises(ParameterError, match="'maps' must be False for other photosites than the pixels"):
            twin.sensor(layout, maps=True)


def test_another_device_of_the_kind(twin):
    one, other = (twin.sensor(maps=False, device_seed=seed) for seed in (1, 2))

    assert one.pattern("prnu").std() == pytest.approx(twin.sensor().pattern("response_map").std(), rel=0.1)
    assert abs(np.corrcoef(one.pattern("prnu"), other.pattern("prnu"))[0, 1]) < 0.1


def test_given_values_replace_maps(twin):
    assert twin.sensor(prnu_fraction=0.0).light_response().std() == 0.0
    assert twin.sensor(prnu_fraction=0.02).light_response().std() == pytest.approx(0.02, rel=0.1)
    assert twin.sensor(dsnu_e=0.0, line_fpn_fraction=0.0).disabled == ()
    assert "offset_map" not in {effect.name for effect in twin.sensor(dsnu_e=1.0).chain}
    assert twin.sensor(dsnu_fraction=0.1).dark_e_per_s == pytest.approx(DARK_E_PER_S, rel=0.05)
    assert twin.sensor(dark_e_per_s=0.0).dark_e_per_s == 0.0
    added = {effect.name: effect for effect in twin.sensor(effects=[fs.sensor.effects.RowNoise(50.0)]).chain}
    assert {"response_map", "offset_map"} <= set(added)
    assert added["row_noise"].noise_e == 50.0
    assert twin.sensor(bits=10).linearise(np.full(N_X * N_Y, 10.0)).gain_dn_per_e == pytest.approx(0.1, rel=0.02)
    for name in ("response_map", "offset_map"):
        assert name not in {effect.name for effect in twin.sensor(disabled=[name]).chain}
    assert twin.sensor(bits=10).provenance["replaced"] == ["bits"]


def test_missing_lines_are_said(twin):
    layout = fs.layout.hexagonal(n_columns=9, n_rows=8, pitch_um=5.0)
    assert twin.estimates["row_noise_e"].value == pytest.approx(ROW_E, rel=0.1)
    bare = fs.Layout.from_polygons(layout.polygons())

    assert "row_noise" in {effect.name for effect in twin.sensor().chain}
    assert any("row noise is omitted" in text for text in twin.sensor(bare).provenance["assumptions"])


# -- compositions ------------------------------------------------------------------------------------------------------------


def numpy_mean_dn(camera_pixels, signal_e):
    """Mean codes of the camera without the package, in the order of sites."""
    response, offset_e, dark = (each[::-1].ravel() for each in camera_pixels)
    return GAIN * (signal_e * response + dark * EXPOSURE_S + offset_e) + BLACK_DN


def signal_of(camera):
    """Electrons of an ideal sensor of the same pixels."""
    ideal = camera.replace(sensor=fs.Sensor(camera.layout, bits=16, shot_noise="off"))
    return float(ideal.capture(flat(), exposure_s=EXPOSURE_S, seed=0).expected_e.mean())


def test_predictions_are_means_of_captures(twin, camera_pixels):
    """Mean and variance of 400 captures, and the mean codes of the camera from which the twin was estimated."""
    camera = camera_of(twin.sensor())
    codes = np.stack([camera.capture(flat(), exposure_s=EXPOSURE_S, seed=seed).code for seed in range(400)]).astype(
        float
    )
    mean_dn, variance_dn2 = camera.predict(flat(), exposure_s=EXPOSURE_S)
    z = (codes.mean(axis=0) - mean_dn) / np.sqrt(variance_dn2 / 400)

    assert abs(z.mean()) < 0.2  # the noise of rows is common to their sites
    assert z.std() == pytest.approx(1.0, abs=0.1)
    assert codes.var(axis=0, ddof=1).mean() == pytest.approx(variance_dn2.mean(), rel=0.02)
    expected = numpy_mean_dn(camera_pixels, signal_of(camera))
    assert np.corrcoef(mean_dn, expected)[0, 1] > 0.99
    assert (mean_dn - expected).std() < 0.15 * expected.std()
    assert mean_dn.mean() == pytest.approx(expected.mean(), rel=0.01)


def test_tiles_have_their_part_of_the_maps(twin):
    """Tiles are bit for bit parts of the capture, and so are sensors of some sites."""
    rng, shape = np.random.default_rng(2), (380, 360)
    large = replace(
        twin,
        pixel_um=0.6,
        maps={
            **{name: np.zeros(shape) for name in ("noise_e", "is_defect")},
            "offset_e": rng.normal(0.0, 15.0, shape),
            "response_fraction": 1.0 + 0.08 * rng.normal(size=shape),
            "dark_e_per_s": rng.uniform(0.0, 200.0, shape),
        },
    )
    camera = camera_of(large.sensor())
    whole = camera.capture(flat(), exposure_s=EXPOSURE_S, seed=3)
    parts = list(tiles.capture_tiles(camera, flat(), exposure_s=EXPOSURE_S, seed=3, tile_sites=BLOCK_SITES))

    assert len(parts) > 2
    np.testing.assert_array_equal(np.concatenate([part.code for part in parts]), whole.code)
    chosen = rng.permutation(camera.layout.n_sites)[:50]
    signal_e = np.full(camera.layout.n_sites, 500.0)
    np.testing.assert_array_equal(
        camera.sensor.part(chosen).predict(signal_e[:50])[0], camera.sensor.predict(signal_e)[0][chosen]
    )


def test_frames_of_videos_share_the_maps(twin):
    """The pattern remains from frame to frame, and the noise is that of predictions; double sampling keeps both."""
    for sensor in (twin.sensor(), twin.sensor(cds=True)):
        camera = camera_of(sensor)
        frames = [capture.code for capture in camera.video([flat()] * 60, exposure_s=EXPOSURE_S, seed=0)]
        codes = np.stack(frames).astype(float)
        mean_dn, variance_dn2 = camera.predict(flat(), exposure_s=EXPOSURE_S)

        assert np.corrcoef(codes[:30].mean(axis=0), codes[30:].mean(axis=0))[0, 1] > 0.95
        assert codes.var(axis=0, ddof=1).mean() == pytest.approx(variance_dn2.mean(), rel=0.05)
        assert codes.mean() == pytest.approx(mean_dn.mean(), rel=2e-3)


def test_rolling_shutters_expose_rows_of_twins(twin):
    """The top row is exposed first: when the light is switched off, only rows that began late are darker."""
    camera = camera_of(twin.sensor(effects=[fs.sensor.effects.RowNoise(0.0)], prnu_fraction=0.0, dsnu_e=0.0))
    dark = fs.Scene.flat(
        **{**{name: value for name, value in SCENE.items() if name != "kind"}, "radiance_w_m2_sr_nm": 0.0}
    )
    line_s = EXPOSURE_S / N_Y
    frames = [flat(), dark, dark, dark]
    first = next(iter(camera.video(frames, exposure_s=EXPOSURE_S, frame_s=EXPOSURE_S, line_s=line_s, seed=0)))
    rows = first.code.reshape(N_Y, N_X).mean(axis=1)

    np.testing.assert_allclose(np.polyfit(np.arange(N_Y), rows, 1)[0] * N_Y, rows.max() - BLACK_DN, rtol=0.1)


def test_longer_exposures_of_twins_add_charge(twin):
    """The difference of two exposure times is the light, with the response of each pixel, and the dark current."""
    sensor = twin.sensor()
    rate = np.full(sensor.layout.n_sites, 1e5)
    estimates = sensor.pattern("response_map")

    codes = [sensor.expose(rate, time_s, seed=2, frame=k)[2].astype(float) for k, time_s in enumerate((0.01, 0.02))]
    slope = (codes[1] - codes[0]) / (0.01 * GAIN)
    assert slope.mean() == pytest.approx((rate * estimates).mean(), rel=0.02)
    assert np.corrcoef(slope, estimates)[0, 1] > 0.6


def codes_in_process(sensor):
    return codes_of(sensor)


def test_sensors_work_in_other_processes(twin):
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        for sensor in (twin.sensor(), replace(twin.sensor(), bits=10), twin.sensor(maps=False)):
            np.testing.assert_array_equal(pool.submit(codes_in_process, sensor).result(), codes_of(sensor))
    for copied in (pickle.loads(pickle.dumps(twin)), copy.deepcopy(twin)):
        assert copied.estimates == twin.estimates
        np.testing.assert_array_equal(
            copied.sensor().predict(np.zeros(N_X * N_Y))[0], twin.sensor().predict(np.zeros(N_X * N_Y))[0]
        )


@pytest.mark.parametrize("suffix", ["npz", "zarr"])
def test_saved_captures_contain_the_sensor(twin, tmp_path, suffix):
    pytest.importorskip("zarr")
    sensor = twin.sensor()
    camera_of(sensor).capture(flat(), exposure_s=EXPOSURE_S, seed=1).save(tmp_path / f"capture.{suffix}")
    found = fs.Capture.load(tmp_path / f"capture.{suffix}")
    restored = fs.Sensor.from_settings(found.layout, found.settings["sensor"], found.sensor_arrays)
    signal_e = np.full(sensor.layout.n_sites, 700.0)

    for one, other in zip(restored.predict(signal_e), sensor.predict(signal_e), strict=True):
        np.testing.assert_array_equal(one, other)
    assert restored.provenance == sensor.provenance
    assert any("maps of the pixels" in text for text in restored.provenance["assumptions"])
    names = {effect["kind"] if "kind" in effect else str(effect) for effect in found.settings["sensor"]["effects"]}
    assert any("ResponseMap" in name for name in names)


def test_moved_gaze_and_other_layouts(twin, camera_pixels):
    """Photosites of four times the area collect four times the charge, behind any optical axis."""
    foveal = fs.layout.log_polar(n_sectors=24, r_min_um=12.0, r_max_um=60.0, min_size_um=3.0)
    sensor = twin.sensor(foveal)
    camera = camera_of(sensor, gaze_um=(8.0, -5.0))
    signal_e = signal_of(camera_of(twin.sensor())) / PITCH_UM**2 * foveal.area_um2
    share = foveal.area_um2 / PITCH_UM**2
    mean_dn = camera.predict(flat(), exposure_s=EXPOSURE_S)[0]
    is_below = signal_e < 0.8 * WELL_E * share

    expected = GAIN / share * (signal_e + DARK_E_PER_S * share * EXPOSURE_S) + BLACK_DN
    assert is_below.all()
    assert np.median(mean_dn / expected) == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(sensor.full_well_e, WELL_E * share, rtol=0.02)
    moved = codes_of(twin.sensor(), gaze_um=(8.0, -5.0))
    assert np.corrcoef(moved, numpy_mean_dn(camera_pixels, 1e3))[0, 1] > 0.9


# -- command line, sweeps, comparisons, data sets ---------------------------------------------------------------------------


def test_commands_use_twins(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = shot_of(tmp_path)
    runner = CliRunner()
    for arguments in (
        ["run", str(file), "--out", "out"],
        ["describe", "twin.npz"],
        ["run", str(file), "--out", "other", "--set", "sensor.twin=twin.npz", "--set", "sensor.bits=10"],
    ):
        result = runner.invoke(app, arguments)
        assert result.exit_code == 0, result.output
    shot = read_shot(file)
    found = fs.Capture.load(next((tmp_path / "out").glob("*.npz")))
    np.testing.assert_array_equal(found.code, shot.camera.capture(shot.scene, exposure_s=EXPOSURE_S, seed=3).code)
    layout = fs.read_layout(path)
    assert (layout.n_sites, layout.columns["row"].max()) == (N_X * N_Y, N_Y - 1)
    with pytest.raises(fs.FoveasimError, match="layer"):
        fs.read_layout(path, layer=3)


def test_sweeps_vary_twins_and_their_values(twin, path, tmp_path):
    """The signal-to-noise ratio falls with the read noise; another twin has another layout."""
    small = replace(twin, maps={name: values[:20, :16] for name, values in twin.maps.items()})
    small.save(tmp_path / "small.npz")
    found = fs.explore.sweep(
        settings_of() | {"sensor": {"twin": str(path)}},
        {"sensor.twin": [str(path), str(tmp_path / "small.npz")], "sensor.read_noise_e": [1.0, 100.0]},
        metrics=["snr", "n_sites"],
        workers=0,
    )

    assert set(found["error"].values.ravel()) == {""}
    np.testing.assert_array_equal(found["n_sites"].values, [[N_X * N_Y] * 2, [320] * 2])
    ratios = found["snr_mean"].values[:, 0] / found["snr_mean"].values[:, 1]
    np.testing.assert_allclose(ratios, ratios[0], rtol=0.05)
    assert ratios[0] > 1.5


def test_comparisons_accept_twins(twin):
    """Read noise is that of pixels and rows; more of it leaves less information."""
    cameras = {
        "twin": camera_of(twin.sensor()),
        "preset": camera_of(fs.Sensor.from_preset(twin.layout(), "machine_vision")),
        "noisy": camera_of(twin.sensor(read_noise_e=400.0)),
    }
    picture = np.random.default_rng(0).integers(0, 256, (24, 24), dtype=np.uint8)
    scene = fs.Scene.from_picture(
        picture, fit="cover", distance_m=1.0, peak_radiance_w_m2_sr_nm=0.05, wavelength_nm=550.0, band_width_nm=50.0
    )
    found = fs.compare.cameras(cameras, {"noise": scene}, exposure_s=EXPOSURE_S)
    rows = {row["camera"]: row for row in found.records()}

    assert rows["twin"]["read_noise_e2"] == pytest.approx(N_X * N_Y * (NOISE_E**2 + ROW_E**2), rel=0.05)
    for name in ("twin", "preset"):
        assert rows[name]["information_bit_per_site"] > 1.5 * rows["noisy"]["information_bit_per_site"]


def test_data_sets_contain_the_pattern(path, tmp_path, camera_pixels, monkeypatch):
    """Samples of a uniform picture correlate with the numbers of the camera."""
    monkeypatch.chdir(tmp_path)
    scene = {
        "kind": "picture", "picture": "", "fit": "cover", "distance_m": 1.0, "peak_radiance_w_m2_sr_nm": 0.02,
        "wavelength_nm": 550, "band_width_nm": 10.0,
    }  # fmt: skip
    data = fs.explore.Dataset(
        np.full((2, 32, 32), 200, np.uint8),
        settings_of() | {"scene": scene},
        {"optics.f_number": {"uniform": [3.9, 4.1]}},
        cameras=2,
    )
    for k in range(len(data)):
        codes = data[k]["code"].astype(float)
        assert np.corrcoef(codes, numpy_mean_dn(camera_pixels, 1e3))[0, 1] > 0.8


# -- colours -----------------------------------------------------------------------------------------------------------------

COLOUR = np.tile([[1.0, 0.7], [0.7, 0.4]], (N_Y // 2, N_X // 2))  # the lamp on R, G and B


@pytest.fixture(scope="module")
def coloured(camera_pixels):
    return fitted(camera_pixels, mosaic="RGGB", colour=COLOUR)


def test_colours_respond_as_to_the_lamp(coloured):
    """Without spectral curves, grey light gives the ratios of the lamp in the channels."""
    sensor = coloured.sensor()
    codes = codes_of(sensor).astype(float) - BLACK_DN
    means = np.array([codes[sensor.filter_of_site == k].mean() for k in range(3)])

    assert sensor.filter_names == ("R", "G", "B")
    np.testing.assert_allclose(means / means[0], [1.0, 0.7, 0.4], rtol=0.02)
    assert any("neutral" in text and "give filters" in text for text in sensor.provenance["assumptions"])


def test_photons_give_the_efficiency_of_each_colour(camera_pixels):
    sensor = fitted(camera_pixels, mosaic="RGGB", colour=COLOUR, efficiency=0.6).sensor()
    e_per_photon = sensor.responsivity_e_per_j(np.array([550.0])) * fs.units.photon_energy_j(550.0)

    np.testing.assert_allclose(e_per_photon[:, 0], [0.6, 0.42, 0.24], rtol=0.02)


def test_given_filters_separate_colours(coloured):
    """Red light reaches red pixels; without spectral curves, it reaches all."""
    red = fs.Scene.flat(**{**{name: value for name, value in SCENE.items() if name != "kind"}, "wavelength_nm": 620.0})

    def means(sensor):
        codes = camera_of(sensor).capture(red, exposure_s=EXPOSURE_S, seed=0).code - BLACK_DN
        return np.array([codes[sensor.layout.channel == k].mean() for k in range(3)])

    given, neutral = means(coloured.sensor(filters="rgb")), means(coloured.sensor())
    assert given[0] > 5.0 * given[2]
    assert neutral[0] < 3.0 * neutral[2]
    assert not any("neutral" in text for text in coloured.sensor(filters="rgb").provenance["assumptions"][-1:])


def test_layouts_without_channels_have_no_filters(coloured):
    sensor = coloured.sensor(fs.layout.hexagonal(n_columns=9, n_rows=8, pitch_um=5.0))
    assert sensor.filters is None
    layout = fs.layout.mosaic(fs.layout.grid(n_x=8, n_y=8, pitch_um=6.0), "RGGB")
    assert coloured.sensor(layout).n_filters == 3

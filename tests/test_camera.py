"""The complete chain: radiometry by hand, equivalent paths, reproducible draws, captures and their files."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.errors import CoverageWarning, FileError, ParameterError, SimulationError

H_J_S, C_M_S, Q_C = 6.62607015e-34, 299792458.0, 1.602176634e-19
OPTICS = fs.Optics(focal_length_mm=22.0, f_number=4.0)
SCENE = {"pitch_um": 20.0, "distance_m": 0.56}


def flat_scene(radiance=0.05, n=300, **changes):
    return fs.Scene.flat(
        **{"shape": (n, n), "radiance_w_m2_sr_nm": radiance, "band_width_nm": 10.0, **SCENE, **changes}
    )


def picture_scene(n_wavelengths=3, shape=(200, 240), **changes):
    picture = np.random.default_rng(1).random((*shape, 3)).astype(np.float32)
    wavelength_nm = np.linspace(430.0, 680.0, n_wavelengths)
    spectrum = np.random.default_rng(2).random((3, n_wavelengths))
    values = {"peak_radiance_w_m2_sr_nm": 0.02, "wavelength_nm": wavelength_nm, "spectrum": spectrum, **SCENE}
    return fs.Scene.from_picture(picture, encoding="linear", **{**values, **changes})


def rgb_layout():
    layout = fs.layout.log_polar(n_sectors=36, min_size_um=3.0, r_max_um=64.0, stagger=True)
    return fs.layout.mosaic(layout, ("RG", "GB"))


def test_flat_scene_gives_radiometric_electrons():
    """n = E A t λ/(hc) QE with E = π L Δλ / (1 + 4 N²), on the axis."""
    layout = fs.Layout.from_rectangles([[0.0, 0.0]], [[3.0, 2.0]])
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout, qe=0.4, dark_e_per_s=7.0))
    scene = flat_scene(0.05)
    image_distance_mm = 1 / (1 / 22.0 - 1 / 560.0)
    n_image = image_distance_mm / (22.0 / 4.0)
    irradiance_w_m2 = np.pi * 0.05 * 10.0 / (1 + 4 * n_image**2)
    photons = irradiance_w_m2 * 6e-12 * 0.02 * 550e-9 / (H_J_S * C_M_S)

    capture = camera.capture(scene, exposure_s=0.02, seed=0)

    assert capture.expected_e[0] == pytest.approx(0.4 * photons + 7.0 * 0.02, rel=2e-5)


def test_power_map_gives_its_photons():
    """1 W/m² on 1 µm² for 1 s at 550 nm are 2.76876e6 photons; two bands add up."""
    layout = fs.Layout.from_rectangles([[2.0, 2.0]], 1.0)
    grid = fs.Grid((4, 4), 1.0)
    one = fs.PowerMap(np.ones((1, 4, 4)), grid, np.array([550.0]))
    two = fs.PowerMap(np.ones((2, 4, 4)), grid, np.array([550.0, 1100.0]))
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout))

    assert camera.photoelectrons_per_s(one)[0] == pytest.approx(2.76876e6, rel=2e-6)
    assert camera.photoelectrons_per_s(two)[0] == pytest.approx(3 * 2.76876e6, rel=2e-6)


@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("filters", [None, "rgb"])
def test_scene_equals_its_power_map(precision, filters):
    optics = fs.Optics(focal_length_mm=22.0, f_number=4.0, precision=precision)
    sensor = fs.Sensor(rgb_layout(), qe=fs.SiliconQE(depth_um=3.0), filters=filters)
    camera = fs.Camera(optics=optics, sensor=sensor, order=2)
    scene = picture_scene(n_wavelengths=11)

    collapsed = camera.photoelectrons_per_s(scene)
    by_wavelength = camera.photoelectrons_per_s(camera.power_map(scene))

    assert collapsed == pytest.approx(by_wavelength, rel=2e-5 if precision == "single" else 1e-7)


@pytest.mark.parametrize(("cells_per_lambda_n", "order"), [(8.2, 2), (2.1, 2), (1.9, 1), (0.3, 1)])
def test_order_depends_on_cells_per_lambda_n(cells_per_lambda_n, order):
    lambda_n_um = 0.55 * OPTICS.working_f_number(0.5)
    pitch_um = lambda_n_um / cells_per_lambda_n / OPTICS.magnification(0.5)
    shape = (401, 401)
    scene = fs.Scene.point_sources(
        shape=shape, pixels=[(200, 200)], intensity_w_sr_nm=1.0, pitch_um=pitch_um, distance_m=0.5, band_width_nm=1.0
    )
    width_um = 401 * lambda_n_um / cells_per_lambda_n
    layout = fs.Layout.from_rectangles([[0.0, 0.0], [0.0, 0.0]], [lambda_n_um, 0.999 * width_um])
    optics = replace(OPTICS, padding="periodic", oversample=1)
    fractions = {}
    for asked in (None, 1, 2):
        camera = fs.Camera(optics=optics, sensor=fs.Sensor(layout), order=asked)
        assert camera.order(scene) == (asked or order)
        assert camera.order(optics.power_map(scene)) == (asked or 1)
        square, complete = camera.photoelectrons_per_s(scene)
        fractions[asked] = square / complete

    assert fractions[None] == fractions[order]
    # A square of side λN at the point, without the boundary of the largest site.
    if cells_per_lambda_n == 8.2:
        assert fractions[2] == pytest.approx(0.528891, abs=4e-4)
        assert abs(fractions[1] - 0.528891) > 1e-3


def test_each_site_has_own_filter():
    """One narrow band per channel: a site's electrons follow its own filter's curve."""
    layout = fs.Layout.from_rectangles([[-6.0, 0.0], [0.0, 0.0], [6.0, 0.0]], 2.0, channel=[2, 0, 1])
    filters = fs.FilterSet(tuple(fs.GaussianCurve(centre_nm=c, fwhm_nm=80.0, peak=0.9) for c in (600.0, 550.0, 450.0)))
    rate = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout, filters=filters)).photoelectrons_per_s(flat_scene())
    plain = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout)).photoelectrons_per_s(flat_scene())

    at_550 = [0.9 * 2.0 ** -((2 * abs(c - 550) / 80) ** 2) for c in (450.0, 600.0, 550.0)]
    assert rate / plain == pytest.approx(at_550, rel=1e-6)


def test_electrons_scale_with_exposure_and_radiance():
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(rgb_layout()))
    once = camera.capture(flat_scene(0.01), exposure_s=0.01, seed=0).expected_e

    assert camera.capture(flat_scene(0.01), exposure_s=0.02, seed=0).expected_e == pytest.approx(2 * once, rel=1e-12)
    assert camera.capture(flat_scene(0.02), exposure_s=0.01, seed=0).expected_e == pytest.approx(2 * once, rel=1e-6)


@pytest.mark.parametrize("qe", [0.3, 1.0])
def test_shot_noise_is_poisson_for_any_qe(qe):
    layout = fs.layout.grid(n_x=200, n_y=200, pitch_um=0.5)
    capture = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout, qe=qe)).capture(
        flat_scene(0.5), exposure_s=0.01, seed=3
    )
    deviation = (capture.electrons - capture.expected_e) / np.sqrt(capture.expected_e)

    # Over n sites, the standard error of the mean is 1/sqrt(n), of the variance sqrt(2/n).
    assert capture.expected_e.min() > 50
    assert abs(deviation.mean()) < 5 / np.sqrt(40_000)
    assert abs(deviation.var() - 1) < 5 * np.sqrt(2 / 40_000)


def test_changed_copy_of_settings_changes_no_capture():
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(fs.layout.grid(n_x=2, n_y=2, pitch_um=2.0), bits=9))
    light = fs.PowerMap(np.ones((1, 4, 4)), fs.Grid.centred((4, 4), 1.0), np.array([550.0]))
    settings = camera.settings
    settings["sensor"]["bits"] = 3
    capture = camera.capture(light, exposure_s=1e-3, seed=0)

    assert capture.settings["sensor"]["bits"] == 9
    assert capture.settings["sensor"] == camera.settings["sensor"]


def test_capture_is_independent_of_threads():
    sensor = fs.Sensor(rgb_layout(), filters="rgb", read_noise_e=2.0)
    scene = picture_scene(shape=(500, 600))
    one, two, again = (
        fs.Camera(optics=OPTICS, sensor=sensor, n_threads=n).capture(scene, exposure_s=0.01, seed=11) for n in (1, 2, 2)
    )

    for name in ("expected_e", "electrons", "code"):
        assert np.array_equal(getattr(one, name), getattr(two, name))
        assert np.array_equal(getattr(again, name), getattr(two, name))


def test_seed_and_frame_change_draws_only():
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(rgb_layout()))
    first = camera.capture(flat_scene(), exposure_s=0.01, seed=0)
    for other in (
        camera.capture(flat_scene(), exposure_s=0.01, seed=1),
        camera.capture(flat_scene(), exposure_s=0.01, seed=0, frame=1),
    ):
        assert np.array_equal(other.expected_e, first.expected_e)
        assert np.mean(other.electrons != first.electrons) > 0.9


def test_sites_outside_image_are_dark():
    layout = fs.Layout.from_rectangles([[0.0, 0.0], [1e4, 0.0]], 2.0)
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout))

    with pytest.warns(CoverageWarning, match="1 of 2 photosites lie partly or completely outside the image"):
        assert camera.photoelectrons_per_s(flat_scene())[1] == 0.0


def test_negative_irradiance_names_the_site():
    layout = fs.Layout.from_rectangles([[0.5, 0.5], [3.5, 3.5]], 1.0)
    data = np.ones((1, 4, 4))
    data[0, 3, 3] = -0.1

    with pytest.raises(SimulationError, match="irradiance on site 1 must be >= 0"):
        fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout)).photoelectrons_per_s(
            fs.PowerMap(data, fs.Grid((4, 4), 1.0), np.array([550.0]))
        )


def test_camera_parts_are_read_only():
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(rgb_layout()))

    with pytest.raises(AttributeError, match="sensor"):
        camera.sensor = fs.Sensor(rgb_layout())


def test_compiled_layouts_are_cached():
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(rgb_layout()))
    grids = [fs.Grid.centred((n, n), 1.0) for n in range(200, 206)]
    first = camera.integrator(grids[0])
    for grid in grids[1:4]:
        camera.integrator(grid)

    assert camera.integrator(grids[0]) is first
    camera.integrator(grids[4])
    assert camera.integrator(grids[0]) is first
    assert camera.integrator(grids[4]).grid == grids[4]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"optics": "lens"}, r"'optics' must be an? Optics, got a str"),
        ({"sensor": rgb_layout()}, r"'sensor' must be an? Sensor, got a Layout"),
        ({"sensor": OPTICS, "optics": fs.Sensor(rgb_layout())}, r"'optics' must be an? Optics, got a Sensor"),
    ],
)
def test_parts_of_wrong_type_are_rejected(parts, message):
    with pytest.raises(ParameterError, match=message):
        fs.Camera(**{"optics": OPTICS, "sensor": fs.Sensor(rgb_layout()), **parts})


def test_nan_irradiance_names_the_site():
    data = np.ones((1, 4, 4))
    data[0, 3, 3] = np.nan
    layout = fs.Layout.from_rectangles([[0.5, 0.5], [3.5, 3.5]], 1.0)
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout))

    with pytest.raises(SimulationError, match="irradiance on site 1 must be finite"):
        camera.photoelectrons_per_s(fs.PowerMap(data, fs.Grid((4, 4), 1.0), np.array([550.0])))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"exposure_s": -1.0}, "'exposure_s' must be >= 0, got -1.0 s"),
        ({"exposure_s": float("nan")}, "'exposure_s' must be finite"),
        ({"seed": -3}, "'seed' must be >= 0"),
        ({"seed": 1.5}, "'seed' must be an integer"),
        ({"frame": -1}, "'frame' must be >= 0"),
        ({"light": "scene"}, "'light' must be a Scene or a PowerMap, got a str"),
    ],
)
def test_invalid_arguments_are_rejected_by_name(arguments, message):
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(rgb_layout()))
    values = {"light": flat_scene(), "exposure_s": 0.01, "seed": 0, **arguments}

    with pytest.raises(ParameterError, match=message):
        camera.capture(values.pop("light"), **values)


# -- captures ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def capture():
    sensor = fs.Sensor(rgb_layout(), filters="rgb", qe=fs.SiliconQE(depth_um=3.0), read_noise_e=1.5, bits=12)
    return fs.Camera(optics=OPTICS, sensor=sensor).capture(picture_scene(), exposure_s=0.02, seed=5)


def test_saved_capture_loads_identically(capture, tmp_path):
    capture.save(tmp_path / "c.npz")
    loaded = fs.Capture.load(tmp_path / "c.npz")

    for name in ("code", "electrons", "expected_e", "filter_of_site", "white_dn"):
        assert np.array_equal(getattr(loaded, name), getattr(capture, name))
        assert getattr(loaded, name).dtype == getattr(capture, name).dtype
    for name in ("xy_um", "ring_offsets", "site_offsets", "channel", "readout_line"):
        assert np.array_equal(getattr(loaded.layout, name), getattr(capture.layout, name))
    assert (loaded.bits, loaded.filter_names, loaded.settings) == (capture.bits, capture.filter_names, capture.settings)
    assert loaded.layout.provenance["generator"] == "log_polar"


def test_capture_contains_its_settings(capture):
    settings = json.loads(json.dumps(capture.settings))

    assert settings["seed"] == 5
    assert settings["exposure_s"] == 0.02
    assert settings["optics"]["f_number"] == 4.0
    assert settings["sensor"]["qe"] == {"kind": "SiliconQE", "depth_um": 3.0, "transmission": 1.0}
    assert settings["versions"]["foveasim"] == fs.__version__
    assert settings["layout"]["parameters"]["n_sectors"] == 36


def test_white_balance_makes_flat_scene_white():
    sensor = fs.Sensor(rgb_layout(), filters="rgb", qe=fs.SiliconQE(depth_um=3.0), bits=14, shot_noise="off",
                       capacitance_f=rgb_layout().area_um2 * 3e-16)  # fmt: skip
    scene = flat_scene(0.004, wavelength_nm=np.linspace(420, 680, 14), band_width_nm=20.0)
    capture = fs.Camera(optics=OPTICS, sensor=sensor).capture(scene, exposure_s=0.02, seed=0)
    balanced = capture.picture(max_pixels=60).data / capture.white_dn[:, np.newaxis, np.newaxis]
    levels = np.nanmedian(balanced, axis=(1, 2))

    assert capture.saturated_fraction == 0.0
    assert levels == pytest.approx(np.full(3, levels.mean()), rel=0.01)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"code": np.full(3, 7.0)}, "'code' must be numbers of the shape"),
        ({"bits": 4}, "'code' must be <= 15 everywhere"),
        ({"filter_names": ("R", "G")}, "'filter_of_site' must be <= 1 everywhere"),
        ({"white_dn": np.array([1.0, np.nan, 1.0])}, "'white_dn' must be finite"),
    ],
)
def test_inconsistent_captures_are_rejected(capture, changes, message):
    with pytest.raises(ParameterError, match=message):
        replace(capture, **changes)


def test_capture_is_read_only(capture):
    for name in ("code", "electrons", "expected_e", "filter_of_site", "white_dn"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(capture, name)[0] = 1


def test_any_provenance_can_be_saved(tmp_path):
    origin = {"n": np.int64(3), "a": np.arange(100), "b": 1 + 2j}
    layout = fs.Layout.from_polygons([shapely.box(0, 0, 4, 4)], provenance=origin)
    capture = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout)).capture(flat_scene(), exposure_s=0.01, seed=0)
    capture.save(tmp_path / "c.npz")

    assert fs.Capture.load(tmp_path / "c.npz").layout.provenance["n"] == 3


def test_zero_filter_gives_finite_white():
    layout = fs.layout.mosaic(fs.layout.grid(n_x=20, n_y=20, pitch_um=2.0), ("RG", "GR"))
    curves = (fs.GaussianCurve(centre_nm=550, fwhm_nm=80), fs.GaussianCurve(centre_nm=400, fwhm_nm=5))
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout, filters=fs.FilterSet(curves, ("R", "G"))))
    capture = camera.capture(flat_scene(), exposure_s=0.01, seed=0)

    assert capture.white_dn.tolist() == [255.0, pytest.approx(2.55)]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda p: p.unlink(), "no such file"),
        (lambda p: p.write_bytes(b""), "is corrupt or not a valid foveasim capture"),
        (lambda p: p.write_bytes(b"PK\x03\x04 and nothing else"), "is corrupt or not a valid foveasim capture"),
        (lambda p: p.write_bytes(p.read_bytes()[:-200]), "is corrupt or not a valid foveasim capture"),
        (
            lambda p: p.write_bytes(p.read_bytes()[: p.stat().st_size // 2]),
            "is corrupt or not a valid foveasim capture",
        ),
        (lambda p: np.savez(p, code=np.zeros(3)), "is not a valid foveasim capture"),
        (lambda p: np.savez(p, about=np.array('{"format": "other"}')), "is not a valid foveasim capture"),
        (lambda p: np.savez(p, about=np.array({"a": 1}, dtype=object)), "is corrupt or not a valid foveasim capture"),
    ],
)
def test_corrupt_capture_files_are_rejected(capture, tmp_path, spoil, message):
    path = tmp_path / "c.npz"
    capture.save(path)
    spoil(path)

    with pytest.raises(FileError, match=message) as caught:
        fs.Capture.load(path)
    assert caught.value.path == path


def test_flipped_bits_are_detected(capture, tmp_path):
    path = tmp_path / "c.npz"
    capture.save(path)
    complete = path.read_bytes()
    rng = np.random.default_rng(0)
    sentences = []
    for _ in range(400):
        spoiled = bytearray(complete)
        for position in rng.integers(0, len(complete), 3):
            spoiled[position] ^= 1 << int(rng.integers(0, 8))
        path.write_bytes(spoiled)
        try:
            fs.Capture.load(path)
        except FileError as error:
            sentences.append(str(error))

    assert len(sentences) > 300
    assert not any("\n" in sentence for sentence in sentences)


def test_failed_save_leaves_no_file(capture, tmp_path, monkeypatch):
    (tmp_path / "kept.npz").write_text("before")

    def fail(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(FileError, match="cannot be written: No space left on device"):
        capture.save(tmp_path / "kept.npz")

    assert [p.name for p in tmp_path.iterdir()] == ["kept.npz"]
    assert (tmp_path / "kept.npz").read_text() == "before"


@pytest.mark.parametrize(
    ("name", "message"), [("c.txt", "must end in .npz"), ("no/such/c.npz", "the directory .* does not exist")]
)
def test_invalid_targets_are_rejected(capture, tmp_path, name, message):
    with pytest.raises(FileError, match=message):
        capture.save(tmp_path / name)


def test_decompression_bombs_are_rejected(capture, tmp_path, monkeypatch):
    capture.save(tmp_path / "c.npz")
    with zipfile.ZipFile(tmp_path / "c.npz") as archive:
        size = sum(item.file_size for item in archive.infolist())
    monkeypatch.setattr("foveasim._io.npz.MAX_DECOMPRESSED_BYTES", size - 1)

    with pytest.raises(FileError, match="would decompress to more than"):
        fs.Capture.load(tmp_path / "c.npz")


def test_mosaic_picture_has_filter_channels(capture):
    assert capture.picture(max_pixels=40).data.shape[0] == 3
    with pytest.raises(
        ParameterError, match="'method' must be one of 'cells', 'linear', 'natural', 'least_squares', got 'magic'"
    ):
        capture.picture("magic")


def test_chain_accepts_layouts_with_holes():
    ring = shapely.Point(0, 0).buffer(6.0).difference(shapely.Point(0, 0).buffer(2.0))
    layout = fs.Layout.from_polygons([ring, shapely.Point(0, 0).buffer(2.0)])
    capture = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout)).capture(flat_scene(), exposure_s=0.01, seed=0)

    # Uniform radiance: electrons are proportional to area, apart from relative illumination over a few µm.
    assert capture.expected_e[0] / capture.expected_e[1] == pytest.approx(ring.area / layout.area_um2[1], rel=1e-4)

"""
Invariants of captures over combinations of features.

Each row of a table (``reference.covering``) contains one feature of every axis of ``reference.features``, and an invariant. The
complete run contains every pair of them, the default run the first rows, and the nightly run all rows with all invariants.
"""

from __future__ import annotations

import copy
import dataclasses
import pickle
import threading
import warnings

import cloudpickle
import numpy as np
import pytest
import yaml
from effort import commit, effort
from reference.covering import N_DEFAULT, cases, invariants, pairs_of, possible_pairs, read_rows
from reference.features import axes, is_possible, settings_of, settings_with

import foveasim as fs
from foveasim import tiles
from foveasim.config import build_shot, read_shot, to_python
from foveasim.distortion import BrownConrady
from foveasim.errors import FoveasimWarning
from foveasim.explore import Dataset

ROWS = read_rows()
CASES = cases(ROWS, effort=effort(), commit=commit())
#: Rounding of integrals: sums over rows of a map in another order.
ROUNDING = 1e-9
N_FRAMES = 200
#: Standard errors of a sample that a statistical test admits.
N_SIGMA = 5.0

pytestmark = pytest.mark.filterwarnings("ignore::foveasim.errors.FoveasimWarning")


def name_of(row):
    return "-".join(name.replace(" ", "_") for name in row)


def pytest_generate_tests(metafunc):
    if "row" in metafunc.fixturenames:
        metafunc.parametrize("row", CASES[metafunc.function.__name__.removeprefix("test_")], ids=name_of)


@pytest.fixture
def settings(row):
    return settings_of(row)


@pytest.fixture
def shot(settings):
    return build_shot(None, settings)


def capture_of(shot, camera=None, **options):
    return (camera or shot.camera).capture(shot.scene, **{"exposure_s": shot.exposure_s, "seed": shot.seed, **options})


def assert_equal_captures(one, other):
    for name in ("code", "electrons", "expected_e", "filter_of_site", "white_dn"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def assert_close(found, expected, rounding=ROUNDING):
    """Compare arrays within a fraction of the largest value."""
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=rounding * np.abs(expected).max(initial=1e-30))


def with_layout(shot, layout, select=None, lens=None):
    """Return the camera of a shot with another layout, and parameters per site of selected sites."""
    sensor = shot.camera.sensor
    values = {}
    for field in dataclasses.fields(sensor):
        value = getattr(sensor, field.name)
        if select is not None and isinstance(value, np.ndarray) and value.shape == (sensor.layout.n_sites,):
            values[field.name] = value[select]
    changed = dataclasses.replace(sensor, layout=layout, **values)
    order = shot.camera.order(shot.scene)
    return fs.Camera(
        optics=shot.camera.optics,
        sensor=changed,
        distortion=shot.camera.distortion if lens is None else lens,
        order=order,
    )


def unused_camera(shot, n_threads=None):
    """Return an unused camera with the parts of a shot."""
    camera = shot.camera
    return fs.Camera(
        optics=camera.optics,
        sensor=dataclasses.replace(camera.sensor),
        distortion=camera.distortion,
        order=camera._order,
        n_threads=n_threads,
    )


def crosses_sites(shot):
    return any(effect.reach == "all" for effect in shot.camera.sensor.chain)


# -- one result on every route -----------------------------------------------------------------------------------------


def test_routes_of_settings_give_equal_codes(settings, shot, files):
    expected = capture_of(shot)

    (files / "shot.yaml").write_text(yaml.safe_dump(settings))
    assert_equal_captures(capture_of(read_shot(files / "shot.yaml")), expected)
    names = {}
    exec(compile(to_python(settings), "shot.py", "exec"), names)
    assert_equal_captures(names["capture"], expected)


def test_frames_of_videos_equal_captures(shot):
    camera = unused_camera(shot)
    frames = list(camera.video([shot.scene, shot.scene], exposure_s=shot.exposure_s, seed=shot.seed))
    resumed = list(camera.video([shot.scene], exposure_s=shot.exposure_s, seed=shot.seed, first_frame=1, ahead=2))

    assert_equal_captures(frames[0], capture_of(shot))
    assert_equal_captures(frames[1], capture_of(shot, frame=1))
    assert_equal_captures(resumed[0], frames[1])
    still = list(camera.video([(shot.scene, (0.0, 0.0))], exposure_s=shot.exposure_s, seed=shot.seed))
    assert_equal_captures(still[0], frames[0])


def test_tiles_equal_captures(shot):
    if crosses_sites(shot):
        with pytest.raises(fs.errors.ParameterError, match="between sites"):
            tiles.capture_tiles(shot.camera, shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)
        return
    expected = capture_of(shot)
    (tile,) = tiles.capture_tiles(shot.camera, shot.scene, exposure_s=shot.exposure_s, seed=shot.seed)

    np.testing.assert_allclose(tile.expected_e, expected.expected_e, rtol=1e-6)
    assert np.mean(tile.code != expected.code) < 0.01


@pytest.mark.slow(keep=6)
@pytest.mark.parametrize(
    ("axis", "feature"),
    [(axis, name) for axis in ("photo", "dark", "shot", "temporal", "fixed", "adc") for name in axes()[axis]],
)
def test_several_tiles_equal_captures(axis, feature):
    settings = settings_with(**{axis: feature}, colour="random")
    settings["layout"]["parameters"] = {"n_x": 280, "n_y": 260, "pitch_um": 0.2}
    settings["layout"]["generator"] = "grid"
    settings["sensor"].setdefault("read_noise_e", 2.0)
    shot = build_shot(None, settings)
    expected = capture_of(shot)
    parts = list(tiles.capture_tiles(shot.camera, shot.scene, exposure_s=shot.exposure_s, seed=shot.seed, tile_sites=1))

    assert len(parts) == 2
    expected_e = np.concatenate([part.expected_e for part in parts])
    np.testing.assert_allclose(expected_e, expected.expected_e, rtol=1e-6)
    # Irradiance is computed in other rows: rounding changes few draws.
    assert np.mean(np.concatenate([part.code for part in parts]) != expected.code) < 1e-3


def test_samples_of_datasets_equal_captures(row, settings):
    if settings["scene"]["kind"] != "picture":
        settings["scene"] = settings_of(["picture", *row[1:]])["scene"]
    dataset = Dataset(["picture.png"], settings, fields=("code", "electrons", "expected_e", "expected_dn"))
    sample = dataset[0]
    same = dataset.shot(0)
    expected = same.camera.capture(same.scene, exposure_s=same.exposure_s, seed=same.seed)

    for name in ("code", "electrons", "expected_e"):
        np.testing.assert_array_equal(sample[name], getattr(expected, name), err_msg=name)
    mean_dn, _ = same.camera.predict(same.scene, exposure_s=same.exposure_s)
    np.testing.assert_array_equal(sample["expected_dn"], mean_dn)
    one = build_shot(None, settings)
    np.testing.assert_array_equal(capture_of(one).expected_e, expected.expected_e)


def test_stored_captures_equal_captures(shot, tmp_path):
    capture = capture_of(shot)
    capture.save(tmp_path / "capture.npz")
    again = fs.Capture.load(tmp_path / "capture.npz")

    assert_equal_captures(again, capture)
    sensor = shot.camera.sensor
    np.testing.assert_array_equal(again.signal_to_noise(sensor=sensor), capture.signal_to_noise(sensor=sensor))
    np.testing.assert_array_equal(again.picture(max_pixels=16).data, capture.picture(max_pixels=16).data)


def test_copies_of_used_cameras_give_equal_captures(shot):
    expected = capture_of(shot)
    mean_dn, variance_dn2 = shot.camera.predict(shot.scene, exposure_s=shot.exposure_s)

    for camera in (
        pickle.loads(pickle.dumps(shot.camera)),
        cloudpickle.loads(cloudpickle.dumps(shot.camera)),
        copy.deepcopy(shot.camera),
    ):
        assert_equal_captures(capture_of(shot, camera), expected)
        again_dn, again_dn2 = camera.predict(shot.scene, exposure_s=shot.exposure_s)
        np.testing.assert_array_equal(again_dn, mean_dn)
        np.testing.assert_array_equal(again_dn2, variance_dn2)


def test_threads_give_equal_captures(shot):
    expected = capture_of(shot, unused_camera(shot, n_threads=1))
    camera, found = unused_camera(shot), {}

    def run(k):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FoveasimWarning)
            found[k] = capture_of(shot, camera)

    threads = [threading.Thread(target=run, args=(k,)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == len(threads)
    for capture in found.values():
        assert_equal_captures(capture, expected)


# -- symmetries --------------------------------------------------------------------------------------------------------


def test_permuted_sites_give_permuted_results(shot):
    layout = shot.camera.sensor.layout
    order = np.random.default_rng(1).permutation(layout.n_sites)
    camera = with_layout(shot, layout[order], order)

    rate_e_per_s = shot.camera.photoelectrons_per_s(shot.scene)
    assert_close(camera.photoelectrons_per_s(shot.scene), rate_e_per_s[order])
    mean_dn, variance_dn2 = shot.camera.predict(shot.scene, exposure_s=shot.exposure_s)
    permuted_dn, permuted_dn2 = camera.predict(shot.scene, exposure_s=shot.exposure_s)
    assert_close(permuted_dn, mean_dn[order], 1e-7)
    assert_close(permuted_dn2, variance_dn2[order], 1e-6)
    budget = shot.camera.noise_budget(shot.scene, exposure_s=shot.exposure_s)
    permuted = camera.noise_budget(shot.scene, exposure_s=shot.exposure_s)
    assert set(budget) == set(permuted)
    for name, noise_e in budget.items():
        assert_close(permuted[name], noise_e[order], 1e-7)


def test_pictures_do_not_depend_on_order(shot):
    capture = capture_of(shot)
    order = np.random.default_rng(1).permutation(capture.layout.n_sites)
    permuted = dataclasses.replace(
        capture,
        layout=capture.layout[order],
        **{name: getattr(capture, name)[order] for name in ("code", "electrons", "expected_e", "filter_of_site")},
    )
    grid = fs.reconstruct.raster_grid(capture.layout, 24)

    assert_close(
        np.nan_to_num(permuted.picture("cells", grid=grid).data),
        np.nan_to_num(capture.picture("cells", grid=grid).data),
        1e-6,
    )


def test_cropped_sites_measure_the_same(shot):
    layout = shot.camera.sensor.layout
    kept = np.random.default_rng(2).random(layout.n_sites) < 0.4
    camera = with_layout(shot, layout[kept], np.flatnonzero(kept))
    scene = shot.camera.fit_scene(shot.scene)  # cells of the image of a panorama depend on the layout
    rate_e_per_s = shot.camera.photoelectrons_per_s(scene)

    assert_close(camera.photoelectrons_per_s(scene), rate_e_per_s[kept])
    if not any(effect.stage == "expected" or effect.reach == "all" for effect in camera.sensor.chain):
        mean_dn, variance_dn2 = shot.camera.predict(scene, exposure_s=shot.exposure_s)
        cropped_dn, cropped_dn2 = camera.predict(scene, exposure_s=shot.exposure_s)
        assert_close(cropped_dn, mean_dn[kept], 1e-7)
        assert_close(cropped_dn2, variance_dn2[kept], 1e-6)


def test_doubled_radiance_doubles_rates_exactly(shot):
    twice = dataclasses.replace(shot.scene, spectrum_w_m2_sr_nm=2.0 * shot.scene.spectrum_w_m2_sr_nm)
    rate_e_per_s = shot.camera.photoelectrons_per_s(shot.scene)

    np.testing.assert_array_equal(shot.camera.photoelectrons_per_s(twice), 2.0 * rate_e_per_s)
    if not np.any(shot.camera.sensor.dark_rate_e_per_s):
        half = capture_of(dataclasses.replace(shot, scene=twice), exposure_s=shot.exposure_s / 2.0)
        assert_equal_captures(half, capture_of(shot))


def test_split_sites_share_their_power(shot):
    layout = shot.camera.sensor.layout
    parts = fs.layout.split(layout, n_x=2, n_y=2)
    camera = with_layout(shot, parts, parts.columns["parent"])
    rate_e_per_s = shot.camera.photoelectrons_per_s(shot.scene)
    found = np.bincount(parts.columns["parent"], camera.photoelectrons_per_s(shot.scene), layout.n_sites)

    # Chords of undistorted edges differ from the curves by up to 2 % of a cell.
    if shot.camera.distortion is None:
        # Negative rates, which coarse cells of order 2 can have, become 0 per part.
        is_clipped = (camera.photoelectrons_per_s(shot.scene) == 0.0) & (parts.area_um2 > 0.0)
        clipped = np.bincount(parts.columns["parent"], is_clipped, layout.n_sites) > 0
        assert_close(np.where(clipped, rate_e_per_s, found), rate_e_per_s)
    else:
        assert_close(found, rate_e_per_s, 5e-3)


def test_moved_image_and_sites_measure_the_same(shot):
    power_map = shot.camera.power_map(shot.scene)
    dx_um, dy_um = 3.37, -1.91
    x0_um, y0_um = power_map.grid.origin_um
    moved_map = fs.PowerMap(
        power_map.data,
        fs.Grid(power_map.grid.shape, power_map.grid.pitch_um, (x0_um + dx_um, y0_um + dy_um)),
        power_map.wavelength_nm,
        projection=power_map.projection,
    )
    lens = shot.camera.distortion
    if lens is not None:
        lens = dataclasses.replace(lens, centre_um=(lens.centre_um[0] + dx_um, lens.centre_um[1] + dy_um))
    layout = shot.camera.sensor.layout
    camera = with_layout(shot, layout.translate(dx_um, dy_um), np.arange(layout.n_sites), lens)

    still = with_layout(shot, layout, np.arange(layout.n_sites)).photoelectrons_per_s(power_map)
    assert_close(camera.photoelectrons_per_s(moved_map), still, 1e-8)


def test_rotated_image_and_sites_measure_the_same(shot):
    power_map = shot.camera.power_map(shot.scene)
    n_y, _ = power_map.grid.shape
    x0_um, y0_um = power_map.grid.origin_um
    pitch_x_um, pitch_y_um = power_map.grid.pitch_xy_um
    rotated_map = fs.PowerMap(
        np.ascontiguousarray(power_map.data[:, ::-1].transpose(0, 2, 1)),
        fs.Grid(power_map.grid.shape[::-1], (pitch_y_um, pitch_x_um), (-(y0_um + n_y * pitch_y_um), x0_um)),
        power_map.wavelength_nm,
        projection=power_map.projection,
    )
    lens = shot.camera.distortion
    if lens is not None:
        assert not isinstance(lens, BrownConrady) or lens.p1 == lens.p2 == 0.0
        lens = dataclasses.replace(lens, centre_um=(-lens.centre_um[1], lens.centre_um[0]))
    layout = shot.camera.sensor.layout
    camera = with_layout(shot, layout.rotate(90.0), np.arange(layout.n_sites), lens)

    still = with_layout(shot, layout, np.arange(layout.n_sites)).photoelectrons_per_s(power_map)
    assert_close(camera.photoelectrons_per_s(rotated_map), still, 1e-8 if lens is None else 1e-6)


# -- prediction --------------------------------------------------------------------------------------------------------


def test_prediction_equals_moments_of_captures(shot):
    sensor = shot.camera.sensor
    rate_e_per_s = shot.camera.photoelectrons_per_s(shot.scene)
    mean_dn, variance_dn2 = shot.camera.predict(shot.scene, exposure_s=shot.exposure_s)
    frames = np.array(
        [sensor.expose(rate_e_per_s, shot.exposure_s, seed=11, frame=k)[2] for k in range(N_FRAMES)], float
    )

    # Codes that a frame in N_FRAMES leaves are not resolved by the sample.
    is_noisy = variance_dn2 > 0.05
    np.testing.assert_allclose(frames.mean(axis=0)[~is_noisy], mean_dn[~is_noisy], atol=0.3)
    if not is_noisy.any():
        return
    error = (frames.mean(axis=0) - mean_dn)[is_noisy] / np.sqrt(variance_dn2[is_noisy] / N_FRAMES)
    # Sites that share noise average less of it: the mean of n correlated sites varies like that of n_independent.
    covariance_dn2 = shot.camera.predict_covariance(shot.scene, np.flatnonzero(is_noisy), exposure_s=shot.exposure_s)
    deviation_dn = np.sqrt(variance_dn2[is_noisy])
    correlation = covariance_dn2 / np.multiply.outer(deviation_dn, deviation_dn)
    n_independent = error.size**2 / correlation.sum()
    n_independent_squares = error.size**2 / (correlation**2).sum()
    bias = 0.02 * np.sqrt(N_FRAMES)  # of the analytical mean, in standard deviations of a code: 2 %
    assert np.abs(error).max() < N_SIGMA + 1.0 + bias
    assert abs(error.mean()) < N_SIGMA / np.sqrt(n_independent) + bias
    ratio = (frames.var(axis=0, ddof=1)[is_noisy] / variance_dn2[is_noisy]).mean()
    assert ratio == pytest.approx(1.0, abs=N_SIGMA * np.sqrt(2.5 / (N_FRAMES * n_independent_squares)) + 0.03)


# -- the table ---------------------------------------------------------------------------------------------------------


def test_table_contains_every_pair():
    values = [*map(list, axes().values()), invariants()]
    found = set().union(*map(pairs_of, ROWS))
    compute = "run: PYTHONPATH=tests python tests/reference/covering.py"

    assert [row for row in ROWS if not is_possible(row)] == [], compute
    assert set(possible_pairs(values, is_possible)) - found == set(), compute
    assert [set(column) for column in zip(*ROWS, strict=True)] == list(map(set, values)), compute


def test_default_rows_contain_every_value():
    for column, values in zip(zip(*ROWS[:N_DEFAULT], strict=True), [*axes().values(), invariants()], strict=True):
        assert min(map(column.count, values)) >= min(6, N_DEFAULT // len(values)) // 2


def test_nightly_cases_contain_every_triple():
    n_cases = {name: len(rows) for name, rows in cases(ROWS, effort="nightly").items()}
    parts = [cases(ROWS, effort="all", commit=commit) for commit in ("f0", "f1", "f2")]

    assert set(n_cases.values()) == {len(ROWS)}
    own = cases(ROWS, effort="all")
    for name in n_cases:
        assert sum(len(part[name]) - len(own[name]) for part in parts) == len(ROWS) - len(own[name])

"""Datasets: reproducible samples, labels mapped through the lens, and resumable storage."""

from __future__ import annotations

import json
import multiprocessing
import operator
import os
import pickle
import resource
import subprocess
import sys
import tarfile
import tempfile
import threading
import warnings
import zipfile
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import shapely
from PIL import Image
from scipy.special import ndtr
from waiting import DEADLINE_S

import foveasim as fs
from foveasim import explore
from foveasim._io.images import write_picture
from foveasim.config import build_shot
from foveasim.errors import ConfigError, CoverageWarning, FileError, FoveasimWarning, ParameterError, SimulationError
from foveasim.explore.datasets import store
from foveasim.explore.datasets.labels import boxes_on_sites, flow_on_sites, mask_on_sites
from foveasim.explore.datasets.pictures import source_of
from foveasim.explore.datasets.pytorch import _dataset_class
from foveasim.units import decode_srgb

SHOT = {
    "scene": {
        "kind": "picture",
        "pitch_um": 300.0,
        "distance_m": 1.0,
        "peak_radiance_w_m2_sr_nm": 0.05,
        "wavelength_nm": [620, 550, 450],
    },
    "optics": {"focal_length_mm": 8.0, "f_number": 2.8},
    "layout": {"generator": "hexagonal", "parameters": {"n_columns": 9, "n_rows": 8, "pitch_um": 7.0}},
    "sensor": {"read_noise_e": 2.0, "capacitance_f": 2e-14},
    "exposure_s": 0.01,
}
VARY = {
    "optics.f_number": {"log_uniform": [1.4, 8.0]},
    "exposure_s": {"uniform": [0.002, 0.02]},
    "sensor.read_noise_e": {"choice": [1.0, 4.0]},
    "sensor.qe": {"choice": [0.5, {"kind": "silicon", "depth_um": 3.0}]},
}
N_Y, N_X = 80, 96
FLAT = {"kind": "flat", "shape": [80, 96], "radiance_w_m2_sr_nm": 0.1}
#: The image distance of the optics, and the distortion of a focal length of 100 µm with k1 = -0.3.
FOCAL_UM = 8064.5
BARREL = {"kind": "brown_conrady", "focal_um": FOCAL_UM, "k1": -0.3 * (FOCAL_UM / 100.0) ** 2}


def pictures(n, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (n, N_Y, N_X, 3), np.uint8)


def labelled(n=5, **more):
    """Create a dataset with labels of all kinds."""
    rng = np.random.default_rng(1)
    options = {
        "cameras": 2,
        "draws": 2,
        "seed": 7,
        "fields": ("code", "electrons", "expected_e", "expected_dn"),
        "labels": ["dog", "cat", "dog", "bird", "cat"][:n],
        "boxes": [[[1, 2, 20, 30, 4]], [], [[3, 3, 9, 12, 1], [20, 5, 40, 39, 2]], [], [[0, 0, N_X, N_Y, 9]]][:n],
        "masks": list(rng.integers(0, 3, (n, N_Y, N_X))),
        "flows": list(rng.normal(size=(n, N_Y, N_X, 2))),
    } | more
    return explore.Dataset(pictures(n), SHOT, VARY, **options)


def assert_same(one, other):
    assert set(one) == set(other)
    for name, value in one.items():
        assert type(value) is type(other[name]), name
        if isinstance(value, np.ndarray):
            assert value.dtype == other[name].dtype, name
        np.testing.assert_array_equal(value, other[name], err_msg=name)


# -- reproducibility --------------------------------------------------------------------------------------------------


def test_samples_do_not_depend_on_order():
    data = labelled(3)
    forwards = [data[k] for k in range(len(data))]

    for k in np.random.default_rng(0).permutation(len(data)):
        assert_same(data[k], forwards[k])
    for k in (0, 7, 11):
        assert_same(labelled(3)[k], forwards[k])


@pytest.mark.slow
def test_samples_do_not_depend_on_process():
    data = labelled()
    order = np.random.default_rng(1).permutation(len(data)).tolist()
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        found = list(pool.map(partial(operator.getitem, data), order))

    for k, sample in zip(order, found, strict=True):
        assert_same(sample, data[k])


def test_pickled_dataset_contains_no_cache():
    data = labelled()
    size = len(pickle.dumps(data))
    list(data)

    assert len(pickle.dumps(data)) == size


def test_sample_equals_capture_of_its_shot():
    data = explore.Dataset(pictures(3), SHOT, VARY, cameras=4, seed=5)
    index = 9
    settings = data.settings_of(index)
    options = {key: value for key, value in SHOT["scene"].items() if key != "kind"}
    flat = {key: value for key, value in options.items() if key != "peak_radiance_w_m2_sr_nm"}
    shot = build_shot("reference", settings | {"scene": FLAT | flat})
    scene = fs.Scene.from_picture(pictures(3)[2], **options)
    capture = shot.camera.capture(scene, exposure_s=shot.exposure_s, seed=5, frame=index)

    np.testing.assert_array_equal(data[index]["code"], capture.code)
    np.testing.assert_array_equal(data[index]["electrons"], capture.electrons)
    assert (
        data.shot(index).camera.optics.f_number
        == settings["optics"]["f_number"]
        == data[index]["settings"]["optics.f_number"]
    )


def test_integer_keys_equal_string_keys():
    def settings(*keys):
        return {"coefficients": dict.fromkeys(keys, 0.1), "unit": "waves", "wavelength_nm": [550]}

    vary = {"optics.zernike.coefficients.7": {"uniform": [0.1, 0.2]}}
    by_shot = explore.Dataset(pictures(1), SHOT | {"optics": SHOT["optics"] | {"zernike": settings(4, 7)}}, vary)
    by_change = explore.Dataset(pictures(1), SHOT, vary, changes={"optics.zernike": settings(4, 7)})
    expected = explore.Dataset(pictures(1), SHOT, vary, changes={"optics.zernike": settings("4", "7")})

    assert by_shot.settings_of(0) == by_change.settings_of(0) == expected.settings_of(0)
    assert_same(by_shot[0], expected[0])


def test_draws_of_camera_differ_in_noise():
    data = labelled()

    first, again, other = data[0], data[1], data[2]

    assert first["settings"] == again["settings"] != other["settings"]
    np.testing.assert_array_equal(first["expected_e"], again["expected_e"])
    np.testing.assert_array_equal(first["expected_dn"], again["expected_dn"])
    assert (first["electrons"] != again["electrons"]).mean() > 0.5
    assert first["picture"] == other["picture"] == 0


def test_seeds_give_different_cameras():
    found = [explore.Dataset(pictures(1), SHOT, VARY, seed=seed)[0]["settings"]["exposure_s"] for seed in range(8)]

    assert len(set(found)) == 8


def test_random_settings_are_drawn_independently():
    few = explore.Dataset(pictures(6), SHOT, {"exposure_s": VARY["exposure_s"]})
    more = explore.Dataset(pictures(6), SHOT, VARY)

    assert [s["settings"]["exposure_s"] for s in few] == [s["settings"]["exposure_s"] for s in more]


# -- distributions ----------------------------------------------------------------------------------------------------

N_DRAWS = 4000


@pytest.mark.parametrize(
    ("distribution", "cdf"),
    [
        ({"uniform": [2.0, 6.0]}, lambda x: (x - 2.0) / 4.0),
        ({"log_uniform": [1.0, 100.0]}, lambda x: np.log(x) / np.log(100.0)),
        ({"normal": [1.0, 2.0, 0.0, 4.0]}, lambda x: (ndtr(0.5 * (x - 1.0)) - ndtr(-0.5)) / (ndtr(1.5) - ndtr(-0.5))),
    ],
)
def test_continuous_draws_follow_distribution(distribution, cdf):
    draw = explore.parse_distribution("x", distribution)
    quantiles = np.sort(cdf(np.array([draw.sample(0, k)[0] for k in range(N_DRAWS)])))

    # Kolmogorov-Smirnov statistic: it exceeds 2.3 / sqrt(n) with a probability of 1 / 25,000.
    assert np.abs(quantiles - (np.arange(N_DRAWS) + 0.5) / N_DRAWS).max() < 2.3 / np.sqrt(N_DRAWS)


@pytest.mark.parametrize(
    ("distribution", "probabilities"),
    [
        ({"integers": [-1, 2]}, {-1: 0.25, 0: 0.25, 1: 0.25, 2: 0.25}),
        ({"choice": [8, 10]}, {8: 0.5, 10: 0.5}),
        ({"choice": ["a", "b", "c"], "weights": [1, 0, 3]}, {"a": 0.25, "b": 0.0, "c": 0.75}),
    ],
)
def test_discrete_draws_follow_probabilities(distribution, probabilities):
    draw = explore.parse_distribution("x", distribution)
    found = [draw.sample(3, k)[0] for k in range(N_DRAWS)]

    assert set(found) == {value for value, p in probabilities.items() if p}
    for value, p in probabilities.items():
        assert abs(found.count(value) - p * N_DRAWS) <= 5.0 * np.sqrt(N_DRAWS * p * (1.0 - p))


@pytest.mark.parametrize("sigma", [1e-320, 1e-9, 0.1, 1e6])
def test_normal_draws_are_within_bounds(sigma):
    """A wide truncated distribution is nearly uniform; a narrow one is concentrated at its mean."""
    draw = explore.parse_distribution("x", {"normal": [1.0, sigma, 0.0, 2.0]})
    found = np.array([draw.sample(0, k)[0] for k in range(N_DRAWS)])
    sigma_cut = min(sigma, np.sqrt(1.0 / 3.0))

    assert 0.0 <= found.min() <= found.max() <= 2.0
    assert abs(found.mean() - 1.0) <= 5.0 * sigma_cut / np.sqrt(N_DRAWS)
    # Standard deviation of a uniform or normal distribution, within 5 sigma of its estimate for a normal distribution.
    assert found.std() == pytest.approx(sigma_cut, rel=5.0 / np.sqrt(2.0 * N_DRAWS))


def test_boolean_labels_become_integers():
    data = explore.Dataset(pictures(2), SHOT, labels=[True, False])

    assert [sample["label"] for sample in data] == [1, 0]


@pytest.mark.slow
def test_bit_depths_give_equal_electrons(tmp_path):
    """One picture with 8 bits, 16 bits and floating-point numbers, in a directory, a zip file and memory."""
    picture = pictures(1)[0]
    deep, exact = picture.astype(np.uint16) * 257, (picture / 255.0).astype(np.float32)
    light = decode_srgb(exact).astype(np.float32)  # floating-point files are linear
    directory = tmp_path / "all"
    directory.mkdir()
    for name, numbers in (("1.png", picture), ("2.png", deep), ("3.tif", deep), ("4.tif", light), ("5.exr", light)):
        write_picture(directory / name, numbers)
    with zipfile.ZipFile(tmp_path / "all.zip", "w") as archive:
        for file in directory.iterdir():
            archive.write(file, file.name)

    for source in (directory, tmp_path / "all.zip", [picture, deep, deep, exact, exact]):
        found = [sample["expected_e"] for sample in explore.Dataset(source, SHOT, fields=("expected_e",))]
        assert len(found) == 5
        for each in found[1:]:
            np.testing.assert_allclose(each, found[0], rtol=1e-6)


def test_boxes_are_clipped_to_picture():
    boxes = [[-5, -5, N_X / 2, N_Y], [N_X + 10, 5, N_X + 20, 9], [-1e300, -1e300, 1e300, 1e300]]
    sample = explore.Dataset(pictures(1), SHOT, boxes=[boxes], fit="cover")[0]
    left = explore.Dataset(pictures(1), SHOT, boxes=[[[0, 0, N_X / 2, N_Y]]], fit="cover")[0]

    np.testing.assert_array_equal(sample["box_covers"][0], left["box_covers"][0])
    assert 0 < left["box_covers"].sum() < left["box_covers"].size
    assert not sample["box_covers"][1].any()
    assert sample["box_covers"][2].all()


def test_samples_contain_indices_of_choices():
    data = explore.Dataset(pictures(10), SHOT, VARY)
    choices = VARY["sensor.qe"]["choice"]

    for k in range(10):
        assert data.settings_of(k)["sensor"]["qe"] == choices[data[k]["settings"]["sensor.qe"]]


def test_code_dtype_follows_largest_bit_depth():
    data = explore.Dataset(pictures(4), SHOT, {"sensor.bits": {"choice": [8, 12]}})

    assert {sample["code"].dtype for sample in data} == {np.dtype(np.uint16)}
    assert explore.Dataset(pictures(1), SHOT)[0]["code"].dtype == np.uint8


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("name", ["data.zarr", "data"])
@pytest.mark.parametrize(
    "vary",
    [
        {"optics.f_number": {"choice": [2, 2.8, 4]}},
        {"sensor.read_noise_e": {"choice": [3, 0.5]}, "sensor.device_seed": {"choice": [2**63 - 1, 0, 7]}},
    ],
)
def test_stored_settings_are_exact(name, vary, tmp_path):
    """The type of the first number, integer or float, does not truncate the others."""
    is_integer_first = set()
    for seed in (0, 4, 5):
        data = explore.Dataset(pictures(6), SHOT, vary, seed=seed, fields=())
        stored, samples = explore.write_dataset(data, tmp_path / f"{seed}{name}"), list(data)
        assert len(samples) == 6
        for k, sample in enumerate(samples):
            assert_same(stored[k], sample)
            settings = data.settings_of(k)
            for path, number in sample["settings"].items():
                section, _, key = path.partition(".")
                assert number == settings[section][key]
                assert type(number) is type(samples[0]["settings"][path])
        section, _, key = next(iter(vary)).partition(".")
        is_integer_first.add(data.settings_of(0)[section][key] in (2, 3, 4))
    assert is_integer_first == {True, False}


# -- labels on the sensor ---------------------------------------------------------------------------------------------

GRID = fs.Grid.centred((11, 13), 4.0)
LENS = fs.distortion.BrownConrady(focal_um=60.0, k1=-0.25, p1=0.01, centre_um=(1.5, -2.0))


@pytest.fixture(scope="module")
def sites():
    """Return sites of irregular shapes, some of them partly outside the picture."""
    return fs.layout.voronoi(n_sites=40, size_um=(56.0, 46.0), seed=2)


def intersection_um2(sites, lens):
    """Compute the intersection area of each site and cell, (n_site, n_y, n_x), and the outlines, by shapely."""
    outlines = sites.polygons()
    if lens is not None:
        outlines = shapely.segmentize(outlines, 0.02)
        outlines = shapely.transform(outlines, lens.undistort)
    x, y = (GRID.origin_um[axis] + np.arange(GRID.shape[1 - axis] + 1) * GRID.pitch_um for axis in (0, 1))
    cells = shapely.box(*np.broadcast_arrays(x[:-1], y[:-1, np.newaxis], x[1:], y[1:, np.newaxis]))
    return shapely.area(shapely.intersection(outlines[:, np.newaxis, np.newaxis], cells)), outlines


@pytest.fixture(scope="module", params=[None, LENS], ids=["undistorted", "distorted"])
def reference(request, sites):
    areas_um2, outlines = intersection_um2(sites, request.param)
    return request.param, fs.Integrator(sites, GRID, distortion=request.param), areas_um2, outlines


def test_site_mask_is_class_with_largest_area(reference):
    _, integrator, areas_um2, outlines = reference
    mask = np.random.default_rng(0).integers(0, 4, GRID.shape)
    found = mask_on_sites(mask[::-1], integrator)
    of_class = np.stack([(areas_um2 * (mask == k)).sum(axis=(1, 2)) for k in range(4)])
    off_um2 = shapely.area(outlines) - areas_um2.sum(axis=(1, 2))
    all_um2 = np.concatenate((off_um2[np.newaxis], of_class))
    first, second = np.sort(all_um2, axis=0)[[-1, -2]]
    is_clear = first - second > 1e-4 * first

    assert is_clear.sum() >= 38
    assert (off_um2 > 0.01).sum() > 5
    np.testing.assert_array_equal(found[is_clear], all_um2.argmax(axis=0)[is_clear] - 1)
    assert -1 in found


@pytest.mark.parametrize("box_px", [(3, 2, 9, 10), (0, 0, 13, 11), (2.25, 1.5, 7.0, 8.125)])
def test_box_covers_sites_mostly_inside(reference, box_px):
    lens, integrator, _, outlines = reference
    x0, y1 = GRID.origin_um[0], GRID.bounds_um[3]
    left, top, right, bottom = box_px
    box = shapely.box(x0 + 4.0 * left, y1 - 4.0 * bottom, x0 + 4.0 * right, y1 - 4.0 * top)
    fraction = shapely.area(shapely.intersection(outlines, box)) / shapely.area(outlines)

    found = boxes_on_sites(np.array([box_px], float), integrator, lens)

    # Pixels on the boundary of a box count with a uniform fraction.
    is_clear = np.abs(fraction - 0.5) > (1e-4 if box_px == tuple(map(int, box_px)) else 0.1)
    assert is_clear.sum() > 30
    assert 5 < (fraction > 0.5).sum() <= 40
    np.testing.assert_array_equal(found.covers[0][is_clear], fraction[is_clear] > 0.5)
    boundary = shapely.get_coordinates(shapely.segmentize(box, 0.01).exterior)
    real = boundary if lens is None else lens.distort(boundary)
    np.testing.assert_allclose(found.box_um[0], [*real.min(axis=0), *real.max(axis=0)], atol=0.02)


def test_box_outside_image_circle_is_empty(sites):
    far = fs.Grid.centred((100, 100), 4.0)
    found = boxes_on_sites(
        np.array([[0.0, 0.0, 5.0, 5.0], [48.0, 48.0, 52.0, 52.0]]),
        fs.Integrator(sites, far, distortion=LENS),
        LENS,
    )

    assert not found.box_um[0].any()
    assert not found.covers[0].any()
    assert found.box_um[1].any()
    assert found.covers[1].any()


def test_site_flow_is_mean_over_pixels(reference):
    lens, integrator, areas_um2, _ = reference
    rng = np.random.default_rng(4)
    flow_px = rng.normal(size=(*GRID.shape, 2))
    flow_px[2:5, 3:6] = np.nan
    centres = np.stack(np.meshgrid(GRID.x_um, GRID.y_um), axis=-1)
    moves = flow_px[::-1] * [4.0, -4.0]
    if lens is not None:
        with np.errstate(invalid="ignore"):
            is_known = np.isfinite(moves).all(axis=-1, keepdims=True)
            moves = np.where(is_known, lens.distort(centres + np.nan_to_num(moves)) - lens.distort(centres), np.nan)
    known_um2 = areas_um2 * np.isfinite(moves[..., 0])
    sums = np.einsum("syx,yxk->sk", known_um2, np.nan_to_num(moves))

    found = flow_on_sites(flow_px, integrator, lens)

    area_um2 = known_um2.sum(axis=(1, 2))
    is_clear = area_um2 > 0.1
    assert is_clear.sum() > 30
    assert found.is_known[is_clear].all()
    np.testing.assert_allclose(found.flow_um[is_clear], sums[is_clear] / area_um2[is_clear, np.newaxis], atol=3e-3)
    assert not found.is_known[area_um2 == 0.0].any()
    assert np.isfinite(found.flow_um).all()


def test_labels_match_the_optical_image():
    """In a picture whose bright area is its mask and box, the bright sites have the labels."""
    bright = np.zeros((N_Y, N_X), np.uint8)
    bright[30:42, 36:70] = 255
    layout = {"generator": "grid", "parameters": {"n_x": 24, "n_y": 20, "pitch_um": 4.0}}
    data = explore.Dataset(
        [bright],
        SHOT | {"layout": layout, "distortion": BARREL, "exposure_s": 1e-4},
        masks=[bright // 255],
        boxes=[[[36, 30, 70, 42]]],
        flows=[np.full((N_Y, N_X, 2), [0.5, 0.25])],
        fields=("expected_e",),
    )
    sample = data[0]
    layout = data.layout
    is_bright = sample["expected_e"] / layout.area_um2 > 0.5 * (sample["expected_e"] / layout.area_um2).max()
    centroids = layout.centroid_um[is_bright]
    inside = np.all(
        (layout.centroid_um > sample["box_um"][0, :2]) & (layout.centroid_um < sample["box_um"][0, 2:]), axis=1
    )

    # Blur affects sites along the edges.
    assert (sample["mask"] == 1).sum() > 50
    assert np.mean(is_bright == (sample["mask"] == 1)) > 0.97
    np.testing.assert_array_equal(sample["box_covers"][0], sample["mask"] == 1)
    assert np.all(inside[sample["mask"] == 1])
    assert centroids[:, 1].mean() > 0.0  # upper half of the picture
    assert sample["flow_um"][:, 0].min() > 0.0 > sample["flow_um"][:, 1].max()


def test_samples_are_finite_outside_picture():
    # The radius r (1 + k1 (r / f)²) is at most 2 r / 3 = 30 µm, at (r / f)² = -1 / (3 k1).
    narrow = {"kind": "brown_conrady", "focal_um": FOCAL_UM, "k1": -((FOCAL_UM / 45.0) ** 2) / 3.0}
    shot = SHOT | {"scene": SHOT["scene"] | {"pitch_um": 120.0}, "distortion": narrow}
    flows = np.full((1, N_Y, N_X, 2), np.nan)
    with pytest.warns(CoverageWarning, match="sample 0: .*photosites lie"):
        sample = explore.Dataset(
            pictures(1), shot, masks=np.zeros((1, N_Y, N_X), int), boxes=[[[0, 0, 5, 5]]], flows=flows
        )[0]

    assert "photosites lie" in sample["warning"]
    assert (sample["mask"] == -1).any()
    assert not sample["flow_known"].any()
    assert all(np.isfinite(value).all() for value in sample.values() if isinstance(value, np.ndarray))


@pytest.mark.parametrize(("fit", "is_covered"), [("cover", True), ("contain", False)])
def test_fit_scales_pictures_to_layout(fit, is_covered):
    wide, high = np.full((24, 90, 3), 200, np.uint8), np.full((90, 24, 3), 200, np.uint8)
    shot = SHOT | {"optics": {"focal_length_mm": 8.0, "f_number": 1.0}}
    data = explore.Dataset([wide, high], shot, masks=[wide[..., 0] // 200, high[..., 0] // 200], fit=fit)
    if is_covered:
        assert all((sample["mask"] == 1).all() for sample in data)
        return
    assert all((sample["mask"] == -1).any() for sample in data)
    x0, y0, x1, y1 = data.layout.bounds_um
    for k, half_um in enumerate((min(-x0, x1), min(-y0, y1))):
        grid = data.shot(k).camera.image_grid(data.shot(k).scene)
        assert 90 * grid.pitch_um / 2 == pytest.approx(half_um)


def test_fit_follows_random_lens():
    vary = {"optics.focal_length_mm": {"uniform": [4.0, 16.0]}}
    data = explore.Dataset(pictures(1), SHOT, vary, cameras=3, fit="width")
    x0, _, x1, _ = data.layout.bounds_um

    pitches_um = [data.shot(k).camera.fit_scene(data.shot(k).scene).pitch_um for k in range(3)]
    assert len(set(pitches_um)) == 3
    for k in range(3):
        assert data.shot(k).camera.image_grid(data.shot(k).scene).pitch_um * N_X == pytest.approx(x1 - x0)


def test_fit_of_shot_is_that_of_dataset():
    scene = {key: value for key, value in SHOT["scene"].items() if key != "pitch_um"}
    shots = [SHOT | {"scene": scene | {"fit": "contain"}}, SHOT]
    by_shot, by_dataset = (
        explore.Dataset(pictures(1), shot, fit=fit)[0] for shot, fit in zip(shots, (None, "contain"), strict=True)
    )

    np.testing.assert_array_equal(by_shot["code"], by_dataset["code"])


# -- picture sources --------------------------------------------------------------------------------------------------


class Lazy:
    """Sequence of pictures other than a list, as one that computes its items on access."""

    def __init__(self, items):
        self.items = items

    def __len__(self):
        return len(self.items)

    def __getitem__(self, k):
        return self.items[k]


def class_directories(tmp_path):
    for k, (name, picture) in enumerate(zip(("b/2.png", "a/10.png", "a/9.png", "b/1.png"), pictures(4), strict=True)):
        path = tmp_path / "pictures" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture).save(path)
        (path.parent / "notes.txt").write_text(str(k))
    (tmp_path / "pictures" / "a" / ".9.png").write_text("hidden")
    return tmp_path / "pictures"


def test_samples_do_not_depend_on_source_kind(tmp_path):
    directory = class_directories(tmp_path)
    names = ["a/9.png", "a/10.png", "b/1.png", "b/2.png"]
    archive = tmp_path / "pictures.zip"
    with zipfile.ZipFile(archive, "w") as file:
        for name in reversed(names):
            file.write(directory / name, name)
    stack = pictures(4)[[2, 1, 3, 0]]
    np.save(tmp_path / "stack.npy", stack)
    classes = ["a", "a", "b", "b"]
    paired = [(Image.open(directory / name), label) for name, label in zip(names, classes, strict=True)]
    datasets = {
        "directory": explore.Dataset(directory, SHOT, VARY),
        "zip": explore.Dataset(archive, SHOT, VARY),
        "files": explore.Dataset([directory / name for name in names], SHOT, VARY, labels=classes),
        "pairs": explore.Dataset(paired, SHOT, VARY),
        "array": explore.Dataset(stack, SHOT, VARY, labels=classes),
        "npy": explore.Dataset(tmp_path / "stack.npy", SHOT, VARY, labels=classes),
    }

    for data in datasets.values():
        assert data.class_names == ["a", "b"]
        again = pickle.loads(pickle.dumps(data)) if data is not datasets["pairs"] else data
        for k in range(4):
            assert_same(again[k], datasets["directory"][k])
    assert [sample["label"] for sample in datasets["zip"]] == [0, 0, 1, 1]


def test_pictures_are_in_natural_order(tmp_path):
    names = ["a1.png", "a.png", "001.png", "01.png", "1.png", "1a.png", "2.png", "10.png"]
    names += [f"{'9' * 5000}.png", f"1{'0' * 5000}.png", "²3.png", "٣.png"]
    order = sorted(names, key=lambda name: (name[0] in "0123456789", names.index(name)))
    Image.fromarray(pictures(1)[0]).save(tmp_path / "a.png")
    for seed in range(5):
        archive = tmp_path / f"{seed}.zip"
        with zipfile.ZipFile(archive, "w") as file:
            for k in np.random.default_rng(seed).permutation(len(names)):
                file.write(tmp_path / "a.png", names[k])
        source = source_of(archive)
        assert [source.key(k) for k in range(len(source))] == order
    (tmp_path / "directory").mkdir()
    short = [name for name in order if len(name) < 99]
    for name in reversed(short):
        Image.fromarray(pictures(1)[0]).save(tmp_path / "directory" / name)
    source = source_of(tmp_path / "directory")
    assert [source.key(k) for k in range(len(source))] == short


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_duplicate_zip_member_is_one_picture(tmp_path):
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        for picture in pictures(2):
            Image.fromarray(picture).save(tmp_path / "a.png")
            archive.write(tmp_path / "a.png", "a.png")
    data = explore.Dataset(tmp_path / "x.zip", SHOT)

    assert len(data) == 1
    np.testing.assert_array_equal(data[0]["code"], explore.Dataset(pictures(2)[1:], SHOT)[0]["code"])


ROTATED = Image.Exif()
ROTATED[274] = 6  # EXIF orientation: rotated by 90 degrees


@pytest.mark.parametrize(
    ("extension", "convert", "exif"),
    [
        ("png", lambda image: image.quantize(16), None),
        ("png", lambda image: image.convert("1"), None),
        ("png", lambda image: image.convert("LA"), None),
        ("png", lambda image: Image.fromarray(np.asarray(image.convert("L")).astype(np.uint16) * 255), None),
        ("png", lambda image: image, ROTATED),
        ("jpg", lambda image: image, ROTATED),
        ("tif", lambda image: image, ROTATED),
    ],
    ids=["palette", "1", "LA", "16 bits", "rotated PNG", "rotated JPEG", "rotated TIFF"],
)
def test_pillow_image_equals_its_file(extension, convert, exif, tmp_path):
    image, file = convert(Image.fromarray(pictures(1)[0])), tmp_path / f"a.{extension}"
    image.save(file, **({} if exif is None else {"exif": exif}))
    opened = Image.open(file)
    opened.load()
    of_file = explore.Dataset([file], SHOT)[0]

    assert_same(explore.Dataset([Image.open(file)], SHOT)[0], of_file)
    assert_same(explore.Dataset([opened], SHOT)[0], of_file)
    assert_same(pickle.loads(pickle.dumps(explore.Dataset([opened], SHOT)))[0], of_file)
    assert_same(explore.Dataset(Lazy([Image.open(file)]), SHOT)[0], of_file)


@pytest.mark.parametrize("mode", ["HSV", "YCbCr", "RGBX"])
def test_pillow_colour_modes_are_converted(mode):
    """Black and white are exact in all modes."""
    grey = np.repeat(pictures(1)[0][..., :1] // 128 * 255, 3, axis=2).astype(np.uint8)

    assert_same(explore.Dataset([Image.fromarray(grey).convert(mode)], SHOT)[0], explore.Dataset([grey], SHOT)[0])


def test_truncated_pillow_image_is_rejected(tmp_path):
    Image.fromarray(pictures(1)[0]).save(tmp_path / "a.png")
    complete = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(complete[: len(complete) // 2])

    with (
        Image.open(tmp_path / "a.png") as image,
        pytest.raises(FileError, match="picture 0: is not a readable image") as caught,
    ):
        explore.Dataset([image], SHOT)
    assert "\n" not in str(caught.value)


def test_palette_mask_gives_indices(tmp_path):
    image = Image.fromarray(np.full((N_Y, N_X), 3, np.uint8), mode=None).convert("P")
    image.putpalette([200, 10, 10] * 256)
    image.putdata([3] * (N_Y * N_X))
    image.save(tmp_path / "mask.png")

    sample = explore.Dataset(pictures(1), SHOT, masks=[tmp_path / "mask.png"])[0]

    assert set(sample["mask"].tolist()) == {3}


# -- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["data.zarr", "data"])
@pytest.mark.parametrize("workers", [1, 2])
def test_stored_samples_equal_simulated_samples(name, workers, tmp_path):
    data = labelled()
    progress = []

    stored = explore.write_dataset(
        data, tmp_path / name, per_shard=3, workers=workers, progress=lambda *counts: progress.append(counts)
    )

    assert len(stored) == len(data)
    for k in range(len(data)):
        assert_same(stored[k], data[k])
    assert_same(pickle.loads(pickle.dumps(stored))[-1], data[-1])
    assert progress[0] == (0, 20)
    assert progress[-1] == (20, 20)
    assert stored.class_names == ["bird", "cat", "dog"]
    assert stored.about["plan"]["seed"] == 7
    assert stored.about["plan"]["settings"]["sensor"]["read_noise_e"] == 2.0
    assert stored.about["plan"]["versions"]["foveasim"] == fs.__version__
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.slow
def test_tar_shards_do_not_depend_on_workers(tmp_path):
    for workers in (1, 2):
        explore.write_dataset(labelled(), tmp_path / f"data{workers}", per_shard=6, workers=workers)
    shards = sorted(p.name for p in (tmp_path / "data1").glob("*.tar"))

    assert shards == [f"shard-{k:06d}.tar" for k in range(4)]
    for name in shards:
        assert (tmp_path / "data1" / name).read_bytes() == (tmp_path / "data2" / name).read_bytes()
    with tarfile.open(tmp_path / "data1" / shards[1]) as tar:
        assert tar.getnames()[:4] == ["__made_of__", "000000006.npz", "000000006.json", "000000006.cls"]
        about = json.load(tar.extractfile("000000007.json"))
        assert about["label"] == int(tar.extractfile("000000007.cls").read()) == labelled()[7]["label"]
    assert fs.read_layout(tmp_path / "data1" / "layout.npz").n_sites == labelled().layout.n_sites


@pytest.mark.parametrize(("n", "n_shards"), [(1, 1), (5, 1), (20, 3)])
@pytest.mark.parametrize("name", ["data", "data.zarr"])
def test_small_datasets_have_few_shards(tmp_path, name, n, n_shards):
    data = explore.Dataset(list(pictures(1)), SHOT, draws=n)
    explore.write_dataset(data, tmp_path / name)
    stored = explore.open_dataset(tmp_path / name)

    assert len(stored) == n
    assert stored.about["per_shard"] == min(n, 8)
    if name == "data":
        assert len(list((tmp_path / name).glob("*.tar"))) == n_shards
    assert all((stored[k]["code"] == data[k]["code"]).all() for k in (0, n - 1))


@pytest.mark.parametrize(
    ("n_samples", "n_bytes", "per_shard"),
    [
        (3, 1000, 3),
        (100, 1000, 8),
        (256, 1000, 8),
        (3200, 1000, 96),
        (10**6, 1000, 512),
        (10**6, 2**20, 64),
        (100, 2**25, 2),
        (100, 2**30, 1),
    ],
)
def test_default_shards_follow_sizes(n_samples, n_bytes, per_shard):
    assert store._default_per_shard(n_samples, n_bytes) == per_shard


def test_zarr_store_contains_layout_and_settings(tmp_path):
    zarr = pytest.importorskip("zarr")
    data = explore.Dataset(pictures(2), SHOT, VARY)
    explore.write_dataset(data, tmp_path / "data.zarr")
    group = zarr.open_group(str(tmp_path / "data.zarr"), mode="r")
    layout = fs.Layout(*(group[f"layout/{name}"][:] for name in ("xy_um", "ring_offsets", "site_offsets")))

    np.testing.assert_array_equal(layout.area_um2, data.layout.area_um2)
    np.testing.assert_array_equal(group["settings/exposure_s"][:], [s["settings"]["exposure_s"] for s in data])


@pytest.mark.parametrize("name", ["data", "data.zarr"])
def test_million_samples_need_little_memory(name, tmp_path):
    data = explore.Dataset(pictures(4), SHOT, VARY, draws=250_000, labels=[0, 1, 0, 1])

    def stop(n_done, n):
        assert (n_done, n) == (0, 10**6)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        explore.write_dataset(data, tmp_path / name, progress=stop)
    with pytest.raises(FileError, match=r"has 0 of 1954 shards"):
        explore.open_dataset(tmp_path / name)

    assert sum(1 for _ in (tmp_path / name).rglob("*")) < 100
    assert len(pickle.dumps(data)) < pictures(4).nbytes + 20_000
    assert data[10**6 - 1]["label"] == 1


def test_zarr_arrays_have_dimensions_and_units(tmp_path):
    xarray = pytest.importorskip("xarray")
    data = labelled(2)
    explore.write_dataset(data, tmp_path / "data.zarr")
    stored = xarray.open_zarr(tmp_path / "data.zarr", consolidated=False)

    assert stored["code"].dims == ("sample", "site")
    assert stored["box_covers"].dims == ("sample", "box", "site")
    assert stored["electrons"].attrs["units"] == "e-"
    assert stored["flow_um"].attrs["units"] == "µm"
    np.testing.assert_array_equal(stored["flow_um"][3], data[3]["flow_um"])


@pytest.mark.parametrize("per_shard", [4, 7, 16])
def test_zarr_samples_are_in_one_file(per_shard, tmp_path):
    explore.write_dataset(explore.Dataset(pictures(2), SHOT, draws=8), tmp_path / "data.zarr", per_shard=per_shard)

    files = [path for path in (tmp_path / "data.zarr" / "electrons" / "c").rglob("*") if path.is_file()]

    assert len(files) == -(-16 // per_shard)


def test_former_zarr_layout_is_rejected(tmp_path):
    data = explore.Dataset(pictures(1), SHOT)
    explore.write_dataset(data, tmp_path / "data.zarr")
    metadata = tmp_path / "data.zarr" / "zarr.json"
    about = json.loads(metadata.read_text())
    about["attributes"]["version"] = 2
    metadata.write_text(json.dumps(about))

    for call in (explore.open_dataset, partial(explore.write_dataset, data)):
        with pytest.raises(FileError, match=r"has the format version 2, expected 3; write the dataset again$"):
            call(tmp_path / "data.zarr")


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("code/zarr.json", '"zstd"', '"gzip"', "is corrupt"),
        ("code/zarr.json", "{", "[", "is corrupt"),
        ("code/zarr.json", '"index_location": "end"', '"index_location": "start"', "is corrupt .*another chunk layout"),
        ("zarr.json", '"items"', '"others"', "is corrupt: it does not describe the items"),
        ("zarr.json", '"electrons": {', '"electrons_": {', "is corrupt .*electrons_"),
    ],
)
def test_corrupt_zarr_metadata_are_one_line(file, old, new, message, tmp_path):
    data = explore.Dataset(pictures(2), SHOT)
    explore.write_dataset(data, tmp_path / "data.zarr")
    path = tmp_path / "data.zarr" / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))

    for call in (explore.open_dataset, partial(explore.write_dataset, data)):
        with pytest.raises(FileError, match=message) as caught:
            call(tmp_path / "data.zarr")
        assert "\n" not in str(caught.value)


def test_missing_zarr_shard_is_corrupt_sample(tmp_path):
    stored = explore.write_dataset(explore.Dataset(pictures(3), SHOT), tmp_path / "data.zarr", per_shard=1)
    (tmp_path / "data.zarr" / "code" / "c" / "1" / "0").unlink()

    assert stored[0]["code"].shape == (72,)
    with pytest.raises(FileError, match="has a corrupt sample 1"):
        stored[1]


def test_only_tar_shards_support_varied_layouts(tmp_path):
    vary = {"layout.parameters.pitch_um": {"uniform": [5.0, 7.0]}, "layout.parameters.n_rows": {"integers": [6, 9]}}
    data = explore.Dataset(pictures(5), SHOT | {"scene": SHOT["scene"] | {"pitch_um": 200.0}}, vary)

    stored = explore.write_dataset(data, tmp_path / "data", per_shard=2)

    assert len({sample["code"].size for sample in stored}) > 1
    with pytest.raises(ParameterError, match="'layout' must not vary in a zarr store"):
        explore.write_dataset(data, tmp_path / "data.zarr")
    with pytest.raises(ParameterError, match="'layout' must be equal in all samples"):
        _ = data.layout


def corrupt_directory(tmp_path):
    """Write six pictures, of which the fifth is truncated; return the directory and its complete contents."""
    directory = tmp_path / "pictures"
    directory.mkdir()
    for k, picture in enumerate(pictures(6)):
        Image.fromarray(picture).save(directory / f"{k}.png")
    complete = (directory / "4.png").read_bytes()
    (directory / "4.png").write_bytes(complete[: len(complete) // 2])
    return directory, complete


@pytest.mark.slow
@pytest.mark.parametrize(("name", "workers"), [("data.zarr", 2), ("data", 1)])
def test_writing_resumes_after_corrupt_picture(name, workers, tmp_path):
    directory, complete = corrupt_directory(tmp_path)
    target = tmp_path / name
    done = (
        (lambda: {p: p.stat().st_mtime_ns for p in target.glob("code/c/*/0")})
        if name.endswith("zarr")
        else (lambda: {p: p.stat().st_mtime_ns for p in target.glob("*.tar")})
    )
    with pytest.raises(FileError, match=r"4\.png: is corrupt or truncated"):
        explore.write_dataset(explore.Dataset(directory, SHOT, VARY), target, per_shard=1, workers=workers)
    before = done()
    with pytest.raises(FileError, match=r"has \d of 6 shards; write the same dataset again to resume"):
        explore.open_dataset(target)
    (directory / "4.png").write_bytes(complete)
    data = explore.Dataset(directory, SHOT, VARY)

    stored = explore.write_dataset(data, target, workers=workers)

    assert len(before) >= 4 if workers == 1 else len(before) >= 1
    assert before.items() <= done().items()
    for k in range(6):
        assert_same(stored[k], data[k])


#: Writes datasets with a number of workers, one after another, each in a process of its own that ends at the sixth picture.
ENDED_PROGRAM = """
import json, os, sys
import numpy as np
from foveasim import explore
class Pictures:
    def __len__(self):
        return 8
    def __getitem__(self, k):
        if k == 5:
            os._exit(9)
        return np.random.default_rng(k).integers(0, 256, (40, 48, 3), np.uint8)
if __name__ == '__main__':
    shot = json.loads(sys.argv[1])
    for workers, path in (each.split("=") for each in sys.argv[2:]):
        if (process := os.fork()) == 0:
            explore.write_dataset(explore.Dataset(Pictures(), shot), path, per_shard=2, workers=int(workers))
            os._exit(0)
        print(path, os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)
"""


@pytest.mark.slow
def test_crash_leaves_only_complete_shards(tmp_path):
    script = tmp_path / "write.py"
    script.write_text(ENDED_PROGRAM)
    both = [str(tmp_path / "data.zarr"), str(tmp_path / "data")]
    written = [f"1={both[0]}", f"1={both[1]}", f"2={both[1]}"]
    command = [sys.executable, str(script), json.dumps(SHOT), *written]
    lost = subprocess.run(command, check=False, capture_output=True, text=True, timeout=DEADLINE_S)

    assert lost.stdout.splitlines()[:2] == [f"{path} 9" for path in both]
    assert "SimulationError: the process that wrote shard 2 ended in every attempt" in lost.stderr
    source = Lazy([np.random.default_rng(k).integers(0, 256, (40, 48, 3), np.uint8) for k in range(8)])
    data = explore.Dataset(source, SHOT)
    for path in map(Path, both):
        shards = [file for file in path.rglob("*") if file.suffix == ".tar" or file.parent.parent.name == "c"]
        before = {file: file.stat().st_mtime_ns for file in shards}
        stored = explore.write_dataset(data, path, per_shard=2)
        assert before
        assert all(file.stat().st_mtime_ns == written for file, written in before.items())
        for k in range(8):
            assert_same(stored[k], data[k])


@pytest.mark.slow
def test_worker_processes_end_with_program(tmp_path):
    script = tmp_path / "write.py"
    script.write_text(
        "import json, multiprocessing, sys, time\n"
        "import numpy as np\n"
        "from foveasim import explore\n"
        "class Pictures:\n"
        "    def __len__(self):\n"
        "        return 8\n"
        "    def __getitem__(self, k):\n"
        "        if multiprocessing.parent_process() is not None:\n"
        "            print('begun', flush=True)\n"
        "            time.sleep(400)\n"
        "        return np.zeros((40, 48, 3), np.uint8)\n"
        "if __name__ == '__main__':\n"
        "    explore.write_dataset(explore.Dataset(Pictures(), json.loads(sys.argv[1])), sys.argv[2], workers=2)\n"
    )
    (tmp_path / "temporary").mkdir()
    running = subprocess.Popen(
        [sys.executable, str(script), json.dumps(SHOT), str(tmp_path / "data")],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"TMPDIR": str(tmp_path / "temporary")},
    )
    try:
        assert running.stdout.readline() == "begun\n"
    finally:
        running.kill()

    # The pipe closes when all processes that can write to it have ended.
    running.communicate(timeout=240)

    # The scratch directory of dask, which its next start removes, is empty.
    assert [path for path in (tmp_path / "temporary").rglob("*") if path.is_file() and path.stat().st_size] == []


class Unpicklable(Lazy):
    """Pictures that cannot be unpickled in another process."""

    def __setstate__(self, state):
        raise ValueError("cannot be unpickled")


@pytest.mark.slow
def test_unpicklable_pictures_are_rejected(tmp_path):
    local = Lazy(pictures(4))
    local.key = threading.Lock()
    for source, message in (
        (local, r"the pictures or labels cannot be sent to other processes \(.*\)"),
        (Unpicklable(pictures(4)), r"the workers cannot compute: cannot be unpickled"),
    ):
        data = explore.Dataset(source, SHOT)
        with pytest.raises(SimulationError, match=message) as caught:
            explore.write_dataset(data, tmp_path / "data", workers=2)
        assert "\n" not in str(caught.value)
    assert_same(explore.write_dataset(data, tmp_path / "data")[3], data[3])


def test_processes_start_only_for_long_tasks(tmp_path, monkeypatch):
    started = []

    @contextmanager
    def recording_executor(write, **options):
        def run(left, _cuts):
            started.append((len(left), options["workers"]))
            return ((k, write(k)) for k in left)

        yield run

    monkeypatch.setattr(store, "executor", recording_executor)
    monkeypatch.setattr(store, "thread_count", lambda: 5)
    data = explore.Dataset(pictures(6), SHOT)
    for name, alone_s, found in (("short", 1e6, []), ("long", 0.0, [(5, 5)])):
        monkeypatch.setattr(store, "SINGLE_PROCESS_S", alone_s)
        stored = explore.write_dataset(data, tmp_path / name, per_shard=1, workers=None)
        assert started == found
        assert_same(stored[5], data[5])


@pytest.mark.parametrize("name", ["data.zarr", "data"])
def test_full_disk_leaves_no_corrupt_shard(name, tmp_path, monkeypatch):
    """A file size limit of the operating system simulates a full disk."""
    # Bytecode of modules that are imported under the limit would be incomplete for all later programs.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    rng = np.random.default_rng(0)
    layout = {"generator": "grid", "parameters": {"n_x": 90, "n_y": 90, "pitch_um": 1.0}}
    data = explore.Dataset(
        rng.integers(0, 256, (4, 100, 100, 3), np.uint8), SHOT | {"layout": layout}, fields=("electrons",), fit="cover"
    )
    data[0]
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (9_000, usual[1]))
    try:
        with pytest.raises(FileError, match="cannot be written: File too large"):
            explore.write_dataset(data, tmp_path / name, per_shard=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)

    stored = explore.write_dataset(data, tmp_path / name, per_shard=1)

    for k in range(4):
        assert_same(stored[k], data[k])
    assert not list(tmp_path.rglob(".foveasim*"))


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="a system without POSIX permissions")
def test_missing_permissions_are_reported():
    """Root switches to an unprivileged user for this test."""
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)  # accessible to other users, unlike the temporary directories of pytest
        directory.chmod(0o777)
        data = explore.Dataset(pictures(2), SHOT)
        for kind in ("a", "a.zarr"):
            explore.write_dataset(data, directory / kind, per_shard=1)
        (directory / "a" / "shard-000001.tar").unlink()
        pytest.importorskip("zarr").open_group(str(directory / "a.zarr"), mode="r+")["done"][1] = 0
        (directory / "pictures" / "closed").mkdir(parents=True)
        Image.fromarray(pictures(1)[0]).save(directory / "pictures" / "1.png")
        closed = [
            directory / "pictures" / "closed",
            *(p for p in (directory / "a.zarr").rglob("*") if p.is_dir()),
            directory / "a",
        ]
        for path in closed:
            path.chmod(0o000 if path.name == "closed" else 0o555)
        try:
            os.seteuid(os.getuid() or 65534)
            for call, message in (
                (lambda: explore.write_dataset(data, directory / "a"), "tar: cannot be written: Permission denied"),
                (
                    lambda: explore.write_dataset(data, directory / "a.zarr"),
                    "zarr: cannot be written: Permission denied",
                ),
                (
                    lambda: explore.write_dataset(data, closed[0] / "a"),
                    "closed/a: cannot be written: Permission denied",
                ),
                (lambda: explore.open_dataset(closed[0] / "a"), "closed/a: cannot be read: Permission denied"),
                (lambda: explore.Dataset(directory / "pictures", SHOT), "closed: cannot be read: Permission denied"),
                (lambda: explore.Dataset(closed[0] / "a", SHOT), "closed/a: cannot be read: Permission denied"),
            ):
                with pytest.raises(FileError, match=message) as caught:
                    call()
                assert "\n" not in str(caught.value)
        finally:
            os.seteuid(os.getuid())
            for path in closed:
                path.chmod(0o755)


def test_other_stores_are_unchanged(tmp_path):
    data = explore.Dataset(pictures(2), SHOT, VARY)
    explore.write_dataset(data, tmp_path / "data", per_shard=1)
    (tmp_path / "other").mkdir()
    (tmp_path / "other.zarr").write_text("text")
    for other, path, message in (
        (explore.Dataset(pictures(2), SHOT, VARY, seed=1), "data", "is another dataset: its 'seed' differs"),
        (explore.Dataset(pictures(3), SHOT, VARY), "data", "its 'pictures' differs"),
        (data, "other", "is not a dataset of foveasim"),
        (data, "other.zarr", "is not a dataset of foveasim"),
        (data, "data.hdf", "must have the extension .zarr, or none"),
        (data, "missing/data", "cannot be written: the directory .*missing does not exist"),
        (data, "data/shard-000000.tar/x", "cannot be written: the directory .* does not exist"),
    ):
        with pytest.raises(FileError, match=message):
            explore.write_dataset(other, tmp_path / path)
    with pytest.raises(FileError, match="its 'per_shard' differs"):
        explore.write_dataset(data, tmp_path / "data", per_shard=2)
    (tmp_path / "data" / "shard-000001.tar").write_bytes(b"truncated")
    with pytest.raises(FileError, match="has a corrupt sample 1"):
        explore.open_dataset(tmp_path / "data")[1]
    with pytest.raises(FileError, match="no such directory"):
        explore.open_dataset(tmp_path / "nothing")


def zipped(path, each):
    with zipfile.ZipFile(path, "w") as archive:
        for k, picture in enumerate(each):
            Image.fromarray(picture).save(path.with_suffix(".png"))
            archive.write(path.with_suffix(".png"), f"{k}.png")
    return path


def saved(path, each):
    np.save(path, each)
    return path


def directory_of(path, each):
    path.mkdir(exist_ok=True)
    for k, picture in enumerate(each):
        Image.fromarray(picture).save(path / f"{k}.png")
    return path


def files_of(path, each):
    directory_of(path, each)
    return [path / f"{k}.png" for k in range(len(each))]


#: Functions that create a dataset from pictures, by kind of the container.
CONTAINERS = {
    "array": lambda _, each: explore.Dataset(each, SHOT),
    "list": lambda _, each: explore.Dataset(list(each), SHOT),
    "Pillow": lambda _, each: explore.Dataset([Image.fromarray(picture) for picture in each], SHOT),
    "pairs": lambda _, each: explore.Dataset([(picture, 3) for picture in each], SHOT),
    "lazy": lambda _, each: explore.Dataset(Lazy(each), SHOT),
    "array file": lambda path, each: explore.Dataset(saved(path / "x.npy", each), SHOT),
    "directory": lambda path, each: explore.Dataset(directory_of(path / "x", each), SHOT),
    "files": lambda path, each: explore.Dataset(files_of(path / "x", each), SHOT),
    "zip": lambda path, each: explore.Dataset(zipped(path / "x.zip", each), SHOT),
    "masks": lambda _, each: explore.Dataset(pictures(4), SHOT, masks=each[..., 0]),
    "mask files": lambda path, each: explore.Dataset(pictures(4), SHOT, masks=files_of(path / "x", each[..., 0])),
    "lazy masks": lambda _, each: explore.Dataset(pictures(4), SHOT, masks=Lazy(each[..., 0])),
    "flows": lambda _, each: explore.Dataset(pictures(4), SHOT, flows=list(each[..., :2])),
}


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("container", CONTAINERS)
def test_changed_inputs_are_rejected(container, tmp_path):
    """Complete shards of changed inputs are not overwritten; missing shards use the current inputs."""
    make = partial(CONTAINERS[container], tmp_path)
    each = pictures(4)
    changed = np.array(each)
    changed[3] ^= 1
    target = tmp_path / "data"
    explore.write_dataset(make(each), target, per_shard=2)
    before = (target / "shard-000001.tar").read_bytes()
    other = make(changed)

    with pytest.raises(
        FileError, match="was written from other pictures, masks or flows: those of samples 2 to 3 have changed"
    ):
        explore.write_dataset(other, target)
    assert (target / "shard-000001.tar").read_bytes() == before
    (target / "shard-000001.tar").unlink()
    stored = explore.write_dataset(other, target)

    for k in range(4):
        assert_same(stored[k], other[k])
    explore.write_dataset(other, target)


def test_changed_inputs_are_rejected_in_zarr(tmp_path):
    explore.write_dataset(explore.Dataset(list(pictures(4)), SHOT), tmp_path / "data.zarr", per_shard=2)

    with pytest.raises(FileError, match="those of samples 0 to 1 have changed"):
        explore.write_dataset(explore.Dataset(list(pictures(4, 1)), SHOT), tmp_path / "data.zarr")


def test_corrupt_shard_is_rewritten(tmp_path):
    data = explore.Dataset(pictures(2), SHOT)
    explore.write_dataset(data, tmp_path / "data", per_shard=1)
    (tmp_path / "data" / "shard-000001.tar").write_bytes(b"truncated")

    assert_same(explore.write_dataset(data, tmp_path / "data")[1], data[1])


class UnclosedFiles(Lazy):
    """Pictures that cause a ResourceWarning on access, as unclosed files do."""

    def __getitem__(self, k):
        warnings.warn("unclosed file", ResourceWarning, stacklevel=2)
        return super().__getitem__(k)


def test_resource_warnings_are_not_stored():
    with pytest.warns(ResourceWarning):
        data = explore.Dataset(UnclosedFiles(pictures(3)), SHOT)

    assert {sample["warning"] for sample in data} == {""}


def test_sample_warnings_are_summarised_and_stored(tmp_path):
    shot = SHOT | {"scene": SHOT["scene"] | {"pitch_um": 70.0}}
    with pytest.warns(FoveasimWarning, match="3 of the samples written have warnings, such as: sample 0: ") as caught:
        stored = explore.write_dataset(explore.Dataset(pictures(3), shot), tmp_path / "data.zarr")

    assert len(caught) == 1
    assert all("photosites lie" in sample["warning"] for sample in stored)


# -- invalid input ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("vary", "error", "message"),
    [
        ({"optics.speed": {"uniform": [1, 2]}}, ConfigError, "^vary.optics.speed: unknown parameter of Optics"),
        ({"exposure_s": [1, 2]}, ParameterError, "'exposure_s' must have exactly one distribution"),
        ({"exposure_s": {"gamma": [1, 2]}}, ParameterError, "must have exactly one distribution"),
        ({"exposure_s": {"uniform": [2, 1]}}, ParameterError, "must have 'uniform' bounds in ascending order"),
        ({"exposure_s": {"uniform": [1]}}, ParameterError, r"must specify 'uniform' as \[low, high\]"),
        ({"exposure_s": {"uniform": "ab"}}, ParameterError, r"must specify 'uniform' as \[low, high\], got 'ab'"),
        ({"exposure_s": {"log_uniform": [0, 1]}}, ParameterError, "must be > 0"),
        ({"exposure_s": {"uniform": [0, float("inf")]}}, ParameterError, "must be finite"),
        ({"exposure_s": {"normal": [5, 1, 0, 1]}}, ParameterError, "a mean between the bounds"),
        ({"exposure_s": {"uniform": [0, 1], "weights": [1]}}, ParameterError, "must not have weights with 'uniform'"),
        ({"sensor.bits": {"choice": []}}, ParameterError, "must have at least one choice"),
        ({"sensor.bits": {"choice": [8, 9], "weights": [1]}}, ParameterError, "must have 2 weights"),
        ({"sensor.bits": {"choice": [8, 9], "weights": [1e308, 1e308]}}, ParameterError, "with a finite sum > 0"),
        ({"sensor.bits": {"choice": [8, 9], "weights": [-1, 2]}}, ParameterError, "must be >= 0"),
        ({"sensor.bits": {"choice": [8, 9], "weights": "ab"}}, ParameterError, "must be an array of numbers"),
        ({"sensor.bits": {"choice": 8}}, ParameterError, "must specify 'choice' as a list of values, got 8"),
        (
            {"sensor.device_seed": {"choice": [2**70, 1]}},
            ParameterError,
            "must have signed 64-bit integers as choices, got 1180591620717411303424",
        ),
        ({"exposure_s": {"choice": [0.1, float("nan")]}}, ParameterError, "'exposure_s' must be finite, got nan"),
        ({"exposure_s": {"uniform": [-1e308, 1e308]}}, ParameterError, "bounds with a finite difference"),
        ({"exposure_s": {"uniform": [None, 1]}}, ParameterError, "must be one number, got None"),
        ({"exposure_s": {"uniform": [True, 2]}}, ParameterError, "must be one number, got True"),
        ({"exposure_s": {"uniform": [[1, 2], [3, 4]]}}, ParameterError, r"must be one number, got \[1, 2\]"),
        ({"exposure_s": {"uniform": {1, 2}}}, ParameterError, r"must specify 'uniform' as \[low, high\]"),
        ({"exposure_s": {"uniform": [1, 2], "integers": [1, 2]}}, ParameterError, "exactly one distribution"),
        ({"exposure_s": {"normal": [1, 0, 0, 2]}}, ParameterError, "a standard deviation > 0"),
        ({"exposure_s": {"normal": [1, 1e300, 0, 2]}}, ParameterError, r"of at most 1e\+06 \* \(high - low\)"),
        ({"exposure_s": {"uniform": b"ab"}}, ParameterError, r"must specify 'uniform' as \[low, high\]"),
        ({"exposure_s": {"integers": [1, 2.5]}}, ParameterError, "must be an integer, got 2.5"),
        ({"": {"uniform": [1, 2]}}, ConfigError, "'' must be the path of a setting"),
        ({"sensor.bits": {"uniform": [8, 9.5]}}, ConfigError, "sensor.bits: "),
        ({"sensor.bits": {"choice": [8, 40]}}, ConfigError, "sensor.bits: must be <= "),
        (
            {"optics.f_number": {"uniform": [0.1, 2]}},
            ConfigError,
            "^vary.optics.f_number: must be >= 0.5, got 0.1",
        ),
        ({"seed": {"integers": [0, 9]}}, ParameterError, "'seed' must not vary"),
        ({"scene.picture": {"choice": ["a.png"]}}, ParameterError, "'scene.picture' must not vary"),
        ({"sensor": {"choice": [{}]}, "sensor.bits": {"choice": [8]}}, ConfigError, "cannot both vary"),
        (["exposure_s"], ParameterError, "'vary' must be a mapping of setting paths to distributions"),
    ],
)
def test_invalid_distribution_is_rejected_before_sampling(vary, error, message):
    with pytest.raises(error, match=message) as caught:
        explore.Dataset(pictures(2), SHOT, vary)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"labels": [1]}, ParameterError, "'labels' must have one item for each of the 2 pictures, got 1"),
        ({"labels": [1, "a"]}, ParameterError, "must all be integers, or all be strings"),
        ({"labels": [1, 2.0]}, ParameterError, "must all be integers, or all be strings"),
        ({"labels": [None, None]}, ParameterError, "must all be integers, or all be strings"),
        ({"labels": np.zeros((2, 2), int)}, ParameterError, "must all be integers, or all be strings"),
        ({"labels": [2**70, 1]}, ParameterError, "'labels' must be <= 9223372036854775807"),
        ({"boxes": [[], [[1, 2, 3, 4, 1e300]]]}, ParameterError, "integers up to 9007199254740992 as classes"),
        ({"boxes": [[], [[1, 2, float("nan"), 4]]]}, ParameterError, "must be finite everywhere"),
        ({"boxes": [[], [[1, 2, 1, 4]]]}, ParameterError, "must have x0 < x1 and y0 < y1"),
        ({"boxes": [[], "ab"]}, ParameterError, "must be an array of numbers"),
        ({"labels": 3}, ParameterError, "'labels' must be a sequence"),
        ({"boxes": [[[0, 0, 1, 1]], [[3, 0, 1, 1]]]}, ParameterError, r"'boxes\[1\]' must have x0 < x1"),
        ({"boxes": [[], [1, 2, 3]]}, ParameterError, r"'boxes\[1\]' must have 2 dimensions"),
        ({"boxes": [[], [[1, 2, 3]]]}, ParameterError, r"must have the shape \(n, 4\)"),
        ({"boxes": [[], [[1, 2, 3, 4, 0.5]]]}, ParameterError, "must have integers up to"),
        (
            {"fields": ["codes"]},
            ParameterError,
            "'fields' must be the name of a column, got 'codes'; did you mean 'code'",
        ),
        ({"fit": "crop"}, ParameterError, "'fit' must be one of 'cover', 'contain'"),
        ({"cameras": 0}, ParameterError, "'cameras' must be >= 1"),
        ({"draws": 1.5}, ParameterError, "'draws' must be an integer"),
        ({"seed": -1}, ParameterError, "'seed' must be >= 0"),
        ({"changes": {"optics.speed": 1}}, ConfigError, "optics.speed: unknown (key|parameter)"),
        ({"fit": "cover", "vary": {"scene.pitch_um": {"uniform": [1, 2]}}}, ParameterError, "must not vary with 'fit'"),
        ({"shot": SHOT | {"scene": FLAT}}, ConfigError, "scene.kind: must be 'picture'"),
        (
            {"shot": SHOT | {"exposure_s": object()}},
            ConfigError,
            r"^shot\.exposure_s: must be a number, string, list or section",
        ),
        ({"shot": 5}, ParameterError, "'shot' must be a settings file or a mapping of settings, got an int"),
        ({"shot": "missing.yaml"}, ConfigError, "missing.yaml: no such file"),
        (
            {"pictures": 5},
            ParameterError,
            "'pictures' must be a directory, a zip file, an array, or a sequence, got an int",
        ),
        ({"pictures": []}, ParameterError, "'pictures' must contain at least one picture"),
        ({"pictures": [(pictures(1)[0], 1), ()]}, ParameterError, "must all be pairs"),
        ({"pictures": [(pictures(1)[0],)]}, ParameterError, "must all be pairs"),
        ({"pictures": [(pictures(1)[0], None)]}, ParameterError, "must all be integers, or all be strings"),
        ({"pictures": np.zeros((3, 4))}, ParameterError, "'pictures' must have the shape"),
        ({"pictures": np.zeros((0, 4, 4))}, ParameterError, "'pictures' must have the shape"),
        ({"pictures": "missing"}, FileError, "missing: no such file or directory"),
        (
            {"pictures": [np.zeros((4, 4, 3), complex)]},
            FileError,
            "picture 0: is not a valid picture for these settings",
        ),
    ],
)
def test_invalid_arguments_are_rejected(options, error, message):
    arguments = {"pictures": pictures(2), "shot": SHOT} | options
    with pytest.raises(error, match=message) as caught:
        explore.Dataset(**arguments)
    assert "\n" not in str(caught.value)


def test_sources_without_pictures_are_rejected(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "notes.txt").write_text("no picture")
    (tmp_path / "one.png").write_bytes(b"no zip file")
    (tmp_path / "bad.npy").write_bytes(b"no array")
    with zipfile.ZipFile(tmp_path / "empty.zip", "w") as file:
        file.writestr("notes.txt", "no picture")
    with zipfile.ZipFile(tmp_path / "corrupt.zip", "w") as file:
        file.writestr("a.png", b"no picture")
    for name, message in (
        ("empty", "empty: contains no pictures"),
        ("empty.zip", "empty.zip: contains no pictures"),
        ("one.png", "must be a directory of pictures, a zip file"),
        ("bad.npy", "bad.npy: is not a readable array"),
        ("corrupt.zip", r"corrupt.zip!a.png: is not a picture"),
    ):
        with pytest.raises(FileError, match=message):
            explore.Dataset(tmp_path / name, SHOT)


def test_label_errors_name_the_picture():
    bad = {
        "masks": ([np.zeros((N_Y, N_X), int), np.zeros((3, 3), int)], "mask of picture 1' must be integers"),
        "flows": ([np.zeros((N_Y, N_X, 2)), np.zeros((N_Y, N_X))], "flow of picture 1' must be numbers of shape"),
    }
    large = [np.zeros((N_Y, N_X), int), np.full((N_Y, N_X), 2**64 - 1, np.uint64)]
    with pytest.raises(SimulationError, match=r"sample 1 .*mask of picture 1' must be signed 64-bit integers"):
        explore.Dataset(pictures(2), SHOT, masks=large)[1]
    for name, (given, message) in bad.items():
        data = explore.Dataset(pictures(2), SHOT, **{name: given})
        data[0]
        with pytest.raises(SimulationError, match=f"sample 1 .*{message}"):
            data[1]


def test_dataset_indexing_follows_sequences():
    data = explore.Dataset(pictures(2), SHOT, cameras=2, draws=3)

    assert len(data) == len(list(data)) == 12
    assert_same(data[-1], data[11])
    for index in (12, -13):
        with pytest.raises(IndexError, match="is out of range for 12 samples"):
            data[index]
    with pytest.raises(TypeError):
        data[1.5]


def test_settings_accept_numpy_scalars():
    shot = SHOT | {"exposure_s": np.float32(0.5), "sensor": {"bits": np.int64(9)}}

    assert explore.Dataset(pictures(1), shot).settings_of(0)["sensor"]["bits"] == 9


# -- recipes ----------------------------------------------------------------------------------------------------------


def test_denoising_target_is_mean_of_draws():
    n_draws = 100
    data = explore.denoising(pictures(1), SHOT, draws=n_draws)
    samples = list(data)
    codes = np.stack([sample["code"] for sample in samples]).astype(float)
    shot, target_dn = data.shot(0), samples[0]["expected_dn"]
    capture = data.capture(0)
    _, variance_dn2 = shot.camera.sensor.predict(capture.expected_e)
    off_dn = np.abs(codes.mean(axis=0) - target_dn)
    is_noisy = variance_dn2 > 4.0 / n_draws

    assert len({sample["settings"]["exposure_s"] for sample in samples}) == 1
    assert is_noisy.sum() > 20
    assert (off_dn / np.sqrt(variance_dn2 / n_draws))[is_noisy].max() < 5.0
    assert off_dn[~is_noisy].max(initial=0.0) < 10.0 / n_draws


def test_classification_draws_cameras_around_shot():
    data = explore.classification(pictures(15), SHOT, {"sensor.bits": {"choice": [6, 8]}}, labels=[0] * 15)
    drawn = [sample["settings"] for sample in data]
    f_numbers = np.array([each["optics.f_number"] for each in drawn])

    assert set(data[0]) == {"index", "picture", "code", "label", "settings", "warning"}
    assert f_numbers.min() >= 2.8 / 1.5
    assert f_numbers.max() <= 8.4
    assert f_numbers.max() / f_numbers.min() > 2.0
    assert len({each["sensor.device_seed"] for each in drawn}) == 15
    assert {each["sensor.bits"] for each in drawn} == {6, 8}
    data = explore.denoising(pictures(1), SHOT, draws=1, cameras=20, changes={"exposure_s": 3.2})
    assert all(0.1 <= sample["settings"]["exposure_s"] <= 3.2 for sample in data)
    with pytest.raises(ConfigError, match="exposure_s: missing"):
        explore.classification(pictures(1), {key: value for key, value in SHOT.items() if key != "exposure_s"})


# -- torch ------------------------------------------------------------------------------------------------------------


def test_missing_torch_gives_install_hint(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    _dataset_class.cache_clear()
    with pytest.raises(ParameterError, match=r"needs torch; install it with: pip install 'foveasim\[learn\]'"):
        explore.torch_dataset(labelled(1))


@pytest.mark.slow
def test_dataset_does_not_import_torch():
    code = "import sys; from foveasim import explore; sys.exit('torch' in sys.modules or 'zarr' in sys.modules)"

    assert subprocess.run([sys.executable, "-c", code], env=os.environ, check=False).returncode == 0

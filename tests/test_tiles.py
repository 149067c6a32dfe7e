"""Captures in tiles, against complete captures."""

from __future__ import annotations

import errno
import itertools
import shutil
from dataclasses import dataclass, replace

import numpy as np
import pytest
from lazy_modules import LazyModule

import foveasim as fs
from foveasim import tiles
from foveasim.errors import CoverageWarning, FileError, ParameterError
from foveasim.sensor import effects
from foveasim.sensor.effects import AdditiveNoise, Effect, FixedFactor, FixedOffset
from foveasim.video import partial_path

zarr = LazyModule("zarr")

BLOCK = 1 << 16
OPTICS = fs.Optics(focal_length_mm=8.0, f_number=4.0)
PITCH_UM = 2.0
NOISE = {
    "read_noise_e": 2.0,
    "prnu_fraction": 0.01,
    "dsnu_fraction": 0.1,
    "line_fpn_fraction": 0.01,
    "rts_fraction": 0.01,
    "rts_e": 5.0,
    "dnl_dn": 0.2,
    "capacitance_f": 1e-13,
    "bits": 12,
}


def scene_of(n_x, n_y, n_bands=3, pixel_um=PITCH_UM):
    """Return a random scene whose image has pixels of one size."""
    wavelength_nm = np.linspace(450.0, 620.0, n_bands)
    basis = np.random.default_rng(0).random((n_bands, n_y, n_x), dtype=np.float32)
    pitch_um = pixel_um / OPTICS.magnification(1.0)
    return fs.Scene(basis, 0.1 * np.eye(n_bands), wavelength_nm, np.full(n_bands, 50.0), pitch_um, 1.0)


@pytest.fixture(scope="module")
def camera():
    """Return a camera of 350,000 sites with a Bayer mosaic and parameters per site."""
    layout = fs.layout.mosaic(fs.layout.grid(700, 500, PITCH_UM), ("RG", "GB"))
    dark_e_per_s = np.linspace(0.0, 5.0, layout.n_sites)
    sensor = fs.Sensor(layout, filters="rgb", dark_e_per_s=dark_e_per_s, **NOISE)
    return fs.Camera(optics=OPTICS, sensor=sensor)


@pytest.fixture(scope="module")
def scene():
    return scene_of(720, 520)


@pytest.fixture(scope="module")
def complete(camera, scene):
    return camera.capture(scene, exposure_s=0.01, seed=3, frame=2)


def joined(parts, name):
    return np.concatenate([getattr(part, name) for part in parts])


@pytest.mark.parametrize("n_blocks", [1, 3, 100])
def test_tiles_equal_complete_capture(camera, scene, complete, n_blocks):
    parts = list(tiles.capture_tiles(camera, scene, exposure_s=0.01, seed=3, frame=2, tile_sites=n_blocks * BLOCK - 5))

    assert len(parts) == -(-camera.sensor.layout.n_sites // (n_blocks * BLOCK))
    assert [part.settings["tile"]["first_site"] for part in parts] == [n_blocks * BLOCK * k for k in range(len(parts))]
    np.testing.assert_allclose(joined(parts, "expected_e"), complete.expected_e, rtol=1e-6)
    # A rounding error of the expected charge changes a draw with a probability of 1e-9.
    for name in ("electrons", "code", "filter_of_site"):
        np.testing.assert_array_equal(joined(parts, name), getattr(complete, name))


@pytest.mark.slow(keep=1)
@pytest.mark.filterwarnings("ignore:automatic oversampling chooses")
@pytest.mark.parametrize("order", [1, 2])
def test_tiles_of_distorted_rings_equal_capture(order):
    layout = fs.layout.log_polar(n_sectors=512, n_rings=300, r_min_um=30.0, r_max_um=290.0)
    lens = fs.distortion.BrownConrady(focal_um=8000.0, k1=-20.0)
    camera = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout, **NOISE), distortion=lens, order=order)
    scene = scene_of(330, 330, n_bands=1)

    whole = camera.capture(scene, exposure_s=0.01, seed=0)
    parts = list(tiles.capture_tiles(camera, scene, exposure_s=0.01, seed=0, tile_sites=BLOCK))

    assert len(parts) == 3
    scale = whole.expected_e.max()
    np.testing.assert_allclose(joined(parts, "expected_e"), whole.expected_e, rtol=1e-6, atol=1e-9 * scale)
    assert np.mean(joined(parts, "code") != whole.code) < 1e-4


@dataclass(frozen=True)
class Shading(FixedFactor):
    """Test effect: loss that increases towards the corners of the layout."""

    name = "shading"
    stage = "photo"

    def pattern(self, sites):
        low, high = np.reshape(sites.layout.bounds_um, (2, 2))
        return 1.0 - np.sum(((sites.layout.centroid_um - low) / (high - low) - 0.5) ** 2, axis=1)


@effects.EFFECTS.register("shading of test_tiles")
@dataclass(frozen=True)
class RegisteredShading(Shading):
    name = "registered_shading"

    def pattern_moments(self, sites):
        return self.pattern(sites), 0.0


@dataclass(frozen=True)
class LeakingCharge(Effect):
    """Test effect: a deterministic loss and noise that increase with the distance from the first row."""

    name = "leak"
    stage = "charge"
    is_temporal = True

    def apply(self, values, *, sites, rng):
        height_um = sites.select(sites.layout.centroid_um[:, 1] - sites.layout.bounds_um[1])
        return values - height_um + 0.2 * height_um * rng.standard_normal(values.size)

    def moments(self, mean, variance, *, sites):
        height_um = sites.select(sites.layout.centroid_um[:, 1] - sites.layout.bounds_um[1])
        return mean - height_um, variance + (0.2 * height_um) ** 2


@dataclass(frozen=True, eq=False)
class MeasuredOffset(FixedOffset):
    """Test effect: an array per site."""

    name = "measured"
    stage = "output"

    offset_v: np.ndarray

    def pattern(self, sites):
        return self.offset_v


@dataclass(frozen=True, eq=False)
class MeasuredNoise(AdditiveNoise):
    """Test effect: noise with an array per site."""

    name = "measured_noise"
    stage = "sense_node"

    sigma_v: np.ndarray

    def deviation(self, sites):
        return self.sigma_v


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("make", [Shading, LeakingCharge, MeasuredOffset, MeasuredNoise])
def test_tiles_with_user_effect_equal_capture(camera, make):
    """Effects that depend on the position in the layout, or contain an array per site."""
    n_sites = camera.sensor.layout.n_sites
    effect = make(np.linspace(0.01, 0.2, n_sites)) if make in (MeasuredOffset, MeasuredNoise) else make()
    camera = camera.replace(sensor=replace(camera.sensor, effects=[effect]))
    cells = np.random.default_rng(1).random((1, 520, 720), dtype=np.float32)
    light = fs.PowerMap.from_array(cells, pitch_um=PITCH_UM, wavelength_nm=[550.0])

    whole = camera.capture(light, exposure_s=1e-2, seed=0)
    parts = list(tiles.capture_tiles(camera, light, exposure_s=1e-2, seed=0, tile_sites=BLOCK))

    assert len(parts) == 6
    for name in ("expected_e", "electrons", "code"):
        np.testing.assert_array_equal(joined(parts, name), getattr(whole, name))
    without = camera.replace(sensor=camera.sensor.without(effect.name)).capture(light, exposure_s=1e-2, seed=0)
    assert np.mean(whole.code != without.code) > 0.3


def test_tiles_have_settings_of_camera(camera, scene, complete):
    part = next(tiles.capture_tiles(camera, scene, exposure_s=0.01, seed=3, frame=2, tile_sites=BLOCK))

    tile = {"first_site": 0, "n_sites": camera.sensor.layout.n_sites}
    assert part.settings == complete.settings | {"tile": tile}


def test_tiles_have_their_part_of_the_sensor(camera, scene, tmp_path):
    sensor = replace(camera.sensor, effects=[RegisteredShading()], dark_e_per_s=1.0)
    shaded = camera.replace(sensor=sensor)
    whole = shaded.capture(scene, exposure_s=0.01, seed=0)
    tile = next(tiles.capture_tiles(shaded, scene, exposure_s=0.01, seed=0, tile_sites=BLOCK))

    expected = whole.signal_to_noise(sensor=sensor)
    np.testing.assert_allclose(tile.signal_to_noise(), expected[:BLOCK], rtol=1e-5)
    tile.save(tmp_path / "tile.npz")
    loaded = fs.Capture.load(tmp_path / "tile.npz")
    with pytest.raises(
        ParameterError, match="'sensor' must be given: the effects 'registered_shading' of a tile need the"
    ):
        loaded.signal_to_noise()
    assert np.array_equal(loaded.signal_to_noise(sensor=sensor.part(slice(0, BLOCK))), tile.signal_to_noise())


@pytest.mark.slow
def test_stored_tiles_have_parameters_per_site(camera, scene, tmp_path):
    noise_e = np.linspace(1.0, 5.0, camera.layout.n_sites)
    noisy = camera.replace(sensor=replace(camera.sensor, effects=[RegisteredShading()], read_noise_e=noise_e))
    expected = noisy.capture(scene, exposure_s=0.01, seed=0).signal_to_noise()
    written = tiles.write_tiles(tmp_path / "t.zarr", noisy, scene, exposure_s=0.01, seed=0, tile_sites=BLOCK)
    ratio = np.concatenate([tile.signal_to_noise() for tile in written])

    np.testing.assert_allclose(ratio, expected, rtol=1e-5)


def test_stored_tiles_of_zeros_are_complete(camera, tmp_path):
    """Codes, electrons and a parameter per site are 0 everywhere."""
    silent = camera.replace(sensor=replace(camera.sensor, effects=(), read_noise_e=np.zeros(camera.layout.n_sites)))
    dark = fs.PowerMap.from_array(np.zeros((520, 720)), pitch_um=PITCH_UM, wavelength_nm=500.0)
    tiles.write_tiles(tmp_path / "dark.zarr", silent, dark, exposure_s=0.01, seed=0, tile_sites=BLOCK)
    found = tiles.read_tiles(tmp_path / "dark.zarr")

    np.testing.assert_array_equal(found.code[:], silent.capture(dark, exposure_s=0.01, seed=0).code)


def test_tiles_without_light_are_complete(tmp_path):
    """Chunks of zeros are files, too: a missing one indicates a corrupt store."""
    layout = fs.layout.grid(n_x=6, n_y=5, pitch_um=4.0)
    dark = fs.Camera(optics=OPTICS, sensor=fs.Sensor(layout, capacitance_f=1e-12))
    scene = fs.Scene.flat(shape=(64, 64), pitch_um=200.0, distance_m=1.0, illuminance_lux=3.0)

    stored = tiles.write_tiles(tmp_path / "dark.zarr", dark, scene, exposure_s=0.001, seed=1)

    assert stored.code[:].tolist() == [0] * 30


@pytest.mark.slow
def test_tiles_of_lateral_colour_equal_capture(camera, scene):
    lens = fs.optics.LateralColour(wavelength_nm=(450.0, 535.0, 620.0), magnification=(1.01, 1.0, 1.005))
    coloured = camera.replace(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0, lateral_colour=lens))
    whole = coloured.capture(scene, exposure_s=0.01, seed=0)
    parts = list(tiles.capture_tiles(coloured, scene, exposure_s=0.01, seed=0, tile_sites=2 * BLOCK))

    np.testing.assert_allclose(joined(parts, "expected_e"), whole.expected_e, rtol=1e-6)


def test_tiles_of_memory_mapped_map_equal_capture(camera, tmp_path):
    """The cells are twice as high as wide."""
    cells = np.random.default_rng(1).random((2, 260, 720), dtype=np.float32)
    np.save(tmp_path / "map.npy", cells)
    light, mapped = (
        fs.PowerMap.from_array(array, pitch_um=(PITCH_UM, 2.0 * PITCH_UM), wavelength_nm=[500.0, 600.0])
        for array in (cells, np.load(tmp_path / "map.npy", mmap_mode="r"))
    )
    whole = camera.capture(light, exposure_s=1e-4, seed=0)
    parts = list(tiles.capture_tiles(camera, mapped, exposure_s=1e-4, seed=0, tile_sites=BLOCK))

    np.testing.assert_allclose(joined(parts, "expected_e"), whole.expected_e, rtol=1e-12)
    np.testing.assert_array_equal(joined(parts, "code"), whole.code)


def test_rows_equal_those_of_maps():
    scene = scene_of(90, 70, n_bands=2)
    weights = np.array([[1.0, 0.5], [0.0, 0.0], [0.2, 1.0]])
    seidel = fs.optics.Seidel(coma_um=0.3)
    for optics in (
        fs.Optics(focal_length_mm=8.0, f_number=4.0, oversample=2),
        fs.Optics(focal_length_mm=8.0, f_number=4.0, seidel=seidel, field_patches=2),
    ):
        maps = optics.weighted_maps(scene, weights)
        for cells, rows in zip(maps, optics.weighted_rows(scene, weights), strict=True):
            np.testing.assert_allclose(rows(13, 61), cells[13:61], rtol=0.0, atol=1e-6 * max(cells.max(), 1e-9))


def test_ranges_of_layouts_equal_selections(camera):
    rings = fs.layout.log_polar(n_sectors=20, n_rings=9, r_min_um=3.0, r_max_um=40.0)
    for layout in (rings, camera.sensor.layout):
        for first, last in ((0, 37), (40, 41), (60, layout.n_sites), (5, 5)):
            part, selected = layout[first:last], layout[np.arange(first, last)]
            for name in ("xy_um", "ring_offsets", "site_offsets"):
                np.testing.assert_array_equal(getattr(part, name), getattr(selected, name))
            assert all(np.array_equal(part.columns[name], selected.columns[name]) for name in selected.columns)


def test_sites_beyond_image_warn_once(camera):
    small = scene_of(600, 400)
    with pytest.warns(CoverageWarning) as whole:
        camera.capture(small, exposure_s=0.01, seed=0)
    with pytest.warns(CoverageWarning) as parts:
        list(tiles.capture_tiles(camera, small, exposure_s=0.01, seed=0, tile_sites=BLOCK))

    assert [str(each.message) for each in parts] == [str(each.message) for each in whole]


def test_crosstalk_between_tiles_is_rejected(camera, scene):
    sensor = fs.Sensor(camera.sensor.layout, filters="rgb", crosstalk=fs.sensor.Diffusion(spread_um=0.5))
    connected = camera.replace(sensor=sensor)

    with pytest.raises(ParameterError, match=r"no effects between sites.*'crosstalk'; switch them off: sensor.without"):
        tiles.capture_tiles(connected, scene, exposure_s=0.01, seed=0)
    switched_off = camera.replace(sensor=sensor.without("crosstalk"))
    assert next(tiles.capture_tiles(switched_off, scene, exposure_s=0.01, seed=0)).code.size == 350_000


def write(path, camera, scene, **options):
    return tiles.write_tiles(
        path, camera, scene, **{"exposure_s": 0.01, "seed": 3, "frame": 2, "tile_sites": BLOCK} | options
    )


@pytest.fixture(scope="module")
def stored(camera, scene, tmp_path_factory):
    return write(tmp_path_factory.mktemp("tiles") / "capture.zarr", camera, scene)


@pytest.mark.slow
def test_stored_tiles_equal_complete_capture(stored, complete, camera):
    for name in ("expected_e", "electrons", "code"):
        np.testing.assert_array_equal(joined(stored, name), joined([stored], name))
    np.testing.assert_array_equal(stored.code[:], complete.code)
    np.testing.assert_array_equal(stored.electrons[70_000:70_010], complete.electrons[70_000:70_010])
    assert stored.layout.lattice is not None
    np.testing.assert_array_equal(stored.layout.xy_um, camera.sensor.layout.xy_um)
    np.testing.assert_array_equal(stored.tile(5).filter_of_site, complete.filter_of_site[5 * BLOCK :])
    assert repr(stored) == "TiledCapture(350,000 sites in 6 tiles, 12 bits, 'capture.zarr')"


def test_overview_has_mean_codes(stored, complete):
    picture = stored.picture(max_pixels=70)

    assert picture.data.shape == (3, 50, 70)
    codes = complete.code.reshape(500, 700).astype(float)
    red = codes[0::2, 0::2].reshape(50, 5, 70, 5).mean(axis=(1, 3))
    np.testing.assert_allclose(picture.data[0], red, rtol=1e-6)


def test_stored_tiles_open_in_xarray(stored, complete):
    xarray = pytest.importorskip("xarray")
    with xarray.open_zarr(stored.path, consolidated=False) as dataset:
        assert dataset["code"].dims == ("site",)
        np.testing.assert_array_equal(dataset["code"][100:200], complete.code[100:200])


def interrupt(monkeypatch, n_tiles, error):
    """Raise an exception in place of a tile."""
    add, counter = tiles._add, itertools.count()

    def add_or_fail(arrays, tile, capture):
        if next(counter) == n_tiles:
            arrays["expected_e"][tile * BLOCK : (tile + 1) * BLOCK] = 1.0  # incomplete
            raise error
        add(arrays, tile, capture)

    monkeypatch.setattr(tiles, "_add", add_or_fail)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("error", "raised", "message"),
    [
        (KeyboardInterrupt(), KeyboardInterrupt, None),
        (OSError(errno.ENOSPC, "No space left on device"), FileError, "No space left on device"),
    ],
)
def test_interrupted_capture_is_resumed(camera, scene, complete, tmp_path, monkeypatch, error, raised, message):
    path = tmp_path / "capture.zarr"
    with monkeypatch.context() as patch:
        interrupt(patch, 2, error)
        with pytest.raises(raised, match=message) as caught:
            write(path, camera, scene)

    assert caught.value.__notes__ == [f"2 tiles are stored in {partial_path(path)}; the same call resumes the capture"]
    assert not path.exists()
    with pytest.raises(FileError, match=r"capture.zarr.partial is unfinished: call write_tiles again"):
        tiles.read_tiles(path)
    with pytest.raises(FileError, match=r"is another capture: 'settings.seed' differs"):
        write(path, camera, scene, seed=4)
    with pytest.raises(FileError, match=r"is another capture: 'light_crc32' differs"):
        write(path, camera, fs.Scene(scene.basis[:, ::-1], *list(vars(scene).values())[1:4], scene.pitch_um, 1.0))
    counted = []
    capture_tiles = tiles.capture_tiles
    monkeypatch.setattr(tiles, "capture_tiles", lambda *a, **k: counted.append(k) or capture_tiles(*a, **k))
    resumed = write(path, camera, scene)
    assert counted[-1]["first_tile"] == 2
    for name in ("expected_e", "electrons", "code"):
        np.testing.assert_allclose(getattr(resumed, name)[:], getattr(complete, name), rtol=1e-6)
    assert not partial_path(path).exists()


def test_nothing_remains_of_first_tile(camera, scene, tmp_path, monkeypatch):
    interrupt(monkeypatch, 0, OSError(errno.ENOSPC, "No space left on device"))
    with pytest.raises(FileError, match="No space left on device"):
        write(tmp_path / "capture.zarr", camera, scene)
    assert list(tmp_path.iterdir()) == []


def test_finished_capture_is_only_read(camera, scene, stored):
    before = {path: path.stat().st_mtime_ns for path in stored.path.rglob("*")}
    again = write(stored.path, camera, scene)

    np.testing.assert_array_equal(again.code[:100], stored.code[:100])
    assert {path: path.stat().st_mtime_ns for path in stored.path.rglob("*")} == before
    with pytest.raises(FileError, match="is another capture: 'tile_sites' differs"):
        write(stored.path, camera, scene, tile_sites=2 * BLOCK)
    other = camera.replace(sensor=fs.Sensor(fs.layout.grid(700, 500, PITCH_UM), **NOISE))
    with pytest.raises(FileError, match="is another capture"):
        write(stored.path, other, scene)


def test_other_paths_are_rejected(camera, scene, tmp_path):
    with pytest.raises(FileError, match=r"must end in .zarr"):
        write(tmp_path / "capture.npz", camera, scene)
    (tmp_path / "data.zarr").mkdir()
    with pytest.raises(FileError, match="the path contains other data"):
        write(tmp_path / "data.zarr", camera, scene)
    with pytest.raises(FileError, match=r"the directory .* does not exist"):
        write(tmp_path / "missing" / "capture.zarr", camera, scene)
    with pytest.raises(FileError, match="no such zarr store"):
        tiles.read_tiles(tmp_path / "capture.zarr")
    with pytest.raises(FileError, match=r"is not a tiled capture|is corrupt"):
        tiles.read_tiles(tmp_path / "data.zarr")


def test_missing_chunks_are_detected(stored, tmp_path):
    damaged = tmp_path / "damaged.zarr"
    shutil.copytree(stored.path, damaged)
    (damaged / "electrons" / "c" / "3").unlink()

    with pytest.raises(FileError, match="is corrupt: 'electrons' is incomplete"):
        tiles.read_tiles(damaged)
    shutil.copy(stored.path / "code" / "c" / "3", damaged / "electrons" / "c" / "3")
    with pytest.raises(FileError, match="corrupt"):
        tiles.read_tiles(damaged).tile(3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera": None}, "'camera' must be a Camera"),
        ({"light": 3.0}, "'light' must be a Scene or a PowerMap"),
        ({"tile_sites": 0}, "'tile_sites' must be"),
        ({"first_tile": 9}, "'first_tile' must be"),
        ({"exposure_s": -1.0}, "'exposure_s' must be"),
    ],
)
def test_bad_arguments_raise_at_once(camera, scene, change, message):
    arguments = {"camera": camera, "light": scene, "exposure_s": 0.01, "seed": 0, "tile_sites": BLOCK} | change
    with pytest.raises(ParameterError, match=message):
        tiles.capture_tiles(**arguments)

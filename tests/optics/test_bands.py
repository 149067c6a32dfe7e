"""Tests of scenes with many basis images: sums over bands, memory, reuse of arrays."""

import tracemalloc
import warnings

import numpy as np
import pytest
from waiting import wait_until

import foveasim as fs
from foveasim._core import work_arrays
from foveasim.errors import SamplingWarning
from foveasim.optics import _imaging

SHAPE = (45, 62)


def lens(**changes):
    return fs.Optics(**{"focal_length_mm": 22.0, "f_number": 4.0, "precision": "double"} | changes)


def scene_of(optics, spectrum, pitch_um, shape=SHAPE):
    """Return a scene of random pixels with the given pitch in the image."""
    n_basis, n_wavelengths = spectrum.shape
    return fs.Scene(
        np.random.default_rng(n_basis).random((n_basis, *shape)),
        spectrum,
        np.linspace(430.0, 670.0, n_wavelengths),
        np.linspace(5.0, 12.0, n_wavelengths),
        pitch_um / optics.magnification(1.0),
        1.0,
    )


def band_of(scene, basis, wavelength):
    """Return one basis image at one wavelength."""
    return fs.Scene(
        scene.basis[basis : basis + 1],
        scene.spectrum_w_m2_sr_nm[basis : basis + 1, wavelength : wavelength + 1],
        scene.wavelength_nm[wavelength : wavelength + 1],
        scene.band_width_nm[wavelength : wavelength + 1],
        scene.pitch_um,
        scene.distance_m,
    )


@pytest.fixture(autouse=True)
def small_pictures():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        yield


RANDOM = np.random.default_rng(3)
SPECTRA = {
    "independent bands": np.diag(1.0 + np.arange(6)),
    "more wavelengths than images": RANDOM.random((2, 6)),
    "more images than wavelengths": RANDOM.random((6, 2)),
    # The first two images and the last two have wavelengths in common, the third is black.
    "separate groups": np.kron(np.diag([1.0, 0.0, 2.0]), [[1.0, 3.0], [2.0, 0.5]])[[0, 1, 2, 4, 5]],
}


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("spectrum", SPECTRA.values(), ids=SPECTRA)
@pytest.mark.parametrize(
    ("pitch_um", "changes"),
    [
        (0.6, {"padding": "periodic"}),
        (2.5, {}),
        (2.5, {"oversample": 2}),
        (6.0, {"emission": "isotropic"}),
        (2.5, {"pupil": fs.optics.Blades(5), "zernike": fs.optics.Zernike(coefficients={7: 0.05})}),
    ],
)
def test_maps_sum_over_images_and_wavelengths(spectrum, pitch_um, changes):
    scene = scene_of(lens(**changes), spectrum, pitch_um)
    pad = 24  # the same padding at all wavelengths
    shape = lens(padding_cells=pad, **changes).image_grids(scene)[0][0].shape
    of_wavelength = np.zeros((spectrum.shape[1], *shape))
    for b, k in np.argwhere(spectrum):
        (one,) = lens(padding_cells=pad, **changes).power_map(band_of(scene, b, k)).data
        of_wavelength[k] += one

    for n_outputs in (1, 3, 8):
        weights = np.random.default_rng(4).random((n_outputs, spectrum.shape[1])) + 0.1
        weights[0, 1:] = 0.0
        maps = np.stack(list(lens(padding_cells=pad, **changes).weighted_maps(scene, weights)))
        expected = np.tensordot(weights, of_wavelength, axes=1)

        # Tables of one wavelength have other steps than those of all; the error of interpolation is 3e-8, more for a pupil.
        tolerance = 2e-3 if "pupil" in changes else 2e-7
        assert np.abs(maps - expected).max() <= tolerance * expected.max(), n_outputs


@pytest.mark.parametrize("n_outputs", [1, 2, 5])
def test_sums_per_wavelength_equal_sums_per_output(monkeypatch, n_outputs):
    optics = lens()
    scene = scene_of(optics, RANDOM.random((3, 4)), 2.5)
    weights = RANDOM.random((n_outputs, 4))
    chosen = np.stack(list(optics.weighted_maps(scene, weights)))

    def per_output(self, outputs, basis):
        products = self.weights[outputs, np.newaxis] * self.irradiance_w_m2[basis]
        n = products.shape[0] * products.shape[1]
        return _imaging.Step(outputs, basis, products.reshape(n, -1), np.eye(n).reshape(*products.shape[:2], n))

    monkeypatch.setattr(_imaging.Imaging, "_step", per_output)
    other = np.stack(list(lens().weighted_maps(scene, weights)))

    assert np.abs(chosen - other).max() <= 1e-12 * chosen.max()


def test_each_band_requires_one_table(monkeypatch):
    prepared = []
    monkeypatch.setattr(_imaging.Transform, "factor", _counting(_imaging.Transform.factor, prepared))
    optics = lens()

    list(optics.weighted_maps(scene_of(optics, np.eye(7), 2.5), RANDOM.random((3, 7))))
    assert len(prepared) == 7

    prepared.clear()
    list(optics.weighted_maps(scene_of(optics, RANDOM.random((2, 31)), 2.5), RANDOM.random((3, 31))))
    assert len(prepared) == 6


def _counting(function, calls):
    def counted(*arguments):
        calls.append(arguments)
        return function(*arguments)

    return counted


def test_memory_is_one_spectrum_per_map(monkeypatch):
    optics = lens(precision="single", padding="periodic")
    shape = (600, 480)
    scene = scene_of(optics, np.eye(12), 2.5, shape)
    weights = RANDOM.random((2, 12))
    for _ in optics.weighted_maps(band_of(scene, 0, 0), np.ones((1, 1))):
        pass  # imports kernels
    monkeypatch.setattr(work_arrays, "_POOL", work_arrays._Pool())
    monkeypatch.setattr(work_arrays._POOL, "max_unused_bytes", 0)
    spectrum_bytes = 8 * shape[0] * (shape[1] // 2 + 1)
    map_bytes = 4 * shape[0] * shape[1]
    # Blocks of rows and columns per thread, and small tables.
    n_threads, block_bytes = 2, 3e6

    tracemalloc.start()
    for cells in optics.weighted_maps(scene, weights, n_threads=n_threads):
        del cells
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert peak <= 3 * spectrum_bytes + map_bytes + n_threads * block_bytes


def n_unused_buffers(at_least):
    """Return the number of unused buffers, which threads return shortly after the result of their last work."""
    wait_until(lambda: len(work_arrays._POOL._unused) >= at_least)
    return len(work_arrays._POOL._unused)


def test_repeated_maps_reuse_memory(monkeypatch):
    monkeypatch.setattr(work_arrays, "_POOL", work_arrays._Pool())
    optics = lens(precision="single")
    scene = scene_of(optics, np.eye(2), 2.5, (600, 480))
    list(optics.weighted_maps(scene, np.eye(2)))
    n_unused = n_unused_buffers(at_least=1)

    first = list(optics.weighted_maps(scene, np.eye(2)))
    copies = [cells.copy() for cells in first]
    second = list(optics.weighted_maps(scene, np.eye(2)))

    assert n_unused > 0
    assert all(np.array_equal(cells, copy) for cells, copy in zip(first, copies, strict=True))
    assert all(np.array_equal(cells, copy) for cells, copy in zip(second, copies, strict=True))
    assert not any(np.may_share_memory(a, b) for a in first for b in second)
    del first, second
    n_unused_buffers(at_least=n_unused)


def test_memory_mapped_scene_is_not_copied(tmp_path):
    basis = RANDOM.random((2, *SHAPE), dtype=np.float32)
    np.save(tmp_path / "basis.npy", basis)
    mapped = np.load(tmp_path / "basis.npy", mmap_mode="r")
    optics = lens()
    arguments = np.eye(2), [500.0, 600.0], [10.0, 10.0], 2.5 / optics.magnification(1.0), 1.0

    scene = fs.Scene(mapped, *arguments)

    assert np.shares_memory(scene.basis, mapped)
    expected = optics.power_map(fs.Scene(basis, *arguments)).data
    assert np.array_equal(optics.power_map(scene).data, expected)

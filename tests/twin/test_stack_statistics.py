"""Sums over stacks of frames against plain numpy sums, for all kinds of arrays and files; threads, limits, interruptions."""

import threading
import tracemalloc

import numpy as np
import pytest
import tifffile
from scipy.stats import binom, chi2, ncx2

import foveasim as fs
from foveasim._core.threads import default_threads
from foveasim.sensor.adc import ADC
from foveasim.twin.fitting import telegraph
from foveasim.twin.fitting.levels import block_means
from foveasim.twin.frames import statistics
from foveasim.twin.frames.statistics import LinearStatistics, StackStatistics, sum_frames, weighted


def codes_of(shape, dtype, seed=0):
    """Random codes of all bits, with zeros."""
    codes = np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    codes.flat[:: max(1, codes.size // 5)] = 0
    return codes


def assert_sums(total, frames):
    """Compare with sums of 64 bits."""
    codes = np.stack([np.asarray(each, np.int64) for each in frames])
    np.testing.assert_array_equal(total.sums, codes.sum(axis=0))
    np.testing.assert_array_equal(total.rows, codes.sum(axis=2))
    np.testing.assert_array_equal(total.columns, codes.sum(axis=1))
    off = codes - int(total.centre)
    np.testing.assert_array_equal(
        total.squares_dn2, (off * (off.shape[2] * off - 2 * off.sum(axis=2, keepdims=True))).sum(axis=0)
    )
    for counts, j in zip(total.counts, np.arange(len(total.counts)) * codes.shape[2] // len(total.counts), strict=True):
        np.testing.assert_array_equal(counts, np.bincount(codes[:, ::2, j].ravel(), minlength=codes.max() + 1))
    assert total.found.tolist() == [(codes == 0).sum(), codes.max(), np.bitwise_or.reduce(codes, axis=None)]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(2, 1, 1), (9, 1, 37), (17, 41, 1), (8, 13, 2), (19, 30, 67)])
def test_sums_equal_those_of_numpy(shape, dtype, monkeypatch):
    monkeypatch.setattr(statistics, "BAND_PIXELS", 200)
    codes = codes_of(shape, dtype)

    assert_sums(sum_frames("stack", codes), codes)


def test_frames_have_any_memory_order(tmp_path):
    codes = codes_of((5, 12, 9), np.uint16)
    np.save(tmp_path / "mapped.npy", codes)
    small = codes_of((12, 9), np.uint8)
    frames = [
        np.asfortranarray(codes[0]),
        codes[1][::-1, ::-1],
        codes[2].astype(">u2"),
        small,
        codes[3].astype(np.int32),
        codes[4].astype(np.float64),
        *np.load(tmp_path / "mapped.npy", mmap_mode="r"),
    ]

    assert_sums(sum_frames("stack", iter(frames)), frames)


@pytest.mark.parametrize("kind", ["c.npy", "fortran.npy", "big.npy", "one.npy", "big.tif", "fits"])
def test_files_equal_their_arrays(kind, tmp_path):
    codes, path = codes_of((3, 11, 6), np.uint16), tmp_path / f"frames.{kind}"
    if kind == "big.tif":
        tifffile.imwrite(path, codes, byteorder=">", photometric="minisblack")
    elif kind == "fits":
        fits = pytest.importorskip("astropy.io.fits")
        header = fits.Header({"ROWORDER": "BOTTOM-UP"})
        fits.writeto(path, codes[:, ::-1], header)
    else:
        stored = {"c.npy": codes, "fortran.npy": np.asfortranarray(codes), "big.npy": codes.astype(">u2")}
        np.save(path, stored.get(kind, codes[0].T))
    if kind == "one.npy":
        path, codes = [path, path], np.stack((codes[0].T,) * 2)

    stack = fs.twin.Stack(path if isinstance(path, list) else [path], 0.01, light=0)

    assert_sums(sum_frames("stack", stack), codes)


@pytest.mark.slow
def test_sums_exceed_32_bits():
    """65,535 times 65,600 is above 2**32."""
    many = np.full((65_600, 1, 3), 65_535, np.uint16)

    np.testing.assert_array_equal(sum_frames("stack", many).sums, np.full((1, 3), 65_535 * 65_600))


def test_sums_have_parts_of_32_bits(monkeypatch):
    monkeypatch.setattr(statistics, "MAX_SUMMED", 16)
    codes = codes_of((43, 5, 4), np.uint16)

    assert_sums(sum_frames("stack", codes), codes)


def test_sums_of_rows_exceed_32_bits():
    """70,000 times 65,535 is above 2**32."""
    wide = np.full((2, 1, 70_000), 65_535, np.uint16)

    np.testing.assert_array_equal(sum_frames("stack", wide).rows, np.full((2, 1), 65_535 * 70_000))


@pytest.mark.parametrize("n_x", [2, 3, 50])
def test_variances_are_those_within_rows(n_x):
    """Of frames with an own offset in each row, and steep differences between pixels."""
    rng = np.random.default_rng(3)
    codes = rng.normal(0.0, 20.0, (13, 6, n_x)) + rng.normal(0.0, 50.0, (13, 6, 1)) + np.linspace(900, 60_000, n_x)
    codes = np.clip(np.rint(codes), 0, 65_535).astype(np.uint16)

    found = StackStatistics.of(sum_frames("stack", codes))

    expected = (codes - codes.mean(axis=2, keepdims=True)).var(axis=0, ddof=1)
    if n_x > 2:
        expected = (expected - expected.mean(axis=1, keepdims=True) / (n_x - 1)) / (1.0 - 2.0 / n_x)
    np.testing.assert_allclose(found.variance_dn2, np.maximum(expected, 0.0), rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(found.mean_dn, codes.mean(axis=0), rtol=1e-15)
    assert found.sums.nbytes + found.variances.nbytes == 8 * codes[0].size


def test_threads_do_not_change_sums(monkeypatch):
    monkeypatch.setattr(statistics, "BAND_PIXELS", 64)
    codes, found = codes_of((11, 40, 23), np.uint16), []
    for n_threads in (1, 5):
        with default_threads(n_threads):
            total = sum_frames("stack", codes)
            found.append((total, StackStatistics.of(total)))

    for one, other in zip(*found, strict=True):
        for name, values in vars(one).items():
            np.testing.assert_array_equal(values, vars(other)[name])


def dark_and_flat(folder, n_frames=4):
    """A folder of a dark and two flat stacks."""
    rng = np.random.default_rng(1)
    for name, signal_e in (("dark_1ms", 0.0), ("flat_1ms", 500.0), ("flat_2ms", 1000.0)):
        (folder / name).mkdir(parents=True)
        codes = np.rint(
            60.0 + rng.normal(0.0, 4.0, (n_frames, 20, 30)) + 0.5 * rng.poisson(signal_e, (n_frames, 20, 30))
        )
        for k, frame in enumerate(codes.astype(np.uint16)):
            np.save(folder / name / f"{k}.npy", frame)
    return folder


def test_resumed_statistics_are_equal(tmp_path, monkeypatch):
    folder = dark_and_flat(tmp_path / "frames")
    first = fs.twin.fit(folder, bits=12, pixel_um=3.0, resume=tmp_path / "sums")
    monkeypatch.setattr("foveasim.twin.frames.camera_fit.sum_frames", None)

    again = fs.twin.fit(folder, bits=12, pixel_um=3.0, resume=tmp_path / "sums")

    assert again.estimates == first.estimates
    for name, values in first.maps.items():
        np.testing.assert_array_equal(again.maps[name], values)


@pytest.mark.parametrize("error", [KeyboardInterrupt, fs.errors.FileError])
def test_interrupted_read_leaves_nothing(error, tmp_path, monkeypatch):
    folder = dark_and_flat(tmp_path / "frames", n_frames=20)
    if error is KeyboardInterrupt:
        monkeypatch.setattr(statistics, "_add", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    else:
        path = folder / "dark_1ms" / "17.npy"
        path.write_bytes(path.read_bytes()[:-7])

    with pytest.raises(error):
        fs.twin.fit(folder, bits=12, pixel_um=3.0, resume=tmp_path / "sums")

    assert not list(tmp_path.glob("sums/*"))
    assert not [each for each in threading.enumerate() if each.name.startswith(statistics.READER)]


def test_long_files_are_read_by_frames(tmp_path):
    """A file of 200 frames of half a megabyte, with half of its memory."""
    np.save(tmp_path / "frames.npy", np.tile(codes_of((4, 512, 512), np.uint16) >> 4, (50, 1, 1)))
    stack = fs.twin.Stack([tmp_path / "frames.npy"], 0.01)
    sum_frames("stack", stack)
    tracemalloc.start()
    sum_frames("stack", stack)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert peak < 100 * 512 * 512 * 2


def test_block_means_have_masks_and_weights():
    rng = np.random.default_rng(2)
    values, share, classes = rng.random((9, 7)), rng.random((9, 7)), rng.integers(-1, 2, (9, 7))

    found = block_means(values, classes, share)

    blocks = np.minimum(np.arange(9) // 4, 1)[:, None] * np.ones(7, int)  # two blocks of whole mosaics
    for c in range(2):
        for b in range(found.shape[1]):
            own = (classes == c) & (blocks == b)
            assert found[c, b] == pytest.approx(np.average(values[own], weights=share[own]), rel=1e-13)


def test_linear_statistics_follow_the_adc():
    codes = codes_of((6, 5, 8), np.uint8)
    found = StackStatistics.of(sum_frames("stack", codes))
    adc = ADC(bits=8, companding="root")

    linear = LinearStatistics.of_codes(found, adc)

    mean_dn = codes.mean(axis=0)
    np.testing.assert_allclose(linear.mean_dn, adc.linear_of_code_dn(mean_dn), rtol=1e-12)
    np.testing.assert_allclose(linear.variance_dn2, found.variance_dn2 * adc.width_of_code_dn(mean_dn) ** 2, rtol=1e-12)
    np.testing.assert_allclose(
        weighted(np.array([0.25, -2.0]), [mean_dn, mean_dn**2]), 0.25 * mean_dn - 2.0 * mean_dn**2
    )


def test_probability_of_rts_is_that_of_bayes():
    """From scipy's densities at each pixel, where the fit interpolates between variances."""
    rng, n, step = np.random.default_rng(4), 16, 30.0
    has_rts = rng.random(20_000) < 0.03
    codes = rng.normal(0.0, 5.0, (n, has_rts.size)) + step * has_rts * rng.integers(0, 2, (n, has_rts.size))
    variance_dn2 = codes.var(axis=0, ddof=1)

    found = telegraph.fit_telegraph(variance_dn2, n)

    x, k = variance_dn2 * (n - 1) / found.noise_dn2, np.arange(1, n)
    off = found.step_dn**2 * k * (n - k) / (n * found.noise_dn2)
    with_rts = (binom.pmf(k, n, 0.5)[:, None] * ncx2.pdf(x, n - 1, off[:, None])).sum(axis=0)
    with_rts += 2.0 * 0.5**n * chi2.pdf(x, n - 1)
    odds = found.fraction * with_rts / ((1.0 - found.fraction) * chi2.pdf(x, n - 1))
    np.testing.assert_allclose(found.probability, odds / (1.0 + odds), atol=1e-4)

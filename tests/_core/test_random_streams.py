"""Random streams by seed, frame and effect; counter-based generators; uniform and Gaussian numbers."""

from __future__ import annotations

import itertools
import math
import os
import subprocess
import sys
from functools import cache

import numba
import numpy as np
import pytest

from foveasim._core import _kernels
from foveasim._core.random_streams import Streams, random_key
from foveasim.errors import ParameterError

N_DRAWS = 100_000
KEYS = [(seed, frame, effect) for seed in (0, 1, 2**40) for frame in (0, 1, 2) for effect in ("shot", "read")]


def draws(seed, frame, effect):
    return Streams(seed, frame).of(effect).standard_normal(N_DRAWS)


@pytest.mark.parametrize("key", KEYS, ids=str)
def test_same_key_gives_same_numbers(key):
    np.testing.assert_array_equal(draws(*key), draws(*key))


def test_streams_of_different_keys_are_uncorrelated():
    # The correlation of n independent pairs has the standard error 1 / sqrt(n).
    correlation = np.corrcoef([draws(*key) for key in KEYS])
    off_diagonal = correlation[~np.eye(len(KEYS), dtype=bool)]
    assert np.abs(off_diagonal).max() < 5.0 / math.sqrt(N_DRAWS)


def test_different_keys_give_different_numbers():
    all_draws = np.concatenate(
        [Streams(seed, frame).of(effect).integers(2**63, size=100) for seed, frame, effect in KEYS]
    )
    assert np.unique(all_draws).size == all_draws.size


def test_seed_and_frame_are_not_interchangeable():
    assert Streams(1, 0).of("shot").integers(2**63) != Streams(0, 1).of("shot").integers(2**63)


def test_stream_is_independent_of_previous_draws():
    streams = Streams(7, 3)
    first = streams.of("read").standard_normal(10)
    for effect in ("shot", "read", "shot_gaussian"):
        streams.of(effect).standard_normal(1000)
    np.testing.assert_array_equal(streams.of("read").standard_normal(10), first)


def test_other_process_draws_same_numbers():
    program = "from foveasim._core.random_streams import Streams; print(Streams(5, 2).of('shot').integers(2**63))"
    here = int(Streams(5, 2).of("shot").integers(2**63))
    for hash_seed in ("1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
        answer = subprocess.run(
            [sys.executable, "-c", program], check=True, capture_output=True, text=True, env=environment
        )
        assert int(answer.stdout) == here


@pytest.mark.parametrize("seed", [2**53, 2**64, 2**127], ids=["2^53", "2^64", "2^127"])
def test_large_seeds_are_distinguished(seed):
    # Default seeds of numpy have 128 bits.
    values = {int(Streams(s).of("shot").integers(2**63)) for s in (seed, seed + 1)}
    assert len(values) == 2


@pytest.mark.parametrize(("name", "index"), [("seed", 0), ("frame", 1)])
@pytest.mark.parametrize(
    ("value", "rule"),
    [
        (-1, "must be >= 0"),
        (0.5, "must be an integer"),
        (math.nan, "must be finite"),
        (True, "must be one number"),
        ("1", "must be one number"),
        (None, "must be one number"),
        ([1, 2], "must be one number"),
    ],
)
def test_invalid_seed_or_frame_is_rejected(name, index, value, rule):
    arguments = [0, 0]
    arguments[index] = value
    with pytest.raises(ParameterError, match=f"^'{name}' {rule}"):
        Streams(*arguments)


def test_integers_of_any_type_are_equal_seeds():
    values = [Streams(seed).of("shot").integers(2**63) for seed in (3, 3.0, np.int64(3), np.uint8(3))]
    assert all(a == b for a, b in itertools.pairwise(values))


def test_blocks_of_an_effect_have_independent_streams():
    blocks = np.array([Streams(7, 3).of("read", block).standard_normal(N_DRAWS) for block in range(6)])
    whole = Streams(7, 3).of("read").standard_normal(N_DRAWS)

    correlation = np.corrcoef([*blocks, whole])
    assert np.abs(correlation[~np.eye(7, dtype=bool)]).max() < 5.0 / math.sqrt(N_DRAWS)
    np.testing.assert_array_equal(Streams(7, 3).of("read", 4).standard_normal(N_DRAWS), blocks[4])


@pytest.mark.parametrize(
    "other", [(8, 3, "read", 1), (7, 4, "read", 1), (7, 3, "reset", 1), (7, 3, "read", 2)], ids=str
)
def test_keys_of_blocks_are_distinct(other):
    first, second = (random_key(Streams(seed, frame).of(*what)) for seed, frame, *what in ((7, 3, "read", 1), other))
    assert first != second


# -- counter-based generators -----------------------------------------------------------------------------------------

MASK_32 = 2**32 - 1


@cache
def from_python(function):
    """Return a function of kernels as one that Python can call."""
    return numba.njit(function.py_func)


def known(generator, key, counter):
    words = from_python(generator)(*(np.uint64(word) for word in (*key, *counter)))
    return tuple(int(word) for word in words)


@pytest.mark.parametrize(
    ("key", "counter", "words"),
    [
        ((0,), (0, 0), (0xFF1DAE59, 0x6CD10DF2)),
        ((MASK_32,), (MASK_32, MASK_32), (0x2C3F628B, 0xAB4FD7AD)),
        ((0x13198A2E,), (0x243F6A88, 0x85A308D3), (0xDD7CE038, 0xF62A4C12)),
    ],
)
def test_philox_2x32_matches_published_values(key, counter, words):
    """Known-answer tests of Random123, Salmon et al."""
    assert known(_kernels.philox_2x32, key, counter) == words


@pytest.mark.parametrize(
    ("key", "counter", "words"),
    [
        ((0, 0), (0, 0, 0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((MASK_32,) * 2, (MASK_32,) * 4, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0xA4093822, 0x299F31D0),
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_4x32_matches_published_values(key, counter, words):
    """Known-answer tests of Random123, Salmon et al."""
    assert known(_kernels.philox_4x32, key, counter) == words


# -- Gaussian and uniform numbers -------------------------------------------------------------------------------------

BATCH = _kernels.BATCH
ONE = np.ones(1)
ONE.flags.writeable = False


def normals(key, n):
    numbers = np.zeros(n)
    _kernels.add_normals(numbers, ONE, np.uint64(key))
    return numbers


def uniforms(key, n_batches):
    """Return pairs of uniform numbers, (2, n)."""
    pairs = np.empty((2, n_batches, BATCH))
    for batch in range(n_batches):
        _kernels.fill_uniforms(np.uint64(key), batch, *pairs[:, batch])
    return pairs.reshape(2, -1)


def key_of(seed):
    return int(random_key(Streams(seed).of("read", 0)))


def reference_normal(key, i):
    """Return Gaussian number ``i`` by the Box-Muller method with functions of the math module."""
    batch, place = divmod(i, BATCH)
    is_second, pair = divmod(place, BATCH // 2)
    which, offset = divmod(pair, BATCH // 4)
    counter = batch * (BATCH // 4) + offset
    words = known(_kernels.philox_4x32, (key & MASK_32, key >> 32), (counter & MASK_32, counter >> 32, 0, 0))
    radius = math.sqrt(-2.0 * math.log((words[which] + 0.5) / 2**32))
    word = words[2 + which]
    # The lower 30 bits, read as signed, are the angle from the diagonal of the quadrant.
    angle = ((word << 2 & MASK_32) ^ 2**31) - 2**31
    theta = math.pi / 4.0 * (1.0 + angle / 2**31)
    sign = -1.0 if word >> (30 if is_second else 31) & 1 else 1.0
    return sign * radius * (math.cos(theta) if is_second else math.sin(theta))


@pytest.mark.parametrize("word", [0, 1, 2**12 - 1, 2**63 - 1, 2**63, 2**64 - 2**12, 2**64 - 1])
def test_uniform_numbers_exclude_zero_and_one(word):
    from scipy import special, stats

    uniform = from_python(_kernels.uniform)
    number, opposite = uniform(np.uint64(word)), uniform(np.uint64(2**64 - 1 - word))

    # Differences below 1 of multiples of 2**-53 are exact.
    assert number == 1.0 - opposite
    assert 0.0 < number < 1.0
    assert special.ndtri(number) == pytest.approx(stats.norm.ppf((word // 2**12 + 0.5) / 2**52))


@pytest.mark.parametrize("key", [0, 1, 2**63, 2**64 - 1])
def test_gaussian_numbers_match_box_muller_method(key):
    expected = np.array([reference_normal(key, i) for i in range(3000)])
    # The numbers have the resolution of float32.
    np.testing.assert_allclose(normals(key, 3000), expected, rtol=1e-6, atol=1e-5)
    assert np.sqrt(np.mean((normals(key, 3000) - expected) ** 2)) < 3e-7


@pytest.mark.parametrize("n", [0, 1, 2, 1023, 1024, 1025, 3001])
def test_shorter_draws_are_prefixes(n):
    np.testing.assert_array_equal(normals(5, n), normals(5, 5000)[:n])


def test_normals_scale_with_deviation_of_each_value():
    deviation, values = np.linspace(0.0, 2.0, 2500), np.arange(2500.0)
    expected = values + deviation * normals(9, 2500)
    deviation.flags.writeable = False

    _kernels.add_normals(values, deviation, np.uint64(9))

    np.testing.assert_array_equal(values, expected)


def test_gaussian_numbers_have_gaussian_moments():
    n = 2_000_000
    z = normals(key_of(11), n)
    # Variance of the mean of z**k: (E z**2k - (E z**k)**2) / n, with E z**2k = (2k - 1)!!.
    for k, moment, square in ((1, 0, 1), (2, 1, 3), (3, 0, 15), (4, 3, 105), (5, 0, 945), (6, 15, 10395)):
        assert np.mean(z**k) == pytest.approx(moment, abs=5.0 * math.sqrt((square - moment**2) / n))


def test_gaussian_numbers_have_gaussian_tails():
    from scipy import stats

    n = 2_000_000
    z = normals(key_of(12), n)
    edges = np.array([-np.inf, -4.5, -4.0, -3.0, -2.0, -1.0, -0.1, 0.0, 0.1, 1.0, 2.0, 3.0, 4.0, 4.5, np.inf])
    expected = n * np.diff(stats.norm.cdf(edges))
    # Cancellation near 1: use the symmetric tail.
    expected[-3:] = expected[2::-1]
    assert stats.chisquare(np.histogram(z, edges)[0], expected).pvalue > 1e-6
    assert stats.kstest(z[:500_000], "norm").pvalue > 1e-6


def test_far_gaussian_tail_has_expected_frequency():
    """Numbers beyond five standard deviations come from the lowest words: 6 in 10**7."""
    from scipy import stats

    counts = [np.count_nonzero(np.abs(normals(key, 2_000_000)) > 5.0) for key in range(25)]
    expected = 50e6 * 2.0 * stats.norm.sf(5.0)
    assert abs(sum(counts) - expected) < 5.0 * math.sqrt(expected)


def test_neighbouring_numbers_are_independent():
    n = 1_000_000
    z = normals(key_of(13), n)
    for function in (lambda x: x, np.square, np.abs):
        values = function(z) - function(z).mean()
        for lag in (1, 2, 3, 255, 256, 511, 512, 1023, 1024):
            assert abs(np.corrcoef(values[:-lag], values[lag:])[0, 1]) < 5.0 / math.sqrt(n)


@pytest.mark.parametrize("other", [1, 2**32, 2**63])
def test_neighbouring_keys_are_independent(other):
    n = 1_000_000
    for function in (lambda x: x, np.square):
        correlation = np.corrcoef(function(normals(2**40, n)), function(normals(2**40 ^ other, n)))[0, 1]
        assert abs(correlation) < 5.0 / math.sqrt(n)


def test_uniform_numbers_are_uniform_and_independent():
    from scipy import stats

    first, second = uniforms(key_of(14), 1000)
    n = first.size
    for u in (first, second):
        assert 0.0 < u.min() < u.max() < 1.0
        assert stats.chisquare(np.bincount((u * 1000.0).astype(int), minlength=1000)).pvalue > 1e-6
        # Lower bits: the position within an interval of 2**-20 is uniform, too.
        assert stats.kstest(u[:200_000] * 2**20 % 1.0, "uniform").pvalue > 1e-6
        for lag in (1, 2, 1023, 1024):
            assert abs(np.corrcoef(u[:-lag], u[lag:])[0, 1]) < 5.0 / math.sqrt(n)
    cells = np.histogram2d(first, second, bins=30, range=((0.0, 1.0), (0.0, 1.0)))[0]
    assert stats.chisquare(cells.ravel()).pvalue > 1e-6


def test_uniform_and_gaussian_numbers_are_independent():
    pairs, z = uniforms(3, 1000), normals(3, 1000 * BATCH)
    for u in pairs:
        for values in (z, np.abs(z)):
            assert abs(np.corrcoef(u, values)[0, 1]) < 5.0 / math.sqrt(z.size)


def test_successive_keys_of_a_generator_differ():
    rng = Streams(1).of("read")
    first, second = normals(random_key(rng), 1000), normals(random_key(rng), 1000)
    assert np.intersect1d(first, second).size < 3

"""Streams of random numbers: each hangs on seed, frame and effect, and on nothing else."""

from __future__ import annotations

import itertools
import math
import os
import subprocess
import sys

import numpy as np
import pytest

from foveasim._core.random_streams import Streams
from foveasim.errors import ParameterError

N_DRAWS = 100_000
KEYS = [(seed, frame, effect) for seed in (0, 1, 2**40) for frame in (0, 1, 2) for effect in ("shot", "read")]


def draws(seed, frame, effect):
    return Streams(seed, frame).of(effect).standard_normal(N_DRAWS)


@pytest.mark.parametrize("key", KEYS, ids=str)
def test_the_same_key_gives_the_same_numbers(key):
    np.testing.assert_array_equal(draws(*key), draws(*key))


def test_streams_of_different_keys_are_uncorrelated():
    # The correlation of n independent pairs has the standard error 1 / sqrt(n).
    correlation = np.corrcoef([draws(*key) for key in KEYS])
    off_diagonal = correlation[~np.eye(len(KEYS), dtype=bool)]
    assert np.abs(off_diagonal).max() < 5.0 / math.sqrt(N_DRAWS)


def test_no_two_keys_share_a_number():
    all_draws = np.concatenate(
        [Streams(seed, frame).of(effect).integers(2**63, size=100) for seed, frame, effect in KEYS]
    )
    assert np.unique(all_draws).size == all_draws.size


def test_seed_and_frame_are_not_interchangeable():
    assert Streams(1, 0).of("shot").integers(2**63) != Streams(0, 1).of("shot").integers(2**63)


def test_a_stream_begins_anew_whatever_was_drawn_before():
    streams = Streams(7, 3)
    first = streams.of("read").standard_normal(10)
    for effect in ("shot", "read", "shot_gaussian"):
        streams.of(effect).standard_normal(1000)
    np.testing.assert_array_equal(streams.of("read").standard_normal(10), first)


def test_another_process_draws_the_same_numbers():
    program = "from foveasim._core.random_streams import Streams; print(Streams(5, 2).of('shot').integers(2**63))"
    here = int(Streams(5, 2).of("shot").integers(2**63))
    for hash_seed in ("1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
        answer = subprocess.run(
            [sys.executable, "-c", program], check=True, capture_output=True, text=True, env=environment
        )
        assert int(answer.stdout) == here


@pytest.mark.parametrize("seed", [2**53, 2**64, 2**127], ids=["2^53", "2^64", "2^127"])
def test_large_seeds_that_differ_by_one_give_different_numbers(seed):
    # numpy's own seeds have 128 bits.
    values = {int(Streams(s).of("shot").integers(2**63)) for s in (seed, seed + 1)}
    assert len(values) == 2


@pytest.mark.parametrize(("name", "index"), [("seed", 0), ("frame", 1)])
@pytest.mark.parametrize(
    ("value", "rule"),
    [
        (-1, "must be >= 0"),
        (0.5, "must be a whole number"),
        (math.nan, "must be finite"),
        (True, "must be one number"),
        ("1", "must be one number"),
        (None, "must be one number"),
        ([1, 2], "must be one number"),
    ],
)
def test_a_seed_or_frame_that_is_no_count_is_refused(name, index, value, rule):
    arguments = [0, 0]
    arguments[index] = value
    with pytest.raises(ParameterError, match=f"^'{name}' {rule}"):
        Streams(*arguments)


def test_whole_numbers_of_any_type_mean_the_same_seed():
    values = [Streams(seed).of("shot").integers(2**63) for seed in (3, 3.0, np.int64(3), np.uint8(3))]
    assert all(a == b for a, b in itertools.pairwise(values))

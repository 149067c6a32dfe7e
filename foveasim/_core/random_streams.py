"""Random numbers: one stream for each effect, named, so that an effect more or less leaves all others as they were."""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

import numpy as np

from foveasim._core.validation import Floats, check_count

__all__ = ["Streams", "derived_seed", "device_key", "standard_normal"]


def device_key(seed: int, effect: str) -> tuple[np.uint64, np.uint64]:
    """Key of a counter-based generator for what is fixed in a device: an effect's numbers, of the device's seed."""
    words = np.random.SeedSequence(seed, spawn_key=(crc32(effect.encode()),)).generate_state(2, np.uint64)
    return words[0], words[1]


def derived_seed(seed: int, index: int) -> int:
    """Seed below 2**63 of one run among many: it depends on the seed of them all and the run's number alone."""
    return int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1, np.uint64)[0] >> np.uint64(1))


def standard_normal(rng: np.random.Generator, n: int) -> Floats:
    """
    Standard Gaussian numbers, at less than half the cost of the generator's own.

    One word of the generator is the key of a counter-based generator, whose numbers are turned into Gaussian ones by the
    method of Box and Muller: see :func:`foveasim._core._kernels.standard_normal`.

    Returns
    -------
    numbers : (n,) float64
    """
    from foveasim._core import _kernels

    numbers = np.empty(n)
    _kernels.standard_normal(np.uint64(rng.bit_generator.random_raw()), numbers)
    return numbers


@dataclass(frozen=True, slots=True)
class Streams:
    """
    The random streams of one frame.

    Parameters
    ----------
    seed : int
        Of the whole run, at least 0.
    frame : int
        Number of the frame, at least 0.

    Raises
    ------
    ParameterError
        When a number is negative or not whole.

    Notes
    -----
    A stream depends on (seed, frame, name of the effect) and on nothing else: not on the order of calls, nor on the
    number of threads or processes.

    Stability: with the same versions of this package and of numpy a seed gives the same numbers, bit for bit, on any machine;
    every capture records both versions. Between versions numbers may change (numpy promises the raw words of its generators,
    not what its distributions make of them); where ours do, the changelog says so. Gaussian noise and what is fixed in a
    device come from published counter-based generators.
    """

    seed: int
    frame: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", check_count("seed", self.seed, at_least=0))
        object.__setattr__(self, "frame", check_count("frame", self.frame, at_least=0))

    def of(self, effect: str, block: int | None = None) -> np.random.Generator:
        """A fresh generator of the effect's stream, at its beginning; of one of its blocks, where it has several."""
        key = (self.frame, crc32(effect.encode())) if block is None else (self.frame, crc32(effect.encode()), block)
        return np.random.Generator(np.random.PCG64DXSM(np.random.SeedSequence(self.seed, spawn_key=key)))

"""
Random number streams, one per named effect.

Adding or removing an effect does not change the numbers of the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import NOT_NEGATIVE, Declared


def fixed_pattern_key(seed: int, effect: str) -> tuple[np.uint64, np.uint64]:
    """Return the generator key for the fixed pattern of an effect in a device."""
    words = np.random.SeedSequence(seed, spawn_key=(crc32(effect.encode()),)).generate_state(2, np.uint64)
    return words[0], words[1]


def derive_seed(seed: int, index: int) -> int:
    """Return a seed below 2**63 that depends only on a common seed and the index of the run."""
    return int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1, np.uint64)[0] >> np.uint64(1))


def random_key(rng: np.random.Generator) -> np.uint64:
    """
    Draw a key for the counter-based generators of :mod:`foveasim._core._kernels`.

    Their numbers cost a tenth of those of ``rng``.
    """
    return np.uint64(rng.bit_generator.random_raw())


@lru_cache(maxsize=64)
def _block_key(seed: int, frame: int, effect: str) -> NDArray[np.uint64]:
    """Return the key of the generators of all blocks of sites of an effect."""
    seeds = np.random.SeedSequence(seed, spawn_key=(frame, crc32(effect.encode())))
    return np.asarray(seeds.generate_state(2, np.uint64), np.uint64)


@dataclass(frozen=True, slots=True)
class Streams(Declared):
    """
    Random streams of one frame.

    ``seed``: seed of the run, at least 0. ``frame``: index of the frame, at least 0. ``first_block``: number of the first
    block of sites, at least 0: for part of a layout.

    A stream depends only on (seed, frame, name of the effect), not on the order of calls or on the number of threads or
    processes. The draws of a site depend on its index in the layout, not on the number of sites.

    Stability: with the same versions of this package and of numpy, a seed gives bit-identical numbers on any machine; every
    capture records both versions. Numbers may change between versions: numpy guarantees the raw words of its generators, not
    the numbers that its distributions draw from them. The changelog lists changes of this package. Gaussian noise and the
    fixed pattern of a device come from published counter-based generators.
    """

    seed: Annotated[int, NOT_NEGATIVE]
    frame: Annotated[int, NOT_NEGATIVE] = 0
    first_block: Annotated[int, NOT_NEGATIVE] = 0

    def of(self, effect: str, block: int | None = None) -> np.random.Generator:
        """
        Return a new generator at the start of the stream of an effect, or of one of its blocks.

        The streams of blocks are parts of the counter range of a Philox generator, which is created in half the time of others.
        """
        if block is not None:
            counter = np.array([0, 0, 0, self.first_block + block], np.uint64)
            return np.random.Generator(np.random.Philox(key=_block_key(self.seed, self.frame, effect), counter=counter))
        key = (self.frame, crc32(effect.encode()))
        return np.random.Generator(np.random.PCG64DXSM(np.random.SeedSequence(self.seed, spawn_key=key)))

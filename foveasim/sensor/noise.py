"""Temporal noise: one Poisson draw on the expected electrons, and Gaussian numbers, in blocks of sites."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np

from foveasim._core.random_streams import Streams
from foveasim._core.threads import each, thread_count
from foveasim._core.validation import Floats, Ints, unmasked

__all__ = ["BLOCK_SITES", "ShotNoise", "draw_shot_noise", "in_blocks", "pieces"]

ShotNoise = Literal["auto", "exact", "off"]

#: Sites that draw from one stream of an effect, one after the other; fixed, so that draws do not depend on the threads.
BLOCK_SITES = 1 << 16
#: Sites of a block that are worked on at a time: their arrays fit a core's cache.
PIECE_SITES = 1 << 13
#: Expectations beyond this are beyond numpy's Poisson generator; the Gaussian is exact to 1e-9 long before.
LARGEST_EXACT_E = 1e18
#: No charge is larger: 2**62 fits int64 with room for sums.
LARGEST_CHARGE_E = 2.0**62


def in_blocks(n_sites: int, work: Callable[[int, slice], None], n_threads: int | None = None) -> None:
    """Do some work on every block of sites: its number, and where its sites lie."""
    n_blocks = -(-n_sites // BLOCK_SITES)
    each(
        lambda block: work(block, slice(block * BLOCK_SITES, min((block + 1) * BLOCK_SITES, n_sites))),
        range(n_blocks),
        thread_count(n_threads),
    )


def pieces(block: slice) -> Iterator[slice]:
    """Split a block of sites into slices of at most ``PIECE_SITES``."""
    for first in range(block.start, block.stop, PIECE_SITES):
        yield slice(first, min(first + PIECE_SITES, block.stop))


def draw_shot_noise(
    expected_e: Floats, how: ShotNoise, gaussian_above_e: float, streams: Streams, *, n_threads: int | None = None
) -> Ints:
    """
    Electrons that are collected where so many are expected.

    Parameters
    ----------
    expected_e : (n_site,) float64, e-
    how : {"auto", "exact", "off"}
        ``"auto"``: Poisson up to ``gaussian_above_e``, above it a Gaussian of the same mean and variance, rounded; a site's
        draw does not depend on how bright the others are. ``"exact"``: Poisson everywhere. ``"off"``: the expectation, rounded.
    gaussian_above_e : float, e-
    streams : Streams
        Uses the stream ``shot``.
    n_threads : int, optional
        All cores by default. Draws do not depend on it.

    Returns
    -------
    electrons : (n_site,) int64, e-
        Never below 0. Mean and variance are those of Poisson on both sides of the switch.
    """
    from foveasim.sensor import _kernels

    expected_e = unmasked("expected_e", expected_e)
    if how == "off":
        return np.rint(np.clip(expected_e, 0.0, LARGEST_CHARGE_E)).astype(np.int64)
    electrons = np.empty(expected_e.size, np.int64)
    expected_e = np.ascontiguousarray(expected_e, np.float64)
    draw = _kernels.poisson_or_gaussian

    def block(number: int, sites: slice) -> None:
        generator = streams.of("shot", number)
        if how == "auto":
            for some in pieces(sites):
                z = generator.standard_normal(some.stop - some.start)
                draw(expected_e[some], z, gaussian_above_e, electrons[some])
            return
        is_beyond = expected_e[sites] > LARGEST_EXACT_E
        electrons[sites] = generator.poisson(np.where(is_beyond, 0.0, expected_e[sites]))
        electrons[sites][is_beyond] = np.rint(np.minimum(expected_e[sites][is_beyond], LARGEST_CHARGE_E)).astype(
            np.int64
        )

    in_blocks(expected_e.size, block, n_threads)
    return electrons

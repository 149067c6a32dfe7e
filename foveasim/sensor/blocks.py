"""Blocks of sites: what draws from one random stream, and what is in the cache at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from foveasim._core.threads import each, thread_count

__all__ = ["BLOCK_SITES", "in_blocks", "pieces"]

#: Sites that draw from one stream of an effect; fixed, so that draws do not depend on the number of threads.
BLOCK_SITES = 1 << 16
#: Sites of a block that are processed at a time, on which draws do not depend: some arrays of them fit the L2 cache (256 KiB
#: each), and interpreter time, which threads cannot share, is little for each site.
PIECE_SITES = 1 << 15


def in_blocks(n_sites: int, work: Callable[[int, slice], None], n_threads: int | None = None) -> None:
    """Call a function for every block of sites, with its number and its slice."""
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

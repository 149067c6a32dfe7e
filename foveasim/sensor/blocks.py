"""Blocks of sites: units of work for threads, of random streams, and for the CPU cache."""

from __future__ import annotations

from collections.abc import Callable

from foveasim._core.threads import parallel_map, thread_count

#: Number of sites per block, fixed so that draws do not depend on the number of threads. An array of this length (512 KiB)
#: fits the L2 cache, and the interpreter overhead per site, which threads cannot parallelise, is below 2 ns with all effects.
BLOCK_SITES = 1 << 16


def for_each_block(n_sites: int, work: Callable[[int, slice], None], n_threads: int | None = None) -> None:
    """Call a function with the number and the slice of each block of sites, in threads."""
    n_blocks = -(-n_sites // BLOCK_SITES)
    parallel_map(
        lambda block: work(block, slice(block * BLOCK_SITES, min((block + 1) * BLOCK_SITES, n_sites))),
        range(n_blocks),
        thread_count(n_threads),
    )

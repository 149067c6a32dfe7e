"""
Effort of a run of the tests, and what follows from it.

FOVEASIM_TESTS is ``default`` (no slow tests, a third of the random examples), ``all`` (a third of the tests marked ``nightly``),
or ``nightly`` (all of them, and every invariant with every row of the covering array of tests/compositions). The hash of a commit
in FOVEASIM_TESTS_COMMIT selects the third.
"""

from __future__ import annotations

import os

EFFORTS = ("default", "all", "nightly")
#: Number of parts of the nightly tests, one of which runs for each commit.
N_PARTS = 3


def effort() -> str:
    """Return the effort of this run, one of ``EFFORTS``."""
    found = os.environ.get("FOVEASIM_TESTS", "default")
    if found not in EFFORTS:
        raise ValueError(f"FOVEASIM_TESTS must be one of {', '.join(EFFORTS)}, got {found!r}")
    return found


def examples(n: int) -> int:
    """Return the number of random examples in this run, for ``n`` in the complete one."""
    return max(n // 3, min(n, 8)) if effort() == "default" else n


def commit() -> str:
    """Return the hash of the commit that is tested, else an empty string."""
    return os.environ.get("FOVEASIM_TESTS_COMMIT", "")


def is_in_part(k: int, commit_hash: str) -> bool:
    """Return whether the k-th nightly test is one of those that a commit selects."""
    return k % N_PARTS == int(commit_hash or "0", 16) % N_PARTS

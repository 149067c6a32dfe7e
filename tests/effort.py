"""
Effort of a run of the tests, and what follows from it.

FOVEASIM_TESTS is ``default`` (no slow tests, a third of the random examples), ``all``, or ``nightly`` (also every
invariant with every row of the covering array of tests/compositions).
"""

from __future__ import annotations

import os

EFFORTS = ("default", "all", "nightly")


def effort() -> str:
    """Return the effort of this run, one of ``EFFORTS``."""
    found = os.environ.get("FOVEASIM_TESTS", "default")
    if found not in EFFORTS:
        raise ValueError(f"FOVEASIM_TESTS must be one of {', '.join(EFFORTS)}, got {found!r}")
    return found


def examples(n: int) -> int:
    """Return the number of random examples in this run, for ``n`` in the complete one."""
    return max(n // 3, min(n, 8)) if effort() == "default" else n

"""Effort of the tests: the default run has a third of the examples."""

from __future__ import annotations

import os


def examples(n: int) -> int:
    """Return the number of random examples in this run, for ``n`` in the complete one."""
    return n if os.environ.get("FOVEASIM_TESTS_ALL") == "1" else max(n // 3, min(n, 8))

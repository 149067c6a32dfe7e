"""Modules with kernels, which the tests compile once."""

from __future__ import annotations

import re
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "foveasim"
KERNELS = re.compile(r"^from foveasim\._core\.jit import njit$", re.MULTILINE)


def kernel_modules():
    """Yield the names of the modules that compile kernels on import."""
    for path in sorted(PACKAGE.rglob("*.py")):
        if KERNELS.search(path.read_text()):
            yield ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)

"""Collection of doctests: none in kernels; those of foveasim.learn need PyTorch."""

from __future__ import annotations

from importlib.util import find_spec

collect_ignore_glob = [
    "foveasim/**/_*kernels.py",
    *([] if find_spec("torch") else ["foveasim/learn/*", "tests/learn/*"]),
]

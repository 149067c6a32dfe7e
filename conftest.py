"""Collection of doctests: those of foveasim.learn need PyTorch."""

from __future__ import annotations

from importlib.util import find_spec

collect_ignore_glob = [] if find_spec("torch") else ["foveasim/learn/*", "tests/learn/*"]

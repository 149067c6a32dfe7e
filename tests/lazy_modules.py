"""Modules that tests import when they use them, so that collecting the tests does not import them."""

from __future__ import annotations

import pytest


class LazyModule:
    """Stand-in for a module, which is imported at the first use; tests that use it are skipped where it is not installed."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> object:
        """Return a public attribute of the module; pytest looks for attributes of its own in all objects of test modules."""
        if attribute.startswith("_"):
            raise AttributeError(attribute)
        return getattr(pytest.importorskip(self._name), attribute)

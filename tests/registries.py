"""Registries to which tests add objects."""

from __future__ import annotations

from contextlib import contextmanager


@contextmanager
def restored(*registries):
    """Give registries their present entries again at the end."""
    before = [(registry, dict(registry), dict(registry._examples)) for registry in registries]
    try:
        yield
    finally:
        for registry, objects, with_examples in before:
            registry._objects, registry._examples = objects, with_examples
            registry.version += 1  # results for the former number are stored

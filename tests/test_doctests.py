"""Examples in docstrings."""

from __future__ import annotations

import doctest
from importlib import import_module

import pytest
from scripts import ROOT


def modules_with_examples():
    """Return the modules whose text contains examples; those of ``foveasim.learn`` require PyTorch."""
    paths = [path for path in sorted((ROOT / "foveasim").rglob("*.py")) if ">>> " in path.read_text()]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in paths]
    of_learn = pytest.mark.needs("torch")
    return [pytest.param(name, marks=[of_learn] if name.startswith("foveasim.learn") else []) for name in names]


@pytest.mark.slow(keep=60)
@pytest.mark.parametrize("name", modules_with_examples())
def test_examples_give_their_results(name):
    module = import_module(name)

    assert any(test.examples for test in doctest.DocTestFinder().find(module))
    assert doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE).failed == 0

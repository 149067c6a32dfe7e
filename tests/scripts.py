"""Scripts of the repository as modules."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import foveasim as fs

#: Directory of the repository.
ROOT = Path(fs.__file__).parents[1]


def load_script(name):
    """Return the module of a script, such as "docs/studio_pictures.py"."""
    path = ROOT / name
    specification = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module

"""Files and effects that the settings of the compositions refer to."""

from __future__ import annotations

import pytest
from reference.features import write_files
from reference.own_effects import OWN_EFFECTS
from registries import restored

from foveasim.sensor.effects import EFFECTS


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    directory = tmp_path_factory.mktemp("compositions")
    write_files(directory)
    return directory


@pytest.fixture(autouse=True, scope="module")
def own_effects():
    """Register the effects of a user."""
    with restored(EFFECTS):
        for name, effect in OWN_EFFECTS.items():
            EFFECTS.register(name, effect)
        yield


@pytest.fixture(autouse=True)
def composed(monkeypatch, files):
    """Change to the directory of the files."""
    monkeypatch.chdir(files)

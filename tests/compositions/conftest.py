"""Files and effects that the settings of the compositions refer to."""

from __future__ import annotations

import pytest
from reference.features import write_files
from reference.own_effects import OWN_EFFECTS

from foveasim.sensor.effects import EFFECTS


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    directory = tmp_path_factory.mktemp("compositions")
    write_files(directory)
    return directory


@pytest.fixture(autouse=True)
def composed(monkeypatch, files):
    """Register the effects of a user, in the directory of the files."""
    monkeypatch.setattr(EFFECTS, "_objects", {**EFFECTS, **OWN_EFFECTS})
    monkeypatch.setattr(EFFECTS, "version", EFFECTS.version + 1)
    monkeypatch.chdir(files)

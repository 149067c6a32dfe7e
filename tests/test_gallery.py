"""Gallery scripts run, check their own figures, and write to their output directory only."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import pytest

import foveasim
import foveasim.view

GALLERY = Path(foveasim.__file__).parents[1] / "gallery"
SCRIPTS = sorted(GALLERY.glob("*.py"))
#: Scripts with their requirements; -k torch selects those that require PyTorch.
PARAMETERS = [
    pytest.param(path, marks=pytest.mark.needs("torch"), id=f"{path.stem}-torch")
    if "import torch" in path.read_text()
    else pytest.param(path, id=path.stem)
    for path in SCRIPTS
]
#: Width at which the site shows a figure: 736 pixels of 1/96 inch; and the smallest text there.
SHOWN_INCHES, MIN_TEXT_PT = 736 / 96, 9.0
#: Resolution of the figures of these tests, which look at no pixels.
DOTS_PER_INCH = 40.0


@pytest.mark.nightly
@pytest.mark.slow(keep=("02_light", "25_own", "16_four"))
@pytest.mark.parametrize("path", PARAMETERS)
def test_script_runs_and_writes_its_pictures(path, tmp_path, monkeypatch):
    from matplotlib.text import Text

    monkeypatch.chdir(tmp_path)
    small = []
    save = foveasim.view.save_figure

    def save_and_measure(figure, path, dpi=150.0):
        scale = min(1.0, SHOWN_INCHES / figure.get_size_inches()[0])
        texts = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()]
        small.extend(f"{path.name}: {text.get_text()!r}" for text in texts if scale * text.get_size() < MIN_TEXT_PT)
        save(figure, path, dpi=min(dpi, DOTS_PER_INCH))

    monkeypatch.setattr(foveasim.view, "save_figure", save_and_measure)
    spec = importlib.util.spec_from_file_location(f"gallery_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # dataclasses look their modules up
    spec.loader.exec_module(module)

    module.main(tmp_path / "out", **getattr(module, "QUICK", {}))

    assert small == []
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    written = sorted((tmp_path / "out").iterdir())
    assert written
    assert all(p.name.startswith(path.stem[:3]) and p.stat().st_size > 1000 for p in written)


def test_scripts_are_numbered_with_expectations():
    assert [path.name[:3] for path in SCRIPTS] == [f"{k:02d}_" for k in range(1, len(SCRIPTS) + 1)]
    for path in SCRIPTS:
        text = path.read_text()
        assert re.search(r'^"""\n.*\?\n\nNew here: .*\n\nExpect: ', text, re.DOTALL)
        assert "assert " in text

"""Methods that draw: functions of foveasim.view with their signature and docstring."""

from __future__ import annotations

import dataclasses
import inspect
import pickle
import pydoc
import re
import subprocess
import sys

import pytest

import foveasim as fs
from foveasim import view
from foveasim._core.show import ViewMethod
from foveasim.layout import Report, Summary
from foveasim.reconstruct import CorticalImage, Picture
from foveasim.sensor import NoiseBudget

CLASSES = (
    *(fs.Camera, fs.Capture, fs.Layout, fs.Optics, fs.PowerMap, fs.Scene, fs.Sensor),
    *(CorticalImage, NoiseBudget, Picture, Report, Summary),
)
METHODS = [(kind, name) for kind in CLASSES for name, member in vars(kind).items() if isinstance(member, ViewMethod)]
LAYOUT = fs.layout.grid(n_x=3, n_y=2, pitch_um=5.0)


def test_all_classes_have_html():
    assert {kind for kind, name in METHODS if name == "_repr_html_"} == set(CLASSES)


@pytest.mark.parametrize(("kind", "name"), METHODS, ids=lambda item: getattr(item, "__name__", item))
def test_methods_have_signature_and_docstring_of_function(kind, name):
    method = vars(kind)[name]
    function = method.function
    first, *others = inspect.signature(function).parameters.values()

    assert getattr(view, function.__name__) is function
    assert list(inspect.signature(method).parameters.values())[1:] == others
    assert next(iter(inspect.signature(method).parameters)) == "self"
    assert method.__doc__.splitlines()[0] == inspect.getdoc(function).splitlines()[0]
    assert f"\n{first.name} : " not in method.__doc__
    assert all(f"\n{other.name}" in method.__doc__ or f", {other.name}" in method.__doc__ for other in others)
    assert method.__doc__.count("Parameters\n---") == bool(others)
    assert method.__qualname__ == f"{kind.__name__}.{name}"
    assert name not in {field.name for field in dataclasses.fields(kind)} if dataclasses.is_dataclass(kind) else True


def test_help_shows_method():
    text = pydoc.plain(pydoc.render_doc(fs.Layout.plot))

    assert re.search(r"plot\(\W*self,\W*by:", text)  # on one line or on several
    assert "Draw photosites" in text
    assert re.search(r"plot\(\W*self,\W*by:", pydoc.plain(pydoc.render_doc(fs.Layout)))
    assert inspect.isroutine(fs.Layout.plot)
    assert next(iter(inspect.signature(LAYOUT.plot).parameters)) == "by"


def test_bound_methods_draw_and_can_be_pickled():
    import matplotlib.pyplot as plt

    for method in (LAYOUT.plot, pickle.loads(pickle.dumps(LAYOUT.plot))):
        ax = method("area_um2", label="area / µm²")
        assert type(ax).__name__ == "Axes"
        plt.close(ax.figure)
    with pytest.raises(fs.errors.ArgumentError, match="colour"):
        LAYOUT.plot(colour="red")


def test_drawing_is_imported_on_use():
    code = "import sys, foveasim as fs; fs.Layout.plot; fs.Scene.plot.__name__; print('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"

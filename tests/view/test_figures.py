"""New figures: shown by notebooks and windows, plain objects in scripts."""

from __future__ import annotations

import subprocess
import sys
import threading

import matplotlib as mpl
import nbformat
import pytest
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from nbclient import NotebookClient

import foveasim as fs
from foveasim.view.plots import figures, hidden_figures
from foveasim.view.plots.figures import new_axes

SITES = fs.layout.grid(4, 3, 2.0)
INLINE = "module://matplotlib_inline.backend_inline"
GUI = "module://backend_of_a_test"
SCRIPT = """
import sys
import matplotlib
import foveasim as fs

sites = fs.layout.grid(4, 3, 2.0)
scene = fs.Scene.flat(shape=(60, 60), pitch_um=50.0, distance_m=0.5, radiance_w_m2_sr_nm=0.05, wavelength_nm=(500.0, 600.0))
camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=fs.Sensor(sites))
capture = camera.capture(scene, exposure_s=0.01, seed=0)
report = sites.check(fs.DesignRules(min_size_um=3.0))
for backend in (matplotlib.get_backend(auto_select=False), "qtagg"):
    matplotlib.rcParams["backend"] = backend
    for item in (sites, report, scene, camera.power_map(scene), capture, capture.picture(max_pixels=16)):
        item.plot()
        item._repr_html_()
    camera.noise_budget(scene, exposure_s=0.01).plot()
assert "matplotlib.figure" in sys.modules
assert "matplotlib.pyplot" not in sys.modules
"""


@pytest.fixture(autouse=True)
def _backend_stays():
    """Restore the backend, and close all figures."""
    before = mpl.get_backend()
    yield
    plt.close("all")
    plt.switch_backend("agg")
    mpl.rcParams["backend"] = before


@pytest.mark.slow
def test_scripts_do_not_import_pyplot(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", INLINE)  # as in programs that a notebook starts
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stderr


def test_figures_without_display_are_plain():
    plt.switch_backend("agg")
    axes = SITES.plot()

    assert type(axes.figure) is Figure
    assert plt.get_fignums() == []


@pytest.fixture
def shown_backend(monkeypatch):
    """Replace the backend by one that is not built in, such as those of notebooks and of development environments."""
    module = type(sys)("backend_of_a_test")
    agg = __import__("matplotlib.backends.backend_agg", fromlist=["FigureCanvasAgg"])
    module.FigureCanvas, module.FigureManager = agg.FigureCanvasAgg, agg.FigureManager
    monkeypatch.setitem(sys.modules, "backend_of_a_test", module)
    plt.switch_backend(GUI)


@pytest.mark.usefixtures("shown_backend")
def test_figures_belong_to_pyplot_where_shown():
    axes = SITES.plot()

    assert plt.get_fignums() == [axes.figure.number]
    assert plt.gca() is axes
    assert SITES.plot().figure is not axes.figure
    assert len(plt.get_fignums()) == 2


@pytest.mark.usefixtures("shown_backend")
def test_given_axes_make_no_figure():
    axes = Figure().add_subplot()

    assert SITES.plot(ax=axes) is axes
    assert fs.view.plot_report(SITES.check(fs.DesignRules(min_size_um=3.0)), ax=axes) is axes
    assert plt.get_fignums() == []


@pytest.mark.usefixtures("shown_backend")
def test_hidden_figures_are_plain():
    with hidden_figures():
        assert type(SITES.plot().figure) is Figure
        SITES._repr_html_()
    assert plt.get_fignums() == []
    SITES.plot()
    assert len(plt.get_fignums()) == 1


@pytest.mark.usefixtures("shown_backend")
def test_thumbnails_make_no_figure():
    report = SITES.check(fs.DesignRules(min_size_um=3.0))
    for item in (SITES, report, SITES.describe(), fs.Sensor(SITES)):
        assert item._repr_html_()

    assert plt.get_fignums() == []


def test_windows_are_opened_in_main_thread_only(monkeypatch):
    monkeypatch.setattr(mpl, "get_backend", lambda **_: "TkAgg")
    found = []
    thread = threading.Thread(target=lambda: found.append(type(SITES.plot().figure)))
    thread.start()
    thread.join()

    assert figures._is_shown()
    assert found == [Figure]


def test_backend_is_not_selected_without_pyplot(monkeypatch):
    selected = []
    monkeypatch.setattr(mpl, "get_backend", lambda auto_select=True: selected.append(auto_select))
    monkeypatch.delitem(sys.modules, "matplotlib.pyplot")

    assert type(SITES.plot().figure) is Figure
    assert selected == [False]


@pytest.mark.parametrize(
    ("ratio", "size"), [(1.0, (8.0, 8.0)), (0.5, (8.0, 4.0)), (4.0, (3.2, 8.0)), (0.01, (8.0, 3.2))]
)
def test_longer_side_of_figure_is_given(ratio, size):
    assert new_axes(8.0, ratio).figure.get_size_inches().tolist() == pytest.approx(size)


CELLS = {
    "sites = fs.layout.grid(4, 3, 2.0)\nsites": {"text/html", "text/plain"},
    "sites.plot('area_um2')": {"text/plain", "image/png"},
    "axes = sites.plot(); report = sites.check(fs.DesignRules(min_size_um=3.0))\nreport.plot();": {
        "text/plain",
        "image/png",
    },
    "report": {"text/html", "text/plain"},
    "with fs.view.hidden_figures():\n    hidden = sites.plot()": set(),
    "%matplotlib agg\nplain = sites.plot()": set(),
}


@pytest.mark.slow
def test_plots_appear_in_notebook(monkeypatch):
    monkeypatch.delenv("MPLBACKEND", raising=False)
    book = nbformat.v4.new_notebook()
    book.cells = [nbformat.v4.new_code_cell(source) for source in ("import foveasim as fs", *CELLS)]
    NotebookClient(book, timeout=120).execute()

    for cell, kinds in zip(book.cells[1:], CELLS.values(), strict=True):
        assert {kind for output in cell.outputs for kind in output.get("data", {})} == kinds, cell.source
    n_figures = [sum("image/png" in output.get("data", {}) for output in cell.outputs) for cell in book.cells[1:]]
    assert n_figures == [0, 1, 2, 0, 0, 0]

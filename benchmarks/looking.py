"""Views: pictures of many photosites, compared with matplotlib's collections and PyVista's defaults."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from report import Report, best_s

import foveasim as fs
from foveasim import view

#: Bounds for a first picture with compiled kernels: 200,000 sites, 10^6 sites, prisms of 200,000 sites.
PICTURE_S, LARGE_PICTURE_S, COLUMNS_S = 0.5, 1.5, 3.0


def sunflower_of(n_sites: int) -> tuple[fs.Layout, np.ndarray]:
    """Return a Voronoi layout with six edges per site on average, and a value for each site."""
    layout = fs.layout.sunflower(n_sites=n_sites, spacing_um=1.0)
    return layout, np.random.default_rng(0).random(layout.n_sites)


def bench_looking(report: Report, n_sites: int) -> None:
    """Draw a layout in 2D and 3D to a file, and compare with the libraries' defaults."""
    with TemporaryDirectory() as folder:
        _bench_flat(report, n_sites, Path(folder) / "picture.png")
        _bench_columns(report, n_sites // 5, Path(folder) / "picture.png")


def _bench_flat(report: Report, n_sites: int, path: Path) -> None:
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    def ours(layout: fs.Layout, values: np.ndarray) -> None:
        view.save_figure(layout.plot(values, label="value").figure, path, dpi=200)

    def peer(layout: fs.Layout, values: np.ndarray) -> None:
        ax = Figure(figsize=(8.0, 8.0)).add_subplot()
        sites = PolyCollection(np.split(layout.xy_um, layout.ring_offsets[1:-1]))
        sites.set_array(values)
        ax.add_collection(sites)
        ax.autoscale()
        ax.figure.savefig(path, dpi=200)

    for n, bound_s in ((n_sites // 5, PICTURE_S), (n_sites, LARGE_PICTURE_S)):
        layout, values = sunflower_of(n)
        times = best_s({"ours": lambda: ours(layout, values), "peer": lambda: peer(layout, values)}, 2)  # noqa: B023
        what = f"a picture of {n:,} sites, 1600 px"
        report.faster_than(what, times["ours"], "matplotlib's PolyCollection", times["peer"], 3)
        report.seconds("the same", times["ours"], bound_s)


def _bench_columns(report: Report, n_sites: int, path: Path) -> None:
    layout, values = sunflower_of(n_sites)
    size_px = (1600, 1000)
    calls = {"software": lambda: view.render(view.prisms(layout, values), path, size_px=size_px, renderer="software")}
    renderer = view.find_renderer()
    if renderer:
        os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = renderer
        import pyvista

        def defaults() -> None:
            plotter = pyvista.Plotter(off_screen=True, window_size=list(size_px))
            plotter.add_mesh(layout.to_pyvista().extrude((0.0, 0.0, 5.0), capping=True))
            plotter.screenshot(path)
            plotter.close()

        calls["ours"] = lambda: view.render(view.prisms(layout, values), path, size_px=size_px, renderer="pyvista")
        calls["defaults"] = defaults
    times = best_s(calls, 2)
    if renderer:
        what = f"a picture of {n_sites:,} columns"
        report.faster_than(what, times["ours"], "PyVista's default, equal heights", times["defaults"])
        report.seconds("the same", times["ours"], COLUMNS_S)
        report.slower_than("the same without OpenGL", times["software"], "with it", times["ours"])

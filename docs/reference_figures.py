"""Figures of the reference: one for each generator, edit, chart, pupil and plot function."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from skimage.data import astronaut

import foveasim as fs
from foveasim.layout import EDITS, LAYOUTS
from foveasim.scene import charts
from foveasim.view import plot_layout

#: Fills of photosites: neighbours differ, in the order of the channels.
FILLS = np.array(
    [(0.55, 0.7, 0.86), (0.98, 0.85, 0.55), (0.75, 0.85, 0.65), (0.9, 0.65, 0.6)]
)
#: Colour of boundaries and vertices.
LINE = "0.2"
#: Size of figures of one and of two drawings, in inches.
ONE, TWO = (4.6, 3.9), (7.4, 3.5)
#: Field of the charts: 6 cm by 8 cm, 1 m away.
FIELD = {
    "shape": (300, 400),
    "pitch_um": 200.0,
    "distance_m": 1.0,
    "band_width_nm": 10.0,
}
LIGHT = {"radiance_w_m2_sr_nm": 2.0}
#: Charts with parameters that show their structure.
CHARTS: dict[str, dict[str, Any]] = {
    "bars": {**LIGHT, "groups": [-1, 0]},
    "checkerboard": {**LIGHT, "square_mm": 8.0},
    "colour_chart": {**LIGHT, "patch_mm": 10.0, "gap_mm": 1.5},
    "grey_scale": {**LIGHT, "patch_mm": 12.0, "n_steps": 6},
    "letter_f": {**LIGHT, "height_mm": 45.0},
    "point_grid": {
        "shape": (60, 80),  # points are single pixels
        "pitch_um": 1000.0,
        "spacing_mm": 8.0,
        "n_points": (5, 7),
        "intensity_w_sr_nm": 3e-6,
    },
    "siemens_star": {**LIGHT, "n_spokes": 36},
    "sine": {**LIGHT, "line_pairs_per_mm": 0.15, "angle_deg": 30.0},
    "slanted_edge": {**LIGHT, "angle_deg": 5.0},
    "zone_plate": {**LIGHT, "line_pairs_per_mm": 1.2},
}


def pupils() -> dict[str, Any]:
    """Return a pupil of each class."""
    y, x = np.mgrid[-1:1:64j, -1:1:64j]
    return {
        "Annulus": fs.optics.Annulus(0.4),
        "Blades": fs.optics.Blades(6),
        "PupilImage": fs.optics.PupilImage(np.exp(-2.0 * (x**2 + y**2))),
        "Slit": fs.optics.Slit(0.4),
        "Spider": fs.optics.Spider(3, 0.08),
    }


def figures() -> Iterator[tuple[str, Callable[[], Figure]]]:
    """Yield complete names of the public interface, and functions that draw them."""
    for name in LAYOUTS.within("foveasim.layout.generators"):
        yield f"foveasim.layout.{name}", lambda name=name: generator(name)
    yield "foveasim.layout.fill", filled
    for name, (before, after) in edits().items():
        yield (
            f"foveasim.layout.{name}",
            lambda before=before, after=after: comparison(before(), after),
        )
    for name in CHARTS:
        yield f"foveasim.scene.charts.{name}", lambda name=name: chart(name)
    for name in pupils():
        yield f"foveasim.optics.{name}", lambda name=name: pupil(name)
    for name, draw in plots().items():
        yield f"foveasim.view.{name}", lambda draw=draw: one(draw)


def one(draw: Callable[[Axes], Any]) -> Figure:
    """Return a figure of one drawing."""
    figure = Figure(figsize=ONE, layout="constrained")
    draw(figure.add_subplot())
    return figure


def neighbours(layout: fs.Layout) -> np.ndarray:
    """Return colours (n_site, 3) that differ between neighbours."""
    return FILLS[fs.layout.graph_colouring(layout, len(FILLS)).channel]


def generator(name: str) -> Figure:
    """Draw the example of a layout generator."""
    layout = LAYOUTS[name](**LAYOUTS.example(name))
    return one(lambda axes: plot_layout(layout, neighbours(layout), ax=axes))


def filled() -> Figure:
    """Draw the fill of a region."""
    rings = fs.layout.log_polar(n_sectors=24, min_size_um=2.0, r_max_um=32.4)
    disc = shapely.Point(0.0, 0.0).buffer(10.0)
    layout = fs.layout.fill(rings, disc, size_um=2.0)
    return one(lambda axes: plot_layout(layout, neighbours(layout), ax=axes))


def squares() -> fs.Layout:
    """Return the layout that the examples of edits refer to."""
    return fs.layout.grid(n_x=4, n_y=4, pitch_um=10.0)


def rings() -> fs.Layout:
    """Return a layout whose sites are small in the centre."""
    return fs.layout.log_polar(n_sectors=16, min_size_um=2.0, r_max_um=30.1)


def loose() -> fs.Layout:
    """Return squares with gaps and overlaps of a micrometre."""
    x_um, y_um = np.meshgrid([0.0, 10.0, 21.0, 30.0], [0.0, 11.0, 20.0, 29.0])
    centres_um = np.stack((x_um.ravel(), y_um.ravel()), axis=1)
    return fs.Layout.from_rectangles(centres_um, np.full((16, 2), 10.0))


def staggered() -> fs.Layout:
    """Return rows whose vertices lie on the edges of their neighbours."""
    x_um, y_um = np.meshgrid(np.arange(4) * 10.0, np.arange(4) * 10.0)
    x_um[1::2] += 5.0
    centres_um = np.stack((x_um.ravel(), y_um.ravel()), axis=1)
    return fs.Layout.from_rectangles(centres_um, np.full((16, 2), 10.0))


def edits() -> dict[str, tuple[Callable[[], fs.Layout], Callable[..., fs.Layout]]]:
    """Return a layout and its change for each edit."""
    public = [name for name in EDITS if name in fs.layout.__all__]
    found = {
        name: (squares, lambda layout, name=name: apply(layout, name))
        for name in public
    }
    edit = fs.layout
    return found | {
        "clean": (loose, lambda layout: edit.clean(layout, 2.0)[0]),
        "cleaned": (loose, lambda layout: edit.cleaned(layout, tolerance_um=2.0)),
        "enforce": (
            rings,
            lambda layout: edit.enforce(layout, fs.DesignRules(min_size_um=3.5))[0],
        ),
        "merge": (squares, lambda layout: edit.merge(layout, np.arange(16) // 2)),
        "merge_small": (rings, lambda layout: edit.merge_small(layout, min_size_um=4)),
        "node": (staggered, edit.node),
        "random_channels": (
            squares,
            lambda layout: edit.random_channels(layout, [1.0, 2.0, 1.0], seed=0),
        ),
        "repair": (
            rings,
            lambda layout: edit.repair(layout, rules=fs.DesignRules(min_size_um=3.5)),
        ),
        "snap": (rings, lambda layout: edit.snap(layout, 1.5)),
        "union": (
            squares,
            lambda layout: edit.union([layout, layout.translate(45.0, 0.0)]),
        ),
    }


def apply(layout: fs.Layout, name: str) -> fs.Layout:
    """Return a layout after the example of an edit."""
    changed = EDITS[name](layout, **EDITS.example(name))
    return changed[0] if isinstance(changed, tuple) else changed


def comparison(before: fs.Layout, after: Callable[..., fs.Layout]) -> Figure:
    """Draw a layout before and after an edit, with its vertices."""
    changed = after(before)
    figure = Figure(figsize=TWO, layout="constrained")
    left, right = figure.subplots(1, 2)
    bounds_um = np.array([layout.bounds_um for layout in (before, changed)])
    low, high = bounds_um[:, :2].min(axis=0), bounds_um[:, 2:].max(axis=0)
    margin_um = 0.05 * (high - low).max()
    for axes, layout, title in ((left, before, "before"), (right, changed, "after")):
        colours = FILLS[layout.channel % len(FILLS)]
        if "readout_order" in layout.columns:
            colours = layout.columns["readout_order"]
        plot_layout(layout, colours, ax=axes, legend=False)
        rings = np.split(layout.xy_um, layout.ring_offsets[1:-1])
        lines = PolyCollection(
            rings, facecolor="none", edgecolor=LINE, linewidth=0.8, zorder=3
        )
        axes.add_collection(lines)
        axes.plot(*layout.xy_um.T, "o", color=LINE, markersize=2.2, zorder=3)
        axes.set_title(f"{title}: {layout.n_sites} photosites", fontsize=10)
        axes.set_xlim(low[0] - margin_um, high[0] + margin_um)
        axes.set_ylim(low[1] - margin_um, high[1] + margin_um)
    return figure


def chart(name: str) -> Figure:
    """Draw a test chart."""
    scene = getattr(charts, name)(**{**FIELD, **CHARTS[name]})
    return one(lambda axes: scene.plot(ax=axes))


def pupil(name: str) -> Figure:
    """Draw the transmission of a pupil, and its PSF."""
    shape = pupils()[name]
    figure = Figure(figsize=TWO, layout="constrained")
    left, right = figure.subplots(1, 2)
    position = np.linspace(-1.05, 1.05, 301)
    x, y = np.meshgrid(position, position)
    inside = np.hypot(x, y) <= 1.0
    transmission = np.where(inside, np.abs(shape(x, y, 550.0)) ** 2, 0.0)
    extent = (-1.05, 1.05, -1.05, 1.05)
    left.imshow(transmission, cmap="gray", vmin=0.0, vmax=1.0, extent=extent)
    left.set(title="transmission", xlabel="x / radius", ylabel="y / radius")
    optics = fs.Optics(focal_length_mm=8.0, f_number=4.0, pupil=shape)
    psf = optics.psf(550.0, pitch_um=0.1, n_points=241)
    shown = np.log10(np.maximum(psf.psf_per_um2 / psf.psf_per_um2.max(), 1e-4))
    low_x, low_y, high_x, high_y = psf.grid.bounds_um
    box = (low_x, high_x, low_y, high_y)
    right.imshow(shown, cmap="magma", extent=box, origin="lower")
    right.set(title="PSF, 4 decades, f/4, 550 nm", xlabel="x / µm", ylabel="y / µm")
    return figure


@cache
def camera() -> fs.Camera:
    """Return a small foveal colour camera."""
    layout = fs.layout.log_polar(
        n_sectors=64, min_size_um=4.0, r_max_um=300.0, stagger=True, fovea="rings"
    )
    sensor = fs.Sensor.from_preset(
        fs.layout.mosaic(layout, "RGGB"), "machine_vision", filters="rgb"
    )
    optics = fs.Optics(focal_length_mm=8.0, f_number=2.8)
    return fs.Camera(optics=optics, sensor=sensor)


@cache
def scene() -> fs.Scene:
    """Return a photograph that covers the field of the camera."""
    found = fs.Scene.from_picture(
        astronaut(), fit="cover", distance_m=1.0, illuminance_lux=500.0
    )
    return camera().fit_scene(found)


@cache
def capture() -> fs.Capture:
    """Return a capture of the photograph."""
    return camera().capture(scene(), exposure_s="auto", seed=0)


def plots() -> dict[str, Callable[[Axes], Any]]:
    """Return calls of the plot functions."""
    view = fs.view
    return {
        "plot_angular_response": lambda axes: view.plot_angular_response(
            tilted(), flat(), ax=axes
        ),
        "plot_capture": lambda axes: view.plot_capture(capture(), ax=axes),
        "plot_cortical": lambda axes: view.plot_cortical(
            capture().cortical(n_rings=40, n_sectors=80), channel=1, ax=axes
        ),
        "plot_curves": lambda axes: view.plot_curves(
            mtf_curves(), "frequency / (1/mm)", "MTF", ax=axes
        ),
        "plot_image": lambda axes: view.plot_image(
            astronaut()[::-1].mean(axis=2), (0.0, 0.0, 1.0, 1.0), "x", "y", ax=axes
        ),
        "plot_layout": lambda axes: view.plot_layout(
            camera().layout, "size_um", ax=axes
        ),
        "plot_noise_budget": lambda axes: view.plot_noise_budget(
            camera().noise_budget(scene(), exposure_s=0.01), ax=axes
        ),
        "plot_picture": lambda axes: view.plot_picture(
            capture().picture(), capture().white_dn, ax=axes
        ),
        "plot_power_map": lambda axes: view.plot_power_map(
            camera().power_map(scene()), ax=axes
        ),
        "plot_report": lambda axes: view.plot_report(
            rings().check(fs.DesignRules(min_size_um=3.5)), rings(), ax=axes
        ),
        "plot_results": lambda axes: view.plot_results(swept(), ax=axes),
        "plot_scene": lambda axes: view.plot_scene(scene(), ax=axes),
    }


def tilted() -> fs.Camera:
    """Return a camera whose photosites lie behind openings."""
    openings = fs.sensor.ApertureStack(height_um=3.0, refractive_index=1.5)
    optics = fs.Optics(focal_length_mm=4.0, f_number=2.0, exit_pupil_mm=3.0)
    sensor = fs.Sensor(
        fs.layout.grid(n_x=60, n_y=60, pitch_um=8.0), pixel_optics=openings
    )
    return fs.Camera(optics=optics, sensor=sensor)


def flat(f_number: float = 2.0) -> fs.PowerMap:
    """Return uniform light."""
    irradiance_w_m2 = 1e-2 / f_number**2
    return fs.PowerMap.from_array(
        np.full((8, 8), irradiance_w_m2), pitch_um=70.0, wavelength_nm=550.0
    )


def mtf_curves() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the MTF of a circular pupil for two f-numbers."""
    frequency = np.linspace(0.0, 600.0, 200)
    return {
        f"f/{n:g}": (
            frequency,
            fs.optics.circular_otf(frequency * 550e-6 * n),
        )
        for n in (2.8, 5.6)
    }


def swept() -> Any:
    """Return results of a sweep over the f-number."""
    import xarray as xr

    f_number = [1.4, 2.0, 2.8, 4.0, 5.6, 8.0]
    sensor = fs.Sensor.from_preset(squares(), "machine_vision")
    means = []
    for n in f_number:
        optics = fs.Optics(focal_length_mm=8.0, f_number=n)
        mean_dn, variance_dn2 = fs.Camera(optics=optics, sensor=sensor).predict(
            flat(n), exposure_s=1e-3
        )
        means.append(float(np.mean(mean_dn / np.sqrt(variance_dn2))))
    data = {"snr": ("optics.f_number", means)}
    return xr.Dataset(data, {"optics.f_number": f_number})


def names() -> set[str]:
    """Return the complete names with a figure."""
    return {name for name, _ in figures()}

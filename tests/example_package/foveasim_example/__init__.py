"""A package that adds one of each kind to foveasim, by the entry points in its ``entry_points.txt``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import shapely
from scipy.special import bdtr

import foveasim as fs
from foveasim.columns import COLUMNS, ColumnInfo
from foveasim.config import Limits, Usual, Words
from foveasim.distortion import LENSES
from foveasim.layout import (
    DERIVED_LAYERS,
    FORMATS,
    RULES,
    FileFormat,
    Rule,
    WrittenLayout,
    layout_edit,
    layout_generator,
)
from foveasim.maps import MAP_FORMATS, Found
from foveasim.metrics import METRICS, MetricInfo
from foveasim.optics import PSF_FORMATS, PUPILS, PSFGrid
from foveasim.scene import CUBE_FORMATS, DISPLAYS, SCENES, Display
from foveasim.sensor import PIXEL_OPTICS, Footprints, PixelOptics
from foveasim.sensor.effects import EFFECTS, AdditiveNoise, Collection
from foveasim.sensor.spectral import CURVES


@layout_generator(example={"n_petals": 12, "petal_um": 3.0})
def daisy(
    *,
    n_petals: Annotated[int, Limits(at_least=3, at_most=1000)],
    petal_um: Annotated[float, Limits(above=0.0, at_most=100.0), Usual(1.0, 20.0), Words("petal radius")],
) -> fs.Layout:
    """A disc with a ring of discs around it."""
    angle = 2.0 * np.pi * np.arange(n_petals) / n_petals
    ring_um = petal_um / np.sin(np.pi / n_petals)
    centres = np.stack((np.cos(angle), np.sin(angle)), axis=1) * ring_um
    discs = shapely.buffer(shapely.points(centres), 0.9 * petal_um)
    centre = shapely.Point(0.0, 0.0).buffer(ring_um - petal_um)
    return fs.Layout.from_polygons([centre, *discs], ring=np.r_[0, np.ones(n_petals, int)])


@layout_edit(example={"factor": 2.0})
def stretch_x(layout: fs.Layout, *, factor: float) -> fs.Layout:
    """Stretch the layout along x."""
    stretched = fs.Layout.from_polygons(
        [shapely.affinity.scale(polygon, factor, 1.0, origin=(0.0, 0.0)) for polygon in layout.polygons()],
        **layout.columns,
    )
    steps = [*layout.provenance.get("steps", []), f"stretch_x {factor}"]
    return stretched.with_provenance({**layout.provenance, "steps": steps})


@DERIVED_LAYERS.register("pad", example={"radius_um": 2.0}, expected=16.0 * 32.0 * np.sin(np.pi / 16.0) / 2.0 * 4.0)
def pad(layout: fs.Layout, *, radius_um: float = 1.0) -> np.ndarray:
    """Return a polygon with 32 corners at the centroid of each site."""
    return shapely.buffer(shapely.points(layout.centroid_um), radius_um, quad_segs=8)


@EFFECTS.register("supply_ripple", example={"sigma_v": 2e-3})
@dataclass(frozen=True)
class SupplyRipple(AdditiveNoise):
    """Noise of the supply on the output voltage."""

    name = "supply_ripple"
    stage = "output"

    sigma_v: float = 1e-3

    def deviation(self, sites):
        """Return the standard deviation, V."""
        return self.sigma_v


@EFFECTS.register("binary_gates", example={"n_gates": 900})
@dataclass(frozen=True)
class BinaryGates(Collection):
    """Gates that count at most one photon each: the number of those that fired is binomial."""

    name = "binary_gates"
    needs_layout = False

    n_gates: int = 100

    def cumulative(self, count, mean, *, sites):
        """Return the probability of at most ``count`` fired gates."""
        return bdtr(np.minimum(count, self.n_gates), self.n_gates, -np.expm1(-mean / self.n_gates))

    def moments(self, mean, variance, *, sites):
        """Return mean and variance of the number of fired gates."""
        dark = np.exp(-mean / self.n_gates)  # probability that a gate does not fire
        return self.n_gates * (1.0 - dark), variance * dark**2 + self.n_gates * dark * (1.0 - dark)


@PIXEL_OPTICS.register("baffle", example={"max_tangent": 0.1}, expected=0.3204)
@dataclass(frozen=True)
class Baffle(PixelOptics):
    """A baffle that absorbs rays beyond an angle."""

    max_tangent: float

    def footprints(self, sites, incidence):
        """Return the fraction of the rays of each site that the baffle transmits."""
        cones = incidence.with_rings(24)
        is_open = np.hypot(*np.moveaxis(cones.tangents, -1, 0)) <= self.max_tangent
        return Footprints(np.minimum((cones.weights * is_open).sum(axis=1), 1.0))


min_roundness = Rule(
    "a site is at least so round; a circle has 1",
    "",
    lambda case: 4.0 * np.pi * case.layout.area_um2 / shapely.length(case.polygons) ** 2,
)
RULES.register("min_roundness", min_roundness, example={"satisfied": 0.78, "violated": 0.79})  # π/4 for squares


def read_boxes(path: Path) -> fs.Layout:
    """Read rectangles: a line with x0, y0, x1, y1 per site, in µm, after the first line."""
    low_high = np.loadtxt(path, skiprows=1, ndmin=2)
    return fs.Layout.from_polygons(list(shapely.box(*low_high.T)))


def write_boxes(layout: fs.Layout, path: Path, *, digits: int = 3) -> WrittenLayout:
    """Write the bounding boxes of the sites."""
    np.savetxt(path, shapely.bounds(layout.polygons()), fmt=f"%.{digits}f", header="BOXES", comments="")
    return WrittenLayout(
        path=path,
        n_sites=layout.n_sites,
        max_displacement_um=10.0**-digits,
        worst_area_error=0.0,
        dropped_columns=tuple(sorted(layout.columns)),
    )


def example_boxes(path: Path) -> fs.Layout:
    """Write two rectangles."""
    path.write_text("BOXES\n0 0 2 2\n2 1 5 2\n", encoding="utf-8")
    return fs.Layout.from_rectangles([[1.0, 1.0], [3.5, 1.5]], [[2.0, 2.0], [3.0, 1.0]])


boxes = FileFormat(
    title="boxes",
    suffixes=(".boxes",),
    signatures=(b"BOXES",),
    read=read_boxes,
    write=write_boxes,
    write_options=("digits",),
)
FORMATS.register("boxes", boxes, example=example_boxes)


def read_lines(path: Path, name: str | None) -> fs.scene.Cube:
    """Read one band: a table of radiance, W/(m² sr nm), top row first, after a header line."""
    values = np.loadtxt(path, skiprows=1, ndmin=2)[np.newaxis]
    return fs.scene.Cube(data=values, wavelength=[550.0], band_width_nm=[10.0], unit="W m-2 sr-1 nm-1")


def example_lines(path: Path) -> np.ndarray:
    """Write a picture of 2 x 2 pixels, and return it bottom row first."""
    path.write_text("LINES\n1 2\n3 4\n", encoding="utf-8")
    return np.array([[[3.0, 4.0], [1.0, 2.0]]])


lines = FileFormat(title="lines", suffixes=(".lines",), signatures=(b"LINES",), read=read_lines)
CUBE_FORMATS.register("lines", lines, example=example_lines)


def read_spot(path: Path) -> PSFGrid:
    """Read a PSF of samples of 1 µm at 550 nm, lowest row first, after a header line."""
    values = np.loadtxt(path, skiprows=1, ndmin=2)
    return PSFGrid.from_arrays(values, x_um=0.0, y_um=0.0, wavelength_nm=550.0, pitch_um=1.0, centre="middle")


def example_spot(path: Path) -> PSFGrid:
    """Write a PSF without symmetry."""
    values = np.pad([[1.0, 2.0], [4.0, 8.0]], 2)
    path.write_text("SPOT\n" + "\n".join(" ".join(map(str, row)) for row in values), encoding="utf-8")
    return PSFGrid.from_arrays(values, x_um=0.0, y_um=0.0, wavelength_nm=550.0, pitch_um=1.0, centre="middle")


spot = FileFormat(title="spot", suffixes=(".spot",), signatures=(b"SPOT",), read=read_spot)
PSF_FORMATS.register("spot", spot, example=example_spot)


def example_powers(path: Path) -> fs.PowerMap:
    """Write a table of two rows, the top row first."""
    path.write_text("POWER\n1 2 3\n4 5 6\n", encoding="utf-8")
    return fs.PowerMap.from_array(np.array([[4.0, 5.0, 6.0], [1.0, 2.0, 3.0]]), pitch_um=1.0, wavelength_nm=550.0)


def read_powers(path: Path, name: str | None) -> Found:
    """Read a table of irradiance in cells of 1 µm, W/m²."""
    values = np.loadtxt(path, skiprows=1, ndmin=2)
    return Found(data=values, is_y_descending=True, pitch_um=(1.0, 1.0), wavelength_nm=[550.0], unit="w_m2")


powers = FileFormat(title="powers", suffixes=(".powers",), signatures=(b"POWER",), read=read_powers)
MAP_FORMATS.register("powers", powers, example=example_powers)


@CURVES.register("comb", example={"period_nm": 100.0}, expected={500.0: 1.0, 525.0: 0.5, 550.0: 0.0})
@dataclass(frozen=True)
class Comb:
    """A curve with periodic maxima."""

    period_nm: float

    def __call__(self, wavelength_nm):
        """Return the values at the wavelengths."""
        return 0.5 + 0.5 * np.cos(2.0 * np.pi * np.asarray(wavelength_nm) / self.period_nm)


@SCENES.register(
    "half_plane", example={"shape": (4, 6), "pitch_um": 100.0, "distance_m": 1.0}, expected=("...###",) * 2
)
def half_plane(*, shape: tuple[int, int], pitch_um: float, distance_m: float, wavelength_nm: float = 550.0) -> fs.Scene:
    """A chart: dark on the left, bright on the right."""
    picture = np.zeros(shape)
    picture[:, shape[1] // 2 :] = 1.0
    return fs.Scene.from_picture(
        picture,
        pitch_um=pitch_um,
        distance_m=distance_m,
        wavelength_nm=wavelength_nm,
        band_width_nm=10.0,
        peak_radiance_w_m2_sr_nm=0.02,
    )


@DISPLAYS.register("amber", example={"pitch_um": 300.0}, expected=((0.5125, 0.4866),))
def amber(*, pitch_um: float = 250.0) -> Display:
    """A monochrome display with light at 580 nm."""
    return Display(
        wavelength_nm=[570.0, 580.0, 590.0], primaries=[[0.0, 1.0, 0.0]], pitch_um=pitch_um, white_cd_m2=90.0
    )


@PUPILS.register("half_moon", expected=0.5)
@dataclass(frozen=True)
class HalfMoon:
    """A pupil that lets light through its upper half."""

    tilt: float = 0.0

    def __call__(self, x, y, wavelength_nm):
        """Return the amplitude at pupil coordinates."""
        return (y > self.tilt).astype(float)

    def edges(self):
        """Return the line between the halves."""
        return fs.optics.PupilEdges(lines_y=[self.tilt])


@LENSES.register("magnifier", example={"factor": 1.2}, expected={(5.0, 10.0): (6.0, 12.0)})
@dataclass(frozen=True)
class Magnifier:
    """A lens model that enlarges everything."""

    focal_um = 8000.0
    centre_um = (0.0, 0.0)

    factor: float = 1.1

    def distort(self, xy_um, *, outside="error"):
        """Return real positions of ideal ones."""
        return np.asarray(xy_um) * self.factor

    def undistort(self, xy_um, *, outside="error"):
        """Return ideal positions of real ones."""
        return np.asarray(xy_um) / self.factor


@METRICS.register("darkest_code_dn", info=MetricInfo(title="lowest code", unit="DN"))
def darkest_code_dn(shot, camera, capture, sites=slice(None)):
    """Return the lowest code."""
    return int(capture.code[sites].min())


@COLUMNS.register("charge_density", info=ColumnInfo(title="charge density", unit="e-/µm²", is_signal=True))
def charge_density(capture):
    """Return the charge of each site over its area, (n_site,) e-/µm²."""
    return capture.electrons / capture.layout.area_um2

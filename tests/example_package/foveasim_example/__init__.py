"""A package that adds one of each kind to foveasim, by the entry points in its ``entry_points.txt``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

import foveasim as fs
from foveasim.layout import FileFormat, Rule, WrittenLayout, layout_family
from foveasim.sensor.effects import AdditiveNoise


@layout_family(example={"n_petals": 12, "petal_um": 3.0})
def daisy(*, n_petals: int, petal_um: float) -> fs.Layout:
    """A disc with a ring of discs around it."""
    angle = 2.0 * np.pi * np.arange(n_petals) / n_petals
    ring_um = petal_um / np.sin(np.pi / n_petals)
    centres = np.stack((np.cos(angle), np.sin(angle)), axis=1) * ring_um
    discs = shapely.buffer(shapely.points(centres), 0.9 * petal_um)
    centre = shapely.Point(0.0, 0.0).buffer(ring_um - petal_um)
    return fs.Layout.from_polygons([centre, *discs], ring=np.r_[0, np.ones(n_petals, int)])


@dataclass(frozen=True)
class SupplyRipple(AdditiveNoise):
    """Noise of the supply on the output voltage."""

    name = "supply_ripple"
    stage = "output"

    sigma_v: float = 1e-3

    def deviation(self, sites):
        """Return the standard deviation, V."""
        return self.sigma_v


min_roundness = Rule(
    "a site is at least so round; a circle has 1",
    "",
    lambda case: 4.0 * np.pi * case.layout.area_um2 / shapely.length(case.polygons) ** 2,
)


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


boxes = FileFormat(
    title="boxes",
    suffixes=(".boxes",),
    signatures=(b"BOXES",),
    read=read_boxes,
    write=write_boxes,
    write_options=("digits",),
)


def read_lines(path: Path, name: str | None) -> fs.scene.Cube:
    """Read one band: a table of radiance, W/(m² sr nm), top row first, after a header line."""
    values = np.loadtxt(path, skiprows=1, ndmin=2)[np.newaxis]
    return fs.scene.Cube(data=values, wavelength=[550.0], band_width_nm=[10.0], unit="W m-2 sr-1 nm-1")


lines = FileFormat(title="lines", suffixes=(".lines",), signatures=(b"LINES",), read=read_lines)


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


@dataclass(frozen=True)
class HalfMoon:
    """A pupil that lets light through its upper half."""

    tilt: float = 0.0

    def __call__(self, x, y, wavelength_nm):
        """Return the amplitude at pupil coordinates."""
        return (y > self.tilt).astype(float)


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


def darkest_code_dn(shot, camera, capture):
    """Return the lowest code."""
    return int(capture.code.min())

"""Checks of extensions: everything that is registered passes, and wrong objects of each kind are found."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import count

import numpy as np
import pytest
import shapely
from registries import restored

import foveasim as fs
from foveasim._core.extras import EXTRA_OF
from foveasim.columns import COLUMNS
from foveasim.distortion import LENSES
from foveasim.errors import ParameterError
from foveasim.layout import (
    DERIVED_LAYERS,
    EDITS,
    FORMATS,
    LAYOUTS,
    RULES,
    FileFormat,
    LayoutLayer,
    Rule,
    layout_generator,
)
from foveasim.maps import MAP_FORMATS, Found
from foveasim.metrics import METRICS
from foveasim.optics import PSF_FORMATS, PUPILS, PSFGrid, PupilEdges
from foveasim.scene import CUBE_FORMATS, DISPLAYS, SCENES
from foveasim.sensor import PIXEL_OPTICS, Footprints, PixelOptics
from foveasim.sensor.effects import EFFECTS, AdditiveNoise, Effect, FixedFactor, FixedOffset
from foveasim.sensor.spectral import CURVES
from foveasim.testing import check_all, check_extension, extensions

REGISTRIES = (
    LAYOUTS, EDITS, RULES, FORMATS, DERIVED_LAYERS, MAP_FORMATS, CUBE_FORMATS, EFFECTS, PIXEL_OPTICS, CURVES, SCENES, DISPLAYS, PUPILS, LENSES,
    METRICS, PSF_FORMATS, COLUMNS,
)  # fmt: skip
NUMBERS = count()
#: Kinds whose files are read in several new processes.
SLOW = {"power map format", "cube format"}


def marks_of(kind, name):
    libraries = [module for module, extra in EXTRA_OF.items() if extra == "dxf"] if name == "dxf" else []
    skip = [pytest.mark.skip(reason="in tests/interop")] if any(find_spec(m) is None for m in libraries) else []
    return skip + ([pytest.mark.slow] if kind in SLOW else [])


@pytest.mark.parametrize(
    ("kind", "name"),
    [pytest.param(kind, name, marks=marks_of(kind, name)) for kind, name in extensions() if " of test_" not in name],
)
def test_extension_passes_its_check(kind, name):
    check_extension(kind, name)


def test_every_registry_has_a_check():
    assert {kind for kind, _ in extensions()} | {"effect"} == {registry.kind for registry in REGISTRIES}


# -- layouts ----------------------------------------------------------------------------------------------------------


def overlapping(*, side_um: float) -> fs.Layout:
    return fs.Layout.from_rectangles([[0.0, 0.0], [0.9 * side_um, 0.0]], side_um)


def varying(*, side_um: float) -> fs.Layout:
    return fs.Layout.from_rectangles([[0.0, 0.0], [2.0 * side_um, float(next(NUMBERS))]], side_um)


def with_fixed_gap(*, side_um: float) -> fs.Layout:
    return fs.Layout.from_rectangles([[0.0, 0.0], [side_um + 0.5, 0.0]], side_um)


def single(*, side_um: float) -> fs.Layout:
    return fs.Layout.from_rectangles([[0.0, 0.0]], side_um)


def unrecorded_scale(layout):
    return fs.Layout.from_polygons(shapely.affinity.scale(shapely.MultiPolygon(list(layout.polygons())), 2, 2).geoms)


def doubled_sites(layout):
    return fs.Layout.from_polygons([*layout.polygons(), *layout.polygons()])


LIMITS = {"satisfied": 9.0, "violated": 11.0}
sizes = Rule("the size of a site is at least the limit", "µm", lambda case: np.sqrt(case.layout.area_um2))


def second_neighbours(layout, *, margin_um: float):
    """Polygons that depend on other sites."""
    return shapely.buffer(layout.polygons(), -margin_um * min(layout.n_sites, 2), join_style="mitre")


# -- files ------------------------------------------------------------------------------------------------------------


def write_corners(path):
    """Write the corners of two rectangles."""
    np.savetxt(path, [[0.0, 0.0, 1.0, 1.0], [0.0, 2.0, 3.0, 3.0]])
    return fs.Layout.from_rectangles([[0.5, 0.5], [1.5, 2.5]], [[1.0, 1.0], [3.0, 1.0]])


def read_corners(path):
    return fs.Layout.from_polygons(list(shapely.box(*np.loadtxt(path).T)))


def read_reflected(path):
    return fs.Layout.from_polygons(list(shapely.box(*(np.loadtxt(path) * [1, -1, 1, -1]).T)))


def write_table(path):
    np.savetxt(path, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    return fs.PowerMap.from_array(np.array([[4.0, 5.0, 6.0], [1.0, 2.0, 3.0]]), pitch_um=2.0, wavelength_nm=550.0)


def read_table(path, name, *, top_row_first=True, unit="w_m2"):
    values = np.loadtxt(path)
    return Found(data=values, is_y_descending=top_row_first, pitch_um=(2.0, 2.0), wavelength_nm=[550.0], unit=unit)


def remembered(path, name):
    return replace(read_table(path, name), data=np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))


def write_radiance(path):
    np.savetxt(path, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    return np.array([[[4.0, 5.0, 6.0], [1.0, 2.0, 3.0]]])


def read_radiance(path, name, *, factor=1.0, top_row_first=True):
    return fs.scene.Cube(
        data=factor * np.loadtxt(path)[np.newaxis],
        is_y_descending=top_row_first,
        wavelength=[550.0],
        band_width_nm=[10.0],
        unit="W m-2 sr-1 nm-1",
    )


def psfs_of(values, **changes):
    about = {"x_um": 0.0, "y_um": 0.0, "wavelength_nm": 550.0, "pitch_um": 2.0, "centre": "fft", **changes}
    return PSFGrid.from_arrays(np.pad(values, 3), **about)


def write_psf(path):
    np.savetxt(path, [[1.0, 2.0], [3.0, 4.0]])
    return psfs_of([[3.0, 4.0], [1.0, 2.0]])


def read_psf(path, **changes):
    return psfs_of(np.loadtxt(path).reshape(2, 2)[::-1], **changes)


def text_format(read):
    return FileFormat(title="test", suffixes=(".wrong",), matches=lambda path, _: path.suffix == ".wrong", read=read)


# -- sensor -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ripple(AdditiveNoise):
    name = "ripple"
    stage = "output"

    sigma_v: float = 2e-3

    def deviation(self, sites):
        return self.sigma_v


class SameEachFrame(Ripple):
    def apply(self, values, *, sites, rng):
        return values + self.sigma_v * np.random.default_rng(0).standard_normal(values.size)


class Irreproducible(Ripple):
    def apply(self, values, *, sites, rng):
        return values + self.sigma_v * np.random.default_rng(next(NUMBERS)).standard_normal(values.size)


class Underestimated(Ripple):
    def moments(self, mean, variance, *, sites):
        return mean, variance + (0.95 * self.sigma_v) ** 2


class Biased(Ripple):
    def apply(self, values, *, sites, rng):
        return values + self.sigma_v * (rng.standard_normal(values.size) + 0.05)


class OfBlock(Ripple):
    def moments(self, mean, variance, *, sites):
        return mean, variance + self.sigma_v**2 * np.linspace(0.5, 1.5, sites.n_sites)

    def apply(self, values, *, sites, rng):
        return values + self.sigma_v * np.sqrt(np.linspace(0.5, 1.5, sites.n_sites)) * rng.standard_normal(values.size)


@dataclass(frozen=True)
class Pattern(FixedFactor):
    name = "pattern"
    stage = "photo"

    sigma: float = 0.05

    def pattern(self, sites):
        return 1.0 + self.sigma * sites.device.normals(self.name)

    def pattern_moments(self, sites):
        return 1.0, self.sigma**2


@dataclass(frozen=True)
class Absorber(PixelOptics):
    response: float = 0.8

    def footprints(self, sites, incidence):
        return Footprints(np.full(sites.n_sites, self.response))


@dataclass(frozen=True)
class OfIndex(PixelOptics):
    def footprints(self, sites, incidence):
        return Footprints(1.0 / (1.0 + np.arange(sites.n_sites)))


@dataclass(frozen=True)
class Shrunk(PixelOptics):
    def footprints(self, sites, incidence):
        outlines = fs.layout.inset(sites, 0.1)
        return Footprints(outlines.area_um2 / sites.area_um2, outlines)


@dataclass(frozen=True)
class Redrawn(Effect):
    name = "redrawn"
    stage = "charge"
    is_temporal = False

    def apply(self, values, *, sites, rng):
        return values * (1.0 + 1e-3 * next(NUMBERS))

    def moments(self, mean, variance, *, sites):
        return mean, variance


class SameDevices(Pattern):
    def pattern(self, sites):
        return 1.0 + self.sigma * np.random.default_rng(0).standard_normal(sites.n_sites)


class UnknownVariance(Pattern):
    def pattern_moments(self, sites):
        return 1.0, 0.0


class WrongVariance(Pattern):
    def pattern_moments(self, sites):
        return 1.0, (0.9 * self.sigma) ** 2


@dataclass(frozen=True)
class Position(FixedOffset):
    """Offset by position that claims not to need the layout."""

    name = "position"
    stage = "output"
    needs_layout = False

    step_v: float = 0.1

    def pattern(self, sites):
        return self.step_v * np.arange(sites.n_sites) / sites.n_sites


def percent(wavelength_nm):
    return 50.0 + 0.0 * np.asarray(wavelength_nm)


def mean_of_all(wavelength_nm):
    return np.full(np.shape(wavelength_nm), 0.5 + 1e-4 * np.size(wavelength_nm))


def micrometres(wavelength_nm):
    return np.where(np.abs(np.asarray(wavelength_nm) - 0.55) < 0.1, 0.8, 0.1)


# -- scenes -----------------------------------------------------------------------------------------------------------

PICTURE = {"shape": (8, 8), "pitch_um": 100.0, "distance_m": 1.0, "radiance_w_m2_sr_nm": 0.1}
CORNER = ("#.", "..")


def scene_of(image, pitch_um, distance_m, radiance_w_m2_sr_nm):
    """Return the scene of an array, row 0 the lowest row."""
    return fs.Scene(
        basis=np.asarray(image, np.float32)[np.newaxis],
        spectrum_w_m2_sr_nm=np.array([[radiance_w_m2_sr_nm]]),
        wavelength_nm=np.array([550.0]),
        band_width_nm=np.array([10.0]),
        pitch_um=pitch_um,
        distance_m=distance_m,
    )


def corner_image(shape, pitch_um, side_mm):
    """Return a bright square at the upper left corner."""
    edges = [np.clip(side_mm - 1e-3 * pitch_um * np.arange(n), 0.0, 1e-3 * pitch_um) / (1e-3 * pitch_um) for n in shape]
    return np.multiply.outer(edges[0][::-1], edges[1])


def corner(*, shape: tuple[int, int], pitch_um: float, distance_m: float, radiance_w_m2_sr_nm: float) -> fs.Scene:
    """Return a bright square at the upper left corner."""
    return scene_of(corner_image(shape, pitch_um, 0.4), pitch_um, distance_m, radiance_w_m2_sr_nm)


def chart_of(image):
    """Return a chart with another image."""

    def wrong(*, shape: tuple[int, int], pitch_um: float, distance_m: float, radiance_w_m2_sr_nm: float) -> fs.Scene:
        """Return a chart."""
        return scene_of(image(shape, pitch_um), pitch_um, distance_m, radiance_w_m2_sr_nm)

    return wrong


def dim(*, shape: tuple[int, int], pitch_um: float, distance_m: float, radiance_w_m2_sr_nm: float) -> fs.Scene:
    """Return a chart that ignores the radiance."""
    return scene_of(corner_image(shape, pitch_um, 0.4), pitch_um, distance_m, 0.1)


def near(*, shape: tuple[int, int], pitch_um: float, distance_m: float, radiance_w_m2_sr_nm: float) -> fs.Scene:
    """Return a chart at another distance."""
    return scene_of(corner_image(shape, pitch_um, 0.4), pitch_um, 2.0 * distance_m, radiance_w_m2_sr_nm)


def with_nan(shape, pitch_um):
    return np.where(corner_image(shape, pitch_um, 0.4) > 0.0, 1.0, np.nan)


def dithered(shape, pitch_um):
    return corner_image(shape, pitch_um, 0.4) * (1.0 - 0.1 * (np.indices(shape).sum(axis=0) % 2) * (pitch_um < 100.0))


LINES = {
    "wavelength_nm": [450.0, 550.0, 650.0], "primaries": np.eye(3)[::-1], "pitch_um": 200.0, "white_cd_m2": 100.0,
    "black_cd_m2": 0.5,
}  # fmt: skip


class Backlit(fs.scene.Display):
    """A display that shows another black than it declares."""

    contrast = 50.0


# -- optics -----------------------------------------------------------------------------------------------------------


def half(x, y):
    return (np.asarray(y) > 0.2).astype(float) + 0.0 * x


class Edgeless:
    def __call__(self, x, y, wavelength_nm):
        return half(x, y)


class Displaced(Edgeless):
    def edges(self):
        return PupilEdges(lines_y=[0.3])


class Amplifier(Edgeless):
    def __call__(self, x, y, wavelength_nm):
        return 1.2 + 0.0 * x + 0.0 * y


class Undefined(Edgeless):
    def __call__(self, x, y, wavelength_nm):
        return np.where(np.asarray(x) + y > 0.5, np.nan, 1.0)


class Open(Edgeless):
    def __call__(self, x, y, wavelength_nm):
        return 1.0 + 0.0 * x + 0.0 * y


@dataclass(frozen=True)
class Magnifier:
    focal_um = 8000.0
    centre_um = (0.0, 0.0)

    factor: float = 1.1
    inverse: float = 1.0 / 1.1
    shift_um: float = 0.0

    def distort(self, xy_um, *, outside="error"):
        return np.asarray(xy_um) * self.factor + self.shift_um

    def undistort(self, xy_um, *, outside="error"):
        return (np.asarray(xy_um) - self.shift_um) * self.inverse


@dataclass
class Changeable:
    factor: float = 1.1
    focal_um: float = 8000.0
    centre_um: tuple = (0.0, 0.0)
    distort, undistort = Magnifier.distort, Magnifier.undistort


# -- metrics ----------------------------------------------------------------------------------------------------------


def counted(shot, camera, capture):
    return next(NUMBERS)


def undefined(shot, camera, capture):
    return float("nan")


def identity(shot, camera, capture):
    return id(capture)


def as_list(shot, camera, capture):
    return {"codes": None}


def of_each_filter(capture):
    return np.bincount(capture.filter_of_site)


def names_of_filters(capture):
    return np.array(capture.filter_names)[capture.filter_of_site]


def changing(capture):
    return capture.code + float(next(NUMBERS))


def brightened(shot, camera, capture):
    code = capture.code
    code.flags.writeable = True
    code += 1
    return float(code.mean())


WRONG = [
    # kind's registry, object, example, expected result, message
    (LAYOUTS, overlapping, {"side_um": 2.0}, None, "has sites that overlap, by up to 0.4 µm²"),
    (LAYOUTS, varying, {"side_um": 2.0}, None, "must return the same layout for the same parameters"),
    (LAYOUTS, with_fixed_gap, {"side_um": 2.0}, None, "must have twice the coordinates for twice the lengths"),
    (LAYOUTS, single, {"side_um": 2.0}, None, "must record its name in the provenance; decorate it with layout_generator"),
    (LAYOUTS, single, {}, None, r"cannot be called with its example \(missing a required argument: 'side_um'\)"),
    (LAYOUTS, lambda: 3, {}, None, "must return a Layout, got int"),
    (EDITS, unrecorded_scale, {}, None, "must record the step in the provenance"),
    (EDITS, doubled_sites, {}, None, "has sites that overlap, by up to 100 µm²"),
    (RULES, sizes, {}, None, "has no limits that are satisfied and violated"),
    (RULES, replace(sizes, is_upper=True), LIMITS, None, "must not be violated by the limit 9.0 of its example"),
    (RULES, replace(sizes, measure=lambda case: case.layout.area_um2), LIMITS, None, "must be violated by the limit 11.0"),
    (FORMATS, text_format(read_corners), None, None, "has no example; register it with a function of a path"),
    (FORMATS, text_format(read_reflected), write_corners, None, "returns sites that are displaced by up to 5 µm"),
    (FORMATS, text_format(lambda _: fs.Layout.from_rectangles([[0.5, 0.5]], 1.0)), write_corners, None, "returns 1 sites"),
    (DERIVED_LAYERS, lambda layout: layout.polygons(), {}, None, "has no known area; register it with expected="),
    (DERIVED_LAYERS, lambda layout: layout.polygons(), {}, 81.0, "has 1600 µm², expected 81 µm²"),
    (DERIVED_LAYERS, second_neighbours, {"margin_um": 0.5}, 1024.0, "must depend on the outline of each site only"),
    (DERIVED_LAYERS, LayoutLayer(lambda layout: [shapely.box(0, 0, 9, 9)]), {}, 81.0, "must move with the layout"),
    (MAP_FORMATS, text_format(lambda p, n: read_table(p, n, top_row_first=False)), write_table, None, "returns other values"),
    (MAP_FORMATS, text_format(lambda p, n: read_table(p, n, unit="W cm-2")), write_table, None, "returns other values"),
    (MAP_FORMATS, text_format(remembered), write_table, None, "must not read a truncated file as if it were complete"),
    (CUBE_FORMATS, text_format(lambda p, n: read_radiance(p, n, factor=2.0)), write_radiance, None, "returns another radiance"),
    (CUBE_FORMATS, text_format(lambda p, n: read_radiance(p, n, top_row_first=False)), write_radiance, None,
     "returns another radiance"),
    (CUBE_FORMATS, text_format(read_radiance), {}, None, "has no example; register it with a function of a path"),
    (PSF_FORMATS, text_format(lambda p: psfs_of(np.loadtxt(p))), write_psf, None, "returns other values; check that PSFs are up"),
    (PSF_FORMATS, text_format(lambda p: read_psf(p, x_um=5.0)), write_psf, None, "returns other points of the field"),
    (PSF_FORMATS, text_format(lambda p: read_psf(p, pitch_um=1.0)), write_psf, None, "returns other wavelengths or another dist"),
    (PSF_FORMATS, text_format(lambda p: read_psf(p, centre=(3.9, 4.0))), write_psf, None, "returns another position of the image"),
    (PSF_FORMATS, text_format(lambda p: read_psf(p, samples="bins")), write_psf, None, "returns samples='bins'"),
    (PSF_FORMATS, text_format(lambda p: read_psf(p, relative_illumination=[[0.5]])), write_psf, None, "returns another relative"),
    (PSF_FORMATS, text_format(lambda _: psfs_of(np.ones((4, 4)))), write_psf, None, "returns PSFs of shape"),
    (EFFECTS, SameEachFrame, {}, None, "is temporal, but two frames are the same"),
    (EFFECTS, Irreproducible, {}, None, "must draw the same numbers for the same seed"),
    (EFFECTS, Underestimated, {}, None, r"has draws whose variance differs by 1\d.\d+% from that of predict"),
    (EFFECTS, Biased, {}, None, r"has draws whose mean differs by 0.05\d* standard deviations from that of predict\(\)"),
    (EFFECTS, OfBlock, {}, None, r"has other moments\(\) in a block of sites; use sites.select\(\)"),
    (EFFECTS, Redrawn, {}, None, "must draw the same numbers for the same seed|is not temporal, but two frames differ"),
    (EFFECTS, SameDevices, {}, None, "has a variance over devices, but two devices are the same"),
    (EFFECTS, UnknownVariance, {}, None, "has no variance over devices, but two devices differ"),
    (EFFECTS, WrongVariance, {}, None, r"has draws whose variance differs by 2\d.\d+% from that of moments\(\) over devices"),
    (EFFECTS, Position, {}, None, "has another effect in a part of the sensor, such as a tile"),
    (EFFECTS, lambda: 3, {}, None, "must return an Effect, got int"),
    (PIXEL_OPTICS, Absorber, {}, 0.7, "has the response 0.8000 of a square of 10 µm on the axis, expected 0.7000"),
    (PIXEL_OPTICS, OfIndex, {}, None, "must give each site the response that it has in any part of a sensor"),
    (PIXEL_OPTICS, Shrunk, {}, None, "must return the areas of its outlines over those of the sites as 'area_ratio'"),
    (PIXEL_OPTICS, lambda: 3, {}, None, "must return PixelOptics, got int"),
    (CURVES, lambda: percent, {}, None, "must be from 0 to 1, got 50 at 300 nm"),
    (CURVES, lambda: mean_of_all, {}, None, "must act on each wavelength separately"),
    (CURVES, lambda: micrometres, {}, {550.0: 0.8}, "is 0.1 at 550 nm, expected 0.8"),
    (SCENES, chart_of(lambda shape, pitch_um: corner_image(shape, pitch_um, 0.4)[:, ::-1]), PICTURE, CORNER,
     r"has the arrangement \['.#', '..'\], expected \['#.', '..'\]; row 0"),
    (SCENES, chart_of(lambda shape, pitch_um: corner_image(shape, pitch_um, 0.4)[::-1]), PICTURE, CORNER, "has the arrangement"),
    (SCENES, chart_of(lambda shape, pitch_um: corner_image(shape, pitch_um, 0.8)), PICTURE, CORNER, "has the arrangement"),
    (SCENES, chart_of(lambda shape, pitch_um: corner_image(shape, 100.0, 0.4)), PICTURE, CORNER,
     "differs by up to 100.0% of white from the mean of 2 x 2 finer pixels; sizes must not depend on pitch_um"),
    (SCENES, chart_of(dithered), PICTURE, CORNER, "differs by up to 5.0% of white from the mean of 2 x 2 finer pixels"),
    (SCENES, chart_of(with_nan), PICTURE, CORNER, "must have finite radiance of at least 0|raises ParameterError"),
    (SCENES, chart_of(lambda shape, _: -np.ones(shape)), PICTURE, CORNER, "must have finite radiance|raises ParameterError"),
    (SCENES, chart_of(lambda shape, pitch_um: corner_image(shape, pitch_um, 0.4).T[:5]), PICTURE, CORNER, "must have the shape"),
    (SCENES, dim, PICTURE, CORNER, "must be proportional to radiance_w_m2_sr_nm"),
    (SCENES, near, PICTURE, CORNER, "must have the distance_m of its example, got 2.0"),
    (SCENES, corner, PICTURE, None, "has no known arrangement; register it with expected="),
    (DISPLAYS, lambda: 3, {}, None, "must return a Display, got int"),
    (DISPLAYS, lambda: Backlit(**LINES), {}, None, r"shows black and white of \[2.0, 100.0\] cd/m², expected \[0.5, 100.0\]"),
    (DISPLAYS, lambda: fs.scene.Display(**LINES), {}, ((0.64, 0.33), (0.3, 0.6), (0.15, 0.06)), "has primaries with the chromaticities"),
    (DISPLAYS, lambda: fs.scene.Display(**LINES | {"pitch_um": float(next(NUMBERS) + 1)}), {}, None, "must be the same in a settings file"),
    (PUPILS, Edgeless, {}, None, r"has discontinuities that are not among its edges\(\)"),
    (PUPILS, Displaced, {}, None, r"has discontinuities that are not among its edges\(\)"),
    (PUPILS, Amplifier, {}, None, "must return amplitudes of at most 1, got 1.2"),
    (PUPILS, Undefined, {}, None, "must return finite amplitudes"),
    (PUPILS, Open, {}, 0.5, "transmits 1.0000 of the power, expected 0.5000"),
    (LENSES, Magnifier, {"inverse": 0.9}, None, "has directions that are not inverse"),
    (LENSES, Magnifier, {"factor": -1.1, "inverse": -1.0 / 1.1}, None, "must map larger ideal radii to larger real radii"),
    (LENSES, Magnifier, {"shift_um": 5.0}, None, "must map the centre to itself"),
    (LENSES, Magnifier, {}, {(1.0, 2.0): (1.2, 2.4)}, r"maps \(1.0, 2.0\) to \[1.1, 2.2\], expected \(1.2, 2.4\)"),
    (LENSES, Changeable, {}, None, "must be a frozen dataclass"),
    (METRICS, counted, {}, None, "must return the same numbers for the same capture"),
    (METRICS, undefined, {}, None, "must be finite, or document NaN"),
    (METRICS, identity, {}, None, "must return the same numbers for a capture that was saved and loaded"),
    (METRICS, as_list, {}, None, "must return a number, a string, or a mapping of names to numbers, got NoneType codes"),
    (METRICS, brightened, {}, None, "must not change the capture|raises ValueError"),
    (COLUMNS, of_each_filter, {}, None, r"must return one value for each of 16 sites, got the shape \(1,\)"),
    (COLUMNS, names_of_filters, {}, None, "must return numbers of the dtype float64, got <U"),
    (COLUMNS, changing, {}, None, "must return the same values for a capture that was saved and loaded"),
]  # fmt: skip


@pytest.fixture
def add():
    """Return a function that registers an object as 'wrong' until the end of the test."""
    with ExitStack() as stack:

        def register(registry, item, example, expected):
            stack.enter_context(restored(registry))
            registry.register("wrong", item, example=example, expected=expected)
            return registry.kind

        yield register


@pytest.mark.parametrize(("registry", "item", "example", "expected", "message"), WRONG)
def test_wrong_extension_is_found(add, registry, item, example, expected, message):
    kind = add(registry, item, example, expected)

    with pytest.raises(AssertionError, match=rf"^{kind} 'wrong' ({message})") as caught:
        check_extension(kind, "wrong")
    assert "\n" not in str(caught.value)


def test_every_kind_has_wrong_extensions():
    assert {registry.kind for registry, *_ in WRONG} == {registry.kind for registry in REGISTRIES}


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("registry", "item", "example", "expected"),
    [
        (RULES, sizes, LIMITS, None),
        (FORMATS, text_format(read_corners), write_corners, None),
        (MAP_FORMATS, text_format(read_table), write_table, None),
        (CUBE_FORMATS, text_format(read_radiance), write_radiance, None),
        (PSF_FORMATS, text_format(read_psf), write_psf, None),
        (EFFECTS, Ripple, {"sigma_v": 1e-3}, None),
        (EFFECTS, Pattern, {}, None),
        (PIXEL_OPTICS, Absorber, {"response": 0.4}, 0.4),
        (SCENES, corner, PICTURE, CORNER),
        (LENSES, Magnifier, {}, {(1.0, 2.0): (1.1, 2.2)}),
    ],
)
def test_correct_extension_passes(add, registry, item, example, expected):
    check_extension(add(registry, item, example, expected), "wrong")


@restored(LAYOUTS)
def test_layout_generator_passes_its_example():
    layout_generator(example={"side_um": 2.0})(single)

    check_extension("layout generator", "single")


@pytest.mark.slow
def test_all_failures_are_listed(add):
    kind = add(LENSES, Changeable, {}, None)

    with pytest.raises(AssertionError, match=r"^lens model 'wrong' must be a frozen dataclass: [^\n]*$"):
        check_all(kind)


def test_unknown_kind_is_rejected():
    with pytest.raises(
        ParameterError, match="'kind' must be a kind of extension, got 'lens modle'; did you mean 'lens model'"
    ):
        check_extension("lens modle", "fisheye")

"""Test charts: closed forms, areas from shapely, means of finer rasters, and published colours."""

from __future__ import annotations

import inspect
import json
import math
import re

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.config import read_shot, schema
from foveasim.errors import ConfigError, ParameterError, SamplingWarning
from foveasim.scene import SCENES, charts

PITCH_UM = 100.0
PITCH_MM = 0.1
EPS32 = float(np.finfo(np.float32).eps)

#: Examples of all charts, on 60 x 80 pixels of 0.1 mm.
KINDS = {name: SCENES.example(name) for name in SCENES.within("foveasim.scene.charts")}
KINDS["point_grid"] = {**KINDS["point_grid"], "spacing_mm": 0.5, "n_points": None}
BLACK_AND_WHITE = sorted(name for name in KINDS if "contrast" in inspect.signature(SCENES[name]).parameters)
#: Tolerance for sharp edges in sampled pixels, at the rim of a disc and near the centre of a star.
SAMPLED = 1 / 64 + 1e-6


def chart(kind, shape=None, pitch_um=PITCH_UM, **changed):
    return getattr(charts, kind)(
        **(KINDS[kind] | {"pitch_um": pitch_um} | ({"shape": shape} if shape else {}) | changed)
    )


def relative_radiance(scene):
    """Return the radiance relative to white, (n_y, n_x)."""
    assert scene.basis.shape[0] == 1
    return scene.basis[0].astype(np.float64)


def centres_mm(n, pitch_mm=PITCH_MM):
    return (np.arange(n) - 0.5 * (n - 1)) * pitch_mm


# -- all charts -----------------------------------------------------------------------------------------------------


def test_charts_are_float32_with_source():
    scenes = {kind: chart(kind) for kind in KINDS}
    assert {kind for kind, scene in scenes.items() if scene.basis.dtype != np.float32} == {"point_grid"}
    assert all(scene.source != "arrays" for scene in scenes.values())
    assert fs.scene.charts is charts


@pytest.mark.parametrize("kind", ["siemens_star", "zone_plate"])
@pytest.mark.parametrize("n", [2, 5])
def test_round_charts_are_exact_within_rim(kind, n):
    coarse = chart(kind)
    _, n_y, n_x = coarse.basis.shape
    fine = chart(kind, shape=(n_y * n, n_x * n), pitch_um=PITCH_UM / n)
    means = fine.basis.reshape(-1, n_y, n, n_x, n).mean(axis=(2, 4), dtype=np.float64)
    difference = np.abs(means - coarse.basis)
    is_sampled = np.abs(np.hypot(centres_mm(80), centres_mm(60)[:, np.newaxis]) - 3.0) < PITCH_MM
    if kind == "siemens_star":
        is_sampled |= np.hypot(centres_mm(80), centres_mm(60)[:, np.newaxis]) < 9 * PITCH_MM
    assert difference[:, is_sampled].max() < SAMPLED
    assert difference[:, ~is_sampled].max() < 4 * EPS32


@pytest.mark.parametrize("kind", BLACK_AND_WHITE)
@pytest.mark.parametrize("contrast", [0.0, 0.2, 1.0])
def test_michelson_contrast_leaves_white_unchanged(kind, contrast):
    full, less = (relative_radiance(chart(kind, contrast=c, pitch_um=20.0, shape=(500, 400))) for c in (1.0, contrast))
    black = (1.0 - contrast) / (1.0 + contrast)
    np.testing.assert_allclose(less, black + (1.0 - black) * full, atol=2 * EPS32)
    assert 0.0 <= full.min() < 0.01
    assert 0.99 < full.max() <= 1.0
    assert 2.0 * less.max() <= 2.0


@pytest.mark.parametrize("kind", BLACK_AND_WHITE)
def test_white_radiance_per_wavelength_is_accepted(kind):
    scene = chart(kind, radiance_w_m2_sr_nm=[1.0, 3.0], wavelength_nm=[500.0, 600.0], band_width_nm=None)
    assert scene.spectrum_w_m2_sr_nm.tolist() == [[1.0, 3.0]]
    assert scene.band_width_nm.tolist() == [100.0, 100.0]


# -- areas in closed form -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle_deg", [-180.0, -135.0, -60.0, -5.0, 0.0, 1e-9, 5.0, 45.0, 90.0, 170.0])
@pytest.mark.parametrize("shape", [(7, 9), (8, 6)])
def test_slanted_edge_matches_polygon_areas(angle_deg, shape):
    got = relative_radiance(chart("slanted_edge", shape=shape, angle_deg=angle_deg, contrast=1.0, pitch_um=1000.0))
    angle = math.radians(angle_deg)
    along, across = np.array([-math.sin(angle), math.cos(angle)]), np.array([math.cos(angle), math.sin(angle)])
    white = shapely.Polygon([-50 * along, -50 * along + 50 * across, 50 * along + 50 * across, 50 * along])
    y, x = np.mgrid[: shape[0], : shape[1]] - np.array(shape).reshape(2, 1, 1) / 2
    pixels = shapely.box(x, y, x + 1, y + 1)
    np.testing.assert_allclose(got, shapely.area(shapely.intersection(pixels, white)), atol=2 * EPS32)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("n_spokes", [2, 3, 8, 31])
def test_star_matches_sector_areas(n_spokes):
    shape, radius_mm = (41, 46), 19.3
    got = relative_radiance(chart("siemens_star", shape=shape, pitch_um=1000.0, n_spokes=n_spokes, radius_mm=radius_mm))
    wedges = [
        shapely.Polygon(
            [(0, 0), *(99 * np.array([[math.cos(a), math.sin(a)] for a in (low, low + math.pi / n_spokes)]))]
        )
        for low in (2 * np.arange(n_spokes) - 0.5) * math.pi / n_spokes
    ]
    disc = shapely.Point(0, 0).buffer(radius_mm, quad_segs=2000)
    y, x = np.mgrid[: shape[0], : shape[1]] - np.array(shape).reshape(2, 1, 1) / 2
    pixels = shapely.box(x, y, x + 1, y + 1)
    inside = shapely.intersection(pixels, disc)
    white = sum(shapely.area(shapely.intersection(inside, wedge)) for wedge in wedges)
    expected = white + 0.5 * (1.0 - shapely.area(inside))
    r = np.hypot(x + 0.5, y + 0.5)
    is_clear = (r * math.sin(math.pi / n_spokes) > 1.5) & (np.abs(r - radius_mm) > 0.71)
    np.testing.assert_allclose(got[is_clear], expected[is_clear], atol=4 * EPS32)
    np.testing.assert_allclose(got, expected, atol=SAMPLED)
    assert is_clear.mean() > 0.5


def test_letter_f_has_correct_ink_area():
    got = relative_radiance(chart("letter_f", height_mm=4.7))
    assert math.isclose((1.0 - got).sum() * PITCH_MM**2, 8 * (4.7 / 5) ** 2, rel_tol=1e-6)


def test_letter_f_is_upright():
    rows_from_the_top = ["XXX", "X..", "XX.", "X..", "X.."]
    expected = [[float(c == ".") for c in row] for row in reversed(rows_from_the_top)]
    got = relative_radiance(chart("letter_f", shape=(5, 3), height_mm=5.0, pitch_um=1000.0))
    np.testing.assert_allclose(got, expected, atol=EPS32)
    bright = relative_radiance(chart("letter_f", shape=(5, 3), height_mm=5.0, pitch_um=1000.0, ink="bright"))
    np.testing.assert_allclose(bright, 1.0 - np.array(expected), atol=EPS32)


def test_letter_f_is_upright_on_sensor():
    scene = chart("letter_f", shape=(200, 120), height_mm=20.0 * 0.99, ink="bright")
    layout = fs.layout.grid(
        n_x=3, n_y=5, pitch_um=4.0 * fs.Optics(focal_length_mm=10.0, f_number=2.0).magnification(1.0) * 1e3
    )
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=10.0, f_number=2.0), sensor=fs.Sensor(layout))
    electrons = camera.capture(scene, exposure_s=0.01, seed=0).expected_e
    x, y = np.rint(layout.centroid_um.T / layout.centroid_um[:, 0].max()).astype(int)
    bright = {
        (int(i), int(j))
        for i, j in zip(x[electrons > electrons.max() / 2], y[electrons > electrons.max() / 2], strict=True)
    }
    assert bright == {(-1, -2), (-1, -1), (-1, 0), (-1, 1), (-1, 2), (0, 0), (0, 2), (1, 2)}


def test_checkerboard_has_specified_arrangement():
    fill = relative_radiance(chart("checkerboard", square_mm=0.5))
    assert math.isclose(fill.mean(), 0.5, rel_tol=1e-6)
    assert fill[30:35, 40:45].max() < 1e-6
    assert fill[25:30, 40:45].min() > 1.0 - 1e-6
    board = relative_radiance(chart("checkerboard", square_mm=1.0, n_squares=(3, 5)))
    dark = 1.0 - board
    assert math.isclose(dark.sum() * PITCH_MM**2, 8.0, rel_tol=1e-6)
    assert dark[15:25, 15:25].min() > 1.0 - 1e-6
    assert dark[15:25, 25:35].max() < 1e-6
    assert dark[:15].max() + dark[:, :15].max() + dark[45:].max() < 1e-6


def test_checkerboard_averages_split_pixels():
    got = relative_radiance(chart("checkerboard", shape=(2, 4), square_mm=1.5, pitch_um=1000.0))
    # Along x: columns from -2 to 2 mm, edges at -1.5, 0 and 1.5 mm.
    np.testing.assert_allclose(got[1], [0.5, 1.0, 0.0, 0.5], atol=EPS32)
    np.testing.assert_allclose(got[0], [0.5, 0.0, 1.0, 0.5], atol=EPS32)


def test_zone_plate_matches_analytic_integral():
    radius_mm, per_mm = 2.7, 3.3
    got = relative_radiance(chart("zone_plate", line_pairs_per_mm=per_mm, radius_mm=radius_mm))
    a = math.pi * per_mm / radius_mm
    expected = 0.5 * 8.0 * 6.0 + 0.5 * math.pi * math.sin(a * radius_mm**2) / a
    assert math.isclose(got.sum() * PITCH_MM**2, expected, rel_tol=1e-4)


def test_star_and_edge_are_half_white():
    for kind in ("siemens_star", "slanted_edge"):
        assert math.isclose(relative_radiance(chart(kind, contrast=1.0)).mean(), 0.5, rel_tol=1e-3)
    assert math.isclose(relative_radiance(chart("slanted_edge", contrast=0.6)).mean(), 0.5 * 1.25, rel_tol=1e-6)


@pytest.mark.parametrize("kind", ["siemens_star", "zone_plate"])
def test_round_charts_are_symmetric(kind):
    got = relative_radiance(chart(kind, shape=(60, 60), **({"n_spokes": 8} if kind == "siemens_star" else {})))
    for mirrored in (got[::-1], got[:, ::-1], got.T):
        np.testing.assert_allclose(mirrored, got, atol=SAMPLED)


# -- periods --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase_deg", [0.0, 90.0, -45.0])
@pytest.mark.parametrize(("cycles_x", "cycles_y"), [(10, 0), (0, 7), (10, 7), (-10, 7)])
def test_sine_has_frequency_phase_and_amplitude(cycles_x, cycles_y, phase_deg):
    fx, fy = cycles_x / 8.0, cycles_y / 6.0
    scene = chart(
        "sine",
        line_pairs_per_mm=math.hypot(fx, fy),
        angle_deg=math.degrees(math.atan2(fy, fx)),
        phase_deg=phase_deg,
        contrast=0.5,
    )
    # The origin is the centre of the picture: exp(-2πi f·x) at the pixel centres.
    wave = np.exp(-2j * math.pi * np.add.outer(fy * centres_mm(60), fx * centres_mm(80)))
    component = (relative_radiance(scene) * wave).mean()
    # White 1, black 1/3: the mean is 2/3, the amplitude 1/3, half of it at each of the frequencies f and -f.
    amplitude = np.sinc(fx * PITCH_MM) * np.sinc(fy * PITCH_MM) / 6.0
    np.testing.assert_allclose(component, amplitude * np.exp(-1j * math.radians(phase_deg)), atol=1e-7)
    assert math.isclose(relative_radiance(scene).mean(), 2.0 / 3.0, rel_tol=1e-6)


@pytest.mark.parametrize("profile", ["square", "sine"])
@pytest.mark.parametrize("n_spokes", [2, 9, 24])
def test_star_has_all_sectors_at_every_radius(n_spokes, profile):
    got = relative_radiance(chart("siemens_star", shape=(600, 600), n_spokes=n_spokes, profile=profile, pitch_um=10.0))
    angle = 2 * math.pi * np.arange(1024) / 1024
    for r in (120.0, 200.0, 290.0):
        i = np.rint(299.5 + r * np.array([np.sin(angle), np.cos(angle)])).astype(int)
        waves = np.fft.rfft(got[i[0], i[1]] - 0.5) / 1024
        assert np.argmax(np.abs(waves)) == n_spokes
        # The first harmonic of a square wave is 4/π of its amplitude; a white sector is centred on the x axis.
        height = 0.25 * (4 / math.pi if profile == "square" else 1.0)
        assert abs(waves[n_spokes] - height) < 0.03 * height


def test_zone_plate_frequency_increases_with_radius():
    got = relative_radiance(chart("zone_plate", shape=(1201, 1201), pitch_um=5.0, line_pairs_per_mm=10.0))
    radius_mm, row = 3.0025, got[600, 600:] - 0.5
    r = np.arange(601) * 0.005
    k = np.flatnonzero(row[:-1] * row[1:] < 0)
    crossings = r[k] + 0.005 * row[k] / (row[k] - row[k + 1])
    # cos(π f r²/R) = 0 for r² = (k + 1/2) R/f.
    slope = np.polyfit(np.arange(k.size) + 0.5, crossings**2, 1)
    np.testing.assert_allclose(slope, [radius_mm / 10.0, 0.0], rtol=1e-4, atol=1e-3)
    assert got[600, 600] > 0.999


@pytest.mark.parametrize("angle_deg", [-20.0, -5.0, 2.0, 5.0, 11.3])
def test_edge_angle_is_recovered_accurately(angle_deg):
    got = relative_radiance(chart("slanted_edge", angle_deg=angle_deg, contrast=1.0))
    # In each row white extends from the edge to the right boundary.
    edge_mm = 4.0 - got.sum(axis=1) * PITCH_MM
    slope, offset = np.polyfit(centres_mm(60), edge_mm, 1)
    assert abs(math.degrees(math.atan(-slope)) - angle_deg) < 1e-5
    assert abs(offset) < 1e-6
    np.testing.assert_allclose(edge_mm, slope * centres_mm(60), atol=1e-6)


@pytest.mark.parametrize("ink", ["dark", "bright"])
def test_bars_match_bar_elements(ink):
    pitch_mm, shape = 0.01, (800, 800)
    got = relative_radiance(chart("bars", shape=shape, pitch_um=10.0, groups=[2, 1], ink=ink))
    got = 1.0 - got if ink == "dark" else got
    elements = charts.bar_elements([2, 1])
    assert len(elements) == 24
    assert [e.group for e in elements] == [1] * 12 + [2] * 12
    for e in elements:
        assert math.isclose(e.line_pairs_per_mm, 2 ** (e.group + (e.element - 1) / 6))
        half = e.side_mm / 2 + 2 * pitch_mm
        i_x, i_y = (np.flatnonzero(np.abs(centres_mm(800, pitch_mm) - centre) < half) for centre in (e.x_mm, e.y_mm))
        element = got[np.ix_(i_y, i_x)]
        width_mm = 0.5 / e.line_pairs_per_mm
        assert math.isclose(element.sum() * pitch_mm**2, 3 * 5 * width_mm**2, rel_tol=1e-5)
        across = element.max(axis=0 if e.direction == "vertical" else 1)
        starts = np.flatnonzero((across[1:] >= 0.5) & (across[:-1] < 0.5))
        assert starts.size == 3
        assert abs((starts[2] - starts[0]) * pitch_mm - 2.0 / e.line_pairs_per_mm) <= pitch_mm
        assert (element.max(axis=1 if e.direction == "vertical" else 0) > 0.5).sum() * pitch_mm <= e.side_mm + pitch_mm
    total = sum(15 * (0.5 / e.line_pairs_per_mm) ** 2 for e in elements)
    assert math.isclose(got.sum() * pitch_mm**2, total, rel_tol=1e-5)


def test_bar_elements_have_standard_frequencies():
    # MIL-STD-150A, in line pairs per mm, rounded as in its table.
    table = {
        (-2, 1): 0.25,
        (-1, 3): 0.63,
        (0, 1): 1.0,
        (0, 6): 1.78,
        (1, 4): 2.83,
        (2, 2): 4.49,
        (4, 5): 25.4,
        (7, 6): 228.1,
    }
    found = {(e.group, e.element): e.line_pairs_per_mm for e in charts.bar_elements(range(-2, 8))}
    for key, line_pairs_per_mm in table.items():
        assert math.isclose(found[key], line_pairs_per_mm, rel_tol=0.005)


def test_grey_scale_steps_have_specified_ratio():
    got = relative_radiance(chart("grey_scale", n_steps=4, ratio=10.0, patch_mm=1.0))
    np.testing.assert_allclose(got[30, 25:65:10], [1.0, 0.1, 0.01, 0.001], rtol=1e-6)
    assert math.isclose(got.sum() * PITCH_MM**2, 1.111, rel_tol=1e-6)
    assert got[:25].max() + got[:, :20].max() < 1e-12


# -- points ---------------------------------------------------------------------------------------------------------


def lit_pixels(scene):
    return [tuple(int(i) for i in index) for index in np.argwhere(scene.basis[0] > 0)]


def test_default_points_fill_picture_symmetrically():
    scene = chart("point_grid", shape=(7, 12), spacing_mm=0.3)
    assert lit_pixels(scene) == [(y, x) for y in (0, 3, 6) for x in (3, 6, 9)]


@pytest.mark.parametrize(
    ("shape", "n_points", "step", "expected"),
    [
        ((5, 5), (1, 1), 2, [(2, 2)]),
        ((5, 5), (1, 3), 2, [(2, 0), (2, 2), (2, 4)]),
        ((4, 4), (2, 2), 3, [(0, 0), (0, 3), (3, 0), (3, 3)]),
        ((4, 4), (1, 2), 2, [(2, 1), (2, 3)]),  # on pixel boundaries: right and upper pixel
        ((1, 1), (1, 1), 4, [(0, 0)]),
    ],
)
def test_point_grid_is_centred(shape, n_points, step, expected):
    assert lit_pixels(chart("point_grid", shape=shape, n_points=n_points, spacing_mm=step * PITCH_MM)) == expected


@pytest.mark.parametrize("n_points", [None, (3, 4)])
def test_points_have_specified_intensity(n_points):
    scene = chart("point_grid", n_points=n_points)
    n = len(lit_pixels(scene))
    assert n == (11 * 15 if n_points is None else 12)
    light = (scene.basis[0].sum(dtype=np.float64) * scene.spectrum_w_m2_sr_nm[0, 0]) * (PITCH_UM * 1e-6) ** 2
    assert math.isclose(light, n * 3e-6, rel_tol=1e-12)


# -- colours --------------------------------------------------------------------------------------------------------

#: CIE 1931 standard observer from 380 to 780 nm in steps of 10 (CIE 15), in ten-thousandths.
OBSERVER = np.array(
    [
        [14, 42, 143, 435, 1344, 2839, 3483, 3362, 2908, 1954, 956, 320, 49, 93, 633, 1655, 2904, 4334, 5945, 7621, 9163,
         10263, 10622, 10026, 8544, 6424, 4479, 2835, 1649, 874, 468, 227, 114, 58, 29, 14, 7, 3, 2, 1, 0],
        [0, 1, 4, 12, 40, 116, 230, 380, 600, 910, 1390, 2080, 3230, 5030, 7100, 8620, 9540, 9950, 9950, 9520, 8700,
         7570, 6310, 5030, 3810, 2650, 1750, 1070, 610, 320, 170, 82, 41, 21, 10, 5, 3, 1, 1, 0, 0],
        [65, 201, 679, 2074, 6456, 13856, 17471, 17721, 16692, 12876, 8130, 4652, 2720, 1582, 782, 422, 203, 87, 39, 21, 17,
         11, 8, 3, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
    ]
)  # fmt: skip
WAVES_NM = np.arange(380.0, 781.0, 10.0)
#: CIELAB under D50 from the manufacturer (GretagMacbeth 2005; X-Rite, "before November 2014"), other specimens than Ohta's.
MAKERS_LAB = np.array(
    [
        [37.986, 13.555, 14.059], [65.711, 18.13, 17.81], [49.927, -4.88, -21.905], [43.139, -13.095, 21.905],
        [55.112, 8.844, -25.399], [70.719, -33.397, -0.199], [62.661, 36.067, 57.096], [40.02, 10.41, -45.964],
        [51.124, 48.239, 16.248], [30.325, 22.976, -21.587], [72.532, -23.709, 57.255], [71.941, 19.363, 67.857],
        [28.778, 14.179, -50.297], [55.261, -38.342, 31.37], [42.101, 53.378, 28.19], [81.733, 4.039, 79.819],
        [51.935, 49.986, -14.574], [51.038, -28.631, -28.638], [96.539, -0.425, 1.186], [81.257, -0.638, -0.335],
        [66.766, -0.734, -0.504], [50.867, -0.153, -0.27], [35.656, -0.421, -1.231], [20.461, -0.079, -0.973],
    ]
)  # fmt: skip


def lab(spectra, light):
    """Return CIELAB (n, 3) of reflected spectra (n, 41) relative to the illuminant (41,)."""
    relative = (spectra @ OBSERVER.T) / (OBSERVER @ light)
    f = np.where(relative > (6 / 29) ** 3, np.cbrt(relative), relative * (29 / 6) ** 2 / 3 + 4 / 29)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


def patch_spectra(scene, patch_mm, gap_mm=0.0):
    """Return the spectral radiance (24, n_wavelength) at the patch centres, row by row from the upper left."""
    n_y, n_x = scene.basis.shape[1:]
    step = (patch_mm + gap_mm) / (scene.pitch_um * 1e-3)
    i_y = np.floor(0.5 * n_y + (1.5 - np.repeat(np.arange(4), 6)) * step).astype(int)
    i_x = np.floor(0.5 * n_x + (np.tile(np.arange(6), 4) - 2.5) * step).astype(int)
    return scene.basis[:, i_y, i_x].T.astype(np.float64) @ scene.spectrum_w_m2_sr_nm


def colours(**changed):
    given = {
        "wavelength_nm": WAVES_NM,
        "band_width_nm": None,
        "patch_mm": 1.0,
        "gap_mm": 0.2,
        "radiance_w_m2_sr_nm": 1.0,
    }
    return chart("colour_chart", **(given | changed))


@pytest.mark.parametrize(("n_basis", "mean", "worst"), [(24, 1.7, 3.6), (12, 1.8, 3.6)])
def test_patch_colours_agree_with_manufacturer(n_basis, mean, worst):
    light = charts.illuminant("D50", WAVES_NM)
    found = lab(patch_spectra(colours(illuminant="D50", n_basis=n_basis), 1.0, 0.2), light)
    difference = np.linalg.norm(found - MAKERS_LAB, axis=1)
    assert difference.mean() < mean
    assert difference.max() < worst
    # The nearest of the manufacturer's colours belongs to the same patch.
    nearest = np.linalg.norm(found[:, np.newaxis] - MAKERS_LAB, axis=2).argmin(axis=1)
    assert nearest.tolist() == list(range(24))


@pytest.mark.parametrize(
    ("n_basis", "mean", "worst"), [(24, 1e-4, 1e-4), (12, 0.11, 0.5), (10, 0.33, 1.3), (8, 0.78, 2.5)]
)
@pytest.mark.parametrize("illuminant", ["D65", "A"])
def test_colour_error_of_few_basis_images(n_basis, mean, worst, illuminant):
    light = charts.illuminant(illuminant, WAVES_NM)
    scene = colours(illuminant=illuminant, n_basis=n_basis)
    assert scene.basis.shape[0] == n_basis
    exact = lab(charts.patch_reflectance(WAVES_NM) * light, light)
    difference = np.linalg.norm(lab(patch_spectra(scene, 1.0, 0.2), light) - exact, axis=1)
    assert difference.mean() < mean
    assert difference.max() < worst


@pytest.mark.parametrize("illuminant", ["D65", "A"])
@pytest.mark.parametrize("step_nm", [2.0, 5.0, 10.0])
def test_photons_are_independent_of_band_width(illuminant, step_nm):
    """Bands end with the tables, at 380 and 780 nm; the trapezoidal rule has an error of second order."""

    def photons(step_nm):
        waves_nm = np.arange(380.0, 780.1, step_nm)
        scene = colours(wavelength_nm=waves_nm, illuminant=illuminant, radiance_w_m2_sr_nm=0.3, n_basis=2)
        assert scene.band_width_nm.sum() == pytest.approx(400.0)
        return float((charts.illuminant(illuminant, waves_nm) * waves_nm * scene.band_width_nm).sum())

    assert photons(step_nm) == pytest.approx(photons(1.0), rel=3e-4)


@pytest.mark.parametrize("waves_nm", [[370.0, 500.0], [500.0, 790.0]])
def test_wavelengths_outside_tables_are_named(waves_nm):
    with pytest.raises(ParameterError, match="'wavelength_nm' must be from 380 to 780, the range of the tables"):
        colours(wavelength_nm=waves_nm)


def test_few_wavelengths_are_exact():
    waves_nm = [620.0, 550.0, 455.0]
    scene = colours(wavelength_nm=waves_nm, radiance_w_m2_sr_nm=0.3, illuminant="D65")
    assert scene.basis.shape[0] == 3
    expected = 0.3 * charts.patch_reflectance(waves_nm) * charts.illuminant("D65", waves_nm)
    np.testing.assert_allclose(patch_spectra(scene, 1.0, 0.2), expected, rtol=1e-6)


def test_colour_chart_has_black_surround():
    scene = colours(wavelength_nm=[550.0], band_width_nm=10.0, illuminant="E")
    area_mm2 = scene.basis.sum(dtype=np.float64) * PITCH_MM**2
    assert math.isclose(area_mm2, charts.patch_reflectance([550.0]).sum(), rel_tol=1e-6)
    assert scene.basis[0, :6].max() == scene.basis[0, :, :4].max() == 0.0


def test_reflectances_match_publication():
    # Ohta's table has steps of 5 nm: 550 nm is tabulated here, 445 nm is interpolated.
    assert charts.PATCH_NAMES[0] == "dark skin"
    np.testing.assert_allclose(charts.patch_reflectance([550.0, 700.0])[[0, 13, 18, 23]].T,
                               [[0.079, 0.323, 0.886, 0.034], [0.282, 0.088, 0.888, 0.032]])  # fmt: skip
    at_fives = charts.patch_reflectance([445.0, 555.0, 635.0])[[1, 12]]
    np.testing.assert_allclose(at_fives, [[0.217, 0.298, 0.569], [0.316, 0.044, 0.041]], atol=0.004)


@pytest.mark.parametrize(
    ("name", "x", "y"),  # CIE 15, chromaticities for the standard observer
    [
        ("A", 0.44758, 0.40745),
        ("D50", 0.34567, 0.35851),
        ("D55", 0.33243, 0.34744),
        ("D65", 0.31272, 0.32903),
        ("D75", 0.29903, 0.31488),
        ("E", 1 / 3, 1 / 3),
    ],
)
def test_illuminants_have_standard_chromaticities(name, x, y):
    xyz = OBSERVER @ charts.illuminant(name, WAVES_NM)
    np.testing.assert_allclose(xyz[:2] / xyz.sum(), [x, y], atol=3e-4)


@pytest.mark.parametrize(
    ("name", "table"),  # CIE 15:2004, Table T.1, also at 5 nm between the steps of the components
    [
        ("A", {380: 9.7951, 405: 16.148, 500: 59.8611, 560: 100.0, 700: 198.261, 780: 241.675}),
        ("D50", {380: 24.488, 405: 52.91, 450: 87.247, 560: 100.0, 680: 99.133, 780: 78.274}),
        ("D55", {380: 32.584, 405: 64.751, 450: 97.993, 560: 100.0, 680: 89.956, 780: 71.818}),
        ("D65", {380: 49.9755, 405: 87.1204, 410: 91.486, 545: 104.225, 560: 100.0, 680: 78.2842, 780: 63.3828}),
        ("D75", {380: 66.703, 405: 106.911, 450: 133.01, 560: 100.0, 680: 71.576, 780: 58.324}),
    ],
)
def test_illuminants_have_published_spectra(name, table):
    found = charts.illuminant(name, [float(w) for w in table])
    np.testing.assert_allclose(found, np.array(list(table.values())) / 100.0, rtol=0.0, atol=1e-5)


# -- aliasing -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "changed"),
    [
        ("checkerboard", {"square_mm": 0.09}),
        ("sine", {"line_pairs_per_mm": 5.1}),
        ("zone_plate", {"line_pairs_per_mm": 5.1}),
        ("siemens_star", {"n_spokes": 95}),
        ("bars", {"pitch_um": 125.0 * 2 ** (1 / 6) + 1.0}),
        ("letter_f", {"height_mm": 0.49}),
        ("grey_scale", {"patch_mm": 0.09}),
        ("colour_chart", {"patch_mm": 0.09}),
        ("point_grid", {"spacing_mm": 0.1}),
    ],
)
def test_pattern_beyond_nyquist_warns(kind, changed):
    with pytest.warns(SamplingWarning, match=r"^'\w+' yields .* pixels per period .* averages to grey") as caught:
        chart(kind, **changed)
    assert len(caught) == 1
    assert caught[0].filename == __file__


def test_too_fine_pattern_averages_to_grey():
    with pytest.warns(SamplingWarning):
        got = relative_radiance(chart("checkerboard", square_mm=0.001))
    np.testing.assert_allclose(got, 0.5, atol=1e-3)


def test_two_pixels_per_period_do_not_warn():
    chart("checkerboard", square_mm=0.1)
    chart("sine", line_pairs_per_mm=5.0)


# -- invalid arguments -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("changed", "name"),
    [
        ({"shape": (0, 5)}, "shape[0]"),
        ({"shape": 5}, "shape"),
        ({"pitch_um": math.nan}, "pitch_um"),
        ({"pitch_um": -1.0}, "pitch_um"),
        ({"distance_m": 0.0}, "distance_m"),
        ({"wavelength_nm": [-5.0]}, "wavelength_nm"),
        ({"band_width_nm": 0.0}, "band_width_nm"),
        ({"wavelength_nm": [550.0], "band_width_nm": None}, "band_width_nm"),
    ],
    ids=str,
)
def test_charts_reject_invalid_picture_parameters(kind, changed, name):
    with pytest.raises(ParameterError, match=rf"^'{re.escape(name)}' must [^\n]*$"):
        chart(kind, **changed)


@pytest.mark.parametrize("kind", BLACK_AND_WHITE)
@pytest.mark.parametrize(
    ("changed", "name"),
    [
        ({"contrast": -0.1}, "contrast"),
        ({"contrast": 1.1}, "contrast"),
        ({"contrast": math.nan}, "contrast"),
        ({"radiance_w_m2_sr_nm": -1.0}, "radiance_w_m2_sr_nm"),
        ({"radiance_w_m2_sr_nm": [1.0, 2.0, 3.0]}, "radiance_w_m2_sr_nm"),
        ({"radiance_w_m2_sr_nm": "much"}, "radiance_w_m2_sr_nm"),
    ],
    ids=str,
)
def test_charts_reject_invalid_contrast_or_radiance(kind, changed, name):
    with pytest.raises(ParameterError, match=rf"^'{name}' must [^\n]*$"):
        chart(kind, **changed)


@pytest.mark.parametrize(
    ("kind", "changed", "message"),
    [
        ("point_grid", {"spacing_mm": 0.0}, "'spacing_mm' must be > 0, got 0.0 mm"),
        ("point_grid", {"spacing_mm": math.nan}, "'spacing_mm' must be finite"),
        (
            "point_grid",
            {"spacing_mm": 0.55},
            "'spacing_mm' must be an integer number of pixels of 0.1 mm, got 0.55 mm; the nearest value",
        ),
        (
            "point_grid",
            {"spacing_mm": 0.01},
            "'spacing_mm' must be an integer number of pixels of 0.1 mm, got 0.01 mm; the nearest value",
        ),
        (
            "point_grid",
            {"n_points": (13, 2)},
            "'n_points' must yield a chart within the picture of 8 x 6 mm, got 0.6 x",
        ),
        ("point_grid", {"n_points": (0, 2)}, "'n_points[0]' must be >= 1"),
        ("point_grid", {"intensity_w_sr_nm": -1.0}, "'intensity_w_sr_nm' must be >= 0"),
        ("checkerboard", {"square_mm": 0.0}, "'square_mm' must be > 0"),
        ("checkerboard", {"square_mm": math.inf}, "'square_mm' must be finite"),
        (
            "checkerboard",
            {"square_mm": 1.0, "n_squares": (7, 8)},
            "'n_squares' must yield a chart within the picture of 8 x 6",
        ),
        ("checkerboard", {"n_squares": (7,)}, "'n_squares' must be two integers"),
        ("siemens_star", {"n_spokes": 1}, "'n_spokes' must be >= 2, got 1"),
        ("siemens_star", {"n_spokes": 2.5}, "'n_spokes' must be an integer"),
        ("siemens_star", {"n_spokes": 5000}, "'n_spokes' must be <= 1000"),
        ("siemens_star", {"radius_mm": -1.0}, "'radius_mm' must be > 0"),
        (
            "siemens_star",
            {"radius_mm": 3.1},
            "'radius_mm' must yield a chart within the picture of 8 x 6 mm, got 6.2 x",
        ),
        ("siemens_star", {"profile": "saw"}, "'profile' must be one of 'square', 'sine', got 'saw'"),
        ("slanted_edge", {"angle_deg": math.nan}, "'angle_deg' must be finite"),
        ("slanted_edge", {"angle_deg": 181.0}, "'angle_deg' must be <= 180, got 181.0 degrees"),
        ("zone_plate", {"line_pairs_per_mm": 0.0}, "'line_pairs_per_mm' must be > 0, got 0.0 per mm"),
        ("zone_plate", {"radius_mm": 4.0}, "'radius_mm' must yield a chart within"),
        ("bars", {"groups": []}, "'groups' must be a list of integers, got []"),
        ("bars", {"groups": 3}, "'groups' must be a list of integers, got 3"),
        ("bars", {"groups": "3"}, "'groups' must be an array of numbers, got '3'"),
        ("bars", {"groups": [1.5]}, "'groups[0]' must be an integer"),
        ("bars", {"groups": [2, 2]}, "'groups' must be unique"),
        ("bars", {"groups": [-3]}, "'groups' must yield a chart within the picture of 8 x 9 mm"),
        ("bars", {"ink": "red"}, "'ink' must be one of 'dark', 'bright', got 'red'"),
        ("sine", {"line_pairs_per_mm": -2.0}, "'line_pairs_per_mm' must be > 0, got -2.0 per mm"),
        ("sine", {"phase_deg": math.inf}, "'phase_deg' must be finite"),
        (
            "letter_f",
            {"height_mm": 6.1},
            "'height_mm' must yield a chart within the picture of 8 x 6 mm, got 3.66 x 6.1",
        ),
        ("letter_f", {"height_mm": 0.0}, "'height_mm' must be > 0"),
        (
            "grey_scale",
            {"patch_mm": 1.0, "n_steps": 12},
            "'patch_mm' must yield a chart within the picture of 8 x 6 mm, got 12 x 1 mm",
        ),
        ("grey_scale", {"ratio": 0.5}, "'ratio' must be >= 1"),
        ("grey_scale", {"n_steps": 0}, "'n_steps' must be >= 1"),
        (
            "colour_chart",
            {"patch_mm": 1.4, "gap_mm": 0.0},
            "'patch_mm' must yield a chart within the picture of 8 x 6 mm",
        ),
        ("colour_chart", {"gap_mm": -0.1}, "'gap_mm' must be >= 0"),
        ("colour_chart", {"n_basis": 25}, "'n_basis' must be <= 24"),
        ("colour_chart", {"illuminant": "D93"}, "'illuminant' must be one of"),
        (
            "colour_chart",
            {"wavelength_nm": [370.0]},
            "'wavelength_nm' must be from 380 to 780, the range of the tables, got [370.0]",
        ),
        ("colour_chart", {"radiance_w_m2_sr_nm": math.nan}, "'radiance_w_m2_sr_nm' must be finite"),
    ],
)
def test_charts_reject_invalid_parameters(kind, changed, message):
    with pytest.raises(ParameterError, match=rf"^{re.escape(message)}[^\n]*$"):
        chart(kind, **changed)


# -- settings files -------------------------------------------------------------------------------------------------

SHOT = """
optics: {focal_length_mm: 8, f_number: 2.8}
layout: {generator: hexagonal, parameters: {n_columns: 10, n_rows: 12, pitch_um: 8}}
exposure_s: 0.01
scene:
"""


@pytest.fixture
def shot_of(tmp_path):
    def build(kind, **changed):
        scene = {"kind": kind, **KINDS[kind]} | changed
        path = tmp_path / "shot.yaml"
        path.write_text(f"{SHOT.rstrip()} {json.dumps(scene)}\n")
        return read_shot(path)

    return build


def test_settings_file_accepts_pairs_and_lists(shot_of):
    board = shot_of(
        "checkerboard", n_squares=[2, 3], radiance_w_m2_sr_nm=[1.0, 2.0], wavelength_nm=[500.0, 600.0]
    ).scene
    assert board.spectrum_w_m2_sr_nm.tolist() == [[1.0, 2.0]]
    assert board.basis[0, 0, 0] == 1.0


@pytest.mark.parametrize(
    ("kind", "changed", "message"),
    [
        ("siemens_star", {"radius_mm": 99.0}, r"scene\.radius_mm: must yield a chart within the picture"),
        ("siemens_star", {"profile": "saw"}, r"scene\.profile: must be one of 'square', 'sine', got \"saw\""),
        ("slanted_edge", {"angle": 3}, r"scene\.angle: unknown (key|parameter)"),
        ("bars", {"groups": [1, 1]}, r"scene\.groups: must be unique"),
    ],
)
def test_invalid_chart_setting_error_names_key(shot_of, kind, changed, message):
    with pytest.raises(ConfigError, match=message):
        shot_of(kind, **changed)


def test_schema_contains_all_charts():
    text = json.dumps(schema())
    for name in (*KINDS, "line_pairs_per_mm", "square_mm", "n_spokes", "illuminant"):
        assert f'"{name}"' in text
    assert "Spectral radiance of white." in text

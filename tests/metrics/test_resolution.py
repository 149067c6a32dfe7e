"""Resolution: closed-form polygon transforms, slanted-edge MTF, and Nyquist frequencies."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.errors import ParameterError, SimulationError
from foveasim.metrics import (
    neighbour_spacing_um,
    nyquist_per_mm,
    nyquist_vs_eccentricity,
    polygon_mtf,
    polygon_otf,
    slanted_edge_mtf,
    wave_vectors_per_mm,
)
from foveasim.optics import circular_otf
from foveasim.scene import charts

#: From frequencies at which the transform is 1 to float64, to 40 periods across a site.
FREQUENCIES = np.array([0.0, 1e-300, 1e-200, 1e-12, 1e-6, 1e-3, 0.1, 1.0, 10.0, 99.7, 250.0, 333.3, 1000.0, 1e4])
ANGLES = (0.0, 17.0, 45.0, 90.0, 133.0, 270.0)

# -- polygon transforms------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle_deg", ANGLES)
def test_rectangle_otf_is_product_of_sincs(angle_deg):
    layout = fs.layout.grid(n_x=1, n_y=1, pitch_um=4.0, pitch_y_um=3.0).translate(5000.0, -300.0)
    waves = wave_vectors_per_mm(FREQUENCIES, angle_deg)
    expected = np.sinc(4e-3 * waves[:, 0]) * np.sinc(3e-3 * waves[:, 1])

    assert np.abs(polygon_otf(layout, waves)[0] - expected).max() <= 1e-12


def test_hexagon_otf_matches_closed_forms():
    layout = fs.layout.hexagonal(n_columns=1, n_rows=1, pitch_um=4.0)
    w, s = 4e-3, 4e-3 / np.sqrt(3.0)
    f = FREQUENCIES

    flat, vertex = polygon_otf(layout, wave_vectors_per_mm(f, 0.0)), polygon_otf(layout, wave_vectors_per_mm(f, 90.0))

    assert np.abs(flat - (2 / 3 * np.sinc(w * f) + 1 / 3 * np.sinc(w * f / 2) ** 2)).max() <= 1e-12
    assert np.abs(vertex - np.sinc(1.5 * s * f) * np.sinc(0.5 * s * f)).max() <= 1e-12


def l_shape():
    polygon = shapely.Polygon(
        [(0, 0), (5, 0), (5, 2), (2, 2.5), (1, 6), (0, 6)], [[(0.5, 0.5), (1.2, 0.6), (0.8, 1.5)]]
    )
    return polygon, fs.Layout.from_polygons([polygon])


def test_polygon_otf_is_additive():
    polygon, layout = l_shape()
    cut = shapely.Polygon([(-1, -1), (3, -1), (0.3, 7), (-1, 7)])
    parts = fs.Layout.from_polygons([polygon & cut, polygon - cut])
    waves = np.random.default_rng(0).normal(0.0, 200.0, (50, 2))

    def integrals(some):
        away = np.exp(-2e-3j * np.pi * (some.centroid_um @ np.moveaxis(waves, 0, 1)))
        return some.area_um2[:, None] * polygon_otf(some, waves) * away

    assert integrals(parts).sum(axis=0) == pytest.approx(integrals(layout)[0], abs=1e-12 * polygon.area)


def test_polygon_otf_matches_point_sampling():
    polygon, layout = l_shape()
    step = 0.01
    x, y = np.meshgrid(np.arange(0.0, 5.0, step) + step / 2, np.arange(0.0, 6.0, step) + step / 2)
    inside = shapely.contains_xy(polygon, x, y)
    points = np.stack((x[inside], y[inside]), axis=1) - layout.centroid_um[0]
    waves = np.array([[30.0, 10.0], [-120.0, 75.0], [0.0, 240.0], [310.0, 0.0]])

    expected = np.exp(-2e-3j * np.pi * (points @ np.moveaxis(waves, 0, 1))).mean(axis=0)

    assert np.abs(polygon_otf(layout, waves)[0] - expected).max() <= 2e-4


def test_polygon_mtf_follows_translation_and_rotation():
    _, layout = l_shape()
    f = np.array([3.0, 80.0, 300.0])

    reference = polygon_mtf(layout, f, angle_deg=20.0)

    assert polygon_mtf(layout.translate(4000.0, 77.0), f, angle_deg=20.0) == pytest.approx(reference, abs=1e-12)
    assert polygon_mtf(layout.rotate(31.0), f, angle_deg=51.0) == pytest.approx(reference, abs=1e-12)


def test_polygon_otf_is_accurate_near_zero():
    layout = fs.layout.grid(n_x=1, n_y=1, pitch_um=4.0)
    f = np.array([1e-3, 1e-2, 1e-1])
    otf = polygon_otf(layout, wave_vectors_per_mm(f))[0]
    tilted = fs.Layout.from_polygons([shapely.Polygon([(0, 0), (3, 0), (0, 3)])])
    odd = polygon_otf(tilted, wave_vectors_per_mm(f))[0].imag

    assert otf.imag.tolist() == [0.0, 0.0, 0.0]
    # The normalised third central moment of x of this triangle is 0.2; its term in exp(-ikx) has the factor i k³ / 6.
    assert odd == pytest.approx((2e-3 * np.pi * f) ** 3 / 6.0 * 0.2, rel=1e-4)


def test_polygon_otf_is_independent_of_threads():
    layout = fs.layout.log_polar(n_sectors=90, min_size_um=2.0, r_max_um=150.0, stagger=True)
    waves = np.random.default_rng(1).normal(0.0, 150.0, (7, 2))
    together = polygon_otf(layout, waves, n_threads=1)

    assert layout.n_sites > 2000
    assert np.array_equal(together, polygon_otf(layout, waves, n_threads=3))
    some = [0, 1023, 1024, layout.n_sites - 1]
    assert np.array_equal(together[some], polygon_otf(layout[some], waves))


def test_invalid_wave_vectors_raise():
    layout = fs.layout.grid(n_x=1, n_y=1, pitch_um=1.0)
    with pytest.raises(ParameterError, match=r"'wave_per_mm' must have shape \(n_wave, 2\)"):
        polygon_otf(layout, [[1.0, 2.0, 3.0]])
    with pytest.raises(ParameterError, match="'angle_deg' must be one number, or one for each of the 3 frequencies"):
        polygon_mtf(layout, [1.0, 2.0, 3.0], angle_deg=[1.0, 2.0])


# -- slanted edge -----------------------------------------------------------------------------------------------------

OPTICS = fs.Optics(focal_length_mm=10.0, f_number=4.0)
CELL_UM, DISTANCE_M = 0.5, 0.5
SQUARES = fs.layout.grid(n_x=60, n_y=60, pitch_um=4.0)
HEXAGONS = fs.layout.hexagonal(n_columns=60, n_rows=70, pitch_um=4.0)


def edge_capture(layout, angle_deg, n_cells=760):
    scene = charts.slanted_edge(
        angle_deg=angle_deg,
        shape=(n_cells, n_cells),
        pitch_um=CELL_UM / OPTICS.magnification(DISTANCE_M),
        distance_m=DISTANCE_M,
        radiance_w_m2_sr_nm=0.1,
        wavelength_nm=[550.0],
        band_width_nm=10.0,
    )
    sensor = fs.Sensor(layout, capacitance_f=1e-15 * layout.area_um2)
    return fs.Camera(optics=OPTICS, sensor=sensor).capture(scene, exposure_s=0.1, seed=1)


def lens_times_pixel(layout, frequency_per_mm, angle_deg):
    """Product of the closed-form MTFs of the lens, the sites, and the cells of chart and map, across an edge."""
    wave = wave_vectors_per_mm(frequency_per_mm, angle_deg)
    lens = circular_otf(frequency_per_mm * 0.55e-3 * OPTICS.working_f_number(DISTANCE_M))
    cells = np.prod(np.sinc(1e-3 * CELL_UM * wave), axis=1) ** 2
    return lens * cells * polygon_mtf(layout, frequency_per_mm, angle_deg=angle_deg).mean(axis=0)


@pytest.mark.slow(keep=6)
@pytest.mark.parametrize("angle_deg", [5.0, -5.0, 85.0, 175.0, -95.0, 23.0])
@pytest.mark.parametrize("layout", [SQUARES, HEXAGONS], ids=["squares", "hexagons"])
def test_edge_mtf_matches_lens_times_pixel(layout, angle_deg):
    found = slanted_edge_mtf(layout, edge_capture(layout, angle_deg).expected_e)
    f = found.frequency_per_mm
    is_in = f <= nyquist_per_mm(layout)[0] * 1.0001
    expected = lens_times_pixel(layout[[0]], f, angle_deg)

    assert abs(found.angle_deg - angle_deg) < 0.01
    assert abs(found.offset_um) < 0.002
    assert np.abs(found.mtf / expected - 1.0)[is_in].max() < 0.02
    assert np.abs(found.mtf - expected)[is_in].max() < 0.008
    assert found.mtf50_per_mm == pytest.approx(np.interp(-0.5, -expected, f), rel=0.015)


def test_edge_mtf_supports_off_centre_edges():
    layout = SQUARES.translate(37.0, 11.0)
    found = slanted_edge_mtf(layout, edge_capture(layout, 5.0).expected_e)
    is_in = found.frequency_per_mm <= 125.0

    assert abs(found.offset_um) < 0.01
    assert np.abs(found.mtf / lens_times_pixel(layout[[0]], found.frequency_per_mm, 5.0) - 1.0)[is_in].max() < 0.02


def test_edge_mtf_supports_sparse_phases():
    # At 60 degrees hexagons form lines 2 µm apart, so that bins of 1 µm contain one line, a part of one, or none.
    found = slanted_edge_mtf(HEXAGONS, edge_capture(HEXAGONS, 60.0).expected_e)
    is_in = found.frequency_per_mm <= 144.0

    expected = lens_times_pixel(HEXAGONS[[0]], found.frequency_per_mm, 60.0)
    assert np.abs(found.mtf / expected - 1.0)[is_in].max() < 0.02


def test_edge_mtf_of_foveal_annulus():
    layout = fs.layout.log_polar(n_sectors=200, min_size_um=2.0, r_max_um=140.0).translate(-70.0, 0.0)
    r_um = np.hypot(layout.centroid_um[:, 0] + 70.0, layout.centroid_um[:, 1])
    where = (r_um > 80.0) & (r_um < 120.0) & (layout.centroid_um[:, 0] > -60.0)
    capture = edge_capture(layout, 5.0, n_cells=900)

    found = slanted_edge_mtf(layout, capture.expected_e / layout.area_um2, where=where)

    is_in = found.frequency_per_mm <= 125.0
    expected = lens_times_pixel(layout[where], found.frequency_per_mm, 5.0)
    assert abs(found.angle_deg - 5.0) < 0.02
    assert np.abs(found.mtf - expected)[is_in].max() < 0.02


def test_edge_mtf_is_robust_to_defects():
    capture = edge_capture(SQUARES, 5.0)
    noisy = capture.electrons.astype(float)
    noisy[np.hypot(*(SQUARES.centroid_um - [60.0, 60.0]).T) < 15.0] = 0.0

    found, clean = (
        slanted_edge_mtf(SQUARES, noisy, reach_um=40.0),
        slanted_edge_mtf(SQUARES, capture.expected_e, reach_um=40.0),
    )

    assert abs(found.angle_deg - 5.0) < 0.05
    assert found.mtf50_per_mm == pytest.approx(clean.mtf50_per_mm, rel=0.02)


def test_edge_mtf_of_gaussian_blur():
    # Point samples of an edge with a Gaussian blur of 3 µm: the MTF is the transform of the Gaussian.
    from scipy.special import ndtr

    layout = fs.layout.grid(n_x=150, n_y=150, pitch_um=2.0)
    across = layout.centroid_um @ [np.cos(np.deg2rad(8.0)), np.sin(np.deg2rad(8.0))]
    f = np.linspace(0.0, 120.0, 25)

    found = slanted_edge_mtf(layout, 100.0 + 200.0 * ndtr((across - 7.0) / 3.0), frequency_per_mm=f, window="none")

    assert found.offset_um == pytest.approx(7.0, abs=1e-3)
    assert found.contrast == pytest.approx(0.5, abs=1e-3)
    assert np.abs(found.mtf - np.exp(-2.0 * (np.pi * 3e-3 * f) ** 2)).max() < 5e-4
    assert found.esf[0] == pytest.approx(100.0)
    assert found.esf[-1] == pytest.approx(300.0)


def test_edge_mtf_varies_little_with_window():
    values = edge_capture(SQUARES, 5.0).expected_e
    f = np.linspace(0.0, 125.0, 26)
    plain = slanted_edge_mtf(SQUARES, values, frequency_per_mm=f, window="none")

    for options in ({"window": "tukey"}, {"window": "hamming"}, {"window": "none", "bin_um": 0.6}):
        assert np.abs(slanted_edge_mtf(SQUARES, values, frequency_per_mm=f, **options).mtf - plain.mtf).max() < 0.005


GRID = fs.layout.grid(n_x=100, n_y=100, pitch_um=3.0)


def squares_at_an_edge(angle_deg=5.0, sigma_um=1.0):
    """Site means on GRID of an edge from 0 to 1 with a Gaussian blur, by quadrature, and the closed-form MTF."""
    from scipy.special import ndtr

    across = np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))])
    nodes, weights = np.polynomial.legendre.leggauss(8)
    values = np.zeros(GRID.n_sites)
    for i, j in np.ndindex(8, 8):
        position_um = (GRID.centroid_um + 1.5 * np.array([nodes[i], nodes[j]])) @ across
        values += 0.25 * weights[i] * weights[j] * ndtr(position_um / sigma_um)

    def mtf(frequency_per_mm):
        box = np.prod(np.sinc(3e-3 * np.multiply.outer(frequency_per_mm, across)), axis=1)
        return np.abs(box) * np.exp(-2.0 * (np.pi * 1e-3 * sigma_um * frequency_per_mm) ** 2)

    return values, mtf


def plain_standard(picture, pitch_um, frequency_per_mm):
    """Reference: e-SFR of ISO 12233 on a grid, with row centroids, four bins per pixel, Hamming window and DFT."""
    n_y, n_x = picture.shape
    x, y = np.arange(n_x), np.arange(n_y)
    rise = np.gradient(picture, axis=1)
    centre = np.full(n_y, 0.5 * (n_x - 1))
    for _ in range(2):
        window = 0.54 + 0.46 * np.cos(2.0 * np.pi * (x - centre[:, None]) / n_x)
        line = np.polyfit(y, (rise * window * x).sum(axis=1) / (rise * window).sum(axis=1), 1)
        centre = np.polyval(line, y)
    k = np.floor(4.0 * (x - centre[:, None])).astype(int)
    first = k.min()
    count = np.bincount((k - first).ravel())
    profile = np.bincount((k - first).ravel(), weights=picture.ravel()) / np.maximum(count, 1)
    profile = np.interp(np.arange(count.size), np.flatnonzero(count), profile[count > 0])
    at = np.arange(count.size - 1) + first + 1.0
    spread = np.diff(profile) * (0.54 + 0.46 * np.cos(np.pi * at / np.abs(at).max()))
    # Bins are measured along x; the factor converts to the distance perpendicular to the edge.
    cycles = 1e-3 * frequency_per_mm * pitch_um * np.cos(np.arctan(line[0]))
    found = np.abs(np.exp(-0.5j * np.pi * np.multiply.outer(cycles, at)) @ spread) / spread.sum()
    return found / np.sinc(cycles / 4.0)


@pytest.mark.slow
def test_edge_mtf_noise_is_below_standard():
    values, mtf = squares_at_an_edge()
    f = np.linspace(0.0, 500.0 / 3.0, 51)
    rng = np.random.default_rng(4)
    found, standard = [], []
    for _ in range(40):
        noisy = values + rng.normal(0.0, 1.0 / 50.0, values.size)
        found.append(slanted_edge_mtf(GRID, noisy, frequency_per_mm=f).mtf - mtf(f))
        standard.append(plain_standard(noisy.reshape(100, 100), 3.0, f) - mtf(f))

    # Without noise the reference is accurate.
    assert np.abs(plain_standard(values.reshape(100, 100), 3.0, f) - mtf(f)).max() < 0.02
    assert np.sqrt(np.mean(np.square(found))) < 2.0 / 3.0 * np.sqrt(np.mean(np.square(standard)))
    assert np.abs(slanted_edge_mtf(GRID, values, frequency_per_mm=f).mtf - mtf(f)).max() < 0.002


@pytest.mark.slow
def test_mtf_sigma_matches_scatter():
    values, mtf = squares_at_an_edge()
    f = np.array([0.0, 20.0, 60.0, 100.0, 140.0, 166.0])
    rng, n_runs = np.random.default_rng(9), 100
    # Noise increases with the signal, as for shot noise.
    noise = 0.02 * np.sqrt(0.3 + values)
    draws = [
        slanted_edge_mtf(GRID, values + noise * rng.normal(size=values.size), frequency_per_mm=f) for _ in range(n_runs)
    ]
    found, sigma = np.array([one.mtf for one in draws]), np.array([one.mtf_sigma for one in draws])
    scatter, mean = found.std(axis=0, ddof=1), np.sqrt(np.square(sigma).mean(axis=0))

    assert mtf(f)[-1] > 10.0 * mean[-1]
    assert (scatter[0], mean[0]) == pytest.approx((0.0, 0.0), abs=1e-12)
    # The relative error of a standard deviation of n values is 1 / sqrt(2 n).
    assert scatter[1:] == pytest.approx(mean[1:], rel=5.0 / np.sqrt(2.0 * n_runs))
    assert np.all(np.abs(found.mean(axis=0) - mtf(f))[1:] < 5.0 * mean[1:] / np.sqrt(n_runs) + 5e-4)
    assert slanted_edge_mtf(GRID, values).mtf_sigma.max() < 0.002


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("kind", ["box of 2 pitches", "box of 20 pitches", "two-sided exponential", "core and halo"])
def test_widening_bins_preserve_mtf_of_wide_edges(kind):
    from scipy.special import ndtr

    layout = fs.layout.grid(n_x=150, n_y=150, pitch_um=2.0)
    d = layout.centroid_um @ [np.cos(np.deg2rad(5.0)), np.sin(np.deg2rad(5.0))]

    def gauss(f, sigma_um):
        return np.exp(-2.0 * (np.pi * 1e-3 * sigma_um * f) ** 2)

    values, expected = {
        "box of 2 pitches": (np.clip(d / 4.0 + 0.5, 0.0, 1.0), lambda f: np.abs(np.sinc(4e-3 * f))),
        "box of 20 pitches": (np.clip(d / 40.0 + 0.5, 0.0, 1.0), lambda f: np.abs(np.sinc(40e-3 * f))),
        "two-sided exponential": (
            0.5 + 0.5 * np.sign(d) * (1.0 - np.exp(-np.abs(d) / 6.0)),
            lambda f: 1.0 / (1.0 + (2e-3 * np.pi * 6.0 * f) ** 2),
        ),
        "core and halo": (0.8 * ndtr(d) + 0.2 * ndtr(d / 12.0), lambda f: 0.8 * gauss(f, 1.0) + 0.2 * gauss(f, 12.0)),
    }[kind]

    found = slanted_edge_mtf(layout, 100.0 + 100.0 * values)

    assert np.abs(found.mtf - expected(found.frequency_per_mm)).max() < 0.01


@pytest.mark.parametrize("bin_um", [0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0])
def test_edge_mtf_is_accurate_for_bin_widths(bin_um):
    values, mtf = squares_at_an_edge()

    found = slanted_edge_mtf(GRID, values, bin_um=bin_um)

    highest = min(1000.0 / 3.0, 250.0 / bin_um)
    assert found.frequency_per_mm[-1] == pytest.approx(highest)
    assert np.abs(found.mtf - mtf(found.frequency_per_mm)).max() < 0.012
    with pytest.raises(
        ParameterError, match=f"'frequency_per_mm' must be <= {250.0 / bin_um:.4g} with bins of {bin_um:g} µm"
    ):
        slanted_edge_mtf(GRID, values, bin_um=bin_um, frequency_per_mm=[0.0, 251.0 / bin_um])


def test_invalid_edge_arguments_raise():
    values, _ = squares_at_an_edge()
    blurred, _ = squares_at_an_edge(sigma_um=9.0)
    for options, message in (
        (
            {"frequency_per_mm": [0.0, 1e5]},
            "'frequency_per_mm' must be <= 333.3 with bins of 0.75 µm, got 100000.* narrower",
        ),
        ({"frequency_per_mm": [[0.0, 1.0], [2.0, 3.0]]}, "'frequency_per_mm' must be strictly increasing"),
        ({"frequency_per_mm": [0.0, 20.0, 10.0]}, "'frequency_per_mm' must be strictly increasing"),
        ({"frequency_per_mm": []}, "'frequency_per_mm' must be strictly increasing"),
        ({"bin_um": 3.1}, "'bin_um' must be <= 3, got 3.1 µm; the limit is one pitch"),
        ({"reach_um": 2.0}, "'reach_um' must be >= 15, got 2.0 µm; the minimum is five pitches of 3 µm"),
    ):
        with pytest.raises(ParameterError, match=message):
            slanted_edge_mtf(GRID, values, **options)
    with pytest.raises(ParameterError, match=r"'reach_um' must be >= 25\.6.* two edge widths of 12\.8"):
        slanted_edge_mtf(GRID, blurred, reach_um=20.0)


def test_values_symmetric_about_zero_have_mtf():
    values, _ = squares_at_an_edge()
    plain, about_0 = slanted_edge_mtf(GRID, values), slanted_edge_mtf(GRID, 100.0 * values - 50.0)

    assert about_0.contrast == np.inf
    assert about_0.mtf == pytest.approx(plain.mtf, abs=1e-4)


@pytest.mark.slow
def test_values_without_edge_raise():
    rng = np.random.default_rng(0)
    x, y = SQUARES.centroid_um[:, 0], SQUARES.centroid_um[:, 1]
    tilted = x + 0.1 * y
    for values, message in (
        (np.full(x.size, 3.0), "no edge found: all values are equal"),
        (rng.normal(100.0, 5.0, x.size), "no edge found: a straight edge explains .* % of the variance of the values"),
        ((np.floor(x / 20) + np.floor(y / 20)) % 2, "no edge found: a straight edge explains"),
        (100.0 + x, "no edge found: the fit is .* µm wide, more than a quarter"),
        (
            1000.0 + 10.0 * (tilted > 0),
            r"the contrast of the edge must be at least 0\.02, got .* \(black 1000, white 1010\)",
        ),
        (
            100.0 * (x > 0.1),
            "the edge spread function must extend to .* rotate the edge by a few degrees from the rows",
        ),
        (100.0 * (tilted > 122), "the edge is too close to the boundary of the region"),
    ):
        with pytest.raises(SimulationError, match=message):
            slanted_edge_mtf(SQUARES, values)
    with pytest.raises(ParameterError, match="'where' must select at least 50 sites, got 40"):
        slanted_edge_mtf(SQUARES, tilted, where=np.arange(3600) < 40)
    with pytest.raises(ParameterError, match="'where' must be a mask of the 3600 sites"):
        slanted_edge_mtf(SQUARES, tilted, where=[1, 2, 3])
    with pytest.raises(ParameterError, match="'values' must have one value for each of the 3600 sites"):
        slanted_edge_mtf(SQUARES, tilted[:5])


# -- sampling density--------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("layout", "expected_per_mm"),
    [
        (fs.layout.grid(n_x=9, n_y=7, pitch_um=2.5), 200.0),
        (fs.layout.grid(n_x=9, n_y=7, pitch_um=2.5, trench_um=0.5).rotate(33.0), 200.0),
        (fs.layout.grid(n_x=9, n_y=7, pitch_um=2.5, stagger=True), 200.0),
        (fs.layout.grid(n_x=40, n_y=7, pitch_um=1.0, pitch_y_um=25.0), 20.0),
        (fs.layout.hexagonal(n_columns=9, n_rows=8, pitch_um=2.0).rotate(11.0), 1000.0 / (np.sqrt(3.0) * 2.0)),
        (fs.layout.hexagonal(n_columns=9, n_rows=8, pitch_um=2.0, orientation="flat"), 1000.0 / (np.sqrt(3.0) * 2.0)),
    ],
)
def test_nyquist_matches_lattice_theory(layout, expected_per_mm):
    assert nyquist_per_mm(layout) == pytest.approx(np.full(layout.n_sites, expected_per_mm), rel=1e-9)


def test_neighbour_spacings_match_random_lattices():
    rng = np.random.default_rng(2)
    for _ in range(20):
        basis = rng.uniform(-3.0, 3.0, (2, 2))
        if abs(np.linalg.det(basis)) < 1.0:
            continue
        i = np.stack(np.meshgrid(np.arange(-25, 26), np.arange(-25, 26)), axis=-1).reshape(-1, 2)
        layout = fs.Layout.from_rectangles(i @ basis, 0.01)
        inner = np.hypot(*layout.centroid_um.T) < 4.0
        nearest_um, row_um = (values[inner] for values in neighbour_spacing_um(layout))
        # Reference: half the shortest vector of the reciprocal lattice.
        reciprocal = np.linalg.norm(np.delete(i, len(i) // 2, axis=0) @ np.linalg.inv(basis).transpose(), axis=1).min()

        assert nearest_um * row_um == pytest.approx(np.full(inner.sum(), abs(np.linalg.det(basis))), rel=1e-6)
        assert 1e-3 * nyquist_per_mm(layout)[inner] == pytest.approx(np.full(inner.sum(), 0.5 * reciprocal), rel=1e-6)


def test_nyquist_per_channel_of_mosaic():
    layout = fs.layout.mosaic(fs.layout.grid(n_x=12, n_y=12, pitch_um=2.0), ["RG", "GB"])
    found = nyquist_per_mm(layout, per_channel=True)

    # Red and blue have twice the pitch; green is a square lattice rotated by 45 degrees.
    for channel, expected in ((0, 125.0), (1, 250.0 / np.sqrt(2.0)), (2, 125.0)):
        assert found[layout.channel == channel] == pytest.approx(expected)
    with pytest.raises(ParameterError, match="'per_channel' must be False with by='area'"):
        nyquist_per_mm(layout, by="area", per_channel=True)


def test_coincident_sites_have_nan_nyquist():
    one = fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0)
    twice = fs.Layout.from_rectangles(np.concatenate((one.centroid_um, one.centroid_um[:1])), 1.0)
    found = nyquist_per_mm(twice)

    assert np.flatnonzero(np.isnan(found)).tolist() == [0, 16]
    assert found[5] == pytest.approx(250.0)


@pytest.mark.parametrize(
    "call",
    [
        nyquist_per_mm,
        neighbour_spacing_um,
        nyquist_vs_eccentricity,
        lambda layout: nyquist_per_mm(layout, by="area"),
        lambda layout: polygon_mtf(layout, [100.0]),
        lambda layout: slanted_edge_mtf(layout, [1.0]),
        fs.metrics.sampling_spectrum,
        fs.metrics.size_classes_um,
    ],
)
def test_invalid_layout_raises(call):
    with pytest.raises(ParameterError, match=r"'layout' must be a Layout, got a NoneType"):
        call(None)


def test_single_row_has_nan_nyquist():
    row = fs.layout.grid(n_x=20, n_y=1, pitch_um=2.0)

    assert np.isnan(nyquist_per_mm(row)).all()
    assert np.isnan(nyquist_per_mm(row[[3]])).all()
    assert nyquist_per_mm(row, by="area") == pytest.approx(250.0)


def test_log_polar_nyquist_is_inverse_to_eccentricity():
    layout = fs.layout.log_polar(n_sectors=200, min_size_um=2.0, r_max_um=400.0)
    table = nyquist_vs_eccentricity(layout, n_bins=10)
    centre_um = 0.5 * (table.edges_um[1:] + table.edges_um[:-1])

    assert table.n_sites.sum() == layout.n_sites
    assert table.size_at_centre_um == 0.0
    assert table.nyquist_per_mm * centre_um == pytest.approx(1000.0 * 200 / (4 * np.pi), rel=0.05)
    assert np.all(
        (table.nyquist_min_per_mm <= table.nyquist_per_mm) & (table.nyquist_per_mm <= table.nyquist_max_per_mm)
    )
    # A circumference 2π r consists of 200 approximately square sites.
    assert table.growth_fraction == pytest.approx(2 * np.pi / 200, rel=0.01)
    assert "size = 0 µm" in str(table)
    assert table.records()[0]["n_sites"] == table.n_sites[0]


def test_e2_of_uniform_and_retinal_layouts():
    uniform = nyquist_vs_eccentricity(SQUARES, n_bins=5)
    retina = nyquist_vs_eccentricity(fs.layout.fovi(fov_um=400.0, a_um=20.0, n_rings=50), by="area")

    assert uniform.nyquist_per_mm == pytest.approx(np.full(5, 125.0))
    assert (uniform.e2_um, uniform.growth_fraction) == (np.inf, 0.0)
    # The ring width is proportional to (r + a), so it has doubled at r = a.
    assert retina.e2_um == pytest.approx(20.0, rel=0.1)


@pytest.mark.parametrize("kind", ["grid", "hexagonal"])
def test_neighbour_spacing_is_independent_of_order(kind):
    rng = np.random.default_rng(3)
    layout = (
        fs.layout.grid(n_x=24, n_y=24, pitch_um=2.0)
        if kind == "grid"
        else fs.layout.hexagonal(n_columns=24, n_rows=24, pitch_um=2.0)
    )
    layout = layout.with_columns(channel=rng.integers(0, 3, layout.n_sites))
    order = rng.permutation(layout.n_sites)

    for all_um, permuted_um in zip(
        neighbour_spacing_um(layout, per_channel=True),
        neighbour_spacing_um(layout[order], per_channel=True),
        strict=True,
    ):
        np.testing.assert_allclose(permuted_um, all_um[order], rtol=1e-12)


def test_tied_rows_have_the_mean_distance():
    # Three sites at 2 µm: the two others are at 2.0, 1.6 or 1.2 µm from the line through one of them.
    layout = fs.Layout.from_rectangles([[0.0, 0.0], [-2.0, 0.0], [0.0, 2.0], [1.2, -1.6]], size_um=0.5)

    nearest_um, row_um = neighbour_spacing_um(layout)

    assert nearest_um[0] == pytest.approx(2.0, rel=1e-12)
    assert row_um[0] == pytest.approx((2.0 + 1.6 + 1.2) / 3.0, rel=1e-12)

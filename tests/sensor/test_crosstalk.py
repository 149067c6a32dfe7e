"""Crosstalk: exchanged charge, charge conservation, and correlations between sites."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
import scipy
import shapely

import foveasim as fs
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import grid
from foveasim.sensor import Diffusion, InterPixelCapacitance, KernelCrosstalk

#: Five standard errors: false-alarm probability 1 in 1.7 million.
SIGMAS = 5.0
ROOT_2_PI = math.sqrt(2.0 * math.pi)

HEXAGONS = fs.layout.hexagonal(n_columns=9, n_rows=8, pitch_um=3.0)
FRAME = fs.Layout.from_polygons(
    [shapely.box(0, 0, 8, 8).difference(shapely.box(2, 2, 5, 5)), shapely.box(2, 2, 5, 5), shapely.box(8, 1, 9, 8)]
)
IS_PRESENT = np.random.default_rng(5).random(HEXAGONS.n_sites) < 0.7
LAYOUTS = {
    "grid": lambda: grid(n_x=7, n_y=5, pitch_um=3.0),
    "rectangles": lambda: grid(n_x=7, n_y=5, pitch_um=3.0, pitch_y_um=5.0),
    "hexagons": lambda: HEXAGONS,
    "hexagons with gaps": lambda: HEXAGONS[IS_PRESENT],
    "rings": lambda: fs.layout.log_polar(n_sectors=16, r_min_um=6.0, r_max_um=44.0),
    "zones": lambda: fs.layout.zones(side_um=(8, 24, 56), pitch_um=(2, 4, 8)),
    "voronoi": lambda: fs.layout.voronoi(n_sites=200, size_um=(60.0, 40.0), seed=3),
    "a site in a hole": lambda: FRAME,
}


@cache
def layout_of(name):
    return LAYOUTS[name]()


#: Kernel without symmetry; all elements differ.
KERNEL = np.array([[0.01, 0.02, 0.03], [0.04, 0.6, 0.05], [0.06, 0.07, 0.12]])
WIDE = np.random.default_rng(8).random((5, 3)) / 20.0


def random_charge_e(layout, seed=0):
    return np.random.default_rng(seed).uniform(10.0, 1000.0, layout.n_sites)


def dense_matrix(operator):
    return operator.matrix.toarray()


# -- diffusion: conservation ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("spread_um", [0.0, 0.1, 1.0, 7.0])
@pytest.mark.parametrize("name", LAYOUTS)
def test_diffusion_conserves_charge_and_is_non_negative(name, spread_um):
    layout = layout_of(name)
    operator = Diffusion(spread_um=spread_um).compile(layout)
    charge_e = random_charge_e(layout)

    np.testing.assert_allclose(operator.matrix.sum(axis=0), 1.0, atol=1e-12)
    assert dense_matrix(operator).min() >= 0.0
    assert math.isclose(operator.apply(charge_e).sum(), charge_e.sum(), rel_tol=1e-12)


@pytest.mark.parametrize("spread_um", [0.1, 1.0, 7.0])
@pytest.mark.parametrize("name", LAYOUTS)
def test_diffusion_preserves_uniform_irradiance(name, spread_um):
    layout = layout_of(name)
    uniform_e = 70.0 * layout.area_um2

    np.testing.assert_allclose(Diffusion(spread_um=spread_um).compile(layout).apply(uniform_e), uniform_e, rtol=1e-10)


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("name", sorted(LAYOUTS.keys() - {"hexagons with gaps"}))
def test_repeated_diffusion_equalises_charge_density(name):
    layout = layout_of(name)
    charge_e = random_charge_e(layout)
    operator = Diffusion(spread_um=5.0).compile(layout)
    for _ in range(4000):
        charge_e = operator.apply(charge_e)

    np.testing.assert_allclose(charge_e / charge_e.sum(), layout.area_um2 / layout.area_um2.sum(), rtol=1e-6)


def test_zero_spread_is_identity():
    charge_e = random_charge_e(HEXAGONS)
    assert np.array_equal(Diffusion(spread_um=0.0).compile(HEXAGONS).apply(charge_e), charge_e)


def test_isolated_sites_retain_charge():
    layout = fs.Layout.from_polygons([shapely.box(0, 0, 2, 2), shapely.box(2, 0, 4, 2), shapely.box(9, 9, 11, 11)])
    charge_e = Diffusion(spread_um=0.5).compile(layout).apply([0.0, 100.0, 33.0])

    assert charge_e[2] == 33.0
    assert charge_e[0] > 0.0


def test_crosstalk_supports_empty_and_single_layouts():
    for layout in (HEXAGONS[[]], HEXAGONS[[3]]):
        charge_e = np.full(layout.n_sites, 5.0)
        for crosstalk in (
            Diffusion(spread_um=1.0),
            InterPixelCapacitance(neighbour_fraction=0.1),
            KernelCrosstalk(kernel=KERNEL / KERNEL.sum()),
        ):
            np.testing.assert_allclose(crosstalk.compile(layout).apply(charge_e), charge_e, rtol=1e-15)


# -- diffusion: exchanged fractions ---------------------------------------------------------------------------------


def test_two_site_exchange_matches_edge_over_area():
    """``spread / sqrt(2 pi)`` times the shared edge of 2 µm, over 8 µm² and over 2 µm²."""
    layout = fs.Layout.from_polygons([shapely.box(0, 0, 4, 2), shapely.box(4, 0, 5, 2)])
    strip_um2 = 2.0 * 0.1 / ROOT_2_PI

    expected = [[1 - strip_um2 / 8, strip_um2 / 2], [strip_um2 / 8, 1 - strip_um2 / 2]]
    np.testing.assert_allclose(dense_matrix(Diffusion(spread_um=0.1).compile(layout)), expected, rtol=1e-12)


def blurred(offset, spread_um, pitch_um):
    """Return the fraction of a uniformly charged cell that a Gaussian blur moves by ``offset`` cells in a row."""

    def ramp_um(x_um):
        """Return the integral of the normal CDF from minus infinity."""
        z = x_um / spread_um
        return x_um * scipy.special.ndtr(z) + spread_um * np.exp(-0.5 * z * z) / ROOT_2_PI

    away_um = np.abs(offset) * pitch_um
    return (ramp_um(pitch_um - away_um) - 2.0 * ramp_um(-away_um) + ramp_um(-pitch_um - away_um)) / pitch_um


@pytest.mark.parametrize("spread_um", [0.02, 0.1, 0.3])
def test_short_spread_matches_gaussian_blur(spread_um):
    """Strips share no corners, so the closed form of the one-dimensional blur is exact."""
    mixed = Diffusion(spread_um=spread_um).compile(grid(n_x=3, n_y=1, pitch_um=2.0)).apply([0.0, 1.0, 0.0])
    np.testing.assert_allclose(mixed, blurred(np.arange(-1, 2), spread_um, 2.0), rtol=1e-9)


@pytest.mark.parametrize("spread_um", [0.05, 0.24, 0.26, 0.5, 1.0, 2.0, 6.0])
def test_single_site_charge_has_blur_variance(spread_um):
    """Charge distributed uniformly over the central site, blurred and summed per site, has the variance of the operator."""
    pitch_um, n, centre = 2.0, 121, 60
    charge_e = np.zeros((n, n))
    charge_e[centre, centre] = 1.0
    operator = Diffusion(spread_um=spread_um).compile(grid(n_x=n, n_y=n, pitch_um=pitch_um))
    picture = operator.apply(charge_e.ravel()).reshape(n, n)
    offset = np.arange(n) - centre
    along_x = np.sum(picture * offset**2)
    along_y = np.sum(picture * offset[:, np.newaxis] ** 2)

    expected = np.sum(offset**2 * blurred(offset, spread_um, pitch_um))
    assert math.isclose(along_x, expected, rel_tol=1e-9)
    assert math.isclose(along_y, along_x, rel_tol=1e-12)


def test_long_spread_variance_matches_diffusion_formula():
    """Variance ``2 D t`` plus 1/6 of a squared cell, for electrons in silicon (36 cm²/s) and 1 ns."""
    n, centre = 81, 40
    charge_e = np.zeros((n, n))
    charge_e[centre, centre] = 1.0
    variance_um2 = 2.0 * 36e8 * 1e-9
    operator = Diffusion(spread_um=math.sqrt(variance_um2)).compile(grid(n_x=n, n_y=n, pitch_um=1.0))
    offset_um = np.arange(n) - centre
    measured_um2 = np.sum(operator.apply(charge_e.ravel()).reshape(n, n) * offset_um**2)

    assert operator.n_steps > 1
    assert math.isclose(measured_um2, variance_um2 + 1.0 / 6.0, rel_tol=1e-9)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("name", ["hexagons", "voronoi"])
def test_short_spread_matches_monte_carlo_loss(name):
    """
    Electrons start uniformly in a site and are displaced randomly; those outside are counted.

    Charge across corners is of relative order ``spread / edge``; the combination of two spreads isolates the linear term.
    """
    layout = layout_of(name)
    site = int(np.argmin(np.hypot(*(layout.centroid_um - layout.centroid_um.mean(axis=0)).T)))
    polygon = layout.polygons()[site]
    shapely.prepare(polygon)
    rng = np.random.default_rng(12)
    x0, y0, x1, y1 = polygon.bounds
    points = rng.uniform((x0, y0), (x1, y1), (3_000_000, 2))
    points = points[shapely.contains_xy(polygon, *points.T)]
    way = rng.standard_normal(points.shape)

    def simulated_loss(spread_um):
        return np.mean(~shapely.contains_xy(polygon, *(points + spread_um * way).T))

    def model_loss(spread_um):
        charge_e = np.zeros(layout.n_sites)
        charge_e[site] = 1.0
        return 1.0 - Diffusion(spread_um=spread_um).compile(layout).apply(charge_e)[site]

    # loss(s) = a s - b s², so 2 loss(s) - loss(2 s) / 2 = a s; the model has b = 0.
    s_um = 0.03
    error = SIGMAS * math.sqrt((4.0 * model_loss(s_um) + 0.25 * model_loss(2 * s_um)) / points.shape[0])
    assert abs(2.0 * simulated_loss(s_um) - 0.5 * simulated_loss(2 * s_um) - model_loss(s_um)) < error
    assert error < 0.1 * model_loss(s_um)


def test_fraction_is_continuous_between_spread_regimes():
    spread_um = 0.125 * (1.0 + np.array([-1e-9, 1e-9]))
    below, above = (
        dense_matrix(Diffusion(spread_um=s).compile(layout_of("grid").scale(1 / 3)))[0, 1] for s in spread_um
    )
    assert math.isclose(below, above, rel_tol=1e-8)


def test_multi_step_exchange_matches_closed_form():
    """Each of n steps reduces the difference by the factor ``1 - 2 a / n``."""
    operator = Diffusion(spread_um=2.0).compile(grid(n_x=2, n_y=1, pitch_um=1.0))
    a = 0.5 * (2.0**2 + 1.0 / 6.0)
    n = operator.n_steps

    assert n == math.ceil(2.0 * a)
    remaining = 0.5 * (1.0 + (1.0 - 2.0 * a / n) ** n)
    np.testing.assert_allclose(operator.apply([1.0, 0.0]), [remaining, 1.0 - remaining], rtol=1e-12)


@pytest.mark.parametrize("spread_um", [0.05, 3.0])
def test_site_in_hole_exchanges_along_outline(spread_um):
    frame, hole = shapely.box(0, 0, 9, 9), shapely.box(3, 3, 6, 6)
    operator = Diffusion(spread_um=spread_um).compile(fs.Layout.from_polygons([frame.difference(hole), hole]))

    assert operator.n_steps < 10
    if spread_um < 1.0:
        assert math.isclose(dense_matrix(operator)[0, 1], 12.0 * spread_um / ROOT_2_PI / 9.0, rel_tol=1e-9)


@pytest.mark.parametrize("fraction", [0.0, 0.02, 0.2, 0.5])
def test_measured_neighbour_fraction_is_reproduced(fraction):
    diffusion = Diffusion.from_neighbour_fraction(fraction, pitch_um=3.0)
    operator = diffusion.compile(layout_of("grid"))
    charge_e = np.zeros(35)
    charge_e[17] = 1.0

    assert operator.n_steps == 1
    assert math.isclose(operator.apply(charge_e)[17], 1.0 - fraction, rel_tol=1e-9)
    assert math.isclose(operator.apply(charge_e)[18], fraction / 4, rel_tol=1e-9, abs_tol=1e-15)


def test_half_pitch_doubles_charge_loss():
    diffusion = Diffusion.from_neighbour_fraction(0.05, pitch_um=6.0)
    remaining = dense_matrix(diffusion.compile(grid(n_x=3, n_y=3, pitch_um=3.0)))[4, 4]
    assert math.isclose(remaining, 1.0 - 0.10, rel_tol=1e-9)


def test_max_gap_enables_exchange_across_trenches():
    layout = grid(n_x=3, n_y=1, pitch_um=2.0, trench_um=0.2)
    charge_e = Diffusion(spread_um=0.1, max_gap_um=0.21).compile(layout).apply([0.0, 1.0, 0.0])
    assert charge_e[0] == pytest.approx(0.1 / ROOT_2_PI / 1.8)


@pytest.mark.parametrize(
    "crosstalk",
    [
        Diffusion(spread_um=0.4),
        Diffusion(spread_um=4.0),
        InterPixelCapacitance(neighbour_fraction=0.02),
        KernelCrosstalk(kernel=KERNEL),
    ],
    ids=["short", "long", "coupling", "kernel"],
)
def test_crosstalk_is_independent_of_site_order(crosstalk):
    layout = layout_of("grid")
    order = np.random.default_rng(4).permutation(layout.n_sites)
    charge_e = random_charge_e(layout)

    shuffled = crosstalk.compile(layout[order]).apply(charge_e[order])
    np.testing.assert_allclose(shuffled, crosstalk.compile(layout).apply(charge_e)[order], rtol=1e-12)


def test_frames_are_mixed_independently_and_unmodified():
    frames_e = np.stack([random_charge_e(HEXAGONS, seed) for seed in range(6)]).reshape(2, 3, -1)
    before = frames_e.copy()
    operator = Diffusion(spread_um=2.0).compile(HEXAGONS)
    mixed = operator.apply(frames_e)

    assert operator.n_steps > 1
    assert mixed.shape == frames_e.shape
    assert np.array_equal(frames_e, before)
    np.testing.assert_allclose(mixed[1, 2], operator.apply(frames_e[1, 2]), rtol=1e-14)


# -- kernels ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kernel", [KERNEL, np.full((3, 3), 1 / 9), WIDE, KERNEL[:, ::-1]], ids=["asymmetric", "box", "5x3", "mirrored"]
)
@pytest.mark.parametrize("n_x", [1, 2, 9])
def test_lost_border_matches_scipy_constant_convolution(kernel, n_x):
    layout = grid(n_x=n_x, n_y=6, pitch_um=2.2)
    picture = random_charge_e(layout).reshape(6, n_x)
    expected = scipy.ndimage.convolve(picture, kernel, mode="constant")

    mixed = KernelCrosstalk(kernel=kernel, border="lost").compile(layout).apply(picture.ravel())
    np.testing.assert_allclose(mixed.reshape(6, n_x), expected, rtol=1e-14)


def test_kept_border_matches_scipy_reflected_convolution():
    kernel = np.array([[0.0, 0.04, 0.0], [0.03, 0.86, 0.02], [0.0, 0.05, 0.0]])
    symmetric = 0.5 * (kernel + kernel[::-1, ::-1])
    picture = random_charge_e(grid(n_x=9, n_y=6, pitch_um=1.0)).reshape(6, 9)
    expected = scipy.ndimage.convolve(picture, symmetric, mode="reflect")

    mixed = KernelCrosstalk(kernel=symmetric).compile(grid(n_x=9, n_y=6, pitch_um=1.0)).apply(picture.ravel())
    np.testing.assert_allclose(mixed.reshape(6, 9), expected, rtol=1e-14)


def test_border_modes_agree_in_interior():
    layout = grid(n_x=9, n_y=6, pitch_um=1.0)
    kept, lost = (
        KernelCrosstalk(kernel=KERNEL, border=border).compile(layout).apply(random_charge_e(layout))
        for border in ("kept", "lost")
    )
    assert np.array_equal(kept.reshape(6, 9)[1:-1, 1:-1], lost.reshape(6, 9)[1:-1, 1:-1])
    assert (kept >= lost).all()


def test_kernel_is_point_response_lowest_row_first():
    layout = grid(n_x=3, n_y=3, pitch_um=2.0)
    charge_e = np.zeros(9)
    charge_e[4] = 1.0
    mixed = KernelCrosstalk(kernel=KERNEL).compile(layout).apply(charge_e)

    for j, y_um in enumerate((-2.0, 0.0, 2.0)):
        for i, x_um in enumerate((-2.0, 0.0, 2.0)):
            at = np.flatnonzero(np.all(np.abs(layout.centroid_um - [x_um, y_um]) < 1e-9, axis=1))
            assert mixed[at] == KERNEL[j, i]


@pytest.mark.parametrize("border", ["kept", "lost"])
def test_missing_sites_act_as_zero_charge(border):
    whole = grid(n_x=20, n_y=15, pitch_um=1.4)
    is_there = np.random.default_rng(2).random(whole.n_sites) < 0.6
    order = np.random.default_rng(3).permutation(np.flatnonzero(is_there))
    layout = whole[order].translate(1234.5, -77.7)
    picture = np.where(is_there, random_charge_e(whole), 0.0)
    expected = scipy.ndimage.convolve(picture.reshape(15, 20), KERNEL, mode="constant").ravel()
    if border == "kept":
        arrives = scipy.ndimage.correlate(is_there.reshape(15, 20).astype(float), KERNEL, mode="constant").ravel()
        expected += picture * (KERNEL.sum() - arrives)

    operator = KernelCrosstalk(kernel=KERNEL, border=border).compile(layout)
    np.testing.assert_allclose(operator.apply(picture[order]), expected[order], rtol=1e-12)
    if border == "kept":
        np.testing.assert_allclose(operator.matrix.sum(axis=0), KERNEL.sum(), rtol=1e-14)


def test_missing_columns_are_detected():
    whole = grid(n_x=10, n_y=4, pitch_um=2.0)
    layout = whole[~np.isin(whole.columns["column"], [2, 3, 7])]
    operator = KernelCrosstalk(kernel=KERNEL).compile(layout)
    column = layout.columns["column"]
    target, source = operator.matrix.nonzero()

    assert np.abs(column[target] - column[source]).max() == 1


@pytest.mark.parametrize(
    "layout",
    [
        grid(n_x=30, n_y=20, pitch_um=1.9, pitch_y_um=2.7),
        grid(n_x=30, n_y=20, pitch_um=1.9, fill_factor=0.2),
        grid(n_x=1000, n_y=3, pitch_um=1.1234567).translate(3e4, 0.0),
        grid(n_x=40, n_y=2, pitch_um=10.0, pitch_y_um=2000.0),
    ],
    ids=["rectangles", "low fill factor", "long rows", "tall sites"],
)
def test_axis_parallel_grids_are_detected(layout):
    """Vertices are rounded to a manufacturing grid of 1 nm."""
    rounded = fs.Layout(np.round(layout.xy_um, 3), layout.ring_offsets, layout.site_offsets, layout.columns)
    n_y, n_x = layout.columns["row"].max() + 1, layout.columns["column"].max() + 1
    picture = random_charge_e(layout).reshape(n_y, n_x)
    mixed = KernelCrosstalk(kernel=KERNEL, border="lost").compile(rounded).apply(picture.ravel())

    expected = scipy.ndimage.convolve(picture, KERNEL, mode="constant")
    np.testing.assert_allclose(mixed.reshape(n_y, n_x), expected, rtol=1e-14)


def test_pitch_defines_grid_of_few_sites():
    layout = grid(n_x=4, n_y=4, pitch_um=2.0)[[0, 5, 15]]
    with pytest.raises(SimulationError, match=r"no two sites are side by side.*set 'pitch_um' if sites are missing$"):
        KernelCrosstalk(kernel=KERNEL).compile(layout)

    for pitch_um in (2.0, (2.0, 2.0)):
        mixed = KernelCrosstalk(kernel=KERNEL, pitch_um=pitch_um, border="lost").compile(layout).apply([1.0, 0.0, 0.0])
        assert mixed.tolist() == [KERNEL[1, 1], KERNEL[2, 2], 0.0]


@pytest.mark.parametrize(
    "name", ["hexagons", "rings", "zones", "voronoi", "staggered", "rotated", "slightly rotated", "duplicated"]
)
def test_layouts_other_than_grids_are_rejected(name):
    layout = {
        **LAYOUTS,
        "staggered": lambda: grid(n_x=5, n_y=4, pitch_um=2.0, stagger=True, fill_factor=0.3),
        "rotated": lambda: layout_of("grid").rotate(20.0),
        "slightly rotated": lambda: grid(n_x=50, n_y=50, pitch_um=2.0).rotate(2.0),
        "duplicated": lambda: layout_of("grid")[[0, 1, 2, 1]],
    }[name]()
    with pytest.raises(
        SimulationError, match=r"not a grid[^\n]*use Diffusion, which supports sites of any shape[^\n]*$"
    ):
        KernelCrosstalk(kernel=KERNEL).compile(layout)


def test_kernels_are_comparable_and_hashable():
    crosstalk = KernelCrosstalk(kernel=KERNEL)
    assert crosstalk == KernelCrosstalk(kernel=KERNEL.tolist())
    assert hash(crosstalk) == hash(KernelCrosstalk(kernel=KERNEL.copy()))


# -- correlations after the draw --------------------------------------------------------------------------------------

N_FRAMES = 40_000
SMALL = fs.layout.hexagonal(n_columns=5, n_rows=4, pitch_um=3.0)


def draw_frames(expected_e, seed):
    return np.random.default_rng(seed).poisson(expected_e, (N_FRAMES, expected_e.size))


def covariance_deviation(samples, expected):
    """Return the largest deviation of the sample covariance in standard errors of Gaussian samples."""
    variance = np.diag(expected)
    error = np.sqrt((expected**2 + np.outer(variance, variance)) / N_FRAMES)
    return np.abs((np.cov(samples, rowvar=False) - expected) / error).max()


def test_diffused_charges_are_poisson_and_uncorrelated():
    expected_e = Diffusion(spread_um=0.8).compile(SMALL).apply(np.where(np.arange(20) == 7, 9e4, 2e3))
    electrons = draw_frames(expected_e, seed=21)

    assert expected_e[6] > 3e3
    assert covariance_deviation(electrons, np.diag(expected_e)) < SIGMAS


def test_coupled_charges_have_predicted_covariance():
    mean_e = np.where(np.arange(20) == 7, 9e4, 2e3).astype(float)
    operator = InterPixelCapacitance(neighbour_fraction=0.03).compile(SMALL)
    read_e = operator.apply(draw_frames(mean_e, seed=22))
    coupling = dense_matrix(operator)
    expected = coupling @ np.diag(mean_e) @ coupling.T

    assert covariance_deviation(read_e, expected) < SIGMAS
    # Sensitivity of the test: the covariance without coupling is rejected.
    assert covariance_deviation(read_e, np.diag(mean_e)) > 5.0 * SIGMAS
    np.testing.assert_allclose(operator.variance(mean_e), np.diag(expected), rtol=1e-12)


def test_coupled_row_covariance_matches_closed_form():
    a, variance_e2 = 0.02, 500.0
    coupling = dense_matrix(InterPixelCapacitance(neighbour_fraction=a).compile(grid(n_x=9, n_y=1, pitch_um=2.0)))
    covariance = variance_e2 * coupling @ coupling.T

    expected = [variance_e2 * x for x in (1 - 4 * a + 6 * a**2, 2 * a * (1 - 2 * a), a**2, 0.0)]
    np.testing.assert_allclose(covariance[4, 4:8], expected, rtol=1e-12, atol=1e-12)


# -- inter-pixel capacitance --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LAYOUTS)
def test_coupling_is_symmetric_and_conserves_charge(name):
    layout = layout_of(name)
    operator = InterPixelCapacitance(neighbour_fraction=0.01).compile(layout)
    charge_e = random_charge_e(layout)

    np.testing.assert_allclose(dense_matrix(operator), dense_matrix(operator).T, atol=1e-15)
    np.testing.assert_allclose(operator.matrix.sum(axis=0), 1.0, atol=1e-12)
    assert math.isclose(operator.apply(charge_e).sum(), charge_e.sum(), rel_tol=1e-12)


@pytest.mark.parametrize("name", ["grid", "hexagons"])
def test_regular_tilings_have_stated_neighbour_fraction(name):
    coupling = dense_matrix(InterPixelCapacitance(neighbour_fraction=0.01).compile(layout_of(name)))
    neighbours = coupling[coupling < 0.5]
    np.testing.assert_allclose(neighbours[neighbours > 0.0], 0.01, rtol=1e-9)


def test_neighbour_fraction_scales_with_reference_edge():
    coupling = dense_matrix(InterPixelCapacitance(neighbour_fraction=0.01, edge_um=6.0).compile(layout_of("grid")))
    assert math.isclose(coupling[0, 1], 0.005, rel_tol=1e-9)


@pytest.mark.parametrize("name", ["hexagons", "zones", "voronoi"])
@pytest.mark.parametrize("is_equal", [True, False])
def test_weak_coupling_matches_capacitor_network(name, is_equal):
    """The reference solves the complete network; the difference is of second order in the coupling."""
    layout = layout_of(name)
    node_f = np.random.default_rng(6).uniform(1.0, 1.0 if is_equal else 4.0, layout.n_sites) * 1e-15
    charge_e = random_charge_e(layout)
    edge_um = layout.adjacency().toarray()
    typical_um, typical_f = np.median(edge_um[edge_um > 0]), np.median(node_f)

    def deviation_e(fraction):
        between_f = fraction * typical_f / typical_um * edge_um
        network_f = np.diag(node_f + between_f.sum(axis=1)) - between_f
        measured_e = node_f * np.linalg.solve(network_f, charge_e)
        mixed_e = (
            InterPixelCapacitance(neighbour_fraction=fraction).compile(layout, capacitance_f=node_f).apply(charge_e)
        )
        assert math.isclose(mixed_e.sum(), charge_e.sum(), rel_tol=1e-12)
        return np.abs(mixed_e - measured_e).max()

    assert 3.6 < deviation_e(2e-4) / deviation_e(1e-4) < 4.4


def test_equal_node_voltages_do_not_mix():
    node_f = np.random.default_rng(6).uniform(1.0, 4.0, HEXAGONS.n_sites) * 1e-15
    charge_e = 1e18 * node_f
    mixed_e = InterPixelCapacitance(neighbour_fraction=0.01).compile(HEXAGONS, capacitance_f=node_f).apply(charge_e)
    np.testing.assert_allclose(mixed_e, charge_e, rtol=1e-12)


def test_common_capacitance_does_not_change_coupling():
    coupling = InterPixelCapacitance(neighbour_fraction=0.01)
    assert (coupling.compile(HEXAGONS, capacitance_f=1e-13).matrix != coupling.compile(HEXAGONS).matrix).nnz == 0


# -- invalid input ----------------------------------------------------------------------------------------------------

BAD = [-0.1, math.nan, math.inf, "much", None]


@pytest.mark.parametrize("value", [*BAD, 1e9])
def test_invalid_spread_is_rejected(value):
    with pytest.raises(ParameterError, match=r"^'spread_um' must be[^\n]*$"):
        Diffusion(spread_um=value)


@pytest.mark.parametrize("value", [*BAD, 0.51, 1.5])
def test_invalid_neighbour_fraction_is_rejected(value):
    with pytest.raises(ParameterError, match=r"^'neighbour_fraction' must be[^\n]*$"):
        InterPixelCapacitance(neighbour_fraction=value)
    with pytest.raises(ParameterError, match=r"^'neighbour_fraction' must be[^\n]*$"):
        Diffusion.from_neighbour_fraction(value, pitch_um=2.0)


@pytest.mark.parametrize("value", BAD[:-1])
def test_invalid_gap_edge_and_pitch_are_rejected(value):
    with pytest.raises(ParameterError, match=r"^'max_gap_um' must be[^\n]*$"):
        Diffusion(spread_um=1.0, max_gap_um=value)
    with pytest.raises(ParameterError, match=r"^'edge_um' must be[^\n]*$"):
        InterPixelCapacitance(neighbour_fraction=0.01, edge_um=value)
    with pytest.raises(ParameterError, match=r"^'pitch_um' must be[^\n]*$"):
        KernelCrosstalk(kernel=KERNEL, pitch_um=value)


@pytest.mark.parametrize(
    ("kernel", "rule"),
    [
        (np.full((2, 3), 0.1), r"must have odd numbers of rows and columns, got the shape \(2, 3\)"),
        (np.full((3, 4), 0.01), "must have odd numbers of rows and columns"),
        (np.zeros((3, 0)), "must have odd numbers of rows and columns"),
        (np.full((3, 3), 0.2), "must have a sum of at most 1, got 1.8"),
        ([[0.0, -0.1, 0.0]], "must be >= 0.0 everywhere, got -0.1"),
        ([[0.0, math.nan, 0.0]], "must be finite everywhere"),
        ([0.1, 0.8, 0.1], "must have 2 dimensions"),
        ([[0.1, 0.8], [0.1]], "must be an array of numbers"),
        (None, "must be a list of arrays"),
        (1.0, "must be a list of arrays"),
    ],
)
def test_invalid_kernel_is_rejected(kernel, rule):
    with pytest.raises(ParameterError, match=rf"^'kernel' {rule}[^\n]*$"):
        KernelCrosstalk(kernel=kernel)


def test_unknown_border_rule_is_rejected():
    with pytest.raises(ParameterError, match="'border' must be one of 'kept', 'lost', got 'wrap'"):
        KernelCrosstalk(kernel=KERNEL, border="wrap")


@pytest.mark.parametrize(
    "crosstalk",
    [Diffusion(spread_um=1.0), InterPixelCapacitance(neighbour_fraction=0.01), KernelCrosstalk(kernel=KERNEL)],
)
def test_compile_rejects_other_than_layouts(crosstalk):
    with pytest.raises(ParameterError, match="'layout' must be a Layout, got a list"):
        crosstalk.compile([1, 2, 3])


@pytest.mark.parametrize("crosstalk", [Diffusion(spread_um=1.0), InterPixelCapacitance(neighbour_fraction=0.01)])
def test_layout_without_shared_edges_suggests_gap(crosstalk):
    with pytest.raises(
        SimulationError, match=r"no two sites of the layout share an edge.*set 'max_gap_um' to the trench width$"
    ):
        crosstalk.compile(grid(n_x=3, n_y=3, pitch_um=2.0, trench_um=0.2))


def test_excessive_spread_error_names_site():
    layout = fs.Layout.from_polygons(
        [shapely.box(0, 0, 5, 5), shapely.box(5, 0, 5.001, 5), shapely.box(5.001, 0, 9, 5)]
    )
    with pytest.raises(
        ParameterError, match=r"'spread_um' must be shorter for site 1 with an area of only 0.005 µm², got 20.0 µm; the"
    ):
        Diffusion(spread_um=20.0).compile(layout)


def test_strong_coupling_error_names_site():
    with pytest.raises(
        ParameterError, match=r"'neighbour_fraction' must be smaller: site 8 would couple 0.8 of its charge"
    ):
        InterPixelCapacitance(neighbour_fraction=0.2).compile(layout_of("grid"))


@pytest.mark.parametrize("charge_e", [np.ones(5), 3.0, np.ones((72, 2)), "all"])
def test_charges_of_wrong_length_are_rejected(charge_e):
    operator = InterPixelCapacitance(neighbour_fraction=0.01).compile(HEXAGONS)
    for call, name in ((operator.apply, "charge_e"), (operator.variance, "variance")):
        with pytest.raises(ParameterError, match=f"^'{name}' must"):
            call(charge_e)


def test_capacitances_must_match_layout():
    with pytest.raises(ParameterError, match="'capacitance_f' must be one number, or one for each of the 72 sites"):
        InterPixelCapacitance(neighbour_fraction=0.01).compile(HEXAGONS, capacitance_f=np.ones(3))
    with pytest.raises(ParameterError, match=r"'capacitance_f' must be > 0.0 everywhere"):
        InterPixelCapacitance(neighbour_fraction=0.01).compile(HEXAGONS, capacitance_f=np.zeros(72))

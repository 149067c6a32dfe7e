"""Crosstalk: what crosses a border, what stays, and which sites are correlated after it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.ndimage
import scipy.special
import shapely

import foveasim as fs
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import grid
from foveasim.sensor import Diffusion, InterPixelCapacitance, KernelCrosstalk

#: Five standard errors: a right answer is outside once in 1.7 million.
SIGMAS = 5.0
ROOT_2_PI = math.sqrt(2.0 * math.pi)

HEXAGONS = fs.layout.hexagonal(n_columns=9, n_rows=8, pitch_um=3.0)
FRAME = fs.Layout.from_polygons(
    [shapely.box(0, 0, 8, 8).difference(shapely.box(2, 2, 5, 5)), shapely.box(2, 2, 5, 5), shapely.box(8, 1, 9, 8)]
)
STAYS = np.random.default_rng(5).random(HEXAGONS.n_sites) < 0.7
LAYOUTS = {
    "grid": grid(n_x=7, n_y=5, pitch_um=3.0),
    "rectangles": grid(n_x=7, n_y=5, pitch_um=3.0, pitch_y_um=5.0),
    "hexagons": HEXAGONS,
    "hexagons with gaps": HEXAGONS[STAYS],
    "rings": fs.layout.log_polar(n_sectors=16, r_min_um=6.0, r_max_um=44.0),
    "zones": fs.layout.zones(side_um=(8, 24, 56), pitch_um=(2, 4, 8)),
    "voronoi": fs.layout.voronoi(n_sites=200, size_um=(60.0, 40.0), seed=3),
    "a site in a hole": FRAME,
}
#: No symmetry at all, and shares that tell every place apart.
KERNEL = np.array([[0.01, 0.02, 0.03], [0.04, 0.6, 0.05], [0.06, 0.07, 0.12]])
WIDE = np.random.default_rng(8).random((5, 3)) / 20.0


def light(layout, seed=0):
    return np.random.default_rng(seed).uniform(10.0, 1000.0, layout.n_sites)


def shares(operator):
    return operator.matrix.toarray()


# -- diffusion: what is conserved -----------------------------------------------------------------------------------


@pytest.mark.parametrize("spread_um", [0.0, 0.1, 1.0, 7.0])
@pytest.mark.parametrize("name", LAYOUTS)
def test_diffusion_loses_no_charge_and_makes_none_negative(name, spread_um):
    layout = LAYOUTS[name]
    operator = Diffusion(spread_um=spread_um).compile(layout)
    charge_e = light(layout)

    np.testing.assert_allclose(operator.matrix.sum(axis=0), 1.0, atol=1e-12)
    assert shares(operator).min() >= 0.0
    assert math.isclose(operator.apply(charge_e).sum(), charge_e.sum(), rel_tol=1e-12)


@pytest.mark.parametrize("spread_um", [0.1, 1.0, 7.0])
@pytest.mark.parametrize("name", LAYOUTS)
def test_an_even_light_stays_even_whatever_the_sites(name, spread_um):
    layout = LAYOUTS[name]
    even_e = 70.0 * layout.area_um2

    np.testing.assert_allclose(Diffusion(spread_um=spread_um).compile(layout).apply(even_e), even_e, rtol=1e-10)


@pytest.mark.parametrize("name", sorted(LAYOUTS.keys() - {"hexagons with gaps"}))
def test_charge_spreads_in_the_end_by_area(name):
    layout = LAYOUTS[name]
    charge_e = light(layout)
    operator = Diffusion(spread_um=5.0).compile(layout)
    for _ in range(4000):
        charge_e = operator.apply(charge_e)

    np.testing.assert_allclose(charge_e / charge_e.sum(), layout.area_um2 / layout.area_um2.sum(), rtol=1e-6)


def test_no_spread_changes_nothing():
    charge_e = light(HEXAGONS)
    assert np.array_equal(Diffusion(spread_um=0.0).compile(HEXAGONS).apply(charge_e), charge_e)


def test_islands_keep_their_charge():
    layout = fs.Layout.from_polygons([shapely.box(0, 0, 2, 2), shapely.box(2, 0, 4, 2), shapely.box(9, 9, 11, 11)])
    charge_e = Diffusion(spread_um=0.5).compile(layout).apply([0.0, 100.0, 33.0])

    assert charge_e[2] == 33.0
    assert charge_e[0] > 0.0


def test_layouts_of_no_site_and_of_one():
    for layout in (HEXAGONS[[]], HEXAGONS[[3]]):
        charge_e = np.full(layout.n_sites, 5.0)
        for crosstalk in (
            Diffusion(spread_um=1.0),
            InterPixelCapacitance(neighbour_fraction=0.1),
            KernelCrosstalk(kernel=KERNEL / KERNEL.sum()),
        ):
            np.testing.assert_allclose(crosstalk.compile(layout).apply(charge_e), charge_e, rtol=1e-15)


# -- diffusion: how much --------------------------------------------------------------------------------------------


def test_two_sites_exchange_by_edge_and_area():
    """``spread / sqrt(2 pi)`` times the common edge of 2 µm, over 8 µm² and over 2 µm²."""
    layout = fs.Layout.from_polygons([shapely.box(0, 0, 4, 2), shapely.box(4, 0, 5, 2)])
    strip_um2 = 2.0 * 0.1 / ROOT_2_PI

    expected = [[1 - strip_um2 / 8, strip_um2 / 2], [strip_um2 / 8, 1 - strip_um2 / 2]]
    np.testing.assert_allclose(shares(Diffusion(spread_um=0.1).compile(layout)), expected, rtol=1e-12)


def blurred(offset, spread_um, pitch_um):
    """Fraction of a cell's even charge that a Gaussian blur brings so many cells away, in a row of cells."""

    def ramp_um(x_um):
        """Integral of the normal distribution function from minus infinity."""
        z = x_um / spread_um
        return x_um * scipy.special.ndtr(z) + spread_um * np.exp(-0.5 * z * z) / ROOT_2_PI

    away_um = np.abs(offset) * pitch_um
    return (ramp_um(pitch_um - away_um) - 2.0 * ramp_um(-away_um) + ramp_um(-pitch_um - away_um)) / pitch_um


@pytest.mark.parametrize("spread_um", [0.02, 0.1, 0.3])
def test_a_short_spread_passes_on_what_a_gaussian_blur_does(spread_um):
    """Between strips, which have no corners inside the row, the blur in closed form holds for itself."""
    mixed = Diffusion(spread_um=spread_um).compile(grid(n_x=3, n_y=1, pitch_um=2.0)).apply([0.0, 1.0, 0.0])
    np.testing.assert_allclose(mixed, blurred(np.arange(-1, 2), spread_um, 2.0), rtol=1e-9)


@pytest.mark.parametrize("spread_um", [0.05, 0.24, 0.26, 0.5, 1.0, 2.0, 6.0])
def test_a_point_spreads_to_the_variance_of_blurred_charge(spread_um):
    """Electrons from everywhere in the middle site, blurred and counted by sites, have the variance of the operator."""
    pitch_um, n, middle = 2.0, 121, 60
    charge_e = np.zeros((n, n))
    charge_e[middle, middle] = 1.0
    operator = Diffusion(spread_um=spread_um).compile(grid(n_x=n, n_y=n, pitch_um=pitch_um))
    picture = operator.apply(charge_e.ravel()).reshape(n, n)
    offset = np.arange(n) - middle
    along_x = np.sum(picture * offset**2)
    along_y = np.sum(picture * offset[:, np.newaxis] ** 2)

    expected = np.sum(offset**2 * blurred(offset, spread_um, pitch_um))
    assert math.isclose(along_x, expected, rel_tol=1e-9)
    assert math.isclose(along_y, along_x, rel_tol=1e-12)


def test_the_variance_of_a_point_is_two_d_t_and_a_sixth_of_a_cell():
    """Electrons in silicon, 36 cm²/s, for a nanosecond."""
    n, middle = 81, 40
    charge_e = np.zeros((n, n))
    charge_e[middle, middle] = 1.0
    variance_um2 = 2.0 * 36e8 * 1e-9
    operator = Diffusion(spread_um=math.sqrt(variance_um2)).compile(grid(n_x=n, n_y=n, pitch_um=1.0))
    offset_um = np.arange(n) - middle
    measured_um2 = np.sum(operator.apply(charge_e.ravel()).reshape(n, n) * offset_um**2)

    assert operator.n_steps > 1
    assert math.isclose(measured_um2, variance_um2 + 1.0 / 6.0, rel_tol=1e-9)


@pytest.mark.parametrize("name", ["hexagons", "voronoi"])
def test_short_spreads_carry_scattered_electrons_over_every_edge(name):
    """
    Electrons from everywhere in a site, moved at random and counted where they end.

    Corners take up to ``spread / edge`` of what crosses: the two spreads that are compared tell the linear part alone.
    """
    layout = LAYOUTS[name]
    site = int(np.argmin(np.hypot(*(layout.centroid_um - layout.centroid_um.mean(axis=0)).T)))
    polygon = layout.polygons()[site]
    shapely.prepare(polygon)
    rng = np.random.default_rng(12)
    x0, y0, x1, y1 = polygon.bounds
    points = rng.uniform((x0, y0), (x1, y1), (3_000_000, 2))
    points = points[shapely.contains_xy(polygon, *points.T)]
    way = rng.standard_normal(points.shape)

    def left(spread_um):
        return np.mean(~shapely.contains_xy(polygon, *(points + spread_um * way).T))

    def passed(spread_um):
        charge_e = np.zeros(layout.n_sites)
        charge_e[site] = 1.0
        return 1.0 - Diffusion(spread_um=spread_um).compile(layout).apply(charge_e)[site]

    # share(s) = a s - b s²: 2 share(s) - share(2 s) / 2 = a s, and the straight law has no b.
    s_um = 0.03
    error = SIGMAS * math.sqrt((4.0 * passed(s_um) + 0.25 * passed(2 * s_um)) / points.shape[0])
    assert abs(2.0 * left(s_um) - 0.5 * left(2 * s_um) - passed(s_um)) < error
    assert error < 0.1 * passed(s_um)


def test_the_law_has_no_step_between_short_and_long_spreads():
    spread_um = 0.125 * (1.0 + np.array([-1e-9, 1e-9]))
    below, above = (shares(Diffusion(spread_um=s).compile(LAYOUTS["grid"].scale(1 / 3)))[0, 1] for s in spread_um)
    assert math.isclose(below, above, rel_tol=1e-8)


def test_long_exchanges_between_two_sites_have_their_closed_form():
    """Each of n exchanges takes the difference down by the factor ``1 - 2 a / n``."""
    operator = Diffusion(spread_um=2.0).compile(grid(n_x=2, n_y=1, pitch_um=1.0))
    a = 0.5 * (2.0**2 + 1.0 / 6.0)
    n = operator.n_steps

    assert n == math.ceil(2.0 * a)
    left = 0.5 * (1.0 + (1.0 - 2.0 * a / n) ** n)
    np.testing.assert_allclose(operator.apply([1.0, 0.0]), [left, 1.0 - left], rtol=1e-12)


@pytest.mark.parametrize("spread_um", [0.05, 3.0])
def test_a_site_in_the_middle_of_its_frame_exchanges_over_its_whole_outline(spread_um):
    frame, middle = shapely.box(0, 0, 9, 9), shapely.box(3, 3, 6, 6)
    operator = Diffusion(spread_um=spread_um).compile(fs.Layout.from_polygons([frame.difference(middle), middle]))

    assert operator.n_steps < 10
    if spread_um < 1.0:
        assert math.isclose(shares(operator)[0, 1], 12.0 * spread_um / ROOT_2_PI / 9.0, rel_tol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.2, 0.5])
def test_a_measured_share_is_what_a_square_pixel_loses(share):
    diffusion = Diffusion.from_neighbour_fraction(share, pitch_um=3.0)
    operator = diffusion.compile(LAYOUTS["grid"])
    charge_e = np.zeros(35)
    charge_e[17] = 1.0

    assert operator.n_steps == 1
    assert math.isclose(operator.apply(charge_e)[17], 1.0 - share, rel_tol=1e-9)
    assert math.isclose(operator.apply(charge_e)[18], share / 4, rel_tol=1e-9, abs_tol=1e-15)


def test_smaller_pixels_of_a_process_lose_more():
    diffusion = Diffusion.from_neighbour_fraction(0.05, pitch_um=6.0)
    middle = shares(diffusion.compile(grid(n_x=3, n_y=3, pitch_um=3.0)))[4, 4]
    assert math.isclose(middle, 1.0 - 0.10, rel_tol=1e-9)


def test_sites_behind_trenches_exchange_when_asked():
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
def test_the_order_of_sites_does_not_matter(crosstalk):
    layout = LAYOUTS["grid"]
    order = np.random.default_rng(4).permutation(layout.n_sites)
    charge_e = light(layout)

    shuffled = crosstalk.compile(layout[order]).apply(charge_e[order])
    np.testing.assert_allclose(shuffled, crosstalk.compile(layout).apply(charge_e)[order], rtol=1e-12)


def test_frames_are_mixed_one_by_one_and_are_not_changed():
    frames_e = np.stack([light(HEXAGONS, seed) for seed in range(6)]).reshape(2, 3, -1)
    before = frames_e.copy()
    operator = Diffusion(spread_um=2.0).compile(HEXAGONS)
    mixed = operator.apply(frames_e)

    assert operator.n_steps > 1
    assert mixed.shape == frames_e.shape
    assert np.array_equal(frames_e, before)
    np.testing.assert_allclose(mixed[1, 2], operator.apply(frames_e[1, 2]), rtol=1e-14)


def test_known_edges_give_the_same_mixing():
    shared_um = HEXAGONS.adjacency()
    before = shared_um.copy()
    for crosstalk in (Diffusion(spread_um=0.5), InterPixelCapacitance(neighbour_fraction=0.02)):
        known = crosstalk.compile(HEXAGONS, shared_um=shared_um)
        assert (known.matrix != crosstalk.compile(HEXAGONS).matrix).nnz == 0
    assert (shared_um != before).nnz == 0


# -- kernels ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kernel", [KERNEL, np.full((3, 3), 1 / 9), WIDE, KERNEL[:, ::-1]], ids=["all", "box", "5x3", "turned"]
)
@pytest.mark.parametrize("n_x", [1, 2, 9])
def test_a_kernel_that_loses_is_the_convolution_of_scipy(kernel, n_x):
    layout = grid(n_x=n_x, n_y=6, pitch_um=2.2)
    picture = light(layout).reshape(6, n_x)
    expected = scipy.ndimage.convolve(picture, kernel, mode="constant")

    mixed = KernelCrosstalk(kernel=kernel, border="lost").compile(layout).apply(picture.ravel())
    np.testing.assert_allclose(mixed.reshape(6, n_x), expected, rtol=1e-14)


def test_a_cross_that_keeps_is_the_reflected_convolution_of_scipy():
    kernel = np.array([[0.0, 0.04, 0.0], [0.03, 0.86, 0.02], [0.0, 0.05, 0.0]])
    symmetric = 0.5 * (kernel + kernel[::-1, ::-1])
    picture = light(grid(n_x=9, n_y=6, pitch_um=1.0)).reshape(6, 9)
    expected = scipy.ndimage.convolve(picture, symmetric, mode="reflect")

    mixed = KernelCrosstalk(kernel=symmetric).compile(grid(n_x=9, n_y=6, pitch_um=1.0)).apply(picture.ravel())
    np.testing.assert_allclose(mixed.reshape(6, 9), expected, rtol=1e-14)


def test_inside_both_borders_agree():
    layout = grid(n_x=9, n_y=6, pitch_um=1.0)
    kept, lost = (
        KernelCrosstalk(kernel=KERNEL, border=border).compile(layout).apply(light(layout))
        for border in ("kept", "lost")
    )
    assert np.array_equal(kept.reshape(6, 9)[1:-1, 1:-1], lost.reshape(6, 9)[1:-1, 1:-1])
    assert (kept >= lost).all()


def test_a_kernel_is_a_picture_of_a_point_with_its_lowest_row_first():
    layout = grid(n_x=3, n_y=3, pitch_um=2.0)
    charge_e = np.zeros(9)
    charge_e[4] = 1.0
    mixed = KernelCrosstalk(kernel=KERNEL).compile(layout).apply(charge_e)

    for j, y_um in enumerate((-2.0, 0.0, 2.0)):
        for i, x_um in enumerate((-2.0, 0.0, 2.0)):
            at = np.flatnonzero(np.all(np.abs(layout.centroid_um - [x_um, y_um]) < 1e-9, axis=1))
            assert mixed[at] == KERNEL[j, i]


@pytest.mark.parametrize("border", ["kept", "lost"])
def test_a_crop_with_holes_is_the_convolution_of_a_picture_with_dark_holes(border):
    whole = grid(n_x=20, n_y=15, pitch_um=1.4)
    is_there = np.random.default_rng(2).random(whole.n_sites) < 0.6
    order = np.random.default_rng(3).permutation(np.flatnonzero(is_there))
    layout = whole[order].translate(1234.5, -77.7)
    picture = np.where(is_there, light(whole), 0.0)
    expected = scipy.ndimage.convolve(picture.reshape(15, 20), KERNEL, mode="constant").ravel()
    if border == "kept":
        arrives = scipy.ndimage.correlate(is_there.reshape(15, 20).astype(float), KERNEL, mode="constant").ravel()
        expected += picture * (KERNEL.sum() - arrives)

    operator = KernelCrosstalk(kernel=KERNEL, border=border).compile(layout)
    np.testing.assert_allclose(operator.apply(picture[order]), expected[order], rtol=1e-12)
    if border == "kept":
        np.testing.assert_allclose(operator.matrix.sum(axis=0), KERNEL.sum(), rtol=1e-14)


def test_missing_columns_are_seen_as_such():
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
    ids=["rectangles", "small in their cells", "long rows", "tall sites"],
)
def test_any_grid_along_the_axes_is_seen(layout):
    """Also when its corners were rounded to a manufacturing grid of 1 nm."""
    rounded = fs.Layout(np.round(layout.xy_um, 3), layout.ring_offsets, layout.site_offsets, layout.columns)
    n_y, n_x = layout.columns["row"].max() + 1, layout.columns["column"].max() + 1
    picture = light(layout).reshape(n_y, n_x)
    mixed = KernelCrosstalk(kernel=KERNEL, border="lost").compile(rounded).apply(picture.ravel())

    expected = scipy.ndimage.convolve(picture, KERNEL, mode="constant")
    np.testing.assert_allclose(mixed.reshape(n_y, n_x), expected, rtol=1e-14)


def test_a_pitch_tells_a_grid_from_few_sites():
    layout = grid(n_x=4, n_y=4, pitch_um=2.0)[[0, 5, 15]]
    with pytest.raises(SimulationError, match=r"no two sites are side by side.*set 'pitch_um' if sites are missing$"):
        KernelCrosstalk(kernel=KERNEL).compile(layout)

    for pitch_um in (2.0, (2.0, 2.0)):
        mixed = KernelCrosstalk(kernel=KERNEL, pitch_um=pitch_um, border="lost").compile(layout).apply([1.0, 0.0, 0.0])
        assert mixed.tolist() == [KERNEL[1, 1], KERNEL[2, 2], 0.0]


@pytest.mark.parametrize(
    "name", ["hexagons", "rings", "zones", "voronoi", "staggered", "turned", "slightly turned", "doubled"]
)
def test_a_layout_that_is_no_grid_is_told_in_a_sentence(name):
    layout = {
        **LAYOUTS,
        "staggered": grid(n_x=5, n_y=4, pitch_um=2.0, stagger=True, fill_factor=0.3),
        "turned": LAYOUTS["grid"].rotate(20.0),
        "slightly turned": grid(n_x=50, n_y=50, pitch_um=2.0).rotate(2.0),
        "doubled": LAYOUTS["grid"][[0, 1, 2, 1]],
    }[name]
    with pytest.raises(
        SimulationError, match=r"not a grid[^\n]*use Diffusion, which supports sites of any shape[^\n]*$"
    ):
        KernelCrosstalk(kernel=KERNEL).compile(layout)


def test_a_kernel_can_be_compared_and_kept_as_text():
    given = KernelCrosstalk(kernel=KERNEL)
    assert given == KernelCrosstalk(kernel=KERNEL.tolist())
    assert hash(given) == hash(KernelCrosstalk(kernel=KERNEL.copy()))


# -- the draw between ------------------------------------------------------------------------------------------------

N_FRAMES = 40_000
SMALL = fs.layout.hexagonal(n_columns=5, n_rows=4, pitch_um=3.0)


def drawn(expected_e, seed):
    return np.random.default_rng(seed).poisson(expected_e, (N_FRAMES, expected_e.size))


def covariance_is_off(samples, expected):
    """Largest deviation of a sample covariance in its standard errors, for normal samples."""
    variance = np.diag(expected)
    error = np.sqrt((expected**2 + np.outer(variance, variance)) / N_FRAMES)
    return np.abs((np.cov(samples, rowvar=False) - expected) / error).max()


def test_after_diffusion_sites_are_poisson_and_uncorrelated():
    expected_e = Diffusion(spread_um=0.8).compile(SMALL).apply(np.where(np.arange(20) == 7, 9e4, 2e3))
    electrons = drawn(expected_e, seed=21)

    assert expected_e[6] > 3e3
    assert covariance_is_off(electrons, np.diag(expected_e)) < SIGMAS


def test_after_coupling_sites_have_the_predicted_covariance():
    mean_e = np.where(np.arange(20) == 7, 9e4, 2e3).astype(float)
    operator = InterPixelCapacitance(neighbour_fraction=0.03).compile(SMALL)
    read_e = operator.apply(drawn(mean_e, seed=22))
    coupling = shares(operator)
    expected = coupling @ np.diag(mean_e) @ coupling.T

    assert covariance_is_off(read_e, expected) < SIGMAS
    # The draw itself, and the operator of another share, are seen to be wrong by the same measure.
    assert covariance_is_off(read_e, np.diag(mean_e)) > 5.0 * SIGMAS
    np.testing.assert_allclose(operator.variance(mean_e), np.diag(expected), rtol=1e-12)


def test_a_row_of_coupled_sites_has_the_covariance_of_its_closed_form():
    a, variance_e2 = 0.02, 500.0
    coupling = shares(InterPixelCapacitance(neighbour_fraction=a).compile(grid(n_x=9, n_y=1, pitch_um=2.0)))
    covariance = variance_e2 * coupling @ coupling.T

    expected = [variance_e2 * x for x in (1 - 4 * a + 6 * a**2, 2 * a * (1 - 2 * a), a**2, 0.0)]
    np.testing.assert_allclose(covariance[4, 4:8], expected, rtol=1e-12, atol=1e-12)


# -- coupling ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LAYOUTS)
def test_coupling_is_symmetric_and_keeps_the_sum(name):
    layout = LAYOUTS[name]
    operator = InterPixelCapacitance(neighbour_fraction=0.01).compile(layout)
    charge_e = light(layout)

    np.testing.assert_allclose(shares(operator), shares(operator).T, atol=1e-15)
    np.testing.assert_allclose(operator.matrix.sum(axis=0), 1.0, atol=1e-12)
    assert math.isclose(operator.apply(charge_e).sum(), charge_e.sum(), rel_tol=1e-12)


@pytest.mark.parametrize("name", ["grid", "hexagons"])
def test_every_neighbour_on_a_regular_tiling_shows_the_share(name):
    coupling = shares(InterPixelCapacitance(neighbour_fraction=0.01).compile(LAYOUTS[name]))
    neighbours = coupling[coupling < 0.5]
    np.testing.assert_allclose(neighbours[neighbours > 0.0], 0.01, rtol=1e-9)


def test_a_share_is_that_of_a_given_edge():
    coupling = shares(InterPixelCapacitance(neighbour_fraction=0.01, edge_um=6.0).compile(LAYOUTS["grid"]))
    assert math.isclose(coupling[0, 1], 0.005, rel_tol=1e-9)


@pytest.mark.parametrize("name", ["hexagons", "zones", "voronoi"])
@pytest.mark.parametrize("is_equal", [True, False])
def test_weak_coupling_is_what_a_network_of_capacitors_does(name, is_equal):
    """The network is solved whole; the difference is of the second order in the coupling."""
    layout = LAYOUTS[name]
    node_f = np.random.default_rng(6).uniform(1.0, 1.0 if is_equal else 4.0, layout.n_sites) * 1e-15
    charge_e = light(layout)
    edge_um = layout.adjacency().toarray()
    typical_um, typical_f = np.median(edge_um[edge_um > 0]), np.median(node_f)

    def deviation_e(share):
        between_f = share * typical_f / typical_um * edge_um
        network_f = np.diag(node_f + between_f.sum(axis=1)) - between_f
        seen_e = node_f * np.linalg.solve(network_f, charge_e)
        mixed_e = InterPixelCapacitance(neighbour_fraction=share).compile(layout, capacitance_f=node_f).apply(charge_e)
        assert math.isclose(mixed_e.sum(), charge_e.sum(), rel_tol=1e-12)
        return np.abs(mixed_e - seen_e).max()

    assert 3.6 < deviation_e(2e-4) / deviation_e(1e-4) < 4.4


def test_nodes_of_equal_voltage_do_not_mix():
    node_f = np.random.default_rng(6).uniform(1.0, 4.0, HEXAGONS.n_sites) * 1e-15
    even_e = 1e18 * node_f
    mixed_e = InterPixelCapacitance(neighbour_fraction=0.01).compile(HEXAGONS, capacitance_f=node_f).apply(even_e)
    np.testing.assert_allclose(mixed_e, even_e, rtol=1e-12)


def test_one_capacitance_for_all_changes_nothing():
    coupling = InterPixelCapacitance(neighbour_fraction=0.01)
    assert (coupling.compile(HEXAGONS, capacitance_f=1e-13).matrix != coupling.compile(HEXAGONS).matrix).nnz == 0


# -- bad input --------------------------------------------------------------------------------------------------------

BAD = [-0.1, math.nan, math.inf, "much", None]


@pytest.mark.parametrize("value", [*BAD, 1e9])
def test_a_spread_that_cannot_be_is_refused(value):
    with pytest.raises(ParameterError, match=r"^'spread_um' must be[^\n]*$"):
        Diffusion(spread_um=value)


@pytest.mark.parametrize("value", [*BAD, 0.51, 1.5])
def test_a_share_that_cannot_be_is_refused(value):
    with pytest.raises(ParameterError, match=r"^'neighbour_fraction' must be[^\n]*$"):
        InterPixelCapacitance(neighbour_fraction=value)
    with pytest.raises(ParameterError, match=r"^'neighbour_fraction' must be[^\n]*$"):
        Diffusion.from_neighbour_fraction(value, pitch_um=2.0)


@pytest.mark.parametrize("value", BAD[:-1])
def test_a_gap_or_an_edge_that_cannot_be_is_refused(value):
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
        (None, "must have 2 dimensions"),
        (1.0, "must have 2 dimensions"),
    ],
)
def test_a_kernel_that_cannot_be_is_refused(kernel, rule):
    with pytest.raises(ParameterError, match=rf"^'kernel' {rule}[^\n]*$"):
        KernelCrosstalk(kernel=kernel)


def test_a_border_rule_that_is_none_is_refused():
    with pytest.raises(ParameterError, match="'border' must be one of 'kept', 'lost', got 'wrap'"):
        KernelCrosstalk(kernel=KERNEL, border="wrap")


@pytest.mark.parametrize(
    "crosstalk",
    [Diffusion(spread_um=1.0), InterPixelCapacitance(neighbour_fraction=0.01), KernelCrosstalk(kernel=KERNEL)],
)
def test_what_is_no_layout_is_refused(crosstalk):
    with pytest.raises(ParameterError, match="'layout' must be a Layout, got a list"):
        crosstalk.compile([1, 2, 3])


@pytest.mark.parametrize("crosstalk", [Diffusion(spread_um=1.0), InterPixelCapacitance(neighbour_fraction=0.01)])
def test_sites_that_all_stand_alone_are_told_with_the_cure(crosstalk):
    with pytest.raises(
        SimulationError, match=r"no two sites of the layout share an edge.*set 'max_gap_um' to the trench width$"
    ):
        crosstalk.compile(grid(n_x=3, n_y=3, pitch_um=2.0, trench_um=0.2))


def test_a_spread_beyond_all_reason_names_the_site():
    layout = fs.Layout.from_polygons(
        [shapely.box(0, 0, 5, 5), shapely.box(5, 0, 5.001, 5), shapely.box(5.001, 0, 9, 5)]
    )
    with pytest.raises(
        ParameterError, match=r"'spread_um' must be shorter for site 1 with an area of only 0.005 µm², got 20.0 µm; the"
    ):
        Diffusion(spread_um=20.0).compile(layout)


def test_coupling_that_is_not_weak_names_the_site():
    with pytest.raises(
        ParameterError, match=r"'neighbour_fraction' must be smaller: site 8 would couple 0.8 of its charge"
    ):
        InterPixelCapacitance(neighbour_fraction=0.2).compile(LAYOUTS["grid"])


@pytest.mark.parametrize("charge_e", [np.ones(5), 3.0, np.ones((72, 2)), "all"])
def test_charges_of_other_sites_are_refused(charge_e):
    operator = InterPixelCapacitance(neighbour_fraction=0.01).compile(HEXAGONS)
    for call, name in ((operator.apply, "charge_e"), (operator.variance, "variance")):
        with pytest.raises(ParameterError, match=f"^'{name}' must"):
            call(charge_e)


def test_variances_do_not_pass_many_exchanges():
    with pytest.raises(SimulationError, match="variances are defined for operators of one step, and this operator has"):
        Diffusion(spread_um=9.0).compile(HEXAGONS).variance(np.ones(72))


def test_edges_and_capacitances_of_other_layouts_are_refused():
    with pytest.raises(ParameterError, match=r"'shared_um' must be a sparse array of shape \(72, 72\)"):
        Diffusion(spread_um=1.0).compile(HEXAGONS, shared_um=SMALL.adjacency())
    with pytest.raises(ParameterError, match="'capacitance_f' must be one number, or one for each of the 72 sites"):
        InterPixelCapacitance(neighbour_fraction=0.01).compile(HEXAGONS, capacitance_f=np.ones(3))
    with pytest.raises(ParameterError, match=r"'capacitance_f' must be > 0.0 everywhere"):
        InterPixelCapacitance(neighbour_fraction=0.01).compile(HEXAGONS, capacitance_f=np.zeros(72))

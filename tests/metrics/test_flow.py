"""Optical flow on polygons: gradients are derivatives, the bound is what a best estimator scatters by, and shifts are found."""

from __future__ import annotations

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import CoverageWarning, ParameterError
from foveasim.metrics import estimate_flow, flow_bound, site_gradients_e_per_um

GRID = fs.Grid.centred((160, 160), 0.5)
FOVEAL = fs.layout.log_polar(
    n_sectors=32, min_size_um=2.0, r_max_um=32.0, stagger=True, chords_per_arc=2, fovea="hexagons"
)
READ_E2 = 9.0


def picture(u=0.0, v=0.0, level=60.0, grid=GRID):
    """Exact cell means of some waves that moved by (u, v), e-/µm²; at least 25 anywhere at the given level."""
    rng = np.random.default_rng(5)
    x, y = np.meshgrid(grid.x_um - u, grid.y_um - v)
    values = np.full(grid.shape, level)
    for _ in range(12):
        wave = rng.normal(size=2)
        wave *= rng.uniform(0.02, 0.12) / np.hypot(*wave)
        inside = np.prod(np.sinc(0.5 * wave))
        values += 4.0 * inside * np.cos(2.0 * np.pi * (wave[0] * x + wave[1] * y) + rng.uniform(0.0, 6.0))
    return values


EXPECT = fs.Integrator(FOVEAL, GRID, order=2)


def test_gradients_are_what_sites_lose_when_the_picture_moves():
    d = 1e-3
    gradient = site_gradients_e_per_um(FOVEAL, picture(), GRID)
    by_x = (EXPECT(picture(-d)) - EXPECT(picture(d))) / (2 * d)
    by_y = (EXPECT(picture(0.0, -d)) - EXPECT(picture(0.0, d))) / (2 * d)

    assert np.abs(gradient - np.stack((by_x, by_y), axis=1)).max() < 3e-4 * np.abs(gradient).max()


def test_a_ramp_gives_each_site_its_area_up_to_the_border():
    x, y = np.meshgrid(GRID.x_um, GRID.y_um)
    layout = fs.layout.grid(n_x=20, n_y=20, pitch_um=4.0)

    gradient = site_gradients_e_per_um(layout, 500.0 + 2.0 * x - 3.0 * y, GRID)

    assert gradient[:, 0] == pytest.approx(2.0 * layout.area_um2)
    assert gradient[:, 1] == pytest.approx(-3.0 * layout.area_um2)


def test_a_shift_without_noise_is_found():
    for u, v in ((0.8, -0.5), (-2.0, 1.7)):
        values = EXPECT(picture(u, v))
        found = estimate_flow(FOVEAL, values, picture(), GRID, variance_e2=values + READ_E2)

        assert found.flow_um[0] == pytest.approx([u, v], abs=1e-4)
        assert found.misfit[0] < 1e-4


def test_one_step_is_lucas_and_kanade():
    values, map_e = EXPECT(picture(0.05, -0.03)), picture()
    gradient, before = site_gradients_e_per_um(FOVEAL, map_e, GRID), EXPECT(picture())
    root = np.sqrt(before + READ_E2)
    slow = np.linalg.lstsq(-gradient / root[:, None], (values - before) / root, rcond=None)[0]

    found = estimate_flow(FOVEAL, values, map_e, GRID, variance_e2=before + READ_E2, n_steps=1)

    assert found.flow_um[0] == pytest.approx(slow, rel=1e-9)
    assert found.flow_um[0] == pytest.approx([0.05, -0.03], rel=0.02)


@pytest.mark.parametrize("noise", ["Gaussian", "Poisson"])
def test_the_best_estimate_scatters_by_the_bound(noise):
    n_runs, shift = 400, np.array([0.3, -0.2])
    rng = np.random.default_rng(11)
    mean = EXPECT(picture(*shift, level=90.0))
    variance = mean + (READ_E2 if noise == "Gaussian" else 0.0)
    draws = mean + rng.normal(size=(n_runs, mean.size)) * np.sqrt(variance)
    if noise == "Poisson":
        draws = rng.poisson(mean, (n_runs, mean.size)).astype(float)
    before = picture(level=90.0)
    found = np.array(
        [estimate_flow(FOVEAL, d, before, GRID, variance_e2=variance, n_steps=3, n_threads=1).flow_um[0] for d in draws]
    )
    gradient = site_gradients_e_per_um(FOVEAL, picture(*shift, level=90.0), GRID)
    bound = flow_bound(gradient, variance).covariance_um2[0]
    # What scatters, made white by the bound: unit variances and no correlation, each known to sqrt(2 / n) and sqrt(1 / n).
    white = np.linalg.solve(np.linalg.cholesky(bound), np.moveaxis(found - shift, 0, 1))
    covariance = np.cov(white)

    assert np.abs(white.mean(axis=1)).max() < 4.0 / np.sqrt(n_runs)
    assert np.diag(covariance) == pytest.approx([1.0, 1.0], abs=4.0 * np.sqrt(2.0 / n_runs))
    assert abs(covariance[0, 1]) < 4.0 / np.sqrt(n_runs)


def test_the_bound_is_the_inverse_of_the_information_and_information_adds_up():
    rng = np.random.default_rng(0)
    gradient, variance = rng.normal(size=(60, 2)), rng.uniform(1.0, 5.0, 60)
    regions = np.repeat([7, 2, -1], 20)
    apart, together = flow_bound(gradient, variance, regions=regions), flow_bound(gradient[:40], variance[:40])
    slow = np.linalg.inv(sum(np.outer(g, g) / s for g, s in zip(gradient[20:40], variance[20:40], strict=True)))

    assert apart.regions.tolist() == [2, 7]
    assert apart.n_sites.tolist() == [20, 20]
    assert apart.covariance_um2[0] == pytest.approx(slow)
    assert apart.sigma_um[0] == pytest.approx(np.sqrt(np.diag(slow)))
    assert apart.information_per_um2.sum(axis=0) == pytest.approx(together.information_per_um2[0])
    assert flow_bound(gradient, 4.0 * variance).sigma_um == pytest.approx(2.0 * flow_bound(gradient, variance).sigma_um)


def test_regions_move_by_themselves():
    left = (FOVEAL.centroid_um[:, 0] > 0.0).astype(int)
    values = np.where(left == 0, EXPECT(picture(0.5, 0.2)), EXPECT(picture(-0.4, 0.6)))

    found = estimate_flow(FOVEAL, values, picture(), GRID, variance_e2=values, regions=left)

    assert found.flow_um == pytest.approx(np.array([[0.5, 0.2], [-0.4, 0.6]]), abs=1e-4)
    assert found.bound.n_sites.sum() == FOVEAL.n_sites


#: 24 x 24 squares of 4 µm, of which the map has 19 x 19 wholly, others partly, and others not at all.
WIDE = fs.layout.grid(n_x=24, n_y=24, pitch_um=4.0).translate(1.3, 0.7)
IS_WHOLE = (np.abs(WIDE.centroid_um) <= 38.0).all(axis=1)
IS_AWAY = (np.abs(WIDE.centroid_um) >= 42.0).any(axis=1)


def test_sites_off_the_map_bias_nothing():
    around = fs.Grid.centred((240, 240), 0.5)
    values = fs.Integrator(WIDE, around, order=2)(picture(0.7, -0.4, grid=around))
    left = (WIDE.centroid_um[:, 0] > 0.0).astype(int)

    found = estimate_flow(WIDE, values, picture(), GRID, variance_e2=values, regions=left)

    assert np.any(~IS_WHOLE & ~IS_AWAY)
    assert found.flow_um == pytest.approx(np.array([[0.7, -0.4], [0.7, -0.4]]), abs=1e-3)
    # By where they are when carried back by the shift.
    lost = (np.abs(WIDE.centroid_um - [0.7, -0.4]) > 38.0).any(axis=1)
    assert found.bound.n_sites.tolist() == [np.sum(~lost & (left == k)) for k in (0, 1)]
    assert np.all(found.misfit < 1e-4)


def test_the_misfit_counts_the_sites_on_the_map():
    around = fs.Grid.centred((240, 240), 0.5)
    mean = fs.Integrator(WIDE, around, order=2)(picture(0.3, 0.2, grid=around))
    values = mean + np.random.default_rng(3).normal(size=mean.size) * np.sqrt(mean)

    found = estimate_flow(WIDE, values, picture(), GRID, variance_e2=mean)

    # A mean of squares of n normal numbers, two of which the flow has taken.
    n_on = found.bound.n_sites[0]
    assert n_on == 19 * 19
    assert found.misfit[0] == pytest.approx(1.0 - 2.0 / n_on, abs=4.0 * np.sqrt(2.0 / n_on))


def test_a_region_off_the_map_is_not_known():
    labels = IS_AWAY.astype(int)
    values = np.full(WIDE.n_sites, 900.0)

    found = estimate_flow(WIDE, values, picture(), GRID, variance_e2=values, regions=labels)

    assert found.bound.n_sites[1] == 0
    assert np.isnan(found.flow_um[1]).all()
    assert np.isnan(found.misfit[1])
    assert np.isinf(found.bound.sigma_um[1]).all()


def test_gradients_of_sites_off_the_map_are_nothing_and_it_is_told():
    with pytest.warns(CoverageWarning, match=f"{np.sum(~IS_WHOLE)} of 576 photosites lie partly or wholly off the map"):
        gradient = site_gradients_e_per_um(WIDE, picture(), GRID)

    assert np.all(gradient[~IS_WHOLE] == 0.0)
    assert np.array_equal(gradient[IS_WHOLE], site_gradients_e_per_um(WIDE[IS_WHOLE], picture(), GRID))


def test_along_an_edge_nothing_is_known():
    x, y = np.meshgrid(GRID.x_um, GRID.y_um)
    upright, slanted = 50.0 + 20.0 * np.tanh(x / 4.0), 50.0 + 20.0 * np.tanh((x + y) / 4.0)
    straight, oblique = (
        flow_bound(site_gradients_e_per_um(fs.layout.grid(n_x=12, n_y=12, pitch_um=3.0), m, GRID), 100.0)
        for m in (upright, slanted)
    )

    assert np.isfinite(straight.sigma_um[0, 0])
    assert straight.sigma_um[0, 1] > 1e6 * straight.sigma_um[0, 0]
    assert np.all(oblique.sigma_um[0] > 1e5 * straight.sigma_um[0, 0])
    flat = estimate_flow(FOVEAL, EXPECT(np.ones(GRID.shape)), np.ones(GRID.shape), GRID, variance_e2=1.0)
    assert np.isnan(flat.flow_um).all()
    assert np.isinf(flat.bound.sigma_um).all()


def test_bad_input_is_told():
    map_e, values = picture(), np.ones(FOVEAL.n_sites)
    with pytest.raises(ParameterError, match="'variance_e2' must be > 0"):
        flow_bound(np.ones((3, 2)), 0.0)
    with pytest.raises(ParameterError, match=r"'gradient_e_per_um' must have the shape \(n_site, 2\)"):
        flow_bound(np.ones((3, 3)), 1.0)
    with pytest.raises(ParameterError, match="'regions' must be 3 integers"):
        flow_bound(np.ones((3, 2)), 1.0, regions=[0.5, 1.0, 2.0])
    with pytest.raises(ParameterError, match=r"'layout' must be a foveasim\.Layout, got a NoneType"):
        estimate_flow(None, values, map_e, GRID, variance_e2=1.0)
    with pytest.raises(ParameterError, match=r"'layout' must be a foveasim\.Layout, got a list"):
        site_gradients_e_per_um([FOVEAL], map_e, GRID)
    with pytest.raises(ParameterError, match="'values_e' must be one for each of the"):
        estimate_flow(FOVEAL, values[:5], map_e, GRID, variance_e2=1.0)
    with pytest.raises(ParameterError, match="'map_e_per_um2' must have the grid's shape"):
        estimate_flow(FOVEAL, values, map_e[:50], GRID, variance_e2=1.0)

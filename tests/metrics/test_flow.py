"""Optical flow on polygons: gradients, Cramér–Rao bound, and estimated displacements."""

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
    """Exact cell means of a sum of waves displaced by (u, v), e-/µm²; at least 25 at the default level."""
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


def test_site_gradients_match_finite_differences():
    d = 1e-3
    gradient = site_gradients_e_per_um(FOVEAL, picture(), GRID)
    by_x = (EXPECT(picture(-d)) - EXPECT(picture(d))) / (2 * d)
    by_y = (EXPECT(picture(0.0, -d)) - EXPECT(picture(0.0, d))) / (2 * d)

    assert np.abs(gradient - np.stack((by_x, by_y), axis=1)).max() < 3e-4 * np.abs(gradient).max()


def test_ramp_gradient_equals_slope_times_area():
    x, y = np.meshgrid(GRID.x_um, GRID.y_um)
    layout = fs.layout.grid(n_x=20, n_y=20, pitch_um=4.0)

    gradient = site_gradients_e_per_um(layout, 500.0 + 2.0 * x - 3.0 * y, GRID)

    assert gradient[:, 0] == pytest.approx(2.0 * layout.area_um2)
    assert gradient[:, 1] == pytest.approx(-3.0 * layout.area_um2)


def test_noise_free_flow_is_recovered():
    for u, v in ((0.8, -0.5), (-2.0, 1.7)):
        values = EXPECT(picture(u, v))
        found = estimate_flow(FOVEAL, values, picture(), GRID, variance_e2=values + READ_E2)

        assert found.flow_um[0] == pytest.approx([u, v], abs=1e-4)
        assert found.misfit[0] < 1e-4


def test_single_step_matches_lucas_kanade():
    values, map_e = EXPECT(picture(0.05, -0.03)), picture()
    gradient, before = site_gradients_e_per_um(FOVEAL, map_e, GRID), EXPECT(picture())
    root = np.sqrt(before + READ_E2)
    expected = np.linalg.lstsq(-gradient / root[:, None], (values - before) / root, rcond=None)[0]

    found = estimate_flow(FOVEAL, values, map_e, GRID, variance_e2=before + READ_E2, n_steps=1)

    assert found.flow_um[0] == pytest.approx(expected, rel=1e-9)
    assert found.flow_um[0] == pytest.approx([0.05, -0.03], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["Gaussian", "Poisson"])
def test_flow_covariance_attains_cramer_rao_bound(noise):
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
    # Errors whitened by the bound: unit variances, no correlation, with standard errors sqrt(2 / n) and sqrt(1 / n).
    white = np.linalg.solve(np.linalg.cholesky(bound), np.moveaxis(found - shift, 0, 1))
    covariance = np.cov(white)

    assert np.abs(white.mean(axis=1)).max() < 4.0 / np.sqrt(n_runs)
    assert np.diag(covariance) == pytest.approx([1.0, 1.0], abs=4.0 * np.sqrt(2.0 / n_runs))
    assert abs(covariance[0, 1]) < 4.0 / np.sqrt(n_runs)


def test_flow_bound_inverts_fisher_information():
    rng = np.random.default_rng(0)
    gradient, variance = rng.normal(size=(60, 2)), rng.uniform(1.0, 5.0, 60)
    regions = np.repeat([7, 2, -1], 20)
    apart, together = flow_bound(gradient, variance, regions=regions), flow_bound(gradient[:40], variance[:40])
    expected = np.linalg.inv(sum(np.outer(g, g) / s for g, s in zip(gradient[20:40], variance[20:40], strict=True)))

    assert apart.regions.tolist() == [2, 7]
    assert apart.n_sites.tolist() == [20, 20]
    assert apart.covariance_um2[0] == pytest.approx(expected)
    assert apart.sigma_um[0] == pytest.approx(np.sqrt(np.diag(expected)))
    assert apart.information_per_um2.sum(axis=0) == pytest.approx(together.information_per_um2[0])
    assert flow_bound(gradient, 4.0 * variance).sigma_um == pytest.approx(2.0 * flow_bound(gradient, variance).sigma_um)


def test_regions_have_independent_flow():
    left = (FOVEAL.centroid_um[:, 0] > 0.0).astype(int)
    values = np.where(left == 0, EXPECT(picture(0.5, 0.2)), EXPECT(picture(-0.4, 0.6)))

    found = estimate_flow(FOVEAL, values, picture(), GRID, variance_e2=values, regions=left)

    assert found.flow_um == pytest.approx(np.array([[0.5, 0.2], [-0.4, 0.6]]), abs=1e-4)
    assert found.bound.n_sites.sum() == FOVEAL.n_sites


#: 24 x 24 squares of 4 µm, of which the map covers 19 x 19 completely, others partly, and others not at all.
WIDE = fs.layout.grid(n_x=24, n_y=24, pitch_um=4.0).translate(1.3, 0.7)
IS_COVERED = (np.abs(WIDE.centroid_um) <= 38.0).all(axis=1)
IS_OUTSIDE = (np.abs(WIDE.centroid_um) >= 42.0).any(axis=1)


def test_uncovered_sites_do_not_bias_flow():
    around = fs.Grid.centred((240, 240), 0.5)
    values = fs.Integrator(WIDE, around, order=2)(picture(0.7, -0.4, grid=around))
    left = (WIDE.centroid_um[:, 0] > 0.0).astype(int)

    found = estimate_flow(WIDE, values, picture(), GRID, variance_e2=values, regions=left)

    assert np.any(~IS_COVERED & ~IS_OUTSIDE)
    assert found.flow_um == pytest.approx(np.array([[0.7, -0.4], [0.7, -0.4]]), abs=1e-3)
    # Coverage is determined after the displacement of the outlines.
    uncovered = (np.abs(WIDE.centroid_um - [0.7, -0.4]) > 38.0).any(axis=1)
    assert found.bound.n_sites.tolist() == [np.sum(~uncovered & (left == k)) for k in (0, 1)]
    assert np.all(found.misfit < 1e-4)


def test_misfit_uses_covered_sites_only():
    around = fs.Grid.centred((240, 240), 0.5)
    mean = fs.Integrator(WIDE, around, order=2)(picture(0.3, 0.2, grid=around))
    values = mean + np.random.default_rng(3).normal(size=mean.size) * np.sqrt(mean)

    found = estimate_flow(WIDE, values, picture(), GRID, variance_e2=mean)

    # Chi-squared distribution: n normal residuals less two degrees of freedom of the flow.
    n_on = found.bound.n_sites[0]
    assert n_on == 19 * 19
    assert found.misfit[0] == pytest.approx(1.0 - 2.0 / n_on, abs=4.0 * np.sqrt(2.0 / n_on))


def test_flow_of_uncovered_region_is_nan():
    labels = IS_OUTSIDE.astype(int)
    values = np.full(WIDE.n_sites, 900.0)

    found = estimate_flow(WIDE, values, picture(), GRID, variance_e2=values, regions=labels)

    assert found.bound.n_sites[1] == 0
    assert np.isnan(found.flow_um[1]).all()
    assert np.isnan(found.misfit[1])
    assert np.isinf(found.bound.sigma_um[1]).all()


def test_uncovered_sites_have_zero_gradient():
    with pytest.warns(
        CoverageWarning, match=f"{np.sum(~IS_COVERED)} of 576 photosites lie partly or entirely off the map"
    ):
        gradient = site_gradients_e_per_um(WIDE, picture(), GRID)

    assert np.all(gradient[~IS_COVERED] == 0.0)
    assert np.array_equal(gradient[IS_COVERED], site_gradients_e_per_um(WIDE[IS_COVERED], picture(), GRID))


def test_flow_along_edge_is_unobservable():
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


def test_invalid_flow_arguments_raise():
    map_e, values = picture(), np.ones(FOVEAL.n_sites)
    with pytest.raises(ParameterError, match="'variance_e2' must be > 0"):
        flow_bound(np.ones((3, 2)), 0.0)
    with pytest.raises(ParameterError, match=r"'gradient_e_per_um' must have shape \(n_site, 2\)"):
        flow_bound(np.ones((3, 3)), 1.0)
    with pytest.raises(ParameterError, match="'regions' must be 3 integers"):
        flow_bound(np.ones((3, 2)), 1.0, regions=[0.5, 1.0, 2.0])
    with pytest.raises(ParameterError, match=r"'layout' must be a Layout, got a NoneType"):
        estimate_flow(None, values, map_e, GRID, variance_e2=1.0)
    with pytest.raises(ParameterError, match=r"'layout' must be a Layout, got a list"):
        site_gradients_e_per_um([FOVEAL], map_e, GRID)
    with pytest.raises(ParameterError, match="'values_e' must be one number, or one for each of the"):
        estimate_flow(FOVEAL, values[:5], map_e, GRID, variance_e2=1.0)
    with pytest.raises(ParameterError, match="'map_e_per_um2' must have the grid's shape"):
        estimate_flow(FOVEAL, values, map_e[:50], GRID, variance_e2=1.0)

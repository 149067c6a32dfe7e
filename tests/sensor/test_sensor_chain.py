"""Effects of the electronic chain: magnitude, order, and independence of other effects."""

from __future__ import annotations

import math
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
import scipy.constants
import shapely

import foveasim as fs
from foveasim.errors import ParameterError, SimulationError
from foveasim.layout import grid
from foveasim.sensor import Sensor, _kernels, noise_budget
from foveasim.sensor.device import Device

N_X, N_Y = 500, 400
N = N_X * N_Y
MANY = grid(n_x=N_X, n_y=N_Y, pitch_um=2.0).with_columns(readout_line=np.tile(np.arange(N_X), N_Y))
SIGMAS = 5.0
#: 16 bits, 1 electron per code, up to 3 V.
FINE = {"bits": 16, "v_sat_v": 3.0, "capacitance_f": 65_536 * scipy.constants.e / 3.0, "shot_noise": "off"}
V_PER_DN = 3.0 / 65_536


def sensor(**parameters):
    return Sensor(MANY, **{**FINE, **parameters})


def expected(photo_e=0.0, exposure_s=1.0, **parameters):
    return np.broadcast_to(sensor(**parameters).expected_electrons(np.full(N, photo_e), exposure_s), N)


def codes(charge_e=30_000, *, seed=0, frame=0, **parameters):
    charge = np.broadcast_to(np.asarray(charge_e, np.int64), N).copy()
    return sensor(**parameters).read(charge, seed=seed, frame=frame).astype(float)


def assert_spread(values, sigma, extra_variance=0.0):
    """Check the standard deviation to five standard errors."""
    variance = sigma**2 + extra_variance
    assert values.var() == pytest.approx(variance, rel=SIGMAS * math.sqrt(2.0 / (values.size - 1)))


# -- random numbers of a device ---------------------------------------------------------------------------------------


def test_device_uniforms_match_philox_reference():
    """numpy's Philox 4x64 increments its counter before the first word."""
    device = Device(seed=7, layout=MANY)
    key = device.key("prnu")
    for second in (0, 1, 2**63):
        ours = _kernels.device_uniforms(*key, np.array([5, 2**63], np.uint64), np.uint64(second))

        for number, first in zip(ours, (5, 2**63), strict=True):
            counter = np.array([first - 1, second, 0, 0], np.uint64)
            word = np.random.Philox(key=[int(k) for k in key], counter=counter).random_raw()
            assert number == ((int(word) >> 12) + 0.5) / 2.0**52


EFFECTS = ("prnu", "dsnu", "hot", "gain_fpn", "pixel_fpn", "rts")


@pytest.mark.parametrize("effect", EFFECTS)
def test_device_is_invariant_to_crop_and_order(effect):
    complete = Device(seed=3, layout=MANY).normals(effect)
    ids = np.random.default_rng(0).permutation(N)[:1000]

    assert np.array_equal(Device(seed=3, layout=MANY[ids]).normals(effect), complete[ids])


def test_site_id_column_replaces_position():
    identified = MANY[:100].with_columns(site_id=np.arange(100) + 7)

    moved = Device(seed=3, layout=identified.translate(5.0, 1.0)).normals("prnu")

    assert np.array_equal(moved, Device(seed=3, layout=identified).normals("prnu"))
    assert not np.any(moved == Device(seed=3, layout=MANY[:100]).normals("prnu"))


def test_non_integer_site_ids_are_rejected():
    layout = MANY[:4].with_columns(site_id=[0.0, 0.5, 1.0, 1.5])

    with pytest.raises(ParameterError, match="'site_id' must be a layout column of integers, got float64"):
        Device(seed=3, layout=layout).normals("prnu")


def concentric_rings():
    """Return a disc and four concentric rings."""
    centre = shapely.Point(3.0, -2.0)
    discs = [centre.buffer(radius_um, quad_segs=16) for radius_um in (2.0, 4.0, 6.0, 8.0, 10.0)]
    return fs.Layout.from_polygons([discs[0], *(outer.difference(inner) for inner, outer in pairwise(discs))])


@pytest.mark.parametrize("effect", EFFECTS)
def test_concentric_sites_have_distinct_devices(effect):
    rings = concentric_rings()
    complete = Device(seed=3, layout=rings).normals(effect)

    assert np.ptp(rings.centroid_um, axis=0).max() < 1e-9
    assert np.unique(complete).size == 5
    for site in range(5):
        assert Device(seed=3, layout=rings[[site]]).normals(effect) == complete[site]
    # The disc contains its centroid, and is therefore identified by it.
    square = fs.Layout.from_rectangles([[3.0, -2.0]], 1.0)
    assert Device(seed=3, layout=square).normals(effect) == complete[0]


def test_crescent_around_site_has_own_device():
    """A bracket, and a square at the bracket's centroid, in its opening; neither has a hole."""
    bracket = shapely.box(0.0, 0.0, 6.0, 6.0).difference(shapely.box(1.0, 1.0, 7.0, 5.0))
    x, y = bracket.centroid.coords[0]
    assert not bracket.contains(bracket.centroid)
    layout = fs.Layout.from_polygons([bracket, shapely.box(x - 0.5, y - 0.5, x + 0.5, y + 0.5)])

    assert np.ptp(layout.centroid_um, axis=0).max() < 1e-9
    assert np.unique(Device(seed=3, layout=layout).normals("prnu")).size == 2


@pytest.mark.parametrize("n_sectors", [3, 4, 5, 8])
def test_arcs_are_identified_by_centroid(n_sectors):
    """Thin arcs do not contain their centroids; squares at these centroids have the same numbers."""
    arcs = fs.layout.log_polar(n_sectors=n_sectors, n_rings=60, r_min_um=5.0, r_max_um=60.0, chords_per_arc=8)
    squares = fs.Layout.from_rectangles(arcs.centroid_um, 0.1)
    contained = shapely.contains_xy(arcs.polygons(), *arcs.centroid_um.T)

    assert not contained.any()
    assert np.array_equal(Device(seed=3, layout=arcs).normals("prnu"), Device(seed=3, layout=squares).normals("prnu"))


def test_arc_around_site_has_own_device():
    arc = fs.layout.log_polar(n_sectors=3, n_rings=60, r_min_um=5.0, r_max_um=60.0, chords_per_arc=8)[[170]]
    x, y = arc.centroid_um[0]
    pair = fs.Layout.from_polygons([arc.polygons()[0], shapely.box(x - 0.5, y - 0.5, x + 0.5, y + 0.5)])

    assert not shapely.intersects(*pair.polygons())
    assert np.unique(Device(seed=3, layout=pair).normals("prnu")).size == 2


def test_ring_device_is_invariant_to_vertex_order():
    rings = concentric_rings()
    reordered = fs.Layout.from_polygons(
        [
            shapely.Polygon(
                np.roll(ring.exterior.coords[:-1], 5, axis=0),
                [np.roll(h.coords[:-1], 3, axis=0) for h in ring.interiors],
            )
            for ring in rings.polygons()
        ]
    )

    assert np.array_equal(
        Device(seed=3, layout=reordered).normals("prnu")[1:], Device(seed=3, layout=rings).normals("prnu")[1:]
    )


def test_equal_polygons_have_equal_patterns():
    duplicates = fs.Layout.from_polygons([concentric_rings().polygons()[2]] * 2)

    assert np.ptp(Device(seed=3, layout=duplicates).normals("prnu")) == 0.0


def test_devices_effects_and_sites_are_independent():
    patterns = [Device(seed=seed, layout=MANY).normals(effect) for seed in (0, 1) for effect in EFFECTS]

    correlation = np.corrcoef(patterns)
    assert np.abs(correlation[~np.eye(len(patterns), dtype=bool)]).max() < SIGMAS / math.sqrt(N)
    picture = patterns[0].reshape(N_Y, N_X)
    for neighbour in (picture[1:] * picture[:-1], picture[:, 1:] * picture[:, :-1]):
        assert abs(neighbour.mean()) < SIGMAS / math.sqrt(neighbour.size)
    assert scipy.stats.kstest(patterns[0], "norm").pvalue > 1e-6


# -- before collection ------------------------------------------------------------------------------------------------


def test_prnu_affects_only_photoelectrons():
    photo_e, dark_e = expected(1000.0, prnu_fraction=0.02), expected(0.0, prnu_fraction=0.02, dark_e_per_s=1000.0)

    assert_spread(photo_e, 20.0)
    assert photo_e.mean() == pytest.approx(1000.0, abs=SIGMAS * 20.0 / math.sqrt(N))
    assert np.ptp(dark_e) == 0.0


def test_dsnu_affects_only_dark_signal():
    dark_e, photo_e = expected(0.0, 2.0, dsnu_fraction=0.1, dark_e_per_s=300.0), expected(500.0, dsnu_fraction=0.1)

    assert_spread(dark_e, 60.0)
    assert np.ptp(photo_e) == 0.0


@pytest.mark.parametrize("fraction", [0.1, 0.5, 1.0, 2.0])
def test_dark_signal_has_stated_log_normal_moments(fraction):
    """Kurtosis of the log-normal distribution: w^4 + 2 w^3 + 3 w^2 - 3, w = 1 + fraction^2."""
    dark = expected(0.0, dsnu_fraction=fraction, dark_e_per_s=300.0)

    w = 1.0 + fraction**2
    kurtosis = w**4 + 2.0 * w**3 + 3.0 * w**2 - 3.0
    assert dark.min() > 0.0
    assert dark.mean() == pytest.approx(300.0, abs=SIGMAS * 300.0 * fraction / math.sqrt(N))
    assert dark.std() == pytest.approx(300.0 * fraction, rel=SIGMAS * 0.5 * math.sqrt((kurtosis - 1.0) / N))
    normal = scipy.stats.norm(np.log(300.0 / math.sqrt(w)), math.sqrt(np.log(w)))
    assert scipy.stats.kstest(np.log(dark), normal.cdf).pvalue > 1e-6  # scipy 1.18 takes no parameters of "norm"


@pytest.mark.parametrize(("temperature_k", "factor"), [(300.0, 1.0), (308.0, 2.0), (292.0, 0.5), (324.0, 8.0)])
def test_dark_current_doubles_every_eight_kelvin(temperature_k, factor):
    assert expected(temperature_k=temperature_k, dark_e_per_s=50.0)[0] == pytest.approx(50.0 * factor)
    assert expected(100.0, temperature_k=temperature_k)[0] == 100.0


def dark_ratio(temperature_k, law, **options):
    return fs.sensor.effects.dark_current_factor(temperature_k, 300.0, law, **options)


@pytest.mark.parametrize(
    ("diffusion_fraction", "power", "energies"), [(0.0, 1.5, 0.5), (1.0, 3.0, 1.0)], ids=["generation", "diffusion"]
)
@pytest.mark.parametrize("temperature_k", [233.0, 300.0])
def test_dark_current_doubles_with_band_gap(temperature_k, diffusion_fraction, power, energies):
    """Doubling temperature k T² ln 2 / (m k T + (E_g - T dE_g/dT) / ν) of T^m exp(-E_g / ν k T), by difference."""
    t_k, k_ev = temperature_k, scipy.constants.k / scipy.constants.e
    gap_ev = 1.1557 - 7.021e-4 * t_k**2 / (1108.0 + t_k)
    slope_ev = -7.021e-4 * t_k * (2.0 * 1108.0 + t_k) / (1108.0 + t_k) ** 2
    expected_k = k_ev * t_k**2 * math.log(2.0) / (power * k_ev * t_k + (gap_ev - t_k * slope_ev) * energies)

    step_k, options = 0.01, {"diffusion_fraction": diffusion_fraction}
    above, below = (dark_ratio(t_k + step, "diffusion_generation", **options) for step in (step_k, -step_k))
    assert math.log(2.0) * 2.0 * step_k / math.log(above / below) == pytest.approx(expected_k, rel=1e-6)
    assert dark_ratio(300.0, "diffusion_generation", **options) == 1.0


def test_dark_laws_differ_when_cooled():
    """Published figures: doubling in 8 K is 3.2 times too bright at 233 K for generation, 3,400 times for diffusion."""
    rule = dark_ratio(233.0, "doubling")
    generation, diffusion, both = (
        dark_ratio(233.0, "diffusion_generation", diffusion_fraction=share) for share in (0.0, 1.0, 0.2)
    )
    assert rule / generation == pytest.approx(3.2, rel=0.01)
    assert rule / diffusion == pytest.approx(3400.0, rel=0.02)
    assert both == pytest.approx(0.8 * generation + 0.2 * diffusion)
    # An Arrhenius plot is a straight line, with the slope -E / k.
    inverse_per_k = np.array([1 / 233.0, 1 / 266.0, 1 / 300.0, 1 / 350.0])
    logarithm = np.log([dark_ratio(1.0 / each, "arrhenius", activation_ev=0.9) for each in inverse_per_k])
    slopes_k = np.diff(logarithm) / np.diff(inverse_per_k)
    assert slopes_k * scipy.constants.k / scipy.constants.e == pytest.approx(-0.9)
    assert dark_ratio(300.0, "arrhenius") == 1.0
    # The default activation energy doubles the current in 8 K at the reference temperature.
    assert dark_ratio(300.1, "arrhenius") == pytest.approx(dark_ratio(300.1, "doubling"), rel=1e-4)
    assert (dark_ratio(0.01, "arrhenius"), dark_ratio(0.01, "diffusion_generation")) == (0.0, 0.0)


@pytest.mark.parametrize("law", ["arrhenius", "diffusion_generation"])
def test_dark_and_hot_current_follow_law(law):
    cooled = {"dark_law": law, "temperature_k": 263.0, "dark_activation_ev": 0.5, "dark_diffusion_fraction": 0.3}
    factor = dark_ratio(263.0, law, activation_ev=0.5, diffusion_fraction=0.3)
    dark = expected(dark_e_per_s=50.0, hot_fraction=0.1, hot_e_per_s=5000.0, **cooled)

    assert np.unique(dark) == pytest.approx([50.0 * factor, 5050.0 * factor])
    assert factor < 0.1
    assert expected(100.0, **cooled)[0] == 100.0


def test_hot_sites_have_stated_fraction_and_current():
    dark = expected(hot_fraction=0.01, hot_e_per_s=5000.0, dark_e_per_s=10.0)

    is_hot = dark > 100.0
    assert np.unique(dark).tolist() == [10.0, 5010.0]
    assert is_hot.sum() == pytest.approx(0.01 * N, abs=SIGMAS * math.sqrt(0.01 * N))


def test_dead_sites_collect_only_dark_signal():
    charge = expected(1000.0, dead_fraction=0.02, dark_e_per_s=10.0)

    assert np.unique(charge).tolist() == [10.0, 1010.0]
    assert (charge == 10.0).sum() == pytest.approx(0.02 * N, abs=SIGMAS * math.sqrt(0.02 * N))


def test_fixed_patterns_depend_only_on_device():
    one, same, other = (sensor(prnu_fraction=0.05, device_seed=s).response for s in (1, 1, 2))

    assert np.array_equal(one, same)
    assert abs(np.corrcoef(one, other)[0, 1]) < SIGMAS / math.sqrt(N)


# -- shot noise ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mean_e", [0.3, 4.0, 60.0, 99.9])
def test_small_charges_are_poisson_independent_of_neighbours(mean_e):
    noisy = sensor(shot_noise="auto")
    expected_e = np.full(N, mean_e)
    expected_e[::2] = np.random.default_rng(0).uniform(0.0, 1e4, N // 2)

    alone = noisy.collect(np.full(N, mean_e), seed=4)
    among = noisy.collect(expected_e, seed=4)

    assert np.array_equal(alone[1::2], among[1::2])
    distribution = scipy.stats.poisson(mean_e)
    low, high = int(distribution.ppf(1e-3)), int(distribution.ppf(1 - 1e-3))
    edges = np.concatenate(([-np.inf], np.arange(low, high + 1) + 0.5, [np.inf]))
    counts = np.histogram(alone, edges)[0]
    probability = np.diff(np.concatenate(([0.0], distribution.cdf(np.arange(low, high + 1)), [1.0])))
    assert scipy.stats.chisquare(counts, probability * N).pvalue > 1e-6


def test_draws_are_independent_of_thread_count():
    noisy = sensor(shot_noise="auto", read_noise_e=3.0, ktc_noise=True, dnl_dn=0.5, rts_fraction=0.1, rts_e=20.0)
    expected_e = np.random.default_rng(0).uniform(0.0, 300.0, N)
    exact = sensor(shot_noise="exact")

    for n_threads in (2, 3, 7):
        for one in (noisy, exact):
            first = one.collect(expected_e, seed=1, n_threads=1)
            assert np.array_equal(first, one.collect(expected_e, seed=1, n_threads=n_threads))
        code = noisy.read(first, seed=1, n_threads=1)
        assert np.array_equal(code, noisy.read(first, seed=1, n_threads=n_threads))


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("n_threads", [1, 2, 7])
@pytest.mark.parametrize(
    "extra", [{}, {"crosstalk": fs.sensor.Diffusion(spread_um=0.3)}, {"shot_noise": "exact"}], ids=str
)
def test_exposure_in_one_pass_equals_its_steps(extra, n_threads):
    noisy = sensor(**{**ALL, "crosstalk": None, "full_well_e": 450.0, "pedestal_v": 0.1, **extra})
    rate_e_per_s = np.random.default_rng(0).uniform(0.0, 900.0, N)
    expected_e = noisy.expected_electrons(rate_e_per_s, 0.5, n_threads=1)
    electrons = noisy.collect(expected_e, seed=1, frame=2, n_threads=1)
    code = noisy.read(electrons, seed=1, frame=2, n_threads=1)

    found = noisy.expose(rate_e_per_s, 0.5, seed=1, frame=2, n_threads=n_threads)

    for values, wanted in zip(found, (expected_e, electrons, code), strict=True):
        assert values.dtype == wanted.dtype
        assert np.array_equal(values, wanted)


def test_negative_rates_are_rejected_in_one_pass():
    rate_e_per_s = np.ones(N)
    rate_e_per_s[-1] = -7.0
    with pytest.raises(ParameterError, match=r"'expected_e' must be >= 0 everywhere, got -7\.0 e-"):
        sensor().expose(rate_e_per_s, 1.0, seed=0)


def test_draws_depend_on_site_index_only():
    """The first sites of a larger layout have the same draws, also within a block."""
    options = {**FINE, "shot_noise": "auto", "read_noise_e": 4.0, "ktc_noise": True, "pedestal_v": 0.3}
    rate_e_per_s = np.random.default_rng(1).uniform(0.0, 300.0, N)
    large = Sensor(MANY, **options).expose(rate_e_per_s, 1.0, seed=5)

    for n in (1, 3, 1025, 40_001):
        small = Sensor(MANY[:n], **options).expose(rate_e_per_s[:n], 1.0, seed=5)
        assert all(np.array_equal(few, many[:n]) for few, many in zip(small, large, strict=True))


@pytest.mark.parametrize("mean_e", [1e-3, 0.97, 1.0, 7.3, 29.999, 64.5, 99.9, 400.25, 699.5])
def test_exact_draws_have_poisson_probabilities(mean_e):
    n = 2_000_000
    electrons = fs.sensor.draw_shot_noise(np.full(n, mean_e), "auto", 700.0, seed=21)

    distribution = scipy.stats.poisson(mean_e)
    edges = np.arange(distribution.ppf(20.0 / n), distribution.isf(20.0 / n))
    counts = np.histogram(electrons, np.concatenate(([-np.inf], edges + 0.5, [np.inf])))[0]
    wanted = n * np.diff(np.concatenate(([0.0], distribution.cdf(edges), [1.0])))
    assert scipy.stats.chisquare(counts, wanted).pvalue > 1e-6


def test_exact_draws_follow_mean_of_each_site():
    """Scaled residuals of means between 0 and 700 have the Poisson variance and skewness."""
    mean_e = np.random.default_rng(2).uniform(0.5, 700.0, 2_000_000)
    z = (fs.sensor.draw_shot_noise(mean_e, "auto", 700.0, seed=22) - mean_e) / np.sqrt(mean_e)

    for values, wanted in ((z, 0.0), (z**2, 1.0), (z**3, np.mean(mean_e**-0.5))):
        assert abs(values.mean() - wanted) < SIGMAS * values.std() / math.sqrt(z.size)
    for lag in (1, 2, 1024):
        assert abs(np.corrcoef(z[:-lag], z[lag:])[0, 1]) < SIGMAS / math.sqrt(z.size)


@pytest.mark.parametrize(("mean_e", "distance"), [(100.0, 2.0e-4), (700.0, 2.8e-5)])
def test_draws_above_limit_approximate_poisson(mean_e, distance):
    """Draws have the probabilities of the documented quadratic function, with its distance and kurtosis."""
    c = 1 / 6 + 11 / (648 * mean_e)
    s = math.sqrt(mean_e - 1 / 12 - 2 * c * c)
    edges = np.arange(int(mean_e - 9 * s), int(mean_e + 10 * s)) + 0.5
    # mean + s z + c (z² - 1) < edge between the two roots.
    root = np.sqrt(s * s - 4 * c * (mean_e - c - edges))
    probability = np.diff(scipy.stats.norm.cdf((root - s) / (2 * c)) - scipy.stats.norm.cdf((-root - s) / (2 * c)))
    charges = edges[1:] - 0.5
    n = 4_000_000

    electrons = fs.sensor.draw_shot_noise(np.full(n, np.nextafter(mean_e, np.inf)), "auto", mean_e, seed=23)

    is_frequent = probability * n > 20
    counts = np.histogram(electrons, edges)[0][is_frequent]
    wanted = probability[is_frequent] * n
    rest = n - counts.sum(), n - wanted.sum()
    assert scipy.stats.chisquare([*counts, rest[0]], [*wanted, rest[1]]).pvalue > 1e-6
    poisson = scipy.stats.poisson.pmf(charges, mean_e)
    assert 0.5 * np.abs(probability - poisson).sum() == pytest.approx(distance, rel=0.02)
    kurtosis = ((charges - mean_e) ** 4 @ probability) / mean_e**2 - 3.0
    assert kurtosis == pytest.approx(4 / (3 * mean_e), rel=2e-3)


@pytest.mark.parametrize("gaussian_above_e", [5.0, 1e9, math.nan])
def test_implausible_poisson_limit_is_rejected(gaussian_above_e):
    with pytest.raises(ParameterError, match="'gaussian_above_e' must be "):
        fs.sensor.draw_shot_noise(np.ones(3), "auto", gaussian_above_e, seed=0)


@pytest.mark.parametrize("how", ["auto", "exact", "off"])
def test_invalid_expectations_are_rejected(how):
    for value in (-1.0, math.nan):
        with pytest.raises(ParameterError, match="'expected_e' must be >= 0 everywhere, got"):
            fs.sensor.draw_shot_noise([3.0, value], how, 100.0, seed=0)


def reset_noise_e(some):
    return noise_budget(some, np.zeros(N), 0.0)["reset"]


# -- readout noise -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("capacitance_f", "noise_e"), [(1e-15, 12.70), (1e-13, 127.0), (4.8e-13, 278.3)])
def test_reset_noise_matches_published_values(capacitance_f, noise_e):
    assert reset_noise_e(sensor(ktc_noise=True, capacitance_f=capacitance_f))[0] == pytest.approx(noise_e, rel=5e-4)


def test_cds_removes_reset_noise():
    size_e = reset_noise_e(sensor(ktc_noise=True))[0]

    assert_spread(codes(ktc_noise=True), size_e, 1 / 12)
    assert np.ptp(codes(ktc_noise=True, cds=True)) == 0.0
    assert reset_noise_e(sensor(ktc_noise=True, temperature_k=75.0))[0] == pytest.approx(size_e / 2)


def test_reset_noise_scales_with_site_capacitance():
    two = np.where(np.arange(N) % 2, FINE["capacitance_f"], 4.0 * FINE["capacitance_f"])

    noise = reset_noise_e(sensor(ktc_noise=True, capacitance_f=two))

    assert noise[0] == pytest.approx(2.0 * noise[1])


def test_reset_and_read_noise_add_in_quadrature():
    size_e = reset_noise_e(sensor(ktc_noise=True))[0]

    assert_spread(codes(ktc_noise=True, read_noise_e=40.0), math.hypot(size_e, 40.0), 1 / 12)


def test_rts_sites_alternate_between_two_states():
    frames = np.stack([codes(rts_fraction=0.1, rts_e=40.0, frame=k) for k in range(30)])
    moves = np.ptp(frames, axis=0)

    assert (moves > 0).sum() == pytest.approx(0.1 * N, abs=SIGMAS * math.sqrt(0.1 * N))
    assert np.unique(moves).tolist() == [0.0, 40.0]
    assert frames[:, moves > 0].mean() == pytest.approx(30_000.0, abs=0.1)


def test_read_noise_acts_after_full_well():
    full = sensor(full_well_e=7000.0, read_noise_e=50.0, ktc_noise=False)
    charge = full.collect(np.full(N, 9000.0), seed=0)

    assert np.unique(charge).tolist() == [7000]
    assert_spread(full.read(charge, seed=0).astype(float), 50.0, 1 / 12)


# -- conversion to volts --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("charge_e", "spread_dn"), [(30_000, 300.0), (15_000, 150.0)])
def test_gain_fpn_is_proportional_to_signal(charge_e, spread_dn):
    assert_spread(codes(charge_e, gain_fpn_fraction=0.01), spread_dn, 1 / 12)


@pytest.mark.parametrize("charge_e", [20_000, 40_000])
def test_pixel_fpn_is_independent_of_signal(charge_e):
    got = codes(charge_e, pixel_fpn_fraction=0.02)

    assert_spread(got, 0.02 * 65_536, 1 / 12)
    assert np.array_equal(got, codes(charge_e, pixel_fpn_fraction=0.02, seed=1, frame=5))
    assert np.ptp(codes(charge_e, pixel_fpn_fraction=0.02, cds=True)) == 0.0


def test_column_fpn_is_common_to_line():
    picture = codes(line_fpn_fraction=0.02).reshape(N_Y, N_X)

    assert np.all(picture == picture[0])
    assert picture[0].std() == pytest.approx(0.02 * 65_536, rel=SIGMAS / math.sqrt(2 * N_X))


def test_offsets_are_clipped_and_independent_of_gain():
    dark = codes(0, pixel_fpn_fraction=0.02, gain_fpn_fraction=0.3)

    # Half of the offsets are negative and clipped at 0.
    assert (dark == 0.0).mean() == pytest.approx(0.5, abs=SIGMAS / math.sqrt(N))
    assert np.array_equal(dark, codes(0, pixel_fpn_fraction=0.02))
    assert codes(65_000, pixel_fpn_fraction=0.02).max() == 65_535
    # 1.5 times the range: no offset moves this signal below saturation.
    assert codes(98_000, pixel_fpn_fraction=0.02).min() == 65_535


def test_pedestal_prevents_clipping_of_dark_noise():
    dark = codes(0, pedestal_v=0.3, read_noise_e=100.0)

    assert dark.mean() == pytest.approx(0.1 * 65_536 - 0.5, abs=SIGMAS * 100.0 / math.sqrt(N))
    assert_spread(dark, 100.0, 1 / 12)
    assert np.ptp(codes(0, pedestal_v=0.3, cds=True)) == 0.0
    assert codes(0, pedestal_v=0.3, cds=True)[0] == codes(0, pedestal_v=0.3)[0] == 6553


def test_nonlinearity_loss_grows_with_signal():
    for fraction in (0.25, 0.5, 1.0):
        charge = round(fraction * 65_536)
        assert codes(charge, nonlinearity_fraction=0.04)[0] == pytest.approx(charge * (1 - 0.04 * fraction), abs=1.0)


def test_pedestal_is_added_after_nonlinearity():
    """A quarter of the range loses 1 % of itself; the pedestal of a tenth of the range loses nothing."""
    code = codes(16_384, nonlinearity_fraction=0.04, pedestal_v=0.3)[0]

    assert code == pytest.approx((0.25 * 0.99 + 0.1) * 65_536, abs=1.0)


# -- codes ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [4, 8, 12])
@pytest.mark.parametrize(
    ("companding", "code_fraction"),
    [
        ({"companding": "linear"}, lambda x: x),
        ({"companding": "root"}, np.sqrt),
        ({"companding": "log", "log_strength": 50.0}, lambda x: np.log(1 + 50 * x) / np.log(51)),
        (
            {"companding": "table", "companding_table": [0.0, 0.5, 0.8, 1.0]},
            lambda x: np.interp(x, [0, 1 / 3, 2 / 3, 1], [0, 0.5, 0.8, 1]),
        ),
    ],
)
def test_companding_adc_follows_transfer_function(bits, companding, code_fraction):
    charge = np.linspace(0, 65_536, N).astype(np.int64)
    got = codes(charge, **{**companding, "bits": bits})

    assert got.min() == 0
    assert got.max() == 2**bits - 1
    assert np.all(np.diff(got) >= 0)
    exact = code_fraction(charge / 65_536) * 2**bits
    is_unambiguous = np.abs(exact - np.rint(exact)) > 1e-4  # near a transition rounding decides
    assert np.array_equal(got[is_unambiguous], np.minimum(np.floor(exact[is_unambiguous]), 2**bits - 1))


def test_inl_matches_table():
    charge = np.linspace(0, 65_535, N).astype(np.int64)
    moved = codes(charge, inl_dn=[0.0, 30.0, 0.0]) - codes(charge)

    is_central = np.abs(charge - 32_768) < 100
    assert np.abs(moved[is_central] - 30.0).max() <= 1.0
    assert np.abs(moved - 30.0 * (1 - np.abs(charge / 32_768 - 1))).max() <= 1.0


def test_dnl_is_independent_per_line_and_code():
    """Signal at the centre of code 7 of 16: DNL beyond half a code changes the code."""
    charge = np.full(N, round(65_536 / 16 * 7.5), np.int64)
    picture = codes(charge, bits=4, dnl_dn=0.5).reshape(N_Y, N_X)

    assert np.all(picture == picture[0])
    moved = picture[0] - 7.0
    dnl = scipy.stats.norm(scale=0.5)
    for step in (-1, 0, 1):
        p = dnl.cdf(step + 0.5) - dnl.cdf(step - 0.5)
        assert (moved == step).mean() == pytest.approx(p, abs=SIGMAS * math.sqrt(p * (1 - p) / N_X))
    other_code = codes(np.full(N, round(65_536 / 16 * 8.5)), bits=4, dnl_dn=0.5).reshape(N_Y, N_X)[0] - 8.0
    assert abs(np.corrcoef(moved, other_code)[0, 1]) < SIGMAS / math.sqrt(N_X)


def test_dnl_has_stated_standard_deviation():
    """On a ramp within one code, the fraction of the next code measures the DNL of each line."""
    steps = np.arange(N_Y) / N_Y
    charge = np.round(65_536 / 16 * (7.0 + steps)).astype(np.int64).repeat(N_X)
    picture = codes(charge, bits=4, dnl_dn=0.2).reshape(N_Y, N_X)

    added = picture.mean(axis=0) - 7.0  # DNL plus a constant, for DNL between -1 and 1
    assert added.std() == pytest.approx(0.2, rel=SIGMAS / math.sqrt(2 * N_X))


# -- order and independence -------------------------------------------------------------------------------------------

ALL = {
    "prnu_fraction": 0.02,
    "dark_e_per_s": 50.0,
    "dsnu_fraction": 0.1,
    "hot_fraction": 0.001,
    "hot_e_per_s": 1e4,
    "dead_fraction": 0.001,
    "full_well_e": 40_000.0,
    "ktc_noise": True,
    "read_noise_e": 5.0,
    "rts_fraction": 0.05,
    "rts_e": 20.0,
    "gain_fpn_fraction": 0.01,
    "pixel_fpn_fraction": 0.01,
    "line_fpn_fraction": 0.01,
    "dnl_dn": 0.5,
    "shot_noise": "auto",
}
#: Keyword of each effect, and the value that disables it.
SWITCHES = {
    "prnu_fraction": 0.0,
    "dark_e_per_s": 0.0,
    "dsnu_fraction": 0.0,
    "hot_fraction": 0.0,
    "dead_fraction": 0.0,
    "shot_noise": "off",
    "full_well_e": None,
    "ktc_noise": False,
    "read_noise_e": 0.0,
    "rts_fraction": 0.0,
    "gain_fpn_fraction": 0.0,
    "pixel_fpn_fraction": 0.0,
    "line_fpn_fraction": 0.0,
    "dnl_dn": 0.0,
}
BEFORE_COLLECTION = ("prnu_fraction", "dark_e_per_s", "dsnu_fraction", "hot_fraction", "dead_fraction")
PATTERNS = {
    "response": lambda s: s.response,
    "dark_rate_e_per_s": lambda s: s.dark_rate_e_per_s,
    **{name: lambda s, name=name: s.pattern(name) for name in ("gain_fpn", "pixel_fpn", "column_fpn", "rts")},
}
PATTERN_OF_KEYWORD = {
    "prnu_fraction": "response",
    "dead_fraction": "response",
    "dark_e_per_s": "dark_rate_e_per_s",
    "dsnu_fraction": "dark_rate_e_per_s",
    "hot_fraction": "dark_rate_e_per_s",
    "gain_fpn_fraction": "gain_fpn",
    "pixel_fpn_fraction": "pixel_fpn",
    "line_fpn_fraction": "column_fpn",
    "rts_fraction": "rts",
}


@pytest.mark.slow(keep=5)
@pytest.mark.parametrize("effect", SWITCHES)
def test_disabled_effect_leaves_other_draws_unchanged(effect):
    on, off = sensor(**ALL), sensor(**{**ALL, effect: SWITCHES[effect]})
    photo_e = np.linspace(0.0, 50_000.0, N)

    charges = [s.collect(s.expected_electrons(photo_e, 1.0), seed=3, frame=2) for s in (on, off)]
    read = [s.read(charge, seed=3, frame=2) for s, charge in zip((on, off), charges, strict=True)]

    assert not np.array_equal(*read)
    for pattern, of in PATTERNS.items():
        if PATTERN_OF_KEYWORD.get(effect) != pattern:
            assert np.array_equal(of(on), of(off))
    if effect in BEFORE_COLLECTION or effect in {"shot_noise", "full_well_e"}:
        # Equal charges give equal codes.
        assert np.array_equal(on.read(charges[0], seed=3, frame=2), off.read(charges[0], seed=3, frame=2))
    else:
        assert np.array_equal(*charges)


def test_rts_changes_only_rts_sites():
    on, off = sensor(**ALL), sensor(**{**ALL, "rts_fraction": 0.0})
    charge = np.full(N, 20_000, np.int64)
    moved = on.read(charge, seed=0) != off.read(charge, seed=0)

    assert set(np.flatnonzero(moved)) <= set(np.flatnonzero(on.pattern("rts")))


@pytest.mark.parametrize("effect", ["prnu_fraction", "dsnu_fraction", "gain_fpn_fraction", "pixel_fpn_fraction", "dnl_dn", "line_fpn_fraction", "dead_fraction", "hot_fraction", "rts_fraction"])  # fmt: skip
def test_cropped_sensor_gives_identical_codes(effect):
    """Temporal noise is disabled because its draws depend on the site index."""
    quiet = {**ALL, "shot_noise": "off", "ktc_noise": False, "read_noise_e": 0.0, "rts_e": 0.0, effect: ALL[effect]}
    ids = np.random.default_rng(1).permutation(N)[:5000]
    crop = Sensor(MANY[ids], **{**FINE, **quiet})
    photo_e = np.linspace(100.0, 30_000.0, N)

    complete = sensor(**quiet)
    codes = [
        s.read(s.collect(s.expected_electrons(photo_e_per_s, 1.0), seed=0), seed=0)
        for s, photo_e_per_s in ((complete, photo_e), (crop, photo_e[ids]))
    ]

    assert np.array_equal(codes[1], codes[0][ids])
    if effect != "rts_fraction":
        return
    crop, complete = (Sensor(layout, **{**FINE, **quiet, "rts_e": 9.0}).pattern("rts") for layout in (MANY[ids], MANY))
    assert np.array_equal(crop, complete[ids])


@pytest.mark.slow
def test_codes_are_independent_of_process_and_order():
    program = """
import hashlib, sys
import numpy as np
import foveasim as fs
layout = fs.layout.grid(n_x=400, n_y=300, pitch_um=2.0)
sensor = fs.Sensor(layout, prnu_fraction=0.02, read_noise_e=3.0, ktc_noise=True, dnl_dn=0.5, rts_fraction=0.1, rts_e=9.0, bits=12)
photo_e = np.linspace(0.0, 500.0, layout.n_sites)
for frame in map(int, sys.argv[2:]):
    charge = sensor.collect(sensor.expected_electrons(photo_e, 1.0), seed=9, frame=frame, n_threads=int(sys.argv[1]))
    code = sensor.read(charge, seed=9, frame=frame, n_threads=int(sys.argv[1]))
    print(frame, hashlib.sha256(code.tobytes()).hexdigest())
"""
    runs = [
        subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True).stdout
        for arguments in (("1", "0", "1", "2"), ("3", "2", "0", "1"))
    ]

    assert len(set(runs[0].splitlines())) == 3
    assert sorted(runs[0].splitlines()) == sorted(runs[1].splitlines())


def test_sensitivity_affects_only_photoelectrons():
    halves = np.where(np.arange(N) % 2, 0.5, 1.0)
    charge = expected(1000.0, sensitivity=halves, dark_e_per_s=10.0)

    assert np.unique(charge).tolist() == [510.0, 1010.0]
    with pytest.raises(ParameterError, match=r"'sensitivity' must be <= 1, got 2.0"):
        sensor(sensitivity=2.0)


# -- invalid input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("prnu_fraction", -0.1, "'prnu_fraction' must be >= 0"),
        ("dead_fraction", 1.5, "'dead_fraction' must be <= 1"),
        ("hot_fraction", float("nan"), "'hot_fraction' must be finite"),
        ("temperature_k", 0.0, "'temperature_k' must be > 0"),
        ("temperature_k", -20.0, "'temperature_k' must be > 0"),
        ("dark_doubling_k", 0.0, "'dark_doubling_k' must be > 0"),
        (
            "dark_law",
            "Arrhenius",
            "'dark_law' must be one of 'doubling', 'arrhenius', 'diffusion_generation', got 'Arr",
        ),
        ("dark_activation_ev", 670.0, r"'dark_activation_ev' must be from 0.01 to 10, got 670.0 eV; in silicon"),
        ("dark_diffusion_fraction", 2.0, "'dark_diffusion_fraction' must be <= 1"),
        ("ktc_noise", 1, "'ktc_noise' must be True or False"),
        ("cds", "yes", "'cds' must be True or False"),
        ("companding", "gamma", "'companding' must be one of 'linear', 'root', 'log', 'table'"),
        ("companding_table", [0.0, 1.0], "'companding_table' must be given if and only if companding='table'"),
        ("companding", "table", "'companding_table' must be given if and only if companding='table'"),
        ("inl_dn", [3.0], "'inl_dn' must have at least two values"),
        ("inl_dn", [0.0, float("inf")], "'inl_dn' must be finite"),
        ("log_strength", 0.0, "'log_strength' must be > 0"),
        ("dnl_dn", -1.0, "'dnl_dn' must be >= 0"),
        ("device_seed", -1, "'device_seed' must be >= 0"),
        ("device_seed", 1.5, "'device_seed' must be an integer"),
        ("gaussian_above_e", 1e5, "'gaussian_above_e' must be <= 700"),
        ("read_noise_e", 1e300, r"'read_noise_e' must be <= 1e\+07, got 1e\+300 e-; charges are in electrons"),
        (
            "read_noise_e",
            np.where(np.arange(N) == 7, 1e300, 1.0),
            r"'read_noise_e' must be <= .* got 1e\+300 e- at \[7\]",
        ),
        ("rts_e", 1e300, r"'rts_e' must be <= 1e\+07, got 1e\+300 e-"),
        ("prnu_fraction", 1e9, "'prnu_fraction' must be <= 0.3, got 1000000000.0; 0.03 is 3 %"),
        ("gain_fpn_fraction", 0.5, "'gain_fpn_fraction' must be <= 0.3"),
        ("dsnu_fraction", 1e9, "'dsnu_fraction' must be <= 10"),
        ("pixel_fpn_fraction", 2.0, "'pixel_fpn_fraction' must be <= 1"),
        ("line_fpn_fraction", 2.0, "'line_fpn_fraction' must be <= 1"),
        ("dark_e_per_s", 1e300, r"'dark_e_per_s' must be <= 1e\+15, got 1e\+300 e-/s"),
        ("hot_e_per_s", 1e300, r"'hot_e_per_s' must be <= 1e\+15, got 1e\+300 e-/s"),
        ("full_well_e", 1e300, r"'full_well_e' must be <= 1e\+15, got 1e\+300 e-"),
        ("v_sat_v", 1e300, r"'v_sat_v' must be from 1e-06 to 1000, got 1e\+300 V; voltages are in volts"),
        ("v_sat_v", 1e-9, r"'v_sat_v' must be from 1e-06 to 1000, got 1e-09 V"),
        ("pedestal_v", 30.0, r"'pedestal_v' must be < v_sat_v = 3 V, got 30.0 V"),
        ("dark_doubling_k", 1e-6, r"'dark_doubling_k' must be from 0.1 to 1000, got 1e-06 K"),
        ("dnl_dn", 1e300, "'dnl_dn' must be <= 65536, got .* DN"),
        ("inl_dn", [0.0, 1e300], "'inl_dn' must be from -65536 to 65536 everywhere, got .* DN"),
        ("gain_dn_per_e", 0.0, "'gain_dn_per_e' must be > 0"),
        ("dsnu_e", -1.0, "'dsnu_e' must be >= 0"),
        ("capacitance_f", 1.0, "'capacitance_f' must be from 1e-18 to 1e-06, got 1.0 F; capacitances are in farad"),
    ],
)
def test_invalid_chain_parameters_are_rejected(name, value, message):
    with pytest.raises(ParameterError, match=f"^{message}"):
        sensor(**{name: value})


def test_implausible_dark_current_is_rejected():
    with pytest.raises(ParameterError, match=r"'dark_e_per_s' must be <= 1e\+15 at temperature_k = 900 K, got .* e-/s"):
        sensor(dark_e_per_s=1.0, temperature_k=900.0, dark_reference_k=300.0, dark_doubling_k=5.0)


@pytest.mark.parametrize("exposure_s", [1e300, 1e-30])
def test_implausible_exposure_is_rejected(exposure_s):
    with pytest.raises(
        ParameterError, match=r"'exposure_s' must be 0, or from 1e-12 to 1e\+07, got .* s; times are in sec"
    ):
        sensor().expected_electrons(np.ones(N), exposure_s)


@pytest.mark.parametrize("table", [[0.0, 0.6, 0.5, 1.0], [0.1, 1.0], [0.0, 0.9], [1.0]])
def test_invalid_companding_table_is_rejected(table):
    with pytest.raises(
        ParameterError, match="'companding_table' must have at least two non-decreasing values from 0 to 1"
    ):
        sensor(companding="table", companding_table=table)


@pytest.mark.parametrize("parameters", [{"dnl_dn": 0.5}, {"line_fpn_fraction": 0.02}])
def test_line_effects_require_readout_line_column(parameters):
    with pytest.raises(SimulationError, match="the layout has no column 'readout_line'"):
        Sensor(fs.Layout.from_rectangles([[0.0, 0.0], [3.0, 0.0]], 2.0), **parameters)


@pytest.mark.parametrize(
    ("charge_e", "message"),
    [
        (np.ones(3), f"must have one value for each of the {N} sites, got the shape \\(3,\\)"),
        (np.full(N, -1.0), "must be >= 0 everywhere, got -1.0 e-"),
        (np.full(N, np.nan), "must be >= 0 everywhere, got nan e-"),
    ],
)
def test_invalid_charges_are_rejected(charge_e, message):
    one = sensor(read_noise_e=1.0)

    for step in (lambda: one.collect(charge_e, seed=0), lambda: one.predict(charge_e)):
        with pytest.raises(ParameterError, match=message):
            step()
    with pytest.raises(ParameterError, match="'electrons' must have one value for each of the"):
        one.read(np.ones(3, np.int64), seed=0)

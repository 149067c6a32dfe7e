"""Photon transfer and EMVA 1288: parameters of a known sensor, recovered from its frames."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.constants

import foveasim as fs
from foveasim.errors import FoveasimWarning, ParameterError
from foveasim.metrics import PhotonTransfer, draw_frames, emva1288, photon_transfer, predicted_photon_transfer
from foveasim.metrics.emva_intervals import Jackknife
from foveasim.metrics.emva_nonuniformity import MeanImage, spatial_parts
from foveasim.metrics.photon_transfer import measure_subsets
from foveasim.sensor import Sensor, noise_budget
from foveasim.units import photon_energy_j

SIGMAS = 5.0
Q = scipy.constants.e

# 40,000 small sites inside, 30,000 large sites around them.
LAYOUT = fs.layout.zones(side_um=(400, 800), pitch_um=(2, 4))
SIZE_UM = np.where(LAYOUT.columns["zone"] == 0, 2.0, 4.0)
IS_LARGE = SIZE_UM == 4.0
N_SITES = np.array([np.count_nonzero(~IS_LARGE), np.count_nonzero(IS_LARGE)])
BITS, V_SAT_V = 12, 1.0
CAPACITANCE_F, READ_E, FULL_WELL_E = np.array([1e-15, 4e-15]), np.array([6.0, 12.0]), np.array([5000.0, 15_000.0])
DARK_E_PER_S, AREA_UM2 = np.array([4000.0, 16_000.0]), np.array([4.0, 16.0])
GAIN_DN_PER_E = 2**BITS * Q / (V_SAT_V * CAPACITANCE_F)
QE, PRNU, DSNU = 0.6, 0.02, 0.1
EXPOSURE_S = 0.05
EXPOSURES_S = np.array([0.02, 0.04, 0.06, 0.08, 0.1])
#: Photons per µm², in steps of 3 % of the saturation of the large sites, up to beyond that of the small sites.
LIGHT_PER_UM2 = np.arange(1, 53) * 48.0
#: Levels near half saturation have more frames, for the PRNU.
N_FRAMES = np.where((LIGHT_PER_UM2 > 600) & (LIGHT_PER_UM2 < 1200), 6, 2)
N_DARK = 8


def per_site(of_classes):
    return np.where(IS_LARGE, of_classes[1], of_classes[0])


#: Every 200th site of each class; a prediction for all sites is slow.
SOME = np.sort(np.concatenate([np.flatnonzero(of)[::200] for of in (~IS_LARGE, IS_LARGE)]))


def two_sizes(layout=LAYOUT, **parameters):
    return Sensor(
        layout,
        **{
            "bits": BITS,
            "v_sat_v": V_SAT_V,
            "capacitance_f": per_site(CAPACITANCE_F),
            "read_noise_e": per_site(READ_E),
            "full_well_e": per_site(FULL_WELL_E),
            "dark_e_per_s": per_site(DARK_E_PER_S),
            "qe": QE,
            "prnu_fraction": PRNU,
            "dsnu_fraction": DSNU,
        }
        | parameters,
    )


def measured(n_threads=1, levels=slice(None), **parameters):
    """Complete measurement: uniform irradiance at 550 nm, dark frames, and a dark series over exposure."""
    sensor = two_sizes(**parameters)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=4.0), sensor=sensor, order=1, n_threads=n_threads)
    one_per_s_um2_w_m2 = float(photon_energy_j(550.0)) * 1e12
    light = fs.PowerMap.from_array(np.full((40, 40), one_per_s_um2_w_m2), pitch_um=25.0, wavelength_nm=550.0)
    rate_e_per_s = camera.photoelectrons_per_s(light) / EXPOSURE_S

    frame = 0

    def frames(expected_e, n_frames):
        nonlocal frame
        frame += n_frames
        return draw_frames(
            sensor, expected_e, n_frames=n_frames, seed=3, first_frame=frame - n_frames, n_threads=n_threads
        )

    lit = [
        frames(sensor.expected_electrons(rate_e_per_s * per_um2, EXPOSURE_S), n)
        for per_um2, n in zip(LIGHT_PER_UM2[levels], N_FRAMES[levels], strict=True)
    ]
    dark = [frames(sensor.expected_electrons(np.zeros(LAYOUT.n_sites), EXPOSURE_S), N_DARK)]
    series = [frames(sensor.expected_electrons(np.zeros(LAYOUT.n_sites), t), N_DARK) for t in EXPOSURES_S]
    return emva1288(
        lit,
        dark,
        LIGHT_PER_UM2[levels, None] * per_site(AREA_UM2),
        classes=SIZE_UM,
        dark_series=series,
        exposure_s=EXPOSURES_S,
    )


@pytest.fixture(scope="module")
def result():
    return measured()


# -- standard errors from the sensor parameters ------------------------------------------------------------------------

DARK_E = DARK_E_PER_S * EXPOSURE_S
LIGHT_E = QE * LIGHT_PER_UM2[:, None] * AREA_UM2


def variance_dn2(light_e, dark_e):
    return GAIN_DN_PER_E**2 * (light_e + dark_e + READ_E**2) + 1.0 / 12.0


def error_of_variance(variance, n_frames):
    """Standard error of a variance of Gaussian noise, from ``n_frames - 1`` degrees of freedom per site."""
    return variance * np.sqrt(2.0 / (N_SITES * (np.asarray(n_frames) - 1.0)))


def relative_error_of_gain():
    """Relative standard error of the gain: errors of the variances, with a common dark variance; errors of means are negligible."""
    linear = 0.66 * FULL_WELL_E  # slightly below the 70 % of saturation that are used, which overestimates the errors
    x = np.where(linear >= LIGHT_E, LIGHT_E, 0.0)
    error_e2 = error_of_variance(variance_dn2(LIGHT_E, DARK_E), N_FRAMES[:, None]) / GAIN_DN_PER_E**2
    dark_e2 = error_of_variance(variance_dn2(0.0, DARK_E), N_DARK) / GAIN_DN_PER_E**2
    squares = (x * x).sum(axis=0)
    return np.sqrt(((x * error_e2) ** 2).sum(axis=0) + (x.sum(axis=0) * dark_e2) ** 2) / squares


def errors_of_dark_line():
    """Standard errors of intercept and slope of the dark variance over exposure, DN² and DN²/s."""
    error = error_of_variance(variance_dn2(0.0, DARK_E_PER_S * EXPOSURES_S[:, None]), N_DARK)
    off_s = EXPOSURES_S - EXPOSURES_S.mean()
    of_slope = off_s / (off_s @ off_s)
    at_zero = 1.0 / off_s.size - EXPOSURES_S.mean() * of_slope
    return tuple(np.sqrt(((weight[:, None] * error) ** 2).sum(axis=0)) for weight in (at_zero, of_slope))


def error_of_spatial(spatial_dn2, temporal_dn2, n_frames):
    """Standard error of a spatial variance of frame means, less the temporal part, DN²."""
    chance = (spatial_dn2 + temporal_dn2 / n_frames) * np.sqrt(2.0 / (N_SITES - 1))
    return np.hypot(chance, error_of_variance(temporal_dn2, n_frames) / n_frames)


def assert_within(got, true, error):
    off = np.abs(got - true) / error
    assert np.all(off < SIGMAS), f"{got} differs from {true} by {off} standard errors"
    assert np.all(error < 0.1 * np.abs(true)), "standard error too large for a meaningful test"


# -- parameters ---------------------------------------------------------------------------------------------------------


def test_classes_match_site_sizes(result):
    assert result.classes.tolist() == [2.0, 4.0]
    assert result.transfer.n_sites.tolist() == N_SITES.tolist()
    assert result.transfer.n_frames.tolist() == N_FRAMES.tolist()


def test_gain_matches_sensor(result):
    assert_within(result.gain_dn_per_e, GAIN_DN_PER_E, GAIN_DN_PER_E * relative_error_of_gain())


def test_quantum_efficiency_matches_sensor(result):
    # PRNU of a finite number of sites, and shot noise of the mean at the highest level used.
    of_response = np.sqrt(PRNU**2 / N_SITES + 1.0 / (N_SITES * 0.66 * FULL_WELL_E))
    assert_within(result.qe, np.full(2, QE), QE * np.hypot(relative_error_of_gain(), of_response))


def test_dark_noise_matches_read_noise(result):
    """Extrapolated to exposure 0, with the quantisation variance of 1/12 subtracted once."""
    error_dn2, _ = errors_of_dark_line()
    error_e = np.hypot(error_dn2 / (2.0 * GAIN_DN_PER_E**2 * READ_E), READ_E * relative_error_of_gain())

    assert_within(result.dark_noise_e, READ_E, error_e)
    assert not result.is_quantisation_limited.any()
    error_dn = error_dn2 / (2.0 * GAIN_DN_PER_E * READ_E)
    assert_within(result.dark_noise_dn, np.sqrt((GAIN_DN_PER_E * READ_E) ** 2 + 1 / 12), error_dn)


def test_dark_current_from_mean_and_variance(result):
    _, slope_error_dn2 = errors_of_dark_line()
    relative = relative_error_of_gain()
    shot = np.sqrt(DARK_E_PER_S * 0.1 / (N_SITES * N_DARK)) / (DARK_E_PER_S * 0.08)
    by_mean = DARK_E_PER_S * np.sqrt(relative**2 + DSNU**2 / N_SITES + shot**2)
    by_variance = np.hypot(slope_error_dn2 / GAIN_DN_PER_E**2, 2.0 * relative * DARK_E_PER_S)

    assert_within(result.dark_current_e_per_s, DARK_E_PER_S, by_mean)
    assert_within(
        result.dark_current_from_variance_e_per_s,
        DARK_E_PER_S,
        np.hypot(by_variance, DARK_E_PER_S * DSNU / N_SITES**0.5),
    )


def test_dsnu_excludes_temporal_noise(result):
    true_e = DSNU * DARK_E
    error_dn2 = error_of_spatial((GAIN_DN_PER_E * true_e) ** 2, variance_dn2(0.0, DARK_E), N_DARK)
    error_e = np.hypot(error_dn2 / (2.0 * GAIN_DN_PER_E**2 * true_e), true_e * relative_error_of_gain())

    assert_within(result.dsnu_e, true_e, error_e)


def test_prnu_excludes_dsnu_and_temporal_noise(result):
    light_e = 0.49 * FULL_WELL_E
    spread_e, dark_spread_e = PRNU * light_e, DSNU * DARK_E
    both = error_of_spatial(
        GAIN_DN_PER_E**2 * (spread_e**2 + dark_spread_e**2), variance_dn2(light_e, DARK_E), N_FRAMES.max()
    )
    dark = error_of_spatial((GAIN_DN_PER_E * dark_spread_e) ** 2, variance_dn2(0.0, DARK_E), N_DARK)
    # The random correlation of both patterns is included in the first term.
    relative = np.hypot(both, dark) / (2.0 * (GAIN_DN_PER_E * spread_e) ** 2)

    assert_within(result.prnu_fraction, np.full(2, PRNU), PRNU * relative)


def test_saturation_is_at_maximum_variance(result):
    chosen = SOME[::5]
    parameters = {
        name: getattr(two_sizes(), name)[chosen]
        for name in ("capacitance_f", "read_noise_e", "full_well_e", "dark_e_per_s")
    }
    sensor = two_sizes(LAYOUT[chosen], **parameters)
    near = slice(20, 50)
    light_e = LIGHT_E[near, IS_LARGE[chosen].astype(int)]
    predicted = predicted_photon_transfer(
        sensor, light_e * sensor.response + sensor.dark_rate_e_per_s * EXPOSURE_S, classes=SIZE_UM[chosen]
    )
    highest = predicted.temporal_variance_dn2.max(axis=0)
    found = predicted.temporal_variance_dn2[result.transfer.saturation_level - near.start, [0, 1]]

    error = np.sqrt(2.0) * error_of_variance(highest, 2)
    # The mean response of 40 and 30 sites differs from that of all sites by a few per mille.
    assert np.all(highest - found < SIGMAS * error + 0.01 * highest)
    # Above the full well the total charge (signal and dark) does not fluctuate. Below it the variance is flat over three
    # levels of 2.3 %, so that the level found depends on the noise.
    with_dark_e = result.saturation_e + DARK_E
    assert np.all((with_dark_e > 0.9 * FULL_WELL_E) & (with_dark_e < FULL_WELL_E))
    full_dn = GAIN_DN_PER_E * FULL_WELL_E
    assert result.transfer.mean_dn[-1] == pytest.approx(full_dn - 0.5, abs=0.6)
    assert result.transfer.temporal_variance_dn2[-1] == pytest.approx((GAIN_DN_PER_E * READ_E) ** 2 + 1 / 12, rel=0.05)


def test_threshold_snr_and_dynamic_range(result):
    noise_e = np.sqrt(READ_E**2 + 1 / 12 / GAIN_DN_PER_E**2)
    error_dn2, _ = errors_of_dark_line()
    relative = np.hypot(error_dn2 / (2.0 * GAIN_DN_PER_E**2 * noise_e**2), relative_error_of_gain())

    assert_within(result.threshold_e, noise_e + 0.5, (noise_e + 0.5) * relative)
    assert_within(result.threshold_ph, (noise_e + 0.5) / QE, (noise_e + 0.5) / QE * 2 * relative)
    assert result.snr_max == pytest.approx(np.sqrt(FULL_WELL_E - DARK_E), rel=0.06)
    assert result.dynamic_range == pytest.approx((FULL_WELL_E - DARK_E) / (noise_e + 0.5), rel=0.12)
    assert result.snr_max_db == pytest.approx(10 * np.log10(result.saturation_e))
    assert result.dynamic_range_db == pytest.approx(20 * np.log10(result.saturation_e / result.threshold_e))


def test_linear_sensor_has_zero_linearity_error(result):
    faintest_e = 0.05 * FULL_WELL_E
    error = np.sqrt((faintest_e + DARK_E + READ_E**2) / (2 * N_SITES)) / faintest_e
    of_dark = np.sqrt((DARK_E + READ_E**2) / (N_DARK * N_SITES)) / faintest_e

    for deviation in (result.linearity_error_min_fraction, result.linearity_error_max_fraction):
        assert np.all(np.abs(deviation) < SIGMAS * np.hypot(error, of_dark))
    assert np.all(result.linearity_error_min_fraction < 0.0)
    assert np.all(result.linearity_error_max_fraction > 0.0)


def test_nonlinear_response_has_expected_linearity_error():
    """Reference: weighted least-squares line of a quadratic response by numpy, and its largest deviations."""
    photons = np.arange(1.0, 101.0) * 30.0
    mean = np.where(photons < 2700.0, photons * (1.0 - 0.1 * photons / 2700.0), 2430.0)
    spread = np.where(photons < 2700.0, np.sqrt(photons), 0.0)
    # Two frames whose sites deviate from the mean by plus or minus the standard deviation.
    sign = np.array([1.0, -1.0, -1.0, 1.0])
    frames = [np.stack((m + s * sign, m - s * sign)) for m, s in zip(mean, spread, strict=True)]

    with pytest.warns(FoveasimWarning, match="dark codes are 0"):
        result = emva1288(frames, [np.zeros((2, 4))], photons)

    full = mean[np.flatnonzero(photons < 2700.0)[-1]]
    x, y = photons[(mean >= 0.05 * full) & (mean <= 0.95 * full)], mean[(mean >= 0.05 * full) & (mean <= 0.95 * full)]
    slope, offset = np.polyfit(x, y, 1, w=1.0 / y)
    deviation = y / (slope * x + offset) - 1.0
    assert result.linearity_error_min_fraction[0] == pytest.approx(deviation.min(), rel=1e-9)
    assert result.linearity_error_max_fraction[0] == pytest.approx(deviation.max(), rel=1e-9)
    assert deviation.max() > 0.005


#: Photons per level for a sensor of 0.2 DN/e- and a full well capacity of 9000 e-.
LEVELS_PH = np.arange(100.0, 11_000.0, 200.0)


def frames_at_five_e_per_dn(photons, n_sites=4000):
    rng = np.random.default_rng(1)
    return [0.2 * np.minimum(rng.poisson(p, (2, n_sites)), 9000) + rng.normal(50.0, 1.0, (2, n_sites)) for p in photons]


def test_unsorted_levels_raise():
    frames, dark = frames_at_five_e_per_dn(LEVELS_PH), frames_at_five_e_per_dn([0.0])
    per_site = np.repeat(LEVELS_PH[:, None], 4000, axis=1)

    assert emva1288(frames, dark, LEVELS_PH).gain_dn_per_e[0] == pytest.approx(0.2, rel=0.02)
    for photons in (LEVELS_PH[::-1], np.r_[LEVELS_PH[1], LEVELS_PH[0], LEVELS_PH[2:]], np.minimum(LEVELS_PH, 9000.0)):
        with pytest.raises(ParameterError, match="'photons' must increase from level to level"):
            emva1288(frames[::-1], dark, photons)
    with pytest.raises(ParameterError, match="'photons' must increase from level to level"):
        emva1288(frames[::-1], dark, per_site[::-1])


def test_gain_is_independent_of_level_order():
    frames = [*frames_at_five_e_per_dn([0.0]), *frames_at_five_e_per_dn(LEVELS_PH)]
    dark = photon_transfer(frames[:1])

    rising, falling = photon_transfer(frames), photon_transfer(frames[::-1])

    assert rising.gain_dn_per_e()[0] == pytest.approx(0.2, rel=0.02)
    assert falling.gain_dn_per_e(dark)[0] == pytest.approx(rising.gain_dn_per_e(dark)[0], rel=1e-12)
    with pytest.raises(ParameterError, match="'levels' must begin with a dark level"):
        falling.gain_dn_per_e()


def test_levels_below_saturation_warn():
    faint = LEVELS_PH < 2500.0
    frames, dark = frames_at_five_e_per_dn(LEVELS_PH[faint]), frames_at_five_e_per_dn([0.0])

    with pytest.warns(FoveasimWarning, match="highest at the last level for 1 of 1 classes: saturation is not reached"):
        emva1288(frames, dark, LEVELS_PH[faint])


def test_emva_result_is_independent_of_threads():
    one, two = (measured(n_threads=n, levels=slice(0, 52, 8)) for n in (1, 2))

    for name in ("gain_dn_per_e", "qe", "dark_noise_e", "dsnu_e", "prnu_fraction", "dark_current_e_per_s"):
        assert np.array_equal(getattr(one, name), getattr(two, name)), name
    assert np.array_equal(one.transfer.temporal_variance_dn2, two.transfer.temporal_variance_dn2)


# -- confidence intervals ---------------------------------------------------------------------------------------------------

#: Two kinds of sites in each of 200 sensors, which differ in the DSNU: 40 e- and far below the noise of the mean.
N_SENSORS, N_OF_KIND = 200, 400
KINDS = np.repeat([0, 1], N_OF_KIND)
KIND = {"gain": 0.5, "qe": 0.6, "read_e": 8.0, "prnu": 0.03, "well_e": 9000.0, "dark_e": 400.0, "dark_s": 0.1}
KIND_DSNU_E = np.array([40.0, 0.2])
KIND_PH = np.linspace(800.0, 20_000.0, 25)
KIND_SERIES_S = np.array([0.02, 0.06, 0.1])


def simulated_parameters(seed):
    """Frames of a new sensor from numpy alone, on a pedestal of 100 DN; codes are integers."""
    rng = np.random.default_rng(seed)
    response = KIND["qe"] * (1.0 + KIND["prnu"] * rng.standard_normal(KINDS.size))
    dark_e_per_s = (KIND["dark_e"] + KIND_DSNU_E[KINDS] * rng.standard_normal(KINDS.size)) / KIND["dark_s"]

    def frames(n, photons, time_s):
        charge = np.minimum(rng.poisson(photons * response + dark_e_per_s * time_s, (n, KINDS.size)), KIND["well_e"])
        return np.floor(100.0 + KIND["gain"] * (charge + KIND["read_e"] * rng.standard_normal(charge.shape)))

    lit = [frames(4 if 0.4 < p / 14_300 < 0.6 else 2, p, KIND["dark_s"]) for p in KIND_PH]
    dark = [frames(6, 0.0, KIND["dark_s"])]
    series = [frames(6, 0.0, t) for t in KIND_SERIES_S]
    return emva1288(lit, dark, KIND_PH, classes=KINDS, dark_series=series, exposure_s=KIND_SERIES_S)


@pytest.fixture(scope="module")
def sensors():
    return [simulated_parameters(seed) for seed in range(N_SENSORS)]


#: Parameters with an interval that is neither simultaneous nor one-sided, and their values.
KIND_NOISE_DN2 = (KIND["gain"] * KIND["read_e"]) ** 2 + 1 / 12
KIND_THRESHOLD_E = math.sqrt(KIND_NOISE_DN2) / KIND["gain"] + 0.5
EXACT = {
    "gain_dn_per_e": KIND["gain"],
    "responsivity_dn_per_ph": KIND["gain"] * KIND["qe"],
    "qe": KIND["qe"],
    "dark_noise_dn": math.sqrt(KIND_NOISE_DN2),
    "dark_noise_e": KIND["read_e"],
    "threshold_e": KIND_THRESHOLD_E,
    "threshold_ph": KIND_THRESHOLD_E / KIND["qe"],
    "prnu_fraction": KIND["prnu"],
    "dark_current_e_per_s": KIND["dark_e"] / KIND["dark_s"],
    "dark_current_from_variance_e_per_s": KIND["dark_e"] / KIND["dark_s"],
}


def coverage(sensors, name, true, kind=0):
    limits = np.array([each.intervals[name][kind] for each in sensors])
    return np.mean((limits[:, 0] <= true) & (true <= limits[:, 1]))


#: Five standard errors of a fraction of 95 %.
COVERAGE_ERROR = SIGMAS * math.sqrt(0.95 * 0.05 / N_SENSORS)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "true"), [*EXACT.items(), ("dsnu_e", KIND_DSNU_E[0])])
def test_intervals_contain_parameter_with_stated_probability(sensors, name, true):
    assert coverage(sensors, name, true) >= 0.95 - COVERAGE_ERROR
    # They are not wider than required: 1.96 times the standard deviation of the estimates, known to 5 %.
    half = np.mean([np.ptp(each.intervals[name][0]) / 2.0 for each in sensors])
    spread = np.std([getattr(each, name)[0] for each in sensors])
    assert half / (1.96 * spread) == pytest.approx(1.0, abs=0.05 * SIGMAS + 0.03)
    assert all(each.intervals.is_resolved(name)[0] for each in sensors)


@pytest.mark.slow
def test_simultaneous_intervals_contain_parameters(sensors):
    for name in ("linearity_error_min_fraction", "linearity_error_max_fraction", "underflow_fraction"):
        assert coverage(sensors, name, 0.0) >= 0.95 - COVERAGE_ERROR, name
    # The variance of min(Poisson charge, full well), with the PRNU by quadrature, is highest at the saturation.
    nodes, weights = np.polynomial.hermite_e.hermegauss(8)
    photons = np.arange(12_000.0, 14_500.0, 50.0)
    mean_e = photons[:, None] * KIND["qe"] * (1.0 + KIND["prnu"] * nodes) + KIND["dark_e"]
    # E X = Σ P(X > k) and E X² = Σ (2 k + 1) P(X > k), for the excess over a charge that all sites have.
    least_e = 5000.0
    excess_e = np.arange(KIND["well_e"] - least_e)
    above = scipy.stats.poisson.sf(least_e + excess_e, mean_e[..., None])
    variance_e2 = above @ (2.0 * excess_e + 1.0) - above.sum(axis=-1) ** 2
    saturation_ph = photons[(variance_e2 @ weights).argmax()]
    saturation_e = KIND["qe"] * saturation_ph
    for name, true in {
        "saturation_ph": saturation_ph,
        "saturation_e": saturation_e,
        "snr_max": math.sqrt(saturation_e),
        "snr_max_db": 10.0 * math.log10(saturation_e),
        "dynamic_range": saturation_e / KIND_THRESHOLD_E,
        "dynamic_range_db": 20.0 * math.log10(saturation_e / KIND_THRESHOLD_E),
    }.items():
        assert coverage(sensors, name, true) >= 0.95 - COVERAGE_ERROR, name
    # They are a few levels wide: variances of 400 sites have errors of 7 %, and levels are 5.6 % apart.
    assert np.mean([np.ptp(each.intervals["saturation_ph"][0]) for each in sensors]) < 0.5 * saturation_ph


@pytest.mark.slow
def test_dsnu_below_noise_is_not_resolved(sensors):
    """The noise of the mean of six frames is 9 e-; a standard deviation of 0.2 e- is lost in its sample variance."""
    estimates = np.array([each.dsnu_e[1] for each in sensors])
    is_resolved = np.array([each.intervals.is_resolved("dsnu_e")[1] for each in sensors])
    limits = np.array([each.intervals["dsnu_e"][1] for each in sensors])

    # Half of the variances are estimated as negative, and the others are far too large.
    assert np.nanmax(estimates) > 8.0 * KIND_DSNU_E[1]
    assert np.isnan(estimates).sum() == pytest.approx(0.5 * N_SENSORS, abs=SIGMAS * math.sqrt(0.25 * N_SENSORS))
    assert is_resolved.mean() < 0.025 + SIGMAS * math.sqrt(0.025 / N_SENSORS)
    assert np.all(limits[~is_resolved, 0] == 0.0)
    assert coverage(sensors, "dsnu_e", KIND_DSNU_E[1], kind=1) >= 0.95 - COVERAGE_ERROR
    unresolved = sensors[int(np.flatnonzero(~is_resolved)[0])]
    assert "dsnu_e" in unresolved.records()[1]["not_resolved"].split(", ")
    assert "dsnu_e" not in unresolved.records()[0]["not_resolved"].split(", ")
    row = next(r for r in unresolved.intervals.records() if (r["class"], r["parameter"]) == (1, "dsnu_e"))
    assert (row["low"], row["is_resolved"]) == (0.0, False)
    assert "dsnu_e" in repr(unresolved.intervals)


def test_jackknife_of_mean_is_error_of_blocks():
    """The error of a mean is the standard deviation of the means of equal blocks over the root of their number."""
    rng = np.random.default_rng(0)
    frames = rng.normal(100.0, 5.0, (2, 1200))
    _, (mean, _, spatial), groups = measure_subsets([frames], classes=np.arange(1200) % 2, n_blocks=50)
    of_sites = frames.mean(axis=0)

    error = Jackknife(groups.n_blocks_of_class).error(mean)
    for kind in (0, 1):
        blocks = of_sites[kind::2].reshape(50, 12).mean(axis=1)
        assert error[0, kind] == pytest.approx(blocks.std(ddof=1) / math.sqrt(50.0), rel=1e-9)
        without = np.delete(of_sites[kind::2].reshape(50, 12), 7, axis=0)
        assert mean[8, 0, kind] == pytest.approx(without.mean(), rel=1e-12)
        noise = np.delete(frames[:, kind::2].reshape(2, 50, 12), 7, axis=1).var(axis=0, ddof=1).mean()
        assert spatial[8, 0, kind] == pytest.approx(without.var(ddof=1) - noise / 2.0, rel=1e-9)


def test_parameters_without_data_have_no_limits(result):
    faint = LEVELS_PH < 2500.0
    frames, dark = frames_at_five_e_per_dn(LEVELS_PH[faint]), frames_at_five_e_per_dn([0.0])
    with pytest.warns(FoveasimWarning, match="saturation is not reached"):
        short = emva1288(frames, dark, LEVELS_PH[faint])

    assert not short.intervals.is_measured("dark_current_e_per_s")[0]
    assert "dark_current_e_per_s" not in [row["parameter"] for row in short.intervals.records()]
    # The full well may be anywhere above the last levels.
    assert short.intervals["saturation_ph"][0, 1] == math.inf
    assert not short.intervals.is_resolved("dynamic_range")[0]
    assert set(result.intervals.limits) >= {"gain_dn_per_e", "saturation_e", "snr_max_db", "prnu_fraction"}
    assert all(limits.shape == (2, 2) for limits in result.intervals.limits.values())
    with pytest.raises(ParameterError, match=r"'name' must be a parameter, got 'dsnu'; did you mean 'dsnu_e'"):
        result.intervals["dsnu"]


# -- photon transfer ------------------------------------------------------------------------------------------------------

GRID = fs.layout.grid(n_x=200, n_y=200, pitch_um=2.0)


def capacitance_of(range_e, v_sat_v=1.0):
    return range_e * Q / v_sat_v


def test_photon_transfer_agrees_with_prediction():
    n_frames, light = 800, np.array([0.0, 100.0, 1000.0, 3000.0, 4700.0, 5200.0, 9000.0])[:, None]
    parameters = {
        name: per_site(values)[SOME]
        for name, values in (
            ("capacitance_f", CAPACITANCE_F),
            ("read_noise_e", READ_E),
            ("full_well_e", FULL_WELL_E),
            ("dark_e_per_s", DARK_E_PER_S),
        )
    }
    sensor = two_sizes(LAYOUT[SOME], pixel_fpn_fraction=0.01, **parameters)
    expected_e = light * per_site([1.0, 3.0])[SOME] * sensor.response + sensor.dark_rate_e_per_s * EXPOSURE_S

    drawn = photon_transfer(sensor, expected_e, classes=SIZE_UM[SOME], n_frames=n_frames, seed=1, n_threads=1)
    predicted = predicted_photon_transfer(sensor, expected_e, classes=SIZE_UM[SOME])

    n_sites, variance = predicted.n_sites, predicted.temporal_variance_dn2
    assert n_sites.tolist() == [200, 150]
    assert np.all(np.abs(drawn.mean_dn - predicted.mean_dn) < SIGMAS * np.sqrt(variance / (n_frames * n_sites)))
    # The formula of the standard attributes a fraction 1 / n_sites of the variance to flicker of the light source.
    error = variance * np.sqrt(2.0 / (n_sites * (n_frames - 1.0)))
    # Near the full well the noise is not Gaussian: its fourth moment is larger, by a factor below 4.
    error[4:6] *= 2.0
    assert np.all(np.abs(drawn.temporal_variance_dn2 - variance * (1.0 - 1.0 / n_sites)) < SIGMAS * error)
    # The fixed pattern is the same in both; the cross term with the temporal noise remains.
    cross = 2.0 * np.sqrt(predicted.spatial_variance_dn2 * variance / (n_frames * n_sites))
    error = np.hypot(cross, variance / n_frames * np.sqrt(2.0 / n_sites)) * 1.2
    assert np.all(np.abs(drawn.spatial_variance_dn2 - predicted.spatial_variance_dn2) < SIGMAS * error)
    assert predicted.n_frames.tolist() == [0] * 7
    assert drawn.n_frames.tolist() == [n_frames] * 7


def test_noise_slopes_of_photon_transfer_curve():
    """Log-log slopes 0, 1/2 and 1 for read noise, shot noise and PRNU (Janesick, Photon Transfer, 2007)."""
    read_e, pedestal_e, prnu, well_e = 50.0, 400.0, 0.03, 5e5
    sensor = Sensor(
        GRID,
        bits=16,
        v_sat_v=1.0,
        capacitance_f=capacitance_of(6e5),
        read_noise_e=read_e,
        prnu_fraction=prnu,
        full_well_e=well_e,
    )
    light_e = np.concatenate(([0.0], np.geomspace(3.0, 4e5, 32), [1e6]))
    curve = photon_transfer(sensor, light_e[:, None] * sensor.response + pedestal_e, n_frames=2, seed=5)
    mean_dn = (curve.mean_dn - curve.mean_dn[0])[:, 0]
    temporal, spatial = curve.temporal_variance_dn2[:, 0], curve.spatial_variance_dn2[:, 0]
    floor_e2 = read_e**2 + pedestal_e

    def slope(variance, is_used):
        return np.polyfit(np.log(light_e[is_used]), 0.5 * np.log(variance[is_used]), 1)[0]

    def error(is_used, relative_error):
        x = np.log(light_e[is_used])
        return relative_error * math.sqrt(1.0 / ((x - x.mean()) ** 2).sum())

    one_in = math.sqrt(0.5 / GRID.n_sites)  # relative error of a standard deviation from one difference per site
    is_faint = (light_e > 0.0) & (light_e < 30.0)
    is_shot = (light_e > 3e4) & (light_e < 4.1e5)
    # Shot noise adds at most 30 e-² to 2900 e-²: a slope of 0.005 at most.
    assert abs(slope(temporal, is_faint)) < 0.5 * 30.0 / floor_e2 + SIGMAS * error(is_faint, one_in)
    assert slope(temporal - temporal[0], is_shot) == pytest.approx(0.5, abs=SIGMAS * error(is_shot, 1.2 * one_in))
    # Fixed patterns are equal at all levels: only shot noise, at most 1 % of them, affects the slope.
    assert slope(spatial, is_shot) == pytest.approx(1.0, abs=SIGMAS * error(is_shot, 0.2 * one_in))
    assert np.sqrt(spatial[is_shot]) / mean_dn[is_shot] == pytest.approx(
        np.full(is_shot.sum(), prnu), rel=SIGMAS * one_in
    )
    # Beyond the full well only the read noise remains.
    gain = 65_536 / 6e5
    assert temporal[-1] == pytest.approx((gain * read_e) ** 2 + 1 / 12, rel=SIGMAS * 2 * one_in)
    assert temporal[-1] < 0.02 * temporal[-2]
    assert spatial[-1] < 1e-4 * spatial[-2]


def test_full_well_of_7000_limits_snr():
    well_e = 7000.0
    sensor = Sensor(GRID, bits=14, v_sat_v=1.0, capacitance_f=capacitance_of(8000.0), full_well_e=well_e)
    unlimited = Sensor(GRID, bits=14, v_sat_v=1.0, capacitance_f=capacitance_of(8000.0))

    at_well = photon_transfer(unlimited, [0.0, well_e], seed=2)
    ratio = (at_well.mean_dn[1] - at_well.mean_dn[0]) / np.sqrt(at_well.temporal_variance_dn2[1])
    assert ratio[0] == pytest.approx(83.7, abs=83.7 * SIGMAS * math.sqrt(0.5 / GRID.n_sites) + 0.04)
    photons = np.arange(100.0, 8000.0, 50.0)
    frames = [draw_frames(sensor, p, seed=2, first_frame=2 * k) for k, p in enumerate(photons)]
    with pytest.warns(FoveasimWarning, match=r"100.0 % of the dark codes are 0"):
        result = emva1288(frames, [draw_frames(sensor, 0.0, seed=3)], photons)
    # The variance is highest 1 to 3 times sqrt(7000) below the full well, which reduces the square root by 0.6 to 1.8 %.
    assert 83.7 * 0.98 < result.snr_max[0] < 83.7
    assert np.isnan(result.dark_current_e_per_s[0])


@pytest.mark.parametrize(("capacitance_f", "noise_e"), [(1e-15, 12.70), (1e-13, 127.0), (4.8e-13, 278.3)])
def test_reset_noise_matches_capacitance(capacitance_f, noise_e):
    sensor = Sensor(GRID, bits=16, v_sat_v=3.0, capacitance_f=capacitance_f, ktc_noise=True, shot_noise="off")
    gain = 65_536 * Q / (3.0 * capacitance_f)
    level_e = 0.5 * 65_536 / gain

    curve = photon_transfer(sensor, [level_e], seed=7)

    got_e = np.sqrt(curve.temporal_variance_dn2[0, 0] - 1 / 12) / gain
    assert noise_budget(sensor, np.zeros(GRID.n_sites), 0.0)["reset"][0] == pytest.approx(noise_e, rel=5e-4)
    assert got_e == pytest.approx(noise_e, rel=SIGMAS * math.sqrt(0.5 / GRID.n_sites) + 5e-4)


def test_quantisation_dominates_with_eight_bits():
    sensor = Sensor(GRID, bits=8, v_sat_v=3.0, capacitance_f=1e-13, ktc_noise=True, read_noise_e=1.0)
    full_e = 3.0 * 1e-13 / Q
    code_e = full_e / 256
    assert full_e == pytest.approx(1.87e6, rel=2e-3)
    assert code_e == pytest.approx(7314.0, abs=1.0)
    assert code_e / math.sqrt(12.0) == pytest.approx(2111.0, abs=1.0)

    # Over many codes, the quantisation noise is far above shot, reset and read noise together.
    expected_e = np.linspace(0.1, 0.6, GRID.n_sites) * full_e
    codes = draw_frames(sensor, expected_e, n_frames=2, seed=1)
    off_e = (codes + 0.5) * code_e - expected_e
    others_e2 = expected_e.mean() + 127.0**2 + 1.0
    assert off_e.std() == pytest.approx(math.hypot(2111.0, math.sqrt(others_e2)), rel=0.01)
    assert off_e.var() / others_e2 > 5.0
    # At the centre of a code all frames are equal: the dark noise is masked, with an upper bound of 0.40 DN.
    light = np.linspace(10.0, 300.0, 30) * code_e
    frames = [
        draw_frames(sensor, np.full(GRID.n_sites, e) + expected_e * 0.01, seed=2, first_frame=2 * k)
        for k, e in enumerate(light)
    ]
    result = emva1288(frames, [draw_frames(sensor, 10.5 * code_e, seed=9)], light)
    assert result.is_quantisation_limited[0]
    # Only upper limits of the noise and the threshold, which is 0.5 e- without noise.
    assert (result.intervals["dark_noise_e"][0, 0], result.intervals["threshold_e"][0, 0]) == (0.0, 0.5)
    assert result.intervals["dark_noise_e"][0, 1] > result.dark_noise_e[0]
    assert not result.intervals.is_resolved("dark_noise_e")[0]
    assert result.dark_noise_e[0] == pytest.approx(math.sqrt(0.24 - 1 / 12) / result.gain_dn_per_e[0])


def test_gain_and_dark_noise_from_curve():
    few = fs.layout.grid(n_x=2, n_y=1, pitch_um=2.0)
    sensor = Sensor(few, bits=14, v_sat_v=1.0, capacitance_f=capacitance_of(10_000.0), read_noise_e=10.0)
    levels_e = np.linspace(0.0, 9000.0, 31) + 400.0

    curve = predicted_photon_transfer(sensor, levels_e)

    assert curve.gain_dn_per_e()[0] == pytest.approx(1.6384, rel=1e-3)
    assert curve.dark_noise_e()[0] == pytest.approx(math.sqrt(100.0 + 400.0), rel=1e-3)


def test_temporal_variance_of_two_frames():
    """Calculated by hand; the flicker between both frames is subtracted."""
    first, second = np.array([10.0, 20.0, 30.0, 40.0]), np.array([13.0, 20.0, 33.0, 42.0])

    curve = photon_transfer([[first, second]], classes=["a", "a", "b", "b"])

    assert curve.classes.tolist() == ["a", "b"]
    assert curve.mean_dn.tolist() == [[15.75, 36.25]]
    assert curve.temporal_variance_dn2.tolist() == [[4.5 / 2 - 1.5**2 / 2, 6.5 / 2 - 2.5**2 / 2]]
    assert curve.spatial_variance_dn2[0] == pytest.approx([8.5**2 / 2 - 2.25 / 2, 9.5**2 / 2 - 3.25 / 2])


def test_photon_transfer_accepts_captures():
    scene = fs.Scene.flat(shape=(80, 80), pitch_um=60.0, distance_m=1.0, radiance_w_m2_sr_nm=0.01, band_width_nm=10.0)
    sensor = Sensor(fs.layout.grid(n_x=8, n_y=8, pitch_um=4.0), bits=10, capacitance_f=4e-15)
    camera = fs.Camera(optics=fs.Optics(focal_length_mm=8.0, f_number=2.8), sensor=sensor)
    captures = [camera.capture(scene, exposure_s=0.02, seed=1, frame=k) for k in range(3)]

    curve = photon_transfer([captures])

    codes = np.stack([capture.code for capture in captures]).astype(float)
    assert curve.mean_dn[0, 0] == pytest.approx(codes.mean())
    expected = codes.var(axis=0, ddof=1).mean() - codes.mean(axis=1).var(ddof=1)
    assert curve.temporal_variance_dn2[0, 0] == pytest.approx(expected)


# -- invalid arguments ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: photon_transfer([]), "at least one level"),
        (lambda: photon_transfer([np.zeros((1, 5))]), "at least two"),
        (lambda: photon_transfer([np.full((2, 5), np.nan)]), "finite"),
        (lambda: photon_transfer([np.zeros((2, 5)), np.zeros((2, 6))]), "5 sites"),
        (lambda: photon_transfer([np.zeros((2, 5))], classes=[0, 1, 1, 1, 1]), "two sites each"),
        (lambda: photon_transfer([np.zeros((2, 5))], classes=[0, 1]), "one value for each"),
        (lambda: photon_transfer([np.zeros((2, 5))], seed=1), "must not be given with frames"),
        (lambda: photon_transfer([3, 4]), "list of frames"),
        (lambda: emva1288(5, [np.ones((2, 4))], [1.0]), "'frames' must be a list of levels, got an int"),
        (lambda: emva1288([np.ones((2, 4))], None, [1.0]), "'dark' must be a list of levels, got a NoneType"),
        (lambda: photon_transfer(5), "'source' must be a foveasim.Sensor or a list of levels, got an int"),
        (lambda: photon_transfer(Sensor(GRID), 5.0, seed=1), "'expected_e' must be a list of levels, got 5.0 e-"),
        (lambda: predicted_photon_transfer(Sensor(GRID), np.array(5.0)), "'expected_e' must be a list of levels"),
        (lambda: photon_transfer(Sensor(GRID), [1.0]), "'seed'"),
        (lambda: photon_transfer(Sensor(GRID), seed=1), "'expected_e'"),
        (lambda: photon_transfer(Sensor(GRID), [-1.0], seed=1), ">= 0"),
        (lambda: photon_transfer(Sensor(GRID), [1.0], seed=1, n_frames=1), ">= 2"),
        (lambda: predicted_photon_transfer(Sensor(GRID), []), "at least one level"),
        (lambda: predicted_photon_transfer(Sensor(GRID), [np.ones(3)]), "40000 sites"),
        (lambda: predicted_photon_transfer(Sensor(GRID), [5.0]).gain_dn_per_e(), "must have a signal"),
        (lambda: emva1288([np.ones((2, 4))], [np.ones((2, 4))] * 2, [1.0]), "one level or 1"),
        (lambda: emva1288([np.ones((2, 4))], [np.ones((2, 4))], [1.0, 2.0]), "'photons'"),
    ],
)
def test_invalid_photon_transfer_arguments_raise(call, match):
    with pytest.raises(ParameterError, match=match):
        call()


def test_inconsistent_dark_series_raises():
    rng = np.random.default_rng(0)
    frames = [rng.normal(100.0 + m, math.sqrt(m), (2, 50)) for m in (10.0, 20.0, 30.0, 40.0)]
    arguments = {"frames": frames, "dark": [rng.normal(100.0, 1.0, (2, 50))], "photons": [10.0, 20.0, 30.0, 40.0]}

    for invalid in (
        {"exposure_s": [1.0, 2.0, 3.0]},
        {"dark_series": frames[:3]},
        {"dark_series": frames[:3], "exposure_s": [1.0, 2.0, 2.0]},
        {"dark_series": frames[:3], "exposure_s": [1.0, 2.0]},
    ):
        with pytest.raises(ParameterError, match="exposure"):
            emva1288(**arguments, **invalid)


# -- rows, columns and pixels ----------------------------------------------------------------------------------------------

#: Standard deviations of rows, columns and pixels: of the dark signal in DN, and of the response.
DARK_PARTS_DN, RESPONSE_PARTS = np.array([3.0, 2.0, 4.0]), np.array([0.006, 0.004, 0.01])
PARTS_PH = np.array([1000.0, 2000.0, 4000.0, 5000.0, 6000.0, 8000.0, 10_000.0, 11_000.0])


def pattern(rng, shape, deviations):
    """Return independent offsets of rows, columns and pixels."""
    n_y, n_x = shape
    row, column, pixel = (rng.normal(0.0, s, n) for s, n in zip(deviations, ((n_y, 1), (1, n_x), shape), strict=True))
    return row + column + pixel


def frames_of_parts(shape, *, shading=1.0, seed=0, n_frames=20, response=RESPONSE_PARTS):
    """Return frames with 0.25 DN per photon, of which 10,000 saturate, with a noise of 2 DN and shot noise, and dark frames."""
    rng = np.random.default_rng(seed)
    dark_dn, relative = 50.0 + pattern(rng, shape, DARK_PARTS_DN), 1.0 + pattern(rng, shape, response)

    def take(photons):
        mean = 0.25 * np.minimum(photons * shading * relative, 10_000.0)
        noise = rng.normal(0.0, 1.0, (n_frames, *shape))
        deviation = np.sqrt(4.0 + 0.25 * np.where(photons > 10_000.0, 0.0, mean))
        return np.rint(dark_dn + mean + deviation * noise).reshape(n_frames, -1)

    return [take(photons) for photons in PARTS_PH], [take(0.0)]


def parts_of(result, name, unit):
    return np.array([getattr(result, f"{name}_{part}_{unit}")[0] for part in ("row", "column", "pixel")])


def relative_errors(shape):
    """Relative standard errors of the deviations of rows, columns and pixels, with the other parts in the means."""
    n_y, n_x = shape
    return np.sqrt(0.5 / np.array([n_y - 1, n_x - 1, (n_y - 1) * (n_x - 1)])) * np.array([1.1, 1.1, 1.3])


def test_variances_of_rows_columns_and_pixels():
    shape = (150, 200)
    layout = fs.layout.grid(n_x=200, n_y=150, pitch_um=3.0)
    frames, dark = frames_of_parts(shape)
    result = emva1288(frames, dark, PARTS_PH, layout=layout)
    half = 0.25 * 5000.0

    gain = result.gain_dn_per_e[0]
    assert gain == pytest.approx(0.25, rel=0.01)
    errors = relative_errors(shape)
    assert np.all(np.abs(gain * parts_of(result, "dsnu", "e") / DARK_PARTS_DN - 1.0) < 4.0 * errors)
    assert np.all(
        np.abs(parts_of(result, "prnu", "fraction") / RESPONSE_PARTS - 1.0)
        < 4.0 * errors * (1.0 + DARK_PARTS_DN / (half * RESPONSE_PARTS))
    )
    assert result.dsnu_e[0] == pytest.approx(np.sqrt((parts_of(result, "dsnu", "e") ** 2).sum()), rel=0.02)
    for name, true in zip(("row", "column", "pixel"), RESPONSE_PARTS, strict=True):
        low, high = result.intervals[f"prnu_{name}_fraction"][0]
        assert low < getattr(result, f"prnu_{name}_fraction")[0] < high
        assert low < true < high
    assert result.records()[0]["prnu_row_fraction"] == result.prnu_row_fraction[0]


def test_order_of_sites_does_not_change_parts():
    shape = (20, 30)
    layout = fs.layout.grid(n_x=30, n_y=20, pitch_um=3.0)
    frames, dark = frames_of_parts(shape, n_frames=4)
    shuffled = np.random.default_rng(1).permutation(layout.n_sites)
    first = emva1288(frames, dark, PARTS_PH, layout=layout)
    other = emva1288([f[:, shuffled] for f in frames], [dark[0][:, shuffled]], PARTS_PH, layout=layout[shuffled])

    assert np.allclose(parts_of(first, "prnu", "fraction"), parts_of(other, "prnu", "fraction"), rtol=1e-9)


def test_photons_of_sites_are_no_prnu():
    # Shading of cos⁴ to 25°: a relative standard deviation of 4.6 %, for a sensor whose sites are equal.
    shape = (90, 120)
    layout = fs.layout.grid(n_x=120, n_y=90, pitch_um=3.0)
    x_um, y_um = layout.centroid_um.T
    shading = np.cos(np.arctan(np.hypot(x_um, y_um) / 480.0)) ** 4
    frames, dark = frames_of_parts(shape, shading=shading.reshape(shape), response=np.zeros(3))
    uneven = emva1288(frames, dark, PARTS_PH * shading.mean(), layout=layout)
    known = emva1288(frames, dark, PARTS_PH[:, None] * shading, layout=layout)
    filtered = emva1288(frames, dark, PARTS_PH * shading.mean(), layout=layout, highpass=True)

    assert uneven.prnu_fraction[0] == pytest.approx(shading.std() / shading.mean(), rel=0.02)
    assert known.intervals["prnu_fraction"][0, 0] < 1e-4
    assert known.intervals["prnu_fraction"][0, 1] < 2e-3
    assert filtered.intervals["prnu_fraction"][0, 1] < 3e-3
    assert np.allclose(known.dsnu_e, uneven.dsnu_e)


def test_photons_explain_areas_of_sites():
    rng = np.random.default_rng(5)
    shape, area = (60, 50), rng.uniform(0.7, 1.3, (60, 50))
    frames, dark = frames_of_parts(shape, shading=area, seed=6)
    result = emva1288(frames, dark, PARTS_PH[:, None] * area.ravel())

    assert result.prnu_fraction[0] == pytest.approx(np.sqrt((RESPONSE_PARTS**2).sum()), rel=0.1)
    with pytest.raises(ParameterError, match="'photons' must be > 0 at each site at the level of the PRNU"):
        emva1288(frames, dark, PARTS_PH[:, None] * np.append(area.ravel()[1:], 0.0))


def test_highpass_filter_recovers_parts():
    shape = (160, 180)
    layout = fs.layout.grid(n_x=180, n_y=160, pitch_um=3.0)
    x_um, y_um = layout.centroid_um.T
    shading = (1.0 - 0.3 * (x_um**2 + y_um**2) / 360.0**2).reshape(shape)
    frames, dark = frames_of_parts(shape, shading=shading, seed=2)
    result = emva1288(frames, dark, PARTS_PH * shading.mean(), layout=layout, highpass=True)

    assert np.allclose(parts_of(result, "prnu", "fraction"), RESPONSE_PARTS, rtol=0.25)
    assert result.prnu_fraction[0] == pytest.approx(np.sqrt((RESPONSE_PARTS**2).sum()), rel=0.05)
    # The filter subtracts: brighter sites count more, by the mean square of the relative shading.
    weight = np.sqrt((shading**2).mean()) / shading.mean()
    for name, true in zip(("row", "column", "pixel"), RESPONSE_PARTS, strict=True):
        low, high = result.intervals[f"prnu_{name}_fraction"][0] / weight
        assert low < true < high


@pytest.mark.parametrize("highpass", [False, True])
def test_parts_are_within_intervals(highpass):
    # 200 sensors of few rows: 95 % of intervals contain the part, with a binomial standard error of 1.5 %.
    shape, deviations = (34, 40), np.array([2.0, 3.0, 5.0])
    grid = np.arange(34 * 40).reshape(shape)
    rng = np.random.default_rng(3)
    found = []
    for _ in range(200):
        image = MeanImage(pattern(rng, shape, deviations).ravel() + rng.normal(0.0, 1.0, grid.size), np.ones(grid.size))
        parts = spatial_parts(image, grid, highpass=highpass)
        found.append((parts.variance_dn2, (parts.low_dn2 < deviations**2) & (deviations**2 < parts.high_dn2)))
    variances, is_inside = (np.array(values) for values in zip(*found, strict=True))

    errors = variances.std(axis=0) / np.sqrt(200)
    assert np.all(np.abs(variances.mean(axis=0) - deviations**2) < 4.0 * errors)
    assert np.all(is_inside.mean(axis=0) > 0.88)


def test_sites_without_rows_have_no_parts():
    layout = fs.layout.log_polar(n_sectors=30, n_rings=20, r_min_um=10.0, r_max_um=90.0)
    frames, dark = frames_of_parts((20, 30), n_frames=4)
    with pytest.warns(FoveasimWarning, match="have no parts of rows, columns and pixels: the sites of no class are in"):
        result = emva1288(frames, dark, PARTS_PH, layout=layout[np.arange(600)])
    assert np.isnan(parts_of(result, "prnu", "fraction")).all()
    assert not result.intervals.is_measured("prnu_row_fraction").any()
    with (
        pytest.raises(ParameterError, match="'highpass' needs complete rows and columns"),
        pytest.warns(FoveasimWarning),
    ):
        emva1288(frames, dark, PARTS_PH, layout=layout[np.arange(600)], highpass=True)
    with pytest.raises(ParameterError, match="'layout' must be given for a highpass filter"):
        emva1288(frames, dark, PARTS_PH, highpass=True)
    with pytest.raises(ParameterError, match="'layout' must be a layout of the 600 sites"):
        emva1288(frames, dark, PARTS_PH, layout=layout[np.arange(10)])
    grid = fs.layout.grid(n_x=30, n_y=20, pitch_um=3.0)
    with pytest.raises(ParameterError, match="'highpass' needs at least 21 rows and columns in each class"):
        emva1288(frames, dark, PARTS_PH, layout=grid, highpass=True)


def test_results_have_repr_and_are_immutable(result):
    assert repr(result) == "Emva1288(52 levels, 2 classes)"
    rows = result.records()
    assert [row["class"] for row in rows] == result.classes.tolist()
    assert [row["gain_dn_per_e"] for row in rows] == result.gain_dn_per_e.tolist()
    assert [row["dynamic_range_db"] for row in rows] == result.dynamic_range_db.tolist()
    assert "saturation / photons" in result._repr_html_()
    assert repr(result.transfer) == "PhotonTransfer(52 levels, 2 classes of 70000 sites)"
    assert "dsnu_e" in result._repr_html_()
    assert repr(result.intervals).startswith("EmvaIntervals(26 parameters, 2 classes")
    for values in (result.qe, result.intervals["qe"]):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 1.0
    with pytest.raises(ParameterError, match="shape"):
        PhotonTransfer(
            *(getattr(result.transfer, n) for n in ("classes", "n_sites", "n_frames")), *[np.zeros((1, 2))] * 3
        )

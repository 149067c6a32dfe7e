"""Sensors estimated from frames of a camera: recovery, coverage of intervals, files, and sensors afterwards."""

import copy
import dataclasses
import pickle

import numpy as np
import pytest
import tifffile
from PIL import Image
from scipy.constants import e as elementary_charge
from scipy.stats import binom
from typer.testing import CliRunner

import foveasim as fs
from foveasim.cli import app
from foveasim.sensor.effects import RowNoise
from foveasim.twin.fitting.chain import Chain
from foveasim.twin.frames.statistics import StackStatistics, sum_frames

N_Y, N_X = 48, 64
LAYOUT = fs.layout.readout_by(fs.layout.grid(n_x=N_X, n_y=N_Y, pitch_um=3.0), "column")
TIMES_S = np.arange(1, 11) * 2e-3


def numpy_stacks(gain, noise_e, black_dn, well_e, bits=12, n_frames=16):
    """Stacks of Poisson and Gaussian numbers, without the package: dark, and levels of a constant lamp above the full well."""
    rng = np.random.default_rng(7)

    def frames(signal_e, n):
        charge = np.minimum(rng.poisson(signal_e, (n, N_Y, N_X)), well_e) + rng.normal(0.0, noise_e, (n, N_Y, N_X))
        return np.clip(np.floor(gain * charge + black_dn + 0.5), 0, 2**bits - 1).astype(np.uint16)

    rate = 1.2 * well_e / TIMES_S[-1]
    dark = fs.twin.Stack(frames(0.0, 64), 1e-3, light=0)
    return [dark, *(fs.twin.Stack(frames(rate * time_s, n_frames), time_s, light=1) for time_s in TIMES_S)]


def camera_of(seed):
    """A random camera, and what a fit has to know of it."""
    rng = np.random.default_rng(seed)
    bits, companding = int(rng.integers(8, 15)), str(rng.choice(["linear", "linear", "root", "log"]))
    n_codes, well_e = 2**bits, rng.uniform(4e3, 2e4)
    gain = n_codes / well_e * rng.choice([0.83, 1.06])
    noise_e, is_cds = max(rng.uniform(2.0, 8.0), 0.7 / gain if companding == "linear" else 0.0), rng.random() < 0.5
    step_e = rng.uniform(5.0, 15.0) * noise_e if rng.random() < 0.5 else 0.0
    offset = 0.5 * noise_e * gain / n_codes
    black = (
        max((6.0 * noise_e + 0.6 * step_e) * gain / n_codes, 0.0 if companding == "linear" else 0.01) + 2.0 / n_codes
    )
    parameters = {
        "bits": bits, "companding": companding, "log_strength": 20.0, "v_sat_v": 1.0, "read_noise_e": noise_e,
        "capacitance_f": n_codes * elementary_charge / gain, "pedestal_v": black, "full_well_e": well_e, "cds": is_cds,
        "prnu_fraction": rng.uniform(0.004, 0.02), "dark_e_per_s": rng.uniform(50.0, 300.0),
        "dsnu_fraction": rng.uniform(0.2, 0.5), "nonlinearity_fraction": rng.choice([0.0, 0.02, -0.01]),
        "pixel_fpn_fraction": 0.0 if is_cds else offset, "line_fpn_fraction": offset * rng.integers(2),
        "rts_fraction": rng.uniform(0.01, 0.05) * (step_e > 0.0), "rts_e": step_e, "device_seed": seed,
    }  # fmt: skip
    effects = [RowNoise(rng.uniform(0.3, 1.0) * noise_e)] if rng.random() < 0.5 else []
    adc = {"bits": bits, "companding": companding} | ({"log_strength": 20.0} if companding == "log" else {})
    return fs.Sensor(LAYOUT, effects=effects, **parameters), adc


def stacks_of(sensor, seed=0, n_frames=16):
    """
    Dark stacks of three exposure times, and flat stacks beyond the full well; the top row of frames is the last one.

    They use the 24 seeds from ``seed``.
    """

    def frames(rate, exposure_s, n, own):
        return np.stack(
            [
                sensor.expose(np.array([rate]), exposure_s, seed=own, frame=k)[2].reshape(N_Y, N_X)[::-1]
                for k in range(n)
            ]
        )

    rate = float(np.max(sensor.full_well_e)) * 1.3 / 0.02
    dark = [(2e-3, 4 * n_frames), (0.1, n_frames), (0.5, n_frames)]
    stacks = [fs.twin.Stack(frames(0.0, time_s, n, seed + k), time_s, light=0) for k, (time_s, n) in enumerate(dark)]
    return [
        *stacks,
        *(
            fs.twin.Stack(frames(rate, time_s, n_frames, seed + 10 + k), time_s, light=1)
            for k, time_s in enumerate(0.02 * np.arange(1, 15) / 14)
        ),
    ]


def truth_of(sensor):
    """Parameters of a sensor in the terms of a twin; the black level is that of its sites."""
    n_codes = 2**sensor.bits
    gain = n_codes * elementary_charge / float(np.max(sensor.capacitance_f))
    patterns = {effect.name for effect in sensor.chain} & {"pixel_fpn", "column_fpn"}
    offset = sum(float(sensor.pattern(name).mean()) for name in patterns)
    names = ("read_noise_e", "prnu_fraction", "dark_e_per_s", "dsnu_fraction", "full_well_e", "nonlinearity_fraction")
    found = {name: float(np.max(getattr(sensor, name))) for name in (*names, "rts_fraction", "rts_e")} | {
        "gain_dn_per_e": gain,
        "black_level_dn": (sensor.pedestal_v + offset) * n_codes - 0.5,
        "dsnu_column_e": sensor.line_fpn_fraction * n_codes / gain,
        "row_noise_e": sensor.effects[0].noise_e if sensor.effects else 0.0,
    }
    if not sensor.cds:
        found["dsnu_e"] = sensor.pixel_fpn_fraction * n_codes / gain
    return found


@pytest.fixture(scope="module")
def stacks():
    return numpy_stacks(0.4, 4.0, 60.0, 8000.0)


@pytest.fixture(scope="module")
def twin(stacks):
    return fs.twin.fit(stacks, bits=12, pixel_um=3.0)


def test_numpy_frames_are_recovered(twin):
    """Intervals of 99.99 %, twice those of 95 %, contain the numbers of the draw."""
    for name, value in (
        ("gain_dn_per_e", 0.4), ("read_noise_e", 4.0), ("black_level_dn", 60.0), ("full_well_e", 8000.0),
        ("nonlinearity_fraction", 0.0),
    ):  # fmt: skip
        found = twin.estimates[name]
        assert abs(found.value - value) <= 2.0 * max(found.high - found.value, found.value - found.low), name
    assert twin.estimates["gain_dn_per_e"].high / twin.estimates["gain_dn_per_e"].low < 1.02
    assert twin.estimates["full_well_e"].high / twin.estimates["full_well_e"].low < 1.02
    assert twin.chi_square_ratio < 2.0


def test_missing_dark_series_is_said(twin):
    for name in ("dark_e_per_s", "dsnu_fraction", "hot_fraction"):
        assert "two exposure times" in twin.not_identifiable[name]
    assert any("dark current is part of the black level" in text for text in twin.assumptions)


def test_level_with_few_pixels_below_full_well():
    """Its variance is that of the few pixels of low response, which no equally probable pixels represent."""
    rng = np.random.default_rng(3)
    response = 1.0 + 0.01 * rng.normal(size=(96, 64))

    def frames(signal_e, n=8):
        charge = np.minimum(rng.poisson(signal_e * response, (n, *response.shape)), 30_000)
        return np.rint(1.5 * (charge + rng.normal(0.0, 2.0, charge.shape)) + 100.0).astype(np.uint16)

    stacks = [fs.twin.Stack(frames(0.0, 32), 1e-3, light=0)]
    stacks += [fs.twin.Stack(frames(3.12e6 * time_s), time_s, light=1) for time_s in 1e-3 * np.arange(1, 12)]
    found = fs.twin.fit(stacks, bits=16, pixel_um=3.0)

    assert found.chi_square_ratio < 2.0
    for name, value in (("gain_dn_per_e", 1.5), ("read_noise_e", 2.0), ("full_well_e", 30_000.0)):
        each = found.estimates[name]
        assert abs(each.value - value) < each.high - each.low, name


def test_unknown_light_is_enough_for_the_gain():
    """Photon transfer needs no exposure times: each level has its own charge."""
    known = numpy_stacks(0.4, 4.0, 60.0, 8000.0)
    unknown = [known[0], *(fs.twin.Stack(each.frames, 0.01) for each in known[1:])]
    found = fs.twin.fit(unknown, bits=12, pixel_um=3.0)

    assert found.estimates["gain_dn_per_e"].value == pytest.approx(0.4, rel=0.01)
    assert found.estimates["read_noise_e"].value == pytest.approx(4.0, rel=0.02)


def test_levels_of_unknown_light_may_be_full():
    """One level is barely above the full well: a tenth of its pixels are not full."""
    rng = np.random.default_rng(2)
    response = 1.0 + 0.02 * rng.standard_normal((N_Y, N_X))

    def frames(signal_e, n=24):
        charge = np.minimum(rng.poisson(signal_e * response, (n, N_Y, N_X)), 8000)
        return np.rint(0.4 * (charge + rng.normal(0.0, 5.0, charge.shape)) + 60.0).astype(np.uint16)

    fractions = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.03, 1.15, 1.3)
    stacks = [fs.twin.Stack(frames(0.0, 48), 1e-3, light=0)]
    stacks += [fs.twin.Stack(frames(8000.0 * fraction), 1e-3) for fraction in fractions]
    found = fs.twin.fit(stacks, bits=12, pixel_um=3.0)

    assert found.chi_square_ratio < 3.0
    for name, value in (("gain_dn_per_e", 0.4), ("read_noise_e", 5.0), ("full_well_e", 8000.0)):
        each = found.estimates[name]
        assert abs(each.value - value) < each.high - each.low, name


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "frames_seed"), [(43106, 45106), (43126, 43126)])
def test_full_companded_levels_end_the_search(seed, frames_seed):
    """
    Gain and nonlinearity of unknown light are a valley of the likelihood, and its end is not its shallow part.

    Wide codes of full pixels without noise are steps of the full well, which differences of a code width cross.
    """
    sensor, adc = camera_of(seed)
    stacks = [
        each if each.is_dark else fs.twin.Stack(each.frames, each.exposure_s) for each in stacks_of(sensor, frames_seed)
    ]
    found, truth = fs.twin.fit(stacks, pixel_um=3.0, **adc), truth_of(sensor)

    assert found.chi_square_ratio < 2.0
    for name in ("gain_dn_per_e", "nonlinearity_fraction", "full_well_e", "read_noise_e"):
        each = found.estimates[name]
        assert abs(each.value - truth[name]) < each.high - each.low, name


def test_photons_give_the_quantum_efficiency():
    known = numpy_stacks(0.4, 4.0, 60.0, 8000.0)
    charges = 1.2 * 8000.0 * TIMES_S / TIMES_S[-1]
    lit = [
        fs.twin.Stack(each.frames, 0.01, photons=charge / 0.6) for each, charge in zip(known[1:], charges, strict=True)
    ]
    found = fs.twin.fit([known[0], *lit], bits=12, pixel_um=3.0)

    assert found.estimates["qe"].value == pytest.approx(0.6, rel=0.01)
    assert found.sensor().qe == found.value("qe")


def test_dark_current_doubles_with_temperature():
    """Three temperatures, 8 K apart: the current of the lowest one, and the rise that doubles it."""
    rng = np.random.default_rng(5)

    def frames(signal_e):
        charge = rng.poisson(signal_e, (16, N_Y, N_X)) + rng.normal(0.0, 4.0, (16, N_Y, N_X))
        return np.rint(0.4 * charge + 60.0).astype(np.uint16)

    stacks = [
        fs.twin.Stack(frames(50.0 * 2.0 ** ((kelvin - 300.0) / 8.0) * time_s), time_s, light=0, temperature_k=kelvin)
        for kelvin in (300.0, 308.0, 316.0)
        for time_s in (0.01, 1.0)
    ]
    lit = [fs.twin.Stack(frames(900.0 * k + 0.5), 0.01, temperature_k=300.0) for k in range(1, 9)]
    found = fs.twin.fit([*stacks, *lit], bits=12, pixel_um=3.0)

    assert found.estimates["dark_doubling_k"].value == pytest.approx(8.0, rel=0.03)
    assert found.estimates["dark_e_per_s"].value == pytest.approx(50.0, rel=0.03)
    sensor = found.sensor()
    assert (sensor.temperature_k, sensor.dark_reference_k) == (300.0, 300.0)


def test_dark_currents_beside_row_noise_and_saturation():
    """Row noise does not widen the spread of dark currents; hot pixels that fill their wells count by shorter exposures."""
    rng = np.random.default_rng(11)
    log = np.sqrt(np.log1p(0.3**2))
    dark = 100.0 * np.exp(log * rng.normal(size=(N_Y, N_X)) - 0.5 * log**2)
    hot = rng.choice(N_X * N_Y, 30, replace=False)
    dark.flat[hot] += 15e3

    def frames(light_e, time_s, n=16):
        charge = np.minimum(rng.poisson(light_e + dark * time_s, (n, N_Y, N_X)), 6000) + rng.normal(
            0.0, 4.0, (n, N_Y, N_X)
        )
        return np.rint(0.6 * (charge + rng.normal(0.0, 8.0, (n, N_Y, 1))) + 60.0).astype(np.uint16)

    stacks = [
        fs.twin.Stack(frames(0.0, time_s, n), time_s, light=0) for time_s, n in ((1e-3, 64), (0.1, 16), (0.5, 16))
    ]
    stacks += [fs.twin.Stack(frames(3e5 * time_s, time_s), time_s, light=1) for time_s in TIMES_S[:-1]]
    found = fs.twin.fit(stacks, bits=12, pixel_um=3.0)

    spread, excess = found.estimates["dsnu_fraction"], found.estimates["hot_e_per_s"]
    assert abs(spread.value - 0.3) < spread.high - spread.low < 0.05
    assert found.estimates["hot_fraction"].value == 30 / (N_X * N_Y)
    assert abs(excess.value - 15e3) < excess.high - excess.low < 300.0
    np.testing.assert_allclose(found.maps["dark_e_per_s"].flat[hot], dark.flat[hot], rtol=0.02)


def test_dark_current_is_no_telegraph_noise():
    """Dark currents of 100 e-/s with a spread of 30 % at 10 ms: no RTS noise, and no PRNU of flats at 40 ms."""
    rng = np.random.default_rng(15)
    log = np.sqrt(np.log1p(0.3**2))
    dark = 400.0 * np.exp(log * rng.normal(size=(N_Y, N_X)) - 0.5 * log**2)
    response = 1.0 + 0.01 * rng.normal(size=(N_Y, 1)) + 0.004 * rng.normal(size=(N_Y, N_X))

    def frames(light_e, time_s, n=16):
        charge = rng.poisson(light_e * response + dark * time_s, (n, N_Y, N_X)) + rng.normal(0.0, 2.0, (n, N_Y, N_X))
        return np.rint(0.6 * charge + 60.0).astype(np.uint16)

    stacks = [
        fs.twin.Stack(frames(0.0, time_s, n), time_s, light=0) for time_s, n in ((1e-2, 64), (0.1, 16), (0.5, 16))
    ]
    stacks += [fs.twin.Stack(frames(500.0 * k, 0.01 * k), 0.01 * k, light=1) for k in range(1, 11)]
    found = fs.twin.fit(stacks, bits=12, pixel_um=3.0)

    assert "rts_fraction" in found.not_identifiable
    for name, value in (
        ("read_noise_e", 2.0),
        ("gain_dn_per_e", 0.6),
        ("prnu_fraction", 0.004),
        ("dark_e_per_s", 400.0),
    ):
        each = found.estimates[name]
        assert abs(each.value - value) < each.high - each.low, name
    rows = found.estimates["prnu_row_fraction"]
    assert abs(rows.value - 0.01) < rows.high - rows.low < 0.005
    assert found.estimates["prnu_column_fraction"].low == 0.0 < found.estimates["prnu_column_fraction"].high < 1e-3
    assert found.chi_square_ratio < 2.5


def test_hidden_spread_of_currents_is_limited():
    """Equal currents of all pixels: the interval begins at 0."""
    rng = np.random.default_rng(12)

    def frames(signal_e):
        charge = rng.poisson(signal_e, (16, N_Y, N_X)) + rng.normal(0.0, 4.0, (16, N_Y, N_X))
        return np.rint(0.4 * charge + 60.0).astype(np.uint16)

    stacks = [fs.twin.Stack(frames(50.0 * time_s), time_s, light=0) for time_s in (0.01, 1.0)]
    stacks += [fs.twin.Stack(frames(900.0 * k), 0.01) for k in range(1, 9)]
    found = fs.twin.fit(stacks, bits=12, pixel_um=3.0).estimates["dsnu_fraction"]

    assert found.low == 0.0
    assert found.value <= found.high < 0.05


@pytest.mark.parametrize("companding", ["linear", "root", "log"])
def test_steps_of_telegraph_noise_are_charges(companding):
    """Two states of a pixel, 60 e- apart, in codes of any transfer function."""
    rng = np.random.default_rng(13)
    is_telegraph = rng.random((N_Y, N_X)) < 0.05

    def frames(signal_e, n=16):
        charge = rng.poisson(signal_e, (n, N_Y, N_X)) + rng.normal(0.0, 4.0, (n, N_Y, N_X))
        charge += np.where(is_telegraph, rng.choice([-30.0, 30.0], (n, N_Y, N_X)), 0.0)
        part = np.clip((charge + 100.0) / 10e3, 0.0, 1.0)
        code = {"linear": part, "root": np.sqrt(part), "log": np.log1p(20.0 * part) / np.log(21.0)}[companding]
        return np.minimum(4096 * code, 4095).astype(np.uint16)

    stacks = [fs.twin.Stack(frames(0.0, 64), 1e-3, light=0)]
    stacks += [fs.twin.Stack(frames(9e3 * k / 12), 1e-3 * k, light=1) for k in range(1, 13)]
    adc = {"log_strength": 20.0} if companding == "log" else {}
    found = fs.twin.fit(stacks, bits=12, pixel_um=3.0, companding=companding, **adc)

    assert found.estimates["rts_e"].value == pytest.approx(60.0, rel=0.02)
    assert found.estimates["rts_fraction"].value == pytest.approx(is_telegraph.mean(), rel=0.1)


@pytest.mark.parametrize("deviation_dn", [0.0, 0.3])
def test_offsets_of_codes_are_not_read_noise(deviation_dn):
    """Each column moves the samples of each code by its own offset (Gaussian), which is DNL."""
    rng = np.random.default_rng(14)
    n_y, n_x = 512, 16
    offset = rng.normal(0.0, 1.0, (n_x, 4096)) * deviation_dn

    def frames(signal_e, n=16):
        charge = rng.poisson(signal_e, (n, n_y, n_x)) + rng.normal(0.0, 4.0, (n, n_y, n_x))
        value = 0.4 * charge + 60.5
        return np.floor(value + offset[np.arange(n_x), np.floor(value).astype(int)]).astype(np.uint16)

    stacks = [fs.twin.Stack(frames(0.0), 1e-3, light=0)]
    stacks += [fs.twin.Stack(frames(900.0 * k), 1e-3 * k, light=1) for k in range(1, 9)]
    found = fs.twin.fit(stacks, bits=12, pixel_um=3.0)

    each, noise = found.estimates["dnl_dn"], found.estimates["read_noise_e"]
    assert abs(each.value - deviation_dn) < each.high - each.low < 0.06
    assert (each.low > 0.0) == (deviation_dn > 0.0)
    assert abs(noise.value - 4.0) < noise.high - noise.low < 0.2
    assert found.sensor().dnl_dn == (each.value if deviation_dn else 0.0)


def test_few_frames_have_no_offsets_of_codes(twin):
    assert "25 samples of each code" in twin.not_identifiable["dnl_dn"]


def test_colours_of_a_mosaic_share_the_electronics():
    """Levels of red, green and blue differ; gain and noise are those of all, and the top left pixel is red."""
    rng = np.random.default_rng(6)
    colour = np.tile([[1.0, 0.7], [0.7, 0.4]], (N_Y // 2, N_X // 2))

    def frames(signal_e, n=16):
        charge = rng.poisson(signal_e * colour, (n, N_Y, N_X)) + rng.normal(0.0, 4.0, (n, N_Y, N_X))
        return np.rint(0.4 * charge + 60.0).astype(np.uint16)

    stacks = [fs.twin.Stack(frames(0.0, 32), 1e-3, light=0)]
    stacks += [fs.twin.Stack(frames(4e5 * time_s), time_s, light=1) for time_s in TIMES_S]
    found = fs.twin.fit(stacks, bits=12, pixel_um=3.0, mosaic="RGGB")

    for name, value in (("gain_dn_per_e", 0.4), ("read_noise_e", 4.0)):
        assert found.estimates[name].value == pytest.approx(value, rel=0.02)
    assert found.estimates["prnu_fraction"].value < 2e-3
    light_e = {row["class"]: row["light_e"] for row in found.levels if row["stack"] == "stack 10"}
    np.testing.assert_allclose([light_e[k] for k in range(4)], [8000.0, 5600.0, 5600.0, 3200.0], rtol=0.02)
    channel = found.layout().channel.reshape(N_Y, N_X)[::-1]  # the top row first
    np.testing.assert_array_equal(channel[:2, :2], [[0, 1], [1, 2]])
    assert found.sensor(filters="rgb").n_filters == 3
    assert any("give filters" in text for text in found.assumptions)


def test_colours_with_defects_are_independent():
    """Classes of different numbers of pixels: a sensor without a mosaic has four equal colours, and the same parameters."""
    sensor, adc = camera_of(4)
    sensor = dataclasses.replace(sensor, hot_fraction=0.01, hot_e_per_s=5e3)
    stacks, truth = stacks_of(sensor), truth_of(sensor)
    one, four = (fs.twin.fit(stacks, pixel_um=3.0, mosaic=mosaic, **adc) for mosaic in (None, "RGGB"))
    assert 0.0 < one.estimates["hot_fraction"].value == four.estimates["hot_fraction"].value

    for name in ("gain_dn_per_e", "read_noise_e", "prnu_fraction"):
        interval = four.estimates[name].high - four.estimates[name].low
        assert four.estimates[name].value == pytest.approx(truth[name], abs=interval)
        assert interval == pytest.approx(one.estimates[name].high - one.estimates[name].low, rel=0.5)


def test_quantisation_hides_noise():
    found = fs.twin.fit(numpy_stacks(0.02, 4.0, 3.3, 8000.0, bits=8), bits=8, pixel_um=3.0)

    assert "quantisation hides" in found.not_identifiable["read_noise_e"]
    assert found.estimates["gain_dn_per_e"].value == pytest.approx(0.02, rel=0.05)


@pytest.mark.slow
@pytest.mark.nightly
def test_intervals_contain_parameters_of_random_cameras():
    """Each parameter, and all of them, as often as binomial numbers of 95 % allow."""
    hits: dict[str, list[bool]] = {}
    for seed in range(40):
        sensor, adc = camera_of(seed)
        found, truth = fs.twin.fit(stacks_of(sensor, 24 * seed), pixel_um=3.0, **adc), truth_of(sensor)
        for name, value in truth.items():
            if name in found.estimates and (value or not name.startswith("rts")):
                each = found.estimates[name]
                hits.setdefault(name, []).append(each.low <= value <= each.high)
            elif name not in found.estimates:
                assert found.not_identifiable[name]
    for name, each in hits.items():
        assert binom.cdf(sum(each), len(each), 0.95) > 1e-4, (name, sum(each), len(each))
    assert 0.93 <= np.mean(np.concatenate(list(hits.values()))) <= 0.98


def test_moments_of_many_bits_need_few_codes():
    """The chain predicts fewer codes than a sensor of 16 bits, whose noise covers 16 of them, and the same moments."""
    values = {"gain_dn_per_e": 4.0, "read_noise_e2": 16.0, "black_level_dn": 300.3, "full_well_e": 14_000.0}
    charges_e = np.array([0.0, 10.0, 3000.0, 13_800.0, 15_500.0])
    found = Chain({"bits": 16}, 5).moments(values, charges_e, np.zeros(5))
    sensor = fs.Sensor(
        fs.layout.grid(n_x=5, n_y=1, pitch_um=1.0), bits=16, gain_dn_per_e=4.0, v_sat_v=1.0, read_noise_e=4.0,
        pedestal_v=300.8 / 2**16, full_well_e=14_000.0,
    )  # fmt: skip
    mean_dn, variance_dn2 = sensor.predict(charges_e)

    np.testing.assert_allclose(found.mean_dn, mean_dn, rtol=1e-9)
    np.testing.assert_allclose(found.variance_dn2, variance_dn2, rtol=1e-7)


def test_row_noise_is_not_noise_of_pixels():
    """Mean squares of rows and pixels, by their definition over residuals."""
    rng = np.random.default_rng(3)
    codes = np.rint(
        100.0 + rng.normal(0.0, 4.0, (8, 12, 10)) + rng.normal(0.0, 3.0, (8, 12, 1)) + rng.normal(0.0, 2.0, (8, 1, 10))
    ).astype(np.uint16)
    found = StackStatistics.of(sum_frames("stack", codes))
    off = codes - codes.mean(axis=0)
    row, column, frame = off.mean(axis=2), off.mean(axis=1), off.mean(axis=(1, 2))
    left = off - row[:, :, None] - column[:, None, :] + frame[:, None, None]

    squares = found.mean_squares_dn2
    assert squares["row"] == pytest.approx(10 * ((row - frame[:, None]) ** 2).sum() / (7 * 11))
    assert squares["column"] == pytest.approx(12 * ((column - frame[:, None]) ** 2).sum() / (7 * 9))
    assert squares["pixel"] == pytest.approx((left**2).sum() / (7 * 11 * 9))


def test_sensor_has_the_maps_of_the_camera():
    """Sites of the fitted sensor correlate with those of the camera, also in their order."""
    camera = fs.Sensor(
        LAYOUT, bits=12, v_sat_v=1.0, capacitance_f=4096 * elementary_charge / 0.4, read_noise_e=4.0, pedestal_v=0.02,
        full_well_e=9000.0, prnu_fraction=0.02, dsnu_e=6.0, dark_e_per_s=200.0, dsnu_fraction=0.5,
    )  # fmt: skip
    found = fs.twin.fit(stacks_of(camera), bits=12, pixel_um=3.0).sensor()
    light_e = np.full(LAYOUT.n_sites, 4000.0)
    codes, wanted = (
        np.mean([each.expose(light_e, 1.0, seed=9, frame=k)[2] for k in range(32)], axis=0) for each in (found, camera)
    )

    assert np.corrcoef(codes, wanted)[0, 1] > 0.95
    assert codes.mean() == pytest.approx(wanted.mean(), rel=5e-3)  # the error of the gain
    assert codes.std() == pytest.approx(wanted.std(), rel=0.05)


def test_sensor_works_where_others_do(twin):
    sensor = twin.sensor()
    copies = pickle.loads(pickle.dumps(sensor)), copy.deepcopy(sensor)
    optics = fs.Optics(focal_length_mm=5.0, f_number=4.0)
    scene = fs.Scene.flat(
        shape=(64, 64),
        pitch_um=800.0,
        radiance_w_m2_sr_nm=0.02,
        distance_m=1.0,
        wavelength_nm=550.0,
        band_width_nm=10.0,
    )
    captures = [
        fs.Camera(optics=optics, sensor=each).capture(scene, exposure_s=0.01, seed=1) for each in (sensor, *copies)
    ]

    for capture in captures[1:]:
        np.testing.assert_array_equal(capture.code, captures[0].code)
    mean_dn, variance_dn2 = sensor.predict(np.full(sensor.layout.n_sites, 1000.0))
    assert np.all(variance_dn2 > 0.0)
    assert mean_dn.mean() == pytest.approx(460.0, rel=0.02)
    restored = fs.Sensor.from_settings(sensor.layout, captures[0].settings["sensor"], sensor.arrays)
    np.testing.assert_array_equal(restored.predict(np.full(sensor.layout.n_sites, 1000.0))[0], mean_dn)


def test_other_layouts_scale_with_area(twin):
    large = twin.sensor(fs.layout.grid(n_x=4, n_y=4, pitch_um=6.0))

    np.testing.assert_allclose(large.full_well_e, 4.0 * twin.value("full_well_e"), rtol=1e-12)
    assert large.linearise(np.full(16, 100.0)).gain_dn_per_e == pytest.approx(0.25 * twin.value("gain_dn_per_e"))
    assert large.read_noise_e == twin.value("read_noise_e")


def test_twins_are_read_as_written(twin, tmp_path):
    twin.save(tmp_path / "twin.npz")
    found = fs.twin.read_twin(tmp_path / "twin.npz")

    assert found.estimates == twin.estimates
    assert found.records()[0] == twin.records()[0]
    np.testing.assert_array_equal(found.maps["offset_e"], twin.maps["offset_e"])
    np.testing.assert_array_equal(
        found.sensor().predict(np.full(N_X * N_Y, 50.0)), twin.sensor().predict(np.full(N_X * N_Y, 50.0))
    )
    with pytest.raises(fs.errors.FileError, match="not a valid foveasim twin"):
        fs.twin.read_twin(__file__)


def test_report_names_parameters_and_reasons(twin, tmp_path):
    twin.write(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()

    for part in ("system gain K", "two exposure times", "Photon transfer", "95 % interval"):
        assert part in page
    assert {path.suffix for path in twin.write_figures(tmp_path)} == {".pdf"}


# -- files ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(stacks, tmp_path):
    for k, stack in enumerate((stacks[0], *stacks[3:9:2])):
        kind = "dark" if stack.is_dark else "flat"
        directory = tmp_path / "frames" / f"{kind}_{1e3 * stack.exposure_s:g}ms"
        directory.mkdir(parents=True)
        for n, frame in enumerate(stack.frames[:4]):
            if k == 1:
                np.save(directory / f"{n}.npy", frame)
            else:
                tifffile.imwrite(directory / f"{n}.tif", frame, photometric="minisblack")
    return tmp_path / "frames"


def test_folder_equals_arrays(folder, stacks, tmp_path):
    found = fs.twin.read_stacks(folder)
    assert (found[0].is_dark, found[0].exposure_s) == (True, 1e-3)
    codes = list(found[1])
    np.testing.assert_array_equal(
        codes, next(each.frames[:4] for each in stacks if each.exposure_s == found[1].exposure_s)
    )
    (folder / "stacks.yaml").write_text(
        "stacks:\n  - {frames: 'dark_1ms/*.tif', exposure_s: 0.001, light: 0}\n"
        "  - {frames: 'flat*/*', exposure_s: 0.01, photons: 500}\n"
    )
    listed = fs.twin.read_stacks(folder)
    assert [each.photons for each in listed] == [None, 500.0]


def test_png_and_raw_files_are_codes(tmp_path):
    codes = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    Image.fromarray(codes).save(tmp_path / "a.png")
    mosaic = [(33421, "H", 2, (2, 2), True), (33422, "B", 4, bytes([0, 1, 1, 2]), True)]
    camera = [(271, "s", 0, "Test", True), (272, "s", 0, "Camera", True), (50706, "B", 4, bytes([1, 4, 0, 0]), True)]
    tags = [*mosaic, *camera, (50717, "H", 1, 65_535, True)]
    tifffile.imwrite(tmp_path / "b.dng", codes, photometric=32803, extratags=tags, metadata=None)
    pytest.importorskip("rawpy")

    for stored in fs.twin.Stack([tmp_path / "a.png", tmp_path / "b.dng"], 0.01, light=0):
        np.testing.assert_array_equal(stored, codes)


def test_interrupted_fit_resumes(folder, tmp_path):
    """Sums of stacks that have been read are used again, without their frames."""
    whole = fs.twin.fit(folder, bits=12, pixel_um=3.0)

    def stop(done, n):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fs.twin.fit(folder, bits=12, pixel_um=3.0, resume=tmp_path / "sums", progress=stop)
    assert len(list((tmp_path / "sums").glob("*.npz"))) == 3
    found = fs.twin.fit(folder, bits=12, pixel_um=3.0, resume=tmp_path / "sums")
    assert found.estimates == whole.estimates


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("truncated", "0.tif: is corrupt or truncated"),
        ("sizes", "must have the same size, but dark_1ms has frames of 64 x 48 pixels and 64 x 47 pixels"),
        ("jpeg", "JPEG files are lossy"),
        ("single", "must be at least two per stack, but dark_1ms has 1"),
        ("bits", "'bits' must be those of the codes: flat.* has the code [0-9]*, got 8"),
        ("no dark", "must contain a stack of dark frames"),
        ("no light", "must contain stacks with light"),
        ("shifted", "the codes are multiples of 16: divide them by it"),
    ],
)
def test_wrong_folders_are_explained(folder, change, message, tmp_path):
    dark, bits = folder / "dark_1ms", 8 if change == "bits" else 12
    first = dark / "0.tif"
    if change == "truncated":
        first.write_bytes(first.read_bytes()[:-4000])
    elif change == "sizes":
        tifffile.imwrite(dark / "1.tif", np.zeros((47, 64), np.uint16), photometric="minisblack")
    elif change == "jpeg":
        first.write_bytes(b"\xff\xd8\xff\xe0" + first.read_bytes())
    elif change == "shifted":
        for path in dark.iterdir():
            tifffile.imwrite(path, 16 * tifffile.imread(path) + np.uint16(8192), photometric="minisblack")
    for path in sorted(dark.iterdir())[1:] if change == "single" else ():
        path.unlink()
    if change in ("no dark", "no light"):
        for path in folder.glob("dark*" if change == "no dark" else "flat*"):
            path.rename(path.with_name("other_" + path.name))
    with pytest.raises(fs.FoveasimError, match=message) as caught:
        fs.twin.fit(folder, bits=bits, pixel_um=3.0)
    assert "\n" not in str(caught.value)


def test_bits_are_checked_when_a_fit_resumes(folder, tmp_path):
    fs.twin.fit(folder, bits=12, pixel_um=3.0, resume=tmp_path / "sums")
    with pytest.raises(fs.errors.ParameterError, match="'bits' must be those of the codes"):
        fs.twin.fit(folder, bits=8, pixel_um=3.0, resume=tmp_path / "sums")


def test_command_leaves_nothing_after_an_error(folder, tmp_path):
    found = CliRunner().invoke(
        app, ["twin", str(folder), "--bits", "8", "--pixel-um", "3", "--out", str(tmp_path / "out")]
    )

    assert isinstance(found.exception, fs.errors.ParameterError)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frames"]


def test_temperatures_belong_to_all_stacks(stacks):
    warm = fs.twin.Stack(stacks[0].frames, 1e-3, light=0, temperature_k=310.0)
    with pytest.raises(fs.errors.ParameterError, match="'temperature_k' must be given for all stacks, or for none"):
        fs.twin.fit([warm, *stacks[1:]], bits=12, pixel_um=3.0)


@pytest.mark.parametrize(
    ("shape", "bits", "message"),
    [
        ((8, 16, 16), 1, "dark frames below the highest code"),
        ((8, 1, 16), 12, "at least 4 rows and columns, got 16 x 1"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*of the codes of stack 0 are 0")
def test_frames_without_statistics_are_explained(shape, bits, message):
    rng = np.random.default_rng(1)

    def frames(probability):
        return rng.binomial(2**bits - 1, probability, shape).astype(np.uint16)

    stacks = [fs.twin.Stack(frames(0.1), 0.01, light=0)]
    stacks += [fs.twin.Stack(frames(0.2 * k), 0.01 * k, light=1) for k in (1, 2, 3, 4)]
    with pytest.raises(fs.errors.ParameterError, match=message):
        fs.twin.fit(stacks, bits=bits, pixel_um=3.0)


def test_clipped_dark_frames_are_reported():
    stacks = numpy_stacks(0.4, 4.0, 0.3, 8000.0)
    with pytest.warns(fs.errors.FoveasimWarning, match="of the codes of stack 0 are 0"):
        fs.twin.fit(stacks, bits=12, pixel_um=3.0)


def test_folder_without_stacks_is_an_error(tmp_path):
    with pytest.raises(fs.errors.FileError, match="contains no stacks"):
        fs.twin.read_stacks(tmp_path)

"""SNR by class: closed forms, simulated frames against predictions, and sensitivity thresholds."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.metrics import (
    METRICS,
    SnrTable,
    measured_snr_by_class,
    relative_exposure_at_snr_fraction,
    size_classes_um,
    snr_by_class,
)
from foveasim.sensor import linearise, signal_to_noise
from foveasim.units import volts_to_electrons
from foveasim.view import plot_capture
from foveasim.view.web._content import content_of

ZONES = fs.layout.zones(side_um=(40, 80, 160), pitch_um=(1, 2, 4))
EXPOSURE_S = 0.01
OPTICS = fs.Optics(focal_length_mm=10.0, f_number=4.0)


def flat(radiance=0.02):
    return fs.Scene.flat(
        shape=(60, 60), pitch_um=200.0, distance_m=0.5, radiance_w_m2_sr_nm=radiance, band_width_nm=10.0
    )


def camera(**options):
    sensor = {"bits": 12, "capacitance_f": 1.5e-15, "v_sat_v": 1.0, "read_noise_e": 5.0, "pedestal_v": 0.02}
    return fs.Camera(optics=OPTICS, sensor=fs.Sensor(ZONES, **(sensor | options)))


def test_snr_matches_closed_form():
    system = camera()
    table = snr_by_class(system, flat(), exposure_s=EXPOSURE_S)
    light_e = system.photoelectrons_per_s(flat()) * EXPOSURE_S
    e_per_dn = volts_to_electrons(1.0 / 4096, 1.5e-15)
    for k, pitch_um in enumerate((1.0, 2.0, 4.0)):
        of = np.isclose(ZONES.area_um2, pitch_um**2)
        signal_e = light_e[of].mean()

        assert table.n_sites[k] == of.sum()
        assert table.size_um[k] == pytest.approx(pitch_um)
        assert table.signal_dn[k] == pytest.approx(signal_e / e_per_dn, rel=1e-3)
        assert table.snr[k] == pytest.approx(signal_e / np.sqrt(signal_e + 25.0 + e_per_dn**2 / 12.0), rel=2e-3)
    assert table.saturated_fraction.tolist() == [0.0, 0.0, 0.0]
    assert table.snr_db == pytest.approx(20.0 * np.log10(table.snr))


def test_measured_snr_agrees_with_prediction():
    system = camera()
    frames = [system.capture(flat(), exposure_s=EXPOSURE_S, seed=1, frame=k) for k in range(12)]
    dark = [system.capture(flat(0.0), exposure_s=EXPOSURE_S, seed=2, frame=k) for k in range(12)]

    predicted, found = snr_by_class(system, flat(), exposure_s=EXPOSURE_S), measured_snr_by_class(ZONES, frames, dark)

    # The relative error of variances of 1,200 sites and 12 frames is sqrt(2 / (1200 · 11)).
    assert found.noise_dn == pytest.approx(predicted.noise_dn, rel=4 * 0.5 * np.sqrt(2 / (1200 * 11)))
    error_dn = np.max(predicted.noise_dn / np.sqrt(1200 * 12)) * np.sqrt(2)
    assert np.abs(found.signal_dn - predicted.signal_dn).max() < 4 * error_dn
    assert np.array_equal(found.classes, predicted.classes)


def test_relative_exposure_matches_closed_form():
    system = camera()
    relative = relative_exposure_at_snr_fraction(system, flat(), exposure_s=EXPOSURE_S, snr=3.0)
    light_e = system.photoelectrons_per_s(flat()) * EXPOSURE_S
    noise_e2 = 25.0 + volts_to_electrons(1.0 / 4096, 1.5e-15) ** 2 / 12.0
    needed_e = 0.5 * (9.0 + np.sqrt(81.0 + 36.0 * noise_e2))
    for k, pitch_um in enumerate((1.0, 2.0, 4.0)):
        of = np.isclose(ZONES.area_um2, pitch_um**2)
        assert relative[k] == pytest.approx(needed_e / light_e[of].mean(), rel=5e-3)


def test_relative_exposure_accounts_for_clipping():
    for options in ({"pedestal_v": 0.0}, {"pedestal_v": 0.0, "dark_e_per_s": 500.0}):
        system = camera(**options)
        relative = relative_exposure_at_snr_fraction(system, flat(), exposure_s=EXPOSURE_S)
        for k, part in enumerate(relative):
            table = snr_by_class(system, flat(0.02 * part), exposure_s=EXPOSURE_S)
            assert table.snr[k] == pytest.approx(1.0, rel=1e-4)


def test_large_sites_saturate_first():
    system = camera(full_well_e=4000.0, pedestal_v=0.0, v_sat_v=0.4)
    table = snr_by_class(system, flat(), exposure_s=EXPOSURE_S)

    assert table.saturated_fraction.tolist() == [0.0, 0.0, 1.0]
    assert "100 %" in str(table).splitlines()[3]
    dim = relative_exposure_at_snr_fraction(system, flat(), exposure_s=EXPOSURE_S, snr=30.0)
    assert np.all(np.diff(dim) < 0.0)


UNIFORM = fs.layout.grid(n_x=30, n_y=30, pitch_um=3.0)


def lit(charge_e, layout=UNIFORM, **options):
    """A camera, and a uniform power map that gives its smallest sites a charge in EXPOSURE_S."""
    sensor = fs.Sensor(layout, **({"capacitance_f": 2e-15, "v_sat_v": 1.0, "bits": 12, "read_noise_e": 5.0} | options))
    system = fs.Camera(optics=OPTICS, sensor=sensor)
    uniform = fs.PowerMap.from_array(np.ones((100, 100)), pitch_um=4.0, wavelength_nm=550.0)
    rate_e_per_s = system.photoelectrons_per_s(uniform).min()
    return system, fs.PowerMap.from_array(
        np.full((100, 100), charge_e / EXPOSURE_S / rate_e_per_s), pitch_um=4.0, wavelength_nm=550.0
    )


@pytest.mark.parametrize(
    ("charge_e", "saturated"),
    [(8000.0, 0.0), (9750.0, 0.0), (9850.0, 1.0), (10_000.0, 1.0), (10_300.0, 1.0), (2e5, 1.0)],
)
@pytest.mark.parametrize("bits", [10, 12])
def test_full_well_saturates_where_noise_is_clipped(charge_e, saturated, bits):
    # Twice the shot noise of 10,000 e- is 200 e-.
    system, light = lit(charge_e, full_well_e=1e4, bits=bits)

    table = snr_by_class(system, light, exposure_s=EXPOSURE_S)

    assert table.saturated_fraction.tolist() == [saturated]
    # Below saturation, clipping increases the SNR over the shot noise limit by less than 1 %.
    assert saturated or table.snr[0] < 1.01 * np.sqrt(charge_e)


@pytest.mark.parametrize(("below_e", "saturated"), [(150.0, 1.0), (350.0, 0.0)])
def test_highest_code_saturates_where_noise_is_clipped(below_e, saturated):
    # 1 V on 2 fF is 12,483 e-, with a shot noise of 112 e-.
    system, light = lit(volts_to_electrons(1.0, 2e-15) - below_e)

    assert snr_by_class(system, light, exposure_s=EXPOSURE_S).saturated_fraction.tolist() == [saturated]


def test_measured_saturation_uses_captured_electrons():
    for charge_e, saturated in ((9000.0, 0.0), (10_100.0, 1.0)):
        system, light = lit(charge_e, full_well_e=1e4)
        frames, dark = (
            [system.capture(some, exposure_s=EXPOSURE_S, seed=k, frame=k) for k in range(4)]
            for some in (light, fs.PowerMap(0.0 * light.data, light.grid, light.wavelength_nm))
        )
        codes, dark_codes = (np.stack([one.code for one in some]) for some in (frames, dark))

        assert measured_snr_by_class(UNIFORM, frames, dark).saturated_fraction.tolist() == [saturated]
        given = measured_snr_by_class(UNIFORM, frames, dark, full_well_e=np.where(np.arange(900) < 450, 8000.0, 2e4))
        assert given.saturated_fraction.tolist() == [0.5]
        # Saturation of the full well is not detectable from codes alone.
        assert measured_snr_by_class(UNIFORM, codes, dark_codes, bits=12).saturated_fraction.tolist() == [0.0]
        with pytest.raises(ParameterError, match="'full_well_e' must not be given without captures"):
            measured_snr_by_class(UNIFORM, codes, dark_codes, bits=12, full_well_e=1e4)


def test_missing_full_well_in_settings_raises():
    system, light = lit(5000.0, full_well_e=np.linspace(9e3, 1e4, 900))
    frames = [system.capture(light, exposure_s=EXPOSURE_S, seed=k, frame=k) for k in range(2)]

    with pytest.raises(ParameterError, match="'full_well_e' must be given, because the settings of the captures"):
        measured_snr_by_class(UNIFORM, frames, frames)
    table = measured_snr_by_class(UNIFORM, frames, frames, full_well_e=system.sensor.full_well_e)
    assert table.saturated_fraction.tolist() == [0.0]


@pytest.mark.parametrize("bits", [10, 12])
def test_relative_exposure_with_partly_saturated_class(bits):
    # The areas within a class differ by 25 % and more: large sites saturate before small ones reach the SNR.
    layout = fs.layout.log_polar(n_sectors=6, n_rings=10, r_min_um=5.0, r_max_um=60.0)
    system, light = lit(2000.0, layout, full_well_e=1e4, bits=bits)
    sensor, labels = system.sensor, size_classes_um(layout, 3)
    full_e = sensor.expected_electrons(system.photoelectrons_per_s(light), EXPOSURE_S)
    fractions = np.geomspace(1e-2, 20.0, 700)
    step_e = volts_to_electrons(1.0 / 2**bits, 2e-15)

    found_some = False
    for snr in (50.0, 80.0, 88.0, 92.0):
        found = relative_exposure_at_snr_fraction(system, light, exposure_s=EXPOSURE_S, snr=snr, classes=labels)
        for k, label in enumerate(np.unique(labels)):
            of = labels == label
            # Exhaustive search for the first fraction; half of the sites within 200 e- of the full well give NaN.
            charge_e = np.minimum(fractions[:, np.newaxis] * full_e[of], 1e4).mean(axis=1)
            ratio = charge_e / np.sqrt(charge_e + 25.0 + step_e**2 / 12.0)
            reached = np.flatnonzero(ratio >= snr)
            first = fractions[reached[0]] if reached.size else np.nan
            full = np.mean(first * full_e[of] > 9800.0)
            found_some |= 0.0 < full < 0.5
            assert found[k] == pytest.approx(np.nan if full >= 0.5 else first, rel=0.012, nan_ok=True)
    assert found_some


def test_unreachable_snr_gives_nan():
    system, light = lit(2000.0, fs.layout.grid(n_x=4, n_y=4, pitch_um=3.0), full_well_e=1e4)

    assert np.isfinite(relative_exposure_at_snr_fraction(system, light, exposure_s=EXPOSURE_S, snr=98.0)).all()
    for snr in (103.0, 150.0, 1e4, 1e9):
        assert np.isnan(relative_exposure_at_snr_fraction(system, light, exposure_s=EXPOSURE_S, snr=snr)).all()
    nothing = fs.PowerMap(0.0 * light.data, light.grid, light.wavelength_nm)
    assert np.isnan(relative_exposure_at_snr_fraction(system, nothing, exposure_s=EXPOSURE_S)).all()


def test_without_noise_quantisation_sets_threshold():
    system, light = lit(2000.0, read_noise_e=0.0, shot_noise="off")

    found = relative_exposure_at_snr_fraction(system, light, exposure_s=EXPOSURE_S)

    # Quantisation to codes, and rounding of charges to integers.
    step_e = volts_to_electrons(1.0 / 4096, 2e-15)
    assert found[0] * 2000.0 == pytest.approx(np.sqrt((step_e**2 + 1.0) / 12.0), rel=1e-5)


def test_size_classes_are_logarithmic():
    layout = fs.layout.log_polar(n_sectors=60, min_size_um=2.0, r_max_um=380.0)
    size_um = np.sqrt(layout.area_um2)
    centre_um = size_classes_um(layout, 5)
    step = (size_um.max() / size_um.min()) ** (1 / 5)

    assert np.unique(centre_um).size == 5
    assert np.all(np.abs(np.log(size_um / centre_um)) <= 0.5 * np.log(step) * (1 + 1e-4))
    assert np.unique(size_classes_um(fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0))).tolist() == [2.0]


def test_snr_table_accepts_string_classes():
    labels = np.where(ZONES.centroid_um[:, 0] > 0.0, "right", "left")
    table = snr_by_class(camera(), flat(), exposure_s=EXPOSURE_S, classes=labels)

    assert table.classes.tolist() == ["left", "right"]
    assert [row["class"] for row in table.records()] == ["left", "right"]
    assert "left" in str(table)


# -- consistency of the SNR ----------------------------------------------------------------------------------------------

LARGE = fs.layout.grid(n_x=10, n_y=10, pitch_um=8.0).with_columns(readout_line=np.tile(np.arange(10), 10))
COMPANDINGS = [{}, {"companding": "root"}, {"companding": "log", "log_strength": 300.0}]


def signals(charges_e, **options):
    """Signals of one site per charge, without dark signal."""
    layout = fs.layout.grid(n_x=len(charges_e), n_y=1, pitch_um=8.0)
    return signal_to_noise(fs.Sensor(layout, **options), charges_e, np.zeros(len(charges_e)))


def test_snr_table_stays_below_shot_limit():
    """One code of 10 bits is 1,828 e-: 2,031 e- lie within one code, where the variance of the codes is 0."""
    ratios = []
    for charge_e in (2031.0, 1e4, 1e5, 1e6):
        system, light = lit(charge_e, LARGE, bits=10, read_noise_e=2.0, capacitance_f=1e-13, v_sat_v=3.0)
        table = snr_by_class(system, light, exposure_s=EXPOSURE_S)
        ratios.append(table.snr[0])
        assert table.snr[0] <= np.sqrt(charge_e)
    # 2,031 / sqrt(2,031 + 4 + 1,828² / 12), in e-.
    assert ratios[0] == pytest.approx(3.83, abs=0.01)
    assert np.all(np.diff(ratios) > 0.0)


@pytest.mark.parametrize("bits", [1, 3, 10, 14])
@pytest.mark.parametrize("companding", COMPANDINGS)
@pytest.mark.parametrize(
    "more",
    [
        {},
        {"full_well_e": 9000.0},
        {"pedestal_v": 0.1, "read_noise_e": 0.0},
        {"ktc_noise": True, "rts_fraction": 1.0, "rts_e": 50.0},
    ],
)
def test_snr_rises_below_shot_limit(bits, companding, more):
    charges_e = np.geomspace(1e-2, 1e6, 4001)
    found = signals(
        charges_e, bits=bits, v_sat_v=1.0, capacitance_f=2e-15, **{"read_noise_e": 3.0, **companding, **more}
    )

    assert np.all(found.ratio <= np.sqrt(found.signal_e) * (1.0 + 1e-12))
    assert np.all(np.diff(found.ratio) >= -1e-9 * found.ratio[1:])
    assert found.is_saturated[-1]
    assert bits == 1 or not found.is_saturated[0]


@pytest.mark.parametrize("sigma_dn", [0.05, 0.3, 1.0, 8.0])
@pytest.mark.parametrize("dnl_dn", [0.0, 0.4])
@pytest.mark.parametrize(("companding", "charge_e"), list(zip(COMPANDINGS, (20_000, 20_000, 6000), strict=True)))
def test_noise_matches_squared_error_of_codes(companding, charge_e, dnl_dn, sigma_dn):
    """Mean squared error of the codes, with offsets uniform over more than one code."""
    n = 40_000
    layout = fs.layout.grid(n_x=200, n_y=200, pitch_um=2.0).with_columns(readout_line=np.arange(n))
    full_e = 40_000.0
    parameters = {
        "bits": 8,
        "v_sat_v": 1.0,
        "capacitance_f": full_e * 1.602176634e-19,
        "shot_noise": "off",
        **companding,
    }
    ideal = fs.Sensor(layout, **parameters)
    step_e = signal_to_noise(ideal, np.full(n, float(charge_e)), np.zeros(n)).noise_e[0] * np.sqrt(12.0)
    # The noise is relative to the code width at this charge.
    sensor = fs.Sensor(
        layout,
        **parameters,
        dnl_dn=dnl_dn,
        read_noise_e=sigma_dn * step_e,
        pixel_fpn_fraction=2.0 * step_e / full_e,
    )
    code = sensor.read(np.full(n, charge_e), seed=5)
    found_e = (linearise(code, sensor) + 0.5) * full_e / 256.0 - sensor.pattern("pixel_fpn") * full_e

    predicted = signal_to_noise(sensor, np.full(n, float(charge_e)), np.zeros(n))

    squares = np.square(found_e - charge_e)
    error = squares.std() / np.sqrt(n)
    # The code width varies along a companding curve, which changes the result by up to 2 %.
    assert squares.mean() == pytest.approx(np.square(predicted.noise_e).mean(), abs=5.0 * error + 0.02 * squares.mean())


def test_snr_definition_is_consistent():
    layout = fs.layout.grid(n_x=6, n_y=6, pitch_um=8.0).with_columns(readout_line=np.repeat(np.arange(6), 6))
    system, light = lit(
        5000.0,
        layout,
        bits=10,
        companding="root",
        dark_e_per_s=2e4,
        dsnu_fraction=0.3,
        hot_fraction=0.1,
        hot_e_per_s=3e4,
        ktc_noise=True,
        rts_fraction=0.4,
        rts_e=80.0,
        dnl_dn=0.3,
        gain_fpn_fraction=0.02,
        pixel_fpn_fraction=0.01,
        line_fpn_fraction=0.01,
        prnu_fraction=0.02,
        pedestal_v=0.05,
        device_seed=4,
    )
    sensor = system.sensor
    capture = system.capture(light, exposure_s=EXPOSURE_S, seed=1)
    dark_e = sensor.expected_electrons(np.zeros(36), EXPOSURE_S)
    ratio = signal_to_noise(sensor, capture.expected_e, dark_e).ratio
    page = content_of(capture)
    column = next(column for column in page.about["columns"] if column["key"] == "snr")
    # All sites in a single class.
    by_site = snr_by_class(system, light, exposure_s=EXPOSURE_S, classes=np.zeros(36, np.int64))

    assert np.ptp(ratio) > 5.0
    assert capture.signal_to_noise() == pytest.approx(ratio)
    assert capture.signal_to_noise(sensor=sensor) == pytest.approx(ratio)
    assert page.arrays[column["array"]] == pytest.approx(ratio, rel=1e-6)
    assert ratio.min() < by_site.snr[0] < ratio.max()
    shot = SimpleNamespace(exposure_s=EXPOSURE_S)
    assert METRICS["snr"](shot, system, capture)["mean"] == pytest.approx(ratio.mean())
    assert plot_capture(capture, "snr").collections[0].get_facecolor().shape == (36, 4)


def test_measured_snr_linearises_companding():
    system, light = lit(6000.0, companding="root", bits=10)
    nothing = fs.PowerMap(0.0 * light.data, light.grid, light.wavelength_nm)
    frames, dark = (
        [system.capture(some, exposure_s=EXPOSURE_S, seed=k, frame=k) for k in range(12)] for some in (light, nothing)
    )

    predicted, found = snr_by_class(system, light, exposure_s=EXPOSURE_S), measured_snr_by_class(UNIFORM, frames, dark)

    # The relative error of variances of 900 sites and 12 frames is sqrt(2 / (900 * 11)); dark noise is half clipped.
    assert found.snr[0] == pytest.approx(predicted.snr[0], rel=5 * 0.5 * np.sqrt(2 / (900 * 11)) + 1e-3)
    assert found.snr[0] < 1.1 * np.sqrt(6000.0)  # without linearisation it would be twice as high


def test_measured_snr_within_one_code():
    codes, dark = np.full((4, 900), 7), np.zeros((4, 900))

    assert measured_snr_by_class(UNIFORM, codes, dark, bits=12).snr == pytest.approx([7.0 * np.sqrt(12.0)])


def test_table_columns_are_separated():
    numbers = np.array([1.961e-06, 5.098e05, 1e-300, 1.2345e300])
    table = SnrTable(
        classes=np.array(["a", "a very long label", "b", "c"]),
        n_sites=np.array([2, 123_456_789, 2, 2]),
        size_um=numbers,
        signal_dn=numbers[::-1].copy(),
        noise_dn=numbers,
        saturated_fraction=np.array([0.0, 1.0, 1e-9, 0.123456]),
    )
    lines = str(table).splitlines()

    for line in lines:
        assert len(re.split(" {2,}", line.strip())) == 8
    assert len({len(line) for line in lines}) == 1


def test_invalid_snr_arguments_raise():
    frames = np.zeros((3, ZONES.n_sites), np.uint16)
    with pytest.raises(ParameterError, match="'bits' must be given for frames that are not captures"):
        measured_snr_by_class(ZONES, frames, frames)
    with pytest.raises(ParameterError, match="'dark' must have the 4000 sites of the layout"):
        measured_snr_by_class(ZONES, frames, frames[:, :7], bits=12)
    with pytest.raises(ParameterError, match="'classes' must have one value for each"):
        snr_by_class(camera(), flat(), exposure_s=EXPOSURE_S, classes=[1, 2])
    with pytest.raises(ParameterError, match=r"'camera' must be a Camera, got a NoneType"):
        snr_by_class(None, None, exposure_s=1.0)
    with pytest.raises(ParameterError, match=r"'camera' must be a Camera, got a Sensor"):
        relative_exposure_at_snr_fraction(camera().sensor, flat(), exposure_s=1.0)
    with pytest.raises(ParameterError, match=r"'layout' must be a Layout, got a NoneType"):
        measured_snr_by_class(None, frames, frames, bits=12)
    with pytest.raises(ParameterError, match="'snr' must be > 0"):
        relative_exposure_at_snr_fraction(camera(), flat(), exposure_s=EXPOSURE_S, snr=0.0)

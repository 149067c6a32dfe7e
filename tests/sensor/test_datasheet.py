"""Data sheets of EMVA 1288: to a sensor, and by a measurement of the standard back to the sheet."""

import numpy as np
import pytest
import yaml
from reference.data_sheets import MISPRINTED, SHEETS
from scipy import stats

import foveasim as fs
from foveasim.sensor import DataSheet, read_datasheet
from foveasim.sensor.published.datasheet import PARAMETERS, QUANTITIES, _range_of, limit_of_saturation

#: A sheet with the quantities that a sensor needs.
PLAIN = {"pixel_um": 3.45, "bits": 12, "qe_percent": 64, "dark_noise_e": "2.1", "saturation_e": 10_400}
N_SIDE, N_FRAMES, EXPOSURE_S = 300, 4, 1e-4


def measured(sensor, saturation_e):
    """EMVA 1288 parameters of simulated frames, with many levels next to the saturation, and many frames for DSNU and PRNU."""
    signals_e = saturation_e * np.concatenate((np.linspace(0.05, 0.9, 18), np.linspace(0.92, 1.05, 27)))
    half = int(np.abs(signals_e - 0.5 * saturation_e).argmin())

    def frames(signal_e, n_frames, seed):
        expected_e = sensor.expected_electrons(np.full(sensor.layout.n_sites, signal_e / EXPOSURE_S), EXPOSURE_S)
        return fs.metrics.draw_frames(sensor, expected_e, n_frames=n_frames, seed=seed, exposure_s=EXPOSURE_S)

    light = [
        frames(each, 60 if abs(k - half) < 2 else 24 if each > 0.9 * saturation_e else N_FRAMES, k)
        for k, each in enumerate(signals_e)
    ]
    dark = frames(0.0, 60, 999)
    found = fs.metrics.emva1288(light, [dark], signals_e / float(sensor.qe))
    # The largest charge, by frames of twice the saturation.
    well_e = (np.mean(frames(2.0 * saturation_e, 2, 998)) - np.mean(dark)) / found.gain_dn_per_e
    return found, well_e


#: Values of a linearity error are those of levels at equal distances, and those for information have no measurement.
NOT_MEASURED = {"linearity_error_min_percent", "linearity_error_max_percent", "frames_per_s"}
#: Conditions, which other values are for.
CONDITIONS = {"pixel_um", "wavelength_nm", "temperature_k", "dark_current_e_per_s", "black_level_dn"}


#: Quantities of a sheet and those of a measurement.
MEASURED = {
    "qe_percent": lambda found: 100.0 * found.qe,
    "gain_dn_per_e": lambda found: found.gain_dn_per_e,
    "inverse_gain_e_per_dn": lambda found: 1.0 / found.gain_dn_per_e,
    "dark_noise_e": lambda found: found.dark_noise_e,
    "dark_noise_dn": lambda found: found.dark_noise_dn,
    "threshold_ph": lambda found: found.threshold_ph,
    "threshold_e": lambda found: found.threshold_e,
    "saturation_ph": lambda found: found.saturation_ph,
    "saturation_e": lambda found: found.saturation_e,
    "snr_max_db": lambda found: found.snr_max_db,
    "dynamic_range_db": lambda found: found.dynamic_range_db,
    "dsnu_e": lambda found: found.dsnu_e,
    "dsnu_dn": lambda found: found.dsnu_e * found.gain_dn_per_e,
    "prnu_percent": lambda found: 100.0 * found.prnu_fraction,
}


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("name", SHEETS)
def test_measurement_returns_the_sheet(name):
    """Each printed value within 1 %, or its rounding; decibels as ratios."""
    printed = SHEETS[name]
    sheet = DataSheet(**printed)
    side_um = float(sheet.value("pixel_um"))
    sensor = fs.Sensor.from_datasheet(fs.layout.grid(n_x=N_SIDE, n_y=N_SIDE, pitch_um=side_um), sheet)
    found, well_e = measured(sensor, sheet.value("saturation_e"))

    assert found.underflow_fraction[0] < 0.005
    checked = {quantity: float(of(found)[0]) for quantity, of in MEASURED.items()}
    if "full_well_e" in printed:
        end_e = (2**sheet.bits - 1 - sheet.black_dn) / checked["gain_dn_per_e"]
        is_well = sheet.value("full_well_e") < 1.01 * end_e  # otherwise the codes end before the full well
        checked["full_well_e"] = float(well_e[0]) if is_well else sheet.value("full_well_e")
        assert well_e[0] == pytest.approx(min(end_e, sheet.value("full_well_e")), rel=0.01)
    largest_e = checked.get("full_well_e", checked["saturation_e"])
    checked["noise_dynamic_range_db"] = 20.0 * np.log10(largest_e / checked["dark_noise_e"])
    quantities = {quantity for quantity in QUANTITIES if quantity in printed} - NOT_MEASURED - CONDITIONS
    assert len(quantities) >= 2
    for quantity in quantities:
        value, (low, high, _) = checked[quantity], _range_of(quantity, printed[quantity])
        tolerance = 20.0 * np.log10(1.01) if quantity.endswith("_db") else 0.01 * value
        assert low - tolerance <= value <= high + tolerance, (quantity, printed[quantity], value)


def test_implied_values_are_those_of_sheet():
    """Five values of the IMX900 imply the others, which its sheet prints."""
    complete = SHEETS["imx900_low_gain"]
    given = ("pixel_um", "bits", "qe_percent", "gain_dn_per_e", "dark_noise_e", "saturation_e")
    sheet = DataSheet(**{name: complete[name] for name in given})

    for name in ("threshold_e", "threshold_ph", "saturation_ph", "snr_max_db", "dynamic_range_db", "dark_noise_dn"):
        low, high, _ = _range_of(name, complete[name])
        # Values that follow from rounded ones.
        assert low - 2e-3 * high <= sheet.value(name) <= high * (1.0 + 2e-3), name
        assert name in sheet.derived


def test_noise_and_saturation_follow_from_others():
    """√μ_e.sat is 40 dB for 10⁴ e-; the threshold of 2.5 e- is 2 e- of noise and 1/2."""
    sheet = DataSheet(
        pixel_um=3.0, bits=16, qe_percent=50, gain_dn_per_e="6.0000", threshold_ph="5.0000", snr_max_db="40.0000"
    )

    assert sheet.value("saturation_e") == pytest.approx(1e4, rel=1e-4)
    assert sheet.value("dark_noise_e") == pytest.approx(2.0, rel=1e-3)  # with 1 / (12 K²) of quantisation


@pytest.mark.parametrize("prnu_fraction", [0.0, 0.01])
def test_variance_is_highest_at_the_saturation(prnu_fraction):
    """Moments of Poisson-distributed charges that are cut at the limit, in the mean over sites."""
    limit_e = limit_of_saturation(2000.0, prnu_fraction)
    charges = np.arange(3000)
    cut_e = np.minimum(charges, limit_e)
    # Sites at equal shares of a normal distribution.
    sites = stats.norm.ppf((np.arange(50) + 0.5) / 50) if prnu_fraction else np.zeros(1)
    means_e = np.linspace(1960.0, 2040.0, 41)
    variance = []
    for mean_e in means_e:
        shares = stats.poisson.pmf(charges, (mean_e * (1.0 + prnu_fraction * sites))[:, None])
        variance.append(np.mean(shares @ cut_e**2 - (shares @ cut_e) ** 2))

    assert means_e[int(np.argmax(variance))] == pytest.approx(2000.0, rel=0.006)


def test_sites_scale_with_their_area():
    """A site of four pixels has four times the full well and the dark current, and the read noise of a pixel."""
    sheet = DataSheet(**PLAIN | {"dark_current_e_per_s": "10.0", "gain_dn_per_e": "0.3", "dsnu_e": "1.0"})
    small, large = (
        fs.Sensor.from_datasheet(fs.layout.grid(n_x=2, n_y=2, pitch_um=pitch_um), sheet) for pitch_um in (3.45, 6.9)
    )

    for name in ("full_well_e", "capacitance_f", "dark_e_per_s"):
        np.testing.assert_allclose(getattr(large, name), 4.0 * getattr(small, name), rtol=1e-12)
    assert large.read_noise_e == small.read_noise_e == 2.1


def test_parameters_replace_those_of_the_sheet():
    qe = fs.sensor.SiliconQE(depth_um=3.0)
    sensor = fs.Sensor.from_datasheet(fs.layout.grid(4, 4, 3.45), DataSheet(**PLAIN), qe=qe, read_noise_e=5.0)

    assert sensor.qe is qe
    assert sensor.read_noise_e == 5.0


def test_what_is_open_is_said():
    assumed = " ".join(DataSheet(**PLAIN, wavelength_nm=529).assumptions)

    for part in ("The gain is 0.38", "The black level is", "at 529 nm holds at all", "no DSNU", "no PRNU", "no dark"):
        assert part in assumed
    assert DataSheet(**SHEETS["imx900_high_gain"]).assumptions == (
        "The quantum efficiency at 536 nm holds at all wavelengths.",
        "A sensor does not contain shutter, global.",
        "The dark current doubles every 8 K, the default of sensors.",
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dark_noise_e": None}, "'dark_noise_e' must be in the data sheet, or follow from dark_noise_dn and gain"),
        ({"saturation_e": None}, "'saturation_e' must be in the data sheet, or follow from saturation_ph and qe"),
        ({"gain_dn_per_e": "2.70"}, "must be at most the last of 12 bits, 4,095 DN, got 28,080 DN; is K of other bits"),
        ({"saturation_e": "wide"}, "'saturation_e' must be a number, without its unit, got 'wide'"),
        ({"prnu_percent": "0.5 %"}, "without its unit"),
        ({"qe_percent": 640}, "'qe_percent'"),
        ({"bits": 12.5}, "'bits' must be an integer"),
        ({"bits": 1}, "'black_level_dn' must be below the last code of 1 bits, 1"),
        ({"black_level_dn": 4095}, "'black_level_dn' must be below the last code of 12 bits, 4095"),
        ({"qe_percent": None, "saturation_ph": 1000}, "'qe_percent' must be <= 100"),
        ({"qe_curve": [[500, 20]]}, "'qe_curve' must have at least two rows"),
        ({"qe_curve": [[500, 20], [400, 30]]}, "'qe_curve' must have wavelengths in ascending order"),
        ({"qe_curve": [[500, 20], [600, 130]]}, "'qe_curve' must be <= 100"),
        ({"saturation_e": None, "snr_max_db": "3.0"}, "'saturation_e' must be from 10 to 1e+08"),
        (
            {"gain_dn_per_e": "0.39", "dsnu_e": "1.0", "dsnu_dn": "1.0"},
            "'dsnu_e' must agree with dsnu_dn / gain_dn_per_e",
        ),
        ({"snr_max_db": "60.2"}, "'saturation_e' must agree with the square of snr_max"),
    ],
)
def test_wrong_sheets_are_explained(changes, message):
    with pytest.raises(fs.errors.ParameterError) as caught:
        DataSheet(**PLAIN | changes)
    assert message in str(caught.value)


def test_quantum_efficiency_is_a_curve():
    """Linear between rows, and an error beyond; a sheet without wavelength has the peak."""
    rows = [[400, "20.0"], [500, "60.0"], [700, "40.0"]]
    sheet = DataSheet(**PLAIN | {"qe_percent": None}, qe_curve=rows, wavelength_nm=600)
    sensor = fs.Sensor.from_datasheet(fs.layout.grid(4, 4, 3.45), sheet)

    np.testing.assert_allclose(sensor.qe(np.array([400.0, 450.0, 600.0])), [0.2, 0.4, 0.5])
    assert sheet.value("qe_percent") == pytest.approx(50.0)
    assert sheet.derived["qe_percent"] == "qe_curve at wavelength_nm"
    assert DataSheet(**PLAIN | {"qe_percent": None}, qe_curve=rows).value("qe_percent") == 60.0
    assert not any("holds at all wavelengths" in each for each in sheet.assumptions)
    with pytest.raises(fs.errors.ParameterError, match="900"):
        fs.Sensor.from_datasheet(fs.layout.grid(4, 4, 3.45), sheet).responsivity_e_per_j(np.array([900.0]))


def test_nonuniformity_of_columns_is_that_of_lines():
    """By the spatial parts of EMVA 1288, of frames of 200 columns."""
    parts = {"dsnu_e": "5.0", "dsnu_column_e": "3.0", "dsnu_pixel_e": "4.0", "gain_dn_per_e": "0.38"}
    sheet = DataSheet(**PLAIN | parts)
    layout = fs.layout.grid(n_x=200, n_y=200, pitch_um=3.45)
    found, total = [], []
    for columns in (True, False):
        sites = layout if columns else fs.Layout.from_polygons(layout.polygons())
        sensor = fs.Sensor.from_datasheet(sites, sheet)
        frames = fs.metrics.draw_frames(sensor, np.zeros(40_000), n_frames=64, seed=0, exposure_s=EXPOSURE_S)
        mean_e = frames.mean(axis=0).reshape(200, 200) / 0.38
        found.append(mean_e.mean(axis=0).std())
        total.append(mean_e.std())
        assert ("line_fpn_fraction" in sheet.settings(has_lines=columns)) == columns

    assert total == pytest.approx([5.0, 5.0], rel=0.05)
    assert found == pytest.approx([np.hypot(3.0, 4.0 / np.sqrt(200.0)), 5.0 / np.sqrt(200.0)], rel=0.15)
    assert "Without readout lines in the layout, dsnu_column_e is among the pixels." in sheet.assumptions


def test_total_nonuniformity_follows_from_parts():
    """3, 4 and 12 are 13."""
    rows = {"dsnu_row_e": "3.0", "dsnu_column_e": "4.0", "dsnu_pixel_e": "12.0", "prnu_row_percent": "0.5"}
    sheet = DataSheet(**PLAIN | rows)

    assert sheet.value("dsnu_e") == pytest.approx(13.0)
    assert sheet.value("prnu_percent") == pytest.approx(0.5)
    assert sum("is among the pixels" in each or "among the pixels" in each for each in sheet.assumptions) == 3
    with pytest.raises(fs.errors.ParameterError, match="'dsnu_e' must agree with the root of the sum of squares"):
        DataSheet(**PLAIN | rows | {"dsnu_e": "20.0"})


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    ("min_percent", "max_percent"), [("-1.133", "0.595"), ("-0.550", None), ("-3.00", None), ("-0.32", "0.62")]
)
def test_measurement_returns_linearity_error(min_percent, max_percent):
    """By levels at equal distances, of a sensor whose codes reach far beyond its saturation."""
    linearity = {"linearity_error_min_percent": min_percent, "linearity_error_max_percent": max_percent}
    sheet = DataSheet(**PLAIN | {"gain_dn_per_e": "0.399", "saturation_e": "8000"} | linearity)
    sensor = fs.Sensor.from_datasheet(fs.layout.grid(n_x=200, n_y=200, pitch_um=3.45), sheet)
    signals_e = 8000.0 * np.arange(1, 54) / 50.0

    def frames(signal_e, k):
        expected_e = np.full(40_000, signal_e * float(sensor.qe) / 0.64)
        return fs.metrics.draw_frames(sensor, expected_e, n_frames=8, seed=k, exposure_s=EXPOSURE_S)

    light = [frames(each, k) for k, each in enumerate(signals_e)]
    found = fs.metrics.emva1288(light, [frames(0.0, 99)], signals_e / 0.64)

    errors_percent = [
        100.0 * each[0] for each in (found.linearity_error_min_fraction, found.linearity_error_max_fraction)
    ]
    assert errors_percent[0] == pytest.approx(float(min_percent), rel=0.05)
    assert max_percent is None or errors_percent[1] == pytest.approx(float(max_percent), rel=0.05)
    assert found.gain_dn_per_e[0] == pytest.approx(0.399, rel=0.01)
    assert found.qe[0] == pytest.approx(0.64, rel=0.01)
    assert found.saturation_e[0] == pytest.approx(8000.0, rel=0.02)  # a step of the levels


def test_linearity_error_of_no_sensor_is_said():
    sheet = DataSheet(**PLAIN, linearity_error_min_percent="-2.0", linearity_error_max_percent="2.5")

    assert any("not linearity_error_min_percent = -2.0, linearity_error_max" in each for each in sheet.assumptions)


def test_full_well_limits_the_charge():
    """The codes of the second end before it."""
    well = PLAIN | {"saturation_e": None, "full_well_e": 10_700}
    sheets = DataSheet(**well), DataSheet(**well | {"inverse_gain_e_per_dn": "2.00"})
    sensors = [fs.Sensor.from_datasheet(fs.layout.grid(4, 4, 3.45), sheet) for sheet in sheets]

    for sheet, sensor, limit_e in zip(sheets, sensors, (10_700.0, 2.0 * 4088), strict=True):
        codes = sensor.read(sensor.collect(np.full(16, 2e4), seed=0), seed=1).mean()
        assert (codes - sheet.black_dn) / sheet.gain == pytest.approx(limit_e, rel=0.005)
        assert limit_of_saturation(sheet.value("saturation_e")) == pytest.approx(limit_e, rel=0.005)
    assert sheets[1].derived["saturation_e"].endswith("or the end of the codes")
    # At 2.005 e-/DN, the largest gain that is printed as 2.00.
    assert "The codes end at 8198 e-, before the full well." in sheets[1].assumptions


def test_range_of_noise_is_recognised():
    """57.7 dB are 6,972 e- over 9.08 e-, and not over the threshold."""
    values = PLAIN | {"dark_noise_e": "9.08", "saturation_e": 6972}
    with pytest.warns(
        fs.errors.FoveasimWarning, match="it is saturation_e / dark_noise_e: use 'noise_dynamic_range_db'"
    ):
        DataSheet(**values, dynamic_range_db="57.7")
    assert DataSheet(**values, noise_dynamic_range_db="57.7").value("dark_noise_e") == 9.08


def test_values_that_follow_contradict_others():
    """A threshold of 10 photons is 7 e-, which a noise of 6.8 e- exceeds with quantisation."""
    values = PLAIN | {"qe_percent": 70, "dark_noise_e": "6.8", "saturation_e": 32_700, "inverse_gain_e_per_dn": "8.4"}
    with pytest.warns(
        fs.errors.FoveasimWarning, match="'dark_noise_e' must agree with threshold_e without quantisation"
    ):
        DataSheet(**values, threshold_ph=10)


def test_published_sheets_are_grouped_and_consistent():
    """Without warnings; each has a source, a group, and values that its data contain as printed."""
    presets = fs.sensor.PRESETS
    measured_presets = {name: preset for name, preset in presets.items() if preset.group != "paper"}

    assert len(measured_presets) >= 20
    assert {preset.group for preset in presets.values()} == {
        "mobile", "machine vision", "scientific", "astronomy", "paper",
    }  # fmt: skip
    for name, preset in measured_presets.items():
        assert len(preset.source) > 20, name
        assert preset.sheet is not None
        assert preset.sheet.title == preset.title == SHEETS[name]["title"]
        assert preset.provenance["source"] == preset.source
        assert preset.settings().keys() <= PARAMETERS


def test_misprint_is_found():
    with pytest.raises(fs.errors.ParameterError, match="'saturation_e' must agree with threshold_e x dynamic_range"):
        DataSheet(**MISPRINTED)
    DataSheet(**MISPRINTED | {"saturation_e": 20_800})


def test_rounded_differences_are_reported():
    """The sheet of a camera with 6,972 e- and 38.7 dB, the root of 7,413 e-."""
    with pytest.warns(fs.errors.FoveasimWarning, match="'saturation_e' must agree with the square of snr_max"):
        DataSheet(**PLAIN | {"saturation_e": 6972, "snr_max_db": "38.7"})


def test_sheet_is_read_from_yaml(tmp_path):
    path = tmp_path / "sheet.yaml"
    path.write_text(yaml.safe_dump(SHEETS["imx900_low_gain"]))
    layout = fs.layout.grid(4, 4, 2.25)

    assert read_datasheet(path).value("gain_dn_per_e") == 0.399
    sheet = DataSheet(**SHEETS["imx900_low_gain"])
    assert fs.Sensor.from_datasheet(layout, path).read_noise_e == fs.Sensor.from_datasheet(layout, sheet).read_noise_e
    path.write_text(yaml.safe_dump(PLAIN | {"dark_noise": 2.1}))
    with pytest.raises(
        fs.errors.ParameterError, match=r"'dark_noise' must be a quantity of a data sheet.*dark_noise_e"
    ):
        read_datasheet(path)
    path.write_text(yaml.safe_dump({"bits": 12}))
    with pytest.raises(fs.errors.ParameterError, match="'pixel_um' must be in the data sheet"):
        read_datasheet(path)
    with pytest.raises(fs.errors.ParameterError, match="'sheet' must be a DataSheet"):
        fs.Sensor.from_datasheet(layout, 5)

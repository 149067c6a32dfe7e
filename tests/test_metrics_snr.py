"""Signal and noise by size: the closed form of shot and read noise, draws against predictions, and the least light."""

from __future__ import annotations

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.metrics import light_at_snr_fraction, measured_snr_by_class, size_classes_um, snr_by_class
from foveasim.units import volts_to_electrons

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


def test_snr_is_that_of_shot_read_and_rounding_noise():
    shown = camera()
    table = snr_by_class(shown, flat(), exposure_s=EXPOSURE_S)
    light_e = shown.photoelectrons_per_s(flat()) * EXPOSURE_S
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


def test_draws_give_what_was_predicted():
    shown = camera()
    frames = [shown.capture(flat(), exposure_s=EXPOSURE_S, seed=1, frame=k) for k in range(12)]
    dark = [shown.capture(flat(0.0), exposure_s=EXPOSURE_S, seed=2, frame=k) for k in range(12)]

    told, found = snr_by_class(shown, flat(), exposure_s=EXPOSURE_S), measured_snr_by_class(ZONES, frames, dark)

    # Variances of 1,200 sites and 12 frames are known to sqrt(2 / (1200 · 11)).
    assert found.noise_dn == pytest.approx(told.noise_dn, rel=4 * 0.5 * np.sqrt(2 / (1200 * 11)))
    assert np.abs(found.signal_dn - told.signal_dn).max() < 4 * np.max(told.noise_dn / np.sqrt(1200 * 12)) * np.sqrt(2)
    assert np.array_equal(found.classes, told.classes)


def test_the_least_light_has_a_closed_form_above_a_pedestal():
    shown = camera()
    share = light_at_snr_fraction(shown, flat(), exposure_s=EXPOSURE_S, snr=3.0)
    light_e = shown.photoelectrons_per_s(flat()) * EXPOSURE_S
    noise_e2 = 25.0 + volts_to_electrons(1.0 / 4096, 1.5e-15) ** 2 / 12.0
    needed_e = 0.5 * (9.0 + np.sqrt(81.0 + 36.0 * noise_e2))
    for k, pitch_um in enumerate((1.0, 2.0, 4.0)):
        of = np.isclose(ZONES.area_um2, pitch_um**2)
        assert share[k] == pytest.approx(needed_e / light_e[of].mean(), rel=5e-3)


def test_the_least_light_counts_the_clip_at_darkness():
    for options in ({"pedestal_v": 0.0}, {"pedestal_v": 0.0, "dark_e_per_s": 500.0}):
        shown = camera(**options)
        share = light_at_snr_fraction(shown, flat(), exposure_s=EXPOSURE_S)
        for k, part in enumerate(share):
            table = snr_by_class(shown, flat(0.02 * part), exposure_s=EXPOSURE_S)
            assert table.snr[k] == pytest.approx(1.0, rel=1e-4)


def test_large_sites_saturate_first_and_a_ratio_beyond_the_well_is_never_reached():
    shown = camera(full_well_e=4000.0, pedestal_v=0.0, v_sat_v=0.4)
    table = snr_by_class(shown, flat(), exposure_s=EXPOSURE_S)

    assert table.saturated_fraction.tolist() == [0.0, 0.0, 1.0]
    assert "100 %" in str(table).splitlines()[3]
    dim = light_at_snr_fraction(shown, flat(), exposure_s=EXPOSURE_S, snr=30.0)
    assert np.all(np.diff(dim) < 0.0)


def test_sizes_fall_into_classes_of_equal_ratios():
    layout = fs.layout.log_polar(n_sectors=60, min_size_um=2.0, r_max_um=380.0)
    size_um = np.sqrt(layout.area_um2)
    middle_um = size_classes_um(layout, 5)
    step = (size_um.max() / size_um.min()) ** (1 / 5)

    assert np.unique(middle_um).size == 5
    assert np.all(np.abs(np.log(size_um / middle_um)) <= 0.5 * np.log(step) * (1 + 1e-4))
    assert np.unique(size_classes_um(fs.layout.grid(n_x=3, n_y=3, pitch_um=2.0))).tolist() == [2.0]


def test_classes_may_be_any_labels_and_print_as_a_table():
    labels = np.where(ZONES.centroid_um[:, 0] > 0.0, "right", "left")
    table = snr_by_class(camera(), flat(), exposure_s=EXPOSURE_S, classes=labels)

    assert table.classes.tolist() == ["left", "right"]
    assert [row["class"] for row in table.records()] == ["left", "right"]
    assert "left" in str(table)


def test_bad_input_is_told():
    frames = np.zeros((3, ZONES.n_sites), np.uint16)
    with pytest.raises(ParameterError, match="'bits' must be given where frames are no captures"):
        measured_snr_by_class(ZONES, frames, frames)
    with pytest.raises(ParameterError, match="'dark' must have the layout's 4000 sites"):
        measured_snr_by_class(ZONES, frames, frames[:, :7], bits=12)
    with pytest.raises(ParameterError, match="'classes' must have one label for each"):
        snr_by_class(camera(), flat(), exposure_s=EXPOSURE_S, classes=[1, 2])
    with pytest.raises(ParameterError, match="'snr' must be > 0"):
        light_at_snr_fraction(camera(), flat(), exposure_s=EXPOSURE_S, snr=0.0)

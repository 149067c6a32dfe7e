"""Effects on light before the collection, dead and saturated sites, in comparisons and pictures per area."""

import pickle
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from reference.own_effects import CornerLoss, RowNoise

import foveasim as fs
from foveasim import Camera, Optics, Sensor
from foveasim.compare import SceneCovariance, gaussian_information_bits, site_information_bits
from foveasim.compare.information import _Apertures
from foveasim.errors import ParameterError
from foveasim.layout import grid
from foveasim.sensor import Diffusion, InterPixelCapacitance
from foveasim.sensor.effects import Effect

HALF_DIAGONAL_UM = 48.0 * np.sqrt(2.0)
LAYOUT = grid(n_x=16, n_y=16, pitch_um=6.0).with_columns(readout_line=np.repeat(np.arange(16), 16))
ELECTRONICS = {"bits": 12, "v_sat_v": 1.0, "capacitance_f": 3.2e-15, "read_noise_e": 2.0, "pedestal_v": 0.01}
ROW_NOISE = RowNoise(1e-3, stage="output")
OPTICS = Optics(focal_length_mm=8.0, f_number=2.8)
EXPOSURE_S = 0.002


#: A transmission that falls from 1 at the centre to 0.1 in the corners, as an effect and as an array.
CORNER_LOSS = CornerLoss(0.9, HALF_DIAGONAL_UM)
AXIS_UM = 6.0 * (np.arange(16) - 7.5)
TRANSMISSION = 1.0 - 0.9 * np.add.outer(AXIS_UM**2, AXIS_UM**2).ravel() / HALF_DIAGONAL_UM**2


@dataclass(frozen=True)
class Glow(Effect):
    """Test effect: 30 % more charge, and 7 e- of light from the electronics, before the draw."""

    name: ClassVar[str] = "glow"
    stage: ClassVar[str] = "expected"
    is_temporal: ClassVar[bool] = False

    def apply(self, values, *, sites, rng):
        return 1.3 * values + 7.0

    def moments(self, mean, variance, *, sites):
        return 1.3 * mean + 7.0, 1.69 * variance


def camera(**keywords):
    return Camera(optics=OPTICS, sensor=Sensor(LAYOUT, **{**ELECTRONICS, **keywords}))


def compare(cameras):
    return fs.compare.cameras(cameras, exposure_s=EXPOSURE_S, max_pixels=32)


EVERYTHING = {
    "prnu_fraction": 0.02,
    "gain_fpn_fraction": 0.01,
    "dark_e_per_s": 50.0,
    "crosstalk": Diffusion(spread_um=0.5),
    "coupling": InterPixelCapacitance(neighbour_fraction=0.02),
    "capacitance_f": 3.2e-15 * np.linspace(0.9, 1.1, LAYOUT.n_sites),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("keywords", "effects"),
    [({}, []), ({}, [ROW_NOISE]), (EVERYTHING, [ROW_NOISE])],
    ids=["plain", "rows", "everything"],
)
def test_effect_and_sensitivity_have_equal_measures(keywords, effects):
    comparison = compare({
        "effect": camera(effects=[CORNER_LOSS, *effects], **keywords),
        "sensitivity": camera(sensitivity=TRANSMISSION, effects=effects, **keywords),
        "without": camera(effects=effects, **keywords),
    })  # fmt: skip

    for name in ("information_bit_per_site", "shift_sigma_um", "snr_mean_db"):
        effect, sensitivity, without = comparison.values[name]
        assert effect == pytest.approx(sensitivity, rel=1e-12)
        assert np.all((effect > without) if name == "shift_sigma_um" else (effect < without))


@pytest.mark.slow
def test_picture_per_area_corrects_effects_on_light():
    """A uniform scene has a uniform picture per area, whether the corner is dark by an effect or by a sensitivity."""
    cameras = (camera(effects=[CORNER_LOSS]), camera(sensitivity=TRANSMISSION))
    lit = fs.PowerMap(np.ones((1, 96, 96), np.float32), fs.Grid((96, 96), 1.0, tuple(LAYOUT.bounds_um[:2])), [550.0])

    pictures = []
    for each in cameras:
        capture = each.capture(lit, exposure_s=EXPOSURE_S, seed=1)
        pictures.append(capture.picture("cells", of="expected_e", per="um2", sensor=each.sensor).data)

    np.testing.assert_allclose(pictures[0], pictures[1], rtol=1e-6)
    assert np.nanmax(pictures[0]) / np.nanmin(pictures[0]) == pytest.approx(1.0, abs=1e-3)


def test_dead_sites_reduce_information_in_proportion():
    """Without correlation between sites, information is that of the living sites."""
    covariance = SceneCovariance([4.0], [0.05])
    is_dead = np.random.default_rng(1).random(LAYOUT.n_sites) < 0.3
    noise = np.full((1, LAYOUT.n_sites), 9.0)

    living = site_information_bits(LAYOUT, covariance, np.full(LAYOUT.n_sites, 16.0), noise)[0]
    some = site_information_bits(LAYOUT, covariance, np.where(is_dead, 0.0, 16.0), noise)[0]

    assert np.all(some[is_dead] == 0.0)
    assert some[~is_dead] == pytest.approx(living[~is_dead], rel=1e-3)


@pytest.mark.slow
def test_information_falls_with_dead_and_saturated_sites():
    comparison = compare({"all": camera(), "dead": camera(dead_fraction=0.3), "full": camera(full_well_e=20.0)})
    information = np.asarray(comparison.values["information_bit_per_site"])
    shift_um = np.asarray(comparison.values["shift_sigma_um"])

    assert np.all(information[1] < 0.9 * information[0])
    assert np.all(information[1] > 0.6 * information[0])
    assert np.all(shift_um[1] > 1.1 * shift_um[0])
    # All sites are within two standard deviations of the full well of 20 e-.
    assert information[2] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("keywords", [{}, {"coupling": InterPixelCapacitance(neighbour_fraction=0.05)}])
def test_correlated_noise_has_closed_form(keywords):
    """For few sites the chain rule is exact: half the logarithm of the ratio of the determinants."""
    part = LAYOUT[:100]
    sensor = Sensor(part, **ELECTRONICS, effects=[ROW_NOISE], **keywords)
    model = sensor.linearise(np.linspace(200.0, 900.0, 100))
    covariance, gain = SceneCovariance([1e-4], [6.0]), model.forward(np.full(100, 900.0))
    signal = _Apertures(part, covariance).covariance(np.arange(100))

    found = site_information_bits(part, covariance, gain, [model])
    independent = site_information_bits(part, covariance, gain, model.variance_dn2()[np.newaxis])

    expected = gaussian_information_bits(
        signal * np.multiply.outer(gain, gain), noise_covariance=model.apply_covariance(np.eye(100))
    )
    assert found.sum() == pytest.approx(expected, rel=1e-9)
    assert abs(independent.sum() / expected - 1.0) > 0.01


@pytest.mark.parametrize("companding", ["linear", "root", "log"])
def test_site_information_falls_with_light(companding):
    """For 100 sites the chain rule is exact; dead and darker sites never add information."""
    rng, part = np.random.default_rng(4), LAYOUT[:100]
    for _ in range(20):
        sensor = Sensor(part, **{**ELECTRONICS, "companding": companding, "bits": int(rng.integers(6, 14)),
                                 "read_noise_e": float(rng.uniform(0.5, 20.0))}, effects=[ROW_NOISE])  # fmt: skip
        light_e = rng.uniform(100.0, 3000.0, 100)
        covariance = SceneCovariance([float(rng.uniform(1e-6, 1e-3))], [float(rng.uniform(2.0, 30.0))])
        bits = []
        for share in (np.ones(100), rng.uniform(0.2, 1.0, 100) * (rng.random(100) > 0.2)):
            model = sensor.linearise(share * light_e)
            bits.append(site_information_bits(part, covariance, model.forward(share * light_e), [model]).sum())
        assert bits[1] <= bits[0]


def test_gains_of_other_scenes_are_errors():
    with pytest.raises(ParameterError, match="one per scene, 3"):
        site_information_bits(
            LAYOUT, SceneCovariance([1.0], [5.0]), np.ones((2, LAYOUT.n_sites)), np.ones((3, LAYOUT.n_sites))
        )


@pytest.mark.parametrize("is_device_known", [True, False])
def test_light_response_is_slope_of_expected_charge(is_device_known):
    sensor = Sensor(
        LAYOUT,
        sensitivity=0.8,
        dead_fraction=0.2,
        prnu_fraction=0.05,
        dark_e_per_s=100.0,
        effects=[CORNER_LOSS, Glow()],
    )
    factor = 0.8 * 1.3 * TRANSMISSION
    if is_device_known:
        factor = factor * sensor.pattern("prnu") * sensor.pattern("dead")

    assert sensor.light_response(is_device_known=is_device_known) == pytest.approx(factor, rel=1e-12)


def test_light_response_conserves_charge_of_crosstalk():
    sensor = Sensor(LAYOUT, crosstalk=Diffusion(spread_um=1.0))
    patterned = replace(sensor, sensitivity=TRANSMISSION)

    assert sensor.light_response() == pytest.approx(1.0, rel=1e-12)
    assert patterned.light_response().sum() == pytest.approx(TRANSMISSION.sum(), rel=1e-12)
    assert patterned.light_response() != pytest.approx(TRANSMISSION, rel=1e-3)


def test_part_has_light_response_of_its_sites():
    sensor = Sensor(
        LAYOUT, sensitivity=TRANSMISSION, prnu_fraction=0.05, dead_fraction=0.2, effects=[CORNER_LOSS, Glow()]
    )
    complete = sensor.light_response()

    for chosen in (slice(100, 200), np.array([5, 250, 5, 17])):
        assert np.array_equal(sensor.part(chosen).light_response(), complete[chosen])
    assert np.array_equal(pickle.loads(pickle.dumps(sensor)).light_response(), complete)

"""First-order models of effects: slopes and added variances against closed forms, and codes against draws."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from foveasim import Sensor
from foveasim.errors import SimulationError
from foveasim.layout import grid
from foveasim.sensor.effects import AdditiveNoise, Effect, FixedFactor, StepModel

ROW = grid(n_x=40, n_y=1, pitch_um=2.0)
SITES = Sensor(ROW).sites
#: Means from far below to far above one unit.
MEANS = np.geomspace(1e-3, 1e6, 40)


@dataclass(frozen=True)
class Power(Effect):
    """Test effect: a power of the values relative to a scale, with multiplicative noise."""

    name: ClassVar[str] = "power"
    is_temporal: ClassVar[bool] = True

    scale: float = 1.0
    exponent: float = 1.0
    spread: float = 0.0
    stage: str = "charge"

    def apply(self, values, *, sites, rng):
        curved = self.scale * np.sign(values) * np.abs(values / self.scale) ** self.exponent
        return curved * (1.0 + self.spread * rng.standard_normal(values.size))

    def moments(self, mean, variance, *, sites):
        ratio = np.maximum(np.abs(mean) / self.scale, 1e-300)
        curved, slope = self.scale * ratio**self.exponent, self.exponent * ratio ** (self.exponent - 1.0)
        return curved, slope**2 * variance * (1.0 + self.spread**2) + curved**2 * self.spread**2


@pytest.mark.parametrize("stage", ["photo", "dark", "expected", "charge"])
@pytest.mark.parametrize("exponent", [0.5, 1.0, 1.5, 2.0])
def test_default_slope_is_derivative(stage, exponent):
    effect = Power(scale=50.0, exponent=exponent, stage=stage)
    wide = MEANS[MEANS >= 1.0]

    found = effect.validate_linear(wide, SITES.block(slice(0, wide.size)))

    assert found.slope == pytest.approx(exponent * (wide / 50.0) ** (exponent - 1.0), rel=1e-6)
    assert found.deviation is None


@pytest.mark.parametrize("factor", [1e-9, 0.3, 1.0, 7.0])
def test_proportional_effects_have_exact_slope(factor):
    """The default agrees with a number to 1e-12, at means of 1e-3 to 1e6."""

    class Gain(Power):
        def moments(self, mean, variance, *, sites):
            return mean * factor, variance * factor**2

    found = Gain().validate_linear(MEANS, SITES)

    assert found.slope == pytest.approx(factor, rel=1e-12)
    assert found.mean == pytest.approx(MEANS * factor, rel=1e-15)


def test_multiplicative_noise_is_proportional_to_mean():
    found = Power(spread=0.5).validate_linear(np.full(40, 3.0), SITES)

    assert found.deviation == pytest.approx(0.5 * 3.0, rel=1e-12)


def test_redefined_moments_replace_inherited_model():
    class Shifted(AdditiveNoise):
        name, stage = "shifted", "charge"

        def deviation(self, sites):
            return 2.0

    class SignalDependent(Shifted):
        def moments(self, mean, variance, *, sites):
            return 0.5 * mean, 0.25 * variance + mean

    class Again(SignalDependent):
        def linearise(self, mean, *, sites):
            return StepModel(mean, np.full(1, 3.0), np.full(1, 5.0))

    shifted, dependent, again = (
        effect().validate_linear(np.full(40, 8.0), SITES) for effect in (Shifted, SignalDependent, Again)
    )

    assert shifted.slope is None
    assert (dependent.slope[0], again.slope[0]) == pytest.approx((0.5, 3.0))
    assert (shifted.deviation[0], dependent.deviation[0], again.deviation[0]) == pytest.approx((2.0, 8.0**0.5, 5.0))


def test_wrong_shapes_name_the_method():
    class Wrong(Power):
        def linearise(self, mean, *, sites):
            return mean, np.ones(7)

    with pytest.raises(
        SimulationError, match=r"'power' must return a mean, a slope and a deviation .*check its linearise"
    ):
        Wrong().validate_linear(MEANS, SITES)


def test_factor_without_device_adds_its_spread():
    class Gain(FixedFactor):
        name, stage = "own_gain", "charge"

        def pattern(self, sites):
            return 1.2 + 0.1 * sites.device.normals(self.name)

        def pattern_moments(self, sites):
            return 1.2, 0.01

    mean = np.full(40, 30.0)
    unknown = Gain().validate_linear(mean, SITES.without_device())
    known = Gain().validate_linear(mean, SITES)

    assert unknown.slope == pytest.approx(1.2)
    assert unknown.deviation == pytest.approx(3.0)
    assert known.slope == pytest.approx(Gain().pattern(SITES))
    assert known.deviation is None


@dataclass(frozen=True)
class Compression(Effect):
    """Test effect: a response in volts that flattens at tenths of a volt."""

    name: ClassVar[str] = "compression"
    stage: ClassVar[str] = "output"
    is_temporal: ClassVar[bool] = False

    knee_v: float

    def apply(self, values, *, sites, rng):
        return self.knee_v * np.log1p(values / self.knee_v)

    def moments(self, mean, variance, *, sites):
        return self.knee_v * np.log1p(mean / self.knee_v), variance / (1.0 + mean / self.knee_v) ** 2


@pytest.mark.parametrize("knee_v", [0.05, 0.3, 2.0])
def test_curved_output_has_drawn_variance(knee_v):
    n = 40_000
    sensor = Sensor(grid(n_x=n, n_y=1, pitch_um=2.0), bits=12, v_sat_v=1.0, capacitance_f=1.6e-15, read_noise_e=10.0,
                    pedestal_v=0.02, effects=[Compression(knee_v)])  # fmt: skip
    expected_e = np.full(n, 4000.0)

    drawn = sensor.read(sensor.collect(expected_e, seed=5), seed=5).astype(np.float64)
    mean_dn, variance_dn2 = sensor.predict(expected_e)

    # The response is curved within the noise: its second derivative times the variance shifts the mean.
    assert drawn.mean() == pytest.approx(mean_dn[0], abs=5.0 * drawn.std() / np.sqrt(n) + 2.0)
    assert drawn.var() == pytest.approx(variance_dn2[0], rel=5.0 * np.sqrt(2.0 / n))

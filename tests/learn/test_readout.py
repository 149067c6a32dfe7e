"""Draws of the readout in PyTorch, compared with the predictions of the simulator; user effects; devices."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import torch
from scipy.special import ndtr

import foveasim as fs
from foveasim import learn
from foveasim.sensor.effects import AdditiveNoise, Collection, Effect, GroupedNoise, InterPixelCapacitance

N_DRAWS = 20_000


@dataclass(frozen=True)
class LineNoise(GroupedNoise):
    name: ClassVar[str] = "line_noise"
    stage: ClassVar[str] = "charge"
    deviation_e: float = 6.0

    def deviation(self, sites):
        return self.deviation_e

    def groups(self, sites):
        return np.arange(sites.layout.n_sites)[sites.index] // 7


@dataclass(frozen=True)
class Hiss(AdditiveNoise):
    name: ClassVar[str] = "hiss"
    stage: ClassVar[str] = "output"

    def deviation(self, sites):
        return 0.004


@dataclass(frozen=True)
class DeadTime(Collection):
    """Gaussian counts of a non-paralysable counter."""

    name: ClassVar[str] = "dead_time"
    fraction: float = 1e-4

    def moments(self, mean, variance, *, sites):
        slowed = 1.0 + mean * self.fraction
        return mean / slowed, (mean + variance) / slowed**3

    def cumulative(self, count, mean, *, sites):
        centre, spread2 = self.moments(mean, 0.0, sites=sites)
        return ndtr((count + 0.5 - centre) / np.sqrt(np.maximum(spread2, 1e-9)))


@dataclass(frozen=True)
class Compression(Effect):
    """Deterministic, nonlinear effect on charges."""

    name: ClassVar[str] = "compression"
    stage: ClassVar[str] = "charge"
    is_temporal: ClassVar[bool] = False

    def apply(self, values, *, sites, rng):
        return values / (1.0 + np.maximum(values, 0.0) * 3e-5)

    def moments(self, mean, variance, *, sites):
        slowed = 1.0 + np.maximum(mean, 0.0) * 3e-5
        return mean / slowed, variance / slowed**4


def sensor(**changes):
    layout = fs.layout.hexagonal(n_columns=7, n_rows=6, pitch_um=3.0)
    settings = {"capacitance_f": 1e-14, "read_noise_e": 3.0, "v_sat_v": 1.0, "bits": 8}
    return fs.Sensor(layout, **{**settings, **changes})


SENSORS = {
    "plain": {},
    "few": {"read_noise_e": 0.3, "capacitance_f": 1.6e-16, "brightest_e": 40.0},
    "coupled": {"coupling": InterPixelCapacitance(neighbour_fraction=0.03)},
    "nonlinear": {"nonlinearity_fraction": 0.05, "pedestal_v": 0.03, "companding": "log"},
    "patterns": {"gain_fpn_fraction": 0.02, "pixel_fpn_fraction": 0.01, "line_fpn_fraction": 0.01, "ktc_noise": True},
    "states": {"rts_fraction": 0.4, "rts_e": 60.0},
    "full": {"full_well_e": 2000.0},
    "converter": {"dnl_dn": 0.5, "inl_dn": (0.0, 2.0, -1.0, 0.0)},
    "rounded": {"shot_noise": "off"},
    "lines": {"effects": [LineNoise()], "bits": 14},
    "coupled lines": {"effects": [LineNoise()], "bits": 14, "coupling": InterPixelCapacitance(neighbour_fraction=0.03)},
    "hiss": {"effects": [Hiss()], "nonlinearity_fraction": 0.05},
    "counter": {"effects": [DeadTime()]},
    "compressed": {"effects": [Compression()]},
}


def built(name):
    changes = dict(SENSORS[name])
    brightest_e = changes.pop("brightest_e", 5500.0)
    device = sensor(**changes)
    return device, np.linspace(0.01 * brightest_e, brightest_e, device.layout.n_sites)


@pytest.mark.parametrize("name", SENSORS)
def test_drawn_codes_agree_with_prediction(name):
    """Mean and variance within 5 standard errors; the variance's from the fourth moment of the draws."""
    device, expected_e = built(name)
    readout = learn.Readout(device)
    charges = readout.draw(torch.from_numpy(expected_e).expand(N_DRAWS, -1), torch.Generator().manual_seed(2))
    code = readout.code(charges).numpy()
    mean, variance = device.predict(expected_e)
    deviations = code - code.mean(axis=0)
    error = np.sqrt(np.maximum(variance, 1e-4) / N_DRAWS)
    error_of_variance = np.sqrt(np.maximum((deviations**4).mean(axis=0) - deviations.var(axis=0) ** 2, 1e-4) / N_DRAWS)

    np.testing.assert_array_less(np.abs(code.mean(axis=0) - mean), 5.0 * error)
    np.testing.assert_array_less(np.abs(code.var(axis=0, ddof=1) - variance), 5.0 * error_of_variance)


@pytest.mark.parametrize("name", [name for name in SENSORS if name not in ("converter", "states", "rounded")])
def test_mean_codes_agree_with_prediction(name):
    """The Gaussian mean differs from the exact one by the shape of the distribution."""
    device, expected_e = built(name)
    found = learn.Readout(device).expected_code(torch.from_numpy(expected_e)).numpy()

    np.testing.assert_allclose(found, device.predict(expected_e)[0], rtol=0, atol=0.03 * 2 ** (device.bits - 8))


@pytest.mark.parametrize("name", ["lines", "coupled lines"])
def test_groups_share_draws(name):
    """Covariances of sites of a line, and of neighbours of different lines."""
    device, expected_e = built(name)
    readout, sites = learn.Readout(device), np.array([8, 9, 12, 15, 16])
    charges = readout.draw(torch.from_numpy(expected_e).expand(N_DRAWS, -1), torch.Generator().manual_seed(3))
    code = readout.code(charges).numpy()[:, sites]
    expected = device.predict_covariance(expected_e, sites)
    error = np.sqrt((np.multiply.outer(np.diag(expected), np.diag(expected)) + expected**2) / N_DRAWS)

    np.testing.assert_array_less(np.abs(np.cov(code.T) - expected), 5.0 * error)


@pytest.mark.parametrize("name", SENSORS)
def test_variances_pass_gradcheck(name):
    device, expected_e = built(name)
    readout = learn.Readout(device)
    charge = torch.from_numpy(expected_e).requires_grad_()

    def results(charge):
        drawn = readout.draw(charge, torch.Generator().manual_seed(0)) if name not in DISCRETE else charge
        return readout.variance_e2(charge), readout.voltage(drawn) * 1e3

    assert torch.autograd.gradcheck(results, (charge,), atol=1e-4, rtol=1e-4, eps=1e-3)


#: Sensors whose draws are integers, whose differences are not derivatives.
DISCRETE = [name for name in SENSORS if name != "counter"]


def test_poisson_gradient_is_that_of_standard_numbers():
    readout = learn.Readout(sensor(read_noise_e=0.0))
    mean = torch.full((2000, readout.sensor.layout.n_sites), 50.0, dtype=torch.float64, requires_grad=True)
    drawn = readout.draw(mean, torch.Generator().manual_seed(1))
    # The derivative of the mean square, m + m²; standard error from 84,000 draws.
    (drawn**2).sum().backward()
    per_draw = mean.grad

    assert torch.equal(drawn, drawn.round())
    assert abs(float(per_draw.mean()) - 101.0) < 5.0 * float(per_draw.std()) / per_draw.numel() ** 0.5


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", SENSORS)
def test_readout_runs_on_devices(name, dtype, device):
    original, expected_e = built(name)
    readout = learn.Readout(original)
    charge = torch.from_numpy(expected_e).to(device=device, dtype=dtype).expand(3, -1)
    drawn = readout.draw(charge)
    results = (
        drawn,
        readout.voltage(drawn),
        readout.code(drawn),
        readout.expected_code(charge),
        readout.variance_e2(charge),
    )

    assert all((part.shape, part.dtype, part.device.type) == (charge.shape, dtype, device.type) for part in results)


@pytest.mark.parametrize("name", SENSORS)
def test_equal_generators_give_equal_draws(name):
    device, expected_e = built(name)
    charge = torch.from_numpy(expected_e)
    first, again, other = (
        learn.Readout(device).draw(charge, torch.Generator().manual_seed(seed)) for seed in (5, 5, 6)
    )

    assert torch.equal(first, again)
    assert name == "rounded" or not torch.equal(first, other)


def test_readout_can_be_pickled_after_use():
    device, expected_e = built("coupled lines")
    readout, charge = learn.Readout(device), torch.from_numpy(expected_e)
    before = readout.draw(charge, torch.Generator().manual_seed(0))
    again = pickle.loads(pickle.dumps(readout))

    assert torch.equal(again.draw(charge, torch.Generator().manual_seed(0)), before)


def test_wrong_generators_are_rejected():
    readout = learn.Readout(sensor())
    charge = torch.ones(readout.sensor.layout.n_sites, device="meta")
    with pytest.raises(fs.FoveasimError, match="'generator' must be on the device of the charges"):
        readout.draw(charge, torch.Generator())


def test_collections_of_an_exposure_require_it():
    @dataclass(frozen=True)
    class Slow(DeadTime):
        needs_exposure: ClassVar[bool] = True

        def moments(self, mean, variance, *, sites):
            slowed = 1.0 + mean * 1e-6 / sites.exposure_s
            return mean / slowed, (mean + variance) / slowed**3

    device = sensor(effects=[Slow()])
    with pytest.raises(fs.FoveasimError, match="'exposure_s' must be given: the collection 'dead_time'"):
        learn.Readout(device)
    expected_e = np.linspace(100.0, 4000.0, device.layout.n_sites)
    found = learn.Readout(device, exposure_s=0.01).expected_code(torch.from_numpy(expected_e)).numpy()
    np.testing.assert_allclose(found, device.predict(expected_e, exposure_s=0.01)[0], rtol=0, atol=0.03)

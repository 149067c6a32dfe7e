"""Sensor chain as differentiable functions of charges, on any device."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from foveasim.errors import ParameterError
from foveasim.learn._tensors import Constants, SparseMap, check_tensor
from foveasim.sensor import Sensor
from foveasim.sensor.adc import CODE_ROUNDING
from foveasim.sensor.effects.crosstalk import CrosstalkOperator
from foveasim.sensor.model.prediction import MIN_SLOPE
from foveasim.sensor.model.tabulation import Curve, LocalStep, tabulate

__all__ = ["Readout"]

#: Memory limit: elements of the table of probabilities, sites x codes, that are computed at once.
MAX_PROBABILITIES = 2**22
#: Smallest variance of a draw: the derivative of its square root is finite.
MIN_VARIANCE = 1e-12
#: Distance from the full well, in standard deviations, from which it clips nothing.
CLIPPED_SIGMAS = 8.0


class Readout:
    """
    Electronics of a sensor for tensors of shape (..., n_site).

    Results have the device and the dtype of the input. Fixed patterns are those of the device. Quantities per site that depend
    on the area, such as a capacitance per µm², remain those of the layout of the sensor.

    Parameters
    ----------
    sensor : Sensor
    exposure_s : float, optional, s
        Required by collections that depend on it.

    Raises
    ------
    ParameterError
        If the collection of the sensor depends on the exposure time, and none is given.

    Notes
    -----
    Draws follow the chain of the sensor: one draw of the collected charge, the full well, and then one draw of each effect,
    common to the sites of its groups. Shot noise is Poisson-distributed; its gradient is that of ``mean + sd * z`` with the
    standardised draw z. For a nonlinear loss this gradient is biased at few electrons: by 5 % at 0.5 e-, by 0.2 % at 5 e-.
    Other collections are Gaussian with their mean and variance. Effects that are not linear are interpolated between 1,025
    charges or voltages.
    """

    def __init__(self, sensor: Sensor, exposure_s: float | None = None) -> None:
        if sensor.collection.needs_exposure and exposure_s is None:
            raise ParameterError(
                "exposure_s", f"must be given: the collection '{sensor.collection.name}' of the sensor depends on it"
            )
        self.sensor = sensor
        self._steps = steps = tabulate(sensor, exposure_s)
        self._n_sites = n = sensor.layout.n_sites
        # Expected charges are affine in light and exposure.
        zero = np.zeros(n)
        at_once_e = sensor.expected_electrons(zero, 0.0)
        self._constants = Constants(
            dark_e=at_once_e,
            dark_e_per_s=sensor.expected_electrons(zero, 1.0) - at_once_e,
            well_e=np.broadcast_to(steps.well_e, n),
            levels=sensor.adc.transition_levels,
            level_v=sensor.adc.transition_levels[1:-1] * steps.v_sat_v,
        )
        self._light = [
            _Mixing(slope) if isinstance(slope, CrosstalkOperator) else _Local(LocalStep(slope, np.zeros(1)), n)
            for slope in steps.response
        ]
        self._collection = _Local(steps.collection, n)
        self._charge = _built(steps.charge, n)
        # From charges to voltages at the ADC.
        response = _Response(steps.nonlinearity_fraction, steps.v_sat_v)
        self._signal = [*_built(steps.sense, n), response, *_built(steps.output, n)]
        self._has_signal_noise = any(step.is_noisy for step in self._signal)
        if steps.dnl_dn is not None:
            first_offset = steps.line_of_site * sensor.adc.n_codes
            self._constants.add(dnl_dn=steps.dnl_dn.ravel(), first_offset=first_offset)

    def __repr__(self) -> str:
        return f"Readout({self.sensor!r})"

    def _check(self, name: str, values: object) -> Tensor:
        if not isinstance(values, Tensor) or values.ndim == 0:
            check_tensor(name, values, (self._n_sites,), " or (..., n_site)", any_device=True)
        assert isinstance(values, Tensor)
        expected = (*([None] * (values.ndim - 1)), self._n_sites)
        return check_tensor(name, values, expected, ", with one column per site", any_device=True)

    def expected_e(self, photo_e_per_s: Tensor, exposure_s: Tensor | float) -> Tensor:
        """
        Compute the expected charge of each site, as :meth:`Sensor.expected_electrons`.

        Parameters
        ----------
        photo_e_per_s : (..., n_site) tensor, e-/s
            Expected photoelectrons per second.
        exposure_s : float or tensor of shape () or (..., 1), s

        Returns
        -------
        (..., n_site) tensor, e-
            Photoelectrons and dark signal, after charge diffusion.
        """
        rates = self._check("photo_e_per_s", photo_e_per_s)
        dark_e, dark_e_per_s = (self._constants.get(name, rates) for name in ("dark_e", "dark_e_per_s"))
        found = rates * exposure_s
        for step in self._light:
            found = step.mean(found)
        return found + (dark_e + dark_e_per_s * exposure_s)

    # -- charges ----------------------------------------------------------------------------------------------------

    def _limited(self, charge_e: Tensor) -> Tensor:
        return torch.minimum(charge_e, self._constants.get("well_e", charge_e))

    def _moments(self, expected_e: Tensor) -> _Moments:
        """Return the moments of the charges that are converted to voltages."""
        collected = self._collection.propagate(_Moments(expected_e, torch.zeros_like(expected_e), ()))
        if np.isfinite(self._steps.well_e).any():
            mean_e, variance_e2 = _clipped(*collected[:2], self._constants.get("well_e", expected_e))
            collected = collected._replace(mean=mean_e, variance=variance_e2)
        return _propagate(collected, self._charge)

    def variance_e2(self, expected_e: Tensor) -> Tensor:
        """
        Compute the temporal variance of the charges that are converted to voltages.

        Parameters
        ----------
        expected_e : (..., n_site) tensor, e-

        Returns
        -------
        (..., n_site) tensor, e-²
            Shot noise, clipped at the full well, reset noise, read noise and RTS noise; without quantisation.
        """
        expected_e = self._check("expected_e", expected_e)
        moments = self._moments(expected_e)
        if not self._has_signal_noise:
            return moments.total
        added = _propagate(_Moments(moments.mean, torch.zeros_like(moments.mean), ()), self._signal)
        return moments.total + added.total / torch.square(self._transfer(moments.mean)[1])

    def draw(self, expected_e: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """
        Draw charges with temporal noise.

        Gradients pass through means and standard deviations (reparameterisation).

        Parameters
        ----------
        expected_e : (..., n_site) tensor, e-
        generator : torch.Generator, optional
            Random numbers, of the device of the charges; those of torch by default.

        Returns
        -------
        (..., n_site) tensor, e-
            Charges that are converted to voltages, with the noise of the readout. Noise of later effects is referred to these
            charges.
        """
        expected_e = self._check("expected_e", expected_e)
        if generator is not None and generator.device.type != expected_e.device.type:
            raise ParameterError(
                "generator",
                f"must be on the device of the charges, {expected_e.device}, got one on {generator.device}",
                hint="create it with torch.Generator(device)",
            )
        charge_e = self._limited(self._collection.draw(expected_e, generator))
        for step in self._charge:
            charge_e = step.draw(charge_e, generator)
        if not self._has_signal_noise:
            return charge_e
        volts, added = charge_e, torch.zeros_like(charge_e)
        for step in self._signal:
            added = step.slope(volts) * added + step.noise(volts, generator)
            volts = step.mean(volts)
        return charge_e + added / self._transfer(charge_e)[1]

    # -- voltages and codes -----------------------------------------------------------------------------------------

    def voltage(self, charge_e: Tensor) -> Tensor:
        """
        Convert charges to voltages at the ADC, before clipping.

        Parameters
        ----------
        charge_e : (..., n_site) tensor, e-
            Charges that are converted to voltages, such as those of :meth:`draw`.

        Returns
        -------
        (..., n_site) tensor, V
            Conversion gain, fixed patterns, response nonlinearity and pedestal.
        """
        return self._transfer(self._check("charge_e", charge_e))[0]

    def _transfer(self, charge_e: Tensor) -> tuple[Tensor, Tensor]:
        """Return the voltages of charges, and the derivatives of the voltages."""
        volts, slope = charge_e, torch.ones_like(charge_e)
        for step in self._signal:
            slope = slope * step.slope(volts)
            volts = step.mean(volts)
        return volts, slope

    def code(self, charge_e: Tensor, *, adc: Literal["straight_through", "linear"] = "straight_through") -> Tensor:
        """
        Convert charges to codes.

        Parameters
        ----------
        charge_e : (..., n_site) tensor, e-
        adc : {"straight_through", "linear"}
            Codes as by the ADC, with the gradient of the linear characteristic within its range; or this characteristic itself.

        Returns
        -------
        (..., n_site) tensor, DN
        """
        fraction = self.voltage(charge_e) / self._steps.v_sat_v
        levels, n_codes = self._constants.get("levels", fraction), self.sensor.adc.n_codes
        # Piecewise linear through the centres of the steps, flat outside.
        position = torch.clamp(fraction, 0.0, 1.0)
        at = position.detach()
        if self.sensor.adc.is_linear:
            index = torch.floor(at * n_codes + CODE_ROUNDING).clamp(0, n_codes - 1).long()
        else:
            index = (torch.searchsorted(levels, at.contiguous(), right=True) - 1).clamp(0, n_codes - 1)
        if self.sensor.adc.is_linear:
            value = position * n_codes
        else:
            low = levels[index]
            value = index.to(fraction.dtype) + (position - low) / (levels[index + 1] - low).clamp_min(1e-12)
        linear = torch.clamp(value - 0.5, 0.0, n_codes - 1.0)
        if adc == "linear":
            return linear
        code = index.to(fraction.dtype)
        if "dnl_dn" in self._constants:
            offset = self._constants.get("dnl_dn", code)[self._constants.get("first_offset", code) + index]
            code = torch.floor(value.detach() + offset + CODE_ROUNDING).clamp(0, n_codes - 1)
        return linear + (code - linear).detach()

    def expected_code(self, expected_e: Tensor) -> Tensor:
        """
        Compute the mean code over temporal noise, as :meth:`Sensor.predict`.

        Parameters
        ----------
        expected_e : (..., n_site) tensor, e-

        Returns
        -------
        (..., n_site) tensor, DN
            Sum over all codes of the probability that the voltage exceeds the transition level. The noise is Gaussian; DNL is
            not included.
        """
        moments = self._moments(self._check("expected_e", expected_e))
        signal = _propagate(moments, self._signal)
        mean_v, slope = signal.mean, self._transfer(moments.mean)[1]
        smallest_v2 = (slope * slope * MIN_VARIANCE).clamp_min(torch.finfo(mean_v.dtype).tiny)
        deviation = torch.sqrt(torch.maximum(signal.total, smallest_v2))
        levels = self._constants.get("level_v", mean_v)
        flat, width = mean_v.reshape(-1), (deviation * math.sqrt(2.0)).reshape(-1)
        n = max(1, MAX_PROBABILITIES // levels.numel())
        parts = [
            0.5 * torch.erfc((levels - flat[k : k + n, None]) / width[k : k + n, None]).sum(dim=1)
            for k in range(0, flat.numel(), n)
        ]
        return torch.cat(parts).reshape(mean_v.shape)


def _clipped(mean: Tensor, variance: Tensor, limit: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and variance of a Gaussian variable clipped at an upper limit."""
    deviation = torch.sqrt(variance.clamp_min(MIN_VARIANCE))
    is_clipped = limit < mean + CLIPPED_SIGMAS * deviation
    z = torch.where(is_clipped, (torch.where(is_clipped, limit, mean) - mean) / deviation, CLIPPED_SIGMAS)
    z = z.clamp_min(-CLIPPED_SIGMAS)
    below = 0.5 * torch.erfc(-z / math.sqrt(2.0))
    density = torch.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    # Moments of the distance to the limit.
    distance = deviation * (z * below + density)
    squared = deviation * deviation * ((1.0 + z * z) * below + z * density)
    clipped_mean = torch.where(is_clipped, torch.where(is_clipped, limit, mean) - distance, mean)
    return clipped_mean, torch.where(is_clipped, (squared - distance * distance).clamp_min(0.0), variance)


class _Moments(NamedTuple):
    """Moments of values: variance per site, and deviations common to groups with labels."""

    mean: Tensor
    variance: Tensor
    groups: tuple[tuple[Tensor, Any], ...]

    @property
    def total(self) -> Tensor:
        """Variance of each site."""
        total = self.variance
        for deviation, _ in self.groups:
            total = total + deviation * deviation
        return total

    def scaled(self, mean: Tensor, slope: Tensor) -> _Moments:
        """Return the moments after a step with a mean and a slope."""
        groups = tuple((deviation * slope, labels) for deviation, labels in self.groups)
        return _Moments(mean, self.variance * (slope * slope), groups)


def _propagate(moments: _Moments, steps: Iterable[Any]) -> _Moments:
    for step in steps:
        moments = step.propagate(moments)
    return moments


def _built(steps: Sequence[LocalStep | CrosstalkOperator], n_sites: int) -> list[Any]:
    return [_Local(step, n_sites) if isinstance(step, LocalStep) else _Mixing(step) for step in steps]


class _Response:
    """Quadratic response nonlinearity."""

    is_noisy = False

    def __init__(self, nonlinearity_fraction: float, v_sat_v: float) -> None:
        self._loss, self._v_sat_v = nonlinearity_fraction, v_sat_v

    def mean(self, volts: Tensor) -> Tensor:
        """Return the voltages after the nonlinearity."""
        return volts * (1.0 - self._loss * torch.clamp(volts / self._v_sat_v, 0.0, 1.0)) if self._loss else volts

    def slope(self, volts: Tensor) -> Tensor:
        """Return the derivative; outside the range the relative loss is constant."""
        fraction = torch.clamp(volts / self._v_sat_v, 0.0, 1.0)
        is_within = (volts > 0.0) & (volts < self._v_sat_v)
        return (1.0 - torch.where(is_within, 2.0, 1.0) * self._loss * fraction).clamp_min(MIN_SLOPE)

    def noise(self, volts: Tensor, generator: torch.Generator | None) -> Tensor:
        """Return no noise."""
        del generator
        return torch.zeros_like(volts)

    def propagate(self, moments: _Moments) -> _Moments:
        """Return the moments after the step."""
        return moments.scaled(self.mean(moments.mean), self.slope(moments.mean))


class _Mixing:
    """Step that mixes sites."""

    is_noisy = False

    def __init__(self, operator: CrosstalkOperator) -> None:
        matrix = operator.matrix
        for _ in range(operator.n_steps - 1):
            matrix = operator.matrix @ matrix
        self._matrix, self._squares = SparseMap(matrix), SparseMap(matrix.multiply(matrix))
        self._groups: dict[int, tuple[Any, Constants, int]] = {}

    def mean(self, values: Tensor) -> Tensor:
        return self._matrix.apply(values)

    def draw(self, values: Tensor, generator: torch.Generator | None) -> Tensor:
        del generator
        return self.mean(values)

    def propagate(self, moments: _Moments) -> _Moments:
        variance = self._squares.apply(moments.variance)
        for deviation, labels in moments.groups:
            variance = variance + self._of_groups(deviation, labels)
        return _Moments(self.mean(moments.mean), variance, ())

    def _of_groups(self, deviation: Tensor, labels: Any) -> Tensor:
        """Return the variance after mixing of noise that is common to groups."""
        if id(labels) not in self._groups:
            entries, n_groups = self._matrix.entries, int(labels.max(initial=0)) + 1
            keys, sums = np.unique(entries.row * n_groups + labels[entries.col], return_inverse=True)
            # Contributions of a group to a site add up before they are squared.
            constants = Constants(column=entries.col, data=entries.data, sum=sums.ravel(), row=keys // n_groups)
            self._groups[id(labels)] = labels, constants, keys.size
        _, constants, n_sums = self._groups[id(labels)]
        column, data, of_sum, row = (constants.get(name, deviation) for name in ("column", "data", "sum", "row"))
        entries = deviation[..., column] * data
        sums = entries.new_zeros(*entries.shape[:-1], n_sums).index_add(-1, of_sum, entries)
        return torch.zeros_like(deviation).index_add(-1, row, sums * sums)


class _Local:
    """Step that does not mix sites."""

    def __init__(self, step: LocalStep, n_sites: int) -> None:
        self._step = step
        self.labels = {f"labels {k}": each.labels for k, each in enumerate(step.groups)}
        self._constants = Constants(
            slope=step.slope, offset=step.offset, variance=step.variance, variance_slope=step.variance_slope,
            half_step=step.half_step, **self.labels,
            **{f"deviation {k}": each.deviation for k, each in enumerate(step.groups)},
        )  # fmt: skip
        self._curve = None if step.curve is None else _Curve(step.curve, n_sites)
        self._variance = None if step.variance_curve is None else _Curve(step.variance_curve, n_sites)
        self._deviations = [None if each.curve is None else _Curve(each.curve, n_sites) for each in step.groups]
        self._has_variance = (
            self._variance is not None or bool(np.any(step.variance)) or bool(np.any(step.variance_slope))
        )
        self._has_states = bool(np.any(step.half_step))
        self.is_noisy = self._has_variance or self._has_states or bool(step.groups)

    def mean(self, values: Tensor) -> Tensor:
        """Return the mean after the step."""
        if self._curve is not None:
            return self._curve(values)
        return values * self._constants.get("slope", values) + self._constants.get("offset", values)

    def slope(self, values: Tensor) -> Tensor:
        """Return the derivative of the mean."""
        return self._constants.get("slope", values) if self._curve is None else self._curve.slope(values)

    def _variance_at(self, values: Tensor) -> Tensor:
        if self._variance is not None:
            return self._variance(values).clamp_min(0.0)
        constants = self._constants
        rise = constants.get("variance_slope", values)
        return constants.get("variance", values) + rise * values.clamp_min(0.0)

    def _group_deviation(self, k: int, values: Tensor) -> Tensor:
        curve = self._deviations[k]
        if curve is not None:
            return curve(values)
        return self._constants.get(f"deviation {k}", values).expand(values.shape[-1:])

    def propagate(self, moments: _Moments) -> _Moments:
        """Return the moments after the step."""
        before = moments.mean
        found = moments.scaled(self.mean(before), self.slope(before))
        variance, groups = found.variance, found.groups
        if self._has_variance:
            variance = variance + self._variance_at(before)
        if self._has_states:
            variance = variance + self._constants.get("half_step", before) ** 2
        for k, name in enumerate(self.labels):
            deviation = self._group_deviation(k, before).expand(before.shape)
            groups = (*groups, (deviation, self.labels[name]))
        return _Moments(found.mean, variance, groups)

    def draw(self, values: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draw the values after the step."""
        if self._step.distribution == "rounded":
            mean = self.mean(values)
            return mean + (torch.round(mean) - mean).detach()
        if self._step.distribution == "poisson":
            with torch.no_grad():
                count = torch.poisson(values.clamp_min(0.0), generator)
            if not values.requires_grad:
                return count
            deviation = torch.sqrt(values.clamp_min(MIN_VARIANCE))
            drawn = values + deviation * ((count - values) / deviation).detach()
            return drawn + (count - drawn).detach()
        return self.mean(values) + self.noise(values, generator)

    def noise(self, values: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draw the noise that the step adds."""
        total: Tensor | float = 0.0
        if self._has_variance:
            total = torch.sqrt(self._variance_at(values).clamp_min(MIN_VARIANCE)) * _normals(values, generator)
        if self._has_states:
            states = torch.rand(values.shape, generator=generator, dtype=values.dtype, device=values.device) < 0.5
            total = total + torch.where(states, -1.0, 1.0) * self._constants.get("half_step", values)
        for k, (name, labels) in enumerate(self.labels.items()):
            n_groups = int(labels.max(initial=0)) + 1
            common = _normals(values.new_empty((*values.shape[:-1], n_groups)), generator)
            total = total + self._group_deviation(k, values) * common[..., self._constants.get(name, values)]
        return total if isinstance(total, Tensor) else torch.zeros_like(values)


def _normals(like: Tensor, generator: torch.Generator | None) -> Tensor:
    return torch.randn(like.shape, generator=generator, dtype=like.dtype, device=like.device)


class _Curve:
    """Cubic Hermite interpolation, with straight continuations."""

    def __init__(self, curve: Curve, n_sites: int) -> None:
        self._curve = curve
        n_nodes, self._n_columns = curve.value.shape
        nodes = curve.start + curve.step * np.arange(n_nodes)
        index = np.arange(n_sites) if self._n_columns > 1 else np.zeros(n_sites, np.int64)
        self._constants = Constants(
            node=nodes**2 if curve.is_root else nodes,
            value=curve.value.ravel(),
            slope=curve.slope.ravel(),
            column=index,
        )

    def _at(self, values: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Return positions in intervals, their widths, and values and slopes at both ends."""
        get, curve = self._constants.get, self._curve
        t = torch.sqrt(values.detach().clamp_min(0.0)) if curve.is_root else values.detach()
        k = torch.floor((t - curve.start) / curve.step).clamp(0, curve.value.shape[0] - 2).long()
        low, high = (get("node", values)[k + j] for j in (0, 1))
        first = k * self._n_columns + get("column", values)
        parts = [get(name, values)[first + j * self._n_columns] for name in ("value", "slope") for j in (0, 1)]
        width = high - low
        return (values - low) / width, width, parts

    def __call__(self, values: Tensor) -> Tensor:
        """Return the values of the curve."""
        s, width, (y0, y1, m0, m1) = self._at(values)
        u = s.clamp(0.0, 1.0)
        inner = (
            y0 * ((1.0 + 2.0 * u) * (1.0 - u) ** 2)
            + y1 * (u * u * (3.0 - 2.0 * u))
            + width * (m0 * (u * (1.0 - u) ** 2) - m1 * (u * u * (1.0 - u)))
        )
        return inner + (s - u) * width * torch.where(s > 0.5, m1, m0)

    def slope(self, values: Tensor) -> Tensor:
        """Return the derivatives of the curve."""
        s, width, (y0, y1, m0, m1) = self._at(values)
        u = s.clamp(0.0, 1.0)
        return (y1 - y0) / width * (6.0 * u * (1.0 - u)) + m0 * (1.0 - u) * (1.0 - 3.0 * u) + m1 * u * (3.0 * u - 2.0)

"""Sensor chain as differentiable functions of charges."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from foveasim.errors import ParameterError
from foveasim.learn._tensors import check_tensor, constant
from foveasim.sensor import Sensor
from foveasim.sensor.effects import ShotNoise
from foveasim.sensor.model.linearisation import QUANTISATION
from foveasim.sensor.model.records import scale_columns

__all__ = ["Readout"]

#: Memory limit: elements of the table of probabilities, sites x codes, that are computed at once.
MAX_PROBABILITIES = 2**22


class Readout:
    """
    Electronics of a sensor for tensors of shape (..., n_site).

    Fixed patterns are those of the device. Quantities per site that depend on the area, such as a capacitance per µm²,
    remain those of the layout of the sensor.

    Raises
    ------
    ParameterError
        If the collection of the sensor depends on the exposure time.

    Notes
    -----
    The statistics are those of :meth:`Sensor.linearise`: Gaussian temporal noise, to first order at the mean. A shot-noise
    gradient by reparameterisation is biased for a nonlinear loss at few electrons: by 5 % at 0.5 e-, by 0.2 % at 5 e-.
    """

    def __init__(self, sensor: Sensor) -> None:
        if sensor.collection.needs_exposure:
            raise ParameterError(
                "sensor", f"must have a collection that does not depend on the exposure, got '{sensor.collection.name}'"
            )
        self.sensor = sensor
        self._n_sites = sensor.layout.n_sites
        # Expected charges are affine in light and exposure.
        zero = np.zeros(self._n_sites)
        at_once_e = sensor.expected_electrons(zero, 0.0)
        self._dark_e = self._per_site(at_once_e)
        self._dark_e_per_s = self._per_site(sensor.expected_electrons(zero, 1.0) - at_once_e)
        model = sensor.linearise(zero, exposure_s=1.0)
        self._light = [step for slope in model.slopes("light", "charge") for step in self._steps(slope)]
        coupling: list[Any] = model.slopes("collected", "node")
        self._coupling = [self._matrix(coupling)] if coupling else []
        mixing = [effect.name for effect in sensor.chain if effect.stage == "charge" and effect.reach == "all"]
        self._local = sensor.without(*mixing) if mixing else sensor

    def __repr__(self) -> str:
        return f"Readout({self.sensor!r})"

    def _check(self, name: str, values: object) -> Tensor:
        if not isinstance(values, Tensor) or values.ndim == 0:
            check_tensor(name, values, (self._n_sites,), " or (..., n_site)")
        assert isinstance(values, Tensor)
        check_tensor(name, values.reshape(-1, values.shape[-1]), (None, self._n_sites), ", with one column per site")
        return values

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
        dark_e = self._dark_e.to(rates.dtype) + self._dark_e_per_s.to(rates.dtype) * exposure_s
        return _map(rates * exposure_s, self._light) + dark_e

    def _mean(self, charge_e: Tensor) -> Any:
        """Return the mean charge of each site over all rows."""
        return np.maximum(charge_e.detach().numpy().reshape(-1, self._n_sites).mean(axis=0), 0.0)

    def _collect(self, expected_e: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and variance of the charge at the sense nodes."""
        mean_e, collection = self._mean(expected_e), self.sensor.collection
        model = self.sensor.linearise(mean_e)
        collected = expected_e
        for slope in model.slopes("charge", "collected"):
            at_mean, per_e = (self._per_site(part, expected_e) for part in (model.collected_e - mean_e * slope, slope))
            collected = at_mean + per_e * expected_e
        if isinstance(collection, ShotNoise):
            drawn_e2 = expected_e if collection.is_drawn else torch.zeros_like(expected_e)
        else:
            drawn_e2 = self._per_site(collection.moments(mean_e, np.zeros(1), sites=self.sensor.sites)[1], expected_e)
        readout = [name for name, kind in model.sources.items() if kind != "fixed"]
        noise_e2 = model.variance_e2([name for name in readout if name not in (collection.name, QUANTISATION)])
        squares = [matrix * matrix for matrix in self._coupling]
        return _map(collected, self._coupling), _map(drawn_e2, squares) + self._per_site(noise_e2, expected_e)

    def variance_e2(self, expected_e: Tensor) -> Tensor:
        """
        Compute the temporal variance of the charges, referred to the sense node.

        Parameters
        ----------
        expected_e : (..., n_site) tensor, e-

        Returns
        -------
        (..., n_site) tensor, e-²
            Shot noise, reset noise, read noise and RTS noise; without quantisation.
        """
        return self._collect(self._check("expected_e", expected_e))[1]

    def draw(self, expected_e: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """
        Draw charges with temporal noise: mean plus standard deviation times a Gaussian number.

        Gradients pass through mean and variance (reparameterisation).

        Parameters
        ----------
        expected_e : (..., n_site) tensor, e-
        generator : torch.Generator, optional
            Random numbers; those of torch by default.

        Returns
        -------
        (..., n_site) tensor, e-
            Charges, limited by the full well capacity, including the noise of the readout.
        """
        expected_e = self._check("expected_e", expected_e)
        noise = torch.randn(expected_e.shape, generator=generator, dtype=expected_e.dtype)
        mean, variance = self._collect(expected_e)
        return self._limited(mean + torch.sqrt(variance.clamp_min(1e-12)) * noise)

    def _steps(self, slope: Any) -> list[Tensor]:
        """Return a slope as tensors: factors (n_site,), or sparse matrices."""
        if isinstance(slope, np.ndarray):
            return [self._per_site(slope)]
        return [_sparse(slope.matrix)] * slope.n_steps

    def _matrix(self, slopes: list[Any]) -> Tensor:
        """Return the product of slopes as a sparse matrix."""
        from scipy.sparse import eye_array

        n = self._n_sites
        rows: Any = eye_array(n, format="csr")
        for slope in reversed(slopes):
            rows = scale_columns(rows, slope) if isinstance(slope, np.ndarray) else slope.rows(rows)
        return _sparse(rows)

    def _per_site(self, values: Any, like: Tensor | None = None) -> Tensor:
        """Return numbers, or one number, as a tensor (n_site,)."""
        found = constant(np.broadcast_to(values, self._n_sites))
        return found if like is None else found.to(like.dtype)

    def _limited(self, charge_e: Tensor) -> Tensor:
        return torch.minimum(charge_e, self._per_site(self.sensor.well_e, charge_e))

    def voltage(self, charge_e: Tensor) -> Tensor:
        """
        Convert charges to voltages at the ADC, before clipping.

        Parameters
        ----------
        charge_e : (..., n_site) tensor, e-
            Charges at the sense nodes, such as those of :meth:`draw`.

        Returns
        -------
        (..., n_site) tensor, V
            Conversion gain, fixed patterns, response nonlinearity and pedestal.
        """
        return self._transfer(self._check("charge_e", charge_e))[0]

    def _transfer(self, charge_e: Tensor) -> tuple[Tensor, Tensor]:
        """Return the voltages of charges, and the derivatives of the voltages."""
        transfer = self._local.readout_model(self._mean(charge_e)).transfer
        gain, sense, scale, output = (
            self._per_site(part, charge_e)
            for part in (transfer.v_per_e, transfer.sense_v, transfer.scale, transfer.output_v)
        )
        volts = charge_e * gain + sense
        loss = transfer.nonlinearity_fraction * torch.clamp(volts / transfer.v_sat_v, 0.0, 1.0)
        within = (volts > 0.0) & (volts < transfer.v_sat_v)
        slope = gain * scale * (1.0 - torch.where(within, 2.0, 1.0) * loss)
        return volts * (1.0 - loss) * scale + output, slope

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
            DNL is not included.
        """
        fraction = self.voltage(charge_e) / self.sensor.v_sat_v
        levels = constant(self.sensor.adc.transition_levels).to(fraction.dtype)
        n_codes = self.sensor.adc.n_codes
        # Piecewise linear through the centres of the steps, flat outside.
        position = torch.clamp(fraction, 0.0, 1.0)
        index = torch.clamp(torch.searchsorted(levels, position.detach().contiguous(), right=True) - 1, 0, n_codes - 1)
        width = (levels[index + 1] - levels[index]).clamp_min(1e-12)
        linear = index.to(fraction.dtype) + (position - levels[index]) / width - 0.5
        linear = torch.clamp(linear, 0.0, n_codes - 1.0)
        if adc == "linear":
            return linear
        return linear + (index.to(fraction.dtype) - linear).detach()

    def expected_code(self, expected_e: Tensor) -> Tensor:
        """
        Compute the mean code over temporal noise, as :meth:`Sensor.predict`.

        Parameters
        ----------
        expected_e : (..., n_site) tensor, e-

        Returns
        -------
        (..., n_site) tensor, DN
            Sum over all codes of the probability that the voltage exceeds the transition level.
        """
        mean_e, variance_e2 = self._collect(self._check("expected_e", expected_e))
        mean_v, slope = self._transfer(self._limited(mean_e))
        deviation = slope.abs() * torch.sqrt(variance_e2.clamp_min(1e-12))
        levels = constant(self.sensor.adc.transition_levels[1:-1] * self.sensor.v_sat_v).to(mean_v.dtype)
        flat, width = mean_v.reshape(-1), (deviation * math.sqrt(2.0)).reshape(-1)
        n = max(1, MAX_PROBABILITIES // levels.numel())
        parts = [
            0.5 * torch.erfc((levels - flat[k : k + n, None]) / width[k : k + n, None]).sum(dim=1)
            for k in range(0, flat.numel(), n)
        ]
        return torch.cat(parts).reshape(mean_v.shape)


def _sparse(matrix: Any) -> Tensor:
    """Return a sparse matrix as a tensor."""
    coo = matrix.tocoo()
    indices = torch.from_numpy(np.stack((coo.row, coo.col)).astype(np.int64))
    return torch.sparse_coo_tensor(
        indices, torch.from_numpy(np.array(coo.data, np.float64)), coo.shape, is_coalesced=False, check_invariants=False
    ).coalesce()


def _map(values: Tensor, steps: list[Tensor]) -> Tensor:
    """Multiply values (..., n_site) by factors per site and by sparse matrices."""
    for step in steps:
        if step.is_sparse:
            rows = values.reshape(-1, values.shape[-1])
            values = torch.sparse.mm(step.to(values.dtype), rows.T).T.reshape(values.shape)
        else:
            values = values * step.to(values.dtype)
    return values

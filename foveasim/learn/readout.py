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
        If an effect on expected charges is not a crosstalk of the package: its derivative is unknown.

    Notes
    -----
    The statistics are those of :meth:`Sensor.readout_model`: Gaussian temporal noise, to first order at the mean. A shot-noise
    gradient by reparameterisation is biased for a nonlinear loss at few electrons: by 5 % at 0.5 e-, by 0.2 % at 5 e-.
    """

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self._n_sites = sensor.layout.n_sites
        self._response, self._dark = self._per_site(sensor.response), self._per_site(sensor.dark_rate_e_per_s)
        self._diffusion: list[Tensor] = []
        self._coupling: list[Tensor] = []
        names: list[str] = []
        for effect in sensor.chain:
            compile_for: Any = getattr(effect, "operator", None)
            if compile_for is not None and effect.stage in ("expected", "charge"):
                operator = compile_for(sensor.sites)
                target = self._diffusion if effect.stage == "expected" else self._coupling
                target.extend([_sparse(operator.matrix)] * operator.n_steps)
                names.append(effect.name)
            elif effect.stage == "expected":
                raise ParameterError(
                    "sensor",
                    f"must have no effect '{effect.name}' on expected charges for gradients",
                    hint="disable it",
                )
        self._local = sensor.without(*names) if names else sensor

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
        charge = (rates * self._response.to(rates.dtype) + self._dark.to(rates.dtype)) * exposure_s
        return _mix(charge, self._diffusion)

    def _model(self, expected_e: Tensor) -> Any:
        """Return the readout model at the mean charge of each site."""
        mean_e = np.maximum(expected_e.detach().numpy().reshape(-1, self._n_sites).mean(axis=0), 0.0)
        return self._local.readout_model(mean_e)

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
        expected_e = self._check("expected_e", expected_e)
        shot = expected_e if self.sensor.shot.is_drawn else torch.zeros_like(expected_e)
        squares = [matrix * matrix for matrix in self._coupling]
        return _mix(shot, squares) + self._per_site(self._model(expected_e).noise_e2, shot)

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
        deviation = torch.sqrt(self.variance_e2(expected_e).clamp_min(1e-12))
        return self._limited(_mix(expected_e, self._coupling) + deviation * noise)

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
        transfer = self._model(charge_e).transfer
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
        expected_e = self._check("expected_e", expected_e)
        mean_e = _mix(expected_e, self._coupling)
        mean_v, slope = self._transfer(self._limited(mean_e))
        deviation = slope.abs() * torch.sqrt(self.variance_e2(expected_e).clamp_min(1e-12))
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


def _mix(charge: Tensor, matrices: list[Tensor]) -> Tensor:
    """Multiply charges (..., n_site) by matrices."""
    for matrix in matrices:
        rows = charge.reshape(-1, charge.shape[-1])
        charge = torch.sparse.mm(matrix.to(charge.dtype), rows.T).T.reshape(charge.shape)
    return charge

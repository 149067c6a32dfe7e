"""Analogue-to-digital converter (ADC): quantisation, companding and nonlinearity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import Limits, check_declared
from foveasim._core.short_repr import short_repr
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, finite_array, read_only
from foveasim.errors import ParameterError

__all__ = ["ADC", "QUANTISATION_DN2", "Companding", "ConversionTables"]

#: Transfer functions from fraction of the voltage range to fraction of the code range.
Companding = Literal["linear", "root", "log", "table"]
COMPANDINGS: tuple[Companding, ...] = get_args(Companding)
BITS = Limits(at_least=1, at_most=16)
LOG_STRENGTH = Limits(above=0.0, at_most=1e9)
DNL = Limits(at_least=0.0, at_most=2.0**16, hint="deviations are in codes")
INL = Limits(low=-(2.0**16), at_most=2.0**16, hint="deviations are in codes")
#: Number of tabulated Gaussian quantiles for differential nonlinearity, interpolated linearly.
N_QUANTILES = 4096
#: Tolerance of code transitions, in codes: covers the rounding error of a division.
CODE_ROUNDING = 1e-9
#: Quantisation variance in units of the squared code width: a uniform distribution over one code.
QUANTISATION_DN2 = 1.0 / 12.0


class ConversionTables(NamedTuple):
    """ADC parameters for the kernels: numbers and read-only float64 arrays."""

    v_sat_v: float
    companding_index: int
    log_strength: float
    curve: Floats
    n_codes: int
    inl: Floats
    dnl_dn: float
    dnl_key: np.uint64
    quantiles: Floats


@dataclass(frozen=True, kw_only=True)
class ADC:
    """
    Analogue-to-digital converter with companding and nonlinearity.

    Parameters
    ----------
    bits : int
        Resolution, 1 to 16: codes from 0 to ``2**bits - 1``, both of which occur.
    companding : {"linear", "root", "log", "table"}
        Transfer function from a fraction x of the voltage range to a fraction of the code range: x, its square root,
        ``log(1 + s x) / log(1 + s)``, or a tabulated curve.
    log_strength : float
        The s of ``"log"``: ratio of the slopes at zero and at full range, minus 1.
    companding_table : sequence, optional
        The curve of ``"table"``: fractions of the code range at equal voltage steps, non-decreasing from 0 to 1.
    inl_dn : sequence, DN
        Integral nonlinearity (INL): deviations at equal code intervals, interpolated linearly.
    dnl_dn : float, DN
        Differential nonlinearity (DNL): standard deviation of the offset of each code transition in each readout line (0.5 in
        the paper). It is fixed for a device. The transfer function is then not necessarily monotonic.
    """

    bits: Annotated[int, BITS] = 8
    companding: Companding = "linear"
    log_strength: Annotated[float, LOG_STRENGTH] = 100.0
    companding_table: Sequence[float] | None = None
    inl_dn: Annotated[Sequence[float], INL] = ()
    dnl_dn: Annotated[float, DNL] = 0.0

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_declared(self)
        if len(self.inl_dn) == 1:
            raise ParameterError("inl_dn", "must have at least two values, at equal code intervals", self.inl_dn, "DN")
        if (self.companding_table is not None) != (self.companding == "table"):
            raise ParameterError(
                "companding_table", "must be given if and only if companding='table'", self.companding_table
            )
        if self.companding_table is not None:
            curve = finite_array("companding_table", self.companding_table, ndim=1)
            if curve.size < 2 or curve[0] != 0.0 or curve[-1] != 1.0 or np.any(np.diff(curve) < 0.0):
                raise ParameterError(
                    "companding_table",
                    "must have at least two non-decreasing values from 0 to 1",
                    self.companding_table,
                )
            object.__setattr__(self, "companding_table", tuple(curve.tolist()))

    @property
    def n_codes(self) -> int:
        """Number of codes."""
        return int(2**self.bits)

    @property
    def is_linear(self) -> bool:
        """Whether all codes have the same width on average: no companding and no INL."""
        return self.companding == "linear" and not self.inl_dn

    @cached_property
    def curve(self) -> Floats:
        """Companding table; a single 0 without a table."""
        return read_only(np.array(self.companding_table if self.companding_table is not None else [0.0]))

    @cached_property
    def inl(self) -> Floats:
        """Integral nonlinearity at equal code intervals, DN; a single 0 without INL."""
        return read_only(np.array(self.inl_dn or [0.0]))

    @cached_property
    def transition_levels(self) -> Floats:
        """
        Code transition levels as fractions of the voltage range, (n_codes + 1,).

        The levels are non-decreasing, and the last level is 1. Codes that are missing because of INL or the companding table
        have zero width.
        """
        levels = np.arange(self.n_codes + 1) / self.n_codes
        if self.inl.size > 1:
            nodes = np.linspace(0.0, 1.0, self.inl.size)
            levels = _invert_piecewise_linear(nodes + self.inl / self.n_codes, nodes, levels)
        if self.companding == "root":
            levels = levels**2
        elif self.companding == "log":
            levels = np.expm1(levels * np.log1p(self.log_strength)) / self.log_strength
        elif self.companding == "table":
            levels = _invert_piecewise_linear(self.curve, np.linspace(0.0, 1.0, self.curve.size), levels)
        levels[-1] = 1.0  # the highest code extends to the end of the range
        return read_only(levels)

    @cached_property
    def linear_dn(self) -> Floats:
        """Linear code of each code, (n_codes,) DN: the centre of its voltage interval."""
        return read_only(0.5 * (self.transition_levels[:-1] + self.transition_levels[1:]) * self.n_codes - 0.5)

    def linear_of_code_dn(self, code: ArrayLike) -> Floats:
        """
        Interpolate the linear code at given codes, (...) DN.

        Raises
        ------
        ParameterError
            If a code is out of range.
        """
        return interpolate_codes(code, self.linear_dn)

    def fraction_of_code(self, code: ArrayLike) -> Floats:
        """Interpolate the fraction of the voltage range at the centre of given codes, (...)."""
        return (self.linear_of_code_dn(code) + 0.5) / self.n_codes

    @cached_property
    def widths_dn(self) -> Floats:
        """Width of each code in linear codes, (n_codes,) DN; 1 for a linear ADC."""
        return read_only(np.diff(self.transition_levels) * self.n_codes)

    def width_of_code_dn(self, code: ArrayLike) -> Floats:
        """Interpolate the code width at given codes, (...) DN in linear codes."""
        return np.interp(np.asarray(code, np.float64), np.arange(self.n_codes), self.widths_dn)

    def width_at_dn(self, fraction: ArrayLike) -> Floats:
        """
        Interpolate the code width at fractions of the voltage range, (...) DN in linear codes.

        Widths are defined at code centres and interpolated linearly, so that the local step is continuous. For logarithmic
        companding the step is the inverse of the slope; for square-root companding it is so at high codes.
        """
        return np.interp(np.asarray(fraction) * self.n_codes - 0.5, self.linear_dn, self.widths_dn)

    @property
    def noise_dn2(self) -> float:
        """
        Variance of quantisation (1/12) plus DNL, in units of the squared local step.

        Where noise covers several codes, both contribute to temporal noise: rounding errors are uniform over a step (EMVA
        1288, Release 4.0 Linear, equation 6), and each code transition of a readout line has its own offset.
        """
        return QUANTISATION_DN2 + self.dnl_dn**2

    def tables(self, v_sat_v: float, dnl_key: np.uint64) -> ConversionTables:
        """Return the kernel arguments for a full range in V and a device's DNL key."""
        return ConversionTables(
            v_sat_v=v_sat_v,
            companding_index=COMPANDINGS.index(self.companding),
            log_strength=self.log_strength,
            curve=self.curve,
            n_codes=self.n_codes,
            inl=self.inl,
            dnl_dn=self.dnl_dn,
            dnl_key=dnl_key & np.uint64(0xFFFFFFFF),
            quantiles=self.quantiles,
        )

    @cached_property
    def quantiles(self) -> Floats:
        """Standard Gaussian quantiles at equal probability steps, (n,)."""
        from scipy.special import ndtri

        return read_only(np.asarray(ndtri((np.arange(N_QUANTILES) + 0.5) / N_QUANTILES)))


def interpolate_codes(code: ArrayLike, linear_dn: Floats) -> Floats:
    """Interpolate the linear codes (n_codes,) at given codes, (...) DN, after validation."""
    values, highest = finite_array("code", code, at_least=0.0), linear_dn.size - 1.0
    if values.size and values.max() > highest:
        raise ParameterError("code", f"must be <= {highest:g} everywhere", float(values.max()), "DN")
    return np.interp(values, np.arange(linear_dn.size), linear_dn)


def _invert_piecewise_linear(values: Floats, at_fraction: Floats, wanted_fraction: Floats) -> Floats:
    """
    Invert a piecewise linear function.

    The result is the first position at which the function reaches each wanted value, or the last position if it never does.
    """
    rising = np.maximum.accumulate(values)
    after = np.searchsorted(rising, wanted_fraction, side="left")
    inside = np.clip(after, 1, values.size - 1)
    low, high = rising[inside - 1], rising[inside]
    step = np.where(high > low, (wanted_fraction - low) / np.where(high > low, high - low, 1.0), 0.0)
    position = at_fraction[inside - 1] + np.clip(step, 0.0, 1.0) * (at_fraction[inside] - at_fraction[inside - 1])
    return np.where(after == 0, at_fraction[0], np.where(after >= values.size, at_fraction[-1], position))

"""The analogue-to-digital converter: codes, companding, and its faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.validation import Floats, check_choice, check_count, finite_array, read_only
from foveasim.errors import ParameterError
from foveasim.sensor.limits import check_plausible, check_plausible_array

__all__ = ["QUANTISATION_DN2", "Companding", "ConversionTables", "Converter"]

#: Ways from a fraction of the voltage range to a fraction of the codes.
Companding = Literal["linear", "root", "log", "table"]
COMPANDINGS: tuple[Companding, ...] = ("linear", "root", "log", "table")
#: Nodes of the Gaussian distribution that differential non-linearity is drawn from; linear in between.
N_QUANTILES = 4096
#: Variance of rounding to a code, in squares of its width: a uniform distribution over one code.
QUANTISATION_DN2 = 1.0 / 12.0


class ConversionTables(NamedTuple):
    """An ADC as the kernels take it: numbers, and read-only arrays of float64."""

    v_sat_v: float
    way: int
    log_strength: float
    curve: Floats
    n_codes: int
    inl: Floats
    dnl_dn: float
    dnl_key: np.uint64
    quantiles: Floats


@dataclass(frozen=True, kw_only=True)
class Converter:
    """
    A converter from volts to codes.

    Parameters
    ----------
    bits : int
        1 to 16: codes from 0 to ``2**bits - 1``, both of which are reached.
    companding : {"linear", "root", "log", "table"}
        Fraction of the codes for a fraction x of the range: x, its square root, ``log(1 + s x) / log(1 + s)``, or a curve.
    log_strength : float
        The s of ``"log"``: the slope of dark codes over that of bright ones, less one.
    companding_table : sequence, optional
        The curve of ``"table"``: fractions of the codes at equal steps of the range, from 0 to 1, never falling.
    inl_dn : sequence, DN
        Integral non-linearity: deviations at equal steps of the codes, linear in between.
    dnl_dn : float, DN
        Differential non-linearity: standard deviation of the number that each readout line adds before each code (the
        paper, 0.5). Fixed for a device; codes may then fall where the voltage rises.

    Raises
    ------
    ParameterError
        When a value is out of range.
    """

    bits: int = 8
    companding: Companding = "linear"
    log_strength: float = 100.0
    companding_table: Sequence[float] | None = None
    inl_dn: Sequence[float] = ()
    dnl_dn: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "bits", check_count("bits", self.bits, at_least=1, at_most=16))
        check_choice("companding", self.companding, COMPANDINGS)
        for name in ("log_strength", "dnl_dn"):
            object.__setattr__(self, name, check_plausible(name, getattr(self, name)))
        inl = check_plausible_array("inl_dn", self.inl_dn, ndim=1)
        if inl.size == 1:
            raise ParameterError(
                "inl_dn", "must be at least two numbers, at equal steps of the codes", self.inl_dn, "DN"
            )
        object.__setattr__(self, "inl_dn", tuple(inl.tolist()))
        if (self.companding_table is not None) != (self.companding == "table"):
            raise ParameterError("companding_table", "and companding='table' belong together", self.companding_table)
        if self.companding_table is not None:
            curve = finite_array("companding_table", self.companding_table, ndim=1)
            if curve.size < 2 or curve[0] != 0.0 or curve[-1] != 1.0 or np.any(np.diff(curve) < 0.0):
                raise ParameterError(
                    "companding_table", "must be two or more numbers from 0 to 1 that never fall", self.companding_table
                )
            object.__setattr__(self, "companding_table", tuple(curve.tolist()))

    @property
    def n_codes(self) -> int:
        """Number of codes."""
        return int(2**self.bits)

    @property
    def way(self) -> int:
        """The companding as the kernels number it."""
        return COMPANDINGS.index(self.companding)

    @cached_property
    def curve(self) -> Floats:
        """The table, or a zero."""
        return read_only(np.array(self.companding_table if self.companding_table is not None else [0.0]))

    @cached_property
    def inl(self) -> Floats:
        """Integral non-linearity at equal steps, or a zero."""
        return read_only(np.array(self.inl_dn or [0.0]))

    @cached_property
    def borders(self) -> Floats:
        """
        Fractions of the range at which the codes begin, and 1, (n_codes + 1,); never falling.

        A code that integral non-linearity or a companding table leaves out has two equal borders.
        """
        border = np.arange(self.n_codes + 1) / self.n_codes
        if self.inl.size > 1:
            nodes = np.linspace(0.0, 1.0, self.inl.size)
            border = _first_at(nodes + self.inl / self.n_codes, nodes, border)
        if self.companding == "root":
            border = border**2
        elif self.companding == "log":
            border = np.expm1(border * np.log1p(self.log_strength)) / self.log_strength
        elif self.companding == "table":
            border = _first_at(self.curve, np.linspace(0.0, 1.0, self.curve.size), border)
        border[-1] = 1.0  # the highest code takes the rest of the range
        return read_only(border)

    @cached_property
    def linear_dn(self) -> Floats:
        """Linear code of every code: the centre of the fractions of the range that it stands for, (n_codes,) DN."""
        return read_only(0.5 * (self.borders[:-1] + self.borders[1:]) * self.n_codes - 0.5)

    @cached_property
    def widths_dn(self) -> Floats:
        """Width of every code in linear codes, (n_codes,) DN: 1 each where the converter is linear."""
        return read_only(np.diff(self.borders) * self.n_codes)

    def width_of_code_dn(self, code: ArrayLike) -> Floats:
        """Width in linear codes at given codes, (...) DN; between two codes on a straight line."""
        return np.interp(np.asarray(code, np.float64), np.arange(self.n_codes), self.widths_dn)

    def width_at_dn(self, fraction: ArrayLike) -> Floats:
        """
        Local step of the converter at fractions of the range, (...) DN: width of a code in linear codes.

        Widths belong to the centres of codes, with straight lines between them, so that the step is continuous: for a
        logarithmic converter it is the slope's inverse, for a square root that of high codes.
        """
        return np.interp(np.asarray(fraction) * self.n_codes - 0.5, self.linear_dn, self.widths_dn)

    @property
    def noise_dn2(self) -> float:
        """
        Variance of conversion in squares of the local step: 1/12 of quantisation, and that of differential non-linearity.

        A charge that moves over several codes meets them as temporal noise: rounding errors are uniform over a step (EMVA 1288,
        Release 4.0 Linear, equation 6), and each line adds a number of its own before each code.
        """
        return QUANTISATION_DN2 + self.dnl_dn**2

    def tables(self, v_sat_v: float, dnl_key: np.uint64) -> ConversionTables:
        """Return the arguments of the kernels, with the full range in V and the key of a device's DNL numbers."""
        return ConversionTables(
            v_sat_v=v_sat_v,
            way=self.way,
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
        """The Gaussian distribution at equal steps of probability, (n,)."""
        from scipy.special import ndtri

        return read_only(np.asarray(ndtri((np.arange(N_QUANTILES) + 0.5) / N_QUANTILES)))


def _first_at(values: Floats, at_fraction: Floats, wanted_fraction: Floats) -> Floats:
    """Place where straight lines through values first reach what is wanted; the last place where they never do."""
    rising = np.maximum.accumulate(values)
    after = np.searchsorted(rising, wanted_fraction, side="left")
    inside = np.clip(after, 1, values.size - 1)
    low, high = rising[inside - 1], rising[inside]
    step = np.where(high > low, (wanted_fraction - low) / np.where(high > low, high - low, 1.0), 0.0)
    place = at_fraction[inside - 1] + np.clip(step, 0.0, 1.0) * (at_fraction[inside] - at_fraction[inside - 1])
    return np.where(after == 0, at_fraction[0], np.where(after >= values.size, at_fraction[-1], place))

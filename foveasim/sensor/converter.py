"""The analogue-to-digital converter: codes, companding, and its faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from foveasim.arrays import Floats, check_choice, check_count, check_number, finite_array, read_only
from foveasim.errors import ParameterError

__all__ = ["Companding", "Converter"]

#: Ways from a share of the voltage range to a share of the codes.
Companding = Literal["linear", "root", "log", "table"]
COMPANDINGS: tuple[Companding, ...] = ("linear", "root", "log", "table")
#: Nodes of the Gaussian law that differential non-linearity is drawn from; linear in between.
N_QUANTILES = 4096


@dataclass(frozen=True, kw_only=True)
class Converter:
    """
    A converter from volts to codes.

    Parameters
    ----------
    bits : int
        1 to 16: codes from 0 to ``2**bits - 1``, both of which are reached.
    companding : {"linear", "root", "log", "table"}
        How a share x of the range becomes a share of the codes: x, its square root, ``log(1 + s x) / log(1 + s)``, or a curve.
    log_strength : float
        The s of ``"log"``: the slope of dark codes over that of bright ones, less one.
    companding_table : sequence, optional
        The curve of ``"table"``: shares of the codes at equal steps of the range, from 0 to 1, never falling.
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
        strength = check_number("log_strength", self.log_strength, above=0.0, at_most=1e9)
        object.__setattr__(self, "log_strength", strength)
        object.__setattr__(self, "dnl_dn", check_number("dnl_dn", self.dnl_dn, at_least=0.0))
        inl = finite_array("inl_dn", self.inl_dn, ndim=1)
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
    def quantiles(self) -> Floats:
        """The Gaussian law at equal steps of probability, (n,)."""
        from scipy.special import ndtri

        return read_only(np.asarray(ndtri((np.arange(N_QUANTILES) + 0.5) / N_QUANTILES)))

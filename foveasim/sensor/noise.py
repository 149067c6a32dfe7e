"""Shot noise: one Poisson draw on the expected electrons."""

from __future__ import annotations

from typing import Literal

import numpy as np

from foveasim.arrays import Floats, Ints
from foveasim.streams import Streams

__all__ = ["LARGEST_CHARGE_E", "ShotNoise", "draw_shot_noise"]

ShotNoise = Literal["auto", "exact", "off"]

#: Variance that rounding to whole electrons adds; taken off the Gaussian's, so that the sum is Poisson's.
ROUNDING_VARIANCE = 1.0 / 12.0
#: Expectations beyond this are beyond numpy's Poisson generator; the Gaussian is exact to 1e-9 long before.
LARGEST_EXACT_E = 1e18
#: No charge is larger: 2**62 fits int64 with room for sums.
LARGEST_CHARGE_E = 2.0**62


def draw_shot_noise(expected_e: Floats, how: ShotNoise, gaussian_above_e: float, streams: Streams) -> Ints:
    """
    Electrons that are collected where so many are expected.

    Parameters
    ----------
    expected_e : (n_site,) float64, e-
    how : {"auto", "exact", "off"}
        ``"exact"``: Poisson. ``"auto"``: Poisson up to ``gaussian_above_e``, above it a Gaussian of the same mean and
        variance, rounded. ``"off"``: the expectation, rounded.
    gaussian_above_e : float, e-
    streams : Streams
        Uses the streams ``shot`` (Poisson) and ``shot_gaussian``.

    Returns
    -------
    electrons : (n_site,) int64, e-
        Never below 0. Mean and variance are those of Poisson on both sides of the switch.
    """
    if how == "off":
        return _whole(expected_e)
    is_gaussian = expected_e > (gaussian_above_e if how == "auto" else LARGEST_EXACT_E)
    electrons = streams.of("shot").poisson(np.where(is_gaussian, 0.0, expected_e))
    if is_gaussian.any():
        # One number a site, used or not: a Gaussian draw does not depend on how bright the other sites are.
        z = streams.of("shot_gaussian").standard_normal(expected_e.size)[is_gaussian]
        mean_e = expected_e[is_gaussian]
        electrons[is_gaussian] = _whole(mean_e + np.sqrt(np.maximum(mean_e - ROUNDING_VARIANCE, 0.0)) * z)
    return electrons


def _whole(charge_e: Floats) -> Ints:
    """Whole electrons, from 0 to the largest number that int64 holds with certainty."""
    return np.rint(np.clip(charge_e, 0.0, LARGEST_CHARGE_E)).astype(np.int64)

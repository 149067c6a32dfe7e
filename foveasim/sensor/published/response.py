"""
Saturation and linearity error of EMVA 1288, and the limits and losses that cause them.

Charges are in e-, losses relative. A signal has the quadratic response x (1 - loss u) with u = x / saturation, as that of
:class:`foveasim.Sensor`.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from foveasim._core.validation import Floats, read_only

#: Nodes of means over a standard normal distribution, so dense that sites reach their limit one after the other, and weights.
NODES = read_only(np.linspace(-5.0, 5.0, 2001))
WEIGHTS = read_only(np.exp(-0.5 * NODES**2) / np.exp(-0.5 * NODES**2).sum())
#: Gain and responsivity are measured up to 70 % of the signal at saturation; the linearity error from 5 to 95 %, at 50 levels
#: from 0 to saturation, the number of the standard: the line follows the lowest of them less than that of more levels.
LINEAR_FRACTION, COMPARED_U = 0.7, read_only(np.arange(3, 48) / 50.0)
#: Levels of a fitted slope: their number has little effect.
N_LINEAR = 35
#: Largest relative loss at saturation for which a linearity error is sought: far above the response of any linear sensor.
MAX_LOSS = 0.3


class Response(NamedTuple):
    """
    Results of EMVA 1288 for a quadratic response.

    Attributes
    ----------
    loss_fraction : float
        Relative loss at saturation.
    gain : float
        Measured system gain over that at zero signal.
    signal_fraction : float
        Measured responsivity over that at zero signal.
    """

    loss_fraction: float
    gain: float
    signal_fraction: float

    @property
    def true_fraction(self) -> float:
        """Charge over the charge that follows from measured gain and quantum efficiency."""
        return self.gain / self.signal_fraction


def response_of(loss_fraction: float) -> Response:
    """Return the measured slopes of gain and responsivity, of lines through the origin."""
    last = LINEAR_FRACTION * (1.0 - loss_fraction)
    last = last if loss_fraction == 0.0 else (1.0 - math.sqrt(1.0 - 4.0 * loss_fraction * last)) / (2.0 * loss_fraction)
    u = last * np.arange(1, N_LINEAR + 1) / N_LINEAR
    mean, variance = u * (1.0 - loss_fraction * u), u * (1.0 - 2.0 * loss_fraction * u) ** 2
    return Response(loss_fraction, float(mean @ variance / (mean @ mean)), float(u @ mean / (u @ u)))


def linearity_errors(loss_fraction: float) -> tuple[float, float]:
    """Return the smallest and the largest relative deviation from a fitted line."""
    signal = COMPARED_U * (1.0 - loss_fraction * COMPARED_U)
    columns = np.stack((COMPARED_U / signal, 1.0 / signal), axis=1)
    slope, offset = np.linalg.lstsq(columns, np.ones_like(signal), rcond=None)[0]
    deviation = signal / (slope * COMPARED_U + offset) - 1.0
    return float(deviation.min()), float(deviation.max())


@cache
def loss_of_linearity_errors(min_fraction: float, max_fraction: float) -> float | None:
    """
    Return the loss at saturation of linearity errors; None if no loss has them.

    An unknown error is 0. The error of larger magnitude is that at the ends of the range: the smallest deviation of a response
    that saturates, with a positive loss, and the largest of one that rises.
    """
    from scipy import optimize

    rises = max_fraction > -min_fraction and min_fraction < 0.0
    k, error_fraction = (0, min_fraction) if min_fraction < 0.0 and not rises else (1, max_fraction)
    end = -MAX_LOSS if rises else MAX_LOSS
    if error_fraction == 0.0:
        return 0.0
    if abs(linearity_errors(end)[k]) <= abs(error_fraction):
        return None
    return float(optimize.brentq(lambda loss: linearity_errors(loss)[k] - error_fraction, min(0.0, end), max(0.0, end)))


@cache
def limit_of_saturation(saturation_e: float, prnu_fraction: float = 0.0) -> float:
    """Return the limit of charges whose temporal variance is highest at a mean, e-."""
    from scipy import optimize

    high_e = saturation_e + 12.0 * (math.sqrt(saturation_e) + prnu_fraction * saturation_e)
    return float(optimize.brentq(lambda limit_e: _slope(saturation_e, limit_e, prnu_fraction), saturation_e, high_e))


@cache
def saturation_of_limit(limit_e: float, prnu_fraction: float = 0.0) -> float:
    """Return the mean of the highest temporal variance for a limit, e-."""
    from scipy import optimize

    low_e = limit_e / (1.0 + 12.0 * (1.0 / math.sqrt(limit_e) + prnu_fraction))
    return float(optimize.brentq(lambda mean_e: _slope(mean_e, limit_e, prnu_fraction), low_e, limit_e))


def _slope(mean_e: float, limit_e: float, prnu_fraction: float) -> float:
    """Return the derivative of the variance of limited charges by their mean."""
    from scipy import special

    factor: Floats = np.maximum(1.0 + prnu_fraction * NODES, 1e-3)
    own_e = mean_e * factor
    z = (limit_e - own_e) / np.sqrt(own_e)
    above, density = special.ndtr(-z), np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    mean = z * above - density
    variance = special.ndtr(z) - z * density + z**2 * above - mean**2
    slope = variance - 2.0 * above * (z - mean) * (np.sqrt(own_e) + 0.5 * z)
    return float(WEIGHTS @ (factor * slope))

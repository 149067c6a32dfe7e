"""Shot noise: one Poisson draw of the expected charge, photoelectrons plus dark signal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from foveasim._core.calls import Declared, Limits
from foveasim._core.random_streams import Streams, random_key
from foveasim._core.validation import Floats, Ints, as_broadcast, read_only, unmasked
from foveasim.errors import ParameterError
from foveasim.sensor.blocks import for_each_block
from foveasim.sensor.effects.collection import MAX_CHARGE_E, ROUNDING_E2, Collection
from foveasim.sensor.effects.contract import Sites, StepModel, check_drawn

__all__ = ["MAX_CHARGE_E", "ROUNDING_E2", "PoissonTables", "ShotChoice", "ShotNoise", "draw_shot_noise"]

ShotChoice = Literal["auto", "exact", "off"]

#: Maximum mean of exact Poisson draws by inversion: its tables have 6 MB.
MAX_INVERSION_MEAN_E = 700.0
GAUSSIAN_ABOVE = Limits(at_least=10.0, at_most=MAX_INVERSION_MEAN_E)
#: Limit of numpy's Poisson generator. Larger expectations are rounded: their relative shot noise is below 1e-9.
MAX_EXACT_E = 1e18
#: Number of intervals of the guide table; a power of 2, so that intervals are exact.
N_GUIDE = 512
#: Cumulative Poisson probabilities reach 1 in float64 this many standard deviations plus this many electrons above the mean.
TABLE_SIGMAS, TABLE_MARGIN_E = 10, 20


class PoissonTables(NamedTuple):
    """
    Cumulative Poisson distributions of integral means, for the kernels.

    ``cumulative_fraction`` (n_mean, n_count) float64: probability that a draw with mean ``m`` is at most ``k``. ``guide``
    (n_mean, N_GUIDE) uint16: smallest k whose cumulative probability exceeds the lower end of each of ``N_GUIDE`` equal
    intervals of probability: the search starts there (H. C. Chen and Y. Asau, AIIE Transactions 6, 163, 1974).
    """

    cumulative_fraction: Floats
    guide: NDArray[np.uint16]


@cache
def poisson_tables(max_mean: int) -> PoissonTables:
    """Compute the distributions with means from 0 to an integer, once per process."""
    from scipy.special import pdtr

    n_count = max_mean + TABLE_SIGMAS * math.isqrt(max_mean) + TABLE_MARGIN_E
    means = np.arange(max_mean + 1.0)
    cumulative = pdtr(np.arange(n_count), means[:, np.newaxis])
    cumulative[0] = 1.0
    starts = np.arange(N_GUIDE) / N_GUIDE
    guide = np.stack([np.searchsorted(row, starts, side="right") for row in cumulative]).astype(np.uint16)
    cumulative[:, -1] = np.inf
    return PoissonTables(read_only(cumulative), read_only(guide))


@dataclass(frozen=True)
class ShotNoise(Declared, Collection):
    """
    Shot-noise draw from expected to collected charge, in whole electrons.

    Parameters
    ----------
    how : {"auto", "exact", "off"}
        ``"auto"``: exact Poisson draws for expectations up to ``gaussian_above_e``, by inversion; above it, a rounded quadratic
        function of a Gaussian number with the mean, variance and third central moment of the Poisson distribution. A site's
        draw does not depend on the expectations of other sites. ``"exact"``: Poisson draws everywhere. ``"off"``: the rounded
        expectation.
    gaussian_above_e : float, e-
        From 10 to 700.

    Notes
    -----
    A Poisson distribution of mean λ has variance λ and third central moment λ. With a standard normal z, the random variable
    ``λ + s z + c (z² - 1)`` has mean λ, variance ``s² + 2 c²`` and third central moment ``6 c s² + 8 c³``; rounding adds 1/12
    to the variance. Hence ``s² = λ - 1/12 - 2 c²``, and c solves ``6 c (λ - 1/12) - 4 c³ = λ``: to order 1/λ it is
    ``1/6 + 11 / (648 λ)``. This is the second-order Cornish-Fisher expansion (Abramowitz and Stegun, 26.2.49), corrected for
    rounding.

    Remaining error above the limit: the fourth cumulant is ``48 c² (s² + c²)``, so that the excess kurtosis is 4/(3 λ), four
    thirds of that of the Poisson distribution: 0.0133 instead of 0.0100 at 100 e-. The total variation distance from the
    Poisson distribution, the largest difference in probability of any event, is 0.02/λ: 2e-3 at 10 e-, 2e-4 at the default
    limit of 100 e-, 3e-5 at 700 e-.
    """

    example: ClassVar[Mapping[str, Any]] = {"shot_noise": "auto"}
    name: ClassVar[str] = "shot"
    has_independent_increments: ClassVar[bool] = True
    needs_layout: ClassVar[bool] = False

    how: ShotChoice = "auto"
    gaussian_above_e: Annotated[float, GAUSSIAN_ABOVE] = 100.0

    @property
    def is_drawn(self) -> bool:
        """Whether charges are drawn, rather than only rounded."""
        return self.how != "off"

    def without_draw(self) -> ShotNoise:
        """Return the rounded expectation."""
        return replace(self, how="off")

    def apply(self, values: Floats, *, sites: Sites | None, rng: np.random.Generator) -> Floats:
        """Return the drawn charges, (n,) e-, in whole electrons."""
        from foveasim.sensor import _kernels

        check_drawn(values, rng, is_drawn=self.is_drawn)
        if self.how == "auto":
            tables = poisson_tables(int(self.gaussian_above_e))
            _kernels.draw_poisson(values, self.gaussian_above_e, tables, random_key(rng))
            return values
        if self.how == "exact":
            is_drawn = values <= MAX_EXACT_E
            values[is_drawn] = rng.poisson(values[is_drawn])
        return np.rint(np.clip(values, 0.0, MAX_CHARGE_E, out=values), out=values)

    def moments(self, mean: Floats, variance: Floats, *, sites: Sites | None = None) -> tuple[Floats, Floats]:
        """Return the mean, and the variance plus shot noise, or plus rounding if not drawn."""
        mean, variance = as_broadcast(mean=mean, variance=variance)
        return mean, variance + (np.maximum(mean, 0.0) if self.is_drawn else ROUNDING_E2)

    def linearise(self, mean: Floats, *, sites: Sites | None = None) -> StepModel:
        """Return the mean and its standard deviation."""
        return StepModel(mean, None, np.sqrt(self.moments(mean, np.zeros(1))[1]))

    def cumulative(self, count: Floats, mean: Floats, *, sites: Sites | None = None) -> Floats:
        """
        Return the Poisson distribution, or that of the rounded expectation.

        Draws of ``"auto"`` approximate it above ``gaussian_above_e``.
        """
        from scipy.special import pdtr

        count, mean = as_broadcast(count=count, mean=mean)
        if not self.is_drawn:
            return (count >= np.rint(mean)).astype(np.float64)
        return np.asarray(np.where(mean > 0.0, pdtr(count, np.maximum(mean, 1e-300)), 1.0))


def draw_shot_noise(
    expected_e: Floats,
    how: ShotChoice,
    gaussian_above_e: float,
    *,
    seed: int,
    frame: int = 0,
    n_threads: int | None = None,
) -> Ints:
    """
    Draw collected charges from expected ones.

    Parameters
    ----------
    expected_e : (n_site,) float64, e-
    how, gaussian_above_e
        See :class:`foveasim.sensor.effects.ShotNoise`.
    seed, frame : int
        Seed and frame number of the draws, as for :meth:`foveasim.Sensor.collect`.
    n_threads : int, optional
        Number of threads; all cores by default. Draws do not depend on it.

    Returns
    -------
    electrons : (n_site,) int64, e-
        Non-negative.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> electrons = fs.sensor.draw_shot_noise(
    ...     np.full(100_000, 400.0), "exact", 500.0, seed=0
    ... )
    >>> round(float(electrons.mean())), round(float(electrons.std()))
    (400, 20)
    """
    expected_e = np.ascontiguousarray(unmasked("expected_e", expected_e), np.float64)
    if expected_e.size and not (smallest := float(np.min(expected_e))) >= 0.0:
        raise ParameterError("expected_e", "must be >= 0 everywhere", smallest, "e-")
    shot, streams = ShotNoise(how, gaussian_above_e), Streams(seed, frame)
    electrons = np.empty(expected_e.size, np.int64)

    def block(number: int, sites: slice) -> None:
        electrons[sites] = shot.apply(expected_e[sites].copy(), sites=None, rng=streams.of(shot.name, number))

    for_each_block(expected_e.size, block, n_threads)
    return electrons

"""Collection of charge: the draw from expected to collected electrons."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.validation import Floats, Ints
from foveasim.errors import SimulationError
from foveasim.sensor.effects.contract import NOTHING, Effect, Sites, Stage, StepModel, select_indices

__all__ = ["MAX_CHARGE_E", "Collection"]

#: Upper limit of charges: 2**62 fits int64 with headroom for sums.
MAX_CHARGE_E = 2.0**62
#: Variance of rounding to integers.
ROUNDING_E2 = 1.0 / 12.0
#: First bracket of a draw: this many standard deviations plus this many electrons on both sides of the mean.
BRACKET_SIGMAS, BRACKET_MARGIN_E = 10.0, 20.0
#: Cumulative probabilities above this one are those of all counts; rounding of special functions may leave them below 1.
COMPLETE = 1.0 - 2.0**-50
#: Probability that tables omit at each end: the difference between 1 and the next smaller float64.
OMITTED = 2.0**-53
#: Number of probabilities of a table that are computed at a time.
PIECE = 1 << 20
#: Relative accuracy of inverted means, and maximum number of iterations.
INVERSE_ROUNDING, MAX_ITERATIONS = 1e-13, 128


class Collection(Effect):
    """
    Distribution of the collected charge for an expected charge, one in each sensor.

    Subclasses define :meth:`cumulative` and :meth:`moments`. The default of sensors is :class:`ShotNoise`; another one is
    passed in ``effects=[...]``.

    Attributes
    ----------
    needs_exposure : bool
        Whether the distribution depends on the exposure time, which is then ``sites.exposure_s``.
    has_independent_increments : bool
        Whether charges of consecutive time intervals are independent and follow the same distribution, as for Poisson
        processes. Only then can a charge be read several times during an exposure.
    """

    stage: ClassVar[Stage] = "collection"
    is_temporal: ClassVar[bool] = True
    needs_exposure: ClassVar[bool] = False
    has_independent_increments: ClassVar[bool] = False

    @property
    def is_drawn(self) -> bool:
        """Whether charges are drawn, rather than only rounded."""
        return True

    @abstractmethod
    def cumulative(self, count: Floats, mean: Floats, *, sites: Sites) -> ArrayLike:
        """
        Return the probability that at most ``count`` electrons are collected.

        Parameters
        ----------
        count : (..., n) float64, e-
            Integers, at least 0.
        mean : (..., n) float64, e-
            Expected charge, at least 0.
        sites : Sites
            The ``n`` sites, with :attr:`Sites.exposure_s`.
        """

    def without_draw(self) -> Collection:
        """Return the collection of the rounded mean."""
        return _RoundedMean(self)

    def apply(self, values: Floats, *, sites: Sites, rng: np.random.Generator) -> Floats:
        """Return the drawn charges, (n,) e-, in whole electrons."""
        return self.quantile(rng.random(values.size), values, sites=sites)

    def quantile(self, probability: ArrayLike, mean: Floats, *, sites: Sites) -> Floats:
        """
        Return the smallest count whose cumulative probability exceeds a probability.

        Parameters
        ----------
        probability : (n,) or number
            From 0 to below 1.
        mean : (n,) float64, e-
            Expected charge.
        sites : Sites
            The ``n`` sites.

        Returns
        -------
        count : (n,) float64, e-

        Raises
        ------
        SimulationError
            If the cumulative probability does not reach 1.
        """
        limit = np.asarray(probability, np.float64)
        centre_e, variance_e2 = self.validate_moments(mean, NOTHING, sites)
        width_e = BRACKET_SIGMAS * np.sqrt(np.maximum(variance_e2, 0.0)) + BRACKET_MARGIN_E
        shape = np.broadcast_shapes(limit.shape, np.shape(mean))
        # Invariant: P(N <= low) <= limit < P(N <= high), if rounding leaves probabilities above the limit.
        low = np.maximum(np.floor(np.broadcast_to(centre_e - width_e, shape)), -1.0)
        high = np.ceil(np.broadcast_to(centre_e + width_e, shape))
        low[self._probability(low, mean, sites) > limit] = -1.0
        while (is_below := self._probability(high, mean, sites) <= np.minimum(limit, COMPLETE)).any():
            if not high[is_below].max() < MAX_CHARGE_E:
                raise SimulationError(
                    f"the effect '{self.name}' must have a cumulative probability that reaches 1; check its cumulative()"
                )
            low, high = np.where(is_below, high, low), np.where(is_below, 2.0 * high, high)
        for _ in range(MAX_ITERATIONS):
            if not (high - low > 1.0).any():
                break
            centre = np.floor(0.5 * (low + high))
            is_below = self._probability(centre, mean, sites) <= limit
            low, high = np.where(is_below, centre, low), np.where(is_below, high, centre)
        return high

    def _probability(self, count: Floats, mean: Floats, sites: Sites) -> Floats:
        """Return the cumulative probabilities, 0 for negative counts, after checking their shape."""
        shape = np.broadcast_shapes(count.shape, np.shape(mean))
        cumulative = self.cumulative(np.maximum(count, 0.0), mean, sites=sites)
        (found,) = self._validate_shapes([cumulative], 1, shape, "numbers", "cumulative")
        return np.where(count >= 0.0, found, 0.0)

    def table(self, mean: ArrayLike, *, sites: Sites) -> tuple[Ints, Floats, Ints]:
        """
        Compute the probabilities of all counts, except tails with a probability of 1e-16.

        Parameters
        ----------
        mean : (n,) float64, e-
            Expected charge.
        sites : Sites
            The ``n`` sites.

        Returns
        -------
        first : (n,) int64, e-
            Smallest count of each site.
        probability : (n_probability,) float64
            Probabilities of consecutive counts, site after site.
        offsets : (n + 1,) int64
            Those of site i are ``probability[offsets[i] : offsets[i + 1]]``.
        """
        sites, mean = sites.of(self), np.broadcast_to(np.asarray(mean, np.float64), sites.n_sites)
        first, last = (self.quantile(limit, mean, sites=sites).astype(np.int64) for limit in (OMITTED, 1.0 - OMITTED))
        n_counts = last - first + 1
        offsets = np.concatenate(([0], np.cumsum(n_counts)))
        probability = np.empty(offsets[-1])
        # Sites with similar numbers of counts together, as rectangular arrays.
        order = np.argsort(n_counts, kind="stable")
        start = 0
        while start < order.size:
            n_most = np.searchsorted(np.cumsum(n_counts[order[start:]]), PIECE, side="right")
            chosen = order[start : start + max(1, int(n_most))]
            n_rows = int(n_counts[chosen[-1]])
            part = sites.block(select_indices(sites.index, chosen, sites.layout.n_sites))
            count = first[chosen] + np.arange(-1.0, n_rows)[:, np.newaxis]
            cumulated = self._probability(count, mean[chosen], part)
            is_there = np.arange(n_rows)[:, np.newaxis] < n_counts[chosen]
            where = (offsets[chosen] + np.arange(n_rows)[:, np.newaxis])[is_there]
            probability[where] = np.maximum(np.diff(cumulated, axis=0), 0.0)[is_there]
            start += chosen.size
        return first, probability, offsets

    def invert(self, collected_e: ArrayLike, *, sites: Sites) -> Floats:
        """
        Return the expected charges with given mean collected charges.

        Parameters
        ----------
        collected_e : (n,) float64, e-
            Mean collected charges.
        sites : Sites
            The ``n`` sites.

        Returns
        -------
        expected_e : (n,) float64, e-
            At least 0; infinite for means that are not reached.
        """
        sites = sites.of(self)
        target = np.broadcast_to(np.asarray(collected_e, np.float64), sites.n_sites)
        low, high = np.zeros(target.shape), np.maximum(2.0 * target, 1.0)
        while True:
            is_below = self.validate_moments(high, NOTHING, sites)[0] < target
            if not (is_below & (high < MAX_CHARGE_E)).any():
                break
            low, high = np.where(is_below, high, low), np.where(is_below, 2.0 * high, high)
        found = np.clip(target, low, high)
        for _ in range(MAX_ITERATIONS):
            model = self.validate_linear(found, sites)
            is_above = model.mean >= target
            low, high = np.where(is_above, low, found), np.where(is_above, found, high)
            with np.errstate(divide="ignore", invalid="ignore"):
                newton = found - (model.mean - target) / _slope(model)
            following = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
            is_complete = np.abs(following - found) <= INVERSE_ROUNDING * np.maximum(found, 1.0)
            found = following
            if is_complete.all():
                break
        return np.where(is_below, np.inf, found)


def _slope(model: StepModel) -> Floats:
    """Return the slope of the mean at each site."""
    return np.asarray(1.0 if model.slope is None else model.slope, np.float64)


class _RoundedMean(Collection):
    """Rounded mean of another collection, without its draw."""

    is_drawn = False

    def __init__(self, of: Collection) -> None:
        self.of = of
        # Class attributes of other effects.
        vars(self).update(name=of.name, needs_exposure=of.needs_exposure, needs_layout=of.needs_layout)

    def apply(self, values: Floats, *, sites: Sites, rng: np.random.Generator) -> Floats:
        """Return the rounded means, (n,) e-."""
        return np.rint(np.clip(self.of.validate_moments(values, NOTHING, sites)[0], 0.0, MAX_CHARGE_E))

    def cumulative(self, count: Floats, mean: Floats, *, sites: Sites) -> ArrayLike:
        """Return 1 for counts from the rounded mean."""
        return (count >= np.rint(self.of.validate_moments(mean, NOTHING, sites)[0])).astype(np.float64)

    def moments(self, mean: Floats, variance: Floats, *, sites: Sites) -> tuple[Floats, Floats]:
        """Return the mean, and the variance with the slope of the mean, plus that of rounding."""
        model = self.of.validate_linear(mean, sites)
        return model.mean, _slope(model) ** 2 * variance + ROUNDING_E2

"""Confidence intervals of EMVA 1288 parameters by the jackknife."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.names import possible_names
from foveasim._core.validation import Bools, Floats, Ints
from foveasim.errors import ParameterError

__all__ = ["CONFIDENCE", "EmvaIntervals", "Jackknife"]

#: Probability that an interval contains the parameter.
CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class EmvaIntervals:
    """
    Intervals of 95 % confidence of EMVA 1288 parameters.

    ``intervals["qe"]`` is the interval of a parameter, (n_class, 2): lower and upper limit.

    Attributes
    ----------
    classes : (n_class,)
        Labels of the classes.
    limits : dict of str to (n_class, 2) float64
        Lower and upper limit of each parameter, in its unit; NaN for a parameter that was not measured.
    """

    classes: NDArray[Any]
    limits: Mapping[str, Floats]

    def __repr__(self) -> str:
        unresolved = [name for name in self.limits if self.is_measured(name).any() and not self.is_resolved(name).all()]
        names = f", not resolved: {', '.join(unresolved)}" if unresolved else ""
        return f"EmvaIntervals({len(self.limits)} parameters, {self.classes.size} classes{names})"

    def __getitem__(self, name: str) -> Floats:
        """Return lower and upper limit of a parameter, (n_class, 2)."""
        if name not in self.limits:
            raise ParameterError("name", "must be a parameter", name, hint=possible_names(name, list(self.limits)))
        return self.limits[name]

    def is_measured(self, name: str) -> Bools:
        """
        Return whether the data contain a parameter, (n_class,).

        Without a dark series, they do not contain the dark current.
        """
        return np.asarray(~np.isnan(self[name]).any(axis=1))

    def is_resolved(self, name: str) -> Bools:
        """
        Return whether the data resolve a parameter, (n_class,).

        They do if its interval is finite and does not contain 0: otherwise, the estimate may be noise alone, and only the
        limits are results.
        """
        low, high = self[name].T
        return np.asarray(np.isfinite(low) & np.isfinite(high) & ((low > 0.0) | (high < 0.0)))

    def records(self) -> list[dict[str, Any]]:
        """Return one dict per class and measured parameter: limits and ``is_resolved``."""
        return [
            {
                "class": label,
                "parameter": name,
                "low": float(self.limits[name][k, 0]),
                "high": float(self.limits[name][k, 1]),
                "is_resolved": bool(self.is_resolved(name)[k]),
            }
            for k, label in enumerate(self.classes.tolist())
            for name in self.limits
            if self.is_measured(name)[k]
        ]

    def _repr_html_(self) -> str:
        from foveasim.view import to_html

        return to_html(self)


class Jackknife:
    """
    Standard errors and intervals from estimates that leave out one block of sites each.

    ``n_blocks_of_class`` (n_class,) int64: number of blocks of each class; further blocks are empty. In all methods,
    ``values[0]`` is the estimate from all sites, and ``values[1 + k]`` the estimate without block k.

    Delete-a-group jackknife: with g blocks, the variance of an estimate is ``(g - 1) / g`` times the sum of squared deviations
    of the g estimates without one block from their mean (J. Shao and D. Tu, The jackknife and bootstrap, Springer, 1995,
    chapter 2). Intervals use Student's distribution with g - 1 degrees of freedom.
    """

    def __init__(self, n_blocks_of_class: Ints) -> None:
        self._n_blocks = n_blocks_of_class

    def error(self, values: Floats) -> Floats:
        """Return standard errors (..., n_class) from values (1 + n_block, ..., n_class)."""
        without = values[1:]
        shape = (without.shape[0],) + (1,) * (without.ndim - 2) + (self._n_blocks.size,)
        is_block = np.broadcast_to((np.arange(shape[0])[:, None] < self._n_blocks).reshape(shape), without.shape)
        mean = without.mean(axis=0, where=is_block)
        squares = ((without - mean) ** 2).sum(axis=0, where=is_block)
        return np.asarray(np.sqrt(squares * (self._n_blocks - 1.0) / self._n_blocks))

    def quantile(self, n_values: int | Ints = 1) -> Floats:
        """Return the two-sided quantiles for the extremes of several values, (n_class,)."""
        from scipy.special import stdtrit

        return np.asarray(stdtrit(self._n_blocks - 1.0, 1.0 - 0.5 * (1.0 - CONFIDENCE) / np.maximum(n_values, 1)))

    def interval(self, values: Floats) -> Floats:
        """Return the limits, (n_class, 2), of a parameter that is not negative."""
        half = self.quantile() * self.error(values)
        return np.maximum(np.stack((values[0] - half, values[0] + half), axis=-1), 0.0)

    def interval_of_extremes(self, values: Floats, is_used: Bools) -> tuple[Floats, Floats]:
        """
        Return the limits, (n_class, 2) each, of the smallest and the largest of several values.

        ``is_used``: (n_value, n_class) bool.

        With at least the probability of the interval, all values are within their simultaneous limits (Bonferroni). Then the
        smallest of the lower limits and the smallest of the upper limits bound the smallest value, and the same applies to the
        largest.
        """
        half = self.quantile(is_used.sum(axis=0)) * self.error(values)
        low, high = values[0] - half, values[0] + half
        smallest = np.stack([np.where(is_used, bound, np.inf).min(axis=0) for bound in (low, high)], axis=-1)
        largest = np.stack([np.where(is_used, bound, -np.inf).max(axis=0) for bound in (low, high)], axis=-1)
        is_any = np.asarray(is_used.any(axis=0))[:, None]
        return np.where(is_any, smallest, np.nan), np.where(is_any, largest, np.nan)

    def candidates(self, values: Floats) -> Bools:
        """
        Return whether values may be the largest, (n_value, n_class).

        Comparisons with the largest estimate, with simultaneous limits (Bonferroni): the set contains the largest value with at
        least the probability of an interval (J. C. Hsu, Multiple comparisons, Chapman and Hall, 1996, chapter 4).
        """
        n_values = values.shape[1]
        largest = values[0].argmax(axis=0)
        difference = values[:, largest, np.arange(values.shape[2])][:, None] - values
        return np.asarray(difference[0] <= self.quantile(n_values) * self.error(difference))

    def interval_of_fraction(self, values: Floats, n_sites: Ints, n_draws: int) -> Floats:
        """
        Return the limits, (n_class, 2), of a fraction from values (1 + n_block, n_class).

        E. B. Wilson's score interval (J. Am. Stat. Assoc. 22, 209, 1927), with the number of independent draws that gives the
        variance of the jackknife: draws of a site are correlated by fixed patterns. At 0 and 1, it is the number of sites.
        """
        p, variance = values[0], self.error(values) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            n = np.where(variance > 0.0, p * (1.0 - p) / variance, n_sites)
        n = np.clip(n, 1.0, n_draws * n_sites)
        z2 = self.quantile() ** 2
        centre, half = p + 0.5 * z2 / n, np.sqrt(z2 * (p * (1.0 - p) + 0.25 * z2 / n) / n)
        return np.clip(np.stack(((centre - half), (centre + half)), axis=-1) / (1.0 + z2 / n)[:, None], 0.0, 1.0)

"""Bounded distributions of settings from plain data, such as ``{"uniform": [1.4, 8]}``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from foveasim._core.names import did_you_mean
from foveasim._core.random_streams import Streams
from foveasim._core.validation import check_count, check_number, finite_array
from foveasim.errors import ParameterError

__all__ = ["Distribution", "parse_distribution"]

#: Kinds of distributions and their parameters.
FORMS = {
    "uniform": "[low, high]",
    "log_uniform": "[low, high]",
    "integers": "[low, high], both inclusive",
    "normal": "[mean, standard deviation, low, high]",
    "choice": "a list of values",
}
#: Largest ratio of the standard deviation to high - low: beyond it, rounding leaves few distinct values.
MAX_SIGMA_RATIO = 1e6
#: Range of the integers of a choice: 64 bits, the type of the arrays of samples.
MIN_INTEGER, MAX_INTEGER = -(2**63), 2**63 - 1


@dataclass(frozen=True)
class Distribution:
    """
    Distribution of one setting.

    Attributes
    ----------
    path : str
        Path of the setting, such as ``"optics.f_number"``.
    kind : {"uniform", "log_uniform", "integers", "normal", "choice"}
    values : tuple
        Parameters of the distribution, or the values of a choice.
    weights : tuple of float, optional
        Relative probabilities of the values of a choice; equal by default.
    """

    path: str
    kind: Literal["uniform", "log_uniform", "integers", "normal", "choice"]
    values: tuple[Any, ...]
    weights: tuple[float, ...] | None = None

    @property
    def is_numeric(self) -> bool:
        """Whether every value is a number; otherwise samples contain the index of the choice."""
        return self.kind != "choice" or all(
            isinstance(value, int | float) and not isinstance(value, bool) for value in self.values
        )

    @property
    def number_type(self) -> type[int | float]:
        """Type of the numbers that samples contain."""
        if self.kind == "choice":
            return float if self.is_numeric and any(isinstance(value, float) for value in self.values) else int
        return int if self.kind == "integers" else float

    @property
    def bounds(self) -> tuple[Any, ...]:
        """Values that are checked before the first sample: both bounds, or every choice."""
        return self.values if self.kind == "choice" else self.values[-2:]

    def sample(self, seed: int, camera: int) -> tuple[Any, int | float]:
        """
        Return the value of the setting for one camera, and the number that samples contain.

        Both depend on the seed, the number of the camera and the path only, not on other random settings.
        """
        u = float(Streams(seed, camera).of(f"setting {self.path}").random())
        if self.kind == "choice":
            cumulative = np.cumsum(np.ones(len(self.values)) if self.weights is None else self.weights)
            index = int(np.searchsorted(cumulative, u * cumulative[-1], side="right"))
            return self.values[index], self.number_type(self.values[index] if self.is_numeric else index)
        low, high = self.values[-2:]
        if self.kind == "integers":
            number: int | float = low + int(u * (high - low + 1))
        elif self.kind == "uniform":
            number = low + u * (high - low)
        elif self.kind == "log_uniform":
            number = math.exp(math.log(low) + u * (math.log(high) - math.log(low)))
        else:
            mean, sigma = self.values[:2]
            with np.errstate(over="ignore"):  # bounds far from the mean
                below, above = ndtr((np.array([low, high]) - mean) / sigma)
            number = mean + sigma * float(ndtri(below + u * (above - below)))
        number = min(max(number, low), high)  # rounding
        return number, number

    def to_dict(self) -> dict[str, Any]:
        """Return the distribution as plain data for :func:`parse_distribution`."""
        return {self.kind: list(self.values)} | ({} if self.weights is None else {"weights": list(self.weights)})


def parse_distribution(path: str, spec: Any) -> Distribution:
    """
    Create the distribution of a setting from plain data.

    Parameters
    ----------
    path : str
        Path of the setting, for the random stream and messages.
    spec : mapping
        ``{"uniform": [low, high]}``; ``{"log_uniform": [low, high]}``, uniform in the logarithm; ``{"integers": [low, high]}``,
        both inclusive; ``{"normal": [mean, standard deviation, low, high]}``, truncated at the bounds; or
        ``{"choice": [...]}``, optionally with ``"weights"``, the relative probabilities.

    Returns
    -------
    Distribution

    Examples
    --------
    >>> parse_distribution("sensor.bits", {"choice": [8, 10]}).bounds
    (8, 10)
    >>> 1.4 <= parse_distribution("optics.f_number", {"log_uniform": [1.4, 8.0]}).sample(
    ...     seed=0, camera=3
    ... )[0] <= 8.0
    True
    """
    known = "; ".join(f"{kind}: {form}" for kind, form in FORMS.items())
    kinds = set(spec) - {"weights"} if isinstance(spec, Mapping) else set()
    if not isinstance(spec, Mapping) or len(kinds) != 1 or not kinds <= set(FORMS):
        unknown = sorted(kinds - set(FORMS))
        hint = did_you_mean(unknown[0], FORMS) if unknown else ""
        raise ParameterError(path, f"must have exactly one distribution ({known})", spec, hint=hint)
    (kind,) = kinds
    values = spec[kind]
    if not isinstance(values, Sequence | np.ndarray) or isinstance(values, str | bytes):
        raise ParameterError(path, f"must specify '{kind}' as {FORMS[kind]}", values)
    if kind == "choice":
        return _choice(path, values, spec.get("weights"))
    if "weights" in spec:
        raise ParameterError(path, f"must not have weights with '{kind}', only with 'choice'")
    if len(values) != (4 if kind == "normal" else 2):
        raise ParameterError(path, f"must specify '{kind}' as {FORMS[kind]}", list(values))
    if kind == "integers":
        low, high = (check_count(path, value, at_least=-(2**62), at_most=2**62) for value in values)
        numbers: tuple[Any, ...] = low, high
    else:
        numbers = tuple(check_number(path, value, above=0.0 if kind == "log_uniform" else None) for value in values)
        low, high = numbers[-2:]
    if not math.isfinite(high - low):
        raise ParameterError(path, f"must have '{kind}' bounds with a finite difference", list(values))
    if low > high:
        raise ParameterError(path, f"must have '{kind}' bounds in ascending order", list(values))
    if kind == "normal":
        mean, sigma = numbers[:2]
        # With a mean outside the bounds, rounding would leave few distinct values between them.
        if not (sigma > 0.0 and low <= mean <= high):
            raise ParameterError(path, "must have a standard deviation > 0 and a mean between the bounds", spec)
        if (high - low) * MAX_SIGMA_RATIO < sigma:
            raise ParameterError(
                path, f"must have a standard deviation of at most {MAX_SIGMA_RATIO:g} * (high - low)", spec
            )
    return Distribution(path, kind, numbers)


def _choice(path: str, values: Sequence[Any] | NDArray[Any], weights: Any) -> Distribution:
    try:
        choices = json.loads(json.dumps(list(values), default=lambda value: value.tolist()))
    except (TypeError, ValueError, AttributeError, RecursionError):
        raise ParameterError(path, "must have numbers, strings, lists or mappings as choices", values) from None
    if not choices:
        raise ParameterError(path, "must have at least one choice")
    for value in choices:
        if isinstance(value, int | float) and not isinstance(value, bool):
            check_number(path, value)
        if isinstance(value, int) and not MIN_INTEGER <= value <= MAX_INTEGER:
            raise ParameterError(path, "must have signed 64-bit integers as choices", value)
    if weights is not None:
        relative_weights = finite_array(f"weights of {path}", weights, ndim=1, at_least=0.0)
        if relative_weights.size != len(choices) or not 0.0 < sum(relative_weights.tolist()) < math.inf:
            raise ParameterError(path, f"must have {len(choices)} weights with a finite sum > 0", weights)
        return Distribution(path, "choice", tuple(choices), tuple(relative_weights.tolist()))
    return Distribution(path, "choice", tuple(choices))

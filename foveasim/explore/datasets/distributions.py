"""Distributions of settings, as plain data: ``{"uniform": [1.4, 8]}`` and its like, with an end on either side."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from foveasim._core.random_streams import Streams
from foveasim._core.validation import check_count, check_number, finite_array
from foveasim.errors import ParameterError

__all__ = ["Draw", "parse_distribution"]

#: What may stand in a distribution, and its numbers.
FORMS = {
    "uniform": "[low, high]",
    "log_uniform": "[low, high]",
    "integers": "[low, high], both of them included",
    "normal": "[mean, standard deviation, low, high]",
    "choice": "a list of values",
}
#: Standard deviation over the distance of the ends: beyond it rounding leaves few numbers between them.
WIDEST = 1e6
#: Integers of choices: those of 64 bits, as arrays of samples hold them.
LEAST, MOST = -(2**63), 2**63 - 1


@dataclass(frozen=True)
class Draw:
    """
    What a setting is drawn from.

    Attributes
    ----------
    path : str
        The setting, such as ``"optics.f_number"``.
    kind : {"uniform", "log_uniform", "integers", "normal", "choice"}
    values : tuple
        Numbers of the distribution, or the values to choose from.
    weights : tuple of float, optional
        Of a choice: chances in proportion to them; all alike by default.
    """

    path: str
    kind: Literal["uniform", "log_uniform", "integers", "normal", "choice"]
    values: tuple[Any, ...]
    weights: tuple[float, ...] | None = None

    @property
    def is_numeric(self) -> bool:
        """Whether every value is a number: others are told by their positions among the choices."""
        return self.kind != "choice" or all(
            isinstance(value, int | float) and not isinstance(value, bool) for value in self.values
        )

    @property
    def number_type(self) -> type[int | float]:
        """Of the numbers that tell the values, the same for all of them."""
        if self.kind == "choice":
            return float if self.is_numeric and any(isinstance(value, float) for value in self.values) else int
        return int if self.kind == "integers" else float

    @property
    def ends(self) -> tuple[Any, ...]:
        """The values that must be possible for all to be: both ends, or every choice."""
        return self.values if self.kind == "choice" else self.values[-2:]

    def at(self, seed: int, camera: int) -> tuple[Any, int | float]:
        """
        The value of one camera, and the number that tells it.

        It depends on the seed, the camera's number and the path, and on nothing else: not on other settings that are drawn.
        """
        share = float(Streams(seed, camera).of(f"setting {self.path}").random())
        if self.kind == "choice":
            edges = np.cumsum(np.ones(len(self.values)) if self.weights is None else self.weights)
            place = int(np.searchsorted(edges, share * edges[-1], side="right"))
            return self.values[place], self.number_type(self.values[place] if self.is_numeric else place)
        low, high = self.values[-2:]
        if self.kind == "integers":
            number: int | float = low + int(share * (high - low + 1))
        elif self.kind == "uniform":
            number = low + share * (high - low)
        elif self.kind == "log_uniform":
            number = math.exp(math.log(low) + share * (math.log(high) - math.log(low)))
        else:
            mean, sigma = self.values[:2]
            with np.errstate(over="ignore"):  # ends that are far out
                below, above = ndtr((np.array([low, high]) - mean) / sigma)
            number = mean + sigma * float(ndtri(below + share * (above - below)))
        number = min(max(number, low), high)  # rounding
        return number, number

    def to_dict(self) -> dict[str, Any]:
        """The distribution as plain data, as :func:`parse_distribution` takes it."""
        return {self.kind: list(self.values)} | ({} if self.weights is None else {"weights": list(self.weights)})


def parse_distribution(path: str, told: Any) -> Draw:
    """
    A distribution from plain data.

    Parameters
    ----------
    path : str
        The setting's, for messages.
    told : mapping
        ``{"uniform": [low, high]}``; ``{"log_uniform": [low, high]}``, even in the logarithm; ``{"integers": [low, high]}``,
        both included; ``{"normal": [mean, standard deviation, low, high]}``, cut off at the ends; or ``{"choice": [...]}``,
        with ``"weights"`` where the chances differ.

    Raises
    ------
    ParameterError
        When it is none of these.

    Examples
    --------
    >>> parse_distribution("sensor.bits", {"choice": [8, 10]}).ends
    (8, 10)
    >>> 1.4 <= parse_distribution("optics.f_number", {"log_uniform": [1.4, 8.0]}).at(seed=0, camera=3)[0] <= 8.0
    True
    """
    known = "; ".join(f"{kind}: {form}" for kind, form in FORMS.items())
    kinds = set(told) - {"weights"} if isinstance(told, Mapping) else set()
    if not isinstance(told, Mapping) or len(kinds) != 1 or not kinds <= set(FORMS):
        raise ParameterError(path, f"must be drawn from one distribution ({known})", told)
    (kind,) = kinds
    values = told[kind]
    if not isinstance(values, Sequence | np.ndarray) or isinstance(values, str | bytes):
        raise ParameterError(path, f"{kind} needs {FORMS[kind]}", values)
    if kind == "choice":
        return _choice(path, values, told.get("weights"))
    if "weights" in told:
        raise ParameterError(path, f"has weights, which only a choice has, and not {kind}")
    if len(values) != (4 if kind == "normal" else 2):
        raise ParameterError(path, f"{kind} needs {FORMS[kind]}", list(values))
    if kind == "integers":
        low, high = (check_count(path, value, at_least=-(2**62), at_most=2**62) for value in values)
        numbers: tuple[Any, ...] = low, high
    else:
        numbers = tuple(check_number(path, value, above=0.0 if kind == "log_uniform" else None) for value in values)
        low, high = numbers[-2:]
    if not math.isfinite(high - low):
        raise ParameterError(path, f"{kind} needs ends whose distance is a number", list(values))
    if low > high:
        raise ParameterError(path, f"{kind} must go from a lower number to a higher one", list(values))
    if kind == "normal":
        mean, sigma = numbers[:2]
        # Further out the numbers between the ends are no longer told apart.
        if not (sigma > 0.0 and low <= mean <= high):
            raise ParameterError(path, "normal needs a standard deviation above 0, and its mean between the ends", told)
        if (high - low) * WIDEST < sigma:
            raise ParameterError(
                path, f"normal needs a standard deviation up to {WIDEST:g} times its ends' distance", told
            )
    return Draw(path, kind, numbers)


def _choice(path: str, values: Sequence[Any] | NDArray[Any], weights: Any) -> Draw:
    try:
        plain = json.loads(json.dumps(list(values), default=lambda value: value.tolist()))
    except (TypeError, ValueError, AttributeError, RecursionError):
        raise ParameterError(path, "must be chosen from numbers, texts, lists and sections", values) from None
    if not plain:
        raise ParameterError(path, "must be chosen from at least one value")
    for value in plain:
        if isinstance(value, int | float) and not isinstance(value, bool):
            check_number(path, value)
        if isinstance(value, int) and not LEAST <= value <= MOST:
            raise ParameterError(path, "must be chosen from numbers of at most 64 bits", value)
    if weights is not None:
        shares = finite_array(f"weights of {path}", weights, ndim=1, at_least=0.0)
        if shares.size != len(plain) or not 0.0 < sum(shares.tolist()) < math.inf:
            raise ParameterError(path, f"needs weights for its {len(plain)} choices, of a sum above 0", weights)
        return Draw(path, "choice", tuple(plain), tuple(shares.tolist()))
    return Draw(path, "choice", tuple(plain))

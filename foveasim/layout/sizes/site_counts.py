"""
Layouts with a given number of sites: the value of one parameter of a generator.

The number of sites is a step function of the parameter, and monotonic except for its steps: the parameter is bracketed by
factors of 2, then found by bisection and interpolation in logarithms.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from foveasim._core.validation import MAX_SITES, check_count
from foveasim.errors import FoveasimError, ParameterError, warn
from foveasim.layout.model import Layout

__all__ = ["SITE_TOLERANCE", "CountError", "SolveFor", "layout_with_n_sites", "select_unknown"]

#: Largest relative difference between the requested and the actual number of sites.
SITE_TOLERANCE = 0.01
#: Relative difference at which the search ends, when counts are known without a layout and when each requires one.
GOOD_FRACTION, GOOD_FRACTION_OF_LAYOUTS = 1e-3, 4e-3
#: Largest number of steps to a bracket, and within it; smallest and largest factor of a step.
MAX_WIDENINGS, MAX_STEPS, MIN_FACTOR, MAX_FACTOR = 64, 64, 1.02, 2.0
#: Powers of 2 around the guess that are tried until a value is valid; few with layouts, which may have very many sites.
MAX_GUESSES, MAX_GUESSES_OF_LAYOUTS = 16, 2
#: Exponent of the first step in the ratio of counts: above 1/2, the exponent of a length in the number of sites.
STEP_EXPONENT = 0.7
#: Integers on either side of the best one that are tried: counts of integer rings are not strictly monotonic, and not every
#: integer is valid.
NEIGHBOURS = 16
#: Largest number of layouts that are generated from the best candidates until one is valid.
MAX_CANDIDATES = 40


#: First value of a search from the number of sites and the parameters, and number of sites from the parameters.
Guess: TypeAlias = Callable[[int, Mapping[str, Any]], float]
Count: TypeAlias = Callable[[Mapping[str, Any]], float | None]


@dataclass(frozen=True, kw_only=True)
class SolveFor:
    """
    A parameter that a generator solves for when ``n_sites`` is given.

    Attributes
    ----------
    name : str
        The parameter; its default is None.
    is_integer : bool
        Whether it is an integer, else a positive real number.
    is_increasing : bool
        Whether the number of sites increases with it.
    guess : function of (n_sites, parameters)
        First value of the search; ``parameters`` is a mapping of all parameters.
    count : function of parameters, optional
        Number of sites, without a layout; None if that is not known. By default a layout is generated for each value. For
        values that the generator rejects, the number may be a fraction.
    needs : tuple of str
        Parameters that must be given, otherwise another parameter is solved for.
    is_optional : bool
        Whether the generator accepts None.
    at_least : int
        Smallest integer.
    """

    name: str
    guess: Guess
    is_integer: bool = True
    is_increasing: bool = True
    count: Count | None = None
    needs: tuple[str, ...] = ()
    is_optional: bool = False
    at_least: int = 1


class CountError(ParameterError):
    """A number of sites that a generator cannot have; ``nearest`` is the nearest possible one."""

    def __init__(self, nearest: int, rule: str, value: int, hint: str) -> None:
        super().__init__("n_sites", rule, value, hint=hint)
        self.nearest = nearest


def select_unknown(generator: str, unknowns: Sequence[SolveFor], parameters: Mapping[str, Any]) -> SolveFor | None:
    """Return the parameter to solve for, or None when ``n_sites`` is not given."""
    free = [unknown for unknown in unknowns if parameters[unknown.name] is None]
    if parameters.get("n_sites") is None:
        for unknown in free:
            if not unknown.is_optional:
                raise ParameterError(unknown.name, "or 'n_sites' must be given")
        return None
    for unknown in free:
        if all(parameters[name] is not None for name in unknown.needs):
            return unknown
    for unknown in free:
        needed = " and ".join(f"'{name}'" for name in unknown.needs if parameters[name] is None)
        raise ParameterError("n_sites", f"of {generator} requires {needed} to solve for '{unknown.name}'")
    names = [f"'{unknown.name}'" for unknown in unknowns]
    raise ParameterError(
        "n_sites",
        f"of {generator} must be used without {' or '.join(names)}, which is then solved for",
        parameters["n_sites"],
    )


def layout_with_n_sites(
    generator: str,
    generate: Callable[[Mapping[str, Any]], Layout],
    unknown: SolveFor,
    parameters: Mapping[str, Any],
) -> tuple[Layout, float]:
    """
    Generate the layout whose number of sites is nearest to ``parameters["n_sites"]``.

    Returns ``value``: value of the unknown parameter. Raises ParameterError when the number differs by more than 1 %, with the
    nearest possible one; or as the generator.
    """
    target = check_count("n_sites", parameters["n_sites"], at_most=MAX_SITES)
    search = _Search(generate, unknown, {**parameters, "n_sites": None}, target)
    search.run()
    layout, value, caught = search.nearest_layout()
    if abs(layout.n_sites - target) > SITE_TOLERANCE * target:
        shown = f"{value:,}" if unknown.is_integer else f"{value:.6g}"
        raise CountError(
            layout.n_sites,
            f"of {generator} must be within {100 * SITE_TOLERANCE:g} % of a possible number",
            target,
            hint=f"the nearest is {layout.n_sites} with '{unknown.name}' = {shown}",
        )
    for warning in caught:
        warn(str(warning.message), warning.category)
    return layout, value


class _Search:
    """Numbers of sites by value of the unknown parameter, and the nearest layout."""

    def __init__(
        self,
        generate: Callable[[Mapping[str, Any]], Layout],
        unknown: SolveFor,
        parameters: Mapping[str, Any],
        target: int,
    ) -> None:
        self.generate, self.unknown, self.parameters, self.target = generate, unknown, parameters, target
        self.counts: dict[float, float | None] = {}
        self.built: tuple[Layout, float, list[warnings.WarningMessage]] | None = None
        self.has_cheap_counts = unknown.count is not None

    def count(self, value: float) -> float | None:
        """Return the number of sites for a value; None if the value is not valid."""
        if value not in self.counts:
            try:
                n_sites = None
                if self.unknown.count is not None:
                    n_sites = self.unknown.count({**self.parameters, self.unknown.name: value})
                if n_sites is None:
                    self.has_cheap_counts = False
                    n_sites = self.build(value)[0].n_sites
                self.counts[value] = n_sites if 0.0 < n_sites <= MAX_SITES else None
            except (FoveasimError, ArithmeticError, TypeError, ValueError):
                self.counts[value] = None  # the generator reports invalid parameters, below
        return self.counts[value]

    def build(self, value: float) -> tuple[Layout, float, list[warnings.WarningMessage]]:
        """Generate the layout of a value; the one nearest to the target is stored."""
        if self.built is not None and self.built[1] == value:
            return self.built
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            layout = self.generate({**self.parameters, self.unknown.name: value})
        found = layout, value, caught
        if self.built is None or self.distance(layout.n_sites) < self.distance(self.built[0].n_sites):
            self.built = found
        return found

    def distance(self, value: float) -> float:
        """Return the difference of a number of sites from the target."""
        return abs(value - self.target)

    def round(self, value: float) -> float:
        return max(self.unknown.at_least, round(value)) if self.unknown.is_integer else value

    def run(self) -> None:
        """Evaluate the count near the target."""
        low = self.start()
        n_low = self.counts[low]
        assert n_low is not None
        if self.distance(n_low) <= self.enough():
            return
        is_up = self.unknown.is_increasing == (n_low < self.target)
        factor = min(max(math.exp(STEP_EXPONENT * abs(math.log(self.target / n_low))), MIN_FACTOR), MAX_FACTOR)
        for _ in range(MAX_WIDENINGS):
            bound = self.round(low * factor if is_up else low / factor)
            if bound == low and self.unknown.is_integer:
                bound = max(self.unknown.at_least, low + (1 if is_up else -1))
            if bound == low:
                return
            if not self.is_before(bound, low):
                self.refine(low, bound)
                return
            low, factor = bound, min(factor**2, MAX_FACTOR)

    def start(self) -> float:
        """Return a valid value near the guess; the generator raises when there is none."""
        try:
            guess = max(float(self.unknown.guess(self.target, self.parameters)), 1e-300)
        except (ArithmeticError, TypeError, ValueError):
            guess = 1.0  # the generator reports invalid parameters
        for k in range(MAX_GUESSES if self.unknown.count is not None else MAX_GUESSES_OF_LAYOUTS):
            for value in (self.round(guess * 2.0**-k), self.round(guess * 2.0**k)):
                if self.count(value) is not None:
                    return value
        self.build(self.round(guess))
        raise ParameterError("n_sites", "must be a possible number of sites", self.target)

    def is_before(self, value: float, low: float) -> bool:
        """Return whether a value is valid, on the same side of the target, and nearer."""
        n_sites, n_low = self.count(value), self.counts[low]
        assert n_low is not None
        if n_sites is None:
            return False
        return n_low < n_sites < self.target if n_low < self.target else n_low >= n_sites >= self.target

    def refine(self, low: float, bound: float) -> None:
        """Search between a value on one side, and one on the other side or not valid."""
        for step in range(MAX_STEPS):
            middle = self.round(self.between(low, bound, step))
            if middle in (low, bound) or (not self.unknown.is_integer and abs(math.log(bound / low)) < 1e-12):
                return
            n_sites = self.count(middle)
            if n_sites is not None and self.distance(n_sites) <= self.enough():
                return
            if n_sites == self.counts[low] or self.is_before(middle, low):
                low = middle
            else:
                bound = middle

    def enough(self) -> float:
        """Return the difference of the number of sites at which the search ends."""
        return (GOOD_FRACTION if self.has_cheap_counts else GOOD_FRACTION_OF_LAYOUTS) * self.target

    def between(self, low: float, bound: float, step: int) -> float:
        """Return a value between two others, interpolated in every second step."""
        fraction, n_low, n_far = 0.5, self.counts[low], self.counts[bound]
        if step % 2 == 0 and n_low is not None and n_far is not None and n_low != n_far:
            fraction = math.log(self.target / n_low) / math.log(n_far / n_low)
        value = low * (bound / low) ** min(max(fraction, 0.01), 0.99)
        if self.unknown.is_integer and abs(bound - low) > 1:
            value = min(max(value, min(low, bound) + 1), max(low, bound) - 1)
        return value

    def sorted_values(self) -> list[float]:
        """Return all valid values, the nearest number of sites first."""
        known = {value: n_sites for value, n_sites in self.counts.items() if n_sites is not None}
        return sorted(known, key=lambda value: (self.distance(known[value]), value))

    def nearest_layout(self) -> tuple[Layout, float, list[warnings.WarningMessage]]:
        """Generate the nearest layout, from the best values that the generator accepts."""
        best = self.sorted_values()[0]
        try:
            found = self.build(best)
        except FoveasimError:
            found = None
        if found is not None and self.distance(found[0].n_sites) <= SITE_TOLERANCE * self.target:
            return found
        if self.unknown.is_integer and self.has_cheap_counts:
            for k in range(max(self.unknown.at_least, int(best) - NEIGHBOURS), int(best) + NEIGHBOURS + 1):
                self.count(k)
        problem: FoveasimError | None = None
        for value in self.sorted_values()[:MAX_CANDIDATES]:
            try:
                return self.build(value)
            except FoveasimError as error:
                problem = problem or error
        assert problem is not None  # at least one value is valid
        raise problem

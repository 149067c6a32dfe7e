"""
Declarations of parameters: ``Annotated[float, Limits(...)]`` contains the valid range.

The unit follows from the name (:func:`~foveasim._core.validation.unit_of`); a parameter whose type contains an array may have
one value per site. Validation, settings files with their schema, and the controls of the studio follow from the annotations.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache, partial
from inspect import get_annotations
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

import numpy as np

from foveasim._core.calls.kinds import resolve_annotation, without_alias
from foveasim._core.validation import (
    MAX_LENGTH_UM,
    MIN_LENGTH_UM,
    Floats,
    check_choice,
    check_count,
    check_number,
    finite_array,
    read_only,
    unit_of,
)
from foveasim.errors import ParameterError

#: Returns the valid value of a parameter: its name, a value, and the number of sites of the object.
Converter = Callable[[str, Any, int | None], Any]


@dataclass(frozen=True, kw_only=True, slots=True)
class Limits:
    """
    Valid range of a parameter, in its unit.

    Parameters
    ----------
    above, at_least : float, optional
        Lower limit, excluded or included.
    at_most : float, optional
        Upper limit.
    low : float
        Smallest plausible value besides 0: smaller ones indicate errors of units or digits.
    hint : str
        Reminder of the unit, for error messages.

    Examples
    --------
    >>> from foveasim.config import Limits
    >>> Limits(above=0.0, at_most=100.0).range
    'above 0, at most 100'
    """

    above: float | None = None
    at_least: float | None = None
    at_most: float | None = None
    low: float = 0.0
    hint: str = ""

    def __post_init__(self) -> None:
        if self.lowest > self.high:
            raise ParameterError("at_most", f"must be at least the lower limit {self.lowest:g}", self.high)

    @property
    def lowest(self) -> float:
        """Smallest valid value, besides 0 if that is valid."""
        return max(self.low or -math.inf, *(-math.inf if x is None else x for x in (self.above, self.at_least)))

    @property
    def high(self) -> float:
        """Largest valid value."""
        return math.inf if self.at_most is None else self.at_most

    @property
    def range(self) -> str:
        """Range in words, empty if all numbers are valid."""
        is_above = self.above is not None and self.above == self.lowest
        zero = "0, or " if self.low > 0.0 and self.above is None else ""
        if self.at_most is None:
            return "" if self.lowest == -math.inf else f"{'above' if is_above else 'at least'} {self.lowest:g}"
        low = (
            ""
            if self.lowest == -math.inf
            else f"above {self.lowest:g}, "
            if is_above
            else f"{zero}from {self.lowest:g} "
        )
        return f"{low}{'at most' if is_above or not low else 'to'} {self.high:g}"

    @property
    def schema(self) -> dict[str, float]:
        """Range as keys of a JSON schema."""
        is_above = self.above is not None and self.above == self.lowest
        low = {} if self.lowest == -math.inf else {"exclusiveMinimum" if is_above else "minimum": self.lowest}
        if self.low > 0.0 and self.above is None:
            low = {"minimum": 0.0}
        return low | ({} if self.at_most is None else {"maximum": self.at_most})

    def check(self, name: str, value: object) -> float:
        """Return a value as a float, or raise a ParameterError with rule, unit and hint."""
        if type(value) is float and self._contains(value):
            return value
        at_most = None if self.low else self.at_most
        number = check_number(name, value, above=self.above, at_least=self.at_least, at_most=at_most, hint=self.hint)
        if not self._contains(number):
            raise ParameterError(name, f"must be {self.range}", number, unit_of(name), self.hint)
        return number

    def check_array(self, name: str, value: Any, *, ndim: int | None = None) -> Floats:
        """Return values as a float64 array; a ParameterError has the index of the first wrong one."""
        at_most = None if self.low else self.at_most
        array = finite_array(
            name, value, ndim=ndim, above=self.above, at_least=self.at_least, at_most=at_most, hint=self.hint
        )
        if self.low and array.size:
            is_outside = (array > self.high) | ((array < self.low) & (array != 0.0))
            if is_outside.any():
                where = tuple(int(i) for i in np.argwhere(is_outside)[0])
                at = f" at [{', '.join(map(str, where))}]" if where else ""
                rule = f"must be {self.range}{' everywhere' * bool(where)}"
                raise ParameterError(name, rule, float(array[where]), (unit_of(name) + at).strip(), self.hint)
        return array

    def check_count(self, name: str, value: object) -> int:
        """Return a value as an integer within the limits."""
        low, high = (None if limit is None else math.floor(limit) for limit in (self.at_least, self.at_most))
        return check_count(name, value, at_least=-sys.maxsize if low is None else low, at_most=high, hint=self.hint)

    def _contains(self, value: float) -> bool:
        return (
            (self.above is None or value > self.above)
            and (self.at_least is None or value >= self.at_least)
            and value <= self.high
            and (not self.low or value >= self.low or value == 0.0)
            and math.isfinite(value)
        )


class Usual(NamedTuple):
    """
    Range of most devices, for sliders: ``Annotated[float, Limits(...), Usual(low, high)]``.

    Attributes
    ----------
    low, high : float
        Ends of the slider, which are not limits.

    Examples
    --------
    >>> from foveasim.config import Usual
    >>> Usual(1.0, 20.0).high
    20.0
    """

    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Words:
    """
    Words of a parameter on pages: ``Annotated[float, Limits(...), Words("read noise")]``.

    Attributes
    ----------
    label : str
        Name on the page; by default that of the parameter.
    help : str
        Sentence; by default that of the docstring.
    unit : str
        By default that of the name.
    synonyms : str
        Further words that the search finds.

    Examples
    --------
    >>> from foveasim.config import Words
    >>> Words("petal radius").label
    'petal radius'
    """

    label: str = ""
    help: str = ""
    unit: str = ""
    synonyms: str = ""


FINITE = Limits()
FRACTION = Limits(at_least=0.0, at_most=1.0)
POSITIVE = Limits(above=0.0)
NOT_NEGATIVE = Limits(at_least=0.0)
#: Ports of this computer; 0 for a free one.
PORT = Limits(at_least=0, at_most=2**16 - 1)
#: Lengths on a sensor.
LENGTH = Limits(above=0.0, at_least=MIN_LENGTH_UM, at_most=MAX_LENGTH_UM, hint="lengths on a sensor are in µm")


class Declaration(NamedTuple):
    """Types of values of a parameter, without None, with their arguments; ranges, words."""

    kinds: dict[Any, tuple[Any, ...]]
    limits: Limits | None = None
    usual: Usual | None = None
    words: Words | None = None
    is_optional: bool = False

    @classmethod
    def of(cls, annotation: Any) -> Declaration:
        """Return the declaration in a type, also in the members of a union."""
        annotation = without_alias(annotation)
        if get_origin(annotation) is Annotated:
            first, *notes = get_args(annotation)
            found = cls.of(first)
            for note in notes:
                if isinstance(note, Limits):
                    found = found._replace(limits=note)
                elif isinstance(note, Usual):
                    found = found._replace(usual=note)
                elif isinstance(note, Words):
                    found = found._replace(words=note)
            return found
        if get_origin(annotation) not in (Union, UnionType):
            if annotation is NoneType:
                return cls({}, is_optional=True)
            return cls({get_origin(annotation) or annotation: get_args(annotation)})
        parts = [cls.of(each) for each in get_args(annotation)]
        return cls(
            {kind: arguments for part in parts for kind, arguments in part.kinds.items()},
            next((part.limits for part in parts if part.limits), None),
            next((part.usual for part in parts if part.usual), None),
            next((part.words for part in parts if part.words), None),
            any(part.is_optional for part in parts),
        )

    @property
    def is_per_site(self) -> bool:
        """Whether the value is one number, or one for each site."""
        return {float, np.ndarray} <= set(self.kinds)

    @property
    def converter(self) -> Converter | None:
        """Function that returns a valid value; None if all values are valid."""
        convert = self._converter_of_values()
        if convert is None or not self.is_optional:
            return convert
        return lambda name, value, n_sites: None if value is None else convert(name, value, n_sites)

    def _converter_of_values(self) -> Converter | None:
        limits, kinds = self.limits or Limits(), set(self.kinds)
        words = [word for word in self.kinds.get(Literal, ()) if isinstance(word, str)]
        if self.is_per_site:
            return partial(_per_site, limits)
        if kinds - {Literal} in ({float}, {int}) and self.limits is not None:
            check = limits.check if float in kinds else limits.check_count
            return lambda name, value, _: value if isinstance(value, str) and value in words else check(name, value)
        if kinds == {Literal} and len(words) == len(self.kinds[Literal]):
            return lambda name, value, _: check_choice(name, value, words)
        if kinds == {bool}:
            return lambda name, value, _: _check_bool(name, value)
        if kinds == {Sequence} and self.limits is not None:
            return lambda name, value, _: tuple(limits.check_array(name, value, ndim=1).tolist())
        return None


def _per_site(limits: Limits, name: str, value: Any, n_sites: int | None) -> Any:
    """Return a number, or a read-only array with one number for each site."""
    if np.ndim(value) == 0:
        return limits.check(name, value)
    array = limits.check_array(name, value, ndim=1)
    if n_sites is not None and array.size != n_sites:
        raise ParameterError(name, f"must be one number, or one for each of the {n_sites} sites, got {array.size}")
    return read_only(array.copy())


def _check_bool(name: str, value: Any) -> bool:
    if not isinstance(value, bool | np.bool_):
        raise ParameterError(name, "must be True or False", value)
    return bool(value)


@lru_cache(maxsize=512)
def declarations_of(kind: type[Any]) -> Mapping[str, Declaration]:
    """Return what the annotations of the fields of a dataclass declare."""
    names = {each.name for each in fields(kind) if each.init}
    found: dict[str, Declaration] = {}
    for base in reversed(kind.__mro__):
        known = vars(sys.modules[base.__module__])
        for name, annotation in get_annotations(base).items():
            if name in names:
                found[name] = Declaration.of(resolve_annotation(annotation, known))
    return MappingProxyType(found)


@lru_cache(maxsize=512)
def _checks_of(kind: type[Any]) -> tuple[tuple[str, type, float, float, Converter], ...]:
    """Return names, a type and range of valid values, and converters of other values."""
    found = []
    for name, declared in declarations_of(kind).items():  # type: ignore[arg-type]
        convert, limits = declared.converter, declared.limits or FINITE
        if convert is not None:
            plain = next((each for each in (float, int, bool) if each in declared.kinds), NoneType)
            low = limits.lowest if limits.above != limits.lowest else math.nextafter(limits.lowest, math.inf)
            found.append((name, plain, max(low, -sys.float_info.max), min(limits.high, sys.float_info.max), convert))
    return tuple(found)


class Declared:
    """Base of dataclasses whose fields are validated as their annotations declare."""

    __slots__ = ()

    def __post_init__(self) -> None:
        check_declared(self)


def check_declared(instance: Any, *, n_sites: int | None = None) -> None:
    """
    Validate and convert the fields of a dataclass as their annotations declare.

    Numbers become floats or integers, sequences with limits tuples, arrays per site, of the length ``n_sites``, read-only
    copies. :class:`Declared` is the base of classes without further rules.
    """
    for name, plain, low, high, convert in _checks_of(type(instance)):  # type: ignore[arg-type]
        value = getattr(instance, name)
        if type(value) is not plain or value is None or not low <= value <= high:  # type: ignore[operator]
            found = convert(name, value, n_sites)
            if found is not value:
                object.__setattr__(instance, name, found)


def without_declarations(annotation: Any) -> Any:
    """
    Return the type in the text of an annotation, for signatures.

    Examples
    --------
    >>> without_declarations("Annotated[tuple[int, int], Limits(at_least=0)] | None")
    'tuple[int, int] | None'
    """
    while isinstance(annotation, str) and "Annotated[" in annotation:
        before, _, text = annotation.partition("Annotated[")
        depth, comma = 0, None
        for k, character in enumerate(text):
            depth += (character in "[(") - (character in "])")
            if character == "," and depth == 0 and comma is None:
                comma = k
            if depth < 0:
                annotation = before + text[:comma] + text[k + 1 :]
                break
    return annotation

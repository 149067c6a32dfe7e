"""Sensor chain: an ordered tuple of effects, applied in blocks of sites."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.names import possible_names
from foveasim._core.random_streams import Streams
from foveasim._core.validation import Floats
from foveasim.errors import ParameterError, SimulationError
from foveasim.sensor.adc import ConversionTables
from foveasim.sensor.blocks import for_each_block
from foveasim.sensor.effects import (
    STAGES,
    STANDARD,
    Collection,
    Effect,
    FixedFactor,
    FixedOffset,
    Mixing,
    Reach,
    ShotNoise,
    Sites,
)
from foveasim.sensor.effects.contract import REACHES

#: Stages before collection, which have no random stream.
FIXED_STAGES = ("photo", "dark", "expected")
#: Names of the effects that keywords build.
BUILTIN_NAMES = frozenset({"crosstalk", "ipc", "shot", *(cls.name for cls in STANDARD)})
#: Entries of the noise budget that are not effect names.
RESERVED_NAMES = ("photon_shot", "dark_shot", "quantisation")


class _Deterministic(ABC):
    """Deterministic step of the chain between effects."""

    name = ""
    reach: Reach = "site"
    is_temporal = False
    is_drawn_at_reset = False
    needs_layout = False

    @abstractmethod
    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return the values after the step."""


class _Arithmetic(_Deterministic):
    """Operation with an array (n_site,) or a number; a single neutral value changes nothing."""

    operation: ClassVar[np.ufunc]
    neutral: ClassVar[float] = 0.0

    def __init__(self, values: ArrayLike) -> None:
        self.values: NDArray[Any] = np.asarray(values)

    @property
    def is_neutral(self) -> bool:
        """Whether the step changes nothing."""
        return self.values.size == 1 and bool(self.values == self.neutral)

    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return the result of the operation."""
        found: Floats = self.operation(values, sites.select(self.values), out=values)
        return found


class Factor(_Arithmetic):
    """Multiplication."""

    operation: ClassVar[np.ufunc] = np.multiply
    neutral: ClassVar[float] = 1.0


class Offset(_Arithmetic):
    """Addition."""

    operation: ClassVar[np.ufunc] = np.add


class FullWell(_Arithmetic):
    """Upper limit of the charge."""

    operation: ClassVar[np.ufunc] = np.minimum
    neutral: ClassVar[float] = np.inf


@dataclass(eq=False)
class Nonlinearity(_Deterministic):
    """
    Quadratic response nonlinearity.

    ``fraction`` is the relative signal loss at full range; the loss grows with the square of the voltage.
    """

    fraction: float
    v_sat_v: float

    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return the voltages after the nonlinearity."""
        from foveasim.sensor import _kernels

        _kernels.apply_nonlinearity(values, self.fraction, self.v_sat_v)
        return values


@dataclass(eq=False)
class ChargeCheck(_Deterministic):
    """
    Check that charges are finite, and at least a limit, in e-.

    Raises ParameterError with the name of the charges and the smallest one of the block.
    """

    parameter: str
    at_least: float

    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return the values unchanged."""
        if values.size and not (smallest := float(np.min(values))) >= self.at_least:
            raise ParameterError(self.parameter, f"must be >= {self.at_least:g} everywhere", smallest, "e-")
        if values.size and not math.isfinite(largest := float(np.max(values))):
            raise ParameterError(self.parameter, "must be finite everywhere", largest, "e-")
        return values


class Save(_Deterministic):
    """Copy of the values of all sites to ``values``, an array (n_site,) of any type."""

    def __init__(self, dtype: type = np.float64) -> None:
        self.values: NDArray[Any] = np.empty(0, dtype)

    def allocate(self, n_sites: int) -> None:
        """Allocate the array; elements are undefined."""
        self.values = np.empty(n_sites, self.values.dtype)

    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return the values unchanged."""
        self.values[sites.index] = values
        return values


@dataclass(eq=False)
class Conversion(_Deterministic):
    """Conversion of voltages to codes, which are written to an array (n_site,)."""

    code: NDArray[Any]
    line: NDArray[np.int32]
    tables: ConversionTables

    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return the voltages unchanged."""
        from foveasim.sensor import _kernels

        _kernels.convert(values, sites.select(self.line), self.tables, self.code[sites.index])
        return values


#: Effect or deterministic step.
Step: TypeAlias = Effect | _Deterministic


def merge_steps(steps: Iterable[Step], sites: Sites) -> tuple[Step, ...]:
    """
    Merge consecutive factors, and consecutive offsets, into single steps.

    Factors of 1 and offsets of 0 are omitted. The result is the same to rounding. Merging avoids passes over the sites and
    reads of patterns from memory.
    """
    steps_merged: list[Step] = []
    for step in steps:
        current: Step = step
        if isinstance(step, FixedFactor):
            current = Factor(sites.of(step).pattern(step, step.pattern))
        elif isinstance(step, FixedOffset):
            current = Offset(sites.of(step).pattern(step, step.pattern))
        previous = steps_merged[-1] if steps_merged else None
        if isinstance(current, _Arithmetic) and type(previous) is type(current):
            steps_merged[-1] = type(current)(current.operation(previous.values, current.values))
        else:
            steps_merged.append(current)
    return tuple(step for step in steps_merged if not (isinstance(step, _Arithmetic) and step.is_neutral))


def sort_by_stage(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Sort effects by stage; effects of the same stage stay in their order."""
    order = list(STAGES)
    return tuple(sorted(effects, key=lambda effect: order.index(effect.stage)))


def check_effects(added: Any) -> tuple[Effect, ...]:
    """
    Validate additional effects of a sensor and return them as a tuple.

    Raises ParameterError if an effect violates the contract, or its name is not unique.
    """
    if not isinstance(added, list | tuple):
        raise ParameterError("effects", "must be a list of Effect objects", added)
    names = {*BUILTIN_NAMES, *RESERVED_NAMES}
    if any(isinstance(effect, Collection) for effect in added):
        names.discard(ShotNoise.name)
    for effect in added:
        if not isinstance(effect, Effect):
            raise ParameterError("effects", "must contain only foveasim.sensor.effects.Effect objects", effect)
        for attribute, kind in (("name", str), ("stage", str), ("is_temporal", bool)):
            if not isinstance(getattr(effect, attribute, None), kind):
                raise ParameterError(
                    "effects", f"must define the class attribute '{attribute}' of type {kind.__name__}", effect
                )
        if effect.name in names:
            raise ParameterError("effects", f"must have unique names, got '{effect.name}' twice")
        names.add(effect.name)
        if rule := next(_violated_rules(effect), None):
            raise ParameterError("effects", rule)
    if len(collections := [effect.name for effect in added if isinstance(effect, Collection)]) > 1:
        raise ParameterError("effects", f"must have at most one Collection, got {', '.join(map(repr, collections))}")
    return tuple(added)


def _violated_rules(effect: Effect) -> Iterator[str]:
    """Yield the rules of stages and reaches that an effect violates."""
    name, stage = effect.name, effect.stage
    if hasattr(effect, "is_local"):
        yield f"must define 'reach' instead of 'is_local': \"site\", \"group\" or \"all\" in '{name}'"
    if effect.reach not in REACHES:
        yield f'must have a reach of "site", "group" or "all"; \'{name}\' has {effect.reach!r}'
    if isinstance(effect, Collection):
        if (stage, effect.reach, effect.is_temporal) != ("collection", "site", True):
            yield f"must leave stage, reach and is_temporal of a Collection unchanged; '{name}' does not"
        return
    if stage not in STAGES or stage == "collection":
        stages = ", ".join(each for each in STAGES if each != "collection")
        yield f"must have a stage from {stages}; '{name}' has '{stage}'"
    if effect.is_temporal and stage in FIXED_STAGES:
        yield (
            f"before collection must be fixed, but '{name}' at the stage '{stage}' is temporal; use the stage 'charge'"
        )
    if effect.reach != "all" and not isinstance(effect, Mixing):
        return
    # Effects that mix sites are linear maps of charges.
    if effect.is_temporal:
        yield (
            f'of reach "all" must be deterministic, but \'{name}\' is temporal; use the reach "group", as GroupedNoise'
        )
    if not isinstance(effect, Mixing) or effect.reach != "all":
        yield f"of reach \"all\" must derive from Mixing and define operator(); change '{name}'"
    if stage not in (*FIXED_STAGES, "charge"):
        yield f"that mix sites must have a stage up to 'charge'; '{name}' has '{stage}'"


def check_names(names: Any, effects: Iterable[Effect]) -> tuple[str, ...]:
    """
    Validate names of effects and return them as a tuple.

    Raises ParameterError if a name is not that of an effect; the message contains the closest name and all names.
    """
    if isinstance(names, str):
        names = (names,)
    known = sorted({*BUILTIN_NAMES, *(effect.name for effect in effects)})
    try:
        names = tuple(names)
    except TypeError:
        raise ParameterError("disabled", "must contain names of effects", names) from None
    for name in names:
        if name not in known:
            hint = possible_names(name, known)
            raise ParameterError("disabled", "must contain names of effects", name, hint=hint)
    return names


def run_steps(
    steps: Iterable[Step],
    values: Any,
    *,
    sites: Sites,
    streams: Streams | None = None,
    reset_streams: Streams | None = None,
    n_threads: int | None = None,
) -> None:
    """
    Run steps of the chain.

    Results are written by :class:`Save` and :class:`Conversion`. Consecutive steps that do not mix sites process one block of
    sites after another, which stays in the cache for all of them.

    ``values`` (n_site,): not modified. ``sites``: all sites. ``streams``: random streams of the frame; required for temporal
    steps. ``reset_streams``: random streams of the last reset, for effects that are drawn at the reset; by default those of
    the frame. ``n_threads``: number of threads; all cores by default. Results do not depend on it.
    """

    def rng_of(step: Step, block: int) -> Any:
        own = reset_streams if step.is_drawn_at_reset and reset_streams is not None else streams
        if own is None or not step.is_temporal:
            return None
        # Draws of groups are common to all blocks.
        return own.of(step.name, block if step.reach == "site" else None)

    is_own = False
    groups = [(mixes, list(group)) for mixes, group in groupby(steps, key=lambda step: step.reach == "all")]
    for number, (mixes, group) in enumerate(groups):
        if mixes:
            all_sites = sites.block(slice(None), n_threads=n_threads)
            for step in group:
                own_values = values if is_own else np.array(values, np.float64)
                values, is_own = _apply_step(step, own_values, all_sites, None), True
            continue
        first, before, result = group[0], values, Save()
        if is_own and isinstance(first, Save) and first.values.dtype == values.dtype:
            # Shared instead of copied: steps modify only copies of blocks.
            first.values = values
            del group[0]
        if number + 1 < len(groups):
            group.append(result)
        for step in group:
            if isinstance(step, Save):
                step.allocate(sites.n_sites)
        if group:
            _run_blocks(group, before, sites, rng_of, n_threads)
        values, is_own = result.values, True


def _apply_step(step: Step, values: Any, sites: Sites, rng: Any) -> Any:
    """Apply a step and check the shape of its result."""
    found = step.apply(values, sites=sites.of(step), rng=rng)
    if getattr(found, "shape", None) != values.shape:
        raise SimulationError(
            f"the effect '{step.name}' must return an array of shape {values.shape}, got "
            f"{getattr(found, 'shape', type(found).__name__)}; check its apply()"
        )
    return found


def _run_blocks(
    steps: Sequence[Step], values: Any, sites: Sites, rng_of: Callable[[Step, int], Any], n_threads: int | None
) -> None:
    """Run steps that do not mix sites block by block."""

    def block(number: int, index: slice) -> None:
        part, part_sites = values[index].astype(np.float64), sites.block(index)
        for step in steps:
            part = _apply_step(step, part, part_sites, rng_of(step, number))

    for_each_block(sites.n_sites, block, n_threads)

"""Sensor chain: an ordered tuple of effects, applied in blocks of sites."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from foveasim._core.names import possible_names
from foveasim._core.random_streams import Streams
from foveasim._core.validation import Floats
from foveasim.errors import ParameterError, SimulationError
from foveasim.sensor.blocks import for_each_block, pieces
from foveasim.sensor.effects import STAGES, STANDARD, Effect, FixedFactor, FixedOffset, Sites

__all__ = [
    "Factor",
    "Nonlinearity",
    "Offset",
    "Step",
    "apply_steps",
    "check_effects",
    "check_names",
    "merge_steps",
    "sort_by_stage",
]

#: Stages before collection, which have no random stream.
FIXED_STAGES = ("photo", "dark", "expected")
#: Names of the effects that keywords build.
BUILTIN_NAMES = frozenset({"crosstalk", "ipc", "shot", *(cls.name for cls in STANDARD)})
#: Entries of the noise budget that are not effect names.
RESERVED_NAMES = ("photon_shot", "dark_shot", "quantisation")


class _Deterministic:
    """Deterministic step of the chain between effects."""

    name = ""
    is_local = True
    is_temporal = False

    def __init__(self, values: Any) -> None:
        self.values = np.asarray(values)

    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return the values after the step."""
        raise NotImplementedError


class Factor(_Deterministic):
    """Multiplication by an array (n_site,) or a number."""

    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return the product."""
        _ = rng
        values *= sites.select(self.values)
        return values


class Offset(_Deterministic):
    """Addition of an array (n_site,) or a number."""

    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return the sum."""
        _ = rng
        values += sites.select(self.values)
        return values


class Nonlinearity(_Deterministic):
    """
    Quadratic response nonlinearity.

    ``fraction`` is the relative signal loss at full range; the loss grows with the square of the voltage.
    """

    def __init__(self, fraction: float, v_sat_v: float) -> None:
        super().__init__(fraction)
        self.fraction, self.v_sat_v = fraction, v_sat_v

    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return the voltages after the nonlinearity."""
        from foveasim.sensor import _kernels

        _ = sites, rng
        _kernels.apply_nonlinearity(values, self.fraction, self.v_sat_v)
        return values


#: Effect or deterministic step.
Step: TypeAlias = Effect | _Deterministic


def merge_steps(steps: Iterable[Step], sites: Sites) -> tuple[Step, ...]:
    """
    Merge consecutive factors, and consecutive offsets, into single steps.

    The result is the same to rounding. Merging avoids passes over the sites and reads of patterns from memory.
    """
    steps_merged: list[Step] = []
    for step in steps:
        current: Step = step
        if isinstance(step, FixedFactor):
            current = Factor(sites.pattern(step, step.pattern))
        elif isinstance(step, FixedOffset):
            current = Offset(sites.pattern(step, step.pattern))
        previous = steps_merged[-1] if steps_merged else None
        if isinstance(current, Factor) and isinstance(previous, Factor):
            steps_merged[-1] = Factor(previous.values * current.values)
        elif isinstance(current, Offset) and isinstance(previous, Offset):
            steps_merged[-1] = Offset(previous.values + current.values)
        else:
            steps_merged.append(current)
    return tuple(steps_merged)


def sort_by_stage(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Sort effects by stage; effects of the same stage stay in their order."""
    order = list(STAGES)
    return tuple(sorted(effects, key=lambda effect: order.index(effect.stage)))


def check_effects(added: Any) -> tuple[Effect, ...]:
    """
    Validate additional effects of a sensor and return them as a tuple.

    Raises
    ------
    ParameterError
        If an effect violates the contract, or its name is not unique.
    """
    if not isinstance(added, list | tuple):
        raise ParameterError("effects", "must be a list of Effect objects", added)
    names = {*BUILTIN_NAMES, *RESERVED_NAMES}
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
        if effect.stage not in STAGES or effect.stage == "collection":
            stages = ", ".join(stage for stage in STAGES if stage != "collection")
            raise ParameterError("effects", f"must have a stage from {stages}; '{effect.name}' has '{effect.stage}'")
        if effect.is_temporal and effect.stage in FIXED_STAGES:
            raise ParameterError(
                "effects",
                f"before collection must be fixed, but '{effect.name}' at the stage '{effect.stage}' is temporal; "
                "use the stage 'charge'",
            )
    return tuple(added)


def check_names(names: Any, effects: Iterable[Effect]) -> tuple[str, ...]:
    """
    Validate names of effects and return them as a tuple.

    Raises
    ------
    ParameterError
        If a name is not that of an effect; the message contains the closest name and all names.
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


def apply_steps(
    steps: Iterable[Step],
    values: Any,
    *,
    sites: Sites,
    streams: Streams | None = None,
    n_threads: int | None = None,
    out: NDArray[Any] | None = None,
    last: Callable[[Any, Sites, NDArray[Any]], None] | None = None,
) -> NDArray[Any]:
    """
    Apply steps of the chain to the values of all sites.

    Parameters
    ----------
    steps : iterable of Step
    values : (n_site,)
        Not modified.
    sites : Sites
        All sites.
    streams : Streams, optional
        Random streams of the frame; required for temporal steps.
    n_threads : int, optional
        Number of threads; all cores by default. Results do not depend on it.
    out : (n_site,), optional
        Array for the result; a float64 array by default.
    last : callable, optional
        Called as ``last(values, sites, out)`` for each piece of sites; it writes to that part of ``out``.

    Returns
    -------
    out : (n_site,)
    """
    local: list[Step] = []
    is_own = False
    for step in steps:
        if step.is_local:
            local.append(step)
            continue
        if local:
            values = _apply_local_steps(local, values, np.empty(sites.n_sites), None, sites, streams, n_threads)
            is_own = True
        rng: Any = streams.of(step.name) if step.is_temporal and streams is not None else None
        all_sites = sites.block(slice(None), n_threads=n_threads)
        own_values = values if is_own else np.array(values, np.float64)
        values, local, is_own = _apply_step(step, own_values, all_sites, rng), [], True
    if not local and out is None:
        return np.asarray(values)
    return _apply_local_steps(
        local, values, np.empty(sites.n_sites) if out is None else out, last, sites, streams, n_threads
    )


def _apply_step(step: Step, values: Any, sites: Sites, rng: Any) -> Any:
    """Apply a step and check the shape of its result."""
    found = step.apply(values, sites=sites, rng=rng)
    if getattr(found, "shape", None) != values.shape:
        raise SimulationError(
            f"the effect '{step.name}' must return an array of shape {values.shape}, got "
            f"{getattr(found, 'shape', type(found).__name__)}; check its apply()"
        )
    return found


def _apply_local_steps(
    steps: Sequence[Step],
    values: Any,
    out: NDArray[Any],
    last: Callable[[Any, Sites, NDArray[Any]], None] | None,
    sites: Sites,
    streams: Streams | None,
    n_threads: int | None,
) -> NDArray[Any]:
    """Apply local steps piece by piece, so that each piece stays in the cache for all steps."""

    def block(number: int, block_slice: slice) -> None:
        rngs: list[Any] = [
            streams.of(step.name, number) if step.is_temporal and streams is not None else None for step in steps
        ]
        for index in pieces(block_slice):
            part, part_sites = values[index].astype(np.float64), sites.block(index)
            for step, rng in zip(steps, rngs, strict=True):
                part = _apply_step(step, part, part_sites, rng)
            if last is None:
                out[index] = part
            else:
                last(part, part_sites, out[index])

    for_each_block(out.size, block, n_threads)
    return out

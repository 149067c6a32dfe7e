"""The sensor chain: an ordered tuple of effects, and running values through a part of it in blocks of sites."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from difflib import get_close_matches
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from foveasim._core.random_streams import Streams
from foveasim._core.validation import Floats
from foveasim.errors import ParameterError, SimulationError
from foveasim.sensor.blocks import in_blocks, pieces
from foveasim.sensor.effects import STAGES, STANDARD, Effect, FixedFactor, FixedOffset, Sites

__all__ = ["Factor", "Nonlinearity", "Offset", "Step", "check_effects", "check_names", "merged", "ordered", "run"]

#: Stages whose values have no random stream.
FIXED_STAGES = ("photo", "dark", "expected")
#: Names of the effects that keywords build.
BUILT = frozenset({"crosstalk", "ipc", "shot", *(cls.name for cls in STANDARD)})
#: Names of lines of the noise budget that belong to no effect of the same name.
RESERVED = ("photon_shot", "dark_shot", "quantisation")


class _Deterministic:
    """A deterministic part of the chain between effects."""

    name = ""
    is_local = True
    is_temporal = False

    def __init__(self, values: Any) -> None:
        self.values = np.asarray(values)

    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return values after it."""
        raise NotImplementedError


class Factor(_Deterministic):
    """Multiplication by numbers (n_site,) or one number."""

    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return the product."""
        _ = rng
        values *= sites.of(self.values)
        return values


class Offset(_Deterministic):
    """Addition of numbers (n_site,) or one number."""

    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return the sum."""
        _ = rng
        values += sites.of(self.values)
        return values


class Nonlinearity(_Deterministic):
    """The response that lacks a fraction of the voltage at full range, growing with the square of the voltage."""

    def __init__(self, fraction: float, v_sat_v: float) -> None:
        super().__init__(fraction)
        self.bend, self.v_sat_v = fraction, v_sat_v

    def apply(self, values: Floats, *, sites: Sites, rng: Any) -> Floats:
        """Return voltages after the nonlinearity."""
        from foveasim.sensor import _kernels

        _ = sites, rng
        _kernels.bend_voltages(values, self.bend, self.v_sat_v)
        return values


#: What values run through.
Step: TypeAlias = Effect | _Deterministic


def merged(steps: Iterable[Step], sites: Sites) -> tuple[Step, ...]:
    """
    Return steps of the same result, to rounding, in which consecutive factors are one, and consecutive offsets.

    A pass over a piece of sites costs as much as the arithmetic, and each pattern is read from memory.
    """
    done: list[Step] = []
    for step in steps:
        fixed: Step = step
        if isinstance(step, FixedFactor):
            fixed = Factor(sites.pattern(step, step.pattern))
        elif isinstance(step, FixedOffset):
            fixed = Offset(sites.pattern(step, step.pattern))
        before = done[-1] if done else None
        if isinstance(fixed, Factor) and isinstance(before, Factor):
            done[-1] = Factor(before.values * fixed.values)
        elif isinstance(fixed, Offset) and isinstance(before, Offset):
            done[-1] = Offset(before.values + fixed.values)
        else:
            done.append(fixed)
    return tuple(done)


def ordered(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Return effects in the order of the chain; those of one stage stay in their order."""
    order = list(STAGES)
    return tuple(sorted(effects, key=lambda effect: order.index(effect.stage)))


def check_effects(added: Any) -> tuple[Effect, ...]:
    """
    Return effects that are added to a sensor's own as a tuple.

    Raises
    ------
    ParameterError
        When one does not fulfil the contract, or its name is taken.
    """
    if not isinstance(added, list | tuple):
        raise ParameterError("effects", "must be a list of effects", added)
    taken = {*BUILT, *RESERVED}
    for effect in added:
        if not isinstance(effect, Effect):
            raise ParameterError("effects", "must be foveasim.sensor.effects.Effect objects", effect)
        for attribute, kind in (("name", str), ("stage", str), ("is_temporal", bool)):
            if not isinstance(getattr(effect, attribute, None), kind):
                raise ParameterError(
                    "effects", f"must have a class attribute '{attribute}' of type {kind.__name__}", effect
                )
        if effect.name in taken:
            raise ParameterError("effects", f"must have names that no other effect has, got two '{effect.name}'")
        taken.add(effect.name)
        if effect.stage not in STAGES or effect.stage == "collection":
            stages = ", ".join(stage for stage in STAGES if stage != "collection")
            raise ParameterError("effects", f"must have a stage of {stages}; '{effect.name}' has '{effect.stage}'")
        if effect.is_temporal and effect.stage in FIXED_STAGES:
            raise ParameterError(
                "effects",
                f"before collection must be fixed, but '{effect.name}' at the stage '{effect.stage}' is temporal; "
                "give it the stage 'charge'",
            )
    return tuple(added)


def check_names(names: Any, effects: Iterable[Effect]) -> tuple[str, ...]:
    """
    Return names of effects as a tuple.

    Raises
    ------
    ParameterError
        When one is not the name of an effect; with the closest name.
    """
    if isinstance(names, str):
        names = (names,)
    known = sorted({*BUILT, *(effect.name for effect in effects)})
    try:
        names = tuple(names)
    except TypeError:
        raise ParameterError("disabled", "must be names of effects", names) from None
    for name in names:
        if name not in known:
            closest = get_close_matches(str(name), known, n=1)
            hint = f"did you mean '{closest[0]}'?" if closest else f"the effects are {', '.join(known)}"
            raise ParameterError("disabled", "must be names of effects", name, hint=hint)
    return names


def run(
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
    Run values of all sites through steps of the chain.

    Parameters
    ----------
    steps : iterable of Step
    values : (n_site,)
        Not changed.
    sites : Sites
        All sites.
    streams : Streams, optional
        Of the frame; needed where a step is temporal.
    n_threads : int, optional
        All cores by default. Results do not depend on it.
    out : (n_site,), optional
        Array for the result; float64 by default.
    last : callable, optional
        Called as ``last(values, sites, out)`` for each piece, to write into its part of ``out``.

    Returns
    -------
    out : (n_site,)
    """
    local: list[Step] = []
    is_ours = False
    for step in steps:
        if step.is_local:
            local.append(step)
            continue
        if local:
            values = _pass(local, values, np.empty(sites.n_sites), None, sites, streams, n_threads)
            is_ours = True
        rng: Any = streams.of(step.name) if step.is_temporal and streams is not None else None
        whole = sites.block(slice(None), n_threads=n_threads)
        mine = values if is_ours else np.array(values, np.float64)
        values, local, is_ours = _applied(step, mine, whole, rng), [], True
    if not local and out is None:
        return np.asarray(values)
    return _pass(local, values, np.empty(sites.n_sites) if out is None else out, last, sites, streams, n_threads)


def _applied(step: Step, values: Any, sites: Sites, rng: Any) -> Any:
    """Values after a step, one for each site."""
    found = step.apply(values, sites=sites, rng=rng)
    if getattr(found, "shape", None) != values.shape:
        raise SimulationError(
            f"the effect '{step.name}' must return an array of the shape {values.shape}, got "
            f"{getattr(found, 'shape', type(found).__name__)}; check its apply()"
        )
    return found


def _pass(
    steps: Sequence[Step],
    values: Any,
    out: NDArray[Any],
    last: Callable[[Any, Sites, NDArray[Any]], None] | None,
    sites: Sites,
    streams: Streams | None,
    n_threads: int | None,
) -> NDArray[Any]:
    """Run values through local steps, piece by piece, so that all steps of a piece find it in the cache."""

    def block(number: int, whole: slice) -> None:
        rngs: list[Any] = [
            streams.of(step.name, number) if step.is_temporal and streams is not None else None for step in steps
        ]
        for index in pieces(whole):
            part, some = values[index].astype(np.float64), sites.block(index)
            for step, rng in zip(steps, rngs, strict=True):
                part = _applied(step, part, some, rng)
            if last is None:
                out[index] = part
            else:
                last(part, some, out[index])

    in_blocks(out.size, block, n_threads)
    return out

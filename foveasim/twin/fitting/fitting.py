"""Parameters of a sensor from statistics of stacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from foveasim._core.validation import Floats
from foveasim.twin.fitting.chain import Spread
from foveasim.twin.fitting.chain_fit import ChainFit, fit_chain
from foveasim.twin.fitting.defects import find_defects
from foveasim.twin.fitting.estimates import Results
from foveasim.twin.fitting.intervals import Estimate, Uncertain
from foveasim.twin.fitting.levels import Levels
from foveasim.twin.fitting.pixels import Pixels, measure_pixels
from foveasim.twin.fitting.pooled import PooledFit
from foveasim.twin.fitting.recording import Recording
from foveasim.twin.frames.stacks import Stack
from foveasim.twin.frames.statistics import StackStatistics

__all__ = ["Fitted", "fit_statistics"]

#: Rounds of the fit, with what differs between pixels from the round before.
ROUNDS = 3


@dataclass(eq=False)
class Fitted:
    """
    Result of :func:`fit_statistics`.

    ``estimates``: parameters with intervals, or why they are not identifiable. ``maps``: (n_y, n_x) by name. ``levels``,
    ``fit``: statistics and chain. ``assumptions``: what was taken as known. ``temperature_k``: of the dark current, or None.
    """

    estimates: dict[str, Estimate | Uncertain]
    maps: dict[str, Floats]
    levels: Levels
    fit: PooledFit
    assumptions: list[str]
    temperature_k: float | None


def fit_statistics(
    statistics: Sequence[StackStatistics],
    stacks: Sequence[Stack],
    known: Mapping[str, Any],
    mosaic: str | None = None,
) -> Fitted:
    """
    Fit a sensor to the statistics of stacks.

    ``known``: ``bits``, and parameters of the ADC other than linear ones.

    Raises ParameterError when there are no dark stacks, no stacks with light, or the stacks do not differ.
    """
    recording, defects = find_defects(Recording.of(list(statistics), list(stacks), dict(known), mosaic))
    spread = Spread()
    chain: ChainFit | None = None
    pixels: Pixels | None = None
    for k in range(ROUNDS):
        chain = fit_chain(recording, defects, spread, chain)
        pixels = measure_pixels(recording, defects, chain)
        before, spread = spread, pixels.spread
        if k and spread.is_close(before):
            break
    assert chain is not None
    assert pixels is not None
    results = Results(recording, defects, chain, pixels)
    temperatures = [each.temperature_k for each in stacks if each.temperature_k is not None]
    return Fitted(
        results.estimates(),
        results.maps(),
        chain.levels,
        chain.fit,
        results.assumptions(),
        min(temperatures, default=None),
    )

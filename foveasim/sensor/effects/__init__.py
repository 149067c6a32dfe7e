"""
Effects: noise sources, fixed patterns and crosstalk, one frozen class each.

``STANDARD`` lists the classes that the keywords of :class:`foveasim.Sensor` create, in the order of the chain. Further effects
derive from :class:`Effect`, or from :class:`AdditiveNoise`, :class:`GroupedNoise`, :class:`FixedFactor`, :class:`FixedOffset`,
:class:`Mixing` or :class:`Collection`. They are passed to a sensor as ``effects=[...]``, or specified in settings files by
their names in :data:`EFFECTS`.
"""

from __future__ import annotations

from typing import Any

from foveasim._core.calls import publish
from foveasim._core.registry import import_all
from foveasim.sensor.effects.collection import Collection
from foveasim.sensor.effects.contract import (
    EFFECTS,
    STAGES,
    AdditiveNoise,
    Effect,
    FixedFactor,
    FixedOffset,
    GroupedNoise,
    Photosites,
    Reach,
    Sites,
    Stage,
    StepModel,
)
from foveasim.sensor.effects.crosstalk import (
    CrosstalkOperator,
    Diffusion,
    InterPixelCapacitance,
    KernelCrosstalk,
    Mixing,
)
from foveasim.sensor.effects.dark import DarkLaw, DarkSignal, HotSites, dark_current_factor
from foveasim.sensor.effects.fixed_pattern import (
    ColumnOffset,
    DarkOffset,
    DeadSites,
    PhotoResponse,
    PixelGain,
    PixelOffset,
)
from foveasim.sensor.effects.measured import ColumnNoise, OffsetMap, ResponseMap, RowNoise, TelegraphMap
from foveasim.sensor.effects.readout import ReadNoise, ResetNoise, TelegraphNoise
from foveasim.sensor.effects.shot import ShotNoise, draw_shot_noise

__all__ = [
    "EFFECTS",
    "STAGES",
    "STANDARD",
    "AdditiveNoise",
    "Collection",
    "ColumnNoise",
    "ColumnOffset",
    "CrosstalkOperator",
    "DarkLaw",
    "DarkOffset",
    "DarkSignal",
    "DeadSites",
    "Diffusion",
    "Effect",
    "FixedFactor",
    "FixedOffset",
    "GroupedNoise",
    "HotSites",
    "InterPixelCapacitance",
    "KernelCrosstalk",
    "Mixing",
    "OffsetMap",
    "PhotoResponse",
    "Photosites",
    "PixelGain",
    "PixelOffset",
    "Reach",
    "ReadNoise",
    "ResetNoise",
    "ResponseMap",
    "RowNoise",
    "ShotNoise",
    "Sites",
    "Stage",
    "StepModel",
    "TelegraphMap",
    "TelegraphNoise",
    "dark_current_factor",
    "draw_shot_noise",
]

#: Effects of a sensor's keywords, in the order of the chain; ``example`` contains keywords that enable an effect.
STANDARD: tuple[Any, ...] = (
    PhotoResponse,
    DeadSites,
    DarkSignal,
    HotSites,
    ResetNoise,
    ReadNoise,
    TelegraphNoise,
    DarkOffset,
    PixelGain,
    PixelOffset,
    ColumnOffset,
)

import_all(__name__, __path__)

publish(__name__)

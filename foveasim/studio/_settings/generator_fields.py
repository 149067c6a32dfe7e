"""Fields of generated layouts: parameters for another width and height."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["RECTANGULAR", "rounded_down", "with_field", "with_scale"]

#: Generators that fill a rectangle, with the parameters that its sides and the number of photosites replace.
RECTANGULAR: dict[str, tuple[str, ...]] = {
    "grid": ("n_x", "n_y", "pitch_um", "pitch_y_um"),
    "hexagonal": ("n_columns", "n_rows", "pitch_um"),
    "octagonal": ("n_x", "n_y", "pitch_um"),
    "tiling": ("pitch_um", "radius_um"),
    "voronoi": (),
}
#: Significant digits of lengths, and suffix of their names.
DIGITS, LENGTH = 7, "_um"
#: Radius that an outline does not exceed, whatever fills the fovea.
LIMIT = "r_max_um"


def with_field(
    generator: str, parameters: Mapping[str, Any], size_um: Sequence[float], present_um: Sequence[float]
) -> dict[str, Any]:
    """
    Return parameters of a generator for a field of a width and a height.

    Layouts that fill a rectangle lack a pitch, which follows from a number of photosites; others are inscribed in the field.

    ``size_um``, ``present_um``: width and height of the field, and of the layout of the parameters.
    """
    if generator in RECTANGULAR:
        kept = {name: value for name, value in parameters.items() if name not in RECTANGULAR[generator]}
        return {**kept, "size_um": [rounded_down(side_um, DIGITS) for side_um in size_um]}
    factor = min(side_um / own_um for side_um, own_um in zip(size_um, present_um, strict=True))
    return with_scale(parameters, factor, 0.5 * min(size_um))


def with_scale(parameters: Mapping[str, Any], factor: float, limit_um: float) -> dict[str, Any]:
    """Return parameters with lengths times a factor, and radii of at most ``limit_um``."""
    found = {name: _scaled(value, factor) if name.endswith(LENGTH) else value for name, value in parameters.items()}
    return found | {LIMIT: min(found[LIMIT], rounded_down(limit_um, DIGITS))} if LIMIT in found else found


def rounded_down(value: float, n_digits: int) -> float:
    """Return a positive number with a number of significant digits, not above it."""
    unit = 10.0 ** (math.floor(math.log10(value)) - n_digits + 1)
    return float(f"{math.floor(value / unit) * unit:.{n_digits}g}")


def _scaled(value: Any, factor: float) -> Any:
    """Return a length or lengths multiplied by a factor."""
    if isinstance(value, list):
        return [_scaled(item, factor) for item in value]
    return rounded_down(value * factor, DIGITS) if isinstance(value, int | float) else value

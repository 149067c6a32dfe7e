"""Verdict of a comparison in words: which camera is better where, and by how much."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from foveasim._core.validation import Floats
from foveasim.compare.intervals import MIN_SCENES

if TYPE_CHECKING:
    from foveasim.compare.comparison import Comparison

#: Differences of PSNR up to this value count as equal.
EQUAL_DB = 0.1


def verdict_lines(comparison: Comparison) -> list[str]:
    """Return two sentences per camera after the first: by eccentricity, and over the field."""
    by_annulus = comparison.differences("psnr_db", by_eccentricity=True).median
    over_field = comparison.differences("psnr_db")
    first, *others = comparison.names
    lines = []
    for k, other in enumerate(others, start=1):
        lines.append(_by_eccentricity(first, other, by_annulus[k], comparison.edges_um))
        bounds = (float(over_field.low[k]), float(over_field.high[k]))
        lines.append(_over_field(first, other, float(over_field.median[k]), bounds, len(comparison.scenes)))
    return lines


def _by_eccentricity(first: str, other: str, difference_db: Floats, edges_um: Floats) -> str:
    """State at which eccentricities each camera has the higher PSNR."""
    known = np.isfinite(difference_db)
    difference_db, centre_um = difference_db[known], 0.5 * (edges_um[1:] + edges_um[:-1])[known]
    sign = np.where(np.abs(difference_db) > EQUAL_DB, np.sign(difference_db), 0.0)
    if not sign.any():
        return f"{first} and {other} have the same PSNR at all eccentricities, within {EQUAL_DB:g} dB."
    best = {name: float((side * difference_db).max()) for name, side in ((other, 1.0), (first, -1.0))}
    # Annuli of equal PSNR continue the annulus before them.
    different = np.flatnonzero(sign)
    sign = sign[different[np.maximum(np.searchsorted(different, np.arange(sign.size), side="right") - 1, 0)]]
    changes = np.flatnonzero(np.diff(sign))
    inner, outer = (other, first) if sign[0] > 0.0 else (first, other)
    if not changes.size:
        return f"{inner} has a higher PSNR than {outer} at all eccentricities, by up to {best[inner]:.1f} dB."
    at_um = [_crossing_um(centre_um[k : k + 2], difference_db[k : k + 2]) for k in changes]
    if len(at_um) == 1:
        return (
            f"Within {at_um[0]:.0f} µm of the fixation point, {inner} has a higher PSNR than {outer}, by up to "
            f"{best[inner]:.1f} dB; beyond, {outer} has the higher one, by up to {best[outer]:.1f} dB."
        )
    limits = ", ".join(f"{radius_um:.0f}" for radius_um in at_um[:-1]) + f" and {at_um[-1]:.0f}"
    return (
        f"The higher PSNR is that of {inner} (by up to {best[inner]:.1f} dB) and of {outer} (by up to {best[outer]:.1f} dB) in "
        f"turn: from the fixation point outwards, it changes at {limits} µm, beginning with {inner}."
    )


def _crossing_um(radius_um: Floats, difference_db: Floats) -> float:
    """Return the radius at which a difference between two annuli is 0, interpolated linearly."""
    (r0_um, r1_um), (d0_db, d1_db) = radius_um.tolist(), difference_db.tolist()
    fraction = d0_db / (d0_db - d1_db) if d0_db * d1_db < 0.0 else 0.5
    return float(r0_um + fraction * (r1_um - r0_um))


def _over_field(first: str, other: str, difference_db: float, bounds_db: tuple[float, float], n_scenes: int) -> str:
    if not np.isfinite(difference_db):
        return f"Over the field, the PSNR of {first} and {other} cannot be compared."
    if abs(difference_db) <= EQUAL_DB:
        return f"Over the field, the PSNR of {first} and {other} is equal within {EQUAL_DB:g} dB."
    better, worse = (other, first) if difference_db > 0.0 else (first, other)
    low_db, high_db = sorted(np.sign(difference_db) * np.array(bounds_db))
    text = f"Over the field, {better} has a PSNR that is {abs(difference_db):.1f} dB higher than that of {worse}"
    if n_scenes < MIN_SCENES:
        return text + "."
    certainty = "" if low_db > 0.0 else ": not significant"
    return f"{text} (95 % confidence interval over {n_scenes} scenes {low_db:.1f} to {high_db:.1f} dB{certainty})."

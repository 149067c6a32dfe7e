"""Fits of the chain to the levels of a recording, with what differs between pixels so far."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from foveasim._core.validation import Bools, Floats, Ints
from foveasim.twin.fitting.chain import Chain, Spread
from foveasim.twin.fitting.code_widths import fit_code_widths
from foveasim.twin.fitting.defects import Defects
from foveasim.twin.fitting.intervals import HALF_WIDTH, Estimate, Uncertain
from foveasim.twin.fitting.levels import Levels
from foveasim.twin.fitting.pooled import BEND, WELL, Exposures, PooledFit, fit_levels
from foveasim.twin.fitting.recording import Recording
from foveasim.twin.fitting.starts import Start, first_values

__all__ = ["ChainFit", "fit_chain"]

#: Standard error of the nonlinearity up to which it is fitted, and its largest value.
MAX_BEND_ERROR, MAX_BEND = 0.1, 0.3
#: Largest charge, over the full well, with which the fit of a level of unknown light starts, and number of bisections for it.
#: Largest full well over its first value.
ABOVE, N_BISECTIONS, LARGEST = 1.05, 20, 1.4


@dataclass(frozen=True, eq=False)
class ChainFit:
    """
    Fit of the chain to levels.

    ``levels``, ``exposures``: of the levels that are used, ``is_used`` of all. ``start``: first values of the first fit, from
    which its full well was left out: ``well_e``. ``dnl_dn``: of columns. ``bend``: why the nonlinearity is not identifiable,
    if so.
    """

    fit: PooledFit
    levels: Levels
    exposures: Exposures
    is_used: Bools
    start: Start
    well_e: float | None
    dnl_dn: Estimate | Uncertain
    bend: Uncertain | None

    @property
    def values(self) -> Mapping[str, float]:
        """Parameters of the chain."""
        return self.fit.values

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters that were fitted, as start of another fit."""
        return {name: self.fit.values[name] for name in self.fit.names if not name.startswith("level_e_")}


def fit_chain(recording: Recording, defects: Defects, spread: Spread, before: ChainFit | None) -> ChainFit:
    """
    Fit the chain to the levels of all pixels that are no defects.

    The first fit leaves out levels close to the full well, whose noise depends on the responses of pixels.
    """
    levels = Levels.of(recording.statistics, recording.classes, 1.0 - defects.rts_probability)
    errors = np.full(levels.mean_dn.size, np.nan)
    if defects.telegraph is not None:
        levels, errors = _without_telegraph(recording, defects, levels, before)
    exposures = _exposures(recording, levels)
    if before is None:
        start = first_values(levels, exposures, recording.adc, has_dark_series=recording.has_dark_series)
        is_used, light_e, bend = start.is_used & ~start.is_close, start.light_e, None
        dnl_dn = fit_code_widths([recording.statistics[k].counts for k in np.unique(levels.stack[is_used])])
        names = dict(start.values)
        well_e = names.pop(WELL, None)
    else:
        start, is_used, light_e = before.start, before.start.is_used, before.start.light_e.copy()
        names, well_e, dnl_dn, bend = before.parameters, before.well_e, before.dnl_dn, before.bend
        light_e[before.is_used] = before.fit.light_e
    used = np.flatnonzero(is_used)
    dnl_dn2, dnl_error_dn2 = _variance_of(dnl_dn)
    levels = _selected(replace(levels, variances_dn2=levels.variances_dn2 - dnl_dn2), used)
    exposures, light_e = _chosen(exposures, used), light_e[used]
    chain = Chain(recording.known, used.size, spread)
    if before is not None and well_e is not None and WELL not in names:
        names[WELL] = _full_well(chain, levels, exposures, before, light_e)
        light_e = np.where(exposures.is_free, _charges(chain, levels, exposures, names), light_e)

    def fit(names: Mapping[str, float]) -> PooledFit:
        return fit_levels(
            chain, levels, exposures, names, light_e, variance_error_dn2=errors[used], common_error_dn2=dnl_error_dn2
        )

    def result(found: PooledFit) -> ChainFit:
        return ChainFit(found, levels, exposures, is_used, start, well_e, dnl_dn, bend)

    found = fit(names)
    if BEND in names and (found.error(BEND) > MAX_BEND_ERROR or abs(found.values[BEND]) > MAX_BEND):
        bend = Uncertain(
            "the stacks have too few levels of known light: give their exposure times with a constant light, or photons"
        )
        found = fit({name: value for name, value in result(found).parameters.items() if name != BEND})
    return result(found)


def _variance_of(dnl_dn: Estimate | Uncertain) -> tuple[float, float]:
    """Return the variance by DNL, which all levels have, and its standard error, DN²."""
    if isinstance(dnl_dn, Uncertain) or not dnl_dn.low:
        return 0.0, 0.0
    return dnl_dn.value**2, (dnl_dn.high**2 - dnl_dn.low**2) / (2.0 * HALF_WIDTH)


def _full_well(chain: Chain, levels: Levels, exposures: Exposures, before: ChainFit, start_e: Floats) -> float:
    """Return the full well with the mean of the highest level, after a fit without it, e-."""
    from scipy.optimize import brentq

    assert before.well_e is not None
    values = before.values
    guess = before.well_e * before.start.values["gain_dn_per_e"] / values["gain_dn_per_e"]
    highest = int(np.argmax(levels.mean_dn))
    light_e = np.where(exposures.is_free, start_e, exposures.light_e(values))
    if exposures.is_free[highest]:
        light_e[highest] = LARGEST * guess
    dark_e = exposures.dark_e(values)

    def above(well_e: float) -> float:
        moments = chain.moments({**values, WELL: well_e}, light_e, dark_e)
        return float(moments.mean_dn[highest] - levels.mean_dn[highest])

    low, high = 0.7 * guess, LARGEST * guess
    return float(brentq(above, low, high, rtol=1e-6)) if above(low) * above(high) < 0.0 else guess


def _charges(chain: Chain, levels: Levels, exposures: Exposures, values: Mapping[str, float]) -> Floats:
    """
    Return the charges of light with the means of the levels, (n_level,) e-.

    They end a little above the full well. Where some pixels are full, a step of the search could leave the full well, with
    other weights.
    """
    low_e, high_e = np.zeros(levels.mean_dn.size), np.full(levels.mean_dn.size, ABOVE * values[WELL])
    dark_e = exposures.dark_e(values)
    for _ in range(N_BISECTIONS):
        middle_e = 0.5 * (low_e + high_e)
        is_above = chain.moments(values, middle_e, dark_e).mean_dn > levels.mean_dn
        low_e, high_e = np.where(is_above, low_e, middle_e), np.where(is_above, middle_e, high_e)
    return high_e


def _without_telegraph(
    recording: Recording, defects: Defects, levels: Levels, before: ChainFit | None
) -> tuple[Levels, Floats]:
    """
    Return the levels without RTS noise, and the error of the dark variance.

    Pixels have the probability that they are free of RTS noise as weights. The dark variance is that of the mixture.
    """
    assert defects.telegraph is not None
    variances, errors = levels.variances_dn2.copy(), np.full(levels.mean_dn.size, np.nan)
    ratios, p = _slope_ratios(recording, defects, levels, before), defects.rts_probability
    masks = [recording.classes == c for c in range(recording.n_classes)]
    missed = [float(np.sum(p * (1.0 - p), where=own) / np.sum(1.0 - p, where=own)) for own in masks]
    for k, (stack, c) in enumerate(zip(levels.stack.tolist(), levels.class_of_level.tolist(), strict=True)):
        if stack == defects.telegraph_stack:
            variance_dn2 = recording.linear[stack].variance_dn2
            linear_dn2 = float(np.average(variance_dn2, weights=np.where(masks[c], 1.0 - p, 0.0)))
            measured_dn2 = float(levels.column_dn2[k] + variances[k] @ levels.weights)
            variances[k] += (defects.telegraph.noise_dn2 / linear_dn2 - 1.0) * measured_dn2
            errors[k] = defects.telegraph.noise_error_dn2 / linear_dn2 * measured_dn2
        else:
            variances[k] -= missed[c] * 0.25 * (defects.step_dn * ratios[k]) ** 2
    return replace(levels, variances_dn2=variances), errors


def _slope_ratios(recording: Recording, defects: Defects, levels: Levels, before: ChainFit | None) -> Floats:
    """Return slopes of codes by charges over that of the dark level, (n_level,)."""
    adc = recording.adc
    slopes = 1.0 / adc.width_of_code_dn(levels.mean_dn.clip(0.0, adc.n_codes - 1.0))
    if before is not None:
        slopes[before.is_used] = before.fit.slopes_dn_per_e
        slopes[~before.is_used] = 0.0
    return np.asarray(slopes / slopes[levels.stack == defects.telegraph_stack][0])


def _exposures(recording: Recording, levels: Levels) -> Exposures:
    """Return exposure times, light and temperatures of levels."""
    lights, amounts, names = recording.lights, [], []
    for stack, c in zip(levels.stack.tolist(), levels.class_of_level.tolist(), strict=True):
        each = lights[stack]
        suffix = f"_of_class_{c}" if recording.n_classes > 1 else ""
        if each.is_dark:
            amounts.append(0.0)
        elif each.photons is not None:
            amounts.append(each.photons)
        else:
            amounts.append(math.nan if each.light is None else each.light * each.exposure_s)
        names.append(("qe" if each.photons is not None else "light_e_per_s") + suffix)
    temperature = [math.nan if each.temperature_k is None else each.temperature_k for each in lights]
    return Exposures(
        np.array([lights[k].exposure_s for k in levels.stack]), np.array(amounts), tuple(names),
        np.array(temperature)[levels.stack],
    )  # fmt: skip


def _selected(levels: Levels, index: Ints) -> Levels:
    """Return some of the levels."""
    names = (each.name for each in fields(Levels) if each.name != "weights")
    return replace(levels, **{name: getattr(levels, name)[index] for name in names})


def _chosen(exposures: Exposures, index: Ints) -> Exposures:
    return Exposures(
        exposures.exposure_s[index], exposures.light[index], tuple(exposures.light_parameter[k] for k in index),
        exposures.temperature_k[index],
    )  # fmt: skip

"""Checks of effects: draws, moments, noise budget, and parts of a sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from foveasim._core.names import possible_names
from foveasim._core.provenance import to_plain_data
from foveasim._core.random_streams import Streams
from foveasim._core.validation import Floats
from foveasim.errors import ParameterError
from foveasim.layout import grid
from foveasim.sensor import Sensor, noise_budget
from foveasim.sensor.chain import FIXED_STAGES
from foveasim.sensor.effects import EFFECTS, Collection, Effect, Mixing
from foveasim.testing._extension import Extension, check_of, require, shot_with
from foveasim.units import ELEMENTARY_CHARGE_C

#: Standard errors by which sample means may differ.
SIGMAS = 5.0
#: Rows and columns of sites; number of frames (temporal effects) or devices (fixed patterns).
SHAPE, N_DRAWS = (60, 100), 24
N = SHAPE[0] * SHAPE[1]
PHOTO_E, EXPOSURE_S = 5000.0, 0.5
#: Conversion of 1 e- per code, with a pedestal: signals are far from both ends of the range.
V_SAT_V, CODES, PEDESTAL_V = 3.0, 65_536, 0.5
FINE: dict[str, Any] = {
    "bits": 16,
    "v_sat_v": V_SAT_V,
    "capacitance_f": CODES * ELEMENTARY_CHARGE_C / V_SAT_V,
    "pedestal_v": PEDESTAL_V,
    "dark_e_per_s": 4000.0,
    "shot_noise": "off",
}
#: Electrons of one unit of the values of a stage.
E_PER_UNIT = {"photo": EXPOSURE_S, "dark": EXPOSURE_S, "sense_node": CODES / V_SAT_V, "output": CODES / V_SAT_V}


@check_of(EFFECTS)
def check_effect(extension: Extension) -> None:
    """Check an effect of settings files."""
    effect = extension.make()
    require(isinstance(effect, Effect), f"must return an Effect, got {type(effect).__name__}")
    extension.check_dataclass(effect)
    check_sensor_effect(effect.name, {"effects": [effect]})

    sensor = _sensor({"effects": [effect]})
    again = Sensor.from_settings(sensor.layout, to_plain_data(sensor))
    require(np.array_equal(_codes(again), _codes(sensor)), "must be restored from the settings of a capture")
    shot = shot_with("sensor", {"effects": [extension.settings]})
    require(to_plain_data(shot.camera.sensor.effects) == to_plain_data([effect]), "differs in settings files")


def check_sensor_effect(name: str, keywords: Mapping[str, Any]) -> None:
    """
    Check the effect that keywords of a sensor enable.

    Parameters
    ----------
    name : str
        Name of the effect.
    keywords : mapping
        Keywords of :class:`foveasim.Sensor`.

    Raises
    ------
    AssertionError
        When draws, moments, prediction or noise budget disagree, when the effect is not that of its device or frame, or
        differs in a part of the sensor.
    ParameterError
        When the keywords do not enable the effect.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.testing.check_sensor_effect(
    ...     "read", {"read_noise_e": 3.0}
    ... )  # AssertionError for a difference
    """
    sensor = _sensor(keywords)
    names = [found.name for found in sensor.chain]
    if name not in names:
        raise ParameterError("name", "must be an effect of the sensor", name, hint=possible_names(name, names))
    effect = sensor.chain[names.index(name)]
    _check_reproducible(sensor, effect)
    _check_affine(sensor, effect)
    if isinstance(effect, Collection):
        _check_collection(sensor, effect)
    _check_prediction(sensor, effect)
    if effect.reach != "all":
        _check_moments(sensor, effect)
        _check_part(sensor, effect)
    if isinstance(effect, Mixing):
        _check_mixing(sensor, effect)
    quiet, both = (_sensor({**each, "read_noise_e": 7.0}) for each in ({}, keywords))
    if name != "read" and not isinstance(effect, Collection):
        require(
            np.array_equal(_codes(both.without(name)), _codes(quiet)), "changes other draws when it is switched off"
        )


def _sensor(keywords: Mapping[str, Any]) -> Sensor:
    """Return a sensor of squares, each with its own readout line."""
    layout = grid(n_x=SHAPE[1], n_y=SHAPE[0], pitch_um=2.0).with_columns(readout_line=np.arange(N))
    has_collection = any(isinstance(effect, Collection) for effect in keywords.get("effects", ()))
    return Sensor(layout, **{**FINE, **({"shot_noise": "auto"} if has_collection else {}), **keywords})


def _expected_e(sensor: Sensor) -> Floats:
    return sensor.expected_electrons(np.full(sensor.layout.n_sites, PHOTO_E / EXPOSURE_S), EXPOSURE_S)


def _codes(sensor: Sensor, frame: int = 0) -> Floats:
    """Return the codes of a frame."""
    electrons = sensor.collect(_expected_e(sensor), seed=1, frame=frame, exposure_s=EXPOSURE_S)
    return sensor.read(electrons, seed=1, frame=frame).astype(np.float64)


def _check_reproducible(sensor: Sensor, effect: Effect) -> None:
    first = _codes(sensor)
    require(
        np.array_equal(first, _codes(sensor)), "must draw the same numbers for the same seed; use rng or sites.device"
    )
    is_redrawn = not np.array_equal(first, _codes(sensor, 1))
    if effect.is_temporal:
        require(is_redrawn, "is temporal, but two frames are the same; draw from rng, or set is_temporal = False")
        return
    require(not is_redrawn, "is not temporal, but two frames differ; draw from sites.device, or set is_temporal = True")
    _, variance = effect.moments(np.full(N, PHOTO_E), np.zeros(N), sites=sensor.sites.without_device())
    differs = not np.array_equal(first, _codes(replace(sensor, device_seed=sensor.device_seed + 1)))
    is_random = bool(np.any(np.asarray(variance) > 0.0))
    require(
        differs == is_random,
        f"has {'a' if is_random else 'no'} variance over devices, but two devices {'differ' if differs else 'are the same'}; "
        "draw from sites.device, and define pattern_moments()",
    )


def _check_prediction(sensor: Sensor, effect: Effect) -> None:
    """Compare codes with the analytical moments of this device, or of several."""
    n = N_DRAWS if effect.is_temporal else 2
    sensors = [sensor] * n if effect.is_temporal else [replace(sensor, device_seed=k) for k in range(n)]
    moments = [
        each.predict(_expected_e(each), exposure_s=EXPOSURE_S) for each in sensors[: n if not effect.is_temporal else 1]
    ]
    mean_dn, variance_dn2 = (np.stack([found[k] for found in moments]) for k in range(2))
    codes = np.stack([_codes(each, frame) for frame, each in enumerate(sensors)])
    some = np.broadcast_to(variance_dn2 > 0.0, codes.shape)
    require(
        np.abs(codes - mean_dn)[~some].max(initial=0.0) <= 1.0,
        "has codes that differ from the mean of predict() where the variance is 0; compare apply() with moments()",
    )
    if effect.is_temporal:
        require(some.any(), "is temporal, but predict() has a variance of 0; check moments()")
        _compare(codes, mean_dn, variance_dn2, "predict()")


def _check_moments(sensor: Sensor, effect: Effect) -> None:
    """Compare draws and noise budget with the moments, of all devices for fixed patterns."""
    dark_e = float(np.mean(sensor.nominal_dark_e_per_s)) * EXPOSURE_S
    unit = 1.0 / E_PER_UNIT.get(effect.stage, 1.0)
    nominal = {"photo": PHOTO_E, "dark": dark_e}.get(effect.stage, PHOTO_E + dark_e) * unit
    nominal += PEDESTAL_V if effect.stage == "output" else 0.0
    sites = sensor.sites.during(EXPOSURE_S) if effect.is_temporal else sensor.sites.without_device()
    mean, variance = effect.validate_moments(np.full(N, nominal), np.zeros(N), sites)
    shift_e, variance_e2 = (np.broadcast_to(part, N) for part in ((mean - nominal) / unit, variance / unit**2))

    budget = noise_budget(sensor, np.full(N, PHOTO_E / EXPOSURE_S), EXPOSURE_S)
    lines = ("photon_shot", "dark_shot") if isinstance(effect, Collection) else (effect.name,)
    line_e = np.sqrt(sum(budget[line] ** 2 for line in lines))
    require(
        np.allclose(line_e, np.sqrt(variance_e2), rtol=1e-6, atol=1e-9),
        "has another standard deviation in the noise budget than in its moments()",
    )
    if not effect.is_temporal:
        quiet = np.mean(_codes(sensor.without(effect.name)))
        drawn = np.stack([_codes(replace(sensor, device_seed=k)) for k in range(N_DRAWS)]) - quiet
        _compare(drawn, shift_e, variance_e2, "moments() over devices")


def _check_affine(sensor: Sensor, effect: Effect) -> None:
    """Compare the means of effects before collection at three levels."""
    if effect.stage in FIXED_STAGES:
        low, centre, high = (
            effect.validate_moments(np.full(N, k * PHOTO_E), np.zeros(1), sensor.sites)[0] for k in range(3)
        )
        require(
            np.allclose(high - centre, centre - low, rtol=1e-9, atol=1e-9 * PHOTO_E),
            "is not affine in the light, as effects before collection must be; use a Collection, or the stage 'charge'",
        )


def _check_mixing(sensor: Sensor, effect: Mixing) -> None:
    """Compare draws, operator and its transpose."""
    values, other = (Streams(k).of(effect.name).random(N) for k in range(2))
    operator = effect.operator(sensor.sites)
    mixed = effect.apply(values.copy(), sites=sensor.sites, rng=Streams(0).of(effect.name))
    require(np.allclose(mixed, operator.apply(values)), "has another apply() than its operator()")
    one, two = other @ operator.apply(values), operator.transpose().apply(other) @ values
    require(np.isclose(one, two), "has an operator whose transpose() is wrong")


def _check_collection(sensor: Sensor, effect: Collection) -> None:
    """Compare draws and cumulative probabilities with the moments, from 0 e-."""
    sites = sensor.sites.during(EXPOSURE_S)
    mean = np.geomspace(0.01, 2.0 * PHOTO_E, N)
    mean[0] = 0.0
    centre_e, variance_e2 = effect.validate_moments(mean, np.zeros(1), sites)
    first, probability, offsets = effect.table(mean, sites=sites)
    site = np.repeat(np.arange(N), np.diff(offsets))
    off = first[site] + np.arange(probability.size) - offsets[site] - centre_e[site]
    total, bias, spread2 = (np.bincount(site, probability * power, N) for power in (np.ones(off.size), off, off**2))
    for found, expected, what in (
        (total, 1.0, "sum"),
        (centre_e + bias, centre_e, "mean"),
        (spread2, variance_e2, "variance"),
    ):
        require(
            np.allclose(found, expected, rtol=1e-6, atol=1e-9),
            f"has a cumulative() whose {what} differs from {1 if what == 'sum' else 'that of its moments()'}",
        )
    streams = Streams(2)
    drawn = np.stack([effect.apply(mean.copy(), sites=sites, rng=streams.of(effect.name, k)) for k in range(N_DRAWS)])
    require(np.all((drawn >= 0.0) & (drawn == np.rint(drawn))), "must draw integers of at least 0")
    some = (variance_e2 > 1.0) | (centre_e == 0.0)  # enough draws of each site
    _compare(drawn[:, some], centre_e[some], np.broadcast_to(variance_e2, N)[some], "moments()")


def _compare(values: Floats, mean: Floats, variance: Floats, of: str) -> None:
    """Compare draws (n_draw, n_site) with moments; sites may be correlated."""
    some = np.broadcast_to(np.atleast_2d(variance) > 0.0, values.shape).all(axis=0)
    if not some.any():
        return
    mean, variance = (np.broadcast_to(part, values.shape)[:, some] for part in (mean, variance))
    z = (values[:, some] - mean) / np.sqrt(variance)
    rounding = 0.25 / variance.min()
    for measured, expected, rounded, what in (
        (z, 0.0, 0.1 * np.sqrt(rounding), "mean"),
        (z**2, 1.0, rounding, "variance"),
    ):
        of_draws = measured.mean(axis=1)
        error = abs(of_draws.mean() - expected)
        limit = SIGMAS * of_draws.std(ddof=1) / np.sqrt(of_draws.size) + rounded
        size = f"{error:.2g} standard deviations" if what == "mean" else f"{error:.2%}"
        require(
            error <= limit,
            f"has draws whose {what} differs by {size} from that of {of}, more than {SIGMAS:g} standard errors",
        )


def _check_part(sensor: Sensor, effect: Effect) -> None:
    """Compare sites alone, and a block of sites, with the complete sensor."""
    hint = "use sites.select() and sites.pattern(), or derive from Mixing"
    chosen = slice(N // 3, N // 2)
    sites, mean = sensor.sites.during(EXPOSURE_S), np.linspace(0.5, 2.0, N)
    complete = effect.validate_moments(mean, 0.1 * mean, sites)
    alone = effect.validate_moments(mean[chosen], 0.1 * mean[chosen], sites.block(chosen))
    for one, other in zip(complete, alone, strict=True):
        require(np.array_equal(np.broadcast_to(one, N)[chosen], np.broadcast_to(other, mean[chosen].shape)),
                f"has other moments() in a block of sites; {hint}")  # fmt: skip
    part = sensor.part(chosen)
    expected = (
        "has another effect in a part of the sensor, such as a tile; use sites.device, or set needs_layout = True"
    )
    require(np.array_equal(_expected_e(part), _expected_e(sensor)[chosen]), expected)
    predicted = (each.predict(_expected_e(each), exposure_s=EXPOSURE_S) for each in (sensor, part))
    for one, other in zip(*predicted, strict=True):
        require(np.array_equal(one[chosen], other), expected)
    if not effect.is_temporal or effect.reach == "group":
        require(np.array_equal(_codes(sensor)[chosen], _codes(part)), expected)

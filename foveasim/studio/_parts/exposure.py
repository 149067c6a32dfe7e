"""Charts over signal and exposure: photon transfer and signal-to-noise ratio of photosites, analytically."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats
from foveasim.sensor import NoiseBudget, Sensor, noise_budget
from foveasim.sensor.signal_to_noise import local_step_e, signal_to_noise
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, capture_of, curves_of, part

__all__ = ["photon_transfer", "snr"]

#: Number of levels of a curve.
N_LEVELS = 129
#: Lowest signal, e-; highest relative to the full range of a photosite.
LOWEST_E, HIGHEST = 0.1, 4.0
#: Lowest ratio in the chart, dB.
LOWEST_DB = -10.0
#: Lowest temporal noise in the chart, relative to that below saturation.
FLOOR = 0.3
#: Temporal entry of the noise budget with its own curve.
PHOTON_SHOT = "photon_shot"


@part("Photon transfer", capture_of)
def photon_transfer(result: Simulated) -> PartData:
    """Return noise against mean signal of the photosite of median charge, for the exposure time of the capture."""
    sensor, capture, exposure_s = result.shot.camera.sensor, result.capture, result.shot.exposure_s
    if exposure_s == 0.0:
        return curves_of([], [], [])
    site = _median_site(capture.expected_e)
    copies = _copies(sensor, site, N_LEVELS)
    level_e = np.geomspace(LOWEST_E, HIGHEST * _range_e(copies), N_LEVELS)
    sensitivity = float(np.broadcast_to(copies.sensitivity, N_LEVELS)[0]) or 1.0
    photo_e_per_s = level_e / (exposure_s * sensitivity)
    charge_e = copies.expected_electrons(photo_e_per_s, exposure_s)
    dark_e = copies.expected_electrons(np.zeros(N_LEVELS), exposure_s)
    mean_dn, variance_dn2 = copies.predict(charge_e)
    dark_dn = copies.predict(dark_e)[0]
    is_saturated = signal_to_noise(copies, charge_e, dark_e).is_saturated
    budget = noise_budget(copies, photo_e_per_s, exposure_s)
    dn_per_e = 1.0 / local_step_e(copies, charge_e, copies.v_per_e, np.full(1, copies.pedestal_v))
    others = [name for name in budget.temporal if name != PHOTON_SHOT]
    fixed = [name for name in budget if name not in budget.temporal]
    noise_dn = np.sqrt(variance_dn2)
    # Clipped noise approaches 0: lower values than the noise floor are not shown.
    floor_dn = FLOOR * float(noise_dn[~is_saturated].min(initial=np.inf))
    shown = {
        "temporal noise": np.where(noise_dn >= min(floor_dn, float(noise_dn.max())), noise_dn, np.nan),
        "photon shot": np.where(is_saturated, np.nan, budget[PHOTON_SHOT] * dn_per_e),
        "dark and read": np.where(is_saturated, np.nan, _root_sum_of_squares(budget, others) * dn_per_e),
        "fixed pattern": np.where(is_saturated, np.nan, _root_sum_of_squares(budget, fixed) * dn_per_e),
    }
    signal_dn = mean_dn - dark_dn
    is_positive = signal_dn > 0.0
    shown = {name: _positive(values)[is_positive] for name, values in shown.items() if np.nanmax(values) > 0.0}
    curves = [{"label": name, "unit_x": "DN", "unit_y": "DN"} for name in shown]
    about, arrays = curves_of(curves, [signal_dn[is_positive]] * len(curves), list(shown.values()))
    now = _copies(sensor, site, 1)
    now_dn, now_dn2 = now.predict(capture.expected_e[[site]])
    at = float(now_dn[0] - dark_dn[0]), float(np.sqrt(now_dn2[0]))
    about["marks"] = [{"x": at[0], "y": at[1]}] if min(at) > 0.0 else []
    gain, is_over = float(dn_per_e[0]), at[1] <= 0.0 < at[0]
    about["note"] = (
        f"Photosite {site:,} (median signal), {gain:.3g} DN/e⁻, full range {_range_e(copies):,.0f} e⁻"
        f"{'; now saturated' if is_over else ''}"
    )
    return about, arrays


@part("SNR", capture_of)
def snr(result: Simulated) -> PartData:
    """Return the signal-to-noise ratio against exposure of the photosite of median charge of each filter."""
    sensor, capture, exposure_s = result.shot.camera.sensor, result.capture, result.shot.exposure_s
    curves: list[dict[str, Any]] = []
    x: list[NDArray[Any]] = []
    y: list[NDArray[Any]] = []
    marks: list[dict[str, Any]] = []
    ranges = []
    for k in np.unique(capture.filter_of_site) if exposure_s > 0.0 else ():
        name = capture.filter_names[k]
        sites = np.flatnonzero(capture.filter_of_site == k)
        site = int(sites[_median_site(capture.expected_e[sites])])
        charge_e_per_s = float(capture.expected_e[site]) / exposure_s
        dark_e_per_s = float(_copies(sensor, site, 1).expected_electrons(np.zeros(1), exposure_s)[0]) / exposure_s
        if charge_e_per_s <= dark_e_per_s:
            continue
        curve = _SnrCurve(sensor, site, charge_e_per_s, dark_e_per_s)
        # Ratios above saturation are those at saturation: the curve ends there.
        is_shown = (curve.ratio_db >= LOWEST_DB) & (curve.exposure_s <= curve.saturation_s)
        curves.append({"label": name, "name": name, "unit_x": "s", "unit_y": "dB"})
        x.append(np.append(curve.exposure_s[is_shown], curve.saturation_s))
        y.append(np.append(curve.ratio_db[is_shown], curve.saturation_db))
        marks.append({"x": curve.saturation_s, "y": curve.saturation_db, "name": name, "kind": "end"})
        now = min(exposure_s, curve.saturation_s)
        marks.append({"x": exposure_s, "y": float(curve.at(np.array([now]))[0]), "name": name})
        ranges.append((name, curve.dynamic_range_db))
    about, arrays = curves_of(curves, x, y)
    about["marks"] = [mark for mark in marks if mark["y"] >= LOWEST_DB]
    shown = ", ".join(
        f"{name} {range_db:.1f} dB" if len(ranges) > 1 else f"{range_db:.1f} dB" for name, range_db in ranges
    )
    about["note"] = f"Dynamic range {shown}; bars: saturation" if ranges else "No photoelectrons"
    about["dynamic_range_db"] = dict(ranges)
    return about, arrays


class _SnrCurve:
    """
    Signal-to-noise ratio of a photosite against exposure.

    Parameters
    ----------
    sensor : Sensor
    site : int
    charge_e_per_s, dark_e_per_s : float, e-/s
        Rates of the complete charge and of the dark signal.

    Attributes
    ----------
    exposure_s : (n,) float64, s
    ratio_db : (n,) float64, dB
    saturation_s, saturation_db : float
        Exposure from which noise is clipped, and the ratio there.
    dynamic_range_db : float, dB
        Signal at saturation over that of the ratio 1.
    """

    def __init__(self, sensor: Sensor, site: int, charge_e_per_s: float, dark_e_per_s: float) -> None:
        self._copies = _copies(sensor, site, N_LEVELS)
        self._charge_e_per_s, self._dark_e_per_s = charge_e_per_s, dark_e_per_s
        photo_e_per_s = charge_e_per_s - dark_e_per_s
        highest_s = HIGHEST * _range_e(self._copies) / charge_e_per_s
        self.exposure_s = np.geomspace(min(LOWEST_E / photo_e_per_s, 1e-3 * highest_s), highest_s, N_LEVELS)
        found = self._signals(self.exposure_s)
        self.ratio_db = _decibels(found.ratio)
        self.saturation_s = float(self.exposure_s[-1])
        if found.is_saturated.any():
            first = max(int(np.argmax(found.is_saturated)), 1)
            finer_s = np.linspace(self.exposure_s[first - 1], self.exposure_s[first], N_LEVELS)
            self.saturation_s = float(finer_s[int(np.argmax(self._signals(finer_s).is_saturated))])
        self.saturation_db = float(self.at(np.array([self.saturation_s]))[0])
        is_below = self.exposure_s < self.saturation_s
        threshold_s = np.exp(np.interp(0.0, self.ratio_db[is_below], np.log(self.exposure_s[is_below])))
        self.dynamic_range_db = float(_decibels(np.array([self.saturation_s / threshold_s]))[0])

    def _signals(self, exposure_s: Floats) -> Any:
        """Return signals and noise at N_LEVELS exposures."""
        return signal_to_noise(self._copies, self._charge_e_per_s * exposure_s, self._dark_e_per_s * exposure_s)

    def at(self, exposure_s: Floats) -> Floats:
        """Return the ratio at an exposure, (1,) dB."""
        return _decibels(self._signals(np.full(N_LEVELS, exposure_s[0])).ratio[:1])


def _median_site(values: Floats) -> int:
    """Return the index of the median; with an even number of values, the larger of both."""
    middle = values.size // 2
    return int(np.argpartition(values, middle)[middle])


def _copies(sensor: Sensor, site: int, n: int) -> Sensor:
    """Return a sensor of n copies of a photosite, without exchange of charge: each level of a curve is a site."""
    connecting = [effect.name for effect in sensor.chain if not effect.is_local]
    one = (sensor.without(*connecting) if connecting else sensor).part(site, site + 1)
    values = {each.name: getattr(one, each.name) for each in fields(one)}
    single = {name: float(v[0]) for name, v in values.items() if isinstance(v, np.ndarray) and v.shape == (1,)}
    return replace(one, layout=one.layout[np.zeros(n, np.int64)], **single)


def _range_e(sensor: Sensor) -> float:
    """Return the charge of full well or highest code, whichever is smaller, e-."""
    top_e = (sensor.v_sat_v - sensor.pedestal_v) / sensor.v_per_e
    return float(np.minimum(np.broadcast_to(top_e, sensor.layout.n_sites), sensor.well_e)[0])


def _root_sum_of_squares(budget: NoiseBudget, names: list[str]) -> Floats:
    return np.sqrt(sum((np.square(budget[name]) for name in names), np.zeros(N_LEVELS)))


def _positive(values: Floats) -> Floats:
    """Return values with NaN for those that a logarithmic axis cannot show."""
    return np.where(values > 0.0, values, np.nan)


def _decibels(ratio: Floats) -> Floats:
    """Return ratios of amplitudes in dB; -200 dB for 0."""
    return 20.0 * np.log10(np.maximum(ratio, 1e-10))

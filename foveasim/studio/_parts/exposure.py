"""Charts over signal and exposure: photon transfer and SNR of photosites."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Floats
from foveasim.sensor import NoiseBudget, Sensor, noise_budget
from foveasim.sensor.signal_to_noise import signal_to_noise
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, capture_of, curves_of, part

__all__ = ["photon_transfer", "snr"]

#: Number of levels of a curve.
N_LEVELS = 129
#: Lowest signal, e-; highest relative to the full range of a photosite.
LOWEST_E, HIGHEST = 0.1, 4.0
#: Lowest ratio in the chart, dB.
LOWEST_DB = -10.0
#: Temporal entries of the noise budget with their own curves.
SEPARATE = PHOTON_SHOT, QUANTISATION = "photon_shot", "quantisation"


@part("Photon transfer", capture_of)
def photon_transfer(result: Simulated) -> PartData:
    """Return noise against signal of the photosite of median charge."""
    sensor, capture, exposure_s = result.shot.camera.sensor, result.capture, result.shot.exposure_s
    if exposure_s == 0.0:
        return curves_of([], [], [])
    site = _median_site(capture.expected_e)
    copies = _copies(sensor, site, N_LEVELS)
    range_e = _range_e(copies)
    sensitivity = float(np.broadcast_to(copies.sensitivity, N_LEVELS)[0]) or 1.0
    photo_e_per_s = np.geomspace(LOWEST_E, HIGHEST * range_e, N_LEVELS) / (exposure_s * sensitivity)
    dark_e = copies.expected_electrons(np.zeros(N_LEVELS), exposure_s)
    found = signal_to_noise(copies, copies.expected_electrons(photo_e_per_s, exposure_s), dark_e)
    budget = noise_budget(copies, photo_e_per_s, exposure_s)
    fixed = [name for name in budget if name not in budget.temporal]
    shown = {
        "temporal noise": found.noise_e,
        "photon shot": budget[PHOTON_SHOT],
        "dark and read": _root_sum_of_squares(budget, [name for name in budget.temporal if name not in SEPARATE]),
        "quantisation": budget[QUANTISATION],
        "fixed pattern": _root_sum_of_squares(budget, fixed),
    }
    # Above saturation, signal and noise are those at saturation.
    is_shown = ~found.is_saturated & (found.signal_e > 0.0)
    shown = {name: values[is_shown] for name, values in shown.items() if (values[is_shown] > 0.0).all()}
    curves = [{"label": name, "unit_x": "e⁻", "unit_y": "e⁻"} for name in shown]
    about, arrays = curves_of(curves, [found.signal_e[is_shown]] * len(curves), list(shown.values()))
    now = signal_to_noise(_copies(sensor, site, 1), capture.expected_e[[site]], dark_e[:1])
    x, y = float(now.signal_e[0]), float(now.noise_e[0])
    about["marks"] = [{"x": x, "y": y}] if min(x, y) > 0.0 and curves else []
    about["note"] = (
        f"Photosite {site:,}, {float(now.gain_dn_per_e.flat[0]):.3g} DN/e⁻, full range {range_e:,.0f} e⁻"
        f"{'; now saturated' if now.is_saturated[0] else ''}"
    )
    return about, arrays


@part("SNR", capture_of)
def snr(result: Simulated) -> PartData:
    """Return the SNR against exposure of the median photosite of each filter."""
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
    shown = ", ".join(f"{name} {range_db:.1f}" if len(ranges) > 1 else f"{range_db:.1f}" for name, range_db in ranges)
    about["note"] = f"Dynamic range / dB: {shown}" if ranges else "No photoelectrons"
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
    """Return a sensor of n copies of a photosite, without exchange of charge."""
    connecting = [effect.name for effect in sensor.chain if not effect.is_local]
    return (sensor.without(*connecting) if connecting else sensor).part(np.full(n, site))


def _range_e(sensor: Sensor) -> float:
    """Return the charge of full well or highest code, whichever is smaller, e-."""
    top_e = (sensor.v_sat_v - sensor.pedestal_v) / sensor.v_per_e
    return float(np.minimum(np.broadcast_to(top_e, sensor.layout.n_sites), sensor.well_e)[0])


def _root_sum_of_squares(budget: NoiseBudget, names: list[str]) -> Floats:
    return np.sqrt(sum((np.square(budget[name]) for name in names), np.zeros(N_LEVELS)))


def _decibels(ratio: Floats) -> Floats:
    """Return ratios of amplitudes in dB; -200 dB for 0."""
    return 20.0 * np.log10(np.maximum(ratio, 1e-10))

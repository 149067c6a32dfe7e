"""Signal-to-noise ratio against exposure."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from foveasim._core.validation import Bools, Floats
from foveasim.sensor import Sensor
from foveasim.sensor.signal_to_noise import signal_to_noise
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.photon_transfer import HIGHEST, LOWEST_E, N_LEVELS, copies_of, full_range_e, median_site
from foveasim.studio._parts.registry import PartData, curves_of, label_of, part, pinned_of, saturation_of

#: Lowest ratio in the chart, dB.
LOWEST_DB = -10.0


@part("SNR", pinned_of, order=70, group="Measure", is_wide=True)
def snr(result: Simulated) -> PartData:
    """Return the SNR against exposure of pinned photosites, or the median one of each filter."""
    sensor, capture, exposure_s = result.shot.camera.sensor, result.capture, result.shot.exposure_s
    curves: list[dict[str, Any]] = []
    x: list[NDArray[Any]] = []
    y: list[NDArray[Any]] = []
    marks: list[dict[str, Any]] = []
    ranges = []
    for name, site in _chosen(result) if exposure_s > 0.0 else ():
        charge_e_per_s = float(capture.expected_e[site]) / exposure_s
        dark_e_per_s = float(copies_of(sensor, site, 1).expected_electrons(np.zeros(1), exposure_s)[0]) / exposure_s
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
    about["note"] += saturation_of(result)
    about["dynamic_range_db"] = dict(ranges)
    return about, arrays


def _chosen(result: Simulated) -> list[tuple[str, int]]:
    """Return photosites with the names of their curves."""
    if result.pinned:
        return [(label_of(site), site) for site in result.pinned]
    capture, found = result.capture, []
    for k in np.unique(capture.filter_of_site):
        sites = np.flatnonzero(capture.filter_of_site == k)
        found.append((capture.filter_names[k], int(sites[median_site(capture.expected_e[sites])])))
    return found


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
        self._copies = copies_of(sensor, site, N_LEVELS)
        self._charge_e_per_s, self._dark_e_per_s = charge_e_per_s, dark_e_per_s
        photo_e_per_s = charge_e_per_s - dark_e_per_s
        highest_s = HIGHEST * full_range_e(self._copies) / charge_e_per_s
        self.exposure_s = np.geomspace(min(LOWEST_E / photo_e_per_s, 1e-3 * highest_s), highest_s, N_LEVELS)
        ratio, is_saturated = self._signals(self.exposure_s)
        self.ratio_db = _decibels(ratio)
        self.saturation_s = float(self.exposure_s[-1])
        if is_saturated.any():
            first = max(int(np.argmax(is_saturated)), 1)
            finer_s = np.linspace(self.exposure_s[first - 1], self.exposure_s[first], N_LEVELS)
            self.saturation_s = float(finer_s[int(np.argmax(self._signals(finer_s)[1]))])
        self.saturation_db = float(self.at(np.array([self.saturation_s]))[0])
        is_below = self.exposure_s < self.saturation_s
        threshold_s = np.exp(np.interp(0.0, self.ratio_db[is_below], np.log(self.exposure_s[is_below])))
        self.dynamic_range_db = float(_decibels(np.array([self.saturation_s / threshold_s]))[0])

    def _signals(self, exposure_s: Floats) -> tuple[Floats, Bools]:
        """Return the ratio at N_LEVELS exposures, and whether the photosite is saturated."""
        charge_e, dark_e = self._charge_e_per_s * exposure_s, self._dark_e_per_s * exposure_s
        if not self._copies.collection.needs_exposure:
            found = signal_to_noise(self._copies, charge_e, dark_e)
            return found.ratio, found.is_saturated
        single = self._copies.part(slice(0, 1))
        each = [
            signal_to_noise(single, charge_e[[k]], dark_e[[k]], exposure_s=float(time_s))
            for k, time_s in enumerate(exposure_s)
        ]
        return np.concatenate([one.ratio for one in each]), np.concatenate([one.is_saturated for one in each])

    def at(self, exposure_s: Floats) -> Floats:
        """Return the ratio at an exposure, (1,) dB."""
        return _decibels(self._signals(np.full(N_LEVELS, exposure_s[0]))[0][:1])


def _decibels(ratio: Floats) -> Floats:
    """Return ratios of amplitudes in dB; -200 dB for 0."""
    return 20.0 * np.log10(np.maximum(ratio, 1e-10))

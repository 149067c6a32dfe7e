"""Photon transfer: noise against signal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from foveasim._core.quantities import format_quantity
from foveasim._core.validation import Floats
from foveasim.sensor import NoiseBudget, Sensor, noise_budget
from foveasim.sensor.signal_to_noise import SiteSignals, signal_to_noise
from foveasim.studio._engine import Simulated
from foveasim.studio._parts.registry import PartData, curves_of, label_of, part, pinned_of, saturation_of

#: Number of levels of a curve.
N_LEVELS = 129
#: Lowest signal, e-; highest relative to the full range of a photosite.
LOWEST_E, HIGHEST = 0.1, 4.0
#: Temporal entries of the noise budget with their own curves.
SEPARATE = PHOTON_SHOT, QUANTISATION = "photon_shot", "quantisation"


@part("Photon transfer", pinned_of, order=60, group="Measure")
def photon_transfer(result: Simulated) -> PartData:
    """Return noise against signal of the photosite of median charge."""
    sensor, capture, exposure_s = result.shot.camera.sensor, result.capture, result.shot.exposure_s
    if exposure_s == 0.0:
        return curves_of([], [], [])
    if result.pinned:
        return _pinned_curves(result)
    site = median_site(capture.expected_e)
    copies, photo_e_per_s, dark_e, found = _levels(result, site)
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
    curves = [{"label": name, "unit_x": "e-", "unit_y": "e-"} for name in shown]
    about, arrays = curves_of(curves, [found.signal_e[is_shown]] * len(curves), list(shown.values()))
    now = signal_to_noise(copies_of(sensor, site, 1), capture.expected_e[[site]], dark_e[:1], exposure_s=exposure_s)
    x, y = float(now.signal_e[0]), float(now.noise_e[0])
    about["marks"] = [{"x": x, "y": y}] if min(x, y) > 0.0 and curves else []
    about["note"] = (
        f"Photosite {site:,}, {format_quantity(float(now.gain_dn_per_e.flat[0]), 'DN/e-', digits=3)}, "
        f"full range {format_quantity(full_range_e(copies), 'e-')}"
        f"{'; now saturated' if now.is_saturated[0] else ''}{saturation_of(result)}"
    )
    return about, arrays


def _levels(result: Simulated, site: int) -> tuple[Sensor, Floats, Floats, SiteSignals]:
    """Return copies of a photosite, photoelectron rates, dark signals and signals."""
    exposure_s = result.shot.exposure_s
    copies = copies_of(result.shot.camera.sensor, site, N_LEVELS)
    response = float(copies.light_response()[0]) or 1.0
    photo_e_per_s = np.geomspace(LOWEST_E, HIGHEST * full_range_e(copies), N_LEVELS) / (exposure_s * response)
    dark_e = copies.expected_electrons(np.zeros(N_LEVELS), exposure_s)
    levels_e = copies.expected_electrons(photo_e_per_s, exposure_s)
    return copies, photo_e_per_s, dark_e, signal_to_noise(copies, levels_e, dark_e, exposure_s=exposure_s)


def _pinned_curves(result: Simulated) -> PartData:
    """Return the temporal noise against the signal of each pinned photosite."""
    capture, exposure_s = result.capture, result.shot.exposure_s
    x, y, marks, notes = [], [], [], []
    for site in result.pinned:
        copies, _, dark_e, found = _levels(result, site)
        is_shown = ~found.is_saturated & (found.signal_e > 0.0) & (found.noise_e > 0.0)
        x.append(found.signal_e[is_shown])
        y.append(found.noise_e[is_shown])
        now = signal_to_noise(copies.part(slice(0, 1)), capture.expected_e[[site]], dark_e[:1], exposure_s=exposure_s)
        if min(float(now.signal_e[0]), float(now.noise_e[0])) > 0.0:
            marks.append({"x": float(now.signal_e[0]), "y": float(now.noise_e[0]), "name": label_of(site)})
        notes.append(f"{site:,}: full range {format_quantity(full_range_e(copies), 'e-')}")
    labels = [label_of(site) for site in result.pinned]
    about, arrays = curves_of([{"label": n, "name": n, "unit_x": "e-", "unit_y": "e-"} for n in labels], x, y)
    return about | {"marks": marks, "note": "; ".join(notes) + saturation_of(result)}, arrays


def _root_sum_of_squares(budget: NoiseBudget, names: list[str]) -> Floats:
    return np.sqrt(sum((np.square(budget[name]) for name in names), np.zeros(N_LEVELS)))


def median_site(values: Floats) -> int:
    """Return the index of the median; with an even number of values, the larger of both."""
    middle = values.size // 2
    return int(np.argpartition(values, middle)[middle])


def copies_of(sensor: Sensor, site: int, n: int) -> Sensor:
    """Return a sensor of n copies of a photosite, without exchange of charge or light."""
    sensor = replace(sensor, pixel_optics=None)
    connecting = [effect.name for effect in sensor.chain if effect.reach == "all"]
    return (sensor.without(*connecting) if connecting else sensor).part(np.full(n, site))


def full_range_e(sensor: Sensor) -> float:
    """Return the charge of full well or highest code, whichever is smaller, e-."""
    return float(sensor.linearise(0.0, exposure_s=1.0).saturation_e[0])

"""Noise budget: contribution of each effect to temporal noise and non-uniformity, in e-."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np

from foveasim._core.show import Drawn, drawn
from foveasim._core.validation import Floats, as_numbers, check_per_site
from foveasim.sensor.effects import STANDARD
from foveasim.sensor.limits import EXPOSURE
from foveasim.sensor.prediction import apply_nonlinearity
from foveasim.sensor.sensor import Sensor
from foveasim.sensor.signal_to_noise import local_step_e

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["FIXED", "TEMPORAL", "NoiseBudget", "noise_budget"]

#: Standard entries of the budget: temporal noise and fixed patterns.
TEMPORAL = (
    "photon_shot",
    "dark_shot",
    *(effect.name for effect in STANDARD if effect.is_temporal),
    "quantisation",
)
FIXED = tuple(effect.name for effect in STANDARD if not effect.is_temporal)


class NoiseBudget(dict[str, Floats]):
    """
    Standard deviation of each site's charge by effect, a dict of (n_site,) arrays in e-.

    Attributes
    ----------
    temporal : tuple of str
        Names of the temporal effects; the others are fixed patterns.
    """

    def __init__(self, noise_e: Mapping[str, Floats], temporal: Sequence[str]) -> None:
        super().__init__(noise_e)
        self.temporal: tuple[str, ...] = tuple(temporal)

    def __reduce__(self) -> tuple[Any, ...]:
        return NoiseBudget, (dict(self), self.temporal)

    def __repr__(self) -> str:
        total_e = {row["effect"]: row["rms_e"] for row in self.records()}
        n_sites = next((values.size for values in self.values()), 0)
        return (
            f"NoiseBudget({n_sites:,} sites, temporal noise {total_e['all temporal']:.4g} e-, "
            f"fixed patterns {total_e['all fixed']:.4g} e-)"
        )

    def __str__(self) -> str:
        return "\n".join(f"{row['effect']:>16}: {row['rms_e']:.4g} e-" for row in self.records())

    def records(self) -> list[dict[str, Any]]:
        """
        Return one dict per effect that contributes, and for the sums.

        The keys are effect, kind, and rms_e, min_e and max_e over the sites.
        """
        parts = [(name, name in self.temporal, values) for name, values in self.items() if np.any(values > 0.0)]
        sums = []
        for kind, is_temporal in (("temporal", True), ("fixed", False)):
            variances = [values**2 for _, temporal, values in parts if temporal is is_temporal]
            sums.append((f"all {kind}", is_temporal, np.sqrt(np.sum(variances, axis=0)) if variances else np.zeros(1)))
        return [
            {
                "effect": name,
                "kind": "temporal" if is_temporal else "fixed",
                "rms_e": float(np.sqrt(np.mean(values**2))) if values.size else 0.0,
                "min_e": float(values.min(initial=np.inf)) if values.size else 0.0,
                "max_e": float(values.max(initial=0.0)),
            }
            for name, is_temporal, values in (*parts, *sums)
        ]

    plot: ClassVar[Drawn[Axes]] = drawn("plot_noise_budget")
    _repr_html_ = drawn("to_html")


def noise_budget(sensor: Sensor, photo_e_per_s: Floats, exposure_s: Annotated[float, EXPOSURE]) -> NoiseBudget:
    """
    Compute the standard deviation of a site's charge due to each effect alone.

    Parameters
    ----------
    sensor : Sensor
    photo_e_per_s : (n_site,) float64, e-/s
        Photoelectron rate of each site without fixed patterns, as from :meth:`foveasim.Camera.photoelectrons_per_s`.
    exposure_s : float, s

    Returns
    -------
    NoiseBudget
        A dict of (n_site,) float64, e-. Entries by name: :data:`TEMPORAL`, further temporal effects of the sensor,
        :data:`FIXED`, further fixed effects; 0 for effects that the sensor does not have. Effects on voltages are referred to
        the charge by the slope of the complete chain at the site's mean, as is conversion noise: the step divided by
        ``sqrt(12)``, and differential nonlinearity. Without clipping, the squares of temporal entries add up to the temporal
        variance of a site, and the squares of fixed entries to the variance between identical sites.

    Notes
    -----
    An entry is the root mean square deviation from the nominal value: ``sqrt(variance + (mean - nominal)²)`` from
    :meth:`~foveasim.sensor.effects.Effect.moments`, for fixed patterns over all devices. Crosstalk and inter-pixel
    capacitance, which mix sites, are not included.
    """
    n_sites = sensor.layout.n_sites
    rates = check_per_site("photo_e_per_s", as_numbers("photo_e_per_s", photo_e_per_s), n_sites)
    photo = rates * sensor.sensitivity
    dark = np.broadcast_to(sensor.nominal_dark_e_per_s, n_sites)
    charge_e = (photo + dark) * exposure_s
    volts = charge_e * sensor.v_per_e
    output_v, slope = apply_nonlinearity(sensor, volts)
    # Nominal values at each stage, and the number of electrons per unit of that stage.
    nominal = {
        "photo": (photo, exposure_s),
        "dark": (dark, exposure_s),
        "expected": (charge_e, 1.0),
        "charge": (charge_e, 1.0),
        "sense_node": (volts, 1.0 / sensor.v_per_e),
        "output": (output_v, 1.0 / (sensor.v_per_e * slope)),
    }
    step_e = local_step_e(sensor, charge_e, sensor.v_per_e, output_v=sensor.pedestal_v)
    temporal = dict.fromkeys(TEMPORAL, np.zeros(1))
    fixed = dict.fromkeys(FIXED, np.zeros(1))
    temporal["quantisation"] = math.sqrt(sensor.adc.noise_dn2) * step_e
    any_device = sensor.sites.without_device()
    for effect in sensor.chain:
        if effect.stage == "collection":
            if sensor.shot.is_drawn:
                for name, values in (("photon_shot", photo), ("dark_shot", dark)):
                    temporal[name] = np.sqrt(effect.moments(values * exposure_s, np.zeros(1), sites=any_device)[1])
        elif effect.reach != "all":
            values, e_per_unit = nominal[effect.stage]
            sites = sensor.sites if effect.is_temporal else any_device
            mean, variance = effect.validate_moments(values, np.zeros(1), sites)
            entries = temporal if effect.is_temporal else fixed
            entries[effect.name] = np.sqrt(variance + (mean - values) ** 2) * e_per_unit
    noise_e = {name: np.broadcast_to(entry, n_sites).copy() for name, entry in (temporal | fixed).items()}
    return NoiseBudget(noise_e, tuple(temporal))

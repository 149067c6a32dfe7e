"""Noise budget: contribution of each effect to temporal noise and non-uniformity, in e-."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np

from foveasim._core.show import ViewMethod, view_method
from foveasim._core.validation import Floats, check_per_site, finite_array
from foveasim.sensor.effects import STANDARD
from foveasim.sensor.limits import EXPOSURE
from foveasim.sensor.model.linearisation import DARK_SHOT, PHOTON_SHOT, QUANTISATION
from foveasim.sensor.sensor import Sensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["FIXED", "TEMPORAL", "NoiseBudget", "noise_budget"]

#: Standard entries of the budget that are temporal noise.
TEMPORAL = (PHOTON_SHOT, DARK_SHOT, *(effect.name for effect in STANDARD if effect.is_temporal), QUANTISATION)
#: Standard entries of the budget that are fixed patterns.
FIXED = tuple(effect.name for effect in STANDARD if not effect.is_temporal)


class NoiseBudget(dict[str, Floats]):
    """
    Standard deviation of each site's charge by effect, a dict of (n_site,) arrays in e-.

    Attributes
    ----------
    temporal : tuple of str
        Names of the temporal effects; the others are fixed patterns.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(n_x=8, n_y=8, pitch_um=3.0), read_noise_e=5.0, prnu_fraction=0.01
    ... )
    >>> budget = fs.sensor.noise_budget(sensor, np.full(64, 1e5), 0.01)
    >>> [
    ...     name for name in budget if name not in budget.temporal and budget[name].any()
    ... ]  # fixed patterns
    ['prnu']
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

    plot: ClassVar[ViewMethod[Axes]] = view_method("plot_noise_budget")
    _repr_html_ = view_method("to_html")


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
        :data:`FIXED`, further fixed effects; 0 for effects that the sensor does not have. Noise is referred to the charge at
        the sense node, after effects that mix sites, by the slope of the complete chain at the site's mean. This includes the
        noise of the conversion: quantisation (1/12 DN²) and differential nonlinearity.

    Notes
    -----
    Temporal entries are for this device. The variance of the collection is divided between ``photon_shot`` and
    ``dark_shot`` by the mean charges of light and dark signal. Without clipping, the squares of the temporal entries add up to
    the variance of :meth:`foveasim.Sensor.predict`, referred to the charge.

    Fixed entries are standard deviations over devices of the same kind, to first order: the sum of their squares is the
    variance of a site's mean value from device to device. Crosstalk and inter-pixel capacitance reduce them, as they mix sites.

    Examples
    --------
    >>> import foveasim as fs
    >>> import numpy as np
    >>> sensor = fs.Sensor(
    ...     fs.layout.grid(8, 8, 3.0),
    ...     read_noise_e=5.0,
    ...     capacitance_f=1.6e-15,
    ...     v_sat_v=1.0,
    ...     bits=12,
    ... )
    >>> budget = fs.sensor.noise_budget(sensor, np.full(64, 1e5), 0.01)
    >>> (
    ...     round(float(budget["photon_shot"].mean()), 2),
    ...     round(float(budget["read"].mean()), 2),
    ... )
    (31.62, 5.0)
    """
    rates = check_per_site(
        "photo_e_per_s", finite_array("photo_e_per_s", photo_e_per_s, at_least=0.0), sensor.layout.n_sites
    )
    this_device, all_devices = (
        sensor.linearise(photo_e_per_s=rates, exposure_s=exposure_s, is_device_known=is_known)
        for is_known in (True, False)
    )
    noise_e = dict.fromkeys((*TEMPORAL, *FIXED), np.zeros(1))
    temporal = list(TEMPORAL)
    for model, is_temporal in ((this_device, True), (all_devices, False)):
        names = [name for name, kind in model.sources.items() if (kind != "fixed") is is_temporal]
        if not sensor.collection.is_drawn and is_temporal:
            names.remove(sensor.collection.name)  # rounding to whole electrons
        noise_e |= {name: np.sqrt(model.variance_e2([name])) for name in names}
        temporal += [name for name in names if is_temporal and name not in temporal]
    names = [*temporal, *(name for name in noise_e if name not in temporal)]
    return NoiseBudget({name: np.broadcast_to(noise_e[name], rates.size).copy() for name in names}, temporal)

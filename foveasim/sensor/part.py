"""Some of the sites of a sensor, with the fixed patterns of the complete sensor."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from foveasim._core.calls import declarations_of
from foveasim._core.threads import cached_property
from foveasim._core.validation import Ints
from foveasim.errors import ParameterError
from foveasim.sensor.device import Device
from foveasim.sensor.effects import Sites
from foveasim.sensor.sensor import Sensor


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SensorPart(Sensor):
    """
    Some of the sites of a sensor, such as a tile.

    Their fixed patterns and effects are those that they have in the complete sensor. Created by :meth:`Sensor.part`.
    """

    #: Sensor with all sites, whose layout the effects use, and indices of the sites of the part.
    _complete: Sensor
    _selection: slice | Ints

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.device_seed != self._complete.device_seed:
            raise ParameterError(
                "device_seed",
                f"must be {self._complete.device_seed} in part of a sensor",
                self.device_seed,
                hint="change it in the complete sensor",
            )
        n_sites = self._complete.sites.block(self._selection).n_sites
        if self.layout.n_sites != n_sites:
            raise ParameterError("layout", f"must have the {n_sites} sites of the part, got {self.layout.n_sites}")
        _check_local(self)

    @cached_property
    def device(self) -> Device:
        """Source of the fixed patterns."""
        return self._complete.device.part(self._selection, self.layout)

    @property
    def _complete_sites(self) -> tuple[Sites, slice | Ints]:
        return self._complete.sites, self._selection


def part_of(sensor: Sensor, selection: slice | Ints) -> SensorPart:
    """Return the sensor of some of the sites; see :meth:`foveasim.Sensor.part`."""
    _check_local(sensor)
    chosen = selection
    if not isinstance(selection, slice) or not _is_range(selection):
        try:
            chosen = np.arange(sensor.layout.n_sites)[selection]
            if chosen.ndim != 1:
                raise IndexError
        except (IndexError, TypeError, ValueError):
            rule = f"must be a slice, or a list of indices of the {sensor.layout.n_sites} sites"
            raise ParameterError("selection", rule, selection) from None
    values: dict[str, Any] = {each.name: getattr(sensor, each.name) for each in fields(Sensor)}
    per_site = (name for name, declared in declarations_of(Sensor).items() if declared.is_per_site)
    values |= {name: values[name][chosen] for name in per_site if np.ndim(values[name])}
    if sensor.pixel_optics is not None:
        values["pixel_optics"] = sensor.pixel_optics.part(chosen)
    return SensorPart(**values | {"layout": sensor.layout[chosen]}, _complete=sensor, _selection=chosen)


def _check_local(sensor: Sensor) -> None:
    """Raise a ParameterError when effects connect sites, because a part lacks some of them."""
    connecting = ", ".join(repr(effect.name) for effect in sensor.chain if effect.reach == "all")
    if connecting:
        raise ParameterError(
            "sensor",
            f"must have no effects between sites to be divided, got {connecting}",
            hint=f"switch them off: sensor.without({connecting})",
        )
    if sensor.pixel_optics is not None and sensor.pixel_optics.has_mixing:
        raise ParameterError(
            "pixel_optics",
            "must not mix the light of sites in a sensor to be divided; use pixel optics without crosstalk",
        )


def _is_range(selection: slice) -> bool:
    """Whether a slice has integer bounds and no step."""
    bounds = selection.start, selection.stop
    return selection.step in (None, 1) and all(bound is None or isinstance(bound, int) for bound in bounds)

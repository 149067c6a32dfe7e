"""Sensors from the settings of captures: effects by class, arrays by checksum."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from numpy.typing import NDArray

from foveasim._core.provenance import is_digest, resolve
from foveasim.errors import ParameterError
from foveasim.incidence import ChiefRayTable
from foveasim.sensor.effects import EFFECTS
from foveasim.sensor.effects.crosstalk import Diffusion, InterPixelCapacitance, KernelCrosstalk
from foveasim.sensor.effects.shot import ShotNoise
from foveasim.sensor.pixel_optics import PIXEL_OPTICS, Outlines
from foveasim.sensor.sensor import SPECTRAL, Sensor


def values_of(cls: type[Sensor], settings: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Return the parameters of a sensor; see :meth:`foveasim.Sensor.from_settings`."""
    kinds: tuple[Any, ...] = (
        Diffusion, KernelCrosstalk, InterPixelCapacitance, ShotNoise, *EFFECTS.values(), *PIXEL_OPTICS.values(), Outlines,
        ChiefRayTable,
    )  # fmt: skip
    classes = {kind.__name__: kind for kind in kinds}
    values: dict[str, Any] = {}
    for parameter in fields(cls):
        name = parameter.name
        if name in SPECTRAL or name == "layout":
            continue
        if name not in settings and parameter.default:
            raise ParameterError("sensor", f"must be given: the settings of the capture do not contain {name!r}")
        if name in settings:
            values[name] = _object(classes, name, settings[name], arrays)
    return values


def _object(classes: Mapping[str, Any], name: str, data: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """Create the effect objects that plain data describe; return other data unchanged."""
    if is_digest(data):
        values_of = resolve(data, arrays)
        if values_of is None:
            raise ParameterError(
                "sensor", f"must be given: the settings of the capture do not contain all values of {name!r}"
            )
        return values_of
    if isinstance(data, list):
        return [_object(classes, f"{name}[{k}]", item, arrays) for k, item in enumerate(data)]
    if not isinstance(data, Mapping):
        return data
    values = {key: _object(classes, f"{name}.{key}", item, arrays) for key, item in data.items() if key != "kind"}
    if "kind" not in data:
        return values  # a parameter of an effect
    kind = str(data["kind"])
    if kind not in classes:
        raise ParameterError("sensor", f"cannot be restored: effect {kind!r} is not registered; pass sensor=")
    parameters = {each.name: each.init for each in fields(classes[kind])}
    unknown = next((key for key in values if key not in parameters), None)
    if unknown is not None:
        raise ParameterError(
            "sensor", f"cannot be restored: effect {kind!r} has no parameter {unknown!r} any more; pass sensor="
        )
    return classes[kind](**{key: value for key, value in values.items() if parameters[key]})

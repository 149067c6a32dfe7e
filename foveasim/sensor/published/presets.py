"""Published electronics by name: data sheets, and the parameters of the paper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from foveasim._core.names import possible_names
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats
from foveasim.errors import ParameterError
from foveasim.sensor.limits import ALTERNATIVES
from foveasim.sensor.published.datasheet import DataSheet, for_areas
from foveasim.sensor.published.sheets import GROUPS, SHEETS

__all__ = ["PRESETS", "Preset"]

#: Group of the presets of the paper.
PAPER = "paper"


@dataclass(frozen=True, kw_only=True)
class Preset:
    """
    Electronics of a published sensor, for photosites of any size.

    Attributes
    ----------
    title : str
    source : str
        Publication with the values.
    group : {"mobile", "machine vision", "scientific", "astronomy", "paper"}
        Use.
    quantities : mapping of str to object
        Values of the data sheet as they are printed; empty without one.
    parameters : mapping of str to object
        Parameters of :class:`foveasim.Sensor` of a publication that is no data sheet.

    Examples
    --------
    >>> import foveasim as fs
    >>> preset = fs.sensor.PRESETS["machine_vision"]
    >>> preset.group, preset.sheet.bits, preset.quantities["full_well_e"]
    ('machine vision', 12, 10700)
    """

    title: str
    source: str
    group: str
    quantities: Mapping[str, Any] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Preset({self.title!r})"

    @cached_property
    def sheet(self) -> DataSheet | None:
        """Data sheet, None for presets of the paper."""
        return DataSheet(**self.quantities) if self.quantities else None

    @property
    def scaling(self) -> str:
        """Sentence about what depends on the area of a site."""
        if not self.quantities:
            return "All parameters are equal for sites of any size."
        return (
            "Full well, dark current and the steps of the ADC in electrons are proportional to the area of a site; read noise "
            "and bits are those of the pixel."
        )

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Source and assumptions, as plain data."""
        own = {"title": self.title, "source": self.source}
        return MappingProxyType(own) if self.sheet is None else self.sheet.provenance

    def values(self, area_um2: Floats, *, has_lines: bool = False) -> dict[str, Any]:
        """Return :meth:`settings` for sites of these areas, (n_site,) µm²."""
        return for_areas(self.settings(has_lines=has_lines), area_um2)

    def settings(self, *, has_lines: bool = False) -> dict[str, Any]:
        """Return the parameters as in settings files; see :meth:`DataSheet.settings`."""
        if self.sheet is None:
            return {**self.parameters, "provenance": dict(self.provenance)}
        return self.sheet.settings(has_lines=has_lines)


def with_changes(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters with changes, which also replace the same quantity in another unit."""
    given = {name for name, value in changes.items() if value is not None}
    others = {name for pair in ALTERNATIVES if given & {*pair} for name in pair} - given
    found = {name: value for name, value in values.items() if name not in others} | dict(changes)
    replaced = sorted(values.keys() & {*changes, *others})
    if replaced and "provenance" in values and "provenance" not in changes:
        found["provenance"] = {**values["provenance"], "replaced": replaced}
    return found


def find_preset(name: str) -> Preset:
    """Return a preset by its name, or raise a ParameterError with similar names."""
    if name not in PRESETS:
        raise ParameterError("preset", "must be the name of a preset", name, hint=possible_names(name, list(PRESETS)))
    return PRESETS[name]


def _paper(title: str, where: str, **parameters: Any) -> Preset:
    """Return a preset of the paper."""
    source = f'"From the radiance reflected by a scene to a digital picture", {where}'
    return Preset(title=title, source=source, group=PAPER, parameters=parameters)


_GROUP_OF = {name: group for group, names in GROUPS.items() for name in names}
#: Presets by name: ``fs.Sensor.from_preset(layout, "machine_vision")``, and the key ``preset`` of settings files. What a source
#: does not specify is listed in ``preset.sheet.assumptions``.
PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        **{
            name: Preset(title=sheet["title"], source=sheet["source"], group=_GROUP_OF[name], quantities=sheet)
            for name, sheet in SHEETS.items()
        },
        "paper_foveal": _paper(
            "the foveal sensor of the paper",
            "table of its runs, for an exposure of 1/30 s",
            read_noise_e=1.0,
            capacitance_f=1e-13,
            v_sat_v=3.0,
            bits=8,
        ),
        "paper_distortion": _paper(
            "the sensor behind a fisheye lens of the paper",
            "table of its runs, for an exposure of 1/60 s",
            read_noise_e=1.0,
            capacitance_f=4.8e-13,
            v_sat_v=3.0,
            bits=8,
        ),
        "paper_read_noise": _paper(
            "the read noise of the paper",
            "Fig. 9, with a read noise of 0, 50 or 200 e-",
            read_noise_e=50.0,
            full_well_e=7000.0,
        ),
    }
)

"""Published electronic parameters, with sources."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from foveasim._core.names import possible_names
from foveasim._core.validation import Floats
from foveasim.errors import ParameterError
from foveasim.sensor.limits import ALTERNATIVES
from foveasim.units import ELEMENTARY_CHARGE_C

__all__ = ["PRESETS", "Preset"]

#: Voltage range of pixels whose data sheets state charges: only its product with the capacitance matters.
SWING_V = 1.0


@dataclass(frozen=True)
class Preset:
    """
    Electronic parameters of a published sensor, for photosites of any size.

    Attributes
    ----------
    title : str
    source : str
        Publication, and how the parameters follow from its figures.
    parameters : mapping of str to object
        Parameters of :class:`foveasim.Sensor` that are equal for all sites.
    per_um2 : mapping of str to float
        Parameters per µm² of the area of a site.

    Examples
    --------
    >>> import foveasim as fs
    >>> preset = fs.sensor.PRESETS["machine_vision"]
    >>> preset.title, preset.parameters["bits"], sorted(preset.per_um2)
    ('machine vision, global shutter, pixels of 3.45 µm', 12, ['capacitance_f'])
    """

    title: str
    source: str
    parameters: Mapping[str, Any]
    per_um2: Mapping[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Preset({self.title!r})"

    @property
    def scaling(self) -> str:
        """Sentence about what depends on the area of a site."""
        if not self.per_um2:
            return "All parameters are equal for sites of any size."
        return (
            "Full well, capacitance and the steps of the ADC in electrons are proportional to the area of a site; read noise "
            "and bits are those of the pixel."
        )

    def values(self, area_um2: Floats) -> dict[str, Any]:
        """Return the parameters of a sensor whose sites have these areas, (n_site,)."""
        return {**self.parameters, **{name: value * area_um2 for name, value in self.per_um2.items()}}

    def settings(self) -> dict[str, Any]:
        """Return the parameters as in settings files."""
        return {**self.parameters, **{name: {"per_um2": value} for name, value in self.per_um2.items()}}


def with_changes(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters with changes, which also replace the same quantity in another unit."""
    given = {name for name, value in changes.items() if value is not None}
    replaced = {name for pair in ALTERNATIVES if given & {*pair} for name in pair}
    return {name: value for name, value in values.items() if name not in replaced} | dict(changes)


def find_preset(name: str) -> Preset:
    """Return a preset by its name, or raise a ParameterError with similar names."""
    if name not in PRESETS:
        raise ParameterError("preset", "must be the name of a preset", name, hint=possible_names(name, list(PRESETS)))
    return PRESETS[name]


def _measured(
    title: str,
    source: str,
    *,
    pixel_um: float,
    full_well_e: float,
    total_noise_e: float,
    bits: int,
    pedestal_dn: int = 0,
) -> Preset:
    """
    Return the preset of a pixel: full wells proportional to the area, equal read noise.

    A published noise is measured in codes, and contains quantisation: its 1/12 DN² is subtracted in quadrature. Above the
    pedestal, the remaining codes are those of the full well.
    """
    pedestal = pedestal_dn / 2**bits
    e_per_dn = full_well_e / (2**bits * (1.0 - pedestal))
    capacitance_f = full_well_e * ELEMENTARY_CHARGE_C / (SWING_V * (1.0 - pedestal))
    parameters = {
        "read_noise_e": round(math.sqrt(total_noise_e**2 - e_per_dn**2 / 12.0), 4),
        "v_sat_v": SWING_V,
        "bits": bits,
        "cds": True,
    }
    if pedestal_dn:
        parameters["pedestal_v"] = pedestal * SWING_V
    return Preset(title, source, parameters, {"capacitance_f": capacitance_f / pixel_um**2})


#: Presets by name: ``fs.Sensor.from_preset(layout, "machine_vision")``, and the key ``preset`` of settings files. Full wells of
#: measured pixels are proportional to the area of a site, so that all sites saturate at the same irradiance. Quantum efficiency
#: and filters, and parameters that a source does not specify, have their defaults.
PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        "mobile": _measured(
            "mobile camera, pixels of 1.4 µm",
            "OmniVision OV5647 as specified in the OptArc AF51 user guide, v1.02, p. 21: well capacity 4,300 e-, dynamic range "
            "68 dB, which is a noise of 1.71 e- in codes; 10 bits, with a pedestal of 16 codes, above the noise",
            pixel_um=1.4,
            full_well_e=4300.0,
            total_noise_e=1.71,
            bits=10,
            pedestal_dn=16,
        ),
        "machine_vision": _measured(
            "machine vision, global shutter, pixels of 3.45 µm",
            "Sony IMX250 in the Genie Nano M2450, Teledyne DALSA manual, p. 42: full well 10,700 e-, dynamic range 75.46 dB, "
            "which is a noise of 1.8 e- in codes; 12 bits",
            pixel_um=3.45,
            full_well_e=10_700.0,
            total_noise_e=1.804,
            bits=12,
        ),
        "scientific": _measured(
            "scientific CMOS, pixels of 6.5 µm",
            "Andor Zyla 5.5, hardware manual rev. 18, 2021, pp. 22 and 25: saturation 30,000 e-, median read noise 1.38 e- at "
            "560 MHz; 16 bits",
            pixel_um=6.5,
            full_well_e=30_000.0,
            total_noise_e=1.38,
            bits=16,
        ),
        **{
            name: Preset(title, f'"From the radiance reflected by a scene to a digital picture", {where}', parameters)
            for name, title, where, parameters in (
                (
                    "paper_foveal",
                    "the foveal sensor of the paper",
                    "table of its runs, for an exposure of 1/30 s",
                    {"read_noise_e": 1.0, "capacitance_f": 1e-13, "v_sat_v": 3.0, "bits": 8},
                ),
                (
                    "paper_distortion",
                    "the sensor behind a fisheye lens of the paper",
                    "table of its runs, for an exposure of 1/60 s",
                    {"read_noise_e": 1.0, "capacitance_f": 4.8e-13, "v_sat_v": 3.0, "bits": 8},
                ),
                (
                    "paper_read_noise",
                    "the read noise of the paper",
                    "Fig. 9, with a read noise of 0, 50 or 200 e-",
                    {"read_noise_e": 50.0, "full_well_e": 7000.0},
                ),
            )
        },
    }
)

"""Optical formats: sizes of the image areas of standard sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

__all__ = ["OPTICAL_FORMATS", "OpticalFormat"]


@dataclass(frozen=True)
class OpticalFormat:
    """
    Image area of a type of sensor.

    Attributes
    ----------
    title : str
    size_um : (width, height), µm
    source : str

    Examples
    --------
    >>> import foveasim as fs
    >>> found = fs.layout.OPTICAL_FORMATS["1/3"]
    >>> found
    OpticalFormat('1/3 inch', 4.8 × 3.6 mm)
    >>> fs.layout.grid(n_sites=12_000, size_um=found.size_um).bounds_um[2]
    2400.0
    """

    title: str
    size_um: tuple[float, float]
    source: str

    def __repr__(self) -> str:
        return f"OpticalFormat({self.title!r}, {self.description})"

    @property
    def description(self) -> str:
        """Width and height in mm."""
        width_mm, height_mm = (1e-3 * length_um for length_um in self.size_um)
        return f"{width_mm:g} × {height_mm:g} mm"


#: Sources of several sizes.
_TUBES = "optowiki.info, sensor format: a diagonal of 16 mm per inch from 1/2 inch, 18 mm per inch below; 4:3"
_CAMERAS = "typical of digital cameras, since inch-based formats have no standard size: "

#: Optical formats by their designation in inches: the outer diameter of a camera tube with an image of this size.
OPTICAL_FORMATS: Mapping[str, OpticalFormat] = MappingProxyType(
    {
        "1/4": OpticalFormat("1/4 inch", (3600.0, 2700.0), _TUBES),
        "1/3": OpticalFormat("1/3 inch", (4800.0, 3600.0), _TUBES),
        "1/2.3": OpticalFormat("1/2.3 inch", (6170.0, 4550.0), _CAMERAS + "shuttermuse.com, sensor sizes"),
        "1/2": OpticalFormat("1/2 inch", (6400.0, 4800.0), _TUBES),
        "2/3": OpticalFormat(
            "2/3 inch", (8800.0, 6600.0), _CAMERAS + "shuttermuse.com, sensor sizes; diagonal of 11 mm"
        ),
        "1": OpticalFormat("1 inch", (12800.0, 9600.0), _TUBES),
    }
)

"""
Base class of pixel optics: openings, layers and microlenses above photodiodes.

Pixel optics convert the light that is incident on the outlines of photosites to the light that their photodiodes collect. A
camera integrates the image over the outlines of :class:`Footprints`, and multiplies by their factors.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from foveasim._core.registry import Registry
from foveasim._core.short_repr import short_repr
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, Ints, check_per_site, finite_array, read_only
from foveasim.errors import ParameterError, SimulationError, type_name
from foveasim.fields import PackedRings
from foveasim.incidence import Incidence
from foveasim.sensor.effects.contract import Photosites

if TYPE_CHECKING:
    from scipy.sparse import csr_array

__all__ = ["PIXEL_OPTICS", "Footprints", "PixelOptics"]

#: Fraction of the light by which columns and losses may exceed 1.
FRACTION_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Footprints:
    """
    Light that photosites collect, for the cones of light of a lens.

    Parameters
    ----------
    response : (n_site,) float64
        Fraction of the power incident on the outline of a site that its photodiode collects.
    outlines : packed rings, optional
        Outlines in the plane of the image over which this power is collected, in the frame of the layout; by default those of
        the layout.
    area_ratio : (n_site,) float64 or float
        Area of each of these outlines over that of the site.
    mixing : csr_array (n_site, n_site) float64, optional
        Element ``[j, i]`` is the fraction of the power incident on site i that the photodiode of another site j collects; the
        diagonal is 0. Columns and responses have a sum of at most 1; the difference is lost.

    Raises
    ------
    ParameterError
        When a response is not from 0 to 1, or the light of a site is collected more than once.

    Examples
    --------
    >>> Footprints(np.array([0.8, 0.9])).apply(np.array([100.0, 100.0])).tolist()
    [80.0, 90.0]
    """

    response: Floats
    outlines: PackedRings | None = None
    area_ratio: Floats | float = 1.0
    mixing: csr_array[Any] | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        response = finite_array("response", self.response, ndim=1, at_least=0.0, at_most=1.0 + FRACTION_ROUNDING)
        if response.size and response.max() > 1.0:
            response = np.minimum(response, 1.0)
        object.__setattr__(self, "response", read_only(response))
        if not isinstance(self.area_ratio, float):
            ratio = finite_array("area_ratio", self.area_ratio, above=0.0)
            object.__setattr__(self, "area_ratio", read_only(np.broadcast_to(ratio, response.shape)))
        if self.mixing is not None:
            collected = response + np.asarray(self.mixing.sum(axis=0)).ravel()
            if response.size and not (largest := float(collected.max())) <= 1.0 + FRACTION_ROUNDING:
                raise ParameterError("mixing", "plus 'response' must have sums of at most 1 per site", largest)

    @cached_property
    def factor(self) -> Floats:
        """Factor on the power within the outlines, (n_site,): response over ratio of areas."""
        return (
            self.response
            if np.ndim(self.area_ratio) == 0 and self.area_ratio == 1.0
            else read_only(self.response / self.area_ratio)
        )

    def apply(self, rate_e_per_s: Floats, *, out: Floats | None = None) -> Floats:
        """
        Return the rates of photoelectrons, given those within the outlines, (n_site,) e-/s.

        The rate within the outline of a site is that within the outlines, over the ratio of their areas.
        Light that meets the photodiode of another site has passed the filter of its own site. ``out``: array for the result,
        such as the rates.
        """
        mixed = None if self.mixing is None else self.mixing @ (rate_e_per_s / self.area_ratio)
        collected = np.multiply(rate_e_per_s, self.factor, out=out)
        return collected if mixed is None else np.add(collected, mixed, out=collected)


class PixelOptics(ABC):
    """
    Base class of pixel optics.

    Subclasses are frozen dataclasses, registered with ``@PIXEL_OPTICS.register("name")`` for settings files.

    """

    @property
    def has_mixing(self) -> bool:
        """Whether sites collect light of others; such a sensor cannot be divided into tiles."""
        return False

    @abstractmethod
    def footprints(self, sites: Photosites, incidence: Incidence) -> Footprints:
        """
        Compute the light that each site collects.

        Parameters
        ----------
        sites : Layout
            In the frame of the sensor, without gaze.
        incidence : Incidence
            Cone of light at each site: ``incidence.chief_ray``, or ``incidence.tangents`` and ``incidence.weights`` for rays.

        Returns
        -------
        Footprints
            Each site must have the footprint that it has in any selection of sites, unless ``has_mixing``.
        """

    def part(self, selection: slice | Ints) -> PixelOptics:  # noqa: ARG002 -- for subclasses
        """Return the pixel optics of some of the sites, for those with data per site."""
        return self

    def optical_opening_um(self, sites: Photosites) -> float:  # noqa: ARG002 -- for subclasses
        """
        Return the smallest width of an opening times its refractive index, µm.

        Cameras warn when it is less than two wavelengths: geometric rays neglect diffraction. Infinity, the default, for no
        warning.
        """
        return np.inf


def check_footprints(optics: PixelOptics, sites: Photosites, incidence: Incidence) -> Footprints:
    """Return the footprints of pixel optics after checking their type and sizes."""
    found: Any = optics.footprints(sites, incidence)
    name = type(optics).__name__
    if not isinstance(found, Footprints):
        raise SimulationError(f"the pixel optics '{name}' must return Footprints, got {type_name(found)}")
    check_per_site("response", found.response, sites.n_sites)
    if found.outlines is not None and found.outlines.site_offsets.size - 1 != sites.n_sites:
        n_outlines = found.outlines.site_offsets.size - 1
        raise SimulationError(
            f"the pixel optics '{name}' must return outlines of the {sites.n_sites} sites, got {n_outlines}"
        )
    return found


#: Pixel optics by their names in settings files. Classes are registered with ``@PIXEL_OPTICS.register("name")``, or by entry
#: points of the group ``foveasim.pixel_optics`` in installed packages.
PIXEL_OPTICS: Registry[type[PixelOptics]] = Registry("pixel optics", "foveasim.pixel_optics")

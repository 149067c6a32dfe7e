"""Microlenses that image the exit pupil onto photodiodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from foveasim._core.calls import OwnCheck, check_declared
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, Ints, check_choice, check_number
from foveasim.fields import Outlines
from foveasim.incidence import ChiefRayTable, Incidence
from foveasim.sensor.effects.contract import Photosites
from foveasim.sensor.pixel_optics._layers import Layers, as_layers
from foveasim.sensor.pixel_optics._shapes import Shapes, as_outlines, inset, smallest_area_um2
from foveasim.sensor.pixel_optics.aperture_stack import INSET
from foveasim.sensor.pixel_optics.contract import PIXEL_OPTICS, Footprints, PixelOptics

if TYPE_CHECKING:
    pass

__all__ = ["Microlens"]

SHIFTS = ("none", "optimal")


@PIXEL_OPTICS.register("microlens", example={"height_um": 2.0, "refractive_index": 1.5, "shift": "optimal"})
@dataclass(frozen=True, kw_only=True)
class Microlens(PixelOptics):
    """
    A microlens over each site, focused on its photodiode.

    Parameters
    ----------
    height_um : float or sequence of float, µm
        Distance between microlens and photodiode, or the heights of several layers from top to bottom.
    refractive_index : float or sequence of float
        Refractive index of each layer, at least 1.
    shift : {"none", "optimal"} or float
        Shift of the microlenses towards the optical axis: that which centres the image of the pupil on the photodiode, or a
        factor on it.
    design_chief_ray : ChiefRayTable, optional
        Chief rays for which the shift is optimal; by default those of the lens, at the gaze (0, 0).
    photodiode_inset_um : float, µm
        Distance of the edges of photodiodes from the outline of the site, inwards.
    crosstalk : bool
        Whether photodiodes collect light that misses the one of its own site. It has passed the filter of its own site.
    photodiode : Layout, optional
        Photodiodes of all sites, instead of an inset: such as a layer of a chip file, with the same sites in the same order and
        frame.

    Raises
    ------
    ParameterError
        When a value is out of range, or the numbers of heights and indices differ.
    GeometryError
        In captures, when the inset leaves nothing of a site.

    Notes
    -----
    The microlens covers its site, and images the exit pupil onto the plane of the photodiode: a ray of tangent t meets it at
    ``Σ h t / sqrt(n² (1 + t²) - t²) - s`` from the centroid of the site. The response is the fraction of the power in this
    image that is on the photodiode. The optimal shift is ``s = Σ h tan asin(sin CRA / n)``. On the axis, all light is collected
    while ``h / (2 n N)`` is at most the radius of the inscribed circle.

    Images of clear circular pupils are polygons of 96 vertices, whose power per area is linear in the squared displacement: the
    fraction is within 1e-3 from f/2.8, 2e-3 at f/2, 4e-3 at f/1.4 and 8e-3 at f/1, for chief rays up to 38°. Images of other
    pupils are counted ray by ray, with ``n_rings`` rings of rays.

    Rays are geometric: diffraction inside the stack is neglected, which is wrong for openings of a few wavelengths.

    Sources: P. B. Catrysse, X. Liu and A. El Gamal, QE reduction due to pixel vignetting in CMOS image sensors, Proc. SPIE
    3965, 420 (2000).

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.Layout.from_rectangles([[0.0, 0.0], [2000.0, 0.0]], 3.0)
    >>> cones = fs.Optics(focal_length_mm=8.0, f_number=2.8).incidence(layout.centroid_um)
    >>> for shift in ("none", "optimal"):
    ...     optics = Microlens(
    ...         height_um=4.0, refractive_index=1.5, shift=shift, photodiode_inset_um=0.5
    ...     )
    ...     optics.footprints(layout, cones).response.round(2).tolist()
    [1.0, 0.95]
    [1.0, 1.0]
    """

    height_um: OwnCheck[float | Sequence[float]]
    refractive_index: OwnCheck[float | Sequence[float]]
    shift: OwnCheck[Literal["none", "optimal"] | float] = "none"
    design_chief_ray: ChiefRayTable | None = None
    photodiode_inset_um: Annotated[float, INSET] = 0.0
    crosstalk: bool = False
    photodiode: OwnCheck[Outlines | None] = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_declared(self)
        as_layers(self)
        shift = self.shift
        object.__setattr__(
            self,
            "shift",
            check_choice("shift", shift, SHIFTS) if isinstance(shift, str) else check_number("shift", shift),
        )
        if self.photodiode is not None:
            object.__setattr__(self, "photodiode", as_outlines("photodiode", self.photodiode))

    @property
    def has_mixing(self) -> bool:
        """Whether sites collect light of others."""
        return self.crosstalk

    def part(self, selection: slice | Ints) -> Microlens:
        """Return the microlenses of some of the sites."""
        return self if self.photodiode is None else replace(self, photodiode=self.photodiode.part(selection))

    def optical_opening_um(self, sites: Photosites) -> float:
        """Return the size of the smallest site times the index of the top layer, µm."""
        return float(np.atleast_1d(self.refractive_index)[0] * np.sqrt(smallest_area_um2(sites)))

    def shift_um(self, incidence: Incidence) -> Floats:
        """
        Compute the shift of each microlens towards the optical axis.

        Parameters
        ----------
        incidence : Incidence

        Returns
        -------
        shift_um : (n_site, 2) float64, µm
        """
        if self.shift == "none":
            return np.zeros((incidence.n_sites, 2))
        factor = 1.0 if isinstance(self.shift, str) else self.shift
        return factor * as_layers(self).displacements_um(incidence.design(self.design_chief_ray))

    def footprints(self, sites: Photosites, incidence: Incidence) -> Footprints:
        """Compute the fraction of the image of the pupil on each photodiode."""
        if not sites.n_sites:
            return Footprints(np.zeros(0))
        layers = as_layers(self)
        shapes = Shapes.of(sites, 0.0, self.photodiode_inset_um if self.photodiode is None else self.photodiode)

        def fractions(cones: Incidence, site_of: Ints) -> Floats:
            centre_um = shapes.centre_um[site_of]
            return self._fractions(cones, layers, shapes.photodiode, site_of, centre_um)[:, np.newaxis]

        response = shapes.evaluate(incidence, 1, fractions, self.design_chief_ray)[:, 0]
        return self._with_crosstalk(sites, incidence, layers, response) if self.crosstalk else Footprints(response)

    def _fractions(
        self, cones: Incidence, layers: Layers, photodiode: Outlines, site_of: Ints, centre_um: Floats
    ) -> Floats:
        """Return the fraction of the light of each cone, at a centre, on the photodiode of a site."""
        from foveasim.sensor.pixel_optics import _kernels

        found = np.empty(cones.n_sites)
        stack = np.ascontiguousarray(cones.chief_ray), cones.radius, layers.height_um, layers.squared_index
        rings = photodiode.xy_um, photodiode.ring_offsets, photodiode.site_offsets
        target = self.shift_um(cones), *rings, site_of, np.ascontiguousarray(centre_um), found
        if cones.transmission is None:
            _kernels.pupil_fractions(*stack, *target)
        else:
            points, weights = cones.rays()
            _kernels.ray_fractions(*stack, np.ascontiguousarray(points.T), weights, *target)
        return found

    def _with_crosstalk(self, sites: Photosites, incidence: Incidence, layers: Layers, response: Floats) -> Footprints:
        """
        Return the fractions of the light of sites on all photodiodes.

        Both are parts of the same image, without interpolation, so that their sum is at most 1.
        """
        import shapely
        from scipy.sparse import coo_array

        photodiode = self.photodiode
        if photodiode is None:
            photodiode = inset("photodiode", as_outlines("sites", sites), self.photodiode_inset_um)
        starts = photodiode.ring_offsets[photodiode.site_offsets[:-1]]
        low_um, high_um = (find.reduceat(photodiode.xy_um, starts, axis=0) for find in (np.minimum, np.maximum))
        tree = shapely.STRtree(shapely.box(*low_um.T, *high_um.T))
        lost = np.flatnonzero(response < 1.0)
        cones = incidence.at(incidence.field_um[lost])
        angle = 2.0 * np.pi * np.arange(8) / 8.0
        edge = cones.radius / math.cos(np.pi / 8.0) * np.column_stack((np.cos(angle), np.sin(angle)))
        image_um = layers.displacements_um(cones.chief_ray[:, np.newaxis] + edge)
        image_um += (sites.centroid_um[lost] - self.shift_um(cones))[:, np.newaxis]
        of, target = tree.query(shapely.box(*image_um.min(axis=1).T, *image_um.max(axis=1).T))
        source, target = lost[of], target.astype(np.int64)
        fraction = self._fractions(
            incidence.at(incidence.field_um[source]), layers, photodiode, target, sites.centroid_um[source]
        )
        is_other, n_sites = source != target, sites.n_sites
        matrix = coo_array((fraction[is_other], (target[is_other], source[is_other])), shape=(n_sites, n_sites)).tocsr()
        matrix.eliminate_zeros()
        own = np.where(response < 1.0, 0.0, response)
        own[source[~is_other]] = fraction[~is_other]
        return Footprints(own, mixing=matrix)

"""Openings above photodiodes, without microlenses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from foveasim._core.calls import Limits, OwnCheck, check_declared
from foveasim._core.rings import site_area_um2, site_moments_about
from foveasim._core.short_repr import short_repr
from foveasim._core.validation import Floats, Ints, freeze
from foveasim.fields import Outlines
from foveasim.incidence import Incidence
from foveasim.sensor.effects.contract import Photosites
from foveasim.sensor.pixel_optics._layers import as_layers
from foveasim.sensor.pixel_optics._shapes import Shapes, as_outlines
from foveasim.sensor.pixel_optics.contract import PIXEL_OPTICS, Footprints, PixelOptics

__all__ = ["INSET", "ApertureStack"]

#: Numbers of rings of rays, at least, for increasing displacements; more where openings and photodiodes differ.
N_RINGS, N_RINGS_OF_INSETS = (1, 2, 3, 6), (3, 4, 5, 8)
INSET = Limits(at_least=0.0, at_most=1e4, hint="insets are in µm")


@PIXEL_OPTICS.register("aperture_stack", example={"height_um": 2.0, "refractive_index": 1.5})
@dataclass(frozen=True, kw_only=True)
class ApertureStack(PixelOptics):
    """
    Photodiodes at the bottom of a stack of layers, under openings without microlenses.

    Parameters
    ----------
    height_um : float or sequence of float, µm
        Distance between opening and photodiode, or the heights of several layers from top to bottom.
    refractive_index : float or sequence of float
        Refractive index of each layer, at least 1.
    opening_inset_um, photodiode_inset_um : float, µm
        Distance of the edges of openings and photodiodes from the outline of the site, inwards.
    opening, photodiode : Layout, optional
        Openings and photodiodes of all sites, instead of an inset: such as a layer of a chip file, with the same sites in the
        same order and frame.

    Raises
    ------
    ParameterError
        When a value is out of range, or the numbers of heights and indices differ.
    GeometryError
        In captures, when an inset leaves nothing of a site.

    Notes
    -----
    A ray of tangent t above the stack is displaced by ``d = Σ h t / sqrt(n² (1 + t²) - t²)`` on its way from the opening A to
    the photodiode B, and is collected from ``A ∩ (B - d)``. The response is the mean of this area over the cone, over the area
    of the site. The light is collected from one affine image of A, which has the centroid and the second moments of the mean
    overlap: on photographs blurred by 1.5 µm, within 0.05 % (rms) of sixteen clipped outlines per site.

    Rays are geometric: diffraction inside the stack is neglected, which is wrong for openings of a few wavelengths. Light that
    misses its photodiode is absorbed. The number of rays increases with the displacements, in widths of a site: responses are
    within 1e-3 of the mean over the cone; where openings and photodiodes differ, within 2e-3. Sites of equal shape are
    interpolated between nodes of 1/128 in the tangent of the chief ray.

    Source: P. B. Catrysse and B. A. Wandell, Optical efficiency of image sensor pixels, J. Opt. Soc. Am. A 19, 1610 (2002).

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.Layout.from_rectangles([[0.0, 0.0]], 4.0)
    >>> lens = fs.Optics(focal_length_mm=8.0, f_number=2.0)
    >>> stack = ApertureStack(height_um=2.0, refractive_index=1.5)
    >>> stack.footprints(layout, lens.incidence(layout.centroid_um)).response.round(
    ...     3
    ... ).tolist()
    [0.932]
    """

    height_um: OwnCheck[float | Sequence[float]]
    refractive_index: OwnCheck[float | Sequence[float]]
    opening_inset_um: Annotated[float, INSET] = 0.0
    photodiode_inset_um: Annotated[float, INSET] = 0.0
    opening: OwnCheck[Outlines | None] = None
    photodiode: OwnCheck[Outlines | None] = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        check_declared(self)
        as_layers(self)
        for name in ("opening", "photodiode"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_outlines(name, getattr(self, name)))

    def part(self, selection: slice | Ints) -> ApertureStack:
        """Return the stack of some of the sites."""
        parts = {name: getattr(self, name) for name in ("opening", "photodiode") if getattr(self, name) is not None}
        return replace(self, **{name: each.part(selection) for name, each in parts.items()}) if parts else self

    def _shapes(self, sites: Photosites) -> Shapes:
        return Shapes.of(
            sites,
            self.opening_inset_um if self.opening is None else self.opening,
            self.photodiode_inset_um if self.photodiode is None else self.photodiode,
        )

    def optical_opening_um(self, sites: Photosites) -> float:
        """Return the smallest opening times the index of the top layer, µm."""
        opening, index = self._shapes(sites).opening, np.atleast_1d(self.refractive_index)[0]
        area_um2 = site_area_um2(opening.xy_um, opening.ring_offsets, opening.site_offsets)
        return float(index * np.sqrt(area_um2.min(initial=np.inf)))

    def footprints(self, sites: Photosites, incidence: Incidence) -> Footprints:
        """Compute the mean overlap of openings and displaced photodiodes, and its affine outlines."""
        from foveasim.sensor.pixel_optics import _kernels

        if not sites.n_sites:
            return Footprints(np.zeros(0))
        shapes, layers = self._shapes(sites), as_layers(self)
        before = site_moments_about(*_arrays(shapes.opening), shapes.centre_um)
        sites_um2 = before[:, 0] if shapes.opening is shapes.sites else site_area_um2(*_arrays(shapes.sites))
        is_same = _is_same(shapes.opening, shapes.photodiode)
        sets = [max(n_rings, incidence.n_rings) for n_rings in (N_RINGS if is_same else N_RINGS_OF_INSETS)]
        rays = [incidence.rays(n_rings) for n_rings in sets]
        points = np.ascontiguousarray(np.concatenate([each for each, _ in rays]).T)
        weights = np.concatenate([each for _, each in rays])
        offsets = np.cumsum([0, *(each.size for _, each in rays)])
        has_disc = incidence.transmission is None

        def values(cones: Incidence, site_of: Ints) -> Floats:
            """Return response, three elements of the matrix and two of the shift of each cone."""
            found = np.empty((cones.n_sites, 6))
            _kernels.cone_footprints(
                np.ascontiguousarray(cones.chief_ray), cones.radius, layers.height_um, layers.squared_index,
                points, weights, offsets, has_disc, *_arrays(shapes.opening), *_arrays(shapes.photodiode),
                site_of, is_same, shapes.centre_um, before, found,
            )  # fmt: skip
            found[:, 0] /= sites_um2[site_of]
            return found

        found = shapes.evaluate(incidence, 6, values)
        own = np.zeros(sites.n_sites, np.int64) if shapes.is_congruent else slice(None)
        xx, xy, yy = found[:, 1:4].T
        ratio = (xx * yy - xy * xy) * (before[:, 0] / sites_um2)[own]
        outlines = _affine_outlines(shapes, _centres_um(sites, shapes), before, found[:, 1:])
        return Footprints(np.clip(found[:, 0], 0.0, 1.0), outlines, ratio)


def _arrays(outlines: Outlines) -> tuple[Floats, Ints, Ints]:
    return outlines.xy_um, outlines.ring_offsets, outlines.site_offsets


def _is_same(one: Outlines, other: Outlines) -> bool:
    """Return whether two outlines have the same arrays."""
    return one is other or all(np.array_equal(a, b) for a, b in zip(_arrays(one), _arrays(other), strict=True))


def _centres_um(sites: Photosites, shapes: Shapes) -> Floats:
    """Return the centroid of each site, (n_site, 2)."""
    return sites.centroid_um if shapes.is_congruent else shapes.centre_um


def _affine_outlines(shapes: Shapes, centre_um: Floats, before: Floats, maps: Floats) -> Outlines:
    """Return the image of each opening: ``M (x - x̄) + x̄ + shift``."""
    from foveasim.sensor.pixel_optics import _kernels

    opening, n_sites = shapes.opening, centre_um.shape[0]
    rings, site_offsets, site_of = opening.ring_offsets, opening.site_offsets, np.arange(n_sites)
    if shapes.is_congruent:
        n_rings, n_vertices = rings.size - 1, rings[-1]
        rings = np.append((rings[:-1] + n_vertices * site_of[:, np.newaxis]).ravel(), n_vertices * n_sites)
        site_offsets, site_of = n_rings * np.arange(n_sites + 1), np.zeros(n_sites, np.int64)
    xy_um = np.empty((rings[-1], 2))
    mean_um = before[:, 1:3] / before[:, :1]
    _kernels.affine_images(
        *_arrays(opening),
        shapes.centre_um,
        mean_um,
        np.ascontiguousarray(maps),
        np.ascontiguousarray(centre_um),
        site_of,
        xy_um,
    )
    return Outlines(freeze(xy_um), rings, site_offsets)

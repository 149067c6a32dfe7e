"""Warnings of photosites outside an image, and of layouts that measure a small part of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from foveasim._core.user_warnings import warn
from foveasim._core.validation import Floats
from foveasim.errors import CoverageWarning
from foveasim.fields import PowerMap
from foveasim.integrate import Integrator
from foveasim.scene import Scene

#: Cameras warn when the layout measures less than this fraction of the width of a photograph.
MIN_PICTURE_FRACTION = 0.25


class Covered(NamedTuple):
    """
    Numbers of sites beyond an image, among them those outside the image circle.

    ``image_um`` and ``layout_um`` are bounds (x_min, y_min, x_max, y_max), µm.
    """

    image_um: tuple[float, float, float, float]
    layout_um: tuple[float, float, float, float]
    n_uncovered: int
    n_outside: int

    @classmethod
    def by(cls, integrator: Integrator) -> Covered:
        """Return the coverage of an integrator's sites by its grid."""
        n_outside = integrator.sites_outside_image_circle.size
        return cls(integrator.grid.bounds_um, integrator.bounds_um, integrator.n_uncovered, n_outside)

    @classmethod
    def union(cls, image_um: tuple[float, float, float, float], parts: Sequence[Covered]) -> Covered:
        """Return the coverage of the sites of all parts by an image."""
        bounds_um = np.array([part.layout_um for part in parts])
        x0, y0 = np.fmin.reduce(bounds_um[:, :2])
        x1, y1 = np.fmax.reduce(bounds_um[:, 2:])
        n_uncovered, n_outside = (sum(part.n_uncovered for part in parts), sum(part.n_outside for part in parts))
        return cls(image_um, (float(x0), float(y0), float(x1), float(y1)), n_uncovered, n_outside)


def warn_of_coverage(source: Scene | PowerMap, covered: Covered, n_sites: int, *, is_moving: bool = False) -> None:
    """
    Warn of sites outside the image, and of a layout that measures a small part of it.

    Sites outside are dark whatever the scene is.
    """
    if covered.n_outside:
        warn(
            f"{covered.n_outside:,} of {n_sites:,} photosites lie outside the image circle of the lens and "
            "are dark; shrink or move the layout, or use a lens model with a larger field",
            CoverageWarning,
        )
    is_photograph = isinstance(source, Scene) and source.is_picture
    fit = source.fit if isinstance(source, Scene) else None
    if fit in ("contain", "width"):
        return
    image_um, layout_um = covered.image_um, covered.layout_um
    n_uncovered = covered.n_uncovered - covered.n_outside
    if n_uncovered:
        remedy = (
            "use fit='cover', or a larger pitch_um or field_of_view_deg"
            if is_photograph
            else "enlarge the scene (pitch_um)"
        )
        warn(
            f"{n_uncovered:,} of {n_sites:,} photosites lie partly or completely outside the image, where "
            f"irradiance is 0: the image measures {_format_extent(image_um)}, the layout {_format_extent(layout_um)}; "
            f"{remedy}, or shrink or move the layout",
            CoverageWarning,
        )
    elif is_photograph and fit is None and not is_moving:
        fraction = size_um(layout_um)[0] / size_um(image_um)[0]
        if fraction < MIN_PICTURE_FRACTION:
            warn(
                f"the layout measures only {100.0 * fraction:.2g} % of the width of the picture: the image measures "
                f"{_format_extent(image_um)}, the layout {_format_extent(layout_um)}; use fit='cover', or a smaller "
                "pitch_um or field_of_view_deg",
                CoverageWarning,
            )


def size_um(bounds_um: Sequence[float]) -> tuple[float, float]:
    """Return width and height of a bounding box."""
    x0_um, y0_um, x1_um, y1_um = bounds_um
    return x1_um - x0_um, y1_um - y0_um


def format_point(xy_um: Sequence[float] | Floats) -> str:
    return f"({xy_um[0]:.4g}, {xy_um[1]:.4g})"


def _format_extent(bounds_um: Sequence[float]) -> str:
    """Return size and position of a bounding box, for messages."""
    width_um, height_um = size_um(bounds_um)
    return (
        f"{width_um:.5g} x {height_um:.5g} µm, from {format_point(bounds_um[:2])} to {format_point(bounds_um[2:])} µm"
    )

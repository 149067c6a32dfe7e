"""Log-polar rasters of photosites, for ordinary convolutional networks."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from torch import Tensor, nn

from foveasim._core.calls import Limits
from foveasim._core.validation import Floats, Ints
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.learn._tensors import Constants
from foveasim.learn.sites.convolution import check_sites
from foveasim.reconstruct import cortical

__all__ = ["Cortical"]

SIDE, RADIUS = Limits(at_least=1, at_most=2**15), Limits(above=0.0)


class Cortical(nn.Module):
    """
    Resampling of photosites onto a log-polar raster.

    Rows are rings, columns are sectors. Convolutions along the sectors should be periodic: pad the sectors with
    ``torch.nn.functional.pad(..., mode="circular")``, and the rings with zeros.

    Parameters
    ----------
    layout : Layout
        With rings of equal sectors, unless ``n_rings`` is given: then each pixel is one site, as for
        :func:`foveasim.reconstruct.cortical`.
    n_rings, n_sectors : int, optional
        Size of the raster for any layout: the values are interpolated linearly between the centroids. Pixels outside of them
        have the value of the nearest site.
    r_min_um, r_max_um : float, optional, µm
        Radii of the innermost and the outermost circle; by default from the square root of the smallest area to the farthest
        centroid.
    centre_um : (x, y), µm

    Attributes
    ----------
    shape : (n_rings, n_sectors)

    Raises
    ------
    ParameterError
        When the layout has no rings of equal sectors, or the radii are not increasing.

    Examples
    --------
    >>> import foveasim as fs
    >>> import torch
    >>> raster = Cortical(
    ...     fs.layout.hexagonal(n_columns=20, n_rows=20, pitch_um=4.0),
    ...     n_rings=12,
    ...     n_sectors=32,
    ... )
    >>> raster(torch.rand(5, 3, 400)).shape
    torch.Size([5, 3, 12, 32])
    """

    def __init__(
        self,
        layout: Layout,
        *,
        n_rings: Annotated[int | None, SIDE] = None,
        n_sectors: Annotated[int | None, SIDE] = None,
        r_min_um: Annotated[float | None, RADIUS] = None,
        r_max_um: Annotated[float | None, RADIUS] = None,
        centre_um: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        super().__init__()
        if (n_rings is None) != (n_sectors is None):
            raise ParameterError("n_sectors", "must be given with 'n_rings'")
        self._n_sites = layout.n_sites
        if n_rings is None or n_sectors is None:
            sites = cortical(layout, np.zeros(layout.n_sites)).sites
            assert sites is not None
            self.shape: tuple[int, int] = sites.shape[0], sites.shape[1]
            index, weight = sites.reshape(-1, 1), np.ones((sites.size, 1))
        else:
            self.shape = n_rings, n_sectors
            distance_um = np.hypot(*(layout.centroid_um - np.array(centre_um)).T)
            low_um = float(np.sqrt(layout.area_um2.min(initial=np.inf))) if r_min_um is None else r_min_um
            high_um = float(distance_um.max(initial=0.0)) if r_max_um is None else r_max_um
            if not low_um < high_um:
                raise ParameterError("r_max_um", "must be larger than 'r_min_um'", high_um, "µm")
            radius_um = low_um * (high_um / low_um) ** ((np.arange(n_rings) + 0.5) / n_rings)
            angle = 2.0 * np.pi * (np.arange(n_sectors) + 0.5) / n_sectors
            at_um = np.stack(
                np.broadcast_arrays(radius_um[:, None] * np.cos(angle), radius_um[:, None] * np.sin(angle)), -1
            )
            index, weight = _interpolation(layout, at_um.reshape(-1, 2) + np.array(centre_um))
        self._constants = Constants(index=index.T.copy(), weight=weight.T.copy())

    def __repr__(self) -> str:
        return f"Cortical({self._n_sites:,} sites to {self.shape[0]} rings of {self.shape[1]} sectors)"

    def forward(self, values: Tensor) -> Tensor:
        """
        Compute the raster.

        Parameters
        ----------
        values : (..., n_channel, n_site) tensor

        Returns
        -------
        (..., n_channel, n_rings, n_sectors) tensor
            The innermost ring first.
        """
        rows = check_sites("values", values, None, self._n_sites)
        indices, weights = self._constants.get("index", rows), self._constants.get("weight", rows)
        found = rows.index_select(2, indices[0]) * weights[0]
        for index, weight in zip(indices[1:], weights[1:], strict=True):
            found = found + rows.index_select(2, index) * weight
        return found.reshape(*values.shape[:-1], *self.shape)


def _interpolation(layout: Layout, at_um: Floats) -> tuple[Ints, Floats]:
    """Return three sites and their weights for each position."""
    from scipy.spatial import Delaunay, cKDTree

    centroid_um = layout.centroid_um
    nearest = np.asarray(cKDTree(centroid_um).query(at_um)[1])
    index, weight = np.repeat(nearest[:, np.newaxis], 3, axis=1), np.tile((1.0, 0.0, 0.0), (at_um.shape[0], 1))
    if layout.n_sites < 3:
        return index, weight
    triangles = Delaunay(centroid_um)
    of_point = triangles.find_simplex(at_um)
    inside = np.flatnonzero(of_point >= 0)
    transform = triangles.transform[of_point[inside]]
    first = np.einsum("nij,nj->ni", transform[:, :2], at_um[inside] - transform[:, 2])
    barycentric = np.column_stack((first, 1.0 - first.sum(axis=1)))
    is_valid = np.isfinite(barycentric).all(axis=1)
    index[inside[is_valid]] = triangles.simplices[of_point[inside[is_valid]]]
    weight[inside[is_valid]] = barycentric[is_valid]
    return index.astype(np.int64), weight

"""Coarser photosites."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor, nn

from foveasim._core.validation import Ints
from foveasim.errors import ParameterError
from foveasim.layout import Layout, merge
from foveasim.learn._tensors import Constants
from foveasim.learn.sites.convolution import check_sites

__all__ = ["SitePool"]


class SitePool(nn.Module):
    """
    Pooling over groups of photosites.

    Parameters
    ----------
    layout : Layout
        Photosites of the input.
    groups : (n_site,) int, optional
        Label of the group of each site. By default, neighbours are merged twice in pairs, which gives about a quarter of the
        photosites: each site with the free neighbour with which it shares the longest edge, smallest sites first.
    reduce : {"mean", "max", "sum"}
        The mean is weighted by the areas.

    Attributes
    ----------
    layout : Layout
        Merged photosites, in the order of the labels: the input of the next :class:`SiteConv`.
    groups : (n_site,) int64
        Index of the merged site of each site.

    Raises
    ------
    ParameterError
        When there is not one label per site.

    Examples
    --------
    >>> import foveasim as fs
    >>> import torch
    >>> pool = SitePool(fs.layout.grid(n_x=4, n_y=4, pitch_um=2.0))
    >>> pool.layout.n_sites, pool(torch.ones(1, 3, 16)).shape
    (4, torch.Size([1, 3, 4]))
    """

    def __init__(
        self, layout: Layout, groups: ArrayLike | None = None, *, reduce: Literal["mean", "max", "sum"] = "mean"
    ) -> None:
        super().__init__()
        if groups is None:
            first = merged_pairs(layout)
            coarse = merge(layout, first)
            labels = merged_pairs(coarse)[first]
        else:
            labels = np.asarray(groups)
            if labels.shape != (layout.n_sites,) or labels.dtype.kind not in "iu":
                raise ParameterError(
                    "groups",
                    f"must be {layout.n_sites} integers, one per site, got {labels.dtype} of shape {labels.shape}",
                )
        self.groups: Ints = np.unique(labels, return_inverse=True)[1].ravel().astype(np.int64)
        self.layout: Layout = merge(layout, self.groups)
        self.reduce = reduce
        self._n_sites = layout.n_sites
        area_um2 = np.bincount(self.groups, layout.area_um2)
        self._constants = Constants(groups=self.groups, weight=layout.area_um2 / area_um2[self.groups])

    def __repr__(self) -> str:
        return f"SitePool({self._n_sites:,} to {self.layout.n_sites:,} sites, reduce='{self.reduce}')"

    def forward(self, values: Tensor) -> Tensor:
        """
        Compute the values of the merged photosites.

        Parameters
        ----------
        values : (..., n_channel, n_site) tensor

        Returns
        -------
        (..., n_channel, n_merged) tensor
        """
        rows = check_sites("values", values, None, self._n_sites)
        index = self._constants.get("groups", rows)
        if self.reduce == "mean":
            rows = rows * self._constants.get("weight", rows)
        shape = *rows.shape[:2], self.layout.n_sites
        if self.reduce == "max":
            found = rows.new_zeros(shape).scatter_reduce(2, index.expand(rows.shape), rows, "amax", include_self=False)
        else:
            found = rows.new_zeros(shape).index_add(2, index, rows)
        return found.reshape(*values.shape[:-1], self.layout.n_sites)


def merged_pairs(layout: Layout) -> Ints:
    """Return the index of the pair of each site; sites without a free neighbour remain alone."""
    shared, area_um2 = layout.adjacency().tocsr(), layout.area_um2
    # Small sites first; among equal ones in their order, so that the result does not depend on rounding.
    order = np.lexsort((np.arange(layout.n_sites), np.round(np.log(area_um2), 6)))
    partner = np.full(layout.n_sites, -1)
    for site in order.tolist():
        if partner[site] >= 0:
            continue
        entries = slice(shared.indptr[site], shared.indptr[site + 1])
        neighbours, lengths_um = shared.indices[entries], shared.data[entries]
        is_free = (partner[neighbours] < 0) & (neighbours != site)
        partner[site] = site
        if is_free.any():
            free, longest = neighbours[is_free], np.round(lengths_um[is_free], 6)
            chosen = int(free[np.lexsort((free, area_um2[free].round(6), -longest))[0]])
            partner[site], partner[chosen] = chosen, site
    return np.unique(np.minimum(np.arange(layout.n_sites), partner), return_inverse=True)[1].ravel()

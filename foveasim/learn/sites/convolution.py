"""Convolution over the nearest photosites."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
import torch
from torch import Tensor, nn

from foveasim._core.calls import Limits
from foveasim.errors import ParameterError
from foveasim.layout import Layout
from foveasim.layout.graph import Frame, local_offsets, nearest_sites
from foveasim.learn._tensors import Constants, check_tensor

__all__ = ["SiteConv"]

CHANNELS, KERNEL, NEIGHBOURS = Limits(at_least=1), Limits(at_least=1, at_most=15), Limits(at_least=1)
DILATION = Limits(above=0.0)
#: Smallest sum of the interpolation weights of a tap that is normalised to 1; taps further outside the layout fade to 0.
SMALLEST_SUM = 0.25


class SiteConv(nn.Module):
    """
    Convolution over the k nearest photosites.

    Weights are a function of the position in the local scale.

    Parameters
    ----------
    in_channels, out_channels : int
    layout : Layout
        Photosites of the input.
    kernel_size : int
        Number of taps along each side of the kernel, an odd number.
    n_neighbours : int, optional
        Number of nearest photosites, the site itself included; by default the number of taps.
    outputs : Layout, optional
        Photosites of the output, such as the coarser ones of a :class:`SitePool`; by default those of the input.
    dilation : float
        Distance of the taps, in units of the square root of the area of the output site.
    frame : {"image", "radial"}
        Orientation of the kernel: that of the layout, or outwards from the centre, which makes networks on log-polar sites
        equivariant to rotations.
    centre_um : (x, y), µm
        Centre of radial frames.
    bias : bool

    Attributes
    ----------
    weight : Parameter (out_channels, in_channels, kernel_size, kernel_size)
        Rows from the highest y, as the kernel of a :class:`torch.nn.Conv2d` for pictures.
    bias : Parameter (out_channels,) or None

    Raises
    ------
    ParameterError
        When the kernel size is even, or the layout has fewer photosites than neighbours.

    Notes
    -----
    The weight of a neighbour is the kernel, interpolated bilinearly at its position. The interpolation weights of a tap are
    normalised to a sum of 1, so that a constant input has the same output everywhere inside the layout; taps outside of it are
    0, as zero padding. On a square grid, the layer is a :class:`torch.nn.Conv2d` with ``padding="same"``.

    Convolution over k nearest neighbours with the kernel in a local frame of reference is that of FOVI: N. M. Blauch,
    G. A. Alvarez, T. Konkle, "FOVI: a biologically-inspired foveated interface for deep vision models", ICML 2026,
    arXiv:2602.03766.

    Examples
    --------
    >>> import foveasim as fs
    >>> layout = fs.layout.hexagonal(n_columns=8, n_rows=8, pitch_um=4.0)
    >>> SiteConv(3, 16, layout)(torch.rand(5, 3, 64)).shape
    torch.Size([5, 16, 64])
    """

    def __init__(
        self,
        in_channels: Annotated[int, CHANNELS],
        out_channels: Annotated[int, CHANNELS],
        layout: Layout,
        kernel_size: Annotated[int, KERNEL] = 3,
        *,
        n_neighbours: Annotated[int | None, NEIGHBOURS] = None,
        outputs: Layout | None = None,
        dilation: Annotated[float, DILATION] = 1.0,
        frame: Frame = "image",
        centre_um: tuple[float, float] = (0.0, 0.0),
        bias: bool = True,
    ) -> None:
        super().__init__()
        if kernel_size % 2 == 0:
            raise ParameterError("kernel_size", "must be odd", kernel_size)
        n = kernel_size**2 if n_neighbours is None else n_neighbours
        target = layout if outputs is None else outputs
        position_um, scale_um = target.centroid_um, dilation * np.sqrt(target.area_um2)
        index = nearest_sites(layout, position_um, n)
        offset_um = layout.centroid_um[index] - position_um[:, np.newaxis]
        offset = local_offsets(offset_um, position_um[:, np.newaxis], scale_um[:, np.newaxis], frame, centre_um)
        taps = np.arange(kernel_size) - kernel_size // 2
        along_x, along_y = (
            np.maximum(1.0 - np.abs(part[..., np.newaxis] - taps), 0.0) for part in np.moveaxis(offset, -1, 0)
        )
        # Rows of the kernel from the highest y.
        interpolation = (along_y[..., ::-1, np.newaxis] * along_x[..., np.newaxis, :]).reshape(*index.shape, -1)
        interpolation /= np.maximum(interpolation.sum(axis=1, keepdims=True), SMALLEST_SUM)
        self._constants = Constants(
            index=index.ravel(), interpolation=np.ascontiguousarray(interpolation.swapaxes(1, 2))
        )
        self._shape: tuple[int, int] = index.shape
        self._n_sites = layout.n_sites
        self.in_channels, self.out_channels, self.kernel_size = in_channels, out_channels, kernel_size
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, kernel_size, kernel_size))
        self.bias = nn.Parameter(torch.empty(out_channels)) if bias else None
        self.reset_parameters()

    def __repr__(self) -> str:
        return (
            f"SiteConv({self.in_channels}, {self.out_channels}, {self._n_sites:,} to {self._shape[0]:,} sites, "
            f"kernel_size={self.kernel_size}, n_neighbours={self._shape[1]})"
        )

    def reset_parameters(self) -> None:
        """Draw weights and bias as :class:`torch.nn.Conv2d`."""
        nn.init.kaiming_uniform_(self.weight, a=math.sqrt(5.0))
        if self.bias is not None:
            limit = 1.0 / math.sqrt(self.in_channels * self.kernel_size**2)
            nn.init.uniform_(self.bias, -limit, limit)

    def forward(self, values: Tensor) -> Tensor:
        """
        Compute the convolution.

        Parameters
        ----------
        values : (..., in_channels, n_site) tensor

        Returns
        -------
        (..., out_channels, n_output) tensor
        """
        rows = check_sites("values", values, self.in_channels, self._n_sites)
        n_out, k = self._shape
        gathered = rows.transpose(1, 2).index_select(1, self._constants.get("index", rows))
        taps = torch.matmul(
            self._constants.get("interpolation", rows), gathered.reshape(rows.shape[0], n_out, k, self.in_channels)
        )
        weight = self.weight.flatten(2).transpose(1, 2).flatten(1)
        found = nn.functional.linear(
            taps.flatten(2), weight.to(taps.dtype), None if self.bias is None else self.bias.to(taps.dtype)
        )
        return found.transpose(1, 2).reshape(*values.shape[:-2], self.out_channels, n_out)


def check_sites(name: str, values: object, n_channels: int | None, n_sites: int) -> Tensor:
    """Return values (..., n_channel, n_site) as (n, n_channel, n_site), after validation."""
    if not isinstance(values, Tensor) or values.ndim < 2:
        check_tensor(name, values, (n_channels, n_sites), " or (..., n_channel, n_site)", any_device=True)
    assert isinstance(values, Tensor)
    expected = (*([None] * (values.ndim - 2)), n_channels, n_sites)
    check_tensor(name, values, expected, ", with one row per channel and one column per site", any_device=True)
    return values.reshape(-1, *values.shape[-2:])

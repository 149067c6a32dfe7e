"""
Crosstalk: diffusion of charge to neighbours before collection, and inter-pixel capacitance in the readout.

Diffusion mixes expectations before the draw: photosites stay Poisson-distributed and uncorrelated. Inter-pixel capacitance
mixes drawn charges: neighbours become correlated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.threads import each, thread_count
from foveasim._core.validation import (
    Floats,
    Ints,
    as_numbers,
    check_choice,
    check_length_um,
    check_number,
    check_pitch_um,
    finite_array,
)
from foveasim.errors import ParameterError, SimulationError
from foveasim.sensor.blocks import BLOCK_SITES
from foveasim.sensor.effects.contract import Effect, Sites, Stage

if TYPE_CHECKING:
    from scipy.sparse import csr_array

__all__ = ["CrosstalkOperator", "Diffusion", "InterPixelCapacitance", "KernelCrosstalk", "Neighbourhood"]

#: What a site may lose in one exchange: with more, charge would swing to and fro between neighbours.
LARGEST_SHARE = 0.5
#: Exchanges beyond this take seconds a frame for a million sites.
MAX_EXCHANGES = 1000
#: Spreads of up to this fraction of a step cross one border at most, to float64; for longer ones a Fourier series is short.
SHORT_SPREAD = 0.125
#: Terms of that series: the next one is below 1e-16.
N_TERMS = 10
#: No spread is larger; the squares of greater ones leave float64.
LARGEST_SPREAD_UM = 1e4
#: Sum of a kernel above 1 that is rounding of its entries.
KERNEL_ROUNDING = 1e-9
#: Sites of a grid differ by at most this share in area: rounding to a manufacturing grid.
AREA_ROUNDING = 0.02
#: Steps and places of a grid are off by at most this fraction of the pitch.
PLACE_ROUNDING = 0.05
#: Coordinates nearer than this fraction of a site's side are one row or column.
SAME_LINE = 0.02


class Neighbourhood(Protocol):
    """Photosites that know their neighbours, as crosstalk needs them; :class:`foveasim.Layout` is one."""

    @property
    def n_sites(self) -> int:
        """Number of sites."""

    @property
    def area_um2(self) -> Floats:
        """Area of each site, (n_site,) µm²."""

    @property
    def centroid_um(self) -> Floats:
        """Centre of area of each site, (n_site, 2) µm."""

    def adjacency(self, *, max_gap_um: float | None = None) -> csr_array[Any]:
        """Lengths of the edges that sites share, (n_site, n_site) µm, symmetric, the diagonal empty."""


@dataclass(frozen=True, eq=False, repr=False)
class CrosstalkOperator:
    """
    Crosstalk compiled for a layout: make it once, apply it to every frame.

    Made by ``compile()`` of :class:`Diffusion`, :class:`KernelCrosstalk` and :class:`InterPixelCapacitance`.

    Parameters
    ----------
    matrix : csr_array (n_site, n_site) float64
        Share ``[j, i]`` of the charge of site i that one exchange brings to site j. Columns sum to 1, unless charge is lost.
    n_steps : int
        How often it is applied.
    """

    matrix: csr_array[Any]
    n_steps: int = 1

    def __repr__(self) -> str:
        return f"CrosstalkOperator({self.matrix.shape[0]} sites, {self.matrix.nnz} shares, {self.n_steps} exchanges)"

    def apply(self, charge_e: ArrayLike, *, n_threads: int | None = None) -> Floats:
        """
        Charges after crosstalk.

        Parameters
        ----------
        charge_e : (..., n_site), e-
            Expected charges or drawn ones, or anything that mixes as they do. Not changed.
        n_threads : int, optional
            All cores by default.

        Returns
        -------
        charge_e : (..., n_site) float64, e-

        Raises
        ------
        ParameterError
            When there is not one charge a site.

        Notes
        -----
        Cost: one sparse product an exchange, 5 ns per site for hexagons.
        """
        # A row per site: sparse matrices multiply columns.
        columns = np.moveaxis(self._per_site("charge_e", charge_e), -1, 0)
        mixed = columns.reshape(columns.shape[0], -1) if columns.ndim > 1 else columns
        for _ in range(self.n_steps):
            mixed = self._product(mixed, n_threads)
        return np.ascontiguousarray(np.moveaxis(mixed.reshape(columns.shape), 0, -1))

    def _product(self, columns: Floats, n_threads: int | None) -> Floats:
        """The matrix times columns, in blocks of rows."""
        if len(self._row_blocks) < 2:
            return np.asarray(self.matrix @ columns)
        out = np.empty_like(columns)

        def multiply(block: tuple[slice, csr_array[Any]]) -> None:
            rows, matrix = block
            out[rows] = matrix @ columns

        each(multiply, self._row_blocks, thread_count(n_threads))
        return out

    @cached_property
    def _row_blocks(self) -> list[tuple[slice, csr_array[Any]]]:
        starts = range(0, self.matrix.shape[0], BLOCK_SITES)
        return [(rows := slice(start, start + BLOCK_SITES), self.matrix[rows]) for start in starts]

    def variance(self, variance: ArrayLike) -> Floats:
        """
        Variances after a mixing of independent sites, as for a prediction without a draw.

        Parameters
        ----------
        variance : (..., n_site)
            Before it, in the square of any unit.

        Returns
        -------
        variance : (..., n_site) float64
            ``sum_i matrix[j, i]**2 * variance[i]``, in the same unit.

        Raises
        ------
        ParameterError
            When there is not one variance a site.
        SimulationError
            For more than one exchange: those of diffusion, which mixes expectations and no variances.
        """
        if self.n_steps != 1:
            raise SimulationError(
                f"variances pass one exchange only, and this operator has {self.n_steps}; diffusion comes before the draw"
            )
        values = self._per_site("variance", variance)
        columns = np.moveaxis(values, -1, 0)
        mixed = self._squared @ columns.reshape(columns.shape[0], -1)
        return np.ascontiguousarray(np.moveaxis(mixed.reshape(columns.shape), 0, -1))

    @cached_property
    def _squared(self) -> csr_array[Any]:
        return self.matrix.power(2)

    def _per_site(self, name: str, values: ArrayLike) -> Floats:
        array = as_numbers(name, values)
        n_sites = self.matrix.shape[0]
        if array.ndim == 0 or array.shape[-1] != n_sites:
            raise ParameterError(name, f"must have one value for each of the {n_sites} sites, got {array.shape}")
        return array


class _Crosstalk(Effect):
    """Crosstalk in the chain: compiled for the sites at the first use."""

    is_temporal: ClassVar[bool] = False
    is_local: ClassVar[bool] = False

    def compiled_for(self, sites: Sites) -> CrosstalkOperator:
        """Return the operator for all sites of the layout."""
        raise NotImplementedError

    def apply(self, values: Floats, *, sites: Sites, rng: np.random.Generator) -> Floats:
        """Return charges after crosstalk, (n_site,)."""
        _ = rng
        return sites.once(self, self.compiled_for).apply(values, n_threads=sites.n_threads)

    def moments(self, mean: Floats, variance: Floats, *, sites: Sites) -> tuple[Floats, Floats]:
        """Return moments of independent charges after crosstalk, (..., n_site)."""
        operator = sites.once(self, self.compiled_for)
        mean, variance = (
            np.broadcast_to(part, np.broadcast_shapes(np.shape(part), (sites.n_sites,))) for part in (mean, variance)
        )
        return operator.apply(mean), operator.variance(variance) if np.any(variance) else np.zeros(1)


# -- before the draw --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Diffusion(_Crosstalk):
    """
    Charge that wanders sideways while it drifts to its photosite: an exchange between neighbours of any shape.

    Parameters
    ----------
    spread_um : float, µm
        Root mean square of an electron's sideways way along one axis until it is collected; ``sqrt(2 D t)`` for a
        diffusivity D and a time t. 0 for none.
    max_gap_um : float, optional, µm
        Sites that face each other across a gap of up to this width are neighbours, and exchange charge as if they touched;
        by default only those that share an edge.

    Raises
    ------
    ParameterError
        When a number is negative or not finite, or the spread no length on a sensor.

    Notes
    -----
    Of charge that fills the plane evenly with a density n, a Gaussian spread carries ``n * spread / sqrt(2 pi)`` over each
    unit of length of a straight border, either way. So a site of area A passes to a neighbour with which it shares an edge
    of length e the share

    ::

        share = e w / A,    w = spread / sqrt(2 pi)          spread well below the distance d of the two centres
                            w = spread² / (2 d) + d / 12     spread above d/2: Fick's law, flow down the gradient

    and in general ``w = (d / 2) E[g(spread Z / d)]``, where Z is a standard normal number and g joins the squares of the
    integers by straight lines: the flow for which an evenly lit site in a square grid spreads to the variance along an
    axis that it has in truth, ``d² E[g] = spread² + d²/6`` for spreads above d/2 and ``0.798 spread d`` for small ones.

    Charge is conserved: what has no neighbour to go to stays. An even light stays even on any tiling, whatever the sizes of
    its sites, as ``e w`` is the same both ways.

    What goes over a corner is left out of a single exchange: it is of the order of the square of a share. No site may give
    more than half of its charge at once; for long spreads the exchange is therefore divided into ``n`` equal ones,
    ``(I + L / n)^n``, near ``exp(L)`` and of the same variance.

    Examples
    --------
    >>> import foveasim as fs
    >>> pair = fs.layout.grid(n_x=2, n_y=1, pitch_um=4.0)
    >>> Diffusion.from_neighbour_fraction(0.2, pitch_um=4.0).compile(pair).apply([1000.0, 0.0]).round(9).tolist()
    [950.0, 50.0]
    """

    name: ClassVar[str] = "crosstalk"
    stage: ClassVar[Stage] = "expected"

    spread_um: float
    max_gap_um: float | None = None

    def compiled_for(self, sites: Sites) -> CrosstalkOperator:
        """Return the operator for all sites of the layout."""
        return self.compile(sites.layout)

    def __post_init__(self) -> None:
        spread_um = check_number("spread_um", self.spread_um, at_least=0.0, at_most=LARGEST_SPREAD_UM)
        object.__setattr__(self, "spread_um", spread_um)
        object.__setattr__(self, "max_gap_um", _gap_um(self.max_gap_um))

    @classmethod
    def from_neighbour_fraction(
        cls, neighbour_fraction: float, *, pitch_um: float, max_gap_um: float | None = None
    ) -> Diffusion:
        """
        Diffusion as measured on square pixels of the same process, for a layout of any shapes.

        Parameters
        ----------
        neighbour_fraction : float
            Fraction of its charge that one of these pixels loses to its four neighbours together, at most one half.
        pitch_um : float, µm
            Of these pixels.
        max_gap_um : float, optional, µm
            As for the class.

        Raises
        ------
        ParameterError
            When a number is out of range.
        """
        from scipy.optimize import brentq

        share = check_number("neighbour_fraction", neighbour_fraction, at_least=0.0, at_most=LARGEST_SHARE)
        pitch_um = check_length_um("pitch_um", pitch_um)
        # A spread of a pitch loses far more than half.
        steps = float(brentq(lambda s: 2.0 * float(_squared_steps(np.array(s))) - share, 0.0, 1.0, xtol=1e-15))
        return cls(spread_um=steps * pitch_um, max_gap_um=max_gap_um)

    def compile(self, layout: Neighbourhood, *, shared_um: csr_array[Any] | None = None) -> CrosstalkOperator:
        """
        The exchange compiled for a layout.

        Parameters
        ----------
        layout : Layout
        shared_um : csr_array (n_site, n_site), optional, µm
            Lengths of shared edges, where they are known already; ``layout.adjacency()`` by default, which is most of the
            cost.

        Returns
        -------
        CrosstalkOperator

        Raises
        ------
        ParameterError
            When the layout knows no neighbours, or the spread is beyond all reason for its smallest sites.
        SimulationError
            When no two sites share an edge.
        """
        shared_um = _shared_um(layout, shared_um, self.max_gap_um)
        site, neighbour = shared_um.indices, _rows(shared_um)
        centre_um = layout.centroid_um
        distance_um = np.hypot(*np.moveaxis(centre_um[site] - centre_um[neighbour], -1, 0))
        if distance_um.size:
            # Sites in holes of others have the same centre; how deep sites lie behind their edges tells their distance.
            edges_um = shared_um.sum(axis=1)
            depth_um = layout.area_um2 / np.where(edges_um > 0.0, edges_um, 1.0)
            distance_um = np.maximum(distance_um, 0.5 * (depth_um[site] + depth_um[neighbour]))
        width_um = 0.5 * distance_um * _squared_steps(self.spread_um / distance_um)
        matrix = _like(shared_um, shared_um.data * width_um / layout.area_um2[site])
        loss = _column_sums(matrix)
        largest = float(loss.max(initial=0.0))
        if not largest <= LARGEST_SHARE * MAX_EXCHANGES:
            smallest = int(np.argmax(loss))
            raise ParameterError(
                "spread_um",
                f"is too long for site {smallest} of only {layout.area_um2[smallest]:.3g} µm²",
                self.spread_um,
                "µm",
                f"beyond {MAX_EXCHANGES} exchanges a site keeps nothing of its own",
            )
        # Fractions of exactly one half, computed, are that.
        n_steps = max(1, math.ceil(largest / LARGEST_SHARE - 1e-9))
        return CrosstalkOperator(_with_rest(matrix, loss, n_steps), n_steps)


@dataclass(frozen=True, kw_only=True)
class KernelCrosstalk(_Crosstalk):
    """
    The same few shares around every site of a rectangular grid: a convolution, as in the paper.

    Parameters
    ----------
    kernel : (n_row, n_column), odd numbers
        What becomes of a charge of 1 in its middle: ``kernel[j, i]`` goes ``i - n_column // 2`` columns to the right and
        ``j - n_row // 2`` rows **up**; row 0 is the lowest, as in every array here. Fractions of at least 0 that sum to at most
        1; what is missing to 1 is lost in the silicon.
    border : {"kept", "lost"}
        What becomes of charge that would go where there is no site: it stays where it is, or is lost.
    pitch_um : number or (pitch_x, pitch_y), optional, µm
        Of the grid, where a crop has too few sites to show it; by default the smallest step within a row, and within a
        column.

    Raises
    ------
    ParameterError
        When the kernel has an even side, or a share or the sum is out of range.

    Notes
    -----
    On a full grid ``border="lost"`` is ``scipy.ndimage.convolve(picture, kernel, mode="constant")``, row 0 lowest in both.
    No kernel is offered as a default: those published belong to one pixel and one wavelength. Measure one, or take
    :class:`Diffusion`, which also serves sites of other shapes.

    Examples
    --------
    >>> import foveasim as fs
    >>> upwards = KernelCrosstalk(kernel=((0.0,), (0.75,), (0.25,)))
    >>> upwards.compile(fs.layout.grid(n_x=1, n_y=3, pitch_um=2.0)).apply([100.0, 0.0, 8.0]).tolist()
    [75.0, 25.0, 8.0]
    """

    name: ClassVar[str] = "crosstalk"
    stage: ClassVar[Stage] = "expected"

    kernel: Sequence[Sequence[float]]
    border: Literal["kept", "lost"] = "kept"
    pitch_um: float | tuple[float, float] | None = None

    def compiled_for(self, sites: Sites) -> CrosstalkOperator:
        """Return the operator for all sites of the layout."""
        return self.compile(sites.layout)

    def __post_init__(self) -> None:
        kernel = finite_array("kernel", self.kernel, ndim=2, at_least=0.0)
        if any(n % 2 == 0 for n in kernel.shape):
            raise ParameterError(
                "kernel", f"must have odd numbers of rows and columns, a middle, got the shape {kernel.shape}"
            )
        if kernel.sum() > 1.0 + KERNEL_ROUNDING:
            raise ParameterError("kernel", "must sum to at most 1: charge does not grow", float(kernel.sum()))
        object.__setattr__(self, "kernel", tuple(tuple(float(share) for share in row) for row in kernel))
        check_choice("border", self.border, ("kept", "lost"))
        if self.pitch_um is not None:
            object.__setattr__(self, "pitch_um", check_pitch_um("pitch_um", self.pitch_um))

    def compile(self, layout: Neighbourhood) -> CrosstalkOperator:
        """
        The convolution compiled for a layout: any sites of a grid, in any order, with any of them missing.

        Parameters
        ----------
        layout : Layout

        Returns
        -------
        CrosstalkOperator

        Raises
        ------
        ParameterError
            When the argument is no layout.
        SimulationError
            When its sites are no part of a grid along the axes.
        """
        from scipy.sparse import coo_array

        _require_layout(layout)
        n_sites = layout.n_sites
        column, row = _grid_places(layout, self.pitch_um)
        kernel = np.array(self.kernel)
        half_y, half_x = kernel.shape[0] // 2, kernel.shape[1] // 2
        # Places as one number, with room at the ends of rows, so that no row runs over into the next.
        stride = int(column.max(initial=0)) + 1 + 2 * half_x
        place = row * stride + column
        order = np.argsort(place, kind="stable")
        ordered = place[order]
        if n_sites and (ordered[1:] == ordered[:-1]).any():
            twin = order[int(np.flatnonzero(ordered[1:] == ordered[:-1])[0]) + 1]
            raise SimulationError(f"site {twin} lies instead of another, so the layout is no grid; {_OTHER_WAY}")
        source, target, share = [], [], []
        kept = np.zeros(n_sites)
        for j, i in np.argwhere(kernel > 0.0):
            wanted = ordered + (j - half_y) * stride + (i - half_x)
            at = np.minimum(np.searchsorted(ordered, wanted), max(n_sites - 1, 0))
            is_there = ordered[at] == wanted
            source.append(order[is_there])
            target.append(order[at[is_there]])
            share.append(np.full(source[-1].size, kernel[j, i]))
            kept[order[~is_there]] += kernel[j, i]
        if self.border == "kept":
            is_kept = np.flatnonzero(kept)
            source, target, share = [*source, is_kept], [*target, is_kept], [*share, kept[is_kept]]
        if not source:
            return CrosstalkOperator(coo_array((n_sites, n_sites)).tocsr())
        pairs = (np.concatenate(target).astype(np.int32), np.concatenate(source).astype(np.int32))
        return CrosstalkOperator(coo_array((np.concatenate(share), pairs), shape=(n_sites, n_sites)).tocsr())


# -- after the draw ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class InterPixelCapacitance(_Crosstalk):
    """
    Capacitances between neighbouring readout nodes: a part of each charge is read at its neighbours.

    Parameters
    ----------
    neighbour_fraction : float
        Fraction of a site's charge that appears at a neighbour with a shared edge of length ``edge_um``; at others in
        proportion to their shared edges. Hybrid near-infrared arrays (H2RG) have from 0.007 to 0.015 (Donlon, Ninkov and Baum
        2018, arXiv:1805.09413).
    edge_um : float, optional, µm
        The length of that edge; by default the median of the layout's, so that it is any edge of a regular tiling.
    max_gap_um : float, optional, µm
        Sites that face each other across a gap of up to this width are neighbours; by default only those that share an edge.

    Raises
    ------
    ParameterError
        When the share is not from 0 to 1/2, or a length is out of range.

    Notes
    -----
    Two nodes that face each other along a length e have a coupling capacitance ``k e`` between them. With a capacitance C to
    ground the voltages of charges q obey ``C V_i + sum_j k e_ij (V_i - V_j) = q_i``; to first order in ``k e / C`` the reading
    ``C V`` is

    ::

        q_i + sum_j a_ij (q_j - q_i),    a_ij = neighbour_fraction e_ij / edge_um

    which is symmetric and keeps the sum of all readings: no electron moves, its field is seen elsewhere. Read noise of later
    amplifiers is not coupled and comes after. Independent charges of variance v get the covariance ``K diag(v) K^T``, for even
    light ``2 a v`` between neighbours (Moore, Ninkov and Forrest, Opt. Eng. 45, 076402, 2006: which makes a conversion gain
    from variances wrong by about ``1 - 2 sum_j a``).

    Examples
    --------
    >>> import foveasim as fs
    >>> row = fs.layout.grid(n_x=3, n_y=1, pitch_um=4.0)
    >>> InterPixelCapacitance(neighbour_fraction=0.01).compile(row).apply([0, 5000, 0]).tolist()
    [50.0, 4900.0, 50.0]
    """

    name: ClassVar[str] = "ipc"
    stage: ClassVar[Stage] = "charge"

    neighbour_fraction: float
    edge_um: float | None = None
    max_gap_um: float | None = None

    def compiled_for(self, sites: Sites) -> CrosstalkOperator:
        """Return the operator for all sites of the layout, with the capacitances of their sense nodes."""
        return self.compile(sites.layout, capacitance_f=sites.capacitance_f if sites.capacitance_f.size > 1 else None)

    def __post_init__(self) -> None:
        share = check_number("neighbour_fraction", self.neighbour_fraction, at_least=0.0, at_most=LARGEST_SHARE)
        object.__setattr__(self, "neighbour_fraction", share)
        if self.edge_um is not None:
            object.__setattr__(self, "edge_um", check_length_um("edge_um", self.edge_um))
        object.__setattr__(self, "max_gap_um", _gap_um(self.max_gap_um))

    def compile(
        self,
        layout: Neighbourhood,
        *,
        capacitance_f: ArrayLike | None = None,
        shared_um: csr_array[Any] | None = None,
    ) -> CrosstalkOperator:
        """
        The coupling compiled for a layout.

        Parameters
        ----------
        layout : Layout
        capacitance_f : number or (n_site,), optional, F
            Capacitance of every node, where they differ: the share is then that of a node with their median, the smaller
            ones show more of their charge elsewhere, and the sum of the charges that are read stays.
        shared_um : csr_array (n_site, n_site), optional, µm
            Lengths of shared edges, where they are known already; ``layout.adjacency()`` by default.

        Returns
        -------
        CrosstalkOperator

        Raises
        ------
        ParameterError
            When the layout knows no neighbours, there is not one capacitance a site, or a site would show more than half
            of its charge elsewhere.
        SimulationError
            When no two sites share an edge.
        """
        shared_um = _shared_um(layout, shared_um, self.max_gap_um)
        edge_um = self.edge_um
        if edge_um is None:
            edge_um = float(np.median(shared_um.data)) if shared_um.nnz else 1.0
        ratio = np.ones(layout.n_sites)
        if capacitance_f is not None and layout.n_sites:
            node_f = finite_array("capacitance_f", capacitance_f, above=0.0)
            if node_f.shape not in ((), (layout.n_sites,)):
                raise ParameterError(
                    "capacitance_f",
                    f"must be one number, or one for each of the {layout.n_sites} sites, got the shape {node_f.shape}",
                )
            ratio = np.median(node_f) / np.broadcast_to(node_f, layout.n_sites)
        matrix = _like(shared_um, shared_um.data * (self.neighbour_fraction / edge_um) * ratio[shared_um.indices])
        loss = _column_sums(matrix)
        largest = float(loss.max(initial=0.0))
        if largest > LARGEST_SHARE * (1.0 + KERNEL_ROUNDING):
            raise ParameterError(
                "neighbour_fraction",
                f"makes site {int(np.argmax(loss))} show {largest:.3g} of its charge at its neighbours, more than half",
                self.neighbour_fraction,
                hint="this is a law for weak coupling",
            )
        return CrosstalkOperator(_with_rest(matrix, loss, 1))


# -- parts ------------------------------------------------------------------------------------------------------------

_OTHER_WAY = "take Diffusion, which serves sites of any shape"


def _gap_um(max_gap_um: object) -> float | None:
    return None if max_gap_um is None else check_number("max_gap_um", max_gap_um, at_least=0.0)


def _require_layout(layout: object) -> None:
    if not all(hasattr(layout, name) for name in ("n_sites", "area_um2", "centroid_um", "adjacency")):
        raise ParameterError("layout", f"must be a Layout, got a {type(layout).__name__}")


def _shared_um(layout: Neighbourhood, shared_um: csr_array[Any] | None, max_gap_um: float | None) -> csr_array[Any]:
    """Lengths of shared edges with small indices, checked."""
    from scipy.sparse import csr_array, issparse

    _require_layout(layout)
    n_sites = layout.n_sites
    if shared_um is None:
        shared_um = layout.adjacency(max_gap_um=max_gap_um)
    elif not issparse(shared_um) or shared_um.shape != (n_sites, n_sites):
        raise ParameterError(
            "shared_um", f"must be a sparse array of the shape {(n_sites, n_sites)}, as layout.adjacency() gives"
        )
    shared_um = csr_array(shared_um)
    if n_sites > 1 and shared_um.nnz == 0:
        raise SimulationError(
            "no two sites of the layout share an edge, so nothing can cross; for sites behind trenches give 'max_gap_um', the "
            "width of a trench"
        )
    if shared_um.nnz < np.iinfo(np.int32).max:
        small = (shared_um.data, shared_um.indices.astype(np.int32), shared_um.indptr.astype(np.int32))
        shared_um = csr_array(small, shape=(n_sites, n_sites))
    return shared_um


def _squared_steps(spread: Floats) -> Floats:
    """
    Mean square of the steps from a cell to that where its charge ends, in a row of cells; the spread in cells.

    Charge starts anywhere in a cell: on a way z it makes whole steps whose mean square is g(z), the straight lines through
    the squares of the integers. ``g(z) = |z|`` up to 1, and ``z² + f (1 - f)`` with the fraction f of z everywhere, whose
    Fourier series has the terms ``-cos(2 pi n z) / (pi n)²``.
    """
    n = np.arange(1, N_TERMS + 1) * math.pi
    is_long = spread > SHORT_SPREAD
    steps = np.asarray(spread * math.sqrt(2.0 / math.pi))
    if np.any(is_long):
        long = np.asarray(spread)[is_long]
        waves = sum(np.exp(-2.0 * (k * long) ** 2) / k**2 for k in n)
        steps[is_long] = long**2 + 1.0 / 6.0 - waves
    return steps


def _rows(matrix: csr_array[Any]) -> Ints:
    """Row of every entry, (nnz,)."""
    return np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))


def _like(matrix: csr_array[Any], values: Floats) -> csr_array[Any]:
    from scipy.sparse import csr_array

    return csr_array((values, matrix.indices, matrix.indptr), shape=matrix.shape)


def _column_sums(matrix: csr_array[Any]) -> Floats:
    return np.bincount(matrix.indices, weights=matrix.data, minlength=matrix.shape[0]).astype(np.float64)


def _with_rest(matrix: csr_array[Any], share: Floats, n_steps: int) -> csr_array[Any]:
    """One of several equal exchanges; what stays, after the fraction of a site that goes, is on the diagonal."""
    from scipy.sparse import csr_array, diags_array

    return csr_array(matrix / n_steps + diags_array(1.0 - share / n_steps))


def _grid_places(layout: Neighbourhood, pitch_um: Any) -> tuple[Ints, Ints]:
    """Column and row of every site in the grid that the sites are a part of, from 0."""
    n_sites = layout.n_sites
    if n_sites == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    area_um2 = layout.area_um2
    typical_um2 = float(np.median(area_um2))
    odd = int(np.argmax(np.abs(area_um2 - typical_um2)))
    if abs(area_um2[odd] - typical_um2) > AREA_ROUNDING * typical_um2:
        raise SimulationError(
            f"the layout is no grid: site {odd} has {area_um2[odd]:.4g} µm², and others {typical_um2:.4g} µm²; {_OTHER_WAY}"
        )
    same_um = SAME_LINE * math.sqrt(typical_um2)
    centre_um = layout.centroid_um
    lines = [_lines(centre_um[:, axis], same_um) for axis in (0, 1)]
    places = []
    for axis, name in ((0, "columns"), (1, "rows")):
        line, at_um = lines[axis]
        given_um = None if pitch_um is None else pitch_um[axis]
        step_um = _smallest_step_um(line, at_um, lines[1 - axis][0]) if given_um is None else given_um
        place = np.zeros(at_um.size, np.int64)
        if at_um.size > 1:
            if not math.isfinite(step_um):
                raise SimulationError(
                    f"the layout is no grid that shows its pitch: of sites in several {name} no two stand side by side; "
                    f"{_OTHER_WAY}, or give 'pitch_um' when sites are missing"
                )
            steps = np.diff(at_um) / step_um
            is_odd = ~(np.abs(steps - np.rint(steps)) <= PLACE_ROUNDING) | (np.rint(steps) < 1)
            place[1:] = np.cumsum(np.where(is_odd, 0.0, np.rint(steps)).astype(np.int64))
            fitted = np.polyval(np.polyfit(place, at_um, 1), place) if not is_odd.any() else at_um
            is_off = np.abs(fitted - at_um) > PLACE_ROUNDING * step_um
            if is_odd.any() or is_off.any():
                raise SimulationError(
                    f"the layout is no grid along the axes: its {name} are not at equal steps of {step_um:.6g} µm; "
                    f"{_OTHER_WAY}, or give 'pitch_um' when sites are missing"
                )
        places.append(place[line])
    return places[0], places[1]


def _lines(position_um: Floats, same_um: float) -> tuple[Ints, Floats]:
    """Line of every site, and the positions of the lines, rising; a line is a run of positions without a gap."""
    order = np.argsort(position_um, kind="stable")
    rising_um = position_um[order]
    line_of_ordered = np.concatenate(([0], np.cumsum(np.diff(rising_um) > same_um)))
    line = np.zeros(position_um.size, np.int64)
    line[order] = line_of_ordered
    starts = np.flatnonzero(np.diff(line_of_ordered, prepend=-1))
    ends = np.append(starts[1:], position_um.size) - 1
    if np.any(rising_um[ends] - rising_um[starts] > same_um):
        raise SimulationError(
            f"the layout is no grid along the axes: its sites do not stand in rows and columns; {_OTHER_WAY}"
        )
    return line, np.add.reduceat(rising_um, starts) / (ends + 1 - starts)


def _smallest_step_um(line: Ints, at_um: Floats, other_line: Ints) -> float:
    """Smallest distance of two sites in one line across; infinite where none has two."""
    order = np.lexsort((line, other_line))
    together = np.diff(other_line[order]) == 0
    step_um = np.abs(np.diff(at_um[line[order]])[together])
    step_um = step_um[step_um > 0.0]
    if step_um.size == 0:
        return math.inf
    near = step_um[step_um <= 1.25 * step_um.min()]
    return float(np.mean(near))

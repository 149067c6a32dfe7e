"""
Crosstalk: charge diffusion before collection, inter-pixel capacitance in the readout.

Diffusion mixes expected charges before the draw: photosites remain Poisson-distributed and uncorrelated. Inter-pixel
capacitance (IPC) mixes drawn charges: neighbours become correlated.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from foveasim._core.calls import LENGTH, NOT_NEGATIVE, Declared, Limits, OwnCheck
from foveasim._core.short_repr import short_repr
from foveasim._core.threads import cached_property
from foveasim._core.validation import Floats, Ints, as_numbers, check_per_site, check_pitch_um, finite_array, read_only
from foveasim.errors import ParameterError, SimulationError, type_name
from foveasim.sensor.blocks import for_each_block
from foveasim.sensor.effects.contract import Effect, Photosites, Reach, Sites, Stage, StepModel

if TYPE_CHECKING:
    from scipy.sparse import csr_array

__all__ = ["CrosstalkOperator", "Diffusion", "InterPixelCapacitance", "KernelCrosstalk", "Mixing"]

#: Maximum fraction of charge that a site loses in one step; larger fractions would make the exchange oscillate.
MAX_STEP_FRACTION = 0.5
NEIGHBOUR_FRACTION = Limits(at_least=0.0, at_most=MAX_STEP_FRACTION)
#: Maximum number of steps; more would take seconds per frame for a million sites.
MAX_STEPS = 1000
#: Maximum number of elements of a block of rows of a matrix power.
MAX_ELEMENTS = 1 << 22
#: Up to this ratio of spread to distance, charge crosses at most one boundary (to float64); above it, a Fourier series is used.
MAX_SINGLE_CROSSING_SPREAD = 0.125
#: Number of terms of that series: the next one is below 1e-16.
N_TERMS = 10
#: Upper limit of the spread; squares of much larger values overflow float64.
MAX_SPREAD_UM = 1e4
#: Rounding tolerance for the sum of a kernel.
KERNEL_ROUNDING = 1e-9
#: Maximum relative difference in area between sites of a grid: rounding to a manufacturing grid.
AREA_ROUNDING = 0.02
#: Maximum deviation of grid positions and steps, relative to the pitch.
POSITION_ROUNDING = 0.05
#: Maximum difference between coordinates in the same row or column, relative to the side of a site.
SAME_LINE = 0.02


@dataclass(frozen=True, eq=False, repr=False)
class CrosstalkOperator:
    """
    Crosstalk compiled for a layout, applicable to any number of frames.

    Created by ``compile()`` of :class:`Diffusion`, :class:`KernelCrosstalk` and :class:`InterPixelCapacitance`.

    Parameters
    ----------
    matrix : csr_array (n_site, n_site) float64
        Element ``[j, i]`` is the fraction of the charge of site i that moves to site j in one step. Columns sum to 1 unless
        charge is lost.
    n_steps : int
        Number of times that the matrix is applied.

    Examples
    --------
    >>> import foveasim as fs
    >>> row = fs.layout.grid(n_x=3, n_y=1, pitch_um=4.0)
    >>> operator = fs.sensor.Diffusion.from_neighbour_fraction(0.1, pitch_um=4.0).compile(
    ...     row
    ... )
    >>> operator.apply([0.0, 1000.0, 0.0]).round(6).tolist()
    [25.0, 950.0, 25.0]
    """

    matrix: csr_array[Any]
    n_steps: int = 1

    def __repr__(self) -> str:
        return f"CrosstalkOperator({self.matrix.shape[0]} sites, {self.matrix.nnz} fractions, {self.n_steps} steps)"

    def apply(self, charge_e: ArrayLike, *, n_threads: int | None = None) -> Floats:
        """
        Apply crosstalk to charges.

        Parameters
        ----------
        charge_e : (..., n_site), e-
            Expected or drawn charges, or other quantities that mix linearly. Not modified.
        n_threads : int, optional
            Number of threads; all cores by default.

        Returns
        -------
        charge_e : (..., n_site) float64, e-

        Notes
        -----
        The cost is one sparse product per step, 5 ns per site for hexagons.
        """
        charges = check_per_site("charge_e", as_numbers("charge_e", charge_e), self.matrix.shape[0], or_rows=True)
        mixed = np.ascontiguousarray(charges, np.float64).reshape(math.prod(charges.shape[:-1]), charges.shape[-1])
        for _ in range(self.n_steps):
            mixed = self._step(mixed, n_threads)
        return mixed.reshape(charges.shape)

    def _step(self, rows: Floats, n_threads: int | None) -> Floats:
        """Apply one step to charges (n, n_site), in blocks of sites."""
        from foveasim.sensor import _kernels

        out, matrix = np.empty_like(rows), self.matrix
        fractions = np.ascontiguousarray(matrix.data, np.float64)

        def block(_: int, sites: slice) -> None:
            for before, after in zip(rows, out, strict=True):
                _kernels.mix(fractions, matrix.indices, matrix.indptr, before, sites.start, after[sites])

        for_each_block(rows.shape[1], block, n_threads)
        return out

    def variance(self, variance: ArrayLike) -> Floats:
        """
        Propagate variances of independent sites through crosstalk.

        Parameters
        ----------
        variance : (..., n_site)
            Variances before crosstalk, in the square of any unit.

        Returns
        -------
        variance : (..., n_site) float64
            ``sum_i (matrix**n_steps)[j, i]**2 * variance[i]``, in the same unit. The matrix power is computed for a part of
            the sites at a time.
        """
        values = check_per_site("variance", as_numbers("variance", variance), self.matrix.shape[0], or_rows=True)
        columns = np.moveaxis(np.asarray(values, np.float64), -1, 0)
        before = columns.reshape(columns.shape[0], math.prod(columns.shape[1:]))
        if self.n_steps == 1:
            mixed = self._squared_matrix @ before
        else:
            mixed = np.empty(before.shape)
            for sites, rows in self._row_blocks():
                mixed[sites] = rows.power(2) @ before
        return np.ascontiguousarray(np.moveaxis(mixed.reshape(columns.shape), 0, -1))

    @cached_property
    def own_fraction(self) -> Floats:
        """Fraction of the charge of each site that stays, (n_site,): the diagonal of the operator."""
        if self.n_steps == 1:
            return read_only(np.asarray(self.matrix.diagonal(), np.float64))
        found = np.empty(self.matrix.shape[0])
        for sites, rows in self._row_blocks():
            found[sites] = rows.diagonal(sites.start)
        return read_only(found)

    @cached_property
    def _squared_matrix(self) -> csr_array[Any]:
        return self.matrix.power(2)

    def _row_blocks(self) -> Iterator[tuple[slice, csr_array[Any]]]:
        """Yield blocks of sites, and their rows of the matrix power."""
        n_sites = self.matrix.shape[0]
        # In two dimensions, the number of sites that charge reaches grows with the square of the number of steps.
        per_row = min(self.matrix.nnz / max(n_sites, 1) * self.n_steps**2, n_sites)
        step = max(1, int(MAX_ELEMENTS / max(per_row, 1.0)))
        for first in range(0, n_sites, step):
            sites = slice(first, min(first + step, n_sites))
            yield sites, self.rows(sites)

    def transpose(self) -> CrosstalkOperator:
        """Return the operator with the transposed matrix."""
        return self._transposed

    @cached_property
    def _transposed(self) -> CrosstalkOperator:
        from scipy.sparse import csr_array

        return CrosstalkOperator(csr_array(self.matrix.T), self.n_steps)

    def rows(self, sites: Any) -> csr_array[Any]:
        """
        Return rows of the matrix of all steps, ``matrix**n_steps``.

        Parameters
        ----------
        sites : (n,) int or slice, or sparse matrix (n, n_site)
            Indices of the rows; or a matrix that is multiplied by ``matrix**n_steps``.

        Returns
        -------
        rows : csr_array (n, n_site) float64
        """
        from scipy.sparse import csr_array, issparse

        if issparse(sites):
            rows: Any = csr_array(sites)  # type: ignore[call-overload]
        else:
            index = np.atleast_1d(np.arange(self.matrix.shape[0])[sites])
            of_row = np.arange(index.size + 1)
            rows = csr_array((np.ones(index.size), index, of_row), shape=(index.size, self.matrix.shape[0]))
        for _ in range(self.n_steps):
            rows = csr_array(rows @ self.matrix)
        return rows


class Mixing(Effect):
    """
    Deterministic linear mixing of the values of sites, such as crosstalk.

    Subclasses define :meth:`operator`. The stage is "charge" or an earlier one.
    """

    is_temporal: ClassVar[bool] = False
    reach: ClassVar[Reach] = "all"

    @abstractmethod
    def operator(self, sites: Sites) -> CrosstalkOperator:
        """Compile the operator for all sites of ``sites.layout``, called once for all devices."""

    def _compiled(self, sites: Sites) -> CrosstalkOperator:
        """Return the operator, which all devices share."""
        return sites.without_device().cached(self, self.operator)

    def apply(self, values: Floats, *, sites: Sites, rng: np.random.Generator) -> Floats:
        """Return the values after mixing, (n_site,)."""
        return self._compiled(sites).apply(values, n_threads=sites.n_threads)

    def moments(self, mean: Floats, variance: Floats, *, sites: Sites) -> tuple[Floats, Floats]:
        """Compute the moments of independent values after mixing, (..., n_site)."""
        operator = self._compiled(sites)
        variance = _per_site(variance, sites)
        return operator.apply(_per_site(mean, sites)), operator.variance(variance) if np.any(variance) else np.zeros(1)

    def linearise(self, mean: Floats, *, sites: Sites) -> StepModel:
        """Return the mean after mixing, and the operator."""
        operator = self._compiled(sites)
        return StepModel(operator.apply(_per_site(mean, sites)), operator)


def _per_site(values: Floats, sites: Sites) -> Floats:
    """Broadcast values (..., n) or (1,) to all sites."""
    return np.broadcast_to(values, np.broadcast_shapes(np.shape(values), (sites.n_sites,)))


class _Crosstalk(Declared, Mixing):
    """Crosstalk that is compiled for a layout."""

    @abstractmethod
    def compile(self, layout: OwnCheck[Photosites]) -> CrosstalkOperator:
        """Compile the crosstalk for a layout."""

    def operator(self, sites: Sites) -> CrosstalkOperator:
        """Compile the operator for all sites of the layout."""
        return self.compile(sites.layout)


# -- before the draw --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Diffusion(_Crosstalk):
    """
    Charge diffusion between neighbouring photosites of arbitrary shape, before collection.

    Parameters
    ----------
    spread_um : float, µm
        RMS lateral displacement of an electron along one axis until collection: ``sqrt(2 D t)`` for a diffusivity D and a
        time t. 0 for no diffusion.
    max_gap_um : float, optional, µm
        Maximum width of gaps between neighbouring sites, which exchange charge as if they were in contact. By default only
        sites that share an edge are neighbours.

    Notes
    -----
    For a uniform charge density n, a Gaussian spread moves ``n * spread / sqrt(2 pi)`` across each unit of length of a
    straight boundary, in either direction. A site of area A therefore passes to a neighbour with a shared edge of length e
    the fraction

    ::

        fraction = e w / A,    w = spread / sqrt(2 pi)          spread well below the distance d between the two centroids
                               w = spread² / (2 d) + d / 12     spread above d/2: Fick's law

    In general, ``w = (d / 2) E[g(spread Z / d)]``, where Z is a standard normal number and g interpolates the squares of the
    integers linearly. With this w, the charge of a uniformly lit site in a square grid has the exact variance along each
    axis: ``d² E[g] = spread² + d²/6`` for spreads above d/2, and ``0.798 spread d`` for small spreads.

    Charge is conserved: charge at the array boundary stays in its site. Uniform irradiance remains uniform on any tiling,
    because ``e w`` is the same in both directions.

    A single step neglects charge that crosses a corner, which is of the order of the squared fraction. A site cannot lose more
    than half of its charge in one step; for long spreads the exchange is therefore divided into ``n`` equal steps,
    ``(I + L / n)^n``, which approximates ``exp(L)`` and has the same variance.

    Examples
    --------
    >>> import foveasim as fs
    >>> pair = fs.layout.grid(n_x=2, n_y=1, pitch_um=4.0)
    >>> Diffusion.from_neighbour_fraction(0.2, pitch_um=4.0).compile(pair).apply(
    ...     [1000.0, 0.0]
    ... ).round(9).tolist()
    [950.0, 50.0]
    """

    name: ClassVar[str] = "crosstalk"
    stage: ClassVar[Stage] = "expected"

    spread_um: Annotated[float, Limits(at_least=0.0, at_most=MAX_SPREAD_UM)]
    max_gap_um: Annotated[float | None, NOT_NEGATIVE] = None

    @classmethod
    def from_neighbour_fraction(
        cls,
        neighbour_fraction: Annotated[float, NEIGHBOUR_FRACTION],
        *,
        pitch_um: Annotated[float, LENGTH],
        max_gap_um: float | None = None,
    ) -> Diffusion:
        """
        Create the diffusion that corresponds to crosstalk measured on square pixels.

        The result applies to layouts of any shape in the same process.

        Parameters
        ----------
        neighbour_fraction : float
            Fraction of its charge that a square pixel loses to its four neighbours in total, at most one half.
        pitch_um : float, µm
            Pitch of the square pixels.
        max_gap_um : float, optional, µm
            As for the class.
        """
        from scipy.optimize import brentq

        # Upper bracket: with a spread equal to the pitch a pixel loses far more than half.
        steps = float(
            brentq(lambda s: 2.0 * float(_mean_square_steps(np.array(s))) - neighbour_fraction, 0.0, 1.0, xtol=1e-15)
        )
        return cls(spread_um=steps * pitch_um, max_gap_um=max_gap_um)

    def compile(self, layout: OwnCheck[Photosites]) -> CrosstalkOperator:
        """
        Compile the diffusion for a layout.

        Raises
        ------
        ParameterError
            If the argument is not a layout, or the spread is too long for its smallest sites.
        SimulationError
            If no two sites share an edge.
        """
        shared_um = _shared_um(layout, self.max_gap_um)
        site, neighbour = shared_um.indices, np.repeat(np.arange(layout.n_sites), np.diff(shared_um.indptr))
        centre_um = layout.centroid_um
        distance_um = np.hypot(*np.moveaxis(centre_um[site] - centre_um[neighbour], -1, 0))
        if distance_um.size:
            # A site in the hole of another has the same centroid; the ratio of area to edge length then gives the distance.
            edges_um = shared_um.sum(axis=1)
            depth_um = layout.area_um2 / np.where(edges_um > 0.0, edges_um, 1.0)
            distance_um = np.maximum(distance_um, 0.5 * (depth_um[site] + depth_um[neighbour]))
        width_um = 0.5 * distance_um * _mean_square_steps(self.spread_um / distance_um)
        matrix, loss, largest = _exchange(shared_um, shared_um.data * width_um / layout.area_um2[site])
        if not largest <= MAX_STEP_FRACTION * MAX_STEPS:
            smallest = int(np.argmax(loss))
            raise ParameterError(
                "spread_um",
                f"must be shorter for site {smallest} with an area of only {layout.area_um2[smallest]:.3g} µm²",
                self.spread_um,
                "µm",
                f"the diffusion would need more than {MAX_STEPS} steps",
            )
        # Tolerance for computed fractions of exactly one half.
        n_steps = max(1, math.ceil(largest / MAX_STEP_FRACTION - 1e-9))
        return CrosstalkOperator(_add_remainder(matrix, loss, n_steps), n_steps)


@dataclass(frozen=True, kw_only=True)
class KernelCrosstalk(_Crosstalk):
    """
    Crosstalk as a convolution kernel on a rectangular grid, as in the paper.

    Parameters
    ----------
    kernel : (n_row, n_column), odd numbers
        Distribution of the charge of the central element: the fraction ``kernel[j, i]`` moves ``i - n_column // 2`` columns to
        the right and ``j - n_row // 2`` rows **up**; row 0 is the lowest, as in all arrays of this package. The elements are
        non-negative with a sum of at most 1; the difference from 1 is lost in the silicon.
    border : {"kept", "lost"}
        Charge that would move to a position without a site remains in its site ("kept"), or is lost.
    pitch_um : number or (pitch_x, pitch_y), optional, µm
        Pitch of the grid, for crops with too few sites to derive it; by default the smallest step within a row, and within a
        column.

    Raises
    ------
    ParameterError
        If the kernel has an even number of rows or columns, or an element or the sum is out of range.

    Notes
    -----
    On a full grid, ``border="lost"`` equals ``scipy.ndimage.convolve(picture, kernel, mode="constant")``, with row 0 lowest in
    both. There is no default kernel because published kernels are specific to one pixel and one wavelength. Use a measured
    kernel, or :class:`Diffusion`, which supports sites of any shape.

    Examples
    --------
    >>> import foveasim as fs
    >>> upwards = KernelCrosstalk(kernel=((0.0,), (0.75,), (0.25,)))
    >>> upwards.compile(fs.layout.grid(n_x=1, n_y=3, pitch_um=2.0)).apply(
    ...     [100.0, 0.0, 8.0]
    ... ).tolist()
    [75.0, 25.0, 8.0]
    """

    name: ClassVar[str] = "crosstalk"
    stage: ClassVar[Stage] = "expected"

    kernel: Sequence[Sequence[float]]
    border: Literal["kept", "lost"] = "kept"
    pitch_um: float | tuple[float, float] | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        kernel = finite_array("kernel", self.kernel, ndim=2, at_least=0.0)
        if any(n % 2 == 0 for n in kernel.shape):
            raise ParameterError("kernel", f"must have odd numbers of rows and columns, got the shape {kernel.shape}")
        if kernel.sum() > 1.0 + KERNEL_ROUNDING:
            raise ParameterError("kernel", "must have a sum of at most 1", float(kernel.sum()))
        object.__setattr__(self, "kernel", tuple(tuple(float(fraction) for fraction in row) for row in kernel))
        super().__post_init__()
        if self.pitch_um is not None:
            object.__setattr__(self, "pitch_um", check_pitch_um("pitch_um", self.pitch_um))

    def compile(self, layout: OwnCheck[Photosites]) -> CrosstalkOperator:
        """
        Compile the convolution for a layout of grid sites, in any order and with gaps.

        Raises
        ------
        SimulationError
            If the sites are not part of a grid parallel to the axes.
        """
        from scipy.sparse import coo_array

        _require_layout(layout)
        n_sites = layout.n_sites
        column, row = _grid_positions(layout, self.pitch_um)
        kernel = np.array(self.kernel)
        half_y, half_x = kernel.shape[0] // 2, kernel.shape[1] // 2
        # Linear index with padding at the ends of rows, so that the kernel does not wrap into the next row.
        stride = int(column.max(initial=0)) + 1 + 2 * half_x
        position = row * stride + column
        order = np.argsort(position, kind="stable")
        ordered = position[order]
        if n_sites and (ordered[1:] == ordered[:-1]).any():
            duplicate = order[int(np.flatnonzero(ordered[1:] == ordered[:-1])[0]) + 1]
            raise SimulationError(
                f"the layout is not a grid: site {duplicate} has the same position as another site; {_ALTERNATIVE}"
            )
        source, target, fraction = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
        without_target = np.zeros(n_sites)
        for j, i in np.argwhere(kernel > 0.0):
            target_position = ordered + (j - half_y) * stride + (i - half_x)
            at = np.minimum(np.searchsorted(ordered, target_position), max(n_sites - 1, 0))
            has_site = ordered[at] == target_position
            source.append(order[has_site])
            target.append(order[at[has_site]])
            fraction.append(np.full(source[-1].size, kernel[j, i]))
            without_target[order[~has_site]] += kernel[j, i]
        if self.border == "kept":
            source.append(np.flatnonzero(without_target))
            target.append(source[-1])
            fraction.append(without_target[source[-1]])
        pairs = (np.concatenate(target).astype(np.int32), np.concatenate(source).astype(np.int32))
        return CrosstalkOperator(coo_array((np.concatenate(fraction), pairs), shape=(n_sites, n_sites)).tocsr())


# -- after the draw ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class InterPixelCapacitance(_Crosstalk):
    """
    Inter-pixel capacitance (IPC): capacitive coupling between neighbouring readout nodes.

    Parameters
    ----------
    neighbour_fraction : float
        Fraction of a site's charge that appears at a neighbour with a shared edge of length ``edge_um``; for other edges it is
        proportional to their length. Hybrid near-infrared arrays (H2RG) have 0.007 to 0.015 (Donlon, Ninkov and Baum 2018,
        arXiv:1805.09413).
    edge_um : float, optional, µm
        Length of that edge; by default the median over the layout, which is the common edge length of a regular tiling.
    max_gap_um : float, optional, µm
        Maximum width of gaps between neighbouring sites; by default neighbours share an edge.

    Notes
    -----
    Two nodes with a common boundary of length e have a coupling capacitance ``k e``. With a capacitance C to ground, the
    voltages due to charges q obey ``C V_i + sum_j k e_ij (V_i - V_j) = q_i``; to first order in ``k e / C`` the measured
    charge ``C V`` is

    ::

        q_i + sum_j a_ij (q_j - q_i),    a_ij = neighbour_fraction e_ij / edge_um

    The coupling is symmetric and conserves the sum of all measured charges: no electron moves, only its field acts on other
    nodes. Read noise of subsequent amplifiers is not coupled. Independent charges with variances v get the covariance
    ``K diag(v) K^T``, which is ``2 a v`` between neighbours under uniform irradiance. A conversion gain derived from variances
    is then wrong by a factor of about ``1 - 2 sum_j a`` (Moore, Ninkov and Forrest, Opt. Eng. 45, 076402, 2006).

    Examples
    --------
    >>> import foveasim as fs
    >>> row = fs.layout.grid(n_x=3, n_y=1, pitch_um=4.0)
    >>> InterPixelCapacitance(neighbour_fraction=0.01).compile(row).apply(
    ...     [0, 5000, 0]
    ... ).tolist()
    [50.0, 4900.0, 50.0]
    """

    name: ClassVar[str] = "ipc"
    stage: ClassVar[Stage] = "charge"

    neighbour_fraction: Annotated[float, NEIGHBOUR_FRACTION]
    edge_um: Annotated[float | None, LENGTH] = None
    max_gap_um: Annotated[float | None, NOT_NEGATIVE] = None

    def operator(self, sites: Sites) -> CrosstalkOperator:
        """Compile the operator for all sites of the layout and their sense-node capacitances."""
        return self.compile(sites.layout, capacitance_f=sites.capacitance_f if sites.capacitance_f.size > 1 else None)

    def compile(
        self,
        layout: OwnCheck[Photosites],
        *,
        capacitance_f: ArrayLike | None = None,
    ) -> CrosstalkOperator:
        """
        Compile the coupling for a layout.

        Parameters
        ----------
        layout : Layout
        capacitance_f : number or (n_site,), optional, F
            Capacitance of each node, if they differ. ``neighbour_fraction`` then refers to a node with the median
            capacitance; nodes with smaller capacitances couple more of their charge. The sum of measured charges is conserved.

        Raises
        ------
        ParameterError
            If the first argument is not a layout, the number of capacitances is not the number of sites, or a site would
            couple more than half of its charge to its neighbours.
        SimulationError
            If no two sites share an edge.
        """
        shared_um = _shared_um(layout, self.max_gap_um)
        edge_um = self.edge_um
        if edge_um is None:
            edge_um = float(np.median(shared_um.data)) if shared_um.nnz else 1.0
        ratio = np.ones(layout.n_sites)
        if capacitance_f is not None and layout.n_sites:
            node_f = finite_array("capacitance_f", capacitance_f, above=0.0)
            check_per_site("capacitance_f", node_f, layout.n_sites, or_one=True)
            ratio = np.median(node_f) / np.broadcast_to(node_f, layout.n_sites)
        fraction = shared_um.data * (self.neighbour_fraction / edge_um) * ratio[shared_um.indices]
        matrix, loss, largest = _exchange(shared_um, fraction)
        if largest > MAX_STEP_FRACTION * (1.0 + KERNEL_ROUNDING):
            raise ParameterError(
                "neighbour_fraction",
                f"must be smaller: site {int(np.argmax(loss))} would couple {largest:.3g} of its charge to its neighbours, "
                "more than half",
                self.neighbour_fraction,
                hint="the model is valid for weak coupling only",
            )
        return CrosstalkOperator(_add_remainder(matrix, loss, 1))


# -- helpers ----------------------------------------------------------------------------------------------------------

_ALTERNATIVE = "use Diffusion, which supports sites of any shape"


def _require_layout(layout: object) -> None:
    if not all(hasattr(layout, name) for name in ("n_sites", "area_um2", "centroid_um", "adjacency")):
        raise ParameterError("layout", f"must be a Layout, got {type_name(layout)}")


def _shared_um(layout: Photosites, max_gap_um: float | None) -> csr_array[Any]:
    """Return the lengths of shared edges, with int32 indices if possible."""
    from scipy.sparse import csr_array

    _require_layout(layout)
    n_sites = layout.n_sites
    shared_um = csr_array(layout.adjacency(max_gap_um=max_gap_um))
    if n_sites > 1 and shared_um.nnz == 0:
        raise SimulationError(
            "no two sites of the layout share an edge, so there is no crosstalk; for sites separated by trenches, set "
            "'max_gap_um' to the trench width"
        )
    if shared_um.nnz < np.iinfo(np.int32).max:
        small = (shared_um.data, shared_um.indices.astype(np.int32), shared_um.indptr.astype(np.int32))
        shared_um = csr_array(small, shape=(n_sites, n_sites))
    return shared_um


def _mean_square_steps(spread: Floats) -> Floats:
    """
    Compute the mean square number of cells that charge moves in a row of cells.

    ``spread`` is in units of cells. Charge starts uniformly distributed in a cell; for a displacement z, the mean square
    number of cell boundaries crossed is g(z), the linear interpolation of the squares of the integers: ``g(z) = |z|`` up to
    1, and ``z² + f (1 - f)`` with the fractional part f of z in general, whose Fourier series has the terms
    ``-cos(2 pi n z) / (pi n)²``.
    """
    n = np.arange(1, N_TERMS + 1) * math.pi
    is_long = spread > MAX_SINGLE_CROSSING_SPREAD
    steps = np.asarray(spread * math.sqrt(2.0 / math.pi))
    if np.any(is_long):
        long = np.asarray(spread)[is_long]
        waves = sum(np.exp(-2.0 * (k * long) ** 2) / k**2 for k in n)
        steps[is_long] = long**2 + 1.0 / 6.0 - waves
    return steps


def _exchange(shared_um: csr_array[Any], fraction: Floats) -> tuple[csr_array[Any], Floats, float]:
    """Return the matrix of exchanged fractions, the loss of each site, and the largest loss."""
    from scipy.sparse import csr_array

    loss = np.bincount(shared_um.indices, weights=fraction, minlength=shared_um.shape[0]).astype(np.float64)
    matrix = csr_array((fraction, shared_um.indices, shared_um.indptr), shape=shared_um.shape)
    return matrix, loss, float(loss.max(initial=0.0))


def _add_remainder(matrix: csr_array[Any], lost_fraction: Floats, n_steps: int) -> csr_array[Any]:
    """Return the matrix of one of several equal steps; the diagonal is the remaining fraction."""
    from scipy.sparse import csr_array, diags_array

    return csr_array(matrix / n_steps + diags_array(1.0 - lost_fraction / n_steps))


def _grid_positions(layout: Photosites, pitch_um: Any) -> tuple[Ints, Ints]:
    """Return column and row of each site in the underlying grid, from 0."""
    n_sites = layout.n_sites
    if n_sites == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    area_um2 = layout.area_um2
    typical_um2 = float(np.median(area_um2))
    odd = int(np.argmax(np.abs(area_um2 - typical_um2)))
    if abs(area_um2[odd] - typical_um2) > AREA_ROUNDING * typical_um2:
        raise SimulationError(
            f"the layout is not a grid: site {odd} has an area of {area_um2[odd]:.4g} µm², the median is "
            f"{typical_um2:.4g} µm²; {_ALTERNATIVE}"
        )
    same_um = SAME_LINE * math.sqrt(typical_um2)
    centre_um = layout.centroid_um
    lines = [_lines(centre_um[:, axis], same_um) for axis in (0, 1)]
    positions = []
    for axis, name in ((0, "columns"), (1, "rows")):
        line, at_um = lines[axis]
        known_pitch_um = None if pitch_um is None else pitch_um[axis]
        step_um = _smallest_step_um(line, at_um, lines[1 - axis][0]) if known_pitch_um is None else known_pitch_um
        position = np.zeros(at_um.size, np.int64)
        if at_um.size > 1:
            if not math.isfinite(step_um):
                raise SimulationError(
                    f"the layout is not a grid of known pitch: there are several {name}, but no two sites are side by "
                    f"side; {_ALTERNATIVE}, or set 'pitch_um' if sites are missing"
                )
            steps = np.diff(at_um) / step_um
            is_odd = ~(np.abs(steps - np.rint(steps)) <= POSITION_ROUNDING) | (np.rint(steps) < 1)
            position[1:] = np.cumsum(np.where(is_odd, 0.0, np.rint(steps)).astype(np.int64))
            fitted = np.polyval(np.polyfit(position, at_um, 1), position) if not is_odd.any() else at_um
            is_off = np.abs(fitted - at_um) > POSITION_ROUNDING * step_um
            if is_odd.any() or is_off.any():
                raise SimulationError(
                    f"the layout is not a grid parallel to the axes: its {name} do not have equal steps of {step_um:.6g} "
                    f"µm; {_ALTERNATIVE}, or set 'pitch_um' if sites are missing"
                )
        positions.append(position[line])
    return positions[0], positions[1]


def _lines(position_um: Floats, same_um: float) -> tuple[Ints, Floats]:
    """
    Return the line (row or column) of each site, and the ascending positions of the lines.

    A line is a run of sorted positions without steps above ``same_um``.
    """
    order = np.argsort(position_um, kind="stable")
    rising_um = position_um[order]
    line_of_ordered = np.concatenate(([0], np.cumsum(np.diff(rising_um) > same_um)))
    line = np.zeros(position_um.size, np.int64)
    line[order] = line_of_ordered
    starts = np.flatnonzero(np.diff(line_of_ordered, prepend=-1))
    ends = np.append(starts[1:], position_um.size) - 1
    if np.any(rising_um[ends] - rising_um[starts] > same_um):
        raise SimulationError(
            f"the layout is not a grid parallel to the axes: its sites are not in rows and columns; {_ALTERNATIVE}"
        )
    return line, np.add.reduceat(rising_um, starts) / (ends + 1 - starts)


def _smallest_step_um(line: Ints, at_um: Floats, other_line: Ints) -> float:
    """Return the smallest step between sites of the same perpendicular line, or infinity."""
    order = np.lexsort((line, other_line))
    together = np.diff(other_line[order]) == 0
    step_um = np.abs(np.diff(at_um[line[order]])[together])
    step_um = step_um[step_um > 0.0]
    if step_um.size == 0:
        return math.inf
    near = step_um[step_um <= 1.25 * step_um.min()]
    return float(np.mean(near))

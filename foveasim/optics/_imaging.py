"""
Power maps from the basis images of a scene, by Fourier transforms.

The cost is one forward transform per basis image and one inverse transform per map. Maps and basis images that contribute to
each other form a group (:class:`Group`). In a group with more basis images than maps, such as the bands of a hyperspectral
scene behind three colour filters, the maps are summed together: each basis image is transformed, added to the spectra of all
maps and dropped. In other groups the spectra of all basis images are stored, and maps are computed when they are requested.
Memory is therefore limited to one spectrum per map or basis image, the smaller number of the two, plus one, and to one map.

There are two methods for aberrations that vary over the field. In the first, the PSFs are a sum of modes
(:mod:`foveasim.optics._field_modes`): each basis image times the weights of a mode is an additional basis image, and each
wavelength of a mode an additional wavelength. In the second, the picture is divided into overlapping isoplanatic patches with
linear weights, each with the PSF at its centre (overlap-add), so that the PSF is interpolated linearly between patch centres.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from foveasim._core.threads import cached_property
from foveasim._core.validation import Bools, Floats, Images, Ints
from foveasim._io.mapped_files import in_memory
from foveasim.fields import Grid
from foveasim.optics._aperture import PSFModel
from foveasim.optics._field_modes import FieldWeight
from foveasim.optics._transform import Factor, Transform, source_pixels
from foveasim.optics.otf import Tables

#: Function of (first, last) that returns the rows ``first`` to ``last - 1`` of a map.
MapRows = Callable[[int, int], NDArray[Any]]

#: Callable of (weights of a sum, transform, tables) that returns the transfer function of a sum of OTFs, cached or not.
FactorLookup = Callable[[Floats, Transform, Tables], Factor]
#: Function of (first, last) that processes columns of spectra.
Columns = Callable[[int, int], None]
#: Callable of the weights of a sum of OTFs that returns its transfer function.
FactorOf = Callable[[Floats], Factor]
#: Comparison of the PSFs of neighbouring patches: number of points along each axis, and margin beyond the blur in λN.
COMPARISON_POINTS, COMPARISON_LAMBDA_N = 257, 5.0


@dataclass(frozen=True, eq=False)
class Step:
    """
    Basis images that are added to maps in one pass, and their sums of OTFs.

    ``outputs``, ``basis`` (n_output,), (n_basis,): indices of the maps and the basis images. ``weights`` (n_sum,
    n_wavelength): weights of the wavelengths in each sum of OTFs. ``coefficients`` (n_output, n_basis, n_sum): weight of each
    sum in the transfer function from a basis image to a map.
    """

    outputs: Ints
    basis: Ints
    weights: Floats
    coefficients: Floats


@dataclass(frozen=True, eq=False)
class Group:
    """
    Maps and basis images that contribute to each other, and to no others.

    ``basis`` (n_basis,): indices of the basis images. ``steps``: if there are more basis images than maps, one step per basis
    image, which adds it to all maps; else one step per n_basis maps, which computes them from all basis images.
    """

    basis: Ints
    steps: tuple[Step, ...]

    @property
    def is_summed_together(self) -> bool:
        """Whether each step adds one basis image to all maps."""
        return self.steps[0].basis.size < self.basis.size


@dataclass(frozen=True, kw_only=True)
class Imaging:
    """Inputs of the computation of power maps."""

    basis: Images
    # On-axis irradiance in each band for an image value of 1, (n_basis, n_wavelength). With modes of the field, each basis
    # image has one row per mode, and each mode has its own columns, one per wavelength.
    irradiance_w_m2: Floats
    # Weights of the outputs, (n_output, n_wavelength).
    weights: Floats
    # Weights over the field of all modes except the mean PSF.
    field_weights: Sequence[FieldWeight]
    # Factors of the relative illumination besides the power of the cosine; empty if it is 1.
    illumination: Sequence[FieldWeight]
    # Squared tangents of the angles to the axis, (n_x,) and (n_y,), and exponent of the cosine.
    tangent2_x: Floats
    tangent2_y: Floats
    falloff_power: int
    # Grid of the images of the source pixels.
    grid: Grid
    padding: str
    # Minimum number of padding cells on each side.
    pad: int
    # Highest cut-off frequency.
    f_max_per_um: float
    # Largest geometric ray displacement.
    blur_cells: float
    # Cells around an isoplanatic patch that its PSF reaches.
    guard: int
    is_square_source: bool
    # Map cells along a side of a source pixel.
    oversample: int
    real: type[np.floating[Any]]
    n_threads: int
    cached_factor: FactorLookup
    # First and last row of the picture outside which all basis images are 0.
    lit_rows: tuple[int, int] | None = None

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """Groups of maps, in the order of the first map of each."""
        n_outputs, n_basis = len(self.weights), len(self.irradiance_w_m2)
        is_needed = np.array([[bool(np.any(w * e)) for e in self.irradiance_w_m2] for w in self.weights], bool)
        is_needed = is_needed.reshape(n_outputs, n_basis)  # also if there are no maps
        groups = []
        for outputs, basis in _connected(is_needed):
            if basis.size > outputs.size:
                steps = [self._step(outputs, np.array([b])) for b in basis]
            elif basis.size:
                batches = range(0, outputs.size, basis.size)
                steps = [self._step(outputs[first : first + basis.size], basis) for first in batches]
            else:
                continue
            groups.append(Group(basis, tuple(steps)))
        return tuple(groups)

    def _step(self, outputs: Ints, basis: Ints) -> Step:
        """Return a step with one sum of OTFs per wavelength, or per map and basis image."""
        # Whichever gives fewer sums.
        weights = self.weights[outputs, np.newaxis] * self.irradiance_w_m2[basis]
        is_used = weights.any(axis=(0, 1))
        is_needed = weights.any(axis=2)
        if np.count_nonzero(is_used) <= np.count_nonzero(is_needed):
            return Step(outputs, basis, np.eye(is_used.size)[is_used], weights[:, :, is_used])
        coefficients = np.zeros((*is_needed.shape, np.count_nonzero(is_needed)))
        coefficients[(*np.nonzero(is_needed), np.arange(coefficients.shape[2]))] = 1.0
        return Step(outputs, basis, weights[is_needed], coefficients)

    def sums(self) -> list[Floats]:
        """Return the wavelength weights of all different sums of OTFs."""
        found = {weight.tobytes(): weight for group in self.groups for step in group.steps for weight in step.weights}
        return list(found.values())

    def sources(self) -> tuple[Ints, Ints]:
        """Return the picture row of each padded row, and the same for columns; -1: zero."""
        rows, columns = (source_pixels(n, self.padding, self.pad) for n in self.grid.shape)
        return rows, columns

    def transform(self, rows: Ints, columns: Ints, shape: tuple[int, int]) -> Transform:
        """Return the Fourier transforms of padded pictures of one size."""
        return Transform(self, rows, columns, shape)

    def maps(self, table_of: Tables) -> Iterator[MapRows]:
        """Yield maps with one PSF, or with modes of the field; their rows are computed on demand."""
        transform = self.transform(*self.sources(), self.grid.shape)

        def write_spectrum(b: int, out: NDArray[Any], after: Columns | None) -> None:
            b, mode = divmod(b, 1 + len(self.field_weights))
            weights = [*self.illumination, *(self.field_weights[mode - 1 : mode] if mode else ())]
            image = in_memory(self.basis[b])
            transform.forward(
                image, self.tangent2_x, self.tangent2_y, self.falloff_power, out, weights, after, self.lit_rows
            )

        return self._maps(transform, write_spectrum, lambda weight: self.cached_factor(weight, transform, table_of))

    def _maps(
        self,
        transform: Transform,
        write_spectrum: Callable[[int, NDArray[Any], Columns | None], None],
        factor_of: FactorOf,
    ) -> Iterator[MapRows]:
        """Yield maps from the spectra of basis images, which ``write_spectrum`` computes."""
        stored: dict[Group, NDArray[Any]] = {}

        def filtering(spectra: NDArray[Any], step: Step, sums: NDArray[Any], **position: bool) -> Columns:
            factors = [factor_of(weight) for weight in step.weights]
            return transform.filtering(spectra, factors, step.coefficients, sums, **position)

        def sum_together(group: Group) -> NDArray[Any]:
            spectra, sums = transform.spectra(1), transform.sums(group.steps[0].outputs.size)
            for step in group.steps:
                position = {"is_first": step is group.steps[0], "is_last": step is group.steps[-1]}
                add = filtering(spectra, step, sums, **position)
                if transform.is_filtered_by_blocks:
                    write_spectrum(int(step.basis[0]), spectra[0], add)
                else:
                    write_spectrum(int(step.basis[0]), spectra[0], None)
                    transform.for_each_block_of_columns(add)
            return sums

        def sum_step(group: Group, step: Step) -> NDArray[Any]:
            if transform.is_filtered_by_blocks and step.basis.size == step.outputs.size == len(group.steps) == 1:
                # The map overwrites each block of the spectrum while it is in the cache of a core.
                spectra = transform.spectra(1)
                write_spectrum(
                    int(step.basis[0]), spectra[0], filtering(spectra, step, spectra, is_first=True, is_last=True)
                )
                return spectra
            if step is group.steps[0]:
                stored[group] = transform.spectra(group.basis.size)
                for spectrum, b in zip(stored[group], group.basis, strict=True):
                    write_spectrum(int(b), spectrum, None)
            is_last = step is group.steps[-1]
            spectra = stored.pop(group) if is_last else stored[group]
            # The last maps overwrite the spectra, which are no longer needed.
            is_replaced = is_last and spectra.shape[1:] == transform.spectrum_shape
            sums = spectra[: step.outputs.size] if is_replaced else transform.sums(step.outputs.size)
            transform.for_each_block_of_columns(filtering(spectra, step, sums, is_first=True, is_last=True))
            return sums

        starting = {int(step.outputs[0]): (group, step) for group in self.groups for step in group.steps}
        computed: dict[int, NDArray[Any]] = {}
        for c in range(len(self.weights)):
            if c in starting:
                group, step = starting.pop(c)
                sums = sum_together(group) if group.is_summed_together else sum_step(group, step)
                computed |= zip(step.outputs.tolist(), sums, strict=True)
                del sums
            yield partial(transform.inverse, computed.pop(c)) if c in computed else partial(self._no_light, transform)

    def _no_light(self, transform: Transform, first: int, last: int) -> NDArray[Any]:
        """Return rows of a map of 0."""
        return np.zeros((last - first, transform.map_shape[1]), self.real)

    def patches(self, n_patches: tuple[int, int]) -> list[tuple[tuple[float, float], PatchExtent, PatchExtent]]:
        """Return the centre (x, y) in µm, and the extents along y and x, of each patch."""
        node_y_um, node_x_um = _nodes_um(self.grid, n_patches)
        row_sources, column_sources = self.sources()
        all_rows = _patch_extents(self, row_sources, self.grid.shape[0], node_y_um)
        all_columns = _patch_extents(self, column_sources, self.grid.shape[1], node_x_um)
        centre_x_um, centre_y_um = self.grid.centre_um
        return [
            ((float(x_um) + centre_x_um, float(y_um) + centre_y_um), rows, columns)
            for y_um, rows in zip(node_y_um, all_rows, strict=True)
            for x_um, columns in zip(node_x_um, all_columns, strict=True)
        ]

    def patch_cells(self, rows: PatchExtent, columns: PatchExtent) -> tuple[Any, Any]:
        """Return the indices of the cells of a patch in the map, and of these within the patch."""
        k = self.oversample
        fine = [(k * extent.cells[:, np.newaxis] + np.arange(k)).ravel() for extent in (rows, columns)]
        is_inside = [(cells >= 0) & (cells < k * n) for cells, n in zip(fine, self.grid.shape, strict=True)]
        return np.ix_(fine[0][is_inside[0]], fine[1][is_inside[1]]), np.ix_(*is_inside)

    def patch_window(self, rows: PatchExtent, columns: PatchExtent) -> Floats:
        """Return the weights of the pixels of a patch, times the relative illumination."""
        x2, y2 = self.tangent2_x[columns.sources], self.tangent2_y[rows.sources]
        illumination: Floats = (1.0 + x2 + y2[:, np.newaxis]) ** (-0.5 * self.falloff_power)
        for part in self.illumination:
            illumination = (
                illumination * FieldWeight(part.along_y[rows.sources], part.profiles[:, columns.sources]).at_pixels()
            )
        return np.outer(rows.weight, columns.weight) * illumination

    def patch_maps(self, rows: PatchExtent, columns: PatchExtent, table_of: Tables) -> Iterator[MapRows]:
        """Yield the contribution of a patch to every map, over the cells that its PSF reaches."""
        shape = rows.cells.size, columns.cells.size
        transform = self.transform(np.arange(shape[0]), np.arange(shape[1]), shape)
        window = self.patch_window(rows, columns)
        picture = np.zeros(shape, self.real)
        inner = picture[rows.pixels, columns.pixels]
        on_axis = np.zeros(shape[1]), np.zeros(shape[0])
        y, x = (range(int(sources.min()), int(sources.max()) + 1) for sources in (rows.sources, columns.sources))

        def write_spectrum(b: int, out: NDArray[Any], after: Columns | None) -> None:
            box = self.basis[b, y.start : y.stop, x.start : x.stop]
            inner[:] = in_memory(box)[np.ix_(rows.sources - y.start, columns.sources - x.start)] * window
            transform.forward(picture, *on_axis, self.falloff_power, out, (), after)

        return self._maps(transform, write_spectrum, lambda weight: transform.factor(*table_of(weight)))


def _connected(is_needed: Bools) -> Iterator[tuple[Ints, Ints]]:
    """Yield the rows and columns of each connected part of a matrix, by its first row."""
    is_left = np.ones(len(is_needed), bool)
    while is_left.any():
        is_in, is_same = np.arange(is_left.size) == is_left.argmax(), False
        while not is_same:
            columns = is_needed[is_in].any(axis=0)
            grown = is_in | is_needed[:, columns].any(axis=1)
            is_in, is_same = grown, bool((grown == is_in).all())
        is_left &= ~is_in
        yield np.flatnonzero(is_in), np.flatnonzero(columns)


@dataclass(frozen=True)
class PatchExtent:
    """
    Extent of an isoplanatic patch along one axis.

    ``sources``, ``weight`` (n_pixel,): indices of the picture pixels of the patch, and their linear weights. ``pixels``:
    position of these pixels among the cells. ``cells`` (n_cell,): indices of the picture cells that the patch reaches, in
    order; negative or beyond the picture in the padding.
    """

    sources: Ints
    weight: Floats
    pixels: slice
    cells: Ints


def isoplanatic_maps(
    imaging: Imaging, n_patches: tuple[int, int], tables_at: Callable[[tuple[float, float]], Tables]
) -> Iterator[MapRows]:
    """
    Yield maps with a PSF that varies over the field; all maps are in memory together.

    Patches use the same periodic continuation of the padded picture as the computation without patches. With equal PSFs
    both give the same maps, except for energy that falls beyond the guard of a patch.
    """
    k = imaging.oversample
    n_y, n_x = imaging.grid.shape
    maps = np.zeros((len(imaging.weights), k * n_y, k * n_x), imaging.real)
    for field_um, rows, columns in imaging.patches(n_patches):
        to, inner = imaging.patch_cells(rows, columns)
        n_fine_rows = k * rows.cells.size
        for c, patch_rows in enumerate(imaging.patch_maps(rows, columns, tables_at(field_um))):
            maps[c][to] += patch_rows(0, n_fine_rows)[inner]
    for complete in maps:
        yield partial(rows_of, complete)


def rows_of(cells: NDArray[Any], first: int, last: int) -> NDArray[Any]:
    """Return the rows ``first`` to ``last - 1`` of a map."""
    return cells[first:last]


def isoplanatic_error(
    aperture: PSFModel, grid: Grid, n_patches: tuple[int, int], wavelength_nm: float, lambda_n_um: float
) -> float:
    """
    Return the largest fraction of PSF energy displaced by the isoplanatic patches.

    The fraction is evaluated midway between patch centres, or at the corners of the picture for a single patch.
    """
    centre_x_um, centre_y_um = grid.centre_um
    node_y_um, node_x_um = _nodes_um(grid, n_patches)
    node_y_um, node_x_um = node_y_um + centre_y_um, node_x_um + centre_x_um
    if n_patches == (1, 1):
        x0_um, y0_um, x1_um, y1_um = grid.bounds_um
        midpoints_um = [(x_um, y_um) for x_um in (x0_um, x1_um) for y_um in (y0_um, y1_um)]
        known_um = [[grid.centre_um]] * 4
    else:
        steps = [(y, x) for y in itertools.pairwise(node_y_um) for x in itertools.pairwise(node_x_um)]
        known_um = [[(float(x), float(y)) for y in ys for x in xs] for ys, xs in steps]
        midpoints_um = [(float(np.mean(xs)), float(np.mean(ys))) for ys, xs in steps]
    points_um = {point for points in (midpoints_um, *known_um) for point in points}
    reach_um = lambda_n_um * (
        COMPARISON_LAMBDA_N + max(aperture.blur_lambda_n(wavelength_nm, point) for point in points_um)
    )
    at_um = np.linspace(-reach_um, reach_um, COMPARISON_POINTS)
    psf = {point: aperture.psf_per_um2(wavelength_nm, lambda_n_um, at_um, at_um, point) for point in points_um}
    cell_um2 = float(at_um[1] - at_um[0]) ** 2
    return max(
        0.5 * cell_um2 * float(np.abs(psf[midpoint] - sum(psf[node] for node in nodes) / len(nodes)).sum())
        for midpoint, nodes in zip(midpoints_um, known_um, strict=True)
    )


def _nodes_um(grid: Grid, n_patches: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return patch centres along y and x, from edge to edge, relative to the grid's centre."""
    y, x = (
        np.linspace(-0.5, 0.5, n) * size * grid.pitch_x_um if n > 1 else np.zeros(1)
        for n, size in zip(n_patches, grid.shape, strict=True)
    )
    return y, x


def _patch_extents(imaging: Imaging, sources: Ints, n: int, node_um: Floats) -> list[PatchExtent]:
    """Return the patch of each node along one axis."""
    first = -((sources.size - n) // 2)
    half_um = 0.5 * n * imaging.grid.pitch_x_um
    at_um = np.clip((first + np.arange(sources.size) + 0.5) * imaging.grid.pitch_x_um - half_um, -half_um, half_um)
    extents = []
    for k in range(node_um.size):
        weight = np.ones(sources.size)
        if node_um.size > 1:
            weight = np.interp(at_um, node_um, np.arange(node_um.size) == k)
        used = np.flatnonzero((weight > 0.0) & (sources >= 0))
        low, high = (int(used[0]), int(used[-1]) + 1) if used.size else (0, 1)
        weight = np.where(sources >= 0, weight, 0.0)[low:high]
        size = int(scipy.fft.next_fast_len(high - low + 2 * imaging.guard, real=True))
        if size >= sources.size:  # the complete padded picture, which is periodic
            size, begin = sources.size, 0
        else:
            begin = low - (size - (high - low)) // 2
        cells = (begin + np.arange(size)) % sources.size + first
        extents.append(PatchExtent(np.maximum(sources[low:high], 0), weight, slice(low - begin, high - begin), cells))
    return extents


def reach_cells(lost_fraction: float, lambda_n_um: float, blur_lambda_n: float, edge: float, pitch_um: float) -> int:
    """Return the radius in cells that contains all but a fraction of the PSF energy."""
    # Beyond r λN lies 2 / (π² r) of the Airy energy; other pupils scale with their edge length. Geometric blur adds up.
    return math.ceil((2.0 / math.pi**2 / lost_fraction * edge + blur_lambda_n) * lambda_n_um / pitch_um)

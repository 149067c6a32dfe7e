"""
Fourier transforms of padded pictures, and filtering of their spectra.

Cells contain the mean irradiance. Points at cell centres have a spectrum of period 1/p. The mean over a cell multiplies
frequency f by sinc(f p), and a square source pixel does so once more. Each alias f + k/p is multiplied by the OTF at
f + k/p, so that cell means are exact for cells both smaller and larger than the PSF.

Cells may be k times finer than the source pixels. The spectrum of points at the centres of source pixels is periodic: it is
repeated k x k times, multiplied by the factors of the fine cells, and transformed back at k times the size. The centre of
the first fine cell is (p - p/k) / 2 before the centre of the first source pixel, which is a phase factor.

Spectra are stored by columns, (n_x, n_y), of which only those below the cut-off frequency are needed. Transforms along y and
products with transfer functions operate on contiguous blocks of columns, which fit the cache of a core. A transfer function
that is even along y is stored for frequencies >= 0 only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from foveasim._core.threads import cached_property, parallel_map
from foveasim._core.validation import Floats, Images, Ints
from foveasim._core.work_arrays import work_array
from foveasim.errors import ParameterError, SimulationError
from foveasim.optics.otf import MAX_ALIASES

if TYPE_CHECKING:
    from foveasim.optics._field_modes import FieldWeight
    from foveasim.optics._imaging import Imaging

#: Callable of (first, last) that returns the columns of a transfer function, (last - first, n): real with the rows of
#: frequencies >= 0 along y, or complex with all rows.
Factor: TypeAlias = Callable[[int, int], NDArray[Any]]

#: Largest number of aliases per side that are summed directly at each frequency.
DIRECT_ALIASES = 1
#: Chebyshev nodes per axis of the interpolated sum of more aliases. The derivative of the OTF is discontinuous at cut-off. For
#: cells of 1.6 to 60 λN, the resulting error is at most 3e-7 of the peak cell of a point image for a clear circle, and 1e-4
#: for other pupils.
ALIAS_NODES = 32
#: Additional nodes per cell of geometric blur, because the phase of the OTF then rotates once per cell.
NODES_PER_CELL = 4.0
#: Singular values below this fraction of the OTF at zero frequency are omitted from the interpolated sum.
ALIAS_ACCURACY = 1e-9
#: Largest width of a padded picture in cells; a wider one indicates a far too small aperture or a wrong unit.
MAX_PADDED = 1 << 17
#: Rows of a picture and columns of a spectrum per task of a thread.
ROWS_PER_BLOCK, COLUMNS_PER_BLOCK = 64, 32
#: Arguments of ``numpy.pad`` for each padding; index -1 denotes zero.
NUMPY_PADDING: dict[str, dict[str, Any]] = {
    "reflect": {"mode": "reflect"},
    "edge": {"mode": "edge"},
    "zero": {"mode": "constant", "constant_values": -1},
    "periodic": {"mode": "wrap"},
}


def source_pixels(n: int, padding: str, pad: int) -> Ints:
    """Return the picture index of each padded cell, or -1; padded to a fast FFT size."""
    if padding == "periodic":
        return np.arange(n)
    if n + 2 * pad > MAX_PADDED:
        raise ParameterError(
            "padding_cells",
            f"must give a padded picture of at most {MAX_PADDED} cells, got {n} + 2 x {pad} = {n + 2 * pad}",
        )
    extra = int(scipy.fft.next_fast_len(n + 2 * pad, real=True)) - n
    return np.pad(np.arange(n), (extra // 2, extra - extra // 2), **NUMPY_PADDING[padding])


class Transform:
    """
    Fourier transforms of padded pictures of one size.

    ``rows``, ``columns``: indices of the picture rows and columns in the padded picture; ``shape``: that of the picture.
    Padding rows are copies of picture rows, so they are not transformed separately, and the padded picture is never stored.
    """

    def __init__(self, imaging: Imaging, rows: Ints, columns: Ints, shape: tuple[int, int]) -> None:
        from foveasim.optics import _kernels

        oversample = imaging.oversample
        self._picture_shape, self._rows, self._columns = shape, rows, columns
        self._real, self._n_threads, self._oversample = imaging.real, imaging.n_threads, oversample
        self._kernels = _kernels  # imported before threads start
        self._n_rows = oversample * rows.size
        self._pitch_um = imaging.grid.pitch_x_um / oversample
        f_max = imaging.f_max_per_um * self._pitch_um
        self._n_alias = min(MAX_ALIASES, max(0, math.ceil(f_max - 0.5)))
        self._source_cells = float(oversample) if imaging.is_square_source else 0.0
        # For even oversampling, the half-cell shift of the origin changes the sign of odd aliases.
        self._is_alternating = oversample % 2 == 0
        self._n_plane_nodes = 2 * ALIAS_NODES + math.ceil(NODES_PER_CELL * imaging.blur_cells * oversample)
        n_near = self._n_alias if self._n_alias <= DIRECT_ALIASES else 0
        self._aliases = np.arange(-n_near, n_near + 1)[:, np.newaxis]
        self._cycles_x = scipy.fft.rfftfreq(oversample * columns.size)
        if self._n_alias == 0:
            self._cycles_x = self._cycles_x[: int(np.searchsorted(self._cycles_x, f_max)) + 1]
        self._n_columns = self._cycles_x.size

    @property
    def map_shape(self) -> tuple[int, int]:
        """Numbers of rows and columns of a map."""
        n_y, n_x = self._picture_shape
        return self._oversample * n_y, self._oversample * n_x

    @property
    def _n_before(self) -> tuple[int, int]:
        """Numbers of padding rows and columns before the picture."""
        n_y, n_x = self._picture_shape
        return (self._rows.size - n_y) // 2, (self._columns.size - n_x) // 2

    def _far_aliases(self, table: NDArray[Any], per_step: float) -> tuple[NDArray[Any], NDArray[Any]]:
        """
        Return the sum of many aliases as separable products, (n_rank, n_x) and (n_rank, n_y).

        Within half a cycle per cell the sum is smooth, so that a few Chebyshev polynomials represent it. For a radial table it
        is an even function, so that half the range suffices.
        """
        is_radial = table.ndim == 1
        if self._n_alias <= DIRECT_ALIASES:
            return np.zeros((0, self._n_columns), table.dtype), np.zeros((0, self._n_rows), table.dtype)
        to_x, to_y = self._from_radial_nodes if is_radial else self._from_plane_nodes
        add_aliases = self._kernels.add_aliases if is_radial else self._kernels.add_plane_aliases
        nodes = np.polynomial.chebyshev.chebpts1(to_x.shape[1])
        cycles = 0.25 * (nodes + 1.0) if is_radial else 0.5 * nodes
        k = np.arange(-self._n_alias, self._n_alias + 1)
        precise = table.astype(np.float64 if is_radial else np.complex128)
        at_nodes = np.zeros((nodes.size, nodes.size), precise.dtype)
        add_aliases(precise, per_step / self._pitch_um, cycles, k, self._gain(cycles, k[:, np.newaxis]), at_nodes)
        y_modes, sizes, x_modes = np.linalg.svd(at_nodes)
        zero = table[0] if is_radial else table[table.shape[0] // 2, table.shape[0] // 2]
        rank = int(np.searchsorted(-sizes, -ALIAS_ACCURACY * max(float(zero.real), 0.0)))
        # Not as matrix products: the threads of BLAS take longer to start than the sums, and would compete with ours.
        far_x = np.ascontiguousarray(np.einsum("xn,rn->rx", to_x, x_modes[:rank]), table.dtype)
        far_y = np.ascontiguousarray(np.einsum("yn,nr->ry", to_y, y_modes[:, :rank] * sizes[:rank]), table.dtype)
        # Every alias is 0 at zero frequency: one more product cancels the interpolation error there, which conserves energy.
        dc_x, dc_y = np.zeros((1, far_x.shape[1]), table.dtype), np.zeros((1, far_y.shape[1]), table.dtype)
        dc_x[0, 0], dc_y[0, 0] = 1.0, -(far_x[:, 0] @ far_y[:, 0])
        return np.concatenate((far_x, dc_x)), np.concatenate((far_y, dc_y))

    @cached_property
    def _even_cycles_y(self) -> Floats:
        """Frequencies >= 0 along y, in cycles per cell."""
        return np.arange(self._n_rows // 2 + 1) / self._n_rows

    @cached_property
    def _all_cycles_y(self) -> Floats:
        """Frequencies along y in the order of the transform, in cycles per cell."""
        cycles = scipy.fft.fftfreq(self._n_rows)
        # Where the sign of half a cycle matters, it is that of even functions.
        return np.where((cycles == -0.5) & self._is_alternating, 0.5, cycles)

    @cached_property
    def _from_radial_nodes(self) -> tuple[Floats, Floats]:
        """Interpolation matrices (n, n_nodes) of an even function along x and y."""
        x, y = (_interpolation(4.0 * cycles - 1.0, ALIAS_NODES) for cycles in (self._cycles_x, self._even_cycles_y))
        return x, y

    @cached_property
    def _from_plane_nodes(self) -> tuple[Floats, Floats]:
        """Interpolation matrices (n, n_nodes) at the frequencies along x and y."""
        x, y = (_interpolation(2.0 * cycles, self._n_plane_nodes) for cycles in (self._cycles_x, self._all_cycles_y))
        return x, y

    @cached_property
    def _radial_samples(self) -> list[tuple[NDArray[Any], NDArray[Any]]]:
        """Frequencies and gains along x, and along y for an even function."""
        return [self._sample(cycles) for cycles in (self._cycles_x, self._even_cycles_y)]

    @cached_property
    def _plane_samples(self) -> list[tuple[NDArray[Any], NDArray[Any]]]:
        """Frequencies and gains along x and y."""
        return [self._sample(cycles) for cycles in (self._cycles_x, self._all_cycles_y)]

    def _sample(self, cycles: Floats) -> tuple[NDArray[Any], NDArray[Any]]:
        """
        Return the frequencies and gains of the directly summed aliases along one axis.

        Both are (n_alias, n); frequencies in 1/µm.
        """
        gain = self._gain(cycles, self._aliases)
        return ((cycles + self._aliases) / self._pitch_um).astype(self._real), gain.astype(self._real)

    def _gain(self, cycles: Floats, aliases: Ints) -> Floats:
        """Return the factor of cells and source pixels for aliases (n_alias, 1), (n_alias, n)."""
        f = cycles + aliases
        sign = np.where(self._is_alternating & (aliases % 2 == 1), -1.0, 1.0)
        return sign * np.sinc(f) * np.sinc(self._source_cells * f)

    def _for_each_block(self, work: Callable[[int, int], None], n: int, n_per_block: int) -> None:
        parallel_map(lambda first: work(first, min(first + n_per_block, n)), range(0, n, n_per_block), self._n_threads)

    def spectra(self, n: int) -> NDArray[Any]:
        """Return uninitialised spectra of n pictures, (n, n_columns, n_rows)."""
        n_columns = min(self._n_columns, self._columns.size // 2 + 1)
        return work_array((n, n_columns, self._rows.size), np.result_type(self._real, np.complex64))

    def sums(self, n: int) -> NDArray[Any]:
        """Return uninitialised spectra of n maps, (n, n_columns, n_rows)."""
        return work_array((n, *self.spectrum_shape), np.result_type(self._real, np.complex64))

    @property
    def spectrum_shape(self) -> tuple[int, int]:
        """Numbers of columns and rows of the spectrum of a map."""
        return self._n_columns, self._n_rows

    def forward(
        self,
        image: Images,
        x2: Floats,
        y2: Floats,
        falloff_power: int,
        out: NDArray[Any],
        weights: Sequence[FieldWeight] = (),
        after: Callable[[int, int], None] | None = None,
        lit_rows: tuple[int, int] | None = None,
    ) -> None:
        """
        Write the spectrum of a padded picture with relative illumination and weights.

        ``after``: called with (first, last) of each block of columns while it is in the cache of a core. ``lit_rows``: first
        and last row outside which the picture is 0.
        """
        (n_y, _), (top, left) = self._picture_shape, self._n_before
        x2, y2 = x2.astype(self._real), y2.astype(self._real)
        along_y, profiles = _stacked(weights, self._picture_shape, self._real)

        begin, end = (0, n_y) if lit_rows is None else lit_rows

        def transform_rows(first: int, last: int) -> None:
            first, last = begin + first, begin + last
            padded = np.empty((last - first, self._columns.size), self._real)
            rows, of_rows = np.ascontiguousarray(image[first:last]), np.ascontiguousarray(along_y[:, first:last])
            self._kernels.apply_falloff(
                rows, x2, y2[first:last], falloff_power, of_rows, profiles, self._columns, left, padded
            )
            self._kernels.store_rows(scipy.fft.rfft(padded, axis=1, overwrite_x=True), top + first, out)

        def transform_columns(first: int, last: int) -> None:
            lines = out[first:last]
            lines[:, top : top + begin] = lines[:, top + end : top + n_y] = 0.0
            self._kernels.pad_lines(self._rows, top, n_y, lines)
            _in_place(scipy.fft.fft, lines)
            if after is not None:
                after(first, last)

        self._for_each_block(transform_rows, end - begin, ROWS_PER_BLOCK)
        self._for_each_block(transform_columns, out.shape[0], COLUMNS_PER_BLOCK)
        if not np.isfinite(out[0, 0]):
            raise SimulationError("the scene must be finite, got NaN or infinite values; mask or replace them")

    def factor(self, table: NDArray[Any], per_step: float) -> Factor:
        """
        Return the transfer function of map cells.

        The table is radial, (n,) from zero frequency, or square, (2 n + 1, 2 n + 1) centred on zero frequency, with
        ``per_step`` steps per 1/µm.
        """
        is_radial = table.ndim == 1
        kernel = self._kernels.radial_factor if is_radial else self._kernels.plane_factor
        (fx, gain_x), (fy, gain_y) = self._radial_samples if is_radial else self._plane_samples
        far_x, far_y = self._far_aliases(table, per_step)
        table = np.ascontiguousarray(table.T)  # frequencies along y, as in the columns of a spectrum, are contiguous

        def compute(first: int, last: int) -> NDArray[Any]:
            out = np.empty((last - first, fy.shape[1]), table.dtype)
            kernel(table, self._real(per_step), fx, fy, gain_x, gain_y, far_x, far_y, first, out)
            return out

        return compute

    def complete(self, factor: Factor) -> NDArray[Any]:
        """Return all columns of a transfer function."""
        blocks = range(0, self._n_columns, COLUMNS_PER_BLOCK)
        return np.concatenate(
            parallel_map(
                lambda first: factor(first, min(first + COLUMNS_PER_BLOCK, self._n_columns)), blocks, self._n_threads
            )
        )

    @property
    def is_filtered_by_blocks(self) -> bool:
        """Whether columns of a sum depend on the same columns of spectra only."""
        return self._oversample == 1

    def for_each_block_of_columns(self, work: Callable[[int, int], None]) -> None:
        """Call a function of (first, last) for all columns of a sum, in threads."""
        self._for_each_block(work, self._n_columns, COLUMNS_PER_BLOCK)

    def filtering(
        self,
        spectra: NDArray[Any],
        factors: Sequence[Factor],
        coefficients: Floats,
        out: NDArray[Any],
        *,
        is_first: bool,
        is_last: bool,
    ) -> Callable[[int, int], None]:
        """
        Return a function of (first, last) that computes columns of a sum.

        It adds ``sum_br coefficients[c, b, r] * factors[r] * spectra[b]`` to ``out[c]``. ``spectra``: (n_basis, n_columns,
        n_rows). ``coefficients``: (n_output, n_basis, n_factor). ``out`` (n_output, n_columns, n_rows): may be the first of
        the spectra, if there are at least as many as outputs and they have the same shape. ``is_first``: whether the result is
        written to ``out`` instead of being added. ``is_last``: whether to transform the sum back along y, for :meth:`inverse`.
        """
        coefficients = np.ascontiguousarray(coefficients, self._real)

        def filter_columns(first: int, last: int) -> None:
            columns = [factor(first, last) for factor in factors]
            together = columns[0][np.newaxis] if len(columns) == 1 else np.stack(columns)
            lines = self._lines(spectra, first, last)
            self._kernels.filter_and_sum(lines, together, coefficients, first, not is_first, out)
            if is_last:
                for output in out:
                    _in_place(scipy.fft.ifft, output[first:last])

        return filter_columns

    def _lines(self, spectra: NDArray[Any], first: int, last: int) -> NDArray[Any]:
        """Return columns of spectra over the frequencies of the map cells."""
        if self._oversample == 1:
            # Of several spectra a copy, since the sums may replace them.
            return spectra[:, first:last] if spectra.shape[0] == 1 else spectra[:, first:last].copy()
        lines = np.empty((spectra.shape[0], last - first, self._n_rows), spectra.dtype)
        for spectrum, out in zip(spectra, lines, strict=True):
            self._kernels.replicate(spectrum, self._columns.size, *self._phases, first, out)
        return lines

    @cached_property
    def _phases(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Phase factors along x and y that move the origin to the centre of the first fine cell."""
        # Factor k per axis: the means of k² times as many cells add up to k² times the sum.
        x, y = (
            (self._oversample * np.exp(-1j * np.pi * (self._oversample - 1) * cycles)).astype(
                np.result_type(self._real, np.complex64)
            )
            for cycles in (self._cycles_x, self._all_cycles_y)
        )
        return x, y

    def inverse(self, lines: NDArray[Any], first_row: int = 0, last_row: int | None = None) -> NDArray[Any]:
        """Return rows of the picture without padding, from a sum that is transformed along y."""
        n_y, n_x = self.map_shape
        top, left = (self._oversample * before for before in self._n_before)
        n_rows = (n_y if last_row is None else last_row) - first_row

        def transformed(first: int, last: int) -> NDArray[Any]:
            rows = np.empty((last - first, lines.shape[0]), lines.dtype)
            self._kernels.load_rows(lines, top + first_row + first, rows)
            padded = scipy.fft.irfft(rows, n=self._oversample * self._columns.size, axis=1, overwrite_x=True)
            return padded[:, left : left + n_x]

        if n_rows <= ROWS_PER_BLOCK:
            return np.ascontiguousarray(transformed(0, n_rows))
        image = work_array((n_rows, n_x), self._real)

        def transform_rows(first: int, last: int) -> None:
            image[first:last] = transformed(first, last)

        self._for_each_block(transform_rows, n_rows, ROWS_PER_BLOCK)
        return image


def _stacked(weights: Sequence[FieldWeight], shape: tuple[int, int], real: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return functions of the field as (n_function, n_y, n) and (n_function, n, n_x)."""
    n_y, n_x = shape
    if not weights:
        return np.empty((0, n_y, 1), real), np.empty((0, 1, n_x), real)
    n = max(w.profiles.shape[0] for w in weights)
    along_y, profiles = np.zeros((len(weights), n_y, n), real), np.zeros((len(weights), n, n_x), real)
    for k, each in enumerate(weights):
        along_y[k, :, : each.along_y.shape[1]], profiles[k, : each.profiles.shape[0]] = each.along_y, each.profiles
    return along_y, profiles


def _interpolation(x: Floats, n_nodes: int) -> Floats:
    """Return the matrix (n, n_nodes) from values at Chebyshev nodes to those at x in [-1, 1]."""
    vandermonde = np.polynomial.chebyshev.chebvander
    nodes = np.polynomial.chebyshev.chebpts1(n_nodes)
    return np.asarray(vandermonde(x, n_nodes - 1) @ np.linalg.inv(vandermonde(nodes, n_nodes - 1)))


def _in_place(transform: Callable[..., NDArray[Any]], lines: NDArray[Any]) -> None:
    """Replace lines by their Fourier transforms."""
    found = transform(lines, axis=1, overwrite_x=True)
    if not np.may_share_memory(found, lines):  # another backend of scipy.fft
        lines[:] = found

"""
Fourier transforms of padded pictures, and filtering of their spectra.

Cells contain the mean irradiance. Points at cell centres have a spectrum of period 1/p. The mean over a cell multiplies
frequency f by sinc(f p), and a square source pixel does so once more. Each alias f + k/p is multiplied by the OTF at
f + k/p, so that cell means are exact for cells both smaller and larger than the PSF.

Cells may be k times finer than the source pixels. The spectrum of points at the centres of source pixels is periodic: it is
repeated k x k times, multiplied by the factors of the fine cells, and transformed back at k times the size. The centre of
the first fine cell is (p - p/k) / 2 before the centre of the first source pixel, which is a phase factor.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from foveasim._core.threads import parallel_map
from foveasim._core.validation import Floats, Images, Ints
from foveasim.errors import ParameterError, SimulationError
from foveasim.optics.otf import MAX_ALIASES

__all__ = ["Transform", "source_pixels"]

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
#: Rows per task of a thread.
ROWS_PER_BLOCK = 64
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

    A spectrum has all padded rows, but only the columns below the cut-off frequency. Padding rows are copies of picture
    rows, so they are not transformed separately, and the padded picture is never stored.
    """

    def __init__(
        self,
        *,
        shape: tuple[int, int],
        rows: Ints,
        columns: Ints,
        pitch_um: float,
        f_max_per_um: float,
        blur_cells: float,
        is_square_source: bool,
        oversample: int,
        real: type[np.floating[Any]],
        n_threads: int,
    ) -> None:
        from foveasim.optics import _kernels

        self._picture_shape, self._rows, self._columns = shape, rows, columns
        self._real, self._n_threads, self._oversample = real, n_threads, oversample
        self._kernels = _kernels  # imported before threads start
        self._n_rows = oversample * rows.size
        self._pitch_um = pitch_um / oversample
        f_max = f_max_per_um * self._pitch_um
        self._n_alias = min(MAX_ALIASES, max(0, math.ceil(f_max - 0.5)))
        self._source_cells = float(oversample) if is_square_source else 0.0
        # For even oversampling, the half-cell shift of the origin changes the sign of odd aliases.
        self._is_alternating = oversample % 2 == 0
        self._n_plane_nodes = 2 * ALIAS_NODES + math.ceil(NODES_PER_CELL * blur_cells * oversample)
        n_near = self._n_alias if self._n_alias <= DIRECT_ALIASES else 0
        k = np.arange(-n_near, n_near + 1)[:, np.newaxis]
        cycles_y = scipy.fft.fftfreq(self._n_rows) + k
        cycles_x = scipy.fft.rfftfreq(oversample * columns.size) + k
        if self._n_alias == 0:
            cycles_x = cycles_x[:, : int(np.searchsorted(cycles_x[0], f_max)) + 1]
        self._n_columns = cycles_x.shape[1]
        self._fx_per_um, self._fy_per_um = ((cycles / self._pitch_um).astype(real) for cycles in (cycles_x, cycles_y))
        sign = np.where(self._is_alternating & (k % 2 == 1), -1.0, 1.0)
        self._gain_x, self._gain_y = (
            (sign * np.sinc(cycles) * np.sinc(self._source_cells * cycles)).astype(real)
            for cycles in (cycles_x, cycles_y)
        )
        self._cycles_x, self._cycles_y = cycles_x[n_near], cycles_y[n_near]

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
        if self._n_alias <= DIRECT_ALIASES:
            return np.zeros((0, self._cycles_x.size), table.dtype), np.zeros((0, self._cycles_y.size), table.dtype)
        is_radial = table.ndim == 1
        n_nodes = ALIAS_NODES if is_radial else self._n_plane_nodes
        sums = self._kernels.alias_sum if is_radial else self._kernels.alias_sum_plane
        nodes = np.polynomial.chebyshev.chebpts1(n_nodes)
        at_nodes = sums(
            table.astype(np.float64 if is_radial else np.complex128),
            per_step / self._pitch_um,
            0.25 * (nodes + 1.0) if is_radial else 0.5 * nodes,
            self._n_alias,
            self._source_cells,
            self._is_alternating,
        )
        y_modes, sizes, x_modes = np.linalg.svd(at_nodes)
        zero = table[0] if is_radial else table[table.shape[0] // 2, table.shape[0] // 2]
        rank = int(np.searchsorted(-sizes, -ALIAS_ACCURACY * max(float(zero.real), 0.0)))
        to_coefficients = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, n_nodes - 1))

        def evaluate(cycles: Floats, modes: NDArray[Any]) -> NDArray[Any]:
            position = 4.0 * np.abs(cycles) - 1.0 if is_radial else 2.0 * cycles
            polynomials = np.polynomial.chebyshev.chebvander(position, n_nodes - 1)
            return np.ascontiguousarray((polynomials @ (to_coefficients @ modes)).T.astype(table.dtype))

        far_x = evaluate(self._cycles_x, x_modes[:rank].T)
        far_y = evaluate(self._cycles_y, y_modes[:, :rank] * sizes[:rank])
        # Every alias is 0 at zero frequency: one more product cancels the interpolation error there, which conserves energy.
        dc_x, dc_y = np.zeros((1, far_x.shape[1]), table.dtype), np.zeros((1, far_y.shape[1]), table.dtype)
        dc_x[0, 0], dc_y[0, 0] = 1.0, -(far_x[:, 0] @ far_y[:, 0])
        return np.concatenate((far_x, dc_x)), np.concatenate((far_y, dc_y))

    def _for_each_row_block(self, work: Callable[[int, int], None], n_rows: int) -> None:
        parallel_map(
            lambda first: work(first, min(first + ROWS_PER_BLOCK, n_rows)),
            range(0, n_rows, ROWS_PER_BLOCK),
            self._n_threads,
        )

    def forward(self, image: Images, x2: Floats, y2: Floats, falloff_power: int) -> NDArray[Any]:
        """Return the spectrum of a picture with relative illumination and padding."""
        (n_y, _), (top, left) = self._picture_shape, self._n_before
        n_columns = min(self._n_columns, self._columns.size // 2 + 1)
        spectrum = np.empty((self._rows.size, n_columns), np.result_type(self._real, np.complex64))
        x2, y2 = x2.astype(self._real), y2.astype(self._real)

        def process_rows(first: int, last: int) -> None:
            padded = np.empty((last - first, self._columns.size), self._real)
            rows = np.ascontiguousarray(image[first:last])
            self._kernels.apply_falloff(rows, x2, y2[first:last], falloff_power, self._columns, left, padded)
            spectrum[top + first : top + last] = scipy.fft.rfft(padded, axis=1, overwrite_x=True)[:, :n_columns]

        self._for_each_row_block(process_rows, n_y)
        for row in (*range(top), *range(top + n_y, self._rows.size)):
            spectrum[row] = spectrum[top + self._rows[row]] if self._rows[row] >= 0 else 0.0
        spectrum = scipy.fft.fft(spectrum, axis=0, overwrite_x=True, workers=self._n_threads)
        if not np.isfinite(spectrum[0, 0]):
            raise SimulationError("the scene must be finite, got NaN or infinite values; mask or replace them")
        return spectrum

    def refine(self, spectrum: NDArray[Any]) -> NDArray[Any]:
        """
        Return the spectrum of the source points over the frequencies of the map cells.

        Without oversampling this is the same array.
        """
        if self._oversample == 1:
            return spectrum
        # Factor k per axis: the means of k² times as many cells add up to k² times the sum. The phase shifts the origin.
        phase_x, phase_y = (
            (self._oversample * np.exp(-1j * np.pi * (self._oversample - 1) * cycles)).astype(spectrum.dtype)
            for cycles in (self._cycles_x, self._cycles_y)
        )
        out = np.empty(self.spectrum_shape, spectrum.dtype)
        self._for_each_row_block(
            lambda first, last: self._kernels.replicate(
                spectrum, self._columns.size, phase_x, phase_y, first, last, out
            ),
            self._n_rows,
        )
        return out

    def multiply(
        self, spectrum: NDArray[Any], table: NDArray[Any], per_step: float, out: NDArray[Any], *, is_added: bool
    ) -> None:
        """
        Write or add a spectrum times a transfer function to ``out``, which may be the spectrum.

        The table is radial, (n,) from zero frequency, or square, (2 n + 1, 2 n + 1) centred on zero frequency, with
        ``per_step`` steps per 1/µm.
        """
        far_x, far_y = self._far_aliases(table, per_step)
        kernel = self._kernels.multiply_otf if table.ndim == 1 else self._kernels.multiply_otf_plane

        def process_rows(first: int, last: int) -> None:
            kernel(
                spectrum,
                table,
                self._real(per_step),
                self._fx_per_um,
                self._fy_per_um,
                self._gain_x,
                self._gain_y,
                far_x,
                far_y,
                is_added,
                first,
                last,
                out,
            )

        self._for_each_row_block(process_rows, spectrum.shape[0])

    @property
    def spectrum_shape(self) -> tuple[int, int]:
        """Numbers of rows and columns of a spectrum."""
        return self._n_rows, self._n_columns

    def factor(self, table: NDArray[Any], per_step: float) -> NDArray[Any]:
        """Return the factor of :meth:`multiply` as an array; real for a radial table."""
        ones = np.ones(self.spectrum_shape, np.result_type(self._real, np.complex64))
        self.multiply(ones, table, per_step, ones, is_added=False)
        return np.ascontiguousarray(ones.real) if table.ndim == 1 else ones

    def multiply_by(self, spectrum: NDArray[Any], factor: NDArray[Any], out: NDArray[Any], *, is_added: bool) -> None:
        """Compute :meth:`multiply` with a precomputed factor; bit-identical."""
        self._for_each_row_block(
            lambda first, last: self._kernels.multiply(spectrum, factor, is_added, first, last, out), spectrum.shape[0]
        )

    def inverse(self, spectrum: NDArray[Any]) -> NDArray[Any]:
        """Return the picture of a spectrum without padding; overwrites the spectrum."""
        n_y, n_x = self.map_shape
        top, left = (self._oversample * before for before in self._n_before)
        lines = scipy.fft.ifft(spectrum, axis=0, overwrite_x=True, workers=self._n_threads)
        image = np.empty(self.map_shape, self._real)

        def process_rows(first: int, last: int) -> None:
            padded = scipy.fft.irfft(lines[top + first : top + last], n=self._oversample * self._columns.size, axis=1)
            image[first:last] = padded[:, left : left + n_x]

        self._for_each_row_block(process_rows, n_y)
        return image

"""
Fourier transforms of pictures of one size, and what is done to their spectra.

Cells are means of the irradiance: points at cell centres have a spectrum that repeats with 1/p, and the mean over a cell
multiplies frequency f by sinc(f p), a square source pixel once more. Every alias f + k/p passes with the pupil's factor at
f + k/p, so that a cell's mean is exact whether it is smaller than the diffraction pattern or larger.

Cells may be k times finer than the source pixels. The spectrum of points at the centres of source pixels is known at all
frequencies, since it repeats: it is written k x k times side by side, multiplied by the factors of the fine cells, and
transformed back at k times the size. The centre of the first fine cell lies (p - p/k) / 2 before that of the first source
pixel, which is a phase.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from foveasim._core.threads import each
from foveasim._core.validation import Floats, Images, Ints
from foveasim.errors import ParameterError, SimulationError
from foveasim.optics.otf import MAX_ALIASES

__all__ = ["Transform", "source_pixels"]

#: Up to so many aliases to a side are added frequency by frequency ...
DIRECT_ALIASES = 1
#: ... and more by a smooth function of the frequency, through this many Chebyshev nodes an axis. The transfer function's bend
#: at its cut-off leaves an error: of a clear circle at most 3e-7 of the brightest cell of a point's image, over 1.6 to 60 λN a
#: cell, and of others 1e-4.
ALIAS_NODES = 32
#: Where geometry throws the light over many cells, a transfer function turns as often within the range: so many nodes more.
NODES_PER_CELL = 4.0
#: Products of that function that are smaller than this fraction of the factor at zero frequency are left out.
ALIAS_ACCURACY = 1e-9
#: A wider padded picture is a slip: of a lens far too small for its picture, or of a unit.
MAX_PADDED = 1 << 17
#: Rows that one thread works on at a time.
ROWS_PER_PIECE = 64
#: How numpy calls our paddings; -1 stands for darkness.
NUMPY_PADDING: dict[str, dict[str, Any]] = {
    "reflect": {"mode": "reflect"},
    "edge": {"mode": "edge"},
    "zero": {"mode": "constant", "constant_values": -1},
    "periodic": {"mode": "wrap"},
}


def source_pixels(n: int, padding: str, pad: int) -> Ints:
    """Along one axis of n cells, the picture's cell that each padded cell shows, or -1; the padded size is a fast one."""
    if padding == "periodic":
        return np.arange(n)
    if n + 2 * pad > MAX_PADDED:
        raise ParameterError(
            "padding_cells", f"of {pad} makes a picture of {n} cells {n + 2 * pad} cells wide, more than {MAX_PADDED}"
        )
    extra = int(scipy.fft.next_fast_len(n + 2 * pad, real=True)) - n
    return np.pad(np.arange(n), (extra // 2, extra - extra // 2), **NUMPY_PADDING[padding])


class Transform:
    """
    The transforms of one size of picture, with nothing computed that is not used.

    A spectrum has the padded number of rows, and only the columns whose frequencies pass the pupil; the rows of the
    padding are copies of the picture's, so neither they nor the padded picture are ever transformed or stored.
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
        self._kernels = _kernels  # once, before there are threads
        self._n_rows = oversample * rows.size
        self._pitch_um = pitch_um / oversample
        f_max = f_max_per_um * self._pitch_um
        self._n_alias = min(MAX_ALIASES, max(0, math.ceil(f_max - 0.5)))
        self._source_cells = float(oversample) if is_square_source else 0.0
        # The phase of an alias differs from that of its frequency by the factor -1 where the cells divide a pixel evenly.
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
        """Rows and columns of a map's cells."""
        n_y, n_x = self._picture_shape
        return self._oversample * n_y, self._oversample * n_x

    @property
    def _before(self) -> tuple[int, int]:
        """Rows and columns of padding before the picture."""
        n_y, n_x = self._picture_shape
        return (self._rows.size - n_y) // 2, (self._columns.size - n_x) // 2

    def _far_aliases(self, table: NDArray[Any], per_step: float) -> tuple[NDArray[Any], NDArray[Any]]:
        """
        Aliases beyond the frequency itself as a sum of products, (n_rank, n_x) and (n_rank, n_y), when they are many.

        Within half a cycle per cell their sum is smooth, so that a few Chebyshev polynomials hold it; that of a radial table is
        even too, and half the range does.
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

        def at(cycles: Floats, modes: NDArray[Any]) -> NDArray[Any]:
            place = 4.0 * np.abs(cycles) - 1.0 if is_radial else 2.0 * cycles
            polynomials = np.polynomial.chebyshev.chebvander(place, n_nodes - 1)
            return np.ascontiguousarray((polynomials @ (to_coefficients @ modes)).T.astype(table.dtype))

        far_x = at(self._cycles_x, x_modes[:rank].T)
        far_y = at(self._cycles_y, y_modes[:, :rank] * sizes[:rank])
        # At zero frequency every alias has the factor 0: one more product takes off what the polynomials leave there,
        # so that no light is lost or made.
        dc_x, dc_y = np.zeros((1, far_x.shape[1]), table.dtype), np.zeros((1, far_y.shape[1]), table.dtype)
        dc_x[0, 0], dc_y[0, 0] = 1.0, -(far_x[:, 0] @ far_y[:, 0])
        return np.concatenate((far_x, dc_x)), np.concatenate((far_y, dc_y))

    def _each_rows(self, work: Callable[[int, int], None], n_rows: int) -> None:
        each(
            lambda first: work(first, min(first + ROWS_PER_PIECE, n_rows)),
            range(0, n_rows, ROWS_PER_PIECE),
            self._n_threads,
        )

    def forward(self, image: Images, x2: Floats, y2: Floats, falloff_power: int) -> NDArray[Any]:
        """Spectrum of a picture with falloff and padding."""
        (n_y, _), (top, left) = self._picture_shape, self._before
        n_columns = min(self._n_columns, self._columns.size // 2 + 1)
        spectrum = np.empty((self._rows.size, n_columns), np.result_type(self._real, np.complex64))
        x2, y2 = x2.astype(self._real), y2.astype(self._real)

        def some_rows(first: int, last: int) -> None:
            padded = np.empty((last - first, self._columns.size), self._real)
            rows = np.ascontiguousarray(image[first:last])
            self._kernels.expose(rows, x2, y2[first:last], falloff_power, self._columns, left, padded)
            spectrum[top + first : top + last] = scipy.fft.rfft(padded, axis=1, overwrite_x=True)[:, :n_columns]

        self._each_rows(some_rows, n_y)
        for row in (*range(top), *range(top + n_y, self._rows.size)):
            spectrum[row] = spectrum[top + self._rows[row]] if self._rows[row] >= 0 else 0.0
        spectrum = scipy.fft.fft(spectrum, axis=0, overwrite_x=True, workers=self._n_threads)
        if not np.isfinite(spectrum[0, 0]):
            raise SimulationError("the scene has values that are not finite")
        return spectrum

    def refine(self, spectrum: NDArray[Any]) -> NDArray[Any]:
        """Spectrum of the points over the frequencies of the map's cells; the same array where cells are source pixels."""
        if self._oversample == 1:
            return spectrum
        # k² as many cells share the sum of the points. The phases move the origin to the first fine cell.
        phase_x, phase_y = (
            (self._oversample * np.exp(-1j * np.pi * (self._oversample - 1) * cycles)).astype(spectrum.dtype)
            for cycles in (self._cycles_x, self._cycles_y)
        )
        out = np.empty(self.spectrum_shape, spectrum.dtype)
        self._each_rows(
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
        Write a spectrum times a transfer function to ``out``, or add it; ``out`` may be the spectrum.

        The table is a radial one (n,) from zero frequency on, or a square (2 n + 1, 2 n + 1) around it, at ``per_step`` steps
        over the frequency (µm).
        """
        far_x, far_y = self._far_aliases(table, per_step)
        kernel = self._kernels.transfer if table.ndim == 1 else self._kernels.transfer_plane

        def some_rows(first: int, last: int) -> None:
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

        self._each_rows(some_rows, spectrum.shape[0])

    @property
    def spectrum_shape(self) -> tuple[int, int]:
        """Rows and columns of a spectrum."""
        return self._n_rows, self._n_columns

    def factor(self, table: NDArray[Any], per_step: float) -> NDArray[Any]:
        """What :meth:`multiply` multiplies by, as an array of the spectrum's shape; real for a radial table."""
        ones = np.ones(self.spectrum_shape, np.result_type(self._real, np.complex64))
        self.multiply(ones, table, per_step, ones, is_added=False)
        return np.ascontiguousarray(ones.real) if table.ndim == 1 else ones

    def multiply_by(self, spectrum: NDArray[Any], factor: NDArray[Any], out: NDArray[Any], *, is_added: bool) -> None:
        """As :meth:`multiply`, bit for bit, with the factor at hand."""
        self._each_rows(
            lambda first, last: self._kernels.multiply(spectrum, factor, is_added, first, last, out), spectrum.shape[0]
        )

    def inverse(self, spectrum: NDArray[Any]) -> NDArray[Any]:
        """The picture of a spectrum, without its padding; the spectrum is used up."""
        n_y, n_x = self.map_shape
        top, left = (self._oversample * before for before in self._before)
        lines = scipy.fft.ifft(spectrum, axis=0, overwrite_x=True, workers=self._n_threads)
        image = np.empty(self.map_shape, self._real)

        def some_rows(first: int, last: int) -> None:
            padded = scipy.fft.irfft(lines[top + first : top + last], n=self._oversample * self._columns.size, axis=1)
            image[first:last] = padded[:, left : left + n_x]

        self._each_rows(some_rows, n_y)
        return image

"""Optical transfer function of the clear circle, and tables of weighted sums of OTFs."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim._core.caches import BoundedCache
from foveasim._core.threads import ForkSafeLock, cached_property, parallel_map
from foveasim._core.validation import Floats, as_numbers
from foveasim.optics._aperture import PSFModel

__all__ = ["MAX_ALIASES", "PlaneTables", "RadialTables", "Tables", "circular_otf"]

#: Largest number of aliases per side. Further aliases are omitted; for a clear circle, the PSF is widened instead. At most
#: 0.3 % of the energy is displaced.
MAX_ALIASES = 128

#: Points of a radial table up to the smallest cut-off; the float32 table fits the L1 cache. The error of linear interpolation
#: is at most 2.4e-7 of the value at zero frequency in float32 and 3.0e-8 in float64, near the cut-off.
TABLE_POINTS: dict[Any, int] = {np.float32: 1 << 13, np.float64: 1 << 15}
#: Waves of defocus of such a table; more defocus requires more points.
WAVES_PER_TABLE = 4.0
#: Points of such a table between those at which the OTF is computed.
SPLINE_STEP = 16
#: The OTF at one point of the field.
ONE_POINT = np.ones((1, 1))
#: Largest number of points of the field whose OTFs are added together.
POINTS_TOGETHER = 32
#: Sums to which tables of points are added together.
SUMS_TOGETHER = 16
#: Largest number of cached apertures, and of modes over the field, one per scene distance.
MAX_CACHED_APERTURES = 4
#: Largest number of cached geometries of scenes.
MAX_CACHED_VIEWS = 16
#: Largest number of cached scenes with depth.
MAX_CACHED_LAYERS = 2
#: Largest number of cached tables of their layers.
MAX_CACHED_RADIAL = 64
#: Memory limit of the tables of all wavelengths, in numbers (128 MiB); beyond it, their step increases.
MAX_TABLE_SIZE = 1 << 24
#: Memory limit of the tables cached per lens, in complex numbers (512 MiB in single precision).
MAX_CACHE_SIZE = 1 << 26
#: Memory limit of the cached factors on spectra, in numbers (512 MiB in single precision): those of 27 modes and
#: 2048 x 2048 cells.
MAX_FACTOR_SIZE = 1 << 27
#: Largest number of sums with recorded requests; the oldest entry is removed first.
MAX_RECORDED_SUMS = 512


def circular_otf(s: ArrayLike) -> Floats:
    """
    Compute the optical transfer function of a clear circular pupil in focus.

    Parameters
    ----------
    s : array
        Spatial frequency over the cut-off, ``f * wavelength * N`` with the image-side f-number N; the sign is ignored.

    Returns
    -------
    otf : array of the same shape, float64
        ``(2/π) (acos s - s sqrt(1 - s²))``, and 0 for ``s >= 1``. OTF(0) = 1 conserves energy.

    Notes
    -----
    Goodman, Introduction to Fourier Optics, section on the OTF of a diffraction-limited system.

    Examples
    --------
    >>> import foveasim as fs
    >>> fs.optics.circular_otf([0.0, 0.25, 0.5, 1.0]).round(5).tolist()
    [1.0, 0.68504, 0.391, 0.0]
    """
    ratio: Floats = np.minimum(np.abs(as_numbers("s", s)), 1.0)
    return np.asarray((2.0 / np.pi) * (np.arccos(ratio) - ratio * np.sqrt(1.0 - ratio * ratio)))


def defocused_otf(s: ArrayLike, waves: float) -> Floats:
    """
    Compute the optical transfer function of a defocused clear circular pupil.

    Parameters
    ----------
    s : array
        As for :func:`circular_otf`.
    waves : float
        Path difference at the edge of the pupil, in wavelengths.

    Returns
    -------
    otf : array of the same shape, float64
        Real, since the pupil is symmetric.

    Notes
    -----
    H. H. Hopkins, The frequency response of a defocused optical system, Proc. R. Soc. A 231, 91 (1955). Two pupils that are
    displaced by ±s overlap in a lens, in which the phase difference is ``8π w s x``: the OTF is
    ``(4/π) ∫ cos(8π w s x) sqrt(1 - (x + s)²) dx`` from 0 to 1 - s, here by Gauss-Legendre quadrature over asin(x + s).
    """
    ratio: Floats = np.minimum(np.abs(as_numbers("s", s)), 1.0)
    highest = 2.0 * np.pi * abs(waves)  # largest phase in the overlap
    nodes, weights = np.polynomial.legendre.leggauss(24 + math.ceil(0.75 * highest))
    first = np.arcsin(ratio)
    half = 0.5 * (0.5 * np.pi - first)
    total = np.zeros(ratio.shape)
    for node, weight in zip(nodes, weights, strict=True):
        angle = first + half * (1.0 + node)
        total += weight * np.cos(8.0 * np.pi * waves * ratio * (np.sin(angle) - ratio)) * np.cos(angle) ** 2
    return np.asarray((4.0 / np.pi) * half * total)


class Tables(Protocol):
    """Tables of weighted sums of OTFs, for :class:`foveasim.optics._transform.Transform`."""

    def __call__(self, weight: Floats) -> tuple[NDArray[Any], float]:
        """Return the table of ``sum_k weight[k] * OTF_k``, and its steps per frequency (µm)."""


class RadialTables:
    """
    OTF tables of a clear circle, over ``|f|`` up to the highest cut-off.

    ``waves`` (n_wavelength,): defocus at the edge of the pupil, in wavelengths; None in focus.
    """

    def __init__(self, cutoff_per_um: Floats, real: type[np.floating[Any]], waves: Floats | None = None) -> None:
        f_max_per_um = float(cutoff_per_um.max())
        self._real, self._waves = real, np.zeros(cutoff_per_um.size) if waves is None else waves
        n_wanted = TABLE_POINTS[real] * float(f_max_per_um / cutoff_per_um.min())
        n_wanted *= max(1.0, float(np.abs(self._waves).max()) / WAVES_PER_TABLE)
        n_points = max(TABLE_POINTS[real], int(min(n_wanted, MAX_TABLE_SIZE / cutoff_per_um.size)))
        self._f_per_um, self._cutoff_per_um = np.linspace(0.0, f_max_per_um, n_points), cutoff_per_um
        self._per_step = (n_points - 1) / f_max_per_um
        self._otfs: dict[int, Floats] = {}

    def _otf(self, k: int) -> Floats:
        if k not in self._otfs:
            ratio, waves = self._f_per_um / self._cutoff_per_um[k], float(self._waves[k])
            self._otfs[k] = circular_otf(ratio) if waves == 0.0 else _interpolated_otf(ratio, waves)
        return self._otfs[k]

    def __call__(self, weight: Floats) -> tuple[NDArray[Any], float]:
        """Return the table, and its steps per frequency (µm)."""
        total = np.zeros(self._f_per_um.size)
        for k in np.flatnonzero(weight):
            total += weight[k] * self._otf(int(k))
        return total.astype(self._real), self._per_step


def _interpolated_otf(ratio: Floats, waves: float) -> Floats:
    """Return the OTF with defocus at equidistant frequencies, by a cubic spline, within 1e-5."""
    from scipy.interpolate import CubicSpline

    within = np.linspace(0.0, 1.0, max(ratio.size // SPLINE_STEP, 2))
    return np.asarray(CubicSpline(within, defocused_otf(within, waves))(np.minimum(ratio, 1.0)))


class PlaneTables:
    """
    Complex OTF tables over (f_y, f_x) of an arbitrary aperture.

    They are for one point of the field, or for modes of several. A mode is a sum of the PSFs at the points: its weights are
    a row of ``combinations`` (n_mode, n_point). The weights of a sum are those of all wavelengths in the first mode, in the
    second, and so on. The sampling of the aperture is adapted to each wavelength, so that all OTFs have the same frequency
    step and can be added.
    """

    def __init__(
        self,
        aperture: PSFModel,
        wavelength_nm: Floats,
        lambda_n_um: Floats,
        points_um: Sequence[tuple[float, float]],
        real: type[np.floating[Any]],
        combinations: Floats = ONE_POINT,
        n_threads: int = 1,
    ) -> None:
        self._aperture, self._points_um, self._real = aperture, points_um, real
        self._wavelength_nm, self._lambda_n_um = wavelength_nm, lambda_n_um
        self._combinations, self._n_threads = combinations, n_threads
        self._cache: dict[bytes, NDArray[Any]] = {}
        self._sums: list[Floats] = []

    @cached_property
    def _per_step(self) -> float:
        n_across = [
            max(self._aperture.n_across(float(w), point) for point in self._points_um) for w in self._wavelength_nm
        ]
        return float((np.array(n_across) * self._lambda_n_um).max())

    @cached_property
    def _n_lags(self) -> int:
        return math.ceil(self._per_step / float(self._lambda_n_um.min()))

    def prepare(self, weights: Sequence[Floats]) -> None:
        """Compute the tables of several sums in one pass, up to the memory limit."""
        self._sums = list(weights)
        if weights:
            self._compute(weights)

    def _compute(self, weights: Sequence[Floats]) -> dict[bytes, NDArray[Any]]:
        """Return the table of at least the first sum, and cache as many as the limit admits."""
        known, requested = self._cache, weights[0].tobytes()
        n_cached = max(
            1, (MAX_TABLE_SIZE if len(self._points_um) == 1 else MAX_CACHE_SIZE) // (2 * self._n_lags + 1) ** 2
        )
        weights = [w for w in weights if w.tobytes() not in known][:n_cached]
        if not weights:
            return known
        # Other threads may read the cache: it is replaced, never changed.
        if len(known) + len(weights) > n_cached:
            known = {requested: known[requested]} if requested in known else {}
            weights, self._cache = weights[: n_cached - len(known)], known
            if not weights:
                return known
        of_mode = np.reshape(weights, (len(weights), len(self._combinations), -1))
        # Sums over the wavelengths at each point, which modes share.
        spectra, which = np.unique(of_mode.reshape(-1, of_mode.shape[2]), axis=0, return_inverse=True)
        which = which.reshape(of_mode.shape[:2])
        parts = np.stack([(which == k) @ self._combinations for k in range(len(spectra))], axis=1)
        sums = np.zeros((len(weights), *(2 * self._n_lags + 1,) * 2), np.result_type(self._real, np.complex64))
        n_points, n_numbers = len(self._points_um), len(spectra) * sums[0].size
        n_together = max(1, min(POINTS_TOGETHER, MAX_TABLE_SIZE // n_numbers))
        for first in range(0, n_points, n_together):
            at = range(first, min(first + n_together, n_points))
            # The first call samples the pupil, which all points share, at each wavelength if it is chromatic.
            found = [self._at_point(point, spectra) for point in at[: 1 if first == 0 else 0]]
            n_threads = self._n_threads if self._aperture.is_achromatic else 1
            found += parallel_map(lambda point: self._at_point(point, spectra), at[len(found) :], n_threads)
            for k in range(len(spectra)):
                tables = [each[k] for each in found]
                if tables[0] is not None:
                    self._add(sums, parts[:, k, at.start : at.stop], tables)
        self._cache = known = known | {weight.tobytes(): total for weight, total in zip(weights, sums, strict=True)}
        return known

    def _add(self, sums: NDArray[Any], weights: Floats, tables: Sequence[NDArray[Any] | None]) -> None:
        """Add ``weights @ tables`` to sums, of one point or of several."""
        if weights.shape == (1, 1) and weights[0, 0] == 1.0:
            sums[0] += tables[0]
            return
        used = np.flatnonzero(weights.any(axis=1))
        flat = np.stack([each for each in tables if each is not None]).view(self._real).reshape(len(tables), -1)
        weights = weights[used].astype(self._real)
        for first in range(0, used.size, SUMS_TOGETHER):
            some = slice(first, first + SUMS_TOGETHER)
            sums[used[some]] += (weights[some] @ flat).view(sums.dtype).reshape(-1, *sums.shape[1:])

    def _at_point(self, point: int, spectra: Floats) -> list[NDArray[Any] | None]:
        """Return the OTF of each sum over wavelengths at a point, None for no wavelength."""
        sums: list[NDArray[Any] | None] = [None] * len(spectra)
        for k in np.flatnonzero(np.any(spectra, axis=0)):
            n_across = self._per_step / float(self._lambda_n_um[k])
            otf = self._aperture.compute_otf(
                float(self._wavelength_nm[k]), n_across, self._n_lags, self._points_um[point], self._real
            )
            power = self._aperture.relative_power(float(self._wavelength_nm[k]), self._points_um[point])
            for i, weight in enumerate(spectra[:, k]):
                if weight:
                    part = self._real(weight * power) * otf
                    total = sums[i]
                    sums[i] = part if total is None else np.add(total, part, out=total)
        return sums

    def __call__(self, weight: Floats) -> tuple[NDArray[Any], float]:
        """Return the table, and its steps per frequency (µm)."""
        key = weight.tobytes()
        found = self._cache.get(key)
        if found is None:
            # With those that are requested next.
            keys = [each.tobytes() for each in self._sums]
            found = self._compute(self._sums[keys.index(key) :] if key in keys else [weight])[key]
        return found, self._per_step

    @property
    def size(self) -> int:
        """Number of cached values."""
        return sum(table.size for table in self._cache.values())


class TableCache:
    """
    Cache of apertures, OTF tables and factors of a lens, with memory limits; not pickled.

    All frames of a video use the same tables. Tables of other spectra are evicted first; tables that still exceed the limit are
    recomputed for each frame.
    """

    def __init__(self) -> None:
        self._lock = ForkSafeLock()
        self._tables: dict[tuple[Hashable, Hashable], PlaneTables] = {}
        self._factors: dict[tuple[Hashable, bytes], NDArray[Any] | None] = {}
        #: Apertures, modes and relative illumination of the field, and images of scenes by their geometry.
        self.apertures: BoundedCache = BoundedCache(MAX_CACHED_APERTURES)
        self.modes: BoundedCache = BoundedCache(MAX_CACHED_APERTURES)
        self.illumination: BoundedCache = BoundedCache(MAX_CACHED_APERTURES)
        self.views: BoundedCache = BoundedCache(MAX_CACHED_VIEWS)
        #: Of scenes with depth: tables of layers, layers, and lenses with a focus, each with its own cache.
        self.radial: BoundedCache = BoundedCache(MAX_CACHED_RADIAL)
        self.layers: BoundedCache = BoundedCache(MAX_CACHED_LAYERS)
        self.focused: BoundedCache = BoundedCache(MAX_CACHED_LAYERS)

    def __reduce__(self) -> tuple[type[TableCache], tuple[()]]:
        return TableCache, ()

    def prepare(
        self,
        spectrum: Hashable,
        field: Hashable,
        create: Callable[[], PlaneTables],
        weights: Sequence[Floats],
    ) -> PlaneTables:
        """Return tables for a point or the modes of a field, with weighted sums computed."""
        with self._lock:
            tables = self._tables.get((spectrum, field)) or create()
        tables.prepare(weights)
        with self._lock:
            self._tables[spectrum, field] = tables
            for other in [key for key in self._tables if key[0] != spectrum]:
                if self._size() > MAX_CACHE_SIZE:
                    del self._tables[other]
            if len(self._tables) > 1 and self._size() > MAX_CACHE_SIZE:
                del self._tables[spectrum, field]
        return tables

    def factor(
        self, spectrum: Hashable, weight: Floats, n_numbers: int, create: Callable[[], NDArray[Any]]
    ) -> NDArray[Any] | None:
        """
        Return the cached factor on spectra for a weighted sum, from the second request on.

        Return None at the first request, since caching does not pay for a single picture, and if the memory limit is reached.
        Factors of other spectra or picture sizes are evicted first.
        """
        key = spectrum, weight.tobytes()
        with self._lock:
            is_new = key not in self._factors
            found = self._factors.setdefault(key, None)
            while len(self._factors) > MAX_RECORDED_SUMS:
                del self._factors[next(iter(self._factors))]
            if is_new or found is not None:
                return found
            for other in [other for other in self._factors if other[0] != spectrum]:
                if self._factor_size() + n_numbers > MAX_FACTOR_SIZE:
                    del self._factors[other]
            if self._factor_size() + n_numbers > MAX_FACTOR_SIZE:
                return None
        found = create()
        with self._lock:
            self._factors[key] = found
        return found

    def _factor_size(self) -> int:
        return sum(f.size * (2 if np.iscomplexobj(f) else 1) for f in self._factors.values() if f is not None)

    def _size(self) -> int:
        return sum(tables.size for tables in self._tables.values())

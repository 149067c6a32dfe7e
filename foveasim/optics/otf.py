"""The transfer function of a clear circular pupil, and radial tables of weighted sums of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foveasim.arrays import Floats

__all__ = ["RadialTables", "circular_otf"]

#: Points of a radial table up to the smallest cut-off; the one of float32 fits the first-level cache. Linear interpolation
#: errs by at most 2.4e-7 of the value at zero frequency in float32 and 3.0e-8 in float64, next to the cut-off.
TABLE_POINTS = {np.float32: 1 << 13, np.float64: 1 << 15}
#: Numbers that the tables of all wavelengths may hold together, 128 MiB; beyond that their steps grow.
MAX_TABLE_SIZE = 1 << 24


def circular_otf(s: ArrayLike) -> Floats:
    """
    Optical transfer function of a clear circle in focus.

    Parameters
    ----------
    s : array
        Spatial frequency over the cut-off, ``f * wavelength * N`` with the image-side f-number N; the sign does not
        matter.

    Returns
    -------
    otf : array of the same shape, float64
        ``(2/π) (acos s - s sqrt(1 - s²))``, and 0 from ``s = 1`` on. OTF(0) = 1: no light is lost.

    Notes
    -----
    Goodman, Introduction to Fourier Optics, section on the OTF of a diffraction-limited system.
    """
    s = np.minimum(np.abs(np.asarray(s, dtype=np.float64)), 1.0)
    return np.asarray((2.0 / np.pi) * (np.arccos(s) - s * np.sqrt(1.0 - s * s)))


class RadialTables:
    """Makes tables of ``sum_k weight[k] * OTF_k(|f|)`` over ``|f|`` at equal steps, the last one beyond every cut-off."""

    def __init__(self, cutoff_per_um: Floats, real: type[np.floating[Any]]) -> None:
        self.f_max_per_um = float(cutoff_per_um.max())
        self._real = real
        wanted = TABLE_POINTS[real] * float(self.f_max_per_um / cutoff_per_um.min())
        n_points = max(TABLE_POINTS[real], int(min(wanted, MAX_TABLE_SIZE / cutoff_per_um.size)))
        self._otf = circular_otf(np.linspace(0.0, self.f_max_per_um, n_points) / cutoff_per_um[:, np.newaxis])

    def __call__(self, weight: Floats) -> tuple[NDArray[Any], float]:
        """The table, and its steps over frequency (µm)."""
        return (weight @ self._otf).astype(self._real), (self._otf.shape[1] - 1) / self.f_max_per_um

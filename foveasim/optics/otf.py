"""The transfer function of a clear circular pupil."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from foveasim.arrays import Floats

__all__ = ["circular_otf"]


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

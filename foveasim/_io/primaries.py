"""Primaries of colours: tristimulus values, and matrices to linear sRGB."""

from __future__ import annotations

import numpy as np

from foveasim._core.validation import Floats

#: Chromaticities (x, y) of red, green, blue and white of sRGB (IEC 61966-2-1).
SRGB_XY = np.array([[0.64, 0.33], [0.30, 0.60], [0.15, 0.06], [0.3127, 0.3290]])
#: Sharpened cone responses of XYZ (Lam 1985, Bradford).
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def xyz_of_xy(xy: Floats) -> Floats:
    """Return tristimulus values (n, 3) of chromaticities (n, 2), with Y = 1."""
    return np.column_stack((xy[:, 0], xy[:, 1], 1.0 - xy.sum(axis=1))) / xy[:, 1:]


def xyz_of_primaries(xy: Floats) -> Floats:
    """
    Return the tristimulus values (3, 3) of linear red, green and blue, one per row.

    Their sum is white. ``xy`` (4, 2): chromaticities of red, green, blue and white. Raises LinAlgError when the primaries are
    on a line.
    """
    xyz = xyz_of_xy(xy)
    return np.asarray(np.linalg.solve(xyz[:3].T, xyz[3])[:, np.newaxis] * xyz[:3])


#: Tristimulus values of linear red, green and blue of sRGB, one primary per row, and of its white.
XYZ_OF_SRGB = xyz_of_primaries(SRGB_XY)
WHITE_XYZ = XYZ_OF_SRGB.sum(axis=0)


def srgb_of_xyz(xyz: Floats, white_xyz: Floats) -> Floats:
    """
    Return linear sRGB (n, 3) of tristimulus values (n, 3).

    Chromatic adaptation to D65 by the linear Bradford transform: white (3,) becomes (1, 1, 1).
    """
    cones = xyz @ BRADFORD.T / (BRADFORD @ white_xyz) * (BRADFORD @ WHITE_XYZ)
    return np.asarray(np.linalg.solve(XYZ_OF_SRGB.T, np.linalg.solve(BRADFORD, cones.T)).T)

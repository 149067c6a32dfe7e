"""Affine images of outlines with given centroids and second moments."""

from __future__ import annotations

import numpy as np

from foveasim._core.validation import Bools, Floats

#: Overlaps below this fraction of the area of an opening are slivers, whose power is negligible: no outline follows from them.
MIN_OVERLAP = 1e-6


def central_moments(sums: Floats) -> tuple[Floats, Floats]:
    """
    Return centroids and covariances of areas.

    ``sums`` (n, 6): area, and moments of x, y, x², xy, y². Returns ``centroid`` (n, 2) and ``covariance`` (n, 3): xx, xy, yy.
    """
    area = sums[:, :1]
    centroid = sums[:, 1:3] / area
    x, y = centroid.T
    return centroid, sums[:, 3:6] / area - np.stack((x * x, x * y, y * y), axis=1)


def affine_maps(before: Floats, after: Floats) -> tuple[Floats, Floats, Bools]:
    """
    Return the affine maps of areas to others with given moments.

    ``before``, ``after`` (n, 6): area, and moments of x, y, x², xy, y². Returns ``matrix`` (n, 3): elements xx, xy, yy of the
    symmetric matrix M with ``M C₀ M = C₁`` for the covariances; ``centroid_shift`` (n, 2); and a mask (n,) of the areas that
    have such a map. M is the identity for others. In the square root of a symmetric 2 x 2 matrix X,
    ``sqrt(X) = (X + sqrt(det X)) / sqrt(tr X + 2 sqrt(det X))``.
    """
    has_map = after[:, 0] > MIN_OVERLAP * before[:, 0]
    after = np.where(has_map[:, np.newaxis], after, before)
    (centroid_0, covariance_0), (centroid_1, covariance_1) = central_moments(before), central_moments(after)
    root = _square_root(covariance_0)
    inner = _square_root(_product(root, covariance_1))
    matrix = _product(_inverse(root), inner)
    has_map &= np.isfinite(matrix).all(axis=1) & (determinant(matrix) > 0.0)
    identity = np.array([1.0, 0.0, 1.0])
    keep = has_map[:, np.newaxis]
    return np.where(keep, matrix, identity), np.where(keep, centroid_1 - centroid_0, 0.0), has_map


def determinant(matrix: Floats) -> Floats:
    """Return the determinants of symmetric matrices, (n, 3) to (n,)."""
    a, b, c = matrix.T
    return np.asarray(a * c - b * b)


def _square_root(matrix: Floats) -> Floats:
    a, b, c = matrix.T
    root = np.sqrt(np.maximum(a * c - b * b, 0.0))
    return np.asarray(np.stack((a + root, b, c + root), axis=1) / np.sqrt(a + c + 2.0 * root)[:, np.newaxis])


def _inverse(matrix: Floats) -> Floats:
    a, b, c = matrix.T
    return np.asarray(np.stack((c, -b, a), axis=1) / determinant(matrix)[:, np.newaxis])


def _product(outer: Floats, inner: Floats) -> Floats:
    """Return the symmetric products ``outer inner outer``."""
    (p, q, r), (a, b, c) = outer.T, inner.T
    return np.stack(
        (
            p * p * a + 2.0 * p * q * b + q * q * c,
            p * q * a + (p * r + q * q) * b + q * r * c,
            q * q * a + 2.0 * q * r * b + r * r * c,
        ),
        axis=1,
    )

"""Kernel of products with sparse matrices, against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array

from foveasim.integrate._kernels import multiply_rows


@pytest.mark.parametrize(("dtype", "limit"), [(np.float32, 1e-5), (np.float64, 1e-13)])
@pytest.mark.parametrize("density", [0.0, 0.01, 0.3])
def test_products_of_rows_agree_with_scipy(density, dtype, limit):
    rng = np.random.default_rng(0)
    matrix = csr_array(np.where(rng.random((31, 400)) < density, rng.random((31, 400)), 0.0).astype(dtype))
    cells = rng.random((5, 400)).astype(dtype)
    sums = np.full((5, 31), np.nan, dtype)
    multiply_rows(matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32), matrix.data, cells, sums)

    np.testing.assert_allclose(sums, (matrix @ cells.T).T, rtol=limit, atol=0.0)

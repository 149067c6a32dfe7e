"""Kernel that pads pictures, against indices of NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from foveasim.optics._kernels import pad_pictures

N_Y, N_X = 7, 9
ROWS = {
    "whole": np.arange(N_Y),
    "top row first": np.arange(N_Y)[::-1].copy(),
    "mirrored": np.array([1, 0, 0, 1, 2, 3, 4, 5, 6, 6, 5]),
}
COLUMNS = {
    "whole": [(0, 9, 1)],
    "mirrored": [(2, 3, -1), (0, 9, 1), (8, 4, -1)],
    "repeated": [(0, 3, 0), (0, 9, 1), (8, 1, 0)],
    "reversed": [(8, 9, -1)],
    "single pixels": [(4, 1, 1), (2, 1, -1), (7, 1, 0)],
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("row", ROWS)
@pytest.mark.parametrize("column", COLUMNS)
def test_padding_repeats_pixels_of_runs(row, column, dtype):
    rng = np.random.default_rng(0)
    pictures = rng.random((2, N_Y, N_X)).astype(dtype)
    source_column = np.concatenate([first + step * np.arange(n) for first, n, step in COLUMNS[column]])
    window = rng.random((ROWS[row].size, source_column.size)).astype(dtype)
    padded = np.full((2, *window.shape), np.nan, dtype)
    pad_pictures(pictures, ROWS[row], np.array(COLUMNS[column]), window, padded)

    np.testing.assert_array_equal(padded, pictures[:, ROWS[row]][:, :, source_column] * window)

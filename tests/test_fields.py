"""Grids, power maps, and conversion of the row order."""

from __future__ import annotations

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.fields import from_file_rows, to_file_rows

#: The letter F in file order: top row first, arms to the right.
F = np.array([[1, 1, 1], [1, 0, 0], [1, 1, 0], [1, 0, 0], [1, 0, 0]])


def test_first_file_row_has_highest_y():
    assert from_file_rows(F)[0, -1].tolist() == [1, 1, 1]
    assert from_file_rows(F)[0, 0].tolist() == [1, 0, 0]


@pytest.mark.parametrize("picture", [F, np.stack([F, 2 * F, 3 * F], axis=-1)])
def test_row_order_conversion_is_invertible(picture):
    channels = from_file_rows(picture)

    assert np.array_equal(to_file_rows(channels[0] if picture.ndim == 2 else channels), picture)


def test_cell_centres_are_inside_bounds():
    grid = fs.Grid(shape=(2, 3), pitch_um=0.5, origin_um=(10.0, -4.0))

    assert grid.x_um.tolist() == [10.25, 10.75, 11.25]
    assert grid.y_um.tolist() == [-3.75, -3.25]
    assert grid.bounds_um == (10.0, -4.0, 11.5, -3.0)
    assert grid.cell_area_um2 == 0.25


def test_centred_grid_is_centred_on_axis():
    grid = fs.Grid.centred((5, 8), 0.3)

    assert grid.x_um.sum() == pytest.approx(0.0, abs=1e-12)
    assert grid.y_um[2] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"shape": (0, 3)}, r"'shape\[0\]' must be >= 1, got 0"),
        ({"shape": (2.5, 3)}, r"'shape\[0\]' must be an integer"),
        ({"shape": 7}, r"'shape' must be two integers"),
        ({"pitch_um": 0.0}, r"'pitch_um' must be > 0, got 0.0 µm"),
        ({"pitch_um": -1}, r"'pitch_um' must be > 0, got -1 µm"),
        ({"pitch_um": float("inf")}, r"'pitch_um' must be finite"),
        ({"origin_um": (0.0, float("nan"))}, r"'origin_um' must be finite everywhere, got nan µm at \[1\]"),
        ({"origin_um": (1, 2, 3)}, r"'origin_um' must be two numbers"),
    ],
)
def test_invalid_grid_is_rejected(values, message):
    with pytest.raises(ParameterError, match=message):
        fs.Grid(**{"shape": (4, 5), "pitch_um": 1.0, **values})


@pytest.mark.parametrize(
    ("data", "wavelength_nm", "message"),
    [
        (np.ones((2, 4, 5)), [550.0], r"'data' must have the shape .* \(1, 4, 5\) .* got \(2, 4, 5\)"),
        (np.ones((4, 5)), [550.0], r"'data' must have the shape"),
        (np.ones((1, 5, 4)), [550.0], r"'data' must have the shape"),
        (np.ones((1, 4, 5)), [0.0], r"'wavelength_nm' must be > 0"),
        (np.ones((1, 4, 5)), [float("nan")], r"'wavelength_nm' must be finite everywhere, got nan nm at \[0\]"),
    ],
)
def test_mismatched_power_map_is_rejected(data, wavelength_nm, message):
    with pytest.raises(ParameterError, match=message):
        fs.PowerMap(data, fs.Grid((4, 5), 1.0), np.array(wavelength_nm))


def test_power_map_copies_writeable_array():
    data = np.ones((1, 4, 5))
    power_map = fs.PowerMap(data, fs.Grid((4, 5), 1.0), np.array([550.0]))

    with pytest.raises(ValueError, match="read-only"):
        power_map.data[0, 0, 0] = 2.0
    data[0, 0, 0] = 3.0

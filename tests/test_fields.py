"""Carriers: the grid's geometry, the power map's fit, and the one place where rows are turned over."""

from __future__ import annotations

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.fields import from_file_rows, to_file_rows

#: An F in file order: the first row is on top, the arms point to the right.
F = np.array([[1, 1, 1], [1, 0, 0], [1, 1, 0], [1, 0, 0], [1, 0, 0]])


def test_the_first_row_of_a_file_is_the_highest_y():
    assert from_file_rows(F)[0, -1].tolist() == [1, 1, 1]
    assert from_file_rows(F)[0, 0].tolist() == [1, 0, 0]


@pytest.mark.parametrize("picture", [F, np.stack([F, 2 * F, 3 * F], axis=-1)])
def test_turning_rows_there_and_back_changes_nothing(picture):
    there = from_file_rows(picture)

    assert np.array_equal(to_file_rows(there[0] if picture.ndim == 2 else there), picture)


def test_cell_centres_lie_half_a_pitch_inside_the_borders():
    grid = fs.Grid(shape=(2, 3), pitch_um=0.5, origin_um=(10.0, -4.0))

    assert grid.x_um.tolist() == [10.25, 10.75, 11.25]
    assert grid.y_um.tolist() == [-3.75, -3.25]
    assert grid.bounds_um == (10.0, -4.0, 11.5, -3.0)
    assert grid.cell_area_um2 == 0.25


def test_a_centred_grid_has_its_middle_on_the_axis():
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
        ({"origin_um": (0.0, float("nan"))}, r"'origin_um\[1\]' must be finite"),
        ({"origin_um": (1, 2, 3)}, r"'origin_um' must be two numbers"),
    ],
)
def test_a_grid_that_cannot_be_is_refused(values, message):
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
def test_a_power_map_that_does_not_fit_is_refused(data, wavelength_nm, message):
    with pytest.raises(ParameterError, match=message):
        fs.PowerMap(data, fs.Grid((4, 5), 1.0), np.array(wavelength_nm))


def test_a_power_map_is_read_only_and_leaves_the_callers_array_alone():
    data = np.ones((1, 4, 5))
    power_map = fs.PowerMap(data, fs.Grid((4, 5), 1.0), np.array([550.0]))

    with pytest.raises(ValueError, match="read-only"):
        power_map.data[0, 0, 0] = 2.0
    data[0, 0, 0] = 3.0

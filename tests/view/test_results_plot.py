"""Plots of sweeps: curves are those of the data, along the right setting; unknown names and too many curves are rejected."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from foveasim.errors import ParameterError
from foveasim.view import plot_results

#: Metric of f-number, depth and site shape, twice each.
N = np.arange(6 * 3 * 2 * 2, dtype=float).reshape(6, 3, 2, 2)


@cache
def results():
    import xarray as xr

    return xr.Dataset(
        {
            "mtf": (("optics.f_number", "sensor.bits", "layout.kind", "repeat"), N),
            "psnr_db": ("sensor.bits", [20.0, 26.0, 27.0], {"units": "dB"}),
            "seed": ("sensor.bits", [1, 2, 3]),
            "error": ("sensor.bits", ["", "", ""]),
        },
        {
            "optics.f_number": ("optics.f_number", [1.4, 2.0, 2.8, 4.0, 5.6, 8.0]),
            "sensor.bits": [8, 10, 12],
            "layout.kind": ["grid", "hexagonal"],
        },
    )


def lines_of(ax):
    return {line.get_label(): line.get_ydata().tolist() for line in ax.lines}


def test_curves_are_those_of_the_data():
    ax = plot_results(results())

    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_xscale()) == ("optics.f_number", "mtf", "log")
    assert lines_of(ax) == {
        f"sensor.bits = {bits}, layout.kind = {kind}": N[:, k, j].mean(axis=-1).tolist()
        for k, bits in enumerate((8, 10, 12))
        for j, kind in enumerate(("grid", "hexagonal"))
    }
    assert ax.lines[0].get_xdata().tolist() == [1.4, 2.0, 2.8, 4.0, 5.6, 8.0]


def test_settings_are_selected():
    ax = plot_results(results(), "mtf", x="sensor.bits", at={"optics.f_number": 5.0, "layout.kind": "hexagonal"})

    assert list(lines_of(ax).values()) == [N[4, :, 1].mean(axis=-1).tolist()]
    assert (ax.get_xscale(), plot_results(results(), "psnr_db").get_ylabel()) == ("linear", "psnr_db / dB")


def test_categories_are_along_x():
    ax = plot_results(results(), "mtf", x="layout.kind", at={"optics.f_number": 4.0})

    assert [label.get_text() for label in ax.get_xticklabels()] == ["grid", "hexagonal"]
    assert len(ax.lines) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"metric": "mtg"}, "'metric' must be one of 'mtf', 'psnr_db', got 'mtg'"),
        ({"metric": "seed"}, "'metric' must be one of 'mtf', 'psnr_db'"),
        ({"x": "bits"}, "'x' must be one of 'optics.f_number', 'sensor.bits', 'layout.kind'"),
        ({"at": {"bits": 8}}, "'at' must be one of 'optics.f_number'"),
        ({"at": {"sensor.bits": "many"}}, "'at' must be a number for 'sensor.bits'"),
        ({"at": {"sensor.bits": "nan"}}, "'at' must be a number for 'sensor.bits'"),
        ({"at": {"layout.kind": "round"}}, "'at' must be one of 'grid', 'hexagonal'"),
        ({"metric": "psnr_db", "at": {"sensor.bits": 8}}, "'results' must have a setting with at least two values"),
    ],
)
def test_wrong_choices_give_one_line(options, message):
    with pytest.raises(ParameterError, match=message):
        plot_results(results(), **options)


def test_settings_of_points_are_along_x():
    import xarray as xr

    settings = {"a": ("point", [3.0, 1.0]), "b": ("point", [5.0, 6.0]), "point": [0, 1]}
    points = xr.Dataset({"m": ("point", [10.0, 20.0])}, settings)

    ax = plot_results(points, x="a")
    assert ax.get_xlabel() == "a"
    assert [line.get_xdata().tolist() for line in ax.lines] == [[3.0, 1.0]]


def test_too_many_curves_are_rejected():
    import xarray as xr

    many = xr.Dataset({"m": (("a", "b"), np.zeros((20, 13)))}, {"a": np.arange(20), "b": np.arange(13)})

    with pytest.raises(ParameterError, match=r"at most 12 curves, got 13; specify the value of 'b' with 'at'"):
        plot_results(many)
    assert len(plot_results(many, at={"b": "7"}).lines) == 1

"""Layouts with a given number of sites: reached within 1 %, by the nearest value, or rejected with the nearest number."""

from __future__ import annotations

import inspect
import re
import warnings
from math import hypot

import numpy as np
import pytest
from registries import restored

import foveasim as fs
from foveasim.config import read_layout
from foveasim.errors import ConfigError, LayoutWarning, ParameterError
from foveasim.layout import LAYOUTS, layout_generator
from foveasim.layout.sizes.site_counts import SolveFor

IMPORTANCE = np.array([[np.exp(-hypot(x, y) / 12.0) for x in range(-32, 32)] for y in range(-32, 32)])
#: Families with their parameters, without the one that is solved for.
CASES = [
    ("log_polar", {"min_size_um": 2.0, "r_max_um": 200.0}),
    ("log_polar", {"min_size_um": 2.0, "r_max_um": 200.0, "fovea": "rings", "stagger": True}),
    ("log_polar", {"min_size_um": 2.0, "r_max_um": 200.0, "fovea": "hexagons"}),
    ("log_polar", {"n_sectors": 17, "r_max_um": 200.0}),
    ("grid", {"size_um": (100.0, 100.0)}),
    ("grid", {"pitch_um": 3.0, "n_y": 11}),
    ("hexagonal", {"size_um": (100.0, 60.0)}),
    ("hexagonal", {"size_um": (100.0, 60.0), "orientation": "flat"}),
    ("octagonal", {"size_um": (100.0, 100.0)}),
    ("tiling", {"radius_um": 100.0}),
    ("penrose", {"size_um": 100.0}),
    ("fovi", {"fov_um": 200.0, "n_rings": 25}),
    ("giotto", {"n_rho": 30, "n_fovea": 10, "n_across": 200, "unit_um": 2.0}),
    ("giotto", {"n_rho": 30, "n_fovea": 10, "n_across": 200, "unit_um": 2.0, "fovea": "hexagons"}),
    ("zones", {"side_um": (64.0, 128.0, 256.0), "cells": "hexagons"}),
    ("quadtree", {"importance": IMPORTANCE, "pitch_um": 1.0, "n_levels": 5}),
]
IDS = [f"{name}-{'-'.join(sorted(set(parameters) - {'importance'}))}" for name, parameters in CASES]


@pytest.mark.slow(keep=3)
@pytest.mark.filterwarnings("ignore::foveasim.errors.LayoutWarning")
@pytest.mark.parametrize(
    ("name", "parameters", "n_sites"),
    [(*case, (900, 2117)[i % 2]) for i, case in enumerate(CASES)],
    ids=IDS,
)
def test_target_is_reached_or_rejected(name, parameters, n_sites):
    make = LAYOUTS[name]

    try:
        layout = make(n_sites=n_sites, **parameters)
    except ParameterError as error:
        nearest = int(re.search(r"the nearest is (\d+) with", str(error)).group(1))
        assert abs(nearest - n_sites) > 0.01 * n_sites
        assert make(n_sites=nearest, **parameters).n_sites == nearest
    else:
        assert abs(layout.n_sites - n_sites) <= 0.01 * n_sites
        again = make(**{**layout.provenance["parameters"], **parameters})
        np.testing.assert_array_equal(again.xy_um, layout.xy_um)


def test_every_scalable_family_has_unknown():
    solved = {name for name, make in LAYOUTS.within("foveasim").items() if getattr(make, "solve_for", ())}
    given = {
        name for name, make in LAYOUTS.within("foveasim").items() if "n_sites" in inspect.signature(make).parameters
    }

    assert len(given) >= 13
    assert solved <= given
    assert given - solved == {"sunflower", "voronoi"}  # their own parameter


@pytest.mark.parametrize("n_sites", [45, 50, 64, 1000])
def test_grid_has_nearest_square(n_sites):
    possible = [n * n for n in range(1, 200)]
    nearest = min(possible, key=lambda n: abs(n - n_sites))

    if abs(nearest - n_sites) <= 0.01 * n_sites:
        assert fs.layout.grid(n_sites=n_sites, pitch_um=2.0).n_sites == nearest
    else:
        with pytest.raises(ParameterError, match=f"the nearest is {nearest} with 'n_x'"):
            fs.layout.grid(n_sites=n_sites, pitch_um=2.0)


def test_log_polar_sectors_match_exhaustive_search():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LayoutWarning)
        found = fs.layout.log_polar(n_sites=1500, min_size_um=2.0, r_max_um=200.0).n_sites
        counts = [fs.layout.log_polar(n_sectors=n, min_size_um=2.0, r_max_um=200.0).n_sites for n in range(20, 120)]

    assert found in counts
    assert abs(found - 1500) <= max(15, 3 * min(abs(n - 1500) for n in counts))


def test_field_is_filled_by_grid():
    layout = fs.layout.grid(n_sites=392, size_um=(100.0, 50.0))

    assert layout.bounds_um[2] - layout.bounds_um[0] == pytest.approx(100.0)
    assert 50.0 - 100.0 / 28 < layout.bounds_um[3] - layout.bounds_um[1] <= 50.0 + 1e-9


@pytest.mark.parametrize("orientation", ["pointy", "flat"])
def test_field_is_filled_by_hexagons(orientation):
    layout = fs.layout.hexagonal(n_columns=20, size_um=(100.0, 80.0), orientation=orientation)
    size_um = np.subtract(layout.bounds_um[2:], layout.bounds_um[:2])
    along, across = (0, 1) if orientation == "pointy" else (1, 0)
    field_um = np.array([100.0, 80.0])
    pitch_um = field_um[along] / 20.5

    assert size_um[along] == pytest.approx(field_um[along])
    assert field_um[across] - 0.5 * np.sqrt(3.0) * pitch_um < size_um[across] <= field_um[across] + 1e-9


def test_pitches_of_zones_double():
    layout = fs.layout.zones(n_fovea=64, side_um=(64.0, 128.0, 256.0, 512.0))
    expected = fs.layout.zones(pitch_um=(1.0, 2.0, 4.0, 8.0), side_um=(64.0, 128.0, 256.0, 512.0))

    np.testing.assert_array_equal(layout.xy_um, expected.xy_um)
    assert fs.layout.zones(n_sites=13_300, side_um=(64.0, 128.0, 256.0, 512.0)).n_sites == 13_312


def test_settings_accept_number_of_sites(tmp_path):
    file = tmp_path / "sensor.yaml"
    file.write_text("generator: log_polar\nparameters: {n_sites: 1400, min_size_um: 2.0, r_max_um: 200.0}\n")

    assert abs(read_layout(file).n_sites - 1400) <= 14

    file.write_text("generator: grid\nparameters: {n_sites: 110, pitch_um: 2.0}\n")
    with pytest.raises(ConfigError, match=r"parameters.n_sites: of grid must be within 1 %.* nearest is 100 "):
        read_layout(file)


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("grid", {"pitch_um": 2.0}, "'n_x' or 'n_sites' must be given"),
        ("grid", {"n_x": 3, "pitch_um": 2.0, "n_sites": 9}, "must be used without 'n_x'"),
        ("grid", {"n_sites": 0, "pitch_um": 2.0}, "'n_sites' must be >= 1, got 0"),
        ("grid", {"n_sites": 9}, "'pitch_um' or 'size_um' must be given, but only one"),
        ("grid", {"n_sites": 9, "pitch_um": -2.0}, "'pitch_um' must be > 0, got -2"),
        ("fovi", {"n_sites": 500, "fov_um": 100.0}, "requires 'a_um' to solve for 'n_rings'"),
        ("log_polar", {"n_sites": 10**6, "r_max_um": 50.0, "min_size_um": 2.0}, "nearest is .* with 'n_sectors'"),
        ("zones", {"side_um": (4.0, 8.0)}, "'pitch_um' or 'n_fovea' must be given"),
    ],
)
def test_bad_requests_are_explained(name, parameters, message):
    with pytest.raises(ParameterError, match=message):
        LAYOUTS[name](**parameters)


@restored(LAYOUTS)
def test_user_family_solves_for_parameter():
    @layout_generator(
        example={"n": 4},
        solve_for=(SolveFor(name="n", guess=lambda n_sites, _: n_sites**0.5),),
    )
    def triangle_of_squares(*, n: int | None = None, n_sites: int | None = None) -> fs.Layout:
        """Return 1 + 2 + ... + n squares."""
        assert n_sites is None
        return fs.Layout.from_rectangles([[x, y] for y in range(n) for x in range(y + 1)], 1.0)

    layout = triangle_of_squares(n_sites=5051)

    assert layout.n_sites == 5050
    assert layout.provenance["parameters"] == {"n": 100, "n_sites": None}

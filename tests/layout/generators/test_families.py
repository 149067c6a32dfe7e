"""
Common properties of all layout generators of the package.

Their examples are checked with all extensions; the variants here have other options. Generators with ``min_size_um`` are
identified by their signature. Families with an area in closed form are listed here.
"""

from __future__ import annotations

import inspect
import json
import math
import types
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

import foveasim as fs
from foveasim.config import schema
from foveasim.errors import FoveasimError
from foveasim.layout import LAYOUTS

#: Most random combinations of parameters are invalid, and generators reject them with an error of the package.
random_settings = settings(
    max_examples=examples(40),
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow],
)
without_warnings = pytest.mark.filterwarnings("ignore::foveasim.errors.LayoutWarning")


class Family(NamedTuple):
    """
    Parameters of a generator, area in closed form, and number of holes.

    The area is None where sites do not tile, and a function of the layout where it depends on numbers of sites.
    """

    generator: str
    parameters: dict[str, Any]
    area_um2: float | Callable[[fs.Layout], float] | None
    n_holes: int = 0


def polygon_um2(n_corners, radius_um):
    return 0.5 * n_corners * math.sin(2.0 * math.pi / n_corners) * radius_um**2


def rhombs_um2(layout, side_um):
    n_thick = int(layout.columns["is_thick"].sum())
    return side_um**2 * (
        n_thick * math.sin(math.radians(72.0)) + (layout.n_sites - n_thick) * math.sin(math.radians(36.0))
    )


IMPORTANCE = np.zeros((16, 8))
IMPORTANCE[3, 5] = 1.0
PENROSE = {"side_um": 3.0, "size_um": 40.0}
GIOTTO = {"n_rho": 12, "n_theta": 40, "n_fovea": 5, "n_across": 40, "unit_um": 2.0}
RINGS = {"n_sectors": 24, "r_max_um": 60.2, "min_size_um": 2.0}
EXACT = {"n_sectors": 24, "r_min_um": 10.0, "r_max_um": 60.0, "n_rings": 7, "stagger": True}
NOTCHED = [[0.0, 0.0], [20.0, 0.0], [20.0, 15.0], [8.0, 9.0], [0.0, 15.0]]
FAMILIES = [
    Family("foveal_cartesian", {"n_rings": 6, "ring_ratio": 1.4, "pitch_um": 2.0}, (2.0 * 1.4**5) ** 2),
    Family("fovi", {"fov_um": 100.0, "a_um": 10.0, "n_rings": 6, "n_chords": 99}, math.nan),
    Family("giotto", GIOTTO, polygon_um2(80, 40.0)),
    Family("giotto", {**GIOTTO, "fovea": "hexagons", "stagger": False}, polygon_um2(40, 40.0)),
    Family("giotto", {**GIOTTO, "fovea": "none"}, polygon_um2(80, 40.0) - polygon_um2(80, 9.0), n_holes=1),
    Family("grid", {"n_x": 5, "n_y": 3, "pitch_um": 2.2, "pitch_y_um": 3.0}, 15 * 2.2 * 3.0),
    Family("grid", {"n_x": 5, "n_y": 3, "pitch_um": 2.2, "trench_um": 0.2}, None),
    Family("hexagonal", {"n_columns": 5, "n_rows": 4, "pitch_um": 2.0}, 20 * math.sqrt(3.0) / 2.0 * 4.0),
    Family("log_polar", EXACT, polygon_um2(48, 60.0) - polygon_um2(48, 10.0), n_holes=1),
    Family("log_polar", {**EXACT, "fovea": "rings"}, polygon_um2(48, 60.0)),
    Family("log_polar", {**EXACT, "fovea": "linear", "chords_per_arc": 3}, polygon_um2(144, 60.0)),
    Family("log_polar", {**EXACT, "fovea": "hexagons", "min_size_um": 2.0}, polygon_um2(48, 60.0)),
    Family("octagonal", {"n_x": 4, "n_y": 3, "pitch_um": 5.0, "border": "cut"}, 12 * 25.0),
    Family("penrose", PENROSE, lambda layout: rhombs_um2(layout, 3.0)),
    Family("quadtree", {"importance": IMPORTANCE, "pitch_um": 1.5, "limit": 0.5, "n_levels": 3}, 128 * 1.5**2),
    Family("sunflower", {"n_sites": 90, "spacing_um": 2.0, "n_chords": 64}, math.nan),
    Family("tiling", {"pitch_um": 2.0, "region": NOTCHED}, 300.0 - 0.5 * 20.0 * 6.0),
    Family("tiling", {"pitch_um": 2.0, "size_um": [21.0, 9.0], "cells": "squares", "border": "cut"}, 189.0),
    Family("voronoi", {"n_sites": 60, "size_um": (20.0, 30.0), "n_iterations": 3}, 600.0),
    Family("zones", {"side_um": [8.0, 16.0, 48.0], "pitch_um": [1.0, 2.0, 4.0]}, 48.0**2),
    Family("zones", {"side_um": [8.0, 17.0], "pitch_um": [1.0, 2.0], "cells": "hexagons"}, 17.0**2),
]
names = [f"{family.generator} {i}" for i, family in enumerate(FAMILIES)]
every_family = pytest.mark.parametrize("family", FAMILIES, ids=names)


def generate(family):
    return LAYOUTS[family.generator](**family.parameters)


def test_public_generators_are_registered():
    # A family is a function with the name of its module that returns a layout and has no parameter ``layout``.
    public = {
        name
        for name in fs.layout.__all__
        if getattr(getattr(fs.layout, name), "__module__", "") == f"foveasim.layout.generators.{name}"
        and inspect.signature(getattr(fs.layout, name)).return_annotation == "Layout"
        and "layout" not in inspect.signature(getattr(fs.layout, name)).parameters
    }

    assert public <= set(LAYOUTS)
    assert all(getattr(fs.layout, name) is generator for name, generator in LAYOUTS.items())


@every_family
def test_sites_are_simple_polygons_with_area(family):
    layout = generate(family)
    rebuilt = fs.Layout.from_polygons((layout.xy_um, layout.ring_offsets, layout.site_offsets))

    assert layout.n_sites > 1
    assert shapely.is_valid(layout.polygons()).all()
    assert layout.area_um2.min() > 0.0
    # No ring was reversed, and no vertex was removed.
    assert np.array_equal(rebuilt.xy_um, layout.xy_um)
    assert all(column.shape == (layout.n_sites,) for column in layout.columns.values())


@every_family
def test_sites_tile_without_gap_or_overlap(family):
    layout = generate(family)
    polygons = layout.polygons()
    first, second = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    common_um2 = shapely.area(shapely.intersection(polygons[first], polygons[second])[first < second])

    assert common_um2.max(initial=0.0) <= 1e-9 * layout.area_um2.min()
    # Without common vertices on oblique edges, rounding to 1 nm makes real overlaps.
    assert fs.layout.snap(layout, 0.001).check(fs.DesignRules(max_overlap_um2=0.0)).ok
    if family.area_um2 is None:
        return
    covered = shapely.union_all(polygons)
    expected_um2 = family.area_um2(layout) if callable(family.area_um2) else family.area_um2
    if math.isnan(expected_um2):  # a regular polygon whose size the family chooses
        expected_um2 = polygon_um2(family.parameters["n_chords"], layout.provenance["radius_um"])
    assert covered.geom_type == "Polygon"
    assert sum(shapely.Polygon(ring).area > 1e-9 for ring in covered.interiors) == family.n_holes
    assert layout.area_um2.sum() == pytest.approx(expected_um2, rel=1e-9)
    assert len(layout.check(fs.DesignRules(max_gap_um2=0.0)).violations) == family.n_holes


@every_family
def test_npz_round_trip_is_bit_identical(family, tmp_path):
    layout = generate(family)
    layout.write(tmp_path / "layout.npz")
    read = fs.read_layout(tmp_path / "layout.npz")

    for name in ("xy_um", "ring_offsets", "site_offsets"):
        assert np.array_equal(getattr(read, name), getattr(layout, name))
    assert read.columns.keys() == layout.columns.keys()
    for name, column in layout.columns.items():
        assert read.columns[name].dtype == column.dtype
        assert np.array_equal(read.columns[name], column)
    assert read.provenance["generator"] == family.generator


@every_family
def test_provenance_reproduces_layout(family):
    layout = generate(family)
    parameters = layout.provenance["parameters"]

    assert layout.provenance["generator"] == family.generator
    assert set(parameters) == set(inspect.signature(LAYOUTS[family.generator]).parameters)
    if family.generator != "quadtree":  # the picture is not recorded
        assert np.array_equal(LAYOUTS[family.generator](**parameters).xy_um, layout.xy_um)


@pytest.fixture(scope="module")
def sections():
    return schema()["$defs"]


@pytest.mark.parametrize("name", LAYOUTS)
def test_settings_schema_contains_generator(sections, name):
    keys = next(s for s in sections.values() if s["title"] == f"{name} parameters")["properties"]
    not_in_files = {"density_grid"}

    assert set(keys) == set(inspect.signature(LAYOUTS[name]).parameters) - not_in_files
    assert f'"const": "{name}"' in json.dumps(sections)


# -- minimum size ------------------------------------------------------------------------------------------------

WITH_MIN_SIZE = [name for name, call in LAYOUTS.items() if "min_size_um" in inspect.signature(call).parameters]


def values_of(name, hint):
    """Strategy for a parameter by its type and, for numbers, its name; None for other types."""
    if get_origin(hint) is Literal:
        return st.sampled_from(get_args(hint))
    if get_origin(hint) in (Union, types.UnionType):
        parts = [values_of(name, part) for part in get_args(hint) if part is not type(None)]
        return st.one_of(*parts) if all(part is not None for part in parts) else None
    if get_origin(hint) is tuple:
        parts = [values_of(name, part) for part in get_args(hint)]
        return st.tuples(*parts) if all(part is not None for part in parts) else None
    if hint is float:
        return st.floats(1.01, 4.0) if "ratio" in name else st.floats(0.5, 30.0)
    return {bool: st.booleans(), int: st.integers(1, 40)}.get(hint)


@st.composite
def parameters_of(draw, call):
    """Random parameters of a generator; those with a default are often omitted, and 'n_sites' always."""
    hints = get_type_hints(call)
    unknowns = {unknown.name for unknown in call.solve_for if not unknown.is_optional}
    found = {}
    for name, parameter in inspect.signature(call).parameters.items():
        if name == "n_sites":
            continue
        values = values_of(name, hints[name])
        is_required = parameter.default is inspect.Parameter.empty or name in {"min_size_um", *unknowns}
        if values is None:
            assert not is_required, f"no values for '{name}' of {call.__name__}: extend values_of"
        elif is_required or draw(st.booleans()):
            found[name] = draw(values)
    return found


def assert_minimum_size(layout, min_size_um):
    report = layout.check(fs.DesignRules(min_size_um=min_size_um))

    assert report.ok, str(report)


def test_generators_with_minimum_size():
    assert {"log_polar", "tiling"} <= set(WITH_MIN_SIZE)


@pytest.mark.slow
@without_warnings
@pytest.mark.parametrize("name", WITH_MIN_SIZE)
def test_generator_satisfies_minimum_size(name):
    n_generated = 0

    @random_settings
    @given(parameters=parameters_of(LAYOUTS[name]))
    def check(parameters):
        nonlocal n_generated
        try:
            layout = LAYOUTS[name](**parameters)
        except FoveasimError:
            assume(False)
        n_generated += 1
        assert_minimum_size(layout, parameters["min_size_um"])

    check()
    assert n_generated >= 20


@st.composite
def log_polar_parameters(draw):
    n_sectors = draw(st.integers(3, 200))
    min_size_um = draw(st.floats(0.01, 100.0))
    blind_um = min_size_um * n_sectors / (2.0 * math.pi)
    r_min_um = draw(st.none() | st.floats(0.02, 3.0).map(lambda x: x * blind_um))
    ratio = draw(st.none() | st.floats(1.0 + 4.0 / n_sectors, 3.0))
    return {
        "n_sectors": n_sectors,
        "min_size_um": min_size_um,
        "r_min_um": r_min_um,
        "r_max_um": max(blind_um, r_min_um or 0.0) * draw(st.floats(1.5, 8.0)),
        "ring_ratio": ratio,
        "fovea": draw(st.sampled_from(["none", "rings", "linear"])),
        "stagger": draw(st.booleans()),
        "chords_per_arc": draw(st.sampled_from([1, 2, 3, 4, 7])),
    }


@without_warnings
@random_settings
@given(parameters=log_polar_parameters())
@example(parameters={"n_sectors": 192, "min_size_um": 2.0, "r_max_um": 690.0, "stagger": True, "chords_per_arc": 2})
@example(parameters={"n_sectors": 192, "min_size_um": 2.0, "r_max_um": 300.0, "fovea": "rings"})
@example(parameters={"n_sectors": 6, "min_size_um": 2.0, "r_max_um": 100.0, "ring_ratio": 9.0, "fovea": "linear"})
@example(parameters={"n_sectors": 471, "min_size_um": 0.01171875, "r_max_um": 1.756921363975376, "fovea": "rings"})
def test_log_polar_minimum_size_is_exact(parameters):
    try:
        layout = fs.layout.log_polar(**parameters)
    except FoveasimError:
        assume(False)

    assert np.sqrt(layout.area_um2).min() >= parameters["min_size_um"]
    assert_minimum_size(layout, parameters["min_size_um"])


@without_warnings
@random_settings
@given(
    n_sectors=st.integers(3, 40),
    ring_ratio=st.floats(1.005, 1.2),
    fovea=st.sampled_from(["rings", "linear", "hexagons"]),
    chords_per_arc=st.integers(1, 3),
    stagger=st.booleans(),
)
def test_fovea_does_not_cross_coarse_chords(n_sectors, ring_ratio, fovea, chords_per_arc, stagger):
    layout = fs.layout.log_polar(
        n_sectors=n_sectors,
        r_min_um=10.0,
        r_max_um=20.0,
        ring_ratio=ring_ratio,
        fovea=fovea,
        chords_per_arc=chords_per_arc,
        stagger=stagger,
    )
    n_corners = n_sectors * chords_per_arc * (2 if stagger and chords_per_arc % 2 else 1)
    outer_um = np.hypot(*layout.xy_um.T).max()

    assert shapely.is_valid(layout.polygons()).all()
    assert layout.area_um2.sum() == pytest.approx(polygon_um2(n_corners, outer_um), rel=1e-9)


@pytest.mark.parametrize("cells", ["squares", "hexagons"])
@pytest.mark.parametrize("pitch_um", [0.7, 2.2, 3.9])
def test_cells_of_exact_minimum_size_remain(cells, pitch_um):
    area_um2 = pitch_um**2 * (1.0 if cells == "squares" else math.sqrt(3.0) / 2.0)
    parameters = {"pitch_um": pitch_um, "cells": cells, "size_um": (61 * pitch_um, 53 * pitch_um)}
    layout = fs.layout.tiling(**parameters, min_size_um=math.sqrt(area_um2))
    complete = fs.layout.tiling(**parameters, border="drop", min_size_um=math.sqrt(area_um2))
    is_complete = np.isclose(layout.area_um2, area_um2, rtol=1e-9)

    assert_minimum_size(layout, math.sqrt(area_um2))
    # Squares fit the rectangle; pieces of hexagons at its boundary are merged into some of the complete ones.
    assert is_complete.sum() == complete.n_sites if cells == "squares" else is_complete.sum() > 0.9 * complete.n_sites


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"border": "cut"}, "'min_size_um' must be omitted with border='cut'"),
        ({"border": "drop"}, "'min_size_um' must be <= 1.86121, the size of a complete cell, got 2.0 µm"),
    ],
)
def test_tiling_rejects_unattainable_minimum_size(parameters, message):
    with pytest.raises(fs.errors.ParameterError, match=message):
        fs.layout.tiling(pitch_um=2.0, radius_um=20.0, min_size_um=2.0, **parameters)


def test_tiling_warns_about_uncovered_parts():
    region = shapely.MultiPolygon([shapely.box(0, 0, 20, 20), shapely.box(30, 0, 31, 1)])

    with pytest.warns(
        fs.errors.LayoutWarning, match="1 µm² of the region remain uncovered, in parts smaller than a site"
    ):
        layout = fs.layout.tiling(pitch_um=3.0, region=region)
    assert layout.area_um2.sum() == pytest.approx(400.0)


@pytest.mark.parametrize("fovea", ["rings", "linear", "hexagons"])
def test_fovea_too_small_for_site_raises(fovea):
    with pytest.raises(fs.errors.ParameterError, match=r"'fovea' must fit a .* of 5 µm inside the first ring"):
        fs.layout.log_polar(n_sectors=4, r_min_um=2.0, r_max_um=19.0, min_size_um=5.0, ring_ratio=9.0, fovea=fovea)

"""Layout model: accepted and rejected input, measures against shapely, transformations."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import FrozenInstanceError
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from foveasim.errors import GeometryError, ParameterError
from foveasim.layout import Layout

relaxed = settings(max_examples=examples(60))

#: Coordinates are multiples of this, so that shifts by whole µm are exact.
STEP_UM = 2.0**-16


def star(radii_um, jitters, x_um=0.0, y_um=0.0):
    """Vertices of a star-shaped ring about (x, y), one per sector, counter-clockwise."""
    n = len(radii_um)
    angle = 2 * np.pi * (np.arange(n) + 0.5 * np.asarray(jitters)) / n
    xy = np.stack((x_um + radii_um * np.cos(angle), y_um + radii_um * np.sin(angle)), axis=1)
    return np.round(xy / STEP_UM) * STEP_UM


@st.composite
def stars(draw, low_um, high_um, x_um=0.0, y_um=0.0):
    n = draw(st.integers(4, 11))
    radii = draw(st.lists(st.floats(low_um, high_um), min_size=n, max_size=n))
    jitters = draw(st.lists(st.floats(0, 1), min_size=n, max_size=n))
    return star(np.array(radii), jitters, x_um, y_um)


@st.composite
def holed_polygons(draw):
    """Simple polygon around the origin with a radius of 1 to 3 µm and up to two holes."""
    outline = draw(stars(1.0, 3.0))
    # Sectors are at most 135 degrees wide, so edges are at least 0.38 µm from the origin.
    centres_x_um = draw(st.sampled_from([(), (0.0,), (-0.17, 0.17)]))
    return shapely.Polygon(outline, [draw(stars(0.05, 0.15, x_um=x)) for x in centres_x_um])


@st.composite
def polygon_lists(draw):
    """Disjoint polygons in a row."""
    shapes = draw(st.lists(holed_polygons(), min_size=1, max_size=5))
    return [affinity.translate(shape, 8.0 * k, draw(st.integers(-4, 4))) for k, shape in enumerate(shapes)]


def pack_randomly(draw, polygons):
    """Packed rings with random winding, first vertex, closure and repeated vertices."""
    vertices, ring_lengths, site_lengths = [], [], []
    for polygon in polygons:
        rings = [polygon.exterior, *polygon.interiors]
        site_lengths.append(len(rings))
        for ring in rings:
            xy = shapely.get_coordinates(ring)[:-1]
            xy = np.roll(xy, draw(st.integers(0, len(xy) - 1)), axis=0)
            xy = xy[::-1] if draw(st.booleans()) else xy
            xy = np.repeat(xy, draw(st.lists(st.integers(1, 3), min_size=len(xy), max_size=len(xy))), axis=0)
            xy = np.concatenate((xy, xy[:1])) if draw(st.booleans()) else xy
            vertices.append(xy)
            ring_lengths.append(len(xy))
    return np.concatenate(vertices), np.cumsum([0, *ring_lengths]), np.cumsum([0, *site_lengths])


def ring_signs(layout):
    """Orientation of each ring by shapely: True for counter-clockwise."""
    return [
        [bool(shapely.is_ccw(ring)) for ring in (polygon.exterior, *polygon.interiors)] for polygon in layout.polygons()
    ]


def assert_same_arrays(a, b):
    assert a.xy_um.tolist() == b.xy_um.tolist()
    assert a.ring_offsets.tolist() == b.ring_offsets.tolist()
    assert a.site_offsets.tolist() == b.site_offsets.tolist()


UNIT = shapely.box(0, 0, 1, 1)
HOLED = shapely.Polygon(shapely.box(0, 0, 4, 4).exterior, [shapely.box(1, 1, 2, 2).exterior])
TRIANGLE = shapely.Polygon([(10, 0), (13, 0), (10, 4)])
HEXAGON = shapely.Polygon([(20 + math.cos(k * math.pi / 3), math.sin(k * math.pi / 3)) for k in range(6)])


@pytest.fixture
def mixed():
    """Four sites with 4, 4 + 4, 3 and 6 vertices."""
    return Layout.from_polygons(
        [affinity.translate(UNIT, -5, 0), HOLED, TRIANGLE, HEXAGON],
        channel=[0, 1, 2, 1],
        readout_line=[3, 2, 1, 0],
        name=["a", "b", "c", "d"],
    )


# -- from_polygons ---------------------------------------------------------------------------------------------------


@given(polygon_lists())
@relaxed
def test_measures_agree_with_shapely(polygons):
    layout = Layout.from_polygons(polygons)

    np.testing.assert_allclose(layout.area_um2, shapely.area(polygons), rtol=1e-12)
    np.testing.assert_allclose(layout.size_um**2, shapely.area(polygons), rtol=1e-12)
    np.testing.assert_allclose(layout.centroid_um, shapely.get_coordinates(shapely.centroid(polygons)), atol=1e-10)
    assert layout.site_bounds_um.tolist() == shapely.bounds(polygons).tolist()
    assert layout.bounds_um == tuple(shapely.total_bounds(polygons).tolist())


@given(polygon_lists(), st.integers(-9_000_000, 9_000_000), st.integers(-9_000_000, 9_000_000))
@relaxed
def test_measures_are_accurate_far_from_origin(polygons, dx_um, dy_um):
    layout = Layout.from_polygons([affinity.translate(polygon, dx_um, dy_um) for polygon in polygons])
    centroid_um = shapely.get_coordinates(shapely.centroid(polygons)) + np.array([dx_um, dy_um])

    np.testing.assert_allclose(layout.area_um2, shapely.area(polygons), rtol=1e-12)
    np.testing.assert_allclose(layout.centroid_um, centroid_um, rtol=0, atol=1e-7)


@given(st.data(), polygon_lists())
@relaxed
def test_packed_rings_are_normalised(data, polygons):
    layout = Layout.from_polygons(pack_randomly(data.draw, polygons))

    assert bool(np.all(shapely.equals_exact(layout.polygons(), polygons, tolerance=0.0, normalize=True)))
    assert np.diff(layout.ring_offsets).tolist() == [
        len(ring.coords) - 1 for polygon in polygons for ring in (polygon.exterior, *polygon.interiors)
    ]


@given(st.data(), polygon_lists())
@relaxed
def test_outlines_are_counter_clockwise_and_holes_clockwise(data, polygons):
    layout = Layout.from_polygons(pack_randomly(data.draw, polygons))

    assert ring_signs(layout) == [[True, *[False] * len(polygon.interiors)] for polygon in polygons]


@given(polygon_lists())
@relaxed
def test_polygons_round_trip_exactly(polygons):
    assert bool(
        np.all(shapely.equals_exact(Layout.from_polygons(polygons).polygons(), polygons, tolerance=0.0, normalize=True))
    )


@given(polygon_lists())
@relaxed
def test_second_round_trip_preserves_arrays(polygons):
    layout = Layout.from_polygons(polygons)

    assert_same_arrays(Layout.from_polygons(layout.polygons()), layout)


def test_closed_ring_retains_first_vertex():
    layout = Layout.from_polygons(([(5, 5), (6, 5), (6, 6), (5, 6), (5, 5)], [0, 5], [0, 1]))

    assert layout.xy_um.tolist() == [[5, 5], [6, 5], [6, 6], [5, 6]]


def test_reversed_ring_retains_first_vertex():
    layout = Layout.from_polygons(([(5, 5), (5, 6), (6, 6), (6, 5)], [0, 4], [0, 1]))

    assert layout.xy_um.tolist() == [[5, 5], [6, 5], [6, 6], [5, 6]]


def test_mixed_vertex_counts_are_packed_consecutively(mixed):
    assert mixed.ring_offsets.tolist() == [0, 4, 8, 12, 15, 21]
    assert mixed.site_offsets.tolist() == [0, 1, 3, 4, 5]
    assert mixed.area_um2.tolist() == pytest.approx([1.0, 15.0, 6.0, 1.5 * math.sqrt(3)], rel=1e-14)


@pytest.mark.parametrize(
    "polygons",
    [
        pytest.param([UNIT, TRIANGLE, HEXAGON], id="list"),
        pytest.param((UNIT, TRIANGLE, HEXAGON), id="tuple of three"),
        pytest.param(np.array([UNIT, TRIANGLE, HEXAGON], dtype=object), id="object array"),
        pytest.param(shapely.MultiPolygon([UNIT, TRIANGLE, HEXAGON]), id="multipolygon"),
        pytest.param(shapely.GeometryCollection([UNIT, TRIANGLE, HEXAGON]), id="collection"),
        pytest.param((polygon for polygon in (UNIT, TRIANGLE, HEXAGON)), id="generator"),
    ],
)
def test_polygon_collections_are_accepted_in_order(polygons):
    layout = Layout.from_polygons(polygons)

    assert np.diff(layout.ring_offsets).tolist() == [4, 3, 6]
    assert layout.area_um2[1] == 6.0


def test_z_coordinates_are_ignored():
    layout = Layout.from_polygons([shapely.Polygon([(0, 0, 7), (2, 0, 8), (2, 2, 9)])])

    assert layout.xy_um.shape == (3, 2)
    assert layout.area_um2.tolist() == [2.0]


def test_hole_may_touch_outline_in_point():
    layout = Layout.from_polygons([shapely.Polygon([(0, 0), (4, 0), (4, 4), (0, 4)], [[(0, 2), (2, 3), (2, 1)]])])

    assert layout.area_um2.tolist() == [14.0]


@pytest.mark.parametrize(
    "polygons", [pytest.param([], id="list"), pytest.param((np.zeros((0, 2)), [0], [0]), id="packed")]
)
def test_empty_input_gives_empty_layout(polygons):
    layout = Layout.from_polygons(polygons)

    assert (len(layout), layout.area_um2.shape, layout.centroid_um.shape) == (0, (0,), (0, 2))
    assert layout.site_bounds_um.shape == (0, 4)
    assert layout.polygons().shape == (0,)


def with_nan(x_um, y_um):
    with np.errstate(invalid="ignore"):
        return shapely.Polygon([(0, 0), (x_um, y_um), (1, 1)])


BAD_SITES = {
    "empty": (shapely.Polygon(), "site 1 is empty"),
    "not a number": (with_nan(np.nan, 1), "site 1 has a coordinate that is not finite"),
    "infinite": (with_nan(2, -np.inf), "site 1 has a coordinate that is not finite"),
    "crossing itself": (shapely.Polygon([(0, 0), (2, 2), (2, 0), (0, 1)]), "site 1 crosses or touches itself"),
    "figure of eight": (shapely.Polygon([(0, 0), (1, 1), (1, 0), (0, 1)]), "site 1 crosses or touches itself"),
    "touching itself": (
        shapely.Polygon([(0, 0), (2, 0), (2, 2), (1, 0), (0, 2)]),
        "site 1 crosses or touches itself",
    ),
    "flat": (shapely.Polygon([(0, 0), (1, 1), (2, 2)]), "site 1 has a ring with zero area"),
    "flat far out": (
        shapely.Polygon([(1e6, 1e6), (1e6 + 1, 1e6 + 1), (1e6 + 3, 1e6 + 3), (1e6 + 2, 1e6 + 2)]),
        "site 1 has a ring with zero area",
    ),
    "flat hole": (
        shapely.Polygon(shapely.box(0, 0, 4, 4).exterior, [[(1, 1), (2, 2), (3, 3)]]),
        "site 1 has a ring with zero area",
    ),
    "one point": (shapely.Polygon([(1, 1), (1, 1), (1, 1), (1, 1)]), "site 1 has a ring of fewer than 3 distinct"),
    "two points": (shapely.Polygon([(0, 0), (1, 1), (0, 0)]), "site 1 has a ring of fewer than 3 distinct"),
    "several parts": (
        shapely.MultiPolygon([UNIT, shapely.box(3, 3, 4, 4)]),
        "site 1 must be a shapely Polygon, or vertices .n, 2., got a Mul",
    ),
    "line": (
        shapely.LineString([(0, 0), (1, 1)]),
        "site 1 must be a shapely Polygon, or vertices .*, got a LineString",
    ),
    "nothing": (None, "site 1 must be a shapely Polygon, or vertices .*, got a NoneType"),
    "text": ("POLYGON", "site 1 must be a shapely Polygon, or vertices .*, got a str"),
    "points in space": (np.zeros((4, 3)), "site 1 must be a shapely Polygon, or vertices .*, got an ndarray"),
    "rows of different lengths": ([(0, 0), (1, 0, 0), (1, 1)], "site 1 must be .*, or vertices .*, got a list"),
    "names": ([("a", "b"), ("c", "d"), ("e", "f")], "site 1 must be .*, or vertices .*, got a list"),
    "two vertices": ([(0, 0), (1, 1)], "site 1 has a ring of fewer than 3 distinct"),
    "flat vertices": ([(0, 0), (1, 1), (2, 2)], "site 1 has a ring with zero area"),
    "hole outside": (
        shapely.Polygon(shapely.box(0, 0, 1, 1).exterior, [shapely.box(2, 2, 3, 3).exterior]),
        "site 1 has a hole outside its outline",
    ),
    "hole across": (
        shapely.Polygon(shapely.box(0, 0, 2, 2).exterior, [shapely.box(1, 0.5, 3, 1.5).exterior]),
        "site 1 crosses or touches itself",
    ),
    "hole in a hole": (
        shapely.Polygon(
            shapely.box(0, 0, 9, 9).exterior, [shapely.box(1, 1, 8, 8).exterior, shapely.box(2, 2, 3, 3).exterior]
        ),
        "site 1 has a hole inside another hole",
    ),
    "metres for micrometres": (shapely.box(1e9, 0, 1e9 + 5, 1), "site 1 lies further than 1e.07 µm from the origin"),
}


@pytest.mark.parametrize(("bad", "message"), BAD_SITES.values(), ids=BAD_SITES)
def test_invalid_polygon_raises_with_index(bad, message):
    with pytest.raises(GeometryError, match=message) as caught:
        Layout.from_polygons([UNIT, bad, UNIT])

    assert caught.value.site_ids == (1,)
    assert "\n" not in str(caught.value)


OUTLINES = [[(0, 0), (2, 0), (2, 2)], [(3, 0), (3, 2), (5, 2), (5, 0), (3, 0)], [(6, 0), (8, 0), (7, 2)]]


@pytest.mark.parametrize("kind", [list, tuple, iter])
@pytest.mark.parametrize("convert", [list, np.array, lambda each: np.array(each, np.float32), shapely.Polygon])
def test_vertices_are_accepted_as_polygons(kind, convert):
    expected = Layout.from_polygons([shapely.Polygon(each) for each in OUTLINES])
    found = Layout.from_polygons(kind([convert(each) for each in OUTLINES]))
    mixed = Layout.from_polygons([shapely.Polygon(OUTLINES[0]), *map(convert, OUTLINES[1:])])

    for layout in (found, mixed):
        assert layout.n_sites == 3
        assert layout.area_um2.tolist() == [2.0, 4.0, 2.0]
        assert all(a.equals(b) for a, b in zip(layout.polygons(), expected.polygons(), strict=True))


def test_array_of_equal_outlines_is_accepted():
    corners = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]) + 2.0 * np.arange(5)[:, None, None]

    assert Layout.from_polygons(corners).area_um2.tolist() == [1.0] * 5


@pytest.mark.parametrize("kind", [list, tuple, np.array])
def test_one_outline_requires_a_list(kind):
    with pytest.raises(GeometryError, match=r"site 0 must be .* got .*; pass \[vertices\] for a single site"):
        Layout.from_polygons(kind([(0.0, 0.0), (2.0, 0.0), (0.0, 2.0)]))


def test_short_outline_in_a_tuple_is_named():
    with pytest.raises(GeometryError, match="site 1 has a ring of fewer than 3 distinct vertices"):
        Layout.from_polygons((OUTLINES[0], [(0, 0), (1, 1)], OUTLINES[2]))


def test_coordinates_of_shapely_are_vertices():
    assert Layout.from_polygons([shapely.box(0, 0, 2, 3).exterior.coords]).area_um2.tolist() == [6.0]


def test_packed_rings_are_not_taken_for_outlines():
    layout = Layout.from_polygons(([(0, 0), (2, 0), (2, 2)], [0, 3], [0, 1]))

    assert layout.n_sites == 1


BAD_RINGS = {
    "not a number": ([(0, 0), (np.nan, 0), (1, 1)], "site 1 has a coordinate that is not finite"),
    "infinite": ([(0, 0), (1, 0), (1, np.inf)], "site 1 has a coordinate that is not finite"),
    "crossing itself": ([(0, 0), (2, 2), (2, 0), (0, 1)], "site 1 crosses or touches itself"),
    "flat": ([(0, 0), (1, 0), (2, 0), (3, 0)], "site 1 has a ring with zero area"),
    "doubled back": ([(0, 0), (1, 0), (0, 0), (1, 0)], "site 1 has a ring with zero area"),
    "one vertex": ([(0, 0)], "site 1 has a ring of fewer than 3 distinct vertices"),
    "two vertices, closed": ([(0, 0), (1, 0), (0, 0)], "site 1 has a ring of fewer than 3 distinct vertices"),
    "metres for micrometres": ([(0, -1e8), (1, 0), (0, 1)], "site 1 lies further than 1e.07 µm from the origin"),
}


@pytest.mark.parametrize(("ring", "message"), BAD_RINGS.values(), ids=BAD_RINGS)
def test_invalid_packed_ring_raises_with_site(ring, message):
    good = [(5, 5), (6, 5), (6, 6)]
    offsets = np.cumsum([0, 3, len(ring), 3])
    with pytest.raises(GeometryError, match=message) as caught:
        Layout.from_polygons((np.array([*good, *ring, *good], float), offsets, [0, 1, 2, 3]))

    assert caught.value.site_ids == (1,)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        pytest.param(shapely.Polygon(), "site 1 is empty .and 3 more: 3, 4, 6.", id="a few"),
        pytest.param(shapely.Polygon([(0, 0), (1, 1), (2, 2)]), "zero area .and 3 more: 3, 4, 6.", id="flat"),
    ],
)
def test_message_lists_few_invalid_sites(bad, message):
    with pytest.raises(GeometryError, match=message) as caught:
        Layout.from_polygons([UNIT, bad, UNIT, bad, bad, UNIT, bad])

    assert caught.value.site_ids == (1, 3, 4, 6)


def test_message_abbreviates_many_invalid_sites():
    with pytest.raises(GeometryError, match=r"site 0 is empty \(and 999 more: 1, 2, 3, 4, \.\.\.\)") as caught:
        Layout.from_polygons([shapely.Polygon()] * 1000)

    assert caught.value.site_ids == tuple(range(1000))


@pytest.mark.parametrize(
    "polygons",
    [
        pytest.param(UNIT, id="one polygon"),
        pytest.param(shapely.Point(0, 0), id="point"),
        pytest.param(None, id="nothing"),
        pytest.param(3.0, id="number"),
    ],
)
def test_non_sequence_of_polygons_raises(polygons):
    with pytest.raises((GeometryError, ParameterError), match="polygons"):
        Layout.from_polygons(polygons)


SQUARE_XY = [(0, 0), (1, 0), (1, 1), (0, 1)]


@pytest.mark.parametrize(
    ("xy_um", "ring_offsets", "site_offsets", "message"),
    [
        pytest.param([0, 1, 2], [0, 3], [0, 1], r"'xy_um' must have the shape \(n_vertex, 2\)", id="flat list"),
        pytest.param(
            [[0, 0, 0]] * 3, [0, 3], [0, 1], r"'xy_um' must have the shape \(n_vertex, 2\)", id="three columns"
        ),
        pytest.param([["a", "b"]] * 3, [0, 3], [0, 1], "'xy_um' must be an array of numbers", id="string"),
        pytest.param([[0, 0], [1, 0], [1]], [0, 3], [0, 1], "'xy_um' must be an array of numbers", id="ragged"),
        pytest.param(SQUARE_XY, [1, 4], [0, 1], "'ring_offsets' must begin at 0 and end at 4", id="begins at 1"),
        pytest.param(SQUARE_XY, [0, 3], [0, 1], "'ring_offsets' must begin at 0 and end at 4", id="ends early"),
        pytest.param(SQUARE_XY, [0, 5], [0, 1], "'ring_offsets' must begin at 0 and end at 4", id="ends late"),
        pytest.param(SQUARE_XY, [], [0], "'ring_offsets' must be a list of integers", id="no offsets"),
        pytest.param(SQUARE_XY, [0.0, 4.0], [0, 1], "'ring_offsets' must be a list of integers", id="floats"),
        pytest.param(SQUARE_XY, [[0, 4]], [0, 1], "'ring_offsets' must be a list of integers", id="nested"),
        pytest.param(
            SQUARE_XY,
            [0, 4, 4],
            [0, 2],
            "'ring_offsets' .*at least 1 vertices to each item, but item 1",
            id="empty ring",
        ),
        pytest.param(
            SQUARE_XY,
            [0, 9, 4],
            [0, 2],
            "'ring_offsets' .*at least 1 vertices to each item, but item 1",
            id="backwards",
        ),
        pytest.param(SQUARE_XY, [0, 4], [0, 2], "'site_offsets' must begin at 0 and end at 1", id="too many rings"),
        pytest.param(
            SQUARE_XY, [0, 4], [0, 0, 1], "'site_offsets' .*at least 1 rings to each item, but item 0", id="empty site"
        ),
    ],
)
def test_inconsistent_packed_arrays_raise(xy_um, ring_offsets, site_offsets, message):
    with pytest.raises(ParameterError, match=message):
        Layout.from_polygons((xy_um, ring_offsets, site_offsets))


def test_message_about_offsets_is_one_line():
    with pytest.raises(ParameterError, match="must begin at 0 and end at 100") as caught:
        Layout.from_polygons((np.zeros((100, 2)), np.arange(0, 90, 3), np.arange(30)))

    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        pytest.param({"channel": [0]}, "'channel' must have one value for each of the 2 sites", id="short"),
        pytest.param({"readout_line": [0, 1, 2]}, "'readout_line' must have one value for each of the 2", id="long"),
        pytest.param({"channel": 1}, "'channel' must have one value for each of the 2 sites", id="one number"),
        pytest.param({"tag": [[1, 2], [3, 4]]}, "'tag' must have one value for each of the 2 sites", id="nested"),
        pytest.param({"tag": [None, {}]}, "'tag' must be an array of numbers or strings", id="objects"),
        pytest.param({"tag": [[1], [1, 2]]}, "'tag' must ", id="ragged"),
    ],
)
@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda columns: Layout.from_polygons([UNIT, TRIANGLE], **columns), id="from_polygons"),
        pytest.param(lambda columns: Layout.from_rectangles([[0, 0], [1, 1]], 1.0, **columns), id="from_rectangles"),
        pytest.param(lambda columns: Layout.from_polygons([UNIT, TRIANGLE]).with_columns(**columns), id="with_columns"),
    ],
)
def test_invalid_column_raises_with_name(make, columns, message):
    with pytest.raises(ParameterError, match=message):
        make(columns)


@pytest.mark.parametrize("name", ["channel", "readout_line"])
@pytest.mark.parametrize(
    "values",
    [
        pytest.param([0.0, 1.5], id="fractions"),
        pytest.param([0, -1], id="negative"),
        pytest.param(["R", "G"], id="string"),
        pytest.param([True, False], id="booleans"),
    ],
)
def test_indices_must_be_integers_from_zero(name, values):
    with pytest.raises(ParameterError, match=f"'{name}' must contain integers from 0 to 50000000, got"):
        getattr(Layout.from_rectangles([[0, 0], [1, 1]], 1.0, **{name: values}), name)


# -- constructor -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        pytest.param({"xy_um": np.zeros((4, 3))}, r"'xy_um' must have the shape \(n_vertex, 2\)", id="three columns"),
        pytest.param({"xy_um": np.zeros(8)}, r"'xy_um' must have the shape \(n_vertex, 2\)", id="flat"),
        pytest.param(
            {"xy_um": [[0, 0], [1, np.nan], [1, 1], [0, 1]]}, r"'xy_um' must be finite.* at \[1, 1\]", id="nan"
        ),
        pytest.param(
            {"ring_offsets": [0, 2, 4]},
            "'ring_offsets' .*at least 3 vertices to each item, but item 0",
            id="two vertices",
        ),
        pytest.param(
            {"site_offsets": [0, 0, 1]}, "'site_offsets' .*at least 1 rings to each item, but item 0", id="no ring"
        ),
        pytest.param({"site_offsets": [0]}, "'site_offsets' must begin at 0 and end at 1", id="unused rings"),
        pytest.param({"columns": {"channel": [1, 2]}}, "'channel' must have one value for each of the 1", id="column"),
    ],
)
def test_constructor_rejects_invalid_arrays(changes, message):
    good = {"xy_um": np.array(SQUARE_XY, float), "ring_offsets": [0, 4], "site_offsets": [0, 1]}

    with pytest.raises(ParameterError, match=message):
        Layout(**{**good, **changes})


# -- from_rectangles -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size_um", "sizes_um"),
    [
        pytest.param(2.0, [(2, 2), (2, 2)], id="one size"),
        pytest.param([2.0, 4.0], [(2, 2), (4, 4)], id="size per site"),
        pytest.param([[2.0, 4.0], [1.0, 3.0]], [(2, 4), (1, 3)], id="width and height"),
    ],
)
def test_rectangles_have_given_centres_and_sizes(size_um, sizes_um):
    centres = [(0.0, 0.0), (10.0, -3.0)]
    layout = Layout.from_rectangles(centres, size_um, channel=[1, 2])
    expected = [
        shapely.box(x - w / 2, y - h / 2, x + w / 2, y + h / 2)
        for (x, y), (w, h) in zip(centres, sizes_um, strict=True)
    ]

    assert bool(np.all(shapely.equals(layout.polygons(), expected)))
    assert ring_signs(layout) == [[True], [True]]
    assert layout.channel.tolist() == [1, 2]
    assert layout.centroid_um.tolist() == [list(centre) for centre in centres]


def test_no_rectangles_give_empty_layout():
    assert len(Layout.from_rectangles(np.zeros((0, 2)), 1.0)) == 0


@pytest.mark.parametrize(
    ("centre_um", "size_um", "message"),
    [
        pytest.param([0, 0], 1.0, "'centre_um' must have 2 dimensions", id="one point"),
        pytest.param([[0, 0, 0]], 1.0, r"'centre_um' must have the shape \(n_site, 2\)", id="three coordinates"),
        pytest.param([[0, 0], [np.nan, 1]], 1.0, r"'centre_um' must be finite .* at \[1, 0\]", id="nan"),
        pytest.param([[0, 0], [1, 1]], 0.0, "'size_um' must be > 0", id="zero"),
        pytest.param([[0, 0], [1, 1]], [1.0, -2.0], r"'size_um' must be > 0.*got -2.0 µm at \[1\]", id="negative"),
        pytest.param([[0, 0], [1, 1]], [1.0, np.inf], r"'size_um' must be finite .* at \[1\]", id="infinite"),
        pytest.param([[0, 0], [1, 1]], [1.0, 1.0, 1.0], r"'size_um' must be one number, or have the shape", id="long"),
        pytest.param([[0, 0], [1, 1]], [[1.0], [1.0]], r"'size_um' must be one number, or have the shape", id="thin"),
        pytest.param([["a", "b"]], 1.0, "'centre_um' must be an array of numbers", id="string"),
        pytest.param([[1e20, 0]], 1.0, "µm", id="beyond maximum length"),
    ],
)
def test_invalid_rectangles_raise(centre_um, size_um, message):
    with pytest.raises((ParameterError, GeometryError), match=message):
        Layout.from_rectangles(centre_um, size_um)


# -- selection -------------------------------------------------------------------------------------------------------

SELECTIONS = {
    "mask": (np.array([True, False, True, False]), [0, 2]),
    "list of booleans": ([False, True, False, True], [1, 3]),
    "slice": (slice(1, 3), [1, 2]),
    "backwards": (slice(None, None, -1), [3, 2, 1, 0]),
    "ids": ([3, 1], [3, 1]),
    "ids from the end": ([-1, -4], [3, 0]),
    "one id": (1, [1]),
    "duplicate id": ([1, 1], [1, 1]),
    "none by mask": (np.zeros(4, bool), []),
    "none by slice": (slice(0, 0), []),
    "none by ids": ([], []),
    "all": (slice(None), [0, 1, 2, 3]),
}


@pytest.mark.parametrize(("selection", "ids"), SELECTIONS.values(), ids=SELECTIONS)
def test_selection_preserves_outlines_and_columns(mixed, selection, ids):
    selected = mixed[selection]

    assert [p.wkb for p in selected.polygons()] == [mixed.polygons()[i].wkb for i in ids]
    assert selected.area_um2.tolist() == [mixed.area_um2[i] for i in ids]
    assert {name: column.tolist() for name, column in selected.columns.items()} == {
        name: [column[i] for i in ids] for name, column in mixed.columns.items()
    }


@given(st.data(), polygon_lists())
@relaxed
def test_selection_by_ids_equals_selected_polygons(data, polygons):
    ids = data.draw(st.lists(st.integers(0, len(polygons) - 1), max_size=8))

    assert_same_arrays(Layout.from_polygons(polygons)[ids], Layout.from_polygons([polygons[i] for i in ids]))


def test_selection_by_area(mixed):
    assert mixed[mixed.area_um2 > 5.0].columns["name"].tolist() == ["b", "c"]


def test_iteration_yields_each_site_once(mixed):
    assert [float(site.area_um2[0]) for site in mixed] == mixed.area_um2.tolist()


@pytest.mark.parametrize(
    ("selection", "error", "message"),
    [
        pytest.param(4, IndexError, "out of bounds", id="beyond"),
        pytest.param([0, -5], IndexError, "out of bounds", id="beyond the start"),
        pytest.param(np.array([True, False]), IndexError, "boolean index did not match", id="short mask"),
        pytest.param("channel", IndexError, "integers", id="name of a column"),
        pytest.param(np.array([[0, 1], [2, 3]]), (IndexError, ParameterError), "dimension", id="two dimensions"),
    ],
)
def test_invalid_selection_raises(mixed, selection, error, message):
    with pytest.raises(error, match=message):
        mixed[selection]


# -- transformations ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("angle_deg", "rotated"),
    [
        (0, lambda x, y: (x, y)),
        (90, lambda x, y: (-y, x)),
        (180, lambda x, y: (-x, -y)),
        (270, lambda x, y: (y, -x)),
        (360, lambda x, y: (x, y)),
        (450, lambda x, y: (-y, x)),
        (-90, lambda x, y: (y, -x)),
        (-180, lambda x, y: (-x, -y)),
        (-360_000_270, lambda x, y: (-y, x)),
    ],
)
@given(polygons=polygon_lists())
@settings(relaxed, max_examples=examples(10))
def test_quarter_turns_are_exact(angle_deg, rotated, polygons):
    layout = Layout.from_polygons(polygons)
    x, y = layout.xy_um.T

    assert layout.rotate(angle_deg).xy_um.tolist() == np.stack(rotated(x, y), axis=1).tolist()


def test_quarter_turn_about_exact_point_is_exact(mixed):
    layout = mixed[:3]
    x, y = layout.xy_um.T

    assert layout.rotate(90, origin_um=(2.5, -1.25)).xy_um.tolist() == np.stack((1.25 - y, x - 3.75), axis=1).tolist()


@given(
    polygon_lists(),
    st.floats(-720, 720),
    st.tuples(st.floats(-100, 100), st.floats(-100, 100)),
    st.floats(0.01, 100.0),
)
@relaxed
def test_transformations_agree_with_shapely(polygons, angle_deg, origin_um, factor):
    layout = Layout.from_polygons(polygons)
    dx_um, dy_um = origin_um
    transformations = (
        (layout.translate(dx_um, dy_um), lambda p: affinity.translate(p, dx_um, dy_um), 1.0),
        (layout.rotate(angle_deg, origin_um), lambda p: affinity.rotate(p, angle_deg, origin_um), 1.0),
        (layout.scale(factor, origin_um), lambda p: affinity.scale(p, factor, factor, origin=origin_um), factor**2),
    )

    for moved, by_shapely, area_ratio in transformations:
        np.testing.assert_allclose(
            shapely.get_coordinates(moved.polygons()),
            shapely.get_coordinates([by_shapely(p) for p in layout.polygons()]),
            rtol=1e-10,
            atol=1e-9,
        )
        np.testing.assert_allclose(moved.area_um2, layout.area_um2 * area_ratio, rtol=1e-9)
        assert ring_signs(moved) == ring_signs(layout)


def test_transformation_centre_defaults_to_origin(mixed):
    assert mixed.scale(2.0).xy_um.tolist() == (2.0 * mixed.xy_um).tolist()
    assert mixed.rotate(30.0).xy_um.tolist() == mixed.rotate(30.0, (0.0, 0.0)).xy_um.tolist()


@pytest.mark.parametrize(
    "move",
    [
        pytest.param(lambda layout: layout.translate(3.0, 4.0), id="translate"),
        pytest.param(lambda layout: layout.rotate(33.0), id="rotate"),
        pytest.param(lambda layout: layout.scale(1.5), id="scale"),
        pytest.param(lambda layout: layout[[0, 1, 2, 3]], id="select"),
        pytest.param(lambda layout: layout.with_columns(extra=[1, 2, 3, 4]), id="with_columns"),
    ],
)
def test_transformation_preserves_layout_and_columns(mixed, move):
    before = mixed.xy_um.copy(), mixed.ring_offsets.copy(), mixed.site_offsets.copy()
    moved = move(mixed)

    assert [a.tolist() for a in (mixed.xy_um, mixed.ring_offsets, mixed.site_offsets)] == [a.tolist() for a in before]
    assert {name: moved.columns[name].tolist() for name in mixed.columns} == {
        name: column.tolist() for name, column in mixed.columns.items()
    }


@pytest.mark.parametrize(
    ("move", "message"),
    [
        pytest.param(lambda x: x.translate(np.nan, 0), "'dx_um' must be finite, got nan µm", id="dx nan"),
        pytest.param(lambda x: x.translate(0, "1"), "'dy_um' must be one number", id="dy string"),
        pytest.param(lambda x: x.translate(1e20, 0), "µm", id="beyond maximum length"),
        pytest.param(lambda x: x.rotate(np.inf), "'angle_deg' must be finite", id="angle"),
        pytest.param(lambda x: x.rotate(10, (1, 2, 3)), "'origin_um' must ", id="origin of three"),
        pytest.param(lambda x: x.rotate(10, (1,)), "'origin_um' must ", id="origin of one"),
        pytest.param(lambda x: x.rotate(10, (1, np.nan)), "'origin_um' must be finite", id="origin nan"),
        pytest.param(lambda x: x.scale(0.0), "'factor' must be > 0, got 0.0", id="factor 0"),
        pytest.param(lambda x: x.scale(-1.0), "'factor' must be > 0, got -1.0", id="mirror"),
        pytest.param(lambda x: x.scale(2, (1, 2, 3)), "'origin_um' must ", id="scale about three"),
        pytest.param(lambda x: x.scale(2, (1,)), "'origin_um' must ", id="scale about one"),
        pytest.param(lambda x: x.scale(1e200), "µm", id="scaled beyond maximum length"),
    ],
)
def test_invalid_transformation_raises(mixed, move, message):
    with pytest.raises((ParameterError, GeometryError), match=message):
        move(mixed)


def test_transformations_accept_empty_layout(mixed):
    empty = mixed[:0]

    assert [len(x) for x in (empty.translate(1, 2), empty.rotate(30), empty.scale(2), empty[[]], empty[:])] == [0] * 5
    assert empty.channel.tolist() == []


def test_bounds_of_empty_layout_raise(mixed):
    with pytest.raises(GeometryError, match="the layout has no sites, so its bounds are undefined"):
        _ = mixed[:0].bounds_um


# -- columns, provenance, immutability ---------------------------------------------------------------------------------


def test_index_columns_default_to_zero():
    layout = Layout.from_polygons([UNIT, TRIANGLE])

    assert layout.channel.tolist() == [0, 0]
    assert layout.readout_line.tolist() == [0, 0]
    assert dict(layout.columns) == {}


def test_index_properties_equal_columns(mixed):
    assert mixed.channel.tolist() == [0, 1, 2, 1]
    assert mixed.readout_line.tolist() == [3, 2, 1, 0]


def test_with_columns_adds_and_replaces(mixed):
    layout = mixed.with_columns(channel=[2, 2, 2, 2], zone=[7, 8, 9, 10])

    assert layout.channel.tolist() == [2, 2, 2, 2]
    assert layout.columns["zone"].tolist() == [7, 8, 9, 10]
    assert layout.columns["name"].tolist() == ["a", "b", "c", "d"]
    assert "zone" not in mixed.columns


def test_provenance_records_each_step():
    first = Layout.from_polygons([UNIT, TRIANGLE], provenance={"source": "drawing 7"})
    last = first.translate(1, 2).rotate(90).scale(2).with_columns(zone=[0, 1])[[1]]

    assert dict(first.provenance) == {"source": "drawing 7"}
    assert last.provenance["source"] == "drawing 7"
    assert last.provenance["steps"] == [
        "translated by (1, 2) µm",
        "rotated by 90 degrees",
        "scaled by 2",
        "columns zone set",
        "selected 1 of 2 sites",
    ]


@pytest.mark.parametrize(
    ("layout", "made_by"),
    [
        pytest.param(Layout.from_polygons([UNIT]), "from_polygons", id="from_polygons"),
        pytest.param(Layout.from_rectangles([[0, 0]], 1.0), "from_rectangles", id="from_rectangles"),
    ],
)
def test_repr_shows_origin_of_layout(layout, made_by):
    assert layout.provenance["made_by"] == made_by
    assert repr(layout) == f"Layout(1 sites from {made_by}, columns [])"


ARRAYS = {
    "xy_um": lambda x: x.xy_um,
    "ring_offsets": lambda x: x.ring_offsets,
    "site_offsets": lambda x: x.site_offsets,
    "area_um2": lambda x: x.area_um2,
    "centroid_um": lambda x: x.centroid_um,
    "site_bounds_um": lambda x: x.site_bounds_um,
    "column": lambda x: x.columns["channel"],
    "column of a selection": lambda x: x[1:].columns["channel"],
    "translated xy_um": lambda x: x.translate(1, 1).xy_um,
}


@pytest.mark.parametrize("array_of", ARRAYS.values(), ids=ARRAYS)
def test_arrays_are_read_only(mixed, array_of):
    with pytest.raises(ValueError, match="read-only"):
        array_of(mixed)[0] = 0


def test_columns_and_provenance_are_read_only(mixed):
    with pytest.raises(TypeError, match="does not support item assignment"):
        mixed.columns["channel"] = [0, 0, 0, 0]
    with pytest.raises(TypeError, match="does not support item assignment"):
        mixed.provenance["made_by"] = "hand"
    with pytest.raises(FrozenInstanceError, match="cannot assign"):
        mixed.xy_um = np.zeros((3, 2))


def test_layout_copies_input_arrays():
    source = SimpleNamespace(
        xy=np.array(SQUARE_XY, float), rings=np.array([0, 4]), sites=np.array([0, 1]), channel=np.array([3])
    )
    layout = Layout(source.xy, source.rings, source.sites, {"channel": source.channel})
    from_polygons = Layout.from_polygons((source.xy, source.rings, source.sites), channel=source.channel)
    for array in vars(source).values():
        np.add(array, 1, out=array)

    for each in (layout, from_polygons):
        assert each.xy_um.tolist() == [list(map(float, p)) for p in SQUARE_XY]
        assert (each.ring_offsets.tolist(), each.site_offsets.tolist(), each.channel.tolist()) == ([0, 4], [0, 1], [3])


@pytest.mark.parametrize(
    "copy_of",
    [
        pytest.param(copy.deepcopy, id="deepcopy"),
        pytest.param(lambda layout: pickle.loads(pickle.dumps(layout)), id="pickle"),
    ],
)
def test_copies_equal_the_layout(mixed, copy_of):
    copied = copy_of(mixed)

    assert_same_arrays(copied, mixed)
    assert copied.columns["name"].tolist() == ["a", "b", "c", "d"]
    assert dict(copied.provenance) == dict(mixed.provenance)

"""Edits at points, drawn sites and layers: areas, shared vertices, columns, messages."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

import foveasim as fs
from foveasim.errors import FoveasimError, GeometryError, ParameterError
from foveasim.layout import EDITS
from foveasim.testing._extension import shot_with

GRID = fs.layout.mosaic(fs.layout.grid(n_x=4, n_y=4, pitch_um=10.0), ["RG", "GB"])
RINGS = fs.layout.log_polar(n_sectors=24, r_min_um=4.0, r_max_um=33.0, stagger=True)


def overlap_um2(layout):
    return layout.area_um2.sum() - shapely.union_all(layout.polygons()).area


def test_edits_with_objects_equal_settings():
    parameters = {"n_x": 2, "n_y": 1, "pitch_um": 8.0}
    for name, called, setting in (
        ("repair", {"rules": fs.DesignRules(min_size_um=5.0)}, {"rules": {"min_size_um": 5.0}}),
        (
            "overlay",
            {"layer": fs.layout.grid(**parameters)},
            {"layer": {"generator": "grid", "parameters": parameters}},
        ),
    ):
        further = {"operation": "replace", "margin_um": 1.0} if name == "overlay" else {}
        shot = shot_with("layout", {"mosaic": ["RG", "GB"], "edits": [{"kind": name, **setting, **further}]})
        edited = EDITS[name](GRID, **called, **further)

        assert np.array_equal(shot.camera.sensor.layout.xy_um, edited.xy_um)
        assert np.array_equal(shot.camera.sensor.layout.channel, edited.channel)


def test_removed_sites_leave_others_unchanged():
    edited = fs.layout.remove_at(GRID, GRID.centroid_um[[3, 7]])
    kept = np.delete(np.arange(16), [3, 7])

    assert np.array_equal(edited.xy_um, GRID[kept].xy_um)
    assert np.array_equal(edited.channel, GRID.channel[kept])


def test_merged_site_has_union_area():
    edited = fs.layout.merge_at(RINGS, RINGS.centroid_um[[30, 31, 32]])

    assert edited.n_sites == RINGS.n_sites - 2
    assert edited.area_um2[30] == pytest.approx(RINGS.area_um2[30:33].sum(), rel=1e-12)
    assert np.array_equal(edited.area_um2[31:], RINGS.area_um2[33:])


def test_merge_of_distant_sites_raises():
    with pytest.raises(GeometryError, match="must be connected by shared edges") as caught:
        fs.layout.merge_at(GRID, GRID.centroid_um[[0, 15]])
    assert caught.value.site_ids == (0, 15)


def test_line_cuts_square_into_known_areas():
    edited = fs.layout.cut_along(GRID, [[-30.0, 2.5], [30.0, 2.5]])
    row = np.flatnonzero((GRID.centroid_um[:, 1] > 0) & (GRID.centroid_um[:, 1] < 10))

    assert edited.n_sites == 20
    assert sorted(edited.area_um2)[:8] == pytest.approx([25.0] * 4 + [75.0] * 4)
    assert (
        np.bincount(edited.channel).tolist()
        == (np.bincount(GRID.channel) + np.bincount(GRID.channel[row], minlength=3)).tolist()
    )


def test_cut_at_points_leaves_others_complete():
    edited = fs.layout.cut_along(GRID, [[-30.0, 5.0], [30.0, 5.0]], points_um=[[5.0, 5.0]])

    assert edited.n_sites == 17
    assert sorted(edited.area_um2)[:2] == pytest.approx([50.0, 50.0])


def test_line_within_site_raises():
    with pytest.raises(ParameterError, match="must cut at least one site from boundary to boundary"):
        fs.layout.cut_along(GRID, [[1.0, 1.0], [9.0, 9.0]])


@settings(max_examples=examples(50))
@given(dx=st.floats(-3.0, 3.0), dy=st.floats(-3.0, 3.0))
def test_moved_inner_vertex_preserves_tiling(dx, dy):
    edited = fs.layout.move_vertices(GRID, [[0.0, 0.0]], [[dx, dy]])

    assert edited.area_um2.sum() == pytest.approx(1600.0, rel=1e-12)
    assert overlap_um2(edited) == pytest.approx(0.0, abs=1e-9)


def test_moved_edge_point_becomes_shared_vertex():
    edited = fs.layout.move_vertices(GRID, [[5.0, 0.0]], [[5.0, 2.0]])

    # The triangle (0, 0), (10, 0), (5, 2) has 10 µm².
    assert min(edited.area_um2) == pytest.approx(90.0)
    assert max(edited.area_um2) == pytest.approx(110.0)
    assert edited.xy_um.shape[0] == GRID.xy_um.shape[0] + 2


def test_moved_staggered_vertex_opens_no_gap():
    bricks = fs.Layout.from_rectangles(
        [[5.0, 5.0], [15.0, 5.0], [10.0, 15.0]], [[10.0, 10.0], [10.0, 10.0], [20.0, 10.0]]
    )
    edited = fs.layout.move_vertices(bricks, [[10.0, 10.0]], [[10.0, 12.0]])

    assert edited.area_um2.sum() == pytest.approx(bricks.area_um2.sum(), rel=1e-12)
    assert overlap_um2(edited) == pytest.approx(0.0, abs=1e-9)


def test_vertex_moved_onto_next_is_removed():
    edited = fs.layout.move_vertices(GRID, [[20.0, 20.0]], [[20.0, 10.0]])

    assert edited.xy_um.shape[0] == GRID.xy_um.shape[0] - 1
    assert edited.area_um2.sum() == pytest.approx(1550.0)


def test_crossing_outline_raises_with_site():
    with pytest.raises(GeometryError, match="a new outline is invalid") as caught:
        fs.layout.move_vertices(GRID, [[20.0, 20.0]], [[5.0, 12.0]])
    assert caught.value.site_ids == (15,)


def test_removed_vertex_is_removed_from_neighbours():
    split = fs.layout.move_vertices(GRID, [[5.0, 0.0]], [[5.0, 2.0]])
    restored = fs.layout.remove_vertices(split, [[5.0, 2.0]])

    assert np.array_equal(np.sort(restored.area_um2), np.sort(GRID.area_um2))


@pytest.mark.parametrize(
    ("name", "parameters", "problem"),
    [
        ("remove_at", {"points_um": [[0.5, 0.5], [90.0, 0.0]]}, r"'points_um\[1\]' must lie in a photosite, got \[90.0, 0.0\]"),
        ("remove_at", {"points_um": []}, "points_um"),
        ("remove_at", {"points_um": [[np.nan, 0.0]]}, "points_um"),
        ("move_vertices", {"from_um": [[3.0, 3.0]], "to_um": [[4.0, 4.0]]}, r"'from_um\[0\]' must be a vertex or a point on"),
        ("move_vertices", {"from_um": [[0.0, 0.0]], "to_um": [[4.0, 4.0], [5.0, 5.0]]}, "'to_um' must have one point for"),
        ("remove_vertices", {"points_um": [[5.0, 0.0]]}, r"'points_um\[0\]' must be a vertex"),
        ("set_channel", {"points_um": [[5.0, 5.0]], "channel": -1}, "'channel' must"),
        ("draw", {"outlines_um": [[[0.0, 0.0], [9.0, 9.0], [9.0, 0.0], [0.0, 9.0]]]}, r"'outlines_um\[0\]' must be a valid polygon"),
        ("draw", {"outlines_um": []}, "'outlines_um' must be a list of one or more"),
        ("draw", {"outlines_um": [[[1.0, 1.0], [4.0, 1.0], [2.0, 4.0]]], "overlap": "fill"}, "must contain an area outside"),
        ("overlay", {"layer": "grid"}, "'layer' must be a Layout"),
        ("overlay", {"layer": GRID, "operation": "cut_out"}, "must leave at least one site"),
        ("overlay", {"layer": GRID, "operation": "cut"}, "'operation' must be"),
        ("overlay", {"layer": GRID, "region": [[90, 90], [99, 90], [99, 99]]}, "'region' must contain a part of the layer"),
        ("repair", {}, "'rules' must be given"),
    ],
)  # fmt: skip
def test_invalid_edits_raise_by_name(name, parameters, problem):
    with pytest.raises(FoveasimError, match=problem):
        EDITS[name](GRID, **parameters)


def test_drawn_site_replaces_covered_area():
    triangle = [[-4.0, -4.0], [6.0, -4.0], [0.0, 7.0]]
    edited = fs.layout.draw(GRID, [triangle], channel=2)

    assert edited.area_um2[-1] == pytest.approx(55.0)
    assert edited.channel[-1] == 2
    assert edited.area_um2.sum() == pytest.approx(1600.0, rel=1e-12)
    assert overlap_um2(edited) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("rounding_um", [-1e-13, 1e-13])
def test_drawn_vertices_on_outlines_leave_no_repeats(rounding_um):
    # A vertex of four sites, and points of two edges, up to rounding.
    outline = [[rounding_um, 10.0 + rounding_um], [15.0, 0.0 + rounding_um], [10.0 + rounding_um, 15.0]]
    drawn = fs.layout.draw(GRID, [outline]).translate(1000.0, 1000.0)
    end = np.concatenate(
        [np.roll(np.arange(a, b), -1) for a, b in zip(drawn.ring_offsets[:-1], drawn.ring_offsets[1:], strict=True)]
    )
    edge_um = np.hypot(*(drawn.xy_um[end] - drawn.xy_um).T)

    assert edge_um.min() > 0.1
    assert drawn.area_um2.sum() == pytest.approx(1600.0)
    assert fs.layout.min_width_um(drawn, angle_limit_deg=26.0).min() > 0.1


def test_drawn_site_fills_only_gaps():
    holed = fs.layout.remove_at(GRID, [[5.0, 5.0]])
    edited = fs.layout.draw(holed, [[[-5.0, -5.0], [15.0, -5.0], [15.0, 15.0], [-5.0, 15.0]]], overlap="fill")

    assert edited.n_sites == 16
    assert edited.area_um2[-1] == pytest.approx(100.0)


@pytest.mark.parametrize("margin_um", [0.0, 0.75])
def test_layer_replaces_area_with_margin(margin_um):
    layer = fs.layout.grid(n_x=4, n_y=4, pitch_um=3.0)
    edited = fs.layout.overlay(GRID, layer, margin_um=margin_um)

    assert edited.area_um2[-16:] == pytest.approx(9.0)
    assert edited.area_um2[:-16].sum() == pytest.approx(1600.0 - (12.0 + 2.0 * margin_um) ** 2)
    assert overlap_um2(edited) == pytest.approx(0.0, abs=1e-9)
    # Columns of the layer, and those of the nearest site for the others.
    assert sorted(edited.columns) == sorted(GRID.columns)


def test_layer_fills_around_sites():
    wide = fs.layout.grid(n_x=3, n_y=3, pitch_um=40.0)
    edited = fs.layout.overlay(GRID, wide, operation="fill")

    assert edited.n_sites == 16 + 8
    assert edited.area_um2.sum() == pytest.approx(120.0**2)
    assert np.array_equal(edited[:16].xy_um, GRID.xy_um)


@pytest.mark.parametrize(
    ("operation", "sum_um2"), [("replace", 1600.0), ("union", 1750.0), ("clip", 150.0), ("cut_out", 1450.0)]
)
def test_region_limits_the_layer(operation, sum_um2):
    layer = fs.layout.grid(n_x=40, n_y=40, pitch_um=3.0)
    edited = fs.layout.overlay(GRID, layer, operation=operation, region=[[0, 0], [15, 0], [15, 10], [0, 10]])

    assert edited.area_um2.sum() == pytest.approx(sum_um2)


def test_layers_clip_and_cut_complementary():
    disc = fs.Layout.from_polygons([shapely.Point(1.0, 2.0).buffer(9.0)])
    inside, outside = (fs.layout.overlay(GRID, disc, operation=name) for name in ("clip", "cut_out"))

    assert inside.area_um2.sum() == pytest.approx(disc.area_um2[0], rel=1e-9)
    assert inside.area_um2.sum() + outside.area_um2.sum() == pytest.approx(1600.0, rel=1e-12)


def test_union_permits_overlaps():
    edited = fs.layout.overlay(GRID, GRID, operation="union")

    assert edited.n_sites == 32
    assert overlap_um2(edited) == pytest.approx(1600.0)


def test_sites_at_returns_last_overlapping():
    doubled = fs.layout.overlay(GRID, GRID, operation="union")

    assert fs.layout.sites_at(doubled, GRID.centroid_um).tolist() == list(range(16, 32))
    assert fs.layout.sites_at(RINGS, RINGS.centroid_um).tolist() == list(range(RINGS.n_sites))

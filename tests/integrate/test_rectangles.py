"""Integration over axis-aligned rectangles, in rows and columns or in any order, against overlaps cell by cell."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

import foveasim as fs
from foveasim.errors import ParameterError
from foveasim.integrate import _rectangles
from foveasim.integrate._plan import Plan
from foveasim.integrate._rectangles import LatticePlan, RectanglePlan
from foveasim.layout.lattice import RectangleLattice

KINDS = {"lattice": LatticePlan, "rectangles": RectanglePlan, "outlines": Plan}


def intervals(low, high):
    """Return disjoint intervals of various widths, some of them beyond 0 to 24."""
    edges = np.sort(np.random.default_rng(7).uniform(low, high, 24))
    return edges.reshape(-1, 2)


def lattice():
    # Columns narrower than a cell, wider than 20 cells, on cell borders, and outside the map.
    x_um = np.concatenate((intervals(-2.0, 27.0), [[30.0, 31.0], [-1.0, 24.5], [3.0, 4.0], [5.2, 5.3]]))
    y_um = np.concatenate((intervals(-3.0, 20.0), [[0.0, 17.0], [40.0, 41.0], [6.0, 8.0]]))
    return RectangleLattice(x_um, y_um)


def layout_of_kind(kind, shape=None):
    layout = fs.Layout.from_lattice(shape or lattice())
    if kind == "lattice":
        return layout
    polygons = layout.polygons()
    if kind == "outlines":
        # One more site, a triangle outside the map.
        return fs.Layout.from_polygons([*polygons, shapely.Polygon([(90, 90), (91, 90), (90, 91)])])
    return fs.Layout.from_polygons(list(polygons))


def overlaps_um(intervals_um, origin_um, pitch_um, n):
    """Return the lengths of the overlaps of intervals with the cells of an axis, and their moments about the centres."""
    low = origin_um + pitch_um * np.arange(n)
    start = np.maximum(intervals_um[:, :1], low)
    end = np.minimum(intervals_um[:, 1:], low + pitch_um)
    length = np.clip(end - start, 0.0, None)
    return length, length * (0.5 * (start + end) - (low + 0.5 * pitch_um))


def expected_power(shape, grid, cells, order):
    """Return integrals from the overlaps along both axes; at second order with centred differences, one-sided at the borders."""
    (n_y, n_x), (p_x, p_y), (x0, y0) = grid.shape, grid.pitch_xy_um, grid.origin_um
    along_x, moment_x = overlaps_um(shape.x_um, x0, p_x, n_x)
    along_y, moment_y = overlaps_um(shape.y_um, y0, p_y, n_y)
    power = along_y @ cells @ along_x.T
    if order == 2:
        by_y, by_x = np.gradient(cells.astype(float), p_y, p_x)
        power = power + along_y @ by_x @ moment_x.T + moment_y @ by_y @ along_x.T
    return power.ravel()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_rectangles_match_overlaps_of_cells(kind, order, dtype):
    grid = fs.Grid((17, 24), (1.0, 1.25), (0.0, -1.5))
    cells = np.random.default_rng(1).random(grid.shape).astype(dtype)
    integrator = fs.Integrator(layout_of_kind(kind), grid, order=order)

    power = integrator(cells)[: lattice().n_sites]

    assert isinstance(integrator._overlaps, KINDS[kind])
    np.testing.assert_allclose(power, expected_power(lattice(), grid, cells, order), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("kind", KINDS)
def test_selected_sites_match_all_sites(kind):
    grid = fs.Grid((17, 24), 1.0)
    cells = np.random.default_rng(2).random(grid.shape)
    integrator = fs.Integrator(layout_of_kind(kind), grid)
    where = np.random.default_rng(3).random(integrator.n_sites) < 0.4
    out = np.full(integrator.n_sites, -7.0)

    assert integrator(cells, where=where, out=out) is out
    np.testing.assert_allclose(out[where], integrator(cells)[where], rtol=1e-14, atol=1e-14)
    np.testing.assert_array_equal(out[~where], -7.0)
    np.testing.assert_array_equal(integrator(cells, where=where)[~where], 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_unselected_sites_read_no_cells(kind):
    grid = fs.Grid((17, 24), 1.0)
    cells = np.ones(grid.shape)
    cells[:, 12:] = np.nan
    layout = layout_of_kind(kind)
    where = layout.site_bounds_um[:, 2] < 12.0

    assert 0 < where.sum() < layout.n_sites
    assert np.isfinite(fs.Integrator(layout, grid)(cells, where=where)).all()


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("kind", ["lattice", "rectangles"])
def test_touched_borders_read_no_nan(kind, order):
    # The rectangle ends at the border of a cell of NaN, up to rounding: 0.1 * 3 > 0.3.
    shape = RectangleLattice([[0.1, 0.1 * 3]], [[0.1, 0.1 * 3]])
    grid = fs.Grid((6, 6), 0.1)
    cells = np.ones(grid.shape)
    cells[:, 4:] = cells[4:] = np.nan
    integrator = fs.Integrator(layout_of_kind(kind, shape), grid, order=order)
    if order == 1:
        cells[:, 3] = cells[3] = cells[:, 0] = cells[0] = np.nan

    assert integrator(cells)[0] == pytest.approx(0.04, rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_uncovered_area_is_reported_exactly(kind):
    grid = fs.Grid((17, 24), 1.0)
    shape = lattice()
    n = shape.n_sites
    covered = expected_power(shape, grid, np.ones(grid.shape), 1)
    area = (np.diff(shape.y_um) * np.diff(shape.x_um).T).ravel()

    integrator = fs.Integrator(layout_of_kind(kind), grid)

    np.testing.assert_allclose(integrator.uncovered_um2[:n], area - covered, atol=1e-12)
    assert integrator.n_uncovered == np.count_nonzero(area - covered > 1e-9) + integrator.n_sites - n
    assert fs.Integrator(layout_of_kind(kind), fs.Grid((200, 200), 1.0, (-100.0, -100.0))).n_uncovered == 0


@pytest.mark.parametrize("order", [1, 2])
def test_lattice_adjoint_and_matrix_agree(order):
    grid = fs.Grid((17, 24), 1.0)
    cells, values = np.random.default_rng(4).random(grid.shape), np.random.default_rng(5).random(lattice().n_sites)
    integrator = fs.Integrator(layout_of_kind("lattice"), grid, order=order)

    assert integrator.spread(values).ravel() @ cells.ravel() == pytest.approx(values @ integrator(cells), rel=1e-12)
    np.testing.assert_allclose(integrator.weights() @ cells.ravel(), integrator(cells), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", ["lattice", "rectangles"])
def test_threads_do_not_change_rectangles(kind, monkeypatch):
    monkeypatch.setattr(_rectangles, "SITES_PER_PIECE", 500)
    monkeypatch.setattr(_rectangles, "FEW_SITES", 0)
    shape = RectangleLattice(np.sort(np.random.default_rng(6).uniform(0, 300, 120)).reshape(-1, 2), [[0.3, 250.1]] * 60)
    grid = fs.Grid((256, 300), 1.0)
    cells = np.random.default_rng(7).random(grid.shape, np.float32)
    one, three = (fs.Integrator(layout_of_kind(kind, shape), grid, n_threads=n)(cells) for n in (1, 3))

    np.testing.assert_array_equal(one, three)


@pytest.mark.parametrize("first", range(4))
def test_rectangles_from_any_corner_are_recognised(first):
    corners = np.roll([[0.0, 0.0], [2.0, 0.0], [2.0, 3.0], [0.0, 3.0]], first, axis=0)
    layout = fs.Layout(corners, [0, 4], [0, 1])
    integrator = fs.Integrator(layout, fs.Grid((4, 4), 1.0))

    assert isinstance(integrator._overlaps, RectanglePlan)
    assert integrator(np.ones((4, 4)))[0] == 6.0


@pytest.mark.parametrize(
    "ring",
    [
        [[0, 0], [2, 0], [2, 2], [0, 2.5]],
        [[0, 0], [2, 1], [1, 3], [-1, 2]],
        [[0, 0], [2, 0], [2, 2]],
        [[0, 0], [2, 0], [2, 2], [1, 2], [0, 2]],
        [[0, 0], [2, 0], [1, 0], [1, 2]],
    ],
)
def test_other_outlines_are_not_rectangles(ring):
    layout = fs.Layout(np.array(ring, float), [0, len(ring)], [0, 1])

    assert isinstance(fs.Integrator(layout, fs.Grid((4, 4), 1.0))._overlaps, Plan)


def test_clockwise_rectangles_are_rejected():
    layout = fs.Layout(np.array([[0, 0], [0, 2], [2, 2], [2, 0]], float), [0, 4], [0, 1])

    with pytest.raises(fs.errors.GeometryError, match="site 0 must be counter-clockwise"):
        fs.Integrator(layout, fs.Grid((4, 4), 1.0))


@settings(max_examples=examples(40))
@given(
    ends=st.lists(st.tuples(st.floats(-3, 12), st.floats(0.01, 9)), min_size=1, max_size=4),
    pitch=st.floats(0.05, 3),
    order=st.sampled_from([1, 2]),
)
def test_lattice_agrees_with_outlines(ends, pitch, order):
    axis = np.array([(low, low + width) for low, width in ends])
    shape = RectangleLattice(axis, axis)
    grid = fs.Grid((9, 11), pitch, (-0.7, 0.2))
    cells = np.random.default_rng(8).random(grid.shape)
    integrators = [fs.Integrator(layout_of_kind(kind, shape), grid, order=order) for kind in KINDS]
    powers = [integrator(cells)[: shape.n_sites] for integrator in integrators]

    # Differences of coordinates up to 21 µm, in units of the cells, times lengths up to 9 µm.
    for power in powers[1:]:
        np.testing.assert_allclose(power, powers[0], rtol=1e-11, atol=1e-12 * max(1.0, pitch * pitch))


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"where": np.ones(3, bool)}, "'where' must be 4 booleans, one per site, got bool of shape"),
        ({"where": np.ones(4)}, "got float64 of shape"),
        ({"out": np.zeros(3)}, r"'out' must be a C-contiguous float64 array of shape \(4,\)"),
        ({"out": np.zeros(4, np.float32)}, "must be a C-contiguous float64 array"),
        ({"out": np.zeros(8)[::2]}, "must be a C-contiguous float64 array"),
    ],
)
def test_invalid_selections_are_rejected(arguments, match):
    integrator = fs.Integrator(fs.layout.grid(2, 2, 1.0), fs.Grid((4, 4), 1.0, (-2.0, -2.0)))

    with pytest.raises(ParameterError, match=match):
        integrator(np.ones((4, 4)), **arguments)

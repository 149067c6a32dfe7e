"""Power cells: closed forms of derivatives, Voronoi cells, degenerate positions, errors."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.errors import GeometryError, ParameterError

torch = pytest.importorskip("torch")
learn = fs.learn

REGION_UM = (0.0, 0.0, 6.0, 5.0)
GRID = fs.Grid((10, 12), 0.5)


def random_cells(seed, *, weighted=True):
    rng = np.random.default_rng(seed)
    lattice = np.stack(np.meshgrid(np.arange(4) * 1.5 + 0.75, np.arange(3) * 1.6 + 0.8), axis=-1).reshape(-1, 2)
    centres = lattice + rng.uniform(-0.4, 0.4, lattice.shape)
    weights = rng.uniform(-0.3, 0.3, lattice.shape[0]) if weighted else None
    return learn.PowerCells(centres, weights, region_um=REGION_UM)


def square_grid_cells(n=4):
    x = np.arange(n) + 0.5
    return learn.PowerCells(np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2), region_um=(0.0, 0.0, n, n))


def edge_moments(layout, data, grid=GRID):
    """Integrals of P and of P x over the common edge of all pairs, piece by piece, with shapely."""
    pitch = grid.pitch_um
    cells = [
        (value, shapely.box(i * pitch, j * pitch, (i + 1) * pitch, (j + 1) * pitch))
        for (j, i), value in np.ndenumerate(data)
    ]
    polygons = layout.polygons()
    n = layout.n_sites
    total, first = np.zeros((n, n)), np.zeros((n, n, 2))
    for i in range(n):
        for j in range(i):
            ends = np.array(
                [p for p in polygons[i].exterior.coords[:-1] if polygons[j].distance(shapely.Point(p)) < 1e-9]
            )
            if len(ends) != 2:
                continue
            edge = shapely.LineString(ends)
            for value, cell in cells:
                piece = shapely.intersection(edge, cell)
                if piece.length > 0.0:
                    total[i, j] += value * piece.length
                    first[i, j] += value * piece.length * np.array(piece.centroid.coords[0])
    return total + total.T, first + np.swapaxes(first, 0, 1)


def jacobians(cells, data):
    """Derivatives of the power of each site by all weights and by all centres."""
    power = cells.power(torch.from_numpy(data), GRID)
    rows = [torch.autograd.grad(each, (cells.weights_um2, cells.centres_um), retain_graph=True) for each in power]
    return np.array([w.numpy() for w, _ in rows]), np.array([c.numpy() for _, c in rows])


def distances(cells):
    centres = cells.centres_um.detach().numpy()
    d = np.hypot(*np.moveaxis(centres[:, np.newaxis] - centres, -1, 0))
    np.fill_diagonal(d, np.inf)
    return d


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_weight_derivatives_are_edge_integrals(seed):
    cells, data = random_cells(seed), np.random.default_rng(seed).uniform(0.2, 2.0, GRID.shape)

    by_weight, _ = jacobians(cells, data)

    total, _ = edge_moments(cells.layout(), data)
    expected = -total / (2.0 * distances(cells))
    np.fill_diagonal(expected, -expected.sum(axis=1))
    np.testing.assert_allclose(by_weight, expected, rtol=0, atol=1e-11 * abs(expected).max())


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_centre_derivatives_are_edge_moments(seed):
    cells, data = random_cells(seed), np.random.default_rng(seed + 10).uniform(0.2, 2.0, GRID.shape)

    _, by_centre = jacobians(cells, data)

    total, first = edge_moments(cells.layout(), data)
    centres, d = cells.centres_um.detach().numpy(), distances(cells)[:, :, np.newaxis]
    own = ((first - total[:, :, np.newaxis] * centres[:, np.newaxis]) / d).sum(axis=1)
    expected = -(first - total[:, :, np.newaxis] * centres) / d
    expected[np.arange(12), np.arange(12)] = own
    np.testing.assert_allclose(by_centre, expected, rtol=0, atol=1e-11 * abs(expected).max())


def test_derivatives_match_finite_differences():
    cells, maps = random_cells(5), torch.from_numpy(np.random.default_rng(5).uniform(0.2, 2.0, (2, *GRID.shape)))

    def power(centres, weights):
        points, outlines = torch.func.functional_call(cells, {"centres_um": centres, "weights_um2": weights}, ())
        return learn.site_power(points, maps, outlines, GRID)

    inputs = tuple(p.detach().clone().requires_grad_() for p in (cells.centres_um, cells.weights_um2))
    assert torch.autograd.gradcheck(power, inputs, eps=1e-6, atol=1e-6, rtol=1e-6)


def test_second_derivatives_match_finite_differences():
    cells = random_cells(6)
    x, y = np.meshgrid((np.arange(12) + 0.5) * 0.5, (np.arange(10) + 0.5) * 0.5)
    maps = torch.from_numpy(1.0 + 0.3 * x + 0.2 * y)

    def power(centres, weights):
        points, outlines = torch.func.functional_call(cells, {"centres_um": centres, "weights_um2": weights}, ())
        return learn.site_power(points, maps, outlines, GRID, order=2)

    inputs = tuple(p.detach().clone().requires_grad_() for p in (cells.centres_um, cells.weights_um2))
    assert torch.autograd.gradgradcheck(power, inputs, eps=1e-6, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("weighted", [False, True])
def test_power_of_partition_is_constant(weighted):
    data = torch.from_numpy(np.random.default_rng(7).uniform(0.2, 2.0, GRID.shape))

    for seed in range(5):
        cells = random_cells(seed, weighted=weighted)
        total = cells.power(data, GRID).sum()
        total.backward()

        assert total.item() == pytest.approx(float(data.sum()) * 0.25, rel=1e-13)
        assert cells.centres_um.grad.abs().max() < 1e-12 * float(data.sum())
        assert cells.weights_um2.grad.abs().max() < 1e-12 * float(data.sum())


def test_common_weight_does_not_change_cells():
    cells = random_cells(8)
    area = cells.area_um2().detach()

    with torch.no_grad():
        cells.weights_um2 += 3.0

    np.testing.assert_allclose(cells.area_um2().detach(), area, rtol=1e-12)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_equal_weights_give_voronoi_cells(seed):
    rng = np.random.default_rng(seed)
    centres = rng.uniform((-3.0, 2.0), (4.0, 7.0), (150, 2))
    region = shapely.box(-3.0, 2.0, 4.0, 7.0)
    cells = learn.PowerCells(centres, np.full(150, 0.7), region_um=region.bounds).layout().polygons()

    diagram = shapely.voronoi_polygons(shapely.MultiPoint(centres), extend_to=region, ordered=True)

    expected = shapely.intersection(shapely.get_parts(diagram), region)
    assert shapely.area(shapely.symmetric_difference(cells, expected)).max() < 1e-10


def test_cells_have_the_least_power():
    cells = random_cells(9)
    points = np.random.default_rng(9).uniform((0.0, 0.0), (6.0, 5.0), (3000, 2))
    centres, weights = cells.centres_um.detach().numpy(), cells.weights_um2.detach().numpy()

    owner = (((points[:, np.newaxis] - centres) ** 2).sum(axis=-1) - weights).argmin(axis=1)

    assert shapely.contains_xy(cells.layout().polygons()[owner], points).all()


def test_neighbours_share_points():
    points, outlines = random_cells(10).cells()

    assert outlines.n_points == len(points)
    n_sites_of_edge = np.bincount(outlines.edges.edge)
    assert set(n_sites_of_edge) == {1, 2}
    # Euler: points - edges + cells = 1 for a tiling without holes.
    assert outlines.n_points - outlines.edges.n_edges + outlines.n_sites == 1


def test_corners_lie_exactly_on_sides():
    xy_um = random_cells(11).layout().xy_um

    assert (xy_um.min(axis=0) == 0.0).all()
    assert (xy_um.max(axis=0) == (6.0, 5.0)).all()
    assert random_cells(11).layout().check(fs.DesignRules(die_um=REGION_UM, max_gap_um2=0.0)).ok


def test_square_grid_start_has_exact_derivatives():
    cells = square_grid_cells()
    data = np.random.default_rng(12).uniform(0.2, 2.0, (8, 8))
    grid = fs.Grid((8, 8), 0.5)
    power = cells.power(torch.from_numpy(data), grid)

    assert power.detach().numpy() == pytest.approx(data.reshape(4, 2, 4, 2).sum(axis=(1, 3)).ravel() * 0.25, rel=1e-13)
    (by_weight,) = torch.autograd.grad(power[5], cells.weights_um2, retain_graph=True)
    # Edges lie along cell boundaries: the integral along them is that of the mean of both sides.
    lines = {
        4: data[2:4, 1:3], 6: data[2:4, 3:5], 1: data[1:3, 2:4], 9: data[3:5, 2:4],
    }  # fmt: skip
    expected = np.zeros(16)
    for j, cells_at_edge in lines.items():
        expected[j] = -0.5 * cells_at_edge.mean()
    expected[5] = -expected.sum()
    np.testing.assert_allclose(by_weight.numpy(), expected, atol=1e-12)


def test_square_grid_layout_has_square_sites():
    layout = square_grid_cells(6).layout()

    assert np.diff(layout.ring_offsets).tolist() == [4] * 36
    assert layout.area_um2 == pytest.approx(1.0, rel=1e-13)


def test_square_grid_start_reaches_target_areas():
    cells = square_grid_cells()
    target = torch.from_numpy(np.random.default_rng(13).uniform(0.7, 1.3, 16))
    target *= 16.0 / target.sum()
    optimiser = torch.optim.LBFGS(
        [cells.weights_um2], max_iter=60, line_search_fn="strong_wolfe", tolerance_grad=0.0, tolerance_change=1e-15
    )

    def loss():
        optimiser.zero_grad()
        error = ((cells.area_um2() - target) ** 2).sum()
        error.backward()
        return error

    optimiser.step(loss)

    assert (cells.area_um2() - target).abs().max() < 1e-6
    assert cells.layout().area_um2 == pytest.approx(target.numpy(), abs=1e-6)


def test_corner_of_region_on_bisector_is_valid():
    cells = learn.PowerCells([[1.0, 3.0], [3.0, 1.0], [0.5, 0.5]], region_um=(0.0, 0.0, 4.0, 4.0))

    assert cells.area_um2().sum().item() == pytest.approx(16.0, rel=1e-14)
    np.testing.assert_allclose(cells.area_um2().detach()[0], cells.area_um2().detach()[1], rtol=1e-13)


def test_single_centre_fills_region():
    cells = learn.PowerCells([[1.0, 1.0]], region_um=(0.0, 0.0, 4.0, 2.0))

    assert cells.layout().xy_um.tolist() == [[4.0, 0.0], [4.0, 2.0], [0.0, 2.0], [0.0, 0.0]]


def test_empty_cell_error_has_its_index():
    with pytest.raises(GeometryError, match=r"centre 1 must have a cell.*1 empty of 3") as error:
        learn.PowerCells([[1.0, 1.0], [3.0, 1.1], [5.0, 1.0]], [0.0, -9.0, 0.0], region_um=(0.0, 0.0, 6.0, 2.0))

    assert error.value.site_ids == (1,)


def test_centre_outside_region_error_has_index():
    cells = random_cells(14)
    with torch.no_grad():
        cells.centres_um[7] = torch.tensor([6.5, 1.0])

    with pytest.raises(GeometryError, match=r"centre 7 must lie inside the region, got \(6.5, 1\) µm"):
        cells.cells()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[1.0, 1.0, 1.0]],), r"'centres_um' must have the shape \(n, 2\)"),
        (([[1.0, 1.0]], [1.0, 2.0]), r"'weights_um2' must have the shape \(1,\)"),
        (("middle",), "'centres_um' must be a tensor or an array"),
    ],
)
def test_invalid_arguments_give_one_line(arguments, message):
    with pytest.raises(ParameterError, match=message):
        learn.PowerCells(*arguments, region_um=(0.0, 0.0, 2.0, 2.0))


def test_invalid_region_is_rejected():
    with pytest.raises(ParameterError, match=r"'region_um' must be \(x_min, y_min, x_max, y_max\)"):
        learn.PowerCells([[1.0, 1.0]], region_um=(0.0, 0.0, 0.0, 2.0))


def test_equal_centres_are_rejected():
    with pytest.raises(GeometryError, match="must have a cell"):
        learn.PowerCells([[1.0, 1.0], [1.0, 1.0], [0.5, 1.5]], region_um=(0.0, 0.0, 2.0, 2.0))


def test_state_of_cells_is_restored():
    cells = random_cells(15)
    other = random_cells(16)

    other.load_state_dict(cells.state_dict())

    assert torch.equal(other.area_um2(), cells.area_um2())


def test_limited_step_has_no_empty_cell():
    cells = random_cells(17)
    before = cells.centres_um.detach().clone()
    with torch.no_grad():
        cells.weights_um2[5] -= 3.0
        cells.centres_um[0] = torch.tensor([-1.0, 0.8])
        cells.centres_um[11] += 0.01
        cells.centres_um[3, 0] = torch.nan

    fraction = cells.limit_step()

    assert 0.0 < fraction < 1.0
    assert cells.area_um2().min() > 0.0
    assert 0.0 < cells.centres_um[0, 0] < before[0, 0]
    assert torch.equal(cells.centres_um[11].detach(), before[11] + 0.01)
    assert torch.equal(cells.centres_um[3].detach(), before[3])
    assert cells.limit_step() == 1.0

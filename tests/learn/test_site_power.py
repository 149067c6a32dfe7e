"""Integrals as functions of vertices and maps, and meshes: derivatives, conservation, wrong tensors."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

import foveasim as fs
from foveasim import learn

GRID = fs.Grid((12, 14), 0.9, (-6.3, -5.4))


def hexagons():
    return fs.layout.hexagonal(n_columns=4, n_rows=3, pitch_um=2.3).rotate(11.0)


def moved_points(mesh, seed=0, size_um=0.05):
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(mesh.n_points, 2, dtype=torch.float64, generator=generator)
    return (mesh().detach() + size_um * noise).requires_grad_()


def random_maps(n, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(n, *GRID.shape, dtype=torch.float64, generator=generator, requires_grad=True)


@pytest.mark.slow(keep=5)
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("n_maps", [1, 2, 5])
def test_first_derivatives_pass_gradcheck(order, n_maps):
    mesh = learn.Mesh(hexagons())

    def power(points, maps):
        return learn.site_power(points, maps, mesh, GRID, order=order)

    assert gradcheck(power, (moved_points(mesh), random_maps(n_maps)), atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("order", [1, 2])
def test_second_derivatives_pass_gradcheck(order):
    mesh = learn.Mesh(fs.layout.hexagonal(n_columns=2, n_rows=2, pitch_um=2.3).rotate(11.0))

    def power(points, maps):
        return learn.site_power(points, maps, mesh, GRID, order=order)

    assert gradgradcheck(power, (moved_points(mesh), random_maps(2)), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("n_maps", [1, 6])
def test_power_is_that_of_integrator(order, n_maps):
    mesh, maps = learn.Mesh(hexagons(), boundary="free"), random_maps(n_maps).detach()
    points = moved_points(mesh).detach()
    found = learn.site_power(points, maps, mesh, GRID, order=order)
    layout = mesh.outlines.layout(points)

    expected = fs.Integrator(layout, GRID, order=order)(maps.numpy())
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)


def test_total_of_tiling_ignores_inner_vertices():
    mesh = learn.Mesh(fs.layout.grid(5, 4, 1.7).rotate(0.3))
    ones = torch.ones(1, *GRID.shape, dtype=torch.float64)
    for maps in (ones, random_maps(1)):
        learn.site_power(mesh(), maps, mesh, GRID).sum().backward()
        assert float(mesh.displacement_um.grad.abs().max()) < 1e-12


def test_area_gradient_is_exact():
    mesh = learn.Mesh(hexagons(), boundary="free")
    points = moved_points(mesh)
    ones = torch.ones(1, 60, 60, dtype=torch.float64)
    grid = fs.Grid.centred((60, 60), 0.9)
    weights = torch.rand(mesh.n_sites, dtype=torch.float64)
    (by_power,) = torch.autograd.grad((learn.site_power(points, ones, mesh, grid) * weights).sum(), points)
    (by_area,) = torch.autograd.grad((mesh.outlines.area_um2(points) * weights).sum(), points)

    torch.testing.assert_close(by_power, by_area, rtol=1e-12, atol=1e-12)
    assert gradcheck(mesh.outlines.area_um2, (points,))


def test_float32_maps_give_float32_power():
    mesh = learn.Mesh(hexagons())
    maps = random_maps(2).detach().float().requires_grad_()
    power = learn.site_power(mesh(), maps, mesh, GRID)
    power.sum().backward()

    assert power.dtype == maps.grad.dtype == torch.float32
    assert mesh.displacement_um.grad.dtype == torch.float64


def test_leading_axes_of_maps_are_kept():
    mesh = learn.Mesh(hexagons())
    maps = torch.rand(2, 3, *GRID.shape, dtype=torch.float64)

    assert learn.site_power(mesh(), maps, mesh, GRID).shape == (2, 3, 12)
    assert learn.site_power(mesh(), maps[0, 0], mesh, GRID).shape == (12,)


def test_threads_do_not_change_gradient():
    mesh, gradients = learn.Mesh(hexagons()), []
    for n in (1, 4):
        mesh.zero_grad()
        (learn.site_power(mesh(), random_maps(3), mesh, GRID, n_threads=n) ** 2).sum().backward()
        gradients.append(mesh.displacement_um.grad.clone())

    assert torch.equal(*gradients)


MESH = learn.Mesh(hexagons())


@pytest.mark.parametrize(
    ("points", "maps", "message"),
    [
        (np.zeros((3, 2)), None, "'points' must be a Tensor, got an ndarray"),
        (torch.zeros(3, 2), None, r"'points' must have the shape \(38, 2\), one row per point, got \(3, 2\)"),
        (torch.zeros(38, 2, dtype=torch.int64), None, "floating-point numbers, got torch.int64; use .double"),
        (torch.zeros(38, 2, device="meta"), None, "'maps' must be on the device of the points, meta, got cpu"),
        (None, torch.ones(3, 3), "'maps' must have the shape"),
        (None, torch.ones(12, 14, dtype=torch.int32), "'maps' must be a tensor of floating-point numbers"),
        (None, torch.ones(12, 14, device="meta"), "'maps' must be on the device of the points, cpu, got meta"),
        (None, np.ones((12, 14)), "'maps' must be a Tensor"),
    ],
)
def test_wrong_tensors_are_rejected(points, maps, message):
    points = MESH() if points is None else points
    maps = torch.ones(12, 14) if maps is None else maps
    with pytest.raises(fs.FoveasimError, match=message):
        learn.site_power(points, maps, MESH, GRID)


def test_inverted_site_is_reported():
    mesh = learn.Mesh(fs.layout.grid(3, 3, 1.0))
    with torch.no_grad():
        mesh.displacement_um += 2.5

    assert mesh.invalid_sites().size > 0
    with pytest.raises(fs.FoveasimError, match="site"):
        learn.site_power(mesh(), torch.ones(12, 14), mesh, GRID)
    with pytest.raises(fs.errors.GeometryError, match="site"):
        mesh.layout()


def test_not_finite_points_are_reported():
    points = MESH().detach().clone()
    points[4, 1] = torch.nan
    with pytest.raises(fs.FoveasimError, match="point 4 must have finite coordinates"):
        learn.site_power(points, torch.ones(12, 14), MESH, GRID)


# -- meshes ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("boundary", "n_free"), [("fixed", 2 * 4), ("sliding", 2 * 4 + 8), ("free", 2 * 16)])
def test_boundary_determines_free_coordinates(boundary, n_free):
    mesh = learn.Mesh(fs.layout.grid(3, 3, 1.0), boundary)

    assert (mesh.n_points, mesh.displacement_um.numel()) == (16, n_free)


@pytest.mark.parametrize("boundary", ["fixed", "sliding"])
def test_moved_mesh_covers_same_area(boundary):
    layout = fs.layout.grid(6, 5, 1.0)
    mesh = learn.Mesh(layout, boundary)
    with torch.no_grad():
        mesh.displacement_um += 0.2 * torch.randn(
            mesh.displacement_um.shape, generator=torch.Generator().manual_seed(2)
        )
    report = mesh.layout().check(fs.DesignRules(max_overlap_um2=1e-9, max_gap_um2=1e-9))

    assert float(mesh.area_um2().detach().sum()) == pytest.approx(30.0, rel=1e-12)
    assert report.ok


def test_t_junctions_get_shared_points():
    bricks = fs.Layout.from_rectangles([[0.5, 0.5], [1.5, 0.5], [1.0, 1.5]], [[1, 1], [1, 1], [2, 1]])
    mesh = learn.Mesh(bricks)

    assert mesh.n_points == 8
    assert mesh.outlines.edges.n_edges == 10


def test_layout_keeps_columns_and_provenance():
    layout = fs.layout.grid(3, 2, 1.0).with_columns(channel=np.arange(6))
    found = learn.Mesh(layout).layout()

    np.testing.assert_array_equal(found.channel, np.arange(6))
    np.testing.assert_allclose(found.area_um2, layout.area_um2)
    assert found.provenance["generator"] == layout.provenance["generator"]
    assert found.provenance["steps"][-1] == "moved vertices of a mesh"


@pytest.mark.parametrize("size_um", [0.1, 1.0, 30.0])
def test_limited_step_keeps_sites_valid(size_um):
    mesh = learn.Mesh(fs.layout.grid(6, 6, 1.0), "sliding")
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        with torch.no_grad():
            mesh.displacement_um += size_um * torch.randn(
                mesh.displacement_um.shape, generator=generator, dtype=torch.float64
            )
        fraction = mesh.limit_step()
        assert 0.0 <= fraction <= 1.0
        assert not mesh.invalid_sites().size
    assert float(mesh.area_um2().detach().sum()) == pytest.approx(36.0, rel=1e-12)
    assert float(mesh.displacement_um.detach().abs().max()) > 0.01


def test_valid_step_is_complete():
    mesh = learn.Mesh(fs.layout.grid(4, 4, 1.0))
    with torch.no_grad():
        mesh.displacement_um += 0.1

    assert mesh.limit_step() == 1.0
    assert torch.all(mesh.displacement_um == 0.1)


def test_not_finite_step_is_cancelled():
    mesh = learn.Mesh(fs.layout.grid(4, 4, 1.0))
    with torch.no_grad():
        mesh.displacement_um[0] = torch.nan
    mesh.limit_step()

    assert torch.all(mesh.displacement_um == 0.0)


def test_state_of_mesh_is_restored():
    mesh, other = (learn.Mesh(fs.layout.grid(4, 4, 1.0)) for _ in range(2))
    with torch.no_grad():
        mesh.displacement_um += 0.1
    other.load_state_dict(mesh.state_dict())

    assert torch.equal(mesh(), other())


def test_gradient_descent_equalises_power():
    mesh = learn.Mesh(fs.layout.grid(4, 4, 2.0), "sliding")
    grid = fs.Grid.centred((64, 64), 0.125)
    x, y = np.meshgrid(grid.x_um, grid.y_um)
    cells = torch.from_numpy(1.0 + 2.0 * np.exp(-(x**2 + y**2) / 4.0))
    optimiser = torch.optim.Adam(mesh.parameters(), lr=0.02)
    spread = []
    for _ in range(150):
        power = learn.site_power(mesh(), cells, mesh, grid)
        loss = power.var() / power.mean() ** 2
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        mesh.limit_step()
        spread.append(float(loss.detach()))
    area = mesh.area_um2().detach().reshape(4, 4)

    assert spread[-1] < 1e-3 * spread[0]
    assert area[1:3, 1:3].mean() < area[0, 0]


@pytest.mark.parametrize("argument", ["slippery", None])
def test_unknown_boundary_is_rejected(argument):
    with pytest.raises(fs.FoveasimError, match="'boundary' must be one of 'fixed', 'sliding', 'free'"):
        learn.Mesh(fs.layout.grid(2, 2, 1.0), argument)


def test_mesh_requires_layout_with_sites():
    with pytest.raises(fs.FoveasimError, match="'layout' must be a Layout"):
        learn.Mesh(3)
    with pytest.raises(fs.FoveasimError, match="must have at least one site"):
        learn.Mesh(fs.layout.grid(2, 2, 1.0)[:0])

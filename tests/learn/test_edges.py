"""Integrals over sites in operations of PyTorch, compared with the kernels."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

import foveasim as fs
from foveasim import learn
from foveasim.learn._edges import integrate_edges

LAYOUTS = {
    "hexagons": fs.layout.hexagonal(n_columns=5, n_rows=4, pitch_um=3.0).rotate(9.0),
    "beyond the grid": fs.layout.log_polar(n_sectors=12, r_min_um=2.0, r_max_um=14.0, n_rings=5),
    "holes": fs.Layout.from_polygons(
        (
            np.array([[-6, -6], [6, -5], [7, 6], [-5, 7], [-2, -2], [-1, 2], [3, 2], [2, -3], [8, -6], [9, -6], [9, 5]], float),
            np.array([0, 4, 8, 11]),
            np.array([0, 2, 3]),
        )
    ),
}  # fmt: skip


def moved(name, dtype=torch.float64):
    mesh = learn.Mesh(LAYOUTS[name], "free")
    noise = 0.05 * torch.randn(mesh.n_points, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return mesh, (mesh().detach() + noise).to(dtype)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("name", LAYOUTS)
def test_edges_agree_with_kernels(name, order):
    """Integrals and both gradients, for grids with unequal pitches and with a single row."""
    for shape, pitch_um in (((22, 24), 0.8), ((20, 25), (0.7, 0.9)), ((1, 30), (0.5, 15.0))):
        grid = fs.Grid.centred(shape, pitch_um)
        mesh, points = moved(name)
        points.requires_grad_()
        maps = torch.rand(2, *shape, dtype=torch.float64, requires_grad=True)
        weights = torch.rand(2, mesh.n_sites, dtype=torch.float64)
        kernels = learn.site_power(points, maps, mesh, grid, order=order)
        edges = integrate_edges(points, maps, mesh.outlines, grid, order)
        torch.testing.assert_close(edges, kernels, rtol=0, atol=1e-13 * float(kernels.detach().max()))
        for found, expected in zip(
            *(torch.autograd.grad((each * weights).sum(), (points, maps)) for each in (edges, kernels)), strict=True
        ):
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))


@pytest.mark.parametrize("order", [1, 2])
def test_edges_pass_gradcheck(order, real_device):
    grid = fs.Grid.centred((14, 15), 1.1)
    mesh, points = moved("hexagons")
    maps = torch.rand(2, 14, 15, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    inputs = [each.to(real_device).requires_grad_() for each in (points, maps)]

    def power(points, maps):
        return integrate_edges(points, maps, mesh.outlines, grid, order)

    assert gradcheck(power, inputs, eps=1e-7, atol=1e-6, nondet_tol=1e-10, fast_mode=True)


def test_edges_integrate_single_precision():
    grid = fs.Grid.centred((22, 24), 0.8)
    mesh, points = moved("hexagons")
    maps = torch.rand(22, 24, dtype=torch.float32)[None]
    found = integrate_edges(points, maps, mesh.outlines, grid, 1)

    assert found.dtype == torch.float32
    torch.testing.assert_close(found, learn.site_power(points, maps, mesh, grid), rtol=1e-6, atol=1e-6)

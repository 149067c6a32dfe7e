"""Convolution, pooling and log-polar rasters of photosites, compared with the operations of PyTorch on pictures."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import torch
from torch import nn

import foveasim as fs
from foveasim import learn

GRID = fs.layout.grid(n_x=9, n_y=7, pitch_um=3.0)
HEXAGONS = fs.layout.hexagonal(n_columns=12, n_rows=11, pitch_um=3.0)
LOG_POLAR = fs.layout.log_polar(n_sectors=24, r_min_um=3.0, r_max_um=30.0, n_rings=10)


def picture_of(values):
    """Return the values of the sites of the grid as pictures, top row first."""
    return values.reshape(*values.shape[:-1], 7, 9).flip(-2)


def sites_of(pictures):
    return pictures.flip(-2).flatten(-2)


@pytest.mark.parametrize("kernel_size", [1, 3, 5])
def test_convolution_on_grid_is_that_of_pictures(kernel_size):
    own = learn.SiteConv(3, 4, GRID, kernel_size).double()
    conv = nn.Conv2d(3, 4, kernel_size, padding="same").double()
    conv.weight, conv.bias = own.weight, own.bias
    values = torch.rand(2, 3, 63, dtype=torch.float64)

    torch.testing.assert_close(own(values), sites_of(conv(picture_of(values))), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("frame", ["image", "radial"])
@pytest.mark.parametrize("layout", [HEXAGONS, LOG_POLAR], ids=["hexagons", "log-polar"])
def test_convolution_of_constant_is_constant_inside(layout, frame):
    own = learn.SiteConv(2, 3, layout, 3, frame=frame, n_neighbours=16, bias=False).double()
    found = own(torch.ones(1, 2, layout.n_sites, dtype=torch.float64))[0]
    is_inside = np.hypot(*layout.centroid_um.T) < 0.5 * np.hypot(*layout.centroid_um.T).max()
    if layout is LOG_POLAR:  # the innermost rings have no sites in their middle
        is_inside &= np.hypot(*layout.centroid_um.T) > 6.0
    expected = own.weight.sum(dim=(1, 2, 3))

    torch.testing.assert_close(
        found[:, is_inside], expected[:, None].expand(3, int(is_inside.sum())), rtol=1e-12, atol=1e-12
    )


def test_radial_convolution_is_equivariant_to_rotation():
    # Of sites at equal distances, those beyond the kernel may be missing.
    own = learn.SiteConv(2, 3, LOG_POLAR, 3, frame="radial", n_neighbours=24).double()
    values = torch.rand(1, 2, LOG_POLAR.n_sites, dtype=torch.float64)
    order = np.argsort(LOG_POLAR.columns["ring"] * 24 + (LOG_POLAR.columns["sector"] + 5) % 24)
    turned = torch.from_numpy(np.argsort(order))

    torch.testing.assert_close(own(values[..., turned]), own(values)[..., turned], rtol=1e-9, atol=1e-9)


def test_convolution_and_pooling_pass_gradcheck(real_device):
    own = learn.SiteConv(2, 3, HEXAGONS, 3).double().to(real_device)
    pool = learn.SitePool(HEXAGONS).to(real_device)
    coarser = learn.SiteConv(3, 2, HEXAGONS, 3, outputs=pool.layout).double().to(real_device)
    values = torch.rand(1, 2, HEXAGONS.n_sites, dtype=torch.float64, device=real_device, requires_grad=True)

    def found(values, *weights):
        state = dict(zip(dict(own.named_parameters()), weights, strict=True))
        first = torch.func.functional_call(own, state, (values,))
        return pool(first), coarser(first)

    assert torch.autograd.gradcheck(found, (values, *own.parameters()), nondet_tol=1e-10, fast_mode=True)


@pytest.mark.parametrize("reduce", ["mean", "max", "sum"])
def test_pooling_of_blocks_is_that_of_pictures(reduce):
    layout = fs.layout.grid(n_x=8, n_y=6, pitch_um=2.0)
    x, y = np.arange(48) % 8, np.arange(48) // 8
    pool = learn.SitePool(layout, (y // 2) * 4 + x // 2, reduce=reduce)
    values = torch.rand(2, 3, 48)
    pictures = values.reshape(2, 3, 6, 8)
    expected = nn.functional.max_pool2d(pictures, 2) if reduce == "max" else nn.functional.avg_pool2d(pictures, 2)

    torch.testing.assert_close(pool(values), expected.flatten(-2) * (4.0 if reduce == "sum" else 1.0))
    np.testing.assert_allclose(pool.layout.area_um2, 16.0)


@pytest.mark.parametrize("layout", [GRID, HEXAGONS, LOG_POLAR], ids=["grid", "hexagons", "log-polar"])
def test_pairs_conserve_area_and_mean(layout):
    pool = learn.SitePool(layout)
    values = torch.rand(1, 1, layout.n_sites, dtype=torch.float64)
    found = pool(values)[0, 0].numpy()

    assert layout.n_sites / 5 < pool.layout.n_sites < layout.n_sites / 2.5
    np.testing.assert_allclose(pool.layout.area_um2.sum(), layout.area_um2.sum())
    np.testing.assert_allclose(found @ pool.layout.area_um2, values[0, 0].numpy() @ layout.area_um2)


def test_network_of_sites_learns_its_position():
    """A small network: convolution, pooling, convolution."""
    torch.manual_seed(0)
    pool = learn.SitePool(HEXAGONS)
    network = nn.Sequential(
        learn.SiteConv(1, 8, HEXAGONS), nn.ReLU(), pool, learn.SiteConv(8, 8, pool.layout), nn.ReLU(), nn.Flatten(),
        nn.Linear(8 * pool.layout.n_sites, 2),
    )  # fmt: skip
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-2)
    position = torch.from_numpy(HEXAGONS.centroid_um / 15.0).float()
    values = torch.eye(HEXAGONS.n_sites)[:, None] * 3.0
    for _ in range(150):
        optimiser.zero_grad()
        loss = ((network(values) - position) ** 2).mean()
        loss.backward()
        optimiser.step()

    assert float(loss.detach()) < 0.02 * float(position.var())


# -- rasters ----------------------------------------------------------------------------------------------------------------


def test_raster_of_rings_shows_every_site():
    raster = learn.Cortical(LOG_POLAR)
    values = np.random.default_rng(0).random((2, LOG_POLAR.n_sites))
    found = raster(torch.from_numpy(values)[None])[0]

    np.testing.assert_array_equal(found.numpy(), fs.reconstruct.cortical(LOG_POLAR, values).data)


def test_raster_interpolates_linear_functions_exactly():
    raster = learn.Cortical(HEXAGONS, n_rings=6, n_sectors=16, r_min_um=2.0, r_max_um=12.0)
    found = raster(torch.from_numpy(HEXAGONS.centroid_um.T.copy())[None])[0].numpy()
    radius = 2.0 * 6.0 ** ((np.arange(6) + 0.5) / 6)[:, np.newaxis]
    angle = 2 * np.pi * (np.arange(16) + 0.5) / 16

    np.testing.assert_allclose(found, [radius * np.cos(angle), radius * np.sin(angle)], atol=1e-12)


# -- modules ----------------------------------------------------------------------------------------------------------------


LAYERS = {
    "convolution": lambda: learn.SiteConv(3, 4, HEXAGONS),
    "mean": lambda: learn.SitePool(HEXAGONS),
    "max": lambda: learn.SitePool(HEXAGONS, reduce="max"),
    "raster": lambda: learn.Cortical(HEXAGONS, n_rings=4, n_sectors=8),
}


@pytest.mark.parametrize("name", LAYERS)
def test_site_layers_are_modules(name, device):
    layer = LAYERS[name]()
    values = torch.rand(2, 3, HEXAGONS.n_sites)
    expected = layer(values)
    for other in (copy.deepcopy(layer), pickle.loads(pickle.dumps(layer))):
        assert torch.equal(other(values), expected)
    assert layer(values[0]).shape == expected.shape[1:]
    moved = layer.to(device)(values.to(device))
    assert (moved.shape, moved.device.type) == (expected.shape, device.type)


@pytest.mark.parametrize("name", LAYERS)
def test_site_layers_run_in_bfloat16(name):
    values = torch.rand(2, 3, HEXAGONS.n_sites)
    layer = LAYERS[name]()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = layer(values)

    torch.testing.assert_close(found.float(), layer(values), rtol=0.03, atol=0.03)
    assert layer(values.bfloat16()).dtype == torch.bfloat16


@pytest.mark.parametrize("name", LAYERS)
@pytest.mark.parametrize(
    ("values", "message"),
    [
        (torch.rand(2, 3, 5), "'values' must have the shape"),
        (torch.rand(HEXAGONS.n_sites), "'values' must have the shape"),
        (torch.ones(2, 3, HEXAGONS.n_sites, dtype=torch.int64), "floating-point"),
        (np.ones((2, 3, HEXAGONS.n_sites)), "'values' must be a Tensor"),
    ],
)
def test_wrong_values_of_sites_are_rejected(name, values, message):
    with pytest.raises(fs.FoveasimError, match=message):
        LAYERS[name]()(values)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: learn.SiteConv(1, 1, HEXAGONS, 4), "'kernel_size' must be odd"),
        (lambda: learn.SiteConv(1, 1, fs.layout.grid(2, 2, 1.0)), "at least 9 photosites, got 4"),
        (lambda: learn.SiteConv(0, 1, HEXAGONS), "'in_channels' must be"),
        (lambda: learn.SitePool(HEXAGONS, [0, 1]), "'groups' must be 132 integers, one per site"),
        (lambda: learn.SitePool(HEXAGONS, reduce="median"), "'reduce' must be one of"),
        (lambda: learn.Cortical(HEXAGONS), "must have the columns 'ring' and 'sector'"),
        (lambda: learn.Cortical(HEXAGONS, n_rings=3), "'n_sectors' must be given with 'n_rings'"),
        (lambda: learn.Cortical(HEXAGONS, n_rings=3, n_sectors=8, r_max_um=0.1), "'r_max_um' must be larger"),
    ],
)
def test_wrong_site_layers_are_rejected(build, message):
    with pytest.raises(fs.FoveasimError, match=message):
        build()

"""Generated layouts as functions of parameters: central differences, closed forms, errors."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

import foveasim as fs
from foveasim.errors import ParameterError

torch = pytest.importorskip("torch")
learn = fs.learn

GRID = fs.Grid.centred((40, 44), 0.5)
MAP = np.random.default_rng(1).uniform(0.2, 2.0, GRID.shape)
TARGET = np.random.default_rng(2).uniform(0.5, 3.0, 10_000)


def number(value):
    return torch.tensor(value, dtype=torch.float64, requires_grad=True)


def loss_of_layout(layout):
    return float(((fs.Integrator(layout, GRID)(MAP[np.newaxis])[0] - TARGET[: layout.n_sites]) ** 2).sum())


def zones_of_outlines(pitch_um):
    outlines = shapely.box(-3.1, -2.9, 3.0, 3.2), shapely.Polygon([(-8.0, -7.5), (8.1, -7.1), (8.3, 8.2), (-7.9, 7.7)])
    return fs.layout.zones(pitch_um=pitch_um, outlines_um=outlines)


def scaled_zones(pitch_um):
    return fs.layout.zones(side_um=(4 * pitch_um, 8 * pitch_um), pitch_um=(pitch_um, 2 * pitch_um))


LOG_POLAR = {"n_sectors": 17, "n_rings": 6, "r_min_um": 1.3, "r_max_um": 9.1}
CASES = [
    ("log_polar", LOG_POLAR, "r_min_um"),
    ("log_polar", LOG_POLAR, "r_max_um"),
    ("log_polar", {**LOG_POLAR, "fovea": "rings", "stagger": True}, "r_max_um"),
    ("log_polar", {"n_sectors": 23, "r_min_um": 1.1, "r_max_um": 9.9, "ring_ratio": 1.31}, "ring_ratio"),
    ("hexagonal", {"n_columns": 7, "n_rows": 8, "pitch_um": 1.37}, "pitch_um"),
    ("hexagonal", {"n_columns": 7, "n_rows": 8, "pitch_um": 1.37, "fill_factor": 0.71}, "fill_factor"),
    (scaled_zones, {"pitch_um": 1.13}, "pitch_um"),
]


@pytest.mark.parametrize(("generator", "parameters", "name"), CASES)
def test_gradient_of_loss_matches_central_differences(generator, parameters, name):
    value = number(parameters[name])

    points, outlines = learn.generated(generator, {**parameters, name: value})
    power = learn.site_power(points, torch.from_numpy(MAP), outlines, GRID)
    ((power - torch.from_numpy(TARGET[: outlines.n_sites])) ** 2).sum().backward()

    function = getattr(fs.layout, generator) if isinstance(generator, str) else generator
    step = 1e-5 * parameters[name]
    losses = [loss_of_layout(function(**{**parameters, name: parameters[name] + k * step})) for k in (-2, -1, 1, 2)]
    expected = (losses[0] - 8.0 * losses[1] + 8.0 * losses[2] - losses[3]) / (12.0 * step)
    assert value.grad.item() == pytest.approx(expected, rel=1e-6)


def test_derivatives_by_pitches_of_zones_are_separate():
    pitches = number([1.03, 1.65])

    points, outlines = learn.generated(zones_of_outlines, {"pitch_um": pitches})
    power = learn.site_power(points, torch.from_numpy(MAP), outlines, GRID)
    ((power - torch.from_numpy(TARGET[: outlines.n_sites])) ** 2).sum().backward()

    for k in range(2):
        losses = []
        for sign in (-1.0, 1.0):
            moved = [1.03, 1.65]
            moved[k] += sign * 1e-5
            losses.append(loss_of_layout(zones_of_outlines(moved)))
        assert pitches.grad[k].item() == pytest.approx((losses[1] - losses[0]) / 2e-5, rel=1e-6)


def test_area_derivative_of_squares_is_twice_pitch():
    pitch = number(1.7)
    points, outlines = learn.generated("grid", {"n_x": 4, "n_y": 3, "pitch_um": pitch, "fill_factor": 0.64})

    power = learn.site_power(points, torch.full(GRID.shape, 3.0, dtype=torch.float64), outlines, GRID)
    (gradient,) = torch.autograd.grad(power.sum(), pitch)

    assert power.detach().numpy() == pytest.approx(3.0 * 0.64 * 1.7**2, rel=1e-12)
    assert gradient.item() == pytest.approx(12 * 3.0 * 0.64 * 2.0 * 1.7, rel=1e-10)


def test_area_of_log_polar_has_closed_form():
    r_min, r_max = number(1.3), number(9.1)
    points, outlines = learn.generated(
        "log_polar", {"n_sectors": 12, "n_rings": 5, "r_min_um": r_min, "r_max_um": r_max}
    )

    gradients = torch.autograd.grad(outlines.area_um2(points).sum(), (r_min, r_max))

    # A regular polygon of n corners has the area n/2 sin(2π/n) r².
    factor = 12 * np.sin(2.0 * np.pi / 12)
    assert [g.item() for g in gradients] == pytest.approx([-factor * 1.3, factor * 9.1], rel=1e-9)


def test_points_are_those_of_the_generator():
    points, outlines = learn.generated("hexagonal", {"n_columns": 5, "n_rows": 4, "pitch_um": number(2.0)})
    layout = fs.layout.hexagonal(5, 4, 2.0)

    assert outlines.layout(points).xy_um == pytest.approx(layout.xy_um, abs=1e-12)
    assert outlines.n_points < layout.xy_um.shape[0] // 2
    assert sorted(outlines.columns) == sorted(layout.columns)
    assert not learn.generated("hexagonal", {"n_columns": 5, "n_rows": 4, "pitch_um": 2.0})[0].requires_grad


def test_vertices_that_separate_are_not_merged():
    def two_squares(gap_um):
        return fs.Layout.from_polygons([shapely.box(0, 0, 1, 1), shapely.box(1 + gap_um, 0, 2, 1)])

    gap = number(0.0)
    points, outlines = learn.generated(two_squares, {"gap_um": gap})
    (gradient,) = torch.autograd.grad(outlines.area_um2(points)[1], gap, retain_graph=True)

    assert gradient.item() == pytest.approx(-1.0, rel=1e-10)
    assert outlines.n_points == 8
    assert torch.autograd.grad(outlines.area_um2(points)[0], gap)[0].abs() < 1e-11


def test_change_of_topology_names_parameter():
    # At this radius, the next ring begins to fit.
    r_max_um = 1.0 * 1.25**7

    with pytest.raises(ParameterError, match=r"'r_max_um' must not change the topology.*sites.*fixed number of rings"):
        learn.generated(
            "log_polar", {"n_sectors": 20, "r_min_um": 1.0, "ring_ratio": 1.25, "r_max_um": number(r_max_um)}
        )


def test_rejected_neighbouring_values_name_parameter():
    with pytest.raises(
        ParameterError, match=r"'pitch_um\[0\]' must have valid values around it.*function as generator"
    ):
        learn.generated("zones", {"side_um": (8.0, 16.0), "pitch_um": number([1.0, 2.0])})


def test_kink_of_vertices_is_an_error():
    def kinked(side_um):
        return fs.Layout.from_rectangles([[0.0, 0.0]], max(side_um, 2.0))

    with pytest.raises(
        ParameterError, match=r"'side_um' must have values around it at which the vertices move smoothly"
    ):
        learn.generated(kinked, {"side_um": number(2.0)})


def test_integer_with_gradient_is_an_error():
    with pytest.raises(ParameterError, match=r"'n_sectors' must be an integer of 'log_polar', without derivatives"):
        learn.generated("log_polar", {**LOG_POLAR, "n_sectors": number(17.0)})


def test_unknown_name_suggests_closest():
    with pytest.raises(
        ParameterError, match=r"names of parameters of 'log_polar' as keys, got 'r_mx_um'; did you mean 'r_max_um'"
    ):
        learn.generated("log_polar", {"r_mx_um": number(3.0)})
    with pytest.raises(
        ParameterError,
        match=r"'generator' must be the name of a layout generator, got 'logpolar'; did you mean 'log_polar'",
    ):
        learn.generated("logpolar", {})


@pytest.mark.parametrize(
    "value", [torch.tensor(2.0, requires_grad=True), torch.ones(2, 2, dtype=torch.float64, requires_grad=True)]
)
def test_other_tensors_are_rejected(value):
    with pytest.raises(ParameterError, match="'pitch_um' must be a float64 tensor on the CPU with at most one axis"):
        learn.generated("hexagonal", {"n_columns": 3, "pitch_um": value})


def test_function_must_return_layout():
    with pytest.raises(ParameterError, match="'generator' must return a Layout, got an int"):
        learn.generated(lambda pitch_um: int(2 * pitch_um), {"pitch_um": 2.0})
    with pytest.raises(ParameterError, match="'generator' must be a string, or a callable"):
        learn.generated(3, {})


def test_second_derivative_is_an_error():
    pitch = number(1.7)
    points, outlines = learn.generated("grid", {"n_x": 2, "n_y": 2, "pitch_um": pitch})
    (gradient,) = torch.autograd.grad(outlines.area_um2(points).sum(), pitch, create_graph=True)

    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.backward()

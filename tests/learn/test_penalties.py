"""Penalties for design rules: agreement with the check, finite differences, descent to valid layouts."""

from __future__ import annotations

import numpy as np
import pytest

import foveasim as fs
from foveasim.errors import ParameterError

torch = pytest.importorskip("torch")
learn = fs.learn

ALL_RULES = fs.DesignRules(
    min_size_um=0.9, max_size_um=1.1, min_area_um2=0.81, min_width_um=0.8, min_angle_deg=70.0, max_aspect_ratio=1.3, max_neighbour_ratio=1.2,
    angle_limit_deg=26.0,
)  # fmt: skip
SUPPORTED = list(ALL_RULES.limits())


def jittered_mesh(seed, n=8, jitter_um=0.3):
    mesh = learn.Mesh(fs.layout.grid(n, n, 1.0), boundary="sliding")
    rng = np.random.default_rng(seed)
    with torch.no_grad():
        mesh.displacement_um += torch.from_numpy(rng.uniform(-jitter_um, jitter_um, mesh.displacement_um.shape))
        mesh.limit_step()
    return mesh


def worst_values(layout):
    """Worst measured value of each rule: limits that every layout violates make all values visible."""
    extreme = {name: 1e9 if name.startswith("min") else 0.0 for name in SUPPORTED} | {"min_angle_deg": 180.0}
    return {
        result.rule: result.worst
        for result in layout.check(fs.DesignRules(**extreme, angle_limit_deg=12.0, dbu_um=1e-6)).results
    }


@pytest.fixture
def exact_widths(monkeypatch):
    """Distances between edges count completely or not at all, as in the design rule."""
    monkeypatch.setattr("foveasim.learn.penalties.ANGLE_MARGIN_DEG", 1e-9)


@pytest.mark.usefixtures("exact_widths")
@pytest.mark.parametrize("name", SUPPORTED)
@pytest.mark.parametrize("seed", range(6))
def test_penalty_is_positive_where_rule_is_violated(name, seed):
    mesh = jittered_mesh(seed, jitter_um=0.45)
    worst = worst_values(mesh.layout())[name]
    tighter, looser = (1.002, 0.98) if name.startswith("min") else (0.998, 1.02)

    penalties = [
        learn.barrier(
            mesh(), mesh, fs.DesignRules(**{name: factor * worst}, angle_limit_deg=12.0), margin_fraction=1e-3
        ).item()
        for factor in (tighter, looser)
    ]

    assert penalties[0] > 0.0
    assert penalties[1] == 0.0


@pytest.mark.usefixtures("exact_widths")
def test_penalty_is_positive_for_concave_violations():
    rng = np.random.default_rng(3)
    for _ in range(40):
        angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, 9))
        radius = rng.uniform(0.4, 2.0, 9)
        polygon = np.stack((radius * np.cos(angle), radius * np.sin(angle)), axis=1)
        if np.diff(angle, append=angle[0] + 2.0 * np.pi).max() > 3.0:
            continue
        layout = fs.Layout.from_polygons((polygon, [0, 9], [0, 1]))
        outlines, points = learn.Outlines.from_layout(layout)
        worst = worst_values(layout)
        for name in ("min_width_um", "min_angle_deg", "max_aspect_ratio"):
            if not worst[name]:  # a corner below the limit, or no edges that face each other
                continue
            tighter, looser = (1.002, 0.998) if name.startswith("min") else (0.998, 1.002)
            penalties = [
                learn.barrier(
                    torch.from_numpy(points),
                    outlines,
                    fs.DesignRules(**{name: factor * worst[name]}, angle_limit_deg=12.0),
                    margin_fraction=1e-4,
                )
                for factor in (tighter, looser)
            ]
            assert penalties[0] > 0.0
            assert penalties[1] == 0.0


def test_penalty_is_zero_far_from_limits():
    mesh = learn.Mesh(fs.layout.hexagonal(6, 6, 2.0), boundary="free")
    rules = fs.DesignRules(
        min_size_um=1.0, max_size_um=3.0, min_area_um2=1.0, min_width_um=1.0, min_angle_deg=90.0, max_aspect_ratio=1.5, max_neighbour_ratio=1.3,
        angle_limit_deg=26.0,
    )  # fmt: skip

    penalty = learn.barrier(mesh(), mesh, rules, convex=True)
    penalty.backward()

    assert penalty.item() == 0.0
    assert not mesh.displacement_um.grad.any()


@pytest.mark.parametrize("name", [*SUPPORTED, "convex"])
def test_gradient_matches_finite_differences(name):
    mesh = jittered_mesh(11, n=4)
    rules = fs.DesignRules(**({} if name == "convex" else {name: getattr(ALL_RULES, name)}), angle_limit_deg=26.0)
    outlines, margin = mesh.outlines, 1.2 if name in ("convex", "max_aspect_ratio") else 0.2

    def penalty(points):
        return learn.barrier(points, outlines, rules, margin_fraction=margin, convex=name == "convex")

    # No right angles at corners of the layout, where two rectangles of equal area have different derivatives.
    points = mesh().detach() + 0.05 * torch.from_numpy(np.random.default_rng(12).uniform(-1.0, 1.0, mesh().shape))
    points.requires_grad_()
    assert penalty(points) > 0.0
    assert torch.autograd.gradcheck(penalty, (points,), eps=1e-7, atol=1e-5, rtol=1e-6)


def test_penalty_grows_towards_limit_and_beyond():
    layout = fs.layout.grid(2, 2, 1.0)
    outlines, points = learn.Outlines.from_layout(layout)
    limits = np.linspace(0.8, 1.3, 101)

    penalties = np.array(
        [
            learn.barrier(
                torch.from_numpy(points), outlines, fs.DesignRules(min_width_um=limit, angle_limit_deg=26.0)
            ).item()
            for limit in limits
        ]
    )

    assert (penalties[limits < 0.9] == 0.0).all()
    assert (np.diff(penalties[limits > 0.92]) > 0.0).all()
    assert np.isfinite(penalties).all()
    assert (np.diff(penalties[limits > 1.01], 2) > -1e-9).all()


def test_penalty_and_slope_are_continuous():
    layout = fs.layout.grid(1, 1, 1.0)
    outlines, points = learn.Outlines.from_layout(layout)
    rules = fs.DesignRules(min_area_um2=1.0)

    def penalty_and_slope(scale):
        factor = torch.tensor(scale, dtype=torch.float64, requires_grad=True)
        value = learn.barrier(factor * torch.from_numpy(points), outlines, rules, quadratic_fraction=0.3)
        (slope,) = torch.autograd.grad(value, factor)
        return value.item(), slope.item()

    for area in (1.03, 1.1):  # where the parabola ends, and where the penalty begins
        below, above = (penalty_and_slope(np.sqrt(area) + step) for step in (-1e-9, 1e-9))
        assert below == pytest.approx(above, abs=1e-4)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("seed", range(4))
def test_descent_from_violations_satisfies_all_rules(seed):
    mesh = jittered_mesh(seed)
    assert not mesh.layout().check(ALL_RULES).ok
    optimiser = torch.optim.Adam([mesh.displacement_um], lr=0.01)

    for _ in range(400):
        optimiser.zero_grad()
        penalty = learn.barrier(mesh(), mesh, ALL_RULES, margin_fraction=0.05, convex=True)
        if penalty.item() == 0.0:
            break
        penalty.backward()
        optimiser.step()
        mesh.limit_step()

    report = mesh.layout().check(ALL_RULES)
    assert report.ok, report


def test_descent_of_power_cells_satisfies_rules():
    x = np.arange(6) + 0.5
    centres = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2) + np.random.default_rng(5).uniform(-0.4, 0.4, (36, 2))
    cells = learn.PowerCells(centres, region_um=(0.0, 0.0, 6.0, 6.0))
    rules = fs.DesignRules(min_size_um=0.75, min_width_um=0.6, angle_limit_deg=26.0, max_neighbour_ratio=1.5)
    assert not cells.layout().check(rules).ok
    optimiser = torch.optim.Adam(cells.parameters(), lr=0.01)

    for _ in range(300):
        optimiser.zero_grad()
        penalty = learn.barrier(*cells.cells(), rules)
        if penalty.item() == 0.0:
            break
        penalty.backward()
        optimiser.step()
        cells.limit_step()

    assert cells.layout().check(rules).ok


def test_zero_length_edges_do_not_contribute():
    x = np.arange(4) + 0.5
    cells = learn.PowerCells(np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2), region_um=(0.0, 0.0, 4.0, 4.0))
    rules = fs.DesignRules(
        min_width_um=0.9, min_angle_deg=80.0, max_aspect_ratio=1.2, max_neighbour_ratio=1.1, angle_limit_deg=26.0
    )

    penalty = learn.barrier(*cells.cells(), rules, convex=True)
    penalty.backward()

    assert penalty.item() == 0.0
    assert torch.isfinite(cells.centres_um.grad).all()


def test_convexity_moves_reflex_vertex_outwards():
    layout = fs.Layout.from_polygons(([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [1.2, 0.9]], [0, 4], [0, 1]))
    mesh = learn.Mesh(layout, boundary="free")
    assert learn.barrier(mesh(), mesh, fs.DesignRules()).item() == 0.0
    optimiser = torch.optim.Adam([mesh.displacement_um], lr=0.01)

    for _ in range(200):
        optimiser.zero_grad()
        learn.barrier(mesh(), mesh, fs.DesignRules(), convex=True).backward()
        optimiser.step()

    xy_um = mesh.layout().xy_um
    out = np.roll(xy_um, -1, axis=0) - xy_um
    into = np.roll(out, 1, axis=0)
    assert (into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0] > 0.0).all()


def test_unsupported_rule_lists_supported_ones():
    mesh = jittered_mesh(1, n=2)

    with pytest.raises(
        ParameterError, match=r"'rules' must have limits of 'min_size_um', .*'max_neighbour_ratio' only, got 'grid_um'"
    ):
        learn.barrier(mesh(), mesh, fs.DesignRules(grid_um=0.005))
    waived = fs.DesignRules(grid_um=0.005, max_sites=3, max_gap_um2=0.0, waivers={"grid_um": "snapped afterwards"})
    assert learn.barrier(mesh(), mesh, waived).item() == 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rules": fs.DesignRules(max_aspect_ratio=1.0)}, "'rules' must have a limit 'max_aspect_ratio' above 1"),
        ({"rules": 3}, "'rules' must be a DesignRules, got an int"),
        ({"rules": ALL_RULES, "weight": 0.0}, "'weight' must be > 0"),
        ({"rules": ALL_RULES, "margin_fraction": -1.0}, "'margin_fraction' must be > 0"),
        ({"rules": ALL_RULES, "outlines": "mesh"}, "'outlines' must be an Outlines or a Mesh, got a str"),
    ],
)
def test_invalid_arguments_give_one_line(arguments, message):
    mesh = jittered_mesh(1, n=2)

    with pytest.raises(ParameterError, match=message):
        learn.barrier(mesh(), **({"outlines": mesh} | arguments))
